"""Inflated membranes: a clamped disc that lifts a round cap of some weight,
simulated as a wedge of quadratic cells.

The cap is rigid, guided along z, and holds the silicone below it unstretched. Rings are stiff
through the whole thickness, and free to rise and turn. At a height h of the cap, the pressure p in
equilibrium carries the weight F:

    R(p, h) = p pi r0^2 - f_z = F

with the force f_z of the cap on the silicone around r0 (`Simulator.reaction`), all around. As the
height is given, a fall of the pressure while the cap rises is followed without arc length. The
adjoint of f_z gives dR/dp for Newton's method, and the derivatives of the pressure,
dp/dc = -(dR/dc) / (dR/dp).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, pairwise
from typing import Final

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from ...core.dynamics.simulator import Simulator
from ...core.dynamics.solver_settings import SolverSettings
from ...core.energies.catalogue import make_material
from ...core.energies.isochoric import TERMS, bulk_of, shear_modulus
from ...core.energies.pressure import Pressure
from ...core.fem.bodies import Body
from ...core.fem.coordinates import SymmetryPlane
from ...core.mesh.boxes import box_hexahedra
from ...core.mesh.chambers import Chamber
from ...core.mesh.selection import select_faces
from ...core.mesh.volume_mesh import Mesh
from ...core.stepping.inputs import Inputs
from ...io.arrays import Brief, FloatArray, IntArray
from ...io.errors import ConvergenceError, InputError

_ANGLE: Final = 0.15  # of the wedge [rad]
_HEIGHTS: Final = 6  # at which a membrane is simulated
_MOST: Final = 0.15  # largest relative change of a pressure in an iteration
_FAILURES: Final = 3  # halvings of such a change
_SHARES: Final = (0.1, 0.4, 0.7, 1.0)  # of the force at the first height
_SOLVES: Final = (
    99  # of Newton's method for the positions; more are needed only where there is no equilibrium
)
_ITERATIONS: Final = 20  # of Newton's method for the pressure
_EXACT: Final = 1e-4  # relative error of the force
_FAR: Final = 1.1  # ratio of a parameter to the last one beyond which a solution starts anew
_RING_RATIO: Final = 0.499  # Poisson's ratio of the rings
_RINGS: Final = "rings"  # their region


@dataclass(frozen=True)
class Membrane(Brief):
    """A clamped disc under pressure, which lifts a cap of some weight.

    Args:
        radius: of the disc within its clamp [m].
        thickness: [m].
        cap: radius of the cap [m].
        force: weight of the cap [N].
        rings: mean radius and half-width of each stiff ring, from the inner to the outer one [m].
        ring_modulus: shear modulus of the rings [Pa].
        poissons_ratio: of the silicone at small strains.
        cell: largest length of a cell along the radius, in thicknesses.
        layers: cells through the thickness.

    Raises:
        InputError: sizes that are not positive, or a cap and rings that overlap or do not fit into
            the disc.
    """

    radius: float
    thickness: float
    cap: float
    force: float
    rings: Sequence[tuple[float, float]] = ()
    ring_modulus: float = 1e6
    poissons_ratio: float = 0.4995
    cell: float = 1.0
    layers: int = 1
    _simulators: dict[tuple[str, ...], Simulator] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _last: "list[_Solution]" = field(default_factory=list, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Checks the sizes."""
        for name in ("radius", "thickness", "cap", "force", "ring_modulus", "cell"):
            size = getattr(self, name)
            if not (math.isfinite(size) and size > 0.0):
                raise InputError(
                    f"{name} of a membrane is {size:g}: give a positive number, in SI units."
                )
        of_rings = chain.from_iterable((r - half, r + half) for r, half in self.rings)
        edges = [self.cap, *of_rings, self.radius]
        if any(not low < high for low, high in pairwise(edges)):
            shown = ", ".join(f"{1e3 * edge:.4g}" for edge in edges)
            raise InputError(
                f"cap, edges of the rings and clamp are at {shown} mm, which do not rise: give "
                "the mean radius and the half-width of each ring, from the inner to the outer "
                "one, between the cap and the clamp."
            )

    @cached_property
    def inner(self) -> float:
        """Radius r0 up to which the silicone below the cap is left out [m]."""
        return max(self.cap - self.thickness, 0.5 * self.cap)

    @cached_property
    def _box(self) -> tuple[Mesh, FloatArray]:
        """The wedge with its regions, and the radius of each vertex (N,) [m]."""
        rings = [(r - half, r + half) for r, half in self.rings]
        cuts = sorted({self.inner, self.cap, self.radius, *np.ravel(rings).tolist()})
        size = self.cell * self.thickness
        parts = [
            np.linspace(a, b, max(1 + (a >= self.cap), math.ceil((b - a) / size)) + 1)[1:]
            for a, b in pairwise(cuts)
        ]
        grid = np.concatenate([cuts[:1], *parts])
        box = box_hexahedra((1.0, 1.0, 1.0), (len(grid) - 1, 1, self.layers), nodes=27)
        share, turn, height = box.vertices.T
        away = np.interp(share, np.linspace(0.0, 1.0, len(grid)), grid)
        places = [
            away * np.cos(_ANGLE * turn),
            away * np.sin(_ANGLE * turn),
            self.thickness * height,
        ]
        middle = away[box.cells].mean(axis=1)
        stiff = np.any([(middle > a) & (middle < b) for a, b in rings] or [middle < 0.0], axis=0)
        regions = {"sheet": np.flatnonzero(~stiff), _RINGS: np.flatnonzero(stiff)}
        return Mesh(np.stack(places, 1), box.cells, regions=regions if rings else {}), away

    @cached_property
    def lifted(self) -> IntArray:
        """Vertices that the cap holds."""
        mesh, away = self._box
        below = (mesh.vertices[:, 2] > (1.0 - 1e-9) * self.thickness) & (
            away <= self.cap * (1.0 + 1e-9)
        )
        return np.flatnonzero(below | (away <= self.inner * (1.0 + 1e-9)))

    def _simulator(self, terms: tuple[str, ...]) -> Simulator:
        """Returns the simulator of the wedge with a law that has some elastic terms."""
        if terms not in self._simulators:
            mesh, away = self._box
            clamped = np.flatnonzero(away >= self.radius * (1.0 - 1e-9))
            below = Pressure([Chamber("below", select_faces(mesh, z=0.0))])
            planes = [
                SymmetryPlane((0.0, 1.0, 0.0)),
                SymmetryPlane((-math.sin(_ANGLE), math.cos(_ANGLE), 0.0)),
            ]
            body = Body(mesh, np.union1d(self.lifted, clamped), energies=[below], symmetry=planes)
            sheet = make_material("law", **dict.fromkeys(("c10", *terms), 1e4), bulk_1=1e7)
            stiff = {"c10": 0.5 * self.ring_modulus}
            rings = make_material("law", **stiff, bulk_1=bulk_of(stiff, _RING_RATIO))
            material = {"sheet": sheet, _RINGS: rings} if self.rings else sheet
            solver = SolverSettings(name="newton", relative_tolerance=1e-6, max_iterations=_SOLVES)
            self._simulators[terms] = Simulator(
                body, material, gravity=(0.0, 0.0, 0.0), solver=solver
            )
        return self._simulators[terms]

    def response(
        self, strain: FloatArray, parameters: Mapping[str, float]
    ) -> tuple[FloatArray, dict[str, FloatArray], FloatArray]:
        """Returns the pressure (N,) [Pa] of a law at heights
        over the radius (N,), and its derivatives.

        The derivatives are by the parameters, of which viscosity and branches have none, and by the
        height over the radius.

        Raises:
            InputError: heights that are not positive.
            ConvergenceError: the membrane has no equilibrium, as when the law is too soft and it
                bursts.
        """
        low, high = float(strain.min()), float(strain.max())
        if not 0.0 < low <= high:
            raise InputError(
                "heights of a membrane start at zero: leave out those where the cap still rests."
            )
        law = {name: value for name, value in parameters.items() if TERMS.fullmatch(name)}
        levels = np.linspace(low, max(high, low * (1.0 + 1e-6)), _HEIGHTS) * self.radius
        problem = _Problem(self, self._simulator(tuple(law)), law)
        near = (
            self._last[-1]
            if self._last and self._last[-1].is_near(levels, problem.moduli)
            else None
        )
        self._last.clear()
        try:
            solution = problem.followed(levels) if near is None else problem.continued(near)
            by_name = problem.slopes(solution)
        except ConvergenceError as error:
            raise ConvergenceError(
                f"a membrane has no equilibrium under {self.force:.3g} N at heights up to "
                f"{1e3 * levels[-1]:.3g} mm: take a stiffer law, or lower heights.",
                error.positions,
                error.report,
            ) from error
        self._last.append(solution)

        def curve(values: FloatArray, order: int = 0) -> FloatArray:
            return np.asarray(CubicSpline(levels / self.radius, values)(strain, order))

        zero = np.zeros_like(strain)
        columns = {name: curve(by_name[name]) if name in by_name else zero for name in parameters}
        return curve(solution.pressure.numpy()), columns, curve(solution.pressure.numpy(), 1)


