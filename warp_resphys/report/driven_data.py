"""What the reports of motions that pressure drives show."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..learning.metrics import PublishedError
from ..mesh.chambers import Chamber
from .measured_data import SplitReport

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_TIP: Final = 0.12  # Markers that are so close to the farthest one from the clamp are at the tip, over its distance.
_OTHER: Final = 0.25  # How far from the tip's height another marker must be to tell more than those.


@dataclass(frozen=True, eq=False)
class Actuation:
    """The pressures of all trials.

    Attributes:
        chambers: C names.
        pressure: (K, C) gauge pressure during each step [Pa], by trial.
        limit: That none may exceed [Pa]; None where there is none.
    """

    chambers: tuple[str, ...]
    pressure: Mapping[str, FloatArray]
    limit: float | None


@dataclass(frozen=True, eq=False)
class Film:
    """The bodies in the first test trial.

    Attributes:
        steps: (F,) of the frames.
        positions: (F, N, 3) [m] by model, NaN from where it diverged.
    """

    steps: IntArray
    positions: Mapping[str, FloatArray]


@dataclass(frozen=True, eq=False, kw_only=True)
class DrivenReport(SplitReport):
    """Everything that the page of a split of motions under pressure shows.

    Its metrics are those of `errors.json` with `seconds` and `peak_memory_gib` of the stages. The trials are those of
    the test split; their frames stand at the steps of the simulation.

    Attributes:
        chambers: Closed chambers of the body.
        actuation: The pressures.
        film: What the video shows.
        beyond: Names of the roll-outs at higher pressure than that of the training.
        published_windows: Published errors by length of the roll-out [s] and model.
        reconstruction: `mean_mm` and `max_mm` of the reconstructed training trials, and `replayed_mm` of those for
            validation with their forces replayed, None where the simulator failed; empty where not known.
    """

    chambers: tuple[Chamber, ...]
    actuation: Actuation
    film: Film
    beyond: tuple[str, ...]
    published_windows: Mapping[str, Mapping[str, PublishedError]]
    reconstruction: Mapping[str, Any]


def tip_markers(bound: FloatArray, clamped: FloatArray) -> IntArray:
    """Return which markers are at the tip: about as far along the body from its clamped end as any.

    Args:
        bound: (M, 3) [m] at rest.
        clamped: (F, 3) [m] vertices of the clamped end.
    """
    away = along_body(bound, clamped)
    found: IntArray = np.flatnonzero(away >= (1.0 - _TIP) * away.max())
    return found


def along_body(bound: FloatArray, clamped: FloatArray) -> FloatArray:
    """Return (M,) how far markers are from the clamped end, in the direction from it to their middle [m].

    Args:
        bound: (M, 3) [m] at rest.
        clamped: (F, 3) [m] vertices of the clamped end.
    """
    start = clamped.mean(axis=0)
    axis = bound.mean(axis=0) - start
    length = float(np.linalg.norm(axis))
    along: FloatArray = (bound - start) @ (axis / length) if length > 0.0 else np.zeros(len(bound))
    return along


def drawn_markers(measured: FloatArray, bound: FloatArray, clamped: FloatArray) -> list[int]:
    """Return the marker at the tip that moves most and, where there is one well above the tip, that of those.

    Args:
        measured: (T, M, 3) [m], NaN where a marker was not seen.
        bound: (M, 3) [m] at rest.
        clamped: (F, 3) [m] vertices of the clamped end.
    """
    moved = np.nanmax(np.linalg.norm(measured - bound, axis=2), axis=0, initial=0.0)  # (M,) [m]
    away = along_body(bound, clamped)
    tip = tip_markers(bound, clamped)
    others = np.flatnonzero(away < (1.0 - _OTHER) * away.max())
    groups = [group for group in (tip, others) if len(group)]
    return [int(group[np.argmax(moved[group])]) for group in groups]


def mean_of(markers: FloatArray, chosen: IntArray) -> FloatArray:
    """Return (T, 3) the mean of some markers [m], not finite where one of them is not.

    Args:
        markers: (T, M, 3) [m].
        chosen: Which.
    """
    mean: FloatArray = markers[:, chosen].mean(axis=1)
    return mean
