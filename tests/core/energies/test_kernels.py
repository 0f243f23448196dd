"""Local step of a solid against an independent NumPy implementation,
by a tetrahedron with one F an environment.

Cells that vector instructions take as a whole (`kernels.lanes`) are compared with the same points
one by one.
"""

import numpy as np
import pytest
import scipy.optimize
import torch
from scipy.spatial.transform import Rotation

from support.clamped import clamped
from warp_resphys import Body, Mesh, box_hexahedra, box_tetrahedra
from warp_resphys.core.dynamics.assembly import BlockPattern, HessianAssembly
from warp_resphys.core.energies.base import PlacedEnergy
from warp_resphys.core.energies.catalogue import MATERIALS as ALL_MATERIALS
from warp_resphys.core.energies.convex_material import ConvexMaterial
from warp_resphys.core.energies.materials import DensityMaterial
from warp_resphys.core.energies.potential import IncrementalPotential, StepTerms
from warp_resphys.core.energies.solid import Solid, SolidTerm
from warp_resphys.core.linalg.choice import make_linear_solver

UNIT = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
TETRAHEDRON = Body(Mesh(UNIT, np.array([[0, 1, 2, 3]])), volume_integration="full")
SHAPE, VOLUME = 3.0, 7.0
OWN = (DensityMaterial, ConvexMaterial)  # whose moduli have tests of their own
MATERIALS = {name: kind for name, kind in ALL_MATERIALS.items() if not issubclass(kind, OWN)}


def random_gradients(spread, count=10, seed=0):
    return np.eye(3) + spread * np.random.default_rng(seed).normal(size=(count, 3, 3))


GRADIENTS = np.concatenate(
    [
        np.eye(3)[None],
        random_gradients(0.02),
        random_gradients(0.3),
        random_gradients(0.8),  # half of them inverted
        [np.diag([1.0, 1.2, 0.0]), np.diag([1.1, 0.9, -0.2]), np.diag([0.4, 0.5, 0.6])],
    ]
)


def potential_of(body, model, batch, device="cpu"):
    solid = Solid(body.discretisation, MATERIALS[model]())
    fixed = torch.as_tensor(body.fixed_vertices, device=device)
    placed = [PlacedEnergy(solid, solid.points(body.mesh))]
    return IncrementalPotential(placed, body.coordinates, fixed, batch, fixed.device)


def unit_potential(
    gradients,
    model="corotated",
    shape=SHAPE,
    volume=VOLUME,
    viscosity=(0.0, 0.0),
    reference=None,
    **where,
):
    """Potential of the unit tetrahedron, whose residual
    on vertices 1 to 3 is V times the stress's columns.

    `viscosity` is that of shape and that of volume, `reference` the strain from which both act.
    """
    count = len(gradients)
    where = {"device": torch.device("cpu"), "dtype": torch.float64} | where
    potential = potential_of(TETRAHEDRON, model, count, where["device"])

    def full(value, *size):
        return torch.full((count, *size), float(value), **where)

    viscous = torch.as_tensor(viscosity, **where).expand(count, 2)
    strain = torch.as_tensor(np.zeros((count, 3, 3)) if reference is None else reference, **where)
    strain = strain[:, None]
    sizes = {"shape": shape, "volume": volume}
    moduli = (
        [0.5 * shape, 0.0, volume]
        if "hookean" in model
        else [sizes[rule] for rule in MATERIALS[model].rules]
    )
    stiffness = torch.stack([full(modulus, 1) for modulus in moduli], dim=-1)
    values = {"stiffness": stiffness, "viscosity": viscous, "strain_offset": viscous[0, 0] * strain}
    values["dilation_offset"] = viscous[0, 1] * strain.diagonal(dim1=-2, dim2=-1).sum(-1)
    potential.set_terms(StepTerms(full(0, 4, 3), full(0, 4), full(0, 4, 3), [values]))
    potential.positions.copy_(torch.as_tensor(UNIT @ gradients.transpose(0, 2, 1), **where))
    return potential


