"""An interactive view of the bodies of a trial for the page, to be turned and played in a browser.

Vertices of a motion are stored in a reduced basis: rest positions, singular vectors of the displacements of all models,
and their weights in each frame. Ten seconds of an arm take a few hundred kilobytes.
"""

import base64
import json
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
from markupsafe import Markup
from matplotlib import colormaps
from matplotlib.colors import to_hex

from ..io.arrays import FloatArray
from ..learning.metrics import mean_distance
from ..mesh.mesh import boundary_triangles, surface_vertices
from .bodies import ComparedMotion, face_edges, sharp_edges, without_diverged
from .data import MODELS
from .figures import TONES
from .obstacles import OBSTACLE
from .page import ViewInSpace
from .render import MEASURED, OUTLINE, frame_of, motion_axes, upwards

_TOLERANCE: Final = 2e-4  # Largest error of a drawn vertex, over the body's size,
_MOST_MODES: Final = 96  # unless it takes more modes than these.
_DIVERGED: Final = 3.0  # Distance from rest beyond which a body is not drawn, over the body's size.
_COLOUR_MAP: Final = "viridis"
_STOPS: Final = 32  # Of the colour map.
_LEVELS: Final = 255  # Of the errors of a model, from zero to the largest.


def view_in_space(name: str, motion: ComparedMotion, shown: Sequence[str], caption: str, alt: str) -> ViewInSpace:
    """Return the view of all bodies of a motion.

    Args:
        name: Its identifier on the page.
        motion: With a target, vertices are compared with it; without one, markers are compared.
        shown: Models that are shown at first.
        caption: Below the view.
        alt: Description of the view.
    """
    surface = surface_vertices(motion.mesh)
    rest, faces = motion.mesh.vertices[surface], np.searchsorted(surface, boundary_triangles(motion.mesh))
    size = float(np.ptp(motion.mesh.vertices, axis=0).max())
    places = np.stack(
        [without_diverged(q[:, surface], rest, _DIVERGED * size) for q in motion.positions.values()]
    )  # (B, F, S, 3)
    basis, weights = reduced(places - rest, _TOLERANCE * size, _MOST_MODES)
    scales = np.maximum(np.abs(basis).max(axis=1), np.finfo(np.float32).tiny) / np.iinfo(np.int16).max
    axes = motion_axes(motion.gravity, np.concatenate([rest[None], *places]))
    points = np.concatenate([rest, places.reshape(-1, 3)])
    centre, half = frame_of(np.concatenate([points, motion.obstacles.near(points)]), axes)
    has_markers, rest_of_all, compared = motion.target is None, motion.mesh.vertices, np.arange(len(motion.bound))
    if motion.target is None:
        simulated, target = np.stack([*motion.markers.values()]), motion.measured
    else:
        whole = [without_diverged(q, rest_of_all, _DIVERGED * size) for q in motion.positions.values()]
        simulated, target, compared = np.stack(whole), motion.target, surface
    means = mean_distance(simulated, np.broadcast_to(target, simulated.shape))  # (B, F) [mm]
    with np.errstate(invalid="ignore", over="ignore"):
        away = 1e3 * np.linalg.norm(simulated[:, :, compared] - target[:, compared], axis=3)
    drawn = np.isfinite(places.reshape(*places.shape[:2], -1).sum(axis=2))[..., None]  # (B, F, 1)
    away = np.where(drawn, away, np.nan)
    largest = np.where(np.isfinite(away), away, 0.0).max(axis=(1, 2), initial=0.0)
    shares = np.nan_to_num(_LEVELS * away / np.maximum(largest, 1e-300)[:, None, None])
    models = [
        {
            "name": MODELS[model][0],
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
        "edges": _encoded(np.searchsorted(surface, face_edges(motion.mesh)), "<u4"),
        "sharp": _encoded(sharp_edges(rest, faces), "<u4"),
        "obstacles": _encoded(motion.obstacles.local, "<f4"),
        "owners": _encoded(motion.obstacles.owners, "<u4"),
        "poses": _encoded(motion.obstacles.poses, "<f4"),
        "sides": _encoded(motion.obstacles.triangles, "<u4"),
        "modes": _encoded(np.rint(basis / scales[:, None]), "<i2"),
        "scales": scales.tolist(),
        "weights": _encoded(weights, "<f4"),
        "errors": None if has_markers else _encoded(np.rint(shares), "u1"),
        "markers": motion.measured.shape[1] if has_markers else 0,
        "measured": _encoded(motion.measured if has_markers else [], "<f4"),
        "simulated": _encoded(simulated if has_markers else [], "<f4"),
        "models": models,
        "axes": axes.tolist(),
        "up": upwards(motion.gravity).tolist(),
        "centre": centre.tolist(),
        "half": half.tolist(),
        "colours": [to_hex(stop) for stop in colormaps[_COLOUR_MAP](np.linspace(0.0, 1.0, _STOPS))],
        "ink": {"light": TONES["ink"].light, "dark": TONES["ink"].dark},
        "outline": OUTLINE,
        "solid": OBSTACLE,
        "seen": MEASURED,
    }
    payload = Markup(json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"))
    speed = 0.25 if motion.is_fast else 1.0
    return ViewInSpace(
        name, caption, alt, payload, models, len(motion.times), speed, "markers" if has_markers else "vertices"
    )


def reduced(displacements: FloatArray, tolerance: float, most: int) -> tuple[FloatArray, FloatArray]:
    """Return the fewest singular vectors (K, 3 S) that represent displacements, and their weights (B, F, K).

    Args:
        displacements: (B, F, S, 3) [m] of S points in F frames of B bodies, NaN in frames that are left out.
        tolerance: Largest error of a coordinate [m], unless it takes more vectors than `most`.
        most: Largest number of vectors.

    Returns:
        Vectors of unit length, or one of zeros for bodies at rest, and weights [m], NaN in frames that are left out.
    """
    count, frames, *_ = displacements.shape
    rows = displacements.reshape(count * frames, -1)
    finite = np.isfinite(rows).all(axis=1)
    remaining = rows[finite].copy()
    _, left = np.linalg.eigh(remaining @ remaining.T)  # Most often there are fewer frames than coordinates.
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
    return base64.b64encode(np.ascontiguousarray(values, dtype=np.dtype(kind)).tobytes()).decode("ascii")
