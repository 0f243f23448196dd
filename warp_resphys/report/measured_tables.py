"""What the reports of measured motions say in words and in tables."""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final

import numpy as np

from warp_resphys.metrics import PublishedError
from warp_resphys.report.page import NO_BREAK_SPACE, number_text, published_parts

NONE: Final = "\N{EN DASH}"
MINUS: Final = "\N{MINUS SIGN}"
# In the order of the tables: a name, and what it means.
MODELS: Final[Mapping[str, tuple[str, str]]] = {
    "published": ("Published setting", "the simulator as the published code sets it up"),
    "simulation": ("Uncorrected simulation", "the simulator with the values of the data sheet"),
    "sysid_elastic": ("SysID of E and ν", "the elastic parameters that fit best"),  # noqa: RUF001
    "sysid": ("SysID", "all parameters that fit best, damping among them"),
    "simfree": ("SimFree", "a network in place of the simulator"),
    "resphys_uncorrected": ("ResPhys, data sheet", "the learned force on the uncorrected simulator"),
    "resphys": ("ResPhys", "the learned force on the identified simulator"),
}
_PUBLISHED_BESIDE = {"published": "simulation", "sysid_elastic": "sysid"}  # Where these exist, they are what was meant.
# A name, the unit that it is written in, and how many of these make an SI unit.
_PARAMETERS: Final[Mapping[str, tuple[str, str, float]]] = {
    "youngs_modulus": ("Young's modulus", "kPa", 1e-3),
    "poissons_ratio": ("Poisson's ratio", "", 1.0),
    "density": ("Density", "kg/m³", 1.0),
    "mass_damping": ("Damping by mass", "1/s", 1.0),
    "stiffness_damping": ("Damping by stiffness", "ms", 1e3),
    "attached_mass_factor": ("Factor of the attached masses", "", 1.0),
    "pressure_rise": ("Time constant of the pressures", "ms", 1e3),
    "gravity_tilt_1": ("First tilt of gravity", "°", 180.0 / np.pi),
    "gravity_tilt_2": ("Second tilt of gravity", "°", 180.0 / np.pi),
}
_WHOLE: Final = 99.5  # [%] of a parameter's range.
_TIED: Final = 0.9  # From this correlation on, two parameters are named as not told apart.


def verdict(
    errors: Mapping[str, Any],
    trials: Sequence[str],
    seconds: float | None,
    *,
    folds: bool = False,
    without: Collection[str] = (),
) -> str:
    """Say how far the models are from what was measured.

    Args:
        errors: A summary [mm] a model.
        trials: Names of the test trials.
        seconds: How much of them counts.
        folds: Whether each trial was the test of a fold of its own.
        without: Models that learned nothing.
    """
    errors = {model: each for model, each in errors.items() if model not in without}
    who = f"trial {trials[0]}" if len(trials) == 1 else f"{len(trials)} trials"
    held = "each of them kept back once" if folds and len(trials) > 1 else "which no training or identification saw"
    span = "" if seconds is None else f" over the first {seconds:g} s"
    main = next(
        (m for m in ("resphys", "resphys_uncorrected", "sysid", "sysid_elastic", "simulation") if m in errors), ""
    )
    if not main:
        return f"There are no errors to report on {who}."
    if errors[main]["mean"] is None:
        return (
            f"On {who}, {held}, {MODELS[main][0]} diverged in {errors[main]['diverged']} of "
            f"{errors[main]['trajectories']} roll-outs, so that there is no mean error to report."
        )
    said = (
        f"On {who}, {held}, the simulated markers are {number_text(errors[main]['mean'])} mm from the measured ones"
        f"{span} with {MODELS[main][0]}"
    )
    others = [m for m in ("sysid", "sysid_elastic", "simulation") if m in errors and m != main]
    beside = [
        f"{number_text(errors[m]['mean'])}{'' if errors[m]['mean'] is None else ' mm'} "
        f"{'uncorrected' if m == 'simulation' else 'with ' + MODELS[m][0]}"
        for m in others
    ]
    said += f"; {', '.join(beside)}." if beside else "."
    return re.sub(r"(?<=\d) (?=(?:mm|s)\b)", NO_BREAK_SPACE, said)


