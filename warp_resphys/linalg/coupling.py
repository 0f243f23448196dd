"""Factors of matrices with dense couplings between a few unknowns, from the factors without these."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from .linear_solver import Factor


@dataclass(frozen=True)
class Coupling:
    """A symmetric matrix K between a few unknowns of one environment."""

    environment: int
    unknowns: torch.Tensor  # (m,)
    matrix: torch.Tensor  # (m, m)


class CouplingSolver:
    """Solves (A + E K E^T) x = r with a factor of A (Woodbury), where E selects the unknowns of a coupling.

    The solutions S = A^-1 E are kept as long as the factor, so that other matrices K cost only dense algebra.

    Args:
        n: number of unknowns.
        like: tensor with device and dtype of the solutions.
    """

    def __init__(self, n: int, like: torch.Tensor) -> None:
        self._n, self._like = n, like
        self._places: dict[int, torch.Tensor] = {}  # column of every unknown in S, or -1, by environment
        self._solved: dict[int, torch.Tensor] = {}

    def forget(self, environments: Sequence[int]) -> None:
        """Drops the solutions of environments with a new factor."""
        for b in environments:
            self._places.pop(b, None)
            self._solved.pop(b, None)

    def correct(self, factor: Factor, couplings: Sequence[Coupling], x: torch.Tensor, order: torch.Tensor) -> None:
        """Turns solutions for A into those with couplings.

        Args:
            factor: factor of A.
            couplings: at most one for every environment.
            x: (B, n, k) solutions for A, which are overwritten.
            order: (n,) unknowns in the order of x.
        """
        self._solve_missing(factor, couplings, len(x))
        place = torch.empty_like(order)
        place[order] = torch.arange(len(order), device=order.device)
        for coupling in couplings:
            b, own = coupling.environment, coupling.unknowns
            columns, solved, k = self._places[b][own], self._solved[b], coupling.matrix
            small = torch.eye(len(own), device=x.device, dtype=k.dtype) + k @ solved[own[:, None], columns].to(k)
            along = x.new_zeros(solved.shape[1], x.shape[2])
            along[columns] = torch.linalg.solve(small, k @ x[b, place[own]].to(k)).to(x)
            x[b] -= (solved @ along)[order]

    def _solve_missing(self, factor: Factor, couplings: Sequence[Coupling], batch: int) -> None:
        """Solves for unknowns that are not in S yet."""
        missing = dict[int, torch.Tensor]()
        for coupling in couplings:
            b = coupling.environment
            if b not in self._places:
                self._places[b] = torch.full((self._n,), -1, device=self._like.device)
                self._solved[b] = self._like.new_zeros(self._n, 0)
            new = coupling.unknowns[self._places[b][coupling.unknowns] < 0]
            if len(new):
                missing[b] = new
        if not missing:
            return
        right = self._like.new_zeros(batch, self._n, max(map(len, missing.values())))
        for b, new in missing.items():
            right[b, new, torch.arange(len(new), device=new.device)] = 1.0
        solved = factor.solve(right)
        for b, new in missing.items():
            count = self._solved[b].shape[1]
            self._places[b][new] = torch.arange(count, count + len(new), device=new.device)
            self._solved[b] = torch.cat([self._solved[b], solved[b, :, : len(new)]], 1)
