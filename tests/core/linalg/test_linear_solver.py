"""Every layout factorises the same batch of symmetric matrices; the layout that `auto` takes.

Dense couplings.
"""

import os
import sys
from functools import partial

import numpy as np
import pytest
import scipy.sparse
import torch

from support.refusals import refuses
from warp_resphys.core.linalg.banded import BandedSolver, BorderedSolver, hubs
from warp_resphys.core.linalg.choice import make_linear_solver
from warp_resphys.core.linalg.cholmod import SparseSolver
from warp_resphys.core.linalg.coupling import Coupling, CouplingSolver
from warp_resphys.core.linalg.linear_solver import Factor, bandwidth_reducing_order
from warp_resphys.core.linalg.pardiso import PardisoSolver, has_pardiso
from warp_resphys.io.errors import InputError

NODES, BATCH, HUB = 16, 3, 5


def pattern():
    """A ring with a few chords and a node that couples to all:
    its given order has full bandwidth.
    """
    pairs = {(i, i) for i in range(NODES)} | {
        (max(i, (i + 1) % NODES), min(i, (i + 1) % NODES)) for i in range(NODES)
    }
    pairs |= {(max(i, HUB), min(i, HUB)) for i in range(NODES)}
    rows, cols = np.array(sorted(pairs | {(7, 2), (9, 4)})).T
    return rows, cols


def matrices(block, shift, seed=0):
    """(B, n, n) symmetric matrices of the pattern; positive definite for a large shift."""
    rows, cols = pattern()
    rng = np.random.default_rng(seed)
    dense = np.zeros((BATCH, NODES, block, NODES, block))
    for r, c in zip(rows, cols, strict=True):
        values = rng.normal(size=(BATCH, block, block))
        dense[:, r, :, c] += values
        dense[:, c, :, r] += values.transpose(0, 2, 1)
    n = NODES * block
    return dense.reshape(BATCH, n, n) + shift * np.eye(n)


def values_of(solver, dense):
    """The solver's value array, written as the assembly kernel writes it."""
    rows, cols = pattern()
    k = solver.block
    values = np.zeros((len(dense), solver.n_values))
    for (r, c), addresses in zip(zip(rows, cols, strict=True), solver.address, strict=True):
        block = dense[:, r * k : (r + 1) * k, c * k : (c + 1) * k].reshape(len(dense), -1)
        stored = addresses >= 0
        values[:, addresses[stored]] = block[:, stored]
    return torch.as_tensor(values).to(solver.device, solver.dtype)


def factorised(solver, dense):
    """The factor of regular matrices, pivoted where they are not positive definite."""
    factor = solver.factor(values_of(solver, dense))
    return solver.pivoted(values_of(solver, dense), factor) if factor.failed.any() else factor


def make(kind, block, device="cpu", dtype=torch.float64):
    where = *pattern(), NODES, block, torch.device(device), dtype
    return {"banded": BandedSolver, "bordered": BorderedSolver}.get(
        kind, partial(make_linear_solver, kind)
    )(*where)


def layouts(device):
    of_cpus = ["banded", "bordered"] + (["pardiso"] if has_pardiso() else [])
    return ["dense", "sparse", "tiled"] + (of_cpus if device == "cpu" else [])


@pytest.fixture(params=[True, False], ids=["cholespy", "scipy"])
def cholespy(request, monkeypatch):
    if request.param:
        pytest.importorskip("cholespy")
    else:
        monkeypatch.setitem(sys.modules, "cholespy", None)


@pytest.mark.parametrize(("block", "definite"), [(1, True), (3, False)])
def test_solutions_equal_numpy(block, definite, device, cholespy):
    dense = matrices(block, 20.0 if definite else 0.3)
    assert (np.linalg.eigvalsh(dense)[:, 0] > 0).all() == definite
    right = np.random.default_rng(1).normal(size=(BATCH, NODES * block, 4))
    for kind in layouts(device):
        solver = make(kind, block, device)
        factor = factorised(solver, dense)
        assert not factor.failed.any()
        solution = factor.solve(torch.as_tensor(right, device=device))
        np.testing.assert_allclose(
            solution.cpu(), np.linalg.solve(dense, right), rtol=1e-9, atol=1e-9
        )


def test_idle_matrices_leave_the_others_as_they_are(device, cholespy):
    """Even where they are no matrix at all."""
    dense = matrices(3, 20.0)
    dense[1] = np.nan
    idle = torch.tensor([False, True, False], device=device)
    right = torch.ones(BATCH, NODES * 3, 2, dtype=torch.float64, device=device)
    for kind in layouts(device):
        solver = make(kind, 3, device)
        factor = solver.factor(values_of(solver, dense), idle=idle)
        assert not factor.failed[[0, 2]].any()
        solution = factor.solve(right).cpu()[[0, 2]]
        np.testing.assert_allclose(
            solution, np.linalg.solve(dense[[0, 2]], right.cpu()[[0, 2]]), rtol=1e-9, atol=1e-9
        )


