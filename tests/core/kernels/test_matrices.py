"""Functions of a 3x3 matrix against numpy and scipy,
and the tangent of an isotropic energy in closed form.
"""

import numpy as np
import scipy.linalg
import warp as wp

from warp_resphys.kernels.materials.corotated import unimodular_offset
from warp_resphys.kernels.matrices import cofactor, polar_rotation, signed_svd, symmetric_eigen

wp.set_module_options({"enable_backward": False})
RANDOM = np.random.default_rng(0)
MATRICES = np.concatenate(
    [
        np.eye(3)[None],
        *(np.eye(3) + spread * RANDOM.normal(size=(20, 3, 3)) for spread in (0.02, 0.3, 0.8)),
        [np.diag([1.0, 1.2, 0.0]), np.diag([1.1, 0.9, -0.2]), np.diag([0.4, 0.5, 0.6])],
    ]
)


@wp.kernel
def decompose(
    f: wp.array[wp.mat33d], cofactor_out: wp.array[wp.mat33d], rotation_out: wp.array[wp.mat33d],
    unimodular_out: wp.array[wp.mat33d], u_out: wp.array[wp.mat33d], s_out: wp.array[wp.vec3d],
    v_out: wp.array[wp.mat33d],
):  # fmt: skip
    i = wp.tid()
    cofactor_out[i] = cofactor(f[i])
    rotation_out[i] = polar_rotation(f[i])
    unimodular_out[i] = f[i] - unimodular_offset(f[i])
    u, s, v = signed_svd(f[i])
    u_out[i] = u
    s_out[i] = s
    v_out[i] = v


def mapped(kernel, f, *kinds):
    """Outputs of a kernel for matrices, by their types."""
    out = [wp.zeros(len(f), dtype=kind, device="cpu") for kind in kinds]
    wp.launch(kernel, len(f), [wp.array(f, dtype=wp.mat33d, device="cpu"), *out], device="cpu")
    return [array.numpy() for array in out]


def decomposed(f):
    """Cofactor, rotation, nearest unimodular matrix, U, s and V of every matrix."""
    return mapped(decompose, f, *[wp.mat33d] * 4, wp.vec3d, wp.mat33d)


def check_nearest(f, nearest, atol):
    """Asserts that matrices have a determinant of one,
    and offsets along the normal of the surface det D = 1.
    """
    np.testing.assert_allclose(np.linalg.det(nearest), 1.0, atol=1e-13)
    normal = np.linalg.inv(nearest).transpose(0, 2, 1)
    share = np.einsum("nij,nij->n", f - nearest, normal) / np.square(normal).sum((1, 2))
    np.testing.assert_allclose(f - nearest, share[:, None, None] * normal, atol=atol)


def test_decompositions():
    cof, rotation, _, u, s, v = decomposed(MATRICES)
    regular = np.abs(np.linalg.det(MATRICES)) > 1e-3
    inverse = np.linalg.inv(MATRICES[regular]).transpose(0, 2, 1)
    np.testing.assert_allclose(
        cof[regular], np.linalg.det(MATRICES[regular])[:, None, None] * inverse, atol=1e-11
    )
    np.testing.assert_allclose(np.einsum("nik,nk,njk->nij", u, s, v), MATRICES, atol=1e-13)
    np.testing.assert_allclose(
        [np.linalg.det(u), np.linalg.det(v), np.linalg.det(rotation)], 1.0, atol=1e-12
    )
    inverted = np.linalg.det(MATRICES) < 0.0
    assert (s[~inverted] >= 0.0).all()
    assert (s[inverted, 2] < 0.0).all()
    assert (np.abs(s[inverted, 2]) <= s[inverted, :2].min(1)).all()
    upright = np.linalg.det(MATRICES) > 1e-3
    np.testing.assert_allclose(
        rotation[upright], [scipy.linalg.polar(f)[0] for f in MATRICES[upright]], atol=1e-12
    )
    # Of all rotations R the trace of R^T F is largest: s_1 + s_2 +- s_3.
    np.testing.assert_allclose(np.einsum("nij,nij->n", rotation, MATRICES), s.sum(1), atol=1e-12)


