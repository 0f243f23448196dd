import itertools
import re
import sys
from importlib import resources
from math import pi

import numpy as np
import pytest
from scipy.integrate import trapezoid

from support.refusals import refuses
from warp_resphys.core.mesh.arm import mesh_arm, section_of
from warp_resphys.core.mesh.arm_dimensions import ArmMesh
from warp_resphys.core.mesh.arm_section import SOLID
from warp_resphys.core.mesh.chambers import check_chambers, find_chambers, outer_surface
from warp_resphys.core.mesh.quality import cell_volumes, scaled_jacobian
from warp_resphys.core.mesh.readers import read_mesh, read_surfaces
from warp_resphys.core.mesh.section_grids import section_grids, section_quadrilaterals
from warp_resphys.core.mesh.volume_mesh import boundary_faces, check_mesh, face_triangles
from warp_resphys.io.errors import InputError, MeshError

SHIPPED = resources.files("warp_resphys") / "meshes"
SHAPES = [
    ("half_disc", "lobed", 3),
    ("half_disc", "round", 2),
    ("half_disc", "round", 5),
    ("disc", "lobed", 4),
    ("disc", "round", 3),
    ("sector", "round", 3),
    ("sector", "round", 6),
    ("wedge", "round", 4),
]


def volume(mesh, faces):
    """Of what a surface encloses.

    Negative where its faces are counter-clockwise seen from within.
    """
    return np.linalg.det(mesh.vertices[face_triangles(faces)]).sum() / 6.0


def sopra_chambers():
    """Volumes of its chambers: half discs of radii 14 to 9.5 mm and 9.5 to 6.5 mm, 120 mm long."""
    areas = [pi / 2.0 * r**2 for r in (0.014, 0.0095, 0.0065)]
    frusta = [0.120 / 3.0 * (a + b + np.sqrt(a * b)) for a, b in itertools.pairwise(areas)]
    return np.repeat(frusta, 3)


def sopra_silicone():
    """Volume of the solid: three lobes of 4 mm more than the half discs,
    that meet 30 degrees behind their centres.
    """
    sizes = np.array([[0.0283923, 0.014], [0.0212942, 0.0095], [0.0165622, 0.0065]])
    share = np.linspace(0.0, 1.0, 2001)
    total = sum(cap * lobes(*ends) for cap, ends in zip((0.010, 0.021, 0.005), sizes, strict=True))
    for low, high in itertools.pairwise(sizes):
        total += 0.120 * trapezoid([lobes(*(low + t * (high - low))) for t in share], share)
    return total - sum(sopra_chambers())


def lobes(radius, inner):
    """Area inside three circles of a radius of 4 mm more
    than the half discs', by polar integration.
    """
    outer = inner + 0.004
    angle = np.linspace(-pi / 3.0, pi / 3.0, 2001)
    d = radius - outer
    reach = d * np.cos(angle) + np.sqrt(outer**2 - (d * np.sin(angle)) ** 2)
    return 3.0 * trapezoid(0.5 * reach**2, angle)


def polygons(section, size):
    divisions = section.divisions(size)
    return section.chamber_polygon(divisions), section.body_polygon(divisions)


def area(polygon):
    """Area of polygons (..., N) of complex corners, counter-clockwise."""
    return 0.5 * (polygon.conj() * np.roll(polygon, -1, axis=-1)).imag.sum(-1)


@pytest.mark.parametrize(
    ("cells", "size"), [("hexahedra", 0.01), ("hexahedra", 0.002), ("tetrahedra", 0.03)]
)
def test_sopra_has_its_chambers_and_its_silicone_at_every_size(cells, size):
    if cells == "tetrahedra":
        pytest.importorskip("gmsh", reason="gmsh is not installed", exc_type=ImportError)
    mesh, surfaces = mesh_arm(ArmMesh(size=size, cells=cells))
    check_mesh(mesh)
    assert cells == "tetrahedra" or scaled_jacobian(mesh).min() > 0.45
    volumes = [-volume(mesh, surfaces[f"chamber_{i}"]) for i in range(1, 7)]
    np.testing.assert_allclose(volumes, sopra_chambers(), rtol=1e-5)
    assert cell_volumes(mesh).sum() == pytest.approx(sopra_silicone(), rel=2e-3)


