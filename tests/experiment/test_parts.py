"""Bodies of several meshes from YAML."""

import numpy as np
import pytest
import torch

from support.configured import check, composed, settings
from warp_resphys.experiment.build import build_body, build_simulator
from warp_resphys.io.errors import InputError

WHOLE = [
    "experiment=beam_oscillation",
    "mesh={kind: box_hexahedra, size: [0.1, 0.03, 0.03], divisions: [10, 2, 2]}",
    "simulation.poissons_ratio=0.45",
]
FREE_CUBE = (
    "parts={cube: {mesh: {kind: box_hexahedra, size: [0.02, 0.02, 0.02], divisions: [2, 2, 2]}, shift: [0.3, 0, 0]}}"
)


def simulator(*overrides):
    run = settings(*overrides)
    return build_simulator(run, run.simulation)


def test_a_part_has_its_own_material_and_may_be_rigid():
    soft = simulator(*WHOLE, FREE_CUBE, "simulation.regions={body: {}, cube: {youngs_modulus: 50e3}}")
    assert {"body_youngs_modulus", "cube_youngs_modulus"} <= set(soft.parameters)
    rigid = simulator(*WHOLE, FREE_CUBE, "rigid={cube: {density: 1240}}", "integrator=bdf2")
    assert len(rigid.body.coordinates.dependent) == 27 - 4


def test_a_second_body_falls_freely_beside_the_first():
    built = simulator(*WHOLE, FREE_CUBE, "integrator=implicit_euler")
    cube = np.unique(built.body.mesh.cells[built.body.mesh.region("cube")])
    moved = built.rollout(built.rest_state(), 10).q[:, 0, cube, 2]
    wanted = -9.80709 * built.time_step**2 * np.arange(11) * np.arange(1, 12) / 2.0  # by implicit Euler
    torch.testing.assert_close(moved - moved[0], torch.as_tensor(wanted)[:, None].expand(-1, len(cube)))


def test_a_run_accepts_them():
    check(composed(*WHOLE, FREE_CUBE))


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("parts.cube.mesh.kind=box_tetrahedra", "cannot be joined"),
        ("parts.cube.shift=[0,0]", "parts.cube.shift"),
        ("parts={body: {mesh: {kind: box_hexahedra, size: [1, 1, 1], divisions: [1, 1, 1]}}}", r"parts\.body"),
        ("regions={cube: {x: [0, 0.05]}}", r"regions\.cube"),
    ],
)
def test_what_does_not_fit_is_named(override, key):
    with pytest.raises(InputError, match=key):
        build_body(settings(*WHOLE, FREE_CUBE, override))
