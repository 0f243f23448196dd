"""Adjoint gradients of a short roll-out against central differences,
for every kind of parameter.
"""

import math
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import torch

from ..stepping.inputs import Inputs
from ..stepping.rotations import twisted
from ..stepping.state import State
from .simulator import Simulator

Pose = Literal["rest", "bent", "twisted"]
POSES: tuple[Pose, ...] = get_args(Pose)
_HALVINGS = 6  # of the step of a difference
_ACCURACY = 1e-8  # relative, at which a difference is good enough
_LEAST = 1e-3  # of the largest derivative, below which one is compared alone


@dataclass(frozen=True)
class GradientRow:
    """One comparison of a directional derivative of the loss."""

    parameter: str
    adjoint: float
    difference: float  # by central differences
    uncertainty: float = 0.0  # of the difference, due to truncation and rounding

    @property
    def relative_error(self) -> float:
        """|adjoint - difference| over the larger magnitude.

        Infinite where both are zero, since nothing is compared then, and where one is not finite.
        """
        scale = max(abs(self.adjoint), abs(self.difference))
        error = abs(self.adjoint - self.difference) / scale if scale > 0.0 else math.inf
        return error if math.isfinite(error) else math.inf


def central_difference(function: Callable[[float], float]) -> tuple[float, float]:
    """Derivative at zero of a function of one number, and an estimate of its error.

    Central differences over steps of 1, 1/2, 1/4, ... are extrapolated to a step of zero (Ridders
    1982). Truncation error dominates the first extrapolations, rounding error the last ones: the
    one that changes least between steps is returned, with this change as its error.
    """
    row: list[float] = []
    best, error = math.nan, math.inf
    for k in range(1 + _HALVINGS):
        step, before = 0.5**k, row
        row = [(function(step) - function(-step)) / (2.0 * step)]
        for j, coarser in enumerate(before, 1):
            row.append(row[-1] + (row[-1] - coarser) / (4.0**j - 1.0))
            change = max(abs(row[-1] - row[-2]), abs(row[-1] - coarser))
            if change < error:
                best, error = row[-1], change
        if error <= _ACCURACY * abs(best):
            break
    return best, error


def pose(simulator: Simulator, name: str, batch: int) -> State:
    """A state of a body that extends along x from its clamp:
    at rest, bent, or twisted by 90 degrees about x.

    Args:
        simulator: of the body.
        name: one of `POSES`.
        batch: number of environments; their poses differ slightly, except at rest.
    """
    state = simulator.rest_state(batch)
    if name == "rest":
        return state
    q = state.q
    scale = 1.0 + 0.1 * torch.arange(batch, device=q.device, dtype=q.dtype)
    if name == "twisted":
        turned = twisted(simulator.rest_positions, 0.5 * torch.pi / scale)
        return State(turned, torch.zeros_like(turned))
    low, high = q[0].min(0).values, q[0].max(0).values
    s = (q[..., :1] - low[0]) / (high[0] - low[0])
    offset = torch.zeros_like(q)
    offset[..., 2:] = -0.15 * (high[0] - low[0]) * scale[:, None, None] * s**2
    return State(q + offset, 0.3 * offset)


def check_gradients(
    simulator: Simulator,
    pose_name: str = "bent",
    steps: int = 3,
    batch: int = 2,
    seed: int = 0,
    change: float = 1.0,
    names: Container[str] | None = None,
    together: bool = True,
) -> list[GradientRow]:
    """Compares the directional derivatives of a random linear functional
    of all positions and velocities.

    Parameters vary within their bounds, which no difference exceeds. A parameter on a bound, such
    as damping of zero, cannot be checked: give the simulator another value.

    Args:
        simulator: with a tight tolerance, in float64.
        pose_name: start of the roll-out (see `pose`).
        steps: number of steps of the roll-out.
        batch: number of environments.
        seed: of the random directions and functional.
        change: factor of the largest changes; less than one where second derivatives jump, as those
            of friction do.
        names: of the inputs and parameters that are compared, with `q` and `v` of the start; None
            for all.
        together: whether inputs and parameters of one shape change at the same time, by amounts
            that contribute about the same, which takes a fraction of the time. The difference of a
            row is then that of all less the adjoints of the others: a wrong derivative shows in all
            rows of its shape. Derivatives below a thousandth of the largest are compared alone.

    Returns:
        A row for initial positions, initial velocities, each input and each parameter. Parameters
        are checked as one value, as one for each environment, and as one for each element or part.
    """
    problem = _Problem(simulator, pose_name, steps, batch, seed, change)
    cases = [case for case in problem.cases() if names is None or case.name in names]
    groups: dict[str, list[_Case]] = {}
    for case in cases:
        groups.setdefault(case.kind if together else case.title, []).append(case)
    rows = {row.parameter: row for group in groups.values() for row in problem.compare(group)}
    return [rows[case.title] for case in cases]


