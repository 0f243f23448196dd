"""Errors of the marker places on the body and of the recording's frame,
estimated beside the physical parameters.

Marker m sits at an offset b_m from its nominal place on the body, and the frame of the recordings
is shifted by t and rotated by w about a centre c, so that a simulated marker y_m is observed at

    x = c + R(w) (y_m(q; b_m) - c) + t

All of these are nuisance parameters with a normal prior around zero (`identification.nuisances`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from typing_extensions import TypedDict, override

from ..data.markers import Markers, Observation
from ..io.arrays import FloatArray
from ..io.errors import InputError
from .replay import Replay
from .start import Start


@dataclass(frozen=True)
class Accuracy:
    """Prior standard deviations; None for what is known exactly.

    Attributes:
        markers: of each coordinate of a marker's place on the body [m].
        shift: of each coordinate of the origin of the recording's frame [m].
        turn: of each component of its rotation vector [rad].
        between_sessions: of the placement of a session from the common one, relative to the
            deviations above.
        mounting: of each component of the rotation vector of a rigid body on the part that carries
            it [rad]; its position has that of markers.
        rigid_bodies: index of the first of the four points of each rigid body, and these on the
            undeformed body, (4, 3) relative to their mean [m].
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
        """(3 M + 6, K) offsets, shift and turn by one standard deviation,
        for a tensor (..., M, 3) like the markers.

        A marker has three offsets; the points of a rigid body are shifted and turned together, to
        first order.
        """
        count = like.shape[-2]
        sizes = (
            [self.markers or 0.0] * (3 * count) + [self.shift or 0.0] * 3 + [self.turn or 0.0] * 3
        )
        directions = torch.diag(like.new_tensor(sizes))
        kept = torch.ones(len(sizes), dtype=torch.bool)
        for first, corners in self.rigid_bodies:
            rows, eye = slice(3 * first, 3 * first + 12), torch.eye(3).to(like)
            arms = like.new_tensor(corners)[:, None].expand(4, 3, 3)
            # (4, 3, 3) of a point, by the rotation
            turned = torch.linalg.cross(eye.expand(4, 3, 3), arms, dim=-1).mT
            directions[rows, rows] = 0.0
            directions[rows, 3 * first : 3 * first + 3] = (self.markers or 0.0) * eye.repeat(4, 1)
            directions[rows, 3 * first + 3 : 3 * first + 6] = (
                self.mounting or 0.0
            ) * turned.flatten(0, 1)
            kept[3 * first + 6 : 3 * first + 12] = False
        return directions[:, kept.to(like.device)]

    def of_new_session(self, like: torch.Tensor, sessions: int) -> torch.Tensor:
        """Standard deviations of a new session's placement from the common one of n sessions.

        The session's own deviation has the variance b^2 s^2, with b of `between_sessions` and s of
        all. That of the common placement, of which every exactly known session is one draw, is
        s^2 / (1 + n / b^2).

        Args:
            like: (..., M, 3) like the markers.
            sessions: n, of which the placements were identified.

        Returns:
            (3 M + 6, K), as `directions`.
        """
        variance = self.between_sessions**2 + 1.0 / (1.0 + sessions / self.between_sessions**2)
        return math.sqrt(variance) * self.directions(like)


class PlainPlacement(TypedDict):
    """A `Placement` as JSON data."""

    offsets: dict[str, list[float]]  # (3,) by marker
    shift: list[float]
    turn: list[float]
    centre: list[float]


class PlainPlacements(PlainPlacement, total=False):
    """The common placement as JSON data, and those of sessions."""

    sessions: dict[str, PlainPlacement]
    new_session: list[list[float]]  # `Accuracy.of_new_session`


