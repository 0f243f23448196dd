"""Settings of trials: their source, how they begin, their markers, and their split."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator

from ..io.classes import ClassSettings
from ..io.settings import Count, Many, Natural, NotNegative, Positive, Settings, Share, Some, Vector, Word, setting
from .body import TargetSettings
from .mesh import Direction, LengthUnit, PlaceSettings

# Held at rest until the release; released with the first frame; at rest until inputs are applied; at rest under the
# inputs of the first frame; at rest as those do not act, such as of a slack tendon; a static pose.
Begins = Literal["held", "released", "rest", "driven", "slack", "static"]
Axis = Literal["x", "y", "z"]
SignedAxis = Literal["x", "-x", "y", "-y", "z", "-z"]


def different(values: tuple[Any, ...]) -> tuple[Any, ...]:
    """Refuses a list in which a value occurs twice."""
    if len({*values}) < len(values):
        raise ValueError("a value occurs twice: it must be a list of different values.")
    return values


def rising(values: tuple[float, ...]) -> tuple[float, ...]:
    """Refuses a list whose values do not rise."""
    if list(values) != sorted({*values}):
        raise ValueError("they must rise.")
    return values


Labels = Annotated[Some[Word], AfterValidator(different)]
Trials = Count | Literal["others"] | Many[Word]


class SwingSettings(Settings):
    """A sinusoid of a motion."""

    frequency: Positive = setting(unit="Hz")
    translation: Vector = setting((0.0, 0.0, 0.0), "amplitudes along x, y and z", "m")
    rotation: Vector = setting((0.0, 0.0, 0.0), "amplitudes about x, y and z", "rad")
    phase: float = setting(0.0, "phase at time zero", "rad")


class MotionSettings(Settings):
    """Motion of the base or of an obstacle: a table of poses in a file, or a sum of sinusoids."""

    file: Word | None = setting(None, "table of poses, in the folder of the recordings")
    swings: dict[str, SwingSettings] | None = setting(None, "sinusoids, by any names")
    about: Vector = setting((0.0, 0.0, 0.0), "centre of rotation, to which the translation refers", "m")
    start: NotNegative = setting(0.0, "start of the motion", "s")
    ramp: NotNegative = setting(0.0, "duration in which amplitudes grow from zero", "s")

    @model_validator(mode="after")
    def _has_one(self) -> Self:
        if (self.file is None) == (self.swings is None):
            raise ValueError("file and swings: give one of them, a table of poses or sinusoids by any names.")
        if self.swings is not None and not self.swings:
            raise ValueError("swings is empty: give one at least, as {a: {frequency: 1.0, translation: [0.01, 0, 0]}}.")
        return self


class WaveSettings(Settings):
    """Periodic inputs, `data.input_response.wave_inputs`."""

    frequency: Positive = setting(unit="Hz")
    phases: Some[float] = setting(description="initial phases, one per chamber, tendon or muscle", unit="rad")
    mean: float = setting(description="mean, in the unit of the input")
    amplitude: Positive = setting(description="amplitude, in the unit of the input")
    start: NotNegative = setting(0.0, "time before which there are no inputs", "s")
    ramp: NotNegative = setting(0.0, "duration in which they grow from zero", "s")


BaseMotion = MotionSettings | Literal["recorded", "reference"] | None
ObstacleMotions = dict[str, MotionSettings]  # by obstacle


class _Performed(Settings):
    """Recording and inputs of a trial, in a configuration and in a run."""

    file: Word | None = setting(None, "recording, in the folder of the data")
    inputs: Some[float] | None = setting(None, "constant inputs, one for each chamber, tendon or muscle")
    onset: NotNegative | None = setting(None, "start of the inputs, by the clock of the recording; null: at once", "s")
    until: Positive | None = setting(None, "end of the inputs, by the same clock; null: that of the recording", "s")
    input_delay: float = setting(0.0, "delay of the inputs against their log", "s")
    labels: Labels | None = setting(None, "labels in the order of its file; null: those of the file")
    session: Word | None = setting(None, "session in which it was recorded; null: one session")
    payload: NotNegative = setting(0.0, "mass that hangs on the body", "kg")
    waves: WaveSettings | None = setting(None, "periodic inputs of a simulated trial, in place of random ones")
    pull: Vector | None = setting(None, "force at the tip of a simulated body before its release", "N")
    base_motion: MotionSettings | None = setting(None, "in place of data.base_motion")
    obstacle_motion: ObstacleMotions = setting({}, "in place of data.obstacle_motion")

    @model_validator(mode="after")
    def _is_a_pulse(self) -> Self:
        if (self.onset is not None or self.until is not None) and self.inputs is None:
            raise ValueError(
                "inputs is null: onset and until are of constant inputs, so give these, or leave them out."
            )
        if self.until is not None and self.until <= (self.onset or 0.0):
            raise ValueError(f"until is {self.until:g}: it must be above onset, {self.onset or 0.0:g} s.")
        return self


class TrialSettings(_Performed):
    """Settings of a trial."""

    begins: Begins | None = setting(None, "how it begins; null: as data.begins")


def by_file(value: Any) -> Any:
    """Takes a path in place of a group as its key `file`."""
    return {"file": value} if isinstance(value, str) else value


def _named(trials: dict[str, TrialSettings]) -> dict[str, TrialSettings]:
    for name in trials:
        if not name or not all(letter.isalnum() or letter in "_-" for letter in name):
            raise ValueError(f"{name} cannot name a trial: files are named after it, so use letters, digits, _ and -.")
    return trials


TrialTable = Annotated[
    dict[str, Annotated[TrialSettings, BeforeValidator(by_file, json_schema_input_type=TrialSettings | str)]],
    AfterValidator(_named),
]


class Trial(_Performed):
    """A motion of the body, or a pose."""

    name: str
    begins: str  # one of `Begins`, or ``given`` where a simulation provides the state
    sequence: int | None = None  # number of its random inputs in a simulated laboratory, or None
    scale: float = 1.0  # factor of its simulated inputs
    amount: float = 0.0  # parameter of a simulated trial: a weight [kg], an angle [rad] or a factor of a motion
    load: "tuple[HeldSettings, ...] | None" = None  # what holds it, where that differs from the other trials

    @property
    def is_released(self) -> bool:
        """Whether the body is released at time zero."""
        return self.begins in ("held", "released")

    @property
    def is_driven(self) -> bool:
        """Whether a simulated laboratory makes inputs for it."""
        return self.sequence is not None or self.waves is not None

    def tracked(self, labels: Any) -> list[int]:
        """Returns the indices of the labels of tracked markers that the trial has."""
        return [number for number, label in enumerate(labels) if self.has(label)]

    def has(self, label: str) -> bool:
        """Whether the recording has a marker, a rigid body, or a point of one."""
        name, _, corner = label.rpartition(" ")
        return self.labels is None or label in self.labels or (corner in CORNERS and name in self.labels)

    @property
    def recording(self) -> str:
        """Path of its recording in the run folder, in a simulated laboratory."""
        # Scaled ones have their own folder, as that of the others may be the data of another experiment.
        return f"{'recordings' if self.scale == 1.0 else 'recordings_scaled'}/{self.name}.h5"


class Split(Settings):
    """Names of the trials of training, validation and test, in the order of the files.

    With ``data.train_fraction``, a training trial may be tested on its rest.
    """

    train: Many[str]
    validation: Many[str]
    test: Many[str]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all trials."""
        return tuple(dict.fromkeys(self.train + self.validation + self.test))


