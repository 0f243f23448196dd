"""The bodies in space on a report's page: what the script reads, and the page in a browser."""

import base64
import json
import re

import numpy as np
import pytest

from support.browser import opened as browser_of_tests
from support.browser import until
from support.made_up_run import arm_settings, vertex_settings, write_arm_run, write_vertex_run
from support.report_page import FAILING, Page, report, skip_figures
from warp_resphys import Body, Contact, box_hexahedra
from warp_resphys.core.energies.contact.obstacle_surface import ObstacleSurface
from warp_resphys.core.mesh.volume_mesh import boundary_triangles
from warp_resphys.energies import Capsule, Sphere
from warp_resphys.report import render
from warp_resphys.report.body_motions import ComparedMotion
from warp_resphys.report.layers import OBSTACLE
from warp_resphys.report.motion_section import reduced, view_in_space

RUNS = {"markers": (write_arm_run, arm_settings), "vertices": (write_vertex_run, vertex_settings)}


def decoded(text, kind):
    return np.frombuffer(base64.b64decode(text), dtype=kind)


def swinging(frames=40, models=("simulation", "resphys")):
    """A box whose end swings, more with the first model than with the second."""
    mesh = box_hexahedra((0.1, 0.02, 0.02), divisions=(6, 2, 2))
    times = 0.05 * np.arange(frames)
    along = mesh.vertices[:, 0] / 0.1
    shape = np.stack([0.0 * along, 0.0 * along, along**2], axis=1)
    each = {
        model: mesh.vertices + 0.02 * (k + 1) * np.sin(7.0 * times)[:, None, None] * shape
        for k, model in enumerate(reversed(models))
    }
    positions = {model: each[model] for model in models}
    some = [0, len(mesh.vertices) - 1]
    target = mesh.vertices + 0.01 * np.sin(7.0 * times)[:, None, None] * shape
    markers = {model: q[:, some] for model, q in positions.items()}
    gravity = np.array([0.0, 0.0, -9.81])
    return ComparedMotion(
        mesh, times, target[:, some], positions, markers, mesh.vertices[some], gravity
    ), target


def corners(data):
    """(T, P, 3) corners of the obstacles, as the script of the page computes them."""
    owners, local = decoded(data["owners"], "<u4"), decoded(data["obstacles"], "<f4").reshape(-1, 3)
    poses = decoded(data["poses"], "<f4").reshape(-1, owners[-1] + 1, 12)[:, owners]
    return (
        poses[..., :3] + (poses[..., 3:].reshape(*poses.shape[:2], 3, 3) @ local[..., None])[..., 0]
    )


def test_the_scenes_of_a_motion_have_its_obstacles_where_they_are_in_each_frame():
    motion, _ = swinging()
    obstacles = {"floor": Sphere(position=(0.0, 0.0, -0.2), radius=0.05)}
    obstacles["bar"] = Capsule(
        position=(0.05, 0.01, -0.1), axis=(1.0, 0.0, 0.0), radius=0.01, length=0.05, moves=True
    )
    inputs = {
        "obstacle_move_z": np.outer(0.1 * motion.times, [0.0, 1.0]),
        "obstacle_rotate_z": np.outer(motion.times, [0, 1]),
    }
    surface = ObstacleSurface.of(Body(motion.mesh, energies=[Contact(obstacles)])).moved(inputs)
    motion = ComparedMotion(**{**vars(motion), "obstacles": surface})
    bar = surface.owners == 1
    assert np.ptp(surface.points[:, bar, 2].mean(axis=1)) > 0.03
    for scene, frames in ((motion.scene(), motion.instants), (motion.film(), slice(None))):
        for view in scene.views:
            (drawn,) = (
                layer
                for layer in view.layers
                if layer.kind == "surface" and layer.colour == OBSTACLE
            )
            assert np.isin(drawn.points, surface.points[frames]).all()
            assert len(drawn.points) == len(
                next(layer for layer in view.layers if layer.points.ndim == 3).points
            )
    data = json.loads(str(view_in_space("view", motion, ["resphys"], "caption", "alt").payload))
    np.testing.assert_allclose(corners(data), surface.points, atol=1e-7)
    np.testing.assert_array_equal(decoded(data["sides"], "<u4").reshape(-1, 3), surface.triangles)


