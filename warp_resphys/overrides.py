"""Arguments for Hydra in which names and paths stay as they were typed.

Hydra reads ``20261128``, ``1e5`` and ``null`` as numbers and null, commas and brackets as sweeps
and lists, and no letter beyond ASCII. Values of keys that take text alone, by the JSON Schema of
the settings, are put in quotes. Overrides whose keys Hydra cannot read, such as
``data.trials.001.payload=0.05``, change the composed configuration.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import reduce
from importlib import resources
from pathlib import Path
from types import MappingProxyType, NoneType
from typing import Any, Final, get_args

from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict

from .commands import CONFIG_PACKAGE, quote, quote_name
from .io.errors import InputError
from .io.setting_errors import Schema, is_text
from .settings.run import RunSettings

# A text that Hydra reads as such, a part of a key that it reads, a text in quotes, and a call of a
# function.
_PLAIN: Final = re.compile(
    r"(?!(?:true|false|null|inf|nan)\Z)(?:\.{0,2}/)?[a-z_][\w./-]*", re.ASCII | re.IGNORECASE
)
_KEY: Final = re.compile(r"[a-z_$][\w$-]*|0|[1-9]\d*", re.ASCII | re.IGNORECASE)
_QUOTED: Final = re.compile(r"""'(?:\\.|[^'\\])*'|"(?:\\.|[^"\\])*\"""")
_CALL: Final = re.compile(
    r"(?:bool|choice|float|glob|int|interval|range|shuffle|sort|str|tag)\(.*\)"
)
_PAIR: Final = re.compile(rf"\s*({_QUOTED.pattern}|[^:]*?)\s*:\s*(.*)", re.DOTALL)
_CLOSING: Final = {"[": "]", "{": "}", "(": ")", "'": "'", '"': '"'}
_BUDGETS: Final = (
    "budget_on"  # group of options: what a budget changes for one origin of the trials
)
_HYDRA_TEXTS: Final = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir", "hydra.job.name")


@dataclass(frozen=True)
class LateOverride:
    """An override of a composed configuration, whose key Hydra cannot read.

    Attributes:
        argument: on the command line.
        path: names of the groups and of the key.
        value: in Hydra's syntax; None removes the key.
    """

    argument: str
    path: tuple[str, ...]
    value: str | None

    def apply(self, config: DictConfig) -> None:
        """Changes a configuration.

        Raises:
            InputError: the key that is to be removed does not exist, or the value is a sweep.
        """
        with open_dict(config):
            if self.value is None:
                group: Any = config
                for name in self.path[:-1]:
                    group = group.get(name) or {}
                if self.path[-1] not in group:
                    raise InputError(f"cannot remove {'.'.join(self.path)}: there is no such key.")
                del group[self.path[-1]]
                return
            override = OverridesParser.create().parse_override(f"value={self.value}")
            if override.is_sweep_override():
                raise InputError(
                    f"cannot sweep over {'.'.join(self.path)}: choose a name of letters and digits."
                )
            config.merge_with(
                reduce(lambda inner, name: {name: inner}, reversed(self.path), override.value())
            )


def readable(
    arguments: Sequence[str],
    schema: Schema = MappingProxyType({}),
    config_dir: str | None = None,
    sweeps: bool = False,
) -> tuple[list[str], list[LateOverride]]:
    """Returns overrides as Hydra reads them, and those that change the composed configuration.

    Overrides may set keys that no YAML file mentions, since the settings classes check the keys.

    Args:
        arguments: overrides of a command line.
        schema: JSON Schema of the settings of the command.
        config_dir: folder with options of the user.
        sweeps: whether commas separate the values of a sweep.
    """
    folders = [resources.files(CONFIG_PACKAGE), *([] if config_dir is None else [Path(config_dir)])]
    groups = {
        entry.name
        for folder in folders
        if folder.is_dir()
        for entry in folder.iterdir()
        if entry.is_dir()
    }
    reader = _Reader(schema, groups, sweeps)
    overrides = [override for argument in arguments for override in reader.overrides(argument)]
    late = [override for override in overrides if isinstance(override, LateOverride)]
    return [override for override in overrides if isinstance(override, str)], late


def composed(name: str, arguments: Sequence[str] = ()) -> Any:
    """Returns the values of a configuration, such as ``config`` for a run,
    as a command line composes them.
    """
    words, late = readable(arguments)
    with initialize_config_module(CONFIG_PACKAGE, version_base="1.3"):
        config = compose(name, words, return_hydra_config=True)
    with open_dict(config):
        choices = config.pop("hydra").runtime.choices
    adjust(config, choices, late)
    return OmegaConf.to_container(config, resolve=True)


def adjust(config: DictConfig, choices: Mapping[str, str], late: Sequence[LateOverride]) -> None:
    """Changes a configuration that Hydra has composed from chosen options.

    A group that an experiment set to null stays null, if the settings allow that: Hydra gives it
    what a budget changes in it, and nothing else.
    """
    change = resources.files(CONFIG_PACKAGE) / _BUDGETS / f"{choices.get(_BUDGETS)}.yaml"
    changed: Any = OmegaConf.create(change.read_text(encoding="utf-8")) if change.is_file() else {}
    for name, group in changed.items():
        field = RunSettings.model_fields.get(name)
        if field and NoneType in get_args(field.annotation) and config.get(name) == group:
            config[name] = None
    for override in late:
        override.apply(config)


