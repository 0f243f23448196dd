"""Self-contained HTML pages of sections, which have texts, lists,
tables, figures, films and views in space.
"""

import base64
import hashlib
import logging
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from importlib import resources
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypedDict, TypeVar

from markupsafe import Markup

from ..io.atomic import disk_full_error, is_disk_full
from ..io.errors import DataFileError
from ..io.safe_files import write_text
from ..settings.run import RunSettings
from .render import DrawingError, Renderer
from .wording import NO_BREAK_SPACE, duration_text, flatten

if TYPE_CHECKING:
    import rich.console
    import rich.table
    from matplotlib.figure import Figure

_LOG = logging.getLogger(__name__)
_TIMED: Final = {  # Models whose computing times are shown.
    "simulation": "Uncorrected simulator",
    "target": "Simulation with the true parameters",
    "resphys": "Simulation with the learned force",
    "inference": "of which the network",
}
# Characters: beyond every table; terminals below it wrap the heads of rows as well.
_WIDEST, _NARROW = 1000, 78
Result = TypeVar("Result")


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
        return cls(
            heads[0],
            heads[1:],
            [Row(first, [*map(Cell, cells)]) for first, *cells in rows],
            summary=title,
        )

    @property
    def marked(self) -> bool:
        """Whether a row is marked."""
        return any(row.mark for row in self.rows)

    def __rich_console__(
        self, console: "rich.console.Console", options: "rich.console.ConsoleOptions"
    ) -> Iterator[Any]:
        """Yields the table for a terminal, without lines.

        Where it is too wide, its heads are wrapped.
        """
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
        table = rich.table.Table(
            title=title, title_justify="left", box=None, padding=(0, 2, 0, 0), pad_edge=False
        )
        table.add_column(Plain(head), no_wrap=whole)
        for column in self.columns:
            table.add_column(Plain(column), justify="right")
        for row in self.rows:
            cells = (
                " ".join(filter(None, (cell.text, cell.beside, cell.small))) for cell in row.cells
            )
            marked = [row.mark] if self.marked else []
            table.add_row(
                *map(Plain, (row.head, *cells, *marked)), style="bold" if row.mark else None
            )
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
        return cls(path.stem, caption, alt, _address(path.read_bytes(), kind))


class Usage(TypedDict, total=False):
    """Resources that a run used, and what it was made with, in metrics.json."""

    seconds: dict[str, float]  # wall time by stage
    peak_memory_gib: float | None
    seconds_per_test_trajectory: dict[str, dict[str, float]]  # `mean` and `std` by model
    versions: Mapping[str, str]
    device: str


class ShownModel(TypedDict):
    """A model of a view, also for the script of the page."""

    name: str
    light: str  # colour on a light page
    dark: str
    shown: bool  # at first
    largest: float  # error [mm]
    means: list[float | None]  # error in each frame [mm]; None after it diverged


@dataclass(frozen=True)
class ViewInSpace:
    """An interactive view of bodies in motion, with the data that the script of the page reads."""

    name: str  # On the page.
    caption: str
    alt: str  # Description.
    payload: Markup
    models: Sequence[ShownModel]
    frames: int
    speed: float  # Initial speed, over the real one.
    observed: str  # "markers" or "vertices".


@dataclass(frozen=True)
class Rendered:
    """A picture or a film that the drawing process is working on.

    Its block is made once all sections are.
    """

    path: Path  # Of its file.
    finish: Callable[[], Drawn]  # Waits for the process; raises a DrawingError if it cannot draw.


Block = Text | Items | PageTable | Drawn | ViewInSpace | Rendered


