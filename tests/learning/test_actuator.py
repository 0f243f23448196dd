"""Learned changes of the inputs, on a beam with two tendons that creep and act on each other."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters

import warp_resphys as wr
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
from warp_resphys.learning.residuals.actuator_fit import ActuatorFitting, felt_inputs
from warp_resphys.learning.residuals.in_the_loop import InTheLoop
from warp_resphys.learning.residuals.linearised import Linearised, gauss_newton_factor
from warp_resphys.settings.learning import ActuatorSettings

MESH = wr.box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(5, 1, 1))
ROUTES = {side: [[x, y, 0.02] for x in (0.0, 0.05, 0.1)] for side, y in (("left", 0.0), ("right", 0.02))}
BODY = wr.Body(MESH, fixed=wr.select_vertices(MESH, x=0.0), energies=[wr.Tendons(ROUTES)])
MARKERS = wr.bind_markers(
    MESH, np.array([[0.1, 0.01, 0.022], [0.06, 0.01, 0.022], [0.1, 0.022, 0.01]]), ["a", "b", "c"]
)
STEP, STEPS, TRIALS = 0.02, 40, 6
QUICK = ActuatorSettings(filters=(0.3,), width=6, rounds=3, epochs=2, penalty=1e-5)


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
    return ObservedMotions.of(simulator, seen, None, wr.Inputs(tendon_tension=commands), resting, observation=MARKERS)


@pytest.fixture(scope="module")
def motions(simulator):
    return observed(simulator, tensions(), acting(tensions()))


@pytest.fixture(scope="module")
def learned(simulator, motions):
    return fit_actuator(simulator, motions, validation=["motion 3"], train=MANY, settings=QUICK)


MANY = ("motion 0", "motion 1", "motion 2")
OTHERS = ("motion 4", "motion 5")


def trained():
    """A network with weights, and the range that it was made for."""
    network = InputNetwork(torch.tensor([0.1, 0.2, 0.1, 0.2]), torch.tensor([1.0, 2.0, 1.0, 2.0]), (0.1,), 3)
    torch.manual_seed(0)
    for weight in network.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    return network.requires_grad_(False)


def test_an_untrained_network_changes_nothing_and_zero_inputs_never_change():
    fresh = InputNetwork(torch.zeros(4), torch.ones(4), (0.1,), 3)
    values = torch.rand(5, 4, dtype=torch.float64)
    assert not fresh(values).any()
    assert trained()(values).abs().mean() > 1e-2
    torch.testing.assert_close(trained()(torch.zeros(1, 4, dtype=torch.float64)), torch.zeros(1, 2).double())


def test_beyond_the_range_of_the_training_a_network_adds_no_more():
    network, far = trained(), torch.tensor([[1.25, 2.5, 1.25, 2.5]], dtype=torch.float64)
    torch.testing.assert_close(network(100.0 * far), network(far))
    assert not torch.allclose(network(0.5 * far), network(far))


def test_a_network_is_the_same_from_plain_data_and_for_numpy():
    network, values = trained(), torch.rand(5, 4, dtype=torch.float64)
    again = InputNetwork.of_plain(network.plain())
    torch.testing.assert_close(again(values), network(values), rtol=0.0, atol=0.0)
    np.testing.assert_array_equal(network.added(values.numpy()), network(values).numpy())


def test_a_series_at_once_is_the_series_step_by_step_and_settles_at_the_still_input():
    response = InputResponse(STEP, 1.2, rise=0.05, filters=(0.2,), network=trained(), lower=0.0)
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
    torch.testing.assert_close(response.steady(commands[0])["means"][0], mean[0, -1], rtol=1e-5, atol=1e-7)


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


def test_the_first_weights_alone_bring_the_motions_closer(simulator, motions):
    fitting = ActuatorFitting(simulator, motions, MANY, ("motion 3",))
    begun = replace(Identified(), actuator=fitting._begun(MANY, QUICK, 0, "fit", 3)[0].inputs)
    errors = [np.mean([row.mean() for row in fitting._rolled_out(one, OTHERS)]) for one in (begun, Identified())]
    assert errors[0] < 0.4 * errors[1]


def test_an_actuator_that_has_nothing_to_learn_is_not_used(simulator):
    commands = tensions()
    motions = observed(simulator, commands, commands)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(motions.trials.observed.shape)
    motions = replace(motions, trials=replace(motions.trials, observed=motions.trials.observed + noise))
    found = fit_actuator(simulator, motions, train=MANY, settings=QUICK.changed(rounds=1, epochs=1))
    assert not found.test["used"]
    assert (found.test["split"], len(found.test["trials"])) == ("left-out training", 3)


def test_trials_of_several_sessions_are_tested_under_their_own_names(simulator, motions):
    """Errors of trials left out in turn, of sessions that alternate, and a session that is never driven."""
    trials = replace(motions.trials, sessions=("a", "b", "a", "b", "a", "b"))
    trials.inputs["tendon_tension"][1] = 0.0
    mixed = replace(motions, trials=trials)
    fitting = ActuatorFitting(simulator, mixed, trials.names)
    folds = left_out_in_turn(trials, trials.names)
    _, test = fitting._held_out(folds, QUICK.changed(rounds=1, epochs=0), 0, "fit")
    assert sorted(test["trials"]) == sorted(trials.names)
    below = dict(zip(fitting._in_batches(trials.names), fitting._rolled_out(Identified(), trials.names), strict=True))
    losses = [fitting._loss(fold) for fold in folds]
    for fold, loss in zip(folds, losses, strict=True):
        loss.error_mm(None)
        for name, row in zip(fitting._in_batches(fold), loss.judged[-1], strict=True):
            assert row.mean() == pytest.approx(below[name].mean(), rel=1e-6)


def test_known_starts_and_a_part_of_each_trial_can_be_learned_from(simulator, motions):
    start = simulator.static_equilibrium(wr.Inputs(tendon_tension=acting(tensions())[0]))
    initial = torch.stack([start.q, start.v], 1).numpy()
    given = replace(motions.trials, begins=("given",) * TRIALS, initial=initial)
    part = replace(motions, trials=given, train_fraction=0.73)
    found = fit_actuator(simulator, part, train=MANY, settings=QUICK.changed(rounds=1, epochs=1))
    assert found.test["error_mm"] < found.test["below_mm"]


def test_a_network_may_take_the_inputs_alone_and_obstacles_are_no_actuators(simulator, motions):
    settings = QUICK.changed(filters=(), rounds=1, epochs=0)
    found = fit_actuator(simulator, motions, train=MANY, validation=["motion 3"], settings=settings)
    assert found.test["error_mm"] != found.test["below_mm"]
    response = InputResponse(STEP, network=found.actuator["tendon_tension"])
    commands = tensions()
    assert response(response.steady(commands[0]), commands)[0].shape == commands.shape
    wall = Sphere(position=(0.05, 0.01, -0.05), radius=0.01, moves=True)
    floor = wr.Body(MESH, fixed=BODY.fixed_vertices, energies=[wr.Contact({"wall": wall})])
    bare = wr.Simulator(floor, wr.Corotated(264e3, 0.45), time_step=STEP)
    q = bare.rollout(bare.rest_state(), 3).q
    moved = ObservedMotions.of(bare, q, bare.rest_state(), wr.Inputs(obstacle_move_z=torch.zeros(3, 1, 1).double()))
    refuses(InputError, "no inputs whose actuator could be learned", fit_actuator, bare, moved)


def test_derivatives_by_parameters_are_those_of_the_motion_with_the_actuator(simulator, motions, learned):
    alone = Identification({"youngs_modulus": 264e3})
    both = replace(alone, actuator=learned.actuator), alone
    points = [sensitivities(simulator, motions, ["motion 4"], one)["motion 4"].points for one in both]
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
    trials = replace(motions.trials, begins=("static",) * 8, times=0.0 * motions.trials.times, held=rest)
    motions = replace(motions, trials=trials)
    poses = trials.names
    found = fit_actuator(simulator, motions, train=poses[:6], validation=poses[6:7], settings=QUICK.changed(epochs=0))
    errors = [evaluate(simulator, motions, names=poses[7:], parameters=one)[0].mean() for one in (None, found)]
    assert errors[1] < 0.5 * errors[0]


def test_training_that_was_interrupted_goes_on_as_if_it_had_not_been(simulator, motions):
    fitting, kept = ActuatorFitting(simulator, motions, MANY, ("motion 3",)), []
    whole, training = fitting.fit(QUICK, save=kept.append)
    fitting.fit(QUICK.changed(epochs=1), save=kept.append)
    again, resumed = fitting.fit(QUICK, resumed=kept[-1])
    assert [row["epoch"] for row in resumed["epochs"]] == [row["epoch"] for row in training["epochs"]]
    for one, other in zip(
        whole.actuator["tendon_tension"].parameters(), again.actuator["tendon_tension"].parameters(), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9)


def test_the_scale_of_the_loss_changes_nothing(simulator, motions):
    fitting, weights = ActuatorFitting(simulator, motions, MANY), []
    for scale in (1.0, 2.0**-30):
        (model, _), loss = fitting._begun(MANY, QUICK, 0, "fit", 0), fitting._loss(MANY)
        loss.weights = [scale * weight for weight in loss.weights]
        InTheLoop(model, loss, loss, QUICK.changed(penalty=0.0)).run_epoch()
        weights.append(torch.cat([weight.detach().flatten() for weight in model.parameters()]))
    assert weights[0].any()
    torch.testing.assert_close(*weights)


def linearised_motions(simulator, motions, deviation):
    """Linearised motions of MANY, and a network with random weights."""
    fitting = ActuatorFitting(simulator, motions, MANY)
    ((replay, start),) = fitting._replays(MANY)
    model = Actuator({"tendon_tension": InputNetwork(torch.zeros(4), torch.ones(4), QUICK.filters, 3)})
    torch.manual_seed(0)
    for weight in model.parameters():
        torch.nn.init.normal_(weight, std=deviation)
    return Linearised.of(replay, start, {}, model, felt_inputs(replay, {}, QUICK.filters)), model


def test_the_gauss_newton_matrix_is_the_hessian_where_the_motions_are_met(simulator, motions):
    one, model = linearised_motions(simulator, motions, 0.3)
    seen = one.points.clone()
    seen[0, 3:9, 1], seen[2, -5:] = torch.nan, torch.nan  # not seen
    one = replace(one, replay=one.replay.changed(trials=replace(one.replay.trials, observed=seen)))
    penalty, unit, weights = 1e-3, 0.1, [*model.parameters()]
    weights_of_trials = one.replay.trials.loss_weight
    factor = gauss_newton_factor([one], [weights_of_trials], model, penalty, unit)
    torch.testing.assert_close(
        gauss_newton_factor([one, one], [0.5 * weights_of_trials] * 2, model, penalty, unit), factor
    )
    at, gradients = parameters_to_vector(weights).detach(), []
    along = torch.randn(len(at), generator=torch.Generator().manual_seed(1)).double()
    for sign in (1.0, -1.0):
        vector_to_parameters(at + sign * 1e-5 * along, weights)
        errors = one.errors(one.changes(model)).square().sum((1, 2, 3))
        loss = (errors * weights_of_trials).sum() + penalty * sum(w.square().sum() for w in weights)
        gradients.append(parameters_to_vector(torch.autograd.grad(loss / unit, weights)))
    expected = (gradients[0] - gradients[1]) / 2e-5
    torch.testing.assert_close(
        factor @ (factor.T @ along), expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max())
    )


class Quadratic:
    """A loss of the weights w of an actuator with the Hessian H."""

    def __init__(self, hessian, least):
        self._hessian, self._least = hessian, least

    def __call__(self, model):
        off = parameters_to_vector(model.parameters()) - self._least
        return 0.5 * off @ self._hessian @ off

    def error_mm(self, model):
        return float(self(model).detach())


@pytest.mark.parametrize("resumed", [False, True])
def test_training_in_the_factor_of_the_hessian_ends_after_one_step(resumed):
    torch.manual_seed(0)
    model = Actuator({"pressure": InputNetwork(torch.zeros(2), torch.ones(2), (), 3)})
    least = torch.randn(len(parameters_to_vector(model.parameters()))).double()
    root = torch.randn(len(least), len(least)).double() * torch.logspace(-3, 0, len(least)).double()
    loss = Quadratic(root @ root.T + 1e-6 * torch.eye(len(least)).double(), least)
    unit = loss.error_mm(model)
    factor = torch.linalg.cholesky(loss._hessian / unit)
    settings = ActuatorSettings(penalty=0.0)
    trainer = InTheLoop(model, loss, loss, settings, 1, factor)
    trainer.begin()
    if resumed:
        again = InTheLoop(model, loss, loss, settings, 1)
        again.resume(*trainer.snapshot())
        trainer = again
    assert trainer.run_epoch()["train_loss"] < 1e-9 * unit


def test_linearised_motions_follow_changes_of_the_inputs_in_time(simulator, motions):
    one, model = linearised_motions(simulator, motions, 0.0)
    fitting = ActuatorFitting(simulator, motions, MANY)
    ((replay, start),) = fitting._replays(MANY)
    before = one.errors(one.changes(model))
    with torch.no_grad():
        model.inputs["tendon_tension"].linear.weight[:, :2] = 2e-3 * torch.eye(2)
        exact = replay.errors(replay.changed(actuator=model.inputs)(start))[0] - before
        changes = one.changes(model)
        at_once = replace(one, kernel=torch.ones(1).double()).errors(changes) - before
        followed = one.errors(changes) - before
    assert (at_once - exact).norm() > 1e-2 * exact.norm()
    assert (followed - exact).norm() < 0.2 * (at_once - exact).norm()


def test_trials_without_inputs_are_refused(simulator):
    bare = wr.Simulator(wr.Body(MESH, fixed=BODY.fixed_vertices), wr.Corotated(264e3, 0.45), time_step=STEP)
    q = bare.rollout(bare.rest_state(), 4).q
    motions = ObservedMotions.of(bare, q, bare.rest_state())
    refuses(InputError, "motion 0 have no inputs whose actuator could be learned", fit_actuator, bare, motions)
