"""Internal forces: what holds a body carries true loads alone,
and nothing drives a body that is free.
"""

import numpy as np
import pytest
import torch

from support.clamped import clamped, noise
from support.contact import BLOCK, WEIGHT, on_obstacles, resting_floor
from support.slopes import check_slopes
from warp_resphys import (
    Body,
    Corotated,
    Inputs,
    Scene,
    Simulator,
    SolverSettings,
    SymmetryPlane,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.fem.internal_forces import InternalForces
from warp_resphys.core.stepping.state import Reaction

BEAM = box_hexahedra((0.06, 0.02, 0.02), (3, 1, 2))
# Of few cells.
pytestmark = pytest.mark.filterwarnings("ignore::warp_resphys.io.errors.ResphysWarning")
SILICONE = Corotated(264e3, 0.45, density=1070.0, mass_damping=0.5, stiffness_damping=2e-3)
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-13)
ABOUT = (0.01, -0.02, 0.03)
ENDS = np.union1d(select_vertices(BEAM, x=0.0), select_vertices(BEAM, x=0.06))


def simulated(body, **options):
    return Simulator(body, SILICONE, solver=TIGHT, **options)


def forces(simulator, size=2e-2, batch=2):
    """Random forces with a resultant that is a part of the weight."""
    return size * (0.3 + noise(batch, simulator.body.n_vertices, 3)).to(simulator.rest_positions)


def wrench(force, q):
    arms = q - torch.tensor(ABOUT, dtype=q.dtype, device=q.device)
    return torch.cat([force.sum(1), torch.linalg.cross(arms, force).sum(1)], 1)


def weight(simulator):
    constants = simulator.prepare()
    return constants.load_mass[..., None] * constants.gravity[:, None]


def rate(simulator, before, after):
    """Wrench of the rate of change of momentum of implicit Euler,
    with damping, about a point at the end.
    """
    constants, h = simulator.prepare(), simulator.time_step
    changes = (after.v - before.v) / h + constants.mass_damping[..., None] * after.v
    return wrench(constants.mass[..., None] * changes, after.q)


def held(reaction):
    return torch.cat([reaction.force, reaction.moment(ABOUT)], 1)


@pytest.mark.parametrize(
    "fixed", [select_vertices(BEAM, x=0.0), ENDS], ids=["one clamp", "two clamps"]
)
def test_clamps_hold_the_weight_alone(fixed, device):
    simulator = simulated(Body(BEAM, fixed), device=device)
    force = forces(simulator)
    at_rest = simulator.static_equilibrium(Inputs(internal_force=force))
    # The forces bend the beam.
    assert float((at_rest.q - simulator.static_equilibrium().q).abs().max()) > 5e-5
    loads = wrench(weight(simulator).expand_as(at_rest.q), at_rest.q)
    torch.testing.assert_close(held(at_rest.reaction), -loads, rtol=0.0, atol=1e-10)


def test_clamps_give_the_rate_of_change_of_momentum_in_motion():
    simulator = simulated(Body(BEAM, ENDS))
    push, state = 0.1 * forces(simulator).flip(1), simulator.rest_state(2)
    for _ in range(3):
        inputs = Inputs(internal_force=forces(simulator), external_force=push)
        before, state = state, simulator.step(state, inputs)
        loads = wrench(weight(simulator) + push, state.q)
        torch.testing.assert_close(
            held(state.reaction), rate(simulator, before, state) - loads, rtol=0.0, atol=1e-8
        )


def test_internal_forces_move_a_clamped_body_like_external_ones():
    simulator = simulated(clamped(BEAM))
    force = forces(simulator)
    pair = [simulator.step(simulator.rest_state(2), Inputs(**{name: force})) for name in NAMES]
    assert torch.equal(pair[0].q, pair[1].q)
    gap = held(pair[0].reaction) - held(pair[1].reaction)
    torch.testing.assert_close(gap, wrench(force, pair[0].q), rtol=0.0, atol=1e-12)


NAMES = ("internal_force", "external_force")


def test_two_clamps_share_a_force_by_the_law_of_the_lever():
    """Whatever their numbers of vertices, but for couples that small clamps hardly carry."""
    bar = box_hexahedra((0.6, 0.02, 0.02), (3, 1, 2))
    ends = np.setdiff1d(ENDS, select_vertices(BEAM, x=0.06, z=0.01))
    rest = torch.as_tensor(bar.vertices)
    internal, q = InternalForces(Body(bar, ends), rest), rest[None]
    force = torch.zeros_like(q)
    at = int(select_vertices(bar, x=0.2, y=0.02, z=0.02)[0])
    force[0, at, 1] = 1.0
    taken = internal.taken_up(
        Reaction(torch.as_tensor(ends), 0.0 * q[:, ends], q[:, ends]), force, q
    )
    left = bar.vertices[ends, 0] == 0.0
    assert float(taken.forces[0, left, 1].sum()) == pytest.approx(2.0 / 3.0, rel=1e-3)
    assert float(taken.forces[0, ~left, 1].sum()) == pytest.approx(1.0 / 3.0, rel=1e-3)


