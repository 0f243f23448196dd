"""How an observed motion begins: the body that is held, and how it was let go.

The body is at rest under gravity, its weights and a virtual force that brings its markers to where they were held
(the published method finds such forces by steps through time; a static equilibrium has none to wait for). The hand lets
go between two frames, and not without a push, of a body that it may have bent sideways: the delay, a velocity in a few
slow modes, and a sideways displacement are what best explains the first frames.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from ..data.trials import Trials
from ..dynamics.inputs import Inputs
from ..dynamics.integrator import State
from ..dynamics.modes import resolved, vibration_modes, with_signs
from ..dynamics.simulator import Simulator
from ..io.errors import ConvergenceError, InputError
from .replay import Observe, Replay, Start

_HOLD_ITERATIONS = 30
_HOLD_TOLERANCE = 1e-7  # m, change of any position in the last iteration
_SIDEWAYS_STRAIN = 1e-3  # of the body's extent: how far it is bent to find how it bends
_DELAYS = (-2.0, -1.0, 0.0, 1.0, 2.0)  # that the search begins at, in expected deviations
_HOLD_WEIGHT = 1e-6  # w, in units of the largest diagonal entry of the first J^T J


@dataclass(frozen=True)
class ReleaseSettings:
    """How the beginning of a motion is estimated.

    Attributes:
        hold_modes: vibration modes whose inertial forces hold the body; 0 lets it go from where gravity leaves it.
        velocity_modes: vibration modes that the velocity at the release is made of; 0 for none.
        window: how much of the motion after the release is used [s].
        noise: what a marker may be off for reasons that no release explains [m].
        delay: expected deviation of the moment of release from the one found in the frames [s]; 0 keeps that one.
        speed: expected size of the velocity of the fastest vertex [m/s].
        sideways: expected displacement, across gravity, of a body that seems to be held undeformed [m]: as a sideways
            acceleration bends it, at the vertex that moves furthest; 0 for none. Along gravity it would be mistaken for
            a weight or a stiffness.
        iterations: Levenberg-Marquardt steps.
    """

    hold_modes: int = 6
    velocity_modes: int = 0
    window: float = 0.13
    noise: float = 3e-4
    delay: float = 0.0
    speed: float = 0.05
    sideways: float = 0.0
    iterations: int = 4

    def __post_init__(self) -> None:
        """Checks the ranges.

        Raises:
            InputError: a number out of range.
        """
        for name in ("window", "noise", "speed", "iterations"):
            if not getattr(self, name) > 0:
                raise InputError(f"release.{name} is {getattr(self, name)}: it must be positive.")
        for name in ("hold_modes", "velocity_modes", "delay", "sideways"):
            if not getattr(self, name) >= 0:
                raise InputError(f"release.{name} is {getattr(self, name)}: it must be zero or more.")


def estimate_release(simulator: Simulator, markers: Observe, motions: Trials, settings: ReleaseSettings) -> Start:
    """The beginning of every motion, as this simulator would have it.

    Args:
        simulator: of the body.
        markers: (B, N, 3) positions of the vertices to (B, M, 3) markers [m].
        motions: what was observed.
        settings: see the class.

    Raises:
        ConvergenceError: the body cannot be held, or a step of the simulation fails.
    """
    q = hold(Replay(simulator, markers, motions), settings.hold_modes)
    release = Start(State(q, torch.zeros_like(q)), torch.zeros_like(motions.times[:, 0]))
    return _initial_motion(simulator, markers, motions.first(settings.window), release, settings)


def hold(replay: Replay, modes: int) -> torch.Tensor:
    """(R, N, 3) positions at rest under gravity, weights and the virtual force that holds the markers best [m].

    Levenberg-Marquardt on |m(q(a)) - y|^2 + w |a|^2 with q(a) the equilibrium under the force B a. The weight w is so
    small that it only keeps what no marker sees from moving.

    Args:
        replay: of the trials, which tell where the markers were held.
        modes: columns of B, the inertial forces of the slowest vibrations.

    Raises:
        ConvergenceError: no equilibrium was found.
    """
    simulator, count, target = replay.simulator, len(replay.trials.names), replay.trials.held
    with torch.no_grad():
        constants, _, resting = replay.setting()
    if modes == 0:
        with torch.no_grad():
            return simulator.static_equilibrium(resting, constants, batch=count).q
    basis = vibration_modes(simulator, modes)
    identity = torch.eye(modes, dtype=target.dtype, device=target.device)

    def equilibrium(a: torch.Tensor, start: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions, and (R, 3 M) distances from where the markers were held."""
        load = (a @ basis.mT).unflatten(1, (-1, 3))
        q = simulator.static_equilibrium(resting.plus(load), constants, start=start).q
        return q, torch.where(torch.isfinite(target), target - replay.observe(q), 0.0).flatten(1)

    force = simulator.rest_positions.new_zeros(count, modes)
    damping = force.new_full((count, 1, 1), 1e-3)  # in units of the largest diagonal entry
    weight = None
    with torch.no_grad():
        q, missing = equilibrium(force, simulator.rest_state(count).q)
    for _ in range(_HOLD_ITERATIONS):
        jacobian = -_derivatives(equilibrium, force, q)
        gram = jacobian.mT @ jacobian
        scale = gram.diagonal(dim1=1, dim2=2).amax(1)[:, None, None]
        weight = _HOLD_WEIGHT * scale if weight is None else weight
        right = jacobian.mT @ missing[..., None] - weight * force[..., None]
        change = torch.linalg.solve(gram + (weight + damping * scale) * identity, right)[..., 0]
        try:
            with torch.no_grad():
                new_q, new_missing = equilibrium(force + change, q)
        except ConvergenceError:
            damping = 10.0 * damping
            continue
        before, after = (
            y.square().sum(1) + weight[:, 0, 0] * a.square().sum(1)
            for y, a in ((missing, force), (new_missing, force + change))
        )
        better = after <= before
        moved = float((new_q - q).abs().max())
        force = torch.where(better[:, None], force + change, force)
        q = torch.where(better[:, None, None], new_q, q)
        missing = torch.where(better[:, None], new_missing, missing)
        damping = torch.where(better[:, None, None], 0.2 * damping, 10.0 * damping).clamp(1e-9, 1e6)
        if moved < _HOLD_TOLERANCE:
            break
    return q


