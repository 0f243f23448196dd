"""Stages: trials of a simulation that plays the real body, known in every vertex, or recorded as a laboratory would.

A simulated laboratory is for users without one. Its mesh is finer and its steps smaller than those of the simulator to
correct, its material is another one, fibres may be wound around its chambers. Its body stands a little off level, its
markers sit a little off their nominal places, and cameras see it in their frame, with noise.
"""

import logging
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from typing_extensions import override

from ..data.actuation import InputSequences
from ..data.base_motion import check_steps, in_frame, prescribed, rigid
from ..data.recordings.arrays import write_recording
from ..data.recordings.recording import Recording
from ..data.rigid import RigidTransform
from ..dynamics.simulator import Simulator
from ..io.errors import InputError
from ..io.fan_out import ALONE, Workers
from ..io.files import write_json
from ..io.resumable import Field
from ..io.stages import StageContext
from ..learning.replay import sample
from ..mesh.mesh import select_vertices
from ..mesh.poses import twisted
from ..settings.body import PlaceSettings, SimulatorSettings
from ..settings.stages import LaboratoryStage, PlayedSettings, SimulateStage
from ..settings.trials import BaseMotion, MotionSettings, MovingBase, ReleaseFromTwist, SimulatedData, Trial
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .actuators import driven_parts, driving_quantity
from .build import bound_markers, build_simulator, whole_mesh
from .files import DATASET, GIVEN, STATIC, TRUTH, Dataset, payload_inputs
from .parts import ResumableRollout, TrialPart, read_parts, remove_parts, split_into_parts, work_on

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

_LARGEST_OFFSET = 0.5  # m, of the cameras' frame
_POSE_SECONDS = 0.25  # that a recording of a pose lasts
_AXES = ("x", "y", "z")


def simulate(context: StageContext) -> None:
    """Writes dataset.h5: the positions and velocities (R, T + 1, N, 3) of all trials, the held state first."""
    settings: SimulateStage = context.settings
    trials, motion = settings.trials, settings.data.base_motion
    frames, names = settings.data.steps + 1, tuple(trial.name for trial in trials)
    poses, times = None, settings.time_step * np.arange(frames, dtype=np.float64)
    if motion is not None:
        poses = np.stack([base_of(motion, trial, times, _scaled(settings, trial)) for trial in trials])
        points = whole_mesh(settings).vertices
        for each in poses:
            check_steps(each, points, "data.base_motion")
    parts = split_into_parts(context, names, frames)
    work_on(parts, _Free, ALONE)
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
    ).write(context.run_dir / DATASET)
    remove_parts(context)


def base_of(common: BaseMotion, trial: Trial, times: NDArray[Any], scale: float = 1.0) -> FloatArray:
    """(T, 6) how what a body is fixed to really moves, in the frame of the body.

    Args:
        common: motion of the trials that have none of their own.
        trial: which may have one.
        times: (T,) [s].
        scale: of the whole motion.
    """
    motion = common if trial.base_motion is None and isinstance(common, MotionSettings) else trial.base_motion
    return np.zeros((len(times), 6)) if motion is None else prescribed(motion, times, scale=scale)


def _scaled(settings: SimulateStage, trial: Trial) -> float:
    """By which the motion of the base of a trial is multiplied."""
    return trial.amount if isinstance(settings.data, MovingBase) else 1.0


def _carried(simulator: Simulator, motions: FloatArray) -> list[torch.Tensor]:
    """(B, D, 3) the fixed vertices at each of T times [s], of (T, B, 6) motions of their bases."""
    fixed = np.asarray(simulator.body.mesh.vertices[simulator.body.fixed_vertices], dtype=np.float64)
    size = (motions.shape[1], *fixed.shape)
    return [simulator.tensor(rigid(each).apply(np.broadcast_to(fixed, size))) for each in motions]


