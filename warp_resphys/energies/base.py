"""The contract of an energy: its points, parameters, inputs and memory, its kernels and their derivatives.

=================  =========  ===============================================================================
class              lives      what it does
=================  =========  ===============================================================================
`Energy`           host       declares parameters (constants that may be identified) and inputs (loads and
                              actuation over time), and makes the other two
`BoundEnergy`      simulator  turns parameters into values, begins and ends a step, declares its memory
`Term`             batch      kernels on the points, and their arguments
=================  =========  ===============================================================================

Simulator, solver, adjoint, tape, gradient check, identification and configuration know this contract and no energy by
name.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy.sparse
import torch
import warp as wp
from numpy.typing import NDArray
from typing_extensions import override

from ..fem.body import Body
from ..fem.elements import Points
from ..io.errors import InputError
from ..mesh.mesh import Mesh
from ..stepping.constants import Constants, Mass
from ..stepping.inputs import Inputs, check_tensor
from ..stepping.integrators import Integrator
from ..stepping.quantity import Parameter, Quantity
from ..stepping.state import ImplicitStage, State
from .launcher import Launcher, warp_view

Values = Mapping[str, torch.Tensor | None]


@dataclass(frozen=True)
class Memory:
    """A tensor that an energy carries from one step to the next, in `State.memory`."""

    name: str
    unit: str
    shape: tuple[int, ...]  # without the environments
    per: str  # what its first axis counts, such as ``string``

    def check(self, values: Any, batch: int, like: torch.Tensor) -> None:
        """Checks shape, type, device and finiteness of values.

        Args:
            values: values of the memory.
            batch: environments B.
            like: a tensor on the device and of the type of the simulator.

        Raises:
            InputError: values that do not fit.
        """
        shape = (batch, *self.shape)
        if isinstance(values, torch.Tensor) and tuple(values.shape) != shape:
            raise InputError(
                f"state.memory[{self.name!r}] has shape {tuple(values.shape)}: it must be {shape} (environments, "
                f"{self.per}s, ...); take the state from a simulator of this body, or leave the memory out."
            )
        check_tensor(f"state.memory[{self.name!r}]", values, shape, self.unit, self.per, like)


@dataclass(frozen=True)
class PartPoints(Points):
    """Points with a weight, each of which belongs to one part of an energy, such as a chamber or a tendon."""

    part: NDArray[np.int64]  # (P,) number of the part
    weights: NDArray[np.float64]  # (P,) factor of the point's energy: a volume, an area, a length, or one


@dataclass(frozen=True)
class EnergySite:
    """Data of the simulator that an energy is bound to, whose vertices may belong to several bodies."""

    body: Body  # body of the energy
    first: int  # number of that body's first vertex
    points: tuple[Points, ...]  # points of the energy, by the simulator's vertices
    rest_positions: torch.Tensor  # (N, 3) of all bodies [m], on the simulator's device and of its type
    method: Integrator
    time_step: float  # h [s]

    @property
    def mass_volume(self) -> scipy.sparse.csc_array:
        """Volume (N, M) of the body's elements that the vertices carry as mass [m^3]."""
        return self._padded(self.body.mass_volume)

    @property
    def load_volume(self) -> scipy.sparse.csc_array:
        """Volume (N, M) of the body's elements whose weight acts on the vertices [m^3]."""
        return self._padded(self.body.load_volume)

    def _padded(self, matrix: scipy.sparse.csr_array) -> scipy.sparse.csc_array:
        """Returns a matrix (N', M) of the body's vertices with rows for all."""
        coo = matrix.tocoo()
        shape = (len(self.rest_positions), matrix.shape[1])
        return scipy.sparse.csc_array((coo.data, (coo.row + self.first, coo.col)), shape)

    def tensor(self, values: Any) -> torch.Tensor:
        """Returns values on the simulator's device, in its type."""
        return torch.as_tensor(values, device=self.rest_positions.device, dtype=self.rest_positions.dtype)


@dataclass(frozen=True)
class EnergyStep:
    """One time step, as an energy sees it."""

    state: State  # start of the step
    stage: ImplicitStage  # implicit solve of the integrator
    inputs: Inputs
    constants: Constants
    term: "Term"  # term of the energy in the state's batch


