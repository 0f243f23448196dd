"""Self-contained HTML pages of text, tables and figures, and the formats of numbers."""

import base64
import hashlib
import logging
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ..io.atomic import disk_full_error, is_disk_full
from ..io.errors import DataFileError
from ..io.files import write_text
from ..learning.metrics import PublishedError
from ..settings.run import RunSettings
from .render import DrawingError, Renderer

if TYPE_CHECKING:
    import rich.console
    import rich.table
    from matplotlib.figure import Figure as Drawing

_LOG = logging.getLogger(__name__)
NO_BREAK_SPACE = "\u00a0"
NONE = "\N{EN DASH}"
MINUS = "\N{MINUS SIGN}"
_TIMED = {  # Models whose computing times are shown.
    "simulation": "Uncorrected simulator",
    "target": "Simulation with the true parameters",
    "resphys": "Simulation with the learned force",
    "inference": "of which the network",
}
_WIDEST, _NARROW = 1000, 78  # characters: beyond every table; terminals below it wrap the heads of rows as well
_LEAST_DECIMAL = 1e-4  # Smaller numbers are written with a power of ten.


class Cell(NamedTuple):
    """One entry of a table."""

    text: str
    small: str = ""  # In small print below it.
    beside: str = ""  # Beside it, such as a deviation.

    @classmethod
    def of(cls, parts: tuple[str, str]) -> "Cell":
        """Returns a text and its deviation."""
        return cls(parts[0], beside=parts[1])


@dataclass(frozen=True)
class Row:
    """One row of a table."""

    head: str
    cells: Sequence[Cell]  # One a column.
    mark: str = ""  # Beside the row, such as "best"; the row is highlighted.
    small: str = ""  # In small print below the head.
    address: str = ""  # Link of the head; may be empty.


