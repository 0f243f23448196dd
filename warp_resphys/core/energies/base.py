"""Interface of an energy: points, parameters, inputs, memory, kernels and derivatives.

==============  =========  ===================================================================
class           one per    purpose
==============  =========  ===================================================================
`Energy`        body       declares parameters (which can be identified) and inputs (functions
                           of time), and makes the other two
`BoundEnergy`   simulator  turns parameters into values, begins and ends a step, declares its
                           memory
`Term`          batch      kernels on the points, and their arguments
==============  =========  ===================================================================

Simulator, solver, adjoint, tape, gradient check, identification and configuration use only this
interface.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy.sparse
import torch
from numpy.typing import NDArray

from ...io.errors import InputError
from ..fem.bodies import Body
from ..fem.integration_points import Points
from ..mesh.volume_mesh import Mesh
from ..stepping.inputs import check_tensor
from ..stepping.integrators import Integrator
from ..stepping.quantity import Parameter, Quantity, quantities_of
from ..stepping.state import ImplicitStage, Mass, State
from .launcher import Launcher
from .term import PointSet, Term, Values, value_of


@dataclass(frozen=True)
class Memory:
    """A memory variable: a tensor that an energy carries from step to step, in `State.memory`."""

    name: str
    unit: str
    shape: tuple[int, ...]  # without the batch axis
    per: str  # meaning of the first axis, such as ``tendon``

    def check(self, values: Any, batch: int, like: torch.Tensor) -> None:
        """Raises InputError for a wrong shape, dtype or device, or values that are not finite."""
        shape = (batch, *self.shape)
        if isinstance(values, torch.Tensor) and tuple(values.shape) != shape:
            raise InputError(
                f"state.memory[{self.name!r}] has shape {tuple(values.shape)}: it must be "
                f"{shape} (environments, {self.per}s, ...); take the state from a simulator of "
                "this body, or leave the memory out."
            )
        check_tensor(f"state.memory[{self.name!r}]", values, shape, self.unit, self.per, like)


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
        return torch.as_tensor(
            values, device=self.rest_positions.device, dtype=self.rest_positions.dtype
        )


@dataclass(frozen=True)
class EnergyStep:
    """One time step, or a static equilibrium as an endless one, as an energy sees it."""

    state: State  # state at the start
    stage: ImplicitStage  # the implicit solve of the step
    inputs: Mapping[str, torch.Tensor]  # inputs by name, without those that are not given
    fixed_positions: torch.Tensor | None  # (B, D, 3) at the end of the step [m]
    values: Values  # values of the energy that follow from the parameters (`BoundEnergy.prepare`)
    gravity: torch.Tensor  # (1 or B, 3) [m/s^2]
    term: Term  # term of the energy for the state's batch

    def value(self, name: str) -> torch.Tensor:
        """Returns a value that is never None, such as a parameter."""
        return value_of(self.values, name)


class Energy(ABC):
    """One energy of a body.

    Attributes:
        inputs: inputs of the energy, with `count` values each.
        is_load: whether it is a load, which counts among the balancing forces in the convergence
            test.
        is_barrier: whether the energy is infinite at some positions (`Term.feasible`).
    """

    inputs: ClassVar[tuple[Quantity, ...]] = ()
    is_load: ClassVar[bool] = False
    is_barrier: ClassVar[bool] = False

    @property
    def parameters(self) -> tuple[Quantity, ...]:
        """Parameters of the energy, by default those of its fields that are made by
        `stepping.quantity.parameter`.
        """
        return tuple(quantities_of(self).values())

    @property
    def count(self) -> int:
        """Number of parts (chambers, tendons), each
        with its own value of an input or a parameter.
        """
        return 1

    def count_of(self, quantity: Quantity) -> int:
        """Returns the number of values of a parameter or an input:
        `count`, or one that all parts share.
        """
        del quantity
        return self.count

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts."""
        return tuple(str(number + 1) for number in range(self.count))

    @property
    def defaults(self) -> Mapping[str, Parameter]:
        """Default values of the parameters."""
        return {
            quantity.name: getattr(self, name) for name, quantity in quantities_of(self).items()
        }

    def __post_init__(self) -> None:
        """Raises InputError for a parameter out of range."""
        defaults = self.defaults
        for quantity in self.parameters:
            quantity.check(defaults[quantity.name])

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
        """Returns the energy on a simulator's device.

        Overridden by energies with memory or values of a step.
        """
        return BoundEnergy(self, site)

    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Returns the values that follow from the parameters, computed once per roll-out.

        Args:
            parameters: (1 or B, 1 or n) parameters of all energies by name.

        Raises:
            InputError: another number of values than `count`.
        """
        return {
            quantity.name: self.per_part(quantity, parameters[quantity.name])
            for quantity in self.parameters
        }

    def per_part(self, quantity: Quantity, values: torch.Tensor) -> torch.Tensor:
        """Returns (1 or B, `count_of`) values of a parameter, or an array parameter
        (1 or B, *shape) unchanged.

        Raises:
            InputError: another number of values.
        """
        if quantity.shape:
            return values
        count = self.count_of(quantity)
        if values.shape[1] not in (1, count):
            per = quantity.per or "part"
            named = ", ".join(name for name in self.names if not name.isdigit())
            raise InputError(
                f"{quantity.name} has {values.shape[1]} values for {count} "
                f"{per}s{named and f' ({named})'}: give one value, or one for each {per}."
            )
        return values.expand(-1, count)


class BoundEnergy:
    """An energy in a simulator.

    This base class has no memory and no values that depend on the step.

    Args:
        energy: the energy.
        site: the simulator as the energy sees it.

    Attributes:
        memory: memory variables.
        rate_independent: whether a step depends on no time. Then a static equilibrium is a step
            too, with memory, and `at_rest` is not used.
    """

    memory: tuple[Memory, ...] = ()
    rate_independent: bool = False

    def __init__(self, energy: Energy, site: EnergySite) -> None:
        self.energy, self.site = energy, site

    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor | None]:
        """Returns the values that follow from the parameters,
        computed once per roll-out (`Energy.prepare`).
        """
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

    def at_pose(self, q: torch.Tensor, values: Values) -> dict[str, torch.Tensor | None]:
        """Returns these values for an equilibrium whose forces depend
        on its own positions in ways without a potential.

        Args:
            q: (B, N, 3) the equilibrium, or positions near it [m].
            values: the other values of the term by name, such as inputs.
        """
        del q, values
        return {}

    def load(self, step: EnergyStep) -> torch.Tensor | None:
        """Returns a dead load (1 or B, N, 3), independent of the positions [N], or None."""
        del step
        return None

    def load_at_fixed(self, q: torch.Tensor, values: Values) -> torch.Tensor | None:
        """Returns what the forces (B, N, 3) at fixed vertices have beyond the energy's slope [N],
        or None.

        Args:
            q: (B, N, 3) solution of a step or an equilibrium [m].
            values: the values of the term by name.
        """
        del q, values
        return None

    def end_step(
        self, step: EnergyStep, x: torch.Tensor, q: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """Returns the memory variables (B, ...) after a step, by name.

        Called only if `memory` is not empty.

        Args:
            step: the step.
            x: (B, N, 3) solution of its implicit stage [m].
            q: (B, N, 3) positions at its end [m].
        """
        del step, x, q
        return {}


@dataclass(frozen=True)
class PlacedEnergy:
    """An energy, its points in the simulator, and the prefix
    of its names there, such as ``tip_``.
    """

    energy: Energy
    points: tuple[Points, ...]  # points with operators on control vertices (`fem.coordinates`)
    prefix: str = ""
    # points with operators on all vertices; None if they are the same
    all_points: tuple[Points, ...] | None = None
    body: Body | None = None  # body of the energy
    first: int = 0  # index of that body's first vertex in the simulator

    @classmethod
    def of(
        cls,
        whole: Body,
        body: Body,
        first: int,
        energy: Energy,
        points: Sequence[Points],
        prefix: str = "",
    ) -> "PlacedEnergy":
        """Places an energy of a body in a simulator.

        Args:
            whole: the simulator's body or scene.
            body: the body.
            first: index of its first vertex in the simulator.
            energy: the energy.
            points: points of the energy, with the body's own vertex numbers.
            prefix: prefix of the energy's names.
        """
        shifted = tuple(item.shifted(first) for item in points)
        return cls(
            energy, tuple(map(whole.coordinates.compose, shifted)), prefix, shifted, body, first
        )
