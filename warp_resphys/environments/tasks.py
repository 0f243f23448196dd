"""Tasks: reach a place, follow a figure, swing up, pick and place.

The largest reward of a step is one.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Final

import numpy as np
from typing_extensions import override

from ..control.task import Path
from ..io.arrays import FloatArray, IntArray
from ..io.errors import InputError

PREVIEW: Final = (0, 2, 5)  # actions ahead of the goals that are observed
_FIGURES: Final = ("circle", "eight", "R", "E", "S")
_LAPS_S: Final = (2.0, 5.0)  # range of the durations of a figure [s]
_OF_REACH: Final = 0.6  # size of a figure, as a share of the reach
LIFT: Final = 0.03  # height by which a ball is lifted before it is put down [m]
_FROM_BALL: Final = (
    0.15  # size of the task to pick and place, about the first distance of the gripper [m]
)
# Ranges of goals from the ball, along and across the arm [m].
_AHEAD, _ASIDE = (-0.04, 0.04), (0.06, 0.12)


@dataclass(frozen=True)
class Reach:
    """Positions of a point of a robot in equilibrium."""

    places: FloatArray  # (S, 3) sampled positions [m]
    actions: FloatArray  # (S, n) of the inputs, from -1 to 1

    @property
    def size(self) -> float:
        """The largest distance of the places from their middle [m]."""
        return float(np.linalg.norm(self.places - self.middle, axis=1).max())

    @property
    def middle(self) -> FloatArray:
        """Mean (3,) of the places [m]."""
        return np.asarray(self.places.mean(axis=0))

    @property
    def plane(self) -> FloatArray:
        """Directions (2, 3) in which the places spread most."""
        directions = np.linalg.svd(self.places - self.middle, full_matrices=False)[2][:2]
        largest = np.abs(directions).argmax(axis=1)
        return np.asarray(directions * np.sign(directions[[0, 1], largest])[:, None])


class RobotTask(ABC):
    """A task of B robots, with a goal for each."""

    size: float  # scale of observed positions [m]
    width: int  # number of observed values of the task

    @abstractmethod
    def begin(self, row: int, random: np.random.Generator) -> None:
        """Begins a new episode of a robot."""

    @abstractmethod
    def observed(self, points: FloatArray, number: IntArray) -> FloatArray:
        """Observed values (B, width) for points (B, 3) [m] after so many actions (B,)."""

    @abstractmethod
    def reward(self, points: FloatArray, number: IntArray) -> FloatArray:
        """Rewards (B,), at most one."""

    @abstractmethod
    def errors_mm(self, points: FloatArray, number: IntArray) -> FloatArray:
        """Distances (B,) of the points from their goals [mm]."""

    @abstractmethod
    def wanted(self, row: int, number: int) -> FloatArray:
        """Goals (K, 3) of a robot from a number of actions on [m]."""


class GoalTask(RobotTask):
    """A task of goals (B, A + 1, 3), at the start and after each of A actions [m].

    The vectors to the next goals are observed; the reward is one minus the distance over the size
    of the reach.
    """

    def __init__(self, count: int, actions: int, reach: Reach) -> None:
        self.goals = np.tile(reach.middle, (count, actions + 1, 1))
        self.reach, self.size = reach, reach.size
        self.width = 3 * len(PREVIEW)

    @override
    def observed(self, points: FloatArray, number: IntArray) -> FloatArray:
        ahead = np.minimum(number[:, None] + np.array(PREVIEW) + 1, self.goals.shape[1] - 1)
        wanted = self.goals[np.arange(len(points))[:, None], ahead]
        return np.asarray(((wanted - points[:, None]) / self.size).reshape(len(points), -1))

    @override
    def errors_mm(self, points: FloatArray, number: IntArray) -> FloatArray:
        now = self.goals[np.arange(len(number)), np.minimum(number, self.goals.shape[1] - 1)]
        return np.asarray(1e3 * np.linalg.norm(points - now, axis=1))

    @override
    def wanted(self, row: int, number: int) -> FloatArray:
        return self.goals[row, min(number, self.goals.shape[1] - 1) :]

    @override
    def reward(self, points: FloatArray, number: IntArray) -> FloatArray:
        return np.asarray(1.0 - 1e-3 * self.errors_mm(points, number) / self.size)


class ReachTask(GoalTask):
    """Reach one of the robot's equilibria quickly, and stay there."""

    @override
    def begin(self, row: int, random: np.random.Generator) -> None:
        self.goals[row] = self.reach.places[random.integers(len(self.reach.places))]


