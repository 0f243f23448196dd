"""An Optuna study in a folder, shared by any number of processes through a journal.

Optuna has no heartbeats for journals. Instead, a process holds a file lock for each trial that it runs, which the
operating system releases when the process ends for any reason. A running trial whose lock is free has lost its process:
it is marked as failed, and a trial with the same settings that continues it is enqueued.
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
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock, JournalFileSymlinkLock
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
    settings: Mapping[str, Any]  # by dotted key
    trial: Trial
    lock: FileLock  # released when this process leaves the trial


@dataclass(frozen=True)
class Outcome:
    """State and result of a trial."""

    number: int  # from 0 on
    state: str  # complete, pruned, failed or running
    error: float | None  # the objective [mm]; infinite where everything diverged, None where there is none yet
    settings: Mapping[str, Any]  # by dotted key
    seconds: float | None  # of computation, summed over all processes that ran it [s]


class Study:
    """The study in a folder, opened by one of its processes.

    Args:
        folder: of the study, which is created if it does not exist.
        space: values of each setting, by dotted key.
        conditions: everything else on which a trial's result depends, as plain data.
        trials: number of trials to finish, over all processes.
        seed: of the sampler.

    Raises:
        InputError: the existing study has another space or other conditions.
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
                os.truncate(journal, content.rfind(b"\n") + 1)  # drops a line that was cut off by a full disk
                guard = JournalFileOpenLock if os.name == "nt" else JournalFileSymlinkLock  # links take rights there
                storage = JournalStorage(JournalFileBackend(str(journal), guard(str(journal))))
                exists = _NAME in optuna.get_all_study_names(storage)  # creating it again would write to the journal
                self._study = (optuna.load_study if exists else optuna.create_study)(study_name=_NAME, storage=storage)
        except OSError as error:
            raise DataFileError(f"cannot write {folder} ({error.strerror}): make it writable") from error
        except (ValueError, KeyError, AssertionError) as error:
            raise DataFileError(f"{journal} is damaged ({error}): delete it to start the study anew") from error
        self._agree({"space": {key: str(dimension) for key, dimension in space.items()}, **to_plain(conditions)})

    def _agree(self, conditions: dict[str, Any]) -> None:
        """Stores the conditions of a new study; compares those of an existing one."""
        if "conditions" not in self._study.user_attrs:
            self._study.set_user_attr("conditions", conditions)
        stored, new = dict(flatten(self._study.user_attrs["conditions"])), dict(flatten(conditions))
        for key in sorted({*stored, *new}, key=lambda key: (not key.startswith("space."), key)):
            if stored.get(key, "absent") != new.get(key, "absent"):
                raise InputError(
                    f"the study in {self.folder} has another setting: {key} was {stored.get(key, 'absent')}, now it is "
                    f"{new.get(key, 'absent')}; use the old setting, delete the folder, or name another study with "
                    "tune.study=..."
                )

    def _trials(self, *states: TrialState) -> list[FrozenTrial]:
        return self._study.get_trials(deepcopy=False, states=states or None)

    def _numbered(self) -> Iterator[tuple[int, FrozenTrial]]:
        """Yields all trials with their numbers; a trial that continues another one has its number."""
        count = 0
        for trial in self._trials():
            continues = trial.user_attrs.get(_CONTINUES)
            yield (count if continues is None else continues), trial
            count += continues is None

    def claim(self) -> Claim | None:
        """Returns a trial for this process, one that another process lost or a new one; None if there is none."""
        with self._lock:
            for number, running in self._numbered():
                if running.state == TrialState.RUNNING:
                    with suppress(Timeout), self._lock_of(number).acquire(timeout=0):
                        self._study.tell(running.number, state=TrialState.FAIL)
                        self._study.enqueue_trial(self._drawn(running), user_attrs={_CONTINUES: number})
            if len(self._trials(TrialState.RUNNING, TrialState.COMPLETE, TrialState.PRUNED)) >= self.trials:
                return None
            waiting = [lost.user_attrs[_CONTINUES] for lost in self._trials(TrialState.WAITING)]
            number = waiting[0] if waiting else len(dict(self._numbered()))
            lock = self._lock_of(number)
            lock.acquire()
            # The sampler is seeded by trial, so that settings do not depend on the process.
            seed = int(np.random.SeedSequence([self._seed, number]).generate_state(1)[0])
            self._study.sampler = optuna.samplers.TPESampler(seed=seed)
            trial = self._study.ask({key: dimension.distribution for key, dimension in self.space.items()})
            trial.set_user_attr("process", f"{socket.gethostname()}:{os.getpid()}")
            return Claim(number, self._settings(trial.params), trial, lock)

    def _drawn(self, trial: FrozenTrial) -> dict[str, Any]:
        """Returns the settings of a trial; those given if its process ended while it drew them, to draw anew."""
        complete = trial.params.keys() >= self.space.keys()
        return trial.params if complete else trial.system_attrs.get("fixed_params", {})

    def _lock_of(self, number: int) -> FileLock:
        return FileLock(self.folder / "trials" / f"{number}.lock")

    def _settings(self, params: Mapping[str, Any]) -> dict[str, Any]:
        return {key: dimension.value(params[key]) for key, dimension in self.space.items() if key in params}

    def end(self, claim: Claim, value: float | None, seconds: float, state: TrialState = TrialState.COMPLETE) -> None:
        """Ends a trial with its objective, infinite where it diverged; failed trials do not count."""
        with suppress(UpdateFinishedTrialError):  # Another process took the trial over, as if this one had ended.
            claim.trial.set_user_attr("seconds", seconds)
            self._study.tell(claim.trial, value, state=state)
        claim.lock.release()
        (self.folder / "trials" / f"{claim.number}.lock").unlink(missing_ok=True)

    def outcomes(self) -> list[Outcome]:
        """Returns all trials so far, by number."""
        outcomes = []
        for number, trial in dict(self._numbered()).items():
            error = min(trial.intermediate_values.values(), default=None) if trial.value is None else trial.value
            state, seconds = _STATES.get(trial.state, "running"), trial.user_attrs.get("seconds")
            outcomes.append(Outcome(number, state, error, self._settings(trial.params), seconds))
        return outcomes

    def finished(self) -> int:
        """Returns the number of finished trials, including stopped ones."""
        return len(self._trials(TrialState.COMPLETE, TrialState.PRUNED))

    def running(self) -> list[str]:
        """Returns the processes that run a trial now, as ``host:pid``."""
        return [trial.user_attrs.get("process", "?") for trial in self._trials(TrialState.RUNNING)]

    def importance(self) -> dict[str, float]:
        """Returns the importance of each setting for being among the best quarter, summing to one.

        It is computed by PED-ANOVA (Watanabe et al., 2023, arXiv:2304.10255); empty with fewer than four trials.
        """
        values = {trial.value for trial in self._trials(TrialState.COMPLETE) if trial.value is not None}
        if sum(map(math.isfinite, values)) < 4:
            return {}
        evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.25)
        importance = optuna.importance.get_param_importances(self._study, evaluator=evaluator)
        return {key: float(value) for key, value in importance.items()}
