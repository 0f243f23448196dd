"""Figures of motion: markers and tips against models, deformed bodies, and the pressures that drive them."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from numpy.typing import NDArray

from .figures import (
    CHAMBER_COLOURS,
    LABELS,
    LARGEST_SHOWN,
    NARROW,
    ROUND_STEPS,
    STYLE,
    TONES,
    WIDE,
    legend_above,
    model_line,
    new_figure,
    positive,
    use_logarithm,
)
from .render import COLOUR_MAP, Body

FloatArray = NDArray[np.float64]

_MILLI: Final = 1e3
_KILO: Final = 1e-3
_MOST_DOTS: Final = 75  # Along an axis of time.
_LEAST_SPAN: Final = 0.08  # Of a coordinate's axis, over the largest motion of the trial.
_ABOVE: Final = 0.35  # What is seen around the measured path, over its longest side.
_LEAST: Final = 0.25  # Of the shortest side, over the longest.
_LEGEND_ROW: Final = 4  # Most names of chambers in one row.
_ROUND: Final = 0.5  # [s] between the points along a path in space.


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
        motion.plot(time, _MILLI * target[:, axis], color=TONES["target"].light, linewidth=4.0, label="Target")
        for model in (name for name in displacements if name != "target"):
            moved = displacements[model]
            motion.plot(time, _MILLI * moved[:, axis], **model_line(model))
            with np.errstate(over="ignore", invalid="ignore"):
                gap = _MILLI * np.linalg.norm(moved - target, axis=1)
            distance.plot(time, positive(gap), color=TONES[model].light)
        lowest, highest = _MILLI * target[:, axis].min(), _MILLI * target[:, axis].max()
        margin = 0.8 * (highest - lowest)  # Keeps a diverging roll-out from setting the scale.
        bottom, top = motion.get_ylim()
        motion.set_ylim(max(lowest - margin, bottom), min(highest + margin, top))
        motion.set_ylabel(f"tip displacement\nalong {'xyz'[axis]} [mm]")
        motion.yaxis.set_major_locator(MaxNLocator(5, steps=ROUND_STEPS))
        use_logarithm(distance)
        distance.set(xlabel="time [s]", ylabel="off target\n[mm]", xlim=(0.0, time[-1]))
        legend_above(figure, motion, narrow=narrow)
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
            axes.imshow((255.0 * body.pixels).astype(np.uint8))
            factor, unit = (1e3, "mm") if body.largest >= 1e-4 else (1e6, "µm")
            scale = ScalarMappable(Normalize(0.0, factor * body.largest), mpl.colormaps[COLOUR_MAP])
            bar = figure.colorbar(scale, ax=axes, orientation="horizontal", shrink=0.8, aspect=34, pad=0.02)
            bar.outline.set_visible(False)
            bar.set_label(f"distance from the target [{unit}]")
            bar.locator = MaxNLocator(5, steps=ROUND_STEPS)
            bar.update_ticks()
    return figure


def marker_paths(
    times: FloatArray,
    target: FloatArray,
    models: Mapping[str, FloatArray],
    labels: Sequence[str],
    start: FloatArray,
    *,
    narrow: bool,
) -> Figure:
    """Draw each marker's coordinates over time: measured as dots, models as lines.

    Args:
        times: (T,) [s].
        target: (T, M, 3) [m], NaN where a marker was not seen.
        models: (T, M, 3) [m] by model.
        labels: Of the M markers.
        start: (M, 3) [m] what is subtracted: where the markers were held.
        narrow: Whether the figure is for a narrow page; the panels then stand below each other.
    """
    count = len(labels)
    with mpl.rc_context(STYLE):
        shape = (3 * count, 1) if narrow else (count, 3)
        figure = new_figure(0.9 + 1.25 * count, 1.2 + 1.05 * 3 * count, narrow=narrow)
        panels = figure.subplots(*shape, sharex=True, squeeze=False)
        _coordinates(list(panels.flat), times, target - start, {m: q - start for m, q in models.items()})
        for marker, label in enumerate(labels):
            for axis, name in enumerate("xyz"):
                if narrow:
                    panels[3 * marker + axis, 0].set_title(f"{label}, {name} [mm]")
                elif marker == 0:
                    panels[0, axis].set_title(name)
            if not narrow:
                panels[marker, 0].set_ylabel(f"{label} [mm]")
        for axes in panels[-1]:
            axes.set(xlabel="time [s]", xlim=(0.0, times[-1]))
        figure.align_ylabels(panels[:, 0])
        legend_above(figure, panels[0, 0], narrow=narrow)
    return figure


def markers_and_pressures(
    times: FloatArray,
    target: FloatArray,
    models: Mapping[str, FloatArray],
    labels: Sequence[str],
    start: FloatArray,
    pressure: FloatArray,
    chambers: Sequence[str],
    limit: float | None,
    *,
    narrow: bool,
) -> Figure:
    """Draw coordinates of markers over time, and below them the pressures, on one axis of time.

    Args:
        times: (T,) [s].
        target: (T, M, 3) [m], NaN where a marker was not seen.
        models: (T, M, 3) [m] by model.
        labels: Of the M markers.
        start: (M, 3) [m] what is subtracted: where the markers are at rest.
        pressure: (T - 1, C) [Pa] between two frames.
        chambers: C names.
        limit: That no pressure may exceed [Pa].
        narrow: Whether the figure is for a narrow page.
    """
    count = len(labels)
    with mpl.rc_context(STYLE):
        height = 1.0 + 0.95 * 3 * count + 1.9
        figure = new_figure(height, height + 0.5, narrow=narrow)
        panels = figure.subplots(3 * count + 1, 1, sharex=True, height_ratios=[1.0] * 3 * count + [1.5])
        _coordinates(list(panels[:-1]), times, target - start, {m: q - start for m, q in models.items()})
        for place, axes in enumerate(panels[:-1]):
            axes.set_ylabel(f"{'xyz'[place % 3]} [mm]")
            if place % 3 == 0:
                axes.set_title(f"Marker {labels[place // 3]}")
        _pressures(panels[-1], times, pressure, limit)
        panels[-1].set(xlabel="time [s]", xlim=(0.0, times[-1]))
        panels[-1].set_title("Pressures")
        figure.align_ylabels(panels)
        legend_above(figure, panels[0], narrow=narrow)
        _chamber_legend(figure, panels[-1], chambers, narrow=narrow)
    return figure


def _coordinates(
    panels: Sequence[Axes], times: FloatArray, target: FloatArray, models: Mapping[str, FloatArray]
) -> None:
    """Draw displacements (T, M, 3) [m], a panel a coordinate, those of a marker after each other.

    The measured motion sets the scale, so that a model that runs away does not, nor does noise look like motion.
    """
    least = _LEAST_SPAN * float(np.ptp(np.nan_to_num(_MILLI * target), axis=0).max())
    every = -(-len(times) // _MOST_DOTS)
    for place, axes in enumerate(panels):
        at = (slice(None), place // 3, place % 3)
        seen = _MILLI * target[at]
        dots: dict[str, Any] = {"color": TONES["ink"].light, "markersize": 3.2, "zorder": 1.5, "label": "Measured"}
        axes.plot(times[::every], seen[::every], ".", **dots)
        for model, path in models.items():
            axes.plot(times, _shown(path[at]), **model_line(model, 1.1))
        if np.isfinite(seen).any():
            low, high = np.nanmin(seen), np.nanmax(seen)
            margin = 0.6 * (high - low) + 0.02
            bottom, top = axes.get_ylim()
            bottom, top = max(low - margin, bottom), min(high + margin, top)
            more = max(0.0, 0.5 * (least - (top - bottom)))
            axes.set_ylim(bottom - more, top + more)
        axes.yaxis.set_major_locator(MaxNLocator(4, steps=ROUND_STEPS))


def tip_planes(target: FloatArray, models: Mapping[str, FloatArray], *, narrow: bool) -> Figure:
    """Draw the path of the tip in the plane across gravity, a panel a model, over the measured one.

    Args:
        target: (T, 3) displacement from rest [m], NaN where it was not seen.
        models: (T, 3) [m] by model.
        narrow: Whether the figure is for a narrow page; there are then two panels in a row.
    """
    count = len(models)
    with mpl.rc_context(STYLE):
        columns = min(count, 2 if narrow else 4)
        rows = -(-count // columns)
        width = (NARROW if narrow else WIDE) / columns
        height = 0.75 + rows * (min(width, 3.4) + 0.15)
        figure = new_figure(height, height, narrow=narrow)
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        centre, half = _range(target[:, :2])
        for axes in panels.flat[count:]:
            axes.set_axis_off()
        for (model, path), axes in zip(models.items(), panels.flat, strict=False):
            axes.plot(*(_MILLI * target[:, :2]).T, color=TONES["target"].light, linewidth=2.6, label="Measured")
            axes.plot(*_shown(path[:, :2]).T, color=TONES[model].light, linewidth=0.9)
            axes.set_title(LABELS[model])
            reach = half.max() * np.array([-1.0, 1.0])
            axes.set(xlim=centre[0] + reach, ylim=centre[1] + reach)
            axes.set_aspect("equal")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(MaxNLocator(5, steps=ROUND_STEPS))
        for column in range(columns):
            panels[(count - 1 - column) // columns, column].set_xlabel("x [mm]")
            panels[(count - 1 - column) // columns, column].tick_params(labelbottom=True)
        for row in panels:
            row[0].set_ylabel("y [mm]")
        legend_above(figure, panels[0, 0], narrow=narrow)
    return figure


def _range(target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The middle (D,) of a measured path (T, D) [m], and half the widths (D,) of a view of it [mm]."""
    seen = _MILLI * target[np.isfinite(target).all(axis=1)]
    if not len(seen):
        return np.zeros(target.shape[1]), np.ones(target.shape[1])
    low, high = seen.min(axis=0), seen.max(axis=0)
    widest = max(float((high - low).max()), 0.1)
    return 0.5 * (low + high), 0.5 * np.maximum(high - low, _LEAST * widest) + 0.5 * _ABOVE * widest


