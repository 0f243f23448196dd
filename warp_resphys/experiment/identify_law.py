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
from ..energies.catalogue import LAW_FORMAT, read_law, unit_of
from ..io.files import write_json
from ..io.progress import Progress
from ..io.stages import StageContext, package_versions
from ..learning.bounds import Bounds
from ..learning.identification import Identifier
from ..learning.law import VISCOSITIES, LawClass, Library, fit_classes
from ..learning.replay import Replay
from ..learning.weak_form import KnownMotion, WeakForm
from ..settings.stages import IdentifyLawStage
from .experiment import LAW, Experiment
from .files import LAW_FILE
from .identify import Checkpoint, again_of, changes
from .law_trials import LawTrials, Score, branches_of, is_refined, stretches_of, strong_names
from .trials import evenly

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
    settings: IdentifyLawStage = context.settings
    experiment = Experiment(settings, context.run_dir, "count")
    search = _LawSearch(context, experiment)
    content = search.run() if settings.law.file is None else search.given(settings.law.file)
    write_json(context.run_dir / LAW_FILE, content)
    search.kept.path.unlink(missing_ok=True)


@dataclass(frozen=True)
class _Found:
    """Result of a search."""

    parameters: dict[str, float]
    loss: float
    at_bounds: Sequence[str]  # parameters that ended on a bound
    deviation: dict[str, float]  # standard deviations; empty if they are not known


@dataclass(frozen=True)
class _Refined:
    """A law that is refined through the simulator."""

    law: LawClass
    others: dict[str, float]  # identified parameters that are not those of the material
    names: dict[str, str]  # of all identified parameters in `found`, by their names in the law
    found: _Found
    score: Score  # on the validation trials


