"""Experiments on recordings through the command line,
synthetic or of a folder, to the errors of all models.
"""

import shutil

import meshio
import numpy as np
import pytest

import warp_resphys
from support.configured import settings
from support.main_job import run_without_report
from support.refusals import refuses
from warp_resphys import DataFileError
from warp_resphys.core.mesh.boxes import box_tetrahedra
from warp_resphys.experiment.experiment import ACTUATOR, LAW
from warp_resphys.experiment.experiment import MODELS as ALL_MODELS
from warp_resphys.experiment.mesh_check import check_mesh
from warp_resphys.experiment.splits import split_of
from warp_resphys.io.resuming import StageContext, StageInterrupted, run_stages
from warp_resphys.io.safe_files import read_checkpoint, read_hdf5, read_json
from warp_resphys.io.settings import parse
from warp_resphys.learning.identification import search
from warp_resphys.learning.residuals.networks import NextState, ResidualForce, restore
from warp_resphys.pipeline import learning_stages
from warp_resphys.report.error_section import mesh_text
from warp_resphys.report.wording import NO_BREAK_SPACE
from warp_resphys.settings.stage_keys import StageSettings

PLAIN = ("rest", "interpolation", "linear")  # two training trials are too few for a regression
MODELS = [model for model in ALL_MODELS if model not in (LAW, ACTUATOR, "resphys_uncorrected")]
TRAINED = ("resphys", "simfree")

