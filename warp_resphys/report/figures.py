"""The report's figures: a function each, from arrays; `themed_svg` and `save_png` write them.

Every figure exists in two widths, for a page and for a phone, and takes its colours from the reader's theme.
"""

import io
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from .render import COLOUR_MAP, Body

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
LABELS: Final[Mapping[str, str]] = {
    "simulation": "Uncorrected simulation",
    "reconstruction": "Reconstruction",
    "sysid": "SysID",
    "simfree": "SimFree",
    "resphys": "Corrected (ResPhys)",
    "published_network": "Published network",
}
# Okabe and Ito (2008): everyone can tell them apart.
CHAMBER_COLOURS: Final = ("#e69f00", "#56b4e9", "#009e73", "#d55e00", "#0072b2", "#cc79a7", "#f0e442", "#7f7f7f")
LARGEST_SHOWN: Final = 1e5  # Of an error [mm], or a loss.
FONT: Final = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"
ROUND_STEPS: Final = (1, 2, 5, 10)  # Between two ticks, times a power of ten.
WIDE: Final = 7.3  # [in]
_LEGEND_ROW: Final = 5  # Most names in one row.
NARROW: Final = 3.7  # [in]
STYLE: Final[dict[Any, Any]] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "text.color": TONES["ink"].light,
    "axes.labelcolor": TONES["ink"].light,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
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


def tip_displacement(displacements: Mapping[str, FloatArray], time_step: float, *, narrow: bool) -> Figure:
    """Draw how the tip moves, and below it how far each model's tip is from the target's.

    Args:
        displacements: (T+1, 3) displacement [m] of the tip from rest, of the "target" and of the models.
        time_step: Time between two states [s].
        narrow: Whether the figure is for a narrow page.
    """
    target = displacements["target"]
    axis = int(np.argmax(np.ptp(target, axis=0)))
    time = np.arange(len(target)) * time_step
    with mpl.rc_context(STYLE):
        figure = new_figure(3.9, 4.2, narrow=narrow)
        motion, distance = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
        motion.plot(time, 1e3 * target[:, axis], color=TONES["target"].light, linewidth=4.0, label="Target")
        for model in (name for name in displacements if name != "target"):
            moved = displacements[model]
            motion.plot(time, 1e3 * moved[:, axis], color=TONES[model].light, label=LABELS[model])
            with np.errstate(over="ignore", invalid="ignore"):
                gap = 1e3 * np.linalg.norm(moved - target, axis=1)
            distance.plot(time, positive(gap), color=TONES[model].light)
        lowest, highest = 1e3 * target[:, axis].min(), 1e3 * target[:, axis].max()
        margin = 0.8 * (highest - lowest)  # Keeps a diverging roll-out from setting the scale.
        bottom, top = motion.get_ylim()
        motion.set_ylim(max(lowest - margin, bottom), min(highest + margin, top))
        motion.set_ylabel(f"tip displacement\nalong {'xyz'[axis]} [mm]")
        motion.yaxis.set_major_locator(MaxNLocator(5, steps=ROUND_STEPS))
        use_logarithm(distance)
        distance.set(xlabel="time [s]", ylabel="off target\n[mm]", xlim=(0.0, time[-1]))
        legend_above(figure, motion, narrow=narrow)
    return figure


