"""Training of a correction, and roll-outs with it of which some diverge,
in place of a simulator or under feedback.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.clamped import clamped
from support.slopes import check_slopes
from warp_resphys import (
    Body,
    Corotated,
    Inputs,
    Simulator,
    SolverSettings,
    State,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.stepping.rollout import rollout
from warp_resphys.core.stepping.rotations import rotations
from warp_resphys.io.errors import ConvergenceError, InputError
from warp_resphys.io.safe_files import read_checkpoint, write_checkpoint
from warp_resphys.learning.residuals import correction
from warp_resphys.learning.residuals.feedback import equilibrium_under_feedback
from warp_resphys.learning.residuals.networks import NextState, ResidualForce, build_model
from warp_resphys.learning.residuals.training import Samples, Trainer
from warp_resphys.settings.learning import NetworkSettings, TrainerSettings

MESH = box_hexahedra((0.1, 0.03, 0.03), (2, 1, 1))
BODY, TIP = Body(MESH, fixed=select_vertices(MESH, x=0.0)), select_vertices(MESH, x=0.1)
SIMULATOR = Simulator(BODY, Corotated(215e3, 0.45))
REST = SIMULATOR.rest_positions
MODES, SAMPLES = 3, 60
ARCHITECTURE = {"blocks": 2, "layers": 1, "width": 8, "activation": "silu"}
SIZES = {"position_modes": MODES, "velocity_modes": MODES, "force_modes": MODES, **ARCHITECTURE}
NETWORKS = {kind: NetworkSettings(kind=kind, **SIZES) for kind in ("reduced", "nodal")}


class LinearSystem:
    """Displacements and velocities in a few modes, z' = A z: damped rotations that mix both."""

    def __init__(self):
        random = np.random.default_rng(0)
        shapes = np.linalg.qr(random.normal(size=(REST.numel(), 2 * MODES)))[0].T.reshape(
            2, MODES, *REST.shape
        )
        self.shapes = torch.tensor(shapes) * torch.tensor([1e-2, 1.0])[:, None, None, None]
        self.matrix = torch.tensor(
            0.98 * np.linalg.qr(random.normal(size=(2 * MODES, 2 * MODES)))[0]
        )

    def state(self, z):
        """(S, N, 3) positions and velocities of (S, 2 MODES) coordinates."""
        parts = zip(z.split(MODES, dim=1), self.shapes, strict=True)
        u, v = (torch.einsum("sm,mnd->snd", part, shapes) for part, shapes in parts)
        return REST + u, v

    def samples(self, seed=1):
        z = torch.randn(
            SAMPLES, 2 * MODES, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
        )
        return z - z.mean(0), (z - z.mean(0)) @ self.matrix.mT


@pytest.fixture
def system():
    return LinearSystem()


def linear_model(system, kind):
    """Its linear part fitted, its network silent."""
    torch.manual_seed(0)
    now, following = (system.state(z) for z in system.samples())
    model = build_model(NextState, NETWORKS[kind], REST, *now)
    model.fit_linear(
        model.encode(*now), model.encode_outputs(following[0] - REST, following[1]), 1e-6
    )
    model.remainder.zero_()
    return model.eval()


@pytest.mark.parametrize("kind", NETWORKS)
def test_the_linear_part_alone_reproduces_a_linear_system(system, kind):
    model = linear_model(system, kind)
    z = torch.tensor(
        [[1.0, -2.0, 0.5, 0.0, 1.5, -1.0], [0.0, 0.3, 0.0, -2.0, 0.0, 0.7]], dtype=torch.float64
    )
    start = State(*system.state(z))
    step = correction.CorrectedSimulator(SIMULATOR, correction.LearnedPredictor(model)).step
    with torch.no_grad():
        positions = torch.stack(rollout(step, start, range(30), correction.known_positions), 1)
    for step in range(31):
        q, _ = system.state(z @ torch.linalg.matrix_power(system.matrix, step).mT)
        torch.testing.assert_close(
            positions[:, step], q, rtol=0.0, atol=1e-5 * float((start.q - REST).abs().max())
        )


