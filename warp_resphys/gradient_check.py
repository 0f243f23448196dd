"""Adjoint gradients of a short roll-out against central differences, for every kind of parameter."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from rich.table import Table

from .configured import build_simulator
from .errors import InputError
from .integrator import State
from .material import Material
from .poses import twisted
from .simulator import Simulator

_PRESSURE = 1e4  # [Pa] in the chambers, about
POSES = ("rest", "bent", "twisted")
_HALVINGS = 6  # of the step of a difference
_ACCURACY = 1e-8  # relative, at which a difference is good enough


@dataclass(frozen=True)
class GradientRow:
    """One comparison.

    Attributes:
        parameter: its name.
        adjoint: directional derivative of the loss by the adjoint.
        difference: the same by central differences.
        uncertainty: of the difference, by truncation and rounding.
    """

    parameter: str
    adjoint: float
    difference: float
    uncertainty: float = 0.0

    @property
    def relative_error(self) -> float:
        """|adjoint - difference| over the larger magnitude.

        Infinite where both vanish, since such a row compares nothing, and where one is not finite.
        """
        scale = max(abs(self.adjoint), abs(self.difference))
        error = abs(self.adjoint - self.difference) / scale if scale > 0.0 else math.inf
        return error if math.isfinite(error) else math.inf


def central_difference(function: Callable[[float], float]) -> tuple[float, float]:
    """Derivative at zero of a function of one number, and about how far it may be off.

    Central differences over steps of 1, 1/2, 1/4, ... are extrapolated to a step of zero (Ridders 1982). Truncation
    makes the first extrapolations change from one step to the next, rounding the last ones: the one that changes least
    is taken, and its change says how good it is.
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
    """A state of a body that extends along x from its clamp: at rest, bent, or twisted by 90 degrees about x.

    Args:
        simulator: of the body.
        name: one of `POSES`.
        batch: environments; each is posed a little differently, but for the rest state.
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
    simulator: Simulator, pose_name: str = "bent", steps: int = 3, batch: int = 2, seed: int = 0
) -> list[GradientRow]:
    """Compares the directional derivatives of a random linear functional of all positions and velocities.

    Constants vary by factors, and Poisson's ratio between its bounds, so that no difference leaves the physical range.
    The damping constants must be positive.

    Args:
        simulator: with a tight tolerance, in float64.
        pose_name: start of the roll-out (see `pose`).
        steps: of the roll-out.
        batch: environments.
        seed: of directions and functional.

    Returns:
        One row a parameter: initial positions and velocities, external forces, Dirichlet targets where the body has
        any, E and nu (scalar, per element, per environment), density, mass and stiffness damping; and the chambers'
        pressures and their fibres' stiffness (the same for all, per chamber) where the body has any.
    """
    problem = _Problem(simulator, pose_name, steps, batch, seed)
    return [problem.compare(name, *case) for name, case in problem.cases().items()]


class _Problem:
    """A roll-out's loss as a function of one parameter at a time."""

    def __init__(self, simulator: Simulator, pose_name: str, steps: int, batch: int, seed: int) -> None:
        self.simulator, self.steps, self.batch = simulator, steps, batch
        self.random = torch.Generator().manual_seed(seed)
        self.state = pose(simulator, pose_name, batch)
        n = simulator.body.n_vertices
        self.forces = 1e-3 * self.noise(steps, batch, n, 3)
        self.targets = self.state.q[:, simulator.fixed].expand(steps, -1, -1, -1).clone()
        chambers = len(simulator.body.chambers)
        self.pressures = _PRESSURE * (1.0 + 0.3 * self.noise(steps, batch, chambers)) if chambers else None
        h = simulator.time_step
        self.weights = self.noise(steps + 1, batch, n, 3), h * self.noise(steps + 1, batch, n, 3)

    def noise(self, *shape: int) -> torch.Tensor:
        return self.simulator.tensor(torch.randn(*shape, generator=self.random, dtype=torch.float64))

    def loss(
        self,
        q: torch.Tensor | None = None,
        v: torch.Tensor | None = None,
        forces: torch.Tensor | None = None,
        targets: torch.Tensor | None = None,
        material: Material | None = None,
        pressures: torch.Tensor | None = None,
    ) -> torch.Tensor:
        state = State(self.state.q if q is None else q, self.state.v if v is None else v)
        trajectory = self.simulator.rollout(
            state,
            self.steps,
            self.forces if forces is None else forces,
            self.targets if targets is None else targets,
            material,
            self.pressures if pressures is None else pressures,
        )
        return (self.weights[0] * trajectory.q).sum() + (self.weights[1] * trajectory.v).sum()

    def cases(self) -> dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], torch.Tensor, float]]:
        """Loss, value and typical size of a change, by parameter."""
        b = self.batch
        elements = len(self.simulator.body.mesh.cells)
        length = float((self.state.q[0].max(0).values - self.state.q[0].min(0).values).max())
        cases: dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], torch.Tensor, float]] = {
            "initial positions": (lambda x: self.loss(q=x), self.state.q, 3e-4 * length),
            "initial velocities": (lambda x: self.loss(v=x), self.state.v, 0.3 * length),
            "external forces": (lambda x: self.loss(forces=x), self.forces, 1e-2),
        }
        if len(self.simulator.fixed):
            cases["fixed positions"] = (lambda x: self.loss(targets=x), self.targets, 3e-4 * length)

        shapes = {"scalar": (1,), "per element": (elements,), "per environment": (b, 1)}
        constants = {
            f"{name}, {kind}": (key, shape)
            for name, key in (("E", "youngs_modulus"), ("nu", "poissons_ratio"))
            for kind, shape in shapes.items()
        }
        constants |= {key.replace("_", " "): (key, (1,)) for key in ("density", "mass_damping", "stiffness_damping")}
        if self.pressures is not None:
            cases["pressure"] = (lambda x: self.loss(pressures=x), self.pressures, 0.1 * _PRESSURE)
        if self.simulator.body.fibres is not None:
            for kind, count in (("scalar", 1), ("per chamber", len(self.simulator.body.chambers))):
                constants[f"fibre stiffness, {kind}"] = ("fibre_stiffness", (count,))
        zero = self.simulator.tensor(0.0)
        return cases | {name: (self._vary(key), zero.expand(shape), 0.7) for name, (key, shape) in constants.items()}

    def _vary(self, key: str) -> Callable[[torch.Tensor], torch.Tensor]:
        """The loss by the logarithm of a constant's factor, or by that of nu's way from -1 over that to 0.5."""
        base = self.simulator.tensor(getattr(self.simulator.material, key)).mean()

        def loss(x: torch.Tensor) -> torch.Tensor:
            nu = key == "poissons_ratio"
            value = 1.5 * torch.sigmoid(torch.logit((base + 1.0) / 1.5) + x) - 1.0 if nu else base * torch.exp(x)
            changed: dict[str, Any] = {key: value}
            return self.loss(material=replace(self.simulator.material, **changed))

        return loss

    def compare(
        self, name: str, loss: Callable[[torch.Tensor], torch.Tensor], value: torch.Tensor, size: float
    ) -> GradientRow:
        direction = self.noise(*value.shape)
        direction *= size / direction.abs().max()
        variable = value.detach().clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(loss(variable), variable)
        with torch.no_grad():
            difference = central_difference(lambda step: float(loss(value + step * direction)))
        return GradientRow(name, float((gradient * direction).sum()), *difference)


