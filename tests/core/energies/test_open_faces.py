"""Pressure on open faces, whose edges are fixed or lie in symmetry planes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from support.chambered import force_of
from support.clamped import noise
from support.refusals import refuses
from support.slopes import check_rows, check_slopes
from warp_resphys import (
    Body,
    Inputs,
    Mesh,
    Pressure,
    Scene,
    Simulator,
    StableNeoHookean,
    SymmetryPlane,
    box_hexahedra,
    box_tetrahedra,
    quadratic,
    rod,
    select_vertices,
)
from warp_resphys.core.dynamics.gradient_check import check_gradients
from warp_resphys.io.errors import MeshError
from warp_resphys.mesh import Chamber, find_chambers, select_faces

SIDE, THICKNESS = 0.05, 0.004
RUBBER = StableNeoHookean(60e3, 0.45, density=1070.0, mass_damping=0.5, stiffness_damping=2e-3)
EXACT = {"gravity": (0.0, 0.0, 0.0), "solver": "newton", "relative_tolerance": 1e-13}
KINDS = ("hexahedron", "hexahedron20", "hexahedron27", "tetrahedron", "tetrahedron10")


def square(kind="hexahedron", cells=4, side=SIDE):
    """A plate from the origin."""
    make = box_hexahedra if kind.startswith("hexahedron") else box_tetrahedra
    mesh = make((side, side, THICKNESS), (cells, cells, 1))
    return mesh if kind == mesh.kind else quadratic(mesh, kind)


def rim_of(mesh, sides=(0.0, SIDE)):
    """Vertices at sides of a plate."""
    return np.unique(
        np.concatenate([select_vertices(mesh, **{axis: at}) for axis in "xy" for at in sides])
    )


def membrane(kind="hexahedron", mesh=None, fixed=None, **options):
    """A simulator of a plate, by default clamped at its sides, with pressure on its lower face."""
    mesh = square(kind) if mesh is None else mesh
    below = Chamber("below", select_faces(mesh, z=0.0))
    body = Body(
        mesh,
        fixed=rim_of(mesh) if fixed is None else fixed,
        energies=[Pressure([below])],
        **options,
    )
    return Simulator(body, RUBBER, **EXACT)


def load_of(simulator, q, pressure):
    """Force and moment of p n dA on the faces, by the tangents at their points."""
    (points,) = simulator.body.energies[0].points(simulator.body.mesh)
    f = torch.einsum(
        "cqkw,cki->cqiw", torch.as_tensor(points.gradients), q[torch.as_tensor(points.nodes)]
    )
    x, t1, t2 = f.flatten(0, 1).unbind(-1)
    forces = -3.0 * pressure * torch.as_tensor(points.weights)[:, None] * torch.linalg.cross(t1, t2)
    return forces.sum(0), torch.linalg.cross(x, forces).sum(0)


@pytest.mark.parametrize("kind", KINDS)
def test_the_clamp_carries_pressure_times_area(kind):
    """At once, before anything moves, and in a large deflection:
    the area within a plane rim stays.
    """
    simulator = membrane(kind)
    state = simulator.static_equilibrium(Inputs(pressure=[[1e-6], [3e3]]))
    rise = (state.q - simulator.rest_positions)[..., 2].amax(1)
    assert rise[0] < 1e-8
    assert rise[1] > 2.0 * THICKNESS
    for row, pressure in enumerate((1e-6, 3e3)):
        force, moment = load_of(simulator, state.q[row], pressure)
        assert force.tolist() == pytest.approx(
            [0.0, 0.0, pressure * SIDE**2], rel=1e-10, abs=1e-12 * pressure
        )
        reaction = simulator.reaction(state)
        torch.testing.assert_close(
            reaction.force[row], -force, rtol=1e-6 if row == 0 else 1e-9, atol=1e-12
        )
        torch.testing.assert_close(
            reaction.moment()[row], -moment, rtol=1e-5 if row == 0 else 1e-9, atol=1e-14
        )


@pytest.mark.parametrize("kind", ["hexahedron", "tetrahedron10"])
def test_a_base_that_moves_is_held_against_the_pressure_on_the_moved_faces(kind):
    """A clamp that is turned, stretched, bent and carried away,
    in an equilibrium and at the start of a motion.
    """
    simulator = membrane(kind)
    rim = simulator.rest_positions[simulator.fixed]
    turned = rim @ (torch.eye(3, dtype=torch.float64) + 0.2 * noise(3, 3)).mT + simulator.tensor(
        [0.3, -0.2, 0.1]
    )
    turned[:, 2] += 20.0 * rim[:, 0] ** 2 - 5.0 * rim[:, 1] ** 2
    inputs = Inputs(pressure=[[2e3]], fixed_positions=turned[None])
    state = simulator.static_equilibrium(inputs)
    force, moment = load_of(simulator, state.q[0], 2e3)
    reaction = simulator.reaction(state)
    torch.testing.assert_close(reaction.force[0], -force, rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(reaction.moment()[0], -moment, rtol=1e-9, atol=1e-11)
    shift = simulator.tensor([0.5, 0.0, 0.0])
    away = simulator.static_equilibrium(inputs.replace(fixed_positions=turned[None] + shift))
    torch.testing.assert_close(away.q, state.q + shift, rtol=0.0, atol=1e-11)


def hollow_box(cells, size):
    """A box of bricks with a chamber of the inner ones, but two layers at each side."""
    full = box_hexahedra(size, cells)
    place = np.floor(full.vertices[full.cells].mean(axis=1) / (np.array(size) / cells)).astype(int)
    inner = ((place >= 2) & (place < np.array(cells) - 2)).all(axis=1)
    used, cells = np.unique(full.cells[~inner], return_inverse=True)
    return Mesh(full.vertices[used], cells.reshape(-1, 8))


def test_one_wall_of_a_chamber_moves_alike_if_its_others_are_fixed():
    mesh = hollow_box((7, 7, 6), (0.07, 0.07, 0.06))
    (chamber,) = find_chambers(mesh)
    top = Chamber("top", select_faces(mesh, x=(0.02, 0.05), y=(0.02, 0.05), z=0.04))
    assert len(top.faces) == 9
    fixed = np.union1d(
        np.setdiff1d(chamber.vertices, np.setdiff1d(top.vertices, top.edges)),
        select_vertices(mesh, z=0),
    )
    energies = Pressure([chamber]), Pressure([top])
    states, volumes = [], []
    for energy in energies:
        simulator = Simulator(Body(mesh, fixed=fixed, energies=[energy]), RUBBER, **EXACT)
        rest = energy.volumes(mesh, simulator.rest_positions[None])
        states.append(simulator.static_equilibrium(Inputs(pressure=[[2e4]])))
        volumes.append(float(energy.volumes(mesh, states[-1].q) - rest))
    assert float((states[0].q - simulator.rest_positions).abs().max()) > 2e-3
    torch.testing.assert_close(states[0].q, states[1].q, rtol=0.0, atol=1e-12)
    assert volumes[1] == pytest.approx(volumes[0], rel=1e-9)
    assert volumes[0] > 0.0


def test_a_quarter_and_half_a_chamber_move_like_the_whole():
    """Between symmetry planes that are not through the origin.

    The chamber's edges are all in the plane.
    """
    whole, part = membrane(mesh=square(cells=6)), square(cells=3, side=SIDE / 2)
    planes = [SymmetryPlane((1.0, 0.0, 0.0), SIDE / 2), SymmetryPlane((0.0, 1.0, 0.0), SIDE / 2)]
    quarter = membrane(mesh=part, fixed=rim_of(part, (0.0,)), symmetry=planes)
    box = hollow_box((5, 6, 6), (0.05, 0.06, 0.06))
    centres = box.vertices[box.cells].mean(axis=1)
    used, cells = np.unique(box.cells[centres[:, 1] < 0.03], return_inverse=True)
    half = Mesh(box.vertices[used], cells.reshape(-1, 8))
    inside = select_faces(half, x=(0.02, 0.03), y=(0.02, 0.03), z=(0.02, 0.04))
    closed = Simulator(
        Body(box, select_vertices(box, x=0.0), energies=[Pressure(find_chambers(box))]),
        RUBBER,
        **EXACT,
    )
    middle = SymmetryPlane((0.0, 1.0, 0.0), 0.03)
    cut = Body(
        half,
        select_vertices(half, x=0.0),
        energies=[Pressure([Chamber("inside", inside)])],
        symmetry=[middle],
    )
    for full, piece, times, pressure in (
        (whole, quarter, 4, 3e3),
        (closed, Simulator(cut, RUBBER, **EXACT), 2, 1e4),
    ):
        there, here = (s.static_equilibrium(Inputs(pressure=[[pressure]])) for s in (full, piece))
        distance = torch.cdist(piece.rest_positions, full.rest_positions)
        assert float(distance.amin(1).max()) < 1e-7
        torch.testing.assert_close(here.q, there.q[:, distance.argmin(1)], rtol=0.0, atol=1e-10)
        swept = [
            s.body.energies[0].volumes(s.body.mesh, state.q)
            for s, state in ((full, there), (piece, here))
        ]
        force, moment = load_of(piece, here.q[0], pressure)
        reaction, length = piece.reaction(here), float(force.norm()) * SIDE
        torch.testing.assert_close(reaction.force[0], -force, rtol=0.0, atol=1e-9 * length / SIDE)
        torch.testing.assert_close(reaction.moment()[0], -moment, rtol=0.0, atol=1e-9 * length)
        swept[0] -= full.body.energies[0].volumes(full.body.mesh, full.rest_positions[None])
        assert float(swept[0]) == pytest.approx(times * float(swept[1]), rel=1e-8)


@pytest.mark.parametrize("kind", ["hexahedron", "tetrahedron10"])
def test_the_volume_is_swept_and_its_slope_is_the_force(kind):
    simulator = membrane(kind)
    energy = simulator.body.energies[0]
    mesh = simulator.body.mesh
    free = np.ones(len(simulator.rest_positions), bool)
    free[rim_of(mesh)] = False
    raised = simulator.rest_positions.clone()
    raised[:, 2] += (
        0.01 * torch.sin(np.pi / SIDE * raised[:, 0]) * torch.sin(np.pi / SIDE * raised[:, 1])
    )
    lifted = simulator.rest_positions + simulator.tensor([3.0, 2.0, 0.01])
    volumes = energy.volumes(mesh, torch.stack([simulator.rest_positions, raised, lifted]))[
        :, 0
    ].tolist()
    assert volumes[0] == 0.0
    assert volumes[1] == pytest.approx(
        4.0 / np.pi**2 * SIDE**2 * 0.01, rel=0.11 if kind == "hexahedron" else 0.01
    )
    assert volumes[2] == pytest.approx(SIDE**2 * 0.01, rel=1e-9)
    q = (raised + 1e-3 * torch.as_tensor(free)[:, None] * noise(*raised.shape)).requires_grad_()
    (slope,) = torch.autograd.grad(2e3 * energy.volumes(mesh, q[None]).sum(), q)
    force = force_of(simulator, q.detach()[None], simulator.tensor([[2e3]]))
    torch.testing.assert_close(
        force[0, free], slope[free], rtol=0.0, atol=1e-12 * float(slope.abs().max())
    )


@pytest.mark.parametrize("planes", [False, True])
def test_gradients_of_every_parameter(planes):
    mesh = square(cells=3)
    options = {"symmetry": [SymmetryPlane((0.0, 1.0, 0.0), SIDE)]} if planes else {}
    fixed = np.union1d(
        select_vertices(mesh, y=0.0),
        [*select_vertices(mesh, x=0.0), *select_vertices(mesh, x=SIDE)],
    )
    simulator = replace(
        membrane(mesh=mesh, fixed=fixed if planes else None, **options), gravity=(0.0, 0.0, -9.81)
    )
    check_rows(check_gradients(simulator, "rest", steps=2), "pressure", "q", "v")


@pytest.mark.parametrize("integrator", ["static", "bdf2", "midpoint"])
def test_gradients_after_a_large_deflection(integrator):
    """Of positions and reactions, by pressures, clamps and states.

    Also those of a symmetry plane and its corners.
    """
    mesh = square(cells=3)
    sides = [
        *select_vertices(mesh, x=0.0),
        *select_vertices(mesh, y=0.0),
        *select_vertices(mesh, x=SIDE),
    ]
    still = membrane(
        mesh=mesh, fixed=np.unique(sides), symmetry=[SymmetryPlane((0.0, 1.0, 0.0), SIDE)]
    )
    simulator = still if integrator == "static" else replace(still, integrator=integrator)
    rim, shape = simulator.rest_positions[simulator.fixed], (2, *simulator.rest_positions.shape)
    weights = noise(2, *shape, seed=4)
    start = still.static_equilibrium(Inputs(pressure=[[2e3], [3e3]])).q
    assert float((start - still.rest_positions)[..., 2].max()) > 2.0 * THICKNESS
    values = {
        "pressure": simulator.tensor([[2e3], [3e3]]),
        "rim": rim.expand(2, -1, -1) + 1e-3 * noise(2, *rim.shape),
    }
    if integrator != "static":
        values |= {"q": start, "v": 0.05 * noise(*shape, seed=5)}

    def loss(given):
        inputs = Inputs(pressure=given["pressure"], fixed_positions=given["rim"])
        if integrator == "static":
            state = simulator.static_equilibrium(inputs)
        else:
            state = simulator.step(simulator.state(given["q"], given["v"]), inputs)
            state = simulator.step(state, inputs)
        reaction = simulator.reaction(state)
        forces = (reaction.forces * weights[0][:, reaction.vertices]).sum(
            (1, 2)
        ) + 30.0 * reaction.moment().sum(1)
        return forces + 100.0 * (state.q * weights[1]).sum((1, 2))

    check_slopes(loss, values, {"pressure": 1.0, "rim": 1e-6, "q": 1e-6, "v": 1e-5})


def test_a_batch_is_what_its_environments_are_alone():
    simulator, pressures = membrane(), torch.tensor([[0.0], [500.0], [-2e3]], dtype=torch.float64)
    start = simulator.rest_state(3)
    leaf = pressures.clone().requires_grad_()
    after = simulator.step(start, Inputs(pressure=leaf))
    (slopes,) = torch.autograd.grad(
        simulator.reaction(after).force[:, 2].sum() + after.q.sum(), leaf
    )
    for b in range(3):
        alone = pressures[b : b + 1].clone().requires_grad_()
        one = simulator.step(start.select([b]), Inputs(pressure=alone))
        (slope,) = torch.autograd.grad(
            simulator.reaction(one).force[:, 2].sum() + one.q.sum(), alone
        )
        torch.testing.assert_close(slopes[b], slope[0], rtol=1e-10, atol=1e-10)
        assert torch.equal(after.q[b], one.q[0])
        assert torch.equal(simulator.reaction(after).forces[b], simulator.reaction(one).forces[0])


def test_closed_and_open_beside_each_other_and_in_a_scene():
    mesh = hollow_box((7, 7, 6), (0.07, 0.07, 0.06))
    (chamber,) = find_chambers(mesh)
    lid = Chamber("lid", select_faces(mesh, z=0.06))
    walls = [select_vertices(mesh, **{axis: at}) for axis in "xy" for at in (0.0, 0.07)]
    body = Body(mesh, fixed=np.unique(np.concatenate(walls)), energies=[Pressure([chamber, lid])])
    alone = Simulator(body, RUBBER, **EXACT)
    assert alone.parts["pressure"] == ("chamber_1", "lid")
    state = alone.static_equilibrium(Inputs(pressure=[[5e3, 1e3]]))
    assert alone.reaction(state).force[0].tolist() == pytest.approx(
        [0.0, 0.0, 1e3 * 0.07**2], abs=1e-9
    )
    moved = body.moved([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], (0.5, 0.0, 0.0))
    pair = Simulator(Scene({"one": body, "two": moved}), RUBBER, **EXACT)
    both = pair.static_equilibrium(Inputs(one_pressure=[[5e3, 1e3]], two_pressure=[[5e3, 1e3]]))
    reaction = pair.reaction(both, "two")
    assert reaction.force[0].tolist() == pytest.approx([0.0, 0.0, 1e3 * 0.07**2], abs=1e-9)
    torch.testing.assert_close(
        pair.reaction(both, "one").forces, alone.reaction(state).forces, rtol=0.0, atol=1e-10
    )


def inflated(stretch):
    """Pressure times radius over shear modulus and thickness,
    and height over radius, of a neo-Hookean membrane.

    Equilibrium of a clamped disc (Adkins and Rivlin 1952, Phil. Trans. R. Soc. A 244) from its
    stretch at the pole, in the radius s of the undeformed disc, with stretches l1 along meridians
    and l2 = r / s, and tensions t1 and t2.
    """

    def slope(s, y):
        r, l1, _ = y
        l2 = r / s
        t1, t2 = l1 - l1**-3 * l2**-2, l2 - l2**-3 * l1**-2
        sine = r**2 / (2.0 * s * t1)
        cosine = np.sqrt(1.0 - sine**2)
        change = t2 * cosine - t1 - 2.0 * l1**-3 * l2**-3 * (l1 * cosine - l2)
        return [l1 * cosine, change / (s * (1.0 + 3.0 * l1**-4 * l2**-2)), l1 * sine]

    def at_rim(s, y):
        return y[0] - s

    at_rim.terminal = True
    start = [1e-4 * stretch, stretch, 0.0]
    found = solve_ivp(slope, (1e-4, 2.0), start, events=at_rim, rtol=1e-9, atol=1e-12)
    return found.t[-1], found.y[2, -1] / found.t[-1]


def test_a_disc_of_rubber_rises_as_a_membrane():
    """By up to 0.72 of its radius, within its thickness over its radius."""
    radius, thickness, rubber = 0.05, 0.0005, StableNeoHookean(60e3, 0.499)
    disc = rod(
        [[0.0, 0.0, 0.0], [0.0, 0.0, thickness]], radius, layers=1, core=4, rings=8, nodes=20
    )
    below = Chamber("below", select_faces(disc, z=0.0))
    away = np.linalg.norm(disc.vertices[:, :2], axis=1)
    fixed = np.flatnonzero(away > away[below.edges].min() - 1e-9)
    simulator = Simulator(
        Body(disc, fixed, energies=[Pressure([below])]),
        rubber,
        **{**EXACT, "relative_tolerance": 1e-8},
    )
    middle, q = np.flatnonzero(away < 1e-9), None
    for stretch in (1.05, 1.2, 1.4):
        load, height = inflated(stretch)
        pressure = load * 60e3 / (2.0 * 1.499) * thickness / radius
        q = simulator.static_equilibrium(Inputs(pressure=[[pressure]]), start=q).q
        rise = float((q - simulator.rest_positions)[0, middle, 2].mean())
        assert rise / radius == pytest.approx(height, rel=0.01), stretch


def test_edges_that_can_move_are_refused():
    mesh = square()
    below, fixed = select_faces(mesh, z=0.0), select_vertices(mesh, x=0.0)

    def made(faces, held, **options):
        return Simulator(
            Body(mesh, held, energies=[Pressure([Chamber("below", faces)])], **options), RUBBER
        )

    refuses(
        MeshError,
        r"below has 12 open edges that can move, one of them at \(.*\) mm: close",
        made,
        below,
        fixed,
    )
    free = np.setdiff1d(rim_of(mesh), [rim_of(mesh)[0]])
    refuses(MeshError, "below has 2 open edges that can move", made, below, free)
    refuses(
        MeshError,
        "16 of the 16 faces of below look into the solid",
        made,
        below[:, ::-1],
        rim_of(mesh),
    )
    within = np.concatenate([below, mesh.cells[5:6][:, mesh.element.faces[2]]])
    refuses(
        MeshError,
        "1 of the 17 faces of below look into the solid, or are not on",
        made,
        within,
        rim_of(mesh),
    )
    sides = [SymmetryPlane((1.0, 0.0, 0.0), at) for at in (0.0, SIDE)]
    ends = np.union1d(select_vertices(mesh, y=0.0), select_vertices(mesh, y=SIDE))
    refuses(
        MeshError, "symmetry planes that have no common point", made, below, ends, symmetry=sides
    )
    refuses(
        MeshError,
        "no face of the surface has all its vertices at x = 0, z = 0 m",
        select_faces,
        mesh,
        x=0.0,
        z=0.0,
    )
