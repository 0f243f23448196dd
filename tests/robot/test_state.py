"""States, motions and inputs of robots, without a robot."""

import csv

import numpy as np
import torch

from support.refusals import refuses
from warp_resphys import Body, InputError, Motion, Simulator, State, box_hexahedra
from warp_resphys.core.mesh.motion_files import input_columns, write_csv
from warp_resphys.core.stepping.quantity import Quantity
from warp_resphys.robot.actuation import InputReader, RobotInput


def moved(batch, **more):
    q = torch.arange(6.0 * batch, dtype=torch.float64).reshape(batch, 2, 3)
    queue = 2.0 + torch.arange(4.0 * batch).reshape(batch, 2, 2)
    return State(q, -q, memory={"strain": 1.0 + q}).with_memory({"pressure.queue": queue, **more})


def test_environments_are_chosen_from_two_states_repeated_and_selected():
    """What a state lacks is zero there, and its past is its present."""
    more = {"base": torch.ones(2, 2, 6), "left": torch.tensor([True, True])}
    first, still = moved(2, **more), torch.zeros(2, 2, 3).double()
    second = State(still + 5.0, still, (still + 3.0, still)).with_memory(
        {"pressure.queue": torch.zeros(2, 2, 2)}
    )
    mixed = first.where(torch.tensor([True, False]), second)
    for name, joined in mixed.tensors().items():
        assert torch.equal(
            joined[0], {**first.tensors(), "previous_q": first.q, "previous_v": first.v}[name][0]
        )
        assert torch.equal(joined[1], second.tensors().get(name, torch.zeros_like(joined))[1])
    assert mixed.memory_of().keys() == {"pressure.queue", *more}
    assert mixed.left.tolist() == [True, False]
    assert not mixed.lost.any()
    state = moved(2)
    many = state.repeat(3)
    assert (many.batch, len(many.lost)) == (6, 6)
    again = many.select([3, 2])
    for name, values in again.tensors().items():
        assert torch.equal(values, state.tensors()[name].flip(0))


def test_a_table_has_an_empty_cell_where_nothing_was_seen(tmp_path):
    markers = np.arange(12.0).reshape(2, 2, 3)
    markers[1, 1, 2] = np.nan
    columns = input_columns("pressure", ["left"], "Pa", np.array([[5.0]]))
    path = write_csv(tmp_path / "motion.csv", np.array([0.0, 0.1]), ["A", "B"], markers, columns)
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["pressure.left [Pa]"] for row in rows] == ["5", "5"]
    assert (rows[1]["A.x [m]"], rows[1]["B.z [m]"], rows[1]["time [s]"]) == ("6", "", "0.1")


def test_markers_are_interpolated_between_steps():
    """By polynomials of degree three whose slopes are central differences: exact for a parabola."""
    times, wanted = 0.1 * np.arange(5), np.array([0.05, 0.13, 0.37, 0.4])
    rows = torch.arange(6.0, dtype=torch.float64).view(1, 2, 3)

    def at(t):
        t = torch.as_tensor(t)[:, None, None, None]
        return 1.0 + rows * t + 3.0 * t**2

    q = at(times)
    body = Body(box_hexahedra((0.04, 0.01, 0.01), (4, 1, 1)))
    motion = Motion(q, q, State(q[-1], q[-1]), body, 0.1)
    torch.testing.assert_close(motion.at(wanted), at(wanted))
    refuses(InputError, "environment is 1", motion.write_csv, "a.csv", 1)


def test_inputs_are_given_by_part_by_environment_or_for_all():
    body = Body(box_hexahedra((0.04, 0.01, 0.01), (4, 1, 1)))
    pressure = RobotInput(
        "pressure", "Pa", ("left", "right"), quantity=Quantity("pressure", "Pa", 0.0, closed=True)
    )
    reader = InputReader(
        {"pressure": pressure, "payload": RobotInput("payload", "kg", ("payload",))},
        Simulator(body),
    )
    assert reader.read("pressure", {"right": 2.0}, 2).tolist() == [[0.0, 2.0]] * 2
    assert reader.read("pressure", [1.0, 2.0], 2).tolist() == [[1.0, 2.0]] * 2
    assert reader.read("payload", [1.0, 2.0], 2).tolist() == [[1.0], [2.0]]
    assert reader.read("payload", 3.0, 2).tolist() == [[3.0]] * 2
    assert reader.series("pressure", np.zeros((5, 2)), 3).shape == (5, 3, 2)
    assert reader.series("pressure", [1.0, 2.0], 3).shape == (1, 3, 2)
    for wrong in ([-1.0, 0.0], [1.0], [[1.0, 2.0]] * 3, {"middle": 1.0}, [np.inf, 0.0]):
        refuses(InputError, "pressure", reader.read, "pressure", wrong, 2)
