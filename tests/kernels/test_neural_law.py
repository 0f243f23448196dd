"""The law of a convex network against automatic differentiation of its formula, and its convexity."""

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from warp_resphys.energies.neural import ENERGY, NeuralMaterial, bounded, initial_weights, lame, parts
from warp_resphys.kernels.materials import neural

MU, LAMBDA, G2, G4 = 90e3, 4e6, 1.5e6, 1e9
SEEDS = (0, 1)
RANDOM = np.random.default_rng(0)
INVERTED = np.diag([1.1, 0.9, -0.4])
GRADIENTS = np.stack(
    [np.eye(3), *(np.eye(3) + s * RANDOM.normal(size=(3, 3)) for s in 5 * [0.02] + 5 * [0.3]), INVERTED]
)
DIRECTION = RANDOM.normal(size=GRADIENTS.shape)


def weights_of(seed):
    """Initial weights, or any real ones."""
    if seed == 0:
        return initial_weights(MU, LAMBDA)
    return torch.randn(neural.WEIGHTS, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def activated(z):
    return 0.5 * (z + (z**2 + 1.0).sqrt())


def energy(f, weights, g2=G2, g4=G4):
    """Energies (B) of deformation gradients (B, 3, 3) by the formula."""

    def network(x):
        first, coupling, second, output, direct, *_ = parts(bounded(weights))
        h = activated(x @ first[:, :3].T + first[:, 3])
        y = activated(h @ coupling + x @ second[:, :3].T + second[:, 3])
        return y @ output + x[:, :2] @ direct

    jac = torch.linalg.det(f)
    cof = jac[:, None, None] * torch.linalg.inv(f).mT
    j = jac - 1.0
    a = (f**2).sum((1, 2)) - 3.0 - 2.0 * j + j**2
    x = torch.stack([a / 0.25, ((cof**2).sum((1, 2)) - 3.0 - 4.0 * j) / 0.25, j / 0.1], 1)
    rest = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(network(rest).sum(), rest, create_graph=True)
    return ENERGY * (network(x) - network(rest) - slope[0, 2] * x[:, 2]) + g2 * j**2 + g4 * j**4


MODULE = wp.get_module("test_neural_law")
wp.set_module_options({"enable_backward": False, "max_unroll": 1}, MODULE)


@wp.kernel(module=MODULE)
def evaluate(
    f: wp.array[wp.mat33d], df: wp.array[wp.mat33d], m: neural.moduli, w: wp.array[wp.float64], clamp: bool,
    energy_out: wp.array[wp.float64], stress_out: wp.array[wp.mat33d], slopes_out: wp.array[neural.moduli],
    shared_out: wp.array2d[wp.float64], tangent_out: wp.array2d[wp.mat33d],
):  # fmt: skip
    i = wp.tid()
    energy, stress = neural.response(f[i], m, w)
    energy_out[i] = energy
    stress_out[i] = stress
    slopes_out[i] = neural.slopes(f[i], df[i], m, m)
    neural.shared_slopes(f[i], df[i], m, w, shared_out[i])
    neural.tangent(f[i], m, w, clamp, tangent_out[i])


@wp.kernel(module=MODULE)
def evaluate_dissipation(
    p: wp.array[wp.float64], w: wp.array[wp.float64], phi_out: wp.array[wp.vec3d], slopes_out: wp.array2d[wp.float64]
):
    i = wp.tid()
    phi_out[i] = neural.dissipation(p[i], w)
    neural.dissipation_slopes(p[i], wp.float64(1.0), w, slopes_out[i])


def response(weights, f=GRADIENTS, clamp=False):
    """Energies (B), stresses (B, 3, 3), slopes by moduli and shared values (B, n), and tangents (B, 9, 9)."""
    material = NeuralMaterial(weights, G2, G4)
    constants = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in material.constants.items()}
    moduli = neural.moduli(*(float(value) for value in material.moduli(constants)))
    shared = wp.array(material.shared(constants).numpy(), dtype=wp.float64, device="cpu")
    n = len(f)
    sizes = [(n, wp.float64), (n, wp.mat33d), (n, neural.moduli), ((n, neural.SHARED), wp.float64), ((n, 6), wp.mat33d)]
    out = [wp.zeros(size, dtype=kind, device="cpu") for size, kind in sizes]
    fields = [wp.array(values, dtype=wp.mat33d, device="cpu") for values in (f, DIRECTION)]
    wp.launch(evaluate, n, [*fields, moduli, shared, clamp, *out], device="cpu")
    energies, stress, slopes, by_shared, blocks = (array.numpy() for array in out)
    tangent = np.zeros((n, 3, 3, 3, 3))  # column and row of the stress, column and row of F
    for number, (k, i) in enumerate([(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]):
        tangent[:, k, :, i] = blocks[:, number]
        tangent[:, i, :, k] = blocks[:, number].transpose(0, 2, 1)
    return energies, stress, slopes, by_shared, tangent.reshape(n, 9, 9)


def flat(matrices):
    return matrices.transpose(0, 2, 1).reshape(-1, 9)


@pytest.mark.parametrize("seed", SEEDS)
def test_energy_stress_and_tangent_are_those_of_the_formula(seed):
    weights, f = weights_of(seed), torch.tensor(GRADIENTS, requires_grad=True)
    energies, stress, _, _, tangent = response(weights)
    expected = energy(f, weights)
    np.testing.assert_allclose(energies, expected.detach(), rtol=1e-9, atol=1e-9 * MU)
    (slope,) = torch.autograd.grad(expected.sum(), f, create_graph=True)
    np.testing.assert_allclose(stress, slope.detach(), rtol=1e-9, atol=1e-9 * MU)
    (product,) = torch.autograd.grad((slope * torch.as_tensor(DIRECTION)).sum(), f)
    scale = np.abs(tangent).max((1, 2))[:, None]
    along = np.einsum("nij,nj->ni", tangent, flat(DIRECTION))
    np.testing.assert_allclose(along / scale, flat(product.numpy()) / scale, atol=1e-10)
    values, vectors = np.linalg.eigh(tangent)
    assert (values < -1e-3 * MU).any()
    clamped = np.einsum("nij,nj,nkj->nik", vectors, values.clip(0.0), vectors)
    np.testing.assert_allclose(response(weights, clamp=True)[4], clamped, atol=1e-8 * np.abs(tangent).max())


@pytest.mark.parametrize("seed", SEEDS)
def test_slopes_are_the_derivatives_of_the_stress(seed):
    weights, f = weights_of(seed).requires_grad_(True), torch.tensor(GRADIENTS, requires_grad=True)
    _, _, slopes, by_shared, _ = response(weights.detach())
    volume = torch.tensor([G2, G4], dtype=torch.float64, requires_grad=True)
    (stress,) = torch.autograd.grad(energy(f, weights, *volume).sum(), f, create_graph=True)
    along = (stress * torch.as_tensor(DIRECTION)).sum((1, 2))
    shared = NeuralMaterial().shared({"weights": weights})
    for n in range(len(GRADIENTS)):
        by_weights, by_volume = torch.autograd.grad(along[n], (weights, volume), retain_graph=True)
        (own,) = torch.autograd.grad(shared, weights, -torch.as_tensor(by_shared[n]), retain_graph=True)
        np.testing.assert_allclose(own, by_weights, rtol=1e-8, atol=1e-10 * MU)
        np.testing.assert_allclose(slopes[n, 3:], by_volume, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("seed", SEEDS)
def test_at_rest_it_is_linear_elasticity(seed):
    weights = weights_of(seed)
    energies, stress, _, _, tangent = (values[0] for values in response(weights))
    np.testing.assert_allclose(energies, 0.0, atol=1e-10 * MU)
    np.testing.assert_allclose(stress, 0.0, atol=1e-10 * MU)
    mu, volume = map(float, lame(bounded(weights)))
    assert seed or mu == pytest.approx(MU, rel=1e-12)
    assert seed or 0.0 < volume <= 0.5 * LAMBDA
    strain = 0.5 * (DIRECTION[0] + DIRECTION[0].T)
    expected = 2.0 * mu * strain + (volume + 2.0 * G2) * np.trace(strain) * np.eye(3)
    np.testing.assert_allclose((tangent @ DIRECTION[0].T.ravel()).reshape(3, 3).T, expected, rtol=1e-9)


def test_rotations_of_the_body_and_of_its_rest_shape_change_nothing():
    turn, before = Rotation.random(2, rng=np.random.default_rng(1)).as_matrix()
    energies, stress, *_ = response(weights_of(0))
    turned = response(weights_of(0), turn @ GRADIENTS @ before)
    np.testing.assert_allclose(turned[0], energies, rtol=1e-9, atol=1e-9 * MU)
    np.testing.assert_allclose(turned[1], turn @ stress @ before, rtol=1e-9, atol=1e-8 * MU)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_it_is_convex_along_rank_one_directions_and_least_at_rest(seed):
    """Whatever the weights are; at elements of any shape, also inverted and flat ones."""
    random = np.random.default_rng(seed)
    f = random.normal(size=(200, 3, 3))
    f[::5, :, 2] = 0.0
    energies, _, _, _, tangent = response(weights_of(seed), f)
    assert energies.min() > 0.0
    a, b = random.normal(size=(2, len(f), 500, 3))
    along = np.einsum("nki,nkj->nkji", a, b).reshape(len(f), -1, 9)
    curvature = np.einsum("nki,nij,nkj->nk", along, tangent, along)
    assert (curvature.min(1) > -1e-9 * np.abs(tangent).max((1, 2))).all()
    assert np.linalg.eigvalsh(tangent).min() < 0.0  # not convex in F


@pytest.mark.parametrize("seed", SEEDS)
def test_dissipation_is_that_of_its_formula_and_convex(seed):
    weights = weights_of(seed).requires_grad_(True)
    size = torch.tensor([0.0, 1e-3, 0.01, 0.1, 1.0], dtype=torch.float64, requires_grad=True)  # |A|
    p = size.detach().square().requires_grad_(True)
    *_, kappa, (v, g, e) = parts(bounded(weights))

    def phi(p):
        y = (1.0 + p / 0.01**2).sqrt()[:, None] - 1.0
        return kappa * p + 0.01**2 * ((activated(g * y + e) - activated(e)) * v).sum(1)

    values, slopes = wp.zeros(5, dtype=wp.vec3d), wp.zeros((5, neural.SHARED), dtype=wp.float64)
    shared = NeuralMaterial().shared({"weights": weights})
    own = [wp.array(array.detach().numpy(), dtype=wp.float64) for array in (p, shared)]
    wp.launch(evaluate_dissipation, 5, [*own, values, slopes], device="cpu")
    (first,) = torch.autograd.grad(phi(p).sum(), p, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), p, retain_graph=True)
    expected = torch.stack([phi(p), first, second], 1).detach()
    np.testing.assert_allclose(values.numpy(), expected, rtol=1e-9, atol=1e-15)
    for n in range(5):
        (by_weights,) = torch.autograd.grad(first[n], weights, retain_graph=True)
        (product,) = torch.autograd.grad(shared, weights, -torch.as_tensor(slopes.numpy()[n]), retain_graph=True)
        np.testing.assert_allclose(product, by_weights, rtol=1e-9, atol=1e-13)
    (rise,) = torch.autograd.grad(phi(size.square()).sum(), size, create_graph=True)
    assert (torch.autograd.grad(rise.sum(), size)[0] > 0.0).all()
    assert (rise[1:] > 0.0).all()
    assert seed or float(first[0].detach()) == pytest.approx(1.0, rel=1e-12)
