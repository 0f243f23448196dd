"""The simulation of observed trials.

A replay simulates every trial from its own start, under its own inputs, for one or several sets of physical parameters
at once, and reads what is observed off at the times of the frames. All of it is differentiable.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch

from ..data.input_response import InputResponse, response_of
from ..data.observation import Observation
from ..data.trials import Trials
from ..dynamics.simulator import Constants, Simulator
from ..io.errors import ConvergenceError
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .parameters import HUNG, MASS_FACTOR, check_known, constants_of, known_parameters

_POSE_ITERATIONS = 50
_POSE_TOLERANCE = 1e-8  # m
_POSE_MEMORY = 6  # iterations that are combined
_POSE_RIDGE = 1e-12
_POSE_PATIENCE = 20  # tries without a better one, after which a pose is given up
StepForce = Callable[[State, int], torch.Tensor]
Parameters = Mapping[str, torch.Tensor]


@dataclass(frozen=True)
class Start:
    """How trials begin."""

    state: State  # (R, N, 3) positions [m] and velocities [m/s]; a first guess where the trials begin at rest
    delay: torch.Tensor  # (R,) by which the bodies were let go later than the time zero of the frames [s]
    # (R, M, 3) from where the markers are bound to where they sit, on a body that only seemed to be held
    # undeformed [m]; None for no shift
    shift: torch.Tensor | None = None
    # whether the bodies are in equilibrium, which depends on the parameters as much as all that follows
    at_rest: bool = False

    @classmethod
    def resting(cls, guess: torch.Tensor) -> "Start":
        """In equilibrium, found from a first guess (R, N, 3) [m]."""
        return cls(State(guess, torch.zeros_like(guess)), guess.new_zeros(len(guess)), at_rest=True)

    def near(self, q: torch.Tensor) -> "Start":
        """The same with another first guess of where bodies rest [m], (R or E R, N, 3) for E sets of parameters."""
        return replace(self, state=State(q, torch.zeros_like(q)))

    def select(self, indices: list[int]) -> "Start":
        """That of some of the trials."""
        pick = torch.as_tensor(indices, device=self.delay.device)
        shift = None if self.shift is None else self.shift[pick]
        return replace(self, state=self.state.map(lambda t: t[pick]), delay=self.delay[pick], shift=shift)

    def to(self, like: torch.Tensor) -> "Start":
        """The same on the device and in the type of a tensor."""
        shift = None if self.shift is None else self.shift.to(like)
        state = self.state.map(lambda t: t.to(like))
        return replace(self, state=state, delay=self.delay.to(like), shift=shift)

    def shifted(self, markers: torch.Tensor) -> torch.Tensor:
        """(..., R, T, M, 3) markers where they sit, of those where they are bound [m]."""
        return markers if self.shift is None else markers + self.shift[:, None]

    def bound(self, markers: torch.Tensor) -> torch.Tensor:
        """(R, T, M, 3) markers where they are bound, of those where they sit [m]."""
        return markers if self.shift is None else markers - self.shift[:, None]


class Replay:
    """Simulates observed trials.

    Args:
        simulator: of the body; its material gives the constants that no parameter sets.
        observe: what sensors show of the body, M points.
        trials: what was observed.

    Attributes:
        settled: (E R, N, 3) the equilibria [m] in which the trials began when they were simulated last, if they did.
        known: the parameters that it takes: the simulator's that are one number, those of each part of an energy by
            itself, such as ``tendon_stiffness_left`` of a tendon ``left``, a factor on the weights that hang on the
            body, components of gravity's tilt, and for every input what is unknown of its commands: a factor on them,
            a delay [s] with which they come, and the rise time [s] with which it follows them, such as
            ``pressure_factor``, ``pressure_delay`` and ``pressure_rise``.
    """

    def __init__(self, simulator: Simulator, observe: Observation, trials: Trials) -> None:
        self.simulator, self.observe, self.trials = simulator, observe, trials
        self.settled: torch.Tensor | None = None
        self.known = known_parameters(simulator)

    def setting(self, parameters: Parameters | None = None) -> tuple[Constants, Inputs, Inputs]:
        """What E sets of parameters make of R trials, as (E R) environments, the trials running fastest.

        Args:
            parameters: (E,) values of any of ``known``.

        Returns:
            The constants, the inputs of the trials, and those before time zero.

        Raises:
            InputError: an unknown parameter.
        """
        parameters = {} if parameters is None else parameters
        check_known(parameters, self.known)
        sim, count = self.simulator, len(self.trials.names)
        each = len(next(iter(parameters.values()))) if parameters else 1
        spread = {name: value.repeat_interleave(count) for name, value in parameters.items()}
        constants = constants_of(sim, spread)
        inputs = self.trials.inputs.repeat(each)
        changed = self._acting(inputs, spread)
        hung = {name: each for name, each in inputs.fields.items() if name in HUNG}
        if MASS_FACTOR in spread:
            hung = {name: weight * spread[MASS_FACTOR][:, None] for name, weight in hung.items()}
        inputs = inputs.replace(**changed, **hung)
        resting = self.trials.resting.repeat(each)
        resting = resting.replace(**self._acting(resting, spread), **hung)
        return sim.prepare(constants), inputs, resting

    def _acting(self, inputs: Inputs, spread: Parameters) -> dict[str, torch.Tensor]:
        """What commanded inputs come to, of values (E R,) of their parameters."""
        found = {}
        for name, commands in inputs.actuation.items():
            if name not in HUNG:
                response = InputResponse(self.simulator.time_step, *response_of(name, spread))
                throughout = commands.ndim == 2
                found[name] = response.scaled(commands) if throughout else response.from_rest(commands)[0]
        return found

    def begin(
        self, start: Start, constants: Constants, resting: Inputs, each: int = 1, force: StepForce | None = None
    ) -> State:
        """The states (E R) from which the trials go on, for the constants and resting inputs of `setting`.

        A force acts on poses alone, which have no time in which it could: they are in equilibrium with the force of
        where they are, found by going there again and again.

        Raises:
            ConvergenceError: there is no equilibrium, or a pose and its force do not settle.
        """
        times = each * len(self.trials.names)
        q, v = (t.repeat(times // len(t), 1, 1) for t in (start.state.q, start.state.v))
        if not start.at_rest:
            return State(q, v)
        if force is None or not self.is_static:
            state = self.simulator.static_equilibrium(resting, constants, start=q)
            self.settled = state.q.detach()
            return state
        return settled(self.simulator, resting, constants, State(q, v), lambda state: force(state, 0))

    @property
    def is_static(self) -> bool:
        """Whether the trials are poses, without time."""
        return self.trials.observed.shape[1] == 1 and not bool(self.trials.times.any())

    def steps(self, start: Start) -> int:
        """Steps that reach past all frames: one more, for the slope there, where a frame is between two steps."""
        times = (self.trials.times - start.delay[:, None]).clamp_min(0.0)
        last = float(times.max()) / self.simulator.time_step
        return round(last) if _on_steps(times, self.simulator.time_step) else max(math.ceil(last - 1e-6) + 1, 2)

    def __call__(
        self, start: Start, parameters: Parameters | None = None, force: StepForce | None = None
    ) -> torch.Tensor:
        """(E, R, T, M, 3) what is observed at the times of the frames [m]; before its release a body holds still.

        Args:
            start: of the R trials.
            parameters: (E,) values of any of ``known``; one set without any, if left out.
            force: (B, N, 3) added force [N] of the state and the number of the step.

        Raises:
            ConvergenceError: see `Simulator.step`.
        """
        each = len(next(iter(parameters.values()))) if parameters else 1
        constants, inputs, resting = self.setting(parameters)
        state = self.begin(start, constants, resting, each, force)
        series = [self.observe(state.q)]
        for k in range(self.steps(start)):
            added = None if force is None else force(state, k)
            state, _ = self.simulator.step(state, inputs.at(k).plus(added), constants)
            series.append(self.observe(state.q))
        return self.at_frames(torch.stack(series, 1), start).unflatten(0, (each, -1))

    def at_frames(self, series: torch.Tensor, start: Start) -> torch.Tensor:
        """(E R, T, M, 3) observed points at the frames [m] of (E R, K + 1, M, 3) at the steps."""
        each = len(series) // len(self.trials.names)
        times = (self.trials.times - start.delay[:, None]).clamp_min(0.0).repeat(each, 1)
        found = sample(series, times, self.simulator.time_step)
        return start.shifted(found.unflatten(0, (each, -1))).flatten(0, 1)

    def errors(self, simulated: torch.Tensor) -> torch.Tensor:
        """(E, R, T, M, 3) simulated less observed points [m], zero where nothing was seen."""
        return self.observe.residual(simulated, self.trials.observed)


class _Settling:
    """Where to try next to find the fixed points of a map, of each environment by itself.

    Anderson's acceleration (J. ACM 12 (1965) 547) about the try that was led the least far: the combination of all
    tries that would be led nowhere if the map were linear, and from there a share of the way that it leads. The share
    is halved after a try that was led further than that, and doubled after others.
    """

    def __init__(self) -> None:
        self._tried = list[torch.Tensor]()  # (B, 3 N)
        self._moved = list[torch.Tensor]()  # (B, 3 N) how far the map led from there
        self._share: torch.Tensor | None = None  # (B, 1)

    def next(self, q: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) where to try, after (B, N, 3) was tried, from where the map led so far."""
        self._tried, self._moved = [*self._tried, q.flatten(1)], [*self._moved, change.flatten(1)]
        x, f = torch.stack(self._tried), torch.stack(self._moved)  # (m, B, 3 N)
        size = f.norm(dim=2)
        best = size.argmin(0)
        worse = (best < len(x) - 1)[:, None]
        share = torch.ones_like(x[0, :, :1]) if self._share is None else self._share
        self._share = torch.where(worse, 0.5 * share, (2.0 * share).clamp_max(1.0))
        rows = torch.arange(x.shape[1], device=x.device)
        at, led = x[best, rows], f[best, rows]
        if len(x) == 1:
            return (at + led).view_as(q)
        if len(x) > _POSE_MEMORY:  # The worst try of each environment has no say any more.
            kept = size.argsort(0)[:_POSE_MEMORY].sort(0).values
            x, f = (each.gather(0, kept[..., None].expand(-1, -1, each.shape[2])) for each in (x, f))
            self._tried, self._moved = list(x.unbind()), list(f.unbind())
        dx, df = ((each - base).swapaxes(0, 1) for each, base in ((x, at), (f, led)))  # (B, m, 3 N)
        gram = df @ df.mT
        trace = torch.diagonal(gram, dim1=1, dim2=2).sum(1)
        ridge = torch.where(trace > 0.0, _POSE_RIDGE * trace, 1.0)[:, None, None]
        weights = torch.linalg.solve(gram + ridge * torch.eye(gram.shape[1]).to(gram), df @ led[..., None])
        left = led - (df.mT @ weights)[..., 0]
        return (at - (dx.mT @ weights)[..., 0] + self._share * left).view_as(q)


