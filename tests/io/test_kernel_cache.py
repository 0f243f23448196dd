"""Warp's cache of compiled kernels if it is not writable, as in many containers."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

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


READ_ONLY = """
import errno, os, sys, tempfile
from pathlib import Path
import warp as wp
from warp_resphys.io.kernel_cache import ensure_kernel_cache

def refuse(*_, **__):
    raise OSError(errno.EROFS, os.strerror(errno.EROFS))

tempfile.TemporaryFile, tempfile.tempdir = refuse, sys.argv[1]
kernels = Path(os.environ["WARP_CACHE_PATH"], wp.config.version, "wp_warp_resphys.float64_0")
kernels.mkdir(parents=True)
(kernels / "kernels.o").write_text("compiled")
ensure_kernel_cache()
assert os.environ["WARP_CACHE_PATH"] == wp.config.kernel_cache_dir
print(Path(wp.config.kernel_cache_dir, wp.config.version, kernels.name, "kernels.o").read_text())
"""


def in_a_read_only_cache(tmp_path, temporary):
    """Output and errors of a process in whose cache no file can be made."""
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache")}
    command = [sys.executable, "-c", READ_ONLY, str(temporary)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return done.stdout, done.stderr


def test_kernels_of_a_cache_that_can_only_be_read_are_used(tmp_path):
    out, err = in_a_read_only_cache(tmp_path, tmp_path)
    assert out == "compiled\n"
    assert "Read-only file system" in err


def test_without_any_writable_folder_it_is_an_error(tmp_path):
    assert "InputError: Warp's cache" in in_a_read_only_cache(tmp_path, tmp_path / "nowhere")[1]
