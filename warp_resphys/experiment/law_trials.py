"""Simulators with laws on the trials of an experiment, and their errors there."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any, Final

import numpy as np
import torch

from ..data.markers import WHOLE_STATE
from ..dynamics.simulator import Simulator
from ..energies.catalogue import unit_of
from ..energies.materials import MASS_DAMPING
from ..fem.integration_points import principal_stretches
from ..io.arrays import FloatArray
from ..learning.law import VISCOSITIES
from ..learning.parameters import Bounds, Prior
from ..learning.replay import Replay, Start
from ..learning.uncertainty import redundancy
from ..settings.body import MaterialSettings
from .build import build_simulator
from .experiment import LAW, Experiment
from .identify import bounds_of

LEAST: Final = 1e-3  # fraction of the shear modulus below which a coefficient is zero
_OF_MASS: Final = ("density", MASS_DAMPING)
_STIFFEST: Final = 500.0  # bulk over shear modulus, as of a Poisson's ratio of 0.4995
_FURTHER: Final = 0.2  # standard deviation of the priors of further terms from markers, over the shear modulus
_TURN: Final = 0.8  # largest correction of a fibre's angle [rad]
_HELD_OUT: Final = 4  # every fourth training trial
_EARLY: Final = 0.6  # of the training trials that a law is tested on as well: share from which it is identified

_CLEARLY, _CLOSER = 0.5, 0.95
_SIGNIFICANT: Final = 2.0  # standard errors

Replays = Sequence[tuple[Replay, Start]]


@dataclass(frozen=True)
class Score:
    """Errors of a simulator on trials: in each frame the mean square over the squared amplitude of the trial."""

    frames: tuple[FloatArray, ...]  # (T,) of each trial

    @property
    def error(self) -> float:
        """Root mean square over the amplitude, over all trials; infinite if one failed."""
        if not self.frames:
            return math.inf
        square = fmean(float(own.mean()) for own in self.frames)
        return math.sqrt(square) if math.isfinite(square) else math.inf

    def beats(self, other: "Score") -> bool:
        """Whether the error is at most half, or its mean square smaller by two standard errors.

        Frames are correlated in time, so that a short trial may show no less than a large gain. Of static poses the
        standard error is that of the trials' mean; one pose has none, and its error must be smaller by 5 %.
        """
        if not math.isfinite(self.error) or self.error <= _CLEARLY * other.error:
            return self.error < other.error
        less = [theirs - own for own, theirs in zip(self.frames, other.frames, strict=True)]
        means = np.array([d.mean() for d in less])
        if max(len(d) for d in less) > 1:
            variance = [float(d.var()) * redundancy((d - d.mean())[:, None]) / len(d) for d in less]
            doubt = math.sqrt(sum(variance)) / len(less)
        elif len(less) > 1:
            doubt = float(means.std(ddof=1)) / math.sqrt(len(less))
        else:
            return self.error < _CLOSER * other.error
        return float(means.mean()) > _SIGNIFICANT * doubt


class LawTrials:
    """The trials of an experiment, simulated with laws.

    A law is tested on validation trials. Without any, every fourth training trial takes their place until a law is
    chosen; of three motions or fewer, the last part, of which SysID has seen all.

    Args:
        experiment: the experiment.

    Attributes:
        checked: names of the trials that laws are tested on.
        learned: names of the training trials that a law is identified from before it is tested.
        states: whether all vertices are observed.
        sysid: parameters of SysID by name; empty if nothing was identified.
        guess: constants of a law with the moduli, the viscosity and the creep of the identified material.
        shear: its shear modulus [Pa].
        seconds: duration of the trials that may be learned from [s]; None for whole trials.
    """

    def __init__(self, experiment: Experiment) -> None:
        settings = experiment.settings
        self.experiment, self.settings, split = experiment, settings, settings.split
        self.checked, self.learned = split.validation or split.train, split.train
        if not split.validation and len(split.train) >= _HELD_OUT:
            self.checked = split.train[_HELD_OUT // 2 :: _HELD_OUT]
            self.learned = tuple(name for name in split.train if name not in self.checked)
        self.states = experiment.dataset.bound is None and experiment.dataset.velocity is not None
        # A law is identified with values that all trials share.
        common = experiment.identification("sysid").get("parameters", {})
        self.sysid = {name: float(value) for name, value in common.items()}
        self.guess, self.mass = self._guess()
        self.shear = 2.0 * self.guess["c10"]
        self.seconds = settings.trial_seconds
        if settings.train_fraction < 1.0:
            longest = float(experiment.dataset.times.max())
            self.seconds = min(settings.train_fraction * longest, self.seconds or math.inf)

    @property
    def early(self) -> float | None:
        """Duration from which a law is identified before it is tested on the same trials [s]; None with others."""
        longest = self.seconds or float(self.experiment.dataset.times.max())
        return _EARLY * longest if self.checked == self.learned and longest > 0.0 else None

    @property
    def holds_out(self) -> bool:
        """Whether a chosen law is identified again with what it was tested on."""
        return not self.settings.split.validation

    def simulator(self, constants: Mapping[str, float], model: str = LAW) -> Simulator:
        """Returns the simulator of the identified model with the constants of a law; failed steps are counted."""
        settings = self.experiment.settings_of("identified")
        material = MaterialSettings.model_validate({"model": model, **self.mass, **constants})
        return build_simulator(settings, material, self.experiment.body, on_failure="count")

    def others(self, simulator: Simulator) -> dict[str, torch.Tensor]:
        """Returns (1,) identified parameters beside the law: damping by mass and density, and those of other parts."""
        own = {*self.experiment.simulator("simulation").materials[""].quantities} - {*_OF_MASS}
        return {name: simulator.tensor([value]) for name, value in self.sysid.items() if name not in own}

    def bounds_of_others(self, simulator: Simulator) -> dict[str, Bounds]:
        """Returns the ranges of the identified parameters that are not those of the material."""
        if self.settings.identified is None:
            return {}
        return {name: bounds_of(self.settings.identify.parameters[name]) for name in self.others(simulator)}

    def replays(self, simulator: Simulator, names: Sequence[str]) -> Replays:
        """Returns replays of trials, with the markers where SysID has placed them."""
        identified = self.experiment.identified("sysid" if self.sysid else "simulation")
        return self.experiment.motions.replays(simulator, names, identified)

    def scores(self, laws: Sequence[Mapping[str, float]], others: Mapping[str, float] | None = None) -> "list[Score]":
        """Returns the errors of laws on the trials that they are tested on.

        Args:
            laws: constants by name.
            others: values of the other identified parameters, in place of SysID's.
        """
        union: dict[str, float] = {}
        for law in laws:
            union |= {name: value if is_shape(name) else 0.0 for name, value in law.items()}
        simulator = self.simulator({**union, **laws[0]})
        values = {name: simulator.tensor([law.get(name, union[name]) for law in laws]) for name in union}
        own = self.others(simulator) | {n: simulator.tensor([v]) for n, v in (others or {}).items()}
        values |= {name: value.expand(len(laws)) for name, value in own.items()}
        return self.errors(simulator, values, len(laws))

    def errors(self, simulator: Simulator, values: Mapping[str, torch.Tensor], sets: int) -> "list[Score]":
        """Returns the errors of a simulator with some sets of parameters on the trials that laws are tested on."""
        frames: list[list[FloatArray]] = [[] for _ in range(sets)]
        begin = self.early or 0.0
        with torch.no_grad():
            for replay, start in self.replays(simulator, self.checked):
                own = replay.trials if self.seconds is None else replay.trials.first(self.seconds)
                squares = Replay(simulator, replay.observe, own)
                errors = squares.errors(squares(start, values)).square().sum((3, 4))  # (E, R, T)
                seen = own.seen.sum(2)
                means = errors / (seen.clamp_min(1) * own.amplitude.square()[:, None])
                for row, inside in enumerate((own.times >= begin) & (seen > 0)):
                    for number in range(sets) if bool(inside.any()) else ():
                        frames[number].append(means[number, row, inside].double().cpu().numpy())
        return [Score(tuple(own)) for own in frames]

    def score_below(self) -> "Score":
        """Returns the error of the identified simulator, or of the uncorrected one."""
        simulator = self.experiment.model_simulator("sysid" if self.sysid else "simulation")
        shared = {name: simulator.tensor([value]) for name, value in self.sysid.items()}  # as laws have them
        return self.errors(simulator, shared, 1)[0]

    def stretches(
        self, constants: Mapping[str, float], others: Mapping[str, float], names: Sequence[str]
    ) -> list[float]:
        """Returns the least and the largest principal stretch in trials, simulated where markers are seen.

        Args:
            constants: of a law.
            others: values of the other identified parameters.
            names: names of the trials.
        """
        dataset, mesh, simulator = self.experiment.dataset, self.experiment.body.mesh, self.simulator(constants)
        if dataset.bound is None:
            bodies = [dataset.observed[dataset.rows(names)]]
        else:
            values = {name: simulator.tensor([value]) for name, value in others.items()}
            with torch.no_grad():
                bodies = [
                    Replay(simulator, WHOLE_STATE, replay.trials)(replace(start, shift=None), values).cpu().numpy()
                    for replay, start in self.replays(simulator, names)
                ]
        parts = [principal_stretches(mesh, own.reshape(-1, *mesh.vertices.shape)) for own in bodies]
        return [float(min(map(np.nanmin, parts))), float(max(map(np.nanmax, parts)))]

    def validation(self, law: Score, below: Score) -> dict[str, Any]:
        """Returns the errors of a law and of the simulator below it on the trials that laws are tested on."""
        split = "training" if self.holds_out else "validation"
        return {"trials": list(self.checked), "split": split, "law": law.error, "below": below.error}

    def _guess(self) -> tuple[dict[str, float], dict[str, float]]:
        """Returns a neo-Hookean law like the identified material, and its constants of the mass."""
        material = self.experiment.simulator("simulation").materials[""]
        known = {name: float(torch.as_tensor(value)) for name, value in material.constants.items()}
        known |= {name: value for name, value in self.sysid.items() if name in known}
        tensors = {name: torch.tensor([[value]], dtype=torch.float64) for name, value in known.items()}
        lame = np.asarray(material.law.lame).T @ [float(m) for m in material.moduli(tensors)]
        mu, volume = float(lame[0]), max(float(lame[1]), LEAST * float(lame[0]))
        time = known.get("stiffness_damping", 0.0)
        guess = {
            "c10": 0.5 * mu,
            "bulk_1": 0.5 * volume,
            **dict(zip(VISCOSITIES, (time * mu, time * volume), strict=True)),
        }
        times = {name: value for name, value in known.items() if name.startswith("prony_time_")}
        ratios = [(known[name.replace("time", "ratio")], value) for name, value in times.items()]
        relaxing = [(ratio * mu, time) for ratio, time in ratios if ratio > LEAST]
        guess |= branches_of([modulus for modulus, _ in relaxing], [time for _, time in relaxing])
        return guess, {name: known[name] for name in _OF_MASS}

    def bounds(self, name: str, value: float) -> Bounds:
        """Returns the range of a constant of a law, around its first guess, and its prior.

        The priors have the weight of one observation. They hold what the trials do not excite: moduli and viscosities
        near those of SysID, and further terms near zero. At small strains, markers do not tell c10 from these, and the
        neo-Hookean law extrapolates best from there.
        """
        if name == "bulk_1":
            mean = max(value, self.shear)
            return Bounds(0.1 * mean, max(10.0 * mean, _STIFFEST * self.shear), True, Prior(mean, 3.0 * mean))
        if name == "c10":
            return Bounds(0.0, max(4.0 * value, self.shear), prior=self._prior_of_modulus() or Prior(value, self.shear))
        if name.startswith("prony_time"):
            return Bounds(value / 4.0, 4.0 * value, True)
        if name.startswith(("fibre_azimuth", "fibre_elevation")):
            return Bounds(value - _TURN, value + _TURN)
        if name.startswith("fibre_slack"):
            return Bounds(0.0, 0.1)
        if name.startswith("fibre_toe"):
            return Bounds(0.002, 0.1, True)
        if name in VISCOSITIES:
            known = self.guess[name]
            most = (0.01 if name == "shear_viscosity" else 1.0) * self.shear
            prior = Prior(known, known) if known > 1e-6 * self.shear else None
            return Bounds(0.0, max(4.0 * value, 4.0 * known, most), prior=prior)
        deviation = (1.0 if self.states else _FURTHER) * self.shear
        return Bounds(0.0, max(4.0 * value, self.shear), prior=Prior(0.0, deviation))

    def _prior_of_modulus(self) -> Prior | None:
        """Returns the prior of c10 that corresponds to one of Young's modulus, if there is one."""
        parameters = self.settings.identify.parameters if self.settings.identified is not None else {}
        wanted = parameters.get("youngs_modulus")
        if wanted is None or wanted.prior is None:
            return None
        share = self.guess["c10"] / self.sysid["youngs_modulus"]
        return Prior(share * wanted.prior.mean, share * wanted.prior.deviation)