def test_idle_matrices_keep_the_factor_they_have(device, cholespy):
    dense, others = matrices(3, 20.0), matrices(3, 20.0, seed=7)
    idle = torch.tensor([False, True, True], device=device)
    right = torch.ones(BATCH, NODES * 3, 2, dtype=torch.float64, device=device)
    columns = torch.as_tensor(
        0.3 * np.random.default_rng(0).normal(size=(BATCH, NODES * 3, 2)), device=device
    )
    for kind in layouts(device):
        for extra in (None, columns):
            solver = make(kind, 3, device)
            values = values_of(solver, dense)
            before = solver.factor(values, columns=extra)
            # As the assembly does: what is idle stays, as a matrix or as the factor that overwrote
            # it.
            values[0] = values_of(solver, others)[0]
            after = solver.factor(
                values, columns=None if extra is None else 2.0 * extra, idle=idle, before=before
            )
            assert not after.failed.any()
            expected = dense.copy()
            expected[0] = others[0]
            if extra is not None:
                scale = np.array([2.0, 1.0, 1.0])[:, None, None] * extra.cpu().numpy()
                expected = expected + scale @ scale.transpose(0, 2, 1)
            solution = after.solve(right).cpu()
            np.testing.assert_allclose(
                solution, np.linalg.solve(expected, right.cpu()), rtol=1e-9, atol=1e-9
            )
            in_place = right[:, solver.dofs, 0].contiguous()
            after.solve_in_place(in_place)
            np.testing.assert_allclose(
                in_place.cpu(), solution[:, solver.dofs.cpu(), 0], rtol=1e-9, atol=1e-12
            )


@pytest.mark.parametrize("unknown", [0, 16, 35])
def test_a_pivot_that_is_not_positive_is_found_wherever_it_is(unknown, device, cholespy):
    """The first, the last of a tile, the first of the next one, the last of all."""
    dense = matrices(3, 20.0)
    for kind in layouts(device):
        solver = make(kind, 3, device)
        bad = dense.copy()
        at = int(solver.dofs[unknown])
        bad[1, at, at] = -1.0
        assert solver.factor(values_of(solver, bad)).failed.tolist() == [False, True, False]


def test_only_a_solver_that_says_so_writes_over_the_values_and_nan_stays_or_counts_as_failed(
    device,
):
    for kind in layouts(device):
        solver = make(kind, 3, device)
        values = values_of(solver, matrices(3, 20.0))
        before = values.clone()
        solver.factor(values)
        assert bool((values == before).all()) != solver.overwrites
    # A NaN in a matrix never turns into a finite solution.
    dense = matrices(3, 20.0)
    dense[2, 5, 5] = np.nan
    right = torch.ones(BATCH, NODES * 3, 1, dtype=torch.float64)
    for kind in layouts("cpu"):
        solver = make(kind, 3)
        factor = solver.factor(values_of(solver, dense))
        if not factor.failed[2]:
            assert not torch.isfinite(factor.solve(right)[2]).all()


def test_indefinite_matrices_in_float32(device, cholespy):
    dense, right = matrices(3, 0.3), torch.ones(BATCH, NODES * 3, 1, device=device)
    for kind in layouts(device):
        solver = make(kind, 3, device, torch.float32)
        solution = factorised(solver, dense).solve(right)
        expected = np.linalg.solve(dense, right.cpu().numpy())
        np.testing.assert_allclose(
            solution.cpu().numpy(), expected, rtol=0, atol=1e-3 * np.abs(expected).max()
        )


def test_a_correction_of_low_rank_is_as_accurate_in_place(device):
    """Even for the right-hand sides that it changes most."""
    dense = matrices(3, 20.0)
    columns = torch.as_tensor(
        1e3 * np.random.default_rng(0).normal(size=(BATCH, NODES * 3, 1)), device=device
    )
    expected = np.linalg.solve(dense + (columns @ columns.mT).cpu().numpy(), columns.cpu().numpy())
    for kind in layouts(device):
        solver = make(kind, 3, device)
        in_place = columns[:, solver.dofs, 0].contiguous()
        solver.factor(values_of(solver, dense), columns=columns).solve_in_place(in_place)
        reference = expected[:, solver.dofs.cpu().numpy(), 0]
        np.testing.assert_allclose(
            in_place.cpu(), reference, rtol=0, atol=1e-6 * np.abs(reference).max()
        )


