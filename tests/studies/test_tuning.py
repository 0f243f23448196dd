"""The search for settings of a training: its study,
the settings that it prints, and what it refuses.
"""

import contextlib
import re
import shlex
import shutil
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from support.command_line import outcome, refusal, settings_of
from support.main_job import IN_RUN, TINY, run, run_without_report
from warp_resphys.io.safe_files import read_checkpoint
from warp_resphys.learning.residuals.training import Trainer
from warp_resphys.studies.tuning import TunedRun, _checked

SPACE = "tune.space.network={width: [8, 16], blocks: {low: 1, high: 2}}"
SEARCH = ["tune", *TINY, "trainer.epochs=6", "tune.settings.trainer.rollout_every=3", SPACE]
REFUSED = [
    (
        ["experiment=marker_ablation"],
        "tune.model is 'resphys': the experiment marker_ablation trains none",
    ),
    (["tune.model=sysid"], "trains 'simfree', 'resphys'"),
    (["experiment=beam_real", "data.folder=recordings"], "set data.folds to null"),
    (
        ["experiment=beam_real_repeated", "data.folder=recordings"],
        "do not depend on tune's trainer.schedule",
    ),
    (["tune.space.network.colour=[1,2]"], "unknown key 'network.colour'"),
    (["tune.space.network.width=[8,-1]"], "network.width is -1"),
    (["tune.space.network.width=[8]"], "tune.space.network.width is [8]: write two or more values"),
    (
        ["tune.space.network.layers={high:many}"],
        "tune.space.network.layers is {'low': 2, 'high': 'many'}: write two",
    ),
    (["~tune.space.network", "~tune.space.trainer"], "tune.space is empty"),
]


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """A search of three trials, and what it printed."""
    root = tmp_path_factory.mktemp("searched")
    with contextlib.chdir(root):
        ended = outcome(*SEARCH, "tune.trials=3", IN_RUN)
    assert (ended.code, "Warning" in ended.err) == (0, False), ended.err
    return root, ended.out


def study(folder):
    storage = f"sqlite:///{folder}/run/tune.db"
    (name,) = optuna.get_all_study_names(storage)
    return optuna.load_study(study_name=name, storage=storage)


@pytest.mark.slow
def test_a_run_with_the_printed_settings_has_the_error_of_the_best_trial(searched, monkeypatch):
    root, printed = searched
    monkeypatch.chdir(root)
    best = study(root).best_trial
    line = printed.splitlines()[-1]
    program, *arguments = shlex.split(line.removeprefix("A run with the best settings: "))
    assert program == "warp-resphys"
    assert f"network.width={best.params['network.width']}" in arguments
    assert re.search(rf"^{best.number} ", printed, flags=re.MULTILINE)
    run_without_report(root, *arguments)
    _, metadata = read_checkpoint("run/resphys.safetensors", "residual force")
    assert metadata["validation_rollout_error_mm"] == pytest.approx(best.value, rel=1e-6)


@pytest.mark.slow
def test_the_same_command_adds_trials_after_an_interruption_but_other_settings_have_their_own_study(
    searched, monkeypatch
):
    root, _ = searched
    monkeypatch.chdir(root)
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "run_epoch", lambda self: (_ for _ in ()).throw(KeyboardInterrupt))
        code, err = run(*SEARCH, "tune.trials=4", IN_RUN)
    assert (code, "interrupted in trial 3" in err) == (130, True)
    assert [trial.state for trial in study(root).trials] == 3 * [TrialState.COMPLETE] + [
        TrialState.FAIL
    ]
    assert run(*SEARCH, "tune.trials=4", IN_RUN)[0] == 0
    assert [trial.state for trial in study(root).trials][4:] == [TrialState.COMPLETE]
    assert len({trial.params["network.width"] for trial in study(root).trials}) <= 2
    assert run(*SEARCH, "tune.trials=1", "trainer.epochs=4", IN_RUN)[0] == 0
    assert len(optuna.get_all_study_names(f"sqlite:///{root}/run/tune.db")) == 2


@pytest.mark.slow
def test_a_trial_that_is_worse_than_others_is_stopped(searched, tmp_path, monkeypatch):
    shutil.copytree(searched[0] / "run", tmp_path / "run", ignore=shutil.ignore_patterns("tune.db"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(optuna.trial.Trial, "should_prune", lambda self: self.number == 1)
    assert run(*SEARCH, "tune.trials=2", IN_RUN)[0] == 0
    assert [trial.state for trial in study(tmp_path).trials] == [
        TrialState.COMPLETE,
        TrialState.PRUNED,
    ]


@pytest.mark.parametrize(("arguments", "said"), REFUSED)
def test_what_cannot_be_searched_is_refused(arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert said in refusal("tune", *arguments, IN_RUN)
    assert not Path("run/dataset.h5").exists()


@pytest.mark.slow
def test_a_damaged_study_is_one_sentence(searched, monkeypatch):
    root, _ = searched
    monkeypatch.chdir(root)
    shutil.copytree("run", "damaged")
    Path("damaged/tune.db").write_bytes(b"no database" * 500)
    assert "tune.db" in refusal(*SEARCH, "tune.trials=1", "hydra.run.dir=damaged")


@pytest.mark.parametrize("experiment", ["beam_twist", "sopra", "sopra_extrapolation"])
@pytest.mark.parametrize("model", ["resphys", "simfree"])
def test_other_experiments_can_be_searched(experiment, model):
    settings = settings_of(TunedRun, "tune", f"experiment={experiment}", f"tune.model={model}")
    space, training = _checked(settings, settings.tune)
    assert {key.partition(".")[0] for key in space} == {"trainer", "network"}
    assert training.trainer.schedule == "step"
