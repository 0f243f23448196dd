"""Checks of a whole configuration before anything is computed, so that a slip costs no stage that comes before it."""

import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any

from ..dynamics.nonlinear_solver import SolverSettings
from ..energies.material import Material
from ..io.errors import InputError
from ..learning.networks import check_network
from ..learning.reconstruction import make_reconstructor
from ..learning.refinement import check_refinement
from ..learning.sparse_reconstruction import make_sparse_reconstructor
from ..learning.training import check_trainer
from ..mesh.mesh import select_vertices
from .actuated.checks import PRESSURE, check_driven
from .build import build_simulator
from .kinds import dotted, is_list, is_number, is_whole_number, is_word
from .measured.checks import RECORDINGS, check_measured
from .trajectories import MODELS, training_settings, variation_of

_GROUPS = (
    "mesh",
    "physics",
    "solver",
    "reconstruction",
    "network",
    "trainer",
    "refinement",
    "fixed",
    "simulation",
    "simfree",
    "data",
    "tip",
)
_WORDS = (
    "dtype",
    "device",
    "integrator",
    "data.twist_axis",
    "mesh.cells",
    "mesh.profile",
    "mesh.outline",
    "*.kind",
    "*.model",
    "*.name",
    "*.method",
    "solver.linear_solver",
    "network.activation",
    "trainer.schedule",
    "trainer.selection",
)
_WHOLE_NUMBERS = (
    "seed",
    "data.steps",
    "data.limit.*",
    "mesh.chambers",
    "mesh.order",
    "*.max_iterations",
    "solver.memory",
    "solver.refactor_after",
    "network.*",
    "trainer.epochs",
    "trainer.batch_size",
    "trainer.step_epochs",
    "trainer.rollout_every",
    "refinement.window",
    "refinement.epochs",
    "refinement.batch_size",
    "refinement.memory",
    "refinement.rollout_every",
)
_NUMBERS = (
    "time_step",
    "fixed.*",
    "tip.*",
    "data.load.*",
    "mesh.wall",
    "mesh.web",
    "mesh.core",
    "mesh.layers",
    "simulation.*",
    "reality.*",
    "*.relative_tolerance",
    "*.absolute_tolerance",
    "reconstruction.*",
    "trainer.*",
)
_LISTS = (
    "gravity",
    "data.weights_g.*",
    "data.angles_deg.*",
    "mesh.chamber_lengths",
    "mesh.caps",
    "mesh.radii",
    "mesh.rotations",
)
_OPTIONAL = (
    "reconstruction.modes",
    "trainer.linear_noise",
    "fixed.*",
    "tip.*",
    "data.load.*",
    "data.limit",
    "mesh.core",
    "mesh.layers",
)
# Groups that are handed on as keyword arguments.
_TAKEN_BY: Mapping[str, Callable[..., Any]] = {
    "simulation": Material,
    "reality": Material,
    "solver": SolverSettings,
    "reconstruction": make_reconstructor,
    "fixed": select_vertices,
    "tip": select_vertices,
}


def check_configuration(config: Mapping[str, Any]) -> None:
    """Checks what is known without computing anything.

    Args:
        config: with the keys of ``conf/config.yaml``.

    Raises:
        InputError: a value of the wrong kind or out of range, or an unknown key.
    """
    _check_groups(config, _GROUPS)
    kind_of_data = config["data"].get("kind")
    measured = kind_of_data in (RECORDINGS, PRESSURE)
    if measured:
        _check_groups(config, ("markers",))
    else:
        kind = variation_of(config["data"])
        loaded = config["data"]["kind"] == "release_from_load"
        _check_groups(config, ("reality", f"data.{kind.key}", *(["data.load"] if loaded else [])))
    for key, value in dotted({key: value for key, value in config.items() if key != "tune"}):
        check_kind(key, value)
    if not isinstance(config["name"], str) or not re.fullmatch(r"[\w-]+", config["name"]):
        raise InputError(f"name is {config['name']!r}: a folder is named so: use letters, digits, _ and - alone.")
    if config["dtype"] != "float64":
        raise InputError(f"dtype is {config['dtype']!r}: experiments need float64; float32 is for roll-outs in Python.")
    if len(config["gravity"]) != 3 or not all(map(math.isfinite, config["gravity"])):
        raise InputError(f"gravity is {config['gravity']}: it must be three finite numbers, in m/s^2.")
    if not 0 <= config["seed"] < 2**63:
        raise InputError(f"seed is {config['seed']}: it must lie between 0 and 2^63 - 1.")
    for key, function in _TAKEN_BY.items():
        if key not in config:
            continue
        if key == "reconstruction" and measured:
            function = make_sparse_reconstructor
        own_names = inspect.signature(function).parameters
        known = [name for name in own_names if name not in ("mesh", "simulator", "markers")]
        for name in config[key]:
            if name not in known:
                raise InputError(f"unknown key '{key}.{name}': {key} has {', '.join(known)}.")
    own = config["simfree"]
    if own.keys() != {"network", "trainer"} or not all(isinstance(each, Mapping) for each in own.values()):
        raise InputError(f"simfree is {own!r}: it must be a group of the groups network and trainer.")
    for model in MODELS:
        _check_training(config, model)
    if kind_of_data == PRESSURE:
        check_driven(config)
    elif measured:
        check_measured(config)
    else:
        check_refinement(config["refinement"], config["data"]["steps"])
        make_reconstructor(build_simulator(config), **config["reconstruction"])


def _check_training(config: Mapping[str, Any], model: str) -> None:
    """Checks the settings that a model is trained with."""
    settings = training_settings(config, model)
    try:
        for group in ("network", "trainer"):
            for key, value in settings[group].items():
                check_kind(f"{group}.{key}", value)
        check_network(settings["network"])
        check_trainer(settings["trainer"])
    except InputError as error:
        raise (error if model == "resphys" else InputError(f"simfree: {error}")) from error


def _check_groups(config: Mapping[str, Any], keys: Iterable[str]) -> None:
    """Refuses what should be a group of settings and is none."""
    for key in keys:
        group: Any = config
        for name in key.split("."):
            group = group.get(name)
        if not isinstance(group, Mapping):
            raise InputError(f"{key} is {group!r}: it must be a group of settings.")


def check_kind(key: str, value: Any) -> None:
    """Compares a value with the first kind that its key belongs to; other keys may hold anything."""
    if value is None and any(fnmatchcase(key, pattern) for pattern in _OPTIONAL):
        return
    for patterns, fits, wanted in _KINDS:
        if any(fnmatchcase(key, pattern) for pattern in patterns):
            if not fits(value):
                raise InputError(f"{key} is {value!r}: it must be {wanted}.")
            return


_KINDS = (
    (_WORDS, is_word, "a word"),
    (_WHOLE_NUMBERS, is_whole_number, "a whole number"),
    (_NUMBERS, is_number, "a number"),
    (_LISTS, is_list, "a list of numbers"),
)
