# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # First simulation
#
# A silicone beam, 10 cm long and 3 cm thick, is clamped at one end. It sags under its weight, is
# pulled down, and released. All units are SI.
#
# ## A body, a material, a simulator

# %%
import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp

from warp_resphys import (
    Body,
    Corotated,
    Inputs,
    Simulator,
    StableNeoHookean,
    box_hexahedra,
    quadratic,
    select_vertices,
)

wp.config.log_level = wp.LOG_WARNING  # no message for each loaded kernel

box = box_hexahedra(size=(0.1, 0.03, 0.03), divisions=(8, 2, 2))  # m  # short: 8 -> 3
mesh = quadratic(box)  # 27-node hexahedra
clamp, tip = select_vertices(mesh, x=0.0), select_vertices(mesh, x=0.1)
body = Body(mesh, fixed=clamp)
silicone = Corotated(youngs_modulus=264e3, poissons_ratio=0.45, density=1070.0)  # Pa, 1, kg/m^3
simulator = Simulator(body, silicone, time_step=0.01)
print(f"{len(mesh.vertices)} vertices, {len(mesh.cells)} cells, clamped at {len(clamp)} vertices")

# %% [markdown]
# ## Equilibrium
#
# `static_equilibrium` computes the body at rest. States have the shape (B, N, 3): B environments,
# here one, with N vertices each.
#
# The result can be compared with beam theory. Under a uniform load $w = \rho g A$ the deflection of
# a cantilever's tip is the sum of Euler-Bernoulli bending and Timoshenko shear,
#
# $$ \delta = \frac{w L^4}{8 E I} + \frac{w L^2}{2 \kappa G A}, \qquad \kappa = \frac{5}{6}. $$

# %%
length, width, modulus, ratio, density, gravity = 0.1, 0.03, 264e3, 0.45, 1070.0, 9.80709
area, second_moment, shear = width**2, width**4 / 12, modulus / (2 * (1 + ratio))
load = density * gravity * area
bent = load * length**4 / (8 * modulus * second_moment)
sheared = load * length**2 / (2 * 5 / 6 * shear * area)
expected = bent + sheared

hanging = simulator.static_equilibrium()
sag = -(hanging.q[0, tip, 2].mean() - simulator.rest_positions[tip, 2].mean()).item()
print(f"the tip sinks by {1e3 * sag:.3f} mm; Timoshenko's beam by {1e3 * expected:.3f} mm")

# %% [markdown]
# The agreement is this good because two errors of about five per cent cancel. For small strains,
# the second term of this energy has a third of Lamé's $\lambda$ ([theory](../theory.md#materials)),
# so that this silicone is as soft as one of 250 kPa. The clamp, which beam theory neglects,
# prevents the lateral contraction of the cross-section and stiffens a beam as short as this one.
# `StableNeoHookean` is linear elasticity for small strains, so that only the effect of the clamp
# remains.

# %%
third = 264e3 * 0.45 / ((1 + 0.45) * (1 - 2 * 0.45)) / 3  # Pa, of Lame's first parameter
seen_ratio = third / (2 * (third + shear))
seen_modulus = 2 * shear * (1 + seen_ratio)
print(f"seen by small strains: {seen_modulus / 1e3:.1f} kPa, Poisson's ratio {seen_ratio:.3f}")


def sag_of(material):
    """Deflection of the tip [m]."""
    other = Simulator(body, material, time_step=0.01)
    hanging = other.static_equilibrium().q[0, tip, 2].mean()
    return (other.rest_positions[tip, 2].mean() - hanging).item()


linear = sag_of(StableNeoHookean(youngs_modulus=modulus, poissons_ratio=ratio, density=density))
alike = sag_of(
    StableNeoHookean(youngs_modulus=seen_modulus, poissons_ratio=seen_ratio, density=density)
)
print(
    f"stable neo-Hookean: {1e3 * linear:.2f} mm, with the moduli that small strains see "
    f"{1e3 * alike:.2f} mm"
)

