"""A body of a MuJoCo model on which a robot is mounted,
and its motion over a step of the robot under a wrench.

A wrench (6,) is a force [N] and a moment about the origin of the robot's base [N m]; a twist (6,)
is the velocity of that origin [m/s] and the angular velocity [rad/s]; both in axes of the world.

In a step H of the robot, the model makes n steps h = H / n under a constant wrench. The robot,
whose velocities are differences of its positions over H, is then ahead of the model by
tau = (n - 1) h / 2: its base is where the body moves to in that time (staggered by half a step, as
Lesoinne and Farhat, AIAA J. 36 (1998) 1754), or else its inertia would act too late and add energy.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..io.arrays import FloatArray
from ..io.errors import ConvergenceError, InputError, did_you_mean, listed, needs_extra
from ..robot.robot_scene import pose_of

_WHOLE: Final = 1e-6  # deviation of the ratio of the time steps from a whole number
_GRAVITY: Final = 0.01  # difference of the strength of gravity between model and robot [m/s^2]
_LARGEST_TILT: Final = 10.0  # of the robot's gravity from the model's [degrees]
_DIGITS: Final = 6  # after the point, of a pose in a message
HERE: Final = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # the pose (6,) of the frame itself


def mujoco_package() -> Any:
    """Returns the package `mujoco`, or raises InputError where it is not installed."""
    with needs_extra("mujoco", "a mount needs"):
        import mujoco
    return mujoco


def _number(model: Any, body: str) -> int:
    """Returns the number of a body, or raises InputError with the names that there are."""
    names = [model.body(number).name for number in range(model.nbody)]
    if body not in names:
        raise InputError(
            f"the model has no body {body!r}{did_you_mean(body, names)}: it has {listed(names)}; "
            "MuJoCo fuses a link on a fixed joint of a URDF with its parent (fusestatic of the "
            "compiler): name the parent, and give the place of the link on it as pose."
        )
    return names.index(body)


def base_pose(model: Any, data: Any, body: str, pose: ArrayLike = HERE) -> FloatArray:
    """Returns the pose (6,) of a robot's base on a body,
    translation [m] and rotation vector [rad], for `Robot.step`.

    Args:
        model: `mujoco.MjModel`.
        data: `mujoco.MjData`, of which ``qpos`` and the poses of mocap bodies count.
        body: name of the body.
        pose: (6,) of the robot's frame in that of the body.

    Raises:
        InputError: no such body, or a pose that is none.
    """
    rotation, shift = pose_of("the robot on its body", pose)
    mujoco, number = mujoco_package(), _number(model, body)
    own = mujoco.MjData(model)
    own.qpos[:] = data.qpos
    own.mocap_pos[:], own.mocap_quat[:] = data.mocap_pos, data.mocap_quat
    mujoco.mj_kinematics(model, own)
    placed = own.body(number)
    turned = placed.xmat.reshape(3, 3)
    return np.concatenate(
        [placed.xpos + turned @ shift, Rotation.from_matrix(turned @ rotation).as_rotvec()]
    )


def _check_movable(model: Any, body: str, pose: ArrayLike) -> None:
    """Raises InputError for a body that no force moves, or that has no mass."""
    number = _number(model, body)
    root = int(model.body_weldid[number])
    if root == 0:
        raise InputError(
            f"the body {body!r} cannot move: mount the robot on one with a joint above it."
        )
    if model.body_mocapid[root] >= 0:
        raise InputError(
            f"the body {body!r} is a mocap body, or fixed to one, which no force moves: give its "
            "pose to the robot as the input base (base_pose), or mount the robot on a body with "
            "a joint above it."
        )
    if model.body_mass[number] > 0.0:
        return
    carrier = number
    while carrier != root and not model.body_mass[carrier] > 0.0:
        carrier = int(model.body_parentid[carrier])
    if not model.body_mass[carrier] > 0.0:
        raise InputError(
            f"the body {body!r} has no mass, so that a force has no effect: give it its mass."
        )
    name, still = model.body(carrier).name, mujoco_package().MjData(model)
    here, there = base_pose(model, still, body, pose), base_pose(model, still, name)
    back = Rotation.from_rotvec(there[3:]).inv()
    turn = back * Rotation.from_rotvec(here[3:])
    inside = np.round([*back.apply(here[:3] - there[:3]), *turn.as_rotvec()], _DIGITS).tolist()
    raise InputError(
        f"the body {body!r} has no mass: mount the robot on {name!r}, to which it is fixed, with "
        f"the pose {inside}."
    )


def _tilt(model: Any, gravity: ArrayLike) -> FloatArray:
    """Returns the least rotation (3, 3) from a robot's gravity (3,) to that of a model [m/s^2],
    none if they are equal.

    Raises:
        InputError: they differ in strength, or in direction by more than `_LARGEST_TILT`.
    """
    down, pull = np.asarray(model.opt.gravity), np.asarray(gravity, dtype=np.float64)
    if np.allclose(pull, down, rtol=0.0, atol=_GRAVITY):
        return np.eye(3)
    axis = _cross(pull, down)
    sine, stronger = float(np.linalg.norm(axis)), float(np.linalg.norm(pull) - np.linalg.norm(down))
    angle = float(np.arctan2(sine, pull @ down))
    if abs(stronger) > _GRAVITY or np.degrees(angle) > _LARGEST_TILT:
        raise InputError(
            f"gravity is {np.round(down, 3).tolist()} m/s^2 in the model and "
            f"{np.round(pull, 3).tolist()} for the robot: give both the same strength, and "
            f"directions in axes of the world that are {_LARGEST_TILT:g} degrees apart at most, "
            "or mount robot.in_gravity(model.opt.gravity)."
        )
    return np.asarray(Rotation.from_rotvec(axis * (angle / max(sine, 1e-300))).as_matrix())


def twist(before: FloatArray, after: FloatArray, time_step: float) -> FloatArray:
    """Returns the mean twists (E, 6) over a step between frames (E, 7),
    places [m] and quaternions, w first.
    """
    (w, v), (a, b) = ((one[:, 3:4], one[:, 4:]) for one in (after, before))
    # Of after times before^-1.
    cosine, turn = w * a + (v * b).sum(1, keepdims=True), a * v - w * b - _cross(v, b)
    sine = np.linalg.norm(turn, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, np.abs(cosine)) * np.sign(cosine)
    turned = turn * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0.0)
    return np.concatenate([after[:, :3] - before[:, :3], turned], axis=1) / time_step


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """The cross products (..., 3) of vectors, ten times as fast as NumPy for a few of them."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