def test_a_free_body_keeps_its_momentum():
    """Which falls and spins under gravity and a push."""
    simulator = simulated(Body(BEAM))
    rest = simulator.rest_state(2)
    spin = 0.3 * simulator.tensor([1.0, 2.0, 3.0]).expand_as(rest.q)
    state = simulator.state(rest.q, torch.linalg.cross(spin, rest.q))
    push = 0.05 * forces(simulator).flip(1)
    for _ in range(3):
        before = state
        state = simulator.step(state, Inputs(internal_force=forces(simulator), external_force=push))
        loads = wrench(weight(simulator) + push, state.q)
        torch.testing.assert_close(rate(simulator, before, state), loads, rtol=0.0, atol=1e-8)
    # It deforms.
    assert float((torch.cdist(state.q, state.q) - torch.cdist(rest.q, rest.q)).abs().max()) > 1e-4


def test_a_free_body_whose_vertices_have_no_mass_is_balanced():
    """As of a rigid body, whose mass is a matrix of its own; a force of zero follows no pose."""
    rest = torch.as_tensor(BEAM.vertices)
    internal, q = InternalForces(Body(BEAM), rest), rest[None]
    force = 1.0 + noise(1, len(rest), 3)
    balanced = internal.balanced(force, q, torch.zeros(1, len(rest), dtype=torch.float64))
    torch.testing.assert_close(
        wrench(balanced, q), torch.zeros(1, 6).double(), rtol=0.0, atol=1e-12
    )
    assert internal.follow_pose(force)
    assert not internal.follow_pose(0.0 * force)


@pytest.mark.parametrize("count", [1, 2])
def test_a_body_on_pins_swings_under_true_loads_alone(count):
    """One fixed vertex is a ball joint, two are a hinge."""
    pins = select_vertices(BEAM, x=0.0, y=0.0)[:count]
    simulator = simulated(Body(BEAM, pins))
    before = simulator.rest_state(2)
    state = simulator.step(before, Inputs(internal_force=forces(simulator)))
    loads = wrench(weight(simulator).expand_as(state.q), state.q)
    torch.testing.assert_close(
        held(state.reaction), rate(simulator, before, state) - loads, rtol=0.0, atol=1e-8
    )


def test_half_a_body_is_held_by_its_other_half():
    """The clamp of a half carries half of the weight, as without internal forces."""
    simulator = simulated(
        Body(BEAM, select_vertices(BEAM, x=0.0), symmetry=[SymmetryPlane((0.0, 1.0, 0.0))])
    )
    clamp = simulator.fixed
    state = simulator.static_equilibrium(Inputs(internal_force=forces(simulator)))
    along = [0, 2, 4]  # forces in the plane and the moment about its normal
    loads = wrench(weight(simulator).expand_as(state.q), state.q)
    torch.testing.assert_close(
        held(state.reaction)[:, along], -loads[:, along], rtol=0.0, atol=1e-10
    )
    assert len(clamp) < len(state.reaction.vertices)


def test_each_body_of_a_scene_takes_up_its_own():
    scene = Scene({"a": clamped(BEAM), "b": clamped(BLOCK), "c": Body(BEAM)})
    simulator = Simulator(scene, SILICONE, solver=TIGHT)
    before = simulator.rest_state(2)
    state = simulator.step(before, Inputs(internal_force=forces(simulator)))
    mass = simulator.prepare().mass[..., None]
    for name in scene.bodies:
        part = scene.vertex_slice(name)
        rates = (mass * ((state.v - before.v) / simulator.time_step + 0.5 * state.v))[:, part].sum(
            1
        )
        expected = rates - weight(simulator)[:, part].sum(1)
        holds = 0.0 if name == "c" else simulator.reaction(state, name).force
        torch.testing.assert_close(expected, 0.0 * expected + holds, rtol=0.0, atol=1e-8)


def test_a_body_on_the_floor_presses_with_its_weight():
    simulator = on_obstacles({"floor": resting_floor(WEIGHT)}, 0.5, solver=TIGHT)
    rest = simulator.static_equilibrium()
    force = 0.02 * WEIGHT * (0.3 + noise(1, simulator.body.n_vertices, 3))
    pressed = simulator.static_equilibrium(Inputs(internal_force=force), after=rest)
    carried = simulator.reaction(pressed, "floor", rest).force
    torch.testing.assert_close(carried, -weight(simulator).sum(1), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("fixed", [select_vertices(BEAM, x=0.0), ()], ids=["clamped", "free"])
def test_gradients_agree_with_differences(fixed):
    simulator = simulated(Body(BEAM, fixed))
    state, weights = simulator.rest_state(), noise(1, simulator.body.n_vertices, 3)
    force = forces(simulator, batch=1)

    def outcome(values):
        end = simulator.rollout(state, 2, Inputs(internal_force=values["force"])).final
        loads = 0.0 if end.reaction is None else held(end.reaction).sum()
        return (weights * end.q).sum() + 1e-2 * loads

    check_slopes(outcome, {"force": force}, {"force": 1e-3})
