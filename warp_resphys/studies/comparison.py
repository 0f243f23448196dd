"""The page of published beams: published numbers beside ours, from the runs."""

import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from ..experiment.build import build_mesh
from ..experiment.report import read_trials
from ..experiment.trials import VARIATIONS
from ..io.settings import parse
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
    "inference": "of it, the network alone",
}


Runs = Mapping[str, Run]  # by variant


def compare(reproduction: Reproduction, results: Sequence[Run], canvas: Canvas) -> tuple[str, list[Part]]:
    """The page's verdict and its sections.

    Args:
        reproduction: of conf/reproduce.yaml.
        results: runs that have ended, in order.
        canvas: where the figures are drawn.
    """
    done: dict[str, dict[str, Run]] = {}
    for each in results:
        if each.failure is None:
            done.setdefault(each.experiment, {})[each.variant] = each
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
    """The first run of each experiment in a sentence."""
    said = []
    for name, runs in done.items():
        run, known = next(iter(runs.values())), reproduction.experiments[name]
        metrics = run.metrics
        title = known.title if run.variant == known.variants[0] else f"{known.title} ({_label(reproduction, run)})"
        if "by_markers" in metrics:
            said.append(f"{title}: {ablation_page.verdict(metrics['by_markers'], metrics['uncorrected_mm'])}")
            continue
        ours, published = number_text(metrics["errors_mm"]["resphys"]["mean"]), paper.PUBLISHED_MM.get(name, {})
        beside = f", published {published_parts(published['resphys'])[0]} mm" if "resphys" in published else ""
        said.append(f"{title}: with the learned force, the mean error is {ours} mm{beside}.")
    return " ".join(said).replace(" mm", f"{NO_BREAK_SPACE}mm") or "No run has succeeded."


def _label(reproduction: Reproduction, run: Run) -> str:
    return str(reproduction.variants[run.variant].label).lower()


def _columns(reproduction: Reproduction, runs: Runs) -> list[str]:
    return ["Published", *(reproduction.variants[variant].label for variant in runs)]


def _reasons(deviations: Sequence[str]) -> list[Text | Items]:
    return [Text("Why they differ", heading=True), Items(deviations)] if deviations else []


def setup_section(reproduction: Reproduction, studies: Mapping[str, Runs]) -> Part:
    """The published tables of parameters, each experiment beside its published set-up."""
    columns: list[str] = []
    values: list[Mapping[str, float]] = []
    for name, runs in studies.items():
        columns += [f"{reproduction.experiments[name].title}, published", "here"]
        values += [paper.PUBLISHED_SETUP[name], _setup(next(iter(runs.values())).settings)]
    rows = [
        Row(key[:1].upper() + key[1:], [Cell(_value(key, each[key])) if key in each else _NONE for each in values])
        for key in values[1]
    ]
    note = "The incorrect beam is the simulator to correct, the correct one is its target."
    return Part("Set-up", [PageTable("", columns, rows, note)])


def _setup(settings: Mapping[str, Any]) -> dict[str, float]:
    """What the published tables of parameters list, of one run."""
    data = settings["data"]
    values = data[VARIATIONS[data["kind"]].key]
    limits = data["limit"] or {}
    return {
        "degrees of freedom": 3 * len(build_mesh(parse(RunSettings, settings).mesh).vertices),
        **{
            f"{key}, {which} beam": settings[source][constant]
            for key, constant in (("Poisson's ratio", "poissons_ratio"), ("Young's modulus", "youngs_modulus"))
            for which, source in (("incorrect", "simulation"), ("correct", "target"))
        },
        "step size": settings["time_step"],
        "time steps": data["steps"],
        **{
            f"{_SPLITS[name]} trajectories": min(len(values[name]), limits.get(name, len(values[name])))
            for name in _SPLITS
        },
    }


def _value(key: str, value: float) -> str:
    if key.startswith("Young"):
        return f"{value / 1e3:g} kPa"
    return f"{value:g} s" if key == "step size" else f"{value:g}"


def study_section(reproduction: Reproduction, name: str, runs: Runs, canvas: Canvas) -> Part:
    """Roll-out errors of one experiment, and how they and the tip go over time."""
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
        "Mean distance of the vertices over all test trajectories and steps, ± its standard deviation. A roll-out that "
        "diverged leaves no mean. Reconstruction: the simulator with forces fitted to the test trajectory itself."
    )
    table = PageTable("Roll-out error [mm]", _columns(reproduction, runs), rows, note)
    drawn = {role: runs[variant] for role, variant in group.drawn.items() if variant in runs}
    drawn.setdefault("models", next(iter(runs.values())))
    return Part(group.title, [table, *_study_figures(reproduction, name, drawn, canvas), *_reasons(group.deviations)])


