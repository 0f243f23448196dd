"""Stage: recordings of a simulated body that plays the real one, for users without a laboratory.

Its mesh is finer and its steps smaller than those of the simulator to correct, its material is another one. It stands
a little off level, its markers sit a little off their nominal places, and cameras see it in their frame, with noise.
"""

import logging
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...data.recordings.arrays import write_recording
from ...data.recordings.recording import Recording
from ...dynamics.integrator import State
from ...dynamics.simulator import Simulator
from ...io.files import write_json
from ...io.progress import Progress
from ...io.stages import StageContext
from ...learning.replay import sample
from ..binding import bound_markers
from ..build import build_simulator
from .files import TRUTH, attached_mass, recording_file
from .trials import Trial, trials_of, vertical

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

_LARGEST_OFFSET = 0.5  # m, of the cameras' frame


@dataclass(frozen=True)
class Scene:
    """The body as it stands in the laboratory.

    Attributes:
        gravity: (3,) in the frame of the body [m/s^2].
        rotation: from the frame of the body to that of the recordings.
        translation: (3,) [m].
        followed: (M, 3) where these markers are on the body at rest [m].
        others: (S, 3) where the standing ones are [m].
    """

    gravity: FloatArray
    rotation: Rotation
    translation: FloatArray
    followed: FloatArray
    others: FloatArray

    def recorded(self, positions: FloatArray) -> FloatArray:
        """Positions (..., 3) in the frame of the body, as the cameras have them [m]."""
        seen: FloatArray = positions @ self.rotation.as_matrix().T + self.translation
        return seen


def synthesise(context: StageContext) -> None:
    """Writes recordings/<trial>.h5 for every trial, and truth.json.

    The settings are the groups data, markers, synthetic, fixed and solver and the keys gravity, device, dtype and seed.

    Raises:
        InputError: a configured value that does not fit.
        ConvergenceError: a step of the simulation fails.
    """
    settings = context.settings
    synthetic = settings["synthetic"]
    trials = trials_of(settings)
    scene = make_scene(settings)
    simulator = reality(settings, scene.gravity)
    rate, held = synthetic["rate"], synthetic["held_seconds"]
    draws = [np.random.default_rng([settings["seed"], zlib.crc32(trial.name.encode())]) for trial in trials]
    released = held + np.array([draw.random() for draw in draws]) / rate  # (R,) [s]
    times = np.arange(int((held + synthetic["seconds"]) * rate) + 1) / rate  # (T,) [s]
    moving = simulate(settings, simulator, scene, trials, times[None] - released[:, None])
    labels = (*settings["markers"]["followed"], *settings["markers"]["others"])
    standing = np.broadcast_to(scene.others, (len(times), *scene.others.shape))
    distances = []  # of the followed markers from where they would be seen without noise, (T, M) a trial [m]
    for trial, draw, swing in zip(trials, draws, moving, strict=True):
        positions = scene.recorded(np.concatenate([swing, standing], axis=1))
        noise = synthetic["noise"] * draw.standard_normal(positions.shape)
        positions += noise
        distances.append(np.linalg.norm(noise[:, : swing.shape[1]], axis=-1))
        path = context.run_dir / recording_file(trial.name)
        write_recording(path, Recording(labels, positions, rate, path), {"hung_kg": trial.hung})
    write_json(
        context.run_dir / TRUTH,
        {
            "material": synthetic["material"],
            "gravity": scene.gravity,
            "rotation": scene.rotation.as_matrix(),
            "translation": scene.translation,
            "bound": dict(zip(settings["markers"]["followed"], scene.followed, strict=True)),
            "noise_mm": 1e3 * float(np.mean(distances)),
            "released_s": {trial.name: at for trial, at in zip(trials, released, strict=True)},
        },
    )


def make_scene(settings: Mapping[str, Any]) -> Scene:
    """Draws how the body stands, and where its markers are, from the seed.

    The frame of the recordings keeps its vertical in ``data.up``, as that of levelled cameras; the body leans by
    ``synthetic.tilt``. Where ``data.up`` is null, the body stands level and the frame is any.
    """
    synthetic, markers = settings["synthetic"], settings["markers"]
    draw = np.random.default_rng([settings["seed"], 0])
    gravity = np.asarray(settings["gravity"], dtype=np.float64)
    up = vertical(settings["data"]["up"])
    rotation = Rotation.random(random_state=draw)
    heading, turn = draw.uniform(0.0, 2.0 * np.pi, 2)
    strength = float(np.linalg.norm(gravity))
    if up is not None and strength > 0.0:
        across = np.linalg.svd(gravity[None])[2][1:]  # two unit vectors
        axis = np.cos(heading) * across[0] + np.sin(heading) * across[1]
        gravity = Rotation.from_rotvec(np.radians(synthetic["tilt"]) * axis).apply(gravity)
        upright, _ = Rotation.align_vectors(up[None], -gravity[None] / strength)
        rotation = Rotation.from_rotvec(turn * up) * upright
    translation = draw.uniform(-_LARGEST_OFFSET, _LARGEST_OFFSET, 3)
    nominal = np.array([*markers["followed"].values(), *markers["others"].values()], dtype=np.float64)
    places = nominal + synthetic["misplaced"] * draw.standard_normal(nominal.shape)
    count = len(markers["followed"])
    return Scene(gravity, rotation, translation, places[:count], places[count:])


def reality(settings: Mapping[str, Any], gravity: FloatArray) -> Simulator:
    """The simulator that plays the real body: with masses and volumes as they should be."""
    synthetic = settings["synthetic"]
    own = {key: synthetic[key] for key in ("mesh", "time_step", "integrator", "material")}
    physics = {"mass": "row_sum", "volume_integration": "centre"}
    return build_simulator({**settings, **own, "physics": physics, "gravity": gravity.tolist()}, "material")


def simulate(
    settings: Mapping[str, Any], simulator: Simulator, scene: Scene, trials: tuple[Trial, ...], times: FloatArray
) -> FloatArray:
    """(R, T, M, 3) the followed markers in the frame of the body [m].

    Args:
        settings: of the stage.
        simulator: of the real body.
        scene: where its markers are.
        trials: R trials, simulated as one batch.
        times: (R, T) [s] since the release; before it the body is held, undeformed and at rest.

    Raises:
        ConvergenceError: a step fails.
    """
    markers = settings["markers"]
    read = bound_markers(markers, simulator.body.mesh, scene.followed, list(markers["followed"]))
    read = read.to(simulator.rest_positions)
    loads = np.array([trial.hung for trial in trials])
    masses = attached_mass(simulator.body, settings["data"]["hung_on"], loads)
    steps = max(int(times.max() / simulator.time_step) + 1, 2)
    with torch.no_grad(), Progress("synthesise", steps, "steps") as progress:
        tensors = simulator.prepare(attached_mass=simulator.tensor(masses))
        state: State = simulator.rest_state(len(trials))
        series = [read(state.q)]
        for _ in range(steps):
            state, _ = simulator.step(state, material=tensors)
            series.append(read(state.q))
            progress.advance()
        at = simulator.tensor(np.maximum(times, 0.0))
        return np.asarray(sample(torch.stack(series, 1), at, simulator.time_step).cpu().numpy())
