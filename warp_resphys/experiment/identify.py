"""Stage: identifies the physical parameters from the training trials."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import torch

from ..data.rigid_bodies import corners_of, independent
from ..io.errors import ConvergenceError
from ..io.files import resume_checkpoint, write_checkpoint, write_json
from ..io.progress import Progress
from ..io.stages import StageContext
from ..learning.bounds import Bounds, Prior
from ..learning.identification import Identifier, ParameterSearch
from ..learning.parameters import configured_parameters, own_name, split_name
from ..learning.placement import Accuracy
from ..learning.replay import Replay, Start
from ..settings.learning import IdentifySettings, RangeSettings
from ..settings.stages import IdentifyStage
from .experiment import MODELS, Experiment
from .files import IDENTIFICATION, RESTING
from .trials import evenly

log = logging.getLogger(__name__)

ELASTIC = ("youngs_modulus", "poissons_ratio")
_MOST_AGAIN, _UNCHANGED = 3, 0.98  # estimations of a release after the first; ratio of losses at which they end

Replays = Sequence[tuple[Replay, Start]]


def identify(context: StageContext) -> None:
    """Writes identification.json: all configured parameters, and optionally E and nu alone.

    E and nu alone are identified with the integrator of the uncorrected simulator, as published; all parameters with
    the identified simulator. ``identify.trials`` and ``identify.seconds`` restrict the number and length of the
    training trials. Releases are estimated again with the identified parameters, which are then refined. An interrupted
    run keeps its finished searches.
    """
    settings: IdentifyStage = context.settings
    wanted, names = settings.identify, settings.split.train
    experiment = Experiment(settings, context.run_dir)
    names = names if wanted.trials is None else tuple(evenly(names, wanted.trials))
    searches = {"sysid": wanted.parameters, "sysid_elastic": wanted.elastic or {}}
    ranges = {model: _bounds(experiment, search, names) for model, search in searches.items() if search}
    kinds = {model: MODELS[model][0] for model in ranges}
    released = any(experiment.begins(name) == "released" for name in names)
    evaluations = len(ranges) * (wanted.starts + (_MOST_AGAIN if released else 0)) * wanted.max_evaluations
    parts = (*ranges, *(again for model in ranges for again in again_of(model)))
    kept = {part: Checkpoint(context, part) for part in parts}
    done = sum(part.evaluations for part in kept.values())
    identified, replays = {}, {}
    with Progress(context.name, evaluations, "evaluations at most", done) as progress:
        for model, bounds in ranges.items():
            replays[model] = experiment.replays(experiment.simulator(kinds[model]), names)
            nuisances = _nuisances(experiment) | (_placement(experiment) if model == "sysid" else {})
            identifier = Identifier(replays[model], bounds, _seconds(settings, replays[model]), **nuisances)
            known = configured_parameters(experiment.simulator(kinds[model]), [split_name(name)[0] for name in bounds])
            guess = {name: _guess(name, limits, {**known, **wanted.first_guess}) for name, limits in bounds.items()}
            arguments = wanted, settings.seed, identifier, guess, kept[model], progress, wanted.starts
            found = search_parameters(*arguments, is_last=lambda loss: not released)
            history = [[*records] for records in found["history"]]
            best = min((records for records in history if records), key=lambda own: min(one["loss"] for one in own))
            for again in again_of(model) if released else ():  # The starts were estimated with other parameters.
                values, before = found["parameters"], found["loss"]
                is_last = partial(_ends, before, again == again_of(model)[-1])
                replays[model] = [(own, experiment.start(own, parameters=values)) for own, _ in replays[model]]
                identifier = Identifier(replays[model], bounds, _seconds(settings, replays[model]), **nuisances)
                arguments = wanted, settings.seed, identifier, values, kept[again], progress, 1
                found = search_parameters(*arguments, is_last=is_last)
                best.extend(found["history"][0])
                if is_last(found["loss"]):
                    break
            if sessions := (found["placement"] or {}).get("sessions"):
                like = torch.zeros(len(experiment.dataset.labels), 3, dtype=torch.float64)
                expected = nuisances["accuracy"].of_new_session(like, len(sessions)).tolist()
                found = {**found, "placement": {**found["placement"], "new_session": expected}}
            identified[model] = _separated(found, searches[model]) | {"history": history, "first_guess": guess}
    write_json(context.run_dir / IDENTIFICATION, identified)
    for model in ranges:  # First frames are compared with the identified simulator, as later stages read it.
        values, deviations = _of_first_frames(experiment, model, searches[model], names)
        if values:
            own = {"own": identified[model]["own"] | values}
            own["own_deviation"] = identified[model].get("own_deviation", {}) | deviations
            identified[model] = identified[model] | own
    write_json(context.run_dir / IDENTIFICATION, identified)
    for part in kept.values():
        part.path.unlink(missing_ok=True)


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
    assert isinstance(settings, IdentifyStage)
    wanted = {name: bounds_of(limits) for name, limits in search.items() if limits.per == "trial"}
    names = [name for name in settings.split.names if name not in learned and experiment.begins(name) in RESTING]
    shared = experiment.identification(model)
    known = {**shared["parameters"], **shared.get("own", {})}
    for name in names if wanted else ():
        bounds = {own_name(parameter, name): limits for parameter, limits in wanted.items()}
        guess = {own: _guess(own, limits, known) for own, limits in bounds.items()}
        try:
            replays = experiment.replays(experiment.simulator(MODELS[model][0]), [name], model)
            identifier = Identifier(replays, bounds, settings.release.window, known=known, **_nuisances(experiment))
            result = identifier.run([guess], settings.identify.max_evaluations)
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


def _nuisances(experiment: Experiment) -> dict[str, Any]:
    """Arguments of an `Identifier`: delays of the trials, and which observed coordinates are independent."""
    settings = experiment.settings
    assert isinstance(settings, IdentifyStage)
    return {"delay": settings.release.delay, "shares": independent(experiment.dataset.labels)}


def _placement(experiment: Experiment) -> dict[str, Any]:
    """Arguments of an `Identifier` to estimate the placement of the markers; empty if it is not to be estimated."""
    settings = experiment.settings
    assert isinstance(settings, IdentifyStage)
    wanted, markers = settings.identify.placement, settings.markers
    if wanted is None or markers is None:
        return {}
    turn, mounting = (None if x is None else math.radians(x) for x in (wanted.turn, wanted.mounting))
    standing = [*markers.reference.values()] or [*markers.tracked.values()]
    labels, bound = experiment.dataset.labels, experiment.dataset.bound
    assert bound is not None
    bodies = tuple((own.start, bound[own] - bound[own].mean(axis=0)) for own in corners_of(labels).values())
    accuracy = Accuracy(wanted.markers, wanted.shift, turn, wanted.between_sessions, mounting, bodies)
    return {"accuracy": accuracy, "labels": labels, "centre": np.mean(standing, axis=0).tolist()}


def again_of(key: str) -> list[str]:
    """Keys of the searches after a release was estimated again."""
    return [f"{key}_again_{number}" for number in range(1, _MOST_AGAIN + 1)]


def changes(before: float, after: float) -> bool:
    """Whether a loss still changes from one estimation of a release to the next."""
    return not _UNCHANGED < after / max(before, 1e-300) < 1.0 / _UNCHANGED


def _ends(before: float, is_last: bool, after: float) -> bool:
    """Whether no estimation of a release follows, after the last one or where the loss does not change any more."""
    return is_last or not changes(before, after)


class Checkpoint:
    """Checkpoint of the finished work of a part, deleted at the end of the stage; ignored if the settings changed."""

    def __init__(self, context: StageContext, part: str) -> None:
        self.path, self._fingerprint = context.run_dir / f"identify_{part}.safetensors", context.fingerprint
        checkpoint = resume_checkpoint(self.path, "identify", context.fingerprint)
        self.content: dict[str, Any] = {} if checkpoint is None else checkpoint[1]

    def keep(self, **content: Any) -> None:
        """Adds finished work."""
        self.content |= {"fingerprint": self._fingerprint, **content}
        write_checkpoint(self.path, "identify", {}, self.content)

    @property
    def evaluations(self) -> int:
        """Number of evaluations of a finished search."""
        return sum(map(len, self.content["found"]["history"])) if "found" in self.content else 0


def _seconds(settings: IdentifyStage, replays: Replays) -> float | None:
    """Duration from the beginning of each trial that is used [s]; None for whole trials."""
    limits, fraction = [settings.trial_seconds, settings.identify.seconds], settings.train_fraction
    if fraction < 1.0:
        limits.append(fraction * max(float(replay.trials.times.max()) for replay, _ in replays))
    return min((limit for limit in limits if limit is not None), default=None)


def search_parameters(
    wanted: IdentifySettings,
    seed: int,
    search: ParameterSearch,
    guess: Mapping[str, float],
    kept: Checkpoint,
    progress: Progress,
    count: int,
    is_last: Callable[[float], bool] = lambda loss: True,
) -> dict[str, Any]:
    """Returns the `Identification` of a search, as plain data, unless it was finished before.

    Args:
        wanted: its settings.
        seed: of the random candidates.
        search: the search.
        guess: first guess of each parameter.
        kept: finished search.
        progress: advanced by every evaluation.
        count: number of starts.
        is_last: see `ParameterSearch.run`.

    Raises:
        ConvergenceError: the simulation fails at every start.
    """
    if "found" in kept.content:
        return dict(kept.content["found"])

    def report(start: int, loss: float, values: Mapping[str, float]) -> None:
        name, value = next(iter(values.items()))
        progress.advance(1, start=start, loss=f"{loss:.3g}", **{name: f"{value:.4g}"})

    starts = search.starts(guess, count, wanted.candidates, seed)
    found = search.run(starts, wanted.max_evaluations, report, wanted.tolerance, is_last)
    kept.keep(found=asdict(found))
    return dict(kept.content["found"])
