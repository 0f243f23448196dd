"""Contractile fibres against closed forms, differences, and what cannot contract."""

from dataclasses import replace

import numpy as np
import pytest

from support.clamped import clamped
from support.slopes import check_rows
from warp_resphys import Corotated, InputError, Inputs, Simulator, SolverSettings, box_hexahedra, box_tetrahedra
from warp_resphys.energies.muscles import Muscle, Muscles
from warp_resphys.stepping.integrators import INTEGRATORS
from warp_resphys.studies.gradient_check import POSES, check_gradients

SIZE, MODULUS = (0.12, 0.02, 0.02), 264e3
BEAM = box_hexahedra(SIZE, (6, 2, 2))
MESHES = {"hexahedra": BEAM, "tetrahedra10": box_tetrahedra(SIZE, (4, 2, 2), order=2)}
ALONG = (2.0, 0.0, 0.0)  # of any length
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-11)


def whole(mesh):
    return Muscle(np.arange(len(mesh.cells)), ALONG)


def upper(mesh):
    return Muscle(np.flatnonzero(mesh.vertices[mesh.cells].mean(axis=1)[:, 2] > SIZE[2] / 2), ALONG, "upper")


def simulator(*muscles, mesh=BEAM, ratio=0.0, solver=TIGHT, **more):
    body = clamped(mesh, energies=(Muscles(muscles, **more),))
    return Simulator(body, Corotated(MODULUS, ratio, mass_damping=0.5), gravity=(0.0, 0.0, 0.0), solver=solver)


def stretch(sim, inputs):
    """Of the whole bar along x, and how far its vertices are from a uniform one [m]."""
    q = sim.static_equilibrium(inputs).q[0].numpy()
    ratio = q[:, 0].max() / SIZE[0]
    return ratio, np.abs(q[:, 0] - ratio * sim.body.mesh.vertices[:, 0]).max()


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())
def test_a_bar_shortens_by_stress_over_modulus(mesh):
    """Corotated, nu = 0: P = E (lambda - 1) + sigma = 0 along the bar, at any strain."""
    ratio, off = stretch(simulator(whole(mesh), mesh=mesh), Inputs(muscle_stress=0.2 * MODULUS))
    assert ratio == pytest.approx(0.8, abs=1e-9)
    assert off < 1e-9


def test_a_contraction_shares_the_strain_with_the_solid():
    """E (lambda - 1) + k (lambda - 1 + c - toe / 2) = 0 past the toe."""
    k, c, toe = 3.0 * MODULUS, 0.1, 1e-3
    sim = simulator(whole(BEAM), stiffness=k, toe=toe)
    ratio, off = stretch(sim, Inputs(muscle_contraction=c))
    assert ratio == pytest.approx(1.0 - k * (c - 0.5 * toe) / (MODULUS + k), abs=1e-9)
    assert off < 1e-9
    slack, _ = stretch(sim, Inputs(muscle_contraction=-0.1))
    assert slack == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(("integrator", "start"), [*zip(INTEGRATORS, POSES, strict=True)])
def test_gradients(start, integrator):
    solver = SolverSettings(relative_tolerance=1e-11, linear_solver="banded")
    slanted = Muscle(np.arange(8), np.random.default_rng(0).normal(size=(8, 3)))
    sim = simulator(upper(BEAM), slanted, ratio=0.45, stiffness=np.array([4e5, 9e5]), toe=1.0, solver=solver)
    material = replace(sim.material, stiffness_damping=1e-3)
    sim = replace(sim, material=material, integrator=integrator, gravity=(0.0, 0.0, -9.8))
    names = "muscle_stress", "muscle_contraction", "muscle_stiffness, each muscle"
    check_rows(check_gradients(sim, start), *names)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Muscles([]), "there is no muscle"),
        (lambda: Muscles([Muscle([], ALONG)]), "'muscle_1'"),
        (lambda: Muscles([Muscle([0.5], ALONG)]), "give the numbers of one or more"),
        (lambda: Muscles([Muscle([0, 1], np.ones((3, 3)), "left")]), "'left' has directions of shape (3, 3)"),
        (lambda: Muscles([Muscle([0], (0.0, 0.0, 0.0))]), "has a direction that is zero or not finite"),
        (lambda: Muscles([replace(whole(BEAM), name="a")] * 2), "muscles are called a, a"),
        (lambda: Muscles([whole(BEAM)], stiffness=-1.0), "muscle_stiffness is"),
        (lambda: Muscles([whole(BEAM)], toe=0.0), "the strain over which muscle fibres tighten is 0"),
        (lambda: simulator(Muscle([99], ALONG)), "runs through cell 99, but there are 24"),
    ],
)
def test_what_cannot_contract_is_refused(make, said):
    with pytest.raises(InputError) as caught:
        make()
    assert said in str(caught.value)
