"""Stage: imports recordings as markers in the frame of the body and inputs, from time zero on.

Time zero is the release of a held body, or the first frame of a body that rests until its inputs begin. Released bodies
keep the times of their frames, at which simulations are interpolated, so that the frame rate need not match the time
step. Driven bodies are resampled to the time steps, during which inputs are constant.
"""

import logging
from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...data.actuation import NO_INPUT
from ...data.base_motion import at_times, check_steps
from ...data.recordings.processing import smooth
from ...data.recordings.quality import quality
from ...data.registration import Registration
from ...data.rigid import root_mean_square
from ...data.rigid_bodies import angles, as_markers, corners_of, motion_between, owners
from ...io.errors import DataFileError, InputError, number_of
from ...io.files import write_json
from ...io.stages import StageContext
from ...settings.stages import ImportStage
from ...settings.trials import ReadingSettings, Trial
from ..actuators import Drive
from ..build import bound_markers
from ..files import DATASET, QUALITY, REGISTRATION, RESTING, SCALED_DATASET, SLACK, UNDER_INPUTS, Dataset, read_dataset
from ..trials import evenly
from .observing import Observed, Observer
from .reading import vertical

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

_LARGEST_LEAN = 30.0  # degrees between the vertical of a recording and the configured gravity
_SHOWN = 6  # driven trials whose quality and registration are reported
_MILLI = 1e3


def import_recordings(context: StageContext) -> None:
    """Writes dataset.h5, quality.json and registration.json.

    Raises:
        DataFileError: a recording cannot be read or used; the message names the file and the marker.
        InputError: a configured value is invalid.
    """
    observer = Observer(context)
    settings, tracked = observer.settings, observer.tracked
    observed = observer.observe(settings.trials)
    if observer.drive is not None:
        _check_unit([x.driven for x in observed if x.driven is not None], settings.data, observer.drive)
    if text := sessions_text({x.settings.name: x.raw.rate for x in observed}, [x.settings.session for x in observed]):
        log.warning("import: %s", text)
    training = [x.settings.name for x in observed] if settings.learned is None else settings.learned
    offsets = np.stack([_offset(observer, x) for x in observed])  # (R, M, 3) [m]
    bound = _mounted(observer, observed, observer.nominal + _mean_offset(offsets, observed, training))
    bound_markers(settings.markers, observer.simulator.body.mesh, bound, tracked)  # Refuses a marker that is far off.
    shifts = _shifts(observer, observed, bound, offsets)
    mountings = _mountings(observer, observed, bound, offsets, training)
    verticals = _verticals(observed, settings)
    gravity = _gravity(verticals, settings)
    _dataset(observer, observed, bound, shifts, gravity).write(context.run_dir / DATASET)
    _write_quality(context, observed, tracked, shifts, verticals, gravity, mountings)


def import_scaled(context: StageContext) -> None:
    """Writes dataset_scaled.h5 with the trials at scaled inputs, and the marker places of dataset.h5.

    Raises:
        DataFileError: a recording cannot be read or used.
    """
    observer = Observer(context)
    dataset = read_dataset(context.run_dir / DATASET)
    assert dataset.bound is not None
    observed = observer.observe(observer.settings.trials)
    offsets = np.stack([_offset(observer, x) for x in observed])
    shifts = _shifts(observer, observed, dataset.bound, offsets)
    _dataset(observer, observed, dataset.bound, shifts, dataset.gravity).write(context.run_dir / SCALED_DATASET)


def sessions_text(rates: Mapping[str, float], sessions: Sequence[str | None]) -> str:
    """Returns a sentence on recordings that look like several sessions; empty if they do not, or if one is named.

    Args:
        rates: frames a second of the recordings, by trial.
        sessions: configured sessions of these trials.
    """
    kinds: dict[int, list[str]] = {}
    for name, rate in rates.items():
        kinds.setdefault(round(rate), []).append(name)
    if len(kinds) == 1 or any(sessions):
        return ""
    listed = "; ".join(f"{rate} Hz: {', '.join(names)}" for rate, names in sorted(kinds.items()))
    return (
        f"the recordings have different frame rates, as those of different sessions ({listed}): name them with "
        "data.trials.NAME.session, so that markers may have other places in each."
    )


def _offset(observer: Observer, trial: Observed) -> FloatArray:
    """(M, 3) observed minus expected places of tracked markers in the frame of the body [m], NaN if not seen.

    Those of rigid bodies are turned back with their part, so that they are places on the undeformed body.
    """
    offset = np.full_like(observer.nominal, np.nan)
    offset[trial.columns] = trial.places - observer.reader.expected(trial.settings)[: len(trial.columns)]
    return np.einsum("mij,mi->mj", observer.reader.turned(trial.settings), offset)


