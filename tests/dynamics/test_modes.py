"""Vibration modes: one basis, whatever rotation among vibrations of one frequency the eigensolver comes upon."""

import numpy as np
import pytest
import scipy.linalg
import torch

from warp_resphys import Body, Corotated, Simulator, box_hexahedra, select_vertices
from warp_resphys.dynamics.modes import align_degenerate_modes, fix_signs, vibration_modes

MESH = box_hexahedra((0.08, 0.02, 0.02), (4, 1, 1))


def simulator(held=True, **options):
    return Simulator(Body(MESH, fixed=select_vertices(MESH, x=0.0) if held else ()), Corotated(2e5, 0.45), **options)


def turn(columns, seed):
    """Columns in another orthonormal basis of their span."""
    return columns @ np.linalg.qr(np.random.default_rng(seed).standard_normal((columns.shape[1],) * 2))[0]


@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_they_do_not_depend_on_the_basis_that_the_eigensolver_returns(held, count, monkeypatch):
    """Pairs of bending, of which some are cut; six motions of a free body."""
    expected = vibration_modes(simulator(held), count)
    solve = scipy.linalg.eigh

    def turned(matrix, **options):
        values, shapes = solve(matrix, **options)
        apart = np.diff(values) > 1e-6 * abs(values[1:]) + 1e-9 * values[-1]
        clusters = np.split(shapes, np.flatnonzero(apart) + 1, axis=1)
        assert max(s.shape[1] for s in clusters) == (2 if held else 6)
        return values, np.hstack([turn(s, seed=i) for i, s in enumerate(clusters)])

    monkeypatch.setattr(scipy.linalg, "eigh", turned)
    torch.testing.assert_close(vibration_modes(simulator(held), count), expected, rtol=0.0, atol=1e-9)


def test_a_square_beam_bends_along_its_axes_and_a_cut_pair_leaves_its_first():
    modes = vibration_modes(simulator(), 2).view(-1, 3, 2)
    across = modes[:, 1:].norm(dim=0)  # (y and z, mode)
    torch.testing.assert_close(across, torch.diag(across.diagonal()), rtol=0.0, atol=1e-9)
    assert bool((modes.sum(0)[[1, 2], [0, 1]] > 0.5).all())
    torch.testing.assert_close(vibration_modes(simulator(), 1).view(-1, 3), modes[..., 0], rtol=0.0, atol=1e-12)


def test_single_precision_has_the_modes_of_double_precision():
    single = vibration_modes(simulator(dtype=torch.float32), 8)
    torch.testing.assert_close(single.double(), vibration_modes(simulator(), 8), rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("waves", [1, 2, 3])
def test_a_ring_whose_axes_weigh_the_same_has_one_basis(waves):
    """Ovals along the axes and between them have the same displacements along both axes."""
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    radial = np.stack([0.0 * angles, np.cos(angles), np.sin(angles)], 1)
    pair = np.stack([np.cos(waves * angles), np.sin(waves * angles)], 1) / np.sqrt(12.0)
    shapes = (radial[:, :, None] * pair[:, None]).reshape(-1, 2)
    bases = [fix_signs(align_degenerate_modes(np.ones(2), turn(shapes, seed), radial, 1e-4)) for seed in range(4)]
    assert max(np.abs(other - bases[0]).max() for other in bases) < 1e-12
    apart = align_degenerate_modes(np.array([1.0, 1.1]), shapes, radial, 1e-4)
    np.testing.assert_allclose(np.abs(apart), np.abs(shapes), atol=1e-12)
