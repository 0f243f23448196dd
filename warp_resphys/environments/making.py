"""Makes environments of a run by the name of a task, and registers the tasks in Gymnasium."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from ..control.plan import tracked_of
from ..control.reduction import reduced_of
from ..control.sampling import driven_input, settle_some
from ..control.worlds import (
    Laboratory,
    ReducedWorld,
    RobotWorld,
    World,
    laboratory_robot,
    laboratory_settings,
)
from ..experiment.build import choose_device
from ..io.arrays import FloatArray
from ..io.errors import InputError
from ..robot.actuation import BASE
from ..robot.loading import load
from ..robot.robot import Robot
from .arm_world import JOINT_SPEED, ArmWorld
from .grippers import RISE, SPEED, GraspWorld
from .tasks import FollowTask, PlaceTask, Reach, ReachTask, RobotTask, SwingTask
from .vector import ActionMapping, RobotVectorEnv, VectorOptions, gym

TASKS: Final = ("reach", "follow", "swing_up", "grasp", "pick_and_place")
WORLDS: Final = ("simulator", "reduced", "laboratory")
_PLACES: Final = 64  # number of equilibria that sample the reachable places
_RISE: Final = 0.1  # time in which an input can go from its least to its greatest value [s]
_NEAR_TIP: Final = 0.9  # distance of tip markers from the fixed vertices, relative to the largest
_SHOWN: Final = 4  # number of observed vertices of a robot without markers
_BASE: Final = 0.01  # travel of a base to either side [m]
_BASE_SPEED: Final = 0.2  # largest speed of a base [m/s]


def make_vector(
    task: str,
    run: str | Path | Robot,
    num_envs: int = 8,
    model: str | None = None,
    world: str = "simulator",
    spread: float = 1.0,
    seconds: float | None = None,
    action_time: float = 0.05,
    noise: float = 5e-5,
    tracked: Sequence[str] | None = None,
    axis: Sequence[float] = (0.0, 0.0, 1.0),
    render_mode: str | None = None,
    autoreset_mode: str | gym.vector.AutoresetMode = gym.vector.AutoresetMode.NEXT_STEP,
    device: str = "cpu",
    seed: int = 0,
    reach: Reach | None = None,
    forces: bool = False,
    squeeze: float = 0.0,
) -> RobotVectorEnv:
    """Makes a vector environment of robots of a run, of a file, or of Python, with a task.

    Args:
        task: ``reach``, ``follow``, ``swing_up``, which moves the base, ``grasp``, by two fingers
            (`GraspWorld`), or ``pick_and_place``, by two fingers on an arm (`ArmWorld`).
        run: the run folder, a file of `Robot.save`, or a robot, which needs ranges of its input if
            it is of `Robot.of`.
        num_envs: B.
        model: of the run; ``resphys`` if omitted.
        world: ``simulator``; ``reduced``, the reduced model, which is fast and has fixed parameters
            (computing it takes minutes if the run has none); or ``laboratory``, the simulation that
            stands in for the real robot.
        spread: variation of the parameters between robots, in standard deviations of their
            identification.
        seconds: duration of an episode; 2 s if omitted, or 5 s for ``pick_and_place``.
        action_time: duration of an action [s], a multiple of the time step.
        noise: standard deviation of the observed markers' coordinates [m]; a laboratory has its
            own.
        tracked: the markers whose mean is the point of the task; those of the tip if omitted.
        axis: along which a base moves.
        render_mode: ``rgb_array`` for pictures as arrays, or None.
        autoreset_mode: as in Gymnasium.
        device: of the simulation.
        seed: of the sampled inputs whose equilibria are the reachable places.
        reach: ``task.reach`` of another environment, so that both have the same goals and the same
            units; sampled from this robot if omitted.
        forces: whether the force that holds each robot or finger at its base is observed.
        squeeze: penalty on the force of fingers beyond the least that holds the ball, over its
            weight.

    Raises:
        InputError: an unknown task or world, or a robot without the input or the forces that the
            task needs.
        DataFileError: the run is missing, unfinished or changed.
    """
    robot, frames = _loaded(task, run, model, world, device, action_time)
    arms = task == "pick_and_place"
    seconds = (5.0 if arms else 2.0) if seconds is None else seconds
    actions, up = max(round(seconds / action_time), 1), _up(robot)
    shown = None if robot.labels else _spread_vertices(robot)
    if task == "swing_up":
        bodies, mapping = _on_bases(robot, num_envs, spread, axis, shown, frames)
    elif task in ("grasp", "pick_and_place"):
        bodies, mapping = _grippers(task, robot, num_envs, world, frames)
    else:
        bodies, mapping = _driven(robot, num_envs, world, spread, shown, seed, frames)
    rest = bodies.markers(bodies.rest)[0]
    # Coordinates of the task among those of the markers.
    last = {"grasp": 3, "pick_and_place": 6}.get(task)
    point = (
        _tip(robot, rest, tracked, shown)
        if last is None
        else np.eye(last, rest.size, rest.size - last)
    )
    goals: RobotTask
    if arms:
        goals = PlaceTask(num_envs, rest[-1])
    elif task in ("grasp", "swing_up"):
        goals = _lift(robot, num_envs, up, point @ rest.ravel(), task == "grasp")
    else:
        reach = _reach(robot, mapping, point, shown, seed) if reach is None else reach
        follows = task == "follow"
        goals = (
            FollowTask(num_envs, actions, reach, action_time)
            if follows
            else ReachTask(num_envs, actions, reach)
        )
    options = VectorOptions(noise, autoreset_mode, render_mode, up, forces, squeeze)
    return RobotVectorEnv(bodies, goals, mapping, point, actions, options)


def _lift(robot: Robot, count: int, up: FloatArray, place: FloatArray, grasps: bool) -> SwingTask:
    """The task to lift a point (3,) from where it rests [m]:
    a ball, or the tip by the length of the body.
    """
    return SwingTask(
        count, up, place, RISE if grasps else float(np.linalg.norm(place - _fixed(robot)))
    )


def _loaded(
    task: str,
    run: str | Path | Robot,
    model: str | None,
    world: str,
    device: str,
    action_time: float,
) -> tuple[Robot, int]:
    """The robot of a run, which must suit the task, and the number of steps of an action."""
    if task not in TASKS:
        raise InputError(f"the task is {task!r}: choose {', '.join(TASKS)}.")
    if world not in WORLDS:
        raise InputError(f"the world is {world!r}: choose {', '.join(WORLDS)}.")
    if isinstance(run, Robot):
        if model not in (None, run.description.model):
            raise InputError(
                f"the model is {model!r}, but the robot is {run.description.model!r}: leave "
                "model out."
            )
        robot = Robot(run.description, choose_device(device), "count", run.parameters, run.folder)
    else:
        robot = load(run, model, device, "count")
    if world == "laboratory" and robot.folder is None:
        raise InputError("only a run folder has a laboratory: choose world simulator or reduced.")
    frames = round(action_time / robot.time_step)
    if frames < 1 or abs(frames * robot.time_step - action_time) > 1e-9:
        raise InputError(
            f"action_time is {action_time:g} s: it must be a multiple of the step of "
            f"{robot.time_step:g} s."
        )
    if task == "swing_up" and (BASE not in robot.inputs or world != "simulator"):
        raise InputError(
            "swing_up moves the base of a simulated robot: choose a robot with fixed vertices."
        )
    return robot, frames


def _on_bases(
    robot: Robot,
    count: int,
    spread: float,
    axis: Sequence[float],
    shown: list[int] | None,
    frames: int,
) -> tuple[World[Any], ActionMapping]:
    """Robots driven by their base along an axis, and the map from actions to its place."""
    along = np.concatenate(
        [np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis), np.zeros(3)]
    )[None]
    bodies = RobotWorld(robot, BASE, count, spread, along, shown)
    most = np.full(1, _BASE)
    return bodies, ActionMapping(-most, most, np.full(1, _BASE_SPEED), np.zeros(1), frames)


def _driven(
    robot: Robot,
    count: int,
    world: str,
    spread: float,
    shown: list[int] | None,
    seed: int,
    frames: int,
) -> tuple[World[Any], ActionMapping]:
    """Robots driven as in the trials of their run, and the map from actions to their input.

    Worlds begin without inputs.
    """
    bodies: World[Any]
    driven = driven_input(robot)
    if world == "reduced":
        bodies = ReducedWorld(reduced_of(robot), count)
    elif world == "simulator":
        bodies = RobotWorld(robot, driven.name, count, spread, shown=shown)
    else:
        assert robot.folder is not None
        settings = laboratory_settings(robot.folder)
        bodies = Laboratory(settings, robot.folder, driven.name, count, seed, "count")
    low, high = np.array(driven.low), np.array(driven.high)
    return bodies, ActionMapping(low, high, (high - low) / _RISE, np.zeros(len(low)), frames)


def _grippers(
    task: str, robot: Robot, count: int, world: str, frames: int
) -> tuple[World[Any], ActionMapping]:
    """Grippers of two fingers each, and the map from actions to their input and height,
    or the angles of their arms.
    """
    driven = driven_input(robot)
    if world == "reduced":
        raise InputError(
            "a grasp needs contact, which reduced models lack: "
            "choose world simulator or laboratory."
        )
    if len(driven.parts) != 1 or BASE not in robot.inputs:
        raise InputError(
            "a grasp needs a finger that is fixed at its base and has one input: this robot has "
            f"{', '.join(driven.parts)}."
        )
    time_step = robot.time_step
    if world == "laboratory":
        assert robot.folder is not None
        robot = laboratory_robot(
            laboratory_settings(robot.folder), upright=True, on_failure="count"
        )
    low, high = np.array(driven.low), np.array(driven.high)
    rate = (high - low) / _RISE
    bodies: World[Any]
    if task == "grasp":
        bodies = GraspWorld(robot, driven.name, count, time_step)
        low, high = np.append(low, 0.0), np.append(high, RISE)
        rate = np.append(rate, SPEED)
    else:
        bodies = arms = ArmWorld(robot, driven.name, count, time_step)
        low, high = np.append(low, arms.low), np.append(high, arms.high)
        rate = np.append(rate, np.full(len(arms.low), JOINT_SPEED))
    return bodies, ActionMapping(low, high, rate, np.zeros(len(low)), frames)


def _reach(
    robot: Robot, mapping: ActionMapping, point: FloatArray, shown: list[int] | None, seed: int
) -> Reach:
    """Samples equilibria of the robot under random inputs within their range."""
    low, high = mapping.low, mapping.high
    shares = np.random.default_rng(seed).random((_PLACES, len(low)))
    shares[0] = 0.0
    with torch.no_grad():
        inputs = {driven_input(robot).name: low + shares * (high - low)}
        q, settled = settle_some(robot, len(shares), **inputs)
        markers = robot.observe(robot.state(q[settled])).double().cpu().numpy()
    markers = markers if shown is None else markers[:, shown]
    return Reach(
        markers.reshape(len(markers), -1) @ point.T, 2.0 * shares[settled.cpu().numpy()] - 1.0
    )


def _up(robot: Robot) -> FloatArray:
    """Direction (3,) against gravity; z without gravity."""
    up = -np.asarray(robot.simulator.gravity, dtype=np.float64)
    return up if up.any() else np.array([0.0, 0.0, 1.0])


def _fixed(robot: Robot) -> FloatArray:
    """Centre (3,) of the fixed vertices [m]."""
    body = robot.simulator.body
    return np.asarray(body.mesh.vertices[body.fixed_vertices].mean(axis=0))


def _spread_vertices(robot: Robot) -> list[int]:
    """Chooses vertices by farthest-point sampling, away from the fixed ones."""
    vertices = robot.simulator.body.mesh.vertices
    nearest = np.linalg.norm(vertices - _fixed(robot), axis=1)
    chosen: list[int] = []
    for _ in range(_SHOWN):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(vertices - vertices[chosen[-1]], axis=1))
    return chosen


def _tip(
    robot: Robot, markers: FloatArray, tracked: Sequence[str] | None, shown: Sequence[int] | None
) -> FloatArray:
    """Matrix (3, 3 M) from markers (M, 3) to the point of the task, the mean of some of them."""
    names = robot.labels or [str(vertex) for vertex in shown or ()]
    far = np.linalg.norm(markers - _fixed(robot), axis=1)
    of_tip = [
        name for name, distance in zip(names, far, strict=True) if distance >= _NEAR_TIP * far.max()
    ]
    return tracked_of(names, of_tip if tracked is None else tracked)


class RobotEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A single robot as a Gymnasium environment, with the arguments of `make_vector`."""

    def __init__(
        self, task: str, run: str | Path | Robot, render_mode: str | None = None, **settings: Any
    ) -> None:
        self._one = make_vector(
            task,
            run,
            1,
            render_mode=render_mode,
            autoreset_mode=gym.vector.AutoresetMode.DISABLED,
            **settings,
        )
        self.observation_space, self.action_space = (
            self._one.single_observation_space,
            self._one.single_action_space,
        )
        self.render_mode = render_mode
        self.metadata = {
            key: value for key, value in self._one.metadata.items() if key != "autoreset_mode"
        }

    @override
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        first = int(self.np_random.integers(2**31)) if seed is None else seed
        return self._one.reset(seed=first)[0][0], {}

    @override
    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        seen, reward, terminated, truncated, info = self._one.step(np.asarray(action)[None])
        first = {"error_mm": float(info["error_mm"][0])}
        return seen[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), first

    @override
    def render(self) -> NDArray[np.uint8] | None:
        pictures = self._one.render()
        return None if pictures is None else pictures[0]

    @override
    def close(self) -> None:
        self._one.close()


def register() -> None:
    """Registers the tasks in Gymnasium, as ``warp_resphys/Reach-v0``,
    ``warp_resphys/Follow-v0`` and so on.
    """
    for task in TASKS:
        name = f"warp_resphys/{''.join(word.capitalize() for word in task.split('_'))}-v0"
        if name not in gym.registry:
            gym.register(
                name,
                entry_point="warp_resphys.environments.making:RobotEnv",
                vector_entry_point="warp_resphys.environments.making:make_vector",
                kwargs={"task": task},
                disable_env_checker=True,
            )
