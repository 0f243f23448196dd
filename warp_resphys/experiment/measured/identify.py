"""Stage: the physical parameters that explain the training trials."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any

from ...io.files import read_json, write_json
from ...io.progress import Progress
from ...io.stages import StageContext
from ...learning.driven import DRIVEN_PARAMETERS
from ...learning.identification import Bounds, Identifier
from ...learning.replay import Release, Replay
from .files import IDENTIFICATION
from .scene import Scene

ELASTIC = ("youngs_modulus", "poissons_ratio")
_LANDSCAPE = "landscape"
_AT_ONCE = 4  # points of the landscape
_PARTS = ("identified", "simulation", _LANDSCAPE)

Replays = Callable[[str], tuple[Replay, Release]]


def identify(context: StageContext) -> None:
    """Writes identification.json: the configured parameters, E and nu alone, and the landscape over these two.

    E and nu alone belong to the uncorrected simulator, with its integrator, as published; the parameters belong to the
    identified one. What an interrupted run has finished is not done again: starts, searches, points of the landscape.
    """
    settings = context.settings
    config = settings["identify"]
    scene = Scene(settings, context.run_dir / settings["shared"])
    train = tuple(settings["split"]["train"])
    bounds, elastic = (
        {name: Bounds(**b) for name, b in (config[key] or {}).items()} for key in ("parameters", "elastic")
    )
    evaluations = (2 if elastic else 1) * config["starts"] * config["max_evaluations"]
    replays = cache(partial(scene.replay, names=train))
    done = sum(evaluations_done(kept_of(context, kind)) for kind in ("identified", "simulation"))
    with Progress("identify", evaluations, "evaluations at most", done) as progress:
        seconds = settings["data"]["seconds"]
        found = {"sysid": search(context, "identified", bounds, replays, seconds, progress)}
        if elastic:
            found["sysid_elastic"] = search(context, "simulation", elastic, replays, seconds, progress)
    found[_LANDSCAPE] = landscape(context, *replays("identified"), bounds, found["sysid"]["parameters"])
    write_json(context.run_dir / IDENTIFICATION, found)
    remove_kept(context)


def first_guess(settings: Mapping[str, Any], names: Any) -> dict[str, float]:
    """What the parameters are before anything is known: those of the uncorrected simulation."""
    values = {**dict.fromkeys(DRIVEN_PARAMETERS, 0.0), "attached_mass_factor": 1.0}
    values |= {key: value for key, value in settings["simulation"].items() if key != "model"}
    return {name: values[name] for name in names}


def search(
    context: StageContext,
    kind: str,
    bounds: Mapping[str, Bounds],
    replays: Replays,
    seconds: float | None,
    progress: Progress,
) -> dict[str, Any]:
    """The `Identification` of a simulator, as plain data; goes on from where an interrupted one ended.

    Args:
        context: of the stage, with the group ``identify``.
        kind: of the simulator.
        bounds: ranges of the parameters.
        replays: of a kind of simulator, and how their motions begin.
        seconds: how much of each motion counts.
        progress: of the evaluations.
    """
    kept = kept_of(context, kind)
    if "found" in kept:
        return dict(kept["found"])
    config = context.settings["identify"]
    identifier = Identifier(*replays(kind), bounds, seconds)
    if "starts" not in kept:
        guess = first_guess(context.settings, bounds)
        guess |= {name: value for name, value in config["first_guess"].items() if name in bounds}
        starts = identifier.starts(guess, config["starts"], config["candidates"], context.settings["seed"])
        kept = _keep(context, kind, {"starts": starts, "attempts": []})

    def report(start: int, loss: float, values: Mapping[str, float]) -> None:
        progress.advance(1, start=start, loss=f"{loss:.3g}", E=f"{values.get('youngs_modulus', 0.0) / 1e3:.4g} kPa")

    def keep(attempts: list[Any]) -> None:
        _keep(context, kind, {**kept, "attempts": attempts})

    found = identifier.run(
        kept["starts"], config["max_evaluations"], report, kept["attempts"], keep, config["tolerance"]
    )
    return dict(_keep(context, kind, {"found": asdict(found)})["found"])


def evaluations_done(kept: Mapping[str, Any]) -> int:
    """How many went into what is kept of a search."""
    attempts = [each["history"] for each in kept.get("attempts", ())]
    return sum(map(len, kept["found"]["history"] if "found" in kept else attempts))


def landscape(
    context: StageContext,
    replay: Replay,
    release: Release,
    bounds: Mapping[str, Bounds],
    found: Mapping[str, float],
    seconds: float | None = None,
) -> dict[str, Any]:
    """Losses around the identified parameters: a range and a number of points for E, and for nu if that is wanted."""
    grid = context.settings["identify"]["grid"]
    axes = {name: Bounds(each["lower"], each["upper"], each["logarithmic"]) for name, each in grid.items()}
    others = {name: b for name, b in bounds.items() if name not in axes}
    identifier = Identifier(replay, release, {**axes, **others}, seconds)
    counts = {name: int(each["points"]) for name, each in grid.items()}
    finished = [math.inf if loss is None else loss for loss in kept_of(context, _LANDSCAPE).get("losses", [])]
    with Progress(f"{context.name}: landscape", math.prod(counts.values()), "points", len(finished)) as progress:

        def report(losses: list[float]) -> None:
            _keep(context, _LANDSCAPE, {"losses": losses})
            progress.advance(len(losses) - progress.done)

        losses = identifier.grid(counts, found, _AT_ONCE, finished, report)
    ticks = {name: identifier.ticks(name, count).tolist() for name, count in counts.items()}
    return {**ticks, "loss": losses.tolist()}


def remove_kept(context: StageContext) -> None:
    """Removes what was kept of the parts, once all is done."""
    for part in _PARTS:
        _kept_file(context, part).unlink(missing_ok=True)


def _kept_file(context: StageContext, part: str) -> Path:
    """Where what is finished of a part is kept until the stage is done."""
    return context.run_dir / f"identify_{part}.json"


def _keep(context: StageContext, part: str, content: dict[str, Any]) -> dict[str, Any]:
    write_json(_kept_file(context, part), {"fingerprint": context.fingerprint, **content})
    return content


def kept_of(context: StageContext, part: str) -> dict[str, Any]:
    """What an interrupted run kept of a part; nothing if it had other settings."""
    path = _kept_file(context, part)
    kept: dict[str, Any] = read_json(path) if path.is_file() else {}
    return kept if kept.get("fingerprint") == context.fingerprint else {}