def _shown(path: FloatArray) -> FloatArray:
    """A path [mm], with gaps where it ran away."""
    with np.errstate(invalid="ignore", over="ignore"):
        shown: FloatArray = np.where(np.abs(_MILLI * path) < LARGEST_SHOWN, _MILLI * path, np.nan)
    return shown


def tip_in_space(times: FloatArray, target: FloatArray, models: Mapping[str, FloatArray], *, narrow: bool) -> Figure:
    """Draw the path of the tip in space, a panel a model, with points at equal times joined to the measured ones.

    Args:
        times: (T,) [s].
        target: (T, 3) displacement from rest [m], NaN where it was not seen.
        models: (T, 3) [m] by model.
        narrow: Whether the figure is for a narrow page; the panels then stand below each other.
    """
    every = max(1, round(_ROUND / float(times[1] - times[0]))) if len(times) > 1 else 1
    centre, half = _range(target)
    with mpl.rc_context({**STYLE, "xtick.labelsize": 7.5, "ytick.labelsize": 7.5}):
        shape = (len(models), 1) if narrow else (1, len(models))
        figure = new_figure(3.3, 0.4 + 3.2 * len(models), narrow=narrow)
        panels = figure.subplots(*shape, squeeze=False, subplot_kw={"projection": "3d"})
        for (model, path), axes in zip(models.items(), panels.flat, strict=True):
            assert isinstance(axes, Axes3D)
            seen, simulated = _MILLI * target, _inside(_shown(path), centre, half)
            axes.plot(*seen.T, color=TONES["target"].light, linewidth=2.4, label="Measured")
            axes.plot(*simulated.T, color=TONES[model].light, linewidth=1.2, label=LABELS[model])
            for at in range(0, len(times), every):
                pair = np.stack([seen[at], simulated[at]])
                axes.plot(*pair.T, color=TONES["ink"].light, linewidth=0.7)
                axes.plot(*pair[:1].T, "o", color=TONES["muted"].light, markersize=3.0)
                axes.plot(*pair[1:].T, "o", color=TONES[model].light, markersize=3.0)
            _space(axes, centre, half)
            axes.set_title(LABELS[model], y=0.92)
        handles, labels = panels.flat[0].get_legend_handles_labels()
        figure.legend(handles[:1], labels[:1], loc="outside upper left")
    return figure


