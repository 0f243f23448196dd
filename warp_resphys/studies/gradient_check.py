"""Adjoint gradients of a short roll-out against central differences, for every kind of parameter."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from rich.table import Table

from ..dynamics.integrator import State
from ..dynamics.simulator import Simulator
from ..energies.material import Material
from ..experiment.build import build_simulator
from ..experiment.kinds import COUNT, NATURAL, POSITIVE, Kind, check_keys, is_list
from ..io.errors import InputError
from ..mesh.poses import twisted

_PRESSURE = 1e4  # [Pa] in the chambers, about
POSES = ("rest", "bent", "twisted")
_KEYS = {
    "poses": Kind(lambda value: isinstance(value, list) and bool(value), "a list of poses"),
    "poissons_ratios": Kind(lambda value: is_list(value) and bool(value), "a list of numbers"),
    "steps": NATURAL,
    "batch": NATURAL,
    "seed": COUNT,
    "tolerance": POSITIVE,
    "relative_tolerance": POSITIVE,
    "mass_damping": POSITIVE,
    "stiffness_damping": POSITIVE,
}
# Seven-point stencil: its error is of sixth order in the step, so that steps of a percent, which drown the rounding of
# the solves, still leave a truncation of 1e-10.
_STENCIL = tuple((s * k, s * w) for s in (1, -1) for k, w in ((1, 3.0 / 4.0), (2, -3.0 / 20.0), (3, 1.0 / 60.0)))


@dataclass(frozen=True)
class GradientRow:
    """One comparison.

    Attributes:
        parameter: its name.
        adjoint: directional derivative of the loss by the adjoint.
        difference: the same by central differences.
    """

    parameter: str
    adjoint: float
    difference: float

    @property
    def relative_error(self) -> float:
        """|adjoint - difference| over the larger magnitude.

        Infinite where both vanish, since such a row compares nothing, and where one is not finite.
        """
        scale = max(abs(self.adjoint), abs(self.difference))
        error = abs(self.adjoint - self.difference) / scale if scale > 0.0 else math.inf
        return error if math.isfinite(error) else math.inf


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

    The material's damping constants should be positive, or their central differences would leave the physical range.

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
        m, b = self.simulator.material, self.batch
        elements = len(self.simulator.body.mesh.cells)
        length = float((self.state.q[0].max(0).values - self.state.q[0].min(0).values).max())
        full = self.simulator.tensor
        cases: dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], torch.Tensor, float]] = {
            "initial positions": (lambda x: self.loss(q=x), self.state.q, 1e-5 * length),
            "initial velocities": (lambda x: self.loss(v=x), self.state.v, 1e-2 * length),
            "external forces": (lambda x: self.loss(forces=x), self.forces, 1e-3),
        }
        if len(self.simulator.fixed):
            cases["fixed positions"] = (lambda x: self.loss(targets=x), self.targets, 1e-5 * length)
        shapes = {"scalar": (1,), "per element": (elements,), "per environment": (b, 1)}
        for name, key, change, limit in (("E", "youngs_modulus", 1e-2, 0.0), ("nu", "poissons_ratio", 2e-2, 0.5)):
            constant = float(getattr(m, key))
            for kind, shape in shapes.items():
                value = full(constant).expand(shape).clone()
                cases[f"{name}, {kind}"] = (self._vary(key), value, change * abs(constant - limit))
        for key, change in (("density", 1e-2), ("mass_damping", 0.25), ("stiffness_damping", 5e-3)):
            value = full(float(getattr(m, key))).reshape(1)
            cases[key.replace("_", " ")] = (self._vary(key), value, change * float(value))
        if self.pressures is not None:
            cases["pressure"] = (lambda x: self.loss(pressures=x), self.pressures, 0.1 * _PRESSURE)
        if self.simulator.body.fibres is not None:
            stiffness = full(m.fibre_stiffness).mean()
            for kind, count in (("scalar", 1), ("per chamber", len(self.simulator.body.chambers))):
                value = stiffness.expand(count).clone()
                cases[f"fibre stiffness, {kind}"] = (self._vary("fibre_stiffness"), value, 1e-2 * float(stiffness))
        return cases

    def _vary(self, key: str) -> Callable[[torch.Tensor], torch.Tensor]:
        def loss(value: torch.Tensor) -> torch.Tensor:
            changed: dict[str, Any] = {key: value}
            return self.loss(material=replace(self.simulator.material, **changed))

        return loss

    def compare(
        self, name: str, loss: Callable[[torch.Tensor], torch.Tensor], value: torch.Tensor, size: float
    ) -> GradientRow:
        direction = self.noise(*value.shape)
        direction = size * direction / (0.5 + direction.abs())  # bounded by size, as the stencil's truncation is then
        variable = value.detach().clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(loss(variable), variable)
        with torch.no_grad():
            difference = sum(w * float(loss(value + k * direction)) for k, w in _STENCIL)
        return GradientRow(name, float((gradient * direction).sum()), difference)


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
    check_keys("gradcheck", check, _KEYS)
    for name in check["poses"]:
        if name not in POSES:
            raise InputError(f"gradcheck.poses has {name!r}: choose from {', '.join(POSES)}.")
    if config["dtype"] != "float64":
        raise InputError(f"dtype is {config['dtype']!r}: gradients are checked in float64.")
    damping = {key: check[key] for key in ("mass_damping", "stiffness_damping")}
    solver = {**config["solver"], "relative_tolerance": check["relative_tolerance"]}
    simulator = build_simulator({**config, "solver": solver})
    for poissons_ratio in check["poissons_ratios"]:
        material = replace(simulator.material, poissons_ratio=poissons_ratio, **damping)
        checked = replace(simulator, material=material)
        for name in check["poses"]:
            yield poissons_ratio, name, check_gradients(checked, name, check["steps"], check["batch"], check["seed"])


def gradient_table(rows: list[GradientRow], title: str, tolerance: float) -> Table:
    """Adjoint, difference and relative error of each parameter, in red beyond the tolerance."""
    table = Table(title=title, title_justify="left")
    table.add_column("parameter", min_width=20)
    for name in ("adjoint", "difference", "relative error"):
        table.add_column(name, justify="right")
    for row in rows:
        failed = not row.relative_error <= tolerance
        values = (f"{row.adjoint:.9e}", f"{row.difference:.9e}", f"{row.relative_error:.1e}")
        table.add_row(row.parameter, *values, style="red" if failed else None)
    return table
