"""Adapter from the vector environment to Stable-Baselines3."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from ..io.errors import needs_extra
from .vector import RobotVectorEnv

with needs_extra("policies", "policies need"):
    from stable_baselines3.common.vec_env import VecEnv


class Robots(VecEnv):
    """Robots that are reset in the step that ends an episode.

    Args:
        environment: with ``autoreset_mode`` SAME_STEP.
    """

    def __init__(self, environment: RobotVectorEnv) -> None:
        self.environment = environment
        count = environment.num_envs
        super().__init__(
            count, environment.single_observation_space, environment.single_action_space
        )
        self._actions = np.zeros((count, environment.world.parts), dtype=np.float32)

    @override
    def reset(self) -> NDArray[np.float32]:
        seed = self._seeds[0]
        self._reset_seeds()
        return self.environment.reset(seed=seed)[0]

    @override
    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._actions = actions

    @override
    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        seen, rewards, terminated, truncated, info = self.environment.step(self._actions)
        over = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in over]
        for row in np.flatnonzero(over):
            infos[row] = {
                "terminal_observation": info["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
            }
        return seen, rewards.astype(np.float32), over, infos

    @override
    def close(self) -> None:
        self.environment.close()

    @override
    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.environment, attr_name)] * len(list(self._get_indices(indices)))

    @override
    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.environment, attr_name, value)

    @override
    def env_method(
        self, method_name: str, *arguments: Any, indices: Any = None, **named: Any
    ) -> list[Any]:
        result = getattr(self.environment, method_name)(*arguments, **named)
        return [result] * len(list(self._get_indices(indices)))

    @override
    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))

    @override
    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        return self.environment.render() or [None] * self.num_envs
