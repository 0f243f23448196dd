"""Buffers, recorded launches and factors of a batch."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
import warp as wp

from ...io.kernel_cache import start_quietly
from ...kernels import hessian_blocks, line_search, minimisation, points, reductions
from ...kernels.lbfgs import lbfgs_kernels
from ...kernels.modules import compile_together
from ..energies.base import PlacedEnergy
from ..energies.launcher import BLOCK, lasting
from ..energies.potential import IncrementalPotential
from ..energies.solid import Solid
from ..fem.coordinates import Coordinates
from ..linalg.choice import make_linear_solver
from ..linalg.linear_solver import LinearSolver
from .assembly import BlockPattern
from .hessian import ExactHessian
from .minimiser import Minimiser
from .nonlinear_solver import make_minimiser
from .solver_settings import SolverSettings

T = TypeVar("T")
Shard = tuple[slice, "Workspace"]


def _kernels(
    energies: Sequence[PlacedEnergy], device: torch.device, dtype: torch.dtype
) -> list[Any]:
    """Returns a kernel of every module that a solve launches,
    but those of energies that are not materials.
    """
    scalar = wp.float64 if dtype == torch.float64 else wp.float32
    solids = [placed.energy for placed in energies if isinstance(placed.energy, Solid)]
    return [
        *(points.gather_cells, points.set_kernels(3).gather, reductions.masked_norm),
        *(solid.kernel(device) for solid in solids),
        hessian_blocks.pair_kernel(3) if device.type == "cuda" else hessian_blocks.cell_blocks,
        hessian_blocks.scatter_kernel(scalar),
        minimisation.begin,
        lbfgs_kernels(scalar).project,
        *(line_search.perturb, line_search.accept_kernel(scalar)),
    ]


class Workspace:
    """Buffers, launches and factors for one batch size of a body.

    Args:
        energies: energies of the body.
        coordinates: map from control vertices to all vertices.
        fixed: (D,) fixed vertices, on the device.
        pattern: block structure of the Hessian.
        batch: number of environments.
        device: device of every buffer.
        dtype: dtype of states and factors; the potential is evaluated in float64.

    Attributes:
        fixed: (D,) fixed vertices.
        held: (D + R,) fixed vertices, and those that slide in symmetry planes.
        shards: slices of the batch with a workspace each, if several threads share it, else empty.
    """

    def __init__(
        self,
        energies: Sequence[PlacedEnergy],
        coordinates: Coordinates,
        fixed: torch.Tensor,
        pattern: BlockPattern,
        batch: int,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.fixed = fixed
        eliminated = torch.as_tensor(
            np.setdiff1d(np.arange(coordinates.n_vertices), pattern.free), device=device
        )
        start_quietly()
        compile_together(_kernels(energies, device, dtype), device, BLOCK)
        self.potential = IncrementalPotential(energies, coordinates, eliminated, batch, device)
        self.held = torch.cat([fixed, self.potential.coordinates.sliding])
        self.pattern, self.dtype = pattern, dtype
        self._cache: dict[Any, Any] = {}
        self.shards: list[Shard] = []
        self._last: torch.Tensor | None = None

    @property
    def parts(self) -> "list[Shard]":
        """The shards, or the whole batch."""
        return self.shards or [(slice(None), self)]

    def record_positions(self, q: torch.Tensor) -> None:
        """Stores the positions (B, N, 3) at the end of a time step, for `follows`."""
        self._last = q.detach()

    def follows(self, q: torch.Tensor) -> torch.Tensor | None:
        """Returns (B,) whether positions are those at the end of the last time step.

        None before the first step.
        """
        return None if self._last is None else (q.detach() == self._last).flatten(1).all(1)

    def cached(self, key: Hashable, make: Callable[[], T]) -> T:
        """Returns an object of this batch, made at the first use of its key,
        for use outside of inference mode too.
        """
        if key not in self._cache:
            with lasting():
                self._cache[key] = make()
        value: T = self._cache[key]
        return value

    def minimiser(self, purpose: str, settings: SolverSettings) -> Minimiser:
        """Returns the minimiser for a purpose (dynamics, statics), with a factor of its own."""
        return self.cached(
            (purpose, settings),
            lambda: make_minimiser(self.potential, self.pattern, settings, self.dtype),
        )

    def hessian(self, linear_solver: str, dtype: torch.dtype = torch.float64) -> ExactHessian:
        """Returns the exact Hessian, for adjoint solves."""
        return self.cached(
            (linear_solver, dtype),
            lambda: ExactHessian(
                self.potential, self.pattern, self.linear_solver(linear_solver, dtype)
            ),
        )

    def linear_solver(self, name: str, dtype: torch.dtype = torch.float64) -> LinearSolver:
        """Returns a new linear solver for the Hessian."""
        p, k = self.potential, self.pattern
        return make_linear_solver(name, k.rows, k.cols, len(k.free), 3, p.device, dtype)
