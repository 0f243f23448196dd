"""Marker places on the body, the recording's frame and delays of trials, fitted for each set of physical parameters.

Marker m sits at an offset b_m from its nominal place on the body, and the frame of the recordings is shifted by t and
rotated by w about a centre c, so that a simulated marker y_m is observed at

    x = c + R(w) (y_m(q; b_m) - c) + t

The inputs of a trial may act later than recorded, as clocks differ, frames are lost, and a valve opens when it likes. A
delay moves a motion in time, so that it needs no simulation of its own.

All of these are nuisance parameters with a normal prior around zero. For each set of physical parameters, they take the
values with the least sum of squares, prior included (variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 10
(1973) 413).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from typing_extensions import override

from ..data.markers import Markers, Observation
from ..io.arrays import FloatArray
from ..io.errors import InputError
from ..stepping.rollout import sample
from .replay import Replay, Start

_FURTHEST, _TRIED = 3.0, 61  # largest delay, in expected deviations, and number of delays from which the search begins
_TURNS, _STEPS = 4, 6  # Gauss-Newton steps of places, as rotations by a few degrees are nearly linear; with delays
_LONGEST = 0.5  # change of a delay in a step, in expected deviations
_DIFFERENCE = 1e-2  # of the time between frames, for the derivative by a delay


@dataclass(frozen=True)
class Accuracy:
    """Prior standard deviations; None for what is known exactly.

    Attributes:
        markers: of each coordinate of a marker's place on the body [m].
        shift: of each coordinate of the origin of the recording's frame [m].
        turn: of each component of its rotation vector [rad].
        between_sessions: of what the placement of a session differs from that of all by, over those above.
        mounting: of each component of the rotation vector of a rigid body on the part that carries it [rad]; its
            position has that of markers.
        rigid_bodies: index of the first of the four points of each rigid body, and these on the undeformed body,
            (4, 3) relative to their mean [m].
        centre: (3,) about which recordings may be rotated [m].
    """

    markers: float | None = None
    shift: float | None = None
    turn: float | None = None
    between_sessions: float = 0.5
    mounting: float | None = None
    rigid_bodies: tuple[tuple[int, FloatArray], ...] = ()
    centre: Sequence[float] = (0.0, 0.0, 0.0)

    def directions(self, like: torch.Tensor) -> torch.Tensor:
        """(3 M + 6, K) offsets, shift and turn by one standard deviation, for a tensor (..., M, 3) like the markers.

        A marker has three offsets; the points of a rigid body are shifted and turned together, to first order.
        """
        count = like.shape[-2]
        sizes = [self.markers or 0.0] * (3 * count) + [self.shift or 0.0] * 3 + [self.turn or 0.0] * 3
        directions = torch.diag(like.new_tensor(sizes))
        kept = torch.ones(len(sizes), dtype=torch.bool)
        for first, corners in self.rigid_bodies:
            rows, eye = slice(3 * first, 3 * first + 12), torch.eye(3).to(like)
            arms = like.new_tensor(corners)[:, None].expand(4, 3, 3)
            turned = torch.linalg.cross(eye.expand(4, 3, 3), arms, dim=-1).mT  # (4, 3, 3) of a point, by the rotation
            directions[rows, rows] = 0.0
            directions[rows, 3 * first : 3 * first + 3] = (self.markers or 0.0) * eye.repeat(4, 1)
            directions[rows, 3 * first + 3 : 3 * first + 6] = (self.mounting or 0.0) * turned.flatten(0, 1)
            kept[3 * first + 6 : 3 * first + 12] = False
        return directions[:, kept.to(like.device)]

    def of_new_session(self, like: torch.Tensor, sessions: int) -> torch.Tensor:
        """Standard deviations of a new session's placement from the common one of n sessions.

        The session's own deviation has the variance b^2 s^2, with b of `between_sessions` and s of all. That of the
        common placement, of which every exactly known session is one draw, is s^2 / (1 + n / b^2).

        Args:
            like: (..., M, 3) like the markers.
            sessions: n, of which the placements were identified.

        Returns:
            (3 M + 6, K), as `directions`.
        """
        variance = self.between_sessions**2 + 1.0 / (1.0 + sessions / self.between_sessions**2)
        return math.sqrt(variance) * self.directions(like)


@dataclass(frozen=True)
class Placement:
    """Marker places on the body, and the frame of the recordings.

    Attributes:
        offsets: (M, 3) of the markers from their nominal places, in the frame of the body at rest [m].
        shift: (3,) of the recording's frame [m].
        turn: (3,) its rotation vector [rad].
        centre: (3,) about which it is rotated [m].
    """

    offsets: torch.Tensor
    shift: torch.Tensor
    turn: torch.Tensor
    centre: torch.Tensor

    def apply(self, points: torch.Tensor) -> torch.Tensor:
        """Returns points (..., 3) of the body in the frame of the recordings [m]."""
        angle = self.turn.norm()
        axis = self.turn / angle.clamp_min(torch.finfo(angle.dtype).tiny)
        arm = points - self.centre
        across = torch.linalg.cross(axis.expand_as(arm), arm, dim=-1)
        twice = torch.linalg.cross(axis.expand_as(arm), across, dim=-1)  # Rodrigues
        return points + torch.sin(angle) * across + (1.0 - torch.cos(angle)) * twice + self.shift

    def to(self, like: torch.Tensor) -> "Placement":
        """Returns the placement on the device and in the precision of a tensor."""
        return Placement(*(t.to(like) for t in (self.offsets, self.shift, self.turn, self.centre)))

    def places(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns placed markers (..., M, 3) [m] and the body's rotations there, from points of `DisplacedMarkers`."""
        markers, rotations = DisplacedMarkers.split(points)
        return self.apply(markers + (rotations @ self.offsets[..., None])[..., 0]), rotations

    def plain(self, labels: Sequence[str]) -> dict[str, Any]:
        """Returns the placement as JSON data."""
        rest = {"shift": self.shift.tolist(), "turn": self.turn.tolist(), "centre": self.centre.tolist()}
        return {"offsets": dict(zip(labels, self.offsets.tolist(), strict=True)), **rest}

    @classmethod
    def none(cls, count: int, centre: torch.Tensor) -> "Placement":
        """Returns the nominal placement of M markers."""
        zero = torch.zeros_like(centre)
        return cls(centre.new_zeros(count, 3), zero, zero, centre)

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any], labels: Sequence[str]) -> "Placement":
        """Returns the placement that `plain` wrote."""
        offsets = torch.tensor([plain["offsets"][label] for label in labels], dtype=torch.float64)
        rest = (torch.tensor(plain[key], dtype=torch.float64) for key in ("shift", "turn", "centre"))
        return cls(offsets, *rest)


