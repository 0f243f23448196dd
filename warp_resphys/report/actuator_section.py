"""The section on the learned actuator: whether it is used,
and what acts under commands that rise and fall.

A Gaussian process of the inputs changes them (`data.input_network`). Parts that no trial drives are
left out.
"""

from typing import Final

import numpy as np

from ..data.input_response import InputResponse, response_of
from ..io.arrays import FloatArray
from ..learning.scores import text_of
from . import figures
from .data import Driven, RunReport, folds_in
from .page import Block, Canvas, Drawn, Part, Text
from .wording import TONES, in_a_row, unbroken

_SECONDS: Final = 3.0  # in which commands rise to the largest ones of the trials, and fall again
_STEPS: Final = 150  # of each
_COLUMNS: Final = 3
_MOST: Final = 12  # parts that are drawn


def actuator_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns the curves of the inputs that act over the commands.

    None where no actuator was learned.
    """
    driven = data.driven
    if driven is None or driven.quantity.name not in data.actuator:
        return None
    tests = [
        fold["networks"]["actuator"]["test"]
        for fold in folds_in(data.metrics)
        if "actuator" in fold["networks"]
    ]
    test = next((test for test in tests if test is not None), None)
    said = "It was not tested on held-out trials." if test is None else f"Tested {text_of(test)}."
    if test is not None and not test["used"]:
        said += " So it is not used."
    words, filters = driven.quantity.plural, data.actuator[driven.quantity.name].filters
    means = (
        f" and their exponential means over {in_a_row([f'{time:g} s' for time in filters])}"
        if filters
        else ""
    )
    text = (
        f"A Gaussian process changes the {words} of the identified response. It takes all "
        f"{words}{means}, and was trained through the simulator. {said}"
    )
    blocks: list[Block] = [Text(unbroken(text)), *_curves(data, driven, canvas)]
    return Part("The learned actuator", blocks)


def _curves(data: RunReport, driven: Driven, canvas: Canvas) -> list[Drawn]:
    """Draws what acts in each part over its command,
    while the other parts have their mean commands.
    """
    quantity, used = driven.quantity, [*driven.used[:_MOST]]
    parts = [driven.channels[number] for number in used]
    commands, acting = (values[:, used] for values in risen_and_fallen(data, driven))
    rows = -(-len(parts) // _COLUMNS)
    figure = figures.new_figure(1.0 + 2.2 * rows)
    grid = figure.subplots(rows, min(len(parts), _COLUMNS), squeeze=False, sharex=True, sharey=True)
    colour, muted = TONES["actuator"].light, TONES["muted"].light
    for number, (axes, part) in enumerate(zip(grid.flat, parts, strict=False)):
        x, y = (quantity.shown_factor * values[:, number] for values in (commands, acting))
        axes.plot(
            x[:_STEPS],
            x[:_STEPS],
            color=muted,
            linewidth=1.0,
            linestyle=(0, (1, 2)),
            label="as commanded",
        )
        axes.plot(x[:_STEPS], y[:_STEPS], color=colour, linewidth=1.7, label="rising")
        axes.plot(
            x[_STEPS:],
            y[_STEPS:],
            color=colour,
            linewidth=1.7,
            linestyle=(0, (4, 1.5)),
            label="falling",
        )
        axes.set_title(part.replace("_", " "), loc="left", fontsize="medium")
    for axes in grid.flat[len(parts) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel(f"commanded [{quantity.shown_unit}]")
    for axes in grid[:, 0]:
        axes.set_ylabel(f"acting [{quantity.shown_unit}]")
    handles, labels = grid.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=3, columnspacing=1.6)
    ends = "; ".join(
        f"{part}: {quantity.shown(y[_STEPS - 1])} at {quantity.shown(x[_STEPS - 1])}"
        for part, x, y in zip(parts, commands.T, acting.T, strict=False)
    )
    words = quantity.words[:1].upper() + quantity.words[1:]
    caption = (
        f"{words} that acts in each part while its command rises to the largest one of the "
        f"trials in {_SECONDS:g} s and falls again; the other parts have their mean commands."
    )
    return [
        canvas.figure(
            "actuator",
            figure,
            unbroken(f"{words} that acts over the commanded one. {ends}."),
            caption,
        )
    ]


def risen_and_fallen(data: RunReport, driven: Driven) -> tuple[FloatArray, FloatArray]:
    """Returns commands (T, C) of each part, which rise and fall one after the other,
    and what acts in that part.
    """
    trials = np.concatenate([*driven.values.values()])
    high = trials.max(0)
    mean = trials.mean(0)
    count = trials.shape[1]
    ramp = np.linspace(0.0, 1.0, _STEPS)
    ramp = np.concatenate([ramp, ramp[::-1]])
    parameters = data.identification["sysid"].parameters if "sysid" in data.identification else {}
    if "law" in data.metrics["errors_mm"]:
        parameters = data.metrics["law"]["others"]
    arguments = response_of(driven.quantity, parameters, driven.channels, data.actuator)
    response = InputResponse(_SECONDS / _STEPS, **arguments)
    each = np.tile(mean, (len(ramp), count, 1))  # (T, C, C): part by part
    each[:, range(count), range(count)] = ramp[:, None] * high
    moves = data.trials is None or data.trials.moves
    acting = response(response.steady(each[0]), each)[0] if moves else response.still(each)
    return ramp[:, None] * high, acting[:, range(count), range(count)]
