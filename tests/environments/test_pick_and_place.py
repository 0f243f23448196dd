"""An arm that picks a ball and places it: its task,
Gymnasium's checker, batches, and the scripted policy.
"""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from support.refusals import refuses
from warp_resphys import InputError
from warp_resphys.environments.making import make_vector
from warp_resphys.environments.policies import ScriptedPlace
from warp_resphys.environments.tasks import LIFT, PlaceTask

pytest.importorskip("mujoco", reason="the extra mujoco is not installed")

REST = np.array([0.1, 0.2, 0.3])


def test_the_reward_grows_from_the_gripper_at_the_ball_to_the_ball_at_the_goal():
    task, number = PlaceTask(1, REST), np.zeros(1, dtype=np.int64)
    task.begin(0, np.random.default_rng(0))
    goal, up = task.wanted(0, 0)[0], np.array([0.0, 0.0, LIFT])
    far, high = REST + [0.0, 0.0, 1.0], 0.5 * (REST + goal) + up
    path = [
        (far, REST),
        (REST + 0.01, REST),
        (REST, REST),
        (REST + 0.5 * up, REST + 0.5 * up),
        (high, high),
    ]
    rewards = []
    for places in [*path, (goal, goal), (goal + up, goal)]:
        points = np.concatenate(places)[None]
        rewards.append(task.reward(points, number)[0])
        np.testing.assert_allclose(
            task.size * task.observed(points, number)[0, 3:6], goal - places[1]
        )
    assert (np.diff(rewards[:-1]) > 0.0).all()
    np.testing.assert_allclose([rewards[0], rewards[2], *rewards[-2:]], [0.0, 1.0 / 3.0, 1.0, 1.0])
    assert task.errors_mm(points, number) == 0.0
    task.begin(0, np.random.default_rng(0))
    np.testing.assert_allclose(task.reward(np.concatenate([goal, goal])[None], number), 1.0 / 3.0)


def test_goals_lie_on_the_table_to_either_side():
    task, random = PlaceTask(1, REST), np.random.default_rng(0)
    ways = []
    for _ in range(50):
        task.begin(0, random)
        ways.append(task.goals[0] - REST)
    x, y, z = np.transpose(ways)
    assert 0.06 <= np.abs(y).min() < np.abs(y).max() <= 0.12
    assert np.abs(x).max() <= 0.04
    assert 5 < (y > 0.0).sum() < 45
    np.testing.assert_array_equal(z, 0.0)


@pytest.mark.slow
@pytest.mark.usefixtures("can_draw")
def test_gymnasiums_checker_passes(fingers):
    environment = gym.make(
        "warp_resphys/PickAndPlace-v0",
        run=fingers,
        model="sysid",
        seconds=0.2,
        render_mode="rgb_array",
    )
    check_env(environment.unwrapped)
    environment.close()


@pytest.mark.release
@pytest.mark.slow
def test_the_scripted_policy_lifts_the_ball_and_puts_it_down_at_its_goal(fingers):
    arms = make_vector("pick_and_place", fingers, 1, "sysid")
    policy, heights = ScriptedPlace(arms), []
    seen, _ = arms.reset(seed=0)
    before = arms.rests[:, -1]
    for _ in range(arms.actions):
        seen, rewards, terminated, truncated, info = arms.step(policy(seen))
        assert not terminated.any()
        heights.append(arms.world.markers(arms.state)[:, -1, 2] - before[:, 2])
    assert truncated.all()
    assert np.max(heights, axis=0).min() > 0.03
    assert info["error_mm"].max() < 3.0
    assert rewards.min() > 0.98
    gripper, ball = np.swapaxes(arms.world.markers(arms.state)[:, -2:], 0, 1)
    assert (gripper - ball)[:, 2].min() > 0.02  # it has left the ball
    np.testing.assert_allclose(ball[:, 2], before[:, 2], atol=1e-3)


@pytest.mark.slow
def test_arms_are_what_they_are_alone_and_begin_anew(fingers):
    together, alone = (
        make_vector("pick_and_place", fingers, n, "resphys", seconds=0.3, noise=0.0, forces=True)
        for n in (3, 1)
    )
    random = np.random.default_rng(0)
    first = together.reset(seed=0)[0]
    alone.reset(seed=1)
    for action in random.uniform(-1.0, 1.0, (4, 3, 7)).astype(np.float32):
        seen, own = together.step(action)[0], alone.step(action[1:2])[0]
    np.testing.assert_allclose(seen[1, :-6], own[0, :-6], atol=1e-5)
    np.testing.assert_allclose(seen[1, -6:], own[0, -6:], atol=1e-3 * np.abs(own[0, -6:]).max())
    assert np.abs(own[0, -6:]).max() > 0.1
    assert np.abs(seen - first).max() > 0.1
    np.testing.assert_array_equal(together.reset(seed=0)[0], first)


@pytest.mark.slow
def test_what_cannot_pick_is_refused(fingers, folder, monkeypatch):
    refuses(
        InputError,
        "contact, which reduced models lack",
        make_vector,
        "pick_and_place",
        fingers,
        world="reduced",
    )
    refuses(InputError, "this robot has front, left, right", make_vector, "pick_and_place", folder)
    refuses(InputError, "choose pick_and_place", ScriptedPlace, make_vector("grasp", fingers, 1))
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    refuses(
        InputError, r"pip install 'warp-resphys\[mujoco\]'", make_vector, "pick_and_place", fingers
    )
