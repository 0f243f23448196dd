"""One step of a robot, linearised in its slowest vibrations about a state of rest.

The derivatives are central differences of steps, so that they contain everything that a step does:
the learned force, damping, friction and the integrator. They are as wide as the errors that a twin
corrects, since a learned force may change by more within less, and is clipped.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch

from ..control.sampling import linearised
from ..core.energies.materials import VISCOUS
from ..core.stepping.integrators import make_integrator
from ..core.stepping.state import State
from ..io.arrays import FloatArray, IntArray
from ..robot.actuation import FORCE, Given, InputReader
from ..robot.robot import Robot

_STEP: Final = 1e-2  # of the central differences, over the size of the body
_SAME: Final = 1e-3  # relative difference of eigenvalues that belong together
# Shift below zero of the eigenvalues, over the largest on the diagonal: a free body has zeros.
_BELOW: Final = 1e-6
_SLOWEST: Final = 1.0  # least frequency of a mode, for the scale of its errors [rad/s]


@dataclass(frozen=True)
class StepTangent:
    """A step in coordinates z, their rates w, and a force
    that shifts their equilibrium by b, all (r,).
    """

    shapes: torch.Tensor  # (r, N, 3) of the vibrations, orthonormal in the mass
    pull: torch.Tensor  # (r, N, 3) forces that shift the equilibrium by one of each coordinate [N]
    frequencies: FloatArray  # (r,) [rad/s]
    transition: FloatArray  # (2 r, 3 r) of (z, w) after a step by (z, w, b) before it, at rest
    size: float  # root mean square displacement of the body per unit of a coordinate [m]
    amounts: FloatArray  # (3 r,) of z, w and b in the differences
    duals: FloatArray  # (3 F, r) from the free vertices to the coordinates
    free: torch.Tensor  # (F,) numbers of the free vertices

    @classmethod
    def of(
        cls, robot: Robot, state: State, inputs: Mapping[str, Given], modes: int
    ) -> "StepTangent":
        """Linearises a step from a state of rest, with one environment.

        Args:
            robot: with a simulator.
            state: of rest.
            inputs: constant commands under which it rests.
            modes: least number r; vibrations of equal frequency are kept together.
        """
        simulator = robot.simulator
        elastic = robot.with_parameters(
            **{name: 0.0 for name in simulator.parameters if name.endswith(VISCOUS)}
        )
        values, vectors, inertia, free = _vibrations(elastic, state, inputs, modes)
        frequencies, count = np.sqrt(np.abs(values)).clip(_SLOWEST), len(values)
        duals = inertia @ vectors
        spread = scipy.sparse.kron(simulator.body.coordinates.matrix, scipy.sparse.identity(3))
        coordinates = (3 * free[:, None] + np.arange(3)).ravel()

        def fields(columns: FloatArray) -> torch.Tensor:
            whole = np.zeros((3 * simulator.body.n_vertices, count))
            whole[coordinates] = columns
            return simulator.tensor(whole.T.reshape(count, -1, 3))

        shapes = simulator.tensor(
            (spread @ fields(vectors).cpu().double().numpy().reshape(count, -1).T).T.copy()
        )
        shapes = shapes.reshape(count, -1, 3)
        pull = fields(duals * frequencies**2)
        size = float(shapes.norm(dim=2).square().mean().sqrt())
        rest = simulator.rest_positions
        amount = (
            _STEP
            * float((rest.amax(0) - rest.amin(0)).max())
            / shapes.norm(dim=2).amax(1).cpu().double().numpy()
        )
        amounts = np.concatenate([amount, amount * frequencies, amount])
        chosen = torch.as_tensor(free, device=rest.device)
        tangent = cls(
            shapes,
            pull,
            frequencies,
            np.zeros((2 * count, 3 * count)),
            size,
            amounts,
            duals,
            chosen,
        )
        base = robot.step(robot.step(state, **inputs), **inputs).detach()
        columns = range(3 * count)
        moved, faster, pulled = tangent.changes(columns)
        after = robot.step(
            shifted(robot, base.repeat(6 * count), moved, faster),
            **pulled_by(robot, inputs, pulled),
        )
        return replace(tangent, transition=tangent.slopes(after, columns))

    def changes(self, columns: Sequence[int]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Returns displacements [m], velocities [m/s] and forces [N]
        for C columns of a transition, (2 C, N, 3).

        The first C are those of the columns' `amounts`, the others their opposites.
        """
        count = len(self.frequencies)
        fields = self.shapes.new_zeros(3, len(columns), *self.shapes.shape[1:])
        for row, column in enumerate(columns):
            kind, number = divmod(column, count)
            fields[kind, row] = (
                self.amounts[column] * (self.pull if kind == 2 else self.shapes)[number]
            )
        moved, faster, pulled = torch.cat([fields, -fields], dim=1)
        return moved, faster, pulled

    def slopes(self, after: State, columns: Sequence[int]) -> FloatArray:
        """Returns C columns (2 r, C) of a transition,
        from 2 C environments after `changes` and a step.
        """
        count, environments = len(columns), range(len(after.q))
        below, above = after.select(environments[count:]), after.select(environments[:count])
        changes = (
            (x - y)[:, self.free].flatten(1) for x, y in ((above.q, below.q), (above.v, below.v))
        )
        response = 0.5 * np.concatenate(
            [x.cpu().double().numpy() @ self.duals for x in changes], axis=1
        )
        return np.asarray(response.T / self.amounts[[*columns]])


