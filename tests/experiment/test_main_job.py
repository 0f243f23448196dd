"""The main job through its command line: `warp-resphys` with a small beam,
a few steps and a few epochs.
"""

import json
import os
import signal
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest
import trimesh
from omegaconf import OmegaConf

from support import main_job
from support.configured import settings
from support.main_job import IN_RUN, TINY, errors, finish, metrics, run, same_errors
from warp_resphys import box_hexahedra, pipeline
from warp_resphys.experiment.build import build_mesh, build_simulator
from warp_resphys.experiment.checks import check_run
from warp_resphys.experiment.splits import split_of
from warp_resphys.io.progress import Progress
from warp_resphys.io.resuming import fingerprint, package_versions
from warp_resphys.io.safe_files import read_checkpoint, read_hdf5
from warp_resphys.learning.baselines import BASELINES
from warp_resphys.learning.residuals.correction import Learned
from warp_resphys.learning.residuals.networks import NextState
from warp_resphys.learning.residuals.reconstruction import LBFGSB
from warp_resphys.robot.description import finished_experiment

LEARNED_FILES = (("", "safetensors"), ("training_", "json"))


class TestCompleteRun:
    def test_files_metrics_and_a_correction_that_corrects(self, finished):
        names = set(finished[1]) - {f"stages/{name}.json" for name in main_job.STAGES}
        names = {name for name in names if not name.startswith("figures/")}
        learned = {
            f"{kind}{model}.{end}"
            for model in ("resphys", "simfree")
            for kind, end in LEARNED_FILES
        }
        data = {
            "dataset.h5",
            "reconstruction_resphys.h5",
            "reconstruction.json",
            "rollouts.h5",
            "times.json",
        }
        assert names == data | learned | {
            "errors.json",
            "metrics.json",
            "report.html",
            "stages.json",
        }
        results = metrics(finished[0])
        keys = {
            "errors_mm",
            "errors_vs_reconstruction_mm",
            "per_trajectory",
            "range",
            "networks",
            "parameters",
        }
        keys |= {
            "reconstruction",
            "seconds_per_test_trajectory",
            "seconds",
            "peak_memory_gib",
            "versions",
            "device",
        }
        assert set(results) == keys | {
            "first_guesses",
            "at_bounds",
            "baselines",
            "beyond",
            "recommended",
        }
        assert set(results["seconds_per_test_trajectory"]) == {
            "simulation",
            "target",
            "resphys",
            "inference",
        }
        assert set(results["errors_mm"]) == {
            *BASELINES,
            "simulation",
            "reconstruction",
            "resphys",
            "simfree",
        }
        assert set(results["errors_vs_reconstruction_mm"]) == set(results["errors_mm"]) - {
            "reconstruction"
        }
        assert results["baselines"].keys() == {*BASELINES}
        assert list(results["seconds"]) == main_job.STAGES
        assert 0.1 < results["peak_memory_gib"] < 4.0
        assert results["versions"] == package_versions()
        assert {"python", "warp-resphys", "warp-lang", "torch"} <= set(results["versions"])
        assert [trial["name"] for trial in results["per_trajectory"]] == ["70 g", "150 g"]
        results = metrics(finished[0])["errors_mm"]
        assert results["simulation"]["mean"] > 0.5
        assert results["resphys"]["mean"] < 0.02 * results["simulation"]["mean"]
        assert results["reconstruction"]["mean"] < 1e-3
        assert all(results[model]["diverged"] == 0 for model in main_job.MODELS)

    def test_errors_are_those_of_the_stored_positions(self, finished):
        with read_hdf5(finished[0] / "dataset.h5", "dataset") as file:
            assert list(file.attrs["names"]) == [f"{w} g" for w in (50, 90, 130, 110, 70, 150)]
            target = file["observed"][4:, 1:]
            assert file["observed"].shape == (6, 13, 45, 3)
            assert file["observed"].attrs["units"] == "m"
        with read_hdf5(finished[0] / "rollouts.h5", "rollouts") as file:
            stored = {
                model: file[f"{model}_observed"][:, 1:]
                for model in ("simulation", "resphys", "simfree")
            }
        with read_hdf5(finished[0] / "reconstruction_resphys.h5", "reconstruction") as file:
            stored["reconstruction"] = file["q"][4:, 1:]
            assert not file["force"][:, 0].any()
        results = metrics(finished[0])
        for model, q in stored.items():
            distances = 1e3 * np.linalg.norm(q - target, axis=-1).mean(-1)
            summary = results["errors_mm"][model]
            np.testing.assert_allclose(
                [summary["mean"], summary["std"]], [distances.mean(), distances.std()]
            )
        against = 1e3 * np.linalg.norm(stored["resphys"] - stored["reconstruction"], axis=-1).mean()
        np.testing.assert_allclose(
            results["errors_vs_reconstruction_mm"]["resphys"]["mean"], against
        )

    def test_settings_and_seeds_are_saved(self, finished):
        record = json.loads((finished[0] / "stages" / "train_resphys.json").read_text())[
            "settings"
        ]["training"]
        assert (record["seed"], record["trainer"]["epochs"]) == (0, 40)
        saved = OmegaConf.load(finished[0] / ".hydra" / "config.yaml")
        assert saved.network.width == 32
        training = json.loads((finished[0] / "training_resphys.json").read_text())
        history, kept = training["epochs"], training["kept"]
        assert [r["epoch"] for r in history if "rollout_error_mm" in r] == [10, 20, 30, 40]
        assert kept["validation_rollout_error_mm"] == min(
            r.get("rollout_error_mm", 1e9) for r in history
        )
        assert history[kept["epoch"] - 1]["rollout_error_mm"] == kept["validation_rollout_error_mm"]
        _, metadata = read_checkpoint(finished[0] / "resphys.safetensors", "residual force")
        assert metadata.items() >= kept.items()
        assert metrics(finished[0])["networks"]["resphys"] == kept

    def test_a_force_that_is_no_clear_gain_is_not_used(self, finished, monkeypatch):
        experiment = finished_experiment(finished[0])
        learned = experiment.learned("resphys")
        refused = replace(learned, test={**learned.test, "used": False})
        monkeypatch.setattr(Learned, "read", lambda *_: refused)
        assert experiment.model("resphys").learned is None
        monkeypatch.setattr(
            Learned, "read", lambda *_: replace(refused, network=NextState.__new__(NextState))
        )
        assert experiment.learned("simfree") is not None

    def test_the_second_call_runs_nothing(self, finished):
        _, first, second = finished
        changed = [name for name in second if second[name] != first.get(name)]
        assert changed == ["metrics.json"]
        assert json.loads(first["metrics.json"][1]) == json.loads(second["metrics.json"][1])


