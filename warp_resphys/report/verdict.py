"""What a run shows, in words: how far its models are off, which step helped, by more than chance, what to try next."""

import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any, Final

from ..learning.metrics import PUBLISHED_WINDOWS_MM, Gain, PublishedError, paired_gain
from ..learning.parameters import first_guesses
from .data import MODELS, RunReport
from .page import MINUS, NO_BREAK_SPACE, mm_text, published_parts

# By model: what it is called, and what it adds to the first of these models that there is.
_STEPS: Final[Mapping[str, tuple[str, tuple[str, ...]]]] = {
    "sysid_elastic": ("identification of E and nu", ("simulation",)),
    "sysid": ("identification (SysID)", ("simulation",)),
    "simfree": ("the network in place of the simulator (SimFree)", ("sysid", "simulation")),
    "resphys_uncorrected": ("the learned force on the data sheet's simulator", ("simulation",)),
    "resphys": ("the learned force (ResPhys)", ("sysid", "simulation")),
}
_BASES: Final = {"simulation": "the uncorrected simulation", "sysid": "SysID"}
_PLACES: Final = {"sysid": "parameters", "sysid_elastic": "elastic"}  # In the group `identify`.
_CLOSE: Final = 1e-4  # of a parameter's range
_REFINED: Final = "_refined"  # What a network refined through the simulator is called, after its model.


@dataclass(frozen=True)
class Identified:
    """One identified parameter, in SI units."""

    key: str  # Where its range is configured, such as ``identify.parameters.density``.
    value: float
    lower: float  # End of its range.
    upper: float
    start: float  # The first guess.
    known: bool = False  # Whether it has a prior, where it may stay.


# Where prediction intervals come from.
_CALIBRATED: Final[Mapping[str, str]] = {
    "validation": "its errors in the validation trials",
    "training": "its errors in what it was trained on, which tend to be too small",
    "folds": "the errors of the other folds",
}


def verdict(data: RunReport) -> str:
    """Say how far the models are from what was observed, and how that stands to what was published."""
    metrics = data.metrics
    without = untrained(epochs_kept(metrics))
    errors = {model: each for model, each in metrics["errors_mm"].items() if model not in without}
    if not data.sees_markers:
        said = [vertex_verdict(metrics["errors_mm"], data.published, data.simulator, data.target)]
    else:
        trials = tuple(data.pages) if data.trials is None else data.trials.names
        parted = learned_in_part(data.settings, trials)
        said = [marker_verdict(errors, trials, data.seconds, folds=data.trials is None, parted=parted)]
        said.append(reduction_text(errors, data.published, _paired(metrics)))
    if data.settings["data"].get("train_fraction", 1.0) < 1.0:
        published = PUBLISHED_WINDOWS_MM.get(data.experiment, {})
        said.append(growth_text(metrics.get("growth", {}), list(metrics.get("horizons", {})), published))
    said.append(scale_text(metrics.get("scales", {})))
    return unbroken(" ".join(each for each in said if each))


def learned_in_part(settings: Mapping[str, Any], tested: Collection[str]) -> bool:
    """Whether the trials that are tested were learned from, but for the rest of each that is the test."""
    named = settings["data"].get("train")
    return settings["data"].get("train_fraction", 1.0) < 1.0 and isinstance(named, list) and {*tested} <= {*named}


def unbroken(said: str) -> str:
    """Return a text whose numbers stay beside their units and symbols."""
    return re.sub(r"(?<=\d) (?=(?:mm|kPa|s)\b|%)|(?<=\b[Eν]) (?=\d)", NO_BREAK_SPACE, said)  # noqa: RUF001


def vertex_verdict(
    errors: Mapping[str, Any], published: Mapping[str, PublishedError], simulator: str, target: str
) -> str:
    """Say in a sentence or two how far the learned force brings the simulator to its target.

    Args:
        errors: A summary [mm] a model.
        published: Published errors [mm].
        simulator: The corrected simulator in words.
        target: Its target in words.
    """
    if not {"simulation", "resphys"} <= errors.keys():
        each = (f"{mm_text(errors[m]['mean'])} with {MODELS[m][0]}" for m in MODELS if m in errors)
        return f"Mean vertex error: {', '.join(each)}."
    before, after = errors["simulation"]["mean"], errors["resphys"]["mean"]
    count = errors["resphys"]["trajectories"]
    trials, old, new = f"{count} test trial{'s' if count > 1 else ''}", mm_text(before), mm_text(after)
    if after is None:
        said = (
            f"With the learned residual force, {errors['resphys']['diverged']} of {count} test roll-outs diverged, so "
            f"there is no mean error to report. Without it: {old}."
        )
    elif before is None:
        said = (
            f"Uncorrected, {errors['simulation']['diverged']} of {count} test roll-outs diverge; with the learned "
            f"residual force, the mean vertex error is {new}."
        )
    elif after >= before:
        said = (
            f"The learned residual force does not help: the mean vertex error on {trials} is {new} with it and {old} "
            "without."
        )
    else:
        said = (
            f"The learned residual force brings the simulator ({simulator}) {_closer(before, after)} to its target "
            f"({target}): on {trials} that it never saw, the mean vertex error falls from {old} to {new}."
        )
    if "resphys" in published:
        said += f" The published result is {published_parts(published['resphys'])[0]} mm."
    return said


