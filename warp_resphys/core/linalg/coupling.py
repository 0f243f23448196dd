"""Factors of matrices with dense couplings between a few unknowns, from factors without these."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from .linear_solver import Factor, numbered


@dataclass(frozen=True)
class Coupling:
    """Symmetric matrices K of one size between a few unknowns of some environments.

    Attributes:
        environments: (G,) environments.
        unknowns: (G, m) their unknowns; -1 in places that an environment does not need, where K is
            zero.
        matrices: (G, m, m) K.
    """

    environments: torch.Tensor
    unknowns: torch.Tensor
    matrices: torch.Tensor

    def parts(self) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """Environments, unknowns and matrices to be computed at once.

        On a CPU, a product of one matrix and one of several are not the same in every bit.
        """
        size = 1 if self.matrices.device.type == "cpu" else len(self.matrices)
        yield from zip(
            *(x.split(size) for x in (self.environments, self.unknowns, self.matrices)), strict=True
        )


class VertexCouplings:
    """Turns couplings of vertices, some of which are weighted sums of free ones,
    into those of the free ones.

    The matrix of all vertices in contact is made first, and then W^T K W.

    Args:
        columns: (V, w) free vertices that determine every vertex; -1 in places that it does not
            need.
        weights: (V, w) their weights.
    """

    def __init__(self, columns: torch.Tensor, weights: torch.Tensor) -> None:
        self._columns, self._weights = columns, weights
        self._count = int(columns.max()) + 1

    def reduced(
        self, environments: torch.Tensor, vertices: torch.Tensor, matrices: torch.Tensor
    ) -> Iterator[Coupling]:
        """Yields the couplings of free vertices.

        Args:
            environments: (G,) environments.
            vertices: (G, s) their vertices; -1 in places that an environment does not need.
            matrices: (G, 3 s, 3 s) symmetric matrices of the coordinates of these.
        """
        for some, chosen, k in Coupling(environments, vertices, matrices).parts():
            columns = torch.where(chosen[..., None] < 0, -1, self._columns[chosen])  # (G, s, w)
            row = torch.arange(len(some), device=some.device)[:, None, None].expand_as(columns)
            used = columns >= 0
            keys, local = (row * self._count + columns)[used].unique(return_inverse=True)
            if not len(keys):
                continue
            counts, at = numbered(keys // self._count, len(some))
            unknowns = torch.full((len(some), int(counts.max())), -1, device=some.device)
            unknowns[keys // self._count, at] = keys % self._count
            weights = k.new_zeros(*chosen.shape, unknowns.shape[1])
            vertex = torch.arange(chosen.shape[1], device=some.device)[:, None].expand_as(columns)
            vertex = vertex[used]
            weights[row[used], vertex, at[local]] = self._weights[chosen][used].to(k)
            whole = k.unflatten(2, (-1, 3)).unflatten(1, (-1, 3))
            reduced = torch.einsum("gsi,gsxty,gtj->gixjy", weights, whole, weights)
            yield Coupling(some, coordinates(unknowns), reduced.flatten(3, 4).flatten(1, 2))


def coordinates(vertices: torch.Tensor) -> torch.Tensor:
    """Returns the unknowns (G, 3 s) of vertices (G, s); -1 for negative ones."""
    unknowns = 3 * vertices[..., None] + torch.arange(3, device=vertices.device)
    return torch.where(vertices[..., None] < 0, -1, unknowns).flatten(1)


class CouplingSolver:
    """Solves (A + E K E^T) x = r with a factor of A (Woodbury),
    where E selects the unknowns of a coupling.

    The solutions S = A^-1 E are kept as long as the factor, so that other matrices K cost only
    dense algebra.

    Args:
        batch: number of environments B.
        n: number of unknowns.
        like: tensor with device and dtype of the solutions.
    """

    def __init__(self, batch: int, n: int, like: torch.Tensor) -> None:
        device = like.device
        # Column of every unknown in S, or -1.
        self._places = torch.full((batch, n), -1, device=device)
        self._counts = torch.zeros(batch, device=device, dtype=torch.int64)  # columns of S
        self._solved = like.new_zeros(batch, 0, n)  # columns of S as rows

    def forget(self, environments: torch.Tensor | None = None) -> None:
        """Drops the solutions of environments (B,) with a new factor, or of all."""
        kept = None if environments is None else ~environments
        if kept is None or not bool(kept.any()):
            self._places.fill_(-1)
            self._counts.zero_()
        else:
            self._places.masked_fill_(~kept[:, None], -1)
            self._counts.masked_fill_(~kept, 0)

    def correct(
        self, factor: Factor, couplings: Sequence[Coupling], x: torch.Tensor, order: torch.Tensor
    ) -> None:
        """Turns solutions for A into those with couplings.

        Args:
            factor: factor of A.
            couplings: at most one for every environment.
            x: (B, n, k) solutions for A, which are overwritten.
            order: (n,) unknowns in the order of x.
        """
        self._solve_missing(factor, couplings)
        place = torch.empty_like(order)
        place[order] = torch.arange(len(order), device=order.device)
        for b, unknowns, k in (part for coupling in couplings for part in coupling.parts()):
            used = unknowns.clamp_min(0)  # K is zero where there is none
            # (G, m, n)
            solved = self._solved[b[:, None], self._places[b[:, None], used].clamp_min(0)]
            among = solved.gather(2, used[:, None].expand(-1, used.shape[1], -1)).to(k)
            small = torch.eye(used.shape[1], device=x.device, dtype=k.dtype) + k @ among
            along = torch.linalg.solve(small, k @ x[b[:, None], place[used]].to(k)).to(x)
            x[b] -= (solved.mT @ along)[:, order]

    def _solve_missing(self, factor: Factor, couplings: Sequence[Coupling]) -> None:
        """Solves for unknowns that are not in S yet."""
        needed = torch.zeros_like(self._places, dtype=torch.bool)
        for coupling in couplings:
            rows, columns = (coupling.unknowns >= 0).nonzero(as_tuple=True)
            needed[coupling.environments[rows], coupling.unknowns[rows, columns]] = True
        rows, unknowns = (needed & (self._places < 0)).nonzero(as_tuple=True)
        if not len(rows):
            return
        new, number = numbered(rows, len(self._counts))
        at = self._counts[rows] + number
        self._counts += new
        spare = int(self._counts.max()) - self._solved.shape[1]
        if spare > 0:
            more = self._solved.new_zeros(
                len(self._counts), spare + spare // 2, self._solved.shape[2]
            )
            self._solved = torch.cat([self._solved, more], 1)
        self._places[rows, unknowns] = at
        self._solved[rows, at] = factor.inverse_columns(rows, unknowns, self._solved)
