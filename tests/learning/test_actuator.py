"""Learned changes of the inputs, on a beam with two tendons that creep and act on each other."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import warp_resphys as wr
from support.actuators import functions_of, network_of
from support.refusals import refuses
from warp_resphys import ObservedMotions, evaluate, fit_actuator
from warp_resphys.data.input_network import Actuator, InputNetwork
from warp_resphys.data.input_response import InputResponse
from warp_resphys.energies import Sphere
from warp_resphys.io.errors import InputError
from warp_resphys.learning.evaluation import left_out_in_turn
from warp_resphys.learning.identification.search import Identification
from warp_resphys.learning.identification.sensitivity import sensitivities
from warp_resphys.learning.observed_motions import Identified
from warp_resphys.learning.residuals import actuator_fit
from warp_resphys.learning.residuals.actuator_fit import ActuatorFitting, felt_inputs
from warp_resphys.learning.residuals.linearised import Linearised, chosen_penalty
from warp_resphys.settings.learning import ActuatorSettings

MESH = wr.box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(5, 1, 1))
ROUTES = {
    side: [[x, y, 0.02] for x in (0.0, 0.05, 0.1)] for side, y in (("left", 0.0), ("right", 0.02))
}
BODY = wr.Body(MESH, fixed=wr.select_vertices(MESH, x=0.0), energies=[wr.Tendons(ROUTES)])
MARKERS = wr.bind_markers(
    MESH, np.array([[0.1, 0.01, 0.022], [0.06, 0.01, 0.022], [0.1, 0.022, 0.01]]), ["a", "b", "c"]
)
STEP, STEPS, TRIALS = 0.03, 15, 8
QUICK = ActuatorSettings(filters=(0.3,), centres=30, epochs=2)


@pytest.fixture
def given_penalty(monkeypatch):
    """A small penalty of the weights in place of the chosen one, which takes most of a training."""
    monkeypatch.setattr(actuator_fit, "chosen_penalty", lambda *_: 1e-4)


@pytest.fixture(scope="module")
def simulator():
    material = wr.Corotated(264e3, 0.45, density=1070.0, stiffness_damping=5e-3)
    return wr.Simulator(BODY, material, time_step=STEP)


def tensions():
    """(T, B, 2) smooth commands, each from its own tension on [N]."""
    random = np.random.default_rng(3)
    phases, rates = random.uniform(0.0, 6.3, (TRIALS, 2)), random.uniform(1.5, 4.0, (TRIALS, 2))
    times = STEP * np.arange(STEPS)[:, None, None]
    return torch.as_tensor(0.5 * (1.0 + np.sin(phases + rates * times)))


def acting(commands):
    """Tensions of an actuator with friction between its tendons and a slow share."""
    response = InputResponse(STEP, filters=(0.3,))
    _, means, _ = response(response.steady(commands[0]), commands)
    return 0.8 * commands + 0.3 * means[0] - 0.4 * commands * commands.flip(-1)


def observed(simulator, commands, effective):
    start = simulator.static_equilibrium(wr.Inputs(tendon_tension=effective[0]))
    q = simulator.rollout(start, STEPS, wr.Inputs(tendon_tension=effective)).q
    seen = torch.stack([MARKERS(positions) for positions in q])
    resting = wr.Inputs(tendon_tension=commands[0])
    return ObservedMotions.of(
        simulator, seen, None, wr.Inputs(tendon_tension=commands), resting, observation=MARKERS
    )


@pytest.fixture(scope="module")
def motions(simulator):
    return observed(simulator, tensions(), acting(tensions()))


@pytest.fixture(scope="module")
def learned(simulator, motions):
    return fit_actuator(simulator, motions, validation=["motion 3"], train=MANY, settings=QUICK)


MANY = ("motion 0", "motion 1", "motion 2", "motion 6", "motion 7")
FEW = MANY[:3]  # for what takes no good actuator
OTHERS = ("motion 4", "motion 5")


def trained():
    """A network with weights, and the values that it was made for."""
    values = torch.tensor([1.0, 2.0, 1.0, 2.0]) * torch.rand(
        50, 4, generator=torch.Generator().manual_seed(0)
    )
    network = InputNetwork.of_training(values, (0.1,), 12)
    torch.manual_seed(0)
    torch.nn.init.normal_(network.weights, std=0.3)
    return network.requires_grad_(False), values.double()


def test_an_untrained_network_changes_nothing_and_zero_inputs_never_change():
    network, values = trained()
    assert not InputNetwork.of_training(values, (0.1,), 12)(values).any()
    assert network(values).abs().mean() > 1e-2
    torch.testing.assert_close(
        network(torch.zeros(1, 4, dtype=torch.float64)), torch.zeros(1, 2).double()
    )


def test_weights_are_those_of_a_gaussian_process_that_is_zero_at_zero():
    """The covariance of two values under random weights of unit variance,
    at centres, where the basis is exact.
    """
    network, _ = trained()
    functions = functions_of(network, network.unit * network.centres) / network.unit
    found = functions @ functions.T
    a, b = network.centres[:, None], network.centres[None]
    kernel = [
        torch.exp(-0.5 * (x - y).square().sum(-1)) for x, y in ((a, b), (a, 0.0 * b), (0.0 * a, b))
    ]
    torch.testing.assert_close(found, kernel[0] - kernel[1] * kernel[2], atol=1e-4, rtol=0.0)


def test_a_network_fades_beyond_the_values_of_the_training():
    network, values = trained()
    mean = values.mean(0)
    away = values[values.norm(dim=1).argmax()] - mean
    torch.testing.assert_close(network(mean + 1e4 * away), 1e-2 * network(mean + 1e3 * away))
    x = (values - mean) / network.unit
    # It fades from the double on.
    assert float(((x @ network.precision) * x).sum(1).max()) == pytest.approx(0.5)


def test_the_centres_of_few_poses_are_these():
    values = torch.tensor([[0.0, 0.0], [1.0, 0.5], [2.0, 0.5], [1.0, 0.5]])
    assert len(InputNetwork.of_training(values, (), 50).centres) == 2


def test_a_network_is_the_same_from_plain_data_and_for_numpy():
    network, values = trained()
    again = InputNetwork.of_plain(network.plain())
    torch.testing.assert_close(again(values), network(values))
    np.testing.assert_array_equal(network.added(values.numpy()), network(values).numpy())


def test_a_series_at_once_is_the_series_step_by_step_and_settles_at_the_still_input():
    response = InputResponse(STEP, 1.2, rise=0.05, filters=(0.2,), network=trained()[0], lower=0.0)
    commands = torch.rand(20, 3, 2, dtype=torch.float64)
    whole, means, _ = response(response.steady(commands[0]), commands)
    memory, steps = response.steady(commands[0]), []
    for now in commands:
        one, mean, memory = response(memory, now[None])
        steps.append((one[0], mean[:, 0]))
    torch.testing.assert_close(whole, torch.stack([one for one, _ in steps]))
    torch.testing.assert_close(means, torch.stack([mean for _, mean in steps], 1))
    held = commands[:1].expand(400, -1, -1)
    settled, mean, _ = response(response.steady(0.0 * commands[0]), held)
    torch.testing.assert_close(settled[-1], response.still(commands[0]))
    torch.testing.assert_close(
        response.steady(commands[0])["means"][0], mean[0, -1], rtol=1e-5, atol=1e-7
    )


def test_the_actuator_is_learned_and_predicts_other_motions(simulator, motions, learned):
    alone = evaluate(simulator, motions, names=OTHERS).mean()
    found = evaluate(simulator, motions, names=OTHERS, parameters=learned).mean()
    assert alone > 1e-3
    assert found < 0.4 * alone
    assert learned.test["used"]
    assert learned.test["trials"] == ["motion 3"]
    (felt,) = felt_inputs(motions.replay(simulator, OTHERS), {}, QUICK.filters).values()
    commands = tensions()[:, [4, 5]]
    expected = acting(commands) - commands
    added = learned.actuator["tendon_tension"](felt[1:])
    assert (added - expected).abs().mean() < 0.3 * expected.abs().mean()


@pytest.mark.usefixtures("given_penalty")
def test_an_actuator_that_has_nothing_to_learn_is_not_used(simulator):
    commands = tensions()
    motions = observed(simulator, commands, commands)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(motions.trials.observed.shape)
    motions = replace(
        motions, trials=replace(motions.trials, observed=motions.trials.observed + noise)
    )
    found = fit_actuator(simulator, motions, train=FEW, settings=QUICK.changed(epochs=1))
    assert not found.test["used"]
    assert (found.test["split"], len(found.test["trials"])) == ("left-out training", len(FEW))


@pytest.mark.usefixtures("given_penalty")
def test_trials_of_several_sessions_are_tested_under_their_own_names(simulator, motions):
    """Errors of trials left out in turn, of sessions that alternate,
    and a session that is never driven.
    """
    inputs = {"tendon_tension": motions.trials.inputs["tendon_tension"].copy()}
    inputs["tendon_tension"][1] = 0.0
    trials = replace(motions.trials, sessions=("a", "b") * (TRIALS // 2), inputs=inputs)
    mixed = replace(motions, trials=trials)
    names = trials.names[:4]
    fitting = ActuatorFitting(simulator, mixed, names)
    folds = left_out_in_turn(trials, names)
    assert folds
    assert not left_out_in_turn(trials, names[:-1], names[-1:])
    _, test = fitting._held_out(folds, QUICK.changed(epochs=1), "fit")
    assert sorted(test["trials"]) == sorted(names)
    below = dict(
        zip(fitting._in_batches(names), fitting._rolled_out(Identified(), names), strict=True)
    )
    losses = [fitting._loss(fold) for fold in folds]
    for fold, loss in zip(folds, losses, strict=True):
        loss.error_mm(None)
        for name, row in zip(fitting._in_batches(fold), loss.judged[-1], strict=True):
            assert row.mean() == pytest.approx(below[name].mean(), rel=1e-6)


@pytest.mark.usefixtures("given_penalty")
def test_known_starts_and_a_part_of_each_trial_can_be_learned_from(simulator, motions):
    start = simulator.static_equilibrium(wr.Inputs(tendon_tension=acting(tensions())[0]))
    initial = torch.stack([start.q, start.v], 1).numpy()
    given = replace(motions.trials, begins=("given",) * TRIALS, initial=initial)
    part = replace(motions, trials=given, train_fraction=0.73)
    found = fit_actuator(
        simulator, part, train=FEW, validation=["motion 3"], settings=QUICK.changed(epochs=1)
    )
    assert found.test["error_mm"] < found.test["below_mm"]


@pytest.mark.usefixtures("given_penalty")
def test_a_network_may_take_the_inputs_alone_and_obstacles_are_no_actuators(simulator, motions):
    settings = QUICK.changed(filters=(), epochs=1)
    found = fit_actuator(
        simulator, motions, train=FEW[1:], validation=["motion 0"], settings=settings
    )
    assert found.test["error_mm"] < found.test["below_mm"]
    response = InputResponse(STEP, network=found.actuator["tendon_tension"])
    commands = tensions()
    assert response(response.steady(commands[0]), commands)[0].shape == commands.shape
    wall = Sphere(position=(0.05, 0.01, -0.05), radius=0.01, moves=True)
    floor = wr.Body(MESH, fixed=BODY.fixed_vertices, energies=[wr.Contact({"wall": wall})])
    bare = wr.Simulator(floor, wr.Corotated(264e3, 0.45), time_step=STEP)
    q = bare.rollout(bare.rest_state(), 3).q
    moved = ObservedMotions.of(
        bare, q, bare.rest_state(), wr.Inputs(obstacle_move_z=torch.zeros(3, 1, 1).double())
    )
    refuses(InputError, "no inputs whose actuator could be learned", fit_actuator, bare, moved)


def test_derivatives_by_parameters_are_those_of_the_motion_with_the_actuator(
    simulator, motions, learned
):
    alone = Identification({"youngs_modulus": 264e3})
    both = replace(alone, actuator=learned.actuator), alone
    points = [
        sensitivities(simulator, motions, ["motion 4"], one)["motion 4"].points for one in both
    ]
    replay = motions.replay(simulator, ["motion 4"], learned)
    shown = replay(motions.start(replay, learned))
    np.testing.assert_allclose(points[0], shown[0, 0].numpy(), atol=1e-6)
    assert np.abs(np.subtract(*points)).max() > 1e-4


def test_poses_at_rest_teach_what_acts_in_the_end(simulator):
    commands = torch.as_tensor(np.random.default_rng(1).uniform(0.0, 1.0, (8, 2)))
    still = wr.Inputs(tendon_tension=1.1 * commands - 0.4 * commands * commands.flip(-1))
    seen = MARKERS(simulator.static_equilibrium(still).q).expand(2, -1, -1, -1)
    given = wr.Inputs(tendon_tension=commands)
    motions = ObservedMotions.of(simulator, seen, None, given, given, observation=MARKERS)
    rest = MARKERS(simulator.rest_state(8).q).numpy()
    trials = replace(
        motions.trials, begins=("static",) * 8, times=0.0 * motions.trials.times, held=rest
    )
    motions = replace(motions, trials=trials)
    poses = trials.names
    found = fit_actuator(simulator, motions, train=poses[:6], validation=poses[6:7], settings=QUICK)
    errors = [
        evaluate(simulator, motions, names=poses[7:], parameters=one)[0].mean()
        for one in (None, found)
    ]
    assert errors[1] < 0.5 * errors[0]
    # One pose has no spread, so that training poses are left out in turn.
    assert (found.test["split"], sorted(found.test["trials"])) == (
        "left-out training",
        sorted(poses[:6]),
    )
    assert not left_out_in_turn(trials, poses[:6], poses[6:8])
    # A fold that leaves no pose with inputs would have nothing to fit.
    alone = {"tendon_tension": np.zeros_like(trials.inputs["tendon_tension"])}
    alone["tendon_tension"][0] = 1.0
    released = replace(motions, trials=replace(trials, inputs=alone))
    folds = ActuatorFitting(simulator, released, poses[:6], poses[6:7])._folds()
    assert len(folds) == 2
    assert poses[0] not in {*folds[0], *folds[1]}


@pytest.mark.usefixtures("given_penalty")
def test_training_that_was_interrupted_goes_on_as_if_it_had_not_been(simulator, motions):
    fitting, kept = ActuatorFitting(simulator, motions, MANY[:2], ("motion 3",)), []
    two = QUICK.changed(epochs=2)
    whole, training = fitting.fit(two, save=kept.append)
    fitting.fit(QUICK.changed(epochs=1), save=kept.append)
    again, resumed = fitting.fit(two, resumed=kept[-1])
    assert resumed["epochs"] == training["epochs"]
    torch.testing.assert_close(
        again.actuator["tendon_tension"].weights, whole.actuator["tendon_tension"].weights
    )


@pytest.fixture(scope="module")
def linearised_motions(simulator, motions):
    """Linearised motions of FEW and their replay, without an actuator."""
    ((replay, start),) = ActuatorFitting(simulator, motions, FEW)._replays(FEW)
    felt = felt_inputs(replay, {}, QUICK.filters)
    (values,) = felt.values()
    model = Actuator(
        {
            "tendon_tension": InputNetwork.of_training(
                values.flatten(0, 1), QUICK.filters, QUICK.centres
            )
        }
    )
    return Linearised.of(replay, start, {}, model, felt), model, replay, start


def test_the_penalty_grows_with_the_noise_and_the_model_stays(linearised_motions):
    one, model, replay, _ = linearised_motions
    noise = torch.randn(one.points.shape, generator=torch.Generator().manual_seed(0)).double()
    noisy = replace(replay.trials, observed=replay.trials.observed + 3e-3 * noise)
    both = one, replace(one, replay=replay.changed(trials=noisy))
    penalties = [chosen_penalty([linear], [replay.trials.loss_weight], model) for linear in both]
    assert penalties[0] < 0.05 * penalties[1]
    assert not model.inputs["tendon_tension"].weights.any()


def test_linearised_motions_follow_changes_of_the_inputs_in_time(linearised_motions):
    one, model, replay, start = linearised_motions
    before = one.errors(one.changes(model))
    model = Actuator(
        {"tendon_tension": network_of(lambda values: 2e-3 * values[:, :2], 1.0, 2, QUICK.filters)}
    )
    exact = replay.errors(replay.changed(actuator=model.inputs)(start))[0] - before
    changes = one.changes(model)
    at_once = replace(one, kernel=torch.ones(1).double()).errors(changes) - before
    followed = one.errors(changes) - before
    assert (at_once - exact).norm() > 1e-2 * exact.norm()
    assert (followed - exact).norm() < 0.2 * (at_once - exact).norm()


def test_trials_without_inputs_are_refused(simulator):
    bare = wr.Simulator(
        wr.Body(MESH, fixed=BODY.fixed_vertices), wr.Corotated(264e3, 0.45), time_step=STEP
    )
    q = bare.rollout(bare.rest_state(), 4).q
    motions = ObservedMotions.of(bare, q, bare.rest_state())
    refuses(
        InputError,
        "motion 0 have no inputs whose actuator could be learned",
        fit_actuator,
        bare,
        motions,
    )
