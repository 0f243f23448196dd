"""Results of a search: tables, pictures, a page, and the best settings as an option."""

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
from ...settings.learning import TrainingSettings
from ...settings.run import RunSettings
from ..tables import Sheet, show, write_csv
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
        run: settings of the run.
        tune: settings of the search.
        training: settings of every trial, before those of the search space are changed.
        study: the trials.
        configured_mm: roll-out error on the validation split of training as configured; None where it diverges.
    """

    run: RunSettings
    tune: Tune
    training: TrainingSettings
    study: Study
    configured_mm: float | None

    @property
    def option(self) -> Path:
        """File with the best settings, for later runs."""
        return Path(OWN_OPTIONS) / "tuned" / f"{self.tune.save_as}.yaml"

    def as_configured(self, best: Outcome) -> str:
        """Describes the error of training as configured, and whether a trial has beaten it."""
        beaten = self.configured_mm is None or (best.error is not None and best.error < self.configured_mm)
        return f"As configured: {number_text(self.configured_mm)} mm{'' if beaten else ', which no trial has beaten'}"


def ranked(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Returns the complete trials that did not diverge, the best one first."""
    finite = [trial for trial in outcomes if trial.state == "complete" and math.isfinite(trial.error or 0.0)]
    return sorted(finite, key=lambda trial: (trial.error, trial.number))


def searched_groups(training: TrainingSettings) -> list[str]:
    """Returns the groups of settings with which a model is trained."""
    return ["network", "trainer" if training.in_the_loop is None else "in_the_loop"]


