"""Numbers in float64 for device code, where a literal of Python would be one of float32."""

import warp as wp

ZERO = wp.float64(0.0)
SIXTH = wp.float64(1.0 / 6.0)
QUARTER = wp.float64(0.25)
THIRD = wp.float64(1.0 / 3.0)
HALF = wp.float64(0.5)
ONE = wp.float64(1.0)
TWO = wp.float64(2.0)
THREE = wp.float64(3.0)
FOUR = wp.float64(4.0)
SIX = wp.float64(6.0)
EIGHT = wp.float64(8.0)
TWELVE = wp.float64(12.0)
