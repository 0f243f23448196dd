"""Differentiable soft-body simulation on NVIDIA Warp, with learned residual physics.

The names below are imported when they are first used, so that importing the package costs nothing.
"""

import importlib
from typing import Any

_MODULES = {
    "ArmGeometry": "arm_geometry",
    "Body": "body",
    "PointMass": "body",
    "Material": "material",
    "Mesh": "mesh",
    "box_hexahedra": "mesh",
    "box_tetrahedra": "mesh",
    "mesh_arm": "arm",
    "quadratic": "mesh",
    "read_mesh": "mesh_io",
    "read_surfaces": "mesh_io",
    "select_vertices": "mesh",
    "Simulator": "simulator",
    "SolverSettings": "solver",
    "State": "integrator",
    "Trajectory": "simulator",
    "write_mesh": "mesh_io",
}

__all__ = sorted(_MODULES)
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_MODULES[name]}", __name__), name)
