"""Reading the values of an energy at a point, each from its own array: per part, per point, or shared by all points."""

import functools
from typing import Any

import warp as wp

from .modules import named_module


@functools.cache
def value_reader(vector: Any) -> Any:
    """Returns the function that reads the values at point p of environment b into a vector type.

    Its arguments are the addresses of float64 arrays (B, size), their sizes, and the column of each value at each point
    (n, P), so that kernels take any number of values without further arguments or copies.
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
