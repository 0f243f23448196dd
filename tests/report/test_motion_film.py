"""Films of motions of Python."""

from dataclasses import replace

import imageio_ffmpeg
import numpy as np
import torch

from support.refusals import refuses
from warp_resphys import (
    Body,
    Corotated,
    InputError,
    Motion,
    Scene,
    Simulator,
    State,
    box_hexahedra,
    film,
)


def test_a_film_shows_all_bodies_of_a_motion(tmp_path, can_draw):
    """Two boxes side by side, of which one rises: the blue moves up
    in the right half of the picture.
    """
    box = Body(box_hexahedra((0.02, 0.02, 0.02), (1, 1, 1)))
    scene = Scene({"left": box, "right": box.moved(np.eye(3), (0.06, 0.0, 0.0))})
    rest = Simulator(scene, {"left": Corotated(), "right": Corotated()}).rest_state()
    lifted = rest.q.clone()
    lifted[:, 8:, 2] += 0.02
    states = [rest, rest, rest, replace(rest, q=lifted)]
    motion = Motion.of(states, scene, 0.05)
    frames = imageio_ffmpeg.read_frames(
        str(film(motion, tmp_path / "boxes.mp4", gravity=(0.0, 0.0, -9.81)))
    )
    width, height = next(frames)["size"]
    pictures = [
        np.frombuffer(one, np.uint8).reshape(height, width, 3).astype(int) for one in frames
    ]
    heights = []
    for picture in (pictures[0], pictures[-1]):
        blue = (picture[..., 2] > picture[..., 0] + 40) & (
            np.arange(height)[:, None] > 0.1 * height
        )
        halves = blue[:, : width // 2], blue[:, width // 2 :]
        assert all(half.sum() > 500 for half in halves)
        heights.append([np.argwhere(half)[:, 0].mean() for half in halves])
    (left, right), (still, risen) = heights
    assert abs(left - still) < 3.0
    assert right - risen > 0.1 * height


def test_what_is_no_film_is_refused(tmp_path):
    body = Body(box_hexahedra(divisions=(1, 1, 1)))
    state = State(torch.as_tensor(body.vertices)[None], torch.zeros(1, 8, 3).double())
    motion = Motion.of([state, state], body, 0.05)
    refuses(InputError, "no step", film, Motion.of([state], body, 0.05), tmp_path / "a.mp4")
    refuses(InputError, "does not end in .mp4", film, motion, tmp_path / "a.gif")
    refuses(InputError, "environment is 1", film, motion, tmp_path / "a.mp4", environment=1)
