"""A material from pictures, from a simulated camera or from files to the report."""

import json
import shutil
from dataclasses import replace

import meshio
import numpy as np
import pytest
import shapely
from PIL import Image
from scipy.spatial.transform import Rotation

from support.command_line import outcome, refusal
from support.configured import composed, settings
from support.main_job import IN_RUN
from support.tags import draw_tag
from warp_resphys.energies.law_files import read_law
from warp_resphys.experiment.pictures.laboratory import noisy_mask
from warp_resphys.experiment.pictures.stages import picture_stages
from warp_resphys.io.errors import InputError
from warp_resphys.io.files import read_hdf5
from warp_resphys.io.settings import parse
from warp_resphys.io.stages import run_stages
from warp_resphys.mesh.mesh import box_tetrahedra
from warp_resphys.pictures.outlines import Outline
from warp_resphys.report.pictures_page import PictureResult, picture_verdict
from warp_resphys.settings.run import RunSettings

QUIET = ["hydra/job_logging=none", "hydra/hydra_logging=none"]
COARSE = [
    "mesh.boxes=[[[0.0,0.0,0.0],[0.12,0.03,0.03]]]",
    "mesh.size=0.03",
    "data.simulated.material.youngs_modulus=120.0e3",
    "data.simulated.noise=0.5",
    "data.simulated.size=[640,360]",
    "data.lens.matrix=[[450,0,320],[0,450,180],[0,0,1]]",
]
SIMULATED = ["experiment=camera_simulated", *COARSE, *QUIET]


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Folder of a run before a simulated camera."""
    folder = tmp_path_factory.mktemp("pictures")
    result = outcome(*SIMULATED, f"hydra.run.dir={folder}")
    assert result.code == 0, result.err
    return folder, result


@pytest.mark.slow
def test_the_material_of_a_simulated_laboratory_comes_back(played):
    folder, result = played
    identified = json.loads((folder / "identification.json").read_text())["sysid"]
    modulus, deviation = (
        identified["parameters"]["youngs_modulus"],
        identified["uncertainty"]["deviation"]["youngs_modulus"],
    )
    assert modulus == pytest.approx(120e3, rel=0.05)  # the simulator to correct has 200 kPa
    assert abs(modulus - 120e3) < 4.0 * deviation
    metrics = json.loads((folder / "metrics.json").read_text())
    tested = next(row for row in metrics["poses"] if row["tested"])
    assert tested["pose"] == "upwards"
    assert tested["outline_mm"]["sysid"] < 0.5 * tested["outline_mm"]["simulation"]
    assert tested["outline_mm"]["simulation"] < tested["outline_mm"]["undeformed"]
    assert tested["overlap"]["sysid"] > 0.95
    assert "In 1 pose kept back the simulated pictures are" in result.out
    assert "Young's modulus [kPa]: 12" in result.out
    page = (folder / "report.html").read_text()
    assert "Young&#39;s modulus" in page
    assert "upwards" in page
    assert (folder / "figures" / "outlines.png").stat().st_size > 1e4


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Folder of the pictures of a simulated camera."""
    folder = tmp_path_factory.mktemp("camera")
    run_stages(picture_stages(settings(*SIMULATED), {})[:1], folder)
    return folder / "recordings"


@pytest.fixture
def recorded(pictures, folder):
    """A folder of pictures with two cameras of which the first is wrong, a copy, a mesh and clamps of their own."""
    source = pictures / "level"
    pose = folder / "pictures" / "beam"
    pose.mkdir(parents=True)
    shutil.copy(source / "00_mask.png", pose / "00.png")
    shutil.copy(source / "00_mask.png", pose / "01.png")
    mask = np.asarray(Image.open(source / "00_mask.png"))
    Image.fromarray(np.where(mask[..., None] > 0, (30, 90, 200), (20, 20, 20)).astype(np.uint8)).save(pose / "02.png")
    right = json.loads((source / "camera.json").read_text())["frames"][0]["world_to_camera"]
    wrong = np.array(right)
    wrong[:3, :3] = wrong[:3, :3] @ Rotation.from_euler("yz", (2.0, 0.4)).as_matrix()  # about the origin, out of view
    mesh = box_tetrahedra((0.12, 0.03, 0.03), (4, 1, 1))
    meshio.write(pose / "mesh.vtk", meshio.Mesh(mesh.vertices, [("tetra", mesh.cells)]))
    frames = [
        {"image": "00.png", "mask": "00.png", "time": 0.0, "world_to_camera": wrong.tolist()},
        {"image": "01.png", "mask": "01.png", "time": 0.1, "world_to_camera": right},
        {"image": "02.png", "time": 0.2, "world_to_camera": right},
    ]
    clamp = {"vertices": np.flatnonzero(mesh.vertices[:, 0] == 0.0).tolist()}
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


