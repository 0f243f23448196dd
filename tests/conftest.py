import contextlib
import functools
import gc
import os
import re

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported, as the command does

import weakref
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import hydra
import pytest
import torch
import warp as wp
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigSource
from omegaconf import OmegaConf

from support.command_line import enable_loggers
from support.devices import device
from support.main_job import IN_RUN, TINY, files, run, without_reports
from support.scenes import body_scene
from warp_resphys import overrides
from warp_resphys.core.mesh import readers
from warp_resphys.core.mesh.boxes import box_hexahedra
from warp_resphys.data.recordings import recording_files
from warp_resphys.io import atomic, decoding
from warp_resphys.io.settings import Settings
from warp_resphys.report import figures, render

wp.config.log_level = wp.LOG_WARNING
wp.init()
torch.set_num_threads(1)
gc.freeze()  # A collection passes over what is imported, and comes less often.
gc.set_threshold(10_000, 10, 10)

# Modules of tests that are repeated as on other processors. Their results come from code of
# libraries that differs between processors, and from decisions on its last digits: decompositions,
# iterations that end at a threshold, searches that turn back or compare costs, trainings, and
# orders of nearly equal values. Warp compiles kernels for the processor that there is: energies,
# elements, contact and errors are kernels or closed formulas, and refused input has no digits.
# Functions that only call what is tested here (`test_library`, `test_sessions`) add none.
NUMERICAL = {
    # decompositions and iterations of systems
    *("test_least_squares", "test_linear_solver", "test_pardiso"),
    # factors in steps
    *("test_corotation", "test_gradients", "test_integrator", "test_linearisation", "test_modes"),
    *("test_nonlinear_solver", "test_safeguards"),  # line searches, failures
    # least squares of forces and of starts
    *("test_force_sensors", "test_reconstruction", "test_replay"),
    # searches of parameters, and their covariances
    *("test_identification", "test_placement", "test_sensitivity"),
    # selection of terms, classes and samples
    *("test_law", "test_material_tests", "test_stray_samples"),
    # trainings
    *("test_acceptance", "test_actuator", "test_baselines", "test_correction", "test_in_the_loop"),
    *("test_networks", "test_without_physics"),
    # closest points
    *("test_clouds", "test_outlines", "test_picture_misfit", "test_released_motion", "test_tags"),
}
# modules of tests
LOOK_AT_PICTURES = {
    "test_bodies",
    "test_figures",
    "test_render",
    "test_report",
    "test_environments",
    "test_film",
    *("test_control_run", "test_inspect_mesh", "test_motion_film"),
}
# As users do.
DECODE_IN_PROCESSES = {
    "test_damaged_files",
    "test_foreign_recordings",
    "test_mesh",
    "test_recordings",
}
COMMAND = render.COMMAND  # which tests without drawing replace
__all__ = ["device"]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--device",
        default="cpu",
        choices=["cpu", "cuda"],
        help="device of the tests marked validation",
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.stem in NUMERICAL:
            item.add_marker("numerics")
        elif item.path.parent.name == "validation":
            item.add_marker("validation")


