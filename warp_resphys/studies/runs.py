"""Runs of the ordinary command, one after the other, and a page on what they left."""

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from rich.console import Console
from rich.markup import escape

from ..experiment.files import METRICS
from ..io.atomic import disk_full_error, is_disk_full
from ..io.errors import DataFileError, ResphysError
from ..io.files import read_json, write_text
from ..io.machine import commit, hardware
from ..io.progress import clock
from ..io.stages import package_versions
from ..report.page import Cell, Drawn, Items, PageTable, Part, Row, markdown, write_page

_UP_TO_DATE_SECONDS = 8.0  # for a run that finds nothing to do
_LINE_SECONDS = 60.0
_PLAIN: dict[str, Any] = {"markup": False, "highlight": False, "soft_wrap": True}
_PATIENCE = 60.0  # s that an interrupted run gets to save what it has


class RunsInterrupted(KeyboardInterrupt):
    """Ctrl-C during a run; the message says what is kept."""


@dataclass(frozen=True)
class Run:
    """One run of the ordinary command."""

    experiment: str
    variant: str
    arguments: tuple[str, ...]  # of the command
    folder: Path  # that it writes, the one that the ordinary command takes for the same arguments
    minutes: float  # that it may take
    failure: str | None = None  # the sentence that it failed with

    @property
    def name(self) -> str:
        """As in the key ``only``."""
        return f"{self.experiment}/{self.variant}" if self.variant else self.experiment

    @property
    def metrics(self) -> dict[str, Any]:
        """What `metrics.json` holds."""
        return dict(read_json(self.folder / METRICS))

    @property
    def settings(self) -> dict[str, Any]:
        """The whole configuration of the run."""
        return dict(read_json(self.folder / "stages" / "report.json")["settings"]["config"])

    @property
    def evaluation(self) -> dict[str, Any]:
        """What is kept of the stage that measured its errors, the last of those of its folds."""
        paths = [path for each in (".", "fold_*") for path in self.folder.glob(f"{each}/stages/evaluate.json")]
        return max((dict(read_json(path)) for path in paths), key=lambda found: str(found["finished"]))


@dataclass(frozen=True)
class Results:
    """A page on runs, as HTML, and in Markdown where asked."""

    title: str
    kicker: str  # Above the title, and after it in Markdown: a date
    verdict: str  # Below it
    parts: Sequence[Part]

    def write(self, page: Path, copies: str | None, name: str) -> None:
        """Writes the page, results.md beside it and, into the folder `copies`, name.md with its figures.

        Raises:
            DataFileError: a file cannot be written.
        """
        write_page(page, title=self.title, kicker=self.kicker, verdict=self.verdict, parts=self.parts)
        title = f"{self.title} of {self.kicker}"
        write_text(page.with_name("results.md"), markdown(title, self.verdict, self.parts, "figures"))
        if copies is not None:
            place = Path(copies) / name
            drawn = [block.name for part in self.parts for block in part.blocks if isinstance(block, Drawn)]
            _copy([page.parent / "figures" / f"{figure}.png" for figure in drawn], place)
            write_text(place.with_suffix(".md"), markdown(title, self.verdict, self.parts, name))
            print(f"Results: {place}.md")
        print(f"Page: {page}")


def made(command: str, hidden: Sequence[str] = ()) -> Part:
    """How a page was made: by which command, on which machine, with which versions.

    Args:
        command: its name, as in "verify device".
        hidden: keys whose values are folders of that machine.
    """
    known = {**hardware(), "commit": commit() or "not known", **package_versions()}
    table = PageTable("Machine and versions", ["Here"], [Row(name, [Cell(value)]) for name, value in known.items()])
    return Part("Command, machine and versions", [*command_part(command, hidden).blocks, table])


def command_part(command: str, hidden: Sequence[str] = ()) -> Part:
    """By which command a page was made; see `made`."""
    given = [(each, each.partition("=")[0]) for each in HydraConfig.get().overrides.task]
    line = shlex.join(
        ["warp-resphys", *command.split(), *(f"{key}=FOLDER" if key in hidden else each for each, key in given)]
    )
    return Part("Command", [Items([line], code=True)])


def fail_for(results: Sequence[Run]) -> None:
    """Raises a ResphysError where a run failed, after all that there is to show was written."""
    if failed := [result.name for result in results if result.failure]:
        raise ResphysError(
            f"{len(failed)} of {len(results)} runs failed ({', '.join(failed)}): the page says why; mend it and run "
            "the same command again."
        )


