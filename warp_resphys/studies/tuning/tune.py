"""The command `tune`: the search for settings, shared by any number of processes."""

import hashlib
import json
import logging
import math
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from ...experiment.checks import check_training, training_settings
from ...experiment.files import training_file
from ...experiment.learn import Learning, Snapshot, run_epochs
from ...experiment.pipeline import acquire, acquisition_stages, learning_stages, prepare
from ...experiment.scene import LEARNED, Scene, models_of
from ...experiment.schema import is_number, is_whole_number
from ...experiment.trials import folds_of, split_of
from ...io.errors import DataFileError, InputError
from ...io.files import read_json
from ...io.progress import clock
from ...io.resumable import forget_checkpoint, keep_checkpoint, resume_checkpoint
from ...io.stages import Stage, StageInterrupted, run_stages
from ...learning.training import EpochTrainer
from .results import Tuning, print_best, ranked, write_pictures, write_results
from .space import SEARCHED_GROUPS, Dimension, fixed_settings, parse_space, with_settings
from .study import Claim, SharedStudy
from .workers import Watch, Worker, held

log = logging.getLogger(__name__)

_POLL_SECONDS = 0.5
_LEAST = {"trials": 1, "seed": 0}
_PICTURE_SECONDS = 60.0
_RESULTS_LOCK = "results.lock"


class SlowError(Exception):
    """A trial takes longer than trials may."""


class LostError(Exception):
    """Another worker took a trial over, because this one gave no sign of life."""


@dataclass(frozen=True)
class _Bench:
    """What every trial of this process works with."""

    study: SharedStudy
    learning: Learning
    groups: Mapping[str, Any]
    checkpoints: Path
    fingerprint: str
    trial_seconds: float


def run_tuning(config: DictConfig) -> None:
    """Works on the configured study until it has its number of trials; the best settings become a configuration.

    The stages of a run come first, up to the training as configured: what the search has to beat.

    Raises:
        InputError: a value that cannot be used, or a study of another search space or other conditions.
        DataFileError: a file cannot be read or written.
        StageInterrupted: the user pressed Ctrl-C; what is done so far is kept.
    """
    plain, run_dir = prepare(config)
    space = check_tuning(plain)
    tune = plain["tune"]
    model = tune["model"]
    groups = with_settings(training_settings(plain, model), fixed_settings(tune))
    folder = run_dir / "tune" / tune["study"]
    with Worker(folder / "workers", tune["stale_after"]) as worker:
        watch = Watch(folder / "workers", tune["stale_after"])
        before = [*acquisition_stages(plain), *_stages_before(plain, model, "")]
        conditions = {"model": model, **_settings_of(before), **groups}
        for group in _searched(groups):
            conditions[group] = {k: v for k, v in groups[group].items() if f"{group}.{k}" not in space}
        study = SharedStudy(folder, space, conditions, tune["trials"], tune["seed"], worker.identity, watch)
        _, acquired = acquire(plain, run_dir, wait=True)
        needed = _stages_before(plain, model, acquired)
        run_stages(needed, run_dir, wait=True)
        configured = read_json(run_dir / training_file(model))["kept"]["validation_rollout_error_mm"]
        tuning = Tuning(plain, groups, space, folder, configured)
        learning = Learning(Scene(needed[-1].settings, run_dir), model)
        limit = math.inf if tune["trial_seconds"] is None else tune["trial_seconds"]
        _work(_Bench(study, learning, groups, folder / "trials", _digest(conditions), limit), tuning)
    print_best(tuning, study)


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


def _work(bench: _Bench, tuning: Tuning) -> None:
    """Runs trials until there are enough; then waits for those of others, which may have to be taken over."""
    study = bench.study
    drawn = time.monotonic()
    waiting = False
    while True:
        claim = study.claim()
        if claim is not None:
            waiting = False
            _run_trial(bench, claim)
            with held(tuning.folder / _RESULTS_LOCK):
                write_results(tuning, study)
                if time.monotonic() - drawn > _PICTURE_SECONDS:
                    write_pictures(tuning, study)
                    drawn = time.monotonic()
            continue
        holders = study.holders()
        if not holders:
            break
        if not waiting:
            log.info("waiting for the last trials, of %s; Ctrl-C leaves them alone", ", ".join(holders))
            waiting = True
        time.sleep(_POLL_SECONDS)
    with held(tuning.folder / _RESULTS_LOCK):
        write_results(tuning, study)
        write_pictures(tuning, study)


