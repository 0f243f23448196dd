r"""Observations, such as markers: differentiable maps from vertices of a body to M measured points.

An observation predicts the measurement of a sensor from positions, and gives the residual of a
measurement. The simulator is compared with recordings by these two alone, in `learning.replay`, so
that a new kind of sensor is one class.

A marker stands on a stem. The motion of the stem depends on the kind of binding:

- ``normal``: x = sum b_i q_i + d n. The stem is along the normal n of the deformed surface
  triangle, of constant length d; the b_i sum to one and say where in the triangle's plane it
  stands.
- ``frame``: x = sum b_i q_i + R o. It stands on the closest point of the surface and rotates with
  the triangle: R is the rotation of its tangent plane that is closest to the deformation
  (the polar factor).
- ``rigid``: x = c + R o. It follows the rigid motion that is closest to that of a set of vertices,
  such as those of a face that it is glued to; c is their centre.
- ``patch``: like ``rigid``, with the vertices around its foot, such as for a marker on a clip
  around a rod.

All reproduce the markers at rest, and carry them rigidly where the body moves rigidly.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Final, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ..core.mesh.surface import closest_points
from ..core.mesh.volume_mesh import Mesh
from ..core.stepping.rotations import closest_rotation
from ..io.arrays import BoolArray, Brief, FloatArray, IntArray
from ..io.errors import InputError, checks_types

_LEAST_PATCH = 4  # number of vertices that determine the rotation of a patch
KINDS = ("normal", "frame", "rigid", "patch")


class Observation(Brief, ABC):
    """Map from positions to the measurement of a sensor; subclasses are frozen dataclasses.

    Attributes:
        unit: of the measured coordinates.
        dimension: D, number of coordinates of a measured point.
        labels: names of the M points; empty where they have none.
    """

    unit: ClassVar[str] = "m"
    dimension: ClassVar[int] = 3
    labels: tuple[str, ...] = ()

    @abstractmethod
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns the predicted measurement (B, M, D) [unit]
        at positions (B, N, 3) of the vertices [m].

        The B bodies may be several trials, sets of parameters and times; all are observed alike.
        """

    def residual(self, predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        """Returns predicted less measured points, (..., M, D) [unit],
        zero where a point was not measured (NaN).
        """
        seen = torch.isfinite(measured).all(-1, keepdim=True)
        return torch.where(seen, predicted - measured, 0.0)

    def transposed_jacobian(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns the transposed derivative (B, 3 N, D M) of the predicted measurement
        by positions (B, N, 3).
        """
        with torch.enable_grad():
            q = positions.detach().requires_grad_(True)
            points = self(q)
            seeds = torch.eye(points[0].numel(), device=q.device, dtype=q.dtype).view(
                -1, 1, *points.shape[1:]
            )
            (rows,) = torch.autograd.grad(
                points, q, seeds.expand(-1, *points.shape), is_grads_batched=True
            )
        return rows.flatten(2).permute(1, 2, 0).contiguous()

    def to(self, like: torch.Tensor) -> Self:
        """Returns the observation on the device and in the precision of a tensor."""
        names = [item.name for item in fields(self)]  # type: ignore[arg-type]
        changed: dict[str, Any] = {name: _to(getattr(self, name), like) for name in names}
        return replace(self, **changed)  # type: ignore[type-var]


@dataclass(frozen=True)
class WholeState(Observation):
    """The positions of all vertices, as a simulated laboratory knows them."""

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        return positions


WHOLE_STATE: Final = WholeState()


@dataclass(frozen=True)
class NoPoints(Observation):
    """No position at all, where force sensors alone observe a body."""

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        return positions[:, :0]

    @override
    def transposed_jacobian(self, positions: torch.Tensor) -> torch.Tensor:
        return positions.new_zeros(len(positions), positions[0].numel(), 0)


def _to(value: Any, like: torch.Tensor) -> Any:
    if isinstance(value, torch.Tensor):
        return value.to(like) if value.is_floating_point() else value.to(like.device)
    if isinstance(value, tuple):
        return tuple(_to(part, like) for part in value)
    return value.to(like) if hasattr(value, "to") else value


@dataclass(frozen=True)
class Markers(Observation):
    """A map from the vertices of a body to M markers."""

    vertices: torch.Tensor  # indices of the vertices that the markers depend on, in any shape
    labels: tuple[str, ...] = field(default=(), kw_only=True)

    @classmethod
    def bind(cls, mesh: Mesh, places: NDArray[np.float64], labels: Sequence[str]) -> "Markers":
        """Returns markers at places (m, 3) on the undeformed body [m],
        for classes that a configuration names.

        Args:
            mesh: of the body.
            places: of the markers.
            labels: their m names.

        Raises:
            InputError: the class cannot be used in a configuration.
        """
        raise InputError(
            f"{cls.__name__} has no class method bind(mesh, places, labels), "
            "which makes it: add it."
        )

    def moved(self, by: torch.Tensor) -> "Markers":
        """Returns the markers with an offset on the body.

        Args:
            by: (m, 3) offset in the frame of the body at rest [m].

        Raises:
            InputError: the observed points are vertices.
        """
        raise InputError(
            "observed vertices are where they are: only markers on stems can be placed elsewhere."
        )


@dataclass(frozen=True)
class MarkerMap(Markers):
    """Markers as weighted sums of vertices, different in every environment."""

    vertices: torch.Tensor  # (B, m, k) the vertices of each marker
    weights: torch.Tensor  # (B, m, k) weights; all zero for a missing marker

    def __post_init__(self) -> None:
        """Checks that the shapes agree.

        Raises:
            InputError: they do not agree, or there is no marker.
        """
        if (
            self.vertices.ndim != 3
            or self.vertices.shape != self.weights.shape
            or not self.vertices.numel()
        ):
            raise InputError(
                f"marker vertices of shape {tuple(self.vertices.shape)} with weights of shape "
                f"{tuple(self.weights.shape)}: both must be (environments, markers, vertices a "
                "marker)."
            )

    @classmethod
    def at_vertices(cls, vertices: torch.Tensor, dtype: torch.dtype = torch.float64) -> "MarkerMap":
        """Returns one marker on every one of vertices (B, m)."""
        return cls(vertices[..., None], torch.ones_like(vertices[..., None], dtype=dtype))

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        """Applies C: maps values at the vertices (B, N, ...) to values at markers (B, m, ...)."""
        batch = torch.arange(len(positions), device=positions.device)[:, None, None]
        weights = self.weights.reshape(*self.weights.shape, *[1] * (positions.ndim - 2))
        return (positions[batch, self.vertices] * weights).sum(2)

    @override
    def transposed_jacobian(self, positions: torch.Tensor) -> torch.Tensor:
        b, m = max(len(positions), len(self.vertices)), self.vertices.shape[1]
        of_marker = [values.expand(b, -1, -1) for values in (self.vertices, self.weights)]
        weights = self.weights.new_zeros(b, m, positions.shape[1]).scatter_add_(2, *of_marker)
        identity = torch.eye(3, device=weights.device, dtype=weights.dtype)
        return torch.einsum("bmn,ij->bnimj", weights, identity).reshape(b, -1, 3 * m)


@dataclass(frozen=True)
class SurfaceMarkers(Markers):
    """Markers that stand on triangles of the surface.

    Kinds ``normal`` and ``frame`` (see the module).
    """

    vertices: torch.Tensor  # (m, 3) corners of the triangles, counter-clockwise seen from outside
    weights: torch.Tensor  # (m, 3) barycentric coordinates of the feet, the sum of each row one
    # (m, 2, 2) from the triangle's edges to its tangents at rest: the inverse of their coordinates
    # [1/m]
    unstretch: torch.Tensor
    offsets: torch.Tensor  # (m, 3) stems [m] along the first and second tangent and the normal
    axes: torch.Tensor  # (m, 3, 3) tangents and normal at rest, as columns

    @override
    def moved(self, by: torch.Tensor) -> "SurfaceMarkers":
        return replace(
            self, offsets=self.offsets + torch.einsum("mij,mi->mj", self.axes, by.to(self.offsets))
        )

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        corners = positions[:, self.vertices]  # (B, m, 3, 3)
        stems = torch.einsum("bmij,mj->bmi", tangent_frames(corners, self.unstretch), self.offsets)
        return torch.einsum("bmki,mk->bmi", corners, self.weights) + stems


@dataclass(frozen=True)
class RigidMarkers(Markers):
    """Markers that follow the rigid motion of a set of vertices.

    Kind ``rigid`` (see the module).
    """

    vertices: torch.Tensor  # (S,) three or more, not on one line
    rest: torch.Tensor  # (S, 3) [m] vertices at rest, relative to their centre
    offsets: torch.Tensor  # (m, 3) [m] markers at rest, relative to the centre of the vertices

    @override
    def moved(self, by: torch.Tensor) -> "RigidMarkers":
        return replace(self, offsets=self.offsets + by.to(self.offsets))

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        now = positions[:, self.vertices]  # (B, S, 3)
        centre = now.mean(1, keepdim=True)
        rotation = closest_rotation((now - centre).mT @ self.rest)
        return centre + self.offsets @ rotation.mT


@dataclass(frozen=True)
class JoinedMarkers(Markers):
    """Markers of several kinds."""

    vertices: torch.Tensor  # (K,) of all parts
    parts: tuple[SurfaceMarkers | RigidMarkers, ...]  # the markers of each kind
    order: torch.Tensor  # (m,) index of the markers in the concatenated parts

    @classmethod
    def of(cls, parts: Sequence["BoundMarkers"], places: Sequence[list[int]]) -> "BoundMarkers":
        """Returns the markers of parts with their indices among all markers.

        The part itself if there is one.
        """
        if len(parts) == 1:
            return parts[0]
        flat, order = list[SurfaceMarkers | RigidMarkers](), list[int]()
        for part, rows in zip(parts, places, strict=True):
            if isinstance(part, JoinedMarkers):
                flat += part.parts
                order += [rows[number] for number in torch.argsort(part.order).tolist()]
            else:
                flat.append(part)
                order += rows
        vertices = torch.cat([part.vertices.flatten() for part in flat])
        return cls(vertices, tuple(flat), torch.as_tensor(np.argsort(order)))

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        return torch.cat([part(positions) for part in self.parts], 1)[:, self.order]

    @override
    def moved(self, by: torch.Tensor) -> "JoinedMarkers":
        counts = [len(part.offsets) for part in self.parts]
        in_parts = by[torch.argsort(self.order).to(by.device)].split(counts)
        parts = tuple(
            part.moved(offsets) for part, offsets in zip(self.parts, in_parts, strict=True)
        )
        return replace(self, parts=parts)


BoundMarkers = SurfaceMarkers | RigidMarkers | JoinedMarkers


def tangent_frames(corners: torch.Tensor, unstretch: torch.Tensor) -> torch.Tensor:
    """Rotated tangents and normals (B, m, 3, 3) of deformed triangles, as columns.

    With f1, f2 the images of the orthonormal tangents and n the unit normal, f1 + f2 x n points
    along the first column of the rotation closest to the deformation of the plane: the polar factor
    of [[a, b], [c, d]] is the matrix [[a + d, b - c], [c - b, a + d]], scaled to determinant one.
    Corners are (B, m, 3, 3) [m].
    """
    edges = corners[:, :, 1:] - corners[:, :, :1]  # (B, m, 2, 3)
    first, second = torch.einsum("bmki,mkj->jbmi", edges, unstretch)
    normal = torch.nn.functional.normalize(torch.linalg.cross(first, second), dim=-1, eps=0.0)
    along = torch.nn.functional.normalize(
        first + torch.linalg.cross(second, normal), dim=-1, eps=0.0
    )
    return torch.stack([along, torch.linalg.cross(normal, along), normal], dim=-1)


@checks_types
def bind_markers(
    mesh: Mesh,
    positions: ArrayLike,
    names: Sequence[str],
    *,
    kind: str | Sequence[str] = "normal",
    vertices: ArrayLike | None = None,
    largest_distance: float = 0.02,
    patch: float = 0.02,
) -> BoundMarkers:
    """Binds markers to a body at rest.

    A marker is bound to a triangle of `surface.closest_points`. Beside an edge, a ``normal`` one
    stands on the plane of that adjacent triangle which it lies most squarely above, possibly
    outside of the triangle, and a ``frame`` one on the edge.

    Args:
        mesh: The body.
        positions: (m, 3) [m] markers at rest, in the frame of the body.
        names: m names.
        kind: One of `KINDS` for all markers, or one for every marker.
        vertices: (S,) the vertices that ``rigid`` markers follow.
        patch: Radius around the foot of a ``patch`` marker, the closest point of the surface, of
            the vertices that it follows [m].
        largest_distance: Largest distance of a marker from the surface [m].

    Returns:
        Markers in float64 on the CPU.

    Raises:
        InputError: A marker is too far from the surface or not finite, a kind is unknown, or the
            vertices of ``rigid`` markers are missing, too few, on one line or not in the mesh.
    """
    points = np.asarray(positions, dtype=np.float64)
    kinds = [kind] * len(names) if isinstance(kind, str) else list(kind)
    _check_bound(points, names, kinds)
    feet = closest_points(mesh, points)
    worst = int(np.argmax(np.abs(feet.distances)))
    if abs(feet.distances[worst]) > largest_distance:
        raise InputError(
            f"Marker '{names[worst]}' is {1e3 * abs(feet.distances[worst]):.1f} mm from the "
            f"surface of the body, more than {1e3 * largest_distance:.1f} mm: check its "
            "position, the unit of the mesh and the registration."
        )
    flat = np.array(kinds) == "normal"
    parts = list[SurfaceMarkers | RigidMarkers]()
    places = list[list[int]]()
    surface = np.flatnonzero(flat | (np.array(kinds) == "frame"))
    if len(surface):
        parts.append(
            _on_triangles(
                mesh, feet.triangles[surface], points[surface], feet.points[surface], flat[surface]
            )
        )
        places.append(surface.tolist())
    rigid = [number for number, name in enumerate(kinds) if name == "rigid"]
    if rigid:
        parts.append(follow_vertices(mesh, vertices, points[rigid]))
        places.append(rigid)
    for number in [number for number, name in enumerate(kinds) if name == "patch"]:
        near = np.flatnonzero(np.linalg.norm(mesh.vertices - feet.points[number], axis=1) <= patch)
        if len(near) < _LEAST_PATCH:
            raise InputError(
                f"Marker '{names[number]}' follows {len(near)} vertices within {1e3 * patch:.3g} "
                "mm of its foot: widen the patch."
            )
        parts.append(follow_vertices(mesh, near, points[number][None]))
        places.append([number])
    return replace(JoinedMarkers.of(parts, places), labels=tuple(names))


def _check_bound(points: FloatArray, names: Sequence[str], kinds: Sequence[str]) -> None:
    """Refuses markers without a place (m, 3) or of an unknown kind."""
    if points.shape != (len(names), 3) or len(kinds) != len(names) or not len(names):
        raise InputError(
            f"{len(names)} markers are named, with {len(kinds)} kinds and positions "
            f"{points.shape}: there must be a kind and three coordinates for each, "
            "and one marker at least."
        )
    for name, point, kind in zip(names, points, kinds, strict=True):
        if kind not in KINDS:
            raise InputError(
                f"The kind of marker '{name}' is {kind!r}: choose one of {', '.join(KINDS)}."
            )
        if not np.isfinite(point).all():
            raise InputError(
                f"Marker '{name}' was not seen at rest, so it cannot be bound: leave it out."
            )


def _on_triangles(
    mesh: Mesh, triangles: IntArray, points: FloatArray, closest: FloatArray, flat: BoolArray
) -> SurfaceMarkers:
    """Markers with feet at the closest points.

    Those of `flat` markers at their projections on the triangle's plane.
    """
    corners = mesh.vertices[triangles]  # (m, 3, 3)
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)  # (m, 3, 2), as columns
    normal = np.cross(edges[:, :, 0], edges[:, :, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = edges[:, :, 0] / np.linalg.norm(edges[:, :, 0], axis=1, keepdims=True)
    frame = np.stack([first, np.cross(normal, first), normal], axis=2)  # (m, 3, 3), as columns
    unstretch = np.linalg.inv(np.swapaxes(frame[:, :, :2], 1, 2) @ edges)
    above = np.sum((points - corners[:, 0]) * normal, axis=1, keepdims=True)
    feet = np.where(flat[:, None], points - above * normal, closest)
    # (m, 2, 1)
    inside = unstretch @ (np.swapaxes(frame[:, :, :2], 1, 2) @ (feet - corners[:, 0])[:, :, None])
    weights = np.concatenate([1.0 - inside.sum(axis=1), inside[:, :, 0]], axis=1)
    stems = points - np.einsum("mki,mk->mi", corners, weights)
    offsets = (np.swapaxes(frame, 1, 2) @ stems[:, :, None])[:, :, 0]
    offsets[flat, :2] = 0.0
    return SurfaceMarkers(*map(torch.as_tensor, (triangles, weights, unstretch, offsets, frame)))


def follow_vertices(mesh: Mesh, vertices: ArrayLike | None, points: FloatArray) -> RigidMarkers:
    """Returns points (m, 3) of the undeformed body [m]
    that follow the rigid motion of some of its vertices (S,).

    Raises:
        InputError: vertices that are missing, too few, on one line or not in the mesh.
    """
    chosen = np.unique(np.asarray([] if vertices is None else vertices, dtype=np.int64))
    if len(chosen) < 3 or chosen[0] < 0 or chosen[-1] >= len(mesh.vertices):
        raise InputError(
            f"Rigid markers follow {len(chosen)} vertices: give three or more of the "
            f"{len(mesh.vertices)} of the mesh, such as those of a face."
        )
    centre = mesh.vertices[chosen].mean(axis=0)
    rest = mesh.vertices[chosen] - centre
    spread = np.linalg.svd(rest, compute_uv=False)
    if spread[1] <= 1e-6 * spread[0]:
        raise InputError(
            "The vertices that rigid markers follow lie on one line: choose those of a face."
        )
    return RigidMarkers(*map(torch.as_tensor, (chosen, rest, points - centre)))
