"""Runs every experiment and sets what comes out beside what was published, on one page.

python scripts/reproduce.py [budget=quick] [only=[NAME,...]] [results=FOLDER]

Exit code: 0, or 2 where a run failed or an input cannot be used.
"""

from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from warp_resphys.cli import hydra_entry


@hydra_entry("reproduce")
def main(config: DictConfig) -> None:
    """Writes reproduction.html, results.md and figures/ into the run folder."""
    from warp_resphys.studies.reproduction import reproduce

    hydra = HydraConfig.get()
    plain = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
    reproduce(plain, Path(hydra.runtime.output_dir), list(hydra.overrides.task))


if __name__ == "__main__":
    main()