def _derivatives(
    equilibrium: Callable[[torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]],
    force: torch.Tensor,
    q: torch.Tensor,
) -> torch.Tensor:
    """(R, 3 M, modes) of what is missing by the (R, modes) force, at its equilibrium q."""
    a = force.clone().requires_grad_()
    _, missing = equilibrium(a, q)
    rows = [torch.autograd.grad(missing[:, i].sum(), a, retain_graph=True)[0] for i in range(missing.shape[1])]
    return torch.stack(rows, 1)


def _initial_motion(
    simulator: Simulator, markers: Observe, motions: Trials, held: Start, settings: ReleaseSettings
) -> Start:
    """What explains the first frames (`_ReleaseModel`), by Levenberg-Marquardt with differences over a batch.

    A frame before the release sees the body at rest and one after it does not, so that the objective has a kink at the
    delay of every frame, and minima between them: several delays are tried, and the best one is kept.
    """
    beginning = _ReleaseModel(simulator, markers, held, settings)
    count, unknowns = len(motions.names), len(beginning.deviation)
    if not unknowns:
        return held
    starts = simulator.tensor(_DELAYS if settings.delay > 0.0 else (0.0,))
    runs, size = len(starts) * count, 1 + unknowns
    replay = Replay(simulator, markers, motions.select(list(range(count)) * len(starts) * size))
    step = 0.05
    identity = torch.eye(unknowns, dtype=starts.dtype, device=starts.device)
    offsets = torch.cat([torch.zeros_like(identity[:1]), step * identity]).repeat_interleave(runs, 0)
    trial = starts.repeat_interleave(count)[:, None] * identity[0]  # (runs, unknowns), in expected deviations
    best, least, right = trial, torch.full_like(trial[:, 0], torch.inf), trial[..., None]
    gram = identity.expand(runs, -1, -1)
    damping = torch.full_like(gram[:, :1, :1], 1e-2)  # in units of the largest diagonal entry
    with torch.no_grad():
        for _ in range(settings.iterations + 1):  # The last one only tells whether the step before was good.
            simulated = replay(beginning(trial.repeat(size, 1) + offsets))
            residual = replay.errors(simulated)[0].flatten(1).unflatten(0, (size, runs)) / settings.noise
            objective = residual[0].square().sum(1) + trial.square().sum(1)
            better = objective < least
            least, kept = torch.where(better, objective, least), better[:, None]
            best, better = torch.where(kept, trial, best), kept[..., None]
            jacobian = ((residual[1:] - residual[0]) / step).permute(1, 2, 0)
            gram = torch.where(better, jacobian.mT @ jacobian + identity, gram)
            right = torch.where(better, jacobian.mT @ residual[0][..., None] + trial[..., None], right)
            damping = torch.where(better, 0.2 * damping, 10.0 * damping)
            scale = gram.diagonal(dim1=1, dim2=2).amax(1)[:, None, None]
            change = torch.linalg.solve(gram + damping * scale * identity, right)[..., 0]
            trial = best - change * (3.0 / change.abs().amax(1, keepdim=True)).clamp_max(1.0)
        chosen = least.view(-1, count).argmin(0)
        return beginning(best.view(-1, count, unknowns)[chosen, torch.arange(count, device=chosen.device)])


