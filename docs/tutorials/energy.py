# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Write your own energy
#
# Materials, pressure, fibres, tendons, muscles and water are energies. A new one is a class with its points and three
# Warp kernels; solver, adjoint, tape and identification take it as they take the others, and know no energy by name.
# This page writes a floor that a block falls on.
#
# ## The equation
#
# A vertex that is $d = z_0 - z > 0$ below the floor's height $z_0$ has the energy
#
# $$ e = \tfrac{k}{3} d^3, \qquad \text{a force } k d^2 \text{ upwards}, \qquad \text{a stiffness } 2 k d, $$
#
# which is twice differentiable where contact begins, so that Newton steps and gradients do not see a corner. Its
# parameters are $k$ [N/m²] and $z_0$ [m].
#
# ## Points
#
# Every energy of this package is a function of a matrix at points, $F_p = \sum_a x_a g_{pa}^\top$: in a solid, $g$ are
# gradients of shape functions and $F$ is the deformation gradient; along a fibre only the first column of $F$ is used.
# With one node a point and $g = (1, 0, 0)$, the first column is the position of a vertex. That is all a floor needs.
#
# ## Kernels
#
# *stress* writes the derivative of the energy by $F$, and the energy; *tangent* writes the second derivative, in six
# blocks of pairs of columns, of which here only the first is not zero; *adjoint* gets $z = H^{-1}\,dL/dx$ from the
# solver, and writes $z \cdot \partial(\text{force})/\partial(\text{parameter})$, a number for each parameter.

# %%
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp

from warp_resphys import Body, Corotated, Simulator, State, box_hexahedra, select_vertices
from warp_resphys.energies.base import Energy, PartTerm
from warp_resphys.energies.launcher import warp_view
from warp_resphys.fem.elements import Points
from warp_resphys.kernels.points import line_at
from warp_resphys.stepping.quantity import Quantity

wp.config.log_level = wp.LOG_WARNING

ZERO, TWO, THREE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(2.0)), wp.constant(wp.float64(3.0))


@wp.kernel(enable_backward=False)
def floor_stress(
    nodes: wp.array2d[int],  # (C, K) vertex of each node
    operators: wp.array2d[wp.vec3d],  # (P, K) g
    stiffness: wp.array2d[wp.float64],  # (B, 1) k
    height: wp.array2d[wp.float64],  # (B, 1) z_0
    points_per_cell: int,
    positions: wp.array2d[wp.vec3d],  # (B, N)
    stress_out: wp.array2d[wp.mat33d],  # (B, P)
    energy_out: wp.array2d[wp.float64],
):
    b, p = wp.tid()
    x = line_at(positions, nodes, operators, b, p, p / points_per_cell)
    depth = wp.max(height[b, 0] - x[2], ZERO)
    force = stiffness[b, 0] * depth * depth
    stress_out[b, p] = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, -force, ZERO, ZERO)  # d(energy)/dz is -force
    energy_out[b, p] = force * depth / THREE


@wp.kernel(enable_backward=False)
def floor_tangent(
    nodes: wp.array2d[int],
    operators: wp.array2d[wp.vec3d],
    stiffness: wp.array2d[wp.float64],
    height: wp.array2d[wp.float64],
    points_per_cell: int,
    positions: wp.array2d[wp.vec3d],
    positive: wp.array[int],  # (B) 1: leave out what is negative, which is never here
    tangent_out: wp.array3d[wp.mat33d],  # (B, P, 6)
):
    b, p = wp.tid()
    x = line_at(positions, nodes, operators, b, p, p / points_per_cell)
    slope = TWO * stiffness[b, 0] * wp.max(height[b, 0] - x[2], ZERO)
    nothing = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)
    for block in range(6):
        tangent_out[b, p, block] = nothing
    tangent_out[b, p, 0] = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, slope)


@wp.kernel(enable_backward=False)
def floor_adjoint(
    nodes: wp.array2d[int],
    operators: wp.array2d[wp.vec3d],
    stiffness: wp.array2d[wp.float64],
    height: wp.array2d[wp.float64],
    points_per_cell: int,
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],  # (B, N) z
    by_parameter_out: wp.array3d[wp.float64],  # (B, P, 2)
):
    b, p = wp.tid()
    x = line_at(positions, nodes, operators, b, p, p / points_per_cell)
    z = line_at(direction, nodes, operators, b, p, p / points_per_cell)
    depth = wp.max(height[b, 0] - x[2], ZERO)
    by_parameter_out[b, p, 0] = z[2] * depth * depth  # by k: the energy's derivative by z is -k d^2
    by_parameter_out[b, p, 1] = z[2] * TWO * stiffness[b, 0] * depth  # by z_0


# %% [markdown]
# ## The energy
#
# `Energy` lives on the host and is part of a body: what its parameters are called, their units and ranges, which are
# checked for whoever gives them, and its points. `term` makes the part that has a batch: kernels and their arguments.


