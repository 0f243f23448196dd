import re

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from support.refusals import refuses
from warp_resphys import DataFileError, InputError, box_hexahedra, box_tetrahedra, read_recording
from warp_resphys.core.mesh.surface import closest_points
from warp_resphys.core.mesh.volume_mesh import boundary_triangles
from warp_resphys.data.marker_names import assign
from warp_resphys.data.recordings.processing import fill_gaps, find_release
from warp_resphys.data.registration import RigidTransform, axes_rotation, kabsch, register_markers

BEAM = {
    "Tip - 1": (0.1, 0.015, 0.036),
    "Tip - 2": (0.1, -0.006, 0.024),
    "Tip - 3": (0.1, 0.036, 0.006),
    "Base - 1": (0.006, -0.010, -0.001),
    "Base - 2": (0.006, 0.040, 0.0275),
    "Base - 3": (0.006, 0.040, 0.000),
}
NAMES, NOMINAL = list(BEAM), np.array(list(BEAM.values()))
BASE = NAMES[3:]
MOTION = RigidTransform(
    Rotation.from_euler("xyz", [0.4, -2.0, 1.1]).as_matrix(), np.array([0.3, -0.2, 1.5])
)
SOURCE = "swing.c3d"


def measured(motion=MOTION, **moved):
    """The nominal markers in the recording's frame, some moved [m] by their names' place."""
    points = NOMINAL.copy()
    for place, by in moved.items():
        points[int(place[1:])] += by
    return motion.apply(points)


def assert_inverse(result, atol=1e-12):
    np.testing.assert_allclose(result.rotation @ MOTION.rotation, np.eye(3), rtol=0, atol=atol)
    np.testing.assert_allclose(
        result.rotation @ MOTION.translation + result.translation, 0.0, atol=atol
    )