@pytest.mark.parametrize(
    ("value", "left"),
    [
        (float("nan"), True),
        (1.01 * correction.DIVERGENCE_DISTANCE, True),
        (0.99 * correction.DIVERGENCE_DISTANCE, False),
    ],
)
def test_a_diverged_roll_out_stays_lost_and_does_not_affect_others(value, left):
    """The second of three environments leaves at its third step,
    and would come back if it was asked.
    """
    calls = []

    def predict(state, step):
        assert step == len(calls)
        calls.append(state.q.clone())
        following = state.q + 1e-3
        if len(calls) == 3:
            following[1, -1, 0] = REST[-1, 0] + 0.1 * value
        return State(following, state.v + 0.5)

    start = SIMULATOR.rest_state(3)
    step = correction.CorrectedSimulator(SIMULATOR, predict).step
    positions = torch.stack(rollout(step, start, range(6), correction.known_positions), 1)
    lost = torch.isnan(positions).all((2, 3))
    assert lost.tolist() == [7 * [False], 3 * [False] + 4 * [left], 7 * [False]]
    for step in range(7):
        torch.testing.assert_close(positions[0, step], REST + 1e-3 * step)
    assert torch.equal(positions[0], positions[2])
    assert all(torch.equal(q[1], REST) == left for q in calls[3:])  # stands at rest from then on


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_lost_environments_stand_at_rest_without_inputs(integrator):
    settings = SolverSettings(on_failure="count", max_iterations=15)
    simulator = Simulator(
        BODY, Corotated(2e4, 0.3, prony=[(0.5, 0.1)]), integrator=integrator, solver=settings
    )

    def predict(state, step):
        force = torch.zeros_like(state.q)
        force[1] = torch.nan if step == 2 else 0.0
        if step == 3:  # which the solver cannot follow
            force[2] = 1e3 * torch.randn(
                force[2].shape, generator=torch.Generator().manual_seed(0), dtype=force.dtype
            )
        return force

    state, other = (
        rollout(
            correction.CorrectedSimulator(simulator, force).step,
            simulator.rest_state(3),
            range(5),
            lambda now: now,
        )[-1]
        for force in (predict, None)
    )
    assert state.lost.tolist() == [False, True, True]
    assert torch.equal(state.q[1:], simulator.rest_positions.expand(2, -1, -1))
    places = ("q", "previous_q", "memory.robot.lost")
    assert all(not bool(t[1:].any()) for name, t in state.tensors().items() if name not in places)
    assert float(other.memory["viscous_strain"].abs().max()) > 1e-6
    for name, tensor in state.tensors().items():
        torch.testing.assert_close(tensor[0], other.tensors()[name][0], rtol=0.0, atol=1e-9)


def travels(predict, steps=30):
    """States of two beams of 0.1 m; the base of the second one goes 3 m and turns over."""
    simulator = Simulator(BODY, Corotated(2e5, 0.3), solver=SolverSettings(on_failure="count"))
    share = torch.linspace(0.0, 1.0, steps + 1, dtype=torch.float64)[1:, None]
    share = share**2 * (3.0 - 2.0 * share)
    turn = rotations(share * torch.tensor([0.0, 3.0, 0.0]))
    away = REST[BODY.fixed_vertices] @ turn.mT + (share * torch.tensor([3.0, 0.0, 0.0]))[:, None]
    inputs = Inputs(
        fixed_positions=torch.stack([REST[BODY.fixed_vertices].expand_as(away), away], 1)
    )
    step = correction.CorrectedSimulator(simulator, predict, inputs).step
    with torch.no_grad():
        return rollout(step, simulator.rest_state(2), range(steps), lambda now: now), turn[-1]


