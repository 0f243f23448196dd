"""Stage: imports recordings as markers in the frame of the body and inputs, from time zero on.

Time zero is the release of a held body, or the first frame of a body that rests until its inputs
begin. Released bodies keep the times of their frames, at which simulations are interpolated, so
that the frame rate need not match the time step. Driven bodies are resampled to the time steps,
during which inputs are constant.
"""

import logging
from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import chain
from typing import Any

import numpy as np

from ...data.base_motion import at_times, check_steps
from ...data.force_sensors import AXES, UNITS
from ...data.input_response import NO_INPUT
from ...data.recordings.marker_quality import Quality, quality
from ...data.recordings.processing import smooth
from ...data.registration import RegistrationSummary, root_mean_square, unit_vector
from ...data.rigid_bodies import angles, as_markers, corners_of, motion_between, owners
from ...data.trials import RESTING, SLACK, UNDER_INPUTS, Trials, evenly
from ...io.arrays import FloatArray
from ...io.errors import DataFileError, InputError, number_of
from ...io.resuming import StageContext
from ...io.safe_files import write_json
from ..build import bound_markers
from ..files import DATASET, QUALITY, REGISTRATION, SCALED_DATASET
from .registered_trials import RegisteredTrials

log = logging.getLogger(__name__)

_LARGEST_LEAN = 30.0  # degrees between the vertical of a recording and the configured gravity
_SHOWN = 6  # driven trials whose quality and registration are reported
_MILLI = 1e3


def import_recordings(context: StageContext) -> None:
    """Writes dataset.h5, quality.json and registration.json.

    Raises:
        DataFileError: a recording cannot be read or used; the message names the file and the
            marker.
        InputError: a configured value is invalid.
    """
    recorded = RegisteredTrials(context.settings, context.run_dir)
    _check_input_unit(recorded)
    names = [trial.name for trial in recorded.trials]
    sessions = [trial.session for trial in recorded.trials]
    text = sessions_text(
        {n: r.rate for n, r in zip(names, recorded.measured, strict=True)}, sessions
    )
    if text:
        log.warning("import: %s", text)
    training = names if context.settings.learned is None else context.settings.learned
    offsets = _offsets(recorded)
    bound = _bound(recorded, offsets, training)
    # Refuses a far marker.
    bound_markers(recorded.markers, recorded.body.mesh, bound, recorded.tracked)
    mountings = _mountings(recorded, bound, offsets, training)
    verticals, gravity = _verticals(recorded)
    shifts = _shifts(recorded, bound, offsets)
    _dataset(recorded, bound, shifts, gravity).write(context.run_dir / DATASET)
    driven = [row for row, trial in enumerate(recorded.trials) if not trial.is_released]
    hidden = {*driven} - {*(evenly(driven, _SHOWN) if driven else [])}
    shown = {name: row for row, name in enumerate(names) if row not in hidden}
    write_json(
        context.run_dir / QUALITY,
        {name: asdict(_quality(recorded, row)) for name, row in shown.items()},
    )
    registrations = {name: _registration(recorded, row, shifts[row]) for name, row in shown.items()}
    for name, row in shown.items():
        if mountings[name]:
            registrations[name]["mounting"] = mountings[name]
        if verticals is not None:
            registrations[name]["vertical_deg"] = _angle(verticals[row], -gravity)
    write_json(context.run_dir / REGISTRATION, registrations)


def import_scaled(context: StageContext) -> None:
    """Writes dataset_scaled.h5 with trials at scaled inputs, and the marker places of dataset.h5.

    Raises:
        DataFileError: a recording cannot be read or used.
    """
    recorded = RegisteredTrials(context.settings, context.run_dir)
    trials = Trials.read(context.run_dir / DATASET)
    assert trials.bound is not None
    shifts = _shifts(recorded, trials.bound, _offsets(recorded))
    _dataset(recorded, trials.bound, shifts, trials.gravity).write(context.run_dir / SCALED_DATASET)


