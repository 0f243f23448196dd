# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Control
#
# A corrected simulator can be used for planning. Here the tip of a hanging rod, pulled by three
# tendons, draws a circle. The tensions are planned once with the data sheet's parameters and once
# with parameters identified from recordings. Another simulation, with a finer mesh and another
# material, stands in for the robot and executes both. [The guide](../control.md) describes the
# stages. This page runs all of them at a size that takes a minute or two, and then plays a plan
# from Python.
#
# ## The experiment
#
# `experiment=` selects a configuration in `configs/experiment` of the working directory. This one
# is based on `tendon_rod_control` and reduces everything: coarse meshes, six recordings of 0.6 s, a
# small network, and one circle.

# %%
import csv
import json
import subprocess
import sys
from pathlib import Path

import h5py
import matplotlib.pyplot as plt
import numpy as np

import warp_resphys

Path("configs/experiment").mkdir(parents=True)
Path("configs/experiment/drawing.yaml").write_text("""# @package _global_
defaults:
  - tendon_rod_control
  - _self_  # short: _self_ -> override /reconstruction: none
name: drawing
title: A rod draws a circle  # short: title: A rod draws a circle -> parallel: {processes: 1}
mesh: {layers: 3, nodes: 20}
laboratory:
  mesh: {layers: 4, nodes: 20}
  sequences: {rest: 0.01, correlation_time: 0.06}
actuation: {filter_time_constants: [0.1]}
data:
  {sequences: 6, steps: 60, train: 4, validation: 1, test: 1, horizons: [], rest_seconds: 0.01,
    cutoff: 20.0}
identify: {trials: 4, seconds: 0.6, max_evaluations: 12}
network: {position_modes: 2, velocity_modes: 2, force_modes: 2, width: 16}
trainer: {epochs: 4, rollout_every: 2, batch_size: 16}
timing: false
control:
  models: [simulation, sysid]
  receding: [sysid]
  shapes: [circle]
  seconds: [1.5]
  size: 0.03  # m
  plan: {corrections: 2, reach: 0.05}
  horizon: 0.1
  feedback: {gains: [5.0], settles: 0.3}
  reduction: {modes: [4], equilibria: 48, tangents: 24, motions: 3, seconds: 2.0}
""")
ended = subprocess.run(
    [sys.executable, "-m", "warp_resphys", "experiment=drawing"],
    capture_output=True,
    text=True,
    check=False,
)
print("\n".join(ended.stdout.splitlines()[-3:]), ended.stderr[-2000:] if ended.returncode else "")
run = Path("runs/drawing/default")

# %% [markdown]
# ## Comparison of controllers
#
# `control.json` has the mean distance of the tip from its reference: for the plans in open loop,
# for a receding horizon, which plans at every step from the observed markers, and for two baselines
# without a simulator, a linear model of the recordings and feedback by the robot's Jacobian.

# %%
results = json.loads((run / "control.json").read_text())
errors = {name: error["mean_mm"] for name, error in results["tracking"]["1.5"].items()}
for name, error in errors.items():
    print(f"{name:16s} {error:6.2f} mm")
planning = results["command_ms"]["receding_sysid"]["median"]
print(f"a new plan takes {planning:.1f} ms; a step lasts 10 ms")

# %%
with h5py.File(run / "driven.h5") as file:
    names = list(file.attrs["controllers"])
    motion = file["circle_1.5s"]
    path = 1e3 * motion["path"][:]  # (T, 3) [mm]
    points = 1e3 * motion["points"][:]  # (controllers, T, 3) [mm]
figure, axes = plt.subplots(
    1, 3, figsize=(8.5, 3.2), sharex=True, sharey=True, layout="constrained"
)
titles = ("open_simulation", "open_sysid", "receding_sysid")
for axis, name in zip(axes, titles, strict=True):
    axis.plot(*path[:, :2].T, color="0.75", linewidth=5, label="reference")
    axis.plot(*points[names.index(name)][:, :2].T, color="#1a5fb4", label="executed")
    axis.set(title=f"{name}: {errors[name]:.2f} mm", xlabel="x [mm]", aspect="equal")
axes[0].set_ylabel("y [mm]")
axes[0].legend(loc="center", frameon=False)
plt.show()

# %% [markdown]
# The motion begins at the robot's rest position and reaches the circle in the first fifth of its
# duration.
#
# ## A plan is a table
#
# `plans/sysid_circle_1.5s.csv` is the plan for a real robot: times, predicted markers, and
# commanded tensions. The identified simulator, loaded in three lines, plays it and follows the
# prediction.

# %%
robot = warp_resphys.load(run, model="sysid")
with open(run / "plans" / "sysid_circle_1.5s.csv", newline="") as file:
    heads, *rows = csv.reader(file)
table = np.array(rows, dtype=float)
columns = [number for number, head in enumerate(heads) if head.startswith("tendon_tension")]
tensions = table[1:, columns]
expected = table[:, 1 : 1 + 3 * len(robot.labels)].reshape(len(table), -1, 3)
played = robot.rollout(robot.begin(tendon_tension=tensions[0] * 0.0), tendon_tension=tensions)
off = 1e3 * np.linalg.norm(played.markers[:, 0].numpy() - expected, axis=-1)
print(
    f"distance of the markers from the plan: {off.mean():.3f} mm on average, "
    f"{off.max():.3f} mm at most"
)

# %%
figure, axis = plt.subplots(figsize=(7, 2.6), layout="constrained")
axis.plot(table[1:, 0], tensions, label=robot.inputs["tendon_tension"].parts)
axis.set(xlabel="time [s]", ylabel="tension [N]")
axis.legend(frameon=False)
plt.show()

# %% [markdown]
# ## Summary
#
# With parameters identified from six short recordings, the error of the plan is two thirds of that
# with the data sheet's parameters. The error of the receding horizon is less than a millimetre, and
# less than that of both baselines.

# %%
assert off.max() < 0.2
assert errors["open_sysid"] < 0.8 * errors["open_simulation"]
assert errors["receding_sysid"] < 1.0
assert errors["receding_sysid"] < 0.7 * min(errors["receding_linear"], errors["feedback_5"])
