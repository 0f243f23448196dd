"""Builds meshes, bodies, materials and simulators from settings.

A mesh and a body are built once a process for the same settings, as checks, stages and reports ask for the same ones.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike

from ..data.marker_view import MarkerView
from ..data.markers import Markers, bind_markers
from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.materials import Material, make_material
from ..fem.body import Body
from ..fem.rigid import Glue, Rigid
from ..io.atomic import digest
from ..io.errors import InputError, MeshError
from ..io.settings import parse
from ..mesh.arm import mesh_arm
from ..mesh.arm_geometry import ArmGeometry
from ..mesh.boxes import boxes_hexahedra
from ..mesh.mesh import Mesh, box_hexahedra, box_tetrahedra, check_mesh, join, quadratic, select_cells, select_vertices
from ..mesh.readers import read_mesh
from ..mesh.rod import rod
from ..mesh.tetrahedra import fill_surface
from ..settings.body import (
    BodySettings,
    BoxesMesh,
    BoxSettings,
    FileMesh,
    GeneratedArm,
    HexahedralBox,
    MaterialSettings,
    MeshGroup,
    MeshSettings,
    PlaceSettings,
    RodMesh,
    ShippedArm,
    SimulatorSettings,
    SurfaceMesh,
    TetrahedralBox,
)
from ..settings.trials import BindingSettings, MarkerSettings
from .actuators import build_actuators

_DTYPES = {"float64": torch.float64, "float32": torch.float32}


def choose_device(name: str) -> torch.device:
    """The named device; ``auto`` is CUDA where torch finds one.

    Raises:
        InputError: an unknown device, or CUDA without a CUDA device.
    """
    available = torch.cuda.is_available()
    if name == "auto":
        return torch.device("cuda" if available else "cpu")
    if not re.fullmatch(r"(cpu|cuda)(:\d+)?", name):
        raise InputError(f"device is {name!r}: choose auto, cpu or cuda.")
    device = torch.device(name)
    if device.type == "cuda" and not available:
        raise InputError(f"device is {name!r}, but torch finds no CUDA device: choose device=cpu.")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(f"device is {name!r}, but torch finds {torch.cuda.device_count()} CUDA devices.")
    return device


def simulation_device(name: str) -> torch.device:
    """Where bodies are simulated: ``auto`` is the CPU."""
    return choose_device("cpu" if name == "auto" else name)


def build_mesh(settings: MeshSettings) -> Mesh:
    """The mesh of the group ``mesh``.

    Raises:
        InputError: an unknown arm.
        MeshError: a mesh that cannot be read or simulated.
    """
    return _built_mesh(settings.model_dump_json(), _file_of(settings))


def _file_of(settings: MeshSettings) -> str | None:
    """Digest of the file that a mesh is read from, if there is one: what is built is built anew where it changes."""
    path = getattr(settings, "path", None)
    return digest(path) if path is not None and Path(path).is_file() else None


@lru_cache(maxsize=8)
def _built_mesh(content: str, file: str | None) -> Mesh:
    """The mesh of settings as JSON; ``file`` is the digest of the file that it is read from."""
    mesh = _read_or_made(parse(MeshGroup, {"mesh": json.loads(content)}).mesh)
    check_mesh(mesh)
    return mesh


def _read_or_made(settings: MeshSettings) -> Mesh:
    match settings:
        case HexahedralBox():
            return box_hexahedra(settings.size, settings.divisions, settings.nodes)
        case TetrahedralBox():
            return box_tetrahedra(settings.size, settings.divisions, settings.order)
        case BoxesMesh():
            return boxes_hexahedra(settings.boxes, settings.size, settings.nodes)
        case FileMesh():
            return read_mesh(settings.path, settings.units, settings.order, settings.drop_unreferenced)
        case SurfaceMesh():
            return fill_surface(settings.path, settings.size, settings.units, settings.order)
        case ShippedArm():
            return shipped_arm(settings.name)
        case RodMesh():
            return rod(**{key: value for key, value in dict(settings).items() if key != "kind"})
        case GeneratedArm():
            geometry = ArmGeometry(**{each.name: getattr(settings, each.name) for each in fields(ArmGeometry)})
            mesh, _ = mesh_arm(geometry, settings.size, settings.cells, settings.layers)
            return quadratic(mesh) if settings.order == 2 else mesh


def finer(settings: MeshSettings, times: float) -> MeshSettings:
    """The group ``mesh`` with so many times as many cells along the edges of a box, along a rod's axis, or everywhere.

    Raises:
        InputError: a mesh whose cells are given.
    """
    match settings:
        case HexahedralBox() | TetrahedralBox():
            return settings.changed(divisions=[math.ceil(times * each) for each in settings.divisions])
        case BoxesMesh() | SurfaceMesh():
            return settings.changed(size=settings.size / times)
        case RodMesh():
            return settings.changed(layers=math.ceil(times * settings.layers))
        case GeneratedArm():
            layers = None if settings.layers is None else settings.layers / times
            return settings.changed(size=settings.size / times, layers=layers)
    raise InputError(
        f"mesh_check: the cells of a mesh of the kind {settings.kind!r} are given and cannot be made finer: take null."
    )


def shipped_arm(name: str) -> Mesh:
    """One of the meshes that come with the package.

    Raises:
        InputError: there is none of that name.
    """
    folder = resources.files("warp_resphys") / "meshes"
    known = sorted(each.name.removesuffix(".msh") for each in folder.iterdir() if each.name.endswith(".msh"))
    if name not in known:
        raise InputError(f"mesh.name is {name!r}: the arms that come with the package are {', '.join(known)}.")
    with resources.as_file(folder / f"{name}.msh") as path:
        return read_mesh(path)


def build_material(settings: MaterialSettings, key: str) -> Material | dict[str, Material]:
    """The material of a group, or those of its regions by name; errors begin with the group's dotted key.

    Raises:
        InputError: an unknown constant, or one out of range.
    """
    found = {}
    for region, own in settings.by_region.items():
        try:
            found[region] = make_material(own.model, **own.constants)
        except InputError as error:
            raise InputError(f"{key}.regions.{region}: {error}" if region else f"{key}: {error}") from error
    return found.get("", found)


def build_body(settings: BodySettings, payload_at: PlaceSettings | None = None, mesh: Mesh | None = None) -> Body:
    """The body of a configuration.

    Args:
        settings: its mesh, masses, fixed vertices, and what acts on it.
        payload_at: vertices that carry the payloads of a string.
        mesh: in place of that of the settings.

    Raises:
        InputError: another number of chambers than the mesh has, or tendons or muscles that do not fit.
        MeshError: a mesh that cannot be read or simulated, or no vertex where the body is fixed.
    """
    if mesh is not None:
        return _body(settings, payload_at, mesh)
    of_body = BodySettings.of(settings)
    place = None if payload_at is None else payload_at.model_dump_json()
    files = tuple(_file_of(mesh) for mesh in (settings.mesh, *(part.mesh for part in settings.parts.values())))
    return _built_body(of_body.model_dump_json(), place, files)


@lru_cache(maxsize=8)
def _built_body(content: str, place: str | None, files: tuple[str | None, ...]) -> Body:
    """The body of settings as JSON; ``files`` are the digests of the files of its meshes."""
    settings = parse(BodySettings, json.loads(content))
    payload_at = None if place is None else parse(PlaceSettings, json.loads(place))
    return _body(settings, payload_at, whole_mesh(settings))


def _body(settings: BodySettings, payload_at: PlaceSettings | None, mesh: Mesh) -> Body:
    mesh = _with_regions(mesh, settings.regions)
    energies = build_actuators(settings, mesh, payload_at)
    fixed = select_vertices(mesh, **settings.fixed.arguments())
    rigid = {name: Rigid(**dict(part)) for name, part in settings.rigid.items()}
    glued = [_glue(mesh, settings, number) for number in range(len(settings.glued))]
    physics = dict(settings.physics)
    return Body(mesh, energies=tuple(energies), fixed=fixed, rigid=rigid, glued=glued, **physics)


def whole_mesh(settings: BodySettings) -> Mesh:
    """Returns the mesh of a body with those of its ``parts``, each of which is a region.

    Raises:
        InputError: an unknown arm.
        MeshError: a mesh that cannot be read or simulated, or meshes with different kinds of cells.
    """
    mesh = build_mesh(settings.mesh)
    if not settings.parts:
        return mesh
    parts = {}
    for name, part in settings.parts.items():
        own = build_mesh(part.mesh)
        parts[name] = replace(own, vertices=own.vertices + np.asarray(part.shift))
    joined = join({"body": mesh, **parts})
    return replace(joined, regions={**joined.regions, **mesh.regions})


def _glue(mesh: Mesh, settings: BodySettings, number: int) -> Glue:
    """Returns the glue of one entry of ``glued``."""
    glue = settings.glued[number]
    try:
        members = np.unique(mesh.cells[mesh.region(glue.region)])
        mesh.region(glue.to)
        vertices = np.intersect1d(select_vertices(mesh, **glue.at.arguments()), members)
    except MeshError as error:
        raise MeshError(f"glued[{number}]: {error}") from None
    if not len(vertices):
        raise MeshError(f"glued[{number}].at: no vertex of the region {glue.region!r} lies there.")
    return Glue(vertices, glue.to, glue.tolerance)


def _with_regions(mesh: Mesh, boxes: Mapping[str, BoxSettings]) -> Mesh:
    """A mesh with the regions of the group ``regions`` beside its own."""
    regions = dict(mesh.regions)
    for name, box in boxes.items():
        try:
            regions[name] = select_cells(mesh, **box.arguments())
        except MeshError as error:
            raise MeshError(f"regions.{name}: {error}") from None
    return replace(mesh, regions=regions)


def bound_markers(settings: BindingSettings, mesh: Mesh, places: ArrayLike, labels: Sequence[str]) -> Markers:
    """Markers at places (M, 3) on the undeformed body [m], in float64 on the CPU, from the group ``markers``.

    Raises:
        InputError: see `bind_markers`.
        MeshError: no vertex lies where ``markers.bind_to`` says.
    """
    to = settings.bind_to
    return bind_markers(
        mesh,
        places,
        labels,
        kind=settings.bind,
        vertices=None if to is None else select_vertices(mesh, **to.arguments()),
        largest_distance=settings.largest_distance,
        patch=settings.patch,
    )


def marker_view_of(
    settings: MarkerSettings, labels: Sequence[str], sets: tuple[tuple[int, ...], ...] = ()
) -> MarkerView:
    """How much recordings tell of where these tracked markers are, from the group ``markers``.

    Args:
        settings: the group.
        labels: of the markers.
        sets: the numbers of those that are seen together, if not all are.

    Raises:
        InputError: see `MarkerView`.
    """
    return MarkerView.of([settings.tracked[label] for label in labels], settings.plane, settings.frame, sets)


def build_simulator(
    settings: SimulatorSettings,
    material: MaterialSettings,
    body: Body | None = None,
    payload_at: PlaceSettings | None = None,
    on_failure: str | None = None,
) -> Simulator:
    """The simulator of a configuration.

    Args:
        settings: of the simulator and its body.
        material: of the body.
        body: in place of that of the settings.
        payload_at: vertices that carry the payloads of a string.
        on_failure: in place of the configured one.

    Raises:
        InputError: a value that cannot be simulated.
    """
    solver = dict(settings.solver) | ({} if on_failure is None else {"on_failure": on_failure})
    return Simulator(
        build_body(settings, payload_at) if body is None else body,
        build_material(material, "simulation"),
        time_step=settings.time_step,
        gravity=settings.gravity,
        integrator=settings.integrator,
        solver=SolverSettings(**solver),
        device=simulation_device(settings.device),
        dtype=_DTYPES[settings.dtype],
        coupling=settings.coupling,
    )
