"""A linear model of the recordings, without a simulator, that plans are made with as with the reduced model.

It is a dynamic mode decomposition with control (Proctor, Brunton and Kutz, SIAM J. Appl. Dyn. Syst. 15 (2016) 142) of
delayed markers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .plan import Response

FloatArray = NDArray[np.float64]

_RANKS = (8, 12, 18, 24, 36)  # of which validation chooses
DELAYS: Final = 4  # markers that tell the state
_RIDGE = 1e-8
_AHEAD = 0.3  # s, that validation foretells


@dataclass(frozen=True)
class LinearModel:
    """s' = A s + B u, y = y_0 + C s, of delayed markers; inputs in units of `scale`.

    Attributes:
        time_step: h [s].
        scale: (n,) of the inputs.
        rest: (3 M,) markers without inputs [m].
        basis: (D 3 M, q) orthonormal, from D markers, the last first, to s.
        a: (q, q).
        b: (q, n).
        c: (3 M, q).
        validation_mm: error in what validation foretells.
    """

    time_step: float
    scale: FloatArray
    rest: FloatArray
    basis: FloatArray
    a: FloatArray
    b: FloatArray
    c: FloatArray
    validation_mm: float

    @property
    def parts(self) -> int:
        """The number n of inputs."""
        return len(self.scale)

    def state(self, markers: Sequence[FloatArray]) -> FloatArray:
        """(q,) of the last D markers (3 M,), the last first [m]."""
        return np.asarray((np.concatenate(markers) - np.tile(self.rest, len(markers))) @ self.basis)

    def respond(
        self, start: FloatArray, inputs: FloatArray, basis: FloatArray | None = None, bias: FloatArray | None = None
    ) -> Response:
        """The motion of the markers over T steps, see `plan.PredictionModel`; `bias` has no effect."""
        del bias
        s, states, sloped = start, [], []
        ds = None if basis is None else np.zeros((len(s), basis.shape[2]))
        for k, u in enumerate(inputs / self.scale):
            s = self.a @ s + self.b @ u
            states.append(s)
            if basis is not None and ds is not None:
                ds = self.a @ ds + self.b @ (basis[k] / self.scale[:, None])
                sloped.append(ds)
        y = self.rest + np.array(states) @ self.c.T
        return Response(y, None if basis is None else self.c @ np.array(sloped))


def fit_linear(
    train: Sequence[tuple[FloatArray, FloatArray]],
    validation: Sequence[tuple[FloatArray, FloatArray]],
    scale: FloatArray,
    time_step: float,
) -> LinearModel:
    """The linear model of recordings, of the rank that foretells those of validation best.

    Args:
        train: of each trial, markers (T + 1, 3 M) [m], which begin at rest, and inputs (T, n).
        validation: the same.
        scale: (n,) of the inputs.
        time_step: h [s].
    """
    rest = np.mean([markers[0] for markers, _ in train], axis=0)

    def delayed(markers: FloatArray) -> FloatArray:
        """(T + 2 - D, D 3 M) from the rest, the last first."""
        off = markers - rest
        return np.concatenate([off[DELAYS - 1 - j : len(off) - j] for j in range(DELAYS)], axis=1)

    def pairs(trials: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray, FloatArray]:
        rows = [(delayed(y), u[DELAYS - 1 :] / scale) for y, u in trials]
        return (
            np.concatenate([x[:-1][: len(u)] for x, u in rows]),
            np.concatenate([x[1:][: len(u)] for x, u in rows]),
            np.concatenate([u[: len(x) - 1] for x, u in rows]),
        )

    before, after, inputs = pairs(train)
    directions = np.linalg.svd(before, full_matrices=False)[2]
    width, best = len(rest), None
    for rank in (each for each in _RANKS if each <= len(directions)):
        basis = directions[:rank].T
        known = np.concatenate([before @ basis, inputs], axis=1)
        normal = known.T @ known
        normal += _RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
        found = np.linalg.solve(normal, known.T @ (after @ basis)).T
        made = LinearModel(
            time_step, scale, rest, basis, found[:, :rank], found[:, rank:], basis[:width], validation_mm=np.inf
        )
        error = _foretold(made, validation, delayed)
        if best is None or error < best.validation_mm:
            best = replace(made, validation_mm=error)
    assert best is not None
    return best


def _foretold(model: LinearModel, trials: Sequence[tuple[FloatArray, FloatArray]], delayed: object) -> float:
    """Mean error of markers ahead [mm]."""
    steps, errors = max(round(_AHEAD / model.time_step), 1), []
    for markers, inputs in trials:
        for at in range(DELAYS - 1, len(inputs) - steps, steps):
            start = model.state([markers[at - j] for j in range(DELAYS)])
            found = model.respond(start, inputs[at : at + steps]).y
            off = (found - markers[at + 1 : at + 1 + steps]).reshape(steps, -1, 3)
            errors.append(np.linalg.norm(off, axis=2).mean())
    return 1e3 * float(np.mean(errors)) if errors else np.inf
