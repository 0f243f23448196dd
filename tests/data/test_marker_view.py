"""What recordings tell of markers: a plane, or a shape alone."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from warp_resphys import InputError, bind_markers, box_hexahedra
from warp_resphys.data.marker_view import MarkerView, ViewedMarkers

NOMINAL = np.array(
    [[0.0, 0.01, -0.07], [0.002, -0.02, -0.04], [0.0, 0.015, 0.036], [0.004, 0.0, 0.063]]
)
PLACES = torch.as_tensor(NOMINAL)
VIEWS = {
    "plane": MarkerView(PLACES, "xz"),
    "own": MarkerView(PLACES, shape_alone=True),
    "own plane": MarkerView(PLACES, "xz", shape_alone=True),
    "own plane, turned": MarkerView(PLACES, "zy", shape_alone=True),
}


def moved(points, angle, axis, shift):
    return points @ Rotation.from_rotvec(angle * np.asarray(axis)).as_matrix().T + shift


def shaken(scale=0.01, count=5):
    return NOMINAL + scale * np.random.default_rng(0).normal(size=(count, 4, 3))


@pytest.mark.parametrize("name", VIEWS)
def test_the_view_of_nominal_places_is_the_identity(name):
    np.testing.assert_allclose(VIEWS[name].of_arrays(NOMINAL), NOMINAL, atol=1e-12)


def test_depth_is_not_observed():
    points = shaken()
    context = VIEWS["plane"].of_arrays(points)
    np.testing.assert_array_equal(context[..., [0, 2]], points[..., [0, 2]])
    np.testing.assert_array_equal(context[..., 1], np.broadcast_to(NOMINAL[:, 1], (5, 4)))


@pytest.mark.parametrize(
    ("name", "axis", "angle"),
    [
        ("own", [0.6, -0.64, 0.48], 3.1),
        ("own plane", [0, 1, 0], -2.0),
        ("own plane, turned", [1, 0, 0], 3.1),
    ],
)
def test_the_view_of_a_shape_is_invariant_to_rigid_motion(name, axis, angle):
    """In three dimensions or in the plane, moved by any angle: the same shape, and no other."""
    points, view = shaken(), VIEWS[name]
    shift = np.array([0.3, -0.2, 0.1])
    np.testing.assert_allclose(
        view.of_arrays(moved(points, angle, axis, shift)), view.of_arrays(points), atol=1e-12
    )
    spread = view.of_arrays(points)
    assert np.abs(spread - spread[:1]).max() > 5e-3


@pytest.mark.parametrize("name", VIEWS)
def test_gradients_at_rest_and_after_a_large_turn(name):
    """Against central differences, at the nominal places too,
    where the singular values of a plane's are no three.
    """
    turned = moved(shaken(count=2), 2.5, [0.0, 1.0, 0.0], 0.1)
    points = torch.as_tensor(np.concatenate([NOMINAL[None], turned])).requires_grad_()
    assert torch.autograd.gradcheck(VIEWS[name], (points,), eps=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", VIEWS)
def test_a_body_is_carried_with_its_markers(name):
    """A point of the body at a marker has the marker's viewed position,
    apart from the unseen depth.
    """
    points, view = torch.as_tensor(moved(shaken(), 1.2, [0.0, 1.0, 0.0], 0.2)), VIEWS[name]
    body = torch.cat([points, points.flip(-2) + 0.01], -2)
    carried, context = view.carried(body, points), view(points)
    if not view.shape_alone:
        assert carried is body
        return
    seen = [axis for axis in range(3) if axis != view.unseen]
    np.testing.assert_allclose(carried[:, :4, seen], context[..., seen], atol=1e-12)
    if view.plane is None:  # rigidly
        np.testing.assert_allclose(
            torch.cdist(carried, carried), torch.cdist(body, body), atol=1e-12
        )
    else:
        np.testing.assert_allclose(carried[..., view.unseen], body[..., view.unseen], atol=1e-12)


def test_a_hidden_marker_hides_the_shape_of_its_frame_alone():
    points = shaken()
    points[2, 1] = np.nan
    hidden = np.isnan(VIEWS["own plane"].of_arrays(points)).all(axis=(1, 2))
    assert hidden.tolist() == [False, False, True, False, False]
    context = VIEWS["plane"].of_arrays(points)
    assert np.argwhere(np.isnan(context).all(axis=2)).tolist() == [[2, 1]]
    assert np.isnan(context).sum() == 3  # its depth neither


def test_seen_markers_of_a_body_that_is_carried_away_are_where_they_were():
    mesh = box_hexahedra(divisions=(5, 2, 2))
    places = np.array([[0.01, 0.0, 0.033], [0.05, 0.002, 0.033], [0.09, 0.03, 0.033]])
    markers = bind_markers(mesh, places, ["a", "b", "c"], kind="frame")
    seen = ViewedMarkers.of(markers, MarkerView(torch.as_tensor(places), shape_alone=True))
    at = torch.as_tensor(moved(mesh.vertices, 1.0, [0.0, 0.6, 0.8], 0.5))[None]
    np.testing.assert_allclose(seen(at)[0], places, atol=1e-12)
    bent = at.clone()
    bent[0, mesh.vertices[:, 0] > 0.07] += 0.01
    assert float((seen(bent)[0] - torch.as_tensor(places)).norm(dim=1).max()) > 2e-3
    slope = seen.transposed_jacobian(bent).view(1, -1, 3, 9)
    # All vertices alike change no shape.
    assert float(slope.sum(1).abs().max()) < 1e-10 < float(slope.abs().max())
    spin = torch.linalg.cross(
        torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64).expand_as(bent[0]), bent[0]
    )
    assert float(torch.einsum("ni,nim->m", spin, slope[0]).abs().max()) < 1e-10  # nor does a turn
    by = torch.tensor([[0.002, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    assert not torch.allclose(seen.moved(by)(at), seen(at), atol=1e-4)
    single = seen.to(torch.zeros(1, dtype=torch.float32))(bent.float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), seen(bent).numpy(), atol=1e-6)
    assert ViewedMarkers.of(markers, MarkerView(torch.as_tensor(places))) is markers


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((PLACES, "xx"), r"markers\.plane"),
        ((PLACES, "xyz"), "name two of the body's axes"),
        (
            (PLACES * torch.tensor([0, 0, 1]), None, True),
            "the 4 markers that are seen together lie on one line",
        ),
        ((PLACES[:1], "xz", True), "the 1 markers that are seen together are at one place"),
        (
            (PLACES, None, True, ((0, 1, 2), (1, 2, 3))),
            "two trials have some markers in common, and not all",
        ),
        (
            (PLACES, None, True, ((0, 1), (2, 3))),
            "the 2 markers that are seen together lie on one line",
        ),
    ],
)
def test_degenerate_markers_are_refused(arguments, said):
    with pytest.raises(InputError, match=said):
        MarkerView(*arguments)
