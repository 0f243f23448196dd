"""Learns policies on the reduced models of a run, and tries them, beside scripted ones, on the run's laboratory."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import AfterValidator

from ..io.errors import InputError
from ..io.files import read_json, write_json
from ..io.progress import Progress
from ..io.settings import Count, Natural, Settings, Some, Word, parse, setting
from ..io.stages import finished_record
from ..settings.trials import Labels, different
from .command import show, table_of

_SEED: Final = 1000  # of the episodes in which policies are tried
_PREVIEWS: Final = 3  # places that a scripted policy may go to


class Policies(Settings):
    """Policies that are learned, and how they are tried."""

    run: Word = setting(description="folder of a run with a laboratory")
    skill: Literal["reach", "follow"]
    models: Labels = setting(description="on which policies learn, such as sysid and resphys")
    steps: Natural = setting(description="actions of all robots together")
    robots: Natural = setting(description="that learn at once")
    episodes: Natural = setting(description="in which policies are tried")
    seeds: Annotated[Some[Count], AfterValidator(different)] = setting(description="of the policies")


def train_policy(config: Mapping[str, Any], folder: Path) -> None:
    """Prints errors; writes policies and their errors into the folder ``policies`` of the run.

    A policy that was learned before, in the same way from the same run, is not learned again, nor tried again in the
    same episodes: what was interrupted goes on.

    Raises:
        InputError: Gymnasium or Stable-Baselines3 is not installed, or the run has no driven robot or no laboratory.
        DataFileError: there is no finished run.
    """
    del folder
    settings = parse(Policies, config)
    try:
        from ..environments.making import make_vector
        from ..environments.tasks import GoalTask
    except ImportError as error:
        raise InputError(f"policies need Gymnasium ({error}): pip install 'warp-resphys[policies]'.") from None
    wp.config.log_level = wp.LOG_WARNING
    run, task, models = Path(settings.run).expanduser(), settings.skill, settings.models
    reaches = {}
    for model in models:
        goal = make_vector(task, run, 1, model, "reduced").task
        assert isinstance(goal, GoalTask)
        reaches[model] = goal.reach
    worlds = {f"reduced {model}": (model, "reduced") for model in models} | {"laboratory": (models[-1], "laboratory")}
    # What is asked, and the units in which it is shown, are the same for all.
    environments = {
        name: make_vector(task, run, settings.episodes, model, world, reach=reaches[models[-1]])
        for name, (model, world) in worlds.items()
    }
    (run / "policies").mkdir(exist_ok=True)
    found, speeds = _policies(settings, run, reaches)
    _try(found, environments, run / "policies" / f"{task}_trials.json", settings.episodes)
    path = run / "policies" / f"{task}.json"
    asked = {key: value for key, value in settings.plain().items() if key != "run"}
    write_json(
        path, {"settings": asked, "actions_s": speeds, "errors": {name: one.errors for name, one in found.items()}}
    )
    groups: dict[str, list[_Found]] = {}
    for one in found.values():
        groups.setdefault(one.group, []).append(one)
    rows = [
        [group, *(_text([one.errors[world] for one in ones]) for world in worlds)] for group, ones in groups.items()
    ]
    title = f"Mean error in mm, task {task}, {settings.episodes} episodes"
    if len(settings.seeds) > 1:
        title += f", policies of {len(settings.seeds)} seeds (least to most)"
    rates = ", ".join(f"{model} {np.mean(speed):.0f}" for model, speed in speeds.items())
    wrote = f"Written: {path} and the policies beside it"
    show(table_of(title, ["policy", *worlds], rows), f"Actions a second while learning: {rates}.", wrote)


@dataclass(frozen=True)
class _Found:
    """A policy, of which kind it is, what made it, and its errors by world."""

    group: str
    policy: Callable[..., NDArray[np.float32]]
    asked: Mapping[str, Any]
    errors: dict[str, dict[str, Any]] = field(default_factory=dict)


def _policies(
    settings: Policies, run: Path, reaches: Mapping[str, Any]
) -> tuple[dict[str, _Found], dict[str, list[float]]]:
    """Policies by name, scripted ones and those that are learned now or were before, and actions a second by model."""
    from ..environments.making import make_vector
    from ..environments.policies import ScriptedPolicy, acting, learn, learned_before

    task, models = settings.skill, settings.models
    origin = {"run": finished_record(run, "evaluate")["fingerprint"], "last": models[-1]}
    found: dict[str, _Found] = {}
    speeds: dict[str, list[float]] = {model: [] for model in models}
    for model in models:
        robots = make_vector(
            task, run, settings.robots, model, "reduced", autoreset_mode="SameStep", reach=reaches[models[-1]]
        )
        for ahead in range(_PREVIEWS):
            name = f"scripted, {model}, place {ahead + 1}"
            found[name] = _Found(name, ScriptedPolicy(robots, ahead, reaches[model]), origin)
        for seed in settings.seeds:
            saved, about = (run / "policies" / f"{task}_{model}_{seed}{suffix}" for suffix in (".zip", ".json"))
            asked = {"steps": settings.steps, "robots": settings.robots, "seed": seed, **origin}
            known = read_json(about) if about.is_file() and saved.is_file() else {}
            if known.get("asked") != asked:
                about.unlink(missing_ok=True)
                began = time.perf_counter()
                with Progress(f"policy on {model}, seed {seed}", settings.steps, "actions") as progress:
                    learned = learn(robots, settings.steps, seed, progress.advance)
                learned.save(saved)
                known = {"asked": asked, "actions_s": learned.num_timesteps / (time.perf_counter() - began)}
                write_json(about, known)
            speeds[model].append(known["actions_s"])
            name = f"PPO, {model}"
            found[f"{name}, seed {seed}"] = _Found(name, acting(learned_before(saved)), asked)
    return found, speeds


def _try(found: Mapping[str, _Found], environments: Mapping[str, Any], path: Path, episodes: int) -> None:
    """Fills errors of policies in all worlds; what is known of the same episodes, as `path` has it, is not tried."""
    from ..environments.policies import errors_mm

    kept = read_json(path) if path.is_file() else {}
    asked = {name: {**one.asked, "episodes": episodes} for name, one in found.items()}
    every = [(name, world) for name in found for world in environments]
    left = [(name, world) for name, world in every if kept.get(name, {}).get(world, {}).get("asked") != asked[name]]
    total, to_do = (sum(environments[world].actions for _, world in pairs) for pairs in (every, left))
    with Progress("trials", total, "actions", total - to_do) as progress:
        for name, world in left:
            errors = errors_mm(environments[world], found[name].policy, _SEED, progress.advance)
            kept.setdefault(name, {})[world] = {"asked": asked[name], **_told(errors)}
            write_json(path, kept)
    for name, world in every:
        found[name].errors[world] = {key: kept[name][world][key] for key in ("mean_mm", "failed")}


def _told(errors: NDArray[np.float64]) -> dict[str, float | None]:
    """Robots that failed count up to their failure; the mean is None where all failed at once."""
    known = errors[np.isfinite(errors)]
    return {
        "mean_mm": float(known.mean()) if len(known) else None,
        "failed": int(np.isnan(errors).any(axis=0).sum()),
    }


def _text(found: Sequence[Mapping[str, Any]]) -> str:
    """The mean of policies that were learned alike, the least and the most of them, and how many robots failed."""
    means = [each["mean_mm"] for each in found if each["mean_mm"] is not None]
    failures = sum(each["failed"] for each in found)
    text = f"{np.mean(means):.2f}" if means else "-"
    if len(means) > 1:
        text += f" ({min(means):.2f} to {max(means):.2f})"
    return text + (f" ({failures} failed)" if failures else "")
