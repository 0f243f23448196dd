"""The simulation that plays the real body: its own mesh, steps and actuators,
and the trials that a budget picks.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from support.configured import check, composed, settings
from warp_resphys import (
    Body,
    InputError,
    Inputs,
    Muscles,
    Simulator,
    box_hexahedra,
    box_tetrahedra,
    select_vertices,
)
from warp_resphys.data.base_motion import rigid
from warp_resphys.data.trials import Trials
from warp_resphys.energies import Muscle, make_material
from warp_resphys.experiment.ablation import generate_motion, read_motion
from warp_resphys.experiment.build import build_body, build_simulator
from warp_resphys.experiment.files import DATASET
from warp_resphys.experiment.simulate import simulate, vertices_in
from warp_resphys.experiment.splits import split_of, trials_of
from warp_resphys.io.resuming import StageContext
from warp_resphys.io.settings import parse
from warp_resphys.pipeline import acquisition_stages
from warp_resphys.settings.run import RunSettings
from warp_resphys.settings.stage_keys import SIMULATOR, StageSettings

SIZE = (0.1, 0.03, 0.03)
OWN = (
    "target.mesh={kind:box_hexahedra,size:[0.1,0.03,0.03],divisions:[8,4,4]}",
    "target.time_step=0.005",
    "target.integrator=bdf2",
    "target.material={model:stable_neo_hookean,youngs_modulus:264e3,poissons_ratio:0.45,"
    "density:1070.0}",
    "target.muscles={bundles:{along:{direction:[1,0,0]}},stiffness:80e3,toe:0.02}",
)
COARSE = ("mesh={kind:box_hexahedra,size:[0.1,0.03,0.03],divisions:[4,2,2]}", "data.steps=3")


def test_keys_that_are_left_out_are_those_of_the_simulator_and_a_law_is_a_model_as_any_other():
    run = settings("experiment=beam_oscillation", "integrator=bdf2", "time_step=0.02")
    target = run.target
    parameters = target.material.values  # directly in the group, as beam_oscillation has them
    assert [*parameters] == [
        "youngs_modulus",
        "poissons_ratio",
        "density",
        "mass_damping",
        "stiffness_damping",
    ]
    assert parameters["youngs_modulus"] == 264e3
    assert (target.mesh, target.integrator, target.time_step) == (run.mesh, "bdf2", 0.02)

    bare = settings("target=null", "target={integrator: midpoint}").target
    assert (bare.material, bare.integrator) == (run.simulation, "midpoint")
    fibres = settings("experiment=sopra_fibres", "~laboratory.fibres")
    assert fibres.laboratory.fibres == fibres.fibres != None  # noqa: E711
    assert settings("experiment=sopra_fibres", "laboratory.fibres=null").laboratory.fibres is None
    out = [
        "~law",
        *(
            f"~simulation.{name}"
            for name in ("youngs_modulus", "poissons_ratio", "stiffness_damping")
        ),
    ]
    law = "simulation={model:law,c10:40e3,bulk_1:2e6,ogden_m3:5e3,shear_viscosity:20.0}"
    run = settings(*COARSE, *out, law)
    material = build_simulator(run, run.simulation).materials[""]
    assert (material.ogden, material.shear_viscosity, material.density) == ({-3: 5e3}, 20.0, 1070.0)
    with pytest.raises(
        InputError, match="simulation: fibres has fibre_tension_1: give each family"
    ):
        check(composed(*COARSE, *out, law.replace("}", ",fibre_tension_1:1e3}")))


@pytest.mark.parametrize(
    ("mesh", "degree"),
    [(box_hexahedra(SIZE, (3, 1, 2), 27), 2), (box_tetrahedra(SIZE, (3, 1, 2)), 1)],
)
def test_fields_of_the_degree_of_the_cells_are_interpolated_exactly(mesh, degree):
    other = box_hexahedra(SIZE, (5, 3, 3)).vertices
    powers = [
        (i, j, k) for i in range(3) for j in range(3) for k in range(3) if i + j + k <= degree
    ]
    shape = np.random.default_rng(0).normal(size=(len(powers), 3))

    def field(x):
        monomials = [np.prod((x / 0.1) ** power, axis=1)[:, None] for power in powers]
        return sum(m * c for m, c in zip(monomials, shape, strict=True))

    seen = vertices_in(mesh, box_hexahedra(SIZE, (5, 3, 3)))
    values = torch.as_tensor(np.stack([field(mesh.vertices), 2.0 * field(mesh.vertices)]))
    np.testing.assert_allclose(
        seen(values), np.stack([field(other), 2.0 * field(other)]), atol=1e-12
    )


def simulated(folder, *overrides):
    """The dataset of an experiment with simulated data, and its stage's settings."""
    run = settings(*overrides)
    (stage,) = acquisition_stages(run)
    simulate(StageContext("simulate", Path(folder), "fingerprint", stage.settings))
    return Trials.read(Path(folder) / DATASET), run


