"""Stage: the forces that bring the simulator to the trajectories."""

import torch

from ..dynamics.integrator import State
from ..io.progress import Progress
from ..io.resumable import Field, ResumableHDF5
from ..io.stages import StageContext
from ..learning.reconstruction import make_reconstructor
from .build import build_simulator
from .trajectories import RECONSTRUCTION, TRAJECTORIES, last_state, read_fields, state_fields


def reconstruct(context: StageContext) -> None:
    """Writes reconstruction.h5: q, v and force (B, T + 1, N, 3).

    The force of a frame is the one that led to it; that of the first frame is zero.
    """
    settings = context.settings
    simulator = build_simulator(settings, "simulation")
    reconstructor = make_reconstructor(simulator, **settings["reconstruction"])
    observed, velocity = read_fields(context.run_dir / TRAJECTORIES, "trajectories", "q", "v")
    batch, frames, vertices, _ = observed.shape
    fields = state_fields(batch, vertices)
    fields["force"] = Field((batch, vertices, 3), "N", batch_axes=1)
    path = context.run_dir / RECONSTRUCTION
    with (
        ResumableHDF5(path, "reconstruction", context.fingerprint, frames, fields) as file,
        Progress("reconstruct", frames, "frames", file.done) as progress,
    ):
        state = State(simulator.tensor(observed[:, 0]), simulator.tensor(velocity[:, 0]))
        force, iterations = torch.zeros_like(state.q), 0
        if file.done > 0:
            state = last_state(file, simulator.rest_positions)
            force = simulator.tensor(file.read(file.done - 1)["force"])
        while file.done < file.steps:
            if file.done > 0:
                result = reconstructor.step(state, simulator.tensor(observed[:, file.done]), first_guess=force)
                state, force, iterations = result.state.detach(), result.force, result.iterations
            file.append(q=state.q.cpu().numpy(), v=state.v.cpu().numpy(), force=force.cpu().numpy())
            progress.advance(iterations=iterations)
        file.finish({"regularisation": settings["reconstruction"]["regularisation"]})
