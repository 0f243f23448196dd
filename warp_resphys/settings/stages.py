"""Settings of the stages of a run: for each, the keys that it reads, and what the pipeline derives from the run for it.

The fingerprint of a stage is that of its settings. A stage cannot read keys that the pipeline does not name for it, so
that no dependency of a file is forgotten.
"""

from typing import Any, Final, Self

from pydantic import ConfigDict, Field, model_validator

from ..io.settings import Many, Settings, Vector, setting
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
from .run import PublishedSettings, RunSettings
from .shapes import ShapeSettings
from .trials import BindingSettings, MarkerSettings, PlaySettings, ReadingSettings, Split, Trial

LEARNING: Final = (  # keys of all stages of a split, beside those of the simulator
    *("payload_at", "simulation", "markers", "release", "force_frame", "train_fraction", "trial_seconds", "identified"),
    *("with_law", "batch"),
)
NETWORKS: Final = ("actuation", "range_guard")  # and of all with networks


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


class ReportStage(Settings):
    """A report, which shows the whole configuration."""

    config: RunSettings
    acquired: str = ""  # fingerprint of the stage that wrote the dataset, for the report of a split
    folds: dict[str, Any] = Field(default={})  # errors of the models of a cross-validation, by the left-out trial


class StageSettings(SimulatorSettings):
    """Settings of a stage that simulates: those of the simulator, and of the following the ones that it reads."""

    model_config = ConfigDict(validate_default=False)

    files: dict[str, str] = setting(None)  # SHA-256 of all files that are read, by path
    name: str = setting(None)
    seed: int = setting(None)
    simulation: MaterialSettings = setting(None)
    target: TargetSettings = setting(None)
    published: PublishedSettings | None = setting(None)
    payload_at: PlaceSettings | None = setting(None)
    markers: MarkerSettings | None = setting(None)
    data: Any = setting(None)  # of simulations, of recordings or of pictures
    played: PlayedSettings = setting(None)
    trials: Many[Trial] = setting(None)
    learned: Many[str] | None = setting(None)  # names of the trials of training and validation; None with folds
    split: Split = setting(None)
    shared: str = setting(None)  # folder of the dataset, from that of the split
    acquired: str = setting(None)  # fingerprint of the stage that wrote the dataset
    steps: int = setting(None)
    train_fraction: float = setting(None)
    trial_seconds: float | None = setting(None)
    batch: int | None = setting(None)
    release: ReleaseSettings = setting(None)
    identify: IdentifySettings = setting(None)
    identified: IdentifiedSettings | None = setting(None)
    law: LawSettings = setting(None)
    with_law: bool = setting(None)  # whether the law of the material is identified
    shapes: dict[str, ShapeSettings] = setting(None)
    model: str = setting(None)
    reconstruction: ReconstructionSettings = setting(None)
    reconstructed: Many[str] = setting(None)  # names of the trials
    force_frame: str = setting(None)
    actuation: ActuationSettings = setting(None)
    range_guard: bool = setting(None)
    training: TrainingSettings = setting(None)
    correct_uncorrected: bool = setting(None)
    groups: dict[str, Many[str]] = setting(None)  # names of the test trials by scale of the inputs, ``1`` first
    calibration: Many[str] = setting(None)  # names of the trials that prediction intervals come from
    horizons: Many[float] = setting(None)
    mesh_check: float = setting(None)
    counts: Many[int] = setting(None)  # of markers
    draws: int = setting(None)  # of sets of markers
    modes: int | None = setting(None)
    reduction: ReductionSettings = setting(None)
    figures: FigureSettings = setting(None)
    plan: PlanSettings = setting(None)
    must_reach: bool = setting(None)  # whether the robot must be able to reach all figures
    feedback: FeedbackSettings = setting(None)
    control: ControlSettings = setting(None)

    @model_validator(mode="after")
    def _lacks_others(self) -> Self:
        for name in type(self).model_fields.keys() - self.model_fields_set:
            del self.__dict__[name]
        return self

    @classmethod
    def reading(cls, run: RunSettings, *keys: str, **values: Any) -> Self:
        """Returns settings with keys of a run and of its simulator, and ``values`` for what is derived."""
        return cls(**{key: getattr(run, key) for key in (*SimulatorSettings.model_fields, *keys)}, **values)

    def reads(self, key: str) -> bool:
        """Whether the stage reads a key."""
        return key in self.model_fields_set
