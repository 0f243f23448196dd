"""The report of a run: one HTML page that needs nothing beside it, and its figures as PNG files."""

import base64
import logging
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jinja2
import numpy as np
from numpy.typing import NDArray

from warp_resphys.errors import DataFileError, InputError
from warp_resphys.files import disk_full_error, is_disk_full, write_text
from warp_resphys.mesh import Mesh
from warp_resphys.metrics import PublishedError, trajectory_errors
from warp_resphys.verdict import best, judgement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_LOG = logging.getLogger(__name__)
NO_BREAK_SPACE = "\u00a0"
MOST_DECIMALS = 6  # What takes more is written with a power of ten.
_MODELS = {  # In the order of the tables: a name, and what it means.
    "simulation": ("Uncorrected simulation", "the simulator as it is"),
    "reconstruction": ("Reconstruction", "the simulator with forces fitted to the test trajectory itself"),
    "sysid": ("SysID", "the simulator with the parameters that fit best"),
    "simfree": ("SimFree", "a network in place of the simulator"),
    "resphys": ("ResPhys", "the simulator with the learned force, which sees only the simulated state"),
}
MODEL_NAMES = {model: name for model, (name, _) in _MODELS.items()}

_TIMED = {
    "simulation": "Uncorrected simulation",
    "true_parameters": "Simulation with the true parameters",
    "resphys": "Simulation with the learned force",
    "inference": "of it, the network alone",
}


@dataclass(frozen=True, eq=False)
class Example:
    """One test trajectory: what should have happened, and the simulation without and with the learned force.

    Attributes:
        name: What sets it apart, such as "0.12 kg".
        target: (T+1, N, 3) [m].
        simulation: (T+1, N, 3) [m], uncorrected.
        resphys: (T+1, N, 3) [m], corrected; not finite from where it diverged, if it did.
    """

    name: str
    target: FloatArray
    simulation: FloatArray
    resphys: FloatArray


@dataclass(frozen=True, eq=False)
class ReportData:
    """Everything that the report shows.

    Attributes:
        experiment: Name of the experiment, such as "beam_oscillation".
        title: The page's heading.
        simulator: The simulator that is corrected, in words, such as "E 215 kPa".
        reality: What it is brought to, in words.
        metrics: What `metrics.json` holds: `errors_mm`, `errors_vs_reconstruction_mm` (a summary a model, see
            `warp_resphys.metrics.summarise`), `per_trajectory` (see `summarise_each`), `seconds` (a number a
            stage), `peak_memory_gib` (None where it is not known), `versions` (a text a package) and `device`.
        settings: The run's configuration, nested.
        published: Published errors of the models, empty where there are none.
        published_note: How the published set-up differs from this run's.
        time_step: [s].
        mesh: The undeformed body.
        tip: (S,) vertices whose mean is called the tip.
        example: The trajectory that is drawn.
        errors_mm: For each model (R, T) errors [mm] of the R test trajectories at the steps 1 to T.
        training: One record an epoch, see `warp_resphys.report.figures.training_curves`; may be empty.
        refinement: The same of the refinement through the simulator; empty where there was none.
        network_note: Which network ResPhys uses, and how it was trained, in words.
        kept_note: Which weights were taken, in words.

    Raises:
        InputError: The arrays do not fit each other.
    """

    experiment: str
    title: str
    simulator: str
    reality: str
    metrics: Mapping[str, Any]
    settings: Mapping[str, Any]
    published: Mapping[str, PublishedError]
    published_note: str
    time_step: float
    mesh: Mesh
    tip: IntArray
    example: Example
    errors_mm: Mapping[str, FloatArray]
    training: Sequence[Mapping[str, Any]]
    refinement: Sequence[Mapping[str, Any]] = ()
    network_note: str = ""
    kept_note: str = ""

    def __post_init__(self) -> None:
        """Check that the arrays fit each other."""
        wanted = (len(self.example.target), *self.mesh.vertices.shape)
        for model in ("target", "simulation", "resphys"):
            shape = getattr(self.example, model).shape
            if shape != wanted:
                raise InputError(f"the example's {model} trajectory is {shape}, but the mesh asks for {wanted}")
        for model, rows in self.errors_mm.items():
            if rows.ndim != 2 or rows.size == 0:
                raise InputError(f"the errors of {model} are {rows.shape}, not (trajectories, steps)")


