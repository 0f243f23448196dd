"""The search for settings: its space, its workers, the study that they share, and the task."""

import csv
import fcntl
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from test_main_job import IN_RUN, TINY, files, run

from warp_resphys.errors import InputError
from warp_resphys.files import read_checkpoint
from warp_resphys.report import tuning_figures
from warp_resphys.residual.training import Trainer
from warp_resphys.tasks import experiment, tune
from warp_resphys.tuning.space import Choice, Range, parse_space
from warp_resphys.tuning.study import JOURNAL, JournalLock, SharedStudy
from warp_resphys.tuning.workers import Watch, Worker

REPOSITORY = Path(__file__).parents[1]
SPACE = [
    "tune.space.network.width=[8,16]",
    "tune.space.network.blocks={low:1,high:2}",
    "tune.space.network.layers={low:1,high:2}",
]
TRIALS = 4
EPOCHS = 6
SEARCH = [
    *TINY,
    "trainer.epochs=6",
    "tune.settings.trainer.rollout_every=3",
    "task=tune",
    f"tune.trials={TRIALS}",
    *SPACE,
]
FOLDER = Path("run/tune/resphys")
WIDTHS = {"network.width": Choice((8, 16, 32)), "trainer.gamma": Range(0.8, 1.0, log=False, whole=False)}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def no_pictures(monkeypatch):
    """Pictures take most of a tiny search's time, and the report of a tiny run's."""
    monkeypatch.setattr(tune, "write_pictures", lambda tuning, study: None)
    monkeypatch.setattr(experiment, "make_report", lambda context: (context.run_dir / "report.html").write_text("-"))


def table(folder=FOLDER):
    with open(Path(folder) / "trials.csv", newline="") as file:
        return list(csv.DictReader(file))


def results(folder=FOLDER):
    """What was tried and what came of it, whatever the order."""
    keys = ("state", "rollout_error_mm", "network.width", "network.blocks", "network.layers", "trainer.learning_rate")
    return sorted(tuple(row[key] for key in keys) for row in table(folder))


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
            ({}, "tune.space is {}: it must name at least one setting"),
            ({"network": {}}, "tune.space is empty"),
            ({"data": {"steps": [1, 2]}}, "tune.space.data cannot be searched: name settings of network or trainer."),
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


def sleeping_worker(folder, stale_after):
    program = f"""
import json, time
from pathlib import Path
from warp_resphys.tuning.workers import Worker
with Worker(Path({str(folder)!r}), {stale_after}) as worker:
    print(json.dumps(worker.identity), flush=True)
    time.sleep(100)
"""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    child = subprocess.Popen([sys.executable, "-c", program], env=environment, text=True, stdout=subprocess.PIPE)
    return child, json.loads(child.stdout.readline())


class TestWorkers:
    def test_a_killed_one_is_known_to_be_dead_at_once(self, tmp_path):
        child, identity = sleeping_worker(tmp_path, 1000.0)
        watch = Watch(tmp_path, 1000.0)
        try:
            assert watch.is_alive(identity)
        finally:
            child.kill()
            child.wait()
        assert not watch.is_alive(identity)

    def test_a_stopped_one_is_taken_for_dead_until_it_wakes(self, tmp_path):
        child, identity = sleeping_worker(tmp_path, 0.5)
        watch = Watch(tmp_path, 0.5)
        try:
            child.send_signal(signal.SIGSTOP)
            assert watch.is_alive(identity)
            time.sleep(0.7)
            assert watch.is_alive(identity) is False
            child.send_signal(signal.SIGCONT)
            time.sleep(0.5)
            assert watch.is_alive(identity)
        finally:
            child.kill()
            child.wait()

    def test_one_that_left_has_gone(self, tmp_path):
        with Worker(tmp_path, 1000.0) as worker:
            assert Watch(tmp_path, 1000.0).is_alive(worker.identity)
        assert not Watch(tmp_path, 1000.0).is_alive(worker.identity)
        assert not list(tmp_path.iterdir())

    def test_of_another_machine_only_its_signs_of_life_are_seen(self, tmp_path):
        watch = Watch(tmp_path, 0.4)
        with Worker(tmp_path, 0.4) as worker:
            distant = {**worker.identity, "kernel": "another"}
            end = time.monotonic() + 1.2
            while time.monotonic() < end:
                assert watch.is_alive(distant)
                time.sleep(0.02)
        (tmp_path / f"{distant['token']}.alive").write_text("its last sign\n")  # as after a power cut
        assert watch.is_alive(distant)
        time.sleep(0.5)
        assert not watch.is_alive(distant)


