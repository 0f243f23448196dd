"""The search for settings: the task, what it leaves, and how it survives crashes and bad input."""

import csv
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from optuna.trial import TrialState

from support.configured import settings
from support.main_job import IN_RUN, TINY, files, run
from warp_resphys.experiment import learn
from warp_resphys.experiment.checks import check_run
from warp_resphys.io.errors import InputError
from warp_resphys.io.files import read_checkpoint
from warp_resphys.learning.training import Trainer
from warp_resphys.studies.tuning import figures as tuning_figures
from warp_resphys.studies.tuning import results as tuning_results
from warp_resphys.studies.tuning import tune
from warp_resphys.studies.tuning.space import Dimension
from warp_resphys.studies.tuning.study import JOURNAL, Study

REPOSITORY = Path(__file__).parents[2]
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
    "tune",
    f"tune.trials={TRIALS}",
    "parallel.processes=1",
    *SPACE,
]
FOLDER = Path("run/tune/resphys")
WIDTHS = {
    "network.width": Dimension.of("width", [8, 32, 16]),
    "trainer.gamma": Dimension.of("gamma", {"low": 0.8, "high": 1.0}),
}


@pytest.fixture
def no_pictures(monkeypatch, no_report):
    """Pictures take most of a tiny search's time, and the report of a tiny run's."""
    monkeypatch.setattr(tuning_results, "_write_page", lambda *arguments: None)


def table(folder=FOLDER):
    with open(Path(folder) / "trials.csv", newline="") as file:
        return list(csv.DictReader(file))


