"""Clocks, new processes and tables of the studies."""

import math
import time

import pytest
import torch

from warp_resphys import Inputs
from warp_resphys.dynamics.simulator import Simulator
from warp_resphys.energies.materials import Corotated
from warp_resphys.studies.beam import beam_mesh, clamped
from warp_resphys.studies.tables import Sheet
from warp_resphys.studies.timing import TimedRollout, median_seconds, run_in_new_process, step_time


def test_the_median_is_not_moved_by_one_slow_repeat():
    pauses = iter([0.01, 0.3, 0.01])
    assert 0.01 <= median_seconds(lambda: time.sleep(next(pauses)), 3) < 0.3


def test_a_function_runs_in_a_process_of_its_own():
    imported, result = run_in_new_process(math.factorial, 5)
    assert result == 120
    assert imported > 0.0
    with pytest.raises(RuntimeError, match=r"^factorial"):
        run_in_new_process(math.factorial, -1)
    with pytest.raises(TimeoutError, match=r"more than 0\.5 s"):
        run_in_new_process(time.sleep, 60, timeout=0.5)


def test_a_rollout_is_timed_with_its_gradient():
    body = clamped(beam_mesh("tetrahedron10", (0.02, 0.01, 0.01), (1, 1, 1)))
    simulator = Simulator(body, Corotated(1e5, 0.4))
    timed = TimedRollout(simulator, simulator.rest_state(), 2)
    modulus = torch.tensor([1e5], dtype=torch.float64, requires_grad=True)
    for _ in range(3):
        timed.measure({"youngs_modulus": modulus})
    assert [len(own) for own in timed.durations] == [3, 3, 3]
    assert timed.unknowns == 3 * (27 - 9)
    assert all(0.0 < least <= most for least, most in zip(timed.a_step(min), timed.a_step(max), strict=True))
    cost = step_time(simulator, simulator.rest_state(), [Inputs()] * 2, 1)
    assert cost["iterations"] == timed.iterations
    assert cost["step_ms"] > 0.0


def test_a_table_is_a_template_of_its_lines():
    sheet = Sheet.of("Times", "name {name} | step, ms {time:.1f}", [{"name": "beam", "time": 2.04, "unused": 1}])
    assert (list(sheet.headings), sheet.rows) == (["name", "step, ms"], [["beam", "2.0"]])
    (table,) = sheet.for_page().blocks
    assert (table.head, list(table.columns)) == ("Name", ["Step, ms"])
