"""Half of a symmetric body between symmetry planes moves like the whole one.

The forces of the planes.
"""

import math

import numpy as np
import pytest
import torch

from support.clamped import clamped, noise
from support.refusals import refuses
from support.slopes import check_rows, check_slopes
from warp_resphys import (
    Body,
    Corotated,
    InputError,
    Inputs,
    Mesh,
    Rigid,
    Simulator,
    SolverSettings,
    StableNeoHookean,
    Tendons,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.dynamics.gradient_check import POSES, check_gradients
from warp_resphys.core.fem.coordinates import SymmetryPlane

SIZE = (0.1, 0.03, 0.03)
SOFT = StableNeoHookean(264e3, 0.45, mass_damping=0.5, stiffness_damping=1e-3)
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-12)
TURN = 0.4  # about x


def turned(points, angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(points) @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]).T


def beam(half, angle=0.0, rigid=False, stiffness=1e9):
    """A beam of four cells across, or its half y < 15 mm behind a symmetry plane,
    turned about its axis.
    """
    size, cells = ((SIZE[0], 0.015, SIZE[2]), (6, 2, 2)) if half else (SIZE, (6, 4, 2))
    mesh = box_hexahedra(size, cells)
    regions = (
        {"cap": np.flatnonzero(mesh.vertices[mesh.cells].mean(1)[:, 0] > 0.08)} if rigid else {}
    )
    mesh = Mesh(turned(mesh.vertices, angle), mesh.cells, regions)
    planes = [SymmetryPlane(turned([0.0, 1.0, 0.0], angle), 0.015)] if half else []
    return clamped(
        mesh,
        rigid={"cap": Rigid(density=1200.0, stiffness=stiffness)} if rigid else {},
        symmetry=planes,
    )


def simulator(body, angle=0.0, solver=TIGHT, **more):
    gravity = tuple(turned([0.0, 0.0, -9.81], angle))
    return Simulator(body, SOFT, gravity=gravity, solver=solver, integrator="bdf2", **more)


@pytest.mark.parametrize(
    ("solver", "linear", "angle", "rigid"),
    [
        ("newton", "banded", 0.0, False),
        ("quasi_newton", "auto", TURN, True),
        ("newton", "sparse", TURN, False),
    ],
)
def test_half_a_beam_swings_like_the_whole_one(solver, linear, angle, rigid):
    settings = SolverSettings(name=solver, relative_tolerance=1e-11, linear_solver=linear)
    half, whole = (beam(side, angle, rigid) for side in (True, False))
    runs = []
    for body in (half, whole):
        sim = simulator(body, angle, settings)
        runs.append(sim.rollout(sim.rest_state(), 12).q[:, 0])
    moved = (runs[1][-1] - runs[1][0]).norm(dim=1).max()
    assert moved > 0.003
    distance = np.linalg.norm(half.vertices[:, None] - whole.vertices[None], axis=2)
    assert distance.min(axis=1).max() < 1e-12
    error = (runs[0] - runs[1][:, distance.argmin(axis=1)]).norm(dim=2).max()
    assert error < 1e-7 * moved


def test_gradients_of_half_a_beam():
    # Differences are less exact by rounding, the stiffer the cap.
    rows = check_gradients(simulator(beam(True, TURN, rigid=True, stiffness=1e6)), POSES[-1])
    check_rows(
        rows,
        "q",
        "v",
        "external_force",
        "youngs_modulus",
        "cap_density, each environment",
        bound=1e-7,
    )


