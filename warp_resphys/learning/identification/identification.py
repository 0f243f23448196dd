"""System identification: the physical parameters with which a simulator comes closest to observed motions.

A misfit (`misfit.Misfit`) is minimised within bounds, from the best of a coarse set of starts
(`linalg.least_squares.UnitBox`), with derivatives along the motions (`Replay.varied`). It is a sum of squares, and its
parameters are fractions of their ranges, "units" from 0 to 1.

After a release, the start of a motion depends on the parameters: it is estimated again with the result, from which the
search continues, until the loss changes by less than 2 %.
"""

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from pydantic import TypeAdapter

from ...data.rigid_bodies import independent
from ...data.trials import RELEASED, RESTING, Trials
from ...dynamics.simulator import Simulator
from ...io.arrays import FloatArray
from ...io.errors import ConvergenceError
from ...io.progress import Progress
from ...linalg.least_squares import Point, UnitBox, minimise
from ..observed_motions import Identified, ObservedMotions
from ..parameters import Bounds, Limits, configured_parameters, own_name, split_name
from ..placement import Accuracy
from .misfit import BoundedMisfit, Misfit
from .uncertainty import Uncertainty

log = logging.getLogger(__name__)

Report = Callable[[int, float, Mapping[str, float]], None]
IsLast = Callable[[float], bool]
Once = Callable[[str, Callable[[], Any]], Any]

_SIMILAR = 0.7  # ratio of old and new weights of the priors above which a second descent is not worth its time
_MOST_AGAIN, _UNCHANGED = 3, 0.98  # estimations of a release after the first; ratio of losses at which they end
_AT_A_BOUND = 1e-4  # of the range


@dataclass(frozen=True)
class Identification(Identified):
    """Result of an identification.

    Attributes:
        parameters, own, placement: see `Identified`.
        loss: smallest loss, relative to the motions' amplitudes.
        history: records of every start, one a step that did not fail: ``loss`` and the parameters. The loss of the last
            step may be that of the linearisation.
        at_bounds: parameters that ended on a bound.
        uncertainty: of the shared parameters; None if the simulation fails beside the minimum.
        own_deviation: standard deviations of the values of single trials and sessions.
        first_guess: start of the search.
    """

    loss: float = math.nan
    history: Sequence[Sequence[Mapping[str, float]]] = ()
    at_bounds: tuple[str, ...] = ()
    uncertainty: Uncertainty | None = None
    own_deviation: Mapping[str, float] = field(default_factory=dict)
    first_guess: Mapping[str, float] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """Returns the identification as JSON data."""
        own = ("own", "own_deviation")
        return {key: value for key, value in asdict(self).items() if value or key not in own}

    @staticmethod
    def from_plain(plain: Mapping[str, Any]) -> "Identification":
        """Returns the identification that `plain` wrote."""
        return _PLAIN.validate_python(plain)


_PLAIN = TypeAdapter(Identification)


