"""The report of a made-up run in which every vertex is observed, and what all pages share."""

import base64
import re

import pytest
from matplotlib.image import imread

from support.made_up_run import vertex_settings, write_vertex_run
from support.report_page import report
from warp_resphys.experiment.report import RunReader
from warp_resphys.io.errors import DataFileError
from warp_resphys.io.safe_files import read_json
from warp_resphys.report import figures
from warp_resphys.report.error_section import error_over_time
from warp_resphys.report.wording import error_parts, number_text

SETTINGS = vertex_settings()
DRAWN = {
    "error_over_time",
    "paths_worst",
    "paths_best",
    "training_resphys",
    "training_simfree",
    "motion",
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory, used_again):
    """A run with its page."""
    folder = tmp_path_factory.mktemp("run")
    write_vertex_run(folder, SETTINGS)
    with used_again():
        return folder, report(folder, SETTINGS)


@pytest.mark.usefixtures("can_draw")
def test_page_needs_nothing_beside_it(finished):
    folder, page = finished
    assert {path.stem for path in (folder / "figures").iterdir()} == DRAWN
    assert len(page.images) == len(DRAWN)
    assert all(link.startswith("data:") for link in page.links)
    assert all(len(image["alt"]) > 40 for image in page.images)
    assert re.search(r"https?://|url\(|@import", page.source) is None
    assert len(page.scripts) == 1
    assert page.allows_its_scripts_alone()
    for link in page.links:
        if link.startswith("data:image/svg+xml;base64,"):
            svg = base64.b64decode(link.partition(",")[2]).decode()
            assert svg.startswith("<svg")
            assert re.search(r'href="(?!#|data:)', svg) is None
    for path in (folder / "figures").iterdir():
        pixels = imread(path)
        assert pixels.shape[1] == round(200 * figures.WIDE)
        assert pixels[..., :3].std() > 0.02


def test_page_says_how_far_and_stands_beside_the_published_numbers(finished):
    folder, page = finished
    errors = read_json(folder / "errors.json")["errors_mm"]
    for summary in errors.values():
        assert " ".join(error_parts(summary)) in page.text
    simulated, corrected = (
        number_text(errors[model]["mean"]) for model in ("simulation", "resphys")
    )
    page.says(
        f"uncorrected simulator{simulated}",
        f"+ learned force (ResPhys){corrected}best",
        *("4.488 ± 1.468", "0.035 ± 0.070", "0.004 ± 0.010"),
        "2 test trials, 40 steps and 20 vertices",
        "One test trial: 0.12 <kg>",
        *("Against the reconstruction", "the smallest to the largest"),
        "Simulation with the true parameters0.42 s",
        *("1 min 15 s", "1 min 27 s", "numpy", "mesh.divisions", "[4, 1, 1]"),
    )
    for absent in ("markers", "No recordings", "Registration", "Identification", "pressure"):
        assert absent not in page.text[: page.text.index("Settings and versions")]


@pytest.mark.usefixtures("can_draw")
def test_the_same_run_gives_the_same_page(finished, tmp_path, used_again):
    write_vertex_run(tmp_path, SETTINGS)
    with used_again():
        assert report(tmp_path, SETTINGS).source == finished[1].source


@pytest.mark.usefixtures("no_figures")
def test_a_diverged_rollout_is_said_and_does_not_hide_the_rest(tmp_path):
    write_vertex_run(tmp_path, SETTINGS, models=("simulation", "resphys"), diverged=("resphys",))
    stale = tmp_path / "figures" / "motion.png"
    stale.parent.mkdir()
    stale.write_bytes(b"of an earlier run")
    page = report(tmp_path, SETTINGS)
    page.says(
        "1 of 2 diverged", "ResPhys diverged in 1 of 2 trials", "the first roll-out has diverged"
    )
    assert "no OpenGL here" in page.text
    assert page.text.count("libegl1") == 1
    written = {path.stem for path in stale.parent.iterdir()}
    assert written == {"error_over_time", "paths_worst", "paths_best", "training_resphys"}


@pytest.mark.usefixtures("no_drawing")
def test_errors_of_exactly_zero_are_a_report(tmp_path):
    write_vertex_run(tmp_path, SETTINGS, models=("reconstruction",))
    trials = RunReader(tmp_path, SETTINGS).trials
    trials.positions["reconstruction"][:] = trials.target
    figure = error_over_time(trials.errors_mm, trials.times[0])
    assert "zero, or diverged, throughout" in [text.get_text() for text in figure.axes[0].texts]
    assert "0.000" in report(tmp_path, SETTINGS).text


@pytest.mark.usefixtures("no_drawing")
def test_poses_have_no_time(tmp_path):
    write_vertex_run(tmp_path, SETTINGS, steps=0, begins="static", models=("simulation", "resphys"))
    assert "2 test trials, 1 step and" in report(tmp_path, SETTINGS).text
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == {"training_resphys"}
    # As beside motions.
    write_vertex_run(tmp_path, SETTINGS, steps=3, begins="static", models=("simulation", "resphys"))
    assert not RunReader(tmp_path, SETTINGS).trials.moves


def test_arrays_that_do_not_fit_are_refused(tmp_path):
    write_vertex_run(tmp_path, SETTINGS)
    other = tmp_path / "other"
    write_vertex_run(other, SETTINGS, steps=20)
    (other / "rollouts.h5").replace(tmp_path / "rollouts.h5")
    with pytest.raises(DataFileError, match="shape"):
        _ = RunReader(tmp_path, SETTINGS).trials


@pytest.mark.usefixtures("no_drawing")
def test_a_page_that_cannot_be_written_is_one_sentence(tmp_path):
    write_vertex_run(tmp_path, SETTINGS)
    (tmp_path / "figures").write_text("in the way")
    with pytest.raises(DataFileError, match="cannot write figures"):
        report(tmp_path, SETTINGS)
