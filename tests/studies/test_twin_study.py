"""The study of a twin: times and errors of every trial, and what to rely on."""

import json
import math

import pytest

from support.main_job import end_of
from warp_resphys import cli
from warp_resphys.robot.twin.scores import Disagreement


@pytest.mark.parametrize(
    ("twin", "held", "simulator", "best"),
    [
        (1.0, 2.0, 3.0, "twin"),
        (1.0, 0.5, 3.0, "held"),
        (1.0, 2.0, 0.9, "simulator"),
        (1.0, 2.0, math.nan, "twin"),
    ],
)
def test_the_best_may_be_what_is_simpler(twin, held, simulator, best):
    assert Disagreement(9, twin, held, simulator, 0.9).best == best


def test_a_study_has_a_row_for_a_trial(finished, folder):
    arguments = ("benchmark", "twin", f"run={finished[0]}", "trials=['150 g']", "twin.horizon=0.02")
    code, err = end_of(cli.main, "warp-resphys", *arguments, "hydra.run.dir=study")
    assert code in (0, None), err
    (row,) = json.loads((folder / "study" / "twin.json").read_text())["trials"]
    assert row["trial"] == "150 g"
    assert row["predictions"] > 0
    assert 0.0 < row["ms"] <= row["ms_99"]
    assert row["twin_mm"] < row["held_mm"]
    code, err = end_of(cli.main, "warp-resphys", *arguments[:3], "trials=[none]", "hydra.run.dir=study")
    assert code == 2
    assert "trials names 'none'" in err
    code, err = end_of(cli.main, "warp-resphys", *arguments[:3], "trials=[175]", "hydra.run.dir=study")
    assert "trials names '175'" in err
    assert "'150 g'" in err
    # The beam has no markers, either, but a driven input is what makes another run the right one.
    code, err = end_of(cli.main, "warp-resphys", *arguments, "twin.engine=reduced", "hydra.run.dir=study")
    assert code == 2
    assert "driven by one input" in err
    assert "samples" not in err
