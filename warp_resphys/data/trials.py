"""Simulated or recorded trials on the body, in a file and in memory."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import h5py
import numpy as np
import torch

from ..core.fem.bodies import Body
from ..core.mesh.place import Place
from ..core.mesh.selection import vertices_at
from ..core.stepping.inputs import Inputs
from ..core.stepping.quantity import Quantity
from ..core.stepping.rotations import rotations
from ..io.arrays import BoolArray, Brief, FloatArray
from ..io.errors import InputError
from ..io.safe_files import atomic_hdf5, create, read_array, read_attribute, read_hdf5
from .base_motion import at_times, contact_inputs

PAYLOAD: Final = Quantity(
    "payload",
    "kg",
    0.0,
    closed=True,
    typical=0.05,
    words="weight",
    shown_unit="g",
    shown_factor=1e3,
)
GIVEN: Final = "given"  # beginning of trials whose initial state is known
RELEASED: Final = "released"
STATIC: Final = "static"
UNDER_INPUTS: Final = "driven"  # of a body at rest under the inputs of the first frame
SLACK: Final = "slack"  # the same, where these do not act; as UNDER_INPUTS in a dataset
# Of motions that inputs begin, read at the time steps.
RESTING: Final = ("rest", UNDER_INPUTS, SLACK)
_KIND = "dataset"
_RESTING, _CHANNELS = "_resting", "_channels"  # ends of names in a file
T = TypeVar("T")
_GROUPS = {"obstacles": "m, rad", "loads": "N, N m"}  # units of series by name
_UNITS = {
    **dict.fromkeys(("observed", "smoothed", "held", "bound"), "m"),
    **{"velocity": "m/s", "times": "s", "payload": "kg", "base": "m, rad", "initial": "m, m/s"},
}


@dataclass(frozen=True)
class Trials(Brief):
    """R trials of one body, in the frame of the body, as stored in `DATASET`.

    Attributes:
        names: names of the trials.
        labels: labels of the M tracked markers; empty if every vertex is observed.
        begins: how each trial begins, see `settings.performed.Begins`; held bodies are ``released``
            here.
        times: (R, T) times of the frames [s]; trials that end early repeat their last time.
        observed: (R, T, M, 3) observed positions [m], NaN where a marker was not seen.
        held: (R, M, 3) positions before time zero [m], NaN for markers that a trial does not have.
        payload: (R,) mass hanging on the body [kg].
        gravity: (3,) gravity [m/s^2].
        time_step: time step of the inputs [s].
        bound: (M, 3) markers on the undeformed body [m]; None for vertices.
        initial: (R, 2, N, 3) initial positions [m] and velocities [m/s] of trials with a given
            state; None: the first of `observed` and `velocity`.
        smoothed: (R, T, M, 3) smoothed positions that residual forces are fitted to [m]; None to
            fit `observed`.
        velocity: (R, T, N, 3) velocities of the vertices [m/s], in simulated trials.
        inputs: (R, K, ...) inputs of the body during each step by name, such as ``pressure``
            (R, K, C) [Pa]; (R, ...) if constant.
        channels: names of the C channels, by input.
        resting: (R, C) inputs before time zero, by name, of trials that begin under inputs; empty
            if none does.
        base: (R, K + 1, 6) motion of the base at the steps, see `data.base_motion`; None if the
            base stands still.
        obstacles: (R, K + 1, 6) motions of obstacles at the steps by name, see
            `data.obstacle_motion`.
        sessions: session in which each trial was recorded; empty if there is one.
        units: units of the inputs.
        loads: (R, T, 6) readings of force sensors by name [N, N m], see `data.force_sensors`; NaN
            where there is none.
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    begins: tuple[str, ...]
    times: FloatArray
    observed: FloatArray
    held: FloatArray
    payload: FloatArray
    gravity: FloatArray
    time_step: float
    bound: FloatArray | None = None
    initial: FloatArray | None = None
    smoothed: FloatArray | None = None
    velocity: FloatArray | None = None
    inputs: Mapping[str, FloatArray] = field(default_factory=dict)
    channels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    resting: Mapping[str, FloatArray] = field(default_factory=dict)
    base: FloatArray | None = None
    obstacles: Mapping[str, FloatArray] = field(default_factory=dict)
    sessions: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    loads: Mapping[str, FloatArray] = field(default_factory=dict)

    def session(self, name: str) -> str:
        """Session in which a trial was recorded; empty if there is one."""
        (row,) = self.rows([name])
        return self.sessions[row] if self.sessions else ""

    def begin_of(self, name: str) -> str:
        """How a trial begins: given, released, rest, driven or static."""
        (row,) = self.rows([name])
        return self.begins[row]

    def batches(self, names: Sequence[str]) -> list[tuple[str, ...]]:
        """Groups trials by how they begin and their session.

        The trials of a group can be simulated as one batch.
        """
        groups: dict[tuple[str, str], list[str]] = {}
        for name in names:
            groups.setdefault((self.begin_of(name), self.session(name)), []).append(name)
        return [tuple(group) for group in groups.values()]

    def moving(self, names: Sequence[str]) -> tuple[str, ...]:
        """Names of the trials that are motions, not static poses."""
        return tuple(name for name in names if self.begin_of(name) != STATIC)

    def seconds(self, names: Sequence[str]) -> float:
        """Time of the last frame of trials [s]; zero of poses."""
        moving = self.moving(names)
        return float(self.times[self.rows(moving)].max()) if moving else 0.0

    @property
    def present(self) -> BoolArray:
        """(R, M) whether a trial has a marker, i.e. whether any of its frames shows the marker."""
        seen = np.asarray(np.isfinite(self.observed).all(axis=-1))
        return np.asarray(seen.any(axis=1))

    @property
    def sets(self) -> tuple[tuple[int, ...], ...]:
        """Sets of marker indices that occur in the trials; empty if every trial has all markers."""
        kept = np.unique(self.present, axis=0)
        return () if kept.all() else tuple(tuple(np.flatnonzero(row).tolist()) for row in kept)

    def write(self, path: Path) -> None:
        """Writes the trials to a file, see `read`.

        Raises:
            DataFileError: the file cannot be written.
        """
        words = {
            "names": self.names,
            "labels": self.labels,
            "begins": self.begins,
            "inputs": tuple(self.inputs),
        }
        words |= {"sessions": self.sessions} if self.sessions else {}
        words |= {key: tuple(values) for key in _GROUPS if (values := getattr(self, key))}
        words |= {f"{name}{_CHANNELS}": channels for name, channels in self.channels.items()}
        attributes = {
            **{key: list(strings) for key, strings in words.items()},
            "gravity": self.gravity,
        }
        with atomic_hdf5(path, _KIND, {**attributes, "time_step": self.time_step}) as file:
            for name, unit in _UNITS.items():
                if getattr(self, name) is not None:
                    axis = int(name in ("observed", "smoothed", "velocity"))
                    create(file, name, getattr(self, name), units=unit, time_axis=axis)
            for name, values in self.inputs.items():
                create(file, name, values, units=self.units.get(name) or "1", time_axis=1)
            for key, unit in _GROUPS.items():
                for name, values in getattr(self, key).items():
                    create(file, f"{key}/{name}", values, units=unit, time_axis=1)
            for name, values in self.resting.items():
                create(file, f"{name}{_RESTING}", values, units=self.units.get(name) or "1")

    @classmethod
    def read(cls, path: Path) -> Self:
        """Reads trials written by `write`.

        Raises:
            DataFileError: the file is missing, damaged or of another kind.
        """
        with read_hdf5(path, _KIND) as file:
            required = ("names", "labels", "begins", "inputs")
            words = {key: tuple(map(str, read_attribute(file, key))) for key in required}
            more = {key: tuple(map(str, file.attrs.get(key, ()))) for key in ("sessions", *_GROUPS)}
            inputs, r = words.pop("inputs"), len(words["names"])
            times = read_array(file, "times", (r, None))
            observed = read_array(
                file, "observed", (r, times.shape[1], len(words["labels"]) or None, 3)
            )
            shapes = {
                **{
                    "held": (r, observed.shape[2], 3),
                    "payload": (r,),
                    "bound": (observed.shape[2], 3),
                },
                **{"smoothed": observed.shape, "velocity": observed.shape},
                **{"initial": (r, 2, None, 3), "base": (r, None, 6)},
            }
            there = {*file, "held", "payload"}
            arrays = {
                name: read_array(file, name, x) for name, x in shapes.items() if name in there
            }
            known: dict[str, Any] = {**words, **arrays}
            resting = [key.removesuffix(_RESTING) for key in file if key.endswith(_RESTING)]
            return cls(
                **known,
                times=times,
                observed=observed,
                gravity=np.asarray(read_attribute(file, "gravity"), dtype=np.float64),
                time_step=float(read_attribute(file, "time_step")),
                inputs={name: _of_trials(file, name, r) for name in inputs},
                resting={name: _of_trials(file, f"{name}{_RESTING}", r) for name in resting},
                channels={
                    n: tuple(map(str, file.attrs[f"{n}{_CHANNELS}"]))
                    for n in inputs
                    if f"{n}{_CHANNELS}" in file.attrs
                },
                sessions=more["sessions"],
                obstacles={
                    n: read_array(file, f"obstacles/{n}", (r, None, 6)) for n in more["obstacles"]
                },
                loads={n: read_array(file, f"loads/{n}", (*times.shape, 6)) for n in more["loads"]},
            )

    def joined(self, other: "Trials") -> "Trials":
        """Returns these trials followed by others of the same body
        with the same number of frames.
        """
        arrays = {
            name: None
            if getattr(self, name) is None
            else np.concatenate([getattr(self, name), getattr(other, name)])
            for name in (
                "times",
                "observed",
                "held",
                "payload",
                "initial",
                "smoothed",
                "velocity",
                "base",
            )
        }
        named = {}
        for key in ("inputs", *_GROUPS):
            mine, others = getattr(self, key), getattr(other, key)
            named[key] = {name: np.concatenate([mine[name], others[name]]) for name in mine}
        resting = {
            name: np.concatenate([self._at_rest(name), other._at_rest(name)])
            for name in {**self.resting, **other.resting}
        }
        words = {
            key: getattr(self, key) + getattr(other, key) for key in ("names", "begins", "sessions")
        }
        changed: dict[str, Any] = {**words, **arrays, **named, "resting": resting}
        return replace(self, **changed)

    def _at_rest(self, name: str) -> FloatArray:
        """Returns inputs (R, C) before time zero, which are zero for trials from rest."""
        return self.resting.get(name, np.zeros_like(self.inputs[name][:, 0]))

    def chosen(self, names: Sequence[str] | None) -> tuple[str, ...]:
        """Returns some names of trials; all if None.

        Raises:
            InputError: there is no trial of a name, or no name at all.
        """
        names = self.names if names is None else tuple(names)
        if not names:
            raise InputError(f"no trials are named: name some of {', '.join(self.names)}.")
        self.rows(names)
        return names

    def rows(self, names: Sequence[str]) -> list[int]:
        """Returns the indices of trials.

        Raises:
            InputError: there is no trial of a name.
        """
        for name in names:
            if name not in self.names:
                raise InputError(f"there is no trial {name!r}: there are {', '.join(self.names)}.")
        return [self.names.index(name) for name in names]

    def _is_constant(self, name: str) -> bool:
        """Whether an input has no time axis."""
        return self.inputs[name].ndim == (3 if name in ("external_force", "fixed_positions") else 2)

    def _during(self, name: str, rows: Sequence[int], time_step: float) -> FloatArray:
        """(K', R, ...) an input resampled to a time step, by its values at the middle of each.

        (R, ...) if constant.
        """
        values = self.inputs[name][rows]
        if self._is_constant(name):
            return values
        count = round(values.shape[1] * self.time_step / time_step)
        at = ((np.arange(count) + 0.5) * time_step / self.time_step).astype(np.int64)
        resampled: FloatArray = values[:, np.minimum(at, values.shape[1] - 1)].swapaxes(0, 1).copy()
        return resampled

    def base_at(self, names: Sequence[str], time_step: float) -> torch.Tensor | None:
        """(K + 1, R, 6) motion of the base in trials, resampled to another time step.

        None if the base stands still.
        """
        return (
            None
            if self.base is None
            else torch.from_numpy(self._poses_at(self.base, names, time_step))
        )

    def _poses_at(self, poses: FloatArray, names: Sequence[str], time_step: float) -> FloatArray:
        """(K' + 1, R', 6) poses (R, K + 1, 6) of some trials, resampled to another time step."""
        times = self.time_step * np.arange(poses.shape[1])
        new = time_step * np.arange(round(times[-1] / time_step) + 1)
        return np.stack([at_times(poses[row], times, new) for row in self.rows(names)], axis=1)

    def contact_at(
        self, names: Sequence[str], body: Body, time_step: float
    ) -> dict[str, FloatArray]:
        """(K + 1, R, O) inputs of a body's contact in trials by name,
        those that move an obstacle in any trial.
        """
        if not self.obstacles:
            return {}
        acting = [
            name for name, values in contact_inputs(body, self.obstacles).items() if values.any()
        ]
        poses = {
            name: self._poses_at(motion, names, time_step)
            for name, motion in self.obstacles.items()
        }
        inputs = contact_inputs(body, poses)
        return {name: inputs[name] for name in acting}

    def acting(
        self, names: Sequence[str], body: Body, payload_at: Place | None, time_step: float
    ) -> tuple[Inputs, Inputs]:
        """Returns what acts on trials that begin in the same way, in float64 on the CPU.

        Args:
            names: names of the trials.
            body: body that carries the payloads.
            payload_at: see `payload_inputs`.
            time_step: time step of the simulation [s].

        Returns:
            The inputs during each step, and those before time zero.

        Raises:
            InputError: see `payload_inputs`.
        """
        rows = self.rows(names)
        static = self.begins[rows[0]] == STATIC
        acting = {key: torch.from_numpy(self._during(key, rows, time_step)) for key in self.inputs}
        if any(self.payload):
            hung = payload_inputs(body, payload_at, self.payload[rows])
            acting |= {key: torch.from_numpy(masses) for key, masses in hung.items()}
        if static:
            last = {
                key: acting[key] if self._is_constant(key) else acting[key][-1]
                for key in self.inputs
            }
            return Inputs(**acting), Inputs(**last)
        moved = self.contact_at(names, body, time_step)
        acting |= {name: torch.from_numpy(values[1:].copy()) for name, values in moved.items()}
        poses = self.base_at(names, time_step)
        if poses is not None:
            fixed = torch.from_numpy(
                np.asarray(body.mesh.vertices[body.fixed_vertices], dtype=np.float64)
            )
            acting["fixed_positions"] = (fixed @ rotations(poses[1:, :, 3:]).mT) + poses[
                1:, :, None, :3
            ]
        before = self.resting if self.begins[rows[0]] == UNDER_INPUTS else {}
        return Inputs(**acting), Inputs(
            **{key: torch.from_numpy(values[rows]) for key, values in before.items()}
        )


