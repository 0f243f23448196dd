"""Surfaces of the geoms of a MuJoCo model, to draw an arm beside the robots that it carries."""

from typing import Any, Final

import numpy as np

from ..io.arrays import FloatArray, IntArray
from .mounting_body import mujoco_package

_CORNERS: Final = 48  # of a circle


class GeomSurfaces:
    """Surfaces of the spheres, capsules, cylinders and boxes of a model; other geoms are left out.

    Args:
        model: `mujoco.MjModel`.

    Attributes:
        triangles: (S, 3) of all of them.
    """

    def __init__(self, model: Any) -> None:
        self._points = dict[int, FloatArray]()
        triangles, first = [np.zeros((0, 3), dtype=np.int64)], 0
        for geom, size in enumerate(model.geom_size):
            solid = _solid(int(model.geom_type[geom]), *size)
            if solid is not None:
                self._points[geom] = np.asarray(solid.vertices - solid.bounds.mean(axis=0))
                triangles.append(np.asarray(solid.faces) + first)
                first += len(solid.vertices)
        self.triangles: IntArray = np.concatenate(triangles)

    def points(self, data: Any) -> FloatArray:
        """Returns the corners (P, 3) of surfaces where the geoms are in a `mujoco.MjData` [m]."""
        turns, places = data.geom_xmat.reshape(-1, 3, 3), data.geom_xpos
        return np.concatenate(
            [x @ turns[geom].T + places[geom] for geom, x in self._points.items()]
        )


def _solid(kind: int, x: float, y: float, z: float) -> Any:
    """Returns the `trimesh.Trimesh` of a geom, or None."""
    import trimesh

    kinds, of = mujoco_package().mjtGeom, trimesh.creation
    if kind == kinds.mjGEOM_BOX:
        return of.box((2.0 * x, 2.0 * y, 2.0 * z))
    if kind == kinds.mjGEOM_CYLINDER:
        return of.cylinder(x, 2.0 * y, sections=_CORNERS)
    if kind == kinds.mjGEOM_CAPSULE:
        return of.capsule(2.0 * y, x, count=(_CORNERS // 2, _CORNERS))
    return of.uv_sphere(x, count=(_CORNERS // 2, _CORNERS)) if kind == kinds.mjGEOM_SPHERE else None
