r"""Tension of tendons: springs, and friction in the guides,
capstans (Euler 1769) with bristles (Dahl 1968).

`TendonLines.tensions` is the law; all derivatives by values of a step, by parameters and by the
memory are torch's of it. ``kernels.tendon_segments`` evaluates the same law in a solve.
``tests/energies/test_tendon_friction.py`` compares it with capstans, and its derivatives with
differences.

A tendon that turns by the angle theta at a guide slides there only if its tension changes by the
factor exp(mu theta):

    T_before exp(-mu theta) <= T_beyond <= T_before exp(mu theta).

Memory is the tension of every segment. At the start of a step the tension before each guide may
have changed with the actuator; that beyond it stays unless a bound is passed. Then the guide's
friction f = T_beyond - T_before changes with the slide s, the change in length of the tendon beyond
it, over the bristle length z_c and towards the bound F in the direction of the slide,

    f(s) = F + (f_0 - F) exp(-|s| / z_c),

which derives from a convex potential of s. Angles and bounds are those at the start of the step,
under the commands of the step: a contraction that yields much within it makes friction too large in
that step. The spring of a tendon lies before its first guide.

In a static equilibrium, and at the start of a roll-out without memory, tendons have been pulled
from slack: the tension falls at every guide by the factor exp(-mu theta).

L. Euler: Remarques sur l'effet du frottement dans l'equilibre. Memoires de l'academie de Berlin 18,
1769. P. R. Dahl: A solid friction model. The Aerospace Corporation, TOR-0158(3107-18)-1, 1968.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from typing_extensions import override

from ...kernels import tendon_segments as kernels
from ..stepping.quantity import Quantity
from .base import BoundEnergy, Energy, EnergySite, EnergyStep, Memory
from .launcher import Launcher, launch, struct_of, warp_view
from .term import Adjoint, Kernel, PartPoints, PartTerm, PointSet, Values, value_of

TENSION = Quantity(
    "tendon_tension", "N", 0.0, closed=True, per="tendon", words="tension", shown_unit="N"
)
CONTRACTION = Quantity(
    "tendon_contraction",
    "m",
    per="tendon",
    typical=1e-3,
    words="contraction",
    shown_unit="mm",
    shown_factor=1e3,
)
STIFFNESS = Quantity("tendon_stiffness", "N/m", 0.0, closed=True, per="tendon")
OFFSETS = tuple(Quantity(f"tendon_offset_{k}", "m", per="tendon", typical=1e-3) for k in (1, 2))
FRICTION = Quantity("tendon_friction", "", 0.0, closed=True, per="tendon")
BRISTLE = Quantity("tendon_bristle_length", "m", 0.0, per="tendon")
SEGMENT_TENSION = "tendon_segment_tension"
# (B, T, 3) c of `kernels.tendon_segments`: one, and the offsets in their unit
ROUTE = "tendon_route"
# (B, P) of the guide before each segment: friction at the start of a step, its bounds downwards and
# upwards [N], and length of the tendon beyond it then [m]
STEP_VALUES = ("tendon_hold", "tendon_drop", "tendon_rise", "tendon_beyond")
_TINY = 1e-300  # keeps a division by a length defined
_STRAIGHT = 1e-4  # rad: angles are rounded off below it, so that they have a derivative at zero


def thread_pull(elongation: torch.Tensor, toe: float) -> torch.Tensor:
    """Returns the force of a thread of stiffness one [m], as the kernels have it
    (`kernels.axial.thread_pull`).
    """
    tightening = elongation.clamp(0.0, toe)
    return tightening * (elongation - 0.5 * tightening) / toe


@dataclass(frozen=True)
class TendonPoints(PartPoints):
    """Segments of tendons between guides, tendon after tendon, with the operators of F
    (`kernels.tendon_segments`).
    """

    rest: NDArray[np.float64]  # (P, 3, 3) F of the undeformed body [m]
    anchors: NDArray[np.float64]  # (P, 3, 3) part of F by guides that are fixed in the world [m]
    directions: int  # of offsets, for each tendon


class TendonLines:
    """Segments of T tendons as tensors, and the law of their tension.

    Args:
        points: the P segments.
        count: number of tendons T.
        toe: elongation at which a spring reaches its full stiffness [m].
        like: a tensor with device and dtype.

    Attributes:
        columns: columns of F that count: one, and one for each direction of offsets.
        part: (P,) tendon of each segment.
        one_hot: (P, T) the same as a matrix.
        beyond: (P, P) one at [p, q] where segment p belongs to the tendon's part beyond the guide
            before segment q.
    """

    def __init__(self, points: TendonPoints, count: int, toe: float, like: torch.Tensor) -> None:
        part, order = points.part, np.arange(len(points.part))
        beyond = ((part[:, None] == part) & (order[:, None] >= order)).astype(np.float64)
        self.columns = 1 + points.directions
        matrices = (
            x[..., : self.columns] for x in (points.gradients[:, 0], points.rest, points.anchors)
        )
        arrays = (np.eye(count)[part], beyond, *matrices)
        self.one_hot, self.beyond, self._operators, self._rest, self._anchors = (
            torch.as_tensor(array).to(like) for array in arrays
        )
        self.part, self._nodes = (
            torch.as_tensor(array, device=like.device) for array in (part, points.nodes)
        )
        self._toe = toe
        self._by_part = self.one_hot.mT.contiguous()
        self._straight = self._rest[..., 0].norm(dim=-1)  # lengths at rest without offsets

    def lines(self, positions: torch.Tensor, route: torch.Tensor) -> torch.Tensor:
        """Returns the vectors (B, P, 3) along the segments [m]
        at positions (B, N, 3), for c (1 or B, T, 3).
        """
        return self._along(self._matrices(positions) + self._anchors, route)

    def changes(self, direction: torch.Tensor, route: torch.Tensor) -> torch.Tensor:
        """Returns the derivative of `lines` in a direction (B, N, 3)."""
        return self._along(self._matrices(direction), route)

    def _matrices(self, field: torch.Tensor) -> torch.Tensor:
        return field[:, self._nodes].mT @ self._operators

    def _along(self, f: torch.Tensor, route: torch.Tensor) -> torch.Tensor:
        if self.columns == 1:
            return f[..., 0]
        return (f * route[:, self.part, None, : self.columns].to(f)).sum(-1)

    def slack(self, lengths: torch.Tensor, values: Values) -> torch.Tensor:
        """Returns the elongations (B, T) of the springs [m]."""
        rest = (
            self._straight
            if self.columns == 1
            else self._along(self._rest, value_of(values, ROUTE)).norm(dim=-1)
        )
        return (lengths - rest) @ self.one_hot + value_of(values, CONTRACTION.name)

    def at_segments(self, values: torch.Tensor) -> torch.Tensor:
        """Returns the values (1 or B, T) of tendons at their segments, (1 or B, P)."""
        return values @ self._by_part  # with a cheaper derivative than an index

    def actuated(self, lengths: torch.Tensor, values: Values) -> torch.Tensor:
        """Returns the tensions (B, T) before the first guides, of actuators and springs [N]."""
        pull = thread_pull(self.slack(lengths, values), self._toe)
        return value_of(values, TENSION.name) + value_of(values, STIFFNESS.name) * pull

    def tensions(self, lengths: torch.Tensor, values: Values) -> torch.Tensor:
        """Returns the tensions (B, P) of segments of lengths (B, P) [N].

        Args:
            lengths: of the segments [m].
            values: tension, contraction and stiffness (B, T), ``tendon_route`` (B, T, 3), and with
                friction its bristle length and `STEP_VALUES`.
        """
        tension = self.at_segments(self.actuated(lengths, values))
        if STEP_VALUES[0] not in values:
            return tension
        hold, drop, rise, before = (value_of(values, name) for name in STEP_VALUES)
        slide = lengths @ self.beyond - before
        most = torch.where(slide < 0.0, -drop, rise)
        friction = most + (hold - most) * torch.exp(
            -slide.abs() / self.at_segments(value_of(values, BRISTLE.name))
        )
        return tension + friction @ self.beyond.mT


class BoundTendons(BoundEnergy):
    """Tendons with friction in a simulator.

    Memory is ``tendon_segment_tension`` (B, P) [N].

    Args:
        tendons: the tendons.
        site: the simulator as they see it.
        toe: elongation at which a spring reaches its full stiffness [m].
        entry_angle: (T,) of contact before the first guide [rad].
    """

    def __init__(
        self, tendons: Energy, site: EnergySite, toe: float, entry_angle: Sequence[float]
    ) -> None:
        super().__init__(tendons, site)
        (points,) = site.points
        assert isinstance(points, TendonPoints)
        part, count = points.part, tendons.count
        device = site.rest_positions.device
        self._lines = TendonLines(points, count, toe, site.rest_positions)
        first = np.searchsorted(part, np.arange(count + 1))
        self._runs = Launcher(1, device).upload(first.astype(np.int32), int)
        self._first = torch.as_tensor(first[:-1], device=device)
        # A chain has for every tendon what is before its first guide, and then its segments: rows
        # of both in order.
        self._segments = torch.as_tensor(np.arange(len(part)) + part + 1, device=device)
        starts = torch.as_tensor(first[:-1] + np.arange(count), device=device)
        self._chain = torch.cat([starts, self._segments]).argsort()
        entry = np.zeros(len(part))
        entry[first[:-1]] = entry_angle
        self._entry = site.tensor(entry)
        self.memory = (Memory(SEGMENT_TENSION, "N", (len(part),), "segment"),)

    def _geometry(self, q: torch.Tensor, values: Values) -> tuple[torch.Tensor, torch.Tensor]:
        """Mu theta at the guide before each segment, and lengths of segments [m], (B, P) each."""
        line = self._lines.lines(q, value_of(values, ROUTE))
        lengths = line.norm(dim=-1)
        u = line / lengths.clamp_min(torch.finfo(q.dtype).tiny)[..., None]
        chord = (u[:, 1:] - u[:, :-1]).square().sum(-1)
        half = (0.5 * (chord + _STRAIGHT**2).sqrt()).clamp_max(1.0 - 4.0 * torch.finfo(q.dtype).eps)
        turn = torch.nn.functional.pad(2.0 * (half.asin() - np.arcsin(0.5 * _STRAIGHT)), (1, 0))
        turns = turn.index_fill(1, self._first, 0.0) + self._entry
        return self._lines.at_segments(value_of(values, FRICTION.name)) * turns, lengths

    def _stick(
        self, begin: torch.Tensor, segments: torch.Tensor, decay: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Tensions before and beyond each guide, (B, P) each, where every one sticks or slides [N].

        A kernel finds which guides slide, and which way. One that slides multiplies the tension
        before it by exp(-mu theta) or exp(mu theta), one that sticks keeps that beyond it; so a
        tension is that at the last guide that sticks, or at the actuator, times the factors since.

        Args:
            begin: (B, T) tensions before the first guides [N].
            segments: (B, P) tensions of the segments so far [N].
            decay: (B, P) mu theta.
        """
        batch, device = len(segments), segments.device
        slides = torch.zeros(segments.shape, device=device, dtype=torch.int32)
        known = [
            x.detach().double().expand(batch, -1).contiguous()
            for x in (begin, segments, torch.exp(decay))
        ]
        inputs = [self._runs, *(warp_view(value, wp.float64) for value in known)]
        launch(
            kernels.stick, (batch, begin.shape[1]), inputs, [warp_view(slides, wp.int32)], device
        )
        start = torch.zeros_like(known[0])
        total = torch.cat([start, slides * decay], 1)[:, self._chain].cumsum(1)
        order = torch.arange(total.shape[1], device=device)
        last = (
            torch.where(torch.cat([start.int(), slides], 1)[:, self._chain] == 0, order, 0)
            .cummax(1)
            .values
        )
        kept = torch.cat([begin.expand(batch, -1), segments], 1)[:, self._chain].gather(1, last)
        chain = kept * torch.exp(total - total.gather(1, last))
        return chain[:, self._segments - 1], chain[:, self._segments]

    def _values(self, step: EnergyStep) -> dict[str, torch.Tensor]:
        """Returns parameters and inputs, (1 or B, T, ...)."""
        zeros = step.state.q.new_zeros(step.state.batch, self.energy.count)
        constants = {
            name: step.value(name) for name in (STIFFNESS.name, FRICTION.name, BRISTLE.name, ROUTE)
        }
        return constants | {q.name: step.inputs.get(q.name, zeros) for q in self.energy.inputs}

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        values = self._values(step)
        decay, lengths = self._geometry(step.state.q, values)
        segments = step.state.memory.get(SEGMENT_TENSION, torch.zeros_like(decay))
        before, segments = self._stick(self._lines.actuated(lengths, values), segments, decay)
        bounds = -before * torch.expm1(-decay), before * torch.expm1(decay)
        return dict(
            zip(
                STEP_VALUES, (segments - before, *bounds, lengths @ self._lines.beyond), strict=True
            )
        )

    @override
    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        return dict.fromkeys(STEP_VALUES, self._entry.new_zeros(batch, len(self._entry)))

    @override
    def at_pose(self, q: torch.Tensor, values: Values) -> dict[str, torch.Tensor | None]:
        """Returns friction that does not change with the slide,
        which makes both bounds equal to it.
        """
        (decay, lengths), lines = self._geometry(q, values), self._lines
        fall = decay @ lines.beyond.mT
        # Pulled from slack.
        before = lines.at_segments(lines.actuated(lengths, values)) * torch.exp(decay - fall)
        friction = before * torch.expm1(-decay)
        return dict(
            zip(STEP_VALUES, (friction, -friction, friction, lengths @ lines.beyond), strict=True)
        )

    @override
    def end_step(
        self, step: EnergyStep, x: torch.Tensor, q: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        values = {**self._values(step), **self.begin_step(step)}
        lengths = self._lines.lines(q, value_of(values, ROUTE)).norm(dim=-1)
        return {SEGMENT_TENSION: self._lines.tensions(lengths, values).clamp_min(0.0)}


class TendonTerm(PartTerm):
    """Kernels of tendons, on the set of their segments.

    Args:
        launcher: launcher of the potential.
        sets: the set.
        count: number of tendons T.
        toe: elongation at which a spring reaches its full stiffness [m].
        rubs: whether there is friction.
    """

    couples_cells = True
    _kernels = kernels

    def __init__(
        self, launcher: Launcher, sets: Sequence[PointSet], count: int, toe: float, rubs: bool
    ) -> None:
        (s,) = sets
        assert isinstance(s.source, TendonPoints)
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
            (q.name for q in (TENSION, CONTRACTION, STIFFNESS)), (count,)
        )
        shapes[ROUTE] = (count, 3)
        self._rubs = rubs
        if rubs:
            shapes |= {BRISTLE.name: (count,), **dict.fromkeys(STEP_VALUES, (s.n_points,))}
        super().__init__(launcher, sets, shapes, count)
        self._lines = TendonLines(s.source, count, toe, self.weight)
        self._toe = wp.float64(toe)
        first = np.searchsorted(s.source.part, np.arange(count + 1)).astype(np.int32)
        self._segments = struct_of(
            kernels.Segments,
            anchors=launcher.upload(s.source.anchors, wp.mat33d),
            rest=launcher.upload(s.source.rest, wp.mat33d),
            tendon=self.part,
            first=launcher.upload(first, int),
        )
        self._tension = launcher.zeros(s.n_points)
        self._spring, self._friction = launcher.zeros(count, 3), launcher.zeros(s.n_points, 3)
        self._pulls = struct_of(
            kernels.Pulls, tension=self._tension, spring=self._spring, friction=self._friction
        )
        self._segment_length = torch.as_tensor(
            np.linalg.norm(s.source.rest[..., 0], axis=1), device=launcher.device
        )
        operator = np.zeros((s.n_points, s.n_vertices, self._lines.columns))
        rows = np.arange(s.n_points)[:, None]
        np.add.at(
            operator, (rows, s.source.nodes), s.source.gradients[:, 0, :, : self._lines.columns]
        )
        # (.., P, N)
        self._operator = torch.as_tensor(
            np.moveaxis(operator, -1, 0).copy(), device=launcher.device
        )

    @override
    def before(self, positions: Any, active: Any) -> list[Any]:
        (s,) = self.sets
        if self._rubs:
            guides = {name.removeprefix("tendon_"): self.values[name] for name in STEP_VALUES}
            bristles = self.values[BRISTLE.name]
        else:
            guides = dict.fromkeys(
                ("hold", "drop", "rise", "beyond"), self.launcher.zeros(s.n_points)
            )
            bristles = self.launcher.zeros(self.count) + 1.0
        friction = struct_of(kernels.GuideFriction, **guides, bristles=bristles)
        inputs = [
            active,
            s.points,
            self._segments,
            self._toe,
            self._tendon_values(),
            friction,
            positions,
        ]
        return [
            self.launcher.record(
                kernels.pull, (self.launcher.batch, self.count), inputs, [self._pulls]
            )
        ]

    def _tendon_values(self) -> Any:
        return struct_of(
            kernels.TendonValues,
            route=self.values[ROUTE],
            commanded=self.values[TENSION.name],
            contraction=self.values[CONTRACTION.name],
            stiffness=self.values[STIFFNESS.name],
        )

    @override
    def _arguments(self, s: PointSet, positions: Any) -> list[Any]:
        return [s.points, self._segments, self._tendon_values(), self._pulls, positions]

    @override
    def tangent(self, s: PointSet, positions: Any) -> Kernel:
        route, tension = self.view(ROUTE, wp.vec3d), warp_view(self._tension, wp.float64)
        return Kernel(kernels.tangent, [s.points, self._segments, route, tension, positions])

    @override
    def low_rank(self, positions: Any) -> torch.Tensor | None:
        stiffness, slopes = self.values[STIFFNESS.name], self._friction[..., 2]
        sprung, rubs = bool((stiffness > 0.0).any()), self._rubs and bool((slopes > 0.0).any())
        if not (sprung or rubs):
            return None
        route = self.values[ROUTE]
        lines = self._lines.lines(wp.to_torch(positions), route)
        u = lines / lines.norm(dim=-1, keepdim=True).clamp_min(_TINY)
        # (B, .., P, 3)
        columns = (
            route[:, self.part_of].movedim(-1, 1)[:, : len(self._operator), :, None] * u[:, None]
        )
        weights = []  # (B, P, r) of the segments' lengths in the columns
        if sprung:
            weights.append(self.one_hot * (stiffness * self._spring[..., 2]).sqrt()[:, None])
        if rubs:
            weights.append(self._lines.beyond * slopes.sqrt()[:, None])
        # (B, .., P, 3, r)
        by_column = columns[..., None] * torch.cat(weights, -1)[:, None, :, None]
        gradient = (self._operator.mT @ by_column.flatten(3)).sum(1)  # (B, N, 3 r)
        return gradient.unflatten(2, (3, -1)).flatten(1, 2)

    @override
    def curvature(self) -> torch.Tensor:
        tension, stiffness = self.values[TENSION.name], self.values[STIFFNESS.name]
        # |F c|^2 <= |c|^2 |F|^2, and the square of a sum of n lengths is at most n times the sum of
        # their squares.
        columns = self.values[ROUTE].square().sum(-1)
        stretching = (tension * columns)[:, self.part_of] / self._segment_length
        if self._rubs:  # A guide's slope is at most the sum of its bounds over the bristle length.
            drop, rise = self.values["tendon_drop"], self.values["tendon_rise"]
            beyond = self._lines.beyond
            slopes = (drop + rise) / self.values[BRISTLE.name][:, self.part_of] * beyond.sum(0)
            stretching = stretching + columns[:, self.part_of] * (slopes @ beyond.mT)
        return stretching + (stiffness * columns * self.one_hot.sum(0))[:, self.part_of]

    @override
    def adjoint(self, positions: torch.Tensor, direction: torch.Tensor) -> Adjoint:
        """Implements `Term.adjoint`: the residual along z is the sum
        of tensions times the changes of lengths.
        """
        names = [name for name in self.values if name != ROUTE or self._lines.columns > 1]

        def differentiate() -> dict[str, torch.Tensor]:
            with torch.enable_grad():
                leaves = {name: self.values[name].detach().requires_grad_() for name in names}
                route = leaves.get(ROUTE, self.values[ROUTE])
                lines = self._lines.lines(positions, route)
                lengths = lines.norm(dim=-1)
                rates = (lines * self._lines.changes(direction, route)).sum(-1) / lengths.clamp_min(
                    _TINY
                )
                work = -(self._lines.tensions(lengths, {ROUTE: route, **leaves}) * rates).sum()
                slopes = torch.autograd.grad(work, list(leaves.values()))
            return dict(zip(leaves, slopes, strict=True))

        return differentiate
