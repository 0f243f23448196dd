"""Tables that are shown in a terminal and on a page."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table as TerminalTable

from ..report.page import Cell, PageTable, Part, Row
from .command import table_of


@dataclass(frozen=True)
class Sheet:
    """A table of words; printed by rich, it is one of the terminal."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    failed: Collection[int] = ()  # rows that are red in a terminal
    note: str = ""  # below the table on a page

    @classmethod
    def of(cls, title: str, columns: str, rows: Iterable[Mapping[str, Any]]) -> "Sheet":
        """The table of values of rows, by a template of a line such as ``solver {name} | time, ms {time:.2f}``."""
        headings, forms = zip(*(column.strip().rsplit(" ", 1) for column in columns.split("|")), strict=True)
        return cls(title, headings, [[form.format(**row) for form in forms] for row in rows])

    def __rich__(self) -> TerminalTable:
        table = table_of(self.title, self.headings, self.rows)
        for number in self.failed:
            table.rows[number].style = "red"
        return table

    def for_page(self) -> Part:
        """A section of a page."""
        first, *others = (heading[:1].upper() + heading[1:] for heading in self.headings)
        rows = [Row(name, [Cell(value) for value in values]) for name, *values in self.rows]
        return Part(self.title, [PageTable(first, others, rows, note=self.note)])
