"""Pictures of bodies: what is drawn where, in which colours,
and what is said where nothing can be drawn.
"""

import sys
from types import SimpleNamespace

import matplotlib.colors
import numpy as np
import pytest

from support.scenes import MARGIN, SHADE, TOWARDS_VIEWER, body_scene
from warp_resphys.core.mesh.boxes import box_hexahedra, box_tetrahedra
from warp_resphys.core.mesh.plotting import BODY
from warp_resphys.core.mesh.volume_mesh import Mesh, boundary_triangles
from warp_resphys.report import render
from warp_resphys.report.layers import OUTLINE, sharp_edges

MESHES = {
    "hexahedra": box_hexahedra(divisions=(3, 2, 2)),
    "tetrahedra": box_tetrahedra((0.1, 0.03, 0.03), (3, 2, 2)),
    "tetrahedra10": box_tetrahedra((0.1, 0.03, 0.03), (3, 2, 2), order=2),
}
VIEWER = np.asarray(TOWARDS_VIEWER) / np.linalg.norm(TOWARDS_VIEWER)


def shaded(normal: tuple[float, float, float]) -> np.ndarray:
    """(3,) colour of the body on a face that looks along a normal."""
    facing = max(
        0.0, float(np.dot(normal, render.TOWARDS_LIGHT) / np.linalg.norm(render.TOWARDS_LIGHT))
    )
    return np.asarray(matplotlib.colors.to_rgb(BODY)) * (1.0 - SHADE * (1.0 - facing))


def share(pixels: np.ndarray, colour: np.ndarray) -> float:
    """Share of the opaque pixels that have a colour, to within a hundredth."""
    opaque = pixels[pixels[..., 3] == 1.0][:, :3]
    return float(np.mean(np.all(np.abs(opaque - colour) < 0.01, axis=1)))


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())
def test_a_body_is_drawn_whole_to_scale_and_shaded(mesh: Mesh, renderer: render.Renderer) -> None:
    # Each visible face has one colour, in the share of the picture that it covers.
    # [m²]
    faces = {
        (1.0, 0.0, 0.0): 0.03 * 0.03,
        (0.0, -1.0, 0.0): 0.1 * 0.03,
        (0.0, 0.0, 1.0): 0.1 * 0.03,
    }
    covered = {normal: area * float(np.dot(normal, VIEWER)) for normal, area in faces.items()}
    (picture,) = render.draw(body_scene(mesh, views=2), renderer)
    pictures = np.split(picture / 255.0, 2, axis=1)
    for pixels in pictures:
        for normal, area in covered.items():
            expected = area / sum(covered.values())
            # Edges, outline.
            assert share(pixels, shaded(normal)) == pytest.approx(expected, abs=0.06)
        rows, columns = np.nonzero(pixels[..., 3] == 1.0)
        for seen, length in ((rows, pixels.shape[0]), (columns, pixels.shape[1])):
            margin = MARGIN * max(pixels.shape)
            assert seen.min() == pytest.approx(margin, abs=0.3 * margin)
            assert length - seen.max() == pytest.approx(margin, abs=0.3 * margin)
    first, second = pictures
    # A pixel may be rounded otherwise.
    assert np.mean(np.abs(first - second).max(axis=2) > 0.05) < 1e-5


@pytest.mark.usefixtures("can_draw")
def test_the_undeformed_outline_shows_where_the_body_has_left(renderer: render.Renderer) -> None:
    mesh = box_hexahedra(divisions=(3, 1, 1))
    (pixels,) = render.draw(body_scene(mesh, moved=(0.0, 0.0, 0.05)), renderer)
    pixels = pixels / 255.0
    assert share(pixels, np.asarray(matplotlib.colors.to_rgb(OUTLINE))) > 0.03


def test_sharp_edges_are_those_of_the_box_and_the_rim_of_a_part():
    mesh = box_hexahedra((0.1, 0.03, 0.03), (3, 2, 2))
    triangles = boundary_triangles(mesh)
    assert len(sharp_edges(mesh.vertices, triangles)) == 4 * (3 + 2 + 2)
    end = triangles[(mesh.vertices[triangles, 0] == 0.0).all(axis=1)]
    assert len(sharp_edges(mesh.vertices, end)) == 4 * 2


CRASH = "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"


@pytest.mark.parametrize(
    ("script", "time_out", "reason"),
    [
        (CRASH, 60.0, "Segmentation fault"),
        ("import no_such_renderer", 60.0, "No module named 'no_such_renderer'"),
        ("import time; time.sleep(60)", 0.1, "not done after 0.1 s"),
    ],
    ids=["crash", "import", "time-out"],
)
def test_why_nothing_can_be_drawn(tmp_path, monkeypatch, script, time_out, reason):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "modules"))
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "pyvista.py").write_text(script)
    monkeypatch.setattr(render, "TIME_OUT", time_out)
    if script == CRASH:  # A crash needs none of the program.
        monkeypatch.setattr(render, "COMMAND", (sys.executable, "-c", "import pyvista"))
    mesh = box_hexahedra(divisions=(1, 1, 1))
    scene = body_scene(mesh)
    with pytest.raises(render.DrawingError) as caught:
        render.draw(scene)
    assert reason in str(caught.value)
    assert "libegl1" in str(caught.value)
    if "time" in script:  # which needs no process to start
        with pytest.raises(render.DrawingError) as caught:
            render.write_film(tmp_path / "motion.mp4", scene)
        assert reason in str(caught.value)
        assert not [*tmp_path.glob("*.mp4*")]


@pytest.mark.usefixtures("can_draw")
def test_one_process_draws_scene_after_scene(renderer):
    mesh = box_hexahedra(divisions=(1, 1, 1))
    small = body_scene(mesh, longest=200)
    wide = body_scene(mesh, views=2, longest=200)
    first, both = (render.draw(scene, renderer)[0] for scene in (small, wide))
    process = renderer._process
    (again,) = render.draw(small, renderer)
    assert renderer._process is process
    renderer.close()
    (restarted,) = render.draw(small, renderer)
    assert process.poll() is not None
    assert renderer._process is not process
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, restarted)
    assert both.shape[1] == 2 * first.shape[1]


def test_a_film_that_cannot_be_encoded_says_so(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    scene = body_scene(box_hexahedra(divisions=(1, 1, 1)))
    drawn = SimpleNamespace(frames=lambda scene: iter([np.zeros((*scene.size[::-1], 3), np.uint8)]))
    with pytest.raises(render.DrawingError, match="imageio-ffmpeg"):
        render.write_film(tmp_path / "motion.mp4", scene, drawn)
    assert not [*tmp_path.iterdir()]
