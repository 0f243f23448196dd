r"""Recordings that contain less than the marker positions in the frame of the body:
a plane, or the shape alone.

A single camera sees a plane. The markers of a free body, such as a swimming one, have no fixed
frame and give its shape alone. Then both recorded and simulated markers are moved rigidly, frame by
frame, to the best fit with their nominal places (Kabsch 1976), and compared there. Markers x become
R^T (x - mean x) + mean o, with the nominal places o and the rotation R that maximises sum
(x_i - mean x) . R (o_i - mean o); in a plane it has the angle atan2(sum (o_i - mean o) x
(x_i - mean x), sum (o_i - mean o) . (x_i - mean x)).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ..core.stepping.rotations import closest_rotation
from ..io.errors import InputError
from .markers import Markers

_AXES = "xyz"
_LINE = 1e-3  # m: markers closer to a line do not determine the rotation about it


@dataclass(frozen=True)
class MarkerView:
    """Which coordinates of m markers the recordings contain.

    Attributes:
        nominal: (m, 3) places on the undeformed body [m].
        plane: the two axes of the body that span the recorded plane, such as ("x", "z"); None for
            all coordinates.
        shape_alone: whether markers are recorded in their own frame (shape alone) rather than in
            that of the body.
        sets: indices of markers that are seen together and share an own frame; all if left out.
            Markers in no set are never seen.

    Raises:
        InputError: axes that are not two of x, y and z, or markers that determine no frame or are
            in two sets.
    """

    nominal: torch.Tensor
    plane: Sequence[str] | None = None
    shape_alone: bool = False
    sets: tuple[tuple[int, ...], ...] = ()

    def __post_init__(self) -> None:
        """Checks the plane and the frame."""
        if self.plane is not None and (len(self.plane) != 2 or len({*self.plane} & {*_AXES}) != 2):
            raise InputError(
                f"markers.plane is {list(self.plane)}: name two of the body's axes x, y and z."
            )
        if not self.shape_alone:
            return
        if self.sets:
            if len(set().union(*self.sets)) < sum(map(len, self.sets)):
                raise InputError(
                    "markers.frame is own, but two trials have some markers in common, and not "
                    "all: they must have the same ones, or none in common."
                )
            _ = self._parts
        elif bool(self._is_degenerate(self.nominal)):
            what = "lie on one line" if self.plane is None else "are at one place"
            raise InputError(
                f"markers.frame is own, but the {len(self.nominal)} markers that are seen "
                f"together {what}, so that they tell no frame: track others as well, or set "
                "markers.frame to body."
            )

    @property
    def is_whole(self) -> bool:
        """Whether recordings contain all coordinates in the frame of the body."""
        return self.plane is None and not self.shape_alone

    @cached_property
    def _parts(self) -> "list[tuple[torch.Tensor, MarkerView]]":
        """Indices of every set, and the view of its markers."""
        device = self.nominal.device
        return [
            (torch.tensor(members, device=device), self.select(members)) for members in self.sets
        ]

    def select(self, chosen: Sequence[int]) -> "MarkerView":
        """Returns the view of some markers, which are seen together."""
        return replace(self, nominal=self.nominal[list(chosen)], sets=())

    @property
    def unseen(self) -> int | None:
        """Index of the axis that is not recorded; None without one."""
        return (
            None
            if self.plane is None
            else next(i for i, axis in enumerate(_AXES) if axis not in self.plane)
        )

    def to(self, like: torch.Tensor) -> "MarkerView":
        """Returns the view on the device and in the precision of a tensor."""
        return replace(self, nominal=self.nominal.to(like))

    def __call__(self, points: torch.Tensor) -> torch.Tensor:
        """Maps positions (..., m, 3) in the frame of the body to recorded ones [m].

        Unseen coordinates are nominal.
        """
        if self.unseen is not None:
            hidden = torch.arange(3, device=points.device) == self.unseen
            points = torch.where(hidden, self.nominal, points)
        if not self.shape_alone or not self.sets:
            return self._in_own_frame(points, points) if self.shape_alone else points
        viewed = points
        for members, part in self._parts:
            viewed = viewed.index_copy(-2, members, part(points.index_select(-2, members)))
        return viewed

    def of_arrays(self, points: ArrayLike) -> NDArray[np.float64]:
        """Applies the view to an array (..., m, 3), NaN where a marker is not seen.

        In an own frame, all markers become NaN where one is not seen or the markers determine no
        frame.
        """
        if self.is_whole:
            return np.asarray(points, dtype=np.float64)
        assert not self.sets, "A trial has the markers of one set."
        positions = torch.as_tensor(np.asarray(points, dtype=np.float64))
        lost = ~positions.isfinite().all(-1, keepdim=True)
        if self.shape_alone:
            lost = lost.any(-2, keepdim=True)
            lost = (
                lost
                | self._is_degenerate(torch.where(lost, self.nominal, positions))[..., None, None]
            )
        return torch.where(
            lost, torch.nan, self(torch.where(lost, self.nominal, positions))
        ).numpy()

    def carried(self, others: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Moves points (..., N, 3) of a body into the own frame
        of its markers (..., m, 3), if they have one [m].
        """
        return (
            self._in_own_frame(replace(self, shape_alone=False)(points), others)
            if self.shape_alone
            else others
        )

    def _in_own_frame(self, markers: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Moves points (..., N, 3) by the best rigid fit
        of markers (..., m, 3) to their nominal places.
        """
        middle, here = self.nominal.mean(-2), markers.mean(-2, keepdim=True)
        nominal, now, moved = self.nominal - middle, markers - here, points - here
        if self.plane is None:
            rotation = closest_rotation((now.mT @ nominal).reshape(-1, 3, 3)).reshape(
                *now.shape[:-2], 3, 3
            )
            return moved @ rotation + middle
        first, second = (_AXES.index(axis) for axis in self.plane)
        across = (now[..., first] * nominal[:, second] - now[..., second] * nominal[:, first]).sum(
            -1
        )
        along = (now[..., first] * nominal[:, first] + now[..., second] * nominal[:, second]).sum(
            -1
        )
        size = torch.hypot(across, along)
        sine, cosine = (across / size)[..., None], (along / size)[..., None]
        turned = list(moved.unbind(-1))
        turned[first] = cosine * moved[..., first] - sine * moved[..., second]
        turned[second] = sine * moved[..., first] + cosine * moved[..., second]
        return torch.stack(turned, -1) + middle

    def _is_degenerate(self, points: torch.Tensor) -> torch.Tensor:
        """Whether points (..., m, 3) do not determine a rotation, (...,) bool."""
        if self.unseen is not None:
            points = points * (torch.arange(3, device=points.device) != self.unseen)
        spread = torch.linalg.svdvals(points - points.mean(-2, keepdim=True))
        needed = 1 if self.plane is None else 0  # index of the singular value that must not vanish
        if spread.shape[-1] <= needed:
            return torch.ones(spread.shape[:-1], dtype=torch.bool)
        return spread[..., needed] <= _LINE


@dataclass(frozen=True)
class ViewedMarkers(Markers):
    """Markers in the view of the recordings."""

    markers: Markers  # in the frame of the body
    view: MarkerView

    @classmethod
    def of(cls, markers: Markers, view: MarkerView) -> Markers:
        """Returns markers in a view; the markers themselves if the view is whole."""
        return markers if view.is_whole else cls(markers.vertices, markers, view)

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        return self.view(self.markers(positions))

    @override
    def moved(self, by: torch.Tensor) -> "ViewedMarkers":
        return replace(self, markers=self.markers.moved(by))
