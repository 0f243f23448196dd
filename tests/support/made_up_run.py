"""Made-up runs, every file that a report reads: of a beam that is let go,
an arm under pressure, and whole vertices.

Models differ from the reality by their sizes, periods and lags.
"""

from pathlib import Path

import numpy as np

from support.configured import settings
from warp_resphys import ObservedMotions, box_hexahedra
from warp_resphys.data.trials import Trials
from warp_resphys.experiment.build import build_mesh
from warp_resphys.io.safe_files import atomic_hdf5, create, read_json, write_json
from warp_resphys.learning.error_tables import ComparedModels

GRAVITY = np.array([0.0, 0.02, -9.8])


def _write_rollouts(folder, names, step, film_steps, drawn, observed, films):
    """rollouts.h5, with observed positions (R, T, M, 3)
    and filmed bodies (F, N, 3) by model [m].
    """
    with atomic_hdf5(
        folder / "rollouts.h5", "rollouts", {"names": names, "time_step": step, "film_trial": drawn}
    ) as f:
        create(f, "film_steps", film_steps, "1")
        for model, values in observed.items():
            create(f, f"{model}_observed", values, "m", 1)
            create(f, f"{model}_film", np.clip(films[model], -1e30, 1e30).astype(np.float32), "m")


def _write_trainings(folder, models):
    """Histories of the trainings of those models that are learned."""
    epochs = [
        {"epoch": k, "train_loss": 1.0 / k, "validation_loss": 1.5 / k, "learning_rate": 1e-3}
        for k in range(1, 31)
    ]
    for record in epochs[4::5]:
        record["rollout_error_mm"] = 1.0 / record["epoch"]
    test = {
        "trials": ["bare"],
        "split": "validation",
        "error_mm": 0.2,
        "below_mm": 0.5,
        "used": True,
    }
    kept = {"epoch": 30, "selection": "rollout", "validation_rollout_error_mm": 0.2, "test": test}
    for model in {"simfree", "resphys_uncorrected", "resphys"} & set(models):
        write_json(folder / f"training_{model}.json", {"kept": kept, "epochs": epochs})


def _write_stages(folder, **seconds):
    for name, duration in seconds.items():
        write_json(
            folder / "stages" / f"{name}.json", {"seconds": duration, "peak_memory_gib": 0.8}
        )


def _write_recordings(folder, trials, tracked, reference, rng, release=61.3):
    """quality.json and registration.json, from places of the registered markers by label [m]."""
    places = {**tracked, **reference}
    standing, *_, last = reference
    seen = {
        "seen": 0.99,
        "gaps": 1,
        "longest_gap_frames": 7,
        "masked_frames": 7,
        "jumps": [{"frame": 80, "mm": 0.31}],
    }
    rows = [{"label": label, "still": label in reference, **seen} for label in places]
    about = {"rate_hz": 100.0, "frames": 300, "release_frame": release, "longest_gap_filled": 5}
    about |= {
        "markers": [
            {**row, "noise_mm": 0.0071, "drift_mm": 0.02 if row["still"] else None} for row in rows
        ]
    }
    quality, registration = {}, {}
    for number, trial in enumerate(trials):
        warnings = [f"{standing} jumps once, by 0.31 mm, in frame 80."] if number < 2 else []
        quality[trial] = {"source": f"recordings/{trial}.c3d", "warnings": warnings, **about}
        registration[trial] = {
            "rms_mm": 0.82 + 0.1 * number,
            "residual_mm": dict(
                zip(places, (0.8 + 0.1 * number) * rng.uniform(0.5, 1.5, len(places)), strict=True)
            ),
            "outliers": [last] if number == 2 else [],
            "shift_mm": {label: [0.2, 0.2, 0.2] for label in tracked},
            "positions": places,
        }
    write_json(folder / "quality.json", quality)
    write_json(folder / "registration.json", registration)


