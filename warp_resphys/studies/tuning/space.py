"""The group `tune` of the configuration: what is searched, over which values, and how long."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from pydantic import Field

from ...io.errors import InputError
from ...io.settings import Count, Natural, Positive, Settings, Word, setting

Name = Annotated[str, Field(pattern=r"^[\w-]+$", json_schema_extra={"wanted": "letters, digits, _ and - alone"})]


class Groups(Settings):
    """Settings of a training, by the group that they are in."""

    network: dict[str, Any] = setting({})
    trainer: dict[str, Any] = setting({})
    in_the_loop: dict[str, Any] = setting({})

    def dotted(self) -> dict[str, Any]:
        """The settings by dotted key, such as ``network.width``."""
        return {f"{group}.{name}": value for group, values in self.plain().items() for name, value in values.items()}


class Tune(Settings):
    """A search for settings of a network and its training."""

    model: Word = setting(description="resphys or simfree")
    trials: Natural = setting(description="finished trials, over all processes")
    trial_seconds: Positive | None = setting(None, "after which a trial is given up", unit="s")
    seed: Count = setting(0, "of what is tried")
    study: Name = setting(description="folder in tune/ of the run folder")
    save_as: Name = setting(description="name of the option in configs/tuned that has the best settings")
    space: Groups = setting(description="what is searched: lists of values, or ranges {low: .., high: .., log: ..}")
    settings: Groups = setting(Groups(), "what all trials have otherwise than a run")

    @property
    def dimensions(self) -> "dict[str, Dimension]":
        """What may vary, by dotted key, sorted.

        Raises:
            InputError: nothing varies, or something is neither a list of values nor a range.
        """
        found = {key: Dimension.of(f"tune.space.{key}", given) for key, given in self.space.dotted().items()}
        if not found:
            raise InputError("tune.space is empty: it must name at least one setting, such as network.width.")
        return dict(sorted(found.items()))


@dataclass(frozen=True)
class Dimension:
    """What a setting may be.

    Attributes:
        distribution: of what a sampler draws. Of a list of numbers, which is sorted, that is the place in it, since
            neighbours resemble each other.
        values: of the list; empty for a range.
    """

    distribution: BaseDistribution
    values: tuple[Any, ...] = ()

    @classmethod
    def of(cls, key: str, given: Any) -> "Dimension":
        """From the value of a key of the configuration."""
        try:
            if isinstance(given, list) and len(set(given)) == len(given) > 1:
                if all(map(_is_finite, given)):
                    return cls(IntDistribution(0, len(given) - 1), tuple(sorted(given)))
                if all(isinstance(value, (str, bool)) or _is_finite(value) for value in given):
                    return cls(CategoricalDistribution(given), tuple(given))
            if isinstance(given, Mapping) and _is_finite(given.get("low")) and _is_finite(given.get("high")):
                whole = isinstance(given["low"], int) and isinstance(given["high"], int)
                return cls((IntDistribution if whole else FloatDistribution)(**given))
        except (TypeError, ValueError) as error:
            raise InputError(f"{key} is {given}: {error}.") from error
        raise InputError(
            f"{key} is {given}: write two or more different numbers or words, as in [8, 16], or a range, as in "
            "{low: 1.0e-4, high: 1.0e-2, log: true}."
        )

    def value(self, drawn: Any) -> Any:
        """The setting that a drawn value stands for."""
        return self.values[drawn] if self.values and isinstance(self.distribution, IntDistribution) else drawn

    @property
    def log(self) -> bool:
        """Whether equal ratios count alike, instead of equal differences."""
        return bool(getattr(self.distribution, "log", False))

    @property
    def ends(self) -> tuple[Any, ...]:
        """The values of a list, or the limits of a range."""
        return self.values or (self.distribution.low, self.distribution.high)  # type: ignore[attr-defined]

    def __str__(self) -> str:
        """In words."""
        if self.values:
            return f"one of {', '.join(map(str, self.values))}"
        return f"{self.ends[0]:g} to {self.ends[1]:g}{' (log)' if self.log else ''}"


def _is_finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def with_settings(groups: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Groups of settings, with those of some dotted keys replaced."""
    result = dict(groups)
    for key, value in settings.items():
        group, _, name = key.partition(".")
        result[group] = {**result[group], name: value}
    return result
