"""A study that any number of processes keep together in one folder.

What is tried and what came of it stands in a journal. Who writes to it holds the study's lock, so that no trial is
begun, told or taken over twice. A trial belongs to the worker that claimed it last.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import FrozenTrial, Trial, TrialState
from typing_extensions import override

from ...experiment.schema import dotted
from ...io.errors import DataFileError, InputError
from ...io.files import to_plain
from .space import Dimension
from .workers import held

JOURNAL = "study.journal"
_LOCK = "study.lock"
_NAME = "tuning"
_LAYOUT = 2  # of what trials keep in the journal
_STATES = {TrialState.COMPLETE: "complete", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}


class _NoLock(JournalFileOpenLock):
    """For a journal whose writers hold a lock already; Optuna's own stays behind for a while when its holder dies."""

    @override
    def acquire(self) -> bool:
        return True

    @override
    def release(self) -> None:
        pass


@dataclass(frozen=True)
class Claim:
    """A trial that this worker runs."""

    number: int  # from 0 on
    settings: Mapping[str, Any]  # that are tried, by dotted key
    claims: int  # how many workers have had it so far, this one included
    trial: Trial  # as the sampler knows it


@dataclass(frozen=True)
class Outcome:
    """What is known of a trial."""

    number: int  # from 0 on
    state: str  # complete, pruned, failed or running
    error: float | None  # the objective [mm]; infinite where everything diverged, None where it is not known
    settings: Mapping[str, Any]  # that were tried, by dotted key
    seconds: float | None  # of computation, over all workers that had it [s]; None where it is not known


