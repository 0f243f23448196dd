"""Reading of volume meshes from files, through meshio; lengths become metres here."""

import logging
import os
import warnings
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_resphys.errors import MeshError
from warp_resphys.mesh import IntArray, Mesh, check_mesh, quadratic

if TYPE_CHECKING:
    import meshio

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}  # [m] length of one unit
SHORTEST_DIAGONAL, LONGEST_DIAGONAL = 1e-3, 10.0  # [m] of a body whose units are believed

_CELL_TYPES = ("tetra", "tetra10", "hexahedron")  # meshio's names of the cells that can be simulated
_log = logging.getLogger(__name__)


def read_mesh(path: str | os.PathLike[str], units: str = "m", order: int = 1, drop_unreferenced: bool = False) -> Mesh:
    """Read and check a tetrahedral or hexahedral mesh in any format that meshio reads.

    Points, lines and surface cells of the file are ignored, as are its data fields.

    Args:
        path: The file; its extension tells the format.
        units: Unit of the coordinates in the file: "m", "cm" or "mm".
        order: 2 adds the edge midpoints to 4-node tetrahedra; 1 takes the cells as they are in the file.
        drop_unreferenced: Leave out vertices that belong to no volume cell, which are an error otherwise.

    Returns:
        The mesh in metres. Vertices keep the file's order.

    Raises:
        MeshError: The file is missing or unreadable, has no volume cells or cells of several or unsupported
            kinds, fails `check_mesh`, is less than 1 mm or more than 10 m across; or an argument is unknown.
    """
    path = Path(path)
    if units not in METRES:
        raise MeshError(f"the units of a mesh file must be one of {', '.join(METRES)}, not {units}")
    if order not in (1, 2):
        raise MeshError(f"the order of a mesh must be 1 or 2, not {order}")
    if not path.is_file():
        raise MeshError(f"{path}: there is no such mesh file")
    content = _read_file(path)
    try:
        mesh = Mesh(content.points, _volume_cells(content))
        if drop_unreferenced:
            mesh = _without_unreferenced(mesh)
        check_mesh(mesh)
        mesh = Mesh(mesh.vertices * METRES[units], mesh.cells)
        _check_size(mesh, units)
        return quadratic(mesh) if order == 2 and mesh.kind != "tetrahedron10" else mesh
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def _read_file(path: Path) -> "meshio.Mesh":
    """Read a file with meshio, which raises exceptions of many kinds, prints, and exits on some bad files."""
    printed, warned = StringIO(), StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(warned), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import meshio

            content = meshio.read(path)
    except ModuleNotFoundError as error:
        raise MeshError(f"{path}: to read this format, install the Python package {error.name}") from error
    except (Exception, SystemExit) as error:
        said = printed.getvalue() if isinstance(error, SystemExit) else f"{type(error).__name__}: {error}"
        reason = " ".join(said.split())[:200] or "no reason given"
        raise MeshError(
            f"{path}: meshio cannot read this file ({reason}); is it whole, and of its extension's format?"
        ) from error
    if warned.getvalue():
        _log.debug("%s: meshio says: %s", path, warned.getvalue())
    return content


def _volume_cells(content: "meshio.Mesh") -> IntArray:
    """Cells of the one supported kind in a file, (M, 4 | 8 | 10); MeshError if there is not exactly one."""
    solids = {block.type for block in content.cells if block.dim == 3 and len(block)}
    if not solids:
        others = ", ".join(sorted({block.type for block in content.cells})) or "no cells"
        raise MeshError(f"the file has no tetrahedra or hexahedra (only: {others}); mesh the volume first")
    if len(solids) > 1 or not solids.issubset(_CELL_TYPES):
        wanted = f"{', '.join(_CELL_TYPES[:-1])} or {_CELL_TYPES[-1]}"
        raise MeshError(f"the file has {' and '.join(sorted(solids))} cells; all must be {wanted}, and of one kind")
    blocks = [np.asarray(block.data, dtype=np.int64) for block in content.cells if block.type in solids]
    return np.concatenate([block for block in blocks if len(block)])


def _without_unreferenced(mesh: Mesh) -> Mesh:
    """Drop vertices that belong to no cell; a mesh with invalid indices stays as it is, to be refused."""
    count = len(mesh.vertices)
    used, cells = np.unique(mesh.cells, return_inverse=True)
    if used[0] < 0 or used[-1] >= count:
        return mesh
    return Mesh(mesh.vertices[used], cells.reshape(mesh.cells.shape))


def _check_size(mesh: Mesh, units: str) -> None:
    """Raise MeshError if the bounding box is so small or large that the units are likely wrong."""
    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    if not SHORTEST_DIAGONAL <= diagonal <= LONGEST_DIAGONAL:
        others = " or ".join(f"units={unit}" for unit in METRES if unit != units)
        raise MeshError(
            f"read with units={units}, the diagonal of the bounding box is {diagonal:g} m, outside "
            f"{SHORTEST_DIAGONAL:g} to {LONGEST_DIAGONAL:g} m; did you mean {others}?"
        )
