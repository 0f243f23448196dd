"""The command `tune`: the search for settings, shared by any number of processes."""

import hashlib
import json
import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ...experiment.checks import check_training, training_settings
from ...experiment.files import training_file
from ...experiment.learn import Learning, Snapshot, run_epochs
from ...experiment.parts import workers_for
from ...experiment.scene import LEARNED, Scene, models_of
from ...experiment.schema import ANYTHING, COUNT, NAME, NATURAL, POSITIVE, WORD, Group, check, optional
from ...experiment.trials import folds_of, split_of
from ...io.errors import DataFileError, InputError
from ...io.fan_out import Advance, WorkerError, Workers, fan_out
from ...io.files import read_json
from ...io.progress import Progress, clock
from ...io.resumable import forget_checkpoint, keep_checkpoint, resume_checkpoint
from ...io.stages import Stage, StageInterrupted, run_stages
from ...pipeline import acquire, acquisition_stages, learning_stages, prepare
from .results import Tuning, print_best, ranked, short_text, write_pictures, write_results
from .space import SEARCHED_GROUPS, Dimension, fixed_settings, parse_space, with_settings
from .study import Claim, SharedStudy
from .workers import at_work, held, is_alive

log = logging.getLogger(__name__)

_POLL_SECONDS = 0.5
_PICTURE_SECONDS = 60.0
_COUNTED = ("complete", "pruned")  # states of trials
_KEYS = Group(
    {"model": WORD, "trials": NATURAL, "trial_seconds": optional(POSITIVE), "seed": COUNT, "study": NAME}
    | {"save_as": NAME, "space": ANYTHING, "settings": Group(each=ANYTHING)}
)


class SlowError(Exception):
    """A trial takes longer than trials may."""


def run_tuning(config: Mapping[str, Any], run_dir: Path) -> None:
    """Works on the configured study until it has its number of trials; the best settings become a configuration.

    The stages of a run come first, up to the training as configured: what the search has to beat.

    Raises:
        InputError: a value that cannot be used, or a study of another search space or other conditions.
        DataFileError: a file cannot be read or written.
        StageInterrupted: the user pressed Ctrl-C; what is done so far is kept.
    """
    prepare(config)
    check_tuning(config)
    tune = config["tune"]
    with _joined(config, run_dir):  # Refuses a study of something else before anything is computed.
        pass
    _, acquired = acquire(config, run_dir, wait=True)
    run_stages(_stages_before(config, tune["model"], acquired), run_dir, wait=True)
    workers = workers_for(config, config["parallel"]["processes"]).at_most(tune["trials"])
    with _joined(config, run_dir) as searcher:
        tuning = searcher.tuning(run_dir)
        if not workers.alone:
            _share(_Task(config, run_dir.absolute(), acquired), tuning, workers)
        results = _Results(tuning)
        searcher.work(tuning, _learning(config, run_dir, acquired), results)
        results.write(pictures=True)
    print_best(tuning)


@dataclass(frozen=True)
class _Searcher:
    """One process that works on the study."""

    config: Mapping[str, Any]
    space: Mapping[str, Dimension]
    groups: Mapping[str, Any]
    conditions: Mapping[str, Any]
    study: SharedStudy

    def tuning(self, run_dir: Path) -> Tuning:
        """What it works on, in a run whose training as configured is done."""
        kept = read_json(run_dir / training_file(self.config["tune"]["model"]))["kept"]
        return Tuning(self.config, self.groups, self.space, self.study, kept["validation_rollout_error_mm"])

    def work(self, tuning: Tuning, learning: Learning, tell: Advance) -> None:
        """See `_work`."""
        _work(tuning, learning, _digest(self.conditions), tell)


@contextmanager
def _joined(config: Mapping[str, Any], run_dir: Path) -> Iterator[_Searcher]:
    """Makes this process one of those that work on the study."""
    tune = config["tune"]
    space, model = parse_space(tune["space"]), tune["model"]
    groups = with_settings(training_settings(config, model), fixed_settings(tune))
    folder = run_dir / "tune" / tune["study"]
    everyone = folder / "workers"
    with at_work(everyone) as identity:
        before = [*acquisition_stages(config), *_stages_before(config, model, "")]
        conditions = {"model": model, **_settings_of(before), **groups}
        for group in _searched(groups):
            conditions[group] = {k: v for k, v in groups[group].items() if f"{group}.{k}" not in space}
        seed, alive = tune["seed"], partial(is_alive, everyone)
        study = SharedStudy(folder, space, conditions, tune["trials"], seed, identity, alive)
        yield _Searcher(config, space, groups, conditions, study)


