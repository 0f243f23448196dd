"""Stage: from recordings to markers in the frame of the body, and what acted on it, from time zero on.

Time zero is the release of a body that was held, or the first frame of one that rests until its inputs come. Released
bodies keep the times of their frames: losses and errors are taken at them, from the simulation between its steps, so
that the frame rate need not fit the time step. Driven ones are brought to the steps, during which inputs are constant.
"""

import logging
from collections.abc import Container, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.actuation import NO_INPUT
from ..data.base_motion import at_times, check_steps
from ..data.recordings.processing import smooth
from ..data.recordings.quality import quality
from ..data.registration import Registration
from ..io.errors import DataFileError, InputError
from ..io.files import write_json
from ..io.stages import StageContext
from ..settings.stages import ImportStage
from ..settings.trials import ReadingSettings
from .actuators import Drive
from .build import bound_markers
from .files import DATASET, QUALITY, REGISTRATION, SCALED_DATASET, Dataset, read_dataset
from .observing import Observed, Observer
from .simulate import vertical
from .trials import evenly

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

_LARGEST_LEAN = 30.0  # degrees between the vertical of a recording and the configured gravity
_SHOWN = 6  # driven trials whose quality and registration are kept for the report
_MILLI = 1e3


def import_recordings(context: StageContext) -> None:
    """Writes dataset.h5, quality.json and registration.json.

    Raises:
        DataFileError: a recording that cannot be read or used; the sentence names the file and the marker.
        InputError: a configured value that does not fit.
    """
    observer = Observer(context)
    settings, tracked = observer.settings, observer.tracked
    observed = observer.observe(settings.trials)
    if observer.drive is not None:
        _check_unit([each.driven for each in observed if each.driven is not None], settings.data, observer.drive)
    known = [each.trial.name for each in observed] if settings.learned is None else settings.learned
    offsets = np.stack([_offset(observer, each) for each in observed])  # (R, M, 3) [m]
    mean = _mean_offset(offsets, observed, known)
    mesh, bound = observer.simulator.body.mesh, observer.nominal + mean
    bound_markers(settings.markers, mesh, bound, tracked)  # Refuses a marker that is far off.
    shifts = _shifts(settings.data, observed, mean, offsets)
    verticals = _verticals(observed, settings)
    gravity = _gravity(verticals, settings)
    _dataset(observer, observed, bound, shifts, gravity).write(context.run_dir / DATASET)
    _write_quality(context, observed, tracked, shifts, verticals, gravity)


def import_scaled(context: StageContext) -> None:
    """Writes dataset_scaled.h5, of the trials at scaled inputs; markers sit where they sit in dataset.h5.

    Raises:
        DataFileError: a recording that cannot be read or used.
    """
    observer = Observer(context)
    known = read_dataset(context.run_dir / DATASET)
    assert known.bound is not None
    observed = observer.observe(observer.settings.trials)
    offsets = np.stack([_offset(observer, each) for each in observed])
    shifts = _shifts(observer.settings.data, observed, known.bound - observer.nominal, offsets)
    _dataset(observer, observed, known.bound, shifts, known.gravity).write(context.run_dir / SCALED_DATASET)


def _offset(observer: Observer, each: Observed) -> FloatArray:
    """(M, 3) how far tracked markers are from where they should be in the frame of the body [m], NaN where not seen."""
    found = np.full_like(observer.nominal, np.nan)
    found[each.columns] = each.places - observer.reader.expected(each.trial)[: len(each.columns)]
    return found


def _mean_offset(offsets: FloatArray, observed: Sequence[Observed], known: Container[str]) -> FloatArray:
    """(M, 3) by which markers sit elsewhere than nominally [m], of (R, M, 3) offsets; none of those nobody tells.

    Trials that are not ``known``, as they test, tell it of markers that others do not have.
    """
    mean = np.zeros(offsets.shape[1:])
    tells = np.array([each.tells_places for each in observed])
    learned = np.array([each.trial.name in known for each in observed])
    for marker, seen in enumerate(np.isfinite(offsets).all(axis=2).T & tells):
        if seen.any():
            mean[marker] = offsets[seen & learned if (seen & learned).any() else seen, marker].mean(axis=0)
    return mean


