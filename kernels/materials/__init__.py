"""Elastic energy densities, one module per material, for the kernels of `kernels.elasticity`.

The energy of a point is ``sum_t m_t W_t(F)``, with the moduli m_t times the point's volume for that term (shape terms
and volume terms may be integrated at different points, so that a modulus may be zero). A module has

- ``NAME``, the name of its Warp module,
- ``LAME``: contribution of each modulus to the Lame constants (mu, lambda) of small strains,
- ``moduli``, the vector type of the m_t,
- ``response(f, m) -> energy, stress``,
- ``slopes(f, df, m, carried) -> dP/dm_t : df`` for every t; undefined where the volume ``carried`` is zero,
- ``tangent(f, m, clamp, out)``: the blocks of dP/dF; with ``clamp``, without negative eigenvalues.

A law whose first modulus alone has the shape term ``m_0 ||F - R||^2`` may set ``LANES`` (`kernels.lanes`).
"""
