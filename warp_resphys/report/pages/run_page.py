"""The page of a run, of a fold or over folds: the errors, then sections on its other results."""

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final

from markupsafe import Markup

from ...io.errors import number_of
from ..actuator_section import actuator_section
from ..body_section import body_section, paths_section
from ..conditions import conditions
from ..control_section import control_section
from ..data import Metrics, RunReport, folds_in, trial_errors
from ..error_section import error_section, training_section
from ..identification_section import identification_section
from ..law_section import law_section
from ..motion_section import motion_section
from ..page import Canvas, Cell, PageTable, Part, Row, Text, write_page
from ..ranking import LEAST_TRIALS
from ..sections import (
    details_table,
    horizons_section,
    quality_section,
    registration_section,
    shapes_section,
    trials_section,
)
from ..verdict import results_table, verdict
from ..wording import MODELS, mm_text, unbroken

_WITHOUT_RECORDINGS: Final = Markup(
    "No recordings are configured (<code>data.folder</code>): the measurements are simulated, "
    "with noise on the markers, by the body that the settings below have as "
    "<code>laboratory</code>."
)
# By what is observed: how the published errors differ from those of this run.
_PUBLISHED_FOR: Final = {
    "vertices": "Published errors are measured against the reconstructed trajectories, ours "
    "against the target; the published simulator doubles the beam's mass and locks, "
    "as physics=published does.",
    "beam": "The published errors are for other recordings, with ten markers and a weight that "
    "is cut off at the release, and are measured against trajectories reconstructed from "
    "them.",
    "arm": "The published errors are for the published simulator, of 494 vertices, on the "
    "authors' recordings.",
}
_MOST_LABELS: Final = 6  # Markers that are named one by one.


def write_report(path: Path, data: RunReport) -> None:
    """Writes the page, such as `report.html`, see `write_page`."""
    said, holds = verdict(data.metrics, data.settings), conditions(data.metrics, data.settings)
    write_page(
        path,
        lambda canvas: (s(data, canvas) for s in SECTIONS),
        data.settings,
        said,
        data.metrics,
        holds,
    )


def results_section(data: RunReport, canvas: Canvas) -> Part:
    """Returns the mean errors of the models."""
    return Part("", [results_table(data.metrics, data.settings)])


def details_section(data: RunReport, canvas: Canvas) -> Part:
    """Returns the errors of all models beside the published ones,
    their definition, and the trials beyond training.
    """
    synthetic = "laboratory" in data.settings.targets
    blocks: list[Any] = [Text(_WITHOUT_RECORDINGS, "synthetic")] if synthetic else []
    blocks += [
        details_table(data.metrics, data.settings),
        Text(_what_is_measured(data), "what", note=True),
    ]
    ranges = range_table(data.metrics, () if data.trials is None else data.trials.names)
    blocks += [] if ranges is None else [ranges]
    return Part("Errors in detail", blocks)


def _what_is_measured(data: RunReport) -> str:
    """Definition of the errors, with notes on their contributions."""
    trials, seconds = data.trials, data.settings.trial_seconds
    of, others = (
        ("markers", "the measured ones")
        if data.sees_markers
        else ("vertices", "those of the target")
    )
    over, deviation = "the folds, each with one test trial", "the folds’ means"  # noqa: RUF001
    if trials is not None:
        labels = trials.labels
        steps = trials.target.shape[1] - ("given" in trials.begins and trials.moves)
        named = (
            f"the markers {', '.join(labels)}"
            if 1 < len(labels) <= _MOST_LABELS
            else number_of(len(labels), "marker")
        )
        length = (
            f" of {trials.times.max():g} s" if labels and trials.moves and seconds is None else ""
        )
        points = (
            f" and {named}"
            if labels
            else f", {number_of(steps, 'step')} and {len(data.mesh.vertices)} vertices"
        )
        over = f"{number_of(len(trials.names), 'test trial')}{length}{points}"
        deviation = "single frames"
    first = "" if seconds is None else f", of which the first {seconds:g} s after the release count"
    text = (
        f"Distance of the simulated {of} from {others}: mean over {over}{first}; every trial "
        f"counts alike. ± is the standard deviation of {deviation}."
    )
    release = data.settings.release
    if trials is not None and {"rest", "driven"} & {*trials.begins} and release.delay > 0.0:
        text += (
            " The instant at which the inputs of a trial act is estimated with each model, from "
            f"the markers of its first {release.window:g} s and within an expected "
            f"{1e3 * release.delay:g} ms of the detected one, also in test trials."
        )
    reconstructed = data.metrics.get("reconstruction", {})
    learned = [
        f"The reconstruction for {MODELS[model].name} leaves the {of} of the training trials at "
        f"a mean distance of {mm_text(result['mean_mm'])} from the observed ones, "
        f"{mm_text(result['max_mm'])} at most."
        for model, result in reconstructed.items()
    ]
    kind = (
        "arm" if data.settings.chambers is not None else "beam" if data.sees_markers else "vertices"
    )
    learned += [_PUBLISHED_FOR[kind]] if data.published else []
    many = len(next(iter(trial_errors(data.metrics).values()), ())) >= LEAST_TRIALS
    text += " Interval: of the mean, over draws of the trials." if many else ""
    return unbroken(" ".join([text, *_contributions(data.metrics), *learned]))


