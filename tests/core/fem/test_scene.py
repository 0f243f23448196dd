"""Several bodies in one simulator, and bodies in another place,
which move as the first ones do there.
"""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from support.chambered import hollow_box
from support.clamped import clamped
from warp_resphys import (
    Body,
    Fibres,
    Inputs,
    Mesh,
    Muscles,
    Pressure,
    Rigid,
    Scene,
    Simulator,
    SymmetryPlane,
    Tendons,
)
from warp_resphys.core.energies.materials import Corotated, StableNeoHookean
from warp_resphys.core.energies.route import Route
from warp_resphys.core.mesh.boxes import box_hexahedra, box_tetrahedra
from warp_resphys.core.mesh.volume_mesh import join
from warp_resphys.energies import Muscle
from warp_resphys.io.errors import InputError, MeshError
from warp_resphys.mesh import find_chambers

SOFT = Corotated(2e5, 0.45)


def finger():
    mesh = box_hexahedra((0.1, 0.03, 0.03), (4, 1, 1))
    route = Route(guides=[[0.0, 0.015, 0.025], [0.05, 0.015, 0.028], [0.1, 0.015, 0.025]])
    return clamped(mesh, energies=[Tendons([route], friction=0.2)])


def ball():
    """A rigid body of other cells, free to fall."""
    return Body.rigid_body(
        box_tetrahedra((0.02, 0.02, 0.02), (1, 1, 1), order=2), Rigid(density=900.0)
    )


def test_bodies_of_a_scene_move_as_each_alone():
    scene = Scene({"finger": finger(), "ball": ball()})
    pulled = Inputs(tendon_tension=np.array([[0.5]]))
    together = Simulator(scene, SOFT)
    assert {
        "finger_youngs_modulus",
        "finger_tendon_friction",
        "ball_body_density",
    } <= together.parameters.keys()
    motion = together.rollout(together.rest_state(), 6, scene.inputs({"finger": pulled}))
    for name, body, material, inputs in (
        ("finger", finger(), SOFT, pulled),
        ("ball", ball(), {}, Inputs()),
    ):
        alone = Simulator(body, material)
        own = alone.rollout(alone.rest_state(), 6, inputs)
        torch.testing.assert_close(
            motion.q[:, :, scene.vertex_slice(name)], own.q, rtol=0.0, atol=1e-9
        )
        for key, value in own.final.memory.items():
            torch.testing.assert_close(
                motion.final.memory[f"{name}_{key}"], value, rtol=0.0, atol=1e-9
            )


def test_forces_clamps_materials_and_regions_go_to_the_body_that_is_named():
    two = Body(box_hexahedra((0.1, 0.03, 0.03), (2, 1, 1)), fixed=[0, 1])
    scene = Scene({"a": two, "b": finger()})
    force = torch.ones(1, two.n_vertices, 3, dtype=torch.float64)
    inputs = scene.inputs({"a": Inputs(external_force=force)})
    assert float(inputs.external_force[:, scene.vertex_slice("a")].min()) == 1.0
    assert float(inputs.external_force[:, scene.vertex_slice("b")].abs().max()) == 0.0
    clamp = torch.zeros(1, 2, 3, dtype=torch.float64)
    with pytest.raises(InputError, match="fixed_positions of b are missing"):
        scene.inputs({"a": Inputs(fixed_positions=clamp)})
    with pytest.raises(InputError, match="Unknown body 'c'"):
        scene.inputs({"c": Inputs()})
    scene = Scene({"a": finger(), "b": finger()})
    assert scene.mesh.region("b").tolist() == [4, 5, 6, 7]
    simulator = Simulator(scene, {"a": SOFT, "b": StableNeoHookean()})
    assert list(simulator.materials) == ["a", "b"]
    with pytest.raises(InputError, match="'b' has no material"):
        Simulator(scene, {"a": SOFT})
    with pytest.raises(MeshError, match="cannot be joined"):
        Scene({"a": finger(), "ball": ball()}).mesh  # noqa: B018
    with pytest.raises(InputError, match="one or more bodies"):
        Scene({})
    mesh = box_hexahedra()
    named = Mesh(mesh.vertices, mesh.cells, {"b": np.arange(1)})
    with pytest.raises(MeshError, match="two regions have the name 'a_b'"):
        join({"a_b": mesh, "a": named})


