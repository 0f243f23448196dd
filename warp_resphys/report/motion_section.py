"""The section of the page of a run on the motion in a trial: a film, a view in space, and pictures.

The view in space is turned and played in a browser (`view.js`). Vertices of a motion are stored for
it in a reduced basis: rest positions, singular vectors of the displacements of all models, and
their weights in each frame. Ten seconds of an arm take a few hundred kilobytes.
"""

import base64
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from markupsafe import Markup
from matplotlib import colormaps
from matplotlib.colors import to_hex

from ..core.mesh.volume_mesh import boundary_triangles, surface_vertices
from ..data.camera import frame_of, motion_axes, upwards
from ..io.arrays import FloatArray
from ..learning.metrics import mean_distance
from . import figures
from .body_motions import (
    LABORATORY_MARKERS,
    MEASURED_MARKERS,
    TARGET_VERTICES,
    ComparedMotion,
    hangs,
    without_diverged,
)
from .data import Film, RunReport, at_times, shown_markers, spread
from .layers import MEASURED, OBSTACLE, OUTLINE, face_edges, sharp_edges
from .page import Block, Canvas, Drawn, Part, ShownModel, ViewInSpace
from .render import Pixels, draw, write_film
from .wording import MODELS, TONES, shown_models, unbroken

_MOST_POINTS: Final = 6  # Vertices of the tip that are shown, where every vertex is observed.
_MOST_FRAMES: Final = 256  # Of the view in space.
_TOLERANCE: Final = 2e-4  # Largest error of a vertex of the view in space, over the body's size,
_MOST_MODES: Final = 96  # unless it takes more modes than these.
_DIVERGED: Final = (
    3.0  # Distance from rest beyond which a body is not drawn there, over the body's size.
)
_COLOUR_MAP: Final = "viridis"
_STOPS: Final = 32  # Of the colour map.
_LEVELS: Final = 255  # Of the errors of a model, from zero to the largest.


def motion_of(data: RunReport, *, every_model: bool = False) -> ComparedMotion | None:
    """Returns the motion that is drawn: that of the film or,
    where vertices are observed, of the worst trial.

    It has the two models that are compared in pictures, or every model.
    """
    trials, film = data.trials, data.film
    if trials is None:
        return None
    from_below, away = hangs(data.mesh, data.fixed, trials.gravity)
    points = None
    if not trials.labels:
        row = trials.worst
        film = Film(
            trials.names[row], trials.times[row], {m: q[row] for m, q in trials.positions.items()}
        )
        points = data.tip if len(data.tip) else np.flatnonzero(away >= away.max() - 1e-9)
        points = spread(points, _MOST_POINTS)
    if film is None or film.trial not in trials.names:
        return None
    row = trials.names.index(film.trial)
    models = shown_models(film.positions, data.metrics.get("recommended", ""))
    if not models:
        return None
    if every_model:
        models = [
            model for model in MODELS if model in film.positions and model in trials.positions
        ]
    points = shown_markers(trials.target[row]) if points is None else points
    times = trials.times[row]
    frames = np.flatnonzero(np.append(True, np.diff(times) > 0.0))
    if len(frames) > len(film.times):  # The frames that are closest to those of the film.
        nearest = np.abs(times[frames][:, None] - film.times).argmin(axis=0)
        frames = frames[np.unique(nearest)]
    observed = LABORATORY_MARKERS if "laboratory" in data.settings.targets else MEASURED_MARKERS
    return ComparedMotion(
        mesh=data.mesh,
        times=times[frames],
        measured=trials.target[row][frames][:, points],
        positions={m: at_times(film.positions[m], film.times, times[frames]) for m in models},
        markers={m: trials.positions[m][row][frames][:, points] for m in models},
        bound=trials.bound[points],
        gravity=trials.gravity,
        from_below=from_below,
        target=None if trials.labels else trials.target[row][frames],
        obstacles=data.obstacles_at(film.trial, times[frames]),
        observed=observed if trials.labels else TARGET_VERTICES,
    )