BEAM = settings(
    "experiment=beam_real",
    "mesh.divisions=[6,2,2]",
    "data.folder=recordings",
    "data.seconds=0.4",
    *("data.folds=null", "in_the_loop.epochs=5", "time_step=0.01"),
)
TRIALS = {name: trial.payload for name, trial in BEAM.data.trials.items()}
TRACKED, REFERENCE = BEAM.markers.plain()["tracked"], BEAM.markers.plain()["reference"]
STEP, SECONDS, FRAMES = 0.01, 0.4, 45
BOUND = np.array(list(TRACKED.values())) + 1e-4
_SWINGS = {  # Period, damping and level of a model of the beam, over those of the reality.
    "published": (1.5, 1.0, 2.0),
    "simulation": (1.06, 1.4, 1.05),
    "sysid_elastic": (1.02, 1.2, 1.0),
    "sysid": (1.01, 1.05, 1.0),
    "simfree": (1.005, 1.1, 0.98),
    "resphys_uncorrected": (1.008, 1.0, 1.0),
    "resphys": (1.003, 1.0, 1.0),
}
BEAM_MODELS = tuple(_SWINGS)
_FOUND = {
    "youngs_modulus": 251.3e3,
    "poissons_ratio": 0.499,
    "mass_damping": 0.94,
    "stiffness_damping": 2.9e-3,
}


def sag(rest, times, payload, model=None):
    """(T, P, 3) [m] where points at rest (P, 3) are:
    a beam along x that is let go, sags and swings.
    """
    period, damping, level = _SWINGS[model] if model else (1.0, 1.0, 1.0)
    frequency = 2 * np.pi / (period * (0.13 + 1.5 * payload))
    swing = 1.0 - np.exp(-3.0 * damping * times) * np.cos(frequency * times)
    tip = -(0.0065 + 0.3 * payload) * level * np.where(times > 0, swing, 0.0)
    along = np.clip(rest[:, 0] / 0.1, 0.0, None)
    moved = np.repeat(rest[None], len(times), axis=0)
    moved[..., 2] += tip[:, None] * along**2
    moved[..., 0] -= 2.0 * tip[:, None] * along / 0.1 * (rest[:, 2] - 0.015)
    return moved


def _frames(rng):
    """(3, T) times of the frames of all trials [s]."""
    return np.arange(1, FRAMES + 1) * STEP - rng.uniform(0.0, STEP, len(TRIALS))[:, None]


def write_recordings(folder: Path):
    """dataset.h5, quality.json, registration.json and truth.json of a beam."""
    rng = np.random.default_rng(0)
    times = _frames(rng)
    markers = np.stack(
        [sag(BOUND, t, payload) for t, payload in zip(times, TRIALS.values(), strict=True)]
    )
    markers += rng.normal(0.0, 5e-5, markers.shape)
    markers[0, 9:16, 1] = np.nan
    times[-1, -3:], markers[-1, -3:] = times[-1, -4], np.nan
    held, payload = np.repeat(BOUND[None], 3, 0) + 2e-4, np.array([*TRIALS.values()])
    words = tuple(TRIALS), tuple(TRACKED), ("released",) * 3
    Trials(*words, times, markers, held, payload, GRAVITY, STEP, bound=BOUND).write(
        folder / "dataset.h5"
    )
    base = np.array(list(REFERENCE.values())) + 5e-4
    seen = dict(zip(TRACKED, BOUND + 2e-4, strict=True)), dict(zip(REFERENCE, base, strict=True))
    _write_recordings(folder, TRIALS, *seen, rng)
    material = {
        "model": "stable_neo_hookean",
        "youngs_modulus": 250e3,
        "poissons_ratio": 0.49,
        "mass_damping": 1.0,
    }
    write_json(folder / "truth.json", {"material": material})


