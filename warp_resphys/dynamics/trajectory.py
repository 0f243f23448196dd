"""Result of a roll-out, with its files and plots."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ..energies.obstacles import ObstacleMotion
from ..fem.bodies import Body
from ..io.errors import InputError
from ..io.files import atomic_hdf5, create
from ..mesh.motion_files import write_vtk
from ..stepping.inputs import shapes
from ..stepping.state import SolveReport, State


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

    def plot(
        self, vertices: ArrayLike | None = None, axis: str | None = None, environment: int = 0, ax: Any = None
    ) -> Any:
        """Plots the mean displacement of some vertices from their rest positions over time.

        Args:
            vertices: vertex numbers, for example from `select_vertices`, or a single number; by default the vertex that
                moves furthest.
            axis: ``x``, ``y`` or ``z``; by default the one along which they move furthest.
            environment: index of the environment.
            ax: matplotlib axes; a new figure if omitted.

        Returns:
            The axes.

        Raises:
            InputError: an unknown axis, vertex or environment.
        """
        self._check(environment)
        moved, count = _array(self.q[:, environment]) - self.body.vertices, self.body.n_vertices
        if vertices is None:
            vertices = furthest_moved(moved)
        chosen = np.atleast_1d(np.asarray(vertices, dtype=np.int64))
        if not len(chosen) or chosen.min() < 0 or chosen.max() >= count:
            raise InputError(f"the vertices to plot must be one or more of 0 to {count - 1}.")
        return plot_displacements(self.times, moved[:, chosen].mean(1, keepdims=True), axis, ax)

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


def furthest_moved(moved: NDArray[np.float64]) -> int:
    """Returns the number of the vertex that moves furthest, from displacements (T, N, 3) [m]."""
    return int(np.linalg.norm(moved, axis=2).max(axis=0).argmax())


def plot_displacements(times: NDArray[np.float64], moved: NDArray[np.float64], axis: str | None, ax: Any) -> Any:
    """Plots displacements (T, n, 3) [m] over times (T,) [s], and returns the axes.

    Args:
        times: times.
        moved: displacements.
        axis: ``x``, ``y`` or ``z``; None: the one with the largest displacement.
        ax: matplotlib axes; None: a new figure.

    Raises:
        InputError: an unknown axis.
    """
    import matplotlib.pyplot as plt

    axis = "xyz"[int(np.nanmax(np.abs(moved), axis=(0, 1)).argmax())] if axis is None else axis
    if axis not in ("x", "y", "z"):
        raise InputError(f"axis is {axis!r}: choose x, y or z.")
    ax = plt.subplots(layout="constrained")[1] if ax is None else ax
    ax.plot(times, 1e3 * moved[..., "xyz".index(axis)])
    ax.set(xlabel="time [s]", ylabel=f"displacement along {axis} [mm]")
    return ax


def _array(values: torch.Tensor) -> NDArray[np.float64]:
    return np.asarray(values.detach().cpu().numpy(), dtype=np.float64)
