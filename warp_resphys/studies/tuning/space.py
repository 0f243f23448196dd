"""The group `tune` of the configuration: the search space, and how many trials are run."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from pydantic import Field

from ...io.errors import InputError
from ...io.settings import Count, Natural, Positive, Settings, Word, parse, setting
from ...settings.learning import TrainingSettings

Name = Annotated[str, Field(pattern=r"^[\w-]+$", json_schema_extra={"wanted": "letters, digits, _ and - alone"})]


class Groups(Settings):
    """Settings of a training by group."""

    network: dict[str, Any] = setting({})
    trainer: dict[str, Any] = setting({})
    in_the_loop: dict[str, Any] = setting({})

    def dotted(self) -> dict[str, Any]:
        """Returns the settings by dotted key, such as ``network.width``."""
        return {f"{group}.{name}": value for group, values in self.plain().items() for name, value in values.items()}


class Tune(Settings):
    """A search for settings of a network and its training."""

    model: Word = setting(description="resphys or simfree")
    trials: Natural = setting(description="finished trials, over all processes")
    trial_seconds: Positive | None = setting(None, "after which a trial is stopped", unit="s")
    seed: Count = setting(0, "of the sampler")
    study: Name = setting(description="folder in tune/ of the run folder")
    save_as: Name = setting(description="name of the option in configs/tuned that has the best settings")
    space: Groups = setting(description="search space: lists of values, or ranges {low: .., high: .., log: ..}")
    settings: Groups = setting(Groups(), "settings of all trials that differ from those of the run")

    @property
    def dimensions(self) -> "dict[str, Dimension]":
        """The search space by dotted key, sorted.

        Raises:
            InputError: the space is empty, or a value is neither a list of values nor a range.
        """
        space = {key: Dimension.of(f"tune.space.{key}", values) for key, values in self.space.dotted().items()}
        if not space:
            raise InputError("tune.space is empty: it must name at least one setting, such as network.width.")
        return dict(sorted(space.items()))


@dataclass(frozen=True)
class Dimension:
    """Values that a setting may have.

    Attributes:
        distribution: from which a sampler draws; for a list of numbers, indices into the sorted list, as neighbours
            are similar.
        values: of the list; empty for a range.
    """

    distribution: BaseDistribution
    values: tuple[Any, ...] = ()

    @classmethod
    def of(cls, key: str, values: Any) -> "Dimension":
        """Makes a dimension of a configured list or range.

        Raises:
            InputError: the value of ``key`` is neither.
        """
        try:
            if isinstance(values, list) and len(set(values)) == len(values) > 1:
                if all(map(_is_finite, values)):
                    return cls(IntDistribution(0, len(values) - 1), tuple(sorted(values)))
                if all(isinstance(value, (str, bool)) or _is_finite(value) for value in values):
                    return cls(CategoricalDistribution(values), tuple(values))
            if isinstance(values, Mapping) and _is_finite(values.get("low")) and _is_finite(values.get("high")):
                whole = isinstance(values["low"], int) and isinstance(values["high"], int)
                return cls((IntDistribution if whole else FloatDistribution)(**values))
        except (TypeError, ValueError) as error:
            raise InputError(f"{key} is {values}: {error}.") from error
        raise InputError(
            f"{key} is {values}: write two or more different numbers or words, as in [8, 16], or a range, as in "
            "{low: 1.0e-4, high: 1.0e-2, log: true}."
        )

    def value(self, drawn: Any) -> Any:
        """Returns the setting for a drawn value."""
        return self.values[drawn] if self.values and isinstance(self.distribution, IntDistribution) else drawn

    @property
    def log(self) -> bool:
        """Whether the scale is logarithmic."""
        return bool(getattr(self.distribution, "log", False))

    @property
    def ends(self) -> tuple[Any, ...]:
        """The values of a list, or the limits of a range."""
        return self.values or (self.distribution.low, self.distribution.high)  # type: ignore[attr-defined]

    def __str__(self) -> str:
        """Describes the values, as on the page of a search."""
        if self.values:
            return f"one of {', '.join(map(str, self.values))}"
        return f"{self.ends[0]:g} to {self.ends[1]:g}{' (log)' if self.log else ''}"


def _is_finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def with_settings(training: TrainingSettings, changes: Mapping[str, Any]) -> TrainingSettings:
    """Returns the settings of a training with changes by dotted key.

    Raises:
        InputError: a value that cannot be used.
    """
    values = training.plain()
    for key, value in changes.items():
        group, _, name = key.partition(".")
        values[group][name] = value
    return parse(TrainingSettings, values)
