"""Stage: roll-outs of the test trials, by every model, and the errors of their markers."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...data.markers import Markers
from ...dynamics.integrator import State
from ...dynamics.simulator import Simulator
from ...io.files import atomic_hdf5, create, read_checkpoint, write_json
from ...io.progress import Progress
from ...io.stages import StageContext
from ...learning.metrics import summarise, summarise_each
from ...learning.networks import NextState, ResidualForce, restore
from ...learning.replay import Motions, Release, Replay, sample
from ...learning.rollout import DataDrivenRollout, ForcePredictor, HybridRollout, Rollout, StatePredictor, closed_loop
from .files import ERRORS, MODELS, ROLLOUTS, TRAINED, weights_file
from .scene import SIMULATORS, Scene, loads, parameters_of


def evaluate_markers(context: StageContext) -> None:
    """Writes rollouts.h5, positions and markers a model, and errors.json."""
    settings = context.settings
    scene = Scene(settings, context.run_dir / settings["shared"])
    names = tuple(settings["split"]["test"])
    motions = scene.pick(names)
    models = [m for m in MODELS if m != "published" or settings["published"] is not None]
    models = [m for m in models if m != "sysid_elastic" or settings["identify"]["elastic"]]
    releases = {
        kind: scene.release(scene.simulator(kind), motions) for kind in dict.fromkeys(SIMULATORS[m] for m in models)
    }
    positions, markers = {}, {}
    with Progress("evaluate", len(models), "models") as progress:
        for model in models:
            positions[model], markers[model] = _roll_out(context, scene, model, motions, releases)
            progress.advance(1, model=model)
    with atomic_hdf5(context.run_dir / ROLLOUTS, "rollouts", {"names": list(names)}) as file:
        for model in models:
            create(file, f"{model}_q", positions[model], "m")
            create(file, f"{model}_markers", markers[model], "m")
    observed = motions.markers.cpu().numpy()
    errors = {m: [marker_errors(x, y) for x, y in zip(markers[m], observed, strict=True)] for m in models}
    summary: dict[str, Any] = {
        "errors_mm": {m: summarise(rows) for m, rows in errors.items()},
        "per_trajectory": summarise_each(names, errors),
        "per_marker": {m: per_marker(markers[m], observed, scene.labels) for m in models},
    }
    shift = releases["identified"].shift
    if shift is not None:
        summary["sideways_mm"] = dict(zip(names, (1e3 * shift.norm(dim=2).mean(1)).tolist(), strict=True))
    write_json(context.run_dir / ERRORS, summary)


def marker_errors(simulated: NDArray[np.float64], observed: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T',) mean distance of the markers that were seen [mm], of the frames in which one was.

    Args:
        simulated: (T, M, 3) [m], NaN where the roll-out diverged.
        observed: (T, M, 3) [m], NaN where a marker was not seen.
    """
    seen = np.asarray(np.isfinite(observed).all(-1))
    distance = np.where(seen, np.linalg.norm(simulated - np.where(seen[..., None], observed, 0.0), axis=-1), 0.0)
    any_seen = seen.any(1)
    return np.asarray(1e3 * distance.sum(1)[any_seen] / seen.sum(1)[any_seen])


def per_marker(
    simulated: NDArray[np.float64], observed: NDArray[np.float64], labels: tuple[str, ...]
) -> dict[str, float | None]:
    """Mean error of each marker [mm]; None where a roll-out diverged."""
    found: dict[str, float | None] = {}
    for m, label in enumerate(labels):
        errors = [marker_errors(x[:, m : m + 1], y[:, m : m + 1]) for x, y in zip(simulated, observed, strict=True)]
        mean = float(np.concatenate(errors).mean())
        found[label] = mean if np.isfinite(mean) else None
    return found


