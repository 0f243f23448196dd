"""Learns policies on the reduced models of a run, and tries them, beside scripted ones, on the run's laboratory."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ..experiment.schema import COUNT, NATURAL, WORD, check, one_of
from ..io.errors import InputError
from ..io.files import read_json, write_json
from ..io.progress import Progress
from ..io.stages import finished_record
from .command import WORDS, show, table_of

_TASKS: Final = ("reach", "follow")
_SEED: Final = 1000  # of the episodes in which policies are tried
_PREVIEWS: Final = 3  # places that a scripted policy may go to


def train_policy(config: Mapping[str, Any], folder: Path) -> None:
    """Prints errors; writes policies and their errors into the folder ``policies`` of the run.

    A policy that was learned before, in the same way from the same run, is not learned again.

    Raises:
        InputError: Gymnasium or Stable-Baselines3 is not installed, or the run has no driven robot or no laboratory.
        DataFileError: there is no finished run.
    """
    del folder
    check("run", config["run"], WORD)
    check("skill", config["skill"], one_of(*_TASKS))
    check("models", config["models"], WORDS)
    for key in ("steps", "robots", "episodes"):
        check(key, config[key], NATURAL)
    check("seed", config["seed"], COUNT)
    if not config["models"]:
        raise InputError("models names none: name those on which policies are to learn, as in models=[sysid,resphys].")
    try:
        from ..environments.making import make_vector
        from ..environments.policies import Policy, ScriptedPolicy, acting, errors_mm, learn, learned_before
        from ..environments.tasks import GoalTask
    except ImportError as error:
        raise InputError(f"policies need Gymnasium ({error}): pip install 'warp-resphys[policies]'.") from None
    wp.config.log_level = wp.LOG_WARNING
    run, task, models = Path(config["run"]).expanduser(), config["skill"], config["models"]
    reaches = {}
    for model in models:
        goal = make_vector(task, run, 1, model, "reduced").task
        assert isinstance(goal, GoalTask)
        reaches[model] = goal.reach
    common = reaches[models[-1]]  # What is asked, and the units in which it is shown, are the same for all.
    worlds = {f"reduced {model}": (model, "reduced") for model in models} | {"laboratory": (models[-1], "laboratory")}
    tried = {
        name: make_vector(task, run, config["episodes"], model, world, reach=common)
        for name, (model, world) in worlds.items()
    }
    policies: dict[str, Policy] = {}
    speeds: dict[str, float] = {}
    place = run / "policies"
    place.mkdir(exist_ok=True)
    for model in models:
        robots = make_vector(task, run, config["robots"], model, "reduced", autoreset_mode="SameStep", reach=common)
        for ahead in range(_PREVIEWS):
            policies[f"scripted, {model}, place {ahead + 1}"] = ScriptedPolicy(robots, ahead, reaches[model])
        saved, about = place / f"{task}_{model}.zip", place / f"{task}_{model}.json"
        asked = {key: config[key] for key in ("steps", "robots", "seed")} | {"last": models[-1]}
        asked["run"] = finished_record(run, "evaluate")["fingerprint"]
        known = read_json(about) if about.is_file() and saved.is_file() else {}
        if known.get("asked") != asked:
            about.unlink(missing_ok=True)
            began = time.perf_counter()
            with Progress(f"policy on {model}", config["steps"], "actions") as progress:
                learned = learn(robots, config["steps"], config["seed"], progress.advance)
            learned.save(saved)
            known = {"asked": asked, "actions_s": learned.num_timesteps / (time.perf_counter() - began)}
            write_json(about, known)
        speeds[model] = known["actions_s"]
        policies[f"PPO, {model}"] = acting(learned_before(saved))
    errors: dict[str, dict[str, Any]] = {name: {} for name in policies}
    total = len(policies) * sum(environment.actions for environment in tried.values())
    with Progress("trials", total, "actions") as progress:
        for name, policy in policies.items():
            for world, environment in tried.items():
                errors[name][world] = _told(errors_mm(environment, policy, _SEED, progress.advance))
    settings = {key: config[key] for key in ("skill", "models", "steps", "robots", "episodes", "seed")}
    path = place / f"{task}.json"
    write_json(path, {"settings": settings, "actions_s": speeds, "errors": errors})
    rows = [[name, *(_text(each) for each in found.values())] for name, found in errors.items()]
    table = table_of(f"Mean error in mm, task {task}, {config['episodes']} episodes", ["policy", *worlds], rows)
    rates = ", ".join(f"{model} {speed:.0f}" for model, speed in speeds.items())
    show(table, f"Actions a second while learning: {rates}.", f"Written: {path} and the policies beside it")


def _told(errors: NDArray[np.float64]) -> dict[str, float | None]:
    """Robots that failed count up to their failure; the mean is None where all failed at once."""
    known = errors[np.isfinite(errors)]
    return {
        "mean_mm": float(known.mean()) if len(known) else None,
        "failed": int(np.isnan(errors).any(axis=0).sum()),
    }


def _text(found: Mapping[str, float | None]) -> str:
    failed = f" ({found['failed']} failed)" if found["failed"] else ""
    return ("-" if found["mean_mm"] is None else f"{found['mean_mm']:.2f}") + failed
