"""Minimisation of a sum of squares within bounds, by a quasi-Newton method that starts from the Gauss-Newton matrix.

Physical parameters lie along narrow, bent valleys of their loss, such as stiffness against Poisson's ratio. A method
that has to learn their direction from its steps (as L-BFGS-B has) creeps along them and stops early. The Gauss-Newton
matrix knows it from the first step. BFGS keeps it up to date with gradients alone, until a step shows that the valley
bends: then it is computed anew. A step minimises the quadratic model within the bounds and a trust box, and a line
search along it makes sure of a decrease (Nocedal and Wright 2006, chapters 3, 6 and 10).
"""

from collections.abc import Callable

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

Array = NDArray[np.float64]
Objective = Callable[[Array], tuple[float, Array]]

_ARMIJO = 1e-4
_TRIALS = 10
_LARGEST_STEP = 0.25  # of the range of a variable
_RIDGE = 1e-10  # of the trace: keeps directions without influence from moving
_CLOSE = 0.6  # of a step's curvature to the model's: what an update may mend
_ABSOLUTE_DECREASE = 1e-10


def minimise(
    objective: Objective,
    start: Array,
    matrix: Callable[[Array], Array | None],
    max_evaluations: int,
    tolerance: float = 1e-6,
) -> tuple[Array, float]:
    """The minimum over the unit box that is downhill from a start.

    It ends where the model promises a relative decrease below the tolerance, or one of less than 1e-10.

    Args:
        objective: (P,) variables to value and gradient; the value is infinite where there is none.
        start: (P,) between 0 and 1.
        matrix: (P,) variables to the (P, P) Gauss-Newton matrix 2 J^T J, or None where it cannot be had.
        max_evaluations: of the objective; a matrix costs about as much as two.
        tolerance: relative decrease that is still worth a step.

    Returns:
        The variables and the value; infinite if it was so at the start.
    """
    counted = _Counted(objective, max_evaluations)
    x = np.clip(start, 0.0, 1.0)
    value, gradient = counted(x)
    if not np.isfinite(value):
        return x, np.inf
    model, fresh = _model(matrix(x), gradient), True
    while counted.left > 0:
        step = _box_step(model, gradient, x)
        promised = -float(gradient @ step + 0.5 * step @ model @ step)
        found = None
        if promised > max(tolerance * value, _ABSOLUTE_DECREASE):
            found = _search(counted, x, value, gradient, step, model)
        if found is None:
            if fresh:
                break
            model, fresh = _model(matrix(x), gradient), True
            continue
        new, value, slope = found
        moved, change, gradient, x = new - x, slope - gradient, slope, new
        curvature, expected = float(moved @ change), float(moved @ model @ moved)
        if _CLOSE * expected <= curvature <= expected / _CLOSE:
            model, fresh = _update(model, moved, change), False
        else:  # The valley bends.
            model, fresh = _model(matrix(x), gradient), True
    return x, value


class _Counted:
    """An objective that knows how often it may still be evaluated."""

    def __init__(self, objective: Objective, most: int) -> None:
        self._objective, self.left = objective, most

    def __call__(self, x: Array) -> tuple[float, Array]:
        self.left -= 1
        return self._objective(x)


def _model(matrix: Array | None, gradient: Array) -> Array:
    """A positive definite matrix; without one, that with which the first step goes a tenth of a range."""
    if matrix is None or not np.isfinite(matrix).all() or not np.trace(matrix) > 0.0:
        return np.eye(len(gradient)) * max(float(np.linalg.norm(gradient)) / 0.1, 1e-12)
    return matrix + _RIDGE * np.trace(matrix) * np.eye(len(gradient))


def _box_step(model: Array, gradient: Array, x: Array) -> Array:
    """The step that minimises g . d + d . H d / 2 within the bounds and the trust box."""
    root = np.linalg.cholesky(model)
    right = -np.linalg.solve(root, gradient)
    bounds = np.maximum(-x, -_LARGEST_STEP), np.minimum(1.0 - x, _LARGEST_STEP)
    return np.asarray(scipy.optimize.lsq_linear(root.T, right, bounds=bounds, method="bvls").x)


def _search(
    objective: "_Counted", x: Array, value: float, gradient: Array, step: Array, model: Array
) -> tuple[Array, float, Array] | None:
    """Variables, value and gradient of the first sufficient decrease; None if there is none.

    A full step that leaves a bent valley is followed by one back to its floor before it is shortened.
    """
    slope, length = float(gradient @ step), 1.0
    for _ in range(_TRIALS):
        new = np.clip(x + length * step, 0.0, 1.0)
        trial, at_trial = objective(new)
        if trial <= value + _ARMIJO * length * slope:
            return new, trial, at_trial
        if objective.left <= 0:
            return None
        if length == 1.0 and np.isfinite(trial):
            back = np.clip(new + _box_step(model, at_trial, new), 0.0, 1.0)
            second, at_second = objective(back)
            if second <= value + _ARMIJO * slope:
                return back, second, at_second
        lowest = 0.25
        if np.isfinite(trial):  # Where the parabola through what is known has its minimum.
            lowest = -0.5 * slope * length / (trial - value - slope * length)
        length *= min(max(lowest, 0.1), 0.5)
        if objective.left <= 0:
            return None
    return None


def _update(model: Array, step: Array, change: Array) -> Array:
    """The BFGS update, which keeps the matrix positive definite where the step shows a positive curvature."""
    product = model @ step
    return np.asarray(
        model - np.outer(product, product) / (step @ product) + np.outer(change, change) / (step @ change)
    )
