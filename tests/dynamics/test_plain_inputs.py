"""Inputs given as numbers and lists, and what Python prints of a simulation."""

import numpy as np
import pytest
import torch

from support.clamped import clamped
from warp_resphys import Body, Corotated, InputError, Inputs, Scene, Simulator, SurfaceContact, Tendons, box_hexahedra

MESH = box_hexahedra((0.1, 0.02, 0.02), (4, 1, 1))
ROUTES = [[[x, 0.01, z] for x in (0.0, 0.05, 0.1)] for z in (0.002, 0.018)]


def pulled(dtype=torch.float64):
    return Simulator(clamped(MESH, energies=[Tendons(ROUTES)]), Corotated(2e5, 0.45), dtype=dtype)


@pytest.mark.parametrize(("dtype", "batch"), [(torch.float64, 1), (torch.float32, 3)])
def test_numbers_and_lists_are_for_every_environment(dtype, batch):
    simulator = pulled(dtype)
    start = simulator.rest_state(batch)
    series = np.linspace(0.1, 0.2, 3)[:, None, None] * np.ones((1, batch, 2))
    cases = [
        (0.2, [[0.2, 0.2]] * batch),
        ([0.1, 0.3], [[0.1, 0.3]] * batch),
        (np.array([[0.1, 0.3]]), [[0.1, 0.3]] * batch),
        (series, series),
        (series[:, :1], series),
    ]
    for given, expected in cases:
        path = simulator.rollout(start, 3, Inputs(tendon_tension=given))
        other = simulator.rollout(start, 3, Inputs(tendon_tension=simulator.tensor(expected)))
        assert torch.equal(path.q, other.q)
    rest = simulator.static_equilibrium(Inputs(tendon_tension=0.2), batch=batch).q
    assert rest.shape[0] == batch
    assert torch.equal(rest, simulator.static_equilibrium(Inputs(tendon_tension=simulator.tensor(cases[0][1]))).q)
    force = np.zeros((len(MESH.vertices), 3))
    force[-1, 2] = 0.01
    moved = simulator.step(start, Inputs(external_force=force)).q
    assert float((moved - simulator.step(start).q)[:, -1, 2].min()) > 0.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"tendon_tension": "much"}, "tendon_tension is 'much'"),
        ({"external_force": [0.0, 0.0, -1.0]}, r"external_force has shape \(3,\): it must be \(N, 3\)"),
        ({"fixed_positions": 1.0}, r"fixed_positions has shape \(\)"),
        ({"attached_mass": 0.1}, r"attached_mass has shape \(\): .* a mass for every vertex"),
        ({"tendon_tension": [torch.ones(2), torch.ones(2)]}, "list with tensors"),
    ],
)
def test_what_is_no_input_is_refused(given, message):
    with pytest.raises(InputError, match=message):
        Inputs(**given)


def test_wrong_numbers_of_values_are_refused():
    simulator = pulled()
    with pytest.raises(InputError, match=r"tendon_tension has shape \(1, 3\)"):
        simulator.step(simulator.rest_state(), Inputs(tendon_tension=[0.1, 0.2, 0.3]))


def test_simulations_are_printed_in_a_line():
    simulator = pulled()
    inputs = Inputs(tendon_tension=[0.1, 0.2])
    path = simulator.rollout(simulator.rest_state(), 2, inputs)
    scene = Scene({"a": simulator.body, "b": Body.rigid_body(MESH)}, SurfaceContact(distance=1e-4))
    body = "Body(Mesh(20 vertices, 4 cells: hexahedron), 4 fixed vertices, Tendons)"
    assert repr(simulator) == f"Simulator({body}, Corotated, 10 ms, implicit_euler, torch.float64, cpu)"
    assert repr(path.final).startswith("State(q (1, 20, 3), v (1, 20, 3)")
    assert repr(path) == "Motion: 2 steps of 10 ms, 1 environment, q (3, 1, 20, 3)"
    assert repr(inputs) == "Inputs(tendon_tension (1, 2))"
    assert repr(scene).startswith(f"Scene(a: {body}, b: Body(Mesh(20 vertices, 4 cells: hexahedron, regions body)")
