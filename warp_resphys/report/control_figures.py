"""The figure of followed paths."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from .data import FollowedPath
from .figures import NARROW, STYLE, TONES, WIDE, in_style

FloatArray = NDArray[np.float64]

_LINES: Final[Mapping[str, Any]] = {"open": (0, (4, 2)), "receding": "-"}
_COLUMNS: Final = {False: 5, True: 2}  # of figures on a wide page, on a narrow one


@in_style()
def followed_paths(
    paths: Sequence[FollowedPath], controllers: Mapping[str, str], plane: FloatArray, *, narrow: bool
) -> Figure:
    """Draw paths and the paths of the controlled point, side by side in their plane.

    Args:
        paths: Paths and points.
        controllers: Names in words of the controllers that are drawn.
        plane: (2, 3) directions of the width and of the height.
        narrow: Whether the figure is for a narrow page.
    """
    columns = min(_COLUMNS[narrow], len(paths))
    rows = -(-len(paths) // columns)
    width = NARROW if narrow else WIDE
    figure = Figure(figsize=(width, width / columns * rows + 0.35), layout="constrained")
    every = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    first = plane[0] / np.linalg.norm(plane[0])
    second = plane[1] - (plane[1] @ first) * first
    across = 1e3 * np.stack([first, second / np.linalg.norm(second)])
    middle = np.mean([followed.path.mean(axis=0) for followed in paths], axis=0)
    lines: dict[str, Any] = {}
    for axes, followed in zip(every, paths, strict=False):
        x, y = ((followed.path - middle) @ across.T).T
        (lines["path"],) = axes.plot(x, y, color=TONES["target"].light, linewidth=3.2)
        for controller, name in controllers.items():
            beginning, model = controller.split("_", 1)
            x, y = ((followed.points[controller] - middle) @ across.T).T
            tone = TONES[model].light
            (lines[name],) = axes.plot(x, y, color=tone, linestyle=_LINES[beginning], linewidth=1.1)
        axes.set_aspect("equal")
        axes.set_title(followed.name)
        axes.grid(False)
    for axes in every[len(paths) :]:
        axes.set_visible(False)
    for axes in every:
        axes.tick_params(labelsize=STYLE["xtick.labelsize"] - 1.5)
    every[0].set_ylabel("mm")
    figure.legend(
        list(lines.values()), list(lines), loc="outside upper left", ncols=1 if narrow else 4, columnspacing=1.6
    )
    return figure
