"""The command `tune`: settings of a network and its training, searched with Optuna.

The objective is the roll-out error on the validation split. The study is in tune.db in the run
folder, so that the same command continues a search, also beside other processes. Settings that are
not searched are part of the study's name: other settings begin another study in the same file.
"""

import hashlib
import json
import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import optuna
from hydra.core.hydra_config import HydraConfig
from optuna.exceptions import StorageInternalError
from optuna.study import MaxTrialsCallback
from optuna.trial import BaseTrial, FixedTrial, Trial, TrialState
from sqlalchemy.exc import SQLAlchemyError

from ..experiment.experiment import LEARNED, Experiment
from ..experiment.learning_stages import fitting_of
from ..experiment.splits import folds_of, split_of
from ..io.errors import DataFileError, InputError, listed, naming
from ..io.progress import show
from ..io.resuming import StageInterrupted, run_stages
from ..io.settings import Count, Natural, Settings, Word, parse, setting
from ..learning.residuals.fitting import run_epochs
from ..pipeline import acquire, learning_stages, prepare
from ..report.page import PageTable
from ..report.wording import number_text
from ..settings.learning import TrainingSettings
from ..settings.run import RunSettings

_SHOWN = 5  # trials
_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


class Tune(Settings):
    """The group `tune`: a search, with settings by group and name, such as network and width."""

    model: Word = setting(description="resphys or simfree")
    trials: Natural = setting(description="finished trials, over all processes")
    seed: Count = setting(0, "of the search; the trials train with the seed of the run")
    space: dict[str, dict[str, Any]] = setting(
        description="lists of values, or ranges {low: .., high: .., log: ..}"
    )
    settings: dict[str, dict[str, Any]] = setting(
        {}, "of all trials, where they differ from those of the run"
    )


class TunedRun(RunSettings):
    """The configuration ``tune``: that of a run, and the search."""

    tune: Tune


def tune(settings: TunedRun, folder: Path) -> None:
    """Runs trials until the study has the configured number of them,
    and prints the best settings as overrides.

    Raises:
        InputError: a value that cannot be used.
        DataFileError: the study cannot be read or written.
        StageInterrupted: the user pressed Ctrl-C; finished trials are kept.
    """
    search = settings.tune
    run = RunSettings.of(settings)
    prepare(run)
    space, training = _checked(run, search)
    _, acquired = acquire(run, folder, wait=True)
    stages = {stage.name: stage for stage in learning_stages(run, split_of(run), ".", acquired)}
    wanted = [f"train_{search.model}"]
    for needed in wanted:
        wanted += [name for name in stages[needed].upstream if name not in wanted]
    *before, trained = (stage for name, stage in stages.items() if name in wanted)
    run_stages(before, folder, wait=True)
    experiment = Experiment(trained.settings, folder)
    conditions = [
        training.plain(),
        str(space),
        *(stage.settings.content() for stage in (*before, trained)),
    ]
    name = (
        f"{search.model} "
        f"{hashlib.sha256(json.dumps(conditions, sort_keys=True).encode()).hexdigest()[:12]}"
    )

    def error_mm(trial: Trial) -> float:
        """Trains with the settings of a trial, and returns its error.

        Infinite where every roll-out diverged.
        """

        def watch(record: Mapping[str, float]) -> None:
            if "rollout_error_mm" in record:
                trial.report(record["rollout_error_mm"], int(record["epoch"]))
                if trial.should_prune():
                    raise optuna.TrialPruned

        tried = {key: _suggest(trial, key, values) for key, values in space.items()}
        try:
            with naming(f"trial {trial.number}, with {tried}: "):
                trainer, _ = fitting_of(experiment, search.model).trainer(_changed(training, tried))
                run_epochs(f"trial {trial.number}", trainer, watch=watch)
        except KeyboardInterrupt as error:
            again = "the same command continues with another one"
            raise StageInterrupted(f"interrupted in trial {trial.number}; {again}") from error
        return trainer.best_error if math.isfinite(trainer.best_error) else math.inf

    try:
        study = optuna.create_study(
            storage=f"sqlite:///{folder / 'tune.db'}", study_name=name, load_if_exists=True
        )
        study.sampler = optuna.samplers.TPESampler(seed=search.seed + len(study.trials))
        if len(study.get_trials(deepcopy=False, states=_FINISHED)) < search.trials:
            study.optimize(error_mm, callbacks=[MaxTrialsCallback(search.trials, _FINISHED)])
        _print(study, search)
    except (SQLAlchemyError, StorageInternalError) as error:
        raise DataFileError(
            f"cannot use {folder / 'tune.db'} ({error}): make it writable, or delete it."
        ) from error


