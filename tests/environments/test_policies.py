"""The scripted policy, the adapter to Stable-Baselines3, and trained policies."""

import json
from functools import partial

import numpy as np
import pytest

from support.command_line import outcome
from warp_resphys.control import reduction
from warp_resphys.environments import making
from warp_resphys.environments.making import make_vector
from warp_resphys.environments.policies import ScriptedPolicy, acting, errors_mm, learn
from warp_resphys.settings.control import ReductionSettings
from warp_resphys.studies.policy import _text


@pytest.mark.slow
class TestScriptedPolicy:
    def test_it_is_as_good_as_the_exact_static_actions(self, folder):
        robots = make_vector("reach", folder, 3, "sysid", spread=0.0, noise=0.0, seconds=2.0)
        reach = robots.task.reach

        def exact(seen):
            """The actions of the sampled equilibrium that is the goal."""
            distances = np.abs(robots.task.goals[:, :1] - reach.places).sum(axis=2)
            return reach.actions[distances.argmin(axis=1)].astype(np.float32)

        still = lambda seen: -np.ones((len(seen), 3), dtype=np.float32)  # noqa: E731
        errors, best, idle = (
            errors_mm(robots, policy, seed=1) for policy in (ScriptedPolicy(robots), exact, still)
        )
        assert errors.shape == (40, 3)
        assert (idle[-1] - best[-1]).min() > 10.0
        assert np.abs(errors - best).max() < 0.1 * idle.max()


@pytest.mark.slow
class TestLearning:
    def test_the_adapter_steps_as_the_environment_does(self, folder):
        pytest.importorskip("stable_baselines3")
        from warp_resphys.environments.stable_baselines import Robots

        two = [
            make_vector("reach", folder, 2, seconds=0.2, autoreset_mode="SameStep")
            for _ in range(2)
        ]
        robots = Robots(two[0])
        robots.seed(4)
        np.testing.assert_array_equal(robots.reset(), two[1].reset(seed=4)[0])
        action = np.array([[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0]], dtype=np.float32)
        for number in range(5):
            seen, rewards, over, infos = robots.step(action)
            expected = two[1].step(action)
            np.testing.assert_array_equal(seen, expected[0])
            np.testing.assert_allclose(rewards, expected[1], rtol=1e-6)
            assert over.all() == (number == 3)
        assert infos == [{}, {}]

    def test_a_policy_is_learned_again_from_the_same_seed(self, folder):
        pytest.importorskip("stable_baselines3")
        done, actions = [], []
        for _ in range(2):
            robots = make_vector("reach", folder, 4, seconds=0.2, autoreset_mode="SameStep")
            learned = learn(robots, 64, seed=3, on_progress=done.append)
            assert learned.num_timesteps == 64
            policy = acting(learned)
            actions.append(
                policy(
                    np.linspace(-1.0, 1.0, 4 * robots.single_observation_space.shape[0]).reshape(
                        4, -1
                    )
                )
            )
        np.testing.assert_array_equal(*actions)
        assert actions[0].shape == (4, 3)
        assert sum(done) == 128


@pytest.mark.slow
def test_the_command_learns_and_tries_once(folder, tmp_path, monkeypatch):
    """Every policy in every world; finished training and trials are not repeated."""
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    arguments = ("train-policy", f"run={folder}", "skill=reach", "models=[sysid]", "robots=4")
    place, tried = folder / "policies", []

    def counted(environment, *rest):
        tried.append(environment.num_envs)
        return errors_mm(environment, *rest)

    monkeypatch.setattr("warp_resphys.environments.policies.errors_mm", counted)
    monkeypatch.setattr(making, "make_vector", partial(make_vector, seconds=0.2))
    few = ReductionSettings(modes=(4,), equilibria=24, tangents=12, motions=2, seconds=0.8)
    monkeypatch.setattr(reduction, "ReductionSettings", lambda: few)

    def commanded(steps, seeds):
        code, _, err = outcome(
            *arguments, f"steps={steps}", f"seeds={seeds}", "episodes=2", "hydra.run.dir=here"
        )
        assert code == 0, err
        tries = len(tried)
        tried.clear()
        made = [(place / f"reach_sysid_{seed}.zip").stat().st_mtime_ns for seed in seeds]
        return json.loads((place / "reach.json").read_text())["errors"], tries, made

    first, tries, made = commanded(64, [0])
    scripted = [f"scripted, sysid, place {number}" for number in (1, 2, 3)]
    assert list(first) == [*scripted, "PPO, sysid, seed 0"]
    assert all(
        worlds[name]["mean_mm"] > 0.0
        for worlds in first.values()
        for name in ("reduced sysid", "laboratory")
    )
    assert len({worlds["laboratory"]["mean_mm"] for worlds in first.values()}) > 1
    assert tries == 8

    trials = place / "reach_trials.json"
    kept = json.loads(trials.read_text())
    # As if it had been interrupted before that trial.
    del kept["PPO, sysid, seed 0"]["reduced sysid"]
    trials.write_text(json.dumps(kept))
    second, tries, again = commanded(64, [0])
    assert (second, tries, again) == (first, 1, made)

    third, tries, both = commanded(64, [0, 1])
    assert (tries, both[0]) == (2, made[0])
    assert third["PPO, sysid, seed 1"] != third["PPO, sysid, seed 0"] == first["PPO, sysid, seed 0"]

    _, tries, anew = commanded(128, [0])
    assert tries == 2
    assert anew[0] > made[0]


def test_policies_of_several_seeds_are_told_in_one_row():
    alike = [
        {"mean_mm": 2.0, "failed": 0},
        {"mean_mm": None, "failed": 2},
        {"mean_mm": 4.0, "failed": 1},
    ]
    assert _text(alike[:1]) == "2.00"
    assert _text(alike[1:2]) == "- (2 failed)"
    assert _text(alike) == "3.00 (2.00 to 4.00) (3 failed)"


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["seeds=[0,0]", "models=[]"])
def test_wrong_settings_are_refused(folder, tmp_path, monkeypatch, wrong):
    monkeypatch.chdir(tmp_path)
    code, _, err = outcome("train-policy", f"run={folder}", wrong, "hydra.run.dir=here")
    assert code == 2
    assert err.startswith(f"error: {wrong.split('=')[0]}")
