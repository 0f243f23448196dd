"""Settings of identification, reconstruction of forces, networks and their training."""

import math
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, Strict, model_validator

from ..io.classes import ClassSettings
from ..io.settings import (
    Count,
    Many,
    Natural,
    NotNegative,
    Pair,
    Positive,
    Settings,
    Share,
    Some,
    Word,
    setting,
    without_null,
)
from .body import Integrator
from .performed import different, rising

if TYPE_CHECKING:
    import torch

Size = Annotated[int, Field(ge=1, le=16_384)]
Term = Annotated[
    str,
    Field(
        pattern=r"^(c20|c30|c01|c02|dilation|bulk_2|ogden_m?[1-9]\d*)$",
        json_schema_extra={
            "wanted": "c20, c30, c01, c02, dilation, bulk_2, or ogden_3, ogden_m3 and so on"
        },
    ),
]

Shared = Literal["all", "part", "session", "trial", "material", "lens"]
SharedByPart = Annotated[
    tuple[Literal["part"], Literal["session", "trial"]],
    Strict(False),
    Field(json_schema_extra={"wanted": "[part, session] or [part, trial]"}),
]


class Prior(Settings):
    """Normal prior of a parameter, or of its logarithm where that is searched."""

    mean: float = setting(description="mean, in the parameter's unit")
    deviation: Positive = setting(description="standard deviation, in the parameter's unit")


class Bounds(Settings):
    """The search range of a parameter."""

    lower: float = setting(description="lower bound, in the parameter's unit")
    upper: float = setting(description="upper bound, in the parameter's unit")
    logarithmic: bool = setting(False, "whether the scale is logarithmic")
    prior: Prior | None = setting(None, "prior knowledge")
    per: Shared | SharedByPart = setting(
        "all",
        "what shares a value; part: one for each chamber, tendon or muscle; session, trial: near "
        "the mean of the prior; material, lens: for pictures",
    )

    @model_validator(mode="after")
    def _rises(self) -> Self:
        if not self.lower < self.upper:
            raise ValueError(f"lower is {self.lower:g}: it must be below upper, {self.upper:g}.")
        if self.logarithmic and not self.lower > 0.0:
            raise ValueError(
                f"lower is {self.lower:g}: it must be positive, as the scale is logarithmic."
            )
        if self.owner in ("session", "trial") and self.prior is None:
            raise ValueError(
                f"per names {self.owner}, but there is no prior, which holds the values: add one."
            )
        if self.prior is not None and not self.lower <= self.prior.mean <= self.upper:
            raise ValueError(
                f"prior.mean is {self.prior.mean:g}, outside of the range from {self.lower:g} to "
                f"{self.upper:g}: widen the range, or correct the prior."
            )
        return self

    @property
    def by_part(self) -> bool:
        """Whether each part has a value."""
        return self.per == "part" or not isinstance(self.per, str)

    @property
    def owner(self) -> str:
        """The kind of owners of values besides parts: session, trial, material or lens.

        Empty if all share one.
        """
        word = self.per if isinstance(self.per, str) else self.per[1]
        return "" if word in ("all", "part") else word

    def unit_prior(self) -> tuple[float, float] | None:
        """Mean and standard deviation of the prior, as fractions of the range.

        None without a prior.
        """
        if self.prior is None:
            return None
        mean = self.to_unit(self.prior.mean)
        return mean, self.prior.deviation / self.slope(mean)

    def to_unit(self, value: float) -> float:
        """Returns a value as a fraction of the range, 0 to 1."""
        if self.logarithmic:
            low = math.log(self.lower)
            return (math.log(value) - low) / (math.log(self.upper) - low)
        return (value - self.lower) / (self.upper - self.lower)

    def from_unit(self, unit: "torch.Tensor") -> "torch.Tensor":
        """Returns the values at fractions of the range; differentiable."""
        if self.logarithmic:
            return self.lower * (unit * math.log(self.upper / self.lower)).exp()
        return self.lower + unit * (self.upper - self.lower)

    def slope(self, unit: float) -> float:
        """Derivative of the value by its fraction of the range."""
        if self.logarithmic:
            return (
                self.lower * (self.upper / self.lower) ** unit * math.log(self.upper / self.lower)
            )
        return self.upper - self.lower


class PlacementSettings(Settings):
    """Prior standard deviations of positions of markers
    and pose of the recordings, which are identified.
    """

    markers: Positive | None = setting(None, "deviation of a coordinate of a position", "m")
    mounting: Positive | None = setting(
        None, "deviation of a component of a rigid body's rotation on its part", "degrees"
    )
    shift: Positive | None = setting(
        None, "deviation of a coordinate of the recordings' origin", "m"
    )
    turn: Positive | None = setting(
        None, "deviation of a component of the recordings' rotation", "degrees"
    )
    between_sessions: Positive = setting(
        0.5, "deviations between sessions, relative to those above"
    )


