"""Derivatives of predicted markers by the identified parameters and the responses of the inputs."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..data.marker_view import ViewedMarkers
from ..data.markers import Markers
from ..dynamics.simulator import Simulator
from ..io.errors import ConvergenceError, listed
from ..io.progress import Progress
from ..learning.parameters import HUNG, configured_parameters, split_name
from ..learning.placement import DisplacedMarkers, Placement, by_placement, placement_of
from ..learning.replay import Replay, exact
from .experiment import Experiment

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

_DIFFERENCE = 1e-3  # of a parameter, over its standard deviation, or over the typical size of an input's response


@dataclass(frozen=True)
class Sensitivity:
    """The markers of a trial as a simulator predicts them, and their derivatives.

    Attributes:
        points: (T, M, 3) [m].
        by_parameter: (T, M, 3) by parameter; a value of the trial's own moves in place of the common one.
        by_placement: (T, M, 3, 3 M + 6) by the offsets of the markers on the body, and the shift and the rotation
            vector of the recording's frame; None where markers are seen in part.
    """

    points: FloatArray
    by_parameter: Mapping[str, FloatArray]
    by_placement: FloatArray | None


def responses(experiment: Experiment) -> dict[str, str]:
    """Parameters for a scale and a zero of the inputs that drive an experiment, by name, with their word."""
    driven = [name for name, values in experiment.dataset.inputs.items() if name not in HUNG and values.any()]
    return {f"{name}_{word}": word for name in driven for word in ("factor", "zero")}


def sensitivities(experiment: Experiment, model: str, names: Sequence[str]) -> dict[str, Sensitivity]:
    """Returns the derivatives of trials by the parameters of a model's simulator and the `responses` of its inputs.

    Args:
        experiment: the experiment.
        model: a model with markers and identified parameters.
        names: names of the trials; those that cannot be simulated are left out, which a warning says.
    """
    simulator, found = exact(experiment.model_simulator(model)), dict[str, Sensitivity]()
    deviation = (experiment.identification(model).get("uncertainty") or {}).get("deviation", {})
    largest = {name: float(np.abs(values).max()) for name, values in experiment.dataset.inputs.items()}
    added = responses(experiment)
    sizes = {name: largest[name.removesuffix("_zero")] if word == "zero" else 1.0 for name, word in added.items()}
    moved = {name: _DIFFERENCE * size for name, size in {**sizes, **deviation}.items()}
    values = {**_tensors(simulator, configured_parameters(simulator, moved)), **experiment.parameters(model)}
    with Progress("evaluate: derivatives by the parameters", len(names), "trials") as progress, torch.no_grad():
        for batch in _batches(experiment, names):
            try:
                found |= _of_batch(experiment, model, simulator, batch, values, moved)
            except ConvergenceError as error:
                log.warning("evaluate: the posterior does not widen the intervals of %s: %s", listed(batch), error)
            progress.advance(len(batch))
    return found


def _batches(experiment: Experiment, names: Sequence[str]) -> Iterator[Sequence[str]]:
    for whole in experiment.batches(names):
        size = experiment.settings.batch or len(whole)
        yield from (whole[first : first + size] for first in range(0, len(whole), size))


def _tensors(simulator: Simulator, values: Mapping[str, float]) -> dict[str, torch.Tensor]:
    return {name: simulator.tensor([value]) for name, value in values.items()}


def _of_batch(
    experiment: Experiment,
    model: str,
    simulator: Simulator,
    names: Sequence[str],
    values: Mapping[str, torch.Tensor],
    moved: Mapping[str, float],
) -> dict[str, Sensitivity]:
    """Derivatives of trials of one of `Experiment.batches`, from values (1,) of all parameters and steps of some."""
    own = experiment.replay(simulator, names, model)
    replay, start, observe = own, experiment.start(own, model), experiment.observe
    placement = None
    if isinstance(observe, Markers) and not isinstance(observe, ViewedMarkers):
        placement = _placement(experiment, model, names[0])
        displaced = DisplacedMarkers(observe, len(experiment.dataset.labels))
        replay = Replay(own.simulator, displaced, own.trials)
        start = replace(start, shift=None if start.shift is None else start.shift.repeat(1, displaced.copies, 1))
    rows = {parameter: row for row, parameter in enumerate(moved, 1)}
    sets = {name: value.repeat(1 + len(moved)) for name, value in values.items()}
    for name in sets:
        if (parameter := split_name(name)[0]) in moved:
            sets[name][rows[parameter]] += moved[parameter]
    points = (replay.varied if moved and not replay.is_static else replay)(start, sets)
    slopes: Any = [None] * len(names)
    if placement is not None:
        markers, rotations = DisplacedMarkers.split(points)
        points = placement.apply(markers + (rotations @ placement.offsets[..., None])[..., 0])
        slopes = by_placement(placement, points[0], rotations[0]).double().cpu().numpy()
    shown = points.double().cpu().numpy()
    return {
        name: Sensitivity(
            points=shown[0, trial],
            by_parameter={p: (shown[row, trial] - shown[0, trial]) / moved[p] for p, row in rows.items()},
            by_placement=slopes[trial],
        )
        for trial, name in enumerate(names)
    }


def _placement(experiment: Experiment, model: str, name: str) -> Placement:
    """Placement of the markers of a trial, nominal if none is identified."""
    dataset, plain = experiment.dataset, experiment.identification(model).get("placement")
    if plain is not None:
        return placement_of(plain, dataset.labels, dataset.session(name)).to(experiment.like)
    assert dataset.bound is not None
    return Placement.none(len(dataset.labels), experiment.like.new_tensor(np.mean(dataset.bound, axis=0)))
