"""A study that any number of processes work on: Optuna's journal, in one folder.

Optuna has no heartbeats for journals. So a process holds the lock of a file for each trial that it runs, which the
operating system lets go of whatever the process died of. A running trial whose lock is free has lost its process: it
fails in the journal, and one of the same settings that continues it is enqueued.
"""

from __future__ import annotations

import math
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from filelock import FileLock, Timeout
from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState

from ...io.errors import DataFileError, InputError
from ...io.files import to_plain
from ...report.page import flatten
from .space import Dimension

JOURNAL = "study.journal"
_NAME = "tuning"
_CONTINUES = "continues"  # attribute of a trial: the number of the one that it continues
_STATES = {TrialState.COMPLETE: "complete", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}


@dataclass(frozen=True)
class Claim:
    """A trial that this process runs."""

    number: int  # from 0 on
    settings: Mapping[str, Any]  # that are tried, by dotted key
    trial: Trial
    lock: FileLock  # to be released when this process leaves the trial


@dataclass(frozen=True)
class Outcome:
    """State and result of a trial."""

    number: int  # from 0 on
    state: str  # complete, pruned, failed or running
    error: float | None  # the objective [mm]; infinite where everything diverged, None where there is none yet
    settings: Mapping[str, Any]  # that were tried, by dotted key
    seconds: float | None  # of computation, over all processes that had it [s]


class Study:
    """The study in a folder, as one of its processes sees it.

    Args:
        folder: where the study is, or is to be made.
        space: what each setting may be.
        conditions: everything else that a trial's result depends on, as plain data.
        trials: how many are to be finished, over all processes.
        seed: of the sampler.

    Raises:
        InputError: the study that is there has another space or other conditions.
        DataFileError: the folder cannot be written, or the journal is damaged.
    """

    def __init__(
        self, folder: Path, space: Mapping[str, Dimension], conditions: Mapping[str, Any], trials: int, seed: int
    ) -> None:
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.folder, self.trials, self.space, self._seed = folder, trials, space, seed
        self._lock, journal = FileLock(folder / "study.lock"), folder / JOURNAL
        try:
            (folder / "trials").mkdir(parents=True, exist_ok=True)
            with self._lock:
                journal.touch()
                content = journal.read_bytes()
                os.truncate(journal, content.rfind(b"\n") + 1)  # a line that a full disk left half written
                storage = JournalStorage(JournalFileBackend(str(journal)))
                there = _NAME in optuna.get_all_study_names(storage)  # To create it again would write to the journal.
                self._study = (optuna.load_study if there else optuna.create_study)(study_name=_NAME, storage=storage)
        except OSError as error:
            raise DataFileError(f"cannot write {folder} ({error.strerror}): make it writable") from error
        except (ValueError, KeyError, AssertionError) as error:
            raise DataFileError(f"{journal} is damaged ({error}): delete it to start the study anew") from error
        self._agree({"space": {key: str(each) for key, each in space.items()}, **to_plain(conditions)})

    def _agree(self, conditions: dict[str, Any]) -> None:
        """Marks a new study with its conditions, and compares those of an old one."""
        if "conditions" not in self._study.user_attrs:
            self._study.set_user_attr("conditions", conditions)
        there, here = dict(flatten(self._study.user_attrs["conditions"])), dict(flatten(conditions))
        for key in sorted({*there, *here}, key=lambda key: (not key.startswith("space."), key)):
            if there.get(key, "absent") != here.get(key, "absent"):
                raise InputError(
                    f"the study in {self.folder} has another setting: {key} was {there.get(key, 'absent')}, now it is "
                    f"{here.get(key, 'absent')}; go on with the old setting, delete the folder, or name another study "
                    "with tune.study=..."
                )

    def _trials(self, *states: TrialState) -> list[FrozenTrial]:
        return self._study.get_trials(deepcopy=False, states=states or None)

    def _numbered(self) -> Iterator[tuple[int, FrozenTrial]]:
        """All trials with their numbers; those that continue another one have its number."""
        count = 0
        for trial in self._trials():
            continues = trial.user_attrs.get(_CONTINUES)
            yield (count if continues is None else continues), trial
            count += continues is None

    def claim(self) -> Claim | None:
        """A trial for this process: one that another process left, or a new one; None if there is none to take now."""
        with self._lock:
            for number, trial in self._numbered():
                if trial.state == TrialState.RUNNING:
                    with suppress(Timeout), self._lock_of(number).acquire(timeout=0):
                        self._study.tell(trial.number, state=TrialState.FAIL)
                        self._study.enqueue_trial(trial.params, user_attrs={_CONTINUES: number})
            if len(self._trials(TrialState.RUNNING, TrialState.COMPLETE, TrialState.PRUNED)) >= self.trials:
                return None
            waiting = [trial.user_attrs[_CONTINUES] for trial in self._trials(TrialState.WAITING)]
            number = waiting[0] if waiting else len(dict(self._numbered()))
            lock = self._lock_of(number)
            lock.acquire()
            # A trial draws the same settings whichever process asks for it, and no two trials draw alike.
            seed = int(np.random.SeedSequence([self._seed, number]).generate_state(1)[0])
            self._study.sampler = optuna.samplers.TPESampler(seed=seed)
            asked = self._study.ask({key: each.distribution for key, each in self.space.items()})
            asked.set_user_attr("process", f"{socket.gethostname()}:{os.getpid()}")
            return Claim(number, self._settings(asked.params), asked, lock)

    def _lock_of(self, number: int) -> FileLock:
        return FileLock(self.folder / "trials" / f"{number}.lock")

    def _settings(self, params: Mapping[str, Any]) -> dict[str, Any]:
        return {key: each.value(params[key]) for key, each in self.space.items() if key in params}

    def end(self, claim: Claim, value: float | None, seconds: float, state: TrialState = TrialState.COMPLETE) -> None:
        """Ends a trial with its objective, infinite where it diverged; one that fails does not count."""
        with suppress(UpdateFinishedTrialError):  # A process that took this one for dead has taken the trial over.
            claim.trial.set_user_attr("seconds", seconds)
            self._study.tell(claim.trial, value, state=state)
        claim.lock.release()
        (self.folder / "trials" / f"{claim.number}.lock").unlink(missing_ok=True)

    def outcomes(self) -> list[Outcome]:
        """All trials so far, by number."""
        found = []
        for number, trial in dict(self._numbered()).items():
            error = min(trial.intermediate_values.values(), default=None) if trial.value is None else trial.value
            state, seconds = _STATES.get(trial.state, "running"), trial.user_attrs.get("seconds")
            found.append(Outcome(number, state, error, self._settings(trial.params), seconds))
        return found

    def finished(self) -> int:
        """How many trials count as done, given up ones too."""
        return len(self._trials(TrialState.COMPLETE, TrialState.PRUNED))

    def running(self) -> list[str]:
        """The processes that run a trial now, as ``host:pid``."""
        return [trial.user_attrs.get("process", "?") for trial in self._trials(TrialState.RUNNING)]

    def importance(self) -> dict[str, float]:
        """How much each setting matters for being among the best quarter, summing to one; empty if too little is known.

        By PED-ANOVA (Watanabe et al., 2023, arXiv:2304.10255).
        """
        values = {trial.value for trial in self._trials(TrialState.COMPLETE) if trial.value is not None}
        if sum(map(math.isfinite, values)) < 4:
            return {}
        evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.25)
        found = optuna.importance.get_param_importances(self._study, evaluator=evaluator)
        return {key: float(value) for key, value in found.items()}
