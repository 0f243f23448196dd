"""Local rotations of a body at its vertices, forces that rotate with it,
and the frame of a moving base.

A force of constant direction on a rotating body can do net work, unlike an internal force:
compressive dead loads twist a slender body, as they buckle a column. Forces that rotate with the
body do not.
"""

import numpy as np
import torch

from ..fem.bodies import Body
from ..fem.integration_points import mean_gradients
from ..stepping.rotations import closest_rotation, rotations

# Largest displacement by a turn about a point inside, over the longest side of a body's box.
_TURNED = 2.0 * 3.0**0.5
# Weight of the identity in the rotation of a base, over the squared size of the body
_LEAST_TURN = 1e-9
_ITERATIONS = 8  # of the polar decomposition; enough for stretches from 0.1 to 10
_AT_ONCE = 100  # states processed together


class VertexFrames:
    """Rotations R of the mean deformation gradients F = R S of the cells around each vertex.

    Forces of a step are rotated with the extrapolated positions at its end: forces that lag by one
    step amplify oscillations. If the mean gradient is inverted, R is a reflection.

    Args:
        body: body with N vertices.
        time_step: h [s].
        like: a tensor with the device and dtype of the states.
    """

    def __init__(self, body: Body, time_step: float, like: torch.Tensor) -> None:
        self._ahead = time_step
        discretisation = body.discretisation
        points = discretisation.point_sets[0]
        volumes = np.asarray(points.shape_volume.sum(axis=1)).reshape(-1, points.points_per_cell)
        mean = (
            np.einsum("cq,cqki->cki", volumes, points.gradients)
            / volumes.sum(axis=1)[:, None, None]
        )
        nodes, operator = mean_gradients(points.nodes, mean, discretisation.lumped_volume)
        self._nodes = torch.as_tensor(nodes, device=like.device)
        self._operator = torch.as_tensor(operator).to(like)

    def rotations(self, q: torch.Tensor) -> torch.Tensor:
        """Returns rotations (S, N, 3, 3) at positions (S, N, 3) [m], by Newton's polar
        decomposition (Higham 1986).
        """
        matrix = torch.einsum(
            "snwi,nwj->snij", q[:, self._nodes.to(q.device)], self._operator.to(q)
        )
        for _ in range(_ITERATIONS):
            a, b, c = matrix.unbind(-1)
            cofactors = torch.stack(
                [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)],
                dim=-1,
            )
            determinant = (a * cofactors[..., 0]).sum(-1)
            matrix = 0.5 * (matrix + cofactors / determinant[..., None, None])
        return matrix

    def to_world(self, q: torch.Tensor, v: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Rotates forces (S, N, 3) from the rest shape to a body
        at q [m] with velocities v [m/s].
        """
        return torch.einsum("snij,snj->sni", self.rotations(q + self._ahead * v), force)

    def to_rest(self, q: torch.Tensor, v: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Rotates forces (S, N, 3) to the rest shape,
        the inverse of `to_world`, in blocks of states.
        """
        parts = zip(*(field.split(_AT_ONCE) for field in (q, v, force)), strict=True)
        turned = [
            torch.einsum("snji,snj->sni", self.rotations(x + self._ahead * w), f)
            for x, w, f in parts
        ]
        return torch.cat(turned)


@torch.no_grad()
def carried_rest(body: Body, fixed_positions: torch.Tensor) -> torch.Tensor:
    """Returns the rest shapes (B, N, 3) that bodies have where their bases are [m].

    The base of a body, or of each body of a scene, are its fixed vertices: its rest shape makes the
    rigid motion that is closest to theirs. Vertices on one line, which leave a turn about it open,
    turn as little as they can. A body without fixed vertices stays.

    Args:
        body: a body or a scene, with N vertices, of which D are fixed.
        fixed_positions: (B, D, 3) where they are [m].
    """
    places = fixed_positions.double()
    rest = torch.as_tensor(body.vertices).to(places)
    carried, before = rest.expand(len(places), -1, -1).clone(), 0
    for _, member, first in body.members:
        vertices = torch.as_tensor(member.fixed_vertices, device=rest.device)
        if not len(vertices):
            continue
        own = rest[first : first + member.n_vertices]
        base, now = own[vertices], places[:, before : before + len(vertices)]
        before += len(vertices)
        centre, middle = base.mean(0), now.mean(1, keepdim=True)
        least = _LEAST_TURN * (own.amax(0) - own.amin(0)).square().sum()
        turn = closest_rotation((now - middle).mT @ (base - centre) + least * torch.eye(3).to(rest))
        carried[:, first : first + member.n_vertices] = (own - centre) @ turn.mT + middle
    return carried.to(fixed_positions)


class RestOnBase:
    """The rest shape of a body where its base is, and displacements from it.

    Those of a body that nothing holds are beside its mean displacement.

    Args:
        body: a body or a scene.
        rest_positions: (N, 3) [m].
    """

    def __init__(self, body: Body, rest_positions: torch.Tensor) -> None:
        self._body, self._rest = body, rest_positions
        self._length = float(np.ptp(body.vertices, axis=0).max())

    def carried(self, batch: int, fixed_positions: torch.Tensor | None) -> torch.Tensor:
        """Returns rest shapes (B, N, 3) where the fixed vertices (1 or B, D, 3) are,
        by `carried_rest` [m].
        """
        at = (
            self._rest[None]
            if fixed_positions is None
            else carried_rest(self._body, fixed_positions.to(self._rest))
        )
        return at.expand(batch, -1, -1)

    def is_within(self, q: torch.Tensor, resting: torch.Tensor, lengths: float) -> torch.Tensor:
        """Whether the vertices of bodies (B,) are within some body lengths
        of rest shapes (1 or B, N, 3).
        """
        moved = q - resting
        if not len(self._body.fixed_vertices):
            moved = moved - moved.mean(1, keepdim=True)
        return moved.abs().flatten(1).amax(1) < lengths * self._length

    def is_near(
        self, q: torch.Tensor, fixed_positions: torch.Tensor | None, lengths: float
    ) -> torch.Tensor:
        """Whether bodies (B,) are within, however their bases have turned:
        quickly, and False for some that are.
        """
        if fixed_positions is None:
            return self.is_within(q, self._rest, lengths)
        middle = self._rest[torch.as_tensor(self._body.fixed_vertices, device=q.device)].mean(0)
        shift = fixed_positions.to(q).mean(-2, keepdim=True) - middle
        return self.is_within(q - shift, self._rest, lengths - _TURNED)


class BaseFrame:
    """States and forces in the frame of a moving base: x = R x_b + t at the times 0, h, ..., K h.

    Velocities are (x_b - x_b') / h, with the position x_b' of x - h v in the base frame one step
    earlier: a body that moves with its base is at rest. Forces of a step are rotated with the base
    at its end.

    Args:
        poses: (K + 1, B, 6) translations t [m] and rotation vectors of R; the first and last poses
            are extended.
        time_step: h [s].
        first: index of the pose at step zero.
    """

    def __init__(self, poses: torch.Tensor, time_step: float, first: int = 0) -> None:
        self._poses = poses
        self._step, self._first = time_step, first
        self._rotation = rotations(poses[..., 3:])

    def _at(self, step: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns R (B, 3, 3) and t (B, 1, 3) at a step."""
        at = min(max(self._first + step, 0), len(self._poses) - 1)
        return self._rotation[at], self._poses[at][:, None, :3]

    def enter(
        self, q: torch.Tensor, v: torch.Tensor, step: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Converts positions (B, N, 3) [m] and velocities [m/s]
        at the start of a step to the base frame.
        """
        (now, at), (before, was) = self._at(step), self._at(step - 1)
        inside = (q - at) @ now
        return inside, (inside - (q - self._step * v - was) @ before) / self._step

    def leave(
        self, q: torch.Tensor, v: torch.Tensor, step: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Inverse of `enter`."""
        (now, at), (before, was) = self._at(step), self._at(step - 1)
        outside = q @ now.mT + at
        return outside, (outside - (q - self._step * v) @ before.mT - was) / self._step

    def force_inside(self, force: torch.Tensor, step: int) -> torch.Tensor:
        """Converts forces (B, N, 3) of a step to the base frame."""
        return force @ self._at(step + 1)[0]

    def force_outside(self, force: torch.Tensor, step: int) -> torch.Tensor:
        """Inverse of `force_inside`."""
        return force @ self._at(step + 1)[0].mT


def base_movement(poses: torch.Tensor, time_step: float, gravity: torch.Tensor) -> torch.Tensor:
    """Returns network inputs (K, B, 15) for the motion of a base
    during each step, in the base frame.

    They are velocity [m/s] and angular velocity [rad/s] of the step and of the one before, whose
    difference is the acceleration, and the direction of gravity [-].

    Args:
        poses: (K + 1, B, 6) poses, as in `BaseFrame`.
        time_step: h [s].
        gravity: (3,) [m/s^2].
    """
    translation, rotation = poses[..., :3], rotations(poses[..., 3:])
    moved = ((translation[1:] - translation[:-1])[..., None, :] @ rotation[:-1]).squeeze(
        -2
    ) / time_step
    turned = rotation[:-1].mT @ rotation[1:]
    rate = torch.stack(
        [turned[..., i, j] - turned[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1
    ) / (2.0 * time_step)
    during = torch.cat([moved, rate], -1)
    before = torch.cat([torch.zeros_like(during[:1]), during[:-1]])
    down = gravity / gravity.norm().clamp_min(1e-12)
    return torch.cat([during, before, down @ rotation[1:]], -1)
