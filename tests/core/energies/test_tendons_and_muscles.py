"""Tendons and contractile fibres against closed forms,
differences, and what cannot be routed or contract.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.clamped import clamped
from support.slopes import check_rows
from warp_resphys import (
    Corotated,
    Inputs,
    Simulator,
    SolverSettings,
    Tendons,
    box_hexahedra,
    box_tetrahedra,
)
from warp_resphys.core.dynamics.gradient_check import POSES, check_gradients
from warp_resphys.core.energies.muscles import Muscle, Muscles
from warp_resphys.core.energies.route import Route
from warp_resphys.core.stepping.integrators import INTEGRATORS
from warp_resphys.io.errors import InputError

SIZE, DIVISIONS = (0.12, 0.02, 0.02), (6, 2, 2)
BEAM = box_hexahedra(SIZE, DIVISIONS)
SOFT = Corotated(264e3, 0.45, mass_damping=0.5)
WEIGHTLESS = (0.0, 0.0, 0.0)
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-11)


def route(height, count=7, depth=SIZE[1] / 2, length=SIZE[0]):
    x = np.linspace(0.0, length, count)
    return np.column_stack([x, np.full(count, depth), np.full(count, height)])


def simulator(*routes, mesh=BEAM, material=SOFT, solver=TIGHT, **more):
    return Simulator(
        clamped(mesh, energies=(Tendons(routes, **more),)),
        material,
        gravity=WEIGHTLESS,
        solver=solver,
    )


def test_an_offset_tendon_bends_a_beam_to_a_constant_curvature():
    """M = T e along the beam: for small T the curvature is T e / (E I),
    the compression T / (E A).
    """
    mesh = box_hexahedra((0.2, 0.01, 0.01), (20, 2, 2), nodes=27)
    offset, pull, modulus = 0.003, 0.1, 264e3
    material = Corotated(modulus, 0.0)
    sim = simulator(route(0.005 + offset, 41, 0.005, 0.2), mesh=mesh, material=material)
    q = sim.static_equilibrium(Inputs(tendon_tension=pull)).q[0].numpy()
    middle = [
        int(np.argmin(np.linalg.norm(mesh.vertices - [x, 0.005, 0.005], axis=1)))
        for x in (0.1, 0.2)
    ]
    bend = pull * offset / (modulus * 0.01**4 / 12)
    angle, shortening = bend * 0.2, 1.0 - pull / (modulus * 1e-4)
    assert angle > 0.2  # no small rotation
    for vertex, x in zip(middle, (0.1, 0.2), strict=True):
        expected = [
            math.sin(bend * x) / bend * shortening,
            0.005,
            0.005 + (1.0 - math.cos(bend * x)) / bend,
        ]
        np.testing.assert_allclose(q[vertex], expected, atol=0.02 * abs(expected[2] - 0.005))


@pytest.mark.parametrize(
    ("solver", "linear"),
    [("newton", "dense"), ("quasi_newton", "banded"), ("projective_dynamics", "sparse")],
)
def test_a_winch_shortens_a_stiff_tendon_by_what_it_takes_in(solver, linear):
    settings = SolverSettings(name=solver, relative_tolerance=1e-9, linear_solver=linear)
    sim = simulator(route(0.018), stiffness=2e4, solver=settings)
    assert bool(sim.step(sim.rest_state(), Inputs(tendon_contraction=2e-3)).converged.all())
    q = sim.static_equilibrium(Inputs(tendon_contraction=2e-3)).q[0].numpy()
    (points,) = sim.body.energy_points[0]
    pieces = np.einsum("pki,pk->pi", q[points.nodes], points.gradients[:, 0, :, 0])
    pulled = float(np.linalg.norm(pieces, axis=1).sum())
    assert SIZE[0] - 2e-3 < pulled < SIZE[0] - 1.8e-3
    # One that is let out is slack, and does nothing.
    slack = sim.static_equilibrium(Inputs(tendon_contraction=-2e-3)).q
    torch.testing.assert_close(slack[0], sim.rest_positions, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    "kind", [box_hexahedra(SIZE, DIVISIONS), box_tetrahedra(SIZE, (4, 1, 1), order=2)]
)
def test_guides_are_where_they_were_put(kind):
    """Also between the vertices, and where the body's surface bounds them."""
    places = np.array([[0.001, 0.003, 0.0171], [0.0433, 0.01, 0.02], [0.118, 0.0199, 0.0001]])
    (points,) = Tendons([places]).points(kind)
    segments = np.einsum("pki,pk->pi", kind.vertices[points.nodes], points.gradients[:, 0, :, 0])
    np.testing.assert_allclose(segments, np.diff(places, axis=0), atol=1e-12)


