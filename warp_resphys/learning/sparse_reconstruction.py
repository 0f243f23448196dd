r"""Residual forces from sparse markers.

For each step of a motion of which m markers y were observed, find the force f that minimises

    |C q+(f) - y|^2 + lambda |f|^2

with q+ the simulator's next positions and C the map from positions to markers, linear or not. Most of f is left to the
second term: what no marker sees stays at zero.
"""

import torch
from typing_extensions import override

from ..data.markers import Markers
from ..dynamics.inputs import Inputs
from ..dynamics.integrator import State
from ..dynamics.linearisation import Linearisation
from ..dynamics.modes import vibration_modes
from ..dynamics.simulator import Simulator
from ..io.errors import ConvergenceError, InputError
from ..linalg.threads import threads_for
from .reconstruction import LBFGSB, Reconstruction, Reconstructor


class _OnMarkers(Reconstructor):
    """A method that sees markers alone.

    Args:
        simulator: the one to correct.
        markers: C, for as many environments as the states have.
        regularisation: lambda, positive [m^2/N^2].
        tolerance: see the methods.
        max_iterations: after which a step has failed.

    Raises:
        InputError: a number out of range, or a marker on a vertex that the body does not have.
    """

    def __init__(
        self,
        simulator: Simulator,
        markers: Markers,
        regularisation: float,
        tolerance: float,
        max_iterations: int,
    ) -> None:
        super().__init__(simulator, regularisation, tolerance, max_iterations)
        check_sparse(regularisation, markers, simulator)
        self.markers = markers.to(simulator.rest_positions)


class SparseGaussNewton(_OnMarkers):
    """Gauss-Newton in positions and forces at once.

    The step with a force f ends where the residual g of the step without it equals f. Linearised at an iterate x, with
    the exact Hessian H = dg/dx, that is

        x+ = x - H^-1 g + H^-1 f

    so that f solves a ridge regression with J = C' H^-1 and r = y - C(x) + C' H^-1 g, C' being the derivative of C:
    f = J^T (J J^T + lambda I)^-1 r. One factorisation and 3 m + 2 back-substitutions an iteration, no inner solve, and
    at convergence f = g(x) holds as it does for a step of the simulator. Restricted to forces B a with orthonormal
    columns B (see `vibration_modes`), J is C' H^-1 B, which takes a back-substitution a column where these are fewer.

    ``tolerance`` is the last change of any position [m]. Where x stands at a fraction e of the time step, q+ moves 1/e
    times as far as x, so that e (y - C(q+)) takes the place of y - C(x), and lambda e^2 that of lambda. No first guess
    is needed.

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
        markers: Markers,
        regularisation: float,
        tolerance: float,
        max_iterations: int,
        modes: int | None = None,
    ) -> None:
        super().__init__(simulator, markers, regularisation, tolerance, max_iterations)
        self._basis = None if modes is None else vibration_modes(simulator, modes)
        self._constant = (
            self.markers.transposed_jacobian(simulator.rest_positions[None]) if self.markers.linear else None
        )

    @override
    @torch.no_grad()
    def step(
        self,
        state: State,
        observed: torch.Tensor,
        inputs: Inputs | None = None,
        first_guess: torch.Tensor | None = None,
    ) -> Reconstruction:
        """Reconstructs the step from a state to observed markers.

        Args:
            state: where the step starts.
            observed: (B, m, 3), NaN where a marker was not seen [m].
            inputs: what acts during the step.
            first_guess: not used.

        Raises:
            ConvergenceError: the iterates did not settle.
        """
        del first_guess
        problem = self.simulator.linearise(state, inputs, self._constants)
        end_of, weight = problem.stage.end, self.regularisation * problem.stage.end**2
        x = problem.start
        force = torch.zeros_like(x)
        seen = torch.isfinite(observed)
        active = torch.ones(state.batch, dtype=torch.bool, device=x.device)
        with threads_for(x.numel()):
            for iteration in range(1, self.max_iterations + 1):
                end = problem.finish(x).q
                missing = torch.where(seen, end_of * (observed - self.markers(end)), 0.0)
                new, new_force = self._iterate(problem, x, end, missing, seen, weight)
                change = (new - x).abs().amax((1, 2))
                x = torch.where(active[:, None, None], new, x)
                force = torch.where(active[:, None, None], new_force, force)
                active &= ~(change <= self.tolerance)
                if not bool(active.any()):
                    return Reconstruction(problem.finish(x), force, iteration)
        raise ConvergenceError(
            f"sparse Gauss-Newton reconstruction moved by {float(change.max()):.1e} m in its last iteration, the "
            f"{self.max_iterations}th: raise reconstruction.regularisation or reconstruction.max_iterations.",
            x,
            None,
        )

    def _iterate(
        self,
        problem: Linearisation,
        x: torch.Tensor,
        end: torch.Tensor,
        missing: torch.Tensor,
        seen: torch.Tensor,
        weight: float,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Next positions and force (B, N, 3); see the class's equations.

        Args:
            problem: the step.
            x: (B, N, 3) the iterate [m].
            end: (B, N, 3) q+ for it [m].
            missing: (B, m, 3) e (y - C(q+)), zero where not seen [m].
            seen: (B, m, 3) bool.
            weight: lambda e^2.
        """
        residual = problem.residual(x).reshape(len(x), -1, 1).to(x.dtype)
        problem.factorise(x)
        transposed = self.markers.transposed_jacobian(end) if self._constant is None else self._constant
        transposed = transposed * seen.flatten(1)[:, None]
        basis = self._basis
        columns = transposed
        by_mode = basis is not None and basis.shape[1] < transposed.shape[2]
        if basis is not None and by_mode:
            columns = basis.expand(len(x), -1, -1)
        solved = problem.solve(torch.cat([columns, residual], dim=2))
        response = solved[:, :, :-1]
        settling = solved[:, :, -1:]
        jacobian = response.mT
        if basis is not None:
            jacobian = transposed.mT @ response if by_mode else response.mT @ basis
        right = missing.reshape(len(x), -1, 1) + transposed.mT @ settling
        coefficients = ridge(jacobian, right, weight)
        force = coefficients if basis is None else basis @ coefficients
        return x + (problem.solve(force) - settling).view_as(x), force.view_as(x)


