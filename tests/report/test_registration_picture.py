import matplotlib.colors
import numpy as np
import pytest
from matplotlib.image import imread

from warp_resphys.data.registration import register_markers
from warp_resphys.mesh.mesh import box_hexahedra, select_vertices
from warp_resphys.report.body_picture import NOMINAL, draw_registration
from warp_resphys.report.data import Recordings
from warp_resphys.report.render import INK, MEASURED

MESH = box_hexahedra(divisions=(3, 2, 2))
NAMES = ["Tip - 1", "Tip - 2", "Tip - 3", "Base - 1", "Base - 2", "a marker with a rather long name"]
POINTS = np.array([[0.1, 0.01, 0.04], [0.1, -0.01, 0.02], [0.1, 0.04, 0], [0, -0.01, 0], [0, 0.04, 0.03], [0, 0.04, 0]])


def drawn(measured, path, **options):
    registered = register_markers(measured, POINTS, NAMES, source="swing.c3d", **options)
    places = [None if np.isnan(place).any() else place.tolist() for place in registered.positions]
    fit = {"positions": places, "residual_mm": 1e3 * registered.residual}
    fit = {key: dict(zip(registered.names, values, strict=True)) for key, values in fit.items()}
    fits = {"Beam": {**fit, "rms_mm": 0.0, "outliers": registered.outliers}}
    nominal = dict(zip(NAMES, POINTS, strict=True))
    draw_registration(path, Recordings({}, fits, nominal, (), MESH), select_vertices(MESH, x=0.0))
    return imread(path)[..., :3]


def pixels(picture, colour):
    return int((np.abs(picture - matplotlib.colors.to_rgb(colour)).max(axis=2) < 0.15).sum())


@pytest.mark.slow
@pytest.mark.usefixtures("can_draw")
def test_an_outlier_is_named_and_connected_and_a_marker_that_was_not_seen_is_left_out(tmp_path):
    fits = drawn(POINTS, tmp_path / "fits.png")
    measured = POINTS.copy()
    measured[1] += [0.02, 0.0, 0.03]
    off = drawn(measured, tmp_path / "off.png", largest_residual=0.002)
    measured[4] = np.nan
    unseen = drawn(measured, tmp_path / "unseen.png", largest_residual=0.002)
    ringed, connected = pixels(fits, NOMINAL), pixels(off, NOMINAL)
    assert ringed > 1000
    assert connected > ringed + 300
    assert pixels(off, INK) > pixels(fits, INK) + 300  # its name
    assert pixels(unseen, NOMINAL) > 1000
    assert pixels(unseen, MEASURED) < 0.95 * pixels(off, MEASURED)
