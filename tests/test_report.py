"""The report on a made-up run: a beam that swings, a wrong simulation of it, and a nearly right one."""

import base64
import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from warp_resphys.errors import DataFileError, InputError
from warp_resphys.mesh import Mesh, box_hexahedra, box_tetrahedra
from warp_resphys.metrics import PUBLISHED_MM, summarise, summarise_each, trajectory_errors
from warp_resphys.report import figures, render
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


def test_page_needs_nothing_beside_it(report: Path) -> None:
    source = report.read_text(encoding="utf-8")
    page = Page(source)
    assert len(page.images) == 4
    assert page.links
    assert all(link.startswith("data:") for link in page.links)
    assert re.search(r"https?://|url\(|@import|<script", source) is None
    for link in page.links:
        if link.startswith("data:image/svg+xml;base64,"):
            svg = base64.b64decode(link.partition(",")[2]).decode()
            assert svg.startswith("<svg")
            assert re.search(r'href="(?!#|data:)', svg) is None


def test_page_says_how_far_and_stands_beside_the_published_numbers(
    report: Path, report_data: ReportData
) -> None:
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


def test_figures_are_written_and_show_something(report: Path) -> None:
    written = {path.stem: matplotlib.image.imread(path) for path in (report.parent / "figures").glob("*.png")}
    assert set(written) == {"tip_displacement", "shape", "error_over_time", "training"}
    for pixels in written.values():
        assert pixels.shape[1] == round(200 * figures.WIDE)
        assert pixels[..., :3].std() > 0.02
    assert list(report.parent.iterdir()) != []
    assert not list(report.parent.glob("*.part"))


def test_the_same_run_gives_the_same_page(report: Path, report_data: ReportData, tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", report_data)
    assert (tmp_path / "report.html").read_bytes() == report.read_bytes()


def test_a_diverged_rollout_is_said_and_does_not_hide_the_rest(
    report_data: ReportData, tmp_path: Path
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
    assert len(page.images) == 3  # Nothing was trained.


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
        dataclasses.replace(
            report_data, example=dataclasses.replace(report_data.example, resphys=np.zeros((3, 4, 3)))
        )
    with pytest.raises(InputError, match="errors of simulation"):
        dataclasses.replace(report_data, errors_mm={"simulation": np.zeros(3)})


def test_a_page_that_cannot_be_written_is_one_sentence(report_data: ReportData, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DataFileError, match="cannot write the report"):
        write_report(tmp_path / "file" / "report.html", report_data)


MESHES = {
    "hexahedra": box_hexahedra(divisions=(3, 2, 2)),
    "tetrahedra": box_tetrahedra((0.1, 0.03, 0.03), (3, 2, 2)),
    "tetrahedra10": box_tetrahedra((0.1, 0.03, 0.03), (3, 2, 2), order=2),
}


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())
def test_surface_pieces_cover_the_boundary_and_face_outwards(mesh: Mesh) -> None:
    surface = render.Surface.of(mesh)
    pieces = surface.interpolate(mesh.vertices)[:, surface.pieces].reshape(-1, surface.pieces.shape[1], 3)
    centre = mesh.vertices.mean(axis=0)
    areas, volumes = 0.0, 0.0
    for corner in range(1, pieces.shape[1] - 1):
        normal = np.cross(pieces[:, corner] - pieces[:, 0], pieces[:, corner + 1] - pieces[:, 0]) / 2.0
        areas += np.linalg.norm(normal, axis=1).sum()
        volumes += np.einsum("pc,pc->", normal, pieces[:, 0] - centre) / 3.0
    assert areas == pytest.approx(2 * (0.03 * 0.03 + 2 * 0.1 * 0.03))
    assert volumes == pytest.approx(0.1 * 0.03 * 0.03)
    linear = mesh.vertices @ [[1.0], [2.0], [3.0]]  # Shape functions reproduce linear functions.
    np.testing.assert_allclose(
        surface.interpolate(linear), surface.interpolate(mesh.vertices) @ [[1.0], [2.0], [3.0]], atol=1e-15
    )
    owners = surface.pieces[surface.rim_owners]
    assert all(set(rim) <= set(piece) for rim, piece in zip(surface.rims, owners, strict=True))


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())
def test_outline_is_the_twelve_edges_of_the_box(mesh: Mesh) -> None:
    outline = render.Surface.of(mesh).outline(mesh.vertices)
    assert np.linalg.norm(outline[:, 1] - outline[:, 0], axis=1).sum() == pytest.approx(
        4 * (0.1 + 0.03 + 0.03)
    )


def test_ten_node_faces_are_curved() -> None:
    mesh = box_tetrahedra((0.1, 0.03, 0.03), (1, 1, 1), order=2)
    surface = render.Surface.of(mesh)
    squared = mesh.vertices**2  # Quadratic shape functions reproduce it, linear ones do not.
    np.testing.assert_allclose(
        surface.interpolate(squared), surface.interpolate(mesh.vertices) ** 2, atol=1e-15
    )


def test_what_stands_before_hides_what_is_behind() -> None:
    # The face x = 0.1 of the box is turned to the viewer, the face x = 0 away: its colour must not be seen.
    mesh = box_hexahedra((0.1, 0.03, 0.03), (1, 1, 1))
    colours = np.where(mesh.vertices[:, [0]] > 0.05, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    surface = render.Surface.of(mesh)
    view = render.View.around(mesh.vertices)
    figure = Figure(figsize=(3.0, 3.0 / view.aspect), dpi=100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    render.paint(axes, view, surface, mesh.vertices, colours, np.zeros((0, 2, 3)), "black")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3] / 255.0

    def seen_at(point: tuple[float, float, float]) -> np.ndarray:
        share = (np.asarray(point) @ view.axes[:2].T - view.lower) / (view.upper - view.lower)
        return pixels[round((1.0 - share[1]) * len(pixels)), round(share[0] * pixels.shape[1])]

    assert seen_at((0.1, 0.015, 0.015))[2] > 0.5
    assert seen_at((0.1, 0.015, 0.015))[0] < 0.05
    assert seen_at((0.005, 0.0, 0.015))[0] > 0.5
    middle = seen_at((0.05, 0.0, 0.012))
    assert middle[0] == pytest.approx(middle[2], abs=0.08)
