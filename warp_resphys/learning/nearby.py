"""Prediction of motions from those with similar parameters, to first order: q(p) = q(p0) + dq/dp (p - p0).

A search for parameters simulates nearly the same motion again and again. Its prediction is where the solver of a step
starts (`Simulator.step`): the error is of second order in the change of the parameters, and smooth in time, so that the
solver extrapolates it from step to step. States are kept, so that derivatives can be computed after a simulation.
"""

from collections.abc import Sequence

import torch

from ..stepping.state import State

_MOST_BYTES = 2**30  # of the states, and of the derivatives, that are kept


class NearbyMotion:
    """The last motion of R trials, and the last derivatives of their positions by P parameters.

    Args:
        owners: (S, R, P) one where a direction of the derivatives changes a parameter of a trial, else zero.
    """

    def __init__(self, owners: torch.Tensor) -> None:
        self._owners = owners
        self._unit: torch.Tensor | None = None
        self._states: Sequence[State] = ()
        self._slopes: list[torch.Tensor] = []  # (S, R, N, 3) in float32, after each step [m]
        self._steps = owners.new_zeros(())

    def keep(self, unit: torch.Tensor, states: Sequence[State]) -> None:
        """Keeps states of the motion with parameters (P,), as fractions of their ranges, unless they are large."""
        small = sum(state.q.nbytes + state.v.nbytes for state in states) <= _MOST_BYTES
        self._unit, self._states = unit, states if small else ()

    def states(self, unit: torch.Tensor) -> Sequence[State] | None:
        """Returns the states with parameters (P,), if the last motion had these and they are kept."""
        return self._states if self._states and self._unit is not None and torch.equal(unit, self._unit) else None

    def predict(self, unit: torch.Tensor, step: int) -> torch.Tensor | None:
        """Returns positions (R, N, 3) after a step with parameters (P,) [m]; None where nothing predicts them."""
        if self._unit is None or step >= min(len(self._slopes), len(self._states) - 1):
            return None
        slopes = self._slopes[step]
        change = (self._owners @ (unit - self._unit)).to(slopes)
        q = self._states[step + 1].q + torch.einsum("sr,srni->rni", change, slopes)
        return q if bool(q.isfinite().all()) else None

    def differentiate(self, points: torch.Tensor) -> None:
        """Begins derivatives by parameters (1 + S, P): those of the motion, and those changed along each direction."""
        steps = torch.einsum("srp,sp->sr", self._owners, points[1:] - points[0])
        self._steps, self._slopes = torch.where(steps == 0.0, torch.inf, steps)[..., None, None], []

    def record(self, q: torch.Tensor, others: torch.Tensor) -> None:
        """Keeps the derivatives after the next step, unless a long motion of a large body needs too much memory.

        Args:
            q: (R, N, 3) positions [m].
            others: (S R, N, 3) those with the changed parameters [m].
        """
        slopes = ((others.unflatten(0, (-1, len(q))) - q) / self._steps).float()
        if (len(self._slopes) + 1) * slopes.nbytes <= _MOST_BYTES:
            self._slopes.append(slopes)
