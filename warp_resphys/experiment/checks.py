"""Checks of a whole configuration before anything is computed, so that a slip costs no stage that comes before it."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import combinations, product
from typing import Any, cast

import numpy as np
import torch

from ..data.base_motion import OBSERVED
from ..data.markers import MarkerMap
from ..data.registration import axes_rotation
from ..dynamics.simulator import Simulator
from ..energies.base import Energy
from ..energies.materials import Material
from ..energies.tendons import OFFSETS, Tendons
from ..fem.body import Body
from ..io.errors import InputError, listed
from ..io.memory import available_memory_gib
from ..learning.parameters import MASS_FACTOR, command_of, known_parameters, parameters_of_parts
from ..learning.reconstruction import make_reconstructor
from ..mesh.mesh import select_vertices, surface_vertices
from .actuators import Drive, drive_of
from .build import build_body, build_material, build_simulator, finer, sight_of
from .files import STATIC, payload_inputs
from .identify import ELASTIC, bounds_of
from .models import SIMFREE
from .reading import standing_enough
from .scene import models_of
from .schema import IN_THE_LOOP, NAME, NETWORK, TRAINER, check, configuration_group
from .simulate import input_sequences, laboratory_settings, substeps_of, vertical
from .trials import (
    Trial,
    folds_of,
    is_laboratory,
    known_trials,
    sees_markers,
    split_of,
    trials_of,
    variation_of,
)

_LONGEST_STRETCH = 0.3  # rho g L / E from which on the size of a body is not believed
_BYTES_PER_CELL = 4_000  # that a mesh, its points and its matrix take at least
_SHARE_OF_MEMORY = 0.8
_LEAST_STEPS = 20  # of a figure that is followed


def check_configuration(config: Mapping[str, Any]) -> None:
    """Checks what is known without computing anything.

    Args:
        config: with the keys of ``conf/config.yaml``.

    Raises:
        InputError: a value of the wrong kind or out of range, an unknown key, or values that do not fit each other.
        MeshError: a mesh that cannot be read or simulated, or a place where no vertex lies.
        DataFileError: a folder without recordings.
    """
    recorded = sees_markers(config)
    if not recorded:
        variation_of(config["data"])
    elif is_laboratory(config) and config["laboratory"] is None:
        raise InputError("data.folder is not set: give the folder of the recordings.")
    check("", config, configuration_group(config))
    if config["dtype"] != "float64":
        raise InputError(f"dtype is {config['dtype']!r}: experiments need float64; float32 is for roll-outs in Python.")
    _check_memory(config)
    check_training(training_settings(config, "resphys"))
    with _naming("simfree: "):
        check_training(training_settings(config, "simfree"))
    if not recorded:
        build_material(config, "target")
    body = build_body(config)
    select_vertices(body.mesh, **config["tip"])
    simulator = build_simulator(config, body=body)
    for material in simulator.materials.values():
        _check_size(body, material, config["gravity"])
    if recorded:
        _check_recorded(config, body)
        probe = MarkerMap.at_vertices(torch.zeros(1, 1, dtype=torch.int64))
        make_reconstructor(simulator, **config["reconstruction"], markers=probe)
    elif "ablation" in config:
        _check_ablation(config, body)
    else:
        split_of(config)
        _check_base_motion(config, trials_of(config))
        if variation_of(config["data"]).key == "weights_g":
            select_vertices(body.mesh, **config["data"]["load"])
        if "modes" in config["reconstruction"]:
            raise InputError("reconstruction.modes is for bodies that are seen through markers: leave it out.")
        make_reconstructor(simulator, **config["reconstruction"])
    if config["mesh_check"] is not None:
        if not recorded:
            raise InputError("mesh_check compares markers, but markers is null: leave it null, too.")
        _check_memory({**config, "mesh": finer(config["mesh"], config["mesh_check"])})
    if config["refinement"]["kind"] != "none":
        if config["payload_string"] is not None:
            raise InputError(
                "refinement begins anew in every window, where nothing tells how a weight on a string swings: set "
                "refinement to none, or payload_string to null."
            )
        _check_refinement(config)
    if config["control"] is not None:
        _check_control(config, body)
    if config["identify"] is not None:
        if "fibre_stiffness" in config["identify"]["parameters"] and config["fibres"] is None:
            raise InputError("identify.parameters names fibre_stiffness, but fibres is null: give the simulator some.")
        hangs = config["data"].get("payload_at") is not None
        known = [name for name in known_parameters(simulator) if hangs or name != MASS_FACTOR]
        _check_identification(config["identify"], known)
        _check_parts(config["identify"], simulator)


def _check_control(config: Mapping[str, Any], body: Body) -> None:
    """Whether what is to be followed can be."""
    control, drive = config["control"], drive_of(config, body)
    if find_spec("piqp") is None:
        raise InputError("control needs a package that is not installed: pip install 'warp-resphys[control]'.")
    if not sees_markers(config) or folds_of(config) is not None or drive is None:
        raise InputError(
            "control is for a robot with markers, pressures, tendons or muscles, of one split of its trials: set "
            "control=none, or data.folds=null."
        )
    for key in ("models", "receding"):
        odd = [model for model in control[key] if model == SIMFREE or model not in models_of(config)]
        if odd:
            raise InputError(f"control.{key} has {odd[0]}: this experiment has {listed(_simulators(config))}.")
    if not {*control["receding"]} <= {*control["models"]}:
        raise InputError(f"control.receding must be among control.models, which are {listed(control['models'])}.")
    odd = [label for label in control["tracked"] if label not in config["markers"]["tracked"]]
    if odd:
        raise InputError(
            f"control.tracked names {odd[0]!r}: markers.tracked has {listed(config['markers']['tracked'])}."
        )
    limits, most = control["limits"], config["data"]["input_limit"]
    if not limits["low"] < limits["high"] or (most is not None and limits["high"] > most):
        raise InputError(
            f"control.limits are from {limits['low']:g} to {limits['high']:g}: they must rise, to data.input_limit of "
            f"{most:g} at most, which is what was learned from."
        )
    short = [seconds for seconds in control["seconds"] if seconds < _LEAST_STEPS * config["time_step"]]
    if short:
        raise InputError(f"control.seconds has {short[0]:g}: a figure takes {_LEAST_STEPS} steps at least.")
    if is_laboratory(config) and any(trial.payload for trial in trials_of(config)):
        raise InputError("control drives a robot without payloads: leave them out of laboratory.trials.")


def _simulators(config: Mapping[str, Any]) -> list[str]:
    return [model for model in models_of(config) if model != SIMFREE]


def _check_refinement(config: Mapping[str, Any]) -> None:
    steps, window = config["data"].get("steps"), config["refinement"]["window"]
    if config["network"].get("recurrent") is not None:
        raise InputError(
            "refinement begins anew in every window, and network.recurrent lives on what was before: set one of them "
            "to none, or null."
        )
    if steps is not None and window >= steps:
        raise InputError(f"refinement.window is {window}: it must be less than the data's {steps} steps.")


def _check_memory(config: Mapping[str, Any]) -> None:
    """Refuses what this machine has no memory for, before it is tried."""
    limit = _SHARE_OF_MEMORY * available_memory_gib()
    for key, group in (("mesh", config), ("laboratory.mesh", config["laboratory"] or {})):
        divisions = group.get("mesh", {}).get("divisions")
        cells = math.prod(divisions) if divisions else 0
        needed = cells * _BYTES_PER_CELL / 2**30
        if needed > limit:
            raise InputError(
                f"{key}.divisions gives {cells:,} cells, which take {needed:.3g} GiB at least, and {limit:.3g} GiB are "
                "free: take fewer."
            )
    network = config["network"]
    weights = network["blocks"] * (network["layers"] + 1) * network["width"] ** 2
    if 16 * weights / 2**30 > limit:  # weights, gradients and two moments of Adam in single precision
        raise InputError(
            f"network.width, layers and blocks make {weights:,} weights, which take {16 * weights / 2**30:.3g} GiB to "
            f"train, and {limit:.3g} GiB are free: take a smaller network."
        )


def training_settings(config: Mapping[str, Any], model: str) -> dict[str, Any]:
    """The groups ``network``, ``trainer`` and ``in_the_loop`` and the seed that a model is trained with.

    Args:
        config: the whole configuration.
        model: ``simfree``, whose own settings replace the common ones, or any other.
    """
    own = config["simfree"] if model == "simfree" else {}
    groups = {key: {**config[key], **own.get(key, {})} for key in ("network", "trainer")}
    return {**groups, "in_the_loop": None if model == "simfree" else config["in_the_loop"], "seed": config["seed"]}


def check_training(groups: Mapping[str, Any]) -> None:
    """Checks the groups that a model is trained with; see `training_settings`.

    Raises:
        InputError: a value of the wrong kind or out of range.
    """
    for key, spec in (("network", NETWORK), ("trainer", TRAINER), ("in_the_loop", IN_THE_LOOP)):
        if groups.get(key) is not None:
            check(key, groups[key], spec)
    network = groups["network"]
    if network["kind"] == "reduced":
        for key in ("position_modes", "velocity_modes", "force_modes"):
            if key not in network:
                raise InputError(f"network.{key} is missing: a reduced network needs it.")
    if network.get("recurrent") is not None and not groups["in_the_loop"] and "sequence" not in groups["trainer"]:
        raise InputError("trainer.sequence is missing: a recurrent network needs it; trainer=sequences has one.")


@contextmanager
def _naming(group: str) -> Iterator[None]:
    """Errors of the values of a group begin with its name."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{group}{error}") from error


