"""Motion of obstacles: configured, recorded by a marker or a rigid body, and as inputs of contact.

A motion is a series of poses as in `data.base_motion`, from the configured place of the obstacle: of a translation t
[m] and the rotation vector of R [rad], with which a point at x at time zero is at R x + t.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..energies.contact import MOTION, Contact
from ..fem.body import Body
from ..io.arrays import FloatArray
from ..io.errors import DataFileError
from ..settings.trials import MotionSettings
from .base_motion import followed, prescribed, rigid
from .recordings.recording import Recording


def prescribed_all(
    common: Mapping[str, Any], own: Mapping[str, MotionSettings], times: NDArray[Any], folder: str = "."
) -> dict[str, FloatArray]:
    """Poses (T, 6) by obstacle at times (T,) [s] of a trial's given motions: its own, or common ones, none recorded."""
    motions = {name: motion for name, motion in {**common, **own}.items() if isinstance(motion, MotionSettings)}
    return {name: prescribed(motion, times, folder) for name, motion in motions.items()}


def recorded(recording: Recording, name: str, seconds: float) -> FloatArray:
    """Poses (T, 6) of an obstacle in the frame of a recording, from the marker or rigid body of its name.

    Args:
        recording: with all of its markers.
        name: of the obstacle. A marker shows a translation alone.
        seconds: at the start, in which the obstacle stands at its configured place [s].

    Raises:
        DataFileError: there is no such marker, or it is seen in less than half of the frames, or not at the start.
    """
    if name not in recording.labels:
        raise DataFileError(
            f"{recording.source} has no marker or rigid body {name!r}, which shows the motion of this obstacle: name "
            "it so, or give its motion in data.obstacle_motion."
        )
    arms = [f"{name} +{axis}" for axis in "xyz"]
    shown = recording.select([name, *(arms if {*arms} <= {*recording.labels} else ())])
    first = shown.positions[: max(round(seconds * recording.rate), 1)]
    if not np.isfinite(first).all(-1).any(0).all():
        raise DataFileError(
            f"{recording.source}: {name!r} is not seen in the first {seconds:g} s, while its obstacle stands: start "
            "the recording earlier, or give the motion in data.obstacle_motion."
        )
    return followed(shown.positions, np.nanmedian(first, axis=0), recording.source, f"the obstacle {name!r}")


def contact_inputs(body: Body, motions: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Inputs (..., O) of a body's contact by name, for poses (..., 6) of its obstacles; others stand still.

    The inputs turn an obstacle about its position: p moves to R p + t.
    """
    contact = next(energy for energy in body.energies if isinstance(energy, Contact))
    shape = np.broadcast_shapes(*(poses.shape[:-1] for poses in motions.values()))
    values = np.zeros((len(MOTION), *shape, contact.count))
    for number, (name, obstacle) in enumerate(contact.obstacles.items()):
        if name in motions:
            poses, place = motions[name], np.asarray(obstacle.position)
            moved = rigid(poses.reshape(-1, 6)).apply(np.broadcast_to(place, (poses[..., 0].size, 1, 3)))[:, 0] - place
            turned = poses[..., 3:]
            values[..., number] = np.moveaxis(np.concatenate([moved.reshape(turned.shape), turned], -1), -1, 0)
    return {quantity.name: own for quantity, own in zip(MOTION, values, strict=True)}
