"""Experiments: from a configuration to objects, and the stages, one module each; they talk through files.

From outside: `build.build_simulator`, `experiment.run_experiment`.
"""
