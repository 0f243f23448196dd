"""The page of an identification from pictures: outlines on the pictures,
their distances, and the parameters.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..io.arrays import FloatArray
from ..io.errors import listed, number_of
from ..io.safe_files import read_array, read_hdf5
from ..learning.identification.search import Identification
from ..learning.parameters import TILTS
from ..report.identification_section import parameter_rows
from ..report.page import Block, Canvas, Cell, Drawn, PageTable, Part, Row, Text, Usage, write_page
from ..report.ranking import LEAST_EVIDENCE
from ..report.verdict import counted
from ..report.wording import NONE, TONES, in_a_row, mm_text, number_text, share_text
from ..settings.run import RunSettings
from .seen import NEUTRAL

_NAMES: Final = {"undeformed": "an undeformed body", "simulation": "the uncorrected simulator"}
_MODELS: Final = {"undeformed": "Undeformed", "simulation": "Uncorrected", "sysid": "Identified"}
_DRAWN: Final = {"simulation": TONES["simulation"].light, "sysid": "#35d0ff"}
_FIRST: Final = next(iter(_MODELS))
_CLOUD_PANEL: Final = 2.6  # inch
_CLOUD_MARGIN: Final = 0.04  # around a body, over its longer side
_BODY: Final = "#d3dde7"
_SHOWN: Final = 0.95  # of the points of clouds, whose distances are within the colours
_MARGIN: Final = 25  # px, around the body in a figure
_COVERED: Final = 0.5  # overlap, below which a fit has failed
_PANEL: Final = 3.6  # inch
_BETTER: Final = (
    0.9  # of the uncorrected distance, below which an identification makes a difference
)


@dataclass(frozen=True)
class PictureResult:
    """Distances of a pose's pictures from those of models, means over pictures by model.

    None where not measured.
    """

    pose: str
    material: str  # Its name; empty for one material.
    tested: bool  # Whether it was kept back from the identification.
    pictures: int  # Number of different pictures, of which the middle one is drawn.
    outline_mm: Mapping[str, float | None]  # Mean distance of the outlines, at the body's depth.
    outline_px: Mapping[str, float | None]
    overlap: Mapping[str, float | None]  # Common area over the area of both.
    cloud_mm: Mapping[str, float | None]  # Mean distance of scans and depths from the surface.
    points_mm: Mapping[str, float | None]  # Mean distance of the tracked points.

    @property
    def compared(self) -> str:
        """Kind of distance by which models are compared:
        outlines, else clouds, else tracked points.
        """
        kinds = {"outlines": self.outline_mm, "clouds": self.cloud_mm}
        return next(
            (kind for kind, values in kinds.items() if values["sysid"] is not None),
            "tracked points",
        )

    @property
    def drawn(self) -> int:
        """Number of the picture that is drawn; a scan is the last one."""
        return (self.pictures - 1) // 2

    def distance(self, model: str) -> float:
        """Distance by which models are compared [mm]."""
        value = {"outlines": self.outline_mm, "clouds": self.cloud_mm}.get(
            self.compared, self.points_mm
        )[model]
        return float("nan") if value is None else value


class PictureMetrics(Usage, total=False):
    """Content of metrics.json of a run with pictures."""

    poses: list[dict[str, Any]]  # `PictureResult`
    parameters: Mapping[str, float]  # identified


def picture_verdict(results: Sequence[PictureResult]) -> list[str]:
    """Returns what is best, by how much and on how many poses, and advice.

    Of poses of the training without others.
    """
    shown = [result for result in results if result.tested] or results
    errors = {model: _mean(shown, model) for model in _MODELS}
    best, second = sorted(
        ("sysid", min(_NAMES, key=lambda model: errors[model])), key=lambda model: errors[model]
    )
    lower = sum(result.distance(best) < result.distance(second) for result in shown)
    names = {"sysid": "the identified simulator", **_NAMES}
    share = share_text(1.0 - errors[best] / errors[second])
    which = "kept back" if shown[0].tested else "of the training"
    text = (
        f"{names[best]} has {share} less error than {names[second]} "
        f"({counted(lower, len(shown), 'pose')} {which})"
    )
    if len(shown) < LEAST_EVIDENCE or 2 * lower <= len(shown):
        both = in_a_row([f"{names[model]} {mm_text(errors[model])}" for model in (best, second)])
        text = f"no evidence either way: {number_of(len(shown), 'pose')} {which} ({both})"
    doubts = [] if shown[0].tested else ["no pose was kept back"]
    if abs(errors["sysid"] - errors["simulation"]) < (1.0 - _BETTER) * errors["simulation"]:
        doubts.append("these poses hardly depend on the material, and do not test it")
    lost = [
        result.pose
        for result in results
        if (common := result.overlap["sysid"]) is not None and common < _COVERED
    ]
    if lost:
        doubts.append(f"{listed(lost)} hardly overlap: check the camera, the mesh and the mask")
    advice = [f"Check before use: {'; '.join(doubts)}."] if doubts else []
    return [f"{text[0].upper()}{text[1:]}.", *advice]


def _mean(results: Sequence[PictureResult], model: str) -> float:
    """Mean distance of a model over poses [mm]."""
    return float(np.mean([result.distance(model) for result in results]))


def write_pictures_report(
    path: Path,
    metrics: PictureMetrics,
    run: RunSettings,
    identified: Identification,
    start: Mapping[str, float],
    outlines: Path,
    picture: Callable[[str, int], NDArray[np.uint8]],
) -> None:
    """Writes the page, see `write_page`.

    Args:
        path: of the page.
        metrics: of the run.
        run: its configuration.
        identified: the identification.
        start: values of the data sheet.
        outlines: file of the outlines.
        picture: returns the picture (H, W, 3) of a pose by its number.

    Raises:
        DataFileError: a file cannot be read or written.
    """
    results, settings = [PictureResult(**row) for row in metrics["poses"]], run.pictures
    assert settings is not None
    played, as_played = settings.simulated, {**dict.fromkeys(TILTS, 0.0), **NEUTRAL}
    truth = (
        {} if played is None else {**as_played, **start, **played.material, **played.corrections}
    )
    columns = ["Data sheet", "Identified", *(["True"] if truth else []), "At a bound"]
    panels = [
        (result, picture(result.pose, result.drawn))
        for result in results
        if result.outline_mm["sysid"] is not None
    ]
    clouds = [result for result in results if result.cloud_mm["sysid"] is not None]
    # Pictures without outlines are shown as well, where there is nothing else to see.
    panels = panels or [
        (result, picture(result.pose, result.drawn)) for result in results if not clouds
    ]
    up = [-np.array(settings.poses[result.pose].gravity or run.gravity) for result in clouds]

    def sections(canvas: Canvas) -> Iterator[Part]:
        drawn: list[Block] = (
            [draw_outlines(panels, outlines, canvas.folder / "outlines.png")] if panels else []
        )
        seen = list(zip(clouds, up, strict=True))
        drawn += [draw_clouds(seen, outlines, canvas.folder / "clouds.png")] if seen else []
        yield Part("", [*drawn, distance_table(results)])
        yield Part(
            "Identification",
            [PageTable("Parameter", columns, parameter_rows(identified, start, truth), _NOTE)],
        )
        yield Part("How it is compared", [Text(_HOW)])

    write_page(path, sections, run, picture_verdict(results), metrics)


_NOTE: Final = (
    "± is one standard deviation in the Gauss-Newton approximation, for distances that are "
    "correlated along the outlines."
)
_HOW: Final = (
    "A distance is the mean over both outlines of that to the closest point of the other, at the "
    "mean depth of the body; parts that a clamp hides do not count. The overlap is the common "
    "area over that of both together. The distance of a cloud is the mean over its points of "
    "that to the surface, of a depth image to its visible side; a point beyond the reach counts "
    "as one at it. What belongs to a pose alone, such as its place before the camera, is fitted "
    "to it for each of the models."
)


def distance_table(results: Sequence[PictureResult]) -> PageTable:
    """Returns the distances, with a row for each pose."""
    others = {"Overlap": "overlap", "Cloud [mm]": "cloud_mm", "Tracked points [mm]": "points_mm"}
    others = {
        name: key
        for name, key in others.items()
        if any(
            getattr(result, key)["sysid"] not in (None, result.distance("sysid"))
            for result in results
        )
    }
    rows = []
    for result in results:
        cells = [Cell(number_text(result.distance(model))) for model in _MODELS]
        cells += [Cell(_text(getattr(result, key)["sysid"])) for key in others.values()]
        rows.append(Row(result.pose, cells, "kept back" * result.tested, result.material))
    kinds = dict.fromkeys(result.compared for result in results)
    return PageTable(
        f"Pose; distance of {' or '.join(kinds)}",
        [*(f"{name} [mm]" for name in _MODELS.values()), *others],
        rows,
    )


def _text(value: float | None) -> str:
    return NONE if value is None else number_text(value)


def draw_outlines(
    panels: Sequence[tuple[PictureResult, NDArray[np.uint8]]], outlines: Path, path: Path
) -> Drawn:
    """Draws the outlines in a file on the middle picture (H, W, 3) of every pose, into a PNG file.

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
            group = f"{result.pose}/{result.drawn}"
            axis.set_title(f"{result.pose}{' (kept back)' * result.tested}")
            axis.imshow(image)
            if group not in file:
                continue
            measured = read_array(file, f"{group}/measured")
            axis.plot(
                *measured.T,
                linestyle="",
                marker=".",
                markersize=1.0,
                color="#ffffff",
                label="measured",
            )
            for model, colour in _DRAWN.items():
                points, weight = (
                    read_array(file, f"{group}/{model}{end}") for end in ("", "_weight")
                )
                points = points[weight > 0.0]
                axis.plot(
                    *points.T,
                    linestyle="",
                    marker=".",
                    markersize=0.9,
                    color=colour,
                    label=_MODELS[model].lower(),
                )
            low, high = _frame_of(measured, _MARGIN)
            axis.set_xlim(low[0], high[0])
            axis.set_ylim(high[1], low[1])
    handles, labels = axes[0].get_legend_handles_labels()
    if handles:
        legend = figure.legend(
            handles, labels, loc="outside lower center", ncols=3, frameon=True, markerscale=6
        )
        legend.get_frame().set_facecolor("#8a929b")
    figure.savefig(path, dpi=170)
    caption = (
        "The middle picture of each pose: the measured outline (white), and those of the "
        "uncorrected simulator, which has the parameters of the data sheet (orange), and of the "
        "identified one (blue), without what a clamp hides."
    )
    alt = "; ".join(
        f"{result.pose}: {_text(result.outline_mm['simulation'])} mm uncorrected, "
        f"{_text(result.outline_mm['sysid'])} mm identified"
        for result, _ in panels
    )
    return Drawn.of(path, f"Outlines on pictures. Mean distances: {alt}.", caption)


