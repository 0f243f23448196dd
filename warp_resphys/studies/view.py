"""The command `view`: a live simulation of a robot in the browser, by viser."""

import io
import logging
import re
import socket
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import warp as wp

from ..core.energies.contact.obstacle_surface import ObstacleSurface
from ..core.mesh.volume_mesh import boundary_triangles, surface_vertices
from ..io.errors import InputError, ResphysError, needs_extra
from ..io.progress import show
from ..io.settings import Count, Positive, Settings, Word, setting
from ..report.layers import MEASURED, Layer, body_layers, obstacle_layers, sharp_edges
from ..report.wording import TONES
from ..robot.actuation import BASE
from ..robot.loading import held_out_names, load, trial_names
from .live import LiveRobot, range_of
from .live_scene import LiveScene
from .live_twin import LiveTwin, TwinSettings

if TYPE_CHECKING:
    import viser

_RATE: Final = 30.0  # Pictures a second, at most.
_STATUS_EVERY: Final = 0.25  # [s]
_HAND: Final = "hand"
_BY_HAND: Final = "by hand"
_EVERYWHERE: Final = ("0.0.0.0", "::")  # Hosts that stand for all addresses of a machine.
_DOT: Final = 0.02  # Radius of a marker's dot, over the size of the body.
_HELP: Final = (
    "Drag the body to pull it, drag beside it to turn the view, scroll to zoom, right-drag to move."
    "\nKeys: **space** pauses, **R** resets."
)
_HELP_TWIN: Final = (
    "Blue: the estimate. Grey: where the robot will be, if its commands stay. Dots: measured "
    "markers.\n"
    "Drag to turn the view, scroll to zoom, right-drag to move. "
    "Keys: **space** pauses, **R** starts again."
)
_SPEEDS: Final = {"a tenth": 0.1, "a quarter": 0.25, "half": 0.5, "real time": 1.0, "double": 2.0}


class ViewSettings(Settings):
    """The configuration ``view``, which explains its keys."""

    run: Word
    model: Word | None
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
    with needs_extra("view", "the viewer needs"):
        import viser
    wp.config.log_level = wp.LOG_WARNING
    robot = load(Path(settings.run).expanduser(), settings.model, device=settings.device)
    live: LiveRobot | LiveTwin
    if settings.source is not None:
        if settings.trial is not None:
            raise InputError(
                "trial and source are both given: a twin follows its source; leave trial out."
            )
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
            pace = (
                f"an estimate for a packet in {half:.1f} ms (median), "
                f"{most:.1f} ms (99th percentile), "
            )
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
            raise InputError(
                f"port {port} of {host} cannot be used ({reason}): choose another, 0 for any."
            ) from None
        return int(tried.getsockname()[1])


