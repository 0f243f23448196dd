"""Describes a robot that is made of a simulator of Python,
with markers, parameters and ranges of its inputs.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from ..core.dynamics.simulator import Simulator
from ..core.fem.scene import Scene
from ..data.markers import Observation, bind_markers
from ..io.errors import InputError, in_short, listed
from ..learning.identification.search import Identification
from ..learning.observed_motions import Identified
from .description import Description


def description_of(
    simulator: Simulator,
    markers: Observation | Mapping[str, ArrayLike] | None,
    parameters: Identified | Mapping[str, float] | None,
    ranges: Mapping[str, tuple[ArrayLike, ArrayLike]],
    name: str,
) -> Description:
    """Returns the description of a robot; see `Robot.of`.

    Raises:
        InputError: see `Robot.of`.
    """
    if isinstance(simulator.body, Scene):
        raise InputError(
            "the simulator is of a scene: give a Simulator of one body; "
            "RobotScene joins several robots."
        )
    known, mesh = Identified.of(parameters), simulator.body.mesh
    if isinstance(markers, Mapping):
        markers = bind_markers(mesh, np.array([*markers.values()], dtype=np.float64), [*markers])
    if markers is not None and not markers.labels:
        raise InputError(
            f"markers is {in_short(markers)} without labels: give places by label, or bind_markers."
        )
    return Description(
        name=name,
        model="sysid" if known.parameters else "simulation",
        settings=None,
        material=None,
        mesh=mesh,
        parameters=dict(known.parameters),
        uncertainty=known.uncertainty if isinstance(known, Identification) else None,
        labels=() if markers is None else tuple(markers.labels),
        placement=known.placement,
        actuator=known.actuator,
        seen={key: _range_of(simulator, key, limits) for key, limits in ranges.items()},
        built=simulator,
        observation=markers,
    )


def _range_of(
    simulator: Simulator, name: str, limits: tuple[ArrayLike, ArrayLike]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The least and the greatest value of each part of an input, given as numbers or by part."""
    if name not in simulator.inputs:
        raise InputError(
            f"ranges has no input of the body in {name!r}: it has {listed([*simulator.inputs])}."
        )
    count = simulator.counts[name]
    try:
        low, high = (np.broadcast_to(np.asarray(end, dtype=np.float64), (count,)) for end in limits)
    except (TypeError, ValueError):
        low = high = np.zeros(count)
    if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        unit = simulator.inputs[name].unit
        raise InputError(
            f"ranges.{name} is {limits!r}: give the least and the greatest value in "
            f"{unit or 'shares'}, numbers or one for each of its {count} parts."
        )
    return tuple(low.tolist()), tuple(high.tolist())
