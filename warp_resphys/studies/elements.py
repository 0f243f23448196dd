"""Which element to take: static sag of the beam under its own weight and time of a step, by element and refinement."""

from collections.abc import Sequence

import warp as wp
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from ..dynamics.inputs import Inputs
from ..dynamics.simulator import Simulator
from ..energies.materials import Corotated
from ..fem.body import Body
from ..io.errors import InputError
from ..mesh.mesh import Mesh, box_hexahedra, box_tetrahedra, select_vertices
from .stepping import step_time

_FINEST = 4


def element_study(config: DictConfig) -> None:
    """Prints the table.

    Raises:
        InputError: a value that cannot be used.
    """
    if config.finest not in range(1, _FINEST + 1):
        raise InputError(f"finest is {config.finest!r}: choose a whole number from 1 to {_FINEST}.")
    wp.config.log_level = wp.LOG_WARNING
    ratios = list(config.poissons_ratios)
    table = Table("element", "volume term", "vertices", *(f"nu {ratio:g}" for ratio in ratios), "step (ms)")
    table.title = f"Static sag in mm, E {config.youngs_modulus / 1e3:g} kPa; what a step costs, nu {ratios[-1]:g}"
    for refinement in range(1, config.finest + 1):
        for element, mesh in _meshes(config.size, config.divisions, refinement).items():
            for integration in config.integrations:
                body = Body(mesh, fixed=select_vertices(mesh, x=0.0), volume_integration=integration)
                simulators = [Simulator(body, Corotated(config.youngs_modulus, ratio)) for ratio in ratios]
                cells = [f"{sag_mm(simulator):.3f}" for simulator in simulators]
                falling = [Inputs()] * config.steps  # from its straight shape
                cost = step_time(simulators[-1], simulators[-1].rest_state(), falling, config.repeats)
                table.add_row(element, integration, str(len(mesh.vertices)), *cells, f"{cost['step_ms']:.2f}")
    Console().print(table)


def sag_mm(simulator: Simulator) -> float:
    """Mean vertical displacement of the free face at rest under gravity [mm]."""
    mesh = simulator.body.mesh
    q = simulator.static_equilibrium().q[0].cpu().numpy()
    return float(1e3 * (q - mesh.vertices)[select_vertices(mesh, x=mesh.vertices[:, 0].max()), 2].mean())


def _meshes(size: Sequence[float], divisions: Sequence[int], refinement: int) -> dict[str, Mesh]:
    """A box of every kind of element; quadratic ones are twice as large as linear ones."""
    half = [refinement * ((n + 1) // 2) for n in divisions]
    divisions = [refinement * n for n in divisions]
    return {
        "8-node hexahedra": box_hexahedra(size, divisions),
        "20-node hexahedra": box_hexahedra(size, half, nodes=20),
        "27-node hexahedra": box_hexahedra(size, half, nodes=27),
        "4-node tetrahedra": box_tetrahedra(size, divisions),
        "10-node tetrahedra": box_tetrahedra(size, half, order=2),
    }
