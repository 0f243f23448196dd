"""A learned force in a reduced model: the network itself, which sees and pushes a few modes alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..learning.networks import StateMap
from ..learning.predictors import Range
from .evaluator import Evaluator
from .polynomials import Monomials, Polynomial

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ReducedForce:
    r"""G(u) (c - c_0(u)), with c the network's outputs for what it sees of coordinates z, their rates, and inputs.

    It sees [p(u) + E(u) (z - z_0(u)), W(u) z', t + S_0 u + sum_f S_f m_f], standardised and held in the range of the
    training.

    Attributes:
        network: a force in reduced modes.
        range_: of its inputs; None for no guard.
        places: p, (a,), its standardised position modes where z = z_0(u).
        seen: E, (a, r); None for a network that does not see positions.
        seen_rates: W, (b, r); None for a network that does not see velocities.
        told: t, (k,), standardised, of what stays the same.
        told_by: (1 + f, k, n) what the inputs u and their means m_f change in it; none where it is told of no inputs.
        usual: c_0, (c,).
        push: G, (r, c).
    """

    network: StateMap
    range_: Range | None
    places: Polynomial
    seen: Polynomial | None
    seen_rates: Polynomial | None
    told: FloatArray
    told_by: FloatArray
    usual: Polynomial
    push: Polynomial

    def at(self, u: Monomials, base: Polynomial) -> "ForceAt":
        """What it needs along inputs (T, n), of coordinates about z_0."""
        return ForceAt(self, u, base)

    def pull(
        self, u: Monomials, base: Polynomial, z: FloatArray, v: FloatArray, means: Sequence[FloatArray]
    ) -> FloatArray:
        """(B, r) on B robots at once, under inputs (B, n) with means (B, n), of coordinates (B, r) and their rates."""
        parts = [self.places(u)]
        if self.seen is not None:
            parts[0] = parts[0] + (self.seen(u) @ (z - base(u))[..., None])[..., 0]
        parts += [] if self.seen_rates is None else [(self.seen_rates(u) @ v[..., None])[..., 0]]
        told = np.tile(self.told, (len(z), 1))
        for by, each in zip(self.told_by, (u.points, *means), strict=False):
            told += each @ by.T
        left = self.outputs(np.concatenate([*parts, told], axis=1)) - self.usual(u)
        return np.asarray((self.push(u) @ left[..., None])[..., 0])

    def outputs(self, inputs: FloatArray) -> FloatArray:
        """(S, c) of standardised inputs (S, i), held."""
        return self._evaluator(inputs)

    @cached_property
    def _evaluator(self) -> Evaluator:
        return Evaluator(self.network, self.range_)

    def output_slopes(self, inputs: FloatArray, left: FloatArray) -> FloatArray:
        """(S, r, i) derivatives of ``left @ outputs`` by the inputs (S, i), with left (S, r, c)."""
        with torch.enable_grad():
            unheld = torch.as_tensor(inputs).to(self.network.linear).requires_grad_()
            found = self.network.standardised(unheld if self.range_ is None else self.range_.hold(unheld))[0]
            weights = torch.as_tensor(left).to(found).swapaxes(0, 1)  # (r, S, c)
            (slopes,) = torch.autograd.grad(found, unheld, weights, is_grads_batched=True)
        return np.asarray(slopes.swapaxes(0, 1).double().cpu().numpy())

    def polynomials(self) -> dict[str, Polynomial]:
        """Those of it, by name."""
        found = {"places": self.places, "usual": self.usual, "push": self.push}
        more = {"seen": self.seen, "seen_rates": self.seen_rates}
        return found | {name: each for name, each in more.items() if each is not None}

    @classmethod
    def restored(
        cls,
        network: StateMap,
        range_: Range | None,
        made: Mapping[str, Polynomial],
        arrays: Mapping[str, Any],
    ) -> "ReducedForce":
        """Of polynomials by name, and the arrays ``told`` and ``told_by``."""
        return cls(
            network,
            range_,
            made["places"],
            made.get("seen"),
            made.get("seen_rates"),
            arrays["told"],
            arrays["told_by"],
            made["usual"],
            made["push"],
        )


class ForceAt:
    """A `ReducedForce` along inputs (T, n)."""

    def __init__(self, force: ReducedForce, u: Monomials, base: Polynomial) -> None:
        self._force, self._u, self._static, self._base = force, u, base, base(u)
        self._places = force.places(u)
        self._seen = None if force.seen is None else force.seen(u)
        self._rates = None if force.seen_rates is None else force.seen_rates(u)
        self._usual, self._push = force.usual(u), force.push(u)
        nothing = np.zeros((len(u.points), len(force.told)))
        self._told = force.told + (u.points @ force.told_by[0].T if len(force.told_by) else nothing)
        self._inputs: list[FloatArray] = []
        self._states: list[tuple[FloatArray, FloatArray]] = []
        self._outputs: list[FloatArray] = []

    def __call__(self, k: int, z: FloatArray, v: FloatArray, means: FloatArray) -> FloatArray:
        """(r,) during step k, of the state before it and of the means (f, n) of the inputs after it."""
        force = self._force
        parts = [self._places[k] + (0.0 if self._seen is None else self._seen[k] @ (z - self._base[k]))]
        parts += [] if self._rates is None else [self._rates[k] @ v]
        told = self._told[k]
        for by, mean in zip(force.told_by[1:], means, strict=False):
            told = told + by @ mean
        given = np.concatenate([*parts, told])
        found = force.outputs(given[None])[0]
        self._inputs.append(given)
        self._states.append((z, v))
        self._outputs.append(found)
        return np.asarray(self._push[k] @ (found - self._usual[k]))

    def last_slope(self, k: int) -> FloatArray:
        """(r, r) by z, of what was asked last, of step k."""
        if self._seen is None:
            return np.zeros((self._push.shape[1],) * 2)
        slopes = self._force.output_slopes(self._inputs[-1][None], self._push[k : k + 1])[0]
        return np.asarray(slopes[:, : self._places.shape[1]] @ self._seen[k])

    @cached_property
    def slopes(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Of all steps: (T, r, r) by z and by v before them, (T, r, n) by u, and (T, r, f, n) by the means."""
        force, u = self._force, self._u
        j = force.output_slopes(np.array(self._inputs), self._push)  # (T, r, i)
        a = self._places.shape[1]
        b = 0 if self._rates is None else self._rates.shape[1]
        seen, rates, told = j[..., :a], j[..., a : a + b], j[..., a + b :]
        z, v = (np.array(each) for each in zip(*self._states, strict=True))
        moved = force.places.slopes(u).swapaxes(1, 2)
        by_z = np.zeros((*j.shape[:2], j.shape[1]))
        if self._seen is not None and force.seen is not None:
            by_z = seen @ self._seen
            moved = moved - self._seen @ self._static.slopes(u).swapaxes(1, 2)
            moved = moved + np.einsum("tnar,tr->tan", force.seen.slopes(u), z - self._base)
        by_u = seen @ moved - self._push @ force.usual.slopes(u).swapaxes(1, 2)
        left = np.array(self._outputs) - self._usual
        by_u = by_u + np.einsum("tnrc,tc->trn", force.push.slopes(u), left)
        by_v = np.zeros_like(by_z)
        if self._rates is not None and force.seen_rates is not None:
            by_v = rates @ self._rates
            by_u = by_u + rates @ np.einsum("tnbr,tr->tbn", force.seen_rates.slopes(u), v)
        if not len(force.told_by):
            return by_z, by_v, by_u, np.zeros((*by_u.shape[:2], 0, u.points.shape[1]))
        by_u = by_u + told @ force.told_by[0]
        return by_z, by_v, by_u, np.einsum("trk,fkn->trfn", told, force.told_by[1:])
