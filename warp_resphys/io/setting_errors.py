"""Error messages for refused settings: one sentence with the dotted key,
the value, and what it must be.

Types, ranges and units come from the JSON Schema of the settings class.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from pydantic_core import ErrorDetails

from .errors import did_you_mean

Schema = Mapping[str, Any]
Path = Sequence[str | int]  # keys and list indices that lead to a value

_NOUNS: Final = {"string": "word", "number": "number", "integer": "whole number"}
_NUMBERS: Final = ("no", "one", "two", "three", "four", "five", "six")
_WORDS: Final = {"object": "a group of settings", "boolean": "true or false", "string": "a word"}


@dataclass(frozen=True)
class _Place:
    """A value in nested settings."""

    schema: Schema  # of the whole class
    node: Schema  # of the value
    value: Any  # None if it is missing
    path: tuple[str | int, ...] = ()  # keys and indices that lead to it
    group: "_Place | None" = None  # in which it lies

    @property
    def kinds(self) -> list[Schema]:
        """JSON Schemas of the types that the value may have,
        first that of the kind it names, such as ``kind: rod``.
        """

        def names(option: Schema) -> bool:
            fixed = {
                key: one["const"]
                for key, one in option.get("properties", {}).items()
                if "const" in one
            }
            return isinstance(self.value, Mapping) and all(
                self.value.get(key) == word for key, word in fixed.items()
            )

        return sorted(options(self.schema, self.node), key=lambda option: not names(option))

    def within(self, part: str | int) -> "_Place":
        """Returns the place of a key or of an entry of a list."""
        value = (
            self.value.get(_key(self.value, part))
            if isinstance(self.value, Mapping)
            else self.value[part]
        )
        node = next(filter(None, (_below(option, part) for option in self.kinds)), self.node)
        return _Place(self.schema, node, value, (*self.path, part), self)


def sentence(schema: Schema, values: Any, where: str, errors: Sequence[ErrorDetails]) -> str:
    """Returns the message of the most informative error:
    an unknown key, else the most deeply nested one.

    Args:
        schema: JSON Schema of the class.
        values: the refused values.
        where: dotted key of the group; empty for a whole configuration.
        errors: of pydantic.
    """

    def rank(located: tuple[ErrorDetails, _Place]) -> tuple[bool, int, bool]:
        error, place = located
        return error["type"] == "extra_forbidden", len(place.path), error["type"] == "value_error"

    whole = _Place(schema, schema, values)
    error, place = max(((error, _place(whole, error)) for error in errors), key=rank)
    kind, value = error["type"], place.value
    key = _dotted(place.path, where)
    if kind == "extra_forbidden":
        return _unknown(place, where)
    if error["loc"][-1:] == ("[key]",):
        group = _dotted(error["loc"][:-2], where)
        return f"{group} has the name {_shown(error['input'])}, not a text: put it in quotes."
    if kind == "missing" and place.path[-1:] == error["loc"][-1:]:
        return f"{key} is missing: it must be {_in_words(place.node, schema)}."
    if kind.startswith("union_tag") and isinstance(value, Mapping):
        tag = str(error["ctx"]["discriminator"]).strip("'")
        words = [
            str(word)
            for option in options(schema, place.node)
            for word in _words_of(option["properties"][tag])
        ]
        return (
            f"{_dotted([tag], key)} is {_shown(value.get(tag))}: it must be one of "
            f"{', '.join(words)}."
        )
    if kind.startswith("union_tag"):
        return f"{key} is {_shown(value)}: it must be a group of settings."
    if kind == "value_error" and isinstance(value, Mapping):
        return _dotted([str(error["ctx"]["error"])], key)
    if kind == "value_error":
        return f"{key} is {_shown(value)}: {error['ctx']['error']}"
    texts = value if isinstance(value, (list, tuple)) else [value]
    is_number = kind == "string_type" and any(
        isinstance(text, (bool, int, float)) for text in texts
    )
    return (
        f"{key} is {_shown(value)}: it must be "
        f"{_in_words(place.node, schema)}{', in quotes' if is_number else ''}."
    )


def _place(whole: _Place, error: ErrorDetails) -> _Place:
    """Returns the place of an error; for an entry of a list, that of the list."""
    here = keyed = whole
    for part in error["loc"]:
        if isinstance(here.value, Mapping):
            is_missing = error["type"] == "missing" and part == error["loc"][-1]
            if is_missing or _key(here.value, part) in here.value:
                # Else a name that pydantic gives to a type.
                here = keyed = here.within(str(part))
        elif (
            isinstance(here.value, (list, tuple))
            and isinstance(part, int)
            and part < len(here.value)
        ):
            here = here.within(part)
    return keyed


def _key(values: Mapping[Any, Any], part: str | int) -> Any:
    """Returns a key of a mapping by its text, in which YAML may have read a number.

    The text itself without one.
    """
    return next((key for key in values if str(key) == str(part)), part)


def _shown(value: Any) -> str:
    """A value as YAML has it, where Python has other words."""
    return json.dumps(value) if value is None or isinstance(value, bool) else repr(value)


def _dotted(path: Path, where: str = "") -> str:
    parts = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return f"{where}{parts}".removeprefix(".")


def _unknown(place: _Place, where: str) -> str:
    """Message for an unknown key: the most similar keys, else all keys of its group."""
    group, name = place.group, str(place.path[-1])
    key = _dotted(place.path, where)
    assert group is not None
    kinds = [option["properties"] for option in group.kinds if "properties" in option]
    for other in kinds[1:]:
        if name in other and "kind" in other and "kind" in kinds[0]:
            kind = _words_of(other["kind"])[0]
            return (
                f"{key} is a setting of kind {kind}, "
                f"not of {group.value['kind']}: remove it with ~{key}."
            )
    near, every = list(kinds[0]) if kinds else [], list(dict.fromkeys(keys(place.schema)))
    same = [known for known in every if known.rpartition(".")[2] == name]
    hint = (
        did_you_mean(name, same, same)
        or did_you_mean(name, near)
        or did_you_mean(_dotted(place.path), every)
    )
    hint = hint or f": {_dotted(group.path, where) or 'a configuration'} has {', '.join(near)}."
    if "files" in near and re.fullmatch(r".+\.[a-z]\w*", str(place.value), re.IGNORECASE):
        file = f"{key}={place.value}"
        hint += (
            f" There is no file {file} either: check its path; in quotes it is "
            f"'files=[\"{file}\"]'."
        )
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
    return (
        [node]
        if choices is None
        else [option for choice in choices for option in options(schema, choice)]
    )


def _below(option: Schema, part: str | int) -> Schema | None:
    """Returns the JSON Schema of a key or of an entry of a list of one type.

    None if it has no such part.
    """
    if isinstance(part, int):
        return option.get("items")
    below = option.get("properties", {}).get(part) or option.get("additionalProperties")
    return below if isinstance(below, Mapping) else None


def is_text(schema: Schema, path: Path, written: str) -> bool:
    """Returns whether a value is a text, whatever it looks like:
    001, on, or null in a list of names.

    Args:
        schema: JSON Schema of the class.
        path: keys and list indices that lead to the value; ``defaults`` is that of Hydra.
        written: the value in YAML or on the command line.
    """
    choices = options(schema, schema)
    for part in path:
        parts = [_below(option, part) for option in choices]
        choices = [option for node in parts if node is not None for option in options(schema, node)]
    types = {option.get("type") for option in choices} | (
        {"string"} if path[:1] == ("defaults",) else set()
    )
    if "string" not in types or types & {"number", "integer", "boolean"}:
        return False
    is_group = any(
        kind in types and written.startswith(mark)
        for kind, mark in (("object", "{"), ("array", "["))
    )
    is_null = written.lower() in ("null", "~", "") and (
        isinstance(path[-1], str) or "null" in types
    )
    return not is_group and not is_null


def _in_words(node: Schema, schema: Schema) -> str:
    """Describes the valid values of a key, as in "a positive number, in m"."""
    choices = options(schema, node)
    types = [option for option in choices if option.get("type") != "null"]
    unit = f", in {node['unit']}" if "unit" in node else ""
    null = ", or null" if len(types) < len(choices) else ""
    return " or ".join(dict.fromkeys(_type(option, schema) for option in types)) + unit + null


def _type(node: Schema, schema: Schema) -> str:
    """Describes the values of one type, without their unit."""
    if "wanted" in node:
        return str(node["wanted"])
    words = _words_of(node)
    if words:
        return str(words[0]) if len(words) == 1 else f"one of {', '.join(map(str, words))}"
    kind = node.get("type", "")
    if kind == "array":
        return _array(node, schema)
    return _range(node) if kind in ("number", "integer") else _WORDS.get(kind, "anything")


def _words_of(node: Schema) -> list[Any]:
    """The fixed words that a value is chosen from."""
    return [node["const"]] if "const" in node else list(node.get("enum", ()))


def _array(node: Schema, schema: Schema) -> str:
    """Describes a list, as in "three numbers" or "a list of two or more words"."""
    items = node.get("prefixItems", [node.get("items", {})])
    members = re.sub(r"^a |^one (?=of )", "", _in_words(items[0], schema))
    members = re.sub(r"\b(number|word|list|group)\b", r"\1s", members, count=1)
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
    low, above, high, below = (
        node.get(key) for key in ("minimum", "exclusiveMinimum", "maximum", "exclusiveMaximum")
    )
    if (low, high, below) == (None, None, None) and above == 0:
        return f"a positive {noun}"
    if low in (0, 1) and (above, high, below) == (None, None, None):
        return f"a {noun}, {'zero' if low == 0 else 'one'} or more"
    if low is not None and high is not None:
        return f"a {noun} from {low:,g} to {high:,g}"
    limits = {"at least": low, "above": above, "at most": high, "below": below}
    words = " and ".join(
        f"{name} {limit:,g}" for name, limit in limits.items() if limit is not None
    )
    return f"a {noun} {words}".rstrip()
