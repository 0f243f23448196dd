import io
import json
import os
import pickle
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warp_resphys.data.recordings.arrays import decoded
from warp_resphys.data.recordings.published import (
    ARM_NOMINAL,
    BEAM_NOMINAL,
    MARKERS,
    convert_arm,
    convert_beam,
    read_published_arm,
)
from warp_resphys.data.recordings.reading import read_recording
from warp_resphys.io import decoding
from warp_resphys.io.errors import DataFileError

ROOT = Path(__file__).parents[2]
TURN = Rotation.from_euler("xyz", [0.4, -1.5, 2.0])


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


@pytest.fixture
def arm():
    """Two trials of four frames, in the laboratory's frame; the pressures tell trial, frame and chamber."""
    in_recorded_order = TURN.apply(ARM_NOMINAL[list(MARKERS)]) + [0.3, -0.2, 1.0]
    sway = 1e-3 * np.arange(4)[:, None, None] * np.ones((15, 3))
    data = np.stack([in_recorded_order + sway, in_recorded_order + 2.0 * sway])
    trial, frame, chamber = np.meshgrid(range(2), range(4), range(6), indexing="ij")
    return {"data": data, "p": 100.0 * trial + 10.0 * frame + chamber, "note": ["as recorded", 3, None, (1.5, b"x")]}


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_arrays_of_every_protocol_are_read(tmp_path, protocol):
    content = {
        "a": np.arange(12.0).reshape(3, 4),
        "b": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
        "c": np.arange(5, dtype=">f4"),
        "d": np.array([True, False]),
        "e": np.float64(2.5),
        "f": np.zeros((0, 3)),
        "g": [1, {"x": (None, "y")}],
    }
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    arrays = decoded("pickle", path)
    assert sorted(arrays) == list("abcdef")
    for name, array in arrays.items():
        assert array.dtype == np.float64
        np.testing.assert_array_equal(array, content[name])


def test_arrays_of_a_saved_dictionary_are_read(tmp_path, arm):
    """numpy.save makes an array of one object of it."""
    np.save(tmp_path / "data.npy", arm, allow_pickle=True)
    arrays = decoded("pickle", tmp_path / "data.npy")
    np.testing.assert_array_equal(arrays["data"], arm["data"])


def test_names_of_an_older_numpy_are_known(tmp_path):
    before = pickle.dumps({"a": np.arange(3.0)}, protocol=2)
    content = before.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert content != before
    (tmp_path / "data.pkl").write_bytes(content)
    np.testing.assert_array_equal(decoded("pickle", tmp_path / "data.pkl")["a"], [0.0, 1.0, 2.0])


class Build:
    """What is unpickled by naming a class and setting its state."""

    def __init__(self, module, name, state):
        self.module, self.name, self.state = module, name, state

    def dump(self):
        stream = io.BytesIO()
        stream.write(b"\x80\x02c" + f"{self.module}\n{self.name}\n".encode())
        stream.write(pickle.dumps(self.state, protocol=2)[2:-1])
        stream.write(b"b.")
        return stream.getvalue()


@pytest.mark.parametrize("wrapped", ["bare", "in a list", "in a saved dictionary", "in an array of objects"])
def test_a_pickle_that_runs_a_command_is_refused_before_it_does(tmp_path, wrapped):
    payload, path = Payload(tmp_path / "ran"), tmp_path / "data.npy"
    if wrapped == "in a saved dictionary":
        np.save(path, {"data": np.zeros(3), "p": payload}, allow_pickle=True)
    elif wrapped == "in an array of objects":
        np.save(path, np.array([payload, payload], dtype=object), allow_pickle=True)
    else:
        path.write_bytes(pickle.dumps(payload if wrapped == "bare" else [payload]))
    with pytest.raises(DataFileError, match=r"data\.npy cannot be .*it would construct 'posix\.mkdir'"):
        decoded("pickle", path)
    assert not (tmp_path / "ran").exists()
    np.load(path, allow_pickle=True) if wrapped.endswith("ary") else pickle.loads(pickle.dumps(payload))
    assert (tmp_path / "ran").exists()  # the payload is a real one


