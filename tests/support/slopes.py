"""Gradients beside differences."""

import numpy as np
import torch


def check_slopes(loss, values, sizes, seed=3, tolerance=1e-6):
    """Compares gradients of a loss with differences of five points along a random direction of every value.

    Args:
        loss: function of the values by name, a number or (B,) with one for each environment.
        values: tensors by name, (B, ...) where the loss has environments.
        sizes: of the changes by name, so small that no point begins or ends to touch or slide.
        seed: of the directions.
        tolerance: of a difference, relative to its size.
    """
    random = torch.Generator().manual_seed(seed)
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    result = loss(leaves)
    result.sum().backward()
    for name, value in values.items():
        change = sizes[name] * torch.randn(value.shape, generator=random, dtype=torch.float64).to(value.device)
        slopes = leaves[name].grad * change
        slopes = slopes.reshape(len(slopes), -1).sum(1) if result.ndim else slopes.sum()
        with torch.no_grad():
            near = [loss({**values, name: value + factor * change}) for factor in (-2.0, -1.0, 1.0, 2.0)]
        difference = (8.0 * (near[2] - near[1]) - (near[3] - near[0])) / 12.0
        error = float((slopes - difference).norm() / difference.norm())
        assert error < tolerance, f"{name}: {error:.1e}"


def check_rows(rows, *names, bound=1e-6):
    """Returns rows of `check_gradients` by parameter, all right within a bound, the named ones among them."""
    found = {row.parameter: row for row in rows}
    assert {*names} <= found.keys()
    assert {name: row.relative_error for name, row in found.items() if not row.relative_error <= bound} == {}
    return found


def differences(function, x, step):
    """Central differences of a function by every entry of an array (K,), one for each."""
    return [(function(x + change) - function(x - change)) / (2.0 * step) for change in step * np.eye(len(x))]
