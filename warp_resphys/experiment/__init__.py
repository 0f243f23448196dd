"""Experiments: builds objects from settings, and runs the stages,
one module each, which exchange data through files.

Entry points: `build.build_simulator`, `experiment.Experiment`.
"""