class PointSet:
    """Points of one set on a launcher's device.

    Attributes:
        source: the points on the host.
        part: slice of the points of all energies.
        own: slice of the points of their own energy.
        cells: C.
        points_per_cell: Q.
        nodes_per_cell: K.
        n_points: P = C Q.
        n_vertices: N.
        nodes: (C, K).
        width: components of an operator: 3, or 1 where the energy is a function of a vector, see ``kernels.points``.
        gradients: (P, K) operators.
        start: (N + 1) first entry of each vertex in ``incident``.
        incident: cell K + local node of every cell that a vertex belongs to.
    """

    def __init__(self, launcher: Launcher, points: Points, n_vertices: int, part: slice, own: slice) -> None:
        self.source, self.part, self.own, self.n_points = points, part, own, points.n_points
        self.n_vertices = n_vertices
        self.cells, self.points_per_cell, self.nodes_per_cell, self.width = points.gradients.shape
        owner = points.nodes.ravel()
        # A padded node repeats its patch's own vertex with a zero gradient and contributes nothing.
        entries = np.flatnonzero(np.abs(points.gradients).sum(axis=(1, 3)).ravel() > 0.0)
        order = entries[np.argsort(owner[entries], kind="stable")]
        start = np.searchsorted(owner[order], np.arange(n_vertices + 1))
        self.nodes = launcher.upload(points.nodes.astype(np.int32), int)
        shape = (-1, self.nodes_per_cell) if self.width == 1 else (-1, self.nodes_per_cell, 3)
        self.gradients = launcher.upload(points.gradients.reshape(shape), wp.float64 if self.width == 1 else wp.vec3d)
        self.start = launcher.upload(start.astype(np.int32), int)
        self.incident = launcher.upload(order.astype(np.int32), int)

    @property
    def blocks(self) -> int:
        """3 x 3 blocks of a point's tangent."""
        return 1 if self.width == 1 else 6

    def stress_view(self, stress: torch.Tensor) -> Any:
        """Returns the Warp array of a stress (B, P, 3, width)."""
        return warp_view(stress[..., 0], wp.vec3d) if self.width == 1 else warp_view(stress, wp.mat33d)


