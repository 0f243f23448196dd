"""Bodies of several meshes, glued together, from YAML."""

import numpy as np
import pytest
import torch

from support.configured import check, composed, settings
from warp_resphys.experiment.build import build_body, build_simulator
from warp_resphys.io.errors import InputError

HALVES = [
    "experiment=beam_oscillation",
    "mesh={kind: box_hexahedra, size: [0.05, 0.03, 0.03], divisions: [5, 2, 2]}",
    "parts={tip: {mesh: {kind: box_hexahedra, size: [0.05, 0.03, 0.03], divisions: [5, 3, 3]}, shift: [0.05, 0, 0]}}",
    "glued=[{region: tip, at: {x: 0.05}, to: body}]",
    "simulation.poissons_ratio=0.45",
]
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


def test_halves_that_are_glued_bend_like_one_beam():
    sags = []
    for overrides in (HALVES, WHOLE):
        built = simulator(*overrides)
        z = built.static_equilibrium().q[0, :, 2] - torch.as_tensor(built.body.vertices[:, 2])
        sags.append(float(z.min()))
    assert sags[0] == pytest.approx(sags[1], rel=0.03)
    assert sags[0] < -1e-3
    built = simulator(*HALVES)
    body = built.body
    face = np.flatnonzero(body.vertices[:, 0] == 0.05)
    end = built.static_equilibrium().q[0, face]
    assert len(body.coordinates.dependent) == 16  # the finer side of the interface
    # The nine vertices of the coarser side coincide with none but the corners of the finer one, which stay on them.
    rest = body.vertices[face]
    for i in range(len(face)):
        for k in range(i):
            if np.array_equal(rest[i], rest[k]):
                torch.testing.assert_close(end[i], end[k], rtol=0.0, atol=1e-14)


def test_half_a_beam_behind_a_symmetry_plane_sags_like_the_whole_one():
    half = [*WHOLE[:1], WHOLE[1].replace("0.03, 0.03], divisions: [10, 2, 2]", "0.015, 0.03], divisions: [10, 1, 2]")]
    sags = []
    for overrides in ([*half, *WHOLE[2:], "symmetry={y: 0.015}"], WHOLE):
        built = simulator(*overrides)
        sags.append(float((built.static_equilibrium().q[0, :, 2] - built.rest_positions[:, 2]).min()))
    assert sags[1] < -1e-3
    assert sags[0] == pytest.approx(sags[1], rel=1e-6)


def test_a_region_of_another_mesh_has_its_own_material_and_may_be_rigid():
    soft = [*HALVES, "simulation.regions={body: {}, tip: {youngs_modulus: 50e3}}"]
    assert {"body_youngs_modulus", "tip_youngs_modulus"} <= set(simulator(*soft).parameters)
    rigid = [  # A rigid part is followed; it cannot follow.
        *HALVES[:-2],
        "glued=[{region: body, at: {x: 0.05}, to: tip}]",
        "rigid={tip: {density: 1240}}",
        "integrator=bdf2",
        "simulation.poissons_ratio=0.45",
    ]
    built = simulator(*rigid)
    tip = np.unique(built.body.mesh.cells[built.body.mesh.region("tip")])
    q = built.static_equilibrium().q[0].numpy()
    spread = [np.linalg.norm(x[tip][:, None] - x[tip], axis=-1) for x in (q, built.body.vertices)]
    assert np.abs(spread[0] - spread[1]).max() < 1e-4 * spread[1].max()
    assert np.abs(q - built.body.vertices)[tip].max() > 1e-3


def test_a_second_body_falls_freely_beside_the_first():
    built = simulator(*WHOLE, FREE_CUBE, "integrator=implicit_euler")
    cube = np.unique(built.body.mesh.cells[built.body.mesh.region("cube")])
    moved = built.rollout(built.rest_state(), 10).q[:, 0, cube, 2]
    wanted = -9.80709 * built.time_step**2 * np.arange(11) * np.arange(1, 12) / 2.0  # by implicit Euler
    torch.testing.assert_close(moved - moved[0], torch.as_tensor(wanted)[:, None].expand(-1, len(cube)))


def test_a_run_accepts_them():
    check(composed(*HALVES))


@pytest.mark.parametrize(
    ("override", "key"),
    [
        (
            "parts.tip.mesh.kind=box_tetrahedra",
            "cannot be joined",
        ),
        ("glued=[{region: lid, at: {x: 0.05}, to: body}]", r"glued\[0\]: "),
        ("symmetry={y: 0.5}", "no vertex lies in the symmetry plane"),
        ("glued=[{region: tip, at: {x: 0.0}, to: body}]", r"glued\[0\].at: no vertex of the region 'tip'"),
        ("glued=[{region: tip, at: {x: 0.1}, to: body}]", "farther than the tolerance"),
        ("parts.tip.shift=[0,0]", "parts.tip.shift"),
        ("parts={body: {mesh: {kind: box_hexahedra, size: [1, 1, 1], divisions: [1, 1, 1]}}}", r"parts\.body"),
        ("regions={tip: {x: [0, 0.05]}}", r"regions\.tip"),
        ("glued=[{region: tip, at: {x: 0.05}, to: body}, {region: tip, at: {x: 0.05}, to: body}]", "is glued twice"),
    ],
)
def test_what_does_not_fit_is_named(override, key):
    with pytest.raises(InputError, match=key):
        build_body(settings(*HALVES, override))
