"""Interface of an energy: points, parameters, inputs, memory, kernels and derivatives.

=================  =============  ===========================================================================
class              one per        purpose
=================  =============  ===========================================================================
`Energy`           body           declares parameters (constants that can be identified) and inputs (functions
                                  of time), and makes the other two
`BoundEnergy`      simulator      turns parameters into values, begins and ends a step, declares its memory
`Term`             batch          kernels on the points, and their arguments
=================  =============  ===========================================================================

Simulator, solver, adjoint, tape, gradient check, identification and configuration use only this interface.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import scipy.sparse
import torch
import warp as wp
from numpy.typing import NDArray

from ..fem.bodies import Body
from ..fem.integration_points import Points
from ..io.errors import InputError
from ..kernels.points import MatrixPoints, VectorPoints
from ..mesh.volume_mesh import Mesh
from ..stepping.inputs import Inputs, check_tensor
from ..stepping.integrators import Integrator
from ..stepping.quantity import Parameter, Quantity
from ..stepping.state import Constants, ImplicitStage, Mass, State
from .launcher import Launcher, struct_of, warp_view

Values = Mapping[str, torch.Tensor | None]
Adjoint = Callable[[], dict[str, torch.Tensor]]  # computes derivatives by values, by name


def value_of(values: Values, name: str) -> torch.Tensor:
    """Returns a value that is never None."""
    value = values[name]
    assert value is not None
    return value


@dataclass(frozen=True)
class Memory:
    """A memory variable: a tensor that an energy carries from step to step, in `State.memory`."""

    name: str
    unit: str
    shape: tuple[int, ...]  # without the batch axis
    per: str  # meaning of the first axis, such as ``string``

    def check(self, values: Any, batch: int, like: torch.Tensor) -> None:
        """Raises InputError for a wrong shape, dtype or device, or values that are not finite."""
        shape = (batch, *self.shape)
        if isinstance(values, torch.Tensor) and tuple(values.shape) != shape:
            raise InputError(
                f"state.memory[{self.name!r}] has shape {tuple(values.shape)}: it must be {shape} (environments, "
                f"{self.per}s, ...); take the state from a simulator of this body, or leave the memory out."
            )
        check_tensor(f"state.memory[{self.name!r}]", values, shape, self.unit, self.per, like)


@dataclass(frozen=True)
class PairTangents:
    """Second derivatives of energies of four vertices each.

    Attributes:
        environment: (A,) environments.
        nodes: (A, 4) vertices.
        blocks: (A, 12, 12) second derivatives by the 12 coordinates [N/m].
    """

    environment: torch.Tensor
    nodes: torch.Tensor
    blocks: torch.Tensor


@dataclass(frozen=True)
class EnergySite:
    """The simulator as an energy sees it; its vertices may belong to several bodies."""

    body: Body  # body of the energy
    first: int  # index of that body's first vertex
    points: tuple[Points, ...]  # points of the energy, with the simulator's vertex numbers
    rest_positions: torch.Tensor  # (N, 3) of all bodies [m], with the simulator's device and dtype
    method: Integrator
    time_step: float  # h [s]

    @property
    def mass_volume(self) -> scipy.sparse.csc_array:
        """(N, M) `Body.mass_volume`, with rows for all vertices [m^3]."""
        return self._padded(self.body.mass_volume)

    @property
    def load_volume(self) -> scipy.sparse.csc_array:
        """(N, M) `Body.load_volume`, with rows for all vertices [m^3]."""
        return self._padded(self.body.load_volume)

    def _padded(self, matrix: scipy.sparse.csr_array) -> scipy.sparse.csc_array:
        coo = matrix.tocoo()
        shape = (len(self.rest_positions), matrix.shape[1])
        return scipy.sparse.csc_array((coo.data, (coo.row + self.first, coo.col)), shape)

    def tensor(self, values: Any) -> torch.Tensor:
        """Returns values with the simulator's device and dtype."""
        return torch.as_tensor(values, device=self.rest_positions.device, dtype=self.rest_positions.dtype)


