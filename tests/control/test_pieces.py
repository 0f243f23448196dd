"""Paths, polynomials, the response of inputs, quadratic programs, and what control has without a simulator."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from warp_resphys.control.controllers import JacobianFeedback
from warp_resphys.control.linear_model import fit_linear
from warp_resphys.control.plan import Planner, solve_program, tracked_of
from warp_resphys.control.polynomials import Polynomial, powers
from warp_resphys.control.reduced_force import Evaluator
from warp_resphys.control.task import Path
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
        assert len(found) == 251
        np.testing.assert_array_equal(found[0], lead)
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
        with pytest.raises(InputError, match=said):
            Path(**given).timed(seconds, 0.01)


class TestPolynomials:
    def test_a_cubic_is_found_again(self):
        random = np.random.default_rng(0)
        points, count = random.random((80, 3)), len(powers(3, 3))
        wanted = Polynomial(random.standard_normal((count, 2, 2)), 3)
        found = Polynomial.fitted(points, wanted(points), 3)
        np.testing.assert_allclose(found(points[:5]), wanted(points[:5]), atol=1e-5)


def program(target, rows, least, most, high):
    """The point nearest to a target, between zero and upper bounds, with one linear constraint."""
    target = np.array(target)
    return solve_program(
        np.eye(len(target)), -target, np.array([rows]), np.array([least]), np.array([most]), 0.0 * target, high
    )


class TestPrograms:
    def test_a_bound_and_a_rate_hold(self):
        """The nearest point to (3, 2) with x at most 1 and y - x at most -0.5."""
        nearest = program([3.0, 2.0], [-1.0, 1.0], -9.0, -0.5, np.array([1.0, 9.0]))
        np.testing.assert_allclose(nearest, [1.0, 0.5], atol=1e-3)

    def test_contradicting_constraints_are_refused(self):
        with pytest.raises(InputError, match="bounds and rate limits"):
            program([0.0], [1.0], 2.0, 3.0, np.ones(1))

    def test_a_missing_package_is_named(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "piqp", None)
        with pytest.raises(InputError, match=r"warp-resphys\[control\]"):
            program([0.0], [1.0], 0.0, 0.0, np.ones(1))

    def test_points_are_means_of_markers(self):
        markers = np.arange(9.0).reshape(3, 3)
        np.testing.assert_allclose(tracked_of("abc", ["a", "c"]) @ markers.ravel(), markers[[0, 2]].mean(0))
        with pytest.raises(InputError, match="tracked names 'd'"):
            tracked_of("abc", ["d"])


class TestEvaluator:
    @pytest.mark.parametrize(("activation", "blocks"), [("silu", 1), ("normalised_elu", 3)])
    def test_it_is_the_network(self, activation, blocks):
        torch.manual_seed(0)
        samples = torch.randn(20, 4, 3, dtype=torch.float64)
        config = {"kind": "reduced", "position_modes": 3, "velocity_modes": 2, "force_modes": 5, "blocks": blocks,
                  "layers": 2, "width": 16, "activation": activation}  # fmt: skip
        network = build_model(
            ResidualForce, NetworkSettings(**config), samples[0], samples, samples, samples, samples[:, 0]
        ).double()
        network.fit_linear(torch.randn(40, 8), torch.randn(40, 5), 0.1)
        inputs = 3.0 * torch.randn(7, 8, dtype=torch.float64)
        range_ = Range.of(torch.randn(30, 8, dtype=torch.float64))
        for guard in (None, range_):
            wanted = network.standardised(inputs if guard is None else guard.clamp(inputs))[0]
            outputs, _ = Evaluator(network, guard)(inputs.numpy())
            np.testing.assert_allclose(outputs, wanted.detach().numpy(), atol=1e-12)
        fading = replace(range_, missed=torch.ones(2, dtype=torch.float64))
        weight = fading.weight(inputs)
        assert (weight < 1.0).sum() > 0
        assert weight.max() > 0.0
        force = weight[:, None, None] * network.decode(range_.clamp(inputs))[0][0]
        outputs, left = Evaluator(network, fading)(inputs.numpy())
        np.testing.assert_array_equal(left, range_.excludes(inputs))
        np.testing.assert_allclose(outputs, network.encode_outputs(force).detach().numpy(), atol=1e-12)
        np.testing.assert_allclose(outputs, fading.outputs(network, inputs).detach().numpy(), atol=1e-12)


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
        """A model of four trials, the last for validation; a path; and the error of a plan for any path."""
        random = np.random.default_rng(3)
        turn = 0.97 * np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]])
        matrices = turn, np.array([[0.0], [0.01]]), random.standard_normal((6, 2))
        trials = [driven_line(100, random, matrices) for _ in range(4)]
        model = fit_linear(trials[:3], trials[3:], np.ones(1), 0.01)
        start, path = model.state([np.full(6, 0.1)] * 4), driven_line(30, random, matrices)[0][1:]
        limits = LimitsOfInputs(low=0.0, high=1.0, rate=200.0)

        def error(wanted):
            inputs = Planner(model, np.eye(6), limits, wanted, 30, 30, 1e-9, 2).plan(0, start)
            return np.abs(model.respond(start, inputs[:, None])[:, 0] - path)

        return model, path, error

    def test_a_linear_system_is_identified_and_planned_with(self, fitted):
        model, path, error = fitted
        assert model.validation_mm < 1e-3
        assert error(path).max() < 0.05 * np.abs(path - 0.1).max()

    def test_points_are_free_where_the_path_is_nan(self, fitted):
        _, path, error = fitted
        free = np.arange(30) < 15
        without, held = (error(np.where(free[:, None], value, path))[~free] for value in (np.nan, 0.1))
        assert without.max() < 0.2 * held.max()

    def test_feedback_finds_a_place_that_its_jacobian_gets_wrong(self):
        true = np.array([[1e-3, 0.0, 5e-4], [0.0, 2e-3, 0.0]])
        wrong = true * 1.5 + 2e-4
        limits = LimitsOfInputs(low=0.0, high=10.0, rate=100.0)
        goal, command = np.array([5e-3, 8e-3, 0.0]), np.zeros(3)
        tracked = np.eye(2, 3)
        feedback = JacobianFeedback(wrong, limits, 5.0, 0.01, tracked, np.tile(goal[:2], (300, 1)), np.zeros((1, 3)))
        for number in range(300):
            command = feedback(number, np.append(true @ command, 0.0)[None])
            assert (command >= 0.0).all()
            assert (command <= 10.0).all()
        np.testing.assert_allclose(true @ command, goal[:2], atol=1e-4)
