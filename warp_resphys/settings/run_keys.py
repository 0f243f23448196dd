"""The keys of a run, and what follows from them; `run.RunSettings` has their relations as well."""

from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator, Field

from ..core.mesh.place import Place
from ..io.errors import InputError
from ..io.settings import Natural, Pair, Settings, Word, parse, setting
from .body import (
    Integrator,
    MaterialSettings,
    PhysicsSettings,
    SimulatorSettings,
    SteppedSettings,
    TargetSettings,
)
from .control import ControlSettings, Model
from .data_kinds import MovingBase, RecordedData, ReleaseFromLoad, ReleaseFromTwist, SimulatedData
from .learning import (
    AblationSettings,
    ActuationSettings,
    ActuatorSettings,
    BaselineSettings,
    IdentifySettings,
    InTheLoopSettings,
    LawSettings,
    NetworkSettings,
    ReconstructionSettings,
    ReleaseSettings,
    TrainerSettings,
    TrainingSettings,
)
from .observed import BindingSettings, ForceSensorSettings, MarkerSettings
from .performed import MotionSettings, by_file
from .pictures import PictureData
from .played import LaboratorySettings, ShapeSettings
from .specimen import MaterialTestData

Name = Annotated[
    str,
    Field(
        pattern=r"^[\w-]+$",
        json_schema_extra={"wanted": "letters, digits, _ and - alone, as it names a folder"},
    ),
]

DataSettings = Annotated[
    RecordedData | ReleaseFromLoad | ReleaseFromTwist | MovingBase | PictureData | MaterialTestData,
    Field(discriminator="kind"),
]


class ParallelSettings(Settings):
    """Processes that share the work."""

    processes: Natural | None = setting(1, "number of processes; null: one for each core")
    address: Word | None = setting(
        None,
        "address of a Dask cluster with the same folders, "
        "such as tcp://head:8786; null: this machine",
    )
    batch: Natural | None = setting(None, "trials that a process simulates at once; null: all")


class PublishedSettings(Settings):
    """A published simulation, for comparison."""

    simulation: MaterialSettings = setting(description="its material")
    physics: PhysicsSettings = setting(description="its masses and volumes")
    integrator: Integrator = setting(description="its time integrator")


