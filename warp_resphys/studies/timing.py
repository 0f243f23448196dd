"""Timing for the studies of speed: medians over repeats, roll-outs with gradients, steps, and new processes.

The speed of a machine varies with time. Cases therefore take turns, medians are reported, and a fixed task of LAPACK,
the *yardstick*, is timed with them, so that times relative to the yardstick can be compared between machines.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any, Final

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from ..dynamics.simulator import Simulator
from ..stepping.inputs import Inputs
from ..stepping.state import State

CPU: Final = torch.device("cpu")
_YARDSTICK_SIZE: Final = 480
_CHILD: Final = """
import sys, time
began = time.perf_counter()
from {module} import {name}
imported = time.perf_counter() - began
import json
print(json.dumps([imported, {name}(json.load(sys.stdin))]))
"""


def now(device: torch.device = CPU) -> float:
    """Time [s] after the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def median_seconds(task: Callable[[], object], repeats: int, device: torch.device = CPU) -> float:
    """Median duration [s] of a task on a device."""
    seconds = []
    for _ in range(repeats):
        began = now(device)
        task()
        seconds.append(now(device) - began)
    return median(seconds)


def yardstick_seconds() -> float:
    """Median duration [s] of a product and a Cholesky factor of 480 x 480 matrices in NumPy, on one thread."""
    n = _YARDSTICK_SIZE
    random = np.random.default_rng(0).standard_normal((n, n))
    with threadpool_limits(1):
        return median_seconds(lambda: np.linalg.cholesky(random @ random.T + n * np.eye(n)), 5)


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


def step_time(simulator: Simulator, start: State, inputs: Sequence[Inputs], repeats: int) -> dict[str, float]:
    """Mean processor time and solver iterations of the steps of a roll-out.

    Args:
        simulator: of one environment.
        start: of the roll-out.
        inputs: of each step.
        repeats: number of roll-outs, after a first one that is not timed.

    Returns:
        ``step_ms``, the mean over steps of the median over repeats [ms], and ``iterations``.
    """
    times = np.empty((1 + repeats, len(inputs)))  # [ms]
    iterations = []
    prepared = simulator.prepare()
    with torch.no_grad():
        for row in times:
            state = start
            for step, acting in enumerate(inputs):
                began = time.process_time()
                state, report = simulator.step(state, acting, prepared)
                row[step] = 1e3 * (time.process_time() - began)
                iterations.append(float(report.iterations[0]))
    return {"step_ms": float(np.median(times[1:], axis=0).mean()), "iterations": float(np.mean(iterations))}


def run_in_new_process(
    function: Callable[[Any], Any], argument: Any, timeout: float | None = None, environment: Mapping[str, str] = {}
) -> tuple[float, Any]:
    """Calls a function in a new process, with its own imports, kernels and memory.

    Args:
        function: of a module.
        argument: plain data for JSON.
        timeout: after which the process is killed [s].
        environment: additional environment variables.

    Returns:
        Duration of importing the module [s], and the returned value, converted through JSON.

    Raises:
        TimeoutError: the process took longer than ``timeout``.
        RuntimeError: the process failed, with the message of its error.
    """
    code = _CHILD.format(module=function.__module__, name=function.__name__)
    try:
        run = subprocess.run(
            [sys.executable, "-c", code],
            input=json.dumps(argument),
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            check=False,
            timeout=timeout,
        )
    except subprocess.TimeoutExpired:
        raise TimeoutError(f"more than {timeout:g} s") from None
    if run.returncode != 0:
        *_, last = [f"exit code {run.returncode}", *run.stderr.strip().splitlines()]
        raise RuntimeError(last.partition("Error: ")[2] or last)
    imported, result = json.loads(run.stdout.splitlines()[-1])
    return imported, result
