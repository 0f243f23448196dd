"""Time steps and equilibria: one solve, one adjoint, and the integrators around them.

From outside: `simulator.Simulator`, `stepping.state.State`, `tape.record_rollout`, `modes.vibration_modes`.
"""
