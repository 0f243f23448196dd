"""Compares a motion-capture recording of a beam that is let go with its simulation.

python scripts/compare_recording.py recording=bare recording.path=FILE.c3d
"""

from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from warp_resphys.cli import hydra_entry


@hydra_entry("compare_recording")
def main(config: DictConfig) -> None:
    """Writes comparison.json and comparison.png into the run folder and prints the numbers."""
    from warp_resphys.studies.recording_comparison import compare_recording

    folder = Path(HydraConfig.get().runtime.output_dir)
    result = compare_recording(cast(dict[str, Any], OmegaConf.to_container(config, resolve=True)), folder)
    print(f"{'':16}{'measured':>12}{'simulated':>12}{'difference':>12}")
    for label, key, compared in (
        ("sag [mm]", "sag_mm", "sag"),
        ("period [s]", "period_s", "period"),
        ("decay [1/s]", "decay_rate_per_s", "decay_rate"),
    ):
        measured, simulated = result["measured"][key], result["simulated"][key]
        difference = result["relative_difference"][compared]
        print(f"{label:16}{measured:12.4g}{simulated:12.4g}{difference:12.1%}")
    print(f"Written: {folder / 'comparison.json'}, {folder / 'comparison.png'}")


if __name__ == "__main__":
    main()
