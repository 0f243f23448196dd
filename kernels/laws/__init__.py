"""Tension laws, one module per law, for the kernels of `kernels.axial`.

A module has

- ``NAME``, the name of its Warp module,
- ``TIED``: whether the first three values are the position that the point is tied to,
- ``values``, the vector type of the values v,
- ``tension(length, toe, v) -> e, t, dt/dl, dt/dv``, the last of the type of v.
"""
