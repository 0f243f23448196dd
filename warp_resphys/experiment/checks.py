"""Checks of a run that need its mesh or its trials, made before the first stage so that errors are found early.

The values of settings and their relations are checked when settings are made, see `settings.run`.
"""

from collections.abc import Sequence
from importlib.util import find_spec
from itertools import product
from typing import cast

import numpy as np
import torch

from ..data.input_response import SLOPES
from ..data.markers import MarkerMap
from ..dynamics.simulator import Simulator
from ..energies.base import Energy
from ..energies.catalogue import read_law
from ..energies.convex_material import ConvexMaterial
from ..energies.tendons import OFFSETS, Tendons
from ..fem.bodies import Body
from ..io.errors import InputError, naming
from ..learning.parameters import MASS_FACTOR, command_of, identifiable_parameters, parameters_of_parts
from ..learning.residuals.networks import core_factory
from ..learning.residuals.reconstruction import make_reconstructor
from ..mesh.selection import select_vertices
from ..mesh.volume_mesh import surface_vertices
from ..settings.body import MaterialSettings
from ..settings.data_kinds import RecordedData, ReleaseFromLoad
from ..settings.learning import IdentifySettings, LawSettings
from ..settings.run import RunSettings
from .actuators import Drive, check_drive, drive_of
from .build import build_body, build_material, build_simulator
from .recordings.recorded_checks import check_recorded
from .shapes import check_shape
from .simulate import substeps_of, target_settings, vertices_in
from .splits import split_of

_ELASTIC = ("youngs_modulus", "poissons_ratio")
_NOT_NEGATIVE = ("delay", "rise", "slew", "dead_band", "backlash", *SLOPES)  # of identified input responses


def check_run(run: RunSettings) -> None:
    """Checks the settings of a run against its mesh, its trials and the memory.

    Raises:
        InputError: values do not fit the mesh, the trials or the memory.
        MeshError: the mesh cannot be read or simulated, or no vertex lies at a place.
        DataFileError: the folder has no recordings.
    """
    for prefix, settings in run.bodies.items():
        with naming(prefix):
            check_drive(settings)
    for network in (run.network, run.simfree.network):
        if network.core is not None:
            core_factory(network.core)
    body = build_body(run, run.payload_at)
    assert run.tip is not None
    select_vertices(body.mesh, **run.tip.arguments())
    simulator = build_simulator(run, run.simulation, body)
    _check_target(run, body)
    if isinstance(run.data, RecordedData) and run.markers is not None:
        check_recorded(run, run.data, run.markers, body)
        _check_reconstruction(run, simulator)
    elif run.ablation is not None:
        _check_ablation(run, simulator)
    else:
        _check_simulated(run, simulator)
    if run.law is not None:
        _check_law(run.law)
    if run.control is not None:
        _check_control(run, body)
    if run.identify is not None:
        names = [
            name for name in identifiable_parameters(simulator) if run.payload_at is not None or name != MASS_FACTOR
        ]
        if run.identify.integrator is not None:
            with naming("identify."):
                build_simulator(run.changed(integrator=run.identify.integrator), run.simulation, body)
        _check_identification(run.identify, names, simulator)
        _check_parts(run.identify, simulator)


def _check_law(law: LawSettings) -> None:
    """Checks the identification of a law, or that a law of another run can be used."""
    with naming("law.terms: "):
        ConvexMaterial.from_parameters(dict.fromkeys(law.terms, 0.0))
    if law.file is not None:
        given = read_law(law.file)
        material = MaterialSettings.model_validate({"model": given["model"], **given["parameters"]})
        build_material(material, f"law: {law.file}")


def _check_simulated(run: RunSettings, simulator: Simulator) -> None:
    """Checks an experiment with simulated trials, in which all vertices are observed."""
    split_of(run)
    for name, shape in run.shapes.items():
        with naming(f"shapes.{name}: "):
            check_shape(shape)
    make_reconstructor(simulator, **dict(run.reconstruction))


