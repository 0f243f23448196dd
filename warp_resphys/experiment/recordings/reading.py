"""Reads recordings, with names of the configured markers and the inputs that drove the body."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...data.marker_view import MarkerView
from ...data.obstacle_motion import recorded
from ...data.recordings.bag import Bag
from ...data.recordings.reading import read_recording
from ...data.recordings.recording import Recording
from ...data.recordings.text import Table
from ...data.registration import assign, axes_rotation
from ...data.rigid_bodies import corners_of, motion_between, owners, with_corners
from ...dynamics.simulator import Simulator
from ...io.errors import DataFileError, InputError, listed
from ...settings.stages import ImportStage
from ...settings.trials import ReadingSettings, Trial
from ...stepping.inputs import Inputs
from ..actuators import Drive
from ..build import bound_markers, marker_view_of, nominal_places
from ..files import STATIC, payload_inputs

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

POSE_SECONDS = 0.2  # at the end of a recording, from which a static pose is read
_HELD_SECONDS = 0.1  # at the beginning of a recording, while a body is held
_MILLI = 1e3


class Reader:
    """Reads recordings, and computes the expected places of their markers.

    Args:
        settings: settings of the import.
        run_dir: folder of the recordings of a laboratory.
        simulator: simulator of the body.
        drive: input that drives the body; None without actuators.

    Attributes:
        tracked: labels of the tracked markers and of the points of rigid bodies.
        nominal: (M, 3) their nominal places on the undeformed body [m].
        rotation: (3, 3) rotation from the frame of the recordings to the frame of the body; None if registration
            determines it.
        vertical: upward directions in the frames of the recordings and of the body; None if either is unknown.
        enough: number of reference markers that suffice to register a recording.
    """

    def __init__(self, settings: ImportStage, run_dir: Path, simulator: Simulator, drive: Drive | None) -> None:
        self.data, self.markers, self._payload_at = settings.data, settings.markers, settings.payload_at
        self.tracked = list(self.markers.observed)
        self.nominal = nominal_places(self.markers, simulator.body.mesh)
        self._reference = _places(self.markers.reference)
        axes, table = self.data.axes, self.data.table
        self.rotation = None if axes is None else axes_rotation(axes)
        self.vertical = vertical_of(self.data.up, settings.gravity)
        self.enough = standing_enough(self.data, settings.gravity)
        self._simulator, self._drive = simulator, drive
        self._folder = run_dir if self.data.folder is None else None
        self._table = None if table is None else Table(**table.plain())
        self._bag = None if self.data.bag is None else Bag(**self.data.bag.plain())
        self._hanging: FloatArray | None = None

    def tracked_in(self, trial: Trial) -> list[str]:
        """Labels of the tracked markers of a trial."""
        return [self.tracked[number] for number in trial.tracked(self.tracked)]

    def labels(self, trial: Trial) -> list[str]:
        """Labels of the configured markers of a trial, tracked markers first."""
        return [*self.tracked_in(trial), *self.markers.reference]

    def view(self, trial: Trial) -> MarkerView:
        """View of the tracked markers in the recording of a trial."""
        return marker_view_of(self.markers, self.tracked_in(trial))

    def expected(self, trial: Trial) -> FloatArray:
        """(M', 3) expected places of a trial's markers at registration, on the undeformed or the hanging body [m].

        Coordinates that are not seen have their nominal values.
        """
        if trial.is_released:
            return np.concatenate([self.nominal[trial.tracked(self.tracked)], self._reference])
        if self._hanging is None:
            self._hanging = self._posed(Inputs())[0]
        return self._seen(trial, self._hanging)

    def turned(self, trial: Trial) -> FloatArray:
        """(M, 3, 3) rotation of a rigid body from the undeformed body to the expected places; identity for markers."""
        turns = np.tile(np.eye(3), (len(self.tracked), 1, 1))
        if not trial.is_released:
            self.expected(trial)
            assert self._hanging is not None
            for own in corners_of(self.tracked).values():
                turns[own] = motion_between(self.nominal[own], self._hanging[own]).rotation
        return turns

    def _seen(self, trial: Trial, places: FloatArray) -> FloatArray:
        """(M', 3) places of a trial's markers as seen in its recording, from places (M, 3) of all tracked ones."""
        seen = self.view(trial).of_arrays(places[trial.tracked(self.tracked)])
        return np.concatenate([seen, self._reference])

    def read(self, trials: Sequence[Trial]) -> list[Recording]:
        """Reads the recordings of trials, with their configured markers in order.

        Raises:
            DataFileError: a recording cannot be read or used; the message names the file and the marker.
        """
        recordings = [self._read(trial) for trial in trials]
        if self.markers.labels == "assigned":
            recordings = self._assigned(trials, recordings)
        for trial in trials:
            if absent := [label for label in self.tracked if label not in self.labels(trial)]:
                others = [label for label in trial.labels or () if label not in owners(self.labels(trial))]
                log.log(
                    logging.WARNING if others else logging.INFO,
                    "import: %s has no %s, by data.trials.%s.labels%s",
                    *(trial.name, listed(owners(absent)), trial.name),
                    f", and {listed(others)} of it are not configured" if others else "",
                )
        pairs = zip(trials, recordings, strict=True)
        return [self._with_depth(trial, recording.select(self.labels(trial))) for trial, recording in pairs]

    def _with_depth(self, trial: Trial, recording: Recording) -> Recording:
        """Returns a recording in which the unseen coordinate of every marker has its nominal value."""
        unseen = self.view(trial).unseen
        if unseen is None:
            return recording
        assert self.rotation is not None  # A plane needs data.axes.
        axis = self.rotation[unseen]
        deep = np.concatenate([self.nominal[trial.tracked(self.tracked)], self._reference])[:, unseen]

        def moved(points: FloatArray) -> FloatArray:
            return np.asarray(points + (deep - points @ axis)[..., None] * axis)

        rest = None if recording.rest is None else moved(recording.rest)
        return replace(recording, positions=moved(recording.positions), rest=rest)

    def _read(self, trial: Trial) -> Recording:
        if self._folder is not None:
            recording = read_recording(self._folder / trial.recording)
        else:
            assert trial.file is not None
            given = self.data.units, self.data.rate, trial.labels, self._table, self._bag
            recording = read_recording(Path(trial.file), *given)
        lengths = {name: body.length for name, body in self.markers.rigid_bodies.items() if trial.has(name)}
        recording = with_corners(recording, lengths)
        seconds = _HELD_SECONDS if trial.is_released else self.data.rest_seconds
        shown = [name for name, motion in self.data.obstacle_motion.items() if motion == "recorded"]
        recording = replace(recording, obstacles={name: recorded(recording, name, seconds) for name in shown})
        if self._drive is None:
            if trial.inputs is not None:
                raise InputError(
                    f"data.trials.{trial.name}.inputs is set, but the body has no chambers, tendons or muscles."
                )
            if recording.actuation is not None:
                raise DataFileError(
                    f"{recording.source} holds an actuation, {recording.actuation.shape[1]} in each frame, which "
                    "nothing here uses: take an experiment with pressures (/recordings: pressure), or leave it out of "
                    "the file."
                )
        elif trial.inputs is not None:
            frames = np.arange(len(recording.positions)) + recording.start * recording.rate
            share = 1.0 if trial.onset is None else np.clip(frames - trial.onset * recording.rate, 0.0, 1.0)
            inputs = np.asarray(trial.inputs, dtype=np.float64)
            recording = replace(recording, actuation=(np.ones_like(frames) * share)[:, None] * inputs)
        if abs(trial.input_delay) * recording.rate >= len(recording.positions):
            raise InputError(
                f"data.trials.{trial.name}.input_delay is {trial.input_delay:g} s, longer than the recording: give "
                "it in s."
            )
        if self._drive is None or recording.actuation is None:
            return recording
        driven = self._of_parts(recording.actuation, recording.source, self._drive)
        if trial.input_delay:
            own = np.arange(len(driven), dtype=np.float64)
            logged = own - trial.input_delay * recording.rate
            driven = np.stack([np.interp(logged, own, column) for column in driven.T], axis=1)
        return replace(recording, actuation=driven)

    def _of_parts(self, columns: FloatArray, source: Path, drive: Drive) -> FloatArray:
        """(T, C) inputs of the parts of the body, from the columns (T, A) of a recording."""
        parts, count = self.data.parts, len(drive.parts)
        if columns.shape[1] != (count if parts is None else len(parts)):
            names = "the body has" if parts is None else "data.parts names"
            raise DataFileError(
                f"{source} has {drive.quantity.plural} of {columns.shape[1]} {drive.per}s, but {names} "
                f"{count if parts is None else len(parts)}: name the body's {drive.per} of each column in data.parts."
            )
        if parts is None:
            return columns
        inputs = np.zeros((len(columns), count))
        inputs[:, np.array(parts) - 1] = columns
        return inputs

    def _assigned(self, trials: Sequence[Trial], recordings: Sequence[Recording]) -> list[Recording]:
        """Labels the markers of recordings by their places while the body rests or is held."""
        expected = [self.expected(trial) for trial in trials]
        poses = [row for row, trial in enumerate(trials) if trial.begins == STATIC and trial.labels is None]
        if poses:
            posed = self._posed(self._held([trials[row] for row in poses], [recordings[row] for row in poses]))
            for row, places in zip(poses, posed, strict=True):
                expected[row] = self._seen(trials[row], places)
        labelled = []
        for row, (trial, recording) in enumerate(zip(trials, recordings, strict=True)):
            if trial.labels is not None:
                labelled.append(recording)
                continue
            unseen, labels = self.view(trial).unseen, self.labels(trial)
            if unseen is not None:  # The recordings have no depth.
                expected[row][:, unseen] = 0.0
            standing = list(range(len(self.tracked), len(labels)))
            bent = trial.begins == STATIC or len(standing) >= self.enough
            pairs = assign(
                central_places(replace(recording, positions=_still_frames(trial, recording)), np.median),
                expected[row],
                labels,
                source=recording.source,
                anchors=standing if bent else None,
                rotation=self.rotation,
            )
            log.info(
                "import: the markers of %s are assigned by their places, to %.1f mm (next best assignment: %.1f mm)",
                *(trial.name, _MILLI * pairs.rms, _MILLI * pairs.next_rms),
            )
            columns = pairs.columns.tolist()
            rest = None if recording.rest is None else recording.rest[columns]
            positions = recording.positions[:, columns]
            labelled.append(replace(recording, labels=tuple(labels), positions=positions, rest=rest))
        return labelled

    def _held(self, trials: Sequence[Trial], recordings: Sequence[Recording]) -> Inputs:
        """Inputs of the body in static poses."""
        like, fields = self._simulator.rest_positions, {}
        if self._drive is not None:
            last = []
            for recording in recordings:
                driven = recording.actuation
                if driven is None:
                    raise DataFileError(
                        f"{recording.source} has no inputs of the body: add them to the file, or as "
                        "data.trials.NAME.inputs."
                    )
                last.append(np.median(driven[-_count(POSE_SECONDS, recording) :], axis=0))
            fields[self._drive.quantity.name] = like.new_tensor(np.stack(last))
        loads = np.array([trial.payload for trial in trials])
        hung = payload_inputs(self._simulator.body, self._payload_at, loads)
        return Inputs(**fields, **{key: like.new_tensor(masses) for key, masses in hung.items()})

    def _posed(self, inputs: Inputs) -> FloatArray:
        """(R, M, 3) tracked markers of the uncorrected simulator in equilibrium [m]."""
        simulator = self._simulator
        markers = bound_markers(self.markers, simulator.body.mesh, self.nominal, tuple(self.tracked))
        places = markers.to(simulator.rest_positions)(simulator.static_equilibrium(inputs).q)
        return np.asarray(places.cpu().numpy())


def standing_enough(data: ReadingSettings, gravity: Sequence[float]) -> int:
    """Number of reference markers that suffice for registration: 1 with known rotation, 2 with known vertical, else 3.

    Args:
        data: how recordings are read.
        gravity: (3,) gravity in the frame of the body [m/s^2].
    """
    if data.axes is not None:
        return 1
    return 3 if vertical_of(data.up, gravity) is None else 2


def vertical(up: str | Sequence[float] | None) -> FloatArray | None:
    """(3,) upward unit vector in the frame of the recordings; None if it is unknown.

    Args:
        up: ``x``, ``-x``, ``y`` and so on, or a vector (3,).
    """
    if up is None:
        return None
    if isinstance(up, str):
        return np.eye(3)["xyz".index(up.removeprefix("-"))] * (-1.0 if up.startswith("-") else 1.0)
    vector = np.asarray(up, dtype=np.float64)
    return np.asarray(vector / np.linalg.norm(vector))


def vertical_of(up: str | Sequence[float] | None, gravity: Sequence[float]) -> tuple[FloatArray, FloatArray] | None:
    """(3,) upward directions in the frames of the recordings and of the body; None if either is unknown.

    Args:
        up: see `vertical`.
        gravity: (3,) gravity in the frame of the body [m/s^2].
    """
    upwards, down = vertical(up), np.asarray(gravity, dtype=np.float64)
    return None if upwards is None or not down.any() else (upwards, -down)


def central_places(recording: Recording, centre: Callable[..., Any]) -> FloatArray:
    """(M, 3) mean or median position of each marker [m], NaN for a marker that is never seen."""
    places = np.full(recording.positions.shape[1:], np.nan)
    for column, frames in enumerate(recording.seen.T):
        if frames.any():
            places[column] = centre(recording.positions[frames, column], axis=0)
    return places


def _still_frames(trial: Trial, recording: Recording) -> FloatArray:
    """(T', M, 3) marker positions while the body is in a static pose, rests or is held [m]."""
    if trial.begins == STATIC:
        return recording.positions[-_count(POSE_SECONDS, recording) :]
    return recording.positions[: _count(_HELD_SECONDS, recording)]


def _count(seconds: float, recording: Recording) -> int:
    return max(round(seconds * recording.rate), 1)


def _places(markers: Mapping[str, Any]) -> FloatArray:
    return np.array([*markers.values()], dtype=np.float64).reshape(-1, 3)
