"""The section on control: how well paths are followed on the simulated laboratory, and how that was planned."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .data import MODELS, RunReport
from .page import NONE, Canvas, Cell, Items, Part, Row, Table, Text, mm_text, number_text, percent_text

FloatArray = NDArray[np.float64]

_KINDS: Final[Mapping[str, tuple[str, str]]] = {  # by the beginning of a controller's name: its name and its meaning
    "open_": ("{}, open loop", "planned once, on the whole path, and played"),
    "receding_linear": ("Linear model, receding horizon", "dynamic mode decomposition of the same recordings"),
    "receding_": ("{}, receding horizon", "planned anew at each step, from an estimate by the markers"),
    "feedback_": ("Jacobian feedback, {}/s", "by how the point moved when each input was pressed"),
}


def control_section(data: RunReport, canvas: Canvas) -> Part | None:
    """How well paths are followed; None where there is no control, or no simulation that plays the robot."""
    from . import control_figures

    found, control = data.metrics.get("control") or {}, data.settings.get("control")
    if not found or control is None:
        return None
    blocks: list[Any] = [Text(_what(control), "control"), _table(found["tracking"])]
    slowest = max(control["seconds"])
    drawn = [each for each in data.followed if each.seconds == slowest]
    if drawn:
        chosen = compared_controllers(control)
        named = {each: controller_name(each) for each in chosen}
        names = ", ".join(named.values())
        alt = f"{len(drawn)} paths of {slowest:g} s, and where the point went, by {names}."
        caption = (
            f"What was to be drawn in {slowest:g} s (grey), and what the simulated laboratory drew: {names}. The tip "
            "comes from where it hangs."
        )
        plane = np.array([control["right"], control["up"]], dtype=np.float64)
        blocks.append(
            canvas.figure("control", partial(control_figures.followed_paths, drawn, named, plane), alt, caption)
        )
    blocks += [Text("How it was planned", heading=True), Items(_facts(found), "planned")]
    return Part("Control", blocks)


def controller_name(controller: str) -> str:
    """In words."""
    return _words(controller)[0]


def _words(controller: str) -> tuple[str, str]:
    """The name of a controller and its meaning."""
    beginning = next(each for each in _KINDS if controller.startswith(each))
    name, meaning = _KINDS[beginning]
    rest = controller.removeprefix(beginning)
    return name.format(MODELS[rest][0] if rest in MODELS else rest), meaning


def _what(control: Mapping[str, Any]) -> str:
    shapes, tracked = control["shapes"], control["tracked"]
    named = f"the mean of {', '.join(tracked[:-1])} and {tracked[-1]}" if len(tracked) > 1 else tracked[0]
    return (
        f"A point, {named}, follows {len(shapes)} paths ({', '.join(shapes)}) of {1e3 * control['size']:g} mm, by "
        "inputs within their bounds and rates, which are given to the simulation that plays the robot. Errors are "
        "distances of the point there from the path, at the same time, without the noise of the cameras."
    )


def _table(tracking: Mapping[str, Any]) -> Table:
    speeds = list(tracking)
    rows = []
    best = min(tracking[speeds[0]], key=lambda each: float(tracking[speeds[0]][each]["mean_mm"]))
    for controller in tracking[speeds[0]]:
        cells = []
        for speed in speeds:
            each = tracking[speed].get(controller)
            cells.append(
                Cell(NONE)
                if each is None
                else Cell(number_text(each["mean_mm"]), beside=f"at most {number_text(each['max_mm'])}")
            )
        name, meaning = _words(controller)
        rows.append(Row(name, cells, controller == best, meaning))
    return Table("Mean error of the point [mm]", [f"Paths in {float(speed):g} s" for speed in speeds], rows)


def compared_controllers(control: Mapping[str, Any]) -> list[str]:
    """Those that are drawn of the group ``control``: what most can be compared by."""
    models = [model for model in control["models"] if model in ("sysid", control["models"][-1])]
    return [*(f"open_{model}" for model in models), *(f"receding_{model}" for model in control["receding"][-1:])]


def _facts(found: Mapping[str, Any]) -> list[str]:
    said = []
    for model, told in found["reduced"].items():
        window, whole = mm_text(told["window_error_mm"]), mm_text(told["whole_error_mm"])
        said.append(
            f"{MODELS[model][0]} in {told['modes']} modes: over {told['window_s']:g} s, {window} from the full model, "
            f"{percent_text(told['window_relative'], 1)} of its motion; over whole motions, {whole}."
        )
    for model, motions in found["planned_mm"].items():
        first, last = (
            float(np.mean([series[at] if at == 0 else min(series) for series in _whole(motions)])) for at in (0, -1)
        )
        said.append(
            f"{MODELS[model][0]} follows its own plans to {mm_text(last)} after corrections by its full simulator, to "
            f"{mm_text(first)} before."
        )
    for controller, times in found["command_ms"].items():
        if controller.startswith("receding_"):
            said.append(
                f"{controller_name(controller)}: a command takes {times['median']:.1f} ms, 95 % of them less than "
                f"{times['largest_of_20']:.1f} ms, estimate and plan together, on one core."
            )
    return said


def _whole(motions: Mapping[str, Sequence[float]]) -> list[list[float]]:
    return [list(each) for each in motions.values()]