def _inside(path: FloatArray, centre: FloatArray, half: FloatArray) -> FloatArray:
    """What of a path (T, 3) is in the box that is drawn, with gaps where it is not."""
    within = np.asarray((np.abs(path - centre) <= half).all(axis=1))
    return np.where(within[:, None], path, np.nan)


def _space(axes: Axes3D, centre: FloatArray, half: FloatArray) -> None:
    """The box of a picture in space, its axes and its view."""
    axes.set(
        xlim=(centre[0] - half[0], centre[0] + half[0]),
        ylim=(centre[1] - half[1], centre[1] + half[1]),
        zlim=(centre[2] - half[2], centre[2] + half[2]),
        xlabel="x [mm]",
        ylabel="y [mm]",
        zlabel="z [mm]",
    )
    axes.view_init(elev=28.0, azim=-58.0)
    axes.set_box_aspect(tuple(half), zoom=0.84)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(4, steps=ROUND_STEPS))
        axis.set_pane_color((0.0, 0.0, 0.0, 0.0))
        axis.label.set_color(TONES["muted"].light)
        axis._axinfo["grid"]["color"] = TONES["rule"].light


def pressure_sequences(
    time_step: float,
    pressures: Mapping[str, FloatArray],
    chambers: Sequence[str],
    limit: float | None,
    *,
    narrow: bool,
) -> Figure:
    """Draw the pressures of a few trials, a panel a trial.

    Args:
        time_step: [s].
        pressures: (K, C) [Pa] during each step, by the panel's title.
        chambers: C names.
        limit: That none may exceed [Pa].
        narrow: Whether the figure is for a narrow page.
    """
    with mpl.rc_context(STYLE):
        height = 0.9 + 1.35 * len(pressures)
        figure = new_figure(height, height + 0.4, narrow=narrow)
        panels = figure.subplots(len(pressures), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for (title, rows), axes in zip(pressures.items(), panels, strict=True):
            times = time_step * np.arange(len(rows) + 1, dtype=np.float64)
            _pressures(axes, times, rows, limit)
            axes.set_title(title)
        longest = max(len(rows) for rows in pressures.values())
        panels[-1].set(xlabel="time [s]", xlim=(0.0, time_step * longest))
        _chamber_legend(figure, panels[0], chambers, narrow=narrow)
    return figure


def _pressures(axes: Axes, times: FloatArray, pressure: FloatArray, limit: float | None) -> None:
    """Steps of the pressures (K, C) [Pa] between K + 1 times [s], and the limit as a dashed line."""
    for values, colour in zip(pressure.T, cycle(CHAMBER_COLOURS), strict=False):
        axes.stairs(_KILO * values, times, baseline=None, color=colour, linewidth=1.2)
    if limit is not None:
        axes.axhline(_KILO * limit, color=TONES["muted"].light, linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set_ylabel("pressure [kPa]")
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=ROUND_STEPS))


