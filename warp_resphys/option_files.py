"""YAML files of configuration groups as Hydra reads them, with names that stay as they were written.

YAML reads ``001``, ``on`` and ``1e3`` as numbers and truth values. Here all keys are texts, and so are values of keys
that take text alone, by the JSON Schema of a run's settings.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Final

import yaml
from hydra._internal.core_plugins import file_config_source
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from omegaconf import OmegaConf

from .io.setting_errors import Schema, is_text
from .io.text import read_text
from .settings.run import RunSettings

_QUOTE: Final = "'"
_REPLACE: Final = "_replace_"  # in a group of settings: it replaces that of the files below, which Hydra would merge
_EMPTYING: Final = ".emptying"  # end of the name of a file that does not exist, in which such groups are null


class _OptionSource(file_config_source.FileConfigSource):
    """Reads the files of a folder."""

    def is_config(self, config_path: str) -> bool:
        return bool(super().is_config(config_path.removesuffix(_EMPTYING)))

    def load_config(self, config_path: str) -> ConfigResult:
        name = config_path.removesuffix(_EMPTYING)
        path = Path(self.path, self._normalize_file_name(name)).resolve()
        text = read_text(path)
        header = self._get_header_dict(text)
        package = header["package"] or name.rpartition("/")[0].replace("/", ".")
        config = OmegaConf.load(_with_quotes(text, () if package == "_global_" else tuple(package.split(".")), path))
        values: Any = OmegaConf.to_container(config)
        if isinstance(values, dict) and (empty := _without_marks(values)):
            if name == config_path:  # The other file comes directly before this one.
                defaults = values.setdefault("defaults", [])
                defaults += [] if "_self_" in defaults else ["_self_"]
                last = (at for at, entry in enumerate(defaults) if entry == "_self_" or _is_override(entry))
                defaults.insert(next(last), name.rpartition("/")[2] + _EMPTYING)
            config = OmegaConf.create(values if name == config_path else empty)
        return ConfigResult(config=config, path=f"{self.scheme()}://{self.path}", provider=self.provider, header=header)


def _is_override(entry: Any) -> bool:
    """Whether an entry of a defaults list chooses another option, as in ``override /trainer: short``; they are last."""
    return isinstance(entry, dict) and str(next(iter(entry))).startswith("override ")


@contextmanager
def names_are_texts() -> Iterator[None]:
    """Lets Hydra read the files of folders as this module describes; its registry of sources is restored at the end."""
    Plugins.instance()  # registers Hydra's own sources
    sources, scheme = SourcesRegistry.instance().types, _OptionSource.scheme()
    before, sources[scheme] = sources[scheme], _OptionSource
    try:
        yield
    finally:
        sources[scheme] = before


@cache
def run_schema() -> Schema:
    """Returns the JSON Schema of the settings of a run."""
    return RunSettings.model_json_schema()


def _with_quotes(text: str, package: tuple[str, ...], path: Path) -> io.StringIO:
    """The text of a YAML file with quotes around keys, and around values that are texts."""
    schema, places = run_schema(), set[tuple[int, int]]()

    def visit(node: yaml.Node | None, path: tuple[str | int, ...]) -> None:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                add(key)
                visit(value, path if key.value == "<<" else (*path, str(key.value)))
        elif isinstance(node, yaml.SequenceNode):
            for at, item in enumerate(node.value):
                visit(item, (*path, at))
        elif isinstance(node, yaml.ScalarNode) and path and is_text(schema, path, node.value):
            add(node)

    def add(node: yaml.Node) -> None:
        """Notes the place of a scalar without quotes."""
        if isinstance(node, yaml.ScalarNode) and node.style is None and node.value not in ("", "<<"):
            start, end = node.start_mark.index, node.end_mark.index
            start += len(re.match(r"(?:&\S+\s+)?", text[start:end])[0])  # type: ignore[index]
            if text[start] != "!":
                places.add((start, end))

    def stream() -> io.StringIO:
        stream = io.StringIO(text)
        stream.name = str(path)  # for YAML's errors
        return stream

    visit(yaml.compose(stream(), Loader=yaml.SafeLoader), package)
    for start, end in sorted(places, reverse=True):
        text = f"{text[:start]}'{text[start:end].replace(_QUOTE, _QUOTE * 2)}'{text[end:]}"
    return stream()


def _without_marks(values: dict[str, Any]) -> dict[str, Any]:
    """Removes the marks of groups that replace others, and returns these groups with null in place of their keys."""
    empty: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            replaces, inside = value.pop(_REPLACE, False), _without_marks(value)
            if replaces or inside:
                empty[key] = None if replaces else inside
    return empty