def _checked(run: RunSettings, search: Tune) -> tuple[dict[str, Any], TrainingSettings]:
    """Returns the search space by dotted key, and the settings of every trial outside of it.

    Raises:
        InputError: a value of the wrong kind or out of range.
    """
    trains = run.ablation is None and run.reconstruction is not None
    learned = [model for model in run.models if model in LEARNED] if trains else []
    if search.model not in learned:
        raise InputError(
            f"tune.model is {search.model!r}: the experiment {run.name} trains {listed(learned)}."
        )
    if folds_of(run) is not None:
        raise InputError(
            "a search needs one split, and data.folds makes several: set data.folds to null, and "
            "data.train, data.validation and data.test."
        )
    training = run.training_of(search.model)
    fixed = _dotted(search.settings)
    space = _dotted(search.space)
    if not space:
        raise InputError(
            "tune.space is empty: it must name at least one setting, such as network.width."
        )
    groups = ("network", "trainer" if training.in_the_loop is None else "in_the_loop")
    unused = [key for key in (*fixed, *space) if key.partition(".")[0] not in groups]
    if unused:
        raise InputError(
            f"the trials do not depend on tune's {unused[0]}: search {' and '.join(groups)} only."
        )
    with naming("tune: "):
        training = _changed(training, fixed)
    for key, values in space.items():
        try:
            ends = (
                values
                if isinstance(values, list) and len(values) > 1
                else (values["low"], values["high"])
            )
            for value in ends:
                _suggest(FixedTrial({key: value}), key, values)
        except (TypeError, ValueError, KeyError) as error:
            raise InputError(
                f"tune.space.{key} is {values}: write two or more values, as in [8, 16], or a "
                "range, as in {low: 1.0e-4, high: 1.0e-2, log: true}."
            ) from error
        for value in ends:
            with naming("tune: "):
                _changed(training, {key: value})
    return space, training


def _dotted(groups: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Settings by dotted key, such as network.width."""
    return {
        f"{group}.{name}": value
        for group, values in groups.items()
        for name, value in values.items()
    }


def _suggest(trial: BaseTrial, key: str, values: Any) -> Any:
    """Returns a trial's value of a list or a range."""
    if isinstance(values, list):
        return trial.suggest_categorical(key, values)
    whole = isinstance(values["low"], int) and isinstance(values["high"], int)
    return (trial.suggest_int if whole else trial.suggest_float)(key, **values)


def _changed(training: TrainingSettings, changes: Mapping[str, Any]) -> TrainingSettings:
    """The settings of a training with changes by dotted key."""
    values = training.plain()
    for key, value in changes.items():
        group, _, name = key.partition(".")
        values[group][name] = value
    return parse(TrainingSettings, values)


def _print(study: optuna.Study, search: Tune) -> None:
    """Prints the best trials, and the command of a run with the settings of the best one."""
    done = [
        trial for trial in study.get_trials(states=[TrialState.COMPLETE]) if trial.value != math.inf
    ]
    if not done:
        raise InputError("every trial diverged: choose a tune.space closer to settings that work.")
    done.sort(key=lambda trial: (trial.value, trial.number))
    headings = ["trial", "error [mm]", *(key.rpartition(".")[2] for key in done[0].params)]
    rows = [
        [str(trial.number), number_text(trial.value), *map(_text, trial.params.values())]
        for trial in done[:_SHOWN]
    ]
    table = PageTable.plain("Best trials: roll-out error on the validation split", headings, rows)
    overrides = [override.lstrip("+") for override in HydraConfig.get().overrides.task]
    kept = [override for override in overrides if not override.lstrip("~").startswith("tune.")]
    prefix = "simfree." if search.model == "simfree" else ""
    found = [
        f"{prefix}{key}={value}"
        for key, value in (_dotted(search.settings) | done[0].params).items()
    ]
    show(table, f"A run with the best settings: {shlex.join(['warp-resphys', *kept, *found])}")


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