# %%
@dataclass(frozen=True)
class Floor(Energy):
    """A floor that pushes vertices up."""

    parameters: ClassVar[tuple[Quantity, ...]] = (
        Quantity("floor_stiffness", "N/m^2", 0.0, closed=True),  # zero or more
        Quantity("floor_height", "m", typical=0.01),  # any
    )
    vertices: np.ndarray  # those that may touch it
    stiffness: float  # k [N/m^2]
    height: float  # z_0 [m]

    @property
    def constants(self) -> Mapping[str, float]:
        return {"floor_stiffness": self.stiffness, "floor_height": self.height}

    def points(self, mesh):
        """One point at each vertex."""
        operators = np.zeros((len(self.vertices), 1, 1, 3))  # (C, Q, K, 3)
        operators[..., 0] = 1.0
        return (Points(np.asarray(self.vertices)[:, None], operators),)

    def term(self, launcher, sets):
        return FloorTerm(launcher, sets, self)


class FloorTerm(PartTerm):
    """Its kernels, for a batch; `PartTerm` because there are values for parts, of which a floor has one."""

    def __init__(self, launcher, sets: Sequence, floor: Floor) -> None:
        (s,) = sets
        super().__init__(
            launcher, sets, "floor_stiffness", np.zeros(s.n_points, dtype=np.int64), np.ones(s.n_points), floor.count
        )

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Of what a step needs to know."""
        return {"floor_stiffness": (1,), "floor_height": (1,)}

    def arguments(self, s, values, positions):
        return [s.nodes, s.gradients, *self.views(values), s.points_per_cell, positions]

    def step(self, s, values, positions):
        return floor_stress, self.arguments(s, values, positions)

    def tangent(self, s, values, positions, positive):
        return floor_tangent, [*self.arguments(s, values, positions), positive]

    def curvature(self, values) -> torch.Tensor:
        """(B, P) how stiff a point is at most, for small motions: here, a millimetre below the floor."""
        return values["floor_stiffness"] * 2e-3 * torch.ones_like(self.weight)

    def adjoint(self, values, positions, direction) -> Callable[[], dict[str, torch.Tensor]]:
        """Records the launch; what it returns makes it, and sums over the points."""
        own, (s,) = self.launcher, self.sets
        out = own.zeros(self.n_points, 2)
        at, z = (warp_view(each, wp.vec3d) for each in (positions, direction))
        inputs = [*self.arguments(s, values, at), z]
        command = own.record(floor_adjoint, (own.batch, s.n_points), inputs, [warp_view(out, wp.float64)])

        def differentiate() -> dict[str, torch.Tensor]:
            own.launch(command)
            return {name: self.sum_parts(part) for name, part in zip(self.shapes, out.unbind(-1), strict=True)}

        return differentiate


# %% [markdown]
# ## A block that is dropped

# %%
mesh = box_hexahedra(size=(0.04, 0.04, 0.04), divisions=(4, 4, 4))  # m
bottom, top = select_vertices(mesh, z=0.0), select_vertices(mesh, z=0.04)
body = Body(mesh, energies=[Floor(bottom, stiffness=1e5, height=-0.02)])
silicone = Corotated(youngs_modulus=50e3, poissons_ratio=0.45, density=1070.0, stiffness_damping=2e-3)
simulator = Simulator(body, silicone, time_step=0.002, integrator="bdf2", relative_tolerance=1e-9)
print("parameters:", ", ".join(simulator.parameters))

fall = simulator.rollout(simulator.rest_state(), steps=1000)
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
# When it has come to rest, the floor must carry its weight, whatever the kernels say in between.

# %%
depth = (-0.02 - height[-1, bottom]).clamp_min(0.0)
carried, weight = (1e5 * depth**2).sum().item(), 1070.0 * 0.04**3 * 9.80709
print(f"carried {carried:.4f} N, weight {weight:.4f} N")

# %% [markdown]
# ## Its gradients
#
# How high the block is after the first rebound, by both parameters of the floor, against central differences. This is
# the test that every new energy should have.

# %%
state = simulator.rest_state()
state = State(state.q - torch.tensor([0.0, 0.0, 0.018], dtype=torch.float64), state.v)  # it falls 2 mm


def rebound(stiffness, floor):
    parameters = {"floor_stiffness": stiffness, "floor_height": floor}
    return simulator.rollout(state, steps=60, parameters=parameters).q[-1, 0, :, 2].mean()


values = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (1e5, -0.02)]
rebound(*values).backward()
worst = 0.0
for number, step in enumerate((1.0, 1e-7)):
    with torch.no_grad():
        moved = [[v + sign * step * (k == number) for k, v in enumerate(values)] for sign in (1.0, -1.0)]
        difference = (rebound(*moved[0]) - rebound(*moved[1])).item() / (2.0 * step)
    adjoint = values[number].grad.item()
    worst = max(worst, abs(adjoint / difference - 1.0))
    print(f"{list(simulator.parameters)[-3:-1][number]}: adjoint {adjoint:.9e}, differences {difference:.9e}")

# %% [markdown]
# ## From here to an experiment
#
# In `warp_resphys`, an energy's class lies in `warp_resphys/energies`, its kernels in `kernels`, and
# `warp_resphys/experiment/actuators.py` says how a configuration asks for it; its parameters can then be identified by
# name ([contributing](../contributing.md)).

# %%
assert abs(carried / weight - 1) < 1e-3
assert worst < 1e-5