def pulled_by(robot: Robot, inputs: Mapping[str, Given], forces: torch.Tensor) -> dict[str, Given]:
    """Returns inputs with forces (B, N, 3) [N] that are added to theirs."""
    if FORCE in inputs:
        forces = forces + InputReader(robot.inputs, robot.simulator).field(inputs[FORCE], FORCE)
    return {**inputs, FORCE: forces}


def shifted(
    robot: Robot, state: State, moved: torch.Tensor, faster: torch.Tensor, at_once: bool = True
) -> State:
    """Returns a state with other positions and velocities, and a past that fits them.

    Obstacles push the body out.

    Args:
        robot: in this state.
        state: of B environments.
        moved: (B, N, 3) [m].
        faster: (B, N, 3) [m/s].
        at_once: whether the body has only just been moved, so that its material has not relaxed
            there; else as if it had always been there.
    """
    memory = dict(state.memory)
    q = robot.simulator.energies.outside(state.q + moved, state, robot.constants)
    v = state.v + faster
    moved = q - state.q
    if at_once and any("." not in name for name in memory):
        after, before = (
            robot.simulator.remember(state, x, robot.constants).memory for x in (q, state.q)
        )
        memory |= {
            name: memory[name] + (value - before[name])
            for name, value in after.items()
            if name in memory
        }
    previous = None
    if state.previous is not None:
        previous = state.previous[0] + moved - robot.time_step * faster, state.previous[1] + faster
    return State(q, v, previous, memory)


def _vibrations(
    robot: Robot, state: State, inputs: Mapping[str, Given], modes: int
) -> tuple[FloatArray, FloatArray, scipy.sparse.csc_array, IntArray]:
    """Eigenvalues (r,) [1/s^2], vectors (3 F, r), mass (3 F, 3 F) of the slowest vibrations.

    Free vertices.
    """
    still = State(state.q, torch.zeros_like(state.v), memory=state.memory)
    hessian, mass, free = linearised(robot, still, **inputs)
    step = make_integrator(robot.simulator.integrator).stage(still, robot.time_step).step
    stiffness, mass = (hessian - mass).tocsc(), scipy.sparse.csc_array(step**2 * mass)
    unknowns = mass.shape[0]
    count = min(modes + 6, unknowns - 2)
    shift = -_BELOW * float((stiffness.diagonal() / mass.diagonal()).max())
    values, vectors = scipy.sparse.linalg.eigsh(
        stiffness, count, M=mass, sigma=shift, v0=np.ones(unknowns)
    )
    order = np.argsort(values)
    values, vectors = values[order], vectors[:, order]
    kept = min(modes, count)
    while kept < count and values[kept] - values[kept - 1] < _SAME * abs(values[kept]):
        kept += 1
    return values[:kept], vectors[:, :kept], mass, free
