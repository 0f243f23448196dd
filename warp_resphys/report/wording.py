"""Names and colours of the models and controllers that are compared,
and formats of numbers and lists in sentences.
"""

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..learning.baselines import BASELINES
from ..learning.metrics import ErrorSummary, PublishedError
from ..settings.control import ControlSettings

NO_BREAK_SPACE: Final = "\u00a0"
NONE: Final = "\N{EN DASH}"
MINUS: Final = "\N{MINUS SIGN}"
_LEAST: Final = 1e-3  # Smaller numbers are not written out.
_CLEAREST: Final = 0.999  # Larger shares are not written out.


class ComparedModel(NamedTuple):
    """Names of a model in tables and sentences."""

    name: str  # In tables and figures.
    meaning: str  # In small print below it.
    words: str = ""  # In a sentence; empty for its name.


class Tone(NamedTuple):
    """Colour of a role on a light page and on a dark one."""

    light: str
    dark: str


# In the order of the tables.
MODELS: Final[Mapping[str, ComparedModel]] = {
    "rest": ComparedModel("At rest", "without physics: nothing moves", "a body that does not move"),
    "interpolation": ComparedModel(
        "Interpolation",
        "without physics: straight lines between the training trials",
        "interpolation",
    ),
    "regression": ComparedModel(
        "Regression", "without physics: ridge regression over the training trials", "regression"
    ),
    "linear": ComparedModel(
        "Linear model",
        "without physics: linear from frame to frame, with powers of the inputs (DMDc)",
        "a linear model",
    ),
    "published": ComparedModel(
        "Published setting", "the simulator as the published code sets it up"
    ),
    "simulation": ComparedModel(
        "Uncorrected simulator", "with the values of the data sheet", "the uncorrected simulator"
    ),
    "reconstruction": ComparedModel(
        "Reconstruction", "the simulator with forces fitted to the test trial itself"
    ),
    "sysid_elastic": ComparedModel(
        "SysID of E and ν",  # noqa: RUF001
        "the elastic parameters that fit best",
        "identification of E and \N{GREEK SMALL LETTER NU}",
    ),
    "sysid": ComparedModel("SysID", "the simulator with the parameters that fit best"),
    "law": ComparedModel(
        "Law", "the simulator with the identified law of its material", "the law of the material"
    ),
    "actuator": ComparedModel(
        "Actuator",
        "the simulator under learned inputs, which differ from the commands",
        "the learned actuator",
    ),
    "simfree": ComparedModel("SimFree", "a network in place of the simulator"),
    "resphys_uncorrected": ComparedModel(
        "ResPhys, data sheet",
        "the learned force on the uncorrected simulator",
        "the learned force on the uncorrected simulator",
    ),
    "resphys": ComparedModel(
        "ResPhys", "the simulator with the learned force, which sees only the simulated state"
    ),
}
# matplotlib draws the light tones, and `figures.themed_svg` replaces them, so they must differ.
TONES: Final[Mapping[str, Tone]] = {
    "ink": Tone("#1c2127", "#e4e7eb"),
    "muted": Tone("#5c6670", "#9aa4af"),
    "rule": Tone("#dde1e6", "#343b44"),
    "target": Tone("#b4bcc6", "#5d6875"),
    "rest": Tone("#7d6b4f", "#c8b594"),
    "interpolation": Tone("#7d6b50", "#c8b595"),
    "regression": Tone("#7d6b51", "#c8b596"),
    "linear": Tone("#7d6b52", "#c8b597"),
    "simulation": Tone("#c4481b", "#ff9a6c"),
    "reconstruction": Tone("#1d7a55", "#62d2a2"),
    "sysid": Tone("#7a4aa0", "#c9a2ea"),
    "law": Tone("#0f766e", "#5eead4"),
    "actuator": Tone("#e000e0", "#c44dff"),
    "simfree": Tone("#8f6a00", "#e2bd4f"),
    "resphys": Tone("#1a5fb4", "#7fb3f5"),
    "published": Tone("#b0307b", "#f08bc5"),
    "sysid_elastic": Tone("#a57cc4", "#d9bdf0"),
    "resphys_uncorrected": Tone("#1f93b0", "#6fd0e8"),
}
# By prefix of a controller: name in words, and description.
_CONTROLLERS: Final[Mapping[str, tuple[str, str]]] = {
    "open_": ("{}, open loop", "planned once for the whole path, and played"),
    "receding_linear": (
        "Linear model, receding horizon",
        "dynamic mode decomposition of the same recordings",
    ),
    "receding_": (
        "{}, receding horizon",
        "planned anew at each step, from an estimate by the markers",
    ),
    "feedback_": (
        "Jacobian feedback, {}/s",
        "with the measured Jacobian of the point by the inputs",
    ),
}


def model_words(model: str) -> str:
    """Returns the name of a model in a sentence."""
    return MODELS[model].words or MODELS[model].name


