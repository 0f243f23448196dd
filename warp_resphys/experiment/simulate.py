"""Stage: trajectories of the simulation that plays the real robot, every vertex of which is known."""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from ..dynamics.inputs import Inputs
from ..dynamics.integrator import State
from ..dynamics.simulator import Simulator
from ..io.errors import InputError
from ..io.progress import Progress
from ..io.resumable import Field
from ..io.stages import StageContext
from ..mesh.mesh import select_vertices
from ..mesh.poses import twisted
from .build import build_simulator
from .files import DATASET, DATASET_KIND, GIVEN, describe
from .parts import March, march, pack, unpack
from .trials import trials_of

log = logging.getLogger(__name__)

_AXES = ("x", "y", "z")


def simulate(context: StageContext) -> None:
    """Writes dataset.h5: the positions (R, T + 1, N, 3) and velocities of all trials, the held state first."""
    settings = context.settings
    motion = _Free(settings)
    trials = trials_of(settings)
    times = settings["time_step"] * np.tile(np.arange(motion.frames, dtype=np.float64), (len(trials), 1))

    names = [trial.name for trial in trials]
    attributes = describe(names, (), [GIVEN] * len(names), settings["gravity"], settings["time_step"], {})
    with Progress(context.name, motion.frames, "frames") as progress:
        march(
            context.run_dir / DATASET,
            DATASET_KIND,
            context.fingerprint,
            motion,
            progress.advance,
            1,
            attributes,
            {"times": (times, "s")},
        )


class _Free(March):
    """Bodies that are let go and swing on their own."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._data, self._simulator = settings["data"], build_simulator(settings, "target")
        self._amounts = np.array([trial.amount for trial in trials_of(settings)])
        self._constants = self._simulator.prepare()
        self._state: State | None = None
        shape = (len(self._amounts), self._simulator.body.n_vertices, 3)
        self.fields = {"observed": Field(shape, "m", batch_axes=1), "velocity": Field(shape, "m/s", batch_axes=1)}
        self.frames = self._data["steps"] + 1

    @override
    @torch.no_grad()
    def frame(self, number: int) -> tuple[dict[str, Any], dict[str, object]]:
        if number == 0:
            self._state = initial_state(self._simulator, self._data, self._amounts)
        else:
            assert self._state is not None
            self._state, _ = self._simulator.step(self._state, parameters=self._constants)
        return {"observed": self._state.q.cpu().numpy(), "velocity": self._state.v.cpu().numpy()}, {}

    @override
    def snapshot(self) -> dict[str, torch.Tensor]:
        assert self._state is not None
        return pack(self._state)

    @override
    def restore(self, tensors: Mapping[str, torch.Tensor]) -> None:
        self._state = unpack(tensors, self._simulator.rest_positions)


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
    face = select_vertices(simulator.body.mesh, **load)
    if np.isin(face, simulator.body.fixed_vertices).all():
        raise InputError("data.load names fixed vertices alone: hang the weights on vertices that can move.")
    shares = simulator.tensor(weights)[:, None, None] * simulator.tensor(simulator.gravity) / len(face)
    force = simulator.rest_positions.new_zeros(len(shares), simulator.body.n_vertices, 3)
    force[:, torch.as_tensor(face, device=force.device)] = shares
    log.info("finding the equilibrium under %d weights", len(shares))
    return simulator.static_equilibrium(Inputs(force))
