"""One sentence for a value that a class of settings refuses: the dotted key, the value, and what it must be.

The words come from the JSON Schema of the class, where types, ranges and units are already.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from pydantic_core import ErrorDetails

from .errors import did_you_mean

Schema = Mapping[str, Any]
Path = Sequence[str | int]  # keys and places in lists that lead to a value

_NOUNS: Final = {"string": "word", "number": "number", "integer": "whole number"}
_NUMBERS: Final = ("no", "one", "two", "three", "four", "five", "six")


def sentence(schema: Schema, values: Any, where: str, errors: Sequence[ErrorDetails]) -> str:
    """The sentence for the error that says most: an unknown key, else the one that is deepest in the groups.

    Args:
        schema: JSON Schema of the class.
        values: that were refused.
        where: dotted key of the group; empty for a whole configuration.
        errors: of pydantic.
    """
    located = [(error, _path(values, error)) for error in errors]
    error, path = max(
        located,
        key=lambda each: (each[0]["type"] == "extra_forbidden", len(each[1]), each[0]["type"] == "value_error"),
    )
    key, kind, context = _dotted(path, where), error["type"], error.get("ctx", {})
    if kind == "extra_forbidden":
        return _unknown(schema, values, where, path)
    value, node = _value(values, path), _node(schema, path, values)
    if kind == "missing" and path[-1:] == [error["loc"][-1]]:
        return f"{key} is missing: it must be {in_words(node, schema)}."
    if kind.startswith("union_tag"):
        tag = str(context.get("discriminator", "")).strip("'")
        kinds = [str(word) for each in options(schema, node) for word in _words_of(each["properties"][tag])]
        if not isinstance(value, Mapping):
            return f"{key} is {value!r}: it must be a group of settings."
        return f"{_dotted([tag], key)} is {value.get(tag)!r}: it must be one of {', '.join(kinds)}."
    if kind == "value_error":
        message = str(context["error"])
        if not isinstance(value, Mapping):
            return f"{key} is {value!r}: {message}"
        return f"{key}.{message}" if key else message
    return f"{key} is {value!r}: it must be {in_words(node, schema)}."


def _unknown(schema: Schema, values: Any, where: str, path: Path) -> str:
    """The sentence for an unknown key: the nearest of its group, else of the whole, else all of its group."""
    group, name = path[:-1], str(path[-1])
    inside = _value(values, group)
    choices = sorted(options(schema, _node(schema, group, values)), key=lambda each: not _fits(each, inside))
    own = list(next((each["properties"] for each in choices if "properties" in each), {}))
    known, key = list(keys(schema)), _dotted(path, where)
    if kind := _kind_with(choices, name):
        return f"{key} is a setting of kind {kind}, not of {inside['kind']}: leave it out, as ~{key}."
    same = [each for each in known if each.rpartition(".")[2] == name]
    hint = did_you_mean(name, same, preferred=same) or did_you_mean(name, own) or did_you_mean(_dotted(path), known)
    at = _dotted(group, where)
    return f"unknown key '{key}'" + (hint or f": {at or 'a configuration'} has {', '.join(own)}.")


def _kind_with(choices: Sequence[Schema], name: str) -> str:
    """The kind among those that a group may have whose key a name is; empty where there is none."""
    kinds = [each["properties"] for each in choices if "kind" in each.get("properties", {})]
    return next((str(_words_of(each["kind"])[0]) for each in kinds[1:] if name in each), "")


def keys(schema: Schema, node: Schema | None = None, prefix: str = "") -> Iterator[str]:
    """Dotted names of all keys of a class and of the groups in it, of all kinds; NAME stands for any name.

    Args:
        schema: JSON Schema of the class.
        node: the part of it whose keys are wanted; the whole, if left out.
        prefix: of the names.
    """
    for option in options(schema, schema if node is None else node):
        for name, each in option.get("properties", {}).items():
            yield f"{prefix}{name}"
            yield from keys(schema, each, f"{prefix}{name}.")
        if isinstance(option.get("additionalProperties"), Mapping):
            yield from keys(schema, option["additionalProperties"], f"{prefix}NAME.")


def options(schema: Schema, node: Schema) -> list[Schema]:
    """JSON Schemas of the types that a value may have."""
    while "$ref" in node:
        node = schema["$defs"][node["$ref"].rpartition("/")[2]]
    choices = node.get("anyOf") or node.get("oneOf")
    return [node] if choices is None else [each for choice in choices for each in options(schema, choice)]


def in_words(node: Schema, schema: Schema) -> str:
    """What a value must be, as in "it must be a positive number, in m".

    Args:
        node: JSON Schema of the value.
        schema: that of the whole class.
    """
    choices = options(schema, node)
    words = list(dict.fromkeys(_type(each, schema) for each in choices if each.get("type") != "null"))
    unit = f", in {node['unit']}" if "unit" in node else ""
    null = ", or null" if any(each.get("type") == "null" for each in choices) else ""
    return " or ".join(words) + unit + null


def _type(node: Schema, schema: Schema) -> str:
    """Words for values of one type, without their unit."""
    if "wanted" in node:
        return str(node["wanted"])
    if known := _words_of(node):
        return str(known[0]) if len(known) == 1 else f"one of {', '.join(map(str, known))}"
    kind = node.get("type", "")
    if kind == "array":
        return _array(node, schema)
    if kind in ("number", "integer"):
        return _range(node)
    return {"object": "a group of settings", "boolean": "true or false", "string": "a word"}.get(kind, "anything")


def _words_of(node: Schema) -> list[Any]:
    """Fixed words that a value is chosen from."""
    return [node["const"]] if "const" in node else list(node.get("enum", ()))


def _array(node: Schema, schema: Schema) -> str:
    items = node.get("prefixItems", [node.get("items", {})])
    each = in_words(items[0], schema).removeprefix("a ")
    each = re.sub(r"\b(number|word|list|group)\b", r"\1s", each, count=1)
    each = f"lists of {each}" if each.partition(" ")[0] in _NUMBERS else each
    least, most = node.get("minItems", 0), node.get("maxItems")
    if least == most and least < len(_NUMBERS):
        return f"{_NUMBERS[least]} {each}"
    return f"a list of {f'{_NUMBERS[least]} or more ' if 0 < least < len(_NUMBERS) else ''}{each}"


def _range(node: Schema) -> str:
    """Words for a number and its limits."""
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


def completed(schema: Schema, values: Any, node: Schema | None = None) -> Any:
    """Values with the defaults of all keys that are left out; values that a class would refuse stay as they are.

    Args:
        schema: JSON Schema of the class.
        values: nested plain data.
        node: JSON Schema of the values; that of the class, if left out.
    """
    if not isinstance(values, Mapping):
        return values
    choices = [each for each in options(schema, schema if node is None else node) if each.get("type") == "object"]
    option: Schema = next((each for each in choices if _fits(each, values)), {})
    named, other = option.get("properties", {}), option.get("additionalProperties")
    defaults = {key: each["default"] for key, each in named.items() if "default" in each and key not in values}
    found = {**values, **defaults}
    return {
        key: completed(schema, each, named.get(key, other)) if isinstance(named.get(key, other), Mapping) else each
        for key, each in found.items()
    }


def _path(values: Any, error: ErrorDetails) -> Path:
    """Keys that lead to an error, without the types that pydantic tried on the way; of a list, the whole."""
    path: list[str | int] = []
    length = 0
    for part in error["loc"]:
        if isinstance(values, Mapping):
            name = next((each for each in values if str(each) == str(part)), None)
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
    parts = "".join(f"[{each}]" if isinstance(each, int) else f".{each}" for each in path)
    return f"{where}{parts}".removeprefix(".")


def _value(values: Any, path: Path) -> Any:
    for part in path:
        if isinstance(values, Mapping):
            values = next((each for name, each in values.items() if str(name) == str(part)), None)
        else:
            values = values[int(part)]
    return values


def _node(schema: Schema, path: Path, values: Any) -> Schema:
    """JSON Schema at a path; of a group of several kinds, that of the kind that the values name."""
    node = schema
    for at, part in enumerate(path):
        inside = _value(values, path[:at])
        for option in sorted(options(schema, node), key=lambda each: not _fits(each, inside)):
            found = option.get("properties", {}).get(part) or option.get("additionalProperties") or option.get("items")
            if isinstance(found, Mapping):
                node = found
                break
    return node


def _fits(option: Schema, values: Any) -> bool:
    """Whether values have the fixed words of a kind of group, such as ``kind: rod``."""
    fixed = {name: each["const"] for name, each in option.get("properties", {}).items() if "const" in each}
    return isinstance(values, Mapping) and all(values.get(name) == word for name, word in fixed.items())
