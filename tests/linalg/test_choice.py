"""Selection of the linear solver by `auto`, and refused choices."""

import numpy as np
import pytest
import torch

from warp_resphys.io.errors import InputError
from warp_resphys.linalg.banded import BandedSolver, BorderedSolver, hubs
from warp_resphys.linalg.choice import make_linear_solver
from warp_resphys.linalg.cholmod import SparseSolver
from warp_resphys.linalg.pardiso import PardisoSolver, has_pardiso

CPU = torch.device("cpu")


def chain(count):
    """Rows and columns of the lower triangle of a chain of nodes."""
    nodes = np.arange(count)
    return np.concatenate([nodes, nodes[1:]]), np.concatenate([nodes, nodes[:-1]])


def test_few_hubs_of_a_narrow_band_come_last_and_many_of_a_wide_one_do_not():
    """A node that couples to a whole chain, and seven with far more neighbours than the others of a wide band."""
    rows, cols = chain(400)
    rows, cols = np.append(rows, np.full(399, 399)), np.append(cols, np.arange(399))
    assert isinstance(make_linear_solver("auto", rows, cols, 400, 3, CPU, torch.float64), BorderedSolver)
    count, reach, many = 600, 80, np.arange(150, 500, 55)
    pairs = {(i, i) for i in range(count)} | {(i, j) for i in range(count) for j in range(max(i - reach, 0), i, 16)}
    pairs |= {(max(i, j), min(i, j)) for i in many for j in range(i - 120, min(i + 120, count), 2)}
    rows, cols = np.array(sorted(pairs)).T
    assert len(hubs(rows, cols, count)) >= len(many)
    assert isinstance(make_linear_solver("auto", rows, cols, count, 3, CPU, torch.float64), BandedSolver)


def test_compact_bodies_take_pardiso_where_it_is_installed(monkeypatch):
    """A grid of 12 nodes along every axis, which all couple to their neighbours."""
    at = np.stack(np.meshgrid(*[np.arange(12)] * 3, indexing="ij"), -1).reshape(-1, 3)
    near = np.abs(at[:, None] - at).max(-1) <= 1
    rows, cols = np.nonzero(np.tril(near))
    body = (rows, cols, len(at), 3, CPU, torch.float64)
    expected = PardisoSolver if has_pardiso() else BandedSolver
    assert isinstance(make_linear_solver("auto", *body), expected)
    monkeypatch.setattr("warp_resphys.linalg.choice.has_pardiso", lambda: False)
    assert isinstance(make_linear_solver("auto", *body), BandedSolver)
    monkeypatch.setattr("warp_resphys.linalg.choice.MAX_BANDED_FLOPS", 1e9)
    assert isinstance(make_linear_solver("auto", *body), SparseSolver)
    with pytest.raises(InputError, match="pip install mkl"):
        make_linear_solver("pardiso", *body)


def test_bad_choices_are_refused():
    with pytest.raises(InputError, match="linear_solver is 'lu'"):
        make_linear_solver("lu", *chain(3), 3, 3, CPU, torch.float64)
    with pytest.raises(InputError, match="linear_solver=pardiso runs on the CPU alone"):
        make_linear_solver("pardiso", *chain(3), 3, 3, torch.device("cuda"), torch.float64)
