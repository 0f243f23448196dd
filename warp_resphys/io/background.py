"""Runs a stage in a second process of this machine, while this one runs others.

The process is a new interpreter, never a fork, with one thread. It writes its log and its progress to a file, line by
line, which a thread of this process repeats. A second file interrupts it as Ctrl-C does, so that it keeps its
checkpoint; if this process dies, it ends as well.
"""

from __future__ import annotations

import _thread
import json
import logging
import os
import shutil
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from joblib.externals.loky.process_executor import BrokenProcessPool, ProcessPoolExecutor
from threadpoolctl import threadpool_limits
from typing_extensions import override

from .children import begin_worker, interrupts_blocked
from .errors import ResphysError
from .fan_out import WorkerError, WorkerFaultError, begin_work
from .memory import peak_memory_gib
from .progress import print_line, print_to
from .stages import Stage, StageContext, run_stage

log = logging.getLogger(__name__)
_LOOK_SECONDS = 0.05  # interval of looking for new lines, and for the interruption
_PATIENCE = 30.0  # s that an interrupted stage gets to write its checkpoint
_LINES, _STOP = "lines", "stop"  # files
_FOLDER = ".background_"  # first part of the name of a temporary folder in the run folder
_PROGRESS = ""  # name of the logger of lines of progress


class BackgroundProcess:
    """A process that runs one stage at a time, see `stages.Background`; it starts with the stage, and ends with it."""

    def __init__(self) -> None:
        self._running: _Running | None = None

    @property
    def stage(self) -> str | None:
        """Name of the stage that was started and whose result was not asked for; None if there is none."""
        return None if self._running is None else self._running.stage

    def start(self, stage: Stage, context: StageContext) -> None:
        """Starts a stage, whose record has the memory of the larger of both processes."""
        context.memory.count([peak_memory_gib()])
        for left in Path(context.run_dir).glob(f"{_FOLDER}*"):  # of a process that was killed
            shutil.rmtree(left, ignore_errors=True)
        folder = TemporaryDirectory(prefix=_FOLDER, dir=context.run_dir, ignore_cleanup_errors=True)
        ends: Any = {"initializer": begin_worker, "initargs": (os.getpid(),)}
        executor = ProcessPoolExecutor(1, **ends)
        with interrupts_blocked():  # The process leaves Ctrl-C to this one.
            future = executor.submit(_work, stage, context, Path(folder.name))
            self._running = _Running(stage.name, folder, executor, future)
            self._running.thread.start()
        future.add_done_callback(lambda done: _say_failure(stage.name, done))

    def check(self) -> None:
        """Raises the error of the stage, if it has failed.

        Raises:
            WorkerError, WorkerFaultError, OSError: see `result`.
        """
        if self._running is not None and self._running.future.done() and self._running.future.exception() is not None:
            self.result()

    def result(self) -> float:
        """Waits for the stage; returns its duration [s].

        Raises:
            WorkerError: the stage raised a ResphysError, whose message is kept, or its process was killed.
            WorkerFaultError: the stage raised another error.
            OSError: a file could not be written.
        """
        running = self._running
        assert running is not None
        try:
            seconds = running.future.result()
        except BrokenProcessPool as error:
            raise WorkerError(
                f"{running.stage}: its process was killed, perhaps because memory ran out: run the same command again, "
                "with parallel.background=false."
            ) from error
        self._close(running)
        if seconds is None:
            raise WorkerError(f"{running.stage}: its process was interrupted: run the same command again.")
        return seconds

    def stop(self) -> None:
        """Interrupts the stage, if one runs, and waits until it has written its checkpoint."""
        running = self._running
        if running is not None:
            try:
                Path(running.folder.name, _STOP).touch()
                wait([running.future], _PATIENCE)
            finally:
                self._close(running)

    def _close(self, running: _Running) -> None:
        self._running = None
        running.ended.set()
        running.thread.join()
        running.executor.shutdown(wait=False, kill_workers=not running.future.done())
        running.folder.cleanup()


def _say_failure(name: str, future: Future[float | None]) -> None:
    """Logs at once that a stage failed, as its error is raised only after the stage that runs here."""
    if not future.cancelled() and future.exception() is not None:
        log.error("%s failed: the run ends after the stage that is running", name)


class _Running:
    """A stage in its process, and a thread that repeats its lines."""

    def __init__(
        self, stage: str, folder: TemporaryDirectory[str], executor: ProcessPoolExecutor, future: Future[float | None]
    ) -> None:
        self.stage, self.folder, self.executor, self.future = stage, folder, executor, future
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._repeat, name="background", daemon=True)

    def _repeat(self) -> None:
        path, read = Path(self.folder.name, _LINES), 0
        ended = False
        while not ended:
            ended = self.ended.wait(_LOOK_SECONDS)  # One more look after the end.
            content = path.read_bytes()[read:] if path.is_file() else b""
            whole = content[: content.rfind(b"\n") + 1]
            read += len(whole)
            for line in whole.splitlines():
                name, level, message = json.loads(line)
                if name == _PROGRESS:
                    print_line(message)
                else:
                    logging.getLogger(name).log(level, "%s", message)


class _Lines(logging.Handler):
    """Writes records of the log to a file, and lines of progress."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="utf-8", buffering=1)
        super().__init__()

    @override
    def emit(self, record: logging.LogRecord) -> None:
        self._write(record.name, record.levelno, record.getMessage())

    def progress(self, line: str) -> None:
        """Writes a line of progress."""
        self._write(_PROGRESS, logging.INFO, line)

    def _write(self, name: str, level: int, message: str) -> None:
        self._file.write(json.dumps([name, level, message]) + "\n")

    @override
    def close(self) -> None:
        self._file.close()
        super().close()


def _work(stage: Stage, context: StageContext, folder: Path) -> float | None:
    """Runs a stage in the second process; returns its duration [s], None if it was interrupted."""
    lines = _Lines(folder / _LINES)
    logging.basicConfig(level=logging.INFO, handlers=[lines], force=True)
    print_to(lines.progress)
    begin_work()
    try:
        with threadpool_limits(1), _interrupted_by(folder / _STOP):
            return run_stage(stage, context)
    except KeyboardInterrupt:
        return None
    except ResphysError as error:
        raise WorkerError(f"{stage.name}: {error}") from None
    except OSError:
        raise
    except Exception:
        raise WorkerFaultError(f"{stage.name} failed in its process:\n{traceback.format_exc()}") from None
    finally:
        lines.close()


@contextmanager
def _interrupted_by(path: Path) -> Iterator[None]:
    """Raises KeyboardInterrupt in the main thread when a file appears; Ctrl-C itself is left to the parent.

    It is raised again only where it was lost, in a destructor or in the callback of a weak reference.
    """
    ended, due = threading.Event(), threading.Event()
    due.set()

    def interrupt(*_: object) -> None:
        if due.is_set():  # The signal may reach this process itself as well.
            due.clear()
            raise KeyboardInterrupt

    def watch() -> None:
        while not ended.wait(_LOOK_SECONDS):
            if due.is_set() and path.exists():
                _thread.interrupt_main(signal.SIGTERM)

    def unraisable(lost: sys.UnraisableHookArgs) -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            due.set()
        else:
            sys.__unraisablehook__(lost)

    sys.unraisablehook = unraisable
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, interrupt)
    watcher = threading.Thread(target=watch, name="interruption", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()