def fingerprints(*overrides):
    """Fingerprints of the stages of a run, by name."""
    run, stages = settings(*overrides), {}
    for stage in pipeline.acquisition_stages(run):
        stages[stage.name] = acquired = fingerprint(stage, stages)
    for stage in pipeline.learning_stages(run, split_of(run), ".", acquired):
        stages[stage.name] = fingerprint(stage, stages)
    return stages


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("trainer.epochs=30", main_job.LEARNED),
        ("seed=3", main_job.LEARNED),
        ("reconstruction.regularisation=1e-9", main_job.CORRECTED),
        ("simulation.youngs_modulus=220e3", main_job.CORRECTED),
        ("target.youngs_modulus=270e3", main_job.STAGES),
        ("data.weights_g.test=[60]", main_job.STAGES),
        ("title=Another", ["report"]),
        ("parallel.processes=2", ["report"]),
    ],
)
def test_a_stage_depends_on_its_own_settings_and_those_before_it(override, expected):
    before, after = fingerprints(*TINY), fingerprints(*TINY, override)
    assert [name for name in main_job.STAGES if after[name] != before[name]] == expected


PLANNED = {"plan_resphys", "plan_sysid", "plan_simulation"}
CONTROLLED = {"reduce_resphys", "reduce_sysid", "reduce_simulation", *PLANNED, "baselines", "drive"}
TRAINED = {"train_resphys", "train_simfree", "evaluate", *CONTROLLED}
IMPORTED = {"import", "identify", "reconstruct_resphys", "mesh_check", *TRAINED}


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("control.feedback.gains=[1.0]", {"baselines", "drive"}),
        ("control.plan.corrections=1", {*PLANNED, "drive"}),
        ("data.horizons=[0.5]", {"evaluate", *CONTROLLED}),
        ("trainer.epochs=7", TRAINED),
        ("markers.largest_residual=0.01", IMPORTED),
        ("laboratory.noise=2e-3", {"laboratory", *IMPORTED}),
    ],
)
def test_a_stage_of_a_laboratory_or_of_control_reads_single_keys(override, expected):
    run = "experiment=sopra_control"
    before, after = fingerprints(run), fingerprints(run, override)
    assert {name for name in before if after[name] != before[name]} == {*expected, "report"}


def check_correction(*options):
    """A run without a warning, whose forces and whose network correct."""
    code, err = run(*options, IN_RUN)
    assert (code, "Warning" in err) == (0, False)
    results = metrics()["errors_mm"]
    assert results["reconstruction"]["mean"] < 0.1 * results["simulation"]["mean"]
    assert results["resphys"]["mean"] < 0.5 * results["simulation"]["mean"]


