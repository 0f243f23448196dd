"""Stage: the report page."""

from typing import Any

import numpy as np

from ..configured import build_mesh, choose_device
from ..files import read_json
from ..mesh import select_vertices
from ..metrics import PUBLISHED_MM, trajectory_errors
from ..report.page import Example, ReportData, write_report
from ..stages import StageContext, package_versions
from .trajectories import (
    ERRORS,
    RECONSTRUCTION,
    REPORT,
    ROLLOUTS,
    SIMFREE_TRAINING,
    STAGES,
    TIMES,
    TRAINING,
    TRAJECTORIES,
    read_fields,
    split_of,
)

_HISTORIES = {"resphys": TRAINING, "simfree": SIMFREE_TRAINING}
_AS_PUBLISHED = "The published errors are measured against the reconstructed trajectories, ours against the target."
_PHYSICS = {
    "per_vertex": " This run computes masses and volumes as the published code does.",
    "row_sum": (
        " The published simulator doubles the beam's mass and locks (physics=published computes the same); "
        "this run does not, so that its uncorrected error is another one."
    ),
}


def make_report(context: StageContext) -> None:
    """Writes report.html and its figures."""
    settings = context.settings
    config = settings["config"]
    split, _ = split_of(config["data"])
    part = split.indices("test")
    (target,) = read_fields(context.run_dir / TRAJECTORIES, "trajectories", "q")
    (reconstruction,) = read_fields(context.run_dir / RECONSTRUCTION, "reconstruction", "q")
    simulation, resphys, simfree = read_fields(
        context.run_dir / ROLLOUTS, "rollouts", "simulation_q", "resphys_q", "simfree_q"
    )
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
    mesh = build_mesh(config["mesh"])
    worst = int(np.argmax(np.nanmean(errors["simulation"], axis=1)))
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
        example=Example(split.test[worst], target[worst], simulation[worst], resphys[worst]),
        errors_mm=errors,
        training=read_json(context.run_dir / TRAINING)["epochs"],
    )
    write_report(context.run_dir / REPORT, data)


def collect_metrics(context: StageContext, config: dict[str, Any]) -> dict[str, Any]:
    """Errors, which weights were kept, seconds of the stages that are done, versions and device."""
    records = sorted((context.run_dir / "stages").glob("*.json"))
    seconds = {r.stem: read_json(r)["seconds"] for r in records if not r.name.endswith(".progress.json")}
    return {
        **read_json(context.run_dir / ERRORS),
        "networks": {m: read_json(context.run_dir / f)["kept"] for m, f in _HISTORIES.items()},
        "seconds_per_test_trajectory": read_json(context.run_dir / TIMES)["seconds"],
        "seconds": {name: seconds[name] for name in STAGES if name in seconds},
        "versions": package_versions(),
        "device": str(choose_device(config["device"])),
    }


def _in_words(material: dict[str, Any]) -> str:
    """Young's modulus and Poisson's ratio, and the model where it is not the usual one."""
    words = f"E {material['youngs_modulus'] / 1e3:g} kPa, ν {material['poissons_ratio']:g}"  # noqa: RUF001
    return words if material["model"] == "corotated" else f"{words}, {material['model'].replace('_', ' ')}"