class Dead:
    """A watch that sees nobody."""

    def is_alive(self, identity):
        return False


class Living:
    """A watch that sees everybody."""

    def is_alive(self, identity):
        return True


def join(folder, name="a", watch=None, trials=3, space=None, conditions=None):
    watch = Living() if watch is None else watch
    conditions = {"seed": 0} if conditions is None else conditions
    identity = {"token": name, "host": name, "pid": 1, "kernel": "-"}
    return SharedStudy(folder, space or WIDTHS, conditions, trials, 0, identity, watch)


class TestStudy:
    def test_racing_workers_try_as_many_as_were_asked_for(self, tmp_path):
        program = f"""
import time
from pathlib import Path
from warp_resphys.tuning.space import Choice, Range
from warp_resphys.tuning.study import SharedStudy
from warp_resphys.tuning.workers import Watch, Worker
folder = Path({str(tmp_path)!r})
space = {WIDTHS!r}
print("ready", flush=True)
while not (folder / "go").exists():
    time.sleep(1e-4)
with Worker(folder / "workers", 60.0) as worker:
    study = SharedStudy(folder, space, {{}}, 21, 0, worker.identity, Watch(folder / "workers", 60.0))
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
        first, second = join(tmp_path, "a"), join(tmp_path, "b", Dead())
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

    def test_the_journal_is_locked_while_it_is_written(self, tmp_path):
        journal = tmp_path / JOURNAL
        lock = JournalLock(journal)
        lock.acquire()
        with open(tmp_path / f"{JOURNAL}.lock") as file:
            with pytest.raises(BlockingIOError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            lock.release()
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


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """A whole search by one process, and the run folder's files before and after a run of the best settings."""
    root = tmp_path_factory.mktemp("searched")
    before = Path.cwd()
    os.chdir(root)
    try:
        code, err = run(*SEARCH, IN_RUN)
        assert (code, "Warning" in err) == (0, False), err
    finally:
        os.chdir(before)
    return root