def _check_input_unit(recorded: RegisteredTrials) -> None:
    """Refuses inputs that are so much below the limit that their unit must be wrong."""
    drive, limit = recorded.drive, recorded.data.input_limit
    driven = [moving.actuation for moving in recorded.moving if moving.actuation is not None]
    if drive is None or limit is None or not any(len(inputs) > 1 for inputs in driven):
        return
    highest = max(float(np.abs(inputs).max()) for inputs in driven)
    if highest < NO_INPUT * limit:
        raise DataFileError(
            f"the {drive.quantity.plural} of all {len(driven)} recordings stay below "
            f"{highest:.3g} {drive.quantity.unit}, and data.input_limit is {limit:.3g} "
            f"{drive.quantity.unit}: give their unit in the files (actuation_units, or the "
            "header of the column), or set the limit to the robot's maximum."
        )


def sessions_text(rates: Mapping[str, float], sessions: Sequence[str | None]) -> str:
    """Returns a sentence on recordings that look like several sessions.

    Empty if they do not, or if one is named.

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
        f"the recordings have different frame rates, as those of different sessions ({listed}): "
        "name them with data.trials.NAME.session, so that markers may have other places in each."
    )


def _offsets(recorded: RegisteredTrials) -> FloatArray:
    """(R, M, 3) observed minus expected places of tracked markers
    in the frame of the body [m], NaN if not seen.

    Those of rigid bodies are turned back with their part, so that they are places on the undeformed
    body.
    """
    offsets = np.full((len(recorded.trials), *recorded.nominal.shape), np.nan)
    for offset, trial, registration in zip(
        offsets, recorded.trials, recorded.registrations, strict=True
    ):
        has = trial.tracked(recorded.tracked)
        places = recorded.view(trial).of_arrays(registration.positions[: len(has)])
        offset[has] = places - recorded.expected(trial)[: len(has)]
        offset[:] = np.einsum("mij,mi->mj", recorded.turned(trial), offset)
    return offsets


def _bound(recorded: RegisteredTrials, offsets: FloatArray, training: Container[str]) -> FloatArray:
    """(M, 3) places of markers: nominal ones with their mean offsets.

    Of rigid bodies, as their poses at rest [m].

    Test trials are used only for markers that no training trial has.

    Raises:
        InputError: no trial shows a rigid body at rest.
    """
    bound, shows = recorded.nominal.copy(), np.array(recorded.shows_places)
    learned = np.array([trial.name in training for trial in recorded.trials])
    for marker, seen in enumerate(np.isfinite(offsets).all(axis=2).T & shows):
        if seen.any():
            bound[marker] += offsets[
                seen & learned if (seen & learned).any() else seen, marker
            ].mean(axis=0)
    for name, corners in corners_of(recorded.tracked).items():
        if not any(shows[row] and trial.has(name) for row, trial in enumerate(recorded.trials)):
            raise InputError(
                f"markers.rigid_bodies.{name}: its mounting on the body is unknown, as no trial "
                "shows it while the body is undeformed or at rest under its own weight alone: "
                "add such a trial, as a pose or a motion."
            )
        nominal = recorded.nominal[corners]
        bound[corners] = motion_between(nominal, bound[corners]).apply(nominal)
    return bound


def _mountings(
    recorded: RegisteredTrials, bound: FloatArray, offsets: FloatArray, training: Container[str]
) -> dict[str, dict[str, dict[str, float]]]:
    """Distance [mm] and angle [degrees] of the mountings of rigid bodies
    in each trial from those of all, by trial.

    Raises:
        InputError: a rigid body was remounted between two trials.
    """
    trials = recorded.trials
    mountings: dict[str, dict[str, dict[str, float]]] = {trial.name: {} for trial in trials}
    for name, corners in corners_of(recorded.tracked).items():
        shown = [
            row
            for row, trial in enumerate(trials)
            if recorded.shows_places[row] and trial.has(name)
        ]
        nominal = recorded.nominal[corners]
        places = recorded.nominal[corners] + offsets[shown][:, corners]
        away = _MILLI * np.linalg.norm(places.mean(axis=1) - bound[corners].mean(axis=0), axis=-1)
        turned = np.degrees(angles(bound[corners], places))
        first = next((at for at, row in enumerate(shown) if trials[row].name in training), 0)
        apart = [root_mean_square(points - places[first]) for points in places]
        if max(apart) > recorded.markers.largest_residual:
            worst = int(np.argmax(apart))
            source, other = (recorded.measured[shown[at]].source for at in (worst, first))
            moved = _MILLI * np.linalg.norm((places[worst] - places[first]).mean(axis=0))
            raise InputError(
                f"{source}: {name!r} is {moved:.1f} mm and "
                f"{np.degrees(angles(places[first], places[worst])):.1f} degrees from its "
                f"mounting in {other.name}: where it was remounted, give it another name in "
                "data.trials.NAME.labels and in markers.rigid_bodies."
            )
        for row, distance, angle in zip(shown, away, turned, strict=True):
            mountings[trials[row].name][name] = {"distance_mm": distance, "angle_deg": angle}
        log.info(
            "import: %s is mounted %.1f mm from the centre of what carries it, turned by %.1f "
            "degrees; the trials differ from this by up to %.2f mm and %.2f degrees",
            name,
            _MILLI * np.linalg.norm(np.mean(bound[corners] - nominal, axis=0)),
            np.degrees(angles(nominal, bound[corners])),
            away.max(),
            turned.max(),
        )
    return mountings


def _shifts(recorded: RegisteredTrials, bound: FloatArray, offsets: FloatArray) -> FloatArray:
    """(R, M, 3) shifts that move the markers of each trial to their places [m].

    Zero if alignment is shared.
    """
    if recorded.data.alignment == "shared":
        return np.zeros_like(offsets)
    turned = np.stack([recorded.turned(trial) for trial in recorded.trials])
    shifts = np.einsum("rmij,rmj->rmi", turned, bound - recorded.nominal - offsets)
    return np.where(np.array(recorded.shows_places)[:, None, None], shifts, 0.0)


def _verticals(recorded: RegisteredTrials) -> tuple[FloatArray | None, FloatArray]:
    """Returns the (R, 3) vertical of each recording in the frame of the body,
    and (3,) gravity there [m/s^2].

    Gravity has the mean of their directions, and the configured strength. Where the vertical is
    unknown, gravity is the configured one.

    Raises:
        InputError: a vertical is far from that of the configured gravity.
    """
    up, configured = recorded.data.up, np.asarray(recorded.settings.gravity, dtype=np.float64)
    if up is None:
        return None, configured
    verticals = np.stack(
        [fit.transform.rotation @ unit_vector(up) for fit in recorded.registrations]
    )
    for recording, measured in zip(recorded.measured, verticals, strict=True):
        if configured.any() and _angle(measured, -configured) > _LARGEST_LEAN:
            down = ", ".join(f"{-x:.2f}" for x in measured)
            raise InputError(
                f"{recording.source}: with data.up {up}, gravity points along ({down}) in the "
                f"frame of the body, {_angle(measured, -configured):.0f} degrees from the "
                "configured one: set data.up to the vertical of the recordings, or gravity to "
                "its direction in the frame of markers and mesh."
            )
    mean = verticals.mean(axis=0)
    return verticals, -np.linalg.norm(configured) * mean / np.linalg.norm(mean)


def _angle(a: FloatArray, b: FloatArray) -> float:
    """Angle between two vectors [degrees]."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def _dataset(
    recorded: RegisteredTrials, bound: FloatArray, shifts: FloatArray, gravity: FloatArray
) -> Trials:
    """Makes the dataset in the frame of the body; trials that end early are padded."""
    trials, settings = recorded.trials, recorded.settings
    begins = ["released" if trial.is_released else trial.begins for trial in trials]
    begins = [UNDER_INPUTS if word == SLACK else word for word in begins]
    resting = [
        len(r.positions) for r, word in zip(recorded.moving, begins, strict=True) if word in RESTING
    ]
    steps = settings.data.steps
    if resting:
        steps = steps or max(*resting, 2) - 1
    times, observed, smoothed, held = _series(
        recorded, bound, shifts, steps, steps + 1 if resting and steps else 1
    )
    at_steps = settings.time_step * np.arange(
        round(np.ceil(times.max() / settings.time_step - 1e-6)) + 1
    )
    moved = any(r.base is not None for r in recorded.moving)
    driven = dict[str, Any]()
    drive = recorded.drive
    if drive is not None:
        name = drive.quantity.name
        inputs = _inputs(recorded, steps or 1, len(drive.parts))
        driven = {
            "inputs": {name: inputs},
            "channels": {name: drive.parts},
            "units": {name: drive.quantity.unit},
        }
        if UNDER_INPUTS in begins:
            first = [r.actuation[0] for r in recorded.moving if r.actuation is not None]
            driven["resting"] = {name: np.array(first)}
    obstacles = {}
    for name in dict.fromkeys(chain.from_iterable(r.obstacles for r in recorded.moving)):
        poses = [r.obstacles.get(name) for r in recorded.moving]
        obstacles[name] = _motion(recorded, f"the obstacle {name!r}", poses, at_steps)
    sessions = tuple(trial.session or "" for trial in trials)
    return Trials(
        names=tuple(trial.name for trial in trials),
        labels=tuple(recorded.tracked),
        begins=tuple(begins),
        times=times,
        observed=observed,
        held=held,
        payload=np.array([trial.payload for trial in trials]),
        gravity=gravity,
        time_step=settings.time_step,
        bound=bound,
        smoothed=smoothed if recorded.data.cutoff is not None or {*begins} <= {*RESTING} else None,
        base=_motion(recorded, "the base", [r.base for r in recorded.moving], at_steps)
        if moved
        else None,
        obstacles=obstacles,
        sessions=sessions if any(sessions) else (),
        loads=_loads(recorded, times.shape[1]),
        **driven,
    )


