"""Friction of tendons against Euler's capstan, the play of a cable, and differences."""

import math

import numpy as np
import pytest
import torch

from support.refusals import refuses
from support.slopes import check_rows, check_slopes
from warp_resphys import (
    Body,
    Corotated,
    Inputs,
    Simulator,
    State,
    Tendons,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.dynamics import time_step
from warp_resphys.core.dynamics.gradient_check import check_gradients
from warp_resphys.core.energies.route import Route
from warp_resphys.io.errors import ConvergenceError, InputError

SIZE = (0.12, 0.04, 0.02)
BEAM = box_hexahedra(SIZE, (6, 2, 1))
CLAMP, TIP = select_vertices(BEAM, x=0.0), select_vertices(BEAM, x=SIZE[0])
SOFT, HARD = Corotated(264e3, 0.45, mass_damping=0.5, stiffness_damping=2e-3), Corotated(1e9, 0.3)
MU = 0.4
STRAIGHT = np.column_stack([np.linspace(0.0, SIZE[0], 7), np.full(7, 0.02), np.full(7, 0.018)])
# Around two corners of 90 degrees, and a straight one that ends earlier.
CORNERS = np.array([[0.0, 0.01, 0.01], [0.08, 0.01, 0.01], [0.08, 0.03, 0.01], [0.12, 0.03, 0.01]])
SHORT = STRAIGHT[:3]
DOWN = [[0.0, 0.0, -1.0]]


def simulator(*routes, material=SOFT, fixed=CLAMP, integrator="implicit_euler", **more):
    body = Body(BEAM, fixed=fixed, energies=(Tendons(routes, **({"friction": MU} | more)),))
    return Simulator(
        body, material, 0.01, (0.0, 0.0, 0.0), integrator, "newton", relative_tolerance=1e-12
    )


def tension(*newtons):
    return Inputs(tendon_tension=newtons)


def segments(state):
    return state.memory["tendon_segment_tension"][0].numpy()


def test_the_tension_of_a_hard_body_is_the_play_of_a_capstan():
    """It falls by exp(-mu pi/2) at every corner while it rises,
    stays while it turns, and rises by as much after.
    """
    s = simulator(CORNERS, SHORT, material=HARD)
    state, at, corner = s.rest_state(), np.zeros(3), math.exp(0.5 * math.pi * MU)
    for pull in [1.0, 4.0, 3.0, 2.0, 1.0, 0.4, 1.0, 1.5, 2.5]:
        state = s.step(state, tension(pull, 1.0))
        before = pull
        for k, factor in enumerate((1.0, corner, corner)):
            at[k] = before = np.clip(at[k], before / factor, before * factor)
        np.testing.assert_allclose(segments(state), [*at, 1.0, 1.0], rtol=1e-4)


def test_at_rest_the_tension_falls_by_the_angles_of_the_pose():
    """The forces on the vertices of the solution are those of segments with Euler's tensions."""
    pull, entry = 5.0, 0.7
    s = simulator(Route(guides=STRAIGHT, entry_angle=entry))
    free = simulator(STRAIGHT, friction=0.0)
    q = s.static_equilibrium(tension(pull)).q
    assert float((q - free.static_equilibrium(tension(pull)).q).abs().max()) > 3e-4
    above, below = (q[0].numpy()[select_vertices(BEAM, y=0.02, z=z)] for z in (0.02, 0.0))
    lines = np.diff(0.9 * above + 0.1 * below, axis=0)
    u = lines / np.linalg.norm(lines, axis=1)[:, None]
    turns = np.arccos(np.clip((u[1:] * u[:-1]).sum(1), -1.0, 1.0))
    assert turns.sum() > 0.3
    tensions = pull * np.exp(-MU * np.cumsum([entry, *turns]))
    # One tendon for every segment, without friction, holds the same pose under these tensions.
    split = simulator(*(STRAIGHT[k : k + 2] for k in range(6)), friction=None)
    np.testing.assert_allclose(split.static_equilibrium(tension(*tensions)).q, q, atol=5e-6)


@pytest.mark.parametrize(
    ("acting", "forgets"), [(tension(2.0), True), (Inputs(tendon_contraction=6e-3), False)]
)
def test_a_step_from_rest_holds_the_pose(acting, forgets):
    """Also where an environment is reset, whose memory is zero."""
    s = simulator(Route(guides=STRAIGHT, entry_angle=0.3), stiffness=400.0)
    pose = s.static_equilibrium(acting)
    zero = {"tendon_segment_tension": torch.zeros(1, 6, dtype=torch.float64)} if forgets else {}
    trajectory = s.rollout(State(pose.q, pose.v, memory=zero), 5, acting)
    torch.testing.assert_close(trajectory.q[-1], pose.q, rtol=0.0, atol=1e-8)


def test_a_slide_takes_the_tension_to_its_bound_over_the_bristle_length():
    """The end is pulled away and back by a few bristle lengths:
    the cable slides through its corners.
    """
    fixed = np.union1d(CLAMP, TIP)
    s = simulator(CORNERS, material=Corotated(1e7, 0.45), fixed=fixed, bristle_length=2e-4)
    rest, right = s.rest_positions[s.fixed], torch.as_tensor(np.isin(s.fixed.numpy(), TIP))[:, None]
    state, ends = s.rest_state(), []
    for slide in [0.0, *np.linspace(0.0, 8e-3, 17)[1:], *np.linspace(8e-3, -8e-3, 33)[1:]]:
        moved = rest + slide * right * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
        state = s.step(state, tension(2.0).replace(fixed_positions=moved[None]))
        ends.append(segments(state))
    out, back, corner = ends[16], ends[-1], math.exp(0.5 * math.pi * MU)
    np.testing.assert_allclose(out[1] / out[0], corner, rtol=0.02)
    np.testing.assert_allclose(back[1] / back[0], 1.0 / corner, rtol=0.02)
    np.testing.assert_allclose(out[0], 2.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("integrator", "routes", "more"),
    [
        (
            "implicit_euler",
            (Route(guides=STRAIGHT, entry_angle=0.5, offsets=DOWN),),
            {"stiffness": 300.0},
        ),
        ("bdf2", (CORNERS, SHORT), {"stiffness": 300.0}),
        ("midpoint", (CORNERS,), {}),
    ],
)
def test_gradients_of_a_rollout_equal_differences(integrator, routes, more):
    """With long bristles, so that no difference takes a guide across the end of sticking."""
    s = simulator(*routes, integrator=integrator, bristle_length=2e-2, **more)
    rows = check_gradients(s, "bent", steps=3)
    assert {"tendon_friction, each tendon", "tendon_bristle_length, each tendon"} <= {
        row.parameter for row in rows
    }
    rounding = 1e-13  # of the differences; that of the stiffness of a slack spring is no more
    for row in rows:
        assert abs(row.adjoint - row.difference) <= 1e-6 * abs(row.difference) + rounding, (
            row.parameter
        )


def test_gradients_of_a_pose_equal_differences():
    s = simulator(Route(guides=STRAIGHT, entry_angle=0.2, offsets=DOWN), stiffness=400.0)
    values = {
        "tendon_friction": MU,
        "youngs_modulus": 264e3,
        "tendon_offset_1": 0.0,
        "tension": 1.5,
        "shorter": 8e-3,
    }
    sizes = {
        "tendon_friction": 1e-2,
        "youngs_modulus": 2e3,
        "tendon_offset_1": 1e-4,
        "tension": 1e-2,
        "shorter": 1e-4,
    }
    weights = (
        torch.linspace(-1.0, 1.0, s.rest_positions.numel()).double().reshape(s.rest_positions.shape)
    )

    def loss(given):
        parameters = {
            name: given[name] for name in ("tendon_friction", "youngs_modulus", "tendon_offset_1")
        }
        acting = Inputs(
            tendon_tension=given["tension"][None], tendon_contraction=given["shorter"][None]
        )
        return (s.static_equilibrium(acting, parameters).q[0] * weights).sum()

    check_slopes(
        loss, {name: torch.tensor([value]).double() for name, value in values.items()}, sizes
    )


def test_gradients_from_a_straight_rest_are_finite_and_right():
    """Angles are zero there, where that of a chord has no derivative."""
    s = simulator(STRAIGHT)

    def loss(given):
        return (
            s.rollout(s.rest_state(), 4, Inputs(tendon_tension=given["pull"])).q[-1].square().sum()
        )

    check_slopes(loss, {"pull": torch.tensor([[0.5]], dtype=torch.float64)}, {"pull": 0.02})


@pytest.mark.parametrize(
    ("route", "more", "words"),
    [
        (STRAIGHT, {"friction": -0.1}, "tendon_friction is -0.1"),
        (STRAIGHT, {"bristle_length": 0.0}, "tendon_bristle_length is 0"),
        (Route(guides=STRAIGHT, entry_angle=1.0), {"friction": None}, "acts by friction"),
        (STRAIGHT, {"friction": None, "bristle_length": -1.0}, "tendon_bristle_length is -1"),
        (
            [[0.3, 0.0, 0.0], [SIZE[0], 0.02, 0.02]],
            {},
            r"lies 180 mm outside .*: .* name it among the fixed guides",
        ),
    ],
)
def test_bad_friction_is_refused(route, more, words):
    refuses(InputError, words, simulator, route, **more)


@pytest.mark.parametrize(
    ("guides", "keys", "words"),
    [
        (
            STRAIGHT,
            {"entry_angle": -1.0},
            r"Route.entry_angle is -1\.0: it must be a number, zero or more, in rad",
        ),
        (CORNERS, {"fixed_guides": [4]}, "the route has guides 0 to 3"),
        (SHORT, {"fixed_guides": [0, 1, 2]}, "the tendon does not pull on the body"),
    ],
)
def test_bad_routes_are_refused(guides, keys, words):
    refuses(InputError, words, Route, guides=guides, **keys)


def test_friction_that_no_pose_holds_and_memory_of_another_body_are_refused(monkeypatch):
    monkeypatch.setattr(time_step, "_MOST_SETTLINGS", 2)
    s = simulator(STRAIGHT)
    refuses(ConvergenceError, "lower the friction, the tension", s.static_equilibrium, tension(6.0))
    s = simulator(STRAIGHT)
    state = s.rest_state()
    state = State(state.q, state.v, memory={"tendon_segment_tension": torch.zeros(1, 3).double()})
    refuses(InputError, "tendon_segment_tension", s.step, state)


def test_guides_in_the_world_pull_as_a_cable_to_a_post():
    """The force of a cable from the tip to a post, over a pulley above it,
    is its tension along the line.
    """
    post, pulley, end = [0.3, 0.02, -0.1], [0.25, 0.02, 0.1], [SIZE[0], 0.02, 0.02]
    s = simulator(Route(guides=[post, pulley, end], fixed_guides=[0, 1]), friction=0.3)
    state = s.rest_state()
    force = s.linearise(state, tension(2.0)).residual(state.q)[0].numpy()
    corner = math.acos(
        np.dot(
            *(x / np.linalg.norm(x) for x in (np.subtract(pulley, post), np.subtract(end, pulley)))
        )
    )
    line = np.subtract(pulley, end)
    expected = 2.0 * math.exp(-0.3 * corner) * line / np.linalg.norm(line)
    tip = int(np.argmin(np.linalg.norm(BEAM.vertices - end, axis=1)))
    np.testing.assert_allclose(-force[tip], expected, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(np.delete(force, tip, 0), 0.0, atol=1e-9)
    check_rows([row for row in check_gradients(s, "bent", steps=2) if abs(row.difference) > 1e-12])
