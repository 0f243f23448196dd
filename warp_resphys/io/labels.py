"""Names of run folders, and of the folder with the user's own configuration options."""

import hashlib
import re
from collections.abc import Sequence

OWN_OPTIONS = "configs"  # in the working directory: groups of the configuration and their options
_LABEL_LENGTH = 100


def run_label(overrides: Sequence[str], excluded: Sequence[str] = ()) -> str:
    """Names a run folder after its overrides; an OmegaConf resolver.

    The order of the overrides does not matter, so that a repeated command finds its own files.

    Args:
        overrides: Hydra's task overrides, such as "material.density=900".
        excluded: Keys that do not change the results, or that are part of the path already, with all keys below them.

    Returns:
        "key=value,key=value" sorted by key, or "default" without overrides. Long names, and names with unsuitable
        characters, are shortened or replaced and end in a hash of the whole.
    """
    settings = {}
    for override in overrides:
        key, _, value = override.removeprefix("++").partition("=")
        bare = key.lstrip("+~")
        if not any(bare == name or bare.startswith(f"{name}.") for name in excluded):
            settings[key] = f"{key}={value}" if value else key
    whole = ",".join(settings[key] for key in sorted(settings))
    if not whole:
        return "default"
    label = re.sub(r"[^A-Za-z0-9._=,+~-]", "-", whole)
    if label == whole and len(label) <= _LABEL_LENGTH:
        return label
    return f"{label[:_LABEL_LENGTH]}-{hashlib.sha256(whole.encode()).hexdigest()[:8]}"
