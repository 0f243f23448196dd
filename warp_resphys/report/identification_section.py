"""The section on identification: parameters, and how well the trials determine them."""

import math
import re
from collections.abc import Mapping, Sequence
from itertools import chain, product
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from ..data.registration import root_mean_square
from ..data.rigid_bodies import as_markers, corners_of, owners
from ..learning.identification.search import Identification
from ..learning.parameters import split_name, value_name
from ..learning.placement import PlainPlacement
from ..settings.learning import IdentifySettings
from . import figures
from .data import RunReport
from .page import Canvas, Cell, PageTable, Part, Row, Text
from .wording import MINUS, MODELS, NO_BREAK_SPACE, NONE, TONES

# Name, unit on the page, and its number in an SI unit.
Wording = tuple[str, str, float]
_BAND: Final = "_(dead_band|zero|backlash)"  # In the unit of an input.
_UNITS: Final = (  # By patterns of names, of which the first one that fits counts.
    (r"(.+_)?youngs_modulus|(contact|surface)_stiffness.*", "kPa", 1e-3),
    (r"(.+_)?density", "kg/m³", 1.0),
    (r"(.+_)?mass_damping", "1/s", 1.0),
    (r"(.+_)?stiffness_damping|.+_(delay|rise)", "ms", 1e3),
    (r"gravity_tilt_.|(clamp|camera|obstacle)_turn.*", "°", 180.0 / np.pi),
    (r"tendon_(offset|bristle).+|(clamp|camera)_shift.*|obstacle_(growth|[xyz])(_.+)?", "mm", 1e3),
    (r"release_force_.", "N", 1.0),
    (r"principal_point_.", "px", 1.0),
    (r"prony_time_.+", "s", 1.0),
    (r"(.+_)?(pressure|stress)_slew", "µs/Pa", 1e6),
    (r"(.+_)?tension_slew", "µs/N", 1e6),
    (r".+_slew", "µs per unit", 1e6),
    (r"(fibre|tendon)_stiffness", "N/m", 1.0),
    (rf"muscle_contraction{_BAND}", "%", 100.0),
    (rf"(.+_)?(pressure|stress){_BAND}", "kPa", 1e-3),
    (rf"(.+_)?tension{_BAND}", "N", 1.0),
    (rf"(.+_)?contraction{_BAND}", "mm", 1e3),
)
_PROPER: Final = ("Young", "Poisson", "Prony", "Mooney", "Ogden")
_WHOLE: Final = (
    99.5  # Deviation from which on a parameter is not determined at all [% of its range].
)
_TIED: Final = 0.9  # Correlation from which on two parameters count as not separable.
_UNINFORMED: Final = (
    0.8  # Deviation over that of the prior, from which on the data add almost nothing.
)


