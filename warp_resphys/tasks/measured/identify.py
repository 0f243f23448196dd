"""Stage: the physical parameters that explain the training trials."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ...errors import InputError
from ...files import read_json, write_json
from ...identification import Bounds, Identification, Identifier
from ...progress import Progress
from ...replay import PARAMETERS, Release, Replay
from ...stages import StageContext
from .files import IDENTIFICATION
from .scene import Scene

_ELASTIC = ("youngs_modulus", "poissons_ratio")
_KINDS = ("identified", "simulation")


def identify(context: StageContext) -> None:
    """Writes identification.json: all configured parameters, E and nu alone, and the landscape over these two.

    E and nu alone belong to the uncorrected simulator, with its integrator, as published; all parameters belong to the
    identified one.
    """
    settings = context.settings
    config = settings["identify"]
    scene = Scene(settings, context.run_dir / settings["shared"])
    train = tuple(settings["split"]["train"])
    bounds = {name: Bounds(**b) for name, b in config["parameters"].items()}
    elastic = {name: bounds[name] for name in _ELASTIC if name in bounds}
    evaluations = (2 if elastic else 1) * config["starts"] * config["max_evaluations"]
    with Progress("identify", evaluations, "evaluations at most") as progress:
        identified, replay, release = _search(scene, "identified", train, bounds, context, progress)
        results = {"sysid": identified}
        if elastic:
            results["sysid_elastic"], *_ = _search(scene, "simulation", train, elastic, context, progress)
    found: dict[str, Any] = {name: dataclasses.asdict(result) for name, result in results.items()}
    found["landscape"] = _landscape(replay, release, bounds, identified, config["grid"])
    write_json(context.run_dir / IDENTIFICATION, found)
    for kind in _KINDS:
        _attempts_file(context, kind).unlink(missing_ok=True)


def first_guess(settings: Mapping[str, Any], names: Any) -> dict[str, float]:
    """What the parameters are before anything is known: those of the uncorrected simulation."""
    values = {**dict.fromkeys(PARAMETERS, 0.0), "attached_mass_factor": 1.0}
    values |= {key: value for key, value in settings["simulation"].items() if key != "model"}
    return {name: values[name] for name in names}


def _search(
    scene: Scene,
    kind: str,
    train: tuple[str, ...],
    bounds: Mapping[str, Bounds],
    context: StageContext,
    progress: Progress,
) -> tuple[Identification, Replay, Release]:
    settings = context.settings
    config = settings["identify"]
    replay, release = scene.replay(kind, train)
    identifier = Identifier(replay, release, bounds, settings["data"]["seconds"])
    guess = {**first_guess(settings, bounds), **{k: v for k, v in config["first_guess"].items() if k in bounds}}
    starts = identifier.starts(guess, config["starts"], config["candidates"], settings["seed"])

    def report(start: int, loss: float, values: Mapping[str, float]) -> None:
        progress.advance(1, start=start, loss=f"{loss:.3g}", E=f"{values.get('youngs_modulus', 0.0) / 1e3:.4g} kPa")

    path = _attempts_file(context, kind)

    def keep(attempts: list[Any]) -> None:
        write_json(path, {"fingerprint": context.fingerprint, "attempts": attempts})

    kept = read_json(path) if path.is_file() else {}
    finished = kept["attempts"] if kept.get("fingerprint") == context.fingerprint else []
    return (
        identifier.run(starts, config["max_evaluations"], report, finished, keep, config["tolerance"]),
        replay,
        release,
    )


def _attempts_file(context: StageContext, kind: str) -> Path:
    """Where finished starts are kept until the stage is done."""
    return context.run_dir / f"identify_{kind}.json"


def _landscape(
    replay: Replay,
    release: Release,
    bounds: Mapping[str, Bounds],
    found: Identification,
    grid: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Losses around the identified parameters: a range and a number of points for E, and for nu if that is wanted."""
    axes = {name: Bounds(each["lower"], each["upper"], each["logarithmic"]) for name, each in grid.items()}
    others = {name: b for name, b in bounds.items() if name not in axes}
    identifier = Identifier(replay, release, {**axes, **others})
    counts = {name: int(each["points"]) for name, each in grid.items()}
    with torch.no_grad():
        losses = identifier.grid(counts, found.parameters)
    ticks = {name: identifier.ticks(name, count).tolist() for name, count in counts.items()}
    return {**ticks, "loss": losses.tolist()}


def check_identification(config: Mapping[str, Any]) -> None:
    """Checks the group ``identify``.

    Raises:
        InputError: a value out of range, or an unknown parameter.
    """
    for name, each in config["parameters"].items():
        if name not in PARAMETERS:
            raise InputError(f"identify.parameters names '{name}': choose from {', '.join(PARAMETERS)}.")
        try:
            Bounds(**each)
        except (TypeError, InputError) as error:
            raise InputError(f"identify.parameters.{name}: {error}") from error
    for key in ("starts", "max_evaluations", "tolerance"):
        if not config[key] > 0:
            raise InputError(f"identify.{key} is {config[key]}: it must be positive.")
    if "youngs_modulus" not in config["grid"] or not set(config["grid"]) <= set(_ELASTIC):
        raise InputError("identify.grid must have a range of youngs_modulus, and may have one of poissons_ratio.")