def write_split(folder: Path, test, models=BEAM_MODELS, diverged=()):
    """identification.json, rollouts.h5, errors.json and the histories of trainings of a beam."""
    rest = box_hexahedra((0.1, 0.03, 0.03), (6, 2, 2)).vertices
    steps = np.arange(round(SECONDS / STEP) + 1) * STEP
    frames = dict(zip(TRIALS, _frames(np.random.default_rng(0)), strict=True))
    films = {model: sag(rest, steps, TRIALS[test[-1]], model) for model in models}
    observed = {
        model: np.stack([sag(BOUND, frames[t], TRIALS[t], model) for t in test]) for model in models
    }
    for model in diverged:
        films[model][20:] = observed[model][0, 20:] = np.nan
    _write_rollouts(folder, list(test), STEP, np.arange(len(steps)), test[-1], observed, films)
    truth = np.stack([sag(BOUND, frames[trial], TRIALS[trial]) for trial in test])
    count = round(SECONDS / STEP)
    words = (tuple(test), tuple(TRACKED), ("released",) * len(test))
    times = np.stack([frames[trial] for trial in test])
    held = np.repeat(BOUND[None], len(test), 0)
    payload = np.array([TRIALS[trial] for trial in test])
    trials = Trials(
        *words, times[:, :count], truth[:, :count], held, payload, GRAVITY, STEP, bound=BOUND
    )
    simulated = {model: x[:, :count] for model, x in observed.items()}
    content = ComparedModels(ObservedMotions(trials), (), {"1": test}, simulated).errors()
    if "resphys" in models:
        own = {
            "factor": [3.0] * 3,
            "variance": [1e-6, 0.0, 0.0, 0.0, 1.0],
            "coverage": 0.87,
            "half_width_mm": 3.0,
        }
        content["intervals"] = {
            "level": 0.9,
            "calibrated_on": "validation",
            "models": {"resphys": own},
        }
    write_json(folder / "errors.json", content)
    elastic = {name: _FOUND[name] for name in ("youngs_modulus", "poissons_ratio")}
    searches = {"sysid": _search(_FOUND), "sysid_elastic": _search(elastic)}
    write_json(
        folder / "identification.json", {m: own for m, own in searches.items() if m in models}
    )
    _write_trainings(folder, models)
    _write_stages(folder, identify=95.0)


def write_beam_run(folder: Path, *test, **more):
    """All files of a run of a beam."""
    write_recordings(folder)
    write_split(folder, list(test), **more)


def _search(found):
    """Content of identification.json for a model of these parameters: three searches."""

    def record(start, k):
        return {"loss": 0.002 + 0.1 * start * 0.5**k} | {
            n: x * (1.0 + 0.1 * start * 0.6**k) for n, x in found.items()
        }

    correlation = np.eye(len(found))
    correlation[0, 1] = correlation[1, 0] = -0.96
    return {
        "parameters": found,
        "loss": 0.002,
        "history": [[record(start, k) for k in range(12)] for start in (1, 2, 3)],
        "at_bounds": ["poissons_ratio"],
        "uncertainty": {
            "deviation": {name: 0.01 * value for name, value in found.items()},
            "correlation": correlation.tolist(),
            "poorest": dict(zip(found, [0.8, 0.6, 0.01, 0.0], strict=False)),
            "poorest_deviation": 0.12,
            "ranges": dict.fromkeys(found, 1.0),
        },
    }


def write_folds(folder: Path, models=BEAM_MODELS):
    """A run with a fold for each trial, as its stages leave it."""
    write_recordings(folder)
    folds = {}
    for trial in TRIALS:
        write_split(folder / f"fold_{trial}", [trial], models)
        folds[trial] = read_json(folder / f"fold_{trial}" / "errors.json")
    means = {
        model: float(np.mean([fold["errors_mm"][model]["mean"] for fold in folds.values()]))
        for model in models
    }
    over = {
        model: {"mean": mean, "std": 0.1, "trajectories": 3, "diverged": 0}
        for model, mean in means.items()
    }
    write_json(
        folder / "metrics.json",
        {"folds": folds, "errors_mm": over, "versions": {"numpy": "9"}, "device": "cpu"},
    )


ARM_MODELS = ("simulation", "sysid", "simfree", "resphys")
ARM_STEP, LIMIT = 0.02, 20e3
_BENDS = {  # Size and lag [s] of a model of the arm, beside the reality.
    None: (1.0, 0.0),
    "simulation": (1.35, 0.08),
    "sysid": (1.15, 0.05),
    "simfree": (0.9, 0.3),
    "resphys": (1.02, 0.01),
}


def arm_settings(*overrides, name="sopra"):
    """Settings of an experiment on the arm that comes with the package."""
    own = (
        f"data.input_limit={LIMIT}",
        "data.input_scales=[]",
        "data.train_fraction=1",
        f"time_step={ARM_STEP}",
    )
    return settings(f"experiment={name}", "mesh=arm_coarse", *own, *overrides)


