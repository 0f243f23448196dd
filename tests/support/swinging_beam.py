"""A beam with three markers at its tip, and motions of it whose markers a simulation fills in."""

from dataclasses import replace

import numpy as np
import torch

from warp_resphys import Inputs, bind_markers, box_hexahedra, select_vertices
from warp_resphys.learning.replay import Replay
from warp_resphys.learning.trial_batch import TrialBatch

MESH = box_hexahedra(divisions=(4, 1, 1))
TIP = select_vertices(MESH, x=0.1)
POINTS = np.array([[0.1, 0.015, 0.036], [0.1, -0.006, 0.024], [0.1, 0.036, 0.006]])
MARKERS = bind_markers(MESH, POINTS, ["a", "b", "c"], kind="rigid", vertices=TIP)


def double(values):
    return torch.as_tensor(values, dtype=torch.float64)


def blank(frames=12, masses=(0.0, 0.05), rate=100.0):
    """Motions under masses at the tip, whose markers stand a little off
    from where they were held.
    """
    count = len(masses)
    times = (torch.arange(frames, dtype=torch.float64) / rate).expand(count, -1)
    held = torch.as_tensor(POINTS).expand(count, -1, -1)
    attached = torch.zeros(count, len(MESH.vertices), dtype=torch.float64)
    attached[:, TIP] = double(masses)[:, None] / len(TIP)
    names = tuple(f"m{i}" for i in range(count))
    places = held[:, None].repeat(1, frames, 1, 1) + 1e-3
    return TrialBatch(names, times, places, held, Inputs(attached_mass=attached))


def simulated(replay, start, truth=None, observe=None, noise=0.0, seed=0):
    """The replay with the markers that a simulation with the true parameters sees,
    with Gaussian noise [m].
    """
    real = Replay(replay.simulator, observe or replay.observe, replay.trials)
    with torch.no_grad():
        seen = real(start, {name: double([value]) for name, value in (truth or {}).items()})[0]
    seen = seen + noise * torch.randn(
        seen.shape, generator=torch.Generator().manual_seed(seed), dtype=seen.dtype
    )
    return Replay(replay.simulator, replay.observe, replace(replay.trials, observed=seen))
