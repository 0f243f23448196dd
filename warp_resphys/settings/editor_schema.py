"""Writes a JSON Schema of all settings, with which editors complete and check YAML files.

    python -m warp_resphys.settings.editor_schema configs/settings.schema.json

The files begin with ``# yaml-language-server: $schema=settings.schema.json`` (a path from that
file, or absolute).
"""

import sys
from collections.abc import Mapping
from typing import Any

from ..io.safe_files import write_json
from .run import RunSettings


def editor_schema() -> dict[str, Any]:
    """Returns the JSON Schema of a file of settings,
    in which keys may be missing, as it extends other options.
    """
    schema: dict[str, Any] = _partial(RunSettings.model_json_schema())
    schema["properties"] |= {"defaults": {"type": "array"}, "hydra": {"type": "object"}}
    return schema


def _partial(node: Any) -> Any:
    """A JSON Schema without lists of required keys, in which groups may replace others."""
    if isinstance(node, Mapping):
        part = {
            key: _partial(value)
            for key, value in node.items()
            if key != "required" or not isinstance(value, list)
        }
        replaces = {"properties": {**part.get("properties", {}), "_replace_": {"type": "boolean"}}}
        return part | replaces if part.get("type") == "object" else part
    return list(map(_partial, node)) if isinstance(node, list) else node


if __name__ == "__main__":
    for path in sys.argv[1:]:
        write_json(path, editor_schema())
