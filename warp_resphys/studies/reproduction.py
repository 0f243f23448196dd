"""Every experiment in turn, each through the ordinary command, and one page that sets published results beside ours."""

import logging
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.console import Console
from rich.markup import escape

from ..experiment.files import METRICS
from ..experiment.schema import check, optional
from ..io.errors import DataFileError, InputError, ResphysError
from ..io.files import disk_full_error, is_disk_full, write_text
from ..io.labels import run_label
from ..io.machine import commit, hardware
from ..io.progress import clock
from ..io.stages import package_versions, run_lock
from ..report.page import Canvas, Cell, Drawn, Items, Part, Row, Table, figures_beside
from .command import WORDS, settings_of
from .comparison import Run, compare
from .page import markdown, write_page

log = logging.getLogger(__name__)

PAGE = "reproduction.html"
_UP_TO_DATE_SECONDS = 8.0  # for a run that finds nothing to do
_LINE_SECONDS = 60.0
_PLAIN: dict[str, Any] = {"markup": False, "highlight": False, "soft_wrap": True}
_PATIENCE = 60.0  # s that an interrupted run gets to save what it has


class ReproductionInterrupted(KeyboardInterrupt):
    """Ctrl-C during a run; the message says what is kept."""


def reproduce(config: DictConfig) -> None:
    """Runs what is configured; writes the page and logs into the run folder, and where asked a dated page of results.

    Raises:
        InputError: a value that cannot be used.
        ResphysError: a run failed; the others were run, and the page is written.
        ReproductionInterrupted: Ctrl-C.
    """
    plain, folder = settings_of(config)
    runs = plan(plain)
    with run_lock(folder):
        results = run_all(runs, folder / "logs")
        page = folder / PAGE
        with figures_beside(page) as pictures:
            verdict, parts = compare(plain, results, Canvas(pictures))
        parts.append(_made())
        date = f"{datetime.now():%Y-%m-%d}"
        write_page(page, title="Reproduction", kicker=date, verdict=verdict, parts=parts)

        def in_markdown(folder: str) -> str:
            return markdown(f"Reproduction of {date}", verdict, parts, folder)

        write_text(page.with_name("results.md"), in_markdown(pictures.name))
        if plain["results"] is not None:
            name = f"{date}-reproduction"
            place = Path(plain["results"]) / name
            drawn = [block.name for part in parts for block in part.blocks if isinstance(block, Drawn)]
            _copy([pictures / f"{figure}.png" for figure in drawn], place)
            write_text(place.with_suffix(".md"), in_markdown(name))
            print(f"Results: {place}.md")
    print(f"Page: {page}")
    if failed := [result.name for result in results if result.failure]:
        raise ResphysError(
            f"{len(failed)} of {len(runs)} runs failed ({', '.join(failed)}): the page says why; mend it and run the "
            "same command again."
        )


def _made() -> Part:
    """How the page was made: by which command, on which machine, with which versions."""
    command = shlex.join(["warp-resphys", "reproduce", *HydraConfig.get().overrides.task])
    known = {**hardware(), "commit": commit() or "not known", **package_versions()}
    table = Table("Machine and versions", ["Here"], [Row(name, [Cell(value)]) for name, value in known.items()])
    return Part("Command, machine and versions", [Items([command], code=True), table])


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


def plan(config: Mapping[str, Any]) -> list[Run]:
    """The runs that are asked for, in order.

    Raises:
        InputError: a value of the wrong kind, or a name that does not exist.
    """
    check("overrides", config["overrides"], WORDS)
    check("only", config["only"], optional(WORDS))
    runs = [
        _run(config, experiment, variant)
        for experiment, group in config["experiments"].items()
        for variant in group["variants"]
    ]
    wanted = config["only"]
    if wanted is None:
        return runs
    known = {run.experiment for run in runs} | {run.name for run in runs}
    if foreign := [name for name in wanted if name not in known]:
        raise InputError(
            f"only names {foreign[0]!r}, which is no experiment or run: there are {', '.join(sorted(known))}."
        )
    if not wanted:
        raise InputError("only is []: name at least one experiment or run, or leave it null for all.")
    return [run for run in runs if {run.experiment, run.name} & {*wanted}]


def _run(config: Mapping[str, Any], experiment: str, name: str) -> Run:
    if name not in config["variants"]:
        raise InputError(
            f"experiments.{experiment}.variants names {name!r}: there are {', '.join(config['variants'])}."
        )
    variant = config["variants"][name]
    overrides = [*variant["overrides"], *config["experiments"][experiment]["overrides"], *config["overrides"]]
    if config["budget"] != "full":
        overrides.append(f"budget={config['budget']}")
    folder = Path(config["runs"]) / experiment / run_label(overrides, ("experiment", "device"))
    return Run(experiment, name, (f"experiment={experiment}", *overrides), folder, variant["minutes"][config["budget"]])


def run_all(runs: Sequence[Run], logs: Path) -> list[Run]:
    """Runs one after the other; one that fails does not keep the others from running.

    Raises:
        ReproductionInterrupted: Ctrl-C.
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
                failure = execute(run, logs / f"{run.experiment}-{run.variant}.log", _follower(console, status.update))
        except KeyboardInterrupt as error:
            raise ReproductionInterrupted(
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
