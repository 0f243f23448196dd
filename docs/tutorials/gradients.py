# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Gradients and identification
#
# Every time step is differentiable with respect to forces, states, materials and actuators, through
# any number of steps. This page computes such a gradient, checks it against finite differences, and
# uses it to identify Young's modulus and a viscosity from noisy markers.

# %%
import matplotlib.pyplot as plt
import numpy as np
import scipy.optimize
import torch
import warp as wp

from warp_resphys import (
    Body,
    Corotated,
    Inputs,
    Simulator,
    box_hexahedra,
    record_rollout,
    select_vertices,
)

wp.config.log_level = wp.LOG_WARNING
torch.manual_seed(0)

mesh = box_hexahedra(
    size=(0.1, 0.03, 0.03),  # m
    divisions=(10, 3, 3),  # short: (10, 3, 3) -> (4, 1, 1)
)
body = Body(mesh, fixed=select_vertices(mesh, x=0.0))
tip = select_vertices(mesh, x=0.1)
# Second order, with residuals far below the measured differences; gradients are exact at the
# solution.
simulator = Simulator(
    body,
    Corotated(youngs_modulus=264e3, poissons_ratio=0.499, density=1070.0),
    time_step=0.01,
    integrator="bdf2",
    relative_tolerance=1e-10,
)

load = torch.zeros(1, len(mesh.vertices), 3, dtype=torch.float64)  # (B, N, 3) N
load[:, tip, 2] = -0.3 / len(tip)
STEPS = 40


def heights(modulus, viscosity=0.0):
    """(T + 1,) height of the tip after the beam is released from a load [m]."""
    parameters = {"youngs_modulus": modulus, "stiffness_damping": viscosity}
    held = simulator.static_equilibrium(Inputs(external_force=load), parameters=parameters)
    return simulator.rollout(held, STEPS, parameters=parameters).q[:, 0, tip, 2].mean(-1)


# %% [markdown]
# ## A gradient through forty steps
#
# The parameter is a tensor that requires a gradient. The initial equilibrium depends on it, too.

# %%
modulus = torch.tensor([264e3], dtype=torch.float64, requires_grad=True)
last = heights(modulus)[-1]
last.backward()
exact = modulus.grad.item()
print(f"d(height at the end) / dE = {exact:.9e} m/Pa")

# %% [markdown]
# ## Check
#
# The error of central differences decreases with the square of the step, until rounding dominates.
# If the gradient were wrong, the error would stop decreasing earlier, at the error of the gradient.

# %%
digits = np.arange(1.0, 7.5, 0.5)  # short: np.arange(1.0, 7.5, 0.5) -> np.array([2.0, 4.0, 5.0])
relative = 10.0**-digits
errors = []
with torch.no_grad():
    for step in relative:
        up, down = (
            heights(torch.tensor([264e3 * (1 + sign * step)]))[-1].item() for sign in (1, -1)
        )
        errors.append(abs((up - down) / (2 * 264e3 * step) / exact - 1))
figure, axis = plt.subplots(figsize=(5, 3), layout="constrained")
axis.loglog(relative, errors, "o-")
axis.set(xlabel="relative difference of E", ylabel="relative error of differences")
plt.show()
print(f"smallest: {min(errors):.1e}")

# %% [markdown]
# The backward pass is the discrete adjoint of the implicit step: one linear solve with the Hessian
# at the solution, independent of the iterations. Its cost is about that of one step.
#
# ## Identification
#
# Now a noisy motion is given, as for a robot. Its material is stiffer than the data sheet's, and
# viscous. One backward pass computes the gradient of the squared error with respect to both
# parameters, at a cost that does not depend on their number. L-BFGS minimises the error.

# %%
truth = {"modulus": 300e3, "viscosity": 4e-3}  # Pa, s
with torch.no_grad():
    clean = heights(torch.tensor([truth["modulus"]]), torch.tensor([truth["viscosity"]]))
