# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A finger with a tendon
#
# A soft finger, 10 cm long, with a tendon below its axis. Twenty lines simulate it, and use a
# gradient to compute the tension that bends the tip to a target. All units are SI.

# %%
import matplotlib.pyplot as plt
import torch
import warp as wp

import warp_resphys as wr

wp.config.log_level = wp.LOG_WARNING  # no message for each loaded kernel

mesh = wr.rod(
    centreline=[[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]],  # m
    radii=0.01,
    layers=8,  # short: 8 -> 4
)
tendon = wr.Tendons([[[x, 0.0, -0.006] for x in (0.0, 0.02, 0.04, 0.06, 0.08, 0.1)]])  # guides, m
finger = wr.Body(mesh, fixed=wr.select_vertices(mesh, x=0.0), energies=[tendon])
tip = wr.select_vertices(mesh, x=0.1)
silicone = wr.StableNeoHookean(
    youngs_modulus=500e3, poissons_ratio=0.45, density=1070.0, stiffness_damping=0.01
)
simulator = wr.Simulator(finger, silicone, time_step=0.01)

tension = torch.tensor([1.5], dtype=torch.float64, requires_grad=True)  # N
motion = simulator.rollout(
    simulator.rest_state(), steps=60, inputs=wr.Inputs(tendon_tension=tension)
)
height = motion.q[-1, 0, tip, 2].mean()  # m
(slope,) = torch.autograd.grad(height, tension)
# A step of Newton's method towards a tip 25 mm down.
better = (tension + (-0.025 - height) / slope).detach()
closer = simulator.rollout(
    simulator.rest_state(), steps=60, inputs=wr.Inputs(tendon_tension=better)
)
reached = closer.q[-1, 0, tip, 2].mean()

axis = motion.plot(tip)
closer.plot(tip, ax=axis)
axis.axhline(-25.0, color="k", linestyle=":")
axis.legend([f"{value.item():.2f} N" for value in (tension, better)] + ["target"], frameon=False)
plt.show()

# %% [markdown]
# `rollout` returns positions (T + 1, B, N, 3) and velocities, and is differentiable with respect to
# all inputs and parameters. `motion.save("finger.h5")` saves the motion,
# `motion.write_vtk("finger.pvd")` writes it for ParaView.
#
# ## Its stiffness from three markers
#
# Real fingers are softer or stiffer than their data sheet. `identify` estimates the stiffness from
# markers observed at every time step. Here the markers are those of a simulated finger of 430 kPa,
# with noise of 0.1 mm.

# %%
places = [[0.1, 0.0, 0.01], [0.07, 0.0, 0.01], [0.04, 0.0, 0.01]]  # at rest, m
markers = wr.bind_markers(mesh, places, ["tip", "middle", "base"])
pull = wr.Inputs(tendon_tension=tension.detach())
real = simulator.rollout(simulator.rest_state(), 30, pull, {"youngs_modulus": 430e3})
noise = 1e-4 * torch.randn(
    31, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
)
seen = torch.cat([markers(q) for q in real.q]) + noise  # (T + 1, M, 3) m
observed = wr.ObservedMotions.of(
    simulator, seen, start=simulator.rest_state(), inputs=pull, observation=markers
)
identified = wr.identify(simulator, observed, {"youngs_modulus": (200e3, 1e6)})
modulus = identified.parameters["youngs_modulus"]
before = wr.evaluate(simulator, observed).mean().item()
after = wr.evaluate(simulator, observed, parameters=identified.parameters).mean().item()
print(f"Young's modulus: {modulus / 1e3:.1f} kPa; ", end="")
print(f"error of the markers: {1e3 * before:.2f} mm before, ", end="")
print(f"{1e3 * after:.2f} mm after identification, equal to their noise")

# %% [markdown]
# Learned forces reduce the error that remains after identification: `reconstruct` and `fit_force`
# take the same `ObservedMotions`, see [the functions](../api/learning.md) and, step by step,
# [Residual forces](residual_forces.py).
#
# ## Summary
#
# One gradient moves the tip close to its target; `identify` comes within one per cent of the
# stiffness.

# %%
assert abs(height.item() + 0.025) > 5 * abs(reached.item() + 0.025)
assert abs(modulus / 430e3 - 1) < 0.01
assert before > 3 * after
