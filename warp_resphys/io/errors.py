"""What can go wrong in a way that the user can mend: one sentence each, exit code 2 on the command line."""

import difflib
from collections.abc import Sequence
from typing import Any

_LONGEST = 1000


class ResphysError(Exception):
    """Base of every error whose message is written for the user: what was wrong, where, and what to do.

    Messages quote files and what libraries say of them; what is left of that is one line, not too long, that no
    terminal takes for commands.
    """

    def __init__(self, message: object = "") -> None:
        line = "".join(letter if letter.isprintable() else " " for letter in str(message))
        super().__init__(line if len(line) <= _LONGEST else f"{line[:500]} ... {line[-300:]}")


class InputError(ResphysError, ValueError):
    """An argument or a configured value that cannot be simulated."""


class MeshError(InputError):
    """A mesh that cannot be read, or that a finite-element method cannot use."""


class DataFileError(ResphysError):
    """A data file that is missing, truncated, foreign or cannot be written."""


class ConvergenceError(ResphysError, RuntimeError):
    """A solve that stopped short of its tolerance.

    Attributes:
        positions: (B, N, 3) [m] the last iterate, on its device.
        report: iterations, residual and convergence of each environment.
    """

    def __init__(self, message: str, positions: Any, report: Any) -> None:
        super().__init__(message)
        self.positions = positions
        self.report = report


def listed(names: Sequence[str]) -> str:
    """Names in quotation marks, separated by commas, for a message."""
    return ", ".join(f"'{name}'" for name in names) or "none"


def did_you_mean(wanted: str, known: Sequence[str], preferred: Sequence[str] = ()) -> str:
    """The end of a sentence on an unknown name that offers the nearest known ones; empty where none is near.

    Args:
        wanted: the unknown name.
        known: names that exist.
        preferred: those that are offered whatever they look like.
    """
    offered = [name for name in dict.fromkeys(preferred) if name != wanted][:3]
    matches = offered or difflib.get_close_matches(wanted, [name for name in known if name != wanted], n=3, cutoff=0.6)
    return f", did you mean {' or '.join(repr(match) for match in matches)}?" if matches else ""
