"""Materials from pictures: of simulated cameras or of files, by outlines,
tracked points, clouds, and while moving.
"""

import json
import re
import shutil
from dataclasses import replace
from unittest.mock import MagicMock

import meshio
import numpy as np
import pytest
import shapely
import torch
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

import warp_resphys as wr
from support.command_line import outcome, refusal
from support.configured import composed, settings
from support.main_job import IN_RUN, QUIET
from support.tags import draw_tag
from warp_resphys.core.energies.catalogue import read_law
from warp_resphys.core.mesh.volume_mesh import boundary_triangles
from warp_resphys.io.resuming import run_stages
from warp_resphys.io.safe_files import read_hdf5, read_json
from warp_resphys.io.settings import parse
from warp_resphys.learning.identification import search
from warp_resphys.pictures import ClosedSurface, Lens, Outline, PlacedCamera
from warp_resphys.pictures import picture_stages as stages
from warp_resphys.pictures.camera_laboratory import depth_image, noisy_mask
from warp_resphys.pictures.picture_stages import picture_stages
from warp_resphys.pictures.pictures_page import PictureResult, picture_verdict
from warp_resphys.pictures.scene_files import read_tracked
from warp_resphys.settings.run import RunSettings

SIZE = (640, 360)
MATRIX = [[450, 0, 320], [0, 450, 180], [0, 0, 1]]
LENS = f"matrix={MATRIX}".replace(" ", "")
MESH = wr.box_tetrahedra((0.12, 0.03, 0.03), (4, 1, 1))
BEAM = ("mesh.boxes=[[[0.0,0.0,0.0],[0.12,0.03,0.03]]]", f"data.lens.{LENS}", *QUIET)
COARSE = (*BEAM, "mesh.size=0.03")
LABORATORY = ("data.simulated.material.youngs_modulus=120.0e3", "data.simulated.size=[640,360]")
SIMULATED = ("experiment=camera_simulated", *COARSE, *LABORATORY, "data.simulated.noise=0.5")


def identified(folder):
    return read_json(folder / "identification.json")["sysid"]


def poses(folder):
    """Rows of the poses by name."""
    return {row["pose"]: row for row in read_json(folder / "metrics.json")["poses"]}


def check_modulus(folder):
    """The simulator to correct has 200 kPa."""
    found = identified(folder)
    modulus = found["parameters"]["youngs_modulus"]
    deviation = found["uncertainty"]["deviation"]["youngs_modulus"]
    assert modulus == pytest.approx(120e3, rel=0.05)
    assert abs(modulus - 120e3) < 4.0 * deviation


def succeeded(*arguments):
    """The output of a command."""
    result = outcome(*arguments)
    assert result.code == 0, result.err
    return result.out


