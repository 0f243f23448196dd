"""Marker places and delays of trials that fit best for each set
of physical parameters (variable projection).

Both are nuisance parameters with a normal prior around zero: the marker places of `placement`, and
the time by which the inputs of each trial act later than recorded, as clocks differ, frames are
lost, and a valve opens when it likes. A delay moves a motion in time, so that it needs no
simulation of its own. For each set of physical parameters, they take the values with the least sum
of squares, prior included (Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from ...core.stepping.rollout import sample
from ...io.arrays import FloatArray
from ..placement import Accuracy, Placement, PlainPlacements, by_placement
from ..replay import Replay, Sensed
from ..start import Start

# Largest delay, in expected deviations, and number of delays from which the search begins.
_FURTHEST, _TRIED = 3.0, 61
# Gauss-Newton steps of places, as rotations by a few degrees are nearly linear; with delays
_TURNS, _STEPS = 4, 6
_LONGEST = 0.5  # change of a delay in a step, in expected deviations
_DIFFERENCE = 1e-2  # of the time between frames, for the derivative by a delay


@dataclass(frozen=True)
class Nuisances:
    """The best places and delays for one set of parameters.

    Attributes:
        columns: (R, D, K) derivatives of the weighted residuals of each group, in standard
            deviations of the prior; empty if nothing was fitted.
        rows: (K,) weighted residuals of the prior.
        sessions: placement of the markers in each session; empty if it is exact.
        common: placement in a session that is not known.
        moves: (3 M + 6, k) change of the offsets, the shift and the turn of a session by the first
            k nuisances.
    """

    columns: Sequence[FloatArray] = ()
    rows: FloatArray = field(default_factory=lambda: np.zeros(0))
    sessions: Mapping[str, Placement] = field(default_factory=dict)
    common: Placement | None = None
    moves: Mapping[str, FloatArray] = field(default_factory=dict)

    def plain(self, labels: Sequence[str]) -> PlainPlacements | None:
        """Returns the placements as JSON data: the common one, and those of the named `sessions`.

        None without any.
        """
        if self.common is None:
            return None
        placements: PlainPlacements = {**self.common.plain(labels)}
        named = {
            session: placement.plain(labels)
            for session, placement in self.sessions.items()
            if session
        }
        if named:
            placements["sessions"] = named
        return placements


class NuisanceFit:
    """Fits places and delays to simulated points, by Gauss-Newton.

    The unknowns are in standard deviations of the prior: the common placement; what each session's
    differs from it by, if there are several; and the delays of trials whose motion inputs begin,
    with those of their starts.

    Args:
        replays: groups of trials, whose points are `DisplacedMarkers` where places are uncertain.
        weights: (R,) of each trial's squared errors [1/m^2], by group.
        accuracy: standard deviations of the marker places and of the recording's frame; None: both
            are exact.
        delay: standard deviation of the delay of motions that inputs begin [s]; zero: they have
            that of their start.
    """

    def __init__(
        self,
        replays: Sequence[tuple[Replay, Start]],
        weights: Sequence[torch.Tensor],
        accuracy: Accuracy | None,
        delay: float,
    ) -> None:
        self._replays, self._weights = [*replays], [*weights]
        self._accuracy, self._delay = accuracy, delay
        self._centre = weights[0].new_tensor([*(accuracy or Accuracy()).centre])
        self._moves: dict[str | None, torch.Tensor] = {}  # None: of the common placement
        self._places = 0
        if accuracy is not None:
            names = [*dict.fromkeys(replay.trials.session for replay, _ in replays)]
            names = names if len(names) > 1 else []
            common = accuracy.directions(replays[0][0].trials.observed)
            shares = torch.eye(len(names)).to(common) * accuracy.between_sessions
            for name, share in zip((None, *names), (torch.zeros(len(names)), *shares), strict=True):
                self._moves[name] = torch.cat([common, *(part * common for part in share)], 1)
            self._moves.setdefault(replays[0][0].trials.session, common)
            self._places = self._moves[None].shape[1]
        self._late, count = list[slice | None](), self._places
        for replay, start in replays:
            is_late = delay > 0.0 and start.at_rest and replay.trials.observed.shape[1] > 2
            self._late.append(slice(count, count + len(start.delay)) if is_late else None)
            count += len(start.delay) if is_late else 0
        self._count = count

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to fit."""
        return self._count == 0

    def __call__(
        self, series: Sequence[Sensed], prior_weight: float
    ) -> tuple[list[torch.Tensor], Nuisances]:
        """Residuals with the best places and delays for the first set of parameters,
        at which the loss is stationary.

        While the weight of the prior is not known, places and delays are nominal.

        Args:
            series: (E, R, T, M or 4 M, 3) simulated points and (E, R, T, S, 6) readings at the
                frames, by group.
            prior_weight: of the squared nuisance parameters in standard deviations.

        Returns:
            (E, R, T, 3 M + 6 S) by group [m], and what was fitted.
        """
        solution = self._centre.new_zeros(self._count)
        for (_, start), late in zip(self._replays, self._late, strict=True):
            if late is not None:
                solution[late] = start.delay / self._delay
        if self.is_empty or not prior_weight:
            return [
                self._errors(n, sensed, solution) for n, sensed in enumerate(series)
            ], Nuisances()
        first = [(points[:1].detach(), loads[:1].detach()) for points, loads in series]
        with torch.no_grad():
            for _ in range(_TURNS if self._accuracy is not None and self._accuracy.turn else 1):
                solution = self._improved(first, solution, prior_weight, self._places)
            if self._count > self._places:
                solution = self._on_grid(first, solution, prior_weight)
                for _ in range(_STEPS):
                    solution = self._improved(first, solution, prior_weight, self._count)
            columns = [
                by.flatten(1, 2).double().cpu().numpy()
                for _, by in self._linearised(first, solution)
            ]
        placed = {name: self._placement(name, solution) for name in self._moves}
        sessions = dict.fromkeys(replay.trials.session for replay, _ in self._replays if placed)
        fitted = Nuisances(
            columns=columns,
            rows=math.sqrt(prior_weight) * solution.double().cpu().numpy(),
            sessions={session: placed[session] for session in sessions},
            common=placed.get(None),
            moves={
                name: by.double().cpu().numpy()
                for name, by in self._moves.items()
                if name is not None
            },
        )
        return [self._errors(n, sensed, solution) for n, sensed in enumerate(series)], fitted

    def _placement(self, session: str | None, solution: torch.Tensor) -> Placement:
        moved = self._moves[session] @ solution[: self._places]
        return Placement(moved[:-6].view(-1, 3), moved[-6:-3], moved[-3:], self._centre)

    def _later(self, number: int, series: torch.Tensor, solution: torch.Tensor) -> torch.Tensor:
        """Points or readings (E, R, T, ...) of a group, later by its delays."""
        late, (replay, start) = self._late[number], self._replays[number]
        if late is None:
            return series
        times, delay = replay.trials.times, self._delay * solution[late] - start.delay
        step = float(times[0, 1])
        at = (times - delay[:, None]).clamp_min(0.0).repeat(len(series), 1)
        flat, beyond = series.flatten(0, 1), (at - times.max()).clamp_min(0.0)[..., None, None]
        ahead = beyond * (flat[:, -1:] - flat[:, -2:-1]) / step  # straight on after the last frame
        return (sample(flat, at, step) + ahead).unflatten(0, series.shape[:2])

    def _errors(self, number: int, sensed: Sensed, solution: torch.Tensor) -> torch.Tensor:
        """(E, R, T, 3 M + 6 S) residuals of a group [m]."""
        replay, (points, loads) = (
            self._replays[number][0],
            (self._later(number, x, solution) for x in sensed),
        )
        if self._accuracy is not None:
            points = self._placement(replay.trials.session, solution).places(points)[0]
        return torch.cat(
            [replay.errors(points).flatten(3), replay.trials.load_errors(loads).flatten(3)], 3
        )

    def _linearised(
        self, first: Sequence[Sensed], solution: torch.Tensor
    ) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Weighted residuals (R, T, C) of each group and their derivatives (R, T, C, K)."""
        result = []
        for number, (sensed, weight) in enumerate(zip(first, self._weights, strict=True)):
            replay = self._replays[number][0]
            late = self._late[number]
            root = weight.sqrt()[:, None, None]
            errors = self._errors(number, sensed, solution)[0]
            columns = errors.new_zeros(*errors.shape, self._count)
            if self._accuracy is not None:
                placement = self._placement(replay.trials.session, solution)
                placed = placement.places(self._later(number, sensed[0], solution)[0])
                slopes = by_placement(placement, *placed) * replay.trials.seen[..., None, None]
                moved = (slopes @ self._moves[replay.trials.session]).flatten(2, 3)
                columns[:, :, : moved.shape[2], : self._places] = moved
            if late is not None:
                step = _DIFFERENCE * float(replay.trials.times[0, 1])
                rows = torch.arange(len(errors))
                ends = []
                for by in (step, -step):
                    moved = solution.clone()
                    moved[late] += by / self._delay
                    ends.append(self._errors(number, sensed, moved)[0])
                columns[rows, ..., late.start + rows] = (
                    (ends[0] - ends[1]) * self._delay / (2.0 * step)
                )
            result.append((errors * root, columns * root[..., None]))
        return result

    def _improved(
        self, first: Sequence[Sensed], solution: torch.Tensor, prior_weight: float, count: int
    ) -> torch.Tensor:
        """The solution after a step of the first unknowns of a number."""
        normal = prior_weight * torch.eye(count).to(solution)
        right = torch.zeros_like(solution[:count])
        for residual, columns in self._linearised(first, solution) if count else ():
            jacobian = columns[..., :count].flatten(0, 2)
            normal = normal + jacobian.T @ jacobian
            right = right - jacobian.T @ (residual.flatten() - jacobian @ solution[:count])
        change = torch.linalg.solve(normal, right) - solution[:count]
        change[self._places :].clamp_(-_LONGEST, _LONGEST)
        return torch.cat([solution[:count] + change, solution[count:]])

    def _on_grid(
        self, first: Sequence[Sensed], solution: torch.Tensor, prior_weight: float
    ) -> torch.Tensor:
        """The solution with the best delays of a grid for each trial."""
        grid, best = torch.linspace(-_FURTHEST, _FURTHEST, _TRIED).to(solution), solution.clone()
        for number, (sensed, late) in enumerate(zip(first, self._late, strict=True)):
            if late is None:
                continue
            costs = []
            for by in grid:
                moved = solution.clone()
                moved[late] += by
                squares = self._errors(number, sensed, moved)[0].square().sum((1, 2))
                costs.append(self._weights[number] * squares + prior_weight * moved[late].square())
            best[late] += grid[torch.stack(costs).argmin(0)]
        return best