def _check_recorded(config: Mapping[str, Any], body: Body) -> None:
    """What an experiment has that sees its bodies through markers."""
    data = config["data"]
    _check_trials(config)
    if folds_of(config) is None:
        split_of(config)
    trials = trials_of(config)
    _check_markers(config, body, {trial.begins for trial in trials})
    vertical(data["up"])
    payload_inputs(body, data["payload_at"], np.array([trial.payload for trial in trials]))
    begins = {trial.begins for trial in trials}
    if begins & {"held", "released"} and data["seconds"] is None:
        raise InputError("data.seconds is not set: say how much of each trial counts after its release, in s.")
    if "rest" in begins and data["steps"] is None:
        raise InputError("data.steps is not set: say how many steps of the simulation are read of each recording.")
    drive = drive_of(config, body)
    if drive is not None:
        _check_inputs(config, drive)
    _check_times(config, begins)
    if config["published"] is not None:
        with _naming("published."):
            build_material(config["published"], "simulation")
    if is_laboratory(config):
        _check_laboratory(config, begins, drive)
    _check_base_motion(config, trials)
    _check_release(config, begins)


def _check_markers(config: Mapping[str, Any], body: Body, begins: set[str]) -> None:
    markers = config["markers"]
    both = [label for label in markers["tracked"] if label in markers["reference"]]
    if both:
        raise InputError(
            f"the marker '{both[0]}' is in markers.tracked and markers.reference: it moves or stands still."
        )
    if not markers["tracked"]:
        raise InputError("markers.tracked is empty: name the markers that errors are measured on, with their places.")
    count, axes = len(markers["tracked"]) + len(markers["reference"]), config["data"].get("axes")
    if axes is not None:
        with _naming("data.axes: "):
            axes_rotation(axes)
    standing, enough = len(markers["reference"]), standing_enough(config)
    if count < enough:
        raise InputError(
            f"markers names {count} in all: registration needs three or more, two with data.up, or one with data.axes."
        )
    if markers.get("labels") == "assigned" and STATIC in begins and standing < enough:
        raise InputError(
            f"markers.labels is assigned, but markers.reference names {standing} markers that stand still beside a "
            f"body in a pose: it takes {enough}" + (", or data.axes and one." if axes is None else ".")
        )
    _check_sight(config)
    if markers["bind"] == "rigid" and markers["bind_to"] is None:
        raise InputError("markers.bind is rigid: set markers.bind_to to the vertices that they follow, as {x: 0.1}.")
    if markers["bind_to"] is not None:
        select_vertices(body.mesh, **markers["bind_to"])


