"""Learns a policy by PPO on the reduced model of a run, and tries it, beside a scripted one, on the run's laboratory.

    pip install 'warp-resphys[control,policies]'
    warp-resphys experiment=tendon_rod
    python scripts/train_policy.py runs/tendon_rod/default

What it learns with the learned force is tried beside what it learns without: both on the simulated laboratory, which
neither has seen.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from warp_resphys.environments.making import TASKS, make_vector
from warp_resphys.environments.policies import Policy, ScriptedPolicy, acting, errors_mm, learn
from warp_resphys.io.errors import ResphysError
from warp_resphys.io.progress import Progress

_SEED = 1000  # of the episodes in which policies are tried


def main() -> None:
    """Learns and tries; writes the policies into the folder ``policies`` of the run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a run with a simulated laboratory")
    parser.add_argument("--task", default="follow", choices=TASKS[:2])
    parser.add_argument("--models", nargs="+", default=["sysid", "resphys"], help="on which policies learn")
    parser.add_argument("--steps", type=int, default=400_000, help="actions of all robots together")
    parser.add_argument("--robots", type=int, default=64, help="that learn at once")
    parser.add_argument("--episodes", type=int, default=16, help="in which policies are tried")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    console = Console(stderr=True)
    try:
        _train(given, console)
    except ResphysError as error:
        console.print(f"error: {error}", style="red", highlight=False, soft_wrap=True)
        raise SystemExit(2) from None


def _train(given: argparse.Namespace, console: Console) -> None:
    policies: dict[str, Policy] = {}
    for model in given.models:
        robots = make_vector(given.task, given.run, given.robots, model, "reduced", autoreset_mode="SameStep")
        for ahead in range(3):
            policies[f"scripted, {model}, place {ahead + 1}"] = ScriptedPolicy(robots, ahead)
        began = time.perf_counter()
        with Progress(f"policy on {model}", given.steps, "actions") as progress:
            learned = learn(robots, given.steps, given.seed, progress.advance)
        seconds = time.perf_counter() - began
        policies[f"PPO, {model}"] = acting(learned)
        path = given.run / "policies" / f"{given.task}_{model}.zip"
        path.parent.mkdir(exist_ok=True)
        learned.save(path)
        console.print(f"{path}: {seconds:.0f} s, {given.steps / seconds:.0f} actions/s", highlight=False)
    worlds = {f"reduced, {model}": (model, "reduced") for model in given.models}
    worlds["laboratory"] = (given.models[-1], "laboratory")
    table = Table(title=f"Mean error of {given.episodes} episodes [mm]")
    for head in ("policy", *worlds):
        table.add_column(head)
    tried = {
        name: make_vector(given.task, given.run, given.episodes, model, world)
        for name, (model, world) in worlds.items()
    }
    for name, policy in policies.items():
        errors = [errors_mm(environment, policy, _SEED) for environment in tried.values()]
        table.add_row(name, *(_told(each) for each in errors))
    Console().print(table)


def _told(errors: np.ndarray) -> str:
    lost = np.isnan(errors).any(axis=0).sum()
    return f"{np.nanmean(errors):.2f}" + (f" ({lost} failed)" if lost else "")


if __name__ == "__main__":
    main()
