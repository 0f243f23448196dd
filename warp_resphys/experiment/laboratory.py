"""Stage: simulated laboratory, which records trials of a simulation
that takes the place of the real body.

The laboratory is for users without one. Its simulation is a target (`experiment.simulate`): mesh,
time step, material and actuators may differ from those of the simulator to be corrected. Its body
is slightly tilted, its markers deviate slightly from their nominal places, and cameras see the
markers in their own frame, with noise.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ..core.dynamics.simulator import Simulator
from ..core.mesh.selection import vertices_at
from ..core.stepping.inputs import Inputs
from ..core.stepping.rollout import sample
from ..core.stepping.state import State
from ..data.base_motion import in_frame, rigid
from ..data.force_sensors import AXES
from ..data.input_response import draw_inputs, wave_inputs
from ..data.recordings.recording import ARM, Recording
from ..data.recordings.recording_files import write_recording
from ..data.registration import RigidTransform, unit_vector
from ..data.rigid_bodies import as_markers, corners_of, with_axes
from ..data.trials import RESTING, STATIC, UNDER_INPUTS, payload_inputs
from ..io.arrays import FloatArray
from ..io.errors import InputError, number_of
from ..io.fan_out import ALONE, Workers
from ..io.parts import Arrays, Report, TrialPart, cut
from ..io.resuming import StageContext
from ..io.safe_files import write_json
from ..learning.sensing import readings
from ..settings.performed import Trial
from ..settings.played import LaboratorySettings
from ..settings.run import RunSettings
from ..settings.stage_keys import PLAYED, StageSettings
from .actuators import driven_parts, driving_quantity
from .build import bound_markers, build_body, build_simulator, force_sensor, nominal_places
from .files import TRUTH
from .simulate import LOADS, distributed, played, substeps_of, target_settings, true_motions

_LARGEST_OFFSET = 0.5  # m, of the origin of the cameras' frame
_LARGEST_MOUNTING = 0.02  # m, of each coordinate of a rigid body from the centre of what carries it
_POSE_SECONDS = 0.25  # duration of the recording of a static pose
_FURTHEST_ZERO = 3.0  # standard deviations, of recorded inputs


@dataclass(frozen=True)
class Setup:
    """Pose of the body in the laboratory, and places of its markers.

    Attributes:
        gravity: (3,) gravity in the frame of the body [m/s^2].
        frame: transform from the frame of the body to the frame of the recordings.
        tracked: (M, 3) places of the observed points on the undeformed body [m].
        reference: (S, 3) places of the reference markers [m].
    """

    gravity: FloatArray
    frame: RigidTransform
    tracked: FloatArray
    reference: FloatArray

    def recorded(self, positions: FloatArray, base: FloatArray) -> FloatArray:
        """(T, M + S, 3) all markers in the frame of the recordings [m].

        Args:
            positions: (T, M, 3) observed points in the frame of the body [m].
            base: (T, 6) motion of the base, with which the reference markers move.
        """
        return self.frame.apply(
            np.concatenate([positions, rigid(base).apply(self.reference)], axis=1)
        )


def run_laboratory(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes the recording of every trial, and truth.json unless the inputs are scaled.

    Args:
        context: context of the stage.
        workers: workers that share the trials.

    Raises:
        InputError: a configured value is invalid.
        ConvergenceError, WorkerError: a step of the simulation fails.
    """
    settings: StageSettings = context.settings
    laboratory, trials = settings.laboratory, settings.trials
    cut_up = list[TrialPart]()
    for begins in dict.fromkeys(trial.begins for trial in trials):
        names = [trial.name for trial in trials if trial.begins == begins]
        if begins == STATIC:
            frames = max(int(_POSE_SECONDS * _rate_of(settings)), 5)
        elif begins in RESTING:
            assert settings.data.steps is not None
            frames = settings.data.steps + 1
        else:
            assert laboratory.seconds is not None
            frames = max(int(laboratory.seconds / laboratory.time_step) + 1, 2) + 1
        for first, some in cut(names, settings.batch):
            cut_up.append(
                TrialPart(
                    f"{begins}_{first:03d}", some, frames, partial(_played, settings, some, frames)
                )
            )
    parts = context.parts(workers)
    parts.run(cut_up)
    setup = make_setup(settings)
    seen = dict[str, tuple[FloatArray, FloatArray]]()
    for part in cut_up:
        markers, loads = parts.read(part, "markers"), parts.read(part, "loads")
        seen |= dict(zip(part.names, zip(markers, loads, strict=True), strict=True))
    noise = [_record(context, setup, trial, *seen[trial.name]) for trial in trials]
    if all(trial.scale == 1.0 for trial in trials):
        material = laboratory.material
        fibres, muscles = laboratory.fibres, laboratory.muscles
        wound = {} if fibres is None else {"fibre_stiffness": fibres.stiffness}
        wound |= {} if muscles is None else {"muscle_stiffness": muscles.stiffness}
        released = {trial.name: _drawn(settings, trial)[1] for trial in trials}
        zeros = {"zeros": {trial.name: _zero_of(settings, trial) for trial in trials}}
        truth = {
            "material": {"model": material.model, **material.parameters, **wound},
            "fibre_angles": [] if fibres is None else fibres.angles,
            "gravity": setup.gravity,
            "rotation": setup.frame.rotation,
            "translation": setup.frame.translation,
            "bound": dict(zip(settings.binding.observed, setup.tracked, strict=True)),
            "noise_mm": 1e3 * float(np.mean(noise)),
            **(zeros if laboratory.zero_noise else {}),
            "released_s": {name: at for name, at in released.items() if at is not None},
        }
        write_json(context.run_dir / TRUTH, truth)
    parts.remove()


