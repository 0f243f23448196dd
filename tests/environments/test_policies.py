"""A policy that knows where a robot rests, what Stable-Baselines3 sees of robots, and how fast these are."""

import json

import numpy as np
import pytest
from main_job import end_of

from warp_resphys import cli
from warp_resphys.environments.making import make_vector
from warp_resphys.environments.policies import ScriptedPolicy, acting, errors_mm, learn
from warp_resphys.io.errors import InputError
from warp_resphys.studies.benchmark_tables import benchmark_sheets
from warp_resphys.studies.environment_speed import time_environments


def still(seen):
    return -np.ones((len(seen), 3), dtype=np.float32)


class TestScriptedPolicy:
    def test_it_does_what_the_place_itself_tells(self, folder):
        """It knows places from 64 resting robots; where robots are asked to be is among these."""
        robots = make_vector("reach", folder, 3, "sysid", spread=0.0, noise=0.0, seconds=2.0)
        reach = robots.task.reach

        def told(seen):
            """By the actions under which the robot rests there."""
            distances = np.abs(robots.task.goals[:, :1] - reach.places).sum(axis=2)
            return reach.actions[distances.argmin(axis=1)].astype(np.float32)

        found, best, idle = (errors_mm(robots, policy, seed=1) for policy in (ScriptedPolicy(robots), told, still))
        assert found.shape == (40, 3)
        assert (idle[-1] - best[-1]).min() > 10.0
        assert np.abs(found - best).max() < 0.1 * idle.max()

    def test_a_later_place_is_another_action(self, folder):
        robots = make_vector("follow", folder, 2, spread=0.0, noise=0.0)
        seen, _ = robots.reset(seed=0)
        assert np.abs(ScriptedPolicy(robots)(seen) - ScriptedPolicy(robots, 2)(seen)).max() > 1e-3

    def test_a_task_without_places_is_refused(self, folder):
        robots = make_vector("swing_up", folder, 1)
        with pytest.raises(InputError, match="the scripted policy goes to places: take reach or follow"):
            ScriptedPolicy(robots)


class TestLearning:
    def test_what_it_learns_on_is_what_the_robots_do(self, folder):
        pytest.importorskip("stable_baselines3")
        from warp_resphys.environments.stable_baselines import Robots

        two = [make_vector("reach", folder, 2, seconds=0.2, autoreset_mode="SameStep") for _ in range(2)]
        robots = Robots(two[0])
        robots.seed(4)
        np.testing.assert_array_equal(robots.reset(), two[1].reset(seed=4)[0])
        action = np.array([[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0]], dtype=np.float32)
        for number in range(5):
            seen, rewards, over, told = robots.step(action)
            expected = two[1].step(action)
            np.testing.assert_array_equal(seen, expected[0])
            np.testing.assert_allclose(rewards, expected[1], rtol=1e-6)
            assert over.all() == (number == 3)
        assert told == [{}, {}]

    def test_a_policy_is_learned_again_from_the_same_seed(self, folder):
        pytest.importorskip("stable_baselines3")
        done, found = [], []
        for _ in range(2):
            robots = make_vector("reach", folder, 4, seconds=0.2, autoreset_mode="SameStep")
            policy = acting(learn(robots, 64, seed=3, on_progress=done.append))
            found.append(policy(np.linspace(-1.0, 1.0, 4 * robots.single_observation_space.shape[0]).reshape(4, -1)))
        np.testing.assert_array_equal(*found)
        assert found[0].shape == (4, 3)
        assert sum(done) >= 128

    def test_without_stable_baselines_it_says_what_to_install(self, folder, monkeypatch):
        monkeypatch.setitem(__import__("sys").modules, "stable_baselines3", None)
        robots = make_vector("reach", folder, 1, seconds=0.2)
        with pytest.raises(InputError, match=r"pip install 'warp-resphys\[policies\]'"):
            learn(robots, 8)


def test_the_command_learns_a_policy_once(folder, tmp_path, monkeypatch):
    """And tries every policy in every world."""
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    arguments = ("warp-resphys", "train-policy", f"run={folder}", "skill=reach", "models=[sysid]", "robots=4")
    told, saved = folder / "policies" / "reach.json", folder / "policies" / "reach_sysid.zip"
    results = []
    for steps in (64, 64, 128):
        code, err = end_of(cli.main, *arguments, f"steps={steps}", "episodes=2", "hydra.run.dir=policy")
        assert code == 0, err
        results.append((json.loads(told.read_text()), saved.stat().st_mtime_ns))
    (first, made), (second, kept), (_, anew) = results
    assert first == second
    assert made == kept < anew
    errors = first["errors"]
    assert list(errors) == [*(f"scripted, sysid, place {place}" for place in (1, 2, 3)), "PPO, sysid"]
    assert all(each[world]["mean_mm"] > 0.0 for each in errors.values() for world in ("reduced sysid", "laboratory"))
    assert len({each["laboratory"]["mean_mm"] for each in errors.values()}) > 1


def test_speeds_are_those_of_all_robots_and_worlds(folder):
    rows = time_environments(folder, [1, 2], 1, "cpu")
    assert [(row["world"], row["robots"]) for row in rows] == [
        (world, count) for world in ("simulator", "laboratory") for count in (1, 2)
    ]
    for row in rows:
        assert row["actions_s"] == pytest.approx(1e3 * row["robots"] / row["ms"])
        assert row["steps_s"] == pytest.approx(5 * row["actions_s"])
    result = {"settings": {"device": "cpu"}, "hardware": {"processor": "one"}, "yardstick_ms": 1.0, "steps": []}
    *_, sheet = benchmark_sheets({**result, "parts": [], "cold_start": None, "environments": rows, "control": []})
    assert [row[0] for row in sheet.rows] == [row["world"] for row in rows]
    assert {len(row) for row in sheet.rows} == {len(sheet.headings)}
