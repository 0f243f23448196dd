"""Progress of a computation: a bar in a terminal, an occasional line in a log."""

from __future__ import annotations

import math
import sys
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn
from rich.progress import Progress as Bars

QUIET_SECONDS = 2.0  # for ``after`` of work that is mostly short
_BAR_SECONDS = 0.1
_LINE_SECONDS = 10.0
_AT_MOST = " at most"  # of units of work that may end early
_shown = True
_running: list[Progress] = []  # innermost last; a terminal has room for one bar


def be_quiet() -> None:
    """Disables progress output in this process, such as a worker whose parent shows the progress of all."""
    global _shown
    _shown = False


class Progress:
    """Shows count, rate, remaining time and the latest values of a loop.

    Use it as a context manager and call `advance` in the loop; most calls only count, in about a microsecond. Without
    a terminal (log files, continuous integration), it prints a line at most every ten seconds, and one at the end.

    Args:
        description: Name of the computation.
        total: Total number of units.
        unit: Name of the units, in the plural.
        start_at: Number of units done by an interrupted run; they do not count for the rate.
        console: Output; stderr by default.
        after: Seconds before which nothing is shown, for work that is mostly short; such a progress shows nothing
            within that of longer work.
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
        self.description, self.total, self.unit, self.done = description, total, unit, start_at
        self._start_at, self._shown = start_at, -1
        self.console = Console(stderr=True, quiet=not _shown) if console is None else console
        self._fields: dict[str, object] = {}
        self._start = self._next = 0.0
        self._marks = ((0.0, 0), (0.0, 0))  # times at which the units done had doubled, and these units
        self._bars: Bars | None = None
        self._task = TaskID(0)

    def __enter__(self) -> Progress:
        """Starts the clock, and shows the bar in a terminal."""
        self._start = time.perf_counter()
        self._marks = ((self._start, 0), (self._start, 0))
        self._next = self._start + (self._after if self.console.is_terminal else max(self._after, _LINE_SECONDS))
        if self._after and _running:
            self._next = math.inf
        _running.append(self)
        if self.console.is_terminal and not self._after:
            self._start_bar()
        return self

    def _start_bar(self) -> None:
        columns = TextColumn("{task.description}"), BarColumn(bar_width=24), TextColumn("{task.fields[status]}")
        self._bars = Bars(*columns, console=self.console, refresh_per_second=5, redirect_stdout=sys.stdout.isatty())
        self._bars.start()
        self._task = self._bars.add_task(self.description, total=self.total, completed=self.done, status=self.status())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Shows the final state."""
        now, self._ended = time.perf_counter(), kind is None and self.unit.endswith(_AT_MOST)
        _running.remove(self)
        waited = not self._after or (self._next < math.inf and now >= self._start + self._after)
        if self._bars is not None or (waited and self.done != self._shown):
            self._show(now)
        if self._bars is not None:
            self._bars.stop()

    def advance(self, count: int = 1, **fields: object) -> None:
        """Counts further units; `fields` are named values to show, such as a loss."""
        self.done += count
        if fields:
            self._fields = fields
        now, new = time.perf_counter(), self.done - self._start_at
        if new >= 2 * self._marks[1][1]:
            self._marks = (self._marks[1], (now, new))
        if now >= self._next:
            self._show(now)

    def status(self) -> str:
        """Count, rate, remaining time and latest values in one line.

        The rate is that of the later units, as the first ones wait for kernels to be compiled or processes to start.
        """
        now, new = time.perf_counter(), self.done - self._start_at
        elapsed, (since, before) = now - self._start, self._marks[0]
        parts = [f"{self.done}/{self.total} {self.unit}"]
        if new > before and now > since:
            rate = (new - before) / (now - since)
            duration = f"{1 / rate:.3g} s" if rate > 1 / 60 else clock(1 / rate)
            parts.append(f"{rate:.3g} {self.unit.removesuffix(_AT_MOST)}/s" if rate >= 1 else f"{duration} each")
            left = (self.total - self.done) / rate
            parts.append(f"{clock(left)} left" if left > 0 and not self._ended else f"in {clock(elapsed)}")
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
            self.console.print(f"{self.description}: {self.status()}", markup=False, highlight=False, soft_wrap=True)
            self._next = now + _LINE_SECONDS


def clock(seconds: float) -> str:
    """Formats a duration as minutes:seconds or hours:minutes:seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