Ranges = Annotated[
    dict[str, Bounds],
    BeforeValidator(without_null, json_schema_input_type=dict[str, Bounds | None]),
]
Guesses = Annotated[
    dict[str, float], BeforeValidator(without_null, json_schema_input_type=dict[str, float | None])
]


class IdentifySettings(Settings):
    """Physical parameters to identify, and differences of the identified simulator
    from the uncorrected one.
    """

    integrator: Integrator | None = setting(
        None, "integrator of the identified simulator; null: as uncorrected"
    )
    substeps: Natural = setting(1, "substeps per time step, with an integrator of its own")
    elastic: Ranges | None = setting(
        None,
        "ranges of youngs_modulus and poissons_ratio for the published identification of these two",
    )
    parameters: Ranges = setting(
        {}, "ranges by name; null, or ~identify.parameters.NAME, takes one out"
    )
    placement: PlacementSettings | None = setting(
        None, "identify positions of markers and pose of the recordings"
    )
    first_guess: Guesses = setting({}, "of parameters without a value in the data sheet")
    trials: Natural | None = setting(None, "training trials, evenly chosen; null: all")
    seconds: Positive | None = setting(None, "duration of each that is used; null: all", "s")
    starts: Natural = setting(1, "searches: from the first guess and random candidates")
    candidates: Count = setting(4, "random candidates")
    max_evaluations: Natural = setting(10, "evaluations of the loss and its gradient per start")
    tolerance: Positive = setting(1.0e-3, "relative decrease of the loss below which a search ends")

    def key_of(self, parameter: str) -> str:
        """Returns the key of the range of a parameter, which may be that of all parts.

        Empty if it has none.
        """
        shared = [name for name, limits in self.parameters.items() if limits.by_part]
        whole = max(
            (name for name in shared if parameter.startswith(f"{name}_")), key=len, default=""
        )
        return parameter if parameter in self.parameters else whole

    @model_validator(mode="after")
    def _guesses_lie_within(self) -> Self:
        for name, value in self.first_guess.items():
            bounds = self.parameters.get(self.key_of(name))
            if bounds is not None and not bounds.lower <= value <= bounds.upper:
                raise ValueError(
                    f"first_guess.{name} is {value:g}: it must be a number from {bounds.lower:g} "
                    f"to {bounds.upper:g}, its range."
                )
        return self


class LawSettings(Settings):
    """Identification of the material's law as a sum of convex terms, by
    `energies.convex_material.ConvexMaterial`.

    A path in place of the group, law=FILE, takes the law that another run has written in law.json.
    """

    file: Word | None = setting(None, "law of another run, or a silicone's name")
    terms: Many[Term] = setting(
        ("c20", "c01", "dilation", "ogden_3", "ogden_6"), "elastic terms besides c10 and bulk_1"
    )
    branches: Count = setting(13, "relaxation times that are tried")
    relaxation_times: Annotated[Pair[Positive], AfterValidator(rising)] = setting(
        (0.01, 1.0), "shortest and longest", "s"
    )
    families: Count = setting(1, "largest number of families of fibres; with markers at most one")
    trials: Natural | None = setting(3, "training trials, evenly chosen; null: all")
    seconds: Positive | None = setting(1.0, "duration of each that is used; null: all", "s")
    max_evaluations: Natural = setting(
        10, "evaluations of the loss and its derivatives in a search"
    )
    tolerance: Positive = setting(
        1.0e-3, "relative decrease of the loss below which the search ends"
    )


class ReconstructionSettings(Settings):
    """Forces that fit the simulator to observations: min |q+ - target|^2 + regularisation |f|^2."""

    method: Literal["gauss_newton", "levenberg_marquardt", "lbfgsb"] = setting(
        "gauss_newton", "levenberg_marquardt takes smaller steps; lbfgsb is as published, and slow"
    )
    regularisation: NotNegative = setting(
        1.0e-10, "weight of the forces; the published 1e-4 leaves up to 0.3 mm", "m^2/N^2"
    )
    tolerance: Positive = setting(
        1.0e-10, "last change of any position [m]; for lbfgsb, relative change of the loss"
    )
    max_iterations: Natural = setting(20, "iterations after which a step fails")


class NetworkSettings(Settings):
    """The network of the residual force, or of the next state."""

    kind: Literal["reduced", "nodal"] = setting(
        "reduced", "reduced basis, stable in closed loop; nodal: every vertex, as published"
    )
    position_modes: Count = setting(6, "modes of the positions in the input")
    velocity_modes: Count = setting(6, "modes of the velocities in the input")
    force_modes: Natural = setting(12, "modes of the force")
    force_basis: Literal["force", "displacement"] = setting(
        "force", "modes of forces, or of the displacements that they cause"
    )
    blocks: Annotated[int, Field(ge=1, le=100)] = setting(1, "residual blocks")
    layers: Annotated[int, Field(ge=0, le=100)] = setting(3, "hidden layers of a block")
    width: Size = setting(256, "width of a layer")
    activation: Literal["normalised_elu", "silu"] = setting(
        "normalised_elu", "layer normalisation and ELU, as published; silu is smoother"
    )
    acts: Literal["internal", "external"] = setting(
        "internal",
        "where the force acts: within the body, whose support does not feel it, or on it, as "
        "water or an obstacle that the simulator lacks",
    )
    core: ClassSettings | None = setting(
        None, "map between the coders by a class of another package, in place of blocks and layers"
    )


