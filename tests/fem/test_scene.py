"""Several bodies in one simulator."""

import numpy as np
import pytest
import torch

from support.clamped import clamped
from warp_resphys import Body, Corotated, Inputs, Mesh, Rigid, Scene, Simulator, StableNeoHookean, box_hexahedra
from warp_resphys.energies import Strings
from warp_resphys.io.errors import InputError, MeshError
from warp_resphys.mesh.boxes import box_tetrahedra
from warp_resphys.mesh.selection import select_vertices
from warp_resphys.mesh.volume_mesh import join

SOFT = Corotated(2e5, 0.45)


def finger():
    mesh = box_hexahedra((0.1, 0.03, 0.03), (4, 1, 1))
    return clamped(mesh, energies=[Strings([select_vertices(mesh, x=0.1)], 0.1)])


def ball():
    """A rigid body of other cells, free to fall."""
    return Body.rigid_body(box_tetrahedra((0.02, 0.02, 0.02), (1, 1, 1), order=2), Rigid(density=900.0))


def test_bodies_of_a_scene_move_as_each_alone():
    scene = Scene({"finger": finger(), "ball": ball()})
    weight = Inputs(payload=np.array([[0.05]]))
    together = Simulator(scene, SOFT)
    assert {"finger_youngs_modulus", "finger_string_length", "ball_body_density"} <= together.parameters.keys()
    motion = together.rollout(together.rest_state(), 6, scene.inputs({"finger": weight}))
    for name, body, material, inputs in (("finger", finger(), SOFT, weight), ("ball", ball(), {}, Inputs())):
        alone = Simulator(body, material)
        own = alone.rollout(alone.rest_state(), 6, inputs)
        torch.testing.assert_close(motion.q[:, :, scene.vertex_slice(name)], own.q, rtol=0.0, atol=1e-9)
        for key, value in own.final.memory.items():
            torch.testing.assert_close(motion.final.memory[f"{name}_{key}"], value, rtol=0.0, atol=1e-9)


def test_forces_and_clamps_go_to_the_body_that_is_named():
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


def test_a_body_may_be_driven_as_a_whole_but_not_all_of_them():
    mesh = box_hexahedra((0.1, 0.03, 0.03), (2, 1, 1))
    driven = Body(mesh, fixed=np.arange(len(mesh.vertices)))
    scene = Scene({"tool": driven, "finger": finger()})
    simulator = Simulator(scene, SOFT)
    places = simulator.rest_positions[simulator.fixed].clone()
    places[: len(mesh.vertices), 1] += 0.2
    path = simulator.rollout(simulator.rest_state(), 3, Inputs(fixed_positions=places[None]))
    assert torch.equal(path.q[-1][:, scene.vertex_slice("tool")], places[None, : len(mesh.vertices)])
    alone = Simulator(finger(), SOFT)
    own = alone.rollout(alone.rest_state(), 3)
    torch.testing.assert_close(path.q[:, :, scene.vertex_slice("finger")], own.q, rtol=0.0, atol=1e-9)
    with pytest.raises(InputError, match="every vertex is fixed"):
        Simulator(Scene({"tool": driven, "other": driven}), SOFT)


def test_materials_and_the_joined_mesh_of_a_scene():
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


def test_regions_of_one_name_are_refused():
    mesh = box_hexahedra()
    named = Mesh(mesh.vertices, mesh.cells, {"b": np.arange(1)})
    with pytest.raises(MeshError, match="two regions have the name 'a_b'"):
        join({"a_b": mesh, "a": named})
