"""Writes what the classes of settings say, for readers and for editors.

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
from .run import RunSettings

_HEAD: Final = """# Settings

Every key of a run, as the classes in `warp_resphys/settings` have it. Units are SI. `warp-resphys --cfg job` shows the
values of a run, and `key=value` on the command line or in a file of `configs/experiment` sets one. `NAME` stands for
any name. In `simfree`, keys that are left out are as in the groups `network` and `trainer`.

`python -m warp_resphys.settings.reference configs/settings.schema.json` writes a JSON Schema, with which editors
complete and check YAML files that begin with `# yaml-language-server: $schema=../settings.schema.json`. This page is
made by `python -m warp_resphys.settings.reference docs/settings.md`.
"""


def page() -> str:
    """The page of all keys, in Markdown."""
    schema = RunSettings.model_json_schema()
    return "\n".join([_HEAD, *_sections(schema, schema, "", {})])


def _sections(schema: Schema, node: Schema, path: str, shown: dict[str, str]) -> Iterator[str]:
    """A section for each kind of a group and for the groups in it; keys of a whole run come first.

    Args:
        schema: JSON Schema of the class of the whole.
        node: that of the group.
        path: dotted key of the group.
        shown: keys of the groups that have a section, by their content.
    """
    kinds = [each for each in options(schema, node) if "properties" in each]
    for kind in kinds:
        words = [f"`kind: {kind['properties']['kind']['const']}`"] if len(kinds) > 1 else []
        yield f"## {' '.join([f'`{path}`' if path else 'The run', *words])}\n"
        if path:
            yield f"{kind.get('description', '')}\n"
        groups = {name: each for name, each in kind["properties"].items() if _groups_of(schema, each)}
        rows = [_row(schema, kind, name, each) for name, each in kind["properties"].items() if name not in groups]
        if rows:
            yield "\n".join(["| key | it must be | default | meaning |", "|---|---|---|---|", *rows, ""])
        for name, each in groups.items():
            at = f"{path}.{name}" if path else name
            null = "null" if each.get("default", {}) is None else "default" if "default" in each else "required"
            found = _groups_of(schema, each)
            assert found is not None
            inner, suffix = found
            if path or null != "default":
                meaning = each.get("description", "")
                yield f"`{at}` is a group, {null}{f': {meaning}' if meaning else ''}.\n"
            content = json.dumps([each.get("title") for each in options(schema, inner)])
            if shown.setdefault(content, f"{at}{suffix}") != f"{at}{suffix}":
                yield f"`{at}{suffix}` has the keys of `{shown[content]}`.\n"
                continue
            yield from _sections(schema, inner, f"{at}{suffix}", shown)


def _groups_of(schema: Schema, node: Schema) -> tuple[Schema, str] | None:
    """The part of a JSON Schema that has keys, and what follows the key of the group: .NAME for groups by name."""
    choices = options(schema, node)
    if any("properties" in each for each in choices):
        return node, ""
    for each in choices:
        inner = each.get("additionalProperties")
        if isinstance(inner, Mapping) and _groups_of(schema, inner):
            return inner, ".NAME"
    return None


def _row(schema: Schema, kind: Schema, name: str, node: Schema) -> str:
    default = "" if name in kind.get("required", ()) else f"`{json.dumps(node.get('default'))}`"
    cells = (f"`{name}`", in_words(node, schema), default, node.get("description", ""))
    return f"| {' | '.join(each.replace('|', '/') for each in cells)} |"


def editor_schema() -> dict[str, Any]:
    """JSON Schema of a file of settings, which may leave out what the options that it builds on say."""
    schema: dict[str, Any] = _partial(RunSettings.model_json_schema())
    schema["properties"] |= {"defaults": {"type": "array"}, "hydra": {"type": "object"}}
    return schema


def _partial(node: Any) -> Any:
    """The same without required keys, but for the kind of a group that has several."""
    if isinstance(node, Mapping):
        return {key: _partial(each) for key, each in node.items() if key != "required" or not isinstance(each, list)}
    return [_partial(each) for each in node] if isinstance(node, list) else node


if __name__ == "__main__":
    for argument in map(Path, sys.argv[1:]):
        text = page() if argument.suffix == ".md" else json.dumps(editor_schema(), indent=2)
        write_text(argument, f"{text.rstrip()}\n")
