"""Chambers, follower pressure and fibres."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.chambered import BRICK, KINDS, chambered, force_of, hollow_box
from support.clamped import clamped, noise
from support.refusals import refuses
from support.slopes import check_rows, check_slopes
from warp_resphys import Body, Corotated, Fibres, Inputs, Pressure, Simulator, SolverSettings, State
from warp_resphys.core.dynamics.gradient_check import central_difference, check_gradients
from warp_resphys.core.mesh.chambers import Chamber, check_chambers, find_chambers, outer_surface
from warp_resphys.io.errors import InputError, MeshError

SOFT = Corotated(100e3, 0.45, density=1070.0, mass_damping=0.5, stiffness_damping=2e-3)
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-12)


def volumes_of(s, q):
    return s.body.energies[0].volumes(s.body.mesh, q)


def simulator(kind="hexahedron", material=SOFT, fibres=None, **options):
    return Simulator(chambered(kind, fibres=fibres), material, **({"solver": TIGHT} | options))


@pytest.mark.parametrize("kind", KINDS)
def test_volume_of_a_homogeneously_deformed_chamber(kind):
    """Quadratic faces stay flat under an affine map, whose determinant scales the volume."""
    s = simulator(kind)
    assert [c.name for c in s.body.energies[0].chambers] == ["chamber_1", "chamber_2"]
    f = torch.eye(3, dtype=torch.float64) + 0.3 * noise(3, 3)
    q = s.rest_state().q @ f.mT + noise(3, seed=1)
    volumes = volumes_of(s, q)[0] / torch.linalg.det(f)
    np.testing.assert_allclose(volumes.numpy(), [2 * BRICK, BRICK], rtol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_the_force_of_a_pressure_is_the_slope_of_its_volume(kind):
    """So that it does the work p dV; its sum and moment vanish, as the chamber is closed."""
    s, pressure = simulator(kind), torch.tensor([[1e4, 2e4], [3e4, -1e4]], dtype=torch.float64)
    q = (s.rest_state(2).q + 5e-4 * noise(2, s.body.n_vertices, 3)).requires_grad_()

    def work(x):
        return (pressure * volumes_of(s, x)).sum()

    (gradient,) = torch.autograd.grad(work(q), q)
    direction, q = 1e-4 * noise(*q.shape, seed=3), q.detach()
    difference, _ = central_difference(lambda k: float(work(q + k * direction)))
    assert float((gradient * direction).sum()) == pytest.approx(difference, rel=1e-8)
    force = force_of(s, q, pressure)
    torch.testing.assert_close(force, gradient, rtol=0.0, atol=1e-12 * float(gradient.abs().max()))
    size = force.norm(dim=-1).sum(1)
    assert bool((size > 1.0).all())
    assert bool((force.sum(1).norm(dim=1) < 1e-13 * size).all())
    assert bool((torch.linalg.cross(q, force).sum(1).norm(dim=1) < 1e-14 * size).all())


@pytest.mark.parametrize(
    ("start", "poissons_ratio", "options"),
    [
        ("rest", 0.45, {}),
        ("bent", 0.499, {"integrator": "midpoint"}),
        ("twisted", 0.499, {"integrator": "bdf2"}),
        pytest.param("bent", 0.45, {"kind": "tetrahedron10"}, marks=pytest.mark.slow),
    ],
)
def test_gradients_of_every_parameter_under_pressure(start, poissons_ratio, options, device):
    s = simulator(material=replace(SOFT, poissons_ratio=poissons_ratio), device=device, **options)
    check_rows(check_gradients(s, start, steps=2), "pressure")


@pytest.mark.parametrize(
    ("kind", "taut"),
    [("hexahedron", False), pytest.param("tetrahedron10", True, marks=pytest.mark.slow)],
)
def test_gradients_with_fibres(kind, taut):
    """Where all fibres are taut.

    And where some are not, or are about to be: shorter steps pass over fewer of these.
    """
    s = simulator(kind, SOFT, {"angles": (20.0, -20.0)}, time_step=1e-3)
    start = s.rest_state(1).q * s.tensor([1.1, 1.1, 1.1] if taut else [1.0, 1.0, 1.0])
    values = {"pressure": s.tensor([[2e4, 1e4]]), "stiffness": s.tensor([2e3, 1e3]), "q": start}
    weights = noise(*start.shape)

    def loss(given):
        inputs = Inputs(pressure=given["pressure"])
        parameters = {"fibre_stiffness": given["stiffness"]}
        end = s.rollout(State(given["q"], 0.0 * start), 3, inputs, parameters)
        return (weights * end.q[-1]).sum()

    check_slopes(
        loss, values, {name: 2e-5 * float(value.abs().mean()) for name, value in values.items()}
    )


@pytest.mark.parametrize("kind", KINDS)
def test_fibres_run_around_the_chamber_and_spare_its_ends(kind):
    """Stretching the chamber across itself stretches its fibres as much.

    Along itself it does nothing to them.
    """
    mesh = hollow_box(kind)
    (points,) = Fibres(find_chambers(mesh, (1.0, 0.0, 0.0))[:1]).points(mesh)
    sides = 2 * (0.01 + 0.02 / 3) * 0.02  # the chamber reaches 2 cm along x
    assert points.weights.sum() == pytest.approx(sides, rel=1e-12)
    for stretch, expected in (((1.0, 1.1, 1.1), 1.1), ((1.1, 1.0, 1.0), 1.0)):
        x = mesh.vertices * np.array(stretch)
        fibre = np.einsum("cki,cqk->cqi", x[points.nodes], points.gradients[..., 0])
        lengths = np.linalg.norm(fibre, axis=-1).ravel()[points.weights > 0.0]
        np.testing.assert_allclose(lengths, expected, rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_fibres_around_the_outside_are_in_its_sides_alone(kind):
    """Neither in the faces at its ends nor in those of the chambers.

    A stretch along the body does not stretch them.
    """
    mesh = hollow_box(kind)
    (points,) = Fibres([outer_surface(mesh, (1.0, 0.0, 0.0))], axis=(1.0, 0.0, 0.0)).points(mesh)
    size = np.ptp(mesh.vertices, axis=0)
    assert points.weights.sum() == pytest.approx(2.0 * size[0] * (size[1] + size[2]), rel=1e-12)
    for stretch, expected in (((1.0, 1.1, 1.1), 1.1), ((1.1, 1.0, 1.0), 1.0)):
        x = mesh.vertices * np.array(stretch)
        fibre = np.einsum("cki,cqk->cqi", x[points.nodes], points.gradients[..., 0])
        lengths = np.linalg.norm(fibre, axis=-1).ravel()[points.weights > 0.0]
        np.testing.assert_allclose(lengths, expected, rtol=1e-12)


def test_fibres_hold_a_chamber_from_growing_wide_and_do_not_push():
    pressure = torch.tensor([[2e4, 2e4]], dtype=torch.float64)
    widths = {}
    for stiffness in (0.0, 1e3, 1e5):
        s = simulator(
            material=Corotated(50e3, 0.45), fibres={"stiffness": stiffness}, gravity=(0.0, 0.0, 0.0)
        )
        for sign in (1.0, -1.0):
            q = s.static_equilibrium(Inputs(pressure=sign * pressure)).q
            widths[stiffness, sign] = float(volumes_of(s, q)[0, 0] / (2 * BRICK) - 1.0)
    assert widths[0.0, 1.0] > 1.5 * widths[1e3, 1.0] > 2.0 * widths[1e5, 1.0] > 0.0
    assert widths[1e5, -1.0] == pytest.approx(widths[0.0, -1.0], rel=0.1)
    assert widths[0.0, -1.0] < 0.0


def test_bad_input():
    mesh = hollow_box("hexahedron")
    chamber = find_chambers(mesh, (1.0, 0.0, 0.0))[0]
    hole = clamped(mesh, energies=[Pressure([Chamber("lid", chamber.faces[1:])])])
    refuses(MeshError, "lid has 4 open edges that can move, .*: close the surface", Simulator, hole)
    with pytest.raises(
        MeshError, match="the faces of turned look into the solid, or it is the outer surface"
    ):
        check_chambers([Chamber("turned", chamber.faces[:, ::-1])], mesh)
    with pytest.raises(MeshError, match="again and first share a face"):
        check_chambers([Chamber("first", chamber.faces), Chamber("again", chamber.faces)], mesh)
    refuses(InputError, "fibres are wound around chambers", Fibres, [])
    refuses(InputError, "there are none: find them", Pressure, [])
    with pytest.raises(InputError, match="two energies of the body depend on pressure"):
        Body(mesh, energies=[Pressure([chamber]), Pressure([chamber])])
    refuses(InputError, "'fibre_stiffness'", simulator().prepare, {"fibre_stiffness": 1.0})
    with pytest.raises(InputError, match=r"fibre_stiffness has 3 values for 2 chambers"):
        simulator(fibres={"stiffness": [1.0, 2.0, 3.0]}).prepare()
    refuses(InputError, "fibre_stiffness is", Fibres, [chamber], stiffness=-1.0)
    s, zeros = simulator(), torch.zeros(1, 3, dtype=torch.float64)
    refuses(
        InputError, r"pressure has shape \(1, 3\)", s.step, s.rest_state(), Inputs(pressure=zeros)
    )
    with pytest.raises(InputError, match=r"Unknown input tension\. This body accepts .*pressure"):
        s.step(s.rest_state(), Inputs(tension=zeros))
    with pytest.raises(InputError, match="environment 0, chamber 1"):
        s.step(
            s.rest_state(), Inputs(pressure=torch.tensor([[0.0, torch.nan]], dtype=torch.float64))
        )
    bare = Simulator(Body(mesh))
    with pytest.raises(InputError, match=r"Unknown input .*This body accepts external_force"):
        bare.step(bare.rest_state(), Inputs(pressure=zeros))
    for angles, toe in (((), 1e-3), ((90.0,), 1e-3), ((0.0,), 0.0)):
        refuses(InputError, "fibre", Fibres, [chamber], angles, toe)
