"""The report of measured motions, on a made-up run."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from measured_run import (
    FRAMES,
    MODELS,
    SECONDS,
    STEP,
    TRACKED,
    TRIALS,
    config,
    sag,
    write_folds,
    write_recordings,
    write_split,
)
from report_page import FAILING, Page

from warp_resphys.experiment.report import make_folds_report, make_report, read_recordings, read_trials
from warp_resphys.io.errors import DataFileError
from warp_resphys.io.files import read_json, write_json
from warp_resphys.io.stages import StageContext
from warp_resphys.learning.metrics import PUBLISHED_MM
from warp_resphys.mesh.mesh import box_hexahedra
from warp_resphys.report import figures, motion_figures, render
from warp_resphys.report.bodies import ComparedMotion, instants
from warp_resphys.report.camera import motion_axes
from warp_resphys.report.data import at_times, best_and_worst, mean_distance, shown_models
from warp_resphys.report.figures import TONES
from warp_resphys.report.page import Cell
from warp_resphys.report.run_page import published_beside
from warp_resphys.report.sections import against, parameter_rows, quality_rows, residual_table, uncertainty_text
from warp_resphys.report.verdict import marker_verdict

SETTINGS = config()
DOWN = np.array([0.0, 0.0, -9.8])


@pytest.fixture
def no_drawing(monkeypatch):
    """Nothing is drawn in other processes, which takes seconds."""
    monkeypatch.setattr(render, "COMMAND", FAILING)


def report(folder, settings=SETTINGS):
    make_report(StageContext("report", folder, "", {"config": settings}))
    return Page(folder / "report.html")


@pytest.mark.usefixtures("no_drawing")
def test_page_of_a_split(tmp_path):
    write_recordings(tmp_path)
    write_split(tmp_path, ["bare", "load52"])
    page = report(tmp_path)
    errors = read_json(tmp_path / "errors.json")
    assert all(link.startswith("data:") for link in page.links)
    assert re.search(r"https?://", page.source) is None
    assert len(page.scripts) == 1
    assert page.allows_its_scripts_alone()
    assert all(len(image["alt"]) > 40 for image in page.images)
    for model in MODELS:
        assert f"{errors['errors_mm'][model]['mean']:.3f}" in page.text
        assert f"{errors['per_marker'][model]['Tip - 2']:.3f}" in page.text
        assert all(f"{row['errors_mm'][model]:.3f}" in page.text for row in errors["per_trajectory"])
    assert "No recordings are configured" not in page.text
    for said in (
        "On 2 trials, which no training or identification saw, the simulated markers are",
        "5.46 ± 1.78",
        "The published errors are those of other data",
        "251.3 ± 2.5",
        "whose material is stable neo hookean",
        "they cannot tell apart Young's modulus and Poisson's ratio (\N{MINUS SIGN}0.96)",
        "left out",
        "bare: Base - 1 jumps once, by 0.31 mm, in frame 80.",
        "Trial load52, in which the last model of the table is farthest off: coordinates",
        "1 min 35 s",
        "no OpenGL here",
        "90 % should lie within ± 3 mm, on average, of where ResPhys has them",
        "by its errors in the validation trials: 87 % do.",
        "The band around it is to hold nine of ten measured coordinates.",
    ):
        assert said in page.text
    learned = {f"training_{model}" for model in ("simfree", "resphys_uncorrected", "resphys")}
    paths = {"paths_worst", "paths_best"}
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == {
        "error_over_time",
        "landscape",
        "loss_history",
        *learned,
        *paths,
    }


@pytest.mark.usefixtures("no_drawing")
def test_what_is_not_there_is_left_out_and_what_diverged_is_said(tmp_path):
    write_recordings(tmp_path)
    write_split(tmp_path, ["bare", "load52"], models=("simulation", "resphys"), diverged=("resphys",))
    for name in ("identification.json", "training_resphys.json", "truth.json"):
        (tmp_path / name).unlink()
    page = report(tmp_path, {**SETTINGS, "name": "my_robot", "data": {**SETTINGS["data"], "folder": None}})
    assert "ResPhys diverged in 1 of 2 roll-outs, so that there is no mean error to report." in page.text
    assert page.text.count("1 of 2 diverged") == 1
    assert "No recordings are configured" in page.text
    assert "A line ends where the first roll-out has diverged." in page.text
    for absent in ("SysID", "SimFree", "Published", "Identification", "Training", "Against"):
        assert absent not in page.text.replace("no training or identification", "")
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == {"error_over_time", "paths_worst", "paths_best"}


@pytest.mark.usefixtures("no_drawing")
def test_a_learned_force_without_an_epoch_wins_nothing(tmp_path):
    write_recordings(tmp_path)
    write_split(tmp_path, ["bare", "load52"], models=("simulation", "sysid_elastic", "sysid", "resphys"))
    errors = read_json(tmp_path / "errors.json")
    for row in (errors["errors_mm"], *(each["errors_mm"] for each in errors["per_trajectory"])):
        row["resphys"] = row["sysid"]
    write_json(tmp_path / "errors.json", errors)
    history = read_json(tmp_path / "training_resphys.json")
    write_json(tmp_path / "training_resphys.json", {**history, "kept": {**history["kept"], "epoch": 0}})
    found = read_json(tmp_path / "identification.json")
    found["sysid"]["parameters"]["youngs_modulus"] = 2e6
    write_json(tmp_path / "identification.json", found)
    page = report(tmp_path, SETTINGS | {"identify": {"parameters": {"youngs_modulus": {"lower": 5e4, "upper": 2e6}}}})
    head = page.text[: page.text.index("Error of the markers")].replace("\u00a0", " ")
    mean = f"{errors['errors_mm']['sysid']['mean']:.3f}"
    assert re.search(f"{mean} mm from the measured ones over the first [0-9.]+ s with SysID;", head)
    assert "The learned force (ResPhys) adds nothing to SysID: none of its training served held-out trials" in head
    assert "Identification (SysID) leaves" in head
    assert "youngs_modulus was identified at its upper bound, 2e+06: widen identify.parameters" in head
    assert "no force: none of its training was kept" in page.text
    winners = re.findall(r'class="answer"><th scope="row">([^<]+)<', page.source)
    assert winners == ["SysID"]


@pytest.mark.usefixtures("no_drawing")
def test_page_over_folds_leads_to_theirs(tmp_path):
    write_folds(tmp_path, models=("simulation", "sysid", "resphys"))
    metrics = read_json(tmp_path / "metrics.json")
    metrics["folds"]["bare"]["errors_mm"]["resphys"]["mean"] = None
    del metrics["folds"]["load52"]["errors_mm"]["sysid"]
    write_json(tmp_path / "metrics.json", metrics)
    make_folds_report(StageContext("report", tmp_path, "", {"config": SETTINGS}))
    page = Page(tmp_path / "report.html")
    assert [link for link in page.links if not link.startswith("data:")] == [
        f"fold_{trial}/report.html" for trial in TRIALS
    ]
    said = page.text
    assert "On 3 trials, each of them kept back once" in said
    folds = metrics["folds"]
    assert f"bare{folds['bare']['errors_mm']['simulation']['mean']:.3f}" in said
    assert "diverged" in said[said.index("Test trial [mm]") : said.index("load52")]
    assert f"load52{folds['load52']['errors_mm']['simulation']['mean']:.3f}\N{EN DASH}" in said
    assert f"Mean{metrics['errors_mm']['simulation']['mean']:.3f}" in said
    assert "jumps once" in said
    assert "Root mean square" in said


def test_trials_are_read_as_long_as_they_count(tmp_path):
    write_folds(tmp_path, models=("simulation", "resphys"))
    trials = read_trials(tmp_path / "fold_load101", SETTINGS)
    assert trials.names == ("load101",)
    assert trials.positions["resphys"].shape == trials.target.shape
    assert trials.times[0, -1] <= SECONDS < trials.times[0, -1] + STEP
    assert np.isfinite(trials.target).all()
    whole = read_trials(tmp_path / "fold_load101", {**SETTINGS, "data": {**SETTINGS["data"], "seconds": None}})
    assert whole.target.shape[1] == FRAMES
    assert np.isnan(whole.target[0, -3:]).all()
    expected = read_json(tmp_path / "fold_load101" / "errors.json")["errors_mm"]
    for model, rows in trials.errors_mm.items():  # The markers have noise, the errors of the file have none.
        assert rows.mean() == pytest.approx(expected[model]["mean"], abs=0.1)
    hidden = read_trials(tmp_path / "fold_bare", SETTINGS)
    assert np.isnan(hidden.target[0, 9:16, 1]).all()
    assert np.isfinite(hidden.errors_mm["resphys"]).all()


def test_rollouts_of_other_trials_are_refused(tmp_path):
    write_recordings(tmp_path, {"bare": 0.0})
    write_split(tmp_path, ["load52"])
    with pytest.raises(DataFileError, match=r"rollouts.h5 names trials that .* does not hold \(load52\)"):
        read_trials(tmp_path, SETTINGS)


def test_the_trial_that_fits_worst_is_drawn(tmp_path):
    write_recordings(tmp_path)
    found = read_recordings(tmp_path, SETTINGS, box_hexahedra(divisions=(3, 1, 1)), {})
    assert found.drawn == "load101"
    assert found.outliers == ("Base - 3",)
    assert found.labels == (*TRACKED, "Base - 1", "Base - 2", "Base - 3")
    assert found.nominal[0].tolist() == TRACKED["Tip - 1"]
    np.testing.assert_allclose(found.feet[0], [0.1, 0.0153, 0.03], atol=1e-12)


def test_errors_count_what_was_seen():
    measured = np.zeros((1, 4, 2, 3))
    measured[0, 1, 0] = np.nan
    measured[0, 2] = np.nan
    markers = np.zeros((1, 4, 2, 3))
    markers[0, :, 0, 0], markers[0, :, 1, 2] = 0.001, 0.003
    markers[0, 2:, 0] = np.nan
    np.testing.assert_allclose(mean_distance(markers, measured)[0], [2.0, 3.0, np.nan, np.inf])


def test_bodies_are_brought_to_the_frames():
    positions = np.arange(4.0)[:, None, None] * np.ones((1, 2, 3))
    known = np.array([0.0, 0.1, 0.2, 0.3])
    found = at_times(positions, known, np.array([0.0, 0.05, 0.11, 0.3, 0.5]))
    np.testing.assert_allclose(found[:, 0, 0], [0.0, 0.5, 1.1, 3.0, 3.0])
    positions[2:] = np.nan
    np.testing.assert_array_equal(at_times(positions, known, np.array([0.1, 0.11]))[:, 0, 0], [1.0, np.nan])


def test_instants_lie_apart():
    measured, rest = np.zeros((100, 1, 3)), np.zeros((1, 3))
    measured[40, 0, 2] = -1.0
    simulated = measured.copy()
    simulated[97, 0, 0] = 1.0
    assert instants(measured, rest, simulated) == [25, 40, 97]  # The last is too close to where the model is worst.
    simulated[70, 0, 0] = 2.0
    assert instants(measured, rest, simulated) == [40, 70, 99]
    measured[70] = np.nan
    assert instants(measured, rest, simulated) == [25, 40, 97]
    assert instants(measured[:1], rest, simulated[:1]) == [0]


def test_words():
    def summary(mean):
        return {"mean": mean, "std": 0.1, "trajectories": 3, "diverged": int(mean is None)}

    means = {"simulation": 0.9, "sysid_elastic": 0.8, "sysid": None, "resphys": 0.2}
    errors = {model: summary(mean) for model, mean in means.items()}
    assert marker_verdict(errors, ["a"], 1.4, folds=True) == marker_verdict(errors, ["a"], 1.4)
    said = marker_verdict(errors, ["a"], 1.4)
    assert "On trial a, " in said
    assert "0.200 mm from the measured ones over the first 1.4 s with ResPhys; diverged with SysID, " in said
    assert said.endswith("0.900 mm uncorrected.")
    base, share = against(errors)
    assert base == "sysid_elastic"
    assert share["resphys"] == "\N{MINUS SIGN}75 %"
    assert "sysid" not in share
    published = PUBLISHED_MM["beam_real"]
    assert published_beside(published, ["published", "simulation", "sysid", "resphys"]).keys() == {
        "published",
        "sysid",
        "simfree",
        "resphys",
    }
    assert published_beside(published, ["simulation", "sysid_elastic", "sysid"])["sysid_elastic"] == ("1.32", "± 1.38")
    assert shown_models({"resphys": 0, "simulation": 0, "sysid": 0}) == ["simulation", "resphys"]
    assert shown_models({"sysid": 0, "published": 0}) == ["published", "sysid"]


def test_branches_that_were_identified_have_names_and_units():
    found = {"parameters": {"prony_ratio_1": 0.25, "prony_time_2": 0.3125}, "at_bounds": []}
    ratio, time = parameter_rows(found, {"prony_time_2": 1.0}, {})
    assert (ratio.head, ratio.cells[1].text) == ("Prony ratio 1", "0.25")
    assert (time.head, [cell.text for cell in time.cells[:2]]) == ("Relaxation time 2 [s]", ["1", "0.3125"])


def test_parameters_and_what_the_data_cannot_tell():
    found = {
        "parameters": {"youngs_modulus": 251.3e3, "stiffness_damping": 0.0029},
        "at_bounds": ["stiffness_damping"],
        "uncertainty": {
            "deviation": {"youngs_modulus": 2513.0, "stiffness_damping": 1e-4},
            "correlation": [[1.0, 0.5], [0.5, 1.0]],
            "poorest": {"youngs_modulus": 0.1, "stiffness_damping": 0.99},
            "poorest_deviation": 0.034,
        },
    }
    modulus, damping = parameter_rows(found, {"youngs_modulus": 264e3}, {"youngs_modulus": 250e3})
    assert modulus.head == "Young's modulus [kPa]"
    assert modulus.cells == [Cell("264"), Cell("251.3", beside="± 2.5"), Cell("250"), Cell("")]
    assert damping.head == "Damping by stiffness [ms]"
    none = Cell("\N{EN DASH}")
    assert damping.cells == [none, Cell("2.90", beside="± 0.10"), none, Cell("yes")]
    found["parameters"]["youngs_modulus"] = -3.0
    assert parameter_rows(found, {}, {})[0].cells[1].text == "0.0"
    assert parameter_rows({**found, "uncertainty": None}, {}, {})[0].cells[1].text == "\N{MINUS SIGN}0.003"
    said = uncertainty_text("sysid", found, {}).replace("\u00a0", " ")
    assert said == "SysID: the data tell least about damping by stiffness, to 3.4 % of the range."
    assert uncertainty_text("sysid", {**found, "uncertainty": None}, {}) == ""
    found["uncertainty"]["poorest_deviation"] = 1.9
    assert uncertainty_text("sysid", found, {}).endswith(
        "damping by stiffness, and leave that open over the whole range: a prior would settle it."
    )


@pytest.mark.parametrize(("deviation", "told"), [(2.5e3, True), (9.9e3, False)])
def test_what_the_data_add_nothing_to_is_said_to_be_its_prior(deviation, told):
    found = {
        "parameters": {"youngs_modulus": 251.3e3},
        "at_bounds": [],
        "uncertainty": {
            "deviation": {"youngs_modulus": deviation},
            "correlation": [[1.0]],
            "poorest": {"youngs_modulus": 1.0},
            "poorest_deviation": 0.01,
        },
    }
    ranges = {"youngs_modulus": {"prior": {"mean": 250e3, "deviation": 10e3}}}
    said = uncertainty_text("sysid", found, ranges).replace("\u00a0", " ")
    added = " They tell next to nothing of Young's modulus: it stays where its prior has it, at 250 ± 10 kPa."
    assert said.endswith(added) is not told


def test_rows_of_markers_that_were_never_seen():
    marker = {
        "label": "A",
        "seen": 0.0,
        "gaps": 1,
        "longest_gap_frames": 9,
        "masked_frames": 9,
        "jumps": [],
        "noise_mm": None,
        "drift_mm": None,
    }
    (row,) = quality_rows({"markers": [marker]})
    assert [row.head, *(cell.text for cell in row.cells)] == ["A", "0.0 %", "1", "9", "9", "0", "", ""]
    table = residual_table({"t": {"rms_mm": 0.5, "residual_mm": {"A": None, "B": 0.5}, "outliers": []}})
    assert table.columns == ["A", "B", "Root mean square"]
    assert table.rows[0].cells == [Cell("\N{EN DASH}"), Cell("0.50"), Cell("0.50")]
    many = {str(marker): 0.1 for marker in range(9)}
    table = residual_table({"t": {"rms_mm": 0.5, "residual_mm": many, "outliers": ["3"]}})
    assert table.columns == ["t"]
    assert [row.head for row in table.rows] == [*many, "Root mean square"]
    assert table.rows[3].cells == [Cell("0.10", "left out")]


def test_a_model_that_runs_away_does_not_set_the_scale():
    times = np.arange(20) * 0.01
    measured = np.zeros((20, 1, 3))
    measured[:, 0, 2] = 0.01 * np.sin(30.0 * times)
    wild = measured + np.exp(50.0 * times)[:, None, None]
    figure = motion_figures.marker_paths(times, measured, {"resphys": wild}, ["A"], narrow=False)
    spans = [np.ptp(axes.get_ylim()) for axes in figure.axes[:3]]
    assert spans[2] < 50.0
    assert 0.05 * np.ptp(measured[..., 2]) * 1e3 < spans[1] < 5.0  # [mm]


def test_prediction_intervals_are_bands_around_their_model():
    times = np.arange(20) * 0.01
    measured = np.zeros((20, 1, 3))
    measured[:, 0, 2] = 0.01 * np.sin(30.0 * times)
    shown = {"sysid": 1.2 * measured, "resphys": 1.1 * measured}
    widths = {"resphys": np.linspace(1e-3, 3e-3, 20)[:, None]}
    figure = motion_figures.marker_paths(times, measured, shown, ["A"], bands=widths, narrow=False)
    (band,) = figure.axes[2].collections
    corners = band.get_paths()[0].vertices
    for time, middle, width in zip(times, 1.1 * measured[:, 0, 2], widths["resphys"][:, 0], strict=True):
        reached = corners[np.isclose(corners[:, 0], time), 1]
        assert [reached.min(), reached.max()] == pytest.approx([1e3 * (middle - width), 1e3 * (middle + width)])


def test_error_lines_end_where_a_trial_diverged():
    rows = np.array([[1.0, 1.0, 1.0], [3.0, np.nan, np.inf]])
    figure = figures.error_over_time({"resphys": rows}, np.arange(1.0, 4.0), narrow=False)
    (line,) = figure.axes[0].lines
    np.testing.assert_allclose(line.get_ydata(), [2.0, 1.0, np.nan])


def test_landscape_marks_its_points():
    modulus, ratio = np.array([1e5, 2e5, 3e5]), np.array([0.4, 0.45])
    loss = np.array([[1.0, 2.0], [0.1, 0.2], [np.nan, 1.0]])
    points = {"data sheet": (2.64e5, 0.499), "lowest of the grid": (2e5, 0.4)}
    surface = figures.landscape(modulus, ratio, loss, points, narrow=True).axes[0]
    assert [tuple(np.ravel(line.get_data())) for line in surface.lines] == [(264.0, 0.499), (200.0, 0.4)]
    assert len(surface.collections) == 2
    curve = figures.landscape(modulus, np.array([]), loss[:, 1], points, narrow=False).axes[0]
    assert curve.get_ylabel() == "loss"
    assert tuple(np.ravel(curve.lines[-1].get_data())) == (200.0, 0.2)


def test_start_that_was_kept_is_bold():
    histories = {"sysid": [[{"loss": 1.0}, {"loss": 3.0}, {"loss": 0.5}], [{"loss": 2.0}, {"loss": 0.1}], []]}
    (axes,) = figures.loss_histories(histories, narrow=False).axes
    colours = [line.get_color() for line in axes.lines]
    assert colours == [TONES["muted"].light, TONES["sysid"].light]
    np.testing.assert_allclose(axes.lines[0].get_ydata(), [1.0, 1.0, 0.5])


def test_trials_in_order_of_their_errors(tmp_path):
    write_recordings(tmp_path)
    write_split(tmp_path, list(TRIALS), models=("simulation", "resphys"))
    trials = read_trials(tmp_path, SETTINGS)
    assert [trials.names[each] for each in best_and_worst(trials)] == ["load101", "bare"]
    write_split(tmp_path, list(TRIALS), models=("simulation", "resphys"), diverged=("resphys",))
    assert best_and_worst(read_trials(tmp_path, SETTINGS))[0] == 0


def test_views_have_the_free_end_on_the_right_and_gravity_down():
    rest = box_hexahedra(divisions=(4, 1, 1)).vertices
    times = np.arange(10) * STEP
    axes = motion_axes(DOWN, sag(rest, times, 0.05))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert axes[0, 0] > 0.9
    assert axes[1, 2] > 0.9
    mirrored = sag(rest, times, 0.05) * [-1.0, 1.0, 1.0]
    assert motion_axes(DOWN, mirrored)[0, 0] < -0.9
    hanging = sag(rest, times, 0.05)[..., [2, 1, 0]] * [1.0, 1.0, -1.0]
    assert motion_axes(DOWN, hanging)[1, 2] > 0.9
    assert np.isfinite(motion_axes(np.zeros(3), sag(rest, times, 0.05))).all()


def motion(frames=3, model="simulation"):
    mesh = box_hexahedra(divisions=(3, 1, 1))
    bound = np.array(list(TRACKED.values()))
    times = np.arange(1, frames + 1) * 0.02
    positions = {name: sag(mesh.vertices, times, 0.05, name) for name in (model, "resphys")}
    markers = {name: sag(bound, times, 0.05, name) for name in positions}
    return ComparedMotion(mesh, times, sag(bound, times, 0.05), positions, markers, bound, DOWN)


@pytest.mark.usefixtures("can_draw")
def test_instants_show_bodies_dots_and_rings():
    shown = motion(2)
    shown.positions["resphys"][1] *= 1e200
    shown.markers["resphys"][1] = np.nan
    (frames,) = render.draw(shown.scene())
    pixels = np.stack(np.split(frames.astype(int), 2, axis=2), axis=1)
    assert pixels.shape[:2] == (2, 2)
    solid = pixels[..., 3] > 200
    blue = solid & (pixels[..., 2] > pixels[..., 0] + 40)
    dots = solid & (pixels[..., 0] > pixels[..., 2] + 150)
    assert blue[0].sum(axis=(1, 2)).min() > 20_000
    assert blue[1].sum() == 0  # It has diverged.
    assert dots.sum(axis=(2, 3)).min() > 300
    rows, columns = np.nonzero(dots[0, 1])  # From nearby, the markers' middle is that of the view.
    assert abs(rows.mean() / dots.shape[2] - 0.5) < 0.05
    assert abs(columns.mean() / dots.shape[3] - 0.5) < 0.05


@pytest.mark.usefixtures("can_draw")
def test_one_marker_alone_is_seen_from_a_distance_that_shows_its_body():
    several = motion(2)
    alone = replace(
        several,
        measured=several.measured[:, :1],
        markers={model: each[:, :1] for model, each in several.markers.items()},
        bound=several.bound[:1],
    )
    _, near = alone.scene().views
    assert near.half_height >= 0.03 * 0.1
    (frames,) = render.draw(alone.scene())
    nearby = np.split(frames.astype(int), 2, axis=2)[0][0]
    assert (nearby[..., 3] > 200).mean() > 0.3


@pytest.mark.usefixtures("can_draw")
def test_film_moves_and_is_slower_than_the_motion(tmp_path, capsys):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    shown = motion(4)
    shown.measured[2, 1] = np.nan
    render.write_film(tmp_path / "motion.mp4", shown.film())
    assert "4/4 frames" in capsys.readouterr().err
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "motion.mp4"))
    about = next(reader)
    width, height = about["size"]
    assert about["fps"] == pytest.approx(12.5)  # 50 Hz, four times slower.
    frames = [np.frombuffer(frame, np.uint8).reshape(height, width, 3).astype(int) for frame in reader]
    assert len(frames) == 4
    assert np.abs(frames[1] - frames[0]).mean() > 1.0
    assert (tmp_path / "motion.mp4").stat().st_size < 200_000


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("raise SystemExit('no encoder')", "no encoder"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "Segmentation fault"),
    ],
)
def test_a_film_that_cannot_be_made_says_why(tmp_path, monkeypatch, script, reason):
    monkeypatch.setattr(render, "COMMAND", (sys.executable, "-c", script))
    with pytest.raises(render.DrawingError, match=reason):
        render.write_film(tmp_path / "motion.mp4", motion().film())
    assert not list(Path(tmp_path).iterdir())
