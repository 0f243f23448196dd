"""Builds meshes, bodies, materials and simulators from configurations."""

import math
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import torch
from numpy.typing import ArrayLike

from ..data.markers import Markers, bind_markers
from ..data.sight import Sight
from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.materials import Material, make_material
from ..fem.body import Body
from ..io.errors import InputError
from ..mesh.arm import mesh_arm
from ..mesh.arm_geometry import arm_geometry
from ..mesh.boxes import boxes_hexahedra
from ..mesh.mesh import Mesh, box_hexahedra, box_tetrahedra, check_mesh, quadratic, select_vertices
from ..mesh.readers import read_mesh
from ..mesh.rod import rod
from ..mesh.tetrahedra import fill_surface
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


def simulation_device(config: Mapping[str, Any]) -> torch.device:
    """Where bodies are simulated: ``auto`` is the CPU."""
    return choose_device("cpu" if config["device"] == "auto" else config["device"])


def build_mesh(config: Mapping[str, Any]) -> Mesh:
    """A mesh from the group ``mesh``; `schema` has what each kind takes.

    Raises:
        InputError: an unknown kind, or shipped arm.
        MeshError: a mesh that cannot be read or simulated.
    """
    kind = config["kind"]
    if kind == "box_hexahedra":
        mesh = box_hexahedra(config["size"], config["divisions"], config.get("nodes", 8))
    elif kind == "box_tetrahedra":
        mesh = box_tetrahedra(config["size"], config["divisions"], config.get("order", 1))
    elif kind == "boxes":
        mesh = boxes_hexahedra([(low, high) for low, high in config["boxes"]], config["size"], config["nodes"])
    elif kind == "file":
        mesh = read_mesh(config["path"], config["units"], config["order"], config["drop_unreferenced"])
    elif kind == "surface":
        mesh = fill_surface(config["path"], config["size"], config["units"], config["order"])
    elif kind == "arm":
        mesh = shipped_arm(config["name"])
    elif kind == "arm_generated":
        mesh, _ = mesh_arm(arm_geometry(config), config["size"], config["cells"], config["layers"])
        mesh = quadratic(mesh) if config["order"] == 2 else mesh
    elif kind == "rod":
        mesh = rod(**{str(key): value for key, value in config.items() if key != "kind"})
    else:
        raise InputError(f"mesh.kind is {kind!r}: choose one of those in conf/mesh.")
    check_mesh(mesh)
    return mesh


def finer(config: Mapping[str, Any], times: float) -> dict[str, Any]:
    """The group ``mesh`` with so many times as many cells along the edges of a box, along a rod's axis, or everywhere.

    Raises:
        InputError: a mesh whose cells are given.
    """
    kind = config["kind"]
    if kind in ("box_hexahedra", "box_tetrahedra"):
        return {**config, "divisions": [math.ceil(times * each) for each in config["divisions"]]}
    if kind in ("boxes", "surface"):
        return {**config, "size": config["size"] / times}
    if kind == "rod":
        return {**config, "layers": math.ceil(times * config["layers"])}
    if kind == "arm_generated":
        layers = None if config["layers"] is None else config["layers"] / times
        return {**config, "size": config["size"] / times, "layers": layers}
    raise InputError(
        f"mesh_check: the cells of a mesh of the kind {kind!r} are given and cannot be made finer: take null."
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


def build_material(config: Mapping[str, Any], key: str) -> Material:
    """The material of a group.

    Raises:
        InputError: an unknown constant, or one out of range.
    """
    try:
        return make_material(**{str(name): value for name, value in config[key].items()})
    except InputError as error:
        raise InputError(f"{key}: {error}") from error


def build_body(config: Mapping[str, Any], mesh: Mesh | None = None) -> Body:
    """A body from the groups ``mesh``, ``physics``, ``fixed``, and any of its actuators' groups and ``fibres``.

    Args:
        config: these groups.
        mesh: where it is there already, in place of the group ``mesh``.

    Raises:
        InputError: fibres without chambers, another number of chambers than the mesh has, tendons or muscles that do
            not fit, or two inputs.
        MeshError: a mesh that cannot be read or simulated, or no vertex where the body is fixed.
    """
    mesh = build_mesh(config["mesh"]) if mesh is None else mesh
    energies = build_actuators(config, mesh)
    return Body(mesh, energies=tuple(energies), fixed=select_vertices(mesh, **config["fixed"]), **config["physics"])


def bound_markers(settings: Mapping[str, Any], mesh: Mesh, places: ArrayLike, labels: Sequence[str]) -> Markers:
    """Markers at places (M, 3) on the undeformed body [m], in float64 on the CPU, from the group ``markers``.

    Raises:
        InputError: see `bind_markers`.
        MeshError: no vertex lies where ``markers.bind_to`` says.
    """
    vertices = None if settings["bind_to"] is None else select_vertices(mesh, **settings["bind_to"])
    more = {key: settings[key] for key in ("largest_distance", "patch") if key in settings}
    return bind_markers(mesh, places, labels, kind=settings["bind"], vertices=vertices, **more)


def sight_of(settings: Mapping[str, Any], labels: Sequence[str], sets: tuple[tuple[int, ...], ...] = ()) -> Sight:
    """How much recordings tell of where these tracked markers are, from the group ``markers``.

    Args:
        settings: the group.
        labels: of the markers.
        sets: the numbers of those that are seen together, if not all are.

    Raises:
        InputError: see `Sight`.
    """
    nominal = [settings["tracked"][label] for label in labels]
    return Sight.of(nominal, settings.get("plane"), settings.get("frame", "body"), sets)


def build_simulator(
    config: Mapping[str, Any],
    material: str = "simulation",
    body: Body | None = None,
    on_failure: str | None = None,
) -> Simulator:
    """A simulator from a whole configuration.

    Args:
        config: with the keys of ``conf/config.yaml``.
        material: the key of its material, such as ``simulation`` or ``target``.
        body: the body, where it was built already.
        on_failure: in place of the configured one.

    Raises:
        InputError: a value that cannot be simulated.
    """
    if config["dtype"] not in _DTYPES:
        raise InputError(f"dtype is {config['dtype']!r}: choose float64 or float32.")
    solver = {**config["solver"], **({} if on_failure is None else {"on_failure": on_failure})}
    return Simulator(
        build_body(config) if body is None else body,
        build_material(config, material),
        time_step=config["time_step"],
        gravity=config["gravity"],
        integrator=config["integrator"],
        solver=SolverSettings(**solver),
        device=simulation_device(config),
        dtype=_DTYPES[config["dtype"]],
        coupling=config.get("coupling", "implicit"),
    )
