"""Initial conditions of a motion that starts by releasing a held body, or at rest by its inputs.

Before the release, the body is at rest under gravity, its weights and a virtual force that brings
its markers to their held positions (the published method finds such forces by time steps; here it
is one static equilibrium). The release happens between two frames, and the body may have been bent
sideways: the delay and a sideways displacement are estimated from the first frames.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from typing_extensions import override

from ..core.dynamics.modes import align_degenerate_modes, fix_signs, vibration_modes
from ..core.dynamics.simulator import Simulator
from ..core.linalg.least_squares import Move, Point, Problem, damped, minimise
from ..core.stepping.inputs import Inputs
from ..core.stepping.state import State
from ..io.errors import ConvergenceError
from ..settings.learning import ReleaseSettings
from .replay import Parameters, Replay
from .start import Start

_HOLD_ITERATIONS = 100
_HOLD_TOLERANCE = 1e-7  # m, change of any position in the last iteration
# Of the body's extent: size of the displacement from which its bending shapes are computed.
_SIDEWAYS_STRAIN = 1e-3
# Largest delay of inputs, in expected deviations, and number of delays.
_FURTHEST, _TRIED = 3.0, 121
_DELAYS = (-2.0, -1.0, 0.0, 1.0, 2.0)  # starts of the search, in expected deviations
_HOLD_WEIGHT = 1e-6  # w, in units of the largest diagonal entry of the first J^T J
_ITERATIONS = 4  # of Levenberg-Marquardt, at most
# In expected deviations.
_RELEASE_TOLERANCE = 1e-4
_DIFFERENCE = 0.05
_LONGEST_STEP = 3.0


def estimate_release(
    replay: Replay, settings: ReleaseSettings, parameters: Parameters | None = None
) -> Start:
    """Returns the start of every motion that begins by a release.

    The body is at rest in frames before the release and moves in those after it, so that the error
    of the first frames has a kink where the delay equals the time of a frame, and minima in
    between: the search starts at several delays.

    Args:
        replay: of the trials.
        settings: see the class.
        parameters: (1,) values that replace the simulator's, by name.

    Raises:
        ConvergenceError: the body cannot be held, or a step of the simulation fails.
    """
    problem = _FirstFrames(
        replay, hold(replay, settings.hold_modes, parameters), settings, parameters
    )
    count, unknowns = len(replay.trials.names), len(problem.deviation)
    start = problem.deviation.new_zeros(count, unknowns)
    if not unknowns:
        return problem.release(start)
    delays = start.new_tensor(_DELAYS if settings.delay > 0.0 else (0.0,))
    start = delays.repeat_interleave(count)[:, None] * torch.eye(unknowns).to(delays)[0]
    solution = minimise(problem, problem.evaluate(start), _RELEASE_TOLERANCE, _ITERATIONS).point
    best = solution.value.view(-1, count).argmin(0)
    return problem.release(
        solution.x.view(-1, count, unknowns)[best, torch.arange(count, device=best.device)]
    )


def begin_inputs(
    replay: Replay, start: Start, settings: ReleaseSettings, parameters: Parameters | None = None
) -> Start:
    """Returns the start of trials that begin at rest,
    with the delay of each trial's inputs after their recorded time.

    The clock of the inputs and that of the markers may differ, frames may be lost, and a valve
    opens when it likes. A delay shifts the whole motion, so one simulation gives the error of any
    delay in the first frames.

    Args:
        replay: of the trials.
        start: from rest; its delay is replaced.
        settings: the expected delay, the duration of the first frames and their noise; without a
            delay, the start is returned as it is.
        parameters: (1,) values that replace the simulator's, by name.

    Raises:
        ConvergenceError: a step of the simulation fails.
    """
    if settings.delay == 0.0:
        return start
    first = replay.changed(trials=replay.trials.first(settings.window))
    furthest = torch.full_like(start.delay, -_FURTHEST * settings.delay)
    with torch.no_grad():
        series = first.series(replace(start, delay=furthest), parameters)

        def errors(delay: torch.Tensor) -> torch.Tensor:
            return first.errors(
                first.at_frames(series, replace(start, delay=delay.expand_as(start.delay)))[None]
            )[0]

        return replace(start, delay=least_delays(errors, settings, start.delay))


def least_delays(
    errors: Callable[[torch.Tensor], torch.Tensor], settings: ReleaseSettings, like: torch.Tensor
) -> torch.Tensor:
    """Delays (R,) of inputs with the least squared error of the first frames
    over their noise, and of the prior [s].

    Args:
        errors: of a motion delayed by a number [s], (R, T, M, 3) in the first frames [m].
        settings: the expected delay and the noise.
        like: a tensor with the device and type of the result.
    """
    delays = settings.delay * torch.linspace(-_FURTHEST, _FURTHEST, _TRIED).to(like)
    squares = [(errors(delay) / settings.noise).square().flatten(1).sum(1) for delay in delays]
    costs = [
        square + (delay / settings.delay).square()
        for square, delay in zip(squares, delays, strict=True)
    ]
    return delays[torch.stack(costs).argmin(0)]


def hold(replay: Replay, modes: int, parameters: Parameters | None = None) -> torch.Tensor:
    """Positions (R, N, 3) at rest under gravity, weights and the virtual force
    that fits the held markers best [m].

    Args:
        replay: of the trials, with their held markers.
        modes: number of columns of B (see `_HoldProblem`), the inertial forces of the slowest
            vibrations.
        parameters: (1,) values that replace the simulator's, by name.

    Raises:
        ConvergenceError: no equilibrium was found.
    """
    problem = _HoldProblem(replay, modes, parameters)
    return minimise(problem, problem.straight, _HOLD_TOLERANCE, _HOLD_ITERATIONS).point.kept[0]


class _HoldProblem(Problem):
    """|m(q(a)) - y|^2 + w |a|^2 over a (R, modes), with q(a) the equilibrium under the force B a.

    The weight w is so small that it only determines what the markers do not. A point keeps the
    positions (R, N, 3), the residual of the held markers (R, 3 M), and its derivative
    (R, 3 M, modes) [m].
    """

    def __init__(self, replay: Replay, modes: int, parameters: Parameters | None) -> None:
        with torch.no_grad():
            self._constants, _, self._resting = replay.prepare(parameters)
        self._replay, self._basis = replay, vibration_modes(replay.simulator, modes)
        count = len(replay.trials.names)
        self._near, none = replay.simulator.rest_state(count).q, self._basis.new_zeros(count, modes)
        kept = self._equilibrium(none)
        self.straight = Point(none, kept[1].square().sum(1), kept)
        self._weight = _HOLD_WEIGHT * kept[2].square().sum(1).amax(1)[:, None]

    def _equilibrium(self, a: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Returns the values that a point keeps."""
        target = self._replay.trials.held
        with torch.enable_grad():
            a = a.detach().requires_grad_()
            acting = self._resting.plus((a @ self._basis.mT).unflatten(1, (-1, 3)))
            q = self._replay.simulator.static_equilibrium(
                acting, self._constants, start=self._near
            ).q
            residual = torch.where(
                torch.isfinite(target), target - self._replay.observe(q), 0.0
            ).flatten(1)
            rows = [
                torch.autograd.grad(entry.sum(), a, retain_graph=True)[0]
                for entry in residual.unbind(1)
            ]
        return q.detach(), residual.detach(), torch.stack(rows, 1)

    @override
    def evaluate(self, x: torch.Tensor) -> Point:
        try:
            kept = self._equilibrium(x)
        except ConvergenceError:
            return Point(x, torch.full_like(x[:, 0], torch.inf), self.straight.kept)
        return Point(x, kept[1].square().sum(1) + (self._weight * x.square()).sum(1), kept)

    @override
    def linearise(self, point: Point) -> Move:
        self._near, residual, slope = point.kept
        matrix = slope.mT @ slope + torch.diag_embed(self._weight.expand_as(point.x))
        right = -(slope.mT @ residual[..., None])[..., 0] - self._weight * point.x
        return lambda damping: point.x + torch.linalg.solve(damped(matrix, damping), right)

    @override
    def distance(self, old: Point, new: Point) -> torch.Tensor:
        return (new.kept[0] - old.kept[0]).abs().amax((1, 2))


