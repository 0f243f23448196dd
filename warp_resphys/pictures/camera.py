r"""A camera whose lens and place are known up to corrections.

A body's point X [m] is seen at the pixel p = lens(M (R (X - c) + c + t)): M is the given pose of the camera, from the
axes of the scene to its own (x right, y down, z forward), R = exp([w]x) a small turn about a point c of the body's
clamp, and t a shift, by which the body stands elsewhere before the camera than assumed. The lens (`data.camera.Lens`)
is corrected by a factor on its focal lengths and a shift of its principal point. A turn of the camera by w about c, and
a shift, are the same as those of the body, so that R and t stand for errors of both.

`tests/pictures/test_placed_camera.py` compares the derivatives with differences.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import torch

from ..data.camera import Lens, projected
from ..dynamics.frames import rotations
from ..io.errors import InputError

SHIFTS: Final = ("camera_shift_1", "camera_shift_2", "camera_shift_3")  # m
TURNS: Final = ("camera_turn_1", "camera_turn_2", "camera_turn_3")  # rad
FOCAL: Final = "focal_factor"
PRINCIPAL: Final = ("principal_point_1", "principal_point_2")  # px
CORRECTIONS: Final = (*SHIFTS, *TURNS, FOCAL, *PRINCIPAL)
_NEUTRAL: Final = (0.0,) * 6 + (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class PlacedCamera:
    """A lens, its pose, and the point about which the body may be turned (equations in the module's docstring).

    Raises:
        InputError: a pose of another shape, or one that is no rigid motion.
    """

    lens: Lens
    pose: torch.Tensor  # (4, 4) M, from the scene's axes to those of the camera [-, m]
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

    def pixels(self, points: torch.Tensor, corrections: torch.Tensor) -> torch.Tensor:
        """Returns pixels (..., 2) of points (..., 3) [m], with corrections (9,) or (..., 9); NaN behind the camera."""
        middle = self.lens.matrix[:2, 2].to(points)
        seen = projected(self.seen_from(points, corrections), self.lens)
        return middle + corrections[..., 7:] + corrections[..., 6:7] * (seen - middle)

    def derivative(self, points: torch.Tensor, corrections: torch.Tensor, tangents: torch.Tensor) -> torch.Tensor:
        """Returns derivatives (K + 9, P, 2) of pixels, by K motions of the points and by the corrections [px].

        Args:
            points: (P, 3) [m].
            corrections: (9,).
            tangents: (K, P, 3) motions of the points by K parameters [m].
        """
        with torch.enable_grad():
            at, own = points.detach().requires_grad_(), corrections.expand(len(points), -1).clone().requires_grad_()
            seen = self.pixels(at, own)
            rows = [torch.autograd.grad(seen[:, axis].sum(), (at, own), retain_graph=True) for axis in (0, 1)]
        by_points, by_corrections = (torch.stack(own, 1) for own in zip(*rows, strict=True))  # (P, 2, 3) and (P, 2, 9)
        return torch.cat([torch.einsum("pij,kpj->kpi", by_points, tangents), by_corrections.permute(2, 0, 1)])
