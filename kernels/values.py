"""Values of an energy at a point, each read from an array by part, by point, or common to all points."""

import functools
from typing import Any

import warp as wp

from .modules import named_module


@functools.cache
def value_reader(vector: Any) -> Any:
    """Returns the function that reads a vector type's values at point p of environment b.

    Its arguments are the addresses of arrays (B, size) of float64, their sizes, and where in a row the values of each
    point are, (n, P). So kernels take any number of values without a further argument, or a copy.
    """

    @wp.func(module=named_module(f"values.{vector._length_}"))
    def read_values(
        addresses: wp.array[wp.uint64], sizes: wp.array[int], places: wp.array2d[int], b: int, p: int
    ) -> vector:
        values = vector()
        for k in range(places.shape[0]):
            row = wp.array(ptr=addresses[k], shape=((b + 1) * sizes[k],), dtype=wp.float64)
            values[k] = row[b * sizes[k] + places[k, p]]
        return values

    return read_values
