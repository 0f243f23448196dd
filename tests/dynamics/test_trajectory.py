"""Trajectories as files and pictures, and batches of one without their axis."""

import h5py
import meshio
import numpy as np
import pytest
import torch

from warp_resphys import Body, InputError, Inputs, Simulator, Tendons, box_hexahedra, select_vertices
from warp_resphys.dynamics.trajectory import Trajectory

MESH = box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(4, 1, 1))
TIP = select_vertices(MESH, x=0.1)
SIMULATOR = Simulator(
    Body(MESH, select_vertices(MESH, x=0.0), energies=[Tendons([[[0.0, 0.01, 0.02], [0.1, 0.01, 0.02]]])])
)


@pytest.fixture(scope="module")
def trajectory():
    moved = SIMULATOR.rollout(SIMULATOR.rest_state(), 3)
    return Trajectory(moved.q, moved.v, moved.reports, moved.final, SIMULATOR.body, 0.01)


def test_a_file_has_times_and_units(trajectory, tmp_path):
    with h5py.File(trajectory.save(tmp_path / "run" / "beam.h5")) as file:
        assert {name: file[name].attrs["units"] for name in file} == {"times": "s", "q": "m", "v": "m/s", "rest": "m"}
        assert np.array_equal(file["q"], trajectory.q.numpy())
        assert np.array_equal(file["v"], trajectory.v.numpy())
        assert np.allclose(file["times"], [0.0, 0.01, 0.02, 0.03])


def test_a_plot_has_the_displacement_in_millimetres(trajectory):
    (line,) = trajectory.plot(TIP, "z").lines
    expected = 1e3 * (trajectory.q[:, 0, TIP, 2] - SIMULATOR.rest_positions[TIP, 2]).mean(1)
    assert np.allclose(line.get_ydata(), expected.numpy())
    assert line.get_xdata()[-1] == pytest.approx(0.03)
    assert line.get_ydata()[-1] < 0.0


def test_a_series_for_paraview_has_every_step(trajectory, tmp_path):
    path = trajectory.write_vtk(tmp_path / "beam.pvd")
    assert path.read_text(encoding="utf-8").count("<DataSet") == 4
    last = meshio.read(tmp_path / "beam" / "beam_3.vtu")
    assert np.allclose(last.points, trajectory.q[3, 0].numpy())
    assert np.allclose(last.point_data["velocity"], trajectory.v[3, 0].numpy())


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
    with pytest.raises(InputError, match=message):
        call(trajectory)


def test_a_batch_of_one_needs_no_axis():
    force, tension = torch.zeros(20, 3, dtype=torch.float64), torch.tensor([0.5], dtype=torch.float64)
    force[TIP, 1] = 0.01
    rest, velocity = SIMULATOR.rest_positions, torch.full((20, 3), 0.01, dtype=torch.float64)
    velocity[SIMULATOR.fixed] = 0.0
    bare, _ = SIMULATOR.step(SIMULATOR.state(rest, velocity), Inputs(force, tendon_tension=tension))
    batched, _ = SIMULATOR.step(
        SIMULATOR.state(rest[None].numpy(), velocity[None]), Inputs(force[None], tendon_tension=tension[None])
    )
    assert torch.equal(bare.q, batched.q)
    assert bare.q.shape == (1, 20, 3)
    clamp = rest[SIMULATOR.fixed]
    assert Inputs(fixed_positions=clamp).fixed_positions.shape == (1, *clamp.shape)
    assert Inputs(attached_mass=torch.zeros(20)).attached_mass.shape == (1, 20)
    with pytest.raises(InputError, match="q has shape"):
        SIMULATOR.state(rest[:5])
    with pytest.raises(InputError, match="external_force has shape"):
        SIMULATOR.step(SIMULATOR.rest_state(batch=2), Inputs(force))
