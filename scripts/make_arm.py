"""Makes a pneumatic arm of given measures: a mesh file with named surfaces, a table and a picture.

python scripts/make_arm.py mesh.size=0.004 file=my_arm.msh
"""

from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from warp_resphys.cli import hydra_entry


@hydra_entry("make_arm")
def main(config: DictConfig) -> None:
    """Prints the table; writes the mesh and arm.png into the run folder, or the mesh where an absolute path says."""
    from warp_resphys.report.mesh import make_arm

    folder = Path(HydraConfig.get().runtime.output_dir)
    print(make_arm(cast(dict[str, Any], OmegaConf.to_container(config, resolve=True)), folder))
    print(f"Written: {folder / config.file}{f', {folder}/arm.png' if config.picture else ''}")


if __name__ == "__main__":
    main()
