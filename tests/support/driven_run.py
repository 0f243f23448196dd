"""Synthetic files of a run with pressures: every file that its report reads."""

from pathlib import Path

import numpy as np

from support.configured import composed
from support.measured_run import describe_recordings
from warp_resphys.experiment.build import build_mesh
from warp_resphys.io.files import atomic_hdf5, create, read_json, write_json
from warp_resphys.io.settings import parse
from warp_resphys.learning.metrics import median_filter, summarise, summarise_trajectories
from warp_resphys.report.data import mean_distance
from warp_resphys.settings.run import RunSettings

MODELS = ("simulation", "sysid", "simfree", "resphys")
STEP, LIMIT = 0.02, 20e3
BASE = {"Base - 1": [-0.03, -0.02, -0.005], "Base - 2": [-0.03, 0.02, -0.005], "Base - 3": [0.03, 0.0, -0.005]}
_OFF = {
    None: (1.0, 0.0),
    "simulation": (1.35, 0.08),
    "sysid": (1.15, 0.05),
    "simfree": (0.9, 0.3),
    "resphys": (1.02, 0.01),
}


LABORATORY = {
    "mesh": {"kind": "arm_generated"},
    "time_step": 0.01,
    "integrator": "bdf2",
    "material": {},
    "fibres": {"angles": [8.0], "stiffness": 1e4},
    "noise": 0.0,
    "placement_noise": 0.0,
}


def data(**changes):
    """The settings group ``data``."""
    return {
        "kind": "recorded",
        "folder": None,
        "input_limit": LIMIT,
        "train_fraction": 1.0,
        "input_scales": [],
        **changes,
    }


def arm_settings(name="sopra", chambers=6, **changes):
    """Settings of an experiment on the arm that comes with the package."""
    ring = {f"Ring {level + 1} - {at + 1}": (level, at) for level in range(3) for at in range(4)}
    heights, radii = (-0.13, -0.15, -0.27), (0.022, 0.022, 0.018)
    tracked = {
        label: [radii[k] * np.cos(0.3 + 1.6 * at), radii[k] * np.sin(0.3 + 1.6 * at), heights[k]]
        for label, (k, at) in ring.items()
    }
    plain = composed("mesh=arm_coarse")
    plain |= {
        "name": name,
        "title": "Pneumatic arm",
        "fixed": {"z": 0.0},
        "markers": {"tracked": tracked, "reference": BASE},
        "laboratory": LABORATORY,
        "chambers": {"count": chambers, "axis": [0.0, 0.0, -1.0]},
        "data": data(),
        "time_step": STEP,
    }
    return parse(RunSettings, {**plain, **changes})


def pressures(trials, steps, chambers, factor=1.0):
    """Smooth pressures (K, C) between zero and the limit, by trial [Pa]."""
    times = STEP * np.arange(steps)
    rows = {}
    for number, trial in enumerate(trials):
        phase = np.arange(chambers) * 2.4 + number
        waves = np.sin(times[:, None] * (2.0 + 0.3 * np.arange(chambers)) + phase) + 0.5 * np.sin(
            5.0 * times[:, None] + phase
        )
        rest = np.minimum(1.0, times / 0.3)[:, None]
        rows[trial] = factor * np.clip(12e3 * waves * rest, 0.0, LIMIT)
    return rows


def bent(points, pressure, model=None, sag=0.0):
    """Positions (K + 1, P, 3) of points (P, 3) of a hanging arm under pressures (K, C) [m]."""
    level, lag = _OFF[model]
    angle = 2.0 * np.pi / 3.0 * np.arange(pressure.shape[1])
    push = pressure / LIMIT @ np.stack([np.cos(angle), np.sin(angle)], axis=1)
    tip = np.zeros((len(push) + 1, 2))
    rate = STEP / (0.1 + lag)
    for k, target in enumerate(push):
        tip[k + 1] = tip[k] + rate * (0.03 * level * target - tip[k])
    along = (points[:, 2] / points[:, 2].min()) ** 2
    moved = np.repeat(points[None], len(tip), axis=0)
    moved[..., :2] += tip[:, None] * along[:, None]
    moved[..., 2] += (8.0 * (tip**2).sum(axis=1)[:, None] - sag) * along
    return moved


