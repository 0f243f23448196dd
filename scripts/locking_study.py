"""Which mesh to take for an arm: its deflection by element and refinement, and what a step costs.

python scripts/locking_study.py [study.file=FILE] [study.KEY=VALUE] [mesh.KEY=VALUE]

Exit code: 0, 2 for an input that cannot be used, or 130 after Ctrl-C; the same command then goes on.
"""

import sys
from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from warp_resphys.cli import hydra_entry


@hydra_entry("locking_study")
def main(config: DictConfig) -> None:
    """Writes study.json, study.csv and study.png into the run folder and prints the table."""
    from rich.console import Console

    from warp_resphys.studies.locking_page import run_study

    folder = Path(HydraConfig.get().runtime.output_dir)
    console = Console(width=None if sys.stdout.isatty() else 140)
    for part in run_study(cast(dict[str, Any], OmegaConf.to_container(config, resolve=True)), folder):
        console.print(part)
    console.print(f"Written: {folder}/study.json, study.csv, study.png")


if __name__ == "__main__":
    main()