@dataclass(frozen=True)
class PageTable:
    """A table."""

    head: str  # Above the first column.
    columns: Sequence[str]  # Heads of the other columns.
    rows: Sequence[Row]
    note: str = ""  # Below the table.
    summary: str = ""  # Title of a table that can be folded; empty for one that cannot.
    unfolded: bool = False  # Whether it is unfolded at first.

    @classmethod
    def plain(cls, title: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> "PageTable":
        """Returns a table of texts, without small print."""
        return cls(heads[0], heads[1:], [Row(first, [*map(Cell, cells)]) for first, *cells in rows], summary=title)

    @property
    def marked(self) -> bool:
        """Whether a row is marked."""
        return any(row.mark for row in self.rows)

    def __rich_console__(
        self, console: "rich.console.Console", options: "rich.console.ConsoleOptions"
    ) -> Iterator[Any]:
        """Yields the table for a terminal, without lines; where it is too wide, its heads are wrapped."""
        from rich.text import Text as Plain

        table, wide = self._drawn(self.head, True), options.update(max_width=_WIDEST)
        if console.measure(table, options=wide).maximum > options.max_width:
            head = textwrap.fill(self.head, max(len(row.head) for row in self.rows))
            table = self._drawn(head, options.max_width >= _NARROW)
        yield table
        if self.note:
            yield Plain(self.note)

    def _drawn(self, head: str, whole: bool) -> "rich.table.Table":
        import rich.table
        from rich.text import Text as Plain  # "[mm]" is no markup.

        title = Plain(self.summary) if self.summary else None
        table = rich.table.Table(title=title, title_justify="left", box=None, padding=(0, 2, 0, 0), pad_edge=False)
        table.add_column(Plain(head), no_wrap=whole)
        for column in self.columns:
            table.add_column(Plain(column), justify="right")
        for row in self.rows:
            cells = (" ".join(filter(None, (cell.text, cell.beside, cell.small))) for cell in row.cells)
            marked = [row.mark] if self.marked else []
            table.add_row(*map(Plain, (row.head, *cells, *marked)), style="bold" if row.mark else None)
        return table


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str
    name: str = ""  # Identifier on the page.
    note: bool = False  # Whether it is in small print.
    heading: bool = False  # Whether it is a heading.


@dataclass(frozen=True)
class Items:
    """A list."""

    items: Sequence[str]
    name: str = ""


@dataclass(frozen=True)
class Drawn:
    """A picture or a film with its caption."""

    name: str  # Of the file, and on the page.
    caption: str
    alt: str  # Description.
    address: str  # Its content, as a data address.

    @classmethod
    def of(cls, path: Path, alt: str, caption: str) -> "Drawn":
        """Returns a PNG or MP4 file as a picture or a film."""
        kind = {".png": "image/png", ".mp4": "video/mp4"}[path.suffix]
        return cls(path.stem, caption, alt, data_address(path.read_bytes(), kind))


@dataclass(frozen=True)
class ViewInSpace:
    """An interactive view of bodies in motion, with the data that the script of the page reads."""

    name: str  # On the page.
    caption: str
    alt: str  # Description.
    payload: Markup
    models: Sequence[Mapping[str, Any]]  # `name`, `light` and `dark` colour, and whether it is `shown` at first.
    frames: int
    speed: float  # Initial speed, over the real one.
    observed: str  # "markers" or "vertices".


Block = Text | Items | PageTable | Drawn | ViewInSpace


@dataclass(frozen=True)
class Part:
    """A section of a page: its heading and its blocks."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Canvas:
    """Draws the figures of a page into a folder."""

    folder: Path  # Of their files.
    started: dict[str, "Future[Any]"] = field(default_factory=dict)  # Pictures drawn by other processes, by name.
    missing: set[str] = field(default_factory=set)  # Reasons why pictures cannot be drawn on this machine.
    renderer: Renderer = field(default_factory=Renderer)  # Of the pictures that are drawn here.

    def figure(self, name: str, figure: "Drawing", alt: str, caption: str) -> Drawn:
        """Return a figure with its description and caption, and save it as a PNG file of its name too."""
        from . import figures

        figures.settle(figure)
        figures.save_png(figure, self.folder / f"{name}.png")
        return Drawn(name, caption, alt, data_address(figures.themed_svg(figure, name), "image/svg+xml"))

    def attempt(self, file: str, draw: Callable[[Path], Drawn]) -> list[Block]:
        """Return a picture drawn into a file, or a sentence why it cannot be drawn, once for each reason.

        Where it cannot be drawn, the file of an earlier page is removed.
        """
        path = self.folder / file
        try:
            return [draw(path)]
        except DrawingError as error:
            path.unlink(missing_ok=True)
            reason = f"{error}, then delete this page and run the same command again."
            if reason in self.missing:
                return []
            _LOG.warning("the report lacks a picture: %s", error)
            self.missing.add(reason)
            return [Text(reason, path.stem, note=True)]


@contextmanager
def canvas_beside(path: Path) -> Iterator[Canvas]:
    """Yield the canvas of a page, whose files are in the folder `figures` beside it, and apply the style of figures.

    Raises:
        DataFileError: A figure could not be written there.
    """
    from . import figures

    folder = path.parent / "figures"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with figures.in_style():
            yield Canvas(folder)
    except OSError as error:
        if is_disk_full(error):
            raise disk_full_error(folder) from error
        raise DataFileError(f"cannot write figures to {folder}: {error.strerror or error}") from error


def write_page(
    path: Path, parts: Sequence[Part], run: RunSettings, verdict: Sequence[str], metrics: Mapping[str, Any]
) -> None:
    """Write the page of a run.

    Args:
        path: The page's file.
        parts: Its sections.
        run: Settings, with the title.
        verdict: Sentences below the title.
        metrics: `seconds` by stage, `peak_memory_gib`, `versions` and `device`.

    Raises:
        DataFileError: The file cannot be written.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("warp_resphys", "report"),
        undefined=jinja2.StrictUndefined,
        autoescape=jinja2.select_autoescape(["html"]),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    script, digest = "", ""  # The script that some blocks need, and its digest for the content security policy.
    if any(isinstance(block, ViewInSpace) for part in parts for block in part.blocks):
        script = resources.files(__package__).joinpath("view.js").read_text(encoding="utf-8")
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    page = environment.get_template("page.html").render(
        title=run.heading,
        experiment=run.name,
        verdict=verdict,
        parts=[*parts, *_times(metrics)],
        script=Markup(script),
        digest=digest,
        kind_of=lambda block: type(block).__name__,
        metrics=metrics,
        settings=list(flatten(run.plain())),
    )
    write_text(path, page)
    _LOG.debug("report written: %s", path)


def _times(metrics: Mapping[str, Any]) -> Iterator[Part]:
    """Yields the section on computing times and memory; nothing without times."""
    if seconds := metrics.get("seconds"):
        stages = {**seconds, "Sum, also of stages that ran at once": sum(seconds.values())}
        rows = [Row(stage, [Cell(duration_text(spent))]) for stage, spent in stages.items()]
        one = metrics.get("seconds_per_test_trajectory", {})
        timed = [Row(name, [Cell(duration_text(one[m]["mean"]))]) for m, name in _TIMED.items() if m in one]
        tables = [PageTable("Stage", ["Wall time"], rows)]
        tables += [PageTable("One test trial at a time", ["Wall time"], timed)] if timed else []
        peak = metrics["peak_memory_gib"]
        memory = [] if peak is None else [Text(f"Peak memory: {peak:.2f}{NO_BREAK_SPACE}GiB.", note=True)]
        yield Part("Time taken", [*tables, *memory])


def number_text(value: float | None) -> str:
    """Return a number with three digits, or two below 0.1, such as "1.07", "0.0038" or "4.3e-07"; None: diverged."""
    if value is None:
        return "diverged"
    return f"{value:.1e}" if 0.0 < abs(value) < _LEAST_DECIMAL else f"{value:,.{_decimals(value)}f}"


def _decimals(value: float) -> int:
    return max(0, (2 if abs(value) >= 0.1 else 1) - math.floor(math.log10(abs(value)))) if value else 0


def mm_text(value: float | None) -> str:
    """Return a mean error with its unit; None stands for divergence."""
    return number_text(value) + ("" if value is None else " mm")


def largest_text(errors: NDArray[np.float64]) -> str:
    """Return the largest of errors [mm] as text; NaN is left out, an infinite error has diverged."""
    values = errors[~np.isnan(errors)]
    return mm_text(float(values.max())) if len(values) and np.isfinite(values).all() else "infinity (it diverged)"


def error_parts(summary: Mapping[str, Any]) -> tuple[str, str]:
    """Return a mean and its "± deviation", if there is one, with the same decimals."""
    mean, std = summary["mean"], summary["std"]
    if mean is None:
        return f"{summary['diverged']} of {summary['trajectories']} diverged", ""
    if std is None:
        return number_text(mean), ""
    deviation = number_text(std) if mean < _LEAST_DECIMAL else f"{std:,.{_decimals(mean)}f}"
    return number_text(mean), f"± {deviation}"


def duration_text(seconds: float) -> str:
    """Return a duration as "0.42 s", "12.3 s" or "3 min 05 s"."""
    if seconds < 60.0:
        return f"{seconds:.2f} s" if seconds < 10.0 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"


def published_parts(error: PublishedError) -> tuple[str, str]:
    """Return mean and deviation as they were published: both with the same decimals."""
    decimals = max(len(repr(float(part)).partition(".")[2]) for part in error)
    return f"{error.mean:.{decimals}f}", f"± {error.std:.{decimals}f}"


def flatten(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield settings as dotted keys, as on the command line, with their values."""
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{prefix}{key}.")
        elif isinstance(value, list | tuple):
            yield f"{prefix}{key}", f"[{', '.join(map(str, value))}]"
        else:
            yield f"{prefix}{key}", "null" if value is None else str(value)


def data_address(content: bytes, kind: str) -> str:
    """Return content as a data address."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def significant(value: float, digits: int = 2) -> str:
    """Return a number with some significant digits, without an exponent."""
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value)))) if value else 0}f}"


def share_text(share: float) -> str:
    """Return a share as a percentage, such as "63 %" or "99.8 %", with a digit of what is left of it."""
    left = 100.0 * (1.0 - share)
    digits = max(0, -math.floor(math.log10(left))) if left > 0.0 else 0
    return f"{100.0 * share:.{digits}f} %".replace("-", MINUS)


def unbroken(text: str) -> str:
    """Return a text with no-break spaces between numbers and their units or symbols."""
    return re.sub(r"(?<=\d) (?=(?:mm|kPa|s)\b|%)|(?<=\b[Eν]) (?=\d)", NO_BREAK_SPACE, text)  # noqa: RUF001


def in_a_row(words: Sequence[str]) -> str:
    """Return words as a list in a sentence: "a, b and c"."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