class LimitSettings(Settings):
    """Largest number of trials of each split, evenly chosen; for the test, of folds if there are any."""

    train: Natural
    validation: Natural
    test: Natural


class AmountSettings(Settings):
    """Parameters of simulated trials, by split."""

    train: Many[Positive] = ()
    validation: Many[Positive] = ()
    test: Many[Positive] = ()
    observed: Many[Positive] = setting((), "single trial of a marker ablation")


class _Simulated(Settings):
    steps: Natural = setting(description="time steps per trial")
    base_motion: MotionSettings | None = setting(None, "motion of the base")
    obstacle_motion: ObstacleMotions = setting({}, "motion of obstacles from their places, by obstacle")
    folds: Literal["leave_one_out"] | None = setting(None, "cross-validation in place of the split")
    limit: LimitSettings | None = setting(None, "fewer trials, evenly chosen")

    @property
    def amounts(self) -> AmountSettings:
        """Parameters of the trials, by split."""
        (amounts,) = (value for _, value in self if isinstance(value, AmountSettings))
        return amounts


class HeldSettings(Settings):
    """Weight or twist that holds a body before its release, in its own test trial; a list of weights acts at once."""

    weight_g: NotNegative = setting(0.0, "weight", unit="g")
    direction: Direction = setting((0.0, 0.0, -1.0), "direction in which it pulls")
    at: PlaceSettings | None = setting(None, "vertices that carry it, in equal shares; null: data.load")
    twist_deg: float = setting(0.0, "angle of the high end of a twisted body", "degrees")
    twist_axis: Axis = setting("x", "axis along which the angle grows")

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.weight_g > 0.0) == (self.twist_deg != 0.0):
            raise ValueError(
                f"weight_g is {self.weight_g:g} and twist_deg {self.twist_deg:g}: one of them holds the body, so give "
                "one, and leave the other at 0."
            )
        return self


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, (Mapping, HeldSettings)) else value


