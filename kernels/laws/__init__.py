"""Laws of tension, one module per law; `kernels.axial` makes the kernels of a law.

A module has

- ``NAME``, that of its Warp module,
- ``TIED``: whether the first three values are the place that the point is tied to,
- ``values``, the vector type of the values v,
- ``tension(length, toe, v) -> e, t, dt/dl, dt/dv``, the last of the type of v.
"""
