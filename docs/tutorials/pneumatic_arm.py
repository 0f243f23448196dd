# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A pneumatic arm
#
# A silicone arm with three chambers hangs from its base. Air pressure in a chamber lengthens its
# side, and the arm bends away. This page generates such an arm from its dimensions, bends it, uses
# the adjoint to compute the pressures that bring the tip to a target, and opens a valve.
# [The guide](../actuators.md) adds markers, identification and a learned force
# (`experiment=sopra`).
#
# ## The arm

# %%
import matplotlib.pyplot as plt
import numpy as np
import scipy.optimize
import torch
import warp as wp

from warp_resphys import Body, Corotated, Fibres, Inputs, Pressure, Simulator, select_vertices
from warp_resphys.mesh import ArmMesh, find_chambers, mesh_arm

wp.config.log_level = wp.LOG_WARNING

dimensions = ArmMesh(  # m
    chamber_lengths=(0.1,),
    caps=(0.008, 0.008),
    radii=(0.022, 0.018),
    size=0.008,  # short: 0.008 -> 0.015
)
mesh, surfaces = mesh_arm(dimensions)
chambers = find_chambers(mesh)
print(f"{len(mesh.vertices)} vertices; surfaces: {', '.join(surfaces)}")

length = -mesh.vertices[:, 2].min()
tip = select_vertices(mesh, z=-length)
silicone = Corotated(
    youngs_modulus=264e3, poissons_ratio=0.49, density=1070.0, stiffness_damping=5e-3
)


def arm(energies):
    body = Body(mesh, fixed=select_vertices(mesh, z=0.0), energies=energies)
    return Simulator(body, silicone, time_step=0.01, integrator="bdf2")


# %% [markdown]
# ## Fibres
#
# Air pressure acts in all directions. Without a thread around it, a chamber widens more than it
# lengthens, and bends the arm less. Fibres are an energy of the chamber's surface that resists
# stretching along the thread.

# %%
threads = Fibres(chambers, (8.0, -8.0), stiffness=1e4)  # degrees; N/m
pressures = torch.zeros(6, 3, dtype=torch.float64)  # (B, chambers) Pa  # short: (6 -> (2
pressures[:, 0] = torch.linspace(0.0, 20e3, 6)  # short: , 6 -> , 2
volumes, bends = {}, {}
for name, energies in {
    "without fibres": [Pressure(chambers)],
    "with fibres": [Pressure(chambers), threads],
}.items():
    simulator = arm(energies)
    states = simulator.static_equilibrium(Inputs(pressure=pressures), batch=len(pressures))
    bends[name] = 1e3 * (states.q[:, tip].mean(1) - states.q[0, tip].mean(0)).norm(dim=1)
    volumes[name] = energies[0].volumes(simulator.body.mesh, states.q)[:, 0]  # m^3

figure, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
for name, values in bends.items():
    axes[0].plot(1e-3 * pressures[:, 0], values, "o-", label=name)
    axes[1].plot(1e-3 * pressures[:, 0], 1e6 * volumes[name], "o-")
axes[0].set(xlabel="pressure in chamber 1 [kPa]", ylabel="the tip moves by [mm]")
axes[1].set(xlabel="pressure in chamber 1 [kPa]", ylabel="volume of chamber 1 [ml]")
axes[0].legend(frameon=False)
plt.show()

# %% [markdown]
# ## Pressures for a target
#
# Which pressures bring the tip to a given position? `static_equilibrium` is differentiable, and its
# adjoint is one linear solve. L-BFGS minimises the distance, with bounds on the pressures.

# %%
simulator = arm([Pressure(chambers), threads])
rest = simulator.static_equilibrium()
target = rest.q[0, tip].mean(0) + torch.tensor([0.005, -0.004, 0.0])  # m
history = []


def miss(x):
    """Squared distance of the tip from the target [mm^2], a small price on pressure, gradient."""
    pressure = (1e4 * torch.tensor(x)[None]).requires_grad_()  # (1, 3) Pa
    place = simulator.static_equilibrium(Inputs(pressure=pressure)).q[0, tip].mean(0)
    distance = 1e3 * (place - target)[:2].norm()
    history.append(distance.item())
    value = distance.square() + 1e-3 * (1e-4 * pressure).square().sum()
    value.backward()
    return value.item(), 1e4 * pressure.grad[0].numpy()


best = scipy.optimize.minimize(
    miss, np.full(3, 0.3), jac=True, method="L-BFGS-B", bounds=[(0.0, 2.5)] * 3
)
pressure = 1e4 * best.x
print(
    f"pressures {np.round(1e-3 * pressure, 2)} kPa; the tip is {history[-1]:.3f} mm from the "
    "target in the plane"
)
print(
    f"{len(history)} equilibria; distances [mm]:",
    ", ".join(f"{distance:.2f}" for distance in history[:8]),
    "...",
)

# %% [markdown]
# ## A valve
#
# A step of the pressures makes the arm swing. Time-dependent inputs of a roll-out have a leading
# axis of time.

# %%
STEPS = 120
valve = torch.zeros(STEPS, 1, 3, dtype=torch.float64)  # (T, B, chambers) Pa
valve[20:] = torch.tensor(pressure)
motion = simulator.rollout(rest, STEPS, inputs=Inputs(pressure=valve)).q[:, 0, tip].mean(1)
times = 0.01 * np.arange(STEPS + 1)
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
for number, name in enumerate("xy"):
    axis.plot(times, 1e3 * motion[:, number], color=f"C{number}", label=name)
    axis.axhline(1e3 * target[number], color=f"C{number}", linewidth=1.0, linestyle=":")
axis.set(xlabel="time [s]", ylabel="place of the tip [mm]")
figure.legend(loc="outside upper center", ncols=2, frameon=False)
plt.show()

# %% [markdown]
# ## Your own arm
#
# An experiment needs a mesh with closed chambers, pressures and markers in CSV files, and about
# twenty lines of configuration: [robots driven by pressure](../actuators.md). With the threads of
# SoPrA in the simulator (`experiment=sopra_fibres`), the error on its simulated laboratory is
# 0.44 mm after identification, and 0.23 mm with the learned force ([robots](../robots.md#sopra)).
#
# The pressures were computed for a simulator. Their accuracy on a robot depends on the correction
# of the simulator: see [control](control.py).

# %%
assert history[-1] < 0.1
assert bends["with fibres"][-1] > 1.2 * bends["without fibres"][-1]
assert volumes["without fibres"][-1] > 1.2 * volumes["with fibres"][-1]
assert (motion[-1, :2] - target[:2]).norm() < 1e-3
