"""Elastic energy densities, one module per material, for the kernels of `kernels.elasticity`.

The energy of a point is ``sum_t m_t W_t(F)``, with the moduli m_t times the point's volume for that
term (shape terms and volume terms may be integrated at different points, so that a modulus may be
zero). A module has or returns a `kernels.laws.Law` of these values.
"""
