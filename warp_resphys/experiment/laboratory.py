"""Stage: recordings of a simulated body that plays the real one, for users without a laboratory.

Its mesh is finer and its steps smaller than those of the simulator to correct, its material is another one, fibres may
be wound around its chambers. It stands a little off level, its markers sit a little off their nominal places, and
cameras see it in their frame, with noise.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typing_extensions import override

from ..data.actuation import PressureSequences
from ..data.markers import Markers
from ..data.recordings.arrays import write_recording
from ..data.recordings.recording import Recording
from ..dynamics.inputs import Inputs
from ..dynamics.integrator import State
from ..dynamics.simulator import Simulator
from ..io.errors import InputError
from ..io.files import write_json
from ..io.processes import Advance
from ..io.resumable import Field
from ..io.stages import StageContext
from ..learning.replay import sample
from ..mesh.mesh import select_vertices
from .build import bound_markers, build_simulator
from .files import STATIC, TRUTH, attached_mass
from .parts import March, Part, pack, read_parts, remove_parts, split_into_parts, unpack, work_on
from .trials import Trial, known_trials, scaled_trials_of, trials_of

FloatArray = NDArray[np.float64]

_LARGEST_OFFSET = 0.5  # m, of the cameras' frame
_POSE_SECONDS = 0.25  # that a recording of a pose lasts
_AXES = ("x", "y", "z")


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

    def recorded(self, positions: FloatArray) -> FloatArray:
        """Positions (..., 3) in the frame of the body, as the cameras have them [m]."""
        seen: FloatArray = positions @ self.rotation.as_matrix().T + self.translation
        return seen


def run_laboratory(context: StageContext, processes: int = 1, scaled: bool = False) -> None:
    """Writes the recording of every trial, and truth.json.

    Args:
        context: of the stage.
        processes: that share the trials.
        scaled: whether the trials are those at other pressures; truth.json is there then.

    Raises:
        InputError: a configured value that does not fit.
        ConvergenceError, WorkerError: a step of the simulation fails.
    """
    settings = context.settings
    trials = scaled_trials_of(settings) if scaled else trials_of(settings)
    parts = []
    for begins in dict.fromkeys(trial.begins for trial in trials):
        names = [trial.name for trial in trials if trial.begins == begins]
        parts += split_into_parts(context, names, settings["batch"], frames_of(settings, begins), begins)
    work_on(parts, play_part, processes)
    setup, written = make_setup(settings), {}
    for part in parts:
        markers = read_parts([part], "markers")
        for name, row in zip(part.names, markers, strict=True):
            written[name] = row
    distances = {trial.name: _record(context, settings, setup, trial, written[trial.name]) for trial in trials}
    if not scaled:
        write_json(context.run_dir / TRUTH, _truth(settings, setup, trials, float(np.mean([*distances.values()]))))
    remove_parts(context)


def _record(
    context: StageContext, settings: Mapping[str, Any], setup: Setup, trial: Trial, series: FloatArray
) -> float:
    """Writes the recording of a trial; returns the mean distance that the noise moves its tracked markers [m]."""
    laboratory = settings["laboratory"]
    labels = (*settings["markers"]["tracked"], *settings["markers"]["reference"])
    draw = _draw_of(settings, trial)
    rate, released = rate_of(settings), released_at(settings, trial, draw)
    moving = series
    if released is not None:
        times = np.arange(int((laboratory["held_seconds"] + laboratory["seconds"]) * rate) + 1) / rate
        at = torch.from_numpy(np.maximum(times - released, 0.0))[None]
        moving = sample(torch.from_numpy(series)[None], at, laboratory["time_step"])[0].numpy()
    standing = np.broadcast_to(setup.reference, (len(moving), *setup.reference.shape))
    positions = setup.recorded(np.concatenate([moving, standing], axis=1))
    noise = laboratory["noise"] * draw.standard_normal(positions.shape)
    actuation = None if trial.sequence is None else pressures_of(settings, trial)
    if actuation is not None and len(actuation) != len(positions):
        actuation = np.repeat(actuation[-1:], len(positions), axis=0)
    rest = None
    if trial.pull is not None:
        rest = setup.recorded(np.concatenate([setup.tracked, setup.reference]))
    path = context.run_dir / trial.recording
    recording = Recording(labels, positions + noise, rate, path, actuation=actuation, rest=rest)
    write_recording(path, recording, {"payload_kg": trial.payload})
    return float(np.linalg.norm(noise[:, : moving.shape[1]], axis=-1).mean())


def _draw_of(settings: Mapping[str, Any], trial: Trial) -> np.random.Generator:
    return np.random.default_rng([settings["seed"], zlib.crc32(trial.name.encode())])


def released_at(settings: Mapping[str, Any], trial: Trial, draw: np.random.Generator) -> float | None:
    """When a held body is let go, between two frames [s]; None for other trials."""
    if trial.begins != "held":
        return None
    return float(settings["laboratory"]["held_seconds"] + draw.random() / rate_of(settings))


def rate_of(settings: Mapping[str, Any]) -> float:
    """Frames a second [Hz]."""
    rate = settings["laboratory"].get("rate")
    return float(rate) if rate is not None else 1.0 / settings["time_step"]


def _truth(settings: Mapping[str, Any], setup: Setup, trials: Sequence[Trial], noise: float) -> dict[str, Any]:
    """What the recordings were made with; ``noise`` in metres."""
    laboratory = settings["laboratory"]
    fibres = laboratory.get("fibres") or {}
    wound = {"fibre_stiffness": fibres["stiffness"]} if "stiffness" in fibres else {}
    released = {trial.name: released_at(settings, trial, _draw_of(settings, trial)) for trial in trials}
    return {
        "material": {**laboratory["material"], **wound},
        "fibre_angles": fibres.get("angles", []),
        "gravity": setup.gravity,
        "rotation": setup.rotation.as_matrix(),
        "translation": setup.translation,
        "bound": dict(zip(settings["markers"]["tracked"], setup.tracked, strict=True)),
        "noise_mm": 1e3 * noise,
        "released_s": {name: at for name, at in released.items() if at is not None},
    }


def make_setup(settings: Mapping[str, Any]) -> Setup:
    """Draws how the body stands, and where its markers are, from the seed.

    The frame of the recordings keeps its vertical in ``data.up``, as that of levelled cameras; the body leans by
    ``laboratory.tilt``. Where ``data.up`` is null, the body stands level and the frame is any.
    """
    laboratory, markers = settings["laboratory"], settings["markers"]
    draw = np.random.default_rng([settings["seed"], 0])
    gravity = np.asarray(settings["gravity"], dtype=np.float64)
    up = vertical(settings["data"].get("up"))
    rotation = Rotation.random(random_state=draw)
    heading, turn = draw.uniform(0.0, 2.0 * np.pi, 2)
    strength = float(np.linalg.norm(gravity))
    if up is not None and strength > 0.0:
        across = np.linalg.svd(gravity[None])[2][1:]  # two unit vectors
        axis = np.cos(heading) * across[0] + np.sin(heading) * across[1]
        gravity = Rotation.from_rotvec(np.radians(laboratory["tilt"]) * axis).apply(gravity)
        upright, _ = Rotation.align_vectors(up[None], -gravity[None] / strength)
        rotation = Rotation.from_rotvec(turn * up) * upright
    translation = draw.uniform(-_LARGEST_OFFSET, _LARGEST_OFFSET, 3)
    nominal = np.array([*markers["tracked"].values(), *markers["reference"].values()], dtype=np.float64)
    places = nominal + laboratory["placement_noise"] * draw.standard_normal(nominal.shape)
    count = len(markers["tracked"])
    return Setup(gravity, rotation, translation, places[:count], places[count:])


def laboratory_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """A whole configuration of the body that plays the real one: with masses and volumes as they should be."""
    laboratory = settings["laboratory"]
    own = {key: laboratory[key] for key in ("mesh", "time_step", "integrator", "material")}
    physics = {"mass": "row_sum", "volume_integration": "centre"}
    return {**settings, **own, "fibres": laboratory.get("fibres"), "physics": physics, "coupling": "implicit"}


def laboratory_simulator(settings: Mapping[str, Any], gravity: FloatArray) -> Simulator:
    """The simulator that plays the real body, under a gravity [m/s^2] in its frame."""
    return build_simulator({**laboratory_settings(settings), "gravity": gravity.tolist()}, "material")


def pressures_of(settings: Mapping[str, Any], trial: Trial) -> FloatArray:
    """(K + 1, C) the pressures of a trial at the frames [Pa], drawn from the seed and the number of its sequence."""
    sequences = PressureSequences(limit=settings["data"]["pressure_limit"], **settings["laboratory"]["sequences"])
    draw = np.random.default_rng([settings["seed"], 1, trial.sequence or 0])
    drawn = sequences.draw(settings["data"]["steps"], settings["time_step"], settings["chambers"]["count"], draw)
    if trial.begins in ("held", "released"):
        drawn = np.zeros_like(drawn)
    elif trial.begins == STATIC:
        drawn = np.broadcast_to(drawn.mean(axis=0), drawn.shape)
    return trial.scale * drawn


def frames_of(settings: Mapping[str, Any], begins: str) -> int:
    """Frames, or steps of released bodies, that trials are simulated for; see `trials.BEGINNINGS`."""
    if begins == STATIC:
        return max(int(_POSE_SECONDS * rate_of(settings)), 5)
    if begins in ("held", "released"):
        laboratory = settings["laboratory"]
        return max(int(laboratory["seconds"] / laboratory["time_step"]) + 1, 2) + 1
    return int(settings["data"]["steps"]) + 1


def play_part(part: Part, advance: Advance) -> None:
    """The tracked markers of some trials, in the frame of the body.

    Raises:
        ConvergenceError: a step fails.
    """
    part.march(_Played(part.context.settings, part.names), advance)


class _Played(March):
    """Bodies of the laboratory: released from where they are held, under pressures, or in a pose.

    Released bodies are simulated step by step from time zero on; bodies under pressures are kept at the frames, with as
    many smaller steps between these as fit.
    """

    def __init__(self, settings: Mapping[str, Any], names: Sequence[str]) -> None:
        setup = make_setup(settings)
        self._simulator = laboratory_simulator(settings, setup.gravity)
        self._settings = settings
        known = {**known_trials(settings), **{trial.name: trial for trial in scaled_trials_of(settings)}}
        self._trials = [known[name] for name in names]
        self._begins = self._trials[0].begins
        simulator, markers = self._simulator, settings["markers"]
        found = bound_markers(markers, simulator.body.mesh, setup.tracked, tuple(markers["tracked"]))
        self._read: Markers = found.to(simulator.rest_positions)
        self._constants = simulator.prepare()
        payload = np.array([trial.payload for trial in self._trials])
        masses = attached_mass(simulator.body, settings["data"].get("payload_at"), payload)
        self._payload = Inputs(attached_mass=simulator.tensor(masses)) if payload.any() else Inputs()
        self._pressures: torch.Tensor | None = None
        if self._trials[0].sequence is not None:
            self._pressures = simulator.tensor(np.stack([pressures_of(settings, each) for each in self._trials]))
        self._state: State | None = None
        count = len(markers["tracked"])
        self.fields = {"markers": Field((len(self._trials), count, 3), "m", batch_axes=1)}
        self.frames = frames_of(settings, self._begins)

    @override
    @torch.no_grad()
    def frame(self, number: int) -> tuple[dict[str, Any], dict[str, object]]:
        if number == 0:
            self._state = self._begin()
        elif self._begins in ("held", "released"):
            self._step(self._payload if self._pressures is None else self._acting(self._pressures[:, 0]))
        elif self._begins != STATIC:
            self._between(number)
        assert self._state is not None
        return {"markers": self._read(self._state.q).cpu().numpy()}, {}

    def _begin(self) -> State:
        """Undeformed, or pulled aside, where bodies are held; else in equilibrium with what acts at first."""
        simulator, pulls = self._simulator, [trial.pull for trial in self._trials]
        at_rest = self._acting(None if self._pressures is None else self._pressures[:, 0])
        if self._begins in ("held", "released"):
            if not any(pulls):
                return simulator.rest_state(len(self._trials))
            held = simulator.static_equilibrium(at_rest.plus(self._pulling(pulls)), self._constants)
            return State(held.q, torch.zeros_like(held.q))
        return simulator.static_equilibrium(at_rest, self._constants, batch=len(self._trials))

    def _pulling(self, pulls: Sequence[tuple[float, ...] | None]) -> torch.Tensor:
        """(B, N, 3) forces that hold bodies aside, in equal shares at the tip [N]."""
        simulator = self._simulator
        tip = select_vertices(simulator.body.mesh, **self._settings["tip"])
        force = simulator.rest_positions.new_zeros(len(pulls), simulator.body.n_vertices, 3)
        each = simulator.tensor(np.array([(0.0, 0.0, 0.0) if pull is None else pull for pull in pulls]))
        force[:, torch.as_tensor(tip, device=force.device)] = each[:, None] / len(tip)
        return force

    def _acting(self, pressure: torch.Tensor | None) -> Inputs:
        return self._payload if pressure is None else self._payload.replace(pressure=pressure)

    def _between(self, number: int) -> None:
        """The smaller steps from one frame to the next, under pressures that change linearly."""
        if self._pressures is None:
            for _ in range(substeps_of(self._settings)):
                self._step(self._payload)
            return
        before, after = self._pressures[:, number - 1], self._pressures[:, number]
        substeps = substeps_of(self._settings)
        for i in range(1, substeps + 1):
            # At the end of a smaller step, or in its middle.
            share = (i - 0.5) / substeps if self._simulator.integrator == "midpoint" else i / substeps
            self._step(self._acting(torch.lerp(before, after, share)))

    def _step(self, inputs: Inputs) -> None:
        assert self._state is not None
        self._state, _ = self._simulator.step(self._state, inputs, self._constants)

    @override
    def snapshot(self) -> dict[str, torch.Tensor]:
        assert self._state is not None
        return pack(self._state)

    @override
    def restore(self, tensors: Mapping[str, torch.Tensor]) -> None:
        self._state = unpack(tensors, self._simulator.rest_positions)


def substeps_of(settings: Mapping[str, Any]) -> int:
    """Steps of the laboratory's simulation that make one of the simulator.

    Raises:
        InputError: they do not fit.
    """
    ratio = settings["time_step"] / settings["laboratory"]["time_step"]
    if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
        raise InputError(
            f"time_step is {settings['time_step']:g} s and laboratory.time_step "
            f"{settings['laboratory']['time_step']:g} s: the first must be a multiple of the second."
        )
    return round(ratio)


def vertical(up: str | Sequence[float] | None) -> FloatArray | None:
    """(3,) unit vector against gravity in the frame of the recordings; None if that is not known.

    Args:
        up: ``x``, ``-x``, ``y`` and so on, or three numbers.

    Raises:
        InputError: anything else, or a vector of no length.
    """
    if up is None:
        return None
    if isinstance(up, str):
        axis = up.removeprefix("-").removeprefix("+")
        if axis in _AXES:
            return np.eye(3)[_AXES.index(axis)] * (-1.0 if up.startswith("-") else 1.0)
    elif len(up) == 3:
        vector = np.asarray(up, dtype=np.float64)
        if np.isfinite(vector).all() and vector.any():
            return np.asarray(vector / np.linalg.norm(vector))
    raise InputError(f"data.up is {up!r}: give x, -x, y, -y, z, -z, three numbers, or null.")
