"""The page of a run, of a fold or over the folds: the errors, then sections on its other results."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from markupsafe import Markup

from ..io.errors import number_of
from .body_section import body_section, paths_section
from .control_section import control_section
from .data import RunReport, folds_in, trial_errors
from .error_section import error_section, training_section
from .identification_section import identification_section
from .law_section import law_section
from .motion_section import motion_section
from .page import Canvas, Items, Part, Text, write_page
from .sections import (
    details_table,
    horizons_section,
    quality_section,
    registration_section,
    shapes_section,
    trials_section,
)
from .verdict import LEAST_TRIALS, results_table, verdict
from .wording import MODELS, mm_text, unbroken

_WITHOUT_RECORDINGS: Final = Markup(
    "No recordings are configured (<code>data.folder</code>): the measurements are simulated, with noise on the "
    "markers, by the body that the settings below have as <code>laboratory</code>."
)
_PUBLISHED_FOR: Final = {  # By what is observed: how the published errors differ from those of this run.
    "vertices": "Published errors are measured against the reconstructed trajectories, ours against the target; the "
    "published simulator doubles the beam's mass and locks, as physics=published does.",
    "beam": "The published errors are for other recordings, with ten markers and a weight that is cut off at the "
    "release, and are measured against trajectories reconstructed from them.",
    "arm": "The published errors are for the published simulator, of 494 vertices, on the authors' recordings.",
}
_MOST_LABELS: Final = 6  # Markers that are named one by one.


def write_report(path: Path, data: RunReport) -> None:
    """Writes the page, see `write_page`.

    Args:
        path: The page's file, such as `report.html`.
        data: Data of the page.
    """
    said = verdict(data.metrics, data.settings)
    write_page(path, lambda canvas: (s(data, canvas) for s in SECTIONS), data.settings, said, data.metrics)


def results_section(data: RunReport, canvas: Canvas) -> Part:
    """Returns the mean errors of the models."""
    return Part("", [results_table(data.metrics, data.settings)])


def details_section(data: RunReport, canvas: Canvas) -> Part:
    """Returns the errors of all models beside the published ones, their definition, and the trials beyond training."""
    synthetic = "laboratory" in data.settings.targets
    blocks: list[Any] = [Text(_WITHOUT_RECORDINGS, "synthetic")] if synthetic else []
    blocks += [details_table(data.metrics, data.settings), Text(_what_is_measured(data), "what", note=True)]
    if ranges := range_texts(data.metrics, [] if data.trials is None else data.trials.names):
        blocks.append(Text("Roll-outs outside the training range", heading=True))
        blocks.append(Items(ranges, "ranges"))
    return Part("Errors in detail", blocks)


def _what_is_measured(data: RunReport) -> str:
    """Definition of the errors, with notes on their contributions."""
    trials, seconds = data.trials, data.settings.trial_seconds
    of, others = ("markers", "the measured ones") if data.sees_markers else ("vertices", "those of the target")
    over, deviation = "the folds, each with one test trial", "the folds’ means"  # noqa: RUF001
    if trials is not None:
        labels, steps = trials.labels, trials.target.shape[1] - ("given" in trials.begins and trials.moves)
        named = (
            f"the markers {', '.join(labels)}" if 1 < len(labels) <= _MOST_LABELS else number_of(len(labels), "marker")
        )
        length = f" of {trials.times.max():g} s" if labels and trials.moves and seconds is None else ""
        points = f" and {named}" if labels else f", {number_of(steps, 'step')} and {len(data.mesh.vertices)} vertices"
        over, deviation = f"{number_of(len(trials.names), 'test trial')}{length}{points}", "single frames"
    first = "" if seconds is None else f", of which the first {seconds:g} s after the release count"
    text = (
        f"Distance of the simulated {of} from {others}: mean over {over}{first}; every trial counts alike. ± is the "
        f"standard deviation of {deviation}."
    )
    release = data.settings.release
    if trials is not None and {"rest", "driven"} & {*trials.begins} and release.delay > 0.0:
        text += (
            " The instant at which the inputs of a trial act is estimated with each model, from the markers of its "
            f"first {release.window:g} s and within an expected {1e3 * release.delay:g} ms of the detected one, also "
            "in test trials."
        )
    reconstructed = data.metrics.get("reconstruction", {})
    learned = [
        f"The reconstruction for {MODELS[model].name} leaves the {of} of the training trials at a mean distance of "
        f"{mm_text(result['mean_mm'])} from the observed ones, {mm_text(result['max_mm'])} at most."
        for model, result in reconstructed.items()
    ]
    kind = "arm" if data.settings.chambers is not None else "beam" if data.sees_markers else "vertices"
    learned += [_PUBLISHED_FOR[kind]] if data.published else []
    many = len(next(iter(trial_errors(data.metrics).values()), ())) >= LEAST_TRIALS
    text += " Interval: of the mean, over draws of the trials." if many else ""
    return unbroken(" ".join([text, *_contributions(data.metrics), *learned]))


def _contributions(metrics: Mapping[str, Any]) -> list[str]:
    """Sentences on how bodies were held, and on the contribution of noise to the errors, if known."""
    notes = []
    if sideways := {trial: mm for fold in folds_in(metrics) for trial, mm in fold.get("sideways_mm", {}).items()}:
        distances = ", ".join(f"{mm_text(distance)} ({trial})" for trial, distance in sideways.items())
        notes.append(
            "The sideways displacement of the held body is estimated from the first frames of a trial: with the "
            f"identified simulator, the markers by {distances}."
        )
    if "noise_mm" in metrics:
        notes.append(f"The noise of the markers alone is {metrics['noise_mm']:.2f} mm.")
    return notes


def when_text(first: Mapping[str, float]) -> str:
    """Returns when the first of some trials left the training range, in words; empty without any.

    Args:
        first: Times [s] by trial.
    """
    if not first:
        return ""
    if not any(first.values()):
        return f", from the start ({', '.join(first)})"
    earliest = min(first, key=lambda trial: first[trial])
    return f", the first after {first[earliest]:.2f} s ({earliest})"


def range_texts(metrics: Mapping[str, Any], trials: Sequence[str]) -> list[str]:
    """Returns a sentence for each model on how many roll-outs left its training range, and when.

    Args:
        metrics: With `range`, by model, whose `first_s` has the times [s] at which trials left; and `scales_range`,
            the same by scale of the inputs. Both may be missing.
        trials: Names of the test trials.
    """
    sentences = []
    left_by, beyond = metrics.get("range", {}), metrics.get("scales_range", {})
    for model in (model for model in MODELS if model in left_by):
        first = left_by[model]["first_s"]
        count = f"{len(first) or 'none'} of {len(trials)} roll-outs" if len(trials) > 1 else "the roll-out"
        never = " never" * (len(trials) == 1 and not first)
        text = f"{MODELS[model].name}: {count}{never} left the training range{when_text(first)}."
        if model == "resphys" and first and "law" in metrics.get("errors_mm", {}):
            text += " There the learned force fades out, and the law remains."
        scales = [scale for scale in sorted(beyond, key=float) if float(scale) != 1.0]
        left = {scale: beyond[scale][model]["first_s"] for scale in scales}
        if any(left.values()):
            counts = [f"{len(left[scale]) or 'none'} of {len(trials)} ({float(scale):g} times)" for scale in scales]
            earliest = when_text({trial: time for times in left.values() for trial, time in times.items()})
            text += f" At higher inputs: {', '.join(counts)}{earliest}."
        sentences.append(unbroken(text))
    return sentences


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
    shapes_section,
    registration_section,
    quality_section,
    training_section,
)
