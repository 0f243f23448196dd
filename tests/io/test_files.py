import errno
import json
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from support.refusals import refuses
from warp_resphys.io import atomic, safe_files
from warp_resphys.io.errors import DataFileError

POSITIONS = np.linspace(0.0, 1.0, 130 * 4 * 3).reshape(130, 4, 3)


@pytest.fixture
def trajectory(tmp_path: Path) -> Path:
    path = tmp_path / "data" / "trajectory.h5"
    with safe_files.atomic_hdf5(path, "trajectories", {"time_step": 0.01}) as file:
        safe_files.create(file, "positions", POSITIONS, "m")
        safe_files.create(file, "weights/mass", np.array(0.05), "kg")
    return path


def read_positions(path: Path) -> np.ndarray:
    with safe_files.read_hdf5(path, "trajectories") as file:
        return safe_files.read_array(file, "positions", shape=(None, 4, 3))


class TestAtomicFiles:
    def test_a_failing_writer_does_not_change_the_old_file(self, tmp_path):
        path = tmp_path / "metrics.json"
        safe_files.write_json(path, {"a": 1})
        with atomic.atomic_path(path) as partial:
            partial.write_text("2")
            assert safe_files.read_json(path) == {"a": 1}
        assert safe_files.read_json(path) == 2
        with pytest.raises(TypeError), atomic.atomic_path(path) as partial:
            partial.write_bytes("neither bytes nor finished")
        assert safe_files.read_json(path) == 2
        assert os.listdir(tmp_path) == ["metrics.json"]

    def test_an_unwritable_path_is_named(self, tmp_path):
        (tmp_path / "file").write_text("")
        with pytest.raises(
            DataFileError, match=r"cannot write .*file/sub/a\.json \(Not a directory\)"
        ):
            safe_files.write_json(tmp_path / "file" / "sub" / "a.json", {})
        (tmp_path / "folder.h5").mkdir()
        with (
            pytest.raises(DataFileError, match=r"cannot write .*folder\.h5"),
            safe_files.atomic_hdf5(tmp_path / "folder.h5", "k"),
        ):
            pass

    def test_errors_of_other_files_are_not_blamed_on_this_one(self, tmp_path):
        with pytest.raises(FileNotFoundError), atomic.atomic_path(tmp_path / "a.json"):
            (tmp_path / "other").read_text()

    def test_a_full_disk_is_named_and_the_old_file_stays(self, tmp_path):
        path = tmp_path / "a.json"
        safe_files.write_json(path, 1)
        with (
            pytest.raises(DataFileError, match=r"disk is full while writing .*a\.json"),
            atomic.atomic_path(path),
        ):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        assert safe_files.read_json(path) == 1

    @pytest.mark.parametrize("name", ["a.safetensors", "a.h5", "a.json"])
    def test_a_file_that_the_system_cuts_short_is_named_and_not_left(self, tmp_path, name):
        resource = pytest.importorskip("resource")
        path, limits = tmp_path / name, resource.getrlimit(resource.RLIMIT_FSIZE)

        def write():
            with safe_files.atomic_hdf5(path, "k") as file:
                safe_files.create(file, "x", np.ones(8000), "m")

        work = {
            "a.safetensors": lambda: safe_files.write_checkpoint(
                path, "k", {"x": torch.ones(8000).double()}, {}
            ),
            "a.h5": write,
            "a.json": lambda: safe_files.write_json(path, [0] * 40_000),
        }
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, limits[1]))  # Python ignores the signal.
        try:
            refuses(DataFileError, f"disk is full while writing {path}", work[name])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert os.listdir(tmp_path) == []


class TestJson:
    def test_numpy_values_paths_and_infinite_numbers(self, tmp_path):
        path = tmp_path / "a.json"
        data = {
            "x": np.float64(1.5),
            "n": np.array([[1, 2]]),
            "p": Path("b"),
            "bad": [np.nan, -np.inf],
            3: True,
        }
        safe_files.write_json(path, data)
        parsed = json.loads(path.read_text(), parse_constant=pytest.fail)
        assert parsed == {"x": 1.5, "n": [[1, 2]], "p": "b", "bad": [None, None], "3": True}

    def test_objects_are_refused(self, tmp_path):
        refuses(
            TypeError,
            "object cannot be written",
            safe_files.write_json,
            tmp_path / "a.json",
            {"a": object()},
        )
        assert os.listdir(tmp_path) == []

    @pytest.mark.parametrize(
        ("content", "message"),
        [(b'{"a": 1', "not a JSON file"), (b"\xff\xfe", "not a JSON"), (None, "not exist")],
    )
    def test_unreadable(self, tmp_path, content, message):
        path = tmp_path / "a.json"
        if content is not None:
            path.write_bytes(content)
        refuses(DataFileError, f"{path}.*{message}", safe_files.read_json, path)


