"""Notes on the page of a run: its simulator, its network, and contributions to its errors."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch

from ..energies.catalogue import make_material
from ..settings.body import MaterialSettings, TargetSettings
from ..settings.run import RunSettings
from .page import number_text
from .uniaxial import SmallStrain, small_strain

_SELECTED_BY: Final = {"rollout": "roll-out error", "validation_loss": "validation loss"}
_PUBLISHED_NETWORK: Final = {"kind": "nodal", "blocks": 5, "layers": 3, "width": 512, "activation": "normalised_elu"}
_PUBLISHED_TRAINER: Final = {
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
_AGAINST: Final = "The published errors are measured against the reconstructed trajectories, ours against the target."
_MASS: Final = {
    "per_vertex": " This run computes masses and volumes as the published code does.",
    "row_sum": (
        " The published simulator doubles the beam's mass and locks (physics=published computes the same); this run "
        "does not, so its uncorrected error differs."
    ),
}
_TARGET: Final = "The published target differs from its simulator in E and ν alone; this run's also has {}."  # noqa: RUF001
_OF_A_BEAM: Final = (
    "The published errors are for other data: recordings with ten markers on the beam's sides, whose weight is cut off "
    "at the release, compared with trajectories reconstructed from them; the published uncorrected simulation has the "
    "published setting, and the published SysID identifies elastic parameters only."
)
_OF_AN_ARM: Final = {
    True: "The published errors are for another body: recordings of a real arm, which this run does not use.",
    False: "The published errors are for the published simulator, of 494 vertices, on the authors' recordings.",
}
_OF_A_TARGET: Final = {
    "mesh": "mesh",
    "physics": "integration of mass and volume",
    "parts": "further parts",
    "glued": "glue",
    "regions": "regions",
    "rigid": "rigid parts",
    "fixed": "fixed vertices",
    "symmetry": "symmetry planes",
    "chambers": "chambers",
    "fibres": "fibres around the chambers",
    "tendons": "tendons",
    "muscles": "muscle fibres",
    "medium": "fluid",
    "payload_string": "payload string",
    "obstacles": "obstacles",
    "contact": "contact",
}


def published_note(settings: RunSettings) -> str:
    """Returns how the published errors of an experiment differ from ours."""
    if settings.markers is None:
        more = list[str]()
        for target in settings.targets.values():
            more += ["another model of the material"] if target.material.model != settings.simulation.model else []
            more += differences(settings, target)
        also = f" {_TARGET.format(in_a_row(more))}" if more else ""
        return _AGAINST + _MASS[settings.physics.mass] + also
    return _OF_AN_ARM[settings.is_laboratory] if settings.chambers is not None else _OF_A_BEAM


def error_notes(sideways: Mapping[str, float], truth: Mapping[str, Any], mesh_check: Mapping[str, Any]) -> list[str]:
    """Return sentences on how bodies were held, and on the contributions of noise and mesh to the errors, if known.

    Args:
        sideways: Estimated sideways displacement of held bodies [mm], by trial.
        truth: Of a simulated laboratory, with `noise_mm`.
        mesh_check: Results on a finer mesh.
    """
    notes = []
    if sideways:
        distances = ", ".join(f"{number_text(distance)} mm ({trial})" for trial, distance in sideways.items())
        notes.append(
            "The sideways displacement of the held body is estimated from the first frames of a trial: with the "
            f"identified simulator, the markers by {distances}. Every simulator starts from its own estimate."
        )
    if "noise_mm" in truth:
        notes.append(f"The noise of the markers alone is {truth['noise_mm']:.2f} mm.")
    if not mesh_check:
        return notes
    cells, finer = mesh_check["cells"]
    model = "the identified simulator" if mesh_check["model"] == "sysid" else "the simulator"
    finer_mesh = f"a mesh of {finer:,} instead of {cells:,} cells"
    if "failed" in mesh_check:
        return [*notes, f"The error of the mesh is not known: on {finer_mesh}, {mesh_check['failed']}"]
    before, after = map(number_text, mesh_check["errors_mm"])
    return [
        *notes,
        f"Error of the mesh: on {finer_mesh}, with the same constants, the markers of {model} move by "
        f"{number_text(mesh_check['moved_mm'])} mm, and its error is {after} mm instead of {before} mm.",
    ]


def network_note(settings: RunSettings, on_law: bool = False) -> str:
    """Returns the network of the residual force and its training, and whether these are the published ones.

    Args:
        settings: Of the run.
        on_law: Whether the force corrects the simulator with the identified law.
    """
    network, trainer = settings.network, settings.trainer
    who = "the published network" if dict(network).items() >= _PUBLISHED_NETWORK.items() else "our network"
    basis = "force, positions and velocities of every vertex"
    if network.kind == "reduced":
        basis = (
            f"a reduced basis of {network.position_modes} position, {network.velocity_modes} velocity and "
            f"{network.force_modes} force modes"
        )
    blocks = f"{network.blocks} block{'s' if network.blocks > 1 else ''} of {network.layers} hidden layers of "
    core = f"{blocks}{network.width}" if network.core is None else f"the core {network.core.target.rpartition('.')[2]}"
    how = "as published" if dict(trainer).items() >= _PUBLISHED_TRAINER.items() else "our way"
    linear = "" if trainer.linear_noise is None else ", with a linear part from ridge regression"
    text = (
        f"ResPhys: {who}, in {basis}, {core}{linear}; trained "
        f"{how}, {trainer.epochs} epochs, weights chosen by {_SELECTED_BY[trainer.selection]}."
    )
    if (loop := settings.in_the_loop) is not None:
        over = "whole trials" if loop.window is None else f"windows of {loop.window} steps"
        text += f" Then trained through the simulator, on {over}."
    if on_law:
        text += " It corrects the simulator with the identified law, and fades out outside its training range."
    return text


def kept_note(networks: Mapping[str, Any]) -> str:
    """Return which weights of the residual force were kept, and their validation error; empty without any."""
    kept = networks.get("resphys")
    if kept is None:
        return ""
    return f"Kept: epoch {kept['epoch']}, by {_SELECTED_BY[kept['selection']]}; {_validated(kept)}."


def _validated(kept: Mapping[str, Any]) -> str:
    error = kept["validation_rollout_error_mm"]
    if error is None:
        return "its roll-outs of the validation split diverge"
    return f"its mean roll-out error on the validation split is {number_text(error)} mm"


def material_note(material: MaterialSettings) -> str:
    """Return the constants of a material, and its model unless it is corotated; for each region if there are any."""
    if material.regions:
        return "; ".join(f"{region}: {material_note(part)}" for region, part in material.by_region.items())
    model = material.model
    own = make_material(model, **material.constants)
    constants: dict[str, Any] = dict(own.constants)
    if "youngs_modulus" in constants:
        words = f"E {constants['youngs_modulus'] / 1e3:g} kPa, ν {constants['poissons_ratio']:g}"  # noqa: RUF001
    else:
        moduli = {name: constants[name] for name, quantity in own.quantities.items() if quantity.unit == "Pa"}
        words = ", ".join(f"{name.replace('_', ' ')} {value / 1e3:g} kPa" for name, value in moduli.items() if value)
    return words if model == "corotated" else f"{words}, {material_words(model)}"


def material_words(model: str) -> str:
    """Return the name of a material's model in words."""
    return model.replace("_", " ").replace("neo hookean", "neo-Hookean")