def against(errors: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """Return the model that the others are compared with, and by how many per cent each is above or below it."""
    base = next((m for m in ("sysid_elastic", "sysid") if m in errors and errors[m]["mean"]), "")
    if not base:
        return "", {}
    ratios = {m: each["mean"] / errors[base]["mean"] - 1.0 for m, each in errors.items() if each["mean"] is not None}
    return base, {m: NONE if m == base else per_cent(ratio) for m, ratio in ratios.items()}


def per_cent(ratio: float, decimals: int = 0) -> str:
    """Return a share with its sign, in per cent."""
    text = f"{100.0 * ratio:+.{decimals}f}"
    return f"{text.replace('-', MINUS) if float(text) else '0'} %"


def published_beside(published: Mapping[str, PublishedError], models: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return the published errors by the model that they stand beside."""
    taken = {theirs: ours for ours, theirs in _PUBLISHED_BESIDE.items() if ours in models}
    return {taken.get(model, model): published_parts(each) for model, each in published.items()}


def residual_rows(residuals: Mapping[str, Any]) -> tuple[list[str], list[tuple[str, str, list[tuple[str, str]]]]]:
    """Return the labels, and for each trial its root mean square and each residual [mm] with what stands below it."""
    labels = list(dict.fromkeys(label for each in residuals.values() for label in each["residual_mm"]))
    rows = []
    for trial, each in residuals.items():
        cells = []
        for label in labels:
            value = each["residual_mm"].get(label)
            cells.append((NONE if value is None else f"{value:.2f}", "left out" if label in each["outliers"] else ""))
        rows.append((trial, f"{each['rms_mm']:.2f}", cells))
    return labels, rows


def quality_rows(quality: Mapping[str, Any]) -> dict[str, list[list[str]]]:
    """Return the rows of each trial's table: marker, share seen, gaps, longest, masked, jumps, noise, drift."""
    rows: dict[str, list[list[str]]] = {}
    for trial, each in quality.items():
        rows[trial] = []
        for marker in each["markers"]:
            jumps = marker["jumps"]
            rows[trial].append(
                [
                    marker["label"],
                    NONE if marker["seen"] is None else f"{100.0 * marker['seen']:.1f} %",
                    str(marker["gaps"]),
                    str(marker["longest_gap_frames"]),
                    str(marker["masked_frames"]),
                    f"{len(jumps)}" + (f" ({max(jump['mm'] for jump in jumps):.2f} mm)" if jumps else ""),
                    "" if marker["noise_mm"] is None else f"{marker['noise_mm']:.4f}",
                    "" if marker["drift_mm"] is None else f"{marker['drift_mm']:.3f}",
                ]
            )
    return rows


def identifications(identification: Mapping[str, Any]) -> list[str]:
    """Return which models were identified."""
    return [name for name in ("sysid_elastic", "sysid") if name in identification]


def parameter_rows(
    found: Mapping[str, Any], start: Mapping[str, float], truth: Mapping[str, Any]
) -> list[dict[str, str]]:
    """Return a row a parameter: name and unit, the data sheet's value, what was identified, and whether at a bound.

    Args:
        found: One identification.
        start: The values of the data sheet.
        truth: The true ones, where they are known.
    """
    deviations = (found.get("uncertainty") or {}).get("deviation", {})
    rows = []
    for parameter, value in found["parameters"].items():
        words, unit, factor = _PARAMETERS.get(parameter, (parameter, "", 1.0))
        deviation = deviations.get(parameter)
        rows.append(
            {
                "name": f"{words} [{unit}]" if unit else words,
                "start": _digits(start.get(parameter), factor),
                "truth": _digits(truth.get(parameter), factor),
                "identified": _digits(value, factor, deviation),
                "deviation": _deviation(deviation, factor),
                "bound": "yes" if parameter in found["at_bounds"] else "",
            }
        )
    return rows


def _digits(value: float | None, factor: float, deviation: float | None = None) -> str:
    """A value in its unit, with as many decimals as its standard deviation deserves, or four digits."""
    if value is None:
        return NONE
    scaled = factor * value
    if not deviation:
        return f"{scaled:.4g}".replace("-", MINUS)
    text = f"{scaled:.{_decimals(factor * deviation)}f}"
    return text.replace("-", MINUS) if float(text) else text.lstrip("-")


def _deviation(deviation: float | None, factor: float) -> str:
    return f"± {factor * deviation:.{_decimals(factor * deviation)}f}" if deviation else ""


def _decimals(deviation: float) -> int:
    """For two digits of a standard deviation."""
    return max(0, 1 - math.floor(math.log10(deviation)))


def _in_a_sentence(parameter: str) -> str:
    words = _PARAMETERS.get(parameter, (parameter, "", 1.0))[0]
    return words if words.startswith(("Young", "Poisson")) else words[0].lower() + words[1:]


def uncertainty_text(name: str, found: Mapping[str, Any]) -> str:
    """Say which parameters the data cannot tell apart; empty where nothing is known about that.

    Args:
        name: The model that the identification is for.
        found: The identification.
    """
    known = found.get("uncertainty")
    if not known:
        return ""
    names = list(found["parameters"])
    words = {parameter: _in_a_sentence(parameter) for parameter in names}
    largest = max(abs(weight) for weight in known["poorest"].values())
    along = [words[p] for p, weight in known["poorest"].items() if abs(weight) > 0.4 * largest]
    said = f"{MODELS[name][0]}: the data tell least about {' together with '.join(along)}, "
    share = 100.0 * known["poorest_deviation"]
    said += f"to {share:.2g} % of the range" if share < _WHOLE else "and leave that open over the whole range"
    correlation = np.array(known["correlation"], dtype=np.float64)
    tied = [
        f"{words[names[i]]} and {words[names[j]]} ({correlation[i, j]:+.2f})".replace("-", MINUS)
        for j in range(len(names))
        for i in range(j)
        if abs(correlation[i, j]) > _TIED
    ]
    said += f"; they cannot tell apart {', '.join(tied)}, by their correlation." if tied else "."
    return said.replace(" %", f"{NO_BREAK_SPACE}%")