@wp.kernel
def eigenpairs(a: wp.array[wp.mat33d], v_out: wp.array[wp.mat33d], e_out: wp.array[wp.vec3d]):
    i = wp.tid()
    v, e = symmetric_eigen(a[i])
    v_out[i] = v
    e_out[i] = e


def test_eigenvectors_of_symmetric_matrices():
    """Matrices with distinct, nearly equal and equal eigenvalues, of any size, and zero."""
    turns = [np.linalg.qr(RANDOM.normal(size=(3, 3)))[0] for _ in range(6)]
    spectra = [
        (3.0, 1.0, -2.0),
        (1.0, 1.0 + 1e-9, 1.0 - 1e-7),
        (2.0, 2.0, 0.0),
        (1e9, 1.0, 1e-9),
        (0.0, 0.0, 0.0),
    ]
    a = np.array([q * e @ q.T for q in turns for e in spectra] + [np.diag(e) for e in spectra])
    a = np.concatenate([a, [[[1.0, 1e-170, 0.0], [1e-170, 1.0, 0.1], [0.0, 0.1, 1.0]]]])
    a = (a + a.transpose(0, 2, 1)) / 2.0
    v, e = mapped(eigenpairs, a, wp.mat33d, wp.vec3d)
    size = np.linalg.norm(a, axis=(1, 2))[:, None]
    expected = np.linalg.eigvalsh(a)
    assert (np.abs(np.sort(e, axis=1) - expected) <= 1e-14 * size).all()
    np.testing.assert_allclose(
        v.transpose(0, 2, 1) @ v, np.broadcast_to(np.eye(3), a.shape), atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(v), 1.0, atol=1e-14)
    again = np.einsum("nik,nk,njk->nij", v, e, v)
    assert (np.abs(again - a).max((1, 2)) <= 1e-14 * size[:, 0]).all()


def test_the_nearest_unimodular_matrix():
    f = MATRICES[np.linalg.det(MATRICES) > 0.0]
    nearest = decomposed(f)[2]
    check_nearest(f, nearest, atol=1e-9)
    distance = np.linalg.norm(f - nearest, axis=(1, 2))
    for spread in (0.01, 0.1, 0.5):
        other = nearest + spread * RANDOM.normal(size=f.shape)
        other /= np.cbrt(np.linalg.det(other))[:, None, None]
        assert (distance <= np.linalg.norm(f - other, axis=(1, 2)) + 1e-12).all()


def test_the_nearest_unimodular_matrix_is_continuous_where_its_algorithm_changes():
    """On both sides of the largest |J - 1| and trace for which invariants are used:
    D changes as much as F.
    """
    turn = np.linalg.qr(RANDOM.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    shapes = [(1.0, 1.0, 1.0), (1.1, 1.0, 0.9), (1.3, 1.0, 0.8)]
    near = [
        np.diag(s) * np.cbrt(j / np.prod(s)) for s in shapes for j in (0.6, 0.66, 0.67, 0.72, 1.4)
    ]
    # det F = 1 and the largest trace, long^2 + 2 / long
    long = np.roots([1.0, 0.0, -12.0, 2.0]).real.max()
    near.append(np.diag([long, long**-0.5, long**-0.5]))
    pairs = np.array([[(1.0 - 1e-7) * f, (1.0 + 1e-7) * f] for f in near]) @ turn
    growth, trace = np.abs(np.linalg.det(pairs) - 1.0), np.square(pairs).sum((2, 3))
    assert ((growth[:, 0] < 0.4) != (growth[:, 1] < 0.4)).sum() == 6
    assert ((trace[:, 0] < 12.0) != (trace[:, 1] < 12.0)).sum() == 1
    nearest = decomposed(pairs.reshape(-1, 3, 3))[2]
    check_nearest(pairs.reshape(-1, 3, 3), nearest, atol=1e-12)
    one, other = nearest.reshape(-1, 2, 3, 3).swapaxes(0, 1)
    assert np.abs(other - one).max() < 1e-6
