"""Rigid motion of the base of a body, and of obstacles: a function of time,
a table, or estimated from markers on it.

A pose (6,) is a translation t [m] and the rotation vector of R [rad]: a point at x before time zero
is at R x + t, for an obstacle from its configured place.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from ..core.energies.contact.contact_points import MOTION
from ..core.energies.contact.obstacle_contact import Contact
from ..core.fem.bodies import Body
from ..io.arrays import FloatArray
from ..io.errors import DataFileError
from ..io.text import read_rows
from ..settings.performed import MotionSettings
from .registration import RigidTransform, kabsch

LARGEST_STEP = 0.2  # of the size of a body
_MILLI = 1e3


def poses_of(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Poses (T, 6) of rotations (T, 3, 3) and translations (T, 3) [m],
    with continuous rotation vectors.
    """
    return np.concatenate(
        [translation, _unwrapped(Rotation.from_matrix(rotation).as_rotvec())], axis=1
    )


def rigid(poses: FloatArray) -> RigidTransform:
    """Rigid motions of poses (T, 6)."""
    return RigidTransform(Rotation.from_rotvec(poses[:, 3:]).as_matrix(), poses[:, :3])


def prescribed(
    motion: MotionSettings, times: ArrayLike, folder: str | Path = ".", scale: float = 1.0
) -> FloatArray:
    """Poses (T, 6) at times (T,) [s] of a configured motion.

    Args:
        motion: a table of poses, see `_table`, or sinusoids, see `_sinusoids`; ``about`` is the
            point of the base, in the frame of the mesh, that the translation refers to and
            rotations leave in place [m].
        times: (T,) [s].
        folder: of a relative path in ``file``.
        scale: of the whole motion.

    Raises:
        DataFileError: the file cannot be read.
    """
    at = np.asarray(times, dtype=np.float64)
    moved = (
        _sinusoids(motion, at)
        if motion.file is None
        else _table(Path(folder).expanduser() / motion.file, at)
    )
    poses, about = scale * moved, np.asarray(motion.about, dtype=np.float64)
    poses[:, :3] += about - Rotation.from_rotvec(poses[:, 3:]).apply(about)
    return np.asarray(poses)


def _sinusoids(motion: MotionSettings, times: FloatArray) -> FloatArray:
    """Poses (T, 6) of a sum of sinusoids, zero at the start.

    Every one of ``swings`` has a ``frequency`` [Hz], amplitudes ``translation`` [m] and
    ``rotation`` [rad] along and about x, y and z, and a ``phase`` [rad]. Nothing moves before
    ``start``, and the amplitudes grow from zero during ``ramp`` after it [s].
    """
    since = np.maximum(times - motion.start, 0.0)
    share = np.clip(since / motion.ramp, 0.0, 1.0) if motion.ramp else np.ones_like(since)
    growth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    poses = np.zeros((len(since), 6))
    for swing in (motion.swings or {}).values():
        wave = growth * (
            np.sin(2.0 * np.pi * swing.frequency * since + swing.phase) - np.sin(swing.phase)
        )
        poses += wave[:, None] * np.concatenate([swing.translation, swing.rotation])
    return poses


def _table(path: Path, times: FloatArray) -> FloatArray:
    """Poses (T, 6) relative to the first line of a table with lines of t [s],
    x, y, z [m], quaternion w, x, y, z.

    Lines that begin with # are comments. Before and after the table, the first and the last pose
    stay.
    """
    try:
        rows = [row for row in read_rows(path) if any(row) and not row[0].startswith("#")]
        table = np.array(rows, dtype=np.float64, ndmin=2)
    except ValueError as error:
        raise DataFileError(f"{path} cannot be read as a table of numbers: {error}.") from error
    if table.shape[1:] != (8,) or len(table) < 4 or not (np.diff(table[:, 0]) > 0.0).all():
        raise DataFileError(
            f"{path} needs four lines or more of t, x, y, z, and a quaternion w, x, y, z, with "
            "commas between them, and times that rise."
        )
    return at_times(
        since_first(table[:, 1:4] - table[0, 1:4], table[:, 4:], path), table[:, 0], times
    )


