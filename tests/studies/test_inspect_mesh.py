import re

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.image import imread

from support.command_line import sentence, settings_of
from support.refusals import refuses
from warp_resphys import Body, Corotated, Simulator, box_hexahedra, box_tetrahedra, read_mesh
from warp_resphys.core.mesh.arm import mesh_arm, name_surfaces
from warp_resphys.core.mesh.arm_dimensions import ArmMesh
from warp_resphys.core.mesh.chambers import open_cavities
from warp_resphys.core.mesh.quality import cell_volumes, scaled_jacobian
from warp_resphys.core.mesh.volume_mesh import Mesh, boundary_faces, quadratic
from warp_resphys.io.errors import InputError, MeshError, ResphysWarning
from warp_resphys.mesh import read_surfaces, write_mesh
from warp_resphys.studies.inspection import Inspection, inspect, inspect_mesh


def inspected(*overrides):
    """The table of a mesh, by the name of the row."""
    settings = settings_of(Inspection, "inspect", *overrides, "picture=false")
    return rows_of(inspect_mesh(settings.mesh, settings.fixed, settings.density, None, None))


def rows_of(text):
    return dict(re.split(r"  +", line, maxsplit=1) for line in text.splitlines())


def without(mesh, dropped):
    """The mesh less some cells, and less the vertices that are then unused."""
    cells = mesh.cells[~dropped]
    used, numbered = np.unique(cells, return_inverse=True)
    return Mesh(mesh.vertices[used], numbered.reshape(cells.shape))


@pytest.fixture(scope="module")
def arm():
    return mesh_arm(ArmMesh())


def test_ideal_cells_are_worth_one_and_a_sheared_brick_the_sine_of_its_angle():
    assert scaled_jacobian(box_hexahedra((3.0, 1.0, 1.0), (1, 1, 1))) == pytest.approx(1.0)
    regular = Mesh(
        np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]), np.array([[0, 2, 1, 3]])
    )
    np.testing.assert_allclose(np.abs(scaled_jacobian(regular)), 1.0)
    np.testing.assert_allclose(scaled_jacobian(quadratic(regular)), scaled_jacobian(regular))
    box = box_hexahedra((1.0, 1.0, 1.0), (1, 1, 1))
    sheared = Mesh(box.vertices + box.vertices[:, 1:2] * [[1.0 / np.tan(0.5), 0.0, 0.0]], box.cells)
    assert scaled_jacobian(sheared) == pytest.approx(np.sin(0.5))
    inverted = Mesh(box.vertices * [1.0, 1.0, -1.0], box.cells)
    assert scaled_jacobian(inverted) == pytest.approx(-1.0)


class TestQuadraticCells:
    @pytest.mark.parametrize(
        ("mesh", "percent"),
        [
            (box_tetrahedra((0.1, 0.03, 0.03), (8, 2, 2)), 71),
            (box_hexahedra((0.1, 0.03, 0.03), (20, 1, 1)), -34),
            (box_hexahedra((0.1, 0.03, 0.03), (12, 4, 4)), 4),
        ],
    )
    def test_they_are_compared_by_the_sag(self, tmp_path, mesh, percent):
        """As two simulations of silicone differ, in the direction that differs most."""
        write_mesh(tmp_path / "beam.msh", mesh)
        row = inspected(f"mesh.path={tmp_path}/beam.msh", "fixed.x=0")["quadratic cells"]
        assert row.startswith(
            f"sag {abs(percent)} % {'more' if percent > 0 else 'less'} under their weight"
        )
        assert "held at x = 0 m" in row
        assert row.endswith("too coarse") == (abs(percent) > 7)
        sags = []
        for own in (mesh, quadratic(mesh)):
            body = Body(own, fixed=np.flatnonzero(own.vertices[:, 0] == 0.0))
            simulator = Simulator(body, Corotated(5e7, 0.49), relative_tolerance=1e-6)
            mass = simulator.prepare().load_mass[0]
            pulls = torch.tensor([[0.0, -9.81, 0.0], [0.0, 0.0, -9.81]])
            falls = (
                simulator.static_equilibrium(parameters={"gravity": pulls}).q
                - simulator.rest_positions
            )
            sags.append((mass @ falls)[[0, 1], [1, 2]])
        change = max((sags[1] / sags[0] - 1.0).tolist(), key=abs)
        assert 100.0 * change == pytest.approx(percent, abs=1.0)

    def test_a_thin_region_is_named(self, tmp_path):
        box = box_hexahedra((0.1, 0.03, 0.03), (6, 3, 3))
        layer = box.vertices[box.cells].mean(axis=1)[:, 2] < 0.01
        regions = {
            "layer": np.flatnonzero(layer),
            "soft": np.flatnonzero(~layer),
            "whole": np.arange(len(box.cells)),
        }
        write_mesh(tmp_path / "beam.msh", Mesh(box.vertices, box.cells, regions))
        rows = inspected(f"mesh.path={tmp_path}/beam.msh")
        assert rows["one cell thick"].startswith("layer: ")
        assert "held at the lower end along x" in rows["quadratic cells"]
        write_mesh(tmp_path / "beam.msh", quadratic(Mesh(box.vertices, box.cells, regions)))
        assert (
            not {"one cell thick", "quadratic cells"}
            & inspected(f"mesh.path={tmp_path}/beam.msh").keys()
        )


