"""Stage: the physical parameters that explain the training trials."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ..io.files import write_json
from ..io.progress import Progress
from ..io.resumable import forget_checkpoint, keep_checkpoint, resume_checkpoint
from ..io.stages import StageContext
from ..learning.bounds import Bounds, Prior
from ..learning.identification import Identifier
from ..learning.parameters import configured_parameters
from ..learning.placement import Accuracy
from ..learning.replay import Replay, Start
from ..settings.learning import RangeSettings
from ..settings.stages import IdentifyStage
from .experiment import MODELS, Experiment
from .files import IDENTIFICATION
from .trials import evenly

ELASTIC = ("youngs_modulus", "poissons_ratio")
_LANDSCAPE = "landscape"
_AT_ONCE = 4  # points of the landscape

Replays = Sequence[tuple[Replay, Start]]


def identify(context: StageContext) -> None:
    """Writes identification.json: the configured parameters, E and nu alone where that is asked for, and the landscape.

    E and nu alone belong to the uncorrected simulator, with its integrator, as published; the parameters belong to the
    identified one. A few of the training trials, and the beginning of each, may tell enough: ``identify.trials`` and
    ``identify.seconds``. What an interrupted run has finished is not done again: starts, searches, points.
    """
    settings: IdentifyStage = context.settings
    wanted, names = settings.identify, settings.split.train
    experiment = Experiment(settings, context.run_dir)
    names = names if wanted.trials is None else tuple(evenly(names, wanted.trials))
    searches = {"sysid": wanted.parameters, "sysid_elastic": wanted.elastic or {}}
    ranges = {model: {name: bounds_of(each) for name, each in some.items()} for model, some in searches.items() if some}
    kinds = {model: MODELS[model][0] for model in ranges}
    evaluations = len(ranges) * wanted.starts * wanted.max_evaluations
    kept = {part: _Kept(context, part) for part in (*ranges, _LANDSCAPE)}
    done = sum(kept[model].evaluations for model in ranges)
    found, replays = {}, {}
    with Progress(context.name, evaluations, "evaluations at most", done) as progress:
        for model, bounds in ranges.items():
            replays[model] = experiment.replays(experiment.simulator(kinds[model]), names)
            placed = _placement(experiment) if model == "sysid" else {}
            identifier = Identifier(replays[model], bounds, _seconds(settings, replays[model]), **placed)
            guess = {**configured_parameters(experiment.simulator(kinds[model]), bounds), **wanted.first_guess}
            guess = {name: guess[name] for name in bounds}
            found[model] = _search(settings, identifier, guess, kept[model], progress) | {"first_guess": guess}
    if wanted.grid is not None:
        seconds = _seconds(settings, replays["sysid"]) if wanted.seconds is not None else None
        grid = {name: each for name, each in dict(wanted.grid).items() if each is not None}
        axes = {name: Bounds(each.lower, each.upper, each.logarithmic) for name, each in grid.items()}
        others = {name: bounds for name, bounds in ranges["sysid"].items() if name not in axes}
        identifier = Identifier(replays["sysid"], {**axes, **others}, seconds, **_placement(experiment))
        counts = {name: each.points for name, each in grid.items()}
        found[_LANDSCAPE] = _landscape(identifier, counts, found["sysid"]["parameters"], kept[_LANDSCAPE])
    write_json(context.run_dir / IDENTIFICATION, found)
    for each in kept.values():
        forget_checkpoint(each.path)


def bounds_of(settings: RangeSettings) -> Bounds:
    """A range as it is configured."""
    prior = None if settings.prior is None else Prior(**dict(settings.prior))
    return Bounds(settings.lower, settings.upper, settings.logarithmic, prior)


def _placement(experiment: Experiment) -> dict[str, Any]:
    """What an `Identifier` is told of how well it is known where markers sit; nothing where that is not asked."""
    settings = experiment.settings
    assert isinstance(settings, IdentifyStage)
    wanted, markers = settings.identify.placement, settings.markers
    if wanted is None or markers is None:
        return {}
    turn = None if wanted.turn is None else math.radians(wanted.turn)
    standing = [*markers.reference.values()] or [*markers.tracked.values()]
    accuracy = Accuracy(wanted.markers, wanted.shift, turn)
    return {"accuracy": accuracy, "labels": experiment.dataset.labels, "centre": np.mean(standing, axis=0).tolist()}


class _Kept:
    """What is finished of a part, in a file until the stage is done; nothing of a run with other settings."""

    def __init__(self, context: StageContext, part: str) -> None:
        self.path, self._fingerprint = context.run_dir / f"identify_{part}.safetensors", context.fingerprint
        found = resume_checkpoint(self.path, "identify", context.fingerprint)
        self.content: dict[str, Any] = {} if found is None else found[1]

    def keep(self, **content: Any) -> None:
        """Adds what is finished."""
        self.content |= {"fingerprint": self._fingerprint, **content}
        keep_checkpoint(self.path, "identify", {}, self.content)

    @property
    def evaluations(self) -> int:
        """How many went into the starts of a search that are finished."""
        return sum(len(attempt["history"]) for attempt in self.content.get("attempts", ()))


def _seconds(settings: IdentifyStage, replays: Replays) -> float | None:
    """How much of each trial counts [s]; None for all of it."""
    limits, fraction = [settings.trial_seconds, settings.identify.seconds], settings.train_fraction
    if fraction < 1.0:
        limits.append(fraction * max(float(replay.trials.times.max()) for replay, _ in replays))
    return min((each for each in limits if each is not None), default=None)


def _search(
    settings: IdentifyStage, identifier: Identifier, guess: Mapping[str, float], kept: _Kept, progress: Progress
) -> dict[str, Any]:
    """The `Identification` of a model from a first guess, as plain data; goes on where an interrupted one ended."""
    if "found" in kept.content:
        return dict(kept.content["found"])
    wanted = settings.identify
    if "starts" not in kept.content:
        starts = identifier.starts(guess, wanted.starts, wanted.candidates, settings.seed)
        kept.keep(starts=starts, attempts=[])

    def report(start: int, loss: float, values: Mapping[str, float]) -> None:
        name, value = next(iter(values.items()))
        progress.advance(1, start=start, loss=f"{loss:.3g}", **{name: f"{value:.4g}"})

    def keep(attempts: list[Any]) -> None:
        kept.keep(attempts=attempts)

    starts, finished, most = kept.content["starts"], kept.content["attempts"], wanted.max_evaluations
    found = identifier.run(starts, most, report, finished, keep, wanted.tolerance)
    kept.keep(found=asdict(found))
    return dict(kept.content["found"])


def _landscape(
    identifier: Identifier, counts: Mapping[str, int], found: Mapping[str, float], kept: _Kept
) -> dict[str, Any]:
    """Losses around the identified parameters, at so many points of the ranges of some of them."""
    finished = kept.content.get("losses", [])
    with Progress("identify: landscape", math.prod(counts.values()), "points", len(finished)) as progress:

        def report(losses: list[float]) -> None:
            kept.keep(losses=losses)
            progress.advance(len(losses) - progress.done)

        losses = identifier.grid(counts, found, _AT_ONCE, finished, report)
    ticks = {name: identifier.ticks(name, count).tolist() for name, count in counts.items()}
    return {**ticks, "loss": losses.tolist()}
