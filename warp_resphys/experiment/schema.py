"""What a configuration may hold: the kind, the range and the unit of every value, each in one place."""

import math
import numbers
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from ..data.markers import KINDS as BINDINGS
from ..data.recordings.recording import METRES_PER_UNIT
from ..dynamics.integrator import INTEGRATORS
from ..dynamics.simulator import COUPLINGS
from ..fem.body import MASS_MODES
from ..fem.elements import VOLUME_INTEGRATIONS
from ..io.errors import InputError
from ..learning.networks import ACTIVATIONS, FORCE_BASES, NETWORK_KINDS
from ..learning.refinement import REFINEMENTS
from ..learning.training import SCHEDULES, SELECTIONS
from .scene import FORCE_FRAMES
from .trials import BEGINNINGS, FOLDS, SPLITS


def is_whole_number(value: Any) -> bool:
    """Whether it is an integer, and no truth value."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Whether it is a real number, and no truth value."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def is_finite(value: Any) -> bool:
    """Whether it is a finite number."""
    return is_number(value) and math.isfinite(value)


@dataclass(frozen=True)
class Kind:
    """What the value of a key must be.

    Attributes:
        fits: tells whether a value is of the kind.
        wanted: the kind in words, as in "it must be a word".
        optional: whether it may be null.
        absent: whether its key may be left out.
    """

    fits: Callable[[Any], bool]
    wanted: str
    optional: bool = False
    absent: bool = False


@dataclass(frozen=True)
class Group:
    """What a group of settings must be.

    Attributes:
        keys: by name, what their values must be.
        each: what the values of any other keys must be; None where there are none.
        optional: whether it may be null.
        absent: whether its key may be left out.
        short: whether a word may stand for it.
    """

    keys: Mapping[str, "Kind | Group"] = field(default_factory=dict)
    each: "Kind | Group | None" = None
    optional: bool = False
    absent: bool = False
    short: bool = False


Spec = Kind | Group


def _finite(fits: Callable[[Any], bool], wanted: str) -> Kind:
    return Kind(lambda value: is_finite(value) and fits(value), wanted)


def _list(fits: Callable[[Any], bool], wanted: str, most: int | None = None) -> Kind:
    def of_list(value: Any) -> bool:
        return isinstance(value, list) and all(map(fits, value)) and (most is None or len(value) <= most)

    return Kind(of_list, wanted)


def one_of(*words: Any) -> Kind:
    """One of some words."""
    return Kind(lambda value: isinstance(value, str) and value in words, f"one of {', '.join(words)}")


def at_most(limit: int) -> Kind:
    """A whole number from one on, up to a limit beyond which nothing fits a machine."""
    return Kind(lambda value: is_whole_number(value) and 0 < value <= limit, f"a whole number from 1 to {limit:,}")


def optional(spec: Any) -> Any:
    """The same, or null."""
    return replace(spec, optional=True)


def absent(spec: Any) -> Any:
    """The same, or left out."""
    return replace(spec, absent=True)


def _is_word(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(row, list) and len(row) == len(value) and all(map(is_finite, row)) for row in value
    )


def _is_place(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(is_finite, value))


WORD: Final = Kind(_is_word, "a word")
NAME: Final = Kind(
    lambda value: isinstance(value, str) and re.fullmatch(r"[\w-]+", value) is not None,
    "letters, digits, _ and - alone, as a folder is named so",
)
ANYTHING: Final = Kind(lambda _: True, "anything", optional=True)
NUMBER: Final = Kind(is_number, "a number")
FINITE: Final = Kind(is_finite, "a finite number")
POSITIVE: Final = _finite(lambda value: value > 0.0, "a positive number")
NOT_NEGATIVE: Final = _finite(lambda value: value >= 0.0, "a number, zero or more")
SHARE: Final = _finite(lambda value: 0.0 < value <= 1.0, "more than 0 and at most 1")
NATURAL: Final = Kind(lambda value: is_whole_number(value) and value > 0, "a whole number, one or more")
COUNT: Final = Kind(lambda value: is_whole_number(value) and value >= 0, "a whole number, zero or more")
NATURALS: Final = Kind(
    lambda value: isinstance(value, list) and bool(value) and all(map(NATURAL.fits, value)),
    "a list of whole numbers, one or more",
)
TRUTH_VALUE: Final = Kind(lambda value: isinstance(value, bool), "true or false")
_TOLERANCE: Final = _finite(lambda value: 0.0 < value <= 0.1, "more than 0 and at most 0.1")
_STEP: Final = _finite(lambda value: 0.0 < value <= 10.0, "positive and at most 10, in s")
_PLACE: Final = Kind(_is_place, "three numbers, in metres")
_FORCE: Final = Kind(_is_place, "three numbers, in N")
_AXIS: Final = Kind(lambda value: _is_place(value) and any(value), "three numbers, not all zero")
_POSITIVES: Final = _list(POSITIVE.fits, "a list of positive numbers")
NUMBERS: Final = _list(is_number, "a list of numbers")
_THREE_NATURALS: Final = Kind(
    lambda value: isinstance(value, list) and len(value) == 3 and all(at_most(10_000).fits(each) for each in value),
    "three whole numbers from 1 to 10,000",
)
_THREE_LENGTHS: Final = Kind(
    lambda value: isinstance(value, list) and len(value) == 3 and all(map(POSITIVE.fits, value)),
    "three positive numbers, in m",
)
_TRIALS: Final = Kind(
    lambda value: (is_whole_number(value) and value >= 0) or (isinstance(value, list) and all(map(_is_word, value))),
    "a number of trials, or a list of their names",
)
_COLUMNS: Final = Kind(
    lambda value: (
        isinstance(value, list) and bool(value) and all(map(NATURAL.fits, value)) and len({*value}) == len(value)
    ),
    "a list of different chambers, from 1",
)

PLACE: Final = Group({key: absent(optional(FINITE)) for key in ("x", "y", "z")} | {"tolerance": absent(POSITIVE)})
MATERIAL: Final = Group({"model": absent(WORD)}, each=NUMBER)
_MESHES: Final[Mapping[str, Mapping[str, Spec]]] = {
    "box_hexahedra": {
        "size": _THREE_LENGTHS,
        "divisions": _THREE_NATURALS,
        "nodes": absent(Kind(lambda value: value in (8, 20, 27), "one of 8, 20, 27")),
    },
    "box_tetrahedra": {
        "size": _THREE_LENGTHS,
        "divisions": _THREE_NATURALS,
        "order": absent(Kind(lambda value: value in (1, 2), "1 or 2")),
    },
    "file": {
        "path": WORD,
        "units": one_of(*METRES_PER_UNIT),
        "order": Kind(lambda value: value in (1, 2), "1 or 2"),
        "drop_unreferenced": TRUTH_VALUE,
    },
    "arm": {"name": WORD},
    "arm_generated": {
        "size": POSITIVE,
        "cells": WORD,
        "layers": optional(POSITIVE),
        "order": Kind(lambda value: value in (1, 2), "1 or 2"),
        "chamber_lengths": _POSITIVES,
        "caps": _POSITIVES,
        "radii": _POSITIVES,
        "chambers": NATURAL,
        "profile": WORD,
        "outline": WORD,
        "wall": POSITIVE,
        "web": POSITIVE,
        "core": optional(POSITIVE),
        "rotations": NUMBERS,
    },
}


def mesh_group(settings: Any) -> Group:
    """What the group ``mesh`` must be, by its kind.

    Raises:
        InputError: an unknown kind.
    """
    kind = settings.get("kind") if isinstance(settings, Mapping) else None
    if isinstance(settings, Mapping) and kind not in _MESHES:
        *some, last = _MESHES
        raise InputError(f"mesh.kind is {kind!r}: choose {', '.join(some)} or {last}.")
    return Group({"kind": WORD, **_MESHES.get(str(kind), {})})


_SOLVER = Group(
    {
        "name": WORD,
        "relative_tolerance": _TOLERANCE,
        "absolute_tolerance": NOT_NEGATIVE,
        "max_iterations": NATURAL,
        "memory": NATURAL,
        "refactor_after": NATURAL,
        "linear_solver": WORD,
        "on_failure": WORD,
    }
)
_PHYSICS = Group({"mass": one_of(*MASS_MODES), "volume_integration": one_of(*VOLUME_INTEGRATIONS)})
NETWORK: Final = Group(
    {
        "kind": one_of(*NETWORK_KINDS),
        "position_modes": absent(COUNT),
        "velocity_modes": absent(COUNT),
        "force_modes": absent(NATURAL),
        "force_basis": absent(one_of(*FORCE_BASES)),
        "blocks": at_most(100),
        "layers": Kind(lambda value: is_whole_number(value) and 0 <= value <= 100, "a whole number from 0 to 100"),
        "width": at_most(16_384),
        "activation": one_of(*ACTIVATIONS),
        "recurrent": absent(optional(at_most(1_024))),
    }
)
TRAINER: Final = Group(
    {
        "epochs": NATURAL,
        "batch_size": NATURAL,
        "learning_rate": POSITIVE,
        "schedule": one_of(*SCHEDULES),
        "final_learning_rate": POSITIVE,
        "gamma": SHARE,
        "step_epochs": NATURAL,
        "weight_decay": NOT_NEGATIVE,
        "noise": NOT_NEGATIVE,
        "linear_noise": optional(POSITIVE),
        "scale_weight": NOT_NEGATIVE,
        "selection": one_of(*SELECTIONS),
        "rollout_every": NATURAL,
        "sequence": absent(NATURAL),
    }
)
_RANGE = {"lower": FINITE, "upper": FINITE, "logarithmic": absent(TRUTH_VALUE)}
_GRID = Group({"lower": FINITE, "upper": FINITE, "logarithmic": TRUTH_VALUE, "points": NATURAL})
IN_THE_LOOP: Final = Group(
    {
        "epochs": NATURAL,
        "penalty": NOT_NEGATIVE,
        "hold_out": TRUTH_VALUE,
        "patience": NATURAL,
        "memory": NATURAL,
        "rollout_every": NATURAL,
    }
)
_IDENTIFY = Group(
    {
        "integrator": optional(one_of(*INTEGRATORS)),
        "substeps": NATURAL,
        "parameters": Group(each=Group(_RANGE, optional=True)),
        "elastic": optional(Group(each=Group(_RANGE, optional=True))),
        "first_guess": Group(each=FINITE),
        "trials": optional(NATURAL),
        "seconds": optional(POSITIVE),
        "starts": NATURAL,
        "candidates": COUNT,
        "max_evaluations": NATURAL,
        "tolerance": POSITIVE,
        "grid": optional(Group({"youngs_modulus": _GRID, "poissons_ratio": absent(_GRID)})),
    }
)
_RELEASE = Group(
    {
        "hold_modes": COUNT,
        "velocity_modes": COUNT,
        "window": POSITIVE,
        "noise": POSITIVE,
        "delay": NOT_NEGATIVE,
        "speed": POSITIVE,
        "sideways": NOT_NEGATIVE,
        "iterations": NATURAL,
    }
)
_MARKERS = Group(
    {
        "tracked": Group(each=_PLACE),
        "reference": Group(each=_PLACE),
        "bind": one_of(*BINDINGS),
        "bind_to": optional(PLACE),
        "largest_residual": POSITIVE,
        "largest_distance": POSITIVE,
        "largest_distortion": POSITIVE,
        "largest_shift": optional(POSITIVE),
    }
)
_SWING = Group(
    {
        "frequency": POSITIVE,
        "translation": absent(_PLACE),
        "rotation": absent(Kind(_is_place, "three numbers, in rad")),
        "phase": absent(FINITE),
    }
)
_BASE_MOTION = Group(
    {
        "file": absent(Kind(_is_word, "the name of a file")),
        "swings": absent(Group(each=_SWING)),
        "about": absent(_PLACE),
        "start": absent(NOT_NEGATIVE),
        "ramp": absent(NOT_NEGATIVE),
    },
    optional=True,
    absent=True,
    short=True,
)
_TRIAL = Group(
    {
        "file": absent(Kind(_is_word, "the name of a file")),
        "payload": absent(Kind(NOT_NEGATIVE.fits, "a mass, zero or more, in kg")),
        "begins": absent(one_of(*BEGINNINGS)),
        "pull": absent(_FORCE),
        "base_motion": _BASE_MOTION,
    }
)
_SEQUENCES = Group(
    {
        "mean": absent(FINITE),
        "deviation": absent(POSITIVE),
        "correlation_time": absent(POSITIVE),
        "correlation": absent(
            Kind(lambda value: is_finite(value) or _is_matrix(value), "a finite number, or a matrix of them")
        ),
        "rest": absent(NOT_NEGATIVE),
    }
)
_FIBRES = Group({"angles": NUMBERS, "toe": POSITIVE, "stiffness": NOT_NEGATIVE}, optional=True)
_LIMIT = Group(dict.fromkeys(SPLITS, NATURAL), optional=True)
_SPLIT = dict.fromkeys(SPLITS, _TRIALS)
_UP = Kind(lambda value: _is_word(value) or _is_place(value), "x, -x, y, -y, z, -z, three numbers, or null", True)
_RECORDED = Group(
    {
        "folder": optional(WORD),
        "units": optional(one_of(*METRES_PER_UNIT)),
        "rate": optional(POSITIVE),
        "trials": Group(each=replace(_TRIAL, short=True)),
        "sequences": COUNT,
        "begins": one_of(*BEGINNINGS),
        "rest": one_of("held", "file"),
        "alignment": one_of("shared", "own"),
        "payload_at": optional(PLACE),
        "up": _UP,
        "seconds": optional(POSITIVE),
        "rest_seconds": NOT_NEGATIVE,
        "longest_gap": COUNT,
        "steps": optional(NATURAL),
        "chambers": optional(_COLUMNS),
        "pressure_limit": optional(POSITIVE),
        "valve": one_of("recorded", "detected"),
        "cutoff": optional(POSITIVE),
        "train_fraction": SHARE,
        "horizons": _POSITIVES,
        "pressure_scales": _POSITIVES,
        "base_motion": _BASE_MOTION,
        "folds": optional(one_of(*FOLDS)),
        **_SPLIT,
        "limit": _LIMIT,
    }
)
_SIMULATED = Group(
    {
        "kind": WORD,
        "steps": NATURAL,
        "load": absent(PLACE),
        "twist_axis": absent(one_of("x", "y", "z")),
        "weights_g": absent(Group(each=NUMBERS)),
        "angles_deg": absent(Group(each=NUMBERS)),
        "amplitudes": absent(Group(each=NUMBERS)),
        "base_motion": _BASE_MOTION,
        "folds": absent(optional(one_of(*FOLDS))),
        "limit": _LIMIT,
    }
)
_CHAMBERS = Group({"count": NATURAL, "axis": _AXIS}, optional=True)
_ABLATION = Group(
    {
        "counts": Kind(
            lambda value: NATURALS.fits(value) and len({*value}) == len(value),
            "a list of different positive whole numbers",
        ),
        "draws": NATURAL,
        "modes": optional(NATURAL),
        "processes": optional(NATURAL),
    },
    absent=True,
)


def laboratory_group(settings: Any) -> Group:
    """What the group ``laboratory`` must be."""
    mesh = settings.get("mesh") if isinstance(settings, Mapping) else None
    return Group(
        {
            "mesh": mesh_group(mesh),
            "time_step": _STEP,
            "integrator": one_of(*INTEGRATORS),
            "material": MATERIAL,
            "fibres": absent(_FIBRES),
            "sequences": absent(_SEQUENCES),
            "rate": absent(optional(POSITIVE)),
            "noise": NOT_NEGATIVE,
            "placement_noise": NOT_NEGATIVE,
            "tilt": absent(_finite(lambda value: 0.0 <= value <= 20.0, "an angle from 0 to 20 degrees")),
            "held_seconds": absent(_finite(lambda value: value >= 0.25, "0.25 s or more")),
            "seconds": absent(optional(POSITIVE)),
            "trials": Group(each=_TRIAL),
            **{name: absent(_TRIALS) for name in SPLITS},
        },
        optional=True,
    )


def configuration_group(config: Mapping[str, Any]) -> Group:
    """What a whole configuration must be, by what it asks for."""
    recorded = config.get("markers") is not None
    own: dict[str, Spec] = {"target": absent(optional(MATERIAL)), "data": _SIMULATED}
    if recorded:
        own = {"data": _RECORDED, "target": absent(optional(MATERIAL))}
    return Group(
        {
            "name": NAME,
            "title": WORD,
            "seed": Kind(lambda value: is_whole_number(value) and 0 <= value < 2**63, "between 0 and 2^63 - 1"),
            "device": WORD,
            "dtype": WORD,
            "gravity": Kind(_is_place, "three finite numbers, in m/s^2"),
            "time_step": _STEP,
            "integrator": one_of(*INTEGRATORS),
            "mesh": mesh_group(config.get("mesh")),
            "physics": _PHYSICS,
            "solver": _SOLVER,
            "fixed": PLACE,
            "tip": PLACE,
            "simulation": MATERIAL,
            "chambers": _CHAMBERS,
            "fibres": _FIBRES,
            "coupling": one_of(*COUPLINGS),
            "force_frame": one_of(*FORCE_FRAMES),
            "range_guard": TRUTH_VALUE,
            "correct_uncorrected": TRUTH_VALUE,
            "timing": TRUTH_VALUE,
            "reconstruction": Group(
                {
                    "method": WORD,
                    "regularisation": NOT_NEGATIVE,
                    "tolerance": POSITIVE,
                    "max_iterations": NATURAL,
                    "modes": absent(optional(NATURAL)),
                }
            ),
            "network": NETWORK,
            "trainer": TRAINER,
            "simfree": Group({"network": Group(each=ANYTHING), "trainer": Group(each=ANYTHING)}),
            "refinement": refinement_group(config.get("refinement")),
            "in_the_loop": optional(IN_THE_LOOP),
            "identify": optional(_IDENTIFY),
            "release": _RELEASE,
            "markers": optional(_MARKERS),
            "actuation": Group({"filter_time_constants": _POSITIVES, "sees_payload": TRUTH_VALUE}),
            "parallel": Group({"processes": optional(NATURAL), "batch": optional(NATURAL)}),
            "published": Group(
                {"simulation": MATERIAL, "physics": _PHYSICS, "integrator": one_of(*INTEGRATORS)}, optional=True
            ),
            "laboratory": laboratory_group(config.get("laboratory")),
            "ablation": _ABLATION,
            "budget": absent(WORD),
            "tuned": absent(WORD),
            "tune": absent(Group(each=ANYTHING)),
            **own,
        }
    )


def refinement_group(settings: Any) -> Group:
    """What the group ``refinement`` must be: nothing more than its kind where there is none."""
    keys: dict[str, Spec] = {"kind": one_of(*REFINEMENTS)}
    if isinstance(settings, Mapping) and settings.get("kind") != "none":
        keys |= dict.fromkeys(("window", "epochs", "batch_size", "memory", "rollout_every"), NATURAL)
    return Group(keys)


def check(name: str, value: Any, spec: Spec) -> None:
    """Compares a value, or a whole group of settings, with what it must be.

    Args:
        name: its dotted key, for messages; empty for a whole configuration.
        value: to be compared.
        spec: what it must be.

    Raises:
        InputError: a group that is none, a key that is unknown or missing, or a value of another kind or out of range.
    """
    if value is None and spec.optional:
        return
    if isinstance(spec, Kind):
        if not spec.fits(value):
            null = ", or null" if spec.optional and not spec.wanted.endswith("null") else ""
            raise InputError(f"{name} is {value!r}: it must be {spec.wanted}{null}.")
        return
    if spec.short and _is_word(value):
        return
    if not isinstance(value, Mapping):
        raise InputError(f"{name} is {value!r}: it must be a group of settings.")
    at = f"{name}." if name else ""
    for key, each in value.items():
        if key in spec.keys:
            check(f"{at}{key}", each, spec.keys[key])
        elif spec.each is not None:
            check(f"{at}{key}", each, spec.each)
        else:
            known = f": {name} has {', '.join(spec.keys)}" if name else ""
            raise InputError(f"unknown key '{at}{key}'{known}.")
    for key, each_spec in spec.keys.items():
        if key not in value and not each_spec.absent:
            raise InputError(f"{at}{key} is missing{f': {name} needs it' if name else ''}.")


def dotted(groups: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of nested settings."""
    for key, value in groups.items():
        if isinstance(value, Mapping) and value:
            yield from dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
