"""The page of a law that was identified from tests of specimens: stress over strain, errors, classes, coefficients."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypedDict

import numpy as np

from ...energies.catalogue import LawContent
from ...settings.run import RunSettings
from .. import figures
from ..identification_section import identified_cell, within_sentence
from ..law_section import wording
from ..page import Block, Canvas, Cell, Drawn, PageTable, Part, Row, Text, Usage, write_page
from ..wording import NONE, TONES, in_a_row, number_text, share_text, significant, unbroken

_MODELS: Final = {"law": "Law", "neo_hookean": "Neo-Hookean", "hooke": "Hooke"}
_PARTS: Final = {"range": "in the range", "beyond": "beyond, up to twice"}
_CLOSER: Final = 0.98  # ratio of errors below which a law is more accurate than a simpler one
_HEIGHT: Final = 2.7  # inch, of a panel
_ROW: Final = 2  # panels side by side


class SpecimenResult(TypedDict):
    """Errors and curves of a test."""

    kind: str
    errors: dict[str, dict[str, float | None]]  # relative root mean squares by part of the strains and by model
    covered: float | None  # share of the samples beyond the range in the 90 % interval
    strain: list[float]  # measured, of the specimen
    stress: list[float]  # measured, without the zero of the load cell [Pa]
    shown: list[float]  # strains of the curves
    law: list[float]  # stress of the models at these [Pa]
    half_width: list[float] | None  # of the 90 % interval of the law [Pa]
    neo_hookean: list[float]
    hooke: list[float]
    range: list[float]  # strains that the law is identified from


class MaterialMetrics(Usage, total=False):
    """Content of metrics.json of a run with tests of specimens."""

    tests: dict[str, SpecimenResult]
    machines: dict[str, dict[str, float]]  # constants of the machines by test
    rates: list[float] | None  # least and largest rate of strain [1/s]
    parameters: Mapping[str, float]


def specimen_table(metrics: MaterialMetrics) -> PageTable:
    """Returns the relative errors, with a row for each test and part of its strains."""
    rows = []
    for name, result in metrics["tests"].items():
        for part, words in _PARTS.items():
            errors = result["errors"][part]
            if errors["law"] is not None:
                cells = [Cell(_percent(errors[model])) for model in _MODELS]
                held = result["covered"] if part == "beyond" else None
                rows.append(Row(f"{name}, {words}", [*cells, Cell(NONE if held is None else share_text(held))]))
    return PageTable("Test", [*(f"{name} [%]" for name in _MODELS.values()), "In the 90 % interval"], rows, _NOTE)


def material_verdict(metrics: MaterialMetrics, law: LawContent, run: RunSettings) -> list[str]:
    """Returns how accurate the law is, beside the simplest ones, and advice."""
    names = [name for name in law["parameters"] if not name.startswith(("density", "bulk_1", "prony"))]
    branches = sum(name.startswith("prony_time") for name in law["parameters"])
    terms = [within_sentence(wording(name)[0][0]) for name in names]
    words = in_a_row([*terms, *([f"{branches} relaxing branch{'es' * (branches > 1)}"] if branches else [])])
    shown = {part: _mean(metrics, part) for part in _PARTS}
    part = "beyond" if shown["beyond"]["law"] is not None else "range"
    errors = {model: value for model, value in shown[part].items() if value is not None}
    simplest = min(("neo_hookean", "hooke"), key=lambda model: errors[model])
    where = "up to twice the largest strain that it was identified from" if part == "beyond" else "in the tests"
    text = f"The law ({words}) has an error of {_percent(errors['law'])} % {where}"
    if errors["law"] < _CLOSER * errors[simplest]:
        text += f"; {_MODELS[simplest]} has {_percent(errors[simplest])} %"
    elif law.get("groups"):
        text += f"; {_MODELS[simplest]} is closer ({_percent(errors[simplest])} %)"
    said = [f"{text}."]
    if run.material_tests is not None and (played := run.material_tests.simulated) is not None:
        true, found = played.material, law["parameters"]
        off = [f"{name} {100.0 * (found.get(name, 0.0) / x - 1.0):+.2f} %" for name, x in true.items() if x]
        said.append(f"Errors of the coefficients, which are known here: {in_a_row(off)}.")
    return said


def _mean(metrics: MaterialMetrics, part: str) -> dict[str, float | None]:
    """Returns the root mean square over the tests, by model; None without samples."""
    errors = [result["errors"][part] for result in metrics["tests"].values()]
    known = {model: [x for one in errors if (x := one[model]) is not None] for model in _MODELS}
    return {m: float(np.sqrt(np.square(x).mean())) if x else None for m, x in known.items()}


def _percent(error: float | None) -> str:
    return NONE if error is None else number_text(100.0 * error)


def write_material_report(path: Path, metrics: MaterialMetrics, run: RunSettings, law: LawContent) -> None:
    """Writes the page, see `write_page`.

    Raises:
        DataFileError: a file cannot be written.
    """

    def sections(canvas: Canvas) -> Iterator[Part]:
        yield Part("", [draw_curves(metrics["tests"], canvas), specimen_table(metrics)])
        yield Part("Law", [_coefficients(law), *_machines(metrics), _classes(law)])
        yield Part("How it is compared", [Text(_HOW)])

    write_page(path, sections, run, material_verdict(metrics, law, run), metrics)


_NOTE: Final = (
    "Relative root mean squares of the stress. Hooke is a straight line with a free zero of the load cell; Neo-Hookean "
    "has c10 alone, with the same unknown constants of the machine, and branches if there are any."
)
_HOW: Final = (
    "Every class of laws is fitted to the lower 60 % of the strains, and predicts the rest. The smallest class whose "
    "error there is at most 1.25 times the least is fitted to the whole range. The 90 % interval covers the posterior "
    "of the coefficients and the misfit in the range; beyond, it grows by 25 % of the stress with each doubling of the "
    "strain, as nine of ten errors did over 19 silicones of a public database."
)


def draw_curves(tests: Mapping[str, SpecimenResult], canvas: Canvas) -> Drawn:
    """Draws stress over strain of every test."""
    columns = min(len(tests), _ROW)
    rows = -(-len(tests) // columns)
    figure = figures.new_figure(_HEIGHT * rows + 0.5)
    axes = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    for axis, (name, result) in zip(axes, tests.items(), strict=False):
        shown, law = 100.0 * np.array(result["shown"]), 1e-3 * np.array(result["law"])
        axis.plot(
            *(100.0 * np.array(result["strain"]), 1e-3 * np.array(result["stress"])),
            **{"linestyle": "", "marker": ".", "markersize": 3.0, "color": TONES["ink"].light, "label": "measured"},
        )
        if result["half_width"] is not None:
            half = 1e-3 * np.array(result["half_width"])
            band: dict[str, Any] = {"color": TONES["law"].light, "alpha": 0.18, "linewidth": 0.0}
            axis.fill_between(shown, law - half, law + half, **band, label="90 % interval")
        axis.plot(shown, law, color=TONES["law"].light, linewidth=1.8, label="law")
        for model, style in (("neo_hookean", (0, (4, 2))), ("hooke", (0, (1, 1.2)))):
            values = 1e-3 * np.array(result[model])  # type: ignore[literal-required]
            axis.plot(shown, values, color=TONES["muted"].light, linewidth=1.1, linestyle=style, label=_MODELS[model])
        end = 100.0 * result["range"][1]
        if end < shown[-1]:
            axis.axvline(end, color=TONES["rule"].light, linewidth=1.2)
            axis.text(end, 0.97, "identified up to here ", transform=axis.get_xaxis_transform(), **_LEARNED)
        axis.set(xlabel="strain [%]", ylabel="nominal stress [kPa]", title=name, xlim=(0.0, shown[-1]))
        axis.set_ylim(bottom=0.0)
    for axis in axes[len(tests) :]:
        axis.set_axis_off()
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=5)
    ends = "; ".join(f"{name}: law {_percent(result['errors']['range']['law'])} %" for name, result in tests.items())
    return canvas.figure(
        "curves", figure, unbroken(f"Stress over strain. Relative errors in the range: {ends}."), _CAPTION
    )


_LEARNED: Final[dict[str, Any]] = {"fontsize": 7.5, "ha": "right", "va": "top", "color": TONES["muted"].light}
_CAPTION: Final = "Nominal stress over strain of the specimen, without the zero of the load cell."


def _coefficients(law: LawContent) -> PageTable:
    """Returns the coefficients with their standard deviations."""
    rows = []
    for name, value in law["parameters"].items():
        if name != "density":
            (words, unit, factor), meaning = wording(name)
            deviation = law.get("deviation", {}).get(name)
            rows.append(Row(words, [identified_cell(value, factor, deviation), Cell(unit or NONE)], small=meaning))
    note = "± is one standard deviation. The change of volume is of Poisson's ratio as configured."
    return PageTable("Term", ["Identified", "Unit"], rows, note)


def _machines(metrics: MaterialMetrics) -> list[Block]:
    """Returns the unknown constants of the machines."""
    units = {"zero": ("kPa", 1e-3), "toe": ("%", 100.0), "compliance": ("% of the length per MPa", 1e8)}
    names = [name for name in units if any(name in machine for machine in metrics["machines"].values())]
    if not names:
        return []
    rows = [
        Row(test, [Cell(significant(units[name][1] * machine[name], 3) if name in machine else NONE) for name in names])
        for test, machine in metrics["machines"].items()
    ]
    return [PageTable("Machine", [f"{name.capitalize()} [{units[name][0]}]" for name in names], rows)]


def _classes(law: LawContent) -> PageTable:
    """Returns the classes that were tried, with their errors in the lower and the upper part of the strains."""
    rows = []
    for tried in law.get("classes", ()):
        words = in_a_row([within_sentence(wording(name)[0][0]) for name in tried["groups"]]) or "none (neo-Hookean)"
        cells = [Cell(_percent(tried["residual"])), Cell(_percent(tried["validation"]))]
        rows.append(Row(words, cells, "chosen" * (tried["groups"] == law["groups"])))
    return PageTable("Terms beside c10", ["Lower 60 % of the strains [%]", "Predicted rest [%]"], rows)
