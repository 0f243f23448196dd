"""The parameters that can be identified: their names, ranges and effect on a simulator.

A name is that of a simulator's constant (``youngs_modulus``), of the constant of one part of an
energy with several parts (``tendon_stiffness_left``), of an input's response (``pressure_delay``),
or one of `MASS_FACTOR` and `TILTS`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, TypeVar

import numpy as np
import torch

from ..core.dynamics.simulator import Simulator
from ..core.energies.tendons import OFFSETS, Tendons
from ..data.input_response import RESPONSES, SLOPES
from ..io.errors import InputError, naming
from ..settings.learning import Bounds

MASS_FACTOR: Final = "attached_mass_factor"
TILTS: Final = ("gravity_tilt_1", "gravity_tilt_2")
T = TypeVar("T")
_OWN: Final = "@"
_EXACT = 1e-12  # relative tolerance of a solver, small enough for differences of solutions
HUNG: Final = ("attached_mass",)
# Of identified input responses.
_NOT_NEGATIVE: Final = ("delay", "rise", "slew", "dead_band", "backlash", *SLOPES)


Limits = Bounds | tuple[float, float]


def ranges_of(parameters: Mapping[str, Limits]) -> dict[str, Bounds]:
    """Returns the bounds of parameters, also from pairs of numbers,
    which are logarithmic if both are positive.

    Raises:
        InputError: neither.
    """
    ranges = dict[str, Bounds]()
    for name, limits in parameters.items():
        if isinstance(limits, Bounds):
            ranges[name] = limits
            continue
        with naming(f"parameters.{name}: "):
            if isinstance(limits, str) or not isinstance(limits, Sequence) or len(limits) != 2:
                raise InputError(
                    f"a range is {limits!r}: give the smallest and the largest value, or Bounds."
                )
            bounds = Bounds(lower=limits[0], upper=limits[1])
        ranges[name] = bounds.changed(logarithmic=bounds.lower > 0.0)
    return ranges


def value_name(name: str, owner: str) -> str:
    """Name of a parameter's value for one trial, or for those of one session, such as
    ``tension_factor@bend_1``.
    """
    return f"{name}{_OWN}{owner}"


def split_name(name: str) -> tuple[str, str]:
    """The parameter, and the trial or session whose value it is.

    Empty for the value of all others.
    """
    parameter, _, owner = name.partition(_OWN)
    return parameter, owner


def identifiable_parameters(simulator: Simulator) -> tuple[str, ...]:
    """Names of the parameters of a simulator that can be identified, which are numbers.

    See `replay.Replay`.
    """
    numbers = (
        name
        for name, quantity in simulator.parameters.items()
        if name != "gravity" and not quantity.shape
    )
    responses = [
        f"{name}_{word}" for name in simulator.inputs if name not in HUNG for word in RESPONSES
    ]
    return (*numbers, MASS_FACTOR, *TILTS, *responses, *parameters_of_parts(simulator))


def parameters_of_parts(simulator: Simulator) -> dict[str, tuple[str, int]]:
    """Name for all parts and index of the part, by parameter name, for energies with several parts.

    These are constants, such as ``tendon_stiffness_left``, and responses of inputs, such as
    ``pressure_factor_1``.
    """
    found = dict[str, tuple[str, int]]()
    for name, parts in simulator.parts.items():
        words = (
            [f"{name}_{word}" for word in RESPONSES if name not in HUNG]
            if name in simulator.inputs
            else [name]
        )
        for number, part in enumerate(parts if len(parts) > 1 else ()):
            found |= {f"{whole}_{part}": (whole, number) for whole in words}
    return found


def by_part(
    simulator: Simulator, values: Mapping[str, T], ranges: Mapping[str, Bounds]
) -> dict[str, T]:
    """Returns values by name, with one for each part where the range of a parameter is per part."""
    names: dict[str, list[str]] = {}
    for part, (whole, _) in parameters_of_parts(simulator).items():
        names.setdefault(whole, []).append(part)
    shared = {
        name: value for name, value in values.items() if name in ranges and ranges[name].by_part
    }
    found = dict[str, T]()
    for name, value in shared.items():
        found |= dict.fromkeys(names.get(name, [name]), value)
    return found | {name: value for name, value in values.items() if name not in shared}


def replaced(
    simulator: Simulator, known: Mapping[str, Any], others: Mapping[str, Any]
) -> dict[str, Any]:
    """Returns values of parameters with others.

    A common one takes the place of those of the parts.
    """
    of_parts = parameters_of_parts(simulator)
    return {
        name: x for name, x in known.items() if of_parts.get(name, ("", 0))[0] not in others
    } | {**others}


def check_names(names: Iterable[str], known: Sequence[str]) -> None:
    """Checks that all names are names of parameters.

    Raises:
        InputError: a name is unknown.
    """
    for name in (split_name(name)[0] for name in names):
        if name not in known:
            parts = [part for part in known if any(part.startswith(f"{whole}_") for whole in known)]
            shown = ", ".join(one for one in known if one not in parts)
            also = f", or those of a part, such as {parts[0]}" if parts else ""
            raise InputError(
                f"there is no parameter {name!r} to identify: choose from {shown}{also}."
            )


def check_ranges(
    simulator: Simulator,
    ranges: Mapping[str, Bounds],
    known: Sequence[str],
    sessions: Mapping[str, str | None],
) -> None:
    """Checks the ranges of parameters that are to be identified from trials.

    Args:
        simulator: of the body.
        ranges: ranges by name.
        known: names that may be identified.
        sessions: session of each trial, by its name.

    Raises:
        InputError: there is no range, a name is unknown, a parameter stands beside those of its
            parts, a time or a slope may be negative, tendons leave the body at a bound, or `per`
            names what the body or a trial lacks.
    """
    if not ranges:
        raise InputError(
            f"parameters is empty: give a range for at least one of {', '.join(known)}."
        )
    with naming("parameters: "):
        check_names(ranges, known)
    of_parts = parameters_of_parts(simulator)
    for name, limits in ranges.items():
        parts = [part for part, (whole, _) in of_parts.items() if whole == name]
        beside = [part for part in parts if part in ranges]
        if limits.by_part and beside:
            raise InputError(
                f"parameters.{name}.per names part, "
                f"but parameters has {beside[0]} as well: take one out."
            )
        if parts and {*parts} <= {*ranges}:
            raise InputError(
                f"parameters names {name} and its parts, {', '.join(parts)}: choose one."
            )
        word = command_of(simulator, name)[1]
        if word in _NOT_NEGATIVE and limits.lower < 0.0:
            raise InputError(
                f"parameters.{name}.lower is {limits.lower:g}: a {word.replace('_', ' ')} is not "
                "negative: set it to zero or more."
            )
        if limits.by_part and not parts:
            raise InputError(
                f"parameters.{name}.per names part, "
                f"but the body has no parts with a {name}: leave it out."
            )
        if limits.owner in ("material", "lens"):
            raise InputError(
                f"parameters.{name}.per is {limits.per}, "
                "which is for data.kind pictures: leave it out."
            )
        if limits.owner == "session" and (
            lost := next((trial for trial, of in sessions.items() if not of), None)
        ):
            raise InputError(
                f"parameters.{name}.per names session, but the trial {lost!r} has none: set "
                f"data.trials.{lost}.session."
            )
        whole, part = of_parts.get(name, (name, None))
        for end, value in (("lower", limits.lower), ("upper", limits.upper)):
            with naming(f"parameters.{name}.{end}: "):
                _check_routes(simulator, whole, part, value)


def _check_routes(simulator: Simulator, name: str, part: int | None, value: float) -> None:
    """Refuses a value of an offset with which tendons, all or one, leave the body."""
    for tendons in (energy for energy in simulator.body.energies if isinstance(energy, Tendons)):
        for number, quantity in enumerate(OFFSETS[: tendons.offset_count]):
            if quantity.name == name:
                offsets = np.zeros((tendons.count, tendons.offset_count))
                offsets[slice(None) if part is None else part, number] = value
                tendons.rerouted(offsets).points(simulator.body.mesh)


def constants_of(
    simulator: Simulator, parameters: Mapping[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Constants for `Simulator.prepare` from values (E,) of parameters.

    Those of inputs and payloads are ignored.

    Args:
        simulator: gives the constants that are not a parameter.
        parameters: values by a name of `identifiable_parameters`.

    Raises:
        InputError: there is no gravity to tilt.
    """
    known = {name: value for name, value in parameters.items() if name in simulator.parameters}
    constants = {
        name: value[:, None] if value.ndim == 1 else value for name, value in known.items()
    }
    constants |= _by_part(simulator, parameters)
    if any(name in parameters for name in TILTS):
        constants["gravity"] = tilted_gravity(simulator, *(parameters.get(name) for name in TILTS))
    return constants


