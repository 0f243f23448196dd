"""Terms of the incremental potential: inertia, loads, and the values of the energies.

Mass damping is linear in x, so it is merged with inertia and target.
"""

from collections.abc import Sequence

import torch

from ..energies.base import Term
from ..energies.placement import DEPENDENT
from ..energies.potential import StepTerms
from ..fem.coordinates import DeviceCoordinates
from ..stepping.constants import Constants
from ..stepping.inputs import Inputs
from ..stepping.state import ImplicitStage, State
from .energy_set import EnergySet


class PotentialTerms:
    """Computes the terms of a step and of a static equilibrium, differentiable.

    Args:
        energies: all energies of the simulator.
        coordinates: coordinates of the body.
    """

    def __init__(self, energies: EnergySet, coordinates: DeviceCoordinates) -> None:
        self._energies, self._coordinates = energies, coordinates

    def of_step(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, terms: Sequence[Term]
    ) -> StepTerms:
        """Returns the terms of a step; ``terms`` are the energies' kernels for the batch."""
        batch, h = state.batch, stage.step
        damping = constants.mass_damping[..., None] * h  # (1 or B, 1, 1)
        mass, force = constants.mass, self._loads(inputs, constants, batch, False)
        if inputs.attached_mass is not None:
            mass = mass + inputs.attached_mass
        values = self._energies.values(constants, inputs, batch)
        values |= self._energies.begin_step(state, stage, inputs, constants, terms)
        target = (stage.target + damping * stage.velocity_reference) / (1.0 + damping)
        inertia = (mass / h**2 * (1.0 + damping[..., 0])).expand(batch, -1)
        if self._coordinates.depends:
            dependent = self._coordinates.dependent
            values[f"{DEPENDENT}inertia"] = inertia[:, dependent]
            values[f"{DEPENDENT}target"] = target[:, dependent]
        return StepTerms(target, inertia, self._coordinates.reduce(force.expand(batch, -1, -1)), values)

    def at_rest(
        self,
        state: State,
        inputs: Inputs,
        constants: Constants,
        terms: Sequence[Term],
        share: float,
        near: torch.Tensor | None = None,
    ) -> StepTerms:
        """Returns the terms of a static equilibrium after a state, under a fraction of all loads.

        Args:
            state: the state before, whose memory friction continues, and whose positions and forces that of contact.
            inputs: constant inputs.
            constants: prepared constants.
            terms: the energies' kernels for the batch.
            share: the fraction.
            near: (B, N, 3) positions of forces that depend on the pose; without, these are left out [m].
        """
        batch = state.batch
        values = self._energies.values(constants, inputs, batch)
        for name in self._energies.inputs:
            value = values[name]
            values[name] = None if value is None else share * value
        values |= self._energies.at_rest(state, inputs, constants, terms)
        if near is not None:
            values |= self._energies.at_pose(near, values)
        force = self._coordinates.reduce(self._loads(inputs, constants, batch, True).expand(batch, -1, -1))
        return StepTerms(state.q, state.q.new_zeros(state.q.shape[:2]), share * force, values)

    def _loads(self, inputs: Inputs, constants: Constants, batch: int, static: bool) -> torch.Tensor:
        """Returns the dead loads (1 or B, N, 3): gravity, external force and those of the energies [N]."""
        mass = constants.load_mass
        if inputs.attached_mass is not None:
            mass = mass + inputs.attached_mass
        force = mass[..., None] * constants.gravity[:, None]
        if inputs.external_force is not None:
            force = force + inputs.external_force
        for load in self._energies.loads(constants, inputs, batch, static):
            force = force + load
        return force
