"""Times of grasps by two fingers."""

from support.command_line import outcome, refusal
from warp_resphys.io.files import read_json


def test_all_grippers_hold_the_ball_and_nothing_crosses(folder):
    out = outcome("benchmark", "gripper", "batches.cpu=[2]", "repeats=1", "tensions=[1.5,1.8]").out
    assert "hold the ball" in out
    (written,) = folder.rglob("gripper_study.json")
    (row,) = read_json(written)["rows"]
    assert (row["batch"], row["held"], row["crossings"]) == (2, 2, 0)
    assert 0.0 < row["free_ms"] < row["grasp_ms"]


def test_a_loose_gripper_drops_it(folder):
    outcome("benchmark", "gripper", "batches.cpu=[1]", "repeats=1", "tensions=[0.3,0.3]")
    (written,) = folder.rglob("gripper_study.json")
    assert read_json(written)["rows"][0]["held"] == 0


def test_bad_settings(folder):
    assert "tensions is [1, -1]" in refusal("benchmark", "gripper", "tensions=[1,-1]")
