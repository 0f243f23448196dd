"""Checks of the groups that experiments on recordings have, before any of them is read."""

import inspect
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ...data.markers import KINDS, MarkerMap
from ...data.recordings.recording import METRES_PER_UNIT
from ...dynamics.integrator import INTEGRATORS
from ...fem.body import MASS_MODES
from ...fem.elements import VOLUME_INTEGRATIONS
from ...io.errors import InputError
from ...learning.identification import Bounds
from ...learning.markers_in_the_loop import check_in_the_loop
from ...learning.replay import known_parameters
from ...learning.sparse_reconstruction import make_sparse_reconstructor
from ...mesh.mesh import select_vertices
from ..build import build_body, build_material, build_mesh, build_simulator
from ..kinds import (
    COUNT,
    FINITE,
    GROUP,
    NATURAL,
    NOT_NEGATIVE,
    POSITIVE,
    TRUTH_VALUE,
    WORD,
    Kind,
    check_keys,
    is_finite,
    is_number,
    is_word,
    one_of,
    optional,
)
from ..trajectories import SPLITS
from .files import attached_mass
from .identify import ELASTIC
from .trials import FOLDS, folds_of, is_synthetic, split_of, trials_of, vertical

RECORDINGS = "recordings"  # this kind of data
_NAME = r"[\w-]+"


def _is_place(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(is_finite, value))


_NAMES = Kind(lambda value: isinstance(value, list) and all(map(is_word, value)), "a list of names of trials")
_SPLIT = dict.fromkeys(SPLITS, _NAMES)
_UP = Kind(
    lambda value: is_word(value) or _is_place(value), "x, -x, y, -y, z, -z, three numbers, or null", optional=True
)

_KEYS: Mapping[str, Mapping[str, Kind]] = {
    "data": {
        "kind": WORD,
        "folder": optional(WORD),
        "units": optional(one_of(*METRES_PER_UNIT)),
        "rate": optional(POSITIVE),
        "trials": GROUP,
        "hung_on": optional(GROUP),
        "up": _UP,
        "begins": one_of("held", "released"),
        "rest": one_of("held", "file"),
        "seconds": POSITIVE,
        "longest_gap": COUNT,
        "folds": optional(one_of(*FOLDS)),
        **_SPLIT,
    },
    "markers": {
        "followed": GROUP,
        "others": GROUP,
        "bind": one_of(*KINDS),
        "bind_to": optional(GROUP),
        "largest_residual": POSITIVE,
        "largest_distance": POSITIVE,
        "largest_distortion": POSITIVE,
        "largest_shift": optional(POSITIVE),
    },
    "synthetic": {
        "mesh": GROUP,
        "time_step": POSITIVE,
        "integrator": one_of(*INTEGRATORS),
        "material": GROUP,
        "rate": POSITIVE,
        "noise": NOT_NEGATIVE,
        "misplaced": NOT_NEGATIVE,
        "tilt": Kind(lambda value: is_finite(value) and 0.0 <= value <= 20.0, "an angle from 0 to 20 degrees"),
        "held_seconds": Kind(lambda value: is_finite(value) and value >= 0.25, "0.25 s or more"),
        "seconds": POSITIVE,
        "trials": GROUP,
        **_SPLIT,
    },
    "published": {"simulation": GROUP, "physics": GROUP, "integrator": one_of(*INTEGRATORS)},
    "published.physics": {"mass": one_of(*MASS_MODES), "volume_integration": one_of(*VOLUME_INTEGRATIONS)},
    "release": {
        "hold_modes": COUNT,
        "velocity_modes": COUNT,
        "window": POSITIVE,
        "noise": POSITIVE,
        "delay": NOT_NEGATIVE,
        "speed": POSITIVE,
        "sideways": NOT_NEGATIVE,
        "iterations": NATURAL,
    },
    "identify": {
        "integrator": one_of(*INTEGRATORS),
        "substeps": NATURAL,
        "parameters": GROUP,
        "elastic": optional(GROUP),
        "first_guess": GROUP,
        "starts": NATURAL,
        "candidates": COUNT,
        "max_evaluations": NATURAL,
        "tolerance": POSITIVE,
        "grid": GROUP,
    },
    "in_the_loop": {
        "epochs": NATURAL,
        "penalty": NOT_NEGATIVE,
        "sees_loads": TRUTH_VALUE,
        "hold_out": TRUTH_VALUE,
        "patience": NATURAL,
        "memory": NATURAL,
        "rollout_every": NATURAL,
    },
}
_RANGE = {"lower": FINITE, "upper": FINITE}
_OF_THE_BUDGET = ("limit", "steps")  # keys of `data` that the group budget sets for every experiment


