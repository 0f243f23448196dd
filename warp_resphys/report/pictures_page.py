"""The page of an identification from pictures: outlines on the pictures, their distances, and the parameters."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..io.files import read_array, read_hdf5
from ..settings.run import RunSettings
from .figures import TONES, FloatArray, in_style
from .identification_section import parameter_rows
from .page import (
    NO_BREAK_SPACE,
    NONE,
    Canvas,
    Cell,
    Drawn,
    PageTable,
    Part,
    Row,
    Text,
    drawn_file,
    experiment_kicker,
    figures_beside,
    number_text,
    write_page,
)

log = logging.getLogger(__name__)

_MODELS: Final = {"undeformed": "Undeformed", "simulation": "Uncorrected", "sysid": "Identified"}
_DRAWN: Final = {"simulation": TONES["simulation"].light, "sysid": "#35d0ff"}
_MARGIN: Final = 25  # px, around the body in a figure
_COVERED: Final = 0.5  # overlap, below which a fit has failed
_PANEL: Final = 3.6  # inch
_BETTER: Final = 0.9  # of the uncorrected distance, below which an identification makes a difference


@dataclass(frozen=True)
class PictureResult:
    """Distances of a pose's pictures from those of models, means over its pictures by model; None where not measured.

    Attributes:
        pose: name.
        material: name; empty for one material.
        tested: whether it was kept back from the identification.
        pictures: number of different pictures.
        outline_mm: mean distance of the outlines, both ways, at the depth of the body.
        outline_px: the same in pixels.
        overlap: common area over the area of both.
        points_mm: mean distance of the tracked points.
    """

    pose: str
    material: str
    tested: bool
    pictures: int
    outline_mm: Mapping[str, float | None]
    outline_px: Mapping[str, float | None]
    overlap: Mapping[str, float | None]
    points_mm: Mapping[str, float | None]

    def distance(self, model: str) -> float:
        """Distance by which models are compared [mm]: of the outlines, or of the points where there are none."""
        value = self.outline_mm[model] if self.outline_mm[model] is not None else self.points_mm[model]
        return float("nan") if value is None else value


def picture_verdict(results: Sequence[PictureResult]) -> str:
    """Returns what the identification is worth, by the poses that were kept back; by those of training without any."""
    tested, trained = ([own for own in results if own.tested == kept] for kept in (True, False))
    shown = tested or trained
    undeformed, uncorrected, identified = (_mean(shown, model) for model in _MODELS)
    count = f"{len(shown)} pose{'s' * (len(shown) > 1)}"
    which = f"{count} kept back" if tested else f"{count} of training (none was kept back)"
    text = (
        f"In {which} the simulated pictures are {number_text(identified)} mm from the measured ones with the "
        f"identified parameters, {number_text(uncorrected)} mm with those of the data sheet, and "
        f"{number_text(undeformed)} mm with an undeformed body; in each, the place of the body before the camera is "
        "fitted to the picture."
    )
    if abs(identified - uncorrected) < (1.0 - _BETTER) * uncorrected:
        text += " With both materials it is nearly the same: these poses hardly depend on it, and do not test it."
    elif not identified < min(uncorrected, undeformed):
        text += " The identification is no better than what needs none."
    if tested and trained:
        own, sheet, rigid = (number_text(_mean(trained, model)) for model in ("sysid", "simulation", "undeformed"))
        text += f" In training the three are {own}, {sheet} and {rigid} mm."
    if lost := [own.pose for own in results if (share := own.overlap["sysid"]) is not None and share < _COVERED]:
        text += (
            f" {' and '.join(lost)} {'is' if len(lost) == 1 else 'are'} hardly seen where it was simulated: check the "
            "camera, the mesh and the mask."
        )
    return text.replace(" mm", f"{NO_BREAK_SPACE}mm")


def _mean(results: Sequence[PictureResult], model: str) -> float:
    """Mean distance of a model over poses [mm]."""
    return float(np.mean([result.distance(model) for result in results]))


def write_pictures_report(
    path: Path,
    metrics: Mapping[str, Any],
    run: RunSettings,
    identified: Mapping[str, Any],
    start: Mapping[str, float],
    outlines: Path,
    picture: Callable[[str, int], NDArray[np.uint8]],
) -> None:
    """Writes the page, and its figure into `figures/` beside it.

    Args:
        path: of the page.
        metrics: of the run, with `poses`.
        run: its configuration.
        identified: the identification.
        start: values of the data sheet.
        outlines: file of the outlines.
        picture: returns the picture (H, W, 3) of a pose by its number.

    Raises:
        DataFileError: a file cannot be read or written.
    """
    results = [PictureResult(**row) for row in metrics["poses"]]
    assert run.pictures is not None
    played = run.pictures.simulated
    truth = {} if played is None else {**start, **played.material, **played.corrections}
    parameters = PageTable(
        "Parameter",
        ["Data sheet", "Identified", *(["True"] if truth else []), "At a bound"],
        parameter_rows(identified, start, truth),
        "± is one standard deviation in the Gauss-Newton approximation, for distances that are correlated along the "
        "outlines.",
    )
    with figures_beside(path) as folder:
        panels = [(result, picture(result.pose, 0)) for result in results]
        drawn = Canvas(folder).attempt("outlines.png", partial(draw_outlines, panels, outlines))
    write_page(
        path,
        [
            Part("", [*drawn, _distances(results)]),
            Part("Identification", [parameters]),
            Part("How it is compared", [Text(_HOW)]),
        ],
        title=run.title,
        kicker=experiment_kicker(run.name),
        verdict=picture_verdict(results),
        metrics=metrics,
        settings=run.plain(),
    )
    log.info("report written: %s", path)


_HOW: Final = (
    "A distance is the mean over both outlines of that to the closest point of the other, at the mean depth of the "
    "body; parts that a clamp hides do not count. The overlap is the common area over that of both together. What "
    "belongs to a pose alone, such as its place before the camera, is fitted to it for each of the models."
)


def _distances(results: Sequence[PictureResult]) -> PageTable:
    """Table of the distances, with a row for each pose."""
    by_points = any(result.points_mm["sysid"] is not None for result in results)
    columns = [
        *(f"{name} [mm]" for name in _MODELS.values()),
        "Overlap",
        *(["Tracked points [mm]"] if by_points else []),
    ]
    rows = []
    for result in results:
        cells = [Cell(_text(result.outline_mm[model])) for model in _MODELS]
        cells += [Cell(_text(result.overlap["sysid"]))]
        cells += [Cell(_text(result.points_mm["sysid"]))] if by_points else []
        small = f"{result.material}{', ' * bool(result.material)}{'kept back' if result.tested else 'training'}"
        rows.append(Row(result.pose, cells, answer=result.tested, small=small))
    return PageTable("Pose", columns, rows)


def _text(value: float | None) -> str:
    return NONE if value is None else number_text(value)


@in_style()
def draw_outlines(panels: Sequence[tuple[PictureResult, NDArray[np.uint8]]], outlines: Path, path: Path) -> Drawn:
    """Draws the outlines on the first picture of every pose into a PNG file.

    Args:
        panels: results with their pictures (H, W, 3).
        outlines: file of the outlines.
        path: of the PNG file.

    Raises:
        DataFileError: the file of the outlines is damaged.
    """
    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(columns * _PANEL, rows * _PANEL * 0.75), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    for axis in axes:
        axis.set_axis_off()
    with read_hdf5(outlines, "outlines") as file:
        for axis, (result, image) in zip(axes, panels, strict=False):
            group = f"{result.pose}/0"
            axis.set_title(f"{result.pose}{' (kept back)' * result.tested}")
            axis.imshow(image)
            if group not in file:
                continue
            measured = read_array(file, f"{group}/measured")
            axis.plot(*measured.T, linestyle="", marker=".", markersize=1.0, color="#ffffff", label="measured")
            for model, colour in _DRAWN.items():
                points, weight = (read_array(file, f"{group}/{model}{end}") for end in ("", "_weight"))
                points = points[weight > 0.0]
                axis.plot(
                    *points.T, linestyle="", marker=".", markersize=0.9, color=colour, label=_MODELS[model].lower()
                )
            low, high = _frame(measured)
            axis.set_xlim(low[0], high[0])
            axis.set_ylim(high[1], low[1])
    handles, labels = axes[0].get_legend_handles_labels()
    if handles:
        legend = figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=True, markerscale=6)
        legend.get_frame().set_facecolor("#8a929b")
    figure.savefig(path, dpi=170)
    caption = (
        "The first picture of each pose: the measured outline (white), and those of the uncorrected simulator, which "
        "has the parameters of the data sheet (orange), and of the identified one (blue), without what a clamp hides."
    )
    alt = "; ".join(
        f"{result.pose}: {_text(result.outline_mm['simulation'])} mm uncorrected, "
        f"{_text(result.outline_mm['sysid'])} mm identified"
        for result, _ in panels
    )
    return drawn_file(path, f"Outlines on pictures. Mean distances: {alt}.", caption)


def _frame(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest coordinates (2,) of a frame of 4 to 3 around points [px]."""
    low, high = points.min(0) - _MARGIN, points.max(0) + _MARGIN
    half = 0.5 * np.maximum(high - low, (high - low)[::-1] * np.array([4.0 / 3.0, 0.75]))
    middle = 0.5 * (low + high)
    return middle - half, middle + half
