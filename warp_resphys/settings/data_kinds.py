"""Settings of the data of a run: simulated trials of several kinds,
and recordings, with how they are read.
"""

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from ..core.mesh.place import Direction, LengthUnit, Place
from ..io.settings import (
    Count,
    Many,
    Natural,
    NotNegative,
    Positive,
    Settings,
    Share,
    Some,
    Word,
    setting,
)
from .performed import (
    Axis,
    BaseMotion,
    Begins,
    Held,
    LimitSettings,
    MotionSettings,
    ObstacleMotions,
    SignedAxis,
    Split,
    Trials,
    TrialTable,
    different,
    rising,
)


class AmountSettings(Settings):
    """Parameters of simulated trials, by split."""

    train: Many[Positive] = ()
    validation: Many[Positive] = ()
    test: Many[Positive] = ()
    observed: Many[Positive] = setting((), "single trial of a marker ablation")


class _Simulated(Settings):
    steps: Natural = setting(description="time steps per trial")
    base_motion: MotionSettings | None = setting(None, "motion of the base")
    obstacle_motion: ObstacleMotions = setting(
        {}, "motion of obstacles from their places, by obstacle"
    )
    folds: Literal["leave_one_out"] | None = setting(None, "cross-validation in place of the split")
    limit: LimitSettings | None = setting(None, "fewer trials, evenly chosen")

    @property
    def amounts(self) -> AmountSettings:
        """Parameters of the trials, by split."""
        (amounts,) = (value for _, value in self if isinstance(value, AmountSettings))
        return amounts


class ReleaseFromLoad(_Simulated):
    """Bodies that are released from rest under weights."""

    kind: Literal["release_from_load"]
    load: Place = setting(description="vertices that carry the weights, in equal shares")
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

    columns: Many[Word | None] = setting(
        (), "headers such as 'time [s]' or 'tip.x [mm]'; null: not read"
    )
    names: dict[str, Word] = setting({}, "such headers by those of the file, in place of columns")
    header_lines: Count = setting(0, "lines before the numbers, or before the header")
    rate: Positive | None = setting(
        None,
        "rate at which uneven times are sampled again (linearly; inputs hold), or of frames "
        "without times; null: even",
        "Hz",
    )

    @model_validator(mode="after")
    def _has_one(self) -> Self:
        if bool(self.columns) == bool(self.names):
            raise ValueError(
                "columns and names: give one of them, all columns in order, "
                "or names by those of the file."
            )
        return self


class BagSettings(Settings):
    """Topics of bags, with a member after # where a message has several: /tf#tip,
    /joint_states#finger.effort.
    """

    markers: dict[str, Word] = setting(
        description="topics by name of the marker; poses are rigid bodies"
    )
    inputs: Many[Word] = setting((), "topics with units: '/pressure#1 [mbar]'")
    base: Word | None = setting(None, "topic of the pose of the base")
    loads: dict[str, Word] = setting(
        {}, "topics of forces and moments (WrenchStamped) by name of the sensor"
    )
    rate: Positive | None = setting(
        None, "rate of the frames; null: that of the first marker", "Hz"
    )