class SharedStudy:
    """The study in a folder, as one of its workers sees it.

    Args:
        folder: where the study is, or is to be made.
        space: what each setting may be.
        conditions: everything else that a trial's result depends on, as plain data.
        trials: how many are to be finished, over all workers.
        seed: of the sampler.
        identity: of this worker.
        is_alive: tells which other workers live.

    Raises:
        InputError: the study that is there has another space or other conditions.
        DataFileError: the folder cannot be written, or the journal is damaged.
    """

    def __init__(
        self,
        folder: Path,
        space: Mapping[str, Dimension],
        conditions: Mapping[str, Any],
        trials: int,
        seed: int,
        identity: Mapping[str, Any],
        is_alive: Callable[[Mapping[str, Any]], bool],
    ) -> None:
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.folder, self.trials = folder, trials
        self._space, self._seed, self._identity, self._is_alive = space, seed, dict(identity), is_alive
        journal = folder / JOURNAL
        with self.lock():
            try:
                self._storage = JournalStorage(JournalFileBackend(str(journal), lock_obj=_NoLock(str(journal))))
            except (ValueError, KeyError, AssertionError) as error:
                raise DataFileError(f"{journal} is damaged ({error}): delete it to start the study anew") from error
            known = [study.study_name for study in self._storage.get_all_studies()]
            open_study = optuna.load_study if _NAME in known else optuna.create_study
            self._study = open_study(study_name=_NAME, storage=self._storage)
            self._id = self._storage.get_study_id_from_name(_NAME)
            named = {"layout of the journal": _LAYOUT, **to_plain(conditions)}
            self._agree({"space": {key: str(each) for key, each in space.items()}, **named})

    @contextmanager
    def lock(self) -> Iterator[None]:
        """No other worker writes meanwhile; what a killed one left half written is gone."""
        with held(self.folder / _LOCK):
            journal = self.folder / JOURNAL
            content = journal.read_bytes() if journal.exists() else b""
            if not content.endswith(b"\n"):
                journal.touch()
                os.truncate(journal, content.rfind(b"\n") + 1)
            yield

    def _agree(self, conditions: dict[str, Any]) -> None:
        """Marks a new study with its conditions, and compares those of an old one."""
        found = self._study.user_attrs.get("conditions")
        if found is None:
            self._study.set_user_attr("conditions", conditions)
            return
        there, here = dict(dotted(found)), dict(dotted(conditions))
        different = [key for key in sorted({*there, *here}) if there.get(key, "absent") != here.get(key, "absent")]
        if not different:
            return
        key = next((key for key in different if key.startswith("space.")), different[0])
        what = f"the search space of {key.removeprefix('space.')}" if key.startswith("space.") else key
        raise InputError(
            f"the study in {self.folder} has another setting: {what} was {there.get(key, 'absent')}, now it is "
            f"{here.get(key, 'absent')}; go on with the old setting, delete the folder, or name another study with "
            "tune.study=..."
        )

    def _trials(self, *states: TrialState) -> list[FrozenTrial]:
        return self._study.get_trials(deepcopy=False, states=states or None)

    def claim(self) -> Claim | None:
        """A trial for this worker: one that a dead worker left, or a new one; None if there is none to take now."""
        with self.lock():
            running = self._trials(TrialState.RUNNING)
            for trial in running:
                claims = trial.user_attrs.get("claims", [])
                if not claims or not self._is_alive(claims[-1]):
                    number = self._storage.get_trial_id_from_study_id_trial_number(self._id, trial.number)
                    return self._take(Trial(self._study, number))
            if len(running) + len(self._trials(TrialState.COMPLETE, TrialState.PRUNED)) >= self.trials:
                return None
            return self._take(self._study.ask())

    def _take(self, trial: Trial) -> Claim:
        claims = [*trial.user_attrs.get("claims", []), self._identity]
        trial.set_user_attr("claims", claims)
        settings = {}
        for place, (key, each) in enumerate(self._space.items()):
            # Every setting of every trial draws a number of its own: no two trials try the same, and one that a worker
            # left before it had drawn them all goes on with the same ones.
            seed = int(np.random.SeedSequence([self._seed, trial.number, place]).generate_state(1)[0])
            self._study.sampler = optuna.samplers.TPESampler(seed=seed)
            settings[key] = each.suggest(trial, key)
        trial.set_user_attr("settings", settings)
        return Claim(trial.number, settings, len(claims), trial)

    def owns(self, claim: Claim) -> bool:
        """Whether a trial is still this worker's: nobody took it over."""
        now = self._trials()[claim.number]
        return now.state == TrialState.RUNNING and now.user_attrs["claims"][-1] == self._identity

    def report(self, claim: Claim, step: int, value: float) -> None:
        """Notes a value on the way, such as after an epoch, if the trial is still this worker's."""
        with self.lock():
            if self.owns(claim) and step not in self._trials()[claim.number].intermediate_values:
                claim.trial.report(value, step)

    def tell(self, claim: Claim, value: float | None, seconds: float) -> bool:
        """Ends a trial with its objective, infinite where it diverged; None for a trial that is given up.

        Returns:
            Whether it was this worker's to end; if not, nothing is changed.
        """
        return self._end(claim, seconds, TrialState.PRUNED if value is None else TrialState.COMPLETE, value)

    def fail(self, claim: Claim, seconds: float) -> bool:
        """Ends a trial that cannot be computed; it does not count."""
        return self._end(claim, seconds, TrialState.FAIL, None)

    def _end(self, claim: Claim, seconds: float, state: TrialState, value: float | None) -> bool:
        with self.lock():
            if not self.owns(claim):
                return False
            claim.trial.set_user_attr("seconds", seconds)
            self._study.tell(claim.trial, value, state=state)
            return True

    def outcomes(self) -> list[Outcome]:
        """All trials so far."""
        return [self._outcome(trial) for trial in self._trials()]

    def _outcome(self, trial: FrozenTrial) -> Outcome:
        error = min(trial.intermediate_values.values(), default=None) if trial.value is None else trial.value
        state = _STATES.get(trial.state, "running")
        known = trial.user_attrs
        return Outcome(trial.number, state, error, known.get("settings", {}), known.get("seconds"))

    def holders(self) -> list[str]:
        """Who runs a trial now, in words."""
        claims = [trial.user_attrs.get("claims") for trial in self._trials(TrialState.RUNNING)]
        return [f"{each[-1]['host']}:{each[-1]['pid']}" for each in claims if each]

    def importance(self) -> dict[str, float]:
        """How much each setting matters for being among the best quarter, summing to one; empty if that is not known.

        By PED-ANOVA (Watanabe et al., 2023, arXiv:2304.10255).
        """
        values = {trial.value for trial in self._trials(TrialState.COMPLETE) if trial.value is not None}
        if sum(map(math.isfinite, values)) < 4:
            return {}
        evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.25)
        found = optuna.importance.get_param_importances(self._study, evaluator=evaluator)
        return {key: float(value) for key, value in found.items()}
