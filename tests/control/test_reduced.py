"""A reduced model of random polynomials with a random network: its derivatives, and many models at once."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from warp_resphys.control.polynomials import Polynomial, SquaredPolynomial, best_order, powers
from warp_resphys.control.reduced_force import ReducedForce
from warp_resphys.control.reduced_model import ReducedModel
from warp_resphys.learning.residuals.correction import Range
from warp_resphys.learning.residuals.networks import ResidualForce, build_model
from warp_resphys.settings.learning import NetworkSettings
from warp_resphys.studies.gradient_check import central_difference

MODES, PARTS, POINTS, FILTERS, VERTICES = 3, 2, 2, (0.1, 0.5), 4
NETWORK = {"kind": "reduced", "position_modes": 4, "velocity_modes": 2, "force_modes": 3, "blocks": 1, "layers": 1,
           "width": 8, "activation": "silu"}  # fmt: skip


@pytest.fixture(scope="module", params=["implicit_euler", "bdf2"])
def model(request):
    """The second one has two Prony branches, and a learned force that fades out."""
    random = np.random.default_rng(0)
    torch.manual_seed(0)

    def polynomial(order, middle, spread):
        coefficients = spread * random.standard_normal((len(powers(PARTS, order)), *np.shape(middle)))
        coefficients[0] += middle
        return Polynomial(coefficients, order)

    conditions = torch.randn(20, PARTS * (1 + len(FILTERS)), dtype=torch.float64)
    samples = torch.randn(20, 6, 3, dtype=torch.float64)
    network = build_model(ResidualForce, NetworkSettings(**NETWORK), samples[0], samples, samples, samples, conditions)
    network = network.double().requires_grad_(False)
    missed, times = (torch.ones(1, 2, dtype=torch.float64), (0.02, 0.3)) if request.param == "bdf2" else (None, ())
    seen = np.zeros((6, 2 * MODES))
    seen[:4, :MODES], seen[4:, MODES:] = random.standard_normal((4, MODES)), random.standard_normal((2, MODES))
    force = ReducedForce(
        network,
        Range.of(torch.randn(30, 6 + conditions.shape[1], dtype=torch.float64), missed),
        polynomial(3, np.zeros(6), 0.1),
        polynomial(2, seen, 0.1),
        0.1 * random.standard_normal(conditions.shape[1]),
        0.3 * random.standard_normal((conditions.shape[1], conditions.shape[1])),
        polynomial(1, np.zeros(3), 0.1),
        polynomial(2, random.standard_normal((MODES, 3)), 0.1),
    )
    curved = random.standard_normal((MODES, MODES, 3 * POINTS))
    damping, branches = polynomial(2, np.eye(MODES), 0.1), polynomial(2, np.tile(10.0 * np.eye(MODES), (2, 1, 1)), 0.5)
    acts = {"factor": 0.8, "delay": 0.013, "rise": 0.03}
    return ReducedModel(
        0.01,
        request.param,
        ("a", "b"),
        "pressure",
        np.full(PARTS, 5.0),
        np.array([[0.0], [5.0]]) * np.ones(PARTS),
        acts,
        FILTERS,
        times,
        polynomial(3, np.zeros(MODES), 0.1),
        polynomial(3, np.zeros(3 * POINTS), 0.1),
        polynomial(2, np.diag([400.0, 900.0, 2500.0]), 5.0),
        _squared(damping.coefficients),
        polynomial(2, random.standard_normal((3 * POINTS, MODES)), 0.1),
        _squared(branches.coefficients[:, : len(times)]),
        polynomial(3, np.zeros(3 * VERTICES), 0.1),
        random.standard_normal((3 * VERTICES, MODES)),
        curved + curved.swapaxes(0, 1),
        force,
    )


def _squared(coefficients):
    return SquaredPolynomial(coefficients + coefficients.swapaxes(-1, -2), 2)


def test_an_equilibrium_lasts(model):
    state = model.rest(np.array([3.0, 1.5]), count=2)
    end = model.move(state, np.tile([3.0, 1.5], (20, 2, 1)))[2]
    np.testing.assert_allclose(end.z, state.z, atol=1e-6)
    np.testing.assert_allclose(model.observe(end)[0], model.rest_observed(np.array([[3.0, 1.5]]))[0], atol=1e-5)


def test_a_transition_of_states_that_are_moved_with_their_past_is_linearised(model):
    """By differences over small changes, for the first of two models; the second only goes on."""
    random, inputs = np.random.default_rng(6), np.array([2.5, 1.0])
    start = model.move(model.rest(np.full(PARTS, 2.0), 2), np.tile(inputs, (4, 2, 1)))[2]
    weights, way = random.standard_normal(2 * MODES), random.standard_normal((3, MODES))
    bias = np.stack([np.full(MODES, 1e-2), np.zeros(MODES)])
    end, slopes = model.transition(start, inputs, bias)
    for number, slope in enumerate(np.split(slopes, 3, axis=1)):

        def after(x, number=number):
            z, v, b = (x * way * (np.arange(3) == number)[:, None])[:, None]
            state = model.move(start.select([0]).moved(z, v, model.time_step), inputs[None, None], bias[0] + b)[2]
            return float(weights @ np.concatenate([state.z[0], state.v[0]]))

        difference, doubt = central_difference(after)
        assert abs(weights @ slope @ way[number] - difference) < 1e-3 * abs(difference) + 10.0 * doubt
    np.testing.assert_allclose(end.z[1], model.step(start, np.tile(inputs, (2, 1))).z[1], atol=1e-12)


def test_a_command_that_never_varies_changes_nothing(model):
    random = np.random.default_rng(8)
    more = replace(model, scale=np.full(PARTS + 1, 5.0), range=np.array([[0.0, 0.7, 0.0], [5.0, 0.7, 5.0]]))
    inputs = 5.0 * random.random((6, 2, PARTS))
    whole = np.insert(inputs, 1, random.random(2), axis=2)
    one = model.respond(model.rest(inputs[0, 0]), inputs)
    np.testing.assert_allclose(more.respond(more.rest(whole[0, 0]), whole), one, atol=1e-12)
    rests = model.rest_observed(inputs[0])
    np.testing.assert_allclose(more.rest_observed(whole[0]), rests, atol=1e-9)
    assert np.abs(rests[0] - rests[1]).max() > 1e-3


@pytest.mark.parametrize(("true", "least", "best"), [(5, 3, 5), (2, 3, 3)])
def test_the_order_is_the_one_that_predicts_other_samples(true, least, best):
    random = np.random.default_rng(9)
    points, coefficients = random.uniform(-1.0, 1.0, (200, 2)), random.standard_normal((len(powers(2, true)), 4))
    values = Polynomial(coefficients, true)(points) + 1e-3 * random.standard_normal((200, 4))
    assert best_order(points, values, least) == best


def test_a_branch_relaxes_as_a_maxwell_element(model):
    """Coordinates that are moved at once and stay there: what has not relaxed decays with the branch's time."""
    strains, change = np.zeros((len(model.times), 1, MODES)), np.ones((1, MODES))
    strains = model.relaxed(strains + change, 0.0 * change)
    for _ in range(9):
        strains = model.relaxed(strains, 0.0 * change)
    for strain, time in zip(strains, model.times, strict=True):
        np.testing.assert_allclose(strain, np.exp(-10 * model.time_step / time))


