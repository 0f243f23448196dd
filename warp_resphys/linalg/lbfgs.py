"""Limited-memory BFGS updates of a batch of inverse Hessians, in compact form."""

from typing import Protocol

import torch


class InverseHessian(Protocol):
    """An approximate inverse Hessian that needs no memory."""

    def apply(self, residual: torch.Tensor) -> torch.Tensor:
        """(B, n) displacement [m] for a (B, n) residual [N]."""


class InverseHessianUpdate:
    """BFGS updates of a given inverse Hessian by the last pairs of displacement and residual change.

    With the pairs as rows of S and Y, R = triu(S Y^T) and D its diagonal, the two-loop recursion (Nocedal and Wright
    2006, algorithm 7.4) is two triangular solves: a = R^-1 S g, z = H0 (g - Y^T a), b = R^-T (D a - Y z), and the
    result is z + S^T b. Each environment skips pairs of no positive curvature of its own.

    Args:
        memory: pairs kept; 0 leaves the given inverse Hessian as it is.
        like: (B, N, 3) tensor whose batch, device and type the pairs have.
    """

    def __init__(self, memory: int, like: torch.Tensor) -> None:
        b, n = like.shape[0], like[0].numel()
        self.memory, self.count = memory, 0
        self._s = torch.zeros(b, memory, n, device=like.device, dtype=like.dtype)
        self._y = torch.zeros_like(self._s)
        self._r = torch.zeros(b, memory, memory, device=like.device, dtype=like.dtype)

    def reset(self) -> None:
        """Forgets every pair."""
        self.count = 0

    def add(self, displacement: torch.Tensor, change: torch.Tensor) -> None:
        """Remembers (B, n) pairs."""
        if self.memory == 0:
            return
        if self.count == self.memory:
            self._s[:, :-1] = self._s[:, 1:].clone()
            self._y[:, :-1] = self._y[:, 1:].clone()
            self._r[:, :-1, :-1] = self._r[:, 1:, 1:].clone()
            self.count -= 1
        k = self.count
        curvature = torch.linalg.vecdot(displacement, change)
        norms = torch.linalg.vector_norm(displacement, dim=1) * torch.linalg.vector_norm(change, dim=1)
        useful = curvature > 1e-10 * norms
        torch.mul(displacement, useful[:, None], out=self._s[:, k])
        torch.mul(change, useful[:, None], out=self._y[:, k])
        self._r[:, : k + 1, k] = (self._s[:, : k + 1] @ self._y[:, k, :, None])[:, :, 0]
        self._r[:, k, k] += ~useful
        self.count += 1

    def apply(self, residual: torch.Tensor, hessian: InverseHessian) -> torch.Tensor:
        """(B, n) product of the updated inverse Hessian with a residual."""
        k = self.count
        if k == 0:
            return hessian.apply(residual)
        s, y, r = self._s[:, :k], self._y[:, :k], self._r[:, :k, :k]
        a = torch.linalg.solve_triangular(r, s @ residual[:, :, None], upper=True)
        z = hessian.apply(residual - (a.mT @ y)[:, 0])
        right = r.diagonal(dim1=1, dim2=2)[:, :, None] * a - y @ z[:, :, None]
        b = torch.linalg.solve_triangular(r.mT, right, upper=False)
        return z + (b.mT @ s)[:, 0]
