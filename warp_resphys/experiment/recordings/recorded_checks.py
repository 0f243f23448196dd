"""Checks of experiments that observe their bodies through markers, before the first stage."""

from collections.abc import Sequence

import numpy as np

from ...data.input_response import draw_inputs
from ...data.markers import follow_vertices
from ...data.registration import axes_rotation
from ...data.rigid_bodies import owners
from ...data.trials import RESTING, STATIC, UNDER_INPUTS, payload_inputs
from ...fem.bodies import Body
from ...io.errors import InputError, listed, naming, number_of
from ...mesh.selection import select_vertices
from ...settings.data_kinds import RecordedData
from ...settings.observed import MarkerSettings
from ...settings.performed import Trial
from ...settings.run import RunSettings
from ..actuators import Drive, drive_of
from ..build import build_material, marker_view_of, mounted_on
from ..laboratory import largest_input
from ..simulate import substeps_of
from ..splits import all_trials, folds_of, split_of, trials_of
from .reader import standing_enough


def check_recorded(run: RunSettings, data: RecordedData, markers: MarkerSettings, body: Body) -> None:
    """Checks an experiment that observes its bodies through markers."""
    if run.is_laboratory and run.laboratory is not None and not run.laboratory.trials and not data.sequences:
        raise InputError("laboratory.trials is empty: name the trials, or set data.sequences.")
    files: dict[str, str] = {}
    for name, one in data.trials.items():
        if one.file is not None and (other := files.setdefault(one.file, name)) != name:
            raise InputError(f"the trials '{other}' and '{name}' have the same file, {one.file}: use it once.")
    if folds_of(run) is None:
        split_of(run)
    trials = trials_of(run)
    begins = {trial.begins for trial in trials}
    _check_markers(run, data, markers, body, begins)
    _check_view(run, markers, trials)
    payload_inputs(body, data.payload_at, np.array([trial.payload for trial in trials]))
    if begins & {"held", "released"} and data.seconds is None:
        raise InputError("data.seconds is not set: give the time after the release of each trial that is used, in s.")
    if begins & {*RESTING} and data.steps is None and data.folder is None:
        raise InputError("data.steps is not set: give the number of time steps of a simulated trial.")
    drive = drive_of(run, body)
    if drive is not None and data.input_limit is None:
        raise InputError(
            f"data.input_limit is not set: give the largest input of the {drive.per}s, in {drive.quantity.unit}."
        )
    if drive is not None and data.parts is not None and max(data.parts) > len(drive.parts):
        raise InputError(f"data.parts names {drive.per} {max(data.parts)}, but the body has {len(drive.parts)}.")
    _check_waves(run, trials, drive)
    if begins & {*RESTING} and data.steps is not None and data.horizons:
        length = data.steps * run.time_step
        if data.horizons[-1] > length + 1e-9:
            raise InputError(
                f"data.horizons is {list(data.horizons)}: they must rise, up to the {length:g} s of data.steps."
            )
    if run.published is not None:
        build_material(run.published.simulation, "published.simulation")
    if run.is_laboratory:
        _check_laboratory(run, data, trials, drive)
    for trial in trials:
        if trial.begins == STATIC and (data.base_motion is not None or trial.base_motion is not None):
            raise InputError(f"the trial '{trial.name}' is a static pose: its base cannot move.")
        if trial.begins == STATIC and (data.obstacle_motion or trial.obstacle_motion):
            raise InputError(f"the trial '{trial.name}' is a static pose: obstacles cannot move in it.")
    if begins & {"held", "released"} and (sideways := run.release.sideways):
        if data.rest != "held":
            raise InputError(
                f"release.sideways is {sideways:g} m, but data.rest is {data.rest}, which gives the markers on the "
                "undeformed body: set release.sideways to 0."
            )
        if not any(run.gravity):
            raise InputError("release.sideways is across gravity, but gravity is zero: set release.sideways to 0.")


