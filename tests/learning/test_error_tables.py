"""Which tested trials lie beyond the training: by their inputs,
their loads and their displacements.
"""

import numpy as np
import pytest

from warp_resphys import ObservedMotions
from warp_resphys.data.trials import Trials
from warp_resphys.learning.error_tables import beyond_training

FRAMES = 6
NAMES = ("train 1", "train 2", "test")


def motions(pressures, moved=(1.0, 1.0, 1.0), payloads=(0.0, 0.0, 0.0), **more):
    """Three trials of a marker, one of them tested,
    that moves along x by given sizes [mm], under pressures [Pa].
    """
    times = np.tile(0.01 * np.arange(FRAMES), (3, 1))
    ramp = np.linspace(0.0, 1.0, FRAMES)[:, None]
    bound = np.zeros((1, 3))
    towards = [
        np.array([size, 0.0, 0.0]) if np.isscalar(size) else np.array(size) for size in moved
    ]
    observed = 1e-3 * np.stack([ramp * direction for direction in towards])[:, :, None]
    pressed = np.stack([np.tile(np.asarray(p, dtype=float), (FRAMES - 1, 1)) for p in pressures])
    words = NAMES, ("Tip",), ("rest",) * 3
    acting = {"inputs": {"pressure": pressed}, "channels": {"pressure": ("a", "b")}}
    still = observed[:, 0], np.array(payloads), np.array([0.0, 0.0, -9.81]), 0.01
    return ObservedMotions(Trials(*words, times, observed, *still, bound=bound, **acting), **more)


@pytest.mark.parametrize(
    ("changes", "excess"),
    [
        ({"pressures": [[1e4, 0.0], [2e4, 0.0], [2e4, 0.0]]}, {}),
        ({"pressures": [[1e4, 0.0], [2e4, 0.0], [2.05e4, 0.0]]}, {}),  # by less than 5 %
        ({"pressures": [[1e4, 0.0], [2e4, 0.0], [2.8e4, 0.0]]}, {"inputs": 0.4}),
        # In a chamber that was never used.
        ({"pressures": [[1e4, 0.0], [2e4, 0.0], [0.0, 1e4]]}, {"inputs": 0.5}),
        # In both at once.
        ({"pressures": [[2e4, 0.0], [0.0, 2e4], [2e4, 2e4]]}, {"inputs": 2.0**0.5 - 1.0}),
        ({"pressures": [[0.0, 0.0], [0.0, 0.0], [1e3, 0.0]]}, {"inputs": 1.0}),
        ({"pressures": [[1e4, 0.0]] * 3, "moved": (1.0, 2.0, 2.1)}, {}),
        ({"pressures": [[1e4, 0.0]] * 3, "moved": (1.0, 2.0, 3.0)}, {"displacements": 0.5}),
        # To the other side.
        ({"pressures": [[1e4, 0.0]] * 3, "moved": (1.0, 2.0, -1.0)}, {"displacements": 0.5}),
        (
            {"pressures": [[1e4, 0.0]] * 3, "moved": (1.0, 2.0, [0.0, 1.0, 0.0])},
            {"displacements": 0.5},
        ),
        ({"pressures": [[1e4, 0.0]] * 3, "payloads": (0.0, 0.1, 0.12)}, {"loads": 0.2}),
        ({"pressures": [[1e4, 0.0]] * 3, "payloads": (0.02, 0.1, 0.05)}, {}),
        (
            {"pressures": [[1e4, 0.0], [2e4, 0.0], [3e4, 0.0]], "moved": (1.0, 2.0, 4.0)},
            {"inputs": 0.5, "displacements": 1.0},
        ),
    ],
)
def test_a_trial_is_beyond_the_training_by_the_largest_excess_over_its_range(changes, excess):
    found = beyond_training(motions(**changes), NAMES[:2], NAMES[2:], {})
    assert found == ({"test": pytest.approx(excess)} if excess else {})


def test_hidden_markers_and_frames_that_do_not_count_are_left_out():
    moving = motions([[1e4, 0.0]] * 3, moved=(1.0, 2.0, 4.0))
    moving.trials.observed[0, 2] = np.nan
    assert beyond_training(moving, NAMES[:2], NAMES[2:], {})["test"][
        "displacements"
    ] == pytest.approx(1.0)
    moving.trials.observed[2, 1:] = np.nan
    assert beyond_training(moving, NAMES[:2], NAMES[2:], {}) == {}
    assert beyond_training(moving, (), NAMES[2:], {}) == {}


def test_the_second_part_of_a_trial_is_compared_with_the_first_that_was_learned_from():
    halved = motions([[1e4, 0.0]] * 3, moved=(1.0, 1.0, 1.0), train_fraction=0.4)
    found = beyond_training(halved, NAMES[:1], NAMES[:1], {})
    assert found == {"train 1": {"displacements": pytest.approx(1.5)}}
