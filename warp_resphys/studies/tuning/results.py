"""What a search leaves behind: tables, pictures, a page, and the best settings as a configuration."""

import math
import os
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from ...io.files import write_json, write_text
from ...io.labels import OWN_OPTIONS
from ...report.page import (
    NO_BREAK_SPACE,
    Canvas,
    Cell,
    Drawn,
    PageTable,
    Part,
    Row,
    Text,
    duration_text,
    flatten,
    number_text,
    write_page,
)
from ..command import show, table_of, write_csv
from . import figures
from .space import Tune, with_settings
from .study import Outcome, Study

PAGE = "tune.html"
_PRINTED = 5  # trials
_PAGE_SECONDS = 60.0  # between two drawings of the page
_STATES = ("complete", "pruned", "failed", "running")
_MODELS = {"resphys": "ResPhys", "simfree": "SimFree"}


@dataclass(frozen=True)
class SearchResults:
    """The results of a search.

    Attributes:
        config: the whole configuration.
        tune: the group of that name.
        groups: what every trial is trained with, such as ``network``, but for what varies.
        study: its trials.
        configured_mm: roll-out error on the validation split of training as configured; None: it diverges.
    """

    config: Mapping[str, Any]
    tune: Tune
    groups: Mapping[str, Any]
    study: Study
    configured_mm: float | None

    @property
    def option(self) -> Path:
        """The file in which later runs find the best settings."""
        return Path(OWN_OPTIONS) / "tuned" / f"{self.tune.save_as}.yaml"

    def as_configured(self, best: Outcome) -> str:
        """The error to beat, and whether a trial has."""
        beaten = self.configured_mm is None or (best.error is not None and best.error < self.configured_mm)
        return f"As configured: {number_text(self.configured_mm)} mm{'' if beaten else ', which no trial has beaten'}"


