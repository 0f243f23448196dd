"""Studies that several processes share: the space they search, their workers, and who makes which trial."""

import fcntl
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from warp_resphys.io.errors import InputError
from warp_resphys.studies.tuning.space import Choice, Range, parse_space
from warp_resphys.studies.tuning.study import JOURNAL, SharedStudy
from warp_resphys.studies.tuning.workers import at_work, is_alive

REPOSITORY = Path(__file__).parents[2]
WIDTHS = {"network.width": Choice((8, 16, 32)), "trainer.gamma": Range(0.8, 1.0, log=False, whole=False)}


class TestSpace:
    def test_kinds(self):
        space = parse_space(
            {
                "trainer": {"learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}, "schedule": ["step", "cosine"]},
                "network": {"blocks": {"low": 2, "high": 8}, "width": [64, 8, 32]},
            }
        )
        assert space == {
            "network.blocks": Range(2, 8, log=False, whole=True),
            "network.width": Choice((8, 32, 64)),
            "trainer.learning_rate": Range(1e-4, 1e-2, log=True, whole=False),
            "trainer.schedule": Choice(("step", "cosine")),
        }

    @pytest.mark.parametrize(
        ("space", "sentence"),
        [
            (3, "tune.space is 3: it must be a group of settings"),
            ({}, "tune.space is empty: it must name at least one setting"),
            ({"network": {}}, "tune.space is empty"),
            (
                {"data": {"steps": [1, 2]}},
                "unknown key 'tune.space.data': tune.space has network, trainer, in_the_loop.",
            ),
            ({"network": 3}, "tune.space.network is 3: it must be a group"),
            ({"network": {"width": [8]}}, "tune.space.network.width is [8]: it must list two or more"),
            ({"network": {"width": [8, 8]}}, "tune.space.network.width is [8, 8]: it must list two or more different"),
            ({"network": {"width": 8}}, "tune.space.network.width is 8: write {low: "),
            ({"network": {"width": {"low": 1}}}, "tune.space.network.width is {'low': 1}: write {low: "),
            ({"trainer": {"gamma": {"low": 1.0, "high": 0.8}}}, "low and high must be finite numbers, and low the"),
            ({"trainer": {"gamma": {"low": 0.0, "high": 0.8, "log": True}}}, "true needs positive numbers"),
        ],
    )
    def test_refused(self, space, sentence):
        with pytest.raises(InputError) as refusal:
            parse_space(space)
        assert sentence in str(refusal.value)


class TestWorkers:
    def test_a_killed_one_is_known_to_be_dead_at_once(self, tmp_path):
        program = f"""
import json, time
from pathlib import Path
from warp_resphys.studies.tuning.workers import at_work
with at_work(Path({str(tmp_path)!r})) as identity:
    print(json.dumps(identity), flush=True)
    time.sleep(100)
"""
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
        child = subprocess.Popen([sys.executable, "-c", program], env=environment, text=True, stdout=subprocess.PIPE)
        identity = json.loads(child.stdout.readline())
        try:
            assert is_alive(tmp_path, identity)
        finally:
            child.kill()
            child.wait()
        assert (tmp_path / f"{identity['token']}.alive").exists()
        assert not is_alive(tmp_path, identity)

    def test_one_that_left_has_gone(self, tmp_path):
        with at_work(tmp_path) as identity:
            assert is_alive(tmp_path, identity)
        assert not is_alive(tmp_path, identity)
        assert not list(tmp_path.iterdir())


def dead(identity):
    """As if nobody lived."""
    return False


def join(folder, name="a", alive=lambda identity: True, trials=3, space=None, conditions=None):
    conditions = {"seed": 0} if conditions is None else conditions
    return SharedStudy(folder, space or WIDTHS, conditions, trials, 0, {"token": name, "host": name, "pid": 1}, alive)


class TestStudy:
    def test_racing_workers_try_as_many_as_were_asked_for(self, tmp_path):
        program = f"""
import time
from pathlib import Path
from warp_resphys.studies.tuning.space import Choice, Range
from warp_resphys.studies.tuning.study import SharedStudy
from warp_resphys.studies.tuning.workers import at_work, is_alive
folder = Path({str(tmp_path)!r})
space = {WIDTHS!r}
print("ready", flush=True)
while not (folder / "go").exists():
    time.sleep(1e-4)
with at_work(folder / "workers") as identity:
    study = SharedStudy(folder, space, {{}}, 21, 0, identity, lambda other: is_alive(folder / "workers", other))
    while (claim := study.claim()) is not None:
        study.report(claim, 1, 2.0)
        assert study.tell(claim, claim.settings["trainer.gamma"], 1.0)
        print(claim.number, claim.claims, claim.settings["trainer.gamma"], flush=True)
"""
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
        command = [sys.executable, "-c", program]
        children = [subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE) for _ in range(3)]
        assert [child.stdout.readline() for child in children] == 3 * ["ready\n"]
        (tmp_path / "go").touch()
        lines = [child.communicate(timeout=100)[0].splitlines() for child in children]
        assert [child.returncode for child in children] == [0, 0, 0]
        assert all(lines)  # they did race
        told = sorted((int(number), claims, gamma) for number, claims, gamma in (x.split() for y in lines for x in y))
        assert [number for number, *_ in told] == list(range(21))
        assert {claims for _, claims, _ in told} == {"1"}
        assert len({gamma for *_, gamma in told}) == 21
        study = join(tmp_path, trials=21, conditions={})
        assert [each.state for each in study.outcomes()] == 21 * ["complete"]

    def test_a_dead_workers_trial_is_taken_over_and_told_once(self, tmp_path):
        first, second = join(tmp_path, "a"), join(tmp_path, "b", dead)
        begun = first.claim()
        taken = second.claim()
        assert (taken.number, taken.settings, taken.claims) == (begun.number, begun.settings, 2)
        assert not first.owns(begun)
        assert not first.tell(begun, 5.0, 1.0)  # it wakes
        assert second.tell(taken, 7.0, 1.0)
        assert not first.tell(begun, 5.0, 1.0)
        assert not second.tell(taken, 8.0, 1.0)
        assert [(each.number, each.error) for each in first.outcomes()] == [(0, 7.0)]

    def test_a_living_workers_trial_is_left_alone(self, tmp_path):
        first, second = join(tmp_path, "a", trials=2), join(tmp_path, "b", trials=2)
        claims = [first.claim(), second.claim()]
        assert [claim.number for claim in claims] == [0, 1]
        assert claims[0].settings != claims[1].settings
        assert (first.claim(), second.claim()) == (None, None)
        assert second.holders() == ["a:1", "b:1"]

    def test_killed_between_asking_and_claiming(self, tmp_path):
        study = join(tmp_path, "a")
        study._study.ask()
        claim = study.claim()
        assert (claim.number, claim.claims) == (0, 1)
        assert claim.settings.keys() == WIDTHS.keys()

    def test_trials_that_fail_or_are_given_up(self, tmp_path):
        study = join(tmp_path, trials=2)
        assert study.fail(study.claim(), 1.0)
        pruned = study.claim()
        study.report(pruned, 3, 0.5)
        assert study.tell(pruned, None, 1.0)
        assert study.tell(study.claim(), math.inf, 1.0)
        assert study.claim() is None
        found = [(each.state, each.error) for each in study.outcomes()]
        assert found == [("failed", None), ("pruned", 0.5), ("complete", math.inf)]

    def test_more_can_be_asked_for_later(self, tmp_path):
        study = join(tmp_path, trials=1)
        study.tell(study.claim(), 1.0, 1.0)
        assert study.claim() is None
        assert join(tmp_path, trials=2).claim().number == 1

    def test_the_same_seed_tries_the_same(self, tmp_path):
        tried = []
        for name in ("one", "two"):
            study = join(tmp_path / name, trials=14)
            while (claim := study.claim()) is not None:
                study.tell(claim, abs(claim.settings["trainer.gamma"] - 0.9), 1.0)
                tried.append(claim.settings)
        assert tried[:14] == tried[14:]
        assert len({settings["trainer.gamma"] for settings in tried}) == 14

    def test_a_half_written_line_is_cut_off(self, tmp_path):
        study = join(tmp_path)
        study.tell(study.claim(), 1.0, 1.0)
        journal = tmp_path / JOURNAL
        whole = journal.read_bytes()
        journal.write_bytes(whole + b'{"op_code": 5, "work')
        study = join(tmp_path)
        assert study.claim().number == 1
        assert journal.read_bytes().startswith(whole + b'{"op_code"')
        assert len(join(tmp_path).outcomes()) == 2

    def test_the_study_is_locked_while_it_is_written(self, tmp_path):
        study = join(tmp_path)
        with open(tmp_path / "study.lock") as file:
            with study.lock(), pytest.raises(BlockingIOError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)

    @pytest.mark.parametrize(
        ("space", "conditions", "sentence"),
        [
            (
                {**WIDTHS, "network.width": Choice((8, 16))},
                None,
                "network.width was one of 8, 16, 32, now it is",
            ),
            (
                {"network.width": WIDTHS["network.width"]},
                None,
                "space of trainer.gamma was 0.8 to 1, now it",
            ),
            (None, {"seed": 1}, "seed was 0, now it is 1"),
            (None, {"seed": 0, "data": {"steps": 3}}, "data.steps was absent, now it is 3"),
        ],
    )
    def test_of_another_space_or_other_conditions(self, tmp_path, space, conditions, sentence):
        join(tmp_path)
        join(tmp_path)
        with pytest.raises(InputError) as refusal:
            join(tmp_path, space=space, conditions=conditions)
        assert sentence in str(refusal.value)
        assert "delete the folder, or name another study with tune.study=" in str(refusal.value)

    def test_importance_finds_the_setting_that_matters(self, tmp_path):
        study = join(tmp_path, trials=30)
        assert study.importance() == {}
        while (claim := study.claim()) is not None:
            study.tell(claim, abs(claim.settings["trainer.gamma"] - 0.85), 1.0)
        found = study.importance()
        assert found["trainer.gamma"] > 0.7
        assert sum(found.values()) == pytest.approx(1.0)
