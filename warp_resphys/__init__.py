"""Differentiable soft-body simulation on NVIDIA Warp, with learned residual physics.

The names below are imported when they are first used, so that importing the package costs nothing.
"""

import importlib
import importlib.util
from pathlib import Path
from typing import Any

# In a copy of the repository that nobody has installed in place, kernels/ and conf/ lie beside this folder.
if importlib.util.find_spec(f"{__name__}.kernels") is None:
    __path__.append(str(Path(__file__).parents[1]))

_MODULES = {
    "ArmGeometry": "mesh.arm_geometry",
    "Body": "fem.body",
    "PointMass": "fem.body",
    "Corotated": "energies.materials",
    "Material": "energies.materials",
    "StableNeoHookean": "energies.materials",
    "MooneyRivlin": "energies.materials",
    "Gent": "energies.materials",
    "make_material": "energies.materials",
    "Inputs": "stepping.inputs",
    "Glue": "fem.rigid",
    "Rigid": "fem.rigid",
    "load": "robot.loading",
    "Motion": "robot.motion",
    "Robot": "robot.robot",
    "RobotState": "robot.state",
    "recorded_trial": "robot.loading",
    "trial_names": "robot.loading",
    "Pressure": "energies.pressure",
    "Mesh": "mesh.mesh",
    "box_hexahedra": "mesh.mesh",
    "box_tetrahedra": "mesh.mesh",
    "find_chambers": "mesh.chambers",
    "Fibres": "energies.fibres",
    "mesh_arm": "mesh.arm",
    "quadratic": "mesh.mesh",
    "read_mesh": "mesh.readers",
    "read_surfaces": "mesh.readers",
    "read_recording": "data.recordings.reading",
    "record_rollout": "dynamics.tape",
    "fill_surface": "mesh.tetrahedra",
    "rod": "mesh.rod",
    "select_vertices": "mesh.mesh",
    "Scene": "fem.scene",
    "Simulator": "dynamics.simulator",
    "Medium": "energies.medium",
    "Muscle": "energies.muscles",
    "Muscles": "energies.muscles",
    "SolverSettings": "dynamics.nonlinear_solver",
    "State": "stepping.state",
    "Strings": "energies.strings",
    "Trajectory": "dynamics.simulator",
    "Tendons": "energies.tendons",
    "write_mesh": "mesh.readers",
}

__all__ = sorted(_MODULES)
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_MODULES[name]}", __name__), name)