def _weights(held: tuple[HeldSettings, ...]) -> tuple[HeldSettings, ...]:
    if len(held) > 1 and any(one.twist_deg for one in held):
        raise ValueError("it must be one twist, or a list of weights.")
    return held


# One load, or a list of weights that act at the same time.
Held = Annotated[
    Some[HeldSettings],
    BeforeValidator(_listed, json_schema_input_type=HeldSettings | Some[HeldSettings]),
    AfterValidator(_weights),
]


class ReleaseFromLoad(_Simulated):
    """Bodies that are released from rest under weights."""

    kind: Literal["release_from_load"]
    load: PlaceSettings = setting(description="vertices that carry the weights, in equal shares")
    weights_g: AmountSettings = setting(description="weights", unit="g")
    others: dict[str, Held] = setting(
        {}, "further test trials by name, held in other ways: by a load, or by a list of weights"
    )


class ReleaseFromTwist(_Simulated):
    """Bodies that are released from a twist."""

    kind: Literal["release_from_twist"]
    twist_axis: Axis = setting(description="axis along which the angle grows")
    angles_deg: AmountSettings = setting(description="angle of the high end", unit="degrees")


class MovingBase(_Simulated):
    """Bodies whose base moves."""

    kind: Literal["moving_base"]
    base_motion: MotionSettings = setting(description="motion that is multiplied by the amplitudes")
    amplitudes: AmountSettings = setting(description="factors of the motion")


SimulatedData = ReleaseFromLoad | ReleaseFromTwist | MovingBase


class TableSettings(Settings):
    """Columns of CSV or TSV files without a header, or with another one."""

    columns: Many[Word | None] = setting((), "headers such as 'time [s]' or 'tip.x [mm]'; null: not read")
    names: dict[str, Word] = setting({}, "such headers by those of the file, in place of columns")
    header_lines: Count = setting(0, "lines before the numbers, or before the header")

    @model_validator(mode="after")
    def _has_one(self) -> Self:
        if bool(self.columns) == bool(self.names):
            raise ValueError(
                "columns and names: give one of them, all columns in order, or names by those of the file."
            )
        return self


