"""Builds meshes, bodies, materials and simulators from configurations."""

from collections.abc import Mapping
from typing import Any

import torch

from .body import Body, PointMass
from .errors import InputError
from .material import Material
from .mesh import Mesh, box_hexahedra, box_tetrahedra, check_mesh, select_vertices
from .mesh_io import read_mesh
from .simulator import Simulator
from .solver import SolverSettings

_DTYPES = {"float64": torch.float64, "float32": torch.float32}


def choose_device(name: str) -> torch.device:
    """The named device; ``auto`` is CUDA where torch finds one.

    Raises:
        InputError: an unknown device, or CUDA without a CUDA device.
    """
    available = torch.cuda.is_available()
    if name == "auto":
        return torch.device("cuda" if available else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise InputError(f"device is {name!r}: choose auto, cpu or cuda.")
    if device.type == "cuda" and not available:
        raise InputError(f"device is {name!r}, but torch finds no CUDA device: choose device=cpu.")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(f"device is {name!r}, but torch finds {torch.cuda.device_count()} CUDA devices.")
    return device


def build_mesh(config: Mapping[str, Any]) -> Mesh:
    """A mesh from the group ``mesh``.

    Raises:
        InputError: an unknown kind.
        MeshError: a mesh that cannot be read or simulated.
    """
    kind = config["kind"]
    if kind == "box_hexahedra":
        mesh = box_hexahedra(config["size"], config["divisions"])
    elif kind == "box_tetrahedra":
        mesh = box_tetrahedra(config["size"], config["divisions"], config.get("order", 1))
    elif kind == "file":
        mesh = read_mesh(config["path"], config["units"], config["order"], config["drop_unreferenced"])
    else:
        raise InputError(f"mesh.kind is {kind!r}: choose box_hexahedra, box_tetrahedra or file.")
    check_mesh(mesh)
    return mesh


def build_body(config: Mapping[str, Any], point_masses: tuple[PointMass, ...] = ()) -> Body:
    """A body from the groups ``mesh`` and ``physics`` and the key ``fixed``."""
    mesh = build_mesh(config["mesh"])
    return Body(
        mesh,
        fixed=select_vertices(mesh, **config["fixed"]),
        mass=config["physics"]["mass"],
        volume_integration=config["physics"]["volume_integration"],
        point_masses=point_masses,
    )


def build_simulator(
    config: Mapping[str, Any],
    material: str = "simulation",
    body: Body | None = None,
    on_failure: str | None = None,
) -> Simulator:
    """A simulator from a whole configuration.

    Args:
        config: with the keys of ``conf/config.yaml``.
        material: the key of its material: ``simulation`` or ``reality``.
        body: the body, where it was built already.
        on_failure: in place of the configured one.

    Raises:
        InputError: a value that cannot be simulated.
    """
    if config["dtype"] not in _DTYPES:
        raise InputError(f"dtype is {config['dtype']!r}: choose float64 or float32.")
    try:
        constants = Material(**config[material])
    except InputError as error:
        raise InputError(f"{material}: {error}") from error
    settings = dict(config["solver"])
    if on_failure is not None:
        settings["on_failure"] = on_failure
    device = "cpu" if config["device"] == "auto" else config["device"]
    return Simulator(
        build_body(config) if body is None else body,
        constants,
        time_step=config["time_step"],
        gravity=config["gravity"],
        integrator=config["integrator"],
        solver=SolverSettings(**settings),
        device=choose_device(device),
        dtype=_DTYPES[config["dtype"]],
    )