@pytest.mark.parametrize(
    "content",
    [
        pickle.dumps(OrderedDict(a=1)),
        pickle.dumps(frozenset([1]), protocol=2),
        pickle.dumps({"a": complex(1, 2)}),
        pickle.dumps(np.random.default_rng(0)),
        b"\x80\x02cbuiltins\neval\n(X\x01\x00\x00\x001tR.",
        b"\x80\x04\x8c\x05numpy\x8c\x14testing.assert_equal\x93.",
        b"\x80\x02cnumpy\nload\n.",
    ],
)
def test_everything_else_is_refused(tmp_path, content):
    (tmp_path / "data.pkl").write_bytes(content)
    with pytest.raises(DataFileError, match="it would construct"):
        decoded("pickle", tmp_path / "data.pkl")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not a pickle",
        pickle.dumps({"a": np.arange(100.0)})[:-60],
        pickle.dumps([1, 2, 3]),
        pickle.dumps({"a": np.array(["text"])}),
        pickle.dumps({"a": np.array([None, 1], dtype=object)}),
        pickle.dumps({"a": np.zeros(2, dtype=[("x", "f8")])}),
        b"\x93NUMPY\x01\x00\x10\x00{'descr': nonsense",
        b"\x93NUMPY\x01",
        b"\x93NUMPY\x02\x00\xff\xff\xff\x7f{'descr': '|O'",
        Build("numpy", "dtype", {"x": 1}).dump(),
        Build("numpy", "ndarray", (None, {"__class__": 1})).dump(),
        b"\x80\x02cnumpy\ndtype\n\x81.",
        b"\x80\x02cnumpy._core.multiarray\nscalar\ncnumpy\ndtype\nX\x02\x00\x00\x00f8\x85RJ\xff\xff\xff\x7f\x86R.",
    ],
)
def test_damaged_and_useless_pickles_end_with_one_sentence(tmp_path, content):
    (tmp_path / "data.pkl").write_bytes(content)
    with pytest.raises(DataFileError, match=r"data\.pkl cannot be decoded"):
        decoded("pickle", tmp_path / "data.pkl")
    with pytest.raises(DataFileError, match="No such file"):
        decoded("pickle", tmp_path / "absent.pkl")


def test_a_size_that_is_claimed_is_not_allocated(tmp_path):
    """An array whose state says that its bytes are the number 2^40."""
    content = (
        b"\x80\x02}X\x01\x00\x00\x00acnumpy._core.multiarray\n_reconstruct\n)R(K\x01K\x01\x85cnumpy\ndtype\n"
        b"X\x02\x00\x00\x00f8\x85R\x89\x8a\x06\x00\x00\x00\x00\x00\x01tbs."
    )
    (tmp_path / "data.pkl").write_bytes(content)
    with pytest.raises(DataFileError, match="an array that does not hold numbers"):
        decoded("pickle", tmp_path / "data.pkl")


MIB = (1 << 20).to_bytes(4, "little")
DEEP = b")" + 2_000_000 * b"\x85"  # (((...)))
ENCODE = b"c_codecs\nencode\nq\x00X" + MIB + b"7" * (1 << 20) + b"X\x06\x00\x00\x00latin1\x86q\x01"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"}" + DEEP + b"Ns.", "pickle ends with"),  # hashing it fills the stack
        (b"})" + 60 * b"2\x86" + b"Ns.", "does not end within"),  # 2^60 tuples to hash
        (DEEP + b")\x93.", "UnpicklingError"),
        (b"}Nr\xff\xff\xff\x7fa.", "takes more than .* memory"),  # two thousand million memo entries
        (ENCODE + b"0]" + 10_000 * b"h\x00h\x01Ra" + b".", "takes more than .* memory"),  # 10 GiB of texts
    ],
    ids=["deep", "wide", "name", "memo", "texts"],
)
def test_pickles_made_to_take_memory_or_time_end_soon_with_one_sentence(tmp_path, monkeypatch, content, message):
    monkeypatch.setattr(decoding, "MEMORY", (1 << 29, 64))
    monkeypatch.setattr(decoding, "SECONDS", (2.0, 2e-6))
    (tmp_path / "data.pkl").write_bytes(b"\x80\x04" + content)
    with pytest.raises(DataFileError, match=rf"data\.pkl cannot be decoded \(.*{message}.*\): copy") as caught:
        decoded("pickle", tmp_path / "data.pkl")
    assert len(str(caught.value)) < 500


