"""Laws that are refined through the simulator: their errors,
a search by these, and the stretches of a body.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final

import numpy as np
import torch

from ...core.dynamics.simulator import Simulator
from ...core.fem.integration_points import principal_stretches
from ...core.mesh.volume_mesh import Mesh
from ...data.markers import WHOLE_STATE
from ...io.arrays import FloatArray
from ...settings.learning import LawSettings
from ..observed_motions import Identified, ObservedMotions
from ..replay import Replay
from ..scores import Score
from ..start import Start
from .law import LawClass, branches_of, family, longest_side
from .search import Identification

_RUBBERY: Final = (
    25.0  # least bulk over shear modulus in the first guess of a search; Poisson's ratio of 0.49
)
# Names of parameters of a group begin with these.
_MEMBERS: Final = {"branches": ("prony",), "fibres": ("fibre",)}


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
        counted = replay.changed(trials=trials)
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
    """Returns the least and the largest principal stretch of a body in trials,
    simulated where markers are seen.

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
            replays = motions.replays(simulator, names, identified)
            whole = [
                (replay.changed(simulator=simulator, observe=WHOLE_STATE), start)
                for replay, start in replays
            ]
            bodies = [
                replay(replace(start, shift=None), values).cpu().numpy() for replay, start in whole
            ]
    parts = [principal_stretches(mesh, body.reshape(-1, *mesh.vertices.shape)) for body in bodies]
    return [float(min(map(np.nanmin, parts))), float(max(map(np.nanmax, parts)))]


def tried_without_states(
    refine: Callable[[LawClass], RefinedLaw],
    guess: Mapping[str, float],
    wanted: LawSettings,
    mesh: Mesh,
) -> list[RefinedLaw]:
    """Returns the classes that were tried through the simulator, the best last.

    The search begins with all groups of terms, and takes away those without which validation trials
    are as close: a class that lacks a group makes up for it with others, from where the group no
    longer helps.

    Args:
        refine: refines a law through the simulator.
        guess: a neo-Hookean law like the identified material.
        wanted: terms, branches and families of the largest class.
        mesh: of the body.
    """
    shear = 2.0 * guess["c10"]
    start = {**guess, "bulk_1": max(guess["bulk_1"], _RUBBERY * shear)}
    creep = {name: value for name, value in guess.items() if name.startswith("prony")}
    known = [value for name, value in creep.items() if name.startswith("prony_time")]
    shortest, longest = wanted.relaxation_times
    middles = [shortest ** (1.0 - x) * longest**x for x in (0.25, 0.75)][: wanted.branches]
    times = [time for time in middles if all(not time / 4.0 < one < 4.0 * time for one in known)]
    groups = {
        "elastic": dict.fromkeys(wanted.terms, 0.0),
        "branches": branches_of([0.1 * shear] * len(times), times, len(known) + 1),
        "fibres": family(0.3 * shear, longest_side(mesh)) if wanted.families else {},
    }
    groups = {name: added for name, added in groups.items() if added}
    whole = dict(chain.from_iterable(added.items() for added in groups.values()))
    best = refine(LawClass(tuple(groups), start | whole, math.nan))
    tried = [best]
    for name in groups:
        left = {
            n: x
            for n, x in best.law.parameters.items()
            if not n.startswith(_MEMBERS.get(name, wanted.terms))
        }
        if name == "branches":
            left |= creep
        if name == "elastic":  # They may have been all that resists shear.
            left["c10"] = max(left["c10"], guess["c10"])
        smaller = LawClass(
            tuple(group for group in best.law.groups if group != name), left, math.nan
        )
        if left == best.law.parameters:  # The search has left nothing of the group.
            best = replace(best, law=smaller)
            continue
        tried.append(refine(smaller))
        if not best.score.beats(tried[-1].score):
            best = tried[-1]
    return [one for one in tried if one.law.parameters != best.law.parameters] + [best]
