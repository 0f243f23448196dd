"""Points of a body's surface without identity: scans, and depth images.

Their distances from a simulated body.

A measured point is compared with the closest point of the deformed surface. Its distance is
differentiated along the line between the two, on which a shift of the closest point within the
surface has no effect to first order (Besl and McKay 1992; with plane triangles this is the
point-to-plane distance of Chen and Medioni 1992, except at edges). Only triangles on the side from
which a point was seen are compared with it: towards the camera of a depth image, or towards the
outer normal of a scanned surface. Parts of the body that no point shows do not count.

Outliers hardly matter, by the robust loss of `picture_misfit`, and points beyond a reach not at
all; before that, most are left out by `Cloud.around`.

`tests/pictures/test_clouds.py` compares distances with closed forms, and derivatives with
differences.
"""

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
import torch
from scipy.spatial import cKDTree

from ..core.mesh.surface import closest_of, closest_points
from ..core.mesh.volume_mesh import Mesh
from ..data.camera import PlacedCamera
from ..io.arrays import FloatArray, IntArray
from ..io.errors import InputError
from .outlines import Mask

_STRAY: Final = (
    1.0  # % of the points that may lie far away in a direction, when their extent is measured
)
_LEAST: Final = 20  # points on a body
_NEIGHBOURS: Final = 8  # of a point
# Distance of the last of these, over the median of all points, beyond which it is an outlier.
_ISOLATED: Final = 3.0
_LONGER: Final = 1.2  # of the length of a body: what it may be stretched to
_SIZES: Final = (0.05, 200.0)  # of a cloud with its background, over that of the body


@dataclass(frozen=True)
class Cloud:
    """Measured points, in the axes of a scan or as pixels with depths (`PlacedCamera.located`)."""

    measured: FloatArray  # (P, 3) points [m], or pixels and depths [px, px, m]
    outside: FloatArray | None = (
        None  # (P, 3) another place towards which the surface faces; None where not known
    )
    noise: float = 1e-3  # standard deviation of a distance [m]
    reach: float = 0.05  # distance from which points have no effect [m]

    @classmethod
    def of_depth(cls, depth: FloatArray, mask: Mask | None = None) -> Self:
        """Returns the points of a depth image.

        Args:
            depth: (H, W) along the axis of the lens, zero or not finite where there is none [m].
            mask: (H, W) whether a pixel shows the body; all of them, if left out.
        """
        seen = np.isfinite(depth) & (depth > 0.0) & (True if mask is None else mask)
        rows, columns = np.nonzero(seen)
        measured = np.stack([columns, rows, depth[seen]], 1).astype(np.float64)
        return cls(measured, measured * (1.0, 1.0, 0.0))  # at depth zero is the camera

    def around(
        self, camera: PlacedCamera, mesh: Mesh, clamped: IntArray, count: int = 1000, seed: int = 0
    ) -> Self:
        """Returns at most a number of points that may be of a body,
        in their order along the longest axis.

        Left out are points farther from the clamp than the body is long, isolated ones, and those
        that are closest to a clamp of the undeformed body. A choice that followed the body would
        let it evade points.

        Args:
            camera: by which they are located, about the centre of the body's clamp.
            mesh: undeformed body.
            clamped: (D,) vertices in clamps.
            count: number of points.
            seed: of the choice.

        Raises:
            InputError: hardly a point may be of the body, or the cloud has another unit of length.
        """
        centre, vertices = camera.centre.numpy(), mesh.vertices
        places = camera.located(
            torch.as_tensor(self.measured), PlacedCamera.corrections({})
        ).numpy()
        length = float(np.linalg.norm(vertices - centre, axis=1).max())
        known = places[np.isfinite(places).all(1)]  # NaN where a lens cannot see
        away = np.linalg.norm(places - centre, axis=1)
        close = np.flatnonzero(away < _LONGER * length + self.reach)
        if not len(known):
            raise InputError(
                "none of its points is in the view of its lens: check the lens (data.lens)."
            )
        ends = np.percentile(known, [_STRAY, 100.0 - _STRAY], axis=0)
        size, extent = (
            float(np.linalg.norm(np.ptp(points, axis=0))) for points in (ends, vertices)
        )
        if len(close) < _LEAST or not _SIZES[0] < size / extent < _SIZES[1]:
            raise InputError(
                f"{len(close)} of its {len(places)} points are close enough to the clamp to be "
                f"of the body; they are {size:.3g} m across and {np.nanmedian(away):.3g} m from "
                f"the clamp, and the body is {extent:.3g} m across: check the unit "
                "(data.cloud.units of a scan, data.cloud.depth_unit of a depth image) and the "
                "pose (world_to_cloud, world_to_camera)."
            )
        spacing = cKDTree(places[close]).query(places[close], _NEIGHBOURS + 1)[0][:, -1]
        close = close[spacing <= _ISOLATED * np.median(spacing)]
        if len(close) > count:
            close = np.random.default_rng(seed).choice(close, count, replace=False)
        close = close[~np.isin(closest_points(mesh, places[close]).triangles, clamped).all(1)]
        if len(close) < _LEAST:
            raise InputError(
                f"{len(close)} of its {len(places)} points are left without clamp, background "
                "and isolated ones: check the directions of its pose (world_to_cloud, "
                "world_to_camera)."
            )
        longest = np.linalg.eigh(np.cov(places[close].T))[1][:, -1]
        chosen = close[np.argsort(places[close] @ longest)]
        outside = None if self.outside is None else self.outside[chosen]
        return replace(self, measured=self.measured[chosen], outside=outside)

    def distances(
        self, camera: PlacedCamera, corrections: torch.Tensor, triangles: IntArray, q: torch.Tensor
    ) -> "CloudDistances":
        """Returns the distances from a surface.

        Args:
            camera: by which the points are located.
            corrections: (9,) of it.
            triangles: (F, 3) of the surface.
            q: (N, 3) vertices [m].
        """
        import trimesh

        vertices, towards = q.double().cpu().numpy(), None
        places = camera.located(torch.as_tensor(self.measured), corrections).numpy()
        if self.outside is not None:
            towards = camera.located(torch.as_tensor(self.outside), corrections).numpy() - places
        closest = closest_of(triangles, vertices, places, towards)
        offset = places - closest.points
        length = np.maximum(np.abs(closest.distances), 1e-12)[:, None]
        directions = np.where(
            length > 1e-9, np.sign(closest.distances)[:, None] * offset / length, closest.normals
        )
        shares = trimesh.triangles.points_to_barycentric(
            vertices[closest.triangles], closest.points
        )
        return CloudDistances(
            places, closest.triangles, np.asarray(shares), closest.distances, directions
        )


@dataclass(frozen=True)
class CloudDistances:
    """The closest points of a body's surface to P points of a cloud."""

    places: FloatArray  # (P, 3) of the points in the axes of the scene [m]
    triangles: IntArray  # (P, 3) vertices of the closest triangle
    shares: FloatArray  # (P, 3) of these vertices in the closest point
    distances: FloatArray  # (P,) negative inside the body [m]
    directions: FloatArray  # (P, 3) gradient of the distance

    def moved(self, tangents: torch.Tensor) -> FloatArray:
        """Returns derivatives (K, P) of the distances by K motions (K, N, 3) of vertices [m]."""
        at = torch.einsum(
            "kpci,pc->kpi",
            tangents[:, torch.as_tensor(self.triangles)],
            torch.as_tensor(self.shares),
        )
        return -np.einsum("kpi,pi->kp", at.numpy(), self.directions)
