"""An energy that is one Warp function: its kernels, its values over a step and its memory follow from it.

For example::

    class Spring(PointwiseEnergy):                       # k/2 (|x| - L)^2 between two vertices
        parameters = (Quantity("spring_stiffness", "N/m", 0.0), Quantity("spring_length", "m", 0.0))
        density = spring                                 # a Warp function of x (vec3d) and the values (vec2d)
        ...
        def points(self, mesh):
            return (between(self.pairs),)

The function gets what a point sees, a vector (a place, a difference of places) or a matrix (a deformation gradient),
and the values there: parameters, inputs, and values of the step, in the order in which they are declared. How exact
the derivatives are is said in `kernels.pointwise`.
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
from .base import BoundEnergy, Energy, EnergySite, EnergyStep, Memory, PartPoints, PointSet, ReadingTerm, Values
from .launcher import Launcher


class PointwiseEnergy(Energy):
    """Sum over points of a weight times a function of the point's operator value and its values.

    A parameter's value where a simulation is given no other is the attribute of its name. Energies that remember
    something declare `memory`, one number a point, which is zero for a body that has been at rest for long.

    Attributes:
        density: the Warp function e(f, v) [J over the unit of the weight], of a ``wp.vec3d`` or a ``wp.mat33d`` and a
            vector of float64.
        size: about the size of f, for the step of differences.
        memory: what a point carries from step to step.
        step_values: names of what `begin_step` returns; those of the memory where left out.
    """

    implicit_only: ClassVar[bool] = True

    density: ClassVar[Any]
    size: ClassVar[float] = 1.0
    memory: ClassVar[tuple[Quantity, ...]] = ()
    step_values: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    @override
    def points(self, mesh: Mesh) -> tuple[PartPoints, ...]:
        """Returns the points, such as those of `at_vertices`, `between` or `in_cells`, as a tuple of one set."""

    def begin_step(self, seen: torch.Tensor, values: Mapping[str, torch.Tensor]) -> Mapping[str, torch.Tensor]:
        """Returns the values (B, P) that hold during a step, by `step_values`; the memory itself where not overridden.

        Args:
            seen: (B, P, 3) or (B, P, 3, 3), what the points see at the start of the step.
            values: (1 or B, P) parameters, inputs and memory by name.
        """
        del seen
        return {quantity.name: values[quantity.name] for quantity in self.memory}

    def end_step(
        self, start: torch.Tensor, end: torch.Tensor, values: Mapping[str, torch.Tensor]
    ) -> Mapping[str, torch.Tensor]:
        """Returns the memory (B, P) after a step, by name.

        Args:
            start: what the points see at the start of the step, as in `begin_step`.
            end: what they see at its end.
            values: (1 or B, P) parameters, inputs and memory at the start, by name.
        """
        raise NotImplementedError(f"{type(self).__name__} has memory, but no end_step.")

    @property
    @override
    def constants(self) -> Mapping[str, Parameter]:
        return {quantity.name: getattr(self, quantity.name) for quantity in self.parameters}

    @property
    def value_names(self) -> tuple[str, ...]:
        """Names of the values of `density`; those of a step begin with the energy's class."""
        return (*(q.name for q in (*self.parameters, *self.inputs)), *map(self.own_name, self._of_step))

    @property
    def _of_step(self) -> tuple[str, ...]:
        return self.step_values or tuple(quantity.name for quantity in self.memory)

    def own_name(self, name: str) -> str:
        """Returns the name, among those of all energies, of a value of a step."""
        return f"{type(self).__name__}.{name}"

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "PointwiseTerm":
        return PointwiseTerm(launcher, sets, self)

    @override
    def bind(self, placement: EnergySite) -> "BoundPointwise":
        return BoundPointwise(self, placement)


