"""Pages that need nothing beside them: sections of text, tables and figures, and how numbers are written on them."""

import base64
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jinja2

from ..io.errors import DataFileError
from ..io.files import disk_full_error, is_disk_full
from ..learning.metrics import PublishedError
from .render import DrawingError

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_LOG = logging.getLogger(__name__)
NO_BREAK_SPACE = "\u00a0"
NONE = "\N{EN DASH}"
MINUS = "\N{MINUS SIGN}"
MOST_DECIMALS = 6  # What takes more is written with a power of ten.


class Cell(NamedTuple):
    """One entry of a table, what stands small below it, and what stands beside it, such as a deviation."""

    text: str
    small: str = ""
    beside: str = ""


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Attributes:
        head: What the row is.
        cells: One a column.
        answer: Whether the row is the one that counts.
        small: What stands small below the head.
        address: Where the head leads to; may be empty.
    """

    head: str
    cells: Sequence[Cell]
    answer: bool = False
    small: str = ""
    address: str = ""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        head: Above the first column.
        columns: Heads of the others.
        rows: Its rows.
        note: What stands below.
        summary: What unfolds the table; empty for one that is always seen.
        unfolded: Whether it is at first.
    """

    head: str
    columns: Sequence[str]
    rows: Sequence[Row]
    note: str = ""
    summary: str = ""
    unfolded: bool = False


class Picture(NamedTuple):
    """One figure on the page: two widths of it as data addresses, and what it shows, in words."""

    wide: str
    narrow: str
    alt: str


@dataclass(frozen=True)
class Text:
    """A paragraph; a note is written small, a heading large, and `name` is its identifier on the page."""

    text: str
    name: str = ""
    note: bool = False
    heading: bool = False


@dataclass(frozen=True)
class Items:
    """A list, of commands where `code` says so."""

    items: Sequence[str]
    name: str = ""
    code: bool = False


@dataclass(frozen=True)
class Drawn:
    """A picture or a film with its caption.

    Attributes:
        name: Of its file, and on the page.
        caption: What stands below.
        picture: What is shown.
        film: Address of a film, in place of a picture.
        scrolls: Whether it stays wide on a narrow page.
    """

    name: str
    caption: str
    picture: Picture | None = None
    film: str = ""
    scrolls: bool = False


@dataclass(frozen=True)
class Part:
    """A section of a page: its heading, and blocks in their order."""

    title: str
    blocks: Sequence[Text | Items | Table | Drawn]


@dataclass(frozen=True)
class Canvas:
    """Where the figures of a page are drawn.

    Attributes:
        folder: Of their files.
        missing: By name, why something cannot be drawn on this machine.
        started: By name, what is being drawn already.
    """

    folder: Path
    missing: dict[str, str] = field(default_factory=dict)
    started: dict[str, "Future[Any]"] = field(default_factory=dict)

    def start(self, pool: Executor, drawings: Mapping[str, tuple[str, Callable[[Path], Any]]]) -> None:
        """Begin to draw what takes other processes: by name, a file's name and what draws."""
        for name, (file, draw) in drawings.items():
            self.started[name] = pool.submit(draw, self.folder / file)

    def figure(self, name: str, draw: "Callable[..., Drawing]", alt: str, caption: str) -> Drawn:
        """Return a figure in two widths; see `draw_picture`."""
        return Drawn(name, caption, draw_picture(self.folder, name, draw, alt))

    def attempt(self, name: str, file: str, draw: Callable[[Path], Any] | None = None) -> Any:
        """Return what a drawing gives, or None with the reason in `missing`; an earlier page's file is then removed.

        Args:
            name: Of the drawing.
            file: Its name.
            draw: What draws it; None for one that was started.
        """
        path = self.folder / file
        try:
            return self.started[name].result() if draw is None else draw(path)
        except DrawingError as error:
            self.missing[name] = f"{error}, then delete this page and run the same command again."
            _LOG.warning("the report lacks a picture: %s", error)
            path.unlink(missing_ok=True)  # Of an earlier report, it would not belong to this one.
            return None

    def file(self, name: str, draw: Callable[[Path], None], alt: str, caption: str) -> "list[Drawn | Text]":
        """Return a picture that is drawn into a PNG file of its own, or why it is not there."""

        def drawn(path: Path) -> str:
            draw(path)
            return file_address(path, "image/png")

        address = self.attempt(name, f"{name}.png", drawn)
        if address is None:
            return list(self.reason(name))
        return [Drawn(name, caption, Picture(address, address, alt), scrolls=True)]

    def reason(self, name: str) -> list[Text]:
        """Return why something is not there, unless the same was said of something else before."""
        said = self.missing[name]
        first = next(other for other, reason in self.missing.items() if reason == said)
        return [Text(said, name, note=True)] if first == name else []