def check_measured(config: Mapping[str, Any]) -> None:
    """Checks what is known of an experiment on recordings without reading any.

    Args:
        config: a whole configuration with ``data.kind: recordings``.

    Raises:
        InputError: a value of the wrong kind or out of range, or an unknown key.
        MeshError: a place where no vertex lies.
    """
    check_keys("data", config["data"], _KEYS["data"], _OF_THE_BUDGET)
    if config["data"].get("limit") is not None:
        check_keys("data.limit", config["data"]["limit"], dict.fromkeys(SPLITS, NATURAL))
    for group in ("markers", "release", "identify", "in_the_loop"):
        check_keys(group, config.get(group), _KEYS[group])
    for group in ("synthetic", "published"):
        if config[group] is not None:
            check_keys(group, config[group], _KEYS[group])
    _check_trials(config, "data")
    _check_markers(config)
    vertical(config["data"]["up"])
    if is_synthetic(config):
        _check_synthetic(config)
    if config["published"] is not None:
        _check_material(config["published"], "simulation", "published")
        check_keys("published.physics", config["published"]["physics"], _KEYS["published.physics"])
    if folds_of(config) is None:
        split_of(config)
    body = build_body(config)
    for key, place in (("data.hung_on", config["data"]["hung_on"]), ("markers.bind_to", config["markers"]["bind_to"])):
        _check_place(place, key)
    if config["markers"]["bind_to"] is not None:
        select_vertices(body.mesh, **config["markers"]["bind_to"])
    attached_mass(body, config["data"]["hung_on"], np.array([trial.hung for trial in trials_of(config)]))
    _check_learning(config)


def _check_learning(config: Mapping[str, Any]) -> None:
    """What the stages after the import are set to."""
    if config["refinement"]["kind"] != "none":
        raise InputError("refinement is for simulated experiments: recordings train through the simulator anyhow.")
    if config["release"]["sideways"] > 0.0 and config["data"]["rest"] != "held":
        raise InputError(
            f"release.sideways is {config['release']['sideways']:g} m, but data.rest is {config['data']['rest']}: that "
            "tells where the markers are on the undeformed body, so set release.sideways to 0."
        )
    if config["release"]["sideways"] > 0.0 and not np.any(config["gravity"]):
        raise InputError("release.sideways is across gravity, but gravity is zero: set release.sideways to 0.")
    check_in_the_loop(config["in_the_loop"])
    simulator = build_simulator(config)
    check_identification(config["identify"], known_parameters(simulator))
    probe = MarkerMap.at_vertices(torch.zeros(1, 1, dtype=torch.int64))
    make_sparse_reconstructor(simulator, probe, **config["reconstruction"])


def check_identification(identify: Mapping[str, Any], known: Sequence[str]) -> None:
    """Checks the group ``identify``, of which ``elastic`` is optional.

    Args:
        identify: the group, with its own keys checked.
        known: parameters that may be identified.

    Raises:
        InputError: no parameter, an unknown one, a value out of range, or a first guess out of its range.
    """
    if not identify["parameters"]:
        raise InputError(f"identify.parameters is empty: give a range of one or more of {', '.join(known)}.")
    for group, needed, others in (
        ("parameters", _RANGE, ("logarithmic",)),
        ("elastic", _RANGE, ("logarithmic",)),
        ("grid", {**_RANGE, "logarithmic": TRUTH_VALUE, "points": NATURAL}, ()),
    ):
        for name, settings in (identify.get(group) or {}).items():
            choice = known if group == "parameters" else ELASTIC
            if name not in choice:
                raise InputError(f"identify.{group} names '{name}': choose from {', '.join(choice)}.")
            check_keys(f"identify.{group}.{name}", settings, needed, others)
            try:
                Bounds(**{key: value for key, value in settings.items() if key != "points"})
            except (TypeError, InputError) as error:
                raise InputError(f"identify.{group}.{name}: {error}") from error
    if "youngs_modulus" not in identify["grid"]:
        raise InputError("identify.grid must have a range of youngs_modulus, and may have one of poissons_ratio.")
    for name, value in identify["first_guess"].items():
        if name not in known:
            raise InputError(f"identify.first_guess names '{name}': choose from {', '.join(known)}.")
        within = identify["parameters"].get(name)
        if not is_finite(value) or (within is not None and not within["lower"] <= value <= within["upper"]):
            wanted = "" if within is None else f" from {within['lower']:g} to {within['upper']:g}, its range"
            raise InputError(f"identify.first_guess.{name} is {value!r}: it must be a number{wanted}.")


