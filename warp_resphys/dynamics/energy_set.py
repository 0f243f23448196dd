"""All energies of a simulator: their quantities, their values over a step, and their memory.

An energy knows its own names (``youngs_modulus``). Where a simulator has several of a kind, such as the solids of two
regions, the names in the simulator begin with a prefix (``tip_youngs_modulus``); only this module adds and
removes it.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from ..energies.base import BoundEnergy, EnergySite, Memory, Term
from ..energies.placed import PlacedEnergy
from ..fem.body import Body
from ..io.errors import InputError
from ..stepping.constants import Constants, Mass
from ..stepping.inputs import Inputs
from ..stepping.integrators import Integrator
from ..stepping.quantity import Quantity
from ..stepping.state import ImplicitStage, State


class EnergySet:
    """The energies of a simulator.

    Args:
        energies: the energies, with their points and the prefixes of their names.
        body: the body of the energies.
        rest_positions: (N, 3) [m], on the simulator's device and of its type.
        method: the integrator.
        time_step: h [s].

    Attributes:
        parameters: quantities of the energies by name in the simulator.
        inputs: quantities that act through the energies over time, by name.
        constants: default values of the parameters.
        counts: number of values of an input or parameter, without the environments, by name.
        parts: names of the parts, such as tendons, that a parameter has values for, by the parameter's name.
        memory: quantities that the energies carry from step to step, by name.
    """

    def __init__(
        self,
        placed: Sequence[PlacedEnergy],
        body: Body,
        rest_positions: torch.Tensor,
        method: Integrator,
        time_step: float,
    ) -> None:
        self.placed = tuple(energies)
        self._bound: list[BoundEnergy] = []
        self.parameters: dict[str, Quantity] = {}
        self.inputs: dict[str, Quantity] = {}
        self.constants: dict[str, Any] = {}
        self.counts: dict[str, int] = {}
        self.parts: dict[str, tuple[str, ...]] = {}
        self.memory: dict[str, Memory] = {}
        for placed in energies:
            energy, named = placed.energy, placed.named
            points = placed.all_points or placed.points
            place = EnergySite(placed.body or body, placed.first, points, rest_positions, method, time_step)
            bound = energy.bind(place)
            self._bound.append(bound)
            own = named({q.name: replace(q, name=f"{placed.prefix}{q.name}") for q in energy.parameters})
            acting = named({q.name: replace(q, name=f"{placed.prefix}{q.name}") for q in energy.inputs})
            if twice := {*own, *acting} & {*self.parameters, *self.inputs}:
                raise InputError(f"two energies depend on {min(twice)}: rename one of their bodies or regions.")
            self.parameters |= own
            self.inputs |= acting
            self.constants |= named(energy.constants)
            self.counts |= dict.fromkeys([*own, *acting], energy.count)
            self.parts |= dict.fromkeys(own, energy.names) if energy.names else {}
            self.memory |= named({m.name: replace(m, name=f"{placed.prefix}{m.name}") for m in bound.memory})

    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> tuple[dict[str, torch.Tensor | None], Mass]:
        """Returns the values of the energies' terms that follow from parameters, by name, and the mass."""
        values: dict[str, torch.Tensor | None] = {}
        masses: list[Mass] = []
        for placed, bound in self._pairs:
            own = placed.own(parameters)
            values |= placed.named(bound.prepare(own))
            if (mass := bound.mass(own)) is not None:
                masses.append(mass)
        return values, masses[0] if len(masses) == 1 else Mass.sum(masses)

    @property
    def _pairs(self) -> Iterable[tuple[PlacedEnergy, BoundEnergy]]:
        return zip(self.placed, self._bound, strict=True)

    def acting(self, constants: Constants, inputs: Inputs, batch: int) -> dict[str, torch.Tensor | None]:
        """Returns the values of the energies' terms that follow from parameters and inputs; absent inputs are zero."""
        values = dict(constants.values)
        for name in self.inputs:
            given = inputs.actuation.get(name)
            values[name] = constants.gravity.new_zeros(batch, self.counts[name]) if given is None else given
        return values

    def loads(self, constants: Constants, inputs: Inputs, batch: int, static: bool) -> Iterator[torch.Tensor]:
        """Yields forces (1 or B, N, 3) that do not depend on the positions [N]."""
        for placed, bound in self._pairs:
            load = bound.load(placed.own_inputs(inputs), placed.own_constants(constants), batch, static)
            if load is not None:
                yield load

    def begin_step(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, terms: Sequence[Term]
    ) -> dict[str, torch.Tensor | None]:
        """Returns the values of the energies' terms that depend on the step."""
        values: dict[str, torch.Tensor | None] = {}
        for (placed, bound), term in zip(self._pairs, terms, strict=True):
            values |= placed.named(bound.begin_step(placed.step(state, stage, inputs, constants, term)))
        return values

    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        """Returns the values of the energies' terms that depend on the step, for an equilibrium."""
        return {
            name: value for placed, bound in self._pairs for name, value in placed.named(bound.at_rest(batch)).items()
        }

    def end_step(
        self,
        state: State,
        stage: ImplicitStage,
        inputs: Inputs,
        constants: Constants,
        terms: Sequence[Term],
        x: torch.Tensor,
        q: torch.Tensor,
    ) -> dict[str, torch.Tensor]:
        """Returns the energies' memory after a step with the solution x (B, N, 3) and the new positions q."""
        memory: dict[str, torch.Tensor] = {}
        for (placed, bound), term in zip(self._pairs, terms, strict=True):
            memory |= placed.named(bound.end_step(placed.step(state, stage, inputs, constants, term), x, q))
        return memory

    def check_memory(self, memory: Mapping[str, torch.Tensor], batch: int, like: torch.Tensor) -> None:
        """Checks the memory of a state.

        Raises:
            InputError: an unknown name, another shape or type, or values that are not finite.
        """
        for name, values in memory.items():
            if name not in self.memory:
                expected = ", ".join(self.memory) or "nothing"
                raise InputError(
                    f"Unknown memory {name!r} of the state. The energies of this body remember {expected}; leave it "
                    "out."
                )
            self.memory[name].check(values, batch, like)
