# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A pneumatic finger: angle, blocked force, work
#
# Two curves describe a finger of a gripper: its bending angle in free air, and its blocked force,
# with which it pushes when its tip cannot move. This finger is a silicone box with a chamber, 80 mm
# long, on a layer that hardly stretches. Threads are wound around the chamber, so that pressure
# bends the finger rather than swells it. [Reactions](../simulator.md) are the forces that hold it.

# %%
import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp

from warp_resphys import (
    Body,
    Corotated,
    Fibres,
    Inputs,
    Mesh,
    Pressure,
    Simulator,
    box_hexahedra,
    select_vertices,
    silicone,
)
from warp_resphys.mesh import find_chambers

wp.config.log_level = wp.LOG_WARNING  # no message for each loaded kernel
LENGTH, WIDTH, HEIGHT, END, LAYER = 0.08, 0.016, 0.014, 0.006, 0.001  # m


def finger(roof=0.0025, side=0.0025):
    """The mesh of a finger along x, with thicknesses of the roof and the sides [m]."""
    x = np.r_[0.0, np.linspace(END, LENGTH - END, 7), LENGTH]  # short: 7 -> 2
    y = np.r_[0.0, np.linspace(side, WIDTH - side, 3), WIDTH]  # short: 3 -> 2
    z = np.r_[0.0, LAYER, 0.0035, HEIGHT - roof, HEIGHT]
    counts = [len(planes) - 1 for planes in (x, y, z)]
    box = box_hexahedra(counts, counts, nodes=20)  # cells of unit size
    vertices = np.stack(
        [np.interp(box.vertices[:, k], np.arange(len(p)), p) for k, p in enumerate((x, y, z))],
        axis=1,
    )
    column, row, level = np.indices(counts).reshape(3, -1)
    inside = (
        (column > 0) & (column < counts[0] - 1) & (row > 0) & (row < counts[1] - 1) & (level == 2)
    )
    used, cells = np.unique(box.cells[~inside], return_inverse=True)
    layer = np.flatnonzero(level[~inside] == 0)
    rubber = np.setdiff1d(np.arange(len(layer) + (level[~inside] > 0).sum()), layer)
    regions = {"layer": layer, "rubber": rubber}
    return Mesh(vertices[used], cells.reshape(-1, 20), regions)


mesh = finger()
base, tip = select_vertices(mesh, x=0.0), select_vertices(mesh, x=LENGTH)
materials = {"rubber": silicone("Dragon Skin 20"), "layer": Corotated(3e6, 0.45, density=1070.0)}


def simulated(mesh, *held):
    """A simulator of the finger, held at its base and further vertices."""
    chambers = find_chambers(mesh)
    threads = Fibres(chambers, (4.0, -4.0), stiffness=2e4)  # degrees; N/m
    body = Body(mesh, fixed=np.concatenate([base, *held]), energies=[Pressure(chambers), threads])
    return Simulator(body, materials, gravity=(0.0, 0.0, 0.0), relative_tolerance=1e-8)


free = simulated(mesh)
print(mesh)

# %% [markdown]
# ## Bending angle
#
# Pressures are environments of one batch. The angle is that of the tip face, from the mean
# displacements of its upper and lower half.

# %%
pressures = torch.linspace(0.0, 60e3, 5, dtype=torch.float64)  # Pa  # short: 5 -> 3
pressures = pressures[:, None].requires_grad_()  # (B, 1)
bent = free.static_equilibrium(Inputs(pressure=pressures))
heights = mesh.vertices[tip, 2] - mesh.vertices[tip, 2].mean()


def angle_of(q):
    """Rotation (B,) of the tip face about -y, towards the layer [rad]."""
    across = (q[:, tip] * torch.as_tensor(heights)[:, None]).sum(1)
    return torch.atan2(across[:, 0], across[:, 2])


angles = angle_of(bent.q)
# The derivative of every environment [rad/Pa].
(slopes,) = torch.autograd.grad(angles.sum(), pressures, retain_graph=True)
rows = torch.stack([pressures[:, 0], angles, slopes[:, 0]], dim=1).tolist()
for p, angle, slope in rows:
    more = np.degrees(slope) * 1e3
    print(f"{p / 1e3:4.0f} kPa: {np.degrees(angle):5.1f} degrees, and {more:.2f} per kPa more")

