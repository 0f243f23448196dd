r"""Residual forces from sparse markers.

For each step of a motion of which m markers y were observed, find the force f that minimises

    |C q+(f) - y|^2 + lambda |f|^2

with q+ the simulator's next positions and C the map from positions to markers. Most of f is left to the second term:
what no marker sees stays at zero.
"""

from dataclasses import dataclass

import torch
from typing_extensions import override

from ..equilibrium import Workspace
from ..errors import ConvergenceError, InputError
from ..integrator import State
from ..modes import vibration_modes
from ..simulator import Simulator
from ..threads import threads_for
from .reconstruction import LBFGSB, Reconstruction, Reconstructor


@dataclass(frozen=True)
class MarkerMap:
    """Markers as weighted sums of vertices, other ones in every environment.

    Attributes:
        vertices: (B, m, k) the vertices of each marker.
        weights: (B, m, k) their weights; a marker whose weights are all zero is none.
    """

    vertices: torch.Tensor
    weights: torch.Tensor

    def __post_init__(self) -> None:
        """Checks that the shapes agree.

        Raises:
            InputError: they do not, or there is no marker.
        """
        if self.vertices.ndim != 3 or self.vertices.shape != self.weights.shape or not self.vertices.numel():
            raise InputError(
                f"marker vertices of shape {tuple(self.vertices.shape)} with weights of shape "
                f"{tuple(self.weights.shape)}: both must be (environments, markers, vertices a marker)."
            )

    @classmethod
    def at_vertices(cls, vertices: torch.Tensor, dtype: torch.dtype = torch.float64) -> "MarkerMap":
        """One marker on each of (B, m) vertices."""
        return cls(vertices[..., None], torch.ones_like(vertices[..., None], dtype=dtype))

    def __call__(self, fields: torch.Tensor) -> torch.Tensor:
        """C: (B, N, ...) values at the vertices to (B, m, ...) values at the markers."""
        batch = torch.arange(len(self.vertices), device=fields.device)[:, None, None]
        weights = self.weights.reshape(*self.weights.shape, *[1] * (fields.ndim - 2))
        return (fields[batch, self.vertices] * weights).sum(2)

    def transposed(self, n_vertices: int) -> torch.Tensor:
        """(B, 3 N, 3 m) matrix of C^T."""
        b, m, _ = self.vertices.shape
        out = self.weights.new_zeros(b, n_vertices, 3, m, 3)
        batch = torch.arange(b, device=out.device)[:, None, None]
        marker = torch.arange(m, device=out.device)[:, None]
        for axis in range(3):
            where = (batch, self.vertices, torch.full_like(marker, axis), marker, torch.full_like(marker, axis))
            out.index_put_(where, self.weights, accumulate=True)
        return out.reshape(b, 3 * n_vertices, 3 * m)


