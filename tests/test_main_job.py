"""The main job through its command line: `warp-resphys` with a small beam, a few steps and a few epochs."""

import contextlib
import io
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from warp_resphys import box_hexahedra, cli
from warp_resphys.configured import build_simulator
from warp_resphys.files import read_checkpoint, read_hdf5
from warp_resphys.residual.reconstruction import LBFGSB
from warp_resphys.residual.training import EpochTrainer
from warp_resphys.resumable import ResumableHDF5
from warp_resphys.stages import package_versions
from warp_resphys.tasks import evaluate, experiment, train
from warp_resphys.tasks.checks import check_configuration

REPOSITORY = Path(__file__).parents[1]
STAGES = ["generate", "reconstruct", "train", "train_simfree", "evaluate", "time", "report"]
REFINED = ["generate", "reconstruct", "train", "refine", "train_simfree", "evaluate", "time", "report"]
REFINE = ["refinement=solver_in_the_loop", "refinement.window=4", "refinement.epochs=3"]
LEARNED = ["train", "train_simfree", "evaluate", "time", "report"]
CORRECTED = ["reconstruct", "train", "evaluate", "time", "report"]
MODELS = ("simulation", "resphys", "reconstruction")
SMALL = ["mesh.divisions=[4,2,2]"]
SHORT = [
    "data.steps=12",
    "data.weights_g.train=[50,90,130]",
    "data.weights_g.validation=[110]",
    "data.weights_g.test=[70,150]",
    "trainer.epochs=40",
    "trainer.rollout_every=10",
    "network.width=32",
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
]
TINY = [*SMALL, *SHORT]
IN_RUN = "hydra.run.dir=run"


def run(*arguments):
    """Exit code of the command in this process, and what it wrote to stderr."""
    out, err, argv = io.StringIO(), io.StringIO(), sys.argv
    sys.argv = ["warp-resphys", *arguments]
    code = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main()
        except SystemExit as end:
            code = end.code
        finally:
            sys.argv = argv
    return code, err.getvalue()


def metrics(folder="run"):
    return json.loads((Path(folder) / "metrics.json").read_text())


def errors(folder="run"):
    """All errors [mm] of a run, flat."""
    found = metrics(folder)
    groups = [found["errors_mm"], found["errors_vs_reconstruction_mm"]]
    values = [group[model][key] for group in groups for model in sorted(group) for key in ("mean", "std")]
    return values + [each["errors_mm"][model] for each in found["per_trajectory"] for model in MODELS]


def same_errors(a, b):
    np.testing.assert_allclose(a, b, rtol=1e-6)


def files(folder="run"):
    """Content of everything in the run folder but Hydra's own, by name."""
    root = Path(folder)
    paths = [p for p in root.rglob("*") if p.is_file() and ".hydra" not in p.parts and p.name != ".lock"]
    return {str(p.relative_to(root)): (p.stat().st_mtime_ns, p.read_bytes()) for p in paths}


