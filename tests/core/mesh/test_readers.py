"""Meshes in files of gmsh, Abaqus and VTK: every cell once,
sets by their members, nodes in the right order.
"""

import meshio
import numpy as np
import pytest
import pyvista

from support.refusals import refuses
from warp_resphys import Mesh, MeshError, ResphysWarning, box_hexahedra, box_tetrahedra, read_mesh
from warp_resphys.core.mesh.elements import ELEMENTS
from warp_resphys.core.mesh.quality import cell_volumes
from warp_resphys.core.mesh.readers import read_vertices
from warp_resphys.core.mesh.volume_mesh import boundary_faces, quadratic
from warp_resphys.mesh import read_surfaces, write_mesh

BAR = box_hexahedra((0.02, 0.01, 0.01), (2, 1, 1))  # 12 vertices, two cells of 1000 mm^3 along x
LEFT = [101, 102, 104, 103]  # numbers of the nodes of its face at x = 0


def bar(kind):
    linear = (
        box_tetrahedra((0.02, 0.01, 0.01), (2, 1, 1)) if kind.startswith("tetrahedron") else BAR
    )
    return linear if kind == linear.kind else quadratic(linear, kind)


def text(*rows):
    return "".join(" ".join(f"{value:g}" for value in row) + "\n" for row in rows)


def msh(version, named, parametric, partitioned):
    """The bar by gmsh: surface 5 ("tip"), volumes 1 ("all") and 2 ("all", "tip"),
    and a node 7 of no cell.
    """
    new, of = version == "4.1", {5: [7], 1: [7], 2: [7, 8], 12: [7, 8]} if named else {}
    cells = [
        (2, 5, 3, LEFT),
        (3, 1, 5, BAR.cells[0] + 101),
        (3, 12 if partitioned else 2, 5, BAR.cells[1] + 101),
    ]
    places = list(enumerate(1e3 * BAR.vertices, start=101))
    sections = {
        "MeshFormat": f"{version} 0 8\n",
        "PhysicalNames": '3\n2 7 "tip"\n3 7 "all"\n3 8 "tip"\n',
    }
    if version == "2.2":
        own, alone = ([2, 5, 0.1, 0.2], [0, 1]) if parametric else ([], [])
        rows = [[13], [7, 99, 0, 0, *alone], *([k, *x, *own] for k, x in places)]
        sections["ParametricNodes" if parametric else "Nodes"] = text(*rows)
        rows = [
            [kind, 2, group, tag, *cell]
            for _, tag, kind, cell in cells
            for group in of.get(tag, [0])
        ]
        sections["Elements"] = text(
            [len(rows)], *([number, *row] for number, row in enumerate(rows, start=1))
        )
    else:
        entities = {
            tag: [tag, *6 * [0], len(of.get(tag, [])), *of.get(tag, []), 0] for tag in (5, 1, 2, 12)
        }
        points, own = [[1, *(3 if new else 6) * [0], 0]], [0.1, 0.2, 0.3] if parametric else []
        sections["Entities"] = text([1, 0, 1, 2], *points, *(entities[tag] for tag in (5, 1, 2)))
        if partitioned:
            sections["PartitionedEntities"] = text(
                [1], [0], [0, 0, 0, 1], [12, 3, 2, 1, 1, *entities[12][1:]]
            )
        heads = (
            [[0, 1, 0, 1], [3, 1, parametric, 12]]
            if new
            else [[1, 0, 0, 1], [1, 3, parametric, 12]]
        )
        if new:
            inside = [*([k] for k, _ in places), *([*x, *own] for _, x in places)]
            rows = [[2, 13, 7, 112], heads[0], [7], [99, 0, 0], heads[1], *inside]
        else:
            rows = [[2, 13], heads[0], [7, 99, 0, 0], heads[1], *([k, *x, *own] for k, x in places)]
        sections["Nodes"] = text(*rows)
        blocks = [([d, t] if new else [t, d], kind, cell) for d, t, kind, cell in cells]
        rows = [row for at, kind, cell in blocks for row in ([*at, kind, 1], [1, *cell])]
        sections["Elements"] = text([3, 3, 1, 3] if new else [3, 3], *rows)
    return "".join(f"${name}\n{content}$End{name}\n" for name, content in sections.items())


