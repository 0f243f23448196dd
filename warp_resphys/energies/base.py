"""What an energy is: its points, the quantities that it depends on, its kernels and their derivatives.

An `Energy` is constant and lives on the host, as a part of a `fem.body.Body`. It says which parameters it has
(constants that may be identified) and which inputs (what acts through it over time), and makes a `Term` of a batch:
kernels on its points, and their arguments. Solver, adjoint, tape, gradient check, identification and configuration
ask it, and know no energy by name.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from ..fem.elements import Points
from ..io.errors import InputError
from ..mesh.mesh import Mesh
from .launcher import Launcher, warp_view

Parameter = float | Sequence[float] | NDArray[np.float64] | torch.Tensor
Values = Mapping[str, torch.Tensor | None]


@dataclass(frozen=True)
class Quantity:
    """A number that a simulation depends on."""

    name: str  # by which parameters and inputs are given
    unit: str  # of its values
    lower: float = -np.inf  # all values are greater
    upper: float = np.inf  # all values are less
    closed: bool = False  # whether `lower` itself is allowed
    # what there may be a value each of, such as ``element`` or ``chamber``; without it, only environments
    per: str = ""
    typical: float = 1.0  # about how large it is: an input, or a parameter that may be anything
    words: str = ""  # what an input is called in a sentence, and
    shown_unit: str = ""  # the unit in which people read it,
    shown_factor: float = 1.0  # of which this many make one of `unit`

    def shown(self, value: float) -> str:
        """A value as people read it."""
        return f"{self.shown_factor * value:.4g} {self.shown_unit}"

    @property
    def plural(self) -> str:
        """What several of it are called."""
        return f"{self.words}{'es' if self.words.endswith('s') else 's'}"

    @property
    def wanted(self) -> str:
        """Its range in words."""
        unit = f", in {self.unit}" if self.unit else ""
        if self.lower == 0.0 and np.isinf(self.upper):
            return ("zero or more" if self.closed else "positive") + unit
        ends = [f"greater than {self.lower:g}"] if np.isfinite(self.lower) else []
        ends += [f"less than {self.upper:g}"] if np.isfinite(self.upper) else []
        return (" and ".join(ends) or "finite") + unit

    def varied(self, value: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """A value within the range for every x, and the given one for zero.

        At first it changes by a factor exp(x), or by x times its size or `typical` where it may be anything.
        """
        if np.isfinite(self.lower) and np.isfinite(self.upper):
            width = self.upper - self.lower
            return self.lower + width * torch.sigmoid(torch.logit((value - self.lower) / width) + x)
        if np.isfinite(self.lower):
            return self.lower + (value - self.lower) * torch.exp(x)
        return value + value.abs().amax().clamp_min(self.typical) * x

    def check(self, value: Any) -> None:
        """Refuses a value out of range.

        Raises:
            InputError: it is no number or array of numbers, or one of them is out of range.
        """
        try:
            values = torch.as_tensor(value, dtype=torch.float64).detach().cpu()
        except (TypeError, ValueError, RuntimeError):
            raise InputError(f"{self.name} is {value!r}: it must be a number, {self.wanted}.") from None
        inside = (values >= self.lower if self.closed else values > self.lower) & (values < self.upper)
        inside &= torch.isfinite(values)
        if values.numel() == 0 or values.ndim > 2:
            raise InputError(
                f"{self.name} has shape {tuple(values.shape)}: give a number, (M,), (B, 1) or (B, M) values."
            )
        if not bool(inside.all()):
            wrong = values[~inside].flatten()[0].item()
            raise InputError(f"{self.name} is {wrong:g}: it must be {self.wanted}.")

    def shaped(self, values: torch.Tensor) -> torch.Tensor:
        """A number, (n,), (B, 1) or (B, n) values as (1 or B, 1 or n); keeps the autograd graph."""
        if not self.per:
            return values.reshape(-1, 1)
        return values.reshape(1, -1) if values.ndim < 2 else values


class PointSet:
    """Points of one set on a launcher's device.

    Attributes:
        source: the points on the host.
        part: where they lie among the points of all energies.
        own: where they lie among those of their own energy.
        cells: C.
        points_per_cell: Q.
        nodes_per_cell: K.
        n_points: P = C Q.
        n_vertices: N.
        nodes: (C, K).
        gradients: (P, K) operators.
        start: (N + 1) where a vertex's entries of ``incident`` begin.
        incident: cell K + local node of every cell that a vertex belongs to.
    """

    def __init__(self, launcher: Launcher, points: Points, n_vertices: int, part: slice, own: slice) -> None:
        self.source, self.part, self.own, self.n_points = points, part, own, points.n_points
        self.n_vertices = n_vertices
        self.cells, self.points_per_cell, self.nodes_per_cell, _ = points.gradients.shape
        owner = points.nodes.ravel()
        # A padded node repeats its patch's own vertex with a zero gradient and contributes nothing.
        entries = np.flatnonzero(np.abs(points.gradients).sum(axis=(1, 3)).ravel() > 0.0)
        order = entries[np.argsort(owner[entries], kind="stable")]
        start = np.searchsorted(owner[order], np.arange(n_vertices + 1))
        self.nodes = launcher.upload(points.nodes.astype(np.int32), int)
        self.gradients = launcher.upload(points.gradients.reshape(-1, self.nodes_per_cell, 3), wp.vec3d)
        self.start = launcher.upload(start.astype(np.int32), int)
        self.incident = launcher.upload(order.astype(np.int32), int)


class Energy(ABC):
    """One energy of a body.

    Attributes:
        inputs: what acts through it, one value for each of `count`.
        is_load: whether it is a load, which enters the forces that a step's residual is compared with.
        implicit_only: whether it acts on the body at the end of a step whatever the simulator's coupling of loads.
    """

    inputs: ClassVar[tuple[Quantity, ...]] = ()
    is_load: ClassVar[bool] = False
    implicit_only: ClassVar[bool] = False

    @property
    def parameters(self) -> tuple[Quantity, ...]:
        """Constants that it depends on."""
        return ()

    @property
    def count(self) -> int:
        """Parts (chambers, tendons) with an input or a parameter of their own."""
        return 1

    @property
    def names(self) -> tuple[str, ...]:
        """Of its parts."""
        return tuple(str(number + 1) for number in range(self.count))

    @property
    def constants(self) -> Mapping[str, Parameter]:
        """The values of its parameters, where a simulation is given no others."""
        return {}

    @abstractmethod
    def points(self, mesh: Mesh) -> tuple[Points, ...]:
        """Its sets of points on a body's rest shape."""

    @abstractmethod
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "Term":
        """Its kernels for a batch."""

    def prepare(self, constants: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """What its terms need of the constants, computed once a roll-out.

        Args:
            constants: (1 or B, 1 or n) tensors by name, those of other energies too.

        Raises:
            InputError: another number of values than its `count`.
        """
        return {quantity.name: self.per_part(quantity, constants[quantity.name]) for quantity in self.parameters}

    def per_part(self, quantity: Quantity, values: torch.Tensor) -> torch.Tensor:
        """(1 or B, `count`) values of a parameter.

        Raises:
            InputError: another number of them.
        """
        if values.shape[1] not in (1, self.count):
            raise InputError(
                f"{quantity.name} has {values.shape[1]} values for {self.count} {quantity.per}s: give one value, or "
                f"one for each {quantity.per}."
            )
        return values.expand(-1, self.count)


class Term(ABC):
    """An energy's kernels on the points of a batch.

    The step's values are tensors by name, each (B, *shape): buffers that recorded launches read.

    Args:
        launcher: of the potential.
        sets: its points.

    Attributes:
        couples_cells: whether it may have `low_rank` columns.
    """

    couples_cells = False

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet]) -> None:
        self.launcher, self.sets = launcher, tuple(sets)
        self.n_points = sum(s.n_points for s in self.sets)

    @property
    @abstractmethod
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Shape, without the batch, of every value that a step has for it."""

    def before(self, values: Values, positions: Any) -> list[Any]:
        """Launches that the kernels of `step` and `tangent` need to have been made at the positions."""
        del values, positions
        return []

    def low_rank(self, values: Values, positions: Any) -> torch.Tensor | None:
        """(B, 3 N, r) columns C of what the tangent leaves out: C C^T couples vertices of many cells."""
        del values, positions
        return None

    @abstractmethod
    def step(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        """Kernel of stress and energy, and its inputs."""

    @abstractmethod
    def tangent(self, s: PointSet, values: Values, positions: Any, positive: Any) -> tuple[Any, list[Any]]:
        """Kernel of the tangent's blocks, and its inputs."""

    @abstractmethod
    def curvature(self, values: Values) -> torch.Tensor:
        """(1 or B, P) an upper bound of the tangent's eigenvalues for small strains, times the volume [J]."""

    @abstractmethod
    def adjoint(
        self, values: Values, positions: torch.Tensor, direction: torch.Tensor
    ) -> Callable[[], dict[str, torch.Tensor]]:
        """What computes -z . d residual / d value, by name, at the positions x for z = direction, when it is called.

        Args:
            values: the buffers.
            positions: (B, N, 3) buffer of x [m].
            direction: (B, N, 3) buffer of z [m].
        """