def _check_reconstruction(run: RunSettings, simulator: Simulator, modes: int | None = None) -> None:
    """Checks the settings of the reconstruction by making one with a single marker."""
    probe = MarkerMap.at_vertices(torch.zeros(1, 1, dtype=torch.int64))
    more = {} if modes is None else {"modes": modes}
    make_reconstructor(simulator, **dict(run.reconstruction) | more, observation=probe)


def _check_control(run: RunSettings, body: Body) -> None:
    """Checks that the robot can be controlled."""
    if find_spec("piqp") is None:
        raise InputError("control needs a package that is not installed: pip install 'warp-resphys[control]'.")
    if drive_of(run, body) is None:
        raise InputError("control needs a robot with pressures, tendons or muscles: set control=none.")


def _check_identification(identify: IdentifySettings, identifiable: Sequence[str], simulator: Simulator) -> None:
    """Checks the group ``identify``, for the names of the identifiable parameters."""
    if not identify.parameters:
        raise InputError(f"identify.parameters is empty: give a range for at least one of {', '.join(identifiable)}.")
    elastic = [name for name in _ELASTIC if name in identifiable]
    for group, names, choice in (
        ("parameters", identify.parameters, identifiable),
        ("elastic", identify.elastic or (), elastic),
        ("first_guess", identify.first_guess, identifiable),
    ):
        for name in names:
            if name not in choice:
                instead = f"choose from {', '.join(choice)}" if choice else f"set identify.{group} to null"
                raise InputError(f"identify.{group} names '{name}': {instead}.")
    for name, limits in identify.parameters.items():
        word = command_of(simulator, name)[1]
        if word in _NOT_NEGATIVE and limits.lower < 0.0:
            raise InputError(
                f"identify.parameters.{name}.lower is {limits.lower:g}: a {word.replace('_', ' ')} is not negative: "
                "set it to zero or more."
            )


def _check_parts(identify: IdentifySettings, simulator: Simulator) -> None:
    """Checks parameters of parts, and the routes of tendons at the limits of their ranges."""
    names, of_parts = [*identify.parameters], parameters_of_parts(simulator)
    for whole in names:
        parts = [name for name, (parameter, _) in of_parts.items() if parameter == whole]
        if parts and set(parts) <= set(names):
            raise InputError(f"identify.parameters names {whole} and its parts, {', '.join(parts)}: choose one.")
    groups = [energy for energy in cast(Sequence[Energy], simulator.body.energies) if isinstance(energy, Tendons)]
    for tendons, (name, range_) in product(groups, identify.parameters.items()):
        whole, part = of_parts.get(name, (name, None))
        for number, quantity in enumerate(OFFSETS[: tendons.offset_count]):
            for end in ("lower", "upper") if quantity.name == whole else ():
                offsets = np.zeros((tendons.count, tendons.offset_count))
                offsets[slice(None) if part is None else part, number] = getattr(range_, end)
                with naming(f"identify.parameters.{name}.{end}: "):
                    tendons.rerouted(offsets).points(simulator.body.mesh)


def _check_ablation(run: RunSettings, simulator: Simulator) -> None:
    """Checks the marker ablation."""
    assert run.ablation is not None
    counts, surface = run.ablation.counts, len(surface_vertices(simulator.body.mesh))
    if max(counts) > surface:
        raise InputError(
            f"ablation.counts asks for {max(counts)} markers, but the mesh has {surface} surface vertices: use "
            "fewer, or refine the mesh."
        )
    _check_reconstruction(run, simulator, run.ablation.modes)


def _check_target(run: RunSettings, body: Body) -> None:
    """Checks the simulation that plays the real body, which is observed at the vertices of the simulator's body."""
    for key, target in run.targets.items():
        build_material(target.material, f"{key}.material")
        with naming(f"{key}: "):
            simulator = build_simulator(target_settings(run, target), target.material, payload_at=run.payload_at)
        if run.recorded is not None:
            _check_drive(drive_of(run, body), drive_of(target, simulator.body))
            continue
        substeps_of(run.time_step, target, key)
        with naming(f"{key}.mesh: "):
            vertices_in(simulator.body.mesh, body.mesh)
        if isinstance(run.data, ReleaseFromLoad):
            others = run.data.others.items()
            places = {f"data.others.{name}.at": one.at for name, held in others for one in held if one.at}
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
