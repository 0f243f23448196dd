"""Files of scans: points of a surface, and its outer normals where the file has triangles."""

from pathlib import Path
from typing import Any

import numpy as np

from ..io.errors import DataFileError
from ..io.files import read_arrays
from .outlines import FloatArray

_READ_BY_TRIMESH = (".ply", ".xyz", ".obj", ".off", ".stl")
_SAMPLED = 20_000  # points on the triangles of a surface
_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}


def read_scan(path: str | Path, unit: float, seed: int = 0) -> tuple[FloatArray, FloatArray | None]:
    """Reads the points (P, 3) of a scan [m], and its outer unit normals (P, 3); None without triangles.

    Of a surface of triangles, points are spread evenly over these, which must be counter-clockwise from outside.

    Args:
        path: the file; its extension determines the format.
        unit: length of a unit of the file [m].
        seed: of the points on triangles.

    Raises:
        DataFileError: it is missing or damaged, or has no points.
    """
    path, normals = Path(path), None
    try:
        if path.suffix == ".npy":
            points = np.asarray(read_arrays(path)[""], dtype=np.float64)
        elif path.suffix == ".pcd":
            points = _pcd(path)
        elif path.suffix in _READ_BY_TRIMESH:
            points, normals = _by_trimesh(path, seed)
        else:
            known = ", ".join((".npy", ".pcd", *_READ_BY_TRIMESH))
            raise ValueError(f"its extension is none of {known}")
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"it has the shape {points.shape}, not (points, 3)")
    except DataFileError:
        raise
    except Exception as error:  # readers raise all kinds of errors on damaged files
        raise DataFileError(f"cannot read a scan from {path} ({error}): export it as .ply again.") from error
    seen = np.isfinite(points).all(1)
    if not seen.any():
        raise DataFileError(f"{path} has no points: scan again, or leave data.poses.NAME.cloud out.")
    return unit * points[seen], None if normals is None else normals[seen]


def _by_trimesh(path: Path, seed: int) -> tuple[FloatArray, FloatArray | None]:
    import trimesh

    if not path.is_file():
        raise ValueError("there is no such file")
    read: Any = trimesh.load(str(path), process=False)
    if isinstance(read, trimesh.Scene):
        read = read.to_mesh()
    if isinstance(read, trimesh.Trimesh) and len(read.faces):
        points, faces = trimesh.sample.sample_surface(read, _SAMPLED, seed=seed)
        return np.asarray(points, dtype=np.float64), np.asarray(read.face_normals[faces], dtype=np.float64)
    return np.asarray(read.vertices, dtype=np.float64), None


def _pcd(path: Path) -> FloatArray:
    """Points of a file of the Point Cloud Library, as text or binary."""
    content, start, head = path.read_bytes(), 0, dict[str, list[str]]()
    while "DATA" not in head:
        end = content.index(b"\n", start)
        key, *values = content[start:end].decode("ascii").split() or ["#"]
        head[key], start = values, end + 1
    counts = [int(count) for count in head.get("COUNT", ["1"] * len(head["FIELDS"]))]
    if head["DATA"] == ["ascii"]:
        column = dict(zip(head["FIELDS"], np.cumsum([0, *counts]), strict=False))
        rows = np.array([line.split() for line in content[start:].decode("ascii").splitlines() if line], dtype=float)
        return np.asarray(rows[:, [column[axis] for axis in "xyz"]])
    if head["DATA"] != ["binary"]:
        raise ValueError(f"its data are {' '.join(head['DATA'])}, and must be ascii or binary")
    fields = [
        (f"{number}_{name}" if name == "_" else name, f"<{_PCD_TYPES[kind]}{size}", (count,))
        for number, (name, kind, size, count) in enumerate(
            zip(head["FIELDS"], head["TYPE"], head["SIZE"], counts, strict=True)
        )
    ]
    rows = np.frombuffer(content, np.dtype(fields), int(head["POINTS"][0]), start)
    return np.concatenate([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
