"""Networks that predict a residual force, or the next state, from the state.

A model is a multi-layer perceptron between coders (`coders`): these turn (q, v) into standardised
inputs, and standardised outputs into forces. Their constants come from the training split and are
saved with the weights.
"""

import copy
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import torch
from torch import nn
from typing_extensions import override

from ...core.dynamics.modes import RestStiffness
from ...core.stepping.inputs import Acts
from ...io.classes import ClassSettings
from ...io.errors import InputError
from ...settings.learning import NetworkSettings
from .coders import Coder, actuation_coder, displacement_coder, empty_coder, nodal_coder, pod_coder

_ARCHITECTURE = ("blocks", "layers", "width", "activation")
ACTIVATIONS = ("normalised_elu", "silu")


class SkipMLP(nn.Module):
    """Blocks of perceptrons with skip connections between blocks.

    Every linear layer except a block's last is followed by LayerNorm and ELU, as published, or by
    SiLU alone, which gives a smoother function. Blocks after the first add to their input.

    Args:
        n_in: inputs.
        n_out: outputs, also the width between blocks.
        blocks: number of blocks.
        layers: hidden layers a block; 0 makes the map affine.
        width: of the hidden layers.
        activation: one of `ACTIVATIONS`.
    """

    def __init__(
        self, n_in: int, n_out: int, blocks: int, layers: int, width: int, activation: str
    ) -> None:
        super().__init__()
        sizes = [n_in if i == 0 else n_out for i in range(blocks)]
        self.blocks = nn.ModuleList(
            _perceptron(size, n_out, layers, width, activation) for size in sizes
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Maps (S, n_in) to (S, n_out)."""
        first, *others = self.blocks
        x = first(x)
        for block in others:
            x = x + block(x)
        return x


def _perceptron(n_in: int, n_out: int, layers: int, width: int, activation: str) -> nn.Sequential:
    modules: list[nn.Module] = []
    for i in range(layers):
        modules.append(nn.Linear(n_in if i == 0 else width, width))
        modules += [nn.SiLU()] if activation == "silu" else [nn.LayerNorm(width), nn.ELU()]
    return nn.Sequential(*modules, nn.Linear(width if layers else n_in, n_out))


def core_factory(core: ClassSettings) -> Callable[[int, int], nn.Module]:
    """Returns the map from numbers of inputs and outputs to a network of another package.

    Raises:
        InputError: see `ClassSettings.factory`.
    """
    return core.factory(nn.Module, "network.core", 2)


class OwnNetwork(nn.Module):
    """The network of another package, with a factor on each output.

    Args:
        core: its class with arguments; the first two are the numbers of inputs and outputs.
        n_in: inputs.
        n_out: outputs.

    Raises:
        InputError: it cannot be built, or maps to another shape.
    """

    def __init__(self, core: ClassSettings, n_in: int, n_out: int) -> None:
        super().__init__()
        self.core: nn.Module = core_factory(core)(n_in, n_out)
        self.gain = nn.Parameter(torch.ones(n_out))
        with torch.no_grad():
            shape = tuple(self.core.eval()(torch.zeros(2, n_in)).shape)
        self.core.train()
        if shape != (2, n_out):
            raise InputError(
                f"network.core: {core.target} maps (2, {n_in}) to {shape}: "
                f"it must map to (2, {n_out})."
            )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Maps (S, n_in) to (S, n_out)."""
        mapped: torch.Tensor = self.gain * self.core(x)
        return mapped


class StateMap(nn.Module):
    """Predicts fields from a state, in standardised coordinates:
    a linear part plus a network for the remainder.

    Attributes:
        fields: names of the predicted fields, in order.
        acts: whether a force acts within the body or on it (`Inputs.plus`).

    Args:
        rest: (N, 3) rest positions [m].
        position: coder of displacements from rest.
        velocity: coder of velocities.
        outputs: coder of each predicted field.
        architecture: number and width of the layers and their activation, or the class of another
            package.
        actuation: coder of further inputs, such as weights or pressures; None without any.
    """

    fields: tuple[str, ...]
    rest: torch.Tensor
    linear: torch.Tensor
    remainder: torch.Tensor

    def __init__(
        self,
        rest: torch.Tensor,
        position: Coder,
        velocity: Coder,
        outputs: Mapping[str, Coder],
        architecture: NetworkSettings,
        actuation: Coder | None = None,
    ) -> None:
        super().__init__()
        self.register_buffer("rest", rest)
        self.position = position
        self.velocity = velocity
        self.actuation = actuation
        self.outputs = nn.ModuleDict(outputs)
        self.acts: Acts = architecture.acts
        keys = (*_ARCHITECTURE, *(("core",) if architecture.core else ()))
        self.architecture = {
            key: value for key, value in architecture.plain().items() if key in keys
        }
        self._sizes = [coder.size for coder in outputs.values()]
        n_in = position.size + velocity.size + (0 if actuation is None else actuation.size)
        n_out = sum(self._sizes)
        network: SkipMLP | OwnNetwork
        if architecture.core is None:
            network = SkipMLP(n_in, n_out, **self.architecture)
        else:
            network = OwnNetwork(architecture.core, n_in, n_out)
        self.network = network.to(rest.device)
        self.register_buffer("linear", torch.zeros(n_in, n_out, device=rest.device))
        self.register_buffer("remainder", torch.ones((), device=rest.device))

    @property
    def coders(self) -> list[Coder]:
        """Coders of the predicted fields, in order."""
        return [coder for coder in self.outputs.values() if isinstance(coder, Coder)]

    def fit_linear(self, inputs: torch.Tensor, outputs: torch.Tensor, noise: float) -> None:
        """Sets the linear part by ridge regression: least squares for inputs with added noise.

        Args:
            inputs: (S, n_in) standardised.
            outputs: (S, n_out) standardised.
            noise: standard deviation of the noise.
        """
        x, y = inputs.double(), outputs.double()
        gram = x.mT @ x + len(x) * noise**2 * torch.eye(x.shape[1], device=x.device, dtype=x.dtype)
        linear = torch.linalg.solve(gram, x.mT @ y)
        self.linear.copy_(linear)
        self.remainder.copy_((y - x @ linear).square().mean().sqrt())

    def standardised(self, inputs: torch.Tensor) -> torch.Tensor:
        """Maps standardised inputs (S, n_in) from `encode` to standardised fields (S, n_out)."""
        return inputs @ self.linear + self.remainder * self.network(inputs)

    def encode(
        self, q: torch.Tensor, v: torch.Tensor, actuation: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Standardised inputs (S, n_in), in the network's precision, from q,
        v (S, N, 3) [m], [m/s] and (S, A) or None.

        Raises:
            ValueError: no actuation for a model that was built with one.
        """
        parts = [self.position.encode(q - self.rest), self.velocity.encode(v)]
        if self.actuation is not None:
            if actuation is None:
                raise ValueError("this model was trained with an actuation: pass one")
            parts.append(self.actuation.encode(actuation))
        return torch.cat(parts, dim=1).to(self.linear.dtype)

    def missed(self, q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        """Root mean square distances (S, 2) of displacements [m]
        and velocities [m/s] from the modes of the inputs.
        """
        pairs = ((self.position, q - self.rest), (self.velocity, v))
        left = [
            field - coder.decode(coder.encode(field)) if coder.size else 0.0 * field
            for coder, field in pairs
        ]
        return torch.stack([field.square().sum(2).mean(1).sqrt() for field in left], 1)

    def encode_outputs(self, *fields: torch.Tensor) -> torch.Tensor:
        """Standardised outputs (S, n_out), in the network's precision,
        from fields (S, N, 3) in the coders' order.
        """
        pairs = zip(self.coders, fields, strict=True)
        return torch.cat([coder.encode(field) for coder, field in pairs], dim=1).to(
            self.linear.dtype
        )

    def decode(self, inputs: torch.Tensor) -> list[torch.Tensor]:
        """Predicted fields (S, N, 3) in order, from standardised inputs (S, n_in)."""
        parts = self.standardised(inputs).split(self._sizes, dim=1)
        return [coder.decode(part) for coder, part in zip(self.coders, parts, strict=True)]

    def predict(
        self, q: torch.Tensor, v: torch.Tensor, actuation: torch.Tensor | None = None
    ) -> list[torch.Tensor]:
        """Predicted fields (S, N, 3) in order; for the arguments, see `encode`."""
        return self.decode(self.encode(q, v, actuation))

    def description(self) -> dict[str, Any]:
        """Metadata for `restore`, beside the tensors."""
        return {
            "architecture": self.architecture,
            "acts": self.acts,
            "reduced": self.position.basis is not None,
            "actuated": self.actuation is not None,
        }


class ResidualForce(StateMap):
    """Predicts the residual force from the state (the published method's network)."""

    fields = ("force",)

    def forward(
        self, q: torch.Tensor, v: torch.Tensor, actuation: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Residual force (S, N, 3) [N]."""
        return self.predict(q, v, actuation)[0]


class NextState(StateMap):
    """Predicts the next state from the state: the purely data-driven baseline (SimFree)."""

    fields = ("next_position", "next_velocity")

    def forward(
        self, q: torch.Tensor, v: torch.Tensor, actuation: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions [m] and velocities [m/s], (S, N, 3) each, after one time step."""
        position, velocity = self.predict(q, v, actuation)
        return position, velocity

    @override
    def decode(self, inputs: torch.Tensor) -> list[torch.Tensor]:
        """Positions [m] and velocities [m/s], (S, N, 3) each; see `StateMap.decode`."""
        displacement, velocity = super().decode(inputs)
        return [self.rest + displacement, velocity]


Model = TypeVar("Model", bound=StateMap)


def build_model(
    kind: type[Model],
    settings: NetworkSettings,
    rest: torch.Tensor,
    q: torch.Tensor,
    v: torch.Tensor,
    force: torch.Tensor | None = None,
    actuation: torch.Tensor | None = None,
    stiffness: RestStiffness | None = None,
) -> Model:
    """Returns an untrained model, with coders from training samples.

    Args:
        kind: `ResidualForce`, or `NextState`, which has the same coders for inputs and outputs.
        settings: kind and size of the network.
        rest: (N, 3) rest positions [m].
        q: (S, N, 3) positions [m].
        v: (S, N, 3) velocities [m/s].
        force: (S, N, 3) residual forces [N]; None for a next state.
        actuation: (S, A) further inputs of the network, or None.
        stiffness: of the body at rest, for a ``reduced`` network with modes of the static
            displacements; with modes of the forces themselves if None.

    Raises:
        InputError: sizes that do not fit the samples.
    """
    reduced, modes = settings.kind == "reduced", (settings.position_modes, settings.velocity_modes)
    position, velocity = (
        (pod_coder(field, count) if count else empty_coder(field))
        if reduced
        else nodal_coder(field)
        for field, count in zip((q - rest, v), modes, strict=True)
    )
    if force is None:
        coders = copy.deepcopy([position, velocity])
    elif not reduced:
        coders = [nodal_coder(force)]
    elif stiffness is None:
        coders = [pod_coder(force, settings.force_modes)]
    else:
        coders = [displacement_coder(force, stiffness, settings.force_modes)]
    actuated = None if actuation is None else actuation_coder(actuation)
    return kind(
        rest, position, velocity, dict(zip(kind.fields, coders, strict=True)), settings, actuated
    )


def restore(
    kind: type[Model], tensors: Mapping[str, torch.Tensor], description: Mapping[str, Any]
) -> Model:
    """Returns the model of a ``state_dict`` and a `StateMap.description`."""

    def coder(name: str) -> Coder:
        basis, dual = (tensors.get(f"{name}.{part}") for part in ("basis", "dual"))
        return Coder(tensors[f"{name}.mean"], basis, tensors[f"{name}.scale"], dual)

    outputs = {name: coder(f"outputs.{name}") for name in kind.fields}
    actuation = coder("actuation") if description["actuated"] else None
    state = coder("position"), coder("velocity")
    acts = description.get("acts", "internal")  # files of earlier versions lack it
    settings = NetworkSettings(**description["architecture"], acts=acts)
    model = kind(tensors["rest"], *state, outputs, settings, actuation)
    if tensors["linear"].dtype == torch.float64:
        model.double()
    model.load_state_dict(tensors)
    return model.eval()