@dataclass(frozen=True)
class EnergyStep:
    """One time step, as an energy sees it."""

    state: State  # state at the start
    stage: ImplicitStage  # the implicit solve of the step
    inputs: Inputs
    constants: Constants
    term: "Term"  # term of the energy for the state's batch


class PointSet:
    """A set of points on a launcher's device.

    Attributes:
        source: the points on the host.
        part: range of these points among the points of all energies.
        own: range of these points among those of their energy.
        cells: C.
        points_per_cell: Q.
        nodes_per_cell: K.
        n_points: P = C Q.
        n_vertices: N.
        device: device of the launcher.
        width: components of an operator: 3, or 1 if the energy is a function of a vector.
        points: the points on the device (``kernels.points``).
        start: (N + 1) first entry of each vertex in ``incident``.
        incident: cell K + local node, for every cell of a vertex.
    """

    def __init__(self, launcher: Launcher, points: Points, n_vertices: int, part: slice, own: slice) -> None:
        self.source, self.part, self.own, self.n_points = points, part, own, points.n_points
        self.n_vertices, self.device = n_vertices, launcher.device
        self.cells, self.points_per_cell, self.nodes_per_cell, self.width = points.gradients.shape
        vertex = points.nodes.ravel()
        # Padded nodes have a zero gradient.
        entries = np.flatnonzero(np.abs(points.gradients).sum(axis=(1, 3)).ravel() > 0.0)
        order = entries[np.argsort(vertex[entries], kind="stable")]
        start = np.searchsorted(vertex[order], np.arange(n_vertices + 1))
        nodes = launcher.upload(points.nodes.astype(np.int32), int)
        shape = (-1, self.nodes_per_cell) if self.width == 1 else (-1, self.nodes_per_cell, 3)
        kind, scalar = (VectorPoints, wp.float64) if self.width == 1 else (MatrixPoints, wp.vec3d)
        operators = launcher.upload(points.gradients.reshape(shape), scalar)
        self.points = struct_of(kind, nodes=nodes, operators=operators, per_cell=self.points_per_cell)
        self.start = launcher.upload(start.astype(np.int32), int)
        self.incident = launcher.upload(order.astype(np.int32), int)

    @property
    def blocks(self) -> int:
        """Number of 3 x 3 blocks in a point's tangent."""
        return 1 if self.width == 1 else 6

    def stress_view(self, stress: torch.Tensor) -> Any:
        """Returns the Warp array of a stress (B, P, 3, width)."""
        return warp_view(stress[..., 0], wp.vec3d) if self.width == 1 else warp_view(stress, wp.mat33d)


def points_reader(s: PointSet) -> Callable[[torch.Tensor], torch.Tensor]:
    """Returns the function from a field (B, N, 3) to its values (B, P, 3) at points with a width of one."""
    nodes = torch.as_tensor(s.source.nodes, device=s.device)  # (C, K)
    weights = torch.as_tensor(s.source.gradients[..., 0], device=s.device)  # (C, Q, K)
    return lambda field: torch.einsum("cqk,bcki->bcqi", weights, field[:, nodes]).flatten(1, 2)


