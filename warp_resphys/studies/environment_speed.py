"""Steps a second of the environments of a run, for the benchmark."""

import time
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np

from ..control.files import reduced_file
from ..io.errors import InputError
from ..io.progress import Progress
from ..robot.loading import load

_ACTIONS: Final = 5  # of a repeat, of which the median is taken


def time_environments(run: Path, counts: list[int], repeats: int, device: str) -> list[dict[str, Any]]:
    """Rows with ``world``, ``robots``, ``ms`` of an action of all of them, and ``actions_s`` and ``steps_s`` a second.

    Robots do the task reach, their actions are random, and an action is several steps of the simulation. The reduced
    world is timed where the run has a reduced model, the laboratory where there is one.

    Raises:
        InputError: Gymnasium is not installed, or the folder has no run that is driven.
        DataFileError: see `robot.loading.load`.
    """
    try:
        from ..environments.making import make_vector
    except ImportError as error:
        raise InputError(f"environments need Gymnasium ({error}): pip install 'warp-resphys[environments]'.") from None
    known = load(run).description
    worlds = ["simulator", *(["reduced"] if (run / reduced_file(known.model)).is_file() else [])]
    worlds += ["laboratory"] if (run / "stages" / "laboratory.json").is_file() else []
    rows = []
    with Progress("environments", len(worlds) * len(counts) * repeats, "repeats") as progress:
        for world, count in product(worlds, counts):
            where = device if world == "simulator" else "cpu"
            robots = make_vector("reach", run, count, world=world, spread=0.0, seconds=100.0, device=where)
            robots.reset(seed=0)
            random, seconds = np.random.default_rng(0), []
            robots.step(np.zeros((count, robots.world.parts), dtype=np.float32))  # Kernels are loaded, buffers made.
            for _ in range(repeats):
                began = time.perf_counter()
                for _ in range(_ACTIONS):
                    robots.step(random.uniform(-1.0, 1.0, (count, robots.world.parts)).astype(np.float32))
                seconds.append((time.perf_counter() - began) / _ACTIONS)
                progress.advance()
            spent = median(seconds)
            actions = count / spent
            rows.append(
                {
                    "world": world,
                    "robots": count,
                    "ms": 1e3 * spent,
                    "actions_s": actions,
                    "steps_s": actions * robots.frames,
                }
            )
    return rows
