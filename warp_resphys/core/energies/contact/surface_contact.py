r"""Contact of bodies with one another and with themselves:
a barrier between surfaces, and Coulomb friction.

A surface consists of triangles. A vertex and a triangle, or two edges, at the distance d < D, have
the energy

    a kappa D B(d / D),     B(s) = -(s - 1)^2 ln s,

with the area a that the pair stands for, and friction as in `energies.contact`: with the normal
force, the normal and the nearest points of the start of a step, it acts against the relative slide
of these points since then. Where the nearest point is on an edge or at a vertex that several
triangles have in common, their energies are summed so that it counts once (inclusion and
exclusion). Edges that are almost parallel have a factor that vanishes for parallel ones, where
their nearest points are not unique (incremental potential contact; Li et al. 2020).

In contact of two surfaces, the vertices of both stand for half of the area each, and their edges
for an eighth. Where meshes match, the pressure at a gap is that of an obstacle; edges that cross
add to it. Triangles and edges that share a vertex are no pair.

M. Li et al.: Incremental potential contact. ACM Transactions on Graphics 39 (4), 2020.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final, cast

import numpy as np
import torch
from typing_extensions import override

from ....io.errors import InputError, naming
from ...fem.integration_points import Points
from ...fem.scene import Scene
from ...mesh.volume_mesh import Mesh
from ...stepping.quantity import Parameter, Quantity
from ..base import BoundEnergy, Energy, EnergySite, EnergyStep
from ..launcher import Launcher
from ..term import PointSet, value_of
from .barrier import ContactForces
from .pairs import PairList, Surface
from .surface_term import FRICTION, STIFFNESS, SurfacePoints, SurfaceTerm
from .touching_bodies import FrictionPair

_LEAST: Final = 1e-4  # share of D within which surfaces count as touching


@dataclass(frozen=True)
class SurfaceContact(Energy):
    """Contact of a body with itself or, as `Scene.contact`,
    of all bodies with one another and with themselves.

    Parameters are ``surface_stiffness`` [Pa] and ``surface_friction`` (equations in the module's
    docstring), which has one value, or where `pairs` are given that of all others and then theirs.

    Raises:
        InputError: a value out of range.
    """

    is_barrier: ClassVar[bool] = True

    stiffness: Parameter = 1e5  # kappa [Pa]
    friction: Parameter = 0.0  # mu
    distance: float = 1e-3  # D [m]
    slip_speed: float = 1e-3  # v_s [m/s]
    pairs: Mapping[str, FrictionPair] = field(default_factory=dict)  # by name; the first that fits

    def __post_init__(self) -> None:
        """Checks the values."""
        for name in ("distance", "slip_speed"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise InputError(
                    f"{name} of a contact between surfaces is {getattr(self, name):g}: "
                    "it must be positive."
                )
        STIFFNESS.check(self.stiffness)
        FRICTION.check(self.friction)
        if not isinstance(self.pairs, Mapping) or "other" in self.pairs:
            raise InputError(
                f"pairs of a contact between surfaces are {self.pairs!r}: give FrictionPair(...) "
                "by name, other than 'other', which stands for all surfaces that are in no pair."
            )
        if self.pairs and not isinstance(self.friction, float | int):
            raise InputError(
                "contact of surfaces with pairs has one number as the friction of all others."
            )

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return ("other", *self.pairs) if self.pairs else super().names

    @property
    @override
    def count(self) -> int:
        return 1 + len(self.pairs)

    @override
    def count_of(self, quantity: Quantity) -> int:
        return self.count if quantity == FRICTION else 1

    @property
    @override
    def parameters(self) -> tuple[Quantity, ...]:
        return (STIFFNESS, FRICTION)

    @property
    @override
    def defaults(self) -> Mapping[str, Parameter]:
        others = [float(pair.friction) for pair in self.pairs.values()]
        friction = [cast(float, self.friction), *others] if others else self.friction
        return {STIFFNESS.name: self.stiffness, FRICTION.name: friction}

    @override
    def points(self, mesh: Mesh) -> tuple[Points, ...]:
        surface = Surface.of(mesh)
        vertices = surface.vertices
        regions = np.zeros((len(self.pairs), 2, len(mesh.vertices)), dtype=np.bool_)
        for row, (name, pair) in zip(regions, self.pairs.items(), strict=True):
            for members, region in zip(row, (pair.first, pair.second), strict=True):
                with naming(f"the pair {name!r} of a contact between surfaces: "):
                    members[mesh.cells[mesh.region(region)]] = True
        return (
            SurfacePoints(vertices[:, None], np.ones((len(vertices), 1, 1, 1)), surface, regions),
        )

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "SurfaceTerm":
        return SurfaceTerm(launcher, sets, self.distance)

    @override
    def bind(self, site: EnergySite) -> "BoundSurfaceContact":
        return BoundSurfaceContact(self, site)


class BoundSurfaceContact(BoundEnergy):
    """Contact of surfaces in a simulator."""

    rate_independent = True

    def __init__(self, contact: SurfaceContact, site: EnergySite) -> None:
        super().__init__(contact, site)
        self._contact = contact
        body, rest = site.body, site.rest_positions
        members = body.bodies.values() if isinstance(body, Scene) else (body,)
        if any(member.glued or member.symmetry for member in members):
            raise InputError(
                "contact between surfaces does not support symmetry planes or glue, where the "
                "boundary of a mesh is no surface: leave them out."
            )
        (points,) = site.points
        assert isinstance(points, SurfacePoints)
        self._vertices = torch.as_tensor(points.nodes[:, 0], device=rest.device)
        pairs = PairList(Launcher(1, rest.device), points.placed(len(rest)), contact.distance)
        self._check_rest(pairs, rest.double()[None])

    def _check_rest(self, pairs: PairList, rest: torch.Tensor) -> None:
        """Raises InputError where surfaces cross or touch at rest,
        or parts of a piece are within reach of others.
        """
        words = pairs.surface.words
        pairs.check_apart(rest, "at rest", "move the bodies apart, or mend the mesh")
        pairs.find(rest, torch.zeros_like(rest))
        piece, ends = torch.as_tensor(pairs.surface.pieces, device=rest.device), pairs.nodes
        gaps = pairs.distances(rest)
        if len(gaps) and float(gaps.min()) < _LEAST * self._contact.distance:
            nearest = int(gaps.argmin())
            raise InputError(
                f"surfaces touch at rest, at {words(int(ends[nearest, 0]))} and "
                f"{words(int(ends[nearest, 3]))}: "
                "leave a gap of about contact's distance between bodies."
            )
        close = (gaps < self._contact.distance) & (piece[ends[:, 0]] == piece[ends[:, 3]])
        if bool(close.any()):
            worst = int(torch.where(close, gaps, torch.inf).argmin())
            raise InputError(
                f"contact between surfaces begins at {1e3 * self._contact.distance:g} mm, but at "
                f"rest the surface of a body is {1e3 * float(gaps[worst]):.3g} mm from itself, "
                f"between {words(int(ends[worst, 0]))} and {words(int(ends[worst, 3]))}: take a "
                "smaller distance."
            )

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        state, stage = step.state, step.stage
        duration = stage.step if math.isfinite(stage.step) else self.site.time_step
        return {
            "surface_start": state.q,
            "surface_reference": stage.velocity_reference,
            "surface_slip": state.q.new_full((state.batch, 1), self._contact.slip_speed * duration),
            "surface_place": state.q.detach(),
        }

    def forces(self, step: EnergyStep, x: torch.Tensor) -> ContactForces:
        """Returns the forces at the solution x (B, N, 3) of a step's implicit stage [m].

        Gaps are the least of a vertex, the distance at which contact begins where none is nearer;
        slides the largest.
        """
        assert isinstance(step.term, SurfaceTerm)
        shared = {
            q.name: step.value(q.name).expand(step.state.batch, -1) for q in (STIFFNESS, FRICTION)
        }
        values = {
            n: v.double() for n, v in {**shared, **self.begin_step(step)}.items() if v is not None
        }
        gap, normal, friction, slide = (out.to(x) for out in step.term.forces(values, x.double()))
        sticks = (slide >= 0.0) & (slide < value_of(values, "surface_slip").to(x))
        return ContactForces(
            (),
            self._vertices,
            gap,
            normal,
            friction,
            slide.clamp_min(0.0),
            sticks,
            x[:, self._vertices],
        )