def _roll_out(
    context: StageContext, scene: Scene, model: str, motions: Motions, releases: Mapping[str, Release]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(R, K + 1, N, 3) positions at whole time steps and (R, T, M, 3) markers at the frames [m]."""
    simulator = scene.simulator(SIMULATORS[model], on_failure="count")
    device = simulator.rest_positions.device
    release = releases[SIMULATORS[model]]
    parameters = parameters_of(context.run_dir, model, simulator.rest_positions)
    tensors = Replay(simulator, scene.markers, motions).tensors(parameters)
    rollout: Rollout
    if model == "simfree":
        network = restore(NextState, *read_checkpoint(context.run_dir / weights_file(model), "next state"))
        rollout = DataDrivenRollout(simulator, state_predictor_of(network.to(device), loads(motions)))
    else:
        force = None
        if model in TRAINED:
            learned = restore(ResidualForce, *read_checkpoint(context.run_dir / weights_file(model), "residual force"))
            force = force_predictor_of(learned.to(device), loads(motions))
        rollout = HybridRollout(simulator, force, tensors=tensors)
    substeps = round(scene.config["time_step"] / simulator.time_step)
    q = roll_out_to_the_end(rollout, simulator, motions, release, substeps)
    markers = markers_at_frames(q, simulator, scene.markers, motions, release)
    return q[:, ::substeps].cpu().numpy(), markers.cpu().numpy()


def roll_out_to_the_end(
    rollout: Rollout, simulator: Simulator, motions: Motions, release: Release, substeps: int = 1
) -> torch.Tensor:
    """(R, K + 1, N, 3) positions from the releases to past the last frame [m]; NaN from where a roll-out diverged.

    K is a multiple of ``substeps``, the simulator's steps that make a time step of the experiment.
    """
    steps = substeps * max(int(float(motions.times.max()) / (substeps * simulator.time_step)) + 2, 2)
    return closed_loop(rollout, State(release.state.q, release.state.v), steps)


def markers_at_frames(
    q: torch.Tensor, simulator: Simulator, markers: Markers, motions: Motions, release: Release
) -> torch.Tensor:
    """(R, T, M, 3) markers at the frames [m] of (R, K + 1, N, 3) positions at the steps; NaN where these are."""
    lost = ~torch.isfinite(q).flatten(2).all(2)
    followed = torch.where(lost[..., None, None], simulator.rest_positions, q)
    series = markers(followed.flatten(0, 1)).unflatten(0, q.shape[:2])
    series = torch.where(lost[..., None, None], torch.nan, series)
    times = (motions.times - release.delay[:, None]).clamp_min(0.0)
    return release.shifted(sample(series, times, simulator.time_step))


def marker_error_mm(
    rollout: Rollout, simulator: Simulator, markers: Markers, motions: Motions, release: Release
) -> float:
    """Mean error of a roll-out's markers [mm]; infinite where one diverged."""
    q = roll_out_to_the_end(rollout, simulator, motions, release)
    simulated = markers_at_frames(q, simulator, markers, motions, release).cpu().numpy()
    pairs = zip(simulated, motions.markers.cpu().numpy(), strict=True)
    mean = summarise([marker_errors(x, y) for x, y in pairs])["mean"]
    return float("inf") if mean is None else mean


def force_predictor_of(model: ResidualForce, load: torch.Tensor) -> ForcePredictor:
    """The force of a model under the loads (R, A) of a batch."""
    return partial(_predict_force, model, load)


def _predict_force(model: ResidualForce, load: torch.Tensor, q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    with torch.no_grad():
        return model(q, v, load).to(q.dtype)


def state_predictor_of(model: NextState, load: torch.Tensor) -> StatePredictor:
    """The next state by a model under the loads (R, A) of a batch."""
    return partial(_predict_state, model, load)


def _predict_state(
    model: NextState, load: torch.Tensor, q: torch.Tensor, v: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    positions, velocities = model(q, v, load)
    return positions.to(q.dtype), velocities.to(q.dtype)