def _learning(config: Mapping[str, Any], run_dir: Path, acquired: str) -> Learning:
    model = config["tune"]["model"]
    return Learning(Scene(_stages_before(config, model, acquired)[-1].settings, run_dir), model)


@dataclass(frozen=True)
class _Task:
    """What a worker process has to know."""

    config: Mapping[str, Any]
    run_dir: Path
    acquired: str  # fingerprint of the dataset


class _Results:
    """Writes what is known, and draws it now and then, as trials end."""

    def __init__(self, tuning: Tuning) -> None:
        self._tuning, self._drawn = tuning, time.monotonic()

    def __call__(self, count: int = 1, **shown: object) -> None:
        """After some trials."""
        if count:
            self.write(time.monotonic() - self._drawn > _PICTURE_SECONDS)

    def write(self, pictures: bool) -> None:
        """Now."""
        with held(self._tuning.folder / "results.lock"):
            write_results(self._tuning)
            if pictures:
                write_pictures(self._tuning)
                self._drawn = time.monotonic()


def _share(task: _Task, tuning: Tuning, workers: Workers) -> None:
    """Runs trials in worker processes until there are enough."""
    study, results = tuning.study, _Results(tuning)

    def counted() -> int:
        return sum(each.state in _COUNTED for each in study.outcomes())

    done = counted()
    if done >= study.trials:
        return
    crew = workers.at_most(study.trials - done)

    def advance(count: int, **shown: object) -> None:
        nonlocal done
        if shown:  # A trial has ended. What lost workers had counted stays done: the study knows.
            before, done = done, counted()
            progress.advance(done - before, **shown)
            results(count)

    try:
        with Progress(f"{crew.count} workers", study.trials, "trials", done) as progress:
            fan_out(_join, [task] * crew.count, crew, advance, study.folder)
    except KeyboardInterrupt as error:
        raise StageInterrupted(
            "interrupted; whole epochs of the trials that ran are kept, and the same command goes on from there"
        ) from error


def _join(task: _Task, advance: Advance) -> None:
    with _joined(task.config, task.run_dir) as searcher:
        learning = _learning(task.config, task.run_dir, task.acquired)
        searcher.work(searcher.tuning(task.run_dir), learning, advance)


def _stages_before(config: Mapping[str, Any], model: str, acquired: str) -> list[Stage]:
    """The stages of a run from the dataset of a fingerprint up to the training of a model."""
    stages = {stage.name: stage for stage in learning_stages(config, split_of(config), ".", acquired)}

    def before(name: str) -> list[str]:
        return [*(each for needed in stages[name].upstream for each in before(needed)), name]

    wanted = set(before(f"train_{model}"))
    return [stage for name, stage in stages.items() if name in wanted]


def _settings_of(stages: Sequence[Stage]) -> dict[str, Any]:
    """The settings of some stages, in place of the fingerprint of the dataset that they lead to."""
    found: dict[str, Any] = {}
    for key, value in (item for stage in stages for item in stage.settings.items() if item[0] != "acquired"):
        known = found.get(key)
        found[key] = {**known, **value} if isinstance(known, dict) and isinstance(value, dict) else value
    return found


def _searched(groups: Mapping[str, Any]) -> tuple[str, ...]:
    """The groups that a model is trained with."""
    return tuple(each for each in SEARCHED_GROUPS if each != ("trainer" if groups["in_the_loop"] else "in_the_loop"))


