"""Result of a roll-out, with its files and plots."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ..energies.obstacles import ObstacleMotion
from ..fem.body import Body
from ..io.errors import InputError
from ..io.files import atomic_hdf5, create
from ..mesh.motion_files import write_vtk
from ..stepping.inputs import shapes
from ..stepping.state import State
from .nonlinear_solver import SolveReport


@dataclass(frozen=True)
class Trajectory:
    """Result of a roll-out."""

    q: torch.Tensor  # (T + 1, B, N, 3) positions, including the start [m]
    v: torch.Tensor  # (T + 1, B, N, 3) velocities [m/s]
    reports: list[SolveReport]  # T solver reports
    final: State  # last state, from which another roll-out can continue
    body: Body
    time_step: float  # [s]
    obstacles: tuple[ObstacleMotion, ...] = ()

    def __repr__(self) -> str:
        """Number and length of the steps, and shapes of the tensors."""
        given = ", ".join(shapes({"q": self.q, "v": self.v}))
        return f"Trajectory({len(self.reports)} steps of {1e3 * self.time_step:g} ms, {given})"

    @property
    def times(self) -> NDArray[np.float64]:
        """(T + 1,) times, from zero [s]."""
        return self.time_step * np.arange(len(self.q), dtype=np.float64)

    def save(self, path: str | Path) -> Path:
        """Writes times, positions and velocities to an HDF5 file.

        Its datasets are ``times`` (T + 1,), ``q`` and ``v`` (T + 1, B, N, 3) and ``rest`` (N, 3), each with an
        attribute ``units``.

        Args:
            path: path of the file; missing folders are created.

        Raises:
            DataFileError: the file cannot be written.
        """
        with atomic_hdf5(path, "trajectory") as file:
            create(file, "times", self.times, "s")
            create(file, "q", _array(self.q), "m")
            create(file, "v", _array(self.v), "m/s")
            create(file, "rest", self.body.vertices, "m")
        return Path(path)

    def plot(self, vertices: ArrayLike, axis: str = "z", environment: int = 0, ax: Any = None) -> Any:
        """Plots the mean displacement of some vertices from their rest positions over time.

        Args:
            vertices: vertex numbers, for example from `select_vertices`, or a single number.
            axis: ``x``, ``y`` or ``z``.
            environment: index of the environment.
            ax: matplotlib axes; a new figure if omitted.

        Returns:
            The axes.

        Raises:
            InputError: an unknown axis, vertex or environment.
        """
        import matplotlib.pyplot as plt

        self._check(environment)
        chosen, count = np.atleast_1d(np.asarray(vertices, dtype=np.int64)), self.body.n_vertices
        if axis not in ("x", "y", "z"):
            raise InputError(f"axis is {axis!r}: choose x, y or z.")
        if not len(chosen) or chosen.min() < 0 or chosen.max() >= count:
            raise InputError(f"the vertices to plot must be one or more of 0 to {count - 1}.")
        moved = (_array(self.q[:, environment]) - self.body.vertices)[:, chosen, "xyz".index(axis)].mean(1)
        ax = plt.subplots(layout="constrained")[1] if ax is None else ax
        ax.plot(self.times, 1e3 * moved)
        ax.set(xlabel="time [s]", ylabel=f"displacement along {axis} [mm]")
        return ax

    def write_vtk(self, path: str | Path, environment: int = 0) -> Path:
        """Writes a time series for ParaView: a ``.pvd`` file, and a folder of the same name with one file per step.

        The vertices have ``displacement`` and ``velocity``. Obstacles are in ``NAME_obstacles.pvd``, a half-space as a
        plate.

        Args:
            path: path of the ``.pvd`` file.
            environment: index of the environment.

        Raises:
            InputError: an unknown environment or another extension.
            DataFileError: the file cannot be written.
        """
        self._check(environment)
        q, v = (_array(values[:, environment]) for values in (self.q, self.v))
        obstacles = [motion.surface(environment) for motion in self.obstacles]
        return write_vtk(Path(path), self.body.mesh, self.times, q, v, q[:, :0], obstacles)

    def _check(self, environment: int) -> None:
        if not 0 <= environment < self.q.shape[1]:
            raise InputError(f"environment is {environment}: there are {self.q.shape[1]}, numbered from 0.")


def _array(values: torch.Tensor) -> NDArray[np.float64]:
    return np.asarray(values.detach().cpu().numpy(), dtype=np.float64)