class EpochSettings(Settings):
    """Settings of all kinds of training."""

    epochs: Natural = setting(300, "largest number")
    rollout_every: Natural = setting(30, "epochs between roll-outs of the validation split")


class TrainerSettings(EpochSettings):
    """Training on reconstructed steps."""

    batch_size: Natural = setting(64, "steps")
    learning_rate: Positive = setting(2.0e-3, "initial")
    schedule: Literal["cosine", "step"] = setting(
        "cosine",
        "schedule of the learning rate: to final_learning_rate, or times gamma every step_epochs",
    )
    final_learning_rate: Positive = setting(2.0e-6, "last learning rate of schedule=cosine")
    gamma: Share = setting(0.83, "factor of schedule=step")
    step_epochs: Natural = setting(100, "epochs between two steps of schedule=step")
    weight_decay: NotNegative = setting(0.0, "weight decay of Adam")
    noise: NotNegative = setting(1.0e-3, "standard deviation of noise on the standardised inputs")
    linear_noise: Positive | None = setting(
        1.0e-3, "noise of the inputs for which the linear part is fitted; null: no linear part"
    )
    scale_weight: NotNegative = setting(
        0.0, "weights of outputs in the loss: 0 equal, 1 as in the force field"
    )
    selection: Literal["rollout", "validation_loss"] = setting(
        "rollout", "keep the weights of the least validation roll-out error, or loss"
    )
    gate: bool = setting(
        True,
        "use the force only if it is clearly closer to held-out trials than the simulator and "
        "the robot rests with it; false: always",
    )


class LoopSettings(EpochSettings):
    """Training through the simulator."""

    epochs: Natural = setting(5, "largest number of iterations")
    rollout_every: Natural = setting(1, "epochs between roll-outs that choose the weights")
    patience: Natural = setting(3, "epochs without improvement after which training ends")


class InTheLoopSettings(LoopSettings):
    """Training of the residual force on whole trials, through the simulator, by L-BFGS."""

    penalty: NotNegative = setting(1.0e-2, "penalty on the squared weights")
    memory: Natural = setting(10, "number of pairs that L-BFGS keeps")
    hold_out: bool = setting(
        True, "without validation trials, hold out each training trial to choose the epochs"
    )


class ActuatorSettings(LoopSettings):
    """Learned changes of the inputs, trained through the simulator."""

    filters: Many[Positive] = setting(
        (0.4, 2.0), "time constants of exponential means of the inputs", "s"
    )
    centres: Natural = setting(100, "largest number of centres of the Gaussian process")
    epochs: Count = setting(4, "largest number of linearisations of the motions by the inputs")
    gate: bool = setting(
        True,
        "use it only if it is clearly closer to held-out trials than the simulator; false: always",
    )


class TrainingSettings(Settings):
    """Settings of the training of a model."""

    network: NetworkSettings
    trainer: TrainerSettings
    in_the_loop: InTheLoopSettings | None
    seed: Count  # of the weights, the batches and the noise


class BaselineSettings(Settings):
    """Settings of the data-driven baseline.

    Keys that are left out are those of the groups network and trainer.
    """

    network: NetworkSettings = NetworkSettings()
    trainer: TrainerSettings = TrainerSettings()


class ActuationSettings(Settings):
    """Inputs of networks beside the state."""

    filter_time_constants: Many[Positive] = setting(
        (), "time constants of exponential means of the inputs, for bodies that creep", "s"
    )
    sees_payload: bool = setting(False, "the payload is an input of the network")


class ReleaseSettings(Settings):
    """Estimation of the start of a motion: the state at a release,
    from the held markers, or the delay of inputs.
    """

    hold_modes: Natural = setting(6, "vibration modes that hold it")
    window: Positive = setting(
        0.13,
        "duration after the release for estimating delay and sideways displacement: about a "
        "period; and at the beginning of trials for their values and those of their session",
        "s",
    )
    noise: Positive = setting(
        3.0e-4, "standard deviation of markers that the release does not explain", "m"
    )
    delay: NotNegative = setting(0.0, "expected deviation from the detected time; 0 uses that", "s")
    sideways: NotNegative = setting(0.0, "expected deflection across gravity of a held body", "m")


class AblationSettings(Settings):
    """Study of the number of markers for a reconstruction."""

    counts: Annotated[Some[Natural], AfterValidator(different)] = setting(
        description="numbers of markers"
    )
    draws: Natural = setting(10, "random sets of each number")
    processes: Natural | None = setting(None, "processes; null: one per core, one on a GPU")