def _closer(before: float, after: float) -> str:
    """Two significant digits: a ratio of errors over a few trials is worth no more."""
    if after == 0.0:
        return "all the way"
    digits = 1 - math.floor(math.log10(before / after))
    return f"{round(before / after, digits):,.{max(0, digits)}f} times closer"


def marker_verdict(
    errors: Mapping[str, Any],
    trials: Sequence[str],
    seconds: float | None,
    *,
    folds: bool = False,
    parted: bool = False,
) -> str:
    """Say how far the models are from what was measured.

    Args:
        errors: A summary [mm] a model.
        trials: Names of the test trials.
        seconds: How much of them counts.
        folds: Whether each trial was the test of a fold of its own.
        parted: Whether each was learned from, but for the part that is the test.
    """
    who = f"trial {trials[0]}" if len(trials) == 1 else f"{len(trials)} trials"
    held = "each of them kept back once" if folds and len(trials) > 1 else "which no training or identification saw"
    held = "in the part that no training or identification saw" if parted else held
    span = "" if seconds is None else f" over the first {seconds:g} s"
    ranked = ("resphys", "resphys_uncorrected", "sysid", "sysid_elastic", "simulation")
    main = next((m for m in ranked if m in errors), "")
    if not main:
        return f"There are no errors to report on {who}."
    if errors[main]["mean"] is None:
        return (
            f"On {who}, {held}, {MODELS[main][0]} diverged in {errors[main]['diverged']} of "
            f"{errors[main]['trajectories']} roll-outs, so that there is no mean error to report."
        )
    beside = "".join(
        f", {mm_text(errors[m]['mean'])} {'uncorrected' if m == 'simulation' else 'with ' + MODELS[m][0]}"
        for m in ("sysid", "sysid_elastic", "simulation")
        if m in errors and m != main
    )
    return (
        f"On {who}, {held}, the simulated markers are {mm_text(errors[main]['mean'])} from the measured ones{span} "
        f"with {MODELS[main][0]}{beside.replace(',', ';', 1)}."
    )


def reduction(means: Mapping[str, float | None]) -> float | None:
    """Return by which share the mean error of ResPhys is below that of SysID; None where one is not known."""
    before, after = means.get("sysid"), means.get("resphys")
    return None if before is None or after is None or before <= 0.0 else 1.0 - after / before


def reduction_text(
    errors: Mapping[str, Any], published: Mapping[str, PublishedError], paired: Gain | None = None
) -> str:
    """Say how the error of ResPhys stands to that of SysID, here and as published; empty where it is not known.

    Args:
        errors: A summary [mm] a model.
        published: Published errors [mm].
        paired: The gain on the same trials, whose interval is told; None where it is not known.
    """
    found = reduction({model: each["mean"] for model, each in errors.items()})
    if found is None:
        return ""
    theirs = reduction({model: each.mean for model, each in published.items()})
    beside = [] if theirs is None else [f"published: {100.0 * theirs:.1f} % smaller"]
    if paired is not None and paired.trials > 1:
        times = f"{1.0 - paired.upper:.1f} to {1.0 - paired.lower:.1f} times"
        between = times if found < -1.0 else f"{_interval(paired)} %"
        beside.insert(0, f"{between} in nine of ten draws of {paired.trials} trials")
    more = f" ({'; '.join(beside)})" if beside else ""
    if found < -1.0:
        return f"The error of ResPhys is {1.0 - found:.1f} times that of SysID{more}."
    which = "smaller" if found >= 0.0 else "larger"
    return f"The error of ResPhys is {100.0 * abs(found):.1f} % {which} than that of SysID{more}."


def _paired(metrics: Mapping[str, Any]) -> Gain | None:
    """The gain of ResPhys over SysID on the held-out trials of a split or of folds."""
    rows = held_out(metrics)
    pairs = [(row.get("sysid"), row.get("resphys")) for row in rows]
    known = [(before, after) for before, after in pairs if before and after is not None]
    if not known or len(known) < len(rows):
        return None
    return paired_gain([before for before, _ in known], [after for _, after in known])