class SparseGaussNewton(Reconstructor):
    """Gauss-Newton in positions and forces at once.

    The step with a force f ends where the residual g of the step without it equals f. Linearised at an iterate x, with
    the exact Hessian H = dg/dx, that is

        x+ = x - H^-1 g + H^-1 f

    so that f solves a ridge regression with J = C H^-1 and r = y - C (x - H^-1 g): f = J^T (J J^T + lambda I)^-1 r. One
    factorisation and 3 m + 2 back-substitutions an iteration, no inner solve, and at convergence f = g(x) holds as it
    does for a step of the simulator. Restricted to forces B a with orthonormal columns B (see `vibration_modes`), J is
    C H^-1 B, which takes a back-substitution a column where these are fewer.

    ``tolerance`` is the last change of any position [m]. Where x stands at a fraction e of the time step, |C q+ - y| is
    that of x over e, and lambda e^2 takes the place of lambda. No first guess is needed.

    Args:
        simulator: the one to correct.
        markers: C, for as many environments as the states have.
        regularisation: lambda, positive [m^2/N^2].
        tolerance: see above.
        max_iterations: after which a step has failed.
        modes: columns of B; every force on the free vertices where left out.

    Raises:
        InputError: a number out of range, or a marker on a vertex that the body does not have.
    """

    def __init__(
        self,
        simulator: Simulator,
        markers: MarkerMap,
        regularisation: float,
        tolerance: float,
        max_iterations: int,
        modes: int | None = None,
    ) -> None:
        super().__init__(simulator, regularisation, tolerance, max_iterations)
        check_sparse(regularisation, markers, simulator)
        self.markers = markers
        self._basis = None if modes is None else vibration_modes(simulator, modes)
        self._transposed = markers.transposed(simulator.body.n_vertices)

    @override
    @torch.no_grad()
    def step(self, state: State, observed: torch.Tensor, first_guess: torch.Tensor | None = None) -> Reconstruction:
        """Reconstructs the step from a state to observed markers.

        Args:
            state: where the step starts.
            observed: (B, m, 3) [m].
            first_guess: not used.

        Raises:
            ConvergenceError: the iterates did not settle.
        """
        del first_guess
        sim = self.simulator
        workspace = sim.workspace(state.batch)
        p = workspace.potential
        stage = sim.method.stage(state, sim.time_step)
        p.set_terms(sim.step_terms(stage, state.batch, None, self._tensors, workspace))
        target = stage.end * observed + (1.0 - stage.end) * self.markers(state.q)
        x = stage.target.clone()
        x[:, sim.fixed] = state.q[:, sim.fixed]
        force = torch.zeros_like(x)
        active = torch.ones(state.batch, dtype=torch.bool, device=x.device)
        with threads_for(x.numel()):
            for iteration in range(1, self.max_iterations + 1):
                p.positions.copy_(x)
                p.evaluate()
                new, new_force = self._iterate(workspace, x, target, self.regularisation * stage.end**2)
                change = (new - x).abs().amax((1, 2))
                x = torch.where(active[:, None, None], new, x)
                force = torch.where(active[:, None, None], new_force, force)
                active &= ~(change <= self.tolerance)
                if not bool(active.any()):
                    return Reconstruction(sim.method.finish(state, x, sim.time_step), force, iteration)
        raise ConvergenceError(
            f"sparse Gauss-Newton reconstruction moved by {float(change.max()):.1e} m in its last iteration, the "
            f"{self.max_iterations}th: raise reconstruction.regularisation or reconstruction.max_iterations.",
            x,
            None,
        )

    def _iterate(
        self, workspace: Workspace, x: torch.Tensor, target: torch.Tensor, weight: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Next positions and force (B, N, 3) from the residual at x; see the class's equations."""
        metric = workspace.adjoint_metric(self.simulator.settings.linear_solver)
        metric.refactor_exact()
        residual = workspace.potential.residual.reshape(len(x), -1, 1)
        basis, transposed = self._basis, self._transposed
        columns = transposed
        by_mode = basis is not None and basis.shape[1] < transposed.shape[2]
        if basis is not None and by_mode:
            columns = basis.expand(len(x), -1, -1)
        solved = metric.solve(torch.cat([columns, residual], dim=2))
        response = solved[:, :, :-1]
        unforced = x - solved[:, :, -1].view_as(x)
        jacobian = response.mT
        if basis is not None:
            jacobian = transposed.mT @ response if by_mode else response.mT @ basis
        missing = (target - self.markers(unforced)).reshape(len(x), -1, 1)
        coefficients = ridge(jacobian, missing, weight)
        force = coefficients if basis is None else basis @ coefficients
        return unforced + metric.solve(force).view_as(x), force.view_as(x)


class SparseLBFGSB(LBFGSB):
    """The published method on sparse markers: L-BFGS-B on the forces, with gradients through the simulator.

    Args:
        simulator: the one to correct.
        markers: C, for as many environments as the states have.
        regularisation: lambda, positive [m^2/N^2].
        tolerance: relative change of the objective.
        max_iterations: after which a step has failed.

    Raises:
        InputError: a number out of range, or a marker on a vertex that the body does not have.
    """

    def __init__(
        self,
        simulator: Simulator,
        markers: MarkerMap,
        regularisation: float,
        tolerance: float,
        max_iterations: int,
    ) -> None:
        super().__init__(simulator, regularisation, tolerance, max_iterations)
        check_sparse(regularisation, markers, simulator)
        self.markers = markers

    @override
    def step(self, state: State, observed: torch.Tensor, first_guess: torch.Tensor | None = None) -> Reconstruction:
        """See `SparseGaussNewton.step`; the first guess is a force (B, N, 3) [N]."""
        return self._minimise(state, lambda q: (self.markers(q) - observed).square().sum(), first_guess)


def ridge(matrix: torch.Tensor, right: torch.Tensor, weight: float) -> torch.Tensor:
    """(B, n, 1) minimiser of |A x - b|^2 + w |x|^2, from the smaller of its two sets of normal equations.

    Args:
        matrix: (B, m, n).
        right: (B, m, 1).
        weight: w, positive.
    """
    rows, columns = matrix.shape[1:]
    identity = torch.eye(min(rows, columns), device=matrix.device, dtype=matrix.dtype)
    if rows <= columns:
        return matrix.mT @ torch.linalg.solve(matrix @ matrix.mT + weight * identity, right)
    return torch.linalg.solve(matrix.mT @ matrix + weight * identity, matrix.mT @ right)


def check_sparse(regularisation: float, markers: MarkerMap, simulator: Simulator) -> None:
    """Checks what sparse markers ask for beyond the full state.

    Raises:
        InputError: no regularisation, or a marker on a vertex that the body does not have.
    """
    if not regularisation > 0.0:
        raise InputError(
            f"reconstruction.regularisation is {regularisation:g}: it must be positive, as markers leave most of the "
            "force open."
        )
    last = simulator.body.n_vertices - 1
    if int(markers.vertices.min()) < 0 or int(markers.vertices.max()) > last:
        raise InputError(f"a marker is on a vertex that the body does not have: its vertices are 0 to {last}.")


def make_sparse_reconstructor(
    simulator: Simulator,
    markers: MarkerMap,
    method: str,
    regularisation: float,
    tolerance: float,
    max_iterations: int,
    modes: int | None = None,
) -> Reconstructor:
    """The named method.

    Raises:
        InputError: an unknown method, modes for a method without them, or a number out of range.
    """
    settings = (simulator, markers, regularisation, tolerance, max_iterations)
    if method == "gauss_newton":
        return SparseGaussNewton(*settings, modes)
    if method != "lbfgsb":
        raise InputError(f"reconstruction.method is {method!r}: choose one of gauss_newton, lbfgsb.")
    if modes is not None:
        raise InputError("markers.modes is set, but reconstruction.method=lbfgsb has no modes: choose gauss_newton.")
    return SparseLBFGSB(*settings)