@dataclass(frozen=True)
class Placement:
    """Marker places on the body, and the frame of the recordings.

    Attributes:
        offsets: (M, 3) of the markers from their nominal places, in the frame of the body at rest
            [m].
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
        """Returns placed markers (..., M, 3) [m] and the body's rotations there,
        from points of `DisplacedMarkers`.
        """
        markers, rotations = DisplacedMarkers.split(points)
        return self.apply(markers + (rotations @ self.offsets[..., None])[..., 0]), rotations

    def plain(self, labels: Sequence[str]) -> PlainPlacement:
        """Returns the placement as JSON data."""
        offsets = dict(zip(labels, self.offsets.tolist(), strict=True))
        return {
            "offsets": offsets,
            "shift": self.shift.tolist(),
            "turn": self.turn.tolist(),
            "centre": self.centre.tolist(),
        }

    @classmethod
    def none(cls, count: int, centre: torch.Tensor) -> "Placement":
        """Returns the nominal placement of M markers."""
        zero = torch.zeros_like(centre)
        return cls(centre.new_zeros(count, 3), zero, zero, centre)

    @classmethod
    def from_plain(cls, plain: PlainPlacement, labels: Sequence[str]) -> "Placement":
        """Returns the placement that `plain` wrote."""
        offsets = torch.tensor([plain["offsets"][label] for label in labels], dtype=torch.float64)
        frame = (
            torch.tensor(x, dtype=torch.float64)
            for x in (plain["shift"], plain["turn"], plain["centre"])
        )
        return cls(offsets, *frame)


def placement_of(plain: PlainPlacements, labels: Sequence[str], session: str = "") -> Placement:
    """Returns the placement of a session from `Nuisances.plain`.

    The common one for a session that is not known.
    """
    return Placement.from_plain(plain.get("sessions", {}).get(session, plain), labels)


@dataclass(frozen=True)
class PlacedMarkers(Markers):
    """Markers at their placed offsets, in the frame of the recordings."""

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

    Markers are linear in their offsets, so that the copies give the derivative by an offset: the
    rotation of the body at the marker.

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
            raise InputError(
                "where the markers sit can be identified of markers alone: leave "
                "identify.placement out."
            )
        observe = cls(replay.observe, replay.trials.observed.shape[2])
        shift = None if start.shift is None else start.shift.repeat(1, len(observe._all), 1)
        return replay.changed(observe=observe), replace(start, shift=shift)

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) positions to (B, 4 M, 3) points [m]."""
        return torch.cat([markers(positions) for markers in self._all], 1)

    @override
    def residual(self, predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        return self._markers.residual(predicted, measured)

    @staticmethod
    def split(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Markers (..., M, 3) [m] and the rotations of the body there (..., M, 3, 3),
        from points (..., 4 M, 3).
        """
        markers, *displaced = points.chunk(4, -2)
        return markers, torch.stack([copy - markers for copy in displaced], -1)


def by_placement(
    placement: Placement, placed: torch.Tensor, rotations: torch.Tensor
) -> torch.Tensor:
    """Returns derivatives (R, T, M, 3, P) of placed markers by the offsets,
    the shift and the rotation vector.

    R(w + dw) = R(J dw) R(w), with J the left Jacobian of SO(3).

    Args:
        placement: at which they are taken.
        placed: (R, T, M, 3) markers with it [m].
        rotations: (R, T, M, 3, 3) of the body at the markers.
    """
    count, eye = placed.shape[-2], torch.eye(3, dtype=placed.dtype, device=placed.device)
    turn = replace(
        placement,
        shift=torch.zeros_like(placement.shift),
        centre=torch.zeros_like(placement.centre),
    )
    rotation, angle = turn.apply(eye).T, placement.turn.norm()
    cross = torch.linalg.cross(placement.turn.expand(3, 3), eye, dim=-1).T
    first, second = 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0  # series for small angles
    jacobian = eye + first * cross + second * cross @ cross
    columns = placed.new_zeros(*placed.shape, 3 * count + 6)
    for marker in range(count):
        columns[..., marker, :, 3 * marker : 3 * marker + 3] = (
            rotation @ rotations[..., marker, :, :]
        )
    columns[..., -6:-3] = eye
    arm = (placed - placement.shift - placement.centre)[..., None]
    columns[..., -3:] = torch.linalg.cross(
        jacobian.expand(*arm.shape[:-1], 3), arm.expand(*arm.shape[:-1], 3), dim=-2
    )
    return columns
