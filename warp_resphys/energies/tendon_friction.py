r"""Friction of tendons in their guides: capstans (Euler 1769) with bristles (Dahl 1968).

A tendon that turns by the angle theta at a guide slides there only if its tension changes by the factor exp(mu theta):

    T_before exp(-mu theta) <= T_beyond <= T_before exp(mu theta).

Memory is the tension of every segment. At the start of a step the tension before each guide may have changed with the
actuator; that beyond it stays unless a bound is passed. Then the guide's friction f = T_beyond - T_before changes with
the slide s, the change in length of the tendon beyond it, over the bristle length z_c and towards the bound F in the
direction of the slide,

    f(s) = F + (f_0 - F) exp(-|s| / z_c),

which derives from a convex potential of s. Angles and bounds are those at the start of the step, under the commands of
the step: a contraction that yields much within it makes friction too large in that step. The spring of a tendon lies
before its first guide.

In a static equilibrium, and at the start of a roll-out without memory, tendons have been pulled from slack: the tension
falls at every guide by the factor exp(-mu theta).

L. Euler: Remarques sur l'effet du frottement dans l'equilibre. Memoires de l'academie de Berlin 18, 1769.
P. R. Dahl: A solid friction model. The Aerospace Corporation, TOR-0158(3107-18)-1, 1968.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ..kernels import tendon_segments as kernels
from ..stepping.adjoints import AdjointFunction, first_derivatives
from ..stepping.quantity import Quantity
from .base import BoundEnergy, Energy, EnergySite, EnergyStep, Memory
from .launcher import Launcher, launch, warp_view
from .pointwise import PartPoints
from .strings import thread_pull

TENSION = Quantity("tendon_tension", "N", 0.0, closed=True, per="tendon", words="tension", shown_unit="N")
CONTRACTION = Quantity(
    *("tendon_contraction", "m"), per="tendon", typical=1e-3, words="contraction", shown_unit="mm", shown_factor=1e3
)
STIFFNESS = Quantity("tendon_stiffness", "N/m", 0.0, closed=True, per="tendon")
OFFSETS = tuple(Quantity(f"tendon_offset_{k}", "m", per="tendon", typical=1e-3) for k in (1, 2))
FRICTION = Quantity("tendon_friction", "", 0.0, closed=True, per="tendon")
BRISTLE = Quantity("tendon_bristle_length", "m", 0.0, per="tendon")
SEGMENT_TENSION = "tendon_segment_tension"
STEP_VALUES = ("tendon_hold", "tendon_drop", "tendon_rise", "tendon_beyond")
_STRAIGHT = 1e-4  # rad: angles are rounded off below it, so that they have a derivative at zero


@dataclass(frozen=True)
class TendonPoints(PartPoints):
    """Segments of tendons between guides, tendon after tendon, with the operators of F (`kernels.tendon_segments`)."""

    rest: NDArray[np.float64]  # (P, 3, 3) F of the undeformed body [m]
    anchors: NDArray[np.float64]  # (P, 3, 3) part of F due to guides that are fixed in the world [m]


def offset_vector(values: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Returns the vectors c (1 or B, T, 3) of `kernels.tendon_segments` for offsets by name."""
    first, second = torch.broadcast_tensors(*(values[offset.name] / kernels.OFFSET_UNIT for offset in OFFSETS))
    return torch.stack([torch.ones_like(first), first, second], -1)


def friction_after(
    slide: torch.Tensor, hold: torch.Tensor, drop: torch.Tensor, rise: torch.Tensor, length: torch.Tensor
) -> torch.Tensor:
    """Returns the friction f(s) of guides (B, P) after a slide [N] (``kernels.tendon_segments.bristle``)."""
    most = torch.where(slide < 0.0, -drop, rise)
    return most + (hold - most) * torch.exp(-slide.abs() / length)


class Geometry(NamedTuple):
    """Tendons at some positions."""

    turns: torch.Tensor  # (B, P) angle of contact at the guide before each segment [rad]
    beyond: torch.Tensor  # (B, P) length of the tendon beyond that guide [m]
    longer: torch.Tensor  # (B, T) elongation relative to rest [m]


