# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A crawler, and a gait by gradients
#
# A soft slab with three muscles along its lower side crawls by friction: it arches, so that one end
# presses harder on the floor than the other, and the other end slides. Gradients pass through
# contact and friction ([the equations](../theory.md#contact)), also where vertices stick, slide and
# lift off. They lead to a gait that is faster than all waves of a grid.
#
# ## The body and the floor

# %%
import math

import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp

from warp_resphys import (
    Body,
    Contact,
    Corotated,
    HalfSpace,
    Inputs,
    Mesh,
    Muscles,
    Simulator,
    box_hexahedra,
)
from warp_resphys.energies import Muscle

wp.config.log_level = wp.LOG_WARNING

LENGTH, WIDTH, HEIGHT = 0.12, 0.03, 0.016  # m
CELLS = (12, 1, 2)  # short: 12 -> 6
GAP = 9.55e-4  # m: of a slab of this weight at rest; contact begins at 1 mm
box = box_hexahedra((LENGTH, WIDTH, HEIGHT), CELLS)
mesh = Mesh(box.vertices + [0.0, 0.0, GAP], box.cells)
middle = mesh.vertices[mesh.cells].mean(axis=1)
part = np.floor(3.0 * middle[:, 0] / LENGTH)
muscles = [
    Muscle(np.flatnonzero((middle[:, 2] < HEIGHT / 2) & (part == number)), (1.0, 0.0, 0.0), name)
    for number, name in enumerate(["rear", "middle", "front"])
]
floor = Contact({"floor": HalfSpace()}, friction=0.6, stiffness=2e4, distance=1e-3, slip_speed=5e-3)
silicone = Corotated(6e4, 0.45, density=1070.0, stiffness_damping=4e-3)
simulator = Simulator(
    Body(mesh, energies=[Muscles(muscles), floor]),
    silicone,
    time_step=0.01,
    relative_tolerance=1e-6,
)

# %% [markdown]
# ## Gaits
#
# A gait is a periodic stress of every muscle, between 0 and 10 kPa, with a period of half a second:
# a constant and two harmonics, through a sigmoid. Three periods are simulated; the stress is ramped
# up in the first one.

# %%
PERIOD, STEPS, MOST = 0.5, 150, 1e4  # s, steps, Pa
times = simulator.time_step * (1.0 + torch.arange(STEPS, dtype=torch.float64))
turns = 2.0 * math.pi * times / PERIOD
harmonics = torch.stack(
    [torch.ones_like(turns), *(f(k * turns) for k in (1, 2) for f in (torch.cos, torch.sin))]
)
ramp = (times / PERIOD).clamp_max(1.0)[:, None, None]


def stresses(gaits):
    """Muscle stresses (T, B, 3) of gaits (B, 3, 5) [Pa]."""
    return MOST * ramp * torch.sigmoid(torch.einsum("bmk,kt->tbm", gaits, harmonics))


def crawl(gaits):
    """Way of the middle (B,) of a batch of gaits [m], and the trajectory."""
    start = simulator.rest_state(len(gaits))
    trajectory = simulator.rollout(start, STEPS, Inputs(muscle_stress=stresses(gaits)))
    place = trajectory.q[..., 0].mean(-1)
    return place[-1] - place[0], trajectory


def waves(phases):
    """Gaits (B, 3, 5) that switch the muscles on and off, the middle and the front one with phases
    (B, 2) [rad].
    """
    phases = torch.nn.functional.pad(phases, (1, 0))
    gaits = torch.zeros(len(phases), 3, 5, dtype=torch.float64)
    gaits[..., 1], gaits[..., 2] = 3.0 * torch.cos(phases), 3.0 * torch.sin(phases)
    return gaits


# %% [markdown]
# ## A grid of waves
#
# 36 waves, all in one batch:

# %%
COUNT = 6  # short: 6 -> 2
phase = 2.0 * math.pi * torch.arange(COUNT, dtype=torch.float64) / COUNT
grid = torch.cartesian_prod(phase, phase)
with torch.no_grad():
    ways, motions = crawl(waves(grid))
best = int(ways.argmax())
middle_phase, front_phase = grid[best].tolist()
print(
    f"best of 36 waves: {1e3 * ways[best]:.1f} mm in 1.5 s, with phases of {middle_phase:.2f} "
    f"and {front_phase:.2f} rad"
)

