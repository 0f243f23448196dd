"""The check of a run before its first stage: what the stages use is built,
so that errors are found early.

The values of settings and their relations are checked when settings are made, see `settings.run`.
"""

from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

import torch

from ..core.dynamics.simulator import Simulator
from ..core.energies.catalogue import read_material
from ..core.energies.convex_material import ConvexMaterial
from ..core.fem.bodies import Body
from ..core.mesh.selection import vertices_at
from ..data.markers import WHOLE_STATE, MarkerMap
from ..data.trials import RESTING
from ..io.errors import InputError, naming, needs_extra, number_of
from ..learning.parameters import (
    MASS_FACTOR,
    check_names,
    check_ranges,
    command_of,
    identifiable_parameters,
)
from ..learning.residuals.networks import core_factory
from ..learning.residuals.reconstruction import make_reconstructor
from ..settings.data_kinds import RecordedData, ReleaseFromLoad
from ..settings.learning import IdentifySettings, LawSettings
from ..settings.performed import Trial
from ..settings.run import RunSettings
from .ablation import check_ablation
from .actuators import Drive, drive_of
from .build import build_body, build_material, build_simulator
from .laboratory import check_laboratory
from .recordings.reader import Reader
from .shapes import check_shape
from .simulate import substeps_of, target_settings, vertices_in
from .splits import trials_of

_ELASTIC = ("youngs_modulus", "poissons_ratio")
# Responses that leave an input where it is while commands change.
_IDLE = ("dead_band", "zero", "backlash")


def check_run(run: RunSettings) -> None:
    """Builds what the stages of a run use, without reading recordings or simulating.

    Raises:
        InputError: values do not fit the mesh, the trials or the memory.
        MeshError: the mesh cannot be read or simulated, or no vertex lies at a place.
        DataFileError: the folder has no recordings, or there is no law of this name.
    """
    for network in (run.network, run.simfree.network):
        if network.core is not None:
            core_factory(network.core)
    body = build_body(run)
    drive = drive_of(run, body)
    assert run.tip is not None
    vertices_at(body.mesh, run.tip)
    simulator = build_simulator(run, run.simulation, body)
    _check_target(run, body, drive)
    _check_sensors(run, simulator)
    if run.ablation is not None:
        check_ablation(run, simulator)
    else:
        _check_learning(run, simulator, trials_of(run))
    if run.law is not None:
        _check_law(run.law)
    if run.actuator is not None and drive is None:
        raise InputError(
            "a learned actuator needs a robot with pressures, "
            "tendons or muscles: set actuator=null."
        )
    if run.control is not None:
        with needs_extra("control", "control needs"):
            import_module("piqp")
        if drive is None:
            raise InputError(
                "control needs a robot with pressures, tendons or muscles: set control=none."
            )
        for name in () if run.identify is None else run.identify.parameters:
            if command_of(simulator, name)[1] in _IDLE:
                raise InputError(
                    f"{name} is identified, but plans need an input without dead band, zero or "
                    "backlash, which changes with every command: take it out of "
                    "identify.parameters, or set control=none."
                )


def _check_sensors(run: RunSettings, simulator: Simulator) -> None:
    """Refuses force sensors without recordings, and those on what nothing holds."""
    if run.sensors and run.recorded is None:
        raise InputError(
            "sensors are read from recordings: set sensors to {}, or take data.kind recorded."
        )
    if run.sensors and run.symmetry:
        raise InputError(
            "sensors read the whole robot, and symmetry cuts it: "
            "set sensors to {}, or simulate all of it."
        )
    for name, sensor in run.sensors.items():
        if sensor.at in simulator.energies.obstacle_names:
            if run.obstacles[str(sensor.at)].moves and any(
                axis.startswith("t") for axis in sensor.axes
            ):
                raise InputError(
                    f"sensors.{name} measures moments, but its obstacle moves, with which its "
                    "origin does not: name forces alone in axes."
                )
            continue
        if not len(simulator.fixed):
            raise InputError(
                f"sensors.{name}: nothing holds the body: name an obstacle in at, or fix vertices."
            )
        if sensor.at is not None:
            with naming(f"sensors.{name}.at: "):
                simulator.body.fixed_in(sensor.at)


