"""Vertices as weighted sums of control vertices that may slide in planes, x = W (P r + o).

A free vertex is its own control vertex. A glued vertex has the shape functions of the face it is
glued to as weights. A rigid part is an affine body (Lan et al., Affine Body Dynamics, 2022): it is
controlled by four of its vertices, and the weights of the others are their barycentric coordinates.
As W acts on each component alike, the operator F = sum_a x_a g_a^T of a point keeps its form,
F = sum_c r_c (sum_a W_ac g_a)^T: energies use control vertices only, and the Hessian in r, W^T H W,
is assembled without forming H. A control vertex in a symmetry plane through its rest position x0
moves along the plane only: P = I - n n^T and o = (I - P) x0; for all other vertices P = I.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import scipy.sparse
import torch
from numpy.typing import ArrayLike

from ...io.arrays import BoolArray, FloatArray, IntArray
from ...io.errors import InputError
from .integration_points import Points, padded_operators

P = TypeVar("P", bound=Points)
_ROUNDING = 1e-9  # weights up to this size are zero but for rounding
_FLAT = 1e-3  # smallest height of the tetrahedron that controls a rigid part, over the part's size


@dataclass(frozen=True)
class SymmetryPlane:
    """The plane n . x = offset that cuts a symmetric body:
    its vertices in the plane only move within it.

    The mesh is one side of the body; its motion is that of the whole body as long as loads and
    motion are symmetric.

    Raises:
        InputError: a normal of zero length, or numbers that are not finite.
    """

    normal: Sequence[float]  # (3,) n, scaled to unit length
    offset: float = 0.0  # [m]
    tolerance: float = 1e-9  # largest distance of a vertex in the plane [m]

    def __post_init__(self) -> None:
        """Checks the numbers and scales the normal."""
        normal = np.asarray(self.normal, dtype=np.float64)
        if (
            normal.shape != (3,)
            or not np.isfinite([*normal, self.offset]).all()
            or not normal.any()
        ):
            raise InputError(
                f"a symmetry plane has the normal {self.normal}: "
                "give three finite numbers, not all zero."
            )
        object.__setattr__(self, "normal", tuple((normal / np.linalg.norm(normal)).tolist()))

    def contains(self, vertices: FloatArray) -> BoolArray:
        """Returns (N,) whether vertices (N, 3) [m] lie in the plane."""
        return np.asarray(
            np.abs(vertices @ np.asarray(self.normal) - self.offset) <= self.tolerance
        )


def tangential_projections(normals: FloatArray, touched: BoolArray) -> FloatArray:
    """Returns the projections (R, 3, 3) onto the directions along all planes that contain a vertex.

    Args:
        normals: (S, 3) unit normals of the planes.
        touched: (R, S) whether a vertex lies in a plane.
    """
    combinations, which = np.unique(touched, axis=0, return_inverse=True)
    by_combination = [
        np.eye(3) - np.linalg.pinv(normals[planes]) @ normals[planes] for planes in combinations
    ]
    return np.asarray(by_combination)[which.reshape(-1)]


def plane_shares(
    planes: Sequence[SymmetryPlane], plane: SymmetryPlane, vertices: FloatArray
) -> FloatArray:
    """Returns (R, 3) c: of a force f with which planes hold a vertex,
    one of them gives c . f along its normal.

    Args:
        planes: the planes.
        plane: one of them.
        vertices: (R, 3) rest positions of vertices that slide in them [m]; c is zero for those
            outside of the plane.
    """
    normals = np.array([one.normal for one in planes])
    touched = [one.contains(vertices) for one in planes]
    inside = np.stack(touched, axis=1)[:, :, None]
    return np.asarray(np.linalg.pinv((inside * normals).swapaxes(1, 2))[:, [*planes].index(plane)])


@dataclass(frozen=True)
class Coordinates:
    """The map W of a body; the identity without dependent vertices."""

    n_vertices: int  # N
    dependent: IntArray  # (S,) vertices determined by control vertices, ascending
    weights: scipy.sparse.csr_array  # (S, N) of control vertices in each dependent vertex
    sliding: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (R,) in planes
    projections: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))  # (R, 3, 3) P
    offsets: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (R, 3) o [m]

    @classmethod
    def of(cls, dependence: scipy.sparse.csr_array) -> "Coordinates":
        """Builds the map from the weights (N, N) of the control vertices in each dependent vertex.

        A dependent vertex may be a weighted sum of other dependent vertices; these are substituted.

        Raises:
            InputError: two vertices determine each other.
        """
        n_vertices, dependent = dependence.shape[0], np.flatnonzero(np.diff(dependence.indptr))
        free = np.ones(n_vertices)
        free[dependent] = 0.0
        matrix = scipy.sparse.csr_array(scipy.sparse.diags_array(free) + dependence)
        for _ in dependent:
            if not matrix[:, dependent].nnz:
                break
            matrix = scipy.sparse.csr_array(matrix @ matrix)
            matrix.eliminate_zeros()
        if matrix[:, dependent].nnz:
            raise InputError(
                "glued vertices determine each other: "
                "glue one side of an interface to the other only."
            )
        return cls(n_vertices, dependent, scipy.sparse.csr_array(matrix[dependent]))

    @classmethod
    def joined(cls, maps: "Sequence[Coordinates]") -> "Coordinates":
        """Returns the map of several bodies with their vertices concatenated."""
        first = np.cumsum([0, *(part.n_vertices for part in maps)])
        moved = [*zip(maps, first, strict=False)]
        return cls(
            int(first[-1]),
            np.concatenate([part.dependent + start for part, start in moved]),
            scipy.sparse.csr_array(scipy.sparse.block_diag([part.weights for part in maps])),
            np.concatenate([part.sliding + start for part, start in moved]),
            np.concatenate([part.projections for part in maps]),
            np.concatenate([part.offsets for part in maps]),
        )

    def with_planes(
        self, planes: Sequence[SymmetryPlane], vertices: FloatArray, fixed: IntArray
    ) -> "Coordinates":
        """Returns the map with vertices that slide in symmetry planes.

        Args:
            planes: the planes.
            vertices: (N, 3) rest positions [m].
            fixed: (D,) fixed vertices, which do not slide.

        Raises:
            InputError: a plane without vertices, or with a dependent vertex whose control vertices
                lie outside of it.
        """
        if not planes:
            return self
        contained = np.stack([plane.contains(vertices) for plane in planes], axis=1)  # (N, S)
        for plane, inside in zip(planes, contained.T, strict=True):
            if not inside.any():
                raise InputError(
                    f"no vertex lies in the symmetry plane with normal {plane.normal} and offset "
                    f"{plane.offset:g} m: move the plane or the mesh."
                )
            controls = abs(self.weights[inside[self.dependent]]).sum(axis=0) > _ROUNDING
            if (controls & ~inside).any():
                raise InputError(
                    f"a glued or rigid vertex in the symmetry plane with normal {plane.normal} "
                    "is controlled by vertices outside of it: glue it to a face that the plane "
                    "cuts too, or cut the rigid part by it."
                )
        contained[self.dependent] = contained[fixed] = False
        sliding = np.flatnonzero(contained.any(axis=1))
        projections = tangential_projections(
            np.array([plane.normal for plane in planes]), contained[sliding]
        )
        offsets = np.einsum("rij,rj->ri", np.eye(3) - projections, vertices[sliding])
        return replace(self, sliding=sliding, projections=projections, offsets=offsets)

    def __bool__(self) -> bool:
        """Whether any vertex depends on others."""
        return len(self.dependent) > 0

    @cached_property
    def matrix(self) -> scipy.sparse.csr_array:
        """(N, N) W; columns of dependent vertices are empty."""
        identity = scipy.sparse.eye_array(self.n_vertices, format="csc")
        free = np.ones(self.n_vertices)
        free[self.dependent] = 0.0
        return scipy.sparse.csr_array(
            scipy.sparse.diags_array(free) + identity[:, self.dependent] @ self.weights
        )

    def compose(self, points: P) -> P:
        """Returns points whose operators act on control vertices."""
        touched = np.flatnonzero(np.isin(points.nodes, self.dependent).any(axis=1))
        if not len(touched):
            return points
        cells, per_cell, k, components = points.gradients.shape
        rows = self.matrix[points.nodes[touched].ravel()]  # (T K, N)
        node = np.repeat(np.arange(rows.shape[0]), np.diff(rows.indptr))
        operators = points.gradients[touched].swapaxes(1, 2).reshape(-1, per_cell, components)[node]
        first = rows.indices[rows.indptr[:-1:k]]  # a control vertex of each cell
        controls, composed = padded_operators(
            node // k, rows.indices, rows.data[:, None, None] * operators, first
        )
        width = max(k, controls.shape[1])
        # Cells are padded with their first vertex and a zero operator.
        nodes = np.repeat(points.nodes[:, :1], width, axis=1)
        gradients = np.zeros((cells, per_cell, width, components))
        nodes[:, :k], gradients[:, :, :k] = points.nodes, points.gradients
        nodes[touched], gradients[touched] = first[:, None], 0.0
        nodes[touched, : controls.shape[1]] = controls
        gradients[touched, :, : controls.shape[1]] = composed.swapaxes(1, 2)
        return replace(points, nodes=nodes, gradients=gradients)

    @cached_property
    def points(self) -> Points:
        """One point per dependent vertex, whose operator gives the vertex's position."""
        w, count = self.weights, len(self.dependent)
        rows, first = np.repeat(np.arange(count), np.diff(w.indptr)), w.indices[w.indptr[:-1]]
        nodes, operators = padded_operators(rows, w.indices, w.data[:, None, None], first)
        return Points(nodes, operators.swapaxes(1, 2))


