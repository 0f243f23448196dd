"""Checks of the configuration of an experiment with pressures, before anything is computed."""

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ...data.actuation import PressureSequences
from ...data.markers import KINDS, MarkerMap
from ...energies.material import Material
from ...io.errors import InputError
from ...learning.driven import DRIVEN_PARAMETERS
from ...learning.sparse_reconstruction import make_sparse_reconstructor
from ...mesh.mesh import select_vertices
from ..build import build_body, build_simulator
from ..kinds import (
    COUNT,
    FINITE,
    GROUP,
    NATURAL,
    NOT_NEGATIVE,
    POSITIVE,
    WORD,
    Kind,
    check_keys,
    is_finite,
    is_list,
    is_whole_number,
    one_of,
    optional,
)
from ..measured.checks import check_identification
from ..trajectories import SPLITS
from .files import FORCE_FRAMES
from .synthesise import reality_settings, substeps_of
from .trials import is_synthetic, split_of

PRESSURE = "pressure"
_LONGEST_STRETCH = 0.3  # rho g L / E from which on the size of a body is not believed


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) and all(is_list(row) and len(row) == len(value) for row in value)


_POSITIVE_LIST = Kind(lambda value: is_list(value) and all(x > 0.0 for x in value), "a list of positive numbers")
_TRIALS = Kind(
    lambda value: (is_whole_number(value) and value > 0) or (isinstance(value, list) and bool(value)),
    "a number of trials, or a list of their names",
)
_COLUMNS = Kind(
    lambda value: (
        isinstance(value, list)
        and bool(value)
        and all(is_whole_number(x) and x > 0 for x in value)
        and len({*value}) == len(value)
    ),
    "a list of different chambers, from 1",
    optional=True,
)
_SEQUENCES = {
    "mean": FINITE,
    "deviation": POSITIVE,
    "correlation_time": POSITIVE,
    "correlation": Kind(lambda value: is_finite(value) or _is_matrix(value), "a finite number, or a matrix of them"),
    "rest": NOT_NEGATIVE,
}
_KEYS: dict[str, dict[str, Kind]] = {
    "data": {
        "kind": WORD,
        "folder": optional(WORD),
        "units": optional(WORD),
        "rate": optional(POSITIVE),
        "trials": GROUP,
        "sequences": NATURAL,
        "chambers": _COLUMNS,
        "pressure_limit": POSITIVE,
        "valve": one_of("recorded", "detected"),
        "steps": NATURAL,
        "train_fraction": POSITIVE,
        "rest": one_of("mean", "own"),
        "rest_seconds": NOT_NEGATIVE,
        "longest_gap": COUNT,
        "cutoff": optional(POSITIVE),
        "windows": _POSITIVE_LIST,
        "factors": _POSITIVE_LIST,
        "train": _TRIALS,
        "validation": _TRIALS,
        "test": _TRIALS,
        "limit": optional(GROUP),
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
    "actuation": {"memory": _POSITIVE_LIST},
    "parallel": {"processes": optional(NATURAL), "batch": NATURAL},
    "identify": {
        "parameters": GROUP,
        "first_guess": GROUP,
        "trials": NATURAL,
        "seconds": POSITIVE,
        "starts": NATURAL,
        "candidates": COUNT,
        "max_evaluations": NATURAL,
        "tolerance": POSITIVE,
        "grid": GROUP,
    },
    "synthetic": {
        "mesh": GROUP,
        "time_step": POSITIVE,
        "integrator": WORD,
        "material": GROUP,
        "fibres": optional(GROUP),
        "sequences": GROUP,
        "noise": NOT_NEGATIVE,
        "misplaced": NOT_NEGATIVE,
    },
    "chambers": {
        "count": NATURAL,
        "axis": Kind(lambda value: is_list(value) and len(value) == 3 and any(value), "three numbers, not all zero"),
    },
    "fibres": {"angles": Kind(is_list, "a list of degrees"), "toe": POSITIVE},
}


def check_driven(config: Mapping[str, Any]) -> None:
    """Checks what an experiment with pressures has of its own.

    Args:
        config: a whole configuration with ``data.kind: pressure``.

    Raises:
        InputError: a value of the wrong kind or out of range, an unknown key, or another number of chambers.
        MeshError: a mesh that cannot be read or simulated.
        DataFileError: a folder without recordings.
    """
    for group in ("data", "markers", "actuation", "parallel", "identify", "chambers"):
        check_keys(group, config.get(group), _KEYS[group])
    if config["data"]["limit"] is not None:
        check_keys("data.limit", config["data"]["limit"], dict.fromkeys(SPLITS, NATURAL))
    if config.get("fibres") is not None:
        check_keys("fibres", config["fibres"], _KEYS["fibres"])
    if config["refinement"]["kind"] != "none":
        raise InputError("refinement is for experiments without pressures: set refinement=none.")
    if not config["markers"]["followed"]:
        raise InputError("markers.followed is empty: name the markers that errors are measured on, with their places.")
    if config["force_frame"] not in FORCE_FRAMES:
        raise InputError(f"force_frame is {config['force_frame']!r}: choose one of {', '.join(FORCE_FRAMES)}.")
    _check_times(config)
    split_of(config)
    body = build_body(config)
    select_vertices(body.mesh, **config["tip"])
    simulator = build_simulator(config, body=body)
    check_size(body.mesh.vertices, simulator.material, config["gravity"])
    probe = MarkerMap.at_vertices(torch.zeros(1, 1, dtype=torch.int64))
    make_sparse_reconstructor(simulator, probe, **config["reconstruction"])
    check_identification(config["identify"], DRIVEN_PARAMETERS)
    for name in config["identify"]["first_guess"]:
        if name not in config["identify"]["parameters"]:
            raise InputError(
                f"identify.first_guess.{name} is of no use: give it a range in identify.parameters, or leave it out."
            )
    chambers = config["data"]["chambers"]
    if chambers is not None and max(chambers) > len(body.chambers):
        raise InputError(f"data.chambers names chamber {max(chambers)}, but the mesh has {len(body.chambers)}.")
    if "fibre_stiffness" in config["identify"]["parameters"] and config["fibres"] is None:
        raise InputError("identify.parameters names fibre_stiffness, but fibres is null: give the simulator some.")
    if is_synthetic(config):
        _check_synthetic(config)


def _check_times(config: Mapping[str, Any]) -> None:
    """Checks what the trials' length and their pressures have to fit."""
    data, step = config["data"], config["time_step"]
    length = data["steps"] * step
    windows = data["windows"]
    if not windows or windows != sorted({*windows}) or windows[-1] > length + 1e-9:
        raise InputError(f"data.windows is {windows}: they must rise, up to the {length:g} s of data.steps.")
    if not data["train_fraction"] <= 1.0:
        raise InputError(f"data.train_fraction is {data['train_fraction']:g}: it must be at most 1, the whole trial.")
    if data["cutoff"] is not None and not data["cutoff"] < 0.5 / step:
        raise InputError(
            f"data.cutoff is {data['cutoff']:g} Hz: it must be below {0.5 / step:g} Hz, half of the steps."
        )
    factors = data["factors"]
    if 1.0 in factors or len({*factors}) < len(factors):
        raise InputError(f"data.factors is {factors}: give different factors, none of them 1, which is always tested.")
    if factors and not is_synthetic(config):
        raise InputError(
            "data.factors raises the pressures of simulated trials, and recordings have their own: leave it empty."
        )


def check_size(vertices: Any, material: Material, gravity: Any) -> None:
    """Refuses a body that would sag under its own weight beyond belief, as one whose unit was mistaken does.

    A body of length L under its weight has strains of rho g L / E: a percent for an arm of silicone.

    Args:
        vertices: (N, 3) [m].
        material: its constants.
        gravity: (3,) [m/s^2].

    Raises:
        InputError: strains of more than a few tenths.
    """
    length = float(np.linalg.norm(np.ptp(np.asarray(vertices), axis=0)))
    density, stiffness = (float(np.mean(np.asarray(x))) for x in (material.density, material.youngs_modulus))
    strain = density * float(np.linalg.norm(gravity)) * length / stiffness
    if strain > _LONGEST_STRETCH:
        raise InputError(
            f"the mesh is {length:.3g} m across: with E = {1e-3 * stiffness:.3g} kPa its own weight would strain it by "
            f"{100.0 * strain:.0f} %; is its unit millimetres (mesh.units=mm), or that of youngs_modulus not Pa?"
        )


def _check_synthetic(config: Mapping[str, Any]) -> None:
    check_keys("synthetic", config.get("synthetic"), _KEYS["synthetic"])
    substeps_of(config)
    synthetic, data = config["synthetic"], config["data"]
    for key in synthetic["material"]:
        if key not in inspect.signature(Material).parameters:
            raise InputError(f"unknown key 'synthetic.material.{key}': a material has other constants.")
    if synthetic["fibres"] is not None:
        check_keys("synthetic.fibres", synthetic["fibres"], _KEYS["fibres"])
    given = synthetic["sequences"]
    for key in given:
        if key not in _SEQUENCES:
            raise InputError(f"unknown key 'synthetic.sequences.{key}': it has {', '.join(_SEQUENCES)}.")
    check_keys("synthetic.sequences", given, {key: _SEQUENCES[key] for key in given})
    sequences = PressureSequences(limit=data["pressure_limit"], **given)
    sequences.draw(data["steps"], config["time_step"], config["chambers"]["count"], np.random.default_rng(0))
    try:
        body, material = build_body(reality_settings(config)), Material(**synthetic["material"])
    except InputError as error:
        raise InputError(f"synthetic: {error}") from error
    check_size(body.mesh.vertices, material, config["gravity"])
