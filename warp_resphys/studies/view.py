"""The command `view`: a live simulation of a robot in the browser, by viser."""

import io
import logging
import re
import socket
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ..data.camera import upwards
from ..data.obstacle_surface import ObstacleSurface
from ..io.arrays import FloatArray
from ..io.errors import InputError, ResphysError
from ..io.progress import show
from ..io.settings import Count, Positive, Settings, Word, setting
from ..mesh.volume_mesh import boundary_triangles, surface_vertices
from ..report.layers import MEASURED, OBSTACLE, sharp_edges
from ..report.wording import TONES
from ..robot.actuation import BASE
from ..robot.loading import RecordedTrial, held_out_names, load, trial_names
from .live import LiveRobot, range_of
from .live_twin import LiveTwin, TwinSettings

if TYPE_CHECKING:
    import viser

_RATE: Final = 30.0  # Pictures a second, at most.
_STATUS_EVERY: Final = 0.25  # [s]
_HAND: Final = "hand"
_BY_HAND: Final = "by hand"
_EVERYWHERE: Final = ("0.0.0.0", "::")  # Hosts that stand for all addresses of a machine.
_DOT: Final = 0.02  # Radius of a marker's dot, over the size of the body.
_HELP: Final = """Drag the body to pull it, drag beside it to turn the view, scroll to zoom, right-drag to move.
Keys: **space** pauses, **R** resets."""
_HELP_TWIN: Final = """Blue: the estimate. Grey: where the robot will be, if its commands stay. Dots: measured markers.
Drag to turn the view, scroll to zoom, right-drag to move. Keys: **space** pauses, **R** starts again."""
_SPEEDS: Final = {"a tenth": 0.1, "a quarter": 0.25, "half": 0.5, "real time": 1.0, "double": 2.0}


class ViewSettings(Settings):
    """The configuration ``view``, which explains its keys."""

    run: Word
    model: Word
    trial: Word | None
    device: Word
    host: Word
    port: Count
    seconds: Positive | None = setting(unit="s")
    source: Word | None
    twin: TwinSettings


def view(settings: ViewSettings, folder: Path) -> None:
    """Serves a page until it is interrupted, and prints its frame rate.

    Raises:
        InputError: no viser, a port that is in use, or an unknown model or trial.
        DataFileError: there is no finished run.
    """
    del folder
    port = _free_port(settings.host, settings.port)
    try:
        import viser
    except ImportError:
        raise InputError(
            "the viewer needs a package that is not installed: pip install 'warp-resphys[view]'."
        ) from None
    wp.config.log_level = wp.LOG_WARNING
    robot = load(Path(settings.run).expanduser(), settings.model, device=settings.device)
    live: LiveRobot | LiveTwin
    if settings.source is not None:
        if settings.trial is not None:
            raise InputError("trial and source are both given: a twin follows its source; leave trial out.")
        live = LiveTwin(robot, settings.source, settings.twin)
    else:
        live = LiveRobot(robot)
        held_out = () if robot.folder is None else held_out_names(robot, moving=True)
        name = next(iter(held_out), None) if settings.trial is None else settings.trial
        live.play_trial(None if name == _HAND else name)
        live.step()  # Compiles the kernels of a step before the page is opened.
        live.reset()
    logging.getLogger("websockets").setLevel(logging.WARNING)
    with redirect_stdout(io.StringIO()):  # The address is printed below.
        server = viser.ViserServer(settings.host, port, label=robot.description.name, verbose=False)
    try:
        page = Page(server, live)
        where = "localhost" if settings.host in _EVERYWHERE else settings.host
        show(f"Open http://{where}:{server.get_port()} in a browser; Ctrl-C ends it.")
        if isinstance(live, LiveTwin) and live.address:
            show(f"Packets are taken at {live.address}.")
        rate = page.run(settings.seconds)
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()
        if isinstance(live, LiveTwin):
            live.close()
    show(f"{rate:.1f} pictures a second")
    if isinstance(live, LiveTwin):
        pace = "no frames"
        if live.seconds:
            half, most = np.percentile(1e3 * np.array(live.seconds), [50, 99])
            pace = f"an estimate for a packet in {half:.1f} ms (median), {most:.1f} ms (99th percentile), "
            pace += f"steps of {1e3 * robot.time_step:g} ms"
        show("\n".join(filter(None, [pace, *live.words, live.failure])))


def _free_port(host: str, port: int) -> int:
    """A port that can be bound: the given one, or any for zero.

    Raises:
        InputError: the port is in use or cannot be bound.
    """
    with socket.socket() as tried:
        tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            tried.bind((host, port))
        except (OSError, OverflowError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"port {port} of {host} cannot be used ({reason}): choose another, 0 for any.") from None
        return int(tried.getsockname()[1])


