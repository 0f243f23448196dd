"""The section on the identified law: its terms, its moduli at small strains,
the classes that were tried, its use.

The energy and its parameters are those of `kernels.materials.convex`; here it is a function of
three principal stretches, along axes of which one is the direction of fibres. Uniaxial: the sides
are free of stress, so that the nominal stress is dW/ds_1 at dW/ds_2 = dW/ds_3 = 0. Viscosity and
relaxing branches carry no stress in slow loading. `tests/report/test_law_section.py` compares with
the kernels.
"""

import re
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, Final, NamedTuple

import numpy as np
import scipy.optimize
import torch

from ..core.energies.catalogue import LawContent, make_material
from ..io.arrays import FloatArray
from ..learning.identification.law import VISCOSITIES, is_shape
from ..settings.body import MaterialSettings
from ..settings.learning import LawSettings
from . import figures
from .data import RunReport, UsedLaw
from .identification_section import Wording, identified_cell, parameter_wording, within_sentence
from .page import Block, Canvas, Cell, Drawn, PageTable, Part, Row, Text
from .sections import BEYOND
from .wording import NONE, TONES, in_a_row, model_words, significant, unbroken

_ISOTROPIC: Final = ("c10", "c20", "c30", "c01", "c02", "dilation", "bulk_1", "bulk_2")
# Units of parameters that multiply no term: times, slacks, directions.
_NOT_FACTORS: Final = ("ms", "%", "°")
_NOT_OF_A_LAW: Final = ("density", "mass_damping")  # Of its parameters, not shown one by one.
_POINTS: Final = 81  # Of the curve of the stress.
_LEAST: Final = 0.02  # Least range of strains that is drawn, on either side of rest.
_SHADE: Final = 0.45  # Opacity.
_MARGIN: Final = 0.15  # Of the drawn range, over the range of the strains.
_KPA: Final = ("kPa", 1e-3)
_STRAIN: Final = ("%", 1e2)
_ANGLE: Final = ("°", 180.0 / np.pi)
# Of each parameter: its term in words, its meaning, and unit on the page with its number in an SI
# unit.
_TERMS: Final[Mapping[str, tuple[str, str, tuple[str, float]]]] = {
    "c10": (
        "Neo-Hookean term",
        "half the shear modulus that it adds; c10 of I₁ − 3",  # noqa: RUF001
        _KPA,
    ),
    "c20": (
        "Second-order term in I₁",
        "stiffens with strain; c20 of (I₁ − 3)²",  # noqa: RUF001
        _KPA,
    ),
    "c30": (
        "Third-order term in I₁",
        "stiffens with strain; c30 of (I₁ − 3)³",  # noqa: RUF001
        _KPA,
    ),
    "c01": ("Mooney-Rivlin term", "softens in tension; c01 of I₂ − 3", _KPA),  # noqa: RUF001
    "c02": (
        "Second-order term in I₂",
        "stiffens with strain; c02 of (I₂ − 3)²",  # noqa: RUF001
        _KPA,
    ),
    "dilation": ("Local change of volume", "dilation of (J − 1)²", _KPA),  # noqa: RUF001
    "bulk_1": ("Change of volume", "bulk_1 of (J − 1)²", ("MPa", 1e-6)),  # noqa: RUF001
    "bulk_2": ("Large change of volume", "bulk_2 of (J − 1)⁴", ("MPa", 1e-6)),  # noqa: RUF001
    "shear_viscosity": (
        "Viscosity in shear",
        "force in proportion to the rate of shear",
        ("Pa s", 1.0),
    ),
    "bulk_viscosity": (
        "Viscosity in volume",
        "force in proportion to the rate of volume change",
        ("Pa s", 1.0),
    ),
}
_NUMBERED: Final[Mapping[str, tuple[str, str, tuple[str, float]]]] = {
    "prony_modulus": ("Relaxing branch {}: shear modulus", "adds stiffness to fast motions", _KPA),
    "prony_time": (
        "Relaxing branch {}: relaxation time",
        "after which its stress has decayed to 37 %",
        ("ms", 1e3),
    ),
    "fibre_tension": ("Fibres {}: modulus in tension", "beyond the toe", _KPA),
    "fibre_toe": ("Fibres {}: toe", "strain over which they become taut", _STRAIN),
    "fibre_slack": ("Fibres {}: slack", "strain at which they begin to pull", _STRAIN),
    "fibre_stiffening": ("Fibres {}: stiffening", "of the cube of their strain", _KPA),
    "fibre_compression": ("Fibres {}: modulus in compression", "", _KPA),
    "fibre_azimuth": ("Fibres {}: azimuth", "of their direction, from x towards y", _ANGLE),
    "fibre_elevation": (
        "Fibres {}: elevation",
        "of their direction, above the plane of x and y",
        _ANGLE,
    ),
}
_OGDEN: Final = "shear modulus that it adds; larger exponents stiffen more"
_GROUPS: Final[Mapping[str, str]] = {
    "elastic": "elastic terms",
    "viscosity": "viscosity",
    "branches": "relaxation",
    "fibres": "fibres",
}
# Direction of fibres, in axes of which the first is that of the load.
ALONG: Final = (1.0, 0.0, 0.0)
ACROSS: Final = (0.0, 1.0, 0.0)


