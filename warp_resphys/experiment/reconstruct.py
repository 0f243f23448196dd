"""Stage: reconstructs the residual forces with which a simulator follows the observed trials."""

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from ..dynamics.simulator import Simulator
from ..io.fan_out import ALONE, Workers
from ..io.files import atomic_hdf5, create, write_json
from ..io.stages import StageContext
from ..learning.metrics import marker_errors
from ..learning.reconstruction import Reconstructor, make_reconstructor, without_ringing
from ..learning.rollout import Rollout
from ..settings.stages import ReconstructStage
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .experiment import Experiment
from .files import RECONSTRUCTION, read_if_there, reconstruction_file
from .parts import PartRollout, TrialPart, read_parts, remove_parts, split_into_parts, work_on

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

_UNITS = {"q": "m", "v": "m/s", "force": "N"}
_STATIC_STEP = 1e6  # s, time step for static poses, in which inertia is negligible
_REPLAY_TOLERANCE = 0.1  # mm, acceptable increase of the marker error when forces are replayed


def reconstruct(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes reconstruction_<model>.h5: q, v and force (R, K + 1, N, 3), and adds to reconstruction.json.

    The force of a frame is the force during the step that ends there; it is zero in the first frame. Forces from
    markers are stored in single precision, which rounds positions to 1e-8 m. The summary has the distance between
    reconstructed and observed points, and the same distance when the forces of the validation trials are replayed.
    Replays can fail where reconstruction follows unstable equilibria, e.g. of a chamber's wall that is about to buckle:
    each step meets the markers, but a network that learns these forces does not.
    """
    settings: ReconstructStage = context.settings
    experiment, model = Experiment(settings, context.run_dir), settings.model
    parts: list[TrialPart] = []
    for number, names in enumerate(experiment.batches(settings.reconstructed)):
        last = float(experiment.trials(names).times.max()) / experiment.model_simulator(model).time_step
        frames = max(experiment.learned_steps(int(last + 1e-6)), 1) + 1
        parts += split_into_parts(context, names, frames, f"part{number}", batch=settings.batch)
    work_on(parts, _OfTrials, workers)
    order = [name for part in parts for name in part.names]
    held = experiment.moving(settings.split.validation)
    rows = [row for row, name in enumerate(order) if name in held]
    error, held_out = read_parts(parts, "error"), {}
    with atomic_hdf5(context.run_dir / reconstruction_file(model), "reconstruction", {"names": order}) as file:
        create(file, "error", error, "mm", time_axis=1)
        for name, unit in _UNITS.items():  # One array at a time, as many trials take much memory.
            values = read_parts(parts, name)
            create(file, name, values, unit, time_axis=1)
            held_out[name] = values[rows].copy()
    summary = {"mean_mm": float(np.nanmean(error)), "max_mm": float(np.nanmax(error))}
    if rows and experiment.dataset.bound is not None:
        summary["replayed_mm"] = _replay(context, [order[row] for row in rows], {**held_out, "error": error[rows]})
    others = read_if_there(context.run_dir / RECONSTRUCTION)
    finite = {key: value if np.isfinite(value) else None for key, value in summary.items()}
    write_json(context.run_dir / RECONSTRUCTION, {**others, model: finite})
    remove_parts(context)


def _replay(context: StageContext, names: Sequence[str], reconstructed: Mapping[str, FloatArray]) -> float:
    """Mean distance of the markers when reconstructed forces are replayed [mm]; warns if it is too large."""
    replayed = float(np.nanmean(replayed_errors(context.settings, context.run_dir, tuple(names), reconstructed)))
    met = float(np.nanmean(reconstructed["error"]))
    if not replayed <= met + _REPLAY_TOLERANCE:
        log.warning(
            "%s: replaying the forces gives a marker error of %.2f mm, reconstruction gave %.2f mm: raise "
            "reconstruction.regularisation, or set reconstruction.modes.",
            *(context.name, replayed, met),
        )
    return replayed


def reconstructing_simulator(experiment: Experiment, model: str) -> Simulator:
    """Simulator of a model for reconstruction, see `without_ringing`."""
    return without_ringing(experiment.model_simulator(model), experiment.observe)


class Reconstructing(PartRollout):
    """Roll-out in which forces bring bodies to the observed points; each step starts from the force of the last one.

    Attributes:
        method: reconstruction method.
        force: (B, N, 3) force of the last step [N].
    """

    method: Reconstructor
    force: torch.Tensor

    @torch.enable_grad()
    def bring_to(self, observed: torch.Tensor, inputs: Inputs | None = None) -> State:
        """Returns the next state, close to the observed points (B, M, 3) [m]."""
        result = self.method.step(self.state, observed, inputs, self.force)
        self.force, self.shown = result.force, {"iterations": result.iterations}
        return result.state.detach()


class _OfTrials(Reconstructing):
    """Reconstruction of trials that begin in the same way.

    Saves q, v and the force (B, N, 3), and the mean distance of the observed points (B,) [mm].
    """

    def __init__(self, part: TrialPart) -> None:
        settings: ReconstructStage = part.context.settings
        experiment = Experiment(settings, part.context.run_dir)
        simulator = reconstructing_simulator(experiment, settings.model)
        replay = self._replay = experiment.replay(simulator, part.names, settings.model)
        self._start = experiment.start(replay, settings.model)
        self._constants, self._inputs, self._resting = replay.prepare(experiment.parameters(settings.model))
        self._observed = experiment.targets(replay, self._start)
        if replay.is_static:  # One very long step leads to the static pose.
            simulator = dataclasses.replace(simulator, time_step=_STATIC_STEP, integrator="implicit_euler")
            self._observed = torch.cat([torch.full_like(self._observed, torch.nan), self._observed], 1)
            self._inputs = self._resting
        method = make_reconstructor(simulator, **dict(settings.reconstruction), observation=replay.observe)
        self.method = method.with_constants(self._constants)
        self.force = torch.zeros_like(self._start.state.q)
        self._dtype = "float64" if experiment.dataset.bound is None else "float32"
        self.frames, self.units = self._observed.shape[1], {**_UNITS, "error": "mm"}

    @override
    def begin(self) -> State:
        return self._replay.initial_state(self._start, self._constants, self._resting)

    @override
    def step(self, number: int) -> State:
        return self.bring_to(self._observed[:, number], self._inputs.at(number - 1))

    @override
    def frame_arrays(self, number: int) -> dict[str, NDArray[Any]]:
        kept = {"q": self.state.q, "v": self.state.v, "force": self.force}
        reached, seen = (x.cpu().numpy() for x in (self._replay.observe(self.state.q), self._observed[:, number]))
        error = np.array([frame_error(x, y) for x, y in zip(reached, seen, strict=True)])
        arrays = {**{name: values.cpu().numpy() for name, values in kept.items()}, "error": error}
        return {name: values.astype(self._dtype) for name, values in arrays.items()}


def replayed_errors(
    settings: ReconstructStage, run_dir: Path, names: tuple[str, ...], reconstructed: Mapping[str, FloatArray]
) -> FloatArray:
    """(B, K + 1) marker errors [mm] when reconstructed forces are replayed; infinite after a failed step.

    With ``force_frame: corotated``, forces rotate with the body from its reconstructed to its replayed state.

    Args:
        settings: settings of the stage.
        run_dir: folder with the imported trials and the identified parameters.
        names: names of trials that begin in the same way.
        reconstructed: q [m], v [m/s] and the force [N] of the step that ends there, each (B, K + 1, N, 3).
    """
    experiment = Experiment(settings, run_dir, "count")
    simulator = reconstructing_simulator(experiment, settings.model)
    replay = experiment.replay(simulator, names, settings.model)
    start = experiment.start(replay, settings.model)
    constants, inputs, resting = replay.prepare(experiment.parameters(settings.model))
    observed = experiment.targets(replay, start)
    frames = experiment.frames(simulator)
    steps = reconstructed["q"][:, :-1], reconstructed["v"][:, :-1], reconstructed["force"][:, 1:]
    series = [torch.from_numpy(values).to(simulator.rest_positions).unbind(1) for values in steps]

    def predict(state: State, step: int) -> torch.Tensor:
        q, v, force = (values[step] for values in series)
        return force if frames is None else frames.to_world(state.q, state.v, frames.to_rest(q, v, force))

    rollout = Rollout(simulator, predict, inputs, constants)
    errors: FloatArray = np.full(reconstructed["q"].shape[:2], np.inf)
    errors[:, observed.shape[1] :] = np.nan  # Other trials are longer.
    with torch.no_grad():
        state = replay.initial_state(start, constants, resting)
        for k in range(min(errors.shape[1], observed.shape[1])):
            state = rollout.step(state) if k > 0 else state
            reached, seen = replay.observe(state.q).cpu().numpy(), observed[:, k].cpu().numpy()
            for row in np.flatnonzero(~rollout.lost(state).cpu().numpy()):
                errors[row, k] = frame_error(reached[row], seen[row])
    return errors


def frame_error(reached: FloatArray, observed: FloatArray) -> float:
    """Mean distance of the points (M, 3) that were seen in a frame [mm]; NaN if none was seen."""
    errors = marker_errors(reached[None], observed[None])
    return float(errors[0]) if len(errors) else float("nan")
