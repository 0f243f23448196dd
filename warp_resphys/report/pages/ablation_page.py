"""The page of the marker ablation: a box plot, a table, and the method of reconstruction."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from ...io.arrays import FloatArray
from ...settings.run import RunSettings
from ..figures import new_figure, use_logarithm
from ..page import Canvas, Cell, PageTable, Part, Row, Text, Usage, write_page
from ..wording import NO_BREAK_SPACE, TONES, number_text

_COLUMNS: Final[Mapping[str, str]] = {
    "median_mm": "Median [mm]",
    "lower_quartile_mm": "Lower quartile",
    "upper_quartile_mm": "Upper quartile",
    "interquartile_range_mm": "Interquartile range",
    "largest_mm": "Largest",
    "misfit_median_mm": "At the markers",
}


@dataclass(frozen=True)
class MarkerErrors:
    """Errors [mm] of the draws of a number of markers."""

    markers: int
    median_mm: float
    lower_quartile_mm: float
    upper_quartile_mm: float
    interquartile_range_mm: float
    largest_mm: float
    misfit_median_mm: float  # at the markers
    errors_mm: Sequence[float]  # of each draw


class AblationMetrics(Usage, total=False):
    """Content of metrics.json of a marker ablation."""

    uncorrected_mm: float
    by_markers: list[dict[str, Any]]  # `MarkerErrors`


def write_ablation_report(
    path: Path,
    metrics: AblationMetrics,
    settings: RunSettings,
    *,
    vertices: int,
    surface: int,
    free: int,
) -> None:
    """Writes the page, see `write_page`.

    Args:
        path: The page's file, such as `report.html`.
        metrics: Of the run.
        settings: The run's configuration.
        vertices: Number of vertices of the mesh.
        surface: Number of vertices on its surface.
        free: Number of surface vertices that are not clamped.
    """
    rows = [MarkerErrors(**row) for row in metrics["by_markers"]]
    uncorrected, ablation = metrics["uncorrected_mm"], settings.ablation
    assert ablation is not None
    caption = (
        f"Mean distance of all {vertices} vertices from the target over the "
        f"{settings.data.steps} steps of one motion, reconstructed from the markers alone. The "
        f"orange line is the median of {ablation.draws} random sets of markers, the box extends "
        "from the lower to the upper quartile, "
        "the whiskers to the smallest and the largest error."
    )
    note = (
        "The last column is the median distance of the markers themselves. Uncorrected, the "
        f"simulation is {number_text(uncorrected)}{NO_BREAK_SPACE}mm off on average. The sets "
        f"are drawn from the {free} surface vertices that are not clamped."
    )
    more = [str(row.markers) for row in rows if row.markers > free]
    if more:
        note += (
            f" Sets of {', '.join(more)} markers exceed these, and are drawn from all {surface} "
            "surface vertices, as published."
        )
    medians = "; ".join(f"{row.markers}: {number_text(row.median_mm)} mm" for row in rows)
    alt = (
        "Box plot of the mean vertex error by number of markers, on a logarithmic axis. "
        f"Medians: {medians}."
    )
    assert settings.reconstruction is not None
    how = _how_reconstructed(settings.reconstruction.regularisation)

    def sections(canvas: Canvas) -> Iterator[Part]:
        boxes = marker_boxes({row.markers: np.array(row.errors_mm) for row in rows}, uncorrected)
        yield Part(
            "", [canvas.figure("marker_ablation", boxes, alt, caption), ablation_table(rows, note)]
        )
        yield Part("How it was reconstructed", [Text(how)])

    write_page(path, sections, settings, [verdict(rows, uncorrected)], metrics)


def marker_boxes(errors: Mapping[int, FloatArray], uncorrected: float) -> Figure:
    """Draws a box for each number of markers: median, quartiles,
    and whiskers to the smallest and largest draw.

    Args:
        errors: (D,) errors [mm] of the draws, by number of markers.
        uncorrected: Error without any correction [mm].
    """
    ink: dict[str, Any] = {"color": TONES["ink"].light, "linewidth": 0.9}
    grey, median = TONES["muted"].light, {"color": TONES["simulation"].light, "linewidth": 2.0}
    figure = new_figure(3.6)
    axes, count = figure.subplots(), len(errors)
    lines: Any = {"boxprops": ink, "whiskerprops": ink, "capprops": ink, "medianprops": median}
    axes.boxplot([*errors.values()], widths=0.55, whis=(0, 100), **lines)
    axes.plot(
        [0.5, count + 0.5], [uncorrected, uncorrected], color=grey, linewidth=1.1, linestyle="--"
    )
    place: Any = {"textcoords": "offset points", "ha": "right", "color": grey}
    axes.annotate("uncorrected simulator", (count + 0.5, uncorrected), (-2, 3), **place)
    axes.set_xlim(0.5, count + 0.5)
    axes.set_xticks(range(1, count + 1), [str(markers) for markers in errors])
    axes.set_yscale("log")
    axes.set_ylim(top=1.6 * max(uncorrected, *(row.max() for row in errors.values())))
    use_logarithm(axes)
    axes.grid(visible=False, axis="x")
    axes.set(xlabel="number of markers", ylabel="mean vertex error [mm]")
    return figure


def ablation_table(rows: Sequence[MarkerErrors], note: str = "") -> PageTable:
    """Returns the errors by number of markers."""
    body = [
        Row(str(row.markers), [Cell(number_text(getattr(row, key))) for key in _COLUMNS])
        for row in rows
    ]
    return PageTable("Markers", [*_COLUMNS.values()], body, note)


def _how_reconstructed(regularisation: float) -> str:
    return Markup(
        "Step by step from the known first state, with the force of least "
        "|markers&nbsp;–&nbsp;observed|<sup>2</sup> + "  # noqa: RUF001
        "λ&nbsp;|force|<sup>2</sup>, where λ is {}&nbsp;m²/N², free at every vertex. "
        "The published study uses "
        "1.0&nbsp;×&nbsp;10⁻⁴&nbsp;m²/N² for λ."  # noqa: RUF001
    ).format(number_text(regularisation))


def verdict(rows: Sequence[MarkerErrors], uncorrected: float) -> str:
    """Returns the number of markers needed for the published thresholds,
    and the uncorrected error [mm], in words.
    """
    needed = _markers_below(rows, "median_mm", 0.1)
    text = (
        "With none of these numbers of markers does the median error stay below 0.1 mm."
        if needed is None
        else f"With {needed} or more markers, the median error stays below 0.1 mm; the published "
        "reconstruction needs 4. The error of the uncorrected simulator is "
        f"{number_text(uncorrected)} mm."
    )
    narrow = _markers_below(rows, "interquartile_range_mm", 0.05)
    if narrow is not None:
        text += f" With {narrow} or more, the quartiles are less than 0.05 mm apart."
    return text.replace(" mm", f"{NO_BREAK_SPACE}mm")


def _markers_below(rows: Sequence[MarkerErrors], key: str, threshold: float) -> int | None:
    """The smallest number of markers from which on a value stays below a threshold."""
    above = max((row.markers for row in rows if not getattr(row, key) < threshold), default=0)
    return min((row.markers for row in rows if row.markers > above), default=None)
