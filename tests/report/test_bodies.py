"""Pictures and films of motions: bodies, dots, rings and trails where they are,
and films as long as the motion.
"""

from dataclasses import replace

import matplotlib.colors
import numpy as np
import pytest
from matplotlib.image import imread

from support.made_up_run import TRACKED, arm_settings, sag
from warp_resphys import box_hexahedra, select_vertices
from warp_resphys.core.mesh.chambers import find_chambers
from warp_resphys.data.registration import register_markers
from warp_resphys.experiment.build import shipped_arm
from warp_resphys.report import body_picture, render
from warp_resphys.report.body_motions import ComparedMotion, DrivenBodies
from warp_resphys.report.body_picture import (
    NOMINAL,
    MeshSummary,
    mesh_picture,
    registration_picture,
)
from warp_resphys.report.data import Recordings
from warp_resphys.report.layers import INK, MEASURED
from warp_resphys.report.wording import TONES

DOWN = np.array([0.0, 0.0, -9.8])


def motion(frames=3, model="simulation"):
    mesh = box_hexahedra(divisions=(3, 1, 1))
    bound = np.array(list(TRACKED.values()))
    times = np.arange(1, frames + 1) * 0.02
    positions = {name: sag(mesh.vertices, times, 0.05, name) for name in (model, "resphys")}
    markers = {name: sag(bound, times, 0.05, name) for name in positions}
    return ComparedMotion(mesh, times, sag(bound, times, 0.05), positions, markers, bound, DOWN)


def halves(scene, renderer):
    """(F, 2, H, W, 4) of each frame the two views."""
    return np.stack(np.split(render.draw(scene, renderer).astype(int), 2, axis=2), axis=1)


@pytest.mark.usefixtures("can_draw")
def test_instants_show_bodies_dots_and_rings(renderer):
    shown = motion(2)
    shown.positions["resphys"][1] *= 1e200
    shown.markers["resphys"][1] = np.nan
    pixels = halves(shown.scene(), renderer)
    assert pixels.shape[:2] == (2, 2)
    solid = pixels[..., 3] > 200
    blue = solid & (pixels[..., 2] > pixels[..., 0] + 40)
    dots = solid & (pixels[..., 0] > pixels[..., 2] + 150)
    assert blue[0].sum(axis=(1, 2)).min() > 20_000
    assert blue[1].sum() == 0  # It has diverged.
    assert dots.sum(axis=(2, 3)).min() > 300
    rows, columns = np.nonzero(dots[0, 1])  # From nearby, the markers' middle is that of the view.
    assert abs(rows.mean() / dots.shape[2] - 0.5) < 0.05
    assert abs(columns.mean() / dots.shape[3] - 0.5) < 0.05


@pytest.mark.usefixtures("can_draw")
def test_one_marker_alone_is_seen_from_a_distance_that_shows_its_body(renderer):
    several = motion(2)
    markers = {model: each[:, :1] for model, each in several.markers.items()}
    alone = replace(
        several, measured=several.measured[:, :1], markers=markers, bound=several.bound[:1]
    )
    _, near = alone.scene().views
    assert near.half_height >= 0.03 * 0.1
    assert (halves(alone.scene(), renderer)[0, 0, ..., 3] > 200).mean() > 0.3


def test_second_view_is_from_below():
    """Where the end of an arm is about round, and as small as it is."""
    arm = shipped_arm("arm_hexahedra_500")
    bound = np.array(list(arm_settings().markers.tracked.values()))
    body, markers = np.stack([arm.vertices] * 2), np.stack([bound] * 2)
    models = {"resphys": body}, {"resphys": markers}
    side, below = (
        ComparedMotion(arm, np.arange(2.0), markers, *models, bound, DOWN, from_below=True)
        .scene()
        .views
    )
    assert side.axes[1, 2] > 0.9
    np.testing.assert_allclose(below.axes[2], DOWN / 9.8, atol=1e-12)
    width = np.ptp((arm.vertices @ below.axes.T)[:, :2], axis=0)
    assert 0.5 * width.max() < below.half_height < 0.7 * width.max() < 0.4 * side.half_height


@pytest.mark.slow
@pytest.mark.usefixtures("can_draw")
def test_picture_of_an_arm_has_markers_where_it_is_whole(tmp_path):
    arm = shipped_arm("arm_hexahedra_500")
    body = MeshSummary(arm, np.flatnonzero(arm.vertices[:, 2] == 0.0), find_chambers(arm))
    near = [
        np.flatnonzero(np.abs(arm.vertices[:, 2] - z) < 0.01) for z in (-0.05, -0.1, -0.15, -0.2)
    ]
    nearest = [some[(arm.vertices[some] @ body_picture.TOWARDS_VIEWER).argmax()] for some in near]
    places = arm.vertices[nearest]
    # On a stem below the tip.
    below = np.append(places, [[0.0, 0.0, arm.vertices[:, 2].min() - 0.05]], axis=0)
    for name, markers in (("plain", None), ("dots", places), ("below", below)):
        picture = mesh_picture(body, markers)
        picture.save(tmp_path / f"{name}.png", picture.draw())
    plain, dots, longer = (
        imread(tmp_path / f"{name}.png")[..., :3] for name in ("plain", "dots", "below")
    )
    changed = np.abs(plain - dots).max(axis=2) > 0.2
    left, middle, right = (part.sum() for part in np.array_split(changed, 3, axis=1))
    assert middle == 0
    assert min(left, right) > 500
    inked = [
        int((picture[: int(0.9 * len(picture))].min(axis=2) < 0.95).sum())
        for picture in (longer, plain)
    ]
    # The picture reaches as far, so that the body is smaller in it.
    assert inked[0] < 0.9 * inked[1]


