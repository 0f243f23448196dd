"""Vertices as weighted sums of control vertices: rigid parts and glue."""

import numpy as np
import pytest
import scipy.sparse
import torch

from support.regions import beam, two_boxes
from warp_resphys import Body, Mesh, box_tetrahedra, select_vertices
from warp_resphys.fem.bodies import Glue, Rigid
from warp_resphys.fem.coordinates import Coordinates, DeviceCoordinates, barycentric, control_vertices
from warp_resphys.io.errors import InputError


@pytest.mark.parametrize("mesh", [beam(), box_tetrahedra((0.1, 0.03, 0.03), (5, 2, 2), order=2)])
def test_weights_of_a_rigid_part_are_small_and_give_its_vertices(mesh):
    members = np.unique(mesh.cells[-5:])
    controls = control_vertices(mesh.vertices, members, "cap")
    weights = barycentric(mesh.vertices[controls], mesh.vertices[members])
    np.testing.assert_allclose(weights @ mesh.vertices[controls], mesh.vertices[members], atol=1e-15)
    assert np.abs(weights).max() < 1.0 + 1e-6


def test_composed_points_give_the_same_deformation_gradients():
    body = Body(beam(), rigid={"cap": Rigid()})
    random = np.random.default_rng(0)
    control = torch.as_tensor(random.normal(size=(1, body.n_vertices, 3)))
    device = DeviceCoordinates(body.coordinates, control)
    x = device.expand(control)[0].numpy()
    np.testing.assert_allclose(body.coordinates.matrix @ control[0].numpy(), x, atol=1e-12)
    for points in body.discretisation.point_sets:
        composed = body.coordinates.compose(points)
        assert not np.isin(composed.nodes[np.abs(composed.gradients).sum((1, 3)) > 0], body.coordinates.dependent).any()
        whole = np.einsum("cki,cqkj->cqij", x[points.nodes], points.gradients)
        own = np.einsum("cki,cqkj->cqij", control[0].numpy()[composed.nodes], composed.gradients)
        np.testing.assert_allclose(own, whole, rtol=0, atol=1e-9 * np.abs(whole).max())
    forces = torch.as_tensor(random.normal(size=control.shape))
    work = (device.reduce(forces) * control).sum()
    torch.testing.assert_close(work, (forces * device.expand(control)).sum())


def test_glue_to_a_vertex_that_is_glued_is_resolved():
    pairs = ([1, 2, 2, 3], [0, 0, 1, 2])
    chain = Coordinates.of(scipy.sparse.csr_array(([1.0, 0.25, 0.75, 1.0], pairs), (4, 4)))
    np.testing.assert_allclose(chain.matrix.toarray()[:, 0], np.ones(4))
    with pytest.raises(InputError, match="determine each other"):
        Coordinates.of(scipy.sparse.csr_array(([1.0, 1.0], ([0, 1], [1, 0])), (2, 2)))


MESH, ENDS = two_boxes()
FAR, FAR_ENDS = two_boxes(gap=0.002)
FLAT = Mesh(beam().vertices, beam().cells, {"cap": np.arange(81, 90), "next": np.arange(72, 81)})


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Body(beam(), select_vertices(beam(), x=0.1), rigid={"cap": Rigid()}), "'cap' are fixed"),
        (lambda: Body(FLAT, rigid={"cap": Rigid(), "next": Rigid()}), "share vertices"),
        (lambda: Body(MESH, glued=[Glue(ENDS, "right")]), "belongs to it"),
        (lambda: Body(MESH, ENDS[:1], glued=[Glue(ENDS, "left")]), "is fixed"),
        (lambda: Body(MESH, rigid={"right": Rigid()}, glued=[Glue(ENDS, "left")]), "part of a rigid part"),
        (lambda: Body(FAR, glued=[Glue(FAR_ENDS, "left")]), "farther than the tolerance"),
        (lambda: Rigid(stiffness=0.0), "must be positive, in Pa"),
    ],
)
def test_invalid_rigid_parts_and_glue_are_refused(make, key):
    with pytest.raises(InputError, match=key):
        make()