def _check_sight(config: Mapping[str, Any]) -> None:
    """Refuses what cannot be had of markers whose places are not told."""
    markers, data, trials = config["markers"], config["data"], trials_of(config)
    tracked = [*markers["tracked"]]
    for trial in trials:
        if not trial.tracked(tracked):
            raise InputError(
                f"data.trials.{trial.name}.labels names {listed(trial.labels or ())}, none of which is in "
                f"markers.tracked: {listed(tracked)}."
            )
    everywhere = {number for trial in known_trials(config).values() for number in trial.tracked(tracked)}
    if nowhere := [label for number, label in enumerate(tracked) if number not in everywhere]:
        raise InputError(
            f"markers.tracked names {listed(nowhere)}, which no trial has by data.trials.NAME.labels: name it there, "
            "or leave it out."
        )
    if markers.get("frame") == "own":
        _check_sets(trials, tracked)
    sight = sight_of(markers, tracked, tuple({tuple(trial.tracked(tracked)) for trial in trials}))
    if sight.plane is not None and data.get("axes") is None:
        raise InputError(
            "markers.plane is set, but data.axes is not: name the axes of the recordings along which the body's x, y "
            "and z are, so that it is known which one is not seen."
        )
    moves = [data.get("base_motion"), *(each.base_motion for each in trials)]
    if sight.own and any(each is not None for each in moves):
        raise InputError("markers.frame is own, but a base_motion tells where the body is: take one of them out.")
    if not sight.is_whole and (config.get("identify") or {}).get("placement") is not None:
        raise InputError(
            "identify.placement is set, but with markers.plane, or markers.frame own, recordings do not tell where "
            "markers sit and how the body lies: set it to null."
        )


