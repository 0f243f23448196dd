"""Progress of a computation: a bar in a terminal, an occasional line in a log.

Tables and sentences in a terminal.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType
from typing import Any, Final, TypeVar

from rich.console import Console, RenderableType
from rich.progress import BarColumn, TaskID, TextColumn
from rich.progress import Progress as Bars

T = TypeVar("T")

QUIET_SECONDS = 2.0  # for ``after`` of work that is mostly short
_BAR_SECONDS = 0.1
_LINE_SECONDS = 10.0
_SURE_CALLS, _SURE_SECONDS = 8, 20.0  # of which one is done before an estimate is shown
_AT_MOST = " at most"  # of units of work that may end early
_SHOWN: Final = ContextVar("shown", default=True)
# Number of loops that are shown; a terminal has room for one bar.
_RUNNING: Final = ContextVar("running", default=0)
# Work of the loops of a stage, which ends with one line for all of them; None outside of stages.
_STAGE: Final = ContextVar[list[str] | None]("stage", default=None)
_TITLES: Final = {  # of stages, by the first word of their names, and of single ones
    "simulate": "Simulating the trials",
    "laboratory": "Simulating the recordings",
    "import": "Reading the recordings",
    "identify": "Identifying the parameters",
    "identify_law": "Identifying the law of the material",
    "shapes": "Simulating other bodies",
    "reconstruct": "Reconstructing the missing forces",
    "reconstruct_resphys_uncorrected": "Reconstructing, uncorrected simulator",
    "train": "Training the force",
    "train_actuator": "Training the actuator",
    "train_resphys_uncorrected": "Training, uncorrected simulator",
    "train_simfree": "Training a network without a simulator",
    "evaluate": "Simulating the test trials",
    "time": "Timing the models",
    "mesh_check": "Estimating the error of the mesh",
    "reduce": "Fitting the reduced model",
    "plan": "Planning the motions",
    "baselines": "Fitting the controllers",
    "drive": "Driving the robot",
    "report": "Writing the report",
}
_LOG_WIDTH: Final = 110  # of tables that go to a file, in characters


def title_of(stage: str) -> str:
    """Returns what a stage, or a part of one after a colon, does, in words.

    A name that is no stage unchanged.
    """
    name, colon, part = stage.partition(":")
    return f"{_TITLES.get(name) or _TITLES.get(name.partition('_')[0], name)}{colon}{part}"


@contextmanager
def one_line(stage: str) -> Iterator[Callable[[float], str]]:
    """Shows the loops of a stage without lines at their ends.

    The yielded function makes that of the stage.

    Args:
        stage: its name.
    """
    done: list[str] = []
    token = _STAGE.set(done)
    try:
        yield (
            lambda seconds: (
                f"{title_of(stage):<42}{(done or [''])[0]:<16}{duration(seconds)}".rstrip()
            )
        )
    finally:
        _STAGE.reset(token)


def be_quiet() -> None:
    """Disables progress output in this process, such
    as a worker whose parent shows the progress of all.
    """
    _SHOWN.set(False)


class Progress:
    """Shows count, rate, remaining time and the latest values of a loop.

    Use it as a context manager and call `advance` in the loop; most calls only count, in about a
    microsecond. Without a terminal (log files, continuous integration), it prints a line at most
    every ten seconds, and one at the end.

    Args:
        description: Name of the computation, or of the stage.
        total: Total number of units.
        unit: Name of the units, in the plural.
        start_at: Number of units done by an interrupted run; they do not count for the rate.
        console: Output; stderr by default.
        after: Seconds before which nothing is shown, for work that is mostly short; such a progress
            shows nothing within that of longer work.
    """

    def __init__(
        self,
        description: str,
        total: int,
        unit: str,
        start_at: int = 0,
        console: Console | None = None,
        after: float = 0.0,
    ) -> None:
        self._after, self._ended = after, False
        self.description, self._title = description, title_of(description)
        self.total, self.unit = total, unit
        self.done = self._start_at = start_at
        self._shown, self._calls = -1, 0
        self.console = Console(stderr=True, quiet=not _SHOWN.get()) if console is None else console
        self._fields: dict[str, object] = {}
        self._start = self._next = 0.0
        # Times at which the units done had doubled, and these units.
        self._marks = ((0.0, 0), (0.0, 0))
        self._bars: Bars | None = None
        self._task = TaskID(0)

    def __enter__(self) -> Progress:
        """Starts the clock, and shows the bar in a terminal."""
        self._start = time.perf_counter()
        self._marks = ((self._start, 0), (self._start, 0))
        self._next = self._start + (
            self._after if self.console.is_terminal else max(self._after, _LINE_SECONDS)
        )
        if self._after and _RUNNING.get():
            self._next = math.inf
        self._token = _RUNNING.set(_RUNNING.get() + 1)
        if self.console.is_terminal and not self._after:
            self._start_bar()
        return self

    def _start_bar(self) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[status]}"),
        )
        options: dict[str, Any] = {"refresh_per_second": 5, "redirect_stdout": sys.stdout.isatty()}
        self._bars = Bars(
            *columns, console=self.console, transient=_STAGE.get() is not None, **options
        )
        self._bars.start()
        self._task = self._bars.add_task(
            self._title, total=self.total, completed=self.done, status=self.status()
        )

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Shows the final state."""
        now, self._ended = time.perf_counter(), kind is None and self.unit.endswith(_AT_MOST)
        _RUNNING.reset(self._token)
        stage = _STAGE.get()
        waited = not self._after or (self._next < math.inf and now >= self._start + self._after)
        if (
            stage is not None
            and not self._after
            and not _RUNNING.get()
            and not self.unit.endswith(_AT_MOST)
        ):
            stage.append(f"{self.total:,} {self.unit}")
        if self._bars is not None or (waited and self.done != self._shown and stage is None):
            self._show(now)
        if self._bars is not None:
            self._bars.stop()

    def each(self, items: Iterable[T]) -> Iterator[T]:
        """Yields items, and counts each of them when the next one is asked for."""
        for item in items:
            yield item
            self.advance()

    def advance(self, count: int = 1, **fields: object) -> None:
        """Counts further units; `fields` are named values to show, such as a loss."""
        self.done += count
        self._calls += 1
        if fields:
            self._fields = fields
        now, new = time.perf_counter(), self.done - self._start_at
        if new >= 2 * self._marks[1][1]:
            self._marks = (self._marks[1], (now, new))
        if now >= self._next:
            self._show(now)

    def status(self) -> str:
        """Count, remaining time and latest values in one line.

        The time left follows from the later units, as the first ones wait for kernels to be
        compiled or processes to start; it is not shown before some of them are done, nor for work
        that may end early.
        """
        now, new = time.perf_counter(), self.done - self._start_at
        since, before = self._marks[0]
        at_most = self.unit.endswith(_AT_MOST)
        unit = self.unit.removesuffix(_AT_MOST)
        parts = [f"{unit.removesuffix('s')} {self.done} (limit {self.total})"] if at_most else []
        parts = parts or [f"{self.done}/{self.total} {unit}"]
        if self._ended or self.done >= self.total:
            parts.append(f"in {duration(now - self._start)}")
        elif (
            new > before > 0
            and (self._calls >= _SURE_CALLS or now > since + _SURE_SECONDS)
            and not at_most
        ):
            parts.append(f"{clock((self.total - self.done) * (now - since) / (new - before))} left")
        for name, value in self._fields.items():
            parts.append(f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}")
        return ", ".join(parts)

    def _show(self, now: float) -> None:
        self._shown = self.done
        if self._bars is None and self.console.is_terminal:
            self._start_bar()
        if self._bars is not None:
            self._bars.update(self._task, completed=self.done, status=self.status())
            self._next = now + _BAR_SECONDS
        else:
            self.console.print(
                f"{self._title}: {self.status()}", markup=False, highlight=False, soft_wrap=True
            )
            self._next = now + _LINE_SECONDS


def duration(seconds: float) -> str:
    """Formats a duration as "5 s", or as minutes:seconds from a minute on."""
    return f"{max(seconds, 0.0):.0f} s" if seconds < 59.5 else clock(seconds)


def clock(seconds: float) -> str:
    """Formats a duration as minutes:seconds or hours:minutes:seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def show(*parts: RenderableType) -> None:
    """Prints tables and sentences, as wide as the terminal."""
    console = Console(width=None if sys.stdout.isatty() else _LOG_WIDTH)
    for part in parts:
        console.print(part, markup=False, highlight=False, soft_wrap=isinstance(part, str))


def aligned(rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Rows as lines of text, the first `left` columns aligned to the left,
    the others to the right.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]

    def line(row: Sequence[str]) -> str:
        names = map(str.ljust, row[:left], widths[:left])
        numbers = map(str.rjust, row[left:], widths[left:])
        return "  ".join([*names, *numbers]).rstrip()

    return "\n".join(map(line, rows))
