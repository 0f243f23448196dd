"""The style of all figures.

Their colours follow the reader's theme.
"""

import io
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from ..io.arrays import FloatArray
from ..learning.baselines import BASELINES
from .wording import MODELS, TONES

# Okabe and Ito (2008): distinguishable with colour vision deficiencies.
CHAMBER_COLOURS: Final = (
    "#e69f00",
    "#56b4e9",
    "#009e73",
    "#d55e00",
    "#0072b2",
    "#cc79a7",
    "#f0e442",
    "#7f7f7f",
)
LARGEST_SHOWN: Final = 1e5  # Largest error [mm] or loss that is drawn.
FONT: Final = (
    "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', "
    "Arial, 'DejaVu Sans', sans-serif"
)
WIDE: Final = 7.3  # [in]
_LEGEND_ROW: Final = 5  # Largest number of names in one row.
_BETWEEN: Final = 0.07  # Space between panels, so that labels of their ends do not meet.
_DASHED: Final = {
    **dict.fromkeys(BASELINES, (0, (2, 1))),
    "published": (0, (1, 1.2)),
    "sysid": (0, (4, 4)),
    "sysid_elastic": (0, (4, 2)),
    "simfree": (0, (5, 1.5, 1, 1.5)),
    "resphys_uncorrected": (0, (4, 2)),
}
_LEAST_SPAN: Final = 5.0  # Of a logarithmic axis, end over end: at least two of its ticks.
STYLE: Final[dict[Any, Any]] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "text.color": TONES["ink"].light,
    "axes.labelcolor": TONES["ink"].light,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # Its usual position; computing it from the ticks is slow.
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
    """Applies the style of all figures; also as a decorator."""
    with mpl.rc_context(STYLE):
        yield


def save_png(figure: Figure, path: Path) -> None:
    """Writes a figure with a white background."""
    figure.savefig(path, format="png", dpi=200, facecolor="white")


def themed_svg(figure: Figure, name: str) -> bytes:
    """Returns a figure as an SVG file with text as text, whose colours follow the reader's theme.

    Identifiers in the file depend on the name alone, so that they are the same in every run.
    """
    buffer = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        figure.savefig(
            buffer,
            format="svg",
            dpi=240,
            transparent=True,
            metadata={"Date": None, "Creator": None},
        )
    foreign = r"<\?xml.*?\?>|<!DOCTYPE.*?>|<metadata>.*?</metadata>"
    svg = re.sub(foreign, "", buffer.getvalue(), flags=re.DOTALL)
    svg = re.sub(r"'DejaVu Sans'(, [^;\"]*)?", FONT, svg)
    for role, tone in TONES.items():
        svg = svg.replace(tone.light, f"var(--{role})")
    light, dark = (
        "".join(f"--{role}:{tone[at]};" for role, tone in TONES.items()) for at in range(2)
    )
    style = f"<style>:root{{{light}}}@media (prefers-color-scheme:dark){{:root{{{dark}}}}}</style>"
    return re.sub(r"(<svg [^>]*>)", rf"\1{style}", svg, count=1).strip().encode()


@in_style()
def settle(figure: Figure) -> None:
    """Computes the layout of a figure once, for all files that are written of it."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)


def model_line(model: str, width: float = 1.4) -> dict[str, Any]:
    """Returns style and label of a model's line.

    That of ResPhys is thicker, and dashed ones are drawn over it.
    """
    width += 0.5 if model == "resphys" else 0.0
    look = {
        "color": TONES[model].light,
        "linestyle": _DASHED.get(model, "-"),
        "zorder": 2.1 if model in _DASHED else 2,
    }
    return {**look, "linewidth": width, "label": MODELS[model].name}


def new_figure(height: float) -> Figure:
    """Returns an empty figure of the page's width and a height [in]."""
    return Figure(figsize=(WIDE, height), layout="constrained")


def legend_above(figure: Figure, axes: Axes) -> None:
    """Puts the legend above the figure, in rows of four if there are many names."""
    handles, labels = axes.get_legend_handles_labels()
    columns = len(labels) if len(labels) <= _LEGEND_ROW else _LEGEND_ROW - 1
    figure.legend(handles, labels, loc="outside upper left", ncols=columns, columnspacing=1.6)


def keep_in_view(axes: Axes, seen: FloatArray, share: float, least: float = 0.0) -> None:
    """Limits an axis to a measured motion (T,) and a margin, a share of it, with a least span.

    A model that diverges then does not set the scale, and noise does not look like motion.
    """
    if np.isfinite(seen).any():
        low, high = np.nanmin(seen), np.nanmax(seen)
        margin = share * (high - low) + 0.02
        bottom, top = axes.get_ylim()
        bottom, top = max(low - margin, bottom), min(high + margin, top)
        more = max(0.0, 0.5 * (least - (top - bottom)))
        axes.set_ylim(bottom - more, top + more)


def few_ticks(axis: Axis, most: int) -> None:
    """Labels an axis at a few round numbers."""
    axis.set_major_locator(MaxNLocator(most, steps=(1, 2, 5, 10)))


def count(axis: Axis, most: int) -> None:
    """Labels an axis at whole numbers only, even if there is just one."""
    axis.set_major_locator(MaxNLocator(most, integer=True, min_n_ticks=1))


def positive(values: FloatArray) -> FloatArray:
    """Returns values for a logarithmic axis: NaN where they are not positive
    or exceed `LARGEST_SHOWN`.
    """
    return np.where((values > 0.0) & (values < LARGEST_SHOWN), values, np.nan)


def use_logarithm(axes: Axes, least: float = 0.0) -> None:
    """Makes the y axis logarithmic, over at least a factor of five and from a least value.

    Call it after drawing.

    Labels are 0.1, 1, 10 or, on long axes, powers of ten; on short axes 2 and 5 are labelled too.
    Where no value can be shown, such as errors that are all zero, a sentence is written instead.
    """
    if not np.isfinite(axes.dataLim.minposy):
        axes.set(yticks=[], ylim=(0.0, 1.0))
        axes.text(
            0.5,
            0.5,
            "zero, or diverged, throughout",
            ha="center",
            va="center",
            transform=axes.transAxes,
        )
        return
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    if high < _LEAST_SPAN * low:
        middle, reach = math.sqrt(low * high), math.sqrt(_LEAST_SPAN)
        low, high = middle / reach, middle * reach
    low = max(low, least)
    axes.set_ylim(low, high)
    plain = low >= 5e-5 and high <= 2e4
    decades = math.floor(math.log10(high) + 1e-9) - math.ceil(math.log10(low) - 1e-9) + 1
    axes.yaxis.set_major_locator(
        LogLocator(subs=(1.0, 2.0, 5.0) if decades < 3 else (1.0,), numticks=6)
    )
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: f"{value:g}" if plain else _power(value))
    )
    axes.yaxis.set_minor_locator(NullLocator())


def _power(value: float) -> str:
    exponent = math.floor(math.log10(value) + 1e-9)
    times = round(value / 10.0**exponent)
    return (
        f"{times}·10" * (times > 1)
        + "10" * (times == 1)
        + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    )
