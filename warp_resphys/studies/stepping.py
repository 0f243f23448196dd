"""What a step of a simulator costs."""

import time
from collections.abc import Sequence

import numpy as np
import torch

from ..dynamics.inputs import Inputs
from ..dynamics.integrator import State
from ..dynamics.simulator import Simulator


def step_time(simulator: Simulator, start: State, inputs: Sequence[Inputs], repeats: int) -> dict[str, float]:
    """Milliseconds of a processor, and solver iterations, of a step, in the mean over a roll-out.

    Milliseconds are the median over repetitions of each step.

    Args:
        simulator: that steps.
        start: of the roll-out.
        inputs: of each step.
        repeats: of the roll-out, after a first one that is not timed.
    """
    times: list[list[float]] = []
    iterations: list[float] = []
    prepared = simulator.prepare()
    with torch.no_grad():
        for _ in range(1 + repeats):
            state = start
            times.append([])
            for each in inputs:
                began = time.process_time()
                state, report = simulator.step(state, each, prepared)
                times[-1].append(1e3 * (time.process_time() - began))
                iterations.append(float(report.iterations[0]))
    return {"step_ms": float(np.median(times[1:], axis=0).mean()), "iterations": float(np.mean(iterations))}