def law_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns the law, whether it is used, what the trials determine of it,
    and the classes that were tried.
    """
    whole, settings = data.metrics.get("law"), data.settings.law
    if whole is None or settings is None:
        return None
    parameters = {
        name: value
        for name, value in whole["parameters"].items()
        if not name.startswith(_NOT_OF_A_LAW)
    }
    law: UsedLaw = {**whole, "parameters": parameters}
    blocks: list[Block] = [Text(unbroken(law_text(law)), "law-use"), _terms_table(law)]
    notes = [
        "± is one standard deviation in the Gauss-Newton approximation, "
        "for residuals correlated in time."
    ]
    blocks += [Text(" ".join(notes), note=True)] if law.get("deviation") else []
    said = (not_needed_text(law, settings), outside_text(data))
    blocks += [Text(unbroken(text)) for text in said if text]
    blocks += [_moduli_table(data, parameters), *_curve(data, parameters, canvas)]
    return Part("Law of the material", [*blocks, *_classes(law)])


def law_text(law: UsedLaw) -> str:
    """Returns a sentence on whether the identified law of metrics.json is used, and why."""
    checked, base = law["validation"], model_words(law["against"])
    where = f"{checked['split']} trials ({', '.join(checked['trials'])})"
    head = f"The identified law is {'used' if law['accepted'] else 'not used'}"
    tail = ""
    if "file" in law:
        head = f"The law of {law['file']} is used as it is"
        there = law.get("accepted_there", True)
        tail = (
            ""
            if there
            else " The run that identified it did not use it: it was not clearly closer there."
        )
    law_error, base_error = _share(checked["law"]), _share(checked["below"])
    return (
        f"{head}: its root mean square error on the {where} is {law_error} of the motion's "
        f"amplitude, that of {base} {base_error}.{tail}"
    )


def wording(name: str) -> tuple[Wording, str]:
    """Returns the name, unit and factor of a parameter of a law, and its meaning."""
    if name in _TERMS:
        words, meaning, (unit, factor) = _TERMS[name]
        return (words, unit, factor), meaning
    exponents = [*ogden_terms({name: 0.0})]
    if exponents:
        return (f"Ogden's term of exponent {exponents[0]}", *_KPA), _OGDEN
    numbered = re.fullmatch(r"(\w+)_(\d+)", name)
    if numbered and numbered[1] in _NUMBERED:
        words, meaning, (unit, factor) = _NUMBERED[numbered[1]]
        return (words.format(numbered[2]), unit, factor), meaning
    return parameter_wording(name), ""


def _terms_table(law: LawContent) -> PageTable:
    rows = []
    known = {**law["parameters"], **law.get("others", {})}
    bounds = [name for name in law.get("at_bounds", ()) if name in known]
    for name, value in known.items():
        deviation = law.get("deviation", {}).get(name)
        if not value and not (deviation and is_shape(name)):
            # A term that is not there; an angle may be zero.
            continue
        (words, unit, factor), meaning = wording(name)
        cells = [identified_cell(value, factor, deviation), Cell(unit or NONE)]
        cells += [Cell("yes" if name in bounds else "")] if bounds else []
        rows.append(Row(words, cells, small=meaning))
    return PageTable("Term", ["Identified", "Unit", *(["At a bound"] if bounds else [])], rows)


def outside_text(data: RunReport) -> str:
    """Returns a sentence on test trials outside of the stretches of the training.

    Empty if they hardly are.
    """
    if data.outside is None or data.outside < BEYOND:
        return ""
    low, high = data.stretches["the training"]
    (where, _), *_ = data.stretches.items()
    modes = data.metrics["law"].get("modes", ())
    kinds = f" in {in_a_row(modes)}" if modes else ""
    return (
        f"In {100.0 * data.outside:.0f} % of the cells and times of {where}, a principal stretch "
        f"lies outside of those that the law was learned at, {low:.2f} to "
        f"{high:.2f}{kinds}{', or the load is another one' * bool(modes)}: there it extrapolates."
    )


def not_needed_text(law: LawContent, settings: LawSettings) -> str:
    """Returns a sentence on the terms of the library that the law does not have.

    Empty if it has all of them.
    """
    parameters = {name: value for name, value in law["parameters"].items() if value}
    names = [name for name in settings.terms if name not in parameters]
    exponents = [*map(str, chain.from_iterable(ogden_terms({name: 0.0}) for name in names))]
    absent = [
        within_sentence(wording(name)[0][0]) for name in names if not ogden_terms({name: 0.0})
    ]
    absent += (
        [f"Ogden's term{'s' if len(exponents) > 1 else ''} of exponent {in_a_row(exponents)}"]
        if exponents
        else []
    )
    absent += [
        within_sentence(wording(name)[0][0]) for name in VISCOSITIES if name not in parameters
    ]
    if settings.branches and not any(name.startswith("prony") for name in parameters):
        absent.append("relaxing branches")
    if settings.families and not families(parameters):
        absent.append("fibres")
    return f"Terms of the library that the data did not need: {in_a_row(absent)}." if absent else ""


def _moduli_table(data: RunReport, parameters: Mapping[str, float]) -> PageTable:
    """Moduli at small strains: of the law, of the simulator
    that it replaces, and of a simulated target.
    """
    law = small_strain(parameters)
    columns: dict[str, SmallStrain | None] = {"Law": law}
    start = data.settings.simulation
    below = data.identification["sysid"].parameters if "sysid" in data.identification else {}
    if "youngs_modulus" in below or "poissons_ratio" in below:
        changed = {
            name: below[name] for name in ("youngs_modulus", "poissons_ratio") if name in below
        }
        columns["SysID"] = small_strain_of(
            MaterialSettings.model_validate({**start.parameters, **changed})
        )
    else:
        columns["Data sheet"] = small_strain_of(start)
    for target in data.settings.targets.values():
        columns["Target"] = small_strain_of(target.material)
    shown = {name: moduli for name, moduli in columns.items() if moduli is not None}

    def row(head: str, attribute: str, factor: float) -> Row:
        return Row(
            head, [Cell(f"{factor * getattr(moduli, attribute):.4g}") for moduli in shown.values()]
        )

    rows = [
        row("Shear modulus [kPa]", "mu", 1e-3),
        row("Young's modulus [kPa]", "youngs_modulus", 1e-3),
        row("Poisson's ratio", "poissons_ratio", 1.0),
    ]
    notes = ["Of slow motions: viscosity and relaxing branches left out."]
    branches = sum(value for name, value in parameters.items() if name.startswith("prony_modulus"))
    if branches:
        fast = 1e-3 * (law.mu + branches)
        notes.append(
            "With the relaxing branches, in fast motions, "
            f"the shear modulus of the law is {fast:.4g} kPa."
        )
    notes += ["Fibres are left out too."] if families(parameters) else []
    if "corotated" in (
        start.model,
        *(target.material.model for target in data.settings.targets.values()),
    ):
        notes.append(
            "Of a corotated material they are effective values: "
            "its λ counts a third at small strains."
        )
    return PageTable("At small strains", [*shown], rows, unbroken(" ".join(notes)))


def _curve(data: RunReport, parameters: Mapping[str, float], canvas: Canvas) -> list[Drawn]:
    """Draws the stress in slow tension and compression, and the stretches of trials as shades."""
    stretches, fibres = drawn_stretches(data.stretches), families(parameters)
    directions = (
        {"law": None}
        if fibres != 1
        else {"law, across the fibres": ACROSS, "law, along the fibres": ALONG}
    )
    # [kPa]
    curves = {
        label: 1e-3 * uniaxial_stress(parameters, stretches, d) for label, d in directions.items()
    }
    modulus = 1e-3 * small_strain(parameters).youngs_modulus
    figure, law = figures.new_figure(3.3), TONES["law"].light
    axes = figure.subplots()
    for (name, (low, high)), tone in zip(data.stretches.items(), ("rule", "target"), strict=False):
        colour = TONES[tone].light
        axes.axvspan(
            low, high, color=colour, alpha=_SHADE, linewidth=0.0, label=f"stretches in {name}"
        )
    for (label, stress), dashes in zip(curves.items(), ("-", (0, (4, 1.5))), strict=False):
        axes.plot(stretches, stress, color=law, linewidth=1.9, label=label, linestyle=dashes)
    dashed: dict[str, Any] = {
        "color": TONES["ink"].light,
        "linewidth": 1.0,
        "linestyle": (0, (6, 3)),
    }
    axes.plot(
        stretches,
        modulus * (stretches - 1.0),
        **dashed,
        label=f"E at small strains, {modulus:.3g} kPa",
    )
    axes.axhline(0.0, color=TONES["muted"].light, linewidth=0.6)
    low = np.nanmin([np.nanmin(stress) for stress in curves.values()])
    high = np.nanmax([np.nanmax(stress) for stress in curves.values()])
    margin = 0.1 * (high - low)
    axes.set(xlim=(stretches[0], stretches[-1]), ylim=(low - margin, high + margin))
    axes.set(xlabel="stretch", ylabel="nominal stress [kPa]")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=2, columnspacing=1.6)
    ends = "; ".join(
        f"{label}: {stress[0]:.3g} kPa at a stretch of {stretches[0]:.2f}, {stress[-1]:.3g} kPa "
        f"at {stretches[-1]:.2f}"
        for label, stress in curves.items()
    )
    without = " Fibres are left out, as there are several families." if fibres > 1 else ""
    shaded = " Shaded: principal stretches at the centres of the cells." if data.stretches else ""
    caption = (
        "Nominal stress of the law in slow uniaxial tension and compression; dashed, the "
        f"straight line with its Young's modulus at small strains.{shaded}{without}"
    )
    return [
        canvas.figure(
            "law", figure, unbroken(f"Nominal stress of the law against stretch. {ends}."), caption
        )
    ]


def drawn_stretches(ranges: Mapping[str, tuple[float, float]]) -> FloatArray:
    """Returns stretches (S,) of curves: those of trials and a margin, or 0.8 to 1.3 without any."""
    low = min((low for low, _ in ranges.values()), default=0.8)
    high = max((high for _, high in ranges.values()), default=1.3)
    low, high = min(low, 1.0 - _LEAST), max(high, 1.0 + _LEAST)
    margin = _MARGIN * (high - low)
    return np.unique(np.append(np.linspace(max(low - margin, 0.2), high + margin, _POINTS), 1.0))


def _classes(law: LawContent) -> list[Block]:
    """Returns the classes that were tried, with their errors."""
    tried = law.get("classes", ())
    if not tried:
        return []
    weak = any(tried_class.get("residual") is not None for tried_class in tried)
    columns = ["Coefficients", *(["Force residual"] if weak else []), "Validation error"]
    rows = []
    chosen = next(
        (tried_class for tried_class in tried if tried_class["groups"] == law["groups"]), None
    )
    for tried_class in tried:
        viscous = any(tried_class["parameters"].get(name) for name in VISCOSITIES)
        groups = dict.fromkeys([*tried_class["groups"], *(["viscosity"] if viscous else [])])
        words = in_a_row([_GROUPS.get(group, group) for group in groups])
        head = f"With {words}" if words else "Shape and volume alone (neo-Hookean)"
        cells = [
            Cell(
                str(
                    sum(
                        wording(name)[0][1] not in _NOT_FACTORS
                        for name, value in tried_class["parameters"].items()
                        if value
                    )
                )
            )
        ]
        cells += [Cell(_share(tried_class.get("residual")))] if weak else []
        rows.append(
            Row(
                head,
                [*cells, Cell(_share(tried_class.get("validation")))],
                "chosen" * (tried_class is chosen),
            )
        )
    note = (
        "Validation errors are root mean squares over the amplitude of the motion. The smallest "
        "class that was close enough to the best one was chosen"
    )
    if weak:
        note += (
            ", and refined through the simulator. The force residual is what remains in the "
            "balance of forces"
        )
    return [PageTable("Classes of laws", columns, rows, f"{note}.")]


def _share(value: float | None) -> str:
    return "failed" if value is None else significant(100.0 * value) + " %"


class SmallStrain(NamedTuple):
    """Moduli of an isotropic solid at small strains, after relaxation."""

    mu: float  # Shear modulus [Pa].
    lame: float  # Lamé's first constant [Pa].

    @property
    def youngs_modulus(self) -> float:
        """Young's modulus [Pa]."""
        return self.mu * (3.0 * self.lame + 2.0 * self.mu) / (self.lame + self.mu)

    @property
    def poissons_ratio(self) -> float:
        """Poisson's ratio."""
        return 0.5 * self.lame / (self.lame + self.mu)


