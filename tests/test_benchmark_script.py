"""The script that times the simulator, on the smallest bodies."""

import benchmark
import pytest
from benchmarks import measuring, peers, steps

from warp_resphys.io.safe_files import read_json

TINY = ("mesh.divisions=[2,1,1]", "--repeats=1", "--materials=0.45")


@pytest.fixture
def measured(folder):
    """Runs a subcommand, and returns what the file of the machine has of it."""

    def run(*words):
        assert benchmark.main(words) == 0
        (written,) = (folder / "outputs/benchmark").glob("*.json")
        return read_json(written)[words[0]]

    return run


def test_the_median_of_every_figure_over_turns():
    figures = iter([1.0, 10.0, 3.0, 30.0, 2.0, 90.0])

    def task():
        return {"ms": next(figures)}

    (one, ten), yardstick = measuring.take_turns("turns", [task, task], 3)
    assert (one, ten) == ({"ms": 2.0}, {"ms": 30.0})
    assert yardstick > 0.0


def test_a_row_for_every_case(measured, capsys, device):
    result = measured("step", *TINY, "--steps=2", f"--device={device}")
    rows = result[steps.STEPS]
    assert [row["solver"] for row in rows] == ["quasi_newton", "newton"]
    for row in rows:
        assert (row["batch"], row["unknowns"]) == (1, 24)
        assert row["steps_per_s"] == pytest.approx(1e3 / row["plain_ms"])
        assert row["yardsticks"] == pytest.approx(
            (row["forward_ms"] + row["backward_ms"]) / result["yardstick_ms"]
        )
        assert row["factorisations"] >= row["iterations"] >= 1.0 or row["solver"] == "quasi_newton"
    assert f"{rows[0]['plain_ms']:.4g}" in capsys.readouterr().out
    parts = result["parts of an iteration"]
    assert len(parts) == len(rows)
    assert all(
        part[f"{name}_ms"] > 0.0
        for part in parts
        for name in ("local_step", "assembly", "factor", "solve")
    )
    # A batch, in the same file.
    (row,) = measured("batches", *TINY, "--steps=1", "--batches=3", f"--device={device}")[
        steps.STEPS
    ]
    assert row["steps_per_s"] == pytest.approx(3e3 / row["plain_ms"])
    assert measured("batches", *TINY, "--steps=1", "--batches=1", "--floor")["command"].endswith(
        "--floor"
    )


def test_sizes(measured):
    rows = measured("sizes", *TINY, "--refinements", "1", "2", "--linear-solvers", "banded")[
        "a step by size"
    ]
    assert [(row["linear_solver"], row["unknowns"]) for row in rows] == [
        ("banded", 24),
        ("banded", 108),
    ]
    assert all(row["memory_gib"] > 0.0 for row in rows)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("step", "mash.divisions=[2,1,1]"), "unknown key 'mash'"),
        (("step", "--device=tpu"), "device is 'tpu'"),
        (("twin", "nowhere"), "nowhere"),
    ],
)
def test_an_error_is_a_sentence(words, sentence, folder, capsys):
    assert benchmark.main(words) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert sentence in said


@pytest.mark.parametrize(
    "words", [("step", "beam"), ("step", "--colour=red"), ("gripper", "fingers=2"), ("fly",)]
)
def test_an_unknown_word_is_refused(words, capsys):
    with pytest.raises(SystemExit):
        benchmark.main(words)
    assert words[-1] in capsys.readouterr().err


def test_a_twin_follows_the_trials_of_a_run(finished, measured, capsys):
    run = str(finished[0])
    ((row,),) = [
        rows
        for rows in measured("twin", run, "horizon=0.02", "--trials", "150 g").values()
        if isinstance(rows, list)
    ]
    assert row["trial"] == "150 g"
    assert row["predictions"] > 0
    assert 0.0 < row["estimate_ms"] <= row["p99_ms"]
    assert row["twin_mm"] < row["held_mm"]
    assert benchmark.main(("twin", run, "--trials", "175")) == 2
    assert "--trials names '175'" in capsys.readouterr().err
    assert benchmark.main(("twin", run, "engine=half")) == 2
    assert "engine is 'half'" in capsys.readouterr().err