def pressures(trials, steps, chambers, factor=1.0):
    """Smooth pressures (K, C) between zero and the limit, by trial [Pa]."""
    times = ARM_STEP * np.arange(steps)[:, None]
    rows = {}
    for number, trial in enumerate(trials):
        phase = np.arange(chambers) * 2.4 + number
        waves = np.sin(times * (2.0 + 0.3 * np.arange(chambers)) + phase) + 0.5 * np.sin(
            5.0 * times + phase
        )
        rows[trial] = factor * np.clip(12e3 * waves * np.minimum(1.0, times / 0.3), 0.0, LIMIT)
    return rows


def bent(points, pressure, model=None, sag=0.0):
    """Positions (K + 1, P, 3) of points (P, 3) of a hanging arm under pressures (K, C) [m]."""
    level, lag = _BENDS[model]
    angle = 2.0 * np.pi / 3.0 * np.arange(pressure.shape[1])
    push = pressure / LIMIT @ np.stack([np.cos(angle), np.sin(angle)], axis=1)
    tip = np.zeros((len(push) + 1, 2))
    rate = ARM_STEP / (0.1 + lag)
    for k, target in enumerate(push):
        tip[k + 1] = tip[k] + rate * (0.03 * level * target - tip[k])
    along = (points[:, 2] / points[:, 2].min()) ** 2
    moved = np.repeat(points[None], len(tip), axis=0)
    moved[..., :2] += tip[:, None] * along[:, None]
    moved[..., 2] += (8.0 * (tip**2).sum(axis=1)[:, None] - sag) * along
    return moved


def write_arm_run(
    folder: Path,
    run,
    *,
    train=2,
    test=3,
    steps=100,
    chambers=6,
    models=ARM_MODELS,
    scales=(),
    horizons=(),
    diverged=(),
    simulated=True,
    sag=0.0,
):
    """Writes all files of a run of an arm; bodies hang lower by the sag [m]."""
    mesh, rng = build_mesh(run.mesh), np.random.default_rng(0)
    labels = list(run.markers.tracked)
    bound = np.array(list(run.markers.tracked.values())) + 1e-4
    nominal = [f"test_{number:02d}" for number in range(test)]
    driven = pressures([*(f"train_{n:02d}" for n in range(train)), *nominal], steps, chambers)
    for scale in scales:
        driven |= pressures([f"{name}_{scale:g}" for name in nominal], steps, chambers, scale)
    markers = np.stack([bent(bound, pressure, None, sag) for pressure in driven.values()])
    markers += rng.normal(0.0, 5e-5, markers.shape)
    markers[:, 30:36, min(1, len(labels) - 1)] = np.nan
    drawn, count = np.stack(list(driven.values())), train + test
    parts = {"dataset.h5": slice(None, count)} | (
        {"dataset_scaled.h5": slice(count, None)} if scales else {}
    )
    channels = {"pressure": tuple(f"chamber_{number + 1}" for number in range(chambers))}

    def trials(rows, begins, **inputs):
        names, x = tuple(driven)[rows], markers[rows]
        times = np.tile(ARM_STEP * np.arange(steps + 1), (len(names), 1))
        words, still = (names, tuple(labels), (begins,) * len(names)), np.zeros(len(names))
        return Trials(*words, times, x, x[:, 0], still, GRAVITY, ARM_STEP, bound=bound, **inputs)

    for name, rows in parts.items():
        trials(rows, "rest", inputs={"pressure": drawn[rows]}, channels=channels).write(
            folder / name
        )
    rolled, film = list(driven)[train:], np.arange(0, steps + 1, 2)
    observed = {m: np.stack([bent(bound, driven[name], m, sag) for name in rolled]) for m in models}
    films = {m: bent(mesh.vertices, driven[rolled[0]], m, sag)[film] for m in models}
    for model in diverged:
        observed[model][0, 60:] = films[model][film >= 60] = np.nan
    _write_rollouts(folder, rolled, ARM_STEP, film, rolled[0], observed, films)
    groups = {
        f"{scale:g}": rolled[test * k : test * (k + 1)] for k, scale in enumerate((1.0, *scales))
    }
    left = {model: np.full(len(rolled), -1) for model in ("simfree", "resphys")}
    left["simfree"][:2] = (42, 60)[: len(rolled)]
    left["simfree"][test:][-2:] = (26, 20)[: len(rolled) - test]
    motions = ObservedMotions(trials(slice(None), "given"))
    compared = ComparedModels(motions, (), groups, observed, left, horizons=horizons)
    write_json(folder / "errors.json", compared.errors())
    _write_recordings(
        folder,
        list(driven)[:2],
        dict(zip(labels, bound, strict=True)),
        run.markers.reference,
        rng,
        None,
    )
    if simulated:
        material = {"model": "stable_neo_hookean", "youngs_modulus": 250e3, "poissons_ratio": 0.49}
        write_json(folder / "truth.json", {"material": material, "noise_mm": 0.08})
    if "sysid" in models:
        own = _search({"youngs_modulus": 237e3, "poissons_ratio": 0.42}) | {
            "at_bounds": [],
            "uncertainty": None,
        }
        write_json(folder / "identification.json", {"sysid": own})
    _write_trainings(folder, models)
    write_json(folder / "reconstruction.json", {"resphys": {"mean_mm": 0.12, "max_mm": 0.61}})
    _write_stages(folder, **{"import": 75.0})


