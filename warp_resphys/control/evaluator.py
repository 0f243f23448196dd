"""Small networks in NumPy: of one state at a time, torch takes longer to call a layer than to compute it."""

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from torch import nn

from ..learning.networks import SkipMLP, StateMap
from ..learning.predictors import Range

Array = NDArray[Any]
Layer = Callable[[Array], Array]


class Evaluator:
    """The standardised outputs of a network that is not recurrent, of held inputs; in the type of its weights.

    Args:
        network: that is not trained any further.
        range_: in which its inputs are held; None for no guard.
    """

    def __init__(self, network: StateMap, range_: Range | None) -> None:
        assert isinstance(network.network, SkipMLP)
        self._blocks = [[_layer(each) for each in cast(nn.Sequential, block)] for block in network.network.blocks]
        self._linear, self._remainder = (each.numpy(force=True) for each in (network.linear, network.remainder))
        self._edges = None if range_ is None else [each.numpy(force=True) for each in range_.edges]

    def __call__(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """(S, c) of standardised inputs (S, i)."""
        held: Array = inputs if self._edges is None else np.minimum(np.maximum(inputs, self._edges[0]), self._edges[1])
        held = held.astype(self._linear.dtype)
        found = held
        for number, layers in enumerate(self._blocks):
            after = found
            for layer in layers:
                after = layer(after)
            found = found + after if number else after
        return np.asarray(held @ self._linear + self._remainder * found, dtype=np.float64)


def _layer(module: nn.Module) -> Layer:
    if isinstance(module, nn.Linear):
        return partial(_affine, module.weight.numpy(force=True).T.copy(), module.bias.numpy(force=True))
    if isinstance(module, nn.SiLU):
        return _silu
    if isinstance(module, nn.ELU):
        return partial(_elu, float(module.alpha))
    assert isinstance(module, nn.LayerNorm)
    return partial(_norm, module.weight.numpy(force=True), module.bias.numpy(force=True), float(module.eps))


def _affine(weight: Array, bias: Array, x: Array) -> Array:
    return x @ weight + bias


def _silu(x: Array) -> Array:
    with np.errstate(over="ignore"):  # What is far below zero becomes zero.
        return x / (1.0 + np.exp(-x))


def _elu(alpha: float, x: Array) -> Array:
    return np.where(x > 0.0, x, alpha * np.expm1(np.minimum(x, 0.0)))


def _norm(weight: Array, bias: Array, eps: float, x: Array) -> Array:
    off = x - x.mean(-1, keepdims=True)
    return off / np.sqrt((off * off).mean(-1, keepdims=True) + eps) * weight + bias
