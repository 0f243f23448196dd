# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Bring your robot: a tentacle
#
# A tapered silicone rod hangs from its base, pulled by two tendons. It was recorded at rest, in one
# pose after another, with markers without names. The mesh is generated from the rod's dimensions.
# `experiment=tentacle` is the configuration of a real one. [Your robot](../bring_your_robot.md)
# explains the steps.
#
# ## Poses
#
# A simulation stands in for the robot. It is stiffer than the data sheet's rod and has a finer
# mesh, and its first tendon is displaced by a millimetre from the drawing, as is typical of a real
# robot.

# %%
import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp

import warp_resphys
from warp_resphys import Body, Inputs, Simulator, StableNeoHookean, Tendons, rod, select_vertices
from warp_resphys.data.markers import bind_markers

wp.config.log_level = wp.LOG_WARNING
random = np.random.default_rng(5)

length, radii = 0.2, [[0.0, 0.010], [0.2, 0.006]]  # m: arc lengths and the radii there
routes = {  # m, from the base to the tip
    "first": [[0.0030, 0.0060, 0.0], [0.0018, 0.0036, -length]],
    "second": [[0.0030, -0.0060, 0.0], [0.0018, -0.0036, -length]],
}
tensions = {  # N
    "first_low": [0.4, 0.0], "first_middle": [0.8, 0.0], "first_high": [1.2, 0.0],
    "second_low": [0.0, 0.4], "second_middle": [0.0, 0.8], "second_high": [0.0, 1.2],
    "both_low": [0.4, 0.4], "both_high": [0.9, 0.9], "mixed": [0.5, 1.0],
}  # fmt: skip
test = ["first_middle", "second_middle", "mixed"]
tracked = {  # m, on clips
    "Low": [0.0, 0.016, -0.08],
    "Middle": [0.0, -0.014, -0.14],
    "Tip": [0.0, 0.0, -0.208],
}
reference = {"Base": [0.03, 0.0, 0.005]}

mesh = rod([[0.0, 0.0, 0.0], [0.0, 0.0, -length]], radii, layers=14)  # short: 14 -> 7
along = np.linspace(0.0, 1.0, 21)[:, None]
paths = {
    name: (1 - along) * np.array(start) + along * np.array(end)
    for name, (start, end) in routes.items()
}
paths["first"] += [0.001, 0.0, 0.0]  # unknown to the simulator
body = Body(mesh, select_vertices(mesh, z=0.0), energies=[Tendons(paths)])
laboratory = Simulator(body, StableNeoHookean(310e3, 0.48, density=1120.0))
pulled = torch.tensor(list(tensions.values()), dtype=torch.float64)  # (B, 2) N
poses = laboratory.static_equilibrium(Inputs(tendon_tension=pulled), batch=len(pulled)).q

clips = bind_markers(
    mesh, np.array(list(tracked.values())), list(tracked), kind="patch", patch=0.02
)
seen = clips(poses).numpy()  # (B, 3, 3) m
Path("poses").mkdir()
for name, markers in zip(tensions, seen, strict=True):
    places = np.concatenate([markers, np.array(list(reference.values()))])
    places = places[random.permutation(len(places))]  # in random order
    turned = places[:, [0, 2, 1]] * [1.0, -1.0, 1.0]  # y of the cameras is down
    frames = np.broadcast_to(turned, (10, len(places), 3))
    frames = frames + 2e-4 * random.standard_normal(frames.shape)
    table = np.column_stack([0.01 * np.arange(10), frames.reshape(10, -1)])
    np.savetxt(f"poses/{name}.csv", table, "%.6f", ",")
print(Path("poses/mixed.csv").read_text().splitlines()[0])

figure, axes = plt.subplots(1, 2, figsize=(7, 3.2), layout="constrained", sharey=True)
line = select_vertices(mesh, x=0.0, y=0.0)
line = line[np.argsort(-mesh.vertices[line, 2])]
for name, q in zip(tensions, poses.numpy(), strict=True):
    style = "--" if name in test else "-"
    for axis, column in zip(axes, (0, 1), strict=True):
        axis.plot(1e3 * q[line, column], 1e3 * q[line, 2], style, label=name)
axes[0].set(xlabel="x [mm]", ylabel="z [mm]", aspect="equal")
axes[1].set(xlabel="y [mm]", aspect="equal")
figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper", frameon=False)
plt.show()

# %% [markdown]
# ## The configuration
#
# - **mesh** is generated from the rod's dimensions.
# - **table** names the columns of files without a header; markers that are **assigned** by position
#   may have any names. **axes** gives the orientation of the rod in the frame of the cameras, so
#   that one fixed marker is enough.
# - The tendons' offsets across the axis, about a millimetre, are **identified** with Young's
#   modulus.
# - **placement**: the positions of the clips are known to two millimetres.