class BoundTendons(BoundEnergy):
    """Tendons with friction in a simulator.

    Memory is ``tendon_segment_tension`` (B, P) [N].

    Args:
        tendons: the tendons.
        site: the simulator as they see it.
        toe: elongation at which a spring reaches its full stiffness [m].
        entry_angle: of contact before the first guide, one or (T,) [rad].
    """

    def __init__(self, tendons: Energy, site: EnergySite, toe: float, entry_angle: ArrayLike) -> None:
        super().__init__(tendons, site)
        (points,) = site.points
        assert isinstance(points, TendonPoints)
        part, device = points.part, site.rest_positions.device
        self._toe = toe
        self._nodes = torch.as_tensor(points.nodes, device=device)
        self._operators = site.tensor(points.gradients[:, 0])  # (P, K, 3)
        self._rest, self._anchors = site.tensor(points.rest), site.tensor(points.anchors)  # (P, 3, 3)
        self._part = torch.as_tensor(part, device=device)
        self._one_hot = site.tensor(np.eye(tendons.count)[part])  # (P, T)
        self._beyond = site.tensor(beyond(part))
        first = np.searchsorted(part, np.arange(tendons.count + 1))
        self._runs = Launcher(1, device).upload(first.astype(np.int32), int)
        self._first = torch.as_tensor(first[:-1], device=device)
        entry = np.zeros(len(part))
        entry[first[:-1]] = np.broadcast_to(np.asarray(entry_angle, dtype=np.float64), tendons.count)
        self._entry = site.tensor(entry)
        self.memory = (Memory(SEGMENT_TENSION, "N", (len(part),), "segment"),)

    def _geometry(self, q: torch.Tensor, values: Mapping[str, torch.Tensor]) -> Geometry:
        """Returns the tendons at positions (B, N, 3)."""
        f = torch.einsum("pkw,bpki->bpiw", self._operators, q[:, self._nodes]) + self._anchors
        c = offset_vector(values)[:, self._part].to(q)  # (1 or B, P, 3)
        line = (f * c[..., None, :]).sum(-1)
        lengths = line.norm(dim=-1)
        u = line / lengths.clamp_min(torch.finfo(q.dtype).tiny)[..., None]
        chord = (u[:, 1:] - u[:, :-1]).square().sum(-1)
        half = (0.5 * (chord + _STRAIGHT**2).sqrt()).clamp_max(1.0 - 4.0 * torch.finfo(q.dtype).eps)
        turn = torch.nn.functional.pad(2.0 * (half.asin() - np.arcsin(0.5 * _STRAIGHT)), (1, 0))
        turns = turn.index_fill(1, self._first, 0.0) + self._entry
        rest = (self._rest * c[..., None, :]).sum(-1).norm(dim=-1)
        return Geometry(turns, lengths @ self._beyond, (lengths - rest) @ self._one_hot)

    def _spring(self, geometry: Geometry, values: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Returns the tensions (B, T) of the springs [N]."""
        return values["tendon_stiffness"] * thread_pull(geometry.longer + values["tendon_contraction"], self._toe)

    def _before(self, tension: torch.Tensor, segments: torch.Tensor) -> torch.Tensor:
        """Returns the tension (B, P) before each guide [N]."""
        before = torch.nn.functional.pad(segments[:, :-1], (1, 0))
        return before.index_copy(1, self._first, tension)

    def _values(self, step: EnergyStep) -> dict[str, torch.Tensor]:
        """Returns parameters and inputs, (1 or B, T)."""
        zeros = step.state.q.new_zeros(step.state.batch, self.energy.count)
        names = ("tendon_stiffness", FRICTION.name, BRISTLE.name, *(offset.name for offset in OFFSETS))
        constants = {name: step.constants.value(name) for name in names}
        inputs = ((q.name, step.inputs.actuation.get(q.name)) for q in self.energy.inputs)
        return constants | {name: zeros if given is None else given for name, given in inputs}

    def _start(self, step: EnergyStep, values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Returns the values of the step by name, and the tension ``before`` each guide at its start."""
        here = self._geometry(step.state.q, values)
        tension = values["tendon_tension"] + self._spring(here, values)
        held = step.state.memory.get(SEGMENT_TENSION, torch.zeros_like(here.turns))
        growth = torch.exp(values[FRICTION.name][:, self._part] * here.turns)
        segments: torch.Tensor = _Stick.apply(self._runs, tension, held, growth)
        before = self._before(tension, segments)
        bounds = before - before / growth, before * growth - before
        return dict(zip(STEP_VALUES, (segments - before, *bounds, here.beyond), strict=True))

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        return dict(self._start(step, self._values(step)))

    @override
    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        return dict.fromkeys(STEP_VALUES, self._operators.new_zeros(batch, len(self._part)))

    @override
    def at_pose(self, q: torch.Tensor, values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor | None]:
        """Returns friction that does not change with the slide, which makes both bounds equal to it."""
        here = self._geometry(q, values)
        tension = values["tendon_tension"] + self._spring(here, values)
        decay = values["tendon_friction"][:, self._part] * here.turns
        segments = tension[:, self._part] * torch.exp(-(decay @ self._beyond.mT))  # pulled from slack
        friction = segments - self._before(tension, segments)
        return dict(zip(STEP_VALUES, (friction, -friction, friction, here.beyond), strict=True))

    @override
    def end_step(self, step: EnergyStep, x: torch.Tensor, q: torch.Tensor) -> dict[str, torch.Tensor]:
        values = self._values(step)
        start, end = self._start(step, values), self._geometry(q, values)
        hold, drop, rise, before = (start[name] for name in STEP_VALUES)
        length = values[BRISTLE.name][:, self._part]
        friction = friction_after(end.beyond - before, hold, drop, rise, length)
        tension = values["tendon_tension"] + self._spring(end, values)
        segments = tension[:, self._part] + friction @ self._beyond.mT
        return {SEGMENT_TENSION: segments.clamp_min(0.0)}


class _Stick(AdjointFunction):
    """Tensions (B, P) of the segments where guides stick or slide (`kernels.tendon_segments.stick`)."""

    @override
    @staticmethod
    def forward(ctx: Any, runs: Any, begin: torch.Tensor, held: torch.Tensor, growth: torch.Tensor) -> torch.Tensor:
        given = _environments(begin, held, growth)
        segments = torch.zeros_like(given[1])
        views = [warp_view(value, wp.float64) for value in (*given, segments)]
        launch(kernels.stick, given[0].shape, [runs, *views], [], segments.device)
        ctx.runs = runs
        ctx.save_for_backward(begin, held, growth, segments)
        return segments.to(held.dtype)

    @override
    @staticmethod
    @first_derivatives
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        *values, segments = ctx.saved_tensors
        given = _environments(*values)
        slopes = [torch.zeros_like(x) for x in given]
        tensors = (*given, segments, gradient.double().contiguous(), *slopes)
        inputs = [ctx.runs, *(warp_view(value, wp.float64) for value in tensors)]
        launch(kernels.stick_adjoint, given[0].shape, inputs, [], segments.device)
        pairs = zip(slopes, values, strict=True)
        return None, *(slope.sum_to_size(value.shape).to(gradient.dtype) for slope, value in pairs)


def _environments(begin: torch.Tensor, held: torch.Tensor, growth: torch.Tensor) -> list[torch.Tensor]:
    """Returns values of all environments, of which ``held`` has some for each."""
    return [x.detach().double().expand(len(held), -1).contiguous() for x in (begin, held, growth)]


def beyond(part: NDArray[np.int64]) -> NDArray[np.float64]:
    """Returns (P, P), one where segment p belongs to the tendon's part beyond the guide before segment q, at [p, q]."""
    order = np.arange(len(part))
    return ((part[:, None] == part) & (order[:, None] >= order)).astype(np.float64)
