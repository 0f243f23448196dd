"""Builds meshes, bodies, materials and simulators from settings.

Meshes and bodies are cached by their settings, since checks, stages and reports need the same ones.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib import resources
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike

from ..core.dynamics.plausibility import check_weight
from ..core.dynamics.simulator import Simulator
from ..core.energies.catalogue import make_material
from ..core.energies.materials import Material
from ..core.fem.bodies import Body, Glue
from ..core.fem.coordinates import SymmetryPlane
from ..core.mesh.arm import mesh_arm
from ..core.mesh.arm_dimensions import ArmMesh
from ..core.mesh.boxes import box_hexahedra, box_tetrahedra, boxes_hexahedra
from ..core.mesh.readers import read_mesh
from ..core.mesh.rod import rod
from ..core.mesh.selection import select_cells, vertices_at
from ..core.mesh.tetrahedra import fill_surface
from ..core.mesh.volume_mesh import Mesh, check_mesh, join, quadratic
from ..data.force_sensors import ForceSensor
from ..data.marker_view import MarkerView
from ..data.markers import BoundMarkers, JoinedMarkers, Markers, bind_markers, follow_vertices
from ..data.rigid_bodies import arms, corners_of
from ..io.arrays import FloatArray, IntArray
from ..io.atomic import digest
from ..io.errors import InputError, MeshError, naming
from ..io.machine import available_memory_gib, find_device
from ..io.settings import Settings
from ..settings.body import BodySettings, MaterialSettings, SimulatorSettings
from ..settings.meshing import (
    BoxesMesh,
    FileMesh,
    HexahedralBox,
    MeshSettings,
    RodMesh,
    ShippedArm,
    SurfaceMesh,
    SymmetrySettings,
    TetrahedralBox,
)
from ..settings.observed import (
    BindingSettings,
    ForceSensorSettings,
    MarkerSettings,
    RigidBodySettings,
)
from .actuators import build_actuators

_BYTES_PER_CELL = 4_000  # lower bound for the mesh, its points and its matrix
_SHARE_OF_MEMORY = 0.8


def choose_device(name: str) -> torch.device:
    """Returns the named device; ``auto`` is CUDA if available.

    Raises:
        InputError: the device is unknown or unavailable.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return find_device(name, "auto, cpu or cuda")


def simulation_device(name: str) -> torch.device:
    """Device of the simulation; ``auto`` is the CPU."""
    return choose_device("cpu" if name == "auto" else name)


def _shipped_arms() -> list[str]:
    folder = resources.files("warp_resphys") / "meshes"
    return sorted(
        file.name.removesuffix(".msh") for file in folder.iterdir() if file.name.endswith(".msh")
    )


def shipped_arm(name: str) -> Mesh:
    """Reads a mesh that is shipped with the package.

    Raises:
        InputError: the name is unknown.
    """
    names = _shipped_arms()
    if name not in names:
        raise InputError(
            f"mesh.name is {name!r}: the arms that come with the package are {', '.join(names)}."
        )
    with resources.as_file(resources.files("warp_resphys") / "meshes" / f"{name}.msh") as path:
        return read_mesh(path)


_MAKERS: Mapping[type[Settings], Callable[..., Mesh]] = {
    HexahedralBox: box_hexahedra,
    TetrahedralBox: box_tetrahedra,
    BoxesMesh: boxes_hexahedra,
    FileMesh: read_mesh,
    SurfaceMesh: fill_surface,
    ShippedArm: shipped_arm,
    RodMesh: rod,
}


def build_mesh(settings: MeshSettings) -> Mesh:
    """Builds the mesh of the group ``mesh``.

    Raises:
        InputError: an unknown arm.
        MeshError: a mesh that cannot be read or simulated.
    """
    return _built_mesh(settings, _file_of(settings))


def _file_of(settings: MeshSettings) -> str | None:
    """Digest of the file of a mesh, if any, so that a changed file is read again."""
    path = getattr(settings, "path", None)
    return digest(path) if path is not None and Path(path).is_file() else None


@lru_cache(maxsize=8)
def _built_mesh(settings: MeshSettings, file: str | None) -> Mesh:
    """Builds a mesh; ``file`` is the digest of its file."""
    if isinstance(settings, HexahedralBox | TetrahedralBox):
        _check_memory(settings.divisions)
    if isinstance(settings, ArmMesh):
        mesh, _ = mesh_arm(settings)
        mesh = quadratic(mesh) if settings.order == 2 else mesh
    else:
        mesh = _MAKERS[type(settings)](**settings.arguments())
    check_mesh(mesh)
    return mesh


def _check_memory(divisions: Sequence[int]) -> None:
    """Refuses a box whose cells do not fit into the free memory."""
    cells, limit = math.prod(divisions), _SHARE_OF_MEMORY * available_memory_gib()
    needed = cells * _BYTES_PER_CELL / 2**30
    if needed > limit:
        raise InputError(
            f"mesh.divisions gives {cells:,} cells, which take at least {needed:.3g} GiB, but "
            f"{limit:.3g} GiB are free: use fewer."
        )