def _of_trials(file: h5py.Group, name: str, count: int) -> FloatArray:
    """Reads an array (R, ...) of R trials."""
    return read_array(
        file, name, (count, *[None] * (file[name].ndim - 1)) if name in file else None
    )


def payload_inputs(
    body: Body, payload_at: Place | None, loads: FloatArray
) -> dict[str, FloatArray]:
    """Converts payloads to arguments of `Inputs` [kg].

    The result is an (R, N) ``attached_mass``, in equal shares on the vertices that carry the
    payload.

    Args:
        body: body that carries the payloads.
        payload_at: place of the carrying vertices; None if there is never a payload.
        loads: (R,) payloads [kg].

    Raises:
        InputError: a payload without a place, or a place with fixed vertices only.
        MeshError: no vertex lies at the place.
    """
    masses = np.zeros((len(loads), body.n_vertices))
    if not np.any(loads):
        return {"attached_mass": masses}
    if payload_at is None:
        raise InputError(
            "a trial has a payload, but data.payload_at is not set: "
            "name the vertices that carry it."
        )
    carrying = vertices_at(body.mesh, payload_at)
    if np.isin(carrying, body.fixed_vertices).all():
        raise InputError(
            "data.payload_at selects fixed vertices only: "
            "hang the payload on vertices that can move."
        )
    masses[:, carrying] = loads[:, None] / len(carrying)
    return {"attached_mass": masses}


def evenly(row: Sequence[T], limit: int) -> list[T]:
    """Picks at most `limit` values, evenly spread over a row."""
    places = np.linspace(0, len(row) - 1, min(limit, len(row))).round().astype(int)
    return [row[i] for i in places]
