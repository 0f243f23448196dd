"""Elastic energy densities, one module per material; `kernels.solid` makes the kernels of a material.

The energy of a point is ``sum_t m_t W_t(F)``, the moduli m_t times the volume that the point carries for that term
(shape terms and volume terms may be integrated at different points, so that a modulus may be zero). A module has

- ``NAME``, that of its Warp module,
- ``LAME``: for each modulus, what it adds to the Lame constants (mu, lambda) of small strains,
- ``moduli``, the vector type of the m_t,
- ``response(f, m) -> energy, stress``,
- ``slopes(f, df, m, carried) -> dP/dm_t : df`` for every t; anything for those whose volume ``carried`` is zero,
- ``tangent(f, m, clamp, out)``: the blocks of dP/dF; with ``clamp``, without negative eigenvalues.
"""