def test_kabsch_finds_a_batch_of_rigid_motions():
    generator = np.random.default_rng(1)
    rotation = Rotation.random(5, random_state=2).as_matrix()
    translation = generator.normal(size=(5, 3))
    source = generator.normal(size=(6, 3))
    target = source @ rotation.transpose(0, 2, 1) + translation[:, None]
    motion = kabsch(np.broadcast_to(source, target.shape), target)
    np.testing.assert_allclose(motion.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(motion.translation, translation, atol=1e-12)
    np.testing.assert_allclose(motion.apply(source), target, atol=1e-12)


@pytest.mark.parametrize(
    "points", [np.zeros((2, 3)), np.outer(np.arange(4.0), [1.0, 2.0, 3.0]), np.full((4, 3), np.nan)]
)
def test_kabsch_refuses(points):
    refuses(InputError, "Registration needs", kabsch, points, points)


class TestRegisterMarkers:
    @pytest.mark.parametrize("astray", [0, 4])
    def test_one_marker_ten_centimetres_off_changes_nothing(self, astray):
        points = measured(**{f"m{astray}": [0.06, 0.0, -0.08]})
        result = register_markers(points, NOMINAL, NAMES, source=SOURCE)
        assert_inverse(result.transform)
        assert result.outliers == (NAMES[astray],)
        assert list(np.flatnonzero(~result.inliers)) == [astray]
        assert result.residual[astray] == pytest.approx(0.1)
        assert result.rms < 1e-12

    def test_tips_that_sag_beside_the_base_and_markers_that_were_not_seen_are_left_out(self):
        points = measured(m0=[0, 0, -0.01], m1=[0, 0, -0.01], m2=[0, 0, -0.012])
        result = register_markers(points, NOMINAL, NAMES, source=SOURCE, use=BASE)
        assert_inverse(result.transform)
        np.testing.assert_allclose(
            result.residual, [0.01, 0.01, 0.012, 0, 0, 0], rtol=0, atol=1e-12
        )
        assert list(result.inliers) == [False] * 3 + [True] * 3
        assert result.outliers == ()
        points = measured()
        points[1] = np.nan
        result = register_markers(points, NOMINAL, NAMES, source=SOURCE)
        assert_inverse(result.transform)
        assert np.isnan(result.residual[1])
        assert np.isnan(result.positions[1]).all()
        assert not result.inliers[1]
        assert result.outliers == ()

    @pytest.mark.parametrize(
        ("points", "settings", "sentence"),
        [
            # Of four, none can be left out.
            (measured(m1=[0.1, 0.0, 0.0]), {"use": NAMES[:4]}, "'Tip - 2'"),
            (
                measured(m1=[0.1, 0.0, 0.0], m4=[0.0, 0.05, 0.0], m5=[0.03, 0.0, 0.0]),
                {},
                "'Tip - 2' is ",
            ),
            (measured(m3=[0.0, 0.03, 0.0]), {"use": BASE}, "mm off (all three: "),
            (
                np.where(np.arange(6)[:, None] > 3, np.nan, measured()),
                {"use": BASE},
                "registration needs three markers at rest, but 1 are left to it; not seen: 'Base "
                "- 2', 'Base - 3'.",
            ),
        ],
    )
    def test_it_names_file_and_marker(self, points, settings, sentence):
        with pytest.raises(DataFileError, match=re.escape(sentence)) as error:
            register_markers(points, NOMINAL, NAMES, source=SOURCE, **settings)
        assert "swing.c3d" in str(error.value)

    def test_base_markers_on_a_line_wrong_names_and_shapes_are_refused(self):
        nominal = NOMINAL.copy()
        nominal[3:] = [[0.0, 0.0, 0.0], [0.0, 0.02, 0.001], [0.0, 0.05, 0.0]]
        with pytest.raises(
            InputError, match="'Base - 1', 'Base - 2', 'Base - 3' lie on one line to within 4"
        ):
            register_markers(MOTION.apply(nominal), nominal, NAMES, source=SOURCE, use=BASE)
        refuses(
            InputError,
            "'Base - 9'",
            register_markers,
            measured(),
            NOMINAL,
            NAMES,
            source=SOURCE,
            use=["Base - 9"],
        )
        with pytest.raises(InputError, match="6 markers are named, with measured positions"):
            register_markers(measured()[:5], NOMINAL, NAMES, source=SOURCE)


@pytest.mark.parametrize(
    ("name", "rms"), [("gravity", 0.807e-3), ("load101", 1.132e-3)], ids=["bare", "101g"]
)
def test_recordings_of_the_beam(shared_data, name, rms):
    recording = read_recording(shared_data / "beam_mocap" / f"beam_{name}_V2_a.c3d").select(NAMES)
    positions = fill_gaps(recording, 5).positions
    release = find_release(positions[:, :3].mean(axis=1), recording.rate)
    held = np.median(positions[slice(*release.rest)], axis=0)
    result = register_markers(held, NOMINAL, NAMES, source=recording.source)
    assert result.rms == pytest.approx(rms, abs=2e-6)
    assert result.inliers.all()
    spoilt = held.copy()
    spoilt[4] += 0.1
    without = register_markers(spoilt, NOMINAL, NAMES, source=recording.source)
    assert without.outliers == ("Base - 2",)
    assert np.linalg.norm(without.positions - result.positions, axis=1)[:3].max() < 2.5e-3


MESHES = {
    "hexahedra": box_hexahedra(divisions=(5, 2, 2)),
    "tetrahedra10": box_tetrahedra(divisions=(5, 2, 2), order=2),
}


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())
def test_closest_points_of_a_box(mesh):
    """Against the formula for a box, inside and outside of it."""
    points = np.random.default_rng(2).uniform([-0.02, -0.02, -0.02], [0.12, 0.05, 0.05], (200, 3))
    high = np.array([0.1, 0.03, 0.03])
    outside = np.linalg.norm(np.maximum(np.maximum(-points, points - high), 0.0), axis=1)
    inside = np.minimum(points, high - points).min(axis=1)
    result = closest_points(mesh, points)
    np.testing.assert_allclose(
        result.distances, np.where(outside > 0.0, outside, -inside), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(
        np.linalg.norm(points - result.points, axis=1), np.abs(result.distances), atol=1e-12
    )
    corners = mesh.vertices[result.triangles]
    heights = np.einsum("pki,pi->pk", corners - result.points[:, None], result.normals)
    np.testing.assert_allclose(heights, 0.0, atol=1e-12)
    assert trimesh.Trimesh(mesh.vertices, boundary_triangles(mesh), process=False).volume > 0.0


def shifted(axes, **moved):
    """The nominal markers in a frame with other axes, some moved [m], and the rotation back."""
    rotation = axes_rotation(axes)
    return measured(RigidTransform(rotation.T, rotation.T @ [-0.3, 0.2, -1.5]), **moved), rotation


def test_known_axes_leave_a_shift_that_one_marker_determines_and_have_to_fit():
    points, rotation = shifted(["x", "z", "-y"])
    for use in (NAMES[3:4], BASE, None):
        result = register_markers(points, NOMINAL, NAMES, source=SOURCE, use=use, rotation=rotation)
        np.testing.assert_allclose(result.positions, NOMINAL, atol=1e-12)
        assert result.rms < 1e-12
        assert result.inliers.sum() == (len(NAMES) if use is None else len(use))
    off, rotation = shifted(["x", "z", "-y"], m3=[0.02, 0.0, 0.0], m0=[0.0, 0.001, 0.0])
    result = register_markers(off, NOMINAL, NAMES, source=SOURCE, rotation=rotation)
    assert result.outliers == ("Base - 1",)
    np.testing.assert_allclose(result.residual[[3]], 0.02, atol=3e-4)
    points, rotation = shifted(["y", "-x", "z"])
    with pytest.raises(
        DataFileError, match=r"swing.c3d: .* with the axes that are given: '[A-Z].*' is .* mm off"
    ):
        register_markers(
            points, NOMINAL, NAMES, source=SOURCE, rotation=axes_rotation(["z", "x", "y"])
        )
    with pytest.raises(
        DataFileError, match="registration needs one marker at rest, but 0 are left to it"
    ):
        register_markers(points * np.nan, NOMINAL, NAMES, source=SOURCE, rotation=rotation)
    refuses(InputError, "would mirror the recording", axes_rotation, ["x", "z", "y"])
    refuses(InputError, "name one axis twice", axes_rotation, ["x", "-x", "y"])


class TestWithAKnownVertical:
    """Two markers of a base, or a row of them, and where up is."""

    UP = np.array([0.0, 0.0, 1.0])

    def register(self, nominal):
        lean = Rotation.from_rotvec([0.7, -0.4, 0.0])
        turn = lean * Rotation.from_rotvec(-3.1 * self.UP)
        measured = turn.apply(nominal) + [0.3, 0.2, -0.1]
        names = [f"B{number}" for number in range(len(nominal))]
        vertical = 9.8 * lean.apply(self.UP), self.UP
        return register_markers(measured, nominal, names, source=SOURCE, vertical=vertical), turn

    @pytest.mark.parametrize(
        "nominal",
        [
            [[0.1, 0.0, 0.02], [-0.1, 0.03, 0.0]],
            [[0.0, 0.0, 0.0], [0.05, 0.0, 0.1], [0.1, 0.0, 0.2]],
        ],
    )
    def test_two_markers_or_a_row_register_with_a_known_vertical(self, nominal):
        result, turn = self.register(np.array(nominal))
        np.testing.assert_allclose(result.transform.rotation, turn.inv().as_matrix(), atol=1e-12)
        np.testing.assert_allclose(result.positions, nominal, atol=1e-12)

    def test_degenerate_views_are_refused(self):
        with pytest.raises(InputError, match=r"'B0', 'B1' lie above one another to within 4\.0 mm"):
            self.register(np.array([[0.0, 0.0, 0.0], [0.001, 0.0, 0.3]]))
        pair = np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]])
        with pytest.raises(
            DataFileError, match=r"with the vertical that is given: 'B[01]' is 20\.0 mm off"
        ):
            register_markers(
                pair * 1.2, pair, ["B0", "B1"], source=SOURCE, vertical=(self.UP, self.UP)
            )
        hidden = np.array([[0.1, 0.0, 0.0], [np.nan] * 3])
        with pytest.raises(
            DataFileError, match="registration needs two markers at rest, but 1 are left"
        ):
            register_markers(hidden, pair, ["B0", "B1"], source=SOURCE, vertical=(self.UP, self.UP))


