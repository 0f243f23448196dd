"""Cameras: the pinhole's equation, corrections, derivatives,
points from depths, Young's modulus from pixels; views.
"""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import warp_resphys as wr
from support.refusals import refuses
from support.slopes import differences
from warp_resphys.core.stepping.rotations import rotations
from warp_resphys.data.camera import (
    CameraMarkers,
    Lens,
    PlacedCamera,
    axes_from_below,
    motion_axes,
    path_axes,
)

X, Y, Z = np.eye(3)
DOWN = np.array([0.0, 0.0, -9.8])
MESH = wr.box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(5, 1, 1))
TIP = wr.select_vertices(MESH, x=0.1)
PLACES = np.array([[0.1, 0.01, 0.022], [0.06, 0.01, 0.022], [0.1, 0.022, 0.01]])
MARKERS = wr.bind_markers(MESH, PLACES, ["a", "b", "c"])
FOCAL, CENTRE = 900.0, (320.0, 240.0)  # px
TURN = Rotation.from_euler("xyz", [90.0, 20.0, 5.0], degrees=True).as_matrix()
SHIFT = np.array([-0.05, 0.02, 0.4])  # m: the camera stands 0.4 m away


def camera(turn=TURN, shift=SHIFT):
    intrinsic = torch.tensor(
        [[FOCAL, 0.0, CENTRE[0]], [0.0, FOCAL, CENTRE[1]], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
    pose = np.block([[turn, shift[:, None]], [np.zeros(3), 1.0]])
    return CameraMarkers(MARKERS, PlacedCamera(Lens(intrinsic), torch.as_tensor(pose)))


def beam(youngs_modulus):
    body = wr.Body(MESH, fixed=wr.select_vertices(MESH, x=0.0))
    return wr.Simulator(
        body, wr.Corotated(youngs_modulus, 0.45, stiffness_damping=3e-3), time_step=0.01
    )


def let_go(noise=0.0):
    """Pixels of a beam that is pulled at its tip and let go."""
    force = torch.zeros(1, len(MESH.vertices), 3, dtype=torch.float64)
    force[:, TIP, 2] = -0.1 / len(TIP)
    resting = wr.Inputs(external_force=force)
    robot = beam(264e3)
    q = robot.rollout(robot.static_equilibrium(resting), 25).q
    pixels = torch.stack([camera()(positions) for positions in q])
    pixels = pixels + noise * torch.as_tensor(np.random.default_rng(0).normal(size=pixels.shape))
    return wr.ObservedMotions.of(beam(264e3), pixels, resting=resting, observation=camera())


def test_a_marker_is_at_its_pinhole_projection_and_behind_the_camera_not_seen():
    shown = camera()(torch.as_tensor(MESH.vertices)[None])[0].numpy()
    x, y, z = (PLACES @ TURN.T + SHIFT).T
    np.testing.assert_allclose(
        shown, np.column_stack([FOCAL * x / z, FOCAL * y / z]) + CENTRE, rtol=1e-12
    )
    # The camera looks from the middle of the beam along it: the markers at the tip are in front,
    # the other is behind.
    looks = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    sees, at = camera(looks, -looks @ [0.08, 0.01, 0.0]), torch.as_tensor(MESH.vertices)[None]
    q = at.clone().requires_grad_(True)
    shown = sees(q)
    assert shown.isnan().any(-1)[0].tolist() == [False, True, False]
    sees.residual(shown, torch.where(shown.isnan(), shown, 0.0).detach()).square().sum().backward()
    assert q.grad.isfinite().all()
    assert sees.transposed_jacobian(at).isfinite().all()


def test_youngs_modulus_is_recovered_from_pixels():
    # A hundred and fifty numbers with noise of a pixel, while the tip moves by some twenty.
    result = wr.identify(beam(180e3), let_go(noise=1.0), {"youngs_modulus": (1e5, 1e6)})
    assert result.parameters["youngs_modulus"] == pytest.approx(264e3, rel=0.02)
    exact = wr.identify(beam(180e3), let_go(), {"youngs_modulus": (1e5, 1e6)})
    assert exact.parameters["youngs_modulus"] == pytest.approx(264e3, rel=1e-4)


def test_bad_input_is_named():
    lens, pose = Lens(torch.eye(3)), torch.eye(4)
    refuses(wr.InputError, r"shape \(3, 4\)", PlacedCamera, lens, pose[:3])
    with pytest.raises(wr.InputError, match="no rotation with a shift"):
        PlacedCamera(lens, pose * torch.tensor([[-1.0], [1.0], [1.0], [1.0]]))
    with pytest.raises(wr.InputError, match=r"\(time, motion, point, 2\) in px"):
        wr.ObservedMotions.of(beam(264e3), torch.zeros(3, 1, 3, 3), observation=camera())


OPENCV = """%YAML:1.0
---
calibration_time: "Thu Nov 26 2026"
image_width: 640
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 900., 0., 320., 0., 910., 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 1.0000000000000001e-01, -2.0e-01, 1.0e-03, -2.0e-03,
       3.0e-01 ]
avg_reprojection_error: 3.2e-01
"""


def test_a_lens_is_read_and_distorts_as_opencv_does(tmp_path):
    (tmp_path / "camera.yaml").write_text(OPENCV)
    lens = Lens.read(tmp_path / "camera.yaml")
    points = torch.tensor([[0.1, -0.2, 1.0], [0.3, 0.4, 2.0], [0.0, 0.0, 0.5]], dtype=torch.float64)
    x, y = (points[:, :2] / points[:, 2:]).T.numpy()
    square = x**2 + y**2
    radial = 1.0 + 0.1 * square - 0.2 * square**2 + 0.3 * square**3
    moved_x = x * radial + 2e-3 * x * y - 2e-3 * (square + 2.0 * x**2)
    moved_y = y * radial + 1e-3 * (square + 2.0 * y**2) - 4e-3 * x * y
    expected = np.column_stack([900.0 * moved_x + 320.0, 910.0 * moved_y + 240.0])
    np.testing.assert_allclose(lens.pixels(points), expected, rtol=1e-12)
    rational = Lens(
        lens.matrix, torch.tensor([0.1, -0.2, 1e-3, -2e-3, 0.3, 0.5, 0.0, 0.0], dtype=torch.float64)
    )
    tangential = Lens(lens.matrix, torch.tensor([0.0, 0.0, 1e-3, -2e-3], dtype=torch.float64))
    grown = rational.pixels(points)[0] - tangential.pixels(points)[0]
    share = (radial / (1.0 + 0.5 * square) - 1.0)[0]
    np.testing.assert_allclose(grown, share * np.array([900.0 * x[0], 910.0 * y[0]]), rtol=1e-9)


def test_rays_are_the_inverse_of_pixels():
    intrinsic = torch.tensor(
        [[FOCAL, 2.0, CENTRE[0]], [0.0, 880.0, CENTRE[1]], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
    pixels = torch.tensor([[0.0, 0.0], [639.0, 479.0], [300.0, 250.0]], dtype=torch.float64)
    for distortion in (None, torch.tensor([-0.3, 0.1, 2e-3, 1e-3], dtype=torch.float64)):
        lens = Lens(intrinsic, distortion)
        rays = lens.rays(pixels)
        assert rays[:, 2].tolist() == [1.0, 1.0, 1.0]
        torch.testing.assert_close(lens.pixels(rays), pixels, rtol=0.0, atol=1e-8)
    beyond = Lens(intrinsic, torch.tensor([-0.4, 0.0, 0.0, 0.0], dtype=torch.float64)).rays(
        pixels + 3000.0
    )
    assert beyond[:, :2].isnan().all()  # where the lens cannot be undistorted


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("a: 1", wr.DataFileError, "has no camera_matrix of nine numbers"),
        ("camera_matrix: {data: [a]}", wr.DataFileError, "is no YAML with numbers"),
        ("[", wr.DataFileError, "is no YAML"),
        (
            "camera_matrix: [1, 0, 2, 0, 3, 4, 0, 0, 1]\nD: [1, 2]",
            wr.InputError,
            "give k1, k2, p1, p2",
        ),
    ],
)
def test_files_without_a_calibration_are_said(text, error, words, tmp_path):
    (tmp_path / "camera.yaml").write_text(text)
    refuses(error, words, Lens.read, tmp_path / "camera.yaml")
    refuses(wr.DataFileError, "Cannot read", Lens.read, tmp_path / "none.yaml")


MATRIX = torch.tensor(
    [[900.0, 0.0, 320.0], [0.0, 880.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64
)
LENS = Lens(MATRIX, torch.tensor([-0.12, 0.05, 1e-3, -2e-3], dtype=torch.float64))
POSE = torch.eye(4, dtype=torch.float64)
POSE[:3, :3] = rotations(torch.tensor([2.9, 0.2, -0.1], dtype=torch.float64))
POSE[:3, 3] = torch.tensor([0.02, -0.01, 0.5])
MIDDLE = torch.tensor([0.05, 0.0, 0.01], dtype=torch.float64)
PLACED = PlacedCamera(LENS, POSE, MIDDLE)
POINTS = 0.08 * torch.as_tensor(np.random.default_rng(0).normal(size=(7, 3)))
MOVED = {
    "camera_shift_2": 0.01,
    "camera_turn_1": 0.2,
    "camera_turn_3": -0.1,
    "focal_factor": 1.05,
    "principal_point_1": 8.0,
}


def test_derivatives_by_motions_and_corrections_are_those_of_differences():
    corrections = PLACED.corrections(MOVED)
    tangents = torch.as_tensor(np.random.default_rng(1).normal(size=(3, 7, 3)))
    slopes = PLACED.derivative(POINTS, corrections, tangents)
    step = 1e-6
    for number in range(3):
        ends = [PLACED.pixels(POINTS + by * tangents[number], corrections) for by in (step, -step)]
        assert torch.allclose(
            slopes[number], (ends[0] - ends[1]) / (2.0 * step), rtol=1e-6, atol=1e-5
        )
    by_correction = differences(
        lambda own: PLACED.pixels(POINTS, torch.as_tensor(own)), corrections.numpy(), step
    )
    assert torch.allclose(slopes[3:], torch.stack(by_correction), rtol=1e-6, atol=1e-5)


def test_corrections_mean_what_their_names_say():
    """In words of a pinhole camera without distortion that looks along the scene's axes."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 0.5
    camera = PlacedCamera(Lens(MATRIX), pose, MIDDLE)
    point = MIDDLE + torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)
    plain = camera.pixels(point, camera.corrections({}))
    assert plain.tolist() == pytest.approx([320.0 + 900.0 * 0.15 / 0.51, 240.0])
    shifted = camera.pixels(
        point, camera.corrections({"camera_shift_1": 0.01, "camera_shift_3": -0.01})
    )
    assert shifted.tolist() == pytest.approx([320.0 + 900.0 * 0.16 / 0.5, 240.0])
    # A quarter turn about z takes the point from x to y of the turn's centre.
    turned = camera.pixels(point, camera.corrections({"camera_turn_3": math.pi / 2.0}))
    assert turned.tolist() == pytest.approx(
        [320.0 + 900.0 * 0.05 / 0.51, 240.0 + 880.0 * 0.1 / 0.51]
    )
    lens = camera.pixels(point, camera.corrections({"focal_factor": 1.1, "principal_point_2": 5.0}))
    assert lens.tolist() == pytest.approx([320.0 + 990.0 * 0.15 / 0.51, 245.0])


def test_located_points_are_those_that_are_seen():
    """From pixels and depths through a distorted lens,
    and from the axes of a scan, with derivatives.
    """
    corrections = PLACED.corrections(MOVED)
    depth = PLACED.seen_from(POINTS, corrections)[:, 2:]
    measured = torch.cat([PLACED.pixels(POINTS, corrections), depth], 1)
    scanner = PlacedCamera(None, POSE, MIDDLE)
    for camera, own in ((PLACED, measured), (scanner, scanner.seen_from(POINTS, corrections))):
        assert torch.allclose(camera.located(own, corrections), POINTS, atol=1e-9)

        def located(by, camera=camera, own=own):
            return camera.located(own, torch.as_tensor(by))

        slopes = differences(located, corrections.numpy(), 1e-6)
        assert torch.allclose(
            camera.located_by(own, corrections), torch.stack(slopes), rtol=1e-6, atol=1e-8
        )


@pytest.mark.parametrize("plane", [(X, Y), (X, -Y), (Y, X), (X, Z), (-Y, Z), (X, Y + Z)])
@pytest.mark.parametrize("gravity", [-9.81 * Z, np.zeros(3)])
def test_letters_can_be_read_and_what_is_up_is_above(plane, gravity):
    axes = path_axes(np.stack(plane), gravity)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    right, up = (axes[:2] @ direction for direction in plane)
    assert right[0] > 0.9  # Neither mirrored nor turned:
    assert up[1] > 0.5
    assert right[0] * up[1] - right[1] * up[0] > 0.5
    assert axes[1] @ Z > 0.3


def test_the_free_end_is_on_the_right_and_gravity_down():
    rest = wr.box_hexahedra(divisions=(4, 1, 1)).vertices
    bent = rest + np.linspace(0.0, 0.1, 10)[:, None, None] * rest[:, :1] * [0.0, 0.0, -1.0]
    axes = motion_axes(DOWN, bent)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert axes[0, 0] > 0.9
    assert axes[1, 2] > 0.9
    assert motion_axes(DOWN, bent * [-1.0, 1.0, 1.0])[0, 0] < -0.9
    assert motion_axes(DOWN, bent[..., [2, 1, 0]] * [1.0, 1.0, -1.0])[1, 2] > 0.9
    assert np.isfinite(motion_axes(np.zeros(3), bent)).all()
    below = axes_from_below(axes, DOWN)
    np.testing.assert_allclose(below[[0, 2]], [axes[0], [0.0, 0.0, -1.0]], atol=1e-12)
    assert np.linalg.det(below) == pytest.approx(1.0)
    np.testing.assert_array_equal(axes_from_below(axes, np.zeros(3)), below)
