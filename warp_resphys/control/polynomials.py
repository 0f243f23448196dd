"""Polynomials of several variables with values of any shape, fitted by least squares."""

import itertools
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_SHARE_OF_POINTS: Final = 0.5
_RIDGE: Final = 1e-9  # of the mean square of the features


class Monomials:
    """Monomials of points (T, n), computed once however many polynomials ask for them."""

    def __init__(self, points: FloatArray) -> None:
        self.points = points
        self._values, self._order = np.ones((len(points), 1)), 0

    def values(self, order: int) -> FloatArray:
        """(T, F) up to an order, in the order of `powers`."""
        variables = self.points.shape[1]
        while self._order < order:
            self._order += 1
            factors, before = _products(variables, self._order)
            self._values = np.concatenate([self._values, self.points[:, factors] * self._values[:, before]], axis=1)
        return self._values[:, : len(powers(variables, order))]


class Polynomial:
    """Polynomials of n variables, as arrays of any shape.

    Args:
        coefficients: (F, *shape), in the order of `powers`.
        order: of the polynomials.
    """

    def __init__(self, coefficients: FloatArray, order: int) -> None:
        self.coefficients, self.order = coefficients, order
        self._shape = coefficients.shape[1:]
        self._flat = coefficients.reshape(len(coefficients), -1)
        self._sloped: FloatArray | None = None  # (F, n V) coefficients of the derivatives

    @classmethod
    def fitted(cls, points: FloatArray, values: FloatArray, order: int) -> "Polynomial":
        """By least squares, from values (S, *shape) at points (S, n), of this order or what so many points tell."""
        order = told_order(points, order)
        found = solve_ridge(Monomials(points).values(order), values.reshape(len(values), -1))
        return cls(found.reshape(-1, *values.shape[1:]), order)

    def __call__(self, at: FloatArray | Monomials) -> FloatArray:
        """(T, *shape) at points (T, n)."""
        at = at if isinstance(at, Monomials) else Monomials(at)
        found = at.values(self.order) @ self._flat
        return np.asarray(found.reshape(len(found), *self._shape))

    def slopes(self, at: FloatArray | Monomials) -> FloatArray:
        """(T, n, *shape) derivatives by the variables at points (T, n)."""
        at = at if isinstance(at, Monomials) else Monomials(at)
        n = at.points.shape[1]
        if self._sloped is None:
            self._sloped = (derivatives(n, self.order) @ self._flat).swapaxes(0, 1).reshape(len(self._flat), -1)
        found = at.values(self.order) @ self._sloped
        return np.asarray(found.reshape(len(found), n, *self._shape))


def told_order(points: FloatArray, order: int) -> int:
    """The highest order, up to one, whose polynomials have no more coefficients than a share of the points (S, n)."""
    while order > 0 and len(powers(points.shape[1], order)) > _SHARE_OF_POINTS * len(points):
        order -= 1
    return order


@cache
def powers(variables: int, order: int) -> NDArray[np.int64]:
    """(F, n) exponents of all monomials up to an order."""
    rows = []
    for degree in range(order + 1):
        for chosen in itertools.combinations_with_replacement(range(variables), degree):
            rows.append(np.bincount(chosen, minlength=variables) if chosen else np.zeros(variables, dtype=np.int64))
    return np.array(rows, dtype=np.int64)


@cache
def derivatives(variables: int, order: int) -> FloatArray:
    """(n, F, F) from the coefficients of a polynomial to those of its derivatives by the variables."""
    known = powers(variables, order)
    place = {tuple(row): number for number, row in enumerate(known.tolist())}
    found = np.zeros((variables, len(known), len(known)))
    for number, row in enumerate(known.tolist()):
        for variable in (each for each in range(variables) if row[each]):
            lower = (*row[:variable], row[variable] - 1, *row[variable + 1 :])
            found[variable, place[lower], number] = row[variable]
    return found


@cache
def _products(variables: int, order: int) -> tuple[list[int], list[int]]:
    """The variable and the monomial of lower order whose product each monomial of this order is, by number."""
    known = powers(variables, order)
    place = {tuple(row): number for number, row in enumerate(known.tolist())}
    rows = known[known.sum(1) == order]
    factors = [int(row.argmax()) for row in rows > 0]
    lower = rows - np.eye(variables, dtype=np.int64)[factors]
    return factors, [place[tuple(row)] for row in lower.tolist()]


def solve_ridge(known: FloatArray, values: FloatArray) -> FloatArray:
    """(F, V) least squares of (S, V) values on (S, F) features, which may tell the same."""
    scale = np.sqrt(np.mean(known**2, axis=0))
    scaled = known / np.where(scale > 0.0, scale, 1.0)
    normal = scaled.T @ scaled / len(known) + _RIDGE * np.eye(known.shape[1])
    found = np.linalg.solve(normal, scaled.T @ values / len(known))
    return np.asarray(found / np.where(scale > 0.0, scale, 1.0)[:, None])
