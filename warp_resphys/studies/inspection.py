"""The command `inspect`: tables and pictures of a mesh and of recordings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import model_validator

from ..data.recordings.bag import is_bag
from ..data.recordings.reading import READERS
from ..io.errors import InputError
from ..io.settings import Many, Positive, Word, setting
from ..mesh.tetrahedra import SURFACE_SUFFIXES
from ..settings.mesh import MeshSettings, PlaceSettings, SurfaceMesh
from .mesh_inspection import inspect_mesh
from .recording_quality import RecordingInspection, inspect_recording


class Inspection(RecordingInspection):
    """The configuration ``inspect``, which explains its keys."""

    files: Many[Word]
    mesh: MeshSettings | None
    fixed: PlaceSettings
    density: Positive = setting(unit="kg/m^3")
    picture: bool
    save: Word | None

    @model_validator(mode="before")
    @classmethod
    def _sort_files(cls, values: Any) -> Any:
        """Moves ``files`` to their keys: the first recording, others to compare it with, and a mesh or surface."""
        if not isinstance(values, Mapping) or not isinstance(values["mesh"], Mapping):
            return values
        files = values["files"] if isinstance(values["files"], list) else []
        recordings = [file for file in files if Path(str(file)).suffix.lower() in READERS or is_bag(Path(str(file)))]
        meshes = [file for file in files if file not in recordings]
        if len(meshes) > 1:
            raise ValueError(f"{meshes[0]} and {meshes[1]} are two meshes: name one at a time.")
        mesh, changed = {**values["mesh"], **({"path": meshes[0]} if meshes else {})}, dict(values)
        if recordings:
            changed["recording"] = {**values["recording"], "path": recordings[0]}
            changed["compare_with"] = [*values["compare_with"], *recordings[1:]]
        if mesh["kind"] == "file" and Path(str(mesh.get("path"))).suffix.lower() in SURFACE_SUFFIXES:
            mesh = {key: value for key, value in mesh.items() if key in SurfaceMesh.model_fields} | {"kind": "surface"}
        if mesh.get("path") is None:  # the key is there for every kind of mesh, but only some have files
            mesh.pop("path", None)
        changed["mesh"] = None if mesh["kind"] == "file" and "path" not in mesh else mesh
        return changed


def inspect(settings: Inspection, folder: Path) -> None:
    """Prints tables; writes quality.json and quality.png of a recording, mesh.png of a mesh, and the mesh.

    Raises:
        ResphysError: nothing was named, or it cannot be used.
    """
    if settings.mesh is None and settings.recording.path is None:
        raise InputError("nothing to inspect: name a mesh or a recording, as in warp-resphys inspect FILE.")
    if settings.recording.path is not None:
        print(inspect_recording(settings, folder))
        print(f"Written: {folder / 'quality.json'}, {folder / 'quality.png'}")
    if settings.mesh is not None:
        picture = folder / "mesh.png" if settings.picture else None
        file = None if settings.save is None else folder / settings.save
        print(inspect_mesh(settings.mesh, settings.fixed, settings.density, picture, file))
        if written := [str(path) for path in (file, picture) if path is not None]:
            print(f"Written: {', '.join(written)}")