def _mean_offset(offsets: FloatArray, observed: Sequence[Observed], training: Container[str]) -> FloatArray:
    """(M, 3) mean of offsets (R, M, 3) of markers from their nominal places [m]; zero for markers that no trial shows.

    Test trials are used only for markers that no training trial has.
    """
    mean = np.zeros(offsets.shape[1:])
    shows_places = np.array([x.shows_places for x in observed])
    learned = np.array([x.settings.name in training for x in observed])
    for marker, seen in enumerate(np.isfinite(offsets).all(axis=2).T & shows_places):
        if seen.any():
            mean[marker] = offsets[seen & learned if (seen & learned).any() else seen, marker].mean(axis=0)
    return mean


def _mounted(observer: Observer, observed: Sequence[Observed], bound: FloatArray) -> FloatArray:
    """(M, 3) places of observed points (M, 3), those of a rigid body as its pose at rest has them [m].

    Raises:
        InputError: no trial shows a rigid body at rest.
    """
    for name, own in corners_of(observer.tracked).items():
        if not any(x.shows_places and x.settings.has(name) for x in observed):
            raise InputError(
                f"markers.rigid_bodies.{name}: its mounting on the body is unknown, as no trial shows it while the "
                "body is undeformed or at rest under its own weight alone: add such a trial, as a pose or a motion."
            )
        bound[own] = motion_between(observer.nominal[own], bound[own]).apply(observer.nominal[own])
    return bound


def _mountings(
    observer: Observer,
    observed: Sequence[Observed],
    bound: FloatArray,
    offsets: FloatArray,
    training: Container[str],
) -> dict[str, dict[str, Any]]:
    """Distance [mm] and angle [degrees] of the mountings of rigid bodies in each trial from those of all, by trial.

    Raises:
        InputError: a rigid body was remounted between two trials.
    """
    mountings: dict[str, dict[str, Any]] = {x.settings.name: {} for x in observed}
    for name, own in corners_of(observer.tracked).items():
        shown = [row for row, x in enumerate(observed) if x.shows_places and x.settings.has(name)]
        places = observer.nominal[own] + offsets[shown][:, own]
        away = _MILLI * np.linalg.norm(places.mean(axis=1) - bound[own].mean(axis=0), axis=-1)
        turned = np.degrees(angles(bound[own], places))
        first = next((at for at, row in enumerate(shown) if observed[row].settings.name in training), 0)
        apart = [root_mean_square(corners - places[first]) for corners in places]
        if max(apart) > observer.markers.largest_residual:
            worst = int(np.argmax(apart))
            source, other = (observed[shown[at]].raw.source for at in (worst, first))
            moved = _MILLI * np.linalg.norm((places[worst] - places[first]).mean(axis=0))
            raise InputError(
                f"{source}: {name!r} is {moved:.1f} mm and {np.degrees(angles(places[first], places[worst])):.1f} "
                f"degrees from its mounting in {other.name}: where it was remounted, give it another name in "
                "data.trials.NAME.labels and in markers.rigid_bodies."
            )
        for row, distance, angle in zip(shown, away, turned, strict=True):
            mountings[observed[row].settings.name][name] = {"distance_mm": distance, "angle_deg": angle}
        log.info(
            "import: %s is mounted %.1f mm from the centre of what carries it, turned by %.1f degrees; the trials "
            "differ from this by up to %.2f mm and %.2f degrees",
            *(name, _MILLI * np.linalg.norm(np.mean(bound[own] - observer.nominal[own], axis=0))),
            *(np.degrees(angles(observer.nominal[own], bound[own])), away.max(), turned.max()),
        )
    return mountings


def _shifts(observer: Observer, observed: Sequence[Observed], bound: FloatArray, offsets: FloatArray) -> FloatArray:
    """(R, M, 3) shifts that move the markers of each trial to their places [m]; zero if alignment is shared."""
    if observer.settings.data.alignment == "shared":
        return np.zeros_like(offsets)
    shows_places = np.array([x.shows_places for x in observed])
    turned = np.stack([observer.reader.turned(x.settings) for x in observed])
    shifts = np.einsum("rmij,rmj->rmi", turned, bound - observer.nominal - offsets)
    return np.where(shows_places[:, None, None], shifts, 0.0)


def _check_unit(driven: Sequence[FloatArray], data: ReadingSettings, drive: Drive) -> None:
    """Refuses recordings with negligible inputs, which indicate a wrong unit."""
    if not driven or all(len(inputs) == 1 for inputs in driven):
        return
    assert data.input_limit is not None
    highest, limit = max(float(np.abs(inputs).max()) for inputs in driven), data.input_limit
    words, unit = drive.quantity.plural, drive.quantity.unit
    if highest < NO_INPUT * limit:
        raise DataFileError(
            f"the {words} of all {len(driven)} recordings stay below {highest:.3g} {unit}, and data.input_limit is "
            f"{limit:.3g} {unit}: give their unit in the files (actuation_units, or the header of the column), or "
            "set the limit to the robot's maximum."
        )


