"""Motions: results of roll-outs of bodies and robots, with their files and plots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from ...io.arrays import FloatArray
from ...io.errors import InputError, checks_methods, number_of
from ...io.safe_files import atomic_hdf5, create
from ..energies.contact.obstacle_poses import Pose
from ..energies.contact.obstacle_surface import ObstacleSurface
from ..fem.bodies import Body
from ..mesh.motion_files import input_columns, write_csv, write_usd, write_vtk
from ..stepping.inputs import shapes
from ..stepping.rollout import sample
from ..stepping.state import Reaction, SolveReport, State

_LOADS = tuple(
    f"load.{kind}{axis} [{unit}]" for kind, unit in (("f", "N"), ("t", "N m")) for axis in "xyz"
)


@checks_methods("write_csv", "write_vtk", "write_usd", "save", "plot")
@dataclass(frozen=True, repr=False)
class Motion:
    """T steps of B environments, differentiable.

    Attributes:
        q: (T + 1, B, N, 3) positions of the vertices, including the start [m].
        v: (T + 1, B, N, 3) velocities [m/s].
        final: last state, from which another roll-out can continue.
        body: the body.
        time_step: h [s].
        reports: T solver reports.
        obstacles: T + 1 poses of the obstacles that the body touches; empty without obstacles.
        name: name of a robot and its model.
        markers: (T + 1, B, M, 3) as `Robot.observe` returns them [m]; without a robot, the
            vertices.
        labels: names of the markers of a robot; empty where these are the vertices.
        half_widths: (T + 1, B, M) half-widths of the prediction intervals of the markers'
            coordinates [m]; None without intervals.
        left: (T + 1, B) bool, whether the learned force has been evaluated outside its training
            range.
        lost: (T + 1, B) bool, whether the simulation has diverged.
        inputs: (T, B, C) commands of a robot, by name.
        units: unit and names of the C parts of the commands that drive actuators, by name.
        reaction: what holds the body, as in `State`, in each of the T steps; None where it is not
            known.
    """

    q: torch.Tensor
    v: torch.Tensor
    final: State
    body: Body
    time_step: float
    reports: Sequence[SolveReport] = ()
    obstacles: Sequence[Pose] = ()
    name: str = ""
    markers: torch.Tensor = field(default=None)  # type: ignore[assignment]
    labels: tuple[str, ...] = ()
    half_widths: FloatArray | None = None
    left: torch.Tensor | None = None
    lost: torch.Tensor | None = None
    inputs: Mapping[str, torch.Tensor] = field(default_factory=dict)
    units: Mapping[str, tuple[str, tuple[str, ...]]] = field(default_factory=dict)
    reaction: Reaction | None = None

    def __post_init__(self) -> None:
        """Observes the vertices where there are no markers."""
        if self.markers is None:
            object.__setattr__(self, "markers", self.q)

    @classmethod
    def of(cls, states: Sequence[State], body: Body, time_step: float, **more: Any) -> "Motion":
        """Returns the motion of a body in T + 1 states of a roll-out.

        ``more`` are other attributes.
        """
        q, v = (torch.stack([getattr(state, name) for state in states]) for name in ("q", "v"))
        reports = [state.report for state in states[1:] if state.report is not None]
        reaction = Reaction.stack([state.reaction for state in states[1:]])
        return cls(q, v, states[-1], body, time_step, reports, reaction=reaction, **more)

    def __repr__(self) -> str:
        """Number and length of the steps, environments,
        and how many left the training range or diverged.
        """
        steps, batch = len(self.q) - 1, self.q.shape[1]
        text = f"Motion{f' of {self.name}' if self.name else ''}: {number_of(steps, 'step')} of "
        text += (
            f"{1e3 * self.time_step:g} ms, {number_of(batch, 'environment')}, "
            f"{shapes({'q': self.q})[0]}"
        )
        left, lost = (
            None if flags is None else flags.cpu().numpy() for flags in (self.left, self.lost)
        )
        if left is not None and left.any():
            first = self.times[left.any(axis=1).argmax()]
            text += (
                f"; {left.any(axis=0).sum()} left the training range, the first at {first:.3g} s"
            )
        return text + (f"; {lost[-1].sum()} diverged" if lost is not None and lost.any() else "")

    @property
    def times(self) -> FloatArray:
        """(T + 1,) times, from zero [s]."""
        return self.time_step * np.arange(len(self.q), dtype=np.float64)

    def at(self, times: FloatArray | torch.Tensor) -> torch.Tensor:
        """Interpolates the markers at other times (F,) [s].

        Returns (F, B, M, 3), by cubic interpolation [m].
        """
        wanted = torch.as_tensor(times).to(self.markers)
        if len(self.q) == 1:
            return self.markers.expand(len(wanted), -1, -1, -1)
        return sample(
            self.markers.transpose(0, 1), wanted.expand(self.q.shape[1], -1), self.time_step
        ).transpose(0, 1)

    def surface(self, environment: int = 0) -> ObstacleSurface:
        """Returns the surfaces of the obstacles in an environment, at all times."""
        return ObstacleSurface.along(self.body, self.obstacles, environment)

    def save(self, path: str | Path) -> Path:
        """Writes times, positions and velocities to an HDF5 file.

        Its datasets are ``times`` (T + 1,), ``q`` and ``v`` (T + 1, B, N, 3) and ``rest`` (N, 3),
        each with an attribute ``units``; ``markers`` (T + 1, B, M, 3) if there are any.

        Args:
            path: path of the file; missing folders are created.

        Raises:
            DataFileError: the file cannot be written.
        """
        with atomic_hdf5(
            path, "trajectory", {"labels": list(self.labels)} if self.labels else None
        ) as file:
            create(file, "times", self.times, "s")
            create(file, "q", _array(self.q), "m")
            create(file, "v", _array(self.v), "m/s")
            create(file, "rest", self.body.vertices, "m")
            if self.labels:
                create(file, "markers", _array(self.markers), "m")
        return Path(path)

    def plot(
        self,
        vertices: ArrayLike | None = None,
        axis: str | None = None,
        environment: int = 0,
        ax: Any = None,
        reaction: bool = False,
    ) -> Any:
        """Plots displacements over time, or the force that holds the body.

        Args:
            vertices: vertex numbers, for example from `select_vertices`, or a single number: their
                mean displacement from rest; by default the displacements of the markers since the
                start, or, without markers, that of the vertex that moves furthest from rest.
            axis: ``x``, ``y`` or ``z``; by default the one with the largest displacement.
            environment: index of the environment.
            ax: matplotlib axes; a new figure if omitted.
            reaction: whether the components of the force that holds the fixed vertices are shown
                instead [N].

        Returns:
            The axes.

        Raises:
            InputError: an unknown axis, vertex or environment, or a motion without reaction.
        """
        import matplotlib.pyplot as plt

        if reaction:
            loads = self._loads(environment)
            ax = plt.subplots(layout="constrained")[1] if ax is None else ax
            ax.legend(ax.plot(self.times, np.stack([*loads.values()][:3], axis=1)), ["x", "y", "z"])
            ax.set(xlabel="time [s]", ylabel="reaction [N]")
            return ax
        q = self.of_environment(self.q, environment) - self.body.vertices
        labels = self.labels if vertices is None else ()
        if labels:
            markers = self.of_environment(self.markers, environment)
            moved = markers - markers[0]
        else:
            furthest = np.linalg.norm(q, axis=2).max(axis=0).argmax()
            chosen = np.atleast_1d(
                np.asarray(furthest if vertices is None else vertices, dtype=np.int64)
            )
            if not len(chosen) or chosen.min() < 0 or chosen.max() >= q.shape[1]:
                raise InputError(
                    f"the vertices to plot must be one or more of 0 to {q.shape[1] - 1}."
                )
            moved = q[:, chosen].mean(1, keepdims=True)
        axis = "xyz"[int(np.nanmax(np.abs(moved), axis=(0, 1)).argmax())] if axis is None else axis
        if axis not in ("x", "y", "z"):
            raise InputError(f"axis is {axis!r}: choose x, y or z.")
        ax = plt.subplots(layout="constrained")[1] if ax is None else ax
        lines = ax.plot(self.times, 1e3 * moved[..., "xyz".index(axis)])
        ax.set(xlabel="time [s]", ylabel=f"displacement along {axis} [mm]")
        if labels:
            ax.legend(lines, labels)
        return ax

    def write_csv(
        self,
        path: str | Path,
        environment: int = 0,
        half_widths: bool = False,
        reaction: bool = False,
    ) -> Path:
        """Writes a table of times, markers, and commands of the step that led there, in SI units.

        Its headers have names and units. `read_recording` reads tables without half-widths; the
        reaction is that of a force sensor ``load`` whose readings are on the body.

        Args:
            path: path of the file.
            environment: index of the environment.
            half_widths: whether columns with the half-widths of the markers' prediction intervals
                are added.
            reaction: whether columns ``load.fx [N]`` to ``load.tz [N m]`` are added, with the force
                that holds the fixed vertices, and its moment about the origin; empty at the start,
                to which no step led.

        Raises:
            InputError: an unknown environment, or a motion without reaction.
            DataFileError: the file cannot be written.
        """
        markers, columns = self.of_environment(self.markers, environment), dict[str, FloatArray]()
        if half_widths and self.half_widths is not None:
            widths = zip(self.labels, self.half_widths[:, environment].T, strict=True)
            columns |= {f"{label} half-width [m]": width for label, width in widths}
        for name, (unit, parts) in self.units.items():
            if name in self.inputs:
                columns |= input_columns(
                    name, parts, unit, self.of_environment(self.inputs[name], environment)
                )
        if reaction:
            columns |= self._loads(environment)
        return write_csv(Path(path), self.times, self.labels, markers, columns)

    def write_vtk(self, path: str | Path, environment: int = 0) -> Path:
        """Writes a time series for ParaView: a ``.pvd`` file,
        and a folder of the same name with one file per step.

        The vertices have ``displacement``, ``velocity`` and, if it is known, the ``reaction`` in
        the step that led there [N]. Markers are in ``NAME_markers.pvd``, and obstacles in
        ``NAME_obstacles.pvd``, a half-space as a plate.

        Args:
            path: path of the ``.pvd`` file.
            environment: index of the environment.

        Raises:
            InputError: an unknown environment or another extension.
            DataFileError: the files cannot be written.
        """
        q = self.of_environment(self.q, environment)
        v = self.of_environment(self.v, environment)
        markers = self.of_environment(self.labelled, environment)
        fields = dict[str, FloatArray]()
        if self.reaction is not None:
            held = self.reaction.vertices.cpu()
            forces = self.of_environment(self.reaction.forces, environment)
            fields["reaction"] = np.zeros_like(q)
            fields["reaction"][1:, held] = forces
        return write_vtk(
            Path(path),
            self.body.mesh,
            self.times,
            q,
            v,
            markers,
            self.surface(environment).solids,
            fields,
        )

    def write_usd(self, path: str | Path, environment: int = 0) -> Path:
        """Writes the moving surfaces of the body and its obstacles,
        and its markers, to a USD file (extra ``usd``).

        Args:
            path: path of the ``.usd``, ``.usda`` or ``.usdc`` file.
            environment: index of the environment.

        Raises:
            InputError: an unknown environment, another extension, or the extra is missing.
            DataFileError: the file cannot be written.
        """
        q, markers = (
            self.of_environment(values, environment) for values in (self.q, self.labelled)
        )
        return write_usd(
            Path(path), self.body.mesh, self.times, q, markers, self.surface(environment).solids
        )

    @property
    def labelled(self) -> torch.Tensor:
        """Markers (T + 1, B, M, 3); M = 0 if these are the vertices."""
        return self.markers if self.labels else self.markers[:, :, :0]

    def _loads(self, environment: int) -> dict[str, FloatArray]:
        """Returns force [N] and moment about the origin [N m] of the reaction (T + 1,)
        by header, NaN at the start.
        """
        if self.reaction is None or not len(self.body.fixed_vertices):
            raise InputError(
                "this motion has no reaction: nothing holds the body "
                "at fixed vertices, or no step did."
            )
        clamp = self.reaction.at(self.body.fixed_vertices)
        values = self.of_environment(torch.cat([clamp.force, clamp.moment()], -1), environment)
        return dict(zip(_LOADS, np.concatenate([np.full((1, 6), np.nan), values]).T, strict=True))

    def of_environment(self, series: torch.Tensor, environment: int) -> FloatArray:
        """Returns values (T, ...) of an environment, from those of all (T, B, ...).

        Raises:
            InputError: an unknown environment.
        """
        if not 0 <= environment < self.q.shape[1]:
            raise InputError(
                f"environment is {environment}: there are {self.q.shape[1]}, numbered from 0."
            )
        return _array(series[:, environment])


def _array(values: torch.Tensor) -> FloatArray:
    return np.asarray(values.detach().cpu().numpy(), dtype=np.float64)