ACROSS = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]  # a beam's tendons


@pytest.mark.parametrize(
    ("solver", "offset"), [("quasi_newton", (5e-3, 0.0)), ("projective_dynamics", (0.0, 5e-3))]
)
def test_a_tendon_that_is_off_is_one_that_was_routed_there(solver, offset):
    """In a beam's cells shape functions are linear along each axis:
    an offset along one is exact.
    """
    settings = SolverSettings(name=solver, relative_tolerance=1e-10)
    tapering = (
        np.linspace([0.0, 1.0, 0.0], [0.0, 0.2, 0.0], 7),
        np.linspace([0.0, 0.0, 0.1], [0.0, 0.0, 1.0], 7),
    )
    drive = Inputs(tendon_tension=0.5, tendon_contraction=4e-3)
    off = Route(guides=route(0.013, depth=0.013), offsets=[way.tolist() for way in tapering])
    tendons = Tendons([off], stiffness=2000.0)
    sims = [
        Simulator(clamped(BEAM, energies=(own,)), SOFT, gravity=WEIGHTLESS, solver=settings)
        for own in (tendons, tendons.rerouted([offset]))
    ]
    given = {f"tendon_offset_{number}": value for number, value in enumerate(offset, 1)}
    q, expected = (
        sim.step(sim.rest_state(), drive, its).q
        for sim, its in zip(sims, (given, None), strict=True)
    )
    torch.testing.assert_close(q, expected, rtol=0.0, atol=1e-9)
    assert float((expected - sims[0].rest_positions).abs().max()) > 1e-3
    assert float((sims[0].step(sims[0].rest_state(), drive).q - expected).abs().max()) > 1e-4


@pytest.mark.parametrize(
    ("integrator", "start", "poissons_ratio"),
    [*zip(INTEGRATORS, POSES, (0.45, 0.45, 0.499), strict=True)],
)
def test_gradients(start, integrator, poissons_ratio):
    """With a winch and a commanded tension at once, and by where tendons run."""
    solver = SolverSettings(relative_tolerance=1e-11, linear_solver="banded")
    turning = np.linspace([0.0, 1.0, 0.2], [0.0, -0.5, 1.0], 7)
    low = Route(guides=route(0.006, depth=0.004), offsets=[turning.tolist(), [0.3, 0.0, 1.0]])
    routes, stiffness = (Route(guides=route(0.018), offsets=ACROSS), low), np.array([400.0, 900.0])
    material = replace(SOFT, poissons_ratio=poissons_ratio, stiffness_damping=1e-3)
    sim = simulator(*routes, stiffness=stiffness, solver=solver, material=material)
    sim = replace(sim, integrator=integrator, gravity=(0.0, 0.0, -9.8))
    names = "tendon_tension", "tendon_contraction", "tendon_offset_1"
    each = (f"tendon_{name}, each tendon" for name in ("stiffness", "offset_1", "offset_2"))
    check_rows(check_gradients(sim, start), *names, *each)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Tendons([]), "there is no tendon"),
        (
            lambda: Tendons([[[0.0, 0.0, 0.0]]]),
            "tendon_1.guides is [[0.0, 0.0, 0.0]]: it must be a list of two or more",
        ),
        (lambda: Tendons([route(0.01), np.full((2, 3), np.nan)]), "tendon_2.guides is [[nan"),
        (
            lambda: Tendons([route(0.01)[[0, 1, 1]]]),
            "tendon_1.guides has two in a row at one place",
        ),
        (lambda: Tendons([route(0.01)], stiffness=-1.0), "tendon_stiffness is"),
        (lambda: Tendons([route(0.01)], toe=0.0), "the toe of tendons is 0"),
        (
            lambda: Tendons([route(0.01), Route(guides=route(0.02), offsets=ACROSS)]),
            "the tendons have [0, 2] directions of offsets",
        ),
        (lambda: Route(guides=route(0.01), offsets=[*ACROSS, ACROSS[0]]), "Route.offsets is"),
        (lambda: Route(guides=route(0.01), offsets=["up"]), "Route.offsets is ['up']"),
        (lambda: Route(guides=route(0.01), offsets=[[1.0, 0.0]]), "Route.offsets is [[1.0, 0.0]]"),
        (
            lambda: Route(guides=route(0.01), offsets=[ACROSS]),
            "offsets has a direction for 2 guides",
        ),
        (lambda: Route(guides=route(0.01), offsets=[[0.0, 0.0, 0.0]]), "not all zero"),
        (
            lambda: simulator(route(0.018)).static_equilibrium(Inputs(tendon_tension=-1.0)),
            "tendon_tension is",
        ),
        (
            lambda: simulator(route(0.01), route(0.03)),
            "guide 1 of tendon 2, at [0.0, 0.01, 0.03] m, lies 10 mm",
        ),
    ],
)
def test_what_cannot_be_routed_is_refused(make, said):
    with pytest.raises(InputError) as caught:
        make()
    assert said in str(caught.value)


