"""Time-dependent inputs of a batch of bodies: forces,
motion of the fixed vertices, hung weights, actuation.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike

from ...io.errors import InputError
from .quantity import Quantity

_BY_VERTEX = {
    "external_force": "(N, 3) or (B, N, 3), a force for every vertex",
    "fixed_positions": "(D, 3) or (B, D, 3), a position for every fixed vertex",
    "attached_mass": "(N,) or (B, N), a mass for every vertex",
    "internal_force": "(N, 3) or (B, N, 3), a force for every vertex",
}
Acts = Literal["internal", "external"]  # a force: within the body, or on it from outside


class Inputs:
    """Inputs of a batch for one step or for T steps; every field is optional and differentiable.

    Every field but ``attached_mass`` may have a leading time axis T; `at` selects one step. A field
    without time and batch axes, such as (N, 3) or (n,), is a batch of one. Lists and arrays of
    numbers get the simulator's dtype, and one environment of them is for all; a number, or a tensor
    without axes, is for every chamber or tendon.

    Args:
        external_force: (B, N, 3) or (T, B, N, 3), constant during a step, without gravity [N].
        fixed_positions: (B, D, 3) or (T, B, D, 3) positions of the fixed vertices at the end of a
            step, in the order of ``body.fixed_vertices`` [m]; if omitted, they do not move.
        attached_mass: (1 or B, N) weights hung on the vertices, beside the body's own [kg].
        internal_force: like ``external_force``, but of what acts within a body. Its resultant is
            taken up there: it changes neither the reactions' balance with external loads nor
            momentum (`fem.internal_forces`) [N].
        actuation: (B, n) or (T, B, n) inputs of the body's energies by name, such as ``pressure``
            in each chamber [Pa].

    Attributes:
        plain: names of fields given as numbers, for any number of environments.

    Raises:
        InputError: a field that is no tensor, number or list of numbers, or has too few axes.
    """

    def __init__(
        self,
        external_force: torch.Tensor | ArrayLike | None = None,
        fixed_positions: torch.Tensor | ArrayLike | None = None,
        attached_mass: torch.Tensor | ArrayLike | None = None,
        internal_force: torch.Tensor | ArrayLike | None = None,
        **actuation: torch.Tensor | ArrayLike | None,
    ) -> None:
        by_vertex = (external_force, fixed_positions, attached_mass, internal_force)
        loads = dict(zip(_BY_VERTEX, by_vertex, strict=True))
        plain = {
            n
            for n, x in (loads | actuation).items()
            if not (x is None or isinstance(x, torch.Tensor))
        }
        self.plain = frozenset(plain)
        axes = {"attached_mass": 1}
        batched = [_batched(name, value, axes.get(name, 2)) for name, value in loads.items()]
        self.external_force, self.fixed_positions, self.attached_mass, self.internal_force = batched
        self.actuation: dict[str, torch.Tensor] = {}
        for name, value in actuation.items():
            values = _batched(name, value, 1)
            if values is not None:
                self.actuation[name] = values
                if not values.ndim:
                    self.plain |= {name}

    def __repr__(self) -> str:
        """Shapes of the fields."""
        return f"Inputs({', '.join(shapes(self.fields))})"

    def fitted(
        self, counts: Mapping[str, int], like: torch.Tensor, batch: int | None = None
    ) -> "Inputs":
        """Returns the inputs with fields given as numbers or lists on a device,
        and for every environment.

        Args:
            counts: number of values of the inputs of energies by name.
            like: a tensor with device and dtype.
            batch: number of environments; None for one, which may become more.
        """
        if not self.plain:
            return self
        fields = self.fields
        for name in self.plain:
            value = fields[name].to(like)
            if not value.ndim:
                value = value.expand(1, counts.get(name, 1))
            axis = value.ndim - (2 if name in self.actuation or name == "attached_mass" else 3)
            if batch is not None and value.shape[axis] == 1:
                value = value.expand(*value.shape[:axis], batch, *value.shape[axis + 1 :])
            fields[name] = value
        return Inputs(**fields) if batch is not None else self._derived(fields)

    def _derived(self, fields: Mapping[str, torch.Tensor]) -> "Inputs":
        """Inputs with other values of the fields, which count as numbers where those here do."""
        out = Inputs(**fields)
        out.plain |= self.plain & fields.keys()
        return out

    @property
    def fields(self) -> dict[str, torch.Tensor]:
        """All fields that are set, by name."""
        fields = {name: getattr(self, name) for name in _BY_VERTEX} | self.actuation
        return {name: value for name, value in fields.items() if value is not None}

    def replace(self, **fields: torch.Tensor | ArrayLike | None) -> "Inputs":
        """Returns inputs with some fields replaced; None removes a field."""
        new = Inputs(**fields)
        out = Inputs(**{**self.fields, **dict.fromkeys(fields), **new.fields})
        out.plain |= new.plain | (self.plain - fields.keys())
        return out

    def map(self, change: Callable[[torch.Tensor, int], torch.Tensor]) -> "Inputs":
        """Returns inputs with a function applied to every field
        and the index of its batch axis, but not to numbers.
        """
        shared = {
            n
            for n, (x, axis) in self.axes().items()
            if not x.ndim or (n in self.plain and x.shape[axis] == 1)
        }
        return self._derived(
            {n: x if n in shared else change(x, axis) for n, (x, axis) in self.axes().items()}
        )

    def select(self, environments: torch.Tensor) -> "Inputs":
        """Returns the inputs of some environments, given their indices."""
        return self.map(lambda value, axis: value.index_select(axis, environments.to(value.device)))

    def repeat(self, times: int) -> "Inputs":
        """Returns the inputs of the whole batch, repeated along the batch axis."""
        return (
            self if times == 1 else self.map(lambda value, axis: torch.cat([value] * times, axis))
        )

    def to(self, like: torch.Tensor) -> "Inputs":
        """Returns the inputs with the device and dtype of a tensor."""
        return self._derived({name: value.to(like) for name, value in self.fields.items()})

    def plus(self, force: torch.Tensor | None, acts: Acts = "external") -> "Inputs":
        """Returns the inputs with a force (B, N, 3) added
        that acts from outside, or within the body [N].
        """
        if force is None:
            return self
        name = f"{acts}_force"
        before = self.fields.get(name)
        if before is not None and name in self.plain:
            before = before.to(force)
        return self.replace(**{name: force if before is None else before + force})

    def _has_time_axis(self) -> Mapping[str, bool]:
        """Whether each field has a time axis, by name."""
        axes = {"external_force": 4, "internal_force": 4, "fixed_positions": 4}
        return {
            n: n != "attached_mass" and value.ndim == axes.get(n, 3)
            for n, value in self.fields.items()
        }

    def axes(self) -> dict[str, tuple[torch.Tensor, int]]:
        """All fields by name, each with the index of its batch axis."""
        return {
            name: (self.fields[name], int(has_time))
            for name, has_time in self._has_time_axis().items()
        }

    def check_steps(self, steps: int) -> None:
        """Raises InputError if the time axis of a field has another length than `steps`."""
        for name, has_time in self._has_time_axis().items():
            if has_time and len(self.fields[name]) != steps:
                raise InputError(
                    f"{name} has {len(self.fields[name])} time steps, "
                    f"but {steps} are to be simulated."
                )

    def at(self, step: int) -> "Inputs":
        """Returns the inputs of one step; after the last step, the last values are held."""
        has_time = self._has_time_axis()
        if not any(has_time.values()):
            return self
        return self._derived(
            {n: v[min(step, len(v) - 1)] if has_time[n] else v for n, v in self.fields.items()}
        )

    def by_step(self, steps: int) -> Iterator["Inputs"]:
        """Yields the inputs of steps in turn, whose gradients are joined once
        and not step by step as those of `at`.
        """
        has_time = self._has_time_axis()
        times = {name: values.unbind() for name, values in self.fields.items() if has_time[name]}
        for t in range(steps):
            now = {name: values[min(t, len(values) - 1)] for name, values in times.items()}
            yield self._derived(self.fields | now) if times else self

    def window(self, first: torch.Tensor, steps: int) -> "Inputs":
        """Returns the inputs of consecutive steps that start at another step in each environment.

        Args:
            first: (B,) indices of the first steps.
            steps: length of the window; after the last step, the last values are held.
        """
        span = first + torch.arange(steps, device=first.device)[:, None]

        def pick(value: torch.Tensor) -> torch.Tensor:
            at = span.clamp_max(len(value) - 1).to(value.device)
            return value[at, torch.arange(value.shape[1], device=value.device)]

        has_time = self._has_time_axis()
        return self._derived(
            {name: pick(v) if has_time[name] else v for name, v in self.fields.items()}
        )

    def check(
        self,
        accepted: Mapping[str, tuple[Quantity, int]],
        batch: int,
        vertices: int,
        fixed: int,
        like: torch.Tensor,
    ) -> None:
        """Checks all fields.

        Args:
            accepted: inputs of the body's energies by name, each with its number of values n.
            batch: B.
            vertices: N.
            fixed: D.
            like: a tensor with the device and dtype of the simulator.

        Raises:
            InputError: an unknown input, a wrong shape, dtype or device, or values that are not
                finite or out of range.
        """
        fields = {
            "external_force": ((batch, vertices, 3), "N", "vertex"),
            "internal_force": ((batch, vertices, 3), "N", "vertex"),
            "fixed_positions": ((batch, fixed, 3), "m", "vertex"),
            "attached_mass": ((batch, vertices), "kg", "vertex"),
        } | {
            name: ((batch, count), quantity.unit, quantity.per)
            for name, (quantity, count) in accepted.items()
        }
        for name, values in self.fields.items():
            if name not in fields:
                raise InputError(f"Unknown input {name}. This body accepts {', '.join(fields)}.")
            check_tensor(name, values, *fields[name], like)
            if name in accepted:
                accepted[name][0].check(values)


def _batched(name: str, values: torch.Tensor | ArrayLike | None, axes: int) -> torch.Tensor | None:
    """Adds the batch axis to a field that has only `axes` axes.

    Raises:
        InputError: neither a tensor nor numbers, or forces, positions or masses that are not given
            by vertex.
    """
    if values is None:
        return None
    if isinstance(values, list | tuple) and any(
        isinstance(value, torch.Tensor) for value in values
    ):
        raise InputError(f"{name} is a list with tensors: make it one tensor, as by torch.stack.")
    try:
        tensor = (
            values
            if isinstance(values, torch.Tensor)
            else torch.as_tensor(np.asarray(values, dtype=np.float64))
        )
    except (TypeError, ValueError):
        raise InputError(
            f"{name} is {values!r}: give a tensor, a number or a list of numbers."
        ) from None
    if tensor.ndim < axes and name in _BY_VERTEX:
        raise InputError(f"{name} has shape {tuple(tensor.shape)}: it must be {_BY_VERTEX[name]}.")
    return tensor[None] if tensor.ndim == axes else tensor


def shapes(tensors: Mapping[str, torch.Tensor]) -> list[str]:
    """Returns names and shapes of tensors in words."""
    return [f"{name} {tuple(tensor.shape)}" for name, tensor in tensors.items()]


def check_tensor(
    name: str, values: Any, shape: tuple[int, ...], unit: str, place: str, like: torch.Tensor
) -> None:
    """Raises InputError if a tensor has the wrong dtype,
    device or shape, or values that are not finite.
    """
    if not isinstance(values, torch.Tensor):
        raise InputError(f"{name} is a {type(values).__name__}: it must be a torch tensor.")
    if values.device.type != like.device.type or values.dtype != like.dtype:
        raise InputError(
            f"{name} is {values.dtype} on {values.device}: it must be {like.dtype} on "
            f"{like.device}; Simulator.tensor converts."
        )
    shared = name == "attached_mass" and tuple(values.shape) == (1, *shape[1:])
    if tuple(values.shape) != shape and not shared:
        raise InputError(f"{name} has shape {tuple(values.shape)}: it must be {shape} in {unit}.")
    # A finite sum has finite terms and takes one pass; the sum of finite terms may overflow.
    if not math.isfinite(values.detach().sum()) and not bool(torch.isfinite(values).all()):
        where = (~torch.isfinite(values)).nonzero()[0].tolist()
        raise InputError(
            f"{name} is not finite in environment {where[0]}, "
            f"{place} {where[1]}: check what computes it."
        )