def stress_and_energy(gradients, *args, **kwargs):
    potential = unit_potential(gradients, *args, **kwargs)
    energy, _ = potential.evaluate()
    return potential.residual[:, 1:].mT.cpu().numpy(), energy.cpu().numpy()


def signed_svd(f):
    u, s, vt = np.linalg.svd(f)
    signs = np.array([1.0, 1.0, np.linalg.det(u)]), np.array([1.0, 1.0, np.linalg.det(vt)])
    return u * signs[0], s * signs[0] * signs[1], vt * signs[1][:, None]


def reference_unimodular(f):
    """Minimises over log singular values from several starts."""
    u, s, vt = signed_svd(f)

    def distance(p):
        d = np.exp([p[0], p[1], -p[0] - p[1]])
        slope = 2 * (d - s) * d
        return ((d - s) ** 2).sum(), np.array([slope[0] - slope[2], slope[1] - slope[2]])

    starts = [(a, b) for a in (-0.7, 0.0, 0.7) for b in (-0.7, 0.0, 0.7)]
    results = [
        scipy.optimize.minimize(distance, start, jac=True, options={"gtol": 1e-12})
        for start in starts
    ]
    best = min(results, key=lambda result: result.fun).x
    return u * np.exp([best[0], best[1], -best.sum()]) @ vt


def reference_energy(f, model):
    if model == "corotated":
        _, s, _ = signed_svd(f)
        return (
            SHAPE * ((s - 1) ** 2).sum() + VOLUME / 2 * ((f - reference_unimodular(f)) ** 2).sum()
        )
    j = np.linalg.det(f)
    if model == "mooney_rivlin":  # with c10 = c01
        first = (f**2).sum() - 3 - 2 * (j - 1) + (j - 1) ** 2
        cofactor = np.stack([np.cross(f[1], f[2]), np.cross(f[2], f[0]), np.cross(f[0], f[1])])
        return SHAPE * (first + (cofactor**2).sum() - 3 - 4 * (j - 1)) + VOLUME / 2 * (j - 1) ** 2
    return SHAPE * (((f**2).sum() - 3) / 2 - (j - 1) + (j - 1) ** 2 / 2) + VOLUME / 2 * (j - 1) ** 2


@pytest.mark.parametrize("model", MATERIALS)
def test_energies_equal_the_closed_form(model, device):
    _, energy = stress_and_energy(GRADIENTS, model, device=torch.device(device))
    np.testing.assert_allclose(
        energy, [reference_energy(f, model) for f in GRADIENTS], rtol=1e-9, atol=1e-14
    )


def viscous_energy(f, reference, viscosity, lame_factor):
    """That of the strain from the reference, less that of the undeformed tetrahedron."""

    def potential(rate):
        volume = lame_factor * VOLUME * np.trace(rate, axis1=1, axis2=2) ** 2
        return viscosity[0] * SHAPE * (rate**2).sum((1, 2)) + viscosity[1] / 2 * volume

    return potential((f.transpose(0, 2, 1) @ f - np.eye(3)) / 2 - reference) - potential(-reference)


@pytest.mark.parametrize(
    ("model", "lame_factor"), [("corotated", 1 / 3), ("stable_neo_hookean", 1.0)]
)
def test_viscous_stress_is_the_derivative_of_the_dissipation_potential(model, lame_factor):
    rng = np.random.default_rng(2)
    noise = rng.normal(scale=0.1, size=GRADIENTS.shape)
    viscous = {"viscosity": (0.6, 0.4), "reference": noise + noise.transpose(0, 2, 1)}
    stress, energy = stress_and_energy(GRADIENTS, model, **viscous)
    elastic_stress, elastic_energy = stress_and_energy(GRADIENTS, model)
    arguments = (viscous["reference"], viscous["viscosity"], lame_factor)
    np.testing.assert_allclose(
        energy - elastic_energy, viscous_energy(GRADIENTS, *arguments), rtol=1e-9, atol=1e-12
    )
    step, direction = 1e-5, rng.normal(size=GRADIENTS.shape)
    ahead, behind = (viscous_energy(GRADIENTS + s * step * direction, *arguments) for s in (1, -1))
    slope = np.einsum("nij,nij->n", stress - elastic_stress, direction)
    np.testing.assert_allclose((ahead - behind) / (2 * step), slope, rtol=1e-6, atol=1e-6)


