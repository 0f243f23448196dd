"""Networks that predict the residual force from the state.

A model is a coder around a multi-layer perceptron: the coder turns (q, v) into standardised inputs and standardised
outputs into forces. Its constants come from the training split and are saved with the weights.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from ..errors import InputError

NETWORK_KINDS = ("reduced", "nodal")
# Modes and coordinates that vary less than this fraction of the largest are not amplified to unit deviation.
_DEVIATION_FLOOR = 3e-3


class SkipMLP(nn.Module):
    """Blocks of perceptrons with skip connections between blocks.

    Every linear layer but a block's last is followed by LayerNorm and ELU. Blocks after the first add to their input.

    Args:
        n_in: inputs.
        n_out: outputs, also the width between blocks.
        blocks: number of blocks.
        layers: hidden layers a block.
        width: of the hidden layers.
    """

    def __init__(self, n_in: int, n_out: int, blocks: int, layers: int, width: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(_perceptron(n_in if i == 0 else n_out, n_out, layers, width) for i in range(blocks))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(S, n_in) to (S, n_out)."""
        first, *others = self.blocks
        x = first(x)
        for block in others:
            x = x + block(x)
        return x


def _perceptron(n_in: int, n_out: int, layers: int, width: int) -> nn.Sequential:
    modules: list[nn.Module] = []
    for i in range(layers):
        modules += [nn.Linear(n_in if i == 0 else width, width), nn.LayerNorm(width), nn.ELU()]
    return nn.Sequential(*modules, nn.Linear(width, n_out))