def by_hand(weight, steps):
    """Motion of the target of `OWN` at every one of its steps, (T + 1, N, 3) positions and
    velocities.
    """
    mesh = box_hexahedra(SIZE, (8, 4, 4))
    muscles = Muscles([Muscle(np.arange(len(mesh.cells)), (1.0, 0.0, 0.0))], 80e3, toe=0.02)
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0), energies=(muscles,))
    material = make_material(
        "stable_neo_hookean", youngs_modulus=264e3, poissons_ratio=0.45, density=1070.0
    )
    simulator = Simulator(
        body, material, time_step=0.005, gravity=(0.0, 0.0, -9.80709), integrator="bdf2"
    )
    face = select_vertices(mesh, x=0.1)
    force = torch.zeros(1, len(mesh.vertices), 3, dtype=torch.float64)
    force[:, face, 2] = -9.80709 * weight / len(face)
    with torch.no_grad():
        moved = simulator.rollout(simulator.static_equilibrium(Inputs(force)), steps)
    return mesh, moved.q[:, 0].numpy(), moved.v[:, 0].numpy()


def test_the_data_are_the_motion_of_the_target_at_the_simulators_vertices_and_steps(tmp_path):
    weights = "data.weights_g={train:[100],validation:[150],test:[200]}"
    dataset, run = simulated(tmp_path, *COARSE, *OWN, weights)
    mesh, q, v = by_hand(0.2, 6)
    vertices = build_body(run).mesh.vertices
    # The meshes are nested.
    at = [int(np.argmin(np.linalg.norm(mesh.vertices - x, axis=1))) for x in vertices]
    np.testing.assert_allclose(dataset.observed[2], q[::2, at], atol=1e-8)
    np.testing.assert_allclose(dataset.velocity[2], v[::2, at], atol=1e-5)
    assert np.abs(np.diff(dataset.observed[2], axis=0)).max(axis=(1, 2)).min() > 1e-3
    assert (dataset.time_step, dataset.times[2, -1]) == (0.01, pytest.approx(0.03))
    run = settings(
        "experiment=marker_ablation",
        *COARSE,
        *OWN,
        "data.weights_g.observed=[200]",
        "ablation.counts=[4]",
    )
    own = StageSettings.reading(run, *SIMULATOR, "target", "simulation", "data")
    generate_motion(StageContext("generate", tmp_path, "fingerprint", own))
    seen, uncorrected = read_motion(tmp_path)
    np.testing.assert_allclose(seen, q[::2, at], atol=1e-8)
    np.testing.assert_allclose(uncorrected[0], seen[0], atol=1e-15)