def _copy(figures: Sequence[Path], folder: Path) -> None:
    """Files into a folder of their own, in place of what is there."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for figure in figures:
            shutil.copy(figure, folder)
    except OSError as error:
        if is_disk_full(error):
            raise disk_full_error(folder) from error
        raise DataFileError(f"cannot write {folder} ({error.strerror}): choose another folder for results.") from error


def run_all(runs: Sequence[Run], logs: Path) -> list[Run]:
    """Runs one after the other; one that fails does not keep the others from running.

    Raises:
        RunsInterrupted: Ctrl-C.
    """
    logs.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=True)
    results: list[Run] = []
    pace = _Pace(runs)
    for number, run in enumerate(runs, 1):
        head = f"[{number}/{len(runs)}] {run.name}"
        console.print(f"{head}, about {clock(pace.left())} left in all", **_PLAIN)
        start = time.perf_counter()
        try:
            with console.status(run.name) as status:
                failure = execute(run, logs / f"{run.name.replace('/', '-')}.log", _follower(console, status.update))
        except KeyboardInterrupt as error:
            raise RunsInterrupted(
                f"interrupted in run {number} of {len(runs)}, {run.name}; it keeps what it has, as do those before it, "
                "and the same command goes on from there"
            ) from error
        pace.count(run, time.perf_counter() - start)
        if failure:
            console.print(f"{head} failed: {failure}", **_PLAIN)
        results.append(replace(run, failure=failure))
    return results


class _Pace:
    """How long the runs that are left will take, from their minutes and from how long the others took."""

    def __init__(self, runs: Sequence[Run]) -> None:
        self._expected = {run.name: 60.0 * run.minutes for run in runs if not (run.folder / METRICS).is_file()}
        self._there = {run.name for run in runs} - self._expected.keys()
        self._taken = self._planned = 0.0

    def left(self) -> float:
        """Seconds."""
        pace = self._taken / self._planned if self._planned else 1.0
        return pace * sum(self._expected.values()) + _UP_TO_DATE_SECONDS * len(self._there)

    def count(self, run: Run, seconds: float) -> None:
        """Takes note of a run that is done."""
        self._there.discard(run.name)
        if run.name in self._expected:
            self._planned += self._expected.pop(run.name)
            self._taken += seconds


def _follower(console: Console, update: Callable[[str], None]) -> Callable[[str], None]:
    """Shows a run's own lines: the latest in a terminal, one a minute in a log."""
    due = time.monotonic() + _LINE_SECONDS

    def follow(line: str) -> None:
        nonlocal due
        if console.is_terminal:
            update(escape(line))
        elif time.monotonic() >= due:
            console.print(f"    {line}", **_PLAIN)
            due = time.monotonic() + _LINE_SECONDS

    return follow


def execute(run: Run, log_file: Path, follow: Callable[[str], None]) -> str | None:
    """Runs the ordinary command in a process of its own, out of reach of the terminal's Ctrl-C.

    All that it says goes to a file, and each line of stderr to `follow`.

    Returns:
        The sentence that it failed with, or None.
    """
    place = str(run.folder).replace("\\", r"\\").replace("'", r"\'")
    command = [sys.executable, "-m", "warp_resphys.cli", *run.arguments, f"hydra.run.dir='{place}'"]
    environment = {name: value for name, value in os.environ.items() if name != "HYDRA_FULL_ERROR"}  # cli.main sets it
    sentence = None
    with (
        log_file.open("a", encoding="utf-8", buffering=1) as written,
        subprocess.Popen(
            command, stdout=written, stderr=subprocess.PIPE, text=True, start_new_session=True, env=environment
        ) as child,
    ):
        assert child.stderr is not None
        try:
            for line in child.stderr:
                written.write(line)
                if line.startswith("error: "):
                    sentence = line.removeprefix("error: ").strip()
                elif line.strip():
                    follow(line.strip())
            child.wait()
        except BaseException:
            written.write(_stop(child))
            raise
    if child.returncode == 0:
        return None
    return sentence or f"it ended with exit code {child.returncode}; what it said is in {log_file}"


def _stop(child: "subprocess.Popen[str]") -> str:
    """Ends a run as Ctrl-C does, and by force if it does not listen; what it says at last."""
    child.send_signal(signal.SIGINT)
    try:
        return child.communicate(timeout=_PATIENCE)[1]
    except subprocess.TimeoutExpired:
        child.kill()
        return child.communicate()[1]