def test_the_plane_across_a_beam_holds_its_stress_times_its_area():
    """An eighth of a beam without lateral contraction, stretched by 10 %: E / 10.

    The other planes hold nothing.
    """
    mesh = box_hexahedra(SIZE, (5, 2, 2))
    ends = select_vertices(mesh, x=SIZE[0])
    mesh = Mesh(turned(mesh.vertices, TURN), mesh.cells)
    across, *along = planes = [SymmetryPlane(turned(axis, TURN)) for axis in np.eye(3)]
    body = Body(mesh, fixed=ends, symmetry=planes)
    sim = Simulator(body, Corotated(2e5, 0.0), gravity=(0.0, 0.0, 0.0), solver=TIGHT)
    pulled = sim.rest_positions[sim.fixed] * sim.tensor([1.1, 1.0, 1.0])
    state = sim.static_equilibrium(Inputs(fixed_positions=pulled[None]))
    force = np.array([-2e4 * SIZE[1] * SIZE[2], 0.0, 0.0])
    held, size = sim.reaction(state, across), np.linalg.norm(force)
    assert held.force[0].numpy() == pytest.approx(force, rel=1e-8, abs=1e-8 * size)
    about, middle = np.array([0.02, -0.01, 0.03]), turned([0.0, SIZE[1] / 2.0, SIZE[2] / 2.0], TURN)
    moment = np.cross(middle - about, force)
    assert held.moment(about)[0].numpy() == pytest.approx(moment, rel=1e-8, abs=1e-10 * size)
    assert sim.reaction(state, sim.fixed).force[0].numpy() == pytest.approx(
        -force, rel=1e-8, abs=1e-8 * size
    )
    for plane in along:
        assert float(sim.reaction(state, plane).forces.abs().max()) < 1e-8 * size


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2", "midpoint"])
def test_clamps_and_planes_give_the_rate_of_change_of_the_momentum(integrator):
    """Of half a beam that is pushed, also against its plane, and heavy towards it."""
    sim = Simulator(
        beam(True, TURN), SOFT, gravity=(1.0, -4.0, -9.0), solver=TIGHT, integrator=integrator
    )
    constants, state = sim.prepare(), sim.rest_state()
    mass = constants.mass[..., None]
    weight = constants.load_mass[..., None] * constants.gravity[:, None]
    for push in 1e-3 * noise(4, 1, sim.body.n_vertices, 3):
        after = sim.step(state, Inputs(external_force=push))
        change, velocity = after.v - state.v, after.v
        if integrator == "midpoint":
            velocity = (after.q - state.q) / sim.time_step
        elif state.previous is not None and integrator == "bdf2":
            change = 0.5 * (3.0 * after.v - 4.0 * state.v + state.previous[1])
        rate = mass * (change / sim.time_step + constants.mass_damping[..., None] * velocity)
        expected = (rate - weight - push).sum(1)
        (plane,) = sim.body.symmetry
        reactions = [sim.reaction(after, at).force for at in (sim.fixed, plane)]
        torch.testing.assert_close(
            sum(reactions), expected, rtol=0.0, atol=1e-9 * float(expected.norm())
        )
        assert abs(float(reactions[1] @ sim.tensor(turned([1.0, 0.0, 0.0], TURN)))) < 1e-15
        assert float(reactions[1].norm()) > 1e-3
        state = after


def test_half_a_beam_with_a_rigid_cap_is_held_like_the_whole_one():
    loads = []
    for side in (True, False):
        sim = simulator(beam(side, TURN, rigid=True), TURN)
        motion = sim.rollout(sim.rest_state(), 6)
        loads.append(torch.cat([motion.reaction.force, motion.reaction.moment()], -1)[:, 0])
    (plane,) = beam(True, TURN).symmetry
    middle = sim.tensor(plane.offset * np.asarray(plane.normal))
    force, moment = loads[0].split(3, -1)
    # About the middle, where halves are mirrored.
    moment = moment - torch.linalg.cross(middle.expand_as(force), force)
    normal = sim.tensor(plane.normal)
    force = 2.0 * (force - (force @ normal)[:, None] * normal)
    moment = 2.0 * (moment @ normal)[:, None] * normal + torch.linalg.cross(
        middle.expand_as(force), force
    )
    torch.testing.assert_close(
        force, loads[1][:, :3], rtol=0.0, atol=1e-7 * float(loads[1][:, :3].norm(dim=1).max())
    )
    torch.testing.assert_close(
        moment, loads[1][:, 3:], rtol=0.0, atol=1e-7 * float(loads[1][:, 3:].norm(dim=1).max())
    )


