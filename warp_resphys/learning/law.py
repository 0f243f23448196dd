"""Search for the law of a material: the smallest class of convex terms that explains held-out motions.

The terms are those of `energies.convex_material.ConvexMaterial`. Their forces are linear in their coefficients, so that
the balance of forces of observed motions gives these. With the positions of all vertices at every step, the residual of
a step (`Simulator.linearise`) at the observed solution is g_0 + sum_k theta_k a_k, where a_k is the force of
coefficient k alone. The coefficients are the non-negative least-squares solution of

    min sum || H^-1 (g_0 + sum_k theta_k a_k) ||^2

over steps and motions: the weak form of an unknown law (Flaschel, Kumar and De Lorenzis, Computer Methods in Applied
Mechanics and Engineering 381, 2021). H is the Hessian of a longer step, whose inverse turns forces into the
displacements that they would cause. Without this weight, forces of nearly incompressible modes rule the sum.

It decides which groups of terms a law needs: elastic terms beyond the modulus, viscosity, branches of relaxation, and
families of fibres. Relaxation times and directions of fibres come from a grid, and are refined with the coefficients
through the simulator (`learning.identification`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, combinations
from typing import Final

import numpy as np
import scipy.linalg
import scipy.optimize
import torch

from ..dynamics.simulator import Simulator
from ..energies.hysteresis import PLASTIC_STRAIN
from ..energies.solid import VISCOUS_STRAIN
from ..energies.tendon_forces import SEGMENT_TENSION
from ..io.arrays import FloatArray
from ..io.errors import InputError
from ..stepping.inputs import Inputs
from ..stepping.state import State

Candidate = Mapping[str, float]  # values of parameters that give one unit of a coefficient, the others being zero

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
_CARRIED = (VISCOUS_STRAIN, PLASTIC_STRAIN, SEGMENT_TENSION)  # memory that forces of later steps depend on
_AT_ONCE = 256  # environments of a batch
_RIDGE = 1e-14  # of the trace, where columns are dependent


@dataclass(frozen=True)
class KnownMotion:
    """B observed motions with the same number of steps T."""

    q: torch.Tensor  # (T + 1, B, N, 3) positions of all vertices at the steps [m]
    v: torch.Tensor  # (B, N, 3) velocities at the start [m/s]
    inputs: Inputs = field(default_factory=Inputs)  # during the steps


class WeakForm:
    """Balance of forces of motions.

    Args:
        simulator: simulator with all energies, of which some have unknown coefficients.
        motions: motions that begin without memory, as after a long rest.
        zero: values of the parameters without the forces of these coefficients.
        stiffness: values of the parameters for the Hessian of the weight.
        stride: steps from one row to the next.
        weight_step: time step of that Hessian [s].
    """

    def __init__(
        self,
        simulator: Simulator,
        motions: Sequence[KnownMotion],
        zero: Candidate,
        stiffness: Candidate,
        stride: int = 5,
        weight_step: float = 0.05,
    ) -> None:
        if not motions or stride < 1:
            raise InputError("there is no step to balance: give at least one motion, and a stride of one or more.")
        self._simulator, self._zero, self._stride = simulator, dict(zero), stride
        self._slow = replace(simulator, time_step=weight_step)
        self._stiff = self._slow.prepare(stiffness)
        self._motions = motions
        with torch.no_grad():
            self._states = [list(self._along(motion)) for motion in motions]
        self.target = -self._rows([self._zero])[:, 0]  # (R,) rows of -H^-1 g_0

    def columns(self, candidates: Sequence[Candidate]) -> FloatArray:
        """Returns H^-1 a_k (R, K) of K candidates [m]; rows run over steps, motions and free coordinates."""
        return self._rows([self._zero, *candidates])[:, 1:] + self.target[:, None]

    def _along(self, motion: KnownMotion) -> "list[State]":
        """Returns the states at the start of every step, without memory."""
        method, step = self._simulator.method, self._simulator.time_step
        states = [State(motion.q[0], motion.v)]
        for q in motion.q[1:-1]:
            x = method.solution_for(states[-1], q)
            states.append(replace(method.finish(states[-1], x, step), q=q))
        return states

    @torch.no_grad()
    def _rows(self, candidates: Sequence[Candidate]) -> FloatArray:
        """Returns the weighted residuals (R, K) with the parameters of each candidate, the others being zero."""
        parts = []
        for motion, states in zip(self._motions, self._states, strict=True):
            most = max(1, _AT_ONCE // motion.q.shape[1])
            chunks = [candidates[i : i + most] for i in range(0, len(candidates), most)]
            parts.append(np.concatenate([self._of_motion(motion, states, chunk) for chunk in chunks], axis=1))
        return np.concatenate(parts)

    def _of_motion(self, motion: KnownMotion, states: Sequence[State], candidates: Sequence[Candidate]) -> FloatArray:
        simulator, count = self._simulator, len(candidates)
        batch = motion.q.shape[1]
        names = set().union(*candidates)
        values = {name: [c.get(name, self._zero.get(name, 0.0)) for c in candidates] for name in names}
        spread = {
            name: motion.q.new_tensor(own).repeat_interleave(batch)[:, None]
            for name, own in {**{k: [x] * count for k, x in self._zero.items()}, **values}.items()
        }
        constants = simulator.prepare(spread)
        carries = True
        memory: Mapping[str, torch.Tensor] = {}
        rows = []
        for number, start in enumerate(states):
            if number % self._stride and not carries:
                continue
            state = replace(start.map(lambda t: t.repeat(count, 1, 1)), memory=memory)
            end = motion.q[number + 1]
            inputs = motion.inputs.at(number).repeat(count)
            if number % self._stride == 0:
                x = simulator.method.solution_for(state, end.repeat(count, 1, 1))
                rows.append(self._weighted(simulator.linearise(state, inputs, constants).residual(x), end))
            if carries:
                memory = simulator.remember(state, end.repeat(count, 1, 1), constants, inputs).memory
                memory = {name: value for name, value in memory.items() if name.endswith(_CARRIED)}
                carries = bool(memory)
        return np.concatenate(rows)

    def _weighted(self, residuals: torch.Tensor, at: torch.Tensor) -> FloatArray:
        """Returns H^-1 g on the free vertices, (B 3F, K), of residuals (K B, N, 3) at positions (B, N, 3)."""
        lin = self._slow.linearise(State(at, torch.zeros_like(at)), None, self._stiff)
        lin.factorise(at)
        forces = residuals.unflatten(0, (-1, len(at))).permute(1, 2, 3, 0).flatten(1, 2)
        moved = lin.solve(forces).unflatten(1, (-1, 3))[:, lin.free]
        rows: FloatArray = moved.flatten(0, 2).cpu().numpy().astype(np.float64)
        return rows


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of columns (R, K) theta = target (R,), for fits of many subsets of the columns."""

    matrix: FloatArray  # (K, K)
    right: FloatArray  # (K,)
    square: float  # |target|^2

    @classmethod
    def of(cls, columns: FloatArray, target: FloatArray) -> "NormalEquations":
        """Returns those of columns (R, K) and a target (R,)."""
        return cls(columns.T @ columns, columns.T @ target, float(target @ target))

    def fit(self, members: Sequence[int]) -> FloatArray:
        """Returns the non-negative least-squares solution with some of the columns."""
        picked = np.ix_(members, members)
        scale = np.sqrt(np.diag(self.matrix)[members])
        used = scale > 0.0
        unit = (self.matrix[picked] / np.outer(np.where(used, scale, 1.0), np.where(used, scale, 1.0)))[used][:, used]
        root = scipy.linalg.cholesky(unit + _RIDGE * np.trace(unit) / max(len(unit), 1) * np.eye(len(unit)))
        right = scipy.linalg.solve_triangular(root, self.right[members][used] / scale[used], trans=1)
        theta = np.zeros(len(scale))
        theta[used] = scipy.optimize.nnls(root, right)[0] / scale[used]
        return theta

    def residual(self, members: Sequence[int], theta: FloatArray) -> float:
        """Returns the root mean square of the forces of some columns less the target, over that of the target.

        It has half of the digits of the columns, 1e-8.
        """
        quadratic = float(theta @ self.matrix[np.ix_(members, members)] @ theta)
        left = quadratic - 2.0 * float(theta @ self.right[members]) + self.square
        return math.sqrt(max(left, 0.0) / self.square)


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

    def fit(self, indices: Sequence[int]) -> tuple[FloatArray, float]:
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


def _fibres(direction: FloatArray) -> dict[str, float]:
    x, y, z = direction / np.linalg.norm(direction)
    angles = {"fibre_azimuth_1": math.atan2(y, x), "fibre_elevation_1": math.asin(min(max(z, -1.0), 1.0))}
    return {"fibre_tension_1": UNIT, **angles}


def _half_sphere() -> list[FloatArray]:
    """Returns the axes and diagonals of a cube, 13 directions."""
    steps = np.array(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3)).reshape(3, -1).T
    return [d for d in steps if tuple(d) > (0.0, 0.0, 0.0)]


def _around(azimuth: float, elevation: float) -> list[FloatArray]:
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
