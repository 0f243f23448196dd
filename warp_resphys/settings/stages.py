"""Settings of the stages of a run: a class for each, with a field for every group or key that it may read.

The fingerprint of a stage is that of its settings. A stage cannot read other settings, so that no dependency of a file
is forgotten. `Settings.of` copies the fields that `RunSettings` has by the same name; the pipeline adds the others.
"""

from typing import Annotated, Any

from pydantic import Field

from ..io.settings import Many, Settings, Vector
from .body import MaterialSettings, SimulatorSettings, SolveSettings, TargetSettings
from .control import ControlSettings, FeedbackSettings, FigureSettings, PlanSettings, ReductionSettings
from .learning import (
    ActuationSettings,
    IdentifiedSettings,
    IdentifySettings,
    LawSettings,
    ReconstructionSettings,
    ReleaseSettings,
    TrainingSettings,
)
from .mesh import PlaceSettings
from .pictures import PictureData
from .run import PublishedSettings, RunSettings
from .shapes import ShapeSettings
from .trials import (
    BindingSettings,
    MarkerSettings,
    PlaySettings,
    ReadingSettings,
    ReleaseFromLoad,
    SimulatedData,
    Split,
    Trial,
)


class SimulationStage(SimulatorSettings):
    """Settings of every simulation of a run."""

    payload_at: PlaceSettings | None
    files: dict[str, str]  # SHA-256 of the files that bodies and their motions are read from, by path


class SimulateStage(SimulationStage):
    """Trials of a simulation that stands in for the real body, with all vertices observed."""

    target: TargetSettings
    data: Annotated[SimulatedData, Field(discriminator="kind")]
    trials: Many[Trial]


class PlayedSettings(Settings):
    """A simulated laboratory."""

    laboratory: PlaySettings
    tip: PlaceSettings
    payload_at: PlaceSettings | None
    gravity: Vector
    time_step: float
    solver: SolveSettings
    device: str
    seed: int
    binding: BindingSettings
    data: ReadingSettings
    files: dict[str, str]


class LaboratoryStage(PlayedSettings):
    """Recordings of the laboratory."""

    trials: Many[Trial]
    batch: int | None


class ImportStage(SimulationStage):
    """Recordings that are transformed into the frame of the body."""

    simulation: MaterialSettings
    markers: MarkerSettings
    data: ReadingSettings
    trials: Many[Trial]
    learned: Many[str] | None  # names of the trials of training and validation; None for a cross-validation


class PictureStage(SimulatorSettings):
    """Pictures of bodies, at rest or released."""

    simulation: MaterialSettings
    data: PictureData
    files: dict[str, str]  # SHA-256 of all files that are read, by path
    seed: int


class IdentifyPicturesStage(PictureStage):
    """Identification of a material from pictures."""

    identify: IdentifySettings


class LearningStage(SimulationStage):
    """Settings of all stages of a split."""

    simulation: MaterialSettings
    markers: MarkerSettings | None
    release: ReleaseSettings
    force_frame: str
    train_fraction: float
    trial_seconds: float | None
    identified: IdentifiedSettings | None
    with_law: bool  # whether the law of the material is identified
    batch: int | None
    shared: str  # folder of the dataset, from that of the split
    acquired: str  # fingerprint of the stage that wrote the dataset
    split: Split


class IdentifyStage(LearningStage):
    """Identification."""

    identify: IdentifySettings
    seed: int


class IdentifyLawStage(LearningStage):
    """Identification of the material's law."""

    law: LawSettings
    identify: IdentifySettings | None
    name: str


class ShapesStage(LearningStage):
    """Other bodies with the identified material."""

    target: TargetSettings
    shapes: dict[str, ShapeSettings]
    steps: int


class ReconstructStage(LearningStage):
    """Reconstruction of the forces on a model's simulator."""

    model: str
    reconstruction: ReconstructionSettings
    reconstructed: Many[str]  # names of the trials


class NetworkStage(LearningStage):
    """Settings of all stages with networks."""

    actuation: ActuationSettings
    range_guard: bool


class TrainStage(NetworkStage):
    """Training of a model."""

    model: str
    training: TrainingSettings


class TestStage(NetworkStage):
    """Settings of all stages with roll-outs of models."""

    groups: dict[str, Many[str]]  # names of the test trials by scale of the inputs, ``1`` first


class EvaluateStage(TestStage):
    """Roll-outs of the test trials by all models."""

    calibration: Many[str]  # names of the trials that prediction intervals come from
    published: PublishedSettings | None
    correct_uncorrected: bool
    horizons: Many[float]


class TimeStage(TestStage):
    """Times of the models."""

    target: TargetSettings | None


class MeshCheckStage(TestStage):
    """Comparison with a finer mesh."""

    mesh_check: float


class ReduceStage(LearningStage):
    """A reduced model of a robot."""

    model: str
    reduction: ReductionSettings
    seed: int


class PlanStage(LearningStage):
    """Plans of all motions on the reduced model of a robot."""

    model: str
    figures: FigureSettings
    plan: PlanSettings
    must_reach: bool  # whether the robot must be able to reach all figures


class BaselinesStage(LearningStage):
    """Controllers without a simulator."""

    model: str  # of the robot
    figures: FigureSettings
    feedback: FeedbackSettings
    played: PlayedSettings


class DriveStage(LearningStage):
    """Motions of the laboratory under all controllers."""

    control: ControlSettings
    played: PlayedSettings


class AblationStage(SimulationStage):
    """The motion of a marker ablation, and its reconstructions from random sets of markers."""

    target: TargetSettings
    simulation: MaterialSettings
    data: ReleaseFromLoad
    reconstruction: ReconstructionSettings
    seed: int
    counts: Many[int]
    draws: int
    modes: int | None


class ReportStage(Settings):
    """A report, which shows the whole configuration."""

    config: RunSettings
    acquired: str = ""  # fingerprint of the stage that wrote the dataset, for the report of a split
    folds: dict[str, Any] = Field(
        default={}
    )  # errors of the models of a cross-validation, by the trial that is left out