@pytest.mark.parametrize(("profile", "outline", "count"), SHAPES)
def test_polygons_have_the_areas_of_the_curves_and_converge_to_them(profile, outline, count):
    arm = ArmMesh(chambers=count, profile=profile, outline=outline, wall=0.003, web=0.0025)
    section = section_of(arm, 0.025)
    fine = [area(polygon) for polygon in polygons(section, 1e-4)]
    for size, most in ((1.0, 0.16), (0.002, 0.012), (0.0005, 8e-4)):
        np.testing.assert_allclose(
            [area(polygon) for polygon in polygons(section, size)], fine, rtol=1e-12
        )
        assert all(0.0 < growth < most for growth in section.growth(section.divisions(size)))


@pytest.mark.parametrize(("profile", "outline", "count"), SHAPES)
def test_quadrilaterals_fill_the_solid_and_each_chamber_once(profile, outline, count):
    arm = ArmMesh(chambers=count, profile=profile, outline=outline, wall=0.003, web=0.0025)
    section = section_of(arm, 0.025)
    divisions = section.divisions(0.003)
    grids, chambers = section_grids(section, divisions)
    places, quads = section_quadrilaterals(grids)
    points = np.concatenate([grid.ravel() for grid in grids])[places]
    areas = [area(points[corners[:, [0, 1, 1, 0], [0, 0, 1, 1]]]) for corners in quads]
    assert min(own.min() for own in areas) > 0.0
    for chamber in range(section.count):
        own = sum(
            part.sum() for part, number in zip(areas, chambers, strict=True) if number == chamber
        )
        assert own == pytest.approx(area(section.chamber_polygon(divisions)), rel=1e-9)
    assert set(chambers) == {SOLID, *range(section.count)}
    assert sum(part.sum() for part in areas) == pytest.approx(
        area(section.body_polygon(divisions)), rel=1e-9
    )


@pytest.mark.parametrize(
    ("profile", "outline", "count", "size"),
    [*((*shape, 0.01) for shape in SHAPES), (*SHAPES[0], 0.0025)],
)
def test_walls_and_webs_are_as_thick_as_asked(profile, outline, count, size):
    shape = {
        "chambers": count,
        "profile": profile,
        "outline": outline,
        "wall": 0.003,
        "web": 0.0025,
    }
    along = {
        "chamber_lengths": (0.1,),
        "caps": (0.01, 0.01),
        "radii": (0.025, 0.025),
        "layers": 0.03,
    }
    mesh, surfaces = mesh_arm(ArmMesh(size=size, **shape, **along))
    check_mesh(mesh)
    assert scaled_jacobian(mesh).min() > (0.18 if profile == "disc" else 0.2)
    assert len(surfaces) == 3 + count
    first = np.unique(surfaces["chamber_1"])
    across = mesh.vertices[first, :2] @ [np.sin(pi / count), -np.cos(pi / count)]
    if profile != "disc":  # corners are kept
        # The middle of the web is at 0.
        assert across.min() == pytest.approx(0.5 * 0.0025, abs=1e-9)
    wall = mesh.vertices[:, 0].max() - mesh.vertices[first, 0].max()
    assert wall == pytest.approx(0.003, abs=1e-3 if size > 0.005 else 1e-4)


WALLS = ArmMesh(
    **{
        "chamber_lengths": (0.08,),
        "caps": (0.01, 0.01),
        "radii": (0.022, 0.022),
        "outline": "round",
        "chambers": 4,
    },
    **{
        "profile": "wedge",
        "wall": 0.002,
        "web": 0.002,
        "core": 0.009,
        "bore": 0.007,
        "layers": 0.03,
    },
)


