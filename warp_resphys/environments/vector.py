"""The vector environment: B robots that take actions and return markers,
rewards and ends of episodes; its pictures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ..control.worlds import World
from ..core.energies.contact.obstacle_surface import ObstacleSurface
from ..core.stepping.rollout import states
from ..data.camera import frame_of, side_axes
from ..io.arrays import BoolArray, FloatArray, IntArray
from ..io.errors import InputError, needs_extra
from ..report.layers import INK, Layer, RenderScene, View, body_layers, chain, obstacle_layers
from ..report.render import Pixels, Renderer
from .tasks import RobotTask

with needs_extra("environments", "environments need"):
    import gymnasium as gym
    from gymnasium.vector import AutoresetMode as AutoresetMode
    from gymnasium.vector import VectorEnv

Observation = NDArray[np.float32]

RENDER_MODES: Final = ("rgb_array",)
_LOST: Final = -10.0  # reward of a failed simulation
_SMOOTH: Final = 0.05  # penalty on the mean square change of the inputs, as shares of their ranges
_SIZE: Final = (480, 480)  # px
_TURN, _TILT = np.radians(-35.0), np.radians(20.0)  # azimuth and elevation of the camera
_MARGIN: Final = 0.12  # around the scene, relative to its longer side
_GOAL: Final = "#d1495b"
CARRIER: Final = "#d9dde2"  # of rigid bodies that carry robots
_RADII: Final = {"marker": 0.015, "goal": 0.022}  # relative to half the height of the picture
_BEFORE: Final = {"goals": 4.0, "markers": 5.0}  # shift towards the camera, in the same units


@dataclass(frozen=True)
class ActionMapping:
    """Map from actions to the input of a world."""

    low: FloatArray  # (n,) of the input, at actions of -1
    high: FloatArray  # (n,) of the input, at actions of 1
    rate: FloatArray  # (n,) largest change of the input per second
    start: FloatArray  # (n,) of the input before the first action
    frames: int  # number of simulation steps of an action


@dataclass(frozen=True)
class VectorOptions:
    """Options of a vector environment: observation, resets and drawing.

    Attributes:
        noise: standard deviation of observed coordinates [m], if the world has none.
        autoreset_mode: when episodes are reset, as in Gymnasium.
        render_mode: ``rgb_array`` for pictures, or None.
        up: (3,) upward direction of the pictures.
        forces: whether the forces at the bases are observed (`World.forces`).
        squeeze: penalty on the force of fingers beyond what they need (`World.squeeze`).
    """

    noise: float = 0.0
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP
    render_mode: str | None = None
    up: ArrayLike = (0.0, 0.0, 1.0)
    forces: bool = False
    squeeze: float = 0.0


class RobotVectorEnv(VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """B robots with one task, whose episodes end and begin independently.

    An observation contains the displacements of the M markers from rest, divided by the size of the
    task; their changes since the last action; the current inputs, from -1 to 1; the observed values
    of the task; and forces, if they are observed. An action gives target values of the inputs, from
    -1 to 1, which are approached at their largest rate.

    Args:
        world: the simulated bodies.
        task: of the robots.
        mapping: from actions to the input of the world.
        tracked: (3, 3 M) from the markers to the point of the task, or (6, 3 M) to its two points.
        actions: number A of actions of an episode.
        options: what is observed, reset and drawn.

    Attributes:
        actions: A.
        frames: number of simulation steps of an action.
        task: of the robots.
        tracked: (3, 3 M) or (6, 3 M).
        world: the simulated bodies.
        state: of the world.
        rests: (B, M, 3) markers at the beginning of the episodes [m].

    Raises:
        InputError: an unknown render mode, or forces that the world does not have.
    """

    def __init__(
        self,
        world: World[Any],
        task: RobotTask,
        mapping: ActionMapping,
        tracked: FloatArray,
        actions: int,
        options: VectorOptions = VectorOptions(),
    ) -> None:
        if options.render_mode not in (None, *RENDER_MODES):
            raise InputError(
                f"render_mode is {options.render_mode!r}: choose rgb_array, for pictures as arrays."
            )
        self.world, self.task = world, task
        self._mapping, self.tracked = mapping, tracked
        self.actions, self.frames = actions, mapping.frames
        self._noise = options.noise if world.noise is None else world.noise
        self.num_envs, self.render_mode = world.count, options.render_mode
        self._mode = AutoresetMode(options.autoreset_mode)
        rate = round(1.0 / (world.time_step * mapping.frames))
        self.metadata = {
            "render_modes": [*RENDER_MODES],
            "render_fps": rate,
            "autoreset_mode": self._mode,
        }
        self._up = np.asarray(options.up, dtype=np.float64)
        self._camera: Camera | None = None
        self.state = world.rest
        self.rests = world.markers(self.state)
        self._forces, self._squeeze = options.forces, options.squeeze
        width = 2 * self.rests[0].size + world.parts + task.width
        width += world.forces(self.state).shape[1] if options.forces else 0
        if options.squeeze:
            world.squeeze(self.state)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (width,), np.float32)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (world.parts,), np.float32)
        self.observation_space = gym.vector.utils.batch_space(
            self.single_observation_space, world.count
        )
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, world.count)
        self._random: list[np.random.Generator] | None = None
        self._commands = np.tile(mapping.start, (world.count, 1))
        self._number = np.zeros(world.count, dtype=np.int64)
        self._over = np.zeros(world.count, dtype=np.bool_)
        self._seen = self._before = self.rests

    @override
    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | IntArray | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins new episodes of all robots, with newly drawn parameters, or of those in
        ``options["reset_mask"]``.

        Args:
            seed: of the first robot, followed by the next integers for the others; or a seed for
                each robot. Robots that the mask leaves out keep their random numbers.
            options: ``reset_mask``, (B,) bool.

        Raises:
            InputError: a mask of another shape or type, or seeds that are none.
        """
        count, mask = self.num_envs, (options or {}).get("reset_mask")
        chosen = np.ones(count, dtype=np.bool_) if mask is None else np.asarray(mask)
        if chosen.shape != (count,) or chosen.dtype != np.bool_:
            raise InputError(f"reset_mask must be a boolean array of shape ({count},).")
        if seed is not None or self._random is None:
            drawn = _generators(seed, count)
            kept = drawn if self._random is None else self._random
            self._random = [
                new if begins else old for new, old, begins in zip(drawn, kept, chosen, strict=True)
            ]
        if chosen.all():
            self.world.vary(self._random)
        self._begin(chosen)
        return self._observed(), {}

    def _begin(self, chosen: BoolArray) -> None:
        assert self._random is not None
        self.state = self.world.rest.where(chosen, self.state)
        for row in np.flatnonzero(chosen):
            self.task.begin(int(row), self._random[row])
        self._commands[chosen] = self._mapping.start
        self._number[chosen], self._over[chosen] = 0, False
        rows = chosen[:, None, None]
        self.rests = np.where(rows, self.world.markers(self.state), self.rests)
        seen = self._cameras(chosen)
        self._seen, self._before = (
            np.where(rows, seen, self._seen),
            np.where(rows, seen, self._before),
        )

    def _cameras(self, chosen: BoolArray) -> FloatArray:
        """Observed markers (B, M, 3) [m], with noise for the chosen robots."""
        assert self._random is not None
        markers = self.world.markers(self.state).copy()
        if self._noise:
            for row in np.flatnonzero(chosen):
                markers[row] += self._noise * self._random[row].standard_normal(markers[row].shape)
        return markers

    @property
    def _points(self) -> FloatArray:
        """Points (B, 3) or (B, 6) of the task, without noise [m]."""
        return np.asarray(
            self.world.markers(self.state).reshape(self.num_envs, -1) @ self.tracked.T
        )

    def _errors(self) -> FloatArray:
        """Distances (B,) of the points from their current goals [mm]."""
        return self.task.errors_mm(self._points, self._number)

    @override
    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Returns B pictures (H, W, 3) of robots, markers and goals; None without a render mode.

        Raises:
            InputError: the environment was not reset.
            DrawingError: this machine cannot render.
        """
        if self.render_mode is None:
            return None
        if self._random is None:
            raise InputError(
                "the environment was not reset: call env.reset(seed=...) before env.render()."
            )
        triangles, vertices = self.world.bodies(self.state)
        rigid = self.world.rigid(self.state)
        markers, number = self.world.markers(self.state), self._number
        wanted = [self.task.wanted(row, int(number[row])) for row in range(self.num_envs)]
        if self._camera is None:
            # The frame of the first robot, with the size of the task to all sides.
            middle = np.concatenate([self.rests[0], vertices[0]]).mean(axis=0)
            around = np.concatenate([-np.eye(3), np.eye(3)]) * self.task.size
            ways = np.stack([np.zeros(3), self.world.travel])[:, None]
            seen = np.concatenate(
                [self.rests[0], *(vertices[0] + ways), rigid[1][0], *wanted, middle + around]
            )
            self._camera = Camera(self._up, seen, self.world.obstacles())
        errors = self._errors()
        seconds = number * self.world.time_step * self._mapping.frames
        texts = [f"{at:.2f} s, {error:.1f} mm" for at, error in zip(seconds, errors, strict=True)]
        return tuple(self._camera.pictures(triangles, vertices, markers, wanted, texts, rigid))

    @override
    def close_extras(self, **kwargs: Any) -> None:
        """Ends the rendering process."""
        if self._camera is not None:
            self._camera.close()

    def _observed(self) -> Observation:
        count, size = self.num_envs, self.task.size
        off, moved = (
            (self._seen - start).reshape(count, -1) / size for start in (self.rests, self._before)
        )
        mapping = self._mapping
        commands = 2.0 * (self._commands - mapping.low) / (mapping.high - mapping.low) - 1.0
        task = self.task.observed(self._seen.reshape(count, -1) @ self.tracked.T, self._number)
        parts = [
            off,
            5.0 * moved,
            commands,
            task,
            *([self.world.forces(self.state)] if self._forces else []),
        ]
        return np.concatenate(parts, axis=1).astype(np.float32)

    @override
    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Makes an action of each robot.

        Args:
            actions: (B, n) from -1 to 1.

        Raises:
            InputError: the environment was not reset, or the actions have another shape or are not
                finite.
        """
        if self._random is None:
            raise InputError(
                "the environment was not reset: call env.reset(seed=...) before env.step(...)."
            )
        chosen, mapping = np.asarray(actions, dtype=np.float64), self._mapping
        if chosen.shape != (self.num_envs, self.world.parts) or not np.isfinite(chosen).all():
            raise InputError(
                f"actions have shape {chosen.shape}: give finite values of shape "
                f"{(self.num_envs, self.world.parts)}, from -1 to 1."
            )
        beginning = (
            self._over.copy()
            if self._mode is AutoresetMode.NEXT_STEP
            else np.zeros_like(self._over)
        )
        if self._mode is AutoresetMode.DISABLED and self._over.any():
            raise InputError(
                "an episode is over: reset it with options={'reset_mask': ...} before the next "
                "step."
            )
        wanted = mapping.low + 0.5 * (np.clip(chosen, -1.0, 1.0) + 1.0) * (
            mapping.high - mapping.low
        )
        last, frames = self._commands.copy(), np.arange(1, mapping.frames + 1)[:, None, None]
        most = mapping.rate * self.world.time_step * frames
        commands = last + np.clip(wanted - last, -most, most)  # (F, B, n)
        *_, self.state = states(self.world.step, self.state, commands)
        self._commands = commands[-1]
        lost = self.world.lost(self.state)
        self._number += 1
        self._before, self._seen = self._seen, self._cameras(np.ones_like(lost))
        changed = (self._commands - last) / (mapping.high - mapping.low)
        rewards = self.task.reward(self._points, self._number) - _SMOOTH * np.square(changed).mean(
            axis=1
        )
        if self._squeeze:
            rewards = rewards - self._squeeze * self.world.squeeze(self.state)
        rewards = np.where(lost, _LOST, rewards)
        terminated, truncated = lost.copy(), (self._number >= self.actions) & ~lost
        infos: dict[str, Any] = {"error_mm": self._errors()}
        if beginning.any():
            self._begin(beginning)
            rewards = np.where(beginning, 0.0, rewards)
            terminated, truncated = terminated & ~beginning, truncated & ~beginning
            infos["error_mm"] = np.where(beginning, self._errors(), infos["error_mm"])
        self._over = terminated | truncated
        if self._mode is AutoresetMode.SAME_STEP and self._over.any():
            over, last_seen = self._over.copy(), self._observed()
            final = np.empty(self.num_envs, dtype=object)
            for row in np.flatnonzero(over):
                final[row] = last_seen[row]
            infos |= {"final_obs": final, "_final_obs": over}
            infos |= {
                "final_info": {"error_mm": infos["error_mm"], "_error_mm": over},
                "_final_info": over,
            }
            self._begin(over)
        return self._observed(), rewards, terminated, truncated, infos


