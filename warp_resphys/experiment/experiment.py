"""The `Experiment` that all stages share: the body, its trials, its simulators and its models."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from ..data.input_response import InputResponse, with_means
from ..data.marker_view import ViewedMarkers
from ..data.markers import WHOLE_STATE, Markers, Observation
from ..data.trials import Trials
from ..dynamics.frames import BaseFrame, VertexFrames, base_movement
from ..dynamics.simulator import Simulator
from ..energies.strings import PAYLOAD
from ..fem.body import Body
from ..io.errors import ConvergenceError
from ..io.files import read_json
from ..learning.parameters import split_name
from ..learning.placement import PlacedMarkers, placement_of
from ..learning.release import begin_inputs, estimate_release
from ..learning.replay import Replay, Start, later
from ..settings.body import MaterialSettings, SimulatorSettings
from ..settings.run import models_of
from ..settings.stages import StageSettings
from ..stepping.state import State
from .build import bound_markers, build_body, build_simulator, marker_view_of
from .files import (
    DATASET,
    GIVEN,
    IDENTIFICATION,
    LAW_FILE,
    RESTING,
    SCALED_DATASET,
    STATIC,
    UNDER_INPUTS,
    Dataset,
    read_dataset,
    read_if_there,
)
from .simulate import target_settings

COROTATED: Final = "corotated"
LAW: Final = "law"
LEARNED: Final = ("simfree", "resphys_uncorrected", "resphys")
# By model: the simulator that it uses or corrects, and the identification that provides its parameters.
MODELS: Final[Mapping[str, tuple[str, str | None]]] = {
    "published": ("published", None),
    "simulation": ("simulation", None),
    "sysid_elastic": ("simulation", "sysid_elastic"),
    "sysid": ("identified", "sysid"),
    "law": ("law", "law"),
    "simfree": ("identified", "sysid"),
    "resphys_uncorrected": ("simulation", None),
    "resphys": ("identified", "sysid"),
}
_STANDS_STILL = 1e-9  # m/s, rad/s


@dataclass(frozen=True)
class Experiment:
    """The trials and the simulators of an experiment.

    Attributes:
        settings: settings of the stage.
        folder: folder of the split.
        on_failure: whether a failed step raises an error (``raise``) or is counted (``count``).
    """

    settings: StageSettings
    folder: Path
    on_failure: str = "raise"

    @cached_property
    def dataset(self) -> Dataset:
        """Dataset of the trials, including trials with scaled inputs if the stage tests them."""
        shared = self.folder / self.settings.shared
        dataset = read_dataset(shared / DATASET)
        if len(self.settings.groups) > 1:
            dataset = dataset.joined(read_dataset(shared / SCALED_DATASET))
        return dataset

    @cached_property
    def body(self) -> Body:
        """The simulated body."""
        return build_body(self.settings, self.settings.payload_at)

    @cached_property
    def _simulators(self) -> dict[str, Simulator]:
        return {}

    def simulator(self, kind: str) -> Simulator:
        """Returns a simulator with the gravity of the trials.

        Args:
            kind: ``simulation`` (uncorrected), ``target`` (which generated the trials), ``published``,
                ``identified``, which may use another integrator and a shorter time step, or ``law``, which has an
                identified material as well.
        """
        if kind not in self._simulators:
            body = None if kind in ("published", "target") else self.body
            made_of, material = self.settings_of(kind), self.material_of(kind)
            self._simulators[kind] = build_simulator(made_of, material, body, on_failure=self.on_failure)
        return self._simulators[kind]

    def settings_of(self, kind: str) -> SimulatorSettings:
        """Settings of a simulator of some kind, see `simulator`."""
        settings, identified = self.settings, self.settings.identified
        own: dict[str, Any] = {"gravity": tuple(self.dataset.gravity.tolist())}
        if kind == "published":
            published = settings.published
            assert published is not None
            own |= {"physics": published.physics, "integrator": published.integrator, "payload_string": None}
        elif kind in ("identified", LAW) and identified is not None and identified.integrator is not None:
            own |= {"integrator": identified.integrator, "time_step": settings.time_step / identified.substeps}
        chosen = target_settings(settings, settings.target) if kind == "target" else SimulatorSettings.of(settings)
        return chosen.model_copy(update=own)

    def material_of(self, kind: str) -> MaterialSettings:
        """Material of a simulator of some kind, see `simulator`."""
        if kind == "published":
            assert self.settings.published is not None
            return self.settings.published.simulation
        if kind == LAW:
            law = read_json(self.folder / LAW_FILE)
            return MaterialSettings(model=law["model"], **law["constants"])
        return self.settings.target.material if kind == "target" else self.settings.simulation

    @property
    def like(self) -> torch.Tensor:
        """A tensor with the device and data type of the simulators."""
        return self.simulator("simulation").rest_positions

    @cached_property
    def observe(self) -> Observation:
        """Observation of the body in the recordings: M markers, or all vertices."""
        if self.dataset.bound is None:
            return WHOLE_STATE
        markers, labels = self.settings.markers, self.dataset.labels
        assert markers is not None
        bound = bound_markers(markers, self.body.mesh, self.dataset.bound, labels)
        return ViewedMarkers.of(bound, marker_view_of(markers, labels, self.dataset.sets)).to(self.like)

    def observe_by(self, model: str, session: str = "") -> Observation:
        """Observation with the marker placement that was identified for a model in a session, if any."""
        placement = self.identification(model).get("placement")
        if placement is None:
            return self.observe
        assert isinstance(self.observe, Markers)
        return PlacedMarkers.of(self.observe, placement_of(placement, self.dataset.labels, session)).to(self.like)

    def trials(self, names: Sequence[str], simulator: Simulator | None = None) -> Trials:
        """Trials that begin in the same way, on the device of the simulators, with inputs at the simulator's steps."""
        body, step = (self.body, None) if simulator is None else (simulator.body, simulator.time_step)
        return self.dataset.trials(names, body, self.settings.payload_at, step).to(self.like)

    def base(self, names: Sequence[str], simulator: Simulator) -> BaseFrame | None:
        """Frame of the base to which the body is fixed in trials; None if the base stands still."""
        poses = self.dataset.base_at(names, simulator.time_step)
        return None if poses is None else BaseFrame(poses.to(simulator.rest_positions), simulator.time_step)

    def _base_movement(self, names: Sequence[str], simulator: Simulator) -> torch.Tensor | None:
        """(K, R, A) motion of the base during each step as network inputs; None if the base stands still."""
        poses, mask = self.dataset.base_at(names, simulator.time_step), self.base_movement_mask(simulator)
        if poses is None or mask is None:
            return None
        movement = base_movement(poses, simulator.time_step, torch.from_numpy(self.dataset.gravity))
        return movement[..., mask].to(simulator.rest_positions)

    def base_movement_mask(self, simulator: Simulator) -> torch.Tensor | None:
        """(15,) bool, components of `base_movement` that vary and are network inputs; None if the base stands still."""
        poses = self.dataset.base_at(self.dataset.names, simulator.time_step)
        if poses is None:
            return None
        movement = base_movement(poses, simulator.time_step, torch.from_numpy(self.dataset.gravity))
        return movement.flatten(0, 1).std(0) > _STANDS_STILL

    def batches(self, names: Sequence[str]) -> list[tuple[str, ...]]:
        """Groups trials by how they begin and their session; the trials of a group can be simulated as one batch."""
        groups: dict[tuple[str, str], list[str]] = {}
        for name in names:
            groups.setdefault((self.begins(name), self.dataset.session(name)), []).append(name)
        return [tuple(group) for group in groups.values()]

    def moving(self, names: Sequence[str]) -> tuple[str, ...]:
        """Names of the trials that are motions, not static poses."""
        return tuple(name for name in names if self.begins(name) != STATIC)

    def begins(self, name: str) -> str:
        """Returns the kind of a trial's beginning: given, released, rest or static."""
        return self.dataset.begins[self.dataset.names.index(name)]

    def start(self, replay: Replay, model: str = "simulation", parameters: Mapping[str, float] | None = None) -> Start:
        """Estimates how the trials of a replay begin, with the simulator of a model.

        Args:
            replay: of trials that begin in the same way.
            model: whose identified parameters the simulator has.
            parameters: values of these parameters, if they are not those of the finished identification.
        """
        simulator, trials = replay.simulator, replay.trials
        begins = self.begins(trials.names[0])
        if begins == GIVEN:
            q = trials.observed[:, 0]
            velocity = self.dataset.velocity
            v = torch.zeros_like(q) if velocity is None else q.new_tensor(velocity[self.dataset.rows(trials.names), 0])
            return Start(State(q, v), q.new_zeros(len(q)))
        known = self.parameters(model) if parameters is None else _tensors(parameters, simulator)
        values = {name: value for name, value in known.items() if split_name(name)[0] in replay.parameter_names} or None
        if begins == "released":
            return estimate_release(replay, self.settings.release, values)
        guess = simulator.rest_positions.expand(len(trials.names), -1, -1)
        if begins in (STATIC, UNDER_INPUTS):  # Small changes of a parameter then start close to the solution.
            with contextlib.suppress(ConvergenceError), torch.no_grad():
                constants, _, resting = replay.prepare(values)
                guess = simulator.static_equilibrium(resting, constants).q
        if begins == STATIC:
            return Start.resting(guess)
        return begin_inputs(replay, Start.resting(guess), self.settings.release, values)

    def replay(self, simulator: Simulator, names: Sequence[str], model: str = "simulation") -> Replay:
        """Replay of trials of one of `batches`, with a model's observation."""
        observe = self.observe_by(model, self.dataset.session(names[0]))
        return Replay(simulator, observe, self.trials(names, simulator))

    def replays(
        self, simulator: Simulator, names: Sequence[str], model: str = "simulation"
    ) -> list[tuple[Replay, Start]]:
        """Replays of any trials, one for each way of beginning, each with its start."""
        replays = [self.replay(simulator, batch, model) for batch in self.batches(names)]
        return [(replay, self.start(replay, model)) for replay in replays]

    def identification(self, model: str) -> dict[str, Any]:
        """Returns the identification of a model: parameters, their uncertainty and the placement of markers, if any."""
        key = self.sources(model)[1]
        if key is None or (key != LAW and self.settings.identified is None):
            return {}
        identified = read_if_there(self.folder / IDENTIFICATION)
        if key != LAW:
            return dict(identified[key])
        sysid, parameters = identified.get("sysid", {}), read_json(self.folder / LAW_FILE)["parameters"]
        own = {name: value for name, value in sysid.get("own", {}).items() if split_name(name)[0] in parameters}
        return {"parameters": parameters, "own": own, "placement": sysid.get("placement")}

    def parameters(self, model: str) -> dict[str, torch.Tensor]:
        """(1,) identified parameters of a model's simulator, by name, and those of trials; empty without any."""
        identified = self.identification(model)
        values = {**identified.get("parameters", {}), **identified.get("own", {})}
        return _tensors(values, self.simulator("simulation"))

    @property
    def models(self) -> list[str]:
        """Names of the models that are compared; the law is one of them if it helps on the validation trials."""
        settings = self.settings
        return models_of(settings.published, settings.identified, settings.correct_uncorrected, self.has_law)

    @property
    def has_law(self) -> bool:
        """Whether a law was identified, and helps on the validation trials."""
        return self.settings.with_law and bool(read_if_there(self.folder / LAW_FILE).get("accepted"))

    def sources(self, model: str) -> tuple[str, str | None]:
        """Returns the entry of `MODELS`; a force corrects the law, if there is one."""
        return MODELS[LAW if model == "resphys" and self.has_law else model]

    def model_simulator(self, model: str) -> Simulator:
        """The simulator that a model uses or corrects."""
        kind = self.sources(model)[0]
        return self.simulator("simulation" if kind == "identified" and self.settings.identified is None else kind)

    def conditions(
        self, replay: Replay, parameters: Mapping[str, torch.Tensor], payload: bool = False
    ) -> torch.Tensor | None:
        """Returns the network inputs of trials besides the state; None if there are none.

        Args:
            replay: replay of the trials.
            parameters: (1,) identified parameters.
            payload: whether to include the payload even if ``actuation.sees_payload`` is false.

        Returns:
            (R, 1) payloads [kg] if nothing else acts; otherwise (K, R, A) during each step: payloads, inputs (of
            actuators, and those that move obstacles) with their exponential means, and motion of the base
            (`base_movement`). (R, A) for static poses, under steady inputs.
        """
        _, inputs, resting = replay.prepare(parameters)
        actuation, constant = self.settings.actuation, list[torch.Tensor]()
        if self.settings.payload_at is not None and (payload or actuation.sees_payload):
            rows = self.dataset.rows(replay.trials.names)
            constant.append(replay.trials.times.new_tensor(self.dataset.payload[rows])[:, None])
        filters = actuation.filter_time_constants
        acting = resting if replay.is_static else inputs
        driven = [values for name, values in acting.actuation.items() if name != PAYLOAD.name]
        moving = self._base_movement(replay.trials.names, replay.simulator)
        if replay.is_static:
            constant += [values.repeat(1, 1 + len(filters)) for values in driven]
            constant += [] if moving is None else [moving[0]]
            return torch.cat(constant, -1) if constant else None
        response = InputResponse(replay.simulator.time_step, filters=filters)
        before = [resting.actuation.get(name) for name in acting.actuation if name != PAYLOAD.name]
        series = []
        for values, first in zip(driven, before, strict=True):
            memory = response.steady(0.0 * values[0] if first is None else first)
            series.append(with_means(*response(memory, values)[:2]))
        series += [] if moving is None else [moving]
        if not series:
            return constant[0] if constant else None
        at = torch.arange(max(map(len, series)))
        series = [values[at.clamp_max(len(values) - 1).to(values.device)] for values in series]
        return torch.cat([*(values.expand(len(at), -1, -1) for values in constant), *series], -1)

    def frames(self, simulator: Simulator, kind: str | None = None) -> VertexFrames | None:
        """Corotational frames of the residual forces; None for forces in the world frame (``force_frame: world``)."""
        if (self.settings.force_frame if kind is None else kind) != COROTATED:
            return None
        return VertexFrames(simulator.body, simulator.time_step, simulator.rest_positions)

    def targets(self, replay: Replay, start: Start) -> torch.Tensor:
        """(R, K + 1, M, 3) target positions at a simulator's steps [m], NaN where a marker was not seen.

        Only the part of each trial that is used for training is returned.
        """
        simulator, trials = replay.simulator, replay.trials
        if self.dataset.smoothed is not None and self.begins(trials.names[0]) in RESTING:
            smoothed = simulator.tensor(self.dataset.smoothed[self.dataset.rows(trials.names)])
            targets = later(smoothed, start.delay, simulator.time_step)
        elif self.begins(trials.names[0]) in (GIVEN, STATIC):
            targets = trials.observed
        else:
            targets = start.bound(simulator.tensor(at_steps(trials, simulator.time_step, start.delay)))
        return targets[:, : self.learned_steps(targets.shape[1] - 1) + 1]

    def learned_steps(self, steps: int) -> int:
        """Number of steps of a trial that are used for training."""
        return max(round(self.settings.train_fraction * steps), 1)


def at_steps(trials: Trials, step: float, delay: torch.Tensor | None = None) -> NDArray[np.float64]:
    """(R, K + 1, M, 3) markers at the steps of a simulation [m], NaN after a motion's end and in long occlusions.

    Interpolates with cubic splines through the frames in which a marker was seen, starting from the held position at
    time zero. A marker counts as not seen at steps that are more than 1.5 frames away from its nearest frame.

    Args:
        trials: observed trials.
        step: time step h [s].
        delay: (R,) delay of the release after time zero of the frames [s]; zero by default.
    """
    from scipy.interpolate import CubicSpline

    since = trials.times if delay is None else (trials.times - delay[:, None]).clamp_min(0.0)
    times, markers, held = (t.cpu().numpy() for t in (since, trials.observed, trials.held))
    steps = step * np.arange(int(times.max() / step + 1e-6) + 1)
    positions = np.full((len(times), len(steps), *markers.shape[2:]), np.nan)
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
        positions[r, near, m] = CubicSpline(t, y)(steps[near])
    return positions


def _tensors(values: Mapping[str, float], simulator: Simulator) -> dict[str, torch.Tensor]:
    """(1,) values of parameters."""
    return {name: simulator.tensor([value]) for name, value in values.items()}
