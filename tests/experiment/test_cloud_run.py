"""A material from a simulated depth camera, from a scan, and from two cameras with lenses of their own."""

import json

import meshio
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

import warp_resphys as wr
from support.command_line import outcome, refusal
from support.main_job import IN_RUN
from warp_resphys.data.camera import Lens, PlacedCamera
from warp_resphys.experiment.pictures.laboratory import depth_image, noisy_mask
from warp_resphys.mesh.mesh import boundary_triangles, box_tetrahedra
from warp_resphys.pictures.outlines import ClosedSurface

QUIET = ["hydra/job_logging=none", "hydra/hydra_logging=none"]
COARSE = [
    "mesh.boxes=[[[0.0,0.0,0.0],[0.12,0.03,0.03]]]",
    "mesh.size=0.03",
    "data.lens.matrix=[[450,0,320],[0,450,180],[0,0,1]]",
]
PLAYED = [
    "experiment=depth_simulated",
    *COARSE,
    "data.simulated.material.youngs_modulus=120.0e3",
    "data.simulated.size=[640,360]",
    *QUIET,
]
SIZE = (640, 360)


def identified_in(folder):
    return json.loads((folder / "identification.json").read_text())["sysid"]


@pytest.mark.slow
def test_the_modulus_of_a_simulated_laboratory_comes_back_from_depths(folder):
    result = outcome(*PLAYED, IN_RUN)
    assert result.code == 0, result.err
    depth = np.asarray(Image.open(folder / "run" / "recordings" / "level" / "00_depth.png"))
    assert 300 < depth[depth > 0].min() < depth.max() < 700  # mm
    identified = identified_in(folder / "run")
    modulus, deviation = (
        own["youngs_modulus"] for own in (identified["parameters"], identified["uncertainty"]["deviation"])
    )
    assert modulus == pytest.approx(120e3, rel=0.05)  # the simulator to correct has 200 kPa
    assert abs(modulus - 120e3) < 4.0 * deviation
    (tested,) = [row for row in json.loads((folder / "run" / "metrics.json").read_text())["poses"] if row["tested"]]
    assert tested["outline_mm"]["sysid"] is None
    assert tested["cloud_mm"]["sysid"] < 0.8  # the noise of 1 mm has a mean of 0.8 mm, along the line of sight
    assert tested["cloud_mm"]["sysid"] < min(tested["cloud_mm"][own] for own in ("simulation", "undeformed"))
    assert "Distance of clouds" in result.out
    assert (folder / "run" / "figures" / "clouds.png").stat().st_size > 1e4
    assert not (folder / "run" / "figures" / "outlines.png").exists()


MESH = box_tetrahedra((0.12, 0.03, 0.03), (4, 1, 1))
RECORDED = [
    "experiment=camera_simulated",
    *COARSE,
    "data.folder=recorded",
    "data.simulated=null",
    "data.poses=null",
    "data.train=[beam]",
    "data.test=[]",
    "identify.parameters.camera_shift_1.per=trial",
    *QUIET,
    IN_RUN,
]
SCANNED = [*RECORDED, "+data.poses={beam:{folder:beam,mesh:mesh.vtk,cloud:scan.ply,outline:false}}"]
FILMED = [*RECORDED, "+data.poses={beam:{folder:beam,mesh:mesh.vtk}}"]


@pytest.fixture
def beam(folder):
    """The folder of a hanging beam of 120 kPa, with its mesh, and its surface at rest."""
    pose = folder / "recorded" / "beam"
    pose.mkdir(parents=True)
    meshio.write(pose / "mesh.vtk", meshio.Mesh(MESH.vertices, [("tetra", MESH.cells)]))
    mesh = box_tetrahedra((0.12, 0.03, 0.03), (4, 1, 1), 2)
    body = wr.Body(mesh, fixed=wr.select_vertices(mesh, x=0.0))
    simulator = wr.Simulator(body, wr.Corotated(120e3, 0.49, density=1100.0), gravity=(0.0, -9.81, 0.0))
    return pose, simulator.static_equilibrium().q[0], boundary_triangles(mesh)


