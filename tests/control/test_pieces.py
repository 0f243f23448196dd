"""Paths, polynomials, quadratic programs, the response of inputs,
reduced models, and control without a simulator.
"""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.refusals import refuses
from warp_resphys.control.controllers import JacobianFeedback
from warp_resphys.control.linear_model import fit_linear
from warp_resphys.control.plan import Horizon, Planner, solve_program, tracked_of
from warp_resphys.control.polynomials import Polynomial, SquaredPolynomial, best_order, powers
from warp_resphys.control.reduced_force import Evaluator, ReducedForce
from warp_resphys.control.reduced_model import ReducedModel
from warp_resphys.control.task import Path
from warp_resphys.core.dynamics.gradient_check import central_difference
from warp_resphys.io.errors import InputError
from warp_resphys.learning.residuals.correction import Range
from warp_resphys.learning.residuals.networks import ResidualForce, build_model
from warp_resphys.settings.control import LimitsOfInputs
from warp_resphys.settings.learning import NetworkSettings

SHAPES = ["circle", "eight", *"AQRX"]  # lines, a letter of several strokes, and round ones


class TestPaths:
    @pytest.mark.parametrize("name", SHAPES)
    def test_a_path_has_its_size_and_place_and_no_jump(self, name):
        path = Path(name, 0.05, (0.01, -0.02, -0.3), right=(0.0, 1.0, 0.0), up=(0.0, 0.3, 1.0))
        points = path.points
        low, high = points.min(0), points.max(0)
        assert np.ptp(points[:, 0]) < 1e-12  # In the plane of y and z.
        np.testing.assert_allclose((high - low).max(), 0.05, rtol=1e-9)
        np.testing.assert_allclose(0.5 * (low + high), [0.01, -0.02, -0.3], atol=1e-12)
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        assert steps.max() < 2.0 * steps.sum() / len(points)

    def test_a_timed_path_begins_and_ends_at_rest(self):
        lead = np.array([0.0, 0.0, -0.25])
        found = Path("eight", 0.05, (0.0, 0.0, -0.27)).timed(2.0, 0.01, lead)
        speed = np.linalg.norm(np.diff(found, axis=0), axis=1) / 0.01
        assert len(found) == 250
        assert np.linalg.norm(found[0] - lead) < 1e-5
        assert max(speed[0], speed[-1]) < 0.02 * speed.max()
        even = speed[100:-50]
        assert even.max() < 1.05 * even.min()

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"name": "square"}, "square"),
            ({"size": 0.0}, "size"),
            ({"up": (2.0, 0.0, 0.0)}, "parallel"),
            ({"name": "R", "seconds": 0.05}, "ten steps"),
        ],
    )
    def test_invalid_paths_are_refused(self, change, said):
        given = {"name": "circle", "size": 0.1, "centre": (0.0, 0.0, 0.0), "seconds": 1.0, **change}
        seconds = given.pop("seconds")
        refuses(InputError, said, Path(**given).timed, seconds, 0.01, np.zeros(3))


def test_a_cubic_is_found_again():
    random = np.random.default_rng(0)
    points, count = random.random((80, 3)), len(powers(3, 3))
    wanted = Polynomial(random.standard_normal((count, 2, 2)), 3)
    found = Polynomial.fitted(points, wanted(points), 3)
    np.testing.assert_allclose(found(points[:5]), wanted(points[:5]), atol=1e-5)


def program(target, rows, least, most, high):
    """The point nearest to a target, between zero and upper bounds, with one linear constraint."""
    target = np.array(target)
    return solve_program(
        np.eye(len(target)),
        -target,
        np.array([rows]),
        np.array([least]),
        np.array([most]),
        0.0 * target,
        high,
    )


class TestPrograms:
    def test_a_bound_and_a_rate_hold_and_contradicting_constraints_are_refused(self):
        """The nearest point to (3, 2) with x at most 1 and y - x at most -0.5."""
        nearest = program([3.0, 2.0], [-1.0, 1.0], -9.0, -0.5, np.array([1.0, 9.0]))
        np.testing.assert_allclose(nearest, [1.0, 0.5], atol=1e-3)
        refuses(InputError, "bounds and rate limits", program, [0.0], [1.0], 2.0, 3.0, np.ones(1))

    def test_a_missing_package_is_named(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "piqp", None)
        refuses(InputError, r"warp-resphys\[control\]", program, [0.0], [1.0], 0.0, 0.0, np.ones(1))

    def test_points_are_means_of_markers(self):
        markers = np.arange(9.0).reshape(3, 3)
        np.testing.assert_allclose(
            tracked_of("abc", ["a", "c"]) @ markers.ravel(), markers[[0, 2]].mean(0)
        )
        refuses(InputError, "tracked names d: choose from a, b, c", tracked_of, "abc", ["d"])

    def test_a_plan_keeps_out_of_inputs_for_which_the_model_diverges(self):
        class Model:
            """A point that is where its input is, up to 0.6."""

            parts, time_step = 1, 0.1

            def respond(self, start, inputs, bias):
                return np.where(inputs > 0.6, np.nan, inputs)

        planner = Planner(
            Model(),
            np.eye(1),
            LimitsOfInputs(low=0.0, high=1.0, rate=100.0),
            np.ones((4, 1)),
            Horizon(4, 1),
        )
        # Half of the whole step.
        np.testing.assert_allclose(planner.plan(0, None)[-1], 0.5, rtol=0.1)