def test_a_step_without_its_reaction(measured):
    words = ("mesh.divisions=[2,1,1]", "--bodies=beam", "--steps=2", "--repeats=1")
    (row,) = measured("reactions", *words)["a step with the reaction"]
    assert (row["body"], row["unknowns"], row["fixed_vertices"]) == ("beam", 24, 4)
    times = {f"{name}_ms" for name in ("plain", "forward", "gradient", "backward_of_reactions")}
    assert all(row[name] > 0.0 for name in times)
    assert {name for name in row if name.endswith("cost_percent")} == {
        f"{name}_cost_percent"
        for name in ("plain", "forward", "gradient")  # steps without have no reactions
    }


@pytest.mark.slow
def test_all_grippers_hold_the_ball_and_nothing_crosses(measured):
    result = measured("gripper", "--batches=2", "--repeats=1")
    (row,) = result["a step of 10 ms of all grippers"]
    assert (row["grippers"], row["held"], row["crossings"]) == (2, 2, 0)
    assert row["without_contact_ms"] < row["grasp_ms"]


@pytest.mark.slow
def test_an_arm_costs_little_beside_its_robot(measured):
    pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    result = measured("mounts", "mesh.divisions=[2,1,1]", "--repeats=1", "--substeps", "1", "2")
    rows = result["a step of all robots on arms"]
    assert [(row["arms"], row["substeps"], row["vertices"]) for row in rows] == [
        (1, 1, 12),
        (1, 2, 12),
    ]
    assert all(row["ratio"] == pytest.approx(row["coupled_ms"] / row["alone_ms"]) for row in rows)


class TestPeers:
    @pytest.mark.parametrize(
        ("error", "said"), [(1e-1, "1"), (1e-3, "2"), (6e-5, "2"), (1e-6, "-")]
    )
    def test_the_least_time_with_no_more_error(self, error, said):
        times = ((1.0, 1e-2), (3.0, 1e-4), (2.0, 5e-5))
        rows = [
            {"program": peers.OURS, "load": load, "error_mm": error_mm} for load, error_mm in times
        ]
        assert peers.at_equal_error({"program": "newton", "error_mm": error}, rows) == said
        assert peers.at_equal_error(rows[0], rows) == ""

    @pytest.mark.slow
    @pytest.mark.parametrize("program", ["newton", "mujoco"])
    def test_all_approach_coulombs_law_and_rigid_walls(self, program, measured, monkeypatch):
        pytest.importorskip(program)
        last = {
            peers.OURS: [(4e-3, 1e-3, 1e-4), (1e-3, 1e-4, 1e-4)],
            program: peers.SETTINGS[program][-1:],
        }
        monkeypatch.setattr(peers, "SETTINGS", last)
        result = measured(
            "peers", "--divisions", "4", "3", "2", "--repeats=1", f"--programs={program}"
        )
        for name, ours, theirs in (("slide", 1.0, 3.0), ("grip", 0.2, 0.1)):
            coarse, fine, peer = result[name]
            assert fine["error_mm"] < min(0.4 * coarse["error_mm"], ours), name
            assert coarse["penetration_um"] == fine["penetration_um"] == 0.0
            assert coarse["load"] == pytest.approx(coarse["time_ms"] / 4.0)
            assert peer["error_mm"] < theirs
            assert peer["penetration_um"] > 0.0

    def test_one_that_is_not_installed(self, capsys, monkeypatch):
        monkeypatch.setattr(
            peers, "import_module", lambda name: (_ for _ in ()).throw(ModuleNotFoundError(name))
        )
        assert benchmark.main(("peers", "--programs=newton")) == 2
        assert "pip install 'warp-resphys[peer]'" in capsys.readouterr().err