# %% [markdown]
# ## A gait by gradients
#
# The same effort of 36 simulations, where one with its gradient counts as two: eight random waves,
# then fourteen steps of Adam from the best of them.

# %%
torch.manual_seed(0)
random = waves(2.0 * math.pi * torch.rand(8, 2, dtype=torch.float64))  # short: (8 -> (2
with torch.no_grad():
    first, _ = crawl(random)
# Forwards or backwards: the slab looks the same from both ends.
direction = torch.sign(first[first.abs().argmax()])
gait = random[first.abs().argmax()][None].requires_grad_()
optimiser = torch.optim.Adam([gait], lr=0.4)
reached = []
for _ in range(14):  # short: 14 -> 2
    optimiser.zero_grad()
    way, motion = crawl(gait)
    (-direction * way.sum()).backward()
    optimiser.step()
    reached.append(1e3 * abs(way.item()))
print("mm:", " ".join(f"{way:.1f}" for way in reached))

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
left.axhline(1e3 * ways[best], color="0.5", linestyle="--", label="best of 36 waves")
left.plot(8 + 2 * np.arange(1, 1 + len(reached)), reached, "o-", label="gradients")
left.set(xlabel="simulations", ylabel="way [mm]", ylim=(0, None))
left.legend(frameon=False)
clock = simulator.time_step * np.arange(STEPS + 1)
for label, q in (
    ("best of 36 waves", motions.q[:, best]),
    ("gradients", motion.q[:, 0].detach() * direction),
):
    right.plot(clock, 1e3 * (q[..., 0].mean(-1) - q[0, :, 0].mean()), label=label)
right.set(xlabel="time [s]", ylabel="place of the middle [mm]")
right.legend(frameon=False)
plt.show()

# %% [markdown]
# Side views of the slab, every tenth of a second of the last period, from top to bottom:

# %%
nx, _, nz = CELLS
q = motion.q[:, 0].detach().numpy()
side = np.flatnonzero(np.isclose(mesh.vertices[:, 1], mesh.vertices[:, 1].min()))
order = np.lexsort((mesh.vertices[side, 0], mesh.vertices[side, 2]))
rows = side[order].reshape(nz + 1, nx + 1)
outline = np.concatenate([rows[0], rows[1:, -1], rows[-1, -2::-1], rows[-2::-1, 0]])
figure, axis = plt.subplots(figsize=(4, 5), layout="constrained")
for number, step in enumerate(range(STEPS - 50, STEPS + 1, 10)):
    lift = -40.0 * number
    axis.fill(1e3 * q[step, outline, 0], 1e3 * q[step, outline, 2] + lift, color="C0", alpha=0.4)
    axis.axhline(lift, color="0.4", linewidth=0.8)
axis.set(xlabel="x [mm]", aspect="equal", yticks=[])
plt.show()

# %% [markdown]
# ## Friction over a period
#
# `Simulator.contacts` returns gaps, normal forces, friction and the slide of every vertex in a
# step; they are differentiable too. The figure shows the friction of both halves of the slab over
# the last period:

# %%
forces = []
with torch.no_grad():
    state, applied = simulator.rest_state(), stresses(gait)
    front = None
    for number in range(STEPS):
        inputs = Inputs(muscle_stress=applied[number])
        after = simulator.step(state, inputs)
        contact = simulator.contacts(state, after, inputs)["obstacles"]
        if front is None:
            front = torch.as_tensor(mesh.vertices[contact.vertices, 0] > LENGTH / 2)
        forces.append(
            [float(contact.friction[0, chosen, 0, 0].sum()) for chosen in (~front, front)]
        )
        state = after
forces = 1e3 * np.array(forces)
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
axis.plot(times[-50:], forces[-50:, 0], label="rear half")
axis.plot(times[-50:], forces[-50:, 1], label="front half")
axis.set(xlabel="time [s]", ylabel="friction [mN]")
axis.legend(frameon=False)
plt.show()

# %% [markdown]
# One half sticks while the other slides; over a period the sum is about zero. The weight of the
# slab is 0.6 N, so friction can be at most 0.36 N.

# %%
assert reached[-1] > 1.5e3 * ways[best]  # short: 1.5e3 * ways[best] -> reached[0]
assert abs(forces[-50:].sum(1).mean()) < 0.05 * 360
assert np.abs(forces[-50:]).max() < 360
