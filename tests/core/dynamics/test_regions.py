"""Bodies of several solids, rigid parts and glued meshes:
their motion, and their vertices by control vertices.
"""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
import torch

from support.clamped import clamped, noise
from support.refusals import refuses
from support.regions import beam, two_boxes
from support.slopes import check_slopes
from warp_resphys import (
    Body,
    Corotated,
    InputError,
    Mesh,
    Scene,
    Simulator,
    StableNeoHookean,
    State,
    box_hexahedra,
)
from warp_resphys.core.fem.bodies import Glue
from warp_resphys.core.fem.coordinates import (
    Coordinates,
    DeviceCoordinates,
    barycentric,
    control_vertices,
)
from warp_resphys.core.fem.rigid_region import Rigid
from warp_resphys.core.mesh.boxes import box_tetrahedra
from warp_resphys.core.mesh.selection import select_vertices

MESH = beam((6, 2, 2))
SILICONE = Corotated(2e5, 0.45, prony=[(0.2, 0.1)], stiffness_damping=1e-3)


def test_regions_of_one_material_are_one_solid_and_cover_every_cell_once():
    whole = Simulator(clamped(MESH), SILICONE)
    parts = Simulator(clamped(MESH), {"beam": SILICONE, "cap": SILICONE})
    one, two = (s.rollout(s.rest_state(), 6) for s in (whole, parts))
    torch.testing.assert_close(one.q, two.q, rtol=0.0, atol=1e-13)
    strains = torch.cat(
        [two.final.memory["beam_viscous_strain"], two.final.memory["cap_viscous_strain"]], 2
    )
    shared = one.final.memory["viscous_strain"]
    assert float((strains.norm() - shared.norm()).abs()) < 1e-9 * float(shared.norm())
    refuses(
        InputError, "leave 16 of 24 cells without one", Simulator, clamped(MESH), {"cap": SILICONE}
    )
    capped = clamped(MESH, rigid={"cap": Rigid()})
    refuses(InputError, "cap", Simulator, capped, {"beam": SILICONE, "cap": SILICONE})
    refuses(InputError, "midpoint", Simulator, capped, SILICONE, integrator="midpoint")


def deviation(mesh, cells, q):
    """Largest entry of F^T F - I of a part's best affine map, and the error of that map [m]."""
    members = np.unique(mesh.cells[cells])
    places = np.c_[mesh.vertices[members], np.ones(len(members))]
    affine = np.linalg.lstsq(places, q[members], rcond=None)[0]
    return np.abs(affine[:3] @ affine[:3].T - np.eye(3)).max(), np.abs(
        places @ affine - q[members]
    ).max()


def test_a_cap_is_rigid_to_a_ten_thousandth_of_its_size_and_its_weight_bends_the_beam():
    body = clamped(MESH, rigid={"cap": Rigid(density=3000.0)})
    simulator = Simulator(body, Corotated(2e5, 0.45))
    q = simulator.static_equilibrium().q[0].numpy()
    stretch, error = deviation(body.mesh, body.mesh.region("cap"), q)
    assert stretch < 1e-4
    assert error < 1e-15
    # The moment and the force at the cap's face are those of its weight: so much mass as a load
    # bends it as much.
    stiff = {"beam": Corotated(2e5, 0.45), "cap": Corotated(1e10, 0.3, density=3000.0)}
    other = Simulator(clamped(MESH), stiff, solver="newton").static_equilibrium().q[0].numpy()
    assert np.abs(q - other).max() < 1e-3 * np.abs(q - body.mesh.vertices).max()


def test_a_rigid_body_of_a_scene_has_no_material():
    beam = clamped(MESH)
    stone = Body.rigid_body(box_hexahedra((0.01, 0.01, 0.01), (1, 1, 1)), Rigid(density=500.0))
    scene = Scene({"beam": beam, "stone": stone})
    own = {"beam": Corotated(2e5, 0.45), "cap": Corotated(1e6, 0.3)}
    simulator = Simulator(scene, {"beam": own}, time_step=0.01, gravity=(0.0, 0.0, -9.81))
    assert {name for name in simulator.parameters if name.startswith("stone")} == {
        "stone_body_density"
    }
    v = simulator.rollout(simulator.rest_state(), 3).v[-1, 0, scene.vertex_slice("stone")]
    assert v.detach().numpy() == pytest.approx(
        np.broadcast_to([0.0, 0.0, -3 * 0.01 * 9.81], v.shape), abs=1e-9
    )
    with pytest.raises(InputError, match="The body 'stone' has no material"):
        Simulator(Scene({"beam": beam, "stone": replace(stone, rigid={})}), {"beam": own})