class Picture(NamedTuple):
    """One figure on the page: two widths of it as data addresses, and what it shows, in words."""

    wide: str
    narrow: str
    alt: str


@contextmanager
def figures_beside(path: Path) -> Iterator[Path]:
    """Give the folder `figures` beside a page, made where it is missing.

    Raises:
        DataFileError: A figure could not be written there.
    """
    folder = path.parent / "figures"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    except OSError as error:
        if is_disk_full(error):
            raise disk_full_error(folder) from error
        raise DataFileError(f"cannot write figures to {folder}: {error.strerror or error}") from error


def write_report(path: Path, data: ReportData) -> None:
    """Write the page, and its figures as PNG files into `figures/` beside it.

    The page is whole or not there: it is written beside its final place first.

    Where the deformed bodies cannot be drawn, the page says why in their place, and so does a warning.

    Args:
        path: The page's file, such as `report.html`; missing folders are made.
        data: What to show.

    Raises:
        DataFileError: A file could not be written.
    """
    with figures_beside(path) as folder:
        page = _render_page(data, *_draw(data, folder))
    write_text(path, page)
    _LOG.info("report written: %s", path)


def _draw(data: ReportData, folder: Path) -> tuple[dict[str, Picture], dict[str, str]]:
    """Draw the figures in two widths, and save the wide ones; say of those that cannot be drawn why."""
    from warp_resphys.report import figures, render

    both = partial(draw_picture, folder)
    motion = _tip_motion(data)
    state = worst_state(data.example)
    target = data.example.target[state]
    shapes = {"simulation": data.example.simulation[state], "resphys": data.example.resphys[state]}
    draw_motion = partial(figures.tip_displacement, motion, data.time_step)
    draw_errors = partial(figures.error_over_time, data.errors_mm, data.time_step)
    pictures = {
        "tip_displacement": both("tip_displacement", draw_motion, _describe_motion(motion)),
        "error_over_time": both("error_over_time", draw_errors, _describe_errors(data.errors_mm)),
    }
    missing = {}
    try:
        bodies = render.draw_bodies(data.mesh, shapes, target)
    except render.DrawingError as error:
        missing["shape"] = f"{error}, then delete this page and run the same command again."
        _LOG.warning("the report lacks a picture: %s", error)
        (folder / "shape.png").unlink(missing_ok=True)  # Of an earlier report, it would not belong to this one.
    else:
        alt = _describe_shapes(shapes, target)
        pictures["shape"] = both("shape", partial(figures.shape_comparison, bodies), alt)
    for name, records in (("training", data.training), ("refinement", data.refinement)):
        if records:
            alt = f"Losses and validation roll-out error of the {name}, {len(records)} epochs, on logarithmic axes."
            pictures[name] = both(name, partial(figures.training_curves, records), alt)
    return pictures, missing


def draw_picture(folder: Path, name: str, draw: "Callable[..., Figure]", alt: str) -> Picture:
    """Draw a figure in two widths, for a page, and save the wide one as a PNG file.

    Args:
        folder: Of the PNG file.
        name: Of the figure, and of the file.
        draw: Makes the figure; takes the keyword `narrow`.
        alt: What it shows, in words.
    """
    from warp_resphys.report import figures

    wide, narrow = draw(narrow=False), draw(narrow=True)
    figures.save_png(wide, folder / f"{name}.png")
    return Picture(svg_address(figures.themed_svg(wide, name)), svg_address(figures.themed_svg(narrow, name)), alt)


def worst_state(example: Example) -> int:
    """Return the state at which the uncorrected simulation is farthest from the target, on average."""
    errors = trajectory_errors(example.simulation, example.target)
    return 1 + int(np.argmax(np.where(np.isfinite(errors), errors, -1.0)))


def page_template(name: str) -> jinja2.Template:
    """Return one of the templates in this package."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("warp_resphys", "report"),
        undefined=jinja2.StrictUndefined,
        autoescape=jinja2.select_autoescape(["html"]),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def _render_page(data: ReportData, pictures: Mapping[str, Picture], missing: Mapping[str, str]) -> str:
    metrics = data.metrics
    models = [model for model in _MODELS if model in metrics["errors_mm"] or model in data.published]
    trajectories, steps = next(iter(data.errors_mm.values())).shape
    return page_template("template.html").render(
        title=data.title,
        data=data,
        metrics=metrics,
        pictures=pictures,
        missing=missing,
        names=_MODELS,
        models=models,
        judged=judgement(metrics, data.settings),
        answer=best(metrics["errors_mm"]),
        timed=_TIMED,
        verdict=verdict(metrics["errors_mm"], data.published, data.simulator, data.reality),
        measured={model: error_parts(each) for model, each in metrics["errors_mm"].items()},
        published={model: published_parts(each) for model, each in data.published.items()},
        reconstructed={model: error_parts(each) for model, each in metrics["errors_vs_reconstruction_mm"].items()},
        each_trajectory={row["name"]: row["errors_mm"] for row in metrics["per_trajectory"]},
        number=number_text,
        duration=duration_text,
        settings=list(flatten(data.settings)),
        trajectories=trajectories,
        steps=steps,
        rollouts=any(record.get("rollout_error_mm") is not None for record in data.training),
        worst_time=worst_state(data.example) * data.time_step,
    )


def verdict(errors: Mapping[str, Any], published: Mapping[str, PublishedError], simulator: str, reality: str) -> str:
    """Say in a sentence or two how far the learned force brings the simulator to its target.

    Args:
        errors: A summary [mm] a model, with "simulation" and "resphys" among them.
        published: Published errors [mm].
        simulator: The corrected simulator in words.
        reality: The target in words.
    """
    before, after = errors["simulation"], errors["resphys"]
    count = after["trajectories"]
    old, new = number_text(before["mean"]), number_text(after["mean"])
    if after["mean"] is None:
        said = (
            f"With the learned residual force, {after['diverged']} of {count} test roll-outs diverged, so "
            f"there is no mean error to report. Without it: {old}{'' if before['mean'] is None else ' mm'}."
        )
    elif before["mean"] is None:
        said = (
            f"Uncorrected, {before['diverged']} of {count} test roll-outs diverge; with the learned residual "
            f"force, the mean vertex error is {new} mm."
        )
    elif after["mean"] >= before["mean"]:
        said = (
            "The learned residual force does not help: the mean vertex error on "
            f"{count} test trajectories is {new} mm with it and {old} mm without."
        )
    else:
        said = (
            f"The learned residual force brings the simulator ({simulator}) "
            f"{_closer(before['mean'], after['mean'])} to its target ({reality}): on {count} test "
            f"trajectories that it never saw, the mean vertex error falls from {old} mm to {new} mm."
        )
    if "resphys" in published:
        said += f" The published result is {published_parts(published['resphys'])[0]} mm."
    number_and_unit, symbol_and_number = r"(?<=\d) (?=(?:mm|kPa)\b)", r"(?<=\b\w) (?=\d)"
    return re.sub(f"{number_and_unit}|{symbol_and_number}", NO_BREAK_SPACE, said)


def number_text(value: float | None) -> str:
    """Return a number with three decimals, or two digits if that takes more; None stands for divergence."""
    if value is None:
        return "diverged"
    decimals = _decimals(value)
    if decimals <= MOST_DECIMALS:
        return f"{value:.{decimals}f}"
    exponent = math.floor(math.log10(value))
    return f"{value / 10.0**exponent:.1f}{_times_power(exponent)}"


def error_parts(summary: Mapping[str, Any]) -> tuple[str, str]:
    """Return a mean and its "± deviation" if it has one, with as many digits as the smaller of the two deserves."""
    mean, std = summary["mean"], summary["std"]
    if mean is None:
        return f"{summary['diverged']} of {summary['trajectories']} diverged", ""
    if std is None:
        return number_text(mean), ""
    decimals = _decimals(min(mean, std) or mean)
    if decimals <= MOST_DECIMALS:
        return f"{mean:.{decimals}f}", f"± {std:.{decimals}f}"
    exponent = math.floor(math.log10(mean))
    power = _times_power(exponent)
    return f"{mean / 10.0**exponent:.1f}{power}", f"± {std / 10.0**exponent:.1f}{power}"


def duration_text(seconds: float) -> str:
    """Return a duration as one reads it: "0.42 s", "12.3 s", "3 min 05 s"."""
    if seconds < 60.0:
        return f"{seconds:.2f} s" if seconds < 10.0 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"


def _times_power(exponent: int) -> str:
    return " \N{MULTIPLICATION SIGN} 10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _decimals(value: float) -> int:
    return max(3, 1 - math.floor(math.log10(abs(value)))) if value else 3


def _closer(before: float, after: float) -> str:
    """Two significant digits: a ratio of errors over a few trajectories is worth no more."""
    if after == 0.0:
        return "all the way"
    digits = 1 - math.floor(math.log10(before / after))
    return f"{round(before / after, digits):,.{max(0, digits)}f} times closer"


def published_parts(error: PublishedError) -> tuple[str, str]:
    """Return the number as it was printed: both parts with the same decimals."""
    decimals = max(len(repr(float(part)).partition(".")[2]) for part in error)
    return f"{error.mean:.{decimals}f}", f"± {error.std:.{decimals}f}"


def flatten(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Return the settings as the dotted keys by which the command line sets them, with their values."""
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{prefix}{key}.")
        elif isinstance(value, list | tuple):
            yield f"{prefix}{key}", f"[{', '.join(str(each) for each in value)}]"
        else:
            yield f"{prefix}{key}", "null" if value is None else str(value)