TINY = [
    "experiment=beam_real",
    "mesh.divisions=[4,1,1]",
    "data.seconds=0.08",
    "~identify.parameters.mass_damping",
    "~identify.first_guess.mass_damping",
    "identify.starts=1",
    "identify.max_evaluations=4",
    "in_the_loop.epochs=2",
    "correct_uncorrected=false",
    "simfree.trainer.epochs=4",
    "simfree.trainer.rollout_every=4",
    "parallel.processes=1",  # in this process, where no report is drawn and no torch imported again
]
SYNTHETIC = [
    *TINY,
    "laboratory.mesh.divisions=[6,2,2]",
    "laboratory.time_step=0.005",
    "laboratory.seconds=0.11",
    "laboratory.train=[m0,m80]",
    "laboratory.validation=[m20]",
    "laboratory.test=[m50]",
]
FOLDS = [
    *TINY,
    "data.folder=recordings",
    "data.trials.bare.file=m0.h5",
    "data.trials.load52={file: m50.h5, payload: 0.05}",
    "~data.trials.load101",
    "identify.max_evaluations=3",
    "identify.elastic=null",
    "in_the_loop.epochs=1",
]
STAGES = [
    "identify",
    "reconstruct_resphys",
    "train_resphys",
    "train_simfree",
    "evaluate",
    "mesh_check",
    "report",
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return run_without_report(tmp_path_factory.mktemp("measured"), *SYNTHETIC)


class TestCompleteRun:
    def test_files_are_complete_and_films_have_whole_steps(self, finished):
        names = {path.name for path in finished.iterdir()}
        trained = {
            name for model in TRAINED for name in (f"{model}.safetensors", f"training_{model}.json")
        }
        assert names >= {
            "truth.json",
            "quality.json",
            "registration.json",
            "reconstruction_resphys.h5",
            *trained,
        }
        assert {path.stem for path in (finished / "recordings").iterdir()} == {
            "m0",
            "m20",
            "m50",
            "m80",
        }
        assert {path.stem for path in (finished / "stages").iterdir()} == {
            "laboratory",
            "import",
            *STAGES,
        }
        for model, kind, name in (
            ("simfree", NextState, "next state"),
            ("resphys", ResidualForce, "residual force"),
        ):
            restored = restore(kind, *read_checkpoint(finished / f"{model}.safetensors", name))
            # in_the_loop.sees_payload is false
            assert (restored.actuation is None) == (model != "simfree")
        with read_hdf5(finished / "rollouts.h5", "rollouts") as file:
            assert list(file.attrs["names"]) == ["m50"]
            films = {file[f"{model}_film"].shape for model in MODELS}
            assert (str(file.attrs["film_trial"]), file.attrs["time_step"]) == ("m50", 0.01)
            np.testing.assert_array_equal(file["film_steps"], np.arange(len(file["film_steps"])))
            fall = file["sysid_film"][2, -1, 2] - file["sysid_film"][0, -1, 2]
        # Freely at first; by half steps.
        assert fall == pytest.approx(-0.5 * 9.80709 * 0.02**2, rel=0.15)
        # The whole steps of 0.01 s up to the last frame, which comes before 0.08 s.
        assert films == {(8, 20, 3)}

    def test_identification(self, finished):
        results = read_json(finished / "identification.json")
        assert list(results["sysid"]["parameters"]) == ["youngs_modulus", "stiffness_damping"]
        assert list(results["sysid_elastic"]["parameters"]) == ["youngs_modulus", "poissons_ratio"]
        for found in (results["sysid"], results["sysid_elastic"]):
            losses = [record["loss"] for record in found["history"][0]]
            assert found["loss"] in losses[1:]
            assert found["loss"] < losses[0]
            assert len(losses) <= 4 * 4  # The release was estimated again, up to three times.
        assert np.shape(results["sysid"]["uncertainty"]["correlation"]) == (2, 2)

    def test_errors(self, finished):
        results = read_json(finished / "metrics.json")
        errors = {model: summary["mean"] for model, summary in results["errors_mm"].items()}
        assert list(errors) == [*PLAIN, *MODELS]
        assert all(0.01 < error < 50.0 for error in errors.values()), errors
        assert errors["sysid"] < 0.5 * errors["simulation"] < 0.5 * errors["published"]
        assert [trial["name"] for trial in results["per_trajectory"]] == ["m50"]
        assert results["parameters"].keys() == {"sysid", "sysid_elastic"}
        assert 0.0 < results["sideways_mm"]["m50"] < 0.5  # The simulated beam is held straight.
        # Maxwell's distribution
        assert results["noise_mm"] == pytest.approx(0.05 * np.sqrt(8.0 / np.pi), rel=0.05)
        for model, markers in results["per_marker"].items():
            assert np.mean(list(markers.values())) == pytest.approx(errors[model])

    def test_training_begins_without_a_force_and_the_reconstruction_says_how_close_it_came(
        self, finished
    ):
        training = read_json(finished / "training_resphys.json")
        first, *others = training["epochs"]
        assert [record["epoch"] for record in training["epochs"]] == [0, 1, 2]
        losses = [record["train_loss"] for record in others]
        assert losses == sorted(losses, reverse=True)
        assert losses[-1] < first["train_loss"]
        assert training["kept"]["validation_rollout_error_mm"] <= first["rollout_error_mm"]
        sysid = read_json(finished / "identification.json")["sysid"]["loss"]
        assert first["train_loss"] == pytest.approx(sysid, rel=1e-3)
        results = read_json(finished / "reconstruction.json")
        assert results == read_json(finished / "metrics.json")["reconstruction"]
        assert set(results) == {"resphys"}
        own = results["resphys"]
        assert own["mean_mm"] < 0.5
        assert own["mean_mm"] < own["max_mm"]
        with read_hdf5(finished / "reconstruction_resphys.h5", "reconstruction") as file:
            assert list(file.attrs["names"]) == ["m0", "m80", "m20"]
            assert np.nanmean(file["error"][()]) == pytest.approx(own["mean_mm"], rel=1e-5)
            assert np.isfinite(file["force"][()]).all()
            assert not file["force"][:, 0].any()


def test_the_error_of_a_mesh_that_cannot_be_refined_is_not_known(finished, tmp_path):
    shutil.copy(finished / "dataset.h5", tmp_path)
    mesh = box_tetrahedra((0.1, 0.03, 0.03), (2, 1, 1), order=2)
    meshio.Mesh(mesh.vertices, [("tetra10", mesh.cells)]).write(tmp_path / "beam.vtk")
    given = read_json(finished / "stages" / "mesh_check.json")["settings"]
    given["mesh"] = {"kind": "file", "path": str(tmp_path / "beam.vtk")}
    check_mesh(StageContext("mesh_check", tmp_path, "", parse(StageSettings, given)))
    text = mesh_text(read_json(tmp_path / "mesh_check.json"))
    assert text.startswith(
        "The error of the mesh is not known: its cells are given, and quadratic already"
    )
    linear = {"model": "sysid", "cells": [24, 24], "vertices": [63, 325], "trials": ["m50"]}
    text = mesh_text(linear | {"errors_mm": [0.6, 1.16], "moved_mm": 1.161}).replace(
        NO_BREAK_SPACE, " "
    )
    assert text.startswith(
        "With quadratic cells (325 instead of 63 vertices) and the same parameters, SysID moves"
    )
    assert "by 1.16 mm, and its error is 1.16 mm instead of 0.600 mm" in text


@pytest.mark.slow
def test_folds_each_of_which_is_a_robot(finished, tmp_path):
    shutil.copytree(finished / "recordings", tmp_path / "recordings")
    run = run_without_report(tmp_path, *FOLDS)
    results = read_json(run / "metrics.json")
    assert list(results["folds"]) == ["bare", "load52"]
    for model, summary in results["errors_mm"].items():
        means = [fold["errors_mm"][model]["mean"] for fold in results["folds"].values()]
        assert summary["mean"] == pytest.approx(np.mean(means))
        assert (summary["trajectories"], summary["diverged"]) == (2, 0)
    for trial, fold in results["folds"].items():
        folder = run / f"fold_{trial}"
        assert [row["name"] for row in fold["per_trajectory"]] == [trial]
        assert read_json(folder / "metrics.json") == fold
        split = read_json(folder / "stages" / "train_resphys.json")["settings"]["split"]
        assert trial not in split["train"] + split["validation"]
    places = (".", *(f"fold_{name}" for name in results["folds"]))
    assert all((run / place / "report.html").is_file() for place in places)
    assert warp_resphys.load(run / "fold_bare").description.name == "run/fold_bare"
    refuses(DataFileError, "is a cross-validation.*fold_bare.*fold_load52", warp_resphys.load, run)
    shown = read_json(run / "stages" / "report.json")["settings"]
    assert shown["folds"] == {trial: fold["errors_mm"] for trial, fold in results["folds"].items()}


def test_an_interrupted_identification_goes_on_with_the_next_search(
    finished, tmp_path, monkeypatch
):
    """The searches are replaced: they return their starts."""
    shutil.copy(finished / "dataset.h5", tmp_path)
    wanted = settings(*SYNTHETIC, "identify.starts=2")
    (stage, *_) = learning_stages(wanted, split_of(wanted), ".", "imported")
    descents, at = [], 4

    def descend(misfit, number, start, max_evaluations, tolerance, report):
        descents.append((misfit.simulator.integrator, number))
        if len(descents) == at:
            raise KeyboardInterrupt
        return search._Attempt(misfit.to_unit(start), number + 1.0, [{"loss": 1.0, **start}], 0.0)

    monkeypatch.setattr(search, "_descend", descend)
    with pytest.raises(StageInterrupted, match="interrupted in stage 'identify'"):
        run_stages([stage], tmp_path)
    assert not (tmp_path / "identification.json").exists()
    run_stages([stage], tmp_path)
    # The release again.
    own = [(name, number) for name in ("midpoint", "implicit_euler") for number in (0, 1, 0)]
    assert descents == [*own[:4], *own[3:]]  # The first two searches are kept.
    history = read_json(tmp_path / "identification.json")["sysid"]["history"]
    # The search after the release was estimated again continues the best.
    assert list(map(len, history)) == [2, 1]
    assert not list(tmp_path.glob("identify_*"))
