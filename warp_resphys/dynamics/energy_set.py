"""All energies of a simulator as one: quantities, values of a step, and memory.

An energy has its own names (``youngs_modulus``). If a simulator has several energies of a kind, such as the solids of
two regions, their names in the simulator have a prefix (``tip_youngs_modulus``), which is added and removed only here.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from ..energies.base import BoundEnergy, EnergySite, Memory, Term
from ..energies.contact import BoundContact, ContactForces
from ..energies.explicit import ExplicitEnergy
from ..energies.obstacle_surfaces import ObstacleMotion
from ..energies.placed import PlacedEnergy
from ..energies.surfaces import BoundSurfaceContact, SurfaceForces
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
        placed: the energies, with their points and prefixes.
        body: the body.
        rest_positions: (N, 3) [m], with the simulator's device and dtype.
        method: the integrator.
        time_step: h [s].

    Attributes:
        parameters: parameters by name in the simulator.
        inputs: inputs by name.
        constants: default values of the parameters by name.
        counts: number of values of a parameter or an input per environment, by name.
        parts: names of the parts, such as tendons, with one value each, by the name of the parameter.
        memory: memory variables by name.
    """

    def __init__(
        self,
        placed: Sequence[PlacedEnergy],
        body: Body,
        rest_positions: torch.Tensor,
        method: Integrator,
        time_step: float,
    ) -> None:
        self.placed, self._rest_positions = tuple(placed), rest_positions
        self._explicit: dict[tuple[int, str], ExplicitEnergy] = {}
        self._bound: list[BoundEnergy] = []
        self.parameters: dict[str, Quantity] = {}
        self.inputs: dict[str, Quantity] = {}
        self.constants: dict[str, Any] = {}
        self.counts: dict[str, int] = {}
        self.parts: dict[str, tuple[str, ...]] = {}
        self.memory: dict[str, Memory] = {}
        for item in placed:
            energy, points = item.energy, item.all_points or item.points
            bound = energy.bind(EnergySite(item.body or body, item.first, points, rest_positions, method, time_step))
            self._bound.append(bound)
            parameters, inputs = (
                {f"{item.prefix}{q.name}": replace(q, name=f"{item.prefix}{q.name}") for q in quantities}
                for quantities in (energy.parameters, energy.inputs)
            )
            if duplicates := {*parameters, *inputs} & {*self.parameters, *self.inputs}:
                raise InputError(f"two energies depend on {min(duplicates)}: rename one of their bodies or regions.")
            self.parameters |= parameters
            self.inputs |= inputs
            self.constants |= item.named(energy.constants)
            counts = {q.name: energy.count_of(q) for q in (*energy.parameters, *energy.inputs)}
            self.counts |= item.named(counts)
            shared = item.named({name: counts[name] != energy.count for name in counts})
            self.parts |= {name: energy.names for name in parameters if energy.names and not shared[name]}
            self.memory |= item.named({m.name: replace(m, name=f"{item.prefix}{m.name}") for m in bound.memory})
        pairs = list(enumerate(self._pairs))
        self._loading, self._stepping, self._posing = (
            [(i, pair) for i, pair in pairs if getattr(type(pair[1]), name) is not getattr(BoundEnergy, name)]
            for name in ("load", "begin_step", "at_pose")
        )
        self._remembering = [(i, pair) for i, pair in pairs if pair[1].memory]
        self._rate_independent = [(i, pair) for i, pair in pairs if pair[1].rate_independent]

    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> tuple[dict[str, torch.Tensor | None], Mass]:
        """Returns the values that follow from the parameters, by name, and the mass of the body."""
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

    def values(self, constants: Constants, inputs: Inputs, batch: int) -> dict[str, torch.Tensor | None]:
        """Returns the values that follow from parameters and inputs, by name; missing inputs are zero."""
        values = dict(constants.values)
        for name in self.inputs:
            value = inputs.actuation.get(name)
            values[name] = constants.gravity.new_zeros(batch, self.counts[name]) if value is None else value
        return values

    def loads(self, constants: Constants, inputs: Inputs, batch: int, static: bool) -> Iterator[torch.Tensor]:
        """Yields dead loads (1 or B, N, 3), independent of the positions [N]."""
        for _, (placed, bound) in self._loading:
            load = bound.load(placed.own_inputs(inputs), placed.own_constants(constants), batch, static)
            if load is not None:
                yield load

    def begin_step(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, terms: Sequence[Term]
    ) -> dict[str, torch.Tensor | None]:
        """Returns the values that depend on the step, by name."""
        values: dict[str, torch.Tensor | None] = {}
        for i, (placed, bound) in self._stepping:
            values |= placed.named(bound.begin_step(placed.step(state, stage, inputs, constants, terms[i])))
        return values

    def at_rest(
        self, state: State, inputs: Inputs, constants: Constants, terms: Sequence[Term]
    ) -> dict[str, torch.Tensor | None]:
        """Returns these values for a static equilibrium after a state."""
        values = {k: v for p, bound in self._pairs for k, v in p.named(bound.at_rest(state.batch)).items()}
        for i, (placed, bound) in self._rate_independent:
            step = placed.step(state, _endless_stage(state), inputs, constants, terms[i])
            values |= placed.named(bound.begin_step(step))
        return values

    @property
    def follow_pose(self) -> bool:
        """Whether values of a static equilibrium depend on its positions."""
        return bool(self._posing)

    def at_pose(self, q: torch.Tensor, values: Mapping[str, torch.Tensor | None]) -> dict[str, torch.Tensor | None]:
        """Returns these values at positions (B, N, 3) [m], with the other values by name."""
        posed: dict[str, torch.Tensor | None] = {}
        for _, (placed, bound) in self._posing:
            own = {name: value for name, value in placed.own(values).items() if value is not None}
            posed |= placed.named(bound.at_pose(q, own))
        return posed

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
        """Returns the memory variables after a step with solution x and final positions q, (B, N, 3) each."""
        return self._remembered(self._remembering, state, stage, inputs, constants, terms, x, q)

    def end_pose(
        self, state: State, inputs: Inputs, constants: Constants, terms: Sequence[Term], q: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """Returns the memory variables of a static equilibrium (B, N, 3) after a state."""
        return self._remembered(self._rate_independent, state, _endless_stage(state), inputs, constants, terms, q, q)

    def contacts(
        self,
        state: State,
        stage: ImplicitStage,
        inputs: Inputs,
        constants: Constants,
        terms: Sequence[Term],
        x: torch.Tensor,
    ) -> dict[str, ContactForces | SurfaceForces]:
        """Returns the contact of a step with solution x (B, N, 3) by name (`Simulator.contacts`)."""
        out: dict[str, ContactForces | SurfaceForces] = {}
        for i, (placed, bound) in enumerate(self._pairs):
            if isinstance(bound, BoundContact | BoundSurfaceContact):
                name = (
                    placed.prefix.removesuffix("_") if isinstance(bound, BoundContact) else f"{placed.prefix}surfaces"
                )
                out[name] = bound.forces(placed.step(state, stage, inputs, constants, terms[i]), x)
        return out

    def obstacles(self, states: Sequence[State], constants: Constants) -> tuple[ObstacleMotion, ...]:
        """Returns the motions of all obstacles in successive states, with the prefixes of their energies."""
        motions: list[ObstacleMotion] = []
        for placed, bound in self._pairs:
            if isinstance(bound, BoundContact):
                seen = [replace(state, memory=placed.own(state.memory)) for state in states]
                own = bound.motions(seen, placed.own_constants(constants))
                motions += [replace(motion, name=f"{placed.prefix}{motion.name}") for motion in own]
        return tuple(motions)

    def outside(self, q: torch.Tensor, state: State, constants: Constants) -> torch.Tensor:
        """Returns positions (B, N, 3) [m] out of obstacles, see `Simulator.outside`."""
        for placed, bound in self._pairs:
            if isinstance(bound, BoundContact):
                q = bound.outside(q, state, placed.own_constants(constants))
        return q

    @staticmethod
    def _remembered(
        remembering: Sequence[tuple[int, tuple[PlacedEnergy, BoundEnergy]]],
        state: State,
        stage: ImplicitStage,
        inputs: Inputs,
        constants: Constants,
        terms: Sequence[Term],
        x: torch.Tensor,
        q: torch.Tensor,
    ) -> dict[str, torch.Tensor]:
        memory: dict[str, torch.Tensor] = {}
        for i, (placed, bound) in remembering:
            memory |= placed.named(bound.end_step(placed.step(state, stage, inputs, constants, terms[i]), x, q))
        return memory

    def explicit_energy(self, name: str, batch: int) -> ExplicitEnergy:
        """Returns the energy with the named input for a batch size, made at its first use; see `Simulator`."""
        if (batch, name) not in self._explicit:
            placed = next((item for item in self.placed if name in item.input_names), None)
            if placed is None:
                accepted = ", ".join(self.inputs) or "none"
                raise InputError(f"Unknown input {name}. The energies of this body accept {accepted}.")
            energy, (points,) = placed.energy, placed.all_points or placed.points
            q = self._rest_positions
            self._explicit[batch, name] = ExplicitEnergy(energy, points, len(q), batch, q.device)
        return self._explicit[batch, name]

    def check_memory(self, memory: Mapping[str, torch.Tensor], batch: int, like: torch.Tensor) -> None:
        """Raises InputError for an unknown memory variable, a wrong shape or dtype, or values that are not finite."""
        for name, values in memory.items():
            if name not in self.memory:
                names = ", ".join(self.memory) or "nothing"
                raise InputError(
                    f"Unknown memory {name!r} of the state. The energies of this body remember {names}; leave it out."
                )
            self.memory[name].check(values, batch, like)


def _endless_stage(state: State) -> ImplicitStage:
    """Returns the stage of a static equilibrium after a state: a step without end, in which inertia has no part."""
    return ImplicitStage(math.inf, state.q, state.q, ())