def test_a_body_may_be_driven_as_a_whole_but_not_all_of_them():
    mesh = box_hexahedra((0.1, 0.03, 0.03), (2, 1, 1))
    driven = Body(mesh, fixed=np.arange(len(mesh.vertices)))
    scene = Scene({"tool": driven, "finger": finger()})
    simulator = Simulator(scene, SOFT)
    places = simulator.rest_positions[simulator.fixed].clone()
    places[: len(mesh.vertices), 1] += 0.2
    path = simulator.rollout(simulator.rest_state(), 3, Inputs(fixed_positions=places[None]))
    assert torch.equal(
        path.q[-1][:, scene.vertex_slice("tool")], places[None, : len(mesh.vertices)]
    )
    alone = Simulator(finger(), SOFT)
    own = alone.rollout(alone.rest_state(), 3)
    torch.testing.assert_close(
        path.q[:, :, scene.vertex_slice("finger")], own.q, rtol=0.0, atol=1e-9
    )
    with pytest.raises(InputError, match="every vertex is fixed"):
        Simulator(Scene({"tool": driven, "other": driven}), SOFT)


ROTATION = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
SHIFT = np.array([0.1, -0.2, 0.05])  # m
BOX = box_hexahedra((0.1, 0.02, 0.02), (5, 1, 1))
HOLLOW = hollow_box("hexahedron")
CHAMBER = [max(find_chambers(HOLLOW), key=lambda own: len(own.faces))]  # longer than it is wide
ROUTE = [[0.0, 0.015, 0.01], [0.05, 0.015, 0.012], [0.1, 0.015, 0.01]]
BODIES = {
    "tendon": (
        clamped(BOX, energies=[Tendons([Route(guides=ROUTE, offsets=[[0.0, 0.0, 1.0]])])]),
        {"tendon_tension": 0.4},
        {"tendon_offset_1": 2e-3},
    ),
    "muscle": (
        clamped(BOX, energies=[Muscles([Muscle([2, 3], (1.0, 0.5, 0.0))])]),
        {"muscle_stress": 2e4},
        {},
    ),
    "chamber": (
        clamped(
            HOLLOW,
            energies=[
                Pressure(CHAMBER),
                Fibres(CHAMBER, [20.0], axis=(1.0, 0.2, 0.1), stiffness=1e3),
            ],
        ),
        {"pressure": 3e4},
        {},
    ),
}


@pytest.mark.parametrize("name", BODIES)
def test_the_motion_moves_with_the_body(name):
    body, given, parameters = BODIES[name]
    gravity = np.array([0.0, 3.0, -9.0])
    material, ends = Corotated(2e5, 0.4), []
    for own, pull in ((body, gravity), (body.moved(ROTATION, SHIFT), ROTATION @ gravity)):
        simulator = Simulator(own, material, 0.01, tuple(pull), relative_tolerance=1e-11)
        ends.append(
            simulator.rollout(simulator.rest_state(), 5, Inputs(**given), parameters)
            .q[-1, 0]
            .numpy()
        )
    without = Simulator(body, material, 0.01, tuple(gravity))
    free = without.rollout(without.rest_state(), 5).q[-1, 0].numpy()
    assert np.abs(ends[0] - free).max() > 1e-4  # The actuator does something.
    np.testing.assert_allclose(ends[1], ends[0] @ ROTATION.T + SHIFT, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("rotation", [np.diag([1.0, 1.0, -1.0]), [0.0, 0.0, 1.0]])
def test_a_matrix_that_is_no_rotation_is_refused(rotation):
    with pytest.raises(InputError, match="the rotation is"):
        BODIES["tendon"][0].moved(rotation, SHIFT)


def test_a_symmetric_body_stays():
    with pytest.raises(InputError, match="symmetry plane"):
        clamped(BOX, symmetry=[SymmetryPlane((0.0, 1.0, 0.0))]).moved(ROTATION, SHIFT)