def placement_of(plain: Mapping[str, Any], labels: Sequence[str], session: str = "") -> Placement:
    """Returns the placement of a session from `Nuisances.plain`; the common one for a session that is not known."""
    return Placement.from_plain(plain.get("sessions", {}).get(session, plain), labels)


@dataclass(frozen=True)
class PlacedMarkers(Markers):
    """Markers at their placed offsets, in the frame of the recordings."""

    vertices: torch.Tensor
    markers: Markers  # at their offsets, in the frame of the body
    placement: Placement

    @classmethod
    def of(cls, markers: Markers, placement: Placement) -> "PlacedMarkers":
        """Returns nominal markers with a placement applied."""
        return cls(markers.vertices, markers.moved(placement.offsets), placement)

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        return self.placement.apply(self.markers(positions))


class DisplacedMarkers(Observation):
    """M markers and three copies of them, displaced by 1 m along each axis of the body at rest.

    Markers are linear in their offsets, so that the copies give the derivative by an offset: the rotation of the body
    at the marker.

    Args:
        markers: nominal markers.
        count: M.
    """

    def __init__(self, markers: Markers, count: int) -> None:
        axes = torch.eye(3, dtype=torch.float64)
        self._markers = markers
        self._all = [markers, *(markers.moved(axis.expand(count, 3)) for axis in axes)]

    @classmethod
    def replay(cls, replay: Replay, start: Start) -> tuple[Replay, Start]:
        """Returns a replay that is observed with displaced copies, and its start.

        Raises:
            InputError: something else than markers is observed.
        """
        if not isinstance(replay.observe, Markers):
            raise InputError("where the markers sit can be identified of markers alone: leave identify.placement out.")
        observe = cls(replay.observe, replay.trials.observed.shape[2])
        shift = None if start.shift is None else start.shift.repeat(1, len(observe._all), 1)
        return Replay(replay.simulator, observe, replay.trials), replace(start, shift=shift)

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) positions to (B, 4 M, 3) points [m]."""
        return torch.cat([markers(positions) for markers in self._all], 1)

    @override
    def residual(self, predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        return self._markers.residual(predicted, measured)

    @staticmethod
    def split(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Markers (..., M, 3) [m] and the rotations of the body there (..., M, 3, 3), from points (..., 4 M, 3)."""
        markers, *displaced = points.chunk(4, -2)
        return markers, torch.stack([copy - markers for copy in displaced], -1)


