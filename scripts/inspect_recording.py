"""Says how good a motion-capture recording is: occlusions, jumps, noise and drift of each marker.

python scripts/inspect_recording.py recording.path=FILE
"""

from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from warp_resphys.cli import hydra_entry


@hydra_entry("inspect_recording")
def main(config: DictConfig) -> None:
    """Prints the table, and writes quality.json and quality.png into the run folder."""
    from warp_resphys.report.recordings import inspect_recording

    folder = Path(HydraConfig.get().runtime.output_dir)
    print(inspect_recording(cast(dict[str, Any], OmegaConf.to_container(config, resolve=True)), folder))
    print(f"Written: {folder / 'quality.json'}, {folder / 'quality.png'}")


if __name__ == "__main__":
    main()
