"""System identification: the physical parameters with
which a simulator comes closest to observed motions.

A parameter may have a value for each trial or session, near the mean of a prior. Those of a test
trial, and of a new session, follow from their first frames. Marker places on the body, the frame of
the recordings and delays of inputs are fitted with the parameters (`nuisances`).
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from statistics import fmean

import numpy as np
import torch

from ...core.dynamics.simulator import Simulator
from ...data.rigid_bodies import independent
from ...data.trials import RELEASED, RESTING, Trials
from ...io.errors import ConvergenceError, InputError, checks_types, listed, naming
from ...io.parts import Checkpoint
from ...io.settings import parse
from ...settings.learning import Bounds, IdentifySettings
from ..observed_motions import ObservedMotions
from ..parameters import (
    Limits,
    by_part,
    check_names,
    check_ranges,
    configured_parameters,
    identifiable_parameters,
    ranges_of,
    split_name,
    value_name,
)
from ..placement import Accuracy, PlainPlacements
from ..replay import Replay
from ..start import Start
from .misfit import Misfit
from .search import Identification, Searches, first_points, refined_searches, search_parameters

log = logging.getLogger(__name__)


@checks_types
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
    kept: str | Path | None = None,
) -> Identification:
    """Finds the parameters with which a simulator comes closest to observed motions.

    A parameter with ``per`` part has a value for each chamber, tendon or muscle, such as
    ``pressure_factor_1``; with ``per`` trial or session it has one for each, near the mean of its
    prior; with ``("part", "session")``, each part in each session. Values of held-out trials whose
    motion inputs begin, and of a session of which all trials are held out, follow from their first
    frames (`ReleaseSettings.window`), which then count in no error.

    Args:
        simulator: gives all other parameters.
        motions: observed states or markers.
        parameters: range of every parameter to identify, by a name of `Replay.parameter_names`, in
            its unit. A pair of positive numbers is searched on a logarithmic scale.
        first_guess: start of the search, which is brought into the ranges; the simulator's own
            values where left out.
        names: trials to identify from; all by default.
        held_out: other trials, whose own values, and those of their session, follow from their
            first frames.
        accuracy: of marker places and the recording's frame, which are identified; None: they are
            exact.
        seconds: duration of each motion that is used [s]; None for the part that `motions` learns
            from.
        starts: number of searches; those after the first start at the best of random candidates.
        candidates: number of these; four times the starts by default.
        max_evaluations: of the loss and its gradient, for each start.
        tolerance: relative decrease of the loss below which a search ends.
        seed: of the random candidates.
        kept: file of the finished searches, from which an interrupted identification goes on; it is
            not used if anything that they depend on has changed. None: nothing is kept.

    Raises:
        InputError: an unknown parameter, an empty range, a number out of range, a motion in which
            nothing moves, or first frames without a marker.
        ConvergenceError: the simulation fails at every start.
    """
    trials = motions.trials.chosen(names)
    motions.trials.rows(held_out)
    wanted, identifiable = ranges_of(parameters), identifiable_parameters(simulator)
    check_ranges(
        simulator,
        wanted,
        identifiable,
        {name: motions.trials.session(name) for name in (*trials, *held_out)},
    )
    ranges = by_part(simulator, wanted, wanted)
    shown_first = _shown_first(motions, trials, held_out, ranges)
    with naming("first_guess: "):
        check_names(first_guess or {}, identifiable)
    many = 4 * starts if candidates is None else candidates
    numbers = {
        "starts": starts,
        "candidates": many,
        "max_evaluations": max_evaluations,
        "tolerance": tolerance,
    }
    parse(
        IdentifySettings,
        {**numbers, "seconds": seconds, "first_guess": {**(first_guess or {})}},
        "identify",
    )
    bounds = _bounds_of_owners(ranges, motions.trials, trials)
    replays = motions.replays(simulator, trials)
    known = {**configured_parameters(simulator, [split_name(name)[0] for name in bounds])}
    known |= by_part(simulator, first_guess or {}, wanted)
    guess = {name: _guess(name, limits, known) for name, limits in bounds.items()}
    seconds = _learned(motions, replays, seconds)
    first_search = (guess, starts, many, seed)
    searched = (
        simulator,
        motions,
        bounds,
        trials,
        accuracy,
        seconds,
        first_search,
        max_evaluations,
        tolerance,
    )

    def begin(before: Identification | None) -> tuple[Misfit, list[dict[str, float]]]:
        again = (
            replays
            if before is None
            else [(replay, motions.start(replay, before)) for replay, _ in replays]
        )
        misfit = _misfit(motions, again, bounds, seconds, accuracy)
        first = first_search if before is None else (before.parameters,)
        return misfit, first_points(misfit, *first)

    searches = Searches(
        max_evaluations, tolerance, Checkpoint(kept, *searched), "identify", starts=starts
    )
    rounds = refined_searches(
        begin,
        searches,
        labels=motions.labels,
        released=RELEASED in map(motions.trials.begin_of, trials),
    )
    found = _separated(_joined(rounds, guess, accuracy), ranges)
    for some, limits in shown_first:
        found = _with_first_frames(found, simulator, motions, some, limits, max_evaluations)
    return found


def _misfit(
    motions: ObservedMotions,
    replays: Sequence[tuple[Replay, Start]],
    bounds: Mapping[str, Bounds],
    seconds: float | None,
    accuracy: Accuracy | None = None,
    known: Mapping[str, float] | None = None,
) -> Misfit:
    """Misfit to motions, whose inputs may be late."""
    shares = independent(motions.trials.labels)
    return Misfit(replays, bounds, seconds, accuracy, known, motions.release.delay, shares)


def _learned(
    motions: ObservedMotions, replays: Sequence[tuple[Replay, Start]], seconds: float | None
) -> float | None:
    """Duration from the beginning of each trial that is used [s]; None for whole trials."""
    if motions.train_fraction == 1.0:
        return seconds
    return min(
        motions.train_fraction * max(float(r.trials.times.max()) for r, _ in replays),
        seconds or math.inf,
    )


def _bounds_of_owners(
    ranges: Mapping[str, Bounds], trials: Trials, names: Sequence[str]
) -> dict[str, Bounds]:
    """Bounds of all parameters, and of the values of trials and sessions."""
    owners = {"session": list(dict.fromkeys(map(trials.session, names))), "trial": [*names]}
    found = dict[str, Bounds]()
    for name, limits in ranges.items():
        full_names = [name]
        if limits.owner:
            full_names = [value_name(name, owner) for owner in owners[limits.owner]]
        found |= dict.fromkeys(full_names, limits)
    return found


def _guess(name: str, bounds: Bounds, known: Mapping[str, float]) -> float:
    """First guess of a parameter; the mean of the prior for the value of a trial."""
    parameter, owner = split_name(name)
    return bounds.prior.mean if owner and bounds.prior is not None else known[parameter]


def _joined(
    rounds: Sequence[Identification], guess: Mapping[str, float], accuracy: Accuracy | None
) -> Identification:
    """The result of the last round with the history of all,
    and the expected places in a new session.
    """
    # Of the starts, of which the best continues.
    history = [[*records] for records in rounds[0].history]
    best = min(
        (records for records in history if records),
        key=lambda records: min(record["loss"] for record in records),
    )
    best.extend(chain.from_iterable(later.history[0] for later in rounds[1:]))
    found = replace(rounds[-1], history=history, first_guess=guess)
    if (
        found.placement is None
        or accuracy is None
        or not (sessions := found.placement.get("sessions"))
    ):
        return found
    like = torch.zeros(len(found.placement["offsets"]), 3, dtype=torch.float64)
    expected = accuracy.of_new_session(like, len(sessions)).tolist()
    placement: PlainPlacements = {**found.placement, "new_session": expected}
    return replace(found, placement=placement)


def _separated(found: Identification, ranges: Mapping[str, Bounds]) -> Identification:
    """An identification with the values of trials and sessions in `of_trials`,
    apart from those of all trials.

    The common value, which other trials and sessions have before `_with_first_frames`, is the mean
    of the prior for trials and of the identified ones for sessions; its uncertainty is the
    deviation of the prior.
    """
    priors = {name: one.prior for name, one in ranges.items() if one.owner and one.prior}
    if not priors:
        return found
    for name in (name for name in priors if ranges[name].owner == "session"):
        of_sessions = [
            value for full, value in found.parameters.items() if split_name(full)[0] == name
        ]
        priors[name] = priors[name].changed(mean=fmean(of_sessions))
    names = [*found.parameters]
    common = [name for name in names if not split_name(name)[1]]
    of_trials = {name: value for name, value in found.parameters.items() if split_name(name)[1]}
    parameters = {name: found.parameters[name] for name in common} | {
        name: p.mean for name, p in priors.items()
    }
    found = replace(found, parameters=parameters, of_trials=of_trials)
    uncertainty = found.uncertainty
    if uncertainty is None:
        return found
    rows = [names.index(name) for name in common]
    correlation = np.eye(len(common) + len(priors))
    correlation[: len(rows), : len(rows)] = np.array(uncertainty.correlation)[np.ix_(rows, rows)]
    changed = replace(
        uncertainty,
        deviation={n: uncertainty.deviation[n] for n in common}
        | {n: p.deviation for n, p in priors.items()},
        correlation=correlation.tolist(),
        poorest={n: uncertainty.poorest[n] for n in common} | dict.fromkeys(priors, 0.0),
        ranges={n: uncertainty.ranges[n] for n in common}
        | {n: ranges[n].upper - ranges[n].lower for n in priors},
        left_out={},  # A trial that is left out has no values of its own.
    )
    return replace(
        found,
        uncertainty=changed,
        of_trials_deviation={name: uncertainty.deviation[name] for name in of_trials},
    )


def _shown_first(
    motions: ObservedMotions,
    train: Sequence[str],
    held_out: Sequence[str],
    ranges: Mapping[str, Bounds],
) -> list[tuple[list[str], dict[str, Bounds]]]:
    """Held-out trials, all of a new session or one,
    and the bounds of the values that their first frames show.

    Raises:
        InputError: these frames show no marker.
    """
    trials = motions.trials
    seconds = motions.release.window
    groups = dict[tuple[str, str], list[str]]()
    known = {*map(trials.session, train)}
    for name in (name for name in held_out if trials.begin_of(name) in RESTING):
        session = trials.session(name)
        groups.setdefault((session, name if session in known else ""), []).append(name)
    shown = list[tuple[list[str], dict[str, Bounds]]]()
    for (session, trial), names in groups.items():
        owners = ("trial",) if trial else ("session", "trial")
        wanted = {name: limits for name, limits in ranges.items() if limits.owner in owners}
        if not wanted:
            continue
        times, observed = (x[trials.rows(names)] for x in (trials.times, trials.observed))
        frames = np.isfinite(observed).all(-1).any(-1) & (times <= seconds + 1e-9)
        seen = [name for name, of_trial in zip(names, frames, strict=True) if of_trial.any()]
        if not seen:
            of = "the trial" if trial else f"the session {session!r}"
            raise InputError(
                f"no marker is seen in the first {seconds:g} s of {listed(names)}, from which "
                f"values of {of} are estimated: raise release.window, "
                "or leave out what has no marker."
            )
        shown.append((seen, _bounds_of_owners(wanted, trials, seen)))
    return shown


def _with_first_frames(
    found: Identification,
    simulator: Simulator,
    motions: ObservedMotions,
    names: Sequence[str],
    bounds: Mapping[str, Bounds],
    max_evaluations: int,
) -> Identification:
    """Adds values of trials and their session from first frames (`ReleaseSettings.window`), and
    their deviations.

    Everything else is as identified. Values that these frames do not show stay near the common
    value.
    """
    known, window = {**found.parameters, **found.of_trials}, motions.release.window
    guess = {full: found.parameters[split_name(full)[0]] for full in bounds}
    bounds = {
        full: limits
        if limits.prior is None
        else limits.changed(prior=limits.prior.changed(mean=guess[full]))
        for full, limits in bounds.items()
    }
    try:
        replays = motions.replays(simulator, names, found)
        result = search_parameters(
            _misfit(motions, replays, bounds, window, known=known), [guess], max_evaluations
        )
    except ConvergenceError as error:
        log.warning(
            "identify: the first frames of %s show none of their values: %s", listed(names), error
        )
        return found
    owners = dict.fromkeys(split_name(full)[1] for full in bounds)
    first = {owner: dict.fromkeys([owner] if owner in names else names, window) for owner in owners}
    return replace(
        found,
        of_trials={**found.of_trials, **result.parameters},
        of_trials_deviation={**found.of_trials_deviation, **result.deviation},
        first_frames={**found.first_frames, **first},
    )