@pytest.mark.usefixtures("can_draw")
def test_film_moves_and_is_slower_than_the_motion(tmp_path, capsys, renderer):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    shown = motion(4)
    shown.measured[2, 1] = np.nan
    render.write_film(tmp_path / "motion.mp4", shown.film(), renderer)
    assert "4/4 frames" in capsys.readouterr().err
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "motion.mp4"))
    about = next(reader)
    width, height = about["size"]
    assert about["fps"] == pytest.approx(12.5)  # 50 Hz, four times slower.
    frames = [
        np.frombuffer(frame, np.uint8).reshape(height, width, 3).astype(int) for frame in reader
    ]
    assert len(frames) == 4
    assert np.abs(frames[1] - frames[0]).mean() > 1.0
    assert (tmp_path / "motion.mp4").stat().st_size < 200_000


MESH = box_hexahedra(divisions=(3, 2, 2))
NAMES = [
    "Tip - 1",
    "Tip - 2",
    "Tip - 3",
    "Base - 1",
    "Base - 2",
    "a marker with a rather long name",
]
POINTS = np.array(
    [
        [0.1, 0.01, 0.04],
        [0.1, -0.01, 0.02],
        [0.1, 0.04, 0],
        [0, -0.01, 0],
        [0, 0.04, 0.03],
        [0, 0.04, 0],
    ]
)


def drawn(measured, path, **options):
    registered = register_markers(measured, POINTS, NAMES, source="swing.c3d", **options)
    places = [None if np.isnan(place).any() else place.tolist() for place in registered.positions]
    fit = {"positions": places, "residual_mm": 1e3 * registered.residual}
    fit = {key: dict(zip(registered.names, values, strict=True)) for key, values in fit.items()}
    fits = {"Beam": {**fit, "rms_mm": 0.0, "outliers": registered.outliers}}
    nominal = dict(zip(NAMES, POINTS, strict=True))
    picture = registration_picture(
        Recordings({}, fits, nominal, (), MESH), select_vertices(MESH, x=0.0)
    )
    return imread(picture.save(path, picture.draw()))[..., :3]


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


X, Y, Z = np.eye(3)


def bodies(step, count):
    """Two balls of four vertices on their ways along a line."""
    times = step * np.arange(count)
    corners = 0.01 * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    points = {
        name: np.stack([speed * times, 0.0 * times, 0.0 * times], axis=1)
        for name, speed in (("open_sysid", 0.1), ("receding_resphys", 0.2))
    }
    positions = {name: each[:, None] + corners for name, each in points.items()}
    path = np.stack([np.linspace(0.0, 0.2, 50), np.zeros(50), np.zeros(50)], axis=1)
    return DrivenBodies(times, triangles, positions, points, path, np.stack([X, Y]), -9.81 * Z)


@pytest.mark.parametrize(
    ("step", "slower", "frames", "fps"), [(0.01, 1.0, 26, 25.0), (0.01, 4.0, 101, 25.0)]
)
def test_a_trail_ends_where_the_point_is(step, slower, frames, fps):
    shown = bodies(step, 101)
    scene = shown.film(slower)
    assert len(scene.texts) == frames
    assert scene.fps == pytest.approx(fps)
    assert (scene.texts[0], scene.texts[-1]) == ("0.00 s", "1.00 s")
    sysid, resphys = scene.views
    assert sysid.legend == [
        ("SysID, open loop", TONES["sysid"].light),
        ("path", TONES["muted"].light),
    ]
    assert resphys.legend == [("ResPhys, receding horizon", TONES["resphys"].light)]
    for view, points in zip(scene.views, shown.points.values(), strict=True):
        body, _, path, trail, ball, *drawing = view.layers
        every = points[:: 100 // (frames - 1)]
        np.testing.assert_allclose(ball.points[:, 0], every)
        np.testing.assert_allclose(trail.points[:, -1], every)
        np.testing.assert_allclose(trail.points[:, 0], points[0] + 0.0 * every)
        # Nothing beyond where the point is.
        assert (np.diff(trail.points[..., 0], axis=1) >= 0.0).all()
        np.testing.assert_allclose(trail.points[-1, -2:], points[[-1, -1]])
        np.testing.assert_allclose(body.points[:, 0], every)
        for layer in (path, trail, *drawing):
            seen = (layer.points.reshape(-1, 3) - view.focus) @ view.axes[:2].T
            assert np.abs(seen[:, 0]).max() < view.half_height * scene.size[0] / scene.size[1]
            assert np.abs(seen[:, 1]).max() < view.half_height


def test_the_drawing_is_the_path_enlarged_beside_the_body():
    shown = bodies(0.01, 101)
    for view in shown.film().views:
        body, _, path, trail, ball, larger_path, larger_trail, larger_ball = (
            layer.points.reshape(-1, 3) @ view.axes[:2].T for layer in view.layers
        )
        factors = [
            np.ptp(large, axis=0)[0] / np.ptp(small[:, 0])
            for small, large in ((path, larger_path), (trail, larger_trail))
        ]
        assert factors[0] == pytest.approx(factors[1])
        np.testing.assert_allclose(
            larger_ball[-1] - larger_path[0], factors[0] * (ball[-1] - path[0]), atol=1e-9
        )
        assert larger_path[:, 1].min() > body[:, 1].max()  # A body that lies has it above.
