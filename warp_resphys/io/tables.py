"""Tables and sentences in a terminal, and tables as text."""

import sys
from collections.abc import Sequence
from typing import Final

from rich.console import Console, RenderableType

_LOG_WIDTH: Final = 110  # of tables that go to a file, in characters


def show(*parts: RenderableType) -> None:
    """Prints tables and sentences, as wide as the terminal."""
    console = Console(width=None if sys.stdout.isatty() else _LOG_WIDTH)
    for part in parts:
        console.print(part, markup=False, highlight=False, soft_wrap=isinstance(part, str))


def aligned(rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Rows as lines of text, the first `left` columns aligned to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if at < left else cell.rjust(width)
            for at, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )
