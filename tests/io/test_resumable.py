"""Work that resumes after an interruption, a crash or a full disk."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch

from warp_resphys.io import files
from warp_resphys.io.errors import DataFileError
from warp_resphys.io.resumable import (
    Field,
    ResumableHDF5,
    is_final,
    resume_checkpoint,
)

REPOSITORY = Path(__file__).parents[2]
FIELDS = {"force": Field((4, 3), "N", batch_axes=1), "iterations": Field((), "1", "int64")}
TENSORS = {"weight": torch.arange(6.0).reshape(2, 3).T}


def start_python(program: str, *arguments: object) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", textwrap.dedent(program), *map(str, arguments)]
    return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def force(frame: int) -> np.ndarray:
    return np.full((4, 3), 1.0 + frame) + np.arange(12).reshape(4, 3)


def resumable(path: Path, fingerprint: str = "f", frames: int = 10) -> ResumableHDF5:
    return ResumableHDF5(path, "forces", fingerprint, frames, FIELDS)


def compute(path: Path, upto: int, *arguments: object, finish: bool = True) -> list[int]:
    """Computes frames from the number of the last one, which is the state; returns the computed ones."""
    computed = []
    with resumable(path, *arguments) as file:
        while file.done < upto:
            frame = int(file.state["last"]) + 1 if file.done else 0
            file.append({"last": torch.tensor(frame)}, force=force(frame), iterations=frame)
            computed.append(frame)
        if finish:
            file.finish({"rest": (np.ones(3), "m")})
    return computed


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


def checkpoints(path: Path) -> list[Path]:
    return sorted(path.parent.glob("*.safetensors"))


class TestResumable:
    def test_it_resumes_and_ends_in_a_plain_hdf5_file(self, tmp_path):
        path = tmp_path / "run" / "forces.h5"
        assert compute(path, 4, finish=False) == [0, 1, 2, 3]
        assert compute(path, 6, finish=False) == [4, 5]
        assert not is_final(path, "forces", "f")
        assert compute(path, 10) == [6, 7, 8, 9]
        assert is_final(path, "forces", "f")
        assert not is_final(path, "forces", "g")
        assert os.listdir(path.parent) == ["forces.h5"]
        with files.read_hdf5(path, "forces") as file:
            assert np.array_equal(files.read_array(file, "force"), np.stack([force(frame) for frame in range(10)], 1))
            assert files.read_array(file, "iterations").tolist() == list(range(10))
            assert (file["force"].attrs["units"], file["rest"].attrs["units"]) == ("N", "m")

    def test_ctrl_c_loses_nothing(self, tmp_path):
        def compute_three(file: ResumableHDF5) -> None:
            for frame in range(3):
                file.append({"last": torch.tensor(frame)}, force=force(frame), iterations=frame)
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt), resumable(tmp_path / "a.h5") as file:
            compute_three(file)
        assert compute(tmp_path / "a.h5", 10) == list(range(3, 10))

    def test_other_settings_start_afresh_and_keep_the_old_file_until_the_end(self, tmp_path, caplog):
        path = tmp_path / "forces.h5"
        compute(path, 10)
        assert len(compute(path, 9, "g", finish=False)) == 9
        assert is_final(path, "forces", "f")
        assert len(compute(path, 1, "h", finish=False)) == 1
        assert "belongs to other settings" in caplog.text
        assert len(compute(path, 11, "h", 11)) == 11

    @pytest.mark.parametrize("damaged", [0, 1, 2])
    def test_frames_of_a_damaged_checkpoint_and_later_ones_are_computed_again(self, tmp_path, damaged):
        path = tmp_path / "forces.h5"
        for upto in (3, 5, 8):
            compute(path, upto, finish=False)
        last = (0, 1, 3)[damaged]  # Checkpoints are written after the first frame, and at the end of a run.
        cut_short(checkpoints(path)[damaged])
        assert compute(path, 10) == list(range(last, 10))
        with files.read_hdf5(path, "forces") as file:
            assert np.array_equal(files.read_array(file, "force")[:, 5], force(5))

    def test_a_damaged_file_is_an_error(self, tmp_path):
        compute(tmp_path / "forces.h5", 10)
        cut_short(tmp_path / "forces.h5")
        with pytest.raises(DataFileError, match=r"forces\.h5 is truncated"):
            is_final(tmp_path / "forces.h5", "forces", "f")

    def test_misuse(self, tmp_path):
        with resumable(tmp_path / "a.h5") as file:
            with pytest.raises(ValueError, match=r"shape \(3,\) where \(4, 3\)"):
                file.append({}, force=np.zeros(3), iterations=1)
            with pytest.raises(ValueError, match="0 of 10 frames"):
                file.finish()

    @pytest.mark.slow
    @pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
    def test_a_killed_process_resumes_from_a_whole_frame(self, tmp_path, end):
        program = """
            import signal, sys, numpy as np, torch
            from pathlib import Path
            from warp_resphys.io import resumable
            signal.signal(signal.SIGINT, signal.default_int_handler)
            resumable.KEEP_SECONDS = 0.01
            fields = {"x": resumable.Field((500,), "m")}
            with resumable.ResumableHDF5(Path(sys.argv[1]), "k", "f", 10_000, fields) as file:
                print(file.done, flush=True)
                while file.done < file.frames:
                    last = int(file.state["last"]) if file.done else -1
                    file.append({"last": torch.tensor(last + 1)}, x=np.full(500, last + 1))
                    print(file.done, flush=True)
        """
        path, last = tmp_path / "a.h5", 0
        for _ in range(2):
            child = start_python(program, path)
            first = int(child.stdout.readline())
            assert first >= last if end == signal.SIGINT else first > 0 or last == 0
            while len(checkpoints(path)) < 3 or last < first + 20:
                last = int(child.stdout.readline())
            child.send_signal(end)
            last = max([last, *map(int, child.stdout.read().split("\n")[:-1])])
            child.wait(timeout=20)
            assert child.returncode in (-end, 130)
        fields = {"x": Field((500,), "m")}
        with ResumableHDF5(path, "k", "f", 10_000, fields) as file:
            assert 0 < file.done <= last + 1
            assert int(file.state["last"]) == file.done - 1


@pytest.mark.slow
class TestDiskFull:
    program = """
        import resource, signal, sys
        from pathlib import Path
        import numpy as np
        from warp_resphys.io import files
        from warp_resphys.io.errors import DataFileError
        from warp_resphys.io.resumable import Field, ResumableHDF5

        folder, limit = Path(sys.argv[1]), int(sys.argv[2])
        if limit:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        def frames(name, count, numbers):
            with ResumableHDF5(folder / name, "k", "f", count, {"x": Field((numbers,), "m")}) as file:
                print("done", file.done)
                while file.done < count:
                    file.append({}, x=np.full(numbers, file.done))
                file.finish(constants={"c": (np.zeros(5000), "m")})

        def json():
            files.write_json(folder / "a.json", [0] * 40000)

        for work in (lambda: frames("first.h5", 2, 6000), lambda: frames("last.h5", 3, 100), json):
            try:
                work()
            except DataFileError as error:
                print(error)
    """

    def test_it_is_reported_and_no_work_is_lost(self, tmp_path):
        child = start_python(self.program, tmp_path, 40_000)
        lines, errors = child.communicate(timeout=200)
        assert (child.returncode, errors) == (0, "")
        full = [f"disk is full while writing {tmp_path / name}" for name in ("first.frames", "last.h5", "a.json")]
        lines = lines.splitlines()
        assert [lines[0], lines[2]] == ["done 0", "done 0"]
        assert all(line.startswith(start) for line, start in zip([lines[1], *lines[3:]], full, strict=True))
        assert {path.name.partition(".")[0] for path in tmp_path.iterdir()} == {"last"}
        child = start_python(self.program, tmp_path, 0)
        lines, errors = child.communicate(timeout=200)
        assert (child.returncode, errors, lines.splitlines()) == (0, "", ["done 0", "done 3"])
        with files.read_hdf5(tmp_path / "last.h5", "k") as file:
            assert np.array_equal(file["x"][:, 0], np.arange(3))


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