def _dataset(
    observer: Observer, observed: Sequence[Observed], bound: FloatArray, shifts: FloatArray, gravity: FloatArray
) -> Dataset:
    """Makes the dataset in the frame of the body; trials that end early are padded."""
    settings, drive = observer.settings, observer.drive
    cutoff, steps = settings.data.cutoff, settings.data.steps
    frames = max(len(x.moving.positions) if x.settings.is_released else 1 for x in observed)
    if any(x.settings.begins in RESTING for x in observed):
        assert steps is not None
        frames = max(frames, steps + 1)
    shape = (len(observed), frames, len(observer.tracked), 3)
    markers, smoothed = np.full(shape, np.nan), np.full(shape, np.nan)
    times, held = np.zeros(shape[:2]), np.full((shape[0], *shape[2:]), np.nan)
    inputs, resting = {}, dict[str, FloatArray]()
    if drive is not None:
        inputs[drive.quantity.name] = np.zeros((len(observed), steps if steps else 1, len(drive.parts)))
        if any(_begins(x.settings) == UNDER_INPUTS for x in observed):
            resting[drive.quantity.name] = np.array([x.driven[0] for x in observed if x.driven is not None])
    for row, trial in enumerate(observed):
        limit = frames if trial.settings.is_released or steps is None else steps + 1
        seen = trial.moving.positions[:limit]
        slow = trial.moving if cutoff is None or len(seen) == 1 else smooth(trial.moving, cutoff)
        has, shift = trial.columns, shifts[row, trial.columns]
        markers[row, : len(seen), has] = trial.to_body(seen, shift).swapaxes(0, 1)
        smoothed[row, : len(seen), has] = trial.to_body(slow.positions[:limit], shift).swapaxes(0, 1)
        held[row, has] = trial.to_body(trial.still[: len(has)], shift)
        if trial.settings.is_released:
            times[row] = np.pad(trial.moving.time, (0, frames - len(seen)), mode="edge")
        elif trial.settings.begins in RESTING:
            times[row] = np.minimum(np.arange(frames), steps or 0) * settings.time_step
            held[row] = np.where(np.isfinite(markers[row, 0]), markers[row, 0], held[row])
        else:
            held[row, has] = bound[has]  # The displacement of a static pose counts from the undeformed body.
        if trial.driven is not None:
            for series in inputs.values():
                _fill_inputs(series[row], trial.driven, trial)
    sessions = tuple(x.settings.session or "" for x in observed)
    points = observer.simulator.body.mesh.vertices
    base = _at_steps(observed, [x.base for x in observed], times, settings.time_step, points)
    moved = dict.fromkeys(name for x in observed for name in x.obstacles)
    obstacles = {
        name: _at_steps(
            observed,
            [x.obstacles.get(name) for x in observed],
            times,
            settings.time_step,
            points,
            f"the obstacle {name!r}",
        )
        for name in moved
    }
    return Dataset(
        names=tuple(x.settings.name for x in observed),
        labels=tuple(observer.tracked),
        begins=tuple(_begins(x.settings) for x in observed),
        times=times,
        observed=markers,
        held=held,
        payload=np.array([x.settings.payload for x in observed]),
        gravity=gravity,
        time_step=settings.time_step,
        bound=bound,
        smoothed=smoothed if cutoff is not None or all(x.settings.begins in RESTING for x in observed) else None,
        inputs=inputs,
        channels={} if drive is None else {drive.quantity.name: drive.parts},
        units={} if drive is None else {drive.quantity.name: drive.quantity.unit},
        resting=resting,
        base=base,
        obstacles={name: motion for name, motion in obstacles.items() if motion is not None},
        sessions=sessions if any(sessions) else (),
    )


def _begins(trial: Trial) -> str:
    """How a trial begins in a dataset."""
    return "released" if trial.is_released else UNDER_INPUTS if trial.begins == SLACK else trial.begins


def _at_steps(
    observed: Sequence[Observed],
    motions: Sequence[FloatArray | None],
    times: FloatArray,
    time_step: float,
    points: FloatArray,
    what: str = "the base",
) -> FloatArray | None:
    """(R, K + 1, 6) motion of the base or of an obstacle at the steps of the longest trial; None if it stands still."""
    if all(poses is None for poses in motions):
        return None
    steps = time_step * np.arange(round(np.ceil(times.max() / time_step - 1e-6)) + 1)
    motion = np.zeros((len(observed), len(steps), 6))
    for row, (trial, poses) in enumerate(zip(observed, motions, strict=True)):
        if poses is not None:
            motion[row] = at_times(poses, trial.moving.time, steps)
            check_steps(motion[row], points, trial.raw.source, what)
    return motion