class SparseLevenbergMarquardt(_OnMarkers):
    """Levenberg-Marquardt in the forces, for motions that Gauss-Newton does not follow, such as jerks of real bodies.

    Every trial force is followed by a whole step of the simulator, with its line search, so that an iterate is always a
    state that the simulator reaches. With J = C' H^-1 there, the next force minimises

        |r - J (f - f0)|^2 + lambda |f|^2 + d |f - f0|^2,

    and is taken if the objective gets smaller; the damping d grows where it does not, and fades where it does. An
    environment is done, and left alone, when such a step moves no position by more than ``tolerance`` [m] and either
    is hardly damped or leads nowhere.
    """

    @override
    @torch.no_grad()
    def step(
        self,
        state: State,
        observed: torch.Tensor,
        inputs: Inputs | None = None,
        first_guess: torch.Tensor | None = None,
    ) -> Reconstruction:
        """See `SparseGaussNewton.step`; the first guess is a force (B, N, 3) [N]."""
        force = torch.zeros_like(state.q) if first_guess is None else first_guess
        seen = torch.isfinite(observed)
        inputs = inputs or Inputs()
        new, objective = self._try(state, force, observed, inputs)
        if not bool(torch.isfinite(objective).all()):
            force = torch.zeros_like(force)
            new, objective = self._try(state, force, observed, inputs)
        damping, done = torch.zeros_like(objective), torch.zeros_like(objective, dtype=torch.bool)
        for iteration in range(1, self.max_iterations + 1):
            candidate = self._next_force(state, new, force, observed, seen, damping, inputs)
            reached, value = self._try(state, torch.where(done[:, None, None], force, candidate), observed, inputs)
            simulated = torch.isfinite(value)
            better = simulated & (value <= objective)
            moved = torch.where(simulated, (reached.q - new.q).abs().amax((1, 2)), torch.inf)
            settled = (moved <= self.tolerance) & (~better | (damping <= self.regularisation))
            where = (better & ~done)[:, None, None]
            force = torch.where(where, candidate, force)
            if bool(simulated.all()):
                new = State(
                    torch.where(where, reached.q, new.q), torch.where(where, reached.v, new.v), reached.previous
                )
            objective = torch.where(better & ~done, value, objective)
            damping = torch.where(better, 0.1 * damping, (10.0 * damping).clamp_min(self.regularisation))
            done |= settled
            if bool(done.all()):
                return Reconstruction(new, force, iteration)
        raise ConvergenceError(
            f"sparse Levenberg-Marquardt reconstruction moved by {float(moved.max()):.1e} m in its last iteration, the "
            f"{self.max_iterations}th: raise reconstruction.regularisation or reconstruction.max_iterations.",
            new.q,
            None,
        )

    def _try(
        self, state: State, force: torch.Tensor, observed: torch.Tensor, inputs: Inputs
    ) -> tuple[State, torch.Tensor]:
        """Where a force leads, and the objective (B,) there; infinite where the simulator fails."""
        try:
            new, _ = self.simulator.step(state, inputs.plus(force), self._constants)
        except ConvergenceError:
            return state, torch.full_like(state.q[:, 0, 0], torch.inf)
        missing = torch.nan_to_num(observed - self.markers(new.q))
        misfit = torch.where(torch.isfinite(observed), missing, 0.0).square().sum((1, 2))
        return new, misfit + self.regularisation * force.square().sum((1, 2))

    def _next_force(
        self,
        state: State,
        new: State,
        force: torch.Tensor,
        observed: torch.Tensor,
        seen: torch.Tensor,
        damping: torch.Tensor,
        inputs: Inputs,
    ) -> torch.Tensor:
        """(B, N, 3) the minimiser of the linearised objective; see the class's equations."""
        sim = self.simulator
        problem = sim.linearise(state, inputs, self._constants)
        problem.factorise(sim.method.solution_for(state, new.q))
        transposed = self.markers.transposed_jacobian(new.q) * seen.flatten(1)[:, None]
        jacobian = problem.solve(transposed).mT / problem.stage.end  # q+ moves 1 / end times as far as the solution
        old = force.flatten(1)[..., None]
        missing = torch.where(seen, observed - self.markers(new.q), 0.0).flatten(1)[..., None]
        weight = (self.regularisation + damping)[:, None, None]
        centre = (damping[:, None, None] / weight) * old
        gram = jacobian @ jacobian.mT
        identity = torch.eye(gram.shape[1], device=gram.device, dtype=gram.dtype)
        right = missing + jacobian @ (old - centre)
        return (centre + jacobian.mT @ torch.linalg.solve(gram + weight * identity, right)).view_as(force)


class SparseLBFGSB(_OnMarkers, LBFGSB):
    """The published method on sparse markers: L-BFGS-B on the forces, with gradients through the simulator.

    ``tolerance`` is the relative change of the objective.
    """

    @override
    def step(
        self,
        state: State,
        observed: torch.Tensor,
        inputs: Inputs | None = None,
        first_guess: torch.Tensor | None = None,
    ) -> Reconstruction:
        """See `SparseGaussNewton.step`; the first guess is a force (B, N, 3) [N]."""
        seen = torch.isfinite(observed)
        return self._minimise(
            state, lambda q: torch.where(seen, self.markers(q) - observed, 0.0).square().sum(), inputs, first_guess
        )


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


def check_sparse(regularisation: float, markers: Markers, simulator: Simulator) -> None:
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
    markers: Markers,
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
    methods = {"levenberg_marquardt": SparseLevenbergMarquardt, "lbfgsb": SparseLBFGSB}
    if method not in methods:
        known = ", ".join(("gauss_newton", *methods))
        raise InputError(f"reconstruction.method is {method!r}: choose one of {known}.")
    if modes is not None:
        raise InputError(
            f"{modes} modes are asked for, but reconstruction.method={method} has none: take gauss_newton."
        )
    return methods[method](*settings)
