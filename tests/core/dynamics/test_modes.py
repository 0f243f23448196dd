"""Vibration modes: one basis, whatever rotation among vibrations
of one frequency the eigensolver comes upon.
"""

import numpy as np
import pytest
import scipy.linalg
import torch

from support.clamped import clamped
from warp_resphys import Body, Corotated, Simulator, box_hexahedra
from warp_resphys.core.dynamics.modes import vibration_modes

MESH = box_hexahedra((0.08, 0.02, 0.02), (4, 1, 1))


def simulator(held=True):
    return Simulator(clamped(MESH) if held else Body(MESH), Corotated(2e5, 0.45))


@pytest.mark.parametrize(("held", "count"), [(True, 1), (True, 8), (False, 5)])
def test_they_do_not_depend_on_the_basis_that_the_eigensolver_returns(held, count, monkeypatch):
    """Pairs of bending, of which some are cut; six motions of a free body."""
    expected = vibration_modes(simulator(held), count)
    solve = scipy.linalg.eigh

    def turned(matrix, *mass, **options):
        if mass:  # for the rotary inertia of a free body
            return solve(matrix, *mass, **options)
        values, shapes = solve(matrix, **options)
        apart = np.diff(values) > 1e-6 * abs(values[1:]) + 1e-9 * values[-1]
        clusters = np.split(shapes, np.flatnonzero(apart) + 1, axis=1)
        assert max(s.shape[1] for s in clusters) == (2 if held else 6)
        random = np.random.default_rng(0)
        return values, np.hstack(
            [s @ np.linalg.qr(random.standard_normal((s.shape[1],) * 2))[0] for s in clusters]
        )

    monkeypatch.setattr(scipy.linalg, "eigh", turned)
    torch.testing.assert_close(
        vibration_modes(simulator(held), count), expected, rtol=0.0, atol=1e-9
    )


def test_a_square_beam_bends_along_its_axes_and_a_cut_pair_leaves_its_first():
    modes = vibration_modes(simulator(), 2).view(-1, 3, 2)
    across = modes[:, 1:].norm(dim=0)  # (y and z, mode)
    torch.testing.assert_close(across, torch.diag(across.diagonal()), rtol=0.0, atol=1e-9)
    assert bool((modes.sum(0)[[1, 2], [0, 1]] > 0.5).all())
    torch.testing.assert_close(
        vibration_modes(simulator(), 1).view(-1, 3), modes[..., 0], rtol=0.0, atol=1e-12
    )