@pytest.mark.slow
def test_pictures_of_a_folder(recorded):
    """Copies count once, the better of two cameras is chosen, masks are files or colours."""
    result = outcome(*RECORDED)
    assert result.code == 0, result.err
    assert Image.open(recorded / "run" / "masks" / "beam.png").size == (640, 360)
    with read_hdf5(recorded / "run" / "pictures.h5", "pictures") as file:
        masks, frames = [file[f"beam/masks/{number}"][:] for number in (0, 2)], file["beam/frames"][:]
    assert frames.tolist() == [0, 2]
    assert (masks[0] == masks[1]).mean() > 0.999
    identified = json.loads((recorded / "run" / "identification.json").read_text())
    assert identified["cameras"]["beam"][""][0][3] == pytest.approx(
        json.loads((recorded / "pictures/beam/camera.json").read_text())["frames"][1]["world_to_camera"][0][3]
    )
    (row,) = json.loads((recorded / "run" / "metrics.json").read_text())["poses"]
    assert row["outline_mm"]["sysid"] < 0.5
    assert row["outline_mm"]["sysid"] < 0.2 * row["outline_mm"]["undeformed"]
    assert 100e3 < identified["sysid"]["parameters"]["youngs_modulus@soft"] < 180e3
    assert "(none was kept back)" in result.out
    law = read_law(str(recorded / "run" / "law_soft.json"))
    assert law["constants"]["youngs_modulus"] == identified["sysid"]["parameters"]["youngs_modulus@soft"]
    assert law["constants"]["density"] == 1100.0


@pytest.mark.slow
def test_a_tag_shows_the_camera(recorded):
    """A frame without world_to_camera; of the two cameras that the tag allows, the one that sees the body is chosen."""
    scene = json.loads((recorded / "pictures/beam/camera.json").read_text())
    right = np.array(scene["frames"][1]["world_to_camera"])
    matrix = np.array([[450.0, 0.0, 320.0], [0.0, 450.0, 180.0], [0.0, 0.0, 1.0]])
    image = np.asarray(Image.open(recorded / "pictures/beam/02.png"))
    place, size = np.array([-0.045, 0.015, 0.0]), 0.05
    image = draw_tag(image, right, matrix, place, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), size, 5)
    Image.fromarray(image).save(recorded / "pictures/beam/02.png")
    (recorded / "pictures/beam/camera.json").write_text(json.dumps({**scene, "frames": [{"image": "02.png"}]}))
    tag = f"data.tag={{dictionary:4x4_50,number:5,size:{size},centre:{place.tolist()}}}"
    assert "has no 'world_to_camera': give it, or the tag of data.tag" in refusal(*RECORDED)
    assert "does not show the tag 4 of 4x4_50" in refusal(*RECORDED, tag, "data.tag.number=4")
    result = outcome(*RECORDED, tag, "identify.starts=2", "identify.candidates=6")
    assert result.code == 0, result.err
    camera = np.array(json.loads((recorded / "run" / "identification.json").read_text())["cameras"]["beam"][""])
    assert camera[:3, :3] == pytest.approx(right[:3, :3], abs=0.05)
    assert camera[:3, 3] == pytest.approx(right[:3, 3], abs=0.02)
    (row,) = json.loads((recorded / "run" / "metrics.json").read_text())["poses"]
    assert row["outline_mm"]["sysid"] < 0.5


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("data.poses.beam.frames=[0,9]", "name 9, but"),
        ("data.poses.beam.material=hard", "materials lacks 'hard'"),
        (
            "identify.parameters.youngs_modulus={lower:1e4,upper:1e6,per:trial,prior:{mean:2e5,deviation:1e5}}",
            "take material",
        ),
        ("data.test=[beam]", "which is in data.train as well"),
        ("identify=null", "identify is null, but data.kind is pictures"),
        ("identify.parameters.gravity_tilt_1.per=session", "pictures have all, material, lens and trial"),
        ("identify.parameters.colour={lower:0,upper:1}", "identify.parameters names 'colour': choose from"),
        ("data.lens.file=calibration.yaml", "give one of them, a calibration or the matrix"),
        ("data.poses.beam.points=tracked.csv", "points is empty, and data.poses.beam has some: give their places"),
        ("data.simulated={place:[0,0,1],looks_at:[0,0,0]}", "data.folder is set: set data.simulated to null"),
    ],
)
def test_bad_input_gets_a_sentence(recorded, change, sentence):
    assert sentence in refusal(*RECORDED, change)


def test_a_kept_back_material_is_refused():
    other = "data.poses.other={folder:other,material:hard}"
    with pytest.raises(InputError, match="test has a pose of hard, of which no pose is in"):
        settings(
            "experiment=camera_silicone",
            "data.folder=x",
            other,
            "data.materials.hard={}",
            "data.test=[twist_red,other]",
        )


def test_a_limit_leaves_out_poses():
    values = composed("experiment=camera_simulated", "budget=quick")
    run = parse(RunSettings, values)
    assert run.pictures.train == ("level",)
    assert [*run.pictures.poses] == ["level", "upwards"]
    quick = settings("experiment=camera_silicone", "data.folder=x", "budget=quick").pictures
    assert [*quick.poses] == ["hammer_blue"]  # the twisted pose is of the other material


def test_noise_of_a_simulated_outline():
    """Its standard deviation across the outline is the given one, and no part of the body is lost."""
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

    better = picture_verdict([result(0.5, 2.0, True), result(9.0, 1.0, False)])
    assert "no better" not in better
    assert "0.500" in better
    assert "hardly depend on it" in picture_verdict([result(0.95, 1.0, True)])
    assert "no better than what needs none" in picture_verdict([result(1.5, 1.0, True)])
    assert "(none was kept back)" in picture_verdict([result(0.5, 2.0, False)])
    away = replace(result(0.5, 2.0, True), overlap=dict.fromkeys(("undeformed", "simulation", "sysid"), 0.1))
    assert "a is hardly seen where it was simulated" in picture_verdict([away])
