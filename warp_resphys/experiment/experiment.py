"""What the stages of an experiment share: the body, its trials, its simulators and its models."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ..data.input_response import InputResponse, told_of
from ..data.marker_view import ViewedMarkers
from ..data.markers import Markers
from ..data.observation import WHOLE_STATE, Observation
from ..data.trials import Trials
from ..dynamics.frames import BaseFrame, VertexFrames, base_movement
from ..dynamics.simulator import Simulator
from ..energies.strings import PAYLOAD
from ..fem.body import Body
from ..io.errors import ConvergenceError
from ..io.files import read_json
from ..learning.placement import PlacedMarkers, Placement
from ..learning.release import estimate_release
from ..learning.replay import Replay, Start
from ..settings.body import MaterialSettings, SimulatorSettings
from ..settings.run import PublishedSettings
from ..settings.stages import EvaluateStage, LearningStage, NetworkStage, TestStage, TimeStage
from ..stepping.state import State
from .build import bound_markers, build_body, build_simulator, marker_view_of
from .files import DATASET, GIVEN, IDENTIFICATION, SCALED_DATASET, STATIC, Dataset, read_dataset

COROTATED: Final = "corotated"
LEARNED: Final = ("simfree", "resphys_uncorrected", "resphys")
# By model: the simulator that it is, or corrects, and the identification whose parameters that has.
MODELS: Final[Mapping[str, tuple[str, str | None]]] = {
    "published": ("published", None),
    "simulation": ("simulation", None),
    "sysid_elastic": ("simulation", "sysid_elastic"),
    "sysid": ("identified", "sysid"),
    "simfree": ("identified", "sysid"),
    "resphys_uncorrected": ("simulation", None),
    "resphys": ("identified", "sysid"),
}
_STANDS_STILL = 1e-9  # m/s, rad/s


@dataclass(frozen=True)
class Experiment:
    """The trials and the simulators of an experiment.

    Attributes:
        settings: of the stage.
        folder: of the split.
        on_failure: whether a step that fails raises, or is counted.
    """

    settings: LearningStage
    folder: Path
    on_failure: str = "raise"

    @cached_property
    def dataset(self) -> Dataset:
        """The trials, and those at scaled inputs where the stage tests them."""
        shared = self.folder / self.settings.shared
        found = read_dataset(shared / DATASET)
        if isinstance(self.settings, TestStage) and len(self.settings.groups) > 1:
            found = found.joined(read_dataset(shared / SCALED_DATASET))
        return found

    @cached_property
    def body(self) -> Body:
        """That is simulated."""
        return build_body(self.settings, self.settings.payload_at)

    @cached_property
    def _simulators(self) -> dict[str, Simulator]:
        return {}

    def simulator(self, kind: str) -> Simulator:
        """A simulator under the gravity of the trials.

        Args:
            kind: ``simulation`` (uncorrected), ``target`` (which made the trials), ``published``, or ``identified``,
                which may step with another integrator, and take shorter steps.
        """
        if kind not in self._simulators:
            body = None if kind == "published" else self.body
            made_of, material = self.settings_of(kind), self.material_of(kind)
            self._simulators[kind] = build_simulator(made_of, material, body, on_failure=self.on_failure)
        return self._simulators[kind]

    def settings_of(self, kind: str) -> SimulatorSettings:
        """What `build_simulator` makes a simulator of; for its kinds see there."""
        settings, identified = self.settings, self.settings.identified
        own: dict[str, Any] = {"gravity": tuple(self.dataset.gravity.tolist())}
        if kind == "published":
            published = self._published
            own |= {"physics": published.physics, "integrator": published.integrator, "payload_string": None}
        elif kind == "identified" and identified is not None and identified.integrator is not None:
            own |= {"integrator": identified.integrator, "time_step": settings.time_step / identified.substeps}
        return SimulatorSettings.of(settings).model_copy(update=own)

    def material_of(self, kind: str) -> MaterialSettings:
        """Material of a simulator; for its kinds see `simulator`."""
        if kind == "published":
            return self._published.simulation
        if kind != "target":
            return self.settings.simulation
        assert isinstance(self.settings, TimeStage)
        assert self.settings.target is not None
        return self.settings.target

    @property
    def _published(self) -> PublishedSettings:
        assert isinstance(self.settings, EvaluateStage)
        assert self.settings.published is not None
        return self.settings.published

    @property
    def like(self) -> torch.Tensor:
        """A tensor on the device and in the type of the simulators."""
        return self.simulator("simulation").rest_positions

    @cached_property
    def observe(self) -> Observation:
        """What recordings show of the body: M markers, or all vertices."""
        if self.dataset.bound is None:
            return WHOLE_STATE
        markers, labels = self.settings.markers, self.dataset.labels
        assert markers is not None
        found = bound_markers(markers, self.body.mesh, self.dataset.bound, labels)
        return ViewedMarkers.of(found, marker_view_of(markers, labels, self.dataset.sets)).to(self.like)

    def observe_by(self, model: str) -> Observation:
        """The same, with the markers where the identification of a model found that they sit."""
        key = MODELS[model][1]
        if key is None or self.settings.identified is None:
            return self.observe
        found = read_json(self.folder / IDENTIFICATION)[key].get("placement")
        if found is None:
            return self.observe
        assert isinstance(self.observe, Markers)
        return PlacedMarkers.of(self.observe, Placement.from_plain(found, self.dataset.labels)).to(self.like)

    def trials(self, names: Sequence[str], simulator: Simulator | None = None) -> Trials:
        """Some of the trials, which begin alike, on the simulators' device, with inputs for a simulator's steps."""
        body, step = (self.body, None) if simulator is None else (simulator.body, simulator.time_step)
        found = self.dataset.trials(names, body, self.settings.payload_at, step)
        return found.to(self.like)

    def base(self, names: Sequence[str], simulator: Simulator) -> BaseFrame | None:
        """The frame of what the body is fixed to in some of the trials; None where that stands still."""
        poses = self.dataset.base_at(names, simulator.time_step)
        return None if poses is None else BaseFrame(poses.to(simulator.rest_positions), simulator.time_step)

    def _base_movement(self, names: Sequence[str], simulator: Simulator) -> torch.Tensor | None:
        """(K, R, A) what networks are told of the base during each step: what differs between trials and times."""
        poses, told = self.dataset.base_at(names, simulator.time_step), self.told_of_base(simulator)
        if poses is None or told is None:
            return None
        moved = base_movement(poses, simulator.time_step, torch.from_numpy(self.dataset.gravity))
        return moved[..., told].to(simulator.rest_positions)

    def told_of_base(self, simulator: Simulator) -> torch.Tensor | None:
        """(15,) bool, which numbers of `base_movement` networks are told; None where the base stands still."""
        everything = self.dataset.base_at(self.dataset.names, simulator.time_step)
        if everything is None:
            return None
        known = base_movement(everything, simulator.time_step, torch.from_numpy(self.dataset.gravity))
        return known.flatten(0, 1).std(0) > _STANDS_STILL

    def alike(self, names: Sequence[str]) -> list[tuple[str, ...]]:
        """Trials in groups that begin alike, and can be simulated as one batch."""
        found: dict[str, list[str]] = {}
        for name in names:
            found.setdefault(self.begins(name), []).append(name)
        return [tuple(some) for some in found.values()]

    def moving(self, names: Sequence[str]) -> tuple[str, ...]:
        """Those of the trials that have a time."""
        return tuple(name for name in names if self.begins(name) != STATIC)

    def begins(self, name: str) -> str:
        """How a trial begins."""
        return self.dataset.begins[self.dataset.names.index(name)]

    def start(self, replay: Replay, model: str = "simulation") -> Start:
        """How trials begin, as the simulator of a model would have it."""
        simulator, trials = replay.simulator, replay.trials
        begins = self.begins(trials.names[0])
        if begins == GIVEN:
            q = trials.observed[:, 0]
            velocity = self.dataset.velocity
            v = torch.zeros_like(q) if velocity is None else q.new_tensor(velocity[self.dataset.rows(trials.names), 0])
            return Start(State(q, v), q.new_zeros(len(q)))
        if begins == "released":
            return estimate_release(simulator, replay.observe, trials, self.settings.release)
        guess = simulator.rest_positions.expand(len(trials.names), -1, -1)
        if begins == STATIC:  # Far from rest, where whoever changes a parameter a little need not begin again.
            with contextlib.suppress(ConvergenceError), torch.no_grad():
                constants, _, resting = replay.setting(self.parameters(model))
                guess = simulator.static_equilibrium(resting, constants).q
        return Start.resting(guess)

    def replay(self, simulator: Simulator, names: Sequence[str], model: str = "simulation") -> Replay:
        """A simulator of some of the trials, which begin alike, seen as a model sees them."""
        return Replay(simulator, self.observe_by(model), self.trials(names, simulator))

    def replays(
        self, simulator: Simulator, names: Sequence[str], model: str = "simulation"
    ) -> list[tuple[Replay, Start]]:
        """A simulator of any of the trials, a replay for those that begin alike, and how they begin."""
        found = [self.replay(simulator, some, model) for some in self.alike(names)]
        return [(each, self.start(each, model)) for each in found]

    def parameters(self, model: str) -> dict[str, torch.Tensor]:
        """(1,) identified parameters of a model's simulator; none for one that is not identified."""
        key = MODELS[model][1]
        if key is None or self.settings.identified is None:
            return {}
        values = read_json(self.folder / IDENTIFICATION)[key]["parameters"]
        return {name: torch.tensor([x]).to(self.like) for name, x in values.items()}

    def model_simulator(self, model: str) -> Simulator:
        """The one that a model is, or corrects."""
        kind = MODELS[model][0]
        return self.simulator("simulation" if kind == "identified" and self.settings.identified is None else kind)

    def conditions(
        self, replay: Replay, parameters: Mapping[str, torch.Tensor], payload: bool = False
    ) -> torch.Tensor | None:
        """What networks are told of trials beside the state; None where nothing acts on them.

        Args:
            replay: of the trials.
            parameters: (1,) that were identified.
            payload: whether they are told of it, whatever is configured (``actuation.sees_payload``).

        Returns:
            (R, 1) the payloads [kg]; or (K, R, A) during each step, these, each input with its exponential means, and
            how the base moves (`base_movement`). Of poses (R, A), whose inputs have lasted.
        """
        _, inputs, resting = replay.setting(parameters)
        assert isinstance(self.settings, NetworkStage)
        actuation, told = self.settings.actuation, list[torch.Tensor]()
        if self.settings.payload_at is not None and (payload or actuation.sees_payload):
            rows = self.dataset.rows(replay.trials.names)
            told.append(replay.trials.times.new_tensor(self.dataset.payload[rows])[:, None])
        constants = actuation.filter_time_constants
        acting = resting if replay.is_static else inputs
        driven = [each for name, each in acting.actuation.items() if name != PAYLOAD.name]
        moving = self._base_movement(replay.trials.names, replay.simulator)
        if replay.is_static:
            told += [each.repeat(1, 1 + len(constants)) for each in driven]
            told += [] if moving is None else [moving[0]]
            return torch.cat(told, -1) if told else None
        response = InputResponse(replay.simulator.time_step, filters=constants)
        series = [told_of(*response.from_rest(each)) for each in driven]
        series += [] if moving is None else [moving]
        if not series:
            return told[0] if told else None
        at = torch.arange(max(map(len, series)))
        series = [each[at.clamp_max(len(each) - 1).to(each.device)] for each in series]
        return torch.cat([*(each.expand(len(at), -1, -1) for each in told), *series], -1)

    def frames(self, simulator: Simulator, kind: str | None = None) -> VertexFrames | None:
        """With which residual forces turn; None where they keep their directions (``force_frame: world``)."""
        if (self.settings.force_frame if kind is None else kind) != COROTATED:
            return None
        return VertexFrames(simulator.body, simulator.time_step, simulator.rest_positions)

    def explained(self, replay: Replay, start: Start) -> torch.Tensor:
        """(R, K + 1, M, 3) what forces are to explain at a simulator's steps [m], NaN where nothing was seen.

        That is the part of each trial that is learned from.
        """
        simulator, trials = replay.simulator, replay.trials
        if self.dataset.smoothed is not None and self.begins(trials.names[0]) == "rest":
            found = simulator.tensor(self.dataset.smoothed[self.dataset.rows(trials.names)])
        elif self.begins(trials.names[0]) in (GIVEN, STATIC):
            found = trials.observed
        else:
            found = start.bound(simulator.tensor(at_steps(trials, simulator.time_step, start.delay)))
        return found[:, : self.learned_steps(found.shape[1] - 1) + 1]

    def learned_steps(self, steps: int) -> int:
        """Steps of a trial that are learned from."""
        return max(round(self.settings.train_fraction * steps), 1)