def check_configured(config: Mapping[str, Any]) -> Iterator[tuple[float, str, list[GradientRow]]]:
    """Checks the gradients of a configured body, material and solver.

    Args:
        config: with the keys of ``conf/gradcheck.yaml``.

    Yields:
        Poisson's ratio, pose, and the comparisons there.

    Raises:
        InputError: a value that cannot be simulated, an unknown pose, or float32, whose rounding drowns differences.
        ConvergenceError: the solver does not reach the tolerance.
    """
    check = config["gradcheck"]
    for name in check["poses"]:
        if name not in POSES:
            raise InputError(f"gradcheck.poses has {name!r}: choose from {', '.join(POSES)}.")
    if config["dtype"] != "float64":
        raise InputError(f"dtype is {config['dtype']!r}: gradients are checked in float64.")
    for key in ("mass_damping", "stiffness_damping", "steps", "batch"):
        if not check[key] > 0:
            raise InputError(f"gradcheck.{key} is {check[key]}: it must be positive.")
    damping = {key: check[key] for key in ("mass_damping", "stiffness_damping")}
    solver = {**config["solver"], "relative_tolerance": check["relative_tolerance"]}
    simulator = build_simulator({**config, "solver": solver})
    for poissons_ratio in check["poissons_ratios"]:
        material = replace(simulator.material, poissons_ratio=poissons_ratio, **damping)
        checked = replace(simulator, material=material)
        for name in check["poses"]:
            yield poissons_ratio, name, check_gradients(checked, name, check["steps"], check["batch"], check["seed"])


def gradient_table(rows: list[GradientRow], title: str, tolerance: float) -> Table:
    """Adjoint, difference, its uncertainty and relative error of each parameter, in red beyond the tolerance."""
    table = Table(title=title, title_justify="left")
    table.add_column("parameter", min_width=20)
    for name in ("adjoint", "difference", "uncertain\nby", "relative\nerror"):
        table.add_column(name, justify="right")
    for row in rows:
        failed = not row.relative_error <= tolerance
        values = (f"{row.adjoint:.6e}", f"{row.difference:.6e}", f"{row.uncertainty:.1e}", f"{row.relative_error:.1e}")
        table.add_row(row.parameter, *values, style="red" if failed else None)
    return table
