"""Settings of trials: where they come from, how they begin, what is seen of them, and how they are split."""

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from ..io.settings import Count, Many, Natural, NotNegative, Positive, Settings, Share, Some, Vector, Word, setting
from .body import (
    Direction,
    FibreSettings,
    Integrator,
    LengthUnit,
    MaterialSettings,
    MeshSettings,
    PlaceSettings,
    TimeStep,
)

# Held at rest until it is let go; let go with the first frame; at rest until its inputs come; a pose without time.
Begins = Literal["held", "released", "rest", "static"]
Axis = Literal["x", "y", "z"]
SignedAxis = Literal["x", "-x", "y", "-y", "z", "-z"]


def different(values: tuple[Any, ...]) -> tuple[Any, ...]:
    """Refuses a list in which a value occurs twice."""
    if len({*values}) < len(values):
        raise ValueError("a value occurs twice: it must be a list of different ones.")
    return values


def _rising(values: tuple[float, ...]) -> tuple[float, ...]:
    if list(values) != sorted({*values}):
        raise ValueError("they must rise.")
    return values


Labels = Annotated[Some[Word], AfterValidator(different)]
Trials = Count | Many[Word]


class SwingSettings(Settings):
    """A sinusoid of a base's motion."""

    frequency: Positive = setting(unit="Hz")
    translation: Vector = setting((0.0, 0.0, 0.0), "amplitudes along x, y and z", "m")
    rotation: Vector = setting((0.0, 0.0, 0.0), "amplitudes about x, y and z", "rad")
    phase: float = setting(0.0, "at time zero", "rad")


class MotionSettings(Settings):
    """How what a body is fixed to moves: a table of poses in a file, or a sum of sinusoids."""

    file: Word | None = setting(None, "table of poses, in the folder of the recordings")
    swings: dict[str, SwingSettings] | None = setting(None, "sinusoids, by any names")
    about: Vector = setting((0.0, 0.0, 0.0), "point whose translation is given and that rotations leave alone", "m")
    start: NotNegative = setting(0.0, "time until which nothing moves", "s")
    ramp: NotNegative = setting(0.0, "time in which amplitudes grow from zero", "s")

    @model_validator(mode="after")
    def _has_one(self) -> Self:
        if (self.file is None) == (self.swings is None):
            raise ValueError("file and swings: give one of them, a table of poses or sinusoids by any names.")
        if self.swings is not None and not self.swings:
            raise ValueError("swings is empty: give one at least, as {a: {frequency: 1.0, translation: [0.01, 0, 0]}}.")
        return self


BaseMotion = MotionSettings | Literal["recorded", "reference"] | None


class TrialSettings(Settings):
    """What is configured of a trial."""

    file: Word | None = setting(None, "recording, in the folder of the data")
    begins: Begins | None = setting(None, "how it begins; null: as data.begins says")
    inputs: Some[float] | None = setting(None, "that drive it all the time, one for each chamber, tendon or muscle")
    onset: NotNegative | None = setting(None, "when they come, by the clock of the recording; null: at once", "s")
    input_delay: float = setting(0.0, "how much later than its log says its inputs came, as clocks differ", "s")
    labels: Labels | None = setting(None, "of the markers of its file, in their order; null: as the file says")
    payload: NotNegative = setting(0.0, "mass that hangs on the body", "kg")
    pull: Vector | None = setting(None, "force at the tip that holds a simulated body before its release", "N")
    base_motion: MotionSettings | None = setting(None, "of this trial, in place of data.base_motion")


def _file(value: Any) -> Any:
    return {"file": value} if isinstance(value, str) else value


def _named(trials: dict[str, TrialSettings]) -> dict[str, TrialSettings]:
    for name in trials:
        if not name or not all(letter.isalnum() or letter in "_-" for letter in name):
            raise ValueError(f"{name} cannot name a trial: files are named after it, so use letters, digits, _ and -.")
    return trials


TrialTable = Annotated[
    dict[str, Annotated[TrialSettings, BeforeValidator(_file, json_schema_input_type=TrialSettings | str)]],
    AfterValidator(_named),
]