class TestSearch:
    def test_what_it_leaves(self, searched):
        found = {str(path.relative_to(searched / FOLDER)) for path in (searched / FOLDER).rglob("*") if path.is_file()}
        pages = {"tune.html", "tune.json", "trials.csv", "history.png", "importance.png", "settings.png"}
        locks = {"study.lock", "study.journal.lock", "results.lock"}
        assert found == pages | locks | {"study.journal"}
        rows = table(searched / FOLDER)
        assert [row["state"] for row in rows] == TRIALS * ["complete"]
        assert all(row["network.width"] in ("8", "16") for row in rows)
        best = json.loads((searched / FOLDER / "tune.json").read_text())["best"]
        assert best["rollout_error_mm"] == min(float(row["rollout_error_mm"]) for row in rows)
        configured = json.loads((searched / "run" / "training.json").read_text())["kept"]["validation_rollout_error_mm"]
        assert json.loads((searched / FOLDER / "tune.json").read_text())["configured_rollout_error_mm"] == configured
        page = (searched / FOLDER / "tune.html").read_text()
        assert "tuned=beam_oscillation_resphys" in page
        assert page.count("data:image/svg+xml") == 6

    def test_a_later_run_names_the_best_settings_and_gets_the_same_error(self, searched, monkeypatch, no_pictures):
        monkeypatch.chdir(searched)
        best = json.loads((FOLDER / "tune.json").read_text())["best"]
        settings = [option for option in TINY if not option.startswith(("network", "trainer"))]
        assert run(*settings, "tuned=beam_oscillation_resphys", "hydra.run.dir=best")[0] == 0
        _, metadata = read_checkpoint("best/model.safetensors", "residual force")
        assert metadata["validation_rollout_error_mm"] == pytest.approx(best["rollout_error_mm"], rel=1e-6)
        config = OmegaConf.load("best/.hydra/config.yaml")
        assert config.network.width == best["settings"]["network.width"]
        assert config.trainer.schedule == "step"
        code, err = run("tuned=beam_oscilation_resphys")
        assert code == 2
        assert "unknown tuned 'beam_oscilation_resphys', did you mean 'beam_oscillation_resphys'" in err

    def test_the_folder_is_that_of_the_run_and_what_it_holds_is_used(self, folder, no_pictures):
        short = [*SEARCH, "tune.trials=1"]
        assert run(*[option for option in SEARCH if not option.startswith(("task", "tune"))])[0] == 0
        (run_folder,) = Path("runs/beam_oscillation").iterdir()
        before = files(run_folder)
        assert run(*short)[0] == 0
        assert [*Path("runs/beam_oscillation").iterdir()] == [run_folder]
        now = files(run_folder)
        assert {name: now[name] for name in before if not name.endswith(".log")} == {
            name: content for name, content in before.items() if not name.endswith(".log")
        }

    def test_simfree_is_tuned_by_itself(self, folder, no_pictures):
        assert run(*SEARCH, IN_RUN, "tune.model=simfree", "tune.trials=2")[0] == 0
        assert not Path("run/reconstruction.h5").exists()
        found = OmegaConf.load("configs/tuned/beam_oscillation_simfree.yaml")
        assert set(found) == {"tuned", "simfree"}
        best = json.loads(Path("run/tune/simfree/tune.json").read_text())["best"]
        assert found.simfree.network.width == best["settings"]["network.width"]
        assert run(*TINY, IN_RUN, "tuned=beam_oscillation_simfree", "network.width=12", "trainer.epochs=2")[0] == 0
        architectures = {
            name: read_checkpoint(f"run/{name}.safetensors", kind)
            for name, kind in (("model", "residual force"), ("simfree", "next state"))
        }
        assert architectures["model"][1]["architecture"]["width"] == 12
        assert architectures["simfree"][1]["architecture"]["width"] == best["settings"]["network.width"]
        kept = architectures["simfree"][1]["validation_rollout_error_mm"]
        assert kept == pytest.approx(best["rollout_error_mm"], rel=1e-6)

    def test_a_diverged_trial_counts_and_is_not_the_best(self, folder, monkeypatch):
        whole = tune.residual_force_learning

        def diverging(context):
            learning = whole(context)
            return tune.Learning(learning.samples, learning.build, lambda model: math.inf)

        monkeypatch.setattr(tune, "residual_force_learning", diverging)
        assert run(*SEARCH, IN_RUN, "tune.trials=2")[0] == 0
        assert [row["rollout_error_mm"] for row in table()] == ["inf", "inf"]
        assert json.loads((FOLDER / "tune.json").read_text())["best"] is None
        assert not Path("configs").exists()
        assert "None of them came to a roll-out that stays finite" in (FOLDER / "tune.html").read_text()


class Interrupted:
    """Sends SIGINT to this process in a chosen epoch, and counts the epochs."""

    def __init__(self, monkeypatch):
        self.at, self.done = 0, 0
        run_epoch = Trainer.run_epoch

        def counted(trainer):
            record = run_epoch(trainer)
            self.done += 1
            if self.done == self.at:
                signal.raise_signal(signal.SIGINT)
            return record

        monkeypatch.setattr(Trainer, "run_epoch", counted)


def start(hang: bool):
    """The command in a process of its own; if asked to, it hangs in the fifth epoch of its second trial.

    Before it lie a training as configured and a whole trial, of six epochs each.
    """
    program = """
import time
from warp_resphys.residual.training import Trainer
from warp_resphys.tasks import train, tune
train._CHECKPOINT_SECONDS = 0.0
tune.write_pictures = lambda tuning, study: None
run_epoch, done = Trainer.run_epoch, []
def hanging(trainer):
    if len(done) == 16:
        open("hanging", "w").close()
        time.sleep(1000)
    done.append(1)
    return run_epoch(trainer)
"""
    program += "Trainer.run_epoch = hanging\n" if hang else ""
    program += "from warp_resphys.cli import main\nmain()"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    return subprocess.Popen(
        [sys.executable, "-c", program, *SEARCH, IN_RUN], env=environment, text=True, stderr=subprocess.PIPE
    )


