"""Mooney-Rivlin rubber: its energy, derivatives, small strains and a bar that is stretched to twice its length."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from warp_resphys import Body, MooneyRivlin, Simulator, SolverSettings, StableNeoHookean, box_hexahedra
from warp_resphys.energies.placed import PlacedEnergy
from warp_resphys.energies.potential import IncrementalPotential, StepTerms
from warp_resphys.energies.solid import Solid
from warp_resphys.io.errors import InputError
from warp_resphys.mesh.mesh import Mesh, select_vertices
from warp_resphys.studies.gradient_check import check_gradients

UNIT = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
TETRAHEDRON = Body(Mesh(UNIT, np.array([[0, 1, 2, 3]])), volume_integration="full")
MODULI = np.array([3.0, 2.0, 7.0])
RUBBER = MooneyRivlin(36e3, 8e3, 4e6, mass_damping=0.5, stiffness_damping=2e-3)


def gradients():
    random = np.random.default_rng(0)
    gradients = [np.eye(3) + spread * random.normal(size=(8, 3, 3)) for spread in (0.02, 0.3, 0.8)]
    return np.concatenate([np.eye(3)[None], *gradients, [np.diag([1.0, 1.2, 0.0]), np.diag([1.1, 0.9, -0.2])]])


def potential_of(f):
    solid = Solid(TETRAHEDRON.discretisation, MooneyRivlin())
    fixed = torch.zeros(0, dtype=torch.int64)
    sets = [PlacedEnergy(solid, solid.points(TETRAHEDRON.mesh))]
    p = IncrementalPotential(sets, TETRAHEDRON.coordinates, fixed, len(f), torch.device("cpu"))
    zeros = torch.zeros(len(f), 4, 3, dtype=torch.float64)
    values = {"stiffness": torch.as_tensor(MODULI).expand(len(f), 1, 3), "viscosity": zeros[:, 0, :2]}
    p.set_terms(StepTerms(zeros, zeros[..., 0], zeros, {**values, "strain_offset": None, "dilation_offset": None}))
    p.positions.copy_(torch.as_tensor(UNIT @ f.transpose(0, 2, 1)))
    return p


def response(f):
    p = potential_of(f)
    energy, _ = p.evaluate()
    return energy.numpy(), p.residual[:, 1:].mT.numpy().copy()


def closed_form(f):
    c = f.transpose(0, 2, 1) @ f
    first = np.trace(c, axis1=1, axis2=2)
    second = 0.5 * (first**2 - np.trace(c @ c, axis1=1, axis2=2))
    change = np.linalg.det(f) - 1.0
    terms = first - 3 - 2 * change + change**2, second - 3 - 4 * change, 0.5 * change**2
    return MODULI @ np.stack(terms)


def test_energy_and_stress():
    f, step = gradients(), 1e-5
    direction = np.random.default_rng(1).normal(size=f.shape)
    energy, stress = response(f)
    np.testing.assert_allclose(energy, closed_form(f), rtol=1e-12, atol=1e-13)
    slope = (closed_form(f + step * direction) - closed_form(f - step * direction)) / (2 * step)
    np.testing.assert_allclose(np.einsum("nij,nij->n", stress, direction), slope, rtol=1e-8, atol=1e-8)
    assert np.abs(stress[0]).max() < 1e-14  # at rest


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


def test_a_bar_that_is_stretched():
    """At constant volume its nominal stress is 2 (l - l^-2) (c10 + c01 / l) at the stretch l (Rivlin 1948)."""
    stretch = np.array([0.5, 0.8, 1.0, 1.5, 3.0])
    across = stretch**-0.5
    _, stress = response(np.stack([np.diag([x, y, y]) for x, y in zip(stretch, across, strict=True)]))
    tension = stress[:, 0, 0] - across / stretch * stress[:, 1, 1]  # less the pressure that keeps the sides free
    np.testing.assert_allclose(tension, 2.0 * (stretch - stretch**-2) * (MODULI[0] + MODULI[1] / stretch), atol=1e-12)


@pytest.mark.parametrize(("name", "value"), [("c10", -1), ("bulk_modulus", 0)])
def test_constants_out_of_range(name, value):
    with pytest.raises(InputError, match=f"{name} is {value}: it must be positive, in Pa"):
        MooneyRivlin(**{name: float(value)})
