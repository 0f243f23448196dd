"""The state of a robot: all that its next step depends on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from ..data.input_response import Memory
from ..stepping.state import State


@dataclass(frozen=True)
class RobotState:
    """All that the next step depends on, of B environments.

    Attributes:
        body: positions (B, N, 3) [m] and velocities [m/s] of the vertices, and what its material remembers.
        memory: of the inputs, such as ``pressure.queue``, see `InputResponse`.
        hidden: (B, H) of a recurrent network; None for others, and at the start.
        base: (2, B, 6) how the base had moved a step ago and has now [m, rad]; None where it never did.
        left: (B,) bool, whether the learned force was ever asked outside of the range of its training.
        lost: (B,) bool, whether the simulation diverged; the body stands at rest then.
    """

    body: State
    memory: Memory = field(default_factory=dict)
    hidden: torch.Tensor | None = None
    base: torch.Tensor | None = None
    left: torch.Tensor | None = None
    lost: torch.Tensor | None = None

    @property
    def q(self) -> torch.Tensor:
        """(B, N, 3) positions [m]."""
        return self.body.q

    @property
    def v(self) -> torch.Tensor:
        """(B, N, 3) velocities [m/s]."""
        return self.body.v

    @property
    def batch(self) -> int:
        """B."""
        return self.body.batch

    def each(self, change: Callable[[torch.Tensor, int], torch.Tensor]) -> "RobotState":
        """The state with every tensor changed by a function of it and of the number of its axis of environments."""

        def one(value: torch.Tensor | None, axis: int = 0) -> torch.Tensor | None:
            return None if value is None else change(value, axis)

        memory = {name: change(value, value.ndim - 2) for name, value in self.memory.items()}
        body = self.body.map(lambda value: change(value, 0))
        return RobotState(body, memory, one(self.hidden), one(self.base, 1), one(self.left), one(self.lost))

    def detach(self) -> "RobotState":
        """The same, cut off from the autograd graph."""
        return self.each(lambda value, _: value.detach())

    def select(self, environments: Sequence[int]) -> "RobotState":
        """That of some environments, by number."""
        return self.each(
            lambda value, axis: value.index_select(axis, torch.as_tensor(environments, device=value.device))
        )

    def repeat(self, times: int) -> "RobotState":
        """All environments, several times over."""
        return self.each(lambda value, axis: torch.cat([value] * times, axis))

    def where(self, chosen: torch.Tensor, other: "RobotState") -> "RobotState":
        """These environments where chosen (B,) bool, those of another state of the same robot elsewhere."""
        if bool(chosen.all()):
            return self
        theirs = iter(other._like(self)._tensors())

        def pick(value: torch.Tensor, axis: int) -> torch.Tensor:
            shape = [len(chosen) if at == axis else 1 for at in range(value.ndim)]
            return torch.where(chosen.view(shape), value, next(theirs))

        return self._like(other).each(pick)

    def _tensors(self) -> list[torch.Tensor]:
        found: list[torch.Tensor] = []
        self.each(lambda value, _: found.append(value) or value)  # type: ignore[func-returns-value]
        return found

    def _like(self, other: "RobotState") -> "RobotState":
        """With what the other one remembers and this one does not, as it is where nothing has been."""

        def zeros(mine: torch.Tensor | None, theirs: torch.Tensor | None) -> torch.Tensor | None:
            return torch.zeros_like(theirs) if mine is None and theirs is not None else mine

        own, more = self.body.tensors(), other.body.tensors()
        rest = {"previous_q": self.q, "previous_v": self.v}
        own |= {name: rest.get(name, torch.zeros_like(x)) for name, x in more.items() if name not in own}
        return RobotState(
            State.from_tensors(own),
            self.memory,
            zeros(self.hidden, other.hidden),
            zeros(self.base, other.base),
            zeros(self.left, other.left),
            zeros(self.lost, other.lost),
        )
