"""Stage: the physical parameters that explain the training trials."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..io.files import write_json
from ..io.progress import Progress
from ..io.resumable import forget_checkpoint, keep_checkpoint, resume_checkpoint
from ..io.stages import StageContext
from ..learning.identification import Bounds, Identifier
from ..learning.replay import MASS_FACTOR, Replay, Start
from .files import IDENTIFICATION
from .scene import MODELS, Scene
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
    settings = context.settings
    config = settings["identify"]
    scene = Scene(settings, context.run_dir)
    names = settings["split"]["train"]
    names = evenly(names, config["trials"]) if config["trials"] is not None else names
    searches = {"sysid": config["parameters"], "sysid_elastic": config.get("elastic") or {}}
    ranges = {model: {k: Bounds(**b) for k, b in each.items() if b} for model, each in searches.items() if each}
    kinds = {model: MODELS[model][0] for model in ranges}
    evaluations = len(ranges) * config["starts"] * config["max_evaluations"]
    done = sum(_evaluations_done(_kept_of(context, model)) for model in ranges)
    found, replays = {}, {}
    with Progress(context.name, evaluations, "evaluations at most", done) as progress:
        for model, bounds in ranges.items():
            replays[model] = scene.replays(kinds[model], names)
            seconds = _seconds(settings, replays[model])
            found[model] = _search(context, model, replays[model], bounds, seconds, progress)
    if config["grid"]:
        seconds = _seconds(settings, replays["sysid"]) if config["seconds"] is not None else None
        values = found["sysid"]["parameters"]
        found[_LANDSCAPE] = _landscape(context, replays["sysid"], ranges["sysid"], values, seconds)
    write_json(context.run_dir / IDENTIFICATION, found)
    for part in (*ranges, _LANDSCAPE):
        forget_checkpoint(_kept_file(context, part))


def _seconds(settings: Mapping[str, Any], replays: Replays) -> float | None:
    """How much of each trial counts [s]; None for all of it."""
    limits = [settings["data"].get("seconds"), settings["identify"]["seconds"]]
    fraction = settings["data"].get("train_fraction", 1.0)
    if fraction < 1.0:
        limits.append(fraction * max(float(replay.trials.times.max()) for replay, _ in replays))
    return min((each for each in limits if each is not None), default=None)


def first_guess(settings: Mapping[str, Any], names: Any) -> dict[str, float]:
    """What the parameters are before anything is known: those of the uncorrected simulation."""
    values = {MASS_FACTOR: 1.0, "fibre_stiffness": (settings.get("fibres") or {}).get("stiffness", 0.0)}
    values |= {key: value for key, value in settings["simulation"].items() if key != "model"}
    return {name: values.get(name, 0.0) for name in names}


def _search(
    context: StageContext,
    model: str,
    replays: Replays,
    bounds: Mapping[str, Bounds],
    seconds: float | None,
    progress: Progress,
) -> dict[str, Any]:
    """The `Identification` of a model, as plain data; goes on from where an interrupted one ended."""
    kept = _kept_of(context, model)
    if "found" in kept:
        return dict(kept["found"])
    config = context.settings["identify"]
    identifier = Identifier(replays, bounds, seconds)
    if "starts" not in kept:
        guess = first_guess(context.settings, bounds)
        guess |= {name: value for name, value in config["first_guess"].items() if name in bounds}
        starts = identifier.starts(guess, config["starts"], config["candidates"], context.settings["seed"])
        kept = _keep(context, model, {"starts": starts, "attempts": []})

    def report(start: int, loss: float, values: Mapping[str, float]) -> None:
        progress.advance(1, start=start, loss=f"{loss:.3g}", E=f"{values.get('youngs_modulus', 0.0) / 1e3:.4g} kPa")

    def keep(attempts: list[Any]) -> None:
        _keep(context, model, {**kept, "attempts": attempts})

    found = identifier.run(
        kept["starts"], config["max_evaluations"], report, kept["attempts"], keep, config["tolerance"]
    )
    return dict(_keep(context, model, {"found": asdict(found)})["found"])


def _evaluations_done(kept: Mapping[str, Any]) -> int:
    """How many went into what is kept of a search."""
    attempts = [each["history"] for each in kept.get("attempts", ())]
    return sum(map(len, kept["found"]["history"] if "found" in kept else attempts))


def _landscape(
    context: StageContext,
    replays: Replays,
    bounds: Mapping[str, Bounds],
    found: Mapping[str, float],
    seconds: float | None,
) -> dict[str, Any]:
    """Losses around the identified parameters: a range and a number of points for E, and for nu if that is wanted."""
    grid = context.settings["identify"]["grid"]
    axes = {name: Bounds(each["lower"], each["upper"], each["logarithmic"]) for name, each in grid.items()}
    others = {name: b for name, b in bounds.items() if name not in axes}
    identifier = Identifier(replays, {**axes, **others}, seconds)
    counts = {name: int(each["points"]) for name, each in grid.items()}
    finished = _kept_of(context, _LANDSCAPE).get("losses", [])
    with Progress(f"{context.name}: landscape", math.prod(counts.values()), "points", len(finished)) as progress:

        def report(losses: list[float]) -> None:
            _keep(context, _LANDSCAPE, {"losses": losses})
            progress.advance(len(losses) - progress.done)

        losses = identifier.grid(counts, found, _AT_ONCE, finished, report)
    ticks = {name: identifier.ticks(name, count).tolist() for name, count in counts.items()}
    return {**ticks, "loss": losses.tolist()}


def _kept_file(context: StageContext, part: str) -> Path:
    """Where what is finished of a part is kept until the stage is done."""
    return context.run_dir / f"identify_{part}.safetensors"


def _keep(context: StageContext, part: str, content: dict[str, Any]) -> dict[str, Any]:
    keep_checkpoint(_kept_file(context, part), "identify", {}, {"fingerprint": context.fingerprint, **content})
    return content


def _kept_of(context: StageContext, part: str) -> dict[str, Any]:
    """What an interrupted run kept of a part; nothing if it had other settings."""
    found = resume_checkpoint(_kept_file(context, part), "identify", context.fingerprint)
    return {} if found is None else found[1]