class BoundPointwise(BoundEnergy):
    """A pointwise energy over the steps of a simulator."""

    def __init__(self, energy: PointwiseEnergy, placement: EnergySite) -> None:
        super().__init__(energy, placement)
        (points,) = placement.points
        assert isinstance(points, PartPoints)
        self._pointwise = energy
        self._nodes = torch.as_tensor(points.nodes, device=placement.rest_positions.device)
        self._operators = placement.tensor(points.gradients)  # (C, Q, K, 1 or 3)
        self._part = torch.as_tensor(points.part, device=placement.rest_positions.device)
        self.memory = tuple(Memory(q.name, q.unit, (points.n_points,), q.per or "point") for q in energy.memory)

    def _seen(self, q: torch.Tensor) -> torch.Tensor:
        """Returns the operator values of the points at positions (B, N, 3)."""
        seen = torch.einsum("cqkw,bcki->bcqiw", self._operators, q[:, self._nodes]).flatten(1, 2)
        return seen[..., 0] if seen.shape[-1] == 1 else seen

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
        if not energy._of_step:
            return {}
        values = energy.begin_step(self._seen(step.state.q), self._values(step))
        return {energy.own_name(name): values[name].expand(step.state.batch, -1) for name in energy._of_step}

    @override
    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        energy = self._pointwise
        return {energy.own_name(name): self._zeros(batch) for name in energy._of_step}

    @override
    def end_step(self, step: EnergyStep, x: torch.Tensor, q: torch.Tensor) -> dict[str, torch.Tensor]:
        if not self.memory:
            return {}
        return dict(self._pointwise.end_step(self._seen(step.state.q), self._seen(q), self._values(step)))


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
        acting = len(energy.parameters) + len(energy.inputs)
        own, count = names[acting:], energy.count
        shapes: dict[str, tuple[int, ...]] = {name: arrays.get(name, (count,)) for name in names[:acting]}
        shapes |= dict.fromkeys(own, (sets[0].n_points,))
        super().__init__(launcher, sets, kernels, shapes, count, own, list(arrays), [wp.float64(energy.size)])

    @override
    def curvature(self, values: Values) -> torch.Tensor:
        """Returns zero: the constant matrix of projective dynamics leaves these energies to L-BFGS."""
        del values
        return torch.zeros_like(self.weight)[None]


def at_vertices(vertices: ArrayLike, part: ArrayLike = 0) -> PartPoints:
    """Returns points of weight one whose operator gives the positions of vertices (P,).

    Args:
        vertices: their numbers.
        part: part number of every point, or of all points.
    """
    nodes = np.asarray(vertices, dtype=np.int64).reshape(-1, 1)
    return _unweighted(nodes, np.ones((len(nodes), 1, 1, 1)), part)


def between(pairs: ArrayLike, part: ArrayLike = 0) -> PartPoints:
    """Returns points of weight one whose operator gives the vectors between the vertices of pairs (P, 2).

    Args:
        pairs: numbers of the vertices.
        part: part number of every point, or of all points.
    """
    nodes = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    return _unweighted(nodes, np.tile(np.array([-1.0, 1.0])[:, None], (len(nodes), 1, 1, 1)), part)


def _unweighted(nodes: NDArray[np.int64], operators: NDArray[np.float64], part: ArrayLike) -> PartPoints:
    return PartPoints(nodes, operators, np.broadcast_to(part, len(nodes)).astype(np.int64), np.ones(len(nodes)))


def in_cells(mesh: Mesh, cells: ArrayLike) -> PartPoints:
    """Returns quadrature points of some cells; operators give the deformation gradient, weights are volumes [m^3].

    Args:
        mesh: the rest shape.
        cells: (M',) numbers of the cells.
    """
    points, weights = mesh.element.rule
    nodes = mesh.cells[np.asarray(cells, dtype=np.int64)]
    gradients, determinants = physical_gradients(mesh.vertices, nodes, mesh.element.shape(points)[1])
    volumes = (determinants * weights).ravel()
    return PartPoints(nodes, gradients, np.zeros(len(volumes), dtype=np.int64), volumes)