def draw_clouds(
    panels: Sequence[tuple[PictureResult, FloatArray]], outlines: Path, path: Path
) -> Drawn:
    """Draws the first cloud of every pose on the body of each model into a PNG file,
    in colours of the distance.

    Poses have the direction (3,) upwards.

    Raises:
        DataFileError: the file with the clouds is damaged.
    """
    clouds = list[tuple[PictureResult, list[tuple[FloatArray, ...]]]]()
    with read_hdf5(outlines, "outlines") as file:
        for result, up in panels:
            number = next(
                frame
                for frame in file[result.pose]
                if f"{_FIRST}_places" in file[f"{result.pose}/{frame}"]
            )
            clouds.append((result, _seen_from_the_side(file[f"{result.pose}/{number}"], up)))
    identified = chain.from_iterable(seen[1:] for _, seen in clouds)
    most = max(float(np.quantile(distances, _SHOWN)) for _, distances, _ in identified)
    figure = Figure(
        figsize=(len(_MODELS) * _CLOUD_PANEL, len(clouds) * _CLOUD_PANEL * 0.8),
        layout="constrained",
    )
    axes = figure.subplots(len(clouds), len(_MODELS), squeeze=False)
    dots = None
    for (result, seen), row in zip(clouds, axes, strict=True):
        drawn = chain.from_iterable((places, body) for places, _, body in seen)
        ends = np.concatenate([part.reshape(-1, 2) for part in drawn])
        low, high = _frame_of(ends, _CLOUD_MARGIN * float(np.ptp(ends, axis=0).max()))
        for model, axis, (places, distances, body) in zip(_MODELS, row, seen, strict=True):
            axis.add_collection(
                PolyCollection([*body], facecolors=_BODY, edgecolors=_BODY, linewidths=0.3)
            )
            dots = axis.scatter(
                *places.T, c=distances, s=2.5, cmap="viridis", vmin=0.0, vmax=most, linewidths=0
            )
            axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
            axis.set_axis_off()
            axis.set_title(
                f"{result.pose}{' (kept back)' * result.tested}\n{_MODELS[model].lower()}: "
                f"{_text(result.cloud_mm[model])} mm"
            )
    if dots is not None:
        bar = figure.colorbar(dots, ax=axes, location="bottom", shrink=0.5, aspect=40, extend="max")
        bar.set_label("distance of a point from the surface [mm]")
    figure.savefig(path, dpi=170)
    caption = (
        "Measured points on the simulated body (grey) as seen from the side, above with the mean "
        "of their distances: the undeformed body, the simulator with the parameters of the data "
        "sheet, and the identified one."
    )
    texts = []
    for result, _ in panels:
        distances_mm = ", ".join(_text(result.cloud_mm[model]) for model in _MODELS)
        texts.append(f"{result.pose}: {distances_mm} mm")
    alt = "; ".join(texts)
    return Drawn.of(
        path, f"Clouds of points on bodies. Mean distances of the three models: {alt}.", caption
    )


