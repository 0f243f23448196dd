"""What replaces or joins the stages of a run, by the key of the run that asks for it.

The pipeline imports these functions where it meets their keys, so that it names no application.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final

from .settings.run import RunSettings


@dataclass(frozen=True)
class OwnRun:
    """A run with stages of its own, in place of those that learn from trials.

    Attributes:
        check: function of the run that raises errors before its first stage.
        work: function of the run and its folder that runs the stages and prints the results.
    """

    check: str
    work: str


OWN_RUNS: Final[Mapping[str, OwnRun]] = {
    "pictures": OwnRun(
        "pictures.picture_stages:check_pictures", "pictures.picture_stages:run_pictures"
    ),
    "material_tests": OwnRun(
        "experiment.material_stages:check_material", "experiment.material_stages:run_material"
    ),
    "ablation": OwnRun("experiment.checks:check_run", "experiment.ablation:run_ablation"),
}
# Functions that add stages to those of a split (`experiment.split_stages`), before the report.
FURTHER_STAGES: Final[Mapping[str, str]] = {"control": "control.control_stages:add_control"}


def own_run(run: RunSettings) -> OwnRun | None:
    """Returns the stages that replace those of learning; None for a run that learns from trials."""
    return next((own for key, own in OWN_RUNS.items() if getattr(run, key) is not None), None)


def function_at(place: str) -> Callable[..., Any]:
    """Imports a function of this package, such as ``control.control_stages:add_control``."""
    module, _, name = place.partition(":")
    function: Callable[..., Any] = getattr(import_module(f"{__package__}.{module}"), name)
    return function
