"""The comparison with another simulator at equal error."""

import importlib.util

import pytest

from support.command_line import outcome, refusal
from warp_resphys.io.files import read_json
from warp_resphys.studies.peers import at_equal_error

TIMES = ((1.0, 1e-2), (3.0, 1e-4), (2.0, 5e-5))
OURS = [{"solver": "quasi_newton", "ms": ms, "error_mm": error} for ms, error in TIMES]


@pytest.mark.parametrize(("error", "said"), [(1e-1, "1"), (1e-3, "2"), (6e-5, "2"), (1e-6, "-")])
def test_the_least_time_with_no_more_error(error, said):
    assert at_equal_error({"solver": "VBD", "error_mm": error}, OURS) == said
    assert at_equal_error({"solver": "quasi_newton", "error_mm": error}, OURS) == ""


@pytest.mark.skipif(importlib.util.find_spec("newton") is None, reason="Newton is not installed: the extra 'peer'")
def test_both_converge_to_their_own_solution(folder):
    small = ["divisions=[4,2,2]", "poissons_ratios=[0.45]", "converged_iterations=400", "repeats=1"]
    steps = ["time_steps=[{size: 0.002, count: 7, iterations: [1,8,64]}]", "tolerances=[1e-2,1e-5,1e-8]"]
    assert "ours at that error" in outcome("benchmark", "peers", *small, *steps).out
    (written,) = folder.rglob("peer_study.json")
    rows = read_json(written)["found"][0]["rows"]
    for solver in ("quasi_newton", "VBD"):
        errors = [row["error_mm"] for row in rows if row["solver"] == solver]
        assert errors == sorted(errors, reverse=True)
        assert errors[-1] < 0.05 * errors[0]
        assert all(row["ms"] > 0.0 for row in rows)


@pytest.mark.skipif(importlib.util.find_spec("newton") is not None, reason="Newton is installed")
def test_without_the_peer(folder):
    assert "pip install 'warp-resphys[peer]'" in outcome("benchmark", "peers").err


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("time_steps=[{size: 0, count: 1, iterations: [1]}]", "time_steps[0].size is 0"),
        ("time_steps=[{size: 0.1, count: 1, iterations: []}]", "time_steps[0].iterations is []"),
        ("tolerances=none", "tolerances is 'none'"),
    ],
)
def test_bad_settings(folder, override, key):
    assert key in refusal("benchmark", "peers", override)
