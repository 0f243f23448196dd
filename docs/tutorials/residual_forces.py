# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Residual forces
#
# Identification optimises a simulator's parameters, but errors of its physics remain. The method of
# this package reconstructs the forces that correct these errors, step by step, and learns to
# predict them:
#
# 1. **reconstruct** the force that takes the simulator from an observed state to the next observed
#    state;
# 2. **learn** this force as a function of the state;
# 3. **roll out** the simulator with the learned force, from its own states.
#
# The command `warp-resphys` does this for an experiment. This page does it in Python, for a beam
# whose simulator has a wrong modulus and no viscosity.

# %%
import matplotlib.pyplot as plt
import torch
import warp as wp

from warp_resphys import (
    Body,
    Corotated,
    Inputs,
    Simulator,
    SolverSettings,
    State,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.stepping.rollout import rollout
from warp_resphys.data.markers import MarkerMap
from warp_resphys.learning.residuals.correction import CorrectedSimulator, known_positions
from warp_resphys.learning.residuals.networks import ResidualForce, build_model
from warp_resphys.learning.residuals.reconstruction import make_reconstructor
from warp_resphys.settings.learning import NetworkSettings, ReconstructionSettings

wp.config.log_level = wp.LOG_WARNING
torch.manual_seed(0)
torch.set_num_threads(1)  # faster for a small network, in particular on busy cores

mesh = box_hexahedra(
    size=(0.1, 0.03, 0.03),  # m
    divisions=(8, 3, 3),  # short: (8, 3, 3) -> (4, 3, 3)
)
body = Body(mesh, fixed=select_vertices(mesh, x=0.0))
tip = select_vertices(mesh, x=0.1)
settings = SolverSettings(on_failure="count")  # a failed environment does not stop the others
robot = Simulator(
    body, Corotated(264e3, 0.45, density=1070.0, stiffness_damping=3e-3), solver=settings
)
simulator = Simulator(body, Corotated(215e3, 0.45, density=1070.0), solver=settings)

# %% [markdown]
# ## Motions of the robot
#
# The beam is released from rest under different weights at its tip. All motions are one batch; two
# are for testing.

# %%
kilograms = [0.05, 0.09, 0.11, 0.13, 0.16, 0.19, 0.21, 0.07, 0.14]
weights = torch.tensor(kilograms, dtype=torch.float64)
train, test = slice(0, 7), slice(7, 9)
load = torch.zeros(len(weights), len(mesh.vertices), 3, dtype=torch.float64)  # (B, N, 3) N
load[:, tip, 2] = -9.81 * weights[:, None] / len(tip)
held = robot.static_equilibrium(Inputs(external_force=load))
STEPS = 60  # of 0.01 s  # short: 60 -> 40
motion = robot.rollout(held, STEPS)  # q and v (T + 1, B, N, 3)


def rolled_out(simulator, predict=None):
    """(T + 1, B, N, 3) simulated positions of the test motions, from their first state [m]."""
    start = State(motion.q[0, test], motion.v[0, test])
    corrected = CorrectedSimulator(simulator, predict)
    with torch.no_grad():
        return torch.stack(rollout(corrected.step, start, range(STEPS), known_positions))


def error(q):
    """(T + 1,) mean distance of all vertices from the robot's [mm]."""
    return 1e3 * (q - motion.q[:, test]).norm(dim=-1).mean((1, 2))


uncorrected = rolled_out(simulator)
highest = motion.q[:, test][:, :, tip, 2].mean(-1).max()
swing = 1e3 * (held.q[test][:, tip, 2].mean() - highest).abs()
print(f"uncorrected: {error(uncorrected).mean():.2f} mm; the tip swings over {swing:.0f} mm")

# %% [markdown]
# ## Reconstruct
#
# The force of a step is a regularised least-squares solution,
# $\min_f \lVert q^{+}(f) - \hat q^{+} \rVert^2 + \lambda \lVert f \rVert^2$. All vertices are
# observed here, and Gauss-Newton needs two iterations per step.

# %%
settings = ReconstructionSettings(
    method="gauss_newton", regularisation=1e-10, tolerance=1e-10, max_iterations=20
)
reconstructor = make_reconstructor(simulator, settings)
forces, misfit = [], 0.0
for step in range(STEPS):
    state = State(motion.q[step], motion.v[step])
    reconstructed = reconstructor.step(state, motion.q[step + 1])
    forces.append(reconstructed.force)
    misfit = max(misfit, (reconstructed.state.q - motion.q[step + 1]).abs().max().item())
force = torch.stack(forces)  # (T, B, N, 3) N
print(f"largest error with the force: {1e3 * misfit:.1e} mm")
print(f"largest resultant force on the body: {force.sum(2).norm(dim=-1).max():.2f} N")

# %% [markdown]
# ## Learn
#
# The network's inputs are a few modes of the positions and velocities, its outputs a few modes of
# the force (proper orthogonal decomposition of the training samples). Its linear part is fitted by
# ridge regression, and the network learns the remainder. Torch tensors and Warp arrays share their
# memory without copies.

# %%
samples = [series[:STEPS, train].flatten(0, 1) for series in (motion.q, motion.v, force)]
network = NetworkSettings(
    position_modes=4, velocity_modes=4, force_modes=8, layers=2, width=64, activation="silu"
)
model = build_model(ResidualForce, network, simulator.rest_positions, *samples)

q, v, f = samples
with torch.no_grad():
    inputs, outputs = model.encode(q, v), model.encode_outputs(f)
    model.fit_linear(inputs, outputs, noise=1e-3)
optimiser = torch.optim.Adam(model.network.parameters(), lr=3e-3)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 400)  # short: 400 -> 200
losses = []
for _ in range(400):  # short: 400 -> 200
    optimiser.zero_grad()
    noisy = inputs + 1e-3 * torch.randn_like(inputs)
    loss = (model.standardised(noisy) - outputs).square().mean()
    loss.backward()
    optimiser.step()
    schedule.step()
    losses.append(loss.item())
