"""Stage: identifies the physical parameters from the training trials."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from ..data.rigid_bodies import corners_of, independent
from ..data.trials import RESTING
from ..io.errors import ConvergenceError
from ..io.progress import Progress
from ..io.resuming import StageContext
from ..io.safe_files import resume_checkpoint, write_checkpoint, write_json
from ..learning.identification import ParameterSearch
from ..learning.misfit import Misfit
from ..learning.observed_motions import Identified
from ..learning.parameters import Bounds, Prior, configured_parameters, own_name, split_name
from ..learning.placement import Accuracy
from ..learning.replay import Replay, Start
from ..settings.learning import IdentifySettings, LawSettings, RangeSettings
from ..settings.stage_keys import StageSettings
from .experiment import MODELS, Experiment
from .files import IDENTIFICATION
from .splits import evenly

log = logging.getLogger(__name__)

ELASTIC = ("youngs_modulus", "poissons_ratio")
_MOST_AGAIN, _UNCHANGED = 3, 0.98  # estimations of a release after the first; ratio of losses at which they end

Replays = Sequence[tuple[Replay, Start]]
Found = dict[str, Any]  # an `Identification` as plain data
IsLast = Callable[[float], bool]


def identify(context: StageContext) -> None:
    """Writes identification.json: all configured parameters, and optionally E and nu alone.

    E and nu alone are identified with the integrator of the uncorrected simulator, as published; all parameters with
    the identified simulator. ``identify.trials`` and ``identify.seconds`` restrict the number and length of the
    training trials. Releases are estimated again with the identified parameters, which are then refined. An interrupted
    run keeps its finished searches.
    """
    settings: StageSettings = context.settings
    wanted, names = settings.identify, settings.split.train
    experiment, kept = Experiment(settings, context.run_dir), Checkpoint(context)
    names = names if wanted.trials is None else tuple(evenly(names, wanted.trials))
    searches = {"sysid": wanted.parameters, "sysid_elastic": wanted.elastic or {}}
    searches = {model: search for model, search in searches.items() if search}
    released = any(experiment.dataset.begin_of(name) == "released" for name in names)
    evaluations = len(searches) * (wanted.starts + (_MOST_AGAIN if released else 0)) * wanted.max_evaluations
    with Progress(context.name, evaluations, "evaluations at most", kept.evaluations) as progress:
        identified = {
            model: _identified(experiment, model, search, names, released, kept, progress)
            for model, search in searches.items()
        }
    write_json(context.run_dir / IDENTIFICATION, identified)
    for (
        model,
        search,
    ) in searches.items():  # First frames are compared with the identified simulator, as it was written.
        values, deviations = _of_first_frames(experiment, model, search, names)
        if values:
            own = {"own": identified[model]["own"] | values}
            own["own_deviation"] = identified[model].get("own_deviation", {}) | deviations
            identified[model] = identified[model] | own
    write_json(context.run_dir / IDENTIFICATION, identified)
    kept.path.unlink(missing_ok=True)


def _identified(
    experiment: Experiment,
    model: str,
    search: Mapping[str, RangeSettings],
    names: Sequence[str],
    released: bool,
    kept: "Checkpoint",
    progress: Progress,
) -> dict[str, Any]:
    """Identifies the parameters of a model; returns its content of identification.json."""
    settings = experiment.settings
    wanted, simulator = settings.identify, experiment.simulator(MODELS[model][0])
    bounds, replays = _bounds(experiment, search, names), experiment.motions.replays(simulator, names)
    nuisances = _nuisances(experiment, placed=model == "sysid")
    known = configured_parameters(simulator, [split_name(name)[0] for name in bounds])
    guess = {name: _guess(name, limits, {**known, **wanted.first_guess}) for name, limits in bounds.items()}

    def searched(number: int, before: Found | None, is_last: IsLast) -> Found:
        def work() -> Found:
            first, begins, many = guess, replays, dict[str, int]()
            if before is None:
                many = {"count": wanted.starts, "candidates": wanted.candidates, "seed": settings.seed}
            else:
                first = before["parameters"]
                begins = [(own, experiment.motions.start(own, Identified(first))) for own, _ in replays]
            misfit = Misfit(begins, bounds, _seconds(settings, begins), **nuisances)
            return search_parameters(ParameterSearch(misfit), first, wanted, progress, is_last, **many)

        return dict(kept.once(f"{model} {number}", work))

    rounds = refined_searches(searched, released)
    found, history = rounds[-1], [[*records] for records in rounds[0]["history"]]
    best = min((records for records in history if records), key=lambda own: min(one["loss"] for one in own))
    best.extend(record for own in rounds[1:] for record in own["history"][0])
    if sessions := (found["placement"] or {}).get("sessions"):
        like = torch.zeros(len(experiment.dataset.labels), 3, dtype=torch.float64)
        expected = nuisances["accuracy"].of_new_session(like, len(sessions)).tolist()
        found = {**found, "placement": {**found["placement"], "new_session": expected}}
    return _separated(found, search) | {"history": history, "first_guess": guess}


def _bounds(experiment: Experiment, search: Mapping[str, RangeSettings], names: Sequence[str]) -> dict[str, Bounds]:
    """Bounds of all parameters, and of the values of trials and sessions."""
    owners = {"session": list(dict.fromkeys(map(experiment.dataset.session, names))), "trial": [*names]}
    return {
        own: bounds_of(limits)
        for name, limits in search.items()
        for own in ([name] if limits.per == "all" else [own_name(name, owner) for owner in owners[limits.per]])
    }


def _guess(name: str, bounds: Bounds, known: Mapping[str, float]) -> float:
    """First guess of a parameter; the mean of the prior for the value of a trial."""
    parameter, owner = split_name(name)
    return bounds.prior.mean if owner and bounds.prior is not None else known[parameter]


def _separated(found: Mapping[str, Any], search: Mapping[str, RangeSettings]) -> dict[str, Any]:
    """An identification with the values of trials and sessions in `own`, apart from those of all trials.

    Other trials have the mean of the prior, and its deviation as their uncertainty, before `_of_first_frames`.
    """
    held = {name: limits.prior for name, limits in search.items() if limits.per != "all" and limits.prior is not None}
    if not held:
        return dict(found)
    names = [*found["parameters"]]
    common = [name for name in names if not split_name(name)[1]]
    own = {name: value for name, value in found["parameters"].items() if split_name(name)[1]}
    parameters = {name: found["parameters"][name] for name in common}
    result = {**found, "parameters": parameters | {n: p.mean for n, p in held.items()}, "own": own}
    if (uncertainty := found["uncertainty"]) is None:
        return result
    rows = [names.index(name) for name in common]
    correlation = np.eye(len(common) + len(held))
    correlation[: len(rows), : len(rows)] = np.array(uncertainty["correlation"])[np.ix_(rows, rows)]
    deviation = {name: uncertainty["deviation"][name] for name in common} | {n: p.deviation for n, p in held.items()}
    poorest = {name: uncertainty["poorest"][name] for name in common} | dict.fromkeys(held, 0.0)
    ranges = {n: uncertainty["ranges"][n] for n in common} | {n: search[n].upper - search[n].lower for n in held}
    changed = {"deviation": deviation, "correlation": correlation.tolist(), "poorest": poorest, "ranges": ranges}
    changed |= {"left_out": {}}  # A trial that is left out has no values of its own.
    return result | {
        "uncertainty": {**uncertainty, **changed},
        "own_deviation": {name: uncertainty["deviation"][name] for name in own},
    }


def _of_first_frames(
    experiment: Experiment, model: str, search: Mapping[str, RangeSettings], learned: Sequence[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Own values of validation and test trials, from their first frames (`release.window`), and their deviations.

    Everything else is as identified. Values that these frames do not show stay near the mean of their prior.
    """
    settings, values, deviations = experiment.settings, dict[str, float](), dict[str, float]()
    wanted = {name: bounds_of(limits) for name, limits in search.items() if limits.per == "trial"}
    names = [
        name for name in settings.split.names if name not in learned and experiment.dataset.begin_of(name) in RESTING
    ]
    shared = experiment.identification(model)
    known = {**shared["parameters"], **shared.get("own", {})}
    for name in names if wanted else ():
        bounds = {own_name(parameter, name): limits for parameter, limits in wanted.items()}
        guess = {own: _guess(own, limits, known) for own, limits in bounds.items()}
        try:
            simulator = experiment.simulator(MODELS[model][0])
            replays = experiment.motions.replays(simulator, [name], experiment.identified(model))
            misfit = Misfit(replays, bounds, settings.release.window, known=known, **_nuisances(experiment))
            result = ParameterSearch(misfit).run([guess], settings.identify.max_evaluations)
        except ConvergenceError as error:
            log.warning("identify: the first frames of %s show none of its own values: %s", name, error)
            continue
        values |= result.parameters
        deviations |= {} if result.uncertainty is None else result.uncertainty.deviation
    return values, deviations