def ran(before):
    """Stages whose record is another than before."""
    now = files()
    return [
        s for s in REFINED if f"stages/{s}.json" in now and now[f"stages/{s}.json"] != before.get(f"stages/{s}.json")
    ]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def no_report(monkeypatch):
    """The report takes most of a tiny run's time, and has tests of its own."""
    monkeypatch.setattr(experiment, "make_report", lambda context: (context.run_dir / "report.html").write_text("-"))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A complete run with its report, and one more of the same command."""
    root = tmp_path_factory.mktemp("finished")
    with contextlib.chdir(root):
        assert run(*TINY, IN_RUN)[0] == 0
        first = files()
        assert run(*TINY, IN_RUN)[0] == 0
        return root / "run", first, files()


@pytest.fixture
def copied(finished, folder):
    """A copy of the complete run, to change."""
    shutil.copytree(finished[0], "run")
    return files()


class TestCompleteRun:
    def test_files(self, finished):
        names = set(finished[1]) - {f"stages/{name}.json" for name in STAGES}
        names = {name for name in names if not name.startswith("figures/")}
        data = {"trajectories.h5", "reconstruction.h5", "rollouts.h5", "model.safetensors", "training.json"}
        data |= {"simfree.safetensors", "simfree_training.json", "times.json"}
        assert names == data | {"errors.json", "metrics.json", "report.html"}

    def test_metrics(self, finished):
        found = metrics(finished[0])
        keys = ["errors_mm", "errors_vs_reconstruction_mm", "per_trajectory", "networks", "seconds_per_test_trajectory"]
        assert list(found) == [*keys, "seconds", "peak_memory_gib", "versions", "device"]
        assert set(found["seconds_per_test_trajectory"]) == {"simulation", "true_parameters", "resphys", "inference"}
        assert set(found["errors_mm"]) == {"simulation", "reconstruction", "resphys", "simfree"}
        assert set(found["errors_vs_reconstruction_mm"]) == {"simulation", "resphys", "simfree"}
        assert list(found["seconds"]) == STAGES
        assert all(0.0 < s < 600.0 for s in found["seconds"].values())
        assert 0.1 < found["peak_memory_gib"] < 4.0
        assert found["versions"] == package_versions()
        assert {"python", "warp-resphys", "warp-lang", "torch"} <= set(found["versions"])
        assert found["device"] in ("cpu", "cuda")
        assert [each["name"] for each in found["per_trajectory"]] == ["70 g", "150 g"]

    def test_the_correction_corrects(self, finished):
        found = metrics(finished[0])["errors_mm"]
        assert found["simulation"]["mean"] > 0.5
        assert found["resphys"]["mean"] < 0.02 * found["simulation"]["mean"]
        assert found["reconstruction"]["mean"] < 1e-3
        assert all(found[model]["diverged"] == 0 for model in MODELS)

    def test_errors_are_those_of_the_stored_positions(self, finished):
        with read_hdf5(finished[0] / "trajectories.h5", "trajectories") as file:
            assert list(file.attrs["names"]) == [f"{w} g" for w in (50, 90, 130, 110, 70, 150)]
            target = file["q"][4:, 1:]
            assert file["q"].shape == (6, 13, 45, 3)
            assert file["q"].attrs["units"] == "m"
        with read_hdf5(finished[0] / "rollouts.h5", "rollouts") as file:
            stored = {model: file[f"{model}_q"][:, 1:] for model in ("simulation", "resphys", "simfree")}
        with read_hdf5(finished[0] / "reconstruction.h5", "reconstruction") as file:
            stored["reconstruction"] = file["q"][4:, 1:]
            assert not file["force"][:, 0].any()
        found = metrics(finished[0])
        for model, q in stored.items():
            distances = 1e3 * np.linalg.norm(q - target, axis=-1).mean(-1)
            summary = found["errors_mm"][model]
            np.testing.assert_allclose([summary["mean"], summary["std"]], [distances.mean(), distances.std()])
        against = 1e3 * np.linalg.norm(stored["resphys"] - stored["reconstruction"], axis=-1).mean()
        np.testing.assert_allclose(found["errors_vs_reconstruction_mm"]["resphys"]["mean"], against)

    def test_the_roll_out_starts_from_the_target_and_knows_nothing_else_of_it(self, finished):
        with read_hdf5(finished[0] / "trajectories.h5", "trajectories") as file:
            start, target = file["q"][4:, 0], file["q"][4:]
        with read_hdf5(finished[0] / "rollouts.h5", "rollouts") as file:
            np.testing.assert_array_equal(file["resphys_q"][:, 0], start)
            np.testing.assert_array_equal(file["simulation_q"][:, 0], start)
            assert np.abs(file["resphys_q"][:, -1] - target[:, -1]).max() > 0.0

    def test_settings_and_seeds_are_saved(self, finished):
        record = json.loads((finished[0] / "stages" / "train.json").read_text())
        assert record["settings"]["seed"] == 0
        assert record["settings"]["trainer"]["epochs"] == 40
        saved = OmegaConf.load(finished[0] / ".hydra" / "config.yaml")
        assert saved.network.width == 32
        training = json.loads((finished[0] / "training.json").read_text())
        history, kept = training["epochs"], training["kept"]
        assert [r["epoch"] for r in history if "rollout_error_mm" in r] == [10, 20, 30, 40]
        assert kept["validation_rollout_error_mm"] == min(r.get("rollout_error_mm", 1e9) for r in history)
        assert history[kept["epoch"] - 1]["rollout_error_mm"] == kept["validation_rollout_error_mm"]
        _, metadata = read_checkpoint(finished[0] / "model.safetensors", "residual force")
        assert metadata.items() >= kept.items()
        assert metrics(finished[0])["networks"]["resphys"] == kept

    def test_the_report_is_self_contained(self, finished):
        page = (finished[0] / "report.html").read_text()
        assert "4.488" in page  # published, beside ours
        assert not re.search(r"""<(?:script|img|link|iframe|source)\b[^>]*\b(?:src|href)\s*=\s*["'](?!data:)""", page)
        assert "@import" not in page

    def test_the_second_call_runs_nothing(self, finished):
        _, first, second = finished
        changed = [name for name in second if second[name] != first.get(name)]
        assert changed == ["metrics.json"]
        assert json.loads(first["metrics.json"][1]) == json.loads(second["metrics.json"][1])