def test_a_robot_goes_with_its_base_as_far_as_it_likes():
    motion, _ = travels(None)
    assert not motion[-1].lost.any()
    assert float(motion[-1].q[1, :, 0].mean()) > 2.5


def test_a_lost_environment_stands_at_rest_on_its_own_base():
    motion, turn = travels(lambda state, step: state.q * (torch.nan if step == 20 else 0.0))
    assert motion[20].lost.tolist() == [False, False]
    assert motion[-1].lost.tolist() == [True, True]
    np.testing.assert_allclose(motion[-1].q[0], REST, atol=1e-9)
    np.testing.assert_allclose(
        motion[-1].q[1], REST @ turn.mT + torch.tensor([3.0, 0.0, 0.0]), atol=1e-8
    )
    assert not motion[-1].v.any()


@pytest.mark.parametrize(("apart", "lost"), [(0.0, False), (3.0, True)])
def test_a_free_body_flies_as_far_as_it_likes_in_one_piece(apart, lost):
    def predict(state, step):
        following = state.q + torch.tensor([0.5, 0.0, 0.0])
        following[:, -1, 2] += apart
        return State(following, state.v)

    free = Simulator(Body(MESH), Corotated(2e5, 0.3))
    step = correction.CorrectedSimulator(free, predict).step
    last = rollout(step, free.rest_state(), range(10), lambda now: now)[-1]
    assert bool(last.lost) == lost


def at_rest(*stiffnesses):
    """The state of beams with springs (N/m) from their tips to the places of their tips
    at rest, and the force.
    """
    s = Simulator(
        BODY, Corotated(1e5, 0.4), solver=SolverSettings(name="newton", relative_tolerance=1e-12)
    )
    k = torch.zeros(len(stiffnesses), len(MESH.vertices), 1, dtype=torch.float64)
    k[:, TIP] = torch.tensor(stiffnesses, dtype=torch.float64)[:, None, None]

    def force(state, number=0):
        return k * (s.rest_positions - state.q)

    guess = s.rest_state(len(stiffnesses))
    return s, equilibrium_under_feedback(s, Inputs(), s.prepare(), guess, force), force


@pytest.mark.parametrize("stiffnesses", [(0.0,), (0.0, 1.0, 30.0), (-0.5, 5.0)])
def test_the_force_and_the_weight_are_in_balance(stiffnesses):
    s, state, force = at_rest(*stiffnesses)
    again = s.static_equilibrium(Inputs(force(state)))
    torch.testing.assert_close(again.q, state.q, rtol=0.0, atol=1e-7)
    sags = -(state.q[:, TIP, 2] - s.rest_positions[TIP, 2]).mean(1)
    assert (sags > 0.0).all()
    assert (torch.diff(sags) < 0.0).all()  # A stiffer spring carries more.
    free = at_rest(0.0)[1].q
    if 0.0 in stiffnesses:
        torch.testing.assert_close(state.q[:1], free, rtol=0.0, atol=1e-9)


class Within:
    """A force within the body at its free end, which depends on the state."""

    acts = "internal"

    def __call__(self, state, number=0):
        force = torch.zeros_like(state.q)
        force[:, TIP] = 0.02 + state.q[:, TIP]
        return force


def test_a_clamp_carries_the_weight_alone_under_a_force_within_the_body():
    """At rest and in the steps of a corrected simulator, in every environment."""
    s, *_ = at_rest(0.0)
    constants = s.prepare()
    load = (constants.load_mass[..., None] * constants.gravity[:, None]).sum(1)
    rests = equilibrium_under_feedback(s, Inputs(), constants, s.rest_state(2), Within())
    torch.testing.assert_close(rests.reaction.force, -load.expand(2, -1), rtol=0.0, atol=1e-10)
    corrected, state = correction.CorrectedSimulator(s, Within()), s.rest_state(2)
    for number in range(3):
        before, state = state, corrected.step(state, number)
        rate = constants.mass[..., None] * (
            (state.v - before.v) / s.time_step + constants.mass_damping[..., None] * state.v
        )
        torch.testing.assert_close(state.reaction.force, rate.sum(1) - load, rtol=0.0, atol=1e-8)