def bounds_of(settings: RangeSettings) -> Bounds:
    """Bounds of a parameter from its settings."""
    prior = None if settings.prior is None else Prior(**dict(settings.prior))
    return Bounds(settings.lower, settings.upper, settings.logarithmic, prior)


def _nuisances(experiment: Experiment, placed: bool = False) -> dict[str, Any]:
    """Arguments of a `Misfit`: delays, which observed coordinates are independent, and how markers may be placed."""
    settings = experiment.settings
    labels, bound = experiment.dataset.labels, experiment.dataset.bound
    result: dict[str, Any] = {"delay": settings.release.delay, "shares": independent(labels)}
    wanted, markers = settings.identify.placement, settings.markers
    if not placed or wanted is None or markers is None:
        return result
    turn, mounting = (None if x is None else math.radians(x) for x in (wanted.turn, wanted.mounting))
    standing = [*markers.reference.values()] or [*markers.tracked.values()]
    assert bound is not None
    bodies = tuple((own.start, bound[own] - bound[own].mean(axis=0)) for own in corners_of(labels).values())
    accuracy = Accuracy(wanted.markers, wanted.shift, turn, wanted.between_sessions, mounting, bodies)
    return result | {"accuracy": accuracy, "labels": labels, "centre": np.mean(standing, axis=0).tolist()}


