"""What a search leaves behind: tables, pictures, a page, and the best settings as a configuration."""

import csv
import io
import logging
import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from rich.console import Console
from rich.table import Table

from ...io.files import OWN_OPTIONS, write_json, write_text
from ...report.page import number_text
from .page import TuningReport, write_tuning_report
from .space import Dimension, with_settings
from .study import Outcome, SharedStudy

log = logging.getLogger(__name__)

SUMMARY = "tune.json"
TABLE = "trials.csv"
PAGE = "tune.html"
_PRINTED = 5  # trials


@dataclass(frozen=True)
class Tuning:
    """What is searched.

    Attributes:
        config: the whole configuration.
        groups: ``network`` and ``trainer`` of every trial but for what is searched.
        space: what each setting may be, by dotted key.
        folder: of the study.
        configured_mm: roll-out error on the validation split of the network that is trained as configured [mm]; None
            where it diverges.
    """

    config: Mapping[str, Any]
    groups: Mapping[str, Any]
    space: Mapping[str, Dimension]
    folder: Path
    configured_mm: float | None

    @property
    def name(self) -> str:
        """By which later runs name the best settings."""
        return str(self.config["tune"]["save_as"])

    @property
    def option(self) -> Path:
        """The file that they find them in."""
        return Path(OWN_OPTIONS) / "tuned" / f"{self.name}.yaml"


def ranked(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The complete trials that did not diverge, the best one first."""
    finite = [
        (each.error, each.number, each)
        for each in outcomes
        if each.state == "complete" and each.error is not None and math.isfinite(each.error)
    ]
    return [each for *_, each in sorted(finite, key=lambda row: row[:2])]


def write_results(tuning: Tuning, study: SharedStudy) -> None:
    """Writes tune.json and trials.csv, and the best settings as a configuration."""
    outcomes = study.outcomes()
    best = ranked(outcomes)
    names = list(tuning.space)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["trial", "state", "rollout_error_mm", "seconds", *names])
    for each in outcomes:
        row = [each.number, each.state, each.error, None if each.seconds is None else round(each.seconds, 3)]
        table.writerow([*row, *(each.settings.get(name) for name in names)])
    write_text(tuning.folder / TABLE, text.getvalue())
    summary = {
        "model": tuning.config["tune"]["model"],
        "trials": {state: sum(each.state == state for each in outcomes) for state in _STATES},
        "wanted": study.trials,
        "configured_rollout_error_mm": tuning.configured_mm,
        "seconds": sum(each.seconds or 0.0 for each in outcomes),
        "best": _described(best[0]) if best else None,
        "importance": study.importance(),
    }
    write_json(tuning.folder / SUMMARY, summary)
    if best:
        write_text(tuning.option, option_text(tuning, best[0], len(outcomes)))


_STATES = ("complete", "pruned", "failed", "running")


def _described(outcome: Outcome) -> dict[str, Any]:
    return {"trial": outcome.number, "rollout_error_mm": outcome.error, "settings": dict(outcome.settings)}


def option_text(tuning: Tuning, best: Outcome, trials: int) -> str:
    """An option of the group ``tuned``: all of ``network`` and ``trainer`` as the best trial had them."""
    groups = with_settings(tuning.groups, best.settings)
    found: dict[str, Any] = {key: groups[key] for key in ("network", "trainer")}
    if tuning.config["tune"]["model"] == "simfree":
        found = {"simfree": found}
    command = shlex.join(["warp-resphys", "tune", *HydraConfig.get().overrides.task])
    head = [
        "# @package _global_",
        f"# Trial {best.number} of {trials} until {datetime.now(UTC).date()}: roll-out error of "
        f"{number_text(best.error)} mm on the validation split. Found by",
        f"#   {command}",
        f"# Without it, as configured there: {number_text(tuning.configured_mm)} mm. To use it: tuned={tuning.name}",
    ]
    return "\n".join([*head, str(OmegaConf.to_yaml({"tuned": tuning.name, **found}))])


def write_pictures(tuning: Tuning, study: SharedStudy) -> None:
    """Writes history.png, importance.png and settings.png, and tune.html, which shows them and the trials."""
    outcomes = study.outcomes()
    report = TuningReport(
        title=tuning.config["title"],
        experiment=tuning.config["name"],
        model=tuning.config["tune"]["model"],
        wanted=study.trials,
        outcomes=outcomes,
        ranked=ranked(outcomes),
        configured_mm=tuning.configured_mm,
        importance=study.importance(),
        space=tuning.space,
        option=str(tuning.option),
        name=tuning.name,
        settings={key: tuning.groups[key] for key in ("network", "trainer", "seed")},
    )
    write_tuning_report(tuning.folder / PAGE, report)


def print_best(tuning: Tuning, study: SharedStudy) -> None:
    """Prints the best trials, and how to use what was found."""
    best = ranked(study.outcomes())
    console = Console()
    if not best:
        console.print("Every trial diverged: search closer to settings that work, see tune.space.")
        return
    names = [name.rpartition(".")[2] for name in tuning.space]
    table = Table("trial", "error [mm]", *names, title="Best trials: roll-out error on the validation split")
    for each in best[:_PRINTED]:
        values = (_short(each.settings[name]) for name in tuning.space)
        table.add_row(str(each.number), number_text(each.error), *values)
    console.print(table)
    console.print(f"Page: {os.path.relpath(tuning.folder / PAGE)}", soft_wrap=True)
    console.print(f"To use the best settings: tuned={tuning.name} ({tuning.option})", soft_wrap=True)
    as_configured = f"As configured: {number_text(tuning.configured_mm)} mm"
    error = best[0].error
    beaten = tuning.configured_mm is None or (error is not None and error < tuning.configured_mm)
    console.print(as_configured if beaten else f"{as_configured}, which no trial has beaten")


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
