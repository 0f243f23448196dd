"""Reads meshes of VTK: .vtk, and the XML formats of one file.

Grids without cells of their own are voxels or bricks.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import DecodingError
from .mesh_blocks import Block

_KINDS = {  # meshio's names by VTK's number
    **{
        1: "vertex",
        3: "line",
        5: "triangle",
        8: "quad",
        9: "quad",
        10: "tetra",
        11: "hexahedron",
        12: "hexahedron",
    },
    **{
        13: "wedge",
        14: "pyramid",
        22: "triangle6",
        23: "quad8",
        24: "tetra10",
        25: "hexahedron20",
        28: "quad9",
    },
    **{29: "hexahedron27"},
}
_FACES = (5, 6, 7, 8, 9, 22, 23, 28, 30, 34, 61, 62, 63, 69, 70, 76, 77)  # kinds of two dimensions
_LOWER = (0, 1, 2, 3, 4, 21, 35, 60, 68, 75)  # points and lines
_ORDERS = {8: [0, 1, 3, 2], 11: [0, 1, 3, 2, 4, 5, 7, 6]}  # pixels and voxels have corners in lines


def read_vtk(path: str) -> tuple[NDArray[np.float64], list[Block]]:
    """Returns points (N, 3) and blocks of cells of a file of VTK.

    Raises:
        DecodingError: VTK cannot read the file.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkFiltersCore import vtkAppendFilter
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader
    from vtkmodules.vtkIOXML import vtkXMLGenericDataObjectReader

    messages = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(messages)
    is_legacy = Path(path).suffix.lower() == ".vtk"
    reader = vtkGenericDataObjectReader() if is_legacy else vtkXMLGenericDataObjectReader()
    reader.SetFileName(path)
    reader.Update()
    grid, said = reader.GetOutput(), messages.GetOutput()
    # Bytes if it quotes a damaged file.
    said = said.decode(errors="replace") if isinstance(said, bytes) else said
    if "ERROR: In" in said or grid is None or not grid.IsA("vtkDataSet"):
        reason = (
            re.sub(r"^.*?\): ", "", said, flags=re.DOTALL).partition("ERROR")[0].strip()
            or "no mesh"
        )
        raise DecodingError(
            f"VTK cannot read the file ({reason}); is it whole, and of its extension's format?"
        )
    if not grid.IsA("vtkUnstructuredGrid"):
        converter = vtkAppendFilter()
        converter.AddInputData(grid)
        converter.Update()
        grid = converter.GetOutput()
    count = grid.GetNumberOfCells()
    if not count:
        return np.empty((0, 3)), []
    kinds = np.fromiter(map(grid.GetCellType, range(count)), dtype=np.int64, count=count)
    cells = grid.GetCells()
    ends, nodes = vtk_to_numpy(cells.GetOffsetsArray()), vtk_to_numpy(cells.GetConnectivityArray())
    blocks = []
    for kind in np.unique(kinds).tolist():
        chosen = np.flatnonzero(kinds == kind)
        sizes = ends[chosen + 1] - ends[chosen]
        if kind in _KINDS and sizes.min() < sizes.max():
            raise DecodingError(
                "the file is damaged: cells of one kind have different numbers of nodes"
            )
        rows = nodes[ends[chosen, None] + np.arange(sizes.min())].astype(np.int64)
        rows = rows[:, _ORDERS.get(kind, slice(None))]
        dimension = 2 if kind in _FACES else 1 if kind in _LOWER else 3
        blocks.append(Block(_KINDS.get(kind, f"VTK type {kind}"), dimension, rows, {}))
    return vtk_to_numpy(grid.GetPoints().GetData()).astype(np.float64), blocks