def at_steps(trials: Trials, step: float, delay: torch.Tensor | None = None) -> NDArray[np.float64]:
    """(R, K + 1, M, 3) markers at the steps of a simulation [m], NaN after a motion's end and in long occlusions.

    Cubic splines through the frames in which a marker was seen, with where it was held at time zero. Steps further than
    a frame and a half from the next sight of a marker count as not seen.

    Args:
        trials: observed.
        step: h [s].
        delay: (R,) by which the bodies were let go later than the time zero of the frames [s]; none if left out.
    """
    since = trials.times if delay is None else (trials.times - delay[:, None]).clamp_min(0.0)
    times, markers, held = (t.cpu().numpy() for t in (since, trials.observed, trials.held))
    steps = step * np.arange(int(times.max() / step + 1e-6) + 1)
    found = np.full((len(times), len(steps), *markers.shape[2:]), np.nan)
    for r, m in np.ndindex(len(times), markers.shape[2]):
        seen = np.isfinite(markers[r, :, m]).all(1)
        t, y = times[r, seen], markers[r, seen, m]
        t, first = np.unique(t, return_index=True)
        y = y[first]
        if np.isfinite(held[r, m]).all() and (not len(t) or t[0] > 1e-9):
            t, y = np.concatenate([[0.0], t]), np.concatenate([held[r, m][None], y])
        if len(t) < 4:
            continue
        nearest = np.abs(steps[:, None] - t).min(1)
        near = (nearest <= 1.5 * np.median(np.diff(t))) & (steps <= t[-1] + 1e-9)
        found[r, near, m] = CubicSpline(t, y)(steps[near])
    return found