def _check_sets(trials: Sequence[Trial], tracked: Sequence[str]) -> None:
    """Refuses trials that have some markers in common, and not all, where shapes of them are compared."""
    has = {trial.name: {tracked[number] for number in trial.tracked(tracked)} for trial in trials}
    for one, other in combinations(has, 2):
        common, own = has[one] & has[other], has[one] ^ has[other]
        if common and own:
            raise InputError(
                f"the trials '{one}' and '{other}' both have {listed(sorted(common))}, but only one has "
                f"{listed(sorted(own))}: with markers.frame own they must have the same markers, or none in common."
            )


def _check_trials(config: Mapping[str, Any]) -> None:
    """Names and files of the configured trials."""
    data, laboratory = config["data"], is_laboratory(config)
    group, trials = ("laboratory", config["laboratory"]["trials"]) if laboratory else ("data", data["trials"])
    if laboratory and not trials and not data["sequences"]:
        raise InputError("laboratory.trials is empty: name each trial, or set data.sequences.")
    files: dict[str, str] = {}
    for name, trial in trials.items():
        at = f"{group}.trials.{name}"
        if not isinstance(name, str) or not NAME.fits(name):
            raise InputError(f"{at}: files are named after trials: use letters, digits, _ and -, not digits alone.")
        if laboratory:
            continue
        trial = {"file": trial} if isinstance(trial, str) else trial
        if "file" not in trial:
            raise InputError(f"{at}.file is missing: give the name of a file in data.folder.")
        other = files.setdefault(trial["file"], name)
        if other != name:
            raise InputError(f"the trials '{other}' and '{name}' have the same file, {trial['file']}: name it once.")


def _check_base_motion(config: Mapping[str, Any], trials: Sequence[Trial]) -> None:
    """How what the body is fixed to moves, if it does."""
    common, groups = config["data"].get("base_motion"), {}
    if not sees_markers(config) and (
        isinstance(common, str) or (config["data"]["kind"] == "moving_base" and not common)
    ):
        raise InputError(
            f"data.base_motion is {common!r}: where every vertex is known, it needs file, a table of poses, or swings."
        )
    if isinstance(common, str):
        if common not in OBSERVED:
            raise InputError(
                f"data.base_motion is '{common}': it must be {' or '.join(OBSERVED)}, a group with file or swings, or "
                "null."
            )
        if common == "reference" and len(config["markers"]["reference"]) < 3:
            raise InputError(
                "data.base_motion is reference: name three markers or more, not on a line, in markers.reference."
            )
    elif common is not None:
        groups["data.base_motion"] = common
    group = "laboratory" if is_laboratory(config) else "data"
    groups |= {f"{group}.trials.{each.name}.base_motion": each.base_motion for each in trials if each.base_motion}
    for key, motion in groups.items():
        if isinstance(motion, str) or ("file" in motion) == ("swings" in motion):
            raise InputError(f"{key} needs either file, a table of poses, or swings, by any names.")
        if "swings" in motion and not motion["swings"]:
            raise InputError(
                f"{key}.swings is empty: give it at least one, as {{a: {{frequency: 1.0, translation: [0.01, 0, 0]}}}}."
            )
        for name, swing in motion.get("swings", {}).items():
            if 2.0 * swing["frequency"] * config["time_step"] >= 1.0:
                raise InputError(
                    f"{key}.swings.{name}.frequency is {swing['frequency']:g}: steps of {config['time_step']:g} s "
                    f"follow less than {0.5 / config['time_step']:g} Hz."
                )
    for each in trials:
        if each.begins == STATIC and (common is not None or each.base_motion):
            raise InputError(f"the trial '{each.name}' is a pose, which has no time: its base cannot move.")