def test_an_equilibrium_is_found_where_its_iteration_would_grow_and_has_gradients():
    """A spring at the tip, 40 times as stiff as the beam:
    each equilibrium overshoots the one before.
    """
    s, *_ = at_rest(0.0)

    def tip(values):
        def force(state, number=0):
            pull = torch.zeros_like(state.q)
            pull[:, TIP] = values["stiffness"] * (s.rest_positions[TIP] - state.q[:, TIP])
            return pull

        constants = s.prepare({"youngs_modulus": values["youngs_modulus"]})
        at = equilibrium_under_feedback(s, Inputs(), constants, s.rest_state(), force)
        return at.q[:, TIP, 2].mean() * 1e3 + at.reaction.moment().square().sum()

    values = {
        "stiffness": torch.tensor(100.0).double(),
        "youngs_modulus": torch.tensor([[1e5]]).double(),
    }
    check_slopes(tip, values, {"stiffness": 3.0, "youngs_modulus": 3e3}, tolerance=1e-4)


def test_an_equilibrium_under_a_force_that_is_the_same_everywhere_has_gradients():
    s, *_ = at_rest(0.0)

    def tip(values):
        force = torch.zeros_like(s.rest_state().q)
        force[:, TIP, 2] = values["push"]
        constants = s.prepare({"youngs_modulus": values["youngs_modulus"]})
        at = equilibrium_under_feedback(
            s, Inputs(), constants, s.rest_state(), lambda state, number: force
        )
        return 1e3 * at.q[:, TIP, 2].mean()

    values = {"push": torch.tensor(0.01).double(), "youngs_modulus": torch.tensor([[1e5]]).double()}
    check_slopes(tip, values, {"push": 1e-4, "youngs_modulus": 1e2})


def test_a_force_that_turns_round_has_no_equilibrium():
    """It pushes the tip back over the height at which it rests without the force."""
    s, free, _ = at_rest(0.0)
    height = free.q[:, TIP, 2].mean()

    def force(state, number=0):
        push = torch.zeros_like(state.q)
        push[:, TIP, 2] = -0.02 * torch.sign(state.q[:, TIP, 2].mean() - height)
        return push

    with pytest.raises(ConvergenceError) as caught:
        equilibrium_under_feedback(s, Inputs(), s.prepare(), s.rest_state(), force)
    assert caught.value.report.tolist() == [False]


NETWORK = NetworkSettings(kind="nodal", blocks=2, layers=1, width=16, activation="normalised_elu")
CONFIG = {
    "epochs": 6,
    "batch_size": 16,
    "learning_rate": 5e-3,
    "final_learning_rate": 1e-4,
    "gamma": 0.5,
}
CONFIG |= {
    "step_epochs": 2,
    "weight_decay": 1e-5,
    "noise": 0.01,
    "linear_noise": 0.01,
    "rollout_every": 2,
}


def samples(count, seed):
    """A force that depends on the state in part linearly."""
    random = torch.Generator().manual_seed(seed)
    q, v = (torch.randn(count, 4, 3, generator=random, dtype=torch.float64) for _ in range(2))
    return Samples(q, v, (0.5 * q - 0.2 * v.flip(1) + torch.sin(2.0 * q) * v,))


TRAIN, VALIDATION = samples(70, 1), samples(20, 2)


def rollout_error(model):
    """Depends on the weights, like the real one."""
    with torch.no_grad():
        return float((model(VALIDATION.q, VALIDATION.v) - VALIDATION.outputs[0]).abs().mean())