class _LawSearch:
    """Search for a law in an experiment."""

    def __init__(self, context: StageContext, experiment: Experiment) -> None:
        self.context, self.experiment, self.trials = context, experiment, LawTrials(experiment)
        self.kept = Checkpoint(context, "law")
        self.settings: IdentifyLawStage = context.settings
        self.released = any(experiment.begins(name) == "released" for name in self.settings.split.train)

    def _names(self, whole: bool) -> tuple[str, ...]:
        """Names of the trials of a search."""
        own, most = self.settings.split.train if whole else self.trials.learned, self.settings.law.trials
        return own if most is None else tuple(evenly(own, most))

    def run(self) -> dict[str, Any]:
        """Identifies a law; returns the content of law.json."""
        wanted = self.settings.law
        shortest, longest = wanted.relaxation_times
        library = Library(
            terms=tuple(wanted.terms),
            times=tuple(np.geomspace(shortest, longest, wanted.branches).tolist()),
            families=wanted.families,
        )
        if self.trials.states:
            if "classes" not in self.kept.content:
                self.kept.keep(classes=[asdict(own) for own in self._from_states(library)])
            classes = [LawClass(**{**own, "groups": tuple(own["groups"])}) for own in self.kept.content["classes"]]
            scores = [score.error for score in self.trials.scores([law.constants for law in classes])]
            smallest = next(k for k, score in enumerate(scores) if score <= _CLOSE * min(scores))
            best = self._enlarged(self._refine(classes[smallest]), classes)
        else:
            refined = self._from_markers(library)
            classes, scores = [own.law for own in refined], [own.score.error for own in refined]
            best = refined[-1]
        if self.trials.holds_out:
            again = self._refine(best.law, whole=True)
            best = best if best.score.beats(again.score) else replace(again, score=best.score)
        mass = {name: best.others.get(name, value) for name, value in self.trials.mass.items()}
        constants = mass | best.law.constants
        below, deviation = self.trials.score_below(), best.found.deviation
        tried = [{**asdict(own), "validation": score} for own, score in zip(classes, scores, strict=True)]
        return {
            "format": LAW_FORMAT,
            "model": LAW,
            "accepted": best.score.beats(below),
            "groups": list(best.law.groups),
            "constants": constants,
            "units": {name: unit_of(name) for name in constants},
            "parameters": best.others,
            "deviation": {n: deviation[old] for n, old in best.names.items() if old in deviation},
            "at_bounds": [name for name, old in best.names.items() if old in best.found.at_bounds],
            "loss": best.found.loss,
            "validation": self.trials.validation(best.score, below),
            "classes": tried,
            "stretches": self._stretches(best),
            "data": {"name": self.settings.name, "trials": list(self._names(whole=True))},
            "versions": package_versions(),
        }

    def given(self, file: str) -> dict[str, Any]:
        """Identifies the parameters beside a law of another run; returns the content of law.json."""
        content = read_law(file)
        content["constants"] |= self.trials.mass  # density and damping by mass are those of this body
        simulator = self.trials.simulator(content["constants"], content["model"])
        others, found = dict[str, float](), None
        if bounds := self.trials.bounds_of_others(simulator):
            found = self._search("given", simulator, bounds, {})
            others = found.parameters
        values = {name: simulator.tensor([value]) for name, value in others.items()}
        score = self.trials.errors(simulator, values, 1)[0]
        return {
            **content,
            "accepted": True,
            "accepted_there": content.get("accepted_there", content.get("accepted", True)),
            "file": file,
            "parameters": others,
            "deviation": content.get("deviation", {}) | ({} if found is None else found.deviation),
            "at_bounds": [*content.get("at_bounds", ()), *(() if found is None else found.at_bounds)],
            "validation": self.trials.validation(score, self.trials.score_below()),
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

    def _stretches(self, best: "_Refined") -> list[float]:
        """Returns the least and the largest principal stretch in the training trials."""
        simulator = self.trials.simulator(best.law.constants)
        values = {name: simulator.tensor([value]) for name, value in best.others.items()}
        return stretches_of(self.experiment, self.trials.replays(simulator, self._names(whole=True)), values)

    def _from_states(self, library: Library) -> list[LawClass]:
        """Returns the classes of the weak form."""
        zero = dict.fromkeys((*library.terms, "c10", "bulk_1", *VISCOSITIES), 0.0)
        zero |= branches_of([0.0], [0.1]) | _family(0.0)
        simulator, guess = self.trials.simulator(zero), self.trials.guess
        stiff = {"c10": guess["c10"], "bulk_1": min(guess["bulk_1"], 100.0 * guess["c10"])}
        forms = []
        for names in (self.settings.split.train, self.settings.split.validation):
            motions = [self._motion(simulator, own) for own in self.experiment.batches(names)] if names else []
            forms.append(WeakForm(simulator, motions, zero, stiff, _STRIDE) if motions else None)
        assert forms[0] is not None
        return fit_classes(forms[0], forms[1], library)

    def _motion(self, simulator: Simulator, names: Sequence[str]) -> KnownMotion:
        trials = self.experiment.trials(names, simulator)
        start = self.experiment.start(Replay(simulator, self.experiment.observe, trials))
        _, inputs, _ = Replay(simulator, self.experiment.observe, trials).prepare(self.trials.others(simulator))
        return KnownMotion(trials.observed.transpose(0, 1), start.state.v, inputs)

    def _from_markers(self, library: Library) -> list["_Refined"]:
        """Returns the classes that were tried through the simulator, the best last.

        The search begins with all groups of terms, and takes away those without which validation trials are as close:
        a class that lacks a group makes up for it with others, from where the group no longer helps.
        """
        guess = dict(self.trials.guess)
        own = {name: value for name, value in guess.items() if name.startswith("prony")}
        known = [value for name, value in own.items() if name.startswith("prony_time")]
        shortest, longest = self.settings.law.relaxation_times
        middles = [shortest ** (1.0 - x) * longest**x for x in (0.25, 0.75)][: len(library.times)]
        times = [time for time in middles if all(not time / 4.0 < one < 4.0 * time for one in known)]
        groups = {
            "elastic": dict.fromkeys(library.terms, 0.0),
            "branches": branches_of([0.1 * self.trials.shear] * len(times), times, len(known) + 1),
            "fibres": _family(0.3 * self.trials.shear, self._longest_side()) if library.families else {},
        }
        groups = {name: added for name, added in groups.items() if added}
        guess["bulk_1"] = max(guess["bulk_1"], _RUBBERY * self.trials.shear)
        whole = {name: value for added in groups.values() for name, value in added.items()}
        best = self._refine(LawClass(tuple(groups), guess | whole, math.nan))
        tried = [best]
        for name in groups:
            left = {n: x for n, x in best.law.constants.items() if not n.startswith(_MEMBERS.get(name, library.terms))}
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
        simulator = self.trials.simulator(guess)
        others = self.trials.bounds_of_others(simulator)
        bounds = {name: self.trials.bounds(name, value) for name, value in guess.items() if is_refined(name)} | others
        key = " ".join([*law.groups, *(["whole"] if whole else [])])
        found = self._search(key, simulator, bounds, guess)
        for again in again_of(key) if self.released else ():  # The release was estimated with another law.
            guess |= {name: value for name, value in found.parameters.items() if name in guess}
            before = found.loss
            found = self._search(again, self.trials.simulator(guess), bounds, guess, found.parameters)
            if not changes(before, found.loss):
                break
        refined = {name: found.parameters.get(name, value) for name, value in guess.items()}
        names = strong_names(refined, self.trials.shear)
        kept, after = ({n: refined[old] for n, old in names.items()}, {n: found.parameters[n] for n in others})
        score = self.trials.scores([kept], after)[0]
        return _Refined(replace(law, constants=kept), after, {**names, **{n: n for n in others}}, found, score)

    def _search(
        self,
        key: str,
        simulator: Simulator,
        bounds: Mapping[str, Bounds],
        guess: Mapping[str, float],
        others: Mapping[str, float] | None = None,
    ) -> _Found:
        """Returns the parameters that are closest to the training trials, from a guess and SysID's values.

        Args:
            key: of the checkpoint.
            simulator: with a law.
            bounds: of the parameters.
            guess: of the constants of the law that are among them.
            others: guess of the other ones, in place of SysID's values.
        """
        wanted, finished = self.settings.law, self.kept.content.get("searches", {})
        if key in finished:
            return _Found(**finished[key])
        whole, given = "whole" in key, key == "given"
        limits = (
            self.trials.seconds,
            None if whole else wanted.seconds,
            None if whole or given else self.trials.early,
        )
        seconds = min((limit for limit in limits if limit is not None), default=None)
        shares = independent(self.experiment.dataset.labels)
        replays = self.trials.replays(simulator, self._names(whole or given))
        identifier = Identifier(replays, bounds, seconds, shares=shares)
        with Progress(self.context.name, wanted.max_evaluations, "evaluations at most") as progress:

            def report(_: int, loss: float, values: Mapping[str, float]) -> None:
                name, value = next(iter(values.items()))
                progress.advance(1, loss=f"{loss:.3g}", **{name: f"{value:.4g}"})

            start = {name: {**self.trials.sysid, **(others or {}), **guess}[name] for name in bounds}
            best = identifier.run([start], wanted.max_evaluations, report, wanted.tolerance)
        deviation = {} if best.uncertainty is None else best.uncertainty.deviation
        found = _Found(best.parameters, best.loss, best.at_bounds, deviation)
        self.kept.keep(searches={**finished, key: asdict(found)})
        return found


def _refined_groups(law: LawClass) -> set[str]:
    """Groups of terms of a law when it is refined, which adds viscosities."""
    return {*law.groups, "viscosity"}


def _family(tension: float, direction: tuple[float, float] = (0.0, 0.0)) -> dict[str, float]:
    """Constants of fibres with a tension [Pa], along an azimuth and an elevation [rad]."""
    zero = {f"fibre_{name}_1": 0.0 for name in ("slack", "stiffening", "compression")}
    angles = dict(zip(("fibre_azimuth_1", "fibre_elevation_1"), direction, strict=True))
    return {"fibre_tension_1": tension, "fibre_toe_1": 0.02, **angles, **zero}