@pytest.mark.slow
@pytest.mark.usefixtures("no_report")
class TestOtherRuns:
    @pytest.mark.parametrize(
        "options",
        [
            ["mesh=beam_tetrahedra", "mesh.divisions=[2,1,1]", *main_job.SHORT],
            ["physics=published", *TINY, "trainer=published", "trainer.learning_rate=1e-2"],
            ["solver=projective_dynamics", *TINY, "data.steps=4"],
            [
                "integrator=midpoint",
                "target.model=stable_neo_hookean",
                "target.stiffness_damping=1e-3",
                *TINY,
            ],
        ],
        ids=lambda options: options[0],
    )
    def test_other_options_run_and_the_correction_corrects(self, folder, options):
        check_correction(*options)

    def test_each_frame_of_lbfgsb_starts_from_the_force_of_the_one_before(
        self, folder, monkeypatch
    ):
        guesses, step = [], LBFGSB.step

        def recorded(self, state, observed, inputs=None, first_guess=None, read=None):
            guesses.append(first_guess)
            return step(self, state, observed, inputs, first_guess)

        monkeypatch.setattr(LBFGSB, "step", recorded)
        check_correction("reconstruction=lbfgsb", *TINY, "data.steps=4")
        with read_hdf5("run/reconstruction_resphys.h5", "reconstruction") as file:
            np.testing.assert_array_equal(np.stack(guesses, axis=1), file["force"][:, :-1])

    def test_seeds_of_a_multirun_give_other_networks_of_the_same_data(self, folder):
        code, err = run("--multirun", "seed=0,1", *TINY, "data.steps=4", "trainer.epochs=10")
        assert (code, "Traceback" in err) == (0, False)
        folders = [path.parent for path in Path("runs/beam_oscillation").glob("*/metrics.json")]
        first, second = map(errors, folders)
        assert first != second
        same_errors(*(metrics(folder)["errors_mm"]["simulation"]["mean"] for folder in folders))

    def test_the_same_seed_gives_the_same_numbers_in_another_process(self, finished, folder):
        """Of two threads and another order of sets."""
        places = os.pathsep.join(place for place in sys.path if place)
        environment = {
            **os.environ,
            "PYTHONHASHSEED": "2",
            "OMP_NUM_THREADS": "2",
            "PYTHONPATH": places,
        }
        program = (
            "import sys; from support.main_job import run_without_report as run; "
            "run('.', *sys.argv[1:])"
        )
        command = [sys.executable, "-c", program, *TINY]
        subprocess.run(command, env=environment, check=True, capture_output=True, timeout=300)
        same_errors(errors(), errors(finished[0]))

    def test_a_mesh_from_a_file_is_told_by_its_content(self, folder, finished):
        box = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2))
        meshio.write("box.vtu", meshio.Mesh(100.0 * box.vertices, [("hexahedron", box.cells)]))
        tolerance = ["+fixed.tolerance=1e-6", "+data.load.tolerance=1e-6"]
        arguments = [*main_job.SHORT, "mesh=file", "mesh.path=box.vtu", "mesh.units=cm", *tolerance]
        finish(*arguments)
        np.testing.assert_allclose(errors()[:2], errors(finished[0])[:2], rtol=0.05)
        before = fingerprints(*arguments)
        box = box_hexahedra((0.1, 0.03, 0.03), (3, 2, 2))
        meshio.write("box.vtu", meshio.Mesh(100.0 * box.vertices, [("hexahedron", box.cells)]))
        after = fingerprints(*arguments)
        assert [name for name in main_job.STAGES if after[name] != before[name]] == main_job.STAGES


def options(group):
    return sorted(path.stem for path in (main_job.REPOSITORY / "conf" / group).glob("*.yaml"))


FROM_MARKERS = ("levenberg_marquardt", "pressure_steps")  # reconstructions
GROUPS = ("physics", "solver", "reconstruction", "network", "trainer")


def choices():
    """Every mesh alone, and choices of all other groups at once,
    which have each option at least once.
    """
    for option in options("mesh"):
        yield [f"mesh={option}"]
    others = {
        group: [option for option in options(group) if option not in FROM_MARKERS]
        for group in GROUPS
    }
    for row in range(max(len(names) for names in others.values())):
        yield [f"{group}={names[row % len(names)]}" for group, names in others.items()]