class _FirstFrames(Problem):
    """Squared error of the first frames over their noise,
    as a function of releases in expected deviations.

    The unknowns are the delay, if one is expected, and the sideways displacements. A point keeps
    J^T J + 1 and the gradient, with J from finite differences in one batch.

    Args:
        replay: of the R trials.
        held: (R, N, 3) positions in which the body is held, if it is straight [m].
        settings: which unknowns there are, their expected deviations, and the noise.
        parameters: (1,) values that replace the simulator's.
    """

    def __init__(
        self,
        replay: Replay,
        held: torch.Tensor,
        settings: ReleaseSettings,
        parameters: Parameters | None,
    ) -> None:
        self._replay = replay
        self._observe = replay.observe
        self._trials = replay.trials
        self._held = held
        self._settings = settings
        self._parameters = parameters
        none = held.new_zeros(0, *held[0].shape)
        self._shapes = sideways_shapes(replay.simulator) if settings.sideways > 0.0 else none
        self._sizes = (int(settings.delay > 0.0), len(self._shapes))
        deviations, self._copies = (settings.delay, settings.sideways), dict[int, Replay]()
        self.deviation = held.new_tensor(np.repeat(deviations, self._sizes))

    def release(self, values: torch.Tensor) -> Start:
        """Returns the releases for values (k R, unknowns); the R motions run fastest."""
        delay, bends = (values * self.deviation).split(self._sizes, 1)
        held = self._held.repeat(len(values) // len(self._held), 1, 1)
        bend = torch.einsum("bk,knc->bnc", bends, self._shapes)
        shift = self._observe(held) - self._observe(held + bend) if len(self._shapes) else None
        return Start(State(held + bend, torch.zeros_like(held)), delay.sum(1), shift)

    @override
    def evaluate(self, x: torch.Tensor) -> Point:
        (runs, unknowns), count = x.shape, len(self._held)
        if runs not in self._copies:
            first = self._trials.first(self._settings.window).select(
                [*range(count)] * (runs // count * (1 + unknowns))
            )
            self._copies[runs] = self._replay.changed(trials=first)
        identity = torch.eye(unknowns, dtype=x.dtype, device=x.device)
        offsets = torch.cat(
            [torch.zeros_like(identity[:1]), _DIFFERENCE * identity]
        ).repeat_interleave(runs, 0)
        replay = self._copies[runs]
        simulated = replay(self.release(x.repeat(1 + unknowns, 1) + offsets), self._parameters)
        residual = (
            replay.errors(simulated)[0].flatten(1).unflatten(0, (-1, runs)) / self._settings.noise
        )
        slope = ((residual[1:] - residual[0]) / _DIFFERENCE).permute(1, 2, 0)
        gradient = (slope.mT @ residual[0][..., None])[..., 0] + x
        return Point(
            x,
            residual[0].square().sum(1) + x.square().sum(1),
            (slope.mT @ slope + identity, gradient),
        )

    @override
    def linearise(self, point: Point) -> Move:
        matrix, gradient = point.kept

        def step(damping: torch.Tensor) -> torch.Tensor:
            change = torch.linalg.solve(damped(matrix, damping), -gradient)
            return point.x + change * (
                _LONGEST_STEP / change.abs().amax(1, keepdim=True)
            ).clamp_max(1.0)

        return step

    @override
    def distance(self, old: Point, new: Point) -> torch.Tensor:
        return (new.x - old.x).abs().amax(1)


def sideways_shapes(simulator: Simulator) -> torch.Tensor:
    """Displacements (1 or 2, N, 3) from rest by accelerations perpendicular to gravity,
    scaled to a maximum of one.

    The stiffer of the two directions is left out if it bends the body less than half as far, as its
    displacement may be along gravity. Weights that hang on the body are ignored.
    """
    directions = torch.linalg.svd(simulator.tensor(simulator.gravity)[None])[2][1:]
    extent = float((simulator.rest_positions.amax(0) - simulator.rest_positions.amin(0)).max())
    size = 0.1  # m/s^2
    with torch.no_grad():
        weightless = simulator.prepare({"gravity": torch.zeros_like(directions)})
        mass = weightless.mass - simulator.tensor(simulator.body.attached_mass)
        # Scale to a displacement in the linear range, far above rounding, for any stiffness.
        for _ in range(3):
            load = size * mass[..., None] * directions[:, None]
            bent = (
                simulator.static_equilibrium(Inputs(load), weightless).q - simulator.rest_positions
            )
            size *= _SIDEWAYS_STRAIN * extent / float(bent.norm(dim=2).max())
    # From the softest direction to the stiffest; a relative difference below 0.01 is within the
    # solver's tolerance.
    _, sizes, rows = np.linalg.svd(bent.flatten(1).double().cpu().numpy(), full_matrices=False)
    columns = fix_signs(
        align_degenerate_modes(sizes, rows.T, simulator.body.mesh.vertices, 0.01 * sizes)
    )
    shapes = simulator.tensor(columns.T).unflatten(1, (-1, 3))
    furthest = shapes.norm(dim=2).amax(1)
    reach = simulator.tensor(sizes) * furthest
    return (shapes / furthest[:, None, None])[reach >= 0.5 * reach[0]]
