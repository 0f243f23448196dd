"""Checks of a run that need its mesh or its trials, made before the first stage so that errors are found early.

The values of settings and their relations are checked when settings are made, see `settings.run`.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import combinations, product
from typing import cast

import numpy as np
import torch

from ..data.input_response import SLOPES
from ..data.markers import MarkerMap
from ..data.registration import axes_rotation
from ..dynamics.simulator import Simulator
from ..energies.base import Energy
from ..energies.law_files import read_law
from ..energies.materials import ConvexMaterial, Material
from ..energies.tendons import OFFSETS, Tendons
from ..fem.body import Body
from ..io.errors import InputError, listed
from ..io.memory import available_memory_gib
from ..learning.parameters import MASS_FACTOR, command_of, identifiable_parameters, parameters_of_parts
from ..learning.reconstruction import make_reconstructor
from ..mesh.mesh import select_vertices, surface_vertices
from ..settings.body import MaterialSettings
from ..settings.learning import IdentifySettings, LawSettings
from ..settings.mesh import HexahedralBox, MeshSettings, TetrahedralBox
from ..settings.run import RunSettings
from ..settings.stages import PlayedSettings
from ..settings.trials import MarkerSettings, RecordedData, ReleaseFromLoad, Trial
from .actuators import Drive, drive_of
from .build import build_body, build_material, build_simulator, finer, marker_view_of
from .experiment import LAW
from .files import STATIC, payload_inputs
from .identify import ELASTIC
from .laboratory import input_sequences
from .reading import standing_enough
from .shapes import check_shape
from .target import substeps_of, target_settings, vertices_in
from .trials import all_trials, folds_of, split_of, trials_of

_LARGEST_STRAIN = 0.3  # rho g L / E above which a wrong unit is assumed
_BYTES_PER_CELL = 4_000  # lower bound for the mesh, its points and its matrix
_SHARE_OF_MEMORY = 0.8


def check_run(run: RunSettings) -> None:
    """Checks the settings of a run against its mesh, its trials and the memory.

    Raises:
        InputError: values do not fit the mesh, the trials or the memory.
        MeshError: the mesh cannot be read or simulated, or no vertex lies at a place.
        DataFileError: the folder has no recordings.
    """
    _check_memory(run)
    body = build_body(run, run.payload_at)
    select_vertices(body.mesh, **run.tip.arguments())
    simulator = build_simulator(run, run.simulation, body)
    for material in simulator.materials.values():
        _check_size(body, material, run.gravity)
    if isinstance(run.data, RecordedData) and run.markers is not None:
        _check_recorded(run, run.data, run.markers, body)
        _check_reconstruction(run, simulator)
    elif run.ablation is not None:
        _check_ablation(run, simulator)
    else:
        _check_simulated(run, simulator)
    if run.law is not None:
        _check_law(run, run.law)
    if run.mesh_check is not None:
        _check_memory(run.model_copy(update={"mesh": finer(run.mesh, run.mesh_check)}))
    if run.control is not None:
        _check_control(run, body)
    if run.identify is not None:
        names = [
            name for name in identifiable_parameters(simulator) if run.payload_at is not None or name != MASS_FACTOR
        ]
        _check_identification(run.identify, names, simulator)
        _check_parts(run.identify, simulator)


def _check_law(run: RunSettings, law: LawSettings) -> None:
    """Checks the identification of a law, or that a law of another run can be used."""
    if run.simulation.regions:
        raise InputError("law: the simulator has materials by region, and one law is for one material: leave law out.")
    with _naming("law.terms: "):
        ConvexMaterial.from_constants(dict.fromkeys(law.terms, 0.0))
    if run.simulation.model == LAW and law.file is None:
        raise InputError(
            "law: simulation.model is law already: identify its constants in identify.parameters, or take another one."
        )
    if law.file is not None:
        given = read_law(law.file)
        material = MaterialSettings.model_validate({"model": given["model"], **given["constants"]})
        build_material(material, f"law: {law.file}")


def _check_simulated(run: RunSettings, simulator: Simulator) -> None:
    """Checks an experiment with simulated trials, in which all vertices are observed."""
    split_of(run)
    _check_target(run, simulator.body)
    for name, shape in run.shapes.items():
        with _naming(f"shapes.{name}: "):
            check_shape(shape)
    make_reconstructor(simulator, **dict(run.reconstruction))


def _check_target(run: RunSettings, body: Body) -> None:
    """Checks the simulation that plays the real body, which is observed at the vertices of the simulator's body."""
    for key, target in run.targets.items():
        build_material(target.material, f"{key}.material")
        with _naming(f"{key}: "):
            simulator = build_simulator(target_settings(run, target), target.material, payload_at=run.payload_at)
        for material in simulator.materials.values():
            _check_size(simulator.body, material, run.gravity)
        if run.recorded is not None:
            _check_drive(drive_of(run, body), drive_of(target, simulator.body))
            continue
        substeps_of(run.time_step, target, key)
        with _naming(f"{key}.mesh: "):
            vertices_in(simulator.body.mesh, body.mesh)
        if isinstance(run.data, ReleaseFromLoad):
            places = {f"data.others.{name}.at": held.at for name, held in run.data.others.items() if held.at}
            for place, at in {"data.load": run.data.load, **places}.items():
                with _naming(f"{place}: "):
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
            "inputs, by chambers, tendons or muscles.commanded."
        )


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
    if run.is_laboratory and any(trial.payload for trial in trials_of(run)):
        raise InputError("control does not support payloads: remove them from laboratory.trials.")


