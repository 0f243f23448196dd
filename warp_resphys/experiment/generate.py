"""Stage: trajectories of the simulation that plays the real robot."""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..dynamics.integrator import State
from ..dynamics.simulator import Simulator
from ..io.errors import InputError
from ..io.progress import Progress
from ..io.resumable import ResumableHDF5
from ..io.stages import StageContext
from ..mesh.mesh import select_vertices
from ..mesh.poses import twisted
from .build import build_simulator
from .trajectories import TRAJECTORIES, last_state, split_of, state_fields

log = logging.getLogger(__name__)

_AXES = ("x", "y", "z")


def generate(context: StageContext) -> None:
    """Writes trajectories.h5: q, v (B, T + 1, N, 3), the held state first."""
    settings = context.settings
    data = settings["data"]
    if not data["steps"] > 0:
        raise InputError(f"data.steps is {data['steps']}: it must be positive.")
    simulator = build_simulator(settings, "reality")
    split, values = split_of(data)
    batch, frames = len(values), data["steps"] + 1
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
                state = initial_state(simulator, data, values)
            else:
                state, _ = simulator.step(state, material=tensors)
            file.append(q=state.q.cpu().numpy(), v=state.v.cpu().numpy())
            progress.advance()
        file.finish({"time_step": settings["time_step"], "names": list(split.names)})


def initial_state(simulator: Simulator, data: Mapping[str, Any], values: NDArray[Any]) -> State:
    """The states from which a batch is let go.

    Args:
        simulator: of the body.
        data: the group ``data``.
        values: (B,) weights [kg] or angles [rad], by the kind of data.

    Raises:
        InputError: an unknown axis or face.
    """
    if data["kind"] == "release_from_twist":
        if data["twist_axis"] not in _AXES:
            raise InputError(f"data.twist_axis is {data['twist_axis']!r}: choose one of {', '.join(_AXES)}.")
        axis = _AXES.index(data["twist_axis"])
        q = twisted(simulator.rest_positions, simulator.tensor(values), axis)
        return State(q, torch.zeros_like(q))
    return held_state(simulator, data["load"], values)


def held_state(simulator: Simulator, load: Mapping[str, float], weights: NDArray[Any]) -> State:
    """The body at rest under weights on a face, in equal shares.

    Args:
        simulator: of the body.
        load: the face, such as ``{"x": 0.1}`` [m].
        weights: (B,) [kg].
    """
    face = torch.as_tensor(select_vertices(simulator.body.mesh, **load), device=simulator.rest_positions.device)
    if np.isin(face.cpu().numpy(), simulator.body.fixed_vertices).all():
        raise InputError("data.load names fixed vertices alone: hang the weights on vertices that can move.")
    shares = simulator.tensor(weights)[:, None, None] * simulator.tensor(simulator.gravity) / len(face)
    force = simulator.rest_positions.new_zeros(len(shares), simulator.body.n_vertices, 3)
    force[:, face] = shares
    log.info("generate: finding the equilibrium under %d weights", len(shares))
    return simulator.static_equilibrium(force)