def _by_part(
    simulator: Simulator, parameters: Mapping[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """(E, count) constants of energies with values (E,) for single parts.

    The other parts have the common value.
    """
    of_parts, columns = parameters_of_parts(simulator), dict[str, list[torch.Tensor]]()
    for name, value in parameters.items():
        constant, part = of_parts.get(name, ("", 0))
        if constant not in simulator.parameters:
            continue
        if constant not in columns:
            common = (
                parameters[constant]
                if constant in parameters
                else simulator.tensor(simulator.defaults[constant])
            )
            common = (
                common[:, None]
                if constant in parameters
                else simulator.parameters[constant].shaped(common)
            )
            columns[constant] = list(
                common.expand(len(value), simulator.counts[constant]).unbind(1)
            )
        columns[constant][part] = value
    return {name: torch.stack(values, 1) for name, values in columns.items()}


def tilted_gravity(
    simulator: Simulator, first: torch.Tensor | None, second: torch.Tensor | None
) -> torch.Tensor:
    """(1 or B, 3) the simulator's gravity, tilted along the two axes perpendicular to it [m/s^2].

    Args:
        simulator: gives the gravity before the tilt.
        first: (B,) component of the direction along the first axis across gravity
            (of lowest index); None for zero.
        second: (B,) component along the second axis; None for zero.

    Raises:
        InputError: there is no gravity to tilt.
    """
    gravity = simulator.tensor(simulator.gravity)
    strength = gravity.norm()
    if first is None and second is None:
        return gravity[None]
    if not float(strength) > 0.0:
        raise InputError(
            "without gravity its tilt cannot be identified: leave gravity_tilt_1 and "
            "gravity_tilt_2 out."
        )
    down = gravity / strength
    axes = torch.eye(3, dtype=gravity.dtype, device=gravity.device)
    along = int(down.abs().argmax())
    direction = down[None]
    for axis, tilt in zip([i for i in range(3) if i != along], (first, second), strict=True):
        if tilt is not None:
            across = axes[axis] - (axes[axis] @ down) * down
            direction = direction + tilt[:, None] * across / across.norm()
    return strength * direction / direction.norm(dim=1, keepdim=True)


def command_of(simulator: Simulator, name: str) -> tuple[str, str]:
    """Input and the word of `RESPONSES` in a name such as ``pressure_delay``.

    Else two empty strings.
    """
    name = parameters_of_parts(simulator).get(name, (name, 0))[0]
    for word in RESPONSES:
        driven = name.removesuffix(f"_{word}")
        if driven != name and driven in simulator.inputs and driven not in HUNG:
            return driven, word
    return "", ""


def configured_parameters(simulator: Simulator, names: Iterable[str]) -> dict[str, float]:
    """Configured values of parameters: the simulator's constants,
    or the value without effect (factor, slopes: 1).
    """
    of_parts = parameters_of_parts(simulator)

    def find(name: str) -> float:
        constant, part = of_parts.get(name, (name, None))
        if constant in simulator.parameters:
            value = simulator.tensor(simulator.defaults[constant]).flatten()
            return float(value[0 if part is None or len(value) == 1 else part])
        return (
            1.0
            if name == MASS_FACTOR or command_of(simulator, name)[1] in ("factor", *SLOPES)
            else 0.0
        )

    return {name: find(name) for name in names}


def exact(simulator: Simulator) -> Simulator:
    """Returns a simulator whose solutions differ by their parameters alone,
    also where these hardly differ.
    """
    return replace(simulator, solver=simulator.settings.changed(relative_tolerance=_EXACT))
