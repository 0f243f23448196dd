"""Checks that a body and obstacles do not pass through one another,
and pushes out of obstacles that have moved.
"""

import logging
from collections.abc import Mapping, Sequence

import torch

from ....io.errors import InputError
from .obstacle_poses import ObstacleSet, Pose
from .obstacles import DistanceGrid
from .touching_bodies import Obstacle

log = logging.getLogger(__name__)

_PUSHES = 50  # of vertices out of obstacles that have moved
_ADVANCES = 100  # along the way of an obstacle in a step
_DEEP = 0.3  # share of D within which a start is warned of


class Clearance:
    """Gaps between the surface of a body and obstacles.

    Args:
        obstacles: the obstacles by name.
        distance: D [m].
        shapes: the obstacles on the device.
        vertices: (P,) vertices of the surface.
        free: (P,) zero at fixed ones, one at others.
        rigid: points of each rigid part on the surface, and its vertices within.
    """

    def __init__(
        self,
        obstacles: Mapping[str, Obstacle],
        distance: float,
        shapes: ObstacleSet,
        vertices: torch.Tensor,
        free: torch.Tensor,
        rigid: Sequence[tuple[torch.Tensor, torch.Tensor]],
    ) -> None:
        self._obstacles, self._shapes = obstacles, shapes
        self._distance = distance
        self._vertices, self._free = vertices, free
        self._rigid = rigid

    def check_way(
        self, carried: torch.Tensor, ends: torch.Tensor, pose: Pose, gaps: torch.Tensor
    ) -> None:
        """Raises InputError where an obstacle passes over a vertex,
        or a fixed vertex through an obstacle.

        A way is followed to its first place on an obstacle: by the tangential planes of a convex
        one, which are never beyond it, and by the largest slope of the distance from another.

        Args:
            carried: (B, P, O, 3) vertices as if they had moved with the obstacles [m].
            ends: (B, P, 3) where they are before the solve, fixed vertices at the end of the step
                [m].
            pose: poses after the motion.
            gaps: (B, P, O) distances before it [m].
        """
        ways = ends[:, :, None] - carried
        for k in (ways.norm(dim=-1) > gaps).any(1).any(0).nonzero().ravel().tolist():
            obstacle, way = tuple(self._obstacles.values())[k], ways[:, :, k]
            end, side = (value[:, :, k] for value in self._shapes.distances(ends, pose))
            share = torch.zeros_like(end)
            most = torch.full_like(end, obstacle.size[1]) * way.norm(dim=-1)
            for _ in range(_ADVANCES):
                d, n = (
                    value[:, :, k]
                    for value in self._shapes.distances(
                        carried[:, :, k] + share[..., None] * way, pose
                    )
                )
                slope = most if isinstance(obstacle, DistanceGrid) else -(n * way).sum(-1)
                further = torch.where(
                    slope > 0.0, d / slope.clamp_min(torch.finfo(d.dtype).tiny), 2.0
                )
                share = (share + further.clamp_min(0.0)).clamp_max(2.0)
                if bool(((share >= 1.0) | (further < 1e-6)).all()):
                    break
            passes = (share < 1.0) & ((end > 0.0) | ((n * side).sum(-1) < 0.0))
            if bool(passes.any()):
                vertex = int(self._vertices[passes.any(0).nonzero()[0]])
                name = list(self._obstacles)[k]
                raise InputError(
                    f"vertex {vertex} of the body and the obstacle {name!r} pass through one "
                    "another in a step: move the obstacle, "
                    "or the fixed vertices, less in a step."
                )

    def pushed_out(self, q: torch.Tensor, pose: Pose, gaps: torch.Tensor) -> torch.Tensor:
        """Returns positions (B, N, 3) as far from obstacles
        that have moved as before, at most half of D.

        Args:
            q: (B, N, 3) positions before the motion [m].
            pose: poses after it.
            gaps: (B, P, O) distances before it [m].
        """
        need, free = gaps.clamp_max(0.5 * self._distance), self._free
        for _ in range(_PUSHES):
            d, n = self._shapes.distances(q[:, self._vertices], pose)
            # Not to the last digit, which float32 does not have; nor where another environment
            # needs another push.
            lack, worst = (torch.where(d < 0.999 * need, need - d, 0.0) * free[:, None]).max(-1)
            if not bool(lack.any()):
                break
            normal = n.gather(2, worst[..., None, None].expand(-1, -1, 1, 3))[:, :, 0]
            ways, inside = lack[..., None] * normal, list[tuple[torch.Tensor, torch.Tensor]]()
            for surface, within in self._rigid:  # A rigid part moves as its vertex that lacks most.
                most = lack[:, surface].argmax(1)
                way = ways[torch.arange(len(q), device=q.device), surface[most], None]
                ways[:, surface] = way
                inside.append((within, way.expand(-1, len(within), -1)))
            q = q.index_add(1, self._vertices, ways)
            for within, way in inside:
                q = q.index_add(1, within, way)
        self.check(q, pose, "after an obstacle has moved")
        return q

    def check_start(self, rest: torch.Tensor, pose: Pose) -> None:
        """Raises InputError for a distance that fits no contact,
        and warns of a start that throws the body away.
        """
        surface = rest[self._vertices]
        reach = self._distance
        thickness = float((surface.amax(0) - surface.amin(0)).min())
        if reach > thickness:
            raise InputError(
                f"contact.distance is {1e3 * reach:g} mm and the body {1e3 * thickness:g} mm "
                "thick: take a hundredth to a tenth of that."
            )
        d, _ = self._shapes.distances(surface[None], pose)
        self.check(rest[None], pose, "at rest", d)
        least = d.amin((0, 1))
        if bool((least < _DEEP * reach).any()):
            nearest = list(self._obstacles)[int(least.argmin())]
            log.warning(
                "The body starts %.2g mm from %s, deep in its barrier, which throws it away: "
                "start it at contact.distance (%g mm) or further, or hold it there.",
                1e3 * float(least.min()),
                nearest,
                1e3 * reach,
            )

    def check(self, q: torch.Tensor, pose: Pose, when: str, d: torch.Tensor | None = None) -> None:
        """Raises InputError where a vertex is within an obstacle."""
        if d is None:
            d, _ = self._shapes.distances(q[:, self._vertices], pose)
        deepest = d.detach().amin((0, 1))
        if bool((deepest <= 0.0).any()):
            worst = int(deepest.argmin())
            vertex = int(self._vertices[d.detach()[..., worst].amin(0).argmin()])
            raise InputError(
                f"the body is within the obstacle {list(self._obstacles)[worst]!r} {when}: "
                f"vertex {vertex} by {-1e3 * float(deepest[worst]):.3g} mm; move one of them, or "
                "move obstacles less in a step."
            )