@pytest.mark.parametrize("every_vertex", [False, True])
def test_what_the_script_reads_are_the_bodies(every_vertex):
    motion, target = swinging()
    motion = ComparedMotion(**{**vars(motion), "target": target if every_vertex else None})
    motion.positions["simulation"][30:] = np.nan
    block = view_in_space("view", motion, ["resphys"], "caption", "alt")
    data = json.loads(str(block.payload))
    surface = np.unique(boundary_triangles(motion.mesh))
    basis = (
        decoded(data["modes"], "<i2").reshape(len(data["scales"]), -1)
        * np.array(data["scales"])[:, None]
    )
    weights = decoded(data["weights"], "<f4").reshape(2, 40, -1)
    rest = decoded(data["rest"], "<f4").reshape(-1, 3)
    places = rest + (weights @ basis).reshape(2, 40, -1, 3)
    faces = decoded(data["faces"], "<u4").reshape(-1, 3)
    np.testing.assert_allclose(
        rest[faces], motion.mesh.vertices[boundary_triangles(motion.mesh)], atol=1e-8
    )
    for place, q in zip(places, motion.positions.values(), strict=True):
        np.testing.assert_allclose(place, q[:, surface], atol=2.5e-4 * 0.1)
    expected = target if every_vertex else motion.measured
    compared = motion.positions if every_vertex else motion.markers
    for model, name in zip(data["models"], motion.positions, strict=True):
        away = 1e3 * np.linalg.norm(compared[name] - expected, axis=2)
        drawn = np.isfinite(motion.positions[name]).all(axis=(1, 2))
        assert model["largest"] == pytest.approx(away[drawn].max(), rel=1e-3)
        means = np.array([np.nan if mean is None else mean for mean in model["means"]])
        np.testing.assert_allclose(means, away.mean(axis=1), rtol=1e-3)
    if every_vertex:
        shares = decoded(data["errors"], "u1").reshape(2, 40, -1) / 255
        away = 1e3 * np.linalg.norm(
            motion.positions["resphys"][:, surface] - target[:, surface], axis=2
        )
        np.testing.assert_allclose(
            shares[1] * data["models"][1]["largest"], away, atol=away.max() / 400
        )
    assert [model["shown"] for model in data["models"]] == [False, True]


def test_a_basis_is_as_small_as_it_may_be():
    random = np.random.default_rng(3)
    shapes, weights = random.normal(size=(3, 30)), random.normal(size=(2, 20, 3))
    displacements = (weights @ shapes).reshape(2, 20, 10, 3)
    displacements[1, 7:] = np.nan
    basis, weights = reduced(displacements, 1e-9, 20)
    assert basis.shape == (3, 30)
    np.testing.assert_allclose((weights @ basis).reshape(2, 20, 10, 3), displacements, atol=1e-9)
    # Whatever moves so little still says where it is known.
    basis, weights = reduced(displacements, 1e9, 20)
    np.testing.assert_array_equal(basis, np.zeros((1, 30)))
    assert np.isfinite(weights[0]).all()
    assert np.isnan(weights[1, 7:]).all()
    assert reduced(displacements, 0.0, 2)[0].shape == (2, 30)


@pytest.fixture(scope="module")
def browser():
    with browser_of_tests() as browser:
        yield browser


@pytest.fixture(scope="module", params=RUNS)
def page(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    write, settings = RUNS[request.param]
    config = settings()
    write(folder, config)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render, "COMMAND", FAILING)  # Nothing else is drawn, which takes seconds.
        skip_figures(patch)
        report(folder, config)
    return folder / "report.html"


def opened(browser, page, width, dark):
    """The view on the page, at a width, after its first picture."""
    from selenium.webdriver.common.by import By

    metrics = {
        "width": width,
        "height": 900,
        "deviceScaleFactor": 2 if width < 600 else 1,
        "mobile": width < 600,
    }
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
    browser.get(page.as_uri())
    view = browser.find_element(By.ID, "view")
    browser.execute_script("arguments[0].scrollIntoView()", view)
    until(lambda: view.get_attribute("data-drawn"))
    return view


def drawn(browser, view):
    """(H, W, 3) pixels of the canvas after what was asked of it is drawn."""
    import io

    from matplotlib.image import imread

    script = """const done = arguments[arguments.length - 1], view = arguments[0].view;
        requestAnimationFrame(() => requestAnimationFrame(() => done(view.canvas.toDataURL())));"""
    address = browser.execute_async_script(script, view)
    return imread(io.BytesIO(base64.b64decode(address.partition(",")[2])), format="png")[..., :3]


