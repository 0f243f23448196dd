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
from ..learning.parameters import first_guesses
from ..learning.placement import Accuracy
from ..learning.replay import Replay, Start
from .files import IDENTIFICATION
from .scene import MODELS, Scene
from .trials import evenly

ELASTIC = ("youngs_modulus", "poissons_ratio")
_LANDSCAPE = "landscape"
_RANGE = ("lower", "upper", "logarithmic")
_AT_ONCE = 4  # points of the landscape

Replays = Sequence[tuple[Replay, Start]]


def identify(context: StageContext) -> None:
    """Writes identification.json: the configured parameters, E and nu alone where that is asked for, and the landscape.

    E and nu alone belong to the uncorrected simulator, with its integrator, as published; the parameters belong to the
    identified one. A few of the training trials, and the beginning of each, may tell enough: ``identify.trials`` and
    ``identify.seconds``. What an interrupted run has finished is not done again: starts, searches, points.
    """
    settings = context.settings
    config = settings["identify"]
    scene = Scene(settings, context.run_dir)
    names = settings["split"]["train"]
    names = evenly(names, config["trials"]) if config["trials"] is not None else names
    searches = {"sysid": config["parameters"], "sysid_elastic": config.get("elastic") or {}}
    ranges = {model: {k: bounds_of(b) for k, b in each.items() if b} for model, each in searches.items() if each}
    kinds = {model: MODELS[model][0] for model in ranges}
    evaluations = len(ranges) * config["starts"] * config["max_evaluations"]
    kept = {part: _Kept(context, part) for part in (*ranges, _LANDSCAPE)}
    done = sum(kept[model].evaluations for model in ranges)
    found, replays = {}, {}
    with Progress(context.name, evaluations, "evaluations at most", done) as progress:
        for model, bounds in ranges.items():
            replays[model] = scene.replays(scene.simulator(kinds[model]), names)
            placed = _placement(scene) if model == "sysid" else {}
            identifier = Identifier(replays[model], bounds, _seconds(settings, replays[model]), **placed)
            found[model] = _search(settings, identifier, kept[model], progress)
    if config["grid"]:
        seconds = _seconds(settings, replays["sysid"]) if config["seconds"] is not None else None
        axes = {name: Bounds(*(grid[key] for key in _RANGE)) for name, grid in config["grid"].items()}
        others = {name: bounds for name, bounds in ranges["sysid"].items() if name not in axes}
        identifier = Identifier(replays["sysid"], {**axes, **others}, seconds, **_placement(scene))
        counts = {name: int(grid["points"]) for name, grid in config["grid"].items()}
        found[_LANDSCAPE] = _landscape(identifier, counts, found["sysid"]["parameters"], kept[_LANDSCAPE])
    write_json(context.run_dir / IDENTIFICATION, found)
    for each in kept.values():
        forget_checkpoint(each.path)


def bounds_of(settings: Mapping[str, Any]) -> Bounds:
    """A range as it is configured.

    Raises:
        InputError: an empty range, or a prior outside of it.
    """
    prior = settings.get("prior")
    own = {key: settings[key] for key in _RANGE if key in settings}
    return Bounds(**own, prior=None if prior is None else Prior(**prior))


def _placement(scene: Scene) -> dict[str, Any]:
    """What an `Identifier` is told of how well it is known where markers sit; nothing where that is not asked."""
    wanted = scene.config["identify"].get("placement")
    if wanted is None:
        return {}
    turn = wanted.get("turn")
    accuracy = Accuracy(wanted.get("markers"), wanted.get("shift"), None if turn is None else math.radians(turn))
    markers = scene.config["markers"]
    standing = [*markers["reference"].values()] or [*markers["tracked"].values()]
    return {"accuracy": accuracy, "labels": scene.dataset.labels, "centre": np.mean(standing, axis=0).tolist()}


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


def _seconds(settings: Mapping[str, Any], replays: Replays) -> float | None:
    """How much of each trial counts [s]; None for all of it."""
    limits = [settings["data"].get("seconds"), settings["identify"]["seconds"]]
    fraction = settings["data"].get("train_fraction", 1.0)
    if fraction < 1.0:
        limits.append(fraction * max(float(replay.trials.times.max()) for replay, _ in replays))
    return min((each for each in limits if each is not None), default=None)


def _search(settings: Mapping[str, Any], identifier: Identifier, kept: _Kept, progress: Progress) -> dict[str, Any]:
    """The `Identification` of a model, as plain data; goes on from where an interrupted one ended."""
    if "found" in kept.content:
        return dict(kept.content["found"])
    config, bounds = settings["identify"], identifier.bounds
    if "starts" not in kept.content:
        guess = first_guesses(settings, bounds)
        starts = identifier.starts(guess, config["starts"], config["candidates"], settings["seed"])
        kept.keep(starts=starts, attempts=[])

    def report(start: int, loss: float, values: Mapping[str, float]) -> None:
        progress.advance(1, start=start, loss=f"{loss:.3g}", E=f"{values.get('youngs_modulus', 0.0) / 1e3:.4g} kPa")

    def keep(attempts: list[Any]) -> None:
        kept.keep(attempts=attempts)

    starts, finished, most = kept.content["starts"], kept.content["attempts"], config["max_evaluations"]
    found = identifier.run(starts, most, report, finished, keep, config["tolerance"])
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
