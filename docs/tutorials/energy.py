# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Write your own energy
#
# Materials, pressure, fibres, tendons, muscles and water are energies. A new energy is a Warp
# function and a class of a few lines; solver, adjoint, tape and identification support it without
# changes. This page implements a floor, on which a block falls, and an elastic string. (For real
# use, the package has [contact](../contact.md) with friction.)
#
# ## The equation
#
# A vertex that is $d = z_0 - z > 0$ below the floor's height $z_0$ has the energy
#
# $$ e = \tfrac{k}{3} d^3, \qquad \text{a force } k d^2 \text{ upwards}, \qquad
# \text{a stiffness } 2 k d, $$
#
# which is twice continuously differentiable where contact begins, as Newton's method and gradients
# require. Its parameters are $k$ [N/m²] and $z_0$ [m].
#
# ## The function and the class
#
# An energy is a sum over points. Its argument is a weighted sum of a few vertices: the position of
# a vertex, the vector from one to another, or, as a matrix, the deformation gradient in a cell. The
# energy of a point is a Warp function of this argument and of the point's values. These are the
# parameters and inputs in the order in which the class declares them, with units and ranges, which
# are checked. Warp differentiates the function for the forces. The second derivatives, for Newton
# steps and gradients, are fourth-order differences of the forces, exact to about nine digits.

# %%
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp

from warp_resphys import Body, Corotated, Simulator, State, box_hexahedra, select_vertices
from warp_resphys.core.energies.pointwise import PointwiseEnergy, at_vertices, between
from warp_resphys.core.stepping.quantity import parameter

wp.config.log_level = wp.LOG_WARNING


@wp.func
def floor_energy(x: wp.vec3d, values: wp.vec2d) -> wp.float64:
    depth = wp.max(values[1] - x[2], wp.float64(0.0))
    return values[0] * depth * depth * depth / wp.float64(3.0)


@dataclass(frozen=True)
class Floor(PointwiseEnergy):
    """A floor that pushes vertices up."""

    density: ClassVar = floor_energy
    size: ClassVar = 1e-3  # metres; differences have steps of 3e-4 of it
    vertices: np.ndarray  # vertices that may touch the floor
    stiffness: float = parameter(1e5, "floor_stiffness", "N/m^2", closed=True)  # k, zero or more
    height: float = parameter(0.0, "floor_height", "m", -np.inf, typical=0.01)  # z_0, any

    def points(self, mesh):
        return (at_vertices(self.vertices),)


# %% [markdown]
# ## A block that is dropped

# %%
mesh = box_hexahedra(
    size=(0.04, 0.04, 0.04),  # m
    divisions=(4, 4, 4),  # short: (4, 4, 4) -> (2, 2, 2)
)
bottom, top = select_vertices(mesh, z=0.0), select_vertices(mesh, z=0.04)
body = Body(mesh, energies=[Floor(bottom, stiffness=1e5, height=-0.02)])
silicone = Corotated(
    youngs_modulus=50e3, poissons_ratio=0.45, density=1070.0, stiffness_damping=2e-3
)
simulator = Simulator(
    body,
    silicone,
    time_step=0.002,  # short: 02, -> 04,
    integrator="bdf2",
    relative_tolerance=1e-9,
)
print("parameters:", ", ".join(simulator.parameters))

fall = simulator.rollout(simulator.rest_state(), steps=1000)  # short: 1000 -> 500
height = fall.q[:, 0, :, 2]
times = simulator.time_step * np.arange(len(height))
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
axis.plot(times, 1e3 * height[:, top].mean(1), label="top")
axis.plot(times, 1e3 * height[:, bottom].mean(1), label="bottom")
axis.axhline(-20.0, color="0.6", linewidth=1.0)
axis.set(xlabel="time [s]", ylabel="height [mm]")
axis.legend(frameon=False)
plt.show()

# %% [markdown]
# At rest, the floor must carry the weight of the block.

# %%
depth = (-0.02 - height[-1, bottom]).clamp_min(0.0)
carried, weight = (1e5 * depth**2).sum().item(), 1070.0 * 0.04**3 * 9.80709
print(f"carried {carried:.4f} N, weight {weight:.4f} N")

# %% [markdown]
# ## Its gradients
#
# The derivatives of the block's height after the first rebound, with respect to both parameters of
# the floor, are compared with central differences. Every new energy should have this test.

# %%
state = simulator.rest_state()
down = torch.tensor([0.0, 0.0, 0.018], dtype=torch.float64)
state = State(state.q - down, state.v)  # it falls 2 mm


def rebound(stiffness, floor):
    parameters = {"floor_stiffness": stiffness, "floor_height": floor}
    fall = simulator.rollout(state, steps=60, parameters=parameters)  # short: 60 -> 30
    return fall.q[-1, 0, :, 2].mean()


values = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (1e5, -0.02)]
rebound(*values).backward()
worst = 0.0
for number, step in enumerate((1.0, 1e-7)):
    with torch.no_grad():
        moved = [
            [v + sign * step * (k == number) for k, v in enumerate(values)] for sign in (1.0, -1.0)
        ]
        difference = (rebound(*moved[0]) - rebound(*moved[1])).item() / (2.0 * step)
    adjoint = values[number].grad.item()
    worst = max(worst, abs(adjoint / difference - 1.0))
    name = list(simulator.parameters)[-3:-1][number]
    print(f"{name}: adjoint {adjoint:.9e}, differences {difference:.9e}")

# %% [markdown]
# ## An elastic string
#
# The argument of this energy is the vector from one vertex to another: a spring along a diagonal of
# the block. With stiffness $k$ and length $L$ it has the energy $\tfrac{k}{2} (|x| - L)^2$. With
# `per`, every spring has its own values.


# %%
@wp.func
def spring_energy(x: wp.vec3d, values: wp.vec2d) -> wp.float64:
    longer = wp.length(x) - values[1]
    return wp.float64(0.5) * values[0] * longer * longer


@dataclass(frozen=True)
class Spring(PointwiseEnergy):
    """Springs between pairs of vertices."""

    density: ClassVar = spring_energy
    size: ClassVar = 0.01
    pairs: np.ndarray  # (S, 2)
    stiffness: float = parameter(20.0, "spring_stiffness", "N/m", per="spring")  # k
    length: float = parameter(0.05, "spring_length", "m", per="spring")  # L

    @property
    def count(self):
        return len(self.pairs)

    def points(self, mesh):
        return (between(self.pairs, part=np.arange(self.count)),)


ends = np.array([[bottom[0], top[-1]]])  # a diagonal of the block, which is 69 mm long
tied = Body(mesh, fixed=bottom, energies=[Spring(ends, stiffness=20.0, length=0.05)])
pulled = Simulator(tied, silicone).static_equilibrium().q[0]
length = np.linalg.norm(pulled[ends[0, 0]] - pulled[ends[0, 1]])
print(f"the spring is {1e3 * length:.2f} mm long and pulls with {20.0 * (length - 0.05):.3f} N")

# %% [markdown]
# ## Use in an experiment
#
# [Your own physics](../extending.md) shows how a package of yours gives this energy a name in
# configurations, so that its parameters can be identified by name. For speed, kernels can be
# written by hand, as for pressure.

# %%
assert abs(carried / weight - 1) < 1e-3
assert worst < 1e-5