def trainer(seed=0, error=rollout_error, **settings):
    torch.manual_seed(seed)
    model = build_model(
        ResidualForce,
        NETWORK,
        torch.zeros(4, 3, dtype=torch.float64),
        TRAIN.q,
        TRAIN.v,
        TRAIN.outputs[0],
    )
    return Trainer(model, TRAIN, VALIDATION, error, TrainerSettings(**{**CONFIG, **settings}), seed)


def finish(trainer):
    while not trainer.finished:
        trainer.run_epoch()
    return trainer


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


@pytest.mark.parametrize(
    ("after", "settings"), [(3, {}), (2, {"schedule": "step", "selection": "validation_loss"})]
)
def test_a_snapshot_goes_on_exactly(after, settings, tmp_path):
    whole = finish(trainer(**settings))
    first = trainer(**settings)
    for _ in range(after):
        first.run_epoch()
    path = tmp_path / "training.safetensors"
    write_checkpoint(path, "training", *first.snapshot())
    second = trainer(seed=17, **settings)  # nothing of its own start may remain
    second.resume(*read_checkpoint(path, "training"))
    finish(second)
    assert same(second.model.state_dict(), whole.model.state_dict())
    assert same(second.use_best().state_dict(), whole.use_best().state_dict())
    assert second.history == whole.history
    assert (second.best_score, second.best_epoch) == (whole.best_score, whole.best_epoch)
    assert second.best_error == whole.best_error
    assert same(second.best, whole.best)


class TestSelection:
    @pytest.mark.parametrize(
        ("errors", "best"),
        [([math.inf, 5.0, math.inf], 1), ([2.0, 2.0, 2.0], 0), ([math.inf, 4.0, 3.0], 2)],
    )
    def test_the_smallest_roll_out_error_is_selected(self, errors, best):
        queue, weights = list(errors), []

        def error(model):
            weights.append({k: t.clone() for k, t in model.network.state_dict().items()})
            return queue.pop(0)

        run = finish(trainer(error=error))
        losses = [record["validation_loss"] for record in run.history]
        assert losses == sorted(losses, reverse=True)  # the last epoch has the best loss
        assert (run.best_error, run.best_epoch) == (errors[best], 2 * (best + 1))
        assert not same(weights[0], weights[2])
        assert same(dict(run.use_best().network.state_dict()), weights[best])
        assert not run.model.training

    @pytest.mark.parametrize("measured", [3.0, math.inf])
    def test_the_smallest_validation_loss_is_selected(self, monkeypatch, measured):
        losses, weights, asked = [5.0, 4.0, 2.0, 3.0, math.nan, 6.0], [], []
        run = trainer(
            selection="validation_loss", error=lambda model: asked.append(model) or measured
        )
        training = run._loss

        def loss(*samples):
            if torch.is_grad_enabled():
                return training(*samples)
            weights.append({k: t.clone() for k, t in run.model.network.state_dict().items()})
            return losses[len(weights) - 1]

        monkeypatch.setattr(run, "_loss", loss)
        finish(run)
        assert run.best_epoch == 3
        assert not same(weights[2], weights[-1])
        assert len(asked) == 3  # after epochs 2, 4 and 6
        assert math.isnan(run.best_error)  # of epoch 3, nothing is known yet
        assert same(dict(run.use_best().network.state_dict()), weights[2])
        assert (run.best_error, len(asked)) == (measured, 4)
        assert run.history[2]["rollout_error_mm"] == measured
        run.use_best()
        assert len(asked) == 4
        assert not run.model.training


