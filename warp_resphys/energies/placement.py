"""The energies of a simulator, from its bodies and their materials."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import torch

from ..fem.bodies import Body
from ..fem.integration_points import Points
from ..io.errors import InputError
from ..stepping.inputs import Inputs
from ..stepping.state import Constants, ImplicitStage, State
from .base import Energy, EnergyStep, Term
from .hysteresis import Hysteresis
from .materials import Material
from .rigid import PointInertia, rigid_energies
from .solid import solids_of

T = TypeVar("T")
Materials = Mapping[str, Any]  # by name of a region or body: a material, or the materials of its regions
DEPENDENT = "dependent_"  # prefix of the inertia of dependent vertices


@dataclass(frozen=True)
class SimulatorStep:
    """One time step of a simulator, or a static equilibrium after a state: a step without end (`endless`)."""

    state: State  # state at the start
    stage: ImplicitStage  # the implicit solve of the step
    inputs: Inputs
    constants: Constants
    terms: Sequence[Term]  # kernels of all energies for the state's batch

    @classmethod
    def endless(cls, state: State, inputs: Inputs, constants: Constants, terms: Sequence[Term]) -> "SimulatorStep":
        """Returns a static equilibrium, in which inertia has no part."""
        return cls(state, ImplicitStage(math.inf, state.q, state.q, ()), inputs, constants, terms)


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

    def step(self, step: SimulatorStep, number: int) -> EnergyStep:
        """Returns a step as the energy sees it, whose number among all is given."""
        state = replace(step.state, memory=self.own(step.state.memory)) if self.prefix else step.state
        inputs, constants = self.own_inputs(step.inputs), self.own_constants(step.constants)
        return EnergyStep(state, step.stage, inputs, constants, step.terms[number])

    def own_values(self, values: Mapping[str, torch.Tensor | None], term: Term) -> dict[str, torch.Tensor | None]:
        """Returns the values of the energy's term, with the energy's names."""
        return {name: values[f"{self.prefix}{name}"] for name in term.shapes}


def joined_names(materials: Material | Materials) -> dict[str, Material]:
    """Returns materials of bodies and regions by joined names, as ``finger_tip``; a single one has an empty name."""
    if isinstance(materials, Material):
        return {"": materials}
    return {
        f"{name}_{region}" if region else name: value
        for name, own in materials.items()
        for region, value in joined_names(own).items()
    }


def place_energies(whole: Body, material: Material | Materials) -> list[PlacedEnergy]:
    """Returns the energies of all bodies: solids and their hysteresis, rigid parts, and the bodies' own energies.

    Args:
        whole: a body, or a `fem.scene.Scene`.
        material: one for all bodies, or by region of the mesh, or by body of a scene.

    Raises:
        InputError: a body or a cell without material.
    """
    placed: list[PlacedEnergy] = []
    for name, body, first in whole.members:
        prefix = f"{name}_" if name else ""
        solids = solids_of(body, _material_of(material, body, name))
        energies: list[tuple[Energy, str]] = [(solid, f"{prefix}{region}") for solid, region in solids]
        sliding = [(Hysteresis(solid), f"{prefix}{region}") for solid, region in solids if solid.material.hysteresis]
        energies += sliding
        for part in body.controls:
            energies += [(energy, f"{prefix}{part}_") for energy in rigid_energies(body, part, body.rigid[part])]
        items: list[tuple[Energy, Any, str]] = [(energy, energy.points(body.mesh), own) for energy, own in energies]
        given = zip(cast(Sequence[Energy], body.energies), body.energy_points, strict=True)
        items += [(energy, points, prefix) for energy, points in given]
        placed += [PlacedEnergy.of(whole, body, first, *item) for item in items]
    if (contact := getattr(whole, "contact", None)) is not None:
        placed.append(PlacedEnergy.of(whole, whole, 0, contact, contact.points(whole.mesh)))
    if whole.coordinates:
        placed.append(PlacedEnergy(PointInertia(whole.coordinates.points), (whole.coordinates.points,), DEPENDENT))
    return placed


def _material_of(material: Material | Materials, body: Body, name: str) -> Material | Materials:
    """Returns the material of a body, none for a rigid one, or raises InputError."""
    if not name or isinstance(material, Material):
        return material
    if name not in material:
        if body.soft_cells is not None and not len(body.soft_cells):
            return {}
        raise InputError(f"The body {name!r} has no material. Give one: there are {', '.join(material) or 'none'}.")
    own: Material | Materials = material[name]
    return own