def _check_target(run: RunSettings, body: Body, drive: Drive | None) -> None:
    """Checks the simulation that plays the real body,
    which is observed at the vertices of the simulator's body.
    """
    for key, target in run.targets.items():
        build_material(target.material, f"{key}.material")
        with naming(f"{key}: "):
            simulator = build_simulator(target_settings(run, target), target.material)
            played = drive_of(target, simulator.body)
        if run.recorded is not None:
            _check_drive(drive, played)
            continue
        substeps_of(run.time_step, target, key)
        with naming(f"{key}.mesh: "):
            vertices_in(simulator.body.mesh, body.mesh)
        if isinstance(run.data, ReleaseFromLoad):
            places = {"data.load": run.data.load}
            for name, loads in run.data.others.items():
                places |= {f"data.others.{name}.at": one.at for one in loads if one.at}
            for place, at in places.items():
                with naming(f"{place}: "):
                    vertices_at(simulator.body.mesh, at)


def _check_drive(drive: Drive | None, real: Drive | None) -> None:
    """Refuses a laboratory whose input is not that of the simulator."""
    simulated, played = (
        "no input"
        if one is None
        else f"{one.quantity.name} of {number_of(len(one.parts), one.per)}"
        for one in (drive, real)
    )
    if simulated != played:
        raise InputError(
            f"laboratory: its body takes {played}, but that of the simulator takes {simulated}: "
            "give both the same inputs, by chambers, tendons, muscles.commanded or energies."
        )


def _check_learning(run: RunSettings, simulator: Simulator, trials: Sequence[Trial]) -> None:
    """Checks what is learned from the trials, and how these are read or played."""
    if run.markers is not None:
        Reader(run, trials, Path())
    if run.recorded is not None:
        _check_begins(run, run.recorded, {trial.begins for trial in trials})
    if run.is_laboratory:
        check_laboratory(run, trials)
    if run.published is not None:
        build_material(run.published.simulation, "published.simulation")
    for name, shape in run.shapes.items():
        with naming(f"shapes.{name}: "):
            check_shape(shape)
    marker = MarkerMap.at_vertices(torch.zeros(1, 1, dtype=torch.int64))
    if run.reconstruction is not None:
        make_reconstructor(
            simulator, run.reconstruction, WHOLE_STATE if run.markers is None else marker
        )
    if run.identify is not None:
        with naming("identify."):
            _check_identification(
                run, run.identify, simulator, {trial.name: trial.session for trial in trials}
            )


def _check_begins(run: RunSettings, data: RecordedData, begins: set[str]) -> None:
    """Checks what is estimated of releases, and that driven trials are as long as the horizons."""
    sideways = run.release.sideways
    if sideways and begins & {"held", "released"}:
        if data.rest != "held":
            raise InputError(
                f"release.sideways is {sideways:g} m, but data.rest is {data.rest}, which gives "
                "the markers on the undeformed body: set release.sideways to 0."
            )
        if not any(run.gravity):
            raise InputError(
                "release.sideways is across gravity, "
                "but gravity is zero: set release.sideways to 0."
            )
    if begins & {*RESTING} and data.steps is not None and data.horizons:
        length = data.steps * run.time_step
        if data.horizons[-1] > length + 1e-9:
            raise InputError(
                f"data.horizons is {list(data.horizons)}: they must rise, "
                f"up to the {length:g} s of data.steps."
            )


def _check_identification(
    run: RunSettings,
    identify: IdentifySettings,
    simulator: Simulator,
    sessions: Mapping[str, str | None],
) -> None:
    if identify.integrator is not None:
        build_simulator(run.changed(integrator=identify.integrator), run.simulation, simulator.body)
    known = [
        name
        for name in identifiable_parameters(simulator)
        if run.payload_at is not None or name != MASS_FACTOR
    ]
    check_ranges(simulator, identify.parameters, known, sessions)
    with naming("first_guess: "):
        check_names(identify.first_guess, known)
    elastic = [name for name in _ELASTIC if name in known]
    if identify.elastic and not elastic:
        raise InputError(
            f"elastic is set, but the material has neither {' nor '.join(_ELASTIC)}: set it to "
            "null."
        )
    with naming("elastic: "):
        check_names(identify.elastic or (), elastic)


def _check_law(law: LawSettings) -> None:
    """Checks the identification of a law, or that a law of another run can be used."""
    with naming("law.terms: "):
        ConvexMaterial.from_parameters(dict.fromkeys(law.terms, 0.0))
    if law.file is not None:
        with naming("law: "):
            read_material(law.file)
