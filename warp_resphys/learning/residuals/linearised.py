"""Observed motions as a linear function of changes of their inputs, by which the networks of an actuator are fitted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import torch
from torch.func import functional_call

from ...data.input_network import Actuator
from ...stepping.inputs import Inputs
from ...stepping.rollout import sample
from ..replay import Replay, Start
from .training import with_prefix

_CHANGE: Final = 1e-5  # of the largest input, by which the derivatives are computed
_ITERATIONS: Final = 200  # of L-BFGS on linearised motions
_LEAST_SHARE: Final = 1e-9  # of the mean diagonal of the Gauss-Newton matrix, added to be positive definite
_LEAST_UNIT: Final = 1e-30
_FRAMES_AT_ONCE: Final = 256  # whose derivatives by all weights are computed together


@dataclass(frozen=True)
class Linearised:
    """Simulated points (R, T, M, D) of trials as a linear function of changes of their inputs."""

    replay: Replay
    points: torch.Tensor  # (R, T, M, D), under the inputs with the actuator
    slopes: dict[str, torch.Tensor]  # (R, T, M, D, C) by the inputs
    felt: dict[str, torch.Tensor]  # what the networks take, (R, T, C (1 + F))
    added: dict[str, torch.Tensor]  # by the actuator, (R, T, C)

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
        """Simulates trials, with the derivatives by lasting changes of the inputs."""
        replay = replay.changed(actuator=model.inputs)
        states, prepared = replay.states(start, parameters), replay.prepare(parameters)
        sizes = {name: _CHANGE * network.unit for name, network in model.inputs.items()}
        columns = [name for name in sizes for _ in range(model.inputs[name].parts)]
        repeated = {name: x.repeat(len(columns)) for name, x in parameters.items()}
        constants, *fields = replay.prepare(
            repeated or {f"{columns[0]}_factor": replay.trials.times.new_ones(len(columns))}
        )
        during, before = (_changed(inputs, sizes, columns) for inputs in fields)
        series = replay.varied_points(start, prepared, (constants, during, before), len(columns), states)
        first, *rest = replay.at_frames(series, start).unflatten(0, (1 + len(columns), -1))
        times = (replay.trials.times - start.delay[:, None]).clamp_min(0.0)
        slopes: dict[str, list[torch.Tensor]] = {name: [] for name in sizes}
        for name, moved in zip(columns, rest, strict=True):
            slopes[name].append((moved - first) / sizes[name])
        step, count = replay.simulator.time_step, series.shape[1]
        shown = {name: sample(felt[name][:count].swapaxes(0, 1), times, step) for name in sizes}
        added = {name: model.inputs[name](x) for name, x in shown.items()}
        return cls(replay, first, {name: torch.stack(x, -1) for name, x in slopes.items()}, shown, added)

    def errors(self, model: Actuator) -> torch.Tensor:
        """Points with an actuator less the observed ones (1, R, T, M, D)."""
        moved = self.points
        for name, slope in self.slopes.items():
            change = model.inputs[name](self.felt[name]) - self.added[name]
            moved = moved + (slope @ change[:, :, None, :, None])[..., 0]
        return self.replay.errors(moved[None])


def _changed(inputs: Inputs, sizes: Mapping[str, float], columns: Sequence[str]) -> Inputs:
    """Inputs of C R environments, in which each of C parts is changed in turn; its input is named in the columns."""
    for name in sizes.keys() & inputs.actuation.keys():
        values = inputs.actuation[name]
        rows = [row for row, column in enumerate(columns) if column == name]
        change = values.new_zeros(len(columns), len(rows))
        change[rows] = sizes[name] * torch.eye(len(rows)).to(values)
        inputs = inputs.replace(**{name: values + change.repeat_interleave(values.shape[-2] // len(columns), 0)})
    return inputs


def fit_linearised(
    linearised: Sequence[Linearised], loss_weights: Sequence[torch.Tensor], model: Actuator, penalty: float
) -> None:
    """Minimises the squared errors of linearised motions, with weights (R,) of their trials, and the penalty."""
    weights = [*model.parameters()]
    lbfgs = torch.optim.LBFGS(weights, max_iter=_ITERATIONS, history_size=20, line_search_fn="strong_wolfe")

    def evaluate() -> float:
        lbfgs.zero_grad()
        pairs = zip(linearised, loss_weights, strict=True)
        squares = [(one.errors(model)[0].square().sum((1, 2, 3)) * weight).sum() for one, weight in pairs]
        loss = torch.stack(squares).sum() + penalty * squares_of(model)
        loss.backward()
        return float(loss.detach())

    lbfgs.step(evaluate)


def gauss_newton_factor(
    linearised: Sequence[Linearised], loss_weights: Sequence[torch.Tensor], model: Actuator, penalty: float, unit: float
) -> torch.Tensor | None:
    """Returns the Cholesky factor C (P, P) of the Gauss-Newton matrix of the loss of linearised motions by P weights w.

    C C^T = 2 (sum_k N_k^T J_k^T J_k N_k + penalty) / unit, with the derivatives N_k of the networks by w in a frame and
    J_k of its points by the inputs, the latter weighted as in the loss. None where the matrix is not positive definite,
    as with derivatives that are not finite.
    """
    weights = {name: weight.detach() for name, weight in model.named_parameters()}

    def added(weights: dict[str, torch.Tensor], felt: dict[str, torch.Tensor]) -> torch.Tensor:
        """(C,) what the networks add to their inputs in a frame."""
        networks = [(model.inputs[name], with_prefix(weights, f"network.{name}."), x) for name, x in felt.items()]
        return torch.cat([functional_call(*call) for call in networks])

    by_weights = torch.func.vmap(torch.func.jacrev(added), (None, 0))
    matrix = torch.zeros(2 * [sum(weight.numel() for weight in weights.values())]).to(next(iter(weights.values())))
    for one, weight in zip(linearised, loss_weights, strict=True):
        slopes = torch.cat([one.slopes[name] for name in one.felt], -1)  # (R, T, M, D, C)
        counted = (weight[:, None, None] * one.replay.trials.seen)[..., None, None]
        by_inputs = (slopes.flatten(2, 3).mT @ (counted * slopes).flatten(2, 3)).flatten(0, 1).to(matrix)  # (R T, C, C)
        for frames in torch.arange(len(by_inputs), device=matrix.device).split(_FRAMES_AT_ONCE):
            some = {name: x.flatten(0, 1)[frames] for name, x in one.felt.items()}
            rows = torch.cat([x.flatten(2) for x in by_weights(weights, some).values()], -1)  # (K, C, P)
            matrix += rows.flatten(0, 1).T @ (by_inputs[frames] @ rows).flatten(0, 1)
    matrix.diagonal().add_(penalty + _LEAST_SHARE * float(matrix.diagonal().mean()))
    factor, failed = torch.linalg.cholesky_ex(2.0 / max(unit, _LEAST_UNIT) * matrix)
    return None if bool(failed) else factor


def squares_of(model: Actuator) -> torch.Tensor:
    """Sum of the squared weights."""
    return torch.stack([weight.square().sum() for weight in model.parameters()]).sum()