class FollowTask(GoalTask):
    """Follow a figure at a random speed, from a random point of it,
    in the plane in which the robot reaches furthest.

    Args:
        count: B.
        actions: A.
        reach: of the point.
        action_time: of an action [s].
    """

    def __init__(self, count: int, actions: int, reach: Reach, action_time: float) -> None:
        super().__init__(count, actions, reach)
        self._time = action_time

    @override
    def begin(self, row: int, random: np.random.Generator) -> None:
        reach = self.reach
        name = _FIGURES[random.integers(len(_FIGURES))]
        first, second = reach.plane
        spread = np.ptp((reach.places - reach.middle) @ reach.plane.T, axis=0).min()
        size = _OF_REACH * float(spread) * random.uniform(0.5, 1.0)
        curve = Path(name, size, tuple(reach.middle), tuple(first), tuple(second)).points
        curve = np.concatenate([curve, curve[-2::-1]])  # there and back, a closed curve
        laps = (
            self._time * np.arange(self.goals.shape[1]) / random.uniform(*_LAPS_S)
            + random.uniform()
        )
        at = (laps % 1.0) * (len(curve) - 1)
        self.goals[row] = np.stack(
            [np.interp(at, np.arange(len(curve)), column) for column in curve.T], axis=1
        )


class SwingTask(RobotTask):
    """Swing a point up by moving the base.

    The reward is its height above rest over the body's length, up to one.

    Args:
        count: B.
        up: (3,) direction.
        rest: (3,) of the point [m].
        length: of the body [m].
    """

    def __init__(self, count: int, up: FloatArray, rest: FloatArray, length: float) -> None:
        if not length > 0.0:
            raise InputError(
                "swing_up needs a tracked point away from the base: choose others in tracked."
            )
        self._up = up / np.linalg.norm(up)
        self._rest, self._count = rest, count
        self.size, self.width = length, 1

    @override
    def begin(self, row: int, random: np.random.Generator) -> None:
        pass  # All episodes have the same goal.

    def _height(self, points: FloatArray) -> FloatArray:
        return np.asarray((points - self._rest) @ self._up / self.size)

    @override
    def observed(self, points: FloatArray, number: IntArray) -> FloatArray:
        return self._height(points)[:, None]

    @override
    def reward(self, points: FloatArray, number: IntArray) -> FloatArray:
        return np.clip(self._height(points), 0.0, 1.0)

    @override
    def errors_mm(self, points: FloatArray, number: IntArray) -> FloatArray:
        return np.asarray(1e3 * self.size * (1.0 - self._height(points)))

    @override
    def wanted(self, row: int, number: int) -> FloatArray:
        return np.asarray(self._rest + self.size * self._up)[None]


class PlaceTask(RobotTask):
    """Lift a ball from a table, and put it down on a place to one side of where it was.

    Points (B, 6) are the middle of the gripper and that of the ball. With the greatest height g of
    the ball since the episode began, over the height to lift it, and distances d over the size of
    the task, all from 0 to 1, the reward is
    (max(1 - d(gripper, ball), g) + g + g (1 - d(ball, goal))) / 3. The vectors from gripper to ball
    and from ball to goal, and g, are observed.

    Args:
        count: B.
        rest: (3,) where the balls begin [m].
    """

    size, width = _FROM_BALL, 7

    def __init__(self, count: int, rest: FloatArray) -> None:
        self._rest, self._lifted = rest, np.zeros(count)
        self.goals = np.tile(rest, (count, 1))

    @override
    def begin(self, row: int, random: np.random.Generator) -> None:
        side = random.choice([-1.0, 1.0])
        self.goals[row] = self._rest + [
            random.uniform(*_AHEAD),
            side * random.uniform(*_ASIDE),
            0.0,
        ]
        self._lifted[row] = 0.0

    @override
    def observed(self, points: FloatArray, number: IntArray) -> FloatArray:
        gripper, ball = points[:, :3], points[:, 3:]
        to_ball, to_goal = (ball - gripper) / self.size, (self.goals - ball) / self.size
        return np.concatenate([to_ball, to_goal, self._lifted[:, None]], axis=1)

    @override
    def reward(self, points: FloatArray, number: IntArray) -> FloatArray:
        gripper, ball = points[:, :3], points[:, 3:]
        self._lifted = np.clip((ball[:, 2] - self._rest[2]) / LIFT, self._lifted, 1.0)
        near, placed = (
            np.clip(1.0 - np.linalg.norm(ball - other, axis=1) / self.size, 0.0, 1.0)
            for other in (gripper, self.goals)
        )
        return np.asarray(
            (np.maximum(near, self._lifted) + self._lifted + self._lifted * placed) / 3.0
        )

    @override
    def errors_mm(self, points: FloatArray, number: IntArray) -> FloatArray:
        return np.asarray(1e3 * np.linalg.norm(points[:, 3:] - self.goals, axis=1))

    @override
    def wanted(self, row: int, number: int) -> FloatArray:
        return self.goals[row : row + 1]
