"""The page of a study, from parts: as HTML with nothing beside it, and as Markdown."""

from collections.abc import Sequence
from pathlib import Path

from ..io.files import write_text
from ..report.page import NO_BREAK_SPACE, Part, page_template


def write_page(path: Path, *, title: str, kicker: str, verdict: str, parts: Sequence[Part]) -> None:
    """Writes a page: its heading, what stands above and below that, and its sections.

    Raises:
        DataFileError: the file cannot be written.
    """
    page = page_template("study.html").render(
        title=title, kicker=kicker, verdict=verdict, parts=parts, kind_of=lambda block: type(block).__name__
    )
    write_text(path, page)


def markdown(title: str, verdict: str, parts: Sequence[Part], folder: str) -> str:
    """The same in Markdown, with its figures as PNG files in a folder beside it."""
    page = page_template("study.md").render(
        title=title, verdict=verdict, parts=parts, folder=folder, kind_of=lambda block: type(block).__name__
    )
    return page.replace(NO_BREAK_SPACE, " ") + "\n"