def small_strain_of(material: MaterialSettings) -> SmallStrain | None:
    """Return the moduli of a material at small strains; None for one with regions."""
    if material.regions:
        return None
    own = make_material(material.model, **material.constants)
    if material.model == "law":
        return small_strain({name: float(torch.as_tensor(value)) for name, value in own.constants.items()})
    tensors = {n: torch.as_tensor(x, dtype=torch.float64).reshape(1, -1) for n, x in own.constants.items()}
    mu, lame = np.asarray(own.law.LAME).T @ [float(modulus) for modulus in own.moduli(tensors)]
    return SmallStrain(float(mu), float(lame))


def target_note(settings: RunSettings) -> str:
    """Return the target of simulated data in words: its material, and how else it differs from the simulator."""
    if settings.recorded is not None or settings.target is None:
        return ""
    more = differences(settings, settings.target)
    return material_note(settings.target.material) + (f"; with {in_a_row(more)}" if more else "")


def differences(settings: RunSettings, target: TargetSettings) -> list[str]:
    """Return how the simulation that plays the real body differs from the simulator, its elastic law left out.

    Args:
        settings: Of the run.
        target: One of its `targets`.
    """
    words = []
    for key, name in _OF_A_TARGET.items():
        own, simulated = getattr(target, key), getattr(settings, key)
        if own != simulated:
            other = "other " if name.endswith("s") else "another "
            words.append(f"{other if own and simulated else '' if own else 'no '}{name}")
    if target.time_step != settings.time_step:
        words.append(f"time steps of {target.time_step:g} s")
    if target.integrator != settings.integrator:
        words.append(f"the integrator {target.integrator.replace('_', ' ')}")
    if _damping(target.material) != _damping(settings.simulation):
        words.append("other damping")
    return words


def _damping(material: MaterialSettings) -> dict[str, float]:
    """Constants of viscosity and hysteresis of a material that are not zero."""
    kinds = ("damping", "prony", "hysteresis")
    own = {name: value for name, value in material.parameters.items() if any(kind in name for kind in kinds)}
    return {name: value for name, value in own.items() if value}


def in_a_row(words: Sequence[str]) -> str:
    """Return words as a list in a sentence: "a, b and c"."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
