r"""Contractile fibres (muscles) along a direction in chosen cells of a solid.

At a point with the unit direction a the fibre has the stretch lambda = |F a|, and the energy of a volume is

    sigma lambda + k s(lambda - 1 + c),     tension  t = sigma + k s'(lambda - 1 + c)   [Pa of the rest shape],

an active stress sigma, and a fibre of stiffness k that an active contraction c shortens, s being half the square of
what is positive, rounded over a short strain (`kernels.muscles.tension`). A negative stress pushes, as an inflated
chamber does whose walls are not modelled. Without an input, fibres of a stiffness are a
reinforcement: the solid is stiffer along them where it is stretched (Spencer, Continuum Theory of the Mechanics of
Fibre-Reinforced Composites, 1984), and as it was where it is compressed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ..fem.elements import Points, physical_gradients
from ..io.errors import InputError
from ..kernels import muscles as kernels
from ..mesh.mesh import Mesh
from ..stepping.quantity import Parameter, Quantity
from .base import Energy, PartTerm, PointSet, Values
from .launcher import Launcher, warp_view

STRESS = Quantity(
    *("muscle_stress", "Pa"),
    per="muscle",
    typical=1e4,
    words="stress",
    shown_unit="kPa",
    shown_factor=1e-3,
)
CONTRACTION = Quantity(
    *("muscle_contraction", ""), per="muscle", typical=0.05, words="contraction", shown_unit="%", shown_factor=1e2
)


@dataclass(frozen=True)
class MusclePoints(Points):
    """Quadrature points of the cells of muscles; a cell that two of them cross is there twice."""

    muscle: NDArray[np.int64]  # (P,) number of its muscle
    volume: NDArray[np.float64]  # (P,) [m^3]


@dataclass(frozen=True)
class Muscle:
    """Fibres of one activation.

    Attributes:
        cells: (M',) numbers of the cells that they run through.
        direction: (3,) along which they run, of any length, or (M', 3) one for each cell.
        name: of the muscle.
    """

    cells: ArrayLike
    direction: ArrayLike
    name: str = ""


@dataclass(frozen=True)
class Muscles(Energy):
    """Contractile fibres, see the module.

    Its inputs are ``muscle_stress`` [Pa] and ``muscle_contraction`` (a share of the fibres' length), its parameter
    ``muscle_stiffness`` [Pa]; each has a value for every muscle.

    Raises:
        InputError: no muscle, one without cells, a direction that is zero, not finite or of another shape, or a
            negative stiffness.
    """

    parameters: ClassVar[tuple[Quantity, ...]] = (Quantity("muscle_stiffness", "Pa", 0.0, closed=True, per="muscle"),)
    inputs: ClassVar[tuple[Quantity, ...]] = (STRESS, CONTRACTION)
    is_load: ClassVar[bool] = True
    implicit_only: ClassVar[bool] = True

    muscles: Sequence[Muscle]
    # k [Pa], the parameter ``muscle_stiffness``: a number, (A,) values with one for each muscle, (B, 1), or (B, A)
    stiffness: Parameter = 0.0
    toe: float = 1e-3  # strain over which a fibre tightens

    def __post_init__(self) -> None:
        """Checks the values."""
        if not self.muscles:
            raise InputError("there is no muscle: name the cells and the direction of each, or leave the muscles out.")
        if len(set(self.names)) != self.count:
            raise InputError(f"muscles are called {', '.join(self.names)}: give each a name of its own.")
        for name, muscle in zip(self.names, self.muscles, strict=True):
            cells, direction = np.asarray(muscle.cells), np.asarray(muscle.direction, dtype=np.float64)
            if cells.ndim != 1 or not cells.size or not np.issubdtype(cells.dtype, np.integer):
                raise InputError(
                    f"the muscle '{name}' has cells of shape {cells.shape}: give the numbers of one or more."
                )
            if direction.shape not in ((3,), (len(cells), 3)):
                raise InputError(
                    f"the muscle '{name}' has directions of shape {direction.shape}: give (3,), or one for each of its "
                    f"{len(cells)} cells."
                )
            if not np.isfinite(direction).all() or not np.linalg.norm(direction, axis=-1).all():
                raise InputError(f"the muscle '{name}' has a direction that is zero or not finite.")
        if not (np.isfinite(self.toe) and self.toe > 0.0):
            raise InputError(f"the strain over which muscle fibres tighten is {self.toe:g}: it must be positive.")
        self.parameters[0].check(self.stiffness)

    @property
    @override
    def count(self) -> int:
        return len(self.muscles)

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return tuple(each.name or f"muscle_{number}" for number, each in enumerate(self.muscles, 1))

    @property
    @override
    def constants(self) -> Mapping[str, Parameter]:
        return {"muscle_stiffness": self.stiffness}

    @override
    def points(self, mesh: Mesh) -> tuple[MusclePoints, ...]:
        """The points at which the energy is integrated, those of the solid's shape term.

        Raises:
            InputError: a cell that there is not.
        """
        points, weights = mesh.element.rule
        nodes, operators, volumes, numbers = [], [], [], []
        for number, (name, muscle) in enumerate(zip(self.names, self.muscles, strict=True)):
            cells = np.asarray(muscle.cells, dtype=np.int64)
            wrong = cells[(cells < 0) | (cells >= len(mesh.cells))]
            if len(wrong):
                raise InputError(f"the muscle '{name}' runs through cell {wrong[0]}, but there are {len(mesh.cells)}.")
            direction = np.broadcast_to(np.asarray(muscle.direction, dtype=np.float64), (len(cells), 3))
            unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
            gradients, determinants = physical_gradients(
                mesh.vertices, mesh.cells[cells], mesh.element.shape(points)[1]
            )
            operator = np.zeros_like(gradients)  # (C, Q, K, 3)
            operator[..., 0] = np.einsum("cqki,ci->cqk", gradients, unit)
            nodes.append(mesh.cells[cells])
            operators.append(operator)
            volumes.append((determinants * weights).ravel())
            numbers.append(np.full(determinants.size, number))
        cells, operator = np.concatenate(nodes), np.concatenate(operators)
        return (MusclePoints(cells, operator, np.concatenate(numbers), np.concatenate(volumes)),)

    def lines(self, mesh: Mesh) -> dict[str, NDArray[np.float64]]:
        """(2, 3) a line through the middle of each muscle, as far as its cells reach along it [m], by name."""
        found = {}
        for name, muscle in zip(self.names, self.muscles, strict=True):
            corners = mesh.vertices[np.unique(mesh.cells[np.asarray(muscle.cells)])]
            along = np.atleast_2d(np.asarray(muscle.direction, dtype=np.float64)).mean(axis=0)
            size, middle = np.linalg.norm(along), corners.mean(axis=0)
            unit = along / size if size > 0.0 else along  # Directions that cancel have no line.
            reach = (corners - middle) @ unit
            found[name] = middle + np.outer([reach.min(), reach.max()], unit)
        return found

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "MuscleTerm":
        return MuscleTerm(launcher, sets, self)


class MuscleTerm(PartTerm):
    """Kernels of muscles.

    Args:
        launcher: of the potential.
        sets: the points.
        muscles: whose they are.
    """

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], muscles: Muscles) -> None:
        (s,) = sets
        assert isinstance(s.source, MusclePoints)
        super().__init__(launcher, sets, "muscle_stress", s.source.muscle, s.source.volume, muscles.count)
        self._toe = wp.float64(muscles.toe)

    @property
    @override
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        return dict.fromkeys(("muscle_stress", "muscle_contraction", "muscle_stiffness"), (self.count,))

    def _arguments(self, s: PointSet, values: Values, positions: Any) -> list[Any]:
        volume = [s.nodes, s.gradients, self.weights, self.part]
        return [*volume, *self.views(values), self._toe, s.points_per_cell, positions]

    @override
    def step(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        return kernels.local_step, self._arguments(s, values, positions)

    @override
    def tangent(self, s: PointSet, values: Values, positions: Any, positive: Any) -> tuple[Any, list[Any]]:
        return kernels.tangent, [*self._arguments(s, values, positions), positive]

    @override
    def curvature(self, values: Values) -> torch.Tensor:
        stress, stiffness = values["muscle_stress"], values["muscle_stiffness"]
        assert stress is not None
        assert stiffness is not None
        return self.weight * (stress.clamp_min(0.0) + stiffness)[:, self.part_of]

    @override
    def adjoint(
        self, values: Values, positions: torch.Tensor, direction: torch.Tensor
    ) -> Callable[[], dict[str, torch.Tensor]]:
        """See `Term.adjoint`."""
        own, (s,) = self.launcher, self.sets
        out = own.zeros(self.n_points, 3)
        _, contraction, stiffness = self.views(values)
        views = [warp_view(each, wp.vec3d) for each in (positions, direction)]
        volume = [s.nodes, s.gradients, self.weights, self.part]
        inputs = [*volume, contraction, stiffness, self._toe, s.points_per_cell, *views]
        command = own.record(kernels.adjoint, (own.batch, s.n_points), inputs, [warp_view(out, wp.vec3d)])

        def differentiate() -> dict[str, torch.Tensor]:
            own.launch(command)
            return {name: self.sum_parts(part) for name, part in zip(self.shapes, out.unbind(-1), strict=True)}

        return differentiate
