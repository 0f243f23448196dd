"""Balance of forces of observed motions, which gives the coefficients
of a material's law without simulations.

The terms of a law are those of `energies.convex_material.ConvexMaterial`. Their forces are linear
in their coefficients. With the positions of all vertices at every step, the residual of a step
(`Simulator.linearise`) at the observed solution is g_0 + sum_k theta_k a_k, where a_k is the force
of coefficient k alone. The coefficients are the non-negative least-squares solution of

    min sum || H^-1 (g_0 + sum_k theta_k a_k) ||^2

over steps and motions: the weak form of an unknown law (Flaschel, Kumar and De Lorenzis, Computer
Methods in Applied Mechanics and Engineering 381, 2021). H is the Hessian of a longer step, whose
inverse turns forces into the displacements that they would cause. Without this weight, forces of
nearly incompressible modes rule the sum.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
import scipy.optimize
import torch

from ...core.dynamics.simulator import Simulator
from ...core.energies.solid import VISCOUS_STRAIN
from ...core.energies.tendon_forces import SEGMENT_TENSION
from ...core.stepping.inputs import Inputs
from ...core.stepping.state import State
from ...io.arrays import FloatArray
from ...io.errors import InputError

# Values of parameters that give one unit of a coefficient, the others being zero.
Candidate = Mapping[str, float]

_CARRIED = (VISCOUS_STRAIN, SEGMENT_TENSION)  # memory that forces of later steps depend on
_AT_ONCE = 256  # environments of a batch
_RIDGE = 1e-14  # of the trace, where columns are dependent


@dataclass(frozen=True)
class KnownMotion:
    """B observed motions with the same number of steps T."""

    q: torch.Tensor  # (T + 1, B, N, 3) positions of all vertices at the steps [m]
    v: torch.Tensor  # (B, N, 3) velocities at the start [m/s]
    inputs: Inputs = field(default_factory=Inputs)  # during the steps


class WeakForm:
    """Balance of forces of motions.

    Args:
        simulator: simulator with all energies, of which some have unknown coefficients.
        motions: motions that begin without memory, as after a long rest.
        zero: values of the parameters without the forces of these coefficients.
        stiffness: values of the parameters for the Hessian of the weight.
        stride: steps from one row to the next.
        weight_step: time step of that Hessian [s].
    """

    def __init__(
        self,
        simulator: Simulator,
        motions: Sequence[KnownMotion],
        zero: Candidate,
        stiffness: Candidate,
        stride: int = 5,
        weight_step: float = 0.05,
    ) -> None:
        if not motions or stride < 1:
            raise InputError(
                "there is no step to balance: give at least one motion, "
                "and a stride of one or more."
            )
        self._simulator = simulator
        self._zero = dict(zero)
        self._stride = stride
        self._slow = replace(simulator, time_step=weight_step)
        self._stiff = self._slow.prepare(stiffness)
        self._motions = motions
        with torch.no_grad():
            self._states = [list(self._along(motion)) for motion in motions]
        self.target = -self._rows([self._zero])[:, 0]  # (R,) rows of -H^-1 g_0

    def columns(self, candidates: Sequence[Candidate]) -> FloatArray:
        """Returns H^-1 a_k (R, K) of K candidates [m].

        Rows run over steps, motions and free coordinates.
        """
        return self._rows([self._zero, *candidates])[:, 1:] + self.target[:, None]

    def _along(self, motion: KnownMotion) -> "list[State]":
        """Returns the states at the start of every step, without memory."""
        method, step = self._simulator.method, self._simulator.time_step
        states = [State(motion.q[0], motion.v)]
        for q in motion.q[1:-1]:
            x = method.solution_for(states[-1], q)
            states.append(replace(method.finish(states[-1], x, step), q=q))
        return states

    @torch.no_grad()
    def _rows(self, candidates: Sequence[Candidate]) -> FloatArray:
        """Returns the weighted residuals (R, K) with the parameters of each candidate,
        the others being zero.
        """
        parts = []
        for motion, states in zip(self._motions, self._states, strict=True):
            most = max(1, _AT_ONCE // motion.q.shape[1])
            chunks = [candidates[i : i + most] for i in range(0, len(candidates), most)]
            parts.append(
                np.concatenate([self._of_motion(motion, states, chunk) for chunk in chunks], axis=1)
            )
        return np.concatenate(parts)

    def _of_motion(
        self, motion: KnownMotion, states: Sequence[State], candidates: Sequence[Candidate]
    ) -> FloatArray:
        simulator, count = self._simulator, len(candidates)
        batch = motion.q.shape[1]
        names = set().union(*candidates)
        values = {
            name: [c.get(name, self._zero.get(name, 0.0)) for c in candidates] for name in names
        }
        series = {name: [value] * count for name, value in self._zero.items()} | values
        spread = {
            name: motion.q.new_tensor(x).repeat_interleave(batch)[:, None]
            for name, x in series.items()
        }
        constants = simulator.prepare(spread)
        carries = True
        memory: Mapping[str, torch.Tensor] = {}
        rows = []
        for number, start in enumerate(states):
            if number % self._stride and not carries:
                continue
            state = replace(start.map(lambda t: t.repeat(count, 1, 1)), memory=memory)
            end = motion.q[number + 1]
            inputs = motion.inputs.at(number).repeat(count)
            if number % self._stride == 0:
                x = simulator.method.solution_for(state, end.repeat(count, 1, 1))
                rows.append(
                    self._weighted(simulator.linearise(state, inputs, constants).residual(x), end)
                )
            if carries:
                memory = simulator.remember(
                    state, end.repeat(count, 1, 1), constants, inputs
                ).memory
                memory = {name: value for name, value in memory.items() if name.endswith(_CARRIED)}
                carries = bool(memory)
        return np.concatenate(rows)

    def _weighted(self, residuals: torch.Tensor, at: torch.Tensor) -> FloatArray:
        """Returns H^-1 g on the free vertices, (B 3F, K),
        of residuals (K B, N, 3) at positions (B, N, 3).
        """
        lin = self._slow.linearise(State(at, torch.zeros_like(at)), None, self._stiff)
        lin.factorise(at)
        forces = residuals.unflatten(0, (-1, len(at))).permute(1, 2, 3, 0).flatten(1, 2)
        moved = lin.solve(forces).unflatten(1, (-1, 3))[:, lin.free]
        rows: FloatArray = moved.flatten(0, 2).cpu().numpy().astype(np.float64)
        return rows


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of columns (R, K) theta = target (R,),
    for fits of many subsets of the columns.
    """

    matrix: FloatArray  # (K, K)
    right: FloatArray  # (K,)
    square: float  # |target|^2

    @classmethod
    def of(cls, columns: FloatArray, target: FloatArray) -> "NormalEquations":
        """Returns those of columns (R, K) and a target (R,)."""
        return cls(columns.T @ columns, columns.T @ target, float(target @ target))

    def fit(self, members: Sequence[int]) -> FloatArray:
        """Returns the non-negative least-squares solution with some of the columns."""
        picked = np.ix_(members, members)
        scale = np.sqrt(np.diag(self.matrix)[members])
        used = scale > 0.0
        unit = (
            self.matrix[picked] / np.outer(np.where(used, scale, 1.0), np.where(used, scale, 1.0))
        )[used][:, used]
        root = scipy.linalg.cholesky(
            unit + _RIDGE * np.trace(unit) / max(len(unit), 1) * np.eye(len(unit))
        )
        right = scipy.linalg.solve_triangular(
            root, self.right[members][used] / scale[used], trans=1
        )
        theta = np.zeros(len(scale))
        theta[used] = scipy.optimize.nnls(root, right)[0] / scale[used]
        return theta

    def residual(self, members: Sequence[int], theta: FloatArray) -> float:
        """Returns the root mean square of the forces of some columns less the target,
        over that of the target.

        It has half of the digits of the columns, 1e-8.
        """
        quadratic = float(theta @ self.matrix[np.ix_(members, members)] @ theta)
        left = quadratic - 2.0 * float(theta @ self.right[members]) + self.square
        return math.sqrt(max(left, 0.0) / self.square)