def _check_trials(config: Mapping[str, Any], group: str) -> None:
    """Checks the trials of ``data`` or ``synthetic``."""
    keys = ("hung",) if group == "synthetic" else ("file", "hung")
    trials = config[group]["trials"]
    if not trials and not (group == "data" and is_synthetic(config)):
        raise InputError(f"{group}.trials is empty: name each trial, with its {' and '.join(keys)}.")
    files: dict[str, str] = {}
    for name, trial in trials.items():
        at = f"{group}.trials.{name}"
        if not isinstance(name, str) or not re.fullmatch(_NAME, name):
            raise InputError(f"{at}: files are named after trials: use letters, digits, _ and -, not digits alone.")
        if not isinstance(trial, Mapping) or set(trial) != set(keys):
            raise InputError(f"{at} is {trial!r}: it needs {' and '.join(keys)}, and nothing else.")
        if not NOT_NEGATIVE.fits(trial["hung"]):
            raise InputError(f"{at}.hung is {trial['hung']!r}: it must be a mass, zero or more, in kg.")
        if "file" in trial:
            file = trial["file"]
            if not isinstance(file, str) or not file:
                raise InputError(f"{at}.file is {file!r}: it must be the name of a file in data.folder.")
            if file in files:
                raise InputError(f"the trials '{files[file]}' and '{name}' have the same file, {file}: name it once.")
            files[file] = name


def _check_markers(config: Mapping[str, Any]) -> None:
    markers = config["markers"]
    for group in ("followed", "others"):
        for label, place in markers[group].items():
            if not _is_place(place):
                raise InputError(f"markers.{group}.{label} is {place!r}: it must be three numbers, in metres.")
    both = [label for label in markers["followed"] if label in markers["others"]]
    if both:
        raise InputError(f"the marker '{both[0]}' is in markers.followed and markers.others: it moves or stands still.")
    if not markers["followed"]:
        raise InputError("markers.followed is empty: name the markers that errors are measured on.")
    count = len(markers["followed"]) + len(markers["others"])
    if count < 3:
        raise InputError(f"markers names {count} in all: registration needs three or more.")
    if markers["bind"] == "rigid" and markers["bind_to"] is None:
        raise InputError("markers.bind is rigid: set markers.bind_to to the vertices that they follow, as {x: 0.1}.")


def _check_synthetic(config: Mapping[str, Any]) -> None:
    synthetic = config["synthetic"]
    if synthetic is None:
        raise InputError("data.folder is not set: give the folder of the recordings.")
    _check_trials(config, "synthetic")
    _check_material(synthetic, "material", "synthetic")
    for key in ("begins", "rest"):
        if config["data"][key] != "held":
            raise InputError(
                f"data.{key} is {config['data'][key]}, but simulated bodies are held undeformed: set it to held."
            )
    if synthetic["seconds"] < config["data"]["seconds"]:
        raise InputError(
            f"synthetic.seconds is {synthetic['seconds']}, less than data.seconds ({config['data']['seconds']}): "
            "follow the body for as long as it counts."
        )
    build_mesh(synthetic["mesh"])


def _check_material(config: Mapping[str, Any], key: str, group: str) -> None:
    try:
        build_material(config, key)
    except InputError as error:
        raise InputError(f"{group}.{error}") from error
    for name, value in config[key].items():
        if name != "model" and not is_number(value):
            raise InputError(f"{group}.{key}.{name} is {value!r}: it must be a number.")


def _check_place(place: Any, at: str) -> None:
    """Checks what `select_vertices` is to be given."""
    if place is None:
        return
    known = [name for name in inspect.signature(select_vertices).parameters if name != "mesh"]
    for key, value in place.items():
        if key not in known:
            raise InputError(f"unknown key '{at}.{key}': {at} has {', '.join(known)}.")
        if value is not None and not is_finite(value):
            raise InputError(f"{at}.{key} is {value!r}: it must be a number, in metres.")
