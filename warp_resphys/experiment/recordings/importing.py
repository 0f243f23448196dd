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

from ...data.base_motion import at_times, check_steps
from ...data.input_response import NO_INPUT
from ...data.recordings.processing import smooth
from ...data.recordings.quality import quality
from ...data.registration import root_mean_square
from ...data.rigid_bodies import angles, as_markers, corners_of, motion_between, owners
from ...io.arrays import FloatArray
from ...io.errors import DataFileError, InputError, number_of
from ...io.files import write_json
from ...io.stages import StageContext
from ...settings.stages import StageSettings
from ..build import bound_markers
from ..files import DATASET, QUALITY, REGISTRATION, RESTING, SCALED_DATASET, SLACK, UNDER_INPUTS, Dataset, read_dataset
from ..trials import evenly
from .observing import Observed, Observer
from .reading import vertical

log = logging.getLogger(__name__)

_LARGEST_LEAN = 30.0  # degrees between the vertical of a recording and the configured gravity
_SHOWN = 6  # driven trials whose quality and registration are reported
_MILLI = 1e3


def import_recordings(context: StageContext) -> None:
    """Writes dataset.h5, quality.json and registration.json.

    Raises:
        DataFileError: a recording cannot be read or used; the message names the file and the marker.
        InputError: a configured value is invalid.
    """
    observer, settings = Observer(context), context.settings
    observed = observer.observe(settings.trials)
    drive, limit = observer.drive, settings.data.input_limit
    driven = [x.driven for x in observed if x.driven is not None]
    if drive is not None and limit is not None and any(len(inputs) > 1 for inputs in driven):
        highest = max(float(np.abs(inputs).max()) for inputs in driven)
        if highest < NO_INPUT * limit:  # as in a wrong unit
            raise DataFileError(
                f"the {drive.quantity.plural} of all {len(driven)} recordings stay below {highest:.3g} "
                f"{drive.quantity.unit}, and data.input_limit is {limit:.3g} {drive.quantity.unit}: give their unit in "
                "the files (actuation_units, or the header of the column), or set the limit to the robot's maximum."
            )
    if text := sessions_text({x.settings.name: x.raw.rate for x in observed}, [x.settings.session for x in observed]):
        log.warning("import: %s", text)
    training = [x.settings.name for x in observed] if settings.learned is None else settings.learned
    offsets = _offsets(observer, observed)
    bound = _bound(observer, observed, offsets, training)
    bound_markers(observer.markers, observer.simulator.body.mesh, bound, observer.tracked)  # Refuses a far marker.
    mountings = _mountings(observer, observed, bound, offsets, training)
    verticals, gravity = _verticals(observed, settings)
    shifts = _shifts(observer, observed, bound, offsets)
    _dataset(observer, observed, bound, shifts, gravity).write(context.run_dir / DATASET)
    _write_quality(context, observer, observed, shifts, verticals, gravity, mountings)


def import_scaled(context: StageContext) -> None:
    """Writes dataset_scaled.h5 with the trials at scaled inputs, and the marker places of dataset.h5.

    Raises:
        DataFileError: a recording cannot be read or used.
    """
    observer, dataset = Observer(context), read_dataset(context.run_dir / DATASET)
    assert dataset.bound is not None
    observed = observer.observe(context.settings.trials)
    shifts = _shifts(observer, observed, dataset.bound, _offsets(observer, observed))
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


def _offsets(observer: Observer, observed: Sequence[Observed]) -> FloatArray:
    """(R, M, 3) observed minus expected places of tracked markers in the frame of the body [m], NaN if not seen.

    Those of rigid bodies are turned back with their part, so that they are places on the undeformed body.
    """
    offsets = np.full((len(observed), *observer.nominal.shape), np.nan)
    for offset, trial in zip(offsets, observed, strict=True):
        offset[trial.columns] = trial.places - observer.expected(trial.settings)[: len(trial.columns)]
        offset[:] = np.einsum("mij,mi->mj", observer.turned(trial.settings), offset)
    return offsets


