"""The film of what controllers drive: from where it is seen, and what is drawn."""

import numpy as np
import pytest

from warp_resphys.report.body_motions import DrivenBodies
from warp_resphys.report.wording import TONES

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


@pytest.mark.parametrize(("step", "slower", "frames", "fps"), [(0.01, 1.0, 26, 25.0), (0.01, 4.0, 101, 25.0)])
def test_a_trail_ends_where_the_point_is(step, slower, frames, fps):
    shown = bodies(step, 101)
    scene = shown.film(slower)
    assert len(scene.texts) == frames
    assert scene.fps == pytest.approx(fps)
    assert (scene.texts[0], scene.texts[-1]) == ("0.00 s", "1.00 s")
    sysid, resphys = scene.views
    assert sysid.legend == [("SysID, open loop", TONES["sysid"].light), ("path", TONES["muted"].light)]
    assert resphys.legend == [("ResPhys, receding horizon", TONES["resphys"].light)]
    for view, points in zip(scene.views, shown.points.values(), strict=True):
        body, _, path, trail, ball, *drawing = view.layers
        every = points[:: 100 // (frames - 1)]
        np.testing.assert_allclose(ball.points[:, 0], every)
        np.testing.assert_allclose(trail.points[:, -1], every)
        np.testing.assert_allclose(trail.points[:, 0], points[0] + 0.0 * every)
        assert (np.diff(trail.points[..., 0], axis=1) >= 0.0).all()  # Nothing beyond where the point is.
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
        np.testing.assert_allclose(larger_ball[-1] - larger_path[0], factors[0] * (ball[-1] - path[0]), atol=1e-9)
        assert larger_path[:, 1].min() > body[:, 1].max()  # A body that lies has it above.
