"""The section on control: errors of followed paths on the simulated laboratory, how motions were planned; a film."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ..io.arrays import FloatArray, IntArray
from ..settings.control import ControlSettings
from .bodies import BODIES, BODY_LIGHT, FILM_VIEW, HEADROOM, sharp_edges
from .data import MODELS, FollowedPath, RunReport
from .figures import TONES
from .page import NONE, Canvas, Cell, Items, PageTable, Part, Row, Text, mm_text, number_text
from .render import INK, Layer, RenderScene, View, chain, frame_of, height_of, pace, path_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_KINDS: Final[Mapping[str, tuple[str, str]]] = {  # By prefix of a controller: name in words, and description.
    "open_": ("{}, open loop", "planned once for the whole path, and played"),
    "receding_linear": ("Linear model, receding horizon", "dynamic mode decomposition of the same recordings"),
    "receding_": ("{}, receding horizon", "planned anew at each step, from an estimate by the markers"),
    "feedback_": ("Jacobian feedback, {}/s", "with the measured Jacobian of the point by the inputs"),
}
_LINES: Final[Mapping[str, Any]] = {"open": (0, (4, 2)), "receding": "-"}  # By beginning of a controller's name.
_COLUMNS: Final = 5  # Of followed paths.
_DRAWING: Final = 0.6  # Longer side of the enlarged drawing, over that of the body.
_GAP: Final = 0.15  # Distance of the drawing from the body, over the same.
_BEFORE: Final = {"edges": 0.01, "path": 4.0, "trail": 4.5, "point": 5.0}  # Shifts to the viewer, over half height.
_POINT: Final = 0.02  # Radius of the point, over half a view's height.
_WIDTHS: Final = ((4.0, 2.0), (6.0, 3.0))  # Widths [px] of the path and of the trail, on the body and in the drawing.
_APART: Final = 0.012  # Least length of line segments, over half a view's height; shorter ones have ragged edges.

Placement = Callable[[FloatArray], FloatArray]


def control_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Return the section; None where nothing is controlled, or no simulation plays the robot."""
    metrics, control = data.metrics.get("control") or {}, data.settings.control
    if not metrics or control is None:
        return None
    blocks: list[Any] = [Text(_task(control), "control"), tracking_table(metrics["tracking"])]
    slowest = max(control.seconds)
    drawn = [followed for followed in data.followed if followed.seconds == slowest]
    if drawn:
        named = {controller: controller_name(controller) for controller in compared_controllers(control)}
        names = ", ".join(named.values())
        alt = f"{len(drawn)} paths of {slowest:g} s, and the paths of the point with {names}."
        caption = (
            f"Paths of {slowest:g} s (grey), and the paths of the point in the simulated laboratory with {names}. The "
            "point starts from where the tip hangs."
        )
        plane = np.array([control.right, control.up], dtype=np.float64)
        blocks.append(canvas.figure("control", followed_paths(drawn, named, plane), alt, caption))
    blocks += [Text("How it was planned", heading=True), Items(_facts(metrics), "planned")]
    return Part("Control", blocks)