def held_out(metrics: Mapping[str, Any]) -> list[Mapping[str, float | None]]:
    """The errors of all models on each held-out trial [mm]."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    return [row["errors_mm"] for fold in folds for row in fold.get("per_trajectory", ())]


def growth_text(
    growth: Mapping[str, float | None],
    horizons: Sequence[str],
    published: Mapping[str, Mapping[str, PublishedError]],
) -> str:
    """Say how the error of ResPhys grows with the length of the roll-outs; empty where it is not known."""
    found = growth.get("resphys")
    if found is None or len(horizons) < 2:
        return ""
    first, *_, last = sorted(horizons, key=float)
    theirs = published_growth(published, first, last).get("resphys")
    beside = "" if theirs is None else f" (published: {100.0 * theirs:.1f} %)"
    by = f"{'grows' if found >= 0.0 else 'falls'} by {100.0 * abs(found):.1f} %{beside}"
    return f"From {float(first):g} s to {float(last):g} s the error of ResPhys {by}."


def published_growth(published: Mapping[str, Mapping[str, PublishedError]], first: str, last: str) -> dict[str, float]:
    """Return by which share each published error grows from one length of the roll-outs [s] to another."""
    before, after = published.get(first, {}), published.get(last, {})
    return {model: after[model].mean / before[model].mean - 1.0 for model in before if model in after}


def scale_text(errors: Mapping[str, Mapping[str, Any]]) -> str:
    """Say what the errors are at the highest inputs; empty where there are none higher than in the training."""
    if not errors:
        return ""
    largest = max(errors, key=float)
    found = {m: errors[largest][m]["mean"] for m in ("resphys", "sysid", "simfree") if m in errors[largest]}
    parts = ", ".join(f"{mm_text(mean)} with {MODELS[model][0]}" for model, mean in found.items())
    return f"At {float(largest):g} times the inputs of the training the error is {parts}." if parts else ""


def judgement(metrics: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Sentences on a run, by what metrics.json holds of a split or of folds, and its configuration."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    rows = held_out(metrics)
    errors = {model: [row.get(model) for row in rows] for model in (rows[0] if rows else ())}
    said = gains(errors, epochs_kept(metrics)) + intervals_text(metrics)
    return said + advice([_identified(fold, settings) for fold in folds])


def intervals_text(metrics: Mapping[str, Any]) -> list[str]:
    """Say how wide the prediction intervals of the best model are, and how often they held in the test."""
    found = metrics.get("intervals")
    model = next((m for m in ("resphys", "sysid") if m in (found or {}).get("models", {})), None)
    if found is None or model is None:
        return []
    each, source = found["models"][model], _CALIBRATED[found["calibrated_on"]]
    return [
        f"Of the measured coordinates {100.0 * found['level']:.0f} % should lie within ± {each['half_width_mm']:.2g} "
        f"mm, on average, of where {'ResPhys' if model == 'resphys' else 'SysID'} has them, by {source}: "
        f"{100.0 * each['coverage']:.0f} % do."
    ]


def epochs_kept(metrics: Mapping[str, Any]) -> dict[str, list[int]]:
    """How many epochs the weights that were kept have been trained and refined, by model and fold."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    networks: list[Mapping[str, Any]] = [fold.get("networks", {}) for fold in folds]
    models = dict.fromkeys(model for each in networks for model in each if not model.endswith(_REFINED))

    return {
        model: [n[model]["epoch"] + n.get(f"{model}{_REFINED}", {}).get("epoch", 0) for n in networks if model in n]
        for model in models
    }


def untrained(epochs: Mapping[str, Sequence[int]]) -> set[str]:
    """The models of which no fold kept an epoch: there the learned force is none."""
    return {model for model, each in epochs.items() if each and not any(each)}


def best(errors: Mapping[str, Any], without: Collection[str] = ()) -> str:
    """The model with the smallest mean error; of equal ones, the simplest; none that was published, or `without`."""
    means = {m: errors[m]["mean"] for m in ("simulation", *_STEPS) if m in errors and m not in without}
    known = {m: mean for m, mean in means.items() if mean is not None}
    return min(known, key=lambda m: known[m], default="")