def _record(
    context: StageContext, setup: Setup, trial: Trial, series: FloatArray, loads: FloatArray
) -> float:
    """Writes the recording of a trial.

    Returns the mean distance by which noise moves its tracked markers [m].
    """
    settings: StageSettings = context.settings
    laboratory, data = settings.laboratory, settings.data
    draw, released = _drawn(settings, trial)
    rate = _rate_of(settings) if trial.is_released else 1.0 / settings.time_step
    times = np.arange(len(series)) / rate  # s since the release
    if released is not None:
        assert laboratory.held_seconds is not None
        assert laboratory.seconds is not None
        frames = int((laboratory.held_seconds + laboratory.seconds) * rate) + 1
        times = np.maximum(np.arange(frames) / rate - released, 0.0)
        at = torch.from_numpy(times)[None], laboratory.time_step
        series, loads = (sample(torch.from_numpy(x)[None], *at)[0].numpy() for x in (series, loads))
    base, pushing = true_motions(data, [trial], times)
    still = np.zeros((len(times), 6))
    poses = still if base is None else base[0]
    positions = setup.recorded(series, poses)
    noise = laboratory.noise * draw.standard_normal(positions.shape)
    for corners in corners_of(settings.binding.observed).values():
        turns = np.radians(laboratory.orientation_noise) * draw.standard_normal((len(positions), 3))
        spoke = positions[:, corners] - positions[:, corners].mean(axis=1, keepdims=True)
        noise[:, corners] = (
            noise[:, corners][:, :1] + spoke @ Rotation.from_rotvec(-turns).as_matrix() - spoke
        )
    labels = [*settings.binding.observed, *settings.binding.reference]
    for name in [name for name, motion in data.obstacle_motion.items() if motion == "recorded"]:
        way = pushing[name][0] if name in pushing else still
        arms = ["", *(f" +{axis}" for axis in "xyz")][: 4 if way[:, 3:].any() else 1]
        places = (
            np.asarray(laboratory.obstacles[name].position) + ARM * np.eye(4, 3, -1)[: len(arms)]
        )
        seen = setup.frame.apply(rigid(way).apply(places))
        labels += [f"{name}{arm}" for arm in arms]
        positions = np.concatenate([positions, seen], axis=1)
        noise = np.concatenate([noise, laboratory.noise * draw.standard_normal(seen.shape)], axis=1)
    actuation = None
    if trial.is_driven:
        least = getattr(driving_quantity(laboratory), "lower", -np.inf)
        actuation = np.maximum(_inputs_of(settings, trial) + _zero_of(settings, trial), least)
        if len(actuation) != len(positions):
            actuation = np.repeat(actuation[-1:], len(positions), axis=0)
    rest = None if trial.pull is None else setup.recorded(setup.tracked[None], still[:1])[0]
    motion = in_frame(poses, setup.frame) if data.base_motion == "recorded" else None
    path = context.run_dir / trial.recording
    recording = Recording(
        tuple(labels), positions + noise, rate, path, actuation=actuation, rest=rest, base=motion
    )
    recording = replace(recording, loads=_measured(settings, trial, loads, rate))
    lengths = {name: body.length for name, body in settings.binding.rigid_bodies.items()}
    write_recording(path, with_axes(recording, lengths), {"payload_kg": trial.payload})
    moved = as_markers(noise[:, : series.shape[1]], settings.binding.observed)
    return float(np.linalg.norm(moved, axis=-1).mean())


