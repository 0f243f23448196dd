"""Stage: the forces that bring the identified simulator to the markers it should have learned from."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...io.files import atomic_hdf5, create, write_json
from ...io.processes import Advance
from ...io.stages import StageContext
from ...learning.driven_rollout import DrivenHybridRollout
from ...learning.sparse_reconstruction import make_sparse_reconstructor
from ..measured.evaluate import marker_errors
from .files import RECONSTRUCTED, RECONSTRUCTION
from .parts import Made, Part, read_parts, remove_parts, split_into_parts, work_on
from .scene import DrivenScene

log = logging.getLogger(__name__)

_UNITS = {"q": "m", "v": "m/s", "force": "N"}
_UNHELD = 0.1  # mm, by which replayed markers may be further off than reconstructed ones


def reconstruct_driven(context: StageContext, processes: int = 1) -> None:
    """Writes reconstruction.h5: q, v and force (R, K + 1, N, 3) of the trials of training and validation.

    They are kept in single precision, which rounds positions to 1e-8 m. And reconstruction.json: how far the
    reconstructed markers are from those that were seen, and how far they are where the forces of validation are
    replayed. Forces can lead along equilibria that are not stable, such as those of a chamber's wall that is about to
    buckle: step by step the markers are met, but nothing that learns these forces will go there.
    """
    settings = context.settings
    names = tuple(settings["split"]["train"]) + tuple(settings["split"]["validation"])
    parts = split_into_parts(context, names, settings["batch"])
    work_on(parts, reconstruct_part, processes, DrivenScene(settings, context.run_dir).learned_steps)
    with atomic_hdf5(context.run_dir / RECONSTRUCTED, "reconstruction", {"names": list(names)}) as file:
        for name, unit in _UNITS.items():
            create(file, name, read_parts(parts, name), unit, time_axis=1)
    errors = read_parts(parts, "error")  # (R, K + 1) [mm], NaN where no marker was seen
    count = len(settings["split"]["validation"])
    met, replayed = (float(np.nanmean(rows[-count:])) for rows in (errors, read_parts(parts, "replayed")))
    summary = {"mean_mm": float(np.nanmean(errors)), "max_mm": float(np.nanmax(errors)), "replayed_mm": replayed}
    write_json(context.run_dir / RECONSTRUCTION, {key: _finite(value) for key, value in summary.items()})
    if not replayed <= met + _UNHELD:
        log.warning(
            "reconstruct: replayed, the forces lead %.2f mm away from the markers, %.2f mm when they were found: raise "
            "reconstruction.regularisation, or set reconstruction.modes.",
            replayed,
            met,
        )
    remove_parts(context)


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def reconstruct_part(part: Part, advance: Advance) -> dict[str, Made]:
    """q, v, force (B, K + 1, N, 3) and the distance of the markers (B, K + 1) [mm] of some trials.

    Also that distance with the forces replayed, of those for validation; NaN for the others.

    Raises:
        ConvergenceError: a step fails.
    """
    settings = part.context.settings
    scene = DrivenScene(settings, part.context.run_dir)
    simulator, observed = scene.simulator, scene.smoothed(part.names)
    tensors, drive = scene.tensors("resphys", part.names), scene.drive("resphys", part.names)
    reconstructor = make_sparse_reconstructor(simulator, scene.markers, **settings["reconstruction"])
    reconstructor = reconstructor.with_tensors(tensors)
    batch = len(part.names)
    state = simulator.static_equilibrium(material=tensors, batch=batch)
    force = torch.zeros_like(state.q)
    fields: dict[str, list[NDArray[np.float32]]] = {name: [] for name in (*_UNITS, "error")}

    def keep(target: torch.Tensor) -> None:
        for name, value in (("q", state.q), ("v", state.v), ("force", force)):
            fields[name].append(value.cpu().numpy().astype(np.float32))
        reached = scene.markers(state.q).cpu().numpy()
        errors = [_error(x, y) for x, y in zip(reached, target.cpu().numpy(), strict=True)]
        fields["error"].append(np.array(errors, dtype=np.float32))

    with torch.no_grad():
        keep(observed[:, 0])
        for k in range(1, scene.learned_steps + 1):
            result = reconstructor.step(state, observed[:, k], force, drive.pressure[:, k - 1])
            state, force = result.state.detach(), result.force
            keep(observed[:, k])
            advance(batch)
    made = {name: np.stack(values, axis=1) for name, values in fields.items()}
    made["replayed"] = np.full_like(made["error"], np.nan)
    rows = [row for row, name in enumerate(part.names) if name in settings["split"]["validation"]]
    if rows:
        names = tuple(part.names[row] for row in rows)
        found = {key: made[key][rows] for key in _UNITS}
        made["replayed"][rows] = replayed_errors(settings, part.context.run_dir, names, found)
    return {name: (values, _UNITS.get(name, "mm")) for name, values in made.items()}


def replayed_errors(
    settings: Mapping[str, Any], run_dir: Path, names: tuple[str, ...], found: Mapping[str, NDArray[np.float32]]
) -> NDArray[np.float32]:
    """(B, K + 1) distance of the markers [mm] of simulations with reconstructed forces; infinite from where one fails.

    The forces turn with the body, from where it was to where it is, if those that are learned do (``force_frame``).

    Args:
        settings: of the stage.
        run_dir: with the imported motions and the identified parameters.
        names: of the trials.
        found: q [m], v [m/s] and the force [N] that leads there, each (B, K + 1, N, 3).
    """
    scene = DrivenScene(settings, run_dir, "count")
    tensors, drive, observed = scene.tensors("resphys", names), scene.drive("resphys", names), scene.smoothed(names)
    state = scene.simulator.static_equilibrium(material=tensors, batch=len(names))
    frames = scene.frames(settings["force_frame"])
    steps = (found["q"][:, :-1], found["v"][:, :-1], found["force"][:, 1:])
    known = zip(*(torch.from_numpy(each).to(state.q).unbind(1) for each in steps), strict=True)

    def predict(q: torch.Tensor, v: torch.Tensor, inputs: torch.Tensor) -> list[torch.Tensor]:
        q0, v0, force = next(known)
        return [force if frames is None else frames.to_world(q, v, frames.to_rest(q0, v0, force))]

    rollout = DrivenHybridRollout(scene.simulator, predict, drive, tensors)
    errors: NDArray[np.float32] = np.full(found["q"].shape[:2], np.inf, dtype=np.float32)
    for k in range(errors.shape[1]):
        state = rollout.step(state) if k > 0 else state
        reached, seen = scene.markers(state.q).cpu().numpy(), observed[:, k].cpu().numpy()
        for row in np.flatnonzero(~rollout.lost(state).cpu().numpy()):
            errors[row, k] = _error(reached[row], seen[row])
    return errors


def _error(reached: NDArray[np.float64], observed: NDArray[np.float64]) -> float:
    """Mean distance of the markers of a frame that were seen [mm]; NaN if none was."""
    found = marker_errors(reached[None], observed[None])
    return float(found[0]) if len(found) else float("nan")
