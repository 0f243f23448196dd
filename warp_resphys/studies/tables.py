"""Tables of the commands: in a terminal and as text."""

import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

from rich.console import Console, RenderableType
from rich.table import Table as TerminalTable

_LOG_WIDTH: Final = 140  # of tables that go to a file, in characters


def show(*parts: RenderableType) -> None:
    """Prints tables and sentences, as wide as the terminal."""
    console = Console(width=None if sys.stdout.isatty() else _LOG_WIDTH)
    for part in parts:
        console.print(part, markup=False, highlight=False, soft_wrap=isinstance(part, str))


@dataclass(frozen=True)
class Sheet:
    """A table of text, which rich prints."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    failed: Collection[int] = ()  # rows that are red in a terminal

    def __rich__(self) -> TerminalTable:
        table = TerminalTable(title=self.title)
        for number, heading in enumerate(self.headings):
            table.add_column(heading, justify="right" if number else "left")
        for number, row in enumerate(self.rows):
            table.add_row(*row, style="red" if number in self.failed else None)
        return table


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
