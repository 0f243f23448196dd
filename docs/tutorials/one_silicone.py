# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # One silicone, many robots
#
# A learned force is specific to the mesh of its training; a material is not. This page learns the
# law of a silicone from a beam that is released under weights, and applies it to bodies without any
# trials.
#
# The silicone of the simulated laboratory is a Mooney-Rivlin rubber that relaxes, so that Young's
# modulus, Poisson's ratio and damping cannot describe it.

# %%
import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp

import warp_resphys as wr

wp.config.log_level = wp.LOG_WARNING


def command(*arguments):
    """Runs `warp-resphys` with arguments, and gives what it printed."""
    line = [sys.executable, "-m", "warp_resphys", *arguments]
    ended = subprocess.run(line, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-2000:]
    return ended.stdout


BEAM = ["experiment=law_rubber", "target.muscles=null", "law.families=0"]
QUICK = ["budget=quick", "timing=false", "hydra.run.dir=runs/beam"]
printed = command(*BEAM, *QUICK)
print("\n".join(line for line in printed.splitlines() if "law" in line and "error than" in line))

# %% [markdown]
# ## The law
#
# `law.json` has the selected terms with their standard deviations, and the classes of laws that
# were tried with their errors on the validation trials. The laboratory has c10 30 kPa and c01
# 14 kPa, and 26.4 kPa that relax in 80 ms.

# %%
law = json.loads(Path("runs/beam/law.json").read_text())
for name, value in law["parameters"].items():
    print(f"{name:18s} {value:12.4g} {law['units'][name]}")
print(
    f"\nerror over the amplitude: {law['validation']['law']:.2g}, of SysID "
    f"{law['validation']['below']:.2g}"
)

# %% [markdown]
# ## Other bodies
#
# `Robot.on(mesh)` gives another body the material of a robot. The same bodies are also simulated
# with the true silicone, which only a simulated laboratory can do. Where a body is stretched
# further than the beam was, the law extrapolates.

# %%
bodies = {
    "beam of 20 cm": (
        wr.box_hexahedra((0.2, 0.03, 0.03), (16, 2, 2)),  # short: (16, 2, 2) -> (6, 1, 1)
        {"x": 0.0},
    ),
    "thin beam": (
        wr.box_hexahedra((0.1, 0.02, 0.02), (10, 2, 2)),  # short: (10, 2, 2) -> (5, 1, 1)
        {"x": 0.0},
    ),
    "tapered finger": (
        wr.rod([[0, 0, 0], [0.12, 0, 0]], [[0.0, 0.014], [0.12, 0.007]], layers=6),
        {"x": 0.0},
    ),
}
truth = wr.energies.MooneyRivlin(
    30e3, 14e3, 20e6, density=1070.0, stiffness_damping=5e-4, prony=[(0.3, 0.08)]
)
robots = {model: wr.load("runs/beam", model=model) for model in ("simulation", "sysid", "law")}


def swing(simulator, parameters=None, steps=100):  # short: 100 -> 40
    """Motion of a body that is let go from straight [m]."""
    with torch.no_grad():
        return (
            simulator.rollout(simulator.rest_state(), steps, parameters=parameters).q[:, 0].numpy()
        )


motions, removed = {}, {}
for name, (mesh, fixed) in bodies.items():
    real = wr.Simulator(wr.Body(mesh, wr.select_vertices(mesh, **fixed)), truth, time_step=0.01)
    motions[name] = {"true": swing(real)}
    for model, robot in robots.items():
        there = robot.on(mesh, fixed=fixed)
        motions[name][model] = swing(there.simulator, there.constants)
    errors = {
        m: 1e3 * np.linalg.norm(q - motions[name]["true"], axis=-1).mean()
        for m, q in motions[name].items()
    }
    removed[name] = 100.0 * (1.0 - errors["law"] / errors["simulation"])
    beyond = wr.energies.share_outside_law("runs/beam/law.json", mesh, motions[name]["law"])
    print(
        f"{name:15s} uncorrected {errors['simulation']:6.3f} mm, SysID {errors['sysid']:6.3f} "
        f"mm, law {errors['law']:8.2g} mm: {removed[name]:.3f} % removed, extrapolates in "
        f"{100.0 * beyond:.1f} % of cells"
    )
assert min(removed.values()) > 99.0, removed

# %%
figure, axes = plt.subplots(1, len(bodies), figsize=(9.0, 2.8), sharex=True, layout="constrained")
for axis, (name, own) in zip(axes, motions.items(), strict=True):
    tip = np.argmax(bodies[name][0].vertices[:, 0])
    for model, label in {
        "simulation": "uncorrected",
        "sysid": "SysID",
        "law": "law",
        "true": "true",
    }.items():
        line = {"color": "black", "linestyle": ":"} if model == "true" else {}
        times = 0.01 * np.arange(101)  # short: 101 -> 41
        axis.plot(times, 1e3 * own[model][:, tip, 2], label=label, **line)
    axis.set(title=name, xlabel="time [s]")
axes[0].set_ylabel("height of the tip [mm]")
axes[0].legend(frameon=False, fontsize=8)
plt.show()

# %% [markdown]
# On the command line, `law=runs/beam/law.json` uses the law in any other experiment, and `shapes`
# tests it on other bodies: [experiments](../learning.md#other-bodies-of-the-same-material).
