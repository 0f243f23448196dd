"""Error messages for refused settings: one sentence with the dotted key, the value, and what it must be.

Types, ranges and units come from the JSON Schema of the settings class.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from pydantic_core import ErrorDetails

from .errors import did_you_mean

Schema = Mapping[str, Any]
Path = Sequence[str | int]  # keys and list indices that lead to a value

_NOUNS: Final = {"string": "word", "number": "number", "integer": "whole number"}
_NUMBERS: Final = ("no", "one", "two", "three", "four", "five", "six")


def sentence(schema: Schema, values: Any, where: str, errors: Sequence[ErrorDetails]) -> str:
    """Returns the message of the most informative error: an unknown key, else the most deeply nested one.

    Args:
        schema: JSON Schema of the class.
        values: the refused values.
        where: dotted key of the group; empty for a whole configuration.
        errors: of pydantic.
    """

    def rank(located: tuple[ErrorDetails, Path]) -> tuple[bool, int, bool]:
        error, path = located
        return error["type"] == "extra_forbidden", len(path), error["type"] == "value_error"

    error, path = max(((error, _path(values, error)) for error in errors), key=rank)
    key, kind, context = _dotted(path, where), error["type"], error.get("ctx", {})
    if kind == "extra_forbidden":
        return _unknown(schema, values, where, path)
    value, node = _value(values, path), _node(schema, path, values)
    if error["loc"][-1:] == ("[key]",):
        return (
            f"{_dotted(error['loc'][:-2], where)} has the name {_shown(error['input'])}, not a text: put it in quotes."
        )
    if kind == "missing" and path[-1:] == [error["loc"][-1]]:
        return f"{key} is missing: it must be {in_words(node, schema)}."
    if kind.startswith("union_tag"):
        tag = str(context.get("discriminator", "")).strip("'")
        kinds = [str(word) for option in options(schema, node) for word in _words_of(option["properties"][tag])]
        if not isinstance(value, Mapping):
            return f"{key} is {_shown(value)}: it must be a group of settings."
        return f"{_dotted([tag], key)} is {_shown(value.get(tag))}: it must be one of {', '.join(kinds)}."
    if kind == "value_error":
        message = str(context["error"])
        if not isinstance(value, Mapping):
            return f"{key} is {_shown(value)}: {message}"
        return f"{key}.{message}" if key else message
    texts = value if isinstance(value, (list, tuple)) else [value]
    is_number = kind == "string_type" and any(isinstance(text, (bool, int, float)) for text in texts)
    quoted = ", in quotes" if is_number else ""
    return f"{key} is {_shown(value)}: it must be {in_words(node, schema)}{quoted}."


def _shown(value: Any) -> str:
    """A value as YAML has it, where Python has other words."""
    return json.dumps(value) if value is None or isinstance(value, bool) else repr(value)


def _unknown(schema: Schema, values: Any, where: str, path: Path) -> str:
    """Message for an unknown key: the most similar keys, else all keys of its group."""
    group, name = path[:-1], str(path[-1])
    inside = _value(values, group)
    choices = sorted(options(schema, _node(schema, group, values)), key=lambda option: not _fits(option, inside))
    near = list(next((option["properties"] for option in choices if "properties" in option), {}))
    every, key = list(keys(schema)), _dotted(path, where)
    kinds = [option["properties"] for option in choices if "kind" in option.get("properties", {})]
    for other in kinds[1:]:
        if name in other:
            kind = _words_of(other["kind"])[0]
            return f"{key} is a setting of kind {kind}, not of {inside['kind']}: remove it with ~{key}."
    same = [known for known in every if known.rpartition(".")[2] == name]
    hint = did_you_mean(name, same, preferred=same) or did_you_mean(name, near) or did_you_mean(_dotted(path), every)
    hint = hint or f": {_dotted(group, where) or 'a configuration'} has {', '.join(near)}."
    if "files" in near and re.fullmatch(r".+\.[a-z]\w*", str(value := _value(values, path)), re.IGNORECASE):
        hint += f" There is no file {key}={value} either: check its path; in quotes it is 'files=[\"{key}={value}\"]'."
    return f"unknown key '{key}'{hint}"


def keys(schema: Schema, node: Schema | None = None, prefix: str = "") -> Iterator[str]:
    """Yields the dotted names of all keys of a class and its groups; NAME stands for any name.

    Args:
        schema: JSON Schema of the class.
        node: the part of it whose keys are yielded; the whole if omitted.
        prefix: of the names.
    """
    for option in options(schema, schema if node is None else node):
        for name, member in option.get("properties", {}).items():
            yield f"{prefix}{name}"
            yield from keys(schema, member, f"{prefix}{name}.")
        if isinstance(option.get("additionalProperties"), Mapping):
            yield from keys(schema, option["additionalProperties"], f"{prefix}NAME.")


def options(schema: Schema, node: Schema) -> list[Schema]:
    """Returns the JSON Schemas of the types that a value may have."""
    while "$ref" in node:
        node = schema["$defs"][node["$ref"].rpartition("/")[2]]
    choices = node.get("anyOf") or node.get("oneOf")
    return [node] if choices is None else [option for choice in choices for option in options(schema, choice)]


def is_text(schema: Schema, path: Path, written: str) -> bool:
    """Returns whether a value is a text, whatever it looks like: 001, on, or null in a list of names.

    Args:
        schema: JSON Schema of the class.
        path: keys and list indices that lead to the value; ``defaults`` is that of Hydra.
        written: the value in YAML or on the command line.
    """
    nodes: list[Schema] = [schema]
    for part in path:
        choices = [option for node in nodes for option in options(schema, node)]
        below = [
            option.get("items")
            if isinstance(part, int)
            else option.get("properties", {}).get(part) or option.get("additionalProperties")
            for option in choices
        ]
        nodes = [node for node in below if isinstance(node, Mapping)]
    types = {option.get("type") for node in nodes for option in options(schema, node)}
    types |= {"string"} if path[:1] == ("defaults",) else set()
    brackets = {"object": "{", "array": "["}
    is_group = any(written.startswith(bracket) for kind, bracket in brackets.items() if kind in types)
    is_null = written.lower() in ("null", "~", "") and (isinstance(path[-1], str) or "null" in types)
    return "string" in types and not types & {"number", "integer", "boolean"} and not is_null and not is_group


def in_words(node: Schema, schema: Schema) -> str:
    """Describes the valid values, as in "a positive number, in m".

    Args:
        node: JSON Schema of the value.
        schema: JSON Schema of the whole class.
    """
    choices = options(schema, node)
    types = [option for option in choices if option.get("type") != "null"]
    unit = f", in {node['unit']}" if "unit" in node else ""
    null = ", or null" if len(types) < len(choices) else ""
    return " or ".join(dict.fromkeys(_type(option, schema) for option in types)) + unit + null


def _type(node: Schema, schema: Schema) -> str:
    """Describes the values of one type, without their unit."""
    if "wanted" in node:
        return str(node["wanted"])
    if words := _words_of(node):
        return str(words[0]) if len(words) == 1 else f"one of {', '.join(map(str, words))}"
    kind = node.get("type", "")
    if kind == "array":
        return _array(node, schema)
    if kind in ("number", "integer"):
        return _range(node)
    return {"object": "a group of settings", "boolean": "true or false", "string": "a word"}.get(kind, "anything")


def _words_of(node: Schema) -> list[Any]:
    """The fixed words that a value is chosen from."""
    return [node["const"]] if "const" in node else list(node.get("enum", ()))


def _array(node: Schema, schema: Schema) -> str:
    items = node.get("prefixItems", [node.get("items", {})])
    members = in_words(items[0], schema).removeprefix("a ")
    members = re.sub(r"\b(number|word|list|group)\b", r"\1s", members, count=1)
    members = members.removeprefix("one ") if members.startswith("one of ") else members
    members = f"lists of {members}" if members.partition(" ")[0] in _NUMBERS else members
    least, most = node.get("minItems", 0), node.get("maxItems")
    if least == most and least < len(_NUMBERS):
        return f"{_NUMBERS[least]} {members}"
    if 0 < least < len(_NUMBERS):
        return f"a list of {_NUMBERS[least]} or more {members}"
    return f"a list of {members.removeprefix('of ')}"


def _range(node: Schema) -> str:
    """Describes a number and its limits."""
    noun = _NOUNS[node["type"]]
    low, above, high, below = (node.get(key) for key in ("minimum", "exclusiveMinimum", "maximum", "exclusiveMaximum"))
    if (low, high, below) == (None, None, None) and above == 0:
        return f"a positive {noun}"
    if low in (0, 1) and (above, high, below) == (None, None, None):
        return f"a {noun}, {_NUMBERS[int(low)].replace('no', 'zero')} or more"
    if low is not None and high is not None:
        return f"a {noun} from {low:,g} to {high:,g}"
    limits = {"at least": low, "above": above, "at most": high, "below": below}
    words = " and ".join(f"{name} {limit:,g}" for name, limit in limits.items() if limit is not None)
    return f"a {noun}{f' {words}' if words else ''}"


def _path(values: Any, error: ErrorDetails) -> Path:
    """Keys that lead to an error, without pydantic's names of types; for a list member, the path of the list."""
    path: list[str | int] = []
    length = 0
    for part in error["loc"]:
        if isinstance(values, Mapping):
            name = next((key for key in values if str(key) == str(part)), None)
            if name is None and not (part == error["loc"][-1] and error["type"] == "missing"):
                continue
            values = None if name is None else values[name]
            path.append(str(part))
            length = len(path)
        elif isinstance(values, (list, tuple)) and isinstance(part, int) and part < len(values):
            values = values[part]
            path.append(part)
    return path[:length]


def _dotted(path: Path, where: str = "") -> str:
    parts = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return f"{where}{parts}".removeprefix(".")


def _value(values: Any, path: Path) -> Any:
    for part in path:
        if isinstance(values, Mapping):
            values = next((value for key, value in values.items() if str(key) == str(part)), None)
        else:
            values = values[int(part)]
    return values


def _node(schema: Schema, path: Path, values: Any) -> Schema:
    """JSON Schema at a path; for a group of several kinds, the kind that the values name is preferred."""
    node = schema
    for at, part in enumerate(path):
        inside = _value(values, path[:at])
        for option in sorted(options(schema, node), key=lambda option: not _fits(option, inside)):
            below = option.get("properties", {}).get(part) or option.get("additionalProperties") or option.get("items")
            if isinstance(below, Mapping):
                node = below
                break
    return node


def _fits(option: Schema, values: Any) -> bool:
    """Whether values have the fixed words of a kind of group, such as ``kind: rod``."""
    fixed = {name: member["const"] for name, member in option.get("properties", {}).items() if "const" in member}
    return isinstance(values, Mapping) and all(values.get(name) == word for name, word in fixed.items())
