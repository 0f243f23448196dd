"""Gradients beside differences."""

import numpy as np
import torch

_POINTS = (-2.0, -1.0, 1.0, 2.0)  # of a difference, in changes


def check_slopes(loss, values, sizes, seed=3, tolerance=1e-6, together=False):
    """Compares gradients of a loss with differences
    of five points along a random direction of every value.

    Args:
        loss: function of the values by name, a number or (B,) with one for each environment.
        values: tensors by name, (B, ...) where the loss has environments.
        sizes: of the changes by name, so small that no point begins or ends to touch or slide.
        seed: of the directions.
        tolerance: of a difference, relative to its size.
        together: whether the loss takes all points of all differences at once, as so many times the
            environments.
    """
    random = torch.Generator().manual_seed(seed)
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    result = loss(leaves)
    result.sum().backward()
    changes = {
        name: sizes[name]
        * torch.randn(value.shape, generator=random, dtype=torch.float64).to(value.device)
        for name, value in values.items()
    }
    points = {
        name: [value + factor * changes[name] for factor in _POINTS]
        for name, value in values.items()
    }
    with torch.no_grad():
        if together:
            every = [{**values, name: point} for name in values for point in points[name]]
            stacked = {name: torch.cat([each[name] for each in every]) for name in values}
            found = loss(stacked).reshape(len(values), len(_POINTS), *result.shape)
        else:
            found = [[loss({**values, name: point}) for point in points[name]] for name in values]
    for name, near in zip(values, found, strict=True):
        slopes = leaves[name].grad * changes[name]
        slopes = slopes.reshape(len(slopes), -1).sum(1) if result.ndim else slopes.sum()
        difference = (8.0 * (near[2] - near[1]) - (near[3] - near[0])) / 12.0
        error = float((slopes - difference).norm() / difference.norm())
        assert error < tolerance, f"{name}: {error:.1e}"


def check_rows(rows, *names, bound=1e-6):
    """Returns rows of `check_gradients` by parameter,
    all right within a bound, the named ones among them.
    """
    found = {row.parameter: row for row in rows}
    assert {*names} <= found.keys()
    assert {
        name: row.relative_error for name, row in found.items() if not row.relative_error <= bound
    } == {}
    return found


def differences(function, x, step):
    """Central differences of a function by every entry of an array (K,), one for each."""
    return [
        (function(x + change) - function(x - change)) / (2.0 * step)
        for change in step * np.eye(len(x))
    ]
