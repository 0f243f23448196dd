"""Recorded trials: time zero, registration to the frame of the body,
inputs, and motions of base and obstacles.
"""

import logging
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import median_filter, minimum_filter1d

from ...data.base_motion import followed, in_frame, prescribed, prescribed_all, rigid
from ...data.input_response import NO_INPUT, check_inputs
from ...data.recordings.marker_quality import check_motion, compare_base
from ...data.recordings.processing import (
    Release,
    fill_gaps,
    release_of,
    resample,
    trim_to_release,
    valve_opening,
)
from ...data.recordings.recording import Recording
from ...data.registration import Registration, register_markers
from ...data.rigid_bodies import corners_of, owners
from ...data.trials import SLACK, STATIC, UNDER_INPUTS
from ...io.arrays import BoolArray, FloatArray
from ...io.errors import DataFileError, listed
from ...settings.performed import MotionSettings, Trial
from ...settings.stage_keys import StageSettings
from ..actuators import Drive
from .reader import POSE_SECONDS, Reader, central_places

log = logging.getLogger(__name__)

_LEAST_RATE = (
    40.0  # Hz; the release is estimated from the first tenth of a second, i.e. at least four frames
)
_MILLI = 1e3
_SHARE_AT_REST = (
    0.1  # of the largest displacement of a marker: up to there, the body counts as at rest
)
_NOISE = 2e-4  # m; likewise
_SUSTAINED = 0.05  # s for which markers must have moved
_MOST_LINES = 6  # driven trials whose registrations have a line each
_START = Release(0.0, (0, 1))  # of a recording that begins with its release


