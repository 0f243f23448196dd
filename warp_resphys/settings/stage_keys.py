"""Settings of the stages of a run: a stage reads the keys of the run
that the pipeline names for it, and no others.

The fingerprint of a stage covers the content of these keys, and the values that the pipeline
derives for it. A key that is not named raises an AttributeError, so that no dependency of a file is
forgotten.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar

from pydantic import ConfigDict, PrivateAttr, model_validator
from typing_extensions import override

from ..core.mesh.place import Place
from ..io.safe_files import to_plain
from ..io.settings import Many, Settings, setting
from .body import SimulatorSettings, TargetSettings
from .control import ControlSettings, FigureSettings
from .data_kinds import ReadingSettings
from .learning import (
    AblationSettings,
    ActuatorSettings,
    IdentifySettings,
    LawSettings,
    ReconstructionSettings,
    TrainingSettings,
)
from .observed import BindingSettings
from .performed import Split, Trial
from .played import LaboratorySettings, PlaySettings
from .run import RunSettings

S = TypeVar("S", bound=Settings)


def keys_of(group: str, settings: type[Settings]) -> tuple[str, ...]:
    """Returns the dotted keys of a group that a class of settings has."""
    return tuple(f"{group}.{name}" for name in settings.model_fields)


SIMULATOR: Final = tuple(SimulatorSettings.model_fields)
BATCH: Final = "parallel.batch"
IMPORTED: Final = (
    *SIMULATOR,
    "simulation",
    "markers",
    "sensors",
    *keys_of("data", ReadingSettings),
)
# Keys of a simulated laboratory.
PLAYED: Final = (
    *("gravity", "time_step", "solver", "device", "seed", "tip", "sensors"),
    *keys_of("laboratory", PlaySettings),
    *keys_of("markers", BindingSettings),
    *keys_of("data", ReadingSettings),
)
# Keys of all stages of a split, and of all with networks.
LEARNING: Final = (
    *SIMULATOR,
    *("simulation", "markers", "sensors", "release", "force_frame", "identify", "law", "actuator"),
    *("data.payload_at", "data.seconds", "data.train_fraction", BATCH),
)
NETWORKS: Final = ("actuation", "range_guard")
FIGURES: Final = keys_of("control", FigureSettings)


class StageSettings(RunSettings):
    """The keys of a run that a stage reads, and the values that the pipeline derives for it."""

    model_config = ConfigDict(validate_default=False)

    reads: Many[str]  # keys of the run; a dotted key leads to one key of a group
    files: dict[str, str] = setting({})  # SHA-256 of all files that are read, by path
    trials: Many[Trial] = setting(())
    learned: Many[str] | None = setting(None)  # trials of training, validation; None with folds
    split: Split = setting(Split(train=(), validation=(), test=()))
    shared: str = setting("")  # folder of the dataset, from that of the split
    acquired: str = setting("")  # fingerprint of the stage that wrote the dataset
    model: str = setting("")
    reconstructed: Many[str] = setting(())  # names of the trials
    training: TrainingSettings = setting(None)
    groups: dict[str, Many[str]] = setting({})  # test trials by scale of the inputs, ``1`` first
    calibration: Many[str] = setting(())  # names of the trials that prediction intervals come from
    must_reach: bool = setting(False)  # whether the robot must be able to reach all figures
    folds: dict[str, Any] = setting({})  # errors of models in cross-validation, by left-out trial
    _whole: dict[str, Any] = PrivateAttr(default_factory=dict)  # all keys of the run

    if TYPE_CHECKING:  # A stage with a group is part of runs that have it.
        data: Any
        tip: Place
        target: TargetSettings
        laboratory: LaboratorySettings
        identify: IdentifySettings
        law: LawSettings
        actuator: ActuatorSettings
        reconstruction: ReconstructionSettings
        control: ControlSettings
        ablation: AblationSettings
        mesh_check: float

    @model_validator(mode="after")
    def _lacks_others(self) -> Self:
        self._whole.update(self.__dict__)
        derived = {
            name: value
            for name, value in self.__dict__.items()
            if name not in RunSettings.model_fields
        }
        object.__setattr__(self, "__dict__", _part(self, self.reads) | derived)
        return self

    @classmethod
    def reading(cls, run: RunSettings, *keys: str, **values: Any) -> Self:
        """Returns the settings of a stage.

        Args:
            run: settings of the run.
            keys: those that the stage reads; a dotted key leads to one key of a group.
            values: what is derived from the run.
        """
        return cls(**dict(run), **values, reads=tuple(dict.fromkeys(keys)))

    @override
    def plain(self) -> dict[str, Any]:
        """Returns nested data of JSON types with all keys of the run,
        from which `parse` makes this object again.
        """
        whole = self.model_copy()
        object.__setattr__(whole, "__dict__", self._whole)
        absent = (
            type(self).model_fields.keys() - self.model_fields_set - RunSettings.model_fields.keys()
        )
        return whole.model_dump(mode="json", by_alias=True, exclude=absent)

    @override
    def content(self) -> Any:
        derived = self.model_fields_set - RunSettings.model_fields.keys() - {"reads"}
        values = {
            name: value for name, value in self.__dict__.items() if name in RunSettings.model_fields
        }
        values |= {name: self.__dict__[name] for name in derived}
        return {name: _content(value) for name, value in values.items()}


def _part(group: Settings, keys: Iterable[str]) -> dict[str, Any]:
    """Returns the values of some keys of a group by name.

    A dotted key leads to one key of a group in it.

    Names that the group lacks are left out, as it may be of another kind.
    """
    below: dict[str, list[str]] = {}
    for key in keys:
        name, _, rest = key.partition(".")
        below.setdefault(name, []).append(rest)
    values = {name: getattr(group, name) for name in below if name in type(group).model_fields}
    return {
        name: _only(value, below[name])
        if "" not in below[name] and isinstance(value, Settings)
        else value
        for name, value in values.items()
    }


def _only(group: S, keys: Iterable[str]) -> S:
    """Returns a group that has some keys alone."""
    part = group.model_copy()
    object.__setattr__(part, "__dict__", _part(group, keys))
    return part


def _content(value: Any) -> Any:
    """Returns nested data of settings of which some lack keys."""
    if isinstance(value, Settings) and value.__dict__.keys() == type(value).model_fields.keys():
        return value.plain()
    if isinstance(value, Settings):
        return {name: _content(one) for name, one in value.__dict__.items()}
    return to_plain(value)
