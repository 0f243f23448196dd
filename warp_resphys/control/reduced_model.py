r"""A reduced model of a robot: its equilibria, the slowest vibrations about them,
and the learned force's network.

In coordinates z = Psi^T M x of r modes,

    z'' + D(u) z' + A(u) (z - z_0(u)) + sum_k B_k(u) y_k = G(u) (c - c_0(u)),
    y_k' = z' - y_k / tau_k,

with u the inputs after their response to the commands, y_k what has not relaxed yet in a Prony
branch, and c the outputs of the learned force's network, evaluated on the body that z and z'
describe (hyper-reduction: no degree of freedom of the full model is left). z_0(u) is the
equilibrium under u and a force of fixed outputs c_0(u), affine in u: a fit of the network's
outputs. With Phi(u) the vibrations about it, K phi = omega^2 M phi, and T the orthogonal matrix
closest to Psi^T M Phi,

    A = T (omega^2 - Phi^T dF/dx Phi) T^T,   D = T Phi^T V Phi T^T,
    B_k = T Phi^T V_k Phi T^T,               G = T Phi^T dF/dc,

where F is the learned force of fixed outputs, which turns with the body, and V and V_k are the
damping of the full model and the stiffness of a branch. Observed points are
y = y_0(u) + C(u) dz + H dz dz with dz = z - z_0(u); C is exact for small dz. The vertices are at
x_0(u) + Psi dz. All are polynomials of those inputs that vary in the trials, of the order that is
best on samples that were left out, fitted to equilibria and the vibrations about them
(interpolation of reduced operators: Amsallem and Farhat, AIAA J. 46 (2008) 1803; here all share one
basis Psi); D and B_k are squares of polynomials, so that no motion gains energy by them. H is
constant, fitted to motions. As in the robot, the network is evaluated at the state before a step,
so a step is linear in z. With s = (z, z'), and the integrator's g (1/3 where BDF2 has a previous
state, else 0) and step length h',

    s_{k+1} = L ((1 + g) s_k - g s_{k-1}) + J (A z_0 + P z_k - sum B e y + force(s_k)),
    J = [N; N / h'],   N = (1 / h'^2 + D / h' + A + P)^-1,   P = sum B gamma,
    y_{k+1} = e y_k + gamma (z_{k+1} - z_k),

with sums over the branches, and e and gamma of `energies.viscosity`. B models are stepped together,
so that differences of as many as there are variables give derivatives in one pass. Inputs are in
units of `ReducedModel.scale`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from ..core.energies.viscosity import relaxation
from ..data.input_response import InputResponse
from ..io.arrays import BoolArray, FloatArray, IntArray
from ..io.errors import ConvergenceError
from .polynomials import Monomials, Polynomial, SquaredPolynomial, around
from .reduced_force import ForceAlong, ReducedForce

_REST_TOLERANCE: Final = (
    1e-6  # of equilibria, relative to the coordinates' size; networks are in float32
)
_ITERATIONS: Final = 50
_SHARES: Final = 0.5 ** np.arange(8.0)  # of a step of Newton's method, of which the best is taken
_DIFFERENCE: Final = 1e-3  # of coordinates for derivatives of the force, relative to their size
_MOVED: Final = 1e-4  # root mean square displacement of the vertices for derivatives of a step [m]


@dataclass(frozen=True)
class ReducedState:
    """The state of B reduced models."""

    z: FloatArray  # (B, r) coordinates
    v: FloatArray  # (B, r) their rates [1/s]
    strains: FloatArray  # (K, B, r) y_k of the Prony branches
    acting: FloatArray  # (B, n') moving inputs after their response to commands, in the scale
    memory: Mapping[str, FloatArray]  # of the inputs' response, entries (..., B, n)
    previous: FloatArray  # (2, B, r) coordinates and rates one step earlier
    looks_back: (
        BoolArray  # (B,) whether the integrator may use ``previous``; false before the first step
    )
    left: BoolArray  # (B,) whether the learned force was ever evaluated outside its training range
    lost: (
        BoolArray  # (B,) whether a world has found that the model diverged; it stands at rest then
    )

    def moved(self, z: FloatArray, v: FloatArray, time_step: float) -> "ReducedState":
        """Returns the state with its coordinates (B, r) and rates changed at once,
        and a past that fits them.
        """
        previous = self.previous + np.stack([z - time_step * v, v])
        return replace(
            self, z=self.z + z, v=self.v + v, strains=self.strains + z, previous=previous
        )

    def where(self, chosen: BoolArray, other: "ReducedState") -> "ReducedState":
        """Joins two states: this one where chosen (B,), the other one elsewhere."""
        pairs = ((key, array, other.arrays()[key]) for key, array in self.arrays().items())
        return self.from_arrays(
            {k: np.where(chosen[:, None] if a.ndim > 1 else chosen, a, b) for k, a, b in pairs}
        )

    def select(self, models: Sequence[int]) -> "ReducedState":
        """Returns the state of some models, by number."""
        rows = [*models]
        return self.from_arrays(
            {k: a[..., rows, :] if a.ndim > 1 else a[rows] for k, a in self.arrays().items()}
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays of the state by name."""
        known = {key: array for key, array in vars(self).items() if key != "memory"}
        return known | {f"memory.{key}": array for key, array in self.memory.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> "ReducedState":
        """Restores the state from its `arrays`."""
        arguments = {key: array for key, array in arrays.items() if not key.startswith("memory.")}
        memory = {
            key.removeprefix("memory."): arrays[key] for key in arrays.keys() - arguments.keys()
        }
        return cls(memory=memory, **arguments)


@dataclass(frozen=True)
class ReducedModel:
    """The reduced model of a robot; the module's docstring has the equations."""

    time_step: float  # h [s]
    integrator: str  # ``implicit_euler`` or ``bdf2``
    labels: tuple[str, ...]  # of the M observed points
    name: str  # of the input
    scale: FloatArray  # (n,) of the inputs
    range: FloatArray  # (2, n) least and largest commands of the trials; n' of them differ
    acts: Mapping[str, Any]  # arguments of `InputResponse`, from the commands to the inputs
    filters: tuple[float, ...]  # F time constants of the filtered inputs that the network takes [s]
    times: tuple[float, ...]  # K relaxation times tau_k of the Prony branches [s]
    static: Polynomial  # z_0, (r,)
    observed: Polynomial  # y_0, (3 M,) [m]
    stiffness: Polynomial  # A, (r, r) [1/s^2]
    damping: SquaredPolynomial  # D, (r, r) [1/s]
    shown: Polynomial  # C, (3 M, r) [m]
    branches: SquaredPolynomial  # B_k, (K, r, r) [1/s^2]
    shape: Polynomial  # x_0, (3 N,) displacements of the vertices [m]
    basis: FloatArray  # Psi, (3 N, r)
    curved: FloatArray  # H, (r, r, 3 M), symmetric [m]
    force: ReducedForce | None = None  # the learned force; None for a simulator alone
    # errors, and counts of the samples that the model was fitted to
    quality: Mapping[str, Any] = field(default_factory=dict)
    robot: str = ""  # `reduction.fingerprint` of its robot

    @property
    def modes(self) -> int:
        """The number r of coordinates."""
        return len(self.curved)

    @property
    def parts(self) -> int:
        """The number n of inputs."""
        return len(self.scale)

    @cached_property
    def moving(self) -> IntArray:
        """Numbers (n',) of the inputs that the model depends on."""
        return np.flatnonzero(self.range[1] > self.range[0])

    def _moving(self, acting: FloatArray) -> FloatArray:
        """Moving inputs (..., n') of inputs (..., n), in units of the scale."""
        return np.asarray((acting / self.scale)[..., self.moving])

    @cached_property
    def response(self) -> InputResponse:
        """Response of the inputs to the commands, and filters whose outputs the network takes."""
        return InputResponse(self.time_step, **self.acts, filters=self.filters)

    @cached_property
    def relaxation(self) -> tuple[FloatArray, FloatArray]:
        """Factors e and gamma (K,) of the Prony branches in a step."""
        decay, gamma = relaxation(torch.tensor(self.times, dtype=torch.float64), self.time_step)
        return decay.numpy(), gamma.numpy()

    def rest(self, inputs: FloatArray | None = None, count: int = 1) -> ReducedState:
        """Returns the state of B models in equilibrium under inputs (n,), zero if omitted.

        Raises:
            ConvergenceError: there is no equilibrium, because the learned force is too large.
        """
        commands = np.zeros((count, self.parts)) if inputs is None else np.tile(inputs, (count, 1))
        u = self._moving(self.response.still(commands))
        z = np.repeat(self._equilibrium(Monomials(u[:1])), count, axis=0)
        still, relaxed = np.stack([z, np.zeros_like(z)]), np.zeros((len(self.times), *z.shape))
        memory, no = self.response.steady(commands), np.zeros(count, dtype=np.bool_)
        return ReducedState(still[0], still[1], relaxed, u, memory, still, no, no, no)

    def _equilibrium(self, u: Monomials) -> FloatArray:
        """Coordinates (S, r) with A (z - z_0) = learned force,
        by Newton's method with step halving.
        """
        a, base = self.stiffness(u), self.static(u)
        if self.force is None:
            return base
        size = np.abs(self.static.coefficients).max()
        means = np.repeat(u.points[None], len(self.filters), axis=0)

        def imbalance(z: FloatArray) -> FloatArray:
            """Residuals (K, S, r) of K trials."""
            flat, count = z.reshape(-1, self.modes), len(z)
            force = self._force(
                Monomials(np.tile(u.points, (count, 1))), np.tile(means, (1, count, 1))
            )
            assert force is not None
            pushed = force(slice(None), np.stack([flat, np.zeros_like(flat)]))
            return np.asarray((a @ (z - base)[..., None])[..., 0] - pushed.reshape(z.shape))

        def error(residual: FloatArray) -> FloatArray:
            """Largest residuals (K,), as displacements of the coordinates."""
            return np.asarray(np.abs(np.linalg.solve(a, residual[..., None])).max((1, 2, 3)))

        z, step = base, _DIFFERENCE * size
        for _ in range(_ITERATIONS):
            residual = imbalance(around(z, step))
            if error(residual[:1])[0] < _REST_TOLERANCE * size:
                return z
            slope = np.moveaxis(residual[1:] - residual[0], 0, -1) / step
            change = np.linalg.solve(slope, residual[0][..., None])[..., 0]
            trials = z - _SHARES[:, None, None] * change
            z = trials[error(imbalance(trials)).argmin()]
        raise ConvergenceError(
            "the reduced model has no equilibrium: its learned force is too large.", z, None
        )

    def _force(self, u: Monomials, means: FloatArray) -> ForceAlong | None:
        return None if self.force is None else ForceAlong(self.force, u, self.static, means)

    def rest_observed(self, inputs: FloatArray) -> FloatArray:
        """Returns observed points (S, 3 M) in equilibrium under inputs (S, n) [m].

        Raises:
            ConvergenceError: there is no equilibrium.
        """
        u = Monomials(self._moving(self.response.still(inputs)))
        return self.points(self._equilibrium(u), u)

    def observe(self, state: ReducedState) -> FloatArray:
        """Observed points (B, 3 M) in a state [m]."""
        return self.points(state.z, Monomials(state.acting))

    def positions(self, state: ReducedState) -> FloatArray:
        """Displacements (B, N, 3) of the vertices in a state [m]."""
        u = Monomials(state.acting)
        return (self.shape(u) + (state.z - self.static(u)) @ self.basis.T).reshape(
            len(state.z), -1, 3
        )

    def points(self, z: FloatArray, u: Monomials) -> FloatArray:
        """Observed points (S, 3 M) at coordinates (S, r) under S inputs [m]."""
        off = z - self.static(u)
        squares = (off[:, :, None] * off[:, None, :]).reshape(len(z), -1)
        linear = (self.shown(u) @ off[..., None])[..., 0]
        return self.observed(u) + linear + squares @ self.curved.reshape(squares.shape[1], -1)

    def point_slopes(self, z: FloatArray, u: Monomials) -> FloatArray:
        """Derivatives (S, 3 M, r) of `points` with respect to the coordinates."""
        off, r = z - self.static(u), self.modes
        bent = (off @ self.curved.reshape(r, -1)).reshape(len(z), r, -1)
        return np.asarray(self.shown(u) + 2.0 * bent.swapaxes(1, 2))

    def step(self, state: ReducedState, inputs: FloatArray) -> ReducedState:
        """Returns the state of B models after a step under commands (B, n)."""
        return self.move(state, inputs[None])[2]

    def move(
        self, start: ReducedState, inputs: FloatArray, bias: FloatArray | None = None
    ) -> tuple[FloatArray, Monomials, ReducedState]:
        """Advances B models by T steps, whose matrices are computed at once.

        Args:
            start: their state.
            inputs: (T, B, n) commanded during each step, in their unit.
            bias: (r,) or (B, r), added to the equilibria z_0.

        Returns:
            Coordinates (T, B, r) after each step, monomials of the (T B, n') moving inputs, and the
            last state.
        """
        acting, means, memory = self.response(start.memory, inputs)
        acting, means = self._moving(acting), self._moving(means)
        steps, batch, n = acting.shape
        u = Monomials(acting.reshape(-1, n))
        r, h = self.modes, self.time_step
        back = np.repeat(start.looks_back[None] & (self.integrator == "bdf2"), steps, axis=0)
        back[1:] = self.integrator == "bdf2"
        share = np.where(back, 1.0 / 3.0, 0.0).reshape(-1, 1)  # g
        step = np.where(back, 2.0 / 3.0 * h, h).reshape(-1, 1)
        base, a, damping = self.static(u), self.stiffness(u), self.damping(u)
        inertia = np.eye(r) / step[..., None] ** 2 + damping / step[..., None]
        branches, (decay, gamma) = self.branches(u), self.relaxation
        relaxed = np.einsum("k,skrq->srq", gamma, branches)
        carried = decay[:, None, None] * branches
        inverse = np.linalg.inv(inertia + a + relaxed)
        shifted = base if bias is None else (base.reshape(steps, batch, r) + bias).reshape(-1, r)
        pull = (a @ shifted[..., None])[..., 0]
        force = self._force(u, means.reshape(len(means), len(u.points), n))
        now, before = np.stack([start.z, start.v]), start.previous
        states = list[FloatArray]()
        strain, left = start.strains, start.left
        for k in range(steps):
            rows = slice(k * batch, (k + 1) * batch)
            at, rate = (1.0 + share[rows]) * now - share[rows] * before
            right = (inertia[rows] @ at[..., None])[..., 0] + rate / step[rows] + pull[rows]
            right += (relaxed[rows] @ now[0, ..., None])[..., 0] - np.einsum(
                "bkrq,kbq->br", carried[rows], strain
            )
            if force is not None:
                right += force(rows, now)
                left = left | force.left
            z = (inverse[rows] @ right[..., None])[..., 0]
            strain = self.relaxed(strain, z - now[0])
            now, before = np.stack([z, (z - at) / step[rows]]), now
            states.append(z)
        looks_back = np.ones(batch, dtype=np.bool_)
        end = ReducedState(
            now[0], now[1], strain, acting[-1], memory, before, looks_back, left, start.lost
        )
        return np.stack(states), u, end

    def relaxed(self, strains: FloatArray, change: FloatArray) -> FloatArray:
        """Returns y_k after a step in which the coordinates change; (K, ...) and (...)."""
        decay, gamma = (
            value.reshape(-1, *np.ones(change.ndim, dtype=int)) for value in self.relaxation
        )
        return np.asarray(decay * strains + gamma * change)

    def respond(
        self, start: ReducedState, inputs: FloatArray, bias: FloatArray | None = None
    ) -> FloatArray:
        """Predicts the observed points (T, B, 3 M) of B motions over T steps [m].

        Args:
            start: state of B models, or of one.
            inputs: (T, B, n) commanded during each step, in their unit.
            bias: (r,) added to the equilibria z_0.
        """
        batch = inputs.shape[1]
        starts = start.select([0] * batch) if len(start.z) == 1 else start
        z, u = self.move(starts, inputs, bias)[:2]
        return self.points(z.reshape(-1, self.modes), u).reshape(len(z), batch, -1)

    @cached_property
    def amounts(self) -> FloatArray:
        """Changes (3 r,) of coordinates, rates and bias for derivatives of a step."""
        moved = _MOVED / np.sqrt((self.basis**2).sum(0) / (len(self.basis) / 3))
        stiffness = self.stiffness(np.zeros((1, len(self.moving))))[0]
        return np.concatenate([moved, moved * np.sqrt(np.abs(np.diag(stiffness))), moved])

    def transition(
        self, start: ReducedState, inputs: FloatArray, bias: FloatArray
    ) -> tuple[ReducedState, FloatArray]:
        """Advances B models by a step, and the first also from other states.

        Args:
            start: their state.
            inputs: (n,) commanded during the step, in their unit.
            bias: (B, r), added to the equilibria z_0.

        Returns:
            Their state after it, and derivatives (2 r, 3 r) of that of the first model by z, v and
            the bias, where z and v are moved with their past (`ReducedState.moved`).
        """
        count, r = len(bias), self.modes
        rows = [*range(count), *([0] * 3 * r)]
        z, v, b = np.split(
            np.concatenate([np.zeros((count, 3 * r)), np.diag(self.amounts)]), 3, axis=1
        )
        states = start.select(rows).moved(z, v, self.time_step)
        end = self.move(states, np.tile(inputs, (1, len(rows), 1)), bias[rows] + b)[2]
        after = np.concatenate([end.z, end.v], axis=1)
        slopes = ((after[count:] - after[0]) / self.amounts[:, None]).T
        return end.select(range(count)), slopes
