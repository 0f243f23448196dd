"""Laws of a material: classes of convex terms, and the smallest coefficients
that balance the forces of motions.

The terms are those of `energies.convex_material.ConvexMaterial`, with the coefficients of the weak
form (`weak_form`). It decides which groups of terms a law needs: elastic terms beyond the modulus,
viscosity, branches of relaxation, and families of fibres. Relaxation times and directions of fibres
come from a grid, and are refined with the coefficients through the simulator (`law_search`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from typing import Any, Final

import numpy as np
import torch

from ...core.dynamics.simulator import Simulator
from ...core.energies.catalogue import LawTest, TriedClass, law_content, unit_of
from ...core.energies.convex_material import ConvexMaterial
from ...core.energies.materials import Material
from ...core.mesh.volume_mesh import Mesh
from ...io.arrays import FloatArray
from ...settings.learning import Bounds, Prior
from .weak_form import Candidate, NormalEquations, WeakForm

MODULUS: Final = ("c10", "bulk_1")  # of the smallest class, a neo-Hookean solid
VISCOSITIES: Final = ("shear_viscosity", "bulk_viscosity")
UNIT: Final = 1e5  # Pa, of a candidate's coefficient
_UNIT_VISCOSITY: Final = 1e2  # Pa s
_FIBRE: Final = {"slack": 0.0, "toe": 0.02, "stiffening": 0.0, "compression": 0.0}
_NEEDLESS: Final = 1.02  # ratio of the residuals without and with a term below which it is left out
_ROUNDING: Final = 1e-6  # residual below which every term that is left is needed
_SAME: Final = 1.6  # ratio of neighbouring relaxation times that are one branch
_FINER: Final = math.radians(15.0)  # of the finer directions about the best coarse one
_LEAST: Final = 1e-3  # fraction of the shear modulus below which a coefficient is zero
_STIFFEST: Final = 500.0  # bulk over shear modulus, as of a Poisson's ratio of 0.4995
_OFF_THE_POLE: Final = (
    0.2  # rad, of fibres along z at first: exactly there, their azimuth has no effect
)
_TURN: Final = 0.8  # largest correction of a fibre's angle [rad]


@dataclass(frozen=True)
class IdentifiedLaw:
    """An identified law.

    Attributes:
        simulator: simulator with the law; pass `others` to its functions.
        accepted: whether it helps on the trials that it was tested on.
        parameters: of the material, by name, in SI units.
        others: parameters identified beside the law, by name.
        deviation: standard deviations of all of them; empty if they are not known.
        at_bounds: names of those that ended on a bound.
        validation: errors on the trials that the law was tested on.
        model: name of the material's class.
        groups: groups of terms besides the modulus; this and what follows is None of a law that was
            known.
        loss: of the identification.
        classes: classes that were tried.
        stretches: least and largest principal stretch in the trials that it was identified from.
        trials: their names.
    """

    simulator: Simulator
    accepted: bool
    parameters: Mapping[str, float]
    others: Mapping[str, float]
    deviation: Mapping[str, float]
    at_bounds: Sequence[str]
    validation: LawTest
    model: str = ConvexMaterial.model
    groups: Sequence[str] | None = None
    loss: float | None = None
    classes: Sequence[TriedClass] | None = None
    stretches: Sequence[float] | None = None
    trials: Sequence[str] = ()

    def plain(self) -> dict[str, Any]:
        """Returns the law as JSON data."""
        hidden = ("simulator", "trials")
        known = {
            key: value
            for key, value in vars(self).items()
            if value is not None and key not in hidden
        }
        return {**known, **law_content(self.model, self.parameters)}


@dataclass(frozen=True)
class LawClass:
    """A class of laws with the coefficients of the weak form.

    Attributes:
        groups: groups of terms besides the modulus.
        parameters: parameters of a `ConvexMaterial`, by name.
        residual: residual of the weak form, of held-out motions if there are any.
    """

    groups: tuple[str, ...]
    parameters: dict[str, float]
    residual: float


class _Columns:
    """Columns of candidates for training and for held-out motions."""

    def __init__(self, train: WeakForm, held_out: WeakForm | None) -> None:
        self._forms = [train] if held_out is None else [train, held_out]
        self._columns = [np.zeros((len(form.target), 0)) for form in self._forms]
        self.candidates: list[Candidate] = []

    def add(self, candidates: Sequence[Candidate]) -> list[int]:
        """Adds columns; returns their indices."""
        first = len(self.candidates)
        self.candidates += candidates
        if candidates:
            pairs = zip(self._columns, self._forms, strict=True)
            self._columns = [
                np.concatenate([old, form.columns(candidates)], axis=1) for old, form in pairs
            ]
            pairs = zip(self._columns, self._forms, strict=True)
            self._normal = [NormalEquations.of(columns, form.target) for columns, form in pairs]
        return list(range(first, len(self.candidates)))

    def fit(self, indices: Sequence[int]) -> tuple[FloatArray, float]:
        """Returns the coefficients, and the residual of the held-out motions,
        or of the training motions.
        """
        found = self._normal[0].fit(indices)
        return found, self._normal[-1].residual(indices, found)


def fit_classes(
    train: WeakForm,
    held_out: WeakForm | None,
    terms: Sequence[str],
    times: Sequence[float],
    families: int = 1,
) -> list[LawClass]:
    """Returns the law of every class, from the smallest to the largest.

    Of equal laws, that of the smallest class.

    Args:
        train: balance of the training motions; its simulator has the terms of the library, one
            branch and a family of fibres.
        held_out: balance of the held-out motions; None: residuals are those of the training
            motions.
        terms: elastic terms by name, as in `ConvexMaterial`, besides `MODULUS`.
        times: relaxation times of branches [s], ascending; none: no branches.
        families: largest number of families of fibres.
    """
    columns = _Columns(train, held_out)
    modulus = columns.add([{name: UNIT} for name in MODULUS])
    groups = {
        "elastic": columns.add([{name: UNIT} for name in terms]),
        "viscosity": columns.add([{name: _UNIT_VISCOSITY} for name in VISCOSITIES]),
        "branches": columns.add(
            [{"prony_modulus_1": UNIT, "prony_time_1": time} for time in times]
        ),
    }
    base = modulus + list(chain.from_iterable(groups.values()))
    groups["fibres"] = _families(columns, base, families)
    names = [name for name, members in groups.items() if members]
    laws = dict[tuple[int, ...], LawClass]()
    for chosen in chain.from_iterable(combinations(names, size) for size in range(len(names) + 1)):
        kept = _sparse(columns, modulus, [*chain.from_iterable(groups[name] for name in chosen)])
        coefficients, residual = columns.fit(kept)
        parameters = _parameters([columns.candidates[k] for k in kept], coefficients)
        laws.setdefault(tuple(kept), LawClass(chosen, parameters, residual))
    return list(laws.values())


def _families(columns: _Columns, base: Sequence[int], most: int) -> list[int]:
    """Adds families of fibres one after the other, each along the direction that explains most."""
    families = list[int]()
    for _ in range(most):
        best, directions = (math.inf, -1), _half_sphere()
        for _finer in range(2):
            tried = columns.add([_fibres(direction) for direction in directions])
            best = min(best, *((columns.fit([*base, *families, k])[1], k) for k in tried))
            at = columns.candidates[best[1]]
            directions = _around(at["fibre_azimuth_1"], at["fibre_elevation_1"])
        families.append(best[1])
    return families


def _fibres(direction: FloatArray) -> dict[str, float]:
    x, y, z = direction / np.linalg.norm(direction)
    angles = {
        "fibre_azimuth_1": math.atan2(y, x),
        "fibre_elevation_1": math.asin(min(max(z, -1.0), 1.0)),
    }
    return {"fibre_tension_1": UNIT, **angles}


def _half_sphere() -> list[FloatArray]:
    """Returns the axes and diagonals of a cube, 13 directions."""
    steps = np.array(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3)).reshape(3, -1).T
    return [d for d in steps if tuple(d) > (0.0, 0.0, 0.0)]


def _around(azimuth: float, elevation: float) -> list[FloatArray]:
    """Returns eight directions around one."""
    axis = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    across = np.linalg.svd(axis[None])[2][1:]
    turns = np.linspace(0.0, 2.0 * np.pi, 9)[:-1]
    return [
        axis + math.tan(_FINER) * (np.cos(t) * across[0] + np.sin(t) * across[1]) for t in turns
    ]


def _sparse(columns: _Columns, modulus: Sequence[int], others: Sequence[int]) -> list[int]:
    """Members without those whose absence the residual hardly shows, starting with the least."""
    coefficients, residual = columns.fit([*modulus, *others])
    kept = [k for k, value in zip(others, coefficients[len(modulus) :], strict=True) if value > 0.0]
    while kept:
        without = {
            k: columns.fit([*modulus, *(other for other in kept if other != k)])[1] for k in kept
        }
        least = min(kept, key=lambda k: without[k])
        if without[least] > max(_NEEDLESS * residual, _ROUNDING):
            break
        kept.remove(least)
    return [*modulus, *kept]


def _parameters(candidates: Sequence[Candidate], coefficients: FloatArray) -> dict[str, float]:
    """Returns the parameters of a `ConvexMaterial`.

    Neighbouring relaxation times become one branch.
    """
    parameters = dict[str, float]()
    branches = list[list[float]]()
    families = list[dict[str, float]]()
    for candidate, factor in zip(candidates, coefficients.tolist(), strict=True):
        if "prony_time_1" in candidate:
            modulus, time = factor * UNIT, candidate["prony_time_1"]
            if branches and time < _SAME * branches[-1][1]:
                total = branches[-1][0] + modulus
                branches[-1] = [
                    total,
                    branches[-1][1] ** (branches[-1][0] / total) * time ** (modulus / total),
                ]
            else:
                branches.append([modulus, time])
        elif "fibre_tension_1" in candidate:
            families.append({**candidate, "fibre_tension_1": factor * UNIT})
        else:
            ((name, unit),) = candidate.items()
            parameters[name] = factor * unit
    shear = 2.0 * (parameters["c10"] + parameters.get("c01", 0.0)) + sum(
        value for name, value in parameters.items() if name.startswith("ogden")
    )
    strong = [branch for branch in branches if branch[0] > _LEAST * shear]
    parameters |= branches_of([modulus for modulus, _ in strong], [time for _, time in strong])
    pulling = [family for family in families if family["fibre_tension_1"] > _LEAST * shear]
    for number, family in enumerate(pulling, 1):
        parameters |= {f"fibre_{name}_{number}": value for name, value in _FIBRE.items()}
        parameters |= {f"{name[:-1]}{number}": value for name, value in family.items()}
    return parameters


def first_guess(material: Material, known: Mapping[str, float]) -> dict[str, float]:
    """Returns a neo-Hookean law with the moduli, the viscosity and the creep of a material.

    Args:
        material: its class.
        known: its parameters.
    """
    tensors = {name: torch.tensor([[value]], dtype=torch.float64) for name, value in known.items()}
    lame = np.asarray(material.law.lame).T @ [float(m) for m in material.moduli(tensors)]
    mu, volume = float(lame[0]), max(float(lame[1]), _LEAST * float(lame[0]))
    time = known.get("stiffness_damping", 0.0)
    viscosities = dict(zip(VISCOSITIES, (time * mu, time * volume), strict=True))
    times = {name: value for name, value in known.items() if name.startswith("prony_time_")}
    ratios = [(known[name.replace("time", "ratio")], value) for name, value in times.items()]
    relaxing = [(ratio * mu, time) for ratio, time in ratios if ratio > _LEAST]
    branches = branches_of([modulus for modulus, _ in relaxing], [time for _, time in relaxing])
    return {"c10": 0.5 * mu, "bulk_1": 0.5 * volume, **viscosities, **branches}


def bounds_of_parameter(
    name: str, value: float, guess: Mapping[str, float], deviation: float, modulus: Prior | None
) -> Bounds:
    """Returns the range of a parameter of a law, around a first value, and its prior.

    The priors have the weight of one observation. They hold what the trials do not excite: moduli
    and viscosities near those of the first guess, and further terms near zero. At small strains,
    markers do not tell c10 from these, and the neo-Hookean law extrapolates best from there.

    Args:
        name: of the parameter.
        value: from which its search starts.
        guess: `first_guess`.
        deviation: standard deviation of further terms, over the shear modulus.
        modulus: prior of c10, if one is known.
    """
    shear = 2.0 * guess["c10"]
    if name == "bulk_1":
        mean = max(value, shear)
        most = max(10.0 * mean, _STIFFEST * shear)
        return Bounds(
            lower=0.1 * mean,
            upper=most,
            logarithmic=True,
            prior=Prior(mean=mean, deviation=3.0 * mean),
        )
    if name == "c10":
        return Bounds(
            lower=0.0,
            upper=max(4.0 * value, shear),
            prior=modulus or Prior(mean=value, deviation=shear),
        )
    if name.startswith("prony_time"):
        return Bounds(lower=value / 4.0, upper=4.0 * value, logarithmic=True)
    if name.startswith(("fibre_azimuth", "fibre_elevation")):
        return Bounds(lower=value - _TURN, upper=value + _TURN)
    if name.startswith("fibre_slack"):
        return Bounds(lower=0.0, upper=0.1)
    if name.startswith("fibre_toe"):
        return Bounds(lower=0.002, upper=0.1, logarithmic=True)
    if name in VISCOSITIES:
        known = guess[name]
        most = (0.01 if name == "shear_viscosity" else 1.0) * shear
        prior = Prior(mean=known, deviation=known) if known > 1e-6 * shear else None
        return Bounds(lower=0.0, upper=max(4.0 * value, 4.0 * known, most), prior=prior)
    return Bounds(
        lower=0.0, upper=max(4.0 * value, shear), prior=Prior(mean=0.0, deviation=deviation * shear)
    )


def is_shape(name: str) -> bool:
    """Whether a parameter is no coefficient, but a time, a direction, a slack or a toe."""
    return unit_of(name) != "Pa" and name not in VISCOSITIES


def strong_names(parameters: Mapping[str, float], shear: float) -> dict[str, str]:
    """Names of parameters by their names without terms,
    branches and families that hardly resist, which are left out.

    Args:
        parameters: of a law.
        shear: shear modulus of the material [Pa].
    """
    weak = {
        name
        for name, value in parameters.items()
        if unit_of(name) == "Pa" and value < _LEAST * shear
    }
    weak |= {name for name in VISCOSITIES if parameters.get(name, 1.0) < 1e-6 * shear}
    kept = {
        name: name
        for name in parameters
        if name in ("c10", "bulk_1") or not (name in weak or name.startswith(("prony", "fibre")))
    }
    for leading in ("prony_modulus_", "fibre_tension_"):
        group = leading.split("_")[0]
        strong = [
            name.removeprefix(leading)
            for name in parameters
            if name.startswith(leading) and name not in weak
        ]
        for number, old in enumerate(strong, 1):
            members = [
                name for name in parameters if name.startswith(group) and name.endswith(f"_{old}")
            ]
            kept |= {f"{name.removesuffix(old)}{number}": name for name in members}
    return kept


def branches_of(
    moduli: Sequence[float], times: Sequence[float], first: int = 1
) -> dict[str, float]:
    """Parameters of branches by their moduli [Pa] and relaxation times [s],
    numbered from `first`.
    """
    found = dict[str, float]()
    for k, (modulus, time) in enumerate(zip(moduli, times, strict=True), first):
        found |= {f"prony_modulus_{k}": modulus, f"prony_time_{k}": time}
    return found


def family(tension: float, direction: tuple[float, float] = (0.0, 0.0)) -> dict[str, float]:
    """Parameters of fibres with a tension [Pa], along an azimuth and an elevation [rad]."""
    zero = {f"fibre_{name}_1": 0.0 for name in ("slack", "stiffening", "compression")}
    angles = dict(zip(("fibre_azimuth_1", "fibre_elevation_1"), direction, strict=True))
    return {"fibre_tension_1": tension, "fibre_toe_1": 0.02, **angles, **zero}


def longest_side(mesh: Mesh) -> tuple[float, float]:
    """Azimuth and elevation of the longest side of the box around a body [rad]."""
    side = int(np.ptp(mesh.vertices, axis=0).argmax())
    return ((0.0, 0.0), (0.5 * np.pi, 0.0), (0.0, 0.5 * np.pi - _OFF_THE_POLE))[side]