class TestConfiguration:
    @pytest.mark.parametrize("chosen", choices(), ids=" ".join)
    def test_every_option_is_accepted_and_built(self, folder, chosen):
        choice = chosen[0]
        box = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2))
        if choice == "mesh=surface":
            pytest.importorskip("gmsh", reason="gmsh is not installed", exc_type=ImportError)
            trimesh.creation.box(bounds=[[0.0, 0.0, 0.0], [0.1, 0.03, 0.03]]).export("box.obj")
        meshio.write("box.vtu", meshio.Mesh(box.vertices, [("hexahedron", box.cells)]))
        more = {"mesh=surface": ["mesh.path=box.obj", "mesh.units=m"]}
        more |= {f"mesh={kind}": ["mesh.path=box.vtu"] for kind in ("file", "arm_published")}
        run = settings(*chosen, *more.get(choice, []))
        if (
            choice.startswith(("mesh=arm", "mesh=rod", "mesh=segment"))
            and choice != "mesh=arm_published"
        ):
            assert build_mesh(run.mesh).cells.shape[1] in (4, 8, 10, 20, 27)
        else:
            check_run(run)

    def test_published_sizes_and_settings(self):
        run = settings("physics=published", "network=published", "trainer=published")
        assert build_simulator(run, run.simulation).body.n_vertices * 3 == 528
        assert [
            len(getattr(run.data.weights_g, name)) for name in ("train", "validation", "test")
        ] == [9, 2, 5]
        assert run.data.steps == 150
        assert (run.network.blocks, run.network.layers, run.network.width) == (5, 3, 512)
        trainer = run.trainer
        assert (trainer.epochs, trainer.batch_size) == (1000, 256)
        assert (trainer.learning_rate, trainer.weight_decay) == (1e-3, 1e-5)
        assert (trainer.schedule, trainer.gamma, trainer.step_epochs) == ("step", 0.83, 100)
        assert trainer.selection == "validation_loss"
        assert dict(run.physics) == {"mass": "per_vertex", "volume_integration": "full"}


@pytest.mark.slow
@pytest.mark.usefixtures("no_report")
class TestInterruption:
    @pytest.fixture
    def interruption(self, monkeypatch):
        """Counts frames and epochs by the stage, and sends a signal
        to this process at a chosen one.
        """
        done, cut, advance = Counter(), {}, Progress.advance
        before = signal.signal(signal.SIGINT, signal.default_int_handler)

        def counted(bar, *count, **shown):
            advance(bar, *count, **shown)
            done[bar.description] += 1
            if (chosen := cut.get((bar.description, done[bar.description]))) is not None:
                signal.raise_signal(chosen)

        monkeypatch.setattr(Progress, "advance", counted)
        yield done, cut
        signal.signal(signal.SIGINT, before)

    def test_ctrl_c_in_every_stage(self, folder, interruption):
        """The last time by SIGTERM, with which clusters end a process."""
        arguments, (done, cut) = [*TINY, "integrator=bdf2"], interruption
        assert run(*arguments, "hydra.run.dir=whole")[0] == 0
        whole = {stage: done[stage] for stage in main_job.STAGES[:5]}
        # Frames and their file, epochs, and frames of three models.
        assert [*whole.values()] == [14, 14, 40, 40, 42]
        done.clear()
        for stage, at in {
            "simulate": 1,
            "reconstruct_resphys": 7,
            "train_resphys": 25,
            "evaluate": 18,
        }.items():
            cut.clear()
            cut[stage, at] = signal.SIGTERM if stage == "evaluate" else signal.SIGINT
            code, err = run(*arguments, IN_RUN)
            assert code == 130
            assert f"interrupted in stage '{stage}'" in err
            assert "the same command resumes there" in err
            assert "Traceback" not in err
            assert not Path("run/metrics.json").exists()
            assert not list(Path("run").rglob("*.partial"))
        assert run(*arguments, IN_RUN)[0] == 0
        repeated = [done[stage] - count for stage, count in whole.items()]
        assert repeated.pop(2) <= 1  # the epoch that the signal fell into
        assert repeated == [1, 7, 0, 18 - 14]  # the first model is kept
        same_errors(errors(), errors("whole"))
        assert not list(Path("run").glob("*_parts"))
        assert not list(Path("run").glob("train_*.safetensors"))


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["solver.max_iterations=1", *TINY], "the newton solver stopped after 1 iterations"),
        ([*main_job.SHORT, "mesh=file", "mesh.path=box.vtu"], "box.vtu: "),
    ],
)
def test_what_fails_costs_one_sentence_and_leaves_nothing_half_made(folder, overrides, said):
    code, err = run(*overrides, IN_RUN)
    (line,) = [
        line
        for line in err.splitlines()
        if not line.startswith(tuple(f"{stage}: " for stage in main_job.STAGES))
    ]
    assert code == 2
    assert line.startswith("error: ")
    assert said in line
    written = (
        {path.name for path in Path("run").rglob("*") if path.is_file()}
        if Path("run").exists()
        else set()
    )
    assert not written & {"metrics.json", "report.html", "resphys.safetensors", "rollouts.h5"}
    assert not [name for name in written if name.endswith(".partial")]