class PartTerm(Term):
    """A term on points that each belong to one of the energy's parts, with a value for every part.

    Args:
        launcher: of the potential.
        sets: one set of points.
        value: the name of the step's value, (B, count).
        part: (P,) number of each point's part.
        weights: (P,) of the points.
        count: of the parts.
    """

    def __init__(
        self,
        launcher: Launcher,
        sets: Sequence[PointSet],
        value: str,
        part: NDArray[np.int64],
        weights: NDArray[np.float64],
        count: int,
    ) -> None:
        super().__init__(launcher, sets)
        self.value, self.count = value, count
        self.weights = launcher.upload(weights, wp.float64)
        self.part = launcher.upload(part.astype(np.int32), int)
        own = np.eye(count)[part]
        self._own = torch.as_tensor(own, device=launcher.device)  # (P, count) one in its part
        self.part_of = torch.as_tensor(part, device=launcher.device)
        self.weight = torch.as_tensor(weights, device=launcher.device)

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """One value a part."""
        return {self.value: (self.count,)}

    def views(self, values: Values) -> list[Any]:
        """The step's values, as kernels take them, in the order of `shapes`."""
        found = [values[name] for name in self.shapes]
        return [warp_view(each, wp.float64) for each in found if each is not None]

    def sum_parts(self, values: torch.Tensor) -> torch.Tensor:
        """(B, count) sums of (B, P) values over the points of each part, in a fixed order."""
        return values @ self._own


class ValueTerm(PartTerm):
    """One whose derivatives all come from those by one value a part."""

    @abstractmethod
    def slope(self, s: PointSet, positions: Any, direction: Any) -> tuple[Any, list[Any]]:
        """Kernel of each point's part of the loss's derivative by its part's value, and its inputs."""

    def adjoint(
        self, values: Values, positions: torch.Tensor, direction: torch.Tensor
    ) -> Callable[[], dict[str, torch.Tensor]]:
        """See `Term.adjoint`."""
        del values
        own, (s,) = self.launcher, self.sets
        out = own.zeros(self.n_points)
        kernel, inputs = self.slope(s, warp_view(positions, wp.vec3d), warp_view(direction, wp.vec3d))
        command = own.record(kernel, (own.batch, s.n_points), inputs, [warp_view(out, wp.float64)])

        def differentiate() -> dict[str, torch.Tensor]:
            own.launch(command)
            return {self.value: self.sum_parts(out)}

        return differentiate
