"""Markers in the pictures of a camera: the pinhole's equation, its derivative, and Young's modulus from pixels."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import warp_resphys as wr
from warp_resphys.data.camera import CameraMarkers

MESH = wr.box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(5, 1, 1))
TIP = wr.select_vertices(MESH, x=0.1)
PLACES = np.array([[0.1, 0.01, 0.022], [0.06, 0.01, 0.022], [0.1, 0.022, 0.01]])
MARKERS = wr.bind_markers(MESH, PLACES, ["a", "b", "c"])
FOCAL, CENTRE = 900.0, (320.0, 240.0)  # px
TURN = Rotation.from_euler("xyz", [90.0, 20.0, 5.0], degrees=True).as_matrix()
SHIFT = np.array([-0.05, 0.02, 0.4])  # m: the camera stands 0.4 m away


def camera(markers=MARKERS):
    intrinsic = np.array([[FOCAL, 0.0, CENTRE[0]], [0.0, FOCAL, CENTRE[1]], [0.0, 0.0, 1.0]])
    return CameraMarkers(markers, torch.as_tensor(intrinsic @ np.column_stack([TURN, SHIFT])))


def beam(youngs_modulus):
    body = wr.Body(MESH, fixed=wr.select_vertices(MESH, x=0.0))
    return wr.Simulator(body, wr.Corotated(youngs_modulus, 0.45, stiffness_damping=3e-3), time_step=0.01)


def let_go(noise=0.0):
    """Pixels of a beam that is pulled at its tip and let go."""
    force = torch.zeros(1, len(MESH.vertices), 3, dtype=torch.float64)
    force[:, TIP, 2] = -0.1 / len(TIP)
    resting = wr.Inputs(external_force=force)
    robot = beam(264e3)
    q = robot.rollout(robot.static_equilibrium(resting), 25).q
    pixels = torch.stack([camera()(positions) for positions in q])
    pixels = pixels + noise * torch.as_tensor(np.random.default_rng(0).normal(size=pixels.shape))
    return wr.ObservedMotion(pixels, resting=resting, observation=camera())


def test_a_marker_is_at_its_pinhole_projection():
    shown = camera()(torch.as_tensor(MESH.vertices)[None])[0].numpy()
    x, y, z = (PLACES @ TURN.T + SHIFT).T
    np.testing.assert_allclose(shown, np.column_stack([FOCAL * x / z, FOCAL * y / z]) + CENTRE, rtol=1e-12)


def test_the_derivative_is_that_of_differences():
    sees, at = camera(), torch.as_tensor(MESH.vertices)[None]
    way = torch.as_tensor(np.random.default_rng(1).normal(size=at.shape))
    numeric = (sees(at + 1e-6 * way) - sees(at - 1e-6 * way)).flatten() / 2e-6
    torch.testing.assert_close(sees.transposed_jacobian(at)[0].T @ way.flatten(), numeric, rtol=1e-7, atol=1e-5)


def test_youngs_modulus_is_recovered_from_pixels():
    # A hundred and fifty numbers with noise of a pixel, while the tip moves by some twenty.
    result = wr.identify(beam(180e3), let_go(noise=1.0), {"youngs_modulus": (1e5, 1e6)})
    assert result.parameters["youngs_modulus"] == pytest.approx(264e3, rel=0.02)
    exact = wr.identify(beam(180e3), let_go(), {"youngs_modulus": (1e5, 1e6)})
    assert exact.parameters["youngs_modulus"] == pytest.approx(264e3, rel=1e-4)


def test_forces_are_reconstructed_from_pixels():
    wrong, motion = beam(200e3), let_go()
    samples = wr.reconstruct(wrong, motion)
    uncorrected = float(wr.evaluate(wrong, motion)[1:].mean())
    forces = samples.outputs[0]
    corrected = float(wr.evaluate(wrong, motion, lambda state, step: forces[step : step + 1])[1:].mean())
    assert uncorrected > 2.0  # px
    assert corrected < 0.1 * uncorrected


def test_a_marker_behind_the_camera_is_not_seen_and_spoils_no_gradient():
    # The camera looks from the middle of the beam along it: the markers at the tip are in front, the other is behind.
    looks = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    matrix = np.diag([FOCAL, FOCAL, 1.0]) @ np.column_stack([looks, -looks @ [0.08, 0.01, 0.0]])
    sees, at = CameraMarkers(MARKERS, torch.as_tensor(matrix)), torch.as_tensor(MESH.vertices)[None]
    q = at.clone().requires_grad_(True)
    shown = sees(q)
    assert shown.isnan().any(-1)[0].tolist() == [False, True, False]
    sees.residual(shown, torch.where(shown.isnan(), shown, 0.0).detach()).square().sum().backward()
    assert q.grad.isfinite().all()
    assert sees.transposed_jacobian(at).isfinite().all()


def test_bad_input_is_named():
    with pytest.raises(wr.InputError, match=r"matrix has shape \(3, 3\)"):
        CameraMarkers(MARKERS, torch.eye(3))
    with pytest.raises(wr.InputError, match=r"\(time, motion, point, 2\) in px"):
        wr.ObservedMotion(torch.zeros(3, 1, 3, 3), observation=camera())
