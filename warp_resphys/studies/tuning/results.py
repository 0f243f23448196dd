"""What a search leaves behind: tables, pictures, a page, and the best settings as a configuration."""

import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from rich.console import Console
from rich.table import Table

from ...io.files import OWN_OPTIONS, write_json, write_text
from ...report.page import (
    NO_BREAK_SPACE,
    Picture,
    draw_picture,
    duration_text,
    flatten,
    number_text,
    page_template,
)
from ..command import write_csv
from .space import Dimension, with_settings
from .study import Outcome, SharedStudy

SUMMARY = "tune.json"
TABLE = "trials.csv"
PAGE = "tune.html"
_PRINTED = 5  # trials
_STATES = ("complete", "pruned", "failed", "running")
_MODELS = {"resphys": "ResPhys", "simfree": "SimFree"}


@dataclass(frozen=True)
class Tuning:
    """What is searched.

    Attributes:
        config: the whole configuration.
        groups: ``network``, ``trainer`` and what else every trial is trained with, but for what is searched.
        space: what each setting may be, by dotted key.
        study: shared with the other workers.
        configured_mm: roll-out error on the validation split of the network that is trained as configured [mm]; None
            where it diverges.
    """

    config: Mapping[str, Any]
    groups: Mapping[str, Any]
    space: Mapping[str, Dimension]
    study: SharedStudy
    configured_mm: float | None

    @property
    def folder(self) -> Path:
        """Of the study."""
        return self.study.folder

    @property
    def name(self) -> str:
        """By which later runs name the best settings."""
        return str(self.config["tune"]["save_as"])

    @property
    def option(self) -> Path:
        """The file that they find them in."""
        return Path(OWN_OPTIONS) / "tuned" / f"{self.name}.yaml"

    def beaten_by(self, best: Outcome) -> bool:
        """Whether a trial is better than the settings as configured."""
        return self.configured_mm is None or (best.error is not None and best.error < self.configured_mm)