def _check_release(config: Mapping[str, Any], begins: set[str]) -> None:
    sideways = config["release"]["sideways"]
    if not begins & {"held", "released"} or sideways == 0.0:
        return
    if config["data"]["rest"] != "held":
        raise InputError(
            f"release.sideways is {sideways:g} m, but data.rest is {config['data']['rest']}: that "
            "tells where the markers are on the undeformed body, so set release.sideways to 0."
        )
    if not np.any(config["gravity"]):
        raise InputError("release.sideways is across gravity, but gravity is zero: set release.sideways to 0.")


def _check_inputs(config: Mapping[str, Any], drive: Drive) -> None:
    data, count = config["data"], len(drive.parts)
    if data["input_limit"] is None:
        raise InputError(f"data.input_limit is not set: say what the {drive.per}s take, in {drive.quantity.unit}.")
    if data["parts"] is not None and max(data["parts"]) > count:
        raise InputError(f"data.parts names {drive.per} {max(data['parts'])}, but the body has {count}.")
    scales = data["input_scales"]
    if 1.0 in scales or len({*scales}) < len(scales):
        raise InputError(f"data.input_scales is {scales}: give different ones, none of them 1, which is always tested.")
    if scales and not is_laboratory(config):
        raise InputError(
            "data.input_scales raises the inputs of simulated trials, and recordings have their own: leave it empty."
        )
    if scales and data["folds"]:
        raise InputError("data.input_scales and data.folds exclude each other: take one of them out.")


def _check_times(config: Mapping[str, Any], begins: set[str]) -> None:
    """What the length of driven trials has to fit."""
    data, step = config["data"], config["time_step"]
    if "rest" in begins:
        length, horizons = data["steps"] * step, data["horizons"]
        if horizons and (horizons != sorted({*horizons}) or horizons[-1] > length + 1e-9):
            raise InputError(f"data.horizons is {horizons}: they must rise, up to the {length:g} s of data.steps.")
    if data["cutoff"] is not None and not data["cutoff"] < 0.5 / step:
        raise InputError(
            f"data.cutoff is {data['cutoff']:g} Hz: it must be below {0.5 / step:g} Hz, half of the steps."
        )


def _check_laboratory(config: Mapping[str, Any], begins: set[str], drive: Drive | None) -> None:
    laboratory, data = config["laboratory"], config["data"]
    with _naming("laboratory."):
        material = build_material(laboratory, "material")
    for trial in trials_of(config):
        if trial.pull is not None and data["rest"] != "file":
            raise InputError(
                f"laboratory.trials.{trial.name}.pull deforms the body before its release: set data.rest to file, so "
                "that the recordings tell where markers are on the undeformed body."
            )
    if data["rest"] == "file" and any(trial.pull is None and trial.begins == "held" for trial in trials_of(config)):
        raise InputError("data.rest is file, but simulated bodies are held undeformed: set it to held.")
    if begins & {"held", "released"}:
        for key in ("seconds", "held_seconds"):
            if laboratory.get(key) is None:
                raise InputError(f"laboratory.{key} is missing: trials that are let go need it.")
        if laboratory["seconds"] < data["seconds"]:
            raise InputError(
                f"laboratory.seconds is {laboratory['seconds']}, less than data.seconds ({data['seconds']}): "
                "follow the body for as long as it counts."
            )
    if "rest" in begins:
        substeps_of(config)
        if drive is not None:
            steps, random = data["steps"], np.random.default_rng(0)
            input_sequences(config).draw(steps, config["time_step"], len(drive.parts), random)
    with _naming("laboratory: "):
        body = build_body(laboratory_settings(config))
    _check_size(body, material, config["gravity"])