def _loads(recorded: RegisteredTrials, frames: int) -> dict[str, FloatArray]:
    """(R, T, 6) readings of each force sensor at the frames [N, N m], NaN where there is none.

    Raises:
        DataFileError: no recording has readings of a sensor, or of one of its axes.
    """
    found = dict[str, FloatArray]()
    for name, sensor in recorded.settings.sensors.items():
        found[name] = np.full((len(recorded.moving), frames, len(AXES)), np.nan)
        for row, moving in enumerate(recorded.moving):
            if name in moving.loads:
                read = moving.loads[name][:frames]
                found[name][row, : len(read)] = read
        for axis in sensor.axes:
            if not np.isfinite(found[name][..., AXES.index(axis)]).any():
                raise DataFileError(
                    f"sensors.{name} measures {axis}, but no recording has it: name its column "
                    f"'{name}.{axis} [{UNITS[axis]}]' (docs/recordings.md), or take it out of "
                    f"sensors.{name}.axes."
                )
    return found


def _series(
    recorded: RegisteredTrials, bound: FloatArray, shifts: FloatArray, steps: int | None, least: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Returns times (R, T) [s], positions and smoothed ones (R, T, M, 3),
    and those before time zero (R, M, 3) [m].

    Args:
        recorded: the trials.
        bound: (M, 3) places of markers [m].
        shifts: (R, M, 3), see `_shifts`.
        steps: time steps of driven trials; None without such trials.
        least: least number T of frames.
    """
    trials = recorded.trials
    cutoff = recorded.data.cutoff
    lengths = [
        len(moving.positions) if t.is_released else 1
        for t, moving in zip(trials, recorded.moving, strict=True)
    ]
    frames = max(*lengths, least)
    shape = (len(trials), frames, len(recorded.tracked), 3)
    observed, smoothed = np.full(shape, np.nan), np.full(shape, np.nan)
    times, held = np.zeros(shape[:2]), np.full((shape[0], *shape[2:]), np.nan)
    for row, (trial, moving) in enumerate(zip(trials, recorded.moving, strict=True)):
        limit = frames if trial.is_released or steps is None else steps + 1
        seen = moving.positions[:limit]
        slow = moving if cutoff is None or len(seen) == 1 else smooth(moving, cutoff)
        has = trial.tracked(recorded.tracked)
        for series, positions in ((observed, seen), (smoothed, slow.positions[:limit])):
            series[row, : len(seen), has] = recorded.to_body(
                row, positions, shifts[row, has]
            ).swapaxes(0, 1)
        held[row, has] = recorded.to_body(row, recorded.rests[row][: len(has)], shifts[row, has])
        if trial.is_released:
            times[row] = np.pad(moving.time, (0, frames - len(seen)), mode="edge")
        elif trial.begins in RESTING:
            times[row] = np.minimum(np.arange(frames), steps or 0) * recorded.settings.time_step
            held[row] = np.where(np.isfinite(observed[row, 0]), observed[row, 0], held[row])
        else:
            # The displacement of a static pose counts from the undeformed body.
            held[row, has] = bound[has]
    return times, observed, smoothed, held


def _inputs(recorded: RegisteredTrials, steps: int, parts: int) -> FloatArray:
    """(R, K, C) inputs of the trials during the steps.

    The last ones are repeated after the end of a trial.
    """
    inputs, short = np.zeros((len(recorded.trials), steps, parts)), list[str]()
    for row, moving in enumerate(recorded.moving):
        if moving.actuation is None:
            continue
        series = moving.actuation if len(moving.actuation) == 1 else moving.actuation[1 : steps + 1]
        inputs[row, : len(series)], inputs[row, len(series) :] = series, moving.actuation[-1]
        if 1 < len(series) < steps:
            short.append(f"{moving.source.name}: {len(series)}")
    if short and recorded.data.steps is not None:
        log.warning(
            "import: recordings are shorter than the %d steps of data.steps (%s); "
            "missing frames are ignored.",
            steps,
            ", ".join(short),
        )
    return inputs


def _motion(
    recorded: RegisteredTrials, what: str, poses: Sequence[FloatArray | None], at_steps: FloatArray
) -> FloatArray:
    """(R, K + 1, 6) motion of the base or of an obstacle at the steps (K + 1,),
    from the poses at the frames.
    """
    motion, points = np.zeros((len(poses), len(at_steps), 6)), recorded.body.mesh.vertices
    for row, (trial, moving, at_frames) in enumerate(
        zip(recorded.trials, recorded.moving, poses, strict=True)
    ):
        if at_frames is not None:
            zero = 0.0 if trial.is_released else moving.start  # of the simulation
            motion[row] = at_times(at_frames, moving.time - zero, at_steps)
            check_steps(motion[row], points, moving.source, what)
    return motion


def _quality(recorded: RegisteredTrials, row: int) -> Quality:
    """Quality of a trial; its warnings are logged for released trials."""
    measured, trial = recorded.measured[row], recorded.trials[row]
    still = [*recorded.markers.reference] if recorded.moving[row].base is None else []
    positions = as_markers(measured.positions, measured.labels)
    shown = replace(measured, labels=owners(measured.labels), positions=positions)
    found = quality(shown, still, recorded.releases[row], longest_gap=recorded.data.longest_gap)
    if trial.is_released:
        for warning in found.warnings:
            log.warning("%s: %s", found.source.name, warning)
    elif found.warnings:
        remarks = number_of(len(found.warnings), "remark")
        log.info("import: %s: %s on its quality in the report", found.source.name, remarks)
    return found


def _registration(recorded: RegisteredTrials, row: int, shifts: FloatArray) -> RegistrationSummary:
    """Content of registration.json on a trial, in millimetres
    but for positions in the frame of the body [m].
    """
    markers = recorded.markers
    fit = recorded.registrations[row]
    tracked = recorded.tracked
    # Places of the tracked markers of a loaded body are not known, and do not concern the
    # registration.
    known = [*markers.reference, *(markers.tracked if recorded.shows_places[row] else [])]
    rows = [number for number, label in enumerate(fit.names) if label in known]
    names, has = [fit.names[number] for number in rows], recorded.trials[row].tracked(tracked)
    return {
        "positions": dict(zip(names, fit.positions[rows].tolist(), strict=True)),
        "rms_mm": _MILLI * fit.rms,
        "residual_mm": dict(zip(names, _MILLI * fit.residual[rows], strict=True)),
        "outliers": list(fit.outliers),
        "shift_mm": {
            tracked[n]: (-_MILLI * shifts[n]).tolist() for n in has if tracked[n] in markers.tracked
        },
    }