def results(folder=FOLDER):
    """Settings and results of all trials, whatever the order."""
    keys = ("state", "rollout_error_mm", "network.width", "network.blocks", "network.layers", "trainer.learning_rate")
    return sorted(tuple(row[key] for key in keys) for row in table(folder))


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
        names = {str(path.relative_to(searched / FOLDER)) for path in (searched / FOLDER).rglob("*") if path.is_file()}
        pages = {"tune.html", "tune.json", "trials.csv", "history.png", "importance.png", "settings.png"}
        assert names == pages | {"study.journal", "study.lock", "results.lock"}
        rows = table(searched / FOLDER)
        assert [row["state"] for row in rows] == TRIALS * ["complete"]
        assert all(row["network.width"] in ("8", "16") for row in rows)
        best = json.loads((searched / FOLDER / "tune.json").read_text())["best"]
        assert best["rollout_error_mm"] == min(float(row["rollout_error_mm"]) for row in rows)
        configured = json.loads((searched / "run" / "training_resphys.json").read_text())["kept"][
            "validation_rollout_error_mm"
        ]
        assert json.loads((searched / FOLDER / "tune.json").read_text())["configured_rollout_error_mm"] == configured
        page = (searched / FOLDER / "tune.html").read_text()
        assert "tuned=beam_oscillation_resphys" in page
        assert page.count("data:image/svg+xml") == 6

    def test_a_later_run_names_the_best_settings_and_gets_the_same_error(self, searched, monkeypatch, no_pictures):
        monkeypatch.chdir(searched)
        best = json.loads((FOLDER / "tune.json").read_text())["best"]
        settings = [option for option in TINY if not option.startswith(("network", "trainer"))]
        assert run(*settings, "tuned=beam_oscillation_resphys", "hydra.run.dir=best")[0] == 0
        _, metadata = read_checkpoint("best/resphys.safetensors", "residual force")
        assert metadata["validation_rollout_error_mm"] == pytest.approx(best["rollout_error_mm"], rel=1e-6)
        config = OmegaConf.load("best/.hydra/config.yaml")
        assert config.network.width == best["settings"]["network.width"]
        assert config.trainer.schedule == "step"
        code, err = run("tuned=beam_oscilation_resphys")
        assert code == 2
        assert "unknown tuned 'beam_oscilation_resphys', did you mean 'beam_oscillation_resphys'" in err

    def test_the_folder_is_that_of_the_run_and_what_it_holds_is_used(self, folder, no_pictures):
        short = [*SEARCH, "tune.trials=1"]
        assert run(*[option for option in SEARCH if not option.startswith("tune")])[0] == 0
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
        assert not Path("run/reconstruction_resphys.h5").exists()
        option = OmegaConf.load("configs/tuned/beam_oscillation_simfree.yaml")
        assert set(option) == {"tuned", "simfree"}
        best = json.loads(Path("run/tune/simfree/tune.json").read_text())["best"]
        assert option.simfree.network.width == best["settings"]["network.width"]
        assert run(*TINY, IN_RUN, "tuned=beam_oscillation_simfree", "network.width=12", "trainer.epochs=2")[0] == 0
        architectures = {
            name: read_checkpoint(f"run/{name}.safetensors", kind)
            for name, kind in (("resphys", "residual force"), ("simfree", "next state"))
        }
        assert architectures["resphys"][1]["architecture"]["width"] == 12
        assert architectures["simfree"][1]["architecture"]["width"] == best["settings"]["network.width"]
        kept = architectures["simfree"][1]["validation_rollout_error_mm"]
        assert kept == pytest.approx(best["rollout_error_mm"], rel=1e-6)

    def test_a_diverged_trial_counts_and_is_not_the_best(self, folder, monkeypatch):
        monkeypatch.setattr(learn, "rollout_error", lambda scene, model, names: lambda learned: math.inf)
        assert run(*SEARCH, IN_RUN, "tune.trials=2")[0] == 0
        assert [row["rollout_error_mm"] for row in table()] == ["inf", "inf"]
        assert json.loads((FOLDER / "tune.json").read_text())["best"] is None
        assert not Path("configs").exists()
        assert "None of them has finite roll-outs" in (FOLDER / "tune.html").read_text()


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
from warp_resphys.learning.training import Trainer
from warp_resphys.experiment import learn
from warp_resphys.experiment.checks import check_run
from warp_resphys.studies.tuning import results
learn._CHECKPOINT_SECONDS = 0.0
results._write_page = lambda *arguments: None
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
    def test_one_of_two_processes_is_killed_in_the_middle_of_a_trial(self, searched, folder):
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
        err = other.communicate(timeout=400)[1]
        assert other.returncode == 0, err
        # The same trials as in a search that nothing disturbed, each with the same result, and each once.
        assert results() == results(searched / FOLDER)
        taken = [line for line in err.splitlines() if line.startswith("trial 1: ")]
        assert len(taken) == 1
        assert f"{EPOCHS}/{EPOCHS} epochs" in taken[0]
        assert not list((FOLDER / "trials").iterdir())

    def test_a_worker_process_is_killed(self, searched, folder, caplog):
        """Its trial is done by another one; so few trials are drawn without looking at others."""
        killed, ended = [], threading.Event()

        def kill():
            while not killed and not ended.wait(0.01):
                killed.extend(process for process in at_work()[:1] if process != os.getpid())
            for process in killed:
                os.kill(process, signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        try:
            code, err = run(*SEARCH, "parallel.processes=2", IN_RUN)
        finally:
            ended.set()
            killer.join()
        assert code == 0, err
        assert len(killed) == 1
        assert "a worker process was lost" in caplog.text
        assert f"{TRIALS}/{TRIALS} trials" in err
        assert results() == results(searched / FOLDER)

    def test_a_trial_goes_on_from_its_checkpoint(self, searched, folder, monkeypatch):
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            interrupted = Interrupted(monkeypatch)
            for at in (9, 20):
                interrupted.at = at
                code, err = run(*SEARCH, IN_RUN)
                assert code == 130
                assert "interrupted in trial" in err
                assert "Traceback" not in err
            assert run(*SEARCH, IN_RUN)[0] == 0
        finally:
            signal.signal(signal.SIGINT, before)
        assert interrupted.done <= (TRIALS + 1) * EPOCHS + 2  # the epochs that the signals fell into
        assert results() == results(searched / FOLDER)
        assert run(*SEARCH, IN_RUN)[0] == 0  # nothing is left to do
        assert interrupted.done <= (TRIALS + 1) * EPOCHS + 2


def at_work():
    """The processes that have run a trial."""
    journal = FOLDER / JOURNAL
    lines = journal.read_text().splitlines() if journal.exists() else []
    processes = [json.loads(line).get("user_attr", {}).get("process") for line in lines if line.endswith("}")]
    return [int(process.partition(":")[2]) for process in processes if process]


def table_has(count):
    try:
        return sum(row["state"] == "complete" for row in table()) >= count
    except FileNotFoundError:
        return False


def study_in(folder, trials=3, space=None, conditions=None):
    return Study(folder, space or WIDTHS, {"seed": 0} if conditions is None else conditions, trials, 0)


class TestStudy:
    def test_racing_processes_try_as_many_as_were_asked_for(self, tmp_path):
        program = f"""
import time
from pathlib import Path
from warp_resphys.studies.tuning.space import Dimension
from warp_resphys.studies.tuning.study import Study
folder = Path({str(tmp_path)!r})
space = {{"trainer.gamma": Dimension.of("gamma", {{"low": 0.8, "high": 1.0}})}}
study = Study(folder, space, {{}}, 21, 0)
print("ready", flush=True)
while not (folder / "go").exists():
    time.sleep(1e-4)
while (claim := study.claim()) is not None:
    time.sleep(0.1)  # a trial takes longer than a process waits for the lock
    study.end(claim, claim.settings["trainer.gamma"], 1.0)
    print(claim.number, claim.settings["trainer.gamma"], flush=True)
"""
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
        command = [sys.executable, "-c", program]
        children = [subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE) for _ in range(3)]
        assert [child.stdout.readline() for child in children] == 3 * ["ready\n"]
        (tmp_path / "go").touch()
        lines = [child.communicate(timeout=100)[0].splitlines() for child in children]
        assert [child.returncode for child in children] == [0, 0, 0]
        assert all(lines)  # they did race
        tried = [line.split() for part in lines for line in part]
        assert sorted(int(number) for number, _ in tried) == list(range(21))
        assert len({gamma for _, gamma in tried}) == 21

    def test_a_trial_whose_process_is_gone_is_continued_under_its_number(self, tmp_path):
        left, kept = study_in(tmp_path).claim(), study_in(tmp_path).claim()
        assert [left.number, kept.number] == [0, 1]
        left.lock.release()  # as the system does for a process that ends
        study = study_in(tmp_path)
        taken, new = study.claim(), study.claim()
        assert (taken.number, taken.settings, new.number) == (0, left.settings, 2)
        assert study.claim() is None
        study.end(taken, 7.0, 1.0)
        study_in(tmp_path).end(left, 5.0, 1.0)  # a process that was only taken for dead changes nothing
        assert [(trial.number, trial.state, trial.error) for trial in study.outcomes()] == [
            (0, "complete", 7.0),
            (1, "running", None),
            (2, "running", None),
        ]

    def test_a_process_that_ends_while_it_draws_settings_changes_none(self, tmp_path, monkeypatch):
        expected = study_in(tmp_path / "whole").claim().settings
        study = study_in(tmp_path / "cut")

        def draws_one_setting(space):
            trial = type(study._study).ask(study._study)
            trial._suggest(*next(iter(space.items())))
            raise KeyboardInterrupt

        with monkeypatch.context() as patched:
            patched.setattr(study._study, "ask", draws_one_setting)
            with pytest.raises(KeyboardInterrupt):
                study.claim()
        study._lock_of(0).release()
        taken = study_in(tmp_path / "cut").claim()
        assert (taken.number, taken.settings) == (0, expected)

    def test_trials_that_fail_do_not_count_and_those_that_are_given_up_do(self, tmp_path):
        study = study_in(tmp_path, trials=2)
        study.end(study.claim(), None, 1.0, TrialState.FAIL)
        pruned = study.claim()
        pruned.trial.report(0.5, 3)
        study.end(pruned, None, 1.0, TrialState.PRUNED)
        study.end(study.claim(), math.inf, 1.0)
        assert study.claim() is None
        outcomes = [(trial.state, trial.error) for trial in study.outcomes()]
        assert outcomes == [("failed", None), ("pruned", 0.5), ("complete", math.inf)]
        assert study_in(tmp_path, trials=3).claim().number == 3  # more can be asked for later

    def test_the_same_seed_tries_the_same_and_importance_finds_what_matters(self, tmp_path):
        tried = []
        for name in ("one", "two"):
            study = study_in(tmp_path / name, trials=20)
            assert study.importance() == {}
            while (claim := study.claim()) is not None:
                study.end(claim, abs(claim.settings["trainer.gamma"] - 0.85), 1.0)
                tried.append(claim.settings)
        assert tried[:20] == tried[20:]
        assert len({settings["trainer.gamma"] for settings in tried}) == 20
        assert study.importance()["trainer.gamma"] > 0.7

    def test_a_half_written_line_is_cut_off(self, tmp_path):
        study = study_in(tmp_path)
        study.end(study.claim(), 1.0, 1.0)
        journal = tmp_path / JOURNAL
        journal.write_bytes(journal.read_bytes() + b'{"op_code": 5, "work')
        assert study_in(tmp_path).claim().number == 1

    @pytest.mark.parametrize(
        ("space", "conditions", "key"),
        [
            ({**WIDTHS, "network.width": Dimension.of("width", [8, 16])}, None, "space.network.width"),
            ({"network.width": WIDTHS["network.width"]}, None, "space.trainer.gamma"),
            (None, {"seed": 1}, "seed"),
            (None, {"seed": 0, "data": {"steps": 3}}, "data.steps"),
        ],
    )
    def test_of_another_space_or_other_conditions(self, tmp_path, space, conditions, key):
        study_in(tmp_path)
        with pytest.raises(InputError, match=f"another setting: {key} was "):
            study_in(tmp_path, space=space, conditions=conditions)


