"""Runs the stages of an experiment.

A stage runs again only if its settings, inputs or outputs have changed.

A stage reads and writes files in the run folder. Its record (`stages/<name>.json`) has a
fingerprint of its settings and of those of all stages upstream.
"""

from __future__ import annotations

import hashlib
import json
import logging
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypedDict

from filelock import FileLock, Timeout

from .atomic import digest
from .classes import check_packages
from .errors import DataFileError, InputError
from .fan_out import ALONE, Workers
from .machine import peak_memory_gib
from .parts import Parts
from .progress import one_line
from .safe_files import FORMAT_VERSION, read_json, to_plain, write_json
from .settings import Settings, packages_of

log = logging.getLogger(__name__)

_VALID, _CHANGED = "up to date", "settings changed"  # states of an earlier run
_PLANNED = "stages.json"  # fingerprints and settings of all stages of the last command
_PACKAGES = (
    "warp-resphys",
    "warp-lang",
    "torch",
    "numpy",
    "scipy",
    "cholespy",
    "h5py",
    "hydra-core",
)


@dataclass(frozen=True)
class StageContext:
    """The arguments of a stage's function."""

    name: str  # of the stage
    run_dir: Path  # the run folder, where outputs are written
    fingerprint: str  # identifies everything that the outputs depend on; resumable files contain it
    settings: Any  # of the stage
    upstream: Mapping[str, str] = field(default_factory=dict)  # of stages whose outputs it reads

    def parts(self, workers: Workers = ALONE, batch: int | None = None) -> Parts:
        """Returns the parts of the stage's work, with their files in the run folder."""
        folder = self.run_dir / f"{self.name}_parts"
        return Parts(self.name, workers, folder, self.fingerprint, batch)


@dataclass(frozen=True)
class Stage:
    """A step of an experiment, from files to files."""

    name: str  # also of its record
    function: Callable[[StageContext], None]  # does the work; writes outputs atomically
    outputs: tuple[str, ...]  # paths of the files that it writes, relative to the run folder
    settings: Any  # all that the outputs depend on, and no more: `Settings` or nested plain data
    upstream: tuple[str, ...] = ()  # names of the stages whose outputs it reads


class StageInterrupted(KeyboardInterrupt):
    """Ctrl-C during a stage; the message lists the finished stages."""


def fingerprint(stage: Stage, upstream_fingerprints: Mapping[str, str]) -> str:
    """SHA-256 of everything that a stage's outputs depend on, in hexadecimal."""
    content = {
        "name": stage.name,
        "format_version": FORMAT_VERSION,
        "settings": to_plain(
            stage.settings.content() if isinstance(stage.settings, Settings) else stage.settings
        ),
        "upstream": [upstream_fingerprints[name] for name in stage.upstream],
    }
    packages = packages_of(stage.settings)
    if packages:
        content["packages"] = packages
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def run_stages(
    stages: Sequence[Stage], run_dir: str | Path, wait: bool = False
) -> dict[str, float]:
    """Runs the stages whose outputs are missing, damaged or of other settings.

    Args:
        stages: in the order in which they run; a stage comes after its upstream stages.
        run_dir: the run folder, created if missing; one process at a time may use it.
        wait: whether to wait for another process that uses it, instead of raising.

    Returns:
        The duration of each stage, summed over interrupted runs [s].

    Raises:
        InputError: another process uses the run folder.
        DataFileError: a file cannot be read or written.
        StageInterrupted: the user pressed Ctrl-C; finished work is kept.
    """
    seconds: dict[str, float] = {}
    with run_lock(run_dir, wait):
        _plan([*_contexts(stages, Path(run_dir))], Path(run_dir) / _PLANNED)
        for stage, context in _contexts(stages, Path(run_dir)):
            try:
                took, state = _earlier(stage, context)
                if state not in ("", _VALID, _CHANGED):
                    log.warning("%s: %s", stage.name, state)
                seconds[stage.name] = _run_stage(stage, context) if took is None else took
            except KeyboardInterrupt as error:
                kept = f"finished and kept: {', '.join(seconds)}; " if seconds else ""
                raise StageInterrupted(
                    f"interrupted in stage '{stage.name}' ({kept}what '{stage.name}' has saved "
                    "is kept, too); the same command resumes there"
                ) from error
    return seconds


def _plan(stages: Sequence[tuple[Stage, StageContext]], path: Path) -> None:
    """Adds fingerprints and settings of stages to a file, unless it has them."""
    before = dict[str, Any]()
    with suppress(DataFileError):
        before = read_json(path) if path.is_file() else {}
    planned = {
        stage.name: {"fingerprint": context.fingerprint, "settings": to_plain(stage.settings)}
        for stage, context in stages
    }
    if before != before | planned:
        write_json(path, before | planned)


