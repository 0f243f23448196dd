"""Which element to take: static sag of the beam under its own weight, by element, refinement and integration."""

import warp as wp
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from ..dynamics.simulator import Simulator
from ..energies.materials import Corotated
from ..fem.body import Body
from ..io.errors import InputError
from ..mesh.mesh import Mesh, box_hexahedra, box_tetrahedra, select_vertices

_SIZE = (0.1, 0.03, 0.03)  # m
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
    table = Table("element", "volume term", "vertices", *(f"nu {ratio:g}" for ratio in ratios))
    table.title = f"Static sag in mm, E {config.youngs_modulus / 1e3:g} kPa"
    for refinement in range(1, config.finest + 1):
        for element, mesh in _meshes(refinement).items():
            for integration in ("centre", "full"):
                sags = [sag_mm(mesh, Corotated(config.youngs_modulus, ratio), integration) for ratio in ratios]
                table.add_row(element, integration, str(len(mesh.vertices)), *(f"{sag:.3f}" for sag in sags))
    Console().print(table)


def sag_mm(mesh: Mesh, material: Corotated, volume_integration: str) -> float:
    """Mean vertical displacement of the free face at rest under gravity [mm]."""
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0), volume_integration=volume_integration)
    q = Simulator(body, material).static_equilibrium().q[0].cpu().numpy()
    return float(1e3 * (q - mesh.vertices)[select_vertices(mesh, x=_SIZE[0]), 2].mean())


def _meshes(refinement: int) -> dict[str, Mesh]:
    """The beam of every kind of element; quadratic ones are twice as large as linear ones."""
    n = refinement
    return {
        "8-node hexahedra": box_hexahedra(_SIZE, (10 * n, 3 * n, 3 * n)),
        "20-node hexahedra": box_hexahedra(_SIZE, (5 * n, 2 * n, 2 * n), nodes=20),
        "27-node hexahedra": box_hexahedra(_SIZE, (5 * n, 2 * n, 2 * n), nodes=27),
        "4-node tetrahedra": box_tetrahedra(_SIZE, (10 * n, 3 * n, 3 * n)),
        "10-node tetrahedra": box_tetrahedra(_SIZE, (5 * n, 2 * n, 2 * n), order=2),
    }
