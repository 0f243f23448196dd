"""Quality of a recording as a table and a picture: occlusions, jumps,
noise and drift of its markers; conversion.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import cycle
from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from ..data.force_sensors import AXES, UNITS
from ..data.recordings.bag import is_bag
from ..data.recordings.marker_quality import (
    QUALITY_COLUMNS,
    MarkerQuality,
    Quality,
    compare_base,
    quality,
    quality_table,
)
from ..data.recordings.processing import fill_gaps, release_of
from ..data.recordings.recording import Recording
from ..data.recordings.recording_files import READERS, read_recording, write_recording
from ..io.arrays import FloatArray
from ..io.atomic import atomic_path
from ..io.errors import DataFileError, InputError, listed
from ..io.progress import aligned
from ..io.safe_files import write_json
from ..io.settings import Count, Many, NotNegative, Positive, Settings, Word, setting
from ..report.figures import STYLE, new_figure, save_png
from ..report.wording import TONES
from ..settings.data_kinds import BagSettings, TableSettings

# Okabe and Ito (2008), without yellow: everyone can tell them apart.
MARKER_COLOURS: Final = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#56b4e9",
    "#e69f00",
    "#1c2127",
)
_STATES: Final = {"seen": "#dde1e6", "filled": "#e69f00", "masked": "#c4481b"}
_MILLI: Final = 1e3
_ROW: Final = 0.16  # [in] of a marker in the raster
_LEGEND_COLUMNS: Final = 6


class RecordingFile(Settings):
    """A recording, and what its file does not say or says wrongly."""

    path: Word | None = None
    units: Word | None = None
    rate: Positive | None = setting(None, unit="Hz")
    labels: Many[Word] | None = None
    bag: BagSettings | None = None
    table: TableSettings | None = None


class RecordingInspection(Settings):
    """A recording whose quality is inspected, and others with which it is compared."""

    recording: RecordingFile
    still: Many[Word]
    moving: Many[Word]
    compare_with: Many[Word]
    longest_gap: Count
    least_jump: NotNegative = setting(unit="m")
    largest_distortion: NotNegative = setting(unit="m")


def recording_quality(recording: Recording, result: Quality) -> Figure:
    """Draws displacements of markers from their median position over time, jumps and occlusions.

    Markers that should stand still have their own panel, with their distance from the median
    position. A line breaks where a gap is masked; where it was filled, the line is thin. A triangle
    marks the first frame after a jump.
    """
    several = [
        label
        for label, seen in zip(recording.labels, recording.seen.T, strict=True)
        if seen.sum() > 1
    ]
    bridged = fill_gaps(recording.select(several), result.longest_gap_filled)
    still = {marker.label for marker in result.markers if marker.still}
    panels = [*("xyz" if len(still) < len(recording.labels) else ""), *(["still"] if still else [])]
    heights = [
        *(1.2 if panel == "still" else 1.5 for panel in panels),
        _ROW * len(recording.labels) + 0.1,
    ]
    colours = dict(zip(recording.labels, cycle(MARKER_COLOURS), strict=False))
    with mpl.rc_context(STYLE):
        figure = new_figure(sum(heights) + 1.0)
        *rows, last = figure.subplots(
            len(heights), 1, sharex=True, squeeze=False, height_ratios=heights
        )[:, 0]
        for axes, panel in zip(rows, panels, strict=True):
            for marker in result.markers:
                if marker.label in several and marker.still == (panel == "still"):
                    _draw_marker(axes, panel, recording, bridged, marker, colours[marker.label])
            axes.set_ylabel("distance [mm]" if panel == "still" else f"{panel} [mm]")
            axes.yaxis.set_major_locator(MaxNLocator(4))
            titles = {
                "x": "Markers, from their median position",
                "still": "Markers that should not move",
            }
            axes.set_title(titles.get(panel, ""))
            if result.release_frame is not None:
                released = result.release_frame / result.rate_hz
                axes.axvline(released, color=TONES["ink"].light, linewidth=0.9, linestyle="--")
        _draw_seen(last, recording, bridged, result)
        last.set_xlabel(
            "time [s]; dashed: motion starts" if result.release_frame is not None else "time [s]"
        )
        last.set_xlim(0.0, len(recording.positions) / recording.rate)
        handles = [
            mpl.lines.Line2D([], [], color=colour, label=label) for label, colour in colours.items()
        ]
        columns = min(len(handles), _LEGEND_COLUMNS)
        figure.legend(handles=handles, loc="outside upper left", ncols=columns, columnspacing=1.4)
        figure.align_ylabels(rows)
    return figure


def _draw_marker(
    axes: Axes,
    panel: str,
    recording: Recording,
    bridged: Recording,
    marker: MarkerQuality,
    colour: str,
) -> None:
    """Draws a marker in a panel: thin where gaps were filled, with a triangle at each jump."""
    column = recording.labels.index(marker.label)
    middle = np.nanmedian(recording.positions[:, column], axis=0)
    moved = _MILLI * (bridged.positions[:, bridged.labels.index(marker.label)] - middle)
    path = np.linalg.norm(moved, axis=1) if marker.still else moved[:, "xyz".index(panel)]
    time = np.arange(len(path)) / recording.rate
    axes.plot(time, path, color=colour, linewidth=0.5)
    axes.plot(time, np.where(recording.seen[:, column], path, np.nan), color=colour, linewidth=1.1)
    frames = [jump.frame for jump in marker.jumps]
    axes.plot(
        time[frames],
        path[frames],
        "v",
        color=colour,
        markersize=4.5,
        markeredgecolor="white",
        markeredgewidth=0.4,
    )


def inspect_recording(settings: RecordingInspection, folder: Path) -> str:
    """Examines a recording, and writes quality.json and quality.png.

    Returns:
        The table and the warnings, as text.

    Raises:
        ResphysError: a value in the configuration cannot be used, a recording cannot be read, or a
            marker on the base was moved between two recordings.
    """
    still, longest_gap = settings.still, settings.longest_gap
    if settings.compare_with and len(still) < 2:
        raise InputError(
            "compare_with needs two or more markers on the base to compare: name them in still."
        )
    configured = settings.recording.arguments()
    recordings = [str(settings.recording.path), *settings.compare_with]
    recording, *others = [read_recording(**{**configured, "path": path}) for path in recordings]
    if not recording.labels:
        known = listed([*recording.loads])
        raise DataFileError(
            f"{recording.source} has no markers, whose quality is examined, but force sensors "
            f"alone ({known}): read it in Python, or convert it."
        )
    release = release_of(recording, settings.moving, longest_gap) if settings.moving else None
    result = quality(
        recording, still, release, longest_gap=longest_gap, least_jump=settings.least_jump
    )
    trials = [recording, *others]
    moved = zip(trials[1:], *compare_base(trials, still), strict=True) if len(trials) > 1 else ()
    motions = [
        (trial.source, _MILLI * shift, _MILLI * distortion) for trial, shift, distortion in moved
    ]
    figure = recording_quality(recording, result)
    base = [
        {
            "source": source,
            "shift_mm": dict(zip(still, shift, strict=True)),
            "distortion_mm": dict(zip(still, distortion, strict=True)),
        }
        for source, shift, distortion in motions
    ]
    write_json(folder / "quality.json", {**asdict(result), "base": base})
    with atomic_path(folder / "quality.png") as partial:
        save_png(figure, partial)
    if len(trials) > 1:
        compare_base(trials, still, settings.largest_distortion)
    table = quality_table(result.markers)
    heads = ["marker", *(column.lower() for column in QUALITY_COLUMNS)]
    lines = [aligned([heads, *([label, *cells] for label, cells in table.items())])]
    seconds = result.frames / result.rate_hz
    lines.append(
        f"{result.source}: {result.frames} frames, {seconds:.2f} s at {result.rate_hz:g} Hz"
    )
    lines += [f"Force sensor {name}: {_ranges(loads)}." for name, loads in recording.loads.items()]
    if release is not None:
        rest = release.rest
        lines.append(
            f"Motion starts in frame {release.frame:.2f}; "
            f"still in frames {rest[0]} to {rest[1] - 1}."
        )
    lines += result.warnings
    lines += [
        f"{source}: the base is shifted by up to {shift.max():.2f} mm; its markers moved by up to "
        f"{distortion.max():.2f} mm relative to each other."
        for source, shift, distortion in motions
    ]
    return "\n".join(lines)


def _ranges(loads: FloatArray) -> str:
    """Returns the range of each measured axis of readings (T, 6)."""
    read = {axis: column[np.isfinite(column)] for axis, column in zip(AXES, loads.T, strict=True)}
    known = [
        f"{axis} {x.min():.3g} to {x.max():.3g} {UNITS[axis]}" for axis, x in read.items() if len(x)
    ]
    return ", ".join(known) or "no reading"


def _draw_seen(axes: Axes, recording: Recording, bridged: Recording, result: Quality) -> None:
    """Draws a row for each marker: frames in which it is seen, filled or masked, and its jumps."""
    height = len(recording.labels)
    states = np.full((height, len(recording.positions)), 2)
    states[recording.seen.T] = 0
    for label in bridged.labels:
        row = recording.labels.index(label)
        was_filled = bridged.seen[:, bridged.labels.index(label)] & (states[row] == 2)
        states[row, was_filled] = 1
    image = np.array([mpl.colors.to_rgb(colour) for colour in _STATES.values()])[states]
    extent = (0.0, len(recording.positions) / recording.rate, height - 0.5, -0.5)
    axes.imshow(image, extent=extent, aspect="auto", interpolation="nearest")
    for row, marker in enumerate(result.markers):
        at = [(jump.frame + 0.5) / recording.rate for jump in marker.jumps]
        axes.plot(
            at, [row] * len(at), "|", color=TONES["ink"].light, markersize=6, markeredgewidth=0.9
        )
    for row in range(1, height):
        axes.axhline(row - 0.5, color="white", linewidth=1.2)
    axes.set_title("Seen by the cameras")
    axes.set_yticks(range(height), recording.labels)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False)
    handles: list[Artist] = [Patch(color=colour, label=name) for name, colour in _STATES.items()]
    handles.append(axes.plot([], [], "|", color=TONES["ink"].light, markersize=6, label="jump")[0])
    axes.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, handlelength=1.0
    )


class Conversion(Settings):
    """The configuration ``convert``, which explains its keys."""

    files: Many[Word]
    to: Word
    recording: RecordingFile


def convert(settings: Conversion, folder: Path) -> None:
    """Writes the recordings, and prints a line for each.

    Raises:
        ResphysError: nothing was named, a recording cannot be read, or two have the same name.
    """
    del folder
    files = [*_recordings(settings.files)]
    if not files:
        raise InputError("nothing to convert: name recordings, as in warp-resphys convert FILE.")
    places = {path: Path(settings.to).expanduser() / f"{path.stem}.h5" for path in files}
    if len({*places.values()}) < len(files):
        twice = [str(path) for path in files if [*places.values()].count(places[path]) > 1][:2]
        raise InputError(
            f"{' and '.join(twice)} would both be {places[Path(twice[0])]}: "
            "convert them to two folders."
        )
    for path, place in places.items():
        if place.exists() and place.samefile(path):
            raise InputError(
                f"{path} would be replaced by itself: choose another folder, as in to=converted."
            )
        recording = read_recording(**{**settings.recording.arguments(), "path": path})
        write_recording(place, recording)
        frames, channels = len(recording.positions), recording.actuation
        inputs = "" if channels is None else f", inputs {channels.shape[1]}"
        sensors = f", force sensors {listed([*recording.loads])}" if recording.loads else ""
        seen = f", seen {recording.seen.mean():.1%}" if recording.labels else ""
        print(
            f"{path} -> {place}: {frames} frames at {recording.rate:g} Hz, markers "
            f"{listed(recording.labels)}{inputs}{sensors}{seen}"
        )


def _recordings(files: Sequence[str]) -> Iterator[Path]:
    """Yields recordings, and those in folders that are no bags."""
    for path in (Path(name).expanduser() for name in files):
        if not path.is_dir() or is_bag(path):
            yield path
            continue
        inside = sorted(
            file for file in path.iterdir() if file.suffix.lower() in READERS or is_bag(file)
        )
        if not inside:
            raise DataFileError(
                f"{path} has no recordings that can be read: name a folder with recordings."
            )
        yield from inside