class TestLearning:
    def test_losses_are_mean_squared_errors_that_fall_below_the_remainder_of_the_linear_part(self):
        run = finish(trainer(epochs=100, batch_size=8, noise=0.0))
        linear = float(run.model.remainder) ** 2
        assert 0.1 < linear < 1.0
        assert run.history[-1]["train_loss"] < 0.5 * linear
        run = finish(trainer(epochs=1))
        with torch.no_grad():
            wanted = run.model.coders[0].encode(VALIDATION.outputs[0])
            result = run.model.coders[0].encode(run.model(VALIDATION.q, VALIDATION.v))
        expected = float((result - wanted).square().mean())
        assert run.history[0]["validation_loss"] == pytest.approx(expected, rel=1e-5)

    def test_cosine_and_step_schedules(self):
        rates = [r["learning_rate"] for r in finish(trainer(epochs=5)).history]
        assert (rates[0], rates[-1]) == (5e-3, pytest.approx(1e-4))
        assert rates[2] == pytest.approx((5e-3 + 1e-4) / 2)
        assert rates == sorted(rates, reverse=True)
        rates = [r["learning_rate"] for r in finish(trainer(schedule="step")).history]
        assert rates == [5e-3, 5e-3, 2.5e-3, 2.5e-3, 1.25e-3, 1.25e-3]


@pytest.mark.parametrize("name", ["training", "validation"])
def test_empty_split(name):
    nothing = torch.zeros(0, 4, 3)
    empty = Samples(nothing, nothing, (nothing,))
    splits = {"training": TRAIN, "validation": VALIDATION, name: replace(empty)}
    model = trainer().model
    with pytest.raises(InputError, match=f"the {name} split is empty"):
        Trainer(
            model,
            splits["training"],
            splits["validation"],
            rollout_error,
            TrainerSettings(**CONFIG),
            0,
        )


@pytest.mark.parametrize(("exponent", "smallest"), [(0.0, 1.0), (1.0, 0.1)])
def test_outputs_are_weighted_by_their_deviation(exponent, smallest):
    """With the power one, the validation loss is the squared error
    of the forces themselves, in units of theirs.
    """
    forces = TRAIN.outputs[0] * torch.tensor([1.0, 1.0, 1.0, 0.1])[:, None]
    torch.manual_seed(0)
    model = build_model(
        ResidualForce, NETWORK, torch.zeros(4, 3, dtype=torch.float64), TRAIN.q, TRAIN.v, forces
    )
    data = [
        replace(samples, outputs=(forces[: len(samples.q)],)) for samples in (TRAIN, VALIDATION)
    ]
    run = Trainer(
        model, *data, rollout_error, TrainerSettings(**{**CONFIG, "scale_weight": exponent}), 0
    )
    loss = run.run_epoch()["validation_loss"]
    (coder,) = model.coders
    with torch.no_grad():
        error = model(VALIDATION.q, VALIDATION.v) - data[1].outputs[0]
    weighed = error.flatten(1) if exponent else error.flatten(1) / coder.scale
    unit = coder.scale.square().mean() if exponent else 1.0
    assert loss == pytest.approx(float(weighed.square().mean() / unit), rel=1e-4)
    assert float(coder.scale.min() / coder.scale.max()) ** exponent == pytest.approx(
        smallest, rel=0.5
    )


def test_an_environment_that_diverges_has_no_reaction_and_the_other_keeps_its_own():
    beam = box_hexahedra((0.1, 0.03, 0.02), (6, 2, 2))
    simulator = Simulator(
        clamped(beam), Corotated(264e3, 0.45), solver=SolverSettings(on_failure="count")
    )
    thrown = torch.zeros(2, len(beam.vertices), 3, dtype=torch.float64)
    thrown[1, -1] = 1e9
    corrected = correction.CorrectedSimulator(simulator, lambda state, number: thrown)
    after = corrected.step(simulator.rest_state(2), 0)
    alone = correction.CorrectedSimulator(simulator, lambda state, number: thrown[:1]).step(
        simulator.rest_state(), 0
    )
    assert after.lost.tolist() == [False, True]
    assert torch.equal(simulator.reaction(after).forces[0], simulator.reaction(alone).forces[0])
    assert simulator.reaction(after).forces[1].isnan().all()
    lost = correction.CorrectedSimulator(simulator, lambda state, number: thrown[1:]).step(
        simulator.rest_state(), 0
    )
    assert simulator.reaction(lost).forces.isnan().all()
