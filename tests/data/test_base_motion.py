"""Rigid motion of a base: as a function, from a table, recorded, and followed by markers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.refusals import refuses
from warp_resphys.data.base_motion import (
    at_times,
    check_steps,
    followed,
    poses_of,
    prescribed,
    rigid,
    since_first,
)
from warp_resphys.io.errors import DataFileError
from warp_resphys.io.settings import parse
from warp_resphys.settings.performed import MotionSettings

TIMES = np.linspace(0.0, 2.0, 201)
SWING = parse(
    MotionSettings,
    {
        "swings": {
            "across": {"frequency": 1.5, "translation": (0.02, 0.0, -0.01)},
            "about": {"frequency": 0.7, "rotation": (0.1, 0.3, -0.2), "phase": 0.4},
        },
        "about": (0.05, -0.02, 0.01),
        "start": 0.3,
        "ramp": 0.2,
    },
)
POINTS = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.08, 0.0], [0.0, 0.02, 0.05]])


def moved(poses, points=POINTS):
    return rigid(poses).apply(np.broadcast_to(points, (len(poses), *points.shape)))


def test_nothing_moves_before_the_start_of_the_sinusoids():
    poses = prescribed(SWING, TIMES)
    assert not poses[TIMES <= 0.3].any()
    after = TIMES >= 0.5
    since = TIMES[after] - 0.3
    turned = np.sin(2 * np.pi * 0.7 * since + 0.4) - np.sin(0.4)
    np.testing.assert_allclose(poses[after, 3:], turned[:, None] * [0.1, 0.3, -0.2], atol=1e-12)
    centre = moved(poses, np.array([SWING.about]))[:, 0] - SWING.about
    expected = np.sin(2 * np.pi * 1.5 * since)[:, None] * [0.02, 0.0, -0.01]
    np.testing.assert_allclose(centre[after], expected, atol=1e-12)


class TestTables:
    @pytest.mark.parametrize(
        ("delimiter", "decimal", "encoding"), [(",", ".", "utf-8"), (";", ",", "utf-16")]
    )
    def test_a_table_gives_the_motion_of_its_point(self, tmp_path, delimiter, decimal, encoding):
        known = prescribed(SWING, TIMES)
        place, offset = np.array([0.03, 0.01, -0.02]), np.array([5.0, -2.0, 1.0])
        quaternions = Rotation.from_rotvec(known[:, 3:]).as_quat()[:, [3, 0, 1, 2]]
        table = np.column_stack([TIMES, moved(known, place[None])[:, 0] + offset, quaternions])
        np.savetxt(
            tmp_path / "shaker.csv", table, delimiter=delimiter, header="t, x, y, z, w, i, j, k"
        )
        text = (tmp_path / "shaker.csv").read_text()
        (tmp_path / "shaker.csv").write_text(text.replace(".", decimal), encoding=encoding)
        result = prescribed(
            MotionSettings(**{"file": "shaker.csv", "about": place}), TIMES[3:-3] + 0.004, tmp_path
        )
        np.testing.assert_allclose(
            moved(result), moved(prescribed(SWING, TIMES[3:-3] + 0.004)), atol=2e-5
        )

    @pytest.mark.parametrize("text", ["1,2,3\n", "0,0,0,0,1,0,0,0\n" * 5])
    def test_invalid_tables_of_poses_are_refused(self, tmp_path, text):
        (tmp_path / "bad.csv").write_text(text)
        with pytest.raises(DataFileError, match=r"bad\.csv.*(\.$|to be)"):
            prescribed(MotionSettings(**{"file": "bad.csv"}), TIMES, tmp_path)


class TestRecorded:
    def test_places_and_quaternions_give_the_motion_since_the_first_frame(self):
        known = prescribed(SWING, TIMES + 0.8)
        start = rigid(known[:1])
        turned = rigid(known).rotation @ start.rotation[0].T
        quaternions = Rotation.from_matrix(rigid(known).rotation).as_quat()[:, [3, 0, 1, 2]]
        quaternions[::3] *= -2.0  # the same rotations
        result = rigid(since_first(known[:, :3], quaternions, "a.npz"))
        np.testing.assert_allclose(result.rotation, turned, atol=1e-12)
        again = result.apply(
            np.broadcast_to(start.apply(POINTS[None]), (len(known), *POINTS.shape))
        )
        np.testing.assert_allclose(again, moved(known), atol=1e-12)

    @pytest.mark.parametrize("wrong", [np.nan, 0.0])
    def test_an_invalid_quaternion_is_refused(self, wrong):
        quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (5, 1))
        quaternions[2] = wrong
        refuses(
            DataFileError,
            "'base' needs, in every frame",
            since_first,
            np.zeros((5, 3)),
            quaternions,
            "a.npz",
        )

    def test_rotation_vectors_go_on_beyond_half_a_turn(self):
        angles = np.linspace(0.0, 4.0 * np.pi, 200)
        poses = poses_of(
            Rotation.from_rotvec(angles[:, None] * [0.0, 0.6, 0.8]).as_matrix(), np.zeros((200, 3))
        )
        np.testing.assert_allclose(poses[:, 3:], angles[:, None] * [0.0, 0.6, 0.8], atol=1e-9)


class TestFollowed:
    NOISE = 1e-4  # m

    def test_the_base_motion_is_more_accurate_than_its_markers_of_which_it_needs_three(self):
        draw = np.random.default_rng(0)
        known = prescribed(SWING, TIMES)
        markers = moved(known) + self.NOISE * draw.standard_normal((len(TIMES), *POINTS.shape))
        markers[20:25, 1] = markers[100, :2] = np.nan  # three of them are seen, then two
        result = followed(markers, POINTS, "a.npz")
        error = np.linalg.norm(moved(result) - moved(known), axis=-1)
        assert error.mean() < self.NOISE
        jerky = np.diff(moved(result), 2, axis=0) - np.diff(moved(known), 2, axis=0)
        # Unsmoothed, 2.4 times the noise over the root of their number.
        assert np.abs(jerky).mean() < 0.2 * self.NOISE
        markers = moved(prescribed(SWING, TIMES))
        markers[:150, :2] = np.nan
        with pytest.raises(
            DataFileError, match=r"a\.npz: the base moves, and three .* in 25 % of the frames"
        ):
            followed(markers, POINTS, "a.npz")


def test_times_between_frames_and_beyond_them():
    poses = prescribed(SWING, TIMES)
    result = at_times(poses, TIMES, TIMES[:-1] + 0.003)
    np.testing.assert_allclose(result, prescribed(SWING, TIMES[:-1] + 0.003), atol=2e-5)
    np.testing.assert_array_equal(at_times(poses, TIMES, np.array([-1.0, 3.0])), poses[[0, -1]])


def test_a_motion_that_tears_a_body_is_refused():
    steps = prescribed(SWING, np.arange(0.0, 2.0, 0.01))
    check_steps(steps, POINTS, "a.npz")
    steps[50:, 0] += 0.03
    refuses(
        DataFileError,
        r"a\.npz: the base jumps by .* mm in step 50,",
        check_steps,
        steps,
        POINTS,
        "a.npz",
    )