def by_placement(placement: Placement, placed: torch.Tensor, rotations: torch.Tensor) -> torch.Tensor:
    """Returns derivatives (R, T, M, 3, P) of placed markers by the offsets, the shift and the rotation vector.

    R(w + dw) = R(J dw) R(w), with J the left Jacobian of SO(3).

    Args:
        placement: at which they are taken.
        placed: (R, T, M, 3) markers with it [m].
        rotations: (R, T, M, 3, 3) of the body at the markers.
    """
    count, eye = placed.shape[-2], torch.eye(3, dtype=placed.dtype, device=placed.device)
    turn = replace(placement, shift=torch.zeros_like(placement.shift), centre=torch.zeros_like(placement.centre))
    rotation, angle = turn.apply(eye).T, placement.turn.norm()
    cross = torch.linalg.cross(placement.turn.expand(3, 3), eye, dim=-1).T
    first, second = 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0  # series for small angles
    jacobian = eye + first * cross + second * cross @ cross
    columns = placed.new_zeros(*placed.shape, 3 * count + 6)
    for marker in range(count):
        columns[..., marker, :, 3 * marker : 3 * marker + 3] = rotation @ rotations[..., marker, :, :]
    columns[..., -6:-3] = eye
    arm = (placed - placement.shift - placement.centre)[..., None]
    columns[..., -3:] = torch.linalg.cross(jacobian.expand(*arm.shape[:-1], 3), arm.expand(*arm.shape[:-1], 3), dim=-2)
    return columns


@dataclass(frozen=True)
class Nuisances:
    """The best places and delays for one set of parameters.

    Attributes:
        columns: (R, D, K) derivatives of the weighted residuals of each group, in standard deviations of the prior;
            empty if nothing was fitted.
        rows: (K,) weighted residuals of the prior.
        sessions: placement of the markers in each session; empty if it is exact.
        common: placement in a session that is not known.
        moves: (3 M + 6, k) change of the offsets, the shift and the turn of a session by the first k nuisances.
    """

    columns: Sequence[FloatArray] = ()
    rows: FloatArray = field(default_factory=lambda: np.zeros(0))
    sessions: Mapping[str, Placement] = field(default_factory=dict)
    common: Placement | None = None
    moves: Mapping[str, FloatArray] = field(default_factory=dict)

    def plain(self, labels: Sequence[str]) -> dict[str, Any] | None:
        """Returns the placements as JSON data: the common one, and those of the named `sessions`; None without any."""
        if self.common is None:
            return None
        named = {session: placement.plain(labels) for session, placement in self.sessions.items() if session}
        return self.common.plain(labels) | ({"sessions": named} if named else {})


