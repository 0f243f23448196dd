"""Contact of bodies with one another and with themselves:
pairs, barrier, friction, gradients, batches, refusals.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

from support.clamped import clamped
from support.refusals import refuses
from support.slopes import check_slopes
from warp_resphys import (
    Corotated,
    Inputs,
    Scene,
    Simulator,
    SolverSettings,
    State,
    SurfaceContact,
    SymmetryPlane,
)
from warp_resphys.core.energies.contact.pairs import PairList, Surface
from warp_resphys.core.energies.launcher import Launcher, warp_view
from warp_resphys.core.fem.bodies import Body
from warp_resphys.core.fem.rigid_region import Rigid
from warp_resphys.core.mesh.boxes import box_hexahedra, box_tetrahedra
from warp_resphys.core.mesh.selection import select_cells, select_vertices
from warp_resphys.core.mesh.volume_mesh import Mesh, join
from warp_resphys.energies import FrictionPair
from warp_resphys.io.errors import InputError
from warp_resphys.kernels.contact import nearest_points
from warp_resphys.kernels.contact import surface_pairs as kernels

CPU = torch.device("cpu")
SOFT = Corotated(youngs_modulus=2.5e5, poissons_ratio=0.45)
FINE = SolverSettings(relative_tolerance=1e-12, absolute_tolerance=1e-13)
PLATE = box_tetrahedra((0.04, 0.04, 0.01), (4, 4, 1))
CUBE = box_tetrahedra((0.02, 0.02, 0.02), (2, 2, 2))
KAPPA, D, G = 1e5, 1e-3, 9.81


def turned(mesh, angles, place):
    """A mesh turned about its middle by angles about x and z, with its middle at a place."""
    (cx, cz), (sx, sz) = np.cos(angles), np.sin(angles)
    turn = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ np.array(
        [[1, 0, 0], [0, cx, -sx], [0, sx, cx]]
    )
    middle = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    return replace(mesh, vertices=(mesh.vertices - middle) @ turn.T + place)


def pairs_of(kind, x, area, degree, parallel):
    """Pairs with their own vertices, and those as a batch of one."""
    launcher, pairs = Launcher(1, CPU), nearest_points.Pairs()
    pairs.environment = launcher.upload(np.zeros(len(x), np.int32), int)
    pairs.kind = launcher.upload(kind.astype(np.int32), int)
    pairs.nodes = launcher.upload(np.arange(4 * len(x), dtype=np.int32).reshape(-1, 4), wp.vec4i)
    pairs.area, pairs.degree = launcher.upload(area, wp.float64), launcher.upload(degree, wp.vec4d)
    pairs.parallel = launcher.upload(parallel, wp.float64)
    return launcher, pairs


def launched(kernel, launcher, chosen, pairs, x, stiffness, reach, *out):
    """Launches a kernel of pairs at positions (C, 4, 3), with outputs and their types."""
    at, kappa = torch.tensor(x.reshape(1, -1, 3)), torch.tensor([[stiffness]], dtype=torch.float64)
    inputs = [warp_view(chosen, wp.int32), pairs, warp_view(kappa, wp.float64), wp.float64(reach)]
    views = [warp_view(tensor, kind) for tensor, kind in out]
    launcher.launch(launcher.record(kernel, (len(x),), [*inputs, warp_view(at, wp.vec3d)], views))


def pair_forces(launcher, pairs, x, stiffness, reach):
    """Energies (C,) and gradients (C, 4, 3) of pairs."""
    force = torch.zeros(len(x), 4, 3, dtype=torch.float64)
    energy = torch.zeros(len(x), dtype=torch.float64)
    out = (
        (force, nearest_points.Corners),
        (energy, wp.float64),
        (torch.zeros(len(x), dtype=torch.int32), wp.int32),
    )
    launched(kernels.pair_forces, launcher, launcher.active, pairs, x, stiffness, reach, *out)
    return energy.numpy(), force.numpy()


def pair_tangents(launcher, pairs, x, stiffness, reach):
    """Second derivatives (C, 12, 12) of the energies of pairs."""
    hessian = torch.zeros(len(x), 12, 12, dtype=torch.float64)
    chosen = torch.arange(len(x), dtype=torch.int32)
    launched(
        kernels.pair_tangents, launcher, chosen, pairs, x, stiffness, reach, (hessian, wp.float64)
    )
    return hessian.numpy()


@pytest.mark.parametrize("kind", [0, 1])
def test_derivatives_of_pairs(kind):
    """Vertex and triangle, and edges, also almost parallel ones, at random:
    gradient and Hessian are differences.
    """
    random, count, reach = np.random.default_rng(kind), 400, 1.5
    x = random.normal(size=(count, 4, 3))
    parallel = np.where(np.arange(count) % 2 == 0, 50.0, 1e-3)
    degree = random.integers(3, 8, (count, 4)).astype(float)
    given = (np.full(count, kind), x, random.uniform(0.5, 2.0, count), degree, parallel)
    launcher, pairs = pairs_of(*given)
    energy, force = pair_forces(launcher, pairs, x, 3.0, reach)
    hessian = pair_tangents(launcher, pairs, x, 3.0, reach)
    slopes, curvatures, h = np.zeros((count, 12)), np.zeros((count, 12, 12)), 1e-6
    for k in range(12):
        way = np.zeros((count, 12))
        way[:, k] = h
        (e1, f1), (e0, f0) = (
            pair_forces(launcher, pairs, x + sign * way.reshape(x.shape), 3.0, reach)
            for sign in (1.0, -1.0)
        )
        slopes[:, k], curvatures[:, :, k] = (
            (e1 - e0) / (2 * h),
            ((f1 - f0) / (2 * h)).reshape(count, 12),
        )
    assert (energy != 0.0).sum() > 200
    size = 1e-3 + np.abs(slopes).max(1)
    assert (np.abs(slopes - force.reshape(count, 12)).max(1) / size).max() < 1e-6
    errors = np.abs(hessian - curvatures).max((1, 2)) / (1e-2 + np.abs(curvatures).max((1, 2)))
    # In between, a difference crosses a change of the nearest feature.
    assert np.quantile(errors, 0.99) < 1e-6


@pytest.mark.parametrize("kind", [0, 1])
def test_energies_of_pairs_are_those_of_ipctk(kind):
    """D B(d / D) of vertices beside the inside of a triangle, and of edges with their factor."""
    ipctk = pytest.importorskip(
        "ipctk", reason="compares with ipctk: pip install 'warp-resphys[test]'"
    )
    random, reach = np.random.default_rng(kind + 5), 0.25
    x = random.normal(size=(4000, 4, 3))
    distance = ipctk.edge_edge_distance if kind else ipctk.point_triangle_distance
    if not kind:  # A vertex near an edge shares its energy among triangles.
        edges = ((1, 2), (1, 3), (2, 3))
        x = x[
            [
                min(ipctk.point_edge_distance(y[0], y[a], y[b]) for a, b in edges) > reach**2
                for y in x
            ]
        ]
    d = np.sqrt([distance(*y) for y in x])
    x, d = x[d < reach], d[d < reach]
    count, width = len(x), 20.0  # most edges are almost parallel for it
    launcher, pairs = pairs_of(
        np.full(count, kind), x, np.ones(count), np.ones((count, 4)), np.full(count, width)
    )
    energy, _ = pair_forces(launcher, pairs, x, 1.0, reach)
    # Its barrier is (d - D)^2 ln(d / D) with a minus sign.
    expected = [ipctk.barrier(near, reach) / reach for near in d]
    if kind:
        expected = [
            e * ipctk.edge_edge_mollifier(*y, width) for e, y in zip(expected, x, strict=True)
        ]
    assert count > 30
    assert energy == pytest.approx(np.array(expected), rel=1e-12)


def joined():
    """Two blocks, one above the other, with some disorder in three environments."""
    mesh = join(
        {"lower": PLATE, "upper": replace(CUBE, vertices=CUBE.vertices + [0.011, 0.009, 0.0125])}
    )
    noise = np.random.default_rng(0).normal(size=(3, *mesh.vertices.shape)) * 3e-4
    return mesh, torch.tensor(mesh.vertices + noise)


def test_pairs_are_all_pairs_within_reach():
    """Against the distances of all conceivable pairs.

    Boxes along a way hold those that come within reach on it.
    """
    mesh, x = joined()
    surface, reach = Surface.of(mesh), 4e-3
    pairs = PairList(Launcher(3, CPU), surface, reach)
    pairs.find(x, torch.zeros_like(x))
    vertices, triangles, edges = surface.vertices, surface.triangles, surface.edges
    v, t = (k.ravel() for k in np.meshgrid(vertices, np.arange(len(triangles)), indexing="ij"))
    i, j = np.triu_indices(len(edges), 1)
    nodes = np.concatenate(
        [np.column_stack([v, triangles[t]]), np.column_stack([edges[i], edges[j]])]
    )
    kind = np.repeat([0, 1], [len(v), len(i)])
    shared = (np.sort(nodes, 1)[:, 1:] == np.sort(nodes, 1)[:, :-1]).any(1)
    nodes, kind = nodes[~shared], kind[~shared]
    ones = np.ones(len(nodes))
    launcher, every = pairs_of(kind, nodes, ones, np.ones((len(nodes), 4)), ones)
    for b in range(3):
        d = torch.zeros(len(nodes), dtype=torch.float64)
        at = x[b, nodes.reshape(-1)][None].contiguous()
        views = [every, warp_view(at, wp.vec3d)], [warp_view(d, wp.float64)]
        launcher.launch(launcher.record(nearest_points.distances, (len(nodes),), *views))
        near = {
            (int(k), *map(int, n)) for k, n in zip(kind[d < reach], nodes[d < reach], strict=True)
        }
        own = pairs.environment == b
        found = pairs.distances(x)[own] < reach
        listed = zip(pairs.kind[own][found].tolist(), pairs.nodes[own][found].tolist(), strict=True)
        assert {(k, *n) for k, n in listed} == near
        assert len(near) > 300
    way = torch.zeros_like(x)
    way[:, len(PLATE.vertices) :] = 1e-3
    pairs.find(x, way)
    assert pairs.covers(x + way)
    assert not pairs.covers(x + 10.0 * way)
    assert pairs.covers(x + 1.0)  # Motion of all together changes no distance.


def landing(
    friction=0.5, integrator="implicit_euler", kappa=KAPPA, rigid="", plate=PLATE, **options
):
    """A cube, of which a `rigid` layer or the whole is rigid, above a plate that is held below."""
    low = CUBE.vertices[CUBE.cells].mean(1)[:, 2] < 0.01
    parts = {"layer": np.flatnonzero(low), "whole": np.arange(len(CUBE.cells))}
    cube = turned(replace(CUBE, regions=parts), (0.4, 0.5), (0.021, 0.0197, 0.0255))
    stiff = {rigid: Rigid(density=1070.0, stiffness=1e6)} if rigid else {}
    plate = Body(plate, fixed=select_vertices(plate, z=0.0))
    contact = SurfaceContact(kappa, friction, slip_speed=1e-2)
    scene = Scene({"plate": plate, "cube": Body(cube, rigid=stiff)}, contact)
    return Simulator(
        scene, SOFT, integrator=integrator, **{"time_step": 0.002, "solver": FINE, **options}
    )


def thrown(simulator, velocity, spin, batch=1):
    """The state with the cube thrown with a velocity (B, 3) and a spin (B,) about z."""
    rest, cube = simulator.rest_state(batch), simulator.body.vertex_slice("cube")
    velocity, spin = simulator.tensor(velocity), simulator.tensor(spin)
    arm = rest.q[:, cube] - rest.q[:, cube].mean(1, keepdim=True)
    axis = simulator.tensor([0.0, 0.0, 1.0])
    own = velocity[:, None] + spin[:, None, None] * torch.linalg.cross(axis.expand_as(arm), arm)
    v = torch.cat([torch.zeros_like(rest.q[:, : cube.start]), own], 1)
    return State(rest.q, v)


@pytest.mark.parametrize(
    ("integrator", "rigid"),
    [("implicit_euler", "layer"), pytest.param("bdf2", "", marks=pytest.mark.slow)],
)
def test_gradients_of_an_oblique_impact(integrator, rigid, device):
    """Throws of a turning cube on a plate, which stick,
    slide and rebound, against central differences.
    """
    plate = box_tetrahedra((0.04, 0.04, 0.01), (2, 2, 1))
    simulator = landing(integrator=integrator, rigid=rigid, plate=plate, device=device)
    random = np.random.default_rng(0)
    velocity = simulator.tensor(random.uniform([-0.6, -0.6, -1.4], [0.6, 0.6, -0.8], (2, 3)))
    weights = simulator.tensor(random.normal(size=(2, 2, simulator.body.n_vertices, 3)))
    values = {
        "velocity": velocity,
        "spin": simulator.tensor(np.linspace(-5.0, 5.0, 2)),
        "surface_friction": simulator.tensor(np.linspace(0.1, 0.9, 2)[:, None]),
        "surface_stiffness": simulator.tensor(np.full((2, 1), KAPPA)),
        "plate_youngs_modulus": simulator.tensor(np.full((2, 1), 2.5e5)),
    }

    def loss(given):
        parameters = {name: given[name] for name in given if name not in ("velocity", "spin")}
        start = thrown(simulator, given["velocity"], given["spin"], len(given["spin"]))
        path = simulator.rollout(start, 7, parameters=parameters)
        ends = torch.stack([1e2 * path.q[-1], path.v[-1]]).unflatten(1, (-1, 2))
        return (ends * weights[:, None]).sum((0, 3, 4)).flatten()

    sizes = {"surface_stiffness": 10.0, "spin": 5e-5, "plate_youngs_modulus": 2.5}
    check_slopes(loss, values, {name: sizes.get(name, 1e-6) for name in values}, together=True)


def test_regions_have_their_own_friction():
    """Two cubes on a slope: one slides, and the other one stands on a rough part of the plate."""
    plate = box_hexahedra((0.12, 0.06, 0.01), (8, 4, 1))
    rough = select_cells(plate, y=(0.03, 0.06))
    plate = replace(plate, regions={"rough": rough})
    bodies = {"plate": Body(plate, fixed=select_vertices(plate, z=0.0))}
    for name, y in (("a", 0.007), ("b", 0.0385)):
        cube = box_hexahedra((0.015,) * 3, (2, 2, 2))
        bodies[name] = Body(replace(cube, vertices=cube.vertices + [0.01, y, 0.0109]))
    pairs = {"pad": FrictionPair(first="b", second="plate_rough", friction=0.6)}
    contact = SurfaceContact(2e4, 0.2, pairs=pairs)
    slope = math.radians(25.0)
    options = {"gravity": (G * math.sin(slope), 0.0, -G * math.cos(slope)), "solver": FINE}
    simulator = Simulator(
        Scene(bodies, contact), replace(SOFT, stiffness_damping=2e-3), 0.005, **options
    )
    a, b = (simulator.body.vertex_slice(name) for name in "ab")
    with torch.no_grad():
        half = simulator.rollout(simulator.rest_state(), 20)
        path = simulator.rollout(half.final, 20)
        forces = simulator.contacts(State(path.q[-2], path.v[-2]), path.final)["surfaces"]
    for own, expected in ((a, 0.005 * float(path.v[-1, 0, a, 0].mean())), (b, 0.0)):
        on = torch.isin(forces.vertices, torch.arange(own.start, own.stop)) & (forces.gap[0] < D)
        assert forces.slide[0, on].numpy() == pytest.approx(expected, rel=0.05, abs=5e-6)
        assert forces.sticks[0, on].tolist() == [expected == 0.0] * int(on.sum())
        assert int(on.sum()) >= 4
    gain = (path.v[-1, 0, a, 0] - path.v[0, 0, a, 0]).mean()
    assert float(gain) == pytest.approx(
        20 * 0.005 * G * (math.sin(slope) - 0.2 * math.cos(slope)), rel=0.01
    )
    assert float(path.v[-1, 0, b, 0].mean().abs()) < 1e-3
    assert simulator.parts["surface_friction"] == ("other", "pad")
    check_slopes(
        lambda given: simulator.rollout(half.final, 4, parameters=given).v[-1, 0, :, 0].sum(),
        {"surface_friction": torch.tensor([[0.2, 0.6]], dtype=torch.float64)},
        {"surface_friction": 1e-5},
    )
    pairs = {
        "first": FrictionPair(first="plate", second="b", friction=0.6),
        "second": FrictionPair(first="b", second="plate_rough", friction=0.05),
    }
    both = replace(simulator, body=Scene(bodies, SurfaceContact(2e4, 0.2, pairs=pairs)))
    swapped = dict(reversed(pairs.items()))
    other = replace(simulator, body=Scene(bodies, SurfaceContact(2e4, 0.2, pairs=swapped)))
    with torch.no_grad():
        held, slides = (s.rollout(s.rest_state(), 10).v[-1, 0, b, 0].mean() for s in (both, other))
    assert float(held) < 1e-3 < 0.1 < float(slides)  # the first pair that fits counts
    refuses(
        InputError, "the pair 'pad' of a contact", Simulator, Scene({"a": bodies["a"]}, contact)
    )
    with pytest.raises(
        InputError, match=r"FrictionPair\.friction is -1\.0: it must be a number, zero or more"
    ):
        SurfaceContact(pairs={"pad": FrictionPair(first="a", second="b", friction=-1.0)})
    for wrong in (
        [FrictionPair(first="a", second="b", friction=1.0)],
        {"other": FrictionPair(first="a", second="b", friction=1.0)},
    ):
        refuses(InputError, "by name, other than 'other'", SurfaceContact, pairs=wrong)
    with pytest.raises(InputError, match=r"3 values for 2 coefficients \(other, pad\)"):
        simulator.prepare({"surface_friction": torch.full((1, 3), 0.1, dtype=torch.float64)})


def test_momentum_is_conserved():
    """Two free bodies collide with friction: the sum of momenta stays what it was."""
    cube = turned(CUBE, (0.3, 0.2), (0.0, 0.0, 0.0))
    other = turned(CUBE, (0.9, -0.4), (0.004, 0.003, 0.036))
    scene = Scene({"one": Body(cube), "two": Body(other)}, SurfaceContact(KAPPA, 0.6))
    solver = SolverSettings(relative_tolerance=1e-13, absolute_tolerance=1e-15)
    simulator = Simulator(
        scene, SOFT, time_step=0.002, gravity=(0.0, 0.0, 0.0), integrator="bdf2", solver=solver
    )
    rest = simulator.rest_state()
    rest.v[:, scene.vertex_slice("two")] = simulator.tensor([0.2, -0.1, -2.5])
    path = simulator.rollout(rest, 20)
    momenta = (simulator.prepare().mass[..., None] * path.v).sum(2)
    assert float((momenta - momenta[0]).abs().max()) < 1e-11 * float(momenta[0].norm())
    assert float(path.v[-1][:, scene.vertex_slice("one"), 2].mean()) < -0.5  # It has been hit.


def clip():
    """A U of three bars, whose ends stand 8 mm apart."""
    mesh = box_hexahedra((0.03, 0.006, 0.028), (10, 2, 7))
    middle = mesh.vertices[mesh.cells].mean(1)
    kept = (middle[:, 0] < 0.006) | (np.abs(middle[:, 2] - 0.014) > 0.008)
    used, cells = np.unique(mesh.cells[kept], return_inverse=True)
    return Mesh(mesh.vertices[used], cells.reshape(-1, 8))


def test_a_body_touches_itself(device):
    """The ends of a clip are pressed together: without contact they pass through one another."""
    mesh = clip()
    ends = mesh.vertices[:, 0] > 0.029
    force = torch.zeros(1, len(mesh.vertices), 3, dtype=torch.float64)
    upper, lower = ends & (mesh.vertices[:, 2] > 0.014), ends & (mesh.vertices[:, 2] < 0.014)
    force[0, upper, 2], force[0, lower, 2] = -0.06 / upper.sum(), 0.06 / lower.sum()
    pressed = Inputs(external_force=force.to(device))
    pairs = PairList(Launcher(1, torch.device(device)), Surface.of(mesh), D)
    crossings = {}
    for name, energies in (("free", []), ("touching", [SurfaceContact(KAPPA, 0.3)])):
        body = clamped(mesh, energies=energies)
        simulator = Simulator(body, SOFT, time_step=0.004, gravity=(0.0, 0.0, 0.0), device=device)
        before = simulator.rollout(simulator.rest_state(), 9, pressed).final
        path = simulator.rollout(before, 1, pressed)
        crossings[name] = int(pairs.crossings(path.q[-1])[0])
    assert crossings["free"] > 0 == crossings["touching"]
    forces = simulator.contacts(before, path.final, pressed)["surfaces"]
    with torch.no_grad():
        # Action and reaction.
        assert float(forces.normal.sum((0, 1)).norm()) < 1e-6 * float(forces.normal.norm())
        assert float(forces.friction.sum((0, 1)).norm()) < 1e-6 * float(forces.friction.norm())
        assert 0.0 < float(forces.gap.min()) < D
        assert float(forces.normal.norm()) > 0.01


@pytest.mark.parametrize("rigid", [pytest.param("", marks=pytest.mark.slow), "layer"])
def test_batch_is_what_its_environments_are_alone(rigid, device):
    """Four environments with different contacts in one batch are what they are alone, on a CPU bit
    for bit.
    """
    random = np.random.default_rng(1)
    velocity = torch.tensor(random.uniform([-0.6, -0.6, -2.0], [0.6, 0.6, 1.0], (4, 3)))
    spin = torch.linspace(-4.0, 4.0, 4, dtype=torch.float64)
    settings = SolverSettings(linear_solver="banded")
    together, alone = (landing(rigid=rigid, solver=settings, device=device) for _ in range(2))
    path = together.rollout(thrown(together, velocity, spin, 4), 12)
    for b in range(4):
        own = alone.rollout(thrown(alone, velocity[b : b + 1], spin[b : b + 1]), 12)
        if device == "cpu":
            assert torch.equal(own.q[:, 0], path.q[:, b])
        torch.testing.assert_close(own.q[:, 0], path.q[:, b], rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("rigid", ["layer", "whole"])
def test_the_matrix_of_a_step_has_its_pairs(rigid):
    """H of a step in contact, as a matrix, is the difference of the residual."""
    simulator = landing(rigid=rigid)
    velocity = torch.tensor([[0.3, 0.0, -1.0]], dtype=torch.float64)
    state = simulator.rollout(thrown(simulator, velocity, velocity[:, 0]), 5).final
    step, x = simulator.linearise(state), simulator.step(state).q
    matrix, _ = step.matrix(x)
    way = torch.tensor(np.random.default_rng(0).normal(size=(1, len(step.free), 3)))
    ways = torch.zeros_like(x).index_copy(1, step.free, way)
    expected = (step.residual(x + 1e-9 * ways) - step.residual(x - 1e-9 * ways))[
        :, step.free
    ] / 2e-9
    step.update(x)
    close = pytest.approx(expected.numpy(), abs=1e-5 * float(expected.norm()))
    assert step.product(ways)[:, step.free].numpy() == close
    assert (matrix @ way.numpy().ravel()).reshape(expected.shape) == close
    assert float(simulator.contacts(state, State(x, state.v))["surfaces"].normal.norm()) > 0.0


@pytest.mark.parametrize("rise", [2e-3, pytest.param(0.03, marks=pytest.mark.slow)])
def test_driven_vertices_push_in_one_step(rise, device):
    """A plate that goes up by more than the gap below a cube, or its height, lifts it.

    Momentum and gradient.
    """
    simulator = landing(device=device)
    rest = simulator.rest_state()
    place = simulator.rest_positions[simulator.fixed].clone()
    place[:, 2] += rise
    cube, inputs = simulator.body.vertex_slice("cube"), Inputs(fixed_positions=place[None])
    after = simulator.step(rest, inputs)
    assert bool(after.converged.all())
    pairs = PairList(Launcher(1, rest.q.device), Surface.of(simulator.body.mesh), D)
    assert int(pairs.crossings(after.q)[0]) == 0
    assert float(after.q[0, cube, 2].min()) > 0.01 + 0.9 * rise
    forces = simulator.contacts(rest, after, inputs)["surfaces"]
    mass = simulator.prepare().mass[0, cube]
    lift = float(forces.normal[0, forces.vertices >= cube.start, 2].detach().sum())
    gain = after.v[0, cube, 2] - simulator.time_step * simulator.gravity[2]
    impulse = float((mass * gain).sum())
    assert lift * simulator.time_step == pytest.approx(impulse, rel=1e-5)
    again = simulator.step(after, inputs)
    assert int(pairs.crossings(again.q)[0]) == 0

    def height(more):
        up = place + more * simulator.tensor([0.0, 0.0, 1.0])
        q = landing(device=device).step(rest, Inputs(fixed_positions=up[None])).q
        return q[0, cube, 2].mean()

    more = simulator.tensor(0.0).requires_grad_()
    (slope,) = torch.autograd.grad(height(more), more)
    with torch.no_grad():
        expected = (height(1e-6) - height(-1e-6)) / 2e-6
    assert float(slope) == pytest.approx(float(expected), rel=1e-5)


def test_refusals():
    cube = replace(CUBE, vertices=CUBE.vertices + [0.0102, 0.0103, 0.01 + 1e-12])
    refuses(
        InputError,
        "touch at rest",
        Simulator,
        Scene({"plate": Body(PLATE), "cube": Body(cube)}, SurfaceContact()),
    )
    cube = replace(CUBE, vertices=CUBE.vertices + [0.01, 0.01, 0.005])
    words = r"cross at rest: an edge .* 'plate'.*; deepest is vertex \d+ in '(cube|plate)', by 5 mm"
    refuses(
        InputError,
        words,
        Simulator,
        Scene({"plate": Body(PLATE), "cube": Body(cube)}, SurfaceContact()),
    )
    within = Body(replace(CUBE, vertices=0.2 * CUBE.vertices + [0.01, 0.01, 0.003]))
    words = (
        r"a body with vertex \d+ in 'cube' is within that with vertex \d+ in 'plate' at rest: move"
    )
    refuses(
        InputError,
        words,
        Simulator,
        Scene({"plate": Body(PLATE), "cube": within}, SurfaceContact(distance=1e-4)),
    )
    refuses(
        InputError,
        "mm from itself",
        Simulator,
        Body(clip(), energies=[SurfaceContact(distance=0.02)]),
    )
    refuses(InputError, "distance of a contact between surfaces", SurfaceContact, distance=0.0)
    refuses(InputError, "surface_friction", SurfaceContact, friction=-0.1)
    with pytest.raises(InputError, match="symmetry planes"):
        Simulator(
            Body(CUBE, symmetry=[SymmetryPlane((1.0, 0.0, 0.0))], energies=[SurfaceContact()])
        )
    refuses(
        InputError,
        "midpoint",
        Simulator,
        Body(CUBE, energies=[SurfaceContact()]),
        integrator="midpoint",
    )
    simulator = landing()
    smaller, cube = simulator.rest_positions.clone(), simulator.body.vertex_slice("cube")
    smaller[cube] = 0.2 * (smaller[cube] - smaller[cube].mean(0)) + smaller.new_tensor(
        [0.02, 0.02, 0.005]
    )
    words = r"vertex \d+ in 'cube' is within that with .* in 'plate' at the start .* environment 0"
    refuses(InputError, words, simulator.step, simulator.state(smaller))
    crossing = simulator.rest_positions.clone()
    crossing[cube, 2] -= 0.008
    refuses(InputError, "cross at the start of a step", simulator.step, simulator.state(crossing))


def test_a_cube_in_a_hollow_is_not_within_the_body_around_it():
    """A shell with a small cube in its hollow.

    The small cube in the solid of a large one is seen, in its environment alone.
    """
    shell = box_hexahedra((0.03, 0.03, 0.03), (3, 3, 3))
    middle = np.abs(shell.vertices[shell.cells].mean(1) - 0.015).max(1) < 1e-3
    hollow = Mesh(shell.vertices, shell.cells[~middle])
    inner = box_hexahedra((0.004,) * 3, (1, 1, 1))
    inner = replace(inner, vertices=inner.vertices + 0.013)
    pairs = {}
    for name, mesh in (("hollow", hollow), ("solid", shell)):
        both = join({"outer": mesh, "inner": inner})
        pairs[name] = (
            PairList(Launcher(2, CPU), Surface.of(both), 1e-4),
            torch.tensor(both.vertices).repeat(2, 1, 1),
        )
        pairs[name][1][1, -8:] += 0.1
    assert pairs["hollow"][0].enclosed(pairs["hollow"][1]).tolist() == [[-1, -1]] * 2
    (inside, outer), other = pairs["solid"][0].enclosed(pairs["solid"][1]).tolist()
    assert inside >= len(shell.vertices) > outer >= 0
    assert other == [-1, -1]
