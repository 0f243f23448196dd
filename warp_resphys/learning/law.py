"""Search for the law of a material: the smallest class of convex terms that explains held-out motions.

The terms are those of `energies.materials.ConvexMaterial`. The weak form (`learning.weak_form`) gives their
coefficients from motions of all vertices, and decides which groups of terms a law needs: elastic terms beyond the
modulus, viscosity, branches of relaxation, and families of fibres. Relaxation times and directions of fibres come from
a grid, and are refined with the coefficients through the simulator (`learning.identification`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .weak_form import Candidate, FloatArray, NormalEquations, WeakForm

MODULUS: Final = ("c10", "bulk_1")  # of the smallest class, a neo-Hookean solid
VISCOSITIES: Final = ("shear_viscosity", "bulk_viscosity")
UNIT: Final = 1e5  # Pa, of a candidate's coefficient
_UNIT_VISCOSITY: Final = 1e2  # Pa s
_FIBRE: Final = {"slack": 0.0, "toe": 0.02, "stiffening": 0.0, "compression": 0.0}
_NEEDLESS: Final = 1.02  # ratio of the residuals without and with a term below which it is left out
_ROUNDING: Final = 1e-6  # residual below which every term that is left is needed
_SAME: Final = 1.6  # ratio of neighbouring relaxation times that are one branch
_TURN: Final = math.radians(15.0)  # of the finer directions about the best coarse one
_SMALLEST: Final = 1e-3  # fraction of the shear modulus below which a branch or a family is left out


@dataclass(frozen=True)
class LawClass:
    """A class of laws with the coefficients of the weak form.

    Attributes:
        groups: groups of terms besides the modulus.
        constants: constants of a `ConvexMaterial`, by name.
        residual: residual of the weak form, of held-out motions if there are any.
    """

    groups: tuple[str, ...]
    constants: dict[str, float]
    residual: float


class _Columns:
    """Columns of candidates for training and for held-out motions."""

    def __init__(self, train: WeakForm, held_out: WeakForm | None) -> None:
        self._forms = [train] if held_out is None else [train, held_out]
        self.candidates: list[Candidate] = []
        self._blocks: list[list[FloatArray]] = [[] for _ in self._forms]
        self._normal: list[NormalEquations] = []

    def add(self, candidates: Sequence[Candidate]) -> list[int]:
        """Adds columns; returns their indices."""
        if not candidates:
            return []
        for blocks, form in zip(self._blocks, self._forms, strict=True):
            blocks.append(form.columns(candidates))
        pairs = zip(self._blocks, self._forms, strict=True)
        self._normal = [NormalEquations.of(np.concatenate(blocks, axis=1), form.target) for blocks, form in pairs]
        first = len(self.candidates)
        self.candidates += candidates
        return list(range(first, len(self.candidates)))

    def fit(self, indices: Sequence[int]) -> tuple[NDArray[np.float64], float]:
        """Returns the coefficients, and the residual of the held-out motions, or of the training motions."""
        found = self._normal[0].fit(indices)
        return found, self._normal[-1].residual(indices, found)


def fit_classes(
    train: WeakForm, held_out: WeakForm | None, terms: Sequence[str], times: Sequence[float], families: int = 1
) -> list[LawClass]:
    """Returns the law of every class, from the smallest to the largest; of equal laws, that of the smallest class.

    Args:
        train: balance of the training motions; its simulator has the terms of the library, one branch and a family of
            fibres.
        held_out: balance of the held-out motions; None: residuals are those of the training motions.
        terms: elastic terms by name, as in `ConvexMaterial`, besides `MODULUS`.
        times: relaxation times of branches [s], ascending; none: no branches.
        families: largest number of families of fibres.
    """
    columns = _Columns(train, held_out)
    modulus = columns.add([{name: UNIT} for name in MODULUS])
    groups = {
        "elastic": columns.add([{name: UNIT} for name in terms]),
        "viscosity": columns.add([{name: _UNIT_VISCOSITY} for name in VISCOSITIES]),
        "branches": columns.add([{"prony_modulus_1": UNIT, "prony_time_1": time} for time in times]),
    }
    base = modulus + list(chain.from_iterable(groups.values()))
    groups["fibres"] = _families(columns, base, families)
    names = [name for name, members in groups.items() if members]
    laws = dict[tuple[int, ...], LawClass]()
    for chosen in chain.from_iterable(combinations(names, size) for size in range(len(names) + 1)):
        kept = _sparse(columns, modulus, [k for name in chosen for k in groups[name]])
        coefficients, residual = columns.fit(kept)
        constants = _constants([columns.candidates[k] for k in kept], coefficients)
        laws.setdefault(tuple(kept), LawClass(chosen, constants, residual))
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


def _fibres(direction: NDArray[np.float64]) -> dict[str, float]:
    x, y, z = direction / np.linalg.norm(direction)
    angles = {"fibre_azimuth_1": math.atan2(y, x), "fibre_elevation_1": math.asin(min(max(z, -1.0), 1.0))}
    return {"fibre_tension_1": UNIT, **angles}


def _half_sphere() -> list[NDArray[np.float64]]:
    """Returns the axes and diagonals of a cube, 13 directions."""
    steps = np.array(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3)).reshape(3, -1).T
    return [d for d in steps if tuple(d) > (0.0, 0.0, 0.0)]


def _around(azimuth: float, elevation: float) -> list[NDArray[np.float64]]:
    """Returns eight directions around one."""
    axis = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    across = np.linalg.svd(axis[None])[2][1:]
    turns = np.linspace(0.0, 2.0 * np.pi, 9)[:-1]
    return [axis + math.tan(_TURN) * (np.cos(t) * across[0] + np.sin(t) * across[1]) for t in turns]


def _sparse(columns: _Columns, modulus: Sequence[int], others: Sequence[int]) -> list[int]:
    """Returns the members without those whose absence the residual hardly shows, starting with the least."""
    coefficients, residual = columns.fit([*modulus, *others])
    kept = [k for k, value in zip(others, coefficients[len(modulus) :], strict=True) if value > 0.0]
    while kept:
        without = {k: columns.fit([*modulus, *(other for other in kept if other != k)])[1] for k in kept}
        least = min(kept, key=lambda k: without[k])
        if without[least] > max(_NEEDLESS * residual, _ROUNDING):
            break
        kept.remove(least)
    return [*modulus, *kept]


def _constants(candidates: Sequence[Candidate], coefficients: FloatArray) -> dict[str, float]:
    """Returns the constants of a `ConvexMaterial`; neighbouring relaxation times become one branch."""
    constants, branches, families = dict[str, float](), list[list[float]](), list[dict[str, float]]()
    for candidate, factor in zip(candidates, coefficients.tolist(), strict=True):
        if "prony_time_1" in candidate:
            modulus, time = factor * UNIT, candidate["prony_time_1"]
            if branches and time < _SAME * branches[-1][1]:
                total = branches[-1][0] + modulus
                branches[-1] = [total, branches[-1][1] ** (branches[-1][0] / total) * time ** (modulus / total)]
            else:
                branches.append([modulus, time])
        elif "fibre_tension_1" in candidate:
            families.append({**candidate, "fibre_tension_1": factor * UNIT})
        else:
            ((name, unit),) = candidate.items()
            constants[name] = factor * unit
    shear = 2.0 * (constants["c10"] + constants.get("c01", 0.0)) + sum(
        value for name, value in constants.items() if name.startswith("ogden")
    )
    strong = [branch for branch in branches if branch[0] > _SMALLEST * shear]
    for number, (modulus, time) in enumerate(strong, 1):
        constants |= {f"prony_modulus_{number}": modulus, f"prony_time_{number}": time}
    pulling = [family for family in families if family["fibre_tension_1"] > _SMALLEST * shear]
    for number, family in enumerate(pulling, 1):
        own = {f"{name[:-1]}{number}": value for name, value in family.items()}
        constants |= {f"fibre_{name}_{number}": value for name, value in _FIBRE.items()} | own
    return constants