def _shifts(data: ReadingSettings, observed: Sequence[Observed], mean: FloatArray, offsets: FloatArray) -> FloatArray:
    """(R, M, 3) by which each trial's markers are moved [m]: to where they sit on the whole, if they drift."""
    if data.alignment == "shared":
        return np.zeros_like(offsets)
    own = np.array([each.tells_places for each in observed])
    return np.where(own[:, None, None], mean - offsets, 0.0)


def _check_unit(driven: Sequence[FloatArray], data: ReadingSettings, drive: Drive) -> None:
    """Refuses recordings under which the body would hardly move, as those do whose unit was mistaken."""
    if not driven or all(len(each) == 1 for each in driven):
        return
    assert data.input_limit is not None
    highest, limit = max(float(np.abs(each).max()) for each in driven), data.input_limit
    words, unit = drive.quantity.plural, drive.quantity.unit
    if highest < NO_INPUT * limit:
        raise DataFileError(
            f"the {words} of all {len(driven)} recordings stay below {highest:.3g} {unit}, and data.input_limit is "
            f"{limit:.3g} {unit}: name their unit in the files (actuation_units, or the header of the column), or "
            "set the limit to what the robot takes."
        )


def _dataset(
    observer: Observer, observed: Sequence[Observed], bound: FloatArray, shifts: FloatArray, gravity: FloatArray
) -> Dataset:
    """The trials in the frame of the body; those that end early are padded."""
    settings, drive = observer.settings, observer.drive
    cutoff, steps = settings.data.cutoff, settings.data.steps
    frames = max(len(each.moving.positions) if each.trial.is_released else 1 for each in observed)
    if any(each.trial.begins == "rest" for each in observed):
        assert steps is not None
        frames = max(frames, steps + 1)
    shape = (len(observed), frames, len(observer.tracked), 3)
    markers, smoothed = np.full(shape, np.nan), np.full(shape, np.nan)
    times, held = np.zeros(shape[:2]), np.full((shape[0], *shape[2:]), np.nan)
    inputs = {}
    if drive is not None:
        inputs[drive.quantity.name] = np.zeros((len(observed), steps if steps else 1, len(drive.parts)))
    for row, each in enumerate(observed):
        limit = frames if each.trial.is_released or steps is None else steps + 1
        seen = each.moving.positions[:limit]
        slow = each.moving if cutoff is None or len(seen) == 1 else smooth(each.moving, cutoff)
        has, shift = each.columns, shifts[row, each.columns]
        markers[row, : len(seen), has] = each.to_body(seen, shift).swapaxes(0, 1)
        smoothed[row, : len(seen), has] = each.to_body(slow.positions[:limit], shift).swapaxes(0, 1)
        held[row, has] = each.to_body(each.still[: len(has)], shift)
        if each.trial.is_released:
            times[row] = np.pad(each.moving.time, (0, frames - len(seen)), mode="edge")
        elif each.trial.begins == "rest":
            times[row] = np.minimum(np.arange(frames), steps or 0) * settings.time_step
            held[row] = np.where(np.isfinite(markers[row, 0]), markers[row, 0], held[row])
        else:
            held[row, has] = bound[has]  # A pose is as large as it is far from the undeformed body.
        if each.driven is not None:
            for series in inputs.values():
                _fill_inputs(series[row], each.driven, each)
    base = _bases(observed, times, settings.time_step, observer.simulator.body.mesh.vertices)
    return Dataset(
        names=tuple(each.trial.name for each in observed),
        labels=tuple(observer.tracked),
        begins=tuple("released" if each.trial.is_released else each.trial.begins for each in observed),
        times=times,
        observed=markers,
        held=held,
        payload=np.array([each.trial.payload for each in observed]),
        gravity=gravity,
        time_step=settings.time_step,
        bound=bound,
        smoothed=smoothed if cutoff is not None or all(each.trial.begins == "rest" for each in observed) else None,
        inputs=inputs,
        channels={} if drive is None else {drive.quantity.name: drive.parts},
        base=base,
    )


def _bases(observed: Sequence[Observed], times: FloatArray, time_step: float, points: FloatArray) -> FloatArray | None:
    """(R, K + 1, 6) how the base of each trial moves, at the steps of the longest; None where all stand still."""
    if all(each.base is None for each in observed):
        return None
    steps = time_step * np.arange(round(np.ceil(times.max() / time_step - 1e-6)) + 1)
    found = np.zeros((len(observed), len(steps), 6))
    for row, each in enumerate(observed):
        if each.base is not None:
            found[row] = at_times(each.base, each.moving.time, steps)
            check_steps(found[row], points, each.raw.source)
    return found


