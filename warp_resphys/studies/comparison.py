"""Sections of the page on published beams: published results and those of the runs."""

import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from ..experiment.build import build_mesh
from ..experiment.report import read_trials
from ..learning import metrics as paper
from ..mesh.mesh import select_vertices, surface_vertices
from ..report import ablation_page, figures, motion_figures
from ..report.data import MODEL_NAMES, TrialResults
from ..report.page import (
    NO_BREAK_SPACE,
    NONE,
    Canvas,
    Cell,
    Drawn,
    Items,
    PageTable,
    Part,
    Row,
    Text,
    duration_text,
    error_parts,
    number_text,
    published_parts,
)
from ..settings.run import RunSettings
from ..settings.trials import RecordedData
from .rows import Reproduction
from .runs import Run

_NONE = Cell(NONE)
_SPLITS = {"train": "training", "validation": "validation", "test": "testing"}
_TITLES = {
    "beam_real": "Real beam",
    "sopra": "Pneumatic arm",
    "sopra_extrapolation": "Pneumatic arm, 10 s after training on 5 s",
}
_TIMED = {
    "simulation": "Uncorrected simulation",
    "target": "Simulation with other parameters",
    "resphys": "Residual physics simulation",
    "inference": "of which the network",
}
Runs = Mapping[str, Run]  # by variant


def compare(reproduction: Reproduction, results: Sequence[Run], canvas: Canvas) -> tuple[str, list[Part]]:
    """Verdict and sections of the page.

    Args:
        reproduction: the configuration.
        results: finished runs, in order.
        canvas: for the figures.
    """
    done: dict[str, dict[str, Run]] = {}
    for run in results:
        if run.failure is None:
            done.setdefault(run.experiment, {})[run.variant] = run
    studies = {name: runs for name, runs in done.items() if "errors_mm" in next(iter(runs.values())).metrics}
    set_up = {name: runs for name, runs in studies.items() if name in paper.PUBLISHED_SETUP}
    parts = [setup_section(reproduction, set_up)] if set_up else []
    parts += [study_section(reproduction, name, runs, canvas) for name, runs in studies.items()]
    timing = reproduction.timing
    if timed := {v: r for v, r in done.get(timing.experiment, {}).items() if v in timing.variants}:
        parts.append(timing_section(reproduction, timed))
    parts += [ablation_section(reproduction, name, runs, canvas) for name, runs in done.items() if name not in studies]
    parts.append(runs_section(reproduction, results))
    if missing := {name: errors for name, errors in paper.PUBLISHED_MM.items() if name not in reproduction.experiments}:
        parts.append(missing_section(missing))
    return verdict(reproduction, done), parts


def verdict(reproduction: Reproduction, done: Mapping[str, Runs]) -> str:
    """Sentences on the first run of each experiment."""
    sentences = []
    for name, runs in done.items():
        run, beam = next(iter(runs.values())), reproduction.experiments[name]
        metrics = run.metrics
        title = beam.title if run.variant == beam.variants[0] else f"{beam.title} ({_label(reproduction, run)})"
        if "by_markers" in metrics:
            sentences.append(f"{title}: {ablation_page.verdict(metrics['by_markers'], metrics['uncorrected_mm'])}")
            continue
        ours, published = number_text(metrics["errors_mm"]["resphys"]["mean"]), paper.PUBLISHED_MM.get(name, {})
        beside = f", published {published_parts(published['resphys'])[0]} mm" if "resphys" in published else ""
        sentences.append(f"{title}: with the learned force, the mean error is {ours} mm{beside}.")
    return " ".join(sentences).replace(" mm", f"{NO_BREAK_SPACE}mm") or "No run has succeeded."


def _label(reproduction: Reproduction, run: Run) -> str:
    return str(reproduction.variants[run.variant].label).lower()


def _columns(reproduction: Reproduction, runs: Runs) -> list[str]:
    return ["Published", *(reproduction.variants[variant].label for variant in runs)]


def _reasons(deviations: Sequence[str]) -> list[Text | Items]:
    return [Text("Reasons for deviations", heading=True), Items(deviations)] if deviations else []


def setup_section(reproduction: Reproduction, studies: Mapping[str, Runs]) -> Part:
    """Table of the parameters of each experiment, published and here."""
    columns: list[str] = []
    values: list[Mapping[str, float]] = []
    for name, runs in studies.items():
        columns += [f"{reproduction.experiments[name].title}, published", "here"]
        values += [paper.PUBLISHED_SETUP[name], _setup(next(iter(runs.values())).settings)]
    rows = [
        Row(key[:1].upper() + key[1:], [Cell(_value(key, row[key])) if key in row else _NONE for row in values])
        for key in values[1]
    ]
    note = "The incorrect beam is the simulator to correct, the correct one is its target."
    return Part("Set-up", [PageTable("", columns, rows, note)])


