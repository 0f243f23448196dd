"""Files that are written step by step: they go on after an interruption, a crash or a full disk."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from warp_resphys.io import files
from warp_resphys.io.errors import DataFileError
from warp_resphys.io.resumable import Field, ResumableHDF5

REPOSITORY = Path(__file__).parents[2]


def start_python(program: str, *arguments: object, **options: object) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", textwrap.dedent(program), *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, env=environment, text=True, **{**pipes, **options})


FIELDS = {"force": Field((4, 3), "N"), "iterations": Field((), "1", "int64")}


def force(step: int) -> np.ndarray:
    return np.full((4, 3), 1.0 + step) + np.arange(12).reshape(4, 3)


def resumable(path: Path, fingerprint: str = "f", steps: int = 10) -> ResumableHDF5:
    return ResumableHDF5(path, "forces", fingerprint, steps, FIELDS)


def write(file: ResumableHDF5, upto: int) -> None:
    for step in range(file.done, upto):
        file.append(force=force(step), iterations=step)


def write_and_stop(file: ResumableHDF5, upto: int) -> None:
    write(file, upto)
    raise KeyboardInterrupt


class TestResumable:
    def test_goes_on_where_it_stopped_and_ends_in_a_plain_hdf5_file(self, tmp_path):
        path = tmp_path / "run" / "forces.h5"
        with pytest.raises(KeyboardInterrupt), resumable(path) as file:
            write_and_stop(file, 4)
        assert not path.exists()
        with resumable(path) as file:
            assert file.done == 4
            assert np.array_equal(file.read(3)["force"], force(3))
            write(file, 10)
            file.finish({"solver": "newton"}, {"rest": (np.ones(3), "m")})
        assert os.listdir(path.parent) == ["forces.h5"]
        with files.read_hdf5(path, "forces") as h5:
            assert np.array_equal(files.read_array(h5, "force"), [force(step) for step in range(10)])
            assert files.read_array(h5, "iterations").tolist() == list(range(10))
            assert (h5["force"].attrs["units"], h5["rest"].attrs["units"]) == ("N", "m")
            assert h5.attrs["solver"] == "newton"

    def test_steps_in_any_order_find_their_places(self, tmp_path):
        path, order = tmp_path / "forces.h5", [3, 0, 2, 1]
        with resumable(path, steps=4) as file:
            for step in order:
                file.append(force=force(step), iterations=step)
            for wrong in ([0, 1, 2, 2], [0, 1, 2], [1, 2, 3, 4]):
                with pytest.raises(ValueError, match="each step has a place of its own"):
                    file.finish(order=wrong)
            file.finish(order=order)
        with files.read_hdf5(path, "forces") as h5:
            assert files.read_array(h5, "iterations").tolist() == [0, 1, 2, 3]
            assert np.array_equal(files.read_array(h5, "force")[3], force(3))

    def test_a_finished_file_is_not_computed_again(self, tmp_path):
        path = tmp_path / "forces.h5"
        with resumable(path) as file:
            write(file, 10)
            file.finish()
        identity = path.stat().st_mtime_ns
        with resumable(path) as file:
            assert file.done == 10
            assert np.array_equal(file.read(7)["force"], force(7))
            file.finish()
        assert path.stat().st_mtime_ns == identity
        content = bytearray(path.read_bytes())
        content[content.index(force(7).tobytes())] ^= 1
        path.write_bytes(content)
        with pytest.raises(DataFileError, match=r"forces\.h5 is damaged"), resumable(path):
            pass
        assert path.read_bytes() == content

    def test_other_inputs_start_afresh_and_keep_the_old_file_until_the_end(self, tmp_path, caplog):
        path = tmp_path / "forces.h5"
        with resumable(path) as file:
            write(file, 10)
            file.finish()
        with resumable(path, "g") as file:
            write(file, 9)
        with files.read_hdf5(path, "forces") as h5:
            assert h5.attrs["fingerprint"] == "f"
        with resumable(path, "h") as file:
            assert file.done == 0
            assert "discarding forces.h5.journal" in caplog.text
        with resumable(path, "h", steps=11) as file:
            assert file.done == 0

    def test_batches(self, tmp_path):
        fields = {"q": Field((3, 2), "m", batch_axes=1), "loss": Field((), "1")}
        with ResumableHDF5(tmp_path / "a.h5", "k", "f", 100, fields) as file:
            for step in range(100):
                file.append(q=10 * step + np.arange(6).reshape(3, 2), loss=step)
            assert file.read(2)["q"].shape == (3, 2)
            file.finish()
            assert np.array_equal(file.read(2)["q"], 20 + np.arange(6).reshape(3, 2))
        with files.read_hdf5(tmp_path / "a.h5", "k") as h5:
            assert h5["q"].chunks == (1, 64, 2)
            assert h5["q"].shape == (3, 100, 2)
            assert np.array_equal(h5["q"][1, 7], [72, 73])

    @pytest.mark.parametrize("damage", ["cut record", "cut header", "flipped bit", "zeros"])
    def test_records_that_did_not_reach_the_disk_are_computed_again(self, tmp_path, damage):
        path = tmp_path / "forces.h5"
        with resumable(path) as file:
            write(file, 8)
        content = bytearray(file.journal.read_bytes())
        record = content.index(force(5).tobytes())
        if damage == "cut record":
            del content[record + 20 :]
        elif damage == "cut header":
            del content[20:]
        elif damage == "flipped bit":
            content[record + 20] ^= 1
        else:
            content[record:] = bytes(len(content) - record)
        file.journal.write_bytes(content)
        with resumable(path) as file:
            assert file.done == (0 if damage == "cut header" else 5)
            write(file, 10)
            file.finish()
            assert np.array_equal(file.read(5)["force"], force(5))

    def test_the_system_may_write_less_than_it_was_given(self, tmp_path, monkeypatch):
        pwrite = os.pwrite
        monkeypatch.setattr(os, "pwrite", lambda file, data, offset: pwrite(file, data[:7], offset))
        with resumable(tmp_path / "a.h5") as file:
            write(file, 3)
        with resumable(tmp_path / "a.h5") as file:
            assert file.done == 3

    def test_misuse(self, tmp_path):
        with resumable(tmp_path / "a.h5") as file:
            with pytest.raises(ValueError, match="consists of"):
                file.append(force=force(0))
            with pytest.raises(ValueError, match=r"shape \(3,\) where \(4, 3\)"):
                file.append(force=np.zeros(3), iterations=1)
            with pytest.raises(ValueError, match="0 of 10 steps"):
                file.finish()
            with pytest.raises(ValueError, match="not among the 0"):
                file.read(0)
            write(file, 10)
            with pytest.raises(ValueError, match="no further step"):
                file.append(force=force(0), iterations=1)

    @pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
    def test_a_killed_process_loses_the_current_step_at_most(self, tmp_path, end):
        program = """
            import signal, sys, numpy as np
            from warp_resphys.io.resumable import Field, ResumableHDF5
            signal.signal(signal.SIGINT, signal.default_int_handler)
            steps = 1_000_000
            with ResumableHDF5(sys.argv[1], "k", "f", steps, {"x": Field((5000,), "m")}) as file:
                print("resumed", file.done, flush=True)
                for step in range(file.done, steps):
                    file.append(x=np.full(5000, step))
                    print(file.done, flush=True)
        """
        path = tmp_path / "a.h5"
        last = 0
        for round_ in range(2):
            child = start_python(program, path)
            resumed = int(child.stdout.readline().split()[1])
            # the record that the signal cut off may have been whole already
            assert last <= resumed <= last + 1
            for _ in range(40 + 13 * round_):
                last = int(child.stdout.readline())
            child.send_signal(end)
            rest = child.stdout.read().split("\n")
            last = max([last, *map(int, rest[:-1])])
            child.wait(timeout=20)
            assert child.returncode in (-end, 130)
        with ResumableHDF5(path, "k", "f", 1_000_000, {"x": Field((5000,), "m")}) as file:
            assert last <= file.done <= last + 1
            assert last > 90
            assert all(np.all(file.read(step)["x"] == step) for step in range(file.done))


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

        def hdf5():
            with files.atomic_hdf5(folder / "data.h5", "k") as file:
                for name in "abc":
                    files.create(file, name, np.zeros((640, 100)))

        def journal():
            with ResumableHDF5(folder / "long.h5", "k", "f", 100, {"x": Field((100,), "m")}) as file:
                print("resumed", file.done)
                for step in range(file.done, file.steps):
                    file.append(x=np.full(100, step))
                file.finish()

        def final():
            with ResumableHDF5(folder / "last.h5", "k", "f", 45, {"x": Field((100,), "m")}) as file:
                print("resumed", file.done)
                for step in range(file.done, file.steps):
                    file.append(x=np.full(100, step))
                file.finish(constants={"c": (np.zeros(1000), "m")})

        for function in (hdf5, journal, final, lambda: files.write_json(folder / "a.json", [0] * 40000)):
            try:
                function()
            except DataFileError as error:
                print(error)
    """

    def test_clear_sentence_no_half_file_and_the_work_is_kept(self, tmp_path):
        child = start_python(self.program, tmp_path, 40_000)
        lines, errors = child.communicate(timeout=30)
        assert (child.returncode, errors) == (0, "")
        again = ": free some space and run the same command again"
        journals = [tmp_path / "long.h5.journal", tmp_path / "last.h5.journal"]
        kept = "; what was computed is kept in"
        assert lines.splitlines() == [
            f"disk is full while writing {tmp_path / 'data.h5'}{again}",
            "resumed 0",
            f"disk is full while writing {journals[0]}{again}{kept} {journals[0]}",
            "resumed 0",
            f"disk is full while writing {tmp_path / 'last.h5'}{again}{kept} {journals[1]}",
            f"disk is full while writing {tmp_path / 'a.json'}{again}",
        ]
        assert sorted(tmp_path.iterdir()) == sorted(journals)
        child = start_python(self.program, tmp_path, 0)
        lines, errors = child.communicate(timeout=30)
        assert (child.returncode, errors) == (0, "")
        assert lines.splitlines() == ["resumed 49", "resumed 45"]
        with files.read_hdf5(tmp_path / "long.h5", "k") as file:
            assert np.array_equal(file["x"][:, 0], np.arange(100))
