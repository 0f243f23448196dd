"""Checks of the groups that experiments on recordings have: data, markers, synthetic and published."""

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ...body import MASS_MODES
from ...configured import build_body, build_mesh, build_simulator
from ...elements import VOLUME_INTEGRATIONS
from ...errors import InputError
from ...integrator import INTEGRATORS
from ...markers import KINDS, MarkerMap
from ...material import Material
from ...mesh import select_vertices
from ...recordings.recording import METRES_PER_UNIT
from ...release import ReleaseSettings
from ...residual.markers_in_the_loop import check_in_the_loop
from ...residual.sparse_reconstruction import make_sparse_reconstructor
from ..kinds import is_finite, is_number, is_whole_number, is_word
from .files import attached_mass
from .identify import check_identification
from .trials import FOLDS, folds_of, is_synthetic, split_of, trials_of, vertical

RECORDINGS = "recordings"  # this kind of data
_NAME = r"[\w-]+"


@dataclass(frozen=True)
class _Kind:
    fits: Callable[[Any], bool]
    wanted: str


def _is_place(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(is_finite, value))


_WORD = _Kind(is_word, "a word")
_GROUP = _Kind(lambda value: isinstance(value, Mapping), "a group of settings")
_POSITIVE = _Kind(lambda value: is_finite(value) and value > 0.0, "a positive number")
_NOT_NEGATIVE = _Kind(lambda value: is_finite(value) and value >= 0.0, "a number, zero or more")
_COUNT = _Kind(lambda value: is_whole_number(value) and value >= 0, "a whole number, zero or more")
_NAMES = _Kind(lambda value: isinstance(value, list) and all(map(is_word, value)), "a list of names of trials")
_SPLIT = {"train": _NAMES, "validation": _NAMES, "test": _NAMES}
_UP = _Kind(lambda value: is_word(value) or _is_place(value), "x, -x, y, -y, z, -z, three numbers, or null")

# Keys of each group; those in _OPTIONAL may be null.
_KEYS: Mapping[str, Mapping[str, _Kind]] = {
    "data": {
        "kind": _WORD,
        "folder": _WORD,
        "units": _Kind(lambda value: is_word(value) and value in METRES_PER_UNIT, "m, cm or mm"),
        "rate": _POSITIVE,
        "trials": _GROUP,
        "hung_on": _GROUP,
        "up": _UP,
        "seconds": _POSITIVE,
        "longest_gap": _COUNT,
        "folds": _Kind(lambda value: value in FOLDS, f"{' or '.join(FOLDS)}, or null"),
        **_SPLIT,
    },
    "markers": {
        "followed": _GROUP,
        "others": _GROUP,
        "bind": _Kind(lambda value: value in KINDS, f"one of {', '.join(KINDS)}"),
        "bind_to": _GROUP,
        "largest_residual": _POSITIVE,
        "largest_distance": _POSITIVE,
        "largest_distortion": _POSITIVE,
        "largest_shift": _POSITIVE,
    },
    "synthetic": {
        "mesh": _GROUP,
        "time_step": _POSITIVE,
        "integrator": _Kind(lambda value: value in INTEGRATORS, f"one of {', '.join(INTEGRATORS)}"),
        "material": _GROUP,
        "rate": _POSITIVE,
        "noise": _NOT_NEGATIVE,
        "misplaced": _NOT_NEGATIVE,
        "tilt": _Kind(lambda value: is_finite(value) and 0.0 <= value <= 20.0, "an angle from 0 to 20 degrees"),
        "held_seconds": _Kind(lambda value: is_finite(value) and value >= 0.25, "0.25 s or more"),
        "seconds": _POSITIVE,
        "trials": _GROUP,
        **_SPLIT,
    },
    "published": {
        "simulation": _GROUP,
        "physics": _GROUP,
        "integrator": _Kind(lambda value: value in INTEGRATORS, f"one of {', '.join(INTEGRATORS)}"),
    },
}
_OPTIONAL = (
    *("data.folder", "data.units", "data.rate", "data.hung_on", "data.up", "data.folds"),
    *("markers.bind_to", "markers.largest_shift"),
)
_OF_THE_BUDGET = ("limit", "steps")  # keys of `data` that the group budget sets for every experiment


