"""Search spaces: which settings vary, and over what."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from optuna.trial import Trial

from ...experiment.schema import ANYTHING, Group, absent, check, dotted, is_finite
from ...io.errors import InputError

SEARCHED_GROUPS = ("network", "trainer", "in_the_loop")


@dataclass(frozen=True)
class Range:
    """All numbers between two."""

    low: float
    high: float
    log: bool  # whether equal ratios count alike, instead of equal differences
    whole: bool  # whether only whole numbers are meant

    @property
    def ends(self) -> tuple[Any, ...]:
        """The values that limit the others."""
        return (self.low, self.high)

    def suggest(self, trial: Trial, key: str) -> Any:
        """What a sampler draws, or has drawn."""
        if self.whole:
            return trial.suggest_int(key, int(self.low), int(self.high), log=self.log)
        return trial.suggest_float(key, self.low, self.high, log=self.log)

    def __str__(self) -> str:
        """In words."""
        return f"{self.low:g} to {self.high:g}{' (log)' if self.log else ''}"


@dataclass(frozen=True)
class Choice:
    """One of some values; numbers stand in their order, from the smallest to the largest.

    Of numbers, the sampler draws the place, as neighbours resemble each other.
    """

    values: tuple[Any, ...]

    @property
    def ordered(self) -> bool:
        """Whether the values are numbers."""
        return all(map(is_finite, self.values))

    @property
    def ends(self) -> tuple[Any, ...]:
        """All values."""
        return self.values

    def suggest(self, trial: Trial, key: str) -> Any:
        """What a sampler draws, or has drawn."""
        if self.ordered:
            return self.values[trial.suggest_int(key, 0, len(self.values) - 1)]
        return trial.suggest_categorical(key, self.values)

    def __str__(self) -> str:
        """In words."""
        return f"one of {', '.join(map(str, self.values))}"


Dimension = Range | Choice


def parse_space(space: Any) -> dict[str, Dimension]:
    """The configured search space.

    Args:
        space: nested as the configuration is: ``{network: {width: [64, 128]}, trainer: {gamma: {low: 0.8,
            high: 1.0}}}``.

    Returns:
        What each setting may be, by its dotted key, sorted by key.

    Raises:
        InputError: a key outside of the groups that can be searched, or no range.
    """
    check("tune.space", space, Group({group: absent(Group(each=ANYTHING)) for group in SEARCHED_GROUPS}))
    found = {
        f"{group}.{name}": _parse_dimension(f"tune.space.{group}.{name}", given)
        for group, ranges in space.items()
        for name, given in ranges.items()
    }
    if not found:
        raise InputError("tune.space is empty: it must name at least one setting, such as network.width.")
    return dict(sorted(found.items()))


def _parse_dimension(key: str, given: Any) -> Dimension:
    if isinstance(given, list):
        if len(given) < 2 or any(given.count(value) > 1 for value in given):
            raise InputError(f"{key} is {given}: it must list two or more different values.")
        if not all(isinstance(value, (str, bool)) or is_finite(value) for value in given):
            raise InputError(f"{key} is {given}: it must list numbers or words.")
        choice = Choice(tuple(given))
        return Choice(tuple(sorted(given))) if choice.ordered else choice
    if not isinstance(given, Mapping) or not {"low", "high"} <= given.keys() <= {"low", "high", "log"}:
        raise InputError(f"{key} is {given!r}: write {{low: 1.0e-4, high: 1.0e-2, log: true}} or a list of values.")
    low, high, log = given["low"], given["high"], given.get("log", False)
    if not (is_finite(low) and is_finite(high) and low < high):
        raise InputError(f"{key} is {dict(given)}: low and high must be finite numbers, and low the smaller one.")
    if not isinstance(log, bool) or (log and low <= 0):
        raise InputError(f"{key} is {dict(given)}: log must be true or false, and true needs positive numbers.")
    return Range(low, high, log, whole=isinstance(low, int) and isinstance(high, int))


def with_settings(groups: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Groups of settings, with those of some dotted keys replaced."""
    result = dict(groups)
    for key, value in settings.items():
        group, _, name = key.partition(".")
        result[group] = {**result[group], name: value}
    return result


def fixed_settings(tune: Mapping[str, Any]) -> dict[str, Any]:
    """What all trials have otherwise than a run, by dotted key, from the group ``tune``."""
    return {key: value for key, value in dotted(tune["settings"]) if value not in ({}, None) or "." in key}
