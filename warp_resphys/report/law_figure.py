"""The figure of a law: stress against stretch, with its slope at rest."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from .figures import TONES, FloatArray, in_style, new_figure

_KILO: Final = 1e-3
_POINTS: Final = 81
_LEAST: Final = 0.02  # Least range of strains that is drawn, on either side of rest.
_SHADE: Final = 0.45  # Opacity.
_MARGIN: Final = 0.15  # Of the drawn range, over the range of the strains.


def drawn_stretches(ranges: Mapping[str, tuple[float, float]]) -> FloatArray:
    """Return the stretches (S,) of the curves: those of the trials and a margin, or 0.8 to 1.3 without any."""
    low = min((low for low, _ in ranges.values()), default=0.8)
    high = max((high for _, high in ranges.values()), default=1.3)
    low, high = min(low, 1.0 - _LEAST), max(high, 1.0 + _LEAST)
    margin = _MARGIN * (high - low)
    return np.unique(np.append(np.linspace(max(low - margin, 0.2), high + margin, _POINTS), 1.0))


@in_style()
def stress_over_stretch(
    curves: Mapping[str, tuple[FloatArray, FloatArray]],
    modulus: float,
    ranges: Mapping[str, tuple[float, float]],
    *,
    narrow: bool,
) -> Figure:
    """Draw stress against stretch, the line of Young's modulus dashed, and the stretches of trials as shades.

    Args:
        curves: Stretches (S,) and nominal stress (S,) [Pa], by label.
        modulus: Young's modulus at rest, of the first curve [Pa].
        ranges: Least and largest stretch in trials, by name.
        narrow: Whether the figure is for a narrow page.
    """
    figure = new_figure(3.3, 3.7, narrow=narrow)
    axes = figure.subplots()
    law, ink = TONES["law"].light, TONES["ink"].light
    stretches = next(iter(curves.values()))[0]
    highest = max(float(np.nanmax(stress)) for _, stress in curves.values())
    lowest = min(float(np.nanmin(stress)) for _, stress in curves.values())
    for (name, (low, high)), tone in zip(ranges.items(), ("rule", "target"), strict=False):
        axes.axvspan(low, high, color=TONES[tone].light, alpha=_SHADE, linewidth=0.0, label=f"stretches in {name}")
    looks: list[dict[str, Any]] = [{}, {"linestyle": (0, (4, 1.5))}, {"linestyle": (0, (1, 1.2))}]
    for (label, (x, stress)), look in zip(curves.items(), looks, strict=False):
        axes.plot(x, _KILO * stress, color=law, linewidth=1.9, label=label, **look)
    straight = modulus * (stretches - 1.0)
    dashed: dict[str, Any] = {"color": ink, "linewidth": 1.0, "linestyle": (0, (6, 3))}
    axes.plot(stretches, _KILO * straight, **dashed, label=f"E at small strains, {_KILO * modulus:.3g} kPa")
    axes.axhline(0.0, color=TONES["muted"].light, linewidth=0.6)
    span = highest - lowest
    axes.set(xlim=(stretches[0], stretches[-1]), ylim=(_KILO * (lowest - 0.1 * span), _KILO * (highest + 0.1 * span)))
    axes.set(xlabel="stretch", ylabel="nominal stress [kPa]")
    handles, labels = axes.get_legend_handles_labels()
    columns = 1 if narrow else 2
    figure.legend(handles, labels, loc="outside upper left", ncols=columns, columnspacing=1.6)
    return figure