def test_band_is_as_narrow_as_the_order_allows():
    rows, cols = pattern()
    order = bandwidth_reducing_order(rows, cols, NODES)
    assert sorted(order) == list(range(NODES))
    place = np.argsort(order)
    assert np.abs(place[rows] - place[cols]).max() < np.abs(rows - cols).max()
    assert make("banded", 3).bandwidth < 3 * np.abs(rows - cols).max()


def test_an_indefinite_arrow_may_have_a_singular_band():
    """Both unknowns that couple to the hub alone have no stiffness of their own:
    only pivoting solves this.
    """
    n = 30
    rows, cols = np.array(sorted({(i, i) for i in range(n)} | {(i, 0) for i in range(n)})).T
    solver = BorderedSolver(rows, cols, n, 1, torch.device("cpu"), torch.float64)
    dense = np.eye(n)
    dense[3, 3] = 0.0
    dense[1:, 0] = dense[0, 1:] = np.linspace(0.5, 1.0, n - 1)
    values = torch.zeros(1, solver.n_values, dtype=torch.float64)
    values[0, solver.address[:, 0]] = torch.as_tensor(dense[rows, cols])
    failed = solver.factor(values.clone())
    assert failed.failed.all()
    right = torch.as_tensor(np.random.default_rng(0).normal(size=(1, n, 2)))
    factor = solver.pivoted(values, failed)
    assert not factor.failed.any()
    np.testing.assert_allclose(dense @ factor.solve(right)[0].numpy(), right[0], atol=1e-12)
    column = right[:, solver.dofs, 0].clone()
    factor.solve_in_place(column)
    torch.testing.assert_close(column, factor.solve(right)[:, solver.dofs, 0])


def test_an_indefinite_matrix_prints_nothing(capfd):
    """CHOLMOD warns by C of a matrix that is not positive definite.

    Other output of the process is kept.
    """
    pytest.importorskip("cholespy")
    solver = SparseSolver(np.array([0]), np.array([0]), 1, 3, torch.device("cpu"), torch.float64)
    values = torch.zeros(1, solver.n_values, dtype=torch.float64)
    values[0, solver.address[0][[0, 4, 8]]] = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    os.write(1, b"before\n")
    factor = solver.factor(values)
    print("after", flush=True)
    assert capfd.readouterr().out == "before\nafter\n"
    assert factor.failed.all()


CPU = torch.device("cpu")


def chain(count):
    """Rows and columns of the lower triangle of a chain of nodes."""
    nodes = np.arange(count)
    return np.concatenate([nodes, nodes[1:]]), np.concatenate([nodes, nodes[:-1]])


def test_few_hubs_of_a_narrow_band_come_last_and_many_of_a_wide_one_do_not():
    """A node that couples to a whole chain, and seven
    with far more neighbours than the others of a wide band.
    """
    rows, cols = chain(400)
    rows, cols = np.append(rows, np.full(399, 399)), np.append(cols, np.arange(399))
    assert isinstance(
        make_linear_solver("auto", rows, cols, 400, 3, CPU, torch.float64), BorderedSolver
    )
    count, reach, many = 600, 80, np.arange(150, 500, 55)
    pairs = {(i, i) for i in range(count)} | {
        (i, j) for i in range(count) for j in range(max(i - reach, 0), i, 16)
    }
    pairs |= {(max(i, j), min(i, j)) for i in many for j in range(i - 120, min(i + 120, count), 2)}
    rows, cols = np.array(sorted(pairs)).T
    assert len(hubs(rows, cols, count)) >= len(many)
    assert isinstance(
        make_linear_solver("auto", rows, cols, count, 3, CPU, torch.float64), BandedSolver
    )


def test_compact_bodies_take_pardiso_where_it_is_installed_and_bad_choices_are_refused(monkeypatch):
    """A grid of 12 nodes along every axis, which all couple to their neighbours."""
    at = np.stack(np.meshgrid(*[np.arange(12)] * 3, indexing="ij"), -1).reshape(-1, 3)
    near = np.abs(at[:, None] - at).max(-1) <= 1
    rows, cols = np.nonzero(np.tril(near))
    body = (rows, cols, len(at), 3, CPU, torch.float64)
    expected = PardisoSolver if has_pardiso() else BandedSolver
    assert isinstance(make_linear_solver("auto", *body), expected)
    monkeypatch.setattr("warp_resphys.core.linalg.choice.has_pardiso", lambda: False)
    assert isinstance(make_linear_solver("auto", *body), BandedSolver)
    monkeypatch.setattr("warp_resphys.core.linalg.choice.MAX_BANDED_FLOPS", 1e9)
    assert isinstance(make_linear_solver("auto", *body), SparseSolver)
    refuses(InputError, "pip install mkl", make_linear_solver, "pardiso", *body)
    refuses(
        InputError,
        "linear_solver is 'lu'",
        make_linear_solver,
        "lu",
        *chain(3),
        3,
        3,
        CPU,
        torch.float64,
    )
    with pytest.raises(InputError, match="linear_solver=pardiso runs on the CPU alone"):
        make_linear_solver("pardiso", *chain(3), 3, 3, torch.device("cuda"), torch.float64)


