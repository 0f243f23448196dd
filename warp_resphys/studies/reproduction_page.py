"""The page that sets published tables and figures beside ours: as HTML with nothing beside it, and as Markdown."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..io.files import write_text
from ..report.page import Picture, Table, draw_picture, figures_beside, page_template

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing


@dataclass(frozen=True)
class Figure:
    """A figure to be drawn.

    Attributes:
        name: Of its file.
        draw: Makes it; takes the keyword `narrow`.
        alt: What it shows, in words.
        caption: What stands below.
    """

    name: str
    draw: "Callable[..., Drawing]"
    alt: str
    caption: str


@dataclass(frozen=True)
class Section:
    """One part of the page.

    Attributes:
        title: Its heading.
        text: Paragraphs.
        tables: After the text.
        figures: After the tables.
        list_title: Heading of the list.
        items: Of the list that ends the section; may be empty.
        commands: That gave what the section shows.
    """

    title: str
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    list_title: str = ""
    items: Sequence[str] = ()
    commands: Sequence[str] = ()


@dataclass(frozen=True)
class Reproduction:
    """The whole page.

    Attributes:
        date: Of the page, as YYYY-MM-DD.
        verdict: Its first sentences.
        command: That made it.
        hardware: In words, by what they are.
        commit: Of the code, if known.
        versions: By package.
        sections: In order.
    """

    date: str
    verdict: str
    command: str
    hardware: Mapping[str, str]
    commit: str | None
    versions: Mapping[str, str]
    sections: Sequence[Section]


def write_reproduction(page: Path, data: Reproduction) -> None:
    """Write `reproduction.html`, `results.md` beside it, and their figures into `figures/`.

    Args:
        page: The file of the page; missing folders are made.
        data: What to show.

    Raises:
        DataFileError: A file could not be written.
    """
    with figures_beside(page) as folder:
        pictures = {
            figure.name: draw_picture(folder, figure.name, figure.draw, figure.alt)
            for section in data.sections
            for figure in section.figures
        }
    write_text(page, _render("reproduction.html", data, pictures))
    write_text(page.with_name("results.md"), markdown(data, "figures"))


def markdown(data: Reproduction, folder: str) -> str:
    """Return the page in Markdown.

    Args:
        data: What to show.
        folder: Where the figures lie as PNG files, from the Markdown file.
    """
    return _render("results.md", data, {}, folder=folder).replace("\u00a0", " ") + "\n"


def _render(template: str, data: Reproduction, pictures: Mapping[str, Picture], folder: str = "") -> str:
    return page_template(template).render(
        title="Reproduction", verdict=data.verdict, data=data, pictures=pictures, folder=folder
    )
