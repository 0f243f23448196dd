"""Stage: the report page."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..io.files import read_json
from ..io.stages import StageContext, package_versions, resources_used
from ..learning.metrics import PUBLISHED_MM, trajectory_errors
from ..mesh.mesh import select_vertices
from ..report.page import Example, ReportData, number_text, write_report
from .build import build_mesh, choose_device
from .trajectories import (
    ERRORS,
    RECONSTRUCTION,
    REFINEMENT,
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
_SELECTED_BY = {"rollout": "roll-out error", "validation_loss": "validation loss"}
_PUBLISHED_NETWORK = {"kind": "nodal", "blocks": 5, "layers": 3, "width": 512, "activation": "normalised_elu"}
_PUBLISHED_TRAINER = {
    "epochs": 1000,
    "batch_size": 256,
    "learning_rate": 1e-3,
    "schedule": "step",
    "weight_decay": 1e-5,
    "noise": 0.0,
    "linear_noise": None,
    "scale_weight": 0.0,
    "selection": "validation_loss",
}
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
    metrics = collect_metrics(context, config)
    refined = "refinement" in metrics["networks"]
    worst = test.worst
    data = ReportData(
        experiment=config["name"],
        title=config["title"],
        simulator=_in_words(config["simulation"]),
        reality=_in_words(config["reality"]),
        metrics=metrics,
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
        training=read_json(context.run_dir / TRAINING)["epochs"],
        refinement=read_json(context.run_dir / REFINEMENT)["epochs"] if refined else (),
        network_note=network_in_words(config),
        kept_note=kept_in_words(metrics["networks"]),
    )
    write_report(context.run_dir / REPORT, data)


def collect_metrics(context: StageContext, config: dict[str, Any]) -> dict[str, Any]:
    """Errors, which weights were kept, time and memory of the stages that are done, versions and device."""
    refined = config["refinement"]["kind"] != "none"
    histories = _HISTORIES | ({"refinement": REFINEMENT} if refined else {})
    ours = [name for name in STAGES if refined or name != "refine"]
    return {
        **read_json(context.run_dir / ERRORS),
        "networks": {m: read_json(context.run_dir / f)["kept"] for m, f in histories.items()},
        "seconds_per_test_trajectory": read_json(context.run_dir / TIMES)["seconds"],
        **resources_used(context.run_dir, ours),
        "versions": package_versions(),
        "device": str(choose_device(config["device"])),
    }


def network_in_words(config: dict[str, Any]) -> str:
    """Which network predicts the residual force, and how it is trained; says where it is the published one."""
    network, trainer = config["network"], config["trainer"]
    who = "The published network" if network.items() >= _PUBLISHED_NETWORK.items() else "Our network"
    basis = "force, positions and velocities of every vertex"
    if network["kind"] == "reduced":
        sizes = (network[f"{name}_modes"] for name in ("position", "velocity", "force"))
        basis = "a reduced basis of {} position, {} velocity and {} force modes".format(*sizes)
    blocks = "1 block" if network["blocks"] == 1 else f"{network['blocks']} blocks"
    how = "as published" if trainer.items() >= _PUBLISHED_TRAINER.items() else "our way"
    linear = "" if trainer["linear_noise"] is None else ", beside a linear part from ridge regression"
    said = (
        f"ResPhys: {who[0].lower()}{who[1:]}, in {basis}, {blocks} of {network['layers']} hidden layers of "
        f"{network['width']}{linear}; trained {how}, {trainer['epochs']} epochs, weights chosen by "
        f"{_SELECTED_BY[trainer['selection']]}."
    )
    if config["refinement"]["kind"] != "none":
        said += f" Then refined through the simulator, over windows of {config['refinement']['window']} steps."
    return said


def kept_in_words(networks: dict[str, Any]) -> str:
    """Which weights of the residual force were taken, and what they do on the validation split."""
    kept = networks["resphys"]
    said = f"Kept: epoch {kept['epoch']}, by {_SELECTED_BY[kept['selection']]}; {_validated(kept)}."
    refined = networks.get("refinement")
    if refined is None:
        return said
    if refined["epoch"] == 0:
        return f"{said} No epoch of the refinement was better: the weights are those from before it."
    return f"{said} Taken in the end: epoch {refined['epoch']} of the refinement; {_validated(refined)}."


def _validated(kept: dict[str, Any]) -> str:
    error = kept["validation_rollout_error_mm"]
    if error is None:
        return "its roll-outs of the validation split diverge"
    return f"its mean roll-out error on the validation split is {number_text(error)} mm"


def _in_words(material: dict[str, Any]) -> str:
    """Young's modulus and Poisson's ratio, and the model where it is not the usual one."""
    words = f"E {material['youngs_modulus'] / 1e3:g} kPa, ν {material['poissons_ratio']:g}"  # noqa: RUF001
    return words if material["model"] == "corotated" else f"{words}, {material['model'].replace('_', ' ')}"