class _Free(ResumableRollout):
    """Bodies that are let go and swing on their own, or with what they are fixed to."""

    def __init__(self, part: TrialPart) -> None:
        settings: SimulateStage = part.context.settings
        self._data, self._simulator = settings.data, build_simulator(settings, settings.target)
        self._trials = [trial for trial in settings.trials if trial.name in part.names]
        self._constants, self.like = self._simulator.prepare(), self._simulator.rest_positions
        shape = (len(self._trials), self._simulator.body.n_vertices, 3)
        self.fields = {"observed": Field(shape, "m", batch_axes=1), "velocity": Field(shape, "m/s", batch_axes=1)}
        self.frames = part.frames
        self._fixed: list[torch.Tensor] | None = None
        if (motion := settings.data.base_motion) is not None:
            times = settings.time_step * np.arange(1, part.frames)
            poses = [base_of(motion, trial, times, _scaled(settings, trial)) for trial in self._trials]
            self._fixed = _carried(self._simulator, np.stack(poses, axis=1))

    @override
    def begin(self) -> State:
        return initial_state(self._simulator, self._data, np.array([trial.amount for trial in self._trials]))

    @override
    def step(self, number: int) -> State:
        inputs = Inputs(fixed_positions=None if self._fixed is None else self._fixed[number - 1])
        return self._simulator.step(self.state, inputs, self._constants)[0]

    @override
    def frame_arrays(self, number: int) -> dict[str, ArrayLike]:
        return {"observed": self.state.q.cpu().numpy(), "velocity": self.state.v.cpu().numpy()}


def initial_state(simulator: Simulator, data: SimulatedData, values: NDArray[Any]) -> State:
    """The states from which a batch begins, of (B,) weights [kg], angles [rad] or factors, by ``data.kind``."""
    if isinstance(data, MovingBase):
        return simulator.static_equilibrium(Inputs(), batch=len(values))
    if isinstance(data, ReleaseFromTwist):
        q = twisted(simulator.rest_positions, simulator.tensor(values), _AXES.index(data.twist_axis))
        return State(q, torch.zeros_like(q))
    return held_state(simulator, data.load, values)


def held_state(simulator: Simulator, load: PlaceSettings, weights: NDArray[Any]) -> State:
    """The body at rest under weights (B,) [kg] on a face such as ``{"x": 0.1}`` [m], in equal shares.

    Raises:
        InputError: the face cannot move.
    """
    face = select_vertices(simulator.body.mesh, **load.arguments())
    if np.isin(face, simulator.body.fixed_vertices).all():
        raise InputError("data.load selects fixed vertices only: hang the weights on vertices that can move.")
    log.info("finding the equilibrium under %d weights", len(weights))
    forces = simulator.tensor(weights)[:, None] * simulator.tensor(simulator.gravity)
    return simulator.static_equilibrium(Inputs(_shared(simulator, face, forces)))


def _shared(simulator: Simulator, vertices: NDArray[np.int64], forces: torch.Tensor) -> torch.Tensor:
    """(B, N, 3) forces on all vertices, of (B, 3) in equal shares on some [N]."""
    found = simulator.rest_positions.new_zeros(len(forces), simulator.body.n_vertices, 3)
    found[:, torch.as_tensor(vertices, device=found.device)] = forces[:, None] / len(vertices)
    return found


@dataclass(frozen=True)
class Setup:
    """The body as it stands in the laboratory.

    Attributes:
        gravity: (3,) in the frame of the body [m/s^2].
        rotation: from the frame of the body to that of the recordings.
        translation: (3,) [m].
        tracked: (M, 3) where these markers are on the undeformed body [m].
        reference: (S, 3) where the standing ones are [m].
    """

    gravity: FloatArray
    rotation: Rotation
    translation: FloatArray
    tracked: FloatArray
    reference: FloatArray

    @property
    def frame(self) -> RigidTransform:
        """From the frame of the body to that of the recordings."""
        return RigidTransform(self.rotation.as_matrix(), self.translation)

    def recorded(self, positions: FloatArray, base: FloatArray) -> FloatArray:
        """(T, M + S, 3) all markers as the cameras have them [m].

        Args:
            positions: (T, M, 3) the tracked ones in the frame of the body [m].
            base: (T, 6) how the others have moved.
        """
        standing = rigid(base).apply(np.broadcast_to(self.reference, (len(positions), *self.reference.shape)))
        return self.frame.apply(np.concatenate([positions, standing], axis=1))