@pytest.mark.parametrize(("activation", "blocks"), [("silu", 1), ("normalised_elu", 3)])
def test_the_evaluator_is_the_network(activation, blocks):
    torch.manual_seed(0)
    samples = torch.randn(20, 4, 3, dtype=torch.float64)
    modes = {"position_modes": 3, "velocity_modes": 2, "force_modes": 5}
    layers = {"blocks": blocks, "layers": 2, "width": 16, "activation": activation}
    config = {"kind": "reduced", **modes, **layers}
    network = build_model(
        ResidualForce,
        NetworkSettings(**config),
        samples[0],
        samples,
        samples,
        samples,
        samples[:, 0],
    ).double()
    network.fit_linear(torch.randn(40, 8), torch.randn(40, 5), 0.1)
    inputs = 3.0 * torch.randn(7, 8, dtype=torch.float64)
    range_ = Range.of(torch.randn(30, 8, dtype=torch.float64))
    for guard in (None, range_):
        wanted = network.standardised(inputs if guard is None else guard.clamp(inputs))
        outputs, _ = Evaluator(network, guard)(inputs.numpy())
        np.testing.assert_allclose(outputs, wanted.detach().numpy(), atol=1e-12)
    fading = replace(range_, missed=torch.ones(2, dtype=torch.float64))
    weight = fading.weight(inputs)
    assert (weight < 1.0).sum() > 0
    assert weight.max() > 0.0
    force = weight[:, None, None] * network.decode(range_.clamp(inputs))[0]
    outputs, left = Evaluator(network, fading)(inputs.numpy())
    np.testing.assert_array_equal(left, range_.excludes(inputs))
    np.testing.assert_allclose(outputs, network.encode_outputs(force).detach().numpy(), atol=1e-12)
    np.testing.assert_allclose(
        outputs, fading.outputs(network, inputs).detach().numpy(), atol=1e-12
    )


def driven_line(steps, random, matrices):
    """A linear system of two states, seen through two markers, from rest."""
    a, b, c = matrices
    inputs = np.repeat(random.random((steps // 5, 1)), 5, axis=0)
    state, seen = np.zeros(2), [np.zeros(6)]
    for u in inputs:
        state = a @ state + b @ u
        seen.append(c @ state)
    return np.array(seen) + 0.1, inputs


class TestBaselines:
    @pytest.fixture(scope="class")
    def fitted(self):
        """A model of four trials, the last for validation; a path.

        And the error of a plan for any path.
        """
        random = np.random.default_rng(3)
        turn = 0.97 * np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]])
        matrices = turn, np.array([[0.0], [0.01]]), random.standard_normal((6, 2))
        trials = [driven_line(100, random, matrices) for _ in range(4)]
        model = fit_linear(trials[:3], trials[3:], np.ones(1), 0.01)
        start, path = model.state([np.full(6, 0.1)] * 4), driven_line(30, random, matrices)[0][1:]
        limits = LimitsOfInputs(low=0.0, high=1.0, rate=200.0)

        def error(wanted):
            horizon = Horizon(30, 30, 1e-9, 2)
            inputs = Planner(model, np.eye(6), limits, wanted, horizon).plan(0, start)
            return np.abs(model.respond(start, inputs[:, None])[:, 0] - path)

        return model, path, error

    def test_a_linear_system_is_identified_and_planned_with(self, fitted):
        model, path, error = fitted
        assert model.validation_mm < 1e-3
        assert error(path).max() < 0.05 * np.abs(path - 0.1).max()

    def test_points_are_free_where_the_path_is_nan(self, fitted):
        _, path, error = fitted
        free = np.arange(30) < 15
        without, held = (
            error(np.where(free[:, None], value, path))[~free] for value in (np.nan, 0.1)
        )
        assert without.max() < 0.2 * held.max()

    def test_feedback_finds_a_place_that_its_jacobian_gets_wrong(self):
        true = np.array([[1e-3, 0.0, 5e-4], [0.0, 2e-3, 0.0]])
        wrong = true * 1.5 + 2e-4
        limits = LimitsOfInputs(low=0.0, high=10.0, rate=100.0)
        goal, command = np.array([5e-3, 8e-3, 0.0]), np.zeros(3)
        tracked = np.eye(2, 3)
        feedback = JacobianFeedback(
            wrong, limits, 5.0, 0.01, tracked, np.tile(goal[:2], (300, 1)), np.zeros((1, 3))
        )
        for number in range(300):
            command = feedback(number, np.append(true @ command, 0.0)[None])
            assert (command >= 0.0).all()
            assert (command <= 10.0).all()
        np.testing.assert_allclose(true @ command, goal[:2], atol=1e-4)


