"""What the command `warp-resphys` can be asked to do."""

from typing import Any

from ..io.errors import InputError


def run(config: Any) -> None:
    """Does the configured task (of a Hydra configuration) in Hydra's run folder.

    Raises:
        InputError: an unknown task.
    """
    if config.task == "run":
        from ..experiment.experiment import run_experiment

        run_experiment(config)
    elif config.task == "tune":
        from .tuning.tune import run_tuning

        run_tuning(config)
    else:
        raise InputError(f"task is {config.task!r}: choose run or tune.")