def small_strain(parameters: Mapping[str, float]) -> SmallStrain:
    """Returns the moduli of a law without its fibres, from its parameters by name."""
    rest = torch.ones(3, dtype=torch.float64)
    slopes = torch.autograd.functional.hessian(lambda s: _energy(parameters, s, None), rest)
    along, across = float(slopes[0, 0]), float(slopes[0, 1])  # lambda + 2 mu, and lambda.
    return SmallStrain(0.5 * (along - across), across)


def small_strain_of(material: MaterialSettings) -> SmallStrain | None:
    """Returns the moduli of a material at small strains; None for one with regions."""
    if material.regions:
        return None
    elastic = make_material(material.model, **material.values)
    if material.model == "law":
        return small_strain(
            {name: float(torch.as_tensor(value)) for name, value in elastic.values.items()}
        )
    tensors = {
        n: torch.as_tensor(x, dtype=torch.float64).reshape(1, -1) for n, x in elastic.values.items()
    }
    mu, lame = np.asarray(elastic.law.lame).T @ [
        float(modulus) for modulus in elastic.moduli(tensors)
    ]
    return SmallStrain(float(mu), float(lame))


def ogden_terms(parameters: Mapping[str, float]) -> dict[int, float]:
    """Returns the moduli of Ogden's terms [Pa], by exponent."""
    found = {name: re.fullmatch(r"ogden_(m?)(\d+)", name) for name in parameters}
    return {int(m[2]) * (-1 if m[1] else 1): parameters[name] for name, m in found.items() if m}