def gains(errors: Mapping[str, Sequence[float | None]], epochs: Mapping[str, Sequence[int]]) -> list[str]:
    """Say of every step whether it helped on held-out trials, by how much, and whether other trials would show it.

    The gain is the share of the mean error that a step takes away, see `learning.metrics.paired_gain`.

    Args:
        errors: of each model on the same held-out trials [mm], None where its roll-out diverged.
        epochs: kept by the learned models, in each fold.
    """
    said = []
    for model, (name, bases) in _STEPS.items():
        base = next((each for each in bases if each in errors), None)
        if model not in errors or base is None:
            continue
        sentence = _gain(name, _BASES[base], errors[model], errors[base], list(epochs.get(model, ())))
        said.append(sentence[0].upper() + sentence[1:])
    if said and all(len(each) == 1 for each in errors.values()):
        said.append("All this is on one held-out trial: nothing tells whether another shows the same; test on more.")
    return said


def _gain(
    name: str,
    base: str,
    after: Sequence[float | None],
    before: Sequence[float | None],
    epochs: Sequence[int],
) -> str:
    if epochs and not any(epochs):
        return f"{name} adds nothing to {base}: none of its training served held-out trials, and no epoch was kept."
    idle = f" In {epochs.count(0)} of {len(epochs)} folds none of its training was kept." if 0 in epochs else ""
    if lost := sum(each is None for each in after):
        return f"{name} fails: {lost} of {len(after)} held-out roll-outs diverged.{idle}"
    pairs = [(a, b) for a, b in zip(after, before, strict=True) if a is not None and b]
    if len(pairs) < len(before):
        return f"{name} cannot be compared with {base}, which diverged on held-out trials or has no error there.{idle}"
    gain = paired_gain([b for _, b in pairs], [a for a, _ in pairs])
    means = f"mean {fmean(b for _, b in pairs):.3g} to {fmean(a for a, _ in pairs):.3g} mm"
    which = "less" if gain.share >= 0.0 else "more"
    said = f"{name} leaves {_percent(gain)} {which} error than {base}"
    if gain.trials == 1:
        return f"{said} ({means}).{idle}"
    said += f" on {gain.trials} trials ({means}): "
    if gain.lower <= 0.0 <= gain.upper:
        return f"{said}other trials may show the opposite.{idle}"
    return f"{said}it {'helps' if gain.share > 0.0 else 'does harm'}.{idle}"


def _percent(gain: Gain) -> str:
    """The size of a gain or loss, with the interval in which nine of ten other draws of the trials have it."""
    digits = 2 if 0.99 < gain.share < 1.0 else 0  # Where nearly everything is gone.
    share = f"{100.0 * abs(gain.share):.{digits}f} %"
    return share if gain.trials == 1 else f"{share} (90 %: {_interval(gain, digits)})"


def _interval(gain: Gain, digits: int = 0) -> str:
    """The ends of a gain's interval, of a loss where it is one, in percent."""
    ends = (gain.lower, gain.upper) if gain.share >= 0.0 else (-gain.upper, -gain.lower)
    return " to ".join(f"{100.0 * end:.{digits}f}".replace("-", MINUS) for end in ends)


def advice(folds: Sequence[Sequence[Identified]]) -> list[str]:
    """Say which identified values of each fold are no result but a bound or the first guess, and what to do."""
    found = Counter(said for fold in folds for each in fold if (said := _advice(each)))
    return [f"In {n} of {len(folds)} folds, {said}" if len(folds) > 1 else said for said, n in found.items()]


def _advice(found: Identified) -> str:
    close, name = _CLOSE * (found.upper - found.lower), found.key.rpartition(".")[2]
    for end, bound in (("lower", found.lower), ("upper", found.upper)):
        if abs(found.value - bound) <= close:
            widen = f"widen {found.key}.{end} if the body can be so" if bound else f"take it out (~{found.key})"
            return (
                f"{name} was identified at its {end} bound, {bound:g}: {widen}, or look for what it makes up for, "
                "such as a wrong weight, mesh or registration."
            )
    if found.known or abs(found.value - found.start) > close:
        return ""
    return (
        f"{name} stayed at its first guess, {found.start:g}: raise identify.max_evaluations or identify.starts, or "
        f"take it out (~{found.key}) if the trials do not tell about it."
    )


def _identified(metrics: Mapping[str, Any], settings: Mapping[str, Any]) -> list[Identified]:
    """What a fold has identified, beside how that is configured."""
    config = settings.get("identify") or {}
    found = []
    for model, place in _PLACES.items():
        ranges = config.get(place) or {}
        for name, value in metrics.get("parameters", {}).get(model, {}).items():
            if ranges.get(name):
                start = first_guesses(settings, [name])[name]
                lower, upper = ranges[name]["lower"], ranges[name]["upper"]
                known = ranges[name].get("prior") is not None
                found.append(Identified(f"identify.{place}.{name}", value, lower, upper, start, known))
    return found
