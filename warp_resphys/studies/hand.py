"""A hand of the live view: a sphere that moves, and pushes a robot by contact."""

from dataclasses import replace
from typing import Final

import numpy as np

from ..energies.contact import MOTION
from ..io.errors import InputError
from ..robot.robot import Robot
from ..robot.state import RobotState
from ..settings.obstacles import ContactSettings, SphereSettings

HAND: Final = "hand of the view"
RADIUS: Final = 0.1  # Of the sphere, over the size of the body.
_AWAY: Final = 10.0  # Configured place above the body, where it touches nothing, over the size of the body.
_DISTANCE: Final = 0.05  # At which contact begins, over the thickness of a body without obstacles.
_FRICTION: Final = 0.3
_STIFFNESS: Final = 1e5  # Of the barrier, where the body has no single Young's modulus [Pa].
_SLIP_SPEED: Final = 0.1  # At which friction is fully developed, in sizes of the body a second.


def with_hand(robot: Robot) -> Robot:
    """Returns a robot that touches a sphere, too, which its inputs move; it is stepped by BDF2 in place of midpoint.

    The sphere is the last obstacle, far away at first.

    Raises:
        InputError: a network replaces the simulator or sees where obstacles are; a body or a solver without contact.
    """
    about = robot.description
    if robot.is_data_driven:
        raise InputError("a network in the simulator's place feels no hand: view another model to push it.")
    if about.learned is not None and any(quantity.name in about.seen for quantity in MOTION):
        raise InputError("the learned force sees where the obstacles are, and knows no hand: view model=sysid to push.")
    vertices = robot.simulator.body.mesh.vertices
    size, thickness = (float(choose(np.ptp(vertices, axis=0))) for choose in (np.max, np.min))
    away = vertices.mean(axis=0) + [0.0, 0.0, _AWAY * size]
    sphere = SphereSettings(shape="sphere", radius=RADIUS * size, position=tuple(away.tolist()), moves=True)
    settings = about.settings
    contact = settings.contact
    if not settings.obstacles:
        modulus = np.ravel(robot.parameters.get("youngs_modulus", about.material.constants.get("youngs_modulus", ())))
        stiffness = float(modulus[0]) if len(modulus) == 1 else _STIFFNESS
        contact = ContactSettings(
            stiffness=stiffness,
            friction=_FRICTION,
            distance=_DISTANCE * thickness,
            slip_speed=_SLIP_SPEED * size,
        )
    by_obstacle = {
        key: {**values, HAND: max(values.values())}
        for key in ("stiffness", "friction")
        if isinstance(values := getattr(contact, key), dict)
    }
    changes = {"obstacles": {**settings.obstacles, HAND: sphere}, "contact": contact.model_copy(update=by_obstacle)}
    if settings.integrator == "midpoint":
        changes["integrator"] = "bdf2"
    described = replace(about, settings=settings.model_copy(update=changes))
    return Robot(described, robot.simulator.device, parameters=robot.parameters, folder=robot.folder)


def without_contact(state: RobotState) -> RobotState:
    """Returns a state of which contact remembers no poses: its obstacles count as not having moved."""
    kept = {name: value for name, value in state.body.memory.items() if "contact_" not in name}
    return replace(state, body=replace(state.body, memory=kept))
