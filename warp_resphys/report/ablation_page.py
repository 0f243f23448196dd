"""The report of the marker ablation: one HTML page that needs nothing beside it, and its figure as a PNG file."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..io.files import write_text
from .figures import TONES, FloatArray, in_style, new_figure, use_logarithm
from .page import (
    NO_BREAK_SPACE,
    draw_picture,
    duration_text,
    figures_beside,
    flatten,
    number_text,
    page_template,
)

_LOG = logging.getLogger(__name__)
FIGURE = "marker_ablation"


@dataclass(frozen=True)
class AblationReport:
    """Everything that the page shows."""

    title: str  # The page's heading.
    experiment: str  # Its name.
    metrics: Mapping[str, Any]  # `uncorrected_mm`, `by_markers` (a row a number of markers), resources and versions.
    settings: Mapping[str, Any]  # The run's configuration, nested.
    vertices: int  # Of the mesh.
    surface: int  # Those on its surface.
    free_surface: int  # Those of them that are not clamped.


def write_ablation_report(path: Path, data: AblationReport) -> None:
    """Write the page, and its figure into `figures/` beside it.

    Args:
        path: The page's file, such as `report.html`; missing folders are made.
        data: What to show.

    Raises:
        DataFileError: A file could not be written.
    """
    with figures_beside(path) as folder:
        draw = partial(marker_boxes, box_errors(data.metrics), data.metrics["uncorrected_mm"])
        picture = draw_picture(folder, FIGURE, draw, describe_boxes(data.metrics))
    rows = data.metrics["by_markers"]
    page = page_template("ablation.html").render(
        title=data.title,
        data=data,
        metrics=data.metrics,
        pictures={FIGURE: picture},
        verdict=verdict(rows, data.metrics["uncorrected_mm"]),
        clamped=[row["markers"] for row in rows if row["markers"] > data.free_surface],
        number=number_text,
        duration=duration_text,
        settings=list(flatten(data.settings)),
    )
    write_text(path, page)
    _LOG.info("report written: %s", path)


def verdict(rows: Sequence[Mapping[str, Any]], uncorrected: float) -> str:
    """Say from how many markers on the error stays below the published thresholds; uncorrected, it is this many mm."""
    enough = _from_here_on(rows, "median_mm", 0.1)
    said = (
        "With none of these numbers of markers does the median error stay below 0.1 mm."
        if enough is None
        else f"From {enough} marker{'s' if enough > 1 else ''} on, the median error stays below 0.1 mm, that of the "
        f"published reconstruction from 4 markers on. The uncorrected simulation is {number_text(uncorrected)} mm off."
    )
    narrow = _from_here_on(rows, "interquartile_range_mm", 0.05)
    if narrow is not None:
        said += f" The quartiles lie less than 0.05 mm apart from {narrow} marker{'s' if narrow > 1 else ''} on."
    return said.replace(" mm", f"{NO_BREAK_SPACE}mm")


def _from_here_on(rows: Sequence[Mapping[str, Any]], key: str, below: float) -> int | None:
    """The smallest number of markers from which on a value stays below a threshold."""
    found = None
    for row in sorted(rows, key=lambda row: -int(row["markers"])):
        if not row[key] < below:
            break
        found = int(row["markers"])
    return found


def box_errors(metrics: Mapping[str, Any]) -> dict[int, FloatArray]:
    """Return the draws' errors [mm] by number of markers."""
    return {int(row["markers"]): np.array(row["errors_mm"]) for row in metrics["by_markers"]}


def describe_boxes(metrics: Mapping[str, Any]) -> str:
    """Say what the box plot shows, by `by_markers`."""
    medians = "; ".join(f"{row['markers']}: {number_text(row['median_mm'])} mm" for row in metrics["by_markers"])
    return f"Box plot of the mean vertex error by number of markers, on a logarithmic axis. Medians: {medians}."


@in_style()
def marker_boxes(
    errors: Mapping[int, FloatArray], uncorrected: float, published: tuple[int, float] | None = None, *, narrow: bool
) -> Figure:
    """Draw a box for each number of markers: median, quartiles, and whiskers to the smallest and largest draw.

    Args:
        errors: (D,) errors [mm] of the draws, by number of markers.
        uncorrected: Error without any correction [mm].
        published: From which number of markers on the published median is below what error [mm].
        narrow: Whether the figure is for a narrow page.
    """
    ink: dict[str, Any] = {"color": TONES["ink"].light, "linewidth": 0.9}
    median = {"color": TONES["simulation"].light, "linewidth": 2.0}
    figure = new_figure(3.6, 3.4, narrow=narrow)
    axes, count = figure.subplots(), len(errors)
    lines: Any = {"boxprops": ink, "whiskerprops": ink, "capprops": ink, "medianprops": median}
    axes.boxplot([*errors.values()], widths=0.55, whis=(0, 100), **lines)
    levels = {"uncorrected simulation": (0.5, uncorrected)}
    if published is not None:
        start = 0.5 + sum(markers < published[0] for markers in errors)
        levels["published median: below" if narrow else "published: the median is below"] = (start, published[1])
    for text, (start, level) in levels.items():
        grey = TONES["muted"].light
        axes.plot([start, count + 0.5], [level, level], color=grey, linewidth=1.1, linestyle="--")
        axes.annotate(text, (count + 0.5, level), (-2, 3), textcoords="offset points", ha="right", color=grey)
    axes.set_xlim(0.5, count + 0.5)
    axes.set_xticks(range(1, count + 1), [str(markers) for markers in errors])
    axes.set_yscale("log")
    axes.set_ylim(top=1.6 * max(uncorrected, *(row.max() for row in errors.values())))
    use_logarithm(axes)
    axes.grid(visible=False, axis="x")
    axes.set(xlabel="number of markers", ylabel="mean vertex error [mm]")
    return figure
