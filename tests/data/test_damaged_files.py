"""Randomly damaged files: every reader returns data or raises one sentence,
within limits of memory and time.
"""

import json
import subprocess
import sys
import time
import tracemalloc
import warnings
from types import SimpleNamespace

import ezc3d
import h5py
import numpy as np
import pytest

from warp_resphys import DataFileError, InputError, box_tetrahedra, read_recording
from warp_resphys.core.mesh.readers import read_mesh, read_surfaces, write_mesh
from warp_resphys.data.recordings.segment import read_published_segment
from warp_resphys.io import decoding

resource = pytest.importorskip("resource", reason="this system cannot limit a process")
FRAMES = np.arange(12)
POSITIONS = 0.1 * np.random.default_rng(0).normal(size=(12, 3, 3)).cumsum(axis=0)  # [m]


def rows(separator, *columns):
    return [separator.join(f"{value:.6g}" for value in row) for row in np.column_stack(columns)]


def write_c3d(path):
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["UNITS"]["value"], point["RATE"]["value"], point["LABELS"]["value"] = (
        ["mm"],
        [100.0],
        list("abc"),
    )
    file["data"]["points"] = np.concatenate(
        [1e3 * POSITIONS.transpose(2, 1, 0), np.ones((1, 3, 12))]
    )
    file.write(str(path))


def write_csv(path):
    header = ",".join(
        ["time [s]", *(f"{label}.{axis} [mm]" for label in "abc" for axis in "xyz"), "valve [bar]"]
    )
    path.write_text(
        "\n".join([header, *rows(",", FRAMES / 100, 1e3 * POSITIONS.reshape(12, 9), FRAMES)]) + "\n"
    )


def write_tsv(path):
    head = ["NO_OF_FRAMES\t12", "NO_OF_MARKERS\t3", "FREQUENCY\t100", "MARKER_NAMES\ta\tb\tc"]
    head += [
        "\t".join(["Frame", "Time", *(f"{label} {axis}" for label in "abc" for axis in "XYZ")])
    ]
    path.write_text(
        "\n".join([*head, *rows("\t", FRAMES + 1, FRAMES / 100, 1e3 * POSITIONS.reshape(12, 9))])
        + "\n"
    )


def write_motive(path):
    head = [
        "Format Version,1.23,Export Frame Rate,100,Length Units,Meters",
        ",Type," + ",".join(["Marker"] * 9),
    ]
    head += [
        ",Name," + ",".join(label for label in "abc" for _ in range(3)),
        "Frame,Time," + ",".join("XYZXYZXYZ"),
    ]
    path.write_text(
        "\n".join([*head, *rows(",", FRAMES, FRAMES / 100, POSITIONS.reshape(12, 9))]) + "\n"
    )


def write_npz(path):
    known = {
        "labels": np.array(list("abc")),
        "rate_hz": 100.0,
        "units": "m",
        "start": 0.5,
        "rest": POSITIONS[0],
    }
    np.savez(path, positions=POSITIONS, actuation=np.ones((12, 2)), actuation_units="kPa", **known)


def write_hdf5(path):
    with h5py.File(path, "w") as file:
        file.attrs.update(
            {"rate_hz": 100.0, "labels": list("abc"), "format": "of another program", "start": 0.5}
        )
        file["positions"], file["actuation"], file["rest"] = (
            POSITIONS,
            np.ones((12, 2)),
            POSITIONS[0],
        )
        file["positions"].attrs["units"], file["actuation"].attrs["units"] = "m", "kPa"


def write_segment(path):
    markers = np.repeat(0.05 * np.random.default_rng(1).normal(size=(2, 1, 7, 3)), 30, axis=1)
    markers[:, 10:] += 1e-4 * (np.arange(20) ** 2)[:, None, None]
    np.savez_compressed(path, pressure_mbar=np.array([50.0, 75.0]), markers=markers, rate_hz=100.0)


def write_box(path):
    write_mesh(path, box_tetrahedra((0.1, 0.03, 0.03), (2, 1, 1)))


HERE = {
    "a.csv": (write_csv, read_recording),
    "motive.csv": (write_motive, read_recording),
    "a.tsv": (write_tsv, read_recording),
    "a.npz": (write_npz, read_recording),
    "segment.npz": (write_segment, read_published_segment),
}
ELSEWHERE = {
    "a.c3d": (write_c3d, read_recording),
    "a.h5": (write_hdf5, read_recording),
    "a.inp": (write_box, read_mesh),
    "a.msh": (write_box, read_surfaces),
    "a.vtk": (write_box, read_mesh),
    "a.vtu": (write_box, read_mesh),
}