@pytest.mark.slow
class TestSimulatedLaboratory:
    def test_the_material_comes_back_from_outlines_and_a_finished_search_is_kept(
        self, folder, monkeypatch
    ):
        with monkeypatch.context() as patch:
            patch.setattr(stages, "law_content", MagicMock(side_effect=KeyboardInterrupt))
            assert outcome(*SIMULATED, IN_RUN).code
        monkeypatch.setattr(search, "search_parameters", None)
        out = succeeded(*SIMULATED, IN_RUN)
        check_modulus(folder / "run")
        (tested,) = [row for row in poses(folder / "run").values() if row["tested"]]
        assert tested["pose"] == "upwards"
        assert tested["outline_mm"]["sysid"] < 0.5 * tested["outline_mm"]["simulation"]
        assert tested["outline_mm"]["simulation"] < tested["outline_mm"]["undeformed"]
        assert tested["overlap"]["sysid"] > 0.95
        assert "No evidence either way: 1 pose kept back" in out
        assert "Young's modulus [kPa]: 12" in out
        page = (folder / "run" / "report.html").read_text()
        assert "Young&#39;s modulus" in page
        assert "upwards" in page
        assert (folder / "run" / "figures" / "outlines.png").stat().st_size > 1e4

    def test_and_from_depths(self, folder):
        out = succeeded("experiment=depth_simulated", *COARSE, *LABORATORY, IN_RUN)
        depth = np.asarray(Image.open(folder / "run" / "recordings" / "level" / "00_depth.png"))
        assert 300 < depth[depth > 0].min() < depth.max() < 700  # mm
        check_modulus(folder / "run")
        (tested,) = [row for row in poses(folder / "run").values() if row["tested"]]
        assert tested["outline_mm"]["sysid"] is None
        # The noise of 1 mm has a mean of 0.8 mm, along the line of sight.
        assert tested["cloud_mm"]["sysid"] < 0.8
        assert tested["cloud_mm"]["sysid"] < min(
            tested["cloud_mm"][own] for own in ("simulation", "undeformed")
        )
        assert {"distance", "clouds"} <= set(out.lower().split())  # compared in the table
        assert (folder / "run" / "figures" / "clouds.png").stat().st_size > 1e4
        assert not (folder / "run" / "figures" / "outlines.png").exists()


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Folder of the pictures of a simulated camera."""
    folder = tmp_path_factory.mktemp("camera")
    run_stages(picture_stages(settings(*SIMULATED), {})[:1], folder)
    return folder / "recordings"


@pytest.fixture
def recorded(pictures, folder):
    """A folder of pictures with two cameras of which the first is wrong,
    a copy, a mesh and clamps of their own.
    """
    source = pictures / "level"
    pose = folder / "pictures" / "beam"
    pose.mkdir(parents=True)
    shutil.copy(source / "00_mask.png", pose / "00.png")
    shutil.copy(source / "00_mask.png", pose / "01.png")
    mask = np.asarray(Image.open(source / "00_mask.png"))
    Image.fromarray(
        np.where(mask[..., None] > 0, (30, 90, 200), (20, 20, 20)).astype(np.uint8)
    ).save(pose / "02.png")
    right = read_json(source / "camera.json")["frames"][0]["world_to_camera"]
    wrong = np.array(right)
    # About the origin, out of view.
    wrong[:3, :3] = wrong[:3, :3] @ Rotation.from_euler("yz", (2.0, 0.4)).as_matrix()
    meshio.write(pose / "mesh.vtk", meshio.Mesh(MESH.vertices, [("tetra", MESH.cells)]))
    frames = [
        {"image": "00.png", "mask": "00.png", "time": 0.0, "world_to_camera": wrong.tolist()},
        {"image": "01.png", "mask": "01.png", "time": 0.1, "world_to_camera": right},
        {"image": "02.png", "time": 0.2, "world_to_camera": right},
    ]
    clamp = {"vertices": np.flatnonzero(MESH.vertices[:, 0] == 0.0).tolist()}
    (pose / "camera.json").write_text(json.dumps({"frames": frames, "fixed": [clamp]}))
    return folder


RECORDED = [
    *SIMULATED,
    "data.folder=pictures",
    "data.poses=null",
    "+data.poses={beam:{folder:beam,mesh:mesh.vtk,material:soft,mask:{hue:[200,240]}}}",
    "data.materials={soft:{density:1100.0}}",
    *("data.train=[beam]", "data.test=[]", "data.simulated=null"),
    IN_RUN,
]


class TestPicturesOfAFolder:
    @pytest.mark.slow
    def test_copies_count_once_the_better_camera_is_chosen_and_masks_are_files_or_colours(
        self, recorded
    ):
        out = succeeded(*RECORDED)
        assert Image.open(recorded / "run" / "masks" / "beam.png").size == SIZE
        with read_hdf5(recorded / "run" / "pictures.h5", "pictures") as file:
            masks = [file[f"beam/masks/{number}"][:] for number in (0, 2)]
            frames = file["beam/frames"][:]
        assert frames.tolist() == [0, 2]
        assert (masks[0] == masks[1]).mean() > 0.999
        camera = read_json(recorded / "run" / "identification.json")["cameras"]["beam"][""]
        given = read_json(recorded / "pictures/beam/camera.json")["frames"][1]["world_to_camera"]
        assert camera[0][3] == pytest.approx(given[0][3])
        outline = poses(recorded / "run")["beam"]["outline_mm"]
        assert outline["sysid"] < min(0.5, 0.2 * outline["undeformed"])
        modulus = identified(recorded / "run")["parameters"]["youngs_modulus@soft"]
        assert 100e3 < modulus < 180e3
        assert "no pose was kept back" in out
        parameters = read_law(str(recorded / "run" / "law_soft.json"))["parameters"]
        assert (parameters["youngs_modulus"], parameters["density"]) == (modulus, 1100.0)

    @pytest.mark.slow
    def test_a_tag_shows_the_camera(self, recorded):
        """A frame without world_to_camera.

        Of the two cameras that the tag allows, that which sees the body counts.
        """
        pose = recorded / "pictures" / "beam"
        scene = read_json(pose / "camera.json")
        right = np.array(scene["frames"][1]["world_to_camera"])
        place, size = np.array([-0.045, 0.015, 0.0]), 0.05
        x, y, _ = np.eye(3)
        image = draw_tag(
            np.asarray(Image.open(pose / "02.png")), right, np.array(MATRIX), place, x, y, size, 5
        )
        Image.fromarray(image).save(pose / "02.png")
        (pose / "camera.json").write_text(json.dumps({**scene, "frames": [{"image": "02.png"}]}))
        tag = f"data.tag={{dictionary:4x4_50,number:5,size:{size},centre:{place.tolist()}}}"
        assert "has no 'world_to_camera': give it, or the tag of data.tag" in refusal(*RECORDED)
        assert "does not show the tag 4 of 4x4_50" in refusal(*RECORDED, tag, "data.tag.number=4")
        succeeded(*RECORDED, tag, "identify.starts=2", "identify.candidates=6")
        camera = np.array(
            read_json(recorded / "run" / "identification.json")["cameras"]["beam"][""]
        )
        assert camera[:3, :3] == pytest.approx(right[:3, :3], abs=0.05)
        assert camera[:3, 3] == pytest.approx(right[:3, 3], abs=0.02)
        assert poses(recorded / "run")["beam"]["outline_mm"]["sysid"] < 0.5

    @pytest.mark.parametrize(
        ("change", "sentence"),
        [
            ("data.poses.beam.frames=[0,9]", "name 9, but"),
            ("data.poses.beam.material=hard", "materials lacks 'hard'"),
            (
                "identify.parameters.youngs_modulus={lower:1e4,upper:1e6,per:trial,"
                "prior:{mean:2e5,deviation:1e5}}",
                "take material",
            ),
            ("data.test=[beam]", "which is in data.train as well"),
            ("identify=null", "identify is null, but data.kind is pictures"),
            (
                "identify.parameters.gravity_tilt_1.per=session",
                "choose all, material, lens or trial",
            ),
            ("identify.parameters.gravity_tilt_1.per=part", "choose all, material, lens or trial"),
            (
                "identify.parameters.colour={lower:0,upper:1}",
                "identify.parameters names 'colour': choose from",
            ),
            ("data.lens.file=calibration.yaml", "give one of them, a calibration or the matrix"),
            (
                "data.poses.beam.points=tracked.csv",
                "points is empty, and data.poses.beam has some: give their places",
            ),
            (
                "data.simulated={place:[0,0,1],looks_at:[0,0,0]}",
                "data.folder is set: set data.simulated to null",
            ),
        ],
    )
    def test_bad_input_gets_a_sentence(self, recorded, change, sentence):
        assert sentence in refusal(*RECORDED, change)

    def test_a_limit_leaves_out_poses_and_a_kept_back_material_is_refused(self):
        run = parse(RunSettings, composed("experiment=camera_simulated", "budget=quick"))
        assert run.pictures.train == ("level",)
        assert [*run.pictures.poses] == ["level", "upwards"]
        silicone = ("experiment=camera_silicone", "data.folder=x")
        quick = settings(*silicone, "budget=quick").pictures
        assert [*quick.poses] == ["hammer_blue"]  # the twisted pose is of the other material
        other = ("data.poses.other={folder:other,material:hard}", "data.materials.hard={}")
        with pytest.raises(wr.InputError, match="test has a pose of hard, of which no pose is in"):
            settings(*silicone, *other, "data.test=[twist_red,other]")


class TestClouds:
    OPTIONS = (
        "experiment=camera_simulated",
        *COARSE,
        "data.folder=recorded",
        "data.simulated=null",
        "data.poses=null",
        "data.train=[beam]",
        "data.test=[]",
        "identify.parameters.camera_shift_1.per=trial",
        IN_RUN,
    )
    SCANNED = (
        *OPTIONS,
        "+data.poses={beam:{folder:beam,mesh:mesh.vtk,cloud:scan.ply,outline:false}}",
    )
    FILMED = (*OPTIONS, "+data.poses={beam:{folder:beam,mesh:mesh.vtk}}")

    @pytest.fixture
    def beam(self, folder):
        """The folder of a hanging beam of 120 kPa, with its mesh, and its surface at rest."""
        pose = folder / "recorded" / "beam"
        pose.mkdir(parents=True)
        meshio.write(pose / "mesh.vtk", meshio.Mesh(MESH.vertices, [("tetra", MESH.cells)]))
        mesh = wr.box_tetrahedra((0.12, 0.03, 0.03), (4, 1, 1), 2)
        body = wr.Body(mesh, fixed=wr.select_vertices(mesh, x=0.0))
        simulator = wr.Simulator(
            body, wr.Corotated(120e3, 0.49, density=1100.0), gravity=(0.0, -9.81, 0.0)
        )
        return pose, simulator.static_equilibrium().q[0], boundary_triangles(mesh)

    @pytest.mark.slow
    def test_a_scan_in_axes_of_its_own(self, beam, folder):
        """A surface in mm, turned by a known and by an unknown rotation,
        of a folder without a camera.
        """
        pose, q, triangles = beam
        known = Rotation.from_euler("xyz", (1.0, 2.0, -0.5))
        unknown = Rotation.from_rotvec((0.05, -0.1, 0.08))
        points = unknown.apply(q.numpy()) + (0.01, 0.02, -0.01)
        points = known.apply(points) + (0.4, 0.3, 0.2)
        trimesh.Trimesh(1e3 * points, triangles, process=False).export(pose / "scan.ply")
        world_to_cloud = np.eye(4)
        world_to_cloud[:3, :3], world_to_cloud[:3, 3] = known.as_matrix(), (0.4, 0.3, 0.2)
        (pose / "camera.json").write_text(json.dumps({"world_to_cloud": world_to_cloud.tolist()}))
        assert "check the unit (data.cloud.units of a scan" in refusal(*self.SCANNED)
        in_mm = [*self.SCANNED, "data.cloud.units=mm"]
        succeeded(*in_mm)
        parameters = identified(folder / "run")["parameters"]
        assert parameters["youngs_modulus"] == pytest.approx(120e3, rel=0.03)
        assert "focal_factor" not in parameters
        cloud = poses(folder / "run")["beam"]["cloud_mm"]
        assert cloud["sysid"] < min(0.1, 0.2 * cloud["undeformed"])
        (pose / "camera.json").unlink()  # Then the scan is 0.5 m away from where it is said to be.
        assert "of its 20000 points are close enough to the clamp" in refusal(*in_mm)

    def film(self, beam, factor):
        """Two cameras, on the left with depths and on the right
        with an outline and a longer lens than is assumed.
        """
        pose, q, triangles = beam
        surface, clamp = ClosedSurface.of(triangles), torch.tensor([0.0, 0.015, 0.015])
        matrix, frames = torch.tensor(MATRIX, dtype=torch.float64), []
        for lens, angle, own in (("left", -0.5, 1.0), ("right", 0.4, factor)):
            looking = np.diag([1.0, -1.0, -1.0, 1.0])
            looking[:3, :3] = Rotation.from_euler("x", angle).as_matrix() @ looking[:3, :3]
            looking[:3, 3] = np.array([0.0, 0.0, 0.35]) - looking[:3, :3] @ (0.06, 0.0, 0.015)
            camera = PlacedCamera(Lens(matrix), looking, clamp)
            corrections = camera.corrections({"focal_factor": own})
            pixels = camera.pixels(q, corrections).numpy()
            deep = camera.seen_from(q, corrections)[:, 2].numpy()
            mask = noisy_mask(surface.region(pixels), SIZE, 0.0, np.random.default_rng(0))
            Image.fromarray(mask).save(pose / f"{lens}.png")
            frames.append(
                {
                    "image": f"{lens}.png",
                    "mask": f"{lens}.png",
                    "lens": lens,
                    "world_to_camera": looking.tolist(),
                }
            )
            if lens == "left":
                depth = depth_image(pixels[triangles], deep[triangles], SIZE)
                np.save(pose / "left.npy", np.where(mask, depth, 1.5))  # m: a wall behind the body
                frames[-1]["depth"] = "left.npy"
        (pose / "camera.json").write_text(json.dumps({"frames": frames}))
        return [
            "~data.lens",
            f"+data.lens={{left:{{{LENS}}},right:{{{LENS}}}}}".replace("matrix=", "matrix:"),
        ]

    @pytest.mark.slow
    def test_two_cameras_have_a_lens_each(self, beam, folder):
        succeeded(*self.FILMED, *self.film(beam, 1.02))
        parameters = identified(folder / "run")["parameters"]
        assert parameters["youngs_modulus"] == pytest.approx(120e3, rel=0.04)
        assert parameters["focal_factor@right"] - parameters["focal_factor@left"] == pytest.approx(
            0.02, abs=6e-3
        )
        assert {*read_json(folder / "run" / "identification.json")["cameras"]["beam"]} == {
            "left",
            "right",
        }
        row = poses(folder / "run")["beam"]
        assert row["outline_mm"]["sysid"] < 0.5
        assert row["cloud_mm"]["sysid"] < 0.2
        page = (folder / "run" / "report.html").read_text()
        assert "Cloud [mm]" in page
        assert "Clouds of points on bodies" in page

    @pytest.mark.parametrize(
        ("changes", "sentence"),
        [
            (
                ["data.poses.beam.outline=false", "data.poses.beam.depth=false"],
                "no points, no scan and no depth",
            ),
            (
                ["~data.lens.left"],
                "frame 0 has the lens 'left', and data.lens has the names 'right'",
            ),
            (["~data.lens", "+data.lens=null"], "data.lens is not set, and"),
            (
                ["+data.lens.beam={file:a.yaml}"],
                "data.poses and data.lens both have 'beam': rename one",
            ),
            (
                ["identify.parameters.youngs_modulus.per=lens"],
                "per is lens, and is not of a camera",
            ),
        ],
    )
    def test_bad_input_gets_a_sentence(self, beam, changes, sentence):
        assert sentence in refusal(*self.FILMED, *self.film(beam, 1.0), *changes)


class TestRelease:
    """A body that is released before a camera with a rolling shutter."""

    PLAYED = (
        "experiment=camera_released",
        *BEAM,
        "data.lens.row_time=4.0e-5",
        "data.simulated.size=[640,360]",
        "data.points={tip:[0.12,0.015,0.03],corner:[0.12,0.0,0.03],middle:[0.06,0.015,0.03]}",
        "data.poses.released.release.at.x=0.12",
        "data.poses.pushed.release.at.x=0.12",
        "data.simulated.noise=0.5",
        "data.simulated.frames=24",
        "identify.tolerance=1e-2",
        "data.train=[released,level]",
        "data.test=[]",
        IN_RUN,
    )
    TRACKED = "data.poses.released.points=tracked.csv"
    RECORDED = (*PLAYED, "data.folder=pictures", "data.simulated=null")

    @pytest.mark.slow
    def test_stiffness_density_and_damping_come_back(self, folder):
        out, run = succeeded(*self.PLAYED, self.TRACKED), folder / "run"
        found = identified(run)["parameters"]
        # The simulator to correct has 200 kPa,.
        assert found["youngs_modulus"] == pytest.approx(280e3, rel=0.05)
        assert found["density"] == pytest.approx(1180.0, rel=0.05)  # 1100 kg/m^3
        assert found["stiffness_damping"] == pytest.approx(5e-3, rel=0.1)  # and 2 ms
        assert found["release_delay@released"] == pytest.approx(7e-3, abs=1e-3)
        row = poses(run)["released"]
        assert row["pictures"] == 24
        assert row["outline_mm"]["sysid"] < 0.5 * row["outline_mm"]["simulation"]
        assert row["points_mm"]["sysid"] < 0.5 * row["points_mm"]["undeformed"]
        page = (run / "report.html").read_text()
        for name, true in {
            "Release delay, released [ms]": "7",
            "Gravity tilt 1, released [°]": "0",
        }.items():
            cells = re.sub(r"<[^>]*>", " ", page.partition(name)[2].partition("</tr>")[0]).split()
            assert cells[-1] == true
        assert "Stiffness damping [ms]: " in out
        assert (
            read_json(run / "law.json")["parameters"]["stiffness_damping"]
            == found["stiffness_damping"]
        )

    @pytest.fixture(scope="class")
    @classmethod
    def pictures(cls, tmp_path_factory):
        """Folder of the pictures of a simulated camera, and of tracked points."""
        folder = tmp_path_factory.mktemp("camera")
        run_stages(picture_stages(settings(*cls.PLAYED, cls.TRACKED), {})[:1], folder)
        return folder / "recordings"

    @pytest.fixture
    def rewrite(self, pictures, folder):
        """A function that rewrites camera.json of the motion in a copy of these pictures."""
        shutil.copytree(pictures, folder / "pictures")
        path = folder / "pictures" / "released" / "camera.json"

        def rewrite(change):
            scene = read_json(path)
            change(scene, scene["frames"])
            path.write_text(json.dumps(scene))

        return rewrite

    @pytest.mark.parametrize(
        ("change", "sentence"),
        [
            (
                lambda _, frames: frames[5].pop("time"),
                "frame 5 has no 'time', and its body is released: give it",
            ),
            (
                lambda _, frames: frames[5].update(time="late"),
                "frames[5].time is 'late': it must be a number, or null",
            ),
            (
                lambda _, frames: frames[5].update(time=0.02),
                "has the time 0.02 s, and frame 4 before it 0.0666667",
            ),
            (
                lambda scene, _: scene.update(frame_rate=0),
                "frame_rate is 0: it must be a positive number, or null",
            ),
            (
                lambda scene, frames: scene.update(frames=frames[:6]),
                "fewer than 3 different frames after the release",
            ),
        ],
    )
    def test_times_that_do_not_fit_are_named(self, rewrite, change, sentence):
        rewrite(change)
        assert sentence in refusal(*self.RECORDED)

    def test_a_frame_rate_gives_times(self, rewrite, folder):
        """With which nothing is refused before the file
        of the tracked points, which lacks a frame.
        """

        def change(scene, frames):
            scene["frame_rate"] = 60.0
            for frame in frames:
                del frame["time"]

        rewrite(change)
        table = folder / "pictures" / "released" / "tracked.csv"
        assert np.isfinite(read_tracked(table, ["tip", "corner", "middle"], 0.6, range(24))).all()
        table.write_text("\n".join(table.read_text().splitlines()[:20]))
        assert "has no row of frame 19" in refusal(*self.RECORDED, self.TRACKED)

    def test_a_release_that_does_not_fit_is_named_before_any_work(self, folder):
        sentence = "data.poses.released.release.at: no vertex lies within"
        assert sentence in refusal(*self.PLAYED, "data.poses.released.release.at={x:9.0}")
        assert not (folder / "run" / "recordings").exists()


def test_noise_of_a_simulated_outline():
    """Its standard deviation across the outline is the given one,
    and no part of the body is lost.
    """
    region = shapely.Point(160.0, 120.0).buffer(80.0, quad_segs=64)
    for noise in (0.0, 2.0):
        mask = noisy_mask(region, (320, 240), noise, np.random.default_rng(0))
        away = np.linalg.norm(Outline.of_mask(mask).points - (160.0, 120.0), axis=1) - 80.0
        assert away.std() == pytest.approx(noise, rel=0.25, abs=0.4)
        assert abs(away.mean()) < 0.4


def test_the_verdict_says_where_an_identification_is_no_better():
    def result(sysid, simulation, tested):
        distances = {"undeformed": 9.0, "simulation": simulation, "sysid": sysid}
        none = dict.fromkeys(distances)
        return PictureResult("a", "", tested, 1, distances, distances, distances, none, none)

    three = [result(0.5, 2.0, True)] * 3
    assert picture_verdict([*three, result(9.0, 1.0, False)]) == [
        "The identified simulator has 75 % less error than the uncorrected simulator (on 3 of 3 "
        "poses kept back)."
    ]
    assert picture_verdict([*three[:2], result(9.0, 1.0, False)]) == [
        "No evidence either way: 2 poses kept back (the identified simulator 0.500 mm and the "
        "uncorrected simulator 2.00 mm)."
    ]
    uneven = [result(0.1, 5.0, True), result(1.1, 1.0, True), result(1.1, 1.0, True)]
    assert picture_verdict(uneven)[0].startswith("No evidence either way: 3 poses kept back")
    assert picture_verdict([result(0.95, 1.0, True)])[1].startswith(
        "Check before use: these poses hardly depend on "
    )
    (worse,) = picture_verdict([result(2.0, 1.0, True)] * 3)
    assert worse.startswith(
        "The uncorrected simulator has 50 % less error than the identified simulator (on 3 of 3"
    )
    assert (
        picture_verdict([result(0.5, 2.0, False)])[1] == "Check before use: no pose was kept back."
    )
    away = replace(
        result(0.5, 2.0, True), overlap=dict.fromkeys(("undeformed", "simulation", "sysid"), 0.1)
    )
    assert "'a' hardly overlap: check the camera" in picture_verdict([away])[1]
