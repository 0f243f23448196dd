"""All energies of a simulator as one: quantities, terms of the incremental potential, and memory.

An energy has its own names (``youngs_modulus``). If a simulator has several energies of a kind, such as the solids of
two regions, their names in the simulator have a prefix (``tip_youngs_modulus``), which is added and removed only here.
Mass damping is linear in the solution, so it is merged with inertia and target.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from ..energies.base import BoundEnergy, EnergySite, Memory
from ..energies.contact import BoundContact, ContactForces
from ..energies.obstacles import ObstacleMotion
from ..energies.placement import DEPENDENT, PlacedEnergy, SimulatorStep
from ..energies.potential import StepTerms
from ..energies.surfaces import BoundSurfaceContact
from ..fem.bodies import Body
from ..fem.coordinates import DeviceCoordinates
from ..io.errors import InputError
from ..stepping.inputs import Inputs
from ..stepping.integrators import Integrator
from ..stepping.quantity import Quantity
from ..stepping.state import Constants, Mass, State


class EnergySet:
    """The energies of a simulator.

    Args:
        placed: the energies, with their points and prefixes.
        body: the body.
        coordinates: its coordinates.
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
        coordinates: DeviceCoordinates,
        rest_positions: torch.Tensor,
        method: Integrator,
        time_step: float,
    ) -> None:
        self.placed, self._coordinates = tuple(placed), coordinates
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

    def _values(self, constants: Constants, inputs: Inputs, batch: int) -> dict[str, torch.Tensor | None]:
        """Returns the values that follow from parameters and inputs, by name; missing inputs are zero."""
        values = dict(constants.values)
        for name in self.inputs:
            value = inputs.actuation.get(name)
            values[name] = constants.gravity.new_zeros(batch, self.counts[name]) if value is None else value
        return values

    def step_terms(self, step: SimulatorStep) -> StepTerms:
        """Returns the terms of a step, differentiable."""
        batch, h, constants, stage = step.state.batch, step.stage.step, step.constants, step.stage
        damping = constants.mass_damping[..., None] * h  # (1 or B, 1, 1)
        mass, force = constants.mass, self._loads(step, False)
        if step.inputs.attached_mass is not None:
            mass = mass + step.inputs.attached_mass
        values = self._values(constants, step.inputs, batch)
        for i, (placed, bound) in self._stepping:
            values |= placed.named(bound.begin_step(placed.step(step, i)))
        target = (stage.target + damping * stage.velocity_reference) / (1.0 + damping)
        inertia = (mass / h**2 * (1.0 + damping[..., 0])).expand(batch, -1)
        if self._coordinates.depends:
            dependent = self._coordinates.dependent
            values[f"{DEPENDENT}inertia"] = inertia[:, dependent]
            values[f"{DEPENDENT}target"] = target[:, dependent]
        return StepTerms(target, inertia, self._coordinates.reduce(force.expand(batch, -1, -1)), values)

    def rest_terms(self, step: SimulatorStep, share: float, near: torch.Tensor | None = None) -> StepTerms:
        """Returns the terms of a static equilibrium under a fraction of all loads, differentiable.

        Args:
            step: the equilibrium after a state, whose memory friction continues, and whose positions and forces that of
                contact; its inputs are constant.
            share: the fraction.
            near: (B, N, 3) positions of forces that depend on the pose; without, these are left out [m].
        """
        state, batch = step.state, step.state.batch
        values = self._values(step.constants, step.inputs, batch)
        for name in self.inputs:
            value = values[name]
            values[name] = None if value is None else share * value
        values |= {k: v for placed, bound in self._pairs for k, v in placed.named(bound.at_rest(batch)).items()}
        for i, (placed, bound) in self._rate_independent:
            values |= placed.named(bound.begin_step(placed.step(step, i)))
        if near is not None:
            for _, (placed, bound) in self._posing:
                own = {name: value for name, value in placed.own(values).items() if value is not None}
                values |= placed.named(bound.at_pose(near, own))
        force = self._coordinates.reduce(self._loads(step, True).expand(batch, -1, -1))
        return StepTerms(state.q, state.q.new_zeros(state.q.shape[:2]), share * force, values)

    def _loads(self, step: SimulatorStep, static: bool) -> torch.Tensor:
        """Returns the dead loads (1 or B, N, 3): gravity, external force and those of the energies [N]."""
        constants, inputs, mass = step.constants, step.inputs, step.constants.load_mass
        if inputs.attached_mass is not None:
            mass = mass + inputs.attached_mass
        force = mass[..., None] * constants.gravity[:, None]
        if inputs.external_force is not None:
            force = force + inputs.external_force
        for _, (placed, bound) in self._loading:
            own = placed.own_inputs(inputs), placed.own_constants(constants)
            if (load := bound.load(*own, step.state.batch, static)) is not None:
                force = force + load
        return force

    @property
    def follow_pose(self) -> bool:
        """Whether values of a static equilibrium depend on its positions."""
        return bool(self._posing)

    def end_step(self, step: SimulatorStep, x: torch.Tensor, q: torch.Tensor) -> dict[str, torch.Tensor]:
        """Returns the memory variables after a step with solution x and final positions q, (B, N, 3) each.

        After a static equilibrium these are the ones of energies without rate.
        """
        remembering = self._remembering if math.isfinite(step.stage.step) else self._rate_independent
        memory: dict[str, torch.Tensor] = {}
        for i, (placed, bound) in remembering:
            memory |= placed.named(bound.end_step(placed.step(step, i), x, q))
        return memory

    def contacts(self, step: SimulatorStep, x: torch.Tensor) -> dict[str, ContactForces]:
        """Returns the contact of a step with solution x (B, N, 3) by name (`Simulator.contacts`)."""
        out: dict[str, ContactForces] = {}
        for i, (placed, bound) in enumerate(self._pairs):
            if isinstance(bound, BoundContact | BoundSurfaceContact):
                others = "obstacles" if isinstance(bound, BoundContact) else "surfaces"
                out[f"{placed.prefix}{others}"] = bound.forces(placed.step(step, i), x)
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

    def check_memory(self, memory: Mapping[str, torch.Tensor], batch: int, like: torch.Tensor) -> None:
        """Raises InputError for an unknown memory variable, a wrong shape or dtype, or values that are not finite."""
        for name, values in memory.items():
            if "." in name:  # of a robot
                continue
            if name not in self.memory:
                names = ", ".join(self.memory) or "nothing"
                raise InputError(
                    f"Unknown memory {name!r} of the state. The energies of this body remember {names}; leave it out."
                )
            self.memory[name].check(values, batch, like)