measured = clean + 1e-4 * torch.randn(STEPS + 1, dtype=torch.float64)  # 0.1 mm of noise


def loss(x):
    """Mean squared error [noise^2] and its gradient by logarithms of both over first guesses."""
    logarithms = torch.tensor(x, requires_grad=True)
    guess = torch.tensor([264e3, 1e-3], dtype=torch.float64) * logarithms.exp()
    error = ((heights(guess[:1], guess[1:]) - measured) / 1e-4).square().mean()
    error.backward()
    history.append([*guess.tolist(), error.item()])
    return error.item(), logarithms.grad.numpy()


history = []
fit = scipy.optimize.minimize(
    loss, np.zeros(2), jac=True, method="L-BFGS-B", bounds=[(-1.0, 1.0), (-4.0, 4.0)]
)
modulus, viscosity = 264e3 * np.exp(fit.x[0]), 1e-3 * np.exp(fit.x[1])
print(
    f"E = {modulus / 1e3:.2f} kPa (true: 300), viscosity {1e3 * viscosity:.2f} ms (true: 4.00), "
    f"{fit.nfev} roll-outs"
)
print(f"remaining error: {fit.fun**0.5:.2f} of the noise")

# %%
with torch.no_grad():
    before = heights(torch.tensor([264e3]))
    after = heights(torch.tensor([modulus]), torch.tensor([viscosity]))
times = simulator.time_step * np.arange(STEPS + 1)
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
axis.plot(times, 1e3 * measured, "k.", label="measured")
axis.plot(times, 1e3 * before, label="data sheet")
axis.plot(times, 1e3 * after, label="identified")
axis.set(xlabel="time [s]", ylabel="height of the tip [mm]")
figure.legend(loc="outside upper center", ncols=3, frameon=False)
plt.show()

# %% [markdown]
# In an experiment the stage `identify` does this, with several starts, priors, uncertain marker
# positions and a posterior of the parameters ([experiments](../experiments.md)); in Python, use
# `warp_resphys.identify`.
#
# ## Gradients on a Warp tape
#
# For users of Warp kernels, `wp.Tape` gives the same gradients, in the same memory. Here a kernel
# computes the final height of the tip, and the gradient is with respect to the initial positions.


# %%
@wp.kernel
def mean_height(
    q: wp.array3d[wp.vec3d],
    vertices: wp.array[wp.int32],  # the tip's
    step: wp.int32,
    result: wp.array[wp.float64],
):
    i = wp.tid()
    wp.atomic_add(result, 0, q[step, 0, vertices[i]][2] / wp.float64(vertices.shape[0]))


start = wp.from_torch(simulator.rest_positions[None].clone(), dtype=wp.vec3d, requires_grad=True)
at_rest = wp.zeros_like(start, requires_grad=True)
result = wp.zeros(1, dtype=wp.float64, requires_grad=True)
chosen = wp.array(tip, dtype=wp.int32, device="cpu")
with wp.Tape() as tape:
    path, _ = record_rollout(tape, simulator, start, at_rest, steps=10)
    wp.launch(mean_height, dim=len(tip), inputs=[path, chosen, 10], outputs=[result])
tape.backward(result)
by_warp = wp.to_torch(start.grad)

state = simulator.rest_state()
state.q.requires_grad_()
simulator.rollout(state, 10).q[-1, 0, tip, 2].mean().backward()
print(
    "largest gradient:",
    by_warp.abs().max().item(),
    "difference of both:",
    (by_warp - state.q.grad).abs().max().item(),
)

# %% [markdown]
# ## Summary
#
# Differences agree with the adjoint to one part in ten million, the parameters are identified
# within the accuracy that the noise allows, and torch and Warp give the same gradient.

# %%
assert min(errors) < 1e-7
assert abs(modulus / 300e3 - 1) < 0.01
assert abs(viscosity / 4e-3 - 1) < 0.1
assert fit.fun < 1.5
assert torch.allclose(by_warp, state.q.grad, rtol=1e-9, atol=1e-12)
