"""The command `tune`: a search for settings, shared by any number of processes."""

import hashlib
import json
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optuna import TrialPruned
from optuna.trial import TrialState

from ...experiment.experiment import LEARNED, Experiment
from ...experiment.files import training_file
from ...experiment.learn import Learning, Snapshot, run_epochs
from ...experiment.trials import folds_of, split_of
from ...io.errors import DataFileError, InputError
from ...io.fan_out import Advance, WorkerError, Workers, fan_out
from ...io.files import read_json
from ...io.progress import Progress, clock
from ...io.resumable import forget_checkpoint, keep_checkpoint, resume_checkpoint
from ...io.settings import parse
from ...io.stages import Stage, StageInterrupted, run_stages
from ...pipeline import acquire, acquisition_stages, learning_stages, prepare, workers_of
from ...settings.learning import TrainingSettings
from ...settings.run import RunSettings
from .results import SearchResults, print_best, ranked, searched_groups, short_text, write_results
from .space import Dimension, Tune, with_settings
from .study import Claim, Study

log = logging.getLogger(__name__)

_POLL_SECONDS = 0.5


def run_tuning(run: RunSettings, run_dir: Path) -> None:
    """Runs trials of the configured study until it has its number of them, and writes the best settings as an option.

    The stages of a run come first, up to the training as configured, whose error the search has to beat.

    Raises:
        InputError: a value that cannot be used, or a study with another search space or other conditions.
        DataFileError: a file cannot be read or written.
        StageInterrupted: the user pressed Ctrl-C; finished work is kept.
    """
    prepare(run)
    search = Search.of(run, run_dir.absolute())  # Refuses a study with other conditions before anything is computed.
    _, acquired = acquire(run, run_dir, wait=True)
    run_stages(stages_before(run, search.tune.model, acquired), run_dir, wait=True)
    kept = read_json(run_dir / training_file(search.tune.model))["kept"]
    results = SearchResults(run, search.tune, search.training, search.study, kept["validation_rollout_error_mm"])
    workers = workers_of(run).at_most(search.study.trials - search.study.finished())
    if not workers.alone:
        _share(search, acquired, workers, results)
    _work(search, acquired, lambda count=1, **shown: write_results(results) if count else None)
    write_results(results, finished=True)
    print_best(results)


@dataclass(frozen=True)
class Search:
    """A search in a run folder.

    Attributes:
        run: settings of the run.
        run_dir: its folder.
        tune: settings of the search.
        training: settings of every trial, before those of the search space are changed.
        study: the trials.
    """

    run: RunSettings
    run_dir: Path
    tune: Tune
    training: TrainingSettings
    study: Study

    @classmethod
    def of(cls, run: RunSettings, run_dir: Path) -> "Search":
        """Checks the group ``tune`` of a run, and opens its study.

        Raises:
            InputError, DataFileError: see `check_tuning` and `Study`.
        """
        tune, space, training = check_tuning(run)
        groups, stages = training.plain(), [*acquisition_stages(run), *stages_before(run, tune.model, "")]
        conditions = {"model": tune.model, **_settings_of(stages), **groups}
        for group in searched_groups(training):
            conditions[group] = {name: v for name, v in groups[group].items() if f"{group}.{name}" not in space}
        study = Study(run_dir / "tune" / tune.study, space, conditions, tune.trials, tune.seed)
        return cls(run, run_dir, tune, training, study)


def check_tuning(run: RunSettings) -> tuple[Tune, dict[str, Dimension], TrainingSettings]:
    """Checks the group ``tune`` and all values of the search space.

    Returns:
        The group, the search space by dotted key, and the settings of every trial outside of that space.

    Raises:
        InputError: a value of the wrong kind or out of range.
    """
    tune = parse(Tune, run.tune, "tune")
    if run.ablation is not None:
        raise InputError(f"the experiment {run.name} trains no network: tune another one.")
    if folds_of(run) is not None:
        raise InputError(
            "a search needs one split, and data.folds makes several: set data.folds to null, and data.train, "
            "data.validation and data.test."
        )
    learned = [model for model in run.models if model in LEARNED]
    if tune.model not in learned:
        raise InputError(f"tune.model is {tune.model!r}: choose one of {', '.join(learned)}.")
    space, fixed = tune.dimensions, tune.settings.dotted()
    if both := fixed.keys() & space.keys():
        raise InputError(f"tune.settings.{min(both)} and tune.space.{min(both)} exclude each other: take one out.")
    training = run.training(tune.model)
    groups = searched_groups(training)
    for key in (*fixed, *space):
        group, _, name = key.partition(".")
        if group not in groups or name not in dict(getattr(training, group)):
            raise InputError(f"unknown key '{key}' in the group tune: it must name a setting of {', '.join(groups)}.")
    try:
        training = with_settings(training, fixed)
        for key, dimension in space.items():
            for value in dimension.ends:
                with_settings(training, {key: value})
    except InputError as error:
        raise InputError(f"tune: {error}") from error
    return tune, space, training


def stages_before(run: RunSettings, model: str, acquired: str) -> list[Stage]:
    """Returns the stages of a run after its dataset, of a given fingerprint, up to the training of a model."""
    stages = {stage.name: stage for stage in learning_stages(run, split_of(run), ".", acquired)}

    def before(name: str) -> list[str]:
        return [*(earlier for needed in stages[name].upstream for earlier in before(needed)), name]

    wanted = set(before(f"train_{model}"))
    return [stage for name, stage in stages.items() if name in wanted]


