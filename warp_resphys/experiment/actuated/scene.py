"""What the stages of an experiment with pressures share: the body, its markers, its motions and its simulators."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from ...data.actuation import lagged, remembered
from ...data.markers import Markers
from ...dynamics.frames import VertexFrames
from ...dynamics.simulator import MaterialTensors, Simulator
from ...io.files import read_json
from ...learning.driven import DrivenMotions, DrivenReplay, at_rest
from ...learning.driven_rollout import Drive
from ...learning.replay import Release
from ..binding import bound_markers
from ..build import build_mesh, build_simulator
from ..measured.files import IDENTIFICATION
from .files import COROTATED, MOTIONS, RAISED_MOTIONS, Imported, read_imported

# Models whose simulator, or whose states to learn from, have the identified parameters.
IDENTIFIED = ("sysid", "simfree", "resphys")


@dataclass(frozen=True)
class DrivenScene:
    """The imported motions and the simulator of an experiment.

    Attributes:
        config: the settings of the stage.
        folder: of motions.h5.
        on_failure: whether a step that fails raises, or is counted.
    """

    config: Mapping[str, Any]
    folder: Path
    on_failure: str = "raise"

    @cached_property
    def simulator(self) -> Simulator:
        """The simulator to correct, under the gravity of the recordings."""
        settings = {**self.config, "gravity": self._imported.gravity.tolist()}
        return build_simulator(settings, on_failure=self.on_failure)

    @cached_property
    def _imported(self) -> Imported:
        """The motions, and those at higher pressures where the stage tests them."""
        vertices = len(build_mesh(self.config["mesh"]).vertices)
        found = read_imported(self.folder / MOTIONS, vertices)
        if len(self.config.get("groups", ())) > 1:
            found = found.and_those_of(read_imported(self.folder / RAISED_MOTIONS, vertices))
        return found

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the followed markers."""
        return self._imported.labels

    @cached_property
    def motions(self) -> DrivenMotions:
        """All trials, on the simulator's device."""
        found, like = self._imported.motions, self.simulator.rest_positions
        fields = (found.times, found.markers, found.held, found.attached_mass, found.pressure)
        return DrivenMotions(found.names, *(t.to(like) for t in fields))

    @cached_property
    def markers(self) -> Markers:
        """The followed markers on the body."""
        found = bound_markers(self.config["markers"], self.simulator.body.mesh, self._imported.bound, self.labels)
        return found.to(self.simulator.rest_positions)

    def frames(self, kind: str) -> VertexFrames | None:
        """With which residual forces turn; None where they keep their directions (``force_frame: world``)."""
        simulator = self.simulator
        return (
            VertexFrames(simulator.body, simulator.time_step, simulator.rest_positions) if kind == COROTATED else None
        )

    def pick(self, names: tuple[str, ...]) -> DrivenMotions:
        """Some of the trials."""
        return self.motions.select([self.motions.names.index(name) for name in names])

    @property
    def learned_steps(self) -> int:
        """Steps of a trial that are learned from."""
        return max(round(self.config["data"]["train_fraction"] * self.motions.pressure.shape[1]), 1)

    def smoothed(self, names: tuple[str, ...]) -> torch.Tensor:
        """(R, K + 1, M, 3) the markers of some trials that forces are to explain [m]."""
        rows = [self.motions.names.index(name) for name in names]
        return self._imported.smoothed[rows].to(self.simulator.rest_positions)

    def replay(self, names: tuple[str, ...]) -> tuple[DrivenReplay, Release]:
        """The simulator of some of the trials, and how they begin."""
        motions = self.pick(names)
        replay = DrivenReplay(self.simulator, self.markers, motions)
        return replay, at_rest(motions, self.simulator.rest_positions)

    def parameters(self, model: str) -> dict[str, torch.Tensor]:
        """(1,) identified parameters of a model; none for one that is not identified."""
        if model not in IDENTIFIED:
            return {}
        values = read_json(self.folder / IDENTIFICATION)["sysid"]["parameters"]
        return {name: self.simulator.rest_positions.new_tensor([value]) for name, value in values.items()}

    def tensors(self, model: str, names: tuple[str, ...]) -> MaterialTensors:
        """The constants of a model's simulator."""
        replay, _ = self.replay(names)
        return replay.tensors({k: v for k, v in self.parameters(model).items() if k != "pressure_rise"})

    def drive(self, model: str, names: tuple[str, ...]) -> Drive:
        """The pressures of some trials, as a model's simulator has them in its chambers and as its network is told."""
        pressure = self.pick(names).pressure
        rise = self.parameters(model).get("pressure_rise")
        step = self.simulator.time_step
        if rise is not None:
            pressure = lagged(pressure, rise.expand(len(pressure)), step)
        return Drive(pressure, remembered(pressure, self.config["actuation"]["memory"], step))