@pytest.mark.slow
def test_a_scan_in_axes_of_its_own(beam, folder):
    """A surface in mm, turned by a known and by an unknown rotation, of a folder without a camera."""
    pose, q, triangles = beam
    known, unknown = Rotation.from_euler("xyz", (1.0, 2.0, -0.5)), Rotation.from_rotvec((0.05, -0.1, 0.08))
    points = unknown.apply(q.numpy()) + (0.01, 0.02, -0.01)
    points = known.apply(points) + (0.4, 0.3, 0.2)
    trimesh.Trimesh(1e3 * points, triangles, process=False).export(pose / "scan.ply")
    world_to_cloud = np.eye(4)
    world_to_cloud[:3, :3], world_to_cloud[:3, 3] = known.as_matrix(), (0.4, 0.3, 0.2)
    (pose / "camera.json").write_text(json.dumps({"world_to_cloud": world_to_cloud.tolist()}))
    assert "check the unit (data.cloud.units of a scan" in refusal(*SCANNED)
    in_mm = [*SCANNED, "data.cloud.units=mm"]
    result = outcome(*in_mm)
    assert result.code == 0, result.err
    identified = identified_in(folder / "run")
    assert identified["parameters"]["youngs_modulus"] == pytest.approx(120e3, rel=0.03)
    assert "focal_factor" not in identified["parameters"]
    (row,) = json.loads((folder / "run" / "metrics.json").read_text())["poses"]
    assert row["cloud_mm"]["sysid"] < 0.1
    assert row["cloud_mm"]["sysid"] < 0.2 * row["cloud_mm"]["undeformed"]
    assert "Cloud of points" not in result.err
    (pose / "camera.json").unlink()  # Then the scan is 0.5 m away from where it is said to be.
    assert "of its 20000 points are close enough to the clamp" in refusal(*in_mm)


def film(beam, factor):
    """Two cameras, on the left with depths and on the right with an outline and a longer lens than is assumed."""
    pose, q, triangles = beam
    surface, clamp = ClosedSurface.of(triangles), torch.tensor([0.0, 0.015, 0.015])
    matrix = torch.tensor([[450.0, 0.0, 320.0], [0.0, 450.0, 180.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    frames = []
    for lens, angle, own in (("left", -0.5, 1.0), ("right", 0.4, factor)):
        looking = np.diag([1.0, -1.0, -1.0, 1.0])
        looking[:3, :3] = Rotation.from_euler("x", angle).as_matrix() @ looking[:3, :3]
        looking[:3, 3] = np.array([0.0, 0.0, 0.35]) - looking[:3, :3] @ (0.06, 0.0, 0.015)
        camera = PlacedCamera(Lens(matrix), looking, clamp)
        corrections = camera.corrections({"focal_factor": own})
        pixels, deep = camera.pixels(q, corrections).numpy(), camera.seen_from(q, corrections)[:, 2].numpy()
        mask = noisy_mask(surface.region(pixels), SIZE, 0.0, np.random.default_rng(0))
        Image.fromarray(mask).save(pose / f"{lens}.png")
        frames.append(
            {"image": f"{lens}.png", "mask": f"{lens}.png", "lens": lens, "world_to_camera": looking.tolist()}
        )
        if lens == "left":
            depth = depth_image(pixels[triangles], deep[triangles], SIZE)
            np.save(pose / "left.npy", np.where(mask, depth, 1.5))  # m: a wall behind the body
            frames[-1]["depth"] = "left.npy"
    (pose / "camera.json").write_text(json.dumps({"frames": frames}))
    matrix = "{matrix:[[450,0,320],[0,450,180],[0,0,1]]}"
    return ["~data.lens", f"+data.lens={{left:{matrix},right:{matrix}}}"]


@pytest.mark.slow
def test_two_cameras_have_a_lens_each(beam, folder):
    lenses = film(beam, 1.02)
    result = outcome(*FILMED, *lenses)
    assert result.code == 0, result.err
    identified = identified_in(folder / "run")["parameters"]
    assert identified["youngs_modulus"] == pytest.approx(120e3, rel=0.04)
    assert identified["focal_factor@right"] - identified["focal_factor@left"] == pytest.approx(0.02, abs=6e-3)
    cameras = json.loads((folder / "run" / "identification.json").read_text())["cameras"]["beam"]
    assert {*cameras} == {"left", "right"}
    (row,) = json.loads((folder / "run" / "metrics.json").read_text())["poses"]
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
            "no outline, no points, no scan and no depth",
        ),
        (["~data.lens.left"], "frame 0 has the lens 'left', and data.lens has the names 'right'"),
        (["~data.lens", "+data.lens=null"], "data.lens is not set, and"),
        (["+data.lens.beam={file:a.yaml}"], "data.poses and data.lens both have 'beam': rename one"),
        (["identify.parameters.youngs_modulus.per=lens"], "per is lens, and is not of a camera"),
    ],
)
def test_bad_input_of_clouds_and_lenses_gets_a_sentence(beam, changes, sentence):
    assert sentence in refusal(*FILMED, *film(beam, 1.0), *changes)
