"""Says what is in a mesh file: sizes, mass, chambers, open cavities and the quality of the cells.

python scripts/inspect_mesh.py path=FILE units=mm fixed.z=0
"""

from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from warp_resphys.cli import hydra_entry


@hydra_entry("inspect_mesh")
def main(config: DictConfig) -> None:
    """Prints the table, and writes mesh.png into the run folder."""
    from warp_resphys.report.mesh import inspect_mesh

    folder = Path(HydraConfig.get().runtime.output_dir)
    settings = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    print(inspect_mesh(cast(dict[str, Any], settings), folder))
    if config.picture:
        print(f"Written: {folder / 'mesh.png'}")


if __name__ == "__main__":
    main()
