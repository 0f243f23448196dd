"""Stage: roll-outs of the test trials, by every model, and the errors of their markers."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...io.files import atomic_hdf5, create, read_checkpoint, write_json
from ...io.processes import Advance
from ...io.stages import StageContext
from ...learning.driven_rollout import Range, WatchedModel
from ...learning.metrics import median_filter, summarise, summarise_each
from ...learning.networks import NextState, ResidualForce, StateMap, restore
from ...mesh.mesh import select_vertices
from ..measured.evaluate import marker_errors, per_marker
from ..measured.files import ERRORS, ROLLOUTS, weights_file
from .files import LEARNED, MODELS
from .parts import Made, Part, read_parts, remove_parts, split_into_parts, work_on
from .scene import DrivenScene
from .train import rollout_of

FloatArray = NDArray[np.float64]

_FILM_RATE = 25.0  # Hz
_KINDS: Mapping[str, type[StateMap]] = {"resphys": ResidualForce, "simfree": NextState}
_KIND_NAMES = {"resphys": "residual force", "simfree": "next state"}


def evaluate_driven(context: StageContext, processes: int = 1) -> None:
    """Writes rollouts.h5, markers and tip of every model, and errors.json."""
    settings = context.settings
    scene = DrivenScene(settings, context.run_dir)
    groups = {factor: tuple(names) for factor, names in settings["groups"].items()}
    names = [name for group in groups.values() for name in group]
    batch, steps = settings["batch"], scene.motions.pressure.shape[1]
    parts = {model: split_into_parts(context, names, batch, model, model) for model in MODELS}
    work_on([part for some in parts.values() for part in some], roll_out_part, processes, steps)
    markers = {model: read_parts(some, "markers").astype(np.float64) for model, some in parts.items()}
    step = scene.simulator.time_step
    with atomic_hdf5(context.run_dir / ROLLOUTS, "rollouts", {"names": names, "time_step": step}) as file:
        for model, some in parts.items():
            create(file, f"{model}_markers", markers[model].astype(np.float32), "m", time_axis=1)
            create(file, f"{model}_tip", read_parts(some, "tip"), "m", time_axis=1)
            create(file, f"{model}_film", read_parts(some[:1], "film"), "m")
        create(file, "film_steps", film_steps(steps, step))
    left = {model: read_parts(parts[model], "left") for model in LEARNED}
    observed = scene.pick(tuple(names)).markers.cpu().numpy()
    write_json(context.run_dir / ERRORS, summary(settings, groups, markers, observed, left, scene.labels, step))
    remove_parts(context)


def film_steps(steps: int, step: float) -> NDArray[np.int64]:
    """Steps that the film shows."""
    every = max(round(1.0 / (_FILM_RATE * step)), 1)
    return np.arange(0, steps + 1, every)


def summary(
    settings: Mapping[str, Any],
    groups: Mapping[str, Sequence[str]],
    markers: Mapping[str, FloatArray],
    observed: FloatArray,
    left: Mapping[str, NDArray[np.int64]],
    labels: Sequence[str],
    step: float,
) -> dict[str, Any]:
    """What errors.json says.

    Args:
        settings: with ``data.windows`` [s].
        groups: names of the trials by pressure factor, the nominal ones first.
        markers: by model, (R, K + 1, M, 3) [m], NaN where a roll-out diverged.
        observed: (R, K + 1, M, 3) [m], NaN where a marker was not seen.
        left: by model, (R,) the step at which a trial left the range of the training, or -1.
        labels: M names.
        step: h [s].
    """
    nominal, *others = groups.items()
    count = len(nominal[1])
    test = {model: x[:count] for model, x in markers.items()}
    seen = observed[:count]
    errors = {model: _errors(x, seen) for model, x in test.items()}
    windows = {f"{seconds:g}": round(seconds / step) + 1 for seconds in settings["data"]["windows"]}
    found: dict[str, Any] = {
        "errors_mm": {model: summarise(rows) for model, rows in errors.items()},
        "windows": {
            name: {m: summarise(_errors(x[:, :frames], seen[:, :frames])) for m, x in test.items()}
            for name, frames in windows.items()
        },
        "per_trajectory": summarise_each(tuple(nominal[1]), errors),
        "per_marker": {model: per_marker(x, seen, tuple(labels)) for model, x in test.items()},
        "median_filtered": {model: _largest_filtered(rows, step) for model, rows in errors.items()},
        "range": {model: _range(rows[:count], nominal[1], step) for model, rows in left.items()},
    }
    if len(windows) > 1:
        first, last = next(iter(windows)), list(windows)[-1]
        found["growth"] = {m: _growth(found["windows"][first][m], found["windows"][last][m]) for m in test}
    if others:
        found["overpressure"] = {nominal[0]: found["errors_mm"]}
        found["overpressure_range"] = {nominal[0]: found["range"]}
        for number, (factor, names) in enumerate(others, start=1):
            rows = slice(number * count, (number + 1) * count)
            found["overpressure"][factor] = {m: summarise(_errors(x[rows], observed[rows])) for m, x in markers.items()}
            found["overpressure_range"][factor] = {m: _range(each[rows], names, step) for m, each in left.items()}
    return found


def _errors(markers: FloatArray, observed: FloatArray) -> list[FloatArray]:
    return [marker_errors(x, y) for x, y in zip(markers, observed, strict=True)]


def _largest_filtered(errors: Sequence[FloatArray], step: float) -> float | None:
    """Largest error of any trial after a median over a second of time [mm]; None where a roll-out diverged."""
    if not all(np.isfinite(each).all() for each in errors):
        return None
    return max(float(median_filter(each, step).max()) for each in errors)


def _growth(first: Mapping[str, Any], last: Mapping[str, Any]) -> float | None:
    """By how much of itself the mean error grows; None where a roll-out diverged."""
    if first["mean"] is None or last["mean"] is None:
        return None
    return float(last["mean"] / first["mean"] - 1.0)


def _range(left: NDArray[np.int64], names: Sequence[str], step: float) -> dict[str, Any]:
    gone = {name: float(step * at) for name, at in zip(names, left, strict=True) if at >= 0}
    return {"left": len(gone), "first_s": gone}


def roll_out_part(part: Part, advance: Advance) -> dict[str, Made]:
    """Markers (B, K + 1, M, 3), tip (B, K + 1, 3), the film of the first trial, and when trials left the range."""
    settings, name = part.context.settings, part.more
    scene = DrivenScene(settings, part.context.run_dir, "count")
    simulator, motions = scene.simulator, scene.pick(part.names)
    watched = None
    if name in LEARNED:
        path = part.context.run_dir / weights_file(name)
        tensors, description = read_checkpoint(path, _KIND_NAMES[name])
        model = restore(_KINDS[name], tensors, description).to(simulator.rest_positions.device)
        range_ = Range.restore(description["range"], model.linear)
        watched = WatchedModel(model, range_, scene.frames(description["force_frame"]))
    rollout = rollout_of(scene, name, watched, part.names)
    batch, steps = motions.pressure.shape[:2]
    state = simulator.static_equilibrium(material=scene.tensors(name, part.names), batch=batch)
    tip = torch.as_tensor(select_vertices(simulator.body.mesh, **settings["tip"]), device=state.q.device)
    filmed = set(film_steps(steps, simulator.time_step).tolist())
    markers, tips, film = [], [], []
    for k in range(steps + 1):
        if k > 0:
            state = rollout.step(state)
            advance(batch)
        lost = rollout.lost(state)[:, None, None]
        markers.append(torch.where(lost, torch.nan, scene.markers(state.q)).float())
        tips.append(torch.where(lost[:, 0], torch.nan, state.q[:, tip].mean(1)).float())
        if k in filmed:
            film.append(rollout.positions(state)[0].float())
    left = torch.full((batch,), -1) if watched is None or watched.left_at is None else watched.left_at
    return {
        "markers": (torch.stack(markers, 1).cpu().numpy(), "m"),
        "tip": (torch.stack(tips, 1).cpu().numpy(), "m"),
        "film": (torch.stack(film).cpu().numpy(), "m"),
        "left": (left.cpu().numpy(), "1"),
    }