class Page:
    """The page of a robot in a browser.

    The robot is stepped in the thread that calls `run`. Requests of browsers are queued and handled
    there, before the next picture.

    Args:
        server: that serves the page.
        live: the robot, or the twin.
    """

    def __init__(self, server: "viser.ViserServer", live: LiveRobot | LiveTwin) -> None:
        self._server, self._live = server, live
        self._requests: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._playing, self._stopped = True, False
        self._speed = 1.0
        self._holder: int | None = None  # Client that drags the body.
        # State, trial and robot that are shown.
        self._shown_now: tuple[object, ...] = (None, None, None)
        self.pictures = 0
        mesh = live.robot.simulator.body.mesh
        self._surface = surface_vertices(mesh)
        self._faces = np.searchsorted(self._surface, boundary_triangles(mesh))
        self._sharp = sharp_edges(mesh.vertices[self._surface], self._faces)
        self._scene = LiveScene(
            server, mesh.vertices, np.asarray(live.robot.simulator.gravity, dtype=np.float64)
        )
        self._show()
        if isinstance(live, LiveRobot):
            self._set_dragging(live)
        self._set_controls()

    # Scene

    def _layers(self) -> dict[str, Layer]:
        """Returns the layers of the scene as it is now, by name, in metres.

        Those without points are not shown.
        """
        live = self._live
        around = ObstacleSurface.of(live.robot.simulator.body, live.robot.parameters).moved(
            live.moved
        )
        body, edges = body_layers(
            live.positions[self._surface], self._faces, 0.0, sharp=self._sharp
        )
        solid = obstacle_layers(around.points, around.triangles)
        measured, none = live.measured, np.empty((0, 3))
        target = none if live.target is None else live.target[self._surface]
        seen = none if measured is None or not live.robot.labels else measured
        return {
            "body": replace(body, colour=TONES["resphys"].dark),
            "edges": edges,
            "measured body": Layer(
                "surface", target, self._faces, TONES["target"].light, opacity=0.4
            ),
            "markers": Layer("balls", live.markers, colour=TONES["resphys"].light, size=1.4 * _DOT),
            "measured": Layer("balls", seen, colour=MEASURED, size=_DOT),
            **{
                f"obstacles{part}": layer
                for part, layer in zip(("", " edges"), solid, strict=False)
            },
        }

    def _show(self) -> None:
        """Shows the current state."""
        live = self._live
        now = (live.state, live.trial, live.robot)
        if all(a is b for a, b in zip(now, self._shown_now, strict=True)):
            return
        self._shown_now = now
        with self._server.atomic():
            for name, layer in self._layers().items():
                self._scene.draw(name, layer)

    def _set_dragging(self, live: LiveRobot) -> None:
        """Lets browsers pull the body."""

        def let_go() -> None:
            self._holder = None
            self._ask(live.let_go)

        @self._scene.handles["body"].on_drag
        async def _(
            event: Any,
        ) -> None:  # Without awaiting, so that events are handled in their order.
            if event.phase == "start" and self._holder is None:
                self._holder = event.client_id
                self._ask(partial(live.grab, self._scene.real(event.start_position)))
            if event.client_id != self._holder:
                return
            if event.phase == "end":
                let_go()
            else:
                self._ask(partial(live.drag, self._scene.real(event.end_position)))

        @self._server.on_client_disconnect
        async def _(client: Any) -> None:
            if client.client_id == self._holder:
                let_go()

    # Controls

    def _ask(self, request: Callable[[], None]) -> None:
        """Queues a request, which is handled before the next picture."""
        with self._lock:
            self._requests.append(request)

    def _set_controls(self) -> None:
        gui, live = self._server.gui, self._live
        robot = live.robot
        gui.configure_theme(dark_mode=False, show_logo=False)
        text = _HELP_TWIN if isinstance(live, LiveTwin) else _HELP
        gui.add_markdown(
            f"**{_plain(robot.description.name)}**, {robot.description.model}\n\n{text}"
        )
        self._status = gui.add_markdown("")
        self._play = gui.add_button("Pause")
        self._play.on_click(lambda _: self._ask(self._toggle))
        gui.add_button("Reset").on_click(lambda _: self._ask(self._reset))
        gui.add_command("Pause or go on", hotkey="space").on_trigger(
            lambda _: self._ask(self._toggle)
        )
        gui.add_command("Reset", hotkey="R").on_trigger(lambda _: self._ask(self._reset))
        speed = gui.add_dropdown("Speed", tuple(_SPEEDS), initial_value="real time")
        speed.on_update(lambda _: setattr(self, "_speed", _SPEEDS[speed.value]))
        self._trial: Any = None
        self._sliders: dict[tuple[str, int], Any] = {}  # By input and part.
        if isinstance(live, LiveRobot):
            self._set_driving(live)
        dark = gui.add_checkbox("Dark", False)
        dark.on_update(lambda _: gui.configure_theme(dark_mode=dark.value, show_logo=False))

    def _set_driving(self, live: LiveRobot) -> None:
        """Adds the controls of a robot that is driven by hand or by a trial."""
        gui, robot = self._server.gui, live.robot
        if robot.folder is not None:
            name = _BY_HAND if live.trial is None else live.trial.name
            self._trial = gui.add_dropdown(
                "Motion", (_BY_HAND, *trial_names(robot)), initial_value=name
            )
            self._trial.on_update(lambda _: self._ask(partial(self._choose, live)))
        for name, robot_input in robot.inputs.items():
            words = (
                f"{robot_input.quantity.plural or robot_input.name}".capitalize()
                if name != BASE
                else "Base"
            )
            with gui.add_folder(words, expand_by_default=robot_input.low is not None):
                for part in range(len(robot_input.parts)):
                    self._sliders[name, part] = self._slider(live, name, part)
        if live.parameters:
            with gui.add_folder("Material and other parameters", expand_by_default=False):
                parameters = {name: self._parameter(live, name) for name in live.parameters}
                back = gui.add_button("As identified")

                def restore(_: Any) -> None:
                    for name, slider in parameters.items():
                        slider.value = live.parameters[name][1]
                    self._ask(live.restore)

                back.on_click(restore)

    def _slider(self, live: LiveRobot, name: str, part: int) -> Any:
        """Returns a slider for a part of an input, in the unit of its quantity for display."""
        robot_input = live.robot.inputs[name]
        quantity = robot_input.quantity
        unit = (
            ("m" if part < 3 else "rad")
            if name == BASE
            else quantity.shown_unit or robot_input.unit
        )
        low, high = (quantity.shown_factor * float(limit[part]) for limit in live.limits[name])
        high = high if high > low else low + 1.0
        label = f"{robot_input.parts[part].replace('_', ' ')} [{unit}]"
        slider = self._server.gui.add_slider(
            label, low, high, (high - low) / 500.0, min(max(0.0, low), high)
        )

        def by_hand() -> None:
            # The value when it is handled.
            live.set_input(name, part, slider.value / quantity.shown_factor)
            if self._trial is not None and self._trial.value != _BY_HAND:
                self._trial.value = _BY_HAND

        def moved(event: Any) -> None:
            if event.client is not None:  # Not where a trial has moved the slider.
                self._ask(by_hand)

        slider.on_update(moved)
        return slider

    def _parameter(self, live: LiveRobot, name: str) -> Any:
        """Returns a slider for a parameter."""
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

    def _choose(self, live: LiveRobot) -> None:
        name, now = self._trial.value, _BY_HAND if live.trial is None else live.trial.name
        if name == now:
            return
        try:
            live.play_trial(None if name == _BY_HAND else name)
        except ResphysError:
            self._trial.value = now
            raise
        self._set_sliders()

    def _set_sliders(self) -> None:
        """Moves the sliders to the current values of the inputs."""
        if isinstance(self._live, LiveRobot):
            for (name, part), slider in self._sliders.items():
                factor = self._live.robot.inputs[name].quantity.shown_factor
                value = float(
                    np.clip(factor * self._live.inputs[name][part], slider.min, slider.max)
                )
                if abs(value - slider.value) > 0.5 * slider.step:
                    slider.value = value

    # Time

    def run(self, seconds: float | None) -> float:
        """Simulates and draws until it is interrupted or some seconds are over.

        Returns pictures a second.
        """
        live = self._live
        began = last = time.perf_counter()
        updated = due = simulated = 0.0
        counted = 0
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
                due = min(
                    due + (now - last) * self._speed,
                    2.0 * max(self._speed / _RATE, live.robot.time_step),
                )
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
                    self._show_status(
                        counted / since if updated else 0.0, simulated / since if updated else 0.0
                    )
                    updated = now
                    simulated, counted = 0.0, 0
                time.sleep(max(1.0 / _RATE - (time.perf_counter() - now), 1e-3))
        except KeyboardInterrupt:
            pass
        return self.pictures / (time.perf_counter() - began)

    def stop(self) -> None:
        """Ends `run`, from another thread."""
        self._stopped = True

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
