r"""A robot on a body of a MuJoCo model: the body moves the robot's base,
and the robot's reaction acts on the body.

In every step of length H, let a_n be the change over H of the mean twist of the base, and r_n the
wrench with which the base holds the robot. Both programs make one step after the other, and the
body has to feel a reaction that is not known yet. The reaction of the last step in its place is
unstable where the robot is heavier than what the arm feels like at the mounting body (added mass:
Causin, Gerbeau and Nobile, Comput. Methods Appl. Mech. Engrg. 194 (2005) 4506). So the robot's
response to its base is measured once: Z_k (6, 6) is the reaction k steps after a unit of
acceleration in one step. Z_0 is its apparent mass in a step, the Schur complement of its Hessian on
the motions of the base times H^2. The part of the reaction that the accelerations of this step and
of the last K ones explain,

    m_n = sum_k (1 - k / (K + 1))^2 Z_k a_{n-k},        d_n = r_n - m_n,

acts in this step, and the remainder is extrapolated: the body feels the wrench w = -(m_{n+1} + 2
d_n - d_{n-1}), which is solved with MuJoCo's step a(w) and its mobility A = da / dw
(`MountingBody.place`) by a fixed number of iterations

    w <- w - (1 + Z_0 A)^{-1} (w + m(a(w)) + 2 d_n - d_{n-1}).

Then the robot makes its step, one solve, with its base where the body is. The sum of w + r over
steps telescopes to the last change of d less the first one: momentum is exchanged except for H
times that. A rigid robot has the Z_0 of a rigid body, Z_k = 0 and a constant d: the scheme is that
of one rigid body. The weights are convex, so they keep the response passive (Polya's criterion),
while the last terms of a memory that ends abruptly add energy (docs/coupling.md).

Verified by tests/coupling/test_mount.py.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..core.stepping.state import State
from ..io.arrays import BoolArray, Brief, FloatArray
from ..io.errors import InputError, checks_types, listed
from ..robot.actuation import BASE
from ..robot.robot import Robot
from ..robot.robot_scene import RobotScene
from .mounting_body import HERE, MountingBody, twist

_INTEGRATOR: Final = "implicit_euler"  # whose acceleration of the base is a
# Displacement of the first step that measures the response, in sizes of the robot, and turn [rad].
_NUDGE: Final = 1e-4
_WEIGHTS: Final = (1.0 - np.arange(9) / 9.0) ** 2  # (K + 1,) of the response after k steps


@dataclass(frozen=True)
class MountedState(Brief):
    """State of a batch of E robots on their arms; a step makes a new one.

    Attributes:
        arm: (E, S) states of MuJoCo without the wrench, which `Mount.data` turns into
            `mujoco.MjData`.
        robot: state of the robot, or of the scene of robots.
        pose: (E, 6) of the base [m, rad].
        velocity: (E, 6) mean twist of the base over the last step [m/s, rad/s].
        wrench: (E, 6) of the robot on the mounting body in the last step, about the origin of the
            base [N, N m].
        remainder: (E, 2, 6) d of the last step and of the one before [N, N m].
        accelerations: (E, K, 6) a of the last steps, the last one first [m/s^2, rad/s^2].
        response: (E, K + 1, 6, 6) weighted Z_k, in axes of the base [kg, kg m, kg m^2].
    """

    arm: FloatArray
    robot: State
    pose: FloatArray
    velocity: FloatArray
    wrench: FloatArray
    remainder: FloatArray
    accelerations: FloatArray
    response: FloatArray

    def where(self, chosen: BoolArray, other: "MountedState") -> "MountedState":
        """Joins two states: this one where chosen (E,) bool, the other one elsewhere."""
        joined = {}
        for name in ("arm", "pose", "velocity", "wrench", "remainder", "accelerations", "response"):
            mine, theirs = getattr(self, name), getattr(other, name)
            joined[name] = np.where(chosen.reshape(-1, *[1] * (mine.ndim - 1)), mine, theirs)
        return replace(self, robot=self.robot.where(chosen, other.robot), **joined)


class Mount:
    """A robot, or a scene of robots, whose base is on a body of a MuJoCo model.

    The mass of the robot must not be in the model. Objects of a scene stay in the world. A robot
    whose gravity is tilted, as that of recordings which were registered, is turned on the body by
    its tilt, so that it stands on an upright body as it was recorded. External forces in
    `mujoco.MjData.xfrc_applied` act beside the robot's wrench.

    Args:
        robot: with fixed vertices, which are its base; of a scene, all robots.
        model: `mujoco.MjModel`, as MuJoCo reads it from MJCF or URDF; its time step must divide the
            robot's.
        body: name of the mounting body.
        pose: (6,) of the robot's frame in that of the body, translation [m] and rotation vector
            [rad].
        iterations: number of MuJoCo's steps in a step, at least 2; more help where the arm is in
            contact itself.

    Raises:
        InputError: a robot without a base, or with another integrator than implicit Euler; fewer
            than two iterations; or an error of `MountingBody`.
    """

    @checks_types
    def __init__(
        self,
        robot: Robot | RobotScene,
        model: Any,
        body: str,
        pose: ArrayLike = HERE,
        iterations: int = 2,
    ) -> None:
        self._robots = robot.robots if isinstance(robot, RobotScene) else {"the robot": robot}
        loose = [name for name, one in self._robots.items() if BASE not in one.inputs]
        if loose:
            raise InputError(
                f"{listed(loose)} has no fixed vertices: mount a robot that is fixed at its base."
            )
        used = {one.simulator.integrator for one in self._robots.values()}
        if used != {_INTEGRATOR}:
            raise InputError(
                f"the integrator is {listed(sorted(used))}: mount robots of {_INTEGRATOR}, as of "
                f"robot.integrated_by({_INTEGRATOR!r})."
            )
        if iterations < 2:
            raise InputError(f"iterations is {iterations}: give 2 or more.")
        self._iterations, self.time_step = iterations, robot.simulator.time_step
        pull = robot.constants.gravity[0].detach().double().cpu().numpy()
        self._body = MountingBody(model, body, pose, self.time_step, pull)
        if not np.array_equal(self._body.gravity, pull):
            if isinstance(robot, RobotScene):
                raise InputError(
                    f"gravity is {np.round(pull, 3).tolist()} m/s^2 in the scene and "
                    f"{np.round(model.opt.gravity, 3).tolist()} in the model: give the robots of "
                    "the scene poses by which both are the same."
                )
            robot = robot.in_gravity(self._body.gravity)
        self.robot = robot

    @property
    def model(self) -> Any:
        """Returns the `mujoco.MjModel`."""
        return self._body.model

    def data(self, state: MountedState, environment: int = 0) -> Any:
        """Returns a new `mujoco.MjData` of an environment after `mj_forward`,
        to read or to draw the arm.

        Positions and velocities are those at the end of the step that led to the state.
        Accelerations, torques and forces are those at this instant, the beginning of the next step:
        of the controls of the last step, and with the robot's wrench of the last step beside the
        external force on the mounting body in ``xfrc_applied``.
        """
        return self._body.data(state.arm[environment], state.wrench[environment])

    @torch.no_grad()
    def begin(self, data: Any | Sequence[Any], **inputs: Any) -> MountedState:
        """Returns the state with the arm at rest in a pose, and the robot in its equilibrium there.

        The robot's response is measured there, by 7 (K + 1) of its steps.

        Args:
            data: `mujoco.MjData` with the arm's positions, controls and external forces, which
                stay, or one for each of the E environments.
            inputs: constant inputs of the robot by name, as for `Robot.begin`, or by robot of a
                scene.

        Raises:
            InputError: an arm that moves, or an invalid input.
            ConvergenceError: the robot has no equilibrium.
        """
        arms = [*data] if isinstance(data, Sequence) else [data]
        if any(np.any(arm.qvel) for arm in arms):
            raise InputError("the arm moves: begin with qvel = 0.")
        arm = np.stack([self._body.state_of(one) for one in arms])
        frame = np.stack([self._body.place(row)[0] for row in arm])
        pose = _poses(frame)
        start = self._begin(pose, inputs)
        rest = self.robot.simulator.rest_positions
        size = float((rest.amax(0) - rest.amin(0)).max())
        still, columns = self._probe(start, pose, np.zeros(6), inputs), list[FloatArray]()
        for nudge in _NUDGE * np.diag([size] * 3 + [1.0] * 3):
            change = self._probe(start, pose, nudge, inputs) - still
            columns.append(change * self.time_step**2 / nudge.max())
        turn = _turns(frame)[:, None]
        response = _transposed(turn) @ np.stack(columns, axis=-1) @ turn * _WEIGHTS[:, None, None]
        accelerations = np.zeros((len(arm), len(_WEIGHTS) - 1, 6))
        first = still[:, 0]
        return MountedState(
            arm,
            start,
            pose,
            np.zeros_like(pose),
            -first,
            np.stack([first, first], axis=1),
            accelerations,
            response,
        )

    def _probe(
        self, state: State, pose: FloatArray, nudge: FloatArray, inputs: Mapping[str, Any]
    ) -> FloatArray:
        """The reactions (E, K + 1, 6) of steps in which the base moves by a nudge (6,) a step."""
        reactions = []
        for number in range(1, len(_WEIGHTS) + 1):
            moved, turn = pose.copy(), Rotation.from_rotvec(number * nudge[3:])
            moved[:, :3] += number * nudge[:3]
            moved[:, 3:] = (turn * Rotation.from_rotvec(pose[:, 3:])).as_rotvec()
            state = self._step(state, moved, inputs)
            reactions.append(self._reaction(state, moved))
        return np.stack(reactions, axis=1)

    @torch.no_grad()
    def step(
        self, state: MountedState, ctrl: ArrayLike | None = None, **inputs: Any
    ) -> MountedState:
        """Returns the state after one time step of the robot.

        Args:
            state: before the step.
            ctrl: (nu,) or (E, nu) controls of the model's actuators during the step; those of the
                last step if omitted.
            inputs: of the robot by name, as for `Robot.step` without ``base``, or by robot of a
                scene.

        Raises:
            InputError: controls of another shape, an invalid input, or a base that moves too far in
                a step.
            ConvergenceError: the arm or the robot failed.
        """
        count, h = len(state.arm), self.time_step
        controls = self._controls(ctrl, count)
        placed = map(self._body.place, state.arm)
        before, mobility = map(np.stack, zip(*placed, strict=True))
        turn, past = _turns(before)[:, None], state.accelerations
        response = turn @ state.response @ _transposed(turn)
        remainder = 2.0 * state.remainder[:, 0] - state.remainder[:, 1]
        expected = np.einsum("ekij,ekj->ei", response[:, 1:], past) + remainder
        correction = np.linalg.inv(np.eye(6) + response[:, 0] @ mobility)

        def moved(wrench: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
            """Returns arms (E, S), frames (E, 7), twists (E, 6)
            and expected reactions (E, 6) after the step.
            """
            advanced = map(self._body.advance, state.arm, controls, wrench)
            arm, frame = map(np.stack, zip(*advanced, strict=True))
            velocity = twist(before, frame, h)
            return (
                arm,
                frame,
                velocity,
                _times(response[:, 0], (velocity - state.velocity) / h) + expected,
            )

        wrench = state.wrench
        for _ in range(self._iterations - 1):
            wrench = wrench - _times(correction, wrench + moved(wrench)[-1])
        arm, frame, velocity, reaction = moved(wrench)
        pose = _poses(frame)
        robot, acceleration = self._step(state.robot, pose, inputs), (velocity - state.velocity) / h
        remainder = np.stack(
            [remainder + self._reaction(robot, pose) - reaction, state.remainder[:, 0]], axis=1
        )
        lost = robot.lost.cpu().numpy()[:, None, None]  # their arms go on alone
        return replace(
            state,
            arm=arm,
            robot=robot,
            pose=pose,
            velocity=velocity,
            wrench=wrench,
            remainder=np.where(lost, 0.0, remainder),
            accelerations=np.concatenate([acceleration[:, None], past[:, :-1]], axis=1),
            response=np.where(lost[..., None], 0.0, state.response),
        )

    def _controls(self, ctrl: ArrayLike | None, count: int) -> Sequence[FloatArray | None]:
        """Returns the controls of each environment."""
        if ctrl is None:
            return [None] * count
        values, actuators = np.asarray(ctrl, dtype=np.float64), self._body.model.nu
        if values.shape not in ((actuators,), (count, actuators)):
            raise InputError(
                f"ctrl has shape {values.shape}: give ({actuators},) or ({count}, {actuators}) "
                "values for the model's actuators."
            )
        return [*np.broadcast_to(values, (count, actuators))]

    def _begin(self, pose: FloatArray, inputs: Mapping[str, Any]) -> State:
        """Returns the robot's equilibrium with its base at poses (E, 6)."""
        if isinstance(self.robot, RobotScene):
            return self.robot.begin(len(pose), self._by_robot(pose, inputs))
        return self.robot.begin(len(pose), **{**self._checked(inputs), BASE: pose})

    def _step(self, state: State, pose: FloatArray, inputs: Mapping[str, Any]) -> State:
        """Returns the robot's state after a step that brings its base to poses (E, 6)."""
        if isinstance(self.robot, RobotScene):
            return self.robot.step(state, self._by_robot(pose, inputs))
        return self.robot.step(state, **{**self._checked(inputs), BASE: pose})

    @staticmethod
    def _checked(inputs: Mapping[str, Any]) -> Mapping[str, Any]:
        """Returns the inputs of a robot; refuses a pose of its base, which the arm determines."""
        if BASE in inputs:
            raise InputError(
                "base is given, but a mounted robot is where its body is: leave it out."
            )
        return inputs

    def _by_robot(self, pose: FloatArray, inputs: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Returns the inputs of the robots of a scene, with the poses (E, 6) of their bases."""
        assert isinstance(self.robot, RobotScene)
        unknown = [name for name in inputs if name not in self._robots]
        if unknown:
            raise InputError(
                f"there is no robot {unknown[0]!r} in the scene: it has {listed([*self._robots])}."
            )
        return {
            name: {**self._checked(inputs.get(name, {})), BASE: base}
            for name, base in self.robot.bases(pose).items()
        }

    def _reaction(self, state: State, pose: FloatArray) -> FloatArray:
        """Returns the wrench (E, 6) that holds the robot about its base.

        NaN for environments that are lost.
        """
        whole, simulator = np.zeros_like(pose), self.robot.simulator
        scene = isinstance(self.robot, RobotScene)
        for name in self._robots:
            reaction = simulator.reaction(state, name if scene else None)
            wrench = (
                torch.cat([reaction.force, reaction.moment(pose[:, :3])], -1).double().cpu().numpy()
            )
            whole += wrench
        return whole


def _poses(frames: FloatArray) -> FloatArray:
    """Returns the poses (E, 6) of frames (E, 7)."""
    turned = Rotation.from_quat(frames[:, 3:], scalar_first=True).as_rotvec()
    return np.concatenate([frames[:, :3], turned], axis=1)


def _turns(frames: FloatArray) -> FloatArray:
    """Returns matrices (E, 6, 6) from twists or wrenches
    in axes of frames (E, 7) to those in axes of the world.
    """
    turns = np.zeros((len(frames), 6, 6))
    turns[:, :3, :3] = turns[:, 3:, 3:] = Rotation.from_quat(
        frames[:, 3:], scalar_first=True
    ).as_matrix()
    return turns


def _transposed(matrices: FloatArray) -> FloatArray:
    """Returns matrices (E, 6, 6) transposed."""
    return np.swapaxes(matrices, -1, -2)


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Returns the products (E, 6) of matrices (E, 6, 6) and vectors (E, 6)."""
    return (matrices @ vectors[..., None])[..., 0]