def since_first(places: ArrayLike, quaternions: ArrayLike, source: str | Path) -> FloatArray:
    """Poses (T, 6) relative to the first frame, from positions (T, 3) of a point [m] and
    quaternions (T, 4), w first.

    Raises:
        DataFileError: a value that is not finite, or a quaternion of no length.
    """
    x, turned = np.asarray(places, dtype=np.float64), np.asarray(quaternions, dtype=np.float64)
    if not (
        np.isfinite(x).all()
        and np.isfinite(turned).all()
        and (np.linalg.norm(turned, axis=1) > 0.0).all()
    ):
        raise DataFileError(
            f"{source}: 'base' needs, in every frame, a place in metres and a quaternion (w, x, "
            "y, z) that is not zero."
        )
    rotations = Rotation.from_quat(turned[:, [1, 2, 3, 0]])
    matrices = (rotations * rotations[0].inv()).as_matrix()
    return poses_of(matrices, x - matrices @ x[0])


def followed(
    markers: FloatArray, still: FloatArray, source: str | Path, what: str = "the base"
) -> FloatArray:
    """Poses (T, 6) of a rigid body from its markers (T, M, 3), NaN where not seen,
    and their rest positions (M, 3) [m].

    Frames with fewer than three seen markers are interpolated; a single marker shows a translation
    alone. A spline smooths the motion (generalised cross-validation), as a body feels the
    acceleration of its base.

    Args:
        markers: of the rigid body.
        still: where they are at rest.
        source: of the markers, for errors.
        what: moves, for errors.

    Raises:
        DataFileError: three or more markers, or the single one, are seen in less than half of the
            frames.
    """
    seen = np.asarray(np.isfinite(markers).all(-1) & np.isfinite(still).all(-1))
    enough = seen.sum(1) >= min(3, len(still))
    if not enough.any() or enough.mean() < 0.5:
        shown, more = (
            ("three of its markers are", ", or give more of them")
            if len(still) > 1
            else ("its marker is", "")
        )
        raise DataFileError(
            f"{source}: {what} moves, and {shown} seen in {100.0 * enough.mean():.0f} % of the "
            f"frames: fill the gaps{more}."
        )
    rotation, translation = np.tile(np.eye(3), (len(markers), 1, 1)), np.zeros((len(markers), 3))
    for frame in np.flatnonzero(enough).tolist():
        if len(still) == 1:
            translation[frame] = markers[frame, 0] - still[0]
            continue
        motion = kabsch(still[seen[frame]], markers[frame, seen[frame]])
        rotation[frame], translation[frame] = motion.rotation, motion.translation
    from scipy.interpolate import make_smoothing_spline

    frames, known = np.arange(len(markers)), np.flatnonzero(enough)
    inside = np.clip(frames, known[0], known[-1])
    turned = Slerp(known, Rotation.from_matrix(rotation[known]))(inside) if len(known) > 1 else None
    matrices = (
        np.broadcast_to(rotation[known[0]], rotation.shape)
        if turned is None
        else turned.as_matrix()
    )
    moved = np.stack([np.interp(frames, known, x) for x in translation[known].T], axis=1)
    poses, at = poses_of(matrices, moved), frames.astype(np.float64)
    if len(poses) < 5:
        return poses
    return np.stack(
        [make_smoothing_spline(at, x)(at) if np.ptp(x) > 0.0 else x for x in poses.T], axis=1
    )


