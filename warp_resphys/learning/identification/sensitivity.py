"""Derivatives of predicted markers by the identified parameters, and what follows from them.

That is how uncertain predictions are because the parameters are, predictions without a trial that
was identified from, and what could explain the errors that remain: gain and zero of the inputs, or
marker places. Every such quantity is fitted to the trial itself, so that the fits tell where an
error comes from and are no predictions: where a scale of the inputs takes most of an error away,
the simulator lacks physics of the actuator, or the recording does not contain what the actuator
did.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from typing import Any, TypedDict

import numpy as np
import torch

from ...core.dynamics.simulator import Simulator
from ...core.linalg.threads import in_threads, thread_count
from ...data.marker_view import ViewedMarkers
from ...data.markers import Markers
from ...data.rigid_bodies import as_markers, owners
from ...data.trials import Trials
from ...io.arrays import FloatArray
from ...io.errors import ConvergenceError, listed
from ...io.parts import cut
from ...io.progress import Progress
from ..metrics import mean_distance
from ..observed_motions import ObservedMotions
from ..parameters import (
    HUNG,
    configured_parameters,
    exact,
    parameters_of_parts,
    split_name,
    value_name,
)
from ..placement import DisplacedMarkers, Placement, by_placement, placement_of
from .search import Identification

log = logging.getLogger(__name__)

# Of a parameter, over its standard deviation, or over the typical size of an input's response.
_DIFFERENCE = 1e-3


@dataclass(frozen=True)
class Sensitivity:
    """The markers of a trial as a simulator predicts them, and their derivatives.

    Attributes:
        points: (T, M, 3) [m].
        by_parameter: (T, M, 3) by parameter; a value of the trial's own moves in place of the
            common one.
        by_placement: (T, M, 3, 3 M + 6) by the offsets of the markers on the body, and the shift
            and the rotation vector of the recording's frame; None where markers are seen in part.
    """

    points: FloatArray
    by_parameter: Mapping[str, FloatArray]
    by_placement: FloatArray | None


def _responses(trials: Trials) -> dict[str, str]:
    """Parameters for a scale and a zero of inputs that drive trials, by name, with their word."""
    driven = [name for name, values in trials.inputs.items() if name not in HUNG and values.any()]
    return {f"{name}_{word}": word for name, word in product(driven, ("factor", "zero"))}


def sensitivities(
    simulator: Simulator,
    motions: ObservedMotions,
    names: Sequence[str],
    identified: Identification,
    batch: int | None = None,
) -> dict[str, Sensitivity]:
    """Returns derivatives of trials by parameters of a simulator and gains and zeros of its inputs.

    Args:
        simulator: of which the parameters were identified.
        motions: trials with markers.
        names: names of the trials; those that cannot be simulated are left out, which a warning
            says.
        identified: parameters and their uncertainty.
        batch: largest number of trials that are simulated together; None for all.
    """
    simulator = exact(simulator)
    found = dict[str, Sensitivity]()
    moved = dict[str, float]()
    for name, word in _responses(motions.trials).items():
        inputs = motions.trials.inputs[name.removesuffix(f"_{word}")]
        moved = {name: 1.0 if word == "factor" else float(np.abs(inputs).max())} | moved
    moved |= identified.deviation
    moved = {name: _DIFFERENCE * size for name, size in moved.items()}

    def differentiated(some: Sequence[str]) -> dict[str, Sensitivity]:
        try:
            return _of_batch(simulator, motions, some, identified, moved)
        except ConvergenceError as error:
            log.warning(
                "evaluate: the posterior does not widen the intervals of %s: %s",
                listed(some),
                error,
            )
            return {}

    threads = thread_count() if simulator.rest_positions.device.type == "cpu" else 1
    with (
        Progress("Differentiating the test trials", len(names), "trials") as progress,
        torch.no_grad(),
    ):
        whole = motions.trials.batches(names)
        for _, some in chain.from_iterable(cut(alike, batch) for alike in whole):
            for shared in in_threads(
                differentiated, [part for k in range(threads) if (part := some[k::threads])]
            ):
                found |= shared
            progress.advance(len(some))
    return found


def _of_batch(
    simulator: Simulator,
    motions: ObservedMotions,
    names: Sequence[str],
    identified: Identification,
    moved: Mapping[str, float],
) -> dict[str, Sensitivity]:
    """Derivatives of trials of one of `Trials.batches`, from steps of parameters."""
    observe, trials = motions.observe, motions.trials
    replay, placement = motions.replay(simulator, names, identified), None
    start = motions.start(replay, identified)
    if isinstance(observe, Markers) and not isinstance(observe, ViewedMarkers):
        assert trials.bound is not None
        placement = Placement.none(
            len(trials.labels), simulator.tensor(np.mean(trials.bound, axis=0))
        )
        if identified.placement is not None:
            placement = placement_of(identified.placement, trials.labels, trials.session(names[0]))
            placement = placement.to(simulator.rest_positions)
        unplaced = motions.replay(simulator, names, replace(identified, placement=None))
        replay, start = DisplacedMarkers.replay(unplaced, start)
    configured = {
        name: simulator.tensor([x]) for name, x in configured_parameters(simulator, moved).items()
    }
    sets = {
        name: x.repeat(1 + len(moved))
        for name, x in {**configured, **identified.values(simulator)}.items()
    }
    rows = {parameter: row for row, parameter in enumerate(moved, 1)}
    of_parts = parameters_of_parts(simulator)
    for name in sets:
        parameter = split_name(name)[0]
        if parameter in moved:
            sets[name][rows[parameter]] += moved[parameter]
        whole = of_parts.get(parameter, ("", 0))[0]
        if whole in moved and whole not in identified.parameters:
            # What moves all parts moves each: factors relatively.
            sets[name][rows[whole]] += moved[whole] * (
                sets[name][0] if whole.endswith("_factor") else 1.0
            )
    points, _ = (replay.varied if moved and not replay.is_static else replay.sensed)(start, sets)
    slopes: Any = [None] * len(names)
    if placement is not None:
        points, rotations = placement.places(points)
        slopes = by_placement(placement, points[0], rotations[0]).double().cpu().numpy()
    shown = points.double().cpu().numpy()
    return {
        name: Sensitivity(
            points=shown[0, trial],
            by_parameter={
                p: (shown[row, trial] - shown[0, trial]) / moved[p] for p, row in rows.items()
            },
            by_placement=slopes[trial],
        )
        for trial, name in enumerate(names)
    }


def parameter_spread(
    trials: Trials,
    names: Sequence[str],
    identified: Identification,
    linear: Mapping[str, Sensitivity],
    left_out: bool = False,
) -> FloatArray | None:
    """Returns the variance of predicted markers under the posterior of identified parameters.

    The variance is to first order, J S J^T with the derivatives J of the markers by the parameters
    and the covariance S of these, so that it grows with the distance from the trials that determine
    them. In a session without identified trials, the prior of its placement adds its variance. The
    ranges of the parameters limit their covariance.

    Args:
        trials: of the motions.
        names: names of R trials; those without derivatives have no spread.
        identified: parameters and their uncertainty.
        linear: derivatives by trial, from `sensitivities`.
        left_out: whether the posterior of a trial that was identified from is that without it.

    Returns:
        Means (R, T, M) over the coordinates, of markers and of the positions of rigid bodies [m^2];
        None if the uncertainty of the parameters is not known.
    """
    uncertainty, placement = identified.uncertainty, identified.placement
    if uncertainty is None:
        return None
    ranges = np.array([*uncertainty.ranges.values()])
    spread = np.zeros((len(names), trials.observed.shape[1], len(owners(trials.labels))))
    for row, name in ((row, name) for row, name in enumerate(names) if name in linear):
        posterior = uncertainty.left_out.get(name, uncertainty) if left_out else uncertainty
        deviation = np.array([*posterior.deviation.values()])
        correlation = np.array(posterior.correlation)
        session = trials.session(name)
        for at, parameter in enumerate(posterior.deviation):
            of_trial = (
                identified.of_trials_deviation.get(value_name(parameter, owner))
                for owner in (name, session)
            )
            known = next((value for value in of_trial if value is not None), None)
            if known is not None:
                deviation[at] = known
                correlation[at] = 0.0
                correlation[:, at] = 0.0
                correlation[at, at] = 1.0
        root = deviation[:, None] * _root(correlation, deviation / ranges)
        slopes = np.stack(
            [linear[name].by_parameter[parameter] for parameter in posterior.deviation]
        )
        moved = as_markers(np.einsum("eTmc,ei->iTmc", slopes, root), trials.labels)
        spread[row, : moved.shape[1]] = np.nan_to_num(np.square(moved).sum(0).mean(-1))
        places = linear[name].by_placement
        if placement is None or places is None:
            continue
        if "sessions" in placement and session not in placement["sessions"]:
            moved = as_markers(places @ np.array(placement["new_session"]), trials.labels, -3)
            spread[row, : len(moved)] += np.nan_to_num(np.square(moved).sum(-1).mean(-1))
    return spread


def _root(correlation: FloatArray, shares: FloatArray) -> FloatArray:
    """R with R R^T the covariance of parameters over their standard deviations,
    which their ranges limit.

    A range counts as a normal distribution of the variance of a uniform one: where the data leave a
    parameter open, the linearised posterior would reach far beyond it.

    Args:
        correlation: (P, P) of the posterior.
        shares: (P,) standard deviations over the ranges.
    """
    limited = np.linalg.solve(np.eye(len(shares)) + correlation * (12.0 * shares**2), correlation)
    sizes, vectors = np.linalg.eigh(0.5 * (limited + limited.T))
    return np.asarray(vectors * np.sqrt(np.maximum(sizes, 0.0)))


def left_out_changes(
    trials: Trials,
    names: Sequence[str],
    identified: Identification,
    linear: Mapping[str, Sensitivity],
) -> FloatArray | None:
    """Returns by what predictions of trials change if parameters are identified
    without them, to first order.

    Returns:
        (R, T, M, 3) [m]; None if no trial changes, as those from which nothing was identified.
    """
    left_out = {} if identified.uncertainty is None else identified.uncertainty.left_out
    changes = np.zeros((len(names), *trials.observed.shape[1:]))
    used = [row for row, name in enumerate(names) if name in left_out and name in linear]
    for row in used:
        slopes, without = linear[names[row]], left_out[names[row]]
        change = sum(slopes.by_parameter[name] * by for name, by in without.change.items())
        if without.placement is not None and slopes.by_placement is not None:
            change = change + slopes.by_placement @ np.array(without.placement)
        changes[row, : len(slopes.points)] = change
    return changes if used else None


class FreeFit(TypedDict):
    """Mean error of a trial [mm], and what would remain of it
    if something were free, see `free_fits`.
    """

    name: str
    as_is_mm: float
    left_mm: dict[str, float]
    values: dict[str, float]


def free_fits(
    trials: Trials,
    observed: Mapping[str, FloatArray],
    simulated: Mapping[str, FloatArray],
    linear: Mapping[str, Sensitivity],
) -> list[FreeFit]:
    """Returns what would remain of the errors of trials if something were free, by trial.

    The keys of ``left_mm`` and ``values`` are: ``scale`` of the inputs (its change) and their
    ``zero`` (in their unit), common to all of a trial's inputs; and the ``places`` of the markers
    and the frame of the recordings, which all tested trials of a session share. What the trials do
    not determine is left out.

    Args:
        trials: of the motions.
        observed: (T, M, 3) markers by trial [m], NaN in frames that do not count.
        simulated: (T, M, 3) predicted markers by trial [m].
        linear: derivatives by trial; those without are left out.
    """
    # One frame of a pose.
    counts = {name: len(of_trial.points) for name, of_trial in linear.items()}
    errors = {n: (simulated[n] - seen)[: counts[n]] for n, seen in observed.items() if n in linear}
    errors = {name: error for name, error in errors.items() if np.isfinite(error).any()}

    def mean(error: FloatArray) -> float:
        """Mean error of a trial [mm], of its errors (T, M, 3), as the table of errors has it."""
        of_markers = as_markers(error, trials.labels)
        return float(np.nanmean(mean_distance(of_markers, 0.0 * of_markers)))

    left: dict[str, dict[str, float]] = {name: {} for name in errors}
    values: dict[str, dict[str, float]] = {name: {} for name in errors}
    words = _responses(trials)
    for name, error in errors.items():
        for quantity, word in (("scale", "factor"), ("zero", "zero")):  # all inputs move together
            columns = [linear[name].by_parameter[n] for n, other in words.items() if other == word]
            slope = np.sum(columns, axis=0)
            if columns and (best := _least([error], [slope[..., None]])) is not None:
                left[name][quantity] = mean(error + slope * best[0])
                values[name][quantity] = float(best[0])
    for session in dict.fromkeys(map(trials.session, errors)):
        members = [name for name in errors if trials.session(name) == session]
        places = [slopes for name in members if (slopes := linear[name].by_placement) is not None]
        if len(places) < len(members):
            continue
        # Trials count alike.
        sizes = [float(np.sqrt(np.nanmean(np.square(errors[name])))) or 1.0 for name in members]
        scaled = [errors[n] / size for n, size in zip(members, sizes, strict=True)]
        best = _least(scaled, [x / size for x, size in zip(places, sizes, strict=True)])
        if best is not None:
            for name, slopes in zip(members, places, strict=True):
                left[name]["places"] = mean(errors[name] + slopes @ best)
    return [
        {"name": n, "as_is_mm": mean(e), "left_mm": left[n], "values": values[n]}
        for n, e in errors.items()
    ]


def _least(errors: Sequence[FloatArray], columns: Sequence[FloatArray]) -> FloatArray | None:
    """(K,) values with the least squares of errors (T, M, 3) + columns (T, M, 3, K) values.

    None if not determined.
    """
    seen = [
        np.isfinite(error) & np.isfinite(slopes).all(-1)
        for error, slopes in zip(errors, columns, strict=True)
    ]
    right = np.concatenate([error[where] for error, where in zip(errors, seen, strict=True)])
    matrix = np.concatenate([slopes[where] for slopes, where in zip(columns, seen, strict=True)])
    if len(right) <= 2 * matrix.shape[1] or not matrix.any():
        return None
    return np.asarray(np.linalg.lstsq(matrix, -right)[0])
