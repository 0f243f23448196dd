"""Stage: identifies the law of the material from the training trials, and accepts it if it helps on validation trials.

Where the trials give the states of all vertices, the weak form fits every class of laws (`learning.law`), and the
smallest one that is close to the best on the validation trials is refined through the simulator, and larger ones that
balance the forces clearly better, too. With markers alone, the search begins with all groups of terms and takes one
after the other away, each time refined through the simulator, if the validation trials are as close without it. The
other identified parameters are refined with the law.

A law of another run stays as it is; the parameters of actuators and of the medium are identified with it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np

from ..data.rigid_bodies import independent
from ..dynamics.simulator import Simulator
from ..energies.catalogue import law_content, read_law
from ..io.progress import Progress
from ..io.resuming import StageContext, package_versions
from ..io.safe_files import write_json
from ..learning.identification import ParameterSearch
from ..learning.law import VISCOSITIES, KnownMotion, LawClass, WeakForm, fit_classes
from ..learning.misfit import Misfit
from ..learning.parameters import Bounds
from ..learning.replay import Replay
from ..settings.stage_keys import StageSettings
from .experiment import LAW, Experiment
from .files import LAW_FILE
from .identify import Checkpoint, Found, IsLast, refined_searches, search_parameters
from .law_trials import LawTrials, Score, branches_of, is_refined, strong_names
from .splits import evenly

_CLOSE: Final = 1.25  # ratio of the validation error to the best one that a smaller class may have
_RUBBERY: Final = 25.0  # least bulk over shear modulus in the first guess of a search; Poisson's ratio of 0.49
_MEMBERS: Final = {"branches": ("prony",), "fibres": ("fibre",)}  # names of constants of a group begin with these
_OFF_THE_POLE: Final = 0.2  # rad, of fibres along z at first: exactly there, their azimuth has no effect
_STRIDE: Final = 10  # steps from one balance of forces to the next, where all vertices are observed
_BALANCED: Final = 0.7  # ratio of the force residuals below which a larger class is refined as well


def identify_law(context: StageContext) -> None:
    """Writes law.json: the law, its posterior, the classes that were tried, and whether it is used.

    A run that is interrupted keeps the classes of the weak form and the finished searches.

    Raises:
        DataFileError: the file of the law is missing, damaged or of another version.
    """
    settings: StageSettings = context.settings
    experiment = Experiment(settings, context.run_dir, "count")
    search = _LawSearch(context, experiment)
    content = search.run() if settings.law.file is None else search.given(settings.law.file)
    write_json(context.run_dir / LAW_FILE, content)
    search.kept.path.unlink(missing_ok=True)


@dataclass(frozen=True)
class _Refined:
    """A law that is refined through the simulator."""

    law: LawClass
    others: dict[str, float]  # identified parameters that are not those of the material
    names: dict[str, str]  # of all identified parameters in `found`, by their names in the law
    found: Found
    score: Score  # on the validation trials


class _LawSearch(LawTrials):
    """Search for a law in an experiment."""

    def __init__(self, context: StageContext, experiment: Experiment) -> None:
        super().__init__(experiment)
        self.context, self.kept = context, Checkpoint(context)
        self.released = any(experiment.dataset.begin_of(name) == "released" for name in self.settings.split.train)

    def _names(self, whole: bool) -> tuple[str, ...]:
        """Names of the trials of a search."""
        own, most = self.settings.split.train if whole else self.learned, self.settings.law.trials
        return own if most is None else tuple(evenly(own, most))

    def run(self) -> dict[str, Any]:
        """Identifies a law; returns the content of law.json."""
        if self.states:
            fitted = self.kept.once("classes", lambda: [asdict(own) for own in self._from_states()])
            classes = [LawClass(**{**own, "groups": tuple(own["groups"])}) for own in fitted]
            scores = [score.error for score in self.scores([law.constants for law in classes])]
            smallest = next(k for k, score in enumerate(scores) if score <= _CLOSE * min(scores))
            best = self._enlarged(self._refine(classes[smallest]), classes)
        else:
            refined = self._from_markers()
            classes, scores = [own.law for own in refined], [own.score.error for own in refined]
            best = refined[-1]
        if self.holds_out:
            again = self._refine(best.law, whole=True)
            best = best if best.score.beats(again.score) else replace(again, score=best.score)
        mass = {name: best.others.get(name, value) for name, value in self.mass.items()}
        below, deviation = self.score_below(), _deviation(best.found)
        tried = [{**asdict(own), "validation": score} for own, score in zip(classes, scores, strict=True)]
        return {
            **law_content(LAW, mass | best.law.constants),
            "accepted": best.score.beats(below),
            "groups": list(best.law.groups),
            "parameters": best.others,
            "deviation": {n: deviation[old] for n, old in best.names.items() if old in deviation},
            "at_bounds": [name for name, old in best.names.items() if old in best.found["at_bounds"]],
            "loss": best.found["loss"],
            "validation": self.validation(best.score, below),
            "classes": tried,
            "stretches": self.stretches(best.law.constants, best.others, self._names(whole=True)),
            "data": {"name": self.settings.name, "trials": list(self._names(whole=True))},
            "versions": package_versions(),
        }

    def given(self, file: str) -> dict[str, Any]:
        """Identifies the parameters beside a law of another run; returns the content of law.json."""
        content = read_law(file)
        content["constants"] |= self.mass  # density and damping by mass are those of this body
        simulator = self.simulator(content["constants"], content["model"])
        others, found = dict[str, float](), Found()
        if bounds := self.bounds_of_others(simulator):
            found = self._search("given", simulator, bounds, {})
            others = found["parameters"]
        values = {name: simulator.tensor([value]) for name, value in others.items()}
        score = self.errors(simulator, values, 1)[0]
        return {
            **content,
            "accepted": True,
            "accepted_there": content.get("accepted_there", content.get("accepted", True)),
            "file": file,
            "parameters": others,
            "deviation": content.get("deviation", {}) | _deviation(found),
            "at_bounds": [*content.get("at_bounds", ()), *found.get("at_bounds", ())],
            "validation": self.validation(score, self.score_below()),
        }

    def _enlarged(self, best: "_Refined", classes: Sequence[LawClass]) -> "_Refined":
        """Returns the best refined law of larger classes that balance the forces clearly better."""
        residual = min(own.residual for own in classes if _refined_groups(own) == _refined_groups(best.law))
        for law in classes:
            if _refined_groups(law) > _refined_groups(best.law) and law.residual < _BALANCED * residual:
                larger = self._refine(law)
                if larger.score.error * _CLOSE < best.score.error:
                    best, residual = larger, law.residual
        return best

    def _from_states(self) -> list[LawClass]:
        """Returns the classes of the weak form."""
        wanted, forms = self.settings.law, []
        times = np.geomspace(*wanted.relaxation_times, wanted.branches).tolist()
        zero = dict.fromkeys((*wanted.terms, "c10", "bulk_1", *VISCOSITIES), 0.0)
        zero |= branches_of([0.0], [0.1]) if wanted.branches else {}
        zero |= _family(0.0) if wanted.families else {}
        simulator, guess = self.simulator(zero), self.guess
        stiff = {"c10": guess["c10"], "bulk_1": min(guess["bulk_1"], 100.0 * guess["c10"])}
        for names in (self.settings.split.train, self.settings.split.validation):
            motions = [self._motion(simulator, own) for own in self.experiment.dataset.batches(names)] if names else []
            forms.append(WeakForm(simulator, motions, zero, stiff, _STRIDE) if motions else None)
        assert forms[0] is not None
        return fit_classes(forms[0], forms[1], wanted.terms, times, wanted.families)

    def _motion(self, simulator: Simulator, names: Sequence[str]) -> KnownMotion:
        trials = self.experiment.motions.trials(names, simulator)
        start = self.experiment.motions.start(Replay(simulator, self.experiment.motions.observe, trials))
        _, inputs, _ = Replay(simulator, self.experiment.motions.observe, trials).prepare(self.others(simulator))
        return KnownMotion(trials.observed.transpose(0, 1), start.state.v, inputs)

    def _from_markers(self) -> list["_Refined"]:
        """Returns the classes that were tried through the simulator, the best last.

        The search begins with all groups of terms, and takes away those without which validation trials are as close:
        a class that lacks a group makes up for it with others, from where the group no longer helps.
        """
        guess, wanted = dict(self.guess), self.settings.law
        own = {name: value for name, value in guess.items() if name.startswith("prony")}
        known = [value for name, value in own.items() if name.startswith("prony_time")]
        shortest, longest = wanted.relaxation_times
        middles = [shortest ** (1.0 - x) * longest**x for x in (0.25, 0.75)][: wanted.branches]
        times = [time for time in middles if all(not time / 4.0 < one < 4.0 * time for one in known)]
        groups = {
            "elastic": dict.fromkeys(wanted.terms, 0.0),
            "branches": branches_of([0.1 * self.shear] * len(times), times, len(known) + 1),
            "fibres": _family(0.3 * self.shear, self._longest_side()) if wanted.families else {},
        }
        groups = {name: added for name, added in groups.items() if added}
        guess["bulk_1"] = max(guess["bulk_1"], _RUBBERY * self.shear)
        whole = {name: value for added in groups.values() for name, value in added.items()}
        best = self._refine(LawClass(tuple(groups), guess | whole, math.nan))
        tried = [best]
        for name in groups:
            left = {n: x for n, x in best.law.constants.items() if not n.startswith(_MEMBERS.get(name, wanted.terms))}
            if name == "branches":
                left |= own
            if name == "elastic":  # They may have been all that resists shear.
                left["c10"] = max(left["c10"], guess["c10"])
            smaller = LawClass(tuple(group for group in best.law.groups if group != name), left, math.nan)
            if left == best.law.constants:  # The search has left nothing of the group.
                best = replace(best, law=smaller)
                continue
            tried.append(self._refine(smaller))
            if not best.score.beats(tried[-1].score):
                best = tried[-1]
        return [one for one in tried if one.law.constants != best.law.constants] + [best]

    def _longest_side(self) -> tuple[float, float]:
        """Azimuth and elevation of the longest side of the box around the body [rad]."""
        side = int(np.ptp(self.experiment.body.mesh.vertices, axis=0).argmax())
        return ((0.0, 0.0), (0.5 * np.pi, 0.0), (0.0, 0.5 * np.pi - _OFF_THE_POLE))[side]

    def _refine(self, law: LawClass, whole: bool = False) -> "_Refined":
        """Returns a law that is refined through the simulator, with the other identified parameters.

        Args:
            law: first guess.
            whole: whether to use the whole of training trials on which laws are tested as well.
        """
        guess = dict(law.constants)
        guess |= {name: guess.get(name, 0.0) for name in VISCOSITIES}
        simulator = self.simulator(guess)
        others = self.bounds_of_others(simulator)
        bounds = {name: self.bounds(name, value) for name, value in guess.items() if is_refined(name)} | others
        key = " ".join([*law.groups, *(["whole"] if whole else [])])

        def searched(number: int, before: Found | None, is_last: IsLast) -> Found:
            first = {} if before is None else before["parameters"]
            own = guess | {name: value for name, value in first.items() if name in guess}
            return self._search(f"{key} {number}", self.simulator(own), bounds, first | own, is_last)

        found = refined_searches(searched, self.released)[-1]  # A release is estimated with a law.
        after = found["parameters"]
        refined = {name: after.get(name, value) for name, value in guess.items()}
        names = strong_names(refined, self.shear)
        kept, beside = {n: refined[old] for n, old in names.items()}, {n: after[n] for n in others}
        score = self.scores([kept], beside)[0]
        return _Refined(replace(law, constants=kept), beside, {**names, **{n: n for n in others}}, found, score)

    def _search(
        self,
        key: str,
        simulator: Simulator,
        bounds: Mapping[str, Bounds],
        guess: Mapping[str, float],
        is_last: IsLast = lambda loss: True,
    ) -> Found:
        """Returns the parameters that are closest to the training trials, from a guess and SysID's values.

        Args:
            key: of the checkpoint.
            simulator: with a law.
            bounds: of the parameters.
            guess: of some of them, in place of SysID's values.
            is_last: see `ParameterSearch.run`.
        """
        wanted, whole, given = self.settings.law, "whole" in key, key == "given"
        limits = (self.seconds, None if whole else wanted.seconds, None if whole or given else self.early)

        def work() -> Found:
            seconds = min((limit for limit in limits if limit is not None), default=None)
            replays = self.replays(simulator, self._names(whole or given))
            misfit = Misfit(replays, bounds, seconds, shares=independent(self.experiment.dataset.labels))
            first = {name: {**self.sysid, **guess}[name] for name in bounds}
            with Progress(self.context.name, wanted.max_evaluations, "evaluations at most") as progress:
                return search_parameters(ParameterSearch(misfit), first, wanted, progress, is_last)

        return dict(self.kept.once(key, work))


def _deviation(found: Found) -> dict[str, float]:
    """Standard deviations of identified parameters; empty if they are not known."""
    return dict((found.get("uncertainty") or {}).get("deviation", {}))


def _refined_groups(law: LawClass) -> set[str]:
    """Groups of terms of a law when it is refined, which adds viscosities."""
    return {*law.groups, "viscosity"}


def _family(tension: float, direction: tuple[float, float] = (0.0, 0.0)) -> dict[str, float]:
    """Constants of fibres with a tension [Pa], along an azimuth and an elevation [rad]."""
    zero = {f"fibre_{name}_1": 0.0 for name in ("slack", "stiffening", "compression")}
    angles = dict(zip(("fibre_azimuth_1", "fibre_elevation_1"), direction, strict=True))
    return {"fibre_tension_1": tension, "fibre_toe_1": 0.02, **angles, **zero}
