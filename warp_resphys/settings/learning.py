"""Settings of what is learned: physical parameters, forces, networks, and how they are trained."""

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from ..io.settings import Count, Many, Natural, NotNegative, Positive, Settings, Share, Some, setting
from .body import Integrator
from .trials import different

Size = Annotated[int, Field(ge=1, le=16_384)]


class PriorSettings(Settings):
    """What is known of a parameter beforehand."""

    mean: float = setting(description="in the parameter's unit")
    deviation: Positive = setting(description="in the parameter's unit")


class SpanSettings(Settings):
    """Values of a parameter between two."""

    lower: float = setting(description="in the parameter's unit")
    upper: float = setting(description="in the parameter's unit")
    logarithmic: bool = setting(False, "whether the scale is logarithmic")

    @model_validator(mode="after")
    def _rises(self) -> Self:
        if not self.lower < self.upper:
            raise ValueError(f"lower is {self.lower:g}: it must be below upper, {self.upper:g}.")
        if self.logarithmic and not self.lower > 0.0:
            raise ValueError(f"lower is {self.lower:g}: it must be positive, as the scale is logarithmic.")
        return self


class RangeSettings(SpanSettings):
    """The range in which a parameter is searched."""

    prior: PriorSettings | None = setting(None, "what is known beforehand")

    @model_validator(mode="after")
    def _has_the_prior(self) -> Self:
        if self.prior is not None and not self.lower <= self.prior.mean <= self.upper:
            raise ValueError(
                f"prior.mean is {self.prior.mean:g}, outside of the range from {self.lower:g} to {self.upper:g}: widen "
                "the range, or correct the prior."
            )
        return self


class GridSettings(SpanSettings):
    """Points at which a landscape is drawn."""

    points: Natural = setting(description="number of points")


class GridTable(Settings):
    """The landscape in the report."""

    youngs_modulus: GridSettings = setting(description="points along it", unit="Pa")
    poissons_ratio: GridSettings | None = setting(None, "points along it")


class PlacementSettings(Settings):
    """Standard deviations of where markers sit and how recordings lie, to identify both."""

    markers: Positive | None = setting(None, "of each coordinate of a marker's place", "m")
    shift: Positive | None = setting(None, "of each coordinate of the recordings' origin", "m")
    turn: Positive | None = setting(None, "of each component of the recordings' rotation", "degrees")


def _without_null(values: Any) -> Any:
    """Takes out the parameters whose range or first guess is null."""
    return {key: each for key, each in values.items() if each is not None} if isinstance(values, dict) else values


Ranges = Annotated[
    dict[str, RangeSettings],
    BeforeValidator(_without_null, json_schema_input_type=dict[str, RangeSettings | None]),
]
Guesses = Annotated[dict[str, float], BeforeValidator(_without_null, json_schema_input_type=dict[str, float | None])]


class IdentifiedSettings(Settings):
    """What makes an identified simulator another one than the uncorrected one."""

    integrator: Integrator | None = setting(None, "of the identified simulator; null: that of the uncorrected one")
    substeps: Natural = setting(1, "of a time step, where it has an integrator of its own")
    elastic: Ranges | None = setting(
        None, "ranges of youngs_modulus and poissons_ratio for the published identification, of these alone"
    )