LETTERS = ("a", "b", "c", "d", "base")
PLACES = np.array(
    [
        [0.0, 0.0, -0.1],
        [0.03, 0.0, -0.2],
        [-0.02, 0.01, -0.3],
        [0.0, 0.0, -0.37],
        [0.04, 0.02, 0.01],
    ]
)
TURN = Rotation.from_euler("xyz", [40.0, -70.0, 120.0], degrees=True).as_matrix()
SHIFT = np.array([0.3, -1.2, 0.7])
ORDER = np.array([3, 0, 4, 1, 2])  # of the file


def seen(places=PLACES, noise=0.0, turn=TURN):
    """The markers as a file has them, in another frame and order."""
    drawn = np.random.default_rng(0).normal(size=places.shape)
    return ((places - SHIFT) @ turn + noise * drawn)[ORDER]


@pytest.mark.parametrize(("noise", "extra"), [(0.0, 0), (3e-3, 2)])
def test_markers_are_named_in_any_order_and_frame(noise, extra):
    others = np.random.default_rng(1).uniform(-1.0, 1.0, (extra, 3))
    columns, motion, rms, next_rms = assign(
        np.concatenate([others, seen(noise=noise)]), PLACES, LETTERS, source="file"
    )
    np.testing.assert_array_equal(columns, extra + np.argsort(ORDER))
    np.testing.assert_allclose(motion.rotation, TURN, atol=30.0 * noise + 1e-9)
    assert rms <= 2.0 * noise + 1e-9 < next_rms