def finer(settings: MeshSettings, times: float) -> MeshSettings:
    """Refines the group ``mesh`` by a factor: along the edges of a box,
    along a rod's axis, or everywhere.

    Linear cells of a file become quadratic, and an arm of the package the next finer one. Cells
    that are given and cannot be refined stay as they are.
    """
    match settings:
        case HexahedralBox() | TetrahedralBox():
            return settings.changed(
                divisions=[math.ceil(times * cells) for cells in settings.divisions]
            )
        case BoxesMesh() | SurfaceMesh():
            return settings.changed(size=settings.size / times)
        case RodMesh():
            return settings.changed(layers=math.ceil(times * settings.layers))
        case ArmMesh():
            layers = None if settings.layers is None else settings.layers / times
            return settings.changed(size=settings.size / times, layers=layers)
        case FileMesh():
            return settings.changed(order=2)
        case ShippedArm():
            by_size = sorted(_shipped_arms(), key=lambda name: int(name.rpartition("_")[2]))
            return settings.changed(name=dict(pairwise(by_size)).get(settings.name, settings.name))


def build_material(settings: MaterialSettings, key: str) -> Material | dict[str, Material]:
    """Builds the material of a group, or the materials of its regions by name.

    Errors begin with the dotted key.

    Raises:
        InputError: a constant is unknown or out of range.
    """
    materials = {}
    for region, chosen in settings.by_region.items():
        with naming(f"{key}.regions.{region}: " if region else f"{key}: "):
            materials[region] = make_material(chosen.model, **chosen.values)
    return materials.get("", materials)


def build_body(settings: BodySettings, mesh: Mesh | None = None) -> Body:
    """Builds the body of a configuration.

    Args:
        settings: mesh, masses, fixed vertices and actuators of the body.
        mesh: mesh to use instead of the configured one.

    Raises:
        InputError: the number of chambers differs from the mesh, or tendons or muscles do not fit.
        MeshError: the mesh cannot be read or simulated, or has no vertex where the body is fixed.
    """
    if mesh is not None:
        return _body(settings, mesh)
    files = tuple(_file_of(mesh) for mesh in settings.meshes)
    return _built_body(BodySettings.of(settings), files)


@lru_cache(maxsize=8)
def _built_body(settings: BodySettings, files: tuple[str | None, ...]) -> Body:
    """Builds a body; ``files`` are the digests of the files of its meshes."""
    return _body(settings, whole_mesh(settings))


def _body(settings: BodySettings, mesh: Mesh) -> Body:
    mesh = _with_regions(mesh, settings)
    energies = build_actuators(settings, mesh)
    fixed = () if settings.fixed is None else vertices_at(mesh, settings.fixed)
    glued = [_glue(mesh, settings, number) for number in range(len(settings.glued))]
    planes = _symmetry_planes(settings.symmetry)
    more = {"rigid": settings.rigid, "glued": glued, "symmetry": planes, **dict(settings.physics)}
    return Body(mesh, energies=tuple(energies), fixed=fixed, **more)


def _symmetry_planes(settings: SymmetrySettings | None) -> list[SymmetryPlane]:
    """Returns the planes of the group ``symmetry``."""
    if settings is None:
        return []
    at = [getattr(settings, axis) for axis in "xyz"]
    normals = np.eye(3).tolist()
    return [
        SymmetryPlane(n, x, settings.tolerance)
        for n, x in zip(normals, at, strict=True)
        if x is not None
    ]


def whole_mesh(settings: BodySettings) -> Mesh:
    """Returns the mesh of a body with those of its ``parts``, each of which is a region.

    Raises:
        InputError: an unknown arm.
        MeshError: a mesh that cannot be read or simulated, or meshes with different kinds of cells.
    """
    mesh = build_mesh(settings.mesh)
    if not settings.parts:
        return mesh
    if "body" in settings.parts:
        raise MeshError("parts.body: this is the name of the first mesh: choose another.")
    parts = {}
    for name, part in settings.parts.items():
        with naming(f"parts.{name}."):
            part_mesh = build_mesh(part.mesh)
        parts[name] = replace(part_mesh, vertices=part_mesh.vertices + np.asarray(part.shift))
    joined = join({"body": mesh, **parts})
    twice = joined.regions.keys() & mesh.regions.keys()
    if twice:
        raise MeshError(
            f"a part and a region of the first mesh have the name {min(twice)!r}: rename the part."
        )
    return replace(joined, regions={**joined.regions, **mesh.regions})


def _glue(mesh: Mesh, settings: BodySettings, number: int) -> Glue:
    """Returns the glue of one entry of ``glued``."""
    glue = settings.glued[number]
    with naming(f"glued[{number}]: "):
        members = np.unique(mesh.cells[mesh.region(glue.region)])
        mesh.region(glue.to)
        vertices = np.intersect1d(vertices_at(mesh, glue.at), members)
    if not len(vertices):
        raise MeshError(f"glued[{number}].at: no vertex of the region {glue.region!r} lies there.")
    return Glue(vertices, glue.to, glue.tolerance)


