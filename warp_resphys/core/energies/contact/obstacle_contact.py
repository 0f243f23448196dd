r"""Contact of a body with rigid obstacles: a barrier against penetration, and Coulomb friction.

A point of the surface, which stands for the area a, has with the distance d from an obstacle the
energy

    a kappa D B(d / D),     B(s) = -(s - 1)^2 ln s for s < 1, and 0 beyond,

so that the pressure -kappa B'(d / D) begins at the distance D, has a continuous derivative, and
grows without bound towards d = 0 (incremental potential contact; Li et al. 2020). The stiffness
kappa [Pa] is constant: the gap of a resting body follows from it and is part of the geometry, about
D (1 - sqrt(p / 3 kappa)) under a small pressure p within a face. At edges, a point also stands for
its part of the side walls.

Friction of the coefficient mu, with the normal force lambda and the normal n of the start of a
step, and the slide u = (1 - n n^T)(x - r) relative to the obstacle since then, has the energy

    mu lambda f(|u|),     f'(y) = 2 y / e - y^2 / e^2 for y < e, and 1 beyond,     e = h v_s,

with the slip speed v_s at which it is fully developed. A body that should stick creeps: at the
share c of what friction can hold, with the speed v_s (1 - sqrt(1 - c)). As lambda and n depend on
the state at the start of the step, gradients by it include them.

In a static equilibrium after a state, friction acts against the slide since that state, with the
normal forces of that state: there is none where the body was not pressed against the obstacle
before.

M. Li et al.: Incremental potential contact. ACM Transactions on Graphics 39 (4), 2020.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from typing_extensions import override

from ....io.errors import InputError, check_type, in_short, listed
from ...fem.integration_points import Points
from ...mesh.volume_mesh import Mesh
from ...stepping.quantity import Parameter, Quantity
from ...stepping.rotations import rotations
from ...stepping.state import State
from ..base import BoundEnergy, Energy, EnergySite, EnergyStep, Memory
from ..launcher import Launcher
from ..term import PointSet, Values, value_of
from .barrier import ContactForces, barrier_pressure, friction_over_slide
from .clearance import Clearance
from .contact_points import (
    FRICTION,
    GROWTH,
    MOTION,
    POSE,
    SHIFT,
    STIFFNESS,
    TURN,
    ContactPoints,
    vertex_areas,
    vertex_factors,
)
from .obstacle_poses import ObstacleSet, Pose
from .obstacle_term import ContactTerm
from .obstacles import DistanceGrid
from .touching_bodies import Obstacle, SurfaceFile


@dataclass(frozen=True)
class Contact(Energy):
    """Contact of a body with obstacles (equations in the module's docstring).

    Parameters, one for each obstacle: ``contact_stiffness`` [Pa], ``contact_friction``,
    ``obstacle_growth``, by which its surface lies further out [m], ``obstacle_x``, ``_y`` and
    ``_z``, by which it lies elsewhere [m], and ``obstacle_turn_x``, ``_y`` and ``_z``, a rotation
    vector about its position [rad]. Inputs, if an obstacle moves, are `MOTION`, its pose at the end
    of a step relative to the configured one, which add to the last six. The points are the vertices
    of the surface, at which friction is multiplied by the factor of their region.

    Raises:
        InputError: no obstacle, a value out of range, or values that do not fit the obstacles.
    """

    is_barrier: ClassVar[bool] = True

    obstacles: Mapping[str, Obstacle]
    # kappa [Pa], a number or one by obstacle, in order or by name
    stiffness: Parameter | Mapping[str, float] = 1e5
    friction: Parameter | Mapping[str, float] = 0.0  # mu, likewise
    distance: float = 1e-3  # D [m]
    slip_speed: float = 1e-3  # v_s [m/s]
    friction_factors: Mapping[str, float] = field(default_factory=dict)  # of regions of the mesh

    def __post_init__(self) -> None:
        """Checks the values."""
        check_type("Contact: obstacles", self.obstacles, Mapping)
        if not self.obstacles:
            raise InputError("contact needs an obstacle or more: give them by name.")
        for name, obstacle in self.obstacles.items():
            if not isinstance(obstacle, Obstacle):
                raise InputError(
                    f"the obstacle {name} is {in_short(obstacle)}: give one, such as "
                    "HalfSpace(axis=...)."
                )
        grids = {
            name: DistanceGrid.of_file(o)
            for name, o in self.obstacles.items()
            if isinstance(o, SurfaceFile)
        }
        object.__setattr__(self, "obstacles", {**self.obstacles, **grids})
        for name in ("distance", "slip_speed"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise InputError(f"contact.{name} is {getattr(self, name):g}: it must be positive.")
        for region, factor in self.friction_factors.items():
            if not (math.isfinite(factor) and factor >= 0.0):
                raise InputError(
                    f"contact.friction_factors.{region} is {factor:g}: it must be zero or more."
                )
        for name, quantity in (("stiffness", STIFFNESS), ("friction", FRICTION)):
            values = self._by_obstacle(name)
            quantity.check(values)
            self.per_part(quantity, quantity.shaped(torch.as_tensor(values)))

    def _by_obstacle(self, name: str) -> Parameter:
        """Returns a number, or values in the order of the obstacles."""
        values: Parameter | Mapping[str, float] = getattr(self, name)
        if not isinstance(values, Mapping):
            return values
        if values.keys() != self.obstacles.keys():
            raise InputError(
                f"contact.{name} has values for {listed([*values])}, but the obstacles are "
                f"{listed(self.names)}: give a value to every one."
            )
        return [values[obstacle] for obstacle in self.obstacles]

    @property
    @override
    def parameters(self) -> tuple[Quantity, ...]:
        return (STIFFNESS, FRICTION, GROWTH, *SHIFT, *TURN)

    @property
    def moves(self) -> bool:
        """Whether an obstacle moves."""
        return any(obstacle.moves for obstacle in self.obstacles.values())

    @property
    def inputs(self) -> tuple[Quantity, ...]:  # type: ignore[override]
        """Motions of the obstacles, if one moves."""
        return MOTION if self.moves else ()

    @property
    @override
    def count(self) -> int:
        return len(self.obstacles)

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return tuple(self.obstacles)

    @property
    @override
    def defaults(self) -> Mapping[str, Parameter]:
        zeros = {quantity.name: 0.0 for quantity in (GROWTH, *SHIFT, *TURN)}
        known = {
            STIFFNESS.name: self._by_obstacle("stiffness"),
            FRICTION.name: self._by_obstacle("friction"),
        }
        return {**known, **zeros}

    @override
    def points(self, mesh: Mesh) -> tuple[Points, ...]:
        areas = vertex_areas(mesh)
        vertices = np.flatnonzero(areas)
        factors = vertex_factors(mesh, self.friction_factors)[vertices]
        return (
            ContactPoints(
                vertices[:, None], np.ones((len(vertices), 1, 1, 1)), areas[vertices], factors
            ),
        )

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "ContactTerm":
        return ContactTerm(launcher, sets, [*self.obstacles.values()], self.distance)

    @override
    def bind(self, site: EnergySite) -> "BoundContact":
        return BoundContact(self, site)


class BoundContact(BoundEnergy):
    """Contact in a simulator.

    Memory is the pose of the obstacles and that one step before, if one moves. Without memory, they
    have not moved.
    """

    rate_independent = True

    def __init__(self, contact: Contact, site: EnergySite) -> None:
        super().__init__(contact, site)
        self._contact = contact
        (points,) = site.points
        like, obstacles = site.rest_positions, tuple(contact.obstacles.values())
        assert isinstance(points, ContactPoints)
        if len(site.body.symmetry) or len(site.body.glued):
            what = "symmetry planes" if len(site.body.symmetry) else "glued vertices"
            raise InputError(
                f"a body with {what} has no contact with obstacles: leave one of them out."
            )
        self._vertices = torch.as_tensor(points.nodes[:, 0], device=like.device)
        self._area = site.tensor(points.areas)
        self._factor = site.tensor(points.factors)  # (P,) of friction
        self._has_factors = bool((points.factors != 1.0).any())
        self._interpolates = any(isinstance(obstacle, DistanceGrid) for obstacle in obstacles)
        self._shapes = ObstacleSet(obstacles, contact.distance, like.device)
        self._place = site.tensor(np.array([o.position for o in obstacles]))
        self._turn = site.tensor(np.stack([o.turn for o in obstacles]))
        self._moving = site.tensor(np.array([float(o.moves) for o in obstacles]))
        if contact.moves:
            sizes = (("contact_place", "m", (3,)), ("contact_turn", "rotation", (3, 3)))
            names = [
                (f"{when}{name}", unit, size)
                for when in ("", "previous_")
                for name, unit, size in sizes
            ]
            self.memory = tuple(
                Memory(name, unit, (contact.count, *size), "obstacle") for name, unit, size in names
            )
        self._fixed = torch.as_tensor(site.body.fixed_vertices + site.first, device=like.device)
        free = (~torch.isin(self._vertices, self._fixed)).to(self._area)
        rigid = list[tuple[torch.Tensor, torch.Tensor]]()
        for name in site.body.controls:
            cells = site.body.mesh.cells[site.body.mesh.region(name)]
            part = torch.as_tensor(np.unique(cells) + site.first, device=like.device)
            surface = torch.isin(self._vertices, part).nonzero().ravel()
            if len(surface):
                # Others are out of reach.
                rigid.append((surface, part[~torch.isin(part, self._vertices)]))
        self._clearance = Clearance(
            contact.obstacles, contact.distance, self._shapes, self._vertices, free, rigid
        )
        self._clearance.check_start(like, self.pose(contact.defaults, {}))

    def pose(self, parameters: Mapping[str, Any], inputs: Mapping[str, torch.Tensor]) -> Pose:
        """Returns the poses for parameters and inputs by name."""
        values = [self._place.new_zeros(1, 1) + parameters[q.name] for q in (*SHIFT, *TURN, GROWTH)]
        for number, quantity in enumerate(MOTION):
            if quantity.name in inputs:
                values[number] = values[number] + self._moving * inputs[quantity.name]
        rows = torch.broadcast_tensors(self._place[None, :, 0], *values)[1:]
        shift, turn = torch.stack(rows[:3], -1), rotations(torch.stack(rows[3:6], -1)) @ self._turn
        return Pose(self._place + shift, turn, rows[6])

    @override
    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor | None]:
        values = self.energy.prepare(parameters)
        pose = self.pose(values, {})
        for k, (name, obstacle) in enumerate(self._contact.obstacles.items()):
            if not isinstance(obstacle, DistanceGrid):
                continue
            most = float(pose.growth.detach()[:, k].max()) + self._contact.distance
            if obstacle.margin < most:
                raise InputError(
                    f"the grid of {name!r} ends {1e3 * obstacle.margin:.3g} mm outside of it, "
                    f"and contact begins at {1e3 * most:.3g} mm, "
                    "with obstacle_growth: give it a larger margin."
                )
        return {**values, "contact_place": pose.place, "contact_turn": pose.turn}

    def _pose(self, values: Values, inputs: Mapping[str, torch.Tensor], batch: int) -> Pose:
        """Poses (B, O, ...) at the end of a step with values of `prepare` and inputs by name."""
        if self._contact.moves:
            moved = self.pose(
                {q.name: value_of(values, q.name) for q in (GROWTH, *SHIFT, *TURN)}, inputs
            )
            parts = [moved.place, moved.turn, moved.growth]
        else:
            parts = [value_of(values, name) for name in (*POSE, GROWTH.name)]
        return Pose(*(part.expand(batch, *part.shape[1:]) for part in parts))

    def poses(
        self, memories: Sequence[Mapping[str, torch.Tensor]], values: Values, batch: int
    ) -> list[Pose]:
        """Returns the poses of the obstacles in successive states.

        Args:
            memories: the memory in these states.
            values: values of `prepare`.
            batch: number of environments.
        """
        still, poses = self._pose(values, {}, batch), list[Pose]()
        for memory in memories:
            poses.append(
                Pose(
                    memory.get(POSE[0], still.place), memory.get(POSE[1], still.turn), still.growth
                )
            )
        return poses

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        state, stage = step.state, step.stage
        now = self._pose(step.values, step.inputs, state.batch)
        before, earlier = self._remembered(step, now)
        x = state.q[:, self._vertices]
        d, n = self._shapes.distances(x, before)
        if x.device.type == "cpu":  # On a GPU the host would wait.
            self._clearance.check(state.q, before, "at the start of a step", d)
        same = stage.velocity_reference is state.q
        reference = (x if same else stage.velocity_reference[:, self._vertices])[:, :, None]
        reference = reference.expand(-1, -1, self._contact.count, -1)
        start, here = state.q, x[:, :, None].expand_as(reference)
        if self._contact.moves:
            # Where an obstacle was at a point, it moves with the obstacle; so do the normals.
            inside = before.local(here)
            ways = (here, earlier.world(inside))
            weights = [weight for _, weight in stage.strain_weights] or [1.0]
            was = sum(weight * way for weight, way in zip(weights, ways, strict=False))
            reference = reference + now.world(inside) - was
            n = torch.einsum("boij,bokj,bpok->bpoi", now.turn, before.turn, n)
            self._check_motion(step.inputs, before, now)
            here = now.world(inside)
        if self._contact.moves or step.fixed_positions is not None:
            self._clearance.check_way(
                here.detach(), self._ends(x, step.fixed_positions), now, d.detach()
            )
        if self._contact.moves:
            start = self._clearance.pushed_out(state.q.detach(), now, d.detach())
        load = self._load(d, step.values)
        if self._has_factors:
            load = load * self._factor[:, None]
        if self._interpolates:
            length = n.norm(dim=-1, keepdim=True)
            n, load = n / length, load * length[..., 0]
        duration = stage.step if math.isfinite(stage.step) else self.site.time_step
        values: dict[str, torch.Tensor | None] = {
            "contact_load": load,
            "contact_normal": n,
            "contact_reference": reference,
            "contact_slip": x.new_full((state.batch, 1), self._contact.slip_speed * duration),
            "contact_start": start.detach(),
        }
        return values | dict(zip(POSE, (now.place, now.turn), strict=True))

    def _load(self, d: torch.Tensor, values: Values) -> torch.Tensor:
        """Returns the normal forces (B, P, O) at distances [N]."""
        pressure = barrier_pressure(d, self._contact.distance)
        return value_of(values, STIFFNESS.name)[:, None] * self._area[:, None] * pressure

    def forces(self, step: EnergyStep, x: torch.Tensor) -> ContactForces:
        """Returns the forces at the solution x (B, N, 3) of a step's implicit stage [m]."""
        values = self.begin_step(step)
        at, pose = x[:, self._vertices], self._pose(step.values, step.inputs, step.state.batch)
        d, n = self._shapes.distances(at, pose)
        normal = value_of(values, "contact_normal")
        way = at[:, :, None] - value_of(values, "contact_reference")
        u = way - (way * normal).sum(-1, keepdim=True) * normal
        slip = value_of(values, "contact_slip")[..., None]
        y, factor = friction_over_slide(u, slip)
        most = step.value(FRICTION.name)[:, None] * value_of(values, "contact_load")
        return ContactForces(
            self._contact.names,
            self._vertices,
            d,
            self._load(d, step.values)[..., None] * n,
            -(most * factor)[..., None] * u,
            y,
            (value_of(values, "contact_load") > 0.0) & (y < slip),
            at,
        )

    def _remembered(self, step: EnergyStep, now: Pose) -> tuple[Pose, Pose]:
        """Returns the poses at the start of a step and one step before."""
        if not self._contact.moves:
            return now, now
        poses = [step.state.memory.get(m.name) for m in self.memory]
        if poses[0] is None or poses[1] is None:
            rest = (
                now
                if math.isfinite(step.stage.step)
                else self._pose(step.values, {}, step.state.batch)
            )
            return rest, rest
        before = Pose(poses[0], poses[1], now.growth)
        return before, before if poses[2] is None or poses[3] is None else Pose(
            poses[2], poses[3], now.growth
        )

    @override
    def end_step(
        self, step: EnergyStep, x: torch.Tensor, q: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        if not self._contact.moves:
            return {}
        now = self._pose(step.values, step.inputs, step.state.batch)
        before, _ = self._remembered(step, now)
        poses = (now.place, now.turn, before.place, before.turn)
        return dict(zip((m.name for m in self.memory), poses, strict=True))

    def _ends(self, x: torch.Tensor, fixed_positions: torch.Tensor | None) -> torch.Tensor:
        """Returns the vertices of the surface (B, P, 3),
        the fixed ones where they are at the end of a step [m].
        """
        x = x.detach()
        if fixed_positions is None:
            return x
        whole = x.new_zeros(len(x), len(self.site.rest_positions), 3).index_copy(
            1, self._vertices, x
        )
        whole[:, self._fixed] = fixed_positions.detach()
        return whole[:, self._vertices]

    def _check_motion(self, inputs: Mapping[str, torch.Tensor], before: Pose, now: Pose) -> None:
        """Raises InputError where an obstacle that does not move has an input,
        or one turns too far in a step.
        """
        still = self._moving == 0.0
        for quantity in MOTION:
            value = inputs.get(quantity.name)
            if value is not None and bool((value[..., still] != 0.0).any()):
                raise InputError(
                    f"{quantity.name} is not zero for an obstacle without moves=True: set it there."
                )
        if bool((torch.einsum("boij,boij->bo", before.turn, now.turn) < 1.0).any()):
            raise InputError(
                "an obstacle turns by more than 90 degrees in a step: turn it less in a step."
            )

    def outside(self, q: torch.Tensor, state: State, values: Values) -> torch.Tensor:
        """Returns positions (B, N, 3) [m] out of the obstacles,
        at least by the gaps of a state, at most by half of D.

        Raises:
            InputError: the obstacles leave no place.
        """
        pose = self._pose(values, {}, state.batch)
        gaps, _ = self._shapes.distances(state.q[:, self._vertices], pose)
        return self._clearance.pushed_out(q, pose, gaps)