def test_closed_chambers_are_none_without_its_last_cap(arm):
    assert open_cavities(arm[0]) == []
    assert open_cavities(box_tetrahedra()) == []
    mesh, _ = arm
    cavities = open_cavities(without(mesh, mesh.vertices[mesh.cells].mean(axis=1)[:, 2] < -0.271))
    assert len(cavities) == 3
    around = sorted(
        np.degrees(np.arctan2(cavity.centre[1], cavity.centre[0])) for cavity in cavities
    )
    assert around == pytest.approx([-120.0, 0.0, 120.0], abs=1.0)
    assert all(3e-3 < cavity.area < 6e-3 for cavity in cavities)


class TestNamedSurfaces:
    def test_a_surface_within_the_body_is_left_out_or_refused(self, tmp_path, arm):
        mesh, surfaces = arm
        inside = mesh.cells[:1, [0, 1, 2, 3]]
        assert not np.any(np.all(np.sort(boundary_faces(mesh), axis=1) == np.sort(inside), axis=1))
        write_mesh(tmp_path / "arm.msh", mesh, {**surfaces, "middle": inside})
        with pytest.warns(
            ResphysWarning,
            match=r"arm\.msh: the surface 'middle' is left out, as no face of it is on",
        ):
            assert set(read_surfaces(tmp_path / "arm.msh")) == set(surfaces)
        partly = np.concatenate([inside, boundary_faces(mesh)[:1]])
        write_mesh(tmp_path / "arm.msh", mesh, {"middle": partly})
        with pytest.raises(
            MeshError, match=r"arm\.msh: 1 of 2 faces of the surface 'middle' are not on the body's"
        ):
            read_surfaces(tmp_path / "arm.msh")

    @pytest.mark.parametrize("kind", ["tetrahedron10", "tetrahedron"])
    def test_tetrahedra_keep_midpoints(self, tmp_path, kind):
        mesh = box_tetrahedra(order=2 if kind == "tetrahedron10" else 1)
        surfaces = {"all": boundary_faces(mesh)}
        write_mesh(tmp_path / "box.msh", mesh, surfaces)
        assert read_mesh(tmp_path / "box.msh").kind == kind
        np.testing.assert_array_equal(read_surfaces(tmp_path / "box.msh")["all"], surfaces["all"])

    def test_unknown_extension(self, tmp_path, arm):
        refuses(
            MeshError,
            r"meshio does not know the extension '\.arm'",
            write_mesh,
            tmp_path / "mesh.arm",
            arm[0],
        )
        refuses(
            MeshError,
            r"mesh\.stl: meshio cannot write such a file",
            write_mesh,
            tmp_path / "mesh.stl",
            arm[0],
        )
        assert not list(tmp_path.iterdir())


def test_published_arm(shared_data):
    path = shared_data / "sopra_mesh" / "sopra_494.vtk"
    rows = inspected(f"mesh.path={path}", "fixed.z=0")
    assert rows["vertices in the file"] == "494 = 1,482 degrees of freedom"
    assert rows["of these unused"].startswith("30 belong to no cell")
    assert rows["vertices"] == "464 = 1,392 degrees of freedom"
    assert [rows[f"chamber_{i}"].split(",")[0] for i in range(1, 7)] == ["70 faces"] * 6
    assert rows["chamber_1"] == "70 faces, 22.15 cm3, centre (14.1, -0.0, -70.2) mm"
    assert rows["fixed"] == "36 vertices at z = 0 m, 21 of them used"
    assert rows["pieces"] == "1 of the body, 7 of its boundary"
    assert rows["open cavities"] == "none"
    refuses(MeshError, "read with units=mm", inspected, f"mesh.path={path}", "mesh.units=mm")


