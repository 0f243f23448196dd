"""The page of a law that was identified from tests of specimens:
stress over strain, errors, classes, coefficients.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypedDict

import numpy as np

from ...core.energies.catalogue import LawContent
from ...io.arrays import FloatArray
from ...settings.run import RunSettings
from .. import figures
from ..identification_section import identified_cell, within_sentence
from ..law_section import wording
from ..page import Block, Canvas, Cell, Drawn, PageTable, Part, Row, Text, Usage, write_page
from ..wording import NONE, TONES, in_a_row, number_text, share_text, significant, unbroken

_MODELS: Final = {
    "law": "Law",
    "unscaled": "Unscaled law",
    "neo_hookean": "Neo-Hookean",
    "hooke": "Hooke",
}
_PARTS: Final = {"range": "in the range", "beyond": "beyond, up to twice"}
_CLOSER: Final = 0.98  # ratio of errors below which a law is more accurate than a simpler one
_HEIGHT: Final = 2.7  # inch, of a panel
_ROW: Final = 2  # panels side by side


class SpecimenResult(TypedDict):
    """Errors and curves of a test."""

    kind: str
    held_out: bool  # the law was not identified from it
    errors: dict[str, dict[str, float | None]]  # relative RMS by part of the strains, by model
    covered: float | None  # share of the samples beyond the range in the 90 % interval
    strain: list[float]  # measured, of the specimen
    stress: list[float]  # measured, without the zero of the load cell [Pa]
    shown: list[float]  # strains of the curves
    curves: dict[str, list[float] | None]  # stress of models at these, None if unbalanced [Pa]
    half_width: list[float] | None  # of the 90 % interval of the law [Pa]
    range: list[float]  # strains that the law is identified from


class MaterialMetrics(Usage, total=False):
    """Content of metrics.json of a run with tests of specimens."""

    tests: dict[str, SpecimenResult]
    machines: dict[str, dict[str, float]]  # constants of the machines by test
    rates: list[float] | None  # least and largest rate of strain [1/s]
    factor: float | None  # of the law that was scaled
    left_out: list[str]  # sentences on what was left out of the tests
    parameters: Mapping[str, float]


def specimen_table(metrics: MaterialMetrics) -> PageTable:
    """Returns the relative errors, with a row for each test and part of its strains."""
    rows, models = [], _models(metrics)
    scaled = metrics.get("factor") is not None
    for name, result in metrics["tests"].items():
        for part, words in _PARTS.items():
            errors = result["errors"][part]
            if errors["law"] is not None or part == "range":
                cells = [Cell(_percent(errors.get(model))) for model in models]
                held = result["covered"] if part == "beyond" else None
                within = [] if scaled else [Cell(NONE if held is None else share_text(held))]
                rows.append(
                    Row(
                        f"{name}, {'predicted' if result['held_out'] else words}", [*cells, *within]
                    )
                )
    heads = [
        *(f"{_MODELS[model]} [%]" for model in models),
        *([] if scaled else ["In the 90 % interval"]),
    ]
    return PageTable("Test", heads, rows, _SCALED if scaled else _NOTE)


def _models(metrics: MaterialMetrics) -> list[str]:
    """Returns the models of the tests, in their order."""
    known = set[str]().union(*(one["errors"]["range"] for one in metrics["tests"].values()))
    return [model for model in _MODELS if model in known]


def material_verdict(metrics: MaterialMetrics, law: LawContent, run: RunSettings) -> list[str]:
    """Returns how accurate the law is, beside the simplest ones, and advice."""
    terms_of = {name: value for name, value in law["parameters"].items() if value}
    names = [name for name in terms_of if not name.startswith(("density", "bulk_1", "prony"))]
    branches = sum(name.startswith("prony_time") for name in law["parameters"])
    terms = [within_sentence(wording(name)[0][0]) for name in names]
    words = in_a_row(
        [*terms, *([f"{branches} relaxing branch{'es' * (branches > 1)}"] if branches else [])]
    )
    notes = metrics.get("left_out", [])
    factor = metrics.get("factor")
    if factor is not None:
        return [*_scaled_verdict(metrics, factor), *notes]
    shown = {part: _mean(metrics, part) for part in _PARTS}
    part = "beyond" if shown["beyond"]["law"] is not None else "range"
    errors = {model: value for model, value in shown[part].items() if value is not None}
    simplest = min(("neo_hookean", "hooke"), key=lambda model: errors[model])
    where = (
        "up to twice the largest strain that it was identified from"
        if part == "beyond"
        else "in the tests"
    )
    text = f"The law ({words}) has an error of {_percent(errors['law'])} % {where}"
    if errors["law"] < _CLOSER * errors[simplest]:
        text += f"; {_MODELS[simplest]} has {_percent(errors[simplest])} %"
    elif law.get("groups"):
        text += f"; {_MODELS[simplest]} is closer ({_percent(errors[simplest])} %)"
    said = [f"{text}."]
    if run.material_tests is not None and (played := run.material_tests.simulated) is not None:
        true, found = played.material, law["parameters"]
        off = [
            f"{name} {100.0 * (found.get(name, 0.0) / x - 1.0):+.2f} %"
            for name, x in true.items()
            if x
        ]
        said.append(f"Errors of the coefficients, which are known here: {in_a_row(off)}.")
    return [*said, *notes]


def _scaled_verdict(metrics: MaterialMetrics, factor: float) -> list[str]:
    """Returns the factor of a scaled law, and its errors in the tests that it predicts."""
    held = {
        name: one["errors"]["range"]["law"]
        for name, one in metrics["tests"].items()
        if one["held_out"]
    }
    known = {name: error for name, error in held.items() if error is not None}
    said = [f"The law is the given one times {factor:.3g}."]
    if known:
        worst = max(known, key=lambda name: known[name])
        mean = float(np.sqrt(np.square([*known.values()]).mean()))
        said.append(
            f"It predicts {len(known)} tests that it was not scaled to with an error of "
            f"{_percent(mean)} %, at most {_percent(known[worst])} % ({worst})."
        )
    lost = [name for name in held if name not in known]
    if lost:
        said.append(f"It has no equilibrium in {in_a_row(lost)}: give data.range lower heights.")
    return said


def _mean(metrics: MaterialMetrics, part: str) -> dict[str, float | None]:
    """Returns the root mean square over the tests, by model; None without samples."""
    errors = [result["errors"][part] for result in metrics["tests"].values()]
    known = {model: [x for one in errors if (x := one.get(model)) is not None] for model in _MODELS}
    return {m: float(np.sqrt(np.square(x).mean())) if x else None for m, x in known.items()}


def _percent(error: float | None) -> str:
    return NONE if error is None else number_text(100.0 * error)


def write_material_report(
    path: Path, metrics: MaterialMetrics, run: RunSettings, law: LawContent
) -> None:
    """Writes the page, see `write_page`.

    Raises:
        DataFileError: a file cannot be written.
    """

    def sections(canvas: Canvas) -> Iterator[Part]:
        yield Part("", [draw_curves(metrics["tests"], canvas), specimen_table(metrics)])
        chosen = bool(law.get("classes"))  # not scaled
        yield Part(
            "Law", [_coefficients(law), *_machines(metrics), *([_classes(law)] if chosen else [])]
        )
        if chosen:
            yield Part("How it is compared", [Text(_HOW)])

    write_page(path, sections, run, material_verdict(metrics, law, run), metrics)


_NOTE: Final = (
    "Relative root mean squares of the stress. Hooke is a straight line with a free zero of the "
    "load cell; Neo-Hookean has c10 alone, with the same unknown constants of the machine, and "
    "branches if there are any."
)
_SCALED: Final = (
    "Relative root mean squares of the stress, or of the pressure of a membrane. The law is the "
    "given one times a factor; Neo-Hookean is c10 alone, scaled alike, as far as it then has an "
    "equilibrium in every test. Without a number, "
    "the model has none that is stable under that load."
)
_HOW: Final = (
    "Every class of laws is fitted to the lower 60 % of the strains, and predicts the rest. The "
    "smallest class whose error there is at most 1.25 times the least is fitted to the whole "
    "range. The 90 % interval covers the posterior of the coefficients and the misfit in the "
    "range; beyond, it grows by 25 % of the stress with each doubling of the strain, as nine of "
    "ten errors did over 19 silicones of a public database."
)


def draw_curves(tests: Mapping[str, SpecimenResult], canvas: Canvas) -> Drawn:
    """Draws stress over strain of every test."""
    columns = min(len(tests), _ROW)
    rows = -(-len(tests) // columns)
    figure = figures.new_figure(_HEIGHT * rows + 0.5)
    axes = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    for axis, (name, result) in zip(axes, tests.items(), strict=False):
        shown = 100.0 * np.array(result["shown"])
        axis.plot(
            100.0 * np.array(result["strain"]),
            1e-3 * np.array(result["stress"]),
            linestyle="",
            marker=".",
            markersize=3.0,
            color=TONES["ink"].light,
            label="measured",
        )
        law = _in_kilopascals(result["curves"]["law"])
        if law is not None and result["half_width"] is not None:
            half = 1e-3 * np.array(result["half_width"])
            band: dict[str, Any] = {"color": TONES["law"].light, "alpha": 0.18, "linewidth": 0.0}
            axis.fill_between(shown, law - half, law + half, **band, label="90 % interval")
        if law is not None:
            axis.plot(shown, law, color=TONES["law"].light, linewidth=1.8, label="law")
        for model, style in _STYLES.items():
            values = _in_kilopascals(result["curves"].get(model))
            if values is not None:
                line: dict[str, Any] = {
                    "color": TONES["muted"].light,
                    "linewidth": 1.1,
                    "linestyle": style,
                }
                axis.plot(shown, values, **line, label=_MODELS[model])
        end = 100.0 * result["range"][1]
        if end < shown[-1]:
            axis.axvline(end, color=TONES["rule"].light, linewidth=1.2)
            axis.text(
                end,
                0.97,
                "identified up to here ",
                transform=axis.get_xaxis_transform(),
                **_LEARNED,
            )
        labels = ("height over radius [%]", "pressure [kPa]")
        across, up = labels if result["kind"] == "bulge" else ("strain [%]", "nominal stress [kPa]")
        axis.set(xlabel=across, ylabel=up, title=name, xlim=(0.0, shown[-1]))
        axis.set_ylim(bottom=0.0)
    for axis in axes[len(tests) :]:
        axis.set_axis_off()
    handles, words = axes[0].get_legend_handles_labels()
    figure.legend(handles, words, loc="outside upper left", ncols=5)
    ends = "; ".join(
        f"{name}: law {_percent(result['errors']['range']['law'])} %"
        for name, result in tests.items()
    )
    return canvas.figure(
        "curves",
        figure,
        unbroken(f"Stress over strain. Relative errors in the range: {ends}."),
        _CAPTION,
    )


def _in_kilopascals(values: list[float] | None) -> FloatArray | None:
    return None if values is None else 1e-3 * np.array(values)


_STYLES: Final = {"unscaled": (0, (6, 1, 1, 1)), "neo_hookean": (0, (4, 2)), "hooke": (0, (1, 1.2))}
_LEARNED: Final[dict[str, Any]] = {
    "fontsize": 7.5,
    "ha": "right",
    "va": "top",
    "color": TONES["muted"].light,
}
_CAPTION: Final = (
    "Nominal stress over strain of the specimen, without the zero of the load cell; pressure "
    "over height of a membrane."
)


def _coefficients(law: LawContent) -> PageTable:
    """Returns the coefficients with their standard deviations."""
    rows = []
    for name, value in law["parameters"].items():
        if name != "density":
            (words, unit, factor), meaning = wording(name)
            deviation = law.get("deviation", {}).get(name)
            rows.append(
                Row(
                    words,
                    [identified_cell(value, factor, deviation), Cell(unit or NONE)],
                    small=meaning,
                )
            )
    note = "± is one standard deviation. The change of volume is of Poisson's ratio as configured."
    return PageTable("Term", ["Identified", "Unit"], rows, note)


def _machines(metrics: MaterialMetrics) -> list[Block]:
    """Returns the unknown constants of the machines."""
    units = {
        "zero": ("kPa", 1e-3),
        "toe": ("%", 100.0),
        "compliance": ("% of the length per MPa", 1e8),
    }
    known = set[str]().union(*metrics["machines"].values())
    names = [name for name in units if name in known]
    if not names:
        return []
    rows = []
    for test, machine in metrics["machines"].items():
        cells = [
            Cell(significant(units[name][1] * machine[name], 3) if name in machine else NONE)
            for name in names
        ]
        rows.append(Row(test, cells))
    return [
        PageTable("Machine", [f"{name.capitalize()} [{units[name][0]}]" for name in names], rows)
    ]


def _classes(law: LawContent) -> PageTable:
    """Classes that were tried, with their errors in the lower and the upper part of strains."""
    rows = []
    for tried in law.get("classes", ()):
        words = (
            in_a_row([within_sentence(wording(name)[0][0]) for name in tried["groups"]])
            or "none (neo-Hookean)"
        )
        cells = [Cell(_percent(tried["residual"])), Cell(_percent(tried["validation"]))]
        rows.append(Row(words, cells, "chosen" * (tried["groups"] == law["groups"])))
    return PageTable(
        "Terms beside c10", ["Lower 60 % of the strains [%]", "Predicted rest [%]"], rows
    )
