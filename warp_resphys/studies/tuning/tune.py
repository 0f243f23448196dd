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
from .results import SearchResults, print_best, ranked, short_text, write_results
from .space import Dimension, Tune, with_settings
from .study import Claim, Study

log = logging.getLogger(__name__)

_POLL_SECONDS = 0.5


def run_tuning(config: Mapping[str, Any], run_dir: Path) -> None:
    """Works on the configured study until it has its number of trials; the best settings become a configuration.

    The stages of a run come first, up to the training as configured: what the search has to beat.

    Raises:
        InputError: a value that cannot be used, or a study of another search space or other conditions.
        DataFileError: a file cannot be read or written.
        StageInterrupted: the user pressed Ctrl-C; what is done so far is kept.
    """
    run = parse(RunSettings, config)
    prepare(run)
    search = Search.of(config, run_dir.absolute())  # Refuses a study of something else before anything is computed.
    _, acquired = acquire(run, run_dir, wait=True)
    run_stages(stages_before(run, search.tune.model, acquired), run_dir, wait=True)
    kept = read_json(run_dir / training_file(search.tune.model))["kept"]
    results = SearchResults(config, search.tune, search.groups, search.study, kept["validation_rollout_error_mm"])
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
        config: the whole configuration.
        run_dir: of the run whose settings are searched.
        tune: the group of that name.
        groups: what every trial is trained with, such as ``network``, but for what varies.
        study: its trials.
    """

    config: Mapping[str, Any]
    run_dir: Path
    tune: Tune
    groups: Mapping[str, Any]
    study: Study

    @classmethod
    def of(cls, config: Mapping[str, Any], run_dir: Path) -> "Search":
        """Checks the group ``tune`` of a configuration, and opens its study.

        Raises:
            InputError, DataFileError: see `check_tuning` and `Study`.
        """
        tune, space, groups = check_tuning(config)
        run = parse(RunSettings, config)
        stages = [*acquisition_stages(run), *stages_before(run, tune.model, "")]
        conditions = {"model": tune.model, **_settings_of(stages), **groups}
        for group in _trained_with(groups):
            conditions[group] = {name: v for name, v in groups[group].items() if f"{group}.{name}" not in space}
        study = Study(run_dir / "tune" / tune.study, space, conditions, tune.trials, tune.seed)
        return cls(config, run_dir, tune, groups, study)


def check_tuning(config: Mapping[str, Any]) -> tuple[Tune, dict[str, Dimension], dict[str, Any]]:
    """Checks the group ``tune``, and all values that may be tried.

    Returns:
        The group, what may vary by dotted key, and what every trial is trained with but for that.

    Raises:
        InputError: a value of the wrong kind or out of range.
    """
    run, tune = parse(RunSettings, config), parse(Tune, config["tune"], "tune")
    if run.ablation is not None:
        raise InputError(f"the experiment {run.name} trains no network: tune another one.")
    if folds_of(run) is not None:
        raise InputError(
            "a search needs one split, and data.folds makes several: set data.folds to null, and data.train, "
            "data.validation and data.test."
        )
    known = [model for model in run.models if model in LEARNED]
    if tune.model not in known:
        raise InputError(f"tune.model is {tune.model!r}: choose one of {', '.join(known)}.")
    space, fixed = tune.dimensions, tune.settings.dotted()
    if both := fixed.keys() & space.keys():
        raise InputError(f"tune.settings.{min(both)} and tune.space.{min(both)} exclude each other: take one out.")
    groups: dict[str, Any] = run.training(tune.model).plain()
    for key in (*fixed, *space):
        group, _, name = key.partition(".")
        if group not in _trained_with(groups) or name not in groups[group]:
            known = _trained_with(groups)
            raise InputError(f"unknown key '{key}' in the group tune: it must name a setting of {', '.join(known)}.")
    groups = with_settings(groups, fixed)
    for key, value in [("", None), *((key, value) for key, each in space.items() for value in each.ends)]:
        try:
            parse(TrainingSettings, with_settings(groups, {key: value} if key else {}))
        except InputError as error:
            raise InputError(f"tune: {error}") from error
    return tune, space, groups


def _trained_with(groups: Mapping[str, Any]) -> list[str]:
    """The groups that a model is trained with."""
    return ["network", "in_the_loop" if groups["in_the_loop"] else "trainer"]


def stages_before(run: RunSettings, model: str, acquired: str) -> list[Stage]:
    """The stages of a run from the dataset of a fingerprint up to the training of a model."""
    stages = {stage.name: stage for stage in learning_stages(run, split_of(run), ".", acquired)}

    def before(name: str) -> list[str]:
        return [*(each for needed in stages[name].upstream for each in before(needed)), name]

    wanted = set(before(f"train_{model}"))
    return [stage for name, stage in stages.items() if name in wanted]


def _settings_of(stages: Sequence[Stage]) -> dict[str, Any]:
    """The settings of some stages, in place of the fingerprint of the dataset that they lead to."""
    found: dict[str, Any] = {}
    for key, value in (item for stage in stages for item in stage.settings.plain().items() if item[0] != "acquired"):
        known = found.get(key)
        found[key] = {**known, **value} if isinstance(known, dict) and isinstance(value, dict) else value
    return found


def _share(search: Search, acquired: str, workers: Workers, results: SearchResults) -> None:
    """Runs trials in worker processes until there are enough."""
    study, done = search.study, search.study.finished()

    def advance(count: int = 1, **shown: object) -> None:
        nonlocal done
        if count:  # A trial has ended, or a worker was lost; the study knows how many are done.
            before, done = done, study.finished()
            progress.advance(done - before, **shown)
            write_results(results)

    tasks = [(search.config, search.run_dir, acquired)] * workers.count
    try:
        with Progress(f"{workers.count} workers", study.trials, "trials", done) as progress:
            fan_out(_join, tasks, workers, advance, study.folder)
    except KeyboardInterrupt as error:
        raise StageInterrupted(
            "interrupted; whole epochs of the trials that ran are kept, and the same command goes on from there"
        ) from error


def _join(task: tuple[Mapping[str, Any], Path, str], advance: Advance) -> None:
    """Works on a study in a worker process."""
    config, run_dir, acquired = task
    _work(Search.of(config, run_dir), acquired, advance)


def _work(search: Search, acquired: str, tell: Advance) -> None:
    """Runs trials until there are enough; then waits for those of others, which may have to be taken over.

    Args:
        search: its study is worked on.
        acquired: fingerprint of the dataset.
        tell: is called after each epoch and trial with how many trials that makes, and the best one; may raise.
    """
    training = stages_before(parse(RunSettings, search.config), search.tune.model, acquired)[-1]
    learning = Learning(Experiment(training.settings, search.run_dir), search.tune.model)
    fingerprint = _digest({**training.settings.plain(), **search.groups})
    waiting = False
    while (claim := search.study.claim()) is not None or (others := search.study.running()):
        if claim is not None:
            try:
                _run_trial(search, learning, claim, f"{fingerprint} {_digest(claim.settings)}", tell)
            finally:
                claim.lock.release()
        else:
            if not waiting:
                log.info("waiting for the last trials, of %s; Ctrl-C leaves them alone", ", ".join(others))
            waiting = True
            time.sleep(_POLL_SECONDS)
            tell(0)


def _digest(data: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def _run_trial(search: Search, learning: Learning, claim: Claim, fingerprint: str, tell: Advance) -> None:
    """Trains with the settings of a trial, from where another process left it, and ends the trial with its error."""
    start, spent, study = time.perf_counter(), 0.0, search.study
    limit, path = search.tune.trial_seconds, study.folder / "trials" / f"{claim.number}.safetensors"
    words = ", ".join(f"{key} {short_text(value)}" for key, value in claim.settings.items())
    log.info("trial %d%s: %s", claim.number, " goes on" if path.exists() else "", words)

    def seconds() -> float:
        return spent + time.perf_counter() - start

    def save(kept: Snapshot) -> None:
        keep_checkpoint(path, "training", kept[0], {**kept[1], "seconds": seconds(), "fingerprint": fingerprint})

    def watch(record: Mapping[str, float]) -> None:
        tell(0)
        if limit is not None and seconds() > limit:
            raise TrialPruned
        if "rollout_error_mm" in record:
            claim.trial.report(record["rollout_error_mm"], int(record["epoch"]))

    try:
        trainer = learning.trainer(parse(TrainingSettings, with_settings(search.groups, claim.settings))).trainer
        if found := resume_checkpoint(path, "training", fingerprint):
            trainer.resume(*found)
            spent = float(found[1]["seconds"])
        run_epochs(f"trial {claim.number}", trainer, save, watch)
        trainer.use_best()
        study.end(claim, trainer.best_error if math.isfinite(trainer.best_error) else math.inf, seconds())
    except TrialPruned:
        study.end(claim, None, seconds(), TrialState.PRUNED)
    except KeyboardInterrupt as error:
        raise StageInterrupted(
            f"interrupted in trial {claim.number} (its whole epochs are kept); the same command goes on from there"
        ) from error
    except (DataFileError, OSError, WorkerError):
        raise  # Not the trial's fault: the next process goes on with it.
    except Exception as error:
        study.end(claim, None, seconds(), TrialState.FAIL)
        forget_checkpoint(path)
        if isinstance(error, InputError):
            raise InputError(f"trial {claim.number} ({words}): {error}") from error
        raise
    forget_checkpoint(path)
    outcomes = study.outcomes()
    best, ended = ranked(outcomes), [each.seconds or 0.0 for each in outcomes if each.state in ("complete", "pruned")]
    shown = {"best": f"{best[0].error:.3g} mm of trial {best[0].number}"} if best else {}
    left = (study.trials - len(ended)) * sum(ended) / max(len(ended), 1) / (1 + len(study.running()))
    said = [f"{len(ended)} of {study.trials} done", *shown.values(), *([f"about {clock(left)} left"] if left else [])]
    log.info("trial %d took %s: %s", claim.number, clock(seconds()), ", ".join(said))
    tell(1, **shown)