class ReadingSettings(Settings):
    """Reading of recordings and their transformation into the frame of the body."""

    folder: Word | None = setting(
        None, "folder of the recordings; null: the laboratory simulates them"
    )
    units: LengthUnit | None = setting(None, "unit of files that do not state one")
    rate: Positive | None = setting(None, "frame rate of files that do not state one", "Hz")
    table: TableSettings | None = setting(None, "columns of tables without headers")
    bag: BagSettings | None = setting(None, "topics of ROS bags")
    axes: (
        Annotated[Many[SignedAxis], Field(min_length=3, max_length=3), AfterValidator(different)]
        | None
    ) = setting(None, "recorded axes along the body's x, y and z, if known")
    rest: Literal["held", "file"] = setting(
        "held", "the undeformed body: while held, or the array rest of the files"
    )
    alignment: Literal["shared", "own"] = setting(
        "own", "own: shift each trial to the mean marker positions"
    )
    base_motion: BaseMotion = setting(
        None, "motion of the base: recorded, reference (by markers), or given"
    )
    obstacle_motion: dict[str, MotionSettings | Literal["recorded"]] = setting(
        {}, "motion of obstacles, given or recorded"
    )
    payload_at: Place | None = setting(None, "vertices that carry payloads, in equal shares")
    up: SignedAxis | Direction | None = setting(
        None, "direction against gravity in the recordings; null: as configured"
    )
    seconds: Positive | None = setting(None, "evaluated duration after a release", "s")
    rest_seconds: NotNegative = setting(
        0.05, "duration before the inputs for the rest positions", "s"
    )
    longest_gap: Count = setting(5, "frames; longer occlusions are masked")
    steps: Natural | None = setting(
        None, "time steps read of a driven recording; null: the whole recording"
    )
    lead: NotNegative | None = setting(
        None,
        "driven recordings are read from here before inputs or markers first change; "
        "null: their first frame",
        "s",
    )
    parts: Annotated[Some[Natural], AfterValidator(different)] | None = setting(
        None, "chamber, tendon or muscle, from 1, of each column; null: in order"
    )
    input_limit: Positive | None = setting(
        None, "largest input: larger ones are refused, simulated ones clipped"
    )
    valve: Literal["recorded", "detected"] = setting(
        "recorded", "start of the inputs: as recorded, or detected from the markers"
    )
    cutoff: Positive | None = setting(
        None, "cutoff of the low-pass filter, for reconstruction only", "Hz"
    )


class RecordedData(ReadingSettings):
    """Trials that are observed through markers, recorded or played by a simulated laboratory."""

    kind: Literal["recorded"]
    trials: TrialTable = setting({}, "trials by name; none: all files of the folder")
    sequences: Count = setting(0, "trials under random inputs: t000, t001, ...")
    begins: Begins = setting(
        "held",
        "held at rest until the release; released with the first frame; rest, until inputs; "
        "driven, at rest under the first inputs; slack, where those do not act; static, a pose",
    )
    train_fraction: Share = setting(1.0, "share of every trial, from its start, for training")
    horizons: Annotated[Many[Positive], AfterValidator(rising)] = setting(
        (), "further durations over which errors are reported", "s"
    )
    input_scales: Annotated[Many[Positive], AfterValidator(different)] = setting(
        (), "factors of the inputs for additional test trials"
    )
    folds: Literal["leave_one_out"] | None = setting(
        None, "cross-validation over the trials; null: the split"
    )
    train: Trials = setting((), "names or number of trials; others: the rest")
    validation: Trials = setting((), "names or number of trials; others: the rest")
    test: Trials = setting((), "names or number of trials; others: the rest")
    splits: dict[str, Split] = setting({}, "train, validation and test by the name of a split")
    split: Word | None = setting(None, "one of splits, in place of train, validation and test")
    limit: LimitSettings | None = setting(None, "fewer trials, evenly chosen")

    @model_validator(mode="after")
    def _scales(self) -> Self:
        if self.split is not None and self.split not in self.splits:
            raise ValueError(
                f"split is {self.split!r}: choose from "
                f"{', '.join(self.splits) or 'splits, which is empty'}."
            )
        if self.split is not None and self.folds:
            raise ValueError(
                "split and folds exclude each other: "
                "set data.folds to null, or leave data.split out."
            )
        if 1.0 in self.input_scales:
            raise ValueError("input_scales has 1, which is always tested: leave it out.")
        if self.input_scales and self.folds:
            raise ValueError(
                "input_scales and data.folds exclude each other: take one of them out."
            )
        if self.input_scales and self.folder is not None:
            raise ValueError(
                "input_scales is for simulated trials, "
                "and recordings have their own inputs: leave it empty."
            )
        return self
