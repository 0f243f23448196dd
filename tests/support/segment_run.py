"""A short segment with two chambers and some 70 vertices, whose complete runs take seconds."""

from pathlib import Path

SEGMENT = """# @package _global_
defaults: [sopra, {override /mesh: segment}, _self_]
name: tiny
tip: {z: -0.1}
chambers: {count: 2}
mesh: {size: 0.03, layers: 0.05, chambers: 2}
data:
  {steps: 12, sequences: 5, train: 2, validation: 1, test: 1, horizons: [0.06, 0.12],
    rest_seconds: 0.01, cutoff: 20.0}
markers:
  tracked: null
  reference: {B1: [0.03, 0.0, 0.0], B2: [0.0, 0.03, 0.0], B3: [-0.03, -0.03, 0.0]}
  bind: rigid
  bind_to: {z: -0.1}
parallel: {processes: 1, batch: 2}
identify:
  {trials: 1, seconds: 0.05, max_evaluations: 3}
network: {position_modes: 2, velocity_modes: 0, force_modes: 2, width: 8}
trainer: {epochs: 4, rollout_every: 2, batch_size: 16, gate: false}
laboratory:
  mesh: {chamber_lengths: [0.09], caps: [0.005, 0.005], radii: [0.0222, 0.0222], chambers: 2,
    outline: round, size: 0.02, layers: 0.03, wall: 0.003, web: 0.003}
  sequences: {rest: 0.01, correlation_time: 0.03}
"""
TRACKED = "markers.tracked={T1:[0.02,0.0,-0.1],T2:[0.0,0.02,-0.1],T3:[-0.02,-0.01,-0.1]}"


def place_segment(folder):
    """Writes the experiment ``tiny`` into a folder."""
    place = Path(folder) / "configs" / "experiment" / "tiny.yaml"
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(SEGMENT)