def ranked(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The complete trials that did not diverge, the best one first."""
    finite = [
        (each.error, each.number, each)
        for each in outcomes
        if each.state == "complete" and each.error is not None and math.isfinite(each.error)
    ]
    return [each for *_, each in sorted(finite, key=lambda row: row[:2])]


def short_text(value: Any) -> str:
    """A setting as one reads it."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def write_results(tuning: Tuning) -> None:
    """Writes tune.json and trials.csv, and the best settings as a configuration."""
    outcomes = tuning.study.outcomes()
    rows = [
        {
            "trial": each.number,
            "state": each.state,
            "rollout_error_mm": each.error,
            "seconds": None if each.seconds is None else round(each.seconds, 3),
            **{name: each.settings.get(name) for name in tuning.space},
        }
        for each in outcomes
    ]
    write_csv(tuning.folder / TABLE, rows)
    best = next(iter(ranked(outcomes)), None)
    summary = {
        "model": tuning.config["tune"]["model"],
        "trials": {state: sum(each.state == state for each in outcomes) for state in _STATES},
        "wanted": tuning.study.trials,
        "configured_rollout_error_mm": tuning.configured_mm,
        "seconds": sum(each.seconds or 0.0 for each in outcomes),
        "best": best and {"trial": best.number, "rollout_error_mm": best.error, "settings": dict(best.settings)},
        "importance": tuning.study.importance(),
    }
    write_json(tuning.folder / SUMMARY, summary)
    if best:
        write_text(tuning.option, _option_text(tuning, best, len(outcomes)))


def _option_text(tuning: Tuning, best: Outcome, trials: int) -> str:
    """An option of the group ``tuned``: all of ``network`` and ``trainer`` as the best trial had them."""
    groups = with_settings(tuning.groups, best.settings)
    found: dict[str, Any] = {key: groups[key] for key in ("network", "trainer")}
    if tuning.config["tune"]["model"] == "simfree":
        found = {"simfree": found}
    head = [
        "# @package _global_",
        f"# Trial {best.number} of {trials} until {datetime.now(UTC).date()}: roll-out error of "
        f"{number_text(best.error)} mm on the validation split. Found by",
        f"#   {shlex.join(['warp-resphys', 'tune', *HydraConfig.get().overrides.task])}",
        f"# Without it, as configured there: {number_text(tuning.configured_mm)} mm. To use it: tuned={tuning.name}",
    ]
    return "\n".join([*head, str(OmegaConf.to_yaml({"tuned": tuning.name, **found}))])


def print_best(tuning: Tuning) -> None:
    """Prints the best trials, and how to use what was found."""
    best = ranked(tuning.study.outcomes())
    console = Console()
    if not best:
        console.print("Every trial diverged: search closer to settings that work, see tune.space.")
        return
    names = [name.rpartition(".")[2] for name in tuning.space]
    table = Table("trial", "error [mm]", *names, title="Best trials: roll-out error on the validation split")
    for each in best[:_PRINTED]:
        values = (short_text(each.settings[name]) for name in tuning.space)
        table.add_row(str(each.number), number_text(each.error), *values)
    console.print(table)
    console.print(f"Page: {os.path.relpath(tuning.folder / PAGE)}", soft_wrap=True)
    console.print(f"To use the best settings: tuned={tuning.name} ({tuning.option})", soft_wrap=True)
    as_configured = f"As configured: {number_text(tuning.configured_mm)} mm"
    console.print(as_configured if tuning.beaten_by(best[0]) else f"{as_configured}, which no trial has beaten")


def write_pictures(tuning: Tuning) -> None:
    """Writes history.png, importance.png and settings.png, and tune.html, which shows them and the trials."""
    outcomes = tuning.study.outcomes()
    best = ranked(outcomes)
    last = [key.rpartition(".")[2] for key in tuning.space]
    names = {key: name if last.count(name) == 1 else key for key, name in zip(tuning.space, last, strict=True)}
    common = {key: tuning.groups[key] for key in ("network", "trainer", "seed")}
    page = page_template("tuning.html").render(
        data={
            "title": tuning.config["title"],
            "experiment": tuning.config["name"],
            "ranked": best,
            "name": tuning.name,
            "option": str(tuning.option),
        },
        pictures=_draw(tuning, outcomes, best, names),
        model=_MODELS[tuning.config["tune"]["model"]],
        verdict=_verdict(tuning, outcomes, best),
        names=names,
        space={key: str(dimension) for key, dimension in tuning.space.items()},
        number=number_text,
        duration=duration_text,
        short=short_text,
        settings=[(key, value) for key, value in flatten(common) if key not in tuning.space],
    )
    write_text(tuning.folder / PAGE, page)


def _verdict(tuning: Tuning, outcomes: Sequence[Outcome], best: Sequence[Outcome]) -> str:
    """What the best trial came to, and how many there were."""
    complete, pruned = (sum(each.state == state for each in outcomes) for state in ("complete", "pruned"))
    asides = [f"{pruned} given up, as they took too long"] if pruned else []
    asides += [f"{complete - len(best)} diverged"] if complete > len(best) else []
    said = f"{complete + pruned} of {tuning.study.trials} trials are finished"
    said += f" ({', '.join(asides)})." if asides else "."
    if not best:
        return f"{said} None of them came to a roll-out that stays finite."
    error = number_text(best[0].error)
    found = f"The best settings, of trial {best[0].number}, come to {error} mm on the validation split."
    if tuning.configured_mm is not None:
        beaten = "" if tuning.beaten_by(best[0]) else ", which no trial has beaten"
        found += f" As configured: {number_text(tuning.configured_mm)} mm{beaten}."
    return f"{found} {said}".replace(" mm", f"{NO_BREAK_SPACE}mm")


def _draw(
    tuning: Tuning, outcomes: Sequence[Outcome], best: Sequence[Outcome], names: Mapping[str, str]
) -> dict[str, Picture]:
    from . import figures  # Matplotlib takes a second, which a worker need not wait for.

    errors, pruned = np.full((2, len(outcomes)), np.nan)
    for each in outcomes:
        if each.error is not None and each.state in ("complete", "pruned"):
            (errors if each.state == "complete" else pruned)[each.number] = each.error
    shares = {names[key]: share for key, share in tuning.study.importance().items()}
    tried = [{names[key]: value for key, value in each.settings.items()} for each in best]
    space = {names[key]: dimension for key, dimension in tuning.space.items()}
    scatter = np.array([each.error for each in best], dtype=np.float64)
    told = ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
    drawings = {
        "history": (
            partial(figures.search_history, errors, pruned, tuning.configured_mm),
            f"Validation roll-out error of {len(outcomes)} trials and the best so far, on a logarithmic axis.",
        ),
        "importance": (partial(figures.importance_bars, shares), f"Importance of each setting: {told}."),
        "settings": (
            partial(figures.setting_scatter, scatter, tried, space),
            "Validation roll-out error against each setting, a panel each, on a logarithmic axis.",
        ),
    }
    return {name: draw_picture(tuning.folder, name, draw, alt) for name, (draw, alt) in drawings.items()}