def test_the_arm_comes_out_in_the_order_of_the_mesh(tmp_path, arm):
    np.save(tmp_path / "captured.npy", arm, allow_pickle=True)
    index = convert_arm(tmp_path / "captured.npy", tmp_path / "out")
    assert json.loads((tmp_path / "out" / "index.json").read_text()) == index
    assert [entry["file"] for entry in index] == ["arm_000.h5", "arm_001.h5"]
    assert all(entry["registration_residual_mm"] < 1e-6 for entry in index)
    recording = read_recording(tmp_path / "out" / "arm_001.h5")
    assert recording.labels[:4] == ("Base - 1", "Base - 2", "Base - 3", "Arm - 1")
    assert recording.rate == 100.0
    np.testing.assert_allclose(recording.rest, TURN.apply(ARM_NOMINAL) + [0.3, -0.2, 1.0])
    np.testing.assert_allclose(recording.positions[3], recording.rest + 6e-3)
    np.testing.assert_allclose(recording.actuation[2], 1e4 + 2e3 + 100.0 * np.array([5, 4, 2, 0, 1, 3]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda arm: arm.pop("p"), "has no array 'p'; it has data"),
        (lambda arm: arm.update(p=arm["p"][:, :3]), r"p \(2, 3, 6\) must have the shapes"),
        (lambda arm: arm.update(data=arm["data"][:, :, :12]), r"data \(2, 4, 12, 3\) and p"),
    ],
)
def test_an_arm_of_another_shape(tmp_path, arm, change, message):
    change(arm)
    np.save(tmp_path / "captured.npy", arm, allow_pickle=True)
    with pytest.raises(DataFileError, match=rf"captured\.npy.*{message}"):
        read_published_arm(tmp_path / "captured.npy")


@pytest.fixture
def beam(tmp_path):
    """Trials 0 and 5, in millimetres, marker by marker."""
    folder = tmp_path / "weight_data_ordered"
    folder.mkdir()
    rest = 1e3 * (TURN.apply(BEAM_NOMINAL) + [0.3, -0.2, 1.0])
    for trial in (0, 5):
        frames = rest[:, :, None] + np.arange(6) + trial
        np.save(folder / f"qs_real{trial}_reorder.npy", frames)
    np.savez(folder / "q_data_reorder.npz", arr_0=np.stack([rest + 9.0, rest], axis=2), arr_1=np.zeros((10, 3, 2)))
    return folder


def test_the_beam_has_its_weights_splits_and_rest_shapes(tmp_path, beam):
    index = convert_beam(beam, tmp_path / "out")
    assert [(entry["file"], entry["weight_kg"], entry["split"], entry["frames"]) for entry in index] == [
        ("beam_000.h5", 0.05, "train", 6),
        ("beam_005.h5", 0.08, "validation", 6),
    ]
    assert index[0]["registration_residual_mm"] < 1e-6
    assert index[1]["registration_residual_mm"] is None  # the archive has no arr_5
    recording = read_recording(tmp_path / "out" / "beam_000.h5")
    assert recording.positions.shape == (6, 10, 3)
    np.testing.assert_allclose(recording.rest, TURN.apply(BEAM_NOMINAL) + [0.3, -0.2, 1.0])
    np.testing.assert_allclose(recording.positions[4], recording.rest + 4e-3)


def test_wrong_beam_files(tmp_path, beam):
    with pytest.raises(DataFileError, match=r"holds no file qs_real0_reorder\.npy"):
        convert_beam(tmp_path, tmp_path / "out")
    np.save(beam / "qs_real0_reorder.npy", np.zeros((6, 10, 3)))
    with pytest.raises(DataFileError, match=r"qs_real0_reorder\.npy: an array has the shape \(6, 10, 3\)"):
        convert_beam(beam, tmp_path / "out")
    np.save(beam / "qs_real0_reorder.npy", np.array([Payload(tmp_path / "ran")], dtype=object), allow_pickle=True)
    with pytest.raises(DataFileError, match=r"qs_real0_reorder\.npy is no NumPy archive of plain arrays"):
        convert_beam(beam, tmp_path / "out")
    assert not (tmp_path / "ran").exists()


def test_command(tmp_path, beam):
    def run(*arguments):
        command = [sys.executable, "-m", "warp_resphys", "inspect", "convert", *arguments]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    done = run("layout=beam", f"source={beam}", "output=converted")
    assert done.returncode == 0, done.stderr
    assert "Written: 2 recordings and index.json to converted; rest shapes at most 0.0 mm off" in done.stdout
    assert sorted(file.name for file in (tmp_path / "converted").iterdir()) == [
        "beam_000.h5",
        "beam_005.h5",
        "index.json",
    ]
    refused = run("layout=arm", f"source={beam / 'absent.npy'}")
    assert refused.returncode == 2
    assert refused.stderr.strip().splitlines()[-1].startswith("error: Cannot read ")
