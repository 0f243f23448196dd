"""The command `tune`: settings of a network and its training, searched with Optuna.

The objective is the roll-out error on the validation split. The study is in tune.db in the run folder, so that the same
command continues a search, also beside other processes. Settings that are not searched are part of the study's name:
other settings begin another study in the same file.
"""

import hashlib
import json
import logging
import math
import shlex
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import optuna
from hydra.core.hydra_config import HydraConfig
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.exceptions import StorageInternalError
from optuna.trial import Trial, TrialState
from sqlalchemy.exc import SQLAlchemyError

from ..experiment.experiment import LEARNED, Experiment
from ..experiment.learn import Prepared, run_epochs, trainer_of
from ..experiment.trials import folds_of, split_of
from ..io.errors import DataFileError, InputError, listed, naming
from ..io.settings import Count, Natural, Settings, Word, parse, setting
from ..io.stages import Stage, StageInterrupted, run_stages
from ..pipeline import acquire, learning_stages, prepare
from ..report.page import PageTable, number_text
from ..settings.learning import TrainingSettings
from ..settings.run import RunSettings
from .tables import show

log = logging.getLogger(__name__)
_SHOWN = 5  # trials
_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


class Tune(Settings):
    """The group `tune`: a search, with settings by group and name, such as network and width."""

    model: Word = setting(description="resphys or simfree")
    trials: Natural = setting(description="finished trials, over all processes")
    seed: Count = setting(0, "of the search; the trials train with the seed of the run")
    space: dict[str, dict[str, Any]] = setting(description="lists of values, or ranges {low: .., high: .., log: ..}")
    settings: dict[str, dict[str, Any]] = setting({}, "of all trials, where they differ from those of the run")


class TunedRun(RunSettings):
    """The configuration ``tune``: that of a run, and the search."""

    tune: Tune


def tune(settings: TunedRun, folder: Path) -> None:
    """Runs trials until the study has the configured number of them, and prints the best settings as overrides.

    Raises:
        InputError: a value that cannot be used.
        DataFileError: the study cannot be read or written.
        StageInterrupted: the user pressed Ctrl-C; finished trials are kept.
    """
    search = settings.tune
    run = parse(RunSettings, {key: value for key, value in settings.plain().items() if key != "tune"})
    prepare(run)
    space, training = _checked(run, search)
    _, acquired = acquire(run, folder, wait=True)
    *before, trained = _stages(run, search.model, acquired)
    run_stages(before, folder, wait=True)
    experiment = Experiment(trained.settings, folder)
    conditions = [training.plain(), str(space), *(stage.settings.plain() for stage in (*before, trained))]
    name = f"{search.model} {hashlib.sha256(json.dumps(conditions, sort_keys=True).encode()).hexdigest()[:12]}"
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        study = optuna.create_study(storage=f"sqlite:///{folder / 'tune.db'}", study_name=name, load_if_exists=True)
        while len(study.get_trials(deepcopy=False, states=_FINISHED)) < search.trials:
            study.sampler = optuna.samplers.TPESampler(seed=search.seed + len(study.trials))
            _run_trial(study, study.ask(space), partial(trainer_of, experiment, search.model), training)
        _print(study, search)
    except (SQLAlchemyError, StorageInternalError) as error:
        raise DataFileError(f"cannot use {folder / 'tune.db'} ({error}): make it writable, or delete it.") from error


def _checked(run: RunSettings, search: Tune) -> tuple[dict[str, BaseDistribution], TrainingSettings]:
    """Returns the search space by dotted key, and the settings of every trial outside of it.

    Raises:
        InputError: a value of the wrong kind or out of range.
    """
    learned = [] if run.ablation is not None else [model for model in run.models if model in LEARNED]
    if search.model not in learned:
        raise InputError(f"tune.model is {search.model!r}: the experiment {run.name} trains {listed(learned)}.")
    if folds_of(run) is not None:
        raise InputError(
            "a search needs one split, and data.folds makes several: set data.folds to null, and data.train, "
            "data.validation and data.test."
        )
    training, fixed = run.training(search.model), _dotted(search.settings)
    space = {key: _distribution(key, values) for key, values in _dotted(search.space).items()}
    if not space:
        raise InputError("tune.space is empty: it must name at least one setting, such as network.width.")
    groups = ("network", "trainer" if training.in_the_loop is None else "in_the_loop")
    if unused := [key for key in (*fixed, *space) if key.partition(".")[0] not in groups]:
        raise InputError(f"the trials do not depend on tune's {unused[0]}: search {' and '.join(groups)} only.")
    with naming("tune: "):
        training = _changed(training, fixed)
        for key, values in space.items():
            for value in getattr(values, "choices", None) or (values.low, values.high):  # type: ignore[attr-defined]
                _changed(training, {key: value})
    return space, training