@pytest.mark.parametrize("nodes", [8, 20, 27])
def test_a_bore_and_flat_inner_walls(nodes):
    """The silicone between a circle and a square hole,
    less four wedges between webs, with single quadratic cells.
    """
    mesh, surfaces = mesh_arm(WALLS.changed(nodes=nodes))
    check_mesh(mesh)
    half = pi / 4 - np.arcsin(0.001 / 0.020)
    corner = np.array([0.009, 0.009 - 0.001 * np.sqrt(2.0)])
    end = 0.020 * np.array([np.cos(half), np.sin(half)])
    wedge = (
        0.020**2 * half + (corner[0] * end[1] - corner[1] * end[0]) * -1.0 - corner[0] * corner[1]
    )
    solid = 0.1 * (pi * 0.022**2 - 4.0 * 0.007**2) - 4.0 * 0.08 * wedge
    if nodes == 27:  # the nodes lie on the curves
        assert cell_volumes(mesh).sum() == pytest.approx(solid, rel=2e-3)
    else:
        assert cell_volumes(mesh).sum() == pytest.approx(solid, rel=5e-3)
    outside = outer_surface(mesh)
    assert len(outside.faces) == len(surfaces["outside"]) // 2  # the other half bounds the bore
    radii = np.linalg.norm(mesh.vertices[np.unique(outside.faces), :2], axis=1)
    assert radii.min() == pytest.approx(0.022, rel=1e-9 if nodes > 8 else 0.06)
    assert [len(chamber.faces) for chamber in find_chambers(mesh)] == [
        len(surfaces["chamber_1"])
    ] * 4


@pytest.mark.parametrize("cells", ["hexahedra", "tetrahedra"])
def test_surfaces_are_named_as_the_contract_says(cells):
    if cells == "tetrahedra":
        pytest.importorskip("gmsh", reason="gmsh is not installed", exc_type=ImportError)
    mesh, surfaces = mesh_arm(ArmMesh(size=0.012, cells=cells))
    assert list(surfaces) == ["base", "tip", "outside", *(f"chamber_{i}" for i in range(1, 7))]
    named = np.concatenate(list(surfaces.values()))
    assert len(np.unique(np.sort(named, axis=1), axis=0)) == len(named) == len(boundary_faces(mesh))
    for number in range(6):
        corners = mesh.vertices[surfaces[f"chamber_{number + 1}"]]
        centre = corners.mean(axis=(0, 1))
        assert centre[2] == pytest.approx(-0.07 if number < 3 else -0.211, abs=2e-3)
        angle = np.angle(np.exp(1j * (np.arctan2(centre[1], centre[0]) - 2 * pi * number / 3)))
        assert abs(angle) < 0.02
    for chamber in find_chambers(mesh):
        np.testing.assert_array_equal(chamber.faces, surfaces[chamber.name])
    check_chambers(find_chambers(mesh), mesh)
    assert np.all(mesh.vertices[np.unique(surfaces["base"]), 2] == 0.0)
    assert np.all(np.diff(mesh.vertices[:, 2]) < 1e-12)  # numbered from the base down


def test_rotated_segments_take_tetrahedra():
    arm = ArmMesh(outline="round", rotations=(0.0, 60.0))
    refuses(MeshError, "set the arm's cells to tetrahedra", mesh_arm, arm)
    pytest.importorskip("gmsh", reason="gmsh is not installed", exc_type=ImportError)
    mesh, surfaces = mesh_arm(arm.changed(size=0.012, cells="tetrahedra"))
    centre = mesh.vertices[np.unique(surfaces["chamber_4"])].mean(axis=0)
    assert np.degrees(np.arctan2(centre[1], centre[0])) == pytest.approx(60.0, abs=2.0)