class Coder(nn.Module):
    """An affine map between a field on the vertices and standardised coordinates: c = (x - mean) basis / scale.

    Args:
        mean: (D,) flattened field of the origin.
        basis: (D, M) orthonormal columns; None for the coordinates themselves.
        scale: (M,) deviation of each coordinate.
    """

    mean: torch.Tensor
    scale: torch.Tensor
    basis: torch.Tensor | None

    def __init__(self, mean: torch.Tensor, basis: torch.Tensor | None, scale: torch.Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("basis", basis)
        self.register_buffer("scale", scale)

    @property
    def size(self) -> int:
        """M."""
        return len(self.scale)

    def encode(self, field: torch.Tensor) -> torch.Tensor:
        """(S, N, 3) to (S, M)."""
        x = field.flatten(1) - self.mean
        return (x if self.basis is None else x @ self.basis) / self.scale

    def decode(self, coordinates: torch.Tensor) -> torch.Tensor:
        """(S, M) to (S, N, 3)."""
        x = coordinates * self.scale
        x = x if self.basis is None else x @ self.basis.mT
        return (x + self.mean).unflatten(1, (-1, 3))


def pod_coder(samples: torch.Tensor, modes: int) -> Coder:
    """Proper orthogonal decomposition about zero: the modes that hold most of the samples' energy.

    Args:
        samples: (S, N, 3), with S at least ``modes``.
        modes: M.

    Raises:
        InputError: more modes than samples or coordinates.
    """
    x = samples.flatten(1)
    if not 1 <= modes <= min(x.shape):
        raise InputError(f"{modes} modes were asked for, but {len(x)} samples give 1 to {min(x.shape)}.")
    _, _, directions = torch.linalg.svd(x, full_matrices=False)
    basis = directions[:modes].mT.contiguous()
    deviation = (x @ basis).square().mean(0).sqrt()
    return Coder(torch.zeros_like(x[0]), basis, deviation.clamp_min(_DEVIATION_FLOOR * float(deviation.max())))


def nodal_coder(samples: torch.Tensor) -> Coder:
    """Standardisation of every coordinate of (S, N, 3), as published; constant coordinates stay zero."""
    x = samples.flatten(1)
    deviation = x.std(0)
    return Coder(x.mean(0), None, torch.where(deviation > 0.0, deviation, torch.ones_like(deviation)))


class ResidualForce(nn.Module):
    """Residual force of a state.

    Args:
        rest: (N, 3) rest positions [m].
        position, velocity, force: coders.
        architecture: ``blocks``, ``layers`` and ``width``.
    """

    rest: torch.Tensor
    linear: torch.Tensor
    remainder: torch.Tensor

    def __init__(
        self,
        rest: torch.Tensor,
        position: Coder,
        velocity: Coder,
        force: Coder,
        architecture: Mapping[str, int],
    ) -> None:
        super().__init__()
        self.register_buffer("rest", rest)
        self.position, self.velocity, self.force = position, velocity, force
        self.architecture = {key: int(architecture[key]) for key in ("blocks", "layers", "width")}
        n_in = position.size + velocity.size
        self.network = SkipMLP(n_in, force.size, **self.architecture).to(rest.device)
        self.register_buffer("linear", torch.zeros(n_in, force.size, device=rest.device))
        self.register_buffer("remainder", torch.ones((), device=rest.device))

    def fit_linear(self, inputs: torch.Tensor, outputs: torch.Tensor, noise: float) -> None:
        """Sets the linear part by least squares, as if the inputs had noise of that deviation (ridge regression).

        Args:
            inputs: (S, n_in) standardised.
            outputs: (S, n_out) standardised.
            noise: standard deviation.
        """
        x, y = inputs.double(), outputs.double()
        gram = x.mT @ x + len(x) * noise**2 * torch.eye(x.shape[1], device=x.device, dtype=x.dtype)
        linear = torch.linalg.solve(gram, x.mT @ y)
        self.linear.copy_(linear)
        self.remainder.copy_((y - x @ linear).square().mean().sqrt())

    def standardised(self, inputs: torch.Tensor) -> torch.Tensor:
        """(S, n_out) standardised force from (S, n_in) standardised inputs: linear part and network."""
        return inputs @ self.linear + self.remainder * self.network(inputs)

    def encode(self, q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        """(S, M) standardised inputs in float32 from (S, N, 3) positions [m] and velocities [m/s]."""
        return torch.cat([self.position.encode(q - self.rest), self.velocity.encode(v)], dim=1).float()

    def forward(self, q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        """(S, N, 3) residual force [N]."""
        return self.force.decode(self.standardised(self.encode(q, v)).to(q.dtype))

    def description(self) -> dict[str, Any]:
        """What `restore` needs beside the tensors."""
        return {"architecture": self.architecture, "reduced": self.position.basis is not None}


def build_model(
    config: Mapping[str, Any],
    rest: torch.Tensor,
    q: torch.Tensor,
    v: torch.Tensor,
    force: torch.Tensor,
) -> ResidualForce:
    """A network with coders from training samples.

    Args:
        config: the group ``network``.
        rest: (N, 3) rest positions [m].
        q: (S, N, 3) positions [m].
        v: (S, N, 3) velocities [m/s].
        force: (S, N, 3) residual forces [N].

    Raises:
        InputError: an unknown kind, or sizes that do not fit the samples.
    """
    check_network(config)
    if config["kind"] == "reduced":
        coders = (
            pod_coder(q - rest, config["position_modes"]),
            pod_coder(v, config["velocity_modes"]),
            pod_coder(force, config["force_modes"]),
        )
    else:
        coders = (nodal_coder(q - rest), nodal_coder(v), nodal_coder(force))
    return ResidualForce(rest, *coders, config)


def check_network(config: Mapping[str, Any]) -> None:
    """Checks the ranges of the group ``network``.

    Raises:
        InputError: an unknown kind, or a size that is not positive.
    """
    if config["kind"] not in NETWORK_KINDS:
        raise InputError(f"network.kind is {config['kind']!r}: choose one of {', '.join(NETWORK_KINDS)}.")
    modes = ("position_modes", "velocity_modes", "force_modes") if config["kind"] == "reduced" else ()
    for key in ("blocks", "layers", "width", *modes):
        if not config[key] > 0:
            raise InputError(f"network.{key} is {config[key]}: it must be positive.")


def restore(tensors: Mapping[str, torch.Tensor], description: Mapping[str, Any]) -> ResidualForce:
    """A model from its ``state_dict`` and `ResidualForce.description`."""

    def coder(name: str) -> Coder:
        basis = tensors[f"{name}.basis"] if description["reduced"] else None
        return Coder(tensors[f"{name}.mean"], basis, tensors[f"{name}.scale"])

    coders = (coder("position"), coder("velocity"), coder("force"))
    model = ResidualForce(tensors["rest"], *coders, description["architecture"])
    model.load_state_dict(tensors)
    return model.eval()
