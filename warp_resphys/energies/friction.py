r"""Bristle friction along lines (Dahl 1968), for the hysteresis of sliding braids, sleeves and cables.

A line between two vertices changes its length by the slide s. Bristles with the deflection z resist with F_c z / z_c,

    dz/ds = 1 - sgn(ds) z / z_c,

so that the force approaches the friction force F_c over the bristle length z_c, in both directions and independent of
the speed. From the deflection z_0 at the start of a step this is solved exactly:

    z(s) = sgn(s) z_c + (z_0 - sgn(s) z_c) exp(-|s| / z_c),
    F_c / z_c int z ds = F_c (|s| + (sgn(s) z_0 - z_c) (1 - exp(-|s| / z_c))),

a convex function of s that is part of the incremental potential. Its second derivative jumps where the slide reverses.
After many cycles of amplitude A the force-slide loop has the area 4 F_c (A - z_c tanh(A / z_c)).

P. R. Dahl: A solid friction model. The Aerospace Corporation, TOR-0158(3107-18)-1, 1968.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import ArrayLike
from typing_extensions import override

from ..io.errors import InputError
from ..kernels.friction import bristle_energy
from ..mesh.mesh import Mesh
from ..stepping.quantity import Parameter, Quantity
from .part_terms import PartPoints
from .pointwise import PointwiseEnergy, between


@dataclass(frozen=True)
class BristleFriction(PointwiseEnergy):
    """Dahl friction against changes in the lengths of lines (equations in the module's docstring).

    Parameters are ``friction_force`` F_c [N] and ``bristle_length`` z_c [m], memory is ``bristle_deflection`` z [m],
    with one value per line.

    Raises:
        InputError: no line, a line from a vertex to itself, or a value out of range.
    """

    parameters: ClassVar[tuple[Quantity, ...]] = (
        Quantity("friction_force", "N", 0.0, closed=True, per="line"),
        Quantity("bristle_length", "m", 0.0, per="line"),
    )
    memory: ClassVar[tuple[Quantity, ...]] = (Quantity("bristle_deflection", "m", per="line"),)
    step_values: ClassVar[tuple[str, ...]] = ("deflection", "length")
    density: ClassVar = bristle_energy
    size: ClassVar[float] = 1e-4
    rate_independent: ClassVar[bool] = True

    pairs: ArrayLike  # (L, 2) end vertices of each line
    friction_force: Parameter  # F_c [N]: a number, (L,), (B, 1) or (B, L) values
    bristle_length: Parameter  # z_c [m]: likewise

    def __post_init__(self) -> None:
        """Checks the values."""
        pairs = np.asarray(self.pairs)
        if pairs.ndim != 2 or pairs.shape[1] != 2 or not len(pairs) or (pairs[:, 0] == pairs[:, 1]).any():
            raise InputError(f"the lines of bristle friction are {pairs.tolist()}: give pairs of two vertices each.")
        for quantity, value in zip(self.parameters, self.constants.values(), strict=True):
            quantity.check(value)

    @property
    @override
    def count(self) -> int:
        return len(np.asarray(self.pairs))

    @override
    def points(self, mesh: Mesh) -> tuple[PartPoints, ...]:
        return (between(self.pairs, np.arange(self.count)),)

    @override
    def begin_step(self, start: torch.Tensor, values: Mapping[str, torch.Tensor]) -> Mapping[str, torch.Tensor]:
        return {"deflection": values["bristle_deflection"], "length": start.norm(dim=-1)}

    @override
    def end_step(
        self, start: torch.Tensor, end: torch.Tensor, values: Mapping[str, torch.Tensor]
    ) -> Mapping[str, torch.Tensor]:
        slide, length = end.norm(dim=-1) - start.norm(dim=-1), values["bristle_length"]
        most = slide.sign() * length
        return {"bristle_deflection": most + (values["bristle_deflection"] - most) * torch.exp(-slide.abs() / length)}
