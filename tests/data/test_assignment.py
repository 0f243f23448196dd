"""Which marker is which, in recordings that do not name them."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warp_resphys.data.registration import assign
from warp_resphys.io.errors import DataFileError, InputError

NAMES = ("a", "b", "c", "d", "base")
PLACES = np.array([[0.0, 0.0, -0.1], [0.03, 0.0, -0.2], [-0.02, 0.01, -0.3], [0.0, 0.0, -0.37], [0.04, 0.02, 0.01]])
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
    result = assign(np.concatenate([others, seen(noise=noise)]), PLACES, NAMES, source="file")
    np.testing.assert_array_equal(result.columns, extra + np.argsort(ORDER))
    np.testing.assert_allclose(result.transform.rotation, TURN, atol=30.0 * noise + 1e-9)
    assert result.rms <= 2.0 * noise + 1e-9 < result.next_rms


def test_one_anchor_is_enough_with_known_axes():
    """The others may be centimetres from where they are expected, as on a body of unknown stiffness."""
    moved = PLACES + np.array([[0.0, 0.005, 0.0], [0.01, 0.02, 0.0], [0.01, 0.03, 0.01], [0.02, 0.04, 0.02], [0, 0, 0]])
    result = assign(seen(moved), PLACES, NAMES, source="file", anchors=[4], rotation=TURN)
    np.testing.assert_array_equal(result.columns, np.argsort(ORDER))
    np.testing.assert_allclose(result.transform.translation, SHIFT, atol=1e-9)


def test_ambiguous_markers_are_named():
    places = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.1, 0.1, 0.0]])  # a square
    with pytest.raises(DataFileError, match=r"swing.csv: which of its markers is which is not clear: .* 'a', "):
        assign(places @ TURN, places, NAMES[:4], source="swing.csv")
    turned = np.concatenate([places[[2, 0]], [[0.5, 0.5, 0.0]], places[[1, 3]]])  # and a foreign one
    with pytest.raises(DataFileError) as refused:
        assign(turned @ TURN, places, NAMES[:4], source="swing.csv")
    (pasted,) = re.findall(r"labels: \[(.*)\]\.", str(refused.value))
    assert pasted.split(", ")[2] == "other_3"
    assert sorted(pasted.split(", ")) == sorted([*NAMES[:4], "other_3"])


def test_ambiguous_assignments_are_refused():
    hidden = seen()
    hidden[1] = np.nan
    with pytest.raises(DataFileError, match="file shows 4 markers, and 5 are configured"):
        assign(hidden, PLACES, NAMES, source="file")
    with pytest.raises(InputError, match=r"2 markers stand still, and it takes three .* or data.axes"):
        assign(seen(), PLACES, NAMES, source="file", anchors=[3, 4])
    with pytest.raises(InputError, match="configure one at least"):
        assign(seen(), PLACES, NAMES, source="file", anchors=[], rotation=TURN)
    with pytest.raises(InputError, match="both must be"):
        assign(seen(), PLACES[:4], NAMES, source="file")
    with pytest.raises(DataFileError, match="no three of its markers stand as those"):
        assign(10.0 * seen(), PLACES, NAMES, source="file")
