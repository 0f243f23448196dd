"""Identifications without one of their trials, to first order, from the linearised residuals of all.

Residuals of trials from which parameters were identified are smaller than errors of predictions. Without trial r, the
parameters minimise

    sum_{s != r} |e_s + J_s d + C_s p|^2 + priors

in their change d and that p of places and delays, with the residuals e, J and C their derivatives (Cook and Weisberg,
Residuals and Influence in Regression, 1982). So a trial that determines a parameter alone has its error with the
parameter's prior.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..data.trials import Trials
from .bounded_misfit import LinearMisfit
from .bounds import Bounds
from .nuisance import Nuisances
from .uncertainty import LeftOut, uncertainty_of

FloatArray = NDArray[np.float64]

_UNIFORM = 12.0  # reciprocal variance of a parameter in its range, as a fraction of it


@dataclass(frozen=True)
class LinearSystem:
    """Weighted residuals at P parameters, and their derivatives at constant places and delays.

    Attributes:
        groups: of R trials.
        rows: (R, T, 3 M) residuals, by group.
        slopes: (R, 3 T M, P) derivatives by the parameters, by group.
        seen: number of the coordinates that were seen, by group and trial.
        nuisances: places and delays.
        prior: (K,) weighted residuals of the priors of parameters, and (K, P).
        weight: of the priors.
    """

    groups: Sequence[Trials]
    rows: list[FloatArray]
    slopes: list[FloatArray]
    seen: list[list[float]]
    nuisances: Nuisances
    prior: tuple[FloatArray, FloatArray]
    weight: float

    def misfit(self) -> LinearMisfit:
        """Returns the misfit in which places and delays follow the parameters."""
        jacobians, further = self.nuisances.projected(self.slopes, math.sqrt(self.weight))
        counts = [count for counts in self.seen for count in counts]
        trials = [*zip((own for rows in self.rows for own in rows), jacobians, counts, strict=True)]
        rows, slopes = self.prior
        return LinearMisfit(trials, np.concatenate([rows, self.nuisances.rows]), np.concatenate([slopes, further]))

    def without(self, group: int, row: int) -> "LinearSystem":
        """Returns the system in which a trial has no residuals."""

        def blank(values: Sequence[FloatArray]) -> list[FloatArray]:
            result = [*values]
            if result:
                result[group] = result[group].copy()
                result[group][row] = 0.0
            return result

        nuisances = replace(self.nuisances, columns=blank(self.nuisances.columns))
        return replace(self, rows=blank(self.rows), slopes=blank(self.slopes), nuisances=nuisances)

    def places(self, step: FloatArray, session: str) -> list[float] | None:
        """(3 M + 6,) change of a session's placement with a step (P,) of the parameters; None if places are exact."""
        if self.nuisances.placed is None:
            return None
        pairs = zip(self.rows, self.slopes, strict=True)
        change = self.nuisances.change([r.reshape(len(r), -1) + j @ step for r, j in pairs], math.sqrt(self.weight))
        placed = self.nuisances.placed
        deviations = torch.from_numpy(change[: len(placed.deviations)]).to(placed.deviations)
        return [float(value) for value in placed.change(session, deviations)]


def left_out(system: LinearSystem, bounds: Mapping[str, Bounds], unit: FloatArray) -> dict[str, LeftOut]:
    """Returns the identification without each of the trials; empty with less than two.

    Ranges count as normal distributions of the same variance, as what no other trial determines could be anything.

    Args:
        system: linearised at the minimum.
        bounds: range of each of the P parameters.
        unit: (P,) the minimum, in fractions of the ranges.
    """
    order = [(group, row) for group, rows in enumerate(system.rows) for row in range(len(rows))]
    slopes = np.array([range_.slope(u) for range_, u in zip(bounds.values(), unit, strict=True)])
    result: dict[str, LeftOut] = {}
    for number, (group, row) in enumerate(order if len(order) > 1 else ()):
        others, trials = system.without(group, row), system.groups[group]
        linear = others.misfit()
        kept = linear.trials[:number] + linear.trials[number + 1 :]
        variance = sum(float(np.square(rows).sum()) for rows, _, _ in kept) / sum(seen for _, _, seen in kept)
        curvature = 0.5 * linear.gauss_newton + _UNIFORM * variance * np.eye(len(unit))
        step = np.asarray(-0.5 * np.linalg.lstsq(curvature, linear.gradient)[0], dtype=np.float64)
        uncertainty = uncertainty_of(kept, linear.prior_slopes, system.weight, bounds, unit)
        result[trials.names[row]] = LeftOut(
            change=dict(zip(bounds, (slopes * step).tolist(), strict=True)),
            placement=others.places(step, trials.session),
            deviation=uncertainty.deviation,
            correlation=uncertainty.correlation,
        )
    return result
