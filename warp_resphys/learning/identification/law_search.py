"""Identification of the law of a material, which is accepted if it helps on validation trials.

Where the trials give the positions of all vertices, the weak form fits every class of laws (`law`),
and the smallest one that is close to the best on the validation trials is refined through the
simulator, and larger ones that balance the forces clearly better, too. With markers alone, the
search begins with all groups of terms and takes one after the other away, each time refined through
the simulator, if the validation trials are as close without it. The other identified parameters are
refined with the law.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from pydantic import TypeAdapter

from ...core.dynamics.simulator import Simulator
from ...core.energies.catalogue import LawContent, LawTest, TriedClass, make_material
from ...core.energies.convex_material import ConvexMaterial
from ...core.energies.materials import MASS_DAMPING
from ...data.rigid_bodies import independent
from ...data.trials import RELEASED, evenly
from ...io.errors import InputError, checks_types, naming
from ...io.parts import Checkpoint
from ...settings.learning import Bounds, LawSettings, Prior
from ..observed_motions import Identified, ObservedMotions
from ..parameters import Limits, by_part, check_names, identifiable_parameters, ranges_of
from ..scores import Score
from .law import (
    VISCOSITIES,
    IdentifiedLaw,
    LawClass,
    bounds_of_parameter,
    branches_of,
    family,
    first_guess,
    fit_classes,
    is_shape,
    strong_names,
)
from .law_scores import RefinedLaw, scores_of, stretches_in, tried_without_states
from .misfit import Misfit
from .search import Identification, Searches, first_points, refined_searches
from .weak_form import KnownMotion, WeakForm

_OF_MASS: Final = ("density", MASS_DAMPING)
_FURTHER: Final = (
    0.2  # standard deviation of the priors of further terms from markers, over the shear modulus
)
_HELD_OUT: Final = 4  # every fourth training trial
_EARLY: Final = (
    0.6  # of the training trials that a law is tested on as well: share from which it is identified
)
_CLOSE: Final = 1.25  # ratio of the validation error to the best one that a smaller class may have
_STRIDE: Final = 10  # steps from one balance of forces to the next, where all vertices are observed
_FIXED: Final = ("fibre_stiffening", "fibre_compression")  # parameters that are not refined
_BESIDE: Final = "beside"  # key of the search of parameters beside a known law
_BALANCED: Final = 0.7  # ratio of the force residuals below which a larger class is refined as well


@checks_types
def identify_law(
    simulator: Simulator,
    motions: ObservedMotions,
    parameters: Mapping[str, Limits] | None = None,
    *,
    identified: Identified | None = None,
    train: Sequence[str] | None = None,
    validation: Sequence[str] = (),
    settings: LawSettings | None = None,
    seconds: float | None = None,
    known: LawContent | None = None,
    kept: str | Path | None = None,
) -> IdentifiedLaw:
    """Identifies the law of a material from observed motions, and tests it on others.

    Without validation trials, every fourth training trial takes their place until a law is chosen;
    of three motions or fewer, the last part, of which `identify` has seen all.

    Args:
        simulator: of the body, with a material of a simpler class; the law begins with its
            parameters.
        motions: observed states or markers.
        parameters: ranges that `identify` had; parameters that are not of the material are refined
            with the law.
        identified: result of `identify`; the simulator's own values if None.
        train: names of the training trials; all by default.
        validation: names of the validation trials.
        settings: terms, relaxation times and evaluations; the defaults of the class if None.
        seconds: duration of the trials that may be learned from [s]; None for the part that
            `motions` learns from.
        known: law beside which the parameters are identified; None to identify a law.
        kept: see `identify`.

    Raises:
        InputError: materials of regions, a range of an unknown parameter, or a law of another
            version.
        ConvergenceError: the simulation fails at every start.
    """
    if "" not in simulator.materials:
        raise InputError(
            "a law describes one material, but the simulator has some by region: give a single one."
        )
    if known is not None and not {"model", "parameters"} <= {*known}:
        raise InputError(
            f"known has {', '.join(known)}: a law of this version has model and parameters."
        )
    motions.need_points("a law")
    wanted = ranges_of(parameters or {})
    with naming("parameters: "):
        check_names(wanted, identifiable_parameters(simulator))
    ranges = by_part(simulator, wanted, wanted)
    names = motions.trials.chosen(train)
    if motions.train_fraction < 1.0:
        learned = motions.train_fraction * float(motions.trials.times.max())
        seconds = min(learned, seconds or math.inf)
    given = (simulator, motions, ranges, identified or Identified(), names, tuple(validation))
    options = (settings or LawSettings(), seconds)
    search = _LawSearch(*given, *options, Checkpoint(kept, *given, *options, known))
    return search.run() if known is None else search.beside(known)


@dataclass(frozen=True)
class _LawSearch:
    """Search for a law; for the attributes see `identify_law`."""

    base: Simulator
    motions: ObservedMotions
    ranges: Mapping[str, Bounds]
    identified: Identified
    train: tuple[str, ...]
    validation: tuple[str, ...]
    settings: LawSettings
    seconds: float | None
    kept: Checkpoint

    @cached_property
    def checked(self) -> tuple[str, ...]:
        """Names of the trials that laws are tested on."""
        held_out = (
            self.train[_HELD_OUT // 2 :: _HELD_OUT] if len(self.train) >= _HELD_OUT else self.train
        )
        return self.validation or held_out

    def names(self, whole: bool) -> tuple[str, ...]:
        """Names of the trials of a search: all of the training,
        or those that a law is identified from at first.
        """
        split = whole or self.validation or self.checked == self.train
        names = (
            self.train if split else tuple(name for name in self.train if name not in self.checked)
        )
        return names if self.settings.trials is None else tuple(evenly(names, self.settings.trials))

    @property
    def early(self) -> float | None:
        """Duration from which a law is identified before it is tested on the same trials [s].

        None with others.
        """
        longest = self.seconds or float(self.motions.trials.times.max())
        return _EARLY * longest if self.checked == self.train and longest > 0.0 else None

    @cached_property
    def known(self) -> dict[str, float]:
        """Parameters of the material as it was identified."""
        known = {
            name: float(torch.as_tensor(x)) for name, x in self.base.materials[""].values.items()
        }
        return known | {name: x for name, x in self.identified.parameters.items() if name in known}

    @property
    def mass(self) -> dict[str, float]:
        """Density and damping by mass."""
        return {name: self.known[name] for name in _OF_MASS}

    @cached_property
    def guess(self) -> dict[str, float]:
        """A neo-Hookean law like the identified material."""
        return first_guess(self.base.materials[""], self.known)

    @property
    def shear(self) -> float:
        """Shear modulus of the identified material [Pa]."""
        return 2.0 * self.guess["c10"]

    def simulator(
        self, parameters: Mapping[str, float], model: str = ConvexMaterial.model
    ) -> Simulator:
        """Returns the simulator with the parameters of a law; failed steps are counted."""
        material = make_material(model, **{**self.mass, **parameters})
        return replace(
            self.base, material=material, solver=self.base.settings.changed(on_failure="count")
        )

    @cached_property
    def others(self) -> dict[str, float]:
        """Identified parameters beside the law: density and damping by mass,
        and those of other parts.
        """
        material = {*self.base.materials[""].parameters} - {*_OF_MASS}
        return {
            name: float(value)
            for name, value in self.identified.parameters.items()
            if name not in material
        }

    def run(self) -> IdentifiedLaw:
        """Identifies a law."""
        if self.motions.sees_states:
            fitted = self.kept.once("classes", lambda: [asdict(law) for law in self._from_states()])
            classes = TypeAdapter(list[LawClass]).validate_python(fitted)
            laws = [law.parameters for law in classes]
            scores = [score.error for score in self.scores(laws)]
            smallest = next(k for k, score in enumerate(scores) if score <= _CLOSE * min(scores))
            best = self._enlarged(self._refine(classes[smallest]), classes)
        else:
            refined = tried_without_states(
                self._refine, self.guess, self.settings, self.base.body.mesh
            )
            classes = [tried.law for tried in refined]
            scores = [tried.score.error for tried in refined]
            best = refined[-1]
        if not self.validation:
            again = self._refine(best.law, whole=True)
            best = best if best.score.beats(again.score) else replace(again, score=best.score)
        parameters = {
            name: best.others.get(name, x) for name, x in self.mass.items()
        } | best.law.parameters
        deviation, trials = best.found.deviation, self.names(whole=True)
        return IdentifiedLaw(
            simulator=self.simulator(parameters),
            groups=best.law.groups,
            parameters=parameters,
            others=best.others,
            deviation={n: deviation[old] for n, old in best.names.items() if old in deviation},
            at_bounds=[name for name, old in best.names.items() if old in best.found.at_bounds],
            loss=best.found.loss,
            classes=[
                TriedClass(
                    groups=[*law.groups],
                    parameters=law.parameters,
                    residual=law.residual,
                    validation=score,
                )
                for law, score in zip(classes, scores, strict=True)
            ],
            stretches=stretches_in(
                self.motions,
                trials,
                self.simulator(best.law.parameters),
                best.others,
                self.identified,
            ),
            trials=trials,
            **self._tested(best.score),
        )

    def beside(self, law: LawContent) -> IdentifiedLaw:
        """Identifies the parameters beside a known law, which is used in any case."""
        parameters = {**law["parameters"], **self.mass}
        simulator = self.simulator(parameters, law["model"])
        bounds, found = self._bounds_of_others, Identification()
        if bounds:
            limits = (self.seconds, self.settings.seconds)
            found = self._search(
                _BESIDE, bounds, lambda before: (simulator, {}), self.names(whole=True), limits
            )
        values = {name: simulator.tensor([value]) for name, value in found.parameters.items()}
        return IdentifiedLaw(
            simulator=simulator,
            parameters=parameters,
            others=found.parameters,
            deviation={**law.get("deviation", {}), **found.deviation},
            at_bounds=[*law.get("at_bounds", ()), *found.at_bounds],
            model=law["model"],
            **self._tested(self._scores(simulator, values)[0]) | {"accepted": True},
        )

    def _tested(self, score: Score) -> dict[str, Any]:
        """Whether a law helps, and its errors and those without it on the trials
        that laws are tested on.
        """
        shared = {
            name: self.base.tensor([value]) for name, value in self.identified.parameters.items()
        }
        counting = replace(self.base, solver=self.base.settings.changed(on_failure="count"))
        below = self._scores(counting, shared)[0]
        split = "validation" if self.validation else "training"
        errors = LawTest(trials=[*self.checked], split=split, law=score.error, below=below.error)
        return {"accepted": score.beats(below), "validation": errors}

    def scores(
        self, laws: Sequence[Mapping[str, float]], others: Mapping[str, float] | None = None
    ) -> list[Score]:
        """Returns the errors of laws on the trials that they are tested on.

        Args:
            laws: parameters by name.
            others: values of the other identified parameters, in place of the identified ones.
        """
        union: dict[str, float] = {}
        for law in laws:
            union |= {name: value if is_shape(name) else 0.0 for name, value in law.items()}
        simulator = self.simulator({**union, **laws[0]})
        values = {
            name: simulator.tensor([law.get(name, union[name]) for law in laws]) for name in union
        }
        for name, value in {**self.others, **(others or {})}.items():
            values[name] = simulator.tensor([value]).expand(len(laws))
        return self._scores(simulator, values)

    def _scores(self, simulator: Simulator, values: Mapping[str, torch.Tensor]) -> list[Score]:
        """Errors of a simulator with some sets of parameters on trials that laws are tested on."""
        replays = self.motions.replays(simulator, self.checked, self.identified)
        return scores_of(replays, values, self.early or 0.0, self.seconds)

    def _from_states(self) -> list[LawClass]:
        """Returns the classes of the weak form."""
        wanted, forms = self.settings, []
        times = np.geomspace(*wanted.relaxation_times, wanted.branches).tolist()
        zero = dict.fromkeys((*wanted.terms, "c10", "bulk_1", *VISCOSITIES), 0.0)
        zero |= branches_of([0.0], [0.1]) if wanted.branches else {}
        zero |= family(0.0) if wanted.families else {}
        simulator, guess = self.simulator(zero), self.guess
        stiff = {"c10": guess["c10"], "bulk_1": min(guess["bulk_1"], 100.0 * guess["c10"])}
        for names in (self.train, self.validation):
            motions = [
                self._motion(simulator, batch) for batch in self.motions.trials.batches(names)
            ]
            forms.append(WeakForm(simulator, motions, zero, stiff, _STRIDE) if motions else None)
        assert forms[0] is not None
        return fit_classes(forms[0], forms[1], wanted.terms, times, wanted.families)

    def _motion(self, simulator: Simulator, names: Sequence[str]) -> KnownMotion:
        replay = self.motions.replay(simulator, names)
        _, inputs, _ = replay.prepare(
            {name: simulator.tensor([value]) for name, value in self.others.items()}
        )
        start = self.motions.start(replay)
        return KnownMotion(replay.trials.observed.transpose(0, 1), start.state.v, inputs)

    def _enlarged(self, best: RefinedLaw, classes: Sequence[LawClass]) -> RefinedLaw:
        """Returns the best refined law of larger classes that balance the forces clearly better."""
        residual = min(law.residual for law in classes if {*law.groups} == {*best.law.groups})
        for law in classes:
            if {*law.groups} > {*best.law.groups} and law.residual < _BALANCED * residual:
                larger = self._refine(law)
                if larger.score.error * _CLOSE < best.score.error:
                    best, residual = larger, law.residual
        return best

    def _refine(self, law: LawClass, whole: bool = False) -> RefinedLaw:
        """A law that is refined through the simulator, with the other identified parameters.

        Where markers are seen, every class has viscosities; with whole states, only one with that
        group.

        Args:
            law: first guess.
            whole: whether to use the whole of training trials on which laws are tested as well.
        """
        guess = dict(law.parameters)
        if not self.motions.sees_states or "viscosity" in law.groups:
            guess |= {name: guess.get(name, 0.0) for name in VISCOSITIES}
        others = self._bounds_of_others
        searched = [name for name in guess if not name.startswith(_FIXED)]
        bounds = {name: self._bounds(name, guess[name]) for name in searched} | others

        def begin(before: Identification | None) -> tuple[Simulator, dict[str, float]]:
            first = {} if before is None else dict(before.parameters)
            parameters = guess | {name: value for name, value in first.items() if name in guess}
            return self.simulator(parameters), first | parameters

        key = " ".join([*law.groups, *(["whole"] if whole else [])])
        limits = (self.seconds,) if whole else (self.seconds, self.settings.seconds, self.early)
        found = self._search(key, bounds, begin, self.names(whole), limits)
        refined = {name: found.parameters.get(name, value) for name, value in guess.items()}
        names = strong_names(refined, self.shear)
        kept = {n: refined[old] for n, old in names.items()}
        beside = {n: found.parameters[n] for n in others}
        score = self.scores([kept], beside)[0]
        return RefinedLaw(
            replace(law, parameters=kept), beside, {**names, **{n: n for n in others}}, found, score
        )

    def _search(
        self,
        key: str,
        bounds: Mapping[str, Bounds],
        begin: Callable[[Identification | None], tuple[Simulator, dict[str, float]]],
        names: Sequence[str],
        limits: Sequence[float | None],
    ) -> Identification:
        """Returns the parameters that are closest to trials.

        Args:
            key: of the search.
            bounds: of the parameters.
            begin: simulator and first guesses of a search, where they differ from the identified
                values, by the result of the search before.
            names: of the trials.
            limits: durations of these that are used [s]; the smallest counts.
        """
        seconds = min((limit for limit in limits if limit is not None), default=None)
        wanted, shares = self.settings, independent(self.motions.trials.labels)

        def prepared(before: Identification | None) -> tuple[Misfit, list[dict[str, float]]]:
            simulator, guess = begin(before)
            replays = self.motions.replays(simulator, names, self.identified)
            misfit = Misfit(replays, bounds, seconds, shares=shares)
            known = {**self.identified.parameters, **guess}
            return misfit, first_points(misfit, {name: known[name] for name in bounds})

        released = key != _BESIDE and RELEASED in map(self.motions.trials.begin_of, self.train)
        searches = Searches(
            wanted.max_evaluations, wanted.tolerance, self.kept, "identify_law", key
        )
        return refined_searches(prepared, searches, self.motions.labels, released)[-1]

    @cached_property
    def _bounds_of_others(self) -> dict[str, Bounds]:
        """Ranges of the identified parameters that are not those of the material."""
        return {name: self.ranges[name] for name in self.others if name in self.ranges}

    def _bounds(self, name: str, value: float) -> Bounds:
        """Returns the range of a parameter of a law."""
        prior, modulus = None, self.ranges.get("youngs_modulus")
        if modulus is not None and modulus.prior is not None:
            share = self.guess["c10"] / self.known["youngs_modulus"]
            prior = Prior(
                mean=share * modulus.prior.mean, deviation=share * modulus.prior.deviation
            )
        return bounds_of_parameter(
            name, value, self.guess, 1.0 if self.motions.sees_states else _FURTHER, prior
        )
