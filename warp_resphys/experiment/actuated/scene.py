"""What the stages of an experiment with pressures share: the body, its markers, its motions and its simulators."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from ...data.actuation import remembered
from ...data.markers import Markers
from ...data.trials import Trials
from ...dynamics.frames import VertexFrames
from ...dynamics.inputs import Inputs
from ...dynamics.simulator import Constants, Simulator
from ...io.files import read_json
from ...learning.replay import Replay, Start
from ..binding import bound_markers
from ..build import build_simulator
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
        found = read_imported(self.folder / MOTIONS)
        if len(self.config.get("groups", ())) > 1:
            found = found.and_those_of(read_imported(self.folder / RAISED_MOTIONS))
        return found

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the followed markers."""
        return self._imported.labels

    @cached_property
    def motions(self) -> Trials:
        """All trials, on the simulator's device."""
        return self._imported.motions.to(self.simulator.rest_positions)

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

    def pick(self, names: tuple[str, ...]) -> Trials:
        """Some of the trials."""
        return self.motions.named(names)

    @property
    def learned_steps(self) -> int:
        """Steps of a trial that are learned from."""
        return max(round(self.config["data"]["train_fraction"] * (self.motions.times.shape[1] - 1)), 1)

    def smoothed(self, names: tuple[str, ...]) -> torch.Tensor:
        """(R, K + 1, M, 3) the markers of some trials that forces are to explain [m]."""
        rows = [self.motions.names.index(name) for name in names]
        return self._imported.smoothed[rows].to(self.simulator.rest_positions)

    def replay(self, names: tuple[str, ...]) -> tuple[Replay, Start]:
        """The simulator of some of the trials, and how they begin."""
        replay = Replay(self.simulator, self.markers, self.pick(names))
        return replay, Start.resting(self.simulator.rest_positions.expand(len(names), -1, -1))

    def parameters(self, model: str) -> dict[str, torch.Tensor]:
        """(1,) identified parameters of a model; none for one that is not identified."""
        if model not in IDENTIFIED:
            return {}
        values = read_json(self.folder / IDENTIFICATION)["sysid"]["parameters"]
        return {name: self.simulator.rest_positions.new_tensor([value]) for name, value in values.items()}

    def setting(self, model: str, names: tuple[str, ...]) -> tuple[Constants, Inputs, torch.Tensor]:
        """The constants of a model's simulator, the inputs of some trials, and what networks are told of these.

        Returns:
            The last (K, B, A): the pressures and their exponential means.
        """
        constants, inputs, _ = self.replay(names)[0].setting(self.parameters(model))
        told = remembered(inputs.actuation["pressure"], self.config["actuation"]["memory"], self.simulator.time_step)
        return constants, inputs, told