def identification_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns the identified parameters, and how well the data determine them."""
    identified = {name: data.identification[name] for name in MODELS if name in data.identification}
    if not identified:
        return None
    columns = ["Data sheet", "Identified", *(["True"] if data.truth else []), "At a bound"]
    blocks: list[Any] = [
        PageTable(MODELS[name].name, columns, parameter_rows(result, data.start, data.truth))
        for name, result in identified.items()
    ]
    blocks += [
        table for result in identified.values() if (table := trials_table(result)) is not None
    ]
    texts = (
        uncertainty_text(name, result, data.settings.identify)
        for name, result in identified.items()
    )
    uncertain = list(filter(None, texts))
    notes = []
    if uncertain:
        notes.append(
            "± is one standard deviation in the Gauss-Newton approximation, for residuals "
            "correlated in time."
        )
    if data.truth:
        model = data.true_material.replace("_", " ")
        notes.append(
            f"The true values are those of the simulated laboratory, whose material is {model}."
        )
    blocks += [Text(" ".join(notes), note=True)] if notes else []
    blocks += [Text(text) for text in uncertain]
    placed = {
        name: result.placement
        for name, result in identified.items()
        if result.placement is not None
    }
    markers = data.settings.markers
    lengths = (
        {}
        if markers is None
        else {name: body.length for name, body in markers.rigid_bodies.items()}
    )
    blocks += [Text(placement_text(name, placement, lengths)) for name, placement in placed.items()]
    histories = {name: result.history for name, result in identified.items() if any(result.history)}
    if histories:
        alt = (
            "Loss of the identification over its evaluations, with a line for each start, on a "
            "logarithmic axis."
        )
        caption = (
            "Lowest loss so far over the evaluations, with a line for each start; the kept start "
            "is bold. The loss is the mean squared distance of the markers over the square of the "
            "motion’s amplitude."  # noqa: RUF001
        )
        blocks.append(canvas.figure("loss_history", loss_histories(histories), alt, caption))
    return Part("Identification", blocks)


def loss_histories(histories: Mapping[str, Sequence[Sequence[Mapping[str, float]]]]) -> Figure:
    """Draws the best loss so far over the evaluations of each start,
    with a panel for each identification.

    The starts of an identification have a record with `loss` for each evaluation.
    """
    figure = figures.new_figure(2.6)
    panels = list(figure.subplots(1, len(histories), sharey=True, squeeze=False).flat)
    for axes, (name, starts) in zip(panels, histories.items(), strict=True):
        ends = [record["loss"] for record in chain.from_iterable(starts)]
        for start in filter(None, starts):
            losses = np.fmin.accumulate(
                np.array([record["loss"] for record in start], dtype=np.float64)
            )
            best = bool(ends) and losses[-1] <= min(ends)
            tone, width = TONES["sysid" if best else "muted"].light, 1.8 if best else 0.9
            shown = figures.positive(losses)
            axes.plot(
                np.arange(1, len(losses) + 1),
                shown,
                ".-",
                color=tone,
                linewidth=width,
                markersize=3.5,
            )
        axes.set(title=MODELS[name].name, xlabel="evaluation")
        figures.count(axes.xaxis, 5)
    for axes in panels:  # Once everything is drawn, as they share their axis.
        figures.use_logarithm(axes)
    panels[0].set_ylabel("loss")
    return figure


def parameter_rows(
    identified: Identification, start: Mapping[str, float], truth: Mapping[str, float]
) -> list[Row]:
    """Returns a row for each parameter: values of data sheet, identification and truth if known.

    If at a bound.
    """
    rows = []
    for parameter, value in identified.parameters.items():
        whole, owner = split_name(parameter)
        words, unit, factor = parameter_wording(whole)
        words += f", {owner}" * bool(owner)
        known = identified_cell(value, factor, identified.deviation.get(parameter))
        cells = [Cell(digits(start.get(parameter), factor)), known]
        cells += [Cell(digits(truth.get(parameter, truth.get(whole)), factor))] if truth else []
        cells.append(Cell("yes" if parameter in identified.at_bounds else ""))
        rows.append(Row(f"{words} [{unit}]" if unit else words, cells))
    return rows


def trials_table(identified: Identification) -> PageTable | None:
    """Returns the values of single trials and sessions, with their standard deviations.

    None if there are none.

    The parameters are the rows if they are more than the trials and sessions, as those of chambers
    in two sessions.
    """
    values, deviations = identified.of_trials, identified.of_trials_deviation
    if not values:
        return None
    parameters = {}
    for name in values:
        parameter = split_name(name)[0]
        parameters[parameter] = parameter_wording(parameter)
    owners = list(dict.fromkeys(split_name(name)[1] for name in values))
    heads = [f"{words} [{unit}]" if unit else words for words, unit, _ in parameters.values()]

    def cell(parameter: str, owner: str) -> Cell:
        name = value_name(parameter, owner)
        return identified_cell(values.get(name), parameters[parameter][2], deviations.get(name))

    note = " ".join(
        filter(None, ("Identified with the prior.", first_frames_text(identified.first_frames)))
    )
    if len(parameters) > len(owners):
        rows = [
            Row(head, [cell(p, o) for o in owners])
            for p, head in zip(parameters, heads, strict=True)
        ]
        return PageTable("Value by trial or session", owners, rows, note)
    return PageTable(
        "Trial or session", heads, [Row(o, [cell(p, o) for p in parameters]) for o in owners], note
    )


def first_frames_text(first_frames: Mapping[str, Mapping[str, float]]) -> str:
    """Returns sentences on sessions and trials of which first frames give the values.

    Empty without any.
    """
    sessions = {
        owner: max(shown.values()) for owner, shown in first_frames.items() if owner not in shown
    }
    alone = [shown[owner] for owner, shown in first_frames.items() if owner in shown]
    parts = [
        f"session {name} are estimated from the first {seconds:g} s of its"
        for name, seconds in sessions.items()
    ]
    parts += (
        [f"held-out trials are estimated from the first {max(alone):g} s of these"] if alone else []
    )
    return " ".join(f"Values of {part} trials, which do not count in the errors." for part in parts)


def parameter_wording(parameter: str) -> Wording:
    """Returns the name of a parameter as in the settings but with spaces,
    its unit on the page, and the factor.
    """
    words = (
        parameter.replace("_", " ").replace("youngs", "Young's").replace("poissons", "Poisson's")
    )
    # The second one is that of a part, such as pressure_delay_1.
    names = (parameter, parameter.rpartition("_")[0])
    fits = (
        (unit, factor)
        for name, (pattern, unit, factor) in product(names, _UNITS)
        if re.fullmatch(pattern, name)
    )
    return words[0].upper() + words[1:], *next(fits, ("", 1.0))


def in_sentence(parameter: str) -> str:
    """Returns the name of a parameter as it stands within a sentence."""
    return within_sentence(parameter_wording(parameter)[0])


def within_sentence(words: str) -> str:
    """Returns words without their capital, unless they begin with a proper name."""
    return words if words.startswith(_PROPER) else words[0].lower() + words[1:]


def with_unit(parameter: str, value: float) -> str:
    """Returns a value of a parameter in its unit."""
    _, unit, factor = parameter_wording(parameter)
    return f"{digits(value, factor)} {unit}".rstrip()


def identified_cell(value: float | None, factor: float, deviation: float | None) -> Cell:
    """Returns a value in its unit with its standard deviation, if that is known."""
    beside = f"± {digits(deviation, factor, deviation)}" if deviation else ""
    return Cell(digits(value, factor, deviation), beside=beside)


def digits(value: float | None, factor: float, deviation: float | None = None) -> str:
    """Returns a value in its unit, with two digits of its standard deviation,
    or with four digits without one.
    """
    if value is None:
        return NONE
    if not deviation:
        return f"{factor * value:.4g}".replace("-", MINUS)
    text = f"{factor * value:.{max(0, 1 - math.floor(math.log10(factor * deviation)))}f}"
    return text.replace("-", MINUS) if float(text) else text.lstrip("-")


def placement_text(name: str, placed: PlainPlacement, lengths: Mapping[str, float]) -> str:
    """Returns a sentence on the identified displacements of markers
    and recordings from their nominal positions.

    The angle of a rigid body is the root mean square displacement of its points over its length
    [m].
    """
    labels, offsets = [*placed["offsets"]], np.array([*placed["offsets"].values()])
    away = dict(
        zip(owners(labels), 1e3 * np.linalg.norm(as_markers(offsets, labels), axis=1), strict=True)
    )
    furthest = max(away, key=lambda label: away[label])
    shift, turn = math.hypot(*placed["shift"]), math.hypot(*placed["turn"])
    text = (
        f"{MODELS[name].name}, identified with the parameters: markers are displaced from their "
        f"nominal positions, {furthest} the most, by {away[furthest]:.1f} mm; the recordings are "
        f"shifted by {1e3 * shift:.1f} mm and rotated by {math.degrees(turn):.1f}°"
    )
    for body, corners in corners_of(labels).items():
        angle = root_mean_square(offsets[corners] - offsets[corners].mean(axis=0)) / lengths[body]
        text += f"; {body} is turned by {math.degrees(angle):.1f}° on what carries it"
    text += "."
    return text.replace(" mm", f"{NO_BREAK_SPACE}mm")


def uncertainty_text(
    name: str, identified: Identification, settings: IdentifySettings | None
) -> str:
    """Returns sentences on the parameters of a model that the data do not determine.

    Empty without uncertainties.
    """
    uncertainty = identified.uncertainty
    if uncertainty is None:
        return ""
    names = list(identified.parameters)
    words = {parameter: in_sentence(parameter) for parameter in names}
    largest = max(abs(weight) for weight in uncertainty.poorest.values())
    along = " with ".join(
        words[p] for p, weight in uncertainty.poorest.items() if abs(weight) > 0.4 * largest
    )
    share = 100.0 * uncertainty.poorest_deviation
    known = f"{along} is least certain ({share:.2g} % of the range)."
    text = (
        f"{MODELS[name].name}: "
        f"{known if share < _WHOLE else f'the data do not constrain {along}: set a prior.'}"
    )
    correlation = np.array(uncertainty.correlation, dtype=np.float64)
    tied = [
        f"{words[names[i]]} and {words[names[j]]} (correlation {correlation[i, j]:+.2f})".replace(
            "-", MINUS
        )
        for j in range(len(names))
        for i in range(j)
        if abs(correlation[i, j]) > _TIED
    ]
    text += f" The data do not separate {', '.join(tied)}." if tied else ""
    unknown = list[str]()
    for parameter, deviation in uncertainty.deviation.items():
        limits = None if settings is None else settings.parameters.get(settings.key_of(parameter))
        prior = None if limits is None or limits.owner else limits.prior
        if prior is not None and deviation > _UNINFORMED * prior.deviation:
            _, unit, factor = parameter_wording(parameter)
            where = (
                f"{digits(prior.mean, factor)} ± {digits(prior.deviation, factor)} {unit}".rstrip()
            )
            unknown.append(f"{words[parameter]} beyond its prior ({where})")
    text += f" The data do not constrain {', '.join(unknown)}." if unknown else ""
    return text.replace(" %", f"{NO_BREAK_SPACE}%")
