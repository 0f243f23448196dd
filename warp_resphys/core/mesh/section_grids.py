"""Grids of points and quadrilaterals that fill the cross-section of a pneumatic arm."""

from collections.abc import Sequence

import numpy as np

from ...io.arrays import IntArray
from .arm_section import ComplexArray, Divisions, Growth, Section


def section_grids(
    section: Section, divisions: Divisions, order: int = 1
) -> tuple[list[ComplexArray], list[int]]:
    """Returns grids of points in the blocks of a section,
    by transfinite interpolation (Gordon and Hall 1973).

    Args:
        section: the section.
        divisions: number of intervals on each line between named points.
        order: intervals along the edge of a cell; the nodes of quadratic cells lie on the curves.

    Returns:
        For each block: (k + 1, l + 1) points, with the second axis counter-clockwise of the first,
        and the index of its chamber, from 0, or `SOLID`.
    """
    growth = section.growth(divisions) if order == 1 else Growth(0.0, 0.0)
    grids, chambers = [], []
    for corners, chamber in section.blocks():
        along, across = (
            np.linspace(0.0, 1.0, divisions[section.edge(corners[a][0], corners[b][0])] + 1)
            for a, b in ((0, 1), (0, 3))
        )
        sides = ((0, 1, along), (3, 2, along), (0, 3, across), (1, 2, across))
        low, high, left, right = (
            section.line(corners[i], corners[k], t, growth) for i, k, t in sides
        )
        u, v = along[:, None], across[None, :]
        grid = (
            (1 - v) * low[:, None]
            + v * high[:, None]
            + (1 - u) * left[None, :]
            + u * right[None, :]
        )
        grid = (
            grid
            - (1 - u) * ((1 - v) * low[0] + v * high[0])
            - u * ((1 - v) * low[-1] + v * high[-1])
        )
        p, q, r = grid[0, 0], grid[-1, 0], grid[-1, -1]
        grids.append(grid if ((q - p).conjugate() * (r - p)).imag > 0.0 else grid.T)
        chambers.append(chamber)
    return grids, chambers


def section_quadrilaterals(
    grids: Sequence[ComplexArray], order: int = 1
) -> tuple[IntArray, list[IntArray]]:
    """Numbers the points of grids with shared sides, such as those of `section_grids`.

    Returns:
        Index (S,) of each distinct point among those of all grids, and for each block the points of
        its quadrilaterals (Q, order + 1, order + 1), with the second axis counter-clockwise of the
        first.
    """
    flat = np.concatenate([grid.ravel() for grid in grids])
    unit = 1e-7 * np.abs(flat).max()
    # Keeps symmetric points off the steps.
    keys = np.floor(np.stack([flat.real, flat.imag], axis=1) / unit + 0.1234567)
    _, place, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    ends = np.cumsum([grid.size for grid in grids])
    quads = []
    for grid, index in zip(grids, np.split(number.ravel(), ends[:-1]), strict=True):
        i = index.reshape(grid.shape)
        windows = np.lib.stride_tricks.sliding_window_view(i, (order + 1, order + 1))
        windows = windows[::order, ::order]
        quads.append(windows.reshape(-1, order + 1, order + 1))
    return place, quads