def _bound(
    observer: Observer, observed: Sequence[Observed], offsets: FloatArray, training: Container[str]
) -> FloatArray:
    """(M, 3) places of markers: nominal ones with their mean offsets; of rigid bodies, as their poses at rest [m].

    Test trials are used only for markers that no training trial has.

    Raises:
        InputError: no trial shows a rigid body at rest.
    """
    bound = observer.nominal.copy()
    shows_places = np.array([x.shows_places for x in observed])
    learned = np.array([x.settings.name in training for x in observed])
    for marker, seen in enumerate(np.isfinite(offsets).all(axis=2).T & shows_places):
        if seen.any():
            bound[marker] += offsets[seen & learned if (seen & learned).any() else seen, marker].mean(axis=0)
    for name, own in corners_of(observer.tracked).items():
        if not any(x.shows_places and x.settings.has(name) for x in observed):
            raise InputError(
                f"markers.rigid_bodies.{name}: its mounting on the body is unknown, as no trial shows it while the "
                "body is undeformed or at rest under its own weight alone: add such a trial, as a pose or a motion."
            )
        bound[own] = motion_between(observer.nominal[own], bound[own]).apply(observer.nominal[own])
    return bound


def _mountings(
    observer: Observer, observed: Sequence[Observed], bound: FloatArray, offsets: FloatArray, training: Container[str]
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
    if observer.data.alignment == "shared":
        return np.zeros_like(offsets)
    shows_places = np.array([x.shows_places for x in observed])
    turned = np.stack([observer.turned(x.settings) for x in observed])
    shifts = np.einsum("rmij,rmj->rmi", turned, bound - observer.nominal - offsets)
    return np.where(shows_places[:, None, None], shifts, 0.0)


def _verticals(observed: Sequence[Observed], settings: StageSettings) -> tuple[FloatArray | None, FloatArray]:
    """Returns the (R, 3) vertical of each recording in the frame of the body, and (3,) gravity there [m/s^2].

    Gravity has the mean of their directions, and the configured strength. Where the vertical is unknown, gravity is the
    configured one.

    Raises:
        InputError: a vertical is far from that of the configured gravity.
    """
    up, configured = vertical(settings.data.up), np.asarray(settings.gravity, dtype=np.float64)
    if up is None:
        return None, configured
    verticals = np.stack([x.registration.transform.rotation @ up for x in observed])
    for trial, measured in zip(observed, verticals, strict=True):
        if configured.any() and _angle(measured, -configured) > _LARGEST_LEAN:
            down = ", ".join(f"{-x:.2f}" for x in measured)
            raise InputError(
                f"{trial.raw.source}: with data.up {settings.data.up}, gravity points along ({down}) in the "
                f"frame of the body, {_angle(measured, -configured):.0f} degrees from the configured one: set data.up "
                "to the vertical of the recordings, or gravity to its direction in the frame of markers and mesh."
            )
    mean = verticals.mean(axis=0)
    return verticals, -np.linalg.norm(configured) * mean / np.linalg.norm(mean)


def _angle(a: FloatArray, b: FloatArray) -> float:
    """Angle between two vectors [degrees]."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def _dataset(
    observer: Observer, observed: Sequence[Observed], bound: FloatArray, shifts: FloatArray, gravity: FloatArray
) -> Dataset:
    """Makes the dataset in the frame of the body; trials that end early are padded."""
    settings, drive = observer.settings, observer.drive
    cutoff, steps, step = settings.data.cutoff, settings.data.steps, settings.time_step
    frames = max(len(x.moving.positions) if x.settings.is_released else 1 for x in observed)
    resting = [len(x.moving.positions) for x in observed if x.settings.begins in RESTING]
    begins = ["released" if x.settings.is_released else x.settings.begins for x in observed]
    begins = [UNDER_INPUTS if word == SLACK else word for word in begins]
    if resting:
        steps = steps or max(*resting, 2) - 1
        frames = max(frames, steps + 1)
    shape = (len(observed), frames, len(observer.tracked), 3)
    markers, smoothed = np.full(shape, np.nan), np.full(shape, np.nan)
    times, held = np.zeros(shape[:2]), np.full((shape[0], *shape[2:]), np.nan)
    inputs = np.zeros((len(observed), steps or 1, 0 if drive is None else len(drive.parts)))
    short = list[str]()
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
            times[row] = np.minimum(np.arange(frames), steps or 0) * step
            held[row] = np.where(np.isfinite(markers[row, 0]), markers[row, 0], held[row])
        else:
            held[row, has] = bound[has]  # The displacement of a static pose counts from the undeformed body.
        if trial.driven is not None:  # The last inputs are repeated after the end of a trial.
            series = trial.driven if len(trial.driven) == 1 else trial.driven[1 : inputs.shape[1] + 1]
            inputs[row, : len(series)], inputs[row, len(series) :] = series, trial.driven[-1]
            if 1 < len(series) < inputs.shape[1]:
                short.append(f"{trial.raw.source.name}: {len(series)}")
    if short and settings.data.steps is not None:
        log.warning(
            "import: recordings are shorter than the %d steps of data.steps (%s); missing frames are ignored.",
            *(steps, ", ".join(short)),
        )
    driven: dict[str, Any] = {}
    if drive is not None:
        name = drive.quantity.name
        driven = {"inputs": {name: inputs}, "channels": {name: drive.parts}, "units": {name: drive.quantity.unit}}
        if UNDER_INPUTS in begins:
            driven["resting"] = {name: np.array([x.driven[0] for x in observed if x.driven is not None])}
    at_steps = step * np.arange(round(np.ceil(times.max() / step - 1e-6)) + 1)

    def motion_of(what: str, poses: Sequence[FloatArray | None]) -> FloatArray:
        """Returns the motion (R, K + 1, 6) of the base or of an obstacle at the steps of the longest trial."""
        motion, points = np.zeros((len(observed), len(at_steps), 6)), observer.simulator.body.mesh.vertices
        for row, (trial, own) in enumerate(zip(observed, poses, strict=True)):
            if own is not None:
                zero = 0.0 if trial.settings.is_released else trial.moving.start  # of the simulation
                motion[row] = at_times(own, trial.moving.time - zero, at_steps)
                check_steps(motion[row], points, trial.raw.source, what)
        return motion

    obstacles = {
        name: motion_of(f"the obstacle {name!r}", [x.obstacles.get(name) for x in observed])
        for name in dict.fromkeys(name for x in observed for name in x.obstacles)
    }
    sessions = tuple(x.settings.session or "" for x in observed)
    return Dataset(
        names=tuple(x.settings.name for x in observed),
        labels=tuple(observer.tracked),
        begins=tuple(begins),
        times=times,
        observed=markers,
        held=held,
        payload=np.array([x.settings.payload for x in observed]),
        gravity=gravity,
        time_step=step,
        bound=bound,
        smoothed=smoothed if cutoff is not None or {*begins} <= {*RESTING} else None,
        base=motion_of("the base", [x.base for x in observed]) if any(x.base is not None for x in observed) else None,
        obstacles=obstacles,
        sessions=sessions if any(sessions) else (),
        **driven,
    )


def _write_quality(
    context: StageContext,
    observer: Observer,
    observed: Sequence[Observed],
    shifts: FloatArray,
    verticals: FloatArray | None,
    gravity: FloatArray,
    mountings: Mapping[str, Any],
) -> None:
    """Writes quality.json and registration.json for all released trials and a few driven trials.

    Lengths are in millimetres, except positions in the frame of the body in metres.
    """
    settings, tracked = observer.settings, observer.tracked
    assert settings.markers is not None
    reference, gap = list(settings.markers.reference), settings.data.longest_gap
    driven = [row for row, x in enumerate(observed) if not x.settings.is_released]
    shown = evenly(driven, _SHOWN) if driven else []
    qualities, registrations = {}, {}
    for row, trial in enumerate(observed):
        if row in driven and row not in shown:
            continue
        name, labels, fit = trial.settings.name, trial.raw.labels, trial.registration
        raw = replace(trial.raw, labels=owners(labels), positions=as_markers(trial.raw.positions, labels))
        measured = quality(raw, reference if trial.base is None else [], trial.release, longest_gap=gap)
        qualities[name] = asdict(measured)
        if trial.settings.is_released:
            for warning in measured.warnings:
                log.warning("%s: %s", measured.source.name, warning)
        elif measured.warnings:
            remarks = number_of(len(measured.warnings), "remark")
            log.info("import: %s: %s on its quality in the report", measured.source.name, remarks)
        # Places of the tracked markers of a loaded body are not known, and do not concern the registration.
        known = [*settings.markers.tracked, *reference] if trial.shows_places else reference
        rows = [row for row, label in enumerate(fit.names) if label in known]
        names = [fit.names[row] for row in rows]
        moved = {tracked[n]: -_MILLI * shifts[row, n] for n in trial.columns if tracked[n] in settings.markers.tracked}
        registrations[name] = {
            "positions": dict(zip(names, fit.positions[rows].tolist(), strict=True)),
            "rms_mm": _MILLI * fit.rms,
            "residual_mm": dict(zip(names, _MILLI * fit.residual[rows], strict=True)),
            "outliers": list(fit.outliers),
            "shift_mm": {label: shift.tolist() for label, shift in moved.items()},
            **({"mounting": mountings[name]} if mountings[name] else {}),
            **({} if verticals is None else {"vertical_deg": _angle(verticals[row], -gravity)}),
        }
    write_json(context.run_dir / QUALITY, qualities)
    write_json(context.run_dir / REGISTRATION, registrations)
