"""A made-up run of an experiment with measured motions: every file that its report reads."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from support.configured import composed
from warp_resphys.io.files import atomic_hdf5, create, write_json
from warp_resphys.io.settings import parse
from warp_resphys.learning.metrics import summarise
from warp_resphys.mesh.mesh import box_hexahedra
from warp_resphys.settings.run import RunSettings

MODELS = ("published", "simulation", "sysid_elastic", "sysid", "simfree", "resphys_uncorrected", "resphys")
LEARNED = ("simfree", "resphys_uncorrected", "resphys")
TRIALS = {"bare": 0.0, "load52": 0.0520154, "load101": 0.1020303}
TRACKED = {"Tip - 1": [0.1, 0.015, 0.036], "Tip - 2": [0.1, -0.006, 0.024], "Tip - 3": [0.1, 0.036, 0.006]}
REFERENCE = {"Base - 1": [0.006, -0.01, -0.001], "Base - 2": [0.006, 0.04, 0.0275], "Base - 3": [0.006, 0.04, 0.0]}
STEP, SECONDS, FRAMES = 0.01, 0.4, 45
_OFF = {  # Period, damping and level of a model, over those of the reality.
    "published": (1.5, 1.0, 2.0),
    "simulation": (1.06, 1.4, 1.05),
    "sysid_elastic": (1.02, 1.2, 1.0),
    "sysid": (1.01, 1.05, 1.0),
    "simfree": (1.005, 1.1, 0.98),
    "resphys_uncorrected": (1.008, 1.0, 1.0),
    "resphys": (1.003, 1.0, 1.0),
}


def config(**data):
    """Settings of an experiment on recordings."""
    plain = composed("mesh.divisions=[6,2,2]")
    published = {**plain["simulation"], "youngs_modulus": 215e3, "poissons_ratio": 0.45}
    plain |= {
        "name": "beam_real",
        "title": "Real beam",
        "simulation": {**plain["simulation"], "youngs_modulus": 264e3, "poissons_ratio": 0.499},
        "published": {"simulation": published, "physics": {}, "integrator": "implicit_euler"},
        "markers": {"tracked": TRACKED, "reference": REFERENCE},
        "in_the_loop": {"epochs": 5},
        "data": {"kind": "recorded", "folder": "recordings", "seconds": SECONDS, "folds": None, **data},
        "time_step": STEP,
    }
    return parse(RunSettings, plain)


def sag(rest, times, payload, model=None):
    """(T, P, 3) [m] where points at rest (P, 3) are: a beam along x that is let go, sags and swings."""
    period, damping, level = _OFF[model] if model else (1.0, 1.0, 1.0)
    frequency = 2 * np.pi / (period * (0.13 + 1.5 * payload))
    swing = 1.0 - np.exp(-3.0 * damping * times) * np.cos(frequency * times)
    tip = -(0.0065 + 0.3 * payload) * level * np.where(times > 0, swing, 0.0)
    along = np.clip(rest[:, 0] / 0.1, 0.0, None)
    moved = np.repeat(rest[None], len(times), axis=0)
    moved[..., 2] += tip[:, None] * along**2
    moved[..., 0] -= 2.0 * tip[:, None] * along / 0.1 * (rest[:, 2] - 0.015)
    return moved


def describe_recordings(trials, tracked, reference, rng, release=61.3):
    """What quality.json and registration.json hold, from the places of the registered markers by label [m]."""
    labels, places = [*tracked, *reference], np.array([*tracked.values(), *reference.values()])
    second, first_standing, last = labels[1 % len(tracked)], next(iter(reference)), labels[-1]
    quality, registration = {}, {}
    for number, trial in enumerate(trials):
        rows = [
            {
                "label": label,
                "still": label in reference,
                "seen": 0.99 if number == 0 and label == second else 1.0,
                "gaps": int(number == 0 and label == second),
                "longest_gap_frames": 7,
                "masked_frames": 7,
                "jumps": [{"frame": 80, "mm": 0.31}] if label == first_standing else [],
                "noise_mm": 0.0071,
                "drift_mm": 0.02 if label in reference else None,
            }
            for label in labels
        ]
        quality[trial] = {
            "source": f"recordings/{trial}.c3d",
            "rate_hz": 100.0,
            "frames": 300,
            "release_frame": release,
            "longest_gap_filled": 5,
            "markers": rows,
            "warnings": [f"{first_standing} jumps once, by 0.31 mm, in frame 80."] if number < 2 else [],
        }
        residual = dict(zip(labels, (0.8 + 0.1 * number) * rng.uniform(0.5, 1.5, len(labels)), strict=True))
        registration[trial] = {
            "rms_mm": 0.82 + 0.1 * number,
            "residual_mm": residual,
            "outliers": [last] if number == 2 else [],
            "shift_mm": {label: [0.2, 0.2, 0.2] for label in tracked},
            "positions": dict(zip(labels, places.tolist(), strict=True)),
        }
    return quality, registration


def write_recordings(folder: Path, trials=TRIALS):
    """dataset.h5, quality.json, registration.json and truth.json."""
    bound = np.array(list(TRACKED.values())) + 1e-4
    base = np.array(list(REFERENCE.values()))
    rng = np.random.default_rng(0)
    delays = rng.uniform(0.0, STEP, len(trials))
    times = np.arange(1, FRAMES + 1) * STEP - delays[:, None]
    markers = np.stack([sag(bound, t, payload) for t, payload in zip(times, trials.values(), strict=True)])
    markers += rng.normal(0.0, 5e-5, markers.shape)
    markers[0, 9:16, 1] = np.nan
    times[-1, -3:], markers[-1, -3:] = times[-1, -4], np.nan
    with atomic_hdf5(
        folder / "dataset.h5",
        "dataset",
        {
            "names": list(trials),
            "labels": list(TRACKED),
            "gravity": np.array([0.0, 0.02, -9.8]),
            "begins": ["released"] * len(trials),
            "time_step": STEP,
            "inputs": [],
        },
    ) as file:
        create(file, "times", times, "s", 1)
        create(file, "observed", markers, "m", 1)
        create(file, "held", np.repeat(bound[None], len(trials), 0) + 2e-4, "m", 0)
        create(file, "bound", bound, "m", 0)
        create(file, "payload", list(trials.values()), "kg", 0)
    quality, registration = describe_recordings(
        trials, dict(zip(TRACKED, bound + 2e-4, strict=True)), dict(zip(REFERENCE, base + 5e-4, strict=True)), rng
    )
    write_json(folder / "quality.json", quality)
    write_json(folder / "registration.json", registration)
    material = {"model": "stable_neo_hookean", "youngs_modulus": 250e3, "poissons_ratio": 0.49, "mass_damping": 1.0}
    write_json(folder / "truth.json", {"material": material})


def write_split(folder: Path, test: Sequence[str], models=MODELS, trials=TRIALS, diverged=()):
    """identification.json, rollouts.h5, errors.json and the histories of the trainings."""
    mesh = box_hexahedra((0.1, 0.03, 0.03), (6, 2, 2))
    bound = np.array(list(TRACKED.values())) + 1e-4
    steps = np.arange(round(SECONDS / STEP) + 1) * STEP
    rng = np.random.default_rng(0)
    delays = dict(zip(trials, rng.uniform(0.0, STEP, len(trials)), strict=True))
    frames = {trial: np.arange(1, FRAMES + 1) * STEP - delays[trial] for trial in test}
    errors = {}
    attributes = {"names": list(test), "time_step": STEP, "film_trial": test[-1]}
    with atomic_hdf5(folder / "rollouts.h5", "rollouts", attributes) as file:
        create(file, "film_steps", np.arange(len(steps)), "1")
        for model in models:
            q = sag(mesh.vertices, steps, trials[test[-1]], model)
            m = np.stack([sag(bound, frames[trial], trials[trial], model) for trial in test])
            if model in diverged:
                q[20:] = np.nan
                m[0, 20:] = np.nan
            create(file, f"{model}_film", q.astype(np.float32), "m")
            create(file, f"{model}_observed", m, "m", 1)
            truth = np.stack([sag(bound, frames[trial], trials[trial]) for trial in test])
            errors[model] = 1e3 * np.linalg.norm(m - truth, axis=-1)[:, : round(SECONDS / STEP)]
    means = {model: [float(each.mean()) for each in rows] for model, rows in errors.items()}
    plain = {
        "errors_mm": {model: summarise(rows.mean(axis=2)) for model, rows in errors.items()},
        "per_trajectory": [
            {"name": trial, "errors_mm": {model: means[model][row] for model in models}}
            for row, trial in enumerate(test)
        ],
        "per_marker": {
            model: dict(zip(TRACKED, rows.mean(axis=(0, 1)).tolist(), strict=True)) for model, rows in errors.items()
        },
    }
    if "resphys" in models:
        intervals = {"factor": [3.0] * 3, "variance": [1e-6, 0.0, 0.0, 0.0, 1.0]}
        held = {"coverage": 0.87, "half_width_mm": 3.0}
        each = {"level": 0.9, "calibrated_on": "validation", "models": {"resphys": {**intervals, **held}}}
        plain["intervals"] = each
    write_json(folder / "errors.json", plain)
    _write_identification(folder, models)
    for model in (model for model in LEARNED if model in models):
        epochs = [
            {
                "epoch": epoch,
                "train_loss": 1.0 / epoch,
                "validation_loss": 1.5 / epoch,
                "rollout_error_mm": 1.0 / epoch if epoch % 5 == 0 else None,
                "learning_rate": 1e-3,
            }
            for epoch in range(1, 31)
        ]
        kept = {"epoch": 30, "selection": "rollout", "validation_rollout_error_mm": 0.2}
        write_json(folder / f"training_{model}.json", {"kept": kept, "epochs": epochs})
    write_json(folder / "stages" / "identify.json", {"seconds": 95.0, "peak_memory_gib": 0.8})


def _write_identification(folder: Path, models):
    starts = {"youngs_modulus": (264e3, 180e3, 400e3), "poissons_ratio": (0.499, 0.45, 0.48)}
    damping = {"mass_damping": (0.0, 0.5, 2.0), "stiffness_damping": (0.0, 1e-3, 5e-3)}
    best = {"youngs_modulus": 251.3e3, "poissons_ratio": 0.499, "mass_damping": 0.94, "stiffness_damping": 2.9e-3}

    def result(parameters):
        history = [
            [
                {
                    "loss": 0.002 + 0.1 * (start + 1) * 0.5**k,
                    **{name: best[name] + (values[start] - best[name]) * 0.6**k for name, values in parameters.items()},
                }
                for k in range(12)
            ]
            for start in range(3)
        ]
        names = list(parameters)
        correlation = np.eye(len(names))
        correlation[0, 1] = correlation[1, 0] = -0.96
        return {
            "parameters": {name: best[name] for name in names},
            "loss": 0.002,
            "history": history,
            "at_bounds": ["poissons_ratio"],
            "uncertainty": {
                "deviation": {name: 0.01 * best[name] for name in names},
                "correlation": correlation.tolist(),
                "poorest": dict(zip(names, [0.8, 0.6, 0.01, 0.0], strict=False)),
                "poorest_deviation": 0.12,
            },
        }

    found = {}
    if "sysid" in models:
        found["sysid"] = result(starts | damping)
    if "sysid_elastic" in models:
        found["sysid_elastic"] = result(starts)
    write_json(folder / "identification.json", found)


def write_folds(folder: Path, models=MODELS):
    """A run with a fold for each trial, as its stages leave it."""
    write_recordings(folder)
    folds = {}
    for trial in TRIALS:
        write_split(folder / f"fold_{trial}", [trial], models)
        folds[trial] = json.loads((folder / f"fold_{trial}" / "errors.json").read_text())
    over = {
        model: {
            "mean": float(np.mean([fold["errors_mm"][model]["mean"] for fold in folds.values()])),
            "std": 0.1,
            "trajectories": 3,
            "diverged": 0,
        }
        for model in models
    }
    write_json(folder / "metrics.json", {"folds": folds, "errors_mm": over, "versions": {"numpy": "9"}})