@dataclass(frozen=True)
class Part:
    """A section of a page: its heading and its blocks."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Canvas:
    """Draws the figures of a page into a folder."""

    folder: Path  # Of their files.
    renderer: Renderer = field(default_factory=Renderer)  # Of pictures of bodies.
    pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1))  # Waits for it.

    def figure(self, name: str, figure: "Figure", alt: str, caption: str) -> Drawn:
        """Returns a figure with its description and caption,
        and saves it as a PNG file of its name too.
        """
        from . import figures

        figures.settle(figure)
        figures.save_png(figure, self.folder / f"{name}.png")
        return Drawn(
            name, caption, alt, _address(figures.themed_svg(figure, name), "image/svg+xml")
        )

    def rendered(
        self, file: str, draw: Callable[[Renderer], Result], finish: Callable[[Path, Result], Drawn]
    ) -> Rendered:
        """Starts to draw a picture or film of bodies, which other sections need not wait for.

        Args:
            file: Name of its file.
            draw: Draws by a renderer, in another thread: figures of matplotlib belong to `finish`.
            finish: Makes the block from the path and what was drawn, after all sections.
        """
        path = self.folder / file
        future: Future[Result] = self.pool.submit(draw, self.renderer)
        return Rendered(path, lambda: finish(path, future.result()))


def write_page(
    path: Path,
    sections: Callable[[Canvas], Iterable[Part | None]],
    run: RunSettings,
    verdict: Sequence[str],
    metrics: Usage,
    conditions: Sequence[str] = (),
) -> None:
    """Draws the sections and writes their page, with files of its figures in `figures/` beside it.

    The page is written to a temporary file first, so that it is never incomplete. Pictures that
    cannot be drawn on this machine are replaced by a sentence with the reason.

    Args:
        path: The page's file, such as `report.html`; missing folders are made.
        sections: Yields the sections, drawn on a canvas; None for those with nothing to show.
        run: Settings, with the title.
        verdict: Sentences below the title.
        metrics: Of the run.
        conditions: Of the verdict, listed below it.

    Raises:
        DataFileError: A file could not be written.
    """
    import jinja2

    from . import figures

    folder = path.parent / "figures"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with figures.in_style(), ThreadPoolExecutor(1) as pool, Renderer() as renderer:
            canvas = Canvas(folder, renderer, pool)
            parts = [
                *_finished([part for part in sections(canvas) if part is not None]),
                *_times(metrics),
            ]
    except OSError as error:
        if is_disk_full(error):
            raise disk_full_error(folder) from error
        raise DataFileError(
            f"cannot write figures to {folder}: {error.strerror or error}"
        ) from error
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("warp_resphys", "report"),
        undefined=jinja2.StrictUndefined,
        autoescape=jinja2.select_autoescape(["html"]),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # The script that some blocks need, and its digest for the content security policy.
    script, digest = "", ""
    blocks = chain.from_iterable(part.blocks for part in parts)
    if any(isinstance(block, ViewInSpace) for block in blocks):
        script = resources.files(__package__).joinpath("view.js").read_text(encoding="utf-8")
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    page = environment.get_template("page.html").render(
        title=run.heading,
        experiment=run.name,
        verdict=verdict,
        conditions=conditions,
        parts=parts,
        script=Markup(script),
        digest=digest,
        kind_of=lambda block: type(block).__name__,
        metrics=metrics,
        settings=list(flatten(run.plain())),
    )
    write_text(path, page)
    _LOG.debug("report written: %s", path)


def _finished(parts: Sequence[Part]) -> Iterator[Part]:
    """Yields the sections with their pictures of bodies,
    or a sentence why there are none, once for each reason.

    Where one cannot be drawn, the file of an earlier page is removed.
    """
    missing = set[str]()
    for part in parts:
        blocks = list[Block]()
        for block in part.blocks:
            if not isinstance(block, Rendered):
                blocks.append(block)
                continue
            try:
                blocks.append(block.finish())
            except DrawingError as error:
                block.path.unlink(missing_ok=True)
                reason = f"{error}, then delete this page and run the same command again."
                if reason not in missing:
                    _LOG.warning("the report lacks a picture: %s", error)
                    missing.add(reason)
                    blocks.append(Text(reason, block.path.stem, note=True))
        yield replace(part, blocks=blocks)


def _times(metrics: Usage) -> Iterator[Part]:
    """Yields the section on computing times and memory; nothing without times."""
    seconds = metrics.get("seconds")
    if seconds:
        stages = {**seconds, "Sum, also of stages that ran at once": sum(seconds.values())}
        rows = [Row(stage, [Cell(duration_text(spent))]) for stage, spent in stages.items()]
        one = metrics.get("seconds_per_test_trajectory", {})
        timed = [
            Row(name, [Cell(duration_text(one[m]["mean"]))])
            for m, name in _TIMED.items()
            if m in one
        ]
        tables = [PageTable("Stage", ["Wall time"], rows)]
        tables += [PageTable("One test trial at a time", ["Wall time"], timed)] if timed else []
        peak = metrics["peak_memory_gib"]
        memory = (
            []
            if peak is None
            else [Text(f"Peak memory: {peak:.2f}{NO_BREAK_SPACE}GiB.", note=True)]
        )
        yield Part("Time taken", [*tables, *memory])


def _address(content: bytes, kind: str) -> str:
    """Returns content as a data address."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
