"""A linear model fitted to recordings, without a simulator.

Plans can use it in place of a reduced model.

It is a dynamic mode decomposition with control (Proctor, Brunton and Kutz, SIAM J. Appl. Dyn. Syst.
15 (2016) 142) of delayed marker positions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ..io.arrays import FloatArray

_RANKS = (8, 12, 18, 24, 36)  # candidates; validation chooses one
DELAYS: Final = 4  # D, frames of markers from which the state is computed
_RIDGE = 1e-8
_AHEAD = 0.3  # prediction horizon of the validation [s]


@dataclass(frozen=True)
class LinearModel:
    """s' = A s + B u, y = y_0 + C s, with a state s of delayed markers
    and inputs u in units of `scale`.
    """

    time_step: float  # h [s]
    scale: FloatArray  # (n,) of the inputs
    rest: FloatArray  # (3 M,) y_0, markers without inputs [m]
    basis: FloatArray  # (D 3 M, q) orthonormal; projects D frames of markers, latest first, to s
    a: FloatArray  # (q, q)
    b: FloatArray  # (q, n)
    c: FloatArray  # (3 M, q)
    validation_mm: float  # mean prediction error on the validation trials [mm]

    @property
    def parts(self) -> int:
        """The number n of inputs."""
        return len(self.scale)

    def state(self, markers: Sequence[FloatArray]) -> FloatArray:
        """State (q,) of the last D frames of markers (3 M,), latest first [m]."""
        return np.asarray((np.concatenate(markers) - np.tile(self.rest, len(markers))) @ self.basis)

    def respond(
        self, start: FloatArray, inputs: FloatArray, bias: FloatArray | None = None
    ) -> FloatArray:
        """Predicts the markers (T, B, 3 M) of B motions [m], as `ReducedModel.respond`.

        ``bias`` has no effect.
        """
        s, states = start, []
        for u in inputs / self.scale:
            s = s @ self.a.T + u @ self.b.T
            states.append(s)
        return np.asarray(self.rest + np.array(states) @ self.c.T)


def fit_linear(
    train: Sequence[tuple[FloatArray, FloatArray]],
    validation: Sequence[tuple[FloatArray, FloatArray]],
    scale: FloatArray,
    time_step: float,
) -> LinearModel:
    """Fits a linear model to recordings.

    Its rank is the one with the least error on the validation trials.

    Args:
        train: for each trial, markers (T + 1, 3 M) [m] that begin at rest, and inputs (T, n).
        validation: trials in the same form.
        scale: (n,) of the inputs.
        time_step: h [s].
    """
    rest = np.mean([markers[0] for markers, _ in train], axis=0)

    def delayed(markers: FloatArray) -> FloatArray:
        """D successive frames of displacements from rest (T + 2 - D, D 3 M), latest first."""
        off = markers - rest
        return np.concatenate([off[DELAYS - 1 - j : len(off) - j] for j in range(DELAYS)], axis=1)

    def pairs(
        trials: Sequence[tuple[FloatArray, FloatArray]],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        rows = [(delayed(y), u[DELAYS - 1 :] / scale) for y, u in trials]
        return (
            np.concatenate([x[:-1][: len(u)] for x, u in rows]),
            np.concatenate([x[1:][: len(u)] for x, u in rows]),
            np.concatenate([u[: len(x) - 1] for x, u in rows]),
        )

    before, after, inputs = pairs(train)
    directions = np.linalg.svd(before, full_matrices=False)[2]
    candidates = []
    for rank in [rank for rank in _RANKS if rank <= len(directions)]:
        basis = directions[:rank].T
        features = np.concatenate([before @ basis, inputs], axis=1)
        normal = features.T @ features
        normal += _RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
        a, b = np.split(np.linalg.solve(normal, features.T @ (after @ basis)).T, [rank], axis=1)
        model = LinearModel(
            time_step, scale, rest, basis, a, b, basis[: len(rest)], validation_mm=np.inf
        )
        candidates.append(replace(model, validation_mm=_prediction_error(model, validation)))
    return min(candidates, key=lambda model: model.validation_mm)


def _prediction_error(model: LinearModel, trials: Sequence[tuple[FloatArray, FloatArray]]) -> float:
    """Mean distance of predicted from observed markers over the validation's horizon [mm]."""
    steps, errors = max(round(_AHEAD / model.time_step), 1), []
    for markers, inputs in trials:
        for at in range(DELAYS - 1, len(inputs) - steps, steps):
            start = model.state([markers[at - j] for j in range(DELAYS)])
            predicted = model.respond(start, inputs[at : at + steps, None])[:, 0]
            off = (predicted - markers[at + 1 : at + 1 + steps]).reshape(steps, -1, 3)
            errors.append(np.linalg.norm(off, axis=2).mean())
    return 1e3 * float(np.mean(errors)) if errors else np.inf
