"""Identification from sparse, noisy markers, and its uncertainty against least squares
and correlated errors.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.refusals import refuses
from support.slopes import differences
from support.swinging_beam import MARKERS, MESH, TIP, blank, double, simulated
from warp_resphys import (
    Body,
    ConvergenceError,
    InputError,
    Inputs,
    Simulator,
    SolverSettings,
    select_vertices,
)
from warp_resphys.io.errors import DataFileError
from warp_resphys.learning.identification.misfit import Misfit
from warp_resphys.learning.identification.search import (
    Identification,
    first_points,
    search_parameters,
)
from warp_resphys.learning.identification.uncertainty import (
    LinearMisfit,
    LinearTrial,
    uncertainty_of,
)
from warp_resphys.learning.metrics import redundancy
from warp_resphys.learning.placement import Accuracy, PlacedMarkers, Placement
from warp_resphys.learning.replay import Replay
from warp_resphys.learning.start import Start
from warp_resphys.settings.learning import Bounds, Prior

TRUTH = {"youngs_modulus": 215e3, "stiffness_damping": 0.002}
RANGES = {
    "youngs_modulus": Bounds(lower=1e5, upper=1e6, logarithmic=True),
    "stiffness_damping": Bounds(lower=0.0, upper=0.02),
}
FIRST = {"youngs_modulus": 400e3, "stiffness_damping": 0.0}


def simulator(kind=Simulator, **options):
    return kind(
        Body(MESH, select_vertices(MESH, x=0.0)), time_step=0.01, integrator="bdf2", **options
    )


def replay_of(sim, truth, masses=(0.0, 0.05), frames=25, noise=0.0):
    """Motions from rest under gravity with the true parameters, and their beginning."""
    release = Start(sim.rest_state(len(masses)), torch.zeros(len(masses), dtype=torch.float64))
    return simulated(
        Replay(sim, MARKERS, blank(frames, masses)), release, truth, noise=noise
    ), release


def test_stiffness_and_density_of_a_body_without_weights_are_correlated():
    bounds = {
        "youngs_modulus": Bounds(lower=1e5, upper=1e6),
        "density": Bounds(lower=800.0, upper=1500.0),
    }
    truth = {"youngs_modulus": 215e3, "density": 1070.0}
    replay, release = replay_of(simulator(), truth, masses=(0.0,), noise=5e-5)
    misfit = Misfit([(replay, release)], bounds)
    uncertainty = misfit.uncertainty(misfit.to_unit(truth))
    assert uncertainty.correlation[0][1] > 0.999
    assert uncertainty.poorest_deviation > 1.0
    replay, release = replay_of(simulator(), truth, masses=(0.0, 0.05), noise=5e-5)
    weighted = Misfit([(replay, release)], bounds).uncertainty(np.array([0.13, 0.39]))
    assert weighted.poorest_deviation < 0.1


def test_loss_and_derivatives_do_not_depend_on_the_number_of_threads(monkeypatch):
    pair, results = replay_of(simulator(), TRUTH, masses=(0.0, 0.05, 0.02), noise=5e-5), []
    for count in (1, 2):
        monkeypatch.setenv("WARP_RESPHYS_THREADS", str(count))
        misfit = Misfit([pair], RANGES)
        results.append(misfit.linearise(misfit.to_unit(FIRST)))
    one, two = results
    assert (
        [trial.name for trial in two.trials]
        == [trial.name for trial in one.trials]
        == ["m0", "m1", "m2"]
    )
    assert two.loss == one.loss
    np.testing.assert_array_equal(two.gauss_newton, one.gauss_newton)
    np.testing.assert_array_equal(two.gradient, one.gradient)


def test_a_parameter_outside_its_range_ends_on_the_bound():
    bounds = {"youngs_modulus": Bounds(lower=3e5, upper=1e6, logarithmic=True)}
    pair = replay_of(simulator(), {"youngs_modulus": 215e3}, frames=12)
    result = search_parameters(Misfit([pair], bounds), [{"youngs_modulus": 6e5}], 40)
    assert result.at_bounds == ("youngs_modulus",)
    assert result.parameters["youngs_modulus"] == pytest.approx(3e5)


def test_failed_points_are_infinite_and_the_others_unchanged():
    bounds = {"youngs_modulus": Bounds(lower=1.0, upper=1e10, logarithmic=True)}
    replay, release = replay_of(simulator(), {"youngs_modulus": 215e3}, frames=5)
    points = np.linspace(0.0, 1.0, 6)[:, None]
    whole = Misfit([(replay, release)], bounds).losses_or_infinite(points)
    few = Replay(simulator(solver=SolverSettings(max_iterations=10)), MARKERS, replay.trials)
    losses = Misfit([(few, release)], bounds).losses_or_infinite(points)
    good = np.isfinite(losses)
    assert np.isfinite(whole).all()
    assert 0 < good.sum() < 6
    np.testing.assert_allclose(losses[good], whole[good], rtol=1e-5)


def test_a_start_where_the_simulation_fails_is_passed_over():
    class Fragile(Simulator):
        def prepare(self, parameters=None):
            if isinstance(parameters, dict) and bool((parameters["youngs_modulus"] < 150e3).any()):
                raise ConvergenceError("too soft", None, None)
            return super().prepare(parameters)

    replay, release = replay_of(simulator(Fragile), TRUTH, noise=5e-5)
    soft = FIRST | {"youngs_modulus": 120e3}
    misfit = Misfit([(replay, release)], RANGES)
    result = search_parameters(misfit, [soft, FIRST], 40)
    assert result.parameters["youngs_modulus"] == pytest.approx(215e3, rel=1e-3)
    assert result.parameters["stiffness_damping"] == pytest.approx(0.002, rel=0.02)
    assert result.at_bounds == ()
    assert result.history[0] == []
    assert len(result.history[1]) < 25
    refuses(ConvergenceError, r"every start.*: too soft", search_parameters, misfit, [soft], 20)


def test_starts_are_the_first_guess_and_the_best_candidates():
    replay, release = replay_of(simulator(), TRUTH, frames=12)
    misfit = Misfit([(replay, release)], RANGES)
    starts = first_points(misfit, FIRST, 3, 8, seed=0)
    assert len(starts) == 3
    assert starts[0] == pytest.approx(FIRST)
    assert (
        starts
        == first_points(misfit, FIRST, 3, 8, seed=0)
        != first_points(misfit, FIRST, 3, 8, seed=1)
    )
    assert abs(np.log(starts[1]["youngs_modulus"] / 215e3)) < 0.5


def test_identifications_of_other_versions_are_refused():
    """Such as those with the values of trials by another key."""
    for plain, key in (
        ({"own": {"factor@bend": 1.1}}, "own"),
        ({"parameters": {"density": "x"}}, r"parameters\.density"),
    ):
        with pytest.raises(
            DataFileError,
            match=f"^{key} is not of an identification of this version: identify again",
        ):
            Identification.from_plain(plain)


def test_no_parameters_and_a_motion_that_stands_still_are_refused():
    replay, release = replay_of(simulator(gravity=(0.0, 0.0, 0.0)), TRUTH, frames=3)
    refuses(InputError, "nothing to identify", Misfit, [(replay, release)], {})
    still = replay.trials.held[:, None].repeat(1, 3, 1, 1)
    motions = replace(replay.trials, observed=still)
    with pytest.raises(InputError, match="'m0' stay where they were held"):
        Misfit([(Replay(replay.simulator, MARKERS, motions), release)], RANGES)


@pytest.mark.parametrize(
    ("limits", "sentence"),
    [
        ({"lower": 1.0, "upper": 1.0}, "lower is 1: it must be below upper, 1"),
        ({"lower": 0.0, "upper": np.inf}, "upper is inf: it must be a number"),
        (
            {"lower": 0.0, "upper": 1.0, "logarithmic": True},
            "it must be positive, as the scale is logarithmic",
        ),
        (
            {"lower": 0.0, "upper": 1.0, "prior": Prior(mean=2.0, deviation=1.0)},
            "prior.mean is 2, outside of the range",
        ),
        ({"lower": 0.0, "upper": 1.0, "per": "trial"}, "per names trial, but there is no prior"),
    ],
)
def test_bounds_leave_a_range_and_values_of_trials_have_a_prior(limits, sentence):
    refuses(InputError, sentence, Bounds, **limits)


@pytest.mark.parametrize(
    "bounds", [Bounds(lower=1e5, upper=1e6, logarithmic=True), Bounds(lower=-1.0, upper=3.0)]
)
def test_bounds_there_and_back(bounds):
    unit = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)
    values = bounds.from_unit(unit)
    assert [bounds.to_unit(float(v)) for v in values] == pytest.approx(unit.tolist(), abs=1e-12)
    assert float(values[0]) == bounds.lower
    assert float(values[-1]) == pytest.approx(bounds.upper)


def resting_pose(sim):
    """A pose under a weight with the true parameters, and its beginning."""
    still = Replay(sim, MARKERS, blank(frames=1, masses=(0.1,)))
    start = Start.resting(sim.rest_positions[None])
    assert still.is_static
    return simulated(still, start, TRUTH), start


def test_stiffness_and_damping_are_identified_from_poses_and_motions():
    """A pose under a weight depends on the stiffness alone:
    the damping is identified from the motion.
    """
    motion, release = replay_of(simulator(), TRUTH, masses=(0.0,), frames=25)
    pose, start = resting_pose(motion.simulator)
    result = search_parameters(Misfit([(motion, release), (pose, start)], RANGES), [FIRST], 40)
    assert result.parameters["youngs_modulus"] == pytest.approx(215e3, rel=1e-3)
    assert result.parameters["stiffness_damping"] == pytest.approx(0.002, rel=0.02)
    alone = search_parameters(
        Misfit([(pose, start)], {"youngs_modulus": RANGES["youngs_modulus"]}), [FIRST], 40
    )
    assert alone.parameters["youngs_modulus"] == pytest.approx(215e3, rel=1e-3)


DELAYS, FRAMES, BEGIN = (0.013, -0.021, 0.004), 28, 6
DAMPED = TRUTH | {"stiffness_damping": 0.004}
ACCURACY = Accuracy(markers=0.003, shift=0.002)


def late(observe=MARKERS, noise=1e-5):
    """Motions from rest that a force at the tip causes,
    a little later than the inputs say, and their beginning.
    """
    sim, count = simulator(), len(DELAYS)
    force = torch.zeros(FRAMES, count, len(MESH.vertices), 3, dtype=torch.float64)
    force[BEGIN:, :, TIP, 1] = 0.02  # N
    motions = replace(blank(FRAMES, (0.0,) * count), inputs=Inputs(force))
    start = Start.resting(sim.rest_state(count).q)
    delayed = replace(start, delay=double(DELAYS))
    replay = simulated(Replay(sim, MARKERS, motions), delayed, DAMPED, observe, noise, seed=1)
    replay.trials.observed[1, 20:25, 0] = torch.nan
    return replay, start


@pytest.mark.parametrize("placed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_parameters_are_recovered_from_motions_whose_inputs_were_late(placed):
    """With markers that are elsewhere, too, whose places are held by a prior."""
    offsets = 2e-3 * double([[1.0, -0.5, 0.3], [-0.4, 0.6, 1.0], [0.2, 0.8, -1.0]])
    askew = Placement(
        offsets, double([1e-3, 0.0, -1e-3]), double([0.0, 0.0, 0.0]), double([0.0, 0.0, 0.0])
    )
    pair = late(PlacedMarkers.of(MARKERS, askew) if placed else MARKERS)
    more = {"accuracy": ACCURACY} if placed else {}
    result = search_parameters(
        Misfit([pair], RANGES, delay=0.02, **more), [FIRST], 40, labels="abc"
    )
    assert result.parameters["youngs_modulus"] == pytest.approx(215e3, rel=1e-2 if placed else 1e-3)
    assert result.parameters["stiffness_damping"] == pytest.approx(0.004, rel=0.05)
    on_time = search_parameters(Misfit([pair], RANGES, **more), [FIRST], 40, labels="abc")
    assert result.loss < (0.2 if placed else 0.02) * on_time.loss


@pytest.mark.parametrize("accuracy", [None, ACCURACY])
def test_derivatives_are_those_of_the_loss_with_the_best_delays_and_priors(accuracy):
    replay, start = late(noise=1e-4)
    start = replace(start, delay=double([0.002, 0.0, 0.0]))
    ranges = {
        **RANGES,
        "density": Bounds(lower=800.0, upper=1600.0, prior=Prior(mean=1100.0, deviation=50.0)),
    }
    misfit = Misfit([(replay, start)], ranges, accuracy=accuracy, delay=0.02)
    unit = np.array([0.4, 0.25, 0.9])
    for _ in range(2):
        misfit.update_prior_weight(unit)
    linear = misfit.linearise(unit)
    slopes = differences(lambda x: misfit.linearise(x, derivatives=False).loss, unit, 1e-4)
    assert linear.gradient == pytest.approx(np.array(slopes), rel=1e-3)
    assert misfit.losses_or_infinite(unit[None])[0] == pytest.approx(linear.loss, rel=1e-9)
    step, matrix = np.array([1.0, -1.0, 0.5]), linear.gauss_newton
    np.testing.assert_allclose(matrix, matrix.T)
    assert step @ matrix @ step > 0.0


BOUNDS = {
    "stiffness": Bounds(lower=1.0, upper=3.0),
    "damping": Bounds(lower=0.1, upper=10.0, logarithmic=True),
}
UNIT = np.array([0.5, 0.25])


def series(correlation, shape, seed=0):
    """Errors of unit variance, correlated along the first axis."""
    errors = np.random.default_rng(seed).normal(size=shape)
    for k in range(1, len(errors)):
        errors[k] = correlation * errors[k - 1] + np.sqrt(1.0 - correlation**2) * errors[k]
    return errors


def linear(rows, slopes):
    """One trial without priors."""
    return LinearMisfit(
        [LinearTrial(rows, slopes, rows.size)], np.zeros(0), np.zeros((0, slopes.shape[1])), 1.0
    )


def test_independent_errors_have_the_covariance_of_least_squares():
    frames, coordinates = 400, 6
    rows = 0.1 * series(0.0, (frames, coordinates))
    jacobian = np.random.default_rng(1).normal(size=(frames * coordinates, 2)) @ [
        [1.0, 0.6],
        [0.0, 0.5],
    ]
    result = uncertainty_of(linear(rows, jacobian), BOUNDS, UNIT)
    covariance = 0.1**2 * np.linalg.inv(jacobian.T @ jacobian)
    deviation = np.sqrt(np.diag(covariance))
    slopes = [2.0, 0.1 * 100**0.25 * np.log(100.0)]
    np.testing.assert_allclose(list(result.deviation.values()), deviation * slopes, rtol=0.1)
    assert result.correlation[0][1] == pytest.approx(covariance[0, 1] / deviation.prod(), abs=0.05)
    values, vectors = np.linalg.eigh(covariance)
    assert abs(np.dot(list(result.poorest.values()), vectors[:, 1])) == pytest.approx(1.0, abs=1e-6)
    assert result.poorest_deviation == pytest.approx(np.sqrt(values[1]), rel=0.1)


@pytest.mark.parametrize("correlation", [0.5, 0.8])
def test_correlated_frames_are_worth_fewer(correlation):
    """The mean of an autoregressive series varies (1 + r) / (1 - r) times
    as much as that of independent values.
    """
    rows = series(correlation, (4000, 5))
    expected = (1.0 + correlation) / (1.0 - correlation)
    assert redundancy(rows) == pytest.approx(expected, rel=0.15)
    same = linear(rows, np.ones((rows.size, 1)))
    deviation = uncertainty_of(same, {"a": BOUNDS["stiffness"]}, UNIT[:1]).deviation["a"]
    assert deviation == pytest.approx(2.0 * np.sqrt(expected / rows.size), rel=0.1)


def test_what_the_data_do_not_change_is_uncertain_by_its_range():
    """A uniform variable in [0, 1] has the standard deviation 1 / sqrt(12)."""
    rows = series(0.0, (100, 3))
    jacobian = np.stack([np.ones(rows.size), np.zeros(rows.size)], axis=1)
    result = uncertainty_of(linear(rows, jacobian), BOUNDS, UNIT)
    assert result.poorest == {"stiffness": 0.0, "damping": 1.0}
    assert result.poorest_deviation == pytest.approx(12.0**-0.5)
    assert result.deviation["damping"] == pytest.approx(
        12.0**-0.5 * 0.1 * 100**0.25 * np.log(100.0)
    )