@contextmanager
def figures_beside(path: Path) -> Iterator[Path]:
    """Give the folder `figures` beside a page, made where it is missing.

    Raises:
        DataFileError: A figure could not be written there.
    """
    folder = path.parent / "figures"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    except OSError as error:
        if is_disk_full(error):
            raise disk_full_error(folder) from error
        raise DataFileError(f"cannot write figures to {folder}: {error.strerror or error}") from error


def draw_picture(folder: Path, name: str, draw: "Callable[..., Drawing]", alt: str) -> Picture:
    """Draw a figure in two widths, for a page, and save the wide one as a PNG file.

    Args:
        folder: Of the PNG file.
        name: Of the figure, and of the file.
        draw: Makes the figure; takes the keyword `narrow`.
        alt: What it shows, in words.
    """
    from . import figures

    wide, narrow = draw(narrow=False), draw(narrow=True)
    figures.settle(wide)
    figures.settle(narrow)
    figures.save_png(wide, folder / f"{name}.png")
    return Picture(svg_address(figures.themed_svg(wide, name)), svg_address(figures.themed_svg(narrow, name)), alt)


def page_template(name: str) -> jinja2.Template:
    """Return one of the templates in this package."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("warp_resphys", "report"),
        undefined=jinja2.StrictUndefined,
        autoescape=jinja2.select_autoescape(["html"]),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def number_text(value: float | None) -> str:
    """Return a number with three decimals, or two digits if that takes more; None stands for divergence."""
    if value is None:
        return "diverged"
    decimals = _decimals(value)
    if decimals <= MOST_DECIMALS:
        return f"{value:.{decimals}f}"
    exponent = math.floor(math.log10(value))
    return f"{value / 10.0**exponent:.1f}{_times_power(exponent)}"


def error_parts(summary: Mapping[str, Any]) -> tuple[str, str]:
    """Return a mean and its "± deviation" if it has one, with as many digits as the smaller of the two deserves."""
    mean, std = summary["mean"], summary["std"]
    if mean is None:
        return f"{summary['diverged']} of {summary['trajectories']} diverged", ""
    if std is None:
        return number_text(mean), ""
    decimals = _decimals(min(mean, std) or mean)
    if decimals <= MOST_DECIMALS:
        return f"{mean:.{decimals}f}", f"± {std:.{decimals}f}"
    exponent = math.floor(math.log10(mean))
    power = _times_power(exponent)
    return f"{mean / 10.0**exponent:.1f}{power}", f"± {std / 10.0**exponent:.1f}{power}"


def duration_text(seconds: float) -> str:
    """Return a duration as one reads it: "0.42 s", "12.3 s", "3 min 05 s"."""
    if seconds < 60.0:
        return f"{seconds:.2f} s" if seconds < 10.0 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"


def _times_power(exponent: int) -> str:
    return " \N{MULTIPLICATION SIGN} 10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _decimals(value: float) -> int:
    return max(3, 1 - math.floor(math.log10(abs(value)))) if value else 3


def published_parts(error: PublishedError) -> tuple[str, str]:
    """Return the number as it was printed: both parts with the same decimals."""
    decimals = max(len(repr(float(part)).partition(".")[2]) for part in error)
    return f"{error.mean:.{decimals}f}", f"± {error.std:.{decimals}f}"


def flatten(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Return the settings as the dotted keys by which the command line sets them, with their values."""
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{prefix}{key}.")
        elif isinstance(value, list | tuple):
            yield f"{prefix}{key}", f"[{', '.join(str(each) for each in value)}]"
        else:
            yield f"{prefix}{key}", "null" if value is None else str(value)


def svg_address(svg: bytes) -> str:
    """Return a picture as a data address, for a page that needs no other file."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode("ascii")


def file_address(path: Path, kind: str) -> str:
    """Return a file as a data address."""
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def percent_text(ratio: float, decimals: int = 0) -> str:
    """Return a share with its sign, in per cent."""
    text = f"{100.0 * ratio:+.{decimals}f}"
    return f"{text.replace('-', MINUS) if float(text) else '0'} %"
