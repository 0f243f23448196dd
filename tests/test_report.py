"""The report on a made-up run: a beam that swings, a wrong simulation of it, and a nearly right one."""

import base64
import dataclasses
import logging
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import matplotlib.colors
import matplotlib.image
import numpy as np
import pytest
from hydra import compose, initialize_config_module
from matplotlib import colormaps
from matplotlib.figure import Figure
from omegaconf import OmegaConf

from warp_resphys.errors import DataFileError, InputError
from warp_resphys.mesh import Mesh, box_hexahedra, box_tetrahedra
from warp_resphys.metrics import PUBLISHED_MM, summarise, summarise_each, trajectory_errors
from warp_resphys.report import figures, render
from warp_resphys.report.figures import use_logarithm
from warp_resphys.report.page import (
    Example,
    ReportData,
    duration_text,
    error_parts,
    number_text,
    verdict,
    worst_state,
    write_report,
)
from warp_resphys.tasks.report import kept_in_words, network_in_words

STEPS = 40
TIME_STEP = 0.01


def bending(mesh: Mesh, amplitude: float, period: float, offset: float = 0.0) -> np.ndarray:
    """(STEPS + 1, N, 3) positions [m] of a beam along x whose tip swings along z and comes to rest."""
    time = np.arange(STEPS + 1) * TIME_STEP
    tip = amplitude * np.exp(-3.0 * time) * np.cos(2.0 * np.pi * time / period) + offset * (time > 0.0)
    positions = np.repeat(mesh.vertices[None], STEPS + 1, axis=0)
    positions[..., 2] += tip[:, None] * (mesh.vertices[:, 0] / mesh.vertices[:, 0].max()) ** 2
    return positions


@pytest.fixture(scope="module")
def report_data() -> ReportData:
    mesh = box_hexahedra(divisions=(4, 1, 1))
    weights = (0.01, 0.02)
    target = [bending(mesh, weight, 0.14) for weight in weights]
    models = {
        "simulation": [bending(mesh, weight, 0.16) for weight in weights],
        "reconstruction": [bending(mesh, weight, 0.14, offset=1e-9) for weight in weights],
        "resphys": [bending(mesh, weight, 0.14, offset=2e-6) for weight in weights],
    }
    errors = {
        model: np.array([trajectory_errors(q, wanted) for q, wanted in zip(runs, target, strict=True)])
        for model, runs in models.items()
    }
    summaries = {model: summarise(rows) for model, rows in errors.items()}
    metrics = {
        "errors_mm": summaries,
        "errors_vs_reconstruction_mm": {model: summaries[model] for model in ("simulation", "resphys")},
        "per_trajectory": summarise_each(["0.07 kg", "0.12 <kg>"], errors),
        "seconds": {"generate": 12.0, "train": 75.4},
        "peak_memory_gib": 0.523,
        "versions": {"numpy": "9.9.9"},
        "device": "cpu",
    }
    epochs = np.arange(1, 30)
    records: list[dict[str, Any]] = [
        {
            "epoch": int(epoch),
            "train_loss": 1.0 / epoch,
            "validation_loss": 1.5 / epoch,
            "rollout_error_mm": 0.1 / epoch if epoch % 5 == 0 else None,
            "learning_rate": 1e-3,
        }
        for epoch in epochs
    ]
    return ReportData(
        experiment="beam_oscillation",
        title="Oscillating beam",
        simulator="E 215 kPa",
        reality="E 264 kPa",
        metrics=metrics,
        settings={"material": {"youngs_modulus": 215e3}, "mesh": {"divisions": [4, 1, 1]}, "seed": None},
        published=PUBLISHED_MM["beam_oscillation"],
        published_note="The published masses differ.",
        time_step=TIME_STEP,
        mesh=mesh,
        tip=np.flatnonzero(mesh.vertices[:, 0] > 0.0999),
        example=Example("0.12 kg", target[1], models["simulation"][1], models["resphys"][1]),
        errors_mm=errors,
        training=records,
    )


@pytest.fixture(scope="module")
def why_no_drawing() -> str:
    """Why bodies cannot be drawn on this machine; empty where they can."""
    mesh = box_hexahedra(divisions=(1, 1, 1))
    try:
        render.draw_bodies(mesh, {"box": mesh.vertices}, mesh.vertices)
    except render.DrawingError as error:
        return str(error)
    return ""


@pytest.fixture
def can_draw(why_no_drawing: str) -> None:
    if why_no_drawing:
        pytest.skip(why_no_drawing)


