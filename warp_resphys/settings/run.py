"""`RunSettings`: the whole configuration of a run, and the checks of relations between its groups.

Checks that need the mesh, the trials or their files are in `experiment.checks`.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BeforeValidator, Field, model_validator

from ..io.errors import InputError, listed
from ..io.settings import Natural, Pair, Settings, Word, parse, setting
from .body import Integrator, MaterialSettings, PhysicsSettings, SimulatorSettings, SteppedSettings, TargetSettings
from .control import ControlSettings, Model
from .learning import (
    AblationSettings,
    ActuationSettings,
    BaselineSettings,
    IdentifiedSettings,
    IdentifySettings,
    InTheLoopSettings,
    LawSettings,
    NetworkSettings,
    ReconstructionSettings,
    ReleaseSettings,
    TrainerSettings,
    TrainingSettings,
)
from .mesh import PlaceSettings
from .pictures import PictureData
from .shapes import ShapeSettings
from .trials import (
    BindingSettings,
    LaboratorySettings,
    MarkerSettings,
    MotionSettings,
    MovingBase,
    RecordedData,
    ReleaseFromLoad,
    ReleaseFromTwist,
    SimulatedData,
    by_file,
)

Name = Annotated[
    str,
    Field(pattern=r"^[\w-]+$", json_schema_extra={"wanted": "letters, digits, _ and - alone, as it names a folder"}),
]

DataSettings = Annotated[
    RecordedData | ReleaseFromLoad | ReleaseFromTwist | MovingBase | PictureData, Field(discriminator="kind")
]

_LEAST_STEPS = 20  # of a path that is followed


class ParallelSettings(Settings):
    """Processes that share the work."""

    processes: Natural | None = setting(1, "number of processes; null: one for each core")
    address: Word | None = setting(
        None, "address of a Dask cluster with the same folders, such as tcp://head:8786; null: this machine"
    )
    batch: Natural | None = setting(None, "trials that a process simulates at once; null: all")


class PublishedSettings(Settings):
    """A published simulation, for comparison."""

    simulation: MaterialSettings = setting(description="its material")
    physics: PhysicsSettings = setting(description="its masses and volumes")
    integrator: Integrator = setting(description="its time integrator")


class RunSettings(SimulatorSettings):
    """The configuration of a run."""

    name: Name = setting(description="name of the experiment and of the folder of its runs")
    title: Word = setting(description="title of the report")
    test_titles: Pair[Word] = setting(
        ("loads as in training", "other loads"), "titles of the test trials, and of those of data.others"
    )
    seed: Annotated[int, Field(ge=0, lt=2**63, json_schema_extra={"wanted": "between 0 and 2^63 - 1"})] = setting(
        0, "seed of all random numbers"
    )
    tip: PlaceSettings | None = setting(None, "vertices whose mean motion is reported, where there are no markers")
    simulation: MaterialSettings = setting(description="material of the simulator to correct")
    target: TargetSettings | None = setting(
        None, "simulation that stands in for the real body where data are simulated"
    )
    data: DataSettings
    markers: MarkerSettings | None = setting(
        None, "observed markers; null: every vertex is observed, as in simulations"
    )
    laboratory: LaboratorySettings | None = setting(
        None, "simulation that stands in for the real body where there are no recordings"
    )
    published: PublishedSettings | None = setting(None, "simulation to compare with")
    identify: IdentifySettings | None = setting(None, "physical parameters to identify; null: none")
    law: Annotated[LawSettings | None, BeforeValidator(by_file, json_schema_input_type=LawSettings | str | None)] = (
        setting(None, "law of the material to identify; null: none")
    )
    shapes: dict[str, ShapeSettings] = setting(
        {}, "other bodies by name, on which the identified material is tested, where the real body is simulated"
    )
    reconstruction: ReconstructionSettings = ReconstructionSettings()
    network: NetworkSettings = NetworkSettings()
    trainer: TrainerSettings = TrainerSettings()
    simfree: BaselineSettings = BaselineSettings()
    in_the_loop: InTheLoopSettings | None = setting(
        None, "training of the force on whole trials through the simulator; null: on reconstructed steps"
    )
    actuation: ActuationSettings = ActuationSettings()
    release: ReleaseSettings = ReleaseSettings()
    control: ControlSettings | None = setting(None, "paths that the robot follows; null: none")
    ablation: AblationSettings | None = setting(None, "study of the number of markers, in place of learning")
    correct_uncorrected: bool = setting(False, "also learn a force for the simulator without identification")
    force_frame: Literal["corotated", "world"] = setting(
        "world", "corotated: residual forces rotate with the body; world: they keep their directions, as published"
    )
    range_guard: bool = setting(True, "limit the inputs of networks to their training range")
    mesh_check: Annotated[float, Field(gt=1.0, le=4.0)] | None = setting(
        None, "refinement of a second mesh, whose short simulation shows the discretisation error; null: none"
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
    def trial_data(self) -> RecordedData | SimulatedData:
        """Data of trials.

        Raises:
            InputError: the run has pictures.
        """
        if isinstance(self.data, PictureData):
            raise InputError("data.kind is pictures: they have no trials to show, to track or to learn from.")
        return self.data

    @property
    def is_laboratory(self) -> bool:
        """Whether a simulated laboratory generates the recordings."""
        return isinstance(self.data, RecordedData) and self.data.folder is None

    @property
    def targets(self) -> dict[str, TargetSettings]:
        """The simulation that stands in for the real body, by key; empty if the data are recordings of a real body."""
        own = {"target": None if self.recorded is not None else self.target}
        own |= {"laboratory": self.laboratory if self.is_laboratory else None}
        return {key: settings for key, settings in own.items() if settings is not None}

    @property
    def bodies(self) -> dict[str, SteppedSettings]:
        """The simulator and its target, by the prefix of their keys, such as ``target.``."""
        return {"": self, **{f"{key}.": target for key, target in self.targets.items()}}

    @property
    def payload_at(self) -> PlaceSettings | None:
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
    def identified(self) -> IdentifiedSettings | None:
        """Differences of the identified simulator; None where nothing is identified."""
        return None if self.identify is None else IdentifiedSettings.of(self.identify)

    @property
    def with_law(self) -> bool:
        """Whether the law of the material is identified."""
        return self.law is not None

    @property
    def binding(self) -> BindingSettings:
        """Positions of markers, and how they are bound to the body."""
        assert self.markers is not None
        return BindingSettings.of(self.markers)

    @property
    def batch(self) -> int | None:
        """Trials that a process simulates at once."""
        return self.parallel.batch

    @property
    def models(self) -> list[str]:
        """Names of the models that the run compares."""
        return models_of(self.published, self.identify, self.correct_uncorrected, self.with_law)

    def training_of(self, model: str) -> TrainingSettings:
        """Settings of the training of a model; ``simfree`` has its own, and is trained on steps.

        Raises:
            InputError: settings that contradict each other.
        """
        groups, key = (self, "") if model != "simfree" else (self.simfree, "simfree")
        in_the_loop = self.in_the_loop if model != "simfree" else None
        values = {"network": groups.network, "trainer": groups.trainer, "in_the_loop": in_the_loop, "seed": self.seed}
        return parse(TrainingSettings, values, key)

    @model_validator(mode="before")
    @classmethod
    def _left_out(cls, values: Any) -> Any:
        return filled(values)

    @model_validator(mode="after")
    def _markers_and_data(self) -> Self:
        if (self.markers is None) != (self.recorded is None):
            if self.markers is None:
                raise ValueError("markers is null, but data.kind is recorded: name the markers, with their places.")
            raise ValueError(
                f"data.kind is {self.data.kind!r}, in which all vertices are observed: leave markers null."
            )
        if self.pictures is not None:
            if self.identify is None:
                raise ValueError("identify is null, but data.kind is pictures: name parameters to identify.")
            return self
        if self.tip is None:
            raise ValueError("tip is null: name the vertices whose mean motion is reported, such as {x: 0.1}.")
        if self.shapes and (self.recorded is not None or (self.identify is None and self.law is None)):
            why = "nothing is identified" if self.recorded is None else "data.kind is recorded"
            raise ValueError(
                f"shapes are bodies with the identified material of a simulated target, but {why}: leave shapes out."
            )
        if self.recorded is None and self.target is None:
            raise ValueError(
                "target is null: give the simulation that stands in for the real body, such as its material."
            )
        if self.is_laboratory and self.laboratory is None:
            raise ValueError("data.folder is not set: give the folder of the recordings.")
        if self.mesh_check is not None and self.markers is None:
            raise ValueError("mesh_check compares markers, but markers is null: leave it null, too.")
        if self.reconstruction.modes is not None and self.markers is None:
            raise ValueError("reconstruction.modes is for bodies that are observed through markers: leave it out.")
        if self.ablation is not None:
            weights = self.data.weights_g.observed if isinstance(self.data, ReleaseFromLoad) else ()
            if len(weights) != 1:
                raise ValueError(f"data.weights_g.observed is {list(weights)}: it must be a list of one weight, in g.")
        return self

    @model_validator(mode="after")
    def _training(self) -> Self:
        for model in ("resphys", "simfree"):
            self.training_of(model)
        return self

    @model_validator(mode="after")
    def _times(self) -> Self:
        data, trials = self.recorded, {} if self.laboratory is None else self.laboratory.trials
        frequencies = {
            f"{key}.swings.{name}.frequency": swing.frequency
            for key, motion in self.motions().items()
            for name, swing in (motion.swings or {}).items()
        }
        waves = {name: trial.waves for name, trial in trials.items() if trial.waves is not None}
        frequencies |= {f"laboratory.trials.{name}.waves.frequency": own.frequency for name, own in waves.items()}
        frequencies |= {} if data is None or data.cutoff is None else {"data.cutoff": data.cutoff}
        for key, frequency in frequencies.items():
            if 2.0 * frequency * self.time_step >= 1.0:
                raise ValueError(
                    f"{key} is {frequency:g} Hz: it must be below {0.5 / self.time_step:g} Hz, half of the steps."
                )
        return self

    def motions(self) -> dict[str, MotionSettings]:
        """Returns the configured motions of the base and of obstacles by dotted key."""
        common = self.data.base_motion
        motions = {"data.base_motion": common} if isinstance(common, MotionSettings) else {}
        motions |= {
            f"data.obstacle_motion.{name}": motion
            for name, motion in self.data.obstacle_motion.items()
            if isinstance(motion, MotionSettings)
        }
        tables = {} if self.recorded is None or self.is_laboratory else {"data": self.recorded.trials}
        tables |= {} if self.laboratory is None or not self.is_laboratory else {"laboratory": self.laboratory.trials}
        for group, trials in tables.items():
            for name, trial in trials.items():
                if trial.base_motion is not None:
                    motions[f"{group}.trials.{name}.base_motion"] = trial.base_motion
                for obstacle, motion in trial.obstacle_motion.items():
                    motions[f"{group}.trials.{name}.obstacle_motion.{obstacle}"] = motion
        return motions

    @model_validator(mode="after")
    def _holds_its_base(self) -> Self:
        moved = [key for key in self.motions() if key.endswith("base_motion")]
        moved += ["data.base_motion"] if self.data.base_motion is not None else []
        for prefix, body in self.bodies.items():
            if moved and body.fixed is None:
                raise ValueError(
                    f"{moved[0]} moves the fixed vertices, but {prefix}fixed is null: name some, or leave it out."
                )
        return self

    @model_validator(mode="after")
    def _moves_obstacles(self) -> Self:
        common = self.data.obstacle_motion
        recorded = [name for name, motion in common.items() if motion == "recorded"]
        keys = {f"data.obstacle_motion.{name}": name for name in recorded}
        keys |= {key: key.rpartition(".")[2] for key in self.motions() if ".obstacle_motion." in key}
        for key, name in keys.items():
            for prefix, body in self.bodies.items():
                if name not in body.obstacles:
                    has = listed([*body.obstacles]) if body.obstacles else "none"
                    raise ValueError(f"{key} is of {name!r}, but {prefix}obstacles has {has}: choose one of them.")
                if not body.obstacles[name].moves:
                    raise ValueError(f"{key} moves {name!r}: set {prefix}obstacles.{name}.moves to true.")
        if recorded and self.markers is not None:
            taken = {*self.markers.tracked, *self.markers.reference, *self.markers.rigid_bodies}
            if self.markers.labels == "assigned":
                raise ValueError(
                    f"data.obstacle_motion.{recorded[0]} is recorded by a marker of its name, but markers.labels is "
                    "assigned: use recordings with names, or give the motion."
                )
            if both := [name for name in recorded if name in taken]:
                raise ValueError(
                    f"data.obstacle_motion.{both[0]} is recorded by a marker of its name, which is one of the body, "
                    "too: give the obstacle another name."
                )
        return self

    @model_validator(mode="after")
    def _view(self) -> Self:
        """Checks settings that need more than the recordings tell about the positions of markers."""
        data, markers = self.recorded, self.markers
        if data is None or markers is None:
            return self
        if data.base_motion == "reference" and len(markers.reference) < 3:
            raise ValueError(
                "data.base_motion is reference: name three markers or more, not on a line, in markers.reference."
            )
        if markers.plane is not None and data.axes is None:
            raise ValueError(
                "markers.plane is set, but data.axes is not: name the axes of the recordings along which the body's x, "
                "y and z are, which define the axis that is not observed."
            )
        if markers.frame == "own" and (data.base_motion is not None or data.obstacle_motion or self.motions()):
            raise ValueError(
                "markers.frame is own, but base_motion and obstacle_motion need to know where the body is: take one of "
                "them out."
            )
        whole = markers.plane is None and markers.frame == "body"
        if not whole and self.identify is not None and self.identify.placement is not None:
            raise ValueError(
                "identify.placement is set, but with markers.plane, or markers.frame own, recordings do not determine "
                "positions of markers and pose of the body: set it to null."
            )
        return self

    @model_validator(mode="after")
    def _follows(self) -> Self:
        control, data = self.control, self.recorded
        if control is None:
            return self
        if data is None or self.markers is None or data.folds is not None:
            raise ValueError(
                "control is for a robot with markers and inputs, of one split of its trials: set control=none, or "
                "data.folds=null."
            )
        simulated: list[str] = [model for model in self.models if model != "simfree"]
        for key, models in (("models", control.models), ("receding", control.receding)):
            if unknown := [model for model in models if model not in simulated]:
                raise ValueError(f"control.{key} has {unknown[0]}: this experiment has {', '.join(simulated)}.")
        if not {*control.receding} <= {*control.models}:
            raise ValueError(f"control.receding must be among control.models, which are {', '.join(control.models)}.")
        if missing := [label for label in control.tracked if label not in self.markers.tracked]:
            tracked = ", ".join(self.markers.tracked)
            raise ValueError(f"control.tracked names '{missing[0]}': markers.tracked has {tracked}.")
        limits = control.limits
        if not limits.low < limits.high or (data.input_limit is not None and limits.high > data.input_limit):
            raise ValueError(
                f"control.limits are from {limits.low:g} to {limits.high:g}: they must rise, to data.input_limit of "
                f"{data.input_limit:g} at most, the largest input of the training."
            )
        if short := [seconds for seconds in control.seconds if seconds < _LEAST_STEPS * self.time_step]:
            raise ValueError(f"control.seconds has {short[0]:g}: a path takes {_LEAST_STEPS} steps at least.")
        return self


def models_of(
    published: Any, identified: IdentifiedSettings | None, correct_uncorrected: bool, law: bool = False
) -> list[str]:
    """Returns the names of the models that an experiment compares.

    Args:
        published: settings of the published simulation, or None.
        identified: settings of the identified simulator, or None.
        correct_uncorrected: whether a force is learned for the uncorrected simulator as well.
        law: whether the law of the material is identified.
    """
    absent = {
        "published": published is None,
        "sysid": identified is None,
        "sysid_elastic": identified is None or not identified.elastic,
        "law": not law,
        "resphys_uncorrected": identified is None or not correct_uncorrected,
    }
    return [model for model in get_args(Model) if not absent.get(model)]


def filled(values: Any) -> Any:
    """Returns the plain values of a run, with the keys that some groups leave out copied from other groups.

    These are ``network`` and ``trainer`` of ``simfree``, and in ``target`` and ``laboratory`` all keys of
    `TargetSettings`, with ``simulation`` as the material. Numbers and the model of a material may stand directly in
    ``target``; null takes one out.
    """
    if not isinstance(values, Mapping):
        return values
    values = dict(values)
    simfree = _mapping(values.get("simfree", {}))
    if simfree is not None and {*simfree} <= {"network", "trainer"}:
        merged: dict[str, Any] = {}
        for key in ("network", "trainer"):
            whole, changes = _mapping(values.get(key, {})), _mapping(simfree.get(key, {}))
            merged[key] = simfree.get(key) if whole is None or changes is None else {**whole, **changes}
        values["simfree"] = merged
    keys = TargetSettings.model_fields
    common = {key: values.get(key) for key, field in keys.items() if key in values or field.is_required()}
    for group in ("target", "laboratory"):
        own = values.get(group)
        if isinstance(own, Mapping):
            direct = {key for key, value in own.items() if key not in keys and not isinstance(value, Mapping)}
            constants = {key: own[key] for key in direct} if group == "target" else {}
            material = _mapping(own.get("material", {}))
            if constants and material is not None:
                own = {key: value for key, value in own.items() if key not in constants}
                own["material"] = {key: value for key, value in {**constants, **material}.items() if value is not None}
            values[group] = {**common, "material": values.get("simulation"), **own}
    return values


def _mapping(values: Any) -> Mapping[str, Any] | None:
    """Returns a group as a mapping; None for any other value."""
    if isinstance(values, Settings):
        return values.plain()
    return values if isinstance(values, Mapping) else None
