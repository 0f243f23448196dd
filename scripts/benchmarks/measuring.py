"""Timing in turns, beside a yardstick.

The speed of a machine varies. Cases therefore take turns, medians are reported, and a fixed task of
LAPACK, the yardstick, is timed with them, so that times over the yardstick can be compared between
days and machines.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import Final

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from warp_resphys.core.dynamics.simulator import Simulator
from warp_resphys.core.dynamics.trajectory import Motion
from warp_resphys.io.progress import Progress

CPU: Final = torch.device("cpu")
_SIZE: Final = 480  # of the yardstick's matrices


def now(device: torch.device = CPU) -> float:
    """Returns the time [s] after the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def median_ms(task: Callable[[], object], repeats: int, device: torch.device = CPU) -> float:
    """Returns the median duration [ms] of a task on a device."""
    durations = []
    for _ in range(repeats):
        began = now(device)
        task()
        durations.append(now(device) - began)
    return 1e3 * median(durations)


def take_turns(
    title: str, tasks: Sequence[Callable[[], Mapping[str, float]]], repeats: int
) -> tuple[list[dict[str, float]], float]:
    """Runs tasks in turns, and returns the medians of the figures
    that each returns, and of the yardstick [ms].

    The yardstick is a product and a Cholesky factor of 480 x 480 in NumPy, on one thread.
    """
    random = np.random.default_rng(0).standard_normal((_SIZE, _SIZE))
    figures: list[list[Mapping[str, float]]] = [[] for _ in tasks]
    yardsticks = []
    with Progress(title, repeats * len(tasks), "runs") as progress:
        for _ in range(repeats):
            for task, timed in zip(tasks, figures, strict=True):
                timed.append(task())
                progress.advance()
            with threadpool_limits(1):
                yardsticks.append(
                    median_ms(
                        lambda: np.linalg.cholesky(random @ random.T + _SIZE * np.eye(_SIZE)), 5
                    )
                )
    return [
        {name: median(row[name] for row in timed) for name in timed[0]} for timed in figures
    ], median(yardsticks)


def solves(path: Motion) -> dict[str, float]:
    """Returns the mean numbers of iterations and factorisations in a step of a roll-out."""
    return {
        name: float(np.mean([getattr(r, name).double().mean().item() for r in path.reports]))
        for name in ("iterations", "factorisations")
    }


def free_unknowns(simulator: Simulator) -> int:
    """Returns the number of coordinates of the free vertices of one environment."""
    return 3 * (simulator.body.n_vertices - len(simulator.fixed))