def _measured(
    settings: StageSettings, trial: Trial, loads: FloatArray, rate: float
) -> dict[str, FloatArray]:
    """Readings (T, 6) of force sensors [N, N m] with noise,
    zero and drift, of the axes that they measure.
    """
    draw = np.random.default_rng([settings.seed, 3, zlib.crc32(trial.name.encode())])
    measured = dict[str, FloatArray]()
    times = np.arange(len(loads))[:, None] / rate
    for number, (name, one) in enumerate(settings.sensors.items()):
        sensor = force_sensor(one)
        off = draw.standard_normal(loads[:, number].shape)
        off += sensor.zero * draw.standard_normal(6) + sensor.drift * times * draw.standard_normal(
            6
        )
        seen = [axis in sensor.axes for axis in AXES]
        measured[name] = np.where(
            seen, loads[:, number] + np.where(seen, sensor.deviations, 0.0) * off, np.nan
        )
    return measured


def _drawn(settings: StageSettings, trial: Trial) -> tuple[np.random.Generator, float | None]:
    """Random numbers of a trial, and when its body is released, between two frames [s].

    None if it is not held.
    """
    draw = np.random.default_rng([settings.seed, zlib.crc32(trial.name.encode())])
    if trial.begins != "held":
        return draw, None
    assert settings.laboratory.held_seconds is not None
    return draw, float(settings.laboratory.held_seconds + draw.random() / _rate_of(settings))


def _zero_of(settings: StageSettings, trial: Trial) -> float:
    """Recorded value of a trial's inputs where nothing acts."""
    draw = np.random.default_rng([settings.seed, 2, zlib.crc32(trial.name.encode())])
    return float(
        settings.laboratory.zero_noise
        * np.clip(draw.standard_normal(), -_FURTHEST_ZERO, _FURTHEST_ZERO)
    )


def _rate_of(settings: StageSettings) -> float:
    """Frame rate of the cameras [Hz]."""
    return settings.laboratory.rate or 1.0 / settings.time_step


def make_setup(settings: StageSettings) -> Setup:
    """Draws the pose of the body, the places of its markers
    and the mountings of its rigid bodies from the seed.

    The vertical of the recordings is ``data.up``, as with levelled cameras, and the body is tilted
    by ``laboratory.tilt``. If ``data.up`` is null, the body is not tilted and the frame of the
    recordings is arbitrary.
    """
    laboratory, binding = settings.laboratory, settings.binding
    draw = np.random.default_rng([settings.seed, 0])
    gravity = np.asarray(settings.gravity, dtype=np.float64)
    up = None if settings.data.up is None else unit_vector(settings.data.up)
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
    body = build_body(target_settings(settings, laboratory))
    count, observed = len(binding.tracked), nominal_places(binding, body.mesh)
    nominal = np.array([*observed[:count], *binding.reference.values()], dtype=np.float64)
    places = nominal + laboratory.placement_noise * draw.standard_normal(nominal.shape)
    for corners in corners_of(binding.observed).values():
        mounting, centre = Rotation.random(random_state=draw), observed[corners].mean(axis=0)
        moved = centre + draw.uniform(-_LARGEST_MOUNTING, _LARGEST_MOUNTING, 3)
        observed[corners] = moved + mounting.apply(observed[corners] - centre)
    observed[:count] = places[:count]
    return Setup(
        gravity, RigidTransform(rotation.as_matrix(), translation), observed, places[count:]
    )


