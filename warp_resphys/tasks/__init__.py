"""The stages of an experiment, one module each; they talk through files in the run folder."""

from typing import Any


def run(config: Any) -> None:
    """Runs every stage of the configured experiment (a Hydra configuration) in Hydra's run folder."""
    from .experiment import run_experiment

    run_experiment(config)
