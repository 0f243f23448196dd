"""What a configuration may hold: the kind, the range and the unit of every value, each in one place."""

import math
import numbers
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from ..data.markers import KINDS as BINDINGS
from ..data.recordings.recording import METRES_PER_UNIT
from ..data.sight import FRAMES
from ..dynamics.simulator import COUPLINGS
from ..fem.body import MASS_MODES
from ..fem.elements import VOLUME_INTEGRATIONS
from ..io.errors import InputError
from ..io.fan_out import BACKENDS
from ..learning.networks import ACTIVATIONS, FORCE_BASES, NETWORK_KINDS
from ..learning.refinement import REFINEMENTS
from ..learning.training import SCHEDULES, SELECTIONS
from ..stepping.integrators import INTEGRATORS
from .scene import FORCE_FRAMES, MODELS
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


def optional(spec: Any) -> Any:
    """The same, or null."""
    return replace(spec, optional=True)


def absent(spec: Any) -> Any:
    """The same, or left out."""
    return replace(spec, absent=True)


def one_of(*words: Any) -> Kind:
    """One of some words."""
    return Kind(lambda value: isinstance(value, str) and value in words, f"one of {', '.join(words)}")


def _number(fits: Callable[[Any], bool], wanted: str) -> Kind:
    return Kind(lambda value: is_finite(value) and fits(value), wanted)


def _whole(least: int, wanted: str, most: float = math.inf) -> Kind:
    return Kind(lambda value: is_whole_number(value) and least <= value <= most, wanted)


def _list(each: Kind, wanted: str, counts: Sequence[int] | None = None, different: bool = False) -> Kind:
    """A list of values of a kind, of any length or one of these counts."""

    def fits(value: Any) -> bool:
        if not isinstance(value, list) or not all(map(each.fits, value)):
            return False
        return (counts is None or len(value) in counts) and not (different and len({*value}) < len(value))

    return Kind(fits, wanted)


def _is_word(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) and all(_list(FINITE, "", [len(value)]).fits(row) for row in value)


def _is_place(value: Any) -> bool:
    return _list(FINITE, "", [3]).fits(value)


def at_most(limit: int) -> Kind:
    """A whole number from one on, up to a limit beyond which nothing fits a machine."""
    return _whole(1, f"a whole number from 1 to {limit:,}", limit)


WORD: Final = Kind(_is_word, "a word")
NAME: Final = Kind(
    lambda value: isinstance(value, str) and re.fullmatch(r"[\w-]+", value) is not None,
    "letters, digits, _ and - alone, as a folder is named so",
)
ANYTHING: Final = Kind(lambda _: True, "anything", optional=True)
TRUTH_VALUE: Final = Kind(lambda value: isinstance(value, bool), "true or false")
NUMBER: Final = Kind(is_number, "a number")
FINITE: Final = Kind(is_finite, "a finite number")
POSITIVE: Final = _number(lambda value: value > 0.0, "a positive number")
NOT_NEGATIVE: Final = _number(lambda value: value >= 0.0, "a number, zero or more")
SHARE: Final = _number(lambda value: 0.0 < value <= 1.0, "more than 0 and at most 1")
NATURAL: Final = _whole(1, "a whole number, one or more")
COUNT: Final = _whole(0, "a whole number, zero or more")
_SOME: Final = range(1, sys.maxsize)
NATURALS: Final = _list(NATURAL, "a list of whole numbers, one or more", _SOME)
COUNTS: Final = _list(COUNT, "a list of different whole numbers, zero or more each", different=True)
NUMBERS: Final = _list(NUMBER, "a list of numbers")
_TOLERANCE: Final = _number(lambda value: 0.0 < value <= 0.1, "more than 0 and at most 0.1")
_STEP: Final = _number(lambda value: 0.0 < value <= 10.0, "positive and at most 10, in s")
_PLACE: Final = Kind(_is_place, "three numbers, in metres")
_FORCE: Final = Kind(_is_place, "three numbers, in N")
_AXIS: Final = Kind(lambda value: _is_place(value) and any(value), "three numbers, not all zero")
_PLACES: Final = Kind(
    lambda value: isinstance(value, list) and len(value) > 1 and all(map(_is_place, value)),
    "a list of two or more places of three numbers, in m",
)
_RADII: Final = Kind(
    lambda value: (
        POSITIVE.fits(value)
        or (isinstance(value, list) and all(_list(FINITE, "", [2, 3]).fits(each) for each in value))
    ),
    "a positive number, or a list of arc lengths with one or two radii there, in m",
)
_POSITIVES: Final = _list(POSITIVE, "a list of positive numbers")
_COLUMNS: Final = _list(NATURAL, "a list of different chambers, tendons or muscles, from 1", _SOME, different=True)
_ORDER: Final = Kind(lambda value: value in (1, 2), "1 or 2")
_TRIALS: Final = Kind(
    lambda value: COUNT.fits(value) or (isinstance(value, list) and all(map(_is_word, value))),
    "a number of trials, or a list of their names",
)