def test_the_base_moves_in_the_steps_of_the_target(tmp_path):
    swing = "{frequency:5.0,translation:[0,0,0.004],rotation:[0,0.1,0]}"
    data = ("data.kind=moving_base", "data.steps=4", f"data.base_motion={{swings:{{a:{swing}}}}}")
    data += ("data.amplitudes={train:[1.0],validation:[1.5],test:[2.0]}",)
    gone = ("~law", "~data.load", "~data.weights_g", "~data.others")
    dataset, run = simulated(tmp_path, COARSE[0], *OWN[:3], *gone, *data)
    body = build_body(run)
    clamp = body.mesh.vertices[body.fixed_vertices]
    for row in range(3):
        moved = rigid(dataset.base[row]).apply(np.broadcast_to(clamp, (5, *clamp.shape)))
        np.testing.assert_allclose(
            dataset.observed[row][1:, body.fixed_vertices], moved[1:], atol=1e-12
        )
    assert np.abs(dataset.base[2, 1:]).max() > 1e-3


@pytest.mark.parametrize(
    ("key", "value"), [("time_step", -1.0), ("mesh", {"kind": "rod"}), ("muscles", {"bundle": {}})]
)
def test_a_wrong_value_of_the_simulator_is_not_blamed_on_its_target(key, value):
    plain = composed()
    plain["target"] = plain["target"]["material"]
    with pytest.raises(InputError, match=f"^(unknown key ')?{key}"):
        parse(RunSettings, {**plain, key: value})


ANGLES = {"train": (40, 80, 120, 160), "validation": (100,), "test": (60, 140)}  # degrees
TWISTED = [
    "experiment=beam_twist",
    "mesh.divisions=[4,2,2]",
    "data.steps=12",
    *(
        f"data.angles_deg.{split}={list(angles)}".replace(" ", "")
        for split, angles in ANGLES.items()
    ),
]


def test_the_beam_is_let_go_from_cross_sections_turned_rigidly_by_the_configured_angles(tmp_path):
    rest = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2)).vertices
    dataset, _ = simulated(tmp_path, *TWISTED)
    q = dataset.observed
    angles = [angle for split in ANGLES.values() for angle in split]
    assert list(dataset.names) == [f"{angle}°" for angle in angles]
    assert not dataset.velocity[:, 0].any()
    centre = np.array([0.0, 0.015, 0.015])
    for angle, start in zip(angles, q[:, 0], strict=True):
        for x in np.unique(rest[:, 0]):
            section = rest[:, 0] == x
            # Right-handed about x.
            turn = Rotation.from_rotvec([angle * x / 0.1, 0.0, 0.0], degrees=True)
            np.testing.assert_allclose(
                start[section], centre + turn.apply(rest[section] - centre), atol=1e-15
            )
    clamp = rest[:, 0] == 0.0
    np.testing.assert_array_equal(
        q[:, :, clamp], np.broadcast_to(rest[clamp], q[:, :, clamp].shape)
    )
    assert np.abs(q[:, -1] - q[:, 0]).max((1, 2)).min() > 1e-3  # every beam swings back


@pytest.mark.parametrize(
    ("experiment", "unit", "factor"),
    [(["experiment=beam_twist"], "°", np.pi / 180.0), (["~data.others"], " g", 1e-3)],
)
def test_the_quick_budget_picks_evenly(experiment, unit, factor):
    runs = [settings(*experiment, f"budget={budget}") for budget in ("full", "quick")]
    full, quick = (run.data for run in runs)
    assert full.limit is None
    assert quick.amounts == full.amounts
    assert quick.steps < full.steps
    whole, split = map(split_of, runs)
    amounts = {trial.name: trial.amount for trial in trials_of(runs[1])}
    assert tuple(amounts) == split.names
    for name, limit in dict(quick.limit).items():
        values, picked = np.array(getattr(full.amounts, name)), getattr(split, name)
        row = [f"{x:g}{unit}" for x in values]
        assert list(getattr(whole, name)) == row
        places = [row.index(one) for one in picked]
        assert len(picked) == limit < len(row)
        assert limit == 1 or [places[0], places[-1]] == [0, len(row) - 1]
        # Strides differ by one at most.
        assert limit == 1 or np.ptp(np.diff(places)) <= 1 <= np.diff(places).min()
        np.testing.assert_allclose([amounts[one] for one in picked], factor * values[places])
