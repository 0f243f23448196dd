"""The report of a made-up run in which every vertex is observed, and what all pages share."""

import base64
import re

import numpy as np
import pytest
from hydra import compose, initialize_config_module
from matplotlib.figure import Figure
from matplotlib.image import imread
from omegaconf import OmegaConf
from report_page import FAILING, Page
from vertex_run import STEP, settings, write_run

from warp_resphys.experiment.report import kept_in_words, make_report, network_in_words, read_trials
from warp_resphys.io.errors import DataFileError
from warp_resphys.io.files import read_json
from warp_resphys.io.stages import StageContext
from warp_resphys.learning.metrics import summarise
from warp_resphys.report import figures, render
from warp_resphys.report.figures import use_logarithm
from warp_resphys.report.motion_sections import worst_state
from warp_resphys.report.page import duration_text, error_parts, number_text
from warp_resphys.report.verdict import vertex_verdict

SETTINGS = settings()
DRAWN = {"error_over_time", "tip_displacement", "training_resphys", "training_simfree"}
RENDERED = {"motion", "shape"}


def report(folder, config=SETTINGS):
    make_report(StageContext("report", folder, "", {"config": config}))
    return Page(folder / "report.html")


@pytest.fixture
def no_drawing(monkeypatch):
    """Nothing is drawn in other processes, which takes seconds."""
    monkeypatch.setattr(render, "COMMAND", FAILING)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run with its page."""
    folder = tmp_path_factory.mktemp("run")
    write_run(folder, SETTINGS)
    return folder, report(folder)


@pytest.mark.usefixtures("can_draw")
def test_page_needs_nothing_beside_it(finished):
    folder, page = finished
    assert {path.stem for path in (folder / "figures").iterdir()} == DRAWN | RENDERED
    assert len(page.images) == len(DRAWN | RENDERED)
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
    simulated, corrected = (number_text(errors[model]["mean"]) for model in ("simulation", "resphys"))
    for said in (
        "The learned residual force brings the simulator (E 215 kPa, ν 0.45)",  # noqa: RUF001
        f"falls from {simulated} mm to {corrected} mm. The published result is 0.004 mm.",
        *("4.488 ± 1.468", "0.035 ± 0.070", "0.004 ± 0.010", "The published simulator doubles the beam's mass"),
        "mean over 2 test trials, 40 steps and 20 vertices",
        "One test trial: 0.12 <kg>",
        "ResPhys: our network, in a reduced basis of",
        "Kept: epoch 30, by roll-out error; its mean roll-out error on the validation split is 0.020 mm.",
        "spans the smallest to the largest of them",
        "Against the reconstruction",
        "Simulation with the true parameters0.42 s",
        *("1 min 15 s", "1 min 27 s", "numpy", "mesh.divisions", "[4, 1, 1]"),
    ):
        assert said in page.text
    for absent in ("markers", "No recordings", "Registration", "Identification", "pressure"):
        assert absent not in page.text[: page.text.index("Settings and versions")]


@pytest.mark.usefixtures("can_draw")
def test_the_same_run_gives_the_same_page(finished, tmp_path):
    write_run(tmp_path, SETTINGS)
    assert report(tmp_path).source == finished[1].source


@pytest.mark.usefixtures("no_drawing")
def test_a_diverged_rollout_is_said_and_does_not_hide_the_rest(tmp_path):
    write_run(tmp_path, SETTINGS, models=("simulation", "resphys"), diverged=("resphys",), refined=True)
    stale = tmp_path / "figures" / "shape.png"
    stale.parent.mkdir()
    stale.write_bytes(b"of an earlier run")
    page = report(tmp_path)
    assert "1 of 2 diverged" in page.text
    assert "1 of 2 test roll-outs diverged" in page.text
    assert "A line ends where the first roll-out has diverged." in page.text
    assert "no OpenGL here" in page.text
    assert page.text.count("libegl1") == 1
    assert "Taken in the end: epoch 3 of the refinement" in page.text
    written = {path.stem for path in stale.parent.iterdir()}
    assert written == {"error_over_time", "tip_displacement", "training_resphys", "refinement_resphys"}


@pytest.mark.usefixtures("no_drawing")
def test_errors_of_exactly_zero_are_a_report(tmp_path):
    write_run(tmp_path, SETTINGS, models=("reconstruction",))
    trials = read_trials(tmp_path, SETTINGS)
    trials.positions["reconstruction"][:] = trials.target
    figure = figures.error_over_time(trials.errors_mm, STEP, narrow=False)
    assert "zero, or diverged, throughout" in [text.get_text() for text in figure.axes[0].texts]
    page = report(tmp_path)
    assert "Mean vertex error: " in page.text


@pytest.mark.usefixtures("no_drawing")
def test_poses_have_no_time(tmp_path):
    write_run(tmp_path, SETTINGS, steps=0, begins="static", models=("simulation", "resphys"))
    page = report(tmp_path)
    assert "2 test trials, 1 step and" in page.text
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == {"training_resphys"}
    write_run(tmp_path, SETTINGS, steps=3, begins="static", models=("simulation", "resphys"))  # As beside motions.
    assert not read_trials(tmp_path, SETTINGS).moves


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ["network=published", "trainer=published"],
            "ResPhys: the published network, in force, positions and velocities of every vertex, 5 blocks of 3 hidden "
            "layers of 512; trained as published, 1000 epochs, weights chosen by validation loss.",
        ),
        (
            [],
            "ResPhys: our network, in a reduced basis of 6 position, 6 velocity and 12 force modes, 1 block of 3 "
            "hidden layers of 256, beside a linear part from ridge regression; trained our way, 300 epochs, weights "
            "chosen by roll-out error.",
        ),
        (
            ["network=published", "network.width=64", "trainer=published", "trainer.epochs=10"],
            "ResPhys: our network, in force, positions and velocities of every vertex, 5 blocks of 3 hidden layers of "
            "64; trained our way, 10 epochs, weights chosen by validation loss.",
        ),
    ],
)
def test_it_is_said_whose_network_it_is(options: list[str], said: str) -> None:
    with initialize_config_module("warp_resphys.conf", version_base="1.3"):
        config = OmegaConf.to_container(compose("config", options), resolve=True)
        refined = OmegaConf.to_container(compose("config", [*options, "refinement=solver_in_the_loop"]), resolve=True)
    assert network_in_words(config) == said
    assert network_in_words(refined) == f"{said} Then refined through the simulator, over windows of 10 steps."


def test_it_is_said_which_weights_were_taken() -> None:
    kept = {"selection": "rollout", "epoch": 30, "validation_rollout_error_mm": 0.25}
    lost = {"selection": "validation_loss", "epoch": 9, "validation_rollout_error_mm": None}
    first = "Kept: epoch 30, by roll-out error; its mean roll-out error on the validation split is 0.250 mm."
    assert kept_in_words({"resphys": kept}) == first
    said = kept_in_words({"resphys": lost})
    assert said == "Kept: epoch 9, by validation loss; its roll-outs of the validation split diverge."
    worse, better = {**kept, "epoch": 0}, {**kept, "epoch": 4, "validation_rollout_error_mm": 0.125}
    said = kept_in_words({"resphys": kept, "resphys_refined": worse})
    assert said == f"{first} No epoch of the refinement was better: the weights are those from before it."
    assert kept_in_words({"resphys": kept, "resphys_refined": better}).endswith(
        "Taken in the end: epoch 4 of the refinement; its mean roll-out error on the validation split is 0.125 mm."
    )


def test_a_model_without_error_does_not_hide_the_others():
    rows = np.full((2, 5), 0.5)
    (axes,) = figures.error_over_time({"simulation": rows, "resphys": 0.0 * rows}, STEP, narrow=False).axes
    low, high = axes.get_ylim()
    assert axes.get_yscale() == "log"
    assert low <= 0.5 <= high
    assert not axes.texts


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ([4.5], [0.5], "9.0 times closer"),
        ([4.5], [0.0], "all the way to its target"),
        ([1.0], [1.1], "does not help: the mean vertex error on 1 test trial is 1.100 mm with it"),
        (
            [1.0],
            [np.inf],
            "1 of 1 test roll-outs diverged, so there is no mean error to report. Without it: 1.000",
        ),
        ([np.nan], [1.0], "Uncorrected, 1 of 1 test roll-outs diverge; with the learned residual force"),
    ],
)
def test_verdict(before: list[float], after: list[float], said: str) -> None:
    errors = {"simulation": summarise([np.array(before)]), "resphys": summarise([np.array(after)])}
    assert said in vertex_verdict(errors, {}, "wrong", "right")


def test_numbers_have_sensible_digits() -> None:
    assert [number_text(each) for each in (4.48812, 0.000721, 0.0, None)] == [
        "4.488",
        "0.00072",
        "0.000",
        "diverged",
    ]
    assert number_text(2.14e-9) == "2.1 \N{MULTIPLICATION SIGN} 10⁻⁹"
    summary = {"mean": 0.000721, "std": 0.00031, "trajectories": 5, "diverged": 0}
    assert error_parts(summary) == ("0.00072", "± 0.00031")
    assert error_parts({**summary, "std": None}) == ("0.00072", "")  # of one fold
    assert [duration_text(each) for each in (0.421, 12.34, 59.97, 184.6)] == [
        "0.42 s",
        "12.3 s",
        "60.0 s",
        "3 min 05 s",
    ]


def test_the_picture_is_taken_where_the_simulation_is_worst(tmp_path):
    write_run(tmp_path, SETTINGS)
    trials = read_trials(tmp_path, SETTINGS)
    assert trials.worst == 1
    trials.positions["simulation"][1] = trials.target[1]
    trials.positions["simulation"][1, 7] += 0.01
    trials.positions["simulation"][1, 9:] = np.nan
    trials.errors_mm.clear()
    trials.__dict__.pop("errors_mm")
    assert worst_state(trials, 1) in (7, 9)


def test_arrays_that_do_not_fit_are_refused(tmp_path):
    write_run(tmp_path, SETTINGS)
    other = tmp_path / "other"
    write_run(other, SETTINGS, steps=20)
    (other / "rollouts.h5").replace(tmp_path / "rollouts.h5")
    with pytest.raises(DataFileError, match="shape"):
        read_trials(tmp_path, SETTINGS)


@pytest.mark.usefixtures("no_drawing")
def test_a_page_that_cannot_be_written_is_one_sentence(tmp_path):
    write_run(tmp_path, SETTINGS)
    (tmp_path / "figures").write_text("in the way")
    with pytest.raises(DataFileError, match="cannot write figures"):
        report(tmp_path)


def test_one_epoch_is_seen_and_named_by_a_whole_number():
    record = {"epoch": 1, "train_loss": 3e-5, "validation_loss": 1.5e-4, "learning_rate": 1e-3}
    losses, rate = figures.training_curves([record], narrow=False).axes
    assert all(line.get_marker() == "." for line in (*losses.lines, *rate.lines))
    low, high = rate.get_xlim()
    assert [tick for tick in rate.get_xticks() if low <= tick <= high] == [1.0]


@pytest.mark.parametrize(
    ("errors", "labels"),
    [
        ((0.3, 6.0), ["0.5", "1", "2", "5"]),
        ((2.0, 3.0), ["1", "2", "5", "10"]),
        ((1e-3, 50.0), ["0.001", "0.01", "0.1", "1", "10"]),
        ((1.2e-5, 9e-5), ["10⁻⁵", "2·10⁻⁵", "5·10⁻⁵", "10⁻⁴"]),
    ],
)
def test_a_logarithmic_axis_has_enough_labels(errors, labels):
    axes = Figure().subplots()
    axes.plot(errors)
    use_logarithm(axes)
    axes.figure.canvas.draw()
    low, high = axes.get_ylim()
    inside = [tick.get_text() for tick in axes.get_yticklabels() if low <= tick.get_position()[1] <= high]
    assert inside == labels