class Trial(Settings):
    """A motion of the body, or a pose."""

    name: str
    begins: str  # one of `Begins`; ``given`` where a simulation knows the state
    file: str | None = None  # its recording; None where it is simulated
    payload: float = 0.0  # mass that hangs on the body [kg]
    pull: Vector | None = None  # force that holds the body before the release, where the laboratory is simulated [N]
    sequence: int | None = None  # number of its drawn inputs; None without any
    scale: float = 1.0  # by which these are multiplied
    amount: float = 0.0  # what sets simulated trials apart: a weight [kg], an angle [rad] or a factor of a motion
    inputs: Many[float] | None = None  # see `TrialSettings`
    onset: float | None = None  # [s]
    input_delay: float = 0.0  # [s]
    labels: Many[str] | None = None
    base_motion: MotionSettings | None = None

    @property
    def is_released(self) -> bool:
        """Whether it is let go at time zero."""
        return self.begins in ("held", "released")

    def tracked(self, labels: Any) -> list[int]:
        """Numbers of the tracked markers, of these labels, that it has."""
        return [number for number, label in enumerate(labels) if self.labels is None or label in self.labels]

    @property
    def recording(self) -> str:
        """Path of its recording in the run folder, if the laboratory is simulated."""
        # Scaled ones lie elsewhere, as the folder of the others may become another experiment's data.
        return f"{'recordings' if self.scale == 1.0 else 'recordings_scaled'}/{self.name}.h5"


class Split(Settings):
    """Names of the trials of training, validation and test; their order is that of the files.

    A trial of which a part is learned from (``data.train_fraction``) may be tested on the rest of it.
    """

    train: Many[str]
    validation: Many[str]
    test: Many[str]

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return tuple(dict.fromkeys(self.train + self.validation + self.test))


class LimitSettings(Settings):
    """The most trials of each split, evenly picked; of the test, the folds where there are any."""

    train: Natural
    validation: Natural
    test: Natural


class AmountSettings(Settings):
    """Values that set simulated trials apart, by split."""

    train: Many[Positive] = ()
    validation: Many[Positive] = ()
    test: Many[Positive] = ()
    observed: Many[Positive] = setting((), "the one trial of a marker ablation")


class _Simulated(Settings):
    steps: Natural = setting(description="of each trial")
    base_motion: MotionSettings | None = setting(None, "how what the body is fixed to moves")
    folds: Literal["leave_one_out"] | None = setting(None, "cross-validation in place of the split")
    limit: LimitSettings | None = setting(None, "fewer trials, evenly picked")


class ReleaseFromLoad(_Simulated):
    """Bodies that weights hold at rest, and that are let go."""

    kind: Literal["release_from_load"]
    load: PlaceSettings = setting(description="vertices that carry the weights, in equal shares")
    weights_g: AmountSettings = setting(description="weights", unit="g")

    @property
    def amounts(self) -> AmountSettings:
        """Configured values, by split."""
        return self.weights_g


class ReleaseFromTwist(_Simulated):
    """Bodies that are twisted, and let go."""

    kind: Literal["release_from_twist"]
    twist_axis: Axis = setting(description="along which the angle grows linearly, from zero at the low end")
    angles_deg: AmountSettings = setting(description="of the high end", unit="degrees")

    @property
    def amounts(self) -> AmountSettings:
        """Configured values, by split."""
        return self.angles_deg


class MovingBase(_Simulated):
    """Bodies whose base moves."""

    kind: Literal["moving_base"]
    base_motion: MotionSettings = setting(description="that is multiplied by the amplitudes")
    amplitudes: AmountSettings = setting(description="factors of the motion")

    @property
    def amounts(self) -> AmountSettings:
        """Configured values, by split."""
        return self.amplitudes


SimulatedData = ReleaseFromLoad | ReleaseFromTwist | MovingBase


class TableSettings(Settings):
    """Columns of CSV or TSV files that do not say what they hold."""

    columns: Many[Word | None] = setting(description="headers such as 'time [s]' or 'tip.x [mm]'; null: not read")
    header_lines: Count = setting(0, "lines before the first row of numbers")


