"""The motion of a robot over time, and its export to files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..dynamics.trajectory import furthest_moved, plot_displacements
from ..energies.obstacles import ObstacleMotion
from ..io.arrays import FloatArray
from ..io.errors import InputError, number_of
from ..learning.replay import sample
from ..mesh.motion_files import MovingSurface, input_columns, write_csv, write_usd, write_vtk
from .description import Description
from .inputs import RobotInput
from .state import RobotState


@dataclass(frozen=True, repr=False)
class Motion:
    """T steps of B robots.

    Attributes:
        robot: that moved.
        times: (T + 1,) [s].
        q: (T + 1, B, N, 3) positions of the vertices [m].
        v: (T + 1, B, N, 3) velocities [m/s].
        markers: (T + 1, B, M, 3) as `Robot.observe` returns them [m].
        half_widths: (T + 1, B, M) of the prediction intervals of their coordinates [m]; None if the experiment has
            none.
        left: (T + 1, B) bool, whether the learned force has been evaluated outside its training range.
        lost: (T + 1, B) bool, whether the simulation has diverged.
        inputs: (T, B, C) commands, by name.
        known_inputs: declarations of the robot's inputs, by name.
        final: the last state, from which another roll-out can continue.
        obstacles: motions of the obstacles that the robot touches.
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
    obstacles: tuple[ObstacleMotion, ...] = ()

    def __repr__(self) -> str:
        """Robot, numbers of steps and environments, and when the first of these left the training range."""
        steps, batch = len(self.times) - 1, self.q.shape[1]
        text = f"Motion of {self.robot.name}, {self.robot.model}: {number_of(steps, 'step')}, "
        text += f"{number_of(batch, 'environment')}"
        left, lost = self.left.cpu().numpy(), self.lost.cpu().numpy()
        if left.any():
            first = self.times[left.any(axis=1).argmax()]
            text += f"; {left.any(axis=0).sum()} left the training range, the first at {first:.3g} s"
        return text + (f"; {lost[-1].sum()} diverged" if lost.any() else "")

    def at(self, times: FloatArray | torch.Tensor) -> torch.Tensor:
        """Interpolates the markers at other times (F,) [s]; returns (F, B, M, 3), by cubic interpolation [m]."""
        wanted = torch.as_tensor(times).to(self.markers)
        if len(self.times) == 1:
            return self.markers.expand(len(wanted), -1, -1, -1)
        step = float(self.times[1] - self.times[0])
        return sample(self.markers.transpose(0, 1), wanted.expand(self.markers.shape[1], -1), step).transpose(0, 1)

    def plot(self, axis: str | None = None, environment: int = 0, ax: Any = None) -> Any:
        """Plots the displacements of the markers, or of the vertex that moves furthest if all are observed, over time.

        Args:
            axis: ``x``, ``y`` or ``z``; by default the one along which they move furthest.
            environment: number of the robot in the batch.
            ax: matplotlib axes; a new figure if omitted.

        Returns:
            The axes.

        Raises:
            InputError: there is no such environment or axis.
        """
        self._check(environment)
        markers = _array(self.markers, environment)
        moved, labels = markers - markers[0], list(self.robot.labels)
        if not labels:
            moved = moved[:, [furthest_moved(moved)]]
        ax = plot_displacements(self.times, moved, axis, ax)
        if labels:
            ax.legend(ax.lines[-len(labels) :], labels)
        return ax

    def write_csv(self, path: str | Path, environment: int = 0, half_widths: bool = False) -> Path:
        """Writes a table of times, markers, and the commands of the step that led there, in SI units.

        Its headers have names and units. `read_recording` reads tables without half-widths.

        Args:
            path: of the file.
            environment: number of the robot in the batch.
            half_widths: whether columns with the half-widths of the markers' prediction intervals are added.

        Raises:
            InputError: there is no such environment.
            DataFileError: the file cannot be written.
        """
        self._check(environment)
        columns: dict[str, FloatArray] = {}
        if half_widths and self.half_widths is not None:
            widths = self.half_widths[:, environment].T
            columns |= {
                f"{label} half-width [m]": width for label, width in zip(self.robot.labels, widths, strict=True)
            }
        for name, declared in self.known_inputs.items():
            if name in self.inputs and declared.is_driven:
                values = _array(self.inputs[name], environment)
                columns |= input_columns(name, declared.parts, declared.unit, values)
        return write_csv(Path(path), self.times, self.robot.labels, _array(self.markers, environment), columns)

    def write_vtk(self, path: str | Path, environment: int = 0) -> Path:
        """Writes a time series for ParaView: a ``.pvd`` file, and a folder of the same name with a file for each step.

        The vertices have ``displacement`` and ``velocity``; markers are in ``NAME_markers.pvd``, and obstacles
        in ``NAME_obstacles.pvd``, a half-space as a plate.

        Args:
            path: of the ``.pvd`` file.
            environment: number of the robot in the batch.

        Raises:
            InputError: there is no such environment, or another extension.
            DataFileError: the files cannot be written.
        """
        self._check(environment)
        q, v, markers = (_array(values, environment) for values in (self.q, self.v, self._labelled))
        return write_vtk(Path(path), self.robot.mesh, self.times, q, v, markers, self._surfaces(environment))

    def write_usd(self, path: str | Path, environment: int = 0) -> Path:
        """Writes the moving surfaces of the body and its obstacles, and its markers, to a USD file (extra ``usd``).

        Args:
            path: of the ``.usd``, ``.usda`` or ``.usdc`` file.
            environment: number of the robot in the batch.

        Raises:
            InputError: there is no such environment, another extension, or the extra is missing.
            DataFileError: the file cannot be written.
        """
        self._check(environment)
        q, markers = (_array(values, environment) for values in (self.q, self._labelled))
        return write_usd(Path(path), self.robot.mesh, self.times, q, markers, self._surfaces(environment))

    def _surfaces(self, environment: int) -> list[MovingSurface]:
        """Surfaces of the obstacles."""
        return [motion.surface(environment) for motion in self.obstacles]

    @property
    def _labelled(self) -> torch.Tensor:
        """Markers (T + 1, B, M, 3); M = 0 if every vertex is observed."""
        return self.markers if self.robot.labels else self.markers[:, :, :0]

    def _check(self, environment: int) -> None:
        count = self.q.shape[1]
        if not 0 <= environment < count:
            raise InputError(f"environment is {environment}: the motion has {count}, numbered from 0.")


def _array(values: torch.Tensor, environment: int) -> FloatArray:
    return np.asarray(values[:, environment].detach().cpu().numpy(), dtype=np.float64)
