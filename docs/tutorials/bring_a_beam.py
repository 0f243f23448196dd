# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Bring your robot: a beam
#
# This page leads from CSV files of measured markers to a corrected simulator. The robot is a silicone beam that is
# clamped at one end, held straight by hand, and released, with or without a weight at its tip.
# [The guide](../bring_your_robot.md) explains all options and errors; this page shows one complete example.
#
# ## Recordings
#
# Real recordings come from cameras. Here a finer simulation with another material stands in for them. Its markers are
# in the cameras' frame, in millimetres, noisy, and misplaced by about 0.3 mm per coordinate.

# %%
import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp
from scipy.spatial.transform import Rotation

import warp_resphys
from warp_resphys import Body, Inputs, Simulator, StableNeoHookean, box_hexahedra, quadratic, select_vertices

wp.config.log_level = wp.LOG_WARNING
random = np.random.default_rng(3)

tracked = {"Tip - 1": (0.1, 0.015, 0.03), "Tip - 2": (0.1, 0.0, 0.015), "Tip - 3": (0.1, 0.03, 0.0)}  # m
reference = {"Base - 1": (0.0, 0.0, 0.0), "Base - 2": (0.0, 0.03, 0.03), "Base - 3": (0.0, 0.03, 0.0)}
weights = {"bare": 0.0, "light": 0.04, "heavy": 0.08}  # kg

mesh = quadratic(box_hexahedra((0.1, 0.03, 0.03), (6, 2, 2)))  # short: (6, 2, 2) -> (3, 1, 1)
silicone = StableNeoHookean(250e3, 0.49, density=1070.0, stiffness_damping=1e-3, prony=[(0.15, 0.1)])
robot = Simulator(Body(mesh, select_vertices(mesh, x=0.0)), silicone, time_step=0.005, integrator="midpoint")
carries = select_vertices(mesh, x=0.1)
mass = torch.zeros(len(weights), len(mesh.vertices), dtype=torch.float64)  # (B, N) kg
mass[:, carries] = torch.tensor(list(weights.values()), dtype=torch.float64)[:, None] / len(carries)
motion = robot.rollout(robot.rest_state(len(weights)), 200, inputs=Inputs(attached_mass=mass)).q[::2].numpy()

seen = [int(np.argmin(np.linalg.norm(mesh.vertices - at, axis=1))) for at in (tracked | reference).values()]
stems = 3e-4 * random.standard_normal((len(seen), 3))  # m: offsets of the real marker positions
cameras, origin = Rotation.from_euler("xyz", (90, 10, 35), degrees=True), np.array([0.4, -0.2, 0.9])
Path("recordings").mkdir()
for number, name in enumerate(weights):
    places = (
        np.concatenate([np.repeat(motion[:1, number], 40, axis=0), motion[:, number]])[:, seen] + stems
    )  # (T, M, 3)
    measured = 1e3 * (cameras.apply(places.reshape(-1, 3)) + origin).reshape(places.shape)
    measured += 0.05 * random.standard_normal(measured.shape)  # mm
    columns = [f"{label}.{axis} [mm]" for label in (*tracked, *reference) for axis in "xyz"]
    table = np.column_stack([0.01 * np.arange(len(places)), measured.reshape(len(places), -1)])
    header = ",".join(["time [s]", *columns])
    np.savetxt(f"recordings/{name}.csv", table, "%.4f", ",", header=header, comments="")
print(header)

# %% [markdown]
# ## Inspect the recordings
#
# `warp-resphys inspect` shows occlusions, drift and noise of the markers, and the time of the release.


# %%
def command(*arguments):
    """Runs `warp-resphys` with arguments, and gives what it printed."""
    line = [sys.executable, "-m", "warp_resphys", *arguments]
    ended = subprocess.run(line, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-2000:]
    return ended.stdout


print(
    command("inspect", "recording.path=recordings/heavy.csv", "still=[Base - 1,Base - 2,Base - 3]", "moving=[Tip - 1]")
)

# %% [markdown]
# ## The configuration
#
# A file in `configs/experiment` describes your robot: the body, its data sheet, the trials, and the nominal marker
# positions. Everything else comes from the package's defaults for released bodies (`/recordings: released`).
# The last lines, from `starts: 1` on, only shorten the run for this page; leave them out for a real robot, and use
# `budget=quick` on the command line for a first look.