def laboratory_simulator(settings: StageSettings, gravity: FloatArray) -> Simulator:
    """Simulator that takes the place of the real body,
    for gravity in the frame of the body [m/s^2].
    """
    simulated = target_settings(settings, settings.laboratory).model_copy(
        update={"gravity": tuple(gravity.tolist())}
    )
    return build_simulator(simulated, settings.laboratory.material)


def check_laboratory(run: RunSettings, trials: Sequence[Trial]) -> None:
    """Checks that the laboratory of a run can record its trials.

    Raises:
        InputError: durations, inputs or time steps that do not fit the trials or the body.
    """
    data, laboratory = run.recorded, run.laboratory
    begins = {trial.begins for trial in trials}
    assert data is not None
    assert laboratory is not None
    for trial in trials:
        if trial.pull is not None and data.rest != "file":
            raise InputError(
                f"laboratory.trials.{trial.name}.pull deforms the body before its release: set "
                "data.rest to file, so that the recordings have the markers "
                "on the undeformed body."
            )
    if data.rest == "file" and any(
        trial.pull is None and trial.begins == "held" for trial in trials
    ):
        raise InputError(
            "data.rest is file, but the simulated bodies are held undeformed: set it to held."
        )
    if begins & {"held", "released"}:
        for key in ("seconds", "held_seconds"):
            if getattr(laboratory, key) is None:
                raise InputError(f"laboratory.{key} is missing: released trials need it.")
        if (laboratory.seconds or 0.0) < (data.seconds or 0.0):
            raise InputError(
                f"laboratory.seconds is {laboratory.seconds}, less than data.seconds "
                f"({data.seconds}): record at least as long as the data are used."
            )
    _check_waves(laboratory, trials)
    if begins & {*RESTING}:
        substeps_of(run.time_step, laboratory, "laboratory")
        if driving_quantity(laboratory) is not None:
            driven = next(trial for trial in trials if trial.begins in RESTING)
            _inputs_of(StageSettings.reading(run, *PLAYED), driven)


def _check_waves(laboratory: LaboratorySettings, trials: Sequence[Trial]) -> None:
    """Refuses waves of bodies without inputs, of trials without motion,
    and of other parts than those of the body.
    """
    quantity = driving_quantity(laboratory)
    for trial in trials:
        if trial.waves is None:
            continue
        key = f"laboratory.trials.{trial.name}.waves"
        if quantity is None or trial.begins not in RESTING:
            why = (
                "the body has no inputs" if quantity is None else f"the trial begins {trial.begins}"
            )
            raise InputError(f"{key} is set, but {why}: leave it out.")
        count, parts = len(trial.waves.phases), driven_parts(laboratory)
        if count != parts:
            wanted = number_of(parts, quantity.per)
            raise InputError(
                f"{key}.phases has {count} values, but the body has {wanted}: give as many phases."
            )
    without = [trial.name for trial in trials if trial.begins in RESTING and not trial.is_driven]
    if without and any(trial.waves is not None for trial in trials):
        raise InputError(
            f"laboratory.trials.{without[0]}.waves is missing, which other trials have: add it."
        )


