"""Body: the constant data of a simulation, as NumPy arrays on the host."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import scipy.sparse
import torch
from numpy.typing import ArrayLike, NDArray

from ...io.errors import InputError, check_fields, checks_methods
from ..mesh.motion_files import write_vtu
from ..mesh.plotting import plot_parts
from ..mesh.surface import locate
from ..mesh.volume_mesh import Mesh
from .coordinates import (
    Coordinates,
    SymmetryPlane,
    dependence,
    plane_shares,
    rigid_weights,
    vertex_indices,
)
from .integration_points import Discretisation, Points, discretise
from .rigid_region import Rigid

MASS_MODES = ("row_sum", "per_vertex")


@dataclass(frozen=True)
class Glue:
    """Vertices glued to a region of the mesh whose cells need not match theirs."""

    vertices: ArrayLike  # (n,) glued vertices
    to: str  # region they are glued to
    tolerance: float = 1e-3  # largest distance from the region [m]; gaps are kept


@runtime_checkable
class BodyEnergy(Protocol):
    """The part of `energies.base.Energy` that a body uses."""

    @property
    def parameters(self) -> Sequence[Any]:
        """Parameters of the energy."""

    @property
    def inputs(self) -> Sequence[Any]:
        """Inputs of the energy."""

    def points(self, mesh: Mesh) -> tuple[Points, ...]:
        """Sets of integration points on the rest shape."""

    def moved(
        self, rotation: NDArray[np.float64], translation: NDArray[np.float64]
    ) -> "BodyEnergy":
        """The energy of the body in another place."""


@dataclass(frozen=True)
class PointMass:
    """A weight attached to the body, with inertia and gravity."""

    mass: float  # [kg]
    vertices: Sequence[int]  # (n,) vertices that carry the weight
    # (n,) share of each vertex, summing to one; equal shares if omitted
    weights: Sequence[float] | None = None

    def per_vertex(self, n_vertices: int) -> NDArray[np.float64]:
        """Returns the mass at each vertex, (N,) [kg].

        Raises:
            InputError: a negative mass, a vertex that the mesh does not have, or weights that do
                not sum to one.
        """
        vertices = vertex_indices(self.vertices, n_vertices, "a point mass's vertices")
        n = len(vertices)
        weights = (
            np.full(n, 1.0 / max(n, 1))
            if self.weights is None
            else np.asarray(self.weights, dtype=float)
        )
        if not np.isfinite(self.mass) or self.mass < 0.0:
            raise InputError(f"a point mass of {self.mass:g} kg: its mass must be zero or more.")
        if n == 0:
            raise InputError("a point mass must hang on at least one vertex.")
        if (
            weights.shape != (n,)
            or not (weights >= 0.0).all()
            or not abs(weights.sum() - 1.0) <= 1e-9
        ):
            raise InputError(
                f"a point mass on {n} vertices needs {n} weights, zero or more, that sum to one."
            )
        mass = np.zeros(n_vertices)
        np.add.at(mass, vertices, weights * self.mass)
        return mass


@checks_methods("plot", "write_vtk")
@dataclass(frozen=True)
class Body:
    """A mesh with its boundary conditions, masses and integration rule."""

    mesh: Mesh  # the rest shape
    # vertices with prescribed positions (Dirichlet), at rest unless `Inputs.fixed_positions` moves
    # them
    fixed: ArrayLike = ()
    # ``row_sum`` lumps the mass of each element on its vertices (HRZ for 10-node tetrahedra).
    # ``per_vertex`` gives every vertex the density times the mean element volume: wrong by a factor
    # of two on the published beam, and meant only for comparison with the published code
    mass: str = "row_sum"
    # ``centre`` or ``full`` (see `integration_points.discretise`)
    volume_integration: str = "centre"
    point_masses: Sequence[PointMass] = field(default=())  # attached weights
    energies: Sequence[BodyEnergy] = field(default=())  # besides the material: pressure, fibres
    rigid: Mapping[str, Rigid] = field(default_factory=dict)  # rigid parts, by region of the mesh
    glued: Sequence[Glue] = field(default=())  # vertices that follow a region of another mesh
    symmetry: Sequence[SymmetryPlane] = field(default=())  # planes in which their vertices slide
    # sets of integration points of each energy
    energy_points: tuple[tuple[Points, ...], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Checks the fixed vertices, the mass mode and the energies.

        Raises:
            InputError: an unknown mass mode, fixed vertices that the mesh does not have, or two
                energies with a parameter or an input of the same name.
            MeshError: a mesh that an energy cannot use, such as one with an open chamber.
        """
        check_fields(self)
        if self.mass not in MASS_MODES:
            raise InputError(f"mass is {self.mass!r}: choose one of {', '.join(MASS_MODES)}.")
        fixed = np.unique(vertex_indices(self.fixed, self.n_vertices, "fixed vertices"))
        object.__setattr__(self, "fixed", fixed)
        names = [
            quantity.name
            for energy in self.energies
            for quantity in (*energy.parameters, *energy.inputs)
        ]
        duplicates = [name for name in names if names.count(name) > 1]
        if duplicates:
            raise InputError(
                f"two energies of the body depend on {duplicates[0]}: put them into one."
            )
        object.__setattr__(
            self, "energy_points", tuple(energy.points(self.mesh) for energy in self.energies)
        )
        if self.rigid or self.glued or self.symmetry:
            self.coordinates  # noqa: B018  # Checks rigid parts, glue and planes.

    @classmethod
    def rigid_body(cls, mesh: Mesh, part: Rigid | None = None, **options: Any) -> "Body":
        """Returns a body whose every cell belongs to one rigid part, ``body``.

        Args:
            mesh: its rest shape.
            part: density and stiffness; `Rigid()`, of 1200 kg/m^3, if omitted.
            options: further arguments of `Body` except `rigid`.

        Raises:
            InputError: the mesh has a region of that name.
        """
        if "body" in mesh.regions:
            raise InputError(
                "the mesh of a rigid body has a region 'body', "
                "which would stand for all of it: rename it."
            )
        whole = replace(mesh, regions={**mesh.regions, "body": np.arange(len(mesh.cells))})
        return cls(whole, rigid={"body": Rigid() if part is None else part}, **options)

    def moved(self, rotation: ArrayLike, translation: ArrayLike) -> "Body":
        """Returns the body at R x + t, with its actuators.

        Obstacles, and fibres of a material, stay as they are.

        Args:
            rotation: (3, 3) R.
            translation: (3,) t [m].

        Raises:
            InputError: a body with a symmetry plane, or a matrix that is no rotation.
        """
        r, t = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
        if (
            r.shape != (3, 3)
            or not np.allclose(r @ r.T, np.eye(3), atol=1e-9)
            or np.linalg.det(r) < 0.0
        ):
            raise InputError(
                f"the rotation is {r.tolist()}: "
                "give a (3, 3) matrix of orthogonal rows, without mirror."
            )
        if t.shape != (3,) or not np.isfinite(t).all():
            raise InputError(f"the translation is {t.tolist()}: give three numbers, in m.")
        if self.symmetry:
            raise InputError(
                "a body with a symmetry plane stays in its place: "
                "leave the plane out, and model all of it."
            )
        mesh = replace(self.mesh, vertices=self.mesh.vertices @ r.T + t)
        return replace(self, mesh=mesh, energies=[energy.moved(r, t) for energy in self.energies])

    @property
    def members(self) -> "Iterator[tuple[str, Body, int]]":
        """Name, body and index of the first vertex of each body of a scene:
        here of this body alone, without a name.
        """
        yield "", self, 0

    @property
    def vertices(self) -> NDArray[np.float64]:
        """(N, 3) rest positions [m]."""
        return self.mesh.vertices

    def __repr__(self) -> str:
        """Mesh, number of fixed vertices, rigid parts, energies,
        and numbers of glued regions and symmetry planes.
        """
        parts = [repr(self.mesh), f"{len(self.fixed_vertices)} fixed vertices"]
        parts += [f"rigid {name}" for name in self.rigid] + [
            type(energy).__name__ for energy in self.energies
        ]
        parts += [
            f"{len(parts_of)} {name}"
            for name in ("glued", "symmetry")
            if (parts_of := getattr(self, name))
        ]
        return f"Body({', '.join(parts)})"

    def plot(
        self,
        state: Any = None,
        environment: int = 0,
        screenshot: str | Path | None = None,
        plotter: Any = None,
        **options: Any,
    ) -> Any:
        """Draws the body with pyvista, in a state or at rest,
        with dots at its fixed vertices (`Mesh.plot`).

        Args:
            state: a state of the simulator or of a robot, or positions (N, 3) or (B, N, 3) [m]; at
                rest if omitted.
            environment: its index.
            screenshot: PNG file to draw off screen.
            plotter: a ``pyvista.Plotter`` to which the body is only added.
            options: of ``pyvista.Plotter.add_mesh``.

        Returns:
            The plotter.

        Raises:
            InputError: positions of another body, or an unknown environment.
        """
        at = self._at(self.vertices if state is None else getattr(state, "q", state), environment)
        meshes = (
            (at[first:][: member.n_vertices], member.mesh) for _, member, first in self.members
        )
        parts = ((points, mesh.cells, mesh.element, mesh.regions) for points, mesh in meshes)
        return plot_parts(parts, at[self.fixed_vertices], screenshot, plotter, **options)

    def write_vtk(self, path: str | Path, state: Any = None, environment: int = 0) -> Path:
        """Writes the body in a state to a file for ParaView,
        as `Motion.write_vtk` does for a motion.

        The vertices have their ``displacement``, and of a state the ``velocity`` and any
        ``reaction`` [N].

        Args:
            path: path of the ``.vtu`` file.
            state: as for `plot`.
            environment: index of the environment.

        Raises:
            InputError: positions of another body, an unknown environment, or another extension.
            DataFileError: the file cannot be written.
        """
        at = self._at(self.vertices if state is None else getattr(state, "q", state), environment)
        moving = {"velocity": self._at(state.v, environment)} if hasattr(state, "v") else {}
        fields = {"displacement": at - self.vertices, **moving}
        reaction = getattr(state, "reaction", None)
        if reaction is not None:
            fields["reaction"] = np.zeros_like(at)
            fields["reaction"][reaction.vertices.cpu()] = (
                reaction.forces[environment].detach().cpu().numpy()
            )
        blocks = [
            (body.mesh.element.file_type, body.mesh.cells + first)
            for _, body, first in self.members
        ]
        return write_vtu(Path(path).expanduser(), at, blocks, fields)

    def _at(self, values: Any, environment: int) -> NDArray[np.float64]:
        """Returns vectors (N, 3) of an environment, from those of one or of several (B, N, 3)."""
        q = torch.as_tensor(values).detach().cpu().numpy()
        if (
            q.shape[-2:] != self.vertices.shape
            or q.ndim > 3
            or not 0 <= environment < (len(q) if q.ndim == 3 else 1)
        ):
            raise InputError(
                f"positions have shape {q.shape}, and environment is {environment}: give "
                f"{self.vertices.shape} positions, or such an array for each environment."
            )
        return np.asarray(q[environment] if q.ndim == 3 else q, dtype=np.float64)

    @property
    def n_vertices(self) -> int:
        """Number of vertices N."""
        return len(self.mesh.vertices)

    @property
    def fixed_vertices(self) -> NDArray[np.int64]:
        """(D,) vertices with prescribed positions, in ascending order."""
        return np.asarray(self.fixed)

    def fixed_in(self, part: str) -> NDArray[np.int64]:
        """Returns the fixed vertices (K,) of a region, or of a body of a scene.

        Raises:
            InputError: an unknown name, or nothing that is fixed.
        """
        named: dict[str, NDArray[np.int64]] = {}
        for name, member, first in self.members:
            named |= {name: first + np.arange(member.n_vertices)} if name else {}
            for region, cells in member.mesh.regions.items():
                named[f"{name}_{region}" if name else region] = first + np.unique(
                    member.mesh.cells[cells]
                )
        if part not in named:
            known = f"choose one of {', '.join(named)}" if named else "its mesh has no regions"
            raise InputError(f"the body has no region {part!r}: {known}.")
        found = np.intersect1d(self.fixed_vertices, named[part])
        if not len(found):
            raise InputError(f"no vertex of {part!r} is fixed: fix some, or choose another region.")
        return found

    def sliding_in(self, plane: SymmetryPlane) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Returns vertices (K,) that slide in a symmetry plane,
        which gives c . f of a force f on them, and c (K, 3).

        Raises:
            InputError: the body has no such plane, or all of its vertices are fixed.
        """
        vertices, shares = list[NDArray[np.int64]](), list[NDArray[np.float64]]()
        for _, member, first in self.members:
            if plane in member.symmetry:
                sliding = member.coordinates.sliding
                inside = sliding[plane.contains(member.vertices[sliding])]
                vertices.append(first + inside)
                shares.append(plane_shares(member.symmetry, plane, member.vertices[inside]))
        if not sum(map(len, vertices)):
            raise InputError(
                f"no vertex slides in a symmetry plane {plane}: "
                "choose one of the body's `symmetry`."
            )
        return np.concatenate(vertices), np.concatenate(shares)

    @cached_property
    def discretisation(self) -> Discretisation:
        """Integration points and volumes of the whole mesh."""
        return self.discretised()

    def discretised(self, cells: NDArray[np.int64] | None = None) -> Discretisation:
        """Returns integration points and volumes of some cells, or of all."""
        return discretise(self.mesh, self.volume_integration, cells, cracks=bool(self.glued))

    @cached_property
    def soft_cells(self) -> NDArray[np.int64] | None:
        """(m,) cells outside the rigid parts; None without rigid parts."""
        if not self.rigid:
            return None
        rigid = np.concatenate([self.mesh.region(name) for name in self.rigid])
        return np.setdiff1d(np.arange(len(self.mesh.cells)), rigid)

    @property
    def controls(self) -> dict[str, NDArray[np.int64]]:
        """Four control vertices of each movable rigid part, by name."""
        return self._dependence[0]

    @property
    def coordinates(self) -> Coordinates:
        """The map from control vertices, some of which slide in planes, to all vertices."""
        return self._dependence[1]

    @cached_property
    def _dependence(self) -> tuple[dict[str, NDArray[np.int64]], Coordinates]:
        """Control vertices of the rigid parts, and the map from control vertices to all vertices.

        Raises:
            InputError: a rigid part with only some vertices fixed, two parts that share vertices, a
                flat part, a symmetry plane without vertices, or glued vertices that are fixed,
                rigid, or too far from the region they are glued to.
            MeshError: an unknown region.
        """
        weights = scipy.sparse.csr_array((self.n_vertices, self.n_vertices))
        controls: dict[str, NDArray[np.int64]] = {}
        part_of_vertex: dict[int, str] = {}
        for name in self.rigid:
            vertices = np.unique(self.mesh.cells[self.mesh.region(name)])
            n_fixed = int(np.isin(vertices, self.fixed_vertices).sum())
            if n_fixed == len(vertices):
                continue
            if n_fixed:
                raise InputError(
                    f"{n_fixed} of the {len(vertices)} vertices of the rigid part {name!r} are "
                    "fixed: fix all of them, or none."
                )
            other = next(
                (part_of_vertex[i] for i in vertices.tolist() if i in part_of_vertex), None
            )
            if other:
                raise InputError(
                    f"the rigid parts {other!r} and {name!r} share vertices: make them one region."
                )
            part_of_vertex |= dict.fromkeys(vertices.tolist(), name)
            controls[name], part_weights = rigid_weights(
                self.mesh.vertices, vertices, name, self.symmetry
            )
            weights += part_weights
        for glue in self.glued:
            glued = self._glued_weights(glue, part_of_vertex)
            twice = np.flatnonzero(np.diff(weights.indptr) * np.diff(glued.indptr))
            if len(twice):
                raise InputError(
                    f"vertex {twice[0]} is glued twice: leave it out of the glue to {glue.to!r}."
                )
            weights += glued
        return controls, Coordinates.of(weights).with_planes(
            self.symmetry, self.mesh.vertices, self.fixed_vertices
        )

    def _glued_weights(self, glue: Glue, rigid: Mapping[int, str]) -> scipy.sparse.csr_array:
        """Returns weights (N, N) of control vertices in glued ones,
        from shape functions of the containing cells.
        """
        vertices = np.unique(vertex_indices(glue.vertices, self.n_vertices, "glued vertices"))
        cells = self.mesh.cells[self.mesh.region(glue.to)]
        for what, others in (
            ("fixed", self.fixed_vertices),
            ("part of a rigid part", np.array(list(rigid))),
        ):
            if np.isin(vertices, others).any():
                raise InputError(
                    f"a vertex that is glued to {glue.to!r} is {what}: leave it out of the glue."
                )
        if np.isin(vertices, cells).any():
            raise InputError(
                f"a vertex that is glued to {glue.to!r} belongs to it: "
                "glue vertices of another region."
            )
        used, renumbered = np.unique(cells, return_inverse=True)
        region = Mesh(self.mesh.vertices[used], renumbered.reshape(cells.shape))
        places = locate(region, self.mesh.vertices[vertices])
        if float(places.outside.max()) > glue.tolerance:
            far = int(places.outside.argmax())
            raise InputError(
                f"vertex {vertices[far]} is {places.outside[far]:.3g} m from the region "
                f"{glue.to!r} that it is glued to, farther than the tolerance of "
                f"{glue.tolerance:g} m: move the meshes together, or raise it."
            )
        return dependence(self.n_vertices, vertices, cells[places.cells], places.weights)

    @cached_property
    def mass_volume(self) -> scipy.sparse.csr_array:
        """(N, M) share of each vertex in the volume of each element, for the mass [m^3]."""
        return (
            self._per_vertex_volume
            if self.mass == "per_vertex"
            else self.discretisation.lumped_volume
        )

    @cached_property
    def load_volume(self) -> scipy.sparse.csr_array:
        """(N, M) share of each vertex in the volume of each element, for gravity [m^3]."""
        return (
            self._per_vertex_volume
            if self.mass == "per_vertex"
            else self.discretisation.load_volume
        )

    @cached_property
    def _per_vertex_volume(self) -> scipy.sparse.csr_array:
        volumes = self.discretisation.element_volumes
        return scipy.sparse.csr_array(np.tile(volumes / len(volumes), (self.n_vertices, 1)))

    @cached_property
    def attached_mass(self) -> NDArray[np.float64]:
        """(N,) mass of the attached weights, and of rigid parts
        that are fixed, which only clamps feel [kg].
        """
        mass = sum(
            (m.per_vertex(self.n_vertices) for m in self.point_masses), np.zeros(self.n_vertices)
        )
        for name in self.rigid.keys() - self.controls.keys():
            volume = self.load_volume[:, self.mesh.region(name)].sum(axis=1)
            mass = mass + self.rigid[name].density * volume
        return mass
