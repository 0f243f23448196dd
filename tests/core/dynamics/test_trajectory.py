"""Trajectories as files and pictures, inputs as numbers and lists,
batches of one, and what Python prints.
"""

import h5py
import matplotlib.pyplot as plt
import meshio
import numpy as np
import pytest
import torch

from support.clamped import clamped
from support.refusals import refuses
from warp_resphys import (
    Body,
    Corotated,
    InputError,
    Inputs,
    Scene,
    Simulator,
    Tendons,
    box_hexahedra,
    read_recording,
    select_vertices,
)
from warp_resphys.core.energies.contact.obstacle_contact import Contact
from warp_resphys.core.energies.contact.obstacle_surface import ObstacleSurface
from warp_resphys.core.energies.contact.surface_contact import SurfaceContact
from warp_resphys.energies import Box, Sphere

MESH = box_hexahedra((0.1, 0.02, 0.02), (4, 1, 1))
TIP = select_vertices(MESH, x=0.1)
SIMULATOR = Simulator(clamped(MESH, energies=[Tendons([[[0.0, 0.01, 0.02], [0.1, 0.01, 0.02]]])]))


@pytest.fixture(scope="module")
def trajectory():
    return SIMULATOR.rollout(SIMULATOR.rest_state(), 3)


def test_a_file_has_times_and_units(trajectory, tmp_path):
    with h5py.File(trajectory.save(tmp_path / "run" / "beam.h5")) as file:
        assert {name: file[name].attrs["units"] for name in file} == {
            "times": "s",
            "q": "m",
            "v": "m/s",
            "rest": "m",
        }
        assert np.array_equal(file["q"], trajectory.q.numpy())
        assert np.array_equal(file["v"], trajectory.v.numpy())
        assert np.allclose(file["times"], [0.0, 0.01, 0.02, 0.03])


def test_a_series_for_paraview_has_every_step(trajectory, tmp_path):
    path = trajectory.write_vtk(tmp_path / "beam.pvd")
    assert path.read_text(encoding="utf-8").count("<DataSet") == 4
    last = meshio.read(tmp_path / "beam" / "beam_3.vtu")
    assert np.allclose(last.points, trajectory.q[3, 0].numpy())
    assert np.allclose(last.point_data["velocity"], trajectory.v[3, 0].numpy())
    held = last.point_data["reaction"]
    assert np.array_equal(np.flatnonzero(held.any(1)), trajectory.reaction.vertices.numpy())
    assert np.allclose(held.sum(0), trajectory.reaction.force[2, 0].numpy())


def test_a_table_and_a_plot_have_force_and_moment_of_the_clamp(trajectory, tmp_path):
    plain = trajectory.write_csv(tmp_path / "beam.csv").read_text().splitlines()[0].split(",")
    path = trajectory.write_csv(tmp_path / "loads.csv", reaction=True)
    titles = [
        "load.fx [N]",
        "load.fy [N]",
        "load.fz [N]",
        "load.tx [N m]",
        "load.ty [N m]",
        "load.tz [N m]",
    ]
    assert path.read_text().splitlines()[0].split(",") == [*plain, *titles]
    loads = np.genfromtxt(path, delimiter=",", skip_header=1)[:, -6:]
    assert np.isnan(loads[0]).all()
    expected = torch.cat([trajectory.reaction.force, trajectory.reaction.moment()], -1)[
        :, 0
    ].numpy()
    np.testing.assert_allclose(loads[1:], expected, rtol=1e-11)
    np.testing.assert_allclose(read_recording(path).loads["load"][1:], expected, rtol=1e-11)
    axes = trajectory.plot(reaction=True)
    assert axes.get_ylabel() == "reaction [N]"
    for column, line in enumerate(axes.lines):
        np.testing.assert_allclose(line.get_ydata()[1:], expected[:, column])
    plt.close(axes.figure)
    free = Simulator(Body(MESH))
    refuses(
        InputError,
        "has no reaction",
        free.rollout(free.rest_state(), 1).write_csv,
        path,
        reaction=True,
    )


PLATE = Box(position=(0.09, 0.01, -0.015), edges=(0.02, 0.04, 0.02), moves=True)
BALL = Sphere(position=(0.05, 0.01, -0.05), radius=0.01)


