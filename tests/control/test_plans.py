"""Plans for a small rod whose tensions do not follow their commands,
and reduced models that know it.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.actuators import network_of
from support.configured import settings
from support.main_job import DRIVEN, ROD
from warp_resphys import Robot
from warp_resphys.control import plan
from warp_resphys.control.control_files import read_reduced, write_reduced
from warp_resphys.control.reduction import fingerprint, reduce
from warp_resphys.control.sampling import Source, driven_input
from warp_resphys.control.task import Task
from warp_resphys.control.worlds import laboratory_robot
from warp_resphys.settings.control import ReductionSettings

ELASTIC = ["~laboratory.material.prony_ratio_1", "~laboratory.material.prony_time_1"]
BODY = [*ROD, "laboratory.mesh.nodes=8", "laboratory.time_step=0.01", *ELASTIC]
RUN = [
    "experiment=tendon_rod_control",
    *DRIVEN,
    *BODY,
    "control.shapes=[circle]",
    "control.size=0.02",
]
LIMIT = 1.5  # N


def actuator(gain, creep, coupling=0.0):
    """A network that adds shares of each tension, of its mean over 0.3 s,
    and of the other tensions.
    """
    own = torch.eye(3, dtype=torch.float64)
    shares = torch.cat([gain * own + coupling * (1.0 - own), creep * own], 1)
    return {"tendon_tension": network_of(lambda values: values @ shares.T, LIMIT, 3, (0.3,))}


@pytest.fixture(scope="module")
def robot():
    """A rod with 0.7 of each commanded tension at once, and more of it in time."""
    seen = {"tendon_tension": ((0.0,) * 3, (LIMIT,) * 3)}
    return Robot(
        replace(
            laboratory_robot(settings(*RUN)).description, seen=seen, actuator=actuator(-0.3, 0.15)
        )
    )


@pytest.fixture(scope="module")
def model(robot, tmp_path_factory):
    """The reduced model of the robot, from its file."""
    path = tmp_path_factory.mktemp("reduced") / "reduced.safetensors"
    samples = ReductionSettings(modes=(4,), equilibria=40, tangents=20, motions=2, seconds=0.5)
    write_reduced(path, reduce(robot, samples))
    return read_reduced(path, None)


@pytest.fixture(scope="module")
def task(robot):
    return Task(settings(*RUN).control, robot)


@pytest.fixture(scope="module")
def path(task, model):
    return task.paths[0].timed(1.5, task.time_step, task.tracked @ model.observe(model.rest())[0])


def acting(model, **response):
    """The model under another response of the tensions to the commands."""
    return replace(
        model, acts={word: x for word, x in model.acts.items() if word != "network"} | response
    )


def test_a_plan_through_the_actuator_is_followed_by_the_robot(robot, model, task, path):
    def errors(model, corrections):
        (motion,) = plan.follow(
            robot, model, lambda path: task.planner(model, path), path[None], corrections
        )
        return motion["errors_mm"]

    through, corrected = errors(model, 1)
    assert through < 0.3 * errors(acting(model), 0)[0]
    assert corrected < 0.5 * through


@pytest.mark.parametrize(
    ("response", "most"),
    [
        # Tendons slacken the others down to zero.
        ({"network": actuator(-0.1, 0.1, -0.2)["tendon_tension"]}, 0.3),
        ({"slew": 0.5}, 2.0),
        ({"slope_1": 0.3, "slope_2": 2.0, "slope_3": 0.5, "typical": 1.0}, 0.6),
    ],
)
def test_a_response_with_kinks_is_planned_with(model, task, path, response, most):
    """Whole steps of Gauss and Newton have three to thirty times the error [mm]."""
    bent = acting(model, **response)
    inputs = plan._planned(bent, task.planner(bent, path), 0.0 * path)
    points = bent.respond(bent.rest(), inputs[:, None])[:, 0] @ task.tracked.T
    assert 1e3 * np.linalg.norm(points - path, axis=1).mean() < most


def test_a_robot_with_another_actuator_has_another_reduced_model(robot, model):
    again, other = (
        Robot(replace(robot.description, actuator=actuator(-0.3, creep))) for creep in (0.15, 0.2)
    )
    assert fingerprint(again) == model.robot
    assert fingerprint(other) != model.robot


def test_tensions_that_cancel_when_all_are_commanded_still_have_a_scale(robot):
    cancelling = Robot(replace(robot.description, actuator=actuator(-0.3, 0.0, -0.35)))
    source = Source(cancelling, driven_input(cancelling))
    np.testing.assert_allclose(source.scale, 0.7 * LIMIT, rtol=0.02)