def unfinished(stages: Sequence[Stage], run_dir: str | Path) -> list[Stage]:
    """Returns the stages that `run_stages` would run."""
    return [
        stage
        for stage, context in _contexts(stages, Path(run_dir))
        if _earlier(stage, context)[0] is None
    ]


def expected_seconds(stages: Sequence[Stage], run_dir: str | Path) -> dict[str, float]:
    """Returns how long stages took that did the same before, by name [s].

    These are stages of one name on the same body, the same data and the same budget, in this folder
    and in those beside it, of which the last one counts.
    """
    took = dict[str, float]()
    for stage in stages:
        last = ""
        for path in Path(run_dir).parent.glob(f"*/stages/{stage.name}.json"):
            with suppress(DataFileError, KeyError):  # A damaged record counts for nothing.
                record = read_json(path)
                alike = _works_on(record["settings"]) == _works_on(to_plain(stage.settings))
                if alike and record["finished"] > last:
                    last = record["finished"]
                    took[stage.name] = float(record["seconds"])
    return took


def _works_on(settings: Mapping[str, Any]) -> list[Any]:
    """Returns the settings on which the duration of a stage depends most."""
    return [settings.get(key) for key in ("mesh", "data", "budget", "time_step")]


def _contexts(stages: Sequence[Stage], run_dir: Path) -> Iterator[tuple[Stage, StageContext]]:
    """Yields stages with their contexts."""
    fingerprints: dict[str, str] = {}
    for stage in stages:
        if stage.name in fingerprints or not fingerprints.keys() >= set(stage.upstream):
            raise ValueError(
                f"stage '{stage.name}' occurs twice, or comes before a stage whose outputs it reads"
            )
        fingerprints[stage.name] = fingerprint(stage, fingerprints)
        upstream = {name: fingerprints[name] for name in stage.upstream}
        yield (
            stage,
            StageContext(
                stage.name, run_dir, fingerprints[stage.name], stage.settings, upstream=upstream
            ),
        )


def _record(run_dir: Path, name: str) -> Path:
    return run_dir / "stages" / f"{name}.json"


def _run_stage(stage: Stage, context: StageContext) -> float:
    """Runs one stage and writes its record.

    Returns its duration, including interrupted runs [s].
    """
    interrupted = _record(context.run_dir, stage.name).with_suffix(".interrupted.json")
    before = read_json(interrupted) if interrupted.is_file() else {}
    seconds = float(before["seconds"]) if before.get("fingerprint") == context.fingerprint else 0.0
    start = time.perf_counter() - seconds
    try:
        with one_line(stage.name) as line:
            stage.function(context)
            seconds = time.perf_counter() - start
            _write_record(stage, context, seconds)
            log.info("%s", line(seconds))
    except (Exception, KeyboardInterrupt):
        with suppress(DataFileError):  # A full disk must not hide the error itself.
            write_json(
                interrupted,
                {"fingerprint": context.fingerprint, "seconds": time.perf_counter() - start},
            )
        raise
    interrupted.unlink(missing_ok=True)
    return seconds


def _write_record(stage: Stage, context: StageContext, seconds: float) -> None:
    from .machine import made_on  # imports torch

    write_json(
        _record(context.run_dir, stage.name),
        {
            "fingerprint": context.fingerprint,
            "upstream": dict(context.upstream),
            "seconds": seconds,
            "peak_memory_gib": peak_memory_gib(),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "outputs": {name: _identity(context.run_dir / name) for name in stage.outputs},
            "settings": to_plain(stage.settings),
            "versions": package_versions(),
            "packages": packages_of(stage.settings),
            "machine": made_on(),
        },
    )


def planned(run_dir: str | Path, name: str) -> dict[str, Any]:
    """Returns ``fingerprint`` and ``settings`` of a stage in the last command that had it.

    Empty if there was none.
    """
    path = Path(run_dir) / _PLANNED
    stages: dict[str, Any] = read_json(path) if path.is_file() else {}
    return stages.get(name, {})


