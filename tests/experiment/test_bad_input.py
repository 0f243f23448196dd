"""What cannot be simulated is refused with the right class and a sentence that names it."""

import numpy as np
import pytest
import torch

from warp_resphys import Body, Corotated, Mesh, PointMass, Simulator, State, box_hexahedra, select_vertices
from warp_resphys.energies.catalogue import make_material
from warp_resphys.io.errors import InputError, MeshError
from warp_resphys.stepping.inputs import Inputs

MESH = box_hexahedra((0.02, 0.01, 0.01), (2, 1, 1))
BODY = Body(MESH, fixed=select_vertices(MESH, x=0.0))
ELEMENTS, VERTICES, FIXED = len(MESH.cells), len(MESH.vertices), len(BODY.fixed_vertices)


@pytest.fixture(scope="module")
def simulator():
    return Simulator(BODY, Corotated(1e5, 0.4, density=1000.0))


def refused(message, error=InputError):
    return pytest.raises(error, match=message)


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"youngs_modulus": 0.0}, "youngs_modulus is"),
        ({"youngs_modulus": NAN}, "youngs_modulus is nan"),
        ({"youngs_modulus": [1e5, -1.0]}, "youngs_modulus is"),
        ({"youngs_modulus": torch.ones(1, 1, 1)}, r"youngs_modulus has shape \(1, 1, 1\)"),
        ({"youngs_modulus": []}, r"youngs_modulus has shape \(0,\)"),
        ({"poissons_ratio": 0.5}, "poissons_ratio is"),
        ({"poissons_ratio": -1.0}, "poissons_ratio is -1"),
        ({"density": 0.0}, "density is"),
        ({"stiffness_damping": INF}, "stiffness_damping is inf"),
        ({"lame_lambda": 1e5}, "'lame_lambda'"),
        ({"model": "linear"}, "'linear'"),
    ],
)
def test_material(constants, message):
    with refused(message):
        make_material(**constants)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time_step": -0.01}, "time_step is -0.01: it must be positive"),
        ({"time_step": INF}, "time_step is inf"),
        ({"dtype": torch.float16}, "torch.float16"),
        ({"gravity": (0.0, -9.81)}, "gravity"),
        ({"gravity": (0.0, 0.0, NAN)}, "gravity"),
    ],
)
def test_simulator(options, message):
    with refused(message):
        Simulator(BODY, **options)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_absent_cuda_device():
    with refused("device is 'cuda', but torch finds no CUDA device: choose device=cpu"):
        Simulator(BODY, device="cuda")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fixed": [0, VERTICES]}, f"fixed vertices must lie between 0 and {VERTICES - 1}"),
        ({"fixed": range(VERTICES)}, "every vertex is fixed"),
        ({"mass": "consistent"}, "mass is"),
    ],
)
def test_body(options, message):
    with refused(message):
        Simulator(Body(MESH, **options))


@pytest.mark.parametrize(
    ("mass", "message"),
    [
        (PointMass(-0.1, [0]), "a point mass of -0.1 kg"),
        (PointMass(0.1, []), "a point mass must hang on at least one vertex"),
        (PointMass(0.1, [VERTICES]), f"a point mass's vertices must lie between 0 and {VERTICES - 1}"),
        (PointMass(0.1, [True, False]), "a point mass's vertices must be vertex numbers"),
        (PointMass(0.1, [0, 1], [0.5]), "a point mass on 2 vertices needs 2 weights, zero or more, that sum to one"),
        (PointMass(0.1, [0, 1], [0.5, 0.6]), "a point mass on 2 vertices needs 2 weights, zero or more"),
    ],
)
def test_point_mass(mass, message):
    with refused(message):
        Simulator(Body(MESH, point_masses=[mass]))


def arguments(simulator):
    rest = simulator.rest_state(2)
    return {
        "q": rest.q,
        "v": rest.v,
        "external_force": torch.zeros_like(rest.q),
        "fixed_positions": rest.q[:, simulator.fixed],
    }


def step(simulator, q, v, external_force, fixed_positions):
    return simulator.step(State(q, v), Inputs(external_force, fixed_positions))


NAMES = {"q": "state.q", "v": "state.v", "external_force": "external_force", "fixed_positions": "fixed_positions"}