@pytest.mark.usefixtures("no_report")
class TestChanges:
    @pytest.mark.parametrize(
        ("override", "expected"),
        [
            ("trainer.epochs=30", LEARNED),
            ("network.blocks=2", LEARNED),
            ("seed=3", LEARNED),
            ("reconstruction.regularisation=1e-9", CORRECTED),
            ("simulation.youngs_modulus=220e3", CORRECTED),
            ("reality.youngs_modulus=270e3", STAGES),
            ("data.weights_g.test=[60]", STAGES),
            ("title=Another", ["report"]),
        ],
    )
    def test_what_depends_on_it_runs_again_and_nothing_else(self, copied, override, expected):
        assert run(*TINY, IN_RUN, override)[0] == 0
        assert ran(copied) == expected

    def test_the_same_seed_gives_the_same_numbers_in_another_folder(self, finished, folder):
        assert run(*TINY, "hydra.run.dir=again")[0] == 0
        same_errors(errors("again"), errors(finished[0]))

    def test_multirun(self, finished, folder):
        code, err = run("--multirun", "seed=0,1", *TINY)
        assert (code, "Traceback" in err) == (0, False)
        folders = sorted(Path("runs/beam_oscillation").glob("*/metrics.json"))
        assert len(folders) == 2
        found = [errors(path.parent) for path in folders]
        seeds = [OmegaConf.load(path.parent / ".hydra" / "config.yaml").seed for path in folders]
        same_errors(found[seeds.index(0)], errors(finished[0]))
        assert found[0] != found[1]
        same_errors(*(metrics(path.parent)["errors_mm"]["simulation"]["mean"] for path in folders))

    @pytest.mark.parametrize(
        "options",
        [
            ["mesh=beam_tetrahedra", "mesh.divisions=[2,1,1]", *SHORT],
            ["physics=published", *TINY],
            ["solver=newton", *TINY],
            ["solver=projective_dynamics", *TINY, "data.steps=4"],
            ["reconstruction=lbfgsb", *TINY, "data.steps=4"],
            ["trainer=published", *TINY, "trainer.learning_rate=1e-2"],
            ["integrator=bdf2", *TINY],
            ["integrator=midpoint", *TINY],
            ["reality.model=stable_neo_hookean", "reality.stiffness_damping=1e-3", *TINY],
        ],
        ids=lambda options: options[0],
    )
    def test_other_options_run_and_the_correction_corrects(self, folder, options):
        code, err = run(*options, IN_RUN)
        assert (code, "Warning" in err) == (0, False)
        found = metrics()["errors_mm"]
        assert found["reconstruction"]["mean"] < 0.1 * found["simulation"]["mean"]
        assert found["resphys"]["mean"] < 0.5 * found["simulation"]["mean"]

    def test_the_published_network_runs(self, folder):
        short = [option for option in TINY if not option.startswith("network")]
        small = ["network=published", "network.width=16", "trainer.epochs=2", "trainer.rollout_every=1"]
        assert run(*short, *small, IN_RUN)[0] == 0
        for name, history, kind in (
            ("model", "training", "residual force"),
            ("simfree", "simfree_training", "next state"),
        ):
            _, metadata = read_checkpoint(f"run/{name}.safetensors", kind)
            assert metadata["architecture"] == {"blocks": 5, "layers": 3, "width": 16}
            assert not metadata["reduced"]
            records = json.loads(Path(f"run/{history}.json").read_text())["epochs"]
            assert [r["epoch"] for r in records if "rollout_error_mm" in r] == [1, 2]
        assert metrics()["errors_mm"].keys() == {*MODELS, "simfree"}

    def test_kept_weights_that_diverge_are_no_secret(self, folder, monkeypatch, caplog):
        monkeypatch.setattr(train.Validation, "error_mm", lambda self, rollout: float("inf"))
        assert run(*TINY, IN_RUN, "trainer.selection=validation_loss", "trainer.epochs=3")[0] == 0
        assert "train: the weights that are kept diverge on the validation split" in caplog.text
        for name in ("resphys", "simfree"):
            kept = metrics()["networks"][name]
            assert (kept["selection"], kept["validation_rollout_error_mm"]) == ("validation_loss", None)
        history = json.loads(Path("run/training.json").read_text())["epochs"]
        assert min(history, key=lambda r: r["validation_loss"])["epoch"] == metrics()["networks"]["resphys"]["epoch"]

    def test_refinement_is_never_worse_on_the_validation_split(self, finished, copied):
        """Here it overfits three short trajectories, so that the weights from before it are taken."""
        assert run(*TINY, *REFINE, IN_RUN)[0] == 0
        assert ran(copied) == ["refine", "evaluate", "time", "report"]
        history = json.loads(Path("run/refinement.json").read_text())["epochs"]
        assert [r["epoch"] for r in history] == [0, 1, 2, 3]
        assert history[3]["train_loss"] < history[0]["train_loss"]
        found, before = metrics()["networks"], metrics(finished[0])["networks"]
        assert found["resphys"] == before["resphys"]
        assert found["refinement"]["epoch"] == 0
        start = found["resphys"]["validation_rollout_error_mm"]
        assert found["refinement"]["validation_rollout_error_mm"] == pytest.approx(start, rel=1e-6)
        same_errors(errors(), errors(finished[0]))
        before = files()
        assert run(*TINY, *REFINE, IN_RUN, "refinement.epochs=1")[0] == 0
        assert ran(before) == ["refine", "evaluate", "time", "report"]

    def test_refinement_helps_a_poor_network(self, folder):
        poor = [*TINY, "trainer.epochs=3", "trainer.linear_noise=null"]
        assert run(*poor, *REFINE, "hydra.run.dir=run")[0] == 0
        found, refined = metrics(), files()
        assert found["networks"]["refinement"]["epoch"] > 0
        start = found["networks"]["resphys"]["validation_rollout_error_mm"]
        assert found["networks"]["refinement"]["validation_rollout_error_mm"] < 0.9 * start
        assert list(found["seconds"]) == REFINED
        assert run(*poor, IN_RUN)[0] == 0  # without it again
        assert ran(refined) == ["evaluate", "time", "report"]
        assert list(metrics()["seconds"]) == STAGES
        assert found["errors_mm"]["resphys"]["mean"] < 0.9 * metrics()["errors_mm"]["resphys"]["mean"]

    def test_a_diverged_roll_out_is_counted_and_is_no_number(self, finished, copied, monkeypatch):
        """The second of two test trajectories gets a force that is not finite at its fifth step."""
        whole = evaluate.force_predictor

        def diverging(model):
            predict, calls = whole(model), []

            def force(q, v):
                calls.append(None)
                found = predict(q, v)
                found[1] *= torch.nan if len(calls) == 5 else 1.0
                return found

            return force

        monkeypatch.setattr(evaluate, "force_predictor", diverging)
        Path("run/rollouts.h5").unlink()
        assert run(*TINY, IN_RUN)[0] == 0
        found, before = metrics(), metrics(finished[0])
        for group in ("errors_mm", "errors_vs_reconstruction_mm"):
            lost = {"mean": None, "std": None, "trajectories": 2, "diverged": 1}
            expected = {model: pytest.approx(summary, rel=1e-6) for model, summary in before[group].items()}
            assert found[group] == {**expected, "resphys": lost}
        rows, expected = ([each["errors_mm"] for each in m["per_trajectory"]] for m in (found, before))
        assert rows[0] == pytest.approx(expected[0], rel=1e-6)
        assert rows[1].pop("resphys") is None
        assert expected[1].pop("resphys") is not None
        assert rows[1] == pytest.approx(expected[1], rel=1e-6)
        with read_hdf5("run/rollouts.h5", "rollouts") as file:
            assert np.isnan(file["resphys_q"][:]).all((2, 3)).tolist() == [13 * [False], 5 * [False] + 8 * [True]]
            assert np.isfinite(file["resphys_q"][1, :5]).all()