def _settings_of(stages: Sequence[Stage]) -> dict[str, Any]:
    """The merged settings of stages, without the fingerprint of the dataset."""
    merged: dict[str, Any] = {}
    for key, value in (item for stage in stages for item in stage.settings.plain().items() if item[0] != "acquired"):
        before = merged.get(key)
        merged[key] = {**before, **value} if isinstance(before, dict) and isinstance(value, dict) else value
    return merged


def _share(search: Search, acquired: str, workers: Workers, results: SearchResults) -> None:
    """Runs trials in worker processes until the study has its number of them."""
    study, done = search.study, search.study.finished()

    def advance(count: int = 1, **shown: object) -> None:
        nonlocal done
        if count:  # A trial has ended, or a worker was lost: the study counts the finished trials.
            before, done = done, study.finished()
            progress.advance(done - before, **shown)
            write_results(results)

    tasks = [(search.run, search.run_dir, acquired)] * workers.count
    try:
        with Progress(f"{workers.count} workers", study.trials, "trials", done) as progress:
            fan_out(_join, tasks, workers, advance, study.folder)
    except KeyboardInterrupt as error:
        raise StageInterrupted(
            "interrupted; finished epochs of the running trials are kept, and the same command continues from there"
        ) from error


def _join(task: tuple[RunSettings, Path, str], advance: Advance) -> None:
    """Runs trials of a study in a worker process."""
    run, run_dir, acquired = task
    _work(Search.of(run, run_dir), acquired, advance)


def _work(search: Search, acquired: str, advance: Advance) -> None:
    """Runs trials until there are enough, then waits for those of other processes, which may have to be taken over.

    Args:
        search: with the study.
        acquired: fingerprint of the dataset.
        advance: called after each epoch (with zero) and trial (with one, and the best trial); may raise.
    """
    training = stages_before(search.run, search.tune.model, acquired)[-1]
    learning = Learning(Experiment(training.settings, search.run_dir), search.tune.model)
    fingerprint = _digest({**training.settings.plain(), **search.training.plain()})
    waiting = False
    while (claim := search.study.claim()) is not None or (others := search.study.running()):
        if claim is not None:
            try:
                _run_trial(search, learning, claim, f"{fingerprint} {_digest(claim.settings)}", advance)
            finally:
                claim.lock.release()
        else:
            if not waiting:
                log.info("waiting for the last trials, of %s; Ctrl-C does not stop them", ", ".join(others))
            waiting = True
            time.sleep(_POLL_SECONDS)
            advance(0)


def _digest(data: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def _run_trial(search: Search, learning: Learning, claim: Claim, fingerprint: str, advance: Advance) -> None:
    """Trains with the settings of a trial, from its checkpoint if there is one, and ends the trial with its error."""
    start, spent, study = time.perf_counter(), 0.0, search.study
    limit, path = search.tune.trial_seconds, study.folder / "trials" / f"{claim.number}.safetensors"
    words = ", ".join(f"{key} {short_text(value)}" for key, value in claim.settings.items())
    log.info("trial %d%s: %s", claim.number, " continues" if path.exists() else "", words)

    def seconds() -> float:
        return spent + time.perf_counter() - start

    def save(kept: Snapshot) -> None:
        keep_checkpoint(path, "training", kept[0], {**kept[1], "seconds": seconds(), "fingerprint": fingerprint})

    def watch(record: Mapping[str, float]) -> None:
        advance(0)
        if limit is not None and seconds() > limit:
            raise TrialPruned
        if "rollout_error_mm" in record:
            claim.trial.report(record["rollout_error_mm"], int(record["epoch"]))

    try:
        trainer = learning.trainer(with_settings(search.training, claim.settings)).trainer
        if checkpoint := resume_checkpoint(path, "training", fingerprint):
            trainer.resume(*checkpoint)
            spent = float(checkpoint[1]["seconds"])
        run_epochs(f"trial {claim.number}", trainer, save, watch)
        trainer.use_best()
        study.end(claim, trainer.best_error if math.isfinite(trainer.best_error) else math.inf, seconds())
    except TrialPruned:
        study.end(claim, None, seconds(), TrialState.PRUNED)
    except KeyboardInterrupt as error:
        raise StageInterrupted(
            f"interrupted in trial {claim.number} (its finished epochs are kept); the same command continues from there"
        ) from error
    except (DataFileError, OSError, WorkerError):
        raise  # Not caused by the trial: the next process continues it.
    except Exception as error:
        study.end(claim, None, seconds(), TrialState.FAIL)
        forget_checkpoint(path)
        if isinstance(error, InputError):
            raise InputError(f"trial {claim.number} ({words}): {error}") from error
        raise
    forget_checkpoint(path)
    outcomes = study.outcomes()
    best = ranked(outcomes)
    ended = [outcome.seconds or 0.0 for outcome in outcomes if outcome.state in ("complete", "pruned")]
    shown = {"best": f"{best[0].error:.3g} mm of trial {best[0].number}"} if best else {}
    left = (study.trials - len(ended)) * sum(ended) / max(len(ended), 1) / (1 + len(study.running()))
    progress = [
        f"{len(ended)} of {study.trials} done",
        *shown.values(),
        *([f"about {clock(left)} left"] if left else []),
    ]
    log.info("trial %d took %s: %s", claim.number, clock(seconds()), ", ".join(progress))
    advance(1, **shown)