def _check_size(body: Body, material: Material, gravity: Sequence[float]) -> None:
    """Refuses a body that would sag under its own weight beyond belief, as one whose unit was mistaken does.

    A body of length L under its weight has strains of rho g L / E: a percent for an arm of silicone.
    """
    length = float(np.linalg.norm(np.ptp(np.asarray(body.mesh.vertices), axis=0)))
    constants = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in material.constants.items()}
    each = zip(material.moduli(constants), material.curvature, material.rules, strict=True)
    shear = 0.5 * sum(float(modulus.mean()) * factor for modulus, factor, rule in each if rule == "shape")
    density = float(constants["density"].mean())
    stiffness = float(constants["youngs_modulus"].mean()) if "youngs_modulus" in constants else 3.0 * shear
    strain = density * float(np.linalg.norm(gravity)) * length / stiffness
    if strain > _LONGEST_STRETCH:
        raise InputError(
            f"the mesh is {length:.3g} m across: with E = {1e-3 * stiffness:.3g} kPa its own weight would strain it by "
            f"{100.0 * strain:.0f} %; is its unit millimetres (mesh.units=mm), or that of {next(iter(constants))} not "
            "Pa?"
        )


def _check_identification(identify: Mapping[str, Any], known: Sequence[str]) -> None:
    """Checks the group ``identify``, given the parameters that may be identified."""
    parameters = {name: each for name, each in identify["parameters"].items() if each is not None}
    if not parameters:
        raise InputError(f"identify.parameters is empty: give a range of one or more of {', '.join(known)}.")
    elastic = [name for name in ELASTIC if name in known]
    for group, choice in (("parameters", known), ("elastic", elastic), ("grid", elastic)):
        for name, settings in (identify.get(group) or {}).items():
            if settings is None:
                continue
            if name not in choice:
                instead = f"choose from {', '.join(choice)}" if choice else f"set identify.{group} to null"
                raise InputError(f"identify.{group} names '{name}': {instead}.")
            with _naming(f"identify.{group}.{name}: "):
                bounds_of(settings)
            if command_of(name)[1] in ("delay", "rise") and settings["lower"] < 0.0:
                raise InputError(
                    f"identify.{group}.{name}.lower is {settings['lower']:g}: nothing comes before its command, so it "
                    "must be zero or more, in s; data.trials.NAME.onset says when a command comes."
                )
    for name, value in identify["first_guess"].items():
        within = parameters.get(name)
        if name not in known:
            raise InputError(f"identify.first_guess names '{name}': choose from {', '.join(known)}.")
        if within is not None and not within["lower"] <= value <= within["upper"]:
            raise InputError(
                f"identify.first_guess.{name} is {value!r}: it must be a number from {within['lower']:g} to "
                f"{within['upper']:g}, its range."
            )


def _check_parts(identify: Mapping[str, Any], simulator: Simulator) -> None:
    """Checks parameters of parts, and where the ends of their ranges take tendons."""
    names = [name for name, each in identify["parameters"].items() if each is not None]
    of_parts = parameters_of_parts(simulator)
    for whole in names:
        parts = [name for name, (each, _) in of_parts.items() if each == whole]
        if parts and set(parts) <= set(names):
            raise InputError(f"identify.parameters names {whole} and it of every part, {', '.join(parts)}: choose one.")
    found = [each for each in cast(Sequence[Energy], simulator.body.energies) if isinstance(each, Tendons)]
    for tendons, name in product(found, names):
        whole, part = of_parts.get(name, (name, None))
        for number, quantity in enumerate(OFFSETS[: tendons.offset_count]):
            for end in ("lower", "upper") if quantity.name == whole else ():
                offsets = np.zeros((tendons.count, tendons.offset_count))
                offsets[slice(None) if part is None else part, number] = identify["parameters"][name][end]
                with _naming(f"identify.parameters.{name}.{end}: "):
                    tendons.rerouted(offsets).points(simulator.body.mesh)


def _check_ablation(config: Mapping[str, Any], body: Body) -> None:
    """What the marker ablation has of its own."""
    counts, surface = config["ablation"]["counts"], len(surface_vertices(body.mesh))
    if max(counts) > surface:
        raise InputError(
            f"ablation.counts asks for {max(counts)} markers, but the mesh has {surface} surface vertices: "
            "ask for fewer, or refine the mesh."
        )
    observed = config["data"]["weights_g"].get("observed")
    if not isinstance(observed, list) or len(observed) != 1 or not 0.0 < observed[0] < np.inf:
        raise InputError(f"data.weights_g.observed is {observed!r}: it must be a list of one positive weight, in g.")
    probe = MarkerMap.at_vertices(torch.zeros(1, 1, dtype=torch.int64))
    modes = config["ablation"]["modes"]
    make_reconstructor(build_simulator(config), **config["reconstruction"], modes=modes, markers=probe)