def _run_trial(bench: _Bench, claim: Claim) -> None:
    """Trains with the settings of a trial, from where another worker left it, and tells what came of it.

    Raises:
        InputError: settings that cannot be trained with.
        StageInterrupted: the user pressed Ctrl-C.
    """
    start = time.perf_counter()
    spent = 0.0
    path = bench.checkpoints / f"{claim.number}.{claim.claims}.safetensors"
    groups = with_settings(bench.groups, claim.settings)
    fingerprint = f"{bench.fingerprint} {_digest(claim.settings)}"
    words = ", ".join(f"{key} {_short(value)}" for key, value in claim.settings.items())
    log.info("trial %d%s: %s", claim.number, "" if claim.claims == 1 else " goes on", words)

    def seconds() -> float:
        return spent + time.perf_counter() - start

    def save(kept: Snapshot) -> None:
        metadata = {**kept[1], "seconds": seconds(), "fingerprint": fingerprint}
        keep_checkpoint(path, "training", kept[0], metadata)

    def watch(record: Mapping[str, float]) -> None:
        if seconds() > bench.trial_seconds:
            raise SlowError
        if "rollout_error_mm" in record:
            if not bench.study.owns(claim):
                raise LostError
            bench.study.report(claim, int(record["epoch"]), record["rollout_error_mm"])

    value: float | None = None
    try:
        trainer = bench.learning.trainer(groups).trainer
        spent = _resume(trainer, bench.checkpoints, claim, fingerprint)
        run_epochs(f"trial {claim.number}", trainer, save, watch)
        trainer.use_best()
        value = trainer.best_error if math.isfinite(trainer.best_error) else math.inf
    except SlowError:
        pass
    except LostError:
        forget_checkpoint(path)
        log.warning("trial %d was taken over by another process: this one gave no sign of life", claim.number)
        return
    except KeyboardInterrupt as error:
        raise StageInterrupted(
            f"interrupted in trial {claim.number} (its whole epochs are kept); the same command goes on from there"
        ) from error
    except (DataFileError, OSError):
        raise  # Not the trial's fault: the next process goes on with it.
    except Exception as error:
        if bench.study.fail(claim, seconds()):
            _forget(bench, claim)
        if isinstance(error, InputError):
            raise InputError(f"trial {claim.number} ({words}): {error}") from error
        raise
    if bench.study.tell(claim, value, seconds()):
        _forget(bench, claim)
        _log_progress(bench.study, claim, value, seconds())
    else:
        forget_checkpoint(path)


def _forget(bench: _Bench, claim: Claim) -> None:
    """Removes the checkpoints of a trial that is over."""
    for path in bench.checkpoints.glob(f"{claim.number}.*.safetensors"):
        path.unlink(missing_ok=True)


def _resume(trainer: EpochTrainer[Any], folder: Path, claim: Claim, fingerprint: str) -> float:
    """Goes on from the last checkpoint of a trial, if there is one; returns the seconds spent up to it."""
    for claims in range(claim.claims, 0, -1):
        found = resume_checkpoint(folder / f"{claim.number}.{claims}.safetensors", "training", fingerprint)
        if found is not None:
            trainer.resume(*found)
            return float(found[1]["seconds"])
    return 0.0


def _log_progress(study: SharedStudy, claim: Claim, value: float | None, seconds: float) -> None:
    """One line a trial: what came of it, how far the study is, and how long the rest takes."""
    outcomes = study.outcomes()
    told = [each for each in outcomes if each.state in ("complete", "pruned")]
    came = "given up" if value is None else "diverged" if math.isinf(value) else f"{value:.3g} mm"
    parts = [f"trial {claim.number}: {came} in {clock(seconds)}; {len(told)} of {study.trials} done"]
    best = next(iter(ranked(outcomes)), None)
    if best is not None:
        parts.append(f"best {best.error:.3g} mm of trial {best.number}")
    if len(told) < study.trials:
        mean = sum(each.seconds or 0.0 for each in told) / len(told)
        workers = max(1, len(study.holders()) + 1)
        parts.append(f"about {clock(mean * (study.trials - len(told)) / workers)} left")
    log.info(", ".join(parts))


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def check_tuning(config: Mapping[str, Any]) -> dict[str, Dimension]:
    """Checks the group ``tune``; returns its search space.

    Args:
        config: a configuration that `check_configuration` accepts.

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
    known = [model for model in models_of(config) if model in LEARNED]
    if tune["model"] not in known:
        raise InputError(f"tune.model is {tune['model']!r}: choose one of {', '.join(known)}.")
    for key in ("trials", "seed"):
        if not is_whole_number(tune[key]) or tune[key] < (key == "trials"):
            raise InputError(f"tune.{key} is {tune[key]!r}: it must be a whole number, {_LEAST[key]} or more.")
    for key in ("stale_after", "trial_seconds"):
        given = tune[key]
        if (given is not None or key == "stale_after") and not (is_number(given) and 0.0 < given < math.inf):
            raise InputError(f"tune.{key} is {given!r}: it must be positive, in seconds.")
    for key in ("study", "save_as"):
        if not isinstance(tune[key], str) or not re.fullmatch(r"[\w-]+", tune[key]):
            raise InputError(f"tune.{key} is {tune[key]!r}: use letters, digits, _ and - alone.")
    space = parse_space(tune["space"])
    if not isinstance(tune["settings"], Mapping):
        raise InputError(f"tune.settings is {tune['settings']!r}: it must be a group of settings.")
    fixed = fixed_settings(tune)
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
