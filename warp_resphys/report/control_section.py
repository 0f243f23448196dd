"""The section on control: errors of followed paths on the simulated laboratory,
how motions were planned.
"""

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from ..io.arrays import FloatArray
from ..settings.control import ControlSettings
from . import figures
from .body_motions import plane_axes
from .data import ControlResults, FollowedPath, RunReport, TrackingErrors
from .page import Canvas, Cell, Items, PageTable, Part, Row, Text
from .wording import (
    MODELS,
    NONE,
    TONES,
    compared_controllers,
    controller_name,
    controller_words,
    mm_text,
    number_text,
)

# By beginning of a controller's name.
_LINES: Final[Mapping[str, str | tuple[int, tuple[int, int]]]] = {
    "open": (0, (4, 2)),
    "receding": "-",
}
_COLUMNS: Final = 5  # Of followed paths.


def control_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns the section; None where nothing is controlled, or no simulation plays the robot."""
    metrics, control = data.metrics.get("control"), data.settings.control
    if metrics is None or control is None:
        return None
    blocks: list[Any] = [Text(_task(control), "control"), tracking_table(metrics["tracking"])]
    slowest = max(control.seconds)
    drawn = [followed for followed in data.followed if followed.seconds == slowest]
    if drawn:
        named = {
            controller: controller_name(controller) for controller in compared_controllers(control)
        }
        names = ", ".join(named.values())
        alt = f"{len(drawn)} paths of {slowest:g} s, and the paths of the point with {names}."
        caption = (
            f"Paths of {slowest:g} s (grey), and the paths of the point in the simulated "
            f"laboratory with {names}. The point starts from where the tip hangs."
        )
        plane = np.array([control.right, control.up], dtype=np.float64)
        blocks.append(canvas.figure("control", followed_paths(drawn, named, plane), alt, caption))
    blocks += [Text("How it was planned", heading=True), Items(_facts(metrics), "planned")]
    return Part("Control", blocks)


def followed_paths(
    paths: Sequence[FollowedPath], controllers: Mapping[str, str], plane: FloatArray
) -> Figure:
    """Draws paths and the paths of the controlled point,
    side by side in their plane (2, 3): its width and height.

    Controllers are drawn in the order of their names, with their names in words.
    """
    columns = min(_COLUMNS, len(paths))
    rows = -(-len(paths) // columns)
    figure = figures.new_figure(figures.WIDE / columns * rows + 0.35)
    every = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    across = 1e3 * plane_axes(plane)
    middle = np.mean([followed.path.mean(axis=0) for followed in paths], axis=0)
    lines: dict[str, Any] = {}
    for axes, followed in zip(every, paths, strict=False):
        x, y = ((followed.path - middle) @ across.T).T
        (lines["path"],) = axes.plot(x, y, color=TONES["target"].light, linewidth=3.2)
        for controller, name in controllers.items():
            beginning, model = controller.split("_", 1)
            x, y = ((followed.points[controller] - middle) @ across.T).T
            tone = TONES[model].light
            (lines[name],) = axes.plot(x, y, color=tone, linestyle=_LINES[beginning], linewidth=1.1)
        axes.set_aspect("equal")
        axes.set_title(followed.name)
        axes.grid(False)
    for axes in every[len(paths) :]:
        axes.set_visible(False)
    for axes in every:
        axes.tick_params(labelsize=figures.STYLE["xtick.labelsize"] - 1.5)
    every[0].set_ylabel("mm")
    figure.legend(
        list(lines.values()), list(lines), loc="outside upper left", ncols=4, columnspacing=1.6
    )
    return figure


def _task(control: ControlSettings) -> str:
    shapes, tracked = control.shapes, control.tracked
    named = (
        f"the mean of {', '.join(tracked[:-1])} and {tracked[-1]}"
        if len(tracked) > 1
        else tracked[0]
    )
    return (
        f"A point, {named}, follows {len(shapes)} paths ({', '.join(shapes)}) of "
        f"{1e3 * control.size:g} mm, by inputs within their limits of value and rate, applied to "
        "the simulation that plays the robot. Errors are distances of the point from the path "
        "at the same time, without camera noise."
    )


def tracking_table(tracking: Mapping[str, Mapping[str, TrackingErrors]]) -> PageTable:
    """Returns the errors of the controllers by the duration of the paths."""
    first = next(iter(tracking.values()))
    best = min(first, key=lambda controller: first[controller]["mean_mm"])

    def cell(errors: TrackingErrors | None) -> Cell:
        if errors is None:
            return Cell(NONE)
        return Cell(
            number_text(errors["mean_mm"]), beside=f"at most {number_text(errors['max_mm'])}"
        )

    rows = []
    for controller in first:
        name, meaning = controller_words(controller)
        cells = [cell(errors.get(controller)) for errors in tracking.values()]
        rows.append(Row(name, cells, "best" * (controller == best), meaning))
    return PageTable(
        "Mean error of the point [mm]", [f"Paths in {float(speed):g} s" for speed in tracking], rows
    )


def _facts(metrics: ControlResults) -> list[str]:
    facts = []
    for model, reduced in metrics["reduced"].items():
        window, whole = mm_text(reduced["window_error_mm"]), mm_text(reduced["whole_error_mm"])
        facts.append(
            f"{MODELS[model].name} in {reduced['modes']} modes: over {reduced['window_s']:g} s, "
            f"{window} from the full model, {100.0 * reduced['window_relative']:.1f} % of its "
            f"motion; over whole motions, {whole}."
        )
    # By motion: errors before and after each correction.
    for model, motions in metrics["planned_mm"].items():
        first = fmean(errors[0] for errors in motions.values())
        last = fmean(map(min, motions.values()))
        facts.append(
            f"{MODELS[model].name} follows its own plans to {mm_text(last)} after corrections by "
            f"its full simulator, to {mm_text(first)} before."
        )
    for controller, times in metrics["command_ms"].items():
        if controller.startswith("receding_"):
            facts.append(
                f"{controller_name(controller)}: a command takes {times['median']:.1f} ms, 95 % "
                f"of them less than {times['largest_of_20']:.1f} ms, "
                "estimate and plan together, on one core."
            )
    return facts
