"""Identification of parameters, reconstruction of residual forces, and networks that predict these forces.

Entry points: `library` (functions without configuration and run folders), `identification.ParameterSearch`,
`reconstruction.make_reconstructor`, `networks.build_model`, `correction.CorrectedSimulator`.
"""
