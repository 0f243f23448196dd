"""Kernels of contact with obstacles."""

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from typing_extensions import override

from ....kernels.contact import barriers as kernels
from ..launcher import Launcher, struct_of, warp_view
from ..term import Adjoint, PointSet, Term
from .contact_points import FRICTION, FRICTION_VALUES, GROWTH, POSE, STIFFNESS, ContactPoints
from .obstacle_poses import ObstacleSet
from .touching_bodies import Obstacle


class ContactTerm(Term):
    """Kernels of contact with obstacles."""

    _kernels = kernels

    def __init__(
        self,
        launcher: Launcher,
        sets: Sequence[PointSet],
        obstacles: Sequence[Obstacle],
        reach: float,
    ) -> None:
        (s,) = sets
        assert isinstance(s.source, ContactPoints)
        p, o = s.n_points, len(obstacles)
        names = (
            *POSE,
            GROWTH.name,
            STIFFNESS.name,
            FRICTION.name,
            "contact_slip",
            *FRICTION_VALUES,
            "contact_start",
        )
        shapes = (
            (o, 3),
            (o, 3, 3),
            (o,),
            (o,),
            (o,),
            (1,),
            (p, o),
            (p, o, 3),
            (p, o, 3),
            (s.n_vertices, 3),
        )
        super().__init__(launcher, sets, dict(zip(names, shapes, strict=True)))
        self._count, self._reach = o, reach
        self._shapes = ObstacleSet(tuple(obstacles), reach, launcher.device)
        self._area = torch.as_tensor(s.source.areas, device=launcher.device)
        self._moved = torch.as_tensor(s.source.nodes[:, 0], device=launcher.device)

    def _obstacles(self) -> Any:
        return self._shapes.at(*(self.values[name] for name in (*POSE, GROWTH.name)))

    @override
    def _arguments(self, s: PointSet, positions: Any) -> list[Any]:
        names = {"coefficient": FRICTION.name} | {
            n.removeprefix("contact_"): n for n in ("contact_slip", *FRICTION_VALUES)
        }
        friction = struct_of(
            kernels.Friction, **{field: self.values[name] for field, name in names.items()}
        )
        return [
            s.points,
            warp_view(self._area, wp.float64),
            self._obstacles(),
            self.view(STIFFNESS.name),
            friction,
            positions,
        ]

    @override
    def feasible(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.values["contact_start"], self._moved

    @override
    def bounds(self, origin: Any, positions: Any, share: Any) -> list[Any]:
        batch, (s,) = self.launcher, self.sets
        inputs = [warp_view(batch.active, wp.int32), s.points, self._obstacles(), origin, positions]
        return [
            batch.record(kernels.bound, (batch.batch, s.n_points, self._count), inputs, [share])
        ]

    @override
    def curvature(self) -> torch.Tensor:
        return self.values[STIFFNESS.name].sum(1, keepdim=True) / self._reach * self._area

    @override
    def adjoint(self, positions: torch.Tensor, direction: torch.Tensor) -> Adjoint:
        batch = self.launcher
        (s,) = self.sets
        size = (self.n_points, self._count)
        names = (
            "place",
            "turn",
            "growth",
            "stiffness",
            "coefficient",
            "load",
            "normal",
            "reference",
        )
        shapes = {"turn": (3, 3), **dict.fromkeys(("place", "normal", "reference"), (3,))}
        out = {name: batch.zeros(*size, *shapes.get(name, ())) for name in names}
        inputs = [
            *self._arguments(s, warp_view(positions, wp.vec3d)),
            warp_view(direction, wp.vec3d),
        ]
        slopes = struct_of(kernels.Slopes, **out)
        command = batch.record(kernels.adjoint, (batch.batch, *size), inputs, [slopes])

        def differentiate() -> dict[str, torch.Tensor]:
            batch.launch(command)
            shared = zip((*POSE, GROWTH.name, STIFFNESS.name, FRICTION.name), names, strict=False)
            sums = {value: out[name].sum(1) for value, name in shared}
            return sums | {
                name: out[name.removeprefix("contact_")].clone() for name in FRICTION_VALUES
            }

        return differentiate