_SPAN: Final = Kind(
    lambda value: _list(FINITE, "", [2]).fits(value) and value[0] <= value[1], "two rising numbers, in m"
)
_AT: Final = Kind(lambda value: FINITE.fits(value) or _SPAN.fits(value), "a finite number or two rising ones, in m")
PLACE: Final = Group({key: absent(optional(_AT)) for key in ("x", "y", "z")} | {"tolerance": absent(POSITIVE)})
MATERIAL: Final = Group({"model": absent(WORD)}, each=NUMBER)
_BOX: Final[Mapping[str, Spec]] = {
    "size": _list(POSITIVE, "three positive numbers, in m", [3]),
    "divisions": _list(at_most(10_000), "three whole numbers from 1 to 10,000", [3]),
}
_NODES = Kind(lambda value: value in (8, 20, 27), "one of 8, 20, 27")
_MESHES: Final[Mapping[str, Mapping[str, Spec]]] = {
    "box_hexahedra": {**_BOX, "nodes": absent(_NODES)},
    "box_tetrahedra": {**_BOX, "order": absent(_ORDER)},
    "boxes": {
        "boxes": Kind(
            lambda value: isinstance(value, list) and all(_PLACES.fits(each) and len(each) == 2 for each in value),
            "a list of boxes, each by its lowest and its highest corner of three numbers, in m",
        ),
        "size": POSITIVE,
        "nodes": _NODES,
    },
    "file": {"path": WORD, "units": one_of(*METRES_PER_UNIT), "order": _ORDER, "drop_unreferenced": TRUTH_VALUE},
    "surface": {"path": WORD, "units": one_of(*METRES_PER_UNIT), "size": POSITIVE, "order": _ORDER},
    "rod": {
        "centreline": _PLACES,
        "radii": _RADII,
        **dict.fromkeys(("layers", "core", "rings"), at_most(10_000)),
        "nodes": _NODES,
        "grading": absent(_number(lambda value: 0.0 <= value <= 1.0, "a number from 0 to 1")),
    },
    "arm": {"name": WORD},
    "arm_generated": {
        **dict.fromkeys(("cells", "profile", "outline"), WORD),
        **dict.fromkeys(("size", "wall", "web"), POSITIVE),
        **dict.fromkeys(("layers", "core"), optional(POSITIVE)),
        **dict.fromkeys(("chamber_lengths", "caps", "radii"), _POSITIVES),
        "chambers": NATURAL,
        "rotations": NUMBERS,
        "order": _ORDER,
    },
}


def _mesh_group(settings: Any) -> Group:
    """What the group ``mesh`` must be, by its kind."""
    kind = settings.get("kind") if isinstance(settings, Mapping) else None
    if isinstance(settings, Mapping) and kind not in _MESHES:
        *some, last = _MESHES
        raise InputError(f"mesh.kind is {kind!r}: choose {', '.join(some)} or {last}.")
    return Group({"kind": WORD, **_MESHES.get(str(kind), {})})