def test_a_body_in_two_pieces_with_an_open_chamber(tmp_path, arm):
    mesh = without(arm[0], arm[0].vertices[arm[0].cells].mean(axis=1)[:, 2] < -0.271)
    apart = Mesh(
        np.concatenate([mesh.vertices, mesh.vertices + [0.1, 0.0, 0.0]]),
        np.concatenate([mesh.cells, mesh.cells + len(mesh.vertices)]),
    )
    write_mesh(tmp_path / "two.vtu", apart)
    rows = inspected(f"mesh.path={tmp_path}/two.vtu")
    assert rows["pieces"].startswith("2 of the body, 8 of its boundary")
    assert rows["open cavities"].count("cm2 around") == 6
    assert "pressure needs a closed chamber" in rows["open cavities"]
    assert rows["quadratic cells"].startswith("sag 25 % more")
    rows_of_one_end = inspected(f"mesh.path={tmp_path}/two.vtu", "fixed.x=[0.08,0.2]")
    assert rows_of_one_end["quadratic cells"] == "not compared: a piece is not held, or all of it"
    assert "of these unused" not in rows
    assert "fixed" not in rows


def test_an_arm_is_written_as_it_is_described(tmp_path, capsys, used_again):
    with used_again():
        inspect(
            settings_of(
                Inspection, "inspect", "mesh=arm_generated", "mesh.layers=0.03", "save=own.msh"
            ),
            tmp_path,
        )
    rows = rows_of(capsys.readouterr().out.partition("Written: ")[0])
    mesh = read_mesh(tmp_path / "own.msh")
    assert (
        rows["vertices"] == f"{len(mesh.vertices)} = {3 * len(mesh.vertices):,} degrees of freedom"
    )
    assert set(read_surfaces(tmp_path / "own.msh")) == set(name_surfaces(mesh))
    assert rows["mass"].startswith(f"{1070e3 * cell_volumes(mesh).sum():.1f} g")
    picture = imread(tmp_path / "mesh.png")[..., :3]
    colours = {"chamber 1": (0.90, 0.62, 0.0), "chamber 4": (0.84, 0.37, 0.0)}
    views = picture[: int(0.85 * len(picture))]  # without the legend
    for colour in colours.values():
        hue = np.abs(
            views / views.max(axis=2, keepdims=True).clip(0.1) - np.array(colour) / max(colour)
        ).max(axis=2)
        assert (hue < 0.05).sum() > 2000


@pytest.mark.parametrize(
    ("overrides", "error", "message"),
    [
        (["mesh.order=2"], MeshError, r"mesh\.order is 2: choose 1, or 2 for tetrahedra"),
        (["density=-1"], InputError, "density is -1"),
        (["mesh.radii=0.02"], InputError, r"mesh\.radii"),
    ],
)
def test_wrong_settings(tmp_path, overrides, error, message):
    with pytest.raises(error, match=message):
        inspect(
            settings_of(Inspection, "inspect", "mesh=arm_generated", "save=arm.msh", *overrides),
            tmp_path,
        )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["mesh=arm_generated", "mesh.wall=0.02"],
            "error: where the arm's radius is 21.29 mm, 3 chambers do not fit",
        ),
        (["nowhere.vtk"], "error: nowhere.vtk: there is no such mesh file"),
        ([], "error: nothing to inspect: name a mesh or a recording"),
    ],
)
def test_commands_end_with_one_sentence(folder, arguments, message):
    assert sentence("inspect", *arguments).startswith(message)


def test_a_file_of_a_surface_is_filled(tmp_path):
    """An STL is inspected by its name alone, in mm, as by mesh=surface.

    The size of its cells may be given.
    """
    gmsh = pytest.importorskip("gmsh")
    assert gmsh
    trimesh.creation.box((40.0, 20.0, 10.0)).export(tmp_path / "box.stl")
    settings = settings_of(
        Inspection, "inspect", f"files=[{tmp_path / 'box.stl'}]", "mesh.size=0.01"
    )
    assert (settings.mesh.kind, settings.mesh.units, settings.mesh.size) == ("surface", "mm", 0.01)
    rows = inspected(f"files=[{tmp_path / 'box.stl'}]", "mesh.size=0.01")
    assert rows["cells"].endswith("tetrahedron10")
    assert rows["volume"] == "8.0 cm3"
