"""What comes before an experiment: to look at a mesh or a recording, to make an arm."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..io.errors import InputError
from . import mesh_inspection as meshes
from .recording_quality import inspect_recording


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