def settled(
    simulator: Simulator,
    inputs: Inputs,
    constants: Constants,
    guess: State,
    force: Callable[[State], torch.Tensor],
) -> State:
    """The state of rest under constant inputs and a force (B, N, 3) [N] that depends on it.

    Args:
        simulator: of the body.
        inputs: what else acts on it.
        constants: see `Simulator.prepare`.
        guess: where to begin.
        force: of a state.

    Raises:
        ConvergenceError: there is no equilibrium, or the body and its force do not settle; its report says which
            environments did, (B,).
    """
    state, settling, tries = guess, _Settling(), 0
    pull: torch.Tensor | None = None
    least: torch.Tensor | None = None
    for number in range(_POSE_ITERATIONS):
        before, pull = pull, force(state)
        if before is not None and torch.equal(pull, before):  # It is of the inputs alone.
            return state
        found = simulator.static_equilibrium(inputs.plus(pull), constants, start=state.q.detach())
        change = found.q - state.q
        size = change.detach().abs().amax((1, 2))
        done = size < _POSE_TOLERANCE
        if bool(done.all()):
            return found
        better = least is None or bool(((size < least) & ~done).any())
        least = size if least is None else torch.minimum(size, least)
        tries = 0 if better else tries + 1
        if tries == _POSE_PATIENCE or number == _POSE_ITERATIONS - 1:
            break
        state = State(torch.where(done[:, None, None], found.q, settling.next(state.q, change)), state.v)
    assert least is not None
    raise ConvergenceError(
        "a pose and the force that depends on it did not settle: the force is too large to be a correction.",
        found.q,
        least < _POSE_TOLERANCE,
    )


