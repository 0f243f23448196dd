"""Markers on stems and poses of rigid bodies: at rest, moved, mounted,
and their derivatives against differences.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from support.configured import settings
from warp_resphys import (
    DataFileError,
    InputError,
    box_hexahedra,
    box_tetrahedra,
    read_recording,
    select_vertices,
)
from warp_resphys.core.dynamics.gradient_check import central_difference
from warp_resphys.core.stepping.rotations import closest_rotation, twisted
from warp_resphys.data.markers import KINDS, bind_markers
from warp_resphys.data.rigid_bodies import (
    angles,
    arms,
    as_markers,
    corners_of,
    owners,
    with_axes,
    with_corners,
)
from warp_resphys.experiment.build import bound_markers, build_body, nominal_places

MESHES = {
    "hexahedra": box_hexahedra(divisions=(5, 2, 2)),
    "tetrahedra": box_tetrahedra(divisions=(5, 2, 2)),
    "tetrahedra10": box_tetrahedra(divisions=(5, 2, 2), order=2),
}
MESH = MESHES["hexahedra"]
TIP = select_vertices(MESH, x=0.1)
# Above a face, beside an edge, beyond a corner, sunk in, and on the tip's rim as those of the
# measured beam are.
POINTS = np.array(
    [
        [0.043, 0.012, 0.036],
        [0.103, 0.016, 0.035],
        [0.104, -0.003, 0.034],
        [0.071, 0.0277, 0.011],
        [0.1, 0.015, 0.036],
        [0.1003, -0.006, 0.024],
    ]
)
NAMES = ["above", "edge", "corner", "sunk", "Tip - 1", "Tip - 2"]
MIXED = ["normal", "rigid", "frame", "patch", "rigid", "normal"]


def bind(kind, mesh=MESH):
    return bind_markers(
        mesh, POINTS, NAMES, kind=kind, vertices=select_vertices(mesh, x=0.1), patch=0.03
    )


def bent(rest):
    """(N, 3) the beam bent upwards into an arc of 57 degrees."""
    x, y, z = (rest - rest.new_tensor([0.0, 0.0, 0.015])).unbind(-1)
    radius = 0.1 - z
    angle = x / 0.1
    return torch.stack([radius * torch.sin(angle), y, 0.115 - radius * torch.cos(angle)], -1)


def feet(markers, positions):
    """(B, m, 3) where on the body the stems stand [m]."""
    return replace(markers, offsets=torch.zeros_like(markers.offsets))(positions)


def poses(mesh):
    """(4, N, 3) at rest, bent, twisted by 170 degrees,
    and turned far away, stretched and shaken.
    """
    rest = torch.as_tensor(mesh.vertices)
    turn = torch.as_tensor(Rotation.from_rotvec([2.0, -1.0, 1.5]).as_matrix())
    shaken = torch.rand(rest.shape, generator=torch.Generator().manual_seed(0), dtype=rest.dtype)
    far = (rest * rest.new_tensor([1.2, 0.9, 1.0]) + 1e-3 * shaken) @ turn.T + 0.3
    return torch.stack([rest, bent(rest), twisted(rest, rest.new_tensor([2.97]))[0], far])


@pytest.mark.parametrize(
    ("mesh", "kind"),
    [
        *((MESH, kind) for kind in KINDS),
        (MESHES["tetrahedra"], MIXED),
        (MESHES["tetrahedra10"], MIXED),
    ],
)
def test_markers_are_at_their_measured_places_and_move_with_the_body(mesh, kind):
    markers = bind(kind, mesh)
    rest = torch.as_tensor(mesh.vertices)
    np.testing.assert_allclose(markers(rest[None])[0], POINTS, rtol=0, atol=1e-12)
    rotations = torch.as_tensor(Rotation.random(5, random_state=1).as_matrix())
    shifts = torch.rand(5, 1, 3, dtype=rest.dtype)
    moved = markers(rest @ rotations.mT + shifts)
    np.testing.assert_allclose(
        moved, torch.as_tensor(POINTS) @ rotations.mT + shifts, rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("kind", [*KINDS, MIXED], ids=[*KINDS, "mixed"])
def test_derivatives(kind):
    """At rest, where the square face that the rigid ones follow is symmetric,
    bent, twisted and turned far.
    """
    markers, q = bind(kind), poses(MESH)
    step = 1e-6
    direction = torch.randn(q.shape, generator=torch.Generator().manual_seed(0), dtype=q.dtype)
    expected = (markers(q + step * direction) - markers(q - step * direction)) / (2.0 * step)
    transposed = markers.transposed_jacobian(q)
    assert transposed.shape == (4, q[0].numel(), POINTS.size)
    result = (transposed.mT @ direction.flatten(1)[:, :, None]).view_as(expected)
    np.testing.assert_allclose(result, expected, rtol=0, atol=2e-6)
    along = q.clone().requires_grad_(True)
    weights = torch.randn(expected.shape, generator=torch.Generator().manual_seed(9), dtype=q.dtype)
    (markers(along) * weights).sum().backward()
    assert float((along.grad * direction).sum()) == pytest.approx(
        float((expected * weights).sum()), rel=1e-6
    )


def test_a_stem_along_the_normal_keeps_its_length_and_a_patch_follows_vertices_around_its_foot():
    markers = bind_markers(MESH, POINTS[:1], NAMES[:1], kind="normal")
    q = poses(MESH)
    stem = markers(q) - feet(markers, q)
    np.testing.assert_allclose(stem.norm(dim=-1), 0.006, rtol=0, atol=1e-12)
    corners = q[:, markers.vertices[0]]
    np.testing.assert_allclose(((corners - corners[:, :1]) @ stem.mT).abs().max(), 0.0, atol=1e-15)
    # Barycentric, wherever the body goes.
    weights = torch.linalg.solve(corners.mT, feet(markers, q).mT)[:, :, 0]
    np.testing.assert_allclose(weights, markers.weights.expand(4, -1), rtol=0, atol=1e-9)
    markers = bind_markers(MESH, POINTS[:1], NAMES[:1], kind="patch", patch=0.025)
    near = np.linalg.norm(MESH.vertices - [0.043, 0.012, 0.03], axis=1) <= 0.025
    assert set(markers.vertices.tolist()) == set(np.flatnonzero(near))
    q = poses(MESH)[1:2]
    moved = q.clone()
    moved[:, torch.as_tensor(~near)] += 0.1
    np.testing.assert_array_equal(markers(moved), markers(q))


@pytest.mark.parametrize(
    "spread", [(3.0, 2.0, 1.0), (1.0, 1.0, 0.0), (1.0, 1.0, 1.0), (3.0, 2.0, -1.0)]
)
def test_derivative_of_the_closest_rotation(spread):
    """Also where singular values coincide or vanish,
    as for a square face, and for a mirror image.
    """
    turn = torch.as_tensor(Rotation.random(2, random_state=3).as_matrix())
    matrix = turn[:1] @ torch.diag(torch.tensor(spread, dtype=turn.dtype)) @ turn[1:]
    torch.autograd.gradcheck(closest_rotation, matrix.requires_grad_(True))
    closest = closest_rotation(matrix).detach()
    np.testing.assert_allclose(closest @ closest.mT, np.eye(3)[None], atol=1e-12)


def test_a_diverged_body_has_no_markers_and_does_not_affect_others():
    q = poses(MESH)
    q[1] = torch.nan
    for kind in KINDS:
        at = bind(kind)(q)
        assert at[1].isnan().all()
        assert at[[0, 2, 3]].isfinite().all()


def test_precision_and_vertices():
    markers = bind(MIXED)
    like = torch.zeros(1, dtype=torch.float32)
    single = markers.to(like)(poses(MESH).float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single, markers(poses(MESH)), rtol=0, atol=1e-6)
    assert set(TIP) <= set(markers.vertices.tolist()) <= set(range(len(MESH.vertices)))


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"positions": POINTS + [0.0, 0.0, 0.05]}, "'above'"),
        (
            {"largest_distance": 0.005, "positions": POINTS[[0, 0]], "names": ["a", "b"]},
            "Marker 'a' is 6.0 mm from",
        ),
        (
            {"positions": np.where(np.arange(6)[:, None] == 3, np.nan, POINTS)},
            "Marker 'sunk' was not seen at rest",
        ),
        ({"kind": ["frame"]}, "6 markers are named, with 1 kinds and positions (6, 3)"),
        ({"kind": "rigid", "vertices": [0, 1, 99]}, "Rigid markers follow 3 vertices"),
        (
            {"kind": "rigid", "vertices": [0, 1, 2]},
            "The vertices that rigid markers follow lie on one line",
        ),
        ({"kind": "patch", "patch": 1e-3}, "'above'"),
    ],
)
def test_bad_markers(settings, sentence):
    with pytest.raises(InputError) as error:
        bind_markers(MESH, **{"positions": POINTS, "names": NAMES, **settings})
    assert sentence in str(error.value)


LENGTH = 0.06
TURNS = Rotation.from_rotvec(np.random.default_rng(0).normal(size=(4, 3)))
PLACES = np.random.default_rng(1).normal(size=(4, 3))
LABELS = ["plate +++", "plate +--", "plate -+-", "plate --+"]


def corners(places, turns, length=LENGTH):
    """(T, 4, 3) the points of poses [m]."""
    return places[:, None] + arms(length) @ np.swapaxes(turns.as_matrix(), 1, 2)


def table(
    folder,
    rows,
    columns="plate.x,plate.y,plate.z,plate.qw,plate.qx,plate.qy,plate.qz,tip.x,tip.y,tip.z",
):
    """Writes a table in mm and returns its path."""
    path = folder / "poses.csv"
    lines = [
        ",".join(f"{value:.12g}" if value is not None else "" for value in row) for row in rows
    ]
    heads = [
        f"{name} [mm]" if name[-1] in "xyz" and ".q" not in name else name
        for name in columns.split(",")
    ]
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
        np.testing.assert_allclose(
            angles(corners(PLACES, TURNS), corners(PLACES, turned)), angle, rtol=1e-9
        )


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
    with pytest.raises(
        DataFileError, match=r"'tip' is a marker without an orientation: export it as a rigid body"
    ):
        with_corners(recording, {"tip": LENGTH})
    with pytest.raises(
        DataFileError, match=r"has no rigid body 'cap': it has 'plate'; name it in markers\.rigid"
    ):
        with_corners(recording, {"cap": LENGTH})
    with pytest.raises(DataFileError, match=r"has no rigid body 'Plate', did you mean 'plate'\?"):
        with_corners(recording, {"Plate": LENGTH})
    still = replace(recording, rest=recording.positions[0])
    np.testing.assert_allclose(
        with_corners(still, {"plate": LENGTH}).select(LABELS).rest,
        corners(PLACES, TURNS)[0],
        atol=1e-9,
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
    """The configuration of a beam with a rigid cap,
    with two rigid bodies beside its markers, and its mesh.
    """
    bodies = "{plate: {part: cap}, face: {at: {x: 0.1}, orientation_deviation: 2.0}}"
    run = settings(
        "experiment=beam_regions", "mesh.divisions=[5,2,2]", f"markers.rigid_bodies={bodies}"
    )
    return run.markers, build_body(run).mesh


def deformed(mesh):
    """(2, N, 3) a bent and shaken mesh whose cap is not quite rigid [m]."""
    x, y, z = torch.as_tensor(mesh.vertices).unbind(-1)
    shaken = 1e-4 * torch.randn(
        2, len(x), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    radius, angle = 0.08 - z, x / 0.08
    return (
        torch.stack([radius * torch.sin(angle), y, 0.08 - radius * torch.cos(angle)], -1) + shaken
    )


def test_rigid_bodies_follow_the_rigid_motion_of_their_part():
    """Also far from the body, beyond the distance that markers may have.

    Markers are bound as without them.
    """
    markers, mesh = capped()
    nominal = nominal_places(markers, mesh)
    centre = mesh.vertices[mesh.vertices[:, 0] > 0.07].mean(axis=0)
    np.testing.assert_allclose(nominal[3:7], centre + arms(markers.rigid_bodies["plate"].length))
    mounted = nominal + np.array([[0.0]] * 3 + [[0.2]] * 8)
    bound = bound_markers(markers, mesh, mounted, markers.observed)
    rest = torch.as_tensor(mesh.vertices)[None]
    np.testing.assert_allclose(bound(rest)[0], mounted, atol=1e-12)
    turn = torch.as_tensor(TURNS[0].as_matrix())
    np.testing.assert_allclose(
        bound(rest @ turn.T + 0.3)[0], mounted @ turn.numpy().T + 0.3, atol=1e-12
    )
    tips = list(markers.tracked)
    alone = bind_markers(
        mesh, mounted[:3], tips, kind="rigid", vertices=np.flatnonzero(mesh.vertices[:, 0] == 0.1)
    )
    q = deformed(mesh)
    np.testing.assert_allclose(bound(q)[:, :3], alone(q), atol=1e-15)
    by = torch.randn(11, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    np.testing.assert_allclose(bound.moved(by)(rest)[0], mounted + by.numpy(), atol=1e-12)


def test_derivatives_of_the_errors_of_a_rigid_body():
    """The misfit of positions and orientations by the positions of all vertices."""
    markers, mesh = capped()
    bound = bound_markers(markers, mesh, nominal_places(markers, mesh) + 0.01, markers.observed)
    q = deformed(mesh)
    direction = 1e-3 * torch.randn(
        q.shape, generator=torch.Generator().manual_seed(3), dtype=q.dtype
    )
    measured = bound(q) + 1e-3 * torch.randn(
        2, 11, 3, generator=torch.Generator().manual_seed(2), dtype=q.dtype
    )

    def misfit(positions):
        return bound.residual(bound(positions), measured).square().sum()

    x = q.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(misfit(x), x)
    expected, error = central_difference(lambda step: float(misfit(q + step * direction)))
    assert error < 1e-6 * abs(expected)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-6)
    jacobian = bound.transposed_jacobian(q)
    by_residual = 2.0 * bound.residual(bound(q), measured).flatten(1)
    np.testing.assert_allclose(
        (jacobian @ by_residual[..., None])[..., 0].view_as(q), gradient, atol=1e-15
    )
