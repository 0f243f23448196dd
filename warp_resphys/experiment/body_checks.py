"""Checks of bodies: their size, and those that play the real body."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from ..dynamics.plausibility import mean_of, small_strain_stiffness
from ..energies.materials import Material
from ..fem.body import Body
from ..io.errors import InputError
from ..mesh.mesh import select_vertices
from ..settings.run import RunSettings
from ..settings.trials import ReleaseFromLoad
from .actuators import Drive, drive_of
from .build import build_material, build_simulator
from .target import substeps_of, target_settings, vertices_in

_LARGEST_STRAIN = 0.3  # rho g L / E above which a wrong unit is assumed


@contextmanager
def naming(group: str) -> Iterator[None]:
    """Prefixes errors with the name of a group."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{group}{error}") from error


def check_target(run: RunSettings, body: Body) -> None:
    """Checks the simulation that plays the real body, which is observed at the vertices of the simulator's body."""
    for key, target in run.targets.items():
        build_material(target.material, f"{key}.material")
        with naming(f"{key}: "):
            simulator = build_simulator(target_settings(run, target), target.material, payload_at=run.payload_at)
        for material in simulator.materials.values():
            check_size(simulator.body, material, run.gravity)
        if run.recorded is not None:
            _check_drive(drive_of(run, body), drive_of(target, simulator.body))
            continue
        substeps_of(run.time_step, target, key)
        with naming(f"{key}.mesh: "):
            vertices_in(simulator.body.mesh, body.mesh)
        if isinstance(run.data, ReleaseFromLoad):
            places = {f"data.others.{name}.at": held.at for name, held in run.data.others.items() if held.at}
            for place, at in {"data.load": run.data.load, **places}.items():
                with naming(f"{place}: "):
                    select_vertices(simulator.body.mesh, **at.arguments())


def _check_drive(drive: Drive | None, real: Drive | None) -> None:
    """Refuses a laboratory whose input is not that of the simulator."""
    simulated, played = (
        "no input" if own is None else f"{own.quantity.name} of {len(own.parts)} {own.per}{'s'[: len(own.parts) - 1]}"
        for own in (drive, real)
    )
    if simulated != played:
        raise InputError(
            f"laboratory: its body takes {played}, but that of the simulator takes {simulated}: give both the same "
            "inputs, by chambers, tendons, muscles.commanded or energies."
        )


def check_size(body: Body, material: Material, gravity: Sequence[float]) -> None:
    """Refuses a body with very large strains under its own weight, which indicate a wrong unit.

    A body of length L under its weight has strains of about rho g L / E: one percent for an arm of silicone.
    """
    length = float(np.linalg.norm(np.ptp(np.asarray(body.mesh.vertices), axis=0)))
    constants = material.constants
    density, stiffness = mean_of(constants["density"]), small_strain_stiffness(material)
    if stiffness <= 0.0:
        raise InputError("the material resists no change of shape: give it a coefficient of shear, such as c10.")
    strain = density * float(np.linalg.norm(gravity)) * length / stiffness
    if strain > _LARGEST_STRAIN:
        raise InputError(
            f"the mesh is {length:.3g} m across: with E = {1e-3 * stiffness:.3g} kPa its own weight would strain it by "
            f"{100.0 * strain:.0f} %; is its unit millimetres (mesh.units=mm), or that of {next(iter(constants))} not "
            "Pa?"
        )