def families(parameters: Mapping[str, float]) -> int:
    """Returns the number of families of fibres."""
    return sum(name.startswith("fibre_tension_") for name in parameters)


def uniaxial_stress(
    parameters: Mapping[str, float], stretches: FloatArray, direction: Sequence[float] | None = None
) -> FloatArray:
    """Returns the nominal stress (S,) [Pa] at stretches (S,).

    NaN where no state with free sides was found.

    Args:
        parameters: Of the law, by name.
        stretches: Ratio of the length to that at rest.
        direction: Of the first family of fibres, `ALONG` or `ACROSS` the load; None leaves fibres
            out.
    """
    stress = np.full(len(stretches), np.nan)
    # From rest outwards, each from the nearest state that is known.
    order = np.argsort(np.abs(stretches - 1.0))
    known: dict[float, FloatArray] = {1.0: np.ones(2)}
    for at in order:
        stretch = float(stretches[at])
        nearest = min(known, key=lambda other: abs(other - stretch))
        guess = known[nearest] * (stretch / nearest) ** -0.5
        solved = scipy.optimize.root(
            lambda sides, s=stretch: _slopes(parameters, s, sides, direction)[1:], guess
        )
        slopes = _slopes(parameters, stretch, solved.x, direction)
        if np.abs(slopes[1:]).max() < 1e-6 * small_strain(parameters).mu:
            known[stretch], stress[at] = solved.x, slopes[0]
    return stress


