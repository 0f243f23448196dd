"""Poses of rigid bodies as four points: their weights, conversion, mountings, and derivatives against differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from support.configured import settings
from warp_resphys import DataFileError, bind_markers, read_recording
from warp_resphys.data.rigid_bodies import angles, arms, as_markers, corners_of, owners, with_axes, with_corners
from warp_resphys.experiment.build import bound_markers, build_body, nominal_places
from warp_resphys.studies.gradient_check import central_difference

LENGTH = 0.06
TURNS = Rotation.from_rotvec(np.random.default_rng(0).normal(size=(4, 3)))
PLACES = np.random.default_rng(1).normal(size=(4, 3))
LABELS = ["plate +++", "plate +--", "plate -+-", "plate --+"]


def corners(places, turns, length=LENGTH):
    """(T, 4, 3) the points of poses [m]."""
    return places[:, None] + arms(length) @ np.swapaxes(turns.as_matrix(), 1, 2)


def table(folder, rows, columns="plate.x,plate.y,plate.z,plate.qw,plate.qx,plate.qy,plate.qz,tip.x,tip.y,tip.z"):
    """Writes a table in mm and returns its path."""
    path = folder / "poses.csv"
    lines = [",".join(f"{value:.12g}" if value is not None else "" for value in row) for row in rows]
    heads = [f"{name} [mm]" if name[-1] in "xyz" and ".q" not in name else name for name in columns.split(",")]
    path.write_text("\n".join([",".join(["time [s]", *heads]), *lines]))
    return path


def recorded(folder):
    """The poses as a recording of a table, the third of which was not seen."""
    quaternions, tip = TURNS.as_quat()[:, [3, 0, 1, 2]], [1.0, 2.0, 3.0]
    rows = [[0.01 * n, *1e3 * PLACES[n], *quaternions[n], *tip] for n in range(4)]
    rows[2][1:8] = [None] * 7
    return read_recording(table(folder, rows))


@pytest.mark.parametrize("angle", [0.01, 2.0])
def test_points_weigh_an_angle_by_the_length_about_any_axis(angle):
    """1/4 sum |dx|^2 = |dp|^2 + L^2 (2 sin w/2)^2."""
    for axis in np.random.default_rng(2).normal(size=(5, 3)):
        turned = TURNS * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
        moved = np.array([1e-3, -2e-3, 5e-4])
        error = corners(PLACES + moved, turned) - corners(PLACES, TURNS)
        expected = moved @ moved + LENGTH**2 * (2.0 * np.sin(angle / 2.0)) ** 2
        np.testing.assert_allclose(np.square(error).sum(-1).mean(-1), expected, rtol=1e-12)
        np.testing.assert_allclose(angles(corners(PLACES, TURNS), corners(PLACES, turned)), angle, rtol=1e-9)


def test_a_recorded_pose_becomes_four_points(tmp_path):
    recording = with_corners(recorded(tmp_path), {"plate": LENGTH})
    points = recording.select(LABELS)
    seen = [0, 1, 3]
    np.testing.assert_allclose(points.positions[seen], corners(PLACES, TURNS)[seen], atol=1e-9)
    assert np.isnan(points.positions[2]).all()
    back = with_axes(points, {"plate": LENGTH})
    names = ["plate", "plate +x", "plate +y", "plate +z"]
    assert back.labels == tuple(names)
    np.testing.assert_allclose(back.positions, recording.select(names).positions, atol=1e-12)


def test_a_marker_is_no_rigid_body(tmp_path):
    recording = recorded(tmp_path)
    with pytest.raises(DataFileError, match=r"'tip' is a marker without an orientation: export it as a rigid body"):
        with_corners(recording, {"tip": LENGTH})
    with pytest.raises(DataFileError, match=r"has no rigid body 'cap': it has 'plate'; name it in markers\.rigid"):
        with_corners(recording, {"cap": LENGTH})
    with pytest.raises(DataFileError, match=r"has no rigid body 'Plate', did you mean 'plate'\?"):
        with_corners(recording, {"Plate": LENGTH})
    still = replace(recording, rest=recording.positions[0])
    np.testing.assert_allclose(
        with_corners(still, {"plate": LENGTH}).select(LABELS).rest, corners(PLACES, TURNS)[0], atol=1e-9
    )


def test_a_rigid_body_counts_as_one_marker():
    labels = ["A", *LABELS, "B"]
    points = np.random.default_rng(3).normal(size=(2, 6, 3))
    assert owners(labels) == ("A", "plate", "B")
    assert corners_of(labels) == {"plate": slice(1, 5)}
    expected = np.stack([points[:, 0], points[:, 1:5].mean(1), points[:, 5]], axis=1)
    np.testing.assert_allclose(as_markers(points, labels), expected)
    np.testing.assert_allclose(as_markers(points[..., 0], labels, -1), expected[..., 0])
    assert as_markers(points, list("ABCDEF")) is points


def capped():
    """The configuration of a beam with a rigid cap, with two rigid bodies beside its markers, and its mesh."""
    bodies = "{plate: {part: cap}, face: {at: {x: 0.1}, orientation_deviation: 2.0}}"
    run = settings("experiment=beam_regions", "mesh.divisions=[5,2,2]", f"markers.rigid_bodies={bodies}")
    return run.markers, build_body(run).mesh


def deformed(mesh):
    """(2, N, 3) a bent and shaken mesh whose cap is not quite rigid [m]."""
    x, y, z = torch.as_tensor(mesh.vertices).unbind(-1)
    shaken = 1e-4 * torch.randn(2, len(x), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    radius, angle = 0.08 - z, x / 0.08
    return torch.stack([radius * torch.sin(angle), y, 0.08 - radius * torch.cos(angle)], -1) + shaken


def test_rigid_bodies_follow_the_rigid_motion_of_their_part():
    """Also far from the body, beyond the distance that markers may have; markers are bound as without them."""
    markers, mesh = capped()
    nominal = nominal_places(markers, mesh)
    centre = mesh.vertices[mesh.vertices[:, 0] > 0.07].mean(axis=0)
    np.testing.assert_allclose(nominal[3:7], centre + arms(markers.rigid_bodies["plate"].length))
    mounted = nominal + np.array([[0.0]] * 3 + [[0.2]] * 8)
    bound = bound_markers(markers, mesh, mounted, markers.observed)
    rest = torch.as_tensor(mesh.vertices)[None]
    np.testing.assert_allclose(bound(rest)[0], mounted, atol=1e-12)
    turn = torch.as_tensor(TURNS[0].as_matrix())
    np.testing.assert_allclose(bound(rest @ turn.T + 0.3)[0], mounted @ turn.numpy().T + 0.3, atol=1e-12)
    tips = list(markers.tracked)
    alone = bind_markers(mesh, mounted[:3], tips, kind="rigid", vertices=np.flatnonzero(mesh.vertices[:, 0] == 0.1))
    q = deformed(mesh)
    np.testing.assert_allclose(bound(q)[:, :3], alone(q), atol=1e-15)
    by = torch.randn(11, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    np.testing.assert_allclose(bound.moved(by)(rest)[0], mounted + by.numpy(), atol=1e-12)


def test_derivatives_of_the_errors_of_a_rigid_body():
    """The misfit of positions and orientations by the positions of all vertices."""
    markers, mesh = capped()
    bound = bound_markers(markers, mesh, nominal_places(markers, mesh) + 0.01, markers.observed)
    q = deformed(mesh)
    direction = 1e-3 * torch.randn(q.shape, generator=torch.Generator().manual_seed(3), dtype=q.dtype)
    measured = bound(q) + 1e-3 * torch.randn(2, 11, 3, generator=torch.Generator().manual_seed(2), dtype=q.dtype)

    def misfit(positions):
        return bound.residual(bound(positions), measured).square().sum()

    x = q.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(misfit(x), x)
    expected, error = central_difference(lambda step: float(misfit(q + step * direction)))
    assert error < 1e-6 * abs(expected)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-6)
    jacobian = bound.transposed_jacobian(q)
    by_residual = 2.0 * bound.residual(bound(q), measured).flatten(1)
    np.testing.assert_allclose((jacobian @ by_residual[..., None])[..., 0].view_as(q), gradient, atol=1e-15)