def followed_paths(paths: Sequence[FollowedPath], controllers: Mapping[str, str], plane: FloatArray) -> "Figure":
    """Draw paths and the paths of the controlled point, side by side in their plane.

    Args:
        paths: Paths and points.
        controllers: Names in words of the controllers that are drawn.
        plane: (2, 3) directions of the width and of the height.
    """
    from . import figures

    columns = min(_COLUMNS, len(paths))
    rows = -(-len(paths) // columns)
    figure = figures.new_figure(figures.WIDE / columns * rows + 0.35)
    every = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    first = plane[0] / np.linalg.norm(plane[0])
    second = plane[1] - (plane[1] @ first) * first
    across = 1e3 * np.stack([first, second / np.linalg.norm(second)])
    middle = np.mean([followed.path.mean(axis=0) for followed in paths], axis=0)
    lines: dict[str, Any] = {}
    for axes, followed in zip(every, paths, strict=False):
        x, y = ((followed.path - middle) @ across.T).T
        (lines["path"],) = axes.plot(x, y, color=figures.TONES["target"].light, linewidth=3.2)
        for controller, name in controllers.items():
            beginning, model = controller.split("_", 1)
            x, y = ((followed.points[controller] - middle) @ across.T).T
            tone = figures.TONES[model].light
            (lines[name],) = axes.plot(x, y, color=tone, linestyle=_LINES[beginning], linewidth=1.1)
        axes.set_aspect("equal")
        axes.set_title(followed.name)
        axes.grid(False)
    for axes in every[len(paths) :]:
        axes.set_visible(False)
    for axes in every:
        axes.tick_params(labelsize=figures.STYLE["xtick.labelsize"] - 1.5)
    every[0].set_ylabel("mm")
    figure.legend(list(lines.values()), list(lines), loc="outside upper left", ncols=4, columnspacing=1.6)
    return figure


def controller_name(controller: str) -> str:
    """Return the name of a controller in words."""
    return _words(controller)[0]


def _words(controller: str) -> tuple[str, str]:
    """The name and the description of a controller."""
    prefix = next(prefix for prefix in _KINDS if controller.startswith(prefix))
    name, meaning = _KINDS[prefix]
    rest = controller.removeprefix(prefix)
    return name.format(MODELS[rest][0] if rest in MODELS else rest), meaning


def _task(control: ControlSettings) -> str:
    shapes, tracked = control.shapes, control.tracked
    named = f"the mean of {', '.join(tracked[:-1])} and {tracked[-1]}" if len(tracked) > 1 else tracked[0]
    return (
        f"A point, {named}, follows {len(shapes)} paths ({', '.join(shapes)}) of {1e3 * control.size:g} mm, by "
        "inputs within their limits of value and rate, applied to the simulation that plays the robot. Errors are "
        "distances of the point from the path at the same time, without camera noise."
    )


def tracking_table(tracking: Mapping[str, Any]) -> PageTable:
    """Returns the errors of the controllers by the duration of the paths."""
    first = next(iter(tracking.values()))
    best = min(first, key=lambda controller: float(first[controller]["mean_mm"]))

    def cell(errors: Mapping[str, Any] | None) -> Cell:
        if errors is None:
            return Cell(NONE)
        return Cell(number_text(errors["mean_mm"]), beside=f"at most {number_text(errors['max_mm'])}")

    rows = []
    for controller in first:
        name, meaning = _words(controller)
        cells = [cell(errors.get(controller)) for errors in tracking.values()]
        rows.append(Row(name, cells, "best" * (controller == best), meaning))
    return PageTable("Mean error of the point [mm]", [f"Paths in {float(speed):g} s" for speed in tracking], rows)


def compared_controllers(control: ControlSettings) -> list[str]:
    """Returns the names of the controllers that are drawn."""
    models = [model for model in control.models if model in ("sysid", "law", control.models[-1])]
    return [*(f"open_{model}" for model in models), *(f"receding_{model}" for model in control.receding[-1:])]


def _facts(metrics: Mapping[str, Any]) -> list[str]:
    facts = []
    for model, reduced in metrics["reduced"].items():
        window, whole = mm_text(reduced["window_error_mm"]), mm_text(reduced["whole_error_mm"])
        facts.append(
            f"{MODELS[model][0]} in {reduced['modes']} modes: over {reduced['window_s']:g} s, {window} from the full "
            f"model, {100.0 * reduced['window_relative']:.1f} % of its motion; over whole motions, {whole}."
        )
    for model, motions in metrics["planned_mm"].items():  # By motion: errors before and after each correction.
        first, last = fmean(errors[0] for errors in motions.values()), fmean(map(min, motions.values()))
        facts.append(
            f"{MODELS[model][0]} follows its own plans to {mm_text(last)} after corrections by its full simulator, to "
            f"{mm_text(first)} before."
        )
    for controller, times in metrics["command_ms"].items():
        if controller.startswith("receding_"):
            facts.append(
                f"{controller_name(controller)}: a command takes {times['median']:.1f} ms, 95 % of them less than "
                f"{times['largest_of_20']:.1f} ms, estimate and plan together, on one core."
            )
    return facts


@dataclass(frozen=True, eq=False)
class DrivenBodies:
    """Motions of the simulated laboratory under several controllers, at the same T times."""

    times: FloatArray  # (T,) since the first command [s].
    triangles: IntArray  # (S, 3) of the surface.
    positions: Mapping[str, FloatArray]  # (T, N, 3) [m] of the vertices, by controller.
    points: Mapping[str, FloatArray]  # (T, 3) [m] controlled point, by controller.
    path: FloatArray  # (P, 3) [m] path that it follows.
    plane: FloatArray  # (2, 3) directions to the right and upwards in the plane of the path.
    gravity: FloatArray  # (3,) direction of gravity.

    def film(self, slower: float = 1.0) -> RenderScene:
        """Return the scene of a film: a view of each body with the path and the trail of the point, also enlarged.

        Args:
            slower: Factor of slow motion.
        """
        frames, fps = pace(self.times, slower)
        axes, placed = path_axes(self.plane, self.gravity), self._placed()
        seen = [*(q.reshape(-1, 3) for q in self.positions.values()), placed(self.path)]
        middle, half = frame_of(np.concatenate([*seen, *map(placed, self.points.values())]), axes)
        height = height_of(half, FILM_VIEW)
        room = HEADROOM * height
        legends = [[(controller_name(name), _colour(name))] for name in self.positions]
        legends[0].append(("path", TONES["muted"].light))
        views = [
            View(self._layers(name, frames, height, placed), axes, middle + room * axes[1], height + room, legend)
            for name, legend in zip(self.positions, legends, strict=True)
        ]
        texts = [f"{time:.2f} s" for time in self.times[frames]]
        return RenderScene(views, FILM_VIEW, background="white", fps=fps, texts=texts)

    def _placed(self) -> Placement:
        """Returns the map from points (..., 3) of the plane into the enlarged drawing beside the body."""
        axes = path_axes(self.plane, self.gravity)
        body = np.concatenate([q.reshape(-1, 3) for q in self.positions.values()]) @ axes[:2].T
        low, high = body.min(axis=0), body.max(axis=0)
        longer = float((high - low).max())
        right = self.plane[0] / np.linalg.norm(self.plane[0])
        up = self.plane[1] - (self.plane[1] @ right) * right
        across = np.stack([right, up / np.linalg.norm(up)])
        drawn = np.concatenate([self.path, *self.points.values()]) @ across.T
        first, last = drawn.min(axis=0), drawn.max(axis=0)
        larger = _DRAWING * longer / float((last - first).max())
        size, tall = larger * (last - first), high[1] - low[1] > high[0] - low[0]
        beside = (high[0] + _GAP * longer, 0.5 * (low[1] + high[1] - size[1]))
        above = (0.5 * (low[0] + high[0] - size[0]), high[1] + _GAP * longer)
        corner = np.array(beside if tall else above) - larger * first
        return lambda points: (larger * (points @ across.T) + corner) @ axes[:2]

    def _layers(self, controller: str, frames: IntArray, half: float, placed: Placement) -> list[Layer]:
        before, colour = {name: half * shift for name, shift in _BEFORE.items()}, _colour(controller)
        body, grey = self.positions[controller][frames], TONES["target"].light
        layers = [
            Layer("surface", body, self.triangles, BODIES[1], light=BODY_LIGHT),
            Layer("lines", body, sharp_edges(body[0], self.triangles), INK, size=1.5, shift=before["edges"]),
        ]
        for place, (wide, thin) in ((np.asarray, _WIDTHS[0]), (placed, _WIDTHS[1])):
            path, points = place(self.path), place(self.points[controller])
            corners = _corners(path, _APART * half)
            trail = points[np.minimum(_corners(points, _APART * half), frames[:, None])]  # The part that follows is
            trail = np.concatenate([trail, points[frames, None]], axis=1)  # at the point.
            layers += [
                Layer("lines", path[corners], chain(len(corners)), grey, size=wide, shift=before["path"]),
                Layer("lines", trail, chain(trail.shape[1]), colour, size=thin, shift=before["trail"]),
                Layer("balls", points[frames, None], None, colour, size=_POINT * half, shift=before["point"]),
            ]
        return layers


def _corners(points: FloatArray, apart: float) -> IntArray:
    """Indices of the first and last of points (T, 3), and of points in between at a least distance along the line."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    _, first = np.unique(np.floor(along / apart), return_index=True)
    return np.unique(np.append(first, len(points) - 1))


def _colour(controller: str) -> str:
    """Colour of the controller's model, as in the figures."""
    model = controller.partition("_")[2]
    return TONES[model if model in TONES else "ink"].light
