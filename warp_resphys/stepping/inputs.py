"""What acts on a batch of bodies over time."""

from collections.abc import Callable, Mapping
from typing import Any

import torch

from ..io.errors import InputError
from .quantity import Quantity


class Inputs:
    """What acts on a batch, during one step or during each of T: any subset, all differentiable.

    Every field may have a leading axis of time, T, if it changes: `at` gives that of one step. ``attached_mass`` is
    constant. Without both axes, such as (N, 3) or (n,), a field is that of a batch of one.

    Args:
        external_force: (B, N, 3) or (T, B, N, 3) held during a step, gravity not included [N].
        fixed_positions: (B, D, 3) or (T, B, D, 3) of the fixed vertices at the end of a step, in the order of
            ``body.fixed_vertices`` [m]; where they are, if left out.
        attached_mass: (1 or B, N) weights that hang on the vertices, beside the body's own [kg].
        actuation: (B, n) or (T, B, n) inputs of the body's energies by name, such as ``pressure`` in each chamber [Pa].

    Raises:
        InputError: fields with different numbers of steps.
    """

    def __init__(
        self,
        external_force: torch.Tensor | None = None,
        fixed_positions: torch.Tensor | None = None,
        attached_mass: torch.Tensor | None = None,
        **actuation: torch.Tensor | None,
    ) -> None:
        self.external_force = _batched(external_force, 2)
        self.fixed_positions = _batched(fixed_positions, 2)
        self.attached_mass = _batched(attached_mass, 1)
        self.actuation: dict[str, torch.Tensor] = {}
        for name, value in actuation.items():
            if (values := _batched(value, 1)) is not None:
                self.actuation[name] = values

    @property
    def fields(self) -> dict[str, torch.Tensor]:
        """What is given, by name."""
        names = ("external_force", "fixed_positions", "attached_mass")
        own = {name: getattr(self, name) for name in names}
        return {name: value for name, value in (own | self.actuation).items() if value is not None}

    def replace(self, **fields: torch.Tensor | None) -> "Inputs":
        """The same but for some fields; None takes one out."""
        return Inputs(**{**self.fields, **fields})

    def each(self, change: Callable[[torch.Tensor, int], torch.Tensor]) -> "Inputs":
        """The same with every field changed by a function of it and of the number of its axis of environments."""
        return Inputs(**{name: change(*pair) for name, pair in self.axes().items()})

    def select(self, environments: torch.Tensor) -> "Inputs":
        """Those of some environments, by number."""
        return self.each(lambda value, axis: value.index_select(axis, environments.to(value.device)))

    def repeat(self, times: int) -> "Inputs":
        """Those of all environments, several times over."""
        return self if times == 1 else self.each(lambda value, axis: torch.cat([value] * times, axis))

    def joined(self, other: "Inputs") -> "Inputs":
        """Those of these environments and of others after them."""
        theirs = other.fields
        return Inputs(**{n: torch.cat([value, theirs[n]], axis) for n, (value, axis) in self.axes().items()})

    def to(self, like: torch.Tensor) -> "Inputs":
        """The same on the device and in the type of a tensor."""
        return self.each(lambda value, _: value.to(like))

    def plus(self, force: torch.Tensor | None) -> "Inputs":
        """The same with a further external force (B, N, 3) [N]."""
        if force is None:
            return self
        return self.replace(external_force=force if self.external_force is None else self.external_force + force)

    def _series(self) -> Mapping[str, bool]:
        """Whether a field has an axis of time."""
        axes = {"external_force": 4, "fixed_positions": 4}
        return {n: n != "attached_mass" and value.ndim == axes.get(n, 3) for n, value in self.fields.items()}

    def axes(self) -> dict[str, tuple[torch.Tensor, int]]:
        """What is given, by name, with the number of its axis of environments."""
        return {name: (self.fields[name], int(series)) for name, series in self._series().items()}

    def check_steps(self, steps: int) -> None:
        """Refuses series of another length.

        Raises:
            InputError: a field has another number of steps.
        """
        for name, is_series in self._series().items():
            if is_series and len(self.fields[name]) != steps:
                raise InputError(f"{name} has {len(self.fields[name])} time steps, but {steps} are to be simulated.")

    def at(self, step: int) -> "Inputs":
        """Those during one step; past the end of a series, its last."""
        series = self._series()
        if not any(series.values()):
            return self
        fields = self.fields
        return Inputs(**{n: v[min(step, len(v) - 1)] if series[n] else v for n, v in fields.items()})

    def from_steps(self, first: torch.Tensor, steps: int) -> "Inputs":
        """Those during some steps, which every environment begins at a step of its own.

        Args:
            first: (B,) numbers of the first steps.
            steps: how many; past the end of a series its last stays.
        """
        span = first + torch.arange(steps, device=first.device)[:, None]

        def pick(value: torch.Tensor) -> torch.Tensor:
            at = span.clamp_max(len(value) - 1).to(value.device)
            return value[at, torch.arange(value.shape[1], device=value.device)]

        series = self._series()
        return Inputs(**{name: pick(v) if series[name] else v for name, v in self.fields.items()})

    def check(
        self,
        accepted: Mapping[str, tuple[Quantity, int]],
        batch: int,
        vertices: int,
        fixed: int,
        like: torch.Tensor,
    ) -> None:
        """Refuses what cannot be simulated, in one sentence on the first such field.

        Args:
            accepted: inputs of the body's energies by name, each with its number of values n.
            batch: B.
            vertices: N.
            fixed: D.
            like: a tensor on the device and of the type of the simulator.

        Raises:
            InputError: an unknown input, a field of another shape or type, or values that are not finite or out of
                their range.
        """
        known = {
            "external_force": ((batch, vertices, 3), "N", "vertex"),
            "fixed_positions": ((batch, fixed, 3), "m", "vertex"),
            "attached_mass": ((batch, vertices), "kg", "vertex"),
        }
        own = {name: ((batch, count), quantity.unit, quantity.per) for name, (quantity, count) in accepted.items()}
        for name, values in self.fields.items():
            if name not in known and name not in own:
                raise InputError(f"Unknown input {name}. This body accepts {', '.join([*known, *own])}.")
            shape, unit, place = (known | own)[name]
            check_tensor(name, values, shape, unit, place, like)
            if name in accepted:
                accepted[name][0].check(values)


def _batched(values: torch.Tensor | None, axes: int) -> torch.Tensor | None:
    """A field with an axis of environments, of one that has only so many axes without it."""
    return values[None] if isinstance(values, torch.Tensor) and values.ndim == axes else values


def check_tensor(name: str, values: Any, shape: tuple[int, ...], unit: str, place: str, like: torch.Tensor) -> None:
    """Refuses a tensor of another type, device or shape, or with values that are not finite.

    Raises:
        InputError: in one sentence that names it.
    """
    if not isinstance(values, torch.Tensor):
        raise InputError(f"{name} is a {type(values).__name__}: it must be a torch tensor.")
    if values.device.type != like.device.type or values.dtype != like.dtype:
        raise InputError(
            f"{name} is {values.dtype} on {values.device}: it must be {like.dtype} on {like.device}; "
            "Simulator.tensor converts."
        )
    shared = name == "attached_mass" and tuple(values.shape) == (1, *shape[1:])
    if tuple(values.shape) != shape and not shared:
        raise InputError(f"{name} has shape {tuple(values.shape)}: it must be {shape} in {unit}.")
    if not bool(torch.isfinite(values).all()):
        where = (~torch.isfinite(values)).nonzero()[0].tolist()
        raise InputError(f"{name} is not finite in environment {where[0]}, {place} {where[1]}: check what computes it.")
