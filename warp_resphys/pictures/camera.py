r"""A camera whose lens and place are known up to corrections.

A body's point X [m] is seen at the pixel p = lens(M (R (X - c) + c + t)): M is the given pose of the camera, from the
axes of the scene to its own (x right, y down, z forward), R = exp([w]x) a small turn about a point c of the body's
clamp, and t a shift, by which the body stands elsewhere before the camera than assumed. The lens (`data.camera.Lens`)
is corrected by a factor on its focal lengths and a shift of its principal point. A turn of the camera by w about c, and
a shift, are the same as those of the body, so that R and t stand for errors of both. The same equation, solved for X,
takes pixels with a depth back to the scene, and without a lens the points of a scan, of whose axes M is the pose.

`tests/pictures/test_placed_camera.py` compares the derivatives with differences.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

import torch

from ..data.camera import Lens, projected
from ..io.errors import InputError
from ..stepping.rotations import rotations

SHIFTS: Final = ("camera_shift_1", "camera_shift_2", "camera_shift_3")  # m
TURNS: Final = ("camera_turn_1", "camera_turn_2", "camera_turn_3")  # rad
FOCAL: Final = "focal_factor"
PRINCIPAL: Final = ("principal_point_1", "principal_point_2")  # px
PLACES: Final = (*SHIFTS, *TURNS)
CORRECTIONS: Final = (*PLACES, FOCAL, *PRINCIPAL)
_NEUTRAL: Final = (0.0,) * 6 + (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class PlacedCamera:
    """A lens, its pose, and the point about which the body may be turned (equations in the module's docstring).

    Raises:
        InputError: a pose of another shape, or one that is no rigid motion.
    """

    lens: Lens | None  # None for the axes of a scan, which has no pictures
    pose: torch.Tensor  # (4, 4) M, from the scene's axes to those of the camera or scan [-, m]
    centre: torch.Tensor  # (3,) c [m]

    def __post_init__(self) -> None:
        """Converts arrays, and checks the pose."""
        for name in ("pose", "centre"):
            object.__setattr__(self, name, torch.as_tensor(getattr(self, name), dtype=torch.float64))
        if self.pose.shape != (4, 4):
            raise InputError(f"the pose of a camera has shape {tuple(self.pose.shape)}: world_to_camera is (4, 4).")
        turn = self.pose[:3, :3]
        if not torch.allclose(turn @ turn.mT, torch.eye(3, dtype=turn.dtype), atol=1e-3) or torch.det(turn) < 0.0:
            raise InputError(
                "the pose of a camera is no rotation with a shift (world_to_camera, row-major, right-handed): check "
                "its rows."
            )

    @staticmethod
    def corrections(values: Mapping[str, float]) -> torch.Tensor:
        """(9,) corrections in the order of `CORRECTIONS`, from their values by name; none for those left out."""
        pairs = zip(CORRECTIONS, _NEUTRAL, strict=True)
        return torch.tensor([values.get(name, neutral) for name, neutral in pairs], dtype=torch.float64)

    def seen_from(self, points: torch.Tensor, corrections: torch.Tensor) -> torch.Tensor:
        """Returns points (..., 3) of the scene in the axes of the camera, with corrections (9,) or (..., 9) [m]."""
        away = (rotations(corrections[..., 3:6]) @ (points - self.centre)[..., None])[..., 0]
        return (away + self.centre + corrections[..., :3]) @ self.pose[:3, :3].mT + self.pose[:3, 3]

    def _seen_through(self) -> tuple[Lens, torch.Tensor]:
        """The lens, and its principal point (2,) [px]."""
        assert self.lens is not None
        return self.lens, self.lens.matrix[:2, 2].double()

    def pixels(self, points: torch.Tensor, corrections: torch.Tensor) -> torch.Tensor:
        """Returns pixels (..., 2) of points (..., 3) [m], with corrections (9,) or (..., 9); NaN behind the camera."""
        return self._pixels_seen(self.seen_from(points, corrections), corrections)

    def _pixels_seen(self, seen: torch.Tensor, corrections: torch.Tensor) -> torch.Tensor:
        """Returns pixels (..., 2) of points (..., 3) in the axes of the camera [m]."""
        lens, middle = self._seen_through()
        return middle + corrections[..., 7:] + corrections[..., 6:7] * (projected(seen, lens) - middle)

    def located(self, measured: torch.Tensor, corrections: torch.Tensor) -> torch.Tensor:
        """Returns points (..., 3) in the axes of the scene [m], with corrections (9,) or (..., 9).

        Args:
            measured: (..., 3) pixels and depths along the axis of the lens [px, px, m]; without a lens, points in the
                axes of the scan [m].
            corrections: see above.
        """
        away = measured
        if self.lens is not None:
            lens, middle = self._seen_through()
            rays = lens.rays(middle + (measured[..., :2] - middle - corrections[..., 7:]) / corrections[..., 6:7])
            away = rays * measured[..., 2:]
        away = (away - self.pose[:3, 3]) @ self.pose[:3, :3] - self.centre - corrections[..., :3]
        return (rotations(corrections[..., 3:6]).mT @ away[..., None])[..., 0] + self.centre

    def millimetres(self, corrections: torch.Tensor) -> float:
        """Length that a pixel shows at a depth of 1 m, with corrections (9,) [mm]."""
        return 1e3 / float(corrections[6] * self._seen_through()[0].matrix[:2, :2].diagonal().mean())

    def derivative(self, points: torch.Tensor, corrections: torch.Tensor, tangents: torch.Tensor) -> torch.Tensor:
        """Returns derivatives (K + 9, P, 2) of pixels, by K motions of the points and by the corrections [px].

        Args:
            points: (P, 3) [m].
            corrections: (9,).
            tangents: (K, P, 3) motions of the points by K parameters [m].
        """
        turn = rotations(corrections[3:6])
        seen = self.seen_from(points, corrections)
        (by_seen,) = jacobians(partial(self._pixels_seen, corrections=corrections), seen)
        by_place = by_seen @ self.pose[:3, :3]
        turned = torch.autograd.functional.jacobian(rotations, corrections[3:6])  # (3, 3, 3)
        by_turn = torch.einsum("ijk,pj->pik", turned, points - self.centre)
        lens, middle = self._seen_through()
        by_scale = (projected(seen, lens) - middle)[..., None]
        by_shift = torch.eye(2, dtype=points.dtype).expand(len(points), 2, 2)
        by_corrections = torch.cat([by_place, by_place @ by_turn, by_scale, by_shift], -1)
        return torch.cat([torch.einsum("pij,kpj->kpi", by_place @ turn, tangents), by_corrections.permute(2, 0, 1)])

    def located_by(self, measured: torch.Tensor, corrections: torch.Tensor) -> torch.Tensor:
        """Returns derivatives (9, P, 3) of located points (P, 3) by the corrections (9,) [m]."""
        return jacobians(self.located, measured, corrections.expand(len(measured), -1))[1].permute(2, 0, 1)


def jacobians(function: Callable[..., torch.Tensor], *inputs: torch.Tensor) -> list[torch.Tensor]:
    """Jacobians (P, D, C) of a function (P, D) of P rows by each of its inputs (P, C)."""
    with torch.enable_grad():
        own = [values.detach().clone().requires_grad_() for values in inputs]
        result = function(*own)
        rows = [torch.autograd.grad(column.sum(), own, retain_graph=True) for column in result.unbind(-1)]
    return [torch.stack(parts, 1) for parts in zip(*rows, strict=True)]