class Energy(ABC):
    """One energy of a body.

    Attributes:
        inputs: loads and actuation over time, with `count` values.
        is_load: whether its forces count as loads in the scale of a step's residual.
        implicit_only: whether it acts at the end of a step for every coupling of the simulator's loads.
    """

    inputs: ClassVar[tuple[Quantity, ...]] = ()
    is_load: ClassVar[bool] = False
    implicit_only: ClassVar[bool] = False

    @property
    def parameters(self) -> tuple[Quantity, ...]:
        """Constants of the energy."""
        return ()

    @property
    def count(self) -> int:
        """Number of parts (chambers, tendons) with an input or a parameter value of their own."""
        return 1

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts."""
        return tuple(str(number + 1) for number in range(self.count))

    @property
    def constants(self) -> Mapping[str, Parameter]:
        """Default values of the parameters."""
        return {}

    @abstractmethod
    def points(self, mesh: Mesh) -> tuple[Points, ...]:
        """Returns the energy's sets of points on a body's rest shape."""

    @abstractmethod
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "Term":
        """Returns the energy's kernels for a batch."""

    def bind(self, placement: EnergySite) -> "BoundEnergy":
        """Returns the energy in a simulator; an energy that depends on the start of a step has a class of its own."""
        return BoundEnergy(self, placement)

    def prepare(self, constants: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Returns the values for the energy's terms, computed once a roll-out from the constants.

        Args:
            constants: (1 or B, 1 or n) tensors of all energies, by name.

        Raises:
            InputError: a number of values other than `count`.
        """
        return {quantity.name: self.per_part(quantity, constants[quantity.name]) for quantity in self.parameters}

    def per_part(self, quantity: Quantity, values: torch.Tensor) -> torch.Tensor:
        """Returns (1 or B, `count`) values of a parameter, or an array (1 or B, *shape) as it is.

        Raises:
            InputError: a number of values other than one or `count`.
        """
        if quantity.shape:
            return values
        if values.shape[1] not in (1, self.count):
            raise InputError(
                f"{quantity.name} has {values.shape[1]} values for {self.count} {quantity.per}s: give one value, or "
                f"one for each {quantity.per}."
            )
        return values.expand(-1, self.count)


class BoundEnergy:
    """An energy over the steps of a simulator; the base class is an energy without memory.

    Args:
        energy: the energy to bind.
        placement: its points in the simulator.

    Attributes:
        memory: quantities carried from step to step.
    """

    memory: tuple[Memory, ...] = ()

    def __init__(self, energy: Energy, placement: EnergySite) -> None:
        self.energy, self.placement = energy, placement

    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor | None]:
        """Returns the values that follow from the parameters, computed once a roll-out."""
        return dict(self.energy.prepare(parameters))

    def mass(self, parameters: Mapping[str, torch.Tensor]) -> Mass | None:
        """Returns the mass of the energy's matter, or None."""
        del parameters
        return None

    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        """Returns the values of the energy's term that depend on the step."""
        del step
        return {}

    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        """Returns the values of `begin_step` for an equilibrium, where nothing moves."""
        del batch
        return {}

    def load(self, inputs: Inputs, constants: Constants, batch: int, static: bool) -> torch.Tensor | None:
        """Returns a force (1 or B, N, 3) that does not depend on the positions [N].

        Args:
            inputs: of the step.
            constants: of the roll-out.
            batch: environments B.
            static: whether the force is for an equilibrium instead of a step.
        """
        del inputs, constants, batch, static
        return None

    def end_step(self, step: EnergyStep, x: torch.Tensor, q: torch.Tensor) -> dict[str, torch.Tensor]:
        """Returns the memory (B, ...) after a step, by name.

        Args:
            step: the step.
            x: (B, N, 3) solution of its implicit stage [m].
            q: (B, N, 3) positions at its end [m].
        """
        del step, x, q
        return {}


class Term(ABC):
    """An energy's kernels on the points of a batch.

    The step's values are tensors (B, *shape) by name: buffers that recorded launches read.

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
        """Shapes of the step's values by name, without the batch."""

    def total_stiffness(self, values: Values) -> torch.Tensor | None:
        """Returns the sum (B,) of a solid's moduli times volumes [J], the scale of its energy's rounding error."""
        del values
        return None

    def before(self, values: Values, positions: Any, active: Any) -> list[Any]:
        """Returns launches that must run before the kernels of `step` and `tangent`."""
        del values, positions, active
        return []

    def low_rank(self, values: Values, positions: Any) -> torch.Tensor | None:
        """Returns columns C (B, 3 N, r) of the tangent's low-rank part C C^T, which couples vertices of many cells."""
        del values, positions
        return None

    @abstractmethod
    def step(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        """Returns the kernel of stress and energy, and its inputs after ``active``."""

    @abstractmethod
    def tangent(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        """Returns the kernel of the tangent's blocks, and its inputs after ``active`` and ``clamp``."""

    @abstractmethod
    def curvature(self, values: Values) -> torch.Tensor:
        """Returns an upper bound (1 or B, P) of the tangent's eigenvalues for small strains, times the volume [J]."""

    @abstractmethod
    def adjoint(
        self, values: Values, positions: torch.Tensor, direction: torch.Tensor
    ) -> Callable[[], dict[str, torch.Tensor]]:
        """Returns a function that computes -z . d residual / d value, by name, at the positions x for z = direction.

        Args:
            values: the buffers.
            positions: (B, N, 3) buffer of x [m].
            direction: (B, N, 3) buffer of z [m].
        """


class PartTerm(Term):
    """A term on `PartPoints` with one value for every part.

    Args:
        launcher: of the potential.
        sets: one set of points.
        value: the name of the step's value, (B, count).
        count: number of parts.
    """

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], value: str, count: int) -> None:
        super().__init__(launcher, sets)
        (s,) = sets
        assert isinstance(s.source, PartPoints)
        self.value, self.count = value, count
        self.weights = launcher.upload(s.source.weights, wp.float64)
        self.part = launcher.upload(s.source.part.astype(np.int32), int)
        own = np.eye(count)[s.source.part]
        self._own = torch.as_tensor(own, device=launcher.device)  # (P, count) one in its part
        self.part_of = torch.as_tensor(s.source.part, device=launcher.device)
        self.weight = torch.as_tensor(s.source.weights, device=launcher.device)

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """One value a part."""
        return {self.value: (self.count,)}

    def views(self, values: Values) -> list[Any]:
        """Returns the step's values as Warp arrays, in the order of `shapes`."""
        own = [values[name] for name in self.shapes]
        return [warp_view(value, wp.float64) for value in own if value is not None]

    def sum_parts(self, values: torch.Tensor) -> torch.Tensor:
        """Returns sums (B, count) of values (B, P) over the points of each part, in a fixed order."""
        return values @ self._own


class ReadingTerm(Term):
    """A term on `PartPoints` whose kernels read any number of values at each point; see ``kernels.values``.

    Args:
        launcher: of the potential.
        sets: one set of points.
        kernels: ``local_step``, ``tangent`` and ``adjoint``, and the vector type ``values``.
        shapes: of the values, in the order of the vector: (count,) or (count, n) for values by part, (P,) for values by
            point.
        count: number of parts.
        own: names of the values by point.
        arrays: names of arrays, of any shape, that every point reads as a whole.
        extra: arguments of the kernels after the values.
    """

    def __init__(
        self,
        launcher: Launcher,
        sets: Sequence[PointSet],
        kernels: Any,
        shapes: Mapping[str, tuple[int, ...]],
        count: int,
        own: Sequence[str] = (),
        arrays: Sequence[str] = (),
        extra: Sequence[Any] = (),
    ) -> None:
        super().__init__(launcher, sets)
        (s,) = sets
        assert isinstance(s.source, PartPoints)
        self._kernels, self._shapes, self._extra = kernels, dict(shapes), extra
        self._point_values, self._arrays = frozenset(own), frozenset(arrays)
        self.part_of = torch.as_tensor(s.source.part, device=launcher.device)
        self.weight = torch.as_tensor(s.source.weights, device=launcher.device)
        self._own = torch.as_tensor(np.eye(count)[s.source.part], device=launcher.device)  # (P, count) one in its part
        self._weights = launcher.upload(s.source.weights, wp.float64)
        self._places = {name: self._places_of(name, s.source.part) for name in self._shapes}
        self._place = launcher.upload(np.concatenate(list(self._places.values())).astype(np.int32), int)
        sizes = [int(np.prod(shape)) for name, shape in self._shapes.items() for _ in self._places[name]]
        self._sizes = launcher.upload(np.array(sizes, dtype=np.int32), int)

    def _places_of(self, name: str, part: NDArray[np.int64]) -> NDArray[np.int64]:
        """Returns the columns (n, P) of every point's values in its array."""
        if name in self._arrays:
            return np.tile(np.arange(int(np.prod(self._shapes[name])))[:, None], len(part))
        columns = int(np.prod(self._shapes[name][1:]))
        first = np.arange(len(part)) if name in self._point_values else part
        return np.stack([first * columns + k for k in range(columns)])

    @property
    @override
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        return self._shapes

    def _arguments(self, s: PointSet, values: Values, positions: Any) -> list[Any]:
        tensors = [values[name] for name in self._shapes for _ in self._places[name]]
        addresses = np.array([tensor.data_ptr() for tensor in tensors if tensor is not None], dtype=np.uint64)
        read = [self.launcher.upload(addresses, wp.uint64), self._sizes, self._place]
        return [s.nodes, s.gradients, self._weights, *read, *self._extra, s.points_per_cell, positions]

    @override
    def step(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        return self._kernels.local_step, self._arguments(s, values, positions)

    @override
    def tangent(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        return self._kernels.tangent, self._arguments(s, values, positions)

    @override
    def adjoint(
        self, values: Values, positions: torch.Tensor, direction: torch.Tensor
    ) -> Callable[[], dict[str, torch.Tensor]]:
        own, (s,) = self.launcher, self.sets
        out = own.zeros(self.n_points, self._kernels.values._length_)
        inputs = [*self._arguments(s, values, warp_view(positions, wp.vec3d)), warp_view(direction, wp.vec3d)]
        view = warp_view(out, self._kernels.values)
        command = own.record(self._kernels.adjoint, (own.batch, s.n_points), inputs, [view])

        def differentiate() -> dict[str, torch.Tensor]:
            own.launch(command)
            slopes, first = {}, 0
            for name, shape in self._shapes.items():
                slope = out[..., first : first + len(self._places[name])]
                if name in self._arrays:
                    slope = slope.sum(1)
                elif name not in self._point_values:
                    slope = torch.einsum("bpn,pc->bcn", slope, self._own)
                slopes[name] = slope.reshape(own.batch, *shape).clone()
                first += len(self._places[name])
            return slopes

        return differentiate