def identify(
    simulator: Simulator,
    motions: ObservedMotions,
    parameters: Mapping[str, Limits],
    first_guess: Mapping[str, float] | None = None,
    *,
    names: Sequence[str] | None = None,
    held_out: Sequence[str] = (),
    accuracy: Accuracy | None = None,
    seconds: float | None = None,
    starts: int = 1,
    candidates: int | None = None,
    max_evaluations: int = 30,
    tolerance: float = 1e-6,
    seed: int = 0,
    once: Once = lambda key, work: work(),
    title: str = "",
) -> Identification:
    """Finds the parameters with which a simulator comes closest to observed motions.

    A parameter with ``per`` trial or session has a value for each, near the mean of its prior. That of trials whose
    motion inputs begin can also be identified from their first frames (`ReleaseSettings.window`).

    Args:
        simulator: gives all other parameters.
        motions: observed states or markers.
        parameters: range of every parameter to identify, by a name of `Replay.parameter_names`, in its unit. A pair of
            positive numbers is searched on a logarithmic scale.
        first_guess: start of the search; the simulator's own values where left out.
        names: trials to identify from; all by default.
        held_out: other trials, whose own values follow from their first frames.
        accuracy: of marker places and the recording's frame, which are identified; None: they are exact.
        seconds: duration of each motion that is used [s]; None for the part that `motions` learns from.
        starts: number of searches; those after the first start at the best of random candidates.
        candidates: number of these; four times the starts by default.
        max_evaluations: of the loss and its gradient, for each start.
        tolerance: relative decrease of the loss below which a search ends.
        seed: of the random candidates.
        once: returns the JSON data of a search with a key, by calling it, or what an earlier call of it has returned.
        title: of the progress to show; empty for none.

    Raises:
        InputError: an unknown parameter, an empty range, or a motion in which nothing moves.
        ConvergenceError: the simulation fails at every start.
    """
    dataset, trials = motions.dataset, motions.dataset.names if names is None else tuple(names)
    ranges = {name: Bounds.of(limits) for name, limits in parameters.items()}
    bounds, replays = _bounds_of_owners(ranges, dataset, trials), motions.replays(simulator, trials)
    known = {**configured_parameters(simulator, [split_name(name)[0] for name in bounds]), **(first_guess or {})}
    guess = {name: _guess(name, limits, known) for name, limits in bounds.items()}
    released = any(dataset.begin_of(name) == RELEASED for name in trials)
    if motions.train_fraction < 1.0:
        learned = motions.train_fraction * max(float(replay.trials.times.max()) for replay, _ in replays)
        seconds = min(learned, seconds or math.inf)
    nuisances: dict[str, Any] = {"delay": motions.release.delay, "shares": independent(dataset.labels)}

    def begin(before: Identification | None) -> tuple[Misfit, list[dict[str, float]]]:
        if before is None:
            misfit = Misfit(replays, bounds, seconds, accuracy, **nuisances)
            return misfit, first_points(misfit, guess, starts, 4 * starts if candidates is None else candidates, seed)
        again = [(own, motions.start(own, before)) for own, _ in replays]
        misfit = Misfit(again, bounds, seconds, accuracy, **nuisances)
        return misfit, first_points(misfit, before.parameters)

    with shown(title, (starts + (_MOST_AGAIN if released else 0)) * max_evaluations) as report:
        search = partial(search_parameters, max_evaluations=max_evaluations, tolerance=tolerance, report=report)
        rounds = refined_searches(begin, partial(search, labels=motions.labels), released, once)
    found = replace(rounds[-1], history=_joined(rounds), first_guess=guess)
    if found.placement is not None and accuracy is not None and (sessions := found.placement.get("sessions")):
        expected = accuracy.of_new_session(torch.zeros(len(motions.labels), 3, dtype=torch.float64), len(sessions))
        found = replace(found, placement={**found.placement, "new_session": expected.tolist()})
    found, own = _separated(found, ranges), {name: one for name, one in ranges.items() if one.per == "trial"}
    for name in (name for name in held_out if own and dataset.begin_of(name) in RESTING):
        found = _with_first_frames(found, simulator, motions, name, own, max_evaluations)
    return found


def _bounds_of_owners(ranges: Mapping[str, Bounds], dataset: Trials, names: Sequence[str]) -> dict[str, Bounds]:
    """Bounds of all parameters, and of the values of trials and sessions."""
    owners = {"session": list(dict.fromkeys(map(dataset.session, names))), "trial": [*names]}
    return {
        own: limits
        for name, limits in ranges.items()
        for own in ([own_name(name, owner) for owner in owners[limits.per]] if limits.per in owners else [name])
    }


def _guess(name: str, bounds: Bounds, known: Mapping[str, float]) -> float:
    """First guess of a parameter; the mean of the prior for the value of a trial."""
    parameter, owner = split_name(name)
    return bounds.prior.mean if owner and bounds.prior is not None else known[parameter]


def _joined(rounds: Sequence[Identification]) -> list[list[Mapping[str, float]]]:
    """History of the starts, of which the best continues in later rounds."""
    history = [[*records] for records in rounds[0].history]
    best = min((records for records in history if records), key=lambda own: min(one["loss"] for one in own))
    best.extend(record for own in rounds[1:] for record in own.history[0])
    return history


def _separated(found: Identification, ranges: Mapping[str, Bounds]) -> Identification:
    """An identification with the values of trials and sessions in `own`, apart from those of all trials.

    Other trials have the mean of the prior, and its deviation as their uncertainty, before `_with_first_frames`.
    """
    held = {name: one.prior for name, one in ranges.items() if one.per in ("session", "trial") and one.prior}
    if not held:
        return found
    names = [*found.parameters]
    common = [name for name in names if not split_name(name)[1]]
    own = {name: value for name, value in found.parameters.items() if split_name(name)[1]}
    parameters = {name: found.parameters[name] for name in common} | {name: p.mean for name, p in held.items()}
    found = replace(found, parameters=parameters, own=own)
    if (uncertainty := found.uncertainty) is None:
        return found
    rows = [names.index(name) for name in common]
    correlation = np.eye(len(common) + len(held))
    correlation[: len(rows), : len(rows)] = np.array(uncertainty.correlation)[np.ix_(rows, rows)]
    changed = replace(
        uncertainty,
        deviation={n: uncertainty.deviation[n] for n in common} | {n: p.deviation for n, p in held.items()},
        correlation=correlation.tolist(),
        poorest={n: uncertainty.poorest[n] for n in common} | dict.fromkeys(held, 0.0),
        ranges={n: uncertainty.ranges[n] for n in common} | {n: ranges[n].upper - ranges[n].lower for n in held},
        left_out={},  # A trial that is left out has no values of its own.
    )
    return replace(found, uncertainty=changed, own_deviation={name: uncertainty.deviation[name] for name in own})


