"""Durations of roll-outs and of their gradients."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import torch

from ..dynamics.simulator import Simulator
from ..stepping.inputs import Inputs
from ..stepping.state import State

CPU: Final = torch.device("cpu")


def now(device: torch.device = CPU) -> float:
    """Time [s] after the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


@dataclass
class TimedRollout:
    """A repeated roll-out, with the gradient of the sum of squares of its last state."""

    simulator: Simulator
    start: State
    steps: int
    inputs: Inputs = field(default_factory=Inputs)
    plain: list[float] = field(default_factory=list)  # [s] of each roll-out that keeps nothing for gradients
    forward: list[float] = field(default_factory=list)  # [s] of each roll-out with gradients
    backward: list[float] = field(default_factory=list)  # [s] of each gradient
    iterations: float = 0.0  # mean over the steps of the last roll-out
    factorisations: float = 0.0  # mean over the steps of the last roll-out

    def measure(self, parameters: Mapping[str, torch.Tensor] | None = None) -> None:
        """Times a roll-out and its gradient with respect to the start, and inputs and parameters that require one."""
        device, others = self.start.q.device, [*self.inputs.fields.values(), *(parameters or {}).values()]
        q, v = (tensor.clone().requires_grad_(True) for tensor in (self.start.q, self.start.v))
        began = now(device)
        with torch.no_grad():
            self.simulator.rollout(self.start, self.steps, self.inputs, parameters)
        self.plain.append(now(device) - began)
        began = now(device)
        trajectory = self.simulator.rollout(State(q, v), self.steps, self.inputs, parameters)
        self.forward.append(now(device) - began)
        loss = trajectory.q[-1].square().sum() + trajectory.v[-1].square().sum()
        began = now(device)
        torch.autograd.grad(loss, [q, v, *(tensor for tensor in others if tensor.requires_grad)])
        self.backward.append(now(device) - began)
        self.iterations = float(np.mean([r.iterations.double().mean().item() for r in trajectory.reports]))
        self.factorisations = float(np.mean([r.factorisations.double().mean().item() for r in trajectory.reports]))

    @property
    def unknowns(self) -> int:
        """Number of coordinates of the free vertices of one environment."""
        return 3 * (self.simulator.body.n_vertices - len(self.simulator.fixed))

    @property
    def durations(self) -> tuple[list[float], list[float], list[float]]:
        """``plain``, ``forward`` and ``backward``."""
        return self.plain, self.forward, self.backward

    def a_step(self, statistic: Callable[[list[float]], float]) -> tuple[float, float, float]:
        """A statistic of the durations [s] of a step of the whole batch: plain, forward and backward."""
        plain, forward, backward = (statistic(own) / self.steps for own in self.durations)
        return plain, forward, backward
