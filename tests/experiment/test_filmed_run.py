"""Stiffness, density and damping of a body that is released before a simulated camera with a rolling shutter."""

import json
import re
import shutil

import numpy as np
import pytest

from support.command_line import outcome, refusal
from support.configured import settings
from support.main_job import IN_RUN
from warp_resphys.experiment.pictures.stages import picture_stages
from warp_resphys.io.stages import run_stages
from warp_resphys.pictures.reading import read_tracked
from warp_resphys.settings.pictures import SimulatedCamera

PLAYED = [
    "experiment=camera_released",
    "mesh.boxes=[[[0.0,0.0,0.0],[0.12,0.03,0.03]]]",
    "data.points={tip:[0.12,0.015,0.03],corner:[0.12,0.0,0.03],middle:[0.06,0.015,0.03]}",
    "data.lens.matrix=[[450,0,320],[0,450,180],[0,0,1]]",
    "data.lens.row_time=4.0e-5",
    "data.poses.released.release.at.x=0.12",
    "data.poses.pushed.release.at.x=0.12",
    "data.simulated.size=[640,360]",
    "data.simulated.noise=0.5",
    "data.simulated.frames=24",
    "identify.tolerance=1e-2",
    "data.train=[released,level]",
    "data.test=[]",
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
]


NAMES = ("Delay of the release, released [ms]", "First tilt of gravity, released [°]")


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Folder of a run before a simulated camera, by outlines and tracked points."""
    folder = tmp_path_factory.mktemp("released")
    result = outcome(*PLAYED, "data.poses.released.points=tracked.csv", f"hydra.run.dir={folder}")
    assert result.code == 0, result.err
    return folder, result


@pytest.mark.slow
def test_stiffness_density_and_damping_come_back(played):
    folder, result = played
    identified = json.loads((folder / "identification.json").read_text())["sysid"]["parameters"]
    assert identified["youngs_modulus"] == pytest.approx(280e3, rel=0.05)  # the simulator to correct has 200 kPa,
    assert identified["density"] == pytest.approx(1180.0, rel=0.05)  # 1100 kg/m^3
    assert identified["stiffness_damping"] == pytest.approx(5e-3, rel=0.1)  # and 2 ms
    assert identified["release_delay@released"] == pytest.approx(7e-3, abs=1e-3)
    (row,) = [own for own in json.loads((folder / "metrics.json").read_text())["poses"] if own["pose"] == "released"]
    assert row["pictures"] == 24
    assert row["outline_mm"]["sysid"] < 0.5 * row["outline_mm"]["simulation"]
    assert row["points_mm"]["sysid"] < 0.5 * row["points_mm"]["undeformed"]
    page = (folder / "report.html").read_text()
    rows = {own: re.sub(r"<[^>]*>", " ", page.partition(own)[2].partition("</tr>")[0]).split() for own in NAMES}
    assert [own[-1] for own in rows.values()] == ["7", "0"]  # true values
    assert "Damping by stiffness [ms]: " in result.out
    law = json.loads((folder / "law.json").read_text())
    assert law["constants"]["stiffness_damping"] == identified["stiffness_damping"]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Folder of the pictures of a simulated camera, and of tracked points."""
    folder = tmp_path_factory.mktemp("camera")
    played = settings(*PLAYED, "data.poses.released.points=tracked.csv")
    run_stages(picture_stages(played, {})[:1], folder)
    return folder / "recordings"


@pytest.fixture
def recorded(pictures, folder):
    """A copy of these pictures, with a function that rewrites camera.json of the motion."""
    shutil.copytree(pictures, folder / "pictures")
    path = folder / "pictures" / "released" / "camera.json"
    scene = json.loads(path.read_text())

    def rewrite(change):
        frames = [dict(frame) for frame in scene["frames"]]
        content = {**scene, "frames": frames}
        change(content, frames)
        path.write_text(json.dumps(content))

    return rewrite


RECORDED = [*PLAYED, "data.folder=pictures", "data.simulated=null", IN_RUN]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda _, frames: frames[5].pop("time"), "frame 5 has no 'time', and its body is released: give it in s, or"),
        (lambda _, frames: frames[5].update(time="late"), "frame 5 has the 'time' 'late': give a number, in s"),
        (lambda _, frames: frames[5].update(time=0.02), "frame 5 has the time 0.02 s, and frame 4 before it 0.0666667"),
        (lambda scene, _: scene.update(frame_rate=0), "'frame_rate' is 0: give a positive number, in Hz"),
        (lambda scene, frames: scene.update(frames=frames[:6]), "fewer than 3 different frames after the release"),
    ],
)
def test_times_that_do_not_fit_are_named(recorded, change, sentence):
    recorded(change)
    assert sentence in refusal(*RECORDED)


def test_a_release_after_the_simulated_pictures_is_named_before_any_work(folder):
    sentence = "data.poses.released has fewer than 3 frames after its release at 100.007 s"
    assert sentence in refusal(*PLAYED, "data.poses.released.release.time=100", IN_RUN)
    assert not (folder / "run" / "stages").exists()
    camera = SimulatedCamera(place=(0, 0, 1), looks_at=(0, 0, 0), frames=24, corrections={"release_delay": 0.007})
    camera.check_release("poses.released", 20.3 / 60.0)  # 21, 22 and 23 are later
    with pytest.raises(ValueError, match="fewer than 3 frames"):
        camera.check_release("poses.released", 20.7 / 60.0)  # 21 is not, with the delay


def test_a_frame_rate_gives_times(recorded, folder):
    """With which nothing is refused before the file of the tracked points, which lacks a frame."""

    def change(scene, frames):
        scene["frame_rate"] = 60.0
        for frame in frames:
            del frame["time"]

    recorded(change)
    table = folder / "pictures" / "released" / "tracked.csv"
    assert np.isfinite(read_tracked(table, ["tip", "corner", "middle"], 0.6, range(24))).all()
    table.write_text("\n".join(table.read_text().splitlines()[:20]))
    assert "has no row of frame 19" in refusal(*RECORDED, "data.poses.released.points=tracked.csv")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("data.poses.released.clamp_turn=10", "poses.released has a release beside a scan, which shows no time, or a"),
        ("data.poses.released.release.at={x:9.0}", "data.poses.released.release.at: no vertex lies within"),
        ("data.poses.released.points=tracked.npz", "the simulated camera writes a .csv table"),
    ],
)
def test_releases_that_do_not_fit_are_named(folder, change, sentence):
    assert sentence in refusal(*PLAYED, change, IN_RUN)
    assert not (folder / "run" / "recordings").exists()
