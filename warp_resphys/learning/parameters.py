"""The names of what may be identified, and what a configuration expects of it.

A name is that of a simulator's parameter (``youngs_modulus``), the same of one part of an energy that has several
(``tendon_stiffness_left``), what is unknown of an input's commands (``pressure_delay``), or one of a few others.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import torch

from ..dynamics.simulator import Simulator
from ..energies.strings import PAYLOAD
from ..io.errors import InputError

MASS_FACTOR: Final = "attached_mass_factor"
TILTS: Final = ("gravity_tilt_1", "gravity_tilt_2")
HUNG: Final = ("attached_mass", PAYLOAD.name)
_COMMANDS: Final = ("factor", "delay", "rise")  # that may be unknown of an input, in the order in which they act


def known_parameters(simulator: Simulator) -> tuple[str, ...]:
    """What can be identified of a simulator; see `replay.Replay`."""
    constants = (*(name for name in simulator.parameters if name != "gravity"), *parameters_of_parts(simulator))
    driven = [f"{name}_{what}" for name in simulator.inputs if name not in HUNG for what in _COMMANDS]
    return (*constants, MASS_FACTOR, *TILTS, *driven)


def parameters_of_parts(simulator: Simulator) -> dict[str, tuple[str, int]]:
    """The parameter and the number of the part, for every part of energies that have several, by name."""
    return {
        f"{name}_{part}": (name, number)
        for name, parts in simulator.parts.items()
        if len(parts) > 1
        for number, part in enumerate(parts)
    }


def check_known(names: Iterable[str], known: Sequence[str]) -> None:
    """Refuses a name that no parameter has.

    Raises:
        InputError: it is none of those that are known.
    """
    for name in names:
        if name not in known:
            raise InputError(f"there is no parameter {name!r} to identify: choose from {', '.join(known)}.")


def constants_of(simulator: Simulator, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """What `Simulator.prepare` takes, of values (E,) of parameters; those of commands and of payloads are left out.

    Args:
        simulator: gives what no parameter sets.
        parameters: by a name of `known_parameters`.

    Raises:
        InputError: there is no gravity to tilt.
    """
    found = {name: value[:, None] for name, value in parameters.items() if name in simulator.parameters}
    found |= _by_part(simulator, parameters)
    if any(name in parameters for name in TILTS):
        found["gravity"] = tilted_gravity(simulator, *(parameters.get(name) for name in TILTS))
    return found


def _by_part(simulator: Simulator, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """(E, count) constants of energies of which parts have values (E,) of their own, the others theirs all."""
    of_parts, found = parameters_of_parts(simulator), dict[str, list[torch.Tensor]]()
    for name, value in parameters.items():
        if name not in of_parts:
            continue
        constant, part = of_parts[name]
        if constant not in found:
            own = parameters[constant] if constant in parameters else simulator.tensor(simulator.constants[constant])
            own = own[:, None] if constant in parameters else simulator.parameters[constant].shaped(own)
            found[constant] = list(own.expand(len(value), simulator.counts[constant]).unbind(1))
        found[constant][part] = value
    return {name: torch.stack(columns, 1) for name, columns in found.items()}


def tilted_gravity(simulator: Simulator, first: torch.Tensor | None, second: torch.Tensor | None) -> torch.Tensor:
    """(1 or B, 3) the simulator's gravity, turned by components along the axes across it [m/s^2].

    Args:
        simulator: gives the gravity that is turned, and its strength.
        first: (B,) component of the direction along the first axis across gravity (the one of lowest number), or None.
        second: (B,) along the second.

    Raises:
        InputError: there is no gravity to turn.
    """
    gravity = simulator.tensor(simulator.gravity)
    strength = gravity.norm()
    if first is None and second is None:
        return gravity[None]
    if not float(strength) > 0.0:
        raise InputError("without gravity its tilt cannot be identified: leave gravity_tilt_1 and gravity_tilt_2 out.")
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
    """The input, and which of factor, delay and rise a name is of its commands; both empty for another name."""
    driven, _, what = name.rpartition("_")
    return (driven, what) if driven in simulator.inputs and driven not in HUNG and what in _COMMANDS else ("", "")


def configured_parameters(simulator: Simulator, names: Iterable[str]) -> dict[str, float]:
    """What a simulator has of parameters: its own constants, a part that of all parts; else what changes nothing."""
    of_parts = parameters_of_parts(simulator)

    def find(name: str) -> float:
        constant, part = of_parts.get(name, (name, None))
        if constant in simulator.parameters:
            value = simulator.tensor(simulator.constants[constant]).flatten()
            return float(value[0 if part is None or len(value) == 1 else part])
        driven, what = command_of(simulator, name)
        return 1.0 if name == MASS_FACTOR or (driven and what == "factor") else 0.0

    return {name: find(name) for name in names}