@pytest.mark.usefixtures("no_pictures")
class TestCrashes:
    def test_one_of_two_workers_is_killed_in_the_middle_of_a_trial(self, searched, folder):
        doomed = start(hang=True)
        while not Path("hanging").exists():
            assert doomed.poll() is None, doomed.communicate()[1]
            time.sleep(0.01)
        other = start(hang=False)
        while not table_has(TRIALS - 1) and other.poll() is None:
            time.sleep(0.02)
        assert other.poll() is None  # It waits for the one that hangs, and that lives.
        doomed.kill()
        doomed.communicate()
        err = other.communicate(timeout=60)[1]
        assert other.returncode == 0, err
        # The same trials as in a search that nothing disturbed, each with the same result, and each once.
        assert results() == results(searched / FOLDER)
        taken = [line for line in err.splitlines() if line.startswith("trial 1: ")]
        assert len(taken) == 1
        assert f"{EPOCHS}/{EPOCHS} epochs" in taken[0]
        journal = [json.loads(line) for line in (FOLDER / "study.journal").read_text().splitlines()]
        claims = [log["user_attr"]["claims"] for log in journal if "claims" in log.get("user_attr", {})]
        assert sorted(len(each) for each in claims) == [1] * TRIALS + [2]
        assert not list((FOLDER / "trials").iterdir())

    def test_a_trial_goes_on_from_its_checkpoint(self, searched, folder, monkeypatch):
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            interrupted = Interrupted(monkeypatch)
            for at in (9, 20):
                interrupted.at = at
                code, err = run(*SEARCH, IN_RUN)
                assert code == 130
                assert "interrupted in trial" in err
                assert "the same command goes on from there" in err
                assert "Traceback" not in err
            assert run(*SEARCH, IN_RUN)[0] == 0
        finally:
            signal.signal(signal.SIGINT, before)
        assert interrupted.done <= (TRIALS + 1) * EPOCHS + 2  # the epochs that the signals fell into
        assert results() == results(searched / FOLDER)
        assert run(*SEARCH, IN_RUN)[0] == 0  # nothing is left to do
        assert interrupted.done <= (TRIALS + 1) * EPOCHS + 2

    def test_a_worker_that_wakes_too_late_tells_nothing(self, folder, monkeypatch):
        """While the first trial trains, another process takes it over and finishes it."""
        run_epoch, taken = Trainer.run_epoch, []

        def overtaken(trainer):
            if not taken and seen[0].holders():
                (claims,) = FOLDER.glob("study.journal")
                study = join_journal(claims.parent)
                taken.append(study.claim())
                assert study.tell(taken[0], 123.0, 1.0)
            return run_epoch(trainer)

        def join_journal(path):
            study = object.__new__(SharedStudy)
            study.__dict__ |= {**seen[0].__dict__, "_watch": Dead(), "_identity": {"token": "b", "host": "b", "pid": 2}}
            return study

        seen, whole = [], SharedStudy.__init__

        def remembered(self, *arguments):
            whole(self, *arguments)
            seen.append(self)

        monkeypatch.setattr(SharedStudy, "__init__", remembered)
        monkeypatch.setattr(Trainer, "run_epoch", overtaken)
        assert run(*SEARCH, IN_RUN)[0] == 0
        rows = table()
        assert [row["rollout_error_mm"] == "123.0" for row in rows] == [True] + (TRIALS - 1) * [False]
        assert not list((FOLDER / "trials").iterdir())


def table_has(count):
    try:
        return sum(row["state"] == "complete" for row in table()) >= count
    except FileNotFoundError:
        return False


