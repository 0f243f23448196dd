import re
import subprocess
import sys
from contextlib import nullcontext
from functools import partial

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.refusals import refuses
from warp_resphys import InputError, Mesh, MeshError, quadratic, read_mesh, select_vertices
from warp_resphys.core.mesh.boxes import box_hexahedra, box_tetrahedra, boxes_hexahedra
from warp_resphys.core.mesh.quality import cell_volumes
from warp_resphys.core.mesh.volume_mesh import (
    boundary_faces,
    boundary_triangles,
    check_mesh,
    surface_vertices,
)
from warp_resphys.io import decoding

BOXES = {
    "hexahedron": box_hexahedra,
    "tetrahedron": box_tetrahedra,
    "tetrahedron10": lambda size, divisions: box_tetrahedra(size, divisions, order=2),
    "hexahedron20": partial(box_hexahedra, nodes=20),
    "hexahedron27": partial(box_hexahedra, nodes=27),
}
PER_METRE = {"m": 1, "cm": 100, "mm": 1000}
TRIANGLES_PER_BRICK_SIDE = {
    "hexahedron": 2,
    "tetrahedron": 2,
    "tetrahedron10": 8,
    "hexahedron20": 6,
    "hexahedron27": 8,
}


def enclosed_volume(mesh):
    """Divergence theorem on the boundary, so positive only if the triangles face outwards."""
    a, b, c = np.moveaxis(mesh.vertices[boundary_triangles(mesh)], 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def is_closed(triangles):
    """Every directed edge occurs once, and once in the other direction."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    return len(directed) == len(edges) and all((b, a) in directed for a, b in directed)


def write(path, mesh, *blocks, units="m"):
    cells = [*blocks, (mesh.element.file_type, mesh.cells)]
    file_format = "gmsh" if path.suffix == ".msh" else None  # not ANSYS
    meshio.write(
        path, meshio.Mesh(mesh.vertices * PER_METRE[units], cells), file_format=file_format
    )
    return path


def with_vertex(mesh, index, position):
    vertices = mesh.vertices.copy()
    vertices[index] = position
    return Mesh(vertices, mesh.cells)


def with_cell(mesh, cell, nodes, vertices):
    cells = mesh.cells.copy()
    cells[cell, nodes] = vertices
    return Mesh(mesh.vertices, cells)


def test_beam_has_the_vertex_order_of_the_reference_files():
    mesh = box_hexahedra()
    assert mesh.kind == "hexahedron"
    assert mesh.vertices.shape == (176, 3)
    assert mesh.cells.shape == (90, 8)
    for i, j, k in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (10, 3, 3), (7, 2, 1)):
        expected = [0.01 * i, 0.01 * j, 0.01 * k]
        np.testing.assert_allclose(mesh.vertices[(4 * i + j) * 4 + k], expected, atol=1e-17)
    assert mesh.vertices[-1].tolist() == [0.1, 0.03, 0.03]
    assert len(surface_vertices(mesh)) == 140
    assert len(boundary_faces(mesh)) == 2 * (10 * 3 + 10 * 3 + 3 * 3)


@given(
    kind=st.sampled_from(sorted(BOXES)),
    size=st.tuples(*[st.floats(1e-3, 10.0)] * 3),
    divisions=st.tuples(*[st.integers(1, 4)] * 3),
)
@settings(max_examples=25, deadline=None)
def test_any_box_is_valid_closed_and_outward(kind, size, divisions):
    mesh = BOXES[kind](size, divisions)
    check_mesh(mesh)
    assert mesh.kind == kind
    assert enclosed_volume(mesh) == pytest.approx(np.prod(size), rel=1e-12)
    assert is_closed(boundary_triangles(mesh))
    nx, ny, nz = divisions
    sides = 2 * (nx * ny + ny * nz + nz * nx)
    assert len(boundary_triangles(mesh)) == TRIANGLES_PER_BRICK_SIDE[kind] * sides
    if kind == "hexahedron20":  # the corners, and the middles of the edges along each axis
        along = [np.prod(np.array(divisions) + 1) // (n + 1) * n for n in divisions]
        assert len(mesh.vertices) == np.prod(np.array(divisions) + 1) + sum(along)
        return
    points = np.array(divisions) * (2 if kind in ("tetrahedron10", "hexahedron27") else 1)
    assert len(mesh.vertices) == np.prod(points + 1)
    assert len(surface_vertices(mesh)) == np.prod(points + 1) - np.prod(points - 1)


PLATE = ((-0.005, -0.025, 0.0), (0.005, 0.025, 0.06))
SIDES = ((-0.015, -0.015, 0.0), (0.015, 0.015, 0.06))
FIN = ((-0.005, -0.015, 0.06), (0.005, 0.015, 0.08))


@pytest.mark.parametrize(("size", "nodes"), [(0.007, 8), (0.015, 20), (0.015, 27)])
def test_a_cross_with_a_fin_is_filled_without_cracks(size, nodes):
    mesh = boxes_hexahedra([PLATE, SIDES, FIN], size, nodes)
    check_mesh(mesh)
    assert mesh.element.nodes == nodes
    section = 0.01 * 0.05 + 2 * 0.01 * 0.03
    assert cell_volumes(mesh).sum() == pytest.approx(section * 0.06 + 0.01 * 0.03 * 0.02, rel=1e-12)
    around, (a, b, c) = (
        2 * (0.03 + 0.05),
        np.moveaxis(mesh.vertices[boundary_triangles(mesh)], 1, 0),
    )
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert area == pytest.approx(2 * section + around * 0.06 + 2 * (0.01 + 0.03) * 0.02, rel=1e-9)
    corners = mesh.vertices[mesh.cells[:, :8]]
    assert (corners.max(1) - corners.min(1)).max() <= size + 1e-12


@pytest.mark.parametrize(
    ("boxes", "size", "sentence"),
    [
        ([], 0.01, "a body of boxes needs one box or more"),
        ([PLATE, (PLATE[1], PLATE[0])], 0.01, "box 2 reaches from [0.005, 0.025, 0.06] to [-0.005"),
        (
            [((0, 0, 0), (0.1, 0.0, 0.1))],
            0.01,
            "box 1 reaches from [0.0, 0.0, 0.0] to [0.1, 0.0, 0.1] m: it has no",
        ),
        ([PLATE], 0.0, "the size of cells must be a positive length in metres, not 0.0"),
        ([PLATE, ((0.1, 0, 0), (0.2, 0.1, 0.1))], 0.01, "the boxes do not form one body"),
    ],
)
def test_boxes_that_make_no_body(boxes, size, sentence):
    refuses(MeshError, re.escape(sentence), boxes_hexahedra, boxes, size)


def test_boundary_encloses_the_cells_of_a_distorted_mesh_with_a_cavity():
    box = box_tetrahedra((0.1, 0.1, 0.1), (5, 5, 5))
    middle = np.abs(box.vertices[box.cells].mean(axis=1) - 0.05).max(axis=1) < 0.01
    moved = box.vertices + np.random.default_rng(3).uniform(-2e-3, 2e-3, box.vertices.shape)
    mesh = Mesh(moved, box.cells[~middle])
    check_mesh(mesh)
    assert middle.sum() == 6
    assert is_closed(boundary_triangles(mesh))
    assert len(boundary_faces(mesh)) == 2 * 6 * 25 + 2 * 6
    assert enclosed_volume(mesh) == pytest.approx(cell_volumes(mesh).sum(), rel=1e-12)


def test_selection_of_a_plane_and_of_an_edge():
    mesh = box_hexahedra()
    assert select_vertices(mesh, x=0.0).tolist() == list(range(16))
    assert select_vertices(mesh, x=0.1, z=0.03).tolist() == [163, 167, 171, 175]
    assert len(select_vertices(mesh, y=0.0149, tolerance=0.006)) == 2 * 11 * 4
    assert select_vertices(mesh, x=[0.0, 0.01]).tolist() == list(range(32))
    assert select_vertices(mesh, x=[0.1, 0.2], y=(-1.0, 0.0)).tolist() == [160, 161, 162, 163]


SIZE = "size of a box must be three positive lengths"
DIVISIONS = "divisions of a box must be three positive integers"
BEAM = box_hexahedra()
REFUSED = [
    *(
        (lambda size=size: box_hexahedra(size), SIZE)
        for size in ((0.1, 0, 1), (1, np.nan, 1), (1, 1), 0.1)
    ),
    *(
        (lambda counts=counts: box_tetrahedra(divisions=counts), DIVISIONS)
        for counts in ((1, 0, 1), (1, 2.0, 1), (1, 1), (True, True, True))
    ),
    (lambda: box_tetrahedra(order=3), "order of tetrahedra must be 1 or 2, not 3"),
    (lambda: box_hexahedra(nodes=26), "hexahedra have 8, 20 or 27 nodes, not 26"),
    (
        lambda: quadratic(BEAM, "tetrahedron10"),
        "nodes of tetrahedron10 cannot be added to hexahedron cells",
    ),
    (
        lambda: quadratic(box_tetrahedra(order=2)),
        "of a quadratic element cannot be added to tetrahedron10 cells",
    ),
    (lambda: Mesh(np.zeros((4, 2)), np.zeros((1, 4), int)), "^vertices must be"),
    (lambda: Mesh(np.zeros((4, 3), complex), np.zeros((1, 4), int)), "^vertices must be"),
    (lambda: Mesh(np.zeros((4, 3)), np.zeros((1, 5), int)), "^cells must be"),
    (lambda: Mesh(np.zeros((4, 3)), np.zeros((1, 4))), "^cells must be"),
    (
        lambda: select_vertices(BEAM, x=0.2),
        r"x = 0\.2 m: .* a range for a face that is not flat, as in x=\[0, 0\.01\]",
    ),
    (lambda: select_vertices(BEAM, x=[0.011, 0.019]), r"x = 0\.011 to 0\.019 m"),
    (lambda: select_vertices(BEAM), "at least one of the coordinates"),
    *(
        (
            lambda at=at: select_vertices(BEAM, x=at),
            r"select_vertices\.x is .*: it must be (two rising|a number or two)",
        )
        for at in ("base", [0.02, 0.01], [0.0, 0.01, 0.02], [], float("nan"), [0.0, float("inf")])
    ),
    (lambda: read_mesh(__file__, units="inch"), "m, cm, mm, not inch"),
    (lambda: read_mesh(__file__, order=3), "order of a mesh must be 1 or 2, not 3"),
]


@pytest.mark.parametrize(("make", "message"), REFUSED)
def test_bad_arguments_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


TURNED = [4, 5, 6, 7, 0, 1, 2, 3]


@pytest.mark.parametrize(
    ("broken", "match"),
    [
        (lambda m: Mesh(m.vertices, m.cells[:0]), "empty"),
        (
            lambda m: with_vertex(m, 5, [0, np.nan, 0]),
            r"^1 of 176 vertices \(5; .* NaN or infinite",
        ),
        (lambda m: with_vertex(m, 7, [0, 0, 1e300]), r"^1 of 176 vertices \(7; .* NaN or infinite"),
        (lambda m: with_cell(m, 3, 1, 176), r"^1 of 90 cells \(3; .* outside 0 to 175"),
        (
            lambda m: Mesh(np.vstack([m.vertices, [[1, 1, 1]]]), m.cells),
            r"^1 of 177 .* \(176; .* no cell",
        ),
        (lambda m: with_cell(m, 8, TURNED, m.cells[8]), r"^1 of 90 cells \(8; .* inverted"),
        (
            lambda m: Mesh(m.vertices, m.cells[:, TURNED]),
            r"^90 .* \(0, 1, 2, 3, 4, \.\.\.; .* inverted",
        ),
    ],
)
def test_broken_meshes_are_refused_by_name(broken, match):
    mesh = box_hexahedra()
    check_mesh(mesh)
    refuses(MeshError, match, check_mesh, broken(mesh))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_flatness_is_relative_to_the_longest_edge(scale):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1]])
    flat, thin = corners * [scale, scale, 1e-12 * scale], corners * [scale, scale, 1e-10 * scale]
    check_mesh(Mesh(thin, np.array([[0, 1, 2, 3]])))
    refuses(MeshError, "flat", check_mesh, Mesh(flat, np.array([[0, 1, 2, 3]])))


def test_hexahedra_are_checked_at_their_corners_and_quadratic_tetrahedra_at_their_nodes():
    """With corner 6 of the unit cube at (s, s, s) the determinant there is 3 s - 2.

    Inside it is positive.
    """
    cube = box_hexahedra((1, 1, 1), (1, 1, 1))
    check_mesh(with_vertex(cube, 7, 0.67))
    refuses(MeshError, "folded", check_mesh, with_vertex(cube, 7, 0.66))
    # A midpoint at a quarter of its edge makes the map singular at the corner (quarter-point
    # element).
    mesh = quadratic(Mesh(np.eye(4)[:, 1:], np.array([[0, 1, 2, 3]])))
    node = mesh.cells[0, 4]
    check_mesh(with_vertex(mesh, node, [0.26, 0, 0]))
    refuses(MeshError, "folded", check_mesh, with_vertex(mesh, node, [0.24, 0, 0]))


@pytest.mark.parametrize(("gap", "cracked"), [(0.0, True), (1e-11, True), (1e-6, False)])
def test_crack_between_coincident_vertices_is_refused(gap, cracked):
    left = box_hexahedra((0.1, 0.1, 0.1), (4, 4, 4))
    right = left.vertices + np.array([0.1 + gap, 0, 0])
    mesh = Mesh(np.vstack([left.vertices, right]), np.vstack([left.cells, left.cells + len(right)]))
    with (
        pytest.raises(MeshError, match=r"^25 of 250 .* on another one")
        if cracked
        else nullcontext()
    ):
        check_mesh(mesh)


@pytest.mark.parametrize(
    ("kind", "extension", "units"),
    [("hexahedron", "vtk", "m"), ("tetrahedron", "vtu", "cm")],  # others in test_readers.py
)
def test_files_come_back_in_metres(tmp_path, kind, extension, units):
    mesh = BOXES[kind]((0.1, 0.03, 0.02), (2, 1, 1))
    read = read_mesh(write(tmp_path / f"box.{extension}", mesh, units=units), units=units)
    assert read.kind == kind
    np.testing.assert_allclose(read.vertices, mesh.vertices, rtol=1e-12, atol=1e-15)
    assert np.array_equal(read.cells, mesh.cells)


def test_unreferenced_vertices_are_dropped_only_on_request(tmp_path):
    mesh = box_tetrahedra()
    vertices = np.vstack([[[9, 9, 9], [8, 8, 8]], mesh.vertices])
    path = write(tmp_path / "box.vtk", Mesh(vertices, mesh.cells + 2))
    refuses(MeshError, r"box.vtk: 2 of 178 vertices \(0, 1; .* no cell", read_mesh, path)
    read = read_mesh(path, drop_unreferenced=True)
    assert np.array_equal(read.vertices, mesh.vertices)
    assert np.array_equal(read.cells, mesh.cells)


@pytest.mark.parametrize(
    ("size", "written_in", "units"), [(0.1, "mm", "m"), (0.1, "m", "mm"), (6.0, "m", "m")]
)
def test_implausible_size_is_refused(tmp_path, size, written_in, units):
    path = write(tmp_path / "box.vtk", box_hexahedra([size] * 3, (1, 1, 1)), units=written_in)
    diagonal = f"{np.sqrt(3) * size * PER_METRE[written_in] / PER_METRE[units]:g} m"
    refuses(
        MeshError,
        f"units={units}, .* is {diagonal}, .* did you mean units=",
        read_mesh,
        path,
        units=units,
    )


def test_files_without_usable_cells_are_refused(tmp_path):
    tetrahedra, hexahedra = box_tetrahedra(), box_hexahedra()
    mixed = write(tmp_path / "mixed.vtk", hexahedra, ("tetra", tetrahedra.cells))
    refuses(MeshError, r"mixed.vtk: the file has hexahedron and tetra cells", read_mesh, mixed)
    surface = tmp_path / "surface.stl"
    meshio.write(
        surface, meshio.Mesh(tetrahedra.vertices, [("triangle", boundary_triangles(tetrahedra))])
    )
    refuses(MeshError, r"no tetrahedra or hexahedra \(only: triangle\)", read_mesh, surface)


@pytest.mark.parametrize(
    "name", ["missing.vtk", "folder.vtk", "mesh.xyz", "foreign.vtk", "cut.msh"]
)
def test_unreadable_file_gives_one_sentence_and_no_output(tmp_path, name, capfd):
    (tmp_path / "folder.vtk").mkdir()
    (tmp_path / "mesh.xyz").write_text("0 0 0\n")
    (tmp_path / "foreign.vtk").write_bytes(bytes(range(256)) * 4)
    path = tmp_path / name
    if name.startswith("cut"):
        content = write(path, box_tetrahedra()).read_bytes()
        path.write_bytes(content[: len(content) // 2])
    capfd.readouterr()
    with pytest.raises(MeshError) as caught:
        read_mesh(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_format_that_needs_another_package_names_it(tmp_path, monkeypatch):
    path = write(tmp_path / "box.med", box_tetrahedra())
    (tmp_path / "without" / "h5py.py").parent.mkdir()
    (tmp_path / "without" / "h5py.py").write_text(
        "raise ModuleNotFoundError('no h5py', name='h5py')"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "without"))
    refuses(MeshError, "install the Python package h5py", read_mesh, path)


@pytest.mark.slow
def test_files_that_are_read_for_ever_or_claim_too_much_memory_end_with_one_sentence(
    tmp_path, monkeypatch
):
    path = write(tmp_path / "cut.tec", box_tetrahedra())
    path.write_text(path.read_text()[:2000])
    monkeypatch.setattr(decoding, "SECONDS", (1.0, 0.0))
    refuses(
        MeshError,
        r"cut\.tec: meshio cannot read .* \(decoding takes more than 1 s\)",
        read_mesh,
        path,
    )
    path = write(tmp_path / "big.vtk", box_tetrahedra())
    path.write_bytes(path.read_bytes().replace(b"POINTS 176", b"POINTS 17600000000"))
    refuses(
        MeshError,
        r"big\.vtk: VTK cannot read the file \(Unable to allocate 52800000003",
        read_mesh,
        path,
    )
    path = tmp_path / "big.inp"
    path.write_text("*ELSET, ELSET=all, GENERATE\n1, 10000000000\n")
    refuses(MeshError, r"big\.inp: it takes more than 20\d\d MiB of memory", read_mesh, path)


@pytest.mark.slow
def test_importing_the_mesh_modules_leaves_meshio_alone():
    code = (
        "import sys, warp_resphys.mesh, warp_resphys.core.mesh.readers; "
        "sys.exit('meshio' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