def _with_regions(mesh: Mesh, settings: BodySettings) -> Mesh:
    """Adds the regions of the group ``regions`` to a mesh."""
    regions = dict(mesh.regions)
    for name, box in settings.regions.items():
        if name in settings.parts:
            raise MeshError(f"regions.{name}: a part has this name already: choose another.")
        with naming(f"regions.{name}: "):
            regions[name] = select_cells(mesh, **box.arguments())
    return replace(mesh, regions=regions)


def bound_markers(
    settings: BindingSettings, mesh: Mesh, places: ArrayLike, labels: Sequence[str]
) -> Markers:
    """Binds observed points at places (M, 3) on the undeformed body [m],
    in float64 on the CPU, by `markers`.

    Raises:
        InputError: see `bind_markers`.
        MeshError: no vertex lies at ``markers.bind_to``, or where a rigid body is mounted.
    """
    to, points = settings.bind_to, np.asarray(places, dtype=np.float64)
    parts, rows = list[BoundMarkers](), list[list[int]]()
    for body, corners in corners_of(labels).items():
        parts.append(
            follow_vertices(mesh, mounted_on(settings.rigid_bodies[body], mesh), points[corners])
        )
        rows.append(list(range(corners.start, corners.stop)))
    marked = [row for row, label in enumerate(labels) if label in settings.tracked]
    if marked:
        tracked = mesh, points[marked], [labels[row] for row in marked]
        if settings.observation is not None:
            markers = settings.observation.factory(
                Markers, "markers.observation", len(tracked), "bind"
            )(*tracked)
            if type(markers).moved is Markers.moved:
                raise InputError(
                    f"markers.observation: {type(markers).__name__} has no method moved, which "
                    "identification and prediction intervals need, as places of markers are not "
                    "exact: add it, as in Markers."
                )
        else:
            markers = bind_markers(
                *tracked,
                kind=settings.bind,
                vertices=None if to is None else vertices_at(mesh, to),
                largest_distance=settings.largest_distance,
                patch=settings.patch,
            )
        parts, rows = [markers, *parts], [marked, *rows]
    return JoinedMarkers.of(parts, rows)


def mounted_on(settings: RigidBodySettings, mesh: Mesh) -> IntArray:
    """Returns the vertices of the part or the plate that a rigid body is mounted on.

    Raises:
        MeshError: the mesh has no such region or no vertex there.
    """
    if settings.part is None:
        assert settings.at is not None
        return vertices_at(mesh, settings.at)
    return np.unique(mesh.cells[mesh.region(settings.part)])


def force_sensor(settings: ForceSensorSettings) -> ForceSensor:
    """Returns a configured force sensor."""
    turned = tuple(math.radians(angle) for angle in settings.rotation)
    return ForceSensor(**{**dict(settings), "rotation": turned})


def nominal_places(settings: BindingSettings, mesh: Mesh) -> FloatArray:
    """(M, 3) nominal places of the observed points [m].

    Rigid bodies are aligned with the body, at their part's centre.

    Raises:
        MeshError: see `bound_markers`.
    """
    places = np.array([*settings.tracked.values()], dtype=np.float64).reshape(-1, 3)
    bodies = settings.rigid_bodies.values()
    return np.concatenate(
        [
            places,
            *(mesh.vertices[mounted_on(b, mesh)].mean(axis=0) + arms(b.length) for b in bodies),
        ]
    )


def marker_view_of(
    settings: MarkerSettings, labels: Sequence[str], sets: tuple[tuple[int, ...], ...] = ()
) -> MarkerView:
    """View of tracked markers in the recordings, by the group ``markers``:
    coordinates that are seen, and the frame.

    Args:
        settings: the group.
        labels: labels of the markers.
        sets: sets of marker indices that are seen together; by default all are.

    Raises:
        InputError: see `MarkerView`.
    """
    # Rigid bodies are seen in all coordinates, where nominal positions do not matter.
    nominal = torch.tensor(
        [settings.tracked.get(label, (0.0, 0.0, 0.0)) for label in labels], dtype=torch.float64
    )
    return MarkerView(nominal, settings.plane, settings.frame == "own", sets)


def build_simulator(
    settings: SimulatorSettings,
    material: MaterialSettings,
    body: Body | None = None,
    on_failure: str | None = None,
) -> Simulator:
    """Builds the simulator of a configuration.

    Args:
        settings: settings of the simulator and its body.
        material: material of the body.
        body: body to use instead of the configured one.
        on_failure: behaviour after a failed step, instead of the configured one.

    Raises:
        InputError: a value cannot be simulated.
    """
    solver = (
        settings.solver if on_failure is None else settings.solver.changed(on_failure=on_failure)
    )
    simulator = Simulator(
        build_body(settings) if body is None else body,
        build_material(material, "simulation"),
        time_step=settings.time_step,
        gravity=settings.gravity,
        integrator=settings.integrator,
        solver=solver,
        device=simulation_device(settings.device),
    )
    for made in simulator.materials.values():
        check_weight(simulator.body, made, settings.gravity)
    return simulator
