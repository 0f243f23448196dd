"""Energies given as one Warp function, from which kernels, values of a step and memory follow.

For example::

    class Spring(PointwiseEnergy):                       # k/2 (|x| - L)^2 between two vertices
        parameters = (Quantity("spring_stiffness", "N/m", 0.0), Quantity("spring_length", "m", 0.0))
        density = spring                                 # a Warp function of x (vec3d) and the values (vec2d)
        ...
        def points(self, mesh):
            return (between(self.pairs),)

The function takes the kinematic variable of a point, a vector (a position, a difference of positions) or a matrix (a
deformation gradient), and the values at the point: parameters, inputs, and values of the step, in the order of their
declaration. `kernels.pointwise` describes the accuracy of the derivatives.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ..fem.elements import physical_gradients
from ..io.errors import InputError
from ..kernels.pointwise import pointwise_kernels
from ..mesh.mesh import Mesh
from ..stepping.quantity import Parameter, Quantity
from .base import BoundEnergy, Energy, EnergySite, EnergyStep, Memory, PointSet, Values
from .launcher import Launcher
from .part_terms import PartPoints, ReadingTerm


class PointwiseEnergy(Energy):
    """The sum over points of a weight times a function of the point's kinematic variable and values.

    The default value of a parameter is the attribute of its name. Energies with memory declare `memory`, one number per
    point, which is zero for a body long at rest.

    Attributes:
        density: the Warp function e(f, v) [J over the unit of the weight], of a ``wp.vec3d`` or a ``wp.mat33d`` and a
            vector of float64.
        size: typical size of f, for the step of finite differences.
        memory: memory variables of a point.
        step_values: names of the results of `begin_step`; those of the memory if empty.
        rate_independent: as for `BoundEnergy`.
    """

    density: ClassVar[Any]
    size: ClassVar[float] = 1.0
    memory: ClassVar[tuple[Quantity, ...]] = ()
    step_values: ClassVar[tuple[str, ...]] = ()
    rate_independent: ClassVar[bool] = False

    @abstractmethod
    @override
    def points(self, mesh: Mesh) -> tuple[PartPoints, ...]:
        """Returns a tuple with one set of points, from `at_vertices`, `between` or `in_cells` for example."""

    def begin_step(self, start: torch.Tensor, values: Mapping[str, torch.Tensor]) -> Mapping[str, torch.Tensor]:
        """Returns the values (B, P) of a step, by the names in `step_values`; by default, the memory.

        Args:
            start: (B, P, 3) or (B, P, 3, 3) kinematic variable at the start of the step.
            values: (1 or B, P) parameters, inputs and memory by name.
        """
        del start
        return {quantity.name: values[quantity.name] for quantity in self.memory}

    def end_step(
        self, start: torch.Tensor, end: torch.Tensor, values: Mapping[str, torch.Tensor]
    ) -> Mapping[str, torch.Tensor]:
        """Returns the memory (B, P) after a step, by name.

        Args:
            start: kinematic variable at the start of the step, as in `begin_step`.
            end: kinematic variable at the end of the step.
            values: (1 or B, P) parameters, inputs and memory at the start, by name.
        """
        raise NotImplementedError(f"{type(self).__name__} has memory, but no end_step.")

    @property
    @override
    def constants(self) -> Mapping[str, Parameter]:
        return {quantity.name: getattr(self, quantity.name) for quantity in self.parameters}

    @property
    def value_names(self) -> tuple[str, ...]:
        """Names of the values of `density`; values of a step have the energy's class as prefix."""
        return (*(q.name for q in (*self.parameters, *self.inputs)), *map(self.own_name, self._step_names))

    @property
    def _step_names(self) -> tuple[str, ...]:
        return self.step_values or tuple(quantity.name for quantity in self.memory)

    def own_name(self, name: str) -> str:
        """Returns the full name of a value of a step."""
        return f"{type(self).__name__}.{name}"

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "PointwiseTerm":
        return PointwiseTerm(launcher, sets, self)

    @override
    def bind(self, site: EnergySite) -> "BoundPointwise":
        return BoundPointwise(self, site)


