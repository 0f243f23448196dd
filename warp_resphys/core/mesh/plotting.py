"""Drawing of meshes by pyvista, which is imported when it is first used."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from ...io.arrays import FloatArray, IntArray
from .elements import ELEMENTS, Element

BODY: Final = "#a9bccf"
# Of Okabe and Ito (2008).
REGIONS: Final = ("#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#f0e442", "#0072b2")
FIXED: Final = "#33485e"
_DOT: Final = 8.0  # px

Part = tuple[FloatArray, IntArray, Element, Mapping[str, IntArray]]


def plot_parts(
    parts: Iterable[Part],
    dots: FloatArray | None = None,
    screenshot: str | Path | None = None,
    plotter: Any = None,
    **options: Any,
) -> Any:
    """Draws meshes with their regions in colours, and returns the plotter.

    Args:
        parts: of each mesh the points (N, 3) [m]; its cells (M, K), of which the corners are drawn;
            their kind; and cells by name of their region, of which later ones cover earlier ones.
        dots: (P, 3) points drawn as dots [m].
        screenshot: PNG file to draw off screen; None: a window, or a viewer in a notebook.
        plotter: a ``pyvista.Plotter`` to add to, which is shown by the caller; None: a new one.
        options: of ``pyvista.Plotter.add_mesh``.
    """
    import pyvista

    drawn: Any = pyvista.Plotter(off_screen=screenshot is not None) if plotter is None else plotter
    named = False
    for points, cells, element, regions in parts:
        names, linear = list(regions), ELEMENTS[element.linear]
        region = np.full(len(cells), -1)
        for number, name in enumerate(names):
            region[regions[name]] = number
        for number in np.unique(region).tolist():
            corners = cells[region == number, : linear.nodes]
            used, numbered = np.unique(corners, return_inverse=True)
            kind = getattr(pyvista.CellType, linear.file_type.upper())
            grid = pyvista.UnstructuredGrid({kind: numbered.reshape(corners.shape)}, points[used])
            look = {
                "color": BODY if number < 0 else REGIONS[number % len(REGIONS)],
                "show_edges": True,
            }
            label = None if number < 0 else names[number]
            named |= label is not None
            drawn.add_mesh(grid, **{**look, "label": label, **options})
    if dots is not None and len(dots):
        drawn.add_points(dots, color=FIXED, point_size=_DOT, render_points_as_spheres=True)
    if plotter is None:
        if named:
            drawn.add_legend()
        if screenshot is None:
            drawn.show()
        else:
            drawn.screenshot(str(screenshot))
    return drawn
