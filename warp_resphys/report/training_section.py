"""The section on the training of the networks."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ..io.arrays import FloatArray
from .data import MODELS, RunReport
from .page import Canvas, Part, Text, number_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TRAINED: Final = (
    "Losses, and the roll-out error on the trials by which the weights are chosen; the dot marks the lowest."
)


def training_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Return the curves of the trainings, and which weights were kept."""
    blocks: list[Any] = []
    for model, (name, _) in MODELS.items():
        if records := data.training.get(model):
            alt = f"Losses and validation roll-out error of the training of {name}, {len(records)} epochs."
            figure = canvas.figure(f"training_{model}", training_curves(records), alt, _TRAINED)
            blocks += [Text(name, heading=True), figure]
    return Part("Training", blocks) if blocks else None


def training_curves(records: Sequence[Mapping[str, Any]]) -> "Figure":
    """Draw the losses and, where they were recorded, the validation roll-out error and the learning rate.

    Args:
        records: One for each epoch, with `epoch`, `train_loss`, `validation_loss`, and in some or all epochs
            `rollout_error_mm` and `learning_rate`; values that were not measured are None or absent.
    """
    from . import figures

    def measured(key: str) -> tuple[FloatArray, FloatArray]:  # Epochs and values.
        known = [(record["epoch"], record[key]) for record in records if record.get(key) is not None]
        epochs, values = np.asarray(known, dtype=np.float64).reshape(-1, 2).T
        return epochs, figures.positive(values)

    heights = {"losses": 3, "rollout_error_mm": 3, "learning_rate": 1}
    heights = {key: height for key, height in heights.items() if key == "losses" or len(measured(key)[0])}
    muted, strong = figures.TONES["muted"].light, figures.TONES["resphys"].light
    thin: dict[str, Any] = {"linewidth": 1.1, "marker": "." if len(records) == 1 else ""}
    figure = figures.new_figure(0.6 + 0.57 * sum(heights.values()))
    rows = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=[*heights.values()])[:, 0]
    axes = dict(zip(heights, rows, strict=True))
    for key, label, colour in (("train_loss", "Training loss", muted), ("validation_loss", "Validation loss", strong)):
        epochs, losses = measured(key)
        if len(epochs):
            axes["losses"].plot(epochs, losses, color=colour, label=label, **thin)
    axes["losses"].set_ylabel("loss")
    axes["losses"].legend(loc="lower right", bbox_to_anchor=(1.0, 1.02), ncols=2)
    if (curve := axes.get("rollout_error_mm")) is not None:
        epochs, errors = measured("rollout_error_mm")
        curve.plot(epochs, errors, color=strong)
        curve.set_ylabel("roll-out\nerror [mm]")
        if np.isfinite(errors).any():
            best = int(np.nanargmin(errors))
            curve.plot(epochs[best], errors[best], "o", color=figures.TONES["simulation"].light, markersize=5)
            curve.set_title(f"lowest: {number_text(errors[best])} mm, epoch {epochs[best]:.0f}", loc="right")
    if "learning_rate" in axes:
        axes["learning_rate"].plot(*measured("learning_rate"), color=muted, drawstyle="steps-mid", **thin)
        axes["learning_rate"].set_ylabel("learning\nrate")
    for row in rows:
        figures.use_logarithm(row)
    rows[-1].set_xlabel("epoch")
    figures.count(rows[-1].xaxis, 6)
    figure.align_ylabels()
    return figure
