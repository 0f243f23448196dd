"""Files of interrupted work, and full disks."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch

from warp_resphys.io import files
from warp_resphys.io.errors import DataFileError
from warp_resphys.io.files import is_final, resume_checkpoint

REPOSITORY = Path(__file__).parents[2]
TENSORS = {"weight": torch.arange(6.0).reshape(2, 3).T}


def start_python(program: str, *arguments: object) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", textwrap.dedent(program), *map(str, arguments)]
    return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


def test_a_finished_file_is_one_of_the_same_settings_that_is_whole(tmp_path):
    path = tmp_path / "forces.h5"
    assert not is_final(path, "forces", "f")
    with files.atomic_hdf5(path, "forces", {"fingerprint": "f"}) as file:
        files.create(file, "force", np.ones((4, 10, 3)), "N")
    assert is_final(path, "forces", "f")
    assert not is_final(path, "forces", "g")
    cut_short(path)
    with pytest.raises(DataFileError, match=r"forces\.h5 is truncated"):
        is_final(path, "forces", "f")


@pytest.mark.slow
class TestDiskFull:
    program = """
        import resource, signal, sys
        from pathlib import Path
        import numpy as np
        import torch
        from warp_resphys.io import files
        from warp_resphys.io.errors import DataFileError

        folder, limit = Path(sys.argv[1]), int(sys.argv[2])
        if limit:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        def checkpoint():
            files.write_checkpoint(folder / "a.safetensors", "k", {"x": torch.ones(8000).double()}, {})

        def hdf5():
            with files.atomic_hdf5(folder / "a.h5", "k", {}) as file:
                files.create(file, "x", np.ones(8000), "m")

        def json():
            files.write_json(folder / "a.json", [0] * 40000)

        for work in (checkpoint, hdf5, json):
            try:
                work()
            except DataFileError as error:
                print(error)
    """

    def test_it_is_reported_and_leaves_no_file(self, tmp_path):
        child = start_python(self.program, tmp_path, 40_000)
        lines, errors = child.communicate(timeout=200)
        assert (child.returncode, errors) == (0, "")
        full = [f"disk is full while writing {tmp_path / name}" for name in ("a.safetensors", "a.h5", "a.json")]
        assert all(line.startswith(start) for line, start in zip(lines.splitlines(), full, strict=True))
        assert not list(tmp_path.iterdir())
        child = start_python(self.program, tmp_path, 0)
        assert child.communicate(timeout=200) == ("", "")
        assert len(list(tmp_path.iterdir())) == 3


class TestCheckpoints:
    def test_checkpoints_of_other_settings_or_cut_short_are_not_used(self, tmp_path, caplog):
        path = tmp_path / "a.safetensors"
        files.write_checkpoint(path, "network", TENSORS, {"fingerprint": "f"})
        assert torch.equal(resume_checkpoint(path, "network", "f")[0]["weight"], TENSORS["weight"])
        assert resume_checkpoint(path, "network", "g") is None
        assert resume_checkpoint(tmp_path / "none", "network", "f") is None
        assert "belongs to other settings" in caplog.text
        cut_short(path)
        assert resume_checkpoint(path, "network", "f") is None
        assert f"{path} is not a complete safetensors file" in caplog.text
