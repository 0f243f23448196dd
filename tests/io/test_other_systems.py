"""The machine and how modules are imported on it; Windows and macOS, imitated: what Linux has alone is missing."""

import gc
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from warp_resphys.io import atomic, fan_out, machine
from warp_resphys.io.imports import collector_paused
from warp_resphys.io.machine import available_cores, commit, hardware

REPOSITORY = Path(__file__).parents[2]
UNIX_ALONE = ("fcntl", "resource", "pwd", "grp", "termios")


@pytest.mark.slow
def test_the_package_imports_without_the_modules_of_unix():
    names = ["atomic", "decoding", "fan_out", "kernel_cache", "machine", "resuming", "safe_files"]
    program = f"""
import sys
import filelock
sys.modules.update(dict.fromkeys({UNIX_ALONE}))
import importlib
for name in {names}:
    importlib.import_module("warp_resphys.io." + name)
from warp_resphys.io.machine import available_memory_gib, peak_memory_gib
print(available_memory_gib() > 0.0, peak_memory_gib() >= 0.0)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.stdout == "True True\n", done.stderr


def test_memory_is_not_known_without_a_system_that_tells_it(monkeypatch):
    monkeypatch.setattr(machine, "_kibibytes", lambda path, key: [])
    assert machine.peak_memory_gib() > 0.01  # by getrusage, as on macOS
    monkeypatch.setattr(machine, "resource", None)
    assert machine.peak_memory_gib() == 0.0


def test_cores_and_processor_without_linux(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr("warp_resphys.io.machine._CPU_INFO", Path("missing"))
    assert available_cores() == os.cpu_count()
    assert hardware()["processor"]


def test_files_are_written_where_folders_cannot_be_synchronised(tmp_path, monkeypatch):
    opened = []
    real = os.open

    def refusing(path, flags, *more):
        if os.path.isdir(path):
            raise PermissionError(13, "Permission denied", str(path))
        opened.append(flags)
        return real(path, flags, *more)

    monkeypatch.setattr(atomic.os, "open", refusing)
    monkeypatch.setattr(atomic.os, "name", "nt")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "file").write_text("content")
    atomic._sync(folder / "file")
    atomic._sync(folder)
    assert opened == [os.O_RDWR]


def test_workers_start_where_signals_cannot_be_blocked(monkeypatch):
    monkeypatch.delattr(signal, "pthread_sigmask", raising=False)
    with fan_out.interrupts_blocked():
        pass


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be chosen on this system")
def test_cores_are_those_that_the_process_may_use():
    core = min(os.sched_getaffinity(0))
    program = "from warp_resphys.io import machine; print(machine.available_cores(), machine.hardware()['cores used'])"
    command = [sys.executable, "-c", f"import os; os.sched_setaffinity(0, [{core}]); {program}"]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert out == f"1 1 of {os.cpu_count()}\n"


def test_the_commit_is_that_of_the_repository():
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert commit() is None if head.returncode else head.stdout.startswith(str(commit()).partition(" ")[0])


@pytest.mark.parametrize("error", [None, ImportError])
def test_nothing_is_collected_meanwhile_and_what_was_made_is_not_searched(error):
    gc.unfreeze()
    with pytest.raises(error) if error else collector_paused(), collector_paused():
        assert not gc.isenabled()
        made = [[] for _ in range(10)]
        if error:
            raise error
    assert gc.isenabled()
    assert not {id(x) for x in gc.get_objects()} & {id(x) for x in made}
    gc.unfreeze()
