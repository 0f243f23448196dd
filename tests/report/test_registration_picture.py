import matplotlib.colors
import numpy as np
import pytest
from matplotlib.image import imread

from warp_resphys.data.registration import register_markers
from warp_resphys.mesh.mesh import box_hexahedra, select_vertices
from warp_resphys.report import registration_picture
from warp_resphys.report.data import Recordings
from warp_resphys.report.registration_picture import (
    draw_registration,
    panels_of,
    registration_layers,
    round_length,
    spread,
)
from warp_resphys.report.render import MEASURED, draw

MESH = box_hexahedra(divisions=(3, 2, 2))
NAMES = ["Tip - 1", "Tip - 2", "Tip - 3", "Base - 1", "Base - 2", "a marker with a rather long name"]
POINTS = np.array([[0.1, 0.01, 0.04], [0.1, -0.01, 0.02], [0.1, 0.04, 0], [0, -0.01, 0], [0, 0.04, 0.03], [0, 0.04, 0]])


@pytest.mark.usefixtures("can_draw")
def test_markers_are_drawn_where_labels_and_rings_are_put():
    """Off the body and alone, a marker's pixels lie around its projection, in both views."""
    marker = np.array([[0.13, -0.02, 0.06]])
    panels = panels_of(np.concatenate([MESH.vertices, marker]))
    layers = registration_layers(MESH, np.empty(0, dtype=np.int64), marker, marker, 0.003)
    ball = matplotlib.colors.rgb_to_hsv(matplotlib.colors.to_rgb(MEASURED))
    for panel, (pixels,) in zip(panels, draw(*(panel.scene(layers) for panel in panels)), strict=True):
        height, width = pixels.shape[:2]
        low, high = panel.corners
        assert width / height == pytest.approx((high - low)[0] / (high - low)[1], rel=1e-3)  # Pixels are whole.
        colours = matplotlib.colors.rgb_to_hsv(pixels / 255.0)
        rows, columns = np.nonzero((np.abs(colours[..., 0] - ball[0]) < 0.03) & (colours[..., 1] > 0.6))
        expected = (panel.project(marker[0]) - low) / (high - low) * [width, height]
        drawn = np.array([columns.mean() + 0.5, height - rows.mean() - 0.5])
        np.testing.assert_allclose(drawn, expected, rtol=0, atol=2.0)
        assert np.ptp(columns) == pytest.approx(2 * 0.003 * width / (high - low)[0], rel=0.25)


@pytest.mark.usefixtures("can_draw")
def test_picture_with_an_outlier_and_a_marker_that_was_not_seen(tmp_path):
    measured = POINTS.copy()
    measured[1] += [0.02, 0.0, 0.03]
    measured[4] = np.nan
    registered = register_markers(measured, POINTS, NAMES, source="swing.c3d", largest_residual=0.002)
    fixed = select_vertices(MESH, x=0.0)
    drawn = (registered.names, registered.positions, 1e3 * registered.residual, registered.outliers)
    draw_registration(tmp_path / "beam.png", Recordings({}, {}, "Beam", *drawn, POINTS, POINTS, MESH), fixed)
    picture = imread(tmp_path / "beam.png")[..., :3]
    blue = np.all(np.abs(picture - matplotlib.colors.to_rgb(registration_picture.NOMINAL)) < 0.05, -1)
    assert blue.sum() > 1000
    rim = np.concatenate([picture[:3].ravel(), picture[-3:].ravel(), picture[:, :3].ravel(), picture[:, -3:].ravel()])
    assert rim.min() == 1.0  # Nothing is cut off.


def test_labels_are_moved_apart_as_little_as_it_takes():
    np.testing.assert_allclose(spread(np.array([0.0, 3.0, 9.0]), 2.0), [0.0, 3.0, 9.0])
    np.testing.assert_allclose(spread(np.array([1.0, 1.0, 1.0]), 2.0), [-1.0, 1.0, 3.0])
    np.testing.assert_allclose(spread(np.array([0.0, 0.5, 9.0]), 1.0), [-0.25, 0.75, 9.0])
    assert spread(np.array([]), 1.0).shape == (0,)


@pytest.mark.parametrize(("longest", "length"), [(0.0299, 0.02), (0.05, 0.05), (0.0019, 0.001), (1.2, 1.0)])
def test_scale(longest, length):
    assert round_length(longest) == pytest.approx(length)
