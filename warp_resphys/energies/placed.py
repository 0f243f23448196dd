"""An energy in a simulator: its points there, and what its names begin with."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import torch

from ..fem.body import Body
from ..fem.elements import Points
from ..stepping.constants import Constants
from ..stepping.inputs import Inputs
from ..stepping.state import ImplicitStage, State
from .base import Energy, Step, Term

T = TypeVar("T")


@dataclass(frozen=True)
class Placed:
    """An energy, its points in the simulator, and the prefix of its names there, such as ``tip_``."""

    energy: Energy
    points: tuple[Points, ...]  # whose operators act on control vertices, see `fem.coordinates`
    prefix: str = ""
    # the same with operators on all vertices, where the two differ
    own_points: tuple[Points, ...] | None = None

    @classmethod
    def on(cls, body: Body, energy: Energy, points: tuple[Points, ...], prefix: str = "") -> "Placed":
        """Places an energy on a body, given its points there."""
        return cls(energy, tuple(map(body.coordinates.compose, points)), prefix, points)

    def named(self, values: Mapping[str, T]) -> dict[str, T]:
        """Returns values by the energy's names under their names in the simulator."""
        return {f"{self.prefix}{name}": value for name, value in values.items()}

    def own(self, values: Mapping[str, T]) -> Mapping[str, T]:
        """Returns values by name in the simulator under the energy's names; those of others have no such name."""
        if not self.prefix:
            return values
        return {name.removeprefix(self.prefix): x for name, x in values.items() if name.startswith(self.prefix)}

    def own_constants(self, constants: Constants) -> Constants:
        """Returns the constants with the values under the energy's names."""
        return replace(constants, values=self.own(constants.values)) if self.prefix else constants

    def own_inputs(self, inputs: Inputs) -> Inputs:
        """Returns the inputs of the energy under its names."""
        return Inputs(**self.own(inputs.actuation)) if self.prefix else inputs

    def step(self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, term: Term) -> Step:
        """Returns a step as the energy sees it."""
        seen = replace(state, memory=self.own(state.memory)) if self.prefix else state
        return Step(seen, stage, self.own_inputs(inputs), self.own_constants(constants), term)

    def own_values(self, values: Mapping[str, torch.Tensor | None], term: Term) -> dict[str, torch.Tensor | None]:
        """Returns the values that the energy's term has, under the energy's names."""
        return {name: values[f"{self.prefix}{name}"] for name in term.shapes}