def _seen_from_the_side(group: h5py.Group, up: FloatArray) -> list[tuple[FloatArray, ...]]:
    """The points (P, 2) of a cloud, their distances (P,) [mm]
    and the triangles (F, 3, 2) of the body, by model.

    They are seen along the horizontal direction in which the body is thinnest.
    """
    triangles, shape = read_array(group, "triangles"), read_array(group, f"{_FIRST}_surface")
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    level = np.eye(3) - np.outer(up, up)
    axes = np.stack([np.linalg.eigh(level @ np.cov(shape.T) @ level)[1][:, -1], up], 1)
    seen = list[tuple[FloatArray, ...]]()
    for model in _MODELS:
        places = read_array(group, f"{model}_places")
        distances = read_array(group, f"{model}_distances")
        surface = read_array(group, f"{model}_surface")
        seen.append((places @ axes, 1e3 * distances, surface[triangles] @ axes))
    return seen


def _frame_of(points: FloatArray, margin: float) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest coordinates (2,) of a frame of 4 to 3 around points (P, 2)."""
    low, high = points.min(0) - margin, points.max(0) + margin
    half = 0.5 * np.maximum(high - low, (high - low)[::-1] * np.array([4.0 / 3.0, 0.75]))
    middle = 0.5 * (low + high)
    return middle - half, middle + half
