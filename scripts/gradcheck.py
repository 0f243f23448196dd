"""Compares adjoint gradients with central differences, for an experiment's body and solver.

python scripts/gradcheck.py [experiment=NAME] [solver=NAME] [mesh=NAME] [integrator=NAME] [gradcheck.KEY=VALUE]

Exit code: 0 where every relative error is within the tolerance, 1 where one is not, 2 for an input that cannot be used.
"""

import sys
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from warp_resphys.cli import hydra_entry


@hydra_entry("gradcheck")
def main(config: DictConfig) -> None:
    """Prints a table for every Poisson's ratio; a row a parameter, a column a pose."""
    from warp_resphys.gradient_check import check_configured, gradient_table

    settings = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
    from rich.console import Console

    console = Console()
    tolerance = settings["gradcheck"]["tolerance"]
    within = True
    for poissons_ratio, by_pose in check_configured(settings):
        console.print(gradient_table(by_pose, poissons_ratio, tolerance))
        within &= all(row.relative_error <= tolerance for rows in by_pose.values() for row in rows)
    if not within:
        console.print(f"Gradients differ by more than {tolerance:g}.")
        sys.exit(1)


if __name__ == "__main__":
    main()