class _ReleaseModel:
    """Releases of given delays, velocities and sideways displacements, each in units of its expected deviation.

    Args:
        simulator: of the body.
        markers: positions of the vertices to markers.
        held: the release at the time of the frames, at rest, of a body that is held undeformed.
        settings: tell what is looked for.
    """

    def __init__(self, simulator: Simulator, markers: Observe, held: Start, settings: ReleaseSettings) -> None:
        self._markers, self._held = markers, held
        velocities = velocity_shapes(simulator, settings.velocity_modes)
        sideways = sideways_shapes(simulator) if settings.sideways > 0.0 else velocities[:0]
        self._shapes = (velocities, sideways)
        self._sizes = (int(settings.delay > 0.0), len(velocities), len(sideways))
        deviations = (settings.delay, settings.speed, settings.sideways)
        self.deviation = simulator.tensor([d for d, n in zip(deviations, self._sizes, strict=True) for _ in range(n)])

    def __call__(self, values: torch.Tensor) -> Start:
        """The releases of (k R, unknowns) values, the R motions running fastest."""
        delay, speeds, bends = (values * self.deviation).split(self._sizes, 1)
        repeats = len(values) // len(self._held.delay)
        held = self._held.state.q.repeat(repeats, 1, 1)
        velocity, bend = (torch.einsum("bk,knc->bnc", a, b) for a, b in zip((speeds, bends), self._shapes, strict=True))
        shift = self._markers(held) - self._markers(held + bend) if len(self._shapes[1]) else None
        return Start(State(held + bend, velocity), delay.sum(1), shift)


def sideways_shapes(simulator: Simulator) -> torch.Tensor:
    """(1 or 2, N, 3) displacements by accelerations across gravity, about rest, each with its furthest vertex at one.

    Of the two directions the stiffer one is left out if it bends the body less than half as far: what little it moves
    may well be along gravity. Weights that hang on the body take no part.
    """
    directions = torch.linalg.svd(simulator.tensor(simulator.gravity)[None])[2][1:]
    extent = float((simulator.rest_positions.amax(0) - simulator.rest_positions.amin(0)).max())
    size = 0.1  # m/s^2
    with torch.no_grad():
        weightless = simulator.prepare({"gravity": torch.zeros_like(directions)})
        mass = weightless.mass - simulator.tensor(simulator.body.attached_mass)
        for _ in range(3):  # Small enough for a linear answer, and well above rounding, however stiff the body is.
            load = size * mass[..., None] * directions[:, None]
            bent = simulator.static_equilibrium(Inputs(load), weightless).q - simulator.rest_positions
            size *= _SIDEWAYS_STRAIN * extent / float(bent.norm(dim=2).max())
    # From the softest direction to the stiffest; a hundredth of difference is within what the solver leaves.
    _, sizes, rows = np.linalg.svd(bent.flatten(1).double().cpu().numpy(), full_matrices=False)
    columns = with_signs(resolved(sizes, rows.T, simulator.body.mesh.vertices, 0.01 * sizes))
    shapes = simulator.tensor(columns.T).unflatten(1, (-1, 3))
    furthest = shapes.norm(dim=2).amax(1)
    reach = simulator.tensor(sizes) * furthest
    return (shapes / furthest[:, None, None])[reach >= 0.5 * reach[0]]


def velocity_shapes(simulator: Simulator, modes: int) -> torch.Tensor:
    """(modes, N, 3) shapes of the slowest vibrations, each with its fastest vertex at one."""
    if modes == 0:
        return simulator.rest_positions.new_zeros(0, *simulator.rest_positions.shape)
    inertial = vibration_modes(simulator, modes).mT.unflatten(1, (-1, 3))
    shapes = inertial / simulator.prepare().mass[..., None]
    return shapes / shapes.norm(dim=2).amax(1)[:, None, None]