class Interruption:
    """Sends SIGINT to this process at a chosen step or epoch, and counts the work done."""

    def __init__(self, monkeypatch):
        self.at = None
        self.done = Counter()
        append, run_epoch = ResumableHDF5.append, EpochTrainer.run_epoch

        def interrupted_append(file, **arrays):
            append(file, **arrays)
            self.count(file.kind)

        def interrupted_epoch(trainer):
            record = run_epoch(trainer)
            self.count("epochs")
            return record

        monkeypatch.setattr(ResumableHDF5, "append", interrupted_append)
        monkeypatch.setattr(EpochTrainer, "run_epoch", interrupted_epoch)

    def count(self, kind):
        self.done[kind] += 1
        if self.at == (kind, self.done[kind]):
            signal.raise_signal(signal.SIGINT)


@pytest.mark.usefixtures("no_report")
class TestInterruption:
    @pytest.fixture
    def interruption(self, monkeypatch):
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        yield Interruption(monkeypatch)
        signal.signal(signal.SIGINT, before)

    @pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
    def test_ctrl_c_in_every_stage(self, folder, interruption, integrator):
        arguments = [*TINY, f"integrator={integrator}"]
        assert run(*arguments, "hydra.run.dir=whole")[0] == 0
        whole = Counter(interruption.done)
        assert whole == {"trajectories": 13, "reconstruction": 13, "epochs": 80, "rollouts": 13}
        interruption.done.clear()
        cuts = {"trajectories": ("generate", 1), "reconstruction": ("reconstruct", 7), "epochs": ("train", 25)}
        for kind, (stage, at) in {**cuts, "rollouts": ("evaluate", 5)}.items():
            interruption.at = (kind, at)
            code, err = run(*arguments, IN_RUN)
            assert code == 130
            assert f"interrupted in stage '{stage}'" in err
            assert "the same command goes on from there" in err
            assert "Traceback" not in err
            assert not Path("run/metrics.json").exists()
            assert not list(Path("run").rglob("*.partial"))
        interruption.at = None
        assert run(*arguments, IN_RUN)[0] == 0
        repeated = interruption.done - whole
        assert sorted(repeated.elements()) in ([], ["epochs"])  # the epoch that the signal fell into
        same_errors(errors(), errors("whole"))
        assert not list(Path("run").glob("*.journal"))
        assert not list(Path("run").glob("train*.safetensors"))

    def test_ctrl_c_while_refining(self, finished, folder, interruption):
        shutil.copytree(finished[0], "run")
        shutil.copytree(finished[0], "whole")
        assert run(*TINY, *REFINE, "hydra.run.dir=whole")[0] == 0
        assert interruption.done["epochs"] == 3
        interruption.done.clear()
        interruption.at = ("epochs", 2)
        code, err = run(*TINY, *REFINE, IN_RUN)
        assert (code, "interrupted in stage 'refine'" in err) == (130, True)
        interruption.at = None
        assert run(*TINY, *REFINE, IN_RUN)[0] == 0
        assert interruption.done["epochs"] in (3, 4)
        first, second = (json.loads(Path(f"{name}/refinement.json").read_text()) for name in ("run", "whole"))
        losses = [[r["train_loss"] for r in found["epochs"]] for found in (first, second)]
        assert losses[0] == losses[1]
        same_errors(errors(), errors("whole"))

    def test_twice_in_one_stage_and_before_the_first_frame(self, finished, folder, interruption):
        for at in (1, 2, 9):
            interruption.at = ("reconstruction", at)
            assert run(*TINY, IN_RUN)[0] == 130
        interruption.at = None
        assert run(*TINY, IN_RUN)[0] == 0
        same_errors(errors(), errors(finished[0]))

    def test_each_frame_starts_from_the_force_of_the_one_before(self, folder, interruption, monkeypatch):
        guesses, step = [], LBFGSB.step

        def recorded(self, state, observed, first_guess=None):
            guesses.append(first_guess)
            return step(self, state, observed, first_guess)

        monkeypatch.setattr(LBFGSB, "step", recorded)
        arguments = [*TINY, IN_RUN, "reconstruction=lbfgsb", "data.steps=4"]
        interruption.at = ("reconstruction", 3)
        assert run(*arguments)[0] == 130
        assert run(*arguments)[0] == 0
        with read_hdf5("run/reconstruction.h5", "reconstruction") as file:
            np.testing.assert_array_equal(np.stack(guesses, axis=1), file["force"][:, :-1])

    @staticmethod
    def start(until):
        """The command in a process of its own, once a file is there."""
        program = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        program += "from warp_resphys.cli import main\nmain()"
        command = [sys.executable, "-c", program, *TINY, IN_RUN]
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
        child = subprocess.Popen(command, env=environment, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        while not Path(until).exists() and child.poll() is None:
            time.sleep(0.002)
        return child

    def test_ctrl_c_in_a_real_process(self, finished, folder):
        child = self.start("run/trajectories.h5.journal")
        child.send_signal(signal.SIGINT)
        err = child.communicate(timeout=60)[1]
        assert child.returncode == 130, err
        assert "interrupted in stage" in err
        assert "Traceback" not in err
        assert run(*TINY, IN_RUN)[0] == 0
        same_errors(errors(), errors(finished[0]))

    def test_killed_without_warning(self, finished, folder):
        child = self.start("run/reconstruction.h5.journal")
        child.kill()
        err = child.communicate(timeout=60)[1]
        assert child.returncode == -signal.SIGKILL, err
        assert run(*TINY, IN_RUN)[0] == 0
        same_errors(errors(), errors(finished[0]))


class TestBadInput:
    @pytest.mark.parametrize(
        ("overrides", "sentence"),
        [
            ("simulation.youngs_modulus=0", "simulation: youngs_modulus is 0: it must be positive, in pascals."),
            ("reality.youngs_modulus=-1e5", "reality: youngs_modulus is -100000: it must be positive, in pascals."),
            ("simulation.youngs_modulus=nan", "simulation: youngs_modulus is nan: it must be positive, in pascals."),
            ("simulation.poissons_ratio=0.5", "simulation: poissons_ratio is 0.5: it must be greater than -1 and less"),
            (
                "reality.poissons_ratio=-1",
                "reality: poissons_ratio is -1: it must be greater than -1 and less than 0.5.",
            ),
            ("time_step=0", "time_step is 0: it must be positive, in seconds."),
            ("time_step=-0.01", "time_step is -0.01: it must be positive, in seconds."),
            ("experiment=beam_oscilation", "unknown experiment 'beam_oscilation', did you mean 'beam_oscillation'"),
            ("trainer.epoch=5", "unknown key 'trainer.epoch', did you mean 'trainer.epochs'"),
            ("+simulation.stiffness=5", "unknown key 'simulation.stiffness': simulation has youngs_modulus, "),
            ("simulation.youngs_modulus=soft", "simulation.youngs_modulus is 'soft': it must be a number."),
            ("trainer.epochs=2.5", "trainer.epochs is 2.5: it must be a whole number."),
            ("trainer.learning_rate=0", "trainer.learning_rate is 0: it must be positive."),
            ("trainer.schedule=2", "trainer.schedule is 2: it must be a word."),
            ("trainer.step_epochs=1.5", "trainer.step_epochs is 1.5: it must be a whole number."),
            ("refinement=solver", "unknown refinement 'solver'; known are none, solver_in_the_loop"),
            ("refinement.kind=solver", "refinement.kind is 'solver': choose one of none, solver_in_the_loop."),
            ("reconstruction.regularisation=-1", "reconstruction.regularisation is -1: it must be zero or more."),
            ("network.kind=graph", "network.kind is 'graph': choose one of reduced, nodal."),
            ("network.force_modes=1000", "1000 modes were asked for, but 36 samples give 1 to 36."),
            ("solver.name=gradient_descent", "solver is 'gradient_descent': choose one of"),
            ("integrator=rk4", "integrator is 'rk4': choose one of implicit_euler, bdf2, midpoint."),
            ("device=tpu", "device is 'tpu': choose auto, cpu or cuda."),
            ("device=mps", "device is 'mps': choose auto, cpu or cuda."),
            ("dtype=float16", "dtype is 'float16': experiments need float64"),
            ("seed=-1", "seed is -1: it must lie between 0 and 2^63 - 1."),
            ("gravity=[0,0]", "gravity is [0, 0]: it must be three finite numbers, in m/s^2."),
            ("gravity=[0,0,inf]", "gravity is [0, 0, inf]: it must be three finite numbers, in m/s^2."),
            ("fixed=null", "fixed is None: it must be a group of settings."),
            ("fixed.x=0.5", "no vertex lies within 1e-09 m of x = 0.5 m"),
            ("data.load.x=0.5", "no vertex lies within 1e-09 m of x = 0.5 m"),
            ("data.steps=0", "data.steps is 0: it must be positive."),
            ("data.weights_g.train=[]", "data.weights_g.train is empty: give the split at least one value."),
            ("data.weights_g.validation=[]", "data.weights_g.validation is empty"),
            ("data.weights_g.test=[]", "data.weights_g.test is empty"),
            ("data.weights_g.test=[90]", "data.weights_g names 90 g twice: every trajectory is in one split."),
            ("data.weights_g.test=[-4]", "data.weights_g.test holds a value that is not positive: [-4.0]."),
            ("data.weights_g.test=70", "data.weights_g.test is 70: it must be a list of numbers."),
            ("data.kind=drop", "data.kind is 'drop': choose one of release_from_load, release_from_twist."),
            ("solver.max_iterations=1", "the newton solver stopped after 1 iterations"),
            ("reconstruction.max_iterations=1", "Gauss-Newton reconstruction moved by"),
        ],
    )
    def test_settings(self, folder, overrides, sentence):
        code, err = run(*TINY, IN_RUN, overrides)
        self.check(code, err, sentence)

    @pytest.mark.parametrize("content", [None, b"", b"not a mesh", b"\x89HDF\r\n\x1a\n", "truncated", "surface"])
    def test_mesh(self, folder, content):
        box = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2))
        name = "box.vtu"
        if content in ("truncated", "surface"):
            faces = [("quad", box.cells[:, :4])] if content == "surface" else [("hexahedron", box.cells)]
            meshio.write(name, meshio.Mesh(box.vertices, faces))
            if content == "truncated":
                Path(name).write_bytes(Path(name).read_bytes()[:-300])
        elif content is not None:
            Path(name).write_bytes(content)
        code, err = run(*SHORT, IN_RUN, "mesh=file", f"mesh.path={name}")
        self.check(code, err, "box.vtu: ")

    def test_mesh_without_path(self, folder):
        code, err = run(*SHORT, IN_RUN, "mesh=file")
        self.check(code, err, "Missing mandatory value: path (at mesh.path)")

    @staticmethod
    def check(code, err, sentence):
        lines = [line for line in err.splitlines() if not line.startswith(tuple(f"{stage}: " for stage in STAGES))]
        assert code == 2
        assert len(lines) == 1
        assert lines[0].startswith(f"error: {sentence}")
        written = {path.name for path in Path("run").rglob("*") if path.is_file()} if Path("run").exists() else set()
        assert not written & {"metrics.json", "report.html", "model.safetensors", "rollouts.h5"}
        assert not [name for name in written if name.endswith(".partial")]

    def test_a_file_mesh_runs(self, folder, no_report, finished):
        box = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2))
        meshio.write("box.vtu", meshio.Mesh(100.0 * box.vertices, [("hexahedron", box.cells)]))
        tolerance = ["+fixed.tolerance=1e-6", "+data.load.tolerance=1e-6"]
        arguments = [*SHORT, IN_RUN, "mesh=file", "mesh.path=box.vtu", "mesh.units=cm", *tolerance]
        assert run(*arguments)[0] == 0
        np.testing.assert_allclose(errors()[:2], errors(finished[0])[:2], rtol=0.05)
        before = files()
        box = box_hexahedra((0.1, 0.03, 0.03), (3, 2, 2))
        meshio.write("box.vtu", meshio.Mesh(100.0 * box.vertices, [("hexahedron", box.cells)]))
        assert run(*arguments)[0] == 0
        assert ran(before) == STAGES  # the file's content counts, not its name

    @pytest.mark.parametrize("damage", ["truncated", "foreign", "of another stage", "changed"])
    def test_a_damaged_file_in_the_run_folder_is_an_error_until_it_is_deleted(
        self, finished, copied, no_report, caplog, damage
    ):
        path = Path("run/reconstruction.h5")
        if damage == "truncated":
            path.write_bytes(path.read_bytes()[:-1000])
        elif damage == "foreign":
            path.unlink()
            with h5py.File(path, "w") as file:
                file["q"] = np.zeros(3)
        elif damage == "of another stage":
            shutil.copy("run/trajectories.h5", path)
        else:
            content = bytearray(path.read_bytes())
            content[len(content) // 2] ^= 0xFF
            path.write_bytes(content)
        found = path.read_bytes()
        code, err = run(*TINY, IN_RUN)
        assert code == 2
        assert err.splitlines()[-1].startswith("error: ")
        assert "reconstruction.h5" in err.splitlines()[-1]
        assert "Traceback" not in err
        assert path.read_bytes() == found
        path.unlink()
        assert run(*TINY, IN_RUN)[0] == 0
        assert "reconstruct: missing or changed since they were written: reconstruction.h5" in caplog.text
        assert ran(copied) == ["reconstruct"]  # the same forces as before: what follows is still valid
        same_errors(errors(), errors(finished[0]))

    @staticmethod
    def run_with_files_up_to(kilobytes):
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000 * kilobytes, limits[1]))
        try:
            return run(*TINY, IN_RUN)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    @pytest.mark.parametrize(
        ("kilobytes", "full"),
        [(10, "trajectories.h5.journal"), (172, "trajectories.h5"), (230, "reconstruction.h5.journal")],
    )
    def test_full_disk(self, finished, folder, no_report, kilobytes, full):
        code, err = self.run_with_files_up_to(kilobytes)
        line = err.splitlines()[-1]
        assert code == 2
        assert line.startswith(f"error: disk is full while writing {folder}/run/{full}: free some space and run the")
        assert "Traceback" not in err
        assert not Path("run/metrics.json").exists()
        assert not list(Path("run").rglob("*.partial"))
        assert run(*TINY, IN_RUN)[0] == 0
        same_errors(errors(), errors(finished[0]))

    def test_full_disk_while_the_report_is_written(self, copied):
        Path("run/report.html").unlink()
        code, err = self.run_with_files_up_to(300)
        assert code == 2
        assert re.fullmatch(rf"error: [^\n]*{Path.cwd()}/run/report\.html[^\n]*\n", err)
        assert not Path("run/report.html").exists()
        assert ran(copied) == []  # no record says that there is a report
        assert run(*TINY, IN_RUN)[0] == 0
        assert ran(copied) == ["report"]
        assert Path("run/report.html").stat().st_size > 300_000


