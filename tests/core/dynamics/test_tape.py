import gc
import weakref

import numpy as np
import pytest
import torch
import warp as wp

from support.clamped import clamped
from warp_resphys import (
    Corotated,
    InputError,
    Inputs,
    Simulator,
    State,
    box_hexahedra,
    record_rollout,
)

BATCH, STEPS = 2, 3


def make_simulator(device, integrator="implicit_euler"):
    body = clamped(box_hexahedra((0.04, 0.02, 0.02), (2, 1, 1)))
    material = Corotated(1e5, 0.4, density=1000.0, mass_damping=0.5, stiffness_damping=0.001)
    return Simulator(body, material, integrator=integrator, relative_tolerance=1e-11, device=device)


def array(tensor, dtype=wp.vec3d):
    """A Warp array of its own with a gradient."""
    device = wp.device_from_torch(tensor.device)
    return wp.array(tensor.cpu().numpy(), dtype=dtype, device=device, requires_grad=True)


def moving_state(simulator):
    random = torch.Generator().manual_seed(3)
    noise = simulator.tensor(torch.randn(2, BATCH, simulator.body.n_vertices, 3, generator=random))
    free = simulator.rest_positions[:, :1] / simulator.rest_positions[:, 0].max()
    return State(simulator.rest_positions + 5e-4 * free * noise[0], 0.05 * free * noise[1])


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_gradients_equal_those_of_torch(device, integrator):
    simulator = make_simulator(device, integrator)
    state = moving_state(simulator)
    random = torch.Generator().manual_seed(4)
    shape = (STEPS, BATCH, simulator.body.n_vertices, 3)
    inputs = {
        "q": state.q,
        "v": state.v,
        "external_force": simulator.tensor(1e-3 * torch.randn(shape, generator=random)),
        "fixed_positions": (state.q[:, simulator.fixed] + 1e-4).expand(STEPS, -1, -1, -1).clone(),
        "youngs_modulus": simulator.tensor([1.1e5, 0.9e5]),  # an element
        "poissons_ratio": simulator.tensor([[0.35], [0.42]]),  # an environment
        "density": simulator.tensor([1050.0]),
        "mass_damping": simulator.tensor([0.4]),
        "stiffness_damping": simulator.tensor([0.002]),
    }
    weights = simulator.tensor(torch.randn(2, STEPS + 1, *shape[1:], generator=random))

    leaves = {name: value.clone().requires_grad_(True) for name, value in inputs.items()}
    acting = Inputs(leaves["external_force"], leaves["fixed_positions"])
    parameters = {k: leaves[k] for k in list(inputs)[4:]}
    trajectory = simulator.rollout(State(leaves["q"], leaves["v"]), STEPS, acting, parameters)
    loss = (weights[0] * trajectory.q).sum() + (weights[1] * trajectory.v).sum()
    expected = torch.autograd.grad(loss, list(leaves.values()))

    arrays = {
        name: array(value, wp.vec3d if value.ndim > 2 else wp.float64)
        for name, value in inputs.items()
    }
    tape = wp.Tape()
    path, speeds = record_rollout(
        tape,
        # a fresh one, with no factor left from the roll-out above
        make_simulator(device, integrator),
        arrays["q"],
        arrays["v"],
        STEPS,
        inputs={name: arrays[name] for name in ("external_force", "fixed_positions")},
        parameters={name: arrays[name] for name in list(inputs)[4:]},
    )
    seeds = [wp.from_torch(w.contiguous(), dtype=wp.vec3d) for w in weights]
    tape.backward(grads={path: seeds[0], speeds: seeds[1]})
    for (name, value), gradient in zip(arrays.items(), expected, strict=True):
        got = wp.to_torch(value.grad)
        assert torch.linalg.norm(got - gradient) <= 1e-12 * torch.linalg.norm(gradient), name
        assert torch.linalg.norm(gradient) > 0.0, name


@pytest.mark.parametrize("integrator", ["midpoint", "bdf2"])
def test_two_roll_outs_on_one_tape_are_one(device, integrator):
    simulator = make_simulator(device, integrator)
    state = moving_state(simulator)

    def gradients(parts):
        q, v = array(state.q), array(state.v)
        density = array(simulator.tensor([1000.0]), wp.float64)
        tape = wp.Tape()
        now, before = (q, v), None
        for steps in parts:
            path, speeds = record_rollout(
                tape, simulator, *now, steps, previous=before, parameters={"density": density}
            )
            now, before = (path[-1], speeds[-1]), (path[-2], speeds[-2])
        path.grad[-1].fill_(1.0)
        speeds.grad[-1].fill_(0.01)
        tape.backward()
        return path.numpy()[-1], q.grad.numpy(), density.grad.numpy()

    whole, split = gradients((4,)), gradients((2, 2))
    np.testing.assert_allclose(split[0], whole[0], atol=1e-10)
    for a, b in zip(split[1:], whole[1:], strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-7 * np.abs(b).max())


def test_a_dropped_tape_leaves_nothing_behind(device):
    simulator = make_simulator(device)
    state = simulator.rest_state(BATCH)
    tape = wp.Tape()
    force = array(0.0 * state.q)
    path, speeds = record_rollout(
        tape, simulator, array(state.q), array(state.v), 1, inputs={"external_force": force}
    )
    path.grad.fill_(1.0)
    tape.backward()
    assert force.grad.numpy().any()
    kept = weakref.ref(path)
    del tape, path, speeds
    gc.collect()
    assert kept() is None


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda q, v: (wp.zeros(q.shape, dtype=wp.vec3f, device=q.device), v),
            "q must be a Warp array of vec3d",
        ),
        (lambda q, v: (q, v[:1]), "state.v has shape"),
    ],
)
def test_wrong_input_is_told(device, change, sentence):
    simulator = make_simulator(device)
    state = simulator.rest_state(BATCH)
    with pytest.raises(InputError, match=sentence):
        record_rollout(wp.Tape(), simulator, *change(array(state.q), array(state.v)), 1)
    unknown = {"stiffness": wp.zeros(1, dtype=wp.float64)}
    with pytest.raises(InputError, match="'stiffness' is not a parameter"):
        record_rollout(wp.Tape(), simulator, array(state.q), array(state.v), 1, parameters=unknown)
