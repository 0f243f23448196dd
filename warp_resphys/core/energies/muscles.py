r"""Muscles: contractile fibres along a direction in some cells of a solid.

At a point with the fibre direction a the stretch is lambda = |F a|, and the energy per volume is

    sigma lambda + k s(lambda - 1 + c),
    tension  t = sigma + k s'(lambda - 1 + c)   [Pa of the rest shape],

with an active stress sigma, and a tension-only fibre of stiffness k shortened by an active
contraction c; s(e) is max(e, 0)^2 / 2, smoothed over a short strain (`kernels.axial.muscle_pull`).
A negative stress pushes, like an inflated chamber whose walls are not modelled. Without inputs the
fibres are a reinforcement that stiffens the solid in tension (Spencer, Continuum Theory of the
Mechanics of Fibre-Reinforced Composites, 1984), but not in compression.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ...io.errors import InputError
from ...kernels.axial import MUSCLE
from ..fem.integration_points import physical_gradients
from ..mesh.volume_mesh import Mesh
from ..stepping.quantity import Parameter, Quantity, parameter
from .base import Energy
from .launcher import Launcher
from .term import LawTerm, PartPoints, PointLaw, PointSet

STRESS = Quantity(
    "muscle_stress",
    "Pa",
    per="muscle",
    typical=1e4,
    words="stress",
    shown_unit="kPa",
    shown_factor=1e-3,
)
CONTRACTION = Quantity(
    "muscle_contraction",
    "",
    per="muscle",
    typical=0.05,
    words="contraction",
    shown_unit="%",
    shown_factor=1e2,
)


@dataclass(frozen=True)
class Muscle:
    """A muscle, with one activation.

    Attributes:
        cells: (M',) indices of its cells.
        direction: (3,) fibre direction, of any length, or (M', 3) one per cell.
        name: name of the muscle.
    """

    cells: ArrayLike
    direction: ArrayLike
    name: str = ""


@dataclass(frozen=True)
class Muscles(Energy):
    """Contractile fibres (equation in the module's docstring).

    Inputs are ``muscle_stress`` [Pa] and ``muscle_contraction`` (a fraction of the fibres' length),
    the parameter is ``muscle_stiffness`` [Pa], with one value per muscle.

    Raises:
        InputError: no muscle, one without cells, a direction that is zero, not finite or of another
            shape, or a negative stiffness.
    """

    inputs: ClassVar[tuple[Quantity, ...]] = (STRESS, CONTRACTION)
    is_load: ClassVar[bool] = True

    muscles: Sequence[Muscle]
    # k [Pa]: a number, (A,), (B, 1) or (B, A) values
    stiffness: Parameter = parameter(0.0, "muscle_stiffness", "Pa", closed=True, per="muscle")
    toe: float = 1e-3  # strain at which a fibre reaches its full stiffness

    @override
    def moved(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> "Muscles":
        turned = [
            replace(muscle, direction=np.asarray(muscle.direction) @ rotation.T)
            for muscle in self.muscles
        ]
        return replace(self, muscles=turned)

    def __post_init__(self) -> None:
        """Checks the values."""
        if not self.muscles:
            raise InputError(
                "there is no muscle: name the cells and the direction of each, "
                "or leave the muscles out."
            )
        if len(set(self.names)) != self.count:
            raise InputError(
                f"muscles are called {', '.join(self.names)}: give each a name of its own."
            )
        for name, muscle in zip(self.names, self.muscles, strict=True):
            cells = np.asarray(muscle.cells)
            direction = np.asarray(muscle.direction, dtype=np.float64)
            if cells.ndim != 1 or not cells.size or not np.issubdtype(cells.dtype, np.integer):
                raise InputError(
                    f"the muscle '{name}' has cells of shape {cells.shape}: "
                    "give the numbers of one or more."
                )
            if direction.shape not in ((3,), (len(cells), 3)):
                raise InputError(
                    f"the muscle '{name}' has directions of shape {direction.shape}: give (3,), "
                    f"or one for each of its {len(cells)} cells."
                )
            if not np.isfinite(direction).all() or not np.linalg.norm(direction, axis=-1).all():
                raise InputError(f"the muscle '{name}' has a direction that is zero or not finite.")
        if not (np.isfinite(self.toe) and self.toe > 0.0):
            raise InputError(
                f"the strain over which muscle fibres tighten is {self.toe:g}: it must be positive."
            )
        super().__post_init__()

    @property
    @override
    def count(self) -> int:
        return len(self.muscles)

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return tuple(
            muscle.name or f"muscle_{number}" for number, muscle in enumerate(self.muscles, 1)
        )

    @override
    def points(self, mesh: Mesh) -> tuple[PartPoints, ...]:
        """Returns the quadrature points of the cells, once for every muscle of a cell.

        Raises:
            InputError: a cell that the mesh does not have.
        """
        points, weights = mesh.element.rule
        nodes, operators = [], []
        volumes, numbers = [], []
        for number, (name, muscle) in enumerate(zip(self.names, self.muscles, strict=True)):
            cells = np.asarray(muscle.cells, dtype=np.int64)
            wrong = cells[(cells < 0) | (cells >= len(mesh.cells))]
            if len(wrong):
                raise InputError(
                    f"the muscle '{name}' runs through cell {wrong[0]}, but there are "
                    f"{len(mesh.cells)}."
                )
            direction = np.broadcast_to(
                np.asarray(muscle.direction, dtype=np.float64), (len(cells), 3)
            )
            unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
            gradients, determinants = physical_gradients(
                mesh.vertices, mesh.cells[cells], mesh.element.shape(points)[1]
            )
            nodes.append(mesh.cells[cells])
            operators.append(np.einsum("cqki,ci->cqk", gradients, unit)[..., None])
            volumes.append((determinants * weights).ravel())
            numbers.append(np.full(determinants.size, number))
        return (PartPoints(*map(np.concatenate, (nodes, operators, numbers, volumes))),)

    def lines(self, mesh: Mesh) -> dict[str, NDArray[np.float64]]:
        """Returns a line (2, 3) through the centre of each muscle,
        over the extent of its cells [m], by name.
        """
        lines = {}
        for name, muscle in zip(self.names, self.muscles, strict=True):
            corners = mesh.vertices[np.unique(mesh.cells[np.asarray(muscle.cells)])]
            along = np.atleast_2d(np.asarray(muscle.direction, dtype=np.float64)).mean(axis=0)
            size, middle = np.linalg.norm(along), corners.mean(axis=0)
            unit = along / size if size > 0.0 else along  # Directions that cancel have no line.
            reach = (corners - middle) @ unit
            lines[name] = middle + np.outer([reach.min(), reach.max()], unit)
        return lines

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> LawTerm:
        shapes = dict.fromkeys(
            ("muscle_stress", "muscle_contraction", "muscle_stiffness"), (self.count,)
        )

        def stiffness(values: Mapping[str, torch.Tensor]) -> torch.Tensor:
            return values["muscle_stress"].clamp_min(0.0) + values["muscle_stiffness"]

        law = PointLaw(MUSCLE, [self.toe], stiffness)
        return LawTerm(launcher, sets, law, shapes, self.count)
