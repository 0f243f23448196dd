"""Internal forces of bodies, and what takes up their resultants:
they weigh nothing and move no body as a whole.

What a simulator lacks in material, walls and actuators acts within the body, so that its forces f_i
at the vertices x_i have no resultant. Forces that are estimated from a few markers have one, and
the clamp would carry it. A rigid motion with the twist t = (u, w) about a point c, with a length l,
moves the vertices by J_i t = u + w x (x_i - c) / l; the resultant of the forces is the wrench

    W = sum_i J_i^T f_i,

whose last three components are the moment about c, over l.

- Fixed vertices D return it. They exert g = J a with (sum_D J^T J) a = W beside their reaction r:
  of all forces with this resultant the least ones, as in a group of equal bolts. Two small clamps
  share them by the law of the lever. They change no motion, as fixed vertices do not move.
- Rigid motions N that nothing hinders, all six of a free body, keep their momentum under f - m J N
  b with (N^T sum m J^T J N) b = N^T W, for the masses m. Accelerations within the body stay as they
  are.
- Symmetry planes cut a body; what they can exert is balanced by its other half.

In derivatives, N is constant; it is so for free bodies, symmetry planes, and one or two fixed
vertices that stay.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F

from ...io.arrays import FloatArray
from ..stepping.state import Reaction
from .bodies import Body

_LEAST = 1e-6  # of the largest mass, as which the mass of a vertex counts at least
_RANK = 1e-9  # of the largest eigenvalue: smaller ones belong to motions that nothing hinders


@dataclass(frozen=True)
class _Supports:
    """Supports of one body of a simulator.

    Attributes:
        vertices: range of its vertices.
        fixed: (D,) its fixed vertices.
        rows: range of these among all fixed vertices of the simulator.
        length: l [m].
        twists: (6, K) basis of the rigid motions that no symmetry plane hinders.
        loose: number of these that the fixed vertices do not hinder either.
    """

    vertices: slice
    fixed: torch.Tensor
    rows: slice
    length: float
    twists: torch.Tensor
    loose: int

    @classmethod
    def of(cls, body: Body, first: int, start: int, like: torch.Tensor) -> "_Supports":
        """Returns the supports of a body, from its first vertex,
        and its first row among all fixed vertices.
        """
        fixed, planes = body.fixed_vertices, body.coordinates
        length = float(np.ptp(body.vertices, axis=0).max())
        centre = body.vertices[fixed].mean(0) if len(fixed) else body.vertices.mean(0)
        hindered = np.zeros((6, 6))
        for vertex, projection in zip(planes.sliding, planes.projections, strict=True):
            jacobian = _jacobian((body.vertices[vertex] - centre) / length)
            hindered += jacobian.T @ (np.eye(3) - projection) @ jacobian
        twists = _null_space(hindered)
        hindered = np.zeros((twists.shape[1], twists.shape[1]))
        for vertex in fixed:
            jacobian = _jacobian((body.vertices[vertex] - centre) / length) @ twists
            hindered += jacobian.T @ jacobian
        loose = _null_space(hindered).shape[1]
        return cls(
            slice(first, first + body.n_vertices),
            torch.as_tensor(fixed + first, device=like.device),
            slice(start, start + len(fixed)),
            length,
            torch.as_tensor(twists, device=like.device, dtype=like.dtype),
            loose,
        )

    def moves(self, q: torch.Tensor, centre: torch.Tensor) -> torch.Tensor:
        """Returns J (B, n, 3, K) of the basis of twists, at vertices q (B, n, 3) [m]."""
        arms = (q - centre) / self.length
        return self.twists[:3] + torch.linalg.cross(
            self.twists[3:].expand(*arms.shape, -1), arms[..., None], dim=-2
        )

    def wrench(self, force: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Returns W (B, K) of the forces of all vertices (B, N, 3) [N]
        by the basis of twists, at q (B, N, 3) [m].
        """
        acting, arms = force[:, self.vertices], (q[:, self.vertices] - self.centre(q)) / self.length
        moment = torch.linalg.cross(arms, acting).sum(1)
        return torch.cat([acting.sum(1), moment], 1) @ self.twists

    def centre(self, q: torch.Tensor) -> torch.Tensor:
        """Returns c (B, 1, 3) at positions (B, N, 3) of all vertices [m]."""
        around = q[:, self.fixed] if len(self.fixed) else q[:, self.vertices]
        return around.mean(1, keepdim=True)

    def free(self, stiffness: torch.Tensor) -> torch.Tensor:
        """Returns N (B or 1, K, L), coefficients of the motions
        that nothing hinders, from J^T J (B, K, K) of D.
        """
        if not len(self.fixed):
            return torch.eye(self.loose).to(stiffness)[None]
        return torch.linalg.eigh(stiffness.detach()).eigenvectors[..., : self.loose]

    def at_fixed(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns J (B, D, 3, K) of the fixed vertices at positions (B, N, 3) [m],
        and sum_D J^T J (B, K, K).
        """
        moves = self.moves(q[:, self.fixed], self.centre(q))
        return moves, _gram(moves, moves)


class InternalForces:
    """Resultants of internal forces on the bodies of a simulator,
    each taken up by what holds its own body.

    Args:
        body: a body, or a scene of several.
        rest_positions: (N, 3) [m], with the device and dtype of forces.
    """

    def __init__(self, body: Body, rest_positions: torch.Tensor) -> None:
        self._supports = [*_supports(body, rest_positions)]

    def follow_pose(self, force: torch.Tensor | None) -> bool:
        """Whether balanced forces depend on the pose:
        some (B, N, 3) act where nothing hinders a rigid motion.
        """
        return force is not None and any(
            one.loose and bool(force[:, one.vertices].any()) for one in self._supports
        )

    def balanced(self, force: torch.Tensor, q: torch.Tensor, mass: torch.Tensor) -> torch.Tensor:
        """Returns forces without resultants along the motions that nothing hinders, differentiable.

        Args:
            force: (B, N, 3) [N].
            q: (B, N, 3) positions [m].
            mass: (1 or B, N) [kg]; of a body whose vertices have none, such as a rigid one, all
                count alike.
        """
        parts, largest = [], mass.amax(1, keepdim=True)
        weight = (mass / torch.where(largest > 0.0, largest, 1.0)).clamp_min(_LEAST)
        for one in self._supports:
            acting = force[:, one.vertices]
            if one.loose:
                free = one.free(one.at_fixed(q)[1])
                moves = one.moves(q[:, one.vertices], one.centre(q)) @ free[:, None]
                inert = weight[:, one.vertices, None, None] * moves
                wrench = (one.wrench(force, q)[:, None] @ free)[:, 0]
                share = torch.linalg.solve(_gram(moves, inert), wrench)
                acting = acting - (inert @ share[:, None, :, None])[..., 0]
            parts.append(acting)
        return torch.cat(parts, 1)

    def taken_up(self, reaction: Reaction, force: torch.Tensor, q: torch.Tensor) -> Reaction:
        """Returns a reaction without the resultant of balanced internal forces, differentiable.

        Args:
            reaction: (B, D + R, 3) at the fixed vertices and those in symmetry planes [N].
            force: (B, N, 3) from `balanced` [N].
            q: (B, N, 3) positions [m].
        """
        returned = []
        for one in self._supports:
            if not len(one.fixed):
                continue
            at_fixed, stiffness = one.at_fixed(q)
            wrench = one.wrench(force, q)
            if one.loose:
                free = one.free(stiffness)
                stiffness = stiffness + free @ free.mT
                wrench = wrench - (free @ (free.mT @ wrench[..., None]))[..., 0]
            share = torch.linalg.solve(stiffness, wrench)
            returned.append((at_fixed @ share[:, None, :, None])[..., 0])
        if not returned:
            return reaction
        returns = torch.cat(returned, 1)
        sliding = reaction.forces.shape[1] - returns.shape[1]
        return replace(reaction, forces=reaction.forces + F.pad(returns, (0, 0, 0, sliding)))


def _supports(body: Body, like: torch.Tensor) -> Iterator[_Supports]:
    start = 0
    for _, member, first in body.members:
        yield _Supports.of(member, first, start, like)
        start += len(member.fixed_vertices)


def _jacobian(arm: Sequence[float]) -> FloatArray:
    """Returns J (3, 6) of a vertex at (x - c) / l."""
    x, y, z = arm
    return np.array([[1.0, 0, 0, 0, z, -y], [0, 1.0, 0, -z, 0, x], [0, 0, 1.0, y, -x, 0]])


def _null_space(matrix: FloatArray) -> FloatArray:
    """Returns a basis (K, L) of the null space of a symmetric matrix (K, K)."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray(vectors[:, values <= _RANK * max(float(values.max(initial=0.0)), 1.0)])


def _gram(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Returns the sums over vertices of a^T b, (B, K, L), for (B, n, 3, K) and (B, n, 3, L)."""
    return a.flatten(1, 2).mT @ b.flatten(1, 2)
