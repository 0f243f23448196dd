"""Reads recordings, with names of the configured markers and the inputs that drove the body."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ...core.dynamics.simulator import Simulator
from ...core.mesh.selection import vertices_at
from ...core.stepping.inputs import Inputs
from ...data.marker_names import assign
from ...data.marker_view import MarkerView
from ...data.markers import follow_vertices
from ...data.recordings.processing import obstacle_motion
from ...data.recordings.recording import Recording
from ...data.recordings.recording_files import read_recording
from ...data.registration import axes_rotation, unit_vector
from ...data.rigid_bodies import corners_of, motion_between, owners, with_corners
from ...data.trials import RESTING, STATIC, UNDER_INPUTS, payload_inputs
from ...io.arrays import FloatArray
from ...io.errors import DataFileError, InputError, listed, naming, number_of
from ...settings.data_kinds import ReadingSettings
from ...settings.performed import Trial
from ...settings.run import RunSettings
from ..actuators import drive_of
from ..build import (
    bound_markers,
    build_body,
    build_simulator,
    marker_view_of,
    mounted_on,
    nominal_places,
)

log = logging.getLogger(__name__)

POSE_SECONDS = 0.2  # at the end of a recording, from which a static pose is read
_HELD_SECONDS = 0.1  # at the beginning of a recording, while a body is held
_MILLI = 1e3


class Reader:
    """Reads recordings, and computes the expected places of their markers.

    Args:
        settings: of the run, or of its stage.
        trials: the trials that are read.
        folder: run folder, with the recordings of a simulated laboratory.

    Attributes:
        drive: input that drives the body; None without actuators.
        tracked: labels of the tracked markers and of the points of rigid bodies.
        nominal: (M, 3) their nominal places on the undeformed body [m].
        rotation: (3, 3) rotation from the frame of the recordings to the frame of the body; None if
            registration determines it.
        vertical: upward directions in the frames of the recordings and of the body; None if either
            is unknown.
        enough: number of reference markers that suffice to register a recording: 1 with known
            rotation, 2 with known vertical, none if it is in the frame of the body, else 3.

    Raises:
        InputError: the trials cannot be read, registered or driven with these settings.
        MeshError: no vertex lies at a place.
    """

    def __init__(self, settings: RunSettings, trials: Sequence[Trial], folder: Path) -> None:
        assert settings.markers is not None
        assert isinstance(settings.data, ReadingSettings)
        self.data: ReadingSettings = settings.data
        self.settings = settings
        self.markers = settings.markers
        self.trials = trials
        self.body = build_body(settings)
        self.drive = drive_of(settings, self.body)
        self.tracked = list(self.markers.observed)
        self._check_binding()
        self.nominal = nominal_places(self.markers, self.body.mesh)
        self._reference = np.array([*self.markers.reference.values()], dtype=np.float64).reshape(
            -1, 3
        )
        with naming("data.axes: "):
            self.rotation = None if self.data.axes is None else axes_rotation(self.data.axes)
        up, gravity = self.data.up, np.asarray(settings.gravity, dtype=np.float64)
        self.vertical = None if up is None or not gravity.any() else (unit_vector(up), -gravity)
        self.enough = 1 if self.rotation is not None else 3 if self.vertical is None else 2
        self.enough = 0 if self.markers.register_with == () else self.enough
        self._folder = folder
        self._check_trials()
        self._check_registration()

    @cached_property
    def simulator(self) -> Simulator:
        """The uncorrected simulator."""
        return build_simulator(self.settings, self.settings.simulation, self.body)

    def _check_binding(self) -> None:
        """Refuses places without vertices that markers and rigid bodies could follow."""
        if self.markers.bind_to is not None:
            vertices_at(self.body.mesh, self.markers.bind_to)
        for name, mounted in self.markers.rigid_bodies.items():
            if mounted.part is not None and mounted.part not in self.body.rigid:
                raise InputError(
                    f"markers.rigid_bodies.{name}.part is {mounted.part!r}, but the rigid parts "
                    f"of the body are {listed([*self.body.rigid])}: choose one, or name the "
                    "vertices of a stiff plate in at."
                )
            with naming(f"markers.rigid_bodies.{name}: "):
                follow_vertices(
                    self.body.mesh, mounted_on(mounted, self.body.mesh), np.zeros((1, 3))
                )

    def _check_trials(self) -> None:
        """Refuses trials without markers, durations,
        limits of their inputs, or a place for their payload.
        """
        data, drive = self.data, self.drive
        begins = {trial.begins for trial in self.trials}
        for trial in self.trials:
            if not self.tracked_in(trial):
                raise InputError(
                    f"data.trials.{trial.name}.labels names {listed(trial.labels or ())}, none "
                    "of which is in markers.tracked or rigid_bodies: "
                    f"{listed(owners(self.tracked))}."
                )
            if trial.begins == STATIC and (
                data.base_motion is not None or trial.base_motion is not None
            ):
                raise InputError(
                    f"the trial '{trial.name}' is a static pose: its base cannot move."
                )
            if trial.begins == STATIC and (data.obstacle_motion or trial.obstacle_motion):
                raise InputError(
                    f"the trial '{trial.name}' is a static pose: obstacles cannot move in it."
                )
        marker_view_of(
            self.markers,
            self.tracked,
            tuple({tuple(trial.tracked(self.tracked)) for trial in self.trials}),
        )
        payload_inputs(
            self.body, self.settings.payload_at, np.array([trial.payload for trial in self.trials])
        )
        if begins & {"held", "released"} and data.seconds is None:
            raise InputError(
                "data.seconds is not set: give the time after the release "
                "of each trial that is used, in s."
            )
        if begins & {*RESTING} and data.steps is None and data.folder is None:
            raise InputError(
                "data.steps is not set: give the number of time steps of a simulated trial."
            )
        if drive is not None and data.input_limit is None:
            raise InputError(
                f"data.input_limit is not set: give the largest input of the {drive.per}s, in "
                f"{drive.quantity.unit}."
            )
        if drive is not None and data.parts is not None and max(data.parts) > len(drive.parts):
            raise InputError(
                f"data.parts names {drive.per} {max(data.parts)}, but the body has "
                f"{len(drive.parts)}."
            )

    def _check_registration(self) -> None:
        """Refuses too few markers for the registration of the trials."""
        begins = {trial.begins for trial in self.trials}
        standing = len(self.markers.reference)
        enough = self.enough
        if not enough and self.rotation is None:
            raise InputError(
                "markers.register_with is empty, as of recordings in the frame of the body: name "
                "the axes of the recordings along which the body's x, y and z are in data.axes, "
                "such as [x, y, z]."
            )
        count = len(self.markers.tracked) + standing
        if count < enough:
            raise InputError(
                f"markers.tracked and markers.reference name {number_of(count, 'marker')}: "
                "registration needs at least 3, or 2 with data.up, or 1 with data.axes."
            )
        if self.markers.labels == "assigned" and STATIC in begins and standing < enough:
            raise InputError(
                f"markers.labels is assigned, but markers.reference names {standing}: static "
                f"poses need {enough} reference markers"
                + (", or data.axes and one." if self.data.axes is None else ".")
            )
        if UNDER_INPUTS in begins and standing < enough and self.markers.frame != "own":
            raise InputError(
                "trials that begin driven are bent from the first frame on, and "
                f"markers.reference names {standing}: registration needs {enough} markers on "
                "what the body is fixed to, or markers.frame own, or markers.register_with [] "
                "for recordings in the frame of the body."
            )

    def tracked_in(self, trial: Trial) -> list[str]:
        """Labels of the tracked markers of a trial."""
        return [self.tracked[number] for number in trial.tracked(self.tracked)]

    def labels(self, trial: Trial) -> list[str]:
        """Labels of the configured markers of a trial, tracked markers first."""
        return [*self.tracked_in(trial), *self.markers.reference]

    def view(self, trial: Trial) -> MarkerView:
        """View of the tracked markers in the recording of a trial."""
        return marker_view_of(self.markers, self.tracked_in(trial))

    def expected(self, trial: Trial, places: FloatArray | None = None) -> FloatArray:
        """(M', 3) expected places of a trial's markers at registration,
        on the undeformed or the hanging body [m].

        Coordinates that are not seen have their nominal values.

        Args:
            trial: the trial.
            places: (M, 3) of all tracked markers, in place of those on these bodies [m].
        """
        has = trial.tracked(self.tracked)
        if places is None and trial.is_released:
            return np.concatenate([self.nominal[has], self._reference])
        return np.concatenate(
            [
                self.view(trial).of_arrays((self.hanging if places is None else places)[has]),
                self._reference,
            ]
        )

    @cached_property
    def hanging(self) -> FloatArray:
        """(M, 3) tracked markers on the body that hangs under its weight alone [m]."""
        return self._posed(Inputs())[0]

    def turned(self, trial: Trial) -> FloatArray:
        """(M, 3, 3) rotation of a rigid body from the undeformed body to the expected places.

        Identity for markers.
        """
        turns = np.tile(np.eye(3), (len(self.tracked), 1, 1))
        if not trial.is_released:
            for corners in corners_of(self.tracked).values():
                turns[corners] = motion_between(
                    self.nominal[corners], self.hanging[corners]
                ).rotation
        return turns

    def _posed(self, inputs: Inputs) -> FloatArray:
        """(R, M, 3) tracked markers of the uncorrected simulator in equilibrium [m]."""
        markers = bound_markers(self.markers, self.body.mesh, self.nominal, tuple(self.tracked))
        places = markers.to(self.simulator.rest_positions)(
            self.simulator.static_equilibrium(inputs).q
        )
        return np.asarray(places.cpu().numpy())

    def read(self, trials: Sequence[Trial]) -> list[Recording]:
        """Reads the recordings of trials, with their configured markers in order.

        In a plane, the unseen coordinate of every marker has its nominal value.

        Raises:
            DataFileError: a recording cannot be read or used; the message names the file and the
                marker.
        """
        recordings = [self._read(trial) for trial in trials]
        if self.markers.labels == "assigned":
            recordings = self._assigned(trials, recordings)
        result, lacking = [], dict[tuple[str, str], list[str]]()
        for trial, recording in zip(trials, recordings, strict=True):
            labels = self.labels(trial)
            absent = [label for label in self.tracked if label not in labels]
            if absent:
                unused = [label for label in trial.labels or () if label not in owners(labels)]
                lacking.setdefault(
                    (listed(owners(absent)), listed(unused) if unused else ""), []
                ).append(trial.name)
            chosen, unseen = recording.select(labels), self.view(trial).unseen
            if unseen is not None:
                assert self.rotation is not None  # A plane needs data.axes.
                axis = self.rotation[unseen]
                deep = np.concatenate([self.nominal[trial.tracked(self.tracked)], self._reference])
                deep = deep[:, unseen]
                positions, rest = (
                    None if points is None else points + (deep - points @ axis)[..., None] * axis
                    for points in (chosen.positions, chosen.rest)
                )
                assert positions is not None
                chosen = replace(chosen, positions=positions, rest=rest)
            result.append(chosen)
        for (markers, others), names in lacking.items():
            log.log(
                logging.WARNING if others else logging.INFO,
                "import: no %s in %s, by data.trials.NAME.labels%s",
                markers,
                ", ".join(names),
                f", and {others} there are not configured" if others else "",
            )
        return result

    def _read(self, trial: Trial) -> Recording:
        """Reads the recording of a trial, with its rigid bodies,
        inputs of the body's parts and obstacles.
        """
        data, drive = self.data, self.drive
        if data.folder is None:
            recording = read_recording(self._folder / trial.recording)
        else:
            assert trial.file is not None
            recording = read_recording(
                trial.file, data.units, data.rate, trial.labels, data.table, data.bag
            )
        unread = [name for name in recording.loads if name not in self.settings.sensors]
        if unread:
            log.warning(
                "import: %s has force sensors that are not in sensors: %s",
                recording.source.name,
                listed(unread),
            )
        recording = replace(
            recording, loads={n: x for n, x in recording.loads.items() if n not in unread}
        )
        lengths = {
            name: body.length for name, body in self.markers.rigid_bodies.items() if trial.has(name)
        }
        recording = with_corners(recording, lengths)
        seconds = _HELD_SECONDS if trial.is_released else data.rest_seconds
        shown = [name for name, motion in data.obstacle_motion.items() if motion == "recorded"]
        recording = replace(
            recording, obstacles={name: obstacle_motion(recording, name, seconds) for name in shown}
        )
        driven = recording.actuation
        rate = recording.rate
        frames = np.arange(len(recording.positions))
        if abs(trial.input_delay) * rate >= len(frames):
            raise InputError(
                f"data.trials.{trial.name}.input_delay is {trial.input_delay:g} s, longer than "
                "the recording: give it in s."
            )
        if drive is None:
            if trial.inputs is not None:
                raise InputError(
                    f"data.trials.{trial.name}.inputs is set, but the body has no chambers, "
                    "tendons or muscles."
                )
            if driven is not None:
                raise DataFileError(
                    f"{recording.source} holds an actuation, {driven.shape[1]} in each frame, "
                    "which nothing here uses: take an experiment with pressures (/recordings: "
                    "pressure), or leave it out of the file."
                )
            return recording
        if trial.inputs is not None:
            begun, ended = (
                np.full(len(frames), without)
                if time is None
                else np.clip((recording.time - time) * rate, 0.0, 1.0)
                for time, without in ((trial.onset, 1.0), (trial.until, 0.0))
            )
            driven = (begun - ended)[:, None] * np.asarray(trial.inputs, dtype=np.float64)
        if driven is None:
            return recording
        parts = range(1, len(drive.parts) + 1) if data.parts is None else data.parts
        if driven.shape[1] != len(parts):
            names = "the body has" if data.parts is None else "data.parts names"
            raise DataFileError(
                f"{recording.source} has {drive.quantity.plural} of {driven.shape[1]} "
                f"{drive.per}s, but {names} {len(parts)}: name the body's {drive.per} of each "
                "column in data.parts."
            )
        inputs = np.zeros((len(driven), len(drive.parts)))
        inputs[:, np.array(parts) - 1] = driven
        if trial.input_delay:
            logged = frames - trial.input_delay * rate
            inputs = np.stack([np.interp(logged, frames, column) for column in inputs.T], axis=1)
        return replace(recording, actuation=inputs)

    def _assigned(
        self, trials: Sequence[Trial], recordings: Sequence[Recording]
    ) -> list[Recording]:
        """Labels the markers of recordings by their places while the body rests or is held."""
        places: dict[str, FloatArray | None] = {trial.name: None for trial in trials}
        static = [
            (t, r)
            for t, r in zip(trials, recordings, strict=True)
            if t.begins == STATIC and t.labels is None
        ]
        if static:
            posed = self._posed(self._held(*zip(*static, strict=True)))
            places |= {
                trial.name: posed_places
                for (trial, _), posed_places in zip(static, posed, strict=True)
            }
        labelled = []
        for trial, recording in zip(trials, recordings, strict=True):
            if trial.labels is not None:
                labelled.append(recording)
                continue
            expected, labels = self.expected(trial, places[trial.name]), self.labels(trial)
            unseen = self.view(trial).unseen
            if unseen is not None:  # The recordings have no depth.
                expected[:, unseen] = 0.0
            standing = list(range(len(self.tracked), len(labels)))
            still = slice(-_count(POSE_SECONDS, recording), None)
            if trial.begins != STATIC:
                still = slice(_count(_HELD_SECONDS, recording))
            columns, _, rms, next_rms = assign(
                central_places(recording.positions[still], np.median),
                expected,
                labels,
                source=recording.source,
                anchors=standing
                if trial.begins == STATIC or len(standing) >= self.enough
                else None,
                rotation=self.rotation,
            )
            log.info(
                "import: the markers of %s are assigned by their places, to %.1f mm (next best "
                "assignment: %.1f mm)",
                trial.name,
                _MILLI * rms,
                _MILLI * next_rms,
            )
            rest = None if recording.rest is None else recording.rest[columns]
            positions = recording.positions[:, columns]
            labelled.append(
                replace(recording, labels=tuple(labels), positions=positions, rest=rest)
            )
        return labelled

    def _held(self, trials: Sequence[Trial], recordings: Sequence[Recording]) -> Inputs:
        """Inputs of the body in static poses."""
        like, fields = self.simulator.rest_positions, {}
        if self.drive is not None:
            lacking = [recording.source for recording in recordings if recording.actuation is None]
            if lacking:
                raise DataFileError(
                    f"{lacking[0]} has no inputs of the body: add them to the file, or as "
                    "data.trials.NAME.inputs."
                )
            last = [
                np.median(recording.actuation[-_count(POSE_SECONDS, recording) :], axis=0)
                for recording in recordings
                if recording.actuation is not None
            ]
            fields[self.drive.quantity.name] = like.new_tensor(np.stack(last))
        loads = np.array([trial.payload for trial in trials])
        hung = payload_inputs(self.body, self.settings.payload_at, loads)
        return Inputs(**fields, **{key: like.new_tensor(masses) for key, masses in hung.items()})


def central_places(positions: FloatArray, centre: Callable[..., Any]) -> FloatArray:
    """(M, 3) mean or median of positions (T, M, 3) of each marker [m],
    NaN for a marker that is never seen.
    """
    places = np.full(positions.shape[1:], np.nan)
    for column, frames in enumerate(np.asarray(np.isfinite(positions).all(-1)).T):
        if frames.any():
            places[column] = centre(positions[frames, column], axis=0)
    return places


def _count(seconds: float, recording: Recording) -> int:
    return max(round(seconds * recording.rate), 1)