_SOLVER = Group(
    {
        **dict.fromkeys(("name", "linear_solver", "factors", "on_failure"), WORD),
        **dict.fromkeys(("max_iterations", "memory", "refactor_after"), NATURAL),
        "relative_tolerance": _TOLERANCE,
        "absolute_tolerance": NOT_NEGATIVE,
    }
)
_PHYSICS = Group({"mass": one_of(*MASS_MODES), "volume_integration": one_of(*VOLUME_INTEGRATIONS)})
NETWORK: Final = Group(
    {
        "kind": one_of(*NETWORK_KINDS),
        **dict.fromkeys(("position_modes", "velocity_modes"), absent(COUNT)),
        "force_modes": absent(NATURAL),
        "force_basis": absent(one_of(*FORCE_BASES)),
        "blocks": at_most(100),
        "layers": _whole(0, "a whole number from 0 to 100", 100),
        "width": at_most(16_384),
        "activation": one_of(*ACTIVATIONS),
        "recurrent": absent(optional(at_most(1_024))),
    }
)
TRAINER: Final = Group(
    {
        **dict.fromkeys(("epochs", "batch_size", "step_epochs", "rollout_every"), NATURAL),
        **dict.fromkeys(("learning_rate", "final_learning_rate"), POSITIVE),
        **dict.fromkeys(("weight_decay", "noise", "scale_weight"), NOT_NEGATIVE),
        "schedule": one_of(*SCHEDULES),
        "gamma": SHARE,
        "linear_noise": optional(POSITIVE),
        "selection": one_of(*SELECTIONS),
        "sequence": absent(NATURAL),
    }
)
IN_THE_LOOP: Final = Group(
    {
        **dict.fromkeys(("epochs", "patience", "memory", "rollout_every"), NATURAL),
        "penalty": NOT_NEGATIVE,
        "hold_out": TRUTH_VALUE,
    }
)
_PRIOR = Group({"mean": FINITE, "deviation": POSITIVE}, optional=True, absent=True)
_RANGE = {"lower": FINITE, "upper": FINITE, "logarithmic": absent(TRUTH_VALUE), "prior": _PRIOR}
_PLACEMENT = Group(dict.fromkeys(("markers", "shift", "turn"), absent(optional(POSITIVE))), optional=True, absent=True)
_GRID = Group({"lower": FINITE, "upper": FINITE, "logarithmic": TRUTH_VALUE, "points": NATURAL})
_IDENTIFY = Group(
    {
        "integrator": optional(one_of(*INTEGRATORS)),
        **dict.fromkeys(("substeps", "starts", "max_evaluations"), NATURAL),
        "parameters": Group(each=Group(_RANGE, optional=True)),
        "elastic": optional(Group(each=Group(_RANGE, optional=True))),
        "placement": _PLACEMENT,
        "first_guess": Group(each=FINITE),
        "trials": optional(NATURAL),
        "seconds": optional(POSITIVE),
        "candidates": COUNT,
        "tolerance": POSITIVE,
        "grid": optional(Group({"youngs_modulus": _GRID, "poissons_ratio": absent(_GRID)})),
    }
)
_RELEASE = Group(
    {
        **dict.fromkeys(("hold_modes", "velocity_modes"), COUNT),
        **dict.fromkeys(("window", "noise", "speed"), POSITIVE),
        **dict.fromkeys(("delay", "sideways"), NOT_NEGATIVE),
        "iterations": NATURAL,
    }
)
_MARKERS = Group(
    {
        **dict.fromkeys(("tracked", "reference"), Group(each=_PLACE)),
        "bind": one_of(*BINDINGS),
        "bind_to": optional(PLACE),
        "patch": absent(POSITIVE),
        "labels": absent(one_of("recorded", "assigned")),
        "plane": absent(
            optional(_list(one_of("x", "y", "z"), "two different ones of x, y and z", [2], different=True))
        ),
        "frame": absent(one_of(*FRAMES)),
        **dict.fromkeys(("largest_residual", "largest_distance", "largest_distortion"), POSITIVE),
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
        **dict.fromkeys(("start", "ramp"), absent(NOT_NEGATIVE)),
    },
    optional=True,
    absent=True,
    short=True,
)
_TRIAL = Group(
    {
        "file": absent(Kind(_is_word, "the name of a file")),
        "inputs": absent(_list(FINITE, "a list of finite numbers, one for each chamber, tendon or muscle", _SOME)),
        "onset": absent(NOT_NEGATIVE),
        "input_delay": absent(FINITE),
        "labels": absent(
            _list(WORD, "a list of different words, one for each marker of the file", _SOME, different=True)
        ),
        "payload": absent(Kind(NOT_NEGATIVE.fits, "a mass, zero or more, in kg")),
        "begins": absent(one_of(*BEGINNINGS)),
        "pull": absent(_FORCE),
        "base_motion": _BASE_MOTION,
    }
)
_SEQUENCES = Group(
    {
        "mean": absent(FINITE),
        **dict.fromkeys(("deviation", "correlation_time"), absent(POSITIVE)),
        "correlation": absent(
            Kind(lambda value: is_finite(value) or _is_matrix(value), "a finite number, or a matrix of them")
        ),
        "rest": absent(NOT_NEGATIVE),
    }
)
_FIBRES = Group({"angles": NUMBERS, "toe": POSITIVE, "stiffness": NOT_NEGATIVE}, optional=True)
_OFFSETS = Kind(
    lambda value: (
        isinstance(value, list)
        and len(value) in (1, 2)
        and all(_AXIS.fits(each) or _PLACES.fits(each) for each in value)
    ),
    "a list of one or two directions, each of three numbers, not all zero, or of three for each guide",
)
_ROUTE = Group({"guides": _PLACES, "pieces": absent(at_most(10_000)), "offsets": absent(_OFFSETS)})
_TENDONS = Group(
    {
        "routes": Group(each=_ROUTE),
        "commanded": one_of("tension", "contraction"),
        "stiffness": NOT_NEGATIVE,
        **dict.fromkeys(("toe", "reach"), absent(POSITIVE)),
    },
    optional=True,
)
_WITHIN = absent(Group(dict.fromkeys("xyz", absent(_SPAN))))
_MUSCLES = Group(
    {
        "bundles": Group(each=Group({"direction": _AXIS, "within": _WITHIN})),
        "commanded": optional(one_of("stress", "contraction")),
        "stiffness": NOT_NEGATIVE,
        "toe": absent(POSITIVE),
    },
    optional=True,
)
_LIMIT = Group(dict.fromkeys(SPLITS, NATURAL), optional=True)
_SPLIT = dict.fromkeys(SPLITS, _TRIALS)
_TABLE = Group(
    {
        "columns": Kind(
            lambda value: isinstance(value, list) and all(each is None or _is_word(each) for each in value),
            "a list of headers such as 'time [s]' or 'tip.x [mm]', null for columns that are not read",
        ),
        "header_lines": absent(COUNT),
    },
    optional=True,
    absent=True,
)
_SIGNED_AXES = [sign + axis for axis in "xyz" for sign in ("", "-")]
_AXES = absent(optional(_list(one_of(*_SIGNED_AXES), f"three of {', '.join(_SIGNED_AXES)}", [3], different=True)))
_UP = Kind(lambda value: _is_word(value) or _is_place(value), "x, -x, y, -y, z, -z, three numbers, or null", True)
_RECORDED = Group(
    {
        "folder": optional(WORD),
        "units": optional(one_of(*METRES_PER_UNIT)),
        "table": _TABLE,
        "axes": _AXES,
        **dict.fromkeys(("rate", "seconds", "input_limit", "cutoff"), optional(POSITIVE)),
        "trials": Group(each=replace(_TRIAL, short=True)),
        **dict.fromkeys(("sequences", "longest_gap"), COUNT),
        "begins": one_of(*BEGINNINGS),
        "rest": one_of("held", "file"),
        "alignment": one_of("shared", "own"),
        "payload_at": optional(PLACE),
        "up": _UP,
        "rest_seconds": NOT_NEGATIVE,
        "steps": optional(NATURAL),
        "parts": optional(_COLUMNS),
        "valve": one_of("recorded", "detected"),
        "train_fraction": SHARE,
        **dict.fromkeys(("horizons", "input_scales"), _POSITIVES),
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
        **dict.fromkeys(("weights_g", "angles_deg", "amplitudes"), absent(Group(each=NUMBERS))),
        "base_motion": _BASE_MOTION,
        "folds": absent(optional(one_of(*FOLDS))),
        "limit": _LIMIT,
    }
)
_CHAMBERS = Group({"count": NATURAL, "axis": _AXIS}, optional=True)
_ABLATION = Group(
    {
        "counts": _list(NATURAL, "a list of different positive whole numbers", _SOME, different=True),
        "draws": NATURAL,
        **dict.fromkeys(("modes", "processes"), optional(NATURAL)),
    },
    absent=True,
)