class NuisanceFit:
    """Fits places and delays to simulated points, by Gauss-Newton.

    The unknowns are in standard deviations of the prior: the common placement; what each session's differs from it by,
    if there are several; and the delays of trials whose motion inputs begin, with those of their starts.

    Args:
        replays: groups of trials, whose points are `DisplacedMarkers` where places are uncertain.
        weights: (R,) of each trial's squared errors [1/m^2], by group.
        accuracy: standard deviations of the marker places and of the recording's frame; None: both are exact.
        delay: standard deviation of the delay of motions that inputs begin [s]; zero: they have that of their start.
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
                self._moves[name] = torch.cat([common, *(own * common for own in share)], 1)
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

    def __call__(self, series: Sequence[torch.Tensor], prior_weight: float) -> tuple[list[torch.Tensor], Nuisances]:
        """Residuals with the best places and delays for the first set of parameters, at which the loss is stationary.

        While the weight of the prior is not known, places and delays are nominal.

        Args:
            series: (E, R, T, M or 4 M, 3) simulated points at the frames, by group [m].
            prior_weight: of the squared nuisance parameters in standard deviations.

        Returns:
            (E, R, T, M, 3) by group [m], and what was fitted.
        """
        solution = self._centre.new_zeros(self._count)
        for (_, start), late in zip(self._replays, self._late, strict=True):
            if late is not None:
                solution[late] = start.delay / self._delay
        if self.is_empty or not prior_weight:
            return [self._errors(n, own, solution) for n, own in enumerate(series)], Nuisances()
        first = [own[:1].detach() for own in series]
        with torch.no_grad():
            for _ in range(_TURNS if self._accuracy is not None and self._accuracy.turn else 1):
                solution = self._improved(first, solution, prior_weight, self._places)
            if self._count > self._places:
                solution = self._on_grid(first, solution, prior_weight)
                for _ in range(_STEPS):
                    solution = self._improved(first, solution, prior_weight, self._count)
            columns = [own.flatten(1, 3).double().cpu().numpy() for _, own in self._linearised(first, solution)]
        placed = {name: self._placement(name, solution) for name in self._moves}
        sessions = dict.fromkeys(replay.trials.session for replay, _ in self._replays if placed)
        fitted = Nuisances(
            columns=columns,
            rows=math.sqrt(prior_weight) * solution.double().cpu().numpy(),
            sessions={session: placed[session] for session in sessions},
            common=placed.get(None),
            moves={name: own.double().cpu().numpy() for name, own in self._moves.items() if name is not None},
        )
        return [self._errors(n, own, solution) for n, own in enumerate(series)], fitted

    def _placement(self, session: str | None, solution: torch.Tensor) -> Placement:
        moved = self._moves[session] @ solution[: self._places]
        return Placement(moved[:-6].view(-1, 3), moved[-6:-3], moved[-3:], self._centre)

    def _points(self, number: int, points: torch.Tensor, solution: torch.Tensor) -> torch.Tensor:
        """(E, R, T, M or 4 M, 3) points of a group, later by its delays."""
        late, (replay, start) = self._late[number], self._replays[number]
        if late is None:
            return points
        times, delay = replay.trials.times, self._delay * solution[late] - start.delay
        step, at = float(times[0, 1]), (times - delay[:, None]).clamp_min(0.0).repeat(len(points), 1)
        series, beyond = points.flatten(0, 1), (at - times.max()).clamp_min(0.0)[..., None, None]
        ahead = beyond * (series[:, -1:] - series[:, -2:-1]) / step  # straight on after the last frame
        return (sample(series, at, step) + ahead).unflatten(0, points.shape[:2])

    def _errors(self, number: int, points: torch.Tensor, solution: torch.Tensor) -> torch.Tensor:
        """(E, R, T, M, 3) residuals of a group [m]."""
        replay, points = self._replays[number][0], self._points(number, points, solution)
        if self._accuracy is None:
            return replay.errors(points)
        return replay.errors(self._placement(replay.trials.session, solution).places(points)[0])

    def _linearised(
        self, first: Sequence[torch.Tensor], solution: torch.Tensor
    ) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Weighted residuals (R, T, M, 3) of each group and their derivatives (R, T, M, 3, K)."""
        result = []
        for number, (points, weight) in enumerate(zip(first, self._weights, strict=True)):
            replay, late, root = self._replays[number][0], self._late[number], weight.sqrt()[:, None, None, None]
            errors = self._errors(number, points, solution)[0]
            columns = errors.new_zeros(*errors.shape, self._count)
            if self._accuracy is not None:
                own = self._placement(replay.trials.session, solution)
                placed = own.places(self._points(number, points, solution)[0])
                slopes = by_placement(own, *placed) * replay.trials.seen[..., None, None]
                columns[..., : self._places] = slopes @ self._moves[replay.trials.session]
            if late is not None:
                step, rows = _DIFFERENCE * float(replay.trials.times[0, 1]), torch.arange(len(errors))
                ends = []
                for by in (step, -step):
                    moved = solution.clone()
                    moved[late] += by / self._delay
                    ends.append(self._errors(number, points, moved)[0])
                columns[rows, ..., late.start + rows] = (ends[0] - ends[1]) * self._delay / (2.0 * step)
            result.append((errors * root, columns * root[..., None]))
        return result

    def _improved(
        self, first: Sequence[torch.Tensor], solution: torch.Tensor, prior_weight: float, count: int
    ) -> torch.Tensor:
        """The solution after a step of the first unknowns of a number."""
        normal, right = prior_weight * torch.eye(count).to(solution), torch.zeros_like(solution[:count])
        for residual, columns in self._linearised(first, solution) if count else ():
            jacobian = columns[..., :count].flatten(0, 3)
            normal = normal + jacobian.T @ jacobian
            right = right - jacobian.T @ (residual.flatten() - jacobian @ solution[:count])
        change = torch.linalg.solve(normal, right) - solution[:count]
        change[self._places :].clamp_(-_LONGEST, _LONGEST)
        return torch.cat([solution[:count] + change, solution[count:]])

    def _on_grid(self, first: Sequence[torch.Tensor], solution: torch.Tensor, prior_weight: float) -> torch.Tensor:
        """The solution with the best delays of a grid for each trial."""
        grid, best = torch.linspace(-_FURTHEST, _FURTHEST, _TRIED).to(solution), solution.clone()
        for number, (points, late) in enumerate(zip(first, self._late, strict=True)):
            if late is None:
                continue
            costs = []
            for by in grid:
                moved = solution.clone()
                moved[late] += by
                squares = self._errors(number, points, moved)[0].square().sum((1, 2, 3))
                costs.append(self._weights[number] * squares + prior_weight * moved[late].square())
            best[late] += grid[torch.stack(costs).argmin(0)]
        return best