class IdentifySettings(IdentifiedSettings):
    """Physical parameters to identify."""

    parameters: Ranges = setting(
        {}, "ranges by name; null, or ~identify.parameters.NAME, takes one out; docs/identification has the names"
    )
    placement: PlacementSettings | None = setting(None, "identify where markers sit and how recordings lie")
    first_guess: Guesses = setting({}, "where the data sheet says nothing; null takes one out")
    trials: Natural | None = setting(None, "of the training, evenly picked; null: all")
    seconds: Positive | None = setting(None, "of each; null: all that counts", "s")
    starts: Natural = setting(1, "searches: from the first guess, and the best of random candidates")
    candidates: Count = setting(4, "random candidates")
    max_evaluations: Natural = setting(10, "of the loss and its gradient, a start")
    tolerance: Positive = setting(1.0e-3, "relative decrease of the loss that is still worth a step")
    grid: GridTable | None = setting(None, "landscape in the report")

    @model_validator(mode="after")
    def _guesses_lie_within(self) -> Self:
        for name, value in self.first_guess.items():
            range_ = self.parameters.get(name)
            if range_ is not None and not range_.lower <= value <= range_.upper:
                raise ValueError(
                    f"first_guess.{name} is {value:g}: it must be a number from {range_.lower:g} to {range_.upper:g}, "
                    "its range."
                )
        return self


class ReconstructionSettings(Settings):
    """Forces that bring the simulator to what was observed: min |q+ - target|^2 + regularisation |f|^2."""

    method: Literal["gauss_newton", "levenberg_marquardt", "lbfgsb"] = setting(
        "gauss_newton", "levenberg_marquardt takes smaller steps, for markers; lbfgsb is the published, slow one"
    )
    regularisation: NotNegative = setting(
        1.0e-10, "weight of the forces; the published 1e-4 leaves up to 0.3 mm", "m^2/N^2"
    )
    tolerance: Positive = setting(1.0e-10, "last change of any position [m]; of lbfgsb, relative change of the loss")
    max_iterations: Natural = setting(20, "after which a step has failed")
    modes: Natural | None = setting(None, "vibration modes whose inertial forces span the force; null: any force")


class NetworkSettings(Settings):
    """The network of the residual force, or of the next state."""

    kind: Literal["reduced", "nodal"] = setting(
        "reduced", "in- and output in a reduced basis, stable in closed loop; nodal: of every vertex, as published"
    )
    position_modes: Count = setting(6, "modes of the positions that it sees")
    velocity_modes: Count = setting(6, "modes of the velocities that it sees")
    force_modes: Natural = setting(12, "modes of the force")
    force_basis: Literal["force", "displacement"] = setting(
        "force", "modes of the forces themselves; displacement: of what they would cause"
    )
    blocks: Annotated[int, Field(ge=1, le=100)] = setting(1, "residual blocks")
    layers: Annotated[int, Field(ge=0, le=100)] = setting(3, "hidden layers of a block")
    width: Size = setting(256, "of a layer")
    activation: Literal["normalised_elu", "silu"] = setting(
        "normalised_elu", "layer normalisation and ELU, as published; silu, without, is smoother"
    )
    recurrent: Annotated[int, Field(ge=1, le=1_024)] | None = setting(
        None, "size of a hidden state that goes with the roll-out; it takes trainer=sequences"
    )


class EpochSettings(Settings):
    """What every way of training has."""

    epochs: Natural = setting(300, "at most")
    rollout_every: Natural = setting(30, "epochs between roll-outs of the validation split")


class TrainerSettings(EpochSettings):
    """Training on reconstructed steps."""

    batch_size: Natural = setting(64, "steps")
    learning_rate: Positive = setting(2.0e-3, "at first")
    schedule: Literal["cosine", "step"] = setting(
        "cosine", "of the learning rate: to final_learning_rate, or times gamma every step_epochs"
    )
    final_learning_rate: Positive = setting(2.0e-6, "of schedule=cosine")
    gamma: Share = setting(0.83, "of schedule=step")
    step_epochs: Natural = setting(100, "of schedule=step")
    weight_decay: NotNegative = setting(0.0, "of Adam")
    noise: NotNegative = setting(1.0e-3, "standard deviation added to the standardised inputs")
    linear_noise: Positive | None = setting(
        1.0e-3, "the linear part is fitted as if the inputs had this noise; null leaves it out"
    )
    scale_weight: NotNegative = setting(
        0.0, "power of their deviation by which outputs weigh in the loss: 0 all alike, 1 as in the field itself"
    )
    selection: Literal["rollout", "validation_loss"] = setting(
        "rollout", "weights that are kept: of the least validation roll-out error, or loss"
    )
    sequence: Natural | None = setting(None, "steps that the gradient of a recurrent network reaches back")


