"""Vertices in planes, slabs and boxes, and cells in boxes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..io.arrays import BoolArray, FloatArray, IntArray
from ..io.errors import MeshError
from .elements import ELEMENTS
from .volume_mesh import Mesh

Extent = float | Sequence[float]  # a coordinate, or a range of coordinates


@dataclass(frozen=True)
class Place:
    """A plane, a slab or a box: each coordinate is free, one value, or a range.

    Raises:
        MeshError: no coordinate is given, or one is not a finite number or an ascending pair.
    """

    x: Extent | None = None  # [m]
    y: Extent | None = None
    z: Extent | None = None
    tolerance: float = 1e-9  # [m]

    def __post_init__(self) -> None:
        """Checks the coordinates."""
        if not self._given:
            raise MeshError("a selection of vertices needs at least one of the coordinates x, y and z")
        for axis, at in self._given.items():
            ends = np.atleast_1d(np.asarray(at, dtype=np.float64))
            if ends.shape not in ((1,), (2,)) or not np.isfinite(ends).all() or ends[-1] < ends[0]:
                raise MeshError(f"a selection of vertices at {axis} = {at}: give one number, or two that rise, in m")

    @property
    def _given(self) -> dict[str, Extent]:
        named = {"x": self.x, "y": self.y, "z": self.z}
        return {axis: at for axis, at in named.items() if at is not None}

    def _spans(self) -> dict[str, tuple[float, float]]:
        return {axis: (float(np.min(at)), float(np.max(at))) for axis, at in self._given.items()}

    def holds(self, points: FloatArray) -> BoolArray:
        """Returns (N,) whether points (N, 3) [m] lie in the place."""
        inside = np.ones(len(points), dtype=bool)
        for axis, (first, last) in self._spans().items():
            along = points[:, "xyz".index(axis)]
            inside &= (along >= first - self.tolerance) & (along <= last + self.tolerance)
        return inside

    def __str__(self) -> str:
        return ", ".join(
            f"{axis} = {first:g}" + (f" to {last:g}" if last > first else "")
            for axis, (first, last) in self._spans().items()
        )


def select_vertices(
    mesh: Mesh, x: Extent | None = None, y: Extent | None = None, z: Extent | None = None, tolerance: float = 1e-9
) -> IntArray:
    """Returns the vertices (S,) in a plane, a slab or a box, sorted.

    Args:
        mesh: The mesh.
        x: A coordinate, or a range of coordinates [m].
        y: Likewise [m].
        z: Likewise [m].
        tolerance: Tolerance of the coordinates [m].

    Raises:
        MeshError: No coordinate or an invalid one, or no vertex lies there.
    """
    place = Place(x, y, z, tolerance)
    chosen = np.flatnonzero(place.holds(mesh.vertices))
    if not len(chosen):
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        axes = [axis for axis, at in zip("xyz", (x, y, z), strict=True) if at is not None]
        there = ", ".join(f"{axis} from {low['xyz'.index(axis)]:g} to {high['xyz'.index(axis)]:g}" for axis in axes)
        raise MeshError(
            f"no vertex lies within {tolerance:g} m of {place} m: the mesh reaches {there} m; give a range for a face "
            f"that is not flat, as in {axes[0]}=[{low['xyz'.index(axes[0])]:.3g}, "
            f"{low['xyz'.index(axes[0])] + 0.1 * float(np.ptp(mesh.vertices[:, 'xyz'.index(axes[0])])):.3g}], or a "
            "larger tolerance"
        )
    return chosen


def select_cells(
    mesh: Mesh,
    x: Sequence[float] = (-np.inf, np.inf),
    y: Sequence[float] = (-np.inf, np.inf),
    z: Sequence[float] = (-np.inf, np.inf),
) -> IntArray:
    """Returns the cells (S,) with centres in a box, given by a range of coordinates along each axis [m].

    Raises:
        MeshError: no cell lies there.
    """
    corners = mesh.cells[:, : ELEMENTS[mesh.element.linear].nodes]
    centres, box = mesh.vertices[corners].mean(axis=1), np.array([x, y, z], dtype=np.float64)
    chosen = ((centres >= box[:, 0]) & (centres <= box[:, 1])).all(axis=1)
    if not chosen.any():
        asked = ", ".join(f"{axis} from {low:g} to {high:g}" for axis, (low, high) in zip("xyz", box, strict=True))
        ranges = zip("xyz", centres.min(axis=0), centres.max(axis=0), strict=True)
        there = ", ".join(f"{axis} from {low:g} to {high:g}" for axis, low, high in ranges)
        raise MeshError(f"no cell has its centre within {asked} m: those of the mesh reach {there} m")
    return np.flatnonzero(chosen)