class Energy(ABC):
    """One energy of a body.

    Attributes:
        inputs: inputs of the energy, with `count` values each.
        is_load: whether it is a load, which counts among the balancing forces in the convergence test.
        is_barrier: whether the energy is infinite at some positions (`Term.feasible`).
    """

    inputs: ClassVar[tuple[Quantity, ...]] = ()
    is_load: ClassVar[bool] = False
    is_barrier: ClassVar[bool] = False

    @property
    def parameters(self) -> tuple[Quantity, ...]:
        """Parameters of the energy."""
        return ()

    @property
    def count(self) -> int:
        """Number of parts (chambers, tendons), each with its own value of an input or a parameter."""
        return 1

    def count_of(self, quantity: Quantity) -> int:
        """Returns the number of values of a parameter or an input: `count`, or one that all parts share."""
        del quantity
        return self.count

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

    def moved(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> "Energy":
        """Returns the energy of the body at R x + t; obstacles stay where they are.

        Args:
            rotation: (3, 3) R.
            translation: (3,) t [m].
        """
        del rotation, translation
        return self

    def bind(self, site: EnergySite) -> "BoundEnergy":
        """Returns the energy on a simulator's device; overridden by energies with memory or values of a step."""
        return BoundEnergy(self, site)

    def prepare(self, constants: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Returns the values that follow from the parameters, computed once per roll-out.

        Args:
            constants: (1 or B, 1 or n) parameters of all energies by name.

        Raises:
            InputError: another number of values than `count`.
        """
        return {quantity.name: self.per_part(quantity, constants[quantity.name]) for quantity in self.parameters}

    def per_part(self, quantity: Quantity, values: torch.Tensor) -> torch.Tensor:
        """Returns (1 or B, `count_of`) values of a parameter, or an array parameter (1 or B, *shape) unchanged.

        Raises:
            InputError: another number of values.
        """
        if quantity.shape:
            return values
        count = self.count_of(quantity)
        if values.shape[1] not in (1, count):
            per, named = quantity.per or "part", ", ".join(name for name in self.names if not name.isdigit())
            raise InputError(
                f"{quantity.name} has {values.shape[1]} values for {count} {per}s{named and f' ({named})'}: give one "
                f"value, or one for each {per}."
            )
        return values.expand(-1, count)


class BoundEnergy:
    """An energy in a simulator; this base class has no memory and no values that depend on the step.

    Args:
        energy: the energy.
        site: the simulator as the energy sees it.

    Attributes:
        memory: memory variables.
        rate_independent: whether a step depends on no time. Then a static equilibrium is a step too, with memory, and
            `at_rest` is not used.
    """

    memory: tuple[Memory, ...] = ()
    rate_independent: bool = False

    def __init__(self, energy: Energy, site: EnergySite) -> None:
        self.energy, self.site = energy, site

    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor | None]:
        """Returns the values that follow from the parameters, computed once per roll-out (`Energy.prepare`)."""
        return dict(self.energy.prepare(parameters))

    def mass(self, parameters: Mapping[str, torch.Tensor]) -> Mass | None:
        """Returns the mass of the energy's material, or None."""
        del parameters
        return None

    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        """Returns the values of the energy's term that depend on the step."""
        del step
        return {}

    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        """Returns these values for a static equilibrium."""
        del batch
        return {}

    def at_pose(self, q: torch.Tensor, values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor | None]:
        """Returns these values for an equilibrium whose forces depend on its own positions in ways without a potential.

        Args:
            q: (B, N, 3) the equilibrium, or positions near it [m].
            values: the other values of the term by name, such as inputs.
        """
        del q, values
        return {}

    def load(self, inputs: Inputs, constants: Constants, batch: int, static: bool) -> torch.Tensor | None:
        """Returns a dead load (1 or B, N, 3), independent of the positions [N], or None.

        Args:
            inputs: inputs of the step.
            constants: constants of the roll-out.
            batch: number of environments B.
            static: whether it is for an equilibrium instead of a step.
        """
        del inputs, constants, batch, static
        return None

    def end_step(self, step: EnergyStep, x: torch.Tensor, q: torch.Tensor) -> dict[str, torch.Tensor]:
        """Returns the memory variables (B, ...) after a step, by name; called only if `memory` is not empty.

        Args:
            step: the step.
            x: (B, N, 3) solution of its implicit stage [m].
            q: (B, N, 3) positions at its end [m].
        """
        del step, x, q
        return {}


class WholeCells(NamedTuple):
    """Kernels with one thread per cell.

    Attributes:
        step: adds forces to a residual (B, N) and sets the points' energies (B, P).
        tangent: sets the tangent's blocks (B, P, blocks).
        inputs: of both after ``active``, and of the second after ``clamp`` too.
    """

    step: Any
    tangent: Any
    inputs: list[Any]


class Term(ABC):
    """An energy's kernels for a batch.

    The values of a step are tensors (B, *shape) by name: buffers that recorded launches read.

    Args:
        launcher: launcher of the potential.
        sets: points of the energy.

    Attributes:
        couples_cells: whether the term may have `low_rank` columns or `pair_tangents`.
        has_pairs: whether it may have the latter.
    """

    couples_cells = False
    has_pairs = False
    _kernels: Any  # with ``local_step`` and ``tangent``

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet]) -> None:
        self.launcher, self.sets = launcher, tuple(sets)
        self.n_points = sum(s.n_points for s in self.sets)

    @property
    @abstractmethod
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Shape of every value of a step, without the batch, by name."""

    def total_stiffness(self, values: Values) -> torch.Tensor | None:
        """Returns the sum (B,) of a solid's moduli times volumes, the scale of its energy's rounding error [J]."""
        del values
        return None

    def before(self, values: Values, positions: Any, active: Any) -> list[Any]:
        """Returns launches to be made before the kernels of `step` and `tangent`, at the same positions."""
        del values, positions, active
        return []

    def low_rank(self, values: Values, positions: Any) -> torch.Tensor | None:
        """Returns columns C (B, 3 N, r) of the part C C^T of the Hessian that couples many cells, or None."""
        del values, positions
        return None

    def pair_tangents(self, values: Values, positions: Any, clamp: bool, active: torch.Tensor) -> PairTangents | None:
        """Returns the part of the Hessian that couples vertices of different cells, or None.

        Args:
            values: buffers of the values.
            positions: Warp array (B, N) of the positions [m].
            clamp: whether negative eigenvalues are left out.
            active: (B,) zero for environments that are left out.
        """
        del values, positions, clamp, active
        return None

    def set_step(self, values: Values) -> None:
        """Prepares a step, after its values have been copied to the buffers."""
        del values

    def improve_start(self, positions: Any) -> None:
        """Changes positions (B, N) at which a solve may start, a Warp array, so that it takes fewer iterations."""
        del positions

    def check_start(self, values: Values, start: torch.Tensor, follows: bool) -> None:
        """Raises InputError where a solve cannot start at positions.

        Args:
            values: buffers of the values.
            start: (B, N, 3) `feasible` positions of all terms, fixed vertices where they were before [m].
            follows: whether the step begins where the last one ended.
        """
        del values, start, follows

    def free_way(self, origin: torch.Tensor, end: torch.Tensor, share: torch.Tensor) -> None:
        """Lowers the share (B,) of the way of fixed vertices, between positions (B, N, 3) [m], that others leave free.

        Up to that share, no barrier is passed, although no other vertex moves.
        """
        del origin, end, share

    def feasible(self, values: Values) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Returns positions of finite energy, if there are others; a solve does not pass by those.

        Returns:
            Positions (B, N, 3) [m], and the vertices (V,) that this term may have moved there.
        """
        del values
        return None

    def bounds(self, values: Values, origin: Any, positions: Any, share: Any) -> list[Any]:
        """Returns launches that lower the share (B) of the way from one array of positions (B, N) to another.

        Up to that share, which depends on no other term and no order, no barrier is passed.
        """
        del values, origin, positions, share
        return []

    @abstractmethod
    def _arguments(self, s: PointSet, values: Values, positions: Any) -> list[Any]:
        """Returns the inputs that the kernels ``local_step`` and ``tangent`` have in common."""

    def step(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        """Returns the kernel of stress and energy, and its inputs after ``active``."""
        return self._kernels.local_step, self._arguments(s, values, positions)

    def tangent(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        """Returns the kernel of the tangent's blocks, and its inputs after ``active`` and ``clamp``."""
        return self._kernels.tangent, self._arguments(s, values, positions)

    def whole_cells(self, s: PointSet, values: Values, positions: Any) -> WholeCells | None:
        """Returns kernels with one thread per cell, in place of those of `step` and `tangent`, or None.

        They add forces directly, so that there is no stress of the points.
        """
        del s, values, positions
        return None

    @abstractmethod
    def curvature(self, values: Values) -> torch.Tensor:
        """Returns an upper bound (1 or B, P) of the tangent's eigenvalues at small strains, times the volume [J]."""

    @abstractmethod
    def adjoint(self, values: Values, positions: torch.Tensor, direction: torch.Tensor) -> Adjoint:
        """Returns a function that computes -z . d residual / d value at positions x, by name, from the buffers.

        Args:
            values: buffers of the values.
            positions: (B, N, 3) buffer of x [m].
            direction: (B, N, 3) buffer of z [m].
        """