class BagSettings(Settings):
    """Topics of bags, with a member after # where a message has several: /tf#tip, /joint_states#finger.effort."""

    markers: dict[str, Word] = setting(description="topics by name of the marker; poses are rigid bodies")
    inputs: Many[Word] = setting((), "topics with units: '/pressure#1 [mbar]'")
    base: Word | None = setting(None, "topic of the pose of the base")
    rate: Positive | None = setting(None, "rate of the frames; null: that of the first marker", "Hz")


class ReadingSettings(Settings):
    """Reading of recordings and their transformation into the frame of the body."""

    folder: Word | None = setting(None, "folder of the recordings; null: the laboratory simulates them")
    units: LengthUnit | None = setting(None, "unit of files that do not state one")
    rate: Positive | None = setting(None, "frame rate of files that do not state one", "Hz")
    table: TableSettings | None = setting(None, "columns of tables without headers")
    bag: BagSettings | None = setting(None, "topics of ROS bags")
    axes: Annotated[Many[SignedAxis], Field(min_length=3, max_length=3), AfterValidator(different)] | None = setting(
        None, "recorded axes along the body's x, y and z, if known"
    )
    rest: Literal["held", "file"] = setting("held", "the undeformed body: while held, or the array rest of the files")
    alignment: Literal["shared", "own"] = setting("own", "own: shift each trial to the mean marker positions")
    base_motion: BaseMotion = setting(None, "motion of the base: recorded, reference (by markers), or given")
    obstacle_motion: dict[str, MotionSettings | Literal["recorded"]] = setting(
        {}, "motion of obstacles, given or recorded"
    )
    payload_at: PlaceSettings | None = setting(None, "vertices that carry payloads, in equal shares")
    up: SignedAxis | Direction | None = setting(
        None, "direction against gravity in the recordings; null: as configured"
    )
    seconds: Positive | None = setting(None, "evaluated duration after a release", "s")
    rest_seconds: NotNegative = setting(0.05, "duration before the inputs for the rest positions", "s")
    longest_gap: Count = setting(5, "frames; longer occlusions are masked")
    steps: Natural | None = setting(None, "time steps read of a driven recording; null: the whole recording")
    lead: NotNegative | None = setting(
        None, "driven recordings are read from here before inputs or markers first change; null: their first frame", "s"
    )
    parts: Annotated[Some[Natural], AfterValidator(different)] | None = setting(
        None, "chamber, tendon or muscle, from 1, of each column; null: in order"
    )
    input_limit: Positive | None = setting(None, "largest input: larger ones are refused, simulated ones clipped")
    valve: Literal["recorded", "detected"] = setting(
        "recorded", "start of the inputs: as recorded, or detected from the markers"
    )
    cutoff: Positive | None = setting(None, "cutoff of the low-pass filter, for reconstruction only", "Hz")


class RecordedData(ReadingSettings):
    """Trials that are observed through markers, recorded or played by a simulated laboratory."""

    kind: Literal["recorded"]
    trials: TrialTable = setting({}, "trials by name; none: all files of the folder")
    sequences: Count = setting(0, "trials under random inputs: t000, t001, ...")
    begins: Begins = setting(
        "held",
        "held at rest until the release; released with the first frame; rest, until inputs; driven, at rest under the "
        "first inputs; slack, where those do not act; static, a pose",
    )
    train_fraction: Share = setting(1.0, "share of every trial, from its start, for training")
    horizons: Annotated[Many[Positive], AfterValidator(rising)] = setting(
        (), "further durations over which errors are reported", "s"
    )
    input_scales: Annotated[Many[Positive], AfterValidator(different)] = setting(
        (), "factors of the inputs for additional test trials"
    )
    folds: Literal["leave_one_out"] | None = setting(None, "cross-validation over the trials; null: the split")
    train: Trials = setting((), "names or number of trials; others: the rest")
    validation: Trials = setting((), "names or number of trials; others: the rest")
    test: Trials = setting((), "names or number of trials; others: the rest")
    limit: LimitSettings | None = setting(None, "fewer trials, evenly chosen")

    @model_validator(mode="after")
    def _scales(self) -> Self:
        if 1.0 in self.input_scales:
            raise ValueError("input_scales has 1, which is always tested: leave it out.")
        if self.input_scales and self.folds:
            raise ValueError("input_scales and data.folds exclude each other: take one of them out.")
        if self.input_scales and self.folder is not None:
            raise ValueError(
                "input_scales is for simulated trials, and recordings have their own inputs: leave it empty."
            )
        return self


