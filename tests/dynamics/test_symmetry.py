"""Half of a symmetric body between symmetry planes moves like the whole one."""

import math

import numpy as np
import pytest
import torch

from warp_resphys import (
    Body,
    Inputs,
    Mesh,
    Rigid,
    Simulator,
    SolverSettings,
    StableNeoHookean,
    box_hexahedra,
    box_tetrahedra,
    select_vertices,
)
from warp_resphys.fem.coordinates import SymmetryPlane
from warp_resphys.io.errors import InputError
from warp_resphys.mesh.mesh import boundary_triangles
from warp_resphys.studies.gradient_check import POSES, check_gradients

SIZE = (0.1, 0.03, 0.03)
SOFT = StableNeoHookean(264e3, 0.45, mass_damping=0.5, stiffness_damping=1e-3)
TIGHT = SolverSettings("newton", relative_tolerance=1e-12)
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
    return Body(
        mesh,
        fixed=select_vertices(mesh, x=0.0),
        rigid={"cap": Rigid(1200.0, stiffness)} if rigid else {},
        symmetry=planes,
    )


def simulator(body, angle=0.0, solver=TIGHT, **more):
    gravity = tuple(turned([0.0, 0.0, -9.81], angle))
    return Simulator(body, SOFT, gravity=gravity, solver=solver, integrator="bdf2", **more)


def shared_vertices(half, whole):
    distance = np.linalg.norm(half.vertices[:, None] - whole.vertices[None], axis=2)
    assert distance.min(axis=1).max() < 1e-12
    return distance.argmin(axis=1)


@pytest.mark.parametrize(("solver", "angle", "rigid"), [("newton", 0.0, False), ("quasi_newton", TURN, True)])
def test_half_a_beam_swings_like_the_whole_one(solver, angle, rigid):
    settings = SolverSettings(solver, relative_tolerance=1e-11)
    half, whole = (beam(side, angle, rigid) for side in (True, False))
    runs = []
    for body in (half, whole):
        sim = simulator(body, angle, settings)
        runs.append(sim.rollout(sim.rest_state(), 12).q[:, 0])
    moved = (runs[1][-1] - runs[1][0]).norm(dim=1).max()
    assert moved > 0.003
    error = (runs[0] - runs[1][:, shared_vertices(half, whole)]).norm(dim=2).max()
    assert error < 1e-7 * moved


@pytest.mark.parametrize("linear", ["banded", "multigrid"])
def test_three_planes_leave_a_block_a_uniform_stretch(linear):
    mesh = box_tetrahedra((0.02, 0.02, 0.02), (3, 3, 3))
    planes = [SymmetryPlane(axis) for axis in np.eye(3)]
    body, end = Body(mesh, symmetry=planes), select_vertices(mesh, x=0.02)
    sim = Simulator(
        body,
        StableNeoHookean(100e3, 0.3),
        gravity=(0.0, 0.0, 0.0),
        solver=SolverSettings("newton", linear_solver=linear),
    )
    # The force of a uniform traction on each vertex of the end face is a third of the area of its triangles.
    area, area_of_vertex = 0.0004, np.zeros(len(mesh.vertices))
    for face in boundary_triangles(mesh):
        if np.isin(face, end).all():
            a, b, c = mesh.vertices[face]
            area_of_vertex[face] += np.linalg.norm(np.cross(b - a, c - a)) / 6
    assert area_of_vertex.sum() == pytest.approx(area)
    force = np.zeros((len(mesh.vertices), 3))
    force[:, 0] = 30e3 * area_of_vertex
    q = sim.static_equilibrium(Inputs(external_force=torch.as_tensor(force)[None])).q[0].numpy()
    stretch = q.max(axis=0) / 0.02
    np.testing.assert_allclose(q, mesh.vertices * stretch, atol=1e-9)
    # Stresses dW/dl and dW/dm of W = mu/2 (l^2 + 2 m^2 - 3) - mu (J - 1) + (mu + lambda)/2 (J - 1)^2 with J = l m^2.
    mu, bulk = 100e3 / 2.6, 100e3 * (0.3 / 1.3 / 0.4 + 0.5 / 1.3)  # Pa: mu and mu + lambda
    along, across = stretch[0], stretch[1:].mean()
    pressure = bulk * (along * across**2 - 1.0) - mu
    assert mu * along + pressure * across**2 == pytest.approx(30e3, rel=1e-6)
    assert mu * across + pressure * along * across == pytest.approx(0.0, abs=0.03)
    assert along > 1.2


def test_gradients_of_half_a_beam():
    # Differences are less exact by rounding, the stiffer the cap.
    rows = check_gradients(simulator(beam(True, TURN, rigid=True, stiffness=1e6)), POSES[-1])
    names = {row.parameter for row in rows}
    assert {"q", "v", "external_force", "youngs_modulus", "cap_density, each environment"} <= names
    assert {row.parameter: row.relative_error for row in rows if not row.relative_error < 1e-7} == {}


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
        (lambda: simulator(beam(True), solver=SolverSettings("projective_dynamics")), "projective_dynamics"),
    ],
)
def test_invalid_symmetry_is_refused(make, key):
    with pytest.raises(InputError, match=key):
        make()