def test_obstacles_are_in_the_series_where_they_are_at_the_end_of_every_step(tmp_path):
    """A plate that rises and turns, and a ball whose place
    and size are parameters, by environment.
    """
    simulator = Simulator(
        clamped(MESH, energies=[Contact({"ball": BALL, "plate": PLATE})]), time_step=0.01
    )
    ways = torch.arange(1, 4, dtype=torch.float64)[:, None, None] * torch.tensor(
        [[0.0, 2e-4], [0.0, 5e-4]]
    )
    inputs = {"obstacle_move_z": ways, "obstacle_rotate_y": -20.0 * ways}
    given = {
        "obstacle_x": torch.tensor([[0.0, 0.0], [0.02, 0.0]]),
        "obstacle_growth": torch.tensor([[2e-3], [0.0]]),
    }
    given = {name: value.double() for name, value in given.items()}
    moved = simulator.rollout(simulator.rest_state(2), 3, Inputs(**inputs), given)
    for environment in range(2):
        series = moved.write_vtk(tmp_path / f"{environment}.pvd", environment).with_name(
            f"{environment}_obstacles.pvd"
        )
        assert series.read_text(encoding="utf-8").count("<DataSet") == 4
        placed = {
            "obstacle_x_ball": 0.02 * environment,
            "obstacle_growth": 2e-3 * (1 - environment),
        }
        surface = ObstacleSurface.of(simulator.body, placed)
        begun = {
            name: np.concatenate([np.zeros((1, 2)), x[:, environment]])
            for name, x in inputs.items()
        }
        expected = surface.moved(begun)
        for step in range(4):
            file = meshio.read(tmp_path / series.stem / f"{series.stem}_{step}.vtu")
            assert np.allclose(file.points, expected.points[step], rtol=0.0, atol=1e-9)
            assert np.array_equal(file.point_data["obstacle"], surface.owners)
            assert np.array_equal(file.cells_dict["triangle"], surface.triangles)


def test_a_plot_without_choices_shows_the_vertex_that_moves_furthest_along_its_way(trajectory):
    moved = (trajectory.q[:, 0] - trajectory.q[0, 0]).numpy()
    furthest = np.linalg.norm(moved, axis=2).max(0).argmax()
    axes = trajectory.plot()
    (line,), axis = axes.lines, "xyz"[np.abs(moved[:, furthest]).max(0).argmax()]
    assert axes.get_ylabel() == f"displacement along {axis} [mm]"
    np.testing.assert_allclose(
        line.get_ydata(), 1e3 * moved[:, furthest, "xyz".index(axis)], atol=1e-9
    )
    plt.close(axes.figure)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t: t.plot(TIP, "w"), "choose x, y or z"),
        (lambda t: t.plot(99), "must be one or more of 0 to 19"),
        (lambda t: t.plot(TIP, environment=1), "environment is 1: there are 1"),
        (lambda t: t.write_vtk("a.pvd", environment=-1), "environment is -1: there are 1"),
    ],
)
def test_what_is_not_there_is_refused(trajectory, call, message):
    refuses(InputError, message, call, trajectory)


def test_a_batch_of_one_needs_no_axis():
    force = torch.zeros(20, 3, dtype=torch.float64)
    tension = torch.tensor([0.5], dtype=torch.float64)
    force[TIP, 1] = 0.01
    rest, velocity = SIMULATOR.rest_positions, torch.full((20, 3), 0.01, dtype=torch.float64)
    velocity[SIMULATOR.fixed] = 0.0
    bare = SIMULATOR.step(SIMULATOR.state(rest, velocity), Inputs(force, tendon_tension=tension))
    batched = SIMULATOR.step(
        SIMULATOR.state(rest[None].numpy(), velocity[None]),
        Inputs(force[None], tendon_tension=tension[None]),
    )
    assert torch.equal(bare.q, batched.q)
    assert bare.q.shape == (1, 20, 3)
    clamp = rest[SIMULATOR.fixed]
    assert Inputs(fixed_positions=clamp).fixed_positions.shape == (1, *clamp.shape)
    assert Inputs(attached_mass=torch.zeros(20)).attached_mass.shape == (1, 20)
    refuses(InputError, "q has shape", SIMULATOR.state, rest[:5])
    refuses(
        InputError,
        "external_force has shape",
        SIMULATOR.step,
        SIMULATOR.rest_state(batch=2),
        Inputs(force),
    )


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
    assert torch.equal(
        rest, simulator.static_equilibrium(Inputs(tendon_tension=simulator.tensor(cases[0][1]))).q
    )
    force = np.zeros((len(MESH.vertices), 3))
    force[-1, 2] = 0.01
    moved = simulator.step(start, Inputs(external_force=force)).q
    assert float((moved - simulator.step(start).q)[:, -1, 2].min()) > 0.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"tendon_tension": "much"}, "tendon_tension is 'much'"),
        (
            {"external_force": [0.0, 0.0, -1.0]},
            r"external_force has shape \(3,\): it must be \(N, 3\)",
        ),
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
    assert (
        repr(simulator)
        == f"Simulator({body}, Corotated, 10 ms, implicit_euler, torch.float64, cpu)"
    )
    assert repr(path.final).startswith("State(q (1, 20, 3), v (1, 20, 3)")
    assert repr(path) == "Motion: 2 steps of 10 ms, 1 environment, q (3, 1, 20, 3)"
    assert repr(inputs) == "Inputs(tendon_tension (1, 2))"
    assert repr(scene).startswith(
        f"Scene(a: {body}, b: Body(Mesh(20 vertices, 4 cells: hexahedron, regions body)"
    )
