"""Stage: identifies the law of the material from the training trials, and accepts it if it helps on validation trials.

Where the trials give the states of all vertices, the weak form fits every class of laws (`learning.law`), and the
smallest one that is close to the best on the validation trials is refined through the simulator, and larger ones that
balance the forces clearly better, too. With markers alone,
groups of terms are added one after the other, each time refined through the simulator, and stay in if the validation
trials are closer. The other identified parameters are refined with the law.

A law of another run stays as it is; the parameters of actuators and of the medium are identified with it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from ..data.observation import WHOLE_STATE
from ..dynamics.simulator import Simulator
from ..fem.stretches import principal_stretches
from ..io.files import write_json
from ..io.progress import Progress
from ..io.resumable import forget_checkpoint
from ..io.stages import StageContext, package_versions
from ..learning.bounds import Bounds, Prior
from ..learning.identification import Identification, Identifier
from ..learning.law import VISCOSITIES, LawClass, Library, fit_classes
from ..learning.replay import Replay, Start
from ..learning.weak_form import KnownMotion, WeakForm
from ..settings.body import MaterialSettings
from ..settings.stages import IdentifyLawStage
from .build import build_simulator
from .experiment import LAW, Experiment
from .files import LAW_FILE, LAW_FORMAT, read_law
from .identify import Checkpoint, bounds_of
from .trials import evenly

_UNITS: Final = {"viscosity": "Pa s", "time": "s", "azimuth": "rad", "elevation": "rad", "slack": "", "toe": ""}
_CLOSE: Final = 1.25  # ratio of the validation error to the best one that a smaller class may have
_BALANCED: Final = 0.7  # ratio of the force residuals below which a larger class is refined as well
_CLOSER: Final = 0.95  # ratio of validation errors below which a law, or more terms, are worth while
_GROUPED: Final = ("prony", "fibre")
_OF_MASS: Final = ("density", "mass_damping")
_LEAST: Final = 1e-3  # fraction of the shear modulus below which a refined coefficient is zero

Replays = Sequence[tuple[Replay, Start]]


def identify_law(context: StageContext) -> None:
    """Writes law.json: the law, its posterior, the classes that were tried, and whether it is used.

    A run that is interrupted keeps the classes of the weak form and the finished searches.

    Raises:
        DataFileError: the file of the law is missing, damaged or of another version.
    """
    settings: IdentifyLawStage = context.settings
    search = _LawSearch(context, Experiment(settings, context.run_dir, "count"))
    content = search.run() if settings.law.file is None else search.given(settings.law.file)
    write_json(context.run_dir / LAW_FILE, content)
    forget_checkpoint(search.kept.path)


@dataclass(frozen=True)
class _Refined:
    """A law that is refined through the simulator."""

    law: LawClass
    others: dict[str, float]  # identified parameters that are not those of the material
    names: dict[str, str]  # of all identified parameters in `found`, by their names in the law
    found: Identification
    score: float  # error on the validation trials


class _LawSearch:
    """Search for a law in an experiment."""

    def __init__(self, context: StageContext, experiment: Experiment) -> None:
        self.context, self.experiment = context, experiment
        self.kept = Checkpoint(context, "law")
        self.settings: IdentifyLawStage = context.settings
        split = self.settings.split
        self.checked = split.validation or split.train
        self.released = any(experiment.begins(name) == "released" for name in self.settings.split.train)
        self.states = experiment.dataset.bound is None and experiment.dataset.velocity is not None
        self.sysid = {name: float(value) for name, value in experiment.parameters("sysid").items()}
        self.guess = self._guess()
        self.shear = 2.0 * self.guess["c10"]

        wanted = self.settings.law
        self.names = split.train if wanted.trials is None else tuple(evenly(split.train, wanted.trials))

    def run(self) -> dict[str, Any]:
        """Identifies a law; returns the content of law.json."""
        wanted = self.settings.law
        shortest, longest = wanted.relaxation_times
        library = Library(
            terms=tuple(wanted.terms),
            viscous=wanted.viscous,
            times=tuple(np.geomspace(shortest, longest, wanted.branches).tolist()),
            families=wanted.families,
        )
        if self.states:
            if "classes" not in self.kept.content:
                self.kept.keep(classes=[asdict(own) for own in self._from_states(library)])
            classes = [LawClass(**{**own, "groups": tuple(own["groups"])}) for own in self.kept.content["classes"]]
            scores = self._scores([law.constants for law in classes], self.checked)
            smallest = next(k for k, score in enumerate(scores) if score <= _CLOSE * min(scores))
            best = self._enlarged(self._refine(classes[smallest]), classes)
        else:
            refined = self._from_markers(library)
            classes, scores = [own.law for own in refined], [own.score for own in refined]
            best = refined[-1]
        below, deviation = self._score_below(), _deviation(best.found)
        tried = [{**asdict(own), "validation": score} for own, score in zip(classes, scores, strict=True)]
        return {
            "format": LAW_FORMAT,
            "accepted": best.score < _CLOSER * below,
            "groups": list(best.law.groups),
            "constants": best.law.constants,
            "units": {name: _unit(name) for name in best.law.constants},
            "parameters": best.others,
            "deviation": {n: deviation[old] for n, old in best.names.items() if old in deviation},
            "at_bounds": [name for name, old in best.names.items() if old in best.found.at_bounds],
            "loss": best.found.loss,
            "validation": {"trials": list(self.checked), "law": best.score, "below": below},
            "classes": tried,
            "stretches": self._stretches(best),
            "data": {"name": self.settings.name, "trials": list(self.names)},
            "versions": package_versions(),
        }

    def given(self, file: str) -> dict[str, Any]:
        """Identifies the parameters beside a law of another run; returns the content of law.json."""
        content = read_law(Path(file).expanduser())
        constants: dict[str, float] = content["constants"]
        simulator, others, found = self._simulator(constants), dict[str, float](), None
        if bounds := self._bounds_of_others(simulator):
            found = self._search("given", simulator, bounds, {})
            others = found.parameters
        score = self._scores([constants], self.checked, others)[0]
        return {
            **content,
            "accepted": True,
            "file": file,
            "parameters": others,
            "deviation": content.get("deviation", {}) | _deviation(found),
            "at_bounds": [*content.get("at_bounds", ()), *(() if found is None else found.at_bounds)],
            "validation": {"trials": list(self.checked), "law": score, "below": self._score_below()},
        }

    def _enlarged(self, best: "_Refined", classes: Sequence[LawClass]) -> "_Refined":
        """Returns the best refined law of larger classes that balance the forces clearly better."""
        residual = min(own.residual for own in classes if _refined_groups(own) == _refined_groups(best.law))
        for law in classes:
            if _refined_groups(law) > _refined_groups(best.law) and law.residual < _BALANCED * residual:
                larger = self._refine(law)
                if larger.score * _CLOSE < best.score:
                    best, residual = larger, law.residual
        return best

    def _stretches(self, best: "_Refined") -> list[float]:
        """Returns the least and the largest principal stretch in the training trials."""
        dataset, mesh = self.experiment.dataset, self.experiment.body.mesh
        if self.states:
            positions = dataset.observed[dataset.rows(self.names)].reshape(-1, *mesh.vertices.shape)
            stretches = principal_stretches(mesh, positions)
        else:
            simulator = self._simulator(best.law.constants)
            values = {name: simulator.tensor([value]) for name, value in best.others.items()}
            with torch.no_grad():
                bodies = [
                    Replay(simulator, WHOLE_STATE, replay.trials)(replace(start, shift=None), values).flatten(0, 2)
                    for replay, start in self._replays(simulator, self.names)
                ]
            stretches = np.concatenate([principal_stretches(mesh, q.cpu().numpy()) for q in bodies])
        return [float(np.nanmin(stretches)), float(np.nanmax(stretches))]

    def _guess(self) -> dict[str, float]:
        """Returns a neo-Hookean law with the moduli, the viscosity and the creep of the identified material."""
        material = self.experiment.simulator("simulation").materials[""]
        known = {name: float(torch.as_tensor(value)) for name, value in material.constants.items()}
        known |= {name: value for name, value in self.sysid.items() if name in known}
        tensors = {name: torch.tensor([[value]], dtype=torch.float64) for name, value in known.items()}
        lame = np.asarray(material.law.LAME).T @ [float(m) for m in material.moduli(tensors)]
        mu, volume = float(lame[0]), float(lame[1])
        time = known.get("stiffness_damping", 0.0)
        guess = {
            "c10": 0.5 * mu,
            "bulk_1": 0.5 * volume,
            **dict(zip(VISCOSITIES, (time * mu, time * volume), strict=True)),
        }
        ratios = [(known.get(f"prony_ratio_{k}", 0.0), known.get(f"prony_time_{k}", 0.0)) for k in (1, 2)]
        relaxing = [(ratio * mu, time) for ratio, time in ratios if ratio > _LEAST]
        guess |= _branches([modulus for modulus, _ in relaxing], [time for _, time in relaxing])
        return {**guess, "density": known["density"], "mass_damping": known["mass_damping"]}

    def _simulator(self, constants: Mapping[str, float]) -> Simulator:
        """Returns the simulator of the identified model with a law; failed steps are counted."""
        settings = self.experiment.settings_of("identified")
        common = {name: self.guess[name] for name in _OF_MASS}
        material = MaterialSettings.model_validate({"model": LAW, **common, **constants})
        return build_simulator(settings, material, self.experiment.body, on_failure="count")

    def _from_states(self, library: Library) -> list[LawClass]:
        """Returns the classes of the weak form."""
        wanted = self.settings.law
        zero = dict.fromkeys((*library.terms, "c10", "bulk_1", *VISCOSITIES), 0.0)
        zero |= _branches([0.0], [0.1]) | _family(0.0)
        simulator, guess = self._simulator(zero), self.guess
        stiff = {"c10": guess["c10"], "bulk_1": min(guess["bulk_1"], 100.0 * guess["c10"])}
        forms = []
        for names in (self.settings.split.train, self.settings.split.validation):
            motions = [self._motion(simulator, own) for own in self.experiment.batches(names)] if names else []
            forms.append(WeakForm(simulator, motions, zero, stiff, wanted.stride) if motions else None)
        assert forms[0] is not None
        return fit_classes(forms[0], forms[1], library)

    def _motion(self, simulator: Simulator, names: Sequence[str]) -> KnownMotion:
        trials = self.experiment.trials(names, simulator)
        start = self.experiment.start(Replay(simulator, self.experiment.observe, trials))
        _, inputs, _ = Replay(simulator, self.experiment.observe, trials).prepare(self._others(simulator))
        return KnownMotion(trials.observed.transpose(0, 1), start.state.v, inputs)

    def _others(self, simulator: Simulator) -> dict[str, torch.Tensor]:
        """Returns (1,) identified parameters that are not those of the material."""
        own = self.experiment.simulator("simulation").materials[""].quantities
        return {name: simulator.tensor([value]) for name, value in self.sysid.items() if name not in own}

    def _from_markers(self, library: Library) -> list["_Refined"]:
        """Returns the classes that were tried through the simulator, the best last; groups that help stay in."""
        groups = {
            "elastic": dict.fromkeys(library.terms, 0.0),
            "branches": _branches([0.1 * self.shear] * 2, library.times[:: max(len(library.times) - 1, 1)]),
            "fibres": _family(0.1 * self.shear) if library.families else {},
        }
        guess = {name: value for name, value in self.guess.items() if name not in _OF_MASS}
        if any(name.startswith("prony") for name in guess):
            del groups["branches"]
        best = self._refine(LawClass((), guess, math.nan))
        tried = [best]
        for name, added in groups.items():
            if added:
                law = LawClass((*best.law.groups, name), {**best.law.constants, **added}, math.nan)
                tried.append(self._refine(law))
                if tried[-1].score < _CLOSER * best.score:
                    best = tried[-1]
        return [own for own in tried if own is not best] + [best]

    def _replays(self, simulator: Simulator, names: Sequence[str]) -> Replays:
        return self.experiment.replays(simulator, names, "sysid" if self.sysid else "simulation")

    def _scores(
        self, laws: Sequence[Mapping[str, float]], names: Sequence[str], others: Mapping[str, float] | None = None
    ) -> list[float]:
        """Returns the root mean square error of laws on trials, over the motion's amplitude; infinite if one fails."""
        union: dict[str, float] = {}
        for law in laws:
            union |= {name: value if _is_shape(name) else 0.0 for name, value in law.items()}
        simulator = self._simulator({**union, **laws[0]})
        values = {name: simulator.tensor([law.get(name, union[name]) for law in laws]) for name in union}
        own = self._others(simulator) | {n: simulator.tensor([v]) for n, v in (others or {}).items()}
        values |= {name: value.expand(len(laws)) for name, value in own.items()}
        return self._errors(simulator, values, names, len(laws))

    def _errors(
        self, simulator: Simulator, values: Mapping[str, torch.Tensor], names: Sequence[str], sets: int
    ) -> list[float]:
        total = simulator.tensor(np.zeros(sets))
        with torch.no_grad():
            for replay, start in self._replays(simulator, names):
                errors = replay.errors(replay(start, values)).square().sum((2, 3, 4))
                total += (errors * replay.trials.loss_weight).sum(1) / len(names)
        return [math.sqrt(value) if math.isfinite(value) else math.inf for value in total.tolist()]

    def _score_below(self) -> float:
        """Returns the error of the identified simulator, or of the uncorrected one."""
        simulator = self.experiment.model_simulator("sysid" if self.sysid else "simulation")
        return self._errors(simulator, self.experiment.parameters("sysid"), self.checked, 1)[0]

    def _refine(self, law: LawClass) -> "_Refined":
        """Returns a law that is refined through the simulator, with the other identified parameters."""
        guess = dict(law.constants)
        if self.settings.law.viscous:
            guess |= {name: guess.get(name, 0.0) for name in VISCOSITIES}
        simulator = self._simulator(guess)
        others = self._bounds_of_others(simulator)
        bounds = {name: self._bounds(name, value) for name, value in guess.items() if _is_refined(name)} | others
        key = " ".join(law.groups)
        found = self._search(key, simulator, bounds, guess)
        if self.released:  # The release was estimated with the first guess.
            guess |= {name: value for name, value in found.parameters.items() if name in guess}
            found = self._search(f"{key} again", self._simulator(guess), bounds, guess, found.parameters)
        refined = {name: found.parameters.get(name, value) for name, value in guess.items()}
        names = _strong(refined, self.shear)
        kept, after = ({n: refined[old] for n, old in names.items()}, {n: found.parameters[n] for n in others})
        score = self._scores([kept], self.checked, after)[0]
        return _Refined(replace(law, constants=kept), after, {**names, **{n: n for n in others}}, found, score)

    def _bounds_of_others(self, simulator: Simulator) -> dict[str, Bounds]:
        """Returns the ranges of the identified parameters that are not those of the material."""
        if self.settings.identify is None:
            return {}
        return {name: bounds_of(self.settings.identify.parameters[name]) for name in self._others(simulator)}

    def _search(
        self,
        key: str,
        simulator: Simulator,
        bounds: Mapping[str, Bounds],
        guess: Mapping[str, float],
        others: Mapping[str, float] | None = None,
    ) -> Identification:
        """Returns the parameters that are closest to the training trials, from a guess and SysID's values.

        Args:
            key: of the checkpoint.
            simulator: with a law.
            bounds: of the parameters.
            guess: of the constants of the law that are among them.
            others: guess of the other ones, in place of SysID's values.
        """
        wanted, finished = self.settings.law, self.kept.content.get("searches", {})
        identifier = Identifier(self._replays(simulator, self.names), bounds, wanted.seconds)
        with Progress(self.context.name, wanted.max_evaluations, "evaluations at most") as progress:

            def report(_: int, loss: float, values: Mapping[str, float]) -> None:
                name, value = next(iter(values.items()))
                progress.advance(1, loss=f"{loss:.3g}", **{name: f"{value:.4g}"})

            def keep(attempts: list[Any]) -> None:
                self.kept.keep(searches={**finished, key: attempts})

            start = {name: {**self.sysid, **(others or {}), **guess}[name] for name in bounds}
            done = finished.get(key, ())
            return identifier.run([start], wanted.max_evaluations, report, done, keep, wanted.tolerance)

    def _prior_of_modulus(self) -> Prior | None:
        """Returns the prior of c10 that corresponds to one of Young's modulus, if there is one."""
        wanted = None if self.settings.identify is None else self.settings.identify.parameters.get("youngs_modulus")
        if wanted is None or wanted.prior is None:
            return None
        share = self.guess["c10"] / self.sysid["youngs_modulus"]
        return Prior(share * wanted.prior.mean, share * wanted.prior.deviation)

    def _bounds(self, name: str, value: float) -> Bounds:
        if name == "bulk_1":
            mean = max(value, self.shear)
            return Bounds(0.1 * mean, 10.0 * mean, True, Prior(mean, mean))
        if name == "c10":
            return Bounds(0.0, max(4.0 * value, self.shear), prior=self._prior_of_modulus())
        if name.startswith("prony_time"):
            return Bounds(value / 4.0, 4.0 * value, True)
        if name.startswith(("fibre_azimuth", "fibre_elevation")):
            return Bounds(value - 0.5, value + 0.5)
        if name.startswith("fibre_slack"):
            return Bounds(0.0, 0.1)
        if name.startswith("fibre_toe"):
            return Bounds(0.002, 0.1, True)
        if name in VISCOSITIES:
            return Bounds(0.0, max(4.0 * value, (0.01 if name == "shear_viscosity" else 1.0) * self.shear))
        return Bounds(0.0, max(4.0 * value, self.shear))