# %%
Path("configs/experiment").mkdir(parents=True)
trials = {name: {"file": f"{name}.csv", "inputs": pull} for name, pull in tensions.items()}
offset = "{lower: -2.0e-3, upper: 2.0e-3, prior: {mean: 0.0, deviation: 1.0e-3}}"
Path("configs/experiment/my_tentacle.yaml").write_text(f"""# @package _global_
defaults:
  - /recordings: poses
  - override /mesh: rod
  - _self_
name: my_tentacle
title: My tentacle
mesh:
  centreline: [[0.0, 0.0, 0.0], [0.0, 0.0, {-length}]]  # m
  radii: {radii}
  layers: 10  # short: 10 -> 5
fixed: {{z: 0.0}}
tip: {{z: {-length}, tolerance: 1.0e-6}}
tendons:
  commanded: tension
  stiffness: 0.0
  routes:
    first:
      guides: {routes["first"]}
      pieces: 20
      offsets: [[[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]
    second:
      guides: {routes["second"]}
      pieces: 20
      offsets: [[[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]
simulation: {{youngs_modulus: 250.0e3, poissons_ratio: 0.45, density: 1070.0}}  # the data sheet
data:
  folder: poses
  units: m
  table: {{columns: ["time [s]", a.x, a.y, a.z, b.x, b.y, b.z, c.x, c.y, c.z, d.x, d.y, d.z]}}
  axes: [x, z, -y]
  input_limit: 2.0  # N
  trials: {json.dumps(trials)}
  train: {json.dumps([name for name in tensions if name not in test])}
  test: {json.dumps(test)}
markers:
  labels: assigned
  tracked: {json.dumps(tracked)}
  reference: {json.dumps(reference)}
  bind: patch
  largest_distance: 0.03
reconstruction: {{regularisation: 1.0}}
identify:
  parameters:
    poissons_ratio: null
    tendon_offset_1_first: {offset}  # m
    tendon_offset_1_second: {offset}
  placement: {{markers: 0.002, shift: 0.002, turn: 1.0}}  # m, m, degrees
""")


def command(*arguments):
    """Runs `warp-resphys` with arguments, and gives what it printed."""
    given = [*arguments]  # short: ts] -> ts, "parallel.processes=1"]
    line = [sys.executable, "-m", "warp_resphys", *given]
    ended = subprocess.run(line, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-2000:]
    return ended.stdout


options = ["budget=quick", "data.limit=null"]  # short: l" -> l", "reconstruction=none"
print(command("experiment=my_tentacle", *options))

# %% [markdown]
# ## Results

# %%
run = Path(next(Path("runs/my_tentacle").iterdir()))
errors = json.loads((run / "metrics.json").read_text())["errors_mm"]
identified = json.loads((run / "identification.json").read_text())["sysid"]
for name, error in errors.items():
    print(f"{name:14s} {error['mean']:6.2f} mm")
for name, value in identified["parameters"].items():
    print(f"{name:24s} {value:10.4g}")

# %% [markdown]
# Six poses of three markers determine the stiffness and the tendons' offsets; that of the first
# tendon is close to the true millimetre. The remaining error is little more than the noise, so no
# learned force was kept. `simfree`, a network that replaces the simulator, has larger errors
# because it contains no physics.
#
# ## Application
#
# The identified tentacle, loaded in one line, computes the reachable positions of the tip:
# thirty-six poses in a batch.

# %%
robot = warp_resphys.load(run, model="sysid")
first, second = np.meshgrid(np.linspace(0.0, 1.2, 6), np.linspace(0.0, 1.2, 6))
pairs = np.column_stack([first.ravel(), second.ravel()])  # (36, 2) N
settled = robot.settle(batch=len(pairs), tendon_tension=pairs)
tips = 1e3 * robot.observe(settled)[:, list(robot.labels).index("Tip")].numpy()  # (36, 3) mm

figure, axis = plt.subplots(figsize=(5, 3.6), layout="constrained")
points = axis.scatter(tips[:, 0], tips[:, 1], c=tips[:, 2])
axis.set(xlabel="x of the tip [mm]", ylabel="y of the tip [mm]", aspect="equal")
figure.colorbar(points, label="z of the tip [mm]")
plt.show()

# %% [markdown]
# Here the robot is a simulation, so that this prediction can be checked.

# %%
pulled = Inputs(tendon_tension=torch.tensor(pairs))
asked = laboratory.static_equilibrium(pulled, batch=len(pairs)).q
off = np.linalg.norm(1e3 * clips(asked)[:, -1].numpy() - tips, axis=1)
print(
    f"the tip is {off.mean():.2f} mm off on average over {np.ptp(tips[:, 0]):.0f} x "
    f"{np.ptp(tips[:, 1]):.0f} mm"
)

# %%
assert errors["sysid"]["mean"] < 0.2 * errors["simulation"]["mean"]
assert abs(identified["parameters"]["tendon_offset_1_first"] - 1e-3) < 3e-4
assert abs(identified["parameters"]["tendon_offset_1_second"]) < 3e-4
assert off.mean() < 1.0
