"""What comes before an experiment: to look at a mesh or a recording, to make an arm, to convert recordings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..data.recordings.published import convert_arm, convert_beam
from ..data.recordings.segment import convert_segment
from ..experiment.schema import check, one_of
from ..io.errors import InputError
from . import mesh_inspection as meshes
from .recording_quality import inspect_recording

CONVERTERS = {"arm": convert_arm, "beam": convert_beam, "segment": convert_segment}


def inspect(config: Mapping[str, Any], folder: Path) -> None:
    """Prints tables; writes quality.json and quality.png of a recording, and mesh.png of a mesh.

    Raises:
        ResphysError: nothing was named, or it cannot be used.
    """
    mesh, recording = config["mesh"], config["recording"]["path"]
    if mesh["kind"] == "file" and mesh["path"] is None and recording is None:
        raise InputError("nothing to inspect: name a file, as in mesh.path=FILE or recording.path=FILE.")
    if recording is not None:
        print(inspect_recording(config, folder))
        print(f"Written: {folder / 'quality.json'}, {folder / 'quality.png'}")
    if mesh["kind"] != "file" or mesh["path"] is not None:
        print(meshes.inspect_mesh(config, folder))
        if config["picture"]:
            print(f"Written: {folder / 'mesh.png'}")


def make_arm(config: Mapping[str, Any], folder: Path) -> None:
    """Prints the table; writes the mesh and arm.png into the run folder, or the mesh where an absolute path says."""
    print(meshes.make_arm(config, folder))
    print(f"Written: {folder / config['file']}{f', {folder}/arm.png' if config['picture'] else ''}")


def convert(config: Mapping[str, Any], folder: Path) -> None:
    """Writes one file for each trial, and index.json.

    Raises:
        InputError: an unknown layout.
        DataFileError: a file cannot be read or written.
    """
    check("layout", config["layout"], one_of(*CONVERTERS))
    folder = Path(config["output"])
    index = CONVERTERS[config["layout"]](config["source"], folder)
    residuals = [entry["registration_residual_mm"] for entry in index if entry["registration_residual_mm"] is not None]
    worst = f"; rest shapes at most {max(residuals):.1f} mm off the nominal markers" if residuals else ""
    print(f"Written: {len(index)} recordings and index.json to {folder}{worst}")
