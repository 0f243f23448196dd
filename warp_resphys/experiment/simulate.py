"""Stage: simulates the trials of an experiment without recordings.

The simulation that plays the real body.

The mesh, regions, material, actuators, integrator and time step of this target are its own
(`TargetSettings`). Its positions and velocities are interpolated to other vertices x by the shape
functions of the cells that contain them,

    q(x) = sum_a N_a(x) q_a,

which is exact for fields of the degree of the cells (tests/experiment/test_target.py).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain, islice, repeat
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from ..core.dynamics.simulator import Simulator
from ..core.mesh.place import Place
from ..core.mesh.selection import vertices_at
from ..core.mesh.surface import locate
from ..core.mesh.volume_mesh import Mesh
from ..core.stepping.inputs import Inputs
from ..core.stepping.rollout import states
from ..core.stepping.rotations import twisted
from ..core.stepping.state import Constants, State
from ..data.base_motion import check_steps, contact_inputs, prescribed, prescribed_all, rigid
from ..data.markers import WHOLE_STATE, MarkerMap, Observation
from ..data.trials import GIVEN, Trials
from ..io.arrays import FloatArray, IntArray
from ..io.errors import InputError, MeshError
from ..io.parts import Arrays, Report, TrialPart
from ..io.resuming import StageContext
from ..settings.body import SimulatorSettings, SteppedSettings, TargetSettings
from ..settings.data_kinds import MovingBase, ReadingSettings, ReleaseFromTwist, SimulatedData
from ..settings.performed import HeldSettings, MotionSettings, Trial
from ..settings.stage_keys import StageSettings
from .build import build_body, build_simulator, whole_mesh
from .files import DATASET

LOADS: Final = "sensors"  # owner of the readings in the memory of a state
Read = Callable[[State, State, Inputs, Constants], torch.Tensor]
# Of a vertex from the cell of the other mesh that it is extrapolated from, over its diagonal.
_LARGEST_DISTANCE = 0.2


@dataclass(frozen=True)
class Target:
    """A simulation that plays the real body.

    Attributes:
        simulator: its simulator, on its own mesh.
        substeps: number of its steps per time step of the corrected simulator.
        seen: map from values (B, N', 3) at its vertices to values (B, N, 3) at those of the
            corrected simulator.
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
    return Target(
        simulator,
        substeps_of(settings.time_step, target, "target"),
        seen.to(simulator.rest_positions),
    )


def target_settings(settings: SimulatorSettings, target: TargetSettings) -> SimulatorSettings:
    """Settings of the simulator of a target; gravity, solver and device are those of the run."""
    return SimulatorSettings.of(
        settings, **{key: getattr(target, key) for key in SteppedSettings.model_fields}
    )


def substeps_of(time_step: float, target: TargetSettings, key: str) -> int:
    """Number of steps of a target per time step of the corrected simulator [s].

    Raises:
        InputError: the time step is not a multiple of the target's; ``key`` is the group of the
            target.
    """
    ratio = time_step / target.time_step
    if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
        raise InputError(
            f"time_step is {time_step:g} s and {key}.time_step {target.time_step:g} s: the first "
            "must be a multiple of the second."
        )
    return round(ratio)


@lru_cache(maxsize=4)
def vertices_in(mesh: Mesh, other: Mesh) -> Observation:
    """Map from values (B, N', 3) at vertices of a mesh to values (B, N, 3) at those of another one.

    Vertices slightly outside, as on a coarser curved surface, are extrapolated from the nearest
    cell.

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
            f"the simulator's vertex at ({x:g}, {y:g}, {z:g}) m lies outside of this mesh: both "
            "must be the same body in the same place."
        )
    return MarkerMap(
        torch.as_tensor(mesh.cells[place.cells])[None], torch.as_tensor(place.weights)[None]
    )


def simulate(context: StageContext) -> None:
    """Writes dataset.h5: positions and velocities (R, T + 1, N, 3) of all trials,
    starting from the held state.
    """
    settings: StageSettings = context.settings
    trials, data = settings.trials, settings.data
    frames, names = data.steps + 1, tuple(trial.name for trial in trials)
    times = settings.time_step * np.arange(frames, dtype=np.float64)
    points = whole_mesh(settings).vertices
    base, obstacles = true_motions(data, trials, times)
    for poses in () if base is None else base:
        check_steps(poses, points, "data.base_motion")
    for name, moved in obstacles.items():
        check_steps(moved[0], points, f"data.obstacle_motion.{name}", f"the obstacle {name!r}")
    parts = context.parts()
    part = TrialPart("part_000", names, frames, partial(_free_motion, settings, names))
    parts.run([part])
    observed = parts.read(part, "observed")
    Trials(
        names,
        labels=(),
        begins=(GIVEN,) * len(names),
        times=np.tile(times, (len(names), 1)),
        observed=observed,
        held=observed[:, 0],
        payload=np.zeros(len(names)),
        gravity=np.asarray(settings.gravity, dtype=np.float64),
        time_step=settings.time_step,
        velocity=parts.read(part, "velocity"),
        base=base,
        obstacles=obstacles,
    ).write(context.run_dir / DATASET)
    parts.remove()


def true_motions(
    data: SimulatedData | ReadingSettings, trials: Sequence[Trial], times: NDArray[Any]
) -> tuple[FloatArray | None, dict[str, FloatArray]]:
    """Returns the true motions of the base and of obstacles in the frame of the body.

    Args:
        data: motions of trials without their own.
        trials: R trials.
        times: (T,) times [s].

    Returns:
        (R, T, 6) of the base, None if it stands still in all trials, and of obstacles by name, zero
        in trials in which they stand still.
    """
    common, still = data.base_motion, np.zeros((len(times), 6))
    motions = [
        trial.base_motion or (common if isinstance(common, MotionSettings) else None)
        for trial in trials
    ]
    scales = [trial.amount if isinstance(data, MovingBase) else 1.0 for trial in trials]
    base = [
        still if motion is None else prescribed(motion, times, scale=scale)
        for motion, scale in zip(motions, scales, strict=True)
    ]
    pushed = [
        prescribed_all(data.obstacle_motion, trial.obstacle_motion, times) for trial in trials
    ]
    obstacles = {}
    for name in dict.fromkeys(chain.from_iterable(pushed)):
        obstacles[name] = np.stack([poses.get(name, still) for poses in pushed])
    return np.stack(base) if any(motions) else None, obstacles


def played(
    frames: int,
    simulator: Simulator,
    substeps: int,
    data: SimulatedData | ReadingSettings,
    trials: Sequence[Trial],
    begin: State,
    inputs_at: Callable[[int, float], Inputs] = lambda number, share: Inputs(),
    read: Read | None = None,
) -> Iterator[State]:
    """Yields the states at the frames of bodies that stand in for real ones.

    Args:
        frames: number of frames.
        simulator: of the bodies.
        substeps: steps from frame to frame; none of static poses.
        data: motions of trials without their own.
        trials: trials of the part.
        begin: state of the first frame.
        inputs_at: inputs besides motions, at a share of the time from a frame to the next.
        read: returns readings (B, S, 6) of force sensors after a step, which states have in their
            memory (`LOADS`).
    """
    times = simulator.time_step * np.arange((frames - 1) * substeps + 1)
    base, obstacles = true_motions(data, trials, times)
    # Inputs at the times, by name.
    constants, moving = simulator.prepare(), dict[str, torch.Tensor]()
    if obstacles:
        moved = contact_inputs(
            simulator.body, {name: poses.swapaxes(0, 1) for name, poses in obstacles.items()}
        )
        moving |= {name: simulator.tensor(values) for name, values in moved.items()}
    if base is not None:
        fixed = np.asarray(
            simulator.body.mesh.vertices[simulator.body.fixed_vertices], dtype=np.float64
        )
        at_times = rigid(base.swapaxes(0, 1).reshape(-1, 6)).apply(fixed)
        moving["fixed_positions"] = simulator.tensor(at_times).unflatten(0, (len(times), -1))

    def step(state: State, number: int) -> State:
        frame, i = divmod(number, substeps)
        # Inputs are taken at the end of a step, or in its middle.
        share = (i + 1 - 0.5 * (simulator.integrator == "midpoint")) / substeps
        now = inputs_at(frame, share).replace(
            **{name: values[number + 1] for name, values in moving.items()}
        )
        new = simulator.step(state, now, constants)
        return (
            new
            if read is None
            else new.with_memory({"loads": read(new, state, now, constants)}, LOADS)
        )

    if substeps:
        yield from islice(states(step, begin, range((frames - 1) * substeps)), 0, None, substeps)
    else:
        yield from repeat(begin, frames)


def _free_motion(settings: StageSettings, names: Sequence[str], report: Report) -> Arrays:
    """Positions and velocities of all vertices of released bodies,
    or of bodies with a moving base.
    """
    target = build_target(settings, settings.target)
    seen = list[tuple[torch.Tensor, torch.Tensor]]()
    trials = [trial for trial in settings.trials if trial.name in names]
    begin = initial_state(target.simulator, settings.data, trials)
    for state in played(
        settings.data.steps + 1, target.simulator, target.substeps, settings.data, trials, begin
    ):
        seen.append((target.seen(state.q), target.seen(state.v)))
        report()
    observed, velocity = (
        torch.stack(values, 1).cpu().numpy() for values in zip(*seen, strict=True)
    )
    return {"observed": (observed, "m"), "velocity": (velocity, "m/s")}


def initial_state(simulator: Simulator, data: SimulatedData, trials: Sequence[Trial]) -> State:
    """Initial states of trials, by ``data.kind``, or as loads of their own hold them.

    Raises:
        InputError: a weight hangs on fixed vertices only.
    """
    amounts = np.array([trial.amount for trial in trials])
    q = simulator.rest_state(len(trials)).q.clone()
    if isinstance(data, MovingBase):
        q = simulator.static_equilibrium(Inputs(), batch=len(trials)).q
    elif isinstance(data, ReleaseFromTwist):
        q = twisted(
            simulator.rest_positions, simulator.tensor(amounts), "xyz".index(data.twist_axis)
        )
    else:
        forces = weights(simulator, data.load, amounts[:, None] * np.asarray(simulator.gravity))
        twists = {
            row: trial.load[0]
            for row, trial in enumerate(trials)
            if trial.load and trial.load[0].twist_deg
        }
        for row, trial in enumerate(trials):
            if trial.load and row not in twists:
                forces[row] = loads(simulator, trial.load, data.load, "data.others")
        hanging = [row for row in range(len(trials)) if row not in twists]
        if hanging:
            q[hanging] = simulator.static_equilibrium(Inputs(forces[hanging])).q
        for row, load in twists.items():
            q[row] = twist(simulator, load)
    return State(q, torch.zeros_like(q))


def twist(simulator: Simulator, load: HeldSettings) -> torch.Tensor:
    """Positions (1, N, 3) of a twisted body [m]."""
    angle = simulator.tensor([math.radians(load.twist_deg)])
    return twisted(simulator.rest_positions, angle, "xyz".index(load.twist_axis))


def loads(
    simulator: Simulator, held: Sequence[HeldSettings], load: Place, key: str
) -> torch.Tensor:
    """Nodal forces (1, N, 3) of weights that act at the same time [N].

    Args:
        simulator: of the body.
        held: the weights.
        load: vertices that carry weights without a place of their own.
        key: of these weights in the configuration, for errors.

    Raises:
        InputError: all vertices of a place are fixed.
    """
    total = torch.zeros_like(simulator.rest_positions)[None]
    for one in held:
        along = np.asarray(one.direction, dtype=np.float64) / np.linalg.norm(one.direction)
        force = 1e-3 * one.weight_g * float(np.linalg.norm(simulator.gravity)) * along
        total = total + weights(simulator, one.at or load, force[None], key)
    return total


def weights(
    simulator: Simulator, load: Place, forces: FloatArray, key: str = "data.load"
) -> torch.Tensor:
    """Nodal forces (B, N, 3) of total forces (B, 3) in equal shares on the vertices of a place [N].

    Raises:
        InputError: all vertices of the place are fixed.
    """
    face = vertices_at(simulator.body.mesh, load)
    if np.isin(face, simulator.body.fixed_vertices).all():
        raise InputError(
            f"{key} selects fixed vertices only: hang the weights on vertices that can move."
        )
    return distributed(simulator, face, simulator.tensor(forces))


def distributed(simulator: Simulator, vertices: IntArray, forces: torch.Tensor) -> torch.Tensor:
    """(B, N, 3) nodal forces [N] that distribute total forces (B, 3) equally over vertices."""
    nodal = simulator.rest_positions.new_zeros(len(forces), simulator.body.n_vertices, 3)
    nodal[:, torch.as_tensor(vertices, device=nodal.device)] = forces[:, None] / len(vertices)
    return nodal
