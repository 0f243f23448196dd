"""Interface of the solvers of symmetric linear systems, for a batch of bodies.

A solver is built once per sparsity pattern. Its ``address`` maps each matrix entry to a place in
the value array, so that one Warp kernel assembles for every layout. ``factor`` turns a batch of
value arrays into a `Factor`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg
import torch
from numpy.typing import NDArray
from typing_extensions import override

from ...io.errors import InputError

Indices = NDArray[np.int64]
Mask = torch.Tensor | None  # (B,) bool
_MOST_VALUES = 2**31 // 8 - 1  # Warp strides are 32-bit byte counts.


class Factor(ABC):
    """A factorised batch of matrices.

    Attributes:
        failed: (B,) bool; matrices without a factor because they are not positive definite; their
            solutions are NaN.
    """

    failed: NDArray[np.bool_]

    @abstractmethod
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        """Returns the solutions for (B, n, m) right-hand sides.

        A factor of batch 1 applies to every environment.
        """

    def solve_in_place(self, columns: torch.Tensor) -> None:
        """Overwrites (B, n) right-hand sides, in the solver's order of unknowns, with solutions."""
        columns.copy_(self.solve(columns[:, :, None])[:, :, 0])

    def inverse_columns(
        self, environments: torch.Tensor, unknowns: torch.Tensor, like: torch.Tensor
    ) -> torch.Tensor:
        """Returns columns (k, n) of the inverses.

        Args:
            environments: (k,) environments of the columns, in ascending order.
            unknowns: (k,) their numbers.
            like: (B, any, n) tensor of the type of right-hand sides.
        """
        count, place = numbered(environments, len(like))
        right = like.new_zeros(len(like), like.shape[2], int(count.max()))
        right[environments, unknowns, place] = 1.0
        return self.solve(right)[environments, :, place]


class CorrectedFactor(Factor):
    """A factor of A + C C^T from a factor of A (Sherman, Morrison and Woodbury).

    Args:
        factor: factor of A.
        columns: (B, n, r) C.
        order: (n,) unknowns in the order of the linear solver.
    """

    def __init__(self, factor: Factor, columns: torch.Tensor, order: torch.Tensor) -> None:
        self.factor = factor
        self.columns, self._order = columns, order
        self.failed = factor.failed
        self._solved = factor.solve(columns)
        small = (
            torch.eye(columns.shape[2], device=columns.device, dtype=columns.dtype)
            + columns.mT @ self._solved
        )
        self._small = torch.linalg.lu_factor_ex(small)[:2]

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        x = self.factor.solve(rhs)
        return x - self._solved @ torch.linalg.lu_solve(*self._small, self.columns.mT @ x)

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        self.factor.solve_in_place(columns)
        along = self.columns[:, self._order].mT @ columns[:, :, None]
        columns -= (self._solved[:, self._order] @ torch.linalg.lu_solve(*self._small, along))[
            :, :, 0
        ]


class PivotedFactor(Factor):
    """Factors with those of SuperLU, which pivots, in the place of the ones that have failed.

    Args:
        solver: linear solver of the factors.
        factor: the factors.
        values: (B, n_values) the same matrices.
    """

    def __init__(self, solver: "LinearSolver", factor: Factor, values: torch.Tensor) -> None:
        self._solver, self._factor = solver, factor
        self.failed = factor.failed.copy()
        self._pivoted: dict[int, Any] = {}
        for number in np.flatnonzero(factor.failed).tolist():
            with suppress(ValueError, RuntimeError):
                self._pivoted[number] = sparse_lu(solver.matrix(values[number]), definite=False)
                self.failed[number] = False

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        out = self._factor.solve(rhs)
        for number, lu in self._pivoted.items():
            out[number] = torch.as_tensor(lu.solve(rhs[number].double().cpu().numpy())).to(out)
        return out

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        columns.copy_(self.solve(columns[:, self._solver.places, None])[:, self._solver.dofs, 0])