# %% [markdown]
# ## Blocked force
#
# The lower edge of the tip rests on a load cell, in the pose that it has in free air under some
# pressure, and the pressure is raised. At the pressure of the pose the edge carries nothing; above
# it, the reaction at its vertices is what the finger pushes with. The load cell measures what is
# perpendicular to the layer at the tip.

# %%
edge = select_vertices(mesh, x=LENGTH, z=0.0)
held = simulated(mesh, edge)


def push(pose, pressure):
    """Force on the load cell (B,) [N], with the edge held in poses (B, N, 3), under pressures."""
    inputs = Inputs(pressure=pressure, fixed_positions=pose[:, held.fixed])
    balance = held.static_equilibrium(inputs, start=pose)
    angle = angle_of(pose)
    pushed = torch.stack([-angle.sin(), torch.zeros_like(angle), -angle.cos()], dim=1)
    return -(held.reaction(balance, at=edge).force * pushed).sum(1)


curves = {}
for k in (0, 1, 2):  # poses of free air  # short: , 2) -> )
    above = pressures[k:].detach().clone().requires_grad_()
    strength = push(bent.q[k].detach().expand(len(above), -1, -1), above)
    degrees = float(np.degrees(angles[k].item()))
    curves[degrees] = (above.detach()[:, 0].numpy(), strength.detach().numpy())
    # In free air, the edge is where it wants to be.
    assert abs(strength[0].item()) < 1e-3 * strength[-1].item()
    if k == 0:
        (gain,) = torch.autograd.grad(strength.sum(), above)
        more = gain[-1].item() * 1e6
        print(f"straight, at 60 kPa: {strength[-1].item():.2f} N, and {more:.0f} mN per kPa more")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.2), layout="constrained")
left.plot(pressures.detach()[:, 0].numpy() / 1e3, np.degrees(angles.detach().numpy()), marker=".")
left.set(xlabel="pressure [kPa]", ylabel="angle in free air [degrees]")
for angle, (p, strength) in curves.items():
    right.plot(p / 1e3, strength, marker=".", label=f"at {angle:.0f} degrees")
right.set(xlabel="pressure [kPa]", ylabel="blocked force [N]")
right.legend()
plt.show()

# %% [markdown]
# ## Thickness of the roof
#
# A thinner roof bends more and pushes less, or more? A body has the thickness of its mesh, so that
# its derivative is the difference of two meshes of the same topology.

# %%
strength, bend = [], []
for roof in (0.0024, 0.0026):
    mesh_of = finger(roof)
    loose, stopped = simulated(mesh_of), simulated(mesh_of, edge)
    p = torch.tensor([[40e3]], dtype=torch.float64)
    bend.append(np.degrees(angle_of(loose.static_equilibrium(Inputs(pressure=p)).q).item()))
    reaction = stopped.reaction(stopped.static_equilibrium(Inputs(pressure=p)), at=edge)
    strength.append(reaction.force[0, 2].item())
print(
    f"per 0.1 mm of roof at 40 kPa: {(bend[1] - bend[0]) / 2:+.2f} degrees, "
    f"{(strength[1] - strength[0]) / 2:+.4f} N"
)

# %% [markdown]
# ## Work and efficiency
#
# A chamber gives the work $\int p\, dV$. Here the tip lifts a weight that hangs on it, from where
# it hangs without pressure; what the weight gains is $m g h$.

# %%
mass, gravity = 0.02, 9.81  # kg, m/s^2
pull = torch.zeros(1, len(mesh.vertices), 3, dtype=torch.float64)
# The finger bends towards -z, so that it lifts a weight that pulls along z.
pull[0, tip, 2] = mass * gravity / len(tip)
energy, _ = free.body.energies
ramp = torch.linspace(0.0, 60e3, 5, dtype=torch.float64)[:, None]
loaded = free.static_equilibrium(Inputs(pressure=ramp, external_force=pull.expand(5, -1, -1)))
volume = energy.volumes(mesh, loaded.q)[:, 0]
given = torch.trapezoid(ramp[:, 0], volume).item()
lift = (loaded.q[0, tip, 2] - loaded.q[-1, tip, 2]).mean().item()
gained = mass * gravity * lift
print(
    f"{1e3 * given:.2f} mJ of the air lift {1e3 * mass:.0f} g by {1e3 * lift:.1f} mm: "
    f"{1e3 * gained:.2f} mJ"
)
print(f"efficiency {gained / given:.0%}; the rest is in the rubber, until the pressure is released")
assert 0.0 < gained < given