def run_laboratory(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes the recording of every trial, and truth.json, but for trials at scaled inputs.

    Args:
        context: of the stage.
        workers: that share the trials.

    Raises:
        InputError: a configured value that does not fit.
        ConvergenceError, WorkerError: a step of the simulation fails.
    """
    settings: LaboratoryStage = context.settings
    trials, parts = settings.trials, list[TrialPart]()
    for begins in dict.fromkeys(trial.begins for trial in trials):
        names = [trial.name for trial in trials if trial.begins == begins]
        parts += split_into_parts(context, names, _frames_of(settings, begins), begins, batch=settings.batch)
    work_on(parts, _Played, workers)
    setup = make_setup(settings)
    written = {name: row for part in parts for name, row in zip(part.names, part.read("markers"), strict=True)}
    noise = [_record(context, setup, trial, written[trial.name]) for trial in trials]
    if all(trial.scale == 1.0 for trial in trials):
        write_json(context.run_dir / TRUTH, _truth(settings, setup, trials, float(np.mean(noise))))
    remove_parts(context)


def _record(context: StageContext, setup: Setup, trial: Trial, series: FloatArray) -> float:
    """Writes the recording of a trial; returns the mean distance that the noise moves its tracked markers [m]."""
    settings: LaboratoryStage = context.settings
    laboratory, common = settings.laboratory, settings.data.base_motion
    draw = _draw_of(settings, trial)
    released = _released_at(settings, trial, draw)
    rate = _rate_of(settings) if trial.is_released else 1.0 / settings.time_step
    since = np.arange(len(series)) / rate
    if released is not None:
        assert laboratory.held_seconds is not None
        assert laboratory.seconds is not None
        times = np.arange(int((laboratory.held_seconds + laboratory.seconds) * rate) + 1) / rate
        since = np.maximum(times - released, 0.0)
        read = sample(torch.from_numpy(series)[None], torch.from_numpy(since)[None], laboratory.time_step)
        series = read[0].numpy()
    poses = base_of(common, trial, since)
    positions = setup.recorded(series, poses)
    noise = laboratory.noise * draw.standard_normal(positions.shape)
    actuation = None if trial.sequence is None else _inputs_of(settings, trial)
    if actuation is not None and len(actuation) != len(positions):
        actuation = np.repeat(actuation[-1:], len(positions), axis=0)
    rest = None if trial.pull is None else setup.recorded(setup.tracked[None], np.zeros((1, 6)))[0]
    base = in_frame(poses, setup.frame) if common == "recorded" else None
    path = context.run_dir / trial.recording
    labels = (*settings.binding.tracked, *settings.binding.reference)
    recording = Recording(labels, positions + noise, rate, path, actuation=actuation, rest=rest, base=base)
    write_recording(path, recording, {"payload_kg": trial.payload})
    return float(np.linalg.norm(noise[:, : series.shape[1]], axis=-1).mean())


def _draw_of(settings: PlayedSettings, trial: Trial) -> np.random.Generator:
    return np.random.default_rng([settings.seed, zlib.crc32(trial.name.encode())])


def _released_at(settings: PlayedSettings, trial: Trial, draw: np.random.Generator) -> float | None:
    """When a held body is let go, between two frames [s]; None for other trials."""
    if trial.begins != "held":
        return None
    assert settings.laboratory.held_seconds is not None
    return float(settings.laboratory.held_seconds + draw.random() / _rate_of(settings))


def _rate_of(settings: PlayedSettings) -> float:
    """Frames a second [Hz]."""
    return settings.laboratory.rate or 1.0 / settings.time_step


def _truth(settings: PlayedSettings, setup: Setup, trials: Sequence[Trial], noise: float) -> dict[str, Any]:
    """What the recordings were made with; ``noise`` in metres."""
    material, fibres = settings.laboratory.material, settings.laboratory.fibres
    wound = {} if fibres is None else {"fibre_stiffness": fibres.stiffness}
    released = {trial.name: _released_at(settings, trial, _draw_of(settings, trial)) for trial in trials}
    return {
        "material": {"model": material.model, **material.parameters, **wound},
        "fibre_angles": [] if fibres is None else fibres.angles,
        "gravity": setup.gravity,
        "rotation": setup.rotation.as_matrix(),
        "translation": setup.translation,
        "bound": dict(zip(settings.binding.tracked, setup.tracked, strict=True)),
        "noise_mm": 1e3 * noise,
        "released_s": {name: at for name, at in released.items() if at is not None},
    }


def make_setup(settings: PlayedSettings) -> Setup:
    """Draws how the body stands, and where its markers are, from the seed.

    The frame of the recordings keeps its vertical in ``data.up``, as that of levelled cameras; the body leans by
    ``laboratory.tilt``. Where ``data.up`` is null, the body stands level and the frame is any.
    """
    laboratory, binding = settings.laboratory, settings.binding
    draw = np.random.default_rng([settings.seed, 0])
    gravity = np.asarray(settings.gravity, dtype=np.float64)
    up = vertical(settings.data.up)
    rotation = Rotation.random(random_state=draw)
    heading, turn = draw.uniform(0.0, 2.0 * np.pi, 2)
    strength = float(np.linalg.norm(gravity))
    if up is not None and strength > 0.0:
        across = np.linalg.svd(gravity[None])[2][1:]  # two unit vectors
        axis = np.cos(heading) * across[0] + np.sin(heading) * across[1]
        gravity = Rotation.from_rotvec(np.radians(laboratory.tilt) * axis).apply(gravity)
        upright, _ = Rotation.align_vectors(up[None], -gravity[None] / strength)
        rotation = Rotation.from_rotvec(turn * up) * upright
    translation = draw.uniform(-_LARGEST_OFFSET, _LARGEST_OFFSET, 3)
    nominal = np.array([*binding.tracked.values(), *binding.reference.values()], dtype=np.float64)
    places = nominal + laboratory.placement_noise * draw.standard_normal(nominal.shape)
    count = len(binding.tracked)
    return Setup(gravity, rotation, translation, places[:count], places[count:])


def laboratory_settings(settings: PlayedSettings) -> SimulatorSettings:
    """Settings of the simulator that plays the real body: with masses and volumes as they should be."""
    played = settings.laboratory
    own = {"mesh": played.mesh, "time_step": played.time_step, "integrator": played.integrator, "fibres": played.fibres}
    return SimulatorSettings.of(settings, **own)


def laboratory_simulator(settings: PlayedSettings, gravity: FloatArray) -> Simulator:
    """The simulator that plays the real body, under a gravity [m/s^2] in its frame."""
    made_of = laboratory_settings(settings).model_copy(update={"gravity": tuple(gravity.tolist())})
    return build_simulator(made_of, settings.laboratory.material, payload_at=settings.payload_at)


def input_sequences(settings: PlayedSettings) -> InputSequences:
    """The distribution of the laboratory's inputs."""
    assert settings.data.input_limit is not None
    return InputSequences(limit=settings.data.input_limit, **dict(settings.laboratory.sequences))


def _inputs_of(settings: PlayedSettings, trial: Trial) -> FloatArray:
    """(K + 1, C) the inputs of a trial at the frames, drawn from the seed and the number of its sequence."""
    draw = np.random.default_rng([settings.seed, 1, trial.sequence or 0])
    assert settings.data.steps is not None
    drawn = input_sequences(settings).draw(settings.data.steps, settings.time_step, driven_parts(settings), draw)
    if trial.is_released:
        drawn = np.zeros_like(drawn)
    elif trial.begins == STATIC:
        drawn = np.broadcast_to(drawn.mean(axis=0), drawn.shape)
    return trial.scale * drawn


def _frames_of(settings: PlayedSettings, begins: str) -> int:
    """Frames, or steps of released bodies, that trials are simulated for; see `settings.trials.Begins`."""
    if begins == STATIC:
        return max(int(_POSE_SECONDS * _rate_of(settings)), 5)
    if begins == "rest":
        assert settings.data.steps is not None
        return settings.data.steps + 1
    laboratory = settings.laboratory
    assert laboratory.seconds is not None
    return max(int(laboratory.seconds / laboratory.time_step) + 1, 2) + 1


class _Played(ResumableRollout):
    """Bodies of the laboratory: released from where they are held, driven by their inputs, or in a pose.

    Released bodies are simulated step by step from time zero on; driven ones are kept at the frames, with as
    many smaller steps between these as fit. What is kept are the tracked markers, in the frame of the body.
    """

    def __init__(self, part: TrialPart) -> None:
        settings: LaboratoryStage = part.context.settings
        setup, binding = make_setup(settings), settings.binding
        simulator = self._simulator = laboratory_simulator(settings, setup.gravity)
        self._constants, self.like = simulator.prepare(), simulator.rest_positions
        known = {trial.name: trial for trial in settings.trials}
        self._trials = [known[name] for name in part.names]
        self._tip, self._substeps = settings.tip, 1 if self._trials[0].is_released else substeps_of(settings)
        found = bound_markers(binding, simulator.body.mesh, setup.tracked, tuple(binding.tracked))
        self._read = found.to(self.like)
        payload = np.array([trial.payload for trial in self._trials])
        hung = payload_inputs(simulator.body, settings.payload_at, payload)
        self._payload = Inputs(**{key: simulator.tensor(each) for key, each in hung.items()} if payload.any() else {})
        self._driven: torch.Tensor | None = None
        quantity = driving_quantity(settings)
        if self._trials[0].sequence is not None and quantity is not None:
            self._driven = simulator.tensor(np.stack([_inputs_of(settings, each) for each in self._trials]))
            self._name = quantity.name
        self.fields = {"markers": Field((len(self._trials), len(setup.tracked), 3), "m", batch_axes=1)}
        self.frames = part.frames
        self._fixed: list[torch.Tensor] | None = None
        common = settings.data.base_motion
        if common is not None or any(trial.base_motion is not None for trial in self._trials):
            times = simulator.time_step * np.arange(1, (part.frames - 1) * self._substeps + 1)
            poses = [base_of(common, trial, times) for trial in self._trials]
            self._fixed = _carried(simulator, np.stack(poses, axis=1))

    def _inputs(self, frame: int, share: float = 0.0) -> Inputs:
        """What acts between a frame and the next; inputs change linearly, those of released bodies not at all."""
        if self._driven is None:
            return self._payload
        before, after = self._driven[:, frame], self._driven[:, frame + (share > 0.0)]
        return self._payload.replace(**{self._name: torch.lerp(before, after, share)})

    @override
    def begin(self) -> State:
        """Undeformed, or pulled aside at the tip, where bodies are held; else in equilibrium with what acts."""
        simulator, batch = self._simulator, len(self._trials)
        if not self._trials[0].is_released:
            return simulator.static_equilibrium(self._inputs(0), self._constants, batch=batch)
        pulls = np.array([trial.pull or (0.0, 0.0, 0.0) for trial in self._trials])
        if not any(trial.pull for trial in self._trials):
            return simulator.rest_state(batch)
        force = _shared(
            simulator, select_vertices(simulator.body.mesh, **self._tip.arguments()), simulator.tensor(pulls)
        )
        held = simulator.static_equilibrium(self._inputs(0).plus(force), self._constants)
        return State(held.q, torch.zeros_like(held.q))

    @override
    def step(self, number: int) -> State:
        state, begins = self.state, self._trials[0].begins
        if begins == STATIC:
            return state
        for i in range(1, self._substeps + 1):
            # At the end of a smaller step, or in its middle.
            share = (i - 0.5 * (self._simulator.integrator == "midpoint")) / self._substeps
            inputs = self._inputs(number - 1, share) if begins == "rest" else self._inputs(0)
            if self._fixed is not None:
                inputs = inputs.replace(fixed_positions=self._fixed[(number - 1) * self._substeps + i - 1])
            state, _ = self._simulator.step(state, inputs, self._constants)
        return state

    @override
    def frame_arrays(self, number: int) -> dict[str, ArrayLike]:
        return {"markers": self._read(self.state.q).cpu().numpy()}


def substeps_of(settings: PlayedSettings) -> int:
    """Steps of the laboratory's simulation that make one of the simulator.

    Raises:
        InputError: they do not fit.
    """
    ratio = settings.time_step / settings.laboratory.time_step
    if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
        raise InputError(
            f"time_step is {settings.time_step:g} s and laboratory.time_step {settings.laboratory.time_step:g} s: the "
            "first must be a multiple of the second."
        )
    return round(ratio)


def vertical(up: str | Sequence[float] | None) -> FloatArray | None:
    """(3,) unit vector against gravity in the frame of the recordings; None if that is not known.

    Args:
        up: ``x``, ``-x``, ``y`` and so on, or three numbers.
    """
    if up is None:
        return None
    if isinstance(up, str):
        return np.eye(3)[_AXES.index(up.removeprefix("-"))] * (-1.0 if up.startswith("-") else 1.0)
    vector = np.asarray(up, dtype=np.float64)
    return np.asarray(vector / np.linalg.norm(vector))
