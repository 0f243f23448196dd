"""The command that compares gradients with differences."""

import io

import pytest
from rich.console import Console

from support.command_line import outcome, refusal
from warp_resphys.studies.gradient_check import GradientRow, gradient_sheet

SMALL = ["mesh.divisions=[2,1,1]", "gradcheck.steps=1", "gradcheck.batch=1", "gradcheck.poses=[bent]"]


@pytest.mark.parametrize(
    ("code", "overrides"),
    [
        (0, ["solver=quasi_newton", "gradcheck.poissons_ratios=[0.45]"]),
        (0, ["solver=newton", "experiment=beam_oscillation", "gradcheck.poissons_ratios=[0.499]"]),
        (1, ["gradcheck.poissons_ratios=[0.45]", "gradcheck.tolerance=1e-16"]),
    ],
)
def test_the_exit_code_says_whether_all_errors_are_within_the_tolerance(folder, code, overrides):
    ended = outcome("verify", "gradients", *SMALL, *overrides)
    assert ended.code == code, ended.err
    assert f"nu = {'0.499' if 'solver=newton' in overrides else '0.45'}, bent" in ended.out
    assert "stiffness_damping, each environment" in ended.out
    assert "Largest relative error" in ended.out


def test_rows_beyond_the_tolerance_are_red():
    rows = [GradientRow("E, scalar", 1.0, 1.0 + 1e-9), GradientRow("density", 2.0, 2.1), GradientRow("v", 0.0, 0.0)]
    console = Console(width=100, file=io.StringIO(), color_system="standard", force_terminal=True)
    console.print(gradient_sheet(rows, "nu = 0.45, bent", 1e-6))
    red = [line for line in console.file.getvalue().splitlines() if "\x1b[31m" in line]
    assert len(red) == 2
    assert "density" in red[0]
    assert "4.8e-02" in red[0]
    assert "inf" in red[1]


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("gradcheck.poses=[folded]", "gradcheck.poses"),
        ("gradcheck.steps=2.5", "gradcheck.steps is 2.5"),
        ("gradcheck.seed=-1", "gradcheck.seed is -1"),
        ("gradcheck.poissons_ratios=[]", "gradcheck.poissons_ratios is []"),
        ("gradcheck.mass_damping=0.0", "gradcheck.mass_damping is 0.0"),
        ("dtype=float32", "dtype is 'float32'"),
    ],
)
def test_bad_settings(folder, override, key):
    assert key in refusal("verify", "gradients", override)
