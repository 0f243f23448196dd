"""What a run shows, in words: which step helped, whether that is more than chance, and what to try next."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any, Final

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


@dataclass(frozen=True)
class Identified:
    """One identified parameter.

    Attributes:
        key: where its range is configured, such as ``identify.parameters.density``.
        value: that was found, in SI units like the others.
        lower: end of its range.
        upper: end of its range.
        start: the first guess.
    """

    key: str
    value: float
    lower: float
    upper: float
    start: float


def judgement(metrics: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Sentences on a run.

    Args:
        metrics: what metrics.json holds: ``per_trajectory`` or ``folds``, ``networks`` and ``parameters``.
        settings: its configuration.
    """
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    rows = [row["errors_mm"] for fold in folds for row in fold.get("per_trajectory", ())]
    errors = {model: [row.get(model) for row in rows] for model in (rows[0] if rows else ())}
    return gains(errors, epochs_kept(metrics)) + advice([_identified(fold, settings) for fold in folds])


def epochs_kept(metrics: Mapping[str, Any]) -> dict[str, list[int]]:
    """How many epochs the weights that were kept have been trained, by model and fold."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    models = {model for fold in folds for model in fold.get("networks", {})}
    return {m: [fold["networks"][m]["epoch"] for fold in folds if m in fold.get("networks", {})] for m in models}


def untrained(epochs: Mapping[str, Sequence[int]]) -> set[str]:
    """The models of which no fold kept an epoch: there the learned force is none."""
    return {model for model, each in epochs.items() if each and not any(each)}


def best(errors: Mapping[str, Any], without: Collection[str] = ()) -> str:
    """The model with the smallest mean error; of equal ones, the simplest; none of the published ones.

    Args:
        errors: a summary [mm] a model.
        without: models that are not asked for.
    """
    means = {m: errors[m]["mean"] for m in ("simulation", *_STEPS) if m in errors and m not in without}
    known = {m: mean for m, mean in means.items() if mean is not None}
    return min(known, key=lambda m: known[m], default="")


def gains(errors: Mapping[str, Sequence[float | None]], epochs: Mapping[str, Sequence[int]]) -> list[str]:
    """Say of every step whether it helped on held-out trials, by how much, and whether by more than its spread.

    The gain is the share of the error that a step takes away, trial by trial; its spread is the standard deviation of
    that over the trials.

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
    shares = [1.0 - a / b for a, b in pairs]
    share, spread = fmean(shares), stdev(shares) if len(shares) > 1 else None
    means = f"mean {fmean(b for _, b in pairs):.3g} to {fmean(a for a, _ in pairs):.3g} mm"
    digits = 2 if 0.99 < share < 1.0 else 0  # Where nearly everything is gone.
    amount = f"{100.0 * abs(share):.{digits}f}{'' if spread is None else f' ± {100.0 * spread:.2g}'} %"
    said = f"{name} leaves {amount} {'less' if share >= 0.0 else 'more'} error than {base}"
    if spread is None:
        return f"{said} ({means}).{idle}"
    said += f" on {len(pairs)} trials ({means}): "
    if abs(share) <= spread:
        return f"{said}that is within its spread over the trials, so another may show the opposite.{idle}"
    return f"{said}it {'helps' if share > 0.0 else 'does harm'}, by more than its spread over the trials.{idle}"


def advice(folds: Sequence[Sequence[Identified]]) -> list[str]:
    """Say which identified values are no result but a bound or the first guess, and what to do.

    Args:
        folds: the identified parameters of each fold.
    """
    found: dict[str, int] = {}
    for each in (each for fold in folds for each in fold):
        close = _CLOSE * (each.upper - each.lower)
        name = each.key.rpartition(".")[2]
        for end, bound in (("lower", each.lower), ("upper", each.upper)):
            if abs(each.value - bound) <= close:
                widen = f"widen {each.key}.{end} if the body can be so" if bound else f"take it out (~{each.key})"
                sentence = (
                    f"{name} was identified at its {end} bound, {bound:g}: {widen}, or look for what it makes up for, "
                    "such as a wrong weight, mesh or registration."
                )
                break
        else:
            if abs(each.value - each.start) > close:
                continue
            sentence = (
                f"{name} stayed at its first guess, {each.start:g}: raise identify.max_evaluations or "
                f"identify.starts, or take it out (~{each.key}) if the trials do not tell about it."
            )
        found[sentence] = found.get(sentence, 0) + 1
    return [f"In {n} of {len(folds)} folds, {said}" if len(folds) > 1 else said for said, n in found.items()]


def _identified(metrics: Mapping[str, Any], settings: Mapping[str, Any]) -> list[Identified]:
    """What a fold has identified, beside how that is configured."""
    config = settings.get("identify") or {}
    guess = {**settings.get("simulation", {}), **(config.get("first_guess") or {})}
    found = []
    for model, place in _PLACES.items():
        ranges = config.get(place) or {}
        for name, value in metrics.get("parameters", {}).get(model, {}).items():
            if name in ranges:
                start = guess.get(name, 1.0 if name == "attached_mass_factor" else 0.0)
                lower, upper = ranges[name]["lower"], ranges[name]["upper"]
                found.append(Identified(f"identify.{place}.{name}", value, lower, upper, start))
    return found
