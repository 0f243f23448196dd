"""Robots in one scene, alone and in contact, and the material of a robot on another body."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import warp_resphys
from support.configured import settings
from support.refusals import refuses
from warp_resphys import (
    Body,
    Corotated,
    Inputs,
    RobotScene,
    Simulator,
    SurfaceContact,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.energies.convex_material import ConvexMaterial
from warp_resphys.io.errors import InputError, MeshError
from warp_resphys.robot.description import Description
from warp_resphys.robot.robot import Robot
from warp_resphys.settings.body import MaterialSettings, SimulatorSettings

# About the vertical, so that gravity is the same in both frames.
POSE = (0.02, -0.3, 0.1, 0.0, 0.0, 2.0)
AWAY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
SIZE = (0.1, 0.02, 0.02)  # m
CONTACT = SurfaceContact(1e5, 0.3, distance=1e-3, slip_speed=1e-2)


def beam(*given):
    """A clamped beam as a robot without a learned force."""
    run = settings(
        f"mesh={{kind:box_hexahedra,size:{list(SIZE)},divisions:[5,1,1]}}",
        "integrator=bdf2",
        *given,
    )
    own = MaterialSettings.model_validate({**run.simulation.plain(), "model": "corotated"})
    return Robot(
        Description("beam", "sysid", SimulatorSettings.of(run), own, box_hexahedra(SIZE, (5, 1, 1)))
    )


def tip_force(robot, *newtons):
    """A force (N, 3) on the face of the tip."""
    rest = robot.simulator.rest_positions
    tip = rest[:, 0] > SIZE[0] - 1e-9
    return tip[:, None] * torch.tensor(newtons, dtype=rest.dtype) / tip.sum()


def test_robots_without_contact_move_as_alone(finished):
    """Also with a learned force, a moving base, and another pose; every robot in its own frame."""
    robot = warp_resphys.load(finished[0], "resphys")
    scene = RobotScene({"one": (robot, AWAY), "two": (robot, POSE)})
    push = 0.4 * torch.randn(
        robot.simulator.rest_positions.shape, generator=torch.Generator().manual_seed(0)
    )
    alone = {name: robot.begin(2) for name in scene.robots}
    state = scene.begin(2)
    for step in range(4):
        base = [1e-4 * (step + 1), 0.0, 2e-4 * (step + 1), 0.0, 0.0, 0.002 * (step + 1)]
        inputs = {"one": {"external_force": push}, "two": {"base": base}}
        state = scene.step(state, inputs)
        alone = {name: robot.step(own, **inputs[name]) for name, own in alone.items()}
    for name, own in alone.items():
        at = scene.state_of(state, name)
        assert float((own.q - robot.begin().q).abs().max()) > 1e-4
        torch.testing.assert_close(at.q, own.q, rtol=0.0, atol=1e-8)
        torch.testing.assert_close(at.v, own.v, rtol=0.0, atol=1e-5)
        assert torch.equal(at.left, own.left)
    rotation = torch.tensor(
        [[np.cos(2.0), -np.sin(2.0), 0], [np.sin(2.0), np.cos(2.0), 0], [0, 0, 1]]
    )
    placed = robot.observe(alone["two"]) @ rotation.mT + torch.tensor(POSE[:3], dtype=torch.float64)
    torch.testing.assert_close(scene.observe(state)["two"], placed, rtol=0.0, atol=1e-8)


def test_robots_in_contact_push_one_another():
    """A beam is pushed against a second one, which stands across,
    and against a loose block beyond it.
    """
    robot = beam()
    block = box_hexahedra((0.02, 0.02, 0.02), (1, 1, 1))
    moved = warp_resphys.Mesh(block.vertices + [0.07, -0.0215, 0.0], block.cells)
    objects = {"block": (Body(moved, fixed=[0, 1]), Corotated(2e5, 0.4))}
    objects["stone"] = Body.rigid_body(
        warp_resphys.Mesh(block.vertices + [0.0, 0.5, 0.0], block.cells)
    )
    pose = (SIZE[0], 0.0415, 0.0, 0.0, 0.0, np.pi)
    scene = RobotScene({"first": (robot, AWAY), "second": (robot, pose)}, objects, CONTACT)
    start = state = scene.begin()
    force = tip_force(robot, 0.0, 0.5, 0.0)
    for _ in range(12):
        state = scene.step(state, {"first": {"external_force": force}})
    acting = scene.scene.inputs({"first": Inputs(external_force=force[None])})
    way = (state.q - start.q)[0]
    assert float(way[scene.scene.vertex_slice("second"), 1].max()) > 1e-3  # by the first one
    assert float(way[scene.scene.vertex_slice("block"), 1].abs().max()) < 1e-3
    # In its own frame, which is turned.
    assert float(scene.state_of(state, "second").q[0, :, 1].min()) < -1e-3
    fall = way[scene.scene.vertex_slice("stone")] / (0.5 * np.linalg.norm(robot.simulator.gravity))
    assert float(fall.norm(dim=-1).std()) < 1e-9 < float(fall.norm(dim=-1).mean())
    forces = scene.simulator.contacts(state, scene.step(state), acting, scene.constants)["surfaces"]
    assert 0.0 < float(forces.gap.min()) < CONTACT.distance


def test_gradient_of_a_push_through_contact():
    """Against a difference."""
    robot = beam("solver.relative_tolerance=1e-11")
    scene = RobotScene(
        {"first": (robot, AWAY), "second": (robot, (SIZE[0], 0.0415, 0.0, 0.0, 0.0, np.pi))},
        {},
        CONTACT,
    )

    def deflection(size):
        state = scene.begin()
        force = {"first": {"external_force": size * tip_force(robot, 0.0, 0.5, 0.02)}}
        for _ in range(8):
            state = scene.step(state, force)
        return scene.state_of(state, "second").q[0, :, 1].sum()

    size = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(deflection(size), size)
    with torch.no_grad():
        expected = float(deflection(1.0 + 1e-6) - deflection(1.0 - 1e-6)) / 2e-6
    assert abs(expected) > 1e-4
    assert float(slope) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("robots", "more", "message"),
    [
        ({"one": AWAY, "two": (0.0, 0.5, 0.0, np.pi, 0.0, 0.0)}, (), "gravity of one is"),
        ({"one": "abc"}, (), "pose of one is 'abc'"),
        ({"one": (0.0, 0.0, 0.1)}, (), "pose of one is"),
        ({"one": AWAY}, ({"one": (Body(box_hexahedra()), Corotated())},), "a robot and an object"),
        ({}, (), "no robot"),
        (
            {"one": AWAY, "two": AWAY},
            ({}, CONTACT),
            r"surfaces cross at rest: an edge at vertex \d+ in 'one' .* in 'two'",
        ),
    ],
)
def test_what_does_not_fit_is_refused(robots, more, message):
    robot = beam()
    refuses(
        InputError,
        message,
        RobotScene,
        {name: (robot, pose) for name, pose in robots.items()},
        *more,
    )


def test_robots_that_do_not_fit_are_refused(finished):
    robot = beam()
    for robots, message in (
        ({"one": robot}, "give a robot and its pose"),
        ({"one": (warp_resphys.load(finished[0], "simfree"), AWAY)}, "only a network"),
        (
            {"one": (robot, AWAY), "two": (beam("time_step=0.005"), POSE)},
            "one time step and integrator, these have one 10 ms and bdf2, two 5 ms",
        ),
    ):
        refuses(InputError, message, RobotScene, robots)
    with pytest.raises(InputError, match="no robot 'hand' in the scene: it has one"):
        RobotScene({"one": (robot, AWAY)}).begin(inputs={"hand": {}})


LAW = {
    "c10": 30e3,
    "ogden_3": 20e3,
    "bulk_1": 4e6,
    "prony_modulus_1": 1e4,
    "prony_time_1": 0.05,
    "density": 1000.0,
}
LONG = box_hexahedra((0.15, 0.02, 0.02), (6, 1, 1))


@pytest.fixture(scope="module")
def of_a_law():
    """A beam with an identified law and a damping that is its own."""
    law = MaterialSettings.model_validate({"model": "law", **LAW, "mass_damping": 9.0})
    return Robot(
        replace(beam().description, material=law, parameters={"c10": 44e3, "mass_damping": 9.0})
    )


def test_its_law_moves_another_body_as_a_simulator_of_it_does(of_a_law):
    other = of_a_law.on(LONG, fixed={"x": 0.0})
    material = ConvexMaterial(
        44e3, bulk_1=4e6, density=1000.0, ogden={3: 20e3}, prony=[(1e4, 0.05)]
    )
    alone = Simulator(Body(LONG, fixed=select_vertices(LONG, x=0.0)), material, integrator="bdf2")
    state, expected = other.state(LONG.vertices), alone.rest_state()
    for _ in range(3):
        state, expected = other.step(state), alone.step(expected)
    torch.testing.assert_close(state.q, expected.q, rtol=0.0, atol=1e-9)
    assert (state.q - alone.rest_positions).abs().max() > 1e-3
    kept = other.description
    assert (kept.learned, kept.markers, kept.intervals) == (None, None, None)
    refuses(InputError, "no_such_key", of_a_law.on, LONG, no_such_key=1)
    refuses(MeshError, "no vertex", of_a_law.on, LONG, fixed={"x": 5.0})


def test_a_robot_begins_with_its_base_turned_by_any_angle():
    """About the vertical, its equilibrium turns with it.

    Upside down, it is that of its rest shape there.
    """
    robot = beam()
    turn = torch.tensor([[np.cos(3.0), -np.sin(3.0), 0], [np.sin(3.0), np.cos(3.0), 0], [0, 0, 1]])
    torch.testing.assert_close(
        robot.begin(base=[0.0, 0, 0, 0, 0, 3.0]).q, robot.begin().q @ turn.mT, rtol=0, atol=1e-9
    )
    # The beam is in the same place, its top below.
    over = robot.begin(base=[0.0, 0.02, 0.02, np.pi, 0, 0])
    torch.testing.assert_close(over.q[0].mean(0), robot.begin().q[0].mean(0), rtol=0, atol=1e-9)