def folder_beside_the_repository(name: str, content: str) -> Path:
    folder = Path(
        os.environ.get(f"WARP_RESPHYS_{name.upper()}", Path(__file__).parents[2] / "shared" / name)
    )
    if not folder.is_dir():
        pytest.skip(f"set WARP_RESPHYS_{name.upper()} to a folder with {content}")
    return folder


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Recordings and meshes that are not part of the repository."""
    return folder_beside_the_repository("data", "beam_mocap, segment_mocap, sopra_mesh")


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """Reference trajectories that are not part of the repository."""
    return folder_beside_the_repository("reference", "the .npz files of reference trajectories")


@pytest.fixture(scope="session")
def renderer() -> Iterator[render.Renderer]:
    """One drawing process, which takes seconds to start."""
    with render.Renderer() as drawing:
        yield drawing


@pytest.fixture(scope="session")
def can_draw(renderer: render.Renderer) -> None:
    """Skips where bodies cannot be drawn."""
    mesh = box_hexahedra(divisions=(1, 1, 1))
    try:
        render.draw(body_scene(mesh, longest=100), renderer)
    except render.DrawingError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session", autouse=True)
def _configurations_are_read_once():
    """The files of the package's own configuration and the schemas of settings,
    which every command reads anew.

    Hydra does not compose a configuration twice, the first time to read `hydra.mode`, which nothing
    here sets.
    """
    initialize = GlobalHydra.initialize

    def without_mode(self: GlobalHydra, hydra: Any) -> None:
        hydra.get_mode = lambda **_: None
        initialize(self, hydra)

    sources = [
        source for source in Plugins.instance().discover(ConfigSource) if source.scheme() == "pkg"
    ]
    kept, load = {}, sources[0].load_config

    def read(self: ConfigSource, config_path: str) -> Any:
        if (place := (self.path, config_path)) not in kept:
            kept[place] = load(self, config_path)
        return deepcopy(kept[place])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(GlobalHydra, "initialize", without_mode)
        for source in sources:
            patch.setattr(source, "load_config", read)
        patch.setattr(
            Settings,
            "model_json_schema",
            classmethod(functools.cache(Settings.model_json_schema.__func__)),
        )
        yield


@pytest.fixture(scope="session", autouse=True)
def _options_are_composed_once():
    """What `overrides.composed` makes of the same options, before it sets single keys.

    A copy for each test.
    """
    kept: dict[Any, Any] = {}

    def compose(name: str, words: list[str], **options: bool) -> Any:
        others = [at for at, word in enumerate(words, 1) if not word.startswith("++")]
        first = max(others, default=0)  # of the single keys at the end
        chosen = (name, *words[:first])
        parsed = OverridesParser.create().parse_overrides(words[first:])
        if any(override.is_sweep_override() for override in parsed):
            return hydra.compose(name, words, **options)
        places = re.findall(r"file://([^],']+)", " ".join(chosen))
        outside = [path for place in places for path in sorted(Path(place).rglob("*.yaml"))]
        key = (*chosen, *((str(path), path.read_bytes()) for path in outside))
        if key not in kept:
            kept[key] = hydra.compose(name, list(chosen[1:]), **options)
        config = deepcopy(kept[key])
        for override in parsed:
            name, value = override.key_or_group, override.value()
            OmegaConf.update(config, name, value, merge=True, force_add=True)
        return config

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(overrides, "compose", compose)
        yield


@pytest.fixture(scope="session")
def kept_renderers():
    """Drawing processes that no report needs any more, which draw the next one."""
    kept = []
    yield kept
    for process, messages in kept:
        render._end(process, messages)


@contextlib.contextmanager
def renderers_used_again(kept_renderers: list[Any]) -> Iterator[None]:
    """Drawing processes that draw for the next renderer, as each takes seconds to start."""
    start, close = render.Renderer._start, render.Renderer.close

    def started(self: render.Renderer) -> None:
        if kept_renderers and render.COMMAND is COMMAND:
            self._process, self._messages = own = kept_renderers.pop()
            self._end = weakref.finalize(self, render._end, *own)
        else:
            start(self)

    def closed(self: render.Renderer) -> None:
        if self._end is not None and self._process.poll() is None and render.COMMAND is COMMAND:
            self._end.detach()
            self._end = None
            kept_renderers.append((self._process, self._messages))
        else:
            close(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render.Renderer, "_start", started)
        patch.setattr(render.Renderer, "close", closed)
        yield


@contextlib.contextmanager
def coarse_pictures(kept_renderers: list[Any]) -> Iterator[None]:
    """Small pictures by processes that are used again,
    and figures without a layout that are drawn once.
    """
    frames = render.Renderer.frames

    def coarse(self: render.Renderer, scene: render.RenderScene) -> Iterator[render.Pixels]:
        return frames(self, replace(scene, size=[side // 8 * 2 for side in scene.size]))

    with renderers_used_again(kept_renderers), pytest.MonkeyPatch.context() as patch:
        patch.setattr(render.Renderer, "frames", coarse)
        patch.setattr(figures, "settle", lambda figure: figure.set_layout_engine("none"))
        patch.setattr(
            figures, "save_png", lambda figure, path: figure.savefig(path, format="png", dpi=20)
        )
        patch.setattr(figures, "themed_svg", lambda figure, name: b"<svg/>")
        yield


@pytest.fixture(scope="session")
def used_again(kept_renderers):
    """A context in which drawing processes are used again, for tests that look at pictures."""
    return functools.partial(renderers_used_again, kept_renderers)


@pytest.fixture(scope="module", autouse=True)
def _pictures(request, kept_renderers):
    """Coarse pictures, but for tests that look at them."""
    with (
        contextlib.nullcontext()
        if request.path.stem in LOOK_AT_PICTURES
        else coarse_pictures(kept_renderers)
    ):
        yield


@pytest.fixture(scope="module", autouse=True)
def _files_are_decoded_here(request):
    """Files of other programs, but where damaged ones are read:
    a process for each takes half a second.
    """

    def here(library: str, path: Path, *names: str) -> decoding.Arrays:
        return decoding.decoded(library, str(path), *names)

    with pytest.MonkeyPatch.context() as patch:
        if request.path.stem not in DECODE_IN_PROCESSES:
            patch.setattr(readers, "decode", here)
            patch.setattr(recording_files, "decode", here)
        yield


@pytest.fixture(scope="module", autouse=True)
def _nothing_waits_for_the_disk(request):
    """Files that outlive no loss of power, but where writing is tested."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.parent.name != "io":
            patch.setattr(atomic, "_sync", lambda path: None)
        yield


@pytest.fixture(autouse=True)
def _loggers_are_enabled():
    enable_loggers()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def no_report():
    with without_reports():
        yield


@pytest.fixture(scope="session")
def finished(tmp_path_factory, kept_renderers):
    """A complete run with its report, and its files before
    and after a second run of the same command.
    """
    root = tmp_path_factory.mktemp("finished")
    with contextlib.chdir(root), coarse_pictures(kept_renderers):
        assert run(*TINY, IN_RUN)[0] == 0
        first = files()
        assert run(*TINY, IN_RUN)[0] == 0
        return root / "run", first, files()
