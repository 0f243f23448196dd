"""Part of the stage `identify_law`: a network in place of a sum of terms."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import torch

from ..energies.law_files import LAW_FORMAT
from ..energies.neural import NeuralMaterial, weight_constants
from ..io.progress import Progress
from ..io.resumable import forget_checkpoint
from ..io.stages import StageContext, package_versions
from ..learning.law import VISCOSITIES
from ..learning.neural_law import train_weights
from ..learning.replay import Replay
from ..settings.stages import IdentifyLawStage
from .experiment import Experiment
from .identify import Checkpoint
from .law_trials import LawTrials, Score, stretches_of
from .trials import evenly

_EVALUATIONS: Final = 60


def train_law(context: StageContext, experiment: Experiment) -> dict[str, Any]:
    """Trains a network, and returns the content of law.json.

    It begins near the identified material: with its moduli, its viscosity and its creep. Other identified parameters
    keep SysID's values. Training trials that are held out for the test of the network stay so. An interrupted training
    goes on from its last iteration.
    """
    settings: IdentifyLawStage = context.settings
    trials, wanted = LawTrials(experiment), settings.law
    names = trials.learned if wanted.trials is None else tuple(evenly(trials.learned, wanted.trials))
    constants = _first(trials)
    begun = NeuralMaterial.from_lame(trials.shear, 2.0 * trials.guess["bulk_1"])
    first = torch.as_tensor(begun.weights)
    trained = {"bulk_1": float(torch.as_tensor(begun.bulk_1))}
    trained |= {name: value for name, value in constants.items() if name == "stiffness_damping" and value > 0.0}

    def law(weights: torch.Tensor, others: Mapping[str, float]) -> dict[str, float]:
        return {**constants, **others, **weight_constants(weights)}

    start = trials.simulator(law(first, trained), NeuralMaterial.model)
    fixed = trials.others(start)

    def tested(weights: torch.Tensor, others: Mapping[str, float]) -> Score:
        values = {"weights": start.tensor(weights)[None], **{n: start.tensor([x]) for n, x in others.items()}}
        return trials.errors(start, {**fixed, **values}, 1)[0]

    limits = (wanted.seconds, trials.seconds, trials.early)
    seconds = min((limit for limit in limits if limit is not None), default=None)
    replays = [
        (Replay(start, r.observe, r.trials if seconds is None else r.trials.first(seconds)), own)
        for r, own in trials.replays(start, names)
    ]
    kept = Checkpoint(context, "law")
    used, most = kept.content.get("used", 0), wanted.max_evaluations or _EVALUATIONS
    with Progress(context.name, most, "evaluations at most", used) as progress:
        found = train_weights(
            replays,
            first,
            trained,
            fixed,
            lambda weights, others: tested(weights, others).error,
            max(most - used, 1),
            lambda loss: progress.advance(1, loss=f"{loss:.3g}"),
            kept.content.get("reached"),
            lambda reached: kept.keep(reached=reached, used=progress.done),
        )
    forget_checkpoint(kept.path)
    score, below = tested(found.weights, found.constants), trials.score_below()
    return {
        "format": LAW_FORMAT,
        "model": NeuralMaterial.model,
        "accepted": score.beats(below),
        "groups": [],
        "constants": law(found.weights, found.constants),
        "units": {"bulk_1": "Pa", "stiffness_damping": "s"},
        "parameters": {name: float(value) for name, value in fixed.items()},
        "loss": found.loss,
        "history": found.history,
        "validation": trials.validation(score, below),
        "stretches": stretches_of(experiment, replays),
        "data": {"name": settings.name, "trials": list(names)},
        "versions": package_versions(),
    }


def _first(trials: LawTrials) -> dict[str, float]:
    """Constants of the material beside the weights: mass, damping and creep as identified."""
    guess = trials.guess
    damping = guess[VISCOSITIES[0]] / trials.shear
    branches = {name: value for name, value in guess.items() if name.startswith("prony")}
    ratios = {
        name.replace("modulus", "ratio"): value / (trials.shear if "modulus" in name else 1.0)
        for name, value in branches.items()
    }
    return {**trials.mass, "stiffness_damping": float(np.clip(damping, 0.0, None)), **ratios}
