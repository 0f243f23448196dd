"""Figures of learning: losses of a training and of an identification, and the stress of an identified law."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from .figures import LABELS, TONES, FloatArray, in_style, new_figure, positive, use_logarithm
from .page import number_text

_KILO: Final = 1e-3
_POINTS: Final = 81
_LEAST: Final = 0.02  # Least range of strains that is drawn, on either side of rest.
_SHADE: Final = 0.45  # Opacity.
_MARGIN: Final = 0.15  # Of the drawn range, over the range of the strains.


@in_style()
def training_curves(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the losses and, where they were recorded, the validation roll-out error and the learning rate.

    Args:
        records: One for each epoch, with `epoch`, `train_loss`, `validation_loss`, and in some or all epochs
            `rollout_error_mm` and `learning_rate`; values that were not measured are None or absent.
    """
    heights = {"losses": 3, "rollout_error_mm": 3, "learning_rate": 1}
    heights = {key: height for key, height in heights.items() if key == "losses" or len(_measured(records, key)[0])}
    muted, strong = TONES["muted"].light, TONES["resphys"].light
    thin: dict[str, Any] = {"linewidth": 1.1, "marker": "." if len(records) == 1 else ""}
    height = 0.6 + 0.57 * sum(heights.values())
    figure = new_figure(height)
    rows = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=[*heights.values()])[:, 0]
    axes = dict(zip(heights, rows, strict=True))
    for key, label, colour in (
        ("train_loss", "Training loss", muted),
        ("validation_loss", "Validation loss", strong),
    ):
        epochs, losses = _measured(records, key)
        if len(epochs):
            axes["losses"].plot(epochs, losses, color=colour, label=label, **thin)
    axes["losses"].set_ylabel("loss")
    axes["losses"].legend(loc="lower right", bbox_to_anchor=(1.0, 1.02), ncols=2)
    if "rollout_error_mm" in axes:
        _rollout_curve(axes["rollout_error_mm"], *_measured(records, "rollout_error_mm"))
    if "learning_rate" in axes:
        axes["learning_rate"].plot(*_measured(records, "learning_rate"), color=muted, drawstyle="steps-mid", **thin)
        axes["learning_rate"].set_ylabel("learning\nrate")
    for row in rows:
        use_logarithm(row)
    rows[-1].set_xlabel("epoch")
    _count(rows[-1].xaxis, 6)
    figure.align_ylabels()
    return figure


@in_style()
def loss_histories(histories: Mapping[str, Sequence[Sequence[Mapping[str, float]]]]) -> Figure:
    """Draw the best loss so far over the evaluations of each start, with a panel for each identification.

    Args:
        histories: By identification: for every start its records with `loss`, one for each evaluation.
    """
    figure = new_figure(2.6)
    panels = list(figure.subplots(1, len(histories), sharey=True, squeeze=False).flat)
    for axes, (name, starts) in zip(panels, histories.items(), strict=True):
        ends = [record["loss"] for start in starts for record in start if record["loss"] is not None]
        for start in filter(None, starts):
            losses = np.fmin.accumulate(np.array([record["loss"] for record in start], dtype=np.float64))
            best = bool(ends) and losses[-1] <= min(ends)
            tone = TONES["sysid" if best else "muted"].light
            count = np.arange(1, len(losses) + 1)
            axes.plot(count, positive(losses), ".-", color=tone, linewidth=1.8 if best else 0.9, markersize=3.5)
        axes.set_title(LABELS[name])
        axes.set_xlabel("evaluation")
        _count(axes.xaxis, 5)
    for axes in panels:  # Once everything is drawn, as they share their axis.
        use_logarithm(axes)
    panels[0].set_ylabel("loss")
    return figure


def _count(axis: Axis, most: int) -> None:
    """Label an axis at whole numbers only, even if there is just one."""
    axis.set_major_locator(MaxNLocator(most, integer=True, min_n_ticks=1))


def _measured(records: Sequence[Mapping[str, Any]], key: str) -> tuple[FloatArray, FloatArray]:
    """Epochs in which a quantity was measured, and its values."""
    measured = [(record["epoch"], record[key]) for record in records if record.get(key) is not None]
    epochs, values = np.asarray(measured, dtype=np.float64).reshape(-1, 2).T
    return epochs, positive(values)


def _rollout_curve(axes: Axes, epochs: FloatArray, errors: FloatArray) -> None:
    """The validation roll-out error [mm], its lowest value marked."""
    axes.plot(epochs, errors, color=TONES["resphys"].light)
    axes.set_ylabel("roll-out\nerror [mm]")
    if np.isfinite(errors).any():
        best = int(np.nanargmin(errors))
        axes.plot(epochs[best], errors[best], "o", color=TONES["simulation"].light, markersize=5)
        axes.set_title(f"lowest: {number_text(errors[best])} mm, epoch {epochs[best]:.0f}", loc="right")


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
) -> Figure:
    """Draw stress against stretch, the line of Young's modulus dashed, and the stretches of trials as shades.

    Args:
        curves: Stretches (S,) and nominal stress (S,) [Pa], by label.
        modulus: Young's modulus at rest, of the first curve [Pa].
        ranges: Least and largest stretch in trials, by name.
    """
    figure = new_figure(3.3)
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
    figure.legend(handles, labels, loc="outside upper left", ncols=2, columnspacing=1.6)
    return figure