def _slopes(
    parameters: Mapping[str, float],
    stretch: float,
    sides: FloatArray,
    direction: Sequence[float] | None,
) -> FloatArray:
    """Derivatives (3,) [Pa] of the energy by the principal stretches."""
    s = torch.tensor([stretch, *sides], dtype=torch.float64, requires_grad=True)
    (slopes,) = torch.autograd.grad(_energy(parameters, s, direction), s)
    return np.asarray(slopes.numpy())


def _energy(
    parameters: Mapping[str, float], s: torch.Tensor, direction: Sequence[float] | None
) -> torch.Tensor:
    """Energy density [Pa] at principal stretches (3,)."""
    c10, c20, c30, c01, c02, dilation, bulk_1, bulk_2 = (
        parameters.get(name, 0.0) for name in _ISOTROPIC
    )
    j = s.prod() - 1.0
    first = s.square().sum()
    second = _pairs(s.square())
    a, b = first - 3.0 - 2.0 * j + j**2, second - 3.0 - 4.0 * j
    energy = (
        c10 * a
        + c20 * a**2
        + c30 * a**3
        + c01 * b
        + c02 * b**2
        + (dilation + bulk_1) * j**2
        + bulk_2 * j**4
    )
    for n, mu in ogden_terms(parameters).items():
        powers = s ** abs(n)
        term = powers.sum() + n * (0.5 * j**2 - j) if n > 0 else _pairs(powers) + 2.0 * n * j
        energy = energy + 2.0 * mu / n**2 * term
    if direction is None:
        return energy
    tension, stiffening, compression, slack, toe = (
        parameters.get(f"fibre_{name}_1", 0.0)
        for name in ("tension", "stiffening", "compression", "slack", "toe")
    )
    length = (torch.tensor(direction, dtype=torch.float64) * s).norm()
    q, strain = length**2 - 1.0, (length - 1.0 - slack).clamp_min(0.0)
    t = strain / toe if toe > 0.0 else torch.ones(())
    pull = (
        toe**2 * (0.25 * t**4 - 0.1 * t**5)
        if t < 1.0
        else 0.5 * strain**2 - 0.5 * toe * strain + 0.15 * toe**2
    )
    return (
        energy
        + tension * pull
        + stiffening * q.clamp_min(0.0) ** 3
        + compression * q.clamp_max(0.0) ** 2
    )


def _pairs(x: torch.Tensor) -> torch.Tensor:
    """Sum of the products of two of three numbers (3,)."""
    return 0.5 * (x.sum() ** 2 - x.square().sum())