@pytest.mark.parametrize("version", ["4.1", "4.0", "2.2"])
@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("parametric", [False, True])
def test_gmsh_cells_are_read_once_with_all_their_groups(tmp_path, version, named, parametric):
    path = tmp_path / "BAR.MSH"
    path.write_text(msh(version, named, parametric, parametric and version != "2.2"))
    mesh = read_mesh(path, units="mm")
    np.testing.assert_allclose(mesh.vertices, BAR.vertices)
    np.testing.assert_array_equal(mesh.cells, BAR.cells)
    assert len(read_vertices(path, units="mm")) == len(BAR.vertices) + 1
    assert {name: cells.tolist() for name, cells in mesh.regions.items()} == (
        {"all": [0, 1], "tip": [1]} if named else {}
    )
    faces = read_surfaces(path, units="mm")
    assert {name: np.sort(nodes).tolist() for name, nodes in faces.items()} == (
        {"tip": [[0, 1, 2, 3]]} if named else {}
    )


@pytest.mark.parametrize("kind", ELEMENTS)
@pytest.mark.parametrize(
    ("version", "binary"), [("2.2", True), ("4.0", True), ("4.0", False), ("4.1", True)]
)
def test_gmsh_orders_of_nodes(tmp_path, kind, version, binary):
    mesh = bar(kind)
    content = meshio.Mesh(mesh.vertices, [(mesh.element.file_type, mesh.cells)])
    meshio.gmsh.write(tmp_path / "bar.msh", content, fmt_version=version, binary=binary)
    np.testing.assert_array_equal(read_mesh(tmp_path / "bar.msh").cells, mesh.cells)


def test_what_meshio_writes_by_default_is_the_format_of_fluent(tmp_path):
    meshio.write(tmp_path / "bar.msh", meshio.Mesh(BAR.vertices, {"hexahedron": BAR.cells}))
    assert (tmp_path / "bar.msh").read_bytes()[:1] == b"("
    np.testing.assert_array_equal(read_mesh(tmp_path / "bar.msh").cells, BAR.cells)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            "$NOD\n1\n1 0 0 0\n$ENDNOD\n",
            r"no \$MeshFormat; save the mesh by gmsh as version 4\.1 or 2\.2",
        ),
        ("$MeshFormat\n3 0 8\n$EndMeshFormat\n", "version 3 of gmsh's format is not read"),
        (
            msh("2.2", True, False, False).replace("1 3 2 7 5", "1 36 2 7 5"),
            "kind 36 are above order 2; set Mesh.Elem",
        ),
        (
            msh("4.1", True, False, False).replace("110 112", "110 113"),
            "node 113 of a cell is not in the file",
        ),
        (msh("4.1", True, False, False)[:-40], "the file is not whole"),
    ],
)
def test_gmsh_files_that_are_refused(tmp_path, content, message):
    (tmp_path / "bar.msh").write_text(content)
    refuses(MeshError, message, read_mesh, tmp_path / "bar.msh", units="mm")


