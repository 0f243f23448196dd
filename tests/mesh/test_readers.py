"""Regions of meshes in files."""

import numpy as np
import pytest

from warp_resphys import Mesh, box_hexahedra, box_tetrahedra, read_mesh
from warp_resphys.io.errors import MeshError
from warp_resphys.mesh import read_surfaces, write_mesh
from warp_resphys.mesh.volume_mesh import boundary_faces


def in_two(mesh):
    half = len(mesh.cells) // 2
    return Mesh(mesh.vertices, mesh.cells, {"base": np.arange(half), "tip": np.arange(half, len(mesh.cells))})


@pytest.mark.parametrize("mesh", [box_hexahedra(divisions=(4, 1, 1)), box_tetrahedra(divisions=(4, 1, 1), order=2)])
def test_gmsh_files_keep_regions_beside_surfaces(tmp_path, mesh):
    mesh = in_two(mesh)
    write_mesh(tmp_path / "two.msh", mesh, {"end": boundary_faces(mesh)[:1]})
    again = read_mesh(tmp_path / "two.msh")
    assert list(again.regions) == ["base", "tip"]
    for name, cells in mesh.regions.items():
        np.testing.assert_array_equal(again.region(name), cells)
    assert list(read_surfaces(tmp_path / "two.msh")) == ["end"]


def test_regions_that_cannot_be_are_refused():
    mesh = box_hexahedra(divisions=(2, 1, 1))
    for cells in ([], [2], [True, False], [-1]):
        with pytest.raises(MeshError, match="'tip'"):
            Mesh(mesh.vertices, mesh.cells, {"tip": np.array(cells)})
    with pytest.raises(MeshError, match="no region 'top'; it has base, tip"):
        in_two(mesh).region("top")


def test_cells_in_several_regions_are_kept(tmp_path):
    mesh = box_hexahedra(divisions=(3, 1, 1))
    regions = {"a": np.array([1]), "b": np.array([0, 1]), "c": np.array([1])}
    write_mesh(tmp_path / "twice.msh", Mesh(mesh.vertices, mesh.cells, regions))
    again = read_mesh(tmp_path / "twice.msh")
    np.testing.assert_array_equal(again.cells, mesh.cells)
    assert {name: cells.tolist() for name, cells in again.regions.items()} == {
        "body": [2],
        **{name: cells.tolist() for name, cells in regions.items()},
    }
