"""What commanded inputs come to, one step at a time: the factor, the delay and the lag that were identified.

`data.actuation` does the same to whole series; here each step takes what is remembered and leaves it to the next one.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import torch

from ..data.actuation import followed

Memory = Mapping[str, torch.Tensor]
_QUEUE: Final = "queue"  # (L, B, C) commands, the last first
_BEHIND: Final = "behind"  # (B, C) what the input had risen to
_MEANS: Final = "means"  # (n, B, C) of what it was


class Commands:
    """One commanded input of a robot.

    Args:
        name: of the input.
        parameters: (1 or B,) identified values by name, of which ``NAME_factor``, ``NAME_delay`` [s] and ``NAME_rise``
            [s] are of this input.
        filters: time constants of the means that a network is told of [s].
        time_step: h [s].
    """

    def __init__(
        self, name: str, parameters: Mapping[str, torch.Tensor], filters: Sequence[float], time_step: float
    ) -> None:
        self.name, self._filters, self._step = name, tuple(filters), time_step
        self._factor, self._delay, self._rise = (parameters.get(f"{name}_{w}") for w in ("factor", "delay", "rise"))
        self._length = 0 if self._delay is None else int(float((self._delay / time_step).floor().max())) + 2

    def still(self, commands: torch.Tensor) -> Memory:
        """What is remembered where commands (B, C) have been given for long."""
        given = self._scaled(commands)
        found = {} if self._delay is None else {_QUEUE: given.expand(self._length, *given.shape)}
        found |= {} if self._rise is None else {_BEHIND: given}
        found |= {_MEANS: given.expand(len(self._filters), *given.shape)} if self._filters else {}
        return {f"{self.name}.{key}": value for key, value in found.items()}

    def step(
        self, memory: Memory, commands: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """What commands (B, C) come to during a step.

        Returns:
            (B, C) the input that acts, (B, C (1 + n)) what a network is told of it, and what is remembered then.
        """
        acting, found = self._scaled(commands), dict[str, torch.Tensor]()
        batch = len(acting)
        if self._delay is not None:
            queue = torch.cat([acting[None], memory[f"{self.name}.{_QUEUE}"][:-1]])
            late = (self._delay / self._step).expand(batch)
            number = late.detach().floor().long()
            share, rows = (late - number)[:, None], torch.arange(batch, device=acting.device)
            acting = (1.0 - share) * queue[number, rows] + share * queue[number + 1, rows]
            found[_QUEUE] = queue
        if self._rise is not None:
            acting = followed(acting, memory[f"{self.name}.{_BEHIND}"], self._rise.expand(batch), self._step)
            found[_BEHIND] = acting
        told = [acting]
        if self._filters:
            before = memory[f"{self.name}.{_MEANS}"]
            constants = [acting.new_full((batch,), each) for each in self._filters]
            means = [followed(acting, each, s, self._step) for each, s in zip(before, constants, strict=True)]
            told, found[_MEANS] = [acting, *means], torch.stack(means)
        return acting, torch.cat(told, -1), {f"{self.name}.{key}": value for key, value in found.items()}

    def _scaled(self, commands: torch.Tensor) -> torch.Tensor:
        return commands if self._factor is None else commands * self._factor[:, None]
