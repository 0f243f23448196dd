"""The error messages that users meet most, word for word: what is wrong, where, and what to do."""

import re

import pytest
import torch

import warp_resphys as wr
from warp_resphys.core.dynamics.statics import find_equilibrium

BOX = wr.box_hexahedra((0.04, 0.01, 0.01), (4, 1, 1))
FREE, CLAMPED = wr.Body(BOX), wr.Body(BOX, fixed=wr.select_vertices(BOX, x=0.0))


def beam(body=CLAMPED, **settings):
    return wr.Simulator(body, solver=wr.SolverSettings(**settings))


def pushed(newtons):
    return wr.Inputs(torch.full((1, *BOX.vertices.shape), newtons, dtype=torch.float64))


def collapsed():
    vertices = BOX.vertices.copy()
    vertices[BOX.cells[2]] = vertices[BOX.cells[2][0]]
    return beam(wr.Body(wr.Mesh(vertices, BOX.cells)))


def buckling(share, x):
    if share > 0.3:
        raise wr.ConvergenceError("", x, None)
    return x, None


MESSAGES = {
    "Unknown input presure. This body accepts external_force, internal_force, fixed_positions, "
    "attached_mass.": (
        lambda: beam().step(beam().rest_state(), wr.Inputs(presure=torch.zeros(1, 2)))
    ),
    "5 of 20 vertices (11, 12, 13, 14, 15; counted from 0) lie on another one, a crack between "
    "cells; merge or glue them (gmsh: Coherence, Abaqus: one part)": collapsed,
    "1 of 1 bodies have no equilibrium under these loads: they grow to more than 100 times their "
    "size; lower the loads, or take a stiffer material.": lambda: beam().static_equilibrium(
        pushed(1e3)
    ),
    "no equilibrium was found: under growing loads it is lost beyond 30 % of them; lower the "
    "loads, or take a stiffer material.": lambda: find_equilibrium(
        buckling, torch.zeros(1, 2, 3), torch.zeros(1, 2, 3), limited=False
    ),
    "the quasi_newton solver stopped after 1 iterations with a relative residual of SIZE in "
    "environment 0 of 1: take a smaller time step or loads, raise solver.max_iterations, or "
    "choose solver.name=newton.": (
        lambda: beam(max_iterations=1).step(beam().rest_state(), pushed(0.1))
    ),
    "youngs_modulus is -100000: it must be positive, in Pa.": lambda: wr.Corotated(-1e5),
    "a body without fixed vertices has no static equilibrium: fix some vertices, or lay it on an "
    "obstacle with friction, within the distance of contact.": (
        lambda: beam(FREE).static_equilibrium()
    ),
}


@pytest.mark.parametrize("message", MESSAGES)
def test_message(message):
    with pytest.raises(wr.ResphysError) as caught:
        MESSAGES[message]()
    assert re.sub(r"\d\.\d\de[+-]\d\d", "SIZE", str(caught.value)) == message
