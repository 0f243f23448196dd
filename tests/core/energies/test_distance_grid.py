"""Obstacles of any shape: distances on a grid, from a surface, against closed forms."""

import math

import numpy as np
import pytest
import torch
import trimesh

from support.clamped import noise
from support.refusals import refuses
from support.slopes import check_slopes
from warp_resphys import Body, Contact, Corotated, HalfSpace, Mesh, Simulator, State, box_hexahedra
from warp_resphys.core.energies.contact.obstacle_poses import ObstacleSet, Pose
from warp_resphys.energies import DistanceGrid, SurfaceFile
from warp_resphys.io.errors import InputError, MeshError

RADIUS = 0.02  # m
RING, TUBE = 0.02, 0.008  # m, radii of a torus and of its section
CPU = torch.device("cpu")


def exact(spacing=2e-3, **pose):
    """A sphere by its exact distances."""
    low = -RADIUS - 14.0 * spacing
    axis = low + spacing * np.arange(int(np.ceil(-2.0 * low / spacing)) + 1)
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return DistanceGrid(
        distances=np.linalg.norm(places, axis=-1) - RADIUS,
        spacing=spacing,
        low=(low, low, low),
        **pose,
    )


def measured(grid, x):
    pose = Pose(
        torch.zeros(1, 1, 3).double(), torch.eye(3).double()[None, None], torch.zeros(1, 1).double()
    )
    d, n = ObstacleSet((grid,), 1e-3, CPU).distances(x, pose)
    return d[..., 0], n[:, :, 0]


def test_interpolated_distances_converge_with_the_fourth_power_of_the_spacing():
    ways, errors = np.random.default_rng(0).normal(size=(1, 200, 3)), []
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    x = torch.as_tensor(ways * (RADIUS + np.linspace(1e-4, 2e-3, 200)[:, None]))
    for spacing in (4e-3, 2e-3):
        d, n = measured(exact(spacing), x)
        radius = x.norm(dim=-1)
        errors.append(
            [
                float((d - radius + RADIUS).abs().max()),
                float((n - x / radius[..., None]).norm(dim=-1).max()),
            ]
        )
    assert errors[1][0] < 2e-7
    assert errors[0][0] > 10.0 * errors[1][0]
    assert errors[0][1] > 6.0 * errors[1][1]


def test_outside_of_the_grid_its_distance_is_added_to_the_least_one_at_its_boundary():
    """The interpolation ends one node within the grid,
    13 spacings from the sphere in the direction of an axis.
    """
    spacing, x = 2e-3, np.array([[[0.1, 0.0, 0.0], [0.0, -0.2, 0.0], [0.09, -0.07, 0.001]]])
    grid = exact(spacing)
    end = RADIUS + 13.0 * spacing
    away = x - np.clip(x, -end, end)
    length = np.linalg.norm(away, axis=-1)
    d, n = measured(grid, torch.as_tensor(x))
    np.testing.assert_allclose(d, 13.0 * spacing + length, rtol=1e-12)
    np.testing.assert_allclose(n, away / length[..., None], atol=1e-12)


def ring(**pose):
    surface = trimesh.creation.torus(RING, TUBE, major_sections=48, minor_sections=24)
    return DistanceGrid.of_surface(surface.vertices, surface.faces, 1e-3, **pose)


def test_no_slope_is_larger_than_the_bound_of_slopes():
    """Also at the centre of a hole and in the middle of a plate as thick as a spacing,
    where distances have kinks.
    """
    plate = trimesh.creation.box((0.04, 0.04, 1e-3))
    for grid in (ring(), DistanceGrid.of_surface(plate.vertices, plate.faces, 1e-3)):
        axes = [
            low + 2.5e-4 * np.arange(4, 4 * n - 7)
            for low, n in zip(grid.low, grid.distances.shape, strict=True)
        ]
        within = [axis[np.abs(axis) < 6e-3] for axis in axes]
        most = 0.0
        for places in (within, [axes[0], within[1], within[2]]):
            x = torch.as_tensor(np.stack(np.meshgrid(*places, indexing="ij"), -1).reshape(1, -1, 3))
            most = max(most, float(measured(grid, x)[1].norm(dim=-1).max()))
        assert 1.2 < most < grid.largest_slope < 1.5 * most


