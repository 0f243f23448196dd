"""Energy densities of every material: derivatives, the state at rest,
and invariance under rotation.
"""

import functools

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from warp_resphys.kernels.materials import corotated, gent, mooney_rivlin
from warp_resphys.kernels.materials.convex import convex_law
from warp_resphys.kernels.materials.density import density_law

MU, BULK = 3.0, 7.0
# The law, its moduli, and the Lame constants of small strains.
GENT = density_law("gent", gent.energy_density, gent.volume_energy)
LAWS = {
    "corotated": (corotated.LAW, (MU, BULK), (MU, BULK / 3.0)),
    "stable_neo_hookean": (mooney_rivlin.LAW, (0.5 * MU, 0.0, BULK), (MU, BULK)),
    "mooney_rivlin": (mooney_rivlin.LAW, (MU, 2.0, BULK), (2.0 * MU + 4.0, BULK)),
    "gent": (GENT, (1.0, 1.0, MU, BULK, MU, 60.0, BULK), (MU, BULK - 2.0 / 3.0 * MU)),
}
TERMS = (3.0, 2.0, 1.5, 1.0, 0.7, 0.4, BULK, 3.0, 1.0, 1.0)
OGDEN = {3: 2.0, -4: 1.5, 6: 0.5}
AXES = ((0.6, 0.0, 0.8), (0.48, 0.6, -0.64))
LAWS["convex"] = (convex_law((), 0), TERMS, (8.0, 2.0 * BULK + 0.8))
LAWS["Ogden"] = (
    convex_law(tuple(OGDEN), 0),
    (*TERMS, *OGDEN.values()),
    (12.0, 2.0 * BULK + 0.8 + 1.5),
)
STRETCHED = {3: 2.0, 4: 1.5, 5: 1.0, 6: 0.5, 8: 0.25}  # without an SVD, where F is not inverted
LAWS["Ogden in tension"] = (
    convex_law(tuple(STRETCHED), 0),
    (*TERMS, *STRETCHED.values()),
    (13.25, 2.0 * BULK + 0.8),
)
FIBRES = "convex with two families of fibres"
ISOTROPIC = tuple(LAWS)
LAWS[FIBRES] = (
    convex_law((), 2),
    (*TERMS, *AXES[0], 0.0, 0.1, 4.0, 2.0, 1.0, *AXES[1], 0.03, 0.1, 3.0, 0.0, 5.0),
    None,
)
RANDOM = np.random.default_rng(0)
GRADIENTS = np.concatenate(
    [np.eye(3)[None], *(np.eye(3) + s * RANDOM.normal(size=(10, 3, 3)) for s in (0.02, 0.2))]
)
DIRECTION = RANDOM.normal(size=GRADIENTS.shape)


@functools.cache
def kernel_of(name):
    law = LAWS[name][0]
    module = wp.get_module(f"test_material_laws.{name}")
    wp.set_module_options({"enable_backward": False, "max_unroll": 1}, module)

    @wp.kernel(module=module)
    def evaluate(
        f: wp.array[wp.mat33d],
        df: wp.array[wp.mat33d],
        m: law.values,
        clamp: bool,
        energy_out: wp.array[wp.float64],
        stress_out: wp.array[wp.mat33d],
        slopes_out: wp.array[law.values],
        tangent_out: wp.array2d[wp.mat33d],
    ):
        i = wp.tid()
        energy, stress = law.response(f[i], m)
        energy_out[i] = energy
        stress_out[i] = stress
        slopes_out[i] = law.slopes(f[i], df[i], m, m)
        law.tangent(f[i], m, clamp, tangent_out[i])

    return evaluate