@pytest.mark.usefixtures("no_pictures")
class TestBadInput:
    @pytest.mark.parametrize(
        ("override", "key"),
        [
            ("tune.space.network.width=[8,32]", "space.network.width"),
            ("trainer.epochs=7", "trainer.epochs"),
            ("seed=2", "seed"),
            ("data.steps=13", "data.steps"),
        ],
    )
    def test_a_study_of_something_else(self, searched, monkeypatch, override, key):
        monkeypatch.chdir(searched)
        kept = (FOLDER / "study.journal", Path("run/dataset.h5"))
        before = [path.read_bytes() for path in kept]
        code, err = run(*SEARCH, IN_RUN, override)
        assert code == 2
        assert f"has another setting: {key} was " in err.splitlines()[-1]
        assert [path.read_bytes() for path in kept] == before

    @pytest.mark.parametrize(
        ("override", "sentence"),
        [
            ("tune.model=sysid", "tune.model"),
            ("tune.trials=0", "tune.trials is 0"),
            ("tune.trial_seconds=soon", "tune.trial_seconds is 'soon'"),
            ("tune.save_as=a/b", "tune.save_as is 'a/b'"),
            ("tune.space=3", "tune.space is 3"),
            ("+tune.space.data.steps=[1,2]", "unknown key 'tune.space.data'"),
            ("tune.space.network.width=[8]", "tune.space.network.width is [8]"),
            ("tune.space.network.width=[8,8]", "tune.space.network.width is [8, 8]"),
            ("tune.space.network.width=8", "tune.space.network.width is 8"),
            ("tune.space.trainer.gamma={low:1.0,high:0.8}", "tune.space.trainer.gamma is "),
            ("tune.space.trainer.gamma={low:0.8,high:1.2}", "tune: trainer.gamma is 1.2"),
            ("tune.space.network.width=[8.5,16]", "tune: network.width is 8.5"),
            ("+tune.space.network.depth=[1,2]", "unknown key 'network.depth'"),
            ("+tune.settings.network.width=8", "tune.settings.network.width"),
            ("simfree=3", "simfree is 3"),
            ("+simfree.network.width=-1", "simfree.network.width is -1"),
        ],
    )
    def test_settings(self, folder, override, sentence):
        code, err = run(*SEARCH, IN_RUN, override)
        assert code == 2
        assert err.splitlines()[-1].startswith(f"error: {sentence}")
        assert not Path("run/dataset.h5").exists()

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
        code, err = run("tune", "experiment=marker_ablation", IN_RUN)
        assert code == 2
        assert "error: the experiment marker_ablation trains no network: tune another one." in err

    @pytest.mark.parametrize("name", ["beam_real", "beam_synthetic"])
    def test_an_experiment_with_folds(self, folder, name):
        code, err = run("tune", f"experiment={name}", "data.folder=recordings", "tune=in_the_loop", IN_RUN)
        assert code == 2
        assert err.strip().splitlines()[-1] == (
            "error: a search needs one split, and data.folds makes several: set data.folds to null, and data.train, "
            "data.validation and data.test."
        )

    def test_another_way_of_training(self, folder):
        """The force of recordings is trained on whole trials, which has no batches."""
        code, err = run("tune", "experiment=beam_real_repeated", "data.folder=recordings", IN_RUN)
        assert code == 2
        assert err.strip().splitlines()[-1] == (
            "error: unknown key 'trainer.schedule' in the group tune: it must name a setting of network, in_the_loop."
        )

    @pytest.mark.parametrize(
        ("overrides", "groups"),
        [
            (
                ["experiment=beam_real_repeated", "data.folder=recordings", "tune=in_the_loop"],
                {"in_the_loop", "network"},
            ),
            (["experiment=beam_synthetic", "tune=in_the_loop"], {"in_the_loop", "network"}),
            (["experiment=beam_synthetic", "tune.model=simfree"], {"trainer", "network"}),
            (["experiment=sopra"], {"trainer", "network"}),
            (["experiment=sopra_extrapolation", "tune=reduced"], {"trainer", "network"}),
        ],
    )
    def test_other_experiments_are_searched(self, overrides, groups):
        run_settings = settings(*overrides)
        check_run(run_settings)
        _, space, _ = tune.check_tuning(run_settings)
        assert {key.partition(".")[0] for key in space} == groups

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
    rate = Dimension.of("rate", {"low": 1e-4, "high": 1e-2, "log": True})
    space = {"width": WIDTHS["network.width"], "rate": rate}
    tuning_figures.setting_scatter(np.array([]), [], space, narrow=narrow).savefig(tmp_path / "settings.png")