def short_text(value: Any) -> str:
    """Formats a setting with three digits."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def write_results(results: SearchResults, finished: bool = False) -> None:
    """Writes tune.json, trials.csv, the best settings and, at the end or every minute, the page."""
    study = results.study
    with FileLock(study.folder / "results.lock"):
        outcomes = study.outcomes()
        rows = [
            {"trial": trial.number, "state": trial.state, "rollout_error_mm": trial.error}
            | {"seconds": None if trial.seconds is None else round(trial.seconds, 3)}
            | {name: trial.settings.get(name) for name in study.space}
            for trial in outcomes
        ]
        write_csv(study.folder / "trials.csv", rows)
        best = next(iter(ranked(outcomes)), None)
        summary = {
            "model": results.tune.model,
            "trials": {state: sum(trial.state == state for trial in outcomes) for state in _STATES},
            "wanted": study.trials,
            "configured_rollout_error_mm": results.configured_mm,
            "seconds": sum(trial.seconds or 0.0 for trial in outcomes),
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
    """An option of the group ``tuned``: all settings of the training as in the best trial, but for the seed."""
    training = with_settings(results.training, best.settings).plain()
    settings: dict[str, Any] = {key: value for key, value in training.items() if key != "seed" and value is not None}
    if results.tune.model == "simfree":
        settings = {"simfree": settings}
    head = [
        "# @package _global_",
        f"# Trial {best.number} of {trials} until {datetime.now(UTC).date()}: roll-out error of "
        f"{number_text(best.error)} mm on the validation split. Found by",
        f"#   {shlex.join(['warp-resphys', 'tune', *HydraConfig.get().overrides.task])}",
        f"# {results.as_configured(best)}. To use these: tuned={results.tune.save_as}",
    ]
    return "\n".join([*head, str(OmegaConf.to_yaml({"tuned": results.tune.save_as, **settings}))])


def print_best(results: SearchResults) -> None:
    """Prints the best trials, and how to use their settings."""
    best = ranked(results.study.outcomes())
    if not best:
        show("Every trial diverged: choose a tune.space closer to settings that work.")
        return
    headings = ["trial", "error [mm]", *(key.rpartition(".")[2] for key in results.study.space)]
    rows = [[str(trial.number), *_values(results, trial)] for trial in best[:_PRINTED]]
    show(
        Sheet("Best trials: roll-out error on the validation split", headings, rows),
        f"Page: {os.path.relpath(results.study.folder / PAGE)}",
        f"To use the best settings: tuned={results.tune.save_as} ({results.option})",
        results.as_configured(best[0]),
    )


def _values(results: SearchResults, trial: Outcome) -> list[str]:
    """Error and settings of a trial."""
    return [number_text(trial.error), *(short_text(trial.settings[key]) for key in results.study.space)]


def _write_page(results: SearchResults, outcomes: Sequence[Outcome]) -> None:
    """Writes history.png, importance.png, settings.png, and tune.html with these figures and the trials."""
    best, space = ranked(outcomes), results.study.space
    last = [key.rpartition(".")[2] for key in space]
    names = {key: name if last.count(name) == 1 else key for key, name in zip(space, last, strict=True)}
    rows = [
        Row(str(trial.number), [Cell(text) for text in (*_values(results, trial), duration_text(trial.seconds or 0.0))])
        for trial in best
    ]
    shown: list[Drawn | Text | PageTable] = [*_drawn(results.study, outcomes, names, results.configured_mm)]
    if best:
        use = f"To run with the best settings: tuned={results.tune.save_as}, which stands in {results.option}."
        shown += [Text(use), PageTable("Trial", ["Error [mm]", *names.values(), "Wall time"], rows)]
    fixed = flatten(results.training.model_dump(mode="json", exclude={"in_the_loop"}))
    common = [Row(key, [Cell(value)]) for key, value in fixed if key not in space]
    searched = [
        PageTable("Setting", ["Range"], [Row(key, [Cell(str(dimension))]) for key, dimension in space.items()]),
        PageTable("Setting", ["Value"], common, summary="Settings of all trials"),
    ]
    write_page(
        results.study.folder / PAGE,
        title=results.run.title,
        kicker=f"experiment {results.run.name}, search for the settings of {_MODELS[results.tune.model]}",
        verdict=_verdict(results, outcomes, best),
        parts=[Part("", shown), Part("Search space", searched)],
    )


def _verdict(results: SearchResults, outcomes: Sequence[Outcome], best: Sequence[Outcome]) -> str:
    """Sentences on the best trial and the number of trials."""
    complete, pruned = (sum(trial.state == state for trial in outcomes) for state in ("complete", "pruned"))
    asides = [f"{pruned} stopped, as they took too long"] if pruned else []
    asides += [f"{complete - len(best)} diverged"] if complete > len(best) else []
    count = f"{complete + pruned} of {results.study.trials} trials are finished"
    count += f" ({', '.join(asides)})." if asides else "."
    if not best:
        return f"{count} None of them has finite roll-outs."
    first = (
        f"The best settings, of trial {best[0].number}, reach {number_text(best[0].error)} mm on the validation split"
    )
    return f"{first}. {results.as_configured(best[0])}. {count}".replace(" mm", f"{NO_BREAK_SPACE}mm")


def _drawn(
    study: Study, outcomes: Sequence[Outcome], names: Mapping[str, str], configured_mm: float | None
) -> list[Drawn]:
    """Draws the three figures, with settings labelled by ``names``."""
    errors, pruned = np.full((2, len(outcomes)), np.nan)
    for trial in outcomes:
        if trial.error is not None and trial.state in ("complete", "pruned"):
            (errors if trial.state == "complete" else pruned)[trial.number] = trial.error
    best = ranked(outcomes)
    shares = {names[key]: share for key, share in study.importance().items()}
    tried = [{names[key]: value for key, value in trial.settings.items()} for trial in best]
    space = {names[key]: dimension for key, dimension in study.space.items()}
    scatter = np.array([trial.error for trial in best], dtype=np.float64)
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
            "Error over each setting; the orange point is the best trial. Trials that diverged or were stopped are "
            "left out.",
        ),
        canvas.figure(
            "importance",
            partial(figures.importance_bars, shares),
            f"Importance of each setting: {', '.join(f'{name} {share:.0%}' for name, share in shares.items())}.",
            "Importance of each setting for being among the best quarter of the trials (PED-ANOVA); with few trials, "
            "an order of magnitude at best.",
        ),
    ]