class RunKeys(SimulatorSettings):
    """The keys of a run."""

    name: Name = setting(description="name of the experiment and of the folder of its runs")
    title: Word = setting(description="title of the report")
    test_titles: Pair[Word] = setting(
        ("loads as in training", "other loads"),
        "titles of the test trials, and of those of data.others",
    )
    seed: Annotated[
        int, Field(ge=0, lt=2**63, json_schema_extra={"wanted": "between 0 and 2^63 - 1"})
    ] = setting(0, "seed of all random numbers")
    tip: Place | None = setting(
        None, "vertices whose mean motion is reported, where there are no markers"
    )
    simulation: MaterialSettings = setting(description="material of the simulator to correct")
    target: TargetSettings | None = setting(
        None, "simulation that stands in for the real body where data are simulated"
    )
    data: DataSettings
    markers: MarkerSettings | None = setting(
        None, "observed markers; null: every vertex is observed, as in simulations"
    )
    sensors: dict[str, ForceSensorSettings] = setting(
        {}, "force sensors, by the name of their readings in the recordings"
    )
    laboratory: LaboratorySettings | None = setting(
        None, "simulation that stands in for the real body where there are no recordings"
    )
    published: PublishedSettings | None = setting(None, "simulation to compare with")
    identify: IdentifySettings | None = setting(None, "physical parameters to identify; null: none")
    law: Annotated[
        LawSettings | None,
        BeforeValidator(by_file, json_schema_input_type=LawSettings | str | None),
    ] = setting(None, "law of the material to identify; null: none")
    actuator: ActuatorSettings | None = setting(
        None, "learned changes of the inputs of actuators; null: none"
    )
    shapes: dict[str, ShapeSettings] = setting(
        {},
        "other bodies by name, on which the identified material is tested, "
        "where the real body is simulated",
    )
    reconstruction: ReconstructionSettings | None = setting(
        ReconstructionSettings(),
        "forces that explain the trials; null: none, "
        "so that neither a force nor SimFree is learned",
    )
    network: NetworkSettings = NetworkSettings()
    trainer: TrainerSettings = TrainerSettings()
    simfree: BaselineSettings = BaselineSettings()
    in_the_loop: InTheLoopSettings | None = setting(
        None,
        "training of the force on whole trials through the simulator; null: on reconstructed steps",
    )
    actuation: ActuationSettings = ActuationSettings()
    release: ReleaseSettings = ReleaseSettings()
    control: ControlSettings | None = setting(None, "paths that the robot follows; null: none")
    ablation: AblationSettings | None = setting(
        None, "study of the number of markers, in place of learning"
    )
    correct_uncorrected: bool = setting(
        False, "also learn a force for the simulator without identification"
    )
    force_frame: Literal["corotated", "world"] = setting(
        "world",
        "corotated: residual forces rotate with the body; world: "
        "they keep their directions, as published",
    )
    range_guard: bool = setting(True, "limit the inputs of networks to their training range")
    mesh_check: Annotated[float, Field(gt=1.0, le=4.0)] | None = setting(
        None,
        "refinement of a second mesh, whose short simulation shows the discretisation error; "
        "null: none",
    )
    timing: bool = setting(True, "time the models, one trial at a time")
    parallel: ParallelSettings = ParallelSettings()
    budget: Word = setting("full", "full or quick")

    @property
    def heading(self) -> str:
        """Title of its results."""
        return f"{self.title}, quick look" if self.budget == "quick" else self.title

    @property
    def recorded(self) -> RecordedData | None:
        """Data of bodies that are observed through markers; None where every vertex is observed."""
        return self.data if isinstance(self.data, RecordedData) else None

    @property
    def pictures(self) -> PictureData | None:
        """Data of bodies that cameras see in pictures; None for others."""
        return self.data.limited() if isinstance(self.data, PictureData) else None

    @property
    def material_tests(self) -> MaterialTestData | None:
        """Tests of specimens; None for other data."""
        return self.data if isinstance(self.data, MaterialTestData) else None

    @property
    def trial_data(self) -> RecordedData | SimulatedData:
        """Data of trials.

        Raises:
            InputError: the run has pictures or tests of specimens.
        """
        if isinstance(self.data, PictureData | MaterialTestData):
            raise InputError(
                f"data.kind is {self.data.kind}: "
                "it has no trials to show, to track or to learn from."
            )
        return self.data

    @property
    def is_laboratory(self) -> bool:
        """Whether a simulated laboratory generates the recordings."""
        return isinstance(self.data, RecordedData) and self.data.folder is None

    @property
    def targets(self) -> dict[str, TargetSettings]:
        """The simulation that stands in for the real body, by key.

        Empty if the data are recordings of a real body.
        """
        played = {"target": None if self.recorded is not None else self.target}
        played |= {"laboratory": self.laboratory if self.is_laboratory else None}
        return {key: settings for key, settings in played.items() if settings is not None}

    @property
    def bodies(self) -> dict[str, SteppedSettings]:
        """The simulator and its target, by the prefix of their keys, such as ``target.``."""
        return {"": self, **{f"{key}.": target for key, target in self.targets.items()}}

    @property
    def payload_at(self) -> Place | None:
        """Vertices that carry payloads."""
        return None if self.recorded is None else self.recorded.payload_at

    @property
    def train_fraction(self) -> float:
        """Share of each trial, from its start, that is used for training."""
        return 1.0 if self.recorded is None else self.recorded.train_fraction

    @property
    def trial_seconds(self) -> float | None:
        """Evaluated duration of a trial after its release [s]; None for all of it."""
        return None if self.recorded is None else self.recorded.seconds

    @property
    def horizons(self) -> tuple[float, ...]:
        """Durations over which errors are reported [s]."""
        return () if self.recorded is None else self.recorded.horizons

    @property
    def input_limit(self) -> float | None:
        """Largest input, in its unit."""
        return None if self.recorded is None else self.recorded.input_limit

    @property
    def input_scales(self) -> tuple[float, ...]:
        """Factors of the inputs for additional test trials."""
        return () if self.recorded is None else self.recorded.input_scales

    @property
    def with_law(self) -> bool:
        """Whether the law of the material is identified."""
        return self.law is not None

    @property
    def with_actuator(self) -> bool:
        """Whether changes of the inputs are learned."""
        return self.actuator is not None

    @property
    def binding(self) -> BindingSettings:
        """Positions of markers, and how they are bound to the body."""
        assert self.markers is not None
        return self.markers

    @property
    def batch(self) -> int | None:
        """Trials that a process simulates at once."""
        return self.parallel.batch

    @property
    def models(self) -> list[str]:
        """Names of the models that the run compares."""
        learned = self.with_law, self.with_actuator, self.reconstruction is not None
        return models_of(self.published, self.identify, self.correct_uncorrected, *learned)

    def training_of(self, model: str) -> TrainingSettings:
        """Settings of the training of a model; ``simfree`` has its own, and is trained on steps.

        Raises:
            InputError: settings that contradict each other.
        """
        groups, key = (self, "") if model != "simfree" else (self.simfree, "simfree")
        in_the_loop = self.in_the_loop if model != "simfree" else None
        values = {
            "network": groups.network,
            "trainer": groups.trainer,
            "in_the_loop": in_the_loop,
            "seed": self.seed,
        }
        return parse(TrainingSettings, values, key)

    def motions(self) -> dict[str, MotionSettings]:
        """Returns the configured motions of the base and of obstacles by dotted key."""
        common = self.data.base_motion
        motions = {"data.base_motion": common} if isinstance(common, MotionSettings) else {}
        motions |= {
            f"data.obstacle_motion.{name}": motion
            for name, motion in self.data.obstacle_motion.items()
            if isinstance(motion, MotionSettings)
        }
        tables = (
            {} if self.recorded is None or self.is_laboratory else {"data": self.recorded.trials}
        )
        tables |= (
            {}
            if self.laboratory is None or not self.is_laboratory
            else {"laboratory": self.laboratory.trials}
        )
        for group, trials in tables.items():
            for name, trial in trials.items():
                if trial.base_motion is not None:
                    motions[f"{group}.trials.{name}.base_motion"] = trial.base_motion
                for obstacle, motion in trial.obstacle_motion.items():
                    motions[f"{group}.trials.{name}.obstacle_motion.{obstacle}"] = motion
        return motions


def models_of(
    published: Any,
    identified: IdentifySettings | None,
    correct_uncorrected: bool,
    law: bool = False,
    actuator: bool = False,
    forces: bool = True,
) -> list[str]:
    """Returns the names of the models that an experiment compares.

    Args:
        published: settings of the published simulation, or None.
        identified: settings of the identified simulator, or None.
        correct_uncorrected: whether a force is learned for the uncorrected simulator as well.
        law: whether the law of the material is identified.
        actuator: whether changes of the inputs are learned.
        forces: whether forces are reconstructed, from which networks learn.
    """
    absent = {
        "published": published is None,
        "sysid": identified is None,
        "sysid_elastic": identified is None or not identified.elastic,
        "law": not law,
        "actuator": not actuator,
        "simfree": not forces,
        "resphys_uncorrected": identified is None or not correct_uncorrected or not forces,
    }
    return [model for model in get_args(Model) if not absent.get(model)]
