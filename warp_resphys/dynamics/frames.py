"""Rotation of a body around every vertex, forces that turn with it, and the frame of a moving base.

Forces of fixed direction on a turning body can do work that no material does: forces that press a slender body from
both sides twist it, as dead loads buckle a column. Forces that turn with the body do not.
"""

import numpy as np
import torch

from ..fem.body import Body
from ..fem.elements import mean_gradients

_ITERATIONS = 8  # of the polar decomposition, enough for stretches from 0.1 to 10
_AT_ONCE = 100  # states in a batch of `to_rest`


class VertexFrames:
    """The rotations R of the mean deformation gradients F = R S of the cells around each vertex.

    The forces of a step turn with the predicted positions at its end, q + h v: forces that lag the body by a step feed
    energy into its oscillation. Where the mean gradient is inverted, R is a reflection.

    Args:
        body: with N vertices.
        time_step: h [s].
        like: any tensor on the device and of the type of the states.
    """

    def __init__(self, body: Body, time_step: float, like: torch.Tensor) -> None:
        self._ahead = time_step
        discretisation = body.discretisation
        points = discretisation.point_sets[0]
        volumes = np.asarray(points.shape_volume.sum(axis=1)).reshape(-1, points.points_per_cell)
        mean = np.einsum("cq,cqki->cki", volumes, points.gradients) / volumes.sum(axis=1)[:, None, None]
        nodes, operator = mean_gradients(points.nodes, mean, discretisation.lumped_volume)
        self._nodes = torch.as_tensor(nodes, device=like.device)
        self._operator = torch.as_tensor(operator).to(like)

    def rotations(self, q: torch.Tensor) -> torch.Tensor:
        """Rotations (S, N, 3, 3) at positions (S, N, 3) [m], by Newton's polar decomposition (Higham 1986)."""
        matrix = torch.einsum("snwi,nwj->snij", q[:, self._nodes.to(q.device)], self._operator.to(q))
        for _ in range(_ITERATIONS):
            a, b, c = matrix.unbind(-1)
            cofactors = torch.stack(
                [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-1
            )
            determinant = (a * cofactors[..., 0]).sum(-1)
            matrix = 0.5 * (matrix + cofactors / determinant[..., None, None])
        return matrix

    def to_world(self, q: torch.Tensor, v: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Turns forces (S, N, 3) of the rest shape [N] with a body at positions q [m] with velocities v [m/s]."""
        return torch.einsum("snij,snj->sni", self.rotations(q + self._ahead * v), force)

    def to_rest(self, q: torch.Tensor, v: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Turns forces (S, N, 3) back to the rest shape [N]: the inverse of `to_world`, for any number S."""
        parts = zip(*(field.split(_AT_ONCE) for field in (q, v, force)), strict=True)
        turned = [torch.einsum("snji,snj->sni", self.rotations(x + self._ahead * w), f) for x, w, f in parts]
        return torch.cat(turned)


class BaseFrame:
    """States and forces in the frame of the base that a body is fixed to: x = R x_b + t at the steps 0, h, ..., K h.

    Velocities are (x_b - x_b') / h, with x_b' the position x - h v in the base's frame one step earlier: a body that
    moves with its base is at rest. A force during a step turns with the base at the step's end.

    Args:
        poses: (K + 1, B, 6) translations t [m] and rotation vectors of R; the last pose holds after the
            end, the first before time zero.
        time_step: h [s].
        first: index of the pose at step zero.
    """

    def __init__(self, poses: torch.Tensor, time_step: float, first: int = 0) -> None:
        self._poses, self._step, self._first = poses, time_step, first
        self._rotation = rotations(poses[..., 3:])

    def during(self, environments: torch.Tensor, first: torch.Tensor, steps: int) -> "BaseFrame":
        """Returns the base frame of windows of some environments, whose first steps count as step zero.

        Args:
            environments: (W,) indices.
            first: (W,) first step of each window.
            steps: length of the windows.
        """
        at = (first + torch.arange(-1, steps + 1)[:, None]).clamp(0, len(self._poses) - 1)
        poses = self._poses[at.to(self._poses.device), environments.to(self._poses.device)]
        return BaseFrame(poses, self._step, first=1)

    def _at(self, step: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns R (B, 3, 3) and t (B, 1, 3) before a step."""
        at = min(max(self._first + step, 0), len(self._poses) - 1)
        return self._rotation[at], self._poses[at][:, None, :3]

    def enter(self, q: torch.Tensor, v: torch.Tensor, step: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns positions (B, N, 3) [m] and velocities [m/s] in the frame of the base, before a step."""
        (now, at), (before, was) = self._at(step), self._at(step - 1)
        inside = (q - at) @ now
        return inside, (inside - (q - self._step * v - was) @ before) / self._step

    def leave(self, q: torch.Tensor, v: torch.Tensor, step: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns positions and velocities in the world: the inverse of `enter`."""
        (now, at), (before, was) = self._at(step), self._at(step - 1)
        outside = q @ now.mT + at
        return outside, (outside - (q - self._step * v) @ before.mT - was) / self._step

    def force_inside(self, force: torch.Tensor, step: int) -> torch.Tensor:
        """Returns forces (B, N, 3) during a step in the frame of the base [N]."""
        return force @ self._at(step + 1)[0]

    def force_outside(self, force: torch.Tensor, step: int) -> torch.Tensor:
        """Returns forces in the world: the inverse of `force_inside`."""
        return force @ self._at(step + 1)[0].mT


def rotations(vectors: torch.Tensor) -> torch.Tensor:
    """Returns rotations (..., 3, 3) of rotation vectors (..., 3) [rad], differentiable at zero too."""
    zero, (x, y, z) = torch.zeros_like(vectors[..., 0]), vectors.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(skew)


def base_movement(poses: torch.Tensor, time_step: float, gravity: torch.Tensor) -> torch.Tensor:
    """Returns the motion of a base (K, B, 15) as an input of networks, in the frame of the base.

    Velocity [m/s] and angular velocity [rad/s] during the step and during the one before, whose difference accelerates
    the body, and the direction of gravity [-].

    Args:
        poses: (K + 1, B, 6) as of `BaseFrame`.
        time_step: h [s].
        gravity: (3,) [m/s^2].
    """
    translation, rotation = poses[..., :3], rotations(poses[..., 3:])
    moved = ((translation[1:] - translation[:-1])[..., None, :] @ rotation[:-1]).squeeze(-2) / time_step
    turned = rotation[:-1].mT @ rotation[1:]
    rate = torch.stack([turned[..., i, j] - turned[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1) / (
        2.0 * time_step
    )
    during = torch.cat([moved, rate], -1)
    before = torch.cat([torch.zeros_like(during[:1]), during[:-1]])
    down = gravity / gravity.norm().clamp_min(1e-12)
    return torch.cat([during, before, down @ rotation[1:]], -1)