def options(group):
    return sorted(path.stem for path in (REPOSITORY / "conf" / group).glob("*.yaml"))


GROUPS = ("mesh", "physics", "solver", "reconstruction", "network", "trainer", "refinement", "budget")
SIMULATED = [name for name in options("experiment") if not name.startswith("beam_real")]  # others: test_measured.py
CHOICES = [(name, group, option) for name in SIMULATED for group in GROUPS for option in options(group)]


class TestConfiguration:
    def composed(self, *overrides):
        with initialize_config_module("warp_resphys.conf", version_base="1.3"):
            config = compose("config", overrides=list(overrides))
        return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)

    @pytest.mark.parametrize(("name", "group", "option"), CHOICES, ids="-".join)
    def test_every_option_of_every_experiment_is_accepted_and_built(self, folder, name, group, option):
        overrides = [f"experiment={name}", f"{group}={option}"]
        if (group, option) == ("mesh", "file"):
            box = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2))
            meshio.write("box.vtu", meshio.Mesh(box.vertices, [("hexahedron", box.cells)]))
            overrides.append("mesh.path=box.vtu")
        config = self.composed(*overrides)
        check_configuration(config)
        real, wrong = (build_simulator(config, which) for which in ("reality", "simulation"))
        assert real.material != wrong.material
        wanted = REFINED if option == "solver_in_the_loop" else STAGES
        assert [stage.name for stage in experiment.stages(config)] == wanted

    def test_published_sizes_and_settings(self):
        config = self.composed("physics=published", "network=published", "trainer=published")
        assert build_simulator(config).body.n_vertices * 3 == 528
        assert {k: len(v) for k, v in config["data"]["weights_g"].items()} == {"train": 9, "validation": 2, "test": 5}
        assert config["data"]["steps"] == 150
        assert [config["network"][k] for k in ("blocks", "layers", "width")] == [5, 3, 512]
        keys = ("epochs", "batch_size", "learning_rate", "weight_decay")
        assert [config["trainer"][k] for k in keys] == [1000, 256, 1e-3, 1e-5]
        keys = ("schedule", "gamma", "step_epochs", "selection")
        assert [config["trainer"][k] for k in keys] == ["step", 0.83, 100, "validation_loss"]
        assert config["physics"] == {"mass": "per_vertex", "volume_integration": "full"}
