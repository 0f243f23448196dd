"""Closed surfaces filled with tetrahedra."""

import numpy as np
import pytest
import trimesh

from support.refusals import refuses
from warp_resphys.core.mesh.chambers import find_chambers
from warp_resphys.core.mesh.quality import cell_volumes, scaled_jacobian
from warp_resphys.core.mesh.tetrahedra import fill_surface
from warp_resphys.core.mesh.volume_mesh import check_mesh
from warp_resphys.io.errors import MeshError


@pytest.fixture
def _gmsh():
    pytest.importorskip("gmsh", reason="gmsh is not installed", exc_type=ImportError)


def written(tmp_path, *shells, name="robot.stl"):
    path = tmp_path / name
    trimesh.util.concatenate(shells).export(path)
    return path


@pytest.mark.usefixtures("_gmsh")
@pytest.mark.parametrize(("name", "order"), [("robot.stl", 1), ("robot.ply", 2)])
def test_a_box_is_filled_to_its_edges(tmp_path, name, order):
    path = written(tmp_path, trimesh.creation.box((100.0, 30.0, 20.0)), name=name)
    mesh = fill_surface(path, 0.01, "mm", order)
    check_mesh(mesh)
    assert mesh.cells.shape[1] == {1: 4, 2: 10}[order]
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [0.1, 0.03, 0.02], rtol=1e-6)
    assert cell_volumes(mesh).sum() == pytest.approx(6e-5, rel=1e-6)
    assert scaled_jacobian(mesh).min() > 0.1
    corners = mesh.vertices[mesh.cells[:, :4]]
    edges = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=-1).max(axis=(1, 2))
    assert 0.004 < np.median(edges) < 0.02
    again = fill_surface(path, 0.01, "mm", order)
    np.testing.assert_array_equal(mesh.cells, again.cells)


@pytest.mark.usefixtures("_gmsh")
def test_surfaces_within_are_chambers(tmp_path):
    """Whichever way their triangles turn, as programs differ in that."""
    outer = trimesh.creation.cylinder(20.0, 100.0, sections=24)
    for turned in (False, True):
        holes = [trimesh.creation.box((10.0, 14.0, 60.0)) for _ in range(2)]
        for hole, x in zip(holes, (-9.0, 9.0), strict=True):
            hole.apply_translation([x, 0.0, 0.0])
            if turned:
                hole.invert()
        mesh = fill_surface(written(tmp_path, outer, *holes), 0.008, "mm", order=1)
        assert cell_volumes(mesh).sum() == pytest.approx(
            1e-9 * (outer.volume - 2 * 8400.0), rel=0.02
        )
        chambers = find_chambers(mesh)
        assert len(chambers) == 2
        centres = sorted(
            mesh.vertices[np.unique(chamber.faces)].mean(axis=0)[0] for chamber in chambers
        )
        np.testing.assert_allclose(centres, [-0.009, 0.009], atol=5e-4)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"units": "inch"}, "a surface in inch filled to order 2"),
        ({"order": 3}, "orders 1 or 2"),
        ({"size": 0.0}, "the size of tetrahedra is 0.0"),
        ({"units": "m"}, "read with units=m, the diagonal of the bounding box is 106"),
    ],
)
def test_arguments_that_do_not_fit(tmp_path, changes, said):
    path = written(tmp_path, trimesh.creation.box((100.0, 30.0, 20.0)))
    refuses(MeshError, said, fill_surface, path, **{"size": 0.01, "units": "mm", **changes})


def test_files_that_are_no_closed_surface(tmp_path):
    box = trimesh.creation.box((100.0, 30.0, 20.0))
    box.update_faces(np.arange(12) != 5)
    with pytest.raises(
        MeshError,
        match=r"3 edges of its triangles do not have two of them, the first at \(.*\): close",
    ):
        fill_surface(written(tmp_path, box), 0.01, "mm")
    refuses(MeshError, "there is no such file", fill_surface, tmp_path / "other.stl", 0.01)
    broken = {
        "torn.stl": b"solid robot\nfacet nor",
        "robot.obj": b"\x00\x01",
        "robot.xyz": b"1 2 3\n",
    }
    for name, content in broken.items():
        (tmp_path / name).write_bytes(content)
        refuses(MeshError, "export", fill_surface, tmp_path / name, 0.01)


@pytest.mark.usefixtures("_gmsh")
def test_files_as_other_programs_write_them(tmp_path):
    """With texture coordinates of its own at each corner,
    and with triangles that turn either way.
    """
    box = trimesh.creation.box((100.0, 30.0, 20.0))
    path, corners = tmp_path / "robot.obj", "".join(f"v {x} {y} {z}\n" for x, y, z in box.vertices)
    textures = "".join(f"vt {u:.4f} {1.0 - u:.4f}\n" for u in np.linspace(0.0, 1.0, 36))
    faces = "".join(
        "f " + " ".join(f"{v + 1}/{3 * row + k + 1}" for k, v in enumerate(face)) + "\n"
        for row, face in enumerate(box.faces)
    )
    path.write_text(corners + textures + faces)
    assert cell_volumes(fill_surface(path, 0.01, "mm", 1)).sum() == pytest.approx(6e-5, rel=1e-6)
    turned = box.copy()
    turned.faces[:5] = turned.faces[:5, ::-1]
    turned.export(tmp_path / "turned.ply")
    assert cell_volumes(
        fill_surface(tmp_path / "turned.ply", 0.01, "mm", 1)
    ).sum() == pytest.approx(6e-5, rel=1e-6)


def test_bodies_beside_one_another(tmp_path):
    other = trimesh.creation.box((10.0, 10.0, 10.0))
    other.apply_translation([80.0, 0.0, 0.0])
    path = written(tmp_path, trimesh.creation.box((100.0, 30.0, 20.0)), other)
    refuses(
        MeshError,
        r"closed surfaces beside one another \(2 in all\)",
        fill_surface,
        path,
        0.01,
        "mm",
    )
