"""Policies for environments: a scripted one, their errors, and training with Stable-Baselines3."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from ..control.polynomials import Polynomial, around
from ..core.linalg.threads import threads_for
from ..coupling.mounting_body import base_pose, mujoco_package
from ..io.arrays import FloatArray
from ..io.errors import InputError, needs_extra
from .arm_world import FLANGE, PALM, ArmWorld
from .tasks import LIFT, GoalTask, Reach
from .vector import AutoresetMode, Observation, RobotVectorEnv

Policy = Callable[[Observation], NDArray[np.float32]]

_UPDATE: Final = 2048  # actions of all robots between updates of the policy, at most
_BATCH: Final = 512  # actions, at most
_NETWORK: Final = 128  # width of the policy's layers
_ORDER: Final = 2  # of the polynomial from actions to equilibria
_EFFORT: Final = (
    3e-3  # weight of squared actions beside the squared distance, for places of size one
)
_CHANGE = 1e-6  # of actions for derivatives
_STILL = 0.1  # observed change of positions in an action
_ARM_SPEED: Final = 0.15  # largest speed of a gripper on an arm [m/s]
_GAIN: Final = 0.3  # share of the way to its next place in an action
_NEAR: Final = 1.2e-3  # distance from a place that is reached [m]
_UNMOVED: Final = 0.02  # observed change of positions of an arm in an action
_RISEN: Final = 0.03  # share of the height to lift a ball at which it is in the air
_END: Final = 1e-3  # distance of the fingers' command from the end of its range
# Gauss-Newton iterations, and the largest change of an action in one
_ITERATIONS, _STRIDE = 16, 0.25


class ScriptedPolicy:
    """Commands the inputs whose equilibrium is nearest to one of the observed goals,
    with a small penalty on effort.

    It is quasi-static: where the robot is slow it is late, and it does not damp vibrations.

    Args:
        environment: with a task of goals.
        ahead: number of the observed goal, 0 for the next one.
        reach: equilibria of the robot; those of the task if omitted.

    Raises:
        InputError: the task has no goals.
    """

    def __init__(
        self, environment: RobotVectorEnv, ahead: int = 0, reach: Reach | None = None
    ) -> None:
        task = environment.task
        if not isinstance(task, GoalTask):
            raise InputError("the scripted policy needs a task with goals: choose reach or follow.")
        reach = task.reach if reach is None else reach
        self._rests = Polynomial.fitted(reach.actions, reach.places / task.size, _ORDER)
        self._rest = environment.rests[0].ravel()
        self._tracked, self._size = environment.tracked, task.size
        self._parts, self._ahead = task.reach.actions.shape[1], ahead

    def __call__(self, seen: Observation) -> NDArray[np.float32]:
        """Returns actions (B, n) for observations (B, width)."""
        width = self._rest.size
        point = (self._rest + self._size * seen[:, :width].astype(np.float64)) @ self._tracked.T
        first = 2 * width + self._parts + 3 * self._ahead
        goal = point + self._size * seen[:, first : first + 3]
        return self._actions(goal / self._size).astype(np.float32)

    def _actions(self, goals: FloatArray) -> FloatArray:
        """Actions (B, n) whose equilibria are closest to goals (B, 3),
        by Gauss-Newton's method within the bounds.
        """
        actions = np.zeros((len(goals), self._parts))
        for _ in range(_ITERATIONS):
            moved = np.stack([self._rests(at) for at in around(actions, _CHANGE)])  # (1 + n, B, 3)
            slope = ((moved[1:] - moved[0]) / _CHANGE).swapaxes(0, 1)  # (B, n, 3)
            matrix = slope @ slope.swapaxes(1, 2) + _EFFORT * np.eye(self._parts)
            force = (slope @ (goals - moved[0])[..., None])[..., 0] - _EFFORT * actions
            # At a bound, and pushed beyond it.
            at_bound = (np.abs(actions) >= 1.0) & (actions * force > 0.0)
            matrix = np.where(
                at_bound[:, :, None] | at_bound[:, None, :], np.eye(self._parts), matrix
            )
            change = np.linalg.solve(matrix, np.where(at_bound, 0.0, force)[..., None])[..., 0]
            actions = np.clip(actions + np.clip(change, -_STRIDE, _STRIDE), -1.0, 1.0)
        return actions


class ScriptedGrasp:
    """Closes a gripper with a share of the range of its input,
    and lifts when its fingers stand still.
    """

    def __init__(self, share: float) -> None:
        self._action = 2.0 * share - 1.0

    def __call__(self, seen: Observation) -> NDArray[np.float32]:
        """Returns actions (B, 2) for observations (B, width)."""
        displacements = (seen.shape[1] - 3) // 2
        command, height = seen[:, -3], seen[:, -2]
        still = np.abs(seen[:, displacements:-3]).max(axis=1) < _STILL
        lifts = (height > -1.0) | (still & (command > self._action - 1e-3))
        return np.stack([np.full(len(seen), self._action), np.where(lifts, 1.0, -1.0)], 1).astype(
            np.float32
        )


class ScriptedPlace:
    """Picks a ball and places it: above the ball, down, close, up, above the goal, down, open, up.

    The observation tells which of these is next. The angles of the joints follow from one Newton
    step with MuJoCo's Jacobian towards the next place of the gripper, which stays upright.

    Args:
        environment: with the task ``pick_and_place``.

    Raises:
        InputError: another task.
    """

    def __init__(self, environment: RobotVectorEnv) -> None:
        world = environment.world
        if not isinstance(world, ArmWorld):
            raise InputError("this policy moves arms: choose pick_and_place.")
        self._world, self._size = world, environment.task.size
        self._longest = _ARM_SPEED * world.time_step * environment.frames

    def __call__(self, seen: Observation) -> NDArray[np.float32]:
        """Returns actions (B, 7) for observations (B, width)."""
        return np.stack([self._act(row) for row in seen.astype(np.float64)]).astype(np.float32)

    def _act(self, seen: FloatArray) -> FloatArray:
        """Returns the action (7,) for an observation (width,)."""
        fingers, angles, lifted = seen[-14], seen[-13:-7], seen[-1]
        to_ball, to_goal = self._size * seen[-7:-1].reshape(2, 3)
        still = float(np.abs(seen[len(seen) // 2 - 7 : -14]).max()) < _UNMOVED
        is_open, is_closed = fingers < _END - 1.0, fingers > 1.0 - _END
        closes = not is_open
        move, up = np.zeros(3), np.array([0.0, 0.0, 1.1 * LIFT])

        def down(way: FloatArray) -> tuple[FloatArray, bool]:
            """Returns the move along a way (3,), first above its end,
            and whether the end is reached.
            """
            above = float(np.linalg.norm(way[:2])) > _NEAR
            return way + above * up, still and not above and abs(float(way[2])) < _NEAR

        if lifted < 1.0 and is_open:
            move, closes = down(to_ball)
        elif lifted < 1.0 and is_closed and (still or lifted > _RISEN):
            move = up
        elif lifted == 1.0 and is_closed:
            aside = (to_ball + to_goal)[:2]  # from the gripper, as a ball sways
            move, arrived = down(np.append(aside, to_goal[2]))
            closes = not arrived
        elif lifted == 1.0:
            closes, move = False, to_ball + up if is_open else move
        return np.append(1.0 if closes else -1.0, self._turned(angles, move))

    def _turned(self, angles: FloatArray, move: FloatArray) -> FloatArray:
        """Returns commands (6,) of joints, now at angles (6,),
        for a part of a move (3,) of the gripper [m].
        """
        world, mujoco = self._world, mujoco_package()
        half, model = 0.5 * (world.high - world.low), world.mount.model
        data, jacobian = mujoco.MjData(model), np.empty((6, model.nv))
        data.qpos[:] = world.low + half * (angles + 1.0)
        mujoco.mj_fwdPosition(model, data)
        pose = base_pose(model, data, FLANGE, PALM)
        mujoco.mj_jac(
            model, data, jacobian[:3], jacobian[3:], pose[:3] + world.held, model.body(FLANGE).id
        )
        move = _GAIN * move
        move *= min(1.0, self._longest / max(float(np.linalg.norm(move)), 1e-12))
        return np.asarray(angles + np.linalg.solve(jacobian, np.append(move, -pose[3:])) / half)


def errors_mm(
    environment: RobotVectorEnv,
    policy: Policy,
    seed: int,
    on_action: Callable[[], None] = lambda: None,
) -> FloatArray:
    """Distances (A, B) of the points from their goals in one episode of B robots [mm].

    NaN after a failure.
    """
    seen, _ = environment.reset(seed=seed)
    errors = np.full((environment.actions, environment.num_envs), np.nan)
    alive = np.ones(environment.num_envs, dtype=np.bool_)
    for number in range(environment.actions):
        seen, _, terminated, _, info = environment.step(policy(seen))
        alive &= ~terminated
        errors[number, alive] = info["error_mm"][alive]
        on_action()
    return errors


def learn(
    environment: RobotVectorEnv,
    steps: int,
    seed: int = 0,
    on_progress: Callable[[int], None] = lambda steps: None,
) -> Any:
    """Trains a policy by proximal policy optimisation (PPO, Schulman et al. 2017),
    with Stable-Baselines3.

    Args:
        environment: with ``autoreset_mode`` SAME_STEP.
        steps: total number of actions of all robots, at least; each robot makes eight or more.
        seed: of the network and of the sampled actions.
        on_progress: called with the number of further actions done.

    Returns:
        A ``stable_baselines3.PPO``; `acting` converts it to a policy.

    Raises:
        InputError: Stable-Baselines3 is not installed, or another reset mode.
    """
    with needs_extra("policies", "learning a policy needs"):
        from stable_baselines3 import PPO
        from stable_baselines3.common.callbacks import BaseCallback

        from .stable_baselines import Robots
    if environment.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
        raise InputError("learning needs an environment with autoreset_mode='SameStep'.")

    class Reports(BaseCallback):
        @override
        def _on_step(self) -> bool:
            on_progress(environment.num_envs)
            return True

    robots = environment.num_envs
    count = max(min(-(-steps // robots), _UPDATE // robots), 8)
    batches = -(-count * robots // _BATCH)
    count = -(-count // batches) * batches  # so that all batches have one size
    with threads_for(_NETWORK):
        model = PPO(
            "MlpPolicy",
            Robots(environment),
            n_steps=count,
            batch_size=count * robots // batches,
            n_epochs=6,
            gamma=0.95,
            learning_rate=5e-4,
            policy_kwargs={"net_arch": [_NETWORK, _NETWORK], "log_std_init": -1.0},
            seed=seed,
            device="cpu",
        )
        return model.learn(steps, Reports())


def load_model(path: Path) -> Any:
    """Loads a ``stable_baselines3.PPO``.

    Raises:
        InputError: Stable-Baselines3 is not installed.
    """
    with needs_extra("policies", "a policy needs"):
        from stable_baselines3 import PPO
    return PPO.load(path, device="cpu")


def acting(model: Any) -> Policy:
    """Returns the deterministic policy of a model of Stable-Baselines3."""

    def act(seen: Observation) -> NDArray[np.float32]:
        with threads_for(_NETWORK):
            return np.asarray(model.predict(seen, deterministic=True)[0], dtype=np.float32)

    return act
