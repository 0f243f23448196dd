"""Symmetric linear systems of a batch of bodies: what every factorisation offers.

A solver is built once for a sparsity pattern; it says at which ``address`` of its value array each matrix entry
belongs, so that one Warp kernel assembles for every layout. ``factor`` turns a batch of value arrays into a `Factor`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import torch
from numpy.typing import NDArray
from typing_extensions import override

from ..io.errors import InputError

Indices = NDArray[np.int64]
_MOST_VALUES = 2**31 // 8 - 1  # Warp's strides are 32-bit numbers of bytes.


class Factor(ABC):
    """A factorised batch of matrices.

    Attributes:
        approximate: whether solutions in place are rough.
        failed: (B,) bool; matrices that are not positive definite and have no factor: their solutions are not finite.
    """

    failed: NDArray[np.bool_]
    approximate = False

    @abstractmethod
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        """Solves for (B, n, m) right-hand sides; a factor of batch 1 serves every environment of the batch."""

    def solve_in_place(self, columns: torch.Tensor) -> None:
        """Overwrites (B, n) right-hand sides, in the order of the linear solver, by their solutions."""
        columns.copy_(self.solve(columns[:, :, None])[:, :, 0])


class CorrectedFactor(Factor):
    """A factor of A + C C^T from one of A (Sherman, Morrison and Woodbury).

    Args:
        factor: of A.
        columns: (B, n, r) C.
        order: (n,) unknown at each place of the linear solver.
    """

    def __init__(self, factor: Factor, columns: torch.Tensor, order: torch.Tensor) -> None:
        self.factor, self.columns, self._order = factor, columns, order
        self.failed = factor.failed
        self._solved = factor.solve(columns)
        small = torch.eye(columns.shape[2], device=columns.device, dtype=columns.dtype) + columns.mT @ self._solved
        self._small = torch.linalg.lu_factor_ex(small)[:2]

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        found = self.factor.solve(rhs)
        return found - self._solved @ torch.linalg.lu_solve(*self._small, self.columns.mT @ found)

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        if self.factor.approximate:  # What is rough along C would be amplified.
            super().solve_in_place(columns)
            return
        self.factor.solve_in_place(columns)
        along = self.columns[:, self._order].mT @ columns[:, :, None]
        columns -= (self._solved[:, self._order] @ torch.linalg.lu_solve(*self._small, along))[:, :, 0]


class SeparateFactors(Factor):
    """A factor for each matrix of a batch, made one after another; None for a matrix that has none.

    Args:
        solver: whose order right-hand sides in place have.
        matrices: B, or one for all environments.
        factorise: the factor of matrix i; None where it is not positive definite.
        idle: (B,) matrices that keep the factor they have, if any.
        before: the factors they have.

    Attributes:
        factors: of the B matrices.
    """

    def __init__(
        self,
        solver: "LinearSolver",
        matrices: torch.Tensor,
        factorise: Callable[[int, torch.Tensor], Any],
        idle: torch.Tensor | None,
        before: Factor | None,
    ) -> None:
        kept = before if isinstance(before, type(self)) else None
        self._solver, left_out = solver, [False] * len(matrices) if idle is None else idle.tolist()
        self.failed = np.zeros(len(matrices), dtype=bool)
        self.factors: list[Any] = []
        for i, matrix in enumerate(matrices):
            if left_out[i]:
                self.factors.append(None if kept is None else kept.factors[i])
                self.failed[i] = kept is not None and kept.failed[i]
            else:
                self.factors.append(factorise(i, matrix))
                self.failed[i] = self.factors[i] is None

    @abstractmethod
    def _overwrite(self, factor: Any, rows: torch.Tensor, exact: bool) -> None:
        """Overwrites contiguous right-hand sides (m, n) by the solutions, or where not `exact` by rough ones."""

    def _overwrite_all(self, blocks: torch.Tensor, exact: bool) -> None:
        for factor, failed, rows in zip(self.factors, self.failed, blocks, strict=True):
            if failed:
                rows.fill_(torch.nan)
            elif factor is not None:
                self._overwrite(factor, rows, exact)

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        b, n, m = rhs.shape
        rows = rhs[:, self._solver.dofs].mT.reshape((1, b * m, n) if len(self.factors) == 1 else (b, m, n))
        rows = rows.contiguous()
        self._overwrite_all(rows, exact=True)
        return rows.view(b, m, n).mT[:, self._solver.places]

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        self._overwrite_all(columns[None] if len(self.factors) == 1 else columns[:, None], exact=False)


class LinearSolver(ABC):
    """Factorises symmetric matrices of one sparsity pattern.

    Args:
        rows: (E,) node row of each stored block, ``rows >= cols``.
        cols: (E,) node column of each stored block.
        n_nodes: rows and columns of the matrix in nodes.
        block: unknowns a node (3 for a Hessian, 1 for a projective-dynamics matrix).
        device: where values and right-hand sides live.
        dtype: their type.
        positions: (n_nodes, 3) of the nodes [m], for solvers that make use of them.

    Raises:
        InputError: a matrix too large for the layout.

    Attributes:
        address: (E, block^2) place of each block's entries in the value array, -1 where not stored.
        n_values: length of the value array.
        overwrites: whether `factor` writes over the values.
        iterates: whether a factor costs little beside its solutions, which are found by iterations.
        order: (n_nodes,) node at each place of its right-hand sides `in place <Factor.solve_in_place>`.
    """

    address: NDArray[np.int32]
    n_values: int
    order: Indices
    overwrites = False
    iterates = False

    def __init__(
        self,
        rows: Indices,
        cols: Indices,
        n_nodes: int,
        block: int,
        device: torch.device,
        dtype: torch.dtype,
        positions: NDArray[np.float64] | None = None,
    ) -> None:
        self.positions = positions
        self.n = n_nodes * block
        self.block = block
        self.device = device
        self.dtype = dtype
        self.order = np.arange(n_nodes)
        self._lay_out(rows, cols, n_nodes)
        if self.n_values > _MOST_VALUES:
            raise InputError(
                f"a {type(self).__name__} for {self.n} unknowns needs {self.n_values:.1e} numbers, beyond the "
                f"{_MOST_VALUES:.1e} that a kernel addresses: choose solver.linear_solver=sparse or multigrid."
            )

    @abstractmethod
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        """Chooses an order and sets ``address`` and ``n_values``."""

    def factor(
        self,
        values: torch.Tensor,
        definite: bool = True,
        columns: torch.Tensor | None = None,
        idle: torch.Tensor | None = None,
        before: Factor | None = None,
    ) -> Factor:
        """Factorises matrices A, or A + C C^T.

        Args:
            values: (B, n_values) entries at the solver's addresses, zero elsewhere; see `overwrites`.
            definite: Cholesky, which reports matrices that are not positive definite in ``failed``; otherwise a pivoted
                factorisation that takes any regular matrix.
            columns: (B, n, r) C.
            idle: (B,) matrices that keep the factor they have; without one, their solutions may be anything.
            before: the factor they have. It serves no more itself.
        """
        kept = before if idle is not None else None
        if isinstance(kept, CorrectedFactor):
            if columns is not None and idle is not None:
                columns = torch.where(idle[:, None, None], kept.columns, columns)
            kept = kept.factor
        factor = self._factorise(values, definite, idle, kept)
        return factor if columns is None else CorrectedFactor(factor, columns, self.dofs)

    @abstractmethod
    def _factorise(
        self, values: torch.Tensor, definite: bool, idle: torch.Tensor | None, before: Factor | None
    ) -> Factor:
        """The factor of matrices A; `before` is None unless a matrix is idle."""

    @cached_property
    def dofs(self) -> torch.Tensor:
        """(n,) unknown at each place of the right-hand sides in place."""
        dofs = (self.order[:, None] * self.block + np.arange(self.block)).ravel()
        return torch.as_tensor(dofs, device=self.device)

    @cached_property
    def places(self) -> torch.Tensor:
        """(n,) place of each unknown there."""
        return torch.argsort(self.dofs)

    def _entries(self, rows: Indices, cols: Indices) -> tuple[Indices, Indices]:
        """Scalar row and column (E, block^2) of every entry of every block, in the order of the nodes given."""
        r, c = np.divmod(np.arange(self.block**2), self.block)
        return rows[:, None] * self.block + r, cols[:, None] * self.block + c


def bandwidth(rows: Indices, cols: Indices, n_nodes: int) -> int:
    """Returns the number of nodes in the band, the diagonal included, in `bandwidth_reducing_order`."""
    place = np.argsort(bandwidth_reducing_order(rows, cols, n_nodes))
    return int(np.abs(place[rows] - place[cols]).max(initial=0)) + 1


def bandwidth_reducing_order(rows: Indices, cols: Indices, n_nodes: int) -> Indices:
    """(n_nodes,) node at each place, in the given order or reverse Cuthill-McKee's: whichever band is smaller."""
    i, j = np.concatenate([rows, cols]), np.concatenate([cols, rows])
    graph = scipy.sparse.csr_array((np.ones(len(i), dtype=np.int8), (i, j)), shape=(n_nodes, n_nodes))
    order = scipy.sparse.csgraph.reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True).astype(np.int64)
    place = np.empty(n_nodes, dtype=np.int64)
    place[order] = np.arange(n_nodes)
    if np.abs(place[rows] - place[cols]).max(initial=0) < np.abs(rows - cols).max(initial=0):
        return order
    return np.arange(n_nodes)