class ReadingSettings(Settings):
    """How recordings are read and brought into the frame of the body."""

    folder: Word | None = setting(None, "of the recordings; null: the group laboratory plays the real body")
    units: LengthUnit | None = setting(None, "where the files do not say")
    rate: Positive | None = setting(None, "frames a second, where the files do not say", "Hz")
    table: TableSettings | None = setting(None, "columns of tables that do not say what they hold")
    axes: Annotated[Many[SignedAxis], Field(min_length=3, max_length=3), AfterValidator(different)] | None = setting(
        None, "recorded axes along which the body's x, y and z are, if known: then one standing marker registers"
    )
    rest: Literal["held", "file"] = setting(
        "held", "undeformed body: as it is held; or as the recordings' array rest says, where it is pulled aside"
    )
    alignment: Literal["shared", "own"] = setting(
        "own", "own: each trial is shifted to where markers sit on the whole, as they drift"
    )
    base_motion: BaseMotion = setting(None, "how what the body is fixed to moves: recorded, reference, or a motion")
    payload_at: PlaceSettings | None = setting(None, "vertices that carry payloads, in equal shares")
    up: SignedAxis | Direction | None = setting(
        None, "against gravity in the frame of the recordings; null: gravity is taken as it is"
    )
    seconds: Positive | None = setting(None, "after a release, that count", "s")
    rest_seconds: NotNegative = setting(
        0.05, "at most, before the inputs come: they tell where markers are at rest", "s"
    )
    longest_gap: Count = setting(5, "frames; longer occlusions are masked")
    steps: Natural | None = setting(None, "of the simulation that are read of each driven recording")
    parts: Annotated[Some[Natural], AfterValidator(different)] | None = setting(
        None, "chamber, tendon or muscle that each column of inputs drives, from 1; null: as they are"
    )
    input_limit: Positive | None = setting(
        None, "in the unit of the input: recorded ones beyond it are refused, simulated ones cut off"
    )
    valve: Literal["recorded", "detected"] = setting(
        "recorded", "when inputs come: as the files say, or when the markers begin to move"
    )
    cutoff: Positive | None = setting(None, "motion above it is noise to the forces, not to the errors", "Hz")


class RecordedData(ReadingSettings):
    """Trials that are seen through markers, recorded or played by a simulated laboratory."""

    kind: Literal["recorded"]
    trials: TrialTable = setting({}, "by name; none: all files of the folder")
    sequences: Count = setting(0, "trials of the laboratory under random inputs: t000, t001, ...")
    begins: Begins = setting(
        "held",
        "held at rest, for 0.2 s or more, until it is let go; released with the first frame; rest, until its inputs "
        "come; static, a pose without time",
    )
    train_fraction: Share = setting(1.0, "of each trial, from its start, that is learned from")
    horizons: Annotated[Many[Positive], AfterValidator(_rising)] = setting(
        (), "from the start, for which errors are given too", "s"
    )
    input_scales: Annotated[Many[Positive], AfterValidator(different)] = setting(
        (), "of the inputs, at which simulated test trials are run as well"
    )
    folds: Literal["leave_one_out"] | None = setting(None, "every trial is the test of a fold once; null: the split")
    train: Trials = setting((), "names of trials, or how many")
    validation: Trials = setting((), "names of trials, or how many")
    test: Trials = setting((), "names of trials, or how many")
    limit: LimitSettings | None = setting(None, "fewer trials, evenly picked")

    @model_validator(mode="after")
    def _scales(self) -> Self:
        if 1.0 in self.input_scales:
            raise ValueError("input_scales has 1, which is always tested: leave it out.")
        if self.input_scales and self.folds:
            raise ValueError("input_scales and data.folds exclude each other: take one of them out.")
        if self.input_scales and self.folder is not None:
            raise ValueError(
                "input_scales raises the inputs of simulated trials, and recordings have their own: leave it empty."
            )
        return self


DataSettings = Annotated[
    RecordedData | ReleaseFromLoad | ReleaseFromTwist | MovingBase,
    Field(discriminator="kind"),
]