def _fill_inputs(row: FloatArray, driven: FloatArray, trial: Observed) -> None:
    """Fills in the inputs (K, C) during the steps of a trial; the last inputs are repeated after its end."""
    series = driven if len(driven) == 1 else driven[1 : len(row) + 1]
    row[: len(series)] = series
    row[len(series) :] = driven[-1]
    if 1 < len(series) < len(row):
        log.warning(
            "import: %s ends after %d of the %d steps of data.steps; later frames count as not seen.",
            *(trial.raw.source.name, len(series), len(row)),
        )


def _verticals(observed: Sequence[Observed], settings: ImportStage) -> FloatArray | None:
    """(R, 3) vertical of each recording in the frame of the body; None if unknown, refused if far from gravity."""
    up = vertical(settings.data.up)
    if up is None:
        return None
    verticals = np.stack([x.registration.transform.rotation @ up for x in observed])
    configured = np.asarray(settings.gravity, dtype=np.float64)
    for trial, measured in zip(observed, verticals, strict=True):
        if configured.any() and _angle(measured, -configured) > _LARGEST_LEAN:
            down = ", ".join(f"{-x:.2f}" for x in measured)
            raise InputError(
                f"{trial.raw.source}: with data.up {settings.data.up}, gravity points along ({down}) in the "
                f"frame of the body, {_angle(measured, -configured):.0f} degrees from the configured one: set data.up "
                "to the vertical of the recordings, or gravity to its direction in the frame of markers and mesh."
            )
    return verticals


def _gravity(verticals: FloatArray | None, settings: ImportStage) -> FloatArray:
    """(3,) measured direction of gravity in the frame of the body, with the configured strength [m/s^2]."""
    configured = np.asarray(settings.gravity, dtype=np.float64)
    if verticals is None:
        return configured
    mean = verticals.mean(axis=0)
    return np.asarray(-np.linalg.norm(configured) * mean / np.linalg.norm(mean))


def _angle(a: FloatArray, b: FloatArray) -> float:
    """Angle between two vectors [degrees]."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def _write_quality(
    context: StageContext,
    observed: Sequence[Observed],
    tracked: Sequence[str],
    shifts: FloatArray,
    verticals: FloatArray | None,
    gravity: FloatArray,
    mountings: Mapping[str, Any],
) -> None:
    """Writes quality.json and registration.json for all released trials and a few driven trials."""
    settings: ImportStage = context.settings
    reference, gap = list(settings.markers.reference), settings.data.longest_gap
    driven = [row for row, x in enumerate(observed) if not x.settings.is_released]
    shown = evenly(driven, _SHOWN) if driven else []
    qualities, registrations = {}, {}
    for row, trial in enumerate(observed):
        if row in driven and row not in shown:
            continue
        name = trial.settings.name
        labels = trial.raw.labels
        raw = replace(trial.raw, labels=owners(labels), positions=as_markers(trial.raw.positions, labels))
        measured = quality(raw, reference if trial.base is None else [], trial.release, longest_gap=gap)
        qualities[name] = asdict(measured)
        if trial.settings.is_released:
            for warning in measured.warnings:
                log.warning("%s: %s", measured.source.name, warning)
        elif measured.warnings:
            remarks = number_of(len(measured.warnings), "remark")
            log.info("import: %s: %s on its quality in the report", measured.source.name, remarks)
        # Residuals of the tracked markers of a loaded body do not concern the registration.
        fitted = [*settings.markers.tracked, *reference] if trial.shows_places else reference
        moved = {tracked[n]: -shifts[row, n] for n in trial.columns if tracked[n] in settings.markers.tracked}
        registrations[name] = _summary(trial.registration, moved, fitted)
        if mountings[name]:
            registrations[name]["mounting"] = mountings[name]
        if verticals is not None:
            registrations[name]["vertical_deg"] = _angle(verticals[row], -gravity)
    write_json(context.run_dir / QUALITY, qualities)
    write_json(context.run_dir / REGISTRATION, registrations)


def _summary(registration: Registration, shifts: Mapping[str, FloatArray], only: Sequence[str]) -> dict[str, Any]:
    """Entry of registration.json; lengths are in millimetres, except positions in the frame of the body in metres.

    Positions and residuals are those of ``only`` some markers, whose places are known.
    """
    rows = [row for row, name in enumerate(registration.names) if name in only]
    names = [registration.names[row] for row in rows]
    return {
        "positions": dict(zip(names, registration.positions[rows].tolist(), strict=True)),
        "rms_mm": _MILLI * registration.rms,
        "residual_mm": dict(zip(names, _MILLI * registration.residual[rows], strict=True)),
        "outliers": list(registration.outliers),
        "shift_mm": {label: (_MILLI * shift).tolist() for label, shift in shifts.items()},
    }