def finished_record(run_dir: str | Path, name: str) -> dict[str, Any]:
    """Returns the record of a finished stage, with its ``settings``,
    after checking all files that it depends on.

    Raises:
        DataFileError: there is no such folder, the stage is unfinished, was run by another version
            of this program, or with a package that is not installed, or an output of it or of a
            stage upstream is missing or has changed.
    """
    folder = Path(run_dir)
    if not (folder / "stages").is_dir():
        raise DataFileError(
            f"{folder} is not a run folder: name one that `warp-resphys` has written."
        )
    again = "run its command again"
    path = _record(folder, name)
    if not path.is_file():
        raise DataFileError(
            f"{folder} is unfinished: its stage '{name}' was not completed; {again}."
        )
    record: dict[str, Any] = read_json(path)
    made, here = (
        versions.get("warp-resphys", "an unknown version")
        for versions in (record["versions"], package_versions())
    )
    if made.split(".")[:2] != here.split(".")[:2]:
        raise DataFileError(
            f"{folder} was written by warp-resphys {made}, and this is {here}: {again} in "
            "another run folder, or use the version that wrote it."
        )
    check_packages(record.get("packages", {}), folder)
    for output, identity in record["outputs"].items():
        if not _is_same(folder / output, identity):
            raise DataFileError(
                f"{folder / output} is missing or has changed since it was written: {again}."
            )
    for earlier, expected in record.get("upstream", {}).items():
        if finished_record(folder, earlier)["fingerprint"] != expected:
            raise DataFileError(
                f"{folder} is unfinished: its stage '{earlier}' was run again after '{name}'; "
                f"{again}."
            )
    return record


class Resources(TypedDict):
    """Resources that the stages of a run used."""

    seconds: dict[str, float]  # by stage
    peak_memory_gib: float | None  # largest of the stages


def resources_used(run_dir: str | Path, names: Sequence[str]) -> Resources:
    """Returns durations [s] and the largest peak of memory [GiB]
    of finished stages, for `metrics.json`.
    """
    paths = {name: _record(Path(run_dir), name) for name in names}
    records = {name: read_json(path) for name, path in paths.items() if path.is_file()}
    return {
        "seconds": {name: record["seconds"] for name, record in records.items()},
        "peak_memory_gib": max(
            (record["peak_memory_gib"] for record in records.values()), default=None
        ),
    }


def _identity(path: Path) -> dict[str, Any]:
    """Size, modification time and digest, which identify the content of a file."""
    status = path.stat()
    return {"bytes": status.st_size, "modified_ns": status.st_mtime_ns, "sha256": digest(path)}


def _earlier(stage: Stage, context: StageContext) -> tuple[float | None, str]:
    """The duration of an earlier run whose outputs are still valid, or None.

    And its state in words.
    """
    path = _record(context.run_dir, stage.name)
    if not path.is_file():
        return None, ""
    try:
        record = read_json(path)
        if record["fingerprint"] != context.fingerprint:
            return None, _CHANGED
        changed = [
            name
            for name in stage.outputs
            if not _is_same(context.run_dir / name, record["outputs"][name])
        ]
        if changed:
            return None, f"missing or changed since they were written: {', '.join(changed)}"
        return float(record["seconds"]), _VALID
    except (DataFileError, KeyError, TypeError, ValueError) as error:
        return None, f"its record cannot be used ({type(error).__name__}: {error})"


def _is_same(path: Path, identity: Mapping[str, Any]) -> bool:
    """Compares a file with its identity.

    Its content is read only if the times differ, as they do after copying.
    """
    if not path.is_file() or path.stat().st_size != identity["bytes"]:
        return False
    return bool(
        path.stat().st_mtime_ns == identity["modified_ns"] or digest(path) == identity["sha256"]
    )


@contextmanager
def run_lock(run_dir: str | Path, wait: bool = False) -> Iterator[None]:
    """Locks a run folder; the operating system releases the lock when the process ends.

    Args:
        run_dir: the run folder, created if missing.
        wait: whether to wait for another process that has locked it, instead of raising.

    Raises:
        InputError: another process has locked it.
        DataFileError: the folder cannot be created, or its file system has no locks.
    """
    path = Path(run_dir) / ".lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("a").close()
    except OSError as error:
        raise DataFileError(
            f"cannot write the run folder {run_dir} ({error.strerror}): make it writable or "
            "choose another one"
        ) from error
    lock = FileLock(path)
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        if not wait:
            raise InputError(
                f"another process is writing the run folder {run_dir}: "
                "wait for it or choose another one"
            ) from error
        log.info("waiting for another process that is writing the run folder %s", run_dir)
        lock.acquire()
    except (OSError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or error
        raise DataFileError(
            f"cannot lock the run folder {run_dir} ({reason}): choose one on another disk"
        ) from error
    try:
        yield
    finally:
        lock.release()


@cache
def package_versions() -> Mapping[str, str]:
    """Versions of Python and of the packages that results depend on.

    Absent packages are left out.
    """
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions
