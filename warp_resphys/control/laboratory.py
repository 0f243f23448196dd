"""The simulated laboratory: takes commands step by step and returns noisy markers, as cameras would."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from typing_extensions import override

from ..data.rigid import RigidTransform, kabsch
from ..experiment.build import bound_markers
from ..experiment.files import REGISTRATION
from ..experiment.laboratory import laboratory_simulator, make_setup
from ..experiment.simulate import substeps_of
from ..io.files import read_json
from ..mesh.mesh import boundary_triangles
from ..report.obstacles import ObstacleSurface
from ..robot.state import RobotState
from ..settings.stages import PlayedSettings
from ..stepping.inputs import Inputs
from .world import BoolArray, FloatArray, IntArray, World

_STREAM: Final = 7  # of the random number generator
_BEFORE: Final = 1_000_000  # number of the first of the frames taken before the first step


class Laboratory(World):
    """B simulated bodies that stand in for the real robot; they start at rest.

    Args:
        settings: of the laboratory.
        run_dir: of its run; the registration there gives the pose of the body in the cameras' frame.
        name: of the input.
        count: B.
        seed: of the noise.
        on_failure: ``raise``; or ``count``: a body whose simulation fails stays at rest until `begin`.

    Attributes:
        state: of the bodies.
    """

    noise: float

    def __init__(
        self,
        settings: PlayedSettings,
        run_dir: Path,
        name: str,
        count: int,
        seed: int,
        on_failure: str = "raise",
    ) -> None:
        setup = make_setup(settings)
        simulator = laboratory_simulator(settings, setup.gravity)
        self._simulator = replace(simulator, solver=replace(simulator.settings, on_failure=on_failure))
        self._constants, self.input, self.count = self._simulator.prepare(), name, count
        self.time_step, self.parts = settings.time_step, self._simulator.counts[name]
        binding = settings.binding
        markers = bound_markers(binding, self._simulator.body.mesh, setup.tracked, binding.observed)
        self._read = markers.to(self._simulator.rest_positions)
        self._substeps = substeps_of(settings.time_step, settings.laboratory, "laboratory")
        self.noise = settings.laboratory.noise
        self._seeds = (settings.seed, _STREAM, seed)
        self._frame = _registered(run_dir, setup.reference, tuple(binding.reference))
        with torch.no_grad():
            inputs = self._inputs(np.zeros((count, self.parts)))
            self.state = self._simulator.static_equilibrium(inputs, self._constants, batch=count)
        self._rest, self._failed = self.state, np.zeros(count, dtype=np.bool_)

    def _inputs(self, values: FloatArray) -> Inputs:
        return Inputs(**{self.input: self._simulator.tensor(values)})

    @override
    def begin(self, chosen: BoolArray) -> None:
        self._failed = self._failed & ~chosen
        self._put_to_rest(chosen)

    def _put_to_rest(self, chosen: BoolArray) -> None:
        pick = torch.as_tensor(chosen, device=self.state.q.device)
        self.state = RobotState(self._rest).where(pick, RobotState(self.state)).body

    @override
    @torch.no_grad()
    def step(self, commands: FloatArray) -> BoolArray:
        inputs = self._inputs(commands)
        for _ in range(self._substeps):
            self.state, report = self._simulator.step(self.state, inputs, self._constants)
            self._failed = self._failed | ~report.converged.cpu().numpy()
        if self._failed.any():
            self._put_to_rest(self._failed)
        return self._failed

    @override
    @torch.no_grad()
    def markers(self) -> FloatArray:
        return np.asarray(self._frame.apply(self._read(self.state.q).cpu().numpy()))

    @override
    @torch.no_grad()
    def bodies(self) -> tuple[IntArray, FloatArray]:
        triangles = boundary_triangles(self._simulator.body.mesh)
        return triangles, np.asarray(self._frame.apply(self.state.q.double().cpu().numpy()))

    @override
    def obstacles(self) -> ObstacleSurface:
        return ObstacleSurface.of(self._simulator.body).carried(self._frame)

    def seen(self, number: int) -> FloatArray:
        """Returns noisy markers (B, M, 3) after a number of steps [m]; the step number seeds the noise."""
        markers = self.markers()
        random = np.random.default_rng([*self._seeds, number])
        return markers + self.noise * random.standard_normal(markers.shape)

    def rest(self, frames: int = 20) -> FloatArray:
        """Returns noisy markers (B, M, 3) averaged over frames taken before anything moves [m]."""
        return np.asarray(np.mean([self.seen(_BEFORE + number) for number in range(frames)], axis=0))


def _registered(run_dir: Path, reference: FloatArray, labels: tuple[str, ...]) -> RigidTransform:
    """Transform from the frame of the laboratory's body to the frame of the experiment."""
    trials = read_json(run_dir / REGISTRATION).values()
    positions = [trial["positions"] for trial in trials if "positions" in trial]
    return kabsch(reference, np.mean([[places[label] for label in labels] for places in positions], axis=0))
