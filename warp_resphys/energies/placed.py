"""An energy in a simulator: its points, and the prefix of its names."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch

from ..fem.body import Body
from ..fem.elements import Points
from ..stepping.constants import Constants
from ..stepping.inputs import Inputs
from ..stepping.state import ImplicitStage, State
from .base import Energy, EnergyStep, Term

T = TypeVar("T")


@dataclass(frozen=True)
class PlacedEnergy:
    """An energy, its points in the simulator, and the prefix of its names there, such as ``tip_``."""

    energy: Energy
    points: tuple[Points, ...]  # points with operators on control vertices (`fem.coordinates`)
    prefix: str = ""
    all_points: tuple[Points, ...] | None = None  # points with operators on all vertices; None if they are the same
    body: Body | None = None  # body of the energy
    first: int = 0  # index of that body's first vertex in the simulator

    @classmethod
    def of(
        cls, whole: Body, body: Body, first: int, energy: Energy, points: Sequence[Points], prefix: str = ""
    ) -> "PlacedEnergy":
        """Places an energy of a body in a simulator.

        Args:
            whole: the simulator's body or scene.
            body: the body.
            first: index of its first vertex in the simulator.
            energy: the energy.
            points: points of the energy, with the body's own vertex numbers.
            prefix: prefix of the energy's names.
        """
        shifted = tuple(own.shifted(first) for own in points)
        return cls(energy, tuple(map(whole.coordinates.compose, shifted)), prefix, shifted, body, first)

    @property
    def input_names(self) -> list[str]:
        """Names of the energy's inputs in the simulator."""
        return [f"{self.prefix}{quantity.name}" for quantity in self.energy.inputs]

    def named(self, values: Mapping[str, T]) -> dict[str, T]:
        """Renames values from the energy's names to names in the simulator."""
        return {f"{self.prefix}{name}": value for name, value in values.items()} if self.prefix else dict(values)

    def own(self, values: Mapping[str, T]) -> Mapping[str, T]:
        """Selects the values of the energy, and renames them from names in the simulator to its own names."""
        if not self.prefix:
            return values
        return {name.removeprefix(self.prefix): x for name, x in values.items() if name.startswith(self.prefix)}

    def own_constants(self, constants: Constants) -> Constants:
        """Returns the constants with the energy's names."""
        return replace(constants, values=self.own(constants.values)) if self.prefix else constants

    def own_inputs(self, inputs: Inputs) -> Inputs:
        """Returns the inputs of the energy, with its names."""
        return Inputs(**self.own(inputs.actuation)) if self.prefix else inputs

    def step(self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, term: Term) -> EnergyStep:
        """Returns a step as the energy sees it."""
        own_state = replace(state, memory=self.own(state.memory)) if self.prefix else state
        return EnergyStep(own_state, stage, self.own_inputs(inputs), self.own_constants(constants), term)

    def own_values(self, values: Mapping[str, torch.Tensor | None], term: Term) -> dict[str, torch.Tensor | None]:
        """Returns the values of the energy's term, with the energy's names."""
        return {name: values[f"{self.prefix}{name}"] for name in term.shapes}