def _study_figures(reproduction: Reproduction, name: str, drawn: Mapping[str, Run], canvas: Canvas) -> list[Drawn]:
    settings = drawn["models"].settings
    test = read_trials(drawn["models"].folder, parse(RunSettings, settings))
    paths = {model: test.positions[model][test.worst] for model in ("simulation", "resphys")}
    errors = {model: test.errors_mm[model] for model in ("simulation", "simfree", "resphys")}
    if "published_network" in drawn:
        run = drawn["published_network"]
        other = read_trials(run.folder, parse(RunSettings, run.settings))
        paths["published_network"] = other.positions["resphys"][test.worst]
        errors["published_network"] = other.errors_mm["resphys"]
    published = {model: each.mean for model, each in paper.PUBLISHED_MM.get(name, {}).items() if model in errors}
    label = _label(reproduction, drawn["models"])
    lines = "; ".join(f"{MODEL_NAMES[model]} {error:g} mm" for model, error in published.items())
    beside = f" Dashed: the published means ({lines})." if published else ""
    return [
        canvas.figure(
            f"{name}_error_over_time",
            partial(figures.error_over_time, errors, settings["time_step"], published),
            f"Mean vertex error of the models over time, on a logarithmic axis.{beside}",
            f"Error over time ({label}): mean over the vertices, against the target. The line is the mean of the "
            f"{len(test.names)} test trajectories, the band spans the smallest to the largest of them.{beside}",
        ),
        canvas.figure(
            f"{name}_trajectory",
            partial(motion_figures.tip_displacement, _tip_motion(settings, test, paths), settings["time_step"]),
            "Tip displacement of target and models over time, and their distance from the target.",
            f"Tip displacement of the test trajectory {test.names[test.worst]} ({label}), the target drawn wide "
            "beneath the others. Lower panel: distance of the tip from the target's.",
        ),
    ]


def _tip_motion(settings: Mapping[str, Any], test: TrialResults, paths: Mapping[str, Any]) -> dict[str, Any]:
    """(T + 1, 3) displacement of the tip [m] of the target and the models."""
    run = parse(RunSettings, settings)
    mesh = build_mesh(run.mesh)
    tip = select_vertices(mesh, **run.tip.arguments())
    rest = mesh.vertices[tip].mean(axis=0)
    whole = {"target": test.target[test.worst], **paths}
    return {name: q[:, tip].mean(axis=1) - rest for name, q in whole.items()}


def timing_section(reproduction: Reproduction, runs: Runs) -> Part:
    """The published time benchmark."""
    measured = [(run.metrics["seconds_per_test_trajectory"], run.settings["data"]["steps"]) for run in runs.values()]
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
    """The published box plot of the marker ablation, as ours and in numbers."""
    group, run = reproduction.experiments[name], next(iter(runs.values()))
    metrics, settings = run.metrics, run.settings
    rows = []
    for row in metrics["by_markers"]:
        count = row["markers"]
        median = f"below {paper.PUBLISHED_MARKER_MEDIAN_MM:g}" if count >= paper.PUBLISHED_MARKERS else "not said"
        spread = "small" if count >= paper.PUBLISHED_MARKERS_OF_SMALL_SPREAD else "high"
        ours = (number_text(row[key]) for key in ("median_mm", "interquartile_range_mm", "largest_mm"))
        rows.append(Row(str(count), [Cell(text) for text in (median, spread, *ours)]))
    vertices = len(surface_vertices(build_mesh(parse(RunSettings, settings).mesh)))
    note = (
        f"Error over all vertices and {settings['data']['steps']} steps, in mm, of {settings['ablation']['draws']} "
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
    """What was run: time and memory of each run, or why it failed."""
    rows, failures = [], []
    for run in results:
        head = f"{reproduction.experiments[run.experiment].title}: {_label(reproduction, run)}"
        if run.failure is None:
            metrics = run.metrics
            memory = metrics["peak_memory_gib"]
            taken = Cell(duration_text(sum(metrics["seconds"].values())))
            rows.append(Row(head, [taken, _NONE if memory is None else Cell(f"{memory:.2f}")]))
        else:
            rows.append(Row(head, [Cell("failed"), _NONE]))
            failures.append(Text(f"Failed: {head}: {run.failure}"))
    note = (
        "Time of each stage when it was last run, beside whatever else the machine did. Memory: with that of workers."
    )
    table = PageTable("Run", ["All stages", "Peak memory [GiB]"], rows, note)
    commands = Items([shlex.join(["warp-resphys", *run.arguments]) for run in results], code=True)
    return Part("Runs", [*failures, table, Text("Each by itself", heading=True), commands])


def missing_section(published: Mapping[str, Mapping[str, paper.PublishedError]]) -> Part:
    """The published experiments that no run reproduces yet."""
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