def damaged(content, random):
    """The content with a few bytes changed, cut off, taken out or put in twice."""
    content = bytearray(content)
    kind, at = random.integers(8), int(random.integers(len(content)))
    if kind == 0:
        return content[:at]
    if kind == 1:
        return content[:at] + content[at + int(random.integers(1, 200)) :]
    if kind == 2:
        return content[:at] + content[at : at + 100] + content[at:]
    for place in random.integers(len(content), size=random.integers(1, 5)):
        content[place] = random.choice(
            [random.integers(256), content[place] ^ 1, content[place] ^ 128, 0, 255, 57]
        )
    return content


def is_one_sentence(message, path):
    assert str(path) in message
    assert message.isprintable()
    assert len(message) <= 1000
    return True


def read_damaged(tmp_path, name, write, read, seed, count):
    """Reads the file damaged in so many ways; returns how many of them were refused."""
    write(tmp_path / name)
    read(tmp_path / name)
    whole, refused = (tmp_path / name).read_bytes(), 0
    for number in range(count):
        (tmp_path / name).write_bytes(damaged(whole, np.random.default_rng([seed, number])))
        began = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)
                read(tmp_path / name)
        except (DataFileError, InputError) as error:
            refused += is_one_sentence(str(error), tmp_path / name)
        except BaseException as error:
            raise AssertionError(
                f"{name}, damaged as number {number} of seed {seed}: {error!r}"
            ) from error
        assert time.perf_counter() - began < 60.0
    return refused


@pytest.mark.parametrize("name", HERE)
def test_damaged_files_that_are_read_in_this_process(tmp_path, name):
    tracemalloc.start()
    try:
        assert read_damaged(tmp_path, name, *HERE[name], seed=0, count=150) > 20
        assert tracemalloc.get_traced_memory()[1] < 32 << 20
    finally:
        tracemalloc.stop()


SERVER = """
import json, os, signal, sys
from warp_resphys.io import decoding
libraries = {
    "ezc3d": decoding.c3d_arrays,
    "h5py": decoding.hdf5_arrays,
    "meshio": decoding.mesh_arrays,
}
for number, line in enumerate(sys.stdin):
    memory, seconds, library, path, *names = json.loads(line)
    if number == 0:
        libraries[library](path, *names)  # imports it; the first file is whole
    if (child := os.fork()) == 0:
        signal.alarm(18)
        for stream, name in ((1, "out"), (2, "err")):
            os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
        os._exit(decoding._main(memory, seconds, library, path, *names))
    _, status, usage = os.wait4(child, 0)
    print(os.waitstatus_to_exitcode(status), usage.ru_maxrss, flush=True)
"""


@pytest.fixture
def forked(tmp_path, monkeypatch):
    """Decodes each file in a copy of one small process, which has the libraries.

    Yields the memory that every copy took [KiB].
    """
    places = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "cwd": tmp_path, "text": True}
    taken = []

    def run(command, env, **_):
        if not taken:
            servers.append(
                subprocess.Popen([sys.executable, "-P", "-c", SERVER], env=env, **places)
            )
        server = servers[0]
        server.stdin.write(json.dumps(command[command.index("-m") + 2 :]) + "\n")
        server.stdin.flush()
        code, memory = map(int, server.stdout.readline().split())
        taken.append(memory)
        out, err = ((tmp_path / name).read_bytes() for name in ("out", "err"))
        return subprocess.CompletedProcess(command, code, out, err)

    servers = []
    monkeypatch.setattr(decoding, "MEMORY", (1 << 29, 64))
    monkeypatch.setattr(decoding, "SECONDS", (1.0, 2e-6))
    monkeypatch.setattr(
        decoding, "subprocess", SimpleNamespace(run=run, TimeoutExpired=subprocess.TimeoutExpired)
    )
    yield taken
    for server in servers:
        server.communicate()


@pytest.mark.slow
@pytest.mark.parametrize("name", ELSEWHERE)
def test_many_damaged_files_that_are_read_in_another_process(tmp_path, forked, name):
    assert read_damaged(tmp_path, name, *ELSEWHERE[name], seed=1, count=30) > 6
    assert len(forked) >= 31
    assert 20 << 10 < max(forked) < 600 << 10
