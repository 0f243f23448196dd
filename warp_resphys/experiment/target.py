"""The simulation that plays the real body, observed at the time steps and the vertices of the corrected simulator.

Its mesh, regions, material, actuators, integrator and time step are its own (`TargetSettings`). Its positions and
velocities are interpolated to other vertices x by the shape functions of the cells that contain them,

    q(x) = sum_a N_a(x) q_a,

which is exact for fields of the degree of the cells (tests/experiment/test_target.py).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from ..data.markers import MarkerMap
from ..data.observation import WHOLE_STATE, Observation
from ..dynamics.simulator import Simulator
from ..io.errors import InputError, MeshError
from ..mesh.location import locate
from ..mesh.mesh import Mesh
from ..settings.body import SimulatorSettings, SteppedSettings, TargetSettings
from ..settings.stages import PlayedSettings
from .build import build_body, build_simulator

_LARGEST_DISTANCE = 0.2  # of a vertex from the cell of the other mesh that it is extrapolated from, over its diagonal


@dataclass(frozen=True)
class Target:
    """A simulation that plays the real body.

    Attributes:
        simulator: its simulator, on its own mesh.
        substeps: number of its steps per time step of the corrected simulator.
        seen: map from values (B, N', 3) at its vertices to values (B, N, 3) at those of the corrected simulator.
    """

    simulator: Simulator
    substeps: int
    seen: Observation


def build_target(settings: SimulatorSettings, target: TargetSettings) -> Target:
    """Builds the target of simulated data.

    Args:
        settings: of the corrected simulator.
        target: of the target.

    Raises:
        InputError: see `build_simulator`, `substeps_of` and `vertices_in`.
        MeshError: a mesh cannot be read or simulated.
    """
    simulator = build_simulator(target_settings(settings, target), target.material)
    seen = vertices_in(simulator.body.mesh, build_body(settings).mesh)
    return Target(simulator, substeps_of(settings.time_step, target, "target"), seen.to(simulator.rest_positions))


def target_settings(settings: SimulatorSettings | PlayedSettings, target: TargetSettings) -> SimulatorSettings:
    """Settings of the simulator of a target; gravity, solver and device are those of the run."""
    return SimulatorSettings.of(settings, **{key: getattr(target, key) for key in SteppedSettings.model_fields})


def substeps_of(time_step: float, target: TargetSettings, key: str) -> int:
    """Number of steps of a target per time step of the corrected simulator [s].

    Raises:
        InputError: the time step is not a multiple of the target's; ``key`` is the group of the target.
    """
    ratio = time_step / target.time_step
    if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
        raise InputError(
            f"time_step is {time_step:g} s and {key}.time_step {target.time_step:g} s: the first must be a multiple of "
            "the second."
        )
    return round(ratio)


@lru_cache(maxsize=4)
def vertices_in(mesh: Mesh, other: Mesh) -> Observation:
    """Map from values (B, N', 3) at the vertices of a mesh to values (B, N, 3) at those of another one.

    Vertices slightly outside, as on a coarser curved surface, are extrapolated from the nearest cell.

    Raises:
        MeshError: a vertex of the other mesh lies outside of the first.
    """
    if np.array_equal(mesh.vertices, other.vertices):
        return WHOLE_STATE
    place = locate(mesh, other.vertices)
    size = np.linalg.norm(np.ptp(mesh.vertices[mesh.cells[place.cells]], axis=1), axis=1)
    far = int(np.argmax(place.outside / size))
    if place.outside[far] > _LARGEST_DISTANCE * size[far]:
        x, y, z = other.vertices[far]
        raise MeshError(
            f"the simulator's vertex at ({x:g}, {y:g}, {z:g}) m lies outside of this mesh: both must be the same body "
            "in the same place."
        )
    return MarkerMap(torch.as_tensor(mesh.cells[place.cells])[None], torch.as_tensor(place.weights)[None])
