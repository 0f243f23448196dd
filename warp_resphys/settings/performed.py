"""Settings of trials: motions of base and obstacles,
how trials begin, what holds them, and their split.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, model_validator

from ..core.mesh.place import Direction, Place
from ..io.settings import (
    Count,
    Many,
    Natural,
    NotNegative,
    Positive,
    Settings,
    Some,
    Vector,
    Word,
    setting,
)

# Held at rest until the release; released with the first frame; at rest until inputs are applied;
# at rest under the inputs of the first frame; at rest as those do not act, such as of a slack
# tendon; a static pose.
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
    about: Vector = setting(
        (0.0, 0.0, 0.0), "centre of rotation, to which the translation refers", "m"
    )
    start: NotNegative = setting(0.0, "start of the motion", "s")
    ramp: NotNegative = setting(0.0, "duration in which amplitudes grow from zero", "s")

    @model_validator(mode="after")
    def _has_one(self) -> Self:
        if (self.file is None) == (self.swings is None):
            raise ValueError(
                "file and swings: give one of them, a table of poses or sinusoids by any names."
            )
        if self.swings is not None and not self.swings:
            raise ValueError(
                "swings is empty: give one at least, "
                "as {a: {frequency: 1.0, translation: [0.01, 0, 0]}}."
            )
        return self


class WithoutMotion(Settings):
    """Base of data in which neither the base of the body nor obstacles move."""

    @property
    def base_motion(self) -> None:
        """Motion of the base: there is none."""
        return None

    @property
    def obstacle_motion(self) -> dict[str, MotionSettings]:
        """Motion of obstacles: none moves."""
        return {}


class WaveSettings(Settings):
    """Periodic inputs, `data.input_response.wave_inputs`."""

    frequency: Positive = setting(unit="Hz")
    phases: Some[float] = setting(
        description="initial phases, one per chamber, tendon or muscle", unit="rad"
    )
    mean: float = setting(description="mean, in the unit of the input")
    amplitude: Positive = setting(description="amplitude, in the unit of the input")
    start: NotNegative = setting(0.0, "time before which there are no inputs", "s")
    ramp: NotNegative = setting(0.0, "duration in which they grow from zero", "s")


BaseMotion = MotionSettings | Literal["recorded", "reference"] | None
ObstacleMotions = dict[str, MotionSettings]  # by obstacle


class _Performed(Settings):
    """Recording and inputs of a trial, in a configuration and in a run."""

    file: Word | None = setting(None, "recording, in the folder of the data")
    inputs: Some[float] | None = setting(
        None, "constant inputs, one for each chamber, tendon or muscle"
    )
    onset: NotNegative | None = setting(
        None, "start of the inputs, by the clock of the recording; null: at once", "s"
    )
    until: Positive | None = setting(
        None, "end of the inputs, by the same clock; null: that of the recording", "s"
    )
    input_delay: float = setting(0.0, "delay of the inputs against their log", "s")
    labels: Labels | None = setting(
        None, "labels in the order of its file; null: those of the file"
    )
    session: Word | None = setting(None, "session in which it was recorded; null: one session")
    payload: NotNegative = setting(0.0, "mass that hangs on the body", "kg")
    waves: WaveSettings | None = setting(
        None, "periodic inputs of a simulated trial, in place of random ones"
    )
    pull: Vector | None = setting(
        None, "force at the tip of a simulated body before its release", "N"
    )
    base_motion: MotionSettings | None = setting(None, "in place of data.base_motion")
    obstacle_motion: ObstacleMotions = setting({}, "in place of data.obstacle_motion")

    @model_validator(mode="after")
    def _is_a_pulse(self) -> Self:
        if (self.onset is not None or self.until is not None) and self.inputs is None:
            raise ValueError(
                "inputs is null: onset and until are of constant inputs, "
                "so give these, or leave them out."
            )
        if self.until is not None and self.until <= (self.onset or 0.0):
            raise ValueError(
                f"until is {self.until:g}: it must be above onset, {self.onset or 0.0:g} s."
            )
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
            raise ValueError(
                f"{name} cannot name a trial: files are named after it, "
                "so use letters, digits, _ and -."
            )
    return trials


TrialTable = Annotated[
    dict[
        str,
        Annotated[
            TrialSettings, BeforeValidator(by_file, json_schema_input_type=TrialSettings | str)
        ],
    ],
    AfterValidator(_named),
]


class HeldSettings(Settings):
    """Weight or twist that holds a body before its release, in its own test trial.

    A list of weights acts at once.
    """

    weight_g: NotNegative = setting(0.0, "weight", unit="g")
    direction: Direction = setting((0.0, 0.0, -1.0), "direction in which it pulls")
    at: Place | None = setting(None, "vertices that carry it, in equal shares; null: data.load")
    twist_deg: float = setting(0.0, "angle of the high end of a twisted body", "degrees")
    twist_axis: Axis = setting("x", "axis along which the angle grows")

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.weight_g > 0.0) == (self.twist_deg != 0.0):
            raise ValueError(
                f"weight_g is {self.weight_g:g} and twist_deg {self.twist_deg:g}: one of them "
                "holds the body, so give one, and leave the other at 0."
            )
        return self


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, (Mapping, HeldSettings)) else value


def _weights(loads: tuple[HeldSettings, ...]) -> tuple[HeldSettings, ...]:
    if len(loads) > 1 and any(one.twist_deg for one in loads):
        raise ValueError("it must be one twist, or a list of weights.")
    return loads


# One load, or a list of weights that act at the same time.
Held = Annotated[
    Some[HeldSettings],
    BeforeValidator(_listed, json_schema_input_type=HeldSettings | Some[HeldSettings]),
    AfterValidator(_weights),
]


# Of the tetrahedron that stands for a pose: signs of x, y and z.
CORNERS = ("+++", "+--", "-+-", "--+")


class Trial(_Performed):
    """A motion of the body, or a pose."""

    name: str
    begins: str  # one of `Begins`, or ``given`` where a simulation provides the state
    sequence: int | None = None  # number of its random inputs in a simulated laboratory, or None
    scale: float = 1.0  # factor of its simulated inputs
    amount: float = (
        0.0  # parameter of a simulated trial: a weight [kg], an angle [rad] or a factor of a motion
    )
    load: tuple[HeldSettings, ...] | None = (
        None  # what holds it, where that differs from the other trials
    )

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
        return (
            self.labels is None
            or label in self.labels
            or (corner in CORNERS and name in self.labels)
        )

    @property
    def recording(self) -> str:
        """Path of its recording in the run folder, in a simulated laboratory."""
        # Scaled ones have their own folder, as that of the others may be the data of another
        # experiment.
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
    """Largest number of trials of each split, evenly chosen.

    For the test, of folds if there are any.
    """

    train: Natural
    validation: Natural
    test: Natural
