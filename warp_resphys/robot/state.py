"""States of a robot, which can be selected and joined by environment."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch

from ..data.input_response import Memory
from ..stepping.state import State


@dataclass(frozen=True)
class RobotState:
    """The state of B environments of a robot: everything that their next step depends on.

    Attributes:
        body: positions (B, N, 3) [m] and velocities [m/s] of the vertices, and the memory of the material.
        memory: of the inputs, such as ``pressure.queue``, see `InputResponse`.
        hidden: (B, H) of a recurrent network; None for others, and at the start.
        base: (2, B, 6) displacement of the base one step ago and now [m, rad]; None if it never moved.
        left: (B,) bool, whether the learned force was ever evaluated outside its training range.
        lost: (B,) bool, whether the simulation diverged; the body stands at rest then.
    """

    body: State
    memory: Memory = field(default_factory=dict)
    hidden: torch.Tensor | None = None
    base: torch.Tensor | None = None
    left: torch.Tensor = field(default=None)  # type: ignore[assignment]
    lost: torch.Tensor = field(default=None)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        for name in ("left", "lost"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, torch.zeros(self.batch, dtype=torch.bool, device=self.q.device))

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
        """Number B of environments."""
        return self.body.batch

    def map(self, change: Callable[[torch.Tensor, int], torch.Tensor]) -> "RobotState":
        """Applies a function of a tensor and the number of its environment axis to every tensor."""
        memory = {name: change(value, value.ndim - 2) for name, value in self.memory.items()}
        body = self.body.map(lambda value: change(value, 0))
        hidden = None if self.hidden is None else change(self.hidden, 0)
        base = None if self.base is None else change(self.base, 1)
        return RobotState(body, memory, hidden, base, change(self.left, 0), change(self.lost, 0))

    def detach(self) -> "RobotState":
        """Returns the state without its autograd graph."""
        return self.map(lambda value, _: value.detach())

    def select(self, environments: Sequence[int]) -> "RobotState":
        """Returns the state of some environments, by number."""
        return self.map(
            lambda value, axis: value.index_select(axis, torch.as_tensor(environments, device=value.device))
        )

    def repeat(self, times: int) -> "RobotState":
        """Repeats all environments several times."""
        return self.map(lambda value, axis: torch.cat([value] * times, axis))

    def where(self, chosen: torch.Tensor, other: "RobotState") -> "RobotState":
        """Joins two states of a robot: this one where chosen (B,) bool, the other one elsewhere."""
        if bool(chosen.all()):
            return self
        theirs = list[torch.Tensor]()
        other._like(self).map(lambda value, _: theirs.append(value) or value)  # type: ignore[func-returns-value]
        remaining = iter(theirs)

        def pick(value: torch.Tensor, axis: int) -> torch.Tensor:
            shape = [len(chosen) if at == axis else 1 for at in range(value.ndim)]
            return torch.where(chosen.view(shape), value, next(remaining))

        return self._like(other).map(pick)

    def _like(self, other: "RobotState") -> "RobotState":
        """Adds the tensors that only the other state has, with their initial values."""
        own, more = self.body.tensors(), other.body.tensors()
        rest = {"previous_q": self.q, "previous_v": self.v}
        own |= {name: rest.get(name, torch.zeros_like(x)) for name, x in more.items() if name not in own}
        hidden = torch.zeros_like(other.hidden) if self.hidden is None and other.hidden is not None else self.hidden
        base = torch.zeros_like(other.base) if self.base is None and other.base is not None else self.base
        return replace(self, body=State.from_tensors(own), hidden=hidden, base=base)