def ranked(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The complete trials that did not diverge, the best one first."""
    finite = [each for each in outcomes if each.state == "complete" and math.isfinite(each.error or 0.0)]
    return sorted(finite, key=lambda each: (each.error, each.number))


def short_text(value: Any) -> str:
    """A setting as one reads it."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def write_results(results: SearchResults, finished: bool = False) -> None:
    """Writes tune.json, trials.csv and the best settings; the page too, at the end or if its last drawing is old."""
    study = results.study
    with FileLock(study.folder / "results.lock"):
        outcomes = study.outcomes()
        rows = [
            {"trial": each.number, "state": each.state, "rollout_error_mm": each.error}
            | {"seconds": None if each.seconds is None else round(each.seconds, 3)}
            | {name: each.settings.get(name) for name in study.space}
            for each in outcomes
        ]
        write_csv(study.folder / "trials.csv", rows)
        best = next(iter(ranked(outcomes)), None)
        summary = {
            "model": results.tune.model,
            "trials": {state: sum(each.state == state for each in outcomes) for state in _STATES},
            "wanted": study.trials,
            "configured_rollout_error_mm": results.configured_mm,
            "seconds": sum(each.seconds or 0.0 for each in outcomes),
            "best": best and {"trial": best.number, "rollout_error_mm": best.error, "settings": dict(best.settings)},
            "importance": study.importance(),
        }
        write_json(study.folder / "tune.json", summary)
        if best:
            write_text(results.option, _option_text(results, best, len(outcomes)))
        page = study.folder / PAGE
        if finished or not page.is_file() or time.time() - page.stat().st_mtime > _PAGE_SECONDS:
            _write_page(results, outcomes)


def _option_text(results: SearchResults, best: Outcome, trials: int) -> str:
    """An option of the group ``tuned``: all of ``network`` and ``trainer`` as the best trial had them."""
    groups = with_settings(results.groups, best.settings)
    found: dict[str, Any] = {key: groups[key] for key in ("network", "trainer")}
    if results.tune.model == "simfree":
        found = {"simfree": found}
    head = [
        "# @package _global_",
        f"# Trial {best.number} of {trials} until {datetime.now(UTC).date()}: roll-out error of "
        f"{number_text(best.error)} mm on the validation split. Found by",
        f"#   {shlex.join(['warp-resphys', 'tune', *HydraConfig.get().overrides.task])}",
        f"# {results.as_configured(best)}. To use these: tuned={results.tune.save_as}",
    ]
    return "\n".join([*head, str(OmegaConf.to_yaml({"tuned": results.tune.save_as, **found}))])


def print_best(results: SearchResults) -> None:
    """Prints the best trials, and how to use their settings."""
    best = ranked(results.study.outcomes())
    if not best:
        show("Every trial diverged: search closer to settings that work, see tune.space.")
        return
    headings = ["trial", "error [mm]", *(key.rpartition(".")[2] for key in results.study.space)]
    rows = [[str(each.number), *_values(results, each)] for each in best[:_PRINTED]]
    show(
        table_of("Best trials: roll-out error on the validation split", headings, rows),
        f"Page: {os.path.relpath(results.study.folder / PAGE)}",
        f"To use the best settings: tuned={results.tune.save_as} ({results.option})",
        results.as_configured(best[0]),
    )


def _values(results: SearchResults, trial: Outcome) -> list[str]:
    """Error and settings of a trial."""
    return [number_text(trial.error), *(short_text(trial.settings[key]) for key in results.study.space)]


def _write_page(results: SearchResults, outcomes: Sequence[Outcome]) -> None:
    """Writes history.png, importance.png and settings.png, and tune.html, which shows them and the trials."""
    best, space = ranked(outcomes), results.study.space
    last = [key.rpartition(".")[2] for key in space]
    names = {key: name if last.count(name) == 1 else key for key, name in zip(space, last, strict=True)}
    rows = [
        Row(str(each.number), [Cell(text) for text in (*_values(results, each), duration_text(each.seconds or 0.0))])
        for each in best
    ]
    shown: list[Drawn | Text | PageTable] = [*_drawn(results.study, outcomes, names, results.configured_mm)]
    if best:
        use = f"To run with the best settings: tuned={results.tune.save_as}, which stands in {results.option}."
        shown += [Text(use), PageTable("Trial", ["Error [mm]", *names.values(), "Wall time"], rows)]
    fixed = flatten({key: results.groups[key] for key in ("network", "trainer", "seed")})
    common = [Row(key, [Cell(value)]) for key, value in fixed if key not in space]
    searched = [
        PageTable("Setting", ["Range"], [Row(key, [Cell(str(dimension))]) for key, dimension in space.items()]),
        PageTable("Setting", ["Value"], common, summary="What all trials have in common"),
    ]
    write_page(
        results.study.folder / PAGE,
        title=results.config["title"],
        kicker=f"experiment {results.config['name']}, search for the settings of {_MODELS[results.tune.model]}",
        verdict=_verdict(results, outcomes, best),
        parts=[Part("", shown), Part("What was searched", searched)],
    )


def _verdict(results: SearchResults, outcomes: Sequence[Outcome], best: Sequence[Outcome]) -> str:
    """The best trial, and how many there were."""
    complete, pruned = (sum(each.state == state for each in outcomes) for state in ("complete", "pruned"))
    asides = [f"{pruned} given up, as they took too long"] if pruned else []
    asides += [f"{complete - len(best)} diverged"] if complete > len(best) else []
    said = f"{complete + pruned} of {results.study.trials} trials are finished"
    said += f" ({', '.join(asides)})." if asides else "."
    if not best:
        return f"{said} None of them came to a roll-out that stays finite."
    found = f"The best settings, of trial {best[0].number}, come to {number_text(best[0].error)} mm on the validation "
    return f"{found}split. {results.as_configured(best[0])}. {said}".replace(" mm", f"{NO_BREAK_SPACE}mm")


def _drawn(
    study: Study, outcomes: Sequence[Outcome], names: Mapping[str, str], configured_mm: float | None
) -> list[Drawn]:
    """The three figures; `names` are those of the settings on their axes."""
    errors, pruned = np.full((2, len(outcomes)), np.nan)
    for each in outcomes:
        if each.error is not None and each.state in ("complete", "pruned"):
            (errors if each.state == "complete" else pruned)[each.number] = each.error
    best = ranked(outcomes)
    shares = {names[key]: share for key, share in study.importance().items()}
    tried = [{names[key]: value for key, value in each.settings.items()} for each in best]
    space = {names[key]: dimension for key, dimension in study.space.items()}
    scatter = np.array([each.error for each in best], dtype=np.float64)
    canvas = Canvas(study.folder)
    return [
        canvas.figure(
            "history",
            partial(figures.search_history, errors, pruned, configured_mm),
            f"Validation roll-out error of {len(outcomes)} trials and the best so far, on a logarithmic axis.",
            "Error of each trial: the mean vertex error of roll-outs of the validation split.",
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
            f"Importance of each setting: {', '.join(f'{name} {share:.0%}' for name, share in shares.items())}.",
            "How much each setting tells the best quarter of the trials from the others (PED-ANOVA). With few trials, "
            "an order of magnitude at best.",
        ),
    ]