@pytest.fixture(scope="module")
def report(report_data: ReportData, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "new" / "report.html"
    write_report(path, report_data)
    return path


class Page(HTMLParser):
    """What a page refers to, its images' descriptions, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")]
        if tag == "img":
            self.images.append(dict(attrs))

    def handle_data(self, data: str) -> None:
        self.text += data


def test_page_needs_nothing_beside_it(report: Path, why_no_drawing: str) -> None:
    source = report.read_text(encoding="utf-8")
    page = Page(source)
    assert len(page.images) == (3 if why_no_drawing else 4)
    assert page.links
    assert all(link.startswith("data:") for link in page.links)
    assert re.search(r"https?://|url\(|@import|<script", source) is None
    for link in page.links:
        if link.startswith("data:image/svg+xml;base64,"):
            svg = base64.b64decode(link.partition(",")[2]).decode()
            assert svg.startswith("<svg")
            assert re.search(r'href="(?!#|data:)', svg) is None


def test_page_says_how_far_and_stands_beside_the_published_numbers(report: Path, report_data: ReportData) -> None:
    text = " ".join(Page(report.read_text(encoding="utf-8")).text.replace("\u00a0", " ").split())
    for model in ("simulation", "reconstruction", "resphys"):
        mean, deviation = error_parts(report_data.metrics["errors_mm"][model])
        assert f"{mean} {deviation}" in text
    simulated, corrected = (
        number_text(report_data.metrics["errors_mm"][model]["mean"]) for model in ("simulation", "resphys")
    )
    assert f"falls from {simulated} mm to {corrected} mm. The published result is 0.004 mm." in text
    for published in ("4.488 ± 1.468", "0.035 ± 0.070", "0.004 ± 0.010", "The published masses differ."):
        assert published in text
    for said in (
        "0.12 <kg>",
        "1 min 15 s",
        "1 min 27 s",
        "numpy 9.9.9",
        "material.youngs_modulus",
        "[4, 1, 1]",
    ):
        assert said in text


def test_every_image_is_described(report: Path) -> None:
    for image in Page(report.read_text(encoding="utf-8")).images:
        assert len(image["alt"] or "") > 40


def test_figures_are_written_and_show_something(report: Path, why_no_drawing: str) -> None:
    written = {path.stem: matplotlib.image.imread(path) for path in (report.parent / "figures").glob("*.png")}
    shape = set() if why_no_drawing else {"shape"}
    assert set(written) == {"tip_displacement", "error_over_time", "training"} | shape
    for pixels in written.values():
        assert pixels.shape[1] == round(200 * figures.WIDE)
        assert pixels[..., :3].std() > 0.02
    assert not list(report.parent.glob("*.part*"))


def test_the_same_run_gives_the_same_page(report: Path, report_data: ReportData, tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", report_data)
    assert (tmp_path / "report.html").read_bytes() == report.read_bytes()


def test_a_diverged_rollout_is_said_and_does_not_hide_the_rest(
    report_data: ReportData, tmp_path: Path, why_no_drawing: str
) -> None:
    corrected = report_data.example.resphys.copy()
    corrected[5:9] *= 1e200
    corrected[9:] = np.nan
    rows = report_data.errors_mm["resphys"].copy()
    rows[1, 4:8] *= 1e200
    rows[1, 8:] = np.nan
    errors = {**report_data.errors_mm, "resphys": rows}
    metrics = {
        **report_data.metrics,
        "errors_mm": {model: summarise(each) for model, each in errors.items()},
        "per_trajectory": summarise_each(["a", "b"], errors),
    }
    example = dataclasses.replace(report_data.example, resphys=corrected)
    write_report(
        tmp_path / "report.html",
        dataclasses.replace(report_data, metrics=metrics, errors_mm=errors, example=example, training=[]),
    )
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "1 of 2 diverged" in page.text
    assert "1 of 2 test roll-outs diverged" in page.text.replace("\u00a0", " ")
    assert len(page.images) == (2 if why_no_drawing else 3)  # Nothing was trained.


def test_refinement_and_networks_are_named(report_data: ReportData, tmp_path: Path, why_no_drawing: str) -> None:
    refinement = [
        {
            "epoch": epoch,
            "train_loss": 1e-6 / (1 + epoch),
            "validation_loss": None,
            "rollout_error_mm": 1e-3 / (1 + epoch),
        }
        for epoch in range(4)
    ]
    data = dataclasses.replace(report_data, refinement=refinement, network_note="Net <1>.", kept_note="Epoch 3.")
    write_report(tmp_path / "report.html", data)
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "Net <1>." in page.text
    assert "Epoch 3." in page.text
    assert len(page.images) == (4 if why_no_drawing else 5)
    assert (tmp_path / "figures" / "refinement.png").exists()


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
    said = kept_in_words({"resphys": kept, "refinement": worse})
    assert said == f"{first} No epoch of the refinement was better: the weights are those from before it."
    assert kept_in_words({"resphys": kept, "refinement": better}).endswith(
        "Taken in the end: epoch 4 of the refinement; its mean roll-out error on the validation split is 0.125 mm."
    )


def test_errors_of_exactly_zero_are_a_report(report_data: ReportData, tmp_path: Path, why_no_drawing: str) -> None:
    errors = {model: np.zeros((2, STEPS)) for model in report_data.errors_mm}
    metrics = {
        **report_data.metrics,
        "errors_mm": {model: summarise(each) for model, each in errors.items()},
        "per_trajectory": summarise_each(["a", "b"], errors),
    }
    target = report_data.example.target
    data = dataclasses.replace(
        report_data,
        metrics=metrics,
        errors_mm=errors,
        example=dataclasses.replace(report_data.example, simulation=target, resphys=target),
        training=[{"epoch": 1, "train_loss": 0.0, "validation_loss": 0.0, "rollout_error_mm": 0.0}],
    )
    write_report(tmp_path / "report.html", data)
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "0.000 ± 0.000" in page.text.replace("\u00a0", " ")
    assert len(page.images) == (3 if why_no_drawing else 4)
    svgs = [base64.b64decode(link.partition(",")[2]).decode() for link in page.links if "svg+xml" in link]
    assert sum("zero, or diverged, throughout" in svg for svg in svgs) >= 3


def test_a_model_without_error_does_not_hide_the_others() -> None:
    rows = np.full((2, 5), 0.5)
    figure = figures.error_over_time({"simulation": rows, "resphys": 0.0 * rows}, TIME_STEP, narrow=False)
    (axes,) = figure.axes
    low, high = axes.get_ylim()
    assert axes.get_yscale() == "log"
    assert low <= 0.5 <= high
    assert not axes.texts


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ([4.5], [0.5], "9.0 times closer"),
        ([4.5], [0.0], "all the way to its target"),
        ([1.0], [1.1], "does not help: the mean vertex error on 1 test trajectories is 1.100 mm with it"),
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
    assert said in verdict(errors, {}, "wrong", "right").replace("\u00a0", " ")


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


def test_the_picture_is_taken_where_the_simulation_is_worst(report_data: ReportData) -> None:
    simulated = report_data.example.target.copy()
    simulated[7] += 0.01
    simulated[9:] = np.nan
    assert worst_state(dataclasses.replace(report_data.example, simulation=simulated)) == 7


def test_arrays_that_do_not_fit_are_refused(report_data: ReportData) -> None:
    with pytest.raises(InputError, match="resphys trajectory"):
        dataclasses.replace(report_data, example=dataclasses.replace(report_data.example, resphys=np.zeros((3, 4, 3))))
    with pytest.raises(InputError, match="errors of simulation"):
        dataclasses.replace(report_data, errors_mm={"simulation": np.zeros(3)})


def test_a_page_that_cannot_be_written_is_one_sentence(report_data: ReportData, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DataFileError, match="cannot write figures"):
        write_report(tmp_path / "file" / "report.html", report_data)


@pytest.mark.parametrize(
    ("script", "time_out", "reason"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", 60.0, "Segmentation fault"),
        ("import no_such_renderer", 60.0, "No module named 'no_such_renderer'"),
        ("import time; time.sleep(60)", 0.1, "not done after 0.1 s"),
    ],
    ids=["crash", "import", "time-out"],
)
def test_a_body_that_cannot_be_drawn_is_said_and_does_not_hide_the_rest(
    report_data: ReportData,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    script: str,
    time_out: float,
    reason: str,
) -> None:
    monkeypatch.setattr(render, "COMMAND", (sys.executable, "-c", script))
    monkeypatch.setattr(render, "TIME_OUT", time_out)
    stale = tmp_path / "figures" / "shape.png"
    stale.parent.mkdir()
    stale.write_bytes(b"of an earlier run")
    with caplog.at_level(logging.WARNING):
        write_report(tmp_path / "report.html", report_data)
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    for said in (page.text, caplog.text):
        assert "cannot draw the deformed body on this machine (" in said
        assert reason in said
        assert "libegl1" in said
    assert len(page.images) == 3
    written = {path.stem for path in stale.parent.iterdir()}
    assert written == {"tip_displacement", "error_over_time", "training"}


MESHES = {
    "hexahedra": box_hexahedra(divisions=(3, 2, 2)),
    "tetrahedra": box_tetrahedra((0.1, 0.03, 0.03), (3, 2, 2)),
    "tetrahedra10": box_tetrahedra((0.1, 0.03, 0.03), (3, 2, 2), order=2),
}
TOWARDS_VIEWER = np.asarray(render.TOWARDS_VIEWER) / np.linalg.norm(render.TOWARDS_VIEWER)


def draw(mesh: Mesh, errors: np.ndarray, count: int = 1) -> list[np.ndarray]:
    """(H, W, 4) pictures of the undeformed body, with (N,) errors [m] along x."""
    target = mesh.vertices - errors[:, None] * [1.0, 0.0, 0.0]
    bodies = render.draw_bodies(mesh, {str(each): mesh.vertices for each in range(count)}, target)
    drawn = [body for body in bodies.values() if body]
    assert [body.largest for body in drawn] == pytest.approx([errors.max()] * count, rel=1e-6)
    return [body.pixels for body in drawn]


def shaded(value: float, normal: tuple[float, float, float]) -> np.ndarray:
    """(3,) colour of a value in [0, 1] on a face that looks along a normal."""
    facing = max(0.0, float(np.dot(normal, render.TOWARDS_LIGHT) / np.linalg.norm(render.TOWARDS_LIGHT)))
    return np.asarray(colormaps[render.COLOUR_MAP](value)[:3]) * (1.0 - render.SHADE * (1.0 - facing))


def share(pixels: np.ndarray, colour: np.ndarray) -> float:
    """Share of the opaque pixels that have a colour, to within a hundredth."""
    opaque = pixels[pixels[..., 3] == 1.0][:, :3]
    return float(np.mean(np.all(np.abs(opaque - colour) < 0.01, axis=1)))


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())
def test_a_body_is_drawn_whole_to_scale_and_in_the_colours_of_the_scale(mesh: Mesh) -> None:
    # With one error everywhere each visible face has one colour, in the share of the picture that it covers.
    faces = {(1.0, 0.0, 0.0): 0.03 * 0.03, (0.0, -1.0, 0.0): 0.1 * 0.03, (0.0, 0.0, 1.0): 0.1 * 0.03}  # [m²]
    covered = {normal: area * float(np.dot(normal, TOWARDS_VIEWER)) for normal, area in faces.items()}
    pictures = draw(mesh, np.full(len(mesh.vertices), 1e-3), count=2)
    for pixels in pictures:
        for normal, area in covered.items():
            expected = area / sum(covered.values())
            assert share(pixels, shaded(1.0, normal)) == pytest.approx(expected, abs=0.06)  # Edges, outline.
        rows, columns = np.nonzero(pixels[..., 3] == 1.0)
        for seen, length in ((rows, pixels.shape[0]), (columns, pixels.shape[1])):
            margin = render.MARGIN * max(pixels.shape)
            assert seen.min() == pytest.approx(margin, abs=0.3 * margin)
            assert length - seen.max() == pytest.approx(margin, abs=0.3 * margin)
    np.testing.assert_array_equal(*pictures)


@pytest.mark.usefixtures("can_draw")
def test_colours_are_where_the_errors_are_and_what_stands_before_hides_what_is_behind() -> None:
    mesh = box_hexahedra((0.1, 0.03, 0.03), (1, 1, 1))
    low, high = (shaded(value, (0.0, -1.0, 0.0)) for value in (0.0, 1.0))
    (pixels,) = draw(mesh, np.where(mesh.vertices[:, 0] > 0.05, 1e-3, 0.0))
    middle = pixels[pixels.shape[0] // 2, :, :3]
    np.testing.assert_allclose(middle[round(0.04 * len(middle))], low, atol=0.05)
    np.testing.assert_allclose(middle[round(0.86 * len(middle))], high, atol=0.12)

    hidden = np.all(mesh.vertices == [0.0, 0.03, 0.0], axis=1)  # The corner behind the three visible faces.
    (pixels,) = draw(mesh, np.where(hidden, 1e-3, 0.0))
    assert share(pixels, low) > 0.4
    assert pixels[pixels[..., 3] == 1.0][:, 0].max() < 0.55  # Dark violet and the grey outline.


@pytest.mark.usefixtures("can_draw")
def test_the_undeformed_outline_shows_where_the_body_has_left() -> None:
    mesh = box_hexahedra(divisions=(3, 1, 1))
    moved = mesh.vertices + [0.0, 0.0, 0.05]
    body = render.draw_bodies(mesh, {"moved": moved}, moved)["moved"]
    assert body is not None
    assert share(body.pixels, np.asarray(matplotlib.colors.to_rgb(render.OUTLINE))) > 0.03


def test_only_what_has_not_diverged_is_drawn() -> None:
    mesh = box_hexahedra(divisions=(1, 1, 1))
    diverged = {"far": mesh.vertices + 2.0, "gone": np.full_like(mesh.vertices, np.nan)}
    assert render.draw_bodies(mesh, diverged, mesh.vertices) == {"far": None, "gone": None}


@pytest.mark.parametrize(
    ("errors", "labels"),
    [
        ((0.3, 6.0), ["0.5", "1", "2", "5"]),
        ((2.0, 3.0), ["1", "2", "5", "10"]),
        ((1e-3, 50.0), ["0.001", "0.01", "0.1", "1", "10"]),
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
