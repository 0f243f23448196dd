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

from ...io.files import write_json, write_text
from ...io.labels import OWN_OPTIONS
from ...report.page import (
    NO_BREAK_SPACE,
    Canvas,
    Cell,
    Drawn,
    Part,
    Row,
    Table,
    Text,
    duration_text,
    flatten,
    number_text,
    write_page,
)
from ..command import show, table_of, write_csv
from . import figures
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
    """What is searched."""

    config: Mapping[str, Any]  # all of it
    groups: Mapping[str, Any]  # what every trial is trained with, such as ``network``, but for what is searched
    space: Mapping[str, Dimension]  # what each setting may be, by dotted key
    study: SharedStudy
    configured_mm: float | None  # roll-out error on the validation split of training as configured; None: it diverges

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
    finite = [each for each in outcomes if each.state == "complete" and math.isfinite(each.error or 0.0)]
    return sorted(finite, key=lambda each: (each.error, each.number))


def short_text(value: Any) -> str:
    """A setting as one reads it."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def write_results(tuning: Tuning) -> None:
    """Writes tune.json and trials.csv, and the best settings as a configuration."""
    outcomes = tuning.study.outcomes()
    rows = [
        {"trial": each.number, "state": each.state, "rollout_error_mm": each.error}
        | {"seconds": None if each.seconds is None else round(each.seconds, 3)}
        | {name: each.settings.get(name) for name in tuning.space}
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
    if not best:
        show("Every trial diverged: search closer to settings that work, see tune.space.")
        return
    headings = ["trial", "error [mm]", *(key.rpartition(".")[2] for key in tuning.space)]
    rows = [[str(each.number), *_values(tuning, each)] for each in best[:_PRINTED]]
    beaten = "" if tuning.beaten_by(best[0]) else ", which no trial has beaten"
    show(
        table_of("Best trials: roll-out error on the validation split", headings, rows),
        f"Page: {os.path.relpath(tuning.folder / PAGE)}",
        f"To use the best settings: tuned={tuning.name} ({tuning.option})",
        f"As configured: {number_text(tuning.configured_mm)} mm{beaten}",
    )


def _values(tuning: Tuning, trial: Outcome) -> list[str]:
    """Error and settings of a trial."""
    return [number_text(trial.error), *(short_text(trial.settings[key]) for key in tuning.space)]


def write_pictures(tuning: Tuning) -> None:
    """Writes history.png, importance.png and settings.png, and tune.html, which shows them and the trials."""
    outcomes = tuning.study.outcomes()
    best = ranked(outcomes)
    last = [key.rpartition(".")[2] for key in tuning.space]
    names = {key: name if last.count(name) == 1 else key for key, name in zip(tuning.space, last, strict=True)}
    trials = [
        Row(str(each.number), [Cell(text) for text in (*_values(tuning, each), duration_text(each.seconds or 0.0))])
        for each in best
    ]
    space = [Row(key, [Cell(str(dimension))]) for key, dimension in tuning.space.items()]
    common = [
        Row(key, [Cell(value)])
        for key, value in flatten({key: tuning.groups[key] for key in ("network", "trainer", "seed")})
        if key not in tuning.space
    ]
    use = f"To run with the best settings: tuned={tuning.name}, which stands in {tuning.option}."
    table = Table("Trial", ["Error [mm]", *names.values(), "Wall time"], trials)
    results: list[Drawn | Text | Table] = [*_drawn(tuning, outcomes, best, names)]
    results += [Text(use), table] if best else []
    searched = [
        Table("Setting", ["Range"], space),
        Table("Setting", ["Value"], common, summary="What all trials have in common"),
    ]
    model = _MODELS[tuning.config["tune"]["model"]]
    write_page(
        tuning.folder / PAGE,
        title=tuning.config["title"],
        kicker=f"experiment {tuning.config['name']}, search for the settings of {model}",
        verdict=_verdict(tuning, outcomes, best),
        parts=[Part("", results), Part("What was searched", searched)],
    )


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


def _drawn(
    tuning: Tuning, outcomes: Sequence[Outcome], best: Sequence[Outcome], names: Mapping[str, str]
) -> list[Drawn]:
    errors, pruned = np.full((2, len(outcomes)), np.nan)
    for each in outcomes:
        if each.error is not None and each.state in ("complete", "pruned"):
            (errors if each.state == "complete" else pruned)[each.number] = each.error
    shares = {names[key]: share for key, share in tuning.study.importance().items()}
    tried = [{names[key]: value for key, value in each.settings.items()} for each in best]
    space = {names[key]: dimension for key, dimension in tuning.space.items()}
    scatter = np.array([each.error for each in best], dtype=np.float64)
    told = ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
    canvas = Canvas(tuning.folder)
    return [
        canvas.figure(
            "history",
            partial(figures.search_history, errors, pruned, tuning.configured_mm),
            f"Validation roll-out error of {len(outcomes)} trials and the best so far, on a logarithmic axis.",
            "What each trial came to: the mean vertex error of roll-outs of the validation split.",
        ),
        canvas.figure(
            "settings",
            partial(figures.setting_scatter, scatter, tried, space),
            "Validation roll-out error against each setting, a panel each, on a logarithmic axis.",
            "The same errors against each setting; the orange point is the best trial. Trials that diverged or were "
            "given up are left out.",
        ),
        canvas.figure(
            "importance",
            partial(figures.importance_bars, shares),
            f"Importance of each setting: {told}.",
            "How much each setting tells the best quarter of the trials from the others (PED-ANOVA). With few trials, "
            "an order of magnitude at best.",
        ),
    ]
