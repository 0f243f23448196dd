"""CHOLMOD's warnings of matrices that are not positive definite do not reach the user."""

import os

import numpy as np
import pytest
import torch

from warp_resphys.linalg.sparse import SparseSolver


def test_an_indefinite_matrix_prints_nothing(capfd):
    """The factorisation fails as before, and other output of the process is kept."""
    pytest.importorskip("cholespy")
    solver = SparseSolver(np.array([0]), np.array([0]), 1, 3, torch.device("cpu"), torch.float64)
    values = torch.zeros(1, solver.n_values, dtype=torch.float64)
    values[0, solver.address[0][[0, 4, 8]]] = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    os.write(1, b"before\n")
    factor = solver.factor(values)
    print("after", flush=True)
    assert capfd.readouterr().out == "before\nafter\n"
    assert factor.failed.all()
