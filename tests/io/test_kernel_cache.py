"""Warp's cache of compiled kernels if it is not writable, as in many containers."""

import errno
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import warp as wp

from warp_resphys.io.errors import InputError
from warp_resphys.io.kernel_cache import ensure_kernel_cache

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
        [sys.executable, program], env=environment, cwd=tmp_path, capture_output=True, text=True, check=False
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
