"""Search for the parameters with the smallest misfit, from the best of a coarse set of starts.

The misfit (`misfit.BoundedMisfit`) is a sum of squares, which is minimised within bounds by
`linalg.least_squares.UnitBox` with derivatives along the motions (`Replay.varied`). Its parameters
are fractions of their ranges, "units" from 0 to 1.

After a release, the start of a motion depends on the parameters: it is estimated again with the
result, from which the search continues, until the loss changes by less than 2 %.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from pydantic import ConfigDict, TypeAdapter, ValidationError

from ...core.linalg.least_squares import Point, UnitBox, minimise
from ...io.arrays import FloatArray
from ...io.errors import ConvergenceError, DataFileError
from ...io.parts import Checkpoint
from ...io.progress import Progress
from ...io.safe_files import read_json
from ..observed_motions import Identified
from .misfit import BoundedMisfit
from .uncertainty import Uncertainty

Report = Callable[[int, float, Mapping[str, float]], None]
IsLast = Callable[[float], bool]

# Ratio of old and new weights of the priors above which a second descent is not worth its time.
_SIMILAR = 0.7
# Estimations of a release after the first; ratio of losses at which they end.
_MOST_AGAIN, _UNCHANGED = 3, 0.98
_AT_A_BOUND = 1e-4  # of the range


@dataclass(frozen=True)
class Identification(Identified):
    """Result of an identification.

    Attributes:
        parameters, of_trials, placement, first_frames: see `Identified`.
        loss: smallest loss, relative to the motions' amplitudes.
        history: records of every start, one a step that did not fail: ``loss`` and the parameters.
            The loss of the last step may be that of the linearisation.
        at_bounds: parameters that ended on a bound.
        uncertainty: of the shared parameters; None if the simulation fails beside the minimum.
        of_trials_deviation: standard deviations of the values of single trials and sessions.
        first_guess: start of the search.
    """

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid", arbitrary_types_allowed=True)

    loss: float = math.nan
    history: Sequence[Sequence[Mapping[str, float]]] = ()
    at_bounds: tuple[str, ...] = ()
    uncertainty: Uncertainty | None = None
    of_trials_deviation: Mapping[str, float] = field(default_factory=dict)
    first_guess: Mapping[str, float] = field(default_factory=dict)

    @property
    def deviation(self) -> Mapping[str, float]:
        """Standard deviations of the shared parameters; empty if they are not known."""
        return {} if self.uncertainty is None else self.uncertainty.deviation

    def plain(self) -> dict[str, Any]:
        """Returns the identification as JSON data, without an actuator,
        which is a file of its own.
        """
        where_given = ("of_trials", "of_trials_deviation", "first_frames", "actuator", "test")
        without = replace(self, actuator={}, test=None)
        return {
            key: value for key, value in asdict(without).items() if value or key not in where_given
        }

    @staticmethod
    def from_plain(plain: Any) -> "Identification":
        """Returns the identification that `plain` wrote.

        Raises:
            DataFileError: another version wrote it.
        """
        try:
            return _PLAIN.validate_python(plain)
        except ValidationError as error:
            key = ".".join(map(str, error.errors()[0]["loc"]))
            raise DataFileError(
                f"{key} is not of an identification of this version: identify again."
            ) from error

    @classmethod
    def read(cls, path: Path) -> "dict[str, Identification]":
        """Returns the identifications in identification.json by model; empty without a file."""
        return (
            {name: cls.from_plain(plain) for name, plain in read_json(path).items()}
            if path.is_file()
            else {}
        )


_PLAIN = TypeAdapter(Identification)


@dataclass(frozen=True)
class Searches:
    """Limits of searches that follow one another, and the checkpoint that keeps them.

    Attributes:
        max_evaluations: see `search_parameters`.
        tolerance: see `search_parameters`.
        kept: finished searches.
        title: of the progress bar.
        key: of the searches in `kept`.
        starts: number of starts of the first search.
    """

    max_evaluations: int
    tolerance: float
    kept: Checkpoint
    title: str
    key: str = ""
    starts: int = 1


def refined_searches(
    begin: Callable[[Identification | None], tuple[BoundedMisfit, Sequence[Mapping[str, float]]]],
    searches: Searches,
    labels: Sequence[str] = (),
    released: bool = False,
) -> list[Identification]:
    """Returns the results of a search, and of those with releases
    that are estimated again with the last result.

    They end when the loss changes by less than 2 %.

    Args:
        begin: returns the misfit and the starts of the search that follows a result; None at first.
        searches: how they run, and where they are kept.
        labels: see `search_parameters`.
        released: whether the trials begin by a release.
    """
    results, again = list[Identification](), _MOST_AGAIN if released else 0
    kept = searches.kept
    keys = [f"{searches.key} {number}" for number in range(1 + again)]
    before = [kept.parts[key]["history"] for key in keys if key in kept.parts]
    done = sum(map(len, chain.from_iterable(before)))
    most = (searches.starts + again) * searches.max_evaluations
    with Progress(searches.title, most, "evaluations at most", done) as progress:

        def report(start: int, loss: float, values: Mapping[str, float]) -> None:
            name, value = next(iter(values.items()))
            progress.advance(1, start=start, loss=f"{loss:.3g}", **{name: f"{value:.4g}"})

        for key in keys:
            ends = partial(_ends, key == keys[-1], results[-1].loss if results else None)

            def work(ends: IsLast = ends) -> dict[str, Any]:
                misfit, points = begin(results[-1] if results else None)
                options = (searches.max_evaluations, searches.tolerance, report, ends, labels)
                return asdict(search_parameters(misfit, points, *options))

            results.append(Identification.from_plain(kept.once(key, work)))
            if ends(results[-1].loss):
                break
    return results


def _ends(last: bool, before: float | None, after: float) -> bool:
    """Whether a search is the last, by its loss and that of the search before."""
    return last or (
        before is not None and _UNCHANGED < after / max(before, 1e-300) < 1.0 / _UNCHANGED
    )


def first_points(
    misfit: BoundedMisfit,
    first: Mapping[str, float],
    count: int = 1,
    candidates: int = 0,
    seed: int = 0,
) -> list[dict[str, float]]:
    """The first guess, and the best of random candidates in the ranges.

    Args:
        misfit: of the parameters.
        first: a value of each parameter.
        count: number of starts, the first guess included.
        candidates: number of random sets of parameters (Latin hypercube).
        seed: of the random sets.
    """
    units = [misfit.to_unit(first)]
    if count > 1:
        from scipy.stats import qmc

        sampler = qmc.LatinHypercube(len(misfit.bounds), rng=np.random.default_rng(seed))
        points = sampler.random(max(candidates, count - 1))
        losses = misfit.losses_or_infinite(points)
        units += [points[i] for i in np.argsort(losses)[: count - 1] if np.isfinite(losses[i])]
    return [misfit.from_unit(unit) for unit in units]


def search_parameters(
    misfit: BoundedMisfit,
    starts: Sequence[Mapping[str, float]],
    max_evaluations: int,
    tolerance: float = 1e-6,
    report: Report | None = None,
    is_last: IsLast = lambda loss: True,
    labels: Sequence[str] = (),
) -> Identification:
    """Minimises a misfit from every start and keeps the best.

    Args:
        misfit: of the parameters.
        starts: a value of each parameter, for each start.
        max_evaluations: of the loss and its gradient, for each start.
        tolerance: relative decrease of the loss below which the search ends; a step from which the
            linearisation expects less is not evaluated.
        report: called after every evaluation with the start's number, the loss (infinite where the
            simulation failed) and the parameters.
        is_last: whether no other search follows one with a loss; if not, placement and uncertainty
            are left out.
        labels: names of the markers, if their places are uncertain.

    Raises:
        ConvergenceError: the simulation fails at every start.
    """
    attempts = [
        _descend(misfit, k, start, max_evaluations, tolerance, report)
        for k, start in enumerate(starts)
    ]
    good = [attempt for attempt in attempts if attempt.loss < math.inf]
    if not good:
        reason = misfit.failure or "motions that are not finite"
        raise ConvergenceError(
            f"the simulation failed at every start of the identification: {reason}", None, None
        )
    best = min(good, key=lambda attempt: attempt.loss)
    unit = best.unit
    misfit.prior_weight = best.prior_weight
    last = is_last(best.loss)
    identified = Identification(
        parameters=misfit.from_unit(unit),
        loss=best.loss,
        history=[attempt.history for attempt in attempts],
        at_bounds=tuple(
            n for n, u in zip(misfit.bounds, unit, strict=True) if min(u, 1.0 - u) < _AT_A_BOUND
        ),
        placement=misfit.nuisances(unit).plain(labels) if last else None,
        uncertainty=misfit.uncertainty(unit) if last else None,
    )
    misfit.forget()
    return identified


class _Attempt(NamedTuple):
    """Result of one start."""

    unit: FloatArray  # (P,) as fractions of the ranges
    loss: float  # infinite if the simulation fails there
    history: list[dict[str, float]]
    prior_weight: float


def _descend(
    misfit: BoundedMisfit,
    number: int,
    start: Mapping[str, float],
    max_evaluations: int,
    tolerance: float,
    report: Report | None,
) -> _Attempt:
    """Returns the result of one start."""
    history, first = list[dict[str, float]](), misfit.to_unit(start)

    def evaluated(unit: FloatArray, loss: float) -> None:
        values = misfit.from_unit(unit)
        if math.isfinite(loss):
            history.append({"loss": loss, **values})
        if report is not None:
            report(number, loss, values)

    def minimum(x: torch.Tensor, most: int) -> Point:
        problem = UnitBox(misfit.objective, tolerance, evaluated)
        begin = problem.evaluate(x)
        if not math.isfinite(float(begin.value)):
            return begin
        end = minimise(problem, begin, tolerance, most - 1).point
        return (
            replace(end, value=torch.full_like(end.value, torch.inf))
            if problem.differentiates is False
            else end
        )

    misfit.prior_weight = 0.0
    misfit.forget()
    misfit.update_prior_weight(first)
    point = minimum(torch.as_tensor(first)[None], max_evaluations)
    left, weight = max_evaluations - len(history), misfit.prior_weight
    if misfit.has_priors and left > 1 and math.isfinite(float(point.value)):
        misfit.update_prior_weight(point.x[0].numpy())
        if not _SIMILAR * weight < misfit.prior_weight < weight / _SIMILAR:
            refined = minimum(point.x, left)
            point = refined if math.isfinite(float(refined.value)) else point
    return _Attempt(point.x[0].numpy(), float(point.value), history, misfit.prior_weight)
