"""Stage: from recordings to markers in the frame of the body, from the release on.

Frames keep their own times. Losses and errors are taken at them, from the simulation between its steps, so that the
frame rate need not fit the time step.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...data.recordings.processing import fill_gaps, release_of, trim_to_release
from ...data.recordings.quality import check_base, check_motion, check_passive, quality
from ...data.recordings.reading import read_recording
from ...data.recordings.recording import Recording, listed
from ...data.recordings.release import Release
from ...data.registration import Registration, register_markers
from ...io.errors import DataFileError, InputError
from ...io.files import atomic_hdf5, create, write_json
from ...io.stages import StageContext
from ..binding import bound_markers
from ..build import build_mesh
from .files import MARKERS, QUALITY, REGISTRATION, recording_file
from .trials import Trial, is_synthetic, trials_of, vertical

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

_LEAST_RATE = 40.0  # Hz; the first tenth of a second tells how a body was let go, and four frames are few for that
_LARGEST_LEAN = 30.0  # degrees between the vertical of a recording and the configured gravity
_MILLI = 1e3
_START = Release(0.0, (0, 1))  # of a recording that begins with it


@dataclass(frozen=True)
class Observed:
    """A trial as it was recorded.

    Attributes:
        trial: its name and load.
        recording: the configured markers, the followed ones first, as measured.
        release: when the body was let go.
        registration: of its markers on the undeformed body.
        held: (M, 3) where its markers were while it was held, in the frame of the recording [m].
    """

    trial: Trial
    recording: Recording
    release: Release
    registration: Registration
    held: FloatArray


def import_recordings(context: StageContext) -> None:
    """Writes markers.h5, quality.json and registration.json.

    The settings are the groups data, markers, synthetic, mesh and gravity of the configuration.

    Raises:
        DataFileError: a recording that cannot be read or used; the sentence names the file and the marker.
        InputError: a configured value that does not fit.
    """
    settings = context.settings
    markers = settings["markers"]
    observed = observe(settings, context.run_dir)
    followed, labels = list(markers["followed"]), observed[0].registration.names
    columns = [labels.index(label) for label in followed]
    places = np.stack([each.registration.positions[columns] for each in observed])  # (R, M, 3) [m]
    bound = places.mean(axis=0)
    # Refuses a marker that is far off the body.
    bound_markers(markers, build_mesh(settings["mesh"]), bound, followed)
    moving = [_moving(each, followed, settings["data"]) for each in observed]
    shifts = bound - places
    frames = max(len(each.positions) for each in moving)
    times = np.stack([np.pad(each.time, (0, frames - len(each.time)), mode="edge") for each in moving])
    positions = np.full((len(moving), frames, len(followed), 3), np.nan)
    held = np.stack([each.registration.transform.apply(each.held[columns]) for each in observed]) + shifts
    for row, (each, swing) in enumerate(zip(observed, moving, strict=True)):
        seen = each.registration.transform.apply(swing.positions.reshape(-1, 3)).reshape(swing.positions.shape)
        positions[row, : len(seen)] = seen + shifts[row]
    verticals = _verticals(observed, settings)
    gravity = _gravity(verticals, settings)
    quality_of = {
        each.trial.name: quality(
            each.recording, list(markers["others"]), each.release, longest_gap=settings["data"]["longest_gap"]
        )
        for each in observed
    }
    for found in quality_of.values():
        for warning in found.warnings:
            log.warning("%s: %s", found.source.name, warning)
    attributes = {"names": [each.trial.name for each in observed], "labels": followed, "gravity": gravity}
    with atomic_hdf5(context.run_dir / MARKERS, "markers", attributes) as file:
        create(file, "times", times, units="s", time_axis=1)
        create(file, "markers", positions, units="m", time_axis=1)
        create(file, "held", held, units="m")
        create(file, "bound", bound, units="m")
        create(file, "load", [each.trial.hung for each in observed], units="kg")
    write_json(context.run_dir / QUALITY, {name: found.to_plain() for name, found in quality_of.items()})
    registrations = {
        each.trial.name: registration_summary(each.registration, followed, -shifts[row])
        for row, each in enumerate(observed)
    }
    if verticals is not None:
        for name, up in zip(registrations, verticals, strict=True):
            registrations[name]["vertical_deg"] = _angle(up, -gravity)
    write_json(context.run_dir / REGISTRATION, registrations)


def observe(settings: Mapping[str, Any], run_dir: Path) -> list[Observed]:
    """Reads every trial, finds its release and registers it.

    Args:
        settings: the groups data, markers and synthetic.
        run_dir: where simulated recordings are.

    Raises:
        DataFileError: a recording that cannot be read or used.
    """
    data, markers = settings["data"], settings["markers"]
    nominal = {**markers["followed"], **markers["others"]}
    trials = trials_of(settings)
    recordings = [_read(trial, data, run_dir, is_synthetic(settings)).select(list(nominal)) for trial in trials]
    _check_rates(recordings, settings["time_step"])
    followed = list(markers["followed"])
    releases = [
        _START if data["begins"] == "released" else release_of(each, followed, data["longest_gap"])
        for each in recordings
    ]
    held = [
        replace(each, positions=each.positions[slice(*at.rest)]) for each, at in zip(recordings, releases, strict=True)
    ]
    if len(markers["others"]) > 1:
        check_base(
            held,
            list(markers["others"]),
            largest_distortion=markers["largest_distortion"],
            largest_shift=markers["largest_shift"],
        )
    found = []
    for trial, recording, release, still in zip(trials, recordings, releases, held, strict=True):
        places = _places(still, followed)
        registration = register_markers(
            places if data["rest"] == "held" else _rest(recording, followed),
            list(nominal.values()),
            list(nominal),
            source=recording.source,
            largest_residual=markers["largest_residual"],
        )
        off = f"; left out: {listed(registration.outliers)}" if registration.outliers else ""
        log.info(
            "import: %s is let go in frame %.1f, registered to %.2f mm%s",
            *(trial.name, release.frame, _MILLI * registration.rms, off),
        )
        found.append(Observed(trial, recording, release, registration, places))
    return found


def _read(trial: Trial, data: Mapping[str, Any], run_dir: Path, synthetic: bool) -> Recording:
    if synthetic or trial.file is None:
        return read_recording(run_dir / recording_file(trial.name))
    recording = read_recording(trial.file, data["units"], data["rate"])
    check_passive(recording)
    return recording


def _check_rates(recordings: Sequence[Recording], time_step: float) -> None:
    """Refuses recordings that are too slow, and says which frames fall between the steps of the simulation."""
    for recording in recordings:
        if recording.rate < _LEAST_RATE:
            raise DataFileError(
                f"{recording.source} has {recording.rate:g} frames a second, too few to tell how the body was let go: "
                f"record {_LEAST_RATE:g} or more, or set data.rate if the file is wrong."
            )
        ratio = recording.rate * time_step
        if abs(max(ratio, 1.0 / ratio) - round(max(ratio, 1.0 / ratio))) > 1e-6:
            log.info(
                "import: %s has %g frames a second and the simulation %g steps: it is read off at the times of the "
                "frames, between its steps",
                *(recording.source.name, recording.rate, 1.0 / time_step),
            )


def _places(held: Recording, followed: Sequence[str]) -> FloatArray:
    """(M, 3) median positions of the markers of a recording of the held body [m], NaN for one that is not seen."""
    hidden = [label for label, seen in zip(held.labels, held.seen.T, strict=True) if not seen.any()]
    lost = [label for label in hidden if label in followed]
    if lost:
        raise DataFileError(
            f"{held.source}: {listed(lost)} cannot be seen while the body is held, so where it sits is not known; "
            "leave it out of markers.followed."
        )
    places = np.full((len(held.labels), 3), np.nan)
    known = [label not in hidden for label in held.labels]
    places[known] = np.nanmedian(held.positions[:, known], axis=0)
    return places


def _rest(recording: Recording, followed: Sequence[str]) -> FloatArray:
    """(M, 3) the markers on the undeformed body, as the file has them [m]."""
    if recording.rest is None:
        raise DataFileError(
            f"{recording.source} has no array 'rest' that tells where its markers are on the undeformed body: add it "
            "(docs/recordings.md), or set data.rest to held if the body is held undeformed."
        )
    lost = [label for label in followed if not np.isfinite(recording.rest[recording.labels.index(label)]).all()]
    if lost:
        raise DataFileError(f"{recording.source}: 'rest' has no place of {listed(lost)}; leave it out of the markers.")
    return recording.rest


def _moving(each: Observed, followed: Sequence[str], data: Mapping[str, Any]) -> Recording:
    """The followed markers from the release on, short gaps filled, long ones NaN."""
    filled = fill_gaps(each.recording.select(followed), data["longest_gap"], mask_long=True)
    moving = trim_to_release(filled, each.release, seconds=data["seconds"])
    lost = [label for label, seen in zip(moving.labels, moving.seen.T, strict=True) if not seen.any()]
    if lost:
        raise DataFileError(
            f"{moving.source}: {listed(lost)} cannot be seen in the {data['seconds']:g} s after the release; leave it "
            "out of markers.followed."
        )
    check_motion(moving, followed)
    return moving


def _verticals(observed: Sequence[Observed], settings: Mapping[str, Any]) -> FloatArray | None:
    """(R, 3) the vertical of each recording in the frame of the body; None if it is not known.

    Raises:
        InputError: it points elsewhere than the configured gravity.
    """
    up = vertical(settings["data"]["up"])
    if up is None:
        return None
    verticals = np.stack([each.registration.transform.rotation @ up for each in observed])
    configured = np.asarray(settings["gravity"], dtype=np.float64)
    for each, found in zip(observed, verticals, strict=True):
        if configured.any() and _angle(found, -configured) > _LARGEST_LEAN:
            down = ", ".join(f"{-each:.2f}" for each in found)
            raise InputError(
                f"{each.recording.source}: with data.up {settings['data']['up']}, gravity points along ({down}) in the "
                f"frame of the body, {_angle(found, -configured):.0f} degrees from the configured one: set data.up to "
                "the vertical of the recordings, or gravity to its direction in the frame of markers and mesh."
            )
    return verticals


def _gravity(verticals: FloatArray | None, settings: Mapping[str, Any]) -> FloatArray:
    """(3,) gravity in the frame of the body, as strong as configured [m/s^2]."""
    configured = np.asarray(settings["gravity"], dtype=np.float64)
    if verticals is None:
        return configured
    mean = verticals.mean(axis=0)
    return np.asarray(-np.linalg.norm(configured) * mean / np.linalg.norm(mean))


def _angle(a: FloatArray, b: FloatArray) -> float:
    """Degrees between two vectors."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def registration_summary(registration: Registration, followed: Sequence[str], shift: FloatArray) -> dict[str, Any]:
    """For registration.json: lengths in millimetres, but for the positions in the frame of the body, in metres."""
    residual = dict(zip(registration.names, _MILLI * registration.residual, strict=True))
    return {
        "positions": dict(zip(registration.names, registration.positions.tolist(), strict=True)),
        "rms_mm": _MILLI * registration.rms,
        "residual_mm": residual,
        "outliers": list(registration.outliers),
        "shift_mm": dict(zip(followed, (_MILLI * shift).tolist(), strict=True)),
    }
