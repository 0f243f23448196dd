"""How an input follows its commands, as `data.actuation` has it: after a delay, with a first-order lag."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class InputResponse:
    """See the module; it is linear.

    Attributes:
        time_step: h [s].
        delay: [s].
        rise: time constant [s].
    """

    time_step: float
    delay: float = 0.0
    rise: float = 0.0

    def still(self, commands: FloatArray) -> FloatArray:
        """(L + 1, ...) what is remembered where commands (...) have been given for long."""
        length = int(self.delay / self.time_step) + 2
        return np.repeat(commands[None], length + 1, axis=0)

    def __call__(self, memory: FloatArray, commands: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        """What commands (T, ...) come to, and what is remembered after each step.

        Args:
            memory: (L + 1, ...) before the first.
            commands: during each step.
        """
        length, count = len(memory) - 1, len(commands)
        queue = np.concatenate([memory[:-1], commands])
        whole = int(self.delay / self.time_step)
        share = self.delay / self.time_step - whole
        at = length + np.arange(count) - whole
        acting = (1.0 - share) * queue[at] + share * queue[at - 1]
        if self.rise > 0.0:
            keep, behind = np.exp(-self.time_step / max(self.rise, 1e-2 * self.time_step)), memory[-1]
            for k in range(count):
                behind = acting[k] + keep * (behind - acting[k])
                acting[k] = behind
        kept = [np.concatenate([queue[k + 1 : k + 1 + length], acting[k : k + 1]]) for k in range(count)]
        return acting, kept
