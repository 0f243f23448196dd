r"""Weights on strings: masses that swing below a body and pull on it only when their strings are taut.

A string of length L and compliance c (inextensible for c = 0) is tied to a, the mean of some vertices, and carries a
mass m. In an implicit stage of effective length h, in which inertia and gravity alone would move the mass to y, its
position p minimises the sum of m/(2 h^2) |p - y|^2 and the string's energy. As p lies on the line from a to y, it can
be eliminated, which leaves a tension-only spring from a to y for the body,

    E(a) = k s(|a - y| - L),     k = M / (1 + c M),     M = m / h^2,

with s(e) = max(e, 0)^2 / 2, smoothed over a short distance (`kernels.axial.thread_pull`), and moves the mass to

    p = y + (k / M) s'(|a - y| - L) (a - y) / |a - y| .

So weights add no unknowns to the solve. A string that tightens removes the relative velocity along it, as in a
perfectly inelastic impact.
"""

import math
from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from ..io.errors import InputError
from ..kernels.axial import STRING
from ..mesh.volume_mesh import Mesh
from ..stepping.quantity import Parameter, Quantity, parameter
from ..stepping.state import ImplicitStage, State
from .base import BoundEnergy, Energy, EnergySite, EnergyStep, Memory
from .launcher import Launcher
from .term import LawTerm, PartPoints, PointSet

PAYLOAD = Quantity(
    "payload", "kg", 0.0, closed=True, per="string", typical=0.05, words="weight", shown_unit="g", shown_factor=1e3
)


def thread_pull(elongation: torch.Tensor, toe: float) -> torch.Tensor:
    """Returns the force of a thread of stiffness one [m], as the kernels have it (`kernels.axial.thread_pull`)."""
    tightening = elongation.clamp(0.0, toe)
    return tightening * (elongation - 0.5 * tightening) / toe


@dataclass(frozen=True)
class Strings(Energy):
    """Weights on strings.

    The input is ``payload`` [kg], constant during a motion; parameters are ``string_length`` [m] and
    ``string_compliance`` [m/N]; all with one value per string.

    Raises:
        InputError: no string, a string without vertices, or a length or compliance out of range.
    """

    inputs: ClassVar[tuple[Quantity, ...]] = (PAYLOAD,)

    tied_to: Sequence[NDArray[np.int64]]  # vertices of each string, which is tied to their mean
    # L [m]: a number, (S,), (B, 1) or (B, S) values
    length: Parameter = parameter(MISSING, "string_length", "m", per="string")
    # c [m/N], likewise
    compliance: Parameter = parameter(0.0, "string_compliance", "m/N", closed=True, per="string")
    toe: float = 1e-5  # elongation at which a string reaches its full stiffness [m]

    def __post_init__(self) -> None:
        """Checks the values."""
        if not len(self.tied_to):
            raise InputError("there is no string: say what each is tied to, or leave the strings out.")
        for number, vertices in enumerate(self.tied_to, 1):
            if not len(vertices):
                raise InputError(f"string {number} is tied to no vertex: give it one or more.")
        if not (np.isfinite(self.toe) and self.toe > 0.0):
            raise InputError(f"the toe of strings is {self.toe:g}: it must be positive, in m.")
        super().__post_init__()

    @property
    @override
    def count(self) -> int:
        return len(self.tied_to)

    @override
    def points(self, mesh: Mesh) -> tuple[PartPoints, ...]:
        """Returns one point per string, whose operators average over its vertices.

        Raises:
            InputError: a vertex that the mesh does not have.
        """
        most, count = max(map(len, self.tied_to)), len(mesh.vertices)
        for number, vertices in enumerate(self.tied_to, 1):
            if not (np.min(vertices) >= 0 and np.max(vertices) < count):
                raise InputError(f"string {number} is tied to a vertex that is not among the {count} of the mesh.")
        # Lists are padded with their first vertex and a zero operator.
        nodes = np.array([np.pad(v, (0, most - len(v)), constant_values=v[0]) for v in self.tied_to])
        operator = np.zeros((self.count, 1, most, 1))
        for row, vertices in zip(operator, self.tied_to, strict=True):
            row[0, : len(vertices)] = 1.0 / len(vertices)
        return (PartPoints(nodes, operator, np.arange(self.count), np.ones(self.count)),)

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> LawTerm:
        shapes = {"string_target": (self.count, 3), "string_stiffness": (self.count,), "string_length": (self.count,)}
        constants = [self.toe]
        return LawTerm(
            launcher, sets, STRING, shapes, self.count, constants=constants, stiffness=lambda v: v["string_stiffness"]
        )

    @override
    def bind(self, site: EnergySite) -> "BoundStrings":
        return BoundStrings(self, site)


