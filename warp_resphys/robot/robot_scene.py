"""Robots, and things that they touch, in one scene."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..core.dynamics.frames import carried_rest
from ..core.dynamics.simulator import Simulator
from ..core.energies.contact.surface_contact import SurfaceContact
from ..core.energies.materials import Material
from ..core.fem.bodies import Body
from ..core.fem.scene import Scene
from ..core.stepping.inputs import Inputs
from ..core.stepping.state import State
from ..data.base_motion import in_frame
from ..data.registration import RigidTransform
from ..io.arrays import FloatArray
from ..io.errors import InputError, checks_types
from ..learning.parameters import constants_of
from .actuation import Given
from .robot import Robot

_OWNER: Final = "robot_{}"  # of memory variables of a robot, by its name
_SAME_GRAVITY: Final = 1e-3  # [m/s^2]


class RobotScene:
    """Robots with their learned forces, and other bodies, in one simulator, where they touch.

    A robot's force was learned on the robot alone. It acts in the robot's own frame, from which a
    pose leads to the scene. All robots have the same time step, integrator and gravity, turned by
    their poses.

    Args:
        robots: robots by name, and their poses (6,): translation [m] and rotation vector [rad].
        objects: other bodies by name, with their materials, or rigid bodies alone; they begin at
            rest.
        contact: of all surfaces with one another; None for none.
        relative_tolerance: of the solver; that of the first robot if omitted.

    Raises:
        InputError: no robot, one whose network replaces the simulator, robots of different time
            steps or gravity, a name that stands for two bodies, a pose that is none, or a body that
            cannot touch others (`energies.contact.surface_contact.SurfaceContact`).

    Attributes:
        scene: the bodies.
        simulator: of the scene.
        constants: of the simulator, with the robots' identified parameters.
    """

    @checks_types
    def __init__(
        self,
        robots: Mapping[str, tuple[Robot, ArrayLike]],
        objects: Mapping[str, Body | tuple[Body, Material]] | None = None,
        contact: SurfaceContact | None = None,
        relative_tolerance: float | None = None,
    ) -> None:
        if not robots:
            raise InputError("a scene of robots has no robot: give them by name, with their poses.")
        self.robots, self._poses = dict[str, Robot](), dict[str, tuple[FloatArray, FloatArray]]()
        for name, placed in robots.items():
            if not (
                isinstance(placed, tuple) and len(placed) == 2 and isinstance(placed[0], Robot)
            ):
                raise InputError(
                    f"{name} is {placed!r}: give a robot and its pose, "
                    "as in (robot, (x, y, z, 0, 0, 0))."
                )
            self.robots[name], self._poses[name] = placed[0], pose_of(name, placed[1])
            if placed[0].is_data_driven:
                raise InputError(
                    f"{name} has no simulator, only a network for its mesh: load another model."
                )
            if name in (objects or {}):
                raise InputError(f"{name} is a robot and an object: give them different names.")
        first = next(iter(self.robots.values())).simulator
        others = {
            name: (robot.simulator.time_step, robot.simulator.integrator)
            for name, robot in self.robots.items()
        }
        if len(set(others.values())) > 1:
            these = [f"{name} {1e3 * h:g} ms and {scheme}" for name, (h, scheme) in others.items()]
            raise InputError(
                "robots of a scene have one time step and integrator, these have "
                f"{', '.join(these)}."
            )
        bodies, materials = dict[str, Body](), dict[str, Any]()
        for name, robot in self.robots.items():
            self._check_fibres(name)
            body = robot.simulator.body.moved(*self._poses[name])
            energies = [
                energy
                for energy in body.energies
                if contact is None or not isinstance(energy, SurfaceContact)
            ]
            bodies[name], materials[name] = (
                replace(body, energies=energies),
                robot.simulator.material,
            )
        for name, thing in (objects or {}).items():
            if isinstance(thing, Body):
                bodies[name] = thing
            else:
                bodies[name], materials[name] = thing
        self.scene = Scene(bodies, contact)
        self.simulator: Simulator = replace(
            first,
            body=self.scene,
            material=materials,
            gravity=self._gravity(),
            solver=first.settings,
            relative_tolerance=relative_tolerance,
        )
        tensor = self.simulator.tensor
        self._frames = {
            name: (tensor(rotation), tensor(shift))
            for name, (rotation, shift) in self._poses.items()
        }
        parameters = dict[str, torch.Tensor]()
        for name, robot in self.robots.items():
            identified = constants_of(robot.simulator, robot.parameters)
            parameters |= {
                f"{name}_{key}": value for key, value in identified.items() if key != "gravity"
            }
        self.constants = self.simulator.prepare(parameters)

    def _gravity(self) -> tuple[float, ...]:
        """Gravity (3,) of the scene [m/s^2], with the identified tilt of the robots' gravity."""
        pulls = {}
        for name, robot in self.robots.items():
            pulls[name] = (
                self._poses[name][0] @ robot.constants.gravity[0].detach().double().cpu().numpy()
            )
        first, pull = next(iter(pulls.items()))
        for name, other in pulls.items():
            if not np.allclose(other, pull, atol=_SAME_GRAVITY):
                raise InputError(
                    f"gravity of {first} is {np.round(pull, 3).tolist()} m/s^2 in the scene, and "
                    f"that of {name} {np.round(other, 3).tolist()}: "
                    "give poses by which they are the same."
                )
        return tuple(pull.tolist())

    def _check_fibres(self, name: str) -> None:
        """Raises InputError for a turned robot whose material has fibres."""
        turned = not np.allclose(self._poses[name][0], np.eye(3))
        if turned and any(
            getattr(one, "fibres", ()) for one in self.robots[name].simulator.materials.values()
        ):
            raise InputError(
                f"the material of {name} has fibres, whose directions would have to turn with "
                "it: give it a pose without rotation."
            )

    def begin(
        self, batch: int = 1, inputs: Mapping[str, Mapping[str, Given]] | None = None
    ) -> State:
        """Returns the state with every robot in its equilibrium on its own,
        and objects at rest in their places.

        Args:
            batch: B.
            inputs: constant inputs by robot and by name, as for `Robot.step`.

        Raises:
            InputError: an unknown robot, or an invalid input.
            ConvergenceError: a robot has no equilibrium.
        """
        by_robot = self._checked(inputs)
        rest, states = self.simulator.rest_state(batch), dict[str, State]()
        parts = []
        for name, _, _ in self.scene.members:
            at = self.scene.vertex_slice(name)
            if name in self.robots:
                states[name] = self.robots[name].begin(batch, **by_robot.get(name, {}))
                parts.append(self._placed(name, states[name].q))
            else:
                parts.append(rest.q[:, at])
        return self._with_robots(self.simulator.state(torch.cat(parts, 1)), states)

    def step(self, state: State, inputs: Mapping[str, Mapping[str, Given]] | None = None) -> State:
        """Returns the state after one time step; differentiable.

        Args:
            state: before the step.
            inputs: during the step by robot and by name, as for `Robot.step`; omitted ones are
                zero.

        Raises:
            InputError: an unknown robot, an invalid input, or surfaces that cross.
            ConvergenceError: the step failed.
        """
        by_robot, by_body = self._checked(inputs), dict[str, Inputs]()
        after = dict[str, Callable[[State], State]]()
        for name, robot in self.robots.items():
            acting, after[name] = robot.drive(self.state_of(state, name), **by_robot.get(name, {}))
            by_body[name] = self._inputs_in_scene(name, acting)
        if any(acting_on.fixed_positions is not None for acting_on in by_body.values()):
            for name, body, first in self.scene.members:
                acting_on = by_body.get(name, Inputs())
                if acting_on.fixed_positions is None and len(body.fixed_vertices):
                    places = self.simulator.rest_positions[first + body.fixed_vertices]
                    by_body[name] = acting_on.replace(
                        fixed_positions=places.expand(state.batch, -1, -1)
                    )
        acting_on_all = self.scene.inputs(by_body)
        new = self.simulator.step(state, acting_on_all, self.constants)
        lost = state.lost | ~new.converged
        if bool(lost.any()):
            resting = self.simulator.rest_state(state.batch)
            if acting_on_all.fixed_positions is not None:
                resting = replace(
                    resting, q=carried_rest(self.scene, acting_on_all.fixed_positions)
                )
            new = resting.where(lost, new)
        new = new.with_memory({"lost": lost})
        return self._with_robots(
            new, {name: after[name](self._in_frame(name, new)) for name in self.robots}
        )

    def state_of(self, state: State, name: str) -> State:
        """Returns the state of a robot in its frame,
        without the memory of its materials, as for `Robot.observe`.
        """
        return self._in_frame(name, state).with_memory(state.memory_of(_OWNER.format(name)))

    def observe(self, state: State) -> dict[str, torch.Tensor]:
        """Returns markers (B, M, 3) of the robots in the frame of the scene, by name [m]."""
        return {
            name: self._placed(name, robot.observe(self.state_of(state, name)))
            for name, robot in self.robots.items()
        }

    def bases(self, pose: ArrayLike) -> dict[str, FloatArray]:
        """Returns the input ``base`` of every robot by name,
        if one body that carries all of them moves.

        Args:
            pose: (B, 6) of that body, which was at the origin of the scene [m, rad].
        """
        moved = np.atleast_2d(np.asarray(pose, dtype=np.float64))
        return {
            name: in_frame(moved, RigidTransform(r.T, -r.T @ t))
            for name, (r, t) in self._poses.items()
        }

    def _checked(
        self, inputs: Mapping[str, Mapping[str, Given]] | None
    ) -> Mapping[str, Mapping[str, Given]]:
        by_robot = inputs or {}
        for name in by_robot:
            if name not in self.robots:
                raise InputError(
                    f"there is no robot {name!r} in the scene: it has {', '.join(self.robots)}."
                )
        return by_robot

    def _placed(self, name: str, points: torch.Tensor) -> torch.Tensor:
        """Positions (..., 3) in the scene, from those in a robot's own frame [m]."""
        rotation, shift = self._frames[name]
        return points @ rotation.mT + shift

    def _in_frame(self, name: str, body: State) -> State:
        """Positions and velocities of a robot in its frame."""
        (rotation, shift), at = self._frames[name], self.scene.vertex_slice(name)
        return State((body.q[:, at] - shift) @ rotation, body.v[:, at] @ rotation)

    @staticmethod
    def _with_robots(state: State, robots: Mapping[str, State]) -> State:
        """Adds the memory of the robots' actuators and networks to a state."""
        for name, of_robot in robots.items():
            state = state.with_memory(
                {**of_robot.memory_of(), "lost": state.lost}, _OWNER.format(name)
            )
        left = torch.stack([of_robot.left for of_robot in robots.values()]).any(0)
        return state.with_memory({"lost": state.lost, "left": left})

    def _inputs_in_scene(self, name: str, inputs: Inputs) -> Inputs:
        fields: dict[str, torch.Tensor | None] = {}
        for key in ("external_force", "internal_force"):
            force = inputs.fields.get(key)
            if force is not None:
                fields[key] = force @ self._frames[name][0].mT
        if inputs.fixed_positions is not None:
            fields["fixed_positions"] = self._placed(name, inputs.fixed_positions)
        return inputs.replace(**fields)


def pose_of(name: str, pose: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Returns rotation (3, 3) and translation (3,) [m] of a pose (6,),
    or raises InputError for one that is none.
    """
    try:
        values = np.asarray(pose, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (6,) or not np.isfinite(values).all():
        raise InputError(
            f"the pose of {name} is {pose!r}: give six numbers, "
            "a translation in m and a rotation vector."
        )
    return Rotation.from_rotvec(values[3:]).as_matrix(), values[:3]
