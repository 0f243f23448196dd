import ezc3d
import numpy as np
import pytest

from warp_resphys.data.recordings.processing import find_release
from warp_resphys.data.recordings.reading import read_recording
from warp_resphys.io import decoding
from warp_resphys.io.errors import DataFileError


def write_c3d(path, positions, labels, unit="mm", rate=200.0):
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file["parameters"]["POINT"]["RATE"]["value"] = [rate]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(labels)
    file["data"]["points"] = np.concatenate(
        [positions.transpose(2, 1, 0), np.ones((1, positions.shape[1], len(positions)))]
    )
    file.write(str(path))
    return path


@pytest.fixture
def trajectory():
    generator = np.random.default_rng(3)
    return generator.normal(size=(40, 3, 3)).cumsum(axis=0)


def test_read_c3d_converts_units_and_keeps_occlusions(tmp_path, trajectory):
    trajectory[7:9, 1] = np.nan
    recording = read_recording(write_c3d(tmp_path / "small.c3d", trajectory, "abc"))
    assert recording.labels == ("a", "b", "c")
    assert recording.rate == 200.0
    np.testing.assert_allclose(recording.positions, 1e-3 * trajectory, rtol=1e-6, atol=1e-9)


def test_missing_and_foreign_files(tmp_path):
    with pytest.raises(DataFileError, match="No such file"):
        read_recording(tmp_path / "absent.c3d")
    (tmp_path / "notes.c3d").write_text("this is no recording")
    with pytest.raises(DataFileError, match="not a C3D file"):
        read_recording(tmp_path / "notes.c3d")
    (tmp_path / "empty.c3d").touch()
    with pytest.raises(DataFileError, match="not a C3D file"):
        read_recording(tmp_path / "empty.c3d")


@pytest.mark.parametrize("part", [0.001, 0.3, 0.98])
def test_truncated_file(tmp_path, trajectory, part):
    content = write_c3d(tmp_path / "whole.c3d", np.tile(trajectory, (10, 1, 1)), "abc").read_bytes()
    cut = tmp_path / "cut.c3d"
    cut.write_bytes(content[: int(part * len(content))])
    with pytest.raises(DataFileError, match="truncated"):
        read_recording(cut)


@pytest.mark.parametrize(
    ("name", "after", "value", "limits", "message"),
    [
        ("CONTACT", 10, 0xFF, {}, "ezc3d ends with -11"),  # of -1 dimensions
        ("RATIO", 10, 0x80, {"MEMORY": (1 << 29, 0)}, "it takes more than 512 MiB of memory"),  # -32768 values a frame
        ("CONTACT", 10, 0x7F, {"SECONDS": (1.0, 0.0)}, "takes more than 1 s"),  # of 127 dimensions
    ],
)
def test_a_changed_byte_that_crashes_the_decoder_or_makes_it_claim_memory_or_time(
    tmp_path, trajectory, monkeypatch, name, after, value, limits, message
):
    path = write_c3d(tmp_path / "whole.c3d", trajectory, "abc")
    content = bytearray(path.read_bytes())
    content[content.index(name.encode()) + after] = value
    path.write_bytes(content)
    for limit, given in limits.items():
        monkeypatch.setattr(decoding, limit, given)
    with pytest.raises(DataFileError, match=rf"whole\.c3d cannot be decoded \(.*{message}\): copy"):
        read_recording(path)


def test_unknown_unit(tmp_path, trajectory):
    with pytest.raises(DataFileError, match="positions in 'inch'"):
        read_recording(write_c3d(tmp_path / "inch.c3d", trajectory, "abc", unit="inch"))


@pytest.mark.parametrize("release", [60.0, 60.5])
def test_release_of_a_free_fall_is_found_between_frames(release):
    time = np.maximum(np.arange(120) - release, 0.0) / 100.0
    path = np.zeros((120, 3))
    path[:, 2] = -0.01 * (1.0 - np.cos(48.0 * time) * np.exp(-2.5 * time))
    path += np.random.default_rng(0).normal(scale=5e-6, size=path.shape)
    path[:13] += [0.0, 3e-4, 0.0]  # a marker that was mistaken at first
    path[30, 2] += 8e-3  # one sample gone astray
    result = find_release(path, 100.0)
    assert result.frame == pytest.approx(release, abs=0.25)
    assert 13 <= result.rest[0] < result.rest[1] <= 61


def test_no_release():
    still = np.random.default_rng(0).normal(scale=1e-5, size=(200, 3))
    with pytest.raises(DataFileError, match=r"never moves by more than 0\.\d\d mm"):
        find_release(still, 100.0)
    swinging = np.zeros((200, 3))
    swinging[:, 2] = 0.01 * np.cos(0.5 * np.arange(200))
    with pytest.raises(DataFileError, match="not still"):
        find_release(swinging, 100.0)
    with pytest.raises(DataFileError, match="No release"):
        find_release(still[:1], 100.0)