NODES = "*Node, nset=all\n" + "".join(
    f"{k}, {x:g}, {y:g}, {z:g}\n" for k, (x, y, z) in enumerate(1e3 * BAR.vertices, 1)
)
FIRST, SECOND = ("{}, " + ", ".join(map(str, cell + 1)) + "\n" for cell in BAR.cells)
CELLS = "*Element, type=C3D8R\n" + FIRST.format(1) + SECOND.format(2)
PART = f"*Part, name=Beam\n{NODES}{CELLS}*Elset, elset=tip, generate\n 2, 2, 1\n*End Part\n"
INSTANCE = "*Instance, name=b-{}, part=BEAM\n{}*End Instance\n"
LONG = np.array([20.0, 10.0, 10.0])  # [mm]
DECKS = {  # text, largest coordinates [mm], regions, surfaces
    "hybrid, lower case": (NODES.lower() + CELLS.lower().replace("c3d8r", "c3d8rh"), LONG, {}, {}),
    "two blocks of nodes": (
        NODES.replace("7, 10", "*NODE\n7, 10") + CELLS + "*Node\n999, 40., 5., 5.\n",
        LONG,
        {},
        {},
    ),
    "keywords": (
        f'** c\n{NODES}*ELEMENT,\nTYPE = C3D8 , ELSET="My set"\n1, 1,5,7,3,\n 2,6,8,4\n** c\n*  '
        "Element, type=C3D8\n" + SECOND.format(2),
        *(LONG, {"My set": [0]}, {}),
    ),
    "sets by number, sets of sets": (
        NODES
        + CELLS.replace("1, 1", "70, 1").replace("2, 5", "9, 5")
        + "*Elset, elset=A, unsorted\n70,\n*Elset, elset=all\na, B\n*ELSET, ELSET=b, GENERATE\n "
        "1, 5\n 7, 11, 2\n*Elset, elset=_hid, internal\n9\n",
        *(LONG, {"A": [0], "all": [0, 1], "b": [1]}, {}),
    ),
    "one set in two blocks, shells and beams": (
        NODES
        + "*Element, type=B31, elset=rod\n50, 1, 5\n*Element, type=S4R, elset=skin\n60, 1, 2, 4, "
        "3\n*Element, type=C3D8, elset=all\n"
        + FIRST.format(1)
        + "*Element, type=C3D8, elset=all\n"
        + SECOND.format(2),
        *(LONG, {"all": [0, 1]}, {"skin": [0]}),
    ),
    "instance, moved": (
        PART + INSTANCE.format(1, "5., 0., 0.\n0., 0., 0., 0., 0., 1., 90.\n"),
        *([0.0, 25.0, 10.0], {"tip": [1]}, {}),
    ),
    "two instances": (
        PART.replace("*End", "*Surface, name=End\nTip, S4\n*End")
        + "*Assembly\n"
        + INSTANCE.format(1, "")
        + INSTANCE.format(2, "0., 30., 0.\n")
        + "*Node\n1, 0., 0., 99.\n*Elset, elset=ends, instance=b-2\n 1\n*Elset, "
        "elset=ends\nb-1.2\n*Elset, elset=TIP\nB-1.tip, b-2.TIP\n",
        [20.0, 40.0, 10.0],
        {
            "b-1": [0, 1],
            "b-1_tip": [1],
            "b-2": [2, 3],
            "b-2_tip": [3],
            "ends": [1, 2],
            "tip": [1, 3],
        },
        {"b-1_End": [0], "b-2_End": [0]},
    ),
    "independent instance, surface": (
        "*Part, name=p\n*End Part\n*Instance, name=i, part=p\n"
        + NODES
        + CELLS
        + "*End Instance\n*Elset, elset=_S3, internal, "
        "instance=i, generate\n1, 2, 1\n*Surface, type=ELEMENT, name=front\n_S3, S3\n",
        *(LONG, {}, {"front": [1]}),
    ),
}


@pytest.mark.parametrize("name", DECKS)
def test_abaqus_files(tmp_path, name):
    content, far, regions, surfaces = DECKS[name]
    path = tmp_path / "bar.inp"
    path.write_text(content)
    mesh = read_mesh(path, units="mm")
    np.testing.assert_allclose(cell_volumes(mesh), 1e-6, rtol=1e-9)
    np.testing.assert_allclose(1e3 * mesh.vertices.max(axis=0), far, atol=1e-9)
    assert {name: cells.tolist() for name, cells in mesh.regions.items()} == regions
    places = {
        name: 1e3 * mesh.vertices[faces].reshape(-1, 3)
        for name, faces in read_surfaces(path, units="mm").items()
    }
    assert {
        name: np.flatnonzero(np.ptp(at, axis=0) == 0).tolist() for name, at in places.items()
    } == surfaces


