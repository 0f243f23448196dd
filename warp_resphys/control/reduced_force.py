"""The learned force in a reduced model: the robot's network, evaluated on a few modes.

The network is evaluated in NumPy: for one state at a time, calling torch's layers takes longer than
computing them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ..data.input_response import with_means
from ..io.arrays import BoolArray, FloatArray
from ..learning.residuals.correction import Range
from ..learning.residuals.networks import SkipMLP, StateMap
from .polynomials import Monomials, Polynomial

Array = NDArray[Any]
Layer = Callable[[Array], Array]


class Evaluator:
    """Evaluates a trained network in the type of its weights.

    Args:
        network: whose weights are final.
        range_: to which its inputs are clipped, and beyond which its force may fade out; None for
            no clipping.
    """

    def __init__(self, network: StateMap, range_: Range | None) -> None:
        assert isinstance(network.network, SkipMLP)
        blocks = [cast(nn.Sequential, block) for block in network.network.blocks]
        self._blocks = [list(map(_layer, block)) for block in blocks]
        self._linear, self._remainder = (
            network.linear.numpy(force=True),
            network.remainder.numpy(force=True),
        )
        self._edges = None if range_ is None else [edge.numpy(force=True) for edge in range_.edges]
        self._fades = range_ if range_ is not None and range_.missed is not None else None
        if self._fades is not None:
            self._nothing = network.encode_outputs(torch.zeros_like(network.rest)[None]).numpy(
                force=True
            )

    def __call__(self, inputs: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Returns standardised outputs (S, c) for inputs (S, i),
        and which of these (S,) are outside of the range.
        """
        x: Array = (
            inputs
            if self._edges is None
            else np.minimum(np.maximum(inputs, self._edges[0]), self._edges[1])
        )
        left = (x != inputs).any(1)
        fades = self._fades if left.any() else None
        hidden = x = x.astype(self._linear.dtype)
        for number, layers in enumerate(self._blocks):
            after = hidden
            for layer in layers:
                after = layer(after)
            hidden = hidden + after if number else after
        outputs = x @ self._linear + self._remainder * hidden
        if fades is not None:
            weight = fades.weight(torch.as_tensor(inputs).to(fades.low)).numpy(force=True)
            outputs = self._nothing + weight[:, None] * (outputs - self._nothing)
        return np.asarray(outputs, dtype=np.float64), left


def _layer(module: nn.Module) -> Layer:
    if isinstance(module, nn.Linear):
        return partial(
            _affine, module.weight.numpy(force=True).T.copy(), module.bias.numpy(force=True)
        )
    if isinstance(module, nn.SiLU):
        return _silu
    if isinstance(module, nn.ELU):
        return partial(_elu, float(module.alpha))
    assert isinstance(module, nn.LayerNorm)
    return partial(
        _norm, module.weight.numpy(force=True), module.bias.numpy(force=True), float(module.eps)
    )


def _affine(weight: Array, bias: Array, x: Array) -> Array:
    return x @ weight + bias


def _silu(x: Array) -> Array:
    # exp overflows for very negative x, where the quotient is zero
    with np.errstate(over="ignore"):
        return x / (1.0 + np.exp(-x))


def _elu(alpha: float, x: Array) -> Array:
    return np.where(x > 0.0, x, alpha * np.expm1(np.minimum(x, 0.0)))


def _norm(weight: Array, bias: Array, eps: float, x: Array) -> Array:
    off = x - x.mean(-1, keepdims=True)
    return off / np.sqrt((off * off).mean(-1, keepdims=True) + eps) * weight + bias


@dataclass(frozen=True)
class ReducedForce:
    r"""G(u) (c - c_0(u)), with c the network's outputs for coordinates z,
    their rates, and inputs u.

    The network's inputs are [p(u) + E(u) (z - z_0(u), z'), t + S (u, m)], standardised and clipped
    to the training range, with m the filtered inputs. Beyond the range a force on an identified law
    fades out.
    """

    network: StateMap  # predicts a force in reduced modes
    range_: Range | None  # of its inputs; None for no clipping
    places: Polynomial  # p, (m,), standardised position and velocity modes at rest where z = z_0(u)
    seen: Polynomial  # E, (m, 2 r)
    conditions: FloatArray  # t, (k,), the network's standardised inputs beside the state, at u = 0
    # S, (k, n (1 + F)), their derivatives by the inputs and the filtered inputs; empty where the
    # network takes no inputs
    conditions_by: FloatArray
    usual: Polynomial  # c_0, (c,)
    push: Polynomial  # G, (r, c)

    @cached_property
    def outputs(self) -> Evaluator:
        """Standardised outputs for standardised inputs."""
        return Evaluator(self.network, self.range_)


class ForceAlong:
    """The learned force along a motion under S inputs.

    Args:
        force: of the model.
        u: monomials of the inputs.
        static: z_0.
        means: (F, S, n) filtered inputs.

    Attributes:
        left: (B,) whether the last evaluation was outside of the network's training range.
    """

    left: BoolArray

    def __init__(
        self, force: ReducedForce, u: Monomials, static: Polynomial, means: FloatArray
    ) -> None:
        base = static(u)
        at_rest = np.concatenate([base, np.zeros_like(base)], axis=1)
        self._evaluated = force.outputs
        self._seen, self._usual, self._push = force.seen(u), force.usual(u), force.push(u)
        conditions = np.tile(force.conditions, (len(base), 1))
        if len(force.conditions_by):
            conditions = conditions + with_means(u.points, means) @ force.conditions_by.T
        places = force.places(u) - (self._seen @ at_rest[..., None])[..., 0]
        self._offset, self._modes = np.concatenate([places, conditions], axis=1), places.shape[1]

    def __call__(self, rows: slice, state: FloatArray) -> FloatArray:
        """Force (B, r) in some rows of the S inputs, for coordinates and rates (2, B, r)."""
        flat = np.concatenate([*state], axis=1)
        inputs = self._offset[rows].copy()
        inputs[:, : self._modes] += (self._seen[rows] @ flat[..., None])[..., 0]
        outputs, self.left = self._evaluated(inputs)
        return np.asarray((self._push[rows] @ (outputs - self._usual[rows])[..., None])[..., 0])