def _inputs_of(settings: StageSettings, trial: Trial) -> FloatArray:
    """(K + 1, C) inputs of a trial at the frames: its waves,
    or drawn from the seed and the number of its sequence.

    They are small enough that recorded ones stay within the limit of inputs with any zero.
    """
    draw = np.random.default_rng([settings.seed, 1, trial.sequence or 0])
    data, laboratory = settings.data, settings.laboratory
    assert data.steps is not None
    # Whose end finds the body under inputs.
    before = data.steps if trial.begins == UNDER_INPUTS else 0
    steps, parts = before + data.steps, driven_parts(laboratory)
    limit = data.input_limit - _FURTHEST_ZERO * laboratory.zero_noise
    if trial.waves is not None:
        drawn = wave_inputs(trial.waves, limit, steps, settings.time_step)
    else:
        drawn = draw_inputs(laboratory.sequences, limit, steps, settings.time_step, parts, draw)
    drawn = drawn[before:]
    if trial.is_released:
        drawn = np.zeros_like(drawn)
    elif trial.begins == STATIC:
        drawn = np.broadcast_to(drawn.mean(axis=0), drawn.shape)
    return trial.scale * drawn


def _played(settings: StageSettings, names: Sequence[str], frames: int, report: Report) -> Arrays:
    """Tracked markers of bodies in the laboratory in the frame of the body:
    released, driven, or in a static pose.

    At every step of released bodies, from time zero on, and at the frames of driven bodies, whose
    inputs are interpolated linearly.
    """
    setup, binding = make_setup(settings), settings.binding
    simulator = laboratory_simulator(settings, setup.gravity)
    by_name = {trial.name: trial for trial in settings.trials}
    trials = [by_name[name] for name in names]
    begins, released = trials[0].begins, trials[0].is_released
    markers = bound_markers(binding, simulator.body.mesh, setup.tracked, binding.observed).to(
        simulator.rest_positions
    )
    payload = np.array([trial.payload for trial in trials])
    hung = payload_inputs(simulator.body, settings.payload_at, payload) if payload.any() else {}
    weights = Inputs(**{key: simulator.tensor(masses) for key, masses in hung.items()})
    quantity, driven = driving_quantity(settings.laboratory), None
    if all(trial.is_driven for trial in trials) and quantity is not None:
        driven = simulator.tensor(np.stack([_inputs_of(settings, trial) for trial in trials]))

    def inputs_at(number: int, share: float) -> Inputs:
        if driven is None or quantity is None:
            return weights
        number, share = (number, share) if begins in RESTING else (0, 0.0)
        values = torch.lerp(driven[:, number], driven[:, number + (share > 0.0)], share)
        return weights.replace(**{quantity.name: values})

    if not released:
        begin = simulator.static_equilibrium(
            inputs_at(0, 0.0), simulator.prepare(), batch=len(trials)
        )
    elif any(trial.pull for trial in trials):
        pulls = simulator.tensor([trial.pull or (0.0, 0.0, 0.0) for trial in trials])
        force = distributed(simulator, vertices_at(simulator.body.mesh, settings.tip), pulls)
        begin = simulator.static_equilibrium(inputs_at(0, 0.0).plus(force), simulator.prepare())
        begin = State(begin.q, torch.zeros_like(begin.q))
    else:
        begin = simulator.rest_state(len(trials))
    substeps = 1
    if not released:
        substeps = (
            0
            if begins == STATIC
            else substeps_of(settings.time_step, settings.laboratory, "laboratory")
        )
    sensors = [force_sensor(sensor) for sensor in settings.sensors.values()]
    unread = begin.q.new_full((len(trials), len(sensors), 6), torch.nan)
    if not released:
        unread = readings(simulator, sensors, begin, None, inputs_at(0, 0.0), simulator.prepare())
    begin = begin.with_memory({"loads": unread}, LOADS)
    seen = list[torch.Tensor]()
    loads = list[torch.Tensor]()
    read = partial(readings, simulator, sensors) if sensors else None
    for state in played(frames, simulator, substeps, settings.data, trials, begin, inputs_at, read):
        seen.append(markers(state.q))
        loads.append(state.memory_of(LOADS).get("loads", unread))
        report()
    series = {"markers": (seen, "m"), "loads": (loads, "N, N m")}
    return {
        name: (torch.stack(values, 1).cpu().numpy(), unit)
        for name, (values, unit) in series.items()
    }