def _check_memory(run: RunSettings) -> None:
    """Refuses meshes and networks that do not fit into the free memory."""
    limit = _SHARE_OF_MEMORY * available_memory_gib()
    meshes: dict[str, MeshSettings] = {f"{key}mesh": body.mesh for key, body in run.bodies.items()}
    for key, body in run.bodies.items():
        meshes |= {f"{key}parts.{name}.mesh": part.mesh for name, part in body.parts.items()}
    for key, mesh in meshes.items():
        cells = math.prod(mesh.divisions) if isinstance(mesh, HexahedralBox | TetrahedralBox) else 0
        needed = cells * _BYTES_PER_CELL / 2**30
        if needed > limit:
            raise InputError(
                f"{key}.divisions gives {cells:,} cells, which take at least {needed:.3g} GiB, but {limit:.3g} GiB are "
                "free: use fewer."
            )
    network = run.network
    weights = network.blocks * (network.layers + 1) * network.width**2
    if 16 * weights / 2**30 > limit:  # weights, gradients and two moments of Adam in single precision
        raise InputError(
            f"network.width, layers and blocks make {weights:,} weights, which take {16 * weights / 2**30:.3g} GiB to "
            f"train, but {limit:.3g} GiB are free: use a smaller network."
        )


@contextmanager
def _naming(group: str) -> Iterator[None]:
    """Prefixes errors with the name of a group."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{group}{error}") from error


def _check_recorded(run: RunSettings, data: RecordedData, markers: MarkerSettings, body: Body) -> None:
    """Checks an experiment that observes its bodies through markers."""
    if run.is_laboratory and run.laboratory is not None and not run.laboratory.trials and not data.sequences:
        raise InputError("laboratory.trials is empty: name the trials, or set data.sequences.")
    _check_files(data)
    if folds_of(run) is None:
        split_of(run)
    trials = trials_of(run)
    begins = {trial.begins for trial in trials}
    _check_markers(run, data, markers, body, begins)
    _check_view(run, markers, trials)
    payload_inputs(body, data.payload_at, np.array([trial.payload for trial in trials]))
    if begins & {"held", "released"} and data.seconds is None:
        raise InputError("data.seconds is not set: give the time after the release of each trial that is used, in s.")
    if "rest" in begins and data.steps is None:
        raise InputError("data.steps is not set: give the number of time steps that are read from each recording.")
    drive = drive_of(run, body)
    if drive is not None:
        _check_inputs(data, drive)
    if "rest" in begins and data.steps is not None and data.horizons:
        length = data.steps * run.time_step
        if data.horizons[-1] > length + 1e-9:
            raise InputError(
                f"data.horizons is {list(data.horizons)}: they must rise, up to the {length:g} s of data.steps."
            )
    if run.published is not None:
        build_material(run.published.simulation, "published.simulation")
    if run.is_laboratory:
        _check_laboratory(run, data, trials, body, drive)
    for trial in trials:
        if trial.begins == STATIC and (data.base_motion is not None or trial.base_motion is not None):
            raise InputError(f"the trial '{trial.name}' is a static pose: its base cannot move.")
    if begins & {"held", "released"}:
        _check_release(run, data)


def _check_files(data: RecordedData) -> None:
    """Refuses a file that is used by two trials."""
    files: dict[str, str] = {}
    for name, trial in data.trials.items():
        if trial.file is not None and (other := files.setdefault(trial.file, name)) != name:
            raise InputError(f"the trials '{other}' and '{name}' have the same file, {trial.file}: use it once.")


def _check_markers(run: RunSettings, data: RecordedData, markers: MarkerSettings, body: Body, begins: set[str]) -> None:
    if data.axes is not None:
        with _naming("data.axes: "):
            axes_rotation(data.axes)
    count, standing = len(markers.tracked) + len(markers.reference), len(markers.reference)
    enough = standing_enough(data, run.gravity)
    if count < enough:
        raise InputError(
            f"markers names {count} in total: registration needs at least 3, or 2 with data.up, or 1 with data.axes."
        )
    if markers.labels == "assigned" and STATIC in begins and standing < enough:
        raise InputError(
            f"markers.labels is assigned, but markers.reference names {standing}: static poses need {enough} "
            "reference markers" + (", or data.axes and one." if data.axes is None else ".")
        )
    if markers.bind_to is not None:
        select_vertices(body.mesh, **markers.bind_to.arguments())


def _check_view(run: RunSettings, markers: MarkerSettings, trials: Sequence[Trial]) -> None:
    """Checks the markers of the trials."""
    tracked = [*markers.tracked]
    for trial in trials:
        if not trial.tracked(tracked):
            raise InputError(
                f"data.trials.{trial.name}.labels names {listed(trial.labels or ())}, none of which is in "
                f"markers.tracked: {listed(tracked)}."
            )
    everywhere = {number for trial in all_trials(run).values() for number in trial.tracked(tracked)}
    if nowhere := [label for number, label in enumerate(tracked) if number not in everywhere]:
        raise InputError(
            f"markers.tracked names {listed(nowhere)}, which no trial has in data.trials.NAME.labels: add it there, "
            "or leave it out."
        )
    if markers.frame == "own":
        _check_sets(trials, tracked)
    marker_view_of(markers, tracked, tuple({tuple(trial.tracked(tracked)) for trial in trials}))


def _check_sets(trials: Sequence[Trial], tracked: Sequence[str]) -> None:
    """Refuses trials that have some but not all markers in common, if markers are seen in their own frame."""
    has = {trial.name: {tracked[number] for number in trial.tracked(tracked)} for trial in trials}
    for one, other in combinations(has, 2):
        common, single = has[one] & has[other], has[one] ^ has[other]
        if common and single:
            raise InputError(
                f"the trials '{one}' and '{other}' both have {listed(sorted(common))}, but only one has "
                f"{listed(sorted(single))}: with markers.frame own they must have the same markers, or none in common."
            )


def _check_release(run: RunSettings, data: RecordedData) -> None:
    sideways = run.release.sideways
    if sideways == 0.0:
        return
    if data.rest != "held":
        raise InputError(
            f"release.sideways is {sideways:g} m, but data.rest is {data.rest}, which gives the markers on the "
            "undeformed body: set release.sideways to 0."
        )
    if not any(run.gravity):
        raise InputError("release.sideways is across gravity, but gravity is zero: set release.sideways to 0.")


def _check_inputs(data: RecordedData, drive: Drive) -> None:
    count = len(drive.parts)
    if data.input_limit is None:
        raise InputError(
            f"data.input_limit is not set: give the largest input of the {drive.per}s, in {drive.quantity.unit}."
        )
    if data.parts is not None and max(data.parts) > count:
        raise InputError(f"data.parts names {drive.per} {max(data.parts)}, but the body has {count}.")


def _check_laboratory(
    run: RunSettings, data: RecordedData, trials: Sequence[Trial], body: Body, drive: Drive | None
) -> None:
    laboratory, begins = run.laboratory, {trial.begins for trial in trials}
    assert laboratory is not None
    for trial in trials:
        if trial.pull is not None and data.rest != "file":
            raise InputError(
                f"laboratory.trials.{trial.name}.pull deforms the body before its release: set data.rest to file, so "
                "that the recordings have the markers on the undeformed body."
            )
    if data.rest == "file" and any(trial.pull is None and trial.begins == "held" for trial in trials):
        raise InputError("data.rest is file, but the simulated bodies are held undeformed: set it to held.")
    if begins & {"held", "released"}:
        for key in ("seconds", "held_seconds"):
            if getattr(laboratory, key) is None:
                raise InputError(f"laboratory.{key} is missing: released trials need it.")
        if (laboratory.seconds or 0.0) < (data.seconds or 0.0):
            raise InputError(
                f"laboratory.seconds is {laboratory.seconds}, less than data.seconds ({data.seconds}): record at "
                "least as long as the data are used."
            )
    played = PlayedSettings.of(run, files={})
    if "rest" in begins and data.steps is not None:
        substeps_of(run.time_step, laboratory, "laboratory")
        if drive is not None:
            random = np.random.default_rng(0)
            input_sequences(played).draw(data.steps, run.time_step, len(drive.parts), random)
    _check_target(run, body)


def _check_size(body: Body, material: Material, gravity: Sequence[float]) -> None:
    """Refuses a body with very large strains under its own weight, which indicate a wrong unit.

    A body of length L under its weight has strains of about rho g L / E: one percent for an arm of silicone.
    """
    length = float(np.linalg.norm(np.ptp(np.asarray(body.mesh.vertices), axis=0)))
    constants = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in material.constants.items()}
    terms = zip(material.moduli(constants), material.curvature, material.rules, strict=True)
    shear = 0.5 * sum(float(modulus.mean()) * factor for modulus, factor, rule in terms if rule == "shape")
    density = float(constants["density"].mean())
    stiffness = float(constants["youngs_modulus"].mean()) if "youngs_modulus" in constants else 3.0 * shear
    strain = density * float(np.linalg.norm(gravity)) * length / stiffness
    if strain > _LARGEST_STRAIN:
        raise InputError(
            f"the mesh is {length:.3g} m across: with E = {1e-3 * stiffness:.3g} kPa its own weight would strain it by "
            f"{100.0 * strain:.0f} %; is its unit millimetres (mesh.units=mm), or that of {next(iter(constants))} not "
            "Pa?"
        )


def _check_identification(identify: IdentifySettings, identifiable: Sequence[str], simulator: Simulator) -> None:
    """Checks the group ``identify``, for the names of the identifiable parameters."""
    if not identify.parameters:
        raise InputError(f"identify.parameters is empty: give a range for at least one of {', '.join(identifiable)}.")
    elastic = [name for name in ELASTIC if name in identifiable]
    grid = () if identify.grid is None else [name for name, axis in dict(identify.grid).items() if axis is not None]
    for group, names, choice in (
        ("parameters", identify.parameters, identifiable),
        ("elastic", identify.elastic or (), elastic),
        ("grid", grid, elastic),
        ("first_guess", identify.first_guess, identifiable),
    ):
        for name in names:
            if name not in choice:
                instead = f"choose from {', '.join(choice)}" if choice else f"set identify.{group} to null"
                raise InputError(f"identify.{group} names '{name}': {instead}.")
    for name, limits in identify.parameters.items():
        word = command_of(simulator, name)[1]
        if word == "slew" and limits.lower < 0.0:
            raise InputError(
                f"identify.parameters.{name}.lower is {limits.lower:g}: slew rates are positive, so it must be zero "
                "or more, in s by the unit of the input."
            )
        if word in SLOPES and limits.lower < 0.0:
            raise InputError(
                f"identify.parameters.{name}.lower is {limits.lower:g}: a characteristic curve does not fall, so it "
                "must be zero or more."
            )
        if word in ("delay", "rise") and limits.lower < 0.0:
            raise InputError(
                f"identify.parameters.{name}.lower is {limits.lower:g}: inputs cannot precede their command, so it "
                "must be zero or more, in s; data.trials.NAME.onset is the time of a command."
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
                with _naming(f"identify.parameters.{name}.{end}: "):
                    tendons.rerouted(offsets).points(simulator.body.mesh)


def _check_ablation(run: RunSettings, simulator: Simulator) -> None:
    """Checks the marker ablation."""
    assert run.ablation is not None
    _check_target(run, simulator.body)
    counts, surface = run.ablation.counts, len(surface_vertices(simulator.body.mesh))
    if max(counts) > surface:
        raise InputError(
            f"ablation.counts asks for {max(counts)} markers, but the mesh has {surface} surface vertices: use "
            "fewer, or refine the mesh."
        )
    _check_reconstruction(run, simulator, run.ablation.modes)
