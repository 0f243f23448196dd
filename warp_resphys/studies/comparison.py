"""What the runs of a reproduction have left, as the sections of its page: published numbers beside ours."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ..experiment.build import build_mesh
from ..experiment.files import METRICS
from ..experiment.report import read_trials
from ..experiment.trials import variation_of
from ..io.files import read_json
from ..learning.metrics import (
    PUBLISHED_MARKER_MEDIAN_MM,
    PUBLISHED_MARKERS,
    PUBLISHED_MARKERS_OF_SMALL_SPREAD,
    PUBLISHED_MM,
    PUBLISHED_SECONDS,
    PUBLISHED_SECONDS_STEPS,
    PUBLISHED_SETUP,
)
from ..mesh.mesh import select_vertices, surface_vertices
from ..report import ablation_page, figures, motion_figures
from ..report.data import MODEL_NAMES, Trials
from ..report.page import Cell, Row, Table, duration_text, error_parts, number_text, published_parts
from .reproduction_page import Figure, Section

_NONE = Cell("\N{EN DASH}")
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


@dataclass(frozen=True)
class Result:
    """A run that has ended.

    Attributes:
        experiment: name of the experiment.
        variant: name of the variant.
        arguments: of the command.
        folder: that it wrote.
        failure: the sentence that it failed with, or None.
    """

    experiment: str
    variant: str
    arguments: tuple[str, ...]
    folder: Path
    failure: str | None

    @property
    def metrics(self) -> dict[str, Any]:
        """What `metrics.json` holds."""
        return dict(read_json(self.folder / METRICS))

    @property
    def settings(self) -> dict[str, Any]:
        """The whole configuration of the run."""
        return dict(read_json(self.folder / "stages" / "report.json")["settings"]["config"])


Results = Mapping[str, Result]  # by variant


def compare(config: Mapping[str, Any], results: Sequence[Result]) -> dict[str, Any]:
    """The page's ``verdict`` and ``sections``.

    Args:
        config: with the keys of ``conf/reproduce.yaml``.
        results: of the runs, in order.
    """
    done: dict[str, dict[str, Result]] = {}
    for each in results:
        if each.failure is None:
            done.setdefault(each.experiment, {})[each.variant] = each
    studies = {name: group for name, group in done.items() if "errors_mm" in next(iter(group.values())).metrics}
    set_up = {name: group for name, group in studies.items() if name in PUBLISHED_SETUP}
    sections = [setup_section(config, set_up)] if set_up else []
    sections += [study_section(config, name, group) for name, group in studies.items()]
    timing = config["timing"]
    timed = {v: r for v, r in done.get(timing["experiment"], {}).items() if v in timing["variants"]}
    if timed:
        sections.append(timing_section(config, timed))
    sections += [ablation_section(config, name, group) for name, group in done.items() if name not in studies]
    sections.append(runs_section(config, results))
    missing = missing_section(config)
    return {"verdict": verdict(config, done), "sections": [*sections, *([missing] if missing else [])]}


def verdict(config: Mapping[str, Any], done: Mapping[str, Results]) -> str:
    """The first run of each experiment in a sentence."""
    said = []
    for name, group in done.items():
        result, known = next(iter(group.values())), config["experiments"][name]
        label = config["variants"][result.variant]["label"].lower()
        title = known["title"] if result.variant == known["variants"][0] else f"{known['title']} ({label})"
        if "by_markers" in result.metrics:
            said.append(
                f"{title}: {ablation_page.verdict(result.metrics['by_markers'], result.metrics['uncorrected_mm'])}"
            )
            continue
        errors, published = result.metrics["errors_mm"], PUBLISHED_MM.get(name, {})
        ours = number_text(errors["resphys"]["mean"])
        beside = f", published {published_parts(published['resphys'])[0]} mm" if "resphys" in published else ""
        said.append(f"{title}: with the learned force, the mean error is {ours} mm{beside}.")
    return " ".join(said).replace(" mm", "\N{NO-BREAK SPACE}mm") or "No run has succeeded."


def _labels(config: Mapping[str, Any], results: Results) -> list[str]:
    return [config["variants"][variant]["label"] for variant in results]


def setup_section(config: Mapping[str, Any], studies: Mapping[str, Results]) -> Section:
    """The published tables of parameters, each experiment beside its published set-up."""
    columns, published, ours = [], [], []
    for name, group in studies.items():
        columns += [f"{config['experiments'][name]['title']}, published", "here"]
        published.append(PUBLISHED_SETUP[name])
        ours.append(_setup(next(iter(group.values())).settings))
    rows = []
    for key in ours[0]:
        cells = [
            _NONE if key not in each else Cell(_value(key, each[key]))
            for pair in zip(published, ours, strict=True)
            for each in pair
        ]
        rows.append(Row(key[:1].upper() + key[1:], cells))
    note = "The incorrect beam is the simulator to correct, the correct one is its target."
    return Section("Set-up", tables=[Table("", columns, rows, note)])


def _setup(settings: Mapping[str, Any]) -> dict[str, float]:
    """What the published tables of parameters list, of one run."""
    data = settings["data"]
    values = data[variation_of(data).key]
    limits = data["limit"] or {}
    return {
        "degrees of freedom": 3 * len(build_mesh(settings["mesh"]).vertices),
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


def study_section(config: Mapping[str, Any], name: str, results: Results) -> Section:
    """Roll-out errors of one experiment, and how they and the tip go over time."""
    group = config["experiments"][name]
    published = PUBLISHED_MM.get(name, {})
    measured = [result.metrics["errors_mm"] for result in results.values()]
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
    table = Table(
        "Roll-out error [mm]",
        ["Published", *_labels(config, results)],
        rows,
        "Mean distance of the vertices over all test trajectories and steps, ± its standard deviation. A roll-out that "
        "diverged leaves no mean. Reconstruction: the simulator with forces fitted to the test trajectory itself.",
    )
    drawn = {role: results[variant] for role, variant in group["drawn"].items() if variant in results}
    drawn.setdefault("models", next(iter(results.values())))
    return Section(
        group["title"],
        tables=[table],
        figures=_study_figures(config, name, drawn),
        list_title="Why they differ",
        items=group["deviations"],
    )


def _study_figures(config: Mapping[str, Any], name: str, drawn: Mapping[str, Result]) -> list[Figure]:
    settings = drawn["models"].settings
    test = read_trials(drawn["models"].folder, settings)
    paths = {model: test.positions[model][test.worst] for model in ("simulation", "resphys")}
    errors = {model: test.errors_mm[model] for model in ("simulation", "simfree", "resphys")}
    if "published_network" in drawn:
        other = read_trials(drawn["published_network"].folder, drawn["published_network"].settings)
        paths["published_network"] = other.positions["resphys"][test.worst]
        errors["published_network"] = other.errors_mm["resphys"]
    published = {model: each.mean for model, each in PUBLISHED_MM.get(name, {}).items() if model in errors}
    label = config["variants"][drawn["models"].variant]["label"].lower()
    lines = "; ".join(f"{MODEL_NAMES[model]} {error:g} mm" for model, error in published.items())
    beside = f" Dashed: the published means ({lines})." if published else ""
    return [
        Figure(
            f"{name}_error_over_time",
            partial(figures.error_over_time, errors, settings["time_step"], published),
            f"Mean vertex error of the models over time, on a logarithmic axis.{beside}",
            f"Error over time ({label}): mean over the vertices, against the target. The line is the mean of the "
            f"{len(test.names)} test trajectories, the band spans the smallest to the largest of them.{beside}",
        ),
        Figure(
            f"{name}_trajectory",
            partial(motion_figures.tip_displacement, _tip_motion(settings, test, paths), settings["time_step"]),
            "Tip displacement of target and models over time, and their distance from the target.",
            f"Tip displacement of the test trajectory {test.names[test.worst]} ({label}), the target drawn wide "
            "beneath the others. Lower panel: distance of the tip from the target's.",
        ),
    ]


def _tip_motion(settings: Mapping[str, Any], test: Trials, paths: Mapping[str, Any]) -> dict[str, Any]:
    """(T + 1, 3) displacement of the tip [m] of the target and the models."""
    mesh = build_mesh(settings["mesh"])
    tip = select_vertices(mesh, **settings["tip"])
    rest = mesh.vertices[tip].mean(axis=0)
    whole = {"target": test.target[test.worst], **paths}
    return {name: q[:, tip].mean(axis=1) - rest for name, q in whole.items()}


def timing_section(config: Mapping[str, Any], results: Results) -> Section:
    """The published time benchmark."""
    measured = [(result.metrics["seconds_per_test_trajectory"], result.settings) for result in results.values()]
    rows = []
    for key, label in _TIMED.items():
        cells = [_time_cell(*PUBLISHED_SECONDS[key], PUBLISHED_SECONDS_STEPS)]
        cells += [
            _time_cell(seconds[key]["mean"], seconds[key]["std"], settings["data"]["steps"])
            for seconds, settings in measured
        ]
        rows.append(Row(label, cells))
    steps = " and ".join(sorted({str(settings["data"]["steps"]) for _, settings in measured}))
    note = f"Published: trajectories of {PUBLISHED_SECONDS_STEPS} steps; here: of {steps}."
    table = Table("Time per trajectory [s]", ["Published", *_labels(config, results)], rows, note)
    return Section("Time benchmark", tables=[table], list_title="Why they differ", items=config["timing"]["deviations"])


def _time_cell(mean: float, std: float, steps: int) -> Cell:
    return Cell(f"{mean:.3f} ± {std:.3f}", f"{1e3 * mean / steps:.2g} ms a step")


def ablation_section(config: Mapping[str, Any], name: str, results: Results) -> Section:
    """The published box plot of the marker ablation, as ours and in numbers."""
    group = config["experiments"][name]
    result = next(iter(results.values()))
    metrics, settings = result.metrics, result.settings
    rows = []
    for row in metrics["by_markers"]:
        count = row["markers"]
        median = f"below {PUBLISHED_MARKER_MEDIAN_MM:g}" if count >= PUBLISHED_MARKERS else "not said"
        spread = "small" if count >= PUBLISHED_MARKERS_OF_SMALL_SPREAD else "high"
        values = (row[key] for key in ("median_mm", "interquartile_range_mm", "largest_mm"))
        rows.append(Row(str(count), [Cell(median), Cell(spread), *(Cell(number_text(value)) for value in values)]))
    vertices = len(surface_vertices(build_mesh(settings["mesh"])))
    note = (
        f"Error over all vertices and {settings['data']['steps']} steps, in mm, of {settings['ablation']['draws']} "
        f"random sets of markers among the {vertices} vertices of the surface. "
        f"Uncorrected: {number_text(metrics['uncorrected_mm'])} mm."
    )
    columns = ["Published median", "Published spread", "Median here", "Interquartile range here", "Largest here"]
    published = (PUBLISHED_MARKERS, PUBLISHED_MARKER_MEDIAN_MM)
    boxes = partial(ablation_page.marker_boxes, ablation_page.box_errors(metrics), metrics["uncorrected_mm"], published)
    caption = "Box: lower quartile, median (orange), upper quartile; whiskers to the smallest and the largest error."
    return Section(
        group["title"],
        tables=[Table("Markers", columns, rows, note)],
        figures=[Figure(name, boxes, ablation_page.describe_boxes(metrics), caption)],
        list_title="Why they differ",
        items=group["deviations"],
    )


def runs_section(config: Mapping[str, Any], results: Sequence[Result]) -> Section:
    """What was run: time and memory of each run, or why it failed."""
    rows, failures = [], []
    for each in results:
        title = config["experiments"][each.experiment]["title"]
        head = f"{title}: {config['variants'][each.variant]['label'].lower()}"
        if each.failure is not None:
            rows.append(Row(head, [Cell("failed"), _NONE]))
            failures.append(f"{head}: {each.failure}")
            continue
        metrics = each.metrics
        memory = metrics["peak_memory_gib"]
        cells = [
            Cell(duration_text(sum(metrics["seconds"].values()))),
            _NONE if memory is None else Cell(f"{memory:.2f}"),
        ]
        rows.append(Row(head, cells))
    table = Table(
        "Run",
        ["All stages", "Peak memory [GiB]"],
        rows,
        "Time of each stage when it was last run, beside whatever else the machine did. Memory: with that of workers.",
    )
    commands = [shlex.join(["warp-resphys", *each.arguments]) for each in results]
    return Section(
        "Runs",
        text=[f"Failed: {sentence}" for sentence in failures],
        tables=[table],
        commands=commands,
    )


def missing_section(config: Mapping[str, Any]) -> Section | None:
    """The published experiments that no run reproduces yet."""
    rows = [
        Row(
            _TITLES.get(name, name),
            [
                Cell(*published_parts(errors[model])) if model in errors else _NONE
                for model in MODEL_NAMES
                if model != "reconstruction"
            ],
        )
        for name, errors in PUBLISHED_MM.items()
        if name not in config["experiments"]
    ]
    if not rows:
        return None
    columns = [label for model, label in MODEL_NAMES.items() if model != "reconstruction"]
    return Section("Published, and not reproduced yet", tables=[Table("Published error [mm]", columns, rows)])
