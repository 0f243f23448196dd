"""Polynomials of several variables with array values, fitted by least squares."""

import itertools
from functools import cache
from typing import Final

import numpy as np

from ..io.arrays import FloatArray, IntArray

_SHARE_OF_POINTS: Final = 0.5  # largest number of coefficients, relative to the number of samples
_HELD_OUT: Final = 5  # one of so many samples, for the choice of the order
_MOST: Final = 8  # order
_RIDGE: Final = 1e-9  # relative to the mean square of the features


class Monomials:
    """Monomials of points (T, n), cached for all polynomials that are evaluated there."""

    def __init__(self, points: FloatArray) -> None:
        self.points = points
        self._values, self._order = np.ones((len(points), 1)), 0

    def values(self, order: int) -> FloatArray:
        """Monomials (T, F) up to an order, sorted as in `powers`."""
        variables = self.points.shape[1]
        while self._order < order:
            self._order += 1
            factors, before = _products(variables, self._order)
            self._values = np.concatenate(
                [self._values, self.points[:, factors] * self._values[:, before]], axis=1
            )
        return self._values[:, : len(powers(variables, order))]


class Polynomial:
    """An array of polynomials of n variables.

    Args:
        coefficients: (F, *shape), sorted as in `powers`.
        order: of the polynomials.
    """

    def __init__(self, coefficients: FloatArray, order: int) -> None:
        self.coefficients, self.order = coefficients, order
        self._shape = coefficients.shape[1:]
        self._flat = coefficients.reshape(len(coefficients), -1)

    @classmethod
    def fitted(cls, points: FloatArray, values: FloatArray, order: int) -> "Polynomial":
        """Fits values (S, *shape) at points (S, n) by least squares.

        The order is lowered where samples are too few.
        """
        variables = points.shape[1]
        while order > 0 and len(powers(variables, order)) > _SHARE_OF_POINTS * len(points):
            order -= 1
        coefficients = solve_ridge(Monomials(points).values(order), values.reshape(len(values), -1))
        return cls(coefficients.reshape(len(coefficients), *values.shape[1:]), order)

    def __call__(self, at: FloatArray | Monomials) -> FloatArray:
        """Values (T, *shape) at points (T, n)."""
        at = at if isinstance(at, Monomials) else Monomials(at)
        return np.asarray(
            (at.values(self.order) @ self._flat).reshape(len(at.points), *self._shape)
        )


def best_order(points: FloatArray, values: FloatArray, least: int) -> int:
    """Returns the order of a polynomial, from ``least`` on,
    whose fit to most samples is best on the others.

    Args:
        points: (S, n).
        values: (S, ...).
        least: that is taken where samples are too few to tell.
    """
    left_out = np.arange(len(points)) % _HELD_OUT == _HELD_OUT - 1
    errors, count = dict[int, float](), np.count_nonzero(~left_out)
    for order in range(least, _MOST + 1):
        if len(powers(points.shape[1], order)) > _SHARE_OF_POINTS * count:
            break
        fitted = Polynomial.fitted(points[~left_out], values[~left_out], order)
        errors[order] = float(np.square(fitted(points[left_out]) - values[left_out]).sum())
    return min(errors, key=lambda order: errors[order], default=least)


class SquaredPolynomial(Polynomial):
    """Symmetric matrices (..., r, r) without negative eigenvalues,
    of n variables: squares of polynomials.
    """

    @classmethod
    def fitted(cls, points: FloatArray, values: FloatArray, order: int) -> "SquaredPolynomial":
        """Fits matrices (S, ..., r, r) at points (S, n); negative eigenvalues count as zero."""
        sizes, vectors = np.linalg.eigh(0.5 * (values + values.mT))
        roots = vectors * np.sqrt(np.maximum(sizes, 0.0))[..., None, :] @ vectors.mT
        root = Polynomial.fitted(points, roots, order)
        return cls(root.coefficients, root.order)

    def __call__(self, at: FloatArray | Monomials) -> FloatArray:
        """Values (T, ..., r, r) at points (T, n)."""
        root = super().__call__(at)
        return np.asarray(root @ root.mT)


@cache
def powers(variables: int, order: int) -> IntArray:
    """Exponents (F, n) of all monomials up to an order."""
    rows = []
    for degree in range(order + 1):
        for chosen in itertools.combinations_with_replacement(range(variables), degree):
            rows.append(
                np.bincount(chosen, minlength=variables)
                if chosen
                else np.zeros(variables, dtype=np.int64)
            )
    return np.array(rows, dtype=np.int64)


@cache
def _products(variables: int, order: int) -> tuple[list[int], list[int]]:
    """Factors of each monomial of this order: the numbers of a variable
    and of a monomial of lower order.
    """
    exponents = powers(variables, order)
    place = {tuple(row): number for number, row in enumerate(exponents.tolist())}
    rows = exponents[exponents.sum(1) == order]
    factors = [int(row.argmax()) for row in rows > 0]
    lower = rows - np.eye(variables, dtype=np.int64)[factors]
    return factors, [place[tuple(row)] for row in lower.tolist()]


def solve_ridge(features: FloatArray, values: FloatArray, common_scale: bool = False) -> FloatArray:
    """Solves least squares of values (S, V) on features (S, F), which may be collinear.

    Returns (F, V).

    With a common scale, all features are scaled by the largest, so that rarely excited ones are
    regularised away.
    """
    scale = np.sqrt(np.mean(features**2, axis=0))
    scale = np.full_like(scale, scale.max()) if common_scale else scale
    scale = np.where(scale > 0.0, scale, 1.0)
    scaled = features / scale
    normal = scaled.T @ scaled / len(features) + _RIDGE * np.eye(features.shape[1])
    return np.asarray(np.linalg.solve(normal, scaled.T @ values / len(features)) / scale[:, None])


def around(point: FloatArray, step: float) -> FloatArray:
    """Returns points (1 + k, ..., k) for differences: one (..., k),
    and it with each coordinate moved by a step.
    """
    k = point.shape[-1]
    return np.asarray(
        point + step * np.eye(1 + k, k, -1).reshape(1 + k, *[1] * (point.ndim - 1), k)
    )