def _tip_motion(data: ReportData) -> dict[str, FloatArray]:
    """(T+1, 3) displacement of the tip [m] of the target and the models."""
    rest = data.mesh.vertices[data.tip].mean(axis=0)
    paths = {
        "target": data.example.target,
        "simulation": data.example.simulation,
        "resphys": data.example.resphys,
    }
    return {name: positions[:, data.tip].mean(axis=1) - rest for name, positions in paths.items()}


def _describe_motion(motion: Mapping[str, FloatArray]) -> str:
    gap = {model: _largest(motion[model] - motion["target"]) for model in ("simulation", "resphys")}
    return (
        "Tip displacement over time. The uncorrected simulation leaves the target by up to "
        f"{gap['simulation']}; the corrected one by up to {gap['resphys']}."
    )


def _describe_shapes(shapes: Mapping[str, FloatArray], target: FloatArray) -> str:
    return (
        "The deformed body, coloured by its distance from the target: uncorrected, up to "
        f"{_largest(shapes['simulation'] - target)}; corrected, up to {_largest(shapes['resphys'] - target)}."
    )


def _describe_errors(errors: Mapping[str, FloatArray]) -> str:
    largest = (f"{_MODELS[model][0]} reaches {_largest(rows[..., None] / 1e3)}" for model, rows in errors.items())
    return f"Mean vertex error over time, on a logarithmic axis. {'; '.join(largest)}."


def _largest(differences: FloatArray) -> str:
    """The longest of (..., C) vectors [m], in words."""
    if not np.isfinite(differences).all():
        return "more than any number (it diverged)"
    return f"{number_text(1e3 * float(np.linalg.norm(differences, axis=-1).max()))} mm"


def svg_address(svg: bytes) -> str:
    """Return a picture as a data address, for a page that needs no other file."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode("ascii")
