"""Converts the recordings published beside the paper to the HDF5 layout of docs/recordings.md.

python scripts/convert_recordings.py layout=beam source=FOLDER
python scripts/convert_recordings.py layout=segment source=pressure_steps.npz
"""

from pathlib import Path

from omegaconf import DictConfig

from warp_resphys.cli import hydra_entry
from warp_resphys.io.errors import InputError


@hydra_entry("convert_recordings")
def main(config: DictConfig) -> None:
    """Writes one file for each trial, and index.json."""
    from warp_resphys.data.recordings.published import convert_arm, convert_beam
    from warp_resphys.data.recordings.segment import convert_segment

    converters = {"arm": convert_arm, "beam": convert_beam, "segment": convert_segment}
    if config.layout not in converters:
        raise InputError(f"layout is {config.layout!r}: set it to {', '.join(converters)}.")
    folder = Path(config.output)
    index = converters[config.layout](config.source, folder)
    residuals = [entry["registration_residual_mm"] for entry in index if entry["registration_residual_mm"] is not None]
    worst = f"; rest shapes at most {max(residuals):.1f} mm off the nominal markers" if residuals else ""
    print(f"Written: {len(index)} recordings and index.json to {folder}{worst}")


if __name__ == "__main__":
    main()