def test_without_gmsh_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "gmsh", None)
    refuses(
        MeshError,
        r"need gmsh, which cannot be imported .*pip install 'warp-resphys.mesh.'",
        mesh_arm,
        ArmMesh(cells="tetrahedra"),
    )
    mesh_arm(ArmMesh())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"chamber_lengths": ()},
            "chamber_lengths is (): it must be a list of one or more positive numbers, in m",
        ),
        ({"caps": (0.01, 0.01)}, "caps has 2 numbers, but 2 chamber_lengths need 3"),
        (
            {"radii": (0.028, -0.02, 0.016)},
            "radii is (0.028, -0.02, 0.016): it must be a list of one or more positive",
        ),
        ({"wall": float("nan")}, "wall is nan"),
        ({"chambers": 1}, "chambers is 1: it must be a whole number from 2 to 8"),
        ({"profile": "square"}, "profile is 'square'"),
        ({"profile": "sector"}, "outline is lobed, which does not go with sectors"),
        ({"wall": 0.02}, "3 chambers do not fit: make the wall"),
        ({"core": 0.002}, "a core of 2 mm leaves webs of"),
        ({"rotations": (10.0,)}, "rotations has 1 numbers, but 2 chamber_lengths need 2"),
        ({"chamber_lengths": 0.1}, "chamber_lengths is 0.1: it must be a list"),
        ({"wall": 0.0005, "web": 0.02}, "lobes of the outline do not meet"),
        ({"size": 0.0}, "size is 0.0"),
        ({"size": 1e-5}, "more than 2000000 cells"),
        ({"cells": "bricks"}, "cells is 'bricks'"),
        ({"layers": -1.0}, "layers is -1.0"),
        ({"layers": 0.1, "cells": "tetrahedra"}, "layers is for hexahedra"),
        ({"nodes": 20, "cells": "tetrahedra"}, "nodes and bore are for hexahedra"),
        ({"profile": "wedge"}, "outline is lobed, which does not go with wedges"),
        ({"bore": 0.005}, "bore is set, but profile is half_disc"),
        ({"profile": "wedge", "outline": "round", "bore": 0.02}, "a bore of 20 mm does not fit"),
        (
            {"profile": "wedge", "outline": "round", "core": 0.009, "bore": 0.0085},
            "a bore of 8.5 mm does not fit",
        ),
        ({"profile": "wedge", "outline": "round", "core": 0.02}, "3 chambers do not fit"),
        (
            {"profile": "wedge", "outline": "round", "chambers": 2},
            "chambers is 2, but wedges have flat sides",
        ),
    ],
)
def test_measures_that_make_no_arm(changes, message):
    refuses(InputError, re.escape(message), lambda: mesh_arm(ArmMesh(**changes)))


@pytest.mark.parametrize(("cells", "count"), [(500, 530), (1400, 1373), (2000, 1950)])
def test_shipped_arms(cells, count):
    with resources.as_file(SHIPPED / f"arm_hexahedra_{cells}.msh") as path:
        mesh = read_mesh(path)
    assert len(mesh.vertices) == count
    chambers = find_chambers(mesh)
    assert len(chambers) == 6
    check_chambers(chambers, mesh)
    np.testing.assert_allclose(
        [-volume(mesh, chamber.faces) for chamber in chambers], sopra_chambers(), rtol=1e-5
    )


@pytest.mark.slow
def test_shipped_arms_come_from_the_commands_beside_them(tmp_path):
    rows = re.findall(
        r"mesh\.size=(\S+) mesh\.layers=(\S+) save=(\S+)`", (SHIPPED / "README.md").read_text()
    )
    assert {name for _, _, name in rows} == {
        path.name for path in SHIPPED.iterdir() if path.name.endswith(".msh")
    }
    for size, layers, name in rows:
        mesh, surfaces = mesh_arm(ArmMesh(size=float(size), layers=float(layers)))
        with resources.as_file(SHIPPED / name) as path:
            shipped, named = read_mesh(path), read_surfaces(path)
            assert path.stat().st_size < 300_000
        np.testing.assert_allclose(shipped.vertices, mesh.vertices, atol=1e-12)
        np.testing.assert_array_equal(shipped.cells, mesh.cells)
        assert list(named) == list(surfaces)
        for key, faces in surfaces.items():
            np.testing.assert_array_equal(named[key], faces)