def _refined_groups(law: LawClass) -> set[str]:
    """Groups of terms of a law when it is refined, which adds viscosities."""
    return {*law.groups, "viscosity"}


def _deviation(found: Identification | None) -> dict[str, float]:
    """Standard deviations of identified parameters; none where they are not known."""
    return {} if found is None or found.uncertainty is None else found.uncertainty.deviation


def _is_shape(name: str) -> bool:
    """Whether a constant has no coefficient's meaning: a time, a direction, a slack or a toe."""
    return _unit(name) != "Pa" and name not in VISCOSITIES


def _is_refined(name: str) -> bool:
    return not name.startswith(("fibre_stiffening", "fibre_compression"))


def _strong(constants: Mapping[str, float], shear: float) -> dict[str, str]:
    """Names of constants by their names without terms, branches and families that hardly resist, which are left out.

    Args:
        constants: of a law.
        shear: shear modulus of the material [Pa].
    """
    weak = {name for name, value in constants.items() if _unit(name) == "Pa" and value < _LEAST * shear}
    weak |= {name for name in VISCOSITIES if constants.get(name, 1.0) < 1e-6 * shear}
    kept = {name: name for name in constants if name == "c10" or not (name in weak or name.startswith(_GROUPED))}
    for leading in ("prony_modulus_", "fibre_tension_"):
        group = leading.split("_")[0]
        strong = [name.removeprefix(leading) for name in constants if name.startswith(leading) and name not in weak]
        for number, old in enumerate(strong, 1):
            members = [name for name in constants if name.startswith(group) and name.endswith(f"_{old}")]
            kept |= {f"{name.removesuffix(old)}{number}": name for name in members}
    return kept


def _unit(name: str) -> str:
    words = {*name.split("_")}
    return next((unit for word, unit in _UNITS.items() if word in words), "Pa")


def _branches(moduli: Sequence[float], times: Sequence[float]) -> dict[str, float]:
    pairs = enumerate(zip(moduli, times, strict=False), 1)
    return {key: x for k, (m, t) in pairs for key, x in ((f"prony_modulus_{k}", m), (f"prony_time_{k}", t))}


def _family(tension: float) -> dict[str, float]:
    zero = ("azimuth", "elevation", "slack", "stiffening", "compression")
    return {"fibre_tension_1": tension, "fibre_toe_1": 0.02, **{f"fibre_{name}_1": 0.0 for name in zero}}