def dense_tangent(potential, positive=None):
    """(B, 9, 9) dP/dF."""
    potential.update_tangent(positive)
    columns = []
    for direction in np.eye(9).reshape(9, 3, 3):
        moved = torch.as_tensor(UNIT @ direction.T).expand(potential.batch, -1, -1)
        columns.append(potential.stiffness_product(moved)[:, 1:].mT.reshape(-1, 9))
    return torch.stack(columns, dim=-1).numpy()


def test_clamped_viscous_tangent_is_positive_semidefinite_and_collapsed_elements_stay_finite():
    # Compression rate: a negative geometric part.
    reference = np.tile(0.5 * np.eye(3), (len(GRADIENTS), 1, 1))
    potential = unit_potential(GRADIENTS, viscosity=(5.0, 5.0), reference=reference)
    everywhere = torch.ones(potential.batch, dtype=torch.bool)
    assert np.linalg.eigvalsh(dense_tangent(potential)).min() < -1.0
    assert np.linalg.eigvalsh(dense_tangent(potential, everywhere)).min() > -1e-9
    collapsed = np.stack(
        [np.zeros((3, 3)), np.diag([1.0, 0, 0]), -np.eye(3), np.diag([1e3, 1e-3, -5])]
    )
    for model in MATERIALS:
        stress, energy = stress_and_energy(collapsed, model)
        assert np.isfinite(stress).all()
        assert np.isfinite(energy).all()
        assert np.isfinite(dense_tangent(unit_potential(collapsed, model))).all()


def test_auxetic_material_has_a_negative_volume_term():
    """A negative lambda (nu < 0) must not be taken for a missing term."""
    plain, _ = stress_and_energy(GRADIENTS, volume=0.0)
    positive, _ = stress_and_energy(GRADIENTS, volume=1.0)
    negative, _ = stress_and_energy(GRADIENTS, volume=-1.0)
    np.testing.assert_allclose(negative - plain, plain - positive, atol=1e-12)


MESHES = {
    "hexahedron": box_hexahedra((0.02, 0.02, 0.01), (2, 2, 1)),
    "tetrahedron": box_tetrahedra((0.02, 0.01, 0.01), (2, 1, 1)),
    "tetrahedron10": box_tetrahedra((0.02, 0.01, 0.01), (2, 1, 1), order=2),
}