@pytest.mark.parametrize(("width", "dark"), [(1100, False), (390, True)])
def test_the_view_is_turned_played_and_compared(browser, page, width, dark):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    view = opened(browser, page, width, dark)
    canvas, clock = (view.find_element(By.CSS_SELECTOR, which) for which in ("canvas", ".clock"))
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    first = drawn(browser, view)
    paper = np.array([0x14, 0x18, 0x1D] if dark else [255, 255, 255]) / 255
    assert np.abs(first[4, 4] - paper).max() < 0.01
    body = np.abs(first - paper).max(axis=2) > 0.05
    assert 0.02 < body.mean() < 0.7
    rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    assert min(rows[0], columns[0]) > 0
    assert rows[-1] < len(first) - 1
    assert columns[-1] < first.shape[1] - 1

    ActionChains(browser).drag_and_drop_by_offset(canvas, 60, 20).perform()
    turned = drawn(browser, view)
    assert np.abs(turned - first).max(axis=2).mean() > 0.01
    canvas.send_keys("0")
    np.testing.assert_allclose(drawn(browser, view), first, atol=0.02)
    canvas.send_keys("+")
    assert (np.abs(drawn(browser, view) - paper).max(axis=2) > 0.05).mean() > body.mean()
    canvas.send_keys("-", "0", Keys.ARROW_LEFT)
    assert np.abs(drawn(browser, view) - first).max(axis=2).mean() > 0.005
    canvas.send_keys("0", ".", ".")
    later = drawn(browser, view)
    assert clock.text != "0.00 s"
    assert np.abs(later - first).max(axis=2).max() > 0.2

    button = view.find_element(By.CLASS_NAME, "play")
    button.click()
    assert button.get_attribute("aria-label") == "Pause"
    before = clock.text
    until(lambda: clock.text != before)
    button.click()
    assert button.get_attribute("aria-label") == "Play"
    slider = view.find_element(By.CLASS_NAME, "time")
    browser.execute_script(
        "arguments[0].value = 500; arguments[0].dispatchEvent(new Event('input'))", slider
    )
    drawn(browser, view)
    at, end = (
        float(number) for number in re.findall(r"\d+\.\d+", slider.get_attribute("aria-valuetext"))
    )
    assert at == pytest.approx(end / 2, abs=0.011)
    assert clock.text == f"{at:.2f} s"

    legend = view.find_element(By.CLASS_NAME, "legend")
    assert not legend.is_displayed()
    plain = drawn(browser, view)
    view.find_element(By.NAME, "errors").click()
    assert np.abs(drawn(browser, view) - plain).max(axis=2).max() > 0.2
    assert legend.is_displayed()
    assert legend.text.endswith("mm")
    boxes = view.find_elements(By.CSS_SELECTOR, ".models input")
    shown = view.find_elements(By.CSS_SELECTOR, ".models output")
    assert len(boxes) == len(shown) > 2
    assert all(output.text.endswith(" mm") for output in shown)
    for box in boxes:
        if box.is_selected():
            box.click()
    if markers := view.find_elements(By.NAME, "markers"):
        markers[0].click()
    assert np.abs(drawn(browser, view) - paper).max() < 0.01
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def test_a_browser_without_webgl_says_so(browser, page):
    from selenium.webdriver.common.by import By

    source = "HTMLCanvasElement.prototype.getContext = () => null"
    added = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": source})
    try:
        browser.get(page.as_uri())
        view = browser.find_element(By.ID, "view")
        assert "no WebGL 2" in view.find_element(By.CLASS_NAME, "failed").text
        assert not view.find_element(By.CSS_SELECTOR, "canvas").is_displayed()
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)


def test_the_script_places_obstacles_between_frames(browser, page):
    """The floor stays where it is; the bar is halfway between two frames."""
    floor, bar = Sphere(position=(0.0, 0.0, -0.2), radius=0.05), Sphere(radius=0.01, moves=True)
    body = Body(
        box_hexahedra((0.1, 0.02, 0.02), (2, 1, 1)),
        energies=[Contact({"floor": floor, "bar": bar})],
    )
    surface = ObstacleSurface.of(body, {"obstacle_x": 0.2})
    moved = surface.moved({"obstacle_move_z": np.outer([0.0, 0.1, 0.4], [0.0, 1.0])})
    view = opened(browser, page, 1100, False)
    script = """const [figure, obstacles, owners, poses] = arguments;
        const around = new Float32Array(obstacles.length), data = {times: [0, 1, 2]};
        const own = Object.create(Object.getPrototypeOf(figure.view));
        return [...Object.assign(own, {obstacles, owners, poses, around, data}).placed(1.5)];"""
    for own, expected in ((surface, surface.points), (moved, moved.points[1:].mean(axis=0))):
        arrays = [values.ravel().tolist() for values in (own.local, own.owners, own.poses)]
        placed = np.reshape(browser.execute_script(script, view, *arrays), (-1, 3))
        np.testing.assert_allclose(placed, expected, atol=1e-7)


def test_the_page_stays_small(page):
    written = Page(page)
    assert sum(len(data) for data in written.data) < 1_000_000
    assert len(written.scripts[0]) < 25_000