MODULUS = 264e3
MESHES = {"hexahedra": BEAM, "tetrahedra10": box_tetrahedra(SIZE, (4, 2, 2), order=2)}
ALONG = (2.0, 0.0, 0.0)  # of any length


def whole(mesh):
    return Muscle(np.arange(len(mesh.cells)), ALONG)


def upper(mesh):
    return Muscle(
        np.flatnonzero(mesh.vertices[mesh.cells].mean(axis=1)[:, 2] > SIZE[2] / 2), ALONG, "upper"
    )


def contracting(*muscles, mesh=BEAM, ratio=0.0, solver=TIGHT, **more):
    body = clamped(mesh, energies=(Muscles(muscles, **more),))
    return Simulator(
        body, Corotated(MODULUS, ratio, mass_damping=0.5), gravity=(0.0, 0.0, 0.0), solver=solver
    )


def stretch(sim, inputs):
    """Stretch of the whole bar along x, and how far its vertices are from a uniform one [m]."""
    q = sim.static_equilibrium(inputs).q[0].numpy()
    ratio = q[:, 0].max() / SIZE[0]
    return ratio, np.abs(q[:, 0] - ratio * sim.body.mesh.vertices[:, 0]).max()


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())
def test_a_bar_shortens_by_stress_over_modulus(mesh):
    """Corotated, nu = 0: P = E (lambda - 1) + sigma = 0 along the bar, at any strain."""
    ratio, off = stretch(contracting(whole(mesh), mesh=mesh), Inputs(muscle_stress=0.2 * MODULUS))
    assert ratio == pytest.approx(0.8, abs=1e-9)
    assert off < 1e-9


def test_a_contraction_shares_the_strain_with_the_solid():
    """E (lambda - 1) + k (lambda - 1 + c - toe / 2) = 0 past the toe."""
    k, c, toe = 3.0 * MODULUS, 0.1, 1e-3
    sim = contracting(whole(BEAM), stiffness=k, toe=toe)
    ratio, off = stretch(sim, Inputs(muscle_contraction=c))
    assert ratio == pytest.approx(1.0 - k * (c - 0.5 * toe) / (MODULUS + k), abs=1e-9)
    assert off < 1e-9
    slack, _ = stretch(sim, Inputs(muscle_contraction=-0.1))
    assert slack == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(("integrator", "start"), [*zip(INTEGRATORS, POSES, strict=True)])
def test_gradients_of_muscles(start, integrator):
    solver = SolverSettings(relative_tolerance=1e-11, linear_solver="banded")
    slanted = Muscle(np.arange(8), np.random.default_rng(0).normal(size=(8, 3)))
    sim = contracting(
        upper(BEAM), slanted, ratio=0.45, stiffness=np.array([4e5, 9e5]), toe=1.0, solver=solver
    )
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
        (
            lambda: Muscles([Muscle([0, 1], np.ones((3, 3)), "left")]),
            "'left' has directions of shape (3, 3)",
        ),
        (
            lambda: Muscles([Muscle([0], (0.0, 0.0, 0.0))]),
            "has a direction that is zero or not finite",
        ),
        (lambda: Muscles([replace(whole(BEAM), name="a")] * 2), "muscles are called a, a"),
        (lambda: Muscles([whole(BEAM)], stiffness=-1.0), "muscle_stiffness is"),
        (
            lambda: Muscles([whole(BEAM)], toe=0.0),
            "the strain over which muscle fibres tighten is 0",
        ),
        (lambda: contracting(Muscle([99], ALONG)), "runs through cell 99, but there are 24"),
    ],
)
def test_what_cannot_contract_is_refused(make, said):
    with pytest.raises(InputError) as caught:
        make()
    assert said in str(caught.value)