# %%
Path("configs/experiment").mkdir(parents=True)
Path("configs/experiment/my_robot.yaml").write_text(f"""# @package _global_
defaults:
  - /recordings: released
  - override /mesh: beam_hexahedra  # 10 x 3 x 3 cm; or a file of your own, mesh: file
  - _self_
name: my_robot
title: My robot
mesh: {{divisions: [8, 2, 2]}}
fixed: {{x: 0.0}}  # the clamped vertices
tip: {{x: 0.1}}
simulation:  # from the data sheet
  youngs_modulus: 264.0e3  # Pa
  poissons_ratio: 0.49
  density: 1070.0  # kg/m^3
  model: corotated
  mass_damping: 0.0
  stiffness_damping: 0.0
data:
  folder: recordings
  trials:
    bare: {{file: bare.csv, payload: 0.0}}  # kg
    light: {{file: light.csv, payload: 0.04}}
    heavy: {{file: heavy.csv, payload: 0.08}}
  payload_at: {{x: 0.1}}
  seconds: 0.7
  folds: null
  train: [bare, heavy]
  test: [light]
markers:
  tracked: {json.dumps({name: list(at) for name, at in tracked.items()})}  # m
  reference: {json.dumps({name: list(at) for name, at in reference.items()})}
identify:
  parameters: {{mass_damping: {{lower: 0.0, upper: 10.0}}, stiffness_damping: {{lower: 0.0, upper: 0.02}}}}
  elastic: {{poissons_ratio: null}}
  starts: 1
  max_evaluations: 6
in_the_loop: {{epochs: 2, hold_out: false}}  # short: 2 -> 1
simfree: {{trainer: {{epochs: 40, rollout_every: 20}}}}  # short: 40, rollout_every: 20 -> 4, rollout_every: 4
correct_uncorrected: false
""")
print(command("experiment=my_robot"))

# %% [markdown]
# ## Read the report
#
# `runs/my_robot/default/report.html` begins with a verdict, and has an interactive view of the robot and its markers.
# Its numbers are in `metrics.json`, the identified parameters in `identification.json`.


# %%
def results(run):
    """Mean errors [mm] on the trial that no training saw, and the identified parameters."""
    errors = json.loads((run / "metrics.json").read_text())["errors_mm"]
    identified = json.loads((run / "identification.json").read_text())["sysid"]["parameters"]
    return {name: error["mean"] for name, error in errors.items()}, identified


errors, identified = results(Path("runs/my_robot/default"))
for name, error in errors.items():
    print(f"{name:14s} {error:6.3f} mm")
print(", ".join(f"{name} {value:.4g}" for name, value in identified.items()))

# %% [markdown]
# The error after identification is 1.5 mm, five times the error of the marker positions. The learned force does
# not help, because it overfits two motions. This indicates that the simulator lacks physics: silicone creeps, and the
# material of the simulator has no memory.
#
# ## Better physics
#
# A Prony branch adds memory: an additional shear modulus, given as a ratio to the long-term one, relaxes with a time
# constant ([materials](../simulator.md#creep)). A configuration based on the first one identifies both, and learns no
# force.

# %%
Path("configs/experiment/my_creeping_robot.yaml").write_text("""# @package _global_
defaults:
  - my_robot
  - override /reconstruction: none
  - _self_
name: my_creeping_robot
title: My robot, which creeps  # short: title: My robot, which creeps -> parallel: {processes: 1}
simulation: {prony_ratio_1: 0.0, prony_time_1: 0.3}  # of the shear modulus; s
identify:
  parameters:
    prony_ratio_1: {lower: 0.0, upper: 1.0}
    prony_time_1: {lower: 0.02, upper: 2.0, logarithmic: true}  # s
  first_guess: {prony_ratio_1: 0.1}
  max_evaluations: 8
""")
command("experiment=my_creeping_robot")
run = Path("runs/my_creeping_robot/default")
creeping, identified = results(run)
print(f"identified: {errors['sysid']:.2f} mm without, {creeping['sysid']:.2f} mm with creep")
share, within = identified["prony_ratio_1"], identified["prony_time_1"]
print(f"a share of {share:.2f} within {within:.2f} s (true: 0.15 within 0.10 s)")

# %% [markdown]
# Now the error is that of the marker positions, 0.3 mm, which better physics cannot reduce, and a learned force is not
# needed. If the missing physics is unknown, as in the walls of a pneumatic arm, use a learned force and
# more recordings ([residual forces](residual_forces.py), [a pneumatic arm](pneumatic_arm.py)).
#
# ## Use the result
#
# The run is a robot, which can be loaded in Python and saved to one file.

# %%
robot = warp_resphys.load(run, model="sysid")
trial = warp_resphys.recorded_trial(robot, "light")
played = trial.play(robot)
print(robot)
robot.save("my_robot.safetensors")

figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
axis.plot(trial.times, 1e3 * trial.markers[:, 0, 2], "k.", label="measured")
axis.plot(trial.times, 1e3 * trial.shown(played)[:, 0, 2], label="identified, with creep")
axis.set(xlabel="time [s]", ylabel="height of Tip - 1 [mm]")
figure.legend(loc="outside upper center", ncols=2, frameon=False)
plt.show()

# %%
assert errors["sysid"] < 0.6 * errors["simulation"]
assert creeping["sysid"] < 0.35 * errors["sysid"]
assert 0.1 < share < 0.25
assert abs(trial.errors_mm(played).mean() / creeping["sysid"] - 1) < 0.05
