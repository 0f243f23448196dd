"""A twin of a robot that lies on an obstacle: it follows,
and corrections do not move the body into the obstacle.
"""

import numpy as np
import pytest
import torch

from support.configured import settings
from warp_resphys import InputError, Robot, Twin, box_hexahedra
from warp_resphys.robot.description import Description
from warp_resphys.settings.body import SimulatorSettings

NOISE = 1e-4  # m
RADIUS, PLACE = 0.02, np.array([0.075, -0.0225])  # m: of the bar, its x and z


def beam(*given):
    """A beam that lies on a bar."""
    place = f"position: [{PLACE[0]}, 0.015, {PLACE[1]}], axis: [0, 1, 0]"
    bar = f"{{shape: cylinder, {place}, radius: {RADIUS}, length: 0.06}}"
    contact = "contact={friction: 0.4, distance: 1e-3, slip_speed: 5e-3}"
    run = settings(
        "mesh.divisions=[10,2,2]", "integrator=bdf2", f"obstacles={{bar: {bar}}}", contact, *given
    )
    mesh = box_hexahedra((0.1, 0.03, 0.03), (10, 2, 2))
    return Robot(Description("beam", "sysid", SimulatorSettings.of(run), run.simulation, mesh))


@pytest.fixture(scope="module")
def robot():
    return beam("simulation.stiffness_damping=3e-3")


def gap_of(q):
    """Least distance of vertices from the bar [m]."""
    return float(np.linalg.norm(np.asarray(q)[..., [0, 2]] - PLACE, axis=-1).min()) - RADIUS


def force(robot, *newtons):
    """A force on the tip (N, 3)."""
    rest = robot.simulator.rest_positions
    tip = rest[:, 0] > 0.1 - 1e-9
    return tip[:, None] * torch.tensor(newtons, dtype=rest.dtype) / tip.sum()


def followed(robot, motion):
    """Positions (T, N, 3) of a twin that sees six vertices of a motion, with noise."""
    rest, truth = robot.simulator.rest_positions.numpy(), motion.q[:, 0].numpy()
    seen = np.concatenate([np.flatnonzero(np.isclose(rest[:, 0], x))[:3] for x in (0.05, 0.1)])
    frames = np.full(truth.shape, np.nan)
    frames[:, seen] = truth[:, seen] + NOISE * np.random.default_rng(0).standard_normal(
        (len(truth), 6, 3)
    )
    twin, states = Twin(robot, noise=NOISE), []
    for number, frame in enumerate(frames):
        twin.take(number * robot.time_step, frame)
        states.append(twin.now.state.q[0].numpy())
    assert twin.counts == {}
    return np.stack(states)


def test_a_twin_follows_a_body_that_lies_on_a_bar_but_not_what_moves(robot):
    """The real beam is softer, is let go above the bar,
    and then pressed on it by a force unknown to the twin.
    """
    real = robot.with_parameters(
        youngs_modulus=float(robot.description.material.values["youngs_modulus"]) * 0.9
    )
    pressed = (
        force(robot, 0.0, 0.15, -0.3)
        * torch.linspace(0.0, 1.0, 80, dtype=torch.float64)[:, None, None]
    )
    motion = real.rollout(
        real.begin(external_force=force(robot, 0.0, 0.1, 0.4)), external_force=pressed[:, None]
    )
    twin, free = followed(robot, motion), robot.rollout(robot.begin(), 80).q[:, 0].numpy()
    errors = [
        np.linalg.norm(q - motion.q[:, 0].numpy(), axis=2).mean(axis=1)[10:].mean()
        for q in (twin, free)
    ]
    assert errors[0] < 0.25 * errors[1]
    assert min(gap_of(q) for q in motion.q[:, 0]) < 1e-3  # They touch.
    assert min(map(gap_of, twin)) > 0.0
    with pytest.raises(InputError, match="a twin of a robot with obstacles refines no parameters"):
        Twin(robot, refine={"youngs_modulus": 1e4})
    with pytest.raises(InputError, match="a twin cannot follow a robot with obstacles that move"):
        Twin(beam("obstacles.bar.moves=true"))


def test_markers_within_its_obstacle_do_not_move_a_twin_there(robot):
    """The real bar lies 4 mm lower, so that the markers pull the twin into its own."""
    real = robot.with_parameters(obstacle_z=-4e-3)
    motion = real.rollout(real.begin(external_force=force(robot, 0.0, 0.0, 1.2)), 40)
    assert min(gap_of(q) for q in motion.q[:, 0]) < -1e-3
    assert min(map(gap_of, followed(robot, motion))) > 0.0