print(f"mean squared error of the standardised force: {losses[0]:.1e} to {losses[-1]:.1e}")

# %% [markdown]
# ## Roll out
#
# The corrected simulator adds the force predicted for its own state at every step. These are the
# test motions.

# %%
model.eval()
corrected = rolled_out(simulator, lambda state, step: model(state.q, state.v))
print(f"uncorrected {error(uncorrected).mean():.3f} mm, corrected {error(corrected).mean():.3f} mm")

# %%
times = 0.01 * torch.arange(STEPS + 1)
figure, axes = plt.subplots(1, 2, figsize=(8.5, 3), layout="constrained")
for label, positions in [
    ("robot", motion.q[:, test]),
    ("uncorrected", uncorrected),
    ("corrected", corrected),
]:
    style = {"color": "k", "linewidth": 4, "alpha": 0.25} if label == "robot" else {}
    axes[0].plot(times, 1e3 * positions[:, 1, tip, 2].mean(-1), label=label, **style)
axes[0].set(xlabel="time [s]", ylabel="height of the tip, 140 g [mm]")
axes[0].legend(frameon=False)
axes[1].semilogy(times[1:], error(uncorrected)[1:], color="C0", label="uncorrected")
axes[1].semilogy(times[1:], error(corrected)[1:], color="C1", label="corrected")
axes[1].set(xlabel="time [s]", ylabel="mean error of all vertices [mm]")
plt.show()

# %% [markdown]
# ## From markers
#
# For a real robot only a few points are observed. The regularised force then brings these points
# close to the measurements, with little effect on the rest of the body. Here four vertices of the
# tip and four at half length are observed, with noise of a tenth of a millimetre and a
# regularisation to match.

# %%
middle = select_vertices(mesh, x=0.05)
corners = [0, 3, 12, 15]  # of the 16 vertices of a section
seen = torch.as_tensor([*middle[corners], *tip[corners]])
markers = MarkerMap(seen.view(1, -1, 1), torch.ones(1, len(seen), 1, dtype=torch.float64))
settings = ReconstructionSettings(
    method="levenberg_marquardt", regularisation=1e-4, tolerance=1e-6, max_iterations=100
)
from_markers = make_reconstructor(simulator, settings, markers)
state = State(motion.q[0, 7:8], motion.v[0, 7:8])
guess, off = None, []
for step in range(40):
    measured = motion.q[step + 1, 7:8, seen]
    measured = measured + 1e-4 * torch.randn_like(measured)
    reconstructed = from_markers.step(state, measured, first_guess=guess)
    state, guess = reconstructed.state, reconstructed.force
    off.append(1e3 * (state.q - motion.q[step + 1, 7:8]).norm(dim=-1).mean().item())
alone = error(uncorrected)[1:41].mean().item()
print(
    f"error of all vertices from 8 noisy ones: {sum(off) / len(off):.2f} mm; "
    f"without a force {alone:.2f} mm"
)

# %% [markdown]
# `warp-resphys experiment=marker_ablation` studies the number of markers.
# [Bring your robot](bring_a_beam.py) shows the way from the markers of your own robot to a report.

# %%
assert misfit < 1e-6
assert error(corrected).mean() < 0.05 * error(uncorrected).mean()
assert sum(off) / len(off) < 0.3 * alone