def _contributions(metrics: Metrics) -> list[str]:
    """Sentences on how bodies were held, and on the contribution of noise to errors, if known."""
    notes = []
    of_folds = (fold.get("sideways_mm", {}) for fold in folds_in(metrics))
    sideways = dict(chain.from_iterable(of_fold.items() for of_fold in of_folds))
    if sideways:
        distances = ", ".join(
            f"{mm_text(distance)} ({trial})" for trial, distance in sideways.items()
        )
        notes.append(
            "The sideways displacement of the held body is estimated from the first frames of a "
            f"trial: with the identified simulator, the markers by {distances}."
        )
    if "noise_mm" in metrics:
        notes.append(f"The noise of the markers alone is {metrics['noise_mm']:.2f} mm.")
    return notes


def range_table(metrics: Metrics, trials: Sequence[str]) -> PageTable | None:
    """Returns how many roll-outs left the training range, and when the first one did.

    None where it is not known.

    Args:
        metrics: With `range`, by model, whose `first_s` has the times [s] at which trials left; and
            `scales_range`, the same by scale of the inputs. Both may be missing.
        trials: Names of the test trials.
    """
    scales = {
        scale: left
        for scale, left in metrics.get("scales_range", {}).items()
        if float(scale) != 1.0
    }
    columns = {
        f"Inputs \N{MULTIPLICATION SIGN} {float(scale):g}": scales[scale]
        for scale in sorted(scales, key=float)
    }
    columns = {"Of the test trials": metrics.get("range", {}), **columns}

    def cell(first: Mapping[str, float]) -> Cell:
        earliest = min(first, key=lambda trial: first[trial], default="")
        when = f"after {first[earliest]:.2f} s ({earliest})" if earliest and first[earliest] else ""
        if first and not any(first.values()):
            more = f" and {len(first) - 2} more" if len(first) > 2 else ""
            when = f"from the start ({', '.join([*first][:2])}{more})"
        return Cell(f"{len(first) or 'none'} of {len(trials)}", unbroken(when))

    models = [model for model in MODELS if model in metrics.get("range", {})]
    rows = [
        Row(MODELS[m].name, [cell(left[m]["first_s"]) for left in columns.values()]) for m in models
    ]
    fades = (
        any(metrics["range"][m]["first_s"] for m in models if m == "resphys")
        and "law" in metrics["errors_mm"]
    )
    note = "Small: when the first of them left."
    note += " There the learned force of ResPhys fades out, and the law remains." if fades else ""
    return (
        PageTable("Roll-outs that left the training range", [*columns], rows, note)
        if rows
        else None
    )


SECTIONS: Final[tuple[Callable[[RunReport, Canvas], Part | None], ...]] = (
    results_section,
    motion_section,
    details_section,
    horizons_section,
    error_section,
    trials_section,
    control_section,
    paths_section,
    body_section,
    identification_section,
    law_section,
    actuator_section,
    shapes_section,
    registration_section,
    quality_section,
    training_section,
)
