"""The learned force in a reduced model: the network itself, which sees and pushes a few modes alone."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from ..data.input_response import told_of
from ..learning.networks import StateMap
from ..learning.predictors import Range
from .evaluator import Evaluator
from .polynomials import Monomials, Polynomial

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ReducedForce:
    r"""G(u) (c - c_0(u)), with c the network's outputs for coordinates z, their rates, and inputs u.

    Its inputs are [p(u) + E(u) (z - z_0(u), z'), t + S (u, m)], standardised and held in the range of the training,
    with m the means of the inputs.

    Attributes:
        network: a force in reduced modes.
        range_: of its inputs; None for no guard.
        places: p, (m,), standardised position and velocity modes at rest where z = z_0(u).
        seen: E, (m, 2 r).
        told: t, (k,), standardised inputs that no state tells, without inputs.
        told_by: S, (k, n (1 + F)), of the inputs and their means; empty where the network takes no inputs.
        usual: c_0, (c,).
        push: G, (r, c).
    """

    network: StateMap
    range_: Range | None
    places: Polynomial
    seen: Polynomial
    told: FloatArray
    told_by: FloatArray
    usual: Polynomial
    push: Polynomial

    @cached_property
    def outputs(self) -> Evaluator:
        """(S, c) of standardised inputs (S, i)."""
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
        """Its polynomials by name."""
        return {"places": self.places, "seen": self.seen, "usual": self.usual, "push": self.push}


class ForceAlong:
    """A reduced force along S inputs.

    Args:
        force: of the model.
        u: the inputs.
        static: z_0.
        means: (F, S, n) of the inputs.
    """

    def __init__(self, force: ReducedForce, u: Monomials, static: Polynomial, means: FloatArray) -> None:
        self._force, self._u, self._static, self._filters = force, u, static, len(means)
        base = static(u)
        self._base = np.concatenate([base, np.zeros_like(base)], axis=1)
        self._seen, self._usual, self._push = force.seen(u), force.usual(u), force.push(u)
        told = np.tile(force.told, (len(base), 1))
        if len(force.told_by):
            told = told + told_of(u.points, means) @ force.told_by.T
        places = force.places(u) - (self._seen @ self._base[..., None])[..., 0]
        self._offset, self._modes = np.concatenate([places, told], axis=1), places.shape[1]
        self.restart()

    def restart(self) -> None:
        """Forgets the steps that were made."""
        self._states: list[FloatArray] = []
        self._inputs: list[FloatArray] = []
        self._outputs: list[FloatArray] = []

    def __call__(self, rows: slice, state: FloatArray) -> FloatArray:
        """(B, r) force at some of the S inputs, of coordinates and rates (2, B, r)."""
        flat = np.concatenate([*state], axis=1)
        inputs = self._offset[rows].copy()
        inputs[:, : self._modes] += (self._seen[rows] @ flat[..., None])[..., 0]
        outputs = self._force.outputs(inputs)
        self._states.append(flat)
        self._inputs.append(inputs)
        self._outputs.append(outputs)
        return np.asarray((self._push[rows] @ (outputs - self._usual[rows])[..., None])[..., 0])

    def last_slope(self) -> FloatArray:
        """(r, r) derivative of the last force by the coordinates, along S = 1 inputs."""
        slopes = self._force.output_slopes(self._inputs[-1], self._push)[0]
        return np.asarray(slopes[:, : self._modes] @ self._seen[0, :, : self._push.shape[1]])

    def slopes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivatives of the forces of all steps: (S, r, 2 r) by the states, (S, r, n) by u, (S, r, F, n) by means."""
        force, u = self._force, self._u
        states, inputs, outputs = (np.concatenate(each) for each in (self._states, self._inputs, self._outputs))
        by_inputs = force.output_slopes(inputs, self._push)  # (S, r, i)
        by_modes, by_told = by_inputs[..., : self._modes], by_inputs[..., self._modes :]
        by_z = self._seen[..., : self._base.shape[1] // 2]
        moved = force.places.slopes(u) - self._static.slopes(u) @ by_z.swapaxes(1, 2)
        moved = moved + (force.seen.slopes(u) @ (states - self._base)[:, None, :, None])[..., 0]  # (S, n, m)
        by_u = by_modes @ moved.swapaxes(1, 2) - self._push @ force.usual.slopes(u).swapaxes(1, 2)
        by_u = by_u + (force.push.slopes(u) @ (outputs - self._usual)[:, None, :, None])[..., 0].swapaxes(1, 2)
        by_means = np.zeros((*by_u.shape[:2], self._filters, by_u.shape[2]))
        if len(force.told_by):
            own, more = np.split(by_told @ force.told_by, [by_u.shape[2]], axis=2)
            by_u, by_means = by_u + own, more.reshape(by_means.shape)
        return by_modes @ self._seen, by_u, by_means