def _setup(settings: RunSettings) -> dict[str, float]:
    """Parameters of a run that the published tables list."""
    data = settings.trial_data
    assert not isinstance(data, RecordedData)
    assert settings.target is not None
    constants = {"incorrect": settings.simulation.constants, "correct": settings.target.material.constants}
    limits = {} if data.limit is None else dict(data.limit)
    counts = {name: len(getattr(data.amounts, name)) for name in _SPLITS}
    return {
        "degrees of freedom": 3 * len(build_mesh(settings.mesh).vertices),
        **{
            f"{key}, {which} beam": values[constant]
            for key, constant in (("Poisson's ratio", "poissons_ratio"), ("Young's modulus", "youngs_modulus"))
            for which, values in constants.items()
        },
        "step size": settings.time_step,
        "time steps": data.steps,
        **{
            f"{words} trajectories": min(counts[name], limits.get(name, counts[name]))
            for name, words in _SPLITS.items()
        },
    }


def _value(key: str, value: float) -> str:
    if key.startswith("Young"):
        return f"{value / 1e3:g} kPa"
    return f"{value:g} s" if key == "step size" else f"{value:g}"


def study_section(reproduction: Reproduction, name: str, runs: Runs, canvas: Canvas) -> Part:
    """Roll-out errors of an experiment, as a table and over time, and the motion of the tip."""
    group = reproduction.experiments[name]
    published = paper.PUBLISHED_MM.get(name, {})
    measured = [run.metrics["errors_mm"] for run in runs.values()]
    rows = [
        Row(
            label,
            [
                Cell(*published_parts(published[model])) if model in published else _NONE,
                *(Cell(*error_parts(errors[model])) if model in errors else _NONE for errors in measured),
            ],
            answer=model == "resphys",
        )
        for model, label in MODEL_NAMES.items()
        if model in published or any(model in errors for errors in measured)
    ]
    note = (
        "Mean distance of the vertices over all test trajectories and steps, ± its standard deviation. There is no "
        "mean if a roll-out diverged. Reconstruction: the simulator with forces fitted to the test trajectory itself."
    )
    table = PageTable("Roll-out error [mm]", _columns(reproduction, runs), rows, note)
    drawn = {role: runs[variant] for role, variant in group.drawn.items() if variant in runs}
    drawn.setdefault("models", next(iter(runs.values())))
    return Part(group.title, [table, *_study_figures(reproduction, name, drawn, canvas), *_reasons(group.deviations)])


def _study_figures(reproduction: Reproduction, name: str, drawn: Mapping[str, Run], canvas: Canvas) -> list[Drawn]:
    settings = drawn["models"].settings
    test = read_trials(drawn["models"].folder, settings)
    paths = {model: test.positions[model][test.worst] for model in ("simulation", "resphys")}
    errors = {model: test.errors_mm[model] for model in ("simulation", "simfree", "resphys")}
    if "published_network" in drawn:
        run = drawn["published_network"]
        other = read_trials(run.folder, run.settings)
        paths["published_network"] = other.positions["resphys"][test.worst]
        errors["published_network"] = other.errors_mm["resphys"]
    published = {model: error.mean for model, error in paper.PUBLISHED_MM.get(name, {}).items() if model in errors}
    label = _label(reproduction, drawn["models"])
    lines = "; ".join(f"{MODEL_NAMES[model]} {error:g} mm" for model, error in published.items())
    beside = f" Dashed: the published means ({lines})." if published else ""
    return [
        canvas.figure(
            f"{name}_error_over_time",
            partial(figures.error_over_time, errors, settings.time_step, published),
            f"Mean vertex error of the models over time, on a logarithmic axis.{beside}",
            f"Error over time ({label}): mean over the vertices, against the target. The line is the mean of the "
            f"{len(test.names)} test trajectories, the band spans the smallest to the largest of them.{beside}",
        ),
        canvas.figure(
            f"{name}_trajectory",
            partial(motion_figures.tip_displacement, _tip_motion(settings, test, paths), settings.time_step),
            "Tip displacement of target and models over time, and their distance from the target.",
            f"Tip displacement of the test trajectory {test.names[test.worst]} ({label}); the wide line is the target. "
            "Lower panel: distance of the tip from the target's.",
        ),
    ]


def _tip_motion(settings: RunSettings, test: TrialResults, paths: Mapping[str, Any]) -> dict[str, Any]:
    """Displacement (T + 1, 3) of the tip [m] of the target and the models."""
    mesh = build_mesh(settings.mesh)
    assert settings.tip is not None
    tip = select_vertices(mesh, **settings.tip.arguments())
    rest = mesh.vertices[tip].mean(axis=0)
    whole = {"target": test.target[test.worst], **paths}
    return {name: q[:, tip].mean(axis=1) - rest for name, q in whole.items()}