GRADIENTS: Final = ("reduced", "adjoint")  # of the corrections of plans
_SHAPE: Final = Kind(
    lambda value: value in ("circle", "eight") or (_is_word(value) and re.fullmatch("[A-Z]", value) is not None),
    "circle, eight or a capital letter",
)
_MODEL_NAMES: Final = _list(
    one_of(*MODELS), f"a list of different models of {', '.join(MODELS)}", _SOME, different=True
)
_DIFFERENT: Final = _list(POSITIVE, "a list of different positive numbers", _SOME, different=True)
_CONTROL: Final = Group(
    {
        **dict.fromkeys(("models", "receding"), _MODEL_NAMES),
        "tracked": _list(WORD, "a list of different markers", _SOME, different=True),
        "shapes": _list(_SHAPE, "a list of different ones of circle, eight and capital letters", _SOME, different=True),
        "seconds": _DIFFERENT,
        "centre": _PLACE,
        "size": POSITIVE,
        **dict.fromkeys(("right", "up"), _AXIS),
        "limits": Group({"low": NOT_NEGATIVE, **dict.fromkeys(("high", "rate"), POSITIVE)}),
        "plan": Group(
            {
                **dict.fromkeys(("spacing", "effort", "change", "reach"), POSITIVE),
                "iterations": NATURAL,
                "corrections": COUNT,
                "gradient": one_of(*GRADIENTS),
            }
        ),
        "horizon": Group(
            {
                **dict.fromkeys(("seconds", "effort", "change"), POSITIVE),
                **dict.fromkeys(("pieces", "iterations"), NATURAL),
            }
        ),
        "estimate": Group(dict.fromkeys(("observed", "rate", "bias"), POSITIVE)),
        "feedback": Group({"gains": _DIFFERENT, "pressed": SHARE, "settles": POSITIVE}),
        "reduction": Group(
            {
                "modes": _list(NATURAL, "a list of different whole numbers, one or more", _SOME, different=True),
                **dict.fromkeys(("equilibria", "tangents", "motions", "batch"), NATURAL),
                "seconds": POSITIVE,
            }
        ),
    },
    optional=True,
)