MODES, PARTS, POINTS, FILTERS, VERTICES = 3, 2, 2, (0.1, 0.5), 4
NETWORK = {
    "kind": "reduced",
    "position_modes": 4,
    "velocity_modes": 2,
    "force_modes": 3,
    "blocks": 1,
    "layers": 1,
    "width": 8,
    "activation": "silu",
}


@pytest.fixture(scope="module", params=["implicit_euler", "bdf2"])
def model(request):
    """The second one has two Prony branches, and a learned force that fades out."""
    random = np.random.default_rng(0)
    torch.manual_seed(0)

    def polynomial(order, middle, spread):
        coefficients = spread * random.standard_normal(
            (len(powers(PARTS, order)), *np.shape(middle))
        )
        coefficients[0] += middle
        return Polynomial(coefficients, order)

    conditions = torch.randn(20, PARTS * (1 + len(FILTERS)), dtype=torch.float64)
    samples = torch.randn(20, 6, 3, dtype=torch.float64)
    network = build_model(
        ResidualForce, NetworkSettings(**NETWORK), samples[0], samples, samples, samples, conditions
    )
    network = network.double().requires_grad_(False)
    missed, times = (
        (torch.ones(1, 2, dtype=torch.float64), (0.02, 0.3))
        if request.param == "bdf2"
        else (None, ())
    )
    seen = np.zeros((6, 2 * MODES))
    seen[:4, :MODES], seen[4:, MODES:] = (
        random.standard_normal((4, MODES)),
        random.standard_normal((2, MODES)),
    )
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
    damping = polynomial(2, np.eye(MODES), 0.1)
    branches = polynomial(2, np.tile(10.0 * np.eye(MODES), (2, 1, 1)), 0.5)
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
    np.testing.assert_allclose(
        model.observe(end)[0], model.rest_observed(np.array([[3.0, 1.5]]))[0], atol=1e-5
    )


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
            state = model.move(
                start.select([0]).moved(z, v, model.time_step), inputs[None, None], bias[0] + b
            )[2]
            return float(weights @ np.concatenate([state.z[0], state.v[0]]))

        difference, doubt = central_difference(after)
        assert (
            abs(weights @ slope @ way[number] - difference) < 1e-3 * abs(difference) + 10.0 * doubt
        )
    np.testing.assert_allclose(
        end.z[1], model.step(start, np.tile(inputs, (2, 1))).z[1], atol=1e-12
    )


def test_a_command_that_never_varies_changes_nothing(model):
    random = np.random.default_rng(8)
    more = replace(
        model, scale=np.full(PARTS + 1, 5.0), range=np.array([[0.0, 0.7, 0.0], [5.0, 0.7, 5.0]])
    )
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
    points = random.uniform(-1.0, 1.0, (200, 2))
    coefficients = random.standard_normal((len(powers(2, true)), 4))
    values = Polynomial(coefficients, true)(points) + 1e-3 * random.standard_normal((200, 4))
    assert best_order(points, values, least) == best


def test_a_branch_relaxes_as_a_maxwell_element(model):
    """Coordinates that are moved at once and stay there:
    what has not relaxed decays with the branch's time.
    """
    strains, change = np.zeros((len(model.times), 1, MODES)), np.ones((1, MODES))
    strains = model.relaxed(strains + change, 0.0 * change)
    for _ in range(9):
        strains = model.relaxed(strains, 0.0 * change)
    for strain, time in zip(strains, model.times, strict=True):
        np.testing.assert_allclose(strain, np.exp(-10 * model.time_step / time))


def test_squares_of_polynomials_have_no_negative_eigenvalues():
    random = np.random.default_rng(7)
    points, roots = random.uniform(-1.0, 1.0, (60, 2)), 0.3 * random.standard_normal((6, 3, 3))
    true = SquaredPolynomial(
        roots + roots.swapaxes(1, 2) + 9.0 * np.eye(3) * (np.arange(6) == 0)[:, None, None], 2
    )
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