def weighted_sum(weights: torch.Tensor, fields: Sequence[torch.Tensor]) -> torch.Tensor:
    """Returns sums (B, S, ...) of w fields (B, S or 1, ...) with weights (S, w).

    Their order is fixed, so that every environment is bit for bit what it is in another batch.
    """
    columns = weights.view(*weights.shape, *[1] * (fields[0].ndim - 2)).unbind(1)
    first, *others = (w * f for w, f in zip(columns, fields, strict=True))
    return sum(others, first)


class DeviceCoordinates:
    """`Coordinates` with the device and dtype of a tensor.

    Attributes:
        dependent: (S,) vertices determined by control vertices.
        sliding: (R,) control vertices in symmetry planes.
        projections: (R, 3, 3) projections onto the directions along these planes.
        controls: (S, w) control vertices of the dependent ones, in any order.
        weights: (S, w) their weights, zero in places that a vertex does not need.
        depends: whether there are dependent vertices.
        slides: whether there are sliding vertices.
    """

    def __init__(self, coordinates: Coordinates, like: torch.Tensor) -> None:
        self.dependent = torch.as_tensor(coordinates.dependent, device=like.device)
        points = (
            coordinates.points
            if coordinates
            else Points(np.zeros((0, 1), np.int64), np.zeros((0, 1, 1, 1)))
        )
        self.controls = torch.as_tensor(points.nodes, device=like.device)
        self.weights = torch.as_tensor(points.gradients[:, 0, :, 0]).to(like)
        used = self.weights.ravel().nonzero().ravel()
        # Of `weights`, by control vertex.
        entry = used[self.controls.ravel()[used].argsort(stable=True)]
        self._carried = self.dependent[entry // self.controls.shape[1]]
        self._shares = self.weights.ravel()[entry, None]
        self._moved, self._counts = self.controls.ravel()[entry].unique_consecutive(
            return_counts=True
        )
        self.depends, self.slides = len(coordinates.dependent) > 0, len(coordinates.sliding) > 0
        self.sliding = torch.as_tensor(coordinates.sliding, device=like.device)
        self.projections, self._offsets = (
            torch.as_tensor(values).to(like)
            for values in (coordinates.projections, coordinates.offsets)
        )

    def expand(self, r: torch.Tensor) -> torch.Tensor:
        """Returns a field (B, N, ...) with the values
        at dependent vertices computed from the control vertices.
        """
        if not self.depends:
            return r
        at = [r.index_select(1, column) for column in self.controls.unbind(1)]
        return r.index_copy(1, self.dependent, weighted_sum(self.weights, at))

    def hold(self, r: torch.Tensor) -> torch.Tensor:
        """Returns positions (B, N, 3) with those of sliding vertices projected onto their planes, P
        r + o.
        """
        if not self.slides:
            return r
        return r.index_copy(1, self.sliding, self._project(r) + self._offsets)

    def restrict(self, field: torch.Tensor) -> torch.Tensor:
        """Returns forces or displacements (B, N, 3, ...) of control vertices,
        without those normal to planes, P f.
        """
        return field.index_copy(1, self.sliding, self._project(field)) if self.slides else field

    def _project(self, field: torch.Tensor) -> torch.Tensor:
        return torch.einsum(
            "rij,brj...->bri...", self.projections, field.index_select(1, self.sliding)
        )

    def normal(self, forces: torch.Tensor) -> torch.Tensor:
        """Returns the part of forces (B, R, 3) on the sliding vertices
        that is normal to their planes, f - P f.
        """
        return forces - torch.einsum("rij,brj->bri", self.projections.to(forces), forces)

    def reduce(self, forces: torch.Tensor) -> torch.Tensor:
        """Returns W^T f of forces (B, N, 3, ...): those
        at dependent vertices are moved to their control vertices.
        """
        if not self.depends:
            return forces
        rows = forces.index_select(1, self._carried).movedim(1, 0).flatten(1) * self._shares
        sums = torch.segment_reduce(rows, "sum", lengths=self._counts, axis=0, unsafe=True)
        sums = sums.view(-1, forces.shape[0], *forces.shape[2:]).movedim(0, 1)
        kept = forces.index_fill(1, self.dependent, 0.0)
        return kept.index_copy(1, self._moved, kept.index_select(1, self._moved) + sums)


def control_vertices(
    vertices: FloatArray, candidates: IntArray, name: str, planes: Sequence[SymmetryPlane] = ()
) -> IntArray:
    """Returns four vertices that span a large tetrahedron,
    so that the weights of the others are small.

    A vertex in a symmetry plane is controlled by vertices in that plane: three lie in a plane that
    cuts the part, two in both of two planes, one in all of three.

    Args:
        vertices: (N, 3) rest positions [m].
        candidates: vertices to choose from.
        name: name of the part, for messages.
        planes: symmetry planes.

    Raises:
        InputError: all candidates lie in a plane, or they have no such vertices in the symmetry
            planes.
    """
    places = vertices[candidates]
    in_planes = [plane.contains(places) for plane in planes]
    inside = [flags for flags in in_planes if flags.any()]
    size = float(np.linalg.norm(np.ptp(places, axis=0)))
    chosen: list[int] = []
    for allowed in _corner_sets(inside, len(candidates)):
        if not chosen:
            heights = -(places @ np.array([1.0, 1e-3, 1e-6]))
        else:
            base = places[chosen]
            basis = np.linalg.qr((base[1:] - base[0]).T)[0] if len(chosen) > 1 else np.zeros((3, 0))
            offsets = places - base[0]
            heights = np.linalg.norm(offsets - (offsets @ basis) @ basis.T, axis=1)
        chosen.append(int(np.where(allowed, heights, -np.inf).argmax()))
        if not allowed.any() or (len(chosen) > 1 and not heights[chosen[-1]] > _FLAT * size):
            raise InputError(
                f"the rigid part {name!r} has too few vertices along the {len(inside)} symmetry "
                "planes that touch it: cut it by them."
                if inside
                else f"the rigid part {name!r} is flat: it needs vertices that do not lie in a "
                "plane."
            )
    # Exchange corners to enlarge the tetrahedron, until no weight exceeds one.
    for _ in range(0 if inside else 10):
        weights = barycentric(places[chosen], places)
        point, corner = np.unravel_index(int(np.abs(weights).argmax()), weights.shape)
        if abs(weights[point, corner]) < 1.0 + 1e-9:
            break
        chosen[corner] = int(point)
    return np.sort(candidates[chosen])


def _corner_sets(inside: Sequence[BoolArray], count: int) -> list[BoolArray]:
    """Returns the candidates (count,) of each of the four control vertices,
    from those inside each symmetry plane.
    """
    match inside:
        case []:
            return [np.ones(count, dtype=bool)] * 4
        case [a]:
            return [a, a, a, ~a]
        case [a, b]:
            return [a & b, a & b, a & ~b, b & ~a]
        case [a, b, c, *_]:
            return [a & b & c, a & b & ~c, b & c & ~a, a & c & ~b]
    raise AssertionError


def barycentric(corners: FloatArray, places: FloatArray) -> FloatArray:
    """Returns the barycentric coordinates (n, 4) of places (n, 3) with respect to four corners."""
    system = np.vstack([corners.T, np.ones(len(corners))])
    return np.linalg.solve(system, np.vstack([places.T, np.ones(len(places))])).T


def rigid_weights(
    vertices: FloatArray, members: IntArray, name: str, planes: Sequence[SymmetryPlane] = ()
) -> tuple[IntArray, scipy.sparse.csr_array]:
    """Returns the four control vertices of a rigid part,
    and their weights (N, N) in its other vertices.
    """
    controls = control_vertices(vertices, members, name, planes)
    others = np.setdiff1d(members, controls)
    weights = barycentric(vertices[controls], vertices[others])
    return controls, dependence(len(vertices), others, np.tile(controls, (len(others), 1)), weights)


def dependence(
    n_vertices: int, vertices: IntArray, controls: IntArray, weights: FloatArray
) -> scipy.sparse.csr_array:
    """Returns the weights (S, K) of control vertices (S, K) in vertices (S,) as a matrix (N, N)."""
    pairs = np.repeat(vertices, controls.shape[1]), controls.ravel()
    return scipy.sparse.csr_array((weights.ravel(), pairs), (n_vertices, n_vertices))


def vertex_indices(values: ArrayLike, n_vertices: int, what: str) -> IntArray:
    """Returns vertex indices (n,), or raises InputError for a mask,
    non-integers or indices out of range.
    """
    indices = np.asarray(values).ravel()
    if indices.size and indices.dtype.kind not in "iu":
        raise InputError(
            f"{what} must be vertex numbers: turn a mask into them with np.flatnonzero."
        )
    if indices.size and (indices.min() < 0 or indices.max() >= n_vertices):
        raise InputError(f"{what} must lie between 0 and {n_vertices - 1}.")
    return indices.astype(np.int64)
