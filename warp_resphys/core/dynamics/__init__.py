"""Time steps and static equilibria with their adjoint, vibration modes, and body frames.

Public: `simulator.Simulator`, `trajectory.Motion`, `tape.record_rollout`, `modes.vibration_modes`.
"""