def shown_models(positions: Collection[str], recommended: str = "") -> list[str]:
    """Returns the models that are drawn as bodies: the uncorrected one,
    then the recommended or most corrected one.
    """
    plain = ("simulation", "published")
    corrected = ("resphys", "resphys_uncorrected", "actuator", "law", "sysid", "sysid_elastic")
    groups = (plain, corrected if recommended in plain else (recommended, *corrected))
    return [model for group in groups for model in [m for m in group if m in positions][:1]]


def models_in_figures(errors: Mapping[str, ErrorSummary]) -> list[str]:
    """Returns the models that figures show: of those
    without physics only the one of least mean error.
    """
    plain = [model for model in BASELINES if model in errors]
    best = min(
        plain, key=lambda model: np.inf if (e := errors[model]["mean"]) is None else e, default=""
    )
    return [model for model in MODELS if model in errors and (model not in plain or model == best)]


def controller_words(controller: str) -> tuple[str, str]:
    """Returns the name and the description of a controller."""
    prefix = next(prefix for prefix in _CONTROLLERS if controller.startswith(prefix))
    name, meaning = _CONTROLLERS[prefix]
    rest = controller.removeprefix(prefix)
    return name.format(MODELS[rest].name if rest in MODELS else rest), meaning


def controller_name(controller: str) -> str:
    """Returns the name of a controller in words."""
    return controller_words(controller)[0]


def compared_controllers(control: ControlSettings) -> list[str]:
    """Returns the names of the controllers that are drawn."""
    models = [model for model in control.models if model in ("sysid", "law", control.models[-1])]
    return [
        *(f"open_{model}" for model in models),
        *(f"receding_{model}" for model in control.receding[-1:]),
    ]


def number_text(value: float | None) -> str:
    """Returns a number with three digits, such as "1.07" or "0.0384", or "below 0.001".

    None: diverged.
    """
    if value is None:
        return "diverged"
    return f"below {_LEAST:g}" if 0.0 < abs(value) < _LEAST else f"{value:,.{_decimals(value)}f}"


def _decimals(value: float) -> int:
    return max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0


def mm_text(value: float | None) -> str:
    """Returns a mean error with its unit; None stands for divergence."""
    return number_text(value) + ("" if value is None else " mm")


def largest_text(errors: NDArray[np.float64]) -> str:
    """Returns the largest of errors [mm] as text.

    NaN is left out, an infinite error has diverged.
    """
    values = errors[~np.isnan(errors)]
    return (
        mm_text(float(values.max()))
        if len(values) and np.isfinite(values).all()
        else "infinity (it diverged)"
    )


def error_parts(summary: ErrorSummary) -> tuple[str, str]:
    """Returns a mean and its "± deviation", if there is one, with the same decimals."""
    mean, std = summary["mean"], summary["std"]
    if mean is None:
        return f"{summary['diverged']} of {summary['trajectories']} diverged", ""
    if std is None or mean < _LEAST:
        return number_text(mean), ""
    return number_text(mean), f"± {std:,.{_decimals(mean)}f}"


def duration_text(seconds: float) -> str:
    """Returns a duration as "0.42 s", "12.3 s" or "3 min 05 s"."""
    if seconds < 60.0:
        return f"{seconds:.2f} s" if seconds < 10.0 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"


def published_parts(error: PublishedError) -> tuple[str, str]:
    """Returns mean and deviation as they were published: both with the same decimals."""
    decimals = max(len(repr(float(part)).partition(".")[2]) for part in error)
    return f"{error.mean:.{decimals}f}", f"± {error.std:.{decimals}f}"


def flatten(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yields settings as dotted keys, as on the command line, with their values."""
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{prefix}{key}.")
        elif isinstance(value, list | tuple):
            yield f"{prefix}{key}", f"[{', '.join(map(str, value))}]"
        else:
            yield f"{prefix}{key}", "null" if value is None else str(value)


def significant(value: float, digits: int = 2) -> str:
    """Returns a number with some significant digits, without an exponent."""
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value)))) if value else 0}f}"


def share_text(share: float) -> str:
    """Returns a share as a percentage, such as "63 %",
    "99.8 %" or "more than 99.9 %", with a digit of the rest.
    """
    if _CLEAREST < share < 1.0:
        return f"more than {100.0 * _CLEAREST:g} %"
    left = 100.0 * (1.0 - share)
    digits = max(0, -math.floor(math.log10(left))) if left > 0.0 else 0
    return f"{100.0 * share:.{digits}f} %".replace("-", MINUS)


def unbroken(text: str) -> str:
    """Returns a text with no-break spaces between numbers and their units or symbols."""
    units = r"(?<=\d) (?=(?:mm|kPa|s)\b|%)"
    symbols = r"(?<=\b[Eν]) (?=\d)"  # noqa: RUF001
    return re.sub(f"{units}|{symbols}", NO_BREAK_SPACE, text)


def in_a_row(words: Sequence[str]) -> str:
    """Returns words as a list in a sentence: "a, b and c"."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
