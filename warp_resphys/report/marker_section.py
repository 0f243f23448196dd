"""The section on markers: their coordinates over time, of driven bodies with the inputs."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from ..learning.baselines import BASELINES
from ..learning.intervals import Intervals
from .data import (
    Driven,
    FloatArray,
    RunReport,
    TrialResults,
    best_and_worst,
    drawn_markers,
    shown_markers,
)
from .page import Canvas, Drawn, Part, mm_text

# Models whose coordinates are drawn, as more would overlap.
_DRAWN: Final = (*BASELINES, "simulation", "sysid", "law", "simfree", "resphys")
_CALIBRATED: Final = {  # Source of prediction intervals.
    "validation": "the errors in the validation trials",
    "training": "the errors in the training trials, which tend to be too small",
    "left_out": "the errors in the training trials, with the parameters identified without each of them",
    "folds": "the errors of the other folds",
}
_MOST_MARKERS: Final = 6  # Markers whose coordinates are drawn.


def paths_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Return the coordinates of the markers over time."""
    trials = data.trials
    if trials is None or not trials.labels or not trials.moves:
        return None
    places = dict(zip(("worst", "best"), best_and_worst(trials), strict=False))
    which = {"worst": "", "best": ""}
    if len(places) > 1:
        which["worst"] = ", in which the last model of the table has its largest error"
        which["best"] = ", in which the same model has its least error"
    if data.driven is None:
        drawn = [_coordinates(data, trials, row, at, which[at], canvas) for at, row in places.items()]
        return Part("Marker by marker", drawn)
    return Part("Marker by marker", [_driven_markers(data, trials, places["worst"], data.driven, canvas)])


def _coordinates(data: RunReport, trials: TrialResults, row: int, place: str, which: str, canvas: Canvas) -> Drawn:
    """Draws the coordinates of the markers that move most."""
    reach = np.nanmax(np.linalg.norm(trials.target[row] - trials.bound, axis=2), axis=0, initial=0.0)
    shown = shown_markers(trials.target[row])
    kept = np.sort(shown[np.argsort(-reach[shown])[:_MOST_MARKERS]]).tolist()
    name, hidden = trials.names[row], len(shown) - len(kept)
    models = [m for m in _DRAWN if m in trials.positions]
    bands = _bands(data, trials, row, kept)
    return canvas.figure(
        f"paths_{place}",
        _paths(trials, row, kept, models, trials.bound, bands),
        f"Coordinates of the markers over time in the trial {name}: measured as dots, the models as lines.",
        f"Trial {name}{which}: coordinates of the markers relative to where they were held.{_band_note(data, bands)}"
        + (f" The {hidden} markers that move least are not drawn." if hidden else ""),
    )


def _driven_markers(data: RunReport, trials: TrialResults, row: int, driven: Driven, canvas: Canvas) -> Drawn:
    """Draws the coordinates of markers and, below them, the inputs."""
    name, words, per = trials.names[row], driven.quantity.plural, driven.quantity.per
    kept = drawn_markers(trials.target[row], trials.bound, data.mesh.vertices[data.fixed])
    models = [m for m in _DRAWN if m in trials.positions and m != "simulation"] or list(trials.positions)
    own, bands = replace(driven, values={words.capitalize(): driven.values[name]}), _bands(data, trials, row, kept)
    return canvas.figure(
        "markers",
        _paths(trials, row, kept, models, _start(trials, row), bands, own),
        f"Coordinates of markers over time in the trial {name}, and below them the {words} of the {per}s.",
        f"The trial {name}: displacement of markers from rest, and the {words} that drive it.{_band_note(data, bands)}",
    )


def _paths(
    trials: TrialResults,
    row: int,
    kept: Sequence[int],
    models: Sequence[str],
    start: FloatArray,
    bands: Mapping[str, FloatArray],
    driven: Driven | None = None,
) -> partial[Any]:
    """Prepares the figure of some markers of a trial, measured and by model, relative to their start (M, 3) [m]."""
    from . import motion_figures

    target, *moved = ((q[row] - start)[:, kept] for q in (trials.target, *(trials.positions[m] for m in models)))
    labels, series = [trials.labels[marker] for marker in kept], dict(zip(models, moved, strict=True))
    shown = (trials.times[row], target, series, labels, driven)
    return partial(motion_figures.marker_paths, *shown, coordinates=trials.axes, bands=bands)


def _bands(data: RunReport, trials: TrialResults, row: int, kept: Sequence[int]) -> dict[str, FloatArray]:
    """Half-widths (T, M) [m] of the prediction intervals of some markers, of the last model with intervals."""
    intervals = data.metrics.get("intervals", {}).get("models", {})
    since = None if trials.since is None else trials.since[row]
    for model in ("resphys", "law", "sysid"):
        own = Intervals.from_plain(intervals.get(model))
        if own is not None and model in trials.positions:
            spread = trials.spreads[model][row] if model in trials.spreads else None
            return {model: own.half_widths(trials.positions[model][row], trials.bound, since, spread)[:, kept]}
    return {}


def _band_note(data: RunReport, bands: Mapping[str, FloatArray]) -> str:
    """What the prediction intervals of the drawn band should contain, and what they contain in all test trials."""
    if not bands:
        return ""
    intervals = data.metrics["intervals"]
    (own,) = (intervals["models"][model] for model in bands)
    return (
        f" The band should contain {100.0 * intervals['level']:.0f} % of the measured coordinates, and contains "
        f"{100.0 * own['coverage']:.0f} % of them; it is ± {mm_text(own['half_width_mm'])} wide on average, from "
        f"{_CALIBRATED[intervals['calibrated_on']]}."
    )


def _start(trials: TrialResults, row: int) -> FloatArray:
    """First measured positions (M, 3) of the markers [m]."""
    first = trials.target[row, 0]
    return np.where(np.isfinite(first), first, trials.bound)