def is_shape(name: str) -> bool:
    """Whether a constant has no coefficient's meaning: a time, a direction, a slack or a toe."""
    return unit_of(name) != "Pa" and name not in VISCOSITIES


def is_refined(name: str) -> bool:
    """Whether a constant is identified through the simulator."""
    return not name.startswith(("fibre_stiffening", "fibre_compression"))


def strong_names(constants: Mapping[str, float], shear: float) -> dict[str, str]:
    """Names of constants by their names without terms, branches and families that hardly resist, which are left out.

    Args:
        constants: of a law.
        shear: shear modulus of the material [Pa].
    """
    weak = {name for name, value in constants.items() if unit_of(name) == "Pa" and value < LEAST * shear}
    weak |= {name for name in VISCOSITIES if constants.get(name, 1.0) < 1e-6 * shear}
    kept = {
        name: name
        for name in constants
        if name in ("c10", "bulk_1") or not (name in weak or name.startswith(("prony", "fibre")))
    }
    for leading in ("prony_modulus_", "fibre_tension_"):
        group = leading.split("_")[0]
        strong = [name.removeprefix(leading) for name in constants if name.startswith(leading) and name not in weak]
        for number, old in enumerate(strong, 1):
            members = [name for name in constants if name.startswith(group) and name.endswith(f"_{old}")]
            kept |= {f"{name.removesuffix(old)}{number}": name for name in members}
    return kept


def branches_of(moduli: Sequence[float], times: Sequence[float], first: int = 1) -> dict[str, float]:
    """Constants of branches by their moduli [Pa] and relaxation times [s], numbered from `first`."""
    pairs = enumerate(zip(moduli, times, strict=True), first)
    return {key: x for k, (m, t) in pairs for key, x in ((f"prony_modulus_{k}", m), (f"prony_time_{k}", t))}
