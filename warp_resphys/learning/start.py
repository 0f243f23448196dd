"""How observed trials begin."""

from dataclasses import dataclass, replace

import torch

from ..core.stepping.state import State
from ..io.arrays import Brief


@dataclass(frozen=True)
class Start(Brief):
    """Initial conditions of R trials."""

    state: State  # (R, N, 3) positions [m] and velocities [m/s]; a first guess of those at rest
    delay: torch.Tensor  # (R,) from time zero of the frames to the release, or the inputs [s]
    # (R, M, 3) true less bound marker places, where a body was held bent but registered as
    # undeformed [m]; None for no shift
    shift: torch.Tensor | None = None
    # whether the bodies begin in equilibrium, which is then solved again for every set of
    # parameters
    at_rest: bool = False

    @classmethod
    def resting(cls, guess: torch.Tensor) -> "Start":
        """Starts in equilibrium, which is solved from a first guess (R, N, 3) [m]."""
        return cls(State(guess, torch.zeros_like(guess)), guess.new_zeros(len(guess)), at_rest=True)

    def near(self, q: torch.Tensor) -> "Start":
        """The start with another first guess of its equilibrium [m], (R or E R, N, 3)
        for E sets of parameters.
        """
        return replace(self, state=State(q, torch.zeros_like(q)))

    def select(self, indices: list[int]) -> "Start":
        """The start of the trials with these indices."""
        pick = torch.as_tensor(indices, device=self.delay.device)
        shift = None if self.shift is None else self.shift[pick]
        return replace(
            self, state=self.state.map(lambda t: t[pick]), delay=self.delay[pick], shift=shift
        )

    def shifted(self, markers: torch.Tensor) -> torch.Tensor:
        """(..., R, T, M, 3) true marker positions, from those of bound markers [m]."""
        return markers if self.shift is None else markers + self.shift[:, None]

    def bound(self, markers: torch.Tensor) -> torch.Tensor:
        """(R, T, M, 3) positions of bound markers, from true marker positions [m]."""
        return markers if self.shift is None else markers - self.shift[:, None]