def _check_markers(run: RunSettings, data: RecordedData, markers: MarkerSettings, body: Body, begins: set[str]) -> None:
    if data.axes is not None:
        with naming("data.axes: "):
            axes_rotation(data.axes)
    count, standing = len(markers.tracked) + len(markers.reference), len(markers.reference)
    enough = standing_enough(data, run.gravity)
    if count < enough:
        raise InputError(
            f"markers.tracked and markers.reference name {number_of(count, 'marker')}: registration needs at least 3, "
            "or 2 with data.up, or 1 with data.axes."
        )
    if markers.labels == "assigned" and STATIC in begins and standing < enough:
        raise InputError(
            f"markers.labels is assigned, but markers.reference names {standing}: static poses need {enough} "
            "reference markers" + (", or data.axes and one." if data.axes is None else ".")
        )
    if UNDER_INPUTS in begins and standing < enough and markers.frame != "own":
        raise InputError(
            f"trials that begin driven are bent from the first frame on, and markers.reference names {standing}: "
            f"registration needs {enough} markers on what the body is fixed to, or markers.frame own."
        )
    if markers.bind_to is not None:
        select_vertices(body.mesh, **markers.bind_to.arguments())
    for name, mounted in markers.rigid_bodies.items():
        if mounted.part is not None and mounted.part not in body.rigid:
            raise InputError(
                f"markers.rigid_bodies.{name}.part is {mounted.part!r}, but the rigid parts of the body are "
                f"{listed([*body.rigid])}: choose one, or name the vertices of a stiff plate in at."
            )
        with naming(f"markers.rigid_bodies.{name}: "):
            follow_vertices(body.mesh, mounted_on(mounted, body.mesh), np.zeros((1, 3)))


def _check_view(run: RunSettings, markers: MarkerSettings, trials: Sequence[Trial]) -> None:
    """Checks the markers of the trials."""
    tracked = markers.observed
    for trial in trials:
        if not trial.tracked(tracked):
            raise InputError(
                f"data.trials.{trial.name}.labels names {listed(trial.labels or ())}, none of which is in "
                f"markers.tracked or rigid_bodies: {listed(owners(tracked))}."
            )
    everywhere = {number for trial in all_trials(run).values() for number in trial.tracked(tracked)}
    if nowhere := [label for number, label in enumerate(tracked) if number not in everywhere]:
        raise InputError(
            f"{listed(owners(nowhere))} of markers.tracked or rigid_bodies is in no data.trials.NAME.labels: add it "
            "there, or leave it out."
        )
    marker_view_of(markers, tracked, tuple({tuple(trial.tracked(tracked)) for trial in trials}))


def _check_waves(run: RunSettings, trials: Sequence[Trial], drive: Drive | None) -> None:
    """Refuses waves of recordings, of bodies without inputs, of trials without motion, and of other parts."""
    for trial in trials:
        if trial.waves is None:
            continue
        key = f"laboratory.trials.{trial.name}.waves"
        if drive is None or trial.begins not in RESTING:
            why = "the body has no inputs" if drive is None else f"the trial begins {trial.begins}"
            raise InputError(f"{key} is set, but {why}: leave it out.")
        count, wanted = len(trial.waves.phases), number_of(len(drive.parts), drive.per)
        if count != len(drive.parts):
            raise InputError(f"{key}.phases has {count} values, but the body has {wanted}: give as many phases.")
    without = [trial.name for trial in trials if trial.begins in RESTING and not trial.is_driven]
    if without and any(trial.waves is not None for trial in trials):
        raise InputError(f"laboratory.trials.{without[0]}.waves is missing, which other trials have: add it.")


def _check_laboratory(run: RunSettings, data: RecordedData, trials: Sequence[Trial], drive: Drive | None) -> None:
    laboratory, begins = run.laboratory, {trial.begins for trial in trials}
    assert laboratory is not None
    for trial in trials:
        if trial.pull is not None and data.rest != "file":
            raise InputError(
                f"laboratory.trials.{trial.name}.pull deforms the body before its release: set data.rest to file, so "
                "that the recordings have the markers on the undeformed body."
            )
    if data.rest == "file" and any(trial.pull is None and trial.begins == "held" for trial in trials):
        raise InputError("data.rest is file, but the simulated bodies are held undeformed: set it to held.")
    if begins & {"held", "released"}:
        for key in ("seconds", "held_seconds"):
            if getattr(laboratory, key) is None:
                raise InputError(f"laboratory.{key} is missing: released trials need it.")
        if (laboratory.seconds or 0.0) < (data.seconds or 0.0):
            raise InputError(
                f"laboratory.seconds is {laboratory.seconds}, less than data.seconds ({data.seconds}): record at "
                "least as long as the data are used."
            )
    if begins & {*RESTING} and data.steps is not None:
        substeps_of(run.time_step, laboratory, "laboratory")
        if drive is not None:
            random = np.random.default_rng(0)
            parts, sequences = len(drive.parts), laboratory.sequences
            draw_inputs(
                sequences, largest_input(data.input_limit, laboratory), data.steps, run.time_step, parts, random
            )