class DenseFactor(Factor):
    """Factor of given matrices, which counts its right-hand sides."""

    def __init__(self, matrices):
        self.failed, self.matrices, self.count = np.zeros(len(matrices), dtype=bool), matrices, 0

    def solve(self, rhs):
        self.count += rhs.shape[2]
        return torch.linalg.solve(self.matrices, rhs)


@pytest.mark.parametrize("name", ["banded", "tiled", "dense", "sparse"])
def test_columns_of_inverses(name):
    """Of a matrix of two blocks that are not coupled,
    in two environments, beside those of the dense inverse.
    """
    random = np.random.default_rng(1)
    rows = np.concatenate([np.arange(5), np.arange(1, 3), np.array([4])])
    cols = np.concatenate([np.arange(5), np.arange(2), np.array([3])])
    solver = make_linear_solver(name, rows, cols, 5, 3, CPU, torch.float64)
    pattern = np.kron(
        scipy.sparse.coo_array((np.ones(len(rows)), (rows, cols))).toarray(), np.ones((3, 3))
    )
    pattern = (pattern + pattern.T) > 0
    matrices = np.stack(
        [np.where(pattern, symmetric(random, 15, True), 0.0) + 30.0 * np.eye(15) for _ in range(2)]
    )
    values = torch.zeros(2, solver.n_values, dtype=torch.float64)
    for e, (i, j) in enumerate(zip(rows, cols, strict=True)):
        block = matrices[:, 3 * i : 3 * i + 3, 3 * j : 3 * j + 3].reshape(2, 9)
        stored = solver.address[e] >= 0
        values[:, solver.address[e][stored]] = torch.tensor(block[:, stored])
    environments, unknowns = torch.tensor([0, 0, 1, 1, 1]), torch.tensor([2, 14, 0, 9, 13])
    actual = solver.factor(values).inverse_columns(
        environments, unknowns, values.new_zeros(2, 0, 15)
    )
    expected = np.linalg.inv(matrices)[environments, unknowns]
    np.testing.assert_allclose(actual.numpy(), expected, rtol=0.0, atol=1e-12)


def symmetric(random, size, definite):
    half = random.normal(size=(size, size))
    return half @ half.T + size * np.eye(size) if definite else half + half.T


def test_solutions_are_those_of_the_whole_matrix_and_columns_are_kept():
    """Two environments with other unknowns, one of them with room for more,
    and an order of unknowns of its own.
    """
    random, n = np.random.default_rng(0), 12
    matrices = torch.tensor(np.stack([symmetric(random, n, True) for _ in range(3)]))
    factor, solver = DenseFactor(matrices), CouplingSolver(3, n, matrices)
    right, order = torch.tensor(random.normal(size=(3, n, 1))), torch.tensor(random.permutation(n))

    def corrected(couplings):
        x = torch.linalg.solve(matrices, right)[:, order]
        solver.correct(factor, couplings, x, order)
        return x

    for given in ({0: [1, 4, 7], 2: [0, 2]}, {0: [4, 1, 11], 2: [2, 5]}):
        unknowns, values = torch.full((2, 3), -1), torch.zeros(2, 3, 3, dtype=torch.float64)
        whole, environments = matrices.clone(), torch.tensor(list(given))
        for k, (b, numbers) in enumerate(given.items()):
            own, m = torch.tensor(numbers), len(numbers)
            unknowns[k, :m], values[k, :m, :m] = own, torch.tensor(symmetric(random, m, False))
            whole[b, own[:, None], own] += values[k, :m, :m]
        couplings = [Coupling(environments, unknowns, values)]
        expected = torch.linalg.solve(whole, right)[:, order]
        assert corrected(couplings).numpy() == pytest.approx(expected.numpy(), rel=1e-10, abs=1e-12)
    assert factor.count == 3 + 1  # 1, 4, 7 beside 0, 2; then 11 beside 5
    solver.forget(torch.tensor([True, False, False]))
    corrected(
        [Coupling(torch.tensor([0]), torch.tensor([[4]]), torch.ones(1, 1, 1, dtype=torch.float64))]
    )
    assert factor.count == 5