class MountingBody:
    """A body of a MuJoCo model that carries a robot's base.

    Args:
        model: `mujoco.MjModel`.
        body: name of the body.
        pose: (6,) of the robot's frame in that of the body.
        time_step: H of the robot [s], a multiple of the model's.
        gravity: (3,) of the robot [m/s^2]; the robot's frame turns on the body by the tilt from it
            to the model's.

    Attributes:
        gravity: (3,) of the robot in axes of the model's world [m/s^2].

    Raises:
        InputError: MuJoCo is not installed, no such body, one that no force moves or without mass,
            a pose that is none, a time step that is no multiple of the model's, or a gravity unlike
            the model's (`_tilt`).
    """

    def __init__(
        self, model: Any, body: str, pose: ArrayLike, time_step: float, gravity: ArrayLike
    ) -> None:
        self._mujoco = mujoco = mujoco_package()
        if not isinstance(model, mujoco.MjModel):
            raise InputError(
                f"the model is a {type(model).__name__}: "
                "give a mujoco.MjModel, as from `from_xml_path`."
            )
        self.model, self._time_step = model, time_step
        self._body = _number(model, body)
        rotation, self._shift = pose_of("the robot on its body", pose)
        _check_movable(model, body, pose)
        ratio = time_step / model.opt.timestep
        self._substeps = round(ratio)
        if self._substeps < 1 or abs(ratio - self._substeps) > _WHOLE * ratio:
            raise InputError(
                f"the model has steps of {1e3 * model.opt.timestep:g} ms and the robot of "
                f"{1e3 * time_step:g} ms: set model.opt.timestep to that of the robot, or to a "
                "whole part of it."
            )
        tilt = _tilt(model, gravity)
        self.gravity: FloatArray = tilt @ np.asarray(gravity, dtype=np.float64)
        self._turn = Rotation.from_matrix(rotation @ tilt).as_quat(scalar_first=True)
        self._data, self._kind = mujoco.MjData(model), mujoco.mjtState.mjSTATE_INTEGRATION
        self._size = mujoco.mj_stateSize(model, self._kind)
        warnings = mujoco.mjtWarning
        bad = (
            warnings.mjWARN_BADQPOS,
            warnings.mjWARN_BADQVEL,
            warnings.mjWARN_BADQACC,
            warnings.mjWARN_BADCTRL,
        )
        self._unstable = [int(one) for one in bad]

    def state_of(self, data: Any) -> FloatArray:
        """Returns the state (S,) in a `mujoco.MjData`, with its controls and external forces."""
        state = np.empty(self._size)
        self._mujoco.mj_getState(self.model, data, state, self._kind)
        return state

    def data(self, state: FloatArray, wrench: FloatArray) -> Any:
        """Returns a new `mujoco.MjData` in a state (S,) under a wrench (6,),
        with all that MuJoCo computes from it.
        """
        data = self._mujoco.MjData(self.model)
        self._mujoco.mj_setState(self.model, data, state, self._kind)
        self._add(data, wrench)
        self._mujoco.mj_forward(self.model, data)
        return data

    def _add(self, data: Any, wrench: FloatArray) -> None:
        """Adds a wrench (6,) to the external force on the body for the positions in the data."""
        self._mujoco.mj_kinematics(self.model, data)
        self._mujoco.mj_comPos(self.model, data)
        arm = self._origin(data) - data.xipos[self._body]
        data.xfrc_applied[self._body] += np.concatenate(
            [wrench[:3], wrench[3:] + _cross(arm, wrench[:3])]
        )

    def place(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the frame (7,) of the base in a state (S,), see `twist`, and the mobility A
        (6, 6) of the body there.

        A is the change of the mean acceleration of the base over a step per unit of wrench, J
        (M + h D)^-1 J^T with the Jacobian J of the body at the base, the mass matrix M and the
        joints' damping D; without contacts and limits.
        """
        model, data = self.model, self._data
        self._mujoco.mj_setState(model, data, state, self._kind)
        self._mujoco.mj_fwdPosition(model, data)
        jacobian, inertia = self._jacobian(), np.zeros((model.nv, model.nv))
        self._mujoco.mj_fullM(model, data, inertia)
        inertia += model.opt.timestep * np.diag(model.dof_damping)
        return self._ahead(), jacobian @ np.linalg.solve(inertia, jacobian.T)

    def _origin(self, data: Any) -> FloatArray:
        """Returns the place (3,) of the base's origin for the positions in the data [m]."""
        body = self._body
        return np.asarray(data.xpos[body] + data.xmat[body].reshape(3, 3) @ self._shift)

    def _jacobian(self) -> FloatArray:
        """Returns the Jacobian (6, nv) of the base."""
        jacobian = np.zeros((6, self.model.nv))
        self._mujoco.mj_jac(
            self.model, self._data, jacobian[:3], jacobian[3:], self._origin(self._data), self._body
        )
        return jacobian

    def _ahead(self) -> FloatArray:
        """Returns the frame (7,) of the base, tau ahead of the positions in the data."""
        origin = self._origin(self._data)
        turn, swing = np.empty(4), np.empty(4)
        self._mujoco.mju_mulQuat(turn, self._data.xquat[self._body], self._turn)
        if self._substeps > 1:
            moved = (
                0.5
                * (self._substeps - 1)
                * self.model.opt.timestep
                * self._jacobian()
                @ self._data.qvel
            )
            angle = float(np.linalg.norm(moved[3:]))
            self._mujoco.mju_axisAngle2Quat(swing, moved[3:] / max(angle, 1e-300), angle)
            origin, turned = origin + moved[:3], turn.copy()
            self._mujoco.mju_mulQuat(turn, swing, turned)
        return np.concatenate([origin, turn])

    def advance(
        self, state: FloatArray, ctrl: FloatArray | None, wrench: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns the state (S,) and the frame (7,) of the base
        after a step of the robot under a constant wrench (6,).

        Args:
            state: (S,) at its start.
            ctrl: (nu,) controls; None for those in the state.
            wrench: (6,) on the body, beside its external force in the state, which the new state
                has unchanged.

        Raises:
            ConvergenceError: MuJoCo's simulation has become unstable.
        """
        model, data = self.model, self._data
        self._mujoco.mj_setState(model, data, state, self._kind)
        push = data.xfrc_applied[self._body].copy()
        self._add(data, wrench)
        if ctrl is not None:
            data.ctrl[:] = ctrl
        data.warning.number[:] = 0
        self._mujoco.mj_step(model, data, self._substeps)
        if data.warning.number[self._unstable].any():
            raise ConvergenceError(
                "MuJoCo's simulation of the arm became unstable: take shorter steps, or a "
                "heavier mounting body.",
                data.qpos.copy(),
                None,
            )
        data.xfrc_applied[self._body] = push
        after = self.state_of(data)
        self._mujoco.mj_kinematics(model, data)
        self._mujoco.mj_comPos(model, data)
        return after, self._ahead()