def check_measured(config: Mapping[str, Any]) -> None:
    """Checks what is known of an experiment on recordings without reading any.

    Args:
        config: a whole configuration with ``data.kind: recordings``.

    Raises:
        InputError: a value of the wrong kind or out of range, or an unknown key.
        MeshError: a place where no vertex lies.
    """
    for group in ("data", "markers"):
        _check_group(config, group)
    for group in ("synthetic", "published"):
        if config[group] is not None:
            _check_group(config, group)
    _check_trials(config, "data")
    _check_markers(config)
    vertical(config["data"]["up"])
    if is_synthetic(config):
        _check_synthetic(config)
    if config["published"] is not None:
        _check_material(config["published"]["simulation"], "published.simulation")
        physics = config["published"]["physics"]
        wanted = {"mass": MASS_MODES, "volume_integration": VOLUME_INTEGRATIONS}
        if physics.keys() != wanted.keys() or any(physics[key] not in known for key, known in wanted.items()):
            known = " and ".join(f"{key} ({' or '.join(names)})" for key, names in wanted.items())
            raise InputError(f"published.physics is {dict(physics)}: it needs {known}.")
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
    for group in ("release", "identify", "in_the_loop"):
        if not isinstance(config.get(group), Mapping):
            raise InputError(f"{group} is {config.get(group)!r}: it must be a group of settings.")
    try:
        ReleaseSettings(**config["release"])
    except TypeError as error:
        raise InputError(f"release: {error}; see conf/measured/default.yaml for its keys.") from error
    check_identification(config["identify"])
    check_in_the_loop(config["in_the_loop"])
    simulator = build_simulator(config)
    probe = MarkerMap.at_vertices(torch.zeros(1, 1, dtype=torch.int64))
    make_sparse_reconstructor(simulator, probe, **config["reconstruction"])


def _check_group(config: Mapping[str, Any], group: str) -> None:
    settings = config[group]
    if not isinstance(settings, Mapping):
        raise InputError(f"{group} is {settings!r}: it must be a group of settings.")
    known = _KEYS[group]
    allowed = (*known, *(_OF_THE_BUDGET if group == "data" else ()))
    for key in settings:
        if key not in allowed:
            raise InputError(f"unknown key '{group}.{key}': {group} has {', '.join(known)}.")
    for key, kind in known.items():
        if key not in settings:
            raise InputError(f"{group}.{key} is missing: set it, or begin with the defaults of the group measured.")
        value = settings[key]
        if not (value is None and f"{group}.{key}" in _OPTIONAL) and not kind.fits(value):
            raise InputError(f"{group}.{key} is {value!r}: it must be {kind.wanted}.")


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
        if not _NOT_NEGATIVE.fits(trial["hung"]):
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
    _check_material(synthetic["material"], "synthetic.material")
    if synthetic["seconds"] < config["data"]["seconds"]:
        raise InputError(
            f"synthetic.seconds is {synthetic['seconds']}, less than data.seconds ({config['data']['seconds']}): "
            "follow the body for as long as it counts."
        )
    build_mesh(synthetic["mesh"])


def _check_material(material: Any, at: str) -> None:
    known = inspect.signature(Material).parameters
    for key, value in material.items():
        if key not in known:
            raise InputError(f"unknown key '{at}.{key}': {at} has {', '.join(known)}.")
        if not (is_word(value) if key == "model" else is_number(value)):
            raise InputError(f"{at}.{key} is {value!r}: it must be a {'word' if key == 'model' else 'number'}.")
    try:
        Material(**material)
    except InputError as error:
        raise InputError(f"{at}: {error}") from error


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
