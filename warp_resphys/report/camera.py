"""Views of bodies: their axes and their size."""

from typing import Final

import numpy as np

from ..mesh.mesh import Mesh
from .render import FloatArray, IntArray, view_axes

_FRAME: Final = 0.06  # Margin around the points in a view, over their longer side.
_TILT: Final = (0.30, 0.30)  # Of the view, to the right and upwards.
_HANGING: Final = 0.7  # Least cosine between gravity and the axis of a hanging body.
_LEVEL: Final = 1.2  # Tilt of the view of a path in a level plane, towards its near side.
_UPRIGHT: Final = 0.3  # Tilt of the view of a path in an upright plane, upwards.


def upwards(gravity: FloatArray) -> FloatArray:
    """Return the direction (3,) against gravity; z where there is no gravity."""
    length = float(np.linalg.norm(gravity))
    return -gravity / length if length > 0.0 else np.array([0.0, 0.0, 1.0])


def hangs(mesh: Mesh, fixed: IntArray, gravity: FloatArray) -> tuple[bool, FloatArray]:
    """Return whether a body hangs from its clamp, and the distances (N,) of its vertices from the clamp [m]."""
    start = mesh.vertices[fixed].mean(axis=0) if len(fixed) else mesh.vertices[0]
    away = mesh.vertices - start
    axis = away.mean(axis=0)
    size = float(np.linalg.norm(axis) * np.linalg.norm(gravity))
    return bool(size > 0.0 and axis @ gravity > _HANGING * size), np.linalg.norm(away, axis=1)


def motion_axes(gravity: FloatArray, positions: FloatArray) -> FloatArray:
    """Return axes (3, 3) as `view_axes`, whose right is the direction of largest extent or motion across gravity.

    Args:
        gravity: (3,) direction of gravity; -z is taken for zero.
        positions: (T, N, 3) [m], the first frame at rest; NaN is left out.
    """
    up = upwards(gravity)
    points = positions[np.isfinite(positions).all(axis=2)]
    flat = points - np.outer(points @ up, up)
    _, _, directions = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    right = directions[0] - (directions[0] @ up) * up
    right /= np.linalg.norm(right)
    moved = np.nanmax(np.linalg.norm(positions - positions[0], axis=2), axis=0)  # (N,)
    towards_end = moved @ (positions[0] - positions[0].mean(axis=0))
    right = -right if towards_end @ right < 0.0 else right
    return view_axes(np.cross(right, up) + _TILT[0] * right + _TILT[1] * up, up)


def axes_from_below(axes: FloatArray, gravity: FloatArray) -> FloatArray:
    """Return axes (3, 3) of a view from below with the same right as the given axes.

    Args:
        axes: (3, 3) of a view in which gravity points down or away.
        gravity: (3,) direction of gravity; -z is taken for zero.
    """
    towards = -upwards(gravity)
    return np.stack([axes[0], np.cross(towards, axes[0]), towards])


def path_axes(plane: FloatArray, gravity: FloatArray) -> FloatArray:
    """Return axes (3, 3) as `view_axes`, in which letters in a plane are readable.

    Args:
        plane: (2, 3) directions to the right and upwards in the plane.
        gravity: (3,) direction of gravity.
    """
    up, normal = upwards(gravity), np.cross(*plane)
    normal /= np.linalg.norm(normal)
    level = float(normal @ up)
    near = plane[1] / np.linalg.norm(plane[1])
    return view_axes(normal - _LEVEL * level * near + _UPRIGHT * (1.0 - level**2) * up, up)


def frame_of(points: FloatArray, axes: FloatArray, margin: float = _FRAME) -> tuple[FloatArray, FloatArray]:
    """Return the middle (3,) of points (P, 3), and half the width and height (2,) of a view that contains them [m].

    Args:
        points: [m]; those that are not finite are left out.
        axes: (3, 3) of the view.
        margin: On each side, over the longer side of the points.
    """
    turned = points[np.isfinite(points).all(axis=1)] @ axes.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    extent = (high - low)[:2] + 2.0 * margin * (high - low)[:2].max()
    return 0.5 * (low + high) @ axes, 0.5 * extent


def picture_size(half: FloatArray, longer_side: float) -> list[int]:
    """Return width and height [px] of a picture of a view, from half its width and height (2,) [m]."""
    return [int(side) for side in np.ceil(longer_side * half / half.max())]


def height_of(half: FloatArray, size: tuple[int, int]) -> float:
    """Return half the height of a view of a size [px] that contains half a width and height (2,)."""
    return float(max(half[1], half[0] * size[1] / size[0]))
