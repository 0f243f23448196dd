"""Trains policies on the reduced models of a run, and tests them
and scripted ones on the run's laboratory.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypedDict

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import AfterValidator

from ..io.errors import needs_extra
from ..io.progress import Progress, show
from ..io.resuming import finished_record
from ..io.safe_files import read_json, write_json
from ..io.settings import Count, Natural, Settings, Some, Word, setting
from ..report.page import PageTable
from ..settings.performed import Labels, different

if TYPE_CHECKING:
    from ..environments.tasks import Reach

_SEED: Final = 1000  # of the test episodes
_PREVIEWS: Final = 3  # goals ahead that a scripted policy may aim at
# Of the range of the input, with which a scripted policy closes a gripper.
_SHARES: Final = (0.5, 0.75, 1.0)


class Policies(Settings):
    """The configuration ``train_policy``: policies that are learned, and their test."""

    run: Word = setting(description="folder of a run with a laboratory")
    skill: Literal["reach", "follow", "grasp"]
    models: Labels = setting(description="on which policies learn, such as sysid and resphys")
    steps: Natural = setting(description="actions of all robots together")
    robots: Natural = setting(description="that learn at once")
    episodes: Natural = setting(description="of the test")
    seeds: Annotated[Some[Count], AfterValidator(different)] = setting(
        description="of the policies"
    )

    @property
    def learned_on(self) -> str:
        """World on which policies learn: reduced models have no contact."""
        return "simulator" if self.skill == "grasp" else "reduced"


def train_policy(settings: Policies, folder: Path) -> None:
    """Prints errors; writes policies and their errors into the folder ``policies`` of the run.

    Policies that were trained before with the same settings on the same run are not trained again,
    nor tested again in the same episodes, so that an interrupted command continues.

    Raises:
        InputError: Gymnasium or Stable-Baselines3 is not installed, or the run has no driven robot
            or no laboratory.
        DataFileError: there is no finished run.
    """
    del folder
    with needs_extra("policies", "policies need"):
        from ..environments.making import make_vector
        from ..environments.tasks import GoalTask
    wp.config.log_level = wp.LOG_WARNING
    run = Path(settings.run).expanduser()
    task, models = settings.skill, settings.models
    reaches, learned_on = {}, settings.learned_on
    for model in models:
        goal = make_vector(task, run, 1, model, learned_on).task
        reaches[model] = goal.reach if isinstance(goal, GoalTask) else None
    worlds = {f"{learned_on} {model}": (model, learned_on) for model in models}
    worlds["laboratory"] = (models[-1], "laboratory")
    # Goals and the units of observations are the same for all policies.
    environments = {
        name: make_vector(task, run, settings.episodes, model, world, reach=reaches[models[-1]])
        for name, (model, world) in worlds.items()
    }
    (run / "policies").mkdir(exist_ok=True)
    policies, speeds = _policies(settings, run, reaches)
    _test(policies, environments, run / "policies" / f"{task}_trials.json", settings.episodes)
    path = run / "policies" / f"{task}.json"
    errors = {name: policy.errors for name, policy in policies.items()}
    write_json(
        path,
        {"settings": settings.model_dump(exclude={"run"}), "actions_s": speeds, "errors": errors},
    )
    groups: dict[str, list[_Policy]] = {}
    for policy in policies.values():
        groups.setdefault(policy.group, []).append(policy)
    rows = list[list[str]]()
    for group, alike in groups.items():
        of_group = [[policy.errors[world] for policy in alike] for world in worlds]
        rows.append([group, *map(_text, of_group)])
    title = f"Mean error in mm, task {task}, {settings.episodes} episodes"
    if len(settings.seeds) > 1:
        title += f", policies of {len(settings.seeds)} seeds (lowest to highest)"
    rates = ", ".join(f"{model} {np.mean(speed):.0f}" for model, speed in speeds.items())
    wrote = f"Written: {path} and the policies beside it"
    show(
        PageTable.plain(title, ["policy", *worlds], rows),
        f"Actions a second while learning: {rates}.",
        wrote,
    )


class _Errors(TypedDict):
    """Errors of a policy in a world."""

    mean_mm: float | None  # up to the failure of a robot
    failed: int  # number of robots


@dataclass(frozen=True)
class _Policy:
    """A policy and its errors."""

    group: str  # name of policies that differ in their seed alone
    act: Callable[..., NDArray[np.float32]]
    asked: Mapping[str, Any]  # settings that it was trained with
    errors: dict[str, _Errors] = field(default_factory=dict)  # by world


def _policies(
    settings: Policies, run: Path, reaches: "Mapping[str, Reach | None]"
) -> tuple[dict[str, _Policy], dict[str, list[float]]]:
    """Scripted and trained policies by name, and actions a second of the training by model."""
    from ..environments.making import make_vector
    from ..environments.policies import ScriptedGrasp, ScriptedPolicy, acting, learn, load_model

    task, models = settings.skill, settings.models
    origin = {"run": finished_record(run, "evaluate")["fingerprint"], "last": models[-1]}
    policies: dict[str, _Policy] = {}
    speeds: dict[str, list[float]] = {model: [] for model in models}
    for model in models:
        robots = make_vector(
            task,
            run,
            settings.robots,
            model,
            settings.learned_on,
            autoreset_mode="SameStep",
            reach=reaches[models[-1]],
        )
        reach = reaches[model]
        if reach is None:
            for share in _SHARES:
                name = f"scripted, {share:.0%} of the range"
                policies[name] = _Policy(name, ScriptedGrasp(share), origin)
        else:
            for ahead in range(_PREVIEWS):
                name = f"scripted, {model}, place {ahead + 1}"
                policies[name] = _Policy(name, ScriptedPolicy(robots, ahead, reach), origin)
        for seed in settings.seeds:
            saved, about = (
                run / "policies" / f"{task}_{model}_{seed}{suffix}" for suffix in (".zip", ".json")
            )
            asked = {"steps": settings.steps, "robots": settings.robots, "seed": seed, **origin}
            record = read_json(about) if about.is_file() and saved.is_file() else {}
            if record.get("asked") != asked:
                about.unlink(missing_ok=True)
                began = time.perf_counter()
                with Progress(
                    f"policy on {model}, seed {seed}", settings.steps, "actions"
                ) as progress:
                    learned = learn(robots, settings.steps, seed, progress.advance)
                learned.save(saved)
                record = {
                    "asked": asked,
                    "actions_s": learned.num_timesteps / (time.perf_counter() - began),
                }
                write_json(about, record)
            speeds[model].append(record["actions_s"])
            name = f"PPO, {model}"
            policies[f"{name}, seed {seed}"] = _Policy(name, acting(load_model(saved)), asked)
    return policies, speeds


def _test(
    policies: Mapping[str, _Policy], environments: Mapping[str, Any], path: Path, episodes: int
) -> None:
    """Fills the errors of policies in all worlds.

    Results of the same episodes are read from `path`.
    """
    from ..environments.policies import errors_mm

    kept = read_json(path) if path.is_file() else {}
    asked = {name: {**policy.asked, "episodes": episodes} for name, policy in policies.items()}
    every = [(name, world) for name in policies for world in environments]
    left = [
        (name, world)
        for name, world in every
        if kept.get(name, {}).get(world, {}).get("asked") != asked[name]
    ]
    total = sum(environments[world].actions for _, world in every)
    to_do = sum(environments[world].actions for _, world in left)
    with Progress("trials", total, "actions", total - to_do) as progress:
        for name, world in left:
            errors = errors_mm(environments[world], policies[name].act, _SEED, progress.advance)
            finite = errors[np.isfinite(errors)]  # up to the failure of a robot
            kept.setdefault(name, {})[world] = {
                "asked": asked[name],
                "mean_mm": float(finite.mean()) if len(finite) else None,
                "failed": int(np.isnan(errors).any(axis=0).sum()),
            }
            write_json(path, kept)
    for name, world in every:
        known = kept[name][world]
        policies[name].errors[world] = {"mean_mm": known["mean_mm"], "failed": known["failed"]}


def _text(errors: Sequence[_Errors]) -> str:
    """Mean error of policies that differ in their seed,
    lowest and highest of them, and number of failed robots.
    """
    means = [error["mean_mm"] for error in errors if error["mean_mm"] is not None]
    failures = sum(error["failed"] for error in errors)
    text = f"{np.mean(means):.2f}" if means else "-"
    if len(means) > 1:
        text += f" ({min(means):.2f} to {max(means):.2f})"
    return text + (f" ({failures} failed)" if failures else "")
