"""The state and the constants of a batch, and the implicit solve of a time step."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from numpy.typing import ArrayLike

from ...io.arrays import BoolArray, Brief
from ...io.errors import InputError, check_type
from .inputs import check_tensor, shapes

ROBOT = "robot"  # owner of the memory variables of a robot and of its roll-out
_MEMORY = "memory."  # prefix of memory variables among the tensors of a state


@dataclass(frozen=True)
class SolveReport(Brief):
    """Outcome of the solve of a time step, by environment."""

    iterations: torch.Tensor  # (B,) number of global steps
    relative_residual: torch.Tensor  # (B,) last residual over balancing forces
    converged: torch.Tensor  # (B,) bool
    factorisations: torch.Tensor  # (B,) number of factorisations


@dataclass(frozen=True)
class Reaction(Brief):
    """Forces with which the rest of the world holds bodies at some vertices, differentiable.

    Attributes:
        vertices: (D,) the vertices.
        forces: (..., D, 3) on the body at each of them [N].
        places: (..., D, 3) their positions [m].
    """

    vertices: torch.Tensor
    forces: torch.Tensor
    places: torch.Tensor

    @classmethod
    def stack(cls, reactions: "Sequence[Reaction | None]") -> "Reaction | None":
        """Returns those of T steps with a first axis of time; None unless each has one."""
        known = [one for one in reactions if one is not None]
        if not known or len(known) < len(reactions):
            return None
        return cls(
            known[0].vertices,
            torch.stack([one.forces for one in known]),
            torch.stack([one.places for one in known]),
        )

    @classmethod
    def join(cls, reactions: "Sequence[Reaction]") -> "Reaction":
        """Returns those of several sets of vertices as one."""
        return cls(
            torch.cat([one.vertices for one in reactions]),
            torch.cat([one.forces for one in reactions], -2),
            torch.cat([one.places for one in reactions], -2),
        )

    @property
    def force(self) -> torch.Tensor:
        """(..., 3) their sum [N]."""
        return self.forces.sum(-2)

    def moment(self, about: object = (0.0, 0.0, 0.0)) -> torch.Tensor:
        """Returns their moment (..., 3) [N m] about a point (..., 3) [m]."""
        arms = (
            self.places
            - torch.as_tensor(about, dtype=self.places.dtype, device=self.places.device)[
                ..., None, :
            ]
        )
        return torch.linalg.cross(arms, self.forces).sum(-2)

    def along(self, normal: ArrayLike, vertices: ArrayLike, shares: ArrayLike) -> "Reaction":
        """Returns the parts c . f along a normal (3,) of forces f
        at vertices (K,), with shares c (K, 3).
        """
        there = self.at(vertices)
        c, n = (
            torch.as_tensor(x, dtype=there.forces.dtype, device=there.forces.device)
            for x in (shares, normal)
        )
        return Reaction(there.vertices, (c * there.forces).sum(-1, keepdim=True) * n, there.places)

    def at(self, vertices: ArrayLike | torch.Tensor | slice) -> "Reaction":
        """Returns those at some of the vertices: by number (K,),
        in that order, or all in a range such as of a body.

        Raises:
            InputError: no numbers, or a vertex at which there is none.
        """
        place = {vertex: k for k, vertex in enumerate(self.vertices.tolist())}
        if isinstance(vertices, slice):
            chosen = sorted(place.keys() & {*range(*vertices.indices(1 + max(place, default=0)))})
        else:
            check_type("vertices", vertices, ArrayLike)
            numbers = torch.as_tensor(vertices).reshape(-1)
            if (
                numbers.is_floating_point()
                or numbers.dtype == torch.bool
                or not place.keys() >= {*numbers.tolist()}
            ):
                raise InputError(
                    "there is no reaction at some of these vertices: "
                    "give numbers of those of `vertices`."
                )
            chosen = numbers.tolist()
        rows = [place[vertex] for vertex in chosen]
        return Reaction(self.vertices[rows], self.forces[..., rows, :], self.places[..., rows, :])

    def select(self, environments: Sequence[int]) -> "Reaction":
        """Returns those of some environments, by number, as constants."""
        rows = [*environments]
        return Reaction(
            self.vertices, *(x.detach()[..., rows, :, :] for x in (self.forces, self.places))
        )


@dataclass(frozen=True)
class State:
    """State of a batch of bodies, robots or scenes: everything on which their next step depends."""

    q: torch.Tensor  # (B, N, 3) [m]
    v: torch.Tensor  # (B, N, 3) [m/s]
    previous: tuple[torch.Tensor, torch.Tensor] | None = None  # (q, v) one step earlier, for BDF2
    # (B, ...) by name (`energies.base.Memory`); a missing variable has its value in a body long at
    # rest. Variables OWNER.NAME are those of robots (`own`), such as commands on their way; a
    # simulator ignores them
    memory: Mapping[str, torch.Tensor] = field(default_factory=dict)
    # of the step that led here; None for other states, and for copies by `map`, such as `detach`
    report: SolveReport | None = field(default=None, compare=False)
    # at the fixed vertices, and normal to symmetry planes at those that slide in them, in the step
    # or equilibrium that led here; None for others. NaN in environments that were reset (`where`),
    # and meaningless where the solve failed
    reaction: Reaction | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        """Shapes of the tensors."""
        return f"State({', '.join(shapes(self.tensors()))})"

    @property
    def batch(self) -> int:
        """Number of environments B."""
        return self.q.shape[0]

    @property
    def converged(self) -> torch.Tensor:
        """(B,) whether the step that led here has converged.

        True for states that no step led to.
        """
        if self.report is None:
            return torch.ones(self.batch, dtype=torch.bool, device=self.q.device)
        return self.report.converged

    def check(self, vertices: int, like: torch.Tensor) -> None:
        """Raises InputError for a wrong shape, dtype or device, or values that are not finite.

        Not for the memory.
        """
        fields = {"state.q": self.q, "state.v": self.v}
        if self.previous is not None:
            if not (isinstance(self.previous, tuple) and len(self.previous) == 2):
                raise InputError(
                    "state.previous must be the pair (q, v) of the step before, or None."
                )
            fields |= {f"state.previous[{i}]": values for i, values in enumerate(self.previous)}
        for unit, (name, values) in zip(
            itertools.cycle(("m", "m/s")), fields.items(), strict=False
        ):
            check_tensor(name, values, (self.batch, vertices, 3), unit, "vertex", like)

    @property
    def lost(self) -> torch.Tensor:
        """(B,) bool, whether the simulation has diverged, where failures are counted.

        The body stands at rest then.
        """
        return self._flag("lost")

    @property
    def left(self) -> torch.Tensor:
        """(B,) bool, whether the learned force was ever evaluated outside its training range."""
        return self._flag("left")

    def _flag(self, name: str) -> torch.Tensor:
        known = self.memory.get(f"{ROBOT}.{name}")
        return (
            torch.zeros(self.batch, dtype=torch.bool, device=self.q.device)
            if known is None
            else known
        )

    def memory_of(self, owner: str = ROBOT) -> dict[str, torch.Tensor]:
        """Returns the memory variables of a robot by name."""
        before = f"{owner}."
        return {
            name.removeprefix(before): x
            for name, x in self.memory.items()
            if name.startswith(before)
        }

    def with_memory(self, variables: Mapping[str, torch.Tensor], owner: str = ROBOT) -> "State":
        """Returns the state with these memory variables of a robot in place of its former ones."""
        before = f"{owner}."
        others = {name: x for name, x in self.memory.items() if not name.startswith(before)}
        return replace(
            self, memory=others | {f"{before}{name}": x for name, x in variables.items()}
        )

    def select(self, environments: Sequence[int]) -> "State":
        """Returns the state of some environments, by number."""
        rows = torch.as_tensor([*environments], device=self.q.device)
        return self.map(lambda tensor: tensor[rows])

    def repeat(self, times: int) -> "State":
        """Returns the state with all environments repeated several times."""
        return self.map(lambda tensor: torch.cat([tensor] * times))

    def where(self, chosen: torch.Tensor | BoolArray, other: "State") -> "State":
        """Joins two states: this one where chosen (B,) bool, the other one elsewhere.

        If one of them has a reaction, that of the other is NaN.
        """
        chosen = torch.as_tensor(chosen, device=self.q.device)
        reaction = self.reaction or other.reaction
        if reaction is not None:
            a, b = (
                torch.nan if one.reaction is None else one.reaction.forces for one in (self, other)
            )
            reaction = replace(reaction, forces=torch.where(chosen[:, None, None], a, b))
        if bool(chosen.all()):
            return replace(self, reaction=reaction)
        mine, theirs = (
            {"previous_q": state.q, "previous_v": state.v} | state.tensors()
            for state in (self, other)
        )
        joined = {}
        for name, like in (self.tensors() | other.tensors()).items():
            a, b = (
                tensors[name] if name in tensors else torch.zeros_like(like)
                for tensors in (mine, theirs)
            )
            joined[name] = torch.where(chosen.view(-1, *[1] * (like.ndim - 1)), a, b)
        return replace(State.from_tensors(joined), reaction=reaction)

    def map(self, change: Callable[[torch.Tensor], torch.Tensor]) -> "State":
        """Returns the state with a function applied to every tensor,
        without report and reaction.
        """
        return State.from_tensors({name: change(tensor) for name, tensor in self.tensors().items()})

    def detach(self) -> "State":
        """Returns the state detached from the autograd graph."""
        return self.map(torch.Tensor.detach)

    def tensors(self) -> dict[str, torch.Tensor]:
        """Returns the tensors by name: ``q``, ``v``,
        ``previous_q``, ``previous_v``, ``memory.NAME``.
        """
        tensors = {"q": self.q, "v": self.v}
        if self.previous is not None:
            tensors |= {"previous_q": self.previous[0], "previous_v": self.previous[1]}
        return tensors | {f"{_MEMORY}{name}": tensor for name, tensor in self.memory.items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, torch.Tensor]) -> "State":
        """Builds the state from its `tensors`; other names are ignored."""
        previous = (
            (tensors["previous_q"], tensors["previous_v"]) if "previous_q" in tensors else None
        )
        memory = {
            name.removeprefix(_MEMORY): x for name, x in tensors.items() if name.startswith(_MEMORY)
        }
        return cls(tensors["q"], tensors["v"], previous, memory)


@dataclass(frozen=True)
class ImplicitStage:
    """The implicit solve of a time step."""

    step: float  # effective step h_e [s]
    target: torch.Tensor  # (B, N, 3) inertial target y, the solution without forces [m]
    velocity_reference: torch.Tensor  # (B, N, 3) r [m]; the solution's velocity is (x - r) / h_e
    # (position, weight) pairs; the weighted sum of their strains is the reference of the strain
    # rate
    strain_weights: tuple[tuple[torch.Tensor, float], ...]
    end: float = 1.0  # time of x, as a fraction of the time step


def _total(terms: Sequence[torch.Tensor]) -> torch.Tensor:
    """Returns the sum of tensors of any batch."""
    return torch.stack(torch.broadcast_tensors(*terms)).sum(0)


@dataclass(frozen=True)
class Mass:
    """Differentiable vertex masses of one energy or of a whole body."""

    inertia: torch.Tensor  # (1 or B, N) [kg]
    weight: torch.Tensor  # (1 or B, N) mass that gravity acts on [kg]
    damping: torch.Tensor  # (1 or B, 1 or N) alpha of the force -alpha m v [1/s]

    @classmethod
    def sum(cls, masses: "Sequence[Mass]") -> "Mass":
        """Returns the total mass of several solids.

        Damping at a shared vertex is the mean weighted by mass.
        """
        inertia = _total([m.inertia for m in masses])
        weight = _total([m.weight for m in masses])
        damping = _total([m.damping * m.inertia for m in masses])
        return cls(inertia, weight, damping / torch.where(inertia > 0.0, inertia, 1.0))


@dataclass(frozen=True)
class Constants:
    """Differentiable tensors that stay constant during a roll-out."""

    mass: torch.Tensor  # (1 or B, N) [kg]
    load_mass: torch.Tensor  # (1 or B, N) mass that gravity acts on [kg]
    gravity: torch.Tensor  # (1 or B, 3) [m/s^2]
    mass_damping: torch.Tensor  # (1 or B, 1 or N) [1/s]
    # values of every energy by name; None where an optional term is switched off
    values: Sequence[Mapping[str, torch.Tensor | None]]

    @property
    def batch(self) -> int:
        """Number of environments with values of their own; 1 where all environments share them."""
        return max(map(len, self._tensors))

    @property
    def _tensors(self) -> tuple[torch.Tensor, ...]:
        values = (value for energy in self.values for value in energy.values() if value is not None)
        return (self.mass, self.gravity, self.mass_damping, *values)

    def check_batch(self, batch: int) -> None:
        """Raises InputError unless every constant has one value or one per environment."""
        for tensor in self._tensors:
            if len(tensor) not in (1, batch):
                raise InputError(
                    f"a material parameter has values for {len(tensor)} environments, but the "
                    f"state has {batch}."
                )