class BindingSettings(Settings):
    """Where markers are on the undeformed body, and how they are bound to it."""

    tracked: dict[str, Vector] = setting(description="places by name; errors are measured on these", unit="m")
    reference: dict[str, Vector] = setting({}, "places of markers that stand still, for the registration", "m")
    bind: Literal["normal", "frame", "rigid", "patch"] = setting("normal", "how tracked ones follow the body")
    bind_to: PlaceSettings | None = setting(None, "vertices that rigid markers follow")
    patch: Positive = setting(0.02, "distance from its foot of the vertices that a patch marker follows", "m")
    largest_distance: Positive = setting(0.02, "from the surface of the body", "m")


class MarkerSettings(BindingSettings):
    """Markers, and what is known of them."""

    plane: Annotated[Many[Axis], Field(min_length=2, max_length=2), AfterValidator(different)] | None = setting(
        None, "axes of the body that a single camera sees; null: all three"
    )
    frame: Literal["body", "own"] = setting(
        "body", "own: nobody knows where the body is, as of one that swims, and markers tell its shape alone"
    )
    labels: Literal["recorded", "assigned"] = setting(
        "recorded", "files name their markers; assigned: they are found by where they are"
    )
    largest_residual: Positive = setting(0.004, "how well the nominal places are known", "m")
    largest_distortion: Positive = setting(
        0.001, "that a reference marker may move against the others between trials", "m"
    )
    largest_shift: Positive | None = setting(None, "that it may move in the frame of the recordings; null: any", "m")

    @model_validator(mode="after")
    def _are_bound(self) -> Self:
        both = [label for label in self.tracked if label in self.reference]
        if both:
            raise ValueError(f"tracked and markers.reference both have '{both[0]}': it moves or stands still.")
        if not self.tracked:
            raise ValueError("tracked is empty: name the markers that errors are measured on, with their places.")
        if self.bind == "rigid" and self.bind_to is None:
            raise ValueError("bind is rigid: set markers.bind_to to the vertices that they follow, as {x: 0.1}.")
        return self


class SequenceSettings(Settings):
    """Random inputs of a laboratory; see `data.actuation.InputSequences`."""

    mean: float = setting(8e3, "in the unit of the input")
    deviation: Positive = setting(9e3, "in the unit of the input")
    correlation_time: Positive = setting(0.4, "the longer, the smoother", "s")
    correlation: float | Many[Many[float]] = setting(0.0, "between parts, or a matrix")
    rest: NotNegative = setting(0.1, "without inputs at the start and at the end", "s")


class PlaySettings(Settings):
    """A simulation that plays the real body, with physics that the simulator does not have."""

    mesh: MeshSettings
    time_step: TimeStep = setting(description="of its simulation", unit="s")
    integrator: Integrator = setting(description="of its simulation")
    material: MaterialSettings = setting(description="of its body")
    fibres: FibreSettings | None = setting(None, "around its chambers")
    sequences: SequenceSettings = setting(SequenceSettings(), "random inputs")
    rate: Positive | None = setting(None, "of the cameras; null: one frame a time step", "Hz")
    noise: NotNegative = setting(description="of each coordinate of a marker", unit="m")
    placement_noise: NotNegative = setting(description="how far markers sit from their nominal places", unit="m")
    tilt: Annotated[float, Field(ge=0.0, le=20.0)] = setting(0.0, "how far the body is from level", "degrees")
    held_seconds: Annotated[float, Field(ge=0.25)] | None = setting(
        None, "that the body is held before it is let go", "s"
    )
    seconds: Positive | None = setting(None, "that it is followed after its release", "s")


class LaboratorySettings(PlaySettings):
    """The simulation that plays the real body, and its trials."""

    trials: TrialTable = setting({}, "by name: payloads and beginnings")
    train: Trials | None = setting(None, "its own split, in place of that of data")
    validation: Trials | None = setting(None, "its own split")
    test: Trials | None = setting(None, "its own split")

    @model_validator(mode="after")
    def _is_split_whole(self) -> Self:
        parts = {"train": self.train, "validation": self.validation, "test": self.test}
        missing = [name for name, each in parts.items() if each is None]
        if 0 < len(missing) < len(parts):
            raise ValueError(f"{missing[0]} is missing: a split has train, validation and test.")
        return self