class RegisteredTrials(Reader):
    """The R trials of a stage, read, from time zero on, and registered to the body.

    Args:
        settings: of the stage.
        folder: run folder.

    Attributes:
        measured: recordings of the configured markers as measured, tracked markers first.
        releases: of held bodies; None for other trials.
        moving: tracked markers from time zero on, with short gaps filled and long gaps NaN, in the
            frame of the recording; the inputs that drive the body at the frames, or (1, C) constant
            ones; and the motions of base and obstacles in the frame of the body.
        rests: (M', 3) markers before time zero, in the frame of the recording [m].
        shows_places: whether a trial shows the places of markers on the body: undeformed or under
            gravity only.
        registrations: of the markers at rest.

    Raises:
        DataFileError: a recording cannot be read or used; the message names the file and the
            marker.
    """

    def __init__(self, settings: StageSettings, folder: Path) -> None:
        super().__init__(settings, settings.trials, folder)
        timed = [
            self._timed(*pair) for pair in zip(self.trials, self.read(self.trials), strict=True)
        ]
        self.measured, self.releases = (
            [recording for recording, _ in timed],
            [release for _, release in timed],
        )
        self._check_reference()
        begun = [
            self._begun(*row) for row in zip(self.trials, self.measured, self.releases, strict=True)
        ]
        self.rests, self.shows_places = (
            [rest for _, rest, _ in begun],
            [shows for *_, shows in begun],
        )
        self.moving = [recording for recording, *_ in begun]
        self.registrations = self._registered()
        rows = range(len(self.trials))
        self.moving = [
            self._with_motions(row) if self.trials[row].begins != STATIC else self.moving[row]
            for row in rows
        ]

    def to_body(self, row: int, points: FloatArray, shift: FloatArray) -> FloatArray:
        """Transforms tracked markers (..., M', 3) of a trial to the frame of the body,
        shifted by (M', 3) [m].
        """
        view, transform = self.view(self.trials[row]), self.registrations[row].transform
        moved = transform.apply(points.reshape(-1, 3)).reshape(points.shape)
        return view.of_arrays(view.of_arrays(moved) + shift)

    def _timed(self, trial: Trial, recording: Recording) -> tuple[Recording, Release | None]:
        """Resamples the recording of a driven body to the steps of the simulation.

        Finds the release of a held body.
        """
        if not trial.is_released:
            resampled = resample(recording, 1.0 / self.settings.time_step)
            return resampled if trial.begins == STATIC else self._with_lead(trial, resampled), None
        if recording.rate < _LEAST_RATE:
            raise DataFileError(
                f"{recording.source} has {recording.rate:g} frames per second, too few to "
                f"estimate the release of the body: record at least {_LEAST_RATE:g}, or set "
                "data.rate if the file is wrong."
            )
        ratio = recording.rate * self.settings.time_step
        if abs(max(ratio, 1.0 / ratio) - round(max(ratio, 1.0 / ratio))) > 1e-6:
            log.info(
                "import: %s has %g frames per second and the simulation %g steps: simulated "
                "motions are interpolated at the frames",
                recording.source.name,
                recording.rate,
                1.0 / self.settings.time_step,
            )
        if trial.begins == "released":
            return recording, _START
        return recording, release_of(recording, self.tracked_in(trial), self.data.longest_gap)

    def _with_lead(self, trial: Trial, recording: Recording) -> Recording:
        """Leaves out frames of a body at rest that are earlier
        than `data.lead` before its inputs or markers change.
        """
        if self.data.lead is None or self.data.folder is None:
            return recording
        resting = self._rest_frames(recording)
        changes = moves(recording.select(self.tracked_in(trial)), resting)
        if recording.actuation is not None and self.data.valve == "recorded":
            changes |= ~self._is_at_rest(recording.actuation - recording.actuation[0])
        before = max(int(np.ceil(self.data.lead * recording.rate)), resting)
        first = max(int(np.argmax(changes)) - before, 0)
        return replace(recording.frames(slice(first, None)), start=float(recording.time[first]))

    def _check_reference(self) -> None:
        """Refuses recordings if reference markers moved relative to each other
        between trials of a session.
        """
        reference = list(self.markers.reference)
        sessions = defaultdict[str | None, list[Recording]](list)
        for trial, recording, release in zip(
            self.trials, self.measured, self.releases, strict=True
        ):
            frames = (
                (None,) if self._base_motion(trial) is None else (self._rest_frames(recording),)
            )
            sessions[trial.session].append(
                recording.frames(slice(*(frames if release is None else release.rest)))
            )
        for still in sessions.values() if len(reference) > 1 else ():
            compare_base(
                still, reference, self.markers.largest_distortion, self.markers.largest_shift
            )

    def _rest_frames(self, recording: Recording) -> int:
        return max(round(self.data.rest_seconds * recording.rate), 1)

    def _begun(
        self, trial: Trial, recording: Recording, release: Release | None
    ) -> tuple[Recording, FloatArray, bool]:
        """Returns `moving` without motions of base and obstacles,
        `rests` and `shows_places` of a trial.
        """
        tracked = self.tracked_in(trial)
        recording = replace(recording, base=None if trial.begins == STATIC else recording.base)
        if release is not None:
            return self._released(trial, recording, release)
        if trial.begins != STATIC:
            check_motion(recording.frames(slice(self.data.steps and self.data.steps + 1)), tracked)
        driven = None if self.drive is None else self._inputs(recording, trial, self.drive)
        loaded = (
            driven is not None and not self._is_at_rest(driven[:1])[0] and trial.begins != SLACK
        )
        filled = fill_gaps(recording, self.data.longest_gap)
        if trial.begins == STATIC and loaded:
            rest = _central(filled, tracked, np.median, "is held")
        else:
            rest = self._resting(trial, filled, driven)
        moving = replace(filled.select(tracked), actuation=driven)
        if trial.begins == STATIC:
            frames = max(round(POSE_SECONDS * moving.rate), 1)
            last = _central(moving.frames(slice(-frames, None)), tracked, np.median, "is held")
            driven = None if driven is None else np.median(driven[-frames:], axis=0)[None]
            # Axes that are not measured.
            with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
                loads = {
                    name: np.nanmedian(x[-frames:], axis=0)[None]
                    for name, x in moving.loads.items()
                }
            moving = replace(
                moving, positions=last[None], actuation=driven, obstacles={}, loads=loads
            )
        return moving, rest, trial.payload == 0.0 and not loaded

    def _released(
        self, trial: Trial, recording: Recording, release: Release
    ) -> tuple[Recording, FloatArray, bool]:
        """Returns the same of a body that was held, undeformed or deformed, and then released."""
        tracked = self.tracked_in(trial)
        if self.data.rest == "file":
            _check_rest(recording, tracked)
        rest = _central(recording.frames(slice(*release.rest)), tracked, np.median, "is held")
        filled = fill_gaps(recording.select(tracked), self.data.longest_gap)
        moving = trim_to_release(filled, release, seconds=self.data.seconds)
        lost = [
            label
            for label, seen in zip(moving.labels, moving.seen.T, strict=True)
            if not seen.any()
        ]
        if lost:
            raise DataFileError(
                f"{moving.source}: {listed(owners(lost))} cannot be seen in the "
                f"{self.data.seconds:g} s after the release; "
                "leave it out of the configured markers."
            )
        check_motion(moving, tracked)
        # Inputs of released bodies are taken as constant.
        driven = None if self.drive is None else self._inputs(moving, trial, self.drive)[:1]
        return replace(moving, actuation=driven), rest, True

    def _resting(self, trial: Trial, recording: Recording, driven: FloatArray | None) -> FloatArray:
        """(M', 3) mean positions of the markers before the inputs change [m],
        NaN for markers that are not seen.
        """
        until = len(recording.positions)
        if driven is not None:
            before = driven - driven[0] if trial.begins in (UNDER_INPUTS, SLACK) else driven
            until = next(iter(np.flatnonzero(~self._is_at_rest(before)).tolist()), until)
        if until < 1:
            assert self.drive is not None
            raise DataFileError(
                f"{recording.source} begins under {self.drive.quantity.words}: its first frame "
                f"must show the body at rest without, or give data.trials.{trial.name}.begins: "
                "driven if it is at rest under it, slack if it does not act yet."
            )
        resting = recording.frames(slice(min(until, self._rest_frames(recording))))
        return _central(resting, self.tracked_in(trial), np.mean, "rests")

    def _is_at_rest(self, driven: FloatArray) -> BoolArray:
        """(T,) whether inputs (T, C) are zero up to the noise of a gauge."""
        return np.asarray(
            np.abs(driven).max(axis=1) <= NO_INPUT * (self.data.input_limit or np.inf)
        )

    def _inputs(self, recording: Recording, trial: Trial, drive: Drive) -> FloatArray:
        """(T, C) inputs of the body's parts; refuses values beyond the limit."""
        if recording.actuation is None:
            if trial.is_released:
                return np.zeros((len(recording.positions), len(drive.parts)))
            raise DataFileError(
                f"{recording.source} has no array 'actuation' with the {drive.quantity.plural} "
                f"of the {drive.per}s: add it (docs/recordings.md)."
            )
        limit = trial.scale * (self.data.input_limit or np.inf)
        values = check_inputs(recording.actuation, drive.quantity, limit, recording.source)
        if self.data.valve == "detected" and not trial.is_released:
            opening = valve_opening(recording, self.tracked_in(trial))
            # Inputs begin at the opening of the valve; they act during a part of that step.
            frame = (opening - recording.start) * recording.rate
            values = np.asarray(values * np.clip(np.arange(len(values)) - frame, 0.0, 1.0)[:, None])
        return values

    def _registered(self) -> list[Registration]:
        """Registers every trial.

        In loaded trials only the reference markers are at known places. Their nominal places may be
        wrong by a third of a millimetre, which would rotate a body by a millimetre at its tip
        compared with the other trials, which are registered by all markers. So loaded trials are
        registered by the reference markers of the other trials.
        """
        found, standing = dict[int, Registration](), list[FloatArray]()
        enough = len(self.markers.reference) >= self.enough
        for row in sorted(range(len(self.trials)), key=lambda row: not self.shows_places[row]):
            trial, shows = self.trials[row], self.shows_places[row]
            expected, count = self.expected(trial), len(self.tracked_in(trial))
            if standing and enough and not shows:
                seen = np.isfinite(np.stack(standing)).all(-1).any(0)
                expected[count:][seen] = np.nanmean(np.stack(standing)[:, seen], axis=0)
            found[row] = self._register(row, expected, only_reference=enough and not shows)
            standing += [found[row].positions[count:]] if shows else []
        self._report(found)
        return [found[row] for row in range(len(self.trials))]

    def _report(self, found: Mapping[int, Registration]) -> None:
        """Logs how well the trials are registered, one line each or one for many,
        and warns of markers left out.
        """
        fits = {row: fit for row, fit in sorted(found.items()) if fit.inliers.any()}
        driven = [row for row in fits if not self.trials[row].is_released]
        if len(driven) > _MOST_LINES:
            sizes = [_MILLI * fits[row].rms for row in driven]
            log.info(
                "import: %d trials are registered to %.2f to %.2f mm",
                len(driven),
                min(sizes),
                max(sizes),
            )
        off = defaultdict[tuple[str, ...], list[int]](list)
        for row, fit in fits.items():
            name = self.trials[row].name
            release = self.releases[row]
            size = _MILLI * fit.rms
            if release is not None:
                log.info(
                    "import: %s is released in frame %.1f, registered to %.2f mm",
                    name,
                    release.frame,
                    size,
                )
            elif len(driven) <= _MOST_LINES:
                log.info("import: %s is registered to %.2f mm", name, size)
            if fit.outliers:
                off[fit.outliers].append(row)
        for labels, rows in off.items():
            columns = [fits[rows[0]].names.index(label) for label in labels]
            away = _MILLI * np.max([fits[row].residual[columns] for row in rows], axis=0)
            marks = [
                f"{label} ({distance:.1f} mm)" for label, distance in zip(labels, away, strict=True)
            ]
            names = [self.trials[row].name for row in rows]
            log.warning(
                "import: the registration of %s leaves out %s from the nominal position: check "
                "names (exchanged ones too), positions and unit",
                ", ".join(names) if len(names) <= _MOST_LINES else f"{len(names)} trials",
                ", ".join(marks),
            )

    def _register(self, row: int, expected: FloatArray, only_reference: bool) -> Registration:
        """Registers the markers of a trial at rest to their expected places (M', 3) [m].

        In their own frame, tracked markers do not depend on the pose of the body: any motion
        registers them.
        """
        trial = self.trials[row]
        recording = self.measured[row]
        places = self.rests[row]
        if trial.is_released and self.data.rest == "file":
            assert recording.rest is not None
            places = recording.rest
        chosen = self.markers.register_with
        view = self.view(trial)
        rotation = self.rotation
        use = (
            [*self.markers.reference]
            if only_reference
            else [*self.markers.tracked, *self.markers.reference]
        )
        use = [
            label
            for label in use
            if label in recording.labels and (chosen is None or label in chosen)
        ]
        if view.shape_alone and rotation is not None:
            count = len(view.nominal)
            places = np.concatenate(
                [view.of_arrays(places[:count] @ rotation.T) @ rotation, places[count:]]
            )
        return register_markers(
            places,
            expected,
            recording.labels,
            source=recording.source,
            largest_residual=self.markers.largest_residual,
            use=use,
            rotation=rotation,
            vertical=self.vertical,
        )

    def _base_motion(self, trial: Trial) -> Any:
        """Configured motion of the base of a trial.

        In a laboratory the base may be measured instead.
        """
        common = self.data.base_motion
        return common if trial.base_motion is None or isinstance(common, str) else trial.base_motion

    def _with_motions(self, row: int) -> Recording:
        """Returns `moving` of a trial with motions of base and obstacles in the frame of the body.

        Recorded motions of obstacles take precedence over given ones.
        """
        trial = self.trials[row]
        moving = self.moving[row]
        whole = self.measured[row]
        release = self.releases[row]
        frame, motion = self.registrations[row].transform, self._base_motion(trial)
        folder, base = self.data.folder or ".", None
        if release is not None:
            first = int(np.ceil(release.frame))
            whole = whole.frames(slice(first, first + len(moving.positions)))
        if isinstance(motion, MotionSettings):
            base = prescribed(motion, moving.time, folder)
        elif motion == "reference":
            count = len(moving.labels)
            base = in_frame(
                followed(whole.positions[:, count:], self.rests[row][count:], whole.source), frame
            )
        elif motion is not None:
            if moving.base is None:
                raise DataFileError(
                    f"{whole.source} has no array 'base' with the motion of the base: add it "
                    "(docs/recordings.md), or set data.base_motion to reference if "
                    "markers.reference move with it."
                )
            base = in_frame(moving.base, frame)
        obstacles = prescribed_all(
            self.data.obstacle_motion, trial.obstacle_motion, moving.time, folder
        )
        obstacles |= {name: in_frame(poses, frame) for name, poses in moving.obstacles.items()}
        moved = {} if base is None else {"the base moves the body": base}
        for what, poses in (
            moved | {f"the obstacle {name!r} moves": path for name, path in obstacles.items()}
        ).items():
            early = poses[: 1 if trial.is_released else self._rest_frames(whole)]
            shift = (
                rigid(early).apply(np.broadcast_to(self.nominal, (len(early), *self.nominal.shape)))
                - self.nominal
            )
            furthest = float(np.linalg.norm(shift, axis=-1).max())
            if furthest > self.markers.largest_residual:
                raise DataFileError(
                    f"{whole.source}: {what} by {_MILLI * furthest:.1f} mm during registration: "
                    "keep it still until the release, or in the first data.rest_seconds."
                )
        return replace(moving, base=base, obstacles=obstacles)


