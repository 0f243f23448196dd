"""Half of a symmetric body between symmetry planes moves like the whole one."""

import math

import numpy as np
import pytest

from support.clamped import clamped
from support.slopes import check_rows
from warp_resphys import Body, InputError, Mesh, Rigid, Simulator, SolverSettings, StableNeoHookean, box_hexahedra
from warp_resphys.fem.coordinates import SymmetryPlane
from warp_resphys.studies.gradient_check import POSES, check_gradients

SIZE = (0.1, 0.03, 0.03)
SOFT = StableNeoHookean(264e3, 0.45, mass_damping=0.5, stiffness_damping=1e-3)
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-12)
TURN = 0.4  # about x


def turned(points, angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(points) @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]).T


def beam(half, angle=0.0, rigid=False, stiffness=1e9):
    """A beam of four cells across, or its half y < 15 mm behind a symmetry plane, turned about its axis."""
    size, cells = ((SIZE[0], 0.015, SIZE[2]), (6, 2, 2)) if half else (SIZE, (6, 4, 2))
    mesh = box_hexahedra(size, cells)
    regions = {"cap": np.flatnonzero(mesh.vertices[mesh.cells].mean(1)[:, 0] > 0.08)} if rigid else {}
    mesh = Mesh(turned(mesh.vertices, angle), mesh.cells, regions)
    planes = [SymmetryPlane(turned([0.0, 1.0, 0.0], angle), 0.015)] if half else []
    return clamped(mesh, rigid={"cap": Rigid(density=1200.0, stiffness=stiffness)} if rigid else {}, symmetry=planes)


def simulator(body, angle=0.0, solver=TIGHT, **more):
    gravity = tuple(turned([0.0, 0.0, -9.81], angle))
    return Simulator(body, SOFT, gravity=gravity, solver=solver, integrator="bdf2", **more)


@pytest.mark.parametrize(
    ("solver", "linear", "angle", "rigid"),
    [("newton", "banded", 0.0, False), ("quasi_newton", "auto", TURN, True), ("newton", "sparse", TURN, False)],
)
def test_half_a_beam_swings_like_the_whole_one(solver, linear, angle, rigid):
    settings = SolverSettings(name=solver, relative_tolerance=1e-11, linear_solver=linear)
    half, whole = (beam(side, angle, rigid) for side in (True, False))
    runs = []
    for body in (half, whole):
        sim = simulator(body, angle, settings)
        runs.append(sim.rollout(sim.rest_state(), 12).q[:, 0])
    moved = (runs[1][-1] - runs[1][0]).norm(dim=1).max()
    assert moved > 0.003
    distance = np.linalg.norm(half.vertices[:, None] - whole.vertices[None], axis=2)
    assert distance.min(axis=1).max() < 1e-12
    error = (runs[0] - runs[1][:, distance.argmin(axis=1)]).norm(dim=2).max()
    assert error < 1e-7 * moved


def test_gradients_of_half_a_beam():
    # Differences are less exact by rounding, the stiffer the cap.
    rows = check_gradients(simulator(beam(True, TURN, rigid=True, stiffness=1e6)), POSES[-1])
    check_rows(rows, "q", "v", "external_force", "youngs_modulus", "cap_density, each environment", bound=1e-7)


BOX = box_hexahedra(SIZE, (10, 4, 4))
NAMED = Mesh(BOX.vertices, BOX.cells, {"cap": np.arange(144, 160), "beam": np.arange(144)})


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: SymmetryPlane((0.0, 0.0, 0.0)), "normal"),
        (lambda: SymmetryPlane((0.0, math.nan, 1.0)), "normal"),
        (lambda: Body(BOX, symmetry=[SymmetryPlane((0.0, 1.0, 0.0), 0.5)]), "offset 0.5 m"),
        (
            lambda: Body(
                NAMED, rigid={"cap": Rigid()}, symmetry=[SymmetryPlane((0, 1, 0)), SymmetryPlane((0, 1, 0), 0.03)]
            ),
            "'cap'",
        ),
        (lambda: simulator(beam(True), solver=SolverSettings(name="projective_dynamics")), "projective_dynamics"),
    ],
)
def test_invalid_symmetry_is_refused(make, key):
    with pytest.raises(InputError, match=key):
        make()