def write_run(
    folder: Path,
    settings,
    *,
    train=2,
    test=3,
    steps=100,
    chambers=6,
    models=MODELS,
    scales=(),
    horizons=(),
    diverged=(),
    simulated=True,
    sag=0.0,
):
    """Writes all files of a run; bodies hang lower by the sag [m]."""
    mesh = build_mesh(settings.mesh)
    labels = list(settings.markers.tracked)
    bound = np.array(list(settings.markers.tracked.values())) + 1e-4
    nominal = [f"test_{number:02d}" for number in range(test)]
    driven = pressures([*(f"train_{n:02d}" for n in range(train)), *nominal], steps, chambers)
    for scale in scales:
        driven |= pressures([f"{name}_{scale:g}" for name in nominal], steps, chambers, scale)
    rng = np.random.default_rng(0)
    markers = np.stack([bent(bound, pressure, None, sag) for pressure in driven.values()])
    markers += rng.normal(0.0, 5e-5, markers.shape)
    markers[:, 30:36, min(1, len(labels) - 1)] = np.nan
    attributes = {
        "labels": labels,
        "inputs": ["pressure"],
        "pressure_channels": [f"chamber_{number + 1}" for number in range(chambers)],
        "gravity": np.array([0.0, 0.0, -9.80709]),
        "time_step": STEP,
    }
    drawn, count = np.stack(list(driven.values())), train + test
    parts = {"dataset.h5": slice(None, count)} | ({"dataset_scaled.h5": slice(count, None)} if scales else {})
    times = np.tile(STEP * np.arange(steps + 1), (len(driven), 1))
    for name, rows in parts.items():
        names = list(driven)[rows]
        with atomic_hdf5(
            folder / name, "dataset", {**attributes, "names": names, "begins": ["rest"] * len(names)}
        ) as file:
            create(file, "times", times[rows], "s", 1)
            create(file, "observed", markers[rows], "m", 1)
            create(file, "pressure", drawn[rows], "Pa", 1)
            create(file, "bound", bound, "m", 0)
    rolled = list(driven)[train:]
    film = np.arange(0, steps + 1, 2)
    simulated = {}
    described = {"names": rolled, "time_step": STEP, "film_trial": rolled[0]}
    with atomic_hdf5(folder / "rollouts.h5", "rollouts", described) as file:
        create(file, "film_steps", film, "1", 0)
        for model in models:
            observed = np.stack([bent(bound, driven[name], model, sag) for name in rolled])
            body = bent(mesh.vertices, driven[rolled[0]], model, sag)[film]
            if model in diverged:
                observed[0, 60:] = np.nan
                body[film >= 60] = np.nan
            simulated[model] = observed
            create(file, f"{model}_observed", observed.astype(np.float32), "m", 1)
            create(file, f"{model}_film", body.astype(np.float32), "m", 0)
    write_json(folder / "errors.json", _errors(simulated, markers[train:], rolled, test, labels, scales, horizons))
    _write_rest(folder, settings, dict(zip(labels, bound, strict=True)), list(driven)[:2], rng, models, simulated)


def _errors(simulated, measured, names, test, labels, scales, horizons):
    distances = {model: mean_distance(markers, measured)[:, 1:] for model, markers in simulated.items()}
    for rows in distances.values():
        rows[np.isinf(rows)] = np.nan
    nominal = {model: rows[:test] for model, rows in distances.items()}

    def part(rows, first=0, last=None):
        return {model: summarise(values[first:last]) for model, values in rows.items()}

    content = {
        "errors_mm": part(nominal),
        "per_trajectory": summarise_trajectories(names[:test], nominal),
        "per_marker": {
            model: dict(zip(labels, np.nanmean(1e3 * np.linalg.norm(m - measured, axis=3), axis=(0, 1)), strict=True))
            for model, m in simulated.items()
        },
        "median_filtered": {model: median_filter(rows.mean(axis=0), STEP).max() for model, rows in nominal.items()},
        "range": {
            model: {
                "left": 2 if model == "simfree" else 0,
                "first_s": {"test_01": 1.2, "test_00": 0.84} if model == "simfree" else {},
            }
            for model in ("simfree", "resphys")
        },
    }
    if horizons:
        content["horizons"] = {
            f"{w:g}": part({m: rows[:, : round(w / STEP)] for m, rows in nominal.items()}) for w in horizons
        }
        first, *_, last = content["horizons"].values()
        content["growth"] = {
            m: None if last[m]["mean"] is None else last[m]["mean"] / first[m]["mean"] - 1.0 for m in first
        }
    if scales:
        content["scales"] = {"1": content["errors_mm"]} | {
            f"{scale:g}": part(distances, test * (k + 1), test * (k + 2)) for k, scale in enumerate(scales)
        }
        late = {"1": {}, f"{scales[0]:g}": {}, f"{scales[-1]:g}": {names[-1]: 0.4, names[-2]: 0.52}}
        content["scales_range"] = {
            scale: {m: {"left": len(first), "first_s": first} for m in ("simfree", "resphys")}
            for scale, first in late.items()
        }
    return content


def _write_rest(folder, settings, tracked, registered, rng, models, simulated):
    """Writes all files except motions, roll-outs and errors."""
    quality, registration = describe_recordings(registered, tracked, settings.markers.reference, rng, None)
    write_json(folder / "quality.json", quality)
    write_json(folder / "registration.json", registration)
    if simulated:
        material = {"model": "stable_neo_hookean", "youngs_modulus": 250e3, "poissons_ratio": 0.49}
        write_json(folder / "truth.json", {"material": material, "noise_mm": 0.08})
    identified_values = {"youngs_modulus": 237e3, "poissons_ratio": 0.42}
    history = [[{"loss": 0.3 * 0.6**k + 0.02, **identified_values} for k in range(9)]]
    if "sysid" in models:
        identified = {
            "parameters": identified_values,
            "loss": 0.02,
            "history": history,
            "at_bounds": [],
            "uncertainty": None,
        }
        write_json(folder / "identification.json", {"sysid": identified})
    kept = {"epoch": 30, "selection": "rollout", "validation_rollout_error_mm": 0.4}
    for model in {"simfree", "resphys"} & set(models):
        epochs = [
            {
                "epoch": e,
                "train_loss": 1.0 / e,
                "validation_loss": 1.3 / e,
                "rollout_error_mm": 4.0 / e if e % 5 == 0 else None,
            }
            for e in range(1, 31)
        ]
        write_json(folder / f"training_{model}.json", {"kept": kept, "epochs": epochs})
    write_json(folder / "reconstruction.json", {"resphys": {"mean_mm": 0.12, "max_mm": 0.61, "replayed_mm": 0.17}})
    write_json(folder / "stages" / "import.json", {"seconds": 75.0, "peak_memory_gib": 0.8})


def errors_of(folder):
    """Content of errors.json."""
    return read_json(folder / "errors.json")