# %% [markdown]
# ## Motion
#
# A force at the tip holds the beam down. `rollout` releases it: without `Inputs`, only gravity
# acts. The integrator is implicit Euler, which is stable with any time step, but adds damping.
# `bdf2` and `midpoint` are of second order; a smaller step shows their error.

# %%
pull = torch.zeros(1, len(mesh.vertices), 3, dtype=torch.float64)  # (B, N, 3) N
pull[:, tip, 2] = -0.3 / len(tip)
held = simulator.static_equilibrium(Inputs(external_force=pull))


def height(trajectory):
    """(T,) mean height of the tip, of the first environment [mm]."""
    return 1e3 * trajectory.q[:, 0, tip, 2].mean(-1)


motions = {}
for integrator, step in [
    ("implicit_euler", 0.01),
    ("bdf2", 0.01),
    ("midpoint", 0.01),
    ("midpoint", 0.0025),
]:
    other = Simulator(body, silicone, time_step=step, integrator=integrator)
    motions[integrator, step] = height(other.rollout(held, steps=round(0.5 / step)))

figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
for (integrator, step), values in motions.items():
    axis.plot(step * np.arange(len(values)), values, label=f"{integrator}, {1e3 * step:g} ms")
axis.set(xlabel="time [s]", ylabel="height of the tip [mm]")
figure.legend(loc="outside upper center", ncols=4, frameon=False)
plt.show()

# %% [markdown]
# This material has no damping, so that the last two curves should not decay; implicit Euler
# dissipates most of the motion within two swings. To identify a robot's damping, the damping of the
# integrator must be small.
#
# ## Batches
#
# Environments of a batch are solved together. A parameter may have one value per environment, with
# shape (B, 1).

# %%
moduli = torch.tensor([[150e3], [264e3], [400e3]], dtype=torch.float64)  # Pa
parameters = {"youngs_modulus": moduli}
midpoint = Simulator(body, silicone, time_step=0.005, integrator="midpoint")
three = midpoint.static_equilibrium(
    Inputs(external_force=pull.expand(3, -1, -1)), parameters=parameters, batch=3
)
swings = midpoint.rollout(three, steps=100, parameters=parameters)
print("positions of the trajectory (time, environment, vertex, axis):", tuple(swings.q.shape))

times = 0.005 * np.arange(len(swings.q))
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
for number, value in enumerate(moduli[:, 0].tolist()):
    axis.plot(times, 1e3 * swings.q[:, number, tip, 2].mean(-1), label=f"{value / 1e3:.0f} kPa")
axis.set(xlabel="time [s]", ylabel="height of the tip [mm]")
figure.legend(loc="outside upper center", ncols=3, frameon=False)
plt.show()

# %% [markdown]
# The frequency of a cantilever is proportional to the square root of its modulus. A period is
# the mean time between two downward crossings of the mean height.

# %%
heights = swings.q[:, :, tip, 2].mean(-1).numpy()  # (T, B)
falls = [np.flatnonzero(np.diff(np.sign(height - height.mean())) < 0) for height in heights.T]
periods = np.array([0.005 * np.diff(crossings).mean() for crossings in falls])
for value, period in zip(moduli[:, 0].tolist(), periods, strict=True):
    print(
        f"{value / 1e3:.0f} kPa: a period of {1e3 * period:.0f} ms, "
        f"{period * value**0.5:.1f} s Pa^0.5"
    )

# %% [markdown]
# ## Summary
#
# The equilibrium agrees with beam theory, apart from the effects of clamp and material. With the
# midpoint rule and small steps the tip returns to its initial height in the last swings; with
# implicit Euler it does not. Periods depend on the modulus as predicted. The following checks stop
# the build of the book if a figure of this page is wrong.

# %%
assert abs(sag / expected - 1) < 0.02
assert abs(alike / sag - 1) < 0.02
assert 0.9 < linear / expected < 0.97
fine = motions["midpoint", 0.0025]
assert abs(fine[150:].min() - fine[0]) < 0.1 * (fine.max() - fine[0])
assert motions["implicit_euler", 0.01][25:].min() - fine[0] > 0.2 * (fine.max() - fine[0])
assert abs(periods[0] / periods[2] / (400 / 150) ** 0.5 - 1) < 0.05