class BoundPointwise(BoundEnergy):
    """A pointwise energy in a simulator."""

    def __init__(self, energy: PointwiseEnergy, site: EnergySite) -> None:
        super().__init__(energy, site)
        (points,) = site.points
        assert isinstance(points, PartPoints)
        self._pointwise, self.rate_independent = energy, energy.rate_independent
        self._nodes = torch.as_tensor(points.nodes, device=site.rest_positions.device)
        self._operators = site.tensor(points.gradients)  # (C, Q, K, 1 or 3)
        self._part = torch.as_tensor(points.part, device=site.rest_positions.device)
        self.memory = tuple(Memory(q.name, q.unit, (points.n_points,), q.per or "point") for q in energy.memory)

    def _kinematics(self, q: torch.Tensor) -> torch.Tensor:
        """Returns the kinematic variable at the points for positions (B, N, 3)."""
        f = torch.einsum("cqkw,bcki->bcqiw", self._operators, q[:, self._nodes]).flatten(1, 2)
        return f[..., 0] if f.shape[-1] == 1 else f

    def _values(self, step: EnergyStep) -> dict[str, torch.Tensor]:
        """Returns parameters, inputs and memory at the points, by name."""
        energy, zeros = self._pointwise, self._zeros(step.state.batch)
        constants = {q: step.constants.value(q.name) for q in energy.parameters}
        values = {q.name: value if q.shape else value[:, self._part] for q, value in constants.items()}
        for quantity in energy.inputs:
            given = step.inputs.actuation.get(quantity.name)
            values[quantity.name] = zeros if given is None else given[:, self._part]
        return values | {q.name: step.state.memory.get(q.name, zeros) for q in energy.memory}

    def _zeros(self, batch: int) -> torch.Tensor:
        return self._operators.new_zeros(batch, len(self._part))

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        energy = self._pointwise
        if not energy._step_names:
            return {}
        values = energy.begin_step(self._kinematics(step.state.q), self._values(step))
        return {energy.own_name(name): values[name].expand(step.state.batch, -1) for name in energy._step_names}

    @override
    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        energy = self._pointwise
        return {energy.own_name(name): self._zeros(batch) for name in energy._step_names}

    @override
    def end_step(self, step: EnergyStep, x: torch.Tensor, q: torch.Tensor) -> dict[str, torch.Tensor]:
        if not self.memory:
            return {}
        return dict(self._pointwise.end_step(self._kinematics(step.state.q), self._kinematics(q), self._values(step)))


class PointwiseTerm(ReadingTerm):
    """Kernels of a pointwise energy."""

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], energy: PointwiseEnergy) -> None:
        kernels, names = pointwise_kernels(energy.density), energy.value_names
        arrays = {q.name: q.shape for q in energy.parameters if q.shape}
        values = len(names) - len(arrays) + sum(int(np.prod(shape)) for shape in arrays.values())
        if kernels.values._length_ != values:
            raise InputError(
                f"the density of {type(energy).__name__} takes {kernels.values._length_} values, but the energy has "
                f"{values}: {', '.join(names)}."
            )
        first, count = len(energy.parameters) + len(energy.inputs), energy.count
        per_point = names[first:]
        shapes: dict[str, tuple[int, ...]] = {name: arrays.get(name, (count,)) for name in names[:first]}
        shapes |= dict.fromkeys(per_point, (sets[0].n_points,))
        super().__init__(launcher, sets, kernels, shapes, count, per_point, list(arrays), [wp.float64(energy.size)])

    @override
    def curvature(self, values: Values) -> torch.Tensor:
        """Returns zero: the constant matrix of projective dynamics does not contain these energies."""
        del values
        return torch.zeros_like(self.weight)[None]


def at_vertices(vertices: ArrayLike, part: ArrayLike = 0) -> PartPoints:
    """Returns points of weight one at vertices (P,); the kinematic variable is the position.

    Args:
        vertices: vertex numbers.
        part: part of each point, or of all.
    """
    nodes = np.asarray(vertices, dtype=np.int64).reshape(-1, 1)
    return _unweighted(nodes, np.ones((len(nodes), 1, 1, 1)), part)


def between(pairs: ArrayLike, part: ArrayLike = 0) -> PartPoints:
    """Returns points of weight one for pairs of vertices (P, 2); the kinematic variable is the vector between them.

    Args:
        pairs: vertex numbers.
        part: part of each point, or of all.
    """
    nodes = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    return _unweighted(nodes, np.tile(np.array([-1.0, 1.0])[:, None], (len(nodes), 1, 1, 1)), part)


def _unweighted(nodes: NDArray[np.int64], operators: NDArray[np.float64], part: ArrayLike) -> PartPoints:
    return PartPoints(nodes, operators, np.broadcast_to(part, len(nodes)).astype(np.int64), np.ones(len(nodes)))


def in_cells(mesh: Mesh, cells: ArrayLike) -> PartPoints:
    """Returns the quadrature points of cells, weighted by volume [m^3]; the variable is the deformation gradient.

    Args:
        mesh: the rest shape.
        cells: (M',) cell indices.
    """
    points, weights = mesh.element.rule
    nodes = mesh.cells[np.asarray(cells, dtype=np.int64)]
    gradients, determinants = physical_gradients(mesh.vertices, nodes, mesh.element.shape(points)[1])
    volumes = (determinants * weights).ravel()
    return PartPoints(nodes, gradients, np.zeros(len(volumes), dtype=np.int64), volumes)
