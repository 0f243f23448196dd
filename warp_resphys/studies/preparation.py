"""The commands `inspect`, for a look at meshes and recordings, and `inspect make-arm`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..data.recordings.reading import READERS
from ..io.errors import InputError
from ..io.settings import parse
from . import mesh_inspection as meshes
from .inspection import Arm, Inspection
from .recording_quality import inspect_recording


def inspect(config: Mapping[str, Any], folder: Path) -> None:
    """Prints tables; writes quality.json and quality.png of a recording, and mesh.png of a mesh.

    Raises:
        ResphysError: nothing was named, or it cannot be used.
    """
    settings = with_files(parse(Inspection, config))
    mesh, recording = settings.mesh, settings.recording.path
    if mesh["kind"] == "file" and mesh["path"] is None and recording is None:
        raise InputError("nothing to inspect: name a mesh or a recording, as in warp-resphys inspect FILE.")
    if recording is not None:
        print(inspect_recording(settings, folder))
        print(f"Written: {folder / 'quality.json'}, {folder / 'quality.png'}")
    if mesh["kind"] != "file" or mesh["path"] is not None:
        print(meshes.inspect_mesh(settings, folder))
        if settings.picture:
            print(f"Written: {folder / 'mesh.png'}")


def with_files(settings: Inspection) -> Inspection:
    """The settings with `files` in their places: the first recording, others to compare it with, and a mesh.

    Raises:
        InputError: two meshes.
    """
    recordings = [file for file in settings.files if Path(file).suffix.lower() in READERS]
    meshes = [file for file in settings.files if file not in recordings]
    if len(meshes) > 1:
        raise InputError(f"{meshes[0]} and {meshes[1]} are two meshes: name one at a time.")
    changed: dict[str, Any] = {"files": ()}
    if meshes:
        changed["mesh"] = {**settings.mesh, "path": meshes[0]}
    if recordings:
        changed["recording"] = settings.recording.changed(path=recordings[0])
        changed["compare_with"] = (*settings.compare_with, *recordings[1:])
    return settings.changed(**changed)


def make_arm(config: Mapping[str, Any], folder: Path) -> None:
    """Prints the table; writes the mesh and arm.png into the run folder, or the mesh where an absolute path says."""
    settings = parse(Arm, config)
    print(meshes.make_arm(settings, folder))
    print(f"Written: {folder / settings.file}{f', {folder}/arm.png' if settings.picture else ''}")
