"""A body: the constant part of a simulation, in NumPy on the host."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from ..io.errors import InputError
from ..mesh.location import locate
from ..mesh.mesh import Mesh
from .coordinates import Coordinates, rigid_weights
from .elements import Discretisation, Points, discretise
from .rigid import Glue, Rigid

MASS_MODES = ("row_sum", "per_vertex")


class OnBody(Protocol):
    """What a body needs to know of an energy (`energies.base.Energy`)."""

    @property
    def parameters(self) -> Sequence[Any]:
        """Its constants."""

    @property
    def inputs(self) -> Sequence[Any]:
        """What acts through it."""

    def points(self, mesh: Mesh) -> tuple[Points, ...]:
        """Its sets of points on a body's rest shape."""


def _vertex_indices(values: ArrayLike, n_vertices: int, what: str) -> NDArray[np.int64]:
    """(n,) indices of vertices that the mesh has.

    Raises:
        InputError: values that are no whole numbers, such as a mask, or that no vertex has.
    """
    indices = np.asarray(values).ravel()
    if indices.size and indices.dtype.kind not in "iu":
        raise InputError(f"{what} must be vertex numbers: turn a mask into them with np.flatnonzero.")
    if indices.size and (indices.min() < 0 or indices.max() >= n_vertices):
        raise InputError(f"{what} must lie between 0 and {n_vertices - 1}.")
    return indices.astype(np.int64)


@dataclass(frozen=True)
class PointMass:
    """A weight that moves with the body: it has inertia, and hangs in gravity."""

    mass: float  # [kg]
    vertices: Sequence[int]  # (n,) the vertices that carry it
    weights: Sequence[float] | None = None  # (n,) the share of each, summing to one; equal shares where left out

    def per_vertex(self, n_vertices: int) -> NDArray[np.float64]:
        """(N,) mass at each vertex [kg].

        Raises:
            InputError: a negative mass, a vertex that the mesh does not have, or weights that do not sum to one.
        """
        vertices = _vertex_indices(self.vertices, n_vertices, "a point mass's vertices")
        n = len(vertices)
        weights = np.full(n, 1.0 / max(n, 1)) if self.weights is None else np.asarray(self.weights, dtype=float)
        if not np.isfinite(self.mass) or self.mass < 0.0:
            raise InputError(f"a point mass of {self.mass:g} kg: its mass must be zero or more.")
        if n == 0:
            raise InputError("a point mass must hang on at least one vertex.")
        if weights.shape != (n,) or not (weights >= 0.0).all() or not abs(weights.sum() - 1.0) <= 1e-9:
            raise InputError(f"a point mass on {n} vertices needs {n} weights, zero or more, that sum to one.")
        mass = np.zeros(n_vertices)
        np.add.at(mass, vertices, weights * self.mass)
        return mass