@pytest.mark.parametrize("name", NAMES)
def test_values_that_are_not_finite(name, simulator):
    given = {key: tensor.clone() for key, tensor in arguments(simulator).items()}
    given[name][1, 2, 0] = NAN
    with refused(f"{NAMES[name]} is not finite in environment 1, vertex 2"):
        step(simulator, **given)


def test_the_state_before_is_checked_like_the_state():
    simulator = Simulator(BODY, integrator="bdf2")
    rest = simulator.rest_state(2)
    for which in (0, 1):
        moved = rest.v.clone()
        moved[1, 2, 0] = INF
        for wrong, message in (
            (moved, "is not finite in environment 1, vertex 2"),
            (rest.q[:1], ""),
            (rest.q.numpy(), ""),
        ):
            pair = [rest.q, rest.v]
            pair[which] = wrong
            with refused(rf"state.previous\[{which}\] {message}"):
                simulator.step(State(rest.q, rest.v, tuple(pair)))
    with refused(r"state.previous must be the pair \(q, v\)"):
        simulator.step(State(rest.q, rest.v, (rest.q,)))


@pytest.mark.parametrize("name", NAMES)
def test_wrong_shapes(name, simulator):
    given = arguments(simulator)
    wanted = rf"it must be \(2, {FIXED if name == 'fixed_positions' else VERTICES}, 3\)"
    for wrong in (given[name][:, :-1], given[name][..., :2], given[name][0]):
        with refused(f"{NAMES[name]} has shape" + ("" if name == "q" else f" .*{wanted}")):
            step(simulator, **(given | {name: wrong}))


@pytest.mark.parametrize("count", [0, 2.5, True, "two"])
def test_batches_and_steps_that_are_no_whole_numbers(simulator, count):
    with refused("batch is .*: it must be a whole number, one or more"):
        simulator.rest_state(count)
    with refused("batch is .*: it must be a whole number, one or more"):
        simulator.static_equilibrium(batch=count)
    with refused("steps is .*: it must be a whole number, one or more"):
        simulator.rollout(simulator.rest_state(1), count)


def test_rollout_with_the_wrong_number_of_steps(simulator):
    state = simulator.rest_state(1)
    forces = torch.zeros(3, *state.q.shape)
    with refused("external_force has 3 time steps, but 4 are to be simulated"):
        simulator.rollout(state, 4, Inputs(external_force=forces))
    with refused("fixed_positions has 3 time steps, but 4 are to be simulated"):
        simulator.rollout(state, 4, Inputs(fixed_positions=forces[:, :, simulator.fixed]))


def test_material_of_another_mesh_or_batch(simulator):
    with refused(f"a material parameter has {ELEMENTS + 1} values for {ELEMENTS} elements"):
        simulator.step(simulator.rest_state(1), parameters={"density": [1000.0] * (ELEMENTS + 1)})
    for constants in ({"youngs_modulus": np.full((3, 1), 1e5)}, {"mass_damping": [1.0, 2.0, 3.0]}):
        with refused("3 environments"):
            simulator.step(simulator.rest_state(2), parameters=constants)


def test_static_equilibrium_of_a_free_body():
    with refused("a body without fixed vertices has no static equilibrium: fix some vertices"):
        Simulator(Body(MESH)).static_equilibrium()


@pytest.mark.parametrize("name", ["external_force", "fixed_positions", "start"])
def test_static_equilibrium_of_values_that_are_not_finite(name, simulator):
    d = FIXED if name == "fixed_positions" else VERTICES
    values = torch.zeros(1, d, 3, dtype=torch.float64)
    values[0, 1, 2] = NAN
    with refused(f"{name} is not finite in environment 0, vertex 1"):
        simulator.static_equilibrium(**({name: values} if name == "start" else {"inputs": Inputs(**{name: values})}))


def test_mesh_with_vertices_that_no_cell_uses():
    unused = Mesh(np.concatenate([MESH.vertices, [[1.0, 1.0, 1.0]]]), MESH.cells)
    with refused("vertices .* belong to no cell", MeshError):
        Simulator(Body(unused))


def test_inverted_mesh():
    with refused("inverted", MeshError):
        Simulator(Body(Mesh(MESH.vertices, MESH.cells[:, [4, 5, 6, 7, 0, 1, 2, 3]])))
