import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from support.command_line import settings_of
from support.refusals import refuses
from warp_resphys.data.recordings.marker_quality import quality
from warp_resphys.data.recordings.processing import Release
from warp_resphys.data.recordings.recording import Recording
from warp_resphys.data.recordings.recording_files import write_recording
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.studies.inspection import Inspection
from warp_resphys.studies.recording_quality import inspect_recording, recording_quality

LABELS = ("tip", "base 1", "base 2")


def configured(*overrides):
    return settings_of(Inspection, "inspect", *overrides)


def held_then_initial_motion(base=0.0):
    time = np.maximum(np.arange(200) - 60.4, 0.0) / 100.0
    positions = np.tile([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.04, base]], (200, 1, 1))
    positions[:, 0, 2] -= 0.01 * (1.0 - np.exp(-2.5 * time) * np.cos(48.0 * time))
    positions += np.random.default_rng(0).normal(scale=5e-6, size=positions.shape)
    positions[100:103, 0] = np.nan
    positions[150:170, 0] = np.nan
    positions[90:, 1] += 1e-3
    return Recording(LABELS, positions, 100.0, Path("swing.h5"))


@pytest.fixture
def path(tmp_path):
    write_recording(tmp_path / "swing.h5", held_then_initial_motion())
    return tmp_path / "swing.h5"


def test_table_and_files(tmp_path, path):
    text = inspect_recording(
        configured(f"recording.path={path}", "still=[base 1, base 2]", "moving=[tip]"),
        tmp_path / "out",
    )
    rows = text.splitlines()
    assert rows[0].split()[:6] == ["marker", "seen", "gaps", "longest", "masked", "jumps"]
    assert rows[1].split()[:7] == ["tip", "88.5", "%", "2", "20", "20", "0"]
    assert len({len(row.rstrip()) for row in rows[2:4]}) == 1
    assert any("tip is hidden for up to 20 frames; 20 frames are masked." in row for row in rows)
    assert any("base 1 jumps once, by 1.73 mm, in frame 90." in row for row in rows)
    assert "Motion starts in frame 60." in text
    written = json.loads((tmp_path / "out" / "quality.json").read_text())
    assert written["release_frame"] == pytest.approx(60.4, abs=0.25)
    assert written["markers"][1]["jumps"] == [{"frame": 90, "mm": pytest.approx(1.73, abs=0.02)}]
    assert (tmp_path / "out" / "quality.png").read_bytes().startswith(b"\x89PNG")


def test_ranges_of_force_sensors_are_printed(tmp_path):
    loads = np.full((200, 6), np.nan)
    loads[:, 2], loads[5:, 4] = np.linspace(-0.5, 0.25, 200), 0.125
    write_recording(
        tmp_path / "push.h5", replace(held_then_initial_motion(), loads={"plate": loads})
    )
    said = inspect_recording(configured(f"files=[{tmp_path / 'push.h5'}]"), tmp_path)
    assert "\nForce sensor plate: fz -0.5 to 0.25 N, ty 0.125 to 0.125 N m.\n" in f"{said}\n"


def test_trials_are_compared(tmp_path, path):
    config = configured(
        f"recording.path={path}", "still=[base 1, base 2]", f"compare_with=[{tmp_path}/other.h5]"
    )
    write_recording(tmp_path / "other.h5", held_then_initial_motion(base=0.002))
    text = inspect_recording(config, tmp_path / "out")
    assert "other.h5: the base is shifted by up to 2.00 mm; its markers moved by up to 0.0" in text
    write_recording(tmp_path / "other.h5", held_then_initial_motion(base=0.03))
    with pytest.raises(DataFileError, match=r"other\.h5: base marker base 1 moved by \d+\.\d\d mm"):
        inspect_recording(config, tmp_path / "out")
    assert (
        json.loads((tmp_path / "out" / "quality.json").read_text())["base"][0]["shift_mm"]["base 2"]
        > 29.0
    )


def test_picture_shows_what_is_seen_filled_and_masked():
    recording = held_then_initial_motion()
    recording.positions[:, 2] = np.nan
    result = quality(recording, LABELS[1:], Release(60.4, (40, 60)))
    figure = recording_quality(recording, result)
    *panels, raster = figure.axes
    assert len(panels) == 4  # x, y, z and the markers that should not move
    drawn = panels[2].lines[1].get_ydata()  # the frames that were seen
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(drawn)), np.r_[100:103, 150:170])
    bridged = panels[2].lines[0].get_ydata()
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(bridged)), np.r_[150:170])
    assert np.nanmax(np.abs(drawn)) == pytest.approx(10.0, abs=2.0)  # millimetres
    image = raster.images[0].get_array()
    assert image.shape == (3, 200, 3)
    colours = [tuple(image[0, frame]) for frame in (0, 101, 160)]
    assert colours == [to_rgb("#dde1e6"), to_rgb("#e69f00"), to_rgb("#c4481b")]
    np.testing.assert_array_equal(image[2], np.tile(colours[2], (200, 1)))
    jumps = [
        line.get_xdata()
        for line in raster.lines
        if line.get_marker() == "|" and len(line.get_xdata())
    ]
    np.testing.assert_allclose(jumps, [[0.905]])
    figure.canvas.draw()


def test_files_are_told_by_their_ends():
    settings = configured("files=[a.c3d,body.vtk,b.h5]")
    assert (settings.recording.path, settings.compare_with, settings.mesh.path) == (
        "a.c3d",
        ("b.h5",),
        "body.vtk",
    )
    refuses(InputError, r"^a\.msh and b\.msh are two meshes", configured, "files=[a.msh,b.msh]")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["still=base 1"], "still is 'base 1': it must be a list"),
        (["longest_gap=-1"], "longest_gap is -1"),
        (["recording.rate=fast"], "recording.rate is 'fast'"),
        (["compare_with=[a.h5]"], "compare_with needs two or more markers"),
    ],
)
def test_wrong_settings(tmp_path, path, overrides, message):
    refuses(
        InputError,
        message,
        lambda: inspect_recording(configured(f"recording.path={path}", *overrides), tmp_path),
    )
