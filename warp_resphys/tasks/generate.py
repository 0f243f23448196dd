"""Stage: trajectories of the simulation that plays the real robot."""

import logging

import torch

from ..configured import build_simulator
from ..errors import InputError
from ..integrator import State
from ..mesh import select_vertices
from ..progress import Progress
from ..resumable import ResumableHDF5
from ..simulator import Simulator
from ..stages import StageContext
from .trajectories import TRAJECTORIES, last_state, state_fields, weight_split

log = logging.getLogger(__name__)


def generate(context: StageContext) -> None:
    """Writes trajectories.h5: q, v (B, T + 1, N, 3), the held state first."""
    settings = context.settings
    data = settings["data"]
    if data["kind"] != "release_from_load":
        raise InputError(f"data.kind is {data['kind']!r}: choose release_from_load.")
    if not data["steps"] > 0:
        raise InputError(f"data.steps is {data['steps']}: it must be positive.")
    simulator = build_simulator(settings, "reality")
    split, weights = weight_split(data)
    batch, frames = len(weights), data["steps"] + 1
    fields = state_fields(batch, simulator.body.n_vertices)
    path = context.run_dir / TRAJECTORIES
    with (
        ResumableHDF5(path, "trajectories", context.fingerprint, frames, fields) as file,
        torch.no_grad(),
        Progress("generate", frames, "frames", file.done) as progress,
    ):
        state: State | None = None
        tensors = simulator.prepare()
        while file.done < file.steps:
            if state is None and file.done > 0:
                state = last_state(file, simulator.rest_positions)
            if state is None:
                state = held_state(simulator, data["load"], weights)
            else:
                state, _ = simulator.step(state, material=tensors)
            file.append(q=state.q.cpu().numpy(), v=state.v.cpu().numpy())
            progress.advance()
        file.finish({"time_step": settings["time_step"], "names": list(split.names)})


def held_state(simulator: Simulator, load: dict[str, float], weights: "torch.Tensor | object") -> State:
    """The body at rest under weights on a face, in equal shares.

    Args:
        simulator: of the body.
        load: the face, such as ``{"x": 0.1}`` [m].
        weights: (B,) [kg].
    """
    face = torch.as_tensor(select_vertices(simulator.body.mesh, **load), device=simulator.rest_positions.device)
    shares = simulator.tensor(weights)[:, None, None] * simulator.tensor(simulator.gravity) / len(face)
    force = simulator.rest_positions.new_zeros(len(shares), simulator.body.n_vertices, 3)
    force[:, face] = shares
    log.info("generate: finding the equilibrium under %d weights", len(shares))
    return simulator.static_equilibrium(force)
