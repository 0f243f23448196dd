"""Stage: the forces that bring a simulator to the markers of the training trials."""

import dataclasses

import torch

from ...dynamics.integrator import State
from ...io.progress import Progress
from ...io.resumable import Field, ResumableHDF5
from ...io.stages import StageContext
from ...learning.replay import Replay
from ...learning.sparse_reconstruction import make_sparse_reconstructor
from ..trajectories import last_state, state_fields
from .scene import Scene, at_steps, parameters_of


def reconstruct_markers(context: StageContext) -> None:
    """Writes reconstruction_<model>.h5: q, v and force (R, K + 1, N, 3) of the training trials, R of them."""
    settings = context.settings
    scene = Scene(settings, context.run_dir / settings["shared"])
    kind, model = settings["base"]
    names = tuple(settings["split"]["train"])
    simulator, motions = scene.simulator(kind), scene.pick(names)
    if simulator.integrator == "midpoint":
        # Its velocities ring where positions are prescribed: v+ = 2 (q+ - q) / h - v keeps every deviation.
        simulator = dataclasses.replace(simulator, integrator="bdf2")
    parameters = parameters_of(context.run_dir, model, simulator.rest_positions)
    tensors = Replay(simulator, scene.markers, motions).tensors(parameters)
    reconstructor = make_sparse_reconstructor(simulator, scene.markers, **settings["reconstruction"])
    reconstructor = reconstructor.with_tensors(tensors)
    release = scene.release(simulator, motions)
    observed = release.bound(simulator.tensor(at_steps(motions, simulator.time_step, release.delay)))
    batch, steps = observed.shape[:2]
    fields = state_fields(batch, simulator.body.n_vertices)
    fields["force"] = Field((batch, simulator.body.n_vertices, 3), "N", batch_axes=1)
    path = context.run_dir / f"reconstruction_{model}.h5"
    with (
        ResumableHDF5(path, "reconstruction", context.fingerprint, steps, fields) as file,
        Progress(context.name, steps, "steps", file.done) as progress,
    ):
        state: State = release.state
        force, iterations = torch.zeros_like(state.q), 0
        if file.done > 0:
            state = last_state(file, simulator.rest_positions)
            force = simulator.tensor(file.read(file.done - 1)["force"])
        while file.done < file.steps:
            if file.done > 0:
                result = reconstructor.step(state, observed[:, file.done], first_guess=force)
                state, force, iterations = result.state.detach(), result.force, result.iterations
            file.append(q=state.q.cpu().numpy(), v=state.v.cpu().numpy(), force=force.cpu().numpy())
            progress.advance(iterations=iterations)
        file.finish({"names": list(names), "regularisation": settings["reconstruction"]["regularisation"]})