def refined_searches(search: Callable[[int, Found | None, IsLast], Found], released: bool) -> list[Found]:
    """Returns the results of a search, and of those with releases that are estimated again with the last result.

    They end when the loss changes by less than 2 %.

    Args:
        search: of its number, the last result, None at first, and whether it is the last one with some loss.
        released: whether there are released trials.
    """
    results = [search(0, None, lambda loss: not released)]
    for number in range(1, _MOST_AGAIN + 1) if released else ():
        before = max(results[-1]["loss"], 1e-300)

        def ends(after: float, before: float = before, number: int = number) -> bool:
            return number == _MOST_AGAIN or _UNCHANGED < after / before < 1.0 / _UNCHANGED

        results.append(search(number, results[-1], ends))
        if ends(results[-1]["loss"]):
            break
    return results


class Checkpoint:
    """Finished parts of the work of a stage, in a file that is ignored if the settings changed."""

    def __init__(self, context: StageContext) -> None:
        self.path, self._fingerprint = context.run_dir / f"{context.name}_parts.safetensors", context.fingerprint
        checkpoint = resume_checkpoint(self.path, "parts", context.fingerprint)
        self.parts: dict[str, Any] = {} if checkpoint is None else checkpoint[1]["parts"]

    def once(self, key: str, work: Callable[[], Any]) -> Any:
        """Returns the result of a part, as JSON data, which is worked on unless it was finished before."""
        if key not in self.parts:
            self.parts = {**self.parts, key: work()}
            write_checkpoint(self.path, "parts", {}, {"fingerprint": self._fingerprint, "parts": self.parts})
        return self.parts[key]

    @property
    def evaluations(self) -> int:
        """Number of evaluations of finished searches."""
        return sum(len(records) for found in self.parts.values() for records in found["history"])


def _seconds(settings: StageSettings, replays: Replays) -> float | None:
    """Duration from the beginning of each trial that is used [s]; None for whole trials."""
    limits, fraction = [settings.trial_seconds, settings.identify.seconds], settings.train_fraction
    if fraction < 1.0:
        limits.append(fraction * max(float(replay.trials.times.max()) for replay, _ in replays))
    return min((limit for limit in limits if limit is not None), default=None)


def search_parameters(
    search: ParameterSearch,
    guess: Mapping[str, float],
    wanted: IdentifySettings | LawSettings,
    progress: Progress,
    is_last: IsLast = lambda loss: True,
    count: int = 1,
    candidates: int = 0,
    seed: int = 0,
) -> Found:
    """Returns the `Identification` of a search, as plain data.

    Args:
        search: the search.
        guess: first guess of each parameter.
        wanted: evaluations and tolerance.
        progress: advanced by every evaluation.
        is_last: see `ParameterSearch.run`.
        count: number of starts.
        candidates: see `ParameterSearch.starts`.
        seed: of these.

    Raises:
        ConvergenceError: the simulation fails at every start.
    """

    def report(start: int, loss: float, values: Mapping[str, float]) -> None:
        name, value = next(iter(values.items()))
        progress.advance(1, start=start, loss=f"{loss:.3g}", **{name: f"{value:.4g}"})

    starts = search.starts(guess, count, candidates, seed)
    return asdict(search.run(starts, wanted.max_evaluations, report, wanted.tolerance, is_last))