@pytest.mark.usefixtures("no_pictures")
class TestBadInput:
    @pytest.mark.parametrize(
        ("override", "sentence"),
        [
            ("tune.space.network.width=[8,32]", "has another setting: the search space of network.width was one of 8,"),
            (
                "~tune.space.trainer.gamma",
                "another setting: the search space of trainer.gamma was 0.8 to 1, now it",
            ),
            ("trainer.epochs=7", "has another setting: trainer.epochs was 6, now it is 7; go on with the old setting"),
            ("seed=2", "has another setting: seed was 0, now it is 2"),
            ("data.steps=13", "has another setting: data.steps was 12, now it is 13"),
        ],
    )
    def test_a_study_of_something_else(self, searched, monkeypatch, override, sentence):
        monkeypatch.chdir(searched)
        kept = (FOLDER / "study.journal", Path("run/trajectories.h5"))
        before = [path.read_bytes() for path in kept]
        code, err = run(*SEARCH, IN_RUN, override)
        assert code == 2
        last = err.splitlines()[-1]
        assert last.startswith("error: the study in ")
        assert sentence in last
        assert [path.read_bytes() for path in kept] == before

    @pytest.mark.parametrize(
        ("override", "sentence"),
        [
            ("task=tun", "task is 'tun': choose run or tune."),
            ("tune.model=sysid", "tune.model is 'sysid': choose one of resphys, simfree."),
            ("tune.trials=0", "tune.trials is 0: it must be a whole number, 1 or more."),
            ("tune.stale_after=0", "tune.stale_after is 0: it must be positive, in seconds."),
            ("tune.trial_seconds=soon", "tune.trial_seconds is 'soon': it must be positive, in seconds."),
            ("tune.save_as=a/b", "tune.save_as is 'a/b': use letters, digits, _ and - alone."),
            ("tune.space.trainer.gamma={low:0.8,high:1.2}", "tune: trainer.gamma is 1.2: it must be greater than 0"),
            ("tune.space.network.width=[8.5,16]", "tune: network.width is 8.5: it must be a whole number."),
            ("+tune.space.network.depth=[1,2]", "unknown key 'network.depth' in the group tune"),
            ("+tune.settings.network.width=8", "tune.settings.network.width and tune.space.network.width exclude"),
            ("simfree=3", "simfree is 3: it must be a group of settings."),
            ("+simfree.network.width=-1", "simfree: network.width is -1: it must be positive."),
        ],
    )
    def test_settings(self, folder, override, sentence):
        code, err = run(*SEARCH, IN_RUN, override)
        assert code == 2
        assert err.splitlines()[-1].startswith(f"error: {sentence}")
        assert not Path("run/trajectories.h5").exists()

    def test_the_other_space_is_a_study_of_its_own(self, searched, monkeypatch):
        monkeypatch.chdir(searched)
        settings = [option for option in SEARCH if not option.startswith("tune.")]
        small = ["tune.space.network.width=[8,16]", "tune.settings.trainer.rollout_every=3", "tune.trials=1"]
        assert run(*settings, IN_RUN, "trainer.epochs=6", "tune=reduced", *small)[0] == 0
        (row,) = table("run/tune/resphys_reduced")
        assert row["state"] == "complete"
        assert 4 <= int(row["network.position_modes"]) <= 12
        assert "trainer.gamma" not in row
        assert Path("configs/tuned/beam_oscillation_resphys_reduced.yaml").is_file()

    def test_an_experiment_without_training(self, folder):
        code, err = run("experiment=marker_ablation", "task=tune", IN_RUN)
        assert code == 2
        assert "error: the experiment marker_ablation trains no network: tune another one." in err

    @pytest.mark.parametrize("name", ["beam_real", "beam_real_repeated"])
    def test_an_experiment_on_recordings(self, folder, name):
        code, err = run(f"experiment={name}", "task=tune", "data.folder=recordings", IN_RUN)
        assert code == 2
        assert err.strip().splitlines()[-1] == (
            f"error: task=tune does not search the networks of the experiment {name}, which learns from recordings: "
            "set network and in_the_loop, and simfree and trainer for the baseline, and compare runs with --multirun."
        )

    def test_settings_that_the_data_do_not_allow_end_the_search_and_the_trial_does_not_count(self, folder):
        code, err = run(*SEARCH, IN_RUN, "+tune.space.network.force_modes=[500,1000]")
        assert code == 2
        assert "error: trial 0 (network.blocks " in err
        assert " modes were asked for, but 36 samples give 1 to 36." in err
        assert not FOLDER.joinpath("trials.csv").exists()
        assert not list(FOLDER.glob("trials/*"))

    def test_trials_that_take_too_long_are_given_up_and_count(self, folder):
        assert run(*SEARCH, IN_RUN, "tune.trials=2", "tune.trial_seconds=1e-6")[0] == 0
        assert [row["state"] for row in table()] == ["pruned", "pruned"]
        assert json.loads((FOLDER / "tune.json").read_text())["best"] is None


@pytest.mark.parametrize("narrow", [False, True])
def test_figures_of_searches_that_found_nothing(narrow, tmp_path):
    nothing = np.full(3, np.nan)
    for errors, pruned in ((nothing, nothing), (np.array([np.inf, 1.0, np.nan]), np.array([np.nan, np.nan, 2.0]))):
        tuning_figures.search_history(errors, pruned, None, narrow=narrow).savefig(tmp_path / "history.png")
    tuning_figures.importance_bars({}, narrow=narrow).savefig(tmp_path / "importance.png")
    space = {"width": WIDTHS["network.width"], "rate": Range(1e-4, 1e-2, log=True, whole=False)}
    tuning_figures.setting_scatter(np.array([]), [], space, narrow=narrow).savefig(tmp_path / "settings.png")