def _chamber_legend(figure: Figure, axes: Axes, chambers: Sequence[str], *, narrow: bool) -> None:
    """Names of the chambers, below the figure."""
    handles: list[Any] = [
        Line2D([], [], color=colour, label=name.replace("_", " "))
        for name, colour in zip(chambers, cycle(CHAMBER_COLOURS), strict=False)
    ]
    if axes.lines:
        (handle,) = axes.lines[-1:]
        handles.append(Line2D([], [], color=handle.get_color(), linestyle=(0, (4, 3)), label="limit"))
    figure.legend(handles=handles, loc="outside lower left", ncols=2 if narrow else _LEGEND_ROW, columnspacing=1.4)


def motion_instants(frames: NDArray[np.uint8], titles: Sequence[str], *, narrow: bool) -> Figure:
    """Show the body at a few instants, and beside or below each picture its markers from nearby.

    Args:
        frames: (F, 2, H, W, 4) as `warp_resphys.report.video.draw_instants` drew them.
        titles: Of the F instants.
        narrow: Whether the figure is for a narrow page.
    """
    count, _, height, width, _ = frames.shape
    rise = height / width
    with mpl.rc_context(STYLE):
        size = NARROW / 2.0 if narrow else WIDE / count
        total = count * (rise * size + 0.3) if narrow else 2.0 * rise * size + 0.35
        figure = new_figure(total, total, narrow=narrow)
        shape = (count, 2) if narrow else (2, count)
        panels = figure.subplots(*shape, squeeze=False)
        for frame, title in enumerate(titles):
            for view in range(2):
                axes = panels[frame, view] if narrow else panels[view, frame]
                axes.imshow(frames[frame, view])
                axes.set_axis_off()
                if view == 0:
                    axes.set_title(title)
    return figure
