"""The machine, imports, and Warp's cache where it is not writable; Windows and macOS, imitated."""

import errno
import gc
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import warp as wp

from warp_resphys.io import atomic, fan_out, machine
from warp_resphys.io.errors import InputError
from warp_resphys.io.kernel_cache import ensure_kernel_cache
from warp_resphys.io.machine import available_cores, commit, hardware
from warp_resphys.io.process import collector_paused

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
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
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
@pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity"), reason="cores cannot be chosen on this system"
)
def test_cores_are_those_that_the_process_may_use():
    core = min(os.sched_getaffinity(0))
    program = (
        "from warp_resphys.io import machine; print(machine.available_cores(), "
        "machine.hardware()['cores used'])"
    )
    command = [sys.executable, "-c", f"import os; os.sched_setaffinity(0, [{core}]); {program}"]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert out == f"1 1 of {os.cpu_count()}\n"


def test_the_commit_is_that_of_the_repository():
    head = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert (
        commit() is None
        if head.returncode
        else head.stdout.startswith(str(commit()).partition(" ")[0])
    )


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


PROGRAM = """
import subprocess, sys
import warp as wp
from warp_resphys import Simulator

@wp.kernel
def double(x: wp.array[float]):
    x[wp.tid()] = 2.0 * x[wp.tid()]

x = wp.ones(3, dtype=float, device="cpu")
wp.launch(double, dim=3, inputs=[x], device="cpu")
print(x.numpy().tolist(), wp.config.kernel_cache_dir)
if len(sys.argv) == 1:
    subprocess.run([sys.executable, __file__, "child"], check=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["HOME", "WARP_CACHE_PATH"])
def test_a_cache_that_cannot_be_made_is_a_temporary_one(name, tmp_path):
    """No folder can be created below a regular file, not even by root."""
    (tmp_path / "file").touch()
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    own = {k: v for k, v in os.environ.items() if k not in ("XDG_CACHE_HOME", "WARP_CACHE_PATH")}
    environment = own | {name: str(tmp_path / "file" / "below")}
    run = subprocess.run(
        [sys.executable, program],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    results = [line for line in run.stdout.splitlines() if line.startswith("[2.0, 2.0, 2.0] ")]
    assert len(results) == 2
    (folder,) = {line.rpartition(" ")[2] for line in results}
    assert Path(folder).is_relative_to(tempfile.gettempdir())
    assert not Path(folder).exists()
    warnings = [line for line in run.stderr.splitlines() if line.startswith("warning: ")]
    assert len(warnings) == 1
    assert f"Warp's cache {tmp_path / 'file' / 'below'}" in warnings[0]
    assert "set WARP_CACHE_PATH" in warnings[0]
    assert "Traceback" not in run.stderr


@pytest.fixture
def read_only(tmp_path, monkeypatch):
    """A cache with a kernel, in which no file can be made; a folder for temporary files."""

    def refuse(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "cache"))
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "cache"))
    kernels = tmp_path / "cache" / wp.config.version / "wp_warp_resphys.float64_0"
    kernels.mkdir(parents=True)
    (kernels / "kernels.o").write_text("compiled")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return kernels


def test_kernels_of_a_cache_that_can_only_be_read_are_used(read_only, capsys):
    ensure_kernel_cache()
    folder = Path(wp.config.kernel_cache_dir)
    assert os.environ["WARP_CACHE_PATH"] == str(folder) != str(read_only.parents[1])
    assert (folder / wp.config.version / read_only.name / "kernels.o").read_text() == "compiled"
    assert "Read-only file system" in capsys.readouterr().err


def test_without_any_writable_folder_it_is_an_error(read_only, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(read_only / "nowhere"))
    with pytest.raises(InputError, match="Warp's cache"):
        ensure_kernel_cache()