@pytest.mark.parametrize("kind", [kind for kind in ELEMENTS if kind != "hexahedron27"])
def test_abaqus_orders_of_nodes(tmp_path, kind):
    """In Abaqus, midside nodes follow the edges 1-2, 2-3,
    ... of the first face, of the opposite one, and between.
    """
    mesh = bar(kind)
    edges = {10: [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]}
    edges[20] = [(k + a, k + (a + 1) % 4) for k in (0, 4) for a in range(4)] + [
        (a, a + 4) for a in range(4)
    ]
    places = {tuple(place): k for k, place in enumerate(mesh.vertices.round(6))}
    corners = mesh.cells[:, : 4 if kind.startswith("tetra") else 8]
    middles = (
        mesh.vertices[corners][:, edges.get(mesh.element.nodes, np.empty((0, 2), dtype=int))]
        .mean(axis=2)
        .round(6)
    )
    cells = [
        [*cell, *(places[tuple(place)] for place in own)]
        for cell, own in zip(corners, middles, strict=True)
    ]
    nodes = "".join(
        f"{k}, {x!r}, {y!r}, {z!r}\n" for k, (x, y, z) in enumerate(mesh.vertices.tolist())
    )
    rows = "".join(f"{k}, {', '.join(map(str, cell))}\n" for k, cell in enumerate(cells, start=1))
    (tmp_path / "bar.inp").write_text(
        f"*NODE\n{nodes}*ELEMENT, TYPE=C3D{mesh.element.nodes}H\n{rows}"
    )
    np.testing.assert_array_equal(read_mesh(tmp_path / "bar.inp").cells, mesh.cells)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            f"{NODES}*Include, input=more.inp\n",
            r"line 14, \*INCLUDE: .* put the lines of more\.inp in its place",
        ),
        (
            f"{NODES}*Ngen\n1, 9, 1\n{CELLS}",
            r"line 14, \*NGEN: this keyword is not read; save the mesh with all nodes",
        ),
        (NODES.replace("nset=all", "system=C") + CELLS, r"line 1, \*NODE: only Cartesian"),
        (
            NODES + CELLS.replace("C3D8R", "SC8R"),
            r"\*ELEMENT: elements SC8R are not read; mesh the body with C3D4",
        ),
        (
            NODES + CELLS.replace("C3D8R", "C3D20R"),
            r"\*ELEMENT: each C3D20R must have a number and 20 nodes",
        ),
        (
            f"{NODES}*Element, type=C3D6\n1, 1, 5, 7, 2, 6, 8\n",
            "the file has wedge cells; .* with tetrahedra alone",
        ),
        (NODES + CELLS + SECOND.format(2), r"\*ELEMENT: element 2 is defined 2 times"),
        (NODES + CELLS + SECOND.format(3), "1 of 3 cells .* have the vertices of an earlier one"),
        (
            NODES + CELLS + FIRST.format(3).replace("4\n", "8\n"),
            "1 of 3 cells .* a vertex twice, such as wedges",
        ),
        (f"{NODES}{CELLS}*Elset, elset=a\nb\n", r"\*ELSET: there is no element set 'B'"),
        (f"{NODES}{CELLS}*Elset, elset=a\na\n", r"\*ELSET: the element set 'A' contains itself"),
        (
            f"{PART}*Instance, name=i, part=other\n",
            r"\*INSTANCE: the file has no \*PART of the name 'other'",
        ),
        (
            PART + INSTANCE.format(1, "") + INSTANCE.format(2, "20., 0., 0.\n"),
            "4 of 24 .* merge .* Abaqus: one part",
        ),
        ("nothing\n", "line 1 comes before the first keyword; is it a file of Abaqus"),
    ],
)
def test_abaqus_files_that_are_refused(tmp_path, content, message):
    (tmp_path / "bar.inp").write_text(content)
    refuses(MeshError, message, read_mesh, tmp_path / "bar.inp", units="mm")


@pytest.mark.parametrize("kind", ELEMENTS)
def test_cells_that_all_wind_the_other_way_are_turned_back(tmp_path, kind):
    mesh = bar(kind)
    meshio.write(
        tmp_path / "bar.vtu",
        meshio.Mesh(mesh.vertices * [1, -1, 1], [(mesh.element.file_type, mesh.cells)]),
    )
    with pytest.warns(
        ResphysWarning, match=f"all {len(mesh.cells)} cells have a negative volume, so the order"
    ):
        turned = read_mesh(tmp_path / "bar.vtu")
    assert cell_volumes(turned).sum() == pytest.approx(2e-6)
    half = np.concatenate([mesh.cells[:1], turned.cells[1:]])
    meshio.write(
        tmp_path / "half.vtu", meshio.Mesh(mesh.vertices, [(mesh.element.file_type, half)])
    )
    with pytest.raises(
        MeshError,
        match=f"{len(half) - 1} of {len(half)} cells .* inverted: their nodes wind the other",
    ):
        read_mesh(tmp_path / "half.vtu")


@pytest.mark.parametrize("extension", ["vtk", "vtu"])
def test_voxels_and_pixels_of_vtk(tmp_path, extension):
    voxels = pyvista.ImageData(dimensions=(6, 3, 3), spacing=(0.01, 0.01, 0.01))
    pixel = pyvista.ImageData(
        dimensions=(2, 2, 1), spacing=(0.01, 0.01, 0.01)
    ).cast_to_unstructured_grid()
    voxels.save(tmp_path / "grid.vti")
    voxels.cast_to_unstructured_grid().merge(pixel).save(tmp_path / f"scan.{extension}")
    for name in ("grid.vti", f"scan.{extension}"):
        np.testing.assert_allclose(
            cell_volumes(read_mesh(tmp_path / name)), np.full(20, 1e-6), rtol=1e-5
        )
    pyvista.UnstructuredGrid().save(tmp_path / f"empty.{extension}")
    with pytest.raises(
        MeshError, match=f"empty.{extension}: the file has no cells; save a mesh of the volume"
    ):
        read_mesh(tmp_path / f"empty.{extension}")


def in_two(mesh):
    half = len(mesh.cells) // 2
    return Mesh(
        mesh.vertices,
        mesh.cells,
        {"base": np.arange(half), "tip": np.arange(half, len(mesh.cells))},
    )


@pytest.mark.parametrize(
    "mesh", [box_hexahedra(divisions=(4, 1, 1)), box_tetrahedra(divisions=(4, 1, 1), order=2)]
)
def test_gmsh_files_keep_regions_beside_surfaces(tmp_path, mesh):
    mesh = in_two(mesh)
    write_mesh(tmp_path / "two.msh", mesh, {"end": boundary_faces(mesh)[:1]})
    again = read_mesh(tmp_path / "two.msh")
    assert list(again.regions) == ["base", "tip"]
    for name, cells in mesh.regions.items():
        np.testing.assert_array_equal(again.region(name), cells)
    assert list(read_surfaces(tmp_path / "two.msh")) == ["end"]


def test_regions_that_cannot_be_are_refused_and_cells_in_several_of_them_kept(tmp_path):
    mesh = box_hexahedra(divisions=(2, 1, 1))
    for cells in ([], [2], [True, False], [-1]):
        refuses(MeshError, "'tip'", Mesh, mesh.vertices, mesh.cells, {"tip": np.array(cells)})
    refuses(MeshError, "no region 'top'; it has base, tip", in_two(mesh).region, "top")
    mesh = box_hexahedra(divisions=(3, 1, 1))
    regions = {"a": np.array([1]), "b": np.array([0, 1]), "c": np.array([1])}
    write_mesh(tmp_path / "twice.msh", Mesh(mesh.vertices, mesh.cells, regions))
    again = read_mesh(tmp_path / "twice.msh")
    np.testing.assert_array_equal(again.cells, mesh.cells)
    assert {name: cells.tolist() for name, cells in again.regions.items()} == {
        "body": [2],
        **{name: cells.tolist() for name, cells in regions.items()},
    }
