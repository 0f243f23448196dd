"""From files to recordings in which the configured markers have their names, with what drove the body."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.assignment import assign
from ..data.marker_view import MarkerView
from ..data.recordings.quality import check_passive
from ..data.recordings.reading import read_recording
from ..data.recordings.recording import Recording
from ..data.recordings.text import Table
from ..data.registration import axes_rotation
from ..dynamics.simulator import Simulator
from ..io.errors import DataFileError, InputError, listed
from ..settings.stages import ImportStage
from ..settings.trials import ReadingSettings, Trial
from ..stepping.inputs import Inputs
from .actuators import Drive
from .build import bound_markers, marker_view_of
from .files import STATIC, payload_inputs
from .simulate import vertical

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

POSE_SECONDS = 0.2  # at the end of a recording, that tell a pose
_HELD_SECONDS = 0.1  # at the beginning of one, in which a body is held
_MILLI = 1e3


class Reader:
    """Reads recordings, and knows where their markers should be.

    Args:
        settings: of the import.
        run_dir: where the recordings of a laboratory are.
        simulator: of the body.
        drive: what drives it; None if nothing does.

    Attributes:
        tracked: names of the markers that errors are measured on.
        nominal: (M, 3) where they are on the undeformed body [m].
        rotation: (3, 3) from the frame of the recordings to that of the body; None where markers tell.
        vertical: upwards in the frame of the recordings and in that of the body; None where either is not known.
        enough: how many markers that stand still register a recording.
    """

    def __init__(self, settings: ImportStage, run_dir: Path, simulator: Simulator, drive: Drive | None) -> None:
        self.data, self.markers, self._payload_at = settings.data, settings.markers, settings.payload_at
        self.tracked = list(self.markers.tracked)
        self.nominal, self._reference = _places(self.markers.tracked), _places(self.markers.reference)
        axes, table = self.data.axes, self.data.table
        self.rotation = None if axes is None else axes_rotation(axes)
        self.vertical = vertical_of(self.data.up, settings.gravity)
        self.enough = standing_enough(self.data, settings.gravity)
        self._simulator, self._drive = simulator, drive
        self._folder = run_dir if self.data.folder is None else None
        self._table = None if table is None else Table(table.columns, table.header_lines)
        self._hanging: FloatArray | None = None

    def tracked_in(self, trial: Trial) -> list[str]:
        """Those of the tracked markers that a trial has."""
        return [self.tracked[number] for number in trial.tracked(self.tracked)]

    def labels(self, trial: Trial) -> list[str]:
        """Of the configured markers that a trial has, the tracked ones first."""
        return [*self.tracked_in(trial), *self.markers.reference]

    def view(self, trial: Trial) -> MarkerView:
        """How much the recording of a trial tells of where its tracked markers are."""
        return marker_view_of(self.markers, self.tracked_in(trial))

    def expected(self, trial: Trial) -> FloatArray:
        """(M', 3) where the markers of a trial are when they are registered, on the undeformed body or as it hangs [m].

        What is not told of them is as it is nominally.
        """
        if trial.is_released:
            return np.concatenate([self.nominal[trial.tracked(self.tracked)], self._reference])
        if self._hanging is None:
            self._hanging = self._posed(Inputs())[0]
        return self._seen(trial, self._hanging)

    def _seen(self, trial: Trial, places: FloatArray) -> FloatArray:
        """(M', 3) what is told of the markers of a trial, of where all tracked ones are."""
        told = self.view(trial).of_arrays(places[trial.tracked(self.tracked)])
        return np.concatenate([told, self._reference])

    def read(self, trials: Sequence[Trial]) -> list[Recording]:
        """The recordings of trials, with all configured markers in their order.

        Raises:
            DataFileError: a recording that cannot be read or used; the sentence names the file and the marker.
        """
        found = [self._read(trial) for trial in trials]
        if self.markers.labels == "assigned":
            found = self._assigned(trials, found)
        for trial in trials:
            if absent := [label for label in self.tracked if label not in self.labels(trial)]:
                others = [label for label in trial.labels or () if label not in self.labels(trial)]
                log.log(
                    logging.WARNING if others else logging.INFO,
                    "import: %s has no %s, by data.trials.%s.labels%s",
                    *(trial.name, listed(absent), trial.name),
                    f", and of its {listed(others)} nothing is configured" if others else "",
                )
        pairs = zip(trials, found, strict=True)
        return [self._with_depth(trial, recording.select(self.labels(trial))) for trial, recording in pairs]

    def _with_depth(self, trial: Trial, recording: Recording) -> Recording:
        """The same, with what is not seen of each marker as it is nominally."""
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
            recording = read_recording(Path(trial.file), self.data.units, self.data.rate, trial.labels, self._table)
        if self._drive is None:
            if trial.inputs is not None:
                raise InputError(
                    f"data.trials.{trial.name}.inputs drives nothing: the body has no chambers, tendons or muscles."
                )
            check_passive(recording)
        elif trial.inputs is not None:
            frames = np.arange(len(recording.positions)) + recording.start * recording.rate
            share = 1.0 if trial.onset is None else np.clip(frames - trial.onset * recording.rate, 0.0, 1.0)
            inputs = np.asarray(trial.inputs, dtype=np.float64)
            recording = replace(recording, actuation=(np.ones_like(frames) * share)[:, None] * inputs)
        if abs(trial.input_delay) * recording.rate >= len(recording.positions):
            raise InputError(
                f"data.trials.{trial.name}.input_delay is {trial.input_delay:g} s, longer than the recording: its "
                "unit is s."
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
        """(T, C) inputs of the parts of the body, of the columns (T, A) that a recording has of them."""
        parts, count = self.data.parts, len(drive.parts)
        if columns.shape[1] != (count if parts is None else len(parts)):
            names = "the body has" if parts is None else "data.parts names"
            raise DataFileError(
                f"{source} has {drive.quantity.plural} of {columns.shape[1]} {drive.per}s, but {names} "
                f"{count if parts is None else len(parts)}: name the body's {drive.per} of each column in data.parts."
            )
        if parts is None:
            return columns
        found = np.zeros((len(columns), count))
        found[:, np.array(parts) - 1] = columns
        return found

    def _assigned(self, trials: Sequence[Trial], recordings: Sequence[Recording]) -> list[Recording]:
        """The same, with the markers of each named by where they are while the body rests or is held."""
        expected = [self.expected(trial) for trial in trials]
        poses = [row for row, trial in enumerate(trials) if trial.begins == STATIC and trial.labels is None]
        if poses:
            posed = self._posed(self._held([trials[row] for row in poses], [recordings[row] for row in poses]))
            for row, places in zip(poses, posed, strict=True):
                expected[row] = self._seen(trials[row], places)
        found = []
        for row, (trial, recording) in enumerate(zip(trials, recordings, strict=True)):
            if trial.labels is not None:
                found.append(recording)
                continue
            unseen, labels = self.view(trial).unseen, self.labels(trial)
            if unseen is not None:  # no depth, as the recordings have it
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
                "import: the markers of %s are told by where they are, to %.1f mm (with others, %.1f mm at best)",
                *(trial.name, _MILLI * pairs.rms, _MILLI * pairs.next_rms),
            )
            columns = pairs.columns.tolist()
            rest = None if recording.rest is None else recording.rest[columns]
            named = replace(recording, labels=tuple(labels), positions=recording.positions[:, columns], rest=rest)
            found.append(named)
        return found

    def _held(self, trials: Sequence[Trial], recordings: Sequence[Recording]) -> Inputs:
        """What acts on the body in poses."""
        like, fields = self._simulator.rest_positions, {}
        if self._drive is not None:
            last = []
            for recording in recordings:
                driven = recording.actuation
                if driven is None:
                    raise DataFileError(
                        f"{recording.source} does not say what drove the body: add it to the file, or as "
                        "data.trials.NAME.inputs."
                    )
                last.append(np.median(driven[-_count(POSE_SECONDS, recording) :], axis=0))
            fields[self._drive.quantity.name] = like.new_tensor(np.stack(last))
        loads = np.array([trial.payload for trial in trials])
        hung = payload_inputs(self._simulator.body, self._payload_at, loads)
        return Inputs(**fields, **{key: like.new_tensor(each) for key, each in hung.items()})

    def _posed(self, inputs: Inputs) -> FloatArray:
        """(R, M, 3) the tracked markers of the uncorrected simulator in equilibrium [m]."""
        simulator = self._simulator
        read = bound_markers(self.markers, simulator.body.mesh, self.nominal, tuple(self.tracked))
        found: FloatArray = read.to(simulator.rest_positions)(simulator.static_equilibrium(inputs).q).cpu().numpy()
        return found


def standing_enough(data: ReadingSettings, gravity: Sequence[float]) -> int:
    """How many markers that stand still register a recording: one where its rotation is known, two where its up is.

    Args:
        data: how recordings are read.
        gravity: (3,) in the frame of the body [m/s^2].
    """
    if data.axes is not None:
        return 1
    return 3 if vertical_of(data.up, gravity) is None else 2


def vertical_of(up: str | Sequence[float] | None, gravity: Sequence[float]) -> tuple[FloatArray, FloatArray] | None:
    """(3,) upwards in the frame of the recordings, and in that of the body by its gravity; None if one is not known.

    Args:
        up: see `simulate.vertical`.
        gravity: (3,) in the frame of the body [m/s^2].
    """
    upwards, down = vertical(up), np.asarray(gravity, dtype=np.float64)
    return None if upwards is None or not down.any() else (upwards, -down)


def central_places(recording: Recording, centre: Callable[..., Any]) -> FloatArray:
    """(M, 3) means or medians of the positions of each marker [m], NaN for one that is never seen."""
    places = np.full(recording.positions.shape[1:], np.nan)
    for column, frames in enumerate(recording.seen.T):
        if frames.any():
            places[column] = centre(recording.positions[frames, column], axis=0)
    return places


def _still_frames(trial: Trial, recording: Recording) -> FloatArray:
    """(T', M, 3) while the body is in a pose, rests or is held [m]."""
    if trial.begins == STATIC:
        return recording.positions[-_count(POSE_SECONDS, recording) :]
    return recording.positions[: _count(_HELD_SECONDS, recording)]


def _count(seconds: float, recording: Recording) -> int:
    return max(round(seconds * recording.rate), 1)


def _places(markers: Mapping[str, Any]) -> FloatArray:
    return np.array([*markers.values()], dtype=np.float64).reshape(-1, 3)