@dataclass(frozen=True)
class _Reader:
    """Puts texts in quotes.

    Attributes:
        schema: JSON Schema of the settings.
        groups: names of the configuration groups.
        sweeps: whether commas separate the values of a sweep.
    """

    schema: Schema
    groups: Set[str]
    sweeps: bool

    def overrides(self, argument: str) -> Iterator[str | LateOverride]:
        """Yields an override, or one for each name of a dictionary with names
        that Hydra would change.
        """
        mark = argument[: len(argument) - len(argument.lstrip("+~"))]
        key, equals, value = argument.removeprefix(mark).partition("=")
        if "/" in key or "@" in key or not (equals or mark == "~"):
            yield argument
        elif key in self.groups and value[:1] != "{":
            kept = (
                mark == "~"
                or value[:1] == "["
                or ("," in value and not self.sweeps and not os.path.exists(value))
            )
            yield argument if kept else f"{mark}{key}={self._swept(value, ('defaults', key))}"
        else:
            path = tuple(key.split("."))
            yield from self._spread(
                mark or "++" * (path[0] != "hydra"), path, value if equals else None
            )

    def _spread(
        self, mark: str, path: tuple[str, ...], value: str | None
    ) -> Iterator[str | LateOverride]:
        if value is not None and _has_special_names(value):
            for name, member in _pairs(value):
                name = name[1:-1] if _QUOTED.fullmatch(name) else name
                yield from self._spread(mark, (*path, name), member)
            return
        value = value and self._swept(value, path)
        if value == "{}":  # Hydra merges maps: null empties what others have set.
            yield from self._spread(mark, path, "null")
        argument = f"{mark}{'.'.join(path)}" + ("" if value is None else f"={value}")
        late = LateOverride(argument, path, None if mark == "~" else value)
        yield argument if all(map(_KEY.fullmatch, path)) else late

    def _swept(self, value: str, path: tuple[str, ...]) -> str:
        """A value or, in a sweep, several, with quotes where texts need them."""
        values = _members(f"[{value}]") if self.sweeps and not os.path.exists(value) else None
        return ",".join(self._value(one, path) for one in values or [value])

    def _value(self, value: str, path: tuple[str | int, ...]) -> str:
        """A value of a key, or an item of a list, with quotes where texts need them."""
        if is_text(self.schema, path, value) or ".".join(map(str, path)) in _HYDRA_TEXTS:
            return _text(value)
        if value[:1] == "[" and (items := _members(value)):
            whole = value[1:-1]
            items = (
                [whole]
                if is_text(self.schema, (*path, 0), whole) and os.path.exists(whole)
                else items
            )
            return f"[{','.join(self._value(item, (*path, at)) for at, item in enumerate(items))}]"
        if value[:1] == "{" and (pairs := _pairs(value)):
            members = [f"{name}:{self._value(member, (*path, name))}" for name, member in pairs]
            return f"{{{','.join(members)}}}"
        return value if value[:1] in (*_CLOSING, "") or _is_readable(value) else quote(value)


def _text(value: str) -> str:
    """A text, with quotes where Hydra would change it."""
    if any(form.fullmatch(value) for form in (_PLAIN, _QUOTED)) or (
        _CALL.fullmatch(value) and not os.path.exists(value)
    ):
        return value
    return quote_name(value)


def _is_readable(value: str) -> bool:
    try:
        OverridesParser.create().parse_override(f"value={value}")
    except HydraException:
        return False
    return True


def _has_special_names(value: str) -> bool:
    """Whether a dictionary has names that Hydra would change or refuse, at any depth."""
    return any(
        not _PLAIN.fullmatch(name) or _has_special_names(member) for name, member in _pairs(value)
    )


def _pairs(value: str) -> list[tuple[str, str]]:
    """Names and values of a dictionary in Hydra's syntax; nothing of another value."""
    pairs = (
        [_PAIR.fullmatch(member) for member in _members(value) or ()] if value[:1] == "{" else []
    )
    return [(pair[1], pair[2]) for pair in pairs if pair] if all(pairs) else []


def _members(value: str) -> list[str] | None:
    """Splits a list or a dictionary at commas outside of quotes and brackets.

    None where one of these is open.
    """
    if not value[1:-1].strip():
        return []
    members, opened, start = [], [value[0]], 1
    for at, letter in enumerate(value[1:-1], 1):
        if opened[-1] in "'\"":
            if letter == opened[-1] and (len(value[:at]) - len(value[:at].rstrip("\\"))) % 2 == 0:
                opened.pop()
        elif letter in "[{(" or (letter in "'\"" and value[:at].rstrip()[-1] in "[{(,:"):
            opened.append(letter)
        elif letter in "]})" and letter == _CLOSING[opened[-1]]:
            opened.pop()
            if not opened:
                return None
        elif letter == "," and len(opened) == 1:
            members.append(value[start:at].strip())
            start = at + 1
    members.append(value[start:-1].strip())
    return members if len(opened) == 1 and value[-1] == _CLOSING[value[0]] else None
