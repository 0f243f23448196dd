"""Mooney-Rivlin rubber in a simulator: its limit, its gradients and the range of its constants."""

from dataclasses import replace

import pytest
import torch

from warp_resphys import Body, MooneyRivlin, Simulator, SolverSettings, StableNeoHookean, box_hexahedra
from warp_resphys.io.errors import InputError
from warp_resphys.mesh.mesh import select_vertices
from warp_resphys.studies.gradient_check import check_gradients

RUBBER = MooneyRivlin(36e3, 8e3, 4e6, mass_damping=0.5, stiffness_damping=2e-3)


def beam(material, **options):
    mesh = box_hexahedra((0.06, 0.02, 0.02), (3, 1, 2))
    settings = SolverSettings("newton", relative_tolerance=1e-10)
    return Simulator(Body(mesh, fixed=select_vertices(mesh, x=0.0)), material, solver=settings, **options)


def test_without_the_second_constant_it_is_neo_hookean():
    """With mu = 2 c10 and the same lambda."""
    mu, poissons_ratio = 72e3, 0.45
    bulk = 2.0 * mu * (1.0 + poissons_ratio) / (3.0 * (1.0 - 2.0 * poissons_ratio))
    rubber = beam(MooneyRivlin(mu / 2.0, 0.0, bulk))
    other = beam(StableNeoHookean(2.0 * mu * (1.0 + poissons_ratio), poissons_ratio))
    ends = [s.rollout(s.rest_state(), 10).q[-1] for s in (rubber, other)]
    torch.testing.assert_close(ends[0], ends[1], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("start", ["rest", "bent", "twisted"])
@pytest.mark.parametrize("bulk", [4e5, 4e7])
def test_gradients_of_every_constant(start, bulk, device):
    rows = check_gradients(beam(replace(RUBBER, bulk_modulus=bulk), device=device), start, steps=2)
    assert {"c10", "c01, each element", "bulk_modulus, each environment"} <= {row.parameter for row in rows}
    assert {row.parameter: row.relative_error for row in rows if not row.relative_error <= 1e-6} == {}


@pytest.mark.parametrize(("name", "value"), [("c10", -1), ("bulk_modulus", 0)])
def test_constants_out_of_range(name, value):
    with pytest.raises(InputError, match=f"{name} is {value}: it must be positive, in Pa"):
        MooneyRivlin(**{name: float(value)})
