"""The style of all figures, and those of errors and of learning: a function each, from arrays.

Every figure exists in two widths, for a page and, with `narrow`, for a phone, and takes its colours from the reader's
theme.
"""

import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator
from numpy.typing import NDArray

from ..learning.metrics import median_filter
from .data import MODELS

FloatArray = NDArray[np.float64]


class Tone(NamedTuple):
    """One role's colour on a light page, and on a dark one."""

    light: str
    dark: str


# The light tones are what matplotlib draws and what `themed_svg` looks for, so no two are equal.
TONES: Final[Mapping[str, Tone]] = {
    "ink": Tone("#1c2127", "#e4e7eb"),
    "muted": Tone("#5c6670", "#9aa4af"),
    "rule": Tone("#dde1e6", "#343b44"),
    "target": Tone("#b4bcc6", "#5d6875"),
    "simulation": Tone("#c4481b", "#ff9a6c"),
    "reconstruction": Tone("#1d7a55", "#62d2a2"),
    "sysid": Tone("#7a4aa0", "#c9a2ea"),
    "simfree": Tone("#8f6a00", "#e2bd4f"),
    "resphys": Tone("#1a5fb4", "#7fb3f5"),
    "published_network": Tone("#b0307a", "#f08bc4"),
    "published": Tone("#b0307b", "#f08bc5"),
    "sysid_elastic": Tone("#a57cc4", "#d9bdf0"),
    "resphys_uncorrected": Tone("#1f93b0", "#6fd0e8"),
}
LABELS: Final[Mapping[str, str]] = {model: name for model, (name, _) in MODELS.items()} | {
    "published_network": "Published network"
}
# Okabe and Ito (2008): everyone can tell them apart.
CHAMBER_COLOURS: Final = ("#e69f00", "#56b4e9", "#009e73", "#d55e00", "#0072b2", "#cc79a7", "#f0e442", "#7f7f7f")
LARGEST_SHOWN: Final = 1e5  # Of an error [mm], or a loss.
FONT: Final = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"
ROUND_STEPS: Final = (1, 2, 5, 10)  # Between two ticks, times a power of ten.
WIDE: Final = 7.3  # [in]
_LEGEND_ROW: Final = 5  # Most names in one row.
NARROW: Final = 3.7  # [in]
_DASHED: Final = {"published": (0, (1, 1.2)), "sysid_elastic": (0, (4, 2)), "resphys_uncorrected": (0, (4, 2))}
_LEVELS: Final = 14  # Of a landscape.
_KILO: Final = 1e-3
STYLE: Final[dict[Any, Any]] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "text.color": TONES["ink"].light,
    "axes.labelcolor": TONES["ink"].light,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # Where it is anyway: looking for ticks in its way takes long.
    "axes.labelsize": 9,
    "axes.edgecolor": TONES["muted"].light,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": TONES["rule"].light,
    "grid.linewidth": 0.6,
    "xtick.color": TONES["muted"].light,
    "ytick.color": TONES["muted"].light,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "legend.handlelength": 1.6,
    "legend.borderaxespad": 0.0,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "svg.fonttype": "none",
}


@contextmanager
def in_style() -> Iterator[None]:
    """Draw in the style of all figures; also as a decorator."""
    with mpl.rc_context(STYLE):
        yield


