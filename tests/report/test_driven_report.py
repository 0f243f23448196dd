"""The report of motions that pressure drives, on made-up runs."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from chambered import hollow_box
from driven_run import BASE, LIMIT, MODELS, arm_settings, bent, data, errors_of, write_run
from matplotlib.image import imread
from report_page import FAILING, Page

from warp_resphys.energies.pressure import PRESSURE
from warp_resphys.experiment import report as stage
from warp_resphys.experiment.build import build_mesh, shipped_arm
from warp_resphys.experiment.report import make_report, read_driven, read_film, read_trials
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.io.files import read_json, write_json
from warp_resphys.io.stages import StageContext
from warp_resphys.learning.metrics import PUBLISHED_MM, PUBLISHED_WINDOWS_MM, median_filter, published_errors
from warp_resphys.mesh.chambers import find_chambers
from warp_resphys.mesh.mesh import Mesh
from warp_resphys.mesh.readers import write_mesh
from warp_resphys.report import body_picture, figures, motion_figures, page, render
from warp_resphys.report.bodies import ComparedMotion
from warp_resphys.report.body_picture import MeshSummary
from warp_resphys.report.camera import axes_from_below, motion_axes
from warp_resphys.report.data import Driven, along_body, drawn_markers, tip_markers
from warp_resphys.report.figures import CHAMBER_COLOURS, TONES
from warp_resphys.report.motion_sections import _sequences
from warp_resphys.report.page import Cell, Picture
from warp_resphys.report.run_page import largest_filtered, range_texts
from warp_resphys.report.sections import horizon_table, scale_table
from warp_resphys.report.verdict import (
    growth_text,
    marker_verdict,
    published_growth,
    reduction,
    reduction_text,
    scale_text,
)

DRAWN = {
    "error_over_time",
    "landscape",
    "loss_history",
    "markers",
    "plane_best",
    "plane_worst",
    "inputs",
    "space",
    "training_resphys",
    "training_simfree",
}


@pytest.fixture
def no_drawing(monkeypatch):
    """Nothing is drawn in other processes, which takes seconds."""
    monkeypatch.setattr(render, "COMMAND", FAILING)


@pytest.fixture
def no_figures(no_drawing, monkeypatch):
    """Neither are the figures, which are drawn in tests of their own; their names are kept."""

    def draw(folder, name, _, alt):
        (folder / f"{name}.png").touch()
        return Picture("data:,", "data:,", alt)

    monkeypatch.setattr(page, "draw_picture", draw)


def report(folder, settings):
    make_report(StageContext("report", folder, "", {"config": settings}))
    return Page(folder / "report.html")


def summary(mean, diverged=0):
    return {"mean": mean, "std": None if mean is None else 0.1, "trajectories": 3, "diverged": diverged}


@pytest.mark.usefixtures("no_drawing")
def test_page_of_an_arm(tmp_path):
    settings = arm_settings()
    write_run(tmp_path, settings, steps=200)
    page = report(tmp_path, settings)
    found = errors_of(tmp_path)
    assert all(link.startswith("data:") for link in page.links)
    assert re.search(r"https?://", page.source) is None
    assert len(page.scripts) == 1
    assert page.allows_its_scripts_alone()
    assert all(len(image["alt"]) > 40 for image in page.images)
    for model in MODELS:
        assert f"{found['errors_mm'][model]['mean']:.3f} ± " in page.text
        assert f"{found['per_marker'][model]['Ring 2 - 3']:.3f}" in page.text
        assert f"{found['median_filtered'][model]:.3f} mm (" in page.text
        assert all(f"{row['errors_mm'][model]:.3f}" in page.text for row in found["per_trajectory"])
    means = {model: each["mean"] for model, each in found["errors_mm"].items()}
    less = 100.0 * (1.0 - means["resphys"] / means["sysid"])
    for said in (
        f"The error of ResPhys is {less:.1f} % smaller than that of SysID (",
        "in nine of ten draws of",
        "; published: 21.1 % smaller).",
        "7.31 ± 3.54",
        "No recordings are configured",
        "fibres around the chambers",
        "which this run has not seen",
        "The noise of the markers alone is 0.08 mm.",
        "training trials to 0.120 mm from the observed ones, 0.610 mm at most; replayed in the simulator",
        "mean over 3 test trials of 4 s and 12 markers",
        "SimFree: 2 of 3 roll-outs left the states of the training, the first after 0.84 s (test_00).",
        "ResPhys: none of 3 roll-outs left the states of the training.",
        "dashed, the limit of 20 kPa",
        "Young's modulus [kPa]215237250",
        "1 min 15 s",
        "no OpenGL here",
    ):
        assert said in page.text
    for absent in ("Longer than the training", "Beyond the inputs", "A line ends", "±  is"):
        assert absent not in page.text
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == DRAWN


@pytest.mark.usefixtures("no_figures")
def test_page_of_longer_rollouts_of_which_one_diverged(tmp_path):
    settings = arm_settings("sopra_extrapolation", data=data(folder="recordings", train_fraction=0.5))
    write_run(tmp_path, settings, horizons=(1, 2), diverged=("simfree",), simulated=False)
    page = report(tmp_path, settings)
    found = errors_of(tmp_path)
    growth = found["growth"]["resphys"]
    assert (
        f"From 1 s to 2 s the error of ResPhys {'grows' if growth > 0 else 'falls'} by {abs(100 * growth):.1f} %."
        in page.text
    )
    assert "Longer than the training" in page.text
    assert "First 1 s" in page.text
    assert page.text.count("1 of 3 diverged") == 2
    assert "A line ends where the first roll-out has diverged." in page.text
    assert "of the published simulator, of 494 vertices" in page.text
    assert "No recordings are configured" not in page.text
    assert "9.89 ± 5.02" in page.text


@pytest.mark.usefixtures("no_figures")
def test_page_of_higher_pressures(tmp_path):
    settings = arm_settings("sopra_overpressure", data=data(input_scales=[1.25, 1.75]))
    write_run(tmp_path, settings, test=2, scales=(1.25, 1.75))
    page = report(tmp_path, settings)
    found = errors_of(tmp_path)["scales"]
    text = page.text
    assert f"At 1.75 times the inputs of the training the error is {found['1.75']['resphys']['mean']:.3f} mm" in text
    assert all(f"{found[f][m]['mean']:.3f} ± " in text for f in ("1", "1.25", "1.75") for m in MODELS)
    assert "At higher inputs it is none of 2 (1.25 times), 2 of 2 (1.75 times), the first after 0.40 s" in text
    assert "ResPhys: none of 2 roll-outs" in text
    assert (tmp_path / "figures" / "error_over_scale.png").is_file()
    trials = read_trials(tmp_path, settings)
    assert trials.names == ("test_00", "test_01")
    pressures = read_driven(tmp_path, settings)
    assert len(pressures.scaled) == 4
    assert set(pressures.scaled) < pressures.values.keys()
    rows = trials.errors_mm["resphys"]
    assert rows[:, 1:].mean() == pytest.approx(found["1"]["resphys"]["mean"], rel=1e-5)


@pytest.mark.usefixtures("no_drawing")
def test_page_of_one_chamber_one_trial_and_two_models(tmp_path):
    box = hollow_box("hexahedron")
    turned = box.vertices[:, [2, 1, 0]] * [1.0, 1.0, -1.0] - [0.01, 0.015, 0.0]
    write_mesh(tmp_path / "box.vtk", Mesh(turned, box.cells))
    tracked = {"Tip": [0.0, 0.01, -0.06]}
    settings = arm_settings("segment_real", 2)
    settings["mesh"] = {"kind": "file", "path": str(tmp_path / "box.vtk"), "units": "m", "order": 1}
    settings["mesh"]["drop_unreferenced"] = True
    settings["markers"] = {"tracked": tracked, "reference": BASE}
    settings["data"] = data(folder="recordings", input_limit=None)
    write_run(tmp_path, settings, train=0, test=1, chambers=1, models=("simulation", "resphys"), simulated=False)
    page = report(tmp_path, settings)
    assert "On trial test_00, which no training or identification saw" in page.text
    assert "mean over 1 test trial of 2 s and 1 marker, ±" in page.text
    assert "Pressures of the trial." in page.text
    assert "ResPhys: the roll-out never left the states of the training." in page.text
    for absent in ("SysID", "Published", "The published", "Identification", "dashed", "median filter"):
        assert absent not in page.text
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == DRAWN - {
        "landscape",
        "loss_history",
        "plane_best",
        "training_simfree",
    }


@pytest.mark.parametrize("name", ["dataset.h5", "rollouts.h5", "errors.json", "registration.json"])
def test_a_missing_file_is_one_sentence(tmp_path, name):
    settings = arm_settings()
    write_run(tmp_path, settings, test=1, steps=40, models=("resphys",))
    (tmp_path / name).unlink()
    with pytest.raises(DataFileError, match=name) as caught:
        report(tmp_path, settings)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "report.html").exists()


def test_files_that_do_not_belong_together_are_refused(tmp_path):
    settings = arm_settings()
    write_run(tmp_path, settings, test=2, steps=40, models=("resphys",))
    other = tmp_path / "other"
    write_run(other, settings, test=3, steps=40, models=("resphys",))
    (other / "rollouts.h5").replace(tmp_path / "rollouts.h5")
    with pytest.raises(DataFileError, match=r"rollouts.h5 names trials that .* does not hold \(test_02\)"):
        read_trials(tmp_path, settings)
    write_run(tmp_path, settings, test=2, steps=40, models=("resphys",), chambers=7)
    with pytest.raises(DataFileError, match=r"pressures of chamber_7, but the body's chambers are chamber_1, "):
        report(tmp_path, settings)


def test_what_is_read(tmp_path):
    settings = arm_settings()
    write_run(tmp_path, settings, diverged=("simfree",))
    trials, film = read_trials(tmp_path, settings), read_film(tmp_path, settings, build_mesh(settings["mesh"]))
    pressures = read_driven(tmp_path, settings)
    assert pressures.scaled == ()
    assert trials.times[0, [0, -1]].tolist() == [0.0, pytest.approx(2.0)]
    assert np.isnan(trials.target[0, 30:36, 1]).all()
    rows = trials.errors_mm
    assert np.isinf(rows["simfree"][0, 60:]).all()
    expected = errors_of(tmp_path)["errors_mm"]
    for model in ("sysid", "resphys"):
        assert rows[model][:, 1:].mean() == pytest.approx(expected[model]["mean"], rel=1e-5)
    assert film.positions["resphys"].shape[0] == len(film.times) == 51
    assert list(pressures.values) == ["train_00", "train_01", "test_00", "test_01", "test_02"]
    assert pressures.values["test_00"].shape == (100, 6)


def test_recordings_are_shown_on_the_body_as_it_hangs(tmp_path, monkeypatch):
    settings = arm_settings()
    write_run(tmp_path, settings, test=1, steps=40, models=("simulation",), sag=0.004)
    shown = []
    monkeypatch.setattr(stage, "write_report", lambda _, data: shown.append(data))
    make_report(StageContext("report", tmp_path, "", {"config": settings}))
    (found,) = shown
    assert found.mesh.vertices[:, 2].min() - found.recordings.mesh.vertices[:, 2].min() == pytest.approx(
        0.004, abs=1e-6
    )
    nominal = dict(zip(found.recordings.labels, found.recordings.nominal[:, 2], strict=True))
    assert nominal["Base - 1"] == BASE["Base - 1"][2]
    low, high = ("Ring 3 - 1", "Ring 1 - 1")
    places = settings["markers"]["tracked"]
    assert nominal[low] - places[low][2] == pytest.approx(-0.004, abs=3e-4)
    assert nominal[high] - places[high][2] == pytest.approx(-0.001, abs=3e-4)


def test_median_filter_is_one_of_a_second():
    rng = np.random.default_rng(1)
    values = rng.normal(size=(2, 300))
    smooth = median_filter(values, 0.01)
    for at in (0, 20, 50, 150, 299):  # half a second to both sides: 50 steps
        np.testing.assert_allclose(smooth[:, at], np.median(values[:, max(0, at - 50) : at + 51], axis=1))
    step = (np.arange(300) >= 150).astype(float)
    np.testing.assert_array_equal(median_filter(step, 0.01), step)
    spike = np.zeros(300)
    spike[100:150] = 5.0  # shorter than half of the window
    assert median_filter(spike, 0.01).max() == 0.0
    assert median_filter(spike, 0.02).max() == 5.0  # at this step it lasts a second


def test_median_filter_leaves_out_what_is_not_known():
    values = np.array([1.0, np.nan, 3.0, np.inf, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(median_filter(values, 1.0, 2.0), [1.0, 2.0, np.inf, np.inf, np.inf, np.nan, np.nan])
    for step, window in ((0.0, 1.0), (0.01, -1.0), (np.nan, 1.0)):
        with pytest.raises(InputError, match="both must be positive"):
            median_filter(values, step, window)


def test_published_numbers_are_those_of_the_same_experiment():
    assert published_errors("sopra_extrapolation") is PUBLISHED_MM["sopra_extrapolation"]
    assert published_errors("sopra_overpressure") is PUBLISHED_MM["sopra"]
    assert published_errors("beam_real_repeated") is PUBLISHED_MM["beam_real"]
    assert published_errors("segment_real") == {}
    means = {model: each.mean for model, each in PUBLISHED_MM["sopra"].items()}
    assert 100.0 * reduction(means) == pytest.approx(21.1, abs=0.05)
    growth = published_growth(PUBLISHED_WINDOWS_MM["sopra_extrapolation"], "5", "10")
    assert 100.0 * growth["resphys"] == pytest.approx(5.4, abs=0.05)


def test_words():
    published, horizons = PUBLISHED_MM["sopra"], PUBLISHED_WINDOWS_MM["sopra_extrapolation"]
    errors = {"sysid": summary(2.0), "resphys": summary(2.1)}
    said = "The error of ResPhys is 5.0 % larger than that of SysID"
    assert reduction_text(errors, published) == f"{said} (published: 21.1 % smaller)."
    assert reduction_text(errors, {}) == f"{said}."
    assert reduction_text({"sysid": summary(2.0), "resphys": summary(5.0)}, {}) == (
        "The error of ResPhys is 2.5 times that of SysID."
    )
    assert growth_text({"resphys": -0.021}, ["10", "5"], horizons) == (
        "From 5 s to 10 s the error of ResPhys falls by 2.1 % (published: 5.4 %)."
    )
    assert growth_text({"resphys": -0.021}, ["5"], horizons) == ""
    lost = {"sysid": summary(2.0), "resphys": summary(None, 1)}
    assert "ResPhys diverged in 1 of 3 roll-outs" in marker_verdict(lost, ["a", "b"], None)
    assert reduction_text(lost, published) == ""
    over = {"1": errors, "1.5": {"sysid": summary(3.0), "resphys": summary(None, 2)}, "1.25": errors}
    assert scale_text(over) == (
        "At 1.5 times the inputs of the training the error is diverged with ResPhys, 3.000 mm with SysID."
    )
    assert scale_text({}) == ""


def test_tables_of_horizons_and_scales():
    errors = {"sysid": summary(2.0), "resphys": summary(1.0)}
    more = {"sysid": summary(None, 1), "resphys": summary(1.5)}
    metrics = {"horizons": {"10": more, "5": errors}, "growth": {"sysid": None, "resphys": 0.5}}
    table = horizon_table(metrics, PUBLISHED_WINDOWS_MM["sopra_extrapolation"])
    assert table.columns == ["SysID", "ResPhys"]
    assert {row.head: row.cells for row in table.rows} == {
        "First 5 s": [Cell("2.000 ± 0.100", "7.51 ± 3.63"), Cell("1.000 ± 0.100", "5.79 ± 3.09")],
        "First 10 s": [Cell("1 of 3 diverged", "7.57 ± 3.59"), Cell("1.500 ± 0.100", "6.10 ± 3.22")],
        "Growth": [Cell("\N{EN DASH}", "+0.8 %"), Cell("+50.0 %", "+5.4 %")],
    }
    (row,) = horizon_table({"horizons": {"5": errors}}, {}).rows
    assert row.cells == [Cell("2.000 ± 0.100"), Cell("1.000 ± 0.100")]
    assert horizon_table({}, {}) is None
    table = scale_table({"1.25": more, "1": errors})
    assert table.columns == ["SysID", "ResPhys"]
    assert {row.head: row.cells for row in table.rows} == {
        "\N{MULTIPLICATION SIGN} 1": [Cell("2.000 ± 0.100"), Cell("1.000 ± 0.100", "\N{MINUS SIGN}50 %")],
        "\N{MULTIPLICATION SIGN} 1.25": [Cell("1 of 3 diverged"), Cell("1.500 ± 0.100")],
    }
    assert scale_table({}) is None
    assert largest_filtered({}) == ""
    filtered = {"median_filtered": {"resphys": 1.5, "sysid": None}}
    assert (
        largest_filtered(filtered).replace("\u00a0", " ")
        == "In single trials the filtered error reaches 1.500 mm (ResPhys)."
    )


def test_trials_out_of_range_are_counted_where_they_belong():
    none, some = {"first_s": {}}, {"first_s": {"b": 2.5, "a": 1.0}}
    found = {"range": {"resphys": some, "simfree": none}}
    free, force = (each.replace("\u00a0", " ") for each in range_texts(found, ["a", "b", "c"]))
    assert free == "SimFree: none of 3 roll-outs left the states of the training."
    assert force == "ResPhys: 2 of 3 roll-outs left the states of the training, the first after 1.00 s (a)."
    late = {"first_s": {"d": 0.25}}
    found["scales_range"] = {
        "1": {"resphys": some, "simfree": none},
        "1.5": {"resphys": late, "simfree": none},
        "1.25": {"resphys": none, "simfree": none},
    }
    free, force = (each.replace("\u00a0", " ") for each in range_texts(found, ["a", "b", "c"]))
    assert "higher" not in free
    assert force.endswith(
        "(a). At higher inputs it is none of 3 (1.25 times), 1 of 3 (1.5 times), the first after 0.25 s (d)."
    )
    assert range_texts({"range": {"resphys": {"first_s": {"a": 0.5}}}}, ["a"])[0].startswith(
        "ResPhys: the roll-out left"
    )


def test_markers_that_are_drawn():
    clamped = np.array([[0.01, 0.0, 0.0], [-0.01, 0.0, 0.0]])
    bound = np.array([[0.0, 0.0, -0.1], [0.0, 0.0, -0.27], [0.01, 0.0, -0.265], [0.0, 0.0, -0.15]])
    assert tip_markers(bound, clamped).tolist() == [1, 2]
    np.testing.assert_allclose(along_body(bound, clamped)[0], 0.1, atol=1e-3)
    measured = np.repeat(bound[None], 5, axis=0)
    measured[2, 2, 0] += 0.02
    measured[3, 1, 0] += 0.01
    measured[3, 0, 0] += 0.01
    measured[4, 3] = np.nan
    assert drawn_markers(measured, bound, clamped) == [2, 0]
    assert drawn_markers(measured[:, 1:2], bound[1:2], clamped) == [0]
    measured[:, 2] = np.nan  # which that trial does not have
    assert drawn_markers(measured, bound, clamped) == [1, 0]
    measured[:, 1] = np.nan
    assert drawn_markers(measured, bound, clamped) == [0]
    measured[:, 0] = np.nan
    assert drawn_markers(measured, bound, clamped) == [3]


def test_error_lines_are_filtered_and_thin_behind():
    rows = np.ones((2, 200))
    rows[:, 100:110] = 9.0
    rows[1, 180:] = np.inf
    (axes,) = figures.error_over_time({"resphys": rows}, 0.01, window=1.0, narrow=True).axes
    thin, thick = axes.lines
    assert thin.get_linewidth() < 1.0 < thick.get_linewidth()
    assert np.nanmax(thin.get_ydata()) == 9.0
    assert np.nanmax(thick.get_ydata()) == 1.0
    np.testing.assert_allclose(thick.get_xdata()[[0, -1]], [0.0, 1.99])
    assert np.isnan(thin.get_ydata()[180:]).all()
    (axes,) = figures.error_over_time({"resphys": rows}, 0.01, narrow=False).axes
    (only,) = axes.lines
    assert np.nanmax(only.get_ydata()) == 9.0


def test_points_are_missing_where_a_rollout_diverged():
    errors = {"resphys": {1.0: 2.0, 1.5: 3.0}, "simfree": {1.0: 4.0}}
    (axes,) = figures.error_over_scale(errors, narrow=False).axes
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), [2.0, 3.0])
    np.testing.assert_array_equal(axes.lines[1].get_ydata(), [4.0, np.nan])


def test_a_model_that_runs_away_does_not_set_the_scale_of_the_tip():
    angle = np.linspace(0.0, 6.0, 50)
    measured = 0.02 * np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=1)
    measured[10] = np.nan
    wild = measured * np.exp(angle)[:, None]
    wild[40:] = np.nan
    flat = motion_figures.tip_planes(measured, {"sysid": measured, "resphys": wild}, narrow=False)
    for axes in flat.axes:
        assert np.ptp(axes.get_xlim()) == np.ptp(axes.get_ylim()) < 70.0  # [mm], of a motion of 40
    figure = motion_figures.tip_in_space(0.01 * np.arange(50), measured, {"resphys": wild}, narrow=True)
    assert np.ptp(figure.axes[0].get_zlim()) < 40.0
    drawn = np.concatenate([np.stack(line.get_data_3d(), axis=1) for line in figure.axes[0].lines])
    assert np.nanmax(np.abs(drawn)) < 60.0


def test_pressures_are_in_kilopascal_in_the_chambers_colours():
    pressure = np.array([[0.0, 1e3], [2e4, 3e3]])
    driven = Driven(PRESSURE, ("one", "two"), {"a": pressure, "b": 2 * pressure}, 2e4)
    figure = motion_figures.input_sequences(0.5, driven, narrow=False)
    first, second = figure.axes
    assert second.get_xlim() == (0.0, 1.0)
    assert [line.get_ydata()[0] for line in first.lines] == [20.0]
    steps = first.patches
    np.testing.assert_allclose(steps[1].get_data().values, [1.0, 3.0])
    np.testing.assert_allclose(steps[1].get_data().edges, [0.0, 0.5, 1.0])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "two", "limit"]
    assert [line.get_color() for line in figure.legends[0].get_lines()[:2]] == list(CHAMBER_COLOURS[:2])


def test_pressures_of_poses_are_bars_of_the_chambers_in_use():
    poses = {"a": np.array([[9e3, 0.0, 1e3]]), "b (test)": np.array([[0.0, 0.0, 0.0], [3e3, 0.0, 5e3]])}
    figure = motion_figures.pose_inputs(Driven(PRESSURE, ("one", "two", "three"), poses, 2e4), narrow=False)
    (axes,) = figure.axes
    assert axes.get_xlabel() == "pressure [kPa]"
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["a", "b (test)"]
    assert [bar.get_width() for bar in axes.patches] == [9.0, 3.0, 1.0, 5.0]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "three", "limit"]
    assert [line.get_xdata()[0] for line in axes.lines] == [20.0]


def test_poses_are_not_drawn_over_time():
    rows = np.ones((3, 1))
    driven = Driven(PRESSURE, ("one",), {"p": rows, "a": rows, "b": rows, "q": rows}, poses=("p", "q"))
    assert list(_sequences(driven, SimpleNamespace(names=("b", "q")))) == [
        "a, a trial of the training",
        "b, a test trial",
    ]
    assert _sequences(replace(driven, poses=tuple("pabq")), SimpleNamespace(names=("b", "q"))) == {}


def test_markers_stand_over_the_pressures():
    times = 0.1 * np.arange(4)
    moved = np.repeat(np.array([0.0, 1e-3, 2e-3, 3e-3])[:, None, None], 3, axis=2)
    driven = Driven(PRESSURE, ("chamber_1",), {"Pressures": np.full((3, 1), 5e3)})
    figure = motion_figures.marker_paths(times, moved, {"resphys": moved}, ["A"], driven, narrow=False)
    *coordinates, below = figure.axes
    assert len(coordinates) == 3
    assert all(axes.get_xlim() == below.get_xlim() for axes in coordinates)
    measured_line, model_line = coordinates[2].lines
    np.testing.assert_allclose(measured_line.get_ydata(), [0.0, 1.0, 2.0, 3.0], atol=1e-12)
    assert model_line.get_color() == TONES["resphys"].light
    assert not below.lines
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["chamber 1"]


@pytest.mark.usefixtures("no_figures")
def test_settings_are_shown_and_what_diverged_is_said(tmp_path):
    settings = arm_settings()
    write_run(tmp_path, settings, test=1, train=1, steps=60)
    metrics = read_json(tmp_path / "errors.json")
    metrics["errors_mm"]["resphys"] = summary(None, 1)
    write_json(tmp_path / "errors.json", metrics)
    page = report(tmp_path, settings)
    assert "data.input_limit20000.0" in page.text
    assert "ResPhys diverged in 1 of 3 roll-outs" in page.text


def test_view_from_below_keeps_what_is_to_the_right():
    axes = motion_axes(np.array([0.0, 0.0, -9.8]), np.random.default_rng(0).normal(size=(3, 20, 3)))
    below = axes_from_below(axes, np.array([0.0, 0.0, -9.8]))
    np.testing.assert_allclose(below[[0, 2]], [axes[0], [0.0, 0.0, -1.0]], atol=1e-12)
    assert np.linalg.det(below) == pytest.approx(1.0)
    np.testing.assert_array_equal(axes_from_below(axes, np.zeros(3)), below)


@pytest.mark.usefixtures("can_draw")
def test_second_view_is_from_below():
    arm = shipped_arm("arm_hexahedra_500")
    places = np.array(list(arm_settings()["markers"]["tracked"].values()))
    rest = np.zeros((1, 6))
    push = np.array([[LIMIT, 0.0, 0.0, 0.0, 0.0, 0.0]] * 30)  # Along x.
    moved = {
        name: np.concatenate([bent(arm.vertices, rest)[:1], bent(arm.vertices, push)[-1:]]) for name in ("resphys",)
    }
    markers = np.concatenate([bent(places, rest)[:1], bent(places, push)[-1:]])
    shown = ComparedMotion(
        arm, np.arange(2.0), markers, moved, {"resphys": markers}, places, np.array([0.0, 0.0, -9.8]), from_below=True
    )
    (frames,) = render.draw(shown.scene())
    frames = np.stack(np.split(frames.astype(int), 2, axis=2), axis=1)
    dots = (frames[..., 3] > 200) & (frames[..., 0] > frames[..., 2] + 150)
    solid = frames[..., 3] > 200
    height, width = (np.ptp(np.argwhere(solid[0, 1]), axis=0) + 1).tolist()
    assert 0.8 < height / width < 1.25  # The end of the arm is about round.
    (tall, wide) = (np.ptp(np.argwhere(solid[0, 0]), axis=0) + 1).tolist()
    assert tall > 3 * wide
    assert abs(np.argwhere(dots[1, 1]).mean(axis=0) - np.argwhere(dots[0, 1]).mean(axis=0)).max() > 10


@pytest.mark.usefixtures("can_draw")
def test_picture_of_the_arm_has_markers_where_it_is_whole(tmp_path):
    arm = shipped_arm("arm_hexahedra_500")
    body = MeshSummary(arm, 1070.0, np.flatnonzero(arm.vertices[:, 2] == 0.0), find_chambers(arm))
    near = [np.flatnonzero(np.abs(arm.vertices[:, 2] - z) < 0.01) for z in (-0.05, -0.1, -0.15, -0.2)]
    places = np.array(
        [arm.vertices[some[(arm.vertices[some] @ body_picture._TOWARDS_VIEWER).argmax()]] for some in near]
    )
    below = np.append(places, [[0.0, 0.0, arm.vertices[:, 2].min() - 0.05]], axis=0)  # on a stem below the tip
    body_picture.draw_mesh(tmp_path / "plain.png", body)
    body_picture.draw_mesh(tmp_path / "dots.png", body, places)
    body_picture.draw_mesh(tmp_path / "below.png", body, below)
    plain, dots, longer = (imread(tmp_path / f"{name}.png")[..., :3] for name in ("plain", "dots", "below"))
    changed = np.abs(plain - dots).max(axis=2) > 0.2
    left, middle, right = (part.sum() for part in np.array_split(changed, 3, axis=1))
    assert middle == 0
    assert min(left, right) > 500
    inked = [int((each[: int(0.9 * len(each))].min(axis=2) < 0.95).sum()) for each in (longer, plain)]
    assert inked[0] < 0.9 * inked[1]  # the picture reaches as far, so that the body is smaller in it