def moves(recording: Recording, resting: int) -> BoolArray:
    """Returns whether a body has left its rest, (T,):
    two or more of its markers have, for a twentieth of a second.

    A jump of one marker, or of several in a single frame, is no motion. Where only one marker ever
    leaves its place, it decides alone.

    Args:
        recording: with the markers on the body.
        resting: number of frames at its start in which the body rests.
    """
    frames, away = max(round(_SUSTAINED * recording.rate), 2), list[BoolArray]()
    for path, known in zip(recording.positions.swapaxes(0, 1), recording.seen.T, strict=True):
        if known.any():
            moved = np.nan_to_num(
                np.linalg.norm(path - np.median(path[known][:resting], axis=0), axis=1)
            )
            beyond = moved > max(_SHARE_AT_REST * median_filter(moved, frames).max(), _NOISE)
            away.append(minimum_filter1d(beyond, frames, origin=-(frames // 2), mode="nearest"))
    count = np.sum(away, axis=0) if away else np.zeros(len(recording.positions))
    movers = sum(bool(one.any()) for one in away)
    return np.asarray((count >= min(2, movers)) & (count > 0))


def _central(
    recording: Recording, tracked: Sequence[str], centre: Callable[..., Any], while_it: str
) -> FloatArray:
    """(M', 3) median or mean positions of markers [m], NaN for one that is not seen.

    Refused for tracked ones.
    """
    places = central_places(recording.positions, centre)
    lost = [
        recording.labels[n]
        for n in np.flatnonzero(np.isnan(places[:, 0]))
        if recording.labels[n] in tracked
    ]
    if lost:
        raise DataFileError(
            f"{recording.source}: {listed(owners(lost))} cannot be seen while the body "
            f"{while_it}, so its place on the body is unknown; "
            "leave it out of the configured markers."
        )
    return places


def _check_rest(recording: Recording, tracked: Sequence[str]) -> None:
    """Refuses a recording without the tracked markers on the undeformed body."""
    if recording.rest is None:
        raise DataFileError(
            f"{recording.source} has no array 'rest' with its markers on the undeformed body: "
            "add it (docs/recordings.md), or set data.rest "
            "to held if the body is held undeformed."
        )
    lost = [
        label
        for label in tracked
        if not np.isfinite(recording.rest[recording.labels.index(label)]).all()
    ]
    turned = [name for name, corners in corners_of(tracked).items() if tracked[corners][0] in lost]
    if turned:
        raise DataFileError(
            f"{recording.source}: 'rest' has no orientation of {listed(turned)}: set data.rest "
            "to held, with frames in which the body is held undeformed."
        )
    if lost:
        raise DataFileError(
            f"{recording.source}: 'rest' has no place of {listed(lost)}; leave it out of the "
            "configured markers."
        )
