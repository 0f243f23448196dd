"""Errors of simulators with laws on observed motions, their comparison, and the stretches of a body in them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Final

import numpy as np
import torch

from ...data.markers import WHOLE_STATE
from ...dynamics.simulator import Simulator
from ...fem.integration_points import principal_stretches
from ...io.arrays import FloatArray
from ..observed_motions import Identified, ObservedMotions
from ..replay import Replay, Start
from .law import LawClass
from .search import Identification
from .uncertainty import redundancy

_CLEARLY, _CLOSER = 0.5, 0.95  # ratios of errors
_SIGNIFICANT: Final = 2.0  # standard errors


@dataclass(frozen=True)
class Score:
    """Errors of a simulator on trials: in each frame the mean square over the squared amplitude of the trial."""

    frames: tuple[FloatArray, ...]  # (T,) of each trial

    @property
    def error(self) -> float:
        """Root mean square over the amplitude, over all trials; infinite if one failed."""
        if not self.frames:
            return math.inf
        square = fmean(float(of_trial.mean()) for of_trial in self.frames)
        return math.sqrt(square) if math.isfinite(square) else math.inf

    def beats(self, other: "Score") -> bool:
        """Whether the error is at most half, or its mean square smaller by two standard errors.

        Frames are correlated in time, so that a short trial may show no less than a large gain. Of static poses the
        standard error is that of the trials' mean; one pose has none, and its error must be smaller by 5 %.
        """
        if not math.isfinite(self.error) or self.error <= _CLEARLY * other.error:
            return self.error < other.error
        less = [theirs - ours for ours, theirs in zip(self.frames, other.frames, strict=True)]
        means = np.array([d.mean() for d in less])
        if max(len(d) for d in less) > 1:
            variance = [float(d.var()) * redundancy((d - d.mean())[:, None]) / len(d) for d in less]
            doubt = math.sqrt(sum(variance)) / len(less)
        elif len(less) > 1:
            doubt = float(means.std(ddof=1)) / math.sqrt(len(less))
        else:
            return self.error < _CLOSER * other.error
        return float(means.mean()) > _SIGNIFICANT * doubt


@dataclass(frozen=True)
class RefinedLaw:
    """A law that is refined through the simulator."""

    law: LawClass
    others: dict[str, float]  # identified parameters that are not those of the material
    names: dict[str, str]  # of all identified parameters in `found`, by their names in the law
    found: Identification
    score: Score  # on the trials that laws are tested on


@torch.no_grad()
def scores_of(
    replays: Sequence[tuple[Replay, Start]],
    values: Mapping[str, torch.Tensor],
    begin: float = 0.0,
    seconds: float | None = None,
) -> list[Score]:
    """Returns the errors of a simulator on trials, for E sets of parameters.

    Args:
        replays: of the trials, with their starts.
        values: (E,) values of the parameters by name; without any E is one.
        begin: time from which frames count [s].
        seconds: time until which frames count [s]; None for all.
    """
    frames: list[list[FloatArray]] = [[] for _ in next(iter(values.values()), range(1))]
    for replay, start in replays:
        trials = replay.trials if seconds is None else replay.trials.first(seconds)
        counted = Replay(replay.simulator, replay.observe, trials)
        errors = counted.errors(counted(start, values)).square().sum((3, 4))  # (E, R, T)
        seen = trials.seen.sum(2)
        means = errors / (seen.clamp_min(1) * trials.amplitude.square()[:, None])
        for row, inside in enumerate((trials.times >= begin) & (seen > 0)):
            for of_set, of_all in zip(means, frames, strict=True) if bool(inside.any()) else ():
                of_all.append(of_set[row, inside].double().cpu().numpy())
    return [Score(tuple(rows)) for rows in frames]


def stretches_in(
    motions: ObservedMotions,
    names: Sequence[str],
    simulator: Simulator,
    parameters: Mapping[str, float],
    identified: Identified,
) -> list[float]:
    """Returns the least and the largest principal stretch of a body in trials, simulated where markers are seen.

    Args:
        motions: the trials.
        names: their names.
        simulator: with a law.
        parameters: values of its other parameters.
        identified: parameters with which the starts of the trials are estimated.
    """
    mesh = simulator.body.mesh
    if motions.sees_states:
        bodies = [motions.trials.observed[motions.trials.rows(names)]]
    else:
        values = {name: simulator.tensor([value]) for name, value in parameters.items()}
        with torch.no_grad():
            bodies = [
                Replay(simulator, WHOLE_STATE, replay.trials)(replace(start, shift=None), values).cpu().numpy()
                for replay, start in motions.replays(simulator, names, identified)
            ]
    parts = [principal_stretches(mesh, body.reshape(-1, *mesh.vertices.shape)) for body in bodies]
    return [float(min(map(np.nanmin, parts))), float(max(map(np.nanmax, parts)))]
