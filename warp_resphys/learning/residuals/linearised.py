"""Observed motions as a linear function of changes of their inputs,
by which the networks of an actuator are fitted.
"""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final

import torch
from torch.nn.functional import pad

from ...core.stepping.inputs import Inputs
from ...core.stepping.rollout import sample
from ...data.input_network import Actuator
from ...data.input_response import InputResponse
from ..replay import Replay
from ..start import Start

_CHANGE: Final = 1e-5  # of the largest input, by which the derivatives are computed
_ITERATIONS: Final = 200  # of L-BFGS on linearised motions
_PENALTIES: Final = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
_FOLDS: Final = 3
_MEMORY: Final = 2.0  # s: length of the kernel with which points follow inputs
_CORRELATED: Final = 0.2  # s: of the random changes to which it is fitted
_RIDGE: Final = 1e-3  # of the mean diagonal, added in its fit
_ALL: Final = slice(None)


@dataclass(frozen=True)
class Linearised:
    """Simulated points (R, T, M, D) of trials as a linear function of changes of their inputs.

    A change u of the inputs moves the points by J (k * u): J are the derivatives by lasting
    changes, and the kernel k has the vibrations with which the body follows. It is fitted to
    derivatives along random changes.
    """

    replay: Replay
    times: torch.Tensor  # (R, T) of the frames since the start [s]
    points: torch.Tensor  # (R, T, M, D), under the inputs with the actuator
    slopes: dict[str, torch.Tensor]  # (R, T, M, D, C) by the inputs
    kernel: torch.Tensor  # (L,) of the changes in the steps before a state, the last one first
    felt: dict[str, torch.Tensor]  # what networks take, (R, K + 1, C (1 + F)), first before it
    acting: dict[str, torch.Tensor]  # inputs with the actuator, (R, K + 1, C)

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        replay: Replay,
        start: Start,
        parameters: Mapping[str, torch.Tensor],
        model: Actuator,
        felt: Mapping[str, torch.Tensor],
    ) -> "Linearised":
        """Simulates trials, with derivatives by lasting changes of inputs and along random ones."""
        replay = replay.changed(actuator=model.inputs)
        states, prepared = replay.states(start, parameters), replay.prepare(parameters)
        sizes = {name: _CHANGE * network.unit for name, network in model.inputs.items()}
        columns = [*chain.from_iterable([name] * model.inputs[name].parts for name in sizes)]
        # The derivatives by lasting changes have no transients then.
        settles = start.at_rest and not replay.is_static
        random = _random_changes(prepared[1], sizes, replay.simulator.time_step) if settles else {}
        sets = len(columns) + bool(random)
        repeated = {name: x.repeat(sets) for name, x in parameters.items()}
        unit = {f"{columns[0]}_factor": replay.trials.times.new_ones(sets)}
        constants, *fields = replay.prepare(repeated or unit)
        during, before = (_changed(inputs, sizes, columns, sets) for inputs in fields)
        for name, changes in random.items():
            during.actuation[name][:, -changes.shape[1] :] += changes
        series, _ = replay.varied_points(start, prepared, (constants, during, before), sets, states)
        first, *rest = replay.at_frames(series, start).unflatten(0, (1 + sets, -1))
        times = (replay.trials.times - start.delay[:, None]).clamp_min(0.0)
        slopes: dict[str, list[torch.Tensor]] = {name: [] for name in sizes}
        for name, moved in zip(columns, rest, strict=False):
            slopes[name].append((moved - first) / sizes[name])
        shown = {name: felt[name][: series.shape[1]].swapaxes(0, 1) for name in sizes}
        stacked = {name: torch.stack(x, -1) for name, x in slopes.items()}
        made = cls(replay, times, first, stacked, first.new_ones(1), shown, {})
        made = replace(
            made,
            acting={
                name: made._acting(name, network, shown[name])
                for name, network in model.inputs.items()
            },
        )
        return (
            replace(made, kernel=made._fitted_kernel(random, rest[-1] - first)) if random else made
        )

    def _fitted_kernel(
        self, changes: Mapping[str, torch.Tensor], moved: torch.Tensor
    ) -> torch.Tensor:
        """Kernel (L,) with which changes (K, R, C) in the steps move the points by (R, T, M, D)."""
        steps, seen = next(iter(self.felt.values())).shape[1], self.replay.trials.seen
        length = min(steps, math.ceil(_MEMORY / self.replay.simulator.time_step))
        series = {
            name: pad(x, (0, 0, 0, 0, 1, 0))[:steps].swapaxes(0, 1) for name, x in changes.items()
        }
        delayed = [
            replace(self, kernel=one)._moved(series)[seen].flatten()
            for one in torch.eye(length).to(moved)
        ]
        columns = torch.stack(delayed, 1)
        normal = columns.T @ columns
        normal.diagonal().add_(_RIDGE * normal.diagonal().mean())
        kernel = torch.linalg.solve(normal, columns.T @ moved[seen].flatten())
        return kernel / kernel.sum()

    def followed(self, changes: torch.Tensor, trials: slice = _ALL) -> torch.Tensor:
        """Changes (R, K + 1, ...), the first before the start,
        as trials follow them at their frames, (R, T, ...).
        """
        length, count = len(self.kernel), changes.shape[1]
        padded = torch.cat([changes[:, :1].expand(-1, length - 1, *changes.shape[2:]), changes], 1)
        series = self.kernel[0] * padded[:, length - 1 :]
        for lag in range(1, length):
            series = (
                series + self.kernel[lag] * padded[:, length - 1 - lag : length - 1 - lag + count]
            )
        return sample(series, self.times[trials], self.replay.simulator.time_step)

    def _acting(
        self, name: str, network: Callable[[torch.Tensor], torch.Tensor], felt: torch.Tensor
    ) -> torch.Tensor:
        """Inputs (..., C) with what a network adds for (..., C (1 + F)), within their range."""
        known = felt[..., : self.slopes[name].shape[-1]]
        return (known + network(felt)).clamp_min(self.replay.simulator.inputs[name].lower)

    def _moved(self, changes: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """(R, T, M, D) by which changes (R, K + 1, C) of the inputs move the points."""
        moved = [
            self.slopes[name] @ self.followed(x)[:, :, None, :, None] for name, x in changes.items()
        ]
        return torch.stack(moved).sum(0)[..., 0]

    def changes(self, model: Actuator) -> dict[str, torch.Tensor]:
        """Changes (R, K + 1, C) of the inputs by an actuator."""
        acting = {
            name: self._acting(name, network, self.felt[name])
            for name, network in model.inputs.items()
        }
        return {name: x - self.acting[name] for name, x in acting.items()}

    def errors(self, changes: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Points under changes (R, K + 1, C) of inputs less the observed ones, (R, T, M, D) [m]."""
        return self.replay.errors((self.points + self._moved(changes))[None])[0]


def _random_changes(
    inputs: Inputs, sizes: Mapping[str, float], time_step: float
) -> dict[str, torch.Tensor]:
    """Changes (K, R, C) of inputs that change over time: lagged noise, not negative."""
    generator, changes = torch.Generator().manual_seed(0), dict[str, torch.Tensor]()
    response = InputResponse(time_step, rise=_CORRELATED)
    for name, size in sizes.items():
        values = inputs.actuation[name]
        if values.ndim == 3:
            noise = size * torch.rand(values.shape, generator=generator, dtype=torch.float64).to(
                values
            )
            changes[name] = response(response.steady(noise[0]), noise)[0]
    return changes


def _changed(
    inputs: Inputs, sizes: Mapping[str, float], columns: Sequence[str], sets: int
) -> Inputs:
    """Inputs of E R environments, in whose first C sets of R each of C parts is changed in turn."""
    for name in sizes.keys() & inputs.actuation.keys():
        values = inputs.actuation[name]
        rows = [row for row, column in enumerate(columns) if column == name]
        change = values.new_zeros(sets, len(rows))
        change[rows] = sizes[name] * torch.eye(len(rows)).to(values)
        inputs = inputs.replace(
            **{name: values + change.repeat_interleave(values.shape[-2] // sets, 0)}
        )
    return inputs


def chosen_penalty(
    linearised: Sequence[Linearised], loss_weights: Sequence[torch.Tensor], model: Actuator
) -> float:
    """Returns the penalty with the smallest loss of trials that are left out in turn,
    a third of them at a time.

    Penalties are tried from the largest on, until the loss grows. The model is left as it is. A
    single trial has the largest.

    Args:
        linearised: groups of trials.
        loss_weights: (R,) of the squared errors of each group's trials.
        model: to fit.
    """
    begin = copy.deepcopy(model.state_dict())
    best = _PENALTIES[0]
    least = math.inf
    trials = torch.cat([torch.full_like(weights, 1.0) for weights in loss_weights]).cumsum(0) - 1.0
    folds = [trials % _FOLDS == number for number in range(min(_FOLDS, len(trials)))]
    fitted = [begin for _ in folds]
    for penalty in _PENALTIES if len(folds) > 1 else ():
        loss = 0.0
        for number, fold in enumerate(folds):
            left_out = fold.split([len(weights) for weights in loss_weights])
            rest = [weights * ~out for weights, out in zip(loss_weights, left_out, strict=True)]
            model.load_state_dict(fitted[number])
            fit_linearised(linearised, rest, model, penalty, 0.0)
            fitted[number] = copy.deepcopy(model.state_dict())
            with torch.no_grad():
                for one, weights, out in zip(linearised, loss_weights, left_out, strict=True):
                    squares = one.errors(one.changes(model)).square().sum((1, 2, 3))
                    loss += float((squares * weights * out).sum())
        if not loss < least:
            break
        best, least = penalty, loss
    model.load_state_dict(begin)
    return best


def fit_linearised(
    linearised: Sequence[Linearised],
    loss_weights: Sequence[torch.Tensor],
    model: Actuator,
    penalty: float,
    trust: float,
) -> None:
    """Minimises the squared errors of linearised motions,
    with weights (R,) of their trials, and two penalties.

    One is on the squared weights; trust is on the mean square change of the inputs, as shares of
    the largest one, because motions are linear near their inputs alone.
    """
    weights = [*model.parameters()]
    lbfgs = torch.optim.LBFGS(
        weights, max_iter=_ITERATIONS, history_size=20, line_search_fn="strong_wolfe"
    )

    def evaluate() -> float:
        lbfgs.zero_grad()
        squares = [penalty * torch.stack([weight.square().sum() for weight in weights]).sum()]
        for one, weight in zip(linearised, loss_weights, strict=True):
            changes = one.changes(model)
            errors = one.errors(changes).square().sum((1, 2, 3))
            shares = [x / model.inputs[name].unit for name, x in changes.items()]
            squares += [
                (errors * weight).sum(),
                trust / len(linearised) * torch.cat(shares, -1).square().mean(),
            ]
        total = torch.stack(squares).sum()
        total.backward()
        return float(total.detach())

    lbfgs.step(evaluate)
