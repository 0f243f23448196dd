"""The page of all settings.

python docs/extensions/settings_page.py
"""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from warp_resphys.io.setting_errors import Schema, options
from warp_resphys.settings.body import BodySettings, TargetSettings
from warp_resphys.settings.run import RunSettings

_HEAD: Final = """# Settings

All keys of a run: `key=default`, its meaning, and its values with their unit [in brackets].
[Your robot](bring_your_robot.md) shows the few that a configuration needs. Set one with `key=value`
on the command line, or in a file of `configs/experiment`; `warp-resphys --cfg job` shows the values
of a run. `NAME` stands for any name. A key without a default is required. Keys of `simfree` that
are left out are as in `network` and `trainer`.

`python -m warp_resphys.settings.editor_schema configs/settings.schema.json` writes a JSON Schema,
with which editors complete and check YAML files that begin with
`# yaml-language-server: $schema=../settings.schema.json`.
`python docs/extensions/settings_page.py` writes this page.
"""

_REPLACED: Final = (
    "It may have the keys {} of the run, and `material` with the keys of `simulation`: each "
    "replaces the simulator's as a whole."
)
_OF_SHAPE: Final = "It has the keys {} of a body, of which `mesh` and `fixed` are required."
_TYPES: Final = {"object": "group", "boolean": "true/false", "string": "word"}


def page() -> str:
    """Returns the page of all keys, in Markdown."""
    schema = RunSettings.model_json_schema()
    return "\n".join([_HEAD, *_sections(schema, schema, "", "", {})])


def _sections(
    schema: Schema, node: Schema, path: str, default: str, shown: dict[str, str]
) -> Iterator[str]:
    """Yields a section for a group, one for each of its kinds, and those of the groups in it.

    Args:
        schema: JSON Schema of the run.
        node: JSON Schema of the group.
        path: dotted key of the group.
        default: sentence about the group where it is left out.
        shown: paths of the groups with a section, by their content.
    """
    kinds = [kind for kind in options(schema, node) if "properties" in kind]
    every = [kind["properties"] for kind in kinds]
    common = {
        name: key
        for name, key in every[0].items()
        if all(other.get(name) == key for other in every)
    }
    inherited = _inherited(path)
    below: list[tuple[Schema, str, str]] = []

    def entries(members: Mapping[str, Schema], required: list[str]) -> Iterator[str]:
        lines = []
        for name, key in members.items():
            if name in inherited or ("const" in key and kinds[1:]):
                continue
            values, group = (
                _values(key, schema),
                _group(schema, key, f"{path}.{name}".removeprefix(".")),
            )
            if group is not None:
                inner, at = group
                content = json.dumps(
                    [option["title"] for option in options(schema, inner) if "title" in option]
                )
                if content not in shown:
                    shown[content] = at
                    below.append((inner, at, "Required. " if name in required else _omitted(key)))
                    continue
                values = f"{'by name, ' if at.endswith('.NAME') else ''}as `{shown[content]}`"
            default = key.get("default")
            word = (
                default if isinstance(default, str) else json.dumps(default, separators=(",", ":"))
            )
            set_to = name if name in required else f"{name}={word}"
            meaning = f"{key['description']} ({values})" if "description" in key else values
            lines.append(f"- `{set_to}`: {meaning}")
        if lines:
            yield "\n".join([*lines, ""])

    yield f"## {f'`{path}`' if path else 'The run'}\n"
    about = kinds[0].get("description", "") if len(kinds) == 1 and path else ""
    if default or about:
        yield f"{default}{about}".rstrip() + "\n"
    if inherited:
        names = ", ".join(f"`{name}`" for name in inherited if name != "material")
        yield f"{(_OF_SHAPE if path.startswith('shapes') else _REPLACED).format(names)}\n"
    yield from entries(common, kinds[0].get("required", []))
    for kind in kinds if kinds[1:] else []:
        own = {name: key for name, key in kind["properties"].items() if name not in common}
        words = [f"`{name}: {key['const']}`" for name, key in own.items() if "const" in key]
        yield f"### {' '.join(words)}\n"
        yield f"{kind.get('description', '')}\n"
        yield from entries(own, kind.get("required", []))
    for inner, at, note in below:
        yield from _sections(schema, inner, at, note, shown)


def _omitted(node: Schema) -> str:
    """Says that a group is null by default, or may be, and what null means."""
    meaning = str(node.get("description", "")).partition("null: ")[2]
    if node.get("default", {}) is not None:
        return f"`null`: {meaning}. " if meaning and "default" in node else ""
    return f"Default `null`{f': {meaning}' if meaning else ''}. "


def _inherited(path: str) -> list[str]:
    """Keys of a group that are those of the run."""
    if path == "shapes.NAME":
        return [*BodySettings.model_fields]
    return [*TargetSettings.model_fields] if path in ("target", "laboratory") else []


def _group(schema: Schema, node: Schema, path: str) -> tuple[Schema, str] | None:
    """The part of a JSON Schema with keys, and its dotted key, with .NAME for groups by name."""
    choices = options(schema, node)
    if any("properties" in choice for choice in choices):
        return node, path
    inner = (choice.get("additionalProperties") for choice in choices)
    found = (_group(schema, value, f"{path}.NAME") for value in inner if isinstance(value, Mapping))
    return next((group for group in found if group is not None), None)


def _values(node: Schema, schema: Schema) -> str:
    """Describes the values of a key briefly, as in ">0 [m]"."""
    choices = [option for option in options(schema, node) if option.get("type") != "null"]
    unit = f" [{node['unit']}]" if "unit" in node else ""
    null = (
        ", null"
        if len(choices) < len(options(schema, node)) and node.get("default") is not None
        else ""
    )
    return " or ".join(dict.fromkeys(_type(option, schema) for option in choices)) + unit + null


def _type(node: Schema, schema: Schema) -> str:
    """Describes the values of one type, without their unit."""
    if "wanted" in node:
        return str(node["wanted"])
    if words := [node["const"]] if "const" in node else node.get("enum", []):
        return ", ".join(map(str, words))
    kind = node.get("type", "")
    if kind == "array":
        first = node.get("prefixItems", [node.get("items", {})])[0]
        members = _values(first, schema)
        members = re.sub(
            r"^(number|integer|word|group|list)\b",
            r"\1s",
            re.sub(r"^(\d)", r"lists of \1", members),
        )
        members = f"numbers {members}" if members[0] in "<>≤≥" else members
        if node.get("minItems") != node.get("maxItems", 0):
            return f"list of {members}"
        return f"{node['minItems']} {'of ' if 'enum' in first else ''}{members}"
    limits = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    given = [f"{sign}{node[key]:,g}" for key, sign in limits.items() if key in node]
    name = "" if kind == "number" and given else _TYPES.get(kind, kind)
    return f"{name} {', '.join(given)}".strip()


if __name__ == "__main__":
    Path(__file__).parents[1].joinpath("settings.md").write_text(
        f"{page().rstrip()}\n", encoding="utf-8"
    )