def loaded_potential(mesh):
    """Two environments of a deformed, damped body with inertia,
    its pattern, and its free degrees of freedom.
    """
    body = clamped(mesh)
    b, n = 2, body.n_vertices
    generator = torch.Generator().manual_seed(0)

    def noise(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    potential = potential_of(body, "corotated", b)
    sets = body.discretisation.point_sets
    stiffness = []
    for name, scale in (("shape_volume", 1e5), ("volume_volume", 1e6)):
        carried = np.concatenate([getattr(s, name).sum(axis=1) for s in sets])
        stiffness.append(torch.as_tensor(carried) * (1.0 + noise(b, 1)) * scale)
    strain = 0.01 * noise(b, sum(s.n_points for s in sets), 3, 3)
    main = noise(b, n, 3), 1e4 * (1 + noise(b, n)), noise(b, n, 3)
    values = {
        "viscosity": noise(b, 2),
        "strain_offset": strain + strain.mT,
        "dilation_offset": strain[..., 0, 0],
    }
    potential.set_terms(StepTerms(*main, [{"stiffness": torch.stack(stiffness, dim=-1), **values}]))
    potential.positions.copy_(torch.as_tensor(mesh.vertices) + 1e-3 * noise(b, n, 3))
    pattern = BlockPattern(body.mesh.vertices, body.fixed_vertices, sets)
    dofs = (3 * pattern.free[:, None] + np.arange(3)).ravel()
    return potential, pattern, dofs


@pytest.mark.parametrize("kind", MESHES)
def test_assembled_hessian_is_the_derivative_of_the_residual_in_every_layout(kind):
    potential, pattern, dofs = loaded_potential(MESHES[kind])
    size, step = 3 * potential.n_vertices, 1e-8
    start = potential.positions.clone()
    differences = np.zeros((2, len(dofs), len(dofs)))
    for column, dof in enumerate(dofs):
        moved = []
        for sign in (1, -1):
            potential.positions.copy_(start)
            potential.positions.view(2, size)[:, dof] += sign * step
            potential.evaluate()
            moved.append(potential.residual.view(2, size)[:, dofs].numpy().copy())
        differences[:, :, column] = (moved[0] - moved[1]) / (2 * step)
    potential.positions.copy_(start)
    potential.update_tangent()
    right = torch.randn(
        2, len(dofs), 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    scale = np.abs(differences).max()
    solutions = []
    for layout in ("dense", "banded", "sparse"):
        arguments = (
            pattern.rows,
            pattern.cols,
            len(pattern.free),
            3,
            potential.device,
            torch.float64,
        )
        solver = make_linear_solver(layout, *arguments)
        values = HessianAssembly(potential, solver, pattern)()
        if layout == "dense":
            lower = values.view(2, len(dofs), len(dofs)).tril().numpy()
            full = lower + np.tril(lower, -1).transpose(0, 2, 1)
            np.testing.assert_allclose(full, differences, atol=1e-6 * scale)
        factor = solver.factor(values)
        assert not factor.failed.any()
        solutions.append(factor.solve(right))
        np.testing.assert_allclose(full @ solutions[-1].numpy(), right, atol=1e-8)
    for other in solutions[1:]:
        torch.testing.assert_close(other, solutions[0], rtol=1e-8, atol=1e-12)


BAR = (0.1, 0.02, 0.02)
CELLS = {
    "8 nodes": box_hexahedra(BAR, (5, 2, 1)),
    "20 nodes": box_hexahedra(BAR, (3, 1, 1), nodes=20),
    "27 nodes": box_hexahedra(BAR, (2, 1, 1), nodes=27),
    "tetrahedra": box_tetrahedra(BAR, (3, 1, 1), order=2),
}
STRAINS = (0.0, 1e-6, 0.02, 0.2, 3.0)  # of the environments; the last one turns cells inside out


def positions(mesh):
    """The body moved, turned and deformed, by more and more from one environment to the next."""
    random, q = np.random.default_rng(0), mesh.vertices
    edge = np.ptp(mesh.vertices[mesh.cells[0]], axis=0).min()
    turned = [Rotation.random(random_state=n).apply(q) for n in range(len(STRAINS))]
    return np.stack(
        [
            x + strain * edge * random.uniform(-0.5, 0.5, q.shape)
            for x, strain in zip(turned, STRAINS, strict=True)
        ]
    )


def whole_cells(p):
    """Whether each set of points is taken cell by cell."""
    return [p.energies[0].lane_cells(s) is not None for s in p.sets]


def evaluated(mesh, viscosity, q):
    """A potential after an evaluation and a tangent,
    of which the second environment has clamped eigenvalues.
    """
    batch = len(q)
    p = potential_of(Body(mesh), "corotated", batch)
    random = torch.Generator().manual_seed(0)
    (term,) = p.energies
    carried = torch.as_tensor(term._carried / term._carried.max())
    offset = 0.1 * torch.randn(batch, term.n_points, 3, 3, generator=random, dtype=torch.float64)
    values = {
        "stiffness": carried
        * (1.0 + torch.rand(batch, term.n_points, 2, generator=random, dtype=torch.float64)),
        "viscosity": torch.tensor([viscosity]).double().expand(batch, 2),
        "strain_offset": viscosity[0] * (offset + offset.mT),
        "dilation_offset": 0.1
        * torch.randn(batch, term.n_points, generator=random, dtype=torch.float64),
    }
    n = len(mesh.vertices)
    p.set_terms(StepTerms(p.zeros(n, 3), p.zeros(n), p.zeros(n, 3), [values]))
    p.positions.copy_(torch.as_tensor(q))
    p.evaluate()
    p.update_tangent(torch.arange(batch) == 1)
    return p


def gradients_of(p, q):
    """Deformation gradients (B, C, Q, 3, 3) of all points."""
    (points,) = (s.source for s in p.sets)
    return np.einsum("bcai,cqaj->bcqij", q[:, points.nodes], points.gradients)


def check_equal(whole, mesh, viscosity, q, monkeypatch):
    """Compares a potential with one whose points are taken one by one."""
    monkeypatch.setattr(SolidTerm, "lane_cells", lambda *_: None)
    single = evaluated(mesh, viscosity, q)
    for one, other in zip(whole.residual, single.residual, strict=True):
        size = float(other.abs().max())
        torch.testing.assert_close(one, other, rtol=0.0, atol=1e-13 * (size + 1.0) / BAR[1])
    torch.testing.assert_close(whole.energy, single.energy, rtol=1e-9, atol=1e-14)
    torch.testing.assert_close(whole._point_energy, single._point_energy, rtol=1e-9, atol=1e-14)
    for one, other in zip(whole.tangents, single.tangents, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("viscosity", [(0.0, 0.0), (2.0, 0.5)], ids=str)
@pytest.mark.parametrize("mesh", CELLS)
def test_cells_as_a_whole_equal_their_points(mesh, viscosity, monkeypatch):
    q = positions(CELLS[mesh])
    whole = evaluated(CELLS[mesh], viscosity, q)
    assert all(whole_cells(whole))
    growth = np.linalg.det(gradients_of(whole, q)).min((1, 2))
    assert growth[:-1].min() > 0.1
    assert growth[-1] < 0.0
    check_equal(whole, CELLS[mesh], viscosity, q, monkeypatch)


@pytest.mark.parametrize("flattest", [0.19, 0.21])
def test_a_flat_point_leaves_the_others_of_its_cell_as_they_are(flattest, monkeypatch):
    """One corner of a cell of 27 nodes is pushed in until the flattest point has a given J:
    some groups are taken.
    """
    mesh = box_hexahedra(BAR, (1, 1, 1), nodes=27)
    p, way = potential_of(Body(mesh), "corotated", 1), np.zeros_like(mesh.vertices)
    way[7] = -mesh.vertices[7]  # the corner opposite to the origin

    def growth(share):
        return np.linalg.det(gradients_of(p, (mesh.vertices + share * way)[None]))[0, 0, :27]

    shares = np.linspace(0.0, 0.5, 2001)
    share = shares[np.argmax([growth(s).min() < flattest for s in shares])]
    assert growth(share).min() == pytest.approx(flattest, abs=0.01)
    groups = [growth(share)[k : k + 8].min() for k in range(0, 27, 8)]
    assert max(groups) > 0.5
    q = np.repeat((mesh.vertices + share * way)[None], 2, 0)
    check_equal(evaluated(mesh, (2.0, 0.5), q), mesh, (2.0, 0.5), q, monkeypatch)


def test_an_environment_that_is_done_keeps_its_sums_and_its_tangent():
    q = positions(CELLS["8 nodes"])[1:3]
    p = evaluated(CELLS["8 nodes"], (2.0, 0.5), q)
    before = [getattr(p, name).clone() for name in ("energy", "energy_size", "residual_norm")]
    tangent = p.tangents[0].clone()
    p.active[1] = 0
    p.positions.mul_(1.1)
    p.evaluate()
    p.update_tangent(active=torch.tensor([True, False]))
    for name, own in zip(("energy", "energy_size", "residual_norm"), before, strict=True):
        assert float(getattr(p, name)[0]) != float(own[0])
        assert float(getattr(p, name)[1]) == float(own[1])
    assert bool(p.tangents[0][0].ne(tangent[0]).any())
    torch.testing.assert_close(p.tangents[0][1], tangent[1], rtol=0.0, atol=0.0)


def test_cells_whose_points_have_both_terms_or_none_to_share_are_not_taken():
    for body in (
        Body(CELLS["8 nodes"], volume_integration="full"),
        Body(box_tetrahedra(BAR, (3, 1, 1))),
    ):
        assert not any(whole_cells(potential_of(body, "corotated", 1)))
