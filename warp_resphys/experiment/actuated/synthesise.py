"""Stage: recordings of a simulated body under random pressures, which plays the real one.

Its mesh is finer and its steps are smaller than those of the simulator to correct, its material is another one, and
fibres are wound around its chambers. Cameras see its markers in a frame of their own, with noise.
"""

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...data.actuation import PressureSequences
from ...data.recordings.arrays import write_recording
from ...data.recordings.recording import Recording
from ...dynamics.simulator import Simulator
from ...io.errors import InputError
from ...io.files import write_json
from ...io.processes import Advance
from ...io.stages import StageContext
from ..binding import bound_markers
from ..build import build_simulator
from ..measured.files import TRUTH
from ..measured.synthesise import Scene, make_scene
from .parts import Made, Part, read_parts, remove_parts, split_into_parts, work_on
from .trials import Trial, raised_trials_of, trials_of

FloatArray = NDArray[np.float64]


def synthesise_driven(context: StageContext, processes: int = 1, higher: bool = False) -> None:
    """Writes recordings/<trial>.h5 for every trial, and truth.json.

    Args:
        context: of the stage.
        processes: that share the trials.
        higher: whether the trials are those at higher pressures; truth.json is there then.

    Raises:
        InputError: a configured value that does not fit.
        WorkerError: a step of the simulation fails.
    """
    settings = context.settings
    trials = raised_trials_of(settings) if higher else trials_of(settings)
    names, steps = [trial.name for trial in trials], settings["data"]["steps"]
    parts = split_into_parts(context, names, settings["batch"])
    work_on(parts, simulate_part, processes, steps)
    scene = level_scene(settings)
    labels = (*settings["markers"]["followed"], *settings["markers"]["others"])
    simulator, synthetic = reality(settings), settings["synthetic"]
    distances = []  # of the followed markers from where they would be seen without noise [m]
    found = dict(zip(names, read_parts(parts, "markers"), strict=True))
    standing = np.broadcast_to(scene.others, (steps + 1, *scene.others.shape))
    for trial in trials:
        draw = np.random.default_rng([settings["seed"], zlib.crc32(trial.name.encode())])
        positions = scene.recorded(np.concatenate([found[trial.name], standing], axis=1))
        noise = synthetic["noise"] * draw.standard_normal(positions.shape)
        distances.append(np.linalg.norm(noise[:, : len(scene.followed)], axis=-1).mean())
        path = context.run_dir / trial.made
        pressures = pressures_of(settings, trial, len(simulator.body.chambers))
        rate = 1.0 / settings["time_step"]
        write_recording(path, Recording(labels, positions + noise, rate, path, actuation=pressures))
    if not higher:
        write_json(context.run_dir / TRUTH, _truth(settings, scene, float(np.mean(distances))))
    remove_parts(context)


def _truth(settings: Mapping[str, Any], scene: Scene, noise: float) -> dict[str, Any]:
    """What the recordings were made with; ``noise`` in metres."""
    synthetic = settings["synthetic"]
    return {
        "material": synthetic["material"],
        "fibre_angles": (synthetic["fibres"] or {}).get("angles", []),
        "gravity": settings["gravity"],
        "rotation": scene.rotation.as_matrix(),
        "translation": scene.translation,
        "bound": dict(zip(settings["markers"]["followed"], scene.followed, strict=True)),
        "noise_mm": 1e3 * noise,
    }


def level_scene(settings: Mapping[str, Any]) -> Scene:
    """The body as it stands in the laboratory, level, in the cameras' frame."""
    return make_scene({**settings, "data": {"up": None}})


def reality_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """A whole configuration of the body that plays the real one."""
    own = {key: settings["synthetic"][key] for key in ("mesh", "time_step", "integrator", "material", "fibres")}
    physics = {"mass": "row_sum", "volume_integration": "centre"}
    return {**settings, **own, "physics": physics, "pressure_coupling": "implicit"}


def reality(settings: Mapping[str, Any]) -> Simulator:
    """The simulator that plays the real body, level, with pressure that acts on the chambers as they are."""
    return build_simulator(reality_settings(settings), "material")


def pressures_of(settings: Mapping[str, Any], trial: Trial, chambers: int) -> FloatArray:
    """(K + 1, C) the pressures of a trial at the frames [Pa], drawn from the seed and the number of its sequence."""
    sequences = PressureSequences(limit=settings["data"]["pressure_limit"], **settings["synthetic"]["sequences"])
    draw = np.random.default_rng([settings["seed"], 1, trial.sequence])
    drawn = sequences.draw(settings["data"]["steps"], settings["time_step"], chambers, draw)
    return trial.factor * drawn


def simulate_part(part: Part, advance: Advance) -> dict[str, Made]:
    """The markers (B, K + 1, M, 3) of some trials, in the frame of the body [m].

    Raises:
        ConvergenceError: a step fails.
    """
    settings = part.context.settings
    simulator, scene = reality(settings), level_scene(settings)
    markers = settings["markers"]
    read = bound_markers(markers, simulator.body.mesh, scene.followed, tuple(markers["followed"]))
    read = read.to(simulator.rest_positions)
    substeps = substeps_of(settings)
    known = {trial.name: trial for trial in (*trials_of(settings), *raised_trials_of(settings))}
    chambers = len(simulator.body.chambers)
    drawn = np.stack([pressures_of(settings, known[name], chambers) for name in part.names])
    pressures = simulator.tensor(drawn)  # (B, K + 1, C) [Pa]
    batch, frames = pressures.shape[:2]
    with torch.no_grad():
        tensors = simulator.prepare()
        state = simulator.static_equilibrium(batch=batch)
        series = [read(state.q)]
        for k in range(1, frames):
            for i in range(1, substeps + 1):
                share = _share(simulator.integrator, i, substeps)
                pressure = torch.lerp(pressures[:, k - 1], pressures[:, k], share)
                state, _ = simulator.step(state, material=tensors, pressure=pressure)
            series.append(read(state.q))
            advance(batch)
    return {"markers": (torch.stack(series, 1).cpu().numpy(), "m")}


def _share(integrator: str, step: int, substeps: int) -> float:
    """How much of the way between two frames has passed when the pressure of a smaller step acts."""
    return (step - 0.5) / substeps if integrator == "midpoint" else step / substeps


def substeps_of(settings: Mapping[str, Any]) -> int:
    """Steps of the simulated reality that make one of the simulator.

    Raises:
        InputError: they do not fit.
    """
    ratio = settings["time_step"] / settings["synthetic"]["time_step"]
    if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
        raise InputError(
            f"time_step is {settings['time_step']:g} s and synthetic.time_step {settings['synthetic']['time_step']:g} "
            "s: the first must be a multiple of the second."
        )
    return round(ratio)