def _on_steps(times: torch.Tensor, step: float) -> bool:
    """Whether all times are those of steps."""
    position = times.detach() / step
    return bool(((position - position.round()).abs() < 1e-6).all())


def sample(series: torch.Tensor, times: torch.Tensor, step: float) -> torch.Tensor:
    """(B, T, ...) values at given times, by cubic Hermite interpolation with central differences as slopes.

    Args:
        series: (B, K + 1, ...) values at the times 0, h, ..., K h, with K at least 2 if a time is between them.
        times: (B, T) [s], from zero; beyond the end the last value stays.
        step: h [s].
    """
    last = series.shape[1] - 1
    position = (times / step).clamp(0.0, float(last))
    batch = torch.arange(len(series), device=series.device)[:, None]
    if not times.requires_grad and _on_steps(times, step):
        return series[batch, position.round().long()]
    slopes = torch.gradient(series, dim=1, edge_order=2)[0]
    index = position.floor().long().clamp(max=last - 1)
    s = (position - index).reshape(*times.shape, *[1] * (series.ndim - 2))
    a, b, da, db = series[batch, index], series[batch, index + 1], slopes[batch, index], slopes[batch, index + 1]
    return (
        (1.0 + 2.0 * s) * (1.0 - s) ** 2 * a
        + s * (1.0 - s) ** 2 * da
        + s**2 * (3.0 - 2.0 * s) * b
        + s**2 * (s - 1.0) * db
    )