def _digest(data: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def _work(tuning: Tuning, learning: Learning, fingerprint: str, tell: Advance) -> None:
    """Runs trials until there are enough; then waits for those of others, which may have to be taken over.

    Args:
        tuning: the study.
        learning: what is trained.
        fingerprint: of all that trials have in common.
        tell: is told after each epoch and trial how many trials that makes, and what came of them; may raise.
    """
    study, told = tuning.study, False
    while (claim := study.claim()) is not None or (holders := study.holders()):
        if claim is None:
            if not told:
                log.info("waiting for the last trials, of %s; Ctrl-C leaves them alone", ", ".join(holders))
            told = True
            time.sleep(_POLL_SECONDS)
            tell(0)
            continue
        told = False
        _run_trial(tuning, learning, claim, f"{fingerprint} {_digest(claim.settings)}", tell)


def _run_trial(tuning: Tuning, learning: Learning, claim: Claim, fingerprint: str, tell: Advance) -> None:
    """Trains with the settings of a trial, from where another worker left it, and tells what came of it."""
    start, spent, study = time.perf_counter(), 0.0, tuning.study
    limit = tuning.config["tune"]["trial_seconds"]
    path = tuning.folder / "trials" / f"{claim.number}.safetensors"
    words = ", ".join(f"{key} {short_text(value)}" for key, value in claim.settings.items())
    log.info("trial %d%s: %s", claim.number, "" if claim.claims == 1 else " goes on", words)

    def seconds() -> float:
        return spent + time.perf_counter() - start

    def save(kept: Snapshot) -> None:
        keep_checkpoint(path, "training", kept[0], {**kept[1], "seconds": seconds(), "fingerprint": fingerprint})

    def watch(record: Mapping[str, float]) -> None:
        tell(0)
        if limit is not None and seconds() > limit:
            raise SlowError
        if "rollout_error_mm" in record:
            study.report(claim, int(record["epoch"]), record["rollout_error_mm"])

    value: float | None = None
    try:
        trainer = learning.trainer(with_settings(tuning.groups, claim.settings)).trainer
        if found := resume_checkpoint(path, "training", fingerprint):
            trainer.resume(*found)
            spent = float(found[1]["seconds"])
        run_epochs(f"trial {claim.number}", trainer, save, watch)
        trainer.use_best()
        value = trainer.best_error if math.isfinite(trainer.best_error) else math.inf
    except SlowError:
        pass
    except KeyboardInterrupt as error:
        raise StageInterrupted(
            f"interrupted in trial {claim.number} (its whole epochs are kept); the same command goes on from there"
        ) from error
    except (DataFileError, OSError, WorkerError):
        raise  # Not the trial's fault: the next process goes on with it.
    except Exception as error:
        if study.fail(claim, seconds()):
            forget_checkpoint(path)
        if isinstance(error, InputError):
            raise InputError(f"trial {claim.number} ({words}): {error}") from error
        raise
    if study.tell(claim, value, seconds()):
        _log_progress(study, claim, value, seconds())
    else:
        log.warning("trial %d was taken over by another process: this one was taken for dead", claim.number)
    forget_checkpoint(path)
    tell(1, **_shown(study))


def _shown(study: SharedStudy) -> dict[str, str]:
    best = ranked(study.outcomes())
    return {"best": f"{best[0].error:.3g} mm of trial {best[0].number}"} if best else {}


def _log_progress(study: SharedStudy, claim: Claim, value: float | None, seconds: float) -> None:
    """One line a trial: what came of it, how far the study is, and how long the rest takes."""
    outcomes = study.outcomes()
    told = [each for each in outcomes if each.state in _COUNTED]
    came = "given up" if value is None else "diverged" if math.isinf(value) else f"{value:.3g} mm"
    said = f"trial {claim.number}: {came} in {clock(seconds)}; {len(told)} of {study.trials} done"
    if best := ranked(outcomes):
        said += f", best {best[0].error:.3g} mm of trial {best[0].number}"
    if len(told) < study.trials:
        mean = sum(each.seconds or 0.0 for each in told) / len(told)
        left = mean * (study.trials - len(told)) / (1 + len(study.holders()))
        said += f", about {clock(left)} left"
    log.info("%s", said)


def check_tuning(config: Mapping[str, Any]) -> dict[str, Dimension]:
    """Checks the group ``tune``; returns its search space.

    Raises:
        InputError: a value of the wrong kind or out of range, also among those that may be tried.
    """
    tune = config["tune"]
    if "ablation" in config:
        raise InputError(f"the experiment {config['name']} trains no network: tune another one.")
    if folds_of(config) is not None:
        raise InputError(
            "a search needs one split, and data.folds makes several: set data.folds to null, and data.train, "
            "data.validation and data.test."
        )
    check("tune", tune, _KEYS)
    known = [model for model in models_of(config) if model in LEARNED]
    if tune["model"] not in known:
        raise InputError(f"tune.model is {tune['model']!r}: choose one of {', '.join(known)}.")
    space, fixed = parse_space(tune["space"]), fixed_settings(tune)
    for key in fixed.keys() & space.keys():
        raise InputError(f"tune.settings.{key} and tune.space.{key} exclude each other: take one of them out.")
    tried = [{key: value} for key, dimension in space.items() for value in dimension.ends]
    for settings in ({}, *tried):
        _check_trial(config, {**fixed, **settings})
    return space


def _check_trial(config: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Checks what a trial of these settings, by dotted key, is trained with."""
    groups = training_settings(config, config["tune"]["model"])
    for key in settings:
        group, _, name = key.partition(".")
        known = _searched(groups)
        if name not in (groups[group] if group in known else {}):
            raise InputError(f"unknown key '{key}' in the group tune: it must name a setting of {', '.join(known)}.")
    groups = with_settings(groups, settings)
    try:
        check_training(groups)
    except InputError as error:
        raise InputError(f"tune: {error}") from error
