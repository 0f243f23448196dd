"""All energies of a simulator as one: quantities, terms of the incremental potential, and memory.

An energy has its own names (``youngs_modulus``). If a simulator has several energies of a kind,
such as the solids of two regions, their names in the simulator have a prefix
(``tip_youngs_modulus``), which is added and removed only here. Mass damping is linear in the
solution, so it is merged with inertia and target.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar, cast

import torch

from ...io.errors import InputError, check_type
from ..energies.base import BoundEnergy, Energy, EnergySite, EnergyStep, Memory, PlacedEnergy
from ..energies.contact.barrier import ContactForces
from ..energies.contact.obstacle_contact import BoundContact
from ..energies.contact.obstacle_poses import Pose
from ..energies.contact.surface_contact import BoundSurfaceContact
from ..energies.materials import Material
from ..energies.pointwise import one_part_each
from ..energies.potential import StepTerms
from ..energies.rigid import PointInertia, rigid_energies
from ..energies.solid import solids_of
from ..energies.term import Term, Values
from ..fem.bodies import Body
from ..fem.coordinates import DeviceCoordinates
from ..fem.internal_forces import InternalForces
from ..stepping.inputs import Inputs
from ..stepping.integrators import Integrator
from ..stepping.quantity import Quantity
from ..stepping.state import Constants, ImplicitStage, Mass, State

T = TypeVar("T")
Named = TypeVar("Named", Quantity, Memory)
# By name of a region or body: a material, or the materials of its regions.
Materials = Mapping[str, Any]


@dataclass(frozen=True)
class SimulatorStep:
    """One time step of a simulator, or a static equilibrium after a state:
    a step without end (`endless`).
    """

    state: State  # state at the start
    stage: ImplicitStage  # the implicit solve of the step
    inputs: Inputs
    constants: Constants
    terms: Sequence[Term]  # kernels of all energies for the state's batch

    @classmethod
    def endless(
        cls, state: State, inputs: Inputs, constants: Constants, terms: Sequence[Term]
    ) -> "SimulatorStep":
        """Returns a static equilibrium, in which inertia has no part."""
        return cls(state, ImplicitStage(math.inf, state.q, state.q, ()), inputs, constants, terms)


def _without(prefix: str, values: Mapping[str, T]) -> Mapping[str, T]:
    """Selects the values whose names in the simulator have a prefix, and removes it."""
    if not prefix:
        return values
    return {name.removeprefix(prefix): x for name, x in values.items() if name.startswith(prefix)}


def _prefixed(prefix: str, items: Iterable[Named]) -> dict[str, Named]:
    """Returns items of an energy by their names in the simulator."""
    renamed = (replace(item, name=f"{prefix}{item.name}") for item in items)
    return {item.name: item for item in renamed}


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
        defaults: default values of the parameters by name.
        counts: number of values of a parameter or an input per environment, by name.
        parts: names of the parts, such as tendons, with one value each, by the name of the
            parameter.
        memory: memory variables by name.
        internal: resultants of internal forces.
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
        self.internal = InternalForces(body, rest_positions)
        self._bound: list[BoundEnergy] = []
        self.parameters: dict[str, Quantity] = {}
        self.inputs: dict[str, Quantity] = {}
        self.defaults: dict[str, Any] = {}
        self.counts: dict[str, int] = {}
        self.parts: dict[str, tuple[str, ...]] = {}
        self.memory: dict[str, Memory] = {}
        for item in placed:
            energy, prefix = item.energy, item.prefix
            points = item.all_points or item.points
            bound = energy.bind(
                EnergySite(item.body or body, item.first, points, rest_positions, method, time_step)
            )
            self._bound.append(bound)
            parameters = _prefixed(prefix, energy.parameters)
            inputs = _prefixed(prefix, energy.inputs)
            if duplicates := {*parameters, *inputs} & {*self.parameters, *self.inputs}:
                raise InputError(
                    f"two energies depend on {min(duplicates)}: "
                    "rename one of their bodies or regions."
                )
            self.parameters |= parameters
            self.inputs |= inputs
            self.defaults |= {f"{prefix}{name}": value for name, value in energy.defaults.items()}
            for q in (*energy.parameters, *energy.inputs):
                self.counts[f"{prefix}{q.name}"] = energy.count_of(q)
                if energy.names and energy.count_of(q) == energy.count:
                    self.parts[f"{prefix}{q.name}"] = energy.names
            self.memory |= _prefixed(prefix, bound.memory)
        self._loading = self._overriding("load")
        self._stepping = self._overriding("begin_step")
        self._posing = self._overriding("at_pose")
        self._holding = self._overriding("load_at_fixed")
        self._remembering = [k for k, bound in enumerate(self._bound) if bound.memory]
        self._rate_independent = [
            k for k, bound in enumerate(self._bound) if bound.rate_independent
        ]

    def _overriding(self, name: str) -> list[int]:
        """Returns the numbers of the energies that implement an optional method."""
        inherited = getattr(BoundEnergy, name)
        types = [type(bound) for bound in self._bound]
        return [k for k, kind in enumerate(types) if getattr(kind, name) is not inherited]

    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> tuple[list[Values], Mass]:
        """Returns the values of every energy that follow from the parameters,
        by name, and the mass of the body.
        """
        split = [_without(item.prefix, parameters) for item in self.placed]
        values: list[Values] = [
            bound.prepare(mine) for bound, mine in zip(self._bound, split, strict=True)
        ]
        by_energy = [bound.mass(mine) for bound, mine in zip(self._bound, split, strict=True)]
        masses = [mass for mass in by_energy if mass]
        return values, masses[0] if len(masses) == 1 else Mass.sum(masses)

    def _values(
        self, step: SimulatorStep, share: float = 1.0
    ) -> list[dict[str, torch.Tensor | None]]:
        """Returns the values of every energy that follow from parameters and inputs.

        Missing inputs are zero.

        Args:
            step: the step.
            share: factor of the inputs.
        """
        values = [dict(prepared) for prepared in step.constants.values]
        actuation = step.inputs.actuation
        for energy_values, item in zip(values, self.placed, strict=True):
            for quantity in item.energy.inputs:
                name = f"{item.prefix}{quantity.name}"
                zero = step.constants.gravity.new_zeros
                if name in actuation:
                    energy_values[quantity.name] = (
                        actuation[name] if share == 1.0 else share * actuation[name]
                    )
                else:
                    energy_values[quantity.name] = zero(step.state.batch, self.counts[name])
        return values

    def _step(self, step: SimulatorStep, k: int) -> EnergyStep:
        """Returns a step as energy k sees it."""
        prefix, state = self.placed[k].prefix, step.state
        if prefix and state.memory:
            state = replace(state, memory=_without(prefix, state.memory))
        fixed = None if prefix else step.inputs.fixed_positions
        inputs = _without(prefix, step.inputs.actuation)
        return EnergyStep(
            state,
            step.stage,
            inputs,
            fixed,
            step.constants.values[k],
            step.constants.gravity,
            step.terms[k],
        )

    def step_terms(self, step: SimulatorStep, near: torch.Tensor | None = None) -> StepTerms:
        """Returns the terms of a step, differentiable.

        Args:
            step: the step.
            near: (B, N, 3) positions of forces that depend on the pose (`internal_force`); without,
                those without forces [m].
        """
        stage, constants = step.stage, step.constants
        batch, h = step.state.batch, stage.step
        damping = constants.mass_damping[..., None] * h  # (1 or B, 1, 1)
        mass, force = constants.mass, self._loads(step, near)
        if step.inputs.attached_mass is not None:
            mass = mass + step.inputs.attached_mass
        values = self._values(step)
        for k in self._stepping:
            values[k] |= self._bound[k].begin_step(self._step(step, k))
        target = (stage.target + damping * stage.velocity_reference) / (1.0 + damping)
        inertia = (mass / h**2 * (1.0 + damping[..., 0])).expand(batch, -1)
        if self._coordinates.depends:  # their inertia is the last energy (`place_energies`)
            dependent = self._coordinates.dependent
            values[-1] |= {"inertia": inertia[:, dependent], "target": target[:, dependent]}
        return StepTerms(
            target, inertia, self._coordinates.reduce(force.expand(batch, -1, -1)), values
        )

    def rest_terms(
        self, step: SimulatorStep, share: float, near: torch.Tensor | None = None
    ) -> StepTerms:
        """Returns the terms of a static equilibrium under a fraction of all loads, differentiable.

        Args:
            step: the equilibrium after a state, whose memory friction continues, and whose
                positions and forces that of contact; its inputs are constant.
            share: the fraction.
            near: (B, N, 3) positions of forces that depend on the pose; without, these are left out
                [m].
        """
        state, batch = step.state, step.state.batch
        values = self._values(step, share)
        for k, bound in enumerate(self._bound):
            values[k] |= (
                bound.begin_step(self._step(step, k))
                if bound.rate_independent
                else bound.at_rest(batch)
            )
        if near is not None:
            for k in self._posing:
                values[k] |= self._bound[k].at_pose(near, values[k])
        force = self._coordinates.reduce(self._loads(step, near).expand(batch, -1, -1))
        return StepTerms(state.q, state.q.new_zeros(state.q.shape[:2]), share * force, values)

    def internal_force(
        self, step: SimulatorStep, q: torch.Tensor | None = None
    ) -> torch.Tensor | None:
        """Returns the internal force (B, N, 3) of a step,
        balanced at q (B, N, 3) or without forces, or None [N].
        """
        force, mass = step.inputs.internal_force, step.constants.mass
        if force is None or not self.depends_on_pose(step):
            return force
        if step.inputs.attached_mass is not None:
            mass = mass + step.inputs.attached_mass
        return self.internal.balanced(force, step.stage.target if q is None else q, mass)

    def depends_on_pose(self, step: SimulatorStep) -> bool:
        """Whether the internal force of a step depends on the pose at its end,
        as of a body that nothing holds.
        """
        return self.internal.follow_pose(step.inputs.internal_force)

    def _loads(self, step: SimulatorStep, near: torch.Tensor | None) -> torch.Tensor:
        """The dead loads (1 or B, N, 3): gravity, forces of inputs and those of energies [N]."""
        constants, inputs = step.constants, step.inputs
        mass = constants.load_mass
        if inputs.attached_mass is not None:
            mass = mass + inputs.attached_mass
        force = mass[..., None] * constants.gravity[:, None]
        if inputs.external_force is not None:
            force = force + inputs.external_force
        internal = self.internal_force(step, near)
        if internal is not None:
            force = force + internal
        loads = (self._bound[k].load(self._step(step, k)) for k in self._loading)
        return sum((load for load in loads if load is not None), start=force)

    def loads_at_fixed(self, terms: StepTerms, q: torch.Tensor) -> torch.Tensor | None:
        """Returns what forces (B, N, 3) at fixed vertices have beyond the energies' slopes
        at q (B, N, 3), or None.
        """
        loads = (self._bound[k].load_at_fixed(q, terms.values[k]) for k in self._holding)
        found = [load for load in loads if load is not None]
        return sum(found[1:], found[0]) if found else None

    @property
    def follow_pose(self) -> bool:
        """Whether forces in a static equilibrium depend on its pose without a potential,
        as friction of tendons.
        """
        return bool(self._posing)

    def end_step(
        self, step: SimulatorStep, x: torch.Tensor, q: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """Returns the memory variables after a step with solution x
        and final positions q, (B, N, 3) each.

        After a static equilibrium these are the ones of energies without rate.
        """
        memory: dict[str, torch.Tensor] = {}
        for k in self._remembering if math.isfinite(step.stage.step) else self._rate_independent:
            end = self._bound[k].end_step(self._step(step, k), x, q)
            memory |= {f"{self.placed[k].prefix}{name}": value for name, value in end.items()}
        return memory

    def contacts(self, step: SimulatorStep, x: torch.Tensor) -> dict[str, ContactForces]:
        """Returns the contact of a step with solution x (B, N, 3)
        by name (`Simulator.contacts`).
        """
        out: dict[str, ContactForces] = {}
        for k, bound in enumerate(self._bound):
            if isinstance(bound, BoundContact | BoundSurfaceContact):
                others = "obstacles" if isinstance(bound, BoundContact) else "surfaces"
                out[f"{self.placed[k].prefix}{others}"] = bound.forces(self._step(step, k), x)
        return out

    @cached_property
    def obstacle_names(self) -> frozenset[str]:
        """Names of all obstacles."""
        return frozenset(
            name for item in self.placed for name in getattr(item.energy, "obstacles", ())
        )

    def obstacles(self, states: Sequence[State], constants: Constants) -> tuple[Pose, ...]:
        """Returns the poses of all obstacles in each state; none without obstacles.

        Args:
            states: successive states of a roll-out, whose memory has the poses of obstacles that
                move.
            constants: constants of the simulator.
        """
        contacts: list[list[Pose]] = []
        for item, bound, values in zip(self.placed, self._bound, constants.values, strict=True):
            if isinstance(bound, BoundContact):
                memories = [_without(item.prefix, state.memory) for state in states]
                contacts.append(bound.poses(memories, values, states[0].batch))
        return tuple(Pose.joined(poses) for poses in zip(*contacts, strict=True))

    def outside(self, q: torch.Tensor, state: State, constants: Constants) -> torch.Tensor:
        """Returns positions (B, N, 3) [m] pushed out of obstacles
        that stand still, for a step from there.

        Args:
            q: positions, of which some may be within an obstacle.
            state: nearby, out of all obstacles: vertices are pushed to their gap in it, or to half
                of the distance at which contact begins, whichever is less.
            constants: constants of the simulator.

        Raises:
            InputError: the obstacles leave no place.
        """
        for bound, values in zip(self._bound, constants.values, strict=True):
            if isinstance(bound, BoundContact):
                q = bound.outside(q, state, values)
        return q

    def check_memory(
        self, memory: Mapping[str, torch.Tensor], batch: int, like: torch.Tensor
    ) -> None:
        """Raises InputError for an unknown memory variable,
        a wrong shape or dtype, or values that are not finite.
        """
        for name, values in memory.items():
            if "." in name:  # of a robot
                continue
            if name not in self.memory:
                names = ", ".join(self.memory) or "nothing"
                raise InputError(
                    f"Unknown memory {name!r} of the state. The energies of this body remember "
                    f"{names}; leave it out."
                )
            self.memory[name].check(values, batch, like)


def joined_names(materials: Material | Materials) -> dict[str, Material]:
    """Returns materials of bodies and regions by joined names, as ``finger_tip``.

    A single one has an empty name.
    """
    if isinstance(materials, Material):
        return {"": materials}
    return {
        f"{name}_{region}" if region else name: value
        for name, part in materials.items()
        for region, value in joined_names(part).items()
    }


def place_energies(whole: Body, material: Material | Materials) -> list[PlacedEnergy]:
    """Returns the energies of all bodies: solids, rigid parts, and the bodies' own energies.

    Args:
        whole: a body, or a `fem.scene.Scene`.
        material: one for all bodies, or by region of the mesh, or by body of a scene.

    Raises:
        InputError: a body or a cell without material.
    """
    check_type("the material", material, Material | Mapping)
    placed: list[PlacedEnergy] = []
    for name, body, first in whole.members:
        prefix = f"{name}_" if name else ""
        solids = solids_of(body, _material_of(material, body, name))
        energies: list[tuple[Energy, str]] = [
            (solid, f"{prefix}{region}") for solid, region in solids
        ]
        for part in body.controls:
            energies += [
                (energy, f"{prefix}{part}_")
                for energy in rigid_energies(body, part, body.rigid[part])
            ]
        items: list[tuple[Energy, Any, str]] = [
            (energy, energy.points(body.mesh), region_prefix) for energy, region_prefix in energies
        ]
        declared = zip(cast(Sequence[Energy], body.energies), body.energy_points, strict=True)
        items += [(energy, points, prefix) for energy, points in declared]
        placed += [PlacedEnergy.of(whole, body, first, *item) for item in items]
    contact = getattr(whole, "contact", None)
    if contact is not None:
        placed.append(PlacedEnergy.of(whole, whole, 0, contact, contact.points(whole.mesh)))
    if whole.coordinates:
        dependent = one_part_each(whole.coordinates.points)
        placed.append(PlacedEnergy(PointInertia(dependent), (dependent,), "dependent_"))
    return placed


def _material_of(material: Material | Materials, body: Body, name: str) -> Material | Materials:
    """Returns the material of a body, none for a rigid one, or raises InputError."""
    if not name or isinstance(material, Material):
        return material
    if name not in material:
        if body.soft_cells is not None and not len(body.soft_cells):
            return {}
        raise InputError(
            f"The body {name!r} has no material. Give one: there are "
            f"{', '.join(material) or 'none'}."
        )
    chosen: Material | Materials = material[name]
    return chosen
