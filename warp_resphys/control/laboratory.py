"""The simulated laboratory, driven by hand: commands go in, and what its cameras see comes out."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from ..data.rigid import RigidTransform, kabsch
from ..experiment.build import bound_markers
from ..experiment.files import REGISTRATION
from ..experiment.simulate import laboratory_simulator, make_setup, substeps_of
from ..io.errors import InputError
from ..io.files import read_json
from ..mesh.mesh import boundary_triangles
from ..stepping.inputs import Inputs

FloatArray = NDArray[np.float64]

_STREAM: Final = 7  # of the random numbers
_BEFORE: Final = 1_000_000  # number of the first frame before the first step


class Laboratory:
    """B bodies that play the real one; they begin at rest.

    Args:
        settings: of the experiment, with a laboratory.
        run_dir: of its run, whose registration says where cameras have the body.
        name: of the input.
        batch: B.
        seed: of the noise.
        on_failure: of a step, ``raise`` or ``count``.

    Attributes:
        state: of the bodies.
        parts: of the input.

    Raises:
        InputError: the experiment has recordings in place of a laboratory.
    """

    def __init__(
        self,
        settings: Mapping[str, Any],
        run_dir: Path,
        name: str,
        batch: int,
        seed: int,
        on_failure: str = "raise",
    ) -> None:
        if settings.get("laboratory") is None:
            raise InputError("the experiment has no laboratory: control is tried on a simulated one.")
        setup = make_setup(settings)
        simulator = laboratory_simulator(settings, setup.gravity)
        self._simulator = replace(simulator, solver=replace(simulator.settings, on_failure=on_failure))
        self._constants, self._name, self.batch = self._simulator.prepare(), name, batch
        self.parts = self._simulator.counts[name]
        labels = tuple(settings["markers"]["tracked"])
        found = bound_markers(settings["markers"], self._simulator.body.mesh, setup.tracked, labels)
        self._read = found.to(self._simulator.rest_positions)
        self._substeps, self._noise = substeps_of(settings), float(settings["laboratory"]["noise"])
        self._seeds = (int(settings["seed"]), _STREAM, seed)
        self._frame = _registered(run_dir, setup.reference, tuple(settings["markers"]["reference"]))
        with torch.no_grad():
            self.state = self._simulator.static_equilibrium(self._inputs(0.0), self._constants, batch=batch)

    def _inputs(self, values: Any) -> Inputs:
        given = self._simulator.tensor(np.broadcast_to(values, (self.batch, self.parts)).copy())
        return Inputs(**{self._name: given})

    @torch.no_grad()
    def step(self, commands: FloatArray) -> NDArray[np.bool_]:
        """One time step of the experiment under commands (B, n), which stay the same during it; (B,) which failed.

        Raises:
            ConvergenceError: one did, and ``on_failure`` is ``raise``.
        """
        inputs, failed = self._inputs(commands), np.zeros(self.batch, dtype=np.bool_)
        for _ in range(self._substeps):
            self.state, report = self._simulator.step(self.state, inputs, self._constants)
            failed |= ~report.converged.cpu().numpy()
        return failed

    @torch.no_grad()
    def truth(self) -> FloatArray:
        """(B, M, 3) where the markers are, in the frame that the experiment registered [m]."""
        return np.asarray(self._frame.apply(self._read(self.state.q).cpu().numpy()))

    @torch.no_grad()
    def bodies(self) -> tuple[NDArray[np.int64], FloatArray]:
        """(S, 3) triangles of the surface, and (B, N, 3) where its vertices are, in that frame [m]."""
        triangles = boundary_triangles(self._simulator.body.mesh)
        return triangles, np.asarray(self._frame.apply(self.state.q.double().cpu().numpy()))

    def seen(self, number: int) -> FloatArray:
        """(B, M, 3) where cameras have them after a number of steps [m]; the same noise for the same number."""
        found = self.truth()
        random = np.random.default_rng([*self._seeds, number])
        return found + self._noise * random.standard_normal(found.shape)

    def rest(self, frames: int = 20) -> FloatArray:
        """(B, M, 3) the mean of some frames of cameras, before anything moves [m]."""
        return np.asarray(np.mean([self.seen(_BEFORE + number) for number in range(frames)], axis=0))


def _registered(run_dir: Path, reference: FloatArray, labels: tuple[str, ...]) -> RigidTransform:
    """From the frame of the laboratory's body to that in which the experiment has it."""
    known = read_json(run_dir / REGISTRATION)
    every = [each["positions"] for each in known.values() if "positions" in each]
    return kabsch(reference, np.mean([[places[label] for label in labels] for places in every], axis=0))