STEPS = 40
# Of the tip [m]; the first trial is for training.
AMPLITUDES = {"0.05 kg": 0.008, "0.07 kg": 0.01, "0.12 <kg>": 0.02}
# s
PERIODS = {
    "simulation": 0.16,
    "reconstruction": 0.14,
    "simfree": 0.143,
    "resphys": 0.14,
    "law": 0.141,
}
OFFSETS = {"reconstruction": 1e-9, "resphys": 2e-6}  # m


def vertex_settings():
    """Settings of an experiment with observed vertices."""
    return settings(
        "mesh.divisions=[4,1,1]", f"time_step={STEP}", "~law", "~data.others", "timing=true"
    )


def swinging(vertices, amplitude, period=0.14, offset=0.0, steps=STEPS):
    """(steps + 1, N, 3) positions [m] of a beam along x
    whose tip swings along z and comes to rest.
    """
    time = np.arange(steps + 1) * STEP
    tip = amplitude * np.exp(-3.0 * time) * np.cos(2.0 * np.pi * time / period) + offset * (
        time > 0.0
    )
    positions = np.repeat(vertices[None], steps + 1, axis=0)
    positions[..., 2] += tip[:, None] * (vertices[:, 0] / vertices[:, 0].max()) ** 2
    return positions


def write_vertex_run(
    folder, run, *, models=tuple(PERIODS)[:-1], diverged=(), steps=STEPS, begins="given"
):
    """Writes every file of a run whose vertices are observed."""
    vertices = build_mesh(run.mesh).vertices
    names, test = tuple(AMPLITUDES), list(AMPLITUDES)[1:]
    target = np.stack([swinging(vertices, size, steps=steps) for size in AMPLITUDES.values()])
    times = np.tile(STEP * np.arange(steps + 1), (3, 1))
    trials = Trials(
        names, (), (begins,) * 3, times, target, target[:, 0], np.zeros(3), GRAVITY, STEP
    )
    trials.write(folder / "dataset.h5")
    runs = {
        m: np.stack(
            [
                swinging(vertices, AMPLITUDES[t], PERIODS[m], OFFSETS.get(m, 0.0), steps)
                for t in test
            ]
        )
        for m in models
    }
    for model in diverged:
        runs[model][1, 5:9] *= 1e200
        runs[model][1, 9:] = np.nan
    _write_rollouts(
        folder, test, STEP, np.arange(steps + 1), test[1], runs, {m: q[1] for m, q in runs.items()}
    )
    simulated = {m: q for m, q in runs.items() if m != "reconstruction"}
    motions = ObservedMotions(trials)
    compared = ComparedModels(
        motions, (), {"1": test}, simulated, reconstructed=runs.get("reconstruction")
    )
    write_json(folder / "errors.json", compared.errors())
    _write_trainings(folder, models)
    seconds = {
        name: {"mean": 0.421, "std": 0.1}
        for name in ("simulation", "target", "resphys", "inference")
    }
    write_json(folder / "times.json", {"steps": steps, "seconds": seconds})
    _write_stages(folder, acquire=12.0, train=75.4)