@in_style()
def error_over_time(
    errors: Mapping[str, FloatArray],
    times: FloatArray | float,
    published: Mapping[str, float] | None = None,
    *,
    of: str = "vertex",
    window: float | None = None,
    narrow: bool,
) -> Figure:
    """Draw each model's mean error over time, and around the main ones the range of the trials.

    Args:
        errors: For each model (R, T) errors [mm] of R trials; NaN where nothing was seen, infinite where it diverged.
        times: (T,) [s]; or the time between two frames, of which the first is at zero.
        published: Published errors of models [mm], means over time, drawn as dashed lines.
        of: What is observed.
        window: Of a median filter [s], for long trials: its result is drawn in place of the range, and thin behind it
            what went in. None for no filter.
        narrow: Whether the figure is for a narrow page.
    """
    figure = new_figure(3.5, 3.9, narrow=narrow)
    axes, lowest = figure.subplots(), []
    for model, rows in errors.items():
        time = times if isinstance(times, np.ndarray) else times * np.arange(rows.shape[1])
        mean, line = mean_of_trials(rows), model_line(model)
        shown = positive(mean)
        if window is not None:
            axes.plot(time, shown, color=line["color"], linewidth=0.6, alpha=0.45)
            shown = positive(median_filter(mean, float(time[1] - time[0]), window))
            settled = shown[len(shown) // 10 :]
            lowest += [float(np.nanmin(settled))] if np.isfinite(settled).any() else []
        elif len(rows) > 1 and model not in _DASHED:
            low, high = (positive(extreme.reduce(rows, axis=0)) for extreme in (np.fmin, np.fmax))
            axes.fill_between(time, low, high, color=line["color"], alpha=0.15, linewidth=0)
        axes.plot(time, shown, **line)
        axes.set_xlim(0.0, time[-1])
    for model, error in (published or {}).items():
        axes.axhline(error, color=TONES[model].light, linewidth=1.1, linestyle=(0, (4, 3)))
    use_logarithm(axes, 0.4 * min(lowest, default=0.0))  # Models begin close to the measured rest: not shown.
    axes.set(xlabel="time [s]", ylabel=f"mean {of} error [mm]")
    legend_above(figure, axes, narrow=narrow)
    return figure


def mean_of_trials(rows: FloatArray) -> FloatArray:
    """Return (T,) the mean of the trials (R, T) with a value; infinite where one diverged, NaN where none has one."""
    held = ~np.isnan(rows)
    count = held.sum(axis=0)
    mean: FloatArray = np.where(count > 0, np.where(held, rows, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)
    return mean


@in_style()
def error_over_scale(errors: Mapping[str, Mapping[float, float]], *, narrow: bool) -> Figure:
    """Draw the mean errors [mm] by model against the scale of the inputs; one that diverged is left out."""
    figure = new_figure(3.0, 3.6, narrow=narrow)
    axes = figure.subplots()
    scales = sorted({scale for each in errors.values() for scale in each})
    for model, each in errors.items():
        values = positive(np.array([each.get(scale, np.nan) for scale in scales]))
        axes.plot(scales, values, marker="o", **model_line(model))
    use_logarithm(axes)
    axes.set_xticks(scales, [f"{scale:g}" for scale in scales])
    axes.set(xlabel="inputs over those of the training", ylabel="mean marker error [mm]")
    legend_above(figure, axes, narrow=narrow)
    return figure


@in_style()
def training_curves(records: Sequence[Mapping[str, Any]], *, narrow: bool) -> Figure:
    """Draw the losses and, where they were recorded, the validation roll-out error and the learning rate.

    Args:
        records: One an epoch, with `epoch`, `train_loss`, `validation_loss`, and in some or all epochs
            `rollout_error_mm` and `learning_rate`; what was not measured is None or absent.
        narrow: Whether the figure is for a narrow page.
    """
    heights = {"losses": 3, "rollout_error_mm": 3, "learning_rate": 1}
    heights = {key: each for key, each in heights.items() if key == "losses" or len(_measured(records, key)[0])}
    muted, strong = TONES["muted"].light, TONES["resphys"].light
    thin: dict[str, Any] = {"linewidth": 1.1, "marker": "." if len(records) == 1 else ""}
    height = 0.6 + 0.57 * sum(heights.values())
    figure = new_figure(height, height + 0.2, narrow=narrow)
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
    for each in rows:
        use_logarithm(each)
    rows[-1].set_xlabel("epoch")
    _count(rows[-1].xaxis, 6)
    figure.align_ylabels()
    return figure


@in_style()
def loss_histories(histories: Mapping[str, Sequence[Sequence[Mapping[str, float]]]], *, narrow: bool) -> Figure:
    """Draw the best loss so far over the evaluations of each start, a panel an identification.

    Args:
        histories: By identification: for every start the records with `loss`, one an evaluation.
        narrow: Whether the figure is for a narrow page.
    """
    shape = (len(histories), 1) if narrow else (1, len(histories))
    figure = new_figure(2.6, 0.4 + 2.1 * len(histories), narrow=narrow)
    panels = list(figure.subplots(*shape, sharey=True, squeeze=False).flat)
    for axes, (name, starts) in zip(panels, histories.items(), strict=True):
        ends = [each["loss"] for start in starts for each in start if each["loss"] is not None]
        for start in (each for each in starts if each):
            losses = np.fmin.accumulate(np.array([record["loss"] for record in start], dtype=np.float64))
            best = bool(ends) and losses[-1] <= min(ends)
            tone = TONES["sysid" if best else "muted"].light
            count = np.arange(1, len(losses) + 1)
            axes.plot(count, positive(losses), ".-", color=tone, linewidth=1.8 if best else 0.9, markersize=3.5)
        axes.set_title(LABELS[name])
        axes.set_xlabel("evaluation")
        _count(axes.xaxis, 5)
    for axes in panels:  # With everything drawn, as they share their axis.
        use_logarithm(axes)
    for axes in panels if narrow else panels[:1]:
        axes.set_ylabel("loss")
    return figure


@in_style()
def landscape(
    modulus: FloatArray,
    ratio: FloatArray,
    loss: FloatArray,
    points: Mapping[str, tuple[float, float]],
    *,
    narrow: bool,
) -> Figure:
    """Draw the loss over Young's modulus and Poisson's ratio; as a curve where the grid has one ratio only.

    Args:
        modulus: (A,) [Pa].
        ratio: (B,); one value, or none, for a curve.
        loss: (A, B) or (A,), NaN where the simulation failed.
        points: Modulus and ratio to be marked, by name.
        narrow: Whether the figure is for a narrow page.
    """
    values = positive(np.asarray(loss, dtype=np.float64))
    figure = new_figure(3.6, 3.7, narrow=narrow)
    axes = figure.subplots()
    if values.ndim == 2 and values.shape[1] > 1 and np.isfinite(values).any():
        _contours(figure, axes, _KILO * modulus, ratio, values)
        places = {name: (_KILO * e, nu) for name, (e, nu) in points.items()}
    else:
        curve = values.reshape(len(modulus), -1)[:, 0]
        axes.plot(_KILO * modulus, curve, color=TONES["sysid"].light)
        use_logarithm(axes)
        axes.set_ylabel("loss")
        known, e = np.isfinite(curve), np.array([e for e, _ in points.values()])
        heights = np.interp(e, modulus[known], curve[known]) if known.any() else []
        places = {name: (_KILO * e, float(h)) for (name, (e, _)), h in zip(points.items(), heights, strict=False)}
    for (name, place), marker in zip(places.items(), "oDs^", strict=False):
        tone = TONES["simulation"].light if marker == "D" else "white"
        edge: dict[str, Any] = {"markeredgecolor": "black", "markeredgewidth": 0.9, "zorder": 5, "clip_on": False}
        axes.plot(*place, marker, color=tone, markersize=7.0, linestyle="none", label=name, **edge)
    if modulus.max() > 3.0 * modulus.min():
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("Young's modulus [kPa]")
    if places:
        handles, names = axes.get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper left", ncols=1 if narrow else 3, columnspacing=1.6)
    return figure


def _contours(figure: Figure, axes: Axes, modulus: FloatArray, ratio: FloatArray, loss: FloatArray) -> None:
    """Filled levels, evenly spaced in the logarithm of the loss, with lines between them."""
    level = np.log10(loss)
    low, high = float(np.nanmin(level)), float(np.nanmax(level))
    levels = np.linspace(low - 1e-9, (high if high > low else low + 1.0) + 1e-9, _LEVELS)
    masked = np.ma.masked_invalid(level.T)
    filled = axes.contourf(modulus, ratio, masked, levels=levels, cmap="viridis")
    axes.contour(modulus, ratio, masked, levels=levels, colors="white", linewidths=0.5, alpha=0.55)
    axes.set_ylabel("Poisson's ratio")
    axes.grid(visible=False)
    bar = figure.colorbar(filled, ax=axes, pad=0.02, aspect=28)
    bar.outline.set_visible(False)
    whole = [tick for tick in (-6, -5, -4, -3, -2, -1, 0, 1, 2, 3) if low <= tick <= high]
    ticks = whole if len(whole) > 1 else np.linspace(low, high, 4).tolist()
    bar.set_ticks(ticks, labels=[f"{10.0**tick:.2g}" for tick in ticks])
    bar.set_label("loss")


def save_png(figure: Figure, path: Path) -> None:
    """Write a figure on white."""
    figure.savefig(path, format="png", dpi=200, facecolor="white")


def themed_svg(figure: Figure, name: str) -> bytes:
    """Return a figure as an SVG file whose colours follow the reader's theme, with text that stays text.

    The name makes the identifiers in the file the same in every run.
    """
    buffer = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", dpi=240, transparent=True, metadata={"Date": None, "Creator": None})
    foreign = r"<\?xml.*?\?>|<!DOCTYPE.*?>|<metadata>.*?</metadata>"
    svg = re.sub(foreign, "", buffer.getvalue(), flags=re.DOTALL)
    svg = re.sub(r"'DejaVu Sans'(, [^;\"]*)?", FONT, svg)
    for role, tone in TONES.items():
        svg = svg.replace(tone.light, f"var(--{role})")
    light, dark = ("".join(f"--{role}:{tone[at]};" for role, tone in TONES.items()) for at in range(2))
    style = f"<style>:root{{{light}}}@media (prefers-color-scheme:dark){{:root{{{dark}}}}}</style>"
    return re.sub(r"(<svg [^>]*>)", rf"\1{style}", svg, count=1).strip().encode()


@in_style()
def settle(figure: Figure) -> None:
    """Lay a figure out, once for all that is written of it."""
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)


def model_line(model: str, width: float = 1.4) -> dict[str, Any]:
    """Return how a model's line looks, with its name; that of the residual force is the thickest."""
    width += 0.5 if model == "resphys" else 0.0
    look = {"color": TONES[model].light, "linestyle": _DASHED.get(model, "-")}
    return {**look, "linewidth": width, "label": LABELS[model]}


def new_figure(height: float, narrow_height: float, *, narrow: bool) -> Figure:
    """An empty figure of one of the two widths, of these heights [in]."""
    size = (NARROW, narrow_height) if narrow else (WIDE, height)
    return Figure(figsize=size, layout="constrained")


def legend_above(figure: Figure, axes: Axes, *, narrow: bool) -> None:
    """Put the legend above the figure: in rows of four, or of two where there is less room."""
    handles, labels = axes.get_legend_handles_labels()
    columns = 2 if narrow else len(labels) if len(labels) <= _LEGEND_ROW else _LEGEND_ROW - 1
    figure.legend(handles, labels, loc="outside upper left", ncols=columns, columnspacing=1.6)


def _count(axis: Axis, most: int) -> None:
    """Label an axis at whole numbers only, also where there is but one."""
    axis.set_major_locator(MaxNLocator(most, integer=True, min_n_ticks=1))


def _measured(records: Sequence[Mapping[str, Any]], key: str) -> tuple[FloatArray, FloatArray]:
    """The epochs in which a quantity was measured, and its values."""
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
        axes.set_title(f"lowest: {errors[best]:.2g} mm, epoch {epochs[best]:.0f}", loc="right")


def positive(values: FloatArray) -> FloatArray:
    """Return what a logarithmic axis can show; the rest, and what a blown-up roll-out reaches, becomes a gap."""
    return np.where((values > 0.0) & (values < LARGEST_SHOWN), values, np.nan)


def use_logarithm(axes: Axes, least: float = 0.0) -> None:
    """A logarithmic axis of at least a decade and from a least value, labelled 0.1, 1, 10 or, where long, as powers.

    Everything is drawn already. It is labelled at 2 and 5 as well where there would be a label or two. Where there is
    nothing that it can show, such as errors that are all zero, the axis says so.
    """
    if not np.isfinite(axes.dataLim.minposy):
        axes.set(yticks=[], ylim=(0.0, 1.0))
        axes.text(0.5, 0.5, "zero, or diverged, throughout", ha="center", va="center", transform=axes.transAxes)
        return
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    if high < 10.0 * low:
        low, high = 10.0 ** math.floor(math.log10(low)), 10.0 ** math.ceil(math.log10(high) + 1e-9)
    low = max(low, least)
    axes.set_ylim(low, high)
    plain = low >= 5e-5 and high <= 2e4
    decades = math.floor(math.log10(high) + 1e-9) - math.ceil(math.log10(low) - 1e-9) + 1
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 3 else (1.0,), numticks=6))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}" if plain else _power(value)))
    axes.yaxis.set_minor_locator(NullLocator())


def _power(value: float) -> str:
    exponent = math.floor(math.log10(value) + 1e-9)
    times = round(value / 10.0**exponent)
    return (
        f"{times}·10" * (times > 1)
        + "10" * (times == 1)
        + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    )