def _dotted(groups: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Settings by dotted key, such as network.width."""
    return {f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()}


def _distribution(key: str, values: Any) -> BaseDistribution:
    """The distribution of a list or a range."""
    try:
        if isinstance(values, list) and len(values) > 1:
            return CategoricalDistribution(values)
        whole = isinstance(values["low"], int) and isinstance(values["high"], int)
        return (IntDistribution if whole else FloatDistribution)(**values)
    except (TypeError, ValueError, KeyError) as error:
        raise InputError(
            f"tune.space.{key} is {values}: write two or more values, as in [8, 16], or a range, as in "
            "{low: 1.0e-4, high: 1.0e-2, log: true}."
        ) from error


def _changed(training: TrainingSettings, changes: Mapping[str, Any]) -> TrainingSettings:
    """The settings of a training with changes by dotted key."""
    values = training.plain()
    for key, value in changes.items():
        group, _, name = key.partition(".")
        values[group][name] = value
    return parse(TrainingSettings, values)


def _stages(run: RunSettings, model: str, acquired: str) -> list[Stage]:
    """Returns the stages of a run after its dataset, of a given fingerprint, up to the training of a model."""
    stages = {stage.name: stage for stage in learning_stages(run, split_of(run), ".", acquired)}
    wanted = [f"train_{model}"]
    for name in wanted:
        wanted += [needed for needed in stages[name].upstream if needed not in wanted]
    return [stage for name, stage in stages.items() if name in wanted]


def _run_trial(
    study: optuna.Study, trial: Trial, prepared: Callable[[TrainingSettings], Prepared], training: TrainingSettings
) -> None:
    """Trains with the settings of a trial, and stores its error [mm]; infinite where every roll-out diverged."""
    words = ", ".join(f"{key} {_text(value)}" for key, value in trial.params.items())
    log.info("trial %d: %s", trial.number, words)

    def watch(record: Mapping[str, float]) -> None:
        if "rollout_error_mm" in record:
            trial.report(record["rollout_error_mm"], int(record["epoch"]))
            if trial.should_prune():
                raise optuna.TrialPruned

    try:
        trainer, _ = prepared(_changed(training, trial.params))
        run_epochs(f"trial {trial.number}", trainer, lambda kept: None, watch)
        error = trainer.best_error if math.isfinite(trainer.best_error) else math.inf
        study.tell(trial, error)
        log.info("trial %d: %s mm", trial.number, number_text(error))
    except optuna.TrialPruned:
        study.tell(trial, state=TrialState.PRUNED)
        log.info("trial %d: stopped, as others were better", trial.number)
    except BaseException as error:
        study.tell(trial, state=TrialState.FAIL)
        if isinstance(error, KeyboardInterrupt):
            raise StageInterrupted(
                f"interrupted in trial {trial.number}; the same command continues with another one"
            ) from error
        if isinstance(error, InputError):
            raise InputError(f"trial {trial.number} ({words}): {error}") from error
        raise


def _print(study: optuna.Study, search: Tune) -> None:
    """Prints the best trials, and the command of a run with the settings of the best one."""
    done = [trial for trial in study.get_trials(states=[TrialState.COMPLETE]) if trial.value != math.inf]
    if not done:
        raise InputError("every trial diverged: choose a tune.space closer to settings that work.")
    done.sort(key=lambda trial: (trial.value, trial.number))
    headings = ["trial", "error [mm]", *(key.rpartition(".")[2] for key in done[0].params)]
    rows = [
        [str(trial.number), number_text(trial.value), *map(_text, trial.params.values())] for trial in done[:_SHOWN]
    ]
    table = PageTable.plain("Best trials: roll-out error on the validation split", headings, rows)
    given = [override.lstrip("+") for override in HydraConfig.get().overrides.task]
    kept = [override for override in given if not override.lstrip("~").startswith("tune.")]
    prefix = "simfree." if search.model == "simfree" else ""
    found = [f"{prefix}{key}={value}" for key, value in (_dotted(search.settings) | done[0].params).items()]
    show(table, f"A run with the best settings: {shlex.join(['warp-resphys', *kept, *found])}")


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