def _laboratory_group(settings: Any) -> Group:
    """What the group ``laboratory`` must be."""
    mesh = settings.get("mesh") if isinstance(settings, Mapping) else None
    return Group(
        {
            "mesh": _mesh_group(mesh),
            "time_step": _STEP,
            "integrator": one_of(*INTEGRATORS),
            "material": MATERIAL,
            "fibres": absent(_FIBRES),
            "sequences": absent(_SEQUENCES),
            "rate": absent(optional(POSITIVE)),
            **dict.fromkeys(("noise", "placement_noise"), NOT_NEGATIVE),
            "tilt": absent(_number(lambda value: 0.0 <= value <= 20.0, "an angle from 0 to 20 degrees")),
            "held_seconds": absent(_number(lambda value: value >= 0.25, "0.25 s or more")),
            "seconds": absent(optional(POSITIVE)),
            "trials": Group(each=_TRIAL),
            **dict.fromkeys(SPLITS, absent(_TRIALS)),
        },
        optional=True,
    )


def configuration_group(config: Mapping[str, Any]) -> Group:
    """What a whole configuration must be, by what it asks for."""
    return Group(
        {
            "name": NAME,
            **dict.fromkeys(("title", "device", "dtype"), WORD),
            "seed": _whole(0, "between 0 and 2^63 - 1", 2**63 - 1),
            "gravity": Kind(_is_place, "three finite numbers, in m/s^2"),
            "time_step": _STEP,
            "integrator": one_of(*INTEGRATORS),
            "mesh": _mesh_group(config.get("mesh")),
            "physics": _PHYSICS,
            "solver": _SOLVER,
            **dict.fromkeys(("fixed", "tip"), PLACE),
            "simulation": MATERIAL,
            "target": absent(optional(MATERIAL)),
            "chambers": _CHAMBERS,
            "fibres": _FIBRES,
            "tendons": _TENDONS,
            "muscles": _MUSCLES,
            "medium": Group(
                {
                    "density": NOT_NEGATIVE,
                    **dict.fromkeys(("linear", "normal", "tangential", "layer"), absent(NOT_NEGATIVE)),
                    "buoyancy": absent(TRUTH_VALUE),
                },
                optional=True,
            ),
            "payload_string": Group(
                {"length": POSITIVE, "compliance": absent(NOT_NEGATIVE), "toe": absent(POSITIVE)}, optional=True
            ),
            "coupling": one_of(*COUPLINGS),
            "mesh_check": optional(_number(lambda value: 1.0 < value <= 4.0, "a number above 1, 4 at most")),
            "force_frame": one_of(*FORCE_FRAMES),
            **dict.fromkeys(("range_guard", "correct_uncorrected", "timing"), TRUTH_VALUE),
            "data": _SIMULATED if config.get("markers") is None else _RECORDED,
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
            "simfree": Group(dict.fromkeys(("network", "trainer"), Group(each=ANYTHING))),
            "refinement": refinement_group(config.get("refinement")),
            "in_the_loop": optional(IN_THE_LOOP),
            "identify": optional(_IDENTIFY),
            "release": _RELEASE,
            "markers": optional(_MARKERS),
            "actuation": Group({"filter_time_constants": _POSITIVES, "sees_payload": TRUTH_VALUE}),
            "parallel": Group(
                {
                    **dict.fromkeys(("processes", "batch"), optional(NATURAL)),
                    "backend": one_of(*BACKENDS),
                    "address": optional(WORD),
                }
            ),
            "published": Group(
                {"simulation": MATERIAL, "physics": _PHYSICS, "integrator": one_of(*INTEGRATORS)}, optional=True
            ),
            "laboratory": _laboratory_group(config.get("laboratory")),
            "ablation": _ABLATION,
            "control": _CONTROL,
            **dict.fromkeys(("budget", "tuned"), absent(WORD)),
            "tune": absent(Group(each=ANYTHING)),
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
