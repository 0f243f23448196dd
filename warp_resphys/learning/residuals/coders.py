"""Affine maps between fields on vertices and standardised coordinates, from training samples."""

import torch
from torch import nn

from ...core.dynamics.modes import RestStiffness
from ...io.errors import InputError

# Modes and coordinates that vary less than this fraction of the largest are not amplified to unit
# deviation.
_DEVIATION_FLOOR = 3e-3
# Evenly spaced samples for modes: neighbours in time are nearly equal, and more samples take
# minutes.
_SAMPLES_FOR_MODES = 2_000


class Coder(nn.Module):
    """An affine map between a field on the vertices and standardised coordinates:
    c = (x - mean) basis / scale.

    Its constants are in double precision, as the states of simulations.

    Args:
        mean: (D,) flattened field at c = 0.
        basis: (D, M) columns; None for the coordinates themselves.
        scale: (M,) standard deviation of each coordinate.
        dual: (D, M) columns that decode fields, with dual^T basis = 1; None for an orthonormal
            basis, its own dual.
    """

    mean: torch.Tensor
    scale: torch.Tensor
    basis: torch.Tensor | None
    dual: torch.Tensor | None

    def __init__(
        self,
        mean: torch.Tensor,
        basis: torch.Tensor | None,
        scale: torch.Tensor,
        dual: torch.Tensor | None = None,
    ) -> None:
        super().__init__()
        for name, values in (("mean", mean), ("basis", basis), ("scale", scale), ("dual", dual)):
            self.register_buffer(name, None if values is None else values.double())

    @property
    def size(self) -> int:
        """Number of coordinates, M."""
        return len(self.scale)

    def encode(self, field: torch.Tensor) -> torch.Tensor:
        """Maps fields (S, N, 3) to coordinates (S, M)."""
        x = field.flatten(1) - self.mean
        return (x if self.basis is None else x @ self.basis) / self.scale

    def decode(self, coordinates: torch.Tensor) -> torch.Tensor:
        """Maps coordinates (S, M) to fields (S, N, 3)."""
        x = coordinates * self.scale
        if self.basis is not None:
            x = x @ (self.basis if self.dual is None else self.dual).mT
        return (x + self.mean).unflatten(1, (-1, 3))


def pod_coder(samples: torch.Tensor, modes: int) -> Coder:
    """Proper orthogonal decomposition about zero: the M modes
    with most of the energy of samples (S, N, 3).

    Raises:
        InputError: more modes than samples or coordinates, or samples that are all zero.
    """
    x = _thinned(samples).flatten(1).double()
    if not bool(x.any()):
        raise InputError(
            f"{modes} modes were asked for of a field that is zero in all {len(x)} samples, such "
            "as the velocities of poses: set that number of modes to 0."
        )
    if not 1 <= modes <= min(x.shape):
        raise InputError(
            f"{modes} modes were asked for, but {len(x)} samples give 1 to {min(x.shape)}."
        )
    _, _, directions = torch.linalg.svd(x, full_matrices=False)
    basis = directions[:modes].mT.contiguous()
    deviation = (x @ basis).square().mean(0).sqrt()
    return Coder(
        torch.zeros_like(x[0]),
        basis,
        deviation.clamp_min(_DEVIATION_FLOOR * float(deviation.max())),
    )


def _thinned(samples: torch.Tensor) -> torch.Tensor:
    """At most `_SAMPLES_FOR_MODES` of (S, ...) samples, evenly spaced."""
    return samples[:: -(-len(samples) // _SAMPLES_FOR_MODES)]


def displacement_coder(samples: torch.Tensor, stiffness: RestStiffness, modes: int) -> Coder:
    """Coder of forces in modes Psi of their static displacements: f = K Psi c and c = Psi^T K^-1 f.

    A slender body is moved most by small forces, while large ones cancel. In modes of the forces
    themselves, a small error of a large force moves the body further than the small forces do. In
    modes of K^-1 f, the error of a coordinate is the error of the displacement.

    Args:
        samples: (S, N, 3) forces [N].
        stiffness: K of the body at rest.
        modes: number of modes, M.

    Raises:
        InputError: more modes than samples or coordinates.
    """
    forces = _thinned(samples).flatten(1).double()
    displacements = torch.as_tensor(stiffness.displacements(forces.cpu().numpy().T).T.copy()).to(
        forces
    )
    coder = pod_coder(displacements.unflatten(1, (-1, 3)), modes)
    assert coder.basis is not None
    psi = coder.basis.cpu().numpy()
    basis, dual = (
        torch.as_tensor(part).to(forces)
        for part in (stiffness.displacements(psi), stiffness.forces(psi))
    )
    return Coder(torch.zeros_like(forces[0]), basis, coder.scale, dual)


def actuation_coder(samples: torch.Tensor) -> Coder:
    """Coder of (S, A) by the root mean square of each column; zero actuation stays zero."""
    size = samples.square().mean(0).sqrt()
    return Coder(torch.zeros_like(size), None, torch.where(size > 0.0, size, torch.ones_like(size)))


def nodal_coder(samples: torch.Tensor) -> Coder:
    """Coder that standardises every coordinate of (S, N, 3), as published.

    Constant coordinates are zero.
    """
    x = samples.flatten(1)
    deviation = x.std(0)
    return Coder(
        x.mean(0), None, torch.where(deviation > 0.0, deviation, torch.ones_like(deviation))
    )


def empty_coder(samples: torch.Tensor) -> Coder:
    """Coder without coordinates, for a field that is not an input of the network."""
    mean = samples.new_zeros(samples[0].numel())
    return Coder(mean, mean.new_zeros(len(mean), 0), mean.new_zeros(0))
