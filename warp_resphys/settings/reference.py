"""Writes a reference of all settings, as a page and as a JSON Schema for editors.

    python -m warp_resphys.settings.reference docs/settings.md
    python -m warp_resphys.settings.reference configs/settings.schema.json

The first is the page of all keys. With the second, an editor completes and checks a YAML file that begins with
``# yaml-language-server: $schema=settings.schema.json`` (a path from that file, or absolute).
"""

import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from ..io.files import write_text
from ..io.setting_errors import Schema, in_words, options
from .body import BodySettings, TargetSettings
from .run import RunSettings

_HEAD: Final = """# Settings

This page lists every key of a run, for looking up names, units and ranges; [Bring your robot](bring_your_robot.md)
shows the few that a configuration needs. Units are SI. `warp-resphys --cfg job` shows the
values of a run, and `key=value` on the command line or in a file of `configs/experiment` sets one. `NAME` stands for
any name. In `simfree`, keys that are left out are as in the groups `network` and `trainer`.

`python -m warp_resphys.settings.reference configs/settings.schema.json` writes a JSON Schema, with which editors
complete and check YAML files that begin with `# yaml-language-server: $schema=../settings.schema.json`.
`python -m warp_resphys.settings.reference docs/settings.md` writes this page.
"""

_TARGETS: Final = {
    "target": " Constants and `model` of the material may stand directly in `target`.",
    "laboratory": "",
}
_LEFT_OUT: Final = (
    "Any of the keys {} of the run, and `material` with the keys of `simulation`, replaces that of the simulator as a "
    "whole, and those that are left out are those of the simulator that is corrected."
)
_SHAPE: Final = "shapes.NAME"
_OF_SHAPE: Final = "It has the keys {} of a body, of which `mesh` and `fixed` are required.\n"


def page() -> str:
    """Returns the page of all keys, in Markdown."""
    schema = RunSettings.model_json_schema()
    return "\n".join([_HEAD, *_sections(schema, schema, "", {})])


def _sections(schema: Schema, node: Schema, path: str, shown: dict[str, str]) -> Iterator[str]:
    """Yields a section for each kind of a group and for the groups in it, after the keys of the group.

    Args:
        schema: JSON Schema of the run.
        node: JSON Schema of the group.
        path: dotted key of the group.
        shown: keys of the groups with a section, by their content.
    """
    kinds = [kind for kind in options(schema, node) if "properties" in kind]
    for kind in kinds:
        words = [
            f"`{name}: {key['const']}`" for name, key in kind["properties"].items() if "const" in key and kinds[1:]
        ]
        yield f"## {' '.join([f'`{path}`' if path else 'The run', *words])}\n"
        if path:
            yield f"{kind.get('description', '')}\n"
        shared = [name for name in TargetSettings.model_fields if path in _TARGETS]
        if path == _SHAPE:
            shared = [*BodySettings.model_fields]
        if shared:
            names = ", ".join(f"`{name}`" for name in shared if name != "material")
            yield _OF_SHAPE.format(names) if path == _SHAPE else f"{_LEFT_OUT.format(names)}{_TARGETS[path]}\n"
        own = {name: key for name, key in kind["properties"].items() if name not in shared}
        groups = {name: key for name, key in own.items() if _groups_of(schema, key)}
        rows = [_row(schema, kind, name, key) for name, key in own.items() if name not in groups]
        if rows:
            yield "\n".join(["| key | it must be | default | meaning |", "|---|---|---|---|", *rows, ""])
        for name, group in groups.items():
            at = f"{path}.{name}" if path else name
            null = "null" if group.get("default", {}) is None else "default" if "default" in group else "required"
            keys = _groups_of(schema, group)
            assert keys is not None
            inner, suffix = keys
            if path or null != "default":
                meaning = group.get("description", "")
                yield f"`{at}` is a group, {null}{f': {meaning}' if meaning else ''}.\n"
            content = json.dumps([option["title"] for option in options(schema, inner) if "title" in option])
            if shown.setdefault(content, f"{at}{suffix}") != f"{at}{suffix}":
                yield f"`{at}{suffix}` has the keys of `{shown[content]}`.\n"
                continue
            yield from _sections(schema, inner, f"{at}{suffix}", shown)


def _groups_of(schema: Schema, node: Schema) -> tuple[Schema, str] | None:
    """The part of a JSON Schema with keys, and a suffix of the key of the group: .NAME for groups by name."""
    choices = options(schema, node)
    if any("properties" in choice for choice in choices):
        return node, ""
    for choice in choices:
        inner = choice.get("additionalProperties")
        if isinstance(inner, Mapping) and _groups_of(schema, inner):
            return inner, ".NAME"
    return None


def _row(schema: Schema, kind: Schema, name: str, node: Schema) -> str:
    default = "" if name in kind.get("required", ()) else f"`{json.dumps(node.get('default'))}`"
    cells = (f"`{name}`", in_words(node, schema), default, node.get("description", ""))
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def editor_schema() -> dict[str, Any]:
    """Returns the JSON Schema of a file of settings, in which keys may be missing, as it extends other options."""
    schema: dict[str, Any] = _partial(RunSettings.model_json_schema())
    schema["properties"] |= {"defaults": {"type": "array"}, "hydra": {"type": "object"}}
    return schema


def _partial(node: Any) -> Any:
    """A JSON Schema without lists of required keys."""
    if isinstance(node, Mapping):
        return {key: _partial(value) for key, value in node.items() if key != "required" or not isinstance(value, list)}
    return list(map(_partial, node)) if isinstance(node, list) else node


if __name__ == "__main__":
    for argument in map(Path, sys.argv[1:]):
        text = page() if argument.suffix == ".md" else json.dumps(editor_schema(), indent=2)
        write_text(argument, f"{text.rstrip()}\n")