@pytest.mark.parametrize(("integrator", "order"), [("implicit_euler", 1), ("bdf2", 2)])
def test_a_rigid_box_turns_as_eulers_equations_say(integrator, order):
    """About an axis near that of the largest moment of inertia, so that it nutates."""
    mesh = box_hexahedra((0.1, 0.05, 0.03), (2, 1, 1))
    body = Body(
        Mesh(mesh.vertices, mesh.cells, {"all": np.arange(2)}), rigid={"all": Rigid(density=1000.0)}
    )
    spin = np.array([2.0, 1.0, 10.0])
    inertia = (
        1000.0
        * 0.1
        * 0.05
        * 0.03
        / 12.0
        * np.array([0.05**2 + 0.03**2, 0.1**2 + 0.03**2, 0.1**2 + 0.05**2])
    )
    momentum, turn, h = inertia * spin, np.eye(3), 1e-4

    def slope(r):
        w = r @ ((r.T @ momentum) / inertia)
        return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]]) @ r

    for _ in range(2000):
        a = slope(turn)
        b = slope(turn + 0.5 * h * a)
        c = slope(turn + 0.5 * h * b)
        turn = turn + h / 6.0 * (a + 2.0 * b + 2.0 * c + slope(turn + h * c))
    errors = []
    for steps in (20, 40):
        simulator = Simulator(
            body, {}, time_step=0.2 / steps, gravity=(0.0, 0.0, 0.0), integrator=integrator
        )
        start = simulator.rest_state()
        arm = start.q - start.q.mean(1, keepdim=True)
        v = torch.linalg.cross(torch.as_tensor(spin).expand_as(arm), arm)
        path = simulator.rollout(State(start.q, v), steps)
        # It begins at a rotation.
        assert max(int(report.iterations.max()) for report in path.reports) < 40
        q = path.q[-1, 0].numpy()
        assert deviation(mesh, np.arange(2), q)[0] < 1e-4
        expected = arm[0].numpy() @ turn.T + start.q.mean(1).numpy()
        errors.append(np.abs(q - expected).max())
    assert np.log2(errors[0] / errors[1]) > order - 0.3
    assert errors[1] < (2e-2, 2e-3)[order - 1]


def test_boxes_that_are_glued_bend_like_one():
    mesh, ends = two_boxes()
    glued = Simulator(
        clamped(mesh, glued=[Glue(ends, "left")]), Corotated(2e5, 0.45)
    ).static_equilibrium()
    whole = box_hexahedra((0.1, 0.03, 0.03), (10, 3, 3))
    one = Simulator(clamped(whole), Corotated(2e5, 0.45)).static_equilibrium()
    sag = [
        float((q[0, :, 2] - torch.as_tensor(m.vertices[:, 2])).min())
        for q, m in ((glued.q, mesh), (one.q, whole))
    ]
    assert sag[0] == pytest.approx(sag[1], rel=0.05)
    face = torch.as_tensor(ends)
    inside = np.flatnonzero(
        np.isclose(mesh.vertices[:, 0], 0.05) & (np.arange(len(mesh.vertices)) < ends.min())
    )
    corners = [i for i in inside if np.isclose(mesh.vertices[ends], mesh.vertices[i]).all(1).any()]
    for i in corners:  # Corners coincide at rest, and stay together.
        twin = face[np.isclose(mesh.vertices[ends], mesh.vertices[i]).all(1).argmax()]
        torch.testing.assert_close(glued.q[0, i], glued.q[0, twin], rtol=0.0, atol=1e-15)


def test_gradients_by_the_parameters_of_a_region():
    materials = {
        "beam": Corotated(3e5, 0.45, mass_damping=0.3),
        "cap": StableNeoHookean(1e5, 0.499, mass_damping=0.1),
    }
    simulator = Simulator(clamped(MESH), materials, relative_tolerance=1e-11, integrator="bdf2")
    weights = noise(1, simulator.body.n_vertices, 3)

    def loss(given):
        return (
            weights * simulator.rollout(simulator.rest_state(), 3, parameters=given).q[-1]
        ).sum()

    names = ("beam_youngs_modulus", "cap_poissons_ratio", "cap_mass_damping")
    values = {
        name: torch.tensor([float(simulator.defaults[name])], dtype=torch.float64) for name in names
    }
    check_slopes(loss, values, {name: 1e-3 * float(value) for name, value in values.items()})


@pytest.mark.parametrize("mesh", [beam(), box_tetrahedra((0.1, 0.03, 0.03), (5, 2, 2), order=2)])
def test_weights_of_a_rigid_part_are_small_and_give_its_vertices(mesh):
    members = np.unique(mesh.cells[-5:])
    controls = control_vertices(mesh.vertices, members, "cap")
    weights = barycentric(mesh.vertices[controls], mesh.vertices[members])
    np.testing.assert_allclose(
        weights @ mesh.vertices[controls], mesh.vertices[members], atol=1e-15
    )
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
        assert not np.isin(
            composed.nodes[np.abs(composed.gradients).sum((1, 3)) > 0], body.coordinates.dependent
        ).any()
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


BOXES, ENDS = two_boxes()
FAR, FAR_ENDS = two_boxes(gap=0.002)
FLAT = Mesh(beam().vertices, beam().cells, {"cap": np.arange(81, 90), "next": np.arange(72, 81)})


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (
            lambda: Body(beam(), select_vertices(beam(), x=0.1), rigid={"cap": Rigid()}),
            "'cap' are fixed",
        ),
        (lambda: Body(FLAT, rigid={"cap": Rigid(), "next": Rigid()}), "share vertices"),
        (lambda: Body(BOXES, glued=[Glue(ENDS, "right")]), "belongs to it"),
        (lambda: Body(BOXES, ENDS[:1], glued=[Glue(ENDS, "left")]), "is fixed"),
        (
            lambda: Body(BOXES, rigid={"right": Rigid()}, glued=[Glue(ENDS, "left")]),
            "part of a rigid part",
        ),
        (lambda: Body(FAR, glued=[Glue(FAR_ENDS, "left")]), "farther than the tolerance"),
        (
            lambda: Rigid(stiffness=0.0),
            r"Rigid\.stiffness is 0\.0: it must be a positive number, in Pa",
        ),
    ],
)
def test_invalid_rigid_parts_and_glue_are_refused(make, key):
    refuses(InputError, key, make)
