# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Distance, stiffness and slip speed of contact
#
# [Contact](../contact.md) has three constants that are not in any data sheet: the distance at which
# it begins, the stiffness of its barrier, and the speed at which friction is fully developed. This
# page shows the effects of bad values, and how to choose good ones.
#
# ## Distance: the gap is a thickness

# %%
import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp
from matplotlib.collections import PolyCollection

from warp_resphys import (
    Body,
    Contact,
    Corotated,
    Cylinder,
    HalfSpace,
    Simulator,
    box_hexahedra,
    select_vertices,
)

wp.config.log_level = wp.LOG_WARNING
silicone = Corotated(2e5, 0.45, density=1070.0, stiffness_damping=0.02)


def beam_on_bar(bar, divisions=(16, 1, 2), distance=5e-4):
    """A beam that hangs from its left end on a bar, at rest, and its mesh."""
    mesh = box_hexahedra((0.12, 0.02, 0.012), divisions)
    contact = Contact({"bar": bar}, stiffness=2e5, distance=distance)
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0), energies=[contact])
    simulator = Simulator(body, silicone, time_step=0.01, integrator="implicit_euler")
    with torch.no_grad():
        motion = simulator.rollout(simulator.rest_state(), 80)  # short: 80 -> 20
    return mesh, motion.q[-1, 0].numpy()


def side_view(ax, mesh, q, bar, title):
    """Draws the cells of the front side, and the bar."""
    faces = mesh.cells[:, [0, 1, 5, 4]]  # of bricks, at the smallest y
    front = faces[mesh.vertices[faces][..., 1].max(1) < 1e-9]
    corners = 1e3 * q[front][..., [0, 2]]
    ax.add_collection(PolyCollection(corners, facecolor="0.85", edgecolor="0.4", linewidth=0.6))
    centre = (1e3 * bar.position[0], 1e3 * bar.position[2])
    ax.add_patch(plt.Circle(centre, 1e3 * bar.radius, color="tab:orange"))
    ax.set(xlim=(55, 125), ylim=(-45, 15), aspect="equal", title=title)
    ax.axis("off")


bar = Cylinder(position=(0.09, 0.01, -0.02), axis=(0.0, 1.0, 0.0), radius=0.008, length=0.06)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
for ax, distance in zip(axes, (5e-4, 6e-3), strict=True):
    mesh, q = beam_on_bar(bar, distance=distance)
    side_view(ax, mesh, q, bar, f"distance {1e3 * distance:g} mm")
figure.tight_layout()

# %% [markdown]
# On the right, the bar is in effect some millimetres thicker. Choose a hundredth to a tenth of the
# smallest length that matters.
#
# ## Only vertices touch obstacles
#
# A thin bar between two vertices sinks into the body, by up to s² / 8 R for a spacing s and a
# radius R, or through it:

# %%
thin = Cylinder(position=(0.0865, 0.01, -0.02), axis=(0.0, 1.0, 0.0), radius=0.0015, length=0.06)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
meshes = ((8, 1, 2), (48, 1, 2))  # short: (48, 1, 2) -> (16, 1, 2)
for ax, divisions in zip(axes, meshes, strict=True):
    mesh, q = beam_on_bar(thin, divisions)
    side_view(ax, mesh, q, thin, f"vertices every {120 / divisions[0]:g} mm")
figure.tight_layout()

# %% [markdown]
# Refine the mesh along the body until the spacing of its vertices is less than the width of the
# obstacle, or make the obstacle a body of its own: contact of
# [surfaces](../contact.md#bodies-and-themselves) includes edges and triangles.
#
# ## Stiffness: the remaining gap
#
# A block of 20 mm rests on a floor under increasing load. The remaining gap follows from the ratio
# of pressure to stiffness: a soft barrier yields like a layer of the body, and a stiff one makes
# impacts sudden.

# %%
cube = box_hexahedra((0.02, 0.02, 0.02), (2, 2, 2))  # short: (2, 2, 2) -> (1, 1, 1)
block = Corotated(2e6, 0.4, density=1070.0, stiffness_damping=2e-3)
D = 1e-3  # m
loads = np.array([1.0, 3.0, 10.0, 30.0, 100.0])  # short: 3.0, 10.0, 30.0, 100.0 -> 100.0
figure, ax = plt.subplots(figsize=(5.5, 3.4))
for stiffness in (1e4, 1e5, 1e6):  # short: 1e5, 1e6 -> 1e6
    gaps = []
    for load in loads:
        floor = Contact(
            {"floor": HalfSpace(position=(0.0, 0.0, -0.9 * D))}, stiffness=stiffness, distance=D
        )
        simulator = Simulator(
            Body(cube, energies=[floor]), block, time_step=0.01, gravity=(0.0, 0.0, -9.81 * load)
        )
        with torch.no_grad():
            end = simulator.rollout(simulator.rest_state(), 60).q[-1, 0, :, 2]
        gaps.append(float(end.min()) + 0.9 * D)
    assert np.all(np.diff(gaps) < 0.0)
    assert 0.0 < gaps[-1] < gaps[0] < D
    ax.semilogx(loads, 1e3 * np.array(gaps), "o-", label=f"stiffness {stiffness:.0e} Pa")
ax.set(xlabel="load over the block's weight", ylabel="gap [mm]", ylim=(0.0, 1e3 * D))
ax.legend()
figure.tight_layout()

# %% [markdown]
# The block never passes through the floor, whatever the stiffness. Begin with Young's modulus of
# the body.
#
# ## Slip speed: sticking bodies creep
#
# A block lies on a slope of 15 degrees, with a coefficient of friction of 0.4 that should hold it.
# Below the slip speed, friction grows with the sliding speed, so that the block creeps at a
# fraction of the slip speed. A smaller slip speed costs some iterations where bodies begin to
# slide.

# %%
a, creeps = np.radians(15.0), []
slip_speeds = np.array([1e-4, 1e-3, 1e-2, 1e-1])  # short: [1e-4, 1e-3, 1e-2, 1e-1] -> [1e-2]
print("slip speed  creep      iterations of a thrown block's step, most")
for slip_speed in slip_speeds:
    floor = Contact({"floor": HalfSpace(position=(0.0, 0.0, -9.5e-4))}, 1e5, 0.4, D, slip_speed)
    pull = (9.81 * np.sin(a), 0.0, -9.81 * np.cos(a))
    simulator = Simulator(Body(cube, energies=[floor]), block, time_step=0.01, gravity=pull)
    with torch.no_grad():
        creep = float(simulator.rollout(simulator.rest_state(), 60).v[-1, 0, :, 0].mean())
        start = simulator.rest_state()
        start.v[..., 0], start.v[..., 2] = 1.0, -1.0
        thrown = simulator.rollout(start, 30)
    most = max(int(report.iterations.max()) for report in thrown.reports)
    creeps.append(creep)
    print(f"{1e3 * slip_speed:6g} mm/s {1e3 * creep:6.3g} mm/s {most:10d}")
assert np.allclose(creeps, slip_speeds * (1.0 - np.sqrt(1.0 - np.tan(a) / 0.4)), rtol=0.02)

# %% [markdown]
# Choose a few per cent of the speeds at which bodies slide, and check that sticking bodies do not
# creep too far during a trial.
