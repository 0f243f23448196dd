"""The reports of motions with markers, driven by pressure or let go, on made-up runs."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from support import made_up_run
from support.chambered import hollow_box
from support.made_up_run import (
    ARM_MODELS,
    BEAM,
    BEAM_MODELS,
    TRACKED,
    TRIALS,
    arm_settings,
    write_arm_run,
)
from support.refusals import refuses
from support.report_page import report
from warp_resphys import DataFileError, Mesh, box_hexahedra
from warp_resphys.core.mesh.readers import write_mesh
from warp_resphys.experiment import report as stage
from warp_resphys.experiment.report import RunReader, make_folds_report
from warp_resphys.io.resuming import StageContext
from warp_resphys.io.safe_files import read_json, write_json
from warp_resphys.report.body_section import paths_section
from warp_resphys.report.data import best_and_worst
from warp_resphys.report.motion_section import motion_of
from warp_resphys.report.pages import run_page
from warp_resphys.report.wording import NONE, number_text

ARM = arm_settings()
FIGURES_OF_AN_ARM = {"error_over_time", "loss_history", "paths_worst", "paths_best", "inputs"}
FIGURES_OF_AN_ARM |= {"training_resphys", "training_simfree"}


def figures_in(folder):
    return {path.stem for path in (folder / "figures").iterdir()}


class TestArms:
    @pytest.mark.usefixtures("no_drawing")
    def test_page(self, tmp_path):
        write_arm_run(tmp_path, ARM, steps=200)
        page = report(tmp_path, ARM)
        errors = read_json(tmp_path / "errors.json")
        assert all(link.startswith("data:") for link in page.links)
        assert re.search(r"https?://", page.source) is None
        assert page.allows_its_scripts_alone()
        assert all(len(image["alt"]) > 40 for image in page.images)
        for model in ARM_MODELS:
            assert f"{number_text(errors['errors_mm'][model]['mean'])} ± " in page.text
            assert number_text(errors["per_marker"][model]["Arm - 7"]) in page.text
            assert all(
                number_text(row["errors_mm"][model]) in page.text
                for row in errors["per_trajectory"]
            )
        page.says(
            *("7.31 ± 3.54", "No recordings are configured"),
            "The noise of the markers alone is 0.08 mm.",
            "of 0.120 mm from the observed ones, 0.610 mm at most",
            "mean over 3 test trials of 4 s and 12 markers",
            "SimFree2 of 3after 0.84 s (test_00)",
            "dashed, the limit of 20 kPa",
            "Young's modulus [kPa]264237250",
            "1 min 15 s",
            "no OpenGL here",
        )
        page.lacks("Longer than the training", "A line ends", "±  is")
        assert figures_in(tmp_path) == FIGURES_OF_AN_ARM

    @pytest.mark.usefixtures("no_figures")
    def test_longer_rollouts_of_which_one_diverged(self, tmp_path):
        settings = arm_settings(
            "data.folder=recordings", "data.train_fraction=0.5", name="sopra_extrapolation"
        )
        write_arm_run(tmp_path, settings, horizons=(1, 2), diverged=("simfree",), simulated=False)
        page = report(tmp_path, settings)
        page.says(
            "Longer than the training", "First 1 s", "A line ends", "of 494 vertices", "9.89 ± 5.02"
        )
        assert page.text.count("1 of 3 diverged") == 3
        assert "No recordings are configured" not in page.text

    def test_the_film_shows_the_model_that_is_recommended(self, tmp_path):
        write_arm_run(tmp_path, ARM, models=("simulation", "sysid", "resphys"))
        read = RunReader(tmp_path, ARM).report()
        assert read.metrics["recommended"] == "resphys"
        assert [*motion_of(read).positions] == ["simulation", "resphys"]
        errors = read_json(tmp_path / "errors.json")
        for row in errors["per_trajectory"]:
            row["errors_mm"]["sysid"] = 0.5 * row["errors_mm"]["resphys"]
        write_json(tmp_path / "errors.json", errors)
        better = RunReader(tmp_path, ARM).report()
        assert better.metrics["recommended"] == "sysid"
        assert [*motion_of(better).positions] == ["simulation", "sysid"]
        without = RunReader(tmp_path, ARM.changed(reconstruction=None)).report()
        assert "resphys" not in {
            **without.trials.positions,
            **without.film.positions,
            **without.metrics["errors_mm"],
        }

    @pytest.mark.usefixtures("no_figures")
    def test_higher_pressures(self, tmp_path):
        settings = arm_settings("data.input_scales=[1.25,1.75]", name="sopra_overpressure")
        write_arm_run(tmp_path, settings, test=2, scales=(1.25, 1.75))
        text = report(tmp_path, settings).text
        scales = read_json(tmp_path / "errors.json")["scales"]
        assert all(
            number_text(scales[f][m]["mean"]) in text
            for f in ("1", "1.25", "1.75")
            for m in ARM_MODELS
        )
        assert "none of 22 of 2after 0.40 s" in text
        read = RunReader(tmp_path, settings)
        trials, pressures = read.trials, read.driven
        assert trials.names == ("test_00", "test_01")
        assert len(pressures.scaled) == 4
        assert set(pressures.scaled) < pressures.values.keys()
        assert trials.errors_mm["resphys"][:, 1:].mean() == pytest.approx(
            scales["1"]["resphys"]["mean"], rel=1e-5
        )

    @pytest.mark.usefixtures("no_figures")
    def test_one_chamber_one_trial_and_two_models(self, tmp_path):
        box = hollow_box("hexahedron")
        turned = box.vertices[:, [2, 1, 0]] * [1.0, 1.0, -1.0] - [0.01, 0.015, 0.0]
        write_mesh(tmp_path / "box.vtk", Mesh(turned, box.cells))
        settings = arm_settings(
            "mesh=file",
            f"mesh.path={tmp_path / 'box.vtk'}",
            "mesh.drop_unreferenced=true",
            "chambers.count=2",
            "markers.tracked=null",
            "+markers.tracked={Tip:[0.0,0.01,-0.06]}",
            "data.folder=recordings",
            *("data.input_limit=null", "tip={z:-0.06}"),
            name="segment_real",
        )
        alone = {"models": ("simulation", "resphys"), "diverged": ("resphys",), "simulated": False}
        write_arm_run(tmp_path, settings, train=0, test=1, chambers=1, **alone)
        page = report(tmp_path, settings)
        page.says(
            *("ResPhys diverged in 1 of 1 trials; ", "1 test trial of 2 s and 1 marker"),
            *("Pressures of the trial.", "ResPhysnone of 1", "data.input_limitnull"),
        )
        page.lacks(
            "SysID", "Published", "The published", "Identification", "dashed", "median filter"
        )
        without = {"loss_history", "training_simfree", "paths_best"}
        assert figures_in(tmp_path) == FIGURES_OF_AN_ARM - without

    @pytest.mark.parametrize(
        "name", ["dataset.h5", "rollouts.h5", "errors.json", "registration.json"]
    )
    def test_a_missing_file_is_one_sentence(self, tmp_path, name):
        write_arm_run(tmp_path, ARM, test=1, steps=40, models=("resphys",))
        (tmp_path / name).unlink()
        refuses(DataFileError, name, report, tmp_path, ARM)
        assert not (tmp_path / "report.html").exists()

    def test_files_that_do_not_belong_together_are_refused(self, tmp_path):
        write_arm_run(tmp_path, ARM, test=2, steps=40, models=("resphys",))
        other = tmp_path / "other"
        write_arm_run(other, ARM, test=3, steps=40, models=("resphys",))
        (other / "rollouts.h5").replace(tmp_path / "rollouts.h5")
        with pytest.raises(
            DataFileError, match=r"rollouts.h5 names trials that .* does not hold \(test_02\)"
        ):
            _ = RunReader(tmp_path, ARM).trials
        write_arm_run(tmp_path, ARM, test=2, steps=40, models=("resphys",), chambers=7)
        refuses(
            DataFileError,
            "pressures of chamber_7, but the body's chambers are chamber_1, ",
            report,
            tmp_path,
            ARM,
        )

    def test_what_is_read(self, tmp_path):
        write_arm_run(tmp_path, ARM, diverged=("simfree",))
        read = RunReader(tmp_path, ARM)
        trials, film, pressures = read.trials, read.film, read.driven
        assert pressures.scaled == ()
        assert trials.times[0, [0, -1]].tolist() == [0.0, pytest.approx(2.0)]
        assert np.isnan(trials.target[0, 30:36, 1]).all()
        assert np.isinf(trials.errors_mm["simfree"][0, 60:]).all()
        expected = read_json(tmp_path / "errors.json")["errors_mm"]
        for model in ("sysid", "resphys"):
            assert trials.errors_mm[model][:, 1:].mean() == pytest.approx(
                expected[model]["mean"], rel=1e-5
            )
        assert film.positions["resphys"].shape[0] == len(film.times) == 51
        assert list(pressures.values) == ["train_00", "train_01", "test_00", "test_01", "test_02"]
        assert pressures.values["test_00"].shape == (100, 6)

    def test_markers_are_drawn_over_time(self, tmp_path):
        write_arm_run(tmp_path, ARM, steps=40)
        trials = RunReader(tmp_path, ARM).trials
        canvas = SimpleNamespace(figure=lambda name, *_: name)

        def drawn(shown, driven):
            data = {"tip": [], "metrics": {}, "trials": shown, "driven": driven}
            part = paths_section(SimpleNamespace(**data), canvas)
            return None if part is None else part.blocks

        for driven in (RunReader(tmp_path, ARM).driven, None):
            assert drawn(trials, driven) == ["paths_worst", "paths_best"]
        assert drawn(replace(trials, labels=()), None) is None  # and no tip

    def test_recordings_are_shown_on_the_body_as_it_hangs(self, tmp_path, monkeypatch):
        shown = []
        write_arm_run(tmp_path, ARM, test=1, steps=40, models=("simulation",), sag=0.004)
        monkeypatch.setattr(run_page, "write_report", lambda _, data: shown.append(data))
        stage.make_report(StageContext("report", tmp_path, "", ARM))
        (page_data,) = shown
        sagged = (
            page_data.mesh.vertices[:, 2].min() - page_data.recordings.mesh.vertices[:, 2].min()
        )
        assert sagged == pytest.approx(0.004, abs=1e-6)
        nominal = {label: place[2] for label, place in page_data.recordings.nominal.items()}
        assert nominal["Base - 1"] == ARM.markers.reference["Base - 1"][2]
        for label, moved in (("Arm - 9", -0.004), ("Arm - 1", -0.0008)):
            assert nominal[label] - ARM.markers.tracked[label][2] == pytest.approx(moved, abs=3e-4)


class TestBeams:
    @pytest.mark.usefixtures("no_drawing")
    def test_page_of_a_split(self, tmp_path):
        made_up_run.write_beam_run(tmp_path, "bare", "load52")
        page = report(tmp_path, BEAM)
        errors = read_json(tmp_path / "errors.json")
        assert page.allows_its_scripts_alone()
        for model in BEAM_MODELS:
            assert number_text(errors["errors_mm"][model]["mean"]) in page.text
            assert number_text(errors["per_marker"][model]["Tip - 2"]) in page.text
            assert all(
                number_text(row["errors_mm"][model]) in page.text
                for row in errors["per_trajectory"]
            )
        assert "No recordings are configured" not in page.text
        page.says(
            "Trials: two trials are no evidence; test on five or more.",
            "5.46 ± 1.78",
            "251.3 ± 2.5",
            "stable neo hookean",
            "left out",
            "1 min 35 s",
            "no OpenGL here",
            "Young's modulus and Poisson's ratio (correlation \N{MINUS SIGN}0.96)",
            "bare: Base - 1 jumps once, by 0.31 mm, in frame 80.",
            "Trial load52, in which the last model of the table has its largest error",
            "The band should contain 90 % of the measured coordinates, and contains 87 % of "
            "them; it is ± 3.00 mm",
        )
        learned = {f"training_{model}" for model in ("simfree", "resphys_uncorrected", "resphys")}
        others = {"error_over_time", "loss_history", "paths_worst", "paths_best"}
        assert figures_in(tmp_path) == learned | others

    @pytest.mark.usefixtures("no_figures")
    def test_what_is_not_there_is_left_out_and_what_diverged_is_said(self, tmp_path):
        made_up_run.write_beam_run(
            tmp_path, "bare", "load52", models=("simulation", "resphys"), diverged=("resphys",)
        )
        for name in ("identification.json", "training_resphys.json", "truth.json"):
            (tmp_path / name).unlink()
        page = report(tmp_path, BEAM.changed(name="my_robot", data=BEAM.data.changed(folder=None)))
        assert page.text.count("1 of 2 diverged") == 2
        page.says("ResPhys diverged in 1 of 2 trials", "No recordings are configured")
        page.says("A line ends where the first roll-out has diverged.")
        page.lacks(
            "SysID",
            "SimFree",
            "Published",
            "Identification",
            "Training",
            "Against the reconstruction",
        )
        assert figures_in(tmp_path) == {"error_over_time", "paths_worst", "paths_best"}

    @pytest.mark.usefixtures("no_figures")
    def test_a_learned_force_that_is_not_used_wins_nothing(self, tmp_path):
        made_up_run.write_beam_run(
            tmp_path, "bare", "load52", models=("simulation", "sysid_elastic", "sysid", "resphys")
        )
        errors = read_json(tmp_path / "errors.json")
        for row in (
            errors["errors_mm"],
            *(trial["errors_mm"] for trial in errors["per_trajectory"]),
        ):
            row["resphys"] = row["sysid"]
        write_json(tmp_path / "errors.json", errors)
        history = read_json(tmp_path / "training_resphys.json")
        test = {**history["kept"]["test"], "error_mm": None, "below_mm": 0.5, "used": False}
        write_json(
            tmp_path / "training_resphys.json",
            {**history, "kept": {**history["kept"], "test": test}},
        )
        identified = read_json(tmp_path / "identification.json")
        identified["sysid"]["parameters"]["youngs_modulus"] = 2e6
        write_json(tmp_path / "identification.json", identified)
        ranges = {"parameters": {"youngs_modulus": {"lower": 5e4, "upper": 2e6}}}
        page = report(tmp_path, BEAM.changed(identify=ranges))
        head = page.text[: page.text.index("One test trial")]
        mean = number_text(errors["errors_mm"]["sysid"]["mean"])
        for said in (
            "No evidence either way: 2 trials (SysID",
            "At a bound: Poisson's ratio",
            "Trials: two trials are no evidence",
            "Not used: ResPhys, as on the validation trials (bare) it diverges, and the "
            "simulator without it has 0.5",
            f"+ identified parameters (SysID){mean}best",
        ):
            assert said in head
        assert "not used: on the validation trials (bare) it diverges" in page.text
        marked = re.findall(r'class="marked"><th scope="row">([^<]+)<', page.source)
        assert marked == ["+ identified parameters (SysID)"]

    @pytest.mark.usefixtures("no_figures")
    def test_page_over_folds_leads_to_theirs(self, tmp_path):
        made_up_run.write_folds(tmp_path, models=("simulation", "sysid", "resphys"))
        metrics = read_json(tmp_path / "metrics.json")
        folds = metrics["folds"]
        folds["bare"]["errors_mm"]["resphys"]["mean"] = None
        folds["bare"]["per_trajectory"][0]["errors_mm"]["resphys"] = None
        del folds["load52"]["errors_mm"]["sysid"]
        del folds["load52"]["per_trajectory"][0]["errors_mm"]["sysid"]
        write_json(tmp_path / "metrics.json", metrics)
        page = report(tmp_path, BEAM, make_folds_report)
        links = [link for link in page.links if not link.startswith("data:")]
        assert links == [f"fold_{trial}/report.html" for trial in TRIALS]
        said = page.text
        for trial, end in (("bare", ""), ("load52", NONE)):
            size, mean = (
                folds[trial]["per_trajectory"][0][key] for key in ("amplitude_mm", "errors_mm")
            )
            assert f"{trial}amplitude {size:.3g} mm{number_text(mean['simulation'])}{end}" in said
        assert "diverged" in said[said.index("Test trial [mm]") : said.index("load52")]
        assert all(words in said for words in ("jumps once", "Root mean square"))

    def test_trials_are_read_as_long_as_they_count(self, tmp_path):
        made_up_run.write_folds(tmp_path, models=("simulation", "resphys"))
        trials = RunReader(tmp_path / "fold_load101", BEAM).trials
        assert trials.names == ("load101",)
        assert trials.positions["resphys"].shape == trials.target.shape
        assert trials.times[0, -1] <= made_up_run.SECONDS < trials.times[0, -1] + made_up_run.STEP
        assert np.isfinite(trials.target).all()
        whole = RunReader(
            tmp_path / "fold_load101", BEAM.changed(data=BEAM.data.changed(seconds=None))
        ).trials
        assert whole.target.shape[1] == made_up_run.FRAMES
        assert np.isnan(whole.target[0, -3:]).all()
        expected = read_json(tmp_path / "fold_load101" / "errors.json")["errors_mm"]
        # The markers have noise, the errors of the file have none.
        for model, rows in trials.errors_mm.items():
            assert rows.mean() == pytest.approx(expected[model]["mean"], abs=0.1)
        hidden = RunReader(tmp_path / "fold_bare", BEAM).trials
        assert np.isnan(hidden.target[0, 9:16, 1]).all()
        assert np.isfinite(hidden.errors_mm["resphys"]).all()

    def test_the_trial_that_fits_worst_is_drawn(self, tmp_path):
        made_up_run.write_recordings(tmp_path)
        recordings = RunReader(tmp_path, BEAM).recordings(box_hexahedra(divisions=(3, 1, 1)), {})
        assert recordings.worst == "load101"
        fit = recordings.registered["load101"]
        assert fit["outliers"] == ["Base - 3"]
        assert [*fit["positions"]] == [*TRACKED, "Base - 1", "Base - 2", "Base - 3"]
        assert recordings.nominal["Tip - 1"].tolist() == TRACKED["Tip - 1"]

    def test_trials_in_order_of_their_errors(self, tmp_path):
        made_up_run.write_beam_run(tmp_path, *TRIALS, models=("simulation", "resphys"))
        trials = RunReader(tmp_path, BEAM).trials
        assert [trials.names[row] for row in best_and_worst(trials)] == ["load101", "bare"]
        made_up_run.write_split(
            tmp_path, list(TRIALS), models=("simulation", "resphys"), diverged=("resphys",)
        )
        assert best_and_worst(RunReader(tmp_path, BEAM).trials)[0] == 0
