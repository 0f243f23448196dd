"""Forces and moments that hold a body: closed forms,
momentum, gradients, batches, contact, refusals.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.chambered import BRICK, chambered
from support.clamped import clamped, noise
from support.contact import SOFT, WEIGHT, G, on_obstacles, resting_floor
from support.refusals import refuses
from support.slopes import check_slopes
from warp_resphys import (
    Body,
    Corotated,
    HalfSpace,
    Inputs,
    Pressure,
    Scene,
    Simulator,
    SurfaceContact,
    Tendons,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.fem.bodies import PointMass
from warp_resphys.core.fem.rigid_region import Rigid
from warp_resphys.core.stepping.rollout import rollout
from warp_resphys.io.errors import InputError
from warp_resphys.mesh import find_chambers

BEAM = box_hexahedra(size=(0.1, 0.03, 0.02), divisions=(6, 2, 2))
SILICONE = Corotated(
    264e3, 0.45, density=1070.0, stiffness_damping=5e-3, mass_damping=0.5, prony=[(0.3, 0.05)]
)
ROUTE = {"top": [[x, 0.015, 0.018] for x in (0.0, 0.05, 0.1)]}
PULL = Inputs(tendon_tension=torch.tensor([[1.0]], dtype=torch.float64))


def swinging(integrator="implicit_euler", device="cpu", **options):
    """A beam with a weight at its tip and a tendon, of a silicone with memory."""
    tip = select_vertices(BEAM, x=0.1)
    body = clamped(BEAM, energies=[Tendons(ROUTE)], point_masses=[PointMass(0.02, tip)])
    given = {"time_step": 0.01, "relative_tolerance": 1e-13, **options}
    return Simulator(body, SILICONE, integrator=integrator, device=device, **given)


def test_a_clamp_holds_the_weight_and_its_moment(device):
    simulator = swinging(device=device)
    balance = simulator.static_equilibrium(PULL)
    reaction, constants = simulator.reaction(balance), simulator.prepare()
    weight = constants.load_mass[..., None] * constants.gravity[:, None]
    arms = balance.q - simulator.tensor([0.01, 0.02, 0.03])
    torch.testing.assert_close(reaction.force, -weight.sum(1), rtol=1e-10, atol=1e-10)
    moment = -torch.linalg.cross(arms, weight.expand_as(arms)).sum(1)
    torch.testing.assert_close(reaction.moment((0.01, 0.02, 0.03)), moment, rtol=1e-9, atol=1e-10)
    assert reaction.vertices.tolist() == simulator.fixed.tolist()


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2", "midpoint"])
def test_a_clamp_gives_the_rate_of_change_of_the_momentum(integrator):
    """Under pushes, of a clamp that moves; in the middle of midpoint steps."""
    simulator, clamp = swinging(integrator), BEAM.vertices[select_vertices(BEAM, x=0.0)]
    constants, state = simulator.prepare(), simulator.rest_state()
    mass = constants.mass[..., None]
    weight = constants.load_mass[..., None] * constants.gravity[:, None]
    for number, push in enumerate(1e-3 * noise(6, 1, len(BEAM.vertices), 3)):
        inputs = PULL.replace(external_force=push)
        way = (1e-3 * math.sin(number), 0.0, 5e-4 * number)
        inputs = inputs.replace(fixed_positions=simulator.tensor(clamp + way)[None])
        after = simulator.step(state, inputs)
        change, velocity = after.v - state.v, after.v
        if integrator == "midpoint":
            velocity = (after.q - state.q) / simulator.time_step
        elif state.previous is not None:
            change = 0.5 * (3.0 * after.v - 4.0 * state.v + state.previous[1])
        rate = mass * (change / simulator.time_step + constants.mass_damping[..., None] * velocity)
        expected = (rate - weight - push).sum(1)
        reaction = simulator.reaction(after).force
        torch.testing.assert_close(reaction, expected, rtol=0.0, atol=1e-8 * float(expected.norm()))
        state = after


def test_the_ends_of_a_chamber_are_held_against_pressure_times_area():
    """All vertices but one corner are fixed, so that the walls carry nothing."""
    soft = chambered("hexahedron")
    fixed = np.setdiff1d(
        np.arange(soft.n_vertices), select_vertices(soft.mesh, x=0.06, y=0.0, z=0.0)
    )
    chambers = find_chambers(soft.mesh, (1.0, 0.0, 0.0))
    simulator = Simulator(
        replace(soft, fixed=fixed, energies=[Pressure(chambers)]), SILICONE, gravity=(0.0, 0.0, 0.0)
    )
    state = simulator.static_equilibrium(
        Inputs(pressure=torch.full((1, len(chambers)), 2e4).double())
    )
    area = BRICK / 0.01  # of the chambers from 10 to 30 mm and from 40 to 50 mm
    for x, pushed in ((0.01, -1.0), (0.03, 1.0), (0.04, -1.0), (0.05, 1.0)):
        reaction = simulator.reaction(state, select_vertices(soft.mesh, x=x)).force[0]
        assert reaction.numpy() == pytest.approx(
            [-pushed * 2e4 * area, 0.0, 0.0], rel=1e-12, abs=1e-12
        )


def test_gradients_in_steps_and_equilibria():
    simulator = swinging(integrator="bdf2")
    random, n = noise(3, 2, len(BEAM.vertices), 3, seed=5), len(BEAM.vertices)
    weights = noise(2, len(simulator.fixed), 3, seed=6)
    values = {
        "youngs_modulus": simulator.tensor([[2.4e5], [3e5]]),
        "stiffness_damping": simulator.tensor([[4e-3], [6e-3]]),
        "tendon_tension": simulator.tensor([[1.0], [2.0]]),
        "attached_mass": simulator.tensor(np.full((2, n), 1e-4)),
        "external_force": 1e-3 * random[0],
        "v": 0.1 * random[1],
    }

    def loss(given, static=False):
        parameters = {name: given[name] for name in ("youngs_modulus", "stiffness_damping")}
        fields = ("tendon_tension", "attached_mass", "external_force")
        inputs = Inputs(**{name: given[name] for name in fields})
        if static:
            balance = simulator.static_equilibrium(inputs, parameters)
            return (simulator.reaction(balance).forces * weights).sum((1, 2))
        first = simulator.step(
            simulator.state(simulator.rest_state(2).q, given["v"]), inputs, parameters
        )
        after = simulator.step(first, inputs, parameters)
        reaction = simulator.reaction(after)
        return (reaction.forces * weights).sum((1, 2)) + 10.0 * reaction.moment(
            (0.0, 0.01, 0.02)
        ).sum(1)

    sizes = {
        "youngs_modulus": 30.0,
        "stiffness_damping": 1e-6,
        "tendon_tension": 1e-4,
        "attached_mass": 1e-7,
    }
    sizes |= {"external_force": 1e-5, "v": 1e-4}
    check_slopes(loss, values, sizes)
    at_rest = {
        name: value for name, value in values.items() if name not in ("v", "stiffness_damping")
    }
    constant = {"stiffness_damping": values["stiffness_damping"]}
    check_slopes(lambda given: loss({**given, **constant}, static=True), at_rest, sizes)


def test_a_batch_is_what_its_environments_are_alone(monkeypatch):
    """Also of environments whose solves end earlier than those of others, in two threads."""
    monkeypatch.setenv("WARP_RESPHYS_THREADS", "2")
    simulator = swinging(relative_tolerance=1e-9)
    tensions = simulator.tensor([[0.0], [0.5], [1.5], [3.0], [20.0]])
    start = simulator.rest_state(5)
    leaf, weights = tensions.clone().requires_grad_(), noise(len(simulator.fixed), 3)
    reaction = simulator.reaction(simulator.step(start, Inputs(tendon_tension=leaf)))
    (slopes,) = torch.autograd.grad((reaction.forces * weights).sum(), leaf)
    assert len(simulator.workspace(5).shards) == 2
    for b in range(5):
        alone = tensions[b : b + 1].clone().requires_grad_()
        after = simulator.step(start.select([b]), Inputs(tendon_tension=alone))
        (slope,) = torch.autograd.grad((simulator.reaction(after).forces * weights).sum(), alone)
        torch.testing.assert_close(slopes[b], slope[0], rtol=1e-10, atol=1e-10)
        assert torch.equal(reaction.forces[b], simulator.reaction(after).forces[0])
        assert torch.equal(reaction.moment()[b], simulator.reaction(after).moment()[0])


def test_a_floor_carries_a_block_and_a_wall_nothing():
    floor, wall = resting_floor(WEIGHT), HalfSpace(position=(0.0, 0.0, -1.0))
    simulator = on_obstacles({"floor": floor, "wall": wall}, mu=0.5, relative_tolerance=1e-10)
    state = simulator.static_equilibrium()
    contact = simulator.contacts(state, state)["obstacles"]
    for obstacle, expected in (("floor", WEIGHT), ("wall", 0.0), (None, WEIGHT)):
        reaction = contact.reaction(obstacle)
        assert reaction.force[0].numpy() == pytest.approx([0.0, 0.0, expected], abs=1e-6 * WEIGHT)
        assert reaction.moment((0.01, 0.01, 0.0))[0].numpy() == pytest.approx(
            np.zeros(3), abs=1e-6 * WEIGHT
        )
    refuses(InputError, "no obstacle 'roof': choose one of floor, wall", contact.reaction, "roof")
    refuses(InputError, "it has no reaction", simulator.reaction, state)


def test_grasping_plates_carry_a_cube():
    """Two plates close on a rigid cube: friction and the clamps carry its weight,
    and the clamps press alike.
    """
    plate = box_hexahedra((0.004, 0.02, 0.02), (1, 2, 2))
    cube = box_hexahedra((0.01, 0.01, 0.01), (1, 1, 1))
    shifted = replace(plate, vertices=plate.vertices + (0.0148, 0.0, 0.0))
    raised = replace(cube, vertices=cube.vertices + (0.0044, 0.005, 0.005))
    bodies = {
        "left": Body(plate, fixed=select_vertices(plate, x=0.0)),
        "right": Body(shifted, fixed=select_vertices(shifted, x=0.0188)),
        "cube": Body.rigid_body(raised, Rigid(density=1000.0)),
    }
    scene = Scene(bodies, SurfaceContact(1e5, 0.8, slip_speed=1e-4))
    simulator = Simulator(
        scene, SOFT, time_step=0.005, gravity=(0.0, 0.0, -G), relative_tolerance=1e-9
    )
    state, fixed = simulator.rest_state(), simulator.rest_positions[simulator.fixed]
    inwards = torch.where(fixed[:, :1] < 0.01, 1.0, -1.0) * fixed.new_tensor([1.0, 0.0, 0.0])
    with torch.no_grad():
        for number in range(24):
            inputs = Inputs(fixed_positions=(fixed + 5e-4 * min(1.0, number / 5) * inwards)[None])
            before, state = state, simulator.step(state, inputs)
        weight = 1000.0 * 1e-6 * G
        touch = (
            simulator.contacts(before, state, inputs)["surfaces"]
            .reaction()
            .at(scene.vertex_slice("cube"))
        )
        left, right = (simulator.reaction(state, name) for name in ("left", "right"))
    assert touch.force[0, 2] == pytest.approx(weight, rel=1e-3)
    plates = SOFT.density * 0.004 * 0.02 * 0.02 * G
    assert float(left.force[0, 2] + right.force[0, 2]) == pytest.approx(
        weight + 2.0 * plates, rel=1e-3
    )
    assert float(left.force[0, 0]) > 2.0 * weight
    assert float(left.force[0, 0] + right.force[0, 0]) == pytest.approx(
        0.0, abs=1e-3 * float(left.force[0, 0])
    )


def test_a_rigid_clamp_is_held_by_the_name_of_its_region():
    base = np.flatnonzero(BEAM.vertices[BEAM.cells].mean(1)[:, 0] < 0.02)
    mesh = replace(
        BEAM, regions={"base": base, "rest": np.setdiff1d(np.arange(len(BEAM.cells)), base)}
    )
    body = Body(mesh, fixed=np.unique(mesh.cells[base]), rigid={"base": Rigid(density=2000.0)})
    simulator = Simulator(body, SILICONE, relative_tolerance=1e-12)
    state = simulator.static_equilibrium()
    reaction = simulator.reaction(state, "base").force[0]
    weight = 9.80709 * 0.1 * 0.03 * 0.02 * (2000.0 + 5.0 * 1070.0) / 6.0  # its own, too
    assert reaction.tolist() == pytest.approx([0.0, 0.0, weight], rel=1e-10, abs=1e-10 * weight)
    moved = simulator.rest_positions[simulator.fixed] + simulator.tensor([1e-3, 0.0, 0.0])
    after = simulator.step(state, Inputs(fixed_positions=moved[None]))
    constants = simulator.prepare()
    # With mass damping.
    rate = (constants.mass[..., None] * (after.v / simulator.time_step + 0.5 * after.v)).sum(1)[0]
    pushed = simulator.reaction(after, "base").force[0] - rate
    assert pushed.tolist() == pytest.approx([0.0, 0.0, weight], rel=1e-9, abs=1e-9 * weight)
    tip = replace(mesh, regions={"tip": np.setdiff1d(np.arange(len(BEAM.cells)), base)[-2:]})
    other = Simulator(clamped(tip), SILICONE)
    refuses(
        InputError,
        "no vertex of 'tip' is fixed",
        other.reaction,
        other.step(other.rest_state()),
        "tip",
    )


def test_a_motion_has_the_reaction_of_every_step():
    simulator, start = swinging(), swinging().rest_state(2)
    pull = Inputs(tendon_tension=simulator.tensor([[1.0], [2.0]]))
    motion = simulator.rollout(start, 3, pull)
    half = simulator.fixed[::2].tolist()
    reaction, state = simulator.reaction(motion, half), start
    assert reaction.forces.shape == (3, 2, len(half), 3)
    for number in range(3):
        state = simulator.step(state, pull)
        now = simulator.reaction(state, half)
        torch.testing.assert_close(reaction.force[number], now.force)
        torch.testing.assert_close(
            reaction.moment((0.0, 0.01, 0.0))[number], now.moment((0.0, 0.01, 0.0))
        )
    assert Simulator(Body(BEAM), SILICONE).rollout(start, 1).reaction is None
    balance = simulator.static_equilibrium(pull)
    observed = rollout(
        lambda now, _: simulator.step(now, pull), balance, range(2), lambda now: now.reaction.force
    )
    for force in observed:  # an equilibrium stays
        torch.testing.assert_close(force, simulator.reaction(balance).force, rtol=0.0, atol=1e-8)


def test_gradients_of_an_equilibrium_with_friction_of_a_tendon():
    """Its friction depends on the pose without a potential.

    Alone, and beside a loss on the positions.
    """
    body = clamped(BEAM, energies=[Tendons(ROUTE, friction=0.5)])
    simulator = Simulator(body, SILICONE, relative_tolerance=1e-13)
    weights = noise(2, len(BEAM.vertices), 3)

    def loss(given, positions):
        balance = simulator.static_equilibrium(Inputs(tendon_tension=given["tendon_tension"]))
        forces = (simulator.reaction(balance).forces * weights[0, simulator.fixed]).sum()
        return forces + positions * (balance.q * weights[1]).sum()

    tension = {"tendon_tension": simulator.tensor([[1.0]])}
    for positions in (0.0, 30.0):
        check_slopes(
            lambda given, share=positions: loss(given, share),
            tension,
            {"tendon_tension": 1e-3},
            tolerance=1e-5,
        )


def test_gradients_of_a_clamp_that_moves_and_a_body_that_lands():
    simulator = on_obstacles(
        HalfSpace(position=(0.0, 0.0, -5e-4)),
        mu=0.5,
        fixed=[8],
        integrator="bdf2",
        relative_tolerance=1e-13,
    )
    start, weights = simulator.rest_positions[simulator.fixed], noise(3, seed=1)

    def loss(given):
        state, total = simulator.rest_state(), 0.0
        for number in range(1, 5):
            inputs = Inputs(fixed_positions=(start + 0.25 * number * given["way"])[None])
            state = simulator.step(state, inputs, {"youngs_modulus": given["youngs_modulus"]})
            total = total + (simulator.reaction(state).force[0] * weights).sum()
        return total

    values = {
        "way": simulator.tensor([[1e-3, 0.0, -8e-4]]),
        "youngs_modulus": simulator.tensor([[2.64e5]]),
    }
    check_slopes(loss, values, {"way": 1e-7, "youngs_modulus": 10.0})


def test_wrong_places_are_refused():
    simulator = swinging()
    refuses(
        InputError,
        "no step of a body with fixed vertices or symmetry planes led to this",
        simulator.reaction,
        simulator.rest_state(),
    )
    state = simulator.step(simulator.rest_state())
    refuses(
        InputError, "no region 'roof': its mesh has no regions", simulator.reaction, state, "roof"
    )
    whole, some = simulator.reaction(state), simulator.fixed[[3, 0, 5]]
    chosen = simulator.reaction(state, some)
    assert chosen.vertices.tolist() == some.tolist()
    assert torch.equal(chosen.forces, whole.forces[:, [3, 0, 5]])
    for wrong in ([0, len(BEAM.vertices) - 1], np.ones(len(whole.vertices), dtype=bool), []):
        refuses(
            InputError,
            "there is no reaction at some of these vertices",
            simulator.reaction,
            state,
            wrong,
        )
    refuses(InputError, "it is a copy, as by `detach`", simulator.reaction, state.detach())
