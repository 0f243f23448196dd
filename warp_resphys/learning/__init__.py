"""What a simulator lacks: parameters that are identified, forces that are reconstructed, networks that predict them.

From outside: `library` (functions without configuration and run folders), `identification.Identifier`,
`reconstruction.make_reconstructor`, `networks.build_model`, `rollout.Rollout`.
"""