class Page:
    """The page of a robot in a browser.

    The robot is stepped in the thread that calls `run`. Requests of browsers are queued and handled there, before the
    next picture.

    Args:
        server: that serves the page.
        live: the robot, or the twin.
    """

    def __init__(self, server: "viser.ViserServer", live: LiveRobot | LiveTwin) -> None:
        self._server, self._live = server, live
        self._requests: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._playing, self._speed, self._stopped = True, 1.0, False
        self._holder: int | None = None  # Client that drags the body.
        self._shown_state: object = None
        self._shown_trial: RecordedTrial | None = None
        self.pictures = 0
        mesh = live.robot.simulator.body.mesh
        self._surface = surface_vertices(mesh)
        self._faces = np.searchsorted(self._surface, boundary_triangles(mesh))
        self._scale = 1.0 / float(
            np.ptp(mesh.vertices, axis=0).max()
        )  # Of the scene: viser's cameras expect bodies of about a metre.
        self._middle = mesh.vertices.mean(axis=0)
        self._sharp = sharp_edges(mesh.vertices[self._surface], self._faces)
        self._set_scene()
        self._set_controls()

    # Scene

    def _shown(self, points: FloatArray) -> NDArray[np.float32]:
        return np.asarray((points - self._middle) * self._scale, dtype=np.float32)

    def _real(self, point: tuple[float, float, float]) -> FloatArray:
        return np.asarray(point, dtype=np.float64) / self._scale + self._middle

    def _set_scene(self) -> None:
        server, live = self._server, self._live
        up = upwards(np.asarray(live.robot.simulator.gravity, dtype=np.float64))
        server.scene.set_up_direction((float(up[0]), float(up[1]), float(up[2])))
        side = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
        camera = server.initial_camera
        camera.look_at = (0.0, 0.0, 0.0)
        position = 1.3 * side / np.linalg.norm(side) + 0.35 * up
        camera.position = (float(position[0]), float(position[1]), float(position[2]))
        camera.up = (float(up[0]), float(up[1]), float(up[2]))
        places = self._shown(live.positions[self._surface])
        blue, grey = _bytes(TONES["resphys"].dark), _bytes(TONES["target"].light)
        self._body = server.scene.add_mesh_simple(
            "/body", places, self._faces.astype(np.uint32), color=blue, flat_shading=True, side="double"
        )
        self._target = server.scene.add_mesh_simple(
            "/measured body", places, self._faces.astype(np.uint32), color=grey, opacity=0.4, visible=False
        )
        self._placed, body = live.robot, live.robot.simulator.body
        self._around = ObstacleSurface.of(body, live.robot.parameters)
        self._obstacles: Any = None
        if len(self._around.points):
            self._obstacles = server.scene.add_mesh_simple(
                "/obstacles",
                self._shown(self._around.points),
                self._around.triangles.astype(np.uint32),
                color=_bytes(OBSTACLE),
                flat_shading=True,
                side="double",
            )
        edges = places[self._sharp]
        self._edges = server.scene.add_line_segments("/edges", edges, (30, 40, 50), thickness=0.003)
        none = np.zeros((1, 3), dtype=np.float32)
        self._markers = server.scene.add_point_cloud(
            "/markers", none, (26, 95, 180), point_size=1.4 * _DOT, point_shape="circle", visible=False
        )
        self._measured = server.scene.add_point_cloud(
            "/measured", none, _bytes(MEASURED), point_size=_DOT, point_shape="circle", visible=False
        )

        if isinstance(live, LiveTwin):
            return

        @self._body.on_drag
        async def _(event: Any) -> None:  # Without awaiting, so that events are handled in their order.
            if event.phase == "start" and self._holder is None:
                self._holder = event.client_id
                self._ask(partial(live.grab, self._real(event.start_position)))
            if event.client_id != self._holder:
                return
            if event.phase == "end":
                self._let_go()
            else:
                self._ask(partial(live.drag, self._real(event.end_position)))

        @server.on_client_disconnect
        async def _(client: Any) -> None:
            if client.client_id == self._holder:
                self._let_go()

    def _let_go(self) -> None:
        self._holder = None
        self._ask(self._driven.let_go)

    @property
    def _driven(self) -> LiveRobot:
        """The robot, where it is no twin."""
        assert isinstance(self._live, LiveRobot)
        return self._live

    # Controls

    def _ask(self, request: Callable[[], None]) -> None:
        """Queues a request, which is handled before the next picture."""
        with self._lock:
            self._requests.append(request)

    def _set_controls(self) -> None:
        server, live = self._server, self._live
        gui, robot = server.gui, live.robot
        server.gui.configure_theme(dark_mode=False, show_logo=False)
        text = _HELP_TWIN if isinstance(live, LiveTwin) else _HELP
        gui.add_markdown(f"**{_plain(robot.description.name)}**, {robot.description.model}\n\n{text}")
        self._status = gui.add_markdown("")
        self._play = gui.add_button("Pause")
        self._play.on_click(lambda _: self._ask(self._toggle))
        gui.add_button("Reset").on_click(lambda _: self._ask(self._reset))
        gui.add_command("Pause or go on", hotkey="space").on_trigger(lambda _: self._ask(self._toggle))
        gui.add_command("Reset", hotkey="R").on_trigger(lambda _: self._ask(self._reset))
        speed = gui.add_dropdown("Speed", tuple(_SPEEDS), initial_value="real time")
        speed.on_update(lambda _: setattr(self, "_speed", _SPEEDS[speed.value]))
        self._trial: Any = None
        self._sliders: dict[str, list[Any]] = {}
        if isinstance(live, LiveRobot):
            self._set_driving(live)
        dark = gui.add_checkbox("Dark", False)
        dark.on_update(lambda _: gui.configure_theme(dark_mode=dark.value, show_logo=False))

    def _set_driving(self, live: LiveRobot) -> None:
        """Controls of a robot that is driven by hand or by a trial."""
        gui, robot = self._server.gui, live.robot
        if robot.folder is not None:
            name = _BY_HAND if live.trial is None else live.trial.name
            self._trial = gui.add_dropdown("Motion", (_BY_HAND, *trial_names(robot)), initial_value=name)
            self._trial.on_update(lambda _: self._ask(self._choose))
        for name, robot_input in robot.inputs.items():
            words = f"{robot_input.quantity.plural or robot_input.name}".capitalize() if name != BASE else "Base"
            with gui.add_folder(words, expand_by_default=robot_input.low is not None):
                self._sliders[name] = [self._slider(name, part) for part in range(len(robot_input.parts))]
        if live.parameters:
            with gui.add_folder("Material and other parameters", expand_by_default=False):
                parameters = {name: self._parameter(name) for name in live.parameters}
                back = gui.add_button("As identified")

                def restore(_: Any) -> None:
                    for name, slider in parameters.items():
                        slider.value = live.parameters[name][1]
                    self._ask(live.restore)

                back.on_click(restore)

    def _slider(self, name: str, part: int) -> Any:
        """A slider for a part of an input, in the unit of its quantity for display."""
        live, robot_input = self._driven, self._driven.robot.inputs[name]
        factor = robot_input.quantity.shown_factor if robot_input.quantity.shown_unit else 1.0
        unit = robot_input.quantity.shown_unit or robot_input.unit
        unit = ("m" if part < 3 else "rad") if name == BASE else unit
        low, high = (factor * float(limit[part]) for limit in live.limits[name])
        high = high if high > low else low + 1.0
        label = f"{robot_input.parts[part].replace('_', ' ')} [{unit}]"
        slider = self._server.gui.add_slider(label, low, high, (high - low) / 500.0, min(max(0.0, low), high))

        def moved(event: Any) -> None:
            if event.client is not None:  # Not where a trial has moved the slider.
                self._ask(lambda: self._by_hand(name, part, slider.value / factor))  # The value when it is handled.

        slider.on_update(moved)
        return slider

    def _parameter(self, name: str) -> Any:
        """A slider for a parameter."""
        live = self._driven
        quantity, value = live.parameters[name]
        low, high = range_of(quantity, value)
        label = f"{name.replace('_', ' ')}{f' [{quantity.unit}]' if quantity.unit else ''}"
        slider = self._server.gui.add_slider(label, low, high, (high - low) / 1000.0, value)
        slider.on_update(lambda _: self._ask(lambda: live.set_parameter(name, slider.value)))
        return slider

    def _toggle(self) -> None:
        self._playing = not self._playing
        self._play.label = "Pause" if self._playing else "Go on"

    def _reset(self) -> None:
        self._live.reset()
        self._set_sliders()

    def _choose(self) -> None:
        name, now = self._trial.value, _BY_HAND if self._driven.trial is None else self._driven.trial.name
        if name == now:
            return
        try:
            self._driven.play_trial(None if name == _BY_HAND else name)
        except ResphysError:
            self._trial.value = now
            raise
        self._set_sliders()

    def _by_hand(self, name: str, part: int, value: float) -> None:
        self._driven.set_input(name, part, value)
        if self._trial is not None and self._trial.value != _BY_HAND:
            self._trial.value = _BY_HAND

    def _set_sliders(self) -> None:
        """Moves the sliders to the current values of the inputs."""
        for name, sliders in self._sliders.items():
            quantity = self._driven.robot.inputs[name].quantity
            factor = quantity.shown_factor if quantity.shown_unit else 1.0
            for part, slider in enumerate(sliders):
                value = float(np.clip(factor * self._driven.inputs[name][part], slider.min, slider.max))
                if abs(value - slider.value) > 0.5 * slider.step:
                    slider.value = value

    # Time

    def run(self, seconds: float | None) -> float:
        """Simulates and draws until it is interrupted or some seconds are over; returns pictures a second."""
        live, began, last, updated = self._live, time.perf_counter(), time.perf_counter(), 0.0
        due, simulated, counted = 0.0, 0.0, 0
        try:
            while not self._stopped and (seconds is None or time.perf_counter() - began < seconds):
                now = time.perf_counter()
                with self._lock:
                    requests, self._requests = self._requests, []
                for request in requests:
                    try:
                        request()
                    except ResphysError as error:
                        live.failure = str(error)
                due = min(due + (now - last) * self._speed, 2.0 * max(self._speed / _RATE, live.robot.time_step))
                last = now
                while self._playing and due >= live.robot.time_step and live.step():
                    due -= live.robot.time_step
                    simulated += live.robot.time_step
                due = due if self._playing else 0.0
                self._show()
                self.pictures += 1
                counted += 1
                if now - updated > _STATUS_EVERY:
                    since = now - updated
                    self._show_status(counted / since if updated else 0.0, simulated / since if updated else 0.0)
                    updated, simulated, counted = now, 0.0, 0
                time.sleep(max(1.0 / _RATE - (time.perf_counter() - now), 1e-3))
        except KeyboardInterrupt:
            pass
        return self.pictures / (time.perf_counter() - began)

    def stop(self) -> None:
        """Ends `run`, from another thread."""
        self._stopped = True

    def _show(self) -> None:
        live = self._live
        if self._obstacles is not None and (self._placed is not live.robot or live.moved):
            if self._placed is not live.robot:  # Its parameters have changed.
                self._placed = live.robot
                self._around = ObstacleSurface.of(live.robot.simulator.body, live.robot.parameters)
            self._obstacles.vertices = self._shown(self._around.moved(live.moved).points)
        if self._shown_state is live.state and self._shown_trial is live.trial:
            return
        self._shown_state, self._shown_trial = live.state, live.trial
        places = self._shown(live.positions)
        with self._server.atomic():
            surface = places[self._surface]
            self._body.vertices = surface
            self._edges.points = surface[self._sharp]
            self._dots(self._markers, live.markers)
            measured, target = live.measured, live.target
            self._dots(self._measured, measured if measured is not None and live.robot.labels else np.empty((0, 3)))
            if target is not None:
                self._target.vertices = self._shown(target[self._surface])
            if self._target.visible != (target is not None):
                self._target.visible = target is not None

    def _dots(self, cloud: Any, points: FloatArray) -> None:
        seen = points[np.isfinite(points).all(axis=1)]
        if len(seen):
            cloud.points = self._shown(seen)
        if cloud.visible != bool(len(seen)):
            cloud.visible = bool(len(seen))

    def _show_status(self, rate: float, pace: float) -> None:
        """Shows time, rates and distance from the measured markers."""
        live = self._live
        lines = [f"{live.time:.2f} s, {rate:.0f} pictures a second, {pace:.2g} times real time"]
        measured = live.measured
        if measured is not None:
            where = live.markers if live.robot.labels else live.positions
            away = 1e3 * np.linalg.norm(where - measured, axis=1)
            if np.isfinite(away).any():
                lines.append(f"{float(np.nanmean(away)):.2f} mm from the measurement")
        if isinstance(live, LiveTwin):
            lines += map(_plain, live.words)
        if live.has_left:
            lines.append("**The body is outside the training range.**")
        if live.failure:
            lines.append(f"**{_plain(live.failure)}**")
        self._status.content = "\n\n".join(lines)
        if live.trial is not None:
            self._set_sliders()


def _plain(text: str) -> str:
    """Escapes a text for Markdown."""
    return re.sub(r"([\\`*_{}\[\]()#+!|~-])", r"\\\1", escape(text, quote=False))


def _bytes(tone: str) -> tuple[int, int, int]:
    """Red, green and blue of a colour such as #1a5fb4, from 0 to 255."""
    red, green, blue = (int(tone[at : at + 2], 16) for at in (1, 3, 5))
    return red, green, blue
