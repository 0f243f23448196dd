"""Weights on strings over a step: where they are, what they are for the body's solve, and where they go."""

from dataclasses import dataclass
from typing import Any

import torch

from ..energies.strings import PAYLOAD, Strings
from .constants import Constants
from .inputs import Inputs
from .integrator import ImplicitStage, Integrator, State


@dataclass(frozen=True)
class HangingWeights:
    """The weights of a body's strings; see `energies.strings`."""

    strings: Strings
    shares: torch.Tensor  # (S, N) of the vertices in what each string is tied to
    method: Integrator
    time_step: float  # h [s]

    def masses(self, inputs: Inputs, batch: int) -> torch.Tensor:
        """(B, S) [kg]; nothing hangs where none are given."""
        given = inputs.actuation.get(PAYLOAD.name)
        return self.shares.new_zeros(batch, self.strings.count) if given is None else given

    def load(self, inputs: Inputs, constants: Constants, batch: int, static: bool) -> torch.Tensor | None:
        """See `StepPart`: what the weights pull at rest."""
        if not static:
            return None
        return torch.einsum(
            "bs,sn,bc->bnc", self.masses(inputs, batch), self.shares, constants.gravity.expand(batch, 3)
        )

    def of(self, state: State, inputs: Inputs, constants: Constants) -> State:
        """(B, S, 3) where the weights of a state are; below where they are tied, on taut strings, if it does not say.

        Without gravity nothing tightens a string, and a weight is where it is tied.
        """
        if state.payload is not None:
            return state.payload
        gravity = constants.gravity.expand(state.batch, 3)[:, None]
        size = gravity.norm(dim=-1, keepdim=True)
        pull = self.masses(inputs, state.batch) * size[..., 0]
        length = constants.values["string_length"] + constants.values["string_compliance"] * pull
        length = length + 0.5 * self.strings.toe
        down = torch.where(size > 0.0, gravity / size, 0.0)
        tied = [torch.einsum("sn,bnc->bsc", self.shares, each) for each in (state.q, state.v)]
        return State(tied[0] + length[..., None] * down, tied[1])

    def values(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants
    ) -> dict[str, torch.Tensor]:
        """See `StepPart`."""
        mass = self.masses(inputs, state.batch) / stage.step**2
        return {
            "string_target": self._free(self._stage(state, inputs, constants), constants),
            "string_stiffness": self.strings.stiffness(mass, constants.values["string_compliance"]),
        }

    def still(self, batch: int) -> dict[str, torch.Tensor]:
        """Strings that do nothing, as `load` has what they pull."""
        zeros = self.shares.new_zeros(batch, self.strings.count)
        return {"string_target": zeros[..., None].expand(-1, -1, 3), "string_stiffness": zeros}

    def after(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, x: torch.Tensor
    ) -> dict[str, Any]:
        """Where the weights go."""
        free = self._free(self._stage(state, inputs, constants), constants)
        mass = self.masses(inputs, state.batch) / stage.step**2
        tied = torch.einsum("sn,bnc->bsc", self.shares, x)
        at = self.strings.taken(tied, free, mass, constants.values)
        return {"payload": self.method.finish(self.of(state, inputs, constants), at, self.time_step)}

    def _stage(self, state: State, inputs: Inputs, constants: Constants) -> ImplicitStage:
        return self.method.stage(self.of(state, inputs, constants), self.time_step)

    def _free(self, stage: ImplicitStage, constants: Constants) -> torch.Tensor:
        """(B, S, 3) where inertia and gravity alone take the weights [m]."""
        return stage.target + stage.step**2 * constants.gravity[:, None]
