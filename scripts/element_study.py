"""Which element to take: static sag of the beam under its own weight, by element, refinement and integration.

python scripts/element_study.py            # with nu = 0.45 and 0.499
python scripts/element_study.py --finest 2 # coarser meshes only
"""

import argparse

import warp as wp
from rich.console import Console
from rich.table import Table

from warp_resphys import Body, Corotated, Mesh, Simulator, box_hexahedra, box_tetrahedra, select_vertices

SIZE = (0.1, 0.03, 0.03)  # m
YOUNGS_MODULUS = 264e3  # Pa
POISSONS_RATIOS = (0.45, 0.499)


def sag_mm(mesh: Mesh, poissons_ratio: float, volume_integration: str) -> float:
    """Mean vertical displacement of the free face at rest under gravity [mm]."""
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0), volume_integration=volume_integration)
    simulator = Simulator(body, Corotated(YOUNGS_MODULUS, poissons_ratio))
    tip = select_vertices(mesh, x=SIZE[0])
    q = simulator.static_equilibrium().q[0].cpu().numpy()
    return float(1e3 * (q - mesh.vertices)[tip, 2].mean())


def meshes(refinement: int) -> dict[str, Mesh]:
    """The beam of every kind of element; 10-node tetrahedra are twice as large as the others."""
    n = refinement
    return {
        "8-node hexahedra": box_hexahedra(SIZE, (10 * n, 3 * n, 3 * n)),
        "4-node tetrahedra": box_tetrahedra(SIZE, (10 * n, 3 * n, 3 * n)),
        "10-node tetrahedra": box_tetrahedra(SIZE, (5 * n, 2 * n, 2 * n), order=2),
    }


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--finest", type=int, default=3, choices=range(1, 5), help="largest refinement")
    finest = parser.parse_args().finest
    wp.config.log_level = wp.LOG_WARNING
    table = Table("element", "volume term", "vertices", *(f"nu {nu:g}" for nu in POISSONS_RATIOS))
    table.title = f"Static sag in mm, E {YOUNGS_MODULUS / 1e3:g} kPa"
    for refinement in range(1, finest + 1):
        for element, mesh in meshes(refinement).items():
            for integration in ("centre", "full"):
                sags = (f"{sag_mm(mesh, nu, integration):.3f}" for nu in POISSONS_RATIOS)
                table.add_row(element, integration, str(len(mesh.vertices)), *sags)
    Console().print(table)


if __name__ == "__main__":
    main()
