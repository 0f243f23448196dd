"""Pictures of meshes by pyvista, which is imported when it is first used."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .elements import ELEMENTS, Element

BODY: Final = "#a9bccf"
REGIONS: Final = ("#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#f0e442", "#0072b2")  # of Okabe and Ito (2008)
FIXED: Final = "#33485e"
_DOT: Final = 8.0  # px


class Picture:
    """A picture of one or more meshes.

    Args:
        screenshot: PNG file to draw off screen; None: a window, or a viewer in a notebook.
        plotter: a ``pyvista.Plotter`` to add to, which is shown by the caller; None: a new one.
    """

    def __init__(self, screenshot: str | Path | None = None, plotter: Any = None) -> None:
        import pyvista

        self._file, self._given, self._named = screenshot, plotter is not None, False
        self._plotter: Any = pyvista.Plotter(off_screen=screenshot is not None) if plotter is None else plotter

    def add(
        self,
        points: NDArray[np.float64],
        cells: NDArray[np.int64],
        element: Element,
        regions: Mapping[str, NDArray[np.int64]],
        **options: Any,
    ) -> None:
        """Adds a mesh, with its regions in colours.

        Args:
            points: (N, 3) [m].
            cells: (M, K) vertices.
            element: kind of the cells, of which the corners are drawn.
            regions: cells by name; later ones cover earlier ones.
            options: of ``pyvista.Plotter.add_mesh``.
        """
        import meshio
        import pyvista

        names, linear = list(regions), ELEMENTS[element.linear]
        corners = cells[:, : linear.nodes]
        region = np.full(len(cells), -1)
        for number, name in enumerate(names):
            region[regions[name]] = number
        for number in np.unique(region).tolist():
            used, numbered = np.unique(own := corners[region == number], return_inverse=True)
            grid = pyvista.from_meshio(meshio.Mesh(points[used], [(linear.file_type, numbered.reshape(own.shape))]))
            look = {"color": BODY if number < 0 else REGIONS[number % len(REGIONS)], "show_edges": True}
            label = None if number < 0 else names[number]
            self._named |= label is not None
            self._plotter.add_mesh(grid, **{**look, "label": label, **options})

    def add_points(self, points: NDArray[np.float64]) -> None:
        """Adds points (P, 3) [m] as dots."""
        if len(points):
            self._plotter.add_points(points, color=FIXED, point_size=_DOT, render_points_as_spheres=True)

    def finished(self) -> Any:
        """Shows or writes the picture, unless the plotter was given, and returns the plotter."""
        if not self._given:
            if self._named:
                self._plotter.add_legend()
            if self._file is None:
                self._plotter.show()
            else:
                self._plotter.screenshot(str(self._file))
        return self._plotter
