"""Stage: simulates the trials of an experiment without recordings; the simulation that plays the real body.

The mesh, regions, material, actuators, integrator and time step of this target are its own (`TargetSettings`). Its
positions and velocities are interpolated to other vertices x by the shape functions of the cells that contain them,

    q(x) = sum_a N_a(x) q_a,

which is exact for fields of the degree of the cells (tests/experiment/test_target.py).
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..data.base_motion import check_steps, prescribed, rigid
from ..data.markers import MarkerMap
from ..data.observation import WHOLE_STATE, Observation
from ..data.obstacle_motion import contact_inputs, prescribed_all
from ..dynamics.simulator import Simulator
from ..io.errors import InputError, MeshError
from ..io.fan_out import ALONE
from ..io.stages import StageContext
from ..mesh.location import locate
from ..mesh.mesh import Mesh, select_vertices
from ..mesh.poses import twisted
from ..settings.body import SimulatorSettings, SteppedSettings, TargetSettings
from ..settings.mesh import PlaceSettings
from ..settings.stages import PlayedSettings, SimulateStage
from ..settings.trials import (
    BaseMotion,
    HeldSettings,
    MotionSettings,
    MovingBase,
    ReleaseFromLoad,
    ReleaseFromTwist,
    SimulatedData,
    Trial,
)
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .build import build_body, build_simulator, whole_mesh
from .files import DATASET, GIVEN, Dataset
from .parts import Arrays, Report, TrialPart, read_parts, remove_parts, split_into_parts, work_on

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

_LARGEST_DISTANCE = 0.2  # of a vertex from the cell of the other mesh that it is extrapolated from, over its diagonal


@dataclass(frozen=True)
class Target:
    """A simulation that plays the real body.

    Attributes:
        simulator: its simulator, on its own mesh.
        substeps: number of its steps per time step of the corrected simulator.
        seen: map from values (B, N', 3) at its vertices to values (B, N, 3) at those of the corrected simulator.
    """

    simulator: Simulator
    substeps: int
    seen: Observation


def build_target(settings: SimulatorSettings, target: TargetSettings) -> Target:
    """Builds the target of simulated data.

    Args:
        settings: of the corrected simulator.
        target: of the target.

    Raises:
        InputError: see `build_simulator`, `substeps_of` and `vertices_in`.
        MeshError: a mesh cannot be read or simulated.
    """
    simulator = build_simulator(target_settings(settings, target), target.material)
    seen = vertices_in(simulator.body.mesh, build_body(settings).mesh)
    return Target(simulator, substeps_of(settings.time_step, target, "target"), seen.to(simulator.rest_positions))


def target_settings(settings: SimulatorSettings | PlayedSettings, target: TargetSettings) -> SimulatorSettings:
    """Settings of the simulator of a target; gravity, solver and device are those of the run."""
    return SimulatorSettings.of(settings, **{key: getattr(target, key) for key in SteppedSettings.model_fields})


def substeps_of(time_step: float, target: TargetSettings, key: str) -> int:
    """Number of steps of a target per time step of the corrected simulator [s].

    Raises:
        InputError: the time step is not a multiple of the target's; ``key`` is the group of the target.
    """
    ratio = time_step / target.time_step
    if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
        raise InputError(
            f"time_step is {time_step:g} s and {key}.time_step {target.time_step:g} s: the first must be a multiple of "
            "the second."
        )
    return round(ratio)


@lru_cache(maxsize=4)
def vertices_in(mesh: Mesh, other: Mesh) -> Observation:
    """Map from values (B, N', 3) at the vertices of a mesh to values (B, N, 3) at those of another one.

    Vertices slightly outside, as on a coarser curved surface, are extrapolated from the nearest cell.

    Raises:
        MeshError: a vertex of the other mesh lies outside of the first.
    """
    if np.array_equal(mesh.vertices, other.vertices):
        return WHOLE_STATE
    place = locate(mesh, other.vertices)
    size = np.linalg.norm(np.ptp(mesh.vertices[mesh.cells[place.cells]], axis=1), axis=1)
    far = int(np.argmax(place.outside / size))
    if place.outside[far] > _LARGEST_DISTANCE * size[far]:
        x, y, z = other.vertices[far]
        raise MeshError(
            f"the simulator's vertex at ({x:g}, {y:g}, {z:g}) m lies outside of this mesh: both must be the same body "
            "in the same place."
        )
    return MarkerMap(torch.as_tensor(mesh.cells[place.cells])[None], torch.as_tensor(place.weights)[None])


def simulate(context: StageContext) -> None:
    """Writes dataset.h5: positions and velocities (R, T + 1, N, 3) of all trials, starting from the held state."""
    settings: SimulateStage = context.settings
    trials, motion = settings.trials, settings.data.base_motion
    frames, names = settings.data.steps + 1, tuple(trial.name for trial in trials)
    poses, times = None, settings.time_step * np.arange(frames, dtype=np.float64)
    points = whole_mesh(settings).vertices
    if motion is not None:
        poses = np.stack([base_of(motion, trial, times, _motion_scale(settings, trial)) for trial in trials])
        for motion_of_trial in poses:
            check_steps(motion_of_trial, points, "data.base_motion")
    obstacles = obstacles_of(settings.data.obstacle_motion, trials, times)
    for name, moved in obstacles.items():
        check_steps(moved[0], points, f"data.obstacle_motion.{name}", f"the obstacle {name!r}")
    parts = split_into_parts(context, names, frames)
    work_on(parts, _free_motion, ALONE)
    observed = read_parts(parts, "observed")
    Dataset(
        names,
        labels=(),
        begins=(GIVEN,) * len(names),
        times=np.tile(times, (len(names), 1)),
        observed=observed,
        held=observed[:, 0],
        payload=np.zeros(len(names)),
        gravity=np.asarray(settings.gravity, dtype=np.float64),
        time_step=settings.time_step,
        velocity=read_parts(parts, "velocity"),
        base=poses,
        obstacles=obstacles,
    ).write(context.run_dir / DATASET)
    remove_parts(context)


def base_of(common: BaseMotion, trial: Trial, times: NDArray[Any], scale: float = 1.0) -> FloatArray:
    """(T, 6) true motion of the base of a body, in the frame of the body.

    Args:
        common: motion of trials without a motion of their own.
        trial: the trial.
        times: (T,) times [s].
        scale: factor of the motion.
    """
    motion = common if trial.base_motion is None and isinstance(common, MotionSettings) else trial.base_motion
    return np.zeros((len(times), 6)) if motion is None else prescribed(motion, times, scale=scale)


def obstacles_of(common: Mapping[str, Any], trials: Sequence[Trial], times: NDArray[Any]) -> dict[str, FloatArray]:
    """(R, T, 6) true motions of obstacles by name, in the frame of the body; zero in trials in which they stand still.

    Args:
        common: motions of trials without their own.
        trials: the trials.
        times: (T,) times [s].
    """
    motions = [prescribed_all(common, trial.obstacle_motion, times) for trial in trials]
    still = np.zeros((len(times), 6))
    return {name: np.stack([own.get(name, still) for own in motions]) for own in motions for name in own}


def _motion_scale(settings: SimulateStage, trial: Trial) -> float:
    """Factor of the motion of the base of a trial."""
    return trial.amount if isinstance(settings.data, MovingBase) else 1.0


def fixed_positions(simulator: Simulator, motions: FloatArray) -> list[torch.Tensor]:
    """Positions (B, D, 3) of the fixed vertices at each of T times [m], for motions (T, B, 6) of their bases."""
    fixed = np.asarray(simulator.body.mesh.vertices[simulator.body.fixed_vertices], dtype=np.float64)
    size = (motions.shape[1], *fixed.shape)
    return [simulator.tensor(rigid(poses).apply(np.broadcast_to(fixed, size))) for poses in motions]


def contact_series(
    simulator: Simulator, common: Mapping[str, Any], trials: Sequence[Trial], times: NDArray[Any]
) -> dict[str, torch.Tensor]:
    """Inputs (T, B, O) of contact by name at times (T,) [s], for the true motions of obstacles in trials."""
    motions = obstacles_of(common, trials, times)
    if not motions:
        return {}
    inputs = contact_inputs(simulator.body, {name: poses.swapaxes(0, 1) for name, poses in motions.items()})
    return {name: simulator.tensor(values) for name, values in inputs.items()}


def _free_motion(part: TrialPart, report: Report) -> Arrays:
    """Positions and velocities of released bodies, or of bodies with a moving base."""
    settings: SimulateStage = part.context.settings
    target, data = build_target(settings, settings.target), settings.data
    simulator, trials = target.simulator, [trial for trial in settings.trials if trial.name in part.names]
    constants, fixed = simulator.prepare(), None
    times = simulator.time_step * np.arange((part.frames - 1) * target.substeps + 1)
    moved = contact_series(simulator, data.obstacle_motion, trials, times)
    if (motion := data.base_motion) is not None:
        poses = [base_of(motion, trial, times[1:], _motion_scale(settings, trial)) for trial in trials]
        fixed = fixed_positions(simulator, np.stack(poses, axis=1))
    states = [initial_state(simulator, data, trials)]
    report()
    for number in range(part.frames - 1):
        state = states[-1]
        for at in range(number * target.substeps, (number + 1) * target.substeps):
            acting = {name: values[at + 1] for name, values in moved.items()}
            inputs = Inputs(fixed_positions=None if fixed is None else fixed[at], **acting)
            state = simulator.step(state, inputs, constants)[0]
        states.append(state)
        report()
    series = {"observed": ([state.q for state in states], "m"), "velocity": ([state.v for state in states], "m/s")}
    return {
        name: (torch.stack([target.seen(x) for x in values], 1).cpu().numpy(), unit)
        for name, (values, unit) in series.items()
    }


def initial_state(simulator: Simulator, data: SimulatedData, trials: Sequence[Trial]) -> State:
    """Initial states of trials, by ``data.kind``, or as a trial is held by itself."""
    common = [trial.amount for trial in trials if trial.load is None]
    states = [_common_state(simulator, data, np.array(common))] if common else []
    states += [_alone(simulator, data, trial.load) for trial in trials if trial.load is not None]
    order = np.argsort([k for own in (True, False) for k, t in enumerate(trials) if (t.load is None) == own])
    whole = State(torch.cat([s.q for s in states]), torch.cat([s.v for s in states]))
    return whole.map(lambda values: values[torch.as_tensor(order, device=values.device)])


def _alone(simulator: Simulator, data: SimulatedData, held: HeldSettings) -> State:
    assert isinstance(data, ReleaseFromLoad)
    return held_alone(simulator, held, held.at or data.load, "data.others" if held.at else "data.load")


def held_alone(simulator: Simulator, held: HeldSettings, load: PlaceSettings, key: str) -> State:
    """Returns the state (1, N, 3) of a body that is held in a way of its own.

    Args:
        simulator: of the body.
        held: how it is held.
        load: vertices that carry the weight.
        key: of these vertices in the configuration, for errors.

    Raises:
        InputError: all vertices of the place are fixed.
    """
    if held.twist_deg:
        angle = simulator.tensor([math.radians(held.twist_deg)])
        q = twisted(simulator.rest_positions, angle, "xyz".index(held.twist_axis))
        return State(q, torch.zeros_like(q))
    along = np.asarray(held.direction, dtype=np.float64) / np.linalg.norm(held.direction)
    force = 1e-3 * held.weight_g * float(np.linalg.norm(simulator.gravity)) * along
    return _under_forces(simulator, load, force[None], key)


def _common_state(simulator: Simulator, data: SimulatedData, values: NDArray[Any]) -> State:
    """Initial states of a batch for (B,) weights [kg], angles [rad] or factors of the motion, by ``data.kind``."""
    if isinstance(data, MovingBase):
        return simulator.static_equilibrium(Inputs(), batch=len(values))
    if isinstance(data, ReleaseFromTwist):
        q = twisted(simulator.rest_positions, simulator.tensor(values), "xyz".index(data.twist_axis))
        return State(q, torch.zeros_like(q))
    return held_state(simulator, data.load, values)


def held_state(simulator: Simulator, load: PlaceSettings, weights: NDArray[Any]) -> State:
    """Equilibrium of the body under weights (B,) [kg] on the vertices of a place, in equal shares.

    Raises:
        InputError: all vertices of the place are fixed.
    """
    log.info("computing the equilibrium under %d weights", len(weights))
    return _under_forces(simulator, load, weights[:, None] * np.asarray(simulator.gravity))


def _under_forces(simulator: Simulator, load: PlaceSettings, forces: FloatArray, key: str = "data.load") -> State:
    """Equilibrium of the body under forces (B, 3) [N] on the vertices of a place, in equal shares."""
    face = select_vertices(simulator.body.mesh, **load.arguments())
    if np.isin(face, simulator.body.fixed_vertices).all():
        raise InputError(f"{key} selects fixed vertices only: hang the weights on vertices that can move.")
    return simulator.static_equilibrium(Inputs(distributed(simulator, face, simulator.tensor(forces))))


def distributed(simulator: Simulator, vertices: NDArray[np.int64], forces: torch.Tensor) -> torch.Tensor:
    """(B, N, 3) nodal forces [N] that distribute total forces (B, 3) equally over vertices."""
    nodal = simulator.rest_positions.new_zeros(len(forces), simulator.body.n_vertices, 3)
    nodal[:, torch.as_tensor(vertices, device=nodal.device)] = forces[:, None] / len(vertices)
    return nodal
