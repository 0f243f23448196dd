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
    """Prints a table for every Poisson's ratio and pose."""
    import warp as wp
    from rich.console import Console

    from warp_resphys.studies.gradient_check import check_configured, gradient_table

    wp.config.log_level = wp.LOG_WARNING
    settings = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
    tolerance = settings["gradcheck"]["tolerance"]
    console, largest = Console(), 0.0
    for poissons_ratio, pose, rows in check_configured(settings):
        console.print(gradient_table(rows, f"nu = {poissons_ratio:g}, {pose}", tolerance))
        largest = max([largest, *(row.relative_error for row in rows)])
    console.print(f"Largest relative error: {largest:.1e}, {tolerance:.0e} allowed.")
    if not largest <= tolerance:
        sys.exit(1)


if __name__ == "__main__":
    main()