@dataclass(frozen=True)
class _Case:
    """A start, an input or a parameter in one of its shapes, by a change that is zero at first."""

    name: str
    kind: str  # what has a value of its own, as in "environment"; "one" for one value of all
    change: torch.Tensor
    value: Callable[[torch.Tensor], torch.Tensor]  # of the change

    @property
    def title(self) -> str:
        return self.name if self.kind == "one" else f"{self.name}, each {self.kind}"


class _Problem:
    """The loss of a roll-out as a function of the start, inputs and parameters."""

    def __init__(
        self, simulator: Simulator, pose_name: str, steps: int, batch: int, seed: int, change: float
    ) -> None:
        self.simulator = simulator
        self.steps, self.batch = steps, batch
        self.change = change
        self.random = torch.Generator().manual_seed(seed)
        self.state = pose(simulator, pose_name, batch)
        n = simulator.body.n_vertices
        self.inputs = Inputs(
            external_force=1e-3 * self.noise(steps, batch, n, 3),
            fixed_positions=self.state.q[:, simulator.fixed].expand(steps, -1, -1, -1).clone(),
            attached_mass=1e-4 * (1.0 + self.noise(batch, n).square()),
            **{
                name: quantity.typical
                * (1.0 + 0.3 * self.noise(steps, batch, simulator.counts[name]))
                for name, quantity in simulator.inputs.items()
            },
        )
        self.weights = (
            self.noise(steps + 1, batch, n, 3),
            simulator.time_step * self.noise(steps + 1, batch, n, 3),
        )

    def noise(self, *shape: int) -> torch.Tensor:
        return self.simulator.tensor(
            torch.randn(*shape, generator=self.random, dtype=torch.float64)
        )

    def loss(self, cases: Sequence[_Case], changes: Sequence[torch.Tensor]) -> torch.Tensor:
        """Loss of the roll-out with changes of the start, of inputs and of parameters."""
        return self.losses(cases, [changes])[0]

    def losses(
        self, cases: Sequence[_Case], variants: Sequence[Sequence[torch.Tensor]]
    ) -> torch.Tensor:
        """Losses (R,) of R roll-outs side by side, each with changes of its own."""
        count = len(variants)
        values = {
            case.name: self._side_by_side(case, [case.value(changes[k]) for changes in variants])
            for k, case in enumerate(cases)
        }
        q, v = (
            values.pop(name, getattr(self.state, name).repeat(count, 1, 1)) for name in ("q", "v")
        )
        inputs = {
            name: self._repeated(name, [value] * count)
            for name, value in self.inputs.fields.items()
        }
        inputs |= {name: values.pop(name) for name in [*values] if name in inputs}
        trajectory = self.simulator.rollout(State(q, v), self.steps, Inputs(**inputs), values)
        positions, velocities = (x.unflatten(1, (count, -1)) for x in (trajectory.q, trajectory.v))
        weighted = self.weights[0][:, None] * positions + self.weights[1][:, None] * velocities
        return weighted.sum((0, 2, 3, 4))

    def _side_by_side(self, case: _Case, values: Sequence[torch.Tensor]) -> torch.Tensor:
        """A value of R roll-outs, by environment."""
        if case.name in self.inputs.fields:
            return self._repeated(case.name, values)
        if case.name in ("q", "v", "gravity") or case.kind == "environment":
            return torch.cat([*values])
        return torch.cat([value.expand(self.batch, -1) for value in values])

    @staticmethod
    def _repeated(name: str, values: Sequence[torch.Tensor]) -> torch.Tensor:
        """Inputs of R roll-outs: environments follow the steps, if there are any."""
        return torch.cat([*values], dim=0 if name == "attached_mass" else 1)

    def cases(self) -> Iterator[_Case]:
        """Yields the start and every input and parameter in its shapes,
        with random changes of typical size.
        """
        simulator = self.simulator
        length = float((self.state.q[0].max(0).values - self.state.q[0].min(0).values).max())
        sizes = {"q": 3e-4 * length, "v": 0.3 * length}
        sizes |= {"external_force": 1e-2, "fixed_positions": 3e-4 * length, "attached_mass": 5e-5}
        sizes |= {name: 0.1 * quantity.typical for name, quantity in simulator.inputs.items()}
        for name, value in {"q": self.state.q, "v": self.state.v, **self.inputs.fields}.items():
            if value.numel():
                yield _Case(
                    name,
                    "one",
                    self.direction(sizes[name], *value.shape),
                    partial(torch.add, value),
                )
        for name, quantity in simulator.parameters.items():
            base = simulator.tensor(simulator.defaults[name])
            shapes: dict[str, tuple[int, ...]] = {
                "environment": (self.batch, *(quantity.shape or (3,)))
            }
            if name != "gravity" and not quantity.shape:
                base, shapes = base.mean(), {"environment": (self.batch, 1)}
                if quantity.per:
                    shapes = {"one": (1,), quantity.per: (simulator.counts[name],), **shapes}
            for kind, shape in shapes.items():
                size = 0.01 if quantity.shape else 0.7
                yield _Case(
                    name, kind, self.direction(size, *shape), partial(quantity.varied, base)
                )

    def direction(self, size: float, *shape: int) -> torch.Tensor:
        """A random change whose largest entry is the size times the factor of all changes."""
        noise = self.noise(*shape)
        return noise * (self.change * size / noise.abs().max())

    def compare(self, cases: Sequence[_Case]) -> list[GradientRow]:
        """Rows of cases that change together, or alone where they contribute little."""
        zeros = [torch.zeros_like(case.change, requires_grad=True) for case in cases]
        gradients = torch.autograd.grad(self.loss(cases, zeros), zeros)
        adjoints = [
            float((g * case.change).sum()) for g, case in zip(gradients, cases, strict=True)
        ]
        largest = max(map(abs, adjoints))
        alone = [k for k, adjoint in enumerate(adjoints) if not abs(adjoint) >= _LEAST * largest]
        groups = [[k for k in range(len(cases)) if k not in alone], *([k] for k in alone)]
        return [row for group in groups if group for row in self._rows(cases, adjoints, group)]

    def _rows(
        self, cases: Sequence[_Case], adjoints: Sequence[float], group: Sequence[int]
    ) -> Iterator[GradientRow]:
        """Rows of the cases of a group, which change together by amounts
        that contribute about the same.
        """
        least = min(abs(adjoints[k]) for k in group)
        shares = {k: least / adjoints[k] if adjoints[k] else 1.0 for k in group}
        if len(group) > 1:  # at random, so that wrong derivatives do not cancel
            factors = 0.5 + 0.5 * torch.rand(len(group), generator=self.random)
            shares = {
                k: share * float(factor)
                for (k, share), factor in zip(shares.items(), factors, strict=True)
            }

        steps = [sign * 0.5**k for k in range(1 + _HALVINGS) for sign in (1.0, -1.0)]
        variants = [
            [step * shares.get(k, 0.0) * case.change for k, case in enumerate(cases)]
            for step in steps
        ]
        # All differences in one batch, as a small body's step takes as long as theirs.
        with torch.no_grad():
            losses = dict(zip(steps, self.losses(cases, variants).tolist(), strict=True))
        total, uncertainty = central_difference(losses.__getitem__)
        error = total - sum(share * adjoints[k] for k, share in shares.items())
        for k, share in shares.items():
            yield GradientRow(
                cases[k].title, adjoints[k], adjoints[k] + error / share, abs(uncertainty / share)
            )
