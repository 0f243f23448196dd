"""Training of a network of a material's energy (`energies.neural`) through the simulator.

The loss is that of an identification (`learning.misfit`): the mean square distance from the observed points, over the
squared amplitude of every motion. L-BFGS minimises it, with gradients through all steps, and the weights are those of
the iteration with the least error on validation trials.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy.optimize
import torch
from numpy.typing import NDArray

from ..io.errors import ConvergenceError
from .replay import Replay, Start

FloatArray = NDArray[np.float64]

_FAILED: Final = 1e6  # loss where a simulation fails
_PAIRS: Final = 20  # that L-BFGS keeps
_PENALTY: Final = 1e-6  # of the mean square change of the weights, over the first loss


@dataclass(frozen=True)
class Trained:
    """A trained network."""

    weights: torch.Tensor  # (W,)
    constants: dict[str, float]  # the constants that were trained with it
    loss: float
    history: list[dict[str, float]]  # ``loss`` and ``validation`` of the iterations


def train_weights(
    replays: Sequence[tuple[Replay, Start]],
    weights: torch.Tensor,
    constants: Mapping[str, float],
    fixed: Mapping[str, torch.Tensor],
    score: Callable[[torch.Tensor, Mapping[str, float]], float],
    max_evaluations: int,
    report: Callable[[float], None],
    reached: Sequence[float] | None = None,
    keep: Callable[[list[float]], None] | None = None,
) -> Trained:
    """Returns the weights and constants with the least validation error on the path of L-BFGS.

    Args:
        replays: of the training trials, with their starts, and a simulator of a `NeuralMaterial`.
        weights: (W,) first guess.
        constants: positive constants of the material that are trained as well, with their first guess.
        fixed: (1,) values of other parameters.
        score: validation error of weights and constants.
        max_evaluations: of the loss and its gradient.
        report: called with the loss after every evaluation.
        reached: where an interrupted call had come to, as it passed it to `keep`.
        keep: called after every iteration with what a further call can start from.
    """
    count = sum(len(replay.trials.names) for replay, _ in replays)
    like, size, history = replays[0][0].simulator.rest_positions, len(weights), list[dict[str, float]]()
    first = np.concatenate([weights.numpy(), np.zeros(len(constants))])
    best, scale = (np.inf, first, np.inf), 0.0

    def split(x: torch.Tensor) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        factors = x[size:].exp()
        return x[:size], {name: value * factors[k] for k, (name, value) in enumerate(constants.items())}

    def loss_of(x: torch.Tensor) -> torch.Tensor:
        own, others = split(x)
        values = {**fixed, "weights": own[None], **{name: value[None] for name, value in others.items()}}
        total = x.new_zeros(())
        for replay, start in replays:
            squares = replay.errors(replay(start, values)).square().sum((0, 2, 3, 4))
            total = total + (squares * replay.trials.loss_weight).sum() * (len(replay.trials.names) / count)
        return total

    def objective(at: FloatArray) -> tuple[float, FloatArray]:
        nonlocal scale
        x = torch.tensor(at).to(like).requires_grad_()
        try:
            loss = loss_of(x)
            (slope,) = torch.autograd.grad(loss, x)
        except ConvergenceError:
            report(np.inf)
            return _FAILED, np.zeros_like(at)
        report(float(loss.detach()))
        scale = scale or float(loss.detach()) or 1.0
        penalty, change = _PENALTY / len(at), at - first
        gradient = slope.cpu().numpy() / scale + 2.0 * penalty * change
        return float(loss.detach()) / scale + penalty * float(change @ change), gradient

    def test(at: FloatArray) -> None:
        nonlocal best
        own, others = split(torch.tensor(at))
        error = score(own, {name: float(value) for name, value in others.items()})
        loss = float(loss_of(torch.tensor(at).to(like)).detach())
        history.append({"loss": loss, "validation": error})
        if error < best[0]:
            best = (error, at.copy(), loss)

    def iterated(at: FloatArray) -> None:
        with torch.no_grad():
            test(at)
        if keep is not None:
            keep(at.tolist())

    start = first if reached is None else np.array(reached)
    with torch.no_grad():
        test(start)
    scipy.optimize.minimize(
        objective,
        start,
        jac=True,
        method="L-BFGS-B",
        callback=iterated,
        options={"maxfun": max_evaluations, "maxiter": max_evaluations, "maxcor": _PAIRS},
    )
    own, others = split(torch.tensor(best[1]))
    return Trained(own, {name: float(value) for name, value in others.items()}, best[2], history)