def test_squares_of_polynomials_have_no_negative_eigenvalues():
    random = np.random.default_rng(7)
    points, roots = random.uniform(-1.0, 1.0, (60, 2)), 0.3 * random.standard_normal((6, 3, 3))
    true = SquaredPolynomial(roots + roots.swapaxes(1, 2) + 9.0 * np.eye(3) * (np.arange(6) == 0)[:, None, None], 2)
    again = SquaredPolynomial.fitted(points, true(points), 2)
    np.testing.assert_allclose(again(points), true(points), rtol=1e-5, atol=1e-5)
    assert np.linalg.eigvalsh(again(10.0 * points)).min() > -1e-6


def test_models_at_once_do_not_see_each_other_and_begin_again_by_themselves(model):
    random, rest = np.random.default_rng(4), np.full(PARTS, 1.0)
    inputs = 1.0 + 4.0 * random.random((8, 3, PARTS))
    first = batch = model.rest(rest, 3)
    for number, now in enumerate(inputs):
        if number == 4:
            batch = first.where(np.array([False, True, False]), batch)
        batch = model.step(batch, now)
    for row, since in enumerate((0, 4, 0)):
        wanted = model.respond(model.rest(rest), inputs[since:, row : row + 1])[-1, 0]
        np.testing.assert_allclose(model.observe(batch)[row], wanted, atol=1e-12)
