"""Runs of the command `run`, one after the other, and pages on their results."""

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
from ..io.settings import parse
from ..io.stages import package_versions
from ..report.page import Cell, Drawn, Items, PageTable, Part, Row, markdown, write_page
from ..settings.run import RunSettings

_UP_TO_DATE_SECONDS = 8.0  # for a run that finds nothing to do
_LINE_SECONDS = 60.0
_PLAIN: dict[str, Any] = {"markup": False, "highlight": False, "soft_wrap": True}
_PATIENCE = 60.0  # s that an interrupted run gets to save what it has


class RunsInterrupted(KeyboardInterrupt):
    """Ctrl-C during a run; the message says what is kept."""


@dataclass(frozen=True)
class Run:
    """A run of the command `run`."""

    experiment: str
    variant: str
    arguments: tuple[str, ...]  # of the command
    folder: Path  # run folder, the one that the command `run` chooses for these arguments
    minutes: float  # expected duration
    failure: str | None = None  # error message of a failed run

    @property
    def name(self) -> str:
        """Name of the run in the key ``only``."""
        return f"{self.experiment}/{self.variant}" if self.variant else self.experiment

    @property
    def metrics(self) -> dict[str, Any]:
        """Content of metrics.json."""
        return dict(read_json(self.folder / METRICS))

    @property
    def settings(self) -> RunSettings:
        """The configuration of the run, from the record of its report."""
        return parse(RunSettings, read_json(self.folder / "stages" / "report.json")["settings"]["config"])

    @property
    def evaluation(self) -> dict[str, Any]:
        """Record of the stage ``evaluate``; of a cross-validation, that of the last fold that finished."""
        paths = [path for fold in (".", "fold_*") for path in self.folder.glob(f"{fold}/stages/evaluate.json")]
        return max((dict(read_json(path)) for path in paths), key=lambda record: str(record["finished"]))


@dataclass(frozen=True)
class Results:
    """A page of results, in HTML and in Markdown."""

    title: str
    kicker: str  # date, above the title and, in Markdown, after it
    verdict: str  # below the title
    parts: Sequence[Part]

    def write(self, page: Path, copies: str | None, name: str) -> None:
        """Writes the page, results.md beside it and, into the folder ``copies``, name.md with its figures.

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
    """The section on how a page was made: command, machine and versions of packages.

    Args:
        command: its name, as in "reproduce".
        hidden: keys whose values are folders of that machine; they are left out.
    """
    entries = {**hardware(), "commit": commit() or "not known", **package_versions()}
    table = PageTable("Machine and versions", ["Here"], [Row(name, [Cell(value)]) for name, value in entries.items()])
    return Part("Command, machine and versions", [*command_part(command, hidden).blocks, table])


def command_part(command: str, hidden: Sequence[str] = ()) -> Part:
    """The section with the command that made a page, with the arguments of `made`."""
    keys = {override: override.partition("=")[0] for override in HydraConfig.get().overrides.task}
    shown = (f"{key}=FOLDER" if key in hidden else override for override, key in keys.items())
    line = shlex.join(["warp-resphys", *command.split(), *shown])
    return Part("Command", [Items([line], code=True)])


def fail_for(results: Sequence[Run]) -> None:
    """Raises a ResphysError where a run failed; called after the page was written."""
    if failed := [result.name for result in results if result.failure]:
        raise ResphysError(
            f"{len(failed)} of {len(results)} runs failed ({', '.join(failed)}): the page says why; correct it and run "
            "the same command again."
        )


def _copy(figures: Sequence[Path], folder: Path) -> None:
    """Copies files into a folder, whose earlier content is removed."""
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
    """Executes runs one after the other; after a failed run, the others are still executed.

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
                f"interrupted in run {number} of {len(runs)}, {run.name}; finished work is kept, and the same command "
                "continues from there"
            ) from error
        pace.count(run, time.perf_counter() - start)
        if failure:
            console.print(f"{head} failed: {failure}", **_PLAIN)
        results.append(replace(run, failure=failure))
    return results


class _Pace:
    """Estimate of the remaining time, from the expected minutes of runs and the duration of finished ones."""

    def __init__(self, runs: Sequence[Run]) -> None:
        self._expected = {run.name: 60.0 * run.minutes for run in runs if not (run.folder / METRICS).is_file()}
        self._there = {run.name for run in runs} - self._expected.keys()
        self._taken = self._planned = 0.0

    def left(self) -> float:
        """Remaining time [s]."""
        pace = self._taken / self._planned if self._planned else 1.0
        return pace * sum(self._expected.values()) + _UP_TO_DATE_SECONDS * len(self._there)

    def count(self, run: Run, seconds: float) -> None:
        """Records the duration of a finished run."""
        self._there.discard(run.name)
        if run.name in self._expected:
            self._planned += self._expected.pop(run.name)
            self._taken += seconds


def _follower(console: Console, update: Callable[[str], None]) -> Callable[[str], None]:
    """Returns a function that shows lines of a run: the latest in a terminal, one a minute in a log."""
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
    """Executes the command `run` in a separate process, which the terminal's Ctrl-C does not reach.

    Its output goes to a file, and each line of stderr to ``follow``.

    Returns:
        Error message of a failed run, or None.
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
    return sentence or f"exit code {child.returncode}; its output is in {log_file}"


def _stop(child: "subprocess.Popen[str]") -> str:
    """Interrupts a run as Ctrl-C does, kills it if it does not end in time, and returns the rest of stderr.

    Windows has no such signal: there, the run ends at once, and resumes from its last checkpoint.
    """
    if os.name == "nt":
        child.terminate()
    else:
        child.send_signal(signal.SIGINT)
    try:
        return child.communicate(timeout=_PATIENCE)[1]
    except subprocess.TimeoutExpired:
        child.kill()
        return child.communicate()[1]