def _generators(
    seed: int | Sequence[int | None] | IntArray | None, count: int
) -> list[np.random.Generator]:
    """Returns a generator for each of B robots, from the seed of the first one or a seed for each.

    None: any.

    Raises:
        InputError: seeds that are no whole numbers from zero on, or another number of them.
    """
    first = np.random.default_rng().integers(2**31) if seed is None else seed
    given = np.asarray(first, dtype=object)
    seeds = [*given] if given.ndim else [given.item()]
    known = [
        isinstance(number, int | np.integer) and number >= 0
        for number in seeds
        if number is not None
    ]
    if (
        not all(known)
        or (not known and not given.ndim)
        or len(seeds) != (count if given.ndim else 1)
    ):
        raise InputError(
            f"seed is {seed!r}: give a whole number from zero on, "
            f"or {count} of them, one for each robot."
        )
    if not given.ndim:
        seeds = [int(seeds[0]) + number for number in range(count)]
    return [np.random.default_rng(number) for number in seeds]


class Camera:
    """A distant camera whose frame fits a set of points.

    Args:
        up: (3,) upward direction of the pictures.
        points: (P, 3) that fill the frame [m].
        obstacles: that the robots touch.

    Raises:
        DrawingError: this machine cannot render.
    """

    def __init__(self, up: FloatArray, points: FloatArray, obstacles: ObstacleSurface) -> None:
        self._axes = side_axes(up, _TURN, _TILT)
        self._focus, half = frame_of(
            np.concatenate([points, obstacles.near(points)]), self._axes, _MARGIN
        )
        self._half = float(half.max())
        self._around = obstacle_layers(obstacles.points, obstacles.triangles)
        self._renderer = Renderer()

    def pictures(
        self,
        triangles: IntArray,
        vertices: FloatArray,
        markers: FloatArray,
        goals: Sequence[FloatArray],
        texts: Sequence[str],
        rigid: tuple[IntArray, FloatArray] | None = None,
    ) -> list[Pixels]:
        """Returns pictures (H, W, 3) of B robots.

        Args:
            triangles: (S, 3) of their surface; empty if only markers are known.
            vertices: (B, N, 3) [m].
            markers: (B, M, 3) [m].
            goals: B paths or places (K, 3) of their tasks [m].
            texts: B captions.
            rigid: triangles (R, 3) and vertices (B, N, 3) [m] of rigid bodies that carry the
                robots.

        Raises:
            DrawingError: this machine cannot render.
        """
        most = max(map(len, goals))
        paths = np.stack(
            [np.pad(path, ((0, most - len(path)), (0, 0)), mode="edge") for path in goals]
        )
        before = {name: self._half * share for name, share in _BEFORE.items()}
        radii = {name: self._half * share for name, share in _RADII.items()}
        layers = [
            *self._around,
            Layer("balls", paths[:, :1], None, _GOAL, size=radii["goal"], shift=before["goals"]),
            Layer("balls", markers, None, INK, size=radii["marker"], shift=before["markers"]),
        ]
        if most > 1:
            layers.append(
                Layer("lines", paths, chain(most), _GOAL, size=2.0, shift=before["goals"])
            )
        if len(triangles):
            layers += body_layers(vertices, triangles, self._half, width=1.5)
        if rigid is not None:
            layers += obstacle_layers(rigid[1], rigid[0], colour=CARRIER)
        view = View(layers, self._axes, self._focus, self._half)
        return list(
            self._renderer.frames(RenderScene([view], _SIZE, background="white", texts=texts))
        )

    def close(self) -> None:
        """Ends the rendering process."""
        self._renderer.close()
