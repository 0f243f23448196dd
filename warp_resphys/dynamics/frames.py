"""How a body is turned around each of its vertices, and forces that turn with it.

A force that keeps its direction while the body turns under it does work that no material does: forces that press a
slender body together from both sides wring it, as dead loads buckle a column. Those that turn with the body do not.
"""

import numpy as np
import torch

from ..fem.body import Body
from ..fem.elements import mean_gradients

_ITERATIONS = 8  # of the polar decomposition: stretches from a tenth to ten times
_AT_ONCE = 100  # states


class VertexFrames:
    """The rotations R of the mean deformation gradients F = R S of the cells around each vertex.

    Forces of a step are turned as the body will be at its end, if it goes on as it does: those that turn a step later
    than the body feed its swings where they would have buckled it. Where the mean gradient is turned inside out, R is a
    reflection.

    Args:
        body: with N vertices.
        time_step: h [s].
        like: any tensor on the device and of the type of the states.
    """

    def __init__(self, body: Body, time_step: float, like: torch.Tensor) -> None:
        self._ahead = time_step
        found = body.discretisation
        points = found.point_sets[0]
        volumes = np.asarray(points.shape_volume.sum(axis=1)).reshape(-1, points.points_per_cell)
        mean = np.einsum("cq,cqki->cki", volumes, points.gradients) / volumes.sum(axis=1)[:, None, None]
        nodes, operator = mean_gradients(points.nodes, mean, found.lumped_volume)
        self._nodes = torch.as_tensor(nodes, device=like.device)
        self._operator = torch.as_tensor(operator).to(like)

    def rotations(self, q: torch.Tensor) -> torch.Tensor:
        """(S, N, 3, 3) of positions (S, N, 3) [m], by Newton's iteration for the polar decomposition (Higham 1986)."""
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
        """(S, N, 3) forces of the rest shape [N], turned with a body that is at q [m] with the velocities v [m/s]."""
        return torch.einsum("snij,snj->sni", self.rotations(q + self._ahead * v), force)

    def to_rest(self, q: torch.Tensor, v: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """(S, N, 3) forces as they would be in the rest shape [N]: the opposite of `to_world`, for any number S."""
        parts = zip(*(field.split(_AT_ONCE) for field in (q, v, force)), strict=True)
        turned = [torch.einsum("snji,snj->sni", self.rotations(x + self._ahead * w), f) for x, w, f in parts]
        return torch.cat(turned)