def _with_first_frames(
    found: Identification,
    simulator: Simulator,
    motions: ObservedMotions,
    name: str,
    ranges: Mapping[str, Bounds],
    max_evaluations: int,
) -> Identification:
    """Adds a trial's own values from its first frames (`ReleaseSettings.window`), and their deviations.

    Everything else is as identified. Values that these frames do not show stay near the mean of their prior.
    """
    bounds, known = {own_name(n, name): limits for n, limits in ranges.items()}, {**found.parameters, **found.own}
    window, delay, shares = motions.release.window, motions.release.delay, independent(motions.dataset.labels)
    try:
        replays = motions.replays(simulator, [name], found)
        misfit = Misfit(replays, bounds, window, known=known, delay=delay, shares=shares)
        guess = {own: _guess(own, limits, known) for own, limits in bounds.items()}
        result = search_parameters(misfit, [guess], max_evaluations)
    except ConvergenceError as error:
        log.warning("identify: the first frames of %s show none of its own values: %s", name, error)
        return found
    deviation = {} if result.uncertainty is None else result.uncertainty.deviation
    own, deviations = {**found.own, **result.parameters}, {**found.own_deviation, **deviation}
    return replace(found, own=own, own_deviation=deviations)


@contextmanager
def shown(title: str, most: int) -> Iterator[Report | None]:
    """Shows the progress of searches with at most so many evaluations, which the yielded function reports."""
    if not title:
        yield None
        return
    with Progress(title, most, "evaluations at most") as progress:

        def report(start: int, loss: float, values: Mapping[str, float]) -> None:
            name, value = next(iter(values.items()))
            progress.advance(1, start=start, loss=f"{loss:.3g}", **{name: f"{value:.4g}"})

        yield report


def refined_searches(
    begin: Callable[[Identification | None], tuple[Misfit, Sequence[Mapping[str, float]]]],
    search: Callable[..., Identification],
    released: bool,
    once: Once,
) -> list[Identification]:
    """Returns the results of a search, and of those with releases that are estimated again with the last result.

    They end when the loss changes by less than 2 %.

    Args:
        begin: returns the misfit and the starts of the search that follows a result; None at first.
        search: `search_parameters`.
        released: whether there are released trials.
        once: see `identify`.
    """
    results = list[Identification]()
    for number in range(1 + (_MOST_AGAIN if released else 0)):
        before, last = results[-1] if results else None, not released or number == _MOST_AGAIN
        ends = partial(_ends, last, None if before is None else before.loss)

        def work(before: Identification | None = before, ends: IsLast = ends) -> dict[str, Any]:
            return asdict(search(*begin(before), is_last=ends))

        results.append(Identification.from_plain(once(str(number), work)))
        if ends(results[-1].loss):
            break
    return results


def _ends(last: bool, before: float | None, after: float) -> bool:
    """Whether a search is the last, by its loss and that of the search before."""
    return last or (before is not None and _UNCHANGED < after / max(before, 1e-300) < 1.0 / _UNCHANGED)


def first_points(
    misfit: BoundedMisfit, first: Mapping[str, float], count: int = 1, candidates: int = 0, seed: int = 0
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
        tolerance: relative decrease of the loss below which the search ends; a step from which the linearisation
            expects less is not evaluated.
        report: called after every evaluation with the start's number, the loss (infinite where the simulation failed)
            and the parameters.
        is_last: whether no other search follows one with a loss; if not, placement and uncertainty are left out.
        labels: names of the markers, if their places are uncertain.

    Raises:
        ConvergenceError: the simulation fails at every start.
    """
    attempts = [_descend(misfit, k, start, max_evaluations, tolerance, report) for k, start in enumerate(starts)]
    good = [attempt for attempt in attempts if attempt.loss < math.inf]
    if not good:
        reason = misfit.failure or "motions that are not finite"
        raise ConvergenceError(f"the simulation failed at every start of the identification: {reason}", None, None)
    best = min(good, key=lambda attempt: attempt.loss)
    unit, misfit.prior_weight, last = best.unit, best.prior_weight, is_last(best.loss)
    identified = Identification(
        parameters=misfit.from_unit(unit),
        loss=best.loss,
        history=[attempt.history for attempt in attempts],
        at_bounds=tuple(n for n, u in zip(misfit.bounds, unit, strict=True) if min(u, 1.0 - u) < _AT_A_BOUND),
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
        return replace(end, value=torch.full_like(end.value, torch.inf)) if problem.differentiates is False else end

    misfit.prior_weight = 0.0
    misfit.forget()
    misfit.update_prior_weight(first)
    point = minimum(torch.as_tensor(first)[None], max_evaluations)
    left = max_evaluations - len(history)
    refines = left > 1 and math.isfinite(float(point.value))
    if refines and not _SIMILAR < misfit.update_prior_weight(point.x[0].numpy()) < 1.0 / _SIMILAR:
        refined = minimum(point.x, left)
        point = refined if math.isfinite(float(refined.value)) else point
    return _Attempt(point.x[0].numpy(), float(point.value), history, misfit.prior_weight)
