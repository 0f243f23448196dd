"""Rotations by rotation vectors, and twisted bodies."""

import torch


def rotations(vectors: torch.Tensor) -> torch.Tensor:
    """Returns rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad],
    differentiable also at zero.
    """
    zero, (x, y, z) = torch.zeros_like(vectors[..., 0]), vectors.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(skew)


def twisted(positions: torch.Tensor, angles: torch.Tensor, axis: int = 0) -> torch.Tensor:
    """Returns positions (B, N, 3) of a body (N, 3) [m] twisted about the centre line of its
    bounding box along an axis.

    Cross-sections rotate by an angle that grows linearly from zero at the lower end to (B,) [rad]
    at the upper end.
    """
    low, high = positions.amin(0), positions.amax(0)
    centred = positions - 0.5 * (low + high)
    phi = angles[:, None] * (positions[:, axis] - low[axis]) / (high[axis] - low[axis])  # (B, N)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turned = positions.expand(len(angles), -1, -1).clone()
    turned[..., i] += (
        torch.cos(phi) * centred[:, i] - torch.sin(phi) * centred[:, j] - centred[:, i]
    )
    turned[..., j] += (
        torch.sin(phi) * centred[:, i] + torch.cos(phi) * centred[:, j] - centred[:, j]
    )
    return turned


def closest_rotation(matrix: torch.Tensor) -> torch.Tensor:
    r"""Rotations R (B, 3, 3) that maximise tr(R^T A), differentiable once.

    Identity where A is not finite.

    Where R is optimal, S = R^T A is symmetric. When A changes by dA, R becomes R (1 + [w]) with

        (tr(S) 1 - S) w = axial(R^T dA - dA^T R),

    as [w] S + S [w] = [(tr(S) 1 - S) w]. The matrix on the left has the eigenvalues s2 + s3,
    s1 + s3 and s1 + s2, s3 with the sign of det A: it is regular for all points that are not on a
    line, also for plane and symmetric ones, where the singular vectors have no derivative. A step
    of Newton's method from the optimum is zero and has that derivative; so one step is made, with
    all other values constant.
    """
    identity = torch.eye(3, device=matrix.device, dtype=matrix.dtype)
    with torch.no_grad():
        finite = matrix.isfinite().all(-1).all(-1)[:, None, None]
        u, _, vt = torch.linalg.svd(torch.where(finite, matrix, identity))
        sign = torch.linalg.det(u @ vt).sign()
        rotation = (
            u
            @ torch.diag_embed(
                torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], -1)
            )
            @ vt
        )
        shape = rotation.mT @ torch.where(finite, matrix, identity)
        stiffness = (
            torch.diagonal(shape, dim1=-2, dim2=-1).sum(-1)[:, None, None] * identity - shape
        )
        inverse = torch.linalg.inv(0.5 * (stiffness + stiffness.mT))
    turned = rotation.mT @ matrix
    skew = turned - turned.mT
    axial = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
    spin = (inverse @ axial[:, :, None])[:, :, 0]
    return rotation + torch.linalg.cross(rotation, spin[:, None].expand_as(rotation), dim=-1)