class BoundStrings(BoundEnergy):
    """Weights on strings in a simulator.

    Memory is ``payload_position`` [m] and ``payload_velocity`` [m/s], (B, S, 3), and for BDF2 both one step earlier. If
    a state has none, the weights hang at rest on taut strings.
    """

    def __init__(self, strings: Strings, site: EnergySite) -> None:
        super().__init__(strings, site)
        self._strings = strings
        (points,) = site.points
        averages = np.zeros((strings.count, len(site.rest_positions)))
        np.add.at(averages, (np.arange(strings.count)[:, None], points.nodes), points.gradients[:, 0, :, 0])
        self._averages = site.tensor(averages)  # (S, N) matrix from vertices to the mean of each string's vertices
        shape = (strings.count, 3)
        self.memory = tuple(
            Memory(f"payload_{when}{what}", unit, shape, "string")
            for when in ("", "previous_")
            for what, unit in (("position", "m"), ("velocity", "m/s"))
        )

    def _masses(self, step: EnergyStep) -> torch.Tensor:
        """Returns the masses (B, S), zero without the input [kg]."""
        zeros = self._averages.new_zeros(step.state.batch, self._strings.count)
        return step.inputs.get(PAYLOAD.name, zeros)

    @override
    def load(self, step: EnergyStep) -> torch.Tensor | None:
        if math.isfinite(step.stage.step):
            return None
        gravity = step.gravity.expand(step.state.batch, 3)
        return torch.einsum("bs,sn,bc->bnc", self._masses(step), self._averages, gravity)

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        mass, compliance = self._inertia(step), step.value("string_compliance")
        free = self._free(self._stage(self._weights(step)), step)
        return {"string_target": free, "string_stiffness": mass / (1.0 + compliance * mass)}

    @override
    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        """Returns values of strings without force: at rest their pull is a dead load."""
        zeros = self._averages.new_zeros(batch, self._strings.count)
        return {"string_target": zeros[..., None].expand(-1, -1, 3), "string_stiffness": zeros}

    @override
    def end_step(self, step: EnergyStep, x: torch.Tensor, q: torch.Tensor) -> dict[str, torch.Tensor]:
        weights = self._weights(step)
        free = self._free(self._stage(weights), step)
        tied = torch.einsum("sn,bnc->bsc", self._averages, x)
        at = self._pulled(tied, free, self._inertia(step), step)
        new = self.site.method.finish(weights, at, self.site.time_step)
        values = (new.q, new.v, *(new.previous or ()))
        return {memory.name: value for memory, value in zip(self.memory, values, strict=False)}

    def _inertia(self, step: EnergyStep) -> torch.Tensor:
        """Returns M = m / h^2, (B, S) [N/m]."""
        return self._masses(step) / step.stage.step**2

    def _weights(self, step: EnergyStep) -> State:
        """Returns the state of the weights, (B, S, 3), at the start of a step.

        Without memory they hang at rest on taut strings, or are at a without gravity.
        """
        state = step.state
        stored = [state.memory[memory.name] for memory in self.memory if memory.name in state.memory]
        if len(stored) >= 2:
            previous = (stored[2], stored[3]) if len(stored) == 4 else None
            return State(stored[0], stored[1], previous)
        gravity = step.gravity.expand(state.batch, 3)[:, None]
        size = gravity.norm(dim=-1, keepdim=True)
        pull = self._masses(step) * size[..., 0]
        length = step.value("string_length") + step.value("string_compliance") * pull
        length = length + 0.5 * self._strings.toe
        down = torch.where(size > 0.0, gravity / size, 0.0)
        tied = [torch.einsum("sn,bnc->bsc", self._averages, field) for field in (state.q, state.v)]
        return State(tied[0] + length[..., None] * down, tied[1])

    def _stage(self, weights: State) -> ImplicitStage:
        return self.site.method.stage(weights, self.site.time_step)

    def _free(self, stage: ImplicitStage, step: EnergyStep) -> torch.Tensor:
        """Returns y (B, S, 3), where inertia and gravity alone move the weights [m]."""
        return stage.target + stage.step**2 * step.gravity[:, None]

    def _pulled(self, tied: torch.Tensor, free: torch.Tensor, mass: torch.Tensor, step: EnergyStep) -> torch.Tensor:
        """Returns the positions p (B, S, 3) of the weights at the end of a stage [m].

        Args:
            tied: (B, S, 3) a at the end of the stage [m].
            free: (B, S, 3) y [m].
            mass: (B, S) M [N/m].
            step: the step.
        """
        line, toe = tied - free, self._strings.toe
        distance = line.norm(dim=-1)
        excess = distance - step.value("string_length")
        pull = thread_pull(excess, toe)
        compliance = step.value("string_compliance")
        share = pull / (1.0 + compliance * mass) / distance.clamp_min(torch.finfo(line.dtype).tiny)
        return free + share[..., None] * line