@dataclass(frozen=True)
class Body:
    """A mesh with its boundary conditions, masses and integration rule."""

    mesh: Mesh  # the rest shape
    # vertices with prescribed positions (Dirichlet); they rest where they are unless moved. Their positions are
    # given in the order of ``fixed_vertices``
    fixed: ArrayLike = ()
    # ``row_sum`` lumps each element's own mass on its vertices (HRZ for 10-node tetrahedra). ``per_vertex`` gives
    # every vertex the density times the mean element volume, which is wrong by a factor of two on the published
    # beam and serves for comparison with the published code alone
    mass: str = "row_sum"
    volume_integration: str = "centre"  # ``centre`` or ``full`` (see `elements.discretise`)
    point_masses: Sequence[PointMass] = field(default=())  # attached weights
    # what acts in or on the body beside its material: pressure, fibres (`energies.base.Energy`)
    energies: Sequence[OnBody] = field(default=())
    # regions of the mesh that move as rigid parts, by name
    rigid: Mapping[str, Rigid] = field(default_factory=dict)
    # vertices that follow a region whose mesh does not match theirs
    glued: Sequence[Glue] = field(default=())
    # the sets of points of each of the energies
    energy_points: tuple[tuple[Points, ...], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Checks the fixed vertices, the mass mode and the energies.

        Raises:
            InputError: an unknown mass mode, fixed vertices that the mesh does not have, or two energies that depend on
                a quantity of the same name.
            MeshError: a mesh that an energy does not fit, such as an open chamber.
        """
        if self.mass not in MASS_MODES:
            raise InputError(f"mass is {self.mass!r}: choose one of {', '.join(MASS_MODES)}.")
        fixed = np.unique(_vertex_indices(self.fixed, self.n_vertices, "fixed vertices"))
        if len(fixed) == self.n_vertices:
            raise InputError("every vertex is fixed: leave some free to move.")
        object.__setattr__(self, "fixed", fixed)
        names = [quantity.name for each in self.energies for quantity in (*each.parameters, *each.inputs)]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise InputError(f"two energies of the body depend on {twice[0]}: put them into one.")
        object.__setattr__(self, "energy_points", tuple(each.points(self.mesh) for each in self.energies))
        if self.rigid or self.glued:
            self.coordinates  # noqa: B018  # What cannot move so is refused here.

    @property
    def members(self) -> "Iterator[tuple[str, Body, int]]":
        """The body itself, as a scene of one: an empty name, the body, and the number of its first vertex."""
        yield "", self, 0

    @property
    def vertices(self) -> NDArray[np.float64]:
        """(N, 3) rest positions [m]."""
        return self.mesh.vertices

    @property
    def n_vertices(self) -> int:
        """N."""
        return len(self.mesh.vertices)

    @property
    def fixed_vertices(self) -> NDArray[np.int64]:
        """(D,) vertices with prescribed positions, in ascending order."""
        return np.asarray(self.fixed)

    @cached_property
    def discretisation(self) -> Discretisation:
        """Integration points and volumes."""
        return discretise(self.mesh, self.volume_integration, cracks=bool(self.glued))

    @cached_property
    def soft_cells(self) -> NDArray[np.int64] | None:
        """(m,) cells of no rigid part; None where all cells are soft."""
        if not self.rigid:
            return None
        rigid = np.concatenate([self.mesh.region(name) for name in self.rigid])
        return np.setdiff1d(np.arange(len(self.mesh.cells)), rigid)

    @property
    def controls(self) -> dict[str, NDArray[np.int64]]:
        """Four control vertices of each rigid part that is free to move, by name."""
        return self._dependence[0]

    @property
    def coordinates(self) -> Coordinates:
        """Vertices as weighted sums of control vertices."""
        return self._dependence[1]

    @cached_property
    def _dependence(self) -> tuple[dict[str, NDArray[np.int64]], Coordinates]:
        """Control vertices of the rigid parts, and the map from control vertices to all.

        Raises:
            InputError: a part of which some vertices are fixed and others are not, two parts that share vertices, a
                flat part, or glued vertices that are fixed, rigid, or too far from what they are glued to.
            MeshError: an unknown region.
        """
        weights: dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]] = {}
        controls: dict[str, NDArray[np.int64]] = {}
        taken: dict[int, str] = {}
        for name in self.rigid:
            members = np.unique(self.mesh.cells[self.mesh.region(name)])
            held = int(np.isin(members, self.fixed_vertices).sum())
            if held == len(members):
                continue
            if held:
                raise InputError(
                    f"{held} of the {len(members)} vertices of the rigid part {name!r} are fixed: fix all of them, or "
                    "none."
                )
            if shared := next((taken[i] for i in members.tolist() if i in taken), None):
                raise InputError(f"the rigid parts {shared!r} and {name!r} share vertices: make them one region.")
            taken |= dict.fromkeys(members.tolist(), name)
            controls[name], own = rigid_weights(self.mesh.vertices, members, name)
            weights |= own
        for glue in self.glued:
            weights |= self._glued_weights(glue, taken)
        return controls, Coordinates.of(self.n_vertices, weights)

    def _glued_weights(
        self, glue: Glue, rigid: Mapping[int, str]
    ) -> dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Returns control vertices and weights of glued vertices: the shape functions of the cells they lie in."""
        vertices = np.unique(_vertex_indices(glue.vertices, self.n_vertices, "glued vertices"))
        cells = self.mesh.cells[self.mesh.region(glue.to)]
        for what, others in (("fixed", self.fixed_vertices), ("part of a rigid part", np.array(list(rigid)))):
            if np.isin(vertices, others).any():
                raise InputError(f"a vertex that is glued to {glue.to!r} is {what}: leave it out of the glue.")
        if np.isin(vertices, cells).any():
            raise InputError(f"a vertex that is glued to {glue.to!r} belongs to it: glue vertices of another region.")
        used, renumbered = np.unique(cells, return_inverse=True)
        found = locate(Mesh(self.mesh.vertices[used], renumbered.reshape(cells.shape)), self.mesh.vertices[vertices])
        if float(found.outside.max()) > glue.tolerance:
            far = int(found.outside.argmax())
            raise InputError(
                f"vertex {vertices[far]} is {found.outside[far]:.3g} m from the region {glue.to!r} that it is glued "
                f"to, farther than the tolerance of {glue.tolerance:g} m: move the meshes together, or raise it."
            )
        return {int(i): (cells[c], w) for i, c, w in zip(vertices, found.cells, found.weights, strict=True)}

    def discretised(self, cells: NDArray[np.int64]) -> Discretisation:
        """Returns integration points and volumes of some cells."""
        return discretise(self.mesh, self.volume_integration, cells, cracks=bool(self.glued))

    @cached_property
    def mass_volume(self) -> scipy.sparse.csr_array:
        """(N, M) volume of each element that each vertex carries as mass [m^3]."""
        return self._per_vertex_volume if self.mass == "per_vertex" else self.discretisation.lumped_volume

    @cached_property
    def load_volume(self) -> scipy.sparse.csr_array:
        """(N, M) volume of each element whose weight acts on each vertex [m^3]."""
        return self._per_vertex_volume if self.mass == "per_vertex" else self.discretisation.load_volume

    @cached_property
    def _per_vertex_volume(self) -> scipy.sparse.csr_array:
        volumes = self.discretisation.element_volumes
        return scipy.sparse.csr_array(np.tile(volumes / len(volumes), (self.n_vertices, 1)))

    @cached_property
    def attached_mass(self) -> NDArray[np.float64]:
        """(N,) mass of the attached weights [kg]."""
        return sum((m.per_vertex(self.n_vertices) for m in self.point_masses), np.zeros(self.n_vertices))