def response(name, f=GRADIENTS, moduli=None, clamp=False):
    """Energies (B), stresses (B, 3, 3), slopes (B, n) and tangents (B, 9, 9)."""
    law, own, _ = LAWS[name]
    sizes = [
        (len(f), wp.float64),
        (len(f), wp.mat33d),
        (len(f), law.values),
        ((len(f), 6), wp.mat33d),
    ]
    out = [wp.zeros(size, dtype=kind, device="cpu") for size, kind in sizes]
    fields = [wp.array(field, dtype=wp.mat33d, device="cpu") for field in (f, DIRECTION)]
    wp.launch(
        kernel_of(name), len(f), [*fields, law.values(*(moduli or own)), clamp, *out], device="cpu"
    )
    energy, stress, slopes, blocks = (array.numpy() for array in out)
    tangent = np.zeros((len(f), 3, 3, 3, 3))  # column and row of the stress, column and row of F
    for number, (k, n) in enumerate([(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]):
        tangent[:, k, :, n] = blocks[:, number]
        tangent[:, n, :, k] = blocks[:, number].transpose(0, 2, 1)
    return energy, stress, slopes, tangent.reshape(len(f), 9, 9)


def flat(matrices):
    return matrices.transpose(0, 2, 1).reshape(-1, 9)


@pytest.mark.parametrize("name", LAWS)
def test_stress_and_tangent_are_derivatives(name):
    step = 1e-5
    _, stress, _, tangent = response(name)
    ahead, behind = (response(name, GRADIENTS + s * step * DIRECTION) for s in (1, -1))
    slope = np.einsum("nij,nij->n", stress, DIRECTION)
    smooth = slice(name == FIBRES, None)  # The modulus of fibres jumps at rest.
    np.testing.assert_allclose(
        (ahead[0] - behind[0])[smooth] / (2 * step), slope[smooth], rtol=1e-6, atol=1e-6
    )
    product = np.einsum("nij,nj->ni", tangent, flat(DIRECTION))
    difference = flat(ahead[1] - behind[1]) / (2 * step)
    np.testing.assert_allclose(difference[smooth], product[smooth], rtol=1e-5, atol=1e-5)
    if name == FIBRES:  # Both parts of the tangent are clamped by themselves.
        assert (
            np.linalg.eigvalsh(response(name, clamp=True)[3]).min() > -1e-8 * np.abs(tangent).max()
        )
        return
    values, vectors = np.linalg.eigh(tangent)
    assert (values < -0.1).any()
    clamped = np.einsum("nij,nj,nkj->nik", vectors, values.clip(0.0), vectors)
    np.testing.assert_allclose(
        response(name, clamp=True)[3], clamped, atol=1e-8 * np.abs(tangent).max()
    )


@pytest.mark.parametrize("name", LAWS)
def test_slopes_are_the_derivatives_of_the_stress_by_the_moduli(name):
    _, moduli, _ = LAWS[name]
    slopes = response(name)[2]
    for k in range(4 if name == "gent" else 0, len(moduli)):  # Those before are volumes.
        step = 1e-4 * max(abs(moduli[k]), 0.01)
        ahead, behind = (
            response(name, moduli=tuple(m + s * step * (i == k) for i, m in enumerate(moduli)))[1]
            for s in (1, -1)
        )
        expected = np.einsum("nij,nij->n", ahead - behind, DIRECTION) / (2 * step)
        smooth = slice(name == FIBRES, None)
        scale = max(np.abs(expected).max(), 1.0)
        np.testing.assert_allclose(
            slopes[smooth, k], expected[smooth], rtol=1e-6, atol=1e-7 * scale
        )


@pytest.mark.parametrize("name", ISOTROPIC)
def test_at_rest_it_is_linear_elasticity(name):
    energy, stress, _, tangent = (values[0] for values in response(name))
    np.testing.assert_allclose(energy, 0.0, atol=1e-14)
    np.testing.assert_allclose(stress, 0.0, atol=1e-14)
    mu, lame_lambda = LAWS[name][2]
    strain = 0.5 * (DIRECTION[0] + DIRECTION[0].T)
    expected = 2.0 * mu * strain + lame_lambda * np.trace(strain) * np.eye(3)
    np.testing.assert_allclose(
        (tangent @ DIRECTION[0].T.ravel()).reshape(3, 3).T, expected, atol=1e-7
    )


@pytest.mark.parametrize("name", LAWS)
def test_rotations_of_the_body_and_of_its_rest_shape_change_nothing(name):
    """Fibres turn with the rest shape."""
    turn, before = Rotation.random(2, rng=np.random.default_rng(1)).as_matrix()
    moduli = np.array(LAWS[name][1])
    for first in (10, 18) if name == FIBRES else ():
        moduli[first : first + 3] = before.T @ moduli[first : first + 3]
    energy, stress, _, _ = response(name)
    turned = response(name, turn @ GRADIENTS @ before, tuple(moduli))
    np.testing.assert_allclose(turned[0], energy, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(turned[1], turn @ stress @ before, atol=1e-10)


def test_fibres_pull_along_their_direction_with_the_law_of_their_stretch():
    """Beyond the toe the force is that of a fibre whose slack is longer by half of the toe."""
    stretch, (slack, toe, k, k3, kc) = np.array([1.3, 0.8]), (0.04, 0.02, 4.0, 2.0, 1.0)
    f = np.stack([np.eye(3) + (s - 1.0) * np.outer(AXES[0], AXES[0]) for s in stretch])
    moduli = [0.0] * 10 + [*AXES[0], slack, toe, k, k3, kc, *AXES[1], 0.0, toe, 0.0, 0.0, 0.0]
    q = stretch**2 - 1.0
    by_stretch = k * (stretch[0] - 1.0 - slack - 0.5 * toe)
    pull = np.array([by_stretch + 6.0 * k3 * q[0] ** 2 * stretch[0], 4.0 * kc * q[1] * stretch[1]])
    expected = pull[:, None, None] * np.outer(AXES[0], AXES[0])
    np.testing.assert_allclose(response(FIBRES, f, tuple(moduli))[1], expected, atol=1e-12)


def test_ogdens_rubber_is_the_closed_form():
    """At constant volume; 2 mu / alpha^2 (sum s^alpha - 3) has the modulus mu at small strains."""
    stretches = np.exp(RANDOM.normal(size=(5, 3)) * 0.3)
    stretches /= np.cbrt(stretches.prod(axis=1, keepdims=True))
    turn, before = Rotation.random(2, rng=np.random.default_rng(3)).as_matrix()
    f = np.stack([turn @ np.diag(s) @ before for s in stretches])
    expected = sum(2.0 * mu / a**2 * ((stretches**a).sum(axis=1) - 3.0) for a, mu in OGDEN.items())
    np.testing.assert_allclose(
        response("Ogden", f, (*[0.0] * 10, *OGDEN.values()))[0], expected, rtol=1e-10
    )
