"""Markers on stems: at rest, in rigid motions, and their derivatives against central differences in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from warp_resphys import InputError, box_hexahedra, box_tetrahedra, select_vertices
from warp_resphys.data.markers import KINDS, bind_markers
from warp_resphys.stepping.rotations import closest_rotation, twisted

MESHES = {
    "hexahedra": box_hexahedra(divisions=(5, 2, 2)),
    "tetrahedra": box_tetrahedra(divisions=(5, 2, 2)),
    "tetrahedra10": box_tetrahedra(divisions=(5, 2, 2), order=2),
}
MESH = MESHES["hexahedra"]
TIP = select_vertices(MESH, x=0.1)
# Above a face, beside an edge, beyond a corner, sunk in, and on the tip's rim as those of the measured beam are.
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
    return bind_markers(mesh, POINTS, NAMES, kind=kind, vertices=select_vertices(mesh, x=0.1), patch=0.03)


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
    """(4, N, 3) at rest, bent, twisted by 170 degrees, and turned far away, stretched and shaken."""
    rest = torch.as_tensor(mesh.vertices)
    turn = torch.as_tensor(Rotation.from_rotvec([2.0, -1.0, 1.5]).as_matrix())
    shaken = torch.rand(rest.shape, generator=torch.Generator().manual_seed(0), dtype=rest.dtype)
    far = (rest * rest.new_tensor([1.2, 0.9, 1.0]) + 1e-3 * shaken) @ turn.T + 0.3
    return torch.stack([rest, bent(rest), twisted(rest, rest.new_tensor([2.97]))[0], far])


@pytest.mark.parametrize(
    ("mesh", "kind"),
    [*((MESH, kind) for kind in KINDS), (MESHES["tetrahedra"], MIXED), (MESHES["tetrahedra10"], MIXED)],
)
def test_markers_are_at_their_measured_places_and_move_with_the_body(mesh, kind):
    markers = bind(kind, mesh)
    rest = torch.as_tensor(mesh.vertices)
    np.testing.assert_allclose(markers(rest[None])[0], POINTS, rtol=0, atol=1e-12)
    rotations = torch.as_tensor(Rotation.random(5, random_state=1).as_matrix())
    shifts = torch.rand(5, 1, 3, dtype=rest.dtype)
    moved = markers(rest @ rotations.mT + shifts)
    np.testing.assert_allclose(moved, torch.as_tensor(POINTS) @ rotations.mT + shifts, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", [*KINDS, MIXED], ids=[*KINDS, "mixed"])
def test_derivatives(kind):
    """At rest, where the square face that the rigid ones follow is symmetric, bent, twisted and turned far."""
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
    assert float((along.grad * direction).sum()) == pytest.approx(float((expected * weights).sum()), rel=1e-6)


def test_a_stem_along_the_normal_turns_with_it_and_keeps_its_length():
    markers = bind_markers(MESH, POINTS[:1], NAMES[:1], kind="normal")
    q = poses(MESH)
    stem = markers(q) - feet(markers, q)
    np.testing.assert_allclose(stem.norm(dim=-1), 0.006, rtol=0, atol=1e-12)
    corners = q[:, markers.vertices[0]]
    np.testing.assert_allclose(((corners - corners[:, :1]) @ stem.mT).abs().max(), 0.0, atol=1e-15)
    weights = torch.linalg.solve(corners.mT, feet(markers, q).mT)[:, :, 0]  # Barycentric, wherever the body goes.
    np.testing.assert_allclose(weights, markers.weights.expand(4, -1), rtol=0, atol=1e-9)


def test_a_patch_follows_only_the_vertices_around_its_foot():
    markers = bind_markers(MESH, POINTS[:1], NAMES[:1], kind="patch", patch=0.025)
    near = np.linalg.norm(MESH.vertices - [0.043, 0.012, 0.03], axis=1) <= 0.025
    assert set(markers.vertices.tolist()) == set(np.flatnonzero(near))
    q = poses(MESH)[1:2]
    moved = q.clone()
    moved[:, torch.as_tensor(~near)] += 0.1
    np.testing.assert_array_equal(markers(moved), markers(q))


@pytest.mark.parametrize("spread", [(3.0, 2.0, 1.0), (1.0, 1.0, 0.0), (1.0, 1.0, 1.0), (3.0, 2.0, -1.0)])
def test_derivative_of_the_closest_rotation(spread):
    """Also where singular values coincide or vanish, as for a square face, and for a mirror image."""
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
        ({"largest_distance": 0.005, "positions": POINTS[[0, 0]], "names": ["a", "b"]}, "Marker 'a' is 6.0 mm from"),
        ({"positions": np.where(np.arange(6)[:, None] == 3, np.nan, POINTS)}, "Marker 'sunk' was not seen at rest"),
        ({"kind": ["frame"]}, "6 markers are named, with 1 kinds and positions (6, 3)"),
        ({"kind": "rigid", "vertices": [0, 1, 99]}, "Rigid markers follow 3 vertices"),
        ({"kind": "rigid", "vertices": [0, 1, 2]}, "The vertices that rigid markers follow lie on one line"),
        ({"kind": "patch", "patch": 1e-3}, "'above'"),
    ],
)
def test_bad_markers(settings, sentence):
    with pytest.raises(InputError) as error:
        bind_markers(MESH, **{"positions": POINTS, "names": NAMES, **settings})
    assert sentence in str(error.value)