class SeparateFactors(Factor):
    """One factor per matrix of a batch, computed one after another.

    Args:
        solver: linear solver, which defines the order of unknowns in `solve_in_place`.
        matrices: B matrices, or one for all environments.
        factorise: returns the factor of matrix i, or None if it is not positive definite.
        idle: (B,) matrices that keep their previous factor, if any.
        before: the previous factors.

    Attributes:
        factors: factor of each matrix, or None.
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
        self._solver, is_idle = solver, [False] * len(matrices) if idle is None else idle.tolist()
        self.failed = np.zeros(len(matrices), dtype=bool)
        self.factors: list[Any] = []
        for i, matrix in enumerate(matrices):
            if is_idle[i]:
                self.factors.append(None if kept is None else kept.factors[i])
                self.failed[i] = kept is not None and kept.failed[i]
            else:
                self.factors.append(factorise(i, matrix))
                self.failed[i] = self.factors[i] is None

    @abstractmethod
    def _overwrite(self, factor: Any, rows: torch.Tensor) -> None:
        """Overwrites contiguous right-hand sides (m, n) with the solutions."""

    def _overwrite_all(self, blocks: torch.Tensor) -> None:
        for factor, failed, rows in zip(self.factors, self.failed, blocks, strict=True):
            if failed:
                rows.fill_(torch.nan)
            elif factor is not None:
                self._overwrite(factor, rows)

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        b, n, m = rhs.shape
        rows = rhs[:, self._solver.dofs].mT.reshape(
            (1, b * m, n) if len(self.factors) == 1 else (b, m, n)
        )
        rows = rows.contiguous()
        self._overwrite_all(rows)
        return rows.view(b, m, n).mT[:, self._solver.places]

    @override
    def inverse_columns(
        self, environments: torch.Tensor, unknowns: torch.Tensor, like: torch.Tensor
    ) -> torch.Tensor:
        out, place = like.new_zeros(len(unknowns), like.shape[2]), self._solver.places[unknowns]
        out[torch.arange(len(out), device=out.device), place] = 1.0
        for environment, count in zip(
            *(x.tolist() for x in environments.unique(return_counts=True)), strict=True
        ):
            first = int(torch.searchsorted(environments, environment))
            number = environment if len(self.factors) > 1 else 0
            self._overwrite_units(
                self.factors[number], out[first : first + count], place[first : first + count]
            )
        return out[:, self._solver.places]

    def _overwrite_units(self, factor: Any, rows: torch.Tensor, places: torch.Tensor) -> None:
        """Overwrites right-hand sides (m, n) that are zero
        but for a one at a place (m,) with the solutions.
        """
        if factor is None:
            rows.fill_(torch.nan)
        else:
            self._overwrite(factor, rows)

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        self._overwrite_all(columns[None] if len(self.factors) == 1 else columns[:, None])


class LinearSolver(ABC):
    """Factorises symmetric matrices of one sparsity pattern.

    Args:
        rows: (E,) node row of each stored block, ``rows >= cols``.
        cols: (E,) node column of each stored block.
        n_nodes: number of nodes.
        block: unknowns per node (3 for a Hessian, 1 for a projective-dynamics matrix).
        device: device of values and right-hand sides.
        dtype: dtype of values and right-hand sides.

    Raises:
        InputError: a matrix too large for the layout.

    Attributes:
        address: (E, block^2) place of each block entry in the value array, -1 if not stored.
        n_values: length of the value array.
        overwrites: whether `factor` overwrites the values.
        keeps_factors: whether a factor takes as long as dozens of solutions, so that it is kept for
            many states.
        order: (n_nodes,) nodes in the order of the right-hand sides of `Factor.solve_in_place`.
    """

    address: NDArray[np.int32]
    n_values: int
    order: Indices
    overwrites = False
    keeps_factors = False

    def __init__(
        self,
        rows: Indices,
        cols: Indices,
        n_nodes: int,
        block: int,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self._pattern = rows, cols
        self.n = n_nodes * block
        self.block = block
        self.device = device
        self.dtype = dtype
        self.order = np.arange(n_nodes)
        self._lay_out(rows, cols, n_nodes)
        if self.n_values > _MOST_VALUES:
            raise InputError(
                f"a {type(self).__name__} for {self.n} unknowns needs {self.n_values:.1e} "
                f"numbers, beyond the {_MOST_VALUES:.1e} that a kernel addresses: choose "
                "solver.linear_solver=sparse."
            )

    @abstractmethod
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        """Chooses an order and sets ``address`` and ``n_values``."""

    def factor(
        self,
        values: torch.Tensor,
        columns: torch.Tensor | None = None,
        idle: torch.Tensor | None = None,
        before: Factor | None = None,
    ) -> Factor:
        """Factorises positive definite matrices A, or A + C C^T; others are reported in ``failed``.

        Args:
            values: (B, n_values) entries at the solver's addresses, zero elsewhere; see
                `overwrites`.
            columns: (B, n, r) C.
            idle: (B,) matrices that keep their previous factor; without one, their solutions are
                undefined.
            before: the previous factor, which must not be used any more.
        """
        kept = before if idle is not None else None
        if isinstance(kept, CorrectedFactor):
            if columns is not None and idle is not None:
                columns = torch.where(idle[:, None, None], kept.columns, columns)
            kept = kept.factor
        factor = self._factorise(values, idle, kept)
        return factor if columns is None else CorrectedFactor(factor, columns, self.dofs)

    def direction_factor(
        self,
        values: torch.Tensor,
        columns: torch.Tensor | None = None,
        idle: torch.Tensor | None = None,
        before: Factor | None = None,
    ) -> Factor:
        """Returns a factor like `factor`, for directions and preconditioning:
        in float32 where that is faster.
        """
        return self.factor(values, columns, idle, before)

    def pivoted(
        self, values: torch.Tensor, factor: Factor, columns: torch.Tensor | None = None
    ) -> Factor:
        """Returns a factor of any regular matrices, from one that has failed for some of them.

        Args:
            values: (B, n_values) entries, assembled anew.
            factor: the factor of these.
            columns: (B, n, r) C.
        """
        whole = PivotedFactor(
            self, factor.factor if isinstance(factor, CorrectedFactor) else factor, values
        )
        return whole if columns is None else CorrectedFactor(whole, columns, self.dofs)

    @cached_property
    def both_triangles(self) -> tuple[Indices, Indices, Indices]:
        """Row, column and place in the values of every entry of a matrix."""
        i, j = self._entries(*self._pattern)
        stored = self.address >= 0
        i, j = i[stored], j[stored]
        place = self.address[stored].astype(np.int64)
        off = i != j
        return np.append(i, j[off]), np.append(j, i[off]), np.append(place, place[off])

    def matrix(self, values: torch.Tensor) -> scipy.sparse.csc_array:
        """Returns the matrix (n, n) of one environment from its values (n_values,)."""
        row, column, place = self.both_triangles
        data = values.detach().double().cpu().numpy()[place]
        return scipy.sparse.csc_array((data, (row, column)), shape=(self.n, self.n))

    @abstractmethod
    def _factorise(self, values: torch.Tensor, idle: Mask, before: Factor | None) -> Factor:
        """Returns the factor of the matrices A; `before` is None unless a matrix is idle."""

    @cached_property
    def dofs(self) -> torch.Tensor:
        """(n,) unknowns in the order of the right-hand sides of `Factor.solve_in_place`."""
        dofs = (self.order[:, None] * self.block + np.arange(self.block)).ravel()
        return torch.as_tensor(dofs, device=self.device)

    @cached_property
    def places(self) -> torch.Tensor:
        """(n,) place of each unknown in that order."""
        return torch.argsort(self.dofs)

    def _entries(self, rows: Indices, cols: Indices) -> tuple[Indices, Indices]:
        """Returns the scalar row and column, (E, block^2) each, of every entry of every block."""
        r, c = np.divmod(np.arange(self.block**2), self.block)
        return rows[:, None] * self.block + r, cols[:, None] * self.block + c


def sparse_lu(matrix: scipy.sparse.csc_array, definite: bool) -> Any:
    """Returns SuperLU's factor of a symmetric matrix.

    Raises:
        ValueError: `definite` is set, but the matrix is not positive definite.
        RuntimeError: the matrix is singular.
    """
    lu = scipy.sparse.linalg.splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0 if definite else 1.0,
        options={"SymmetricMode": definite},
    )
    # Without pivoting, a symmetric matrix is positive definite if and only if all pivots are
    # positive.
    if definite and not (lu.U.diagonal() > 0).all():
        raise ValueError("a pivot is not positive")
    return lu


def numbered(groups: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the sizes (count,) of groups, and the number of every entry in its own.

    Args:
        groups: (k,) number of the group of every entry, in ascending order.
        count: number of groups.
    """
    sizes = torch.bincount(groups, minlength=count)
    return sizes, torch.arange(len(groups), device=groups.device) - (sizes.cumsum(0) - sizes)[
        groups
    ]


def bandwidth(rows: Indices, cols: Indices, n_nodes: int) -> int:
    """Returns the bandwidth in nodes, including the diagonal, in `bandwidth_reducing_order`."""
    place = np.argsort(bandwidth_reducing_order(rows, cols, n_nodes))
    return int(np.abs(place[rows] - place[cols]).max(initial=0)) + 1


def bandwidth_reducing_order(rows: Indices, cols: Indices, n_nodes: int) -> Indices:
    """Returns nodes (n_nodes,) in reverse Cuthill-McKee order,
    or in the given order if its band is not wider.
    """
    i, j = np.concatenate([rows, cols]), np.concatenate([cols, rows])
    graph = scipy.sparse.csr_array(
        (np.ones(len(i), dtype=np.int8), (i, j)), shape=(n_nodes, n_nodes)
    )
    order = scipy.sparse.csgraph.reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True).astype(
        np.int64
    )
    place = np.argsort(order)
    if np.abs(place[rows] - place[cols]).max(initial=0) < np.abs(rows - cols).max(initial=0):
        return order
    return np.arange(n_nodes)
