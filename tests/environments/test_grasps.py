"""Two fingers of a small run as a gripper: the environment, scripted policies, and the study of its errors."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from support.main_job import DRIVEN, run_without_report
from warp_resphys.environments.making import make_vector, register
from warp_resphys.environments.policies import ScriptedGrasp, errors_mm
from warp_resphys.io.errors import InputError

BOX = "boxes: [[[-0.007, -0.007, -0.08], [0.007, 0.007, 0.0]]]"
MESHES = ["mesh.size=0.014", f"laboratory.mesh={{kind: boxes, {BOX}, size: 0.01}}", "laboratory.time_step=0.01"]
RUN = ["experiment=finger", *MESHES, *DRIVEN, "data.steps=30"]


@pytest.fixture(scope="module")
def fingers(tmp_path_factory):
    register()
    return run_without_report(tmp_path_factory.mktemp("grasps"), *RUN)


@pytest.mark.slow
@pytest.mark.usefixtures("can_draw")
def test_gymnasiums_checker_passes(fingers):
    environment = gym.make(
        "warp_resphys/Grasp-v0", run=fingers, model="sysid", seconds=0.2, action_time=0.05, render_mode="rgb_array"
    )
    check_env(environment.unwrapped)
    environment.close()


@pytest.mark.slow
@pytest.mark.parametrize("world", ["simulator", "laboratory"])
def test_a_firm_grasp_lifts_the_ball_and_a_loose_one_does_not(fingers, world):
    grippers = make_vector("grasp", fingers, 2, "sysid", world, seconds=1.0)
    policies = ScriptedGrasp(1.0), ScriptedGrasp(0.05)

    def firm_and_loose(seen):
        return np.stack([policy(seen)[row] for row, policy in enumerate(policies)])

    errors = errors_mm(grippers, firm_and_loose, 0)
    firm, loose = errors[-1]
    assert firm < 8.0  # of 20 mm
    assert loose > 18.0


@pytest.mark.slow
def test_grippers_are_what_they_are_alone_and_begin_anew(fingers):
    together, alone = (make_vector("grasp", fingers, n, "resphys", seconds=0.3, noise=0.0) for n in (3, 1))
    actions = np.array([[[-0.5, -1.0], [0.4, 0.0], [1.0, 1.0]]] * 4, dtype=np.float32)
    first = together.reset(seed=0)[0]
    alone.reset(seed=1)
    for action in actions:
        seen, own = together.step(action)[0], alone.step(action[1:2])[0]
    np.testing.assert_allclose(seen[1], own[0], atol=1e-5)
    assert np.abs(seen - first).max() > 0.1
    np.testing.assert_array_equal(together.reset(seed=0)[0], first)


@pytest.mark.slow
def test_what_cannot_grasp_is_refused(fingers, folder):
    with pytest.raises(InputError, match="contact, which reduced models lack"):
        make_vector("grasp", fingers, 1, world="reduced")
    with pytest.raises(InputError, match="this robot has front, left, right"):
        make_vector("grasp", folder, 1)