@pytest.mark.parametrize("static", [False, True])
def test_gradients_of_what_planes_exert(static):
    """With a spring of a tendon that couples all cells,
    loads against the planes, and velocities towards them.
    """
    mesh = box_hexahedra((0.06, 0.015, 0.015), (3, 1, 1))
    planes = [SymmetryPlane((0.0, 1.0, 0.0)), SymmetryPlane((0.0, math.sin(TURN), -math.cos(TURN)))]
    mesh = Mesh(
        mesh.vertices + np.outer(mesh.vertices[:, 1], [0.0, 0.0, math.tan(TURN)]), mesh.cells
    )
    routes = {"top": [[x, 0.012, 0.014] for x in (0.0, 0.03, 0.06)]}
    body = clamped(mesh, symmetry=planes, energies=[Tendons(routes, stiffness=300.0)])
    sim = Simulator(body, SOFT, solver=TIGHT, integrator="bdf2")
    weights = noise(2, len(sim.rest_positions), 3)

    def loss(given):
        inputs = Inputs(tendon_contraction=given["pull"], external_force=given["force"])
        parameters = {
            "youngs_modulus": given["youngs_modulus"],
            "tendon_stiffness": given["stiffness"],
        }
        if static:
            state = sim.static_equilibrium(inputs, parameters)
        else:
            state = sim.step(sim.state(sim.rest_state(2).q, given["v"]), inputs, parameters)
            state = sim.step(state, inputs, parameters)
        total = (state.reaction.forces * weights[0][state.reaction.vertices]).sum((1, 2))
        for number, plane in enumerate(planes):
            total = total + (20.0 + number) * sim.reaction(state, plane).moment(
                (0.01, 0.0, 0.02)
            ).sum(1)
        return total + 100.0 * (state.q * weights[1]).sum((1, 2))

    values = {
        "youngs_modulus": sim.tensor([[2.4e5], [3e5]]),
        "stiffness": sim.tensor([[300.0], [500.0]]),
        "pull": sim.tensor([[2e-3], [4e-3]]),
        "force": 1e-2 * noise(2, *weights[0].shape, seed=1),
        "v": 0.1 * noise(2, *weights[0].shape, seed=2),
    }
    sizes = {"youngs_modulus": 30.0, "stiffness": 0.1, "pull": 1e-5, "force": 1e-4, "v": 1e-4}
    check_slopes(
        loss, {name: value for name, value in values.items() if not static or name != "v"}, sizes
    )


def test_a_batch_is_what_its_environments_are_alone_and_near_in_single_precision(
    monkeypatch, device
):
    monkeypatch.setenv("WARP_RESPHYS_THREADS", "2")
    pushes, runs = 1e-2 * noise(3, len(beam(True).vertices), 3), []
    for dtype in (torch.float64, torch.float32):
        sim = simulator(
            beam(True, TURN),
            TURN,
            SolverSettings(relative_tolerance=1e-5),
            device=device,
            dtype=dtype,
        )
        start, push = sim.rest_state(3), sim.tensor(pushes)
        (plane,) = sim.body.symmetry
        runs.append(sim.reaction(sim.step(start, Inputs(external_force=push)), plane).force)
        for b in range(3):
            alone = sim.step(start.select([b]), Inputs(external_force=push[b : b + 1]))
            assert torch.equal(runs[-1][b], sim.reaction(alone, plane).force[0])
    torch.testing.assert_close(
        *(run.double() for run in runs), rtol=0.0, atol=1e-3 * float(runs[0].abs().max())
    )


def test_planes_that_hold_nothing_are_refused():
    sim = simulator(beam(True))
    state = sim.step(sim.rest_state())
    refuses(
        InputError,
        "choose one of the body's `symmetry`",
        sim.reaction,
        state,
        SymmetryPlane((0.0, 0.0, 1.0)),
    )


BOX = box_hexahedra(SIZE, (10, 4, 4))
NAMED = Mesh(BOX.vertices, BOX.cells, {"cap": np.arange(144, 160), "beam": np.arange(144)})


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: SymmetryPlane((0.0, 0.0, 0.0)), "normal"),
        (lambda: SymmetryPlane((0.0, math.nan, 1.0)), "normal"),
        (lambda: Body(BOX, symmetry=[SymmetryPlane((0.0, 1.0, 0.0), 0.5)]), "offset 0.5 m"),
        (
            lambda: Body(
                NAMED,
                rigid={"cap": Rigid()},
                symmetry=[SymmetryPlane((0, 1, 0)), SymmetryPlane((0, 1, 0), 0.03)],
            ),
            "'cap'",
        ),
        (
            lambda: simulator(beam(True), solver=SolverSettings(name="projective_dynamics")),
            "projective_dynamics",
        ),
    ],
)
def test_invalid_symmetry_is_refused(make, key):
    with pytest.raises(InputError, match=key):
        make()