def _fill_inputs(row: FloatArray, driven: FloatArray, each: Observed) -> None:
    """Writes the inputs (K, C) during the steps of a trial; past its end, and in a pose, the last ones."""
    series = driven if len(driven) == 1 else driven[1 : len(row) + 1]
    row[: len(series)] = series
    row[len(series) :] = driven[-1]
    if 1 < len(series) < len(row):
        log.warning(
            "import: %s ends after %d of the %d steps of data.steps; the rest counts as not seen.",
            *(each.raw.source.name, len(series), len(row)),
        )


def _verticals(observed: Sequence[Observed], settings: ImportStage) -> FloatArray | None:
    """(R, 3) the vertical of each recording in the frame of the body, near the configured one; None if not known."""
    up = vertical(settings.data.up)
    if up is None:
        return None
    verticals = np.stack([each.registration.transform.rotation @ up for each in observed])
    configured = np.asarray(settings.gravity, dtype=np.float64)
    for each, found in zip(observed, verticals, strict=True):
        if configured.any() and _angle(found, -configured) > _LARGEST_LEAN:
            down = ", ".join(f"{-each:.2f}" for each in found)
            raise InputError(
                f"{each.raw.source}: with data.up {settings.data.up}, gravity points along ({down}) in the "
                f"frame of the body, {_angle(found, -configured):.0f} degrees from the configured one: set data.up to "
                "the vertical of the recordings, or gravity to its direction in the frame of markers and mesh."
            )
    return verticals


def _gravity(verticals: FloatArray | None, settings: ImportStage) -> FloatArray:
    """(3,) gravity in the frame of the body, as strong as configured [m/s^2]."""
    configured = np.asarray(settings.gravity, dtype=np.float64)
    if verticals is None:
        return configured
    mean = verticals.mean(axis=0)
    return np.asarray(-np.linalg.norm(configured) * mean / np.linalg.norm(mean))


def _angle(a: FloatArray, b: FloatArray) -> float:
    """Degrees between two vectors."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def _write_quality(
    context: StageContext,
    observed: Sequence[Observed],
    tracked: Sequence[str],
    shifts: FloatArray,
    verticals: FloatArray | None,
    gravity: FloatArray,
) -> None:
    """quality.json and registration.json: of all released trials, and of a few driven ones."""
    settings: ImportStage = context.settings
    reference, gap = list(settings.markers.reference), settings.data.longest_gap
    driven = [row for row, each in enumerate(observed) if not each.trial.is_released]
    shown = evenly(driven, _SHOWN) if driven else []
    qualities, registrations = {}, {}
    for row, each in enumerate(observed):
        if row in driven and row not in shown:
            continue
        name = each.trial.name
        found = quality(each.raw, reference if each.base is None else [], each.release, longest_gap=gap)
        qualities[name] = found.to_plain()
        if each.trial.is_released:
            for warning in found.warnings:
                log.warning("%s: %s", found.source.name, warning)
        elif found.warnings:
            log.info("import: %s: %d remarks on its quality in the report", found.source.name, len(found.warnings))
        # Where a loaded body has its own markers says nothing of the registration.
        standing = None if each.tells_places else reference
        labels = [tracked[number] for number in each.columns]
        registrations[name] = _summary(each.registration, labels, -shifts[row, each.columns], standing)
        if verticals is not None:
            registrations[name]["vertical_deg"] = _angle(verticals[row], -gravity)
    write_json(context.run_dir / QUALITY, qualities)
    write_json(context.run_dir / REGISTRATION, registrations)


def _summary(
    registration: Registration, tracked: Sequence[str], shift: FloatArray, only: Sequence[str] | None
) -> dict[str, Any]:
    """For registration.json: lengths in millimetres, but for the positions in the frame of the body, in metres.

    Positions and residuals are those of all markers, or of some ``only``.
    """
    rows = [row for row, name in enumerate(registration.names) if only is None or name in only]
    names = [registration.names[row] for row in rows]
    return {
        "positions": dict(zip(names, registration.positions[rows].tolist(), strict=True)),
        "rms_mm": _MILLI * registration.rms,
        "residual_mm": dict(zip(names, _MILLI * registration.residual[rows], strict=True)),
        "outliers": list(registration.outliers),
        "shift_mm": dict(zip(tracked, (_MILLI * shift).tolist(), strict=True)),
    }
