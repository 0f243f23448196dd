"""Several models on the same tested trials: roll-outs, errors,
prediction intervals, and what explains errors.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, product
from typing import Any, Final

import numpy as np

from ..core.dynamics.simulator import Simulator
from ..data.rigid_bodies import as_markers
from ..io.arrays import FloatArray, IntArray
from ..io.parts import Parts, TrialPart
from .error_tables import ComparedModels, ErrorTables, amplitudes, counted
from .evaluation import rollout_parts, used_frames
from .identification.identification import Identification
from .identification.sensitivity import (
    FreeFit,
    Sensitivity,
    free_fits,
    left_out_changes,
    parameter_spread,
    sensitivities,
)
from .intervals import (
    LEVEL,
    Intervals,
    IntervalTable,
    ModelIntervals,
    Predicted,
    coverage,
    predicted_trials,
    rest_places,
)
from .observed_motions import ObservedMotions
from .residuals.correction import Learned
from .without_physics import without_physics

_FILM_FRAMES: Final = 256  # maximum
Linear = Mapping[str, Mapping[str, Sensitivity]]  # derivatives by model and trial


@dataclass(frozen=True)
class Model:
    """A simulator with identified parameters, and the network that corrects or replaces it, if any.

    Attributes:
        simulator: whose roll-outs are compared; failed steps are counted.
        identified: its parameters and marker places.
        learned: the network; None for the simulator alone.
        has_intervals: whether prediction intervals are calibrated for it.
    """

    simulator: Simulator
    identified: Identification = field(default_factory=Identification)
    learned: Learned | None = None
    has_intervals: bool = True


@dataclass(frozen=True)
class Comparison:
    """Models on tested trials, beside predictions without physics.

    Attributes:
        models: by name.
        motions: observed trials.
        train: names of the trials that were learned from.
        groups: names of the tested trials by input scale; ``1``, the original inputs, is first.
        calibration: names of the trials that prediction intervals come from; none without
            intervals.
        horizons: durations of whose errors there is a table [s].
        reconstructed: (R, T, M, 3) reconstructed points of the trials with the original inputs [m];
            None without any.
        parts: workers and files of the roll-outs.
    """

    models: Mapping[str, Model]
    motions: ObservedMotions
    train: Sequence[str]
    groups: Mapping[str, Sequence[str]]
    calibration: Sequence[str] = ()
    horizons: Sequence[float] = ()
    reconstructed: FloatArray | None = None
    parts: Parts = field(default_factory=lambda: Parts("evaluate"))

    @property
    def names(self) -> list[str]:
        """Names of all tested trials."""
        return [*chain.from_iterable(self.groups.values())]

    @cached_property
    def _largest(self) -> list[str]:
        """Training trials, those with larger displacements first."""
        return sorted(self.train, key=lambda name: self._reach([name]), reverse=True)

    @cached_property
    def _growing(self) -> list[str]:
        """Models whose errors in the largest training trial are known
        as if they were identified without it.

        Not those with a network, which has seen the trial.
        """

        def grows(model: Model) -> bool:
            known = model.identified.uncertainty
            trained = model.learned is not None or model.identified.actuator
            return (
                model.has_intervals
                and not trained
                and known is not None
                and self._largest[0] in known.left_out
            )

        many = self.calibration and len(self.train) > 1
        return [name for name, model in self.models.items() if grows(model)] if many else []

    def _below(self, model: str) -> str | None:
        """Name of the model whose growth a model has:
        itself, or the simulator that its networks correct, if any.
        """
        used = self.models.get(model)
        if used is None or model in self._growing:
            return None if used is None else model
        corrected = (
            bool(used.identified.actuator)
            if used.learned is None
            else not used.learned.replaces_simulator
        )
        for other in self._growing if corrected else ():
            if self._same_simulator(other, model):
                return other
        return None

    def _same_simulator(self, model: str, other: str) -> bool:
        """Whether two models have the same simulator with the same parameters,
        whatever was learned on top of it.
        """
        one, two = self.models[model], self.models[other]
        return (
            one.simulator is two.simulator
            and one.identified.parameters == two.identified.parameters
        )

    def _same_motions(self, model: str, other: str) -> bool:
        """Whether two models have the same simulator with all
        that was identified, and no network.
        """
        one, two = self.models[model], self.models[other]
        known = [
            (m.identified.of_trials, m.identified.placement, m.identified.actuator)
            for m in (one, two)
        ]
        networks = one.learned, two.learned
        return (
            networks == (None, None) and self._same_simulator(model, other) and known[0] == known[1]
        )

    def _calibrating(self, model: str) -> list[str]:
        """Names of the trials of the calibration, and of the largest training trial
        if the model grows by it.
        """
        return [
            *dict.fromkeys(
                [*self.calibration, *(self._largest[:1] if model in self._growing else ())]
            )
        ]

    def _used(self, names: Sequence[str]) -> FloatArray:
        """(R, T, M, 3) observed points of some trials [m],
        NaN in frames that may be tested or gave first values.
        """
        motions, trials = self.motions, self.motions.trials
        observed = trials.observed[trials.rows(names)]
        learned = [row for row, name in enumerate(names) if name in self.train]
        observed[learned, motions.learned_steps(observed.shape[1] - 1) + 1 :] = np.nan
        observed[used_frames(trials, names, self._first_frames)] = np.nan
        return observed

    def _reach(self, names: Sequence[str]) -> float:
        """Largest observed displacement of some trials of the training or calibration [m]."""
        trials = self.motions.trials
        moved = as_markers(self._used(names), trials.labels) - rest_places(trials)
        return float(np.nanmax(np.linalg.norm(moved, axis=-1), initial=0.0))

    @cached_property
    def filmed(self) -> str:
        """Name of the tested trial with the largest motion, whose vertices are kept."""
        sizes = amplitudes(self.motions.trials, self.groups["1"])
        return max(sizes, key=sizes.__getitem__)

    @cached_property
    def film_steps(self) -> IntArray:
        """Steps of the inputs at which vertices are kept."""
        trials = self.motions.trials
        steps = int(trials.seconds([self.filmed]) / trials.time_step + 1e-6)
        return np.arange(0, steps + 1, max(-(-steps // _FILM_FRAMES), 1))

    @cached_property
    def _rolled_out(self) -> tuple[dict[str, list[TrialPart]], dict[str, list[TrialPart]]]:
        """Parts of the tested trials, and of those of the calibration,
        by model, after they were rolled out.

        Models with equal motions, as where nothing that was learned is used, have the same parts.
        """
        new = list[TrialPart]()

        def cut(
            models: Sequence[str], names: Callable[[str], Sequence[str]], label: str
        ) -> dict[str, list[TrialPart]]:
            parts = dict[str, list[TrialPart]]()
            for model in models:
                used = self.models[model]
                made = used.simulator, self.motions, names(model), used.learned, used.identified
                alike = (
                    o
                    for o in parts
                    if self._same_motions(o, model) and [*names(o)] == [*names(model)]
                )
                same = next(alike, None)
                if same is None:
                    parts[model] = rollout_parts(
                        *made, self.parts.batch, self.filmed, f"{label}{model}"
                    )
                    new.extend(parts[model])
                else:
                    parts[model] = parts[same]
            return parts

        tested = cut([*self.models], lambda _: self.names, "")
        with_intervals = [name for name, model in self.models.items() if model.has_intervals]
        calibrating = cut(with_intervals, self._calibrating, "calibration_")
        self.parts.run(new)
        return tested, calibrating

    def _in_order(self, model: str, name: str) -> Any:
        """An array of the roll-outs of a model, (R, ...) in the order of the tested trials."""
        parts = self._rolled_out[0][model]
        order = [*chain.from_iterable(part.names for part in parts)]
        rows = [order.index(trial) for trial in self.names]
        if name in ("observed", "loads"):
            return self.parts.joined(parts, name, self.motions.trials.observed.shape[1])[rows]
        return np.concatenate([self.parts.read(part, name) for part in parts])[rows]

    @property
    def _first_frames(self) -> Mapping[str, Mapping[str, float]]:
        """First frames of trials from which values of some model were estimated, see
        `Identified`.
        """
        shown = [model.identified.first_frames for model in self.models.values()]
        return dict(chain.from_iterable(frames.items() for frames in shown))

    @cached_property
    def _without_physics(self) -> tuple[dict[str, FloatArray], dict[str, str], dict[str, str]]:
        return without_physics(self.motions, self.names, self.train, self._first_frames)

    @cached_property
    def simulated(self) -> dict[str, FloatArray]:
        """(R, T, M, 3) predicted points of the tested trials by model [m],
        first those without physics.
        """
        return self._without_physics[0] | {
            model: self._in_order(model, "observed") for model in self.models
        }

    @cached_property
    def loads(self) -> dict[str, FloatArray]:
        """(R, T, S, 6) readings of the force sensors in tested trials by model [N, N m].

        Empty without sensors.
        """
        if not self.motions.sensors:
            return {}
        as_points = _loads_as_points(self.motions)
        plain, *_ = without_physics(as_points, self.names, self.train, self._first_frames)
        shown = {model: values.reshape(*values.shape[:2], -1, 6) for model, values in plain.items()}
        return shown | {model: self._in_order(model, "loads") for model in self.models}

    def film(self, model: str) -> FloatArray:
        """(F, N, 3) vertices of the filmed trial at `film_steps` [m]."""
        parts = self._rolled_out[0][model]
        bodies = next(self.parts.read(part, "film") for part in parts if self.filmed in part.names)
        substeps = round(self.motions.trials.time_step / self.models[model].simulator.time_step)
        return np.asarray(bodies[np.minimum(substeps * self.film_steps, len(bodies) - 1)])

    @cached_property
    def _linear(self) -> Linear:
        return self._linearised(self.groups["1"])

    def _linearised(self, names: Sequence[str], uncertain: bool = False) -> Linear:
        """Derivatives of trials by the parameters of each model's simulator; empty without markers.

        Models that differ in what was learned share the derivatives of the first of them.

        Args:
            names: names of the trials.
            uncertain: whether models are left out whose parameters have no uncertainty.
        """
        found: dict[str, Mapping[str, Sensitivity]] = {}
        for name, model in self.models.items() if self.motions.trials.bound is not None else ():
            replaced = model.learned is not None and model.learned.replaces_simulator
            if (
                replaced
                or not model.has_intervals
                or (uncertain and model.identified.uncertainty is None)
            ):
                continue
            same = next((other for other in found if self._same_simulator(other, name)), None)
            found[name] = (
                sensitivities(
                    model.simulator, self.motions, names, model.identified, self.parts.batch
                )
                if same is None
                else found[same]
            )
        return found

    def _spreads(
        self, names: Sequence[str], linear: Linear, left_out: bool = False
    ) -> dict[str, FloatArray]:
        trials, models = self.motions.trials, self.models
        spreads = {
            m: parameter_spread(trials, names, models[m].identified, x, left_out)
            for m, x in linear.items()
        }
        return {model: spread for model, spread in spreads.items() if spread is not None}

    @cached_property
    def spreads(self) -> dict[str, FloatArray]:
        """Variances (R, T, M) of markers and rigid bodies due to the parameters [m^2], by model."""
        return self._spreads(self.groups["1"], self._linear)

    def errors(self) -> ErrorTables:
        """Returns all that errors.json has: tables,
        baselines, displacements, free fits and intervals.
        """
        test, (_, plain, missing) = self.groups["1"], self._without_physics
        networks = {
            name: model.learned for name, model in self.models.items() if model.learned is not None
        }
        left = {
            name: self._in_order(name, "left")
            for name, learned in networks.items()
            if learned.range_ is not None
        }
        compared = ComparedModels(
            self.motions,
            self.train,
            self.groups,
            self.simulated,
            left,
            self.reconstructed,
            self.horizons,
            first_frames=self._first_frames,
            loads=self.loads,
        )
        content = compared.errors()
        if self._first_frames:
            content["first_frames"] = self._first_frames
        content["baselines"] = plain
        if missing:
            content["missing_baselines"] = missing
        sideways = dict(
            zip(self.names, self._in_order([*self.models][-1], "sideways").tolist(), strict=True)
        )
        known = {name: sideways[name] for name in test if math.isfinite(sideways[name])}
        if known:
            content["sideways_mm"] = known
        fits = self._free_fits()
        if any(fits.values()):
            content["free_fits"] = fits
        if self.calibration and (intervals := self._intervals())["models"]:
            content["intervals"] = intervals
        return content

    def _free_fits(self) -> dict[str, list[FreeFit]]:
        """Returns what would remain of the errors if something were free, by model."""
        names, fits = self.groups["1"], {}
        observed = dict(
            zip(names, counted(self.motions, self.train, names, self._first_frames), strict=True)
        )
        for model, linear in self._linear.items():
            predicted = dict(zip(names, self.simulated[model][: len(names)], strict=True))
            fits[model] = free_fits(self.motions.trials, observed, predicted, linear)
        return fits

    def _intervals(self) -> IntervalTable:
        """Prediction intervals by model and their coverage of the tested trials, see `intervals`.

        Trials of the training are predicted as if the parameters were identified without them
        (`left_out_changes`), so that the one with the largest displacement shows how errors grow
        beyond the training of the others. Models with a network have the growth of the simulator
        below it. The intervals of a robot, which does not know the variance due to the parameters,
        are `without_spread`.
        """
        motions, trials = self.motions, self.motions.trials
        test = self.groups["1"]
        rest = rest_places(trials)
        target = counted(motions, self.train, test, self._first_frames)
        names = [*dict.fromkeys(chain(self.calibration, *map(self._calibrating, self._growing)))]
        linear = self._linearised(names, uncertain=True)
        changes = {
            m: left_out_changes(trials, names, self.models[m].identified, x)
            for m, x in linear.items()
        }
        plain, *_ = without_physics(
            motions, self.calibration, self.train, self._first_frames, left_out=True
        )
        simulated: dict[str, tuple[Sequence[str], FloatArray]] = {
            m: (self.calibration, x) for m, x in plain.items()
        }
        for model, parts in self._rolled_out[1].items():
            of_parts, change = [*chain(*(part.names for part in parts))], changes.get(model)
            made = self.parts.joined(parts, "observed", trials.observed.shape[1])
            simulated[model] = (
                of_parts,
                made if change is None else made + change[[names.index(n) for n in of_parts]],
            )
        spreads = self._spreads(names, linear, left_out=True)
        whole, alone = dict[str, Intervals | None](), dict[str, Intervals | None]()
        for model, (shown, made) in simulated.items():
            spread = (
                None
                if model not in spreads
                else spreads[model][[names.index(name) for name in shown]]
            )
            predicted = predicted_trials(trials, shown, made, self._used(shown), spread)
            whole[model] = self._calibrated(model, predicted)
            known = {name: replace(trial, spread=None) for name, trial in predicted.items()}
            alone[model] = self._calibrated(model, known) if model in self.spreads else None
        models = dict[str, ModelIntervals]()
        for model in (model for model in simulated if model in self.simulated):
            intervals = self._grown(model, whole)
            if intervals is None:
                continue
            new = self.simulated[model][: len(test)]
            tested = predicted_trials(trials, test, new, target, self.spreads.get(model))
            covered = coverage(
                {name: intervals.covered(trial, rest) for name, trial in tested.items()}
            )
            models[model] = {**intervals.plain(), **covered}
            of_robot = self._grown(model, alone)
            if of_robot is not None:
                models[model]["without_spread"] = of_robot.plain()
        without = any(change is not None for change in changes.values())
        trained = not {*self.calibration}.isdisjoint(self.train)
        split = ("left_out" if without else "training") if trained else "validation"
        return {"level": LEVEL, "calibrated_on": split, "models": models}

    def _calibrated(self, model: str, predicted: Mapping[str, Predicted]) -> Intervals | None:
        """Calibrates intervals of a model on trials that it predicted,
        of which the largest one shows any growth.
        """
        rest = rest_places(self.motions.trials)
        intervals = Intervals.calibrated({name: predicted[name] for name in self.calibration}, rest)
        if intervals is None or model not in self._growing:
            return intervals
        largest, *others = self._largest
        reach = self._reach([*{*self.train, *self.calibration}])
        return intervals.growing(predicted[largest], self._reach(others), reach, rest)

    def _grown(self, model: str, calibrated: Mapping[str, Intervals | None]) -> Intervals | None:
        """The intervals of a model with the growth of the one that shows it, see `_below`."""
        own, below = calibrated[model], calibrated.get(self._below(model) or "")
        return (
            own
            if own is None or below is None
            else replace(own, reach=below.reach, growth=below.growth)
        )


def _loads_as_points(motions: ObservedMotions) -> ObservedMotions:
    """Returns motions whose observed points are forces and moments,
    two of each sensor, for predictions from data.
    """
    trials = motions.trials
    readings = np.stack([*trials.loads.values()], 2).reshape(*trials.times.shape, -1, 3)
    kinds = product(trials.loads, ("force", "moment"))
    names = tuple(f"{name} {kind}" for name, kind in kinds)
    known = np.isfinite(readings)
    # NaN where there is none
    first = np.take_along_axis(readings, known.argmax(axis=1)[:, None], axis=1)[:, 0]
    changed = replace(
        trials, labels=names, observed=readings, held=first, smoothed=None, bound=None
    )
    return replace(motions, trials=replace(changed, loads={}), sensors={})
