"""Contact with rigid obstacles: shapes, barrier, Coulomb's friction,
gradients, moved obstacles, refusals.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.clamped import noise
from support.contact import BLOCK, KAPPA, SIDE, SOFT, WEIGHT, D, G, distances, resting_floor
from support.contact import on_obstacles as simulator
from support.refusals import refuses
from support.slopes import check_slopes
from warp_resphys import (
    Body,
    Corotated,
    Inputs,
    Simulator,
    State,
    SymmetryPlane,
    box_hexahedra,
    box_tetrahedra,
)
from warp_resphys.core.energies.contact.contact_points import vertex_areas, vertex_factors
from warp_resphys.core.energies.contact.obstacle_contact import Contact
from warp_resphys.core.energies.contact.obstacle_poses import ObstacleSet, Pose
from warp_resphys.core.energies.contact.touching_bodies import (
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    Sphere,
)
from warp_resphys.core.mesh.selection import select_cells, select_vertices
from warp_resphys.io.errors import InputError

CPU = torch.device("cpu")
TIGHT = {"solver": "newton", "relative_tolerance": 1e-13}
DENSITY = 1070.0
GROOVE = {"left": 0.6, "right": -0.4}
PLACED = {"position": (0.004, -0.003, 0.002), "axis": (0.3, -0.2, 0.9)}
SHAPES = {
    "half-space": HalfSpace(**PLACED),
    "sphere": Sphere(radius=0.02, **PLACED),
    "capsule": Capsule(radius=0.012, length=0.03, **PLACED),
    "box": Box(edges=(0.02, 0.03, 0.04), **PLACED),
    "cylinder": Cylinder(radius=0.015, length=0.03, **PLACED),
}


def vector(*values):
    return torch.tensor(values, dtype=torch.float64)


def measured(obstacle, x):
    """Distances (P,) and normals (P, 3) of positions (P, 3)."""
    pose = Pose(
        vector(obstacle.position)[None], torch.as_tensor(obstacle.turn)[None, None], vector([0.0])
    )
    return (value[0, :, 0] for value in ObstacleSet((obstacle,), D, CPU).distances(x[None], pose))


@pytest.mark.parametrize("shape", SHAPES)
def test_distances_and_normals_within_and_around_a_shape(shape):
    """Normals lead to the surface: x - d n lies on it.

    They are continuous outside, where regions of a shape meet.
    """
    obstacle = SHAPES[shape]
    assert obstacle.turn.T @ obstacle.turn == pytest.approx(np.eye(3), abs=1e-15)
    assert obstacle.turn[:, 2] == pytest.approx(
        np.array(PLACED["axis"]) / np.linalg.norm(PLACED["axis"])
    )
    x = torch.as_tensor(np.random.default_rng(0).normal(size=(4000, 3)) * 0.025 + obstacle.position)
    d, n = measured(obstacle, x)
    np.testing.assert_allclose(d, distances(obstacle, x.numpy()), atol=1e-15)
    assert int((d < 0.0).sum()) > 200
    assert n.norm(dim=-1).numpy() == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(distances(obstacle, (x - d[:, None] * n).numpy()), 0.0, atol=1e-15)
    # The projection on a convex set is no expansion, so that n turns by no more than |dx| / d.
    ways = torch.as_tensor(np.random.default_rng(1).normal(size=x.shape)) * 1e-3
    further, turned = measured(obstacle, x + ways)
    apart = torch.minimum(d, further) > 1e-4
    size = ways.norm(dim=-1)
    assert bool(((turned - n).norm(dim=-1) <= 2.0 * size / torch.minimum(d, further))[apart].all())
    # Convexity, on which bounds of steps rely.
    assert bool((d + (n * ways).sum(-1) <= further + 1e-15).all())


@pytest.mark.parametrize("shape", SHAPES)
def test_derivatives_of_distances_and_normals(shape):
    """By position, place, rotation and growth: first
    and second derivatives of the distance, and `turn_slope`.
    """
    obstacles = (SHAPES[shape], SHAPES[shape].changed(axis=(1.0, 0.5, 0.1)))
    rng, shapes = np.random.default_rng(2), ObstacleSet(obstacles, D, CPU)
    y = rng.normal(size=(2, 40, 3)) * 0.025
    turns = np.stack([np.stack([o.turn for o in obstacles])] * 2)
    given = (y, rng.normal(size=(2, 2, 3)) * 1e-3, turns, rng.normal(size=(2, 2)) * 1e-3)
    given = tuple(torch.as_tensor(value).requires_grad_() for value in given)
    weights = [torch.as_tensor(rng.normal(size=size)) for size in ((2, 40, 2), (2, 40, 2, 3))]

    def total(x, place, turn, growth):
        d, n = shapes.distances(x, Pose(place, turn, growth))
        return (weights[0] * d).sum() + 0.01 * (weights[1] * n).sum()

    assert torch.autograd.gradcheck(total, given, eps=1e-8, atol=2e-6, rtol=2e-6)


@pytest.mark.parametrize(
    "mesh",
    [box_hexahedra((0.1, 0.03, 0.02), (3, 2, 2), nodes=n) for n in (8, 20, 27)]
    + [box_tetrahedra(order=2)],
)
def test_areas_of_vertices_sum_to_the_surface(mesh):
    size, areas = np.ptp(mesh.vertices, axis=0), vertex_areas(mesh)
    assert areas.sum() == pytest.approx(
        2.0 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    )
    assert areas.min() == 0.0
    inner = ((mesh.vertices > 1e-9) & (mesh.vertices < size - 1e-9)).all(1)
    assert np.all(areas[inner] == 0.0)


def resting(tilt=0.0, moves=False, **options):
    """A block at rest on a floor under gravity that is tilted
    by an angle [degrees], and its gap [m].
    """
    floor = resting_floor(WEIGHT * math.cos(math.radians(tilt)))
    return simulator(floor.changed(moves=moves), **options), -floor.position[2]


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_forces_of_contact_balance_a_block_that_sticks_or_slides(integrator):
    """On inclines of half a degree less and more than arctan mu,
    the second of which begins beyond the slip speed.
    """
    mu, h = vector([0.3], [0.3]), 5e-3
    radians = math.atan(0.3) + np.radians([-0.5, 0.5])
    gravity = torch.as_tensor(G * np.stack([np.sin(radians), 0.0 * radians, -np.cos(radians)], 1))
    s, _ = resting(20.0, integrator=integrator, time_step=h, **TIGHT)
    given, start = {"contact_friction": mu, "gravity": gravity}, s.rest_state(2)
    start = State(start.q, start.v + vector([0.0, 0.0, 0.0], [0.02, 0.0, 0.0])[:, None])
    states = [start]
    for _ in range(30):
        states.append(s.step(states[-1], None, given))
    earlier, before, after = states[-3:]
    old, new = (
        s.contacts(*pair, None, given)["obstacles"] for pair in ((earlier, before), (before, after))
    )
    assert new.obstacles == ("obstacle",)
    weights = {"implicit_euler": (1.0, -1.0, 0.0), "bdf2": (1.5, -2.0, 0.5)}[integrator]
    v = [state.v for state in (after, before, earlier)]
    acceleration = sum(w * value for w, value in zip(weights, v, strict=True)) / h
    force = (s.prepare().mass[..., None] * (acceleration - gravity[:, None])).sum(1)
    acting = (new.normal + new.friction).sum((1, 2))
    assert acting.numpy() == pytest.approx(
        force.numpy(), abs=1e-6 * float(force.norm(dim=-1).min())
    )
    pressed = old.normal.norm(dim=-1) > 0.0
    assert bool((new.normal[..., 2] >= 0.0).all())
    # Coulomb's law with the normal force at the start of the step; the slide is that of the
    # velocity at its end.
    slide, at = after.v[:, new.vertices, None, :2], pressed[1]
    full = mu[1] * old.normal[1].norm(dim=-1)
    assert new.friction[1].norm(dim=-1).numpy() == pytest.approx(full.numpy(), rel=1e-6)
    assert new.friction[1, ..., :2][at].numpy() == pytest.approx(
        (-full[..., None] * slide[1] / slide[1].norm(dim=-1, keepdim=True))[at].numpy(),
        rel=1e-6,
        abs=1e-9,
    )
    assert bool(((new.friction[..., :2] * slide).sum(-1)[pressed] < 0.0).all())
    assert new.slide.numpy() == pytest.approx(h / weights[0] * slide.norm(dim=-1).numpy(), rel=1e-6)
    assert torch.equal(new.sticks[0], pressed[0])
    assert not bool(new.sticks[1].any())


def test_friction_of_a_region_of_the_body():
    """Factors of 3 and 1: vertices within the region,
    beside it and between them have three, one and two times mu.
    """
    halves = {
        "left": select_cells(BLOCK, x=(0.0, 0.01)),
        "top": select_cells(BLOCK, z=(0.01, SIDE)),
    }
    mesh, x = replace(BLOCK, regions=halves), BLOCK.vertices[:, 0]
    factors = vertex_factors(mesh, {"left": 3.0})
    assert factors == pytest.approx(np.where(x < 0.009, 3.0, np.where(x > 0.011, 1.0, 2.0)))
    mu, floor = 0.2, resting_floor(WEIGHT)
    contact = Contact({"floor": floor}, KAPPA, mu, D, 1e-3, {"left": 3.0})
    s = Simulator(Body(mesh, energies=[contact]), SOFT, 5e-3, **TIGHT)
    start = s.rest_state()
    states = [State(start.q, start.v + vector(0.5, 0.0, 0.0))]
    for _ in range(3):
        states.append(s.step(states[-1]))
    earlier, before, after = states[-3:]
    old, new = (s.contacts(*pair)["obstacles"] for pair in ((earlier, before), (before, after)))
    normal, friction = old.normal[0, :, 0, 2].numpy(), new.friction[0, :, 0].norm(dim=-1).numpy()
    pressed = normal > 0.0
    assert pressed.sum() == 9
    assert friction[pressed] == pytest.approx(
        (mu * factors[new.vertices] * normal)[pressed], rel=1e-6
    )
    force = (s.prepare().mass[..., None] * (after.v - before.v) / 5e-3).sum(1)[0, 0]
    assert float(force) == pytest.approx(
        -float(mu * (factors[new.vertices] * normal).sum()), rel=1e-6
    )


@pytest.mark.parametrize("moves", [False, True])
def test_a_batch_is_bit_for_bit_its_environments(moves):
    """In a groove, whose two sides approach by different ways."""
    sides = {
        name: HalfSpace(position=(0.01, 0.0, -0.008), axis=(x, 0.0, 1.0), moves=moves)
        for name, x in GROOVE.items()
    }
    s, steps = simulator(sides, 0.3), 12
    start = s.rest_state(4)
    speeds = vector([0.0, 0.0, 0.0], [0.0, 0.0, -2.0], [1.0, 0.1, -0.2], [0.3, 0.0, 1.0])
    start = State(start.q, start.v + speeds[:, None])
    times = torch.linspace(0.0, 1.0, steps, dtype=torch.float64)[:, None, None]
    rise = times * vector([0.0, 1e-3], [5e-3, 2e-3], [-2e-3, 8e-3], [8e-3, 8.5e-3])
    trajectory = s.rollout(start, steps, Inputs(obstacle_move_z=rise) if moves else None)
    for b in range(4):
        row = slice(b, b + 1)
        inputs = Inputs(obstacle_move_z=rise[:, row]) if moves else None
        alone = replace(s).rollout(State(start.q[row], start.v[row]), steps, inputs)
        assert torch.equal(alone.q[:, 0], trajectory.q[:, b])
        assert torch.equal(alone.v[:, 0], trajectory.v[:, b])


def test_a_floor_that_moves_carries_a_block():
    """A conveyor at 0.05 m/s, and a table that turns: the block follows both."""
    s, _ = resting(moves=True, mu=0.5, integrator="bdf2")
    times = s.time_step * torch.arange(1, 61, dtype=torch.float64)[:, None, None]
    speed = 0.05
    carried = s.rollout(s.rest_state(), 60, Inputs(obstacle_move_x=speed * times)).v[-1, 0]
    assert carried.numpy() == pytest.approx(
        np.broadcast_to([speed, 0.0, 0.0], carried.shape), abs=2e-5
    )
    rate = 1.0
    turned = s.rollout(s.rest_state(), 60, Inputs(obstacle_rotate_z=rate * times))
    bottom = torch.as_tensor(select_vertices(BLOCK, z=0.0))
    q, v = turned.q[-1, 0, bottom], turned.v[-1, 0, bottom]
    expected = torch.linalg.cross(vector(0.0, 0.0, rate).expand_as(q), q)
    assert v[:, :2].numpy() == pytest.approx(expected[:, :2].numpy(), abs=1e-3)


@pytest.mark.parametrize(("integrator", "moves"), [("implicit_euler", False), ("bdf2", True)])
def test_gradients_of_a_rollout_that_sticks_slides_and_rebounds(integrator, moves):
    floor = HalfSpace(position=(0.0, 0.0, -1.2e-3), axis=(0.03, -0.02, 1.0), moves=moves)
    ball = Sphere(position=(0.008, 0.012, -0.0315), radius=0.03, moves=moves)
    material, steps, slip = replace(SOFT, stiffness_damping=2e-4), 14, 2e-2
    options = {"slip_speed": slip, "integrator": integrator, "time_step": 1e-3, **TIGHT}
    s = simulator({"floor": floor, "ball": ball}, 0.0, material, **options)
    start, random = s.rest_state(3), torch.Generator().manual_seed(0)
    values = {
        "v": start.v + vector([0.01, 0.0, -0.05], [0.4, 0.1, -0.1], [0.1, 0.0, -1.0])[:, None]
    }
    zeros = torch.zeros(3, 2, 3, dtype=torch.float64)
    values |= {"obstacle_": zeros, "obstacle_turn_": zeros}  # vectors have prefixes of x, y and z
    sizes = {"v": 1e-5, "contact_friction": 1e-5, "contact_stiffness": 0.5, "youngs_modulus": 25.0}
    sizes |= {"obstacle_growth": 1e-8, "obstacle_": 1e-8, "obstacle_turn_": 1e-6}
    if moves:
        for name, size in (("obstacle_move_", 2e-5), ("obstacle_rotate_", 2e-4)):
            way = torch.randn(steps, 3, 2, 3, generator=random, dtype=torch.float64).cumsum(0)
            values[name], sizes[name] = (size * way).movedim(0, 1), 1e-4 * size
    else:
        values |= {
            "contact_friction": vector([0.9, 0.8], [0.2, 0.3], [0.4, 0.4]),
            "contact_stiffness": KAPPA * vector([1.0, 1.2], [0.8, 1.0], [0.6, 0.7]),
            "youngs_modulus": 264e3 * vector([1.0], [0.8], [1.2]),
            "obstacle_growth": zeros[..., 0],
        }

    def rollout(values):
        given = {"contact_friction": 0.4}
        for name, value in values.items():
            if name.endswith("_"):
                given |= {f"{name}{axis}": value[..., k] for k, axis in enumerate("xyz")}
            elif name != "v":
                given[name] = value
        inputs = {
            name: given.pop(name).movedim(1, 0)
            for name in list(given)
            if "move" in name or "rotate" in name
        }
        return s.rollout(State(start.q, values["v"]), steps, Inputs(**inputs), given)

    weights = torch.randn(2, *start.q.shape, generator=random, dtype=torch.float64)

    def losses(values):
        trajectory = rollout(values)
        return (
            (weights[0] * trajectory.q[-1] + 0.02 * weights[1] * trajectory.v[-1]).flatten(1).sum(1)
        )

    if not moves:
        t = rollout(values)
        gaps = torch.as_tensor(distances(floor, t.q.detach().numpy()))
        slides = [float(t.v[-1, b, gaps[-1, b] < D, :2].detach().abs().amax()) for b in range(2)]
        assert slides[0] < slip < 10.0 * slip < slides[1]
        assert float(gaps[:, 2].min()) < D < float(gaps[-1, 2].min())
    check_slopes(losses, values, sizes)


BEAM = box_hexahedra((0.08, 0.02, 0.02), (4, 1, 1))


def leaning(mu=0.0, **options):
    """A clamped beam that gravity bends onto a sphere below its tip."""
    ball = Sphere(position=(0.07, 0.01, -0.0505), radius=0.05)
    soft = Corotated(4e4, 0.4, density=DENSITY, mass_damping=20.0, stiffness_damping=2e-3)
    return simulator(ball, mu, soft, BEAM, select_vertices(BEAM, x=0.0), **TIGHT, **options)


def test_a_beam_that_leans_on_a_sphere_is_where_it_comes_to_rest():
    s = leaning()
    leant = s.static_equilibrium().q
    free = (
        Simulator(Body(BEAM, fixed=s.body.fixed), s.material, gravity=s.gravity)
        .static_equilibrium()
        .q
    )
    assert float((leant - free)[..., 2].max()) > 5e-4  # which is held up
    rest = leaning(time_step=0.02).rollout(s.rest_state(), 150).q[-1]
    assert leant.numpy() == pytest.approx(rest.numpy(), abs=1e-9)


def test_gradients_of_a_leaning_beam_with_friction():
    """Pushed aside from where it leant, which friction hinders."""
    s = leaning(0.5)
    push = torch.zeros(2, s.body.n_vertices, 3, dtype=torch.float64)
    push[:, select_vertices(BEAM, x=0.08), 1] = vector([2e-3], [1e-2])
    values = {
        "contact_friction": vector([0.5], [0.3]),
        "contact_stiffness": KAPPA * vector([1.0], [0.7]),
    }
    values |= {"youngs_modulus": 4e4 * vector([1.0], [1.1])}
    places = {"push": push, "shift": torch.zeros(2, 1, 3, dtype=torch.float64)}
    weights = noise(*push.shape)

    def solve(values):
        given = {name: value for name, value in values.items() if name not in places}
        given |= {f"obstacle_{axis}": values["shift"][..., k] for k, axis in enumerate("xyz")}
        before = s.static_equilibrium(None, given, batch=2)
        return before, s.static_equilibrium(Inputs(values["push"]), given, after=before).q

    values |= places
    both = solve(values), solve({**values, "contact_friction": 0.0})
    aside = [(q - before.q)[..., 1].abs().amax(1).detach() for before, q in both]
    assert bool((aside[0] < 0.9 * aside[1]).all())
    sizes = {
        "push": 1e-5,
        "shift": 1e-7,
        "contact_friction": 1e-4,
        "contact_stiffness": 5.0,
        "youngs_modulus": 1.0,
    }
    check_slopes(lambda values: (weights * solve(values)[1]).flatten(1).sum(1), values, sizes)


def test_a_free_block_rests_on_a_floor_by_friction():
    """It carries its weight, and goes aside by less than the slip under
    which friction holds a push.
    """
    s = simulator({"floor": resting_floor(WEIGHT)}, 0.5, **TIGHT)
    push = torch.zeros(1, s.body.n_vertices, 3, dtype=torch.float64)
    push[..., 0] = 0.3 * WEIGHT / s.body.n_vertices
    lying, pushed = s.static_equilibrium(), s.static_equilibrium(Inputs(push))
    assert float((lying.q - s.rest_positions).abs().max()) < 2e-5
    aside = (pushed.q - lying.q)[:, select_vertices(BLOCK, z=0.0), 0]
    assert 0.0 < float(aside.min()) < float(aside.max()) < 1e-3 * 5e-3  # m: slip speed times step
    forces = s.contacts(s.rest_state(), pushed)["obstacles"]
    assert float(forces.normal.sum((1, 2))[0, 2]) == pytest.approx(WEIGHT, rel=1e-9)
    assert float(forces.friction.sum((1, 2))[0, 0]) == pytest.approx(-0.3 * WEIGHT, rel=1e-9)


@pytest.mark.parametrize(("mu", "gap"), [(0.0, 0.95e-3), (0.5, 1.1e-3)])
def test_a_free_block_that_no_friction_holds_is_refused(mu, gap):
    s = simulator({"floor": HalfSpace(position=(0.0, 0.0, -gap))}, mu)
    assert not s.is_held(s.rest_state())
    refuses(
        InputError,
        "lay it on an obstacle with friction, within the distance of contact",
        s.static_equilibrium,
    )


def test_bodies_states_and_inputs_that_contact_refuses():
    with pytest.raises(InputError, match=r"within the obstacle 'floor' at rest: vertex 0 by 2 mm"):
        simulator(
            {
                "ball": Sphere(radius=0.01, position=(0.1, 0.0, 0.0)),
                "floor": HalfSpace(position=(0.0, 0.0, 2e-3)),
            }
        )
    s = simulator(HalfSpace(position=(0.0, 0.0, -1e-3), moves=True))
    start = s.rest_state()
    with pytest.raises(
        InputError, match=r"'obstacle' at the start of a step: vertex \d+ by 1.5 mm"
    ):
        s.step(State(start.q - vector(0.0, 0.0, 2.5e-3), start.v))
    held = simulator(s.body.energies[0].obstacles["obstacle"], fixed=select_vertices(BLOCK, z=0.0))
    with pytest.raises(
        InputError,
        match=r"after an obstacle has moved: vertex \d+ by 0.5 mm; .* move obstacles less",
    ):
        held.rollout(start, 2, Inputs(obstacle_move_z=vector(0.0, 1.5e-3)[:, None, None]))
    floor = HalfSpace(position=(0.0, 0.0, -0.01), moves=True)
    other = HalfSpace(position=(0.0, 0.0, -0.02))
    half = Body(
        BLOCK, symmetry=[SymmetryPlane((1.0, 0.0, 0.0))], energies=[Contact({"floor": other})]
    )
    refuses(InputError, "symmetry planes has no contact", Simulator, half)
    lying = Simulator(Body(BLOCK, energies=[Contact({"floor": floor, "other": other})]))
    with pytest.raises(InputError, match="without moves=True"):
        lying.step(
            lying.rest_state(),
            Inputs(obstacle_move_z=torch.tensor([[0.0, 1e-3]], dtype=torch.float64)),
        )


TWO = {"a": HalfSpace(position=(0.0, 0.0, -0.1)), "b": HalfSpace(position=(0.0, 0.0, -0.2))}


def test_values_by_the_name_of_an_obstacle():
    contact = Contact(TWO, stiffness=2e4, friction={"b": 0.2, "a": 0.1})
    constants = Simulator(Body(BLOCK, energies=[contact])).prepare()
    assert constants.values[1]["contact_friction"].tolist() == [[0.1, 0.2]]
    assert constants.values[1]["contact_stiffness"].unique().tolist() == [2e4]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Contact({}), "needs an obstacle"),
        (
            lambda: Contact({"a": {"shape": "sphere"}}),
            "the obstacle a is of type dict: give one, such as HalfSpace",
        ),
        (lambda: Contact({"a": HalfSpace()}, friction=-0.1), "contact_friction.* -0.1"),
        (lambda: Contact({"a": HalfSpace()}, stiffness=0.0), "contact_stiffness.* 0"),
        (
            lambda: Contact({"a": HalfSpace()}, friction=[0.1, 0.2]),
            "contact_friction has 2 values for 1 obstacle",
        ),
        (
            lambda: Contact(TWO, friction={"a": 0.1, "c": 0.2}),
            "friction has values for 'a', 'c', but the obstacles are",
        ),
        (lambda: Contact({"a": HalfSpace()}, slip_speed=math.nan), "contact.slip_speed is nan"),
        (
            lambda: Contact({"a": HalfSpace()}, friction_factors={"foot": -1.0}),
            "friction_factors.foot is -1",
        ),
        (lambda: Sphere(radius=-1.0), "Sphere.radius is -1.0: it must be a positive number, in m"),
        (lambda: Box(edges=(0.1, 0.0, 0.1)), "Box.edges is"),
        (lambda: HalfSpace(axis=(0.0, 0.0, 0.0)), "HalfSpace.axis is .* not all zero"),
        (
            lambda: HalfSpace(position=(0.0, 0.0)),
            r"HalfSpace.position is \(0.0, 0.0\): it must be three numbers, in m",
        ),
    ],
)
def test_values_out_of_range(make, message):
    refuses(InputError, message, make)


def test_an_obstacle_and_a_clamp_that_pass_through_one_another_in_a_step_are_refused():
    thickness = 0.002
    plate = Box(position=(0.01, 0.01, SIDE + 0.01), edges=(0.05, 0.05, thickness), moves=True)
    simulator = Simulator(
        Body(BLOCK, energies=[Contact({"plate": plate})]), gravity=(0.0, 0.0, 0.0), time_step=0.01
    )
    still = torch.zeros(1, 1, dtype=torch.float64)
    state = simulator.step(simulator.rest_state(), Inputs(obstacle_move_z=still))
    for way in np.linspace(0.012 + 0.5 * thickness, 0.1, 3):
        with pytest.raises(InputError, match="'plate' pass through one another"):
            simulator.step(state, Inputs(obstacle_move_z=still - way))
    simulator.step(state, Inputs(obstacle_move_z=still - 0.0105 + 0.5 * thickness))
    with pytest.raises(InputError, match="more than 90 degrees"):
        simulator.step(state, Inputs(obstacle_move_z=still, obstacle_rotate_z=still + 2.0))
    plate = Box(position=(0.01, 0.01, -0.003), edges=(0.05, 0.05, 0.002))
    body = Body(BLOCK, fixed=select_vertices(BLOCK, z=0.0), energies=[Contact({"plate": plate})])
    simulator = Simulator(body, gravity=(0.0, 0.0, 0.0), time_step=0.01)
    clamp = simulator.rest_positions[simulator.fixed]
    for way in (0.004, 0.05):
        inputs = Inputs(fixed_positions=clamp - torch.tensor([0.0, 0.0, way]))
        refuses(InputError, "'plate'", simulator.step, simulator.rest_state(), inputs)
        refuses(InputError, "'plate'", simulator.static_equilibrium, inputs)
    simulator.step(
        simulator.rest_state(), Inputs(fixed_positions=clamp - torch.tensor([0.0, 0.0, 0.0015]))
    )
