"""Where markers sit and how the recording lies, where that is known to millimetres and degrees alone.

A marker sits b_m beside its nominal place on the body, and the frame of the recordings is shifted by t and turned by w
about a centre c, so that of what a simulator shows

    x = c + R(w) (y_m(q; b_m) - c) + t

is observed. All of these are nuisance: a normal distribution around zero says how large they may be, and for each set
of physical parameters they are what leaves the least sum of squares, that of the distribution included (variable
projection, Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from typing_extensions import override

from ..data.markers import Markers
from ..data.observation import Observation

_DIRECTIONS = 3
_ITERATIONS = 4  # as turns of a few degrees are all but linear


@dataclass(frozen=True)
class Accuracy:
    """Standard deviations of what is known beforehand; None for what is known exactly.

    Attributes:
        markers: of each coordinate of a marker's place on the body [m].
        shift: of each coordinate of the recordings' origin [m].
        turn: of each component of the recordings' rotation [rad].
    """

    markers: float | None = None
    shift: float | None = None
    turn: float | None = None


@dataclass(frozen=True)
class Placement:
    """Where markers sit, and how the recordings lie.

    Attributes:
        offsets: (M, 3) of the markers from their nominal places, in the frame of the body at rest [m].
        shift: (3,) of the recordings [m].
        turn: (3,) their rotation vector [rad].
        centre: (3,) about which they are turned [m].
    """

    offsets: torch.Tensor
    shift: torch.Tensor
    turn: torch.Tensor
    centre: torch.Tensor

    def apply(self, points: torch.Tensor) -> torch.Tensor:
        """(..., 3) points of the body as the recordings show them [m]."""
        angle = self.turn.norm()
        axis = self.turn / angle.clamp_min(torch.finfo(angle.dtype).tiny)
        arm = points - self.centre
        across = torch.linalg.cross(axis.expand_as(arm), arm, dim=-1)
        twice = torch.linalg.cross(axis.expand_as(arm), across, dim=-1)  # Rodrigues
        return points + torch.sin(angle) * across + (1.0 - torch.cos(angle)) * twice + self.shift

    def to(self, like: torch.Tensor) -> "Placement":
        """On the device and in the precision of a tensor."""
        return Placement(*(each.to(like) for each in (self.offsets, self.shift, self.turn, self.centre)))

    def plain(self, labels: Sequence[str]) -> dict[str, Any]:
        """As JSON."""
        rest = {"shift": self.shift.tolist(), "turn": self.turn.tolist(), "centre": self.centre.tolist()}
        return {"offsets": dict(zip(labels, self.offsets.tolist(), strict=True)), **rest}

    @classmethod
    def none(cls, count: int, centre: torch.Tensor) -> "Placement":
        """Where M markers are to be."""
        zero = torch.zeros_like(centre)
        return cls(centre.new_zeros(count, 3), zero, zero, centre)

    @classmethod
    def from_plain(cls, found: Mapping[str, Any], labels: Sequence[str]) -> "Placement":
        """Of `plain`."""
        offsets = torch.tensor([found["offsets"][label] for label in labels], dtype=torch.float64)
        rest = (torch.tensor(found[key], dtype=torch.float64) for key in ("shift", "turn", "centre"))
        return cls(offsets, *rest)


@dataclass(frozen=True)
class PlacedMarkers(Markers):
    """Markers as recordings show them."""

    vertices: torch.Tensor
    markers: Markers  # where they sit
    placement: Placement

    @classmethod
    def of(cls, markers: Markers, placement: Placement) -> "PlacedMarkers":
        """Nominal markers, placed."""
        return cls(markers.vertices, markers.moved(placement.offsets), placement)

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        return self.placement.apply(self.markers(positions))


class Stems(Observation):
    """Markers and what moving them by a metre would do, as points of one observation.

    Args:
        markers: nominal ones.
        count: M, how many they are.
    """

    copies = 1 + _DIRECTIONS

    def __init__(self, markers: Markers, count: int) -> None:
        axes = torch.eye(_DIRECTIONS, dtype=torch.float64)
        self._markers = markers
        self._all = [markers, *(markers.moved(axis.expand(count, 3)) for axis in axes)]

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) positions to (B, 4 M, 3) points [m]."""
        return torch.cat([markers(positions) for markers in self._all], 1)

    @override
    def residual(self, shown: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        return self._markers.residual(shown, measured)

    @staticmethod
    def parts(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Markers (..., M, 3) [m] and the rotations of their stems (..., M, 3, 3), of points (..., 4 M, 3)."""
        at, *moved = points.chunk(1 + _DIRECTIONS, -2)
        return at, torch.stack([each - at for each in moved], -1)


def estimate(
    accuracy: Accuracy,
    centre: torch.Tensor,
    errors: Sequence[torch.Tensor],
    seen: Sequence[torch.Tensor],
    points: Sequence[torch.Tensor],
    turns: Sequence[torch.Tensor],
    weights: Sequence[torch.Tensor],
    prior_weight: float,
) -> tuple[Placement, torch.Tensor]:
    """The placement that is the best for one set of physical parameters.

    Args:
        accuracy: what is known beforehand.
        centre: (3,) about which recordings are turned [m].
        errors: of each group of trials, (R, T, M, 3) simulated less observed markers [m], zero where nothing was seen.
        seen: (R, T, M) where something was.
        points: (R, T, M, 3) simulated markers [m].
        turns: (R, T, M, 3, 3) rotations of their stems.
        weights: (R,) of the squares of each trial's errors [1/m^2].
        prior_weight: of the squares of what is estimated over its standard deviations.

    Returns:
        The placement, and (P,) what it is in standard deviations.
    """
    count, like = errors[0].shape[-2], errors[0]
    deviations = [accuracy.markers or 0.0] * (3 * count) + [accuracy.shift or 0.0] * 3 + [accuracy.turn or 0.0] * 3
    scale = like.new_tensor(deviations)
    inside, found = torch.zeros_like(scale), Placement.none(count, centre)
    for _ in range(_ITERATIONS if accuracy.turn else 1):
        normal, right = torch.diag(torch.full_like(scale, prior_weight)), torch.zeros_like(scale)
        for error, there, at, turn, weight in zip(errors, seen, points, turns, weights, strict=True):
            root = weight.sqrt()[:, None, None, None] * there[..., None]  # (R, T, M, 1)
            moved = at + (turn @ found.offsets[..., None])[..., 0]
            shown = found.apply(moved)
            columns = _columns(found, shown, turn) * scale * root[..., None]
            flat = columns.flatten(0, 3)
            left = ((error + shown - at) * root).flatten() - flat @ inside
            normal = normal + flat.T @ flat
            right = right - flat.T @ left
        inside = torch.linalg.solve(normal, right)
        x = scale * inside
        found = Placement(x[:-6].view(count, 3), x[-6:-3], x[-3:], centre)
    return found, inside


def _columns(placement: Placement, shown: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
    """(R, T, M, 3, P) derivatives of shown markers by the offsets, the shift and the rotation vector.

    R(w + dw) = R(J dw) R(w), J the left Jacobian of the rotations.
    """
    count, eye = shown.shape[-2], torch.eye(3, dtype=shown.dtype, device=shown.device)
    turn = replace(placement, shift=torch.zeros_like(placement.shift), centre=torch.zeros_like(placement.centre))
    rotation, angle = turn.apply(eye).T, placement.turn.norm()
    cross = torch.linalg.cross(placement.turn.expand(3, 3), eye, dim=-1).T
    first, second = 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0  # of angles far below one
    jacobian = eye + first * cross + second * cross @ cross
    columns = shown.new_zeros(*shown.shape, 3 * count + 6)
    for marker in range(count):
        columns[..., marker, :, 3 * marker : 3 * marker + 3] = rotation @ turns[..., marker, :, :]
    columns[..., -6:-3] = eye
    arm = (shown - placement.shift - placement.centre)[..., None]
    columns[..., -3:] = torch.linalg.cross(jacobian.expand(*arm.shape[:-1], 3), arm.expand(*arm.shape[:-1], 3), dim=-2)
    return columns