class TestHdf5:
    def test_round_trip_with_units_and_chunks_along_time(self, trajectory):
        with safe_files.read_hdf5(trajectory, "trajectories") as file:
            dataset = file["positions"]
            assert dataset.chunks == (64, 4, 3)
            assert dataset.attrs["units"] == "m"
            assert file.attrs["time_step"] == 0.01
            assert safe_files.read_array(file, "weights/mass", shape=()) == 0.05
            assert np.array_equal(
                safe_files.read_array(file, "positions", index=(slice(3, 5), 2)), POSITIONS[3:5, 2]
            )
        assert np.array_equal(read_positions(trajectory), POSITIONS)

    def test_cut_anywhere_it_is_refused_and_a_flipped_bit_never_gives_other_numbers(
        self, trajectory
    ):
        content = trajectory.read_bytes()
        for length in [*range(0, 2048, 97), len(content) // 2, len(content) - 1]:
            trajectory.write_bytes(content[:length])
            with pytest.raises(
                DataFileError, match=r"trajectory\.h5 (is truncated|is not an HDF5 file|is damaged)"
            ):
                read_positions(trajectory)
        content = trajectory.read_bytes()
        refused = 0
        for place in range(0, len(content), 211):
            damaged = bytearray(content)
            damaged[place] ^= 0x10
            trajectory.write_bytes(damaged)
            try:
                assert np.array_equal(read_positions(trajectory), POSITIONS), f"byte {place}"
            except DataFileError:
                refused += 1
        assert refused > 0.8 * len(range(0, POSITIONS.nbytes, 211))

    def test_a_finished_file_is_one_of_the_same_settings_that_is_whole(self, tmp_path):
        path = tmp_path / "forces.h5"
        assert not safe_files.is_final(path, "forces", "f")
        with safe_files.atomic_hdf5(path, "forces", {"fingerprint": "f"}) as file:
            safe_files.create(file, "force", np.ones((4, 10, 3)), "N")
        assert safe_files.is_final(path, "forces", "f")
        assert not safe_files.is_final(path, "forces", "g")
        path.write_bytes(path.read_bytes()[:-9])
        refuses(DataFileError, r"forces\.h5 is truncated", safe_files.is_final, path, "forces", "f")

    @pytest.mark.parametrize(
        ("attributes", "message"),
        [
            ({"format": "other"}, "was not written by warp_resphys"),
            ({"format": "warp_resphys", "version": 2}, "format version 2"),
            (
                {"format": "warp_resphys", "version": 1, "kind": "forces"},
                "contains 'forces' where 'trajectories'",
            ),
            ({"format": "warp_resphys", "version": 1, "kind": "trajectories"}, "is unfinished"),
        ],
    )
    def test_files_of_others(self, tmp_path, attributes, message):
        path = tmp_path / "a.h5"
        with h5py.File(path, "w") as file:
            file.attrs.update(attributes)
        with (
            pytest.raises(DataFileError, match=message),
            safe_files.read_hdf5(path, "trajectories"),
        ):
            pass

    def test_no_hdf5_at_all_and_missing_and_misshapen_datasets(self, tmp_path, trajectory):
        np.savez(tmp_path / "a.npz", x=POSITIONS)
        (tmp_path / "empty.h5").touch()
        for name, message in [
            ("a.npz", "not an HDF5 file"),
            ("empty.h5", "not an HDF5 file|truncated"),
            ("none.h5", "does not exist"),
            (".", "Is a directory"),
        ]:
            with (
                pytest.raises(DataFileError, match=message),
                safe_files.read_hdf5(tmp_path / name, "trajectories"),
            ):
                pass
        with safe_files.read_hdf5(trajectory, "trajectories") as file:
            for name in ("velocities", "weights"):
                refuses(DataFileError, f"no dataset '{name}'", safe_files.read_array, file, name)
            for shape in [(None, 4), (None, 5, 3)]:
                with pytest.raises(DataFileError, match=r"shape \(130, 4, 3\) where any x"):
                    safe_files.read_array(file, "positions", shape=shape)

    @pytest.mark.parametrize("kind", ["external link", "soft link", "external storage", "virtual"])
    def test_data_outside_of_the_file_are_refused(self, tmp_path, trajectory, kind):
        path = tmp_path / "a.h5"
        (tmp_path / "secret").write_bytes(bytes(80))
        with h5py.File(path, "w") as file:
            group = file.create_group("inner")
            if kind == "external link":
                group["x"] = h5py.ExternalLink(str(trajectory), "/positions")
            elif kind == "soft link":
                group["x"] = h5py.SoftLink("/elsewhere")
            elif kind == "external storage":
                group.create_dataset("x", (10,), "f8", external=[(str(tmp_path / "secret"), 0, 80)])
            else:
                layout = h5py.VirtualLayout((130, 4, 3), "f8")
                layout[...] = h5py.VirtualSource(str(trajectory), "positions", (130, 4, 3))
                group.create_virtual_dataset("x", layout)
        with (
            pytest.raises(DataFileError, match="'/inner/x'"),
            safe_files.read_hdf5(path, "trajectories"),
        ):
            pass

    def test_errors_of_other_files_are_not_blamed_on_this_one(self, trajectory, tmp_path):
        with pytest.raises(FileNotFoundError), safe_files.read_hdf5(trajectory, "trajectories"):
            (tmp_path / "other").read_text()


class TestCheckpoints:
    @property
    def tensors(self) -> dict[str, torch.Tensor]:
        # Not contiguous.
        return {"weight": torch.arange(6.0).reshape(2, 3).T, "step": torch.tensor(3)}

    def test_round_trip(self, tmp_path):
        path = tmp_path / "a.safetensors"
        shared = {**self.tensors, "alias": self.tensors["weight"]}
        safe_files.write_checkpoint(
            path, "network", shared, {"epoch": 3, "mean": np.float64(0.5), "fingerprint": "f"}
        )
        tensors, metadata = safe_files.read_checkpoint(path, "network")
        assert all(torch.equal(tensors[name], shared[name]) for name in shared)
        assert metadata == {"epoch": 3, "mean": 0.5, "fingerprint": "f"}
        tensors["weight"] += 1  # own memory, not the file's
        assert torch.equal(
            safe_files.read_checkpoint(path, "network")[0]["weight"], self.tensors["weight"]
        )

    def test_damage_anywhere_is_one_sentence_or_does_no_harm(self, tmp_path):
        path = tmp_path / "a.safetensors"
        safe_files.write_checkpoint(path, "network", self.tensors, {"epoch": 3, "fingerprint": "f"})
        content, refused = path.read_bytes(), 0
        for place in range(len(content)):
            damaged = bytearray(content)
            damaged[place] ^= 1 << place % 8
            path.write_bytes(damaged)
            try:
                safe_files.read_checkpoint(path, "network")
            except DataFileError:
                refused += 1
        assert refused > 0.5 * len(content)

    def test_unusable(self, tmp_path):
        path = tmp_path / "a.safetensors"
        safe_files.write_checkpoint(path, "network", self.tensors, {"fingerprint": "f"})
        refuses(DataFileError, "'network'", safe_files.read_checkpoint, path, "other")
        content = path.read_bytes()
        for length in (0, 5, 40, len(content) - 1):
            path.write_bytes(content[:length])
            with pytest.raises(DataFileError, match=r"not a complete safetensors file|is damaged"):
                safe_files.read_checkpoint(path, "network")
        refuses(
            DataFileError,
            "does not exist",
            safe_files.read_checkpoint,
            tmp_path / "none",
            "network",
        )
        from safetensors.torch import save_file

        save_file({"x": torch.zeros(2)}, path)
        refuses(
            DataFileError,
            "was not written by warp_resphys",
            safe_files.read_checkpoint,
            path,
            "network",
        )

    def test_those_of_other_settings_or_cut_short_are_not_used(self, tmp_path, caplog):
        path = tmp_path / "a.safetensors"
        safe_files.write_checkpoint(path, "network", self.tensors, {"fingerprint": "f"})
        assert torch.equal(
            safe_files.resume_checkpoint(path, "network", "f")[0]["weight"], self.tensors["weight"]
        )
        assert safe_files.resume_checkpoint(path, "network", "g") is None
        assert safe_files.resume_checkpoint(tmp_path / "none", "network", "f") is None
        assert "belongs to other settings" in caplog.text
        path.write_bytes(path.read_bytes()[:-9])
        assert safe_files.resume_checkpoint(path, "network", "f") is None
        assert f"{path} is not a complete safetensors file" in caplog.text
