"""YAML files of configuration groups as Hydra reads them,
with names that stay as they were written.

YAML reads ``001``, ``on`` and ``1e3`` as numbers and truth values. Here all keys are texts, and so
are values of keys that take text alone, by the JSON Schema of a run's settings.

Hydra merges a group with those of the files before it. With ``_replace_: true`` in it, it replaces
them: directly before such a file, Hydra also reads a file ``NAME.emptying`` that does not exist, in
which these groups are null.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Final

import yaml
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf

from .commands import quote
from .io.errors import InputError
from .io.setting_errors import Path as KeyPath
from .io.setting_errors import Schema, is_text
from .io.text import read_text
from .settings.run import RunSettings

_REPLACE: Final = "_replace_"
_EMPTYING: Final = ".emptying"
_Names = list[str]  # Sources have a method `list`.
_SCHEME: Final = "options"  # of folders that are read here, on Hydra's search path


class _OptionSource(ConfigSource):
    """Reads the files of a folder."""

    @staticmethod
    def scheme() -> str:
        return _SCHEME

    def available(self) -> bool:
        return self.is_group("")

    def is_group(self, config_path: str) -> bool:
        return Path(self.path, config_path).is_dir()

    def is_config(self, config_path: str) -> bool:
        return self._file(config_path).is_file()

    def list(self, config_path: str, results_filter: ObjectType | None) -> _Names:
        found: _Names = []
        for name in os.listdir(Path(self.path, config_path)):
            self._list_add_result(found, os.path.join(config_path, name), name, results_filter)
        return sorted(set(found))

    def _file(self, config_path: str) -> Path:
        return Path(self.path, self._normalize_file_name(config_path.removesuffix(_EMPTYING)))

    def load_config(self, config_path: str) -> ConfigResult:
        name = config_path.removesuffix(_EMPTYING)
        path = self._file(name).resolve()
        text = read_text(path)
        header = self._get_header_dict(text)
        package = header["package"] or name.rpartition("/")[0].replace("/", ".")
        quoted = _with_quotes(
            text, () if package == "_global_" else tuple(package.split(".")), path
        )
        values: Any = OmegaConf.to_container(OmegaConf.load(_stream(quoted, path)))
        replaced = _without_marks(values) if isinstance(values, dict) else {}
        if name != config_path:
            values = replaced
        elif replaced:
            _add_before(values, name.rpartition("/")[2] + _EMPTYING)
        config = OmegaConf.create(values)
        return ConfigResult(
            config=config,
            path=f"{self.scheme()}://{self.path}",
            provider=self.provider,
            header=header,
        )


class _OptionFolders(SearchPathPlugin):
    """Puts folders of options on Hydra's search path.

    Attributes:
        added: the folders, within `own_options`.
    """

    added: ClassVar[list[str] | None] = None

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        if self.added is None:
            return
        for element in search_path.get_path():
            element.path = _read_here(element.path)
        for folder in self.added:
            search_path.append("options", _read_here(folder))


@contextmanager
def own_options(folder: str | None) -> Iterator[None]:
    """Lets Hydra read folders as this module describes, and one more folder than it would.

    Raises:
        InputError: there is no such folder.
    """
    if folder is not None and not os.path.isdir(folder):
        place = os.path.abspath(folder)
        raise InputError(f"Additional config directory '{place}' not found")
    for plugin in (_OptionSource, _OptionFolders):
        Plugins.instance().register(plugin)
    _OptionFolders.added = [] if folder is None else [os.path.abspath(folder)]
    try:
        yield
    finally:
        _OptionFolders.added = None


def search_path_read_here(override: str) -> str:
    """An override of Hydra's search path whose folders are read here; others stay."""
    key, _, value = override.partition("=")
    if key.lstrip("+") != "hydra.searchpath" or value[:1] != "[":
        return override
    places: Any = OverridesParser.create().parse_override(override).value()
    return f"{key}=[{','.join(quote(_read_here(str(place))) for place in places)}]"


def _read_here(place: str) -> str:
    """A place on Hydra's search path, which `_OptionSource` reads if it is a folder."""
    folder = place.removeprefix("file://")
    return place if "://" in folder else f"{_SCHEME}://{folder}"


@cache
def run_schema() -> Schema:
    """Returns the JSON Schema of the settings of a run."""
    return RunSettings.model_json_schema()


def _with_quotes(text: str, package: KeyPath, path: Path) -> str:
    """Puts quotes around the keys of a YAML file, and around values that are texts."""
    places = set[tuple[int, int]]()
    for node in _texts(yaml.compose(_stream(text, path), Loader=yaml.SafeLoader), package):
        if node.style is None and node.value not in ("", "<<"):
            start, end = node.start_mark.index, node.end_mark.index
            anchor = re.match(r"&\S+\s+", text[start:end])
            start += anchor.end() if anchor else 0
            if text[start] != "!":  # A tag gives the type.
                places.add((start, end))
    for start, end in sorted(places, reverse=True):
        written = text[start:end].replace("'", "''")
        text = f"{text[:start]}'{written}'{text[end:]}"
    return text


def _stream(text: str, path: Path) -> io.StringIO:
    """Returns a stream with the name of a file, which errors of YAML tell."""
    stream = io.StringIO(text)
    stream.name = str(path)
    return stream


def _texts(node: yaml.Node | None, path: KeyPath) -> Iterator[yaml.ScalarNode]:
    """Yields the keys, and the values that are texts,
    of the part of a file that stands at a path of the settings.
    """
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield from [key] if isinstance(key, yaml.ScalarNode) else []
            yield from _texts(value, path if key.value == "<<" else (*path, str(key.value)))
    elif isinstance(node, yaml.SequenceNode):
        for at, item in enumerate(node.value):
            yield from _texts(item, (*path, at))
    elif isinstance(node, yaml.ScalarNode) and path and is_text(run_schema(), path, node.value):
        yield node


def _without_marks(values: dict[str, Any]) -> dict[str, Any]:
    """Removes the marks of groups that replace others,
    and returns these groups with null in place of their keys.
    """
    replaced: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            replaces, inside = value.pop(_REPLACE, False), _without_marks(value)
            if replaces or inside:
                replaced[key] = None if replaces else inside
    return replaced


def _add_before(values: dict[str, Any], file: str) -> None:
    """Adds a file to the defaults list, directly before the file that has the list.

    Overrides stay at its end.
    """
    defaults = values.setdefault("defaults", [])
    defaults += [] if "_self_" in defaults else ["_self_"]
    at_its_end = [
        entry == "_self_" or str(next(iter(entry))).startswith("override ") for entry in defaults
    ]
    defaults.insert(at_its_end.index(True), file)
