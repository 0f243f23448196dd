"""Marker places and delays of trials that fit best for each set of physical parameters (variable projection).

Both are nuisance parameters with a normal prior around zero: the marker places of `placement`, and the time by which
the inputs of each trial act later than recorded, as clocks differ, frames are lost, and a valve opens when it likes. A
delay moves a motion in time, so that it needs no simulation of its own.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from .placement import Accuracy, DisplacedMarkers, Placed, estimate_placement
from .replay import Replay, Start, sample

FloatArray = NDArray[np.float64]

_FURTHEST, _TRIED = 3.0, 61  # largest delay, in expected deviations, and number of delays from which the search begins
_STEPS, _ROUNDS = 6, 3  # Gauss-Newton steps of a delay; estimates of places and delays in turn
_DIFFERENCE = 1e-2  # of the time between frames, for the derivative by a delay


@dataclass(frozen=True)
class Nuisances:
    """The best places and delays for one set of parameters.

    Attributes:
        placed: places of the markers; None if they are exact.
        columns: (R, D, K) derivatives of the weighted residuals of each group, in standard deviations of the prior;
            empty if nothing was fitted.
        rows: (K,) weighted residuals of the prior.
    """

    placed: Placed | None
    columns: list[FloatArray]
    rows: FloatArray

    def projected(self, jacobians: Sequence[FloatArray], weight: float) -> tuple[list[FloatArray], FloatArray]:
        """Derivatives of the residuals, and of those of the prior, where places and delays follow the parameters.

        To first order they follow as in a linear problem (Kaufman, BIT 15 (1975) 49).

        Args:
            jacobians: (R, D, P) of each group, at constant places and delays.
            weight: root of the weight of the prior.

        Returns:
            (D, P) of each trial, and (K, P).
        """
        if not self.columns:
            return [own for jacobian in jacobians for own in jacobian], np.zeros((0, jacobians[0].shape[-1]))
        pairs = [*zip(self.columns, jacobians, strict=True)]
        rows, slopes = (np.concatenate([x.reshape(-1, x.shape[-1]) for x in of]) for of in zip(*pairs, strict=True))
        follows = np.linalg.solve(rows.T @ rows + weight**2 * np.eye(rows.shape[1]), rows.T @ slopes)
        return [own for a, j in pairs for own in j - a @ follows], -weight * follows

    def change(self, residuals: Sequence[FloatArray], weight: float) -> FloatArray:
        """(K,) change of places and delays, in standard deviations, by which residuals have their least squares.

        Args:
            residuals: (R, D) of each group, to first order with the places and delays as they are.
            weight: root of the weight of the prior.
        """
        columns = np.concatenate([own.reshape(-1, own.shape[-1]) for own in self.columns])
        right = columns.T @ np.concatenate([own.ravel() for own in residuals]) + weight * self.rows
        return np.asarray(-np.linalg.solve(columns.T @ columns + weight**2 * np.eye(len(right)), right))


class NuisanceFit:
    """Fits places and delays to simulated points.

    Args:
        replays: groups of trials, whose points are `DisplacedMarkers` where places are uncertain.
        weights: (R,) of each trial's squared errors [1/m^2], by group.
        accuracy: standard deviations of the marker places and of the recording's frame; None: both are exact.
        centre: (3,) about which recordings may be rotated [m].
        delay: standard deviation of the delay of motions that inputs begin [s]; zero: they have that of their start.
    """

    def __init__(
        self,
        replays: Sequence[tuple[Replay, Start]],
        weights: Sequence[torch.Tensor],
        accuracy: Accuracy | None,
        centre: torch.Tensor,
        delay: float,
    ) -> None:
        self._replays, self._weights = [*replays], [*weights]
        self._accuracy, self._centre, self._delay = accuracy, centre, delay
        frames = [replay.trials.observed.shape[1] for replay, _ in replays]
        self._late = [delay > 0.0 and own[1].at_rest and count > 2 for own, count in zip(replays, frames, strict=True)]

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to fit."""
        return self._accuracy is None and not any(self._late)

    def __call__(self, series: Sequence[torch.Tensor], prior_weight: float) -> tuple[list[torch.Tensor], Nuisances]:
        """Residuals with the best places and delays for the first set of parameters, at which the loss is stationary.

        While the weight of the prior is not known, places and delays are nominal.

        Args:
            series: (E, R, T, M or 4 M, 3) simulated points at the frames, by group [m].
            prior_weight: of the squared nuisance parameters in standard deviations.

        Returns:
            (E, R, T, M, 3) by group [m], and what was fitted.
        """
        delays = [torch.zeros_like(start.delay) for _, start in self._replays]
        if self.is_empty or not prior_weight:
            errors = [self._errors(n, own, delays[n], None) for n, own in enumerate(series)]
            return errors, Nuisances(None, [], np.zeros(0))
        first, placed = [own[:1].detach() for own in series], None
        with torch.no_grad():
            for turn in range(_ROUNDS if any(self._late) and self._accuracy is not None else 1):
                placed = self._placed(first, delays, prior_weight)
                delays = [self._delayed(n, own, delays[n], placed, prior_weight, turn) for n, own in enumerate(first)]
            if any(self._late):
                placed = self._placed(first, delays, prior_weight)
        errors = [self._errors(n, own, delays[n], placed) for n, own in enumerate(series)]
        return errors, self._fitted(first, delays, placed, math.sqrt(prior_weight))

    def _moved(self, number: int, points: torch.Tensor, delay: torch.Tensor) -> torch.Tensor:
        """(E, R, T, M or 4 M, 3) points of a group, later by delays (R,) [s]."""
        if not self._late[number]:
            return points
        times = self._replays[number][0].trials.times
        step, late = float(times[0, 1]), (times - delay[:, None]).clamp_min(0.0).repeat(len(points), 1)
        series, beyond = points.flatten(0, 1), (late - times.max()).clamp_min(0.0)[..., None, None]
        ahead = beyond * (series[:, -1:] - series[:, -2:-1]) / step  # straight on after the last frame
        return (sample(series, late, step) + ahead).unflatten(0, points.shape[:2])

    def _errors(self, number: int, points: torch.Tensor, delay: torch.Tensor, placed: Placed | None) -> torch.Tensor:
        """(E, R, T, M, 3) residuals of a group with places and delays (R,) [m]."""
        replay, points = self._replays[number][0], self._moved(number, points, delay)
        if self._accuracy is None:
            return replay.errors(points)
        markers, rotations = DisplacedMarkers.split(points)
        if placed is None:
            return replay.errors(markers)
        own = placed.sessions[replay.trials.session]
        return replay.errors(own.apply(markers + (rotations @ own.offsets[..., None])[..., 0]))

    def _placed(
        self, first: Sequence[torch.Tensor], delays: Sequence[torch.Tensor], prior_weight: float
    ) -> Placed | None:
        """The best places of the markers with given delays."""
        if self._accuracy is None:
            return None
        parts = [DisplacedMarkers.split(self._moved(n, own, delays[n])) for n, own in enumerate(first)]
        return estimate_placement(
            self._accuracy,
            self._centre,
            [self._errors(n, own, delays[n], None)[0] for n, own in enumerate(first)],
            [replay.trials.seen for replay, _ in self._replays],
            [points[0] for points, _ in parts],
            [rotations[0] for _, rotations in parts],
            self._weights,
            prior_weight,
            [replay.trials.session for replay, _ in self._replays],
        )

    def _delayed(
        self, number: int, points: torch.Tensor, delay: torch.Tensor, placed: Placed | None, prior: float, turn: int
    ) -> torch.Tensor:
        """The best delays (R,) of a group with given places, in the first turn from the best of a grid."""
        if not self._late[number]:
            return delay
        weight, before = self._weights[number], self._replays[number][1].delay

        def cost(at: torch.Tensor) -> torch.Tensor:
            squares = self._errors(number, points, at, placed)[0].square().sum((1, 2, 3))
            return weight * squares + prior * ((before + at) / self._delay).square()

        if turn == 0:
            grid = self._delay * torch.linspace(-_FURTHEST, _FURTHEST, _TRIED).to(delay)
            delay = grid[torch.stack([cost(at.expand_as(delay)) for at in grid]).argmin(0)]
        for _ in range(_STEPS):
            errors, slopes = self._errors(number, points, delay, placed)[0], self._slopes(number, points, delay, placed)
            right = weight * (slopes * errors).sum((1, 2, 3)) + prior * (before + delay) / self._delay**2
            step = right / (weight * slopes.square().sum((1, 2, 3)) + prior / self._delay**2)
            delay = delay - step.clamp(-0.5 * self._delay, 0.5 * self._delay)
        return delay

    def _slopes(self, number: int, points: torch.Tensor, delay: torch.Tensor, placed: Placed | None) -> torch.Tensor:
        """(R, T, M, 3) derivatives of the residuals of a group by delays (R,) [m/s]."""
        times = self._replays[number][0].trials.times
        step = _DIFFERENCE * float(times[0, 1])
        ends = [self._errors(number, points, delay + by, placed)[0] for by in (step, -step)]
        return (ends[0] - ends[1]) / (2.0 * step)

    def _fitted(
        self, first: Sequence[torch.Tensor], delays: list[torch.Tensor], placed: Placed | None, weight: float
    ) -> Nuisances:
        """What was fitted, with the derivatives of the residuals and the residuals of the prior."""
        blocks, rows = list[FloatArray](), list[FloatArray]()
        counts = [len(delay) if late else 0 for delay, late in zip(delays, self._late, strict=True)]
        for number, (points, delay) in enumerate(zip(first, delays, strict=True)):
            size = points.shape[1]
            columns = np.zeros((size, self._replays[number][0].trials.observed[0].numel(), sum(counts)))
            if self._late[number]:
                root = self._weights[number].sqrt()[:, None, None, None] * self._delay
                slopes = (self._slopes(number, points, delay, placed) * root).flatten(1).double().cpu().numpy()
                at = sum(counts[:number]) + np.arange(size)
                columns[np.arange(size), :, at] = slopes
                before = self._replays[number][1].delay
                rows.append(weight * ((before + delay) / self._delay).double().cpu().numpy())
            blocks.append(columns)
        if placed is not None:
            places = [own.flatten(1, 3).double().cpu().numpy() for own in placed.columns]
            blocks = [np.concatenate(pair, 2) for pair in zip(places, blocks, strict=True)]
            rows.insert(0, weight * placed.deviations.double().cpu().numpy())
        return Nuisances(placed, blocks, np.concatenate(rows))
