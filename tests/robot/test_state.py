"""States and motions of robots, without a robot."""

import csv

import numpy as np
import torch

from warp_resphys.mesh.motion_files import input_columns, write_csv
from warp_resphys.robot.state import RobotState
from warp_resphys.stepping.state import State


def moved(batch, **more):
    q = torch.arange(6.0 * batch, dtype=torch.float64).reshape(batch, 2, 3)
    memory = {"pressure.queue": 2.0 + torch.arange(4.0 * batch).reshape(2, batch, 2)}
    return RobotState(State(q, -q), memory, **more)


def test_environments_are_chosen_from_two_states():
    flags = torch.tensor([True, True])
    first = moved(2, hidden=torch.ones(2, 4), base=torch.ones(2, 2, 6), left=flags)
    second = RobotState(
        State(torch.zeros(2, 2, 3).double(), torch.zeros(2, 2, 3).double()), {"pressure.queue": torch.zeros(2, 2, 2)}
    )
    mixed = first.where(torch.tensor([True, False]), second)
    for name in ("q", "v", "hidden", "left"):
        joined, wanted = getattr(mixed, name), getattr(first, name)
        assert torch.equal(joined[0], wanted[0])
        assert not joined[1].any()
    assert torch.equal(mixed.base[:, 0], first.base[:, 0])
    assert not mixed.base[:, 1].any()
    assert torch.equal(mixed.memory["pressure.queue"][:, 0], first.memory["pressure.queue"][:, 0])
    assert not mixed.memory["pressure.queue"][:, 1].any()
    assert not mixed.lost.any()


def test_environments_are_repeated_and_selected():
    state = moved(2)
    many = state.repeat(3)
    assert (many.batch, len(many.lost)) == (6, 6)
    again = many.select([3, 2])
    assert torch.equal(again.q, state.q.flip(0))
    assert torch.equal(again.memory["pressure.queue"], state.memory["pressure.queue"].flip(1))


def test_a_table_has_an_empty_cell_where_nothing_was_seen(tmp_path):
    markers = np.arange(12.0).reshape(2, 2, 3)
    markers[1, 1, 2] = np.nan
    columns = input_columns("pressure", ["left"], "Pa", np.array([[5.0]]))
    path = write_csv(tmp_path / "motion.csv", np.array([0.0, 0.1]), ["A", "B"], markers, columns)
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["pressure.left [Pa]"] for row in rows] == ["5", "5"]
    assert (rows[1]["A.x [m]"], rows[1]["B.z [m]"], rows[1]["time [s]"]) == ("6", "", "0.1")
