"""Motions as files of other programs: tables, time series for ParaView, scenes in USD."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from ..io.atomic import atomic_path
from ..io.errors import InputError
from ..io.files import write_text
from ..mesh.mesh import Mesh, boundary_triangles, surface_vertices

FloatArray = NDArray[np.float64]

_USD = (".usd", ".usda", ".usdc")
_MARKER_SHARE = 0.02  # of the body's size, that a marker's ball is wide


@dataclass(frozen=True)
class Track:
    """The motion of one body.

    Attributes:
        mesh: its rest shape.
        times: (T + 1,) [s].
        q: (T + 1, N, 3) positions of its vertices [m].
        v: (T + 1, N, 3) velocities [m/s].
        labels: of its markers; none where every vertex is observed.
        markers: (T + 1, M, 3) [m].
        columns: what else a table has, by header: (T + 1,) each.
    """

    mesh: Mesh
    times: FloatArray
    q: FloatArray
    v: FloatArray
    labels: Sequence[str]
    markers: FloatArray
    columns: dict[str, FloatArray]


def input_columns(name: str, parts: Sequence[str], unit: str, values: FloatArray) -> dict[str, FloatArray]:
    """(T + 1,) each: columns of what an input was during the step that led there, of values (T, C)."""
    headers = [f"{name}.{part} [{unit}]" for part in parts]
    return dict(zip(headers, np.concatenate([values[:1], values]).T, strict=True))


def write_csv(path: Path, track: Track) -> Path:
    """See `Motion.write_csv`."""
    labels = track.labels or [f"vertex_{number}" for number in range(track.markers.shape[1])]
    header = ["time [s]", *(f"{label}.{axis} [m]" for label in labels for axis in "xyz"), *track.columns]
    more = [values[:, None] for values in track.columns.values()]
    rows = np.concatenate([track.times[:, None], track.markers.reshape(len(track.times), -1), *more], axis=1)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([["" if np.isnan(x) else f"{x:.12g}" for x in row] for row in rows])
    write_text(path, text.getvalue())
    return path


def write_vtk(path: Path, track: Track) -> Path:
    """See `Motion.write_vtk`."""
    if path.suffix != ".pvd":
        raise InputError(f"{path} does not end in .pvd: give such a name, which ParaView opens as a time series.")
    mesh, dots = track.mesh, np.arange(len(track.labels))
    fields = ({"displacement": x - mesh.vertices, "velocity": w} for x, w in zip(track.q, track.v, strict=True))
    _write_series(path, track.times, track.q, (mesh.element.file_type, mesh.cells), fields)
    if len(dots):
        numbers = ({"marker": dots} for _ in track.times)
        place = path.with_name(f"{path.stem}_markers.pvd")
        _write_series(place, track.times, track.markers, ("vertex", dots[:, None]), numbers)
    return path


def _write_series(
    path: Path,
    times: FloatArray,
    points: FloatArray,
    cells: tuple[str, NDArray[np.int64]],
    fields: Iterator[dict[str, Any]],
) -> None:
    """A file for each time, then the collection that names them."""
    import meshio

    entries, digits = [], len(str(len(times) - 1))
    for number, (time, at, data) in enumerate(zip(times, points, fields, strict=True)):
        name = f"{path.stem}/{path.stem}_{number:0{digits}d}.vtu"
        with atomic_path(path.parent / name) as partial:
            meshio.write(partial, meshio.Mesh(at, [cells], point_data=data), file_format="vtu")
        entries.append(f'    <DataSet timestep="{time:.9g}" file={quoteattr(name)}/>')
    lines = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', "  <Collection>", *entries]
    write_text(path, "\n".join([*lines, "  </Collection>", "</VTKFile>", ""]))


def write_usd(path: Path, track: Track) -> Path:
    """See `Motion.write_usd`."""
    if path.suffix not in _USD:
        raise InputError(f"{path} does not end in {', '.join(_USD)}: give such a name.")
    try:
        from pxr import Usd, UsdGeom, Vt
    except ImportError:
        raise InputError("USD files need a package that is not installed: pip install 'warp-resphys[usd]'.") from None
    mesh, q, times = track.mesh, track.q, track.times
    kept = surface_vertices(mesh)
    triangles = np.searchsorted(kept, boundary_triangles(mesh))
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    step = float(times[1] - times[0]) if len(times) > 1 else 1.0
    stage.SetTimeCodesPerSecond(1.0 / step)
    stage.SetFramesPerSecond(1.0 / step)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(len(q) - 1.0)
    root = UsdGeom.Xform.Define(stage, "/robot")
    stage.SetDefaultPrim(root.GetPrim())
    body = UsdGeom.Mesh.Define(stage, "/robot/body")
    body.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    body.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, dtype=np.int32)))
    body.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(triangles.astype(np.int32).ravel()))
    surfaces = [(body, q[:, kept])]
    if track.labels:
        dots = UsdGeom.Points.Define(stage, "/robot/markers")
        size = _MARKER_SHARE * float(np.ptp(mesh.vertices, axis=0).max())
        dots.CreateWidthsAttr(Vt.FloatArray.FromNumpy(np.full(len(track.labels), size, dtype=np.float32)))
        surfaces.append((dots, track.markers))
    for shape, series in surfaces:
        points, extent = shape.CreatePointsAttr(), shape.CreateExtentAttr()
        for number, at in enumerate(series.astype(np.float32)):
            points.Set(Vt.Vec3fArray.FromNumpy(at), float(number))
            extent.Set(Vt.Vec3fArray.FromNumpy(np.stack([at.min(0), at.max(0)])), float(number))
    with atomic_path(path) as partial:
        ending = partial.with_name(f"{partial.stem}.writing{path.suffix}")  # by which USD tells the format
        try:
            stage.Export(str(ending))
            ending.replace(partial)
        finally:
            ending.unlink(missing_ok=True)
    return path
