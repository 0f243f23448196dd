"""What a robot does over time, and the files that it goes to."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ..io.errors import InputError
from ..learning.replay import sample
from ..mesh.motion_files import input_columns, write_csv, write_usd, write_vtk
from .description import Description
from .inputs import RobotInput
from .state import RobotState

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """T steps of B robots.

    Attributes:
        robot: that moved.
        times: (T + 1,) [s].
        q: (T + 1, B, N, 3) positions of the vertices [m].
        v: (T + 1, B, N, 3) velocities [m/s].
        markers: (T + 1, B, M, 3) as `Robot.observe` has them [m].
        half_widths: (T + 1, B, M) of the prediction intervals of their coordinates [m]; None where the experiment has
            none.
        left: (T + 1, B) bool, whether the learned force had been asked outside of the range of its training.
        lost: (T + 1, B) bool, whether the simulation had diverged.
        inputs: (T, B, C) what was commanded, by name.
        known_inputs: of the robot, by name.
        final: the last state, from which a further roll-out goes on.
    """

    robot: Description
    times: FloatArray
    q: torch.Tensor
    v: torch.Tensor
    markers: torch.Tensor
    half_widths: FloatArray | None
    left: torch.Tensor
    lost: torch.Tensor
    inputs: Mapping[str, torch.Tensor]
    known_inputs: Mapping[str, RobotInput]
    final: RobotState

    def at(self, times: FloatArray | torch.Tensor) -> torch.Tensor:
        """(F, B, M, 3) markers at other times [s], by cubic interpolation [m]."""
        wanted = torch.as_tensor(times).to(self.markers)
        if len(self.times) == 1:
            return self.markers.expand(len(wanted), -1, -1, -1)
        step = float(self.times[1] - self.times[0])
        found = sample(self.markers.transpose(0, 1), wanted.expand(self.markers.shape[1], -1), step)
        return found.transpose(0, 1)

    def write_csv(self, path: str | Path, environment: int = 0, half_widths: bool = False) -> Path:
        """Writes a table: times, markers, and what actuators were told during the step that led there, in SI units.

        Its headers have names and units; `read_recording` reads it, unless half-widths are in it.

        Args:
            path: of the file.
            environment: which of the B robots.
            half_widths: whether those of the markers' prediction intervals follow these.

        Raises:
            InputError: there is no such environment.
            DataFileError: it cannot be written.
        """
        self._check(environment)
        columns: dict[str, FloatArray] = {}
        if half_widths and self.half_widths is not None:
            widths = self.half_widths[:, environment].T
            columns |= {f"{name} half-width [m]": each for name, each in zip(self.robot.labels, widths, strict=True)}
        for known in (each for name, each in self.known_inputs.items() if name in self.inputs and each.is_driven):
            values = _array(self.inputs[known.name], environment)
            columns |= input_columns(known.name, known.parts, known.unit, values)
        return write_csv(Path(path), self.times, self.robot.labels, _array(self.markers, environment), columns)

    def write_vtk(self, path: str | Path, environment: int = 0) -> Path:
        """Writes a time series for ParaView: a ``.pvd`` file, and a folder of the same name with a file for each step.

        The vertices have ``displacement`` and ``velocity``; markers are in ``NAME_markers.pvd``.

        Args:
            path: of the ``.pvd`` file.
            environment: which of the B robots.

        Raises:
            InputError: there is no such environment, or another extension.
            DataFileError: it cannot be written.
        """
        self._check(environment)
        series = (_array(each, environment) for each in (self.q, self.v, self._labelled))
        return write_vtk(Path(path), self.robot.mesh, self.times, *series)

    def write_usd(self, path: str | Path, environment: int = 0) -> Path:
        """Writes the body's surface and its markers with their motion to a USD file; needs the extra ``usd``.

        Args:
            path: of the ``.usd``, ``.usda`` or ``.usdc`` file.
            environment: which of the B robots.

        Raises:
            InputError: there is no such environment, another extension, or the extra is missing.
            DataFileError: it cannot be written.
        """
        self._check(environment)
        series = (_array(each, environment) for each in (self.q, self._labelled))
        return write_usd(Path(path), self.robot.mesh, self.times, *series)

    @property
    def _labelled(self) -> torch.Tensor:
        """(T + 1, B, M, 3) the markers; none where every vertex is observed."""
        return self.markers if self.robot.labels else self.markers[:, :, :0]

    def _check(self, environment: int) -> None:
        count = self.q.shape[1]
        if not 0 <= environment < count:
            raise InputError(f"environment is {environment}: the motion has {count}, numbered from 0.")


def _array(values: torch.Tensor, environment: int) -> FloatArray:
    return np.asarray(values[:, environment].detach().cpu().numpy(), dtype=np.float64)
