"""Scripts of the repository as modules."""

import importlib
import sys
from pathlib import Path

SCRIPTS = Path(__file__).parents[2] / "scripts"


def script(name):
    """A script, or a module beside it, such as benchmarks.steps."""
    if str(SCRIPTS) not in sys.path:
        sys.path.append(str(SCRIPTS))
    return importlib.import_module(name)
