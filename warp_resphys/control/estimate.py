"""State estimation from markers: an extended Kalman filter on a reduced model, with a bias of the equilibria.

The state is (z, z', b): coordinates, their rates, and the offset b of the real robot's equilibria from the model's,
a random walk. Estimating b removes the steady-state error of a receding horizon, whatever constant error the model
has (offset-free control: Pannocchia and Rawlings, AIChE J. 49 (2003) 426).
"""

import numpy as np
import scipy.linalg

from ..io.arrays import FloatArray
from .polynomials import Monomials
from .reduced import ReducedModel

_RATE = 0.3  # unmodelled change of the rates in a step, relative to their spread in a swing of one millimetre
_BIAS = 5e-3  # drift of the bias in a second, as a displacement of the markers [m]
_JITTER = 1e-12  # of a correlation matrix, which is singular where a quantity is known exactly


class Estimator:
    """Estimates the state of a robot from its markers.

    Args:
        model: of the robot.
        inputs: (n,) under which the robot rests at first.
        offset: (3 M,) of its markers from those of the model, at rest [m]; zero if omitted.
        noise: standard deviation of a coordinate of a marker [m].
    """

    def __init__(
        self, model: ReducedModel, inputs: FloatArray, offset: FloatArray | None = None, noise: float = 1e-4
    ) -> None:
        self.model, self._noise = model, noise
        self.state = model.rest(inputs)
        r = model.modes
        self.bias = np.zeros(r)
        self.offset = np.zeros(model.curved.shape[2]) if offset is None else offset
        u = Monomials(self.state.acting)
        seen = model.point_slopes(self.state.z, u)[0]
        # Mean displacement of the markers per unit of each coordinate [m].
        size = np.linalg.norm(seen, axis=0) / np.sqrt(len(self.offset) / 3.0)
        one = 1e-3 / size
        stiffness = np.abs(np.diag(model.stiffness(u)[0]))
        self._wander = np.concatenate(
            [np.zeros(r), (_RATE * one * np.sqrt(stiffness)) ** 2, (_BIAS / size) ** 2 * model.time_step]
        )
        self._covariance = np.diag(np.concatenate([one**2, (one * np.sqrt(stiffness)) ** 2, (2.0 * one) ** 2]))

    def predict(self, inputs: FloatArray) -> None:
        """Advances the estimate by one step under inputs (n,)."""
        transition = np.eye(3 * self.model.modes)
        self.state, transition[: 2 * self.model.modes], _ = self.model.transition(self.state, inputs, self.bias[None])
        self._covariance = transition @ self._covariance @ transition.T + np.diag(self._wander)

    def correct(self, markers: FloatArray) -> None:
        """Updates the estimate with markers (M, 3) observed after the step [m]; NaN where one is not seen."""
        model, r = self.model, self.model.modes
        seen = np.isfinite(markers).ravel()
        if not seen.any():
            return
        slopes = np.zeros((int(seen.sum()), 3 * r))
        slopes[:, :r] = model.point_slopes(self.state.z, Monomials(self.state.acting))[0, seen]
        expected = (model.observe(self.state)[0] + self.offset)[seen]
        residual = markers.ravel()[seen] - expected
        change, self._covariance = conditioned(self._covariance, slopes, residual, self._noise)
        self.state = self.state.moved(change[None, :r], change[None, r : 2 * r], model.time_step)
        self.bias = self.bias + change[2 * r :]


def conditioned(
    covariance: FloatArray, slopes: FloatArray, residual: FloatArray, deviation: float
) -> tuple[FloatArray, FloatArray]:
    """Conditions n jointly normal errors on m observations with independent noise.

    In the square-root form of Bierman (1977), which stays positive definite, and costs n^3 however many observations.

    Args:
        covariance: (n, n).
        slopes: (m, n) of the observations.
        residual: (m,) observed minus expected.
        deviation: standard deviation of the noise.

    Returns:
        The change of the mean (n,), and the covariance (n, n) after it.
    """
    size = np.sqrt(np.diag(covariance))
    size = np.where(size > 0.0, size, 1.0)
    scaled = covariance / size / size[:, None]
    root = size[:, None] * np.linalg.cholesky(scaled + _JITTER * np.eye(len(size)))
    seen = (slopes @ root).T / deviation
    gained = scipy.linalg.solve(np.eye(len(size)) + seen @ seen.T, root.T, assume_a="pos").T
    after = gained @ root.T
    return gained @ (seen @ residual) / deviation, 0.5 * (after + after.T)
