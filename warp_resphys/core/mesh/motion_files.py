"""Export of motions: CSV tables, time series for ParaView, USD scenes."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from ...io.arrays import FloatArray, IntArray
from ...io.atomic import atomic_path
from ...io.errors import InputError, needs_extra
from ...io.safe_files import write_text
from .volume_mesh import Mesh, boundary_triangles, surface_vertices

Solid = tuple[FloatArray, IntArray]  # corners and triangles
_USD = (".usd", ".usda", ".usdc")
_MARKER_SHARE = 0.02  # diameter of a marker, over the body's size


def input_columns(
    name: str, parts: Sequence[str], unit: str, values: FloatArray
) -> dict[str, FloatArray]:
    """Returns table columns (T + 1,) of an input (T, C):
    at each time, the value of the step that ends there.
    """
    headers = [f"{name}.{part} [{unit}]" for part in parts]
    return dict(zip(headers, np.concatenate([values[:1], values]).T, strict=True))


def write_csv(
    path: Path,
    times: FloatArray,
    labels: Sequence[str],
    markers: FloatArray,
    columns: Mapping[str, FloatArray],
) -> Path:
    """Writes a table of markers (T + 1, M, 3) [m] at times (T + 1,) [s],
    and of further columns (T + 1,) by header.

    Without labels, columns are named as vertices.
    """
    labels = labels or [f"vertex_{number}" for number in range(markers.shape[1])]
    header = ["time [s]", *(f"{label}.{axis} [m]" for label in labels for axis in "xyz"), *columns]
    more = [values[:, None] for values in columns.values()]
    rows = np.concatenate([times[:, None], markers.reshape(len(times), -1), *more], axis=1)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([["" if np.isnan(x) else f"{x:.12g}" for x in row] for row in rows])
    write_text(path, text.getvalue())
    return path


def write_vtk(
    path: Path,
    mesh: Mesh,
    times: FloatArray,
    q: FloatArray,
    v: FloatArray,
    markers: FloatArray,
    obstacles: Mapping[str, Solid],
    fields: Mapping[str, FloatArray],
) -> Path:
    """Writes a time series for ParaView: a ``.pvd`` file,
    and a folder of the same name with one file per step.

    Args:
        path: path of the ``.pvd`` file.
        mesh: the rest shape.
        times: (T + 1,) [s].
        q: (T + 1, N, 3) positions of the vertices [m].
        v: (T + 1, N, 3) velocities [m/s].
        markers: (T + 1, M, 3) markers, written to ``NAME_markers.pvd`` unless M is 0 [m].
        obstacles: corners (T + 1, P, 3) [m] and triangles (S, 3) by name, counter-clockwise seen
            from outside; written to ``NAME_obstacles.pvd`` if there are any, numbered by
            ``obstacle``.
        fields: further vectors (T + 1, N, 3) at the vertices, by name.
    """
    if path.suffix != ".pvd":
        raise InputError(
            f"{path} does not end in .pvd: give such a name, which ParaView opens as a time series."
        )
    every = {"displacement": q - mesh.vertices, "velocity": v, **fields}
    at_times = (
        {name: values[number] for name, values in every.items()} for number in range(len(times))
    )
    _write_series(path, times, q, (mesh.element.file_type, mesh.cells), at_times)
    dots = np.arange(markers.shape[1])
    if len(dots):
        place = path.with_name(f"{path.stem}_markers.pvd")
        _write_series(
            place, times, markers, ("vertex", dots[:, None]), ({"marker": dots} for _ in times)
        )
    if obstacles:
        corners, solids = zip(*obstacles.values(), strict=True)
        sizes = [points.shape[1] for points in corners]
        firsts, number = np.cumsum([0, *sizes[:-1]]), np.repeat(np.arange(len(sizes)), sizes)
        triangles = np.concatenate(
            [solid + first for solid, first in zip(solids, firsts, strict=True)]
        )
        points = np.concatenate(corners, axis=1)
        place = path.with_name(f"{path.stem}_obstacles.pvd")
        _write_series(
            place, times, points, ("triangle", triangles), ({"obstacle": number} for _ in times)
        )
    return path


def write_vtu(
    path: Path, points: FloatArray, cells: Sequence[tuple[str, IntArray]], fields: Mapping[str, Any]
) -> Path:
    """Writes a file for ParaView.

    Args:
        path: path of the ``.vtu`` file.
        points: (N, 3) [m].
        cells: names of their kinds in files, and their points, in blocks.
        fields: values (N, ...) at the points by name.
    """
    import meshio

    if path.suffix != ".vtu":
        raise InputError(
            f"{path} does not end in .vtu: give such a name, which ParaView opens as one mesh."
        )
    with atomic_path(path) as partial:
        meshio.write(
            partial, meshio.Mesh(points, [*cells], point_data=dict(fields)), file_format="vtu"
        )
    return path


def _write_series(
    path: Path,
    times: FloatArray,
    points: FloatArray,
    cells: tuple[str, IntArray],
    fields: Iterator[dict[str, Any]],
) -> None:
    """Writes one file per time, then the collection that lists them."""
    entries, digits = [], len(str(len(times) - 1))
    for number, (time, at, data) in enumerate(zip(times, points, fields, strict=True)):
        name = f"{path.stem}/{path.stem}_{number:0{digits}d}.vtu"
        write_vtu(path.parent / name, at, [cells], data)
        entries.append(f'    <DataSet timestep="{time:.9g}" file={quoteattr(name)}/>')
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="Collection" version="0.1">',
        "  <Collection>",
        *entries,
    ]
    write_text(path, "\n".join([*lines, "  </Collection>", "</VTKFile>", ""]))


def write_usd(
    path: Path,
    mesh: Mesh,
    times: FloatArray,
    q: FloatArray,
    markers: FloatArray,
    obstacles: Mapping[str, Solid],
) -> Path:
    """Writes the surfaces of a body and its obstacles,
    and its markers, with their motion to a USD file.

    Arrays are as in `write_vtk`; an obstacle is the mesh ``/robot/obstacles/NAME``.
    """
    if path.suffix not in _USD:
        raise InputError(f"{path} does not end in {', '.join(_USD)}: give such a name.")
    with needs_extra("usd", "USD files need"):
        from pxr import Tf, Usd, UsdGeom, Vt
    surface = surface_vertices(mesh)
    triangles = np.searchsorted(surface, boundary_triangles(mesh))
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
    meshes = {"/robot/body": (q[:, surface], triangles)}
    meshes |= {
        f"/robot/obstacles/{Tf.MakeValidIdentifier(name)}": solid
        for name, solid in obstacles.items()
    }
    if obstacles:
        UsdGeom.Xform.Define(stage, "/robot/obstacles")
    surfaces: list[tuple[Any, FloatArray]] = []
    for place, (corners, sides) in meshes.items():
        shape = UsdGeom.Mesh.Define(stage, place)
        shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        shape.CreateFaceVertexCountsAttr(
            Vt.IntArray.FromNumpy(np.full(len(sides), 3, dtype=np.int32))
        )
        shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(sides.astype(np.int32).ravel()))
        surfaces.append((shape, corners))
    if markers.shape[1]:
        dots = UsdGeom.Points.Define(stage, "/robot/markers")
        size = _MARKER_SHARE * float(np.ptp(mesh.vertices, axis=0).max())
        dots.CreateWidthsAttr(
            Vt.FloatArray.FromNumpy(np.full(markers.shape[1], size, dtype=np.float32))
        )
        surfaces.append((dots, markers))
    for shape, series in surfaces:
        points, extent = shape.CreatePointsAttr(), shape.CreateExtentAttr()
        for number, at in enumerate(series.astype(np.float32)):
            points.Set(Vt.Vec3fArray.FromNumpy(at), float(number))
            extent.Set(Vt.Vec3fArray.FromNumpy(np.stack([at.min(0), at.max(0)])), float(number))
    with atomic_path(path) as partial:
        # USD needs the suffix for the format
        temporary = partial.with_name(f"{partial.stem}.writing{path.suffix}")
        try:
            stage.Export(str(temporary))
            temporary.replace(partial)
        finally:
            temporary.unlink(missing_ok=True)
    return path