def motion_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns a film, a view in space and a few instants of a trial."""
    motion, trials = motion_of(data), data.trials
    if motion is None or trials is None:
        return None
    models, best = list(motion.positions), data.metrics.get("recommended", "")
    name = (
        data.film.trial
        if data.film is not None and data.sees_markers
        else trials.names[trials.worst]
    )
    colours = f"Grey: {MODELS[models[0]].name}. " if len(models) > 1 else ""
    colours += f"Blue: {MODELS[models[-1]].name}{', the recommended model' * (models[-1] == best)}."
    blocks: list[Block] = []
    # A film takes longer than the rest of the page; where vertices are observed, it adds nothing to
    # the instants.
    if data.sees_markers and len(motion.times) > 1:
        views = (
            "from the side and from below"
            if motion.from_below
            else "the whole body, and its markers from nearby"
        )
        pace = "four times slower than real time" if motion.is_fast else "in real time"
        caption = Markup(
            "The trial {}, {}: {}. {} Dots: {}; rings: simulated. The film lies in "
            "<code>figures/motion.mp4</code>."
        ).format(name, pace, views, colours, motion.observed)
        alt = "The simulated bodies and what was observed, in motion"
        blocks.append(
            canvas.rendered(
                "motion.mp4",
                lambda renderer: write_film(canvas.folder / "motion.mp4", motion.film(), renderer),
                lambda path, _: replace(Drawn.of(path, alt, caption), name="video"),
            )
        )
    blocks += _in_space(data, name)
    same = "The same trial" if blocks else f"The trial {name}"
    instants = canvas.rendered(
        "motion.png",
        lambda renderer: draw(motion.scene(), renderer),
        lambda _, frames: _instants_figure(data, motion, frames, same, colours, canvas),
    )
    where = ", beyond the training loads" if name in data.others else ""
    return Part(f"One test trial: {name}{where}", [*blocks, instants])


def _in_space(data: RunReport, name: str) -> list[Block]:
    """Returns an interactive view of the bodies of all models."""
    motion = motion_of(data, every_model=True)
    if motion is None:
        return []
    motion = motion.at(spread(np.arange(len(motion.times)), _MOST_FRAMES))
    compared, against = (
        ("markers", "the measured ones") if data.sees_markers else ("vertices", "the target")
    )
    caption = (
        f"The trial {name} in space: drag to turn, with Shift to move, pinch or scroll to zoom; "
        "arrow keys turn, plus and minus zoom, the space bar plays, comma and full stop step, 0 "
        f"resets. Colours show the distance of the {compared} of the solid body from {against}, "
        "from zero to the largest in this trial."
    )
    alt = (
        "An interactive view of the bodies of "
        f"{', '.join(MODELS[model].name for model in motion.positions)} in motion."
    )
    shown = shown_models(motion.positions, data.metrics.get("recommended", ""))
    return [view_in_space("view", motion, shown, unbroken(caption), alt)]


def _instants_figure(
    data: RunReport, motion: ComparedMotion, frames: Pixels, name: str, colours: str, canvas: Canvas
) -> Drawn:
    """Shows the body at a few instants (F, H, 2 W, 4), each with a second view of its markers."""
    titles = [f"{motion.times[frame]:.2f} s" for frame in motion.instants]
    caption = f"{name} at {len(titles)} instants, one with the largest error of the grey body."
    when = ", ".join(titles)
    if len(motion.times) == 1:  # A pose.
        titles = [""]
        caption = f"{name}."
        when = "rest"
    caption += (
        " Drawn to scale; "
        f"{'below, the view from below' if motion.from_below else 'the second view follows'}"
    )
    caption += (
        "."
        if motion.from_below
        else (" the markers." if data.sees_markers else " some vertices of the tip.")
    )
    if not data.sees_markers:
        caption += f" {colours} Dots: the target’s tip; rings: simulated."  # noqa: RUF001
    last = list(motion.positions)[-1]
    if data.metrics["errors_mm"][last]["diverged"]:
        caption += f" Where {MODELS[last].name} is not drawn, it has diverged."
    alt = f"The deformed body at {when}, with observed and simulated markers."
    count = len(frames)
    height, width = frames.shape[1:3]
    figure = figures.new_figure(4.0 * height / width * figures.WIDE / count + 0.35)
    panels = figure.subplots(2, count, squeeze=False)
    for row, frame, title in zip(panels.T, frames, titles, strict=True):
        for axes, picture in zip(row, np.split(frame, 2, axis=1), strict=True):
            axes.imshow(picture)
            axes.set_axis_off()
        row[0].set_title(title)
    return canvas.figure("motion", figure, alt, caption)


def view_in_space(
    name: str, motion: ComparedMotion, shown: Sequence[str], caption: str, alt: str
) -> ViewInSpace:
    """Returns the view of all bodies of a motion, of which some models are shown at first.

    With a target, vertices are compared with it; without one, markers are compared.
    """
    mesh, obstacles = motion.mesh, motion.obstacles
    surface = surface_vertices(motion.mesh)
    rest, faces = mesh.vertices[surface], np.searchsorted(surface, boundary_triangles(mesh))
    size = float(np.ptp(mesh.vertices, axis=0).max())
    finite = partial(without_diverged, far=_DIVERGED * size)
    # (B, F, S, 3)
    places = np.stack([finite(q[:, surface], rest) for q in motion.positions.values()])
    axes = motion_axes(motion.gravity, np.concatenate([rest[None], *places]))
    points = np.concatenate([rest, places.reshape(-1, 3)])
    centre, half = frame_of(np.concatenate([points, obstacles.near(points)]), axes)
    has_markers = True
    simulated = np.stack([*motion.markers.values()])
    target = motion.measured
    compared = np.arange(len(motion.bound))
    if motion.target is not None:
        has_markers = False
        target = motion.target
        compared = surface
        simulated = np.stack([finite(q, mesh.vertices) for q in motion.positions.values()])
    means = mean_distance(simulated, np.broadcast_to(target, simulated.shape))  # (B, F) [mm]
    largest, shares = _error_shares(simulated[:, :, compared], target[:, compared], places)
    models: list[ShownModel] = [
        {
            "name": MODELS[model].name,
            "light": TONES[model].light,
            "dark": TONES[model].dark,
            "shown": model in shown,
            "largest": float(f"{most:.4g}"),
            "means": [float(f"{mean:.4g}") if np.isfinite(mean) else None for mean in by_frame],
        }
        for model, most, by_frame in zip(motion.positions, largest, means, strict=True)
    ]
    data = {
        "times": [float(f"{time:.6g}") for time in motion.times],
        "rest": _encoded(rest, "<f4"),
        "faces": _encoded(faces, "<u4"),
        "edges": _encoded(np.searchsorted(surface, face_edges(mesh)), "<u4"),
        "sharp": _encoded(sharp_edges(rest, faces), "<u4"),
        "obstacles": _encoded(obstacles.local, "<f4"),
        "owners": _encoded(obstacles.owners, "<u4"),
        "poses": _encoded(obstacles.poses, "<f4"),
        "sides": _encoded(obstacles.triangles, "<u4"),
        **_encoded_motion(places - rest, size),
        "errors": None if has_markers else _encoded(np.rint(shares), "u1"),
        "markers": motion.measured.shape[1] if has_markers else 0,
        "measured": _encoded(motion.measured if has_markers else [], "<f4"),
        "simulated": _encoded(simulated if has_markers else [], "<f4"),
        "models": models,
        **{"axes": axes.tolist(), "up": upwards(motion.gravity).tolist()},
        **{"centre": centre.tolist(), "half": half.tolist()},
        "colours": [to_hex(stop) for stop in colormaps[_COLOUR_MAP](np.linspace(0.0, 1.0, _STOPS))],
        "ink": TONES["ink"]._asdict(),
        **{"outline": OUTLINE, "solid": OBSTACLE, "seen": MEASURED},
    }
    payload = Markup(
        json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    )
    kind, speed = "markers" if has_markers else "vertices", 0.25 if motion.is_fast else 1.0
    return ViewInSpace(name, caption, alt, payload, models, len(motion.times), speed, kind)


def _error_shares(
    simulated: FloatArray, target: FloatArray, places: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The largest distances (B,) [mm] of points (B, F, P, 3) from a target (F, P, 3),
    and all over it, up to `_LEVELS`.

    Frames in which a body (B, F, S, 3) is not drawn do not count.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        away = 1e3 * np.linalg.norm(simulated - target, axis=3)
    drawn = np.isfinite(places.reshape(*places.shape[:2], -1).sum(axis=2))[..., None]  # (B, F, 1)
    away = np.where(drawn, away, np.nan)
    largest = np.where(np.isfinite(away), away, 0.0).max(axis=(1, 2), initial=0.0)
    return largest, np.nan_to_num(_LEVELS * away / np.maximum(largest, 1e-300)[:, None, None])


def _encoded_motion(displacements: FloatArray, size: float) -> dict[str, Any]:
    """Basis of displacements (B, F, S, 3) of bodies of a size [m],
    with its scales, and their weights.
    """
    basis, weights = reduced(displacements, _TOLERANCE * size, _MOST_MODES)
    scales = (
        np.maximum(np.abs(basis).max(axis=1), np.finfo(np.float32).tiny) / np.iinfo(np.int16).max
    )
    modes = _encoded(np.rint(basis / scales[:, None]), "<i2")
    return {"modes": modes, "scales": scales.tolist(), "weights": _encoded(weights, "<f4")}


def reduced(
    displacements: FloatArray, tolerance: float, most: int
) -> tuple[FloatArray, FloatArray]:
    """Returns the fewest singular vectors (K, 3 S) that represent displacements,
    and their weights (B, F, K).

    Args:
        displacements: (B, F, S, 3) [m] of S points in F frames of B bodies, NaN in frames that are
            left out.
        tolerance: Largest error of a coordinate [m], unless it takes more vectors than `most`.
        most: Largest number of vectors.

    Returns:
        Vectors of unit length, or one of zeros for bodies at rest, and weights [m], NaN in frames
        that are left out.
    """
    count, frames = displacements.shape[:2]
    rows = displacements.reshape(count * frames, -1)
    finite = np.isfinite(rows).all(axis=1)
    remaining = rows[finite].copy()
    # Most often there are fewer frames than coordinates.
    _, left = np.linalg.eigh(remaining @ remaining.T)
    basis = np.empty((0, rows.shape[1]))
    while len(basis) < min(most, left.shape[1]) and np.abs(remaining).max(initial=0.0) > tolerance:
        vector = left[:, -1 - len(basis)] @ remaining
        vector /= np.linalg.norm(vector)
        remaining -= np.outer(remaining @ vector, vector)
        basis = np.concatenate([basis, vector[None]])
    if not len(basis):  # At rest, a vector of zeros, whose weights tell which frames are finite.
        basis = np.zeros((1, rows.shape[1]))
    weights = np.full((len(rows), len(basis)), np.nan)
    weights[finite] = rows[finite] @ basis.T
    return basis, weights.reshape(count, frames, -1)


def _encoded(values: npt.ArrayLike, kind: str) -> str:
    """Encodes numbers for the script of the page."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=np.dtype(kind)).tobytes()).decode(
        "ascii"
    )
