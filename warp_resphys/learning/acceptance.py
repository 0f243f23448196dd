"""What a learned force must not do, however accurate its roll-outs are.

A robot with the force must have an equilibrium at rest and under constant inputs of the training,
and rest near its recordings where these are at rest. Readings of force sensors must be predicted no
worse than without it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import torch

from ..core.dynamics.simulator import Simulator
from ..core.stepping.inputs import Inputs
from ..core.stepping.state import State
from ..data.trials import evenly
from ..io.errors import ConvergenceError, listed
from .evaluation import TrialRollout, evaluate
from .observed_motions import Identified, ObservedMotions
from .residuals.correction import Learned
from .residuals.feedback import equilibrium_under_feedback
from .trial_batch import TrialBatch

_MOST_TRIALS: Final = 8  # in which equilibria are sought
_LAST: Final = 10  # frames at the end of a trial in which a body at rest stays where it is
_STILL: Final = 0.02  # of the amplitude of a trial, up to which its markers stay where they are
_WORSE: Final = 1.05  # ratio of errors of readings, above which they are worse


class Acceptance:
    """Checks of a learned force beside its errors.

    Args:
        simulator: that the force corrects.
        motions: observed trials.
        identified: parameters of the simulator.
        away_mm: mean error of the simulator without the force [mm]; resting bodies may be as far
            from a recording.
    """

    def __init__(
        self, simulator: Simulator, motions: ObservedMotions, identified: Identified, away_mm: float
    ) -> None:
        counting = simulator.settings.changed(on_failure="count")
        self._simulator, self._motions = replace(simulator, solver=counting), motions
        self._identified, self._away_mm = identified, away_mm

    def objections(
        self, learned: Learned, train: Sequence[str], judged: Sequence[str]
    ) -> list[str]:
        """Returns why a force is refused, as parts of a sentence.

        Nothing for one that is acceptable.

        Args:
            learned: the force.
            train: names of the trials before which, and under whose inputs, there must be an
                equilibrium.
            judged: names of the trials whose readings are predicted.
        """
        found = list[str]()
        for batch in self._motions.trials.batches(evenly(train, _MOST_TRIALS)):
            run = TrialRollout(self._simulator, self._motions, batch, self._identified)
            found += self._at_rest(run, learned)
        return [*dict.fromkeys(found), *self._of_readings(learned, judged)]

    def _at_rest(self, run: TrialRollout, learned: Learned) -> Iterator[str]:
        """Yields objections to equilibria before trials
        that begin alike, and under their inputs.
        """
        trials = run.replay.trials
        if run.replay.is_static:  # Their roll-outs are equilibria.
            return
        before = trials.held if run.start.at_rest else torch.full_like(trials.held, torch.nan)
        yield from self._in_poses(run, learned, _resting(trials), "at rest", before)
        if trials.inputs.actuation and trials.inputs.fixed_positions is None:
            where = "under constant inputs of the training"
            last, largest = trials.inputs.at(run.steps - 1), _largest(trials.inputs)
            yield from self._in_poses(run, learned, last, where, _at_the_end(trials))
            if any(
                not torch.equal(x, last.actuation[name]) for name, x in largest.actuation.items()
            ):
                yield from self._in_poses(
                    run, learned, largest, where, torch.full_like(before, torch.nan)
                )

    def _in_poses(
        self,
        run: TrialRollout,
        learned: Learned,
        inputs: Inputs,
        where: str,
        observed: torch.Tensor,
    ) -> Iterator[str]:
        """Yields objections to equilibria under constant inputs of trials that begin alike.

        Args:
            run: of the R trials.
            learned: the force.
            inputs: constant commands.
            where: in words.
            observed: (R, M, D) points there, NaN where a recording is not at rest.
        """
        below = self._settled(run, None, inputs)
        if below is None:
            return
        try:
            state = self._settled(run, learned, inputs)
        except ConvergenceError as error:
            rests = (
                error.report.tolist()
                if isinstance(error.report, torch.Tensor)
                else [False] * below.batch
            )
            named = [
                name
                for name, there in zip(run.replay.trials.names, rests, strict=True)
                if not there
            ]
            of_some = f" ({listed(named)})" if any(rests) else ""
            yield f"{where}{of_some} the robot has no equilibrium with it"
            return
        assert state is not None
        with_it, without = (self._distance_mm(run, one, observed) for one in (state, below))
        if with_it > max(without, self._away_mm):
            yield (
                f"{where} the robot is {with_it:.3g} mm from the recording with it, and "
                f"{without:.3g} mm without"
            )

    def _settled(
        self, run: TrialRollout, learned: Learned | None, commands: Inputs
    ) -> State | None:
        """Returns the equilibria of R trials under constant commands.

        None for a body that nothing holds.

        Raises:
            ConvergenceError: there is no equilibrium with the force.
        """
        constant = replace(run.replay.trials, inputs=commands, resting=commands)
        replay = run.replay.changed(trials=constant)
        values = self._identified.values(self._simulator)
        constants, acting, _ = replay.prepare(values)
        rest = self._simulator.rest_state(len(constant.names))
        if not self._simulator.is_held(rest, acting, constants):
            return None
        with torch.no_grad():
            if learned is not None:
                predictor = run.predictor(learned, replay)
                return equilibrium_under_feedback(
                    self._simulator, acting, constants, rest, predictor
                )
            try:
                return self._simulator.static_equilibrium(acting, constants, batch=rest.batch)
            except ConvergenceError:  # The simulator has none, so that the force is not to blame.
                return None

    def _distance_mm(self, run: TrialRollout, state: State, observed: torch.Tensor) -> float:
        """Returns the largest of the trials' mean distances from points (R, M, D) [mm].

        Zero where none was seen.
        """
        away = 1e3 * self._motions.observe.residual(
            run.replay.observe(state.q), observed.to(state.q)
        ).norm(dim=-1)
        seen = torch.isfinite(observed).all(-1).to(away.device)
        means = (away * seen).sum(1) / seen.sum(1).clamp_min(1)
        return float(means.max())

    def _of_readings(self, learned: Learned, names: Sequence[str]) -> Iterator[str]:
        """Yields objections to the predicted readings of force sensors."""
        for name, sensor in self._motions.sensors.items():
            away_by = partial(
                evaluate,
                self._simulator,
                self._motions,
                names=names,
                parameters=self._identified,
                sensor=name,
            )
            with_it, without = (float(np.nanmean(away_by(force))) for force in (learned, None))
            if with_it > max(_WORSE * without, without + sensor.noise):
                away = (
                    f"{with_it:.3g} {sensor.unit} with it, and {without:.3g} {sensor.unit} without"
                )
                yield f"the predicted readings of the force sensor {name} are off by {away}"


def _resting(trials: TrialBatch) -> Inputs:
    """Returns the inputs before trials: those that are known, weights, and zeros of all others."""
    first = trials.inputs.at(0)
    return first.replace(**{name: 0.0 * x for name, x in first.actuation.items()}).replace(
        **trials.resting.fields
    )


def _largest(inputs: Inputs) -> Inputs:
    """Returns the largest inputs of each trial over time,
    by the sum of their squares over the largest of all.
    """
    series = [x / x.abs().max().clamp_min(1e-12) for x in inputs.actuation.values() if x.ndim == 3]
    if not series:
        return inputs
    largest = torch.cat(series, -1).square().sum(-1).argmax(0)
    return inputs.window(largest, 1).at(0)


def _at_the_end(trials: TrialBatch) -> torch.Tensor:
    """The points (R, M, D) at the end of trials [unit], NaN where they or the inputs still move."""
    last = trials.observed[:, -_LAST:]
    spread = (last.amax(1) - last.amin(1)).norm(dim=-1)
    still = spread <= _STILL * trials.amplitude[:, None]
    for values in trials.inputs.actuation.values():
        if values.ndim == 3:
            before = values[-min(_LAST, len(values)) :]
            still = still & (before == before[-1]).all(0).all(-1)[:, None]
    return torch.where(still[..., None], last.mean(1), torch.nan)
