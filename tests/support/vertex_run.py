"""Synthetic files of a run with observed vertices: a swinging beam, and models with larger and smaller errors."""

from pathlib import Path

import numpy as np

from support.configured import composed
from warp_resphys.experiment.build import build_mesh
from warp_resphys.io.files import atomic_hdf5, create, write_json
from warp_resphys.io.settings import parse
from warp_resphys.learning.metrics import marker_errors, summarise, summarise_trajectories
from warp_resphys.settings.run import RunSettings

STEPS, STEP = 40, 0.01
TRIALS = {"0.05 kg": 0.008, "0.07 kg": 0.01, "0.12 <kg>": 0.02}  # the first one for training
PERIODS = {"simulation": 0.16, "reconstruction": 0.14, "simfree": 0.143, "resphys": 0.14}
OFFSETS = {"reconstruction": 1e-9, "resphys": 2e-6}


def settings(**changes):
    """Settings of an experiment with observed vertices."""
    return parse(RunSettings, {**composed("mesh.divisions=[4,1,1]"), "time_step": STEP, **changes})


def bending(vertices, amplitude, period=0.14, offset=0.0, steps=STEPS):
    """(steps + 1, N, 3) positions [m] of a beam along x whose tip swings along z and comes to rest."""
    time = np.arange(steps + 1) * STEP
    tip = amplitude * np.exp(-3.0 * time) * np.cos(2.0 * np.pi * time / period) + offset * (time > 0.0)
    positions = np.repeat(vertices[None], steps + 1, axis=0)
    positions[..., 2] += tip[:, None] * (vertices[:, 0] / vertices[:, 0].max()) ** 2
    return positions


def write_run(folder: Path, config, *, models=tuple(PERIODS), diverged=(), steps=STEPS, begins="given"):
    """Writes every file that the report reads."""
    vertices = build_mesh(config.mesh).vertices
    names, test = list(TRIALS), list(TRIALS)[1:]
    target = np.stack([bending(vertices, size, steps=steps) for size in TRIALS.values()])
    attributes = {"names": names, "labels": [], "gravity": np.array([0.0, 0.0, -9.8]), "begins": [begins] * 3}
    with atomic_hdf5(folder / "dataset.h5", "dataset", {**attributes, "time_step": STEP, "inputs": []}) as file:
        create(file, "times", np.tile(STEP * np.arange(steps + 1), (3, 1)), "s", 1)
        create(file, "observed", target, "m", 1)
    runs = {
        m: np.stack([bending(vertices, TRIALS[t], PERIODS[m], OFFSETS.get(m, 0.0), steps) for t in test])
        for m in models
    }
    for model in diverged:
        runs[model][1, 5:9] *= 1e200
        runs[model][1, 9:] = np.nan
    described = {"names": test, "time_step": STEP, "film_trial": test[1]}
    with atomic_hdf5(folder / "rollouts.h5", "rollouts", described) as file:
        create(file, "film_steps", np.arange(steps + 1), "1")
        for model, q in runs.items():
            create(file, f"{model}_observed", q, "m", 1)
            create(file, f"{model}_film", np.clip(q[1], -1e30, 1e30).astype(np.float32), "m")
    write_errors(folder, test, runs, target[1:])
    for model in {"simfree", "resphys"} & set(models):
        write_history(folder / f"training_{model}.json", range(1, 30), 30)
    seconds = {name: {"mean": 0.421, "std": 0.1} for name in ("simulation", "target", "resphys", "inference")}
    write_json(folder / "times.json", {"steps": steps, "seconds": seconds})
    for name, duration in {"acquire": 12.0, "train": 75.4}.items():
        write_json(folder / "stages" / f"{name}.json", {"seconds": duration, "peak_memory_gib": 0.523})


def write_errors(folder, test, runs, target):
    """Writes errors.json."""
    first = min(1, target.shape[1] - 1)
    pairs = {model: zip(q, target, strict=True) for model, q in runs.items()}
    errors = {model: [marker_errors(a[first:], b[first:]) for a, b in rows] for model, rows in pairs.items()}
    summaries = {model: summarise(rows) for model, rows in errors.items()}
    write_json(
        folder / "errors.json",
        {
            "errors_mm": summaries,
            "errors_vs_reconstruction_mm": {m: rows for m, rows in summaries.items() if m != "reconstruction"},
            "per_trajectory": summarise_trajectories(test, errors),
        },
    )


def write_history(path, epochs, kept):
    """Writes the history of a training."""
    records = [
        {
            "epoch": epoch,
            "train_loss": 1.0 / (1 + epoch),
            "validation_loss": 1.5 / (1 + epoch),
            "rollout_error_mm": 0.1 / (1 + epoch) if epoch % 5 == 0 else None,
            "learning_rate": 1e-3,
        }
        for epoch in epochs
    ]
    write_json(
        path,
        {"kept": {"epoch": kept, "selection": "rollout", "validation_rollout_error_mm": 0.02}, "epochs": records},
    )
