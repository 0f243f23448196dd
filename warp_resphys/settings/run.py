"""`RunSettings`: the whole configuration of a run, and the relations between its groups.

What needs a mesh, the trials or their files is checked where these are made; see `experiment.checks`.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Field, model_validator

from ..io.settings import Natural, Settings, Word, parse, setting
from .body import Integrator, MaterialSettings, PhysicsSettings, PlaceSettings, SimulatorSettings
from .control import ControlSettings, Model
from .learning import (
    AblationSettings,
    ActuationSettings,
    BaselineSettings,
    IdentifiedSettings,
    IdentifySettings,
    InTheLoopSettings,
    NetworkSettings,
    ReconstructionSettings,
    RefinementSettings,
    ReleaseSettings,
    TrainerSettings,
    TrainingSettings,
)
from .trials import (
    BindingSettings,
    DataSettings,
    LaboratorySettings,
    MarkerSettings,
    MotionSettings,
    RecordedData,
    ReleaseFromLoad,
)

Name = Annotated[
    str,
    Field(pattern=r"^[\w-]+$", json_schema_extra={"wanted": "letters, digits, _ and - alone, as a folder is named so"}),
]
_LEAST_STEPS = 20  # of a figure that is followed


class ParallelSettings(Settings):
    """Processes that share the work."""

    processes: Natural | None = setting(1, "that share the trials; null: one a core")
    backend: Literal["local", "ray", "dask"] = setting(
        "local", "processes of this machine; or of a cluster with the same folders"
    )
    address: Word | None = setting(None, "of the cluster, as ray://head:10001; null: one on this machine")
    batch: Natural | None = setting(None, "trials that a process simulates at once; null: all")


class PublishedSettings(Settings):
    """A simulation to compare with."""

    simulation: MaterialSettings = setting(description="its material")
    physics: PhysicsSettings = setting(description="its masses and volumes")
    integrator: Integrator = setting(description="its integrator")


class RunSettings(SimulatorSettings):
    """The configuration of a run."""

    name: Name = setting(description="of the experiment; the folder of its runs")
    title: Word = setting(description="of the report")
    seed: Annotated[int, Field(ge=0, lt=2**63, json_schema_extra={"wanted": "between 0 and 2^63 - 1"})] = setting(
        0, "of all that is drawn"
    )
    tip: PlaceSettings = setting(description="vertices whose mean the report follows, where there are no markers")
    simulation: MaterialSettings = setting(description="material of the simulator to correct")
    target: MaterialSettings | None = setting(None, "material of the simulation that plays the real body")
    data: DataSettings
    markers: MarkerSettings | None = setting(
        None, "what is seen of the body; null: every vertex, as a simulation knows"
    )
    laboratory: LaboratorySettings | None = setting(None, "plays the real body where there are no recordings")
    published: PublishedSettings | None = setting(None, "simulation to compare with")
    identify: IdentifySettings | None = setting(None, "physical parameters to identify; null: none")
    reconstruction: ReconstructionSettings = ReconstructionSettings()
    network: NetworkSettings = NetworkSettings()
    trainer: TrainerSettings = TrainerSettings()
    simfree: BaselineSettings = BaselineSettings()
    in_the_loop: InTheLoopSettings | None = setting(
        None, "training of the force on whole trials through the simulator; null: on reconstructed steps"
    )
    refinement: RefinementSettings | None = setting(None, "further training through the simulator; null: none")
    actuation: ActuationSettings = ActuationSettings()
    release: ReleaseSettings = ReleaseSettings()
    control: ControlSettings | None = setting(None, "figures that the robot follows; null: none")
    ablation: AblationSettings | None = setting(None, "how many markers it takes, in place of learning")
    correct_uncorrected: bool = setting(
        False, "whether a force is learned for the simulator without identification, too"
    )
    force_frame: Literal["corotated", "world"] = setting(
        "world",
        "residual forces keep their directions, as published; corotated: they turn with the body at each vertex",
    )
    range_guard: bool = setting(
        True, "roll-outs hold what a network sees within what it saw in training, and say when it would leave that"
    )
    mesh_check: Annotated[float, Field(gt=1.0, le=4.0)] | None = setting(
        None, "so many times as many cells, 1.5 or 2, tell what the mesh changes in the markers of the test trials"
    )
    timing: bool = setting(True, "whether models are timed, one trial at a time")
    parallel: ParallelSettings = ParallelSettings()
    budget: Word = setting("full", "full or quick")
    tuned: Word = setting("none", "settings that a search found; files of configs/tuned")
    tune: dict[str, Any] = setting({}, "the search of warp-resphys tune; see there")

    @property
    def recorded(self) -> RecordedData | None:
        """Data of bodies that are seen through markers; None where every vertex is."""
        return self.data if isinstance(self.data, RecordedData) else None

    @property
    def is_laboratory(self) -> bool:
        """Whether there are no recordings, so that a simulated laboratory makes them."""
        return isinstance(self.data, RecordedData) and self.data.folder is None

    @property
    def payload_at(self) -> PlaceSettings | None:
        """Vertices that carry payloads."""
        return None if self.recorded is None else self.recorded.payload_at

    @property
    def train_fraction(self) -> float:
        """Share of each trial, from its start, that is learned from."""
        return 1.0 if self.recorded is None else self.recorded.train_fraction

    @property
    def trial_seconds(self) -> float | None:
        """How much of a trial counts after its release [s]."""
        return None if self.recorded is None else self.recorded.seconds

    @property
    def horizons(self) -> tuple[float, ...]:
        """Times for which errors are given [s]."""
        return () if self.recorded is None else self.recorded.horizons

    @property
    def input_limit(self) -> float | None:
        """Largest input, in its unit."""
        return None if self.recorded is None else self.recorded.input_limit

    @property
    def input_scales(self) -> tuple[float, ...]:
        """Factors of the inputs at which test trials are run as well."""
        return () if self.recorded is None else self.recorded.input_scales

    @property
    def identified(self) -> IdentifiedSettings | None:
        """What makes the identified simulator another one; None where nothing is identified."""
        return None if self.identify is None else IdentifiedSettings.of(self.identify)

    @property
    def binding(self) -> BindingSettings:
        """Where markers are and how they are bound."""
        assert self.markers is not None
        return BindingSettings.of(self.markers)

    @property
    def batch(self) -> int | None:
        """Trials that a process simulates at once."""
        return self.parallel.batch

    @property
    def models(self) -> list[str]:
        """Names of the models that the run compares."""
        return models_of(self.published, self.identify, self.correct_uncorrected)

    def training(self, model: str) -> TrainingSettings:
        """What a model is trained with; of ``simfree``, which is trained on steps, the groups of its own.

        Raises:
            InputError: settings that do not fit each other.
        """
        own, at = (self, "") if model != "simfree" else (self.simfree, "simfree")
        in_the_loop = self.in_the_loop if model != "simfree" else None
        values = {"network": own.network, "trainer": own.trainer, "in_the_loop": in_the_loop, "seed": self.seed}
        return parse(TrainingSettings, values, at)

    @model_validator(mode="before")
    @classmethod
    def _baseline(cls, values: Any) -> Any:
        return with_baseline(values)

    @model_validator(mode="after")
    def _markers_and_data(self) -> Self:
        if self.dtype != "float64":
            raise ValueError("dtype is 'float32': experiments need float64; float32 is for roll-outs in Python.")
        if (self.markers is None) != (self.recorded is None):
            if self.markers is None:
                raise ValueError("markers is null, but data.kind is recorded: name the markers, with their places.")
            raise ValueError(f"data.kind is {self.data.kind!r}, whose vertices are all known: leave markers null.")
        if self.recorded is None and self.target is None:
            raise ValueError("target is null: give the material of the simulation that plays the real body.")
        if self.is_laboratory and self.laboratory is None:
            raise ValueError("data.folder is not set: give the folder of the recordings.")
        if self.mesh_check is not None and self.markers is None:
            raise ValueError("mesh_check compares markers, but markers is null: leave it null, too.")
        if self.reconstruction.modes is not None and self.markers is None:
            raise ValueError("reconstruction.modes is for bodies that are seen through markers: leave it out.")
        if self.ablation is not None:
            weights = self.data.weights_g.observed if isinstance(self.data, ReleaseFromLoad) else ()
            if len(weights) != 1:
                raise ValueError(f"data.weights_g.observed is {list(weights)}: it must be a list of one weight, in g.")
        return self

    @model_validator(mode="after")
    def _drives(self) -> Self:
        commanded = {
            "chambers": self.chambers is not None,
            "tendons": self.tendons is not None,
            "muscles": self.muscles is not None and self.muscles.commanded is not None,
        }
        driven = [group for group, is_driven in commanded.items() if is_driven]
        if len(driven) > 1:
            raise ValueError(
                f"{driven[0]} and {driven[1]} are two inputs of the body, and recordings drive one: take one out."
            )
        if self.fibres is not None and self.chambers is None:
            raise ValueError("fibres are wound around chambers, but chambers is null: leave the fibres out.")
        if self.payload_string is not None and self.payload_at is None:
            raise ValueError("payload_string is set, but data.payload_at is not: name the vertices that carry it.")
        if self.identify is not None and "fibre_stiffness" in self.identify.parameters and self.fibres is None:
            raise ValueError("identify.parameters names fibre_stiffness, but fibres is null: give the simulator some.")
        return self

    @model_validator(mode="after")
    def _holds_rigid_parts(self) -> Self:
        used = {"integrator": self.integrator}
        used |= {} if self.identify is None else {"identify.integrator": self.identify.integrator or self.integrator}
        if self.is_laboratory and self.laboratory is not None:
            used["laboratory.integrator"] = self.laboratory.integrator
        for key in [key for key, each in used.items() if self.rigid and each == "midpoint"]:
            raise ValueError(f"{key} is midpoint, by which rigid parts ring: choose implicit_euler or bdf2.")
        return self

    @model_validator(mode="after")
    def _training(self) -> Self:
        for model in ("resphys", "simfree"):
            self.training(model)
        refinement = self.refinement
        if refinement is None:
            return self
        if self.payload_string is not None:
            raise ValueError(
                "refinement begins anew in every window, where nothing tells how a weight on a string swings: set "
                "refinement to none, or payload_string to null."
            )
        if self.network.recurrent is not None:
            raise ValueError(
                "refinement begins anew in every window, and network.recurrent lives on what was before: set one of "
                "them to none, or null."
            )
        if self.data.steps is not None and refinement.window >= self.data.steps:
            raise ValueError(
                f"refinement.window is {refinement.window}: it must be less than the data's {self.data.steps} steps."
            )
        return self

    @model_validator(mode="after")
    def _times(self) -> Self:
        for key, motion in self.motions().items():
            for name, swing in (motion.swings or {}).items():
                if 2.0 * swing.frequency * self.time_step >= 1.0:
                    raise ValueError(
                        f"{key}.swings.{name}.frequency is {swing.frequency:g}: steps of {self.time_step:g} s follow "
                        f"less than {0.5 / self.time_step:g} Hz."
                    )
        data = self.recorded
        if data is not None and data.cutoff is not None and not data.cutoff < 0.5 / self.time_step:
            raise ValueError(
                f"data.cutoff is {data.cutoff:g} Hz: it must be below {0.5 / self.time_step:g} Hz, half of the steps."
            )
        return self

    def motions(self) -> dict[str, MotionSettings]:
        """Motions of the base that are given beforehand, by their dotted key."""
        common = self.data.base_motion
        found = {"data.base_motion": common} if isinstance(common, MotionSettings) else {}
        tables = {} if self.recorded is None or self.is_laboratory else {"data": self.recorded.trials}
        tables |= {} if self.laboratory is None or not self.is_laboratory else {"laboratory": self.laboratory.trials}
        for group, trials in tables.items():
            own = {f"{group}.trials.{name}.base_motion": each.base_motion for name, each in trials.items()}
            found |= {key: motion for key, motion in own.items() if motion is not None}
        return found

    @model_validator(mode="after")
    def _view(self) -> Self:
        """What can be had of markers whose places recordings do not tell."""
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
                "y and z are, so that it is known which one is not seen."
            )
        if markers.frame == "own" and (data.base_motion is not None or self.motions()):
            raise ValueError("markers.frame is own, but a base_motion tells where the body is: take one of them out.")
        whole = markers.plane is None and markers.frame == "body"
        if not whole and self.identify is not None and self.identify.placement is not None:
            raise ValueError(
                "identify.placement is set, but with markers.plane, or markers.frame own, recordings do not tell where "
                "markers sit and how the body lies: set it to null."
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
        known: list[str] = [model for model in self.models if model != "simfree"]
        for key, models in (("models", control.models), ("receding", control.receding)):
            unknown = [model for model in models if model not in known]
            if unknown:
                raise ValueError(f"control.{key} has {unknown[0]}: this experiment has {', '.join(known)}.")
        if not {*control.receding} <= {*control.models}:
            raise ValueError(f"control.receding must be among control.models, which are {', '.join(control.models)}.")
        odd = [label for label in control.tracked if label not in self.markers.tracked]
        if odd:
            tracked = ", ".join(self.markers.tracked)
            raise ValueError(f"control.tracked names '{odd[0]}': markers.tracked has {tracked}.")
        limits = control.limits
        if not limits.low < limits.high or (data.input_limit is not None and limits.high > data.input_limit):
            raise ValueError(
                f"control.limits are from {limits.low:g} to {limits.high:g}: they must rise, to data.input_limit of "
                f"{data.input_limit:g} at most, which is what was learned from."
            )
        short = [seconds for seconds in control.seconds if seconds < _LEAST_STEPS * self.time_step]
        if short:
            raise ValueError(f"control.seconds has {short[0]:g}: a figure takes {_LEAST_STEPS} steps at least.")
        return self


def models_of(published: Any, identified: IdentifiedSettings | None, correct_uncorrected: bool) -> list[str]:
    """Names of the models that an experiment compares.

    Args:
        published: settings of the published simulation; None for none.
        identified: settings of the identified simulator; None for none.
        correct_uncorrected: whether a force is learned for the uncorrected simulator, too.
    """
    absent = {
        "published": published is None,
        "sysid": identified is None,
        "sysid_elastic": identified is None or not identified.elastic,
        "resphys_uncorrected": identified is None or not correct_uncorrected,
    }
    return [model for model in get_args(Model) if not absent.get(model)]


def with_baseline(values: Any) -> Any:
    """Plain values of a run in which the group simfree has what it leaves out of the groups network and trainer."""
    own = _mapping(values.get("simfree", {})) if isinstance(values, Mapping) else None
    if own is None or not {*own} <= {"network", "trainer"}:
        return values
    merged: dict[str, Any] = {}
    for key in ("network", "trainer"):
        common, different = _mapping(values.get(key, {})), _mapping(own.get(key, {}))
        merged[key] = own.get(key) if common is None or different is None else {**common, **different}
    return {**values, "simfree": merged}


def _mapping(values: Any) -> Mapping[str, Any] | None:
    """Nested settings as a mapping; None for what is none."""
    if isinstance(values, Settings):
        return values.plain()
    return values if isinstance(values, Mapping) else None
