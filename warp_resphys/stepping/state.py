"""The state of a batch, and the implicit solve that a time step comes down to."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch

_MEMORY = "memory."  # begins the names of memory among the tensors of a state


@dataclass(frozen=True)
class State:
    """Positions and velocities of a batch, and what its energies remember."""

    q: torch.Tensor  # (B, N, 3) [m]
    v: torch.Tensor  # (B, N, 3) [m/s]
    previous: tuple[torch.Tensor, torch.Tensor] | None = None  # (q, v) one step earlier, for BDF2
    # (B, ...) by name, see `energies.base.Memory`; what is not there is as in a body that has been at rest for long
    memory: Mapping[str, torch.Tensor] = field(default_factory=dict)

    @property
    def batch(self) -> int:
        """Number of environments B."""
        return self.q.shape[0]

    def map(self, change: Callable[[torch.Tensor], torch.Tensor]) -> "State":
        """Returns the state with a function applied to every tensor."""
        return State.from_tensors({name: change(tensor) for name, tensor in self.tensors().items()})

    def detach(self) -> "State":
        """Returns the state cut off from the autograd graph."""
        return self.map(torch.Tensor.detach)

    def tensors(self) -> dict[str, torch.Tensor]:
        """Returns all tensors of the state by name: ``q``, ``v``, ``previous_q``, ``previous_v``, ``memory.NAME``."""
        tensors = {"q": self.q, "v": self.v}
        if self.previous is not None:
            tensors |= {"previous_q": self.previous[0], "previous_v": self.previous[1]}
        return tensors | {f"{_MEMORY}{name}": tensor for name, tensor in self.memory.items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, torch.Tensor]) -> "State":
        """Builds the state from its `tensors`; other names are ignored."""
        previous = (tensors["previous_q"], tensors["previous_v"]) if "previous_q" in tensors else None
        memory = {name.removeprefix(_MEMORY): x for name, x in tensors.items() if name.startswith(_MEMORY)}
        return cls(tensors["q"], tensors["v"], previous, memory)


@dataclass(frozen=True)
class ImplicitStage:
    """The implicit solve that a time step comes down to."""

    step: float  # effective step h_e [s]
    target: torch.Tensor  # (B, N, 3) y, where inertia alone would go [m]
    velocity_reference: torch.Tensor  # (B, N, 3) r with velocity (x - r) / h_e at the solution [m]
    # (position, weight) pairs whose weighted strains the strain rate starts from
    strain_weights: tuple[tuple[torch.Tensor, float], ...]
    end: float = 1.0  # fraction of the time step at which x stands