@dataclass(frozen=True)
class _Solution:
    """Pressures (S,) [Pa] and positions (S, N, 3) [m]
    in equilibrium at heights (S,) [m] with some moduli.
    """

    heights: FloatArray
    pressure: torch.Tensor
    q: torch.Tensor
    moduli: tuple[float, ...]

    def is_near(self, heights: FloatArray, moduli: tuple[float, ...]) -> bool:
        """Whether other moduli and heights are near enough to start from this solution."""
        if not np.array_equal(heights, self.heights) or len(moduli) != len(self.moduli):
            return False
        return all(
            1.0 / _FAR < new / old < _FAR
            for new, old in zip(moduli, self.moduli, strict=True)
            if old
        )


@dataclass(frozen=True)
class _Problem:
    """Equilibria of a membrane with the coefficients of a law."""

    membrane: Membrane
    simulator: Simulator
    law: Mapping[str, float]

    @property
    def moduli(self) -> tuple[float, ...]:
        """Coefficients, for comparison."""
        return (*self.law.values(),)

    def _parameters(self, size: int) -> dict[str, torch.Tensor]:
        """The coefficients (S, 1) by their names in the simulator, the bulk modulus last."""
        values = {**self.law, "bulk_1": bulk_of(self.law, self.membrane.poissons_ratio)}
        prefix = "sheet_" if self.membrane.rings else ""
        return {
            f"{prefix}{name}": self.simulator.tensor([[x]]).repeat(size, 1)
            for name, x in values.items()
        }

    def _inputs(self, heights: FloatArray, pressure: torch.Tensor) -> Inputs:
        """Returns the pressures (S,) and the places of cap and clamp at heights (S,)."""
        simulator = self.simulator
        held = simulator.rest_positions[simulator.fixed].repeat(len(heights), 1, 1)
        lifted = np.isin(simulator.fixed.cpu(), self.membrane.lifted)
        held[:, lifted, 2] += simulator.tensor(heights)[:, None]
        return Inputs(pressure=pressure[:, None], fixed_positions=held)

    def _carried(
        self,
        heights: FloatArray,
        pressure: torch.Tensor,
        start: torch.Tensor,
        parameters: Mapping[str, torch.Tensor],
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Weights (S,) [N] that pressures (S,) carry, differentiable, and positions (S, N, 3)."""
        inputs, membrane = self._inputs(heights, pressure), self.membrane
        state = self.simulator.static_equilibrium(inputs, parameters, start=start)
        around = (
            2.0 * math.pi / _ANGLE * self.simulator.reaction(state, at=membrane.lifted).force[:, 2]
        )
        return pressure * math.pi * membrane.inner**2 - around, state.q.detach()

    def solved(
        self,
        heights: FloatArray,
        pressure: torch.Tensor,
        start: torch.Tensor,
        force: float | None = None,
    ) -> _Solution:
        """Returns the equilibria that carry a force,
        by default that of the cap, by Newton's method.
        """
        goal = self.membrane.force if force is None else force
        parameters = self._parameters(len(heights))
        good, failures = pressure, 0  # the last pressures with an equilibrium
        for _ in range(_ITERATIONS):
            leaf = pressure.detach().clone().requires_grad_()
            try:
                carried, start = self._carried(heights, leaf, start, parameters)
            except ConvergenceError:  # above the largest pressure at this height
                failures += 1
                if failures > _FAILURES or torch.equal(good, pressure):
                    raise
                pressure = 0.5 * (pressure + good)
                continue
            good = pressure
            (slope,) = torch.autograd.grad(carried.sum(), leaf)
            away = goal - carried.detach()
            if not bool((slope > 0.0).all()):
                break  # beyond the limit of the pressure at this height
            if bool((away.abs() < _EXACT * self.membrane.force).all()):
                return _Solution(heights, pressure, start, self.moduli)
            most = _MOST * (pressure.abs().max() + self._unit)
            pressure = pressure + (away / slope).clamp(-most, most)
        raise ConvergenceError("no pressure carries the cap.", start, None)

    @property
    def _unit(self) -> float:
        """Shear modulus and thickness over radius [Pa], of the order of a tenth of pressures."""
        return shear_modulus(self.law) * self.membrane.thickness / self.membrane.radius

    def followed(self, heights: FloatArray) -> _Solution:
        """Returns the equilibria at rising heights,
        equally spaced, the first under an increasing force.
        """
        rest = self.simulator.rest_positions[None]
        membrane = self.membrane
        first = heights[:1]
        away = (membrane.radius - rest[0, :, :2].norm(dim=1)) / (membrane.radius - membrane.cap)
        q = rest.clone()
        q[..., 2] += heights[0] * away.clamp(0.0, 1.0)
        pressure = self.simulator.tensor([self._unit])
        carried, q = self._carried(first, pressure, q, self._parameters(1))
        begun = float(carried.detach())
        for share in _SHARES:
            now = self.solved(first, pressure, q, begun + share * (membrane.force - begun))
            pressure, q = now.pressure, now.q
        found = [now]
        for height in heights[1:]:
            if len(found) > 1:
                pressure, q = 2.0 * pressure - found[-2].pressure, 2.0 * q - found[-2].q
            else:
                q = q.clone()
                q[..., 2] += (height - heights[0]) * away.clamp(0.0, 1.0)
            found.append(self.solved(np.array([height]), pressure, q))
            pressure, q = found[-1].pressure, found[-1].q
        pressure = torch.cat([one.pressure for one in found])
        q = torch.cat([one.q for one in found])
        return _Solution(heights, pressure, q, self.moduli)

    def continued(self, near: _Solution) -> _Solution:
        """Returns the equilibria at the heights of a solution with other moduli."""
        try:
            return self.solved(near.heights, near.pressure, near.q)
        except ConvergenceError:  # The solution is too far away.
            return self.followed(near.heights)

    def slopes(self, solution: _Solution) -> dict[str, FloatArray]:
        """Returns the derivatives (S,) of the pressure by the coefficients."""
        pressure = solution.pressure.detach().clone()
        parameters = self._parameters(len(solution.heights))
        leaves = [pressure, *[*parameters.values()][: len(self.law)]]
        for leaf in leaves:
            leaf.requires_grad_()
        carried, _ = self._carried(solution.heights, pressure, solution.q, parameters)
        by_pressure, *others = torch.autograd.grad(carried.sum(), leaves)
        return {
            name: (-slope[:, 0] / by_pressure).numpy()
            for name, slope in zip(self.law, others, strict=True)
        }