CORNERS = ("+++", "+--", "-+-", "--+")  # of the tetrahedron that stands for a pose: signs of x, y and z


class RigidBodySettings(Settings):
    """Recorded pose of a rigid body, whose mounting on the body is estimated from the frames at rest.

    An error of `position_deviation` counts as much as one of `orientation_deviation`.
    """

    part: Word | None = setting(None, "rigid part that it is mounted on")
    at: PlaceSettings | None = setting(None, "vertices of a stiff plate that it is mounted on instead")
    position_deviation: Annotated[float, Field(gt=0.0, le=0.05)] = setting(1.0e-3, "expected error of a position", "m")
    orientation_deviation: Annotated[float, Field(gt=0.0, le=45.0)] = setting(
        1.0, "expected error of an orientation", "degrees"
    )

    @model_validator(mode="after")
    def _is_mounted(self) -> Self:
        if (self.part is None) == (self.at is None):
            raise ValueError("part and at: give one of them, a rigid part or the vertices of a plate, as {x: 0.1}.")
        return self

    @property
    def length(self) -> float:
        """Length that an error of one radian counts as [m]."""
        return self.position_deviation / math.radians(self.orientation_deviation)


class BindingSettings(Settings):
    """Positions of markers on the undeformed body, and how they are bound to it."""

    tracked: dict[str, Vector] = setting({}, "positions by name; errors are measured on these", "m")
    rigid_bodies: dict[str, RigidBodySettings] = setting(
        {}, "recorded poses (positions with quaternions) by name; errors are measured on these, too"
    )
    reference: dict[str, Vector] = setting({}, "positions of fixed markers, for the registration", "m")
    bind: Literal["normal", "frame", "rigid", "patch"] = setting("normal", "how tracked markers follow the body")
    bind_to: PlaceSettings | None = setting(None, "vertices that rigid markers follow")
    patch: Positive = setting(0.02, "radius of a patch", "m")
    largest_distance: Positive = setting(0.02, "largest distance from the surface of the body", "m")
    observation: ClassSettings | None = setting(
        None, "observation of tracked markers by a class of another package, in place of bind"
    )

    @model_validator(mode="after")
    def _binds_once(self) -> Self:
        if self.observation is not None and (self.bind != "normal" or self.bind_to is not None):
            raise ValueError("observation takes the place of bind and bind_to: leave these two out.")
        return self

    @property
    def observed(self) -> tuple[str, ...]:
        """Labels of the M observed points: tracked markers, then four points of each rigid body."""
        return (*self.tracked, *(f"{name} {corner}" for name in self.rigid_bodies for corner in CORNERS))


