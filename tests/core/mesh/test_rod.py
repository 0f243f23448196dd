"""Round rods."""

import numpy as np
import pytest

from warp_resphys import MeshError, box_hexahedra, box_tetrahedra, rod
from warp_resphys.core.mesh.quality import cell_volumes
from warp_resphys.core.mesh.surface import locate
from warp_resphys.core.mesh.volume_mesh import check_mesh

AXIS = [[0.0, 0.0, 0.0], [0.0, 0.0, -0.3]]
TAPER = [[0.0, 0.02], [0.3, 0.01]]
FRUSTUM = np.pi * 0.3 / 3 * (0.02**2 + 0.02 * 0.01 + 0.01**2)


@pytest.mark.parametrize(
    ("nodes", "core", "rings", "larger", "error"),
    [(8, 3, 3, 1.023, 1e-9), (20, 1, 1, 1.006, 1e-3), (27, 2, 2, 1.0004, 1e-9)],
)
def test_its_volume_is_that_of_a_cone(nodes, core, rings, larger, error):
    mesh = rod(AXIS, TAPER, 12, core, rings, nodes)
    check_mesh(mesh)
    assert mesh.cells.shape == (12 * (core**2 + 4 * core * rings), nodes)
    assert cell_volumes(mesh).sum() == pytest.approx(FRUSTUM, rel=error)
    outer = np.linalg.norm(mesh.vertices[:, :2], axis=1)
    for z, radius in ((0.0, 0.02), (-0.3, 0.01)):
        assert outer[mesh.vertices[:, 2] == z].max() == pytest.approx(radius * larger, rel=5e-3)


def test_along_a_curve_it_keeps_its_radius_and_does_not_twist_and_may_be_an_ellipse():
    angle = np.linspace(0.0, np.pi / 2, 200)
    quarter = np.column_stack([0.2 * np.sin(angle), 0.0 * angle, 0.2 * np.cos(angle)])
    mesh = rod(quarter, 0.01, 20)
    distance = np.hypot(
        np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 2]) - 0.2, mesh.vertices[:, 1]
    )
    assert distance.max() == pytest.approx(0.01, rel=0.01)
    assert cell_volumes(mesh).sum() == pytest.approx(np.pi * 0.01**2 * 0.2 * np.pi / 2, rel=0.002)
    x, y, z = mesh.vertices.T
    first, last = np.sort(y[np.abs(x) < 1e-9]), np.sort(y[np.abs(z) < 1e-9])
    # a section that does not turn about the axis
    np.testing.assert_allclose(first, last, atol=1e-4)
    # Of which the first semi-axis is along the coordinate axis that the rod crosses most squarely,
    # y here.
    profile = np.array([[0.0, 0.02, 0.005], [0.201, 0.01, 0.005]])
    mesh = rod([[0.0, 0.0, 0.0], [0.02, 0.0, -0.2]], profile, 8, nodes=27)
    assert cell_volumes(mesh).sum() == pytest.approx(np.pi * 0.015 * 0.005 * 0.201, rel=3e-3)
    first = mesh.vertices[mesh.vertices[:, 2] > -1e-3]
    last = mesh.vertices[mesh.vertices[:, 2] < -0.199]
    assert (np.ptp(first[:, 1]), np.ptp(last[:, 1])) == (
        pytest.approx(0.04, rel=0.01),
        pytest.approx(0.02, rel=0.01),
    )
    assert (np.ptp(first[:, 0]), np.ptp(last[:, 0])) == (
        pytest.approx(0.01, rel=0.02),
        pytest.approx(0.01, rel=0.02),
    )


@pytest.mark.parametrize("noise", [0.0, 6e-17, -6e-17])
def test_an_ellipse_does_not_turn_on_a_rounding_error(noise):
    mesh = rod([[0.0, 0.0, 0.0], [noise, 2.0 * noise, -0.2]], [[0.0, 0.02, 0.005]], 4)
    # x comes first where x and y are alike
    assert np.ptp(mesh.vertices[:, 0]) == pytest.approx(0.04, rel=0.01)
    assert np.ptp(mesh.vertices[:, 1]) == pytest.approx(0.01, rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (([[0, 0, 0]], 0.1, 4), "needs two or more finite points"),
        (([[0, 0, 0], [0, 0, 0], [0, 0, 1]], 0.1, 4), "two points in a row at one place"),
        ((AXIS, -0.1, 4), "must be one positive number"),
        ((AXIS, [[0.3, 0.1], [0.0, 0.1]], 4), "rising arc lengths"),
        ((AXIS, 0.1, 0), "layers of a rod is 0"),
        ((AXIS, 0.1, 4, 1, 1, 10), "a rod of cells with 10 nodes"),
        ((AXIS, 0.1, 4, 1, 1, 27, 2.0), "grading of a rod is 2"),
        (([[0, 0, 0], [0, 0, 1], [0, 0.5, 0.1]], 0.4, 12), "bent more sharply than it is thick"),
    ],
)
def test_what_is_no_rod_is_refused(arguments, said):
    with pytest.raises(MeshError, match=said):
        rod(*arguments)


@pytest.mark.parametrize(
    "mesh",
    [
        box_hexahedra((0.1, 0.03, 0.02), (5, 2, 1)),
        box_tetrahedra((0.1, 0.03, 0.02), (5, 2, 1), order=2),
        rod([[0.0, 0.015, 0.01], [0.1, 0.015, 0.01]], 0.012, 8),
    ],
)
def test_points_are_found_in_their_cells(mesh):
    random = np.random.default_rng(0)
    inside = random.uniform([0.0, 0.01, 0.005], [0.1, 0.02, 0.015], (30, 3))
    places = locate(mesh, inside)
    np.testing.assert_allclose(
        np.einsum("pk,pki->pi", places.weights, mesh.vertices[mesh.cells[places.cells]]),
        inside,
        atol=1e-12,
    )
    np.testing.assert_allclose(places.weights.sum(1), 1.0, atol=1e-12)
    assert places.outside.max() == 0.0
    beside = locate(mesh, inside + [0.0, 0.02, 0.0])
    assert beside.outside[inside[:, 1] > 0.015].min() > 1e-3
