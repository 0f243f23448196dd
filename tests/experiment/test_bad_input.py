"""What cannot be simulated is refused with the right class and a sentence that names it."""

import numpy as np
import pytest
import torch

from warp_resphys import (
    Body,
    Corotated,
    Inputs,
    Mesh,
    PointMass,
    Simulator,
    State,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.energies.catalogue import make_material
from warp_resphys.io.errors import InputError, MeshError

MESH = box_hexahedra((0.02, 0.01, 0.01), (2, 1, 1))
BODY = Body(MESH, fixed=select_vertices(MESH, x=0.0))
ELEMENTS, VERTICES, FIXED = len(MESH.cells), len(MESH.vertices), len(BODY.fixed_vertices)
NAN, INF = float("nan"), float("inf")


@pytest.fixture(scope="module")
def simulator():
    return Simulator(BODY, Corotated(1e5, 0.4, density=1000.0))


def build(mesh=MESH, **options):
    return Simulator(Body(mesh, **options))


def hung(*mass):
    return build(point_masses=[PointMass(*mass)])


def moved(s, parameters, batch=1):
    return s.step(s.rest_state(batch), parameters=parameters)


def rolled(s, steps, **inputs):
    return s.rollout(s.rest_state(1), steps, Inputs(**inputs))


FORCES = torch.zeros(3, 1, VERTICES, 3, dtype=torch.float64)
UNUSED = Mesh(np.concatenate([MESH.vertices, [[1.0, 1.0, 1.0]]]), MESH.cells)
INVERTED = Mesh(MESH.vertices, MESH.cells[:, [4, 5, 6, 7, 0, 1, 2, 3]])
WHOLE = "is .*: it must be a whole number, one or more"
CASES = [
    ("youngs_modulus is nan", lambda s: make_material(youngs_modulus=NAN)),
    ("youngs_modulus is", lambda s: make_material(youngs_modulus=[1e5, -1.0])),
    (
        r"youngs_modulus has shape \(1, 1, 1\)",
        lambda s: make_material(youngs_modulus=torch.ones(1, 1, 1)),
    ),
    (r"youngs_modulus has shape \(0,\)", lambda s: make_material(youngs_modulus=[])),
    ("poissons_ratio is", lambda s: make_material(poissons_ratio=0.5)),
    ("poissons_ratio is -1", lambda s: make_material(poissons_ratio=-1.0)),
    ("density is", lambda s: make_material(density=0.0)),
    ("stiffness_damping is inf", lambda s: make_material(stiffness_damping=INF)),
    ("'lame_lambda'", lambda s: make_material(lame_lambda=1e5)),
    ("'linear'", lambda s: make_material(model="linear")),
    ("time_step is -0.01: it must be positive", lambda s: Simulator(BODY, time_step=-0.01)),
    ("time_step is inf", lambda s: Simulator(BODY, time_step=INF)),
    ("torch.float16", lambda s: Simulator(BODY, dtype=torch.float16)),
    ("gravity", lambda s: Simulator(BODY, gravity=(0.0, -9.81))),
    ("gravity", lambda s: Simulator(BODY, gravity=(0.0, 0.0, NAN))),
    (f"fixed vertices must lie between 0 and {VERTICES - 1}", lambda s: build(fixed=[0, VERTICES])),
    ("every vertex is fixed", lambda s: build(fixed=range(VERTICES))),
    ("mass is", lambda s: build(mass="consistent")),
    ("a point mass of -0.1 kg", lambda s: hung(-0.1, [0])),
    ("a point mass must hang on at least one vertex", lambda s: hung(0.1, [])),
    (
        f"a point mass's vertices must lie between 0 and {VERTICES - 1}",
        lambda s: hung(0.1, [VERTICES]),
    ),
    ("a point mass's vertices must be vertex numbers", lambda s: hung(0.1, [True, False])),
    (
        "a point mass on 2 vertices needs 2 weights, zero or more, that sum to one",
        lambda s: hung(0.1, [0, 1], [0.5]),
    ),
    (
        "a point mass on 2 vertices needs 2 weights, zero or more",
        lambda s: hung(0.1, [0, 1], [0.5, 0.6]),
    ),
    (
        r"state.previous must be the pair \(q, v\)",
        lambda s: s.step(State(*2 * (s.rest_positions[None],), (None,))),
    ),
    *(
        (f"batch {WHOLE}", lambda s, count=count: s.rest_state(count))
        for count in (0, 2.5, True, "two")
    ),
    (f"batch {WHOLE}", lambda s: s.static_equilibrium(batch=0)),
    ("steps is of type float: it must be int", lambda s: rolled(s, 2.5)),
    (
        "external_force has 3 time steps, but 4 are to be simulated",
        lambda s: rolled(s, 4, external_force=FORCES),
    ),
    (
        "fixed_positions has 3 time steps, but 4",
        lambda s: rolled(s, 4, fixed_positions=FORCES[:, :, s.fixed]),
    ),
    (
        f"has {ELEMENTS + 1} values for {ELEMENTS} elements",
        lambda s: moved(s, {"density": [1000.0] * (ELEMENTS + 1)}),
    ),
    ("3 environments", lambda s: moved(s, {"youngs_modulus": np.full((3, 1), 1e5)}, 2)),
    ("3 environments", lambda s: moved(s, {"mass_damping": [1.0, 2.0, 3.0]}, 2)),
    ("vertices .* belong to no cell", lambda s: build(UNUSED)),
    ("inverted", lambda s: build(INVERTED)),
]


@pytest.mark.parametrize(("message", "call"), CASES, ids=[message for message, _ in CASES])
def test_it_is_refused(message, call, simulator):
    with pytest.raises(
        MeshError if "belong" in message or message == "inverted" else InputError, match=message
    ):
        call(simulator)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_absent_cuda_device():
    with pytest.raises(
        InputError, match="device is 'cuda', but torch finds no CUDA device: choose device=cpu"
    ):
        Simulator(BODY, device="cuda")


STATE = {
    "q": "state.q",
    "v": "state.v",
    "q_back": r"state.previous\[0\]",
    "v_back": r"state.previous\[1\]",
}


@pytest.mark.parametrize("name", [*STATE, "external_force", "fixed_positions"])
def test_states_and_inputs_that_are_not_finite_or_misshapen(name):
    simulator = Simulator(BODY, integrator="bdf2")
    rest = simulator.rest_state(2)
    given = {
        "q": rest.q,
        "v": rest.v,
        "q_back": rest.q,
        "v_back": rest.v,
        "external_force": torch.zeros_like(rest.q),
    }
    given["fixed_positions"] = rest.q[:, simulator.fixed]
    wrong, infinite = given[name].clone(), given[name].clone()
    wrong[1, 2, 0], infinite[1, 2, 0] = NAN, INF
    shape = rf" has shape .*it must be \(2, {FIXED if name == 'fixed_positions' else VERTICES}, 3\)"
    cases = [(x, " is not finite in environment 1, vertex 2") for x in (wrong, infinite)]
    cases += [
        (x, " has shape" if name == "q" else shape)
        for x in (wrong[:, :-1], wrong[..., :2], wrong[0])
    ]
    cases += [(wrong.numpy(), "")] if name.endswith("back") else []
    for value, message in cases:
        q, v, q_back, v_back, *inputs = (given | {name: value}).values()
        with pytest.raises(InputError, match=STATE.get(name, name) + message):
            simulator.step(State(q, v, (q_back, v_back)), Inputs(*inputs))


@pytest.mark.parametrize("name", ["external_force", "fixed_positions", "start"])
def test_static_equilibrium_of_values_that_are_not_finite(name, simulator):
    values = torch.zeros(
        1, FIXED if name == "fixed_positions" else VERTICES, 3, dtype=torch.float64
    )
    values[0, 1, 2] = NAN
    with pytest.raises(InputError, match=f"{name} is not finite in environment 0, vertex 1"):
        simulator.static_equilibrium(
            **({name: values} if name == "start" else {"inputs": Inputs(**{name: values})})
        )
