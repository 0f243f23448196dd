"""Films of motions of Python, of bodies, robots and scenes."""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ..core.dynamics.trajectory import Motion
from ..core.mesh.volume_mesh import boundary_triangles
from ..data.camera import frame_of, height_of, motion_axes
from ..io.errors import InputError, checks_types
from .layers import (
    MEASURED,
    Layer,
    RenderScene,
    View,
    body_layers,
    face_edges,
    obstacle_layers,
    pace,
    sharp_edges,
)
from .render import DrawingError, write_film

_SIZE: Final = (720, 560)  # px
_DOT: Final = 0.024  # diameter of a marker, over half the height of the view
_BEFORE: Final = 5.0  # shift of the markers to the viewer, over the same


@checks_types
def film(
    motion: Motion,
    path: str | Path,
    environment: int = 0,
    slower: float = 1.0,
    gravity: ArrayLike = (0.0, 0.0, -1.0),
) -> Path:
    """Writes a film (MP4) of a motion, of its body with its markers and obstacles.

    Args:
        motion: of a body, a robot or a scene, of one step or more.
        path: of the ``.mp4`` file.
        environment: index of the environment.
        slower: factor of slow motion.
        gravity: (3,) direction of gravity, down in the picture.

    Returns:
        The path.

    Raises:
        InputError: an unknown environment, a motion without steps, another extension, or a machine
            that cannot draw.
        DataFileError: the file cannot be written.
    """
    path = Path(path).expanduser()
    if path.suffix != ".mp4":
        raise InputError(f"{path} does not end in .mp4: give such a name.")
    if len(motion.q) < 2:
        raise InputError("the motion has no step: draw a state with body.plot(state).")
    try:
        write_film(path, _scene(motion, environment, slower, np.asarray(gravity, dtype=np.float64)))
    except DrawingError as error:
        raise InputError(f"no film can be drawn on this machine: {error}.") from None
    return path


def _scene(motion: Motion, environment: int, slower: float, gravity: np.ndarray) -> RenderScene:
    """Returns the scene of a film, in one view from the side."""
    frames, fps = pace(motion.times, slower)
    q = motion.of_environment(motion.q, environment)[frames]
    markers = motion.of_environment(motion.labelled, environment)[frames]
    obstacles = motion.surface(environment).at(frames)
    members = [*motion.body.members]
    triangles = np.concatenate(
        [boundary_triangles(body.mesh) + first for _, body, first in members]
    )
    edges = np.concatenate([face_edges(body.mesh) + first for _, body, first in members])
    sharp = sharp_edges(motion.body.vertices, triangles)
    axes, points = motion_axes(gravity, q), np.concatenate([q, markers], axis=1).reshape(-1, 3)
    middle, half = frame_of(np.concatenate([points, obstacles.near(points)]), axes)
    height = height_of(half, _SIZE)
    layers = obstacle_layers(obstacles.points, obstacles.triangles)
    layers += body_layers(q, triangles, height, edges, sharp if len(sharp) else edges)
    if markers.shape[1]:
        layers.append(
            Layer("balls", markers, None, MEASURED, size=_DOT * height, shift=_BEFORE * height)
        )
    texts = [f"{time:.2f} s" for time in motion.times[frames]]
    return RenderScene(
        [View(layers, axes, middle, height)], _SIZE, background="white", texts=texts, fps=fps
    )