class MarkerSettings(BindingSettings):
    """Markers and tolerances of their registration."""

    plane: Annotated[Many[Axis], Field(min_length=2, max_length=2), AfterValidator(different)] | None = setting(
        None, "axes that a single camera sees; null: all"
    )
    frame: Literal["body", "own"] = setting("body", "own: markers measure the shape alone, as for swimming")
    labels: Literal["recorded", "assigned"] = setting("recorded", "assigned: names are assigned by position")
    register_with: Labels | None = setting(None, "markers for registration; null: all of a body at rest")
    largest_residual: Positive = setting(0.004, "largest residual of the registration", "m")
    largest_distortion: Positive = setting(0.001, "largest motion of a reference marker in a session", "m")
    largest_shift: Positive | None = setting(None, "largest shift of a reference marker; null: any", "m")

    @model_validator(mode="after")
    def _are_bound(self) -> Self:
        if both := [label for label in self.tracked if label in self.reference]:
            raise ValueError(f"tracked and markers.reference both have '{both[0]}': it moves or is fixed.")
        if unknown := [label for label in self.register_with or () if label not in (*self.tracked, *self.reference)]:
            raise ValueError(
                f"register_with names '{unknown[0]}', which is in neither tracked nor reference: choose from "
                f"{', '.join((*self.tracked, *self.reference))}."
            )
        if not self.tracked and not self.rigid_bodies:
            raise ValueError("tracked is empty: name the markers that errors are measured on, with their places.")
        if both := [name for name in self.rigid_bodies if name in (*self.tracked, *self.reference)]:
            raise ValueError(
                f"rigid_bodies has '{both[0]}', which is a marker in tracked or reference, too: its place is not "
                "given, but estimated, so name it in rigid_bodies alone."
            )
        if self.rigid_bodies and (self.plane is not None or self.frame == "own" or self.labels == "assigned"):
            raise ValueError(
                "rigid_bodies need recordings in three dimensions, in the frame of the body, with names: leave plane, "
                "frame and labels out."
            )
        if self.tracked and self.bind == "rigid" and self.bind_to is None:
            raise ValueError("bind is rigid: set markers.bind_to to the vertices that they follow, as {x: 0.1}.")
        return self


class SequenceSettings(Settings):
    """Random inputs of a laboratory, `data.input_response.draw_inputs`."""

    mean: float = setting(8e3, "mean, in the unit of the input")
    deviation: Positive = setting(9e3, "standard deviation, in the unit of the input")
    correlation_time: Positive = setting(0.4, "correlation time of the random process", "s")
    correlation: float | Many[Many[float]] = setting(0.0, "correlation of different parts")
    rest: NotNegative = setting(0.1, "duration without inputs at the start and at the end", "s")


class PlaySettings(TargetSettings):
    """A simulation that stands in for the real body, and its cameras."""

    model_config = ConfigDict(json_schema_extra={"additionalProperties": False})

    sequences: SequenceSettings = setting(SequenceSettings(), "random inputs")
    rate: Positive | None = setting(None, "frame rate of the cameras; null: one frame per time step", "Hz")
    noise: NotNegative = setting(description="noise of a coordinate of a marker", unit="m")
    placement_noise: NotNegative = setting(
        description="noise of a coordinate of a marker's position on the body", unit="m"
    )
    orientation_noise: Annotated[float, Field(ge=0.0, le=45.0)] = setting(
        0.0, "noise of a component of a rigid body's rotation", unit="degrees"
    )
    zero_noise: NotNegative = setting(0.0, "noise of the zero of recorded inputs")
    tilt: Annotated[float, Field(ge=0.0, le=20.0)] = setting(0.0, "tilt of the body from level", "degrees")
    held_seconds: Annotated[float, Field(ge=0.25)] | None = setting(None, "recorded duration before the release", "s")
    seconds: Positive | None = setting(None, "recorded after the release", "s")


class LaboratorySettings(PlaySettings):
    """The simulation that stands in for the real body, and its trials."""

    trials: TrialTable = setting({}, "trials by name: payloads and beginnings")
    train: Trials | None = setting(None, "training trials, in place of those of data")
    validation: Trials | None = setting(None, "validation trials")
    test: Trials | None = setting(None, "test trials")

    @model_validator(mode="after")
    def _is_split_whole(self) -> Self:
        parts = {"train": self.train, "validation": self.validation, "test": self.test}
        missing = [name for name, trials in parts.items() if trials is None]
        if 0 < len(missing) < len(parts):
            raise ValueError(f"{missing[0]} is missing: a split has train, validation and test.")
        return self
