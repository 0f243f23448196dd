"""Stage: the report page."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..configured import build_mesh, choose_device
from ..files import read_json
from ..mesh import select_vertices
from ..metrics import PUBLISHED_MM, trajectory_errors
from ..report.page import Example, ReportData, write_report
from ..stages import StageContext, package_versions, resources_used
from .trajectories import (
    ERRORS,
    RECONSTRUCTION,
    REPORT,
    ROLLOUTS,
    STAGES,
    TIMES,
    TRAINING,
    TRAJECTORIES,
    read_fields,
    split_of,
)

_AS_PUBLISHED = "The published errors are measured against the reconstructed trajectories, ours against the target."
_PHYSICS = {
    "per_vertex": " This run computes masses and volumes as the published code does.",
    "row_sum": (
        " The published simulator doubles the beam's mass and locks (physics=published computes the same); "
        "this run does not, so that its uncorrected error is another one."
    ),
}


@dataclass(frozen=True, eq=False)
class EvaluatedSplit:
    """The test split of a run: what should have happened, and what the models made of it.

    Attributes:
        names: R trajectories.
        target: (R, T + 1, N, 3) [m].
        positions: the same of each model.
        errors_mm: for each model (R, T) mean distances from the target.
        worst: the trajectory of which the uncorrected simulator makes most errors.
    """

    names: tuple[str, ...]
    target: NDArray[np.float64]
    positions: dict[str, NDArray[np.float64]]
    errors_mm: dict[str, NDArray[np.float64]]
    worst: int


def read_rollouts(folder: Path, config: Mapping[str, Any]) -> EvaluatedSplit:
    """What an experiment has left in its run folder."""
    split, _ = split_of(config["data"])
    part = split.indices("test")
    (target,) = read_fields(folder / TRAJECTORIES, "trajectories", "q")
    (reconstruction,) = read_fields(folder / RECONSTRUCTION, "reconstruction", "q")
    simulation, resphys, simfree = read_fields(folder / ROLLOUTS, "rollouts", "simulation_q", "resphys_q", "simfree_q")
    positions = {
        "simulation": simulation,
        "reconstruction": reconstruction[part],
        "simfree": simfree,
        "resphys": resphys,
    }
    target = target[part]
    errors = {
        m: np.stack([trajectory_errors(a, b) for a, b in zip(q, target, strict=True)]) for m, q in positions.items()
    }
    return EvaluatedSplit(
        split.test, target, positions, errors, int(np.argmax(np.nanmean(errors["simulation"], axis=1)))
    )


def make_report(context: StageContext) -> None:
    """Writes report.html and its figures."""
    config = context.settings["config"]
    test = read_rollouts(context.run_dir, config)
    mesh = build_mesh(config["mesh"])
    worst = test.worst
    data = ReportData(
        experiment=config["name"],
        title=config["title"],
        simulator=_in_words(config["simulation"]),
        reality=_in_words(config["reality"]),
        metrics=collect_metrics(context, config),
        settings=config,
        published=PUBLISHED_MM.get(config["name"], {}),
        published_note=_AS_PUBLISHED + _PHYSICS[config["physics"]["mass"]],
        time_step=config["time_step"],
        mesh=mesh,
        tip=select_vertices(mesh, **config["tip"]),
        example=Example(
            test.names[worst], test.target[worst], test.positions["simulation"][worst], test.positions["resphys"][worst]
        ),
        errors_mm=test.errors_mm,
        training=read_json(context.run_dir / TRAINING),
    )
    write_report(context.run_dir / REPORT, data)


def collect_metrics(context: StageContext, config: dict[str, Any]) -> dict[str, Any]:
    """Errors, time and memory of the stages that are done, versions and device."""
    return {
        **read_json(context.run_dir / ERRORS),
        "seconds_per_test_trajectory": read_json(context.run_dir / TIMES)["seconds"],
        **resources_used(context.run_dir, STAGES),
        "versions": package_versions(),
        "device": str(choose_device(config["device"])),
    }


def _in_words(material: dict[str, Any]) -> str:
    """Young's modulus and Poisson's ratio, and the model where it is not the usual one."""
    words = f"E {material['youngs_modulus'] / 1e3:g} kPa, ν {material['poissons_ratio']:g}"  # noqa: RUF001
    return words if material["model"] == "corotated" else f"{words}, {material['model'].replace('_', ' ')}"