def test_one_anchor_is_enough_with_known_axes():
    """The others may be centimetres from where they are expected,
    as on a body of unknown stiffness.
    """
    moved = PLACES + np.array(
        [[0.0, 0.005, 0.0], [0.01, 0.02, 0.0], [0.01, 0.03, 0.01], [0.02, 0.04, 0.02], [0, 0, 0]]
    )
    columns, motion, *_ = assign(
        seen(moved), PLACES, LETTERS, source="file", anchors=[4], rotation=TURN
    )
    np.testing.assert_array_equal(columns, np.argsort(ORDER))
    np.testing.assert_allclose(motion.translation, SHIFT, atol=1e-9)


def test_ambiguous_markers_are_named_and_ambiguous_assignments_refused():
    # a square
    places = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.1, 0.1, 0.0]])
    with pytest.raises(
        DataFileError, match=r"swing.csv: which of its markers is which is not clear: .* 'a', "
    ):
        assign(places @ TURN, places, LETTERS[:4], source="swing.csv")
    # And a foreign one.
    turned = np.concatenate([places[[2, 0]], [[0.5, 0.5, 0.0]], places[[1, 3]]])
    with pytest.raises(DataFileError) as refused:
        assign(turned @ TURN, places, LETTERS[:4], source="swing.csv")
    (pasted,) = re.findall(r"labels: \[(.*)\]\.", str(refused.value))
    assert pasted.split(", ")[2] == "other_3"
    assert sorted(pasted.split(", ")) == sorted([*LETTERS[:4], "other_3"])
    hidden = seen()
    hidden[1] = np.nan
    refuses(
        DataFileError,
        "file shows 4 markers, and 5 are configured",
        assign,
        hidden,
        PLACES,
        LETTERS,
        source="file",
    )
    with pytest.raises(
        InputError, match=r"2 markers stand still, and it takes three .* or data.axes"
    ):
        assign(seen(), PLACES, LETTERS, source="file", anchors=[3, 4])
    with pytest.raises(InputError, match="configure one at least"):
        assign(seen(), PLACES, LETTERS, source="file", anchors=[], rotation=TURN)
    refuses(InputError, "both must be", assign, seen(), PLACES[:4], LETTERS, source="file")
    with pytest.raises(DataFileError, match="no three of its markers stand as those"):
        assign(10.0 * seen(), PLACES, LETTERS, source="file")


def test_without_markers_the_origin_is_that_of_the_recording():
    points, rotation = shifted(["x", "z", "-y"])
    result = register_markers(points, NOMINAL, NAMES, source=SOURCE, use=(), rotation=rotation)
    np.testing.assert_allclose(result.positions, points @ rotation.T)
    assert np.isnan(result.residual).all()
    assert not result.inliers.any()
