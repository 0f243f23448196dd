"""Stage: from recordings to markers in the frame of the body and pressures in its chambers, at the steps."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...data.actuation import check_pressures
from ...data.recordings.processing import fill_gaps, resample, smooth
from ...data.recordings.quality import check_base, check_motion, quality
from ...data.recordings.reading import read_recording
from ...data.recordings.recording import Recording, listed
from ...data.recordings.valve import valve_opening
from ...data.registration import Registration, register_markers
from ...dynamics.simulator import Simulator
from ...io.errors import DataFileError
from ...io.files import atomic_hdf5, create, write_json
from ...io.stages import StageContext
from ..binding import bound_markers
from ..build import build_simulator, chambers_of
from ..measured.files import QUALITY, REGISTRATION
from ..measured.importing import registration_summary
from ..trajectories import evenly
from .files import MOTIONS, RAISED_MOTIONS, read_imported
from .trials import Trial, is_synthetic, raised_trials_of, trials_of

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

_MILLI = 1e3
_REST_PRESSURE = 0.01  # of the limit: less is what a gauge shows of none
_SHOWN = 6  # trials whose quality and registration are kept for the report


@dataclass(frozen=True)
class Observed:
    """A trial as it was recorded, at the steps of the simulation.

    Attributes:
        trial: its name.
        recording: the configured markers, the followed ones first, short gaps filled.
        raw: the same as measured.
        pressure: (T, C) in the chambers of the body at the frames [Pa].
        rest: (M, 3) where its markers were before the pressure came, in the frame of the recording [m].
        registration: of these.
    """

    trial: Trial
    recording: Recording
    raw: Recording
    pressure: FloatArray
    rest: FloatArray
    registration: Registration


def import_driven(context: StageContext) -> None:
    """Writes motions.h5, quality.json and registration.json.

    Raises:
        DataFileError: a recording that cannot be read or used; the sentence names the file and the marker.
        InputError: a configured value that does not fit.
    """
    settings = context.settings
    simulator, followed = build_simulator(settings), list(settings["markers"]["followed"])
    nominal, hanging = _hanging(settings, simulator)
    observed = _observe_all(trials_of(settings), context, simulator, hanging)
    _check_unit([each.pressure for each in observed], settings["data"]["pressure_limit"])
    places = _resting_places(observed, followed)
    known = len(settings["split"]["train"]) + len(settings["split"]["validation"])  # which come first
    mean = np.nanmean(places[:known], axis=0)
    bound = nominal + (mean - hanging[: len(followed)])
    bound_markers(settings["markers"], simulator.body.mesh, bound, followed)  # Refuses a marker that is far off.
    shifts = _shifts(settings, mean, places)
    _write_motions(context, MOTIONS, observed, bound, shifts, simulator)
    _write_quality(context, observed, followed, -shifts)


def import_raised(context: StageContext) -> None:
    """Writes motions_raised.h5, of the trials at higher pressures; markers sit where they sit in motions.h5.

    Raises:
        DataFileError: a recording that cannot be read or used.
    """
    settings = context.settings
    simulator, followed = build_simulator(settings), list(settings["markers"]["followed"])
    bound = read_imported(context.run_dir / MOTIONS).bound
    nominal, hanging = _hanging(settings, simulator)
    observed = _observe_all(raised_trials_of(settings), context, simulator, hanging)
    mean = hanging[: len(followed)] + (bound - nominal)
    shifts = _shifts(settings, mean, _resting_places(observed, followed))
    _write_motions(context, RAISED_MOTIONS, observed, bound, shifts, simulator)


def _hanging(settings: Mapping[str, Any], simulator: Simulator) -> tuple[FloatArray, FloatArray]:
    """(M, 3) nominal places of the followed markers, and (M', 3) where all markers are while the body hangs [m].

    Recordings show the body at rest under gravity; the nominal places are those on the undeformed body.
    """
    markers = settings["markers"]
    nominal, others = (
        np.array([*markers[key].values()], dtype=np.float64).reshape(-1, 3) for key in ("followed", "others")
    )
    read = bound_markers(markers, simulator.body.mesh, nominal, tuple(markers["followed"]))
    moved: FloatArray = read.to(simulator.rest_positions)(simulator.static_equilibrium().q)[0].cpu().numpy()
    return nominal, np.concatenate([moved, others])


def _observe_all(
    trials: Sequence[Trial], context: StageContext, simulator: Simulator, expected: FloatArray
) -> list[Observed]:
    """Reads and registers trials, whose standing markers must not have moved against each other."""
    observed = [_observe(trial, context, simulator, expected) for trial in trials]
    _check_others(observed, context.settings)
    return observed


def _resting_places(observed: Sequence[Observed], followed: Sequence[str]) -> FloatArray:
    """(R, M, 3) where the followed markers of each trial rest, in the frame of the body [m]."""
    return np.stack([each.registration.positions[: len(followed)] for each in observed])


def _shifts(settings: Mapping[str, Any], mean: FloatArray, places: FloatArray) -> FloatArray:
    """(R, M, 3) by which each trial's markers are moved [m]: to where they rest on the whole, if they drift."""
    return mean - places if settings["data"]["rest"] == "own" else np.zeros_like(places)


def _write_motions(
    context: StageContext,
    name: str,
    observed: Sequence[Observed],
    bound: FloatArray,
    shifts: FloatArray,
    simulator: Simulator,
) -> None:
    """Markers and pressures of trials at the steps of the simulation."""
    settings = context.settings
    steps, followed = settings["data"]["steps"], list(settings["markers"]["followed"])
    moving = np.full((len(observed), steps + 1, len(followed), 3), np.nan)
    smoothed = moving.copy()
    pressure = np.zeros((len(observed), steps, len(chambers_of(simulator.body))))
    for row, each in enumerate(observed):
        transform, seen = each.registration.transform, each.recording.select(followed)
        cutoff = settings["data"]["cutoff"]
        for target, source in ((moving, seen), (smoothed, seen if cutoff is None else smooth(seen, cutoff))):
            found = source.positions[: steps + 1]
            target[row, : len(found)] = transform.apply(found.reshape(-1, 3)).reshape(found.shape) + shifts[row]
        series = each.pressure[1 : steps + 1]
        pressure[row, : len(series)] = series
        pressure[row, len(series) :] = each.pressure[-1]
        if len(series) < steps:
            log.warning(
                "import: %s ends after %d of the %d steps of data.steps; the rest counts as not seen.",
                each.recording.source.name,
                len(series),
                steps,
            )
    attributes = {
        "names": [each.trial.name for each in observed],
        "labels": followed,
        "chambers": [chamber.name for chamber in chambers_of(simulator.body)],
        "gravity": settings["gravity"],
        "time_step": settings["time_step"],
    }
    with atomic_hdf5(context.run_dir / name, "motions", attributes) as file:
        create(file, "markers", moving, units="m", time_axis=1)
        create(file, "smoothed", smoothed, units="m", time_axis=1)
        create(file, "pressure", pressure, units="Pa", time_axis=1)
        create(file, "bound", bound, units="m")


def _observe(trial: Trial, context: StageContext, simulator: Simulator, expected: FloatArray) -> Observed:
    """Reads and registers a trial."""
    settings = context.settings
    data, markers = settings["data"], settings["markers"]
    labels = [*markers["followed"], *markers["others"]]
    if is_synthetic(settings) or trial.file is None:
        recording = read_recording(context.run_dir / trial.made)
    else:
        recording = read_recording(trial.file, data["units"], data["rate"])
    recording = resample(recording.select(labels), 1.0 / settings["time_step"], interpolate=True)
    counting = replace(recording, positions=recording.positions[: data["steps"] + 1])
    check_motion(counting, list(markers["followed"]))
    pressure = _pressure(recording, settings, simulator, trial.factor)
    filled = fill_gaps(recording, data["longest_gap"], mask_long=True)
    rest = _rest(filled, pressure, data, list(markers["followed"]))
    registration = register_markers(
        rest, expected, labels, source=recording.source, largest_residual=markers["largest_residual"]
    )
    off = f"; left out: {listed(registration.outliers)}" if registration.outliers else ""
    log.debug("import: %s registered to %.2f mm%s", trial.name, _MILLI * registration.rms, off)
    return Observed(trial, filled, recording, pressure, rest, registration)


def _pressure(recording: Recording, settings: Mapping[str, Any], simulator: Simulator, factor: float) -> FloatArray:
    """(T, C) in the chambers of the body [Pa].

    Raises:
        DataFileError: no pressures, of another number of chambers, or beyond the limit.
    """
    data, chambers = settings["data"], len(chambers_of(simulator.body))
    if recording.actuation is None:
        raise DataFileError(
            f"{recording.source} has no array 'actuation' with the pressures of the chambers: add it "
            "(docs/recordings.md)."
        )
    found = recording.actuation
    if data["chambers"] is not None:
        columns = list(data["chambers"])
        if len(columns) != found.shape[1]:
            raise DataFileError(
                f"{recording.source} has pressures of {found.shape[1]} chambers, but data.chambers names "
                f"{len(columns)}: name the mesh's chamber of each column of the file."
            )
        placed = np.zeros((len(found), chambers))
        placed[:, [int(number) - 1 for number in columns]] = found
        found = placed
    values = check_pressures(found, chambers, factor * data["pressure_limit"], recording.source)
    if data["valve"] == "detected":
        opening = valve_opening(recording, list(settings["markers"]["followed"]))
        values = _from_opening(values, (opening - recording.start) * recording.rate)
    return values


def _check_unit(pressures: Sequence[FloatArray], limit: float) -> None:
    """Refuses recordings under which the body would hardly move, as those do whose unit was mistaken.

    Raises:
        DataFileError: no pressure is near the limit.
    """
    highest = max(float(np.abs(each).max()) for each in pressures)
    if highest < _REST_PRESSURE * limit:
        raise DataFileError(
            f"the pressures of all {len(pressures)} recordings stay below {highest:.3g} Pa, and data.pressure_limit is "
            f"{limit:.3g} Pa: name their unit in the files (actuation_units, or the header of the column), or set the "
            "limit to what the robot takes."
        )


def _from_opening(values: FloatArray, frame: float) -> FloatArray:
    """Commanded pressures from the moment on at which the valve opens; the step in which it does has its share."""
    share = np.clip(np.arange(len(values)) - frame, 0.0, 1.0)
    return np.asarray(values * share[:, None])


def _rest(recording: Recording, pressure: FloatArray, data: Mapping[str, Any], followed: Sequence[str]) -> FloatArray:
    """(M, 3) mean positions of the markers before the pressure comes [m], NaN for one that is not seen."""
    driven = np.flatnonzero(np.abs(pressure).max(axis=1) > _REST_PRESSURE * data["pressure_limit"])
    until = int(driven[0]) if len(driven) else len(pressure)
    count = max(min(until, round(data["rest_seconds"] * recording.rate)), 1)
    if until < 1:
        raise DataFileError(f"{recording.source} begins under pressure: its first frame must show the body at rest.")
    window = recording.positions[:count]
    seen: NDArray[np.bool_] = np.asarray(recording.seen[:count])
    ever = np.any(seen, axis=0)
    hidden = [label for label, ok in zip(recording.labels, ever.tolist(), strict=True) if not ok]
    lost = [label for label in hidden if label in followed]
    if lost:
        raise DataFileError(
            f"{recording.source}: {listed(lost)} cannot be seen while the body rests, so where it sits is not known; "
            "leave it out of markers.followed."
        )
    places = np.full(window.shape[1:], np.nan)
    for column, frames in enumerate(seen.T):
        if frames.any():
            places[column] = window[frames, column].mean(axis=0)
    return places


def _check_others(observed: Sequence[Observed], settings: Mapping[str, Any]) -> None:
    """Refuses recordings whose standing markers moved against each other between trials."""
    markers = settings["markers"]
    if len(markers["others"]) > 1:
        check_base(
            [each.recording for each in observed],
            list(markers["others"]),
            largest_distortion=markers["largest_distortion"],
            largest_shift=markers["largest_shift"],
        )


def _write_quality(
    context: StageContext, observed: list[Observed], followed: Sequence[str], shifts: FloatArray
) -> None:
    """quality.json and registration.json of a few trials."""
    settings = context.settings
    some = evenly([*zip(observed, shifts, strict=True)], _SHOWN)
    gap = settings["data"]["longest_gap"]
    found = {
        each.trial.name: quality(each.raw, list(settings["markers"]["others"]), longest_gap=gap) for each, _ in some
    }
    for each in found.values():
        if each.warnings:
            log.info("import: %s: %d remarks on its quality in the report", each.source.name, len(each.warnings))
    write_json(context.run_dir / QUALITY, {name: each.to_plain() for name, each in found.items()})
    registrations = {each.trial.name: registration_summary(each.registration, followed, shift) for each, shift in some}
    write_json(context.run_dir / REGISTRATION, registrations)