class FullBatchSettings(EpochSettings):
    """L-BFGS through the simulator."""

    memory: Natural = setting(10, "pairs that L-BFGS keeps")


class InTheLoopSettings(FullBatchSettings):
    """Training of the residual force on whole trials, through the simulator."""

    epochs: Natural = setting(5, "iterations of L-BFGS, at most")
    rollout_every: Natural = setting(1, "epochs between measurements of the error by which the weights are chosen")
    hold_out: bool = setting(
        True, "without validation trials, hold out each training trial once, and train as long as that serves it"
    )
    patience: Natural = setting(3, "epochs without any gain for the trials held out, after which that search ends")
    penalty: NotNegative = setting(1.0e-2, "on the squared weights")


class RefinementSettings(FullBatchSettings):
    """Further training of the residual force through the simulator, over windows."""

    kind: Literal["solver_in_the_loop"] = setting("solver_in_the_loop", "way of refinement")
    epochs: Natural = setting(12, "iterations of L-BFGS")
    rollout_every: Natural = setting(1, "epochs between roll-outs of the validation split, by which weights are chosen")
    window: Natural = setting(10, "steps that the simulator takes from each start on the target trajectory")
    batch_size: Natural = setting(32, "windows that are simulated at once")


class TrainingSettings(Settings):
    """Everything that a model is trained with."""

    network: NetworkSettings
    trainer: TrainerSettings
    in_the_loop: InTheLoopSettings | None
    seed: Count  # of the weights, the batches and the noise

    @model_validator(mode="after")
    def _sequences(self) -> Self:
        if self.network.recurrent is not None and self.in_the_loop is None and self.trainer.sequence is None:
            raise ValueError("trainer.sequence is missing: a recurrent network needs it; trainer=sequences has one.")
        return self


class BaselineSettings(Settings):
    """What the data-driven baseline has; keys that are left out are as in the groups network and trainer."""

    network: NetworkSettings = NetworkSettings()
    trainer: TrainerSettings = TrainerSettings()


class ActuationSettings(Settings):
    """What networks see beside the state."""

    filter_time_constants: Many[Positive] = setting(
        (), "of exponential means of the inputs, for bodies that creep", "s"
    )
    sees_payload: bool = setting(False, "whether the residual force may depend on the payload, with many to learn from")


class ReleaseSettings(Settings):
    """How a motion begins that is let go: the body that is held by its markers, and how."""

    hold_modes: Count = setting(
        6, "vibration modes whose inertial forces hold it; 0 lets it go from where gravity and payload leave it"
    )
    velocity_modes: Count = setting(0, "vibration modes of a velocity at the release")
    window: Positive = setting(
        0.13, "after the release, that tells delay, velocity and sideways displacement: about a period", "s"
    )
    noise: Positive = setting(3.0e-4, "that a marker may be off for reasons that no release explains", "m")
    delay: NotNegative = setting(
        0.0, "expected deviation of the release from the one found in the frames; 0 takes that one", "s"
    )
    speed: Positive = setting(0.05, "expected speed of the fastest vertex", "m/s")
    sideways: NotNegative = setting(
        0.0, "expected displacement, across gravity, of a body that is held undeformed only to the eye; 0 for none", "m"
    )
    iterations: Natural = setting(4, "Levenberg-Marquardt steps")


class AblationSettings(Settings):
    """How many markers a reconstruction needs."""

    counts: Annotated[Some[Natural], AfterValidator(different)] = setting(description="numbers of markers")
    draws: Natural = setting(10, "random sets of each number")
    processes: Natural | None = setting(None, "that share the numbers; null: one a core, and one where a GPU simulates")
    modes: Natural | None = setting(None, "vibration modes whose inertial forces span the force; null: any force")