def timing_section(reproduction: Reproduction, runs: Runs) -> Part:
    """The published time benchmark."""
    measured = [(run.metrics["seconds_per_test_trajectory"], run.settings.data.steps or 1) for run in runs.values()]
    rows = [
        Row(
            label,
            [
                _time_cell(*paper.PUBLISHED_SECONDS[key], paper.PUBLISHED_SECONDS_STEPS),
                *(_time_cell(seconds[key]["mean"], seconds[key]["std"], steps) for seconds, steps in measured),
            ],
        )
        for key, label in _TIMED.items()
    ]
    counts = " and ".join(sorted({str(steps) for _, steps in measured}))
    note = f"Published: trajectories of {paper.PUBLISHED_SECONDS_STEPS} steps; here: of {counts}."
    table = PageTable("Time per trajectory [s]", _columns(reproduction, runs), rows, note)
    return Part("Time benchmark", [table, *_reasons(reproduction.timing.deviations)])


def _time_cell(mean: float, std: float, steps: int) -> Cell:
    return Cell(f"{mean:.3f} ± {std:.3f}", f"{1e3 * mean / steps:.2g} ms a step")


def ablation_section(reproduction: Reproduction, name: str, runs: Runs, canvas: Canvas) -> Part:
    """The marker ablation as a box plot and a table, with the published results."""
    group, run = reproduction.experiments[name], next(iter(runs.values()))
    metrics, settings = run.metrics, run.settings
    rows = []
    for row in metrics["by_markers"]:
        count = row["markers"]
        median = f"below {paper.PUBLISHED_MARKER_MEDIAN_MM:g}" if count >= paper.PUBLISHED_MARKERS else "not given"
        spread = "small" if count >= paper.PUBLISHED_MARKERS_OF_SMALL_SPREAD else "high"
        ours = (number_text(row[key]) for key in ("median_mm", "interquartile_range_mm", "largest_mm"))
        rows.append(Row(str(count), [Cell(text) for text in (median, spread, *ours)]))
    assert settings.ablation is not None
    vertices = len(surface_vertices(build_mesh(settings.mesh)))
    note = (
        f"Error over all vertices and {settings.data.steps} steps, in mm, of {settings.ablation.draws} "
        f"random sets of markers among the {vertices} vertices of the surface. "
        f"Uncorrected: {number_text(metrics['uncorrected_mm'])} mm."
    )
    columns = ["Published median", "Published spread", "Median here", "Interquartile range here", "Largest here"]
    published = (paper.PUBLISHED_MARKERS, paper.PUBLISHED_MARKER_MEDIAN_MM)
    boxes = partial(ablation_page.marker_boxes, ablation_page.box_errors(metrics), metrics["uncorrected_mm"], published)
    caption = "Box: lower quartile, median (orange), upper quartile; whiskers to the smallest and the largest error."
    figure = canvas.figure(name, boxes, ablation_page.describe_boxes(metrics), caption)
    return Part(group.title, [PageTable("Markers", columns, rows, note), figure, *_reasons(group.deviations)])


def runs_section(reproduction: Reproduction, results: Sequence[Run]) -> Part:
    """Time and memory of each run, or why it failed, and the commands."""
    rows, failures = [], []
    for run in results:
        head = f"{reproduction.experiments[run.experiment].title}: {_label(reproduction, run)}"
        if run.failure is None:
            metrics = run.metrics
            memory = metrics["peak_memory_gib"]
            duration = Cell(duration_text(sum(metrics["seconds"].values())))
            rows.append(Row(head, [duration, _NONE if memory is None else Cell(f"{memory:.2f}")]))
        else:
            rows.append(Row(head, [Cell("failed"), _NONE]))
            failures.append(Text(f"Failed: {head}: {run.failure}"))
    note = (
        "Time: sum over the last run of each stage, also of those that ran at once, on a machine with other load. "
        "Memory: including worker processes."
    )
    table = PageTable("Run", ["All stages", "Peak memory [GiB]"], rows, note)
    commands = Items([shlex.join(["warp-resphys", *run.arguments]) for run in results], code=True)
    return Part("Runs", [*failures, table, Text("Commands of the runs", heading=True), commands])


def missing_section(published: Mapping[str, Mapping[str, paper.PublishedError]]) -> Part:
    """Table of published results that no run reproduces yet."""
    models = {model: label for model, label in MODEL_NAMES.items() if model != "reconstruction"}
    rows = [
        Row(
            _TITLES.get(name, name),
            [Cell(*published_parts(errors[model])) if model in errors else _NONE for model in models],
        )
        for name, errors in published.items()
    ]
    table = PageTable("Published error [mm]", [*models.values()], rows)
    return Part("Published, and not reproduced yet", [table])