def error_over_time(
    errors: Mapping[str, FloatArray],
    time_step: float,
    published: Mapping[str, float] = MappingProxyType({}),
    *,
    narrow: bool,
) -> Figure:
    """Draw each model's mean error over time, and the range of the trajectories around it.

    Args:
        errors: For each model (R, T) errors [mm] of R trajectories at the steps 1 to T.
        time_step: Time between two states [s].
        published: Published errors of models [mm], means over time, drawn as dashed lines.
        narrow: Whether the figure is for a narrow page.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(3.2, 3.4, narrow=narrow)
        axes = figure.subplots()
        for model, rows in errors.items():
            tone = TONES[model].light
            time = np.arange(1, rows.shape[1] + 1) * time_step
            low, high = positive(rows.min(axis=0)), positive(rows.max(axis=0))
            axes.fill_between(time, low, high, color=tone, alpha=0.18, linewidth=0)
            axes.plot(time, positive(rows.mean(axis=0)), color=tone, label=LABELS[model])
            axes.set_xlim(0.0, time[-1])
        for model, error in published.items():
            axes.axhline(error, color=TONES[model].light, linewidth=1.1, linestyle=(0, (4, 3)))
        use_logarithm(axes)
        axes.set(xlabel="time [s]", ylabel="mean vertex error [mm]")
        legend_above(figure, axes, narrow=narrow)
    return figure


def training_curves(records: Sequence[Mapping[str, Any]], *, narrow: bool) -> Figure:
    """Draw the losses and, where they were recorded, the validation roll-out error and the learning rate.

    Args:
        records: One an epoch, with `epoch`, `train_loss`, `validation_loss`, and in some or all epochs
            `rollout_error_mm` and `learning_rate`; what was not measured is None or absent.
        narrow: Whether the figure is for a narrow page.
    """
    heights = {"losses": 3, "rollout_error_mm": 3, "learning_rate": 1}
    panels = [key for key in heights if key == "losses" or len(_measured(records, key)[0])]
    muted, strong = TONES["muted"].light, TONES["resphys"].light
    with mpl.rc_context(STYLE):
        height = 0.6 + 0.57 * sum(heights[key] for key in panels)
        figure = new_figure(height, height + 0.2, narrow=narrow)
        rows = figure.subplots(
            len(panels), 1, sharex=True, squeeze=False, height_ratios=[heights[key] for key in panels]
        )
        axes = dict(zip(panels, rows[:, 0], strict=True))
        for key, label, colour in (
            ("train_loss", "Training loss", muted),
            ("validation_loss", "Validation loss", strong),
        ):
            epochs, losses = _measured(records, key)
            if len(epochs):
                axes["losses"].plot(epochs, losses, color=colour, label=label, linewidth=1.1)
        axes["losses"].set_ylabel("loss")
        axes["losses"].legend(loc="lower right", bbox_to_anchor=(1.0, 1.02), ncols=2)
        if "rollout_error_mm" in axes:
            _rollout_curve(axes["rollout_error_mm"], *_measured(records, "rollout_error_mm"))
        if "learning_rate" in axes:
            rates = _measured(records, "learning_rate")
            axes["learning_rate"].plot(*rates, color=muted, linewidth=1.1, drawstyle="steps-mid")
            axes["learning_rate"].set_ylabel("learning\nrate")
        for each in axes.values():
            use_logarithm(each)
        rows[-1, 0].set_xlabel("epoch")
        rows[-1, 0].xaxis.set_major_locator(MaxNLocator(6, integer=True))
        figure.align_ylabels()
    return figure


def marker_boxes(
    errors: Mapping[int, FloatArray], uncorrected: float, published: tuple[int, float] | None = None, *, narrow: bool
) -> Figure:
    """Draw a box for each number of markers: median, quartiles, and whiskers to the smallest and largest draw.

    Args:
        errors: (D,) errors [mm] of the draws, by number of markers.
        uncorrected: Error without any correction [mm].
        published: From which number of markers on the published median is below what error [mm].
        narrow: Whether the figure is for a narrow page.
    """
    ink, strong = {"color": TONES["ink"].light, "linewidth": 0.9}, TONES["simulation"].light
    with mpl.rc_context(STYLE):
        figure = new_figure(3.6, 3.4, narrow=narrow)
        axes = figure.subplots()
        places = range(1, len(errors) + 1)
        axes.boxplot(
            [*errors.values()],
            positions=places,
            widths=0.55,
            whis=(0, 100),
            boxprops=ink,
            whiskerprops=ink,
            capprops=ink,
            medianprops={"color": strong, "linewidth": 2.0},
        )
        lines = {"uncorrected simulation": (0.5, uncorrected)}
        if published is not None:
            start = 0.5 + sum(count < published[0] for count in errors)
            lines["published median: below" if narrow else "published: the median is below"] = (start, published[1])
        for text, (start, level) in lines.items():
            grey = TONES["muted"].light
            axes.plot([start, len(errors) + 0.5], [level, level], color=grey, linewidth=1.1, linestyle="--")
            place = (len(errors) + 0.5, level)
            axes.annotate(text, place, (-2, 3), textcoords="offset points", ha="right", color=grey)
        axes.set_xlim(0.5, len(errors) + 0.5)
        axes.set_xticks([*places], [str(count) for count in errors])
        axes.set_yscale("log")
        axes.set_ylim(top=1.6 * max(uncorrected, *(row.max() for row in errors.values())))
        use_logarithm(axes)
        axes.grid(visible=False, axis="x")
        axes.set(xlabel="number of markers", ylabel="mean vertex error [mm]")
    return figure


def shape_comparison(bodies: Mapping[str, Body | None], *, narrow: bool) -> Figure:
    """Show each model's deformed body side by side, coloured by the distance from the target's vertices.

    Args:
        bodies: What `warp_resphys.report.render.draw_bodies` drew, by model; None for one that diverged.
        narrow: Whether the figure is for a narrow page.
    """
    shapes = [body.pixels.shape for body in bodies.values() if body]
    rise = shapes[0][0] / shapes[0][1] if shapes else 0.5  # Height over width.
    height = (NARROW if narrow else WIDE / len(bodies)) * rise + 0.75
    with mpl.rc_context(STYLE):
        figure = new_figure(height, height * len(bodies), narrow=narrow)
        grid = (len(bodies), 1) if narrow else (1, len(bodies))
        panels = figure.subplots(*grid, squeeze=False).flat
        for axes, (model, body) in zip(panels, bodies.items(), strict=True):
            axes.set_title(LABELS[model])
            axes.set_axis_off()
            if body is None:
                axes.text(0.5, 0.5, "diverged before this time", ha="center", transform=axes.transAxes)
                continue
            axes.imshow(body.pixels)
            factor, unit = (1e3, "mm") if body.largest >= 1e-4 else (1e6, "µm")
            scale = ScalarMappable(Normalize(0.0, factor * body.largest), mpl.colormaps[COLOUR_MAP])
            bar = figure.colorbar(scale, ax=axes, orientation="horizontal", shrink=0.8, aspect=34, pad=0.02)
            bar.outline.set_visible(False)
            bar.set_label(f"distance from the target [{unit}]")
            bar.locator = MaxNLocator(5, steps=ROUND_STEPS)
            bar.update_ticks()
    return figure


def save_png(figure: Figure, path: Path) -> None:
    """Write a figure on white."""
    figure.savefig(path, format="png", dpi=200, facecolor="white")


def themed_svg(figure: Figure, name: str) -> bytes:
    """Return a figure as an SVG file whose colours follow the reader's theme, with text that stays text.

    Args:
        figure: What to write.
        name: Makes the identifiers in the file the same in every run.
    """
    buffer = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", dpi=240, transparent=True, metadata={"Date": None, "Creator": None})
    foreign = r"<\?xml.*?\?>|<!DOCTYPE.*?>|<metadata>.*?</metadata>"
    svg = re.sub(foreign, "", buffer.getvalue(), flags=re.DOTALL)
    svg = re.sub(r"'DejaVu Sans'(, [^;\"]*)?", FONT, svg)
    for role, tone in TONES.items():
        svg = svg.replace(tone.light, f"var(--{role})")
    light = "".join(f"--{role}:{tone.light};" for role, tone in TONES.items())
    dark = "".join(f"--{role}:{tone.dark};" for role, tone in TONES.items())
    style = f"<style>:root{{{light}}}@media (prefers-color-scheme:dark){{:root{{{dark}}}}}</style>"
    return re.sub(r"(<svg [^>]*>)", rf"\1{style}", svg, count=1).strip().encode()


def new_figure(height: float, narrow_height: float, *, narrow: bool) -> Figure:
    """An empty figure of one of the two widths, of these heights [in]."""
    size = (NARROW, narrow_height) if narrow else (WIDE, height)
    return Figure(figsize=size, layout="constrained")


def legend_above(figure: Figure, axes: Axes, *, narrow: bool) -> None:
    """Put the legend above the figure: in rows of four, or of two where there is less room."""
    handles, labels = axes.get_legend_handles_labels()
    columns = 2 if narrow else len(labels) if len(labels) <= _LEGEND_ROW else _LEGEND_ROW - 1
    figure.legend(handles, labels, loc="outside upper left", ncols=columns, columnspacing=1.6)


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
    """A logarithmic axis of at least a decade, labelled 0.1, 1, 10 where that is short, else as powers.

    It is labelled at 2 and 5 as well where there would be a label or two. Where there is nothing that it can show, such
    as errors that are all zero, the axis says so.

    Args:
        axes: With everything drawn.
        least: That it begins with, at least.
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
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _power(value, plain=plain)))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(which="minor", left=False)


def _power(value: float, *, plain: bool) -> str:
    if plain:
        return f"{value:g}"
    exponent = round(math.log10(value))
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