def test_a_surface_gives_the_distances_of_its_shape(tmp_path):
    box = trimesh.creation.box((0.04, 0.03, 0.02))
    box.apply_scale(1e3)
    box.export(tmp_path / "box.stl")
    file = SurfaceFile(path=str(tmp_path / "box.stl"))
    grid = Contact({"box": file}).obstacles["box"]
    d, n = measured(
        grid, torch.tensor([[[0.0, 0.0, 0.011], [0.0, 0.0157, 0.0], [0.0, 0.0, 0.0]]]).double()
    )
    np.testing.assert_allclose(d[0], [1e-3, 0.7e-3, -1e-2], atol=2e-5)
    np.testing.assert_allclose(n[0, :2], [[0, 0, 1], [0, 1, 0]], atol=3e-3)
    (tmp_path / "open.stl").write_bytes(
        trimesh.Trimesh(box.vertices, box.faces[1:]).export(file_type="stl")
    )
    refuses(
        MeshError,
        "close the surface",
        lambda: Contact({"box": file.changed(path=str(tmp_path / "open.stl"))}),
    )
    refuses(
        InputError,
        r"SurfaceFile\.units is 'inch': it must be one of m, cm, mm",
        file.changed,
        units="inch",
    )
    for faces in (box.faces[:, ::-1], np.concatenate([box.faces[:1, ::-1], box.faces[1:]])):
        refuses(
            InputError,
            "counter-clockwise",
            DistanceGrid.of_surface,
            1e-3 * box.vertices,
            faces,
            1e-3,
        )


@pytest.mark.slow
def test_a_body_that_is_thrown_through_a_ring_does_not_penetrate():
    """The distance of a ring is not convex: the whole block passes through its hole or rests on
    it.
    """
    height = -0.015
    grid = ring(position=(0.0, 0.0, height))
    box = box_hexahedra((0.03, 0.03, 0.01), (4, 4, 1))
    mesh = Mesh(box.vertices + [-0.01, -0.014, 0.0], box.cells)
    contact = Contact({"ring": grid, "floor": HalfSpace(position=(0.0, 0.0, -0.04))}, friction=0.5)
    silicone = Corotated(1e5, 0.45, density=1070.0, stiffness_damping=2e-3)
    simulator = Simulator(Body(mesh, energies=[contact]), silicone, 2e-3, relative_tolerance=1e-6)
    state = simulator.rest_state()
    state = State(state.q, state.v + torch.tensor([0.5, 0.0, -5.0]))
    touched = False
    for _ in range(40):
        before, state = state, simulator.step(state)
        forces = simulator.contacts(before, state)["obstacles"]
        x = state.q[0, forces.vertices].numpy() - [0.0, 0.0, height]
        gaps = np.hypot(np.hypot(x[:, 0], x[:, 1]) - RING, x[:, 2]) - TUBE
        assert gaps.min() > 0.0
        assert float(forces.gap.min()) > 0.0
        touched |= bool((forces.normal[:, :, 0].norm(dim=-1) > 0.0).any())
    assert touched


def test_gradients_of_a_block_that_slides_over_a_ring():
    """By its velocity, friction, stiffness and the pose of the ring."""
    box = box_hexahedra((0.03, 0.03, 0.01), (3, 3, 1))
    mesh = Mesh(box.vertices + [-0.0103, -0.0144, 0.0], box.cells)  # between the nodes of the grid
    contact = Contact(
        {"ring": ring(position=(0.0, 0.0, -0.0088))}, stiffness=2e4, friction=0.3, slip_speed=2e-2
    )
    silicone = Corotated(1e5, 0.45, density=1070.0, stiffness_damping=2e-3)
    body = Body(mesh, energies=[contact])
    simulator = Simulator(body, silicone, 1e-3, solver="newton", relative_tolerance=1e-13)
    start = simulator.rest_state()
    weights = noise(*start.q.shape)
    values = {
        "v": start.v + torch.tensor([0.3, 0.1, -0.1]),
        "contact_friction": 0.3,
        "contact_stiffness": 2e4,
    }
    values |= {"obstacle_y": 0.0, "obstacle_z": 0.0, "obstacle_turn_x": 0.0, "obstacle_growth": 0.0}
    values = {
        name: torch.as_tensor(value).double().reshape(1, -1, 3 if name == "v" else 1)
        for name, value in values.items()
    }
    sizes = {"v": 1e-5, "contact_friction": 1e-5, "contact_stiffness": 0.5, "obstacle_turn_x": 1e-6}

    def loss(values):
        given = {name: value.reshape(1, 1) for name, value in values.items() if name != "v"}
        trajectory = simulator.rollout(State(start.q, values["v"]), 8, None, given)
        return (weights * trajectory.q[-1]).sum()

    check_slopes(loss, values, {name: sizes.get(name, 1e-7) for name in values})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"distances": np.zeros((4, 4, 4))}, "8 nodes or more"),
        ({"distances": -np.ones((9, 9, 9))}, "end outside of the shape"),
        ({"spacing": 0.0}, "spacing"),
        ({"low": (0.0, math.nan, 0.0)}, "DistanceGrid.low is .*: it must be three numbers, in m"),
    ],
)
def test_grids_that_are_refused(change, words):
    with pytest.raises(InputError, match=words):
        DistanceGrid(
            **{"distances": np.ones((9, 9, 9)), "spacing": 1e-3, "low": (0.0, 0.0, 0.0), **change}
        )