def in_frame(poses: FloatArray, frame: RigidTransform) -> FloatArray:
    """Poses (T, 6) of the motions D in another frame:
    G D G^-1, with G from their frame to the other one.
    """
    motion = rigid(poses)
    turned = frame.rotation @ motion.rotation @ frame.rotation.T
    origin = -frame.rotation.T @ frame.translation
    return poses_of(turned, frame.apply(motion.rotation @ origin + motion.translation))


def at_times(poses: FloatArray, times: NDArray[Any], new: NDArray[Any]) -> FloatArray:
    """Poses (T', 6) at new times, by cubic splines.

    Before and after the frames, the first and the last pose.
    """
    from scipy.interpolate import CubicSpline

    if len(poses) < 2:
        return np.repeat(poses, len(new), axis=0)
    kept = np.clip(new, times[0], times[-1])
    return np.asarray(CubicSpline(times, poses)(kept))


def check_steps(
    poses: FloatArray, points: FloatArray, source: str | Path, what: str = "the base"
) -> None:
    """Checks that poses (K + 1, 6) at the steps of a simulation do not jump,
    for a body of points (N, 3) [m].

    Raises:
        DataFileError: a corner of the body moves by a fifth of its size in a single step.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1), indexing="ij"), axis=-1).reshape(
        -1, 3
    )
    moved = rigid(poses).apply(np.broadcast_to(corners, (len(poses), *corners.shape)))
    steps = np.linalg.norm(np.diff(moved, axis=0), axis=-1).max(axis=1, initial=0.0)
    if len(steps) and steps.max() > LARGEST_STEP * float((high - low).max()):
        raise DataFileError(
            f"{source}: {what} jumps by {_MILLI * steps.max():.0f} mm in step "
            f"{int(steps.argmax()) + 1}, more than a body follows without being torn: check the "
            "unit of the motion, or take a smaller time_step."
        )


def _unwrapped(vectors: FloatArray) -> FloatArray:
    """Rotation vectors (T, 3) of the same rotations, each the nearest one to its predecessor."""
    unwrapped = vectors.copy()
    for row in range(1, len(unwrapped)):
        angle = np.linalg.norm(unwrapped[row])
        if angle > 0.0:
            axis = unwrapped[row] / angle
            turns = np.round((unwrapped[row - 1] @ axis - angle) / (2.0 * np.pi))
            unwrapped[row] = (angle + 2.0 * np.pi * turns) * axis
    return unwrapped


def prescribed_all(
    common: Mapping[str, Any],
    of_trial: Mapping[str, MotionSettings],
    times: NDArray[Any],
    folder: str = ".",
) -> dict[str, FloatArray]:
    """Poses (T, 6) by obstacle at times (T,) [s] of a trial's given motions:
    its own, or common ones, none recorded.
    """
    motions = {
        name: motion
        for name, motion in {**common, **of_trial}.items()
        if isinstance(motion, MotionSettings)
    }
    return {name: prescribed(motion, times, folder) for name, motion in motions.items()}


def contact_inputs(body: Body, motions: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Inputs (..., O) of a body's contact by name, for poses (..., 6) of its obstacles.

    Others stand still.

    The inputs turn an obstacle about its position: p moves to R p + t.
    """
    contact = next(energy for energy in body.energies if isinstance(energy, Contact))
    shape = np.broadcast_shapes(*(poses.shape[:-1] for poses in motions.values()))
    values = np.zeros((len(MOTION), *shape, contact.count))
    for number, (name, obstacle) in enumerate(contact.obstacles.items()):
        if name in motions:
            poses, place = motions[name], np.asarray(obstacle.position)
            moved = (
                rigid(poses.reshape(-1, 6)).apply(
                    np.broadcast_to(place, (poses[..., 0].size, 1, 3))
                )[:, 0]
                - place
            )
            turned = poses[..., 3:]
            values[..., number] = np.moveaxis(
                np.concatenate([moved.reshape(turned.shape), turned], -1), -1, 0
            )
    return {quantity.name: moved_by for quantity, moved_by in zip(MOTION, values, strict=True)}
