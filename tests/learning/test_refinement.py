"""Solver-in-the-loop refinement: its gradient, its windows, its optimiser and its way back from an interruption."""

import math
from dataclasses import replace

import pytest
import torch

from support.configured import settings
from warp_resphys import Body, Corotated, Simulator, box_hexahedra, select_vertices
from warp_resphys.data.trials import Trials
from warp_resphys.dynamics.nonlinear_solver import SolverSettings
from warp_resphys.io.errors import InputError
from warp_resphys.io.files import read_checkpoint, write_checkpoint
from warp_resphys.learning.networks import build_model
from warp_resphys.learning.refinement import RefinementBatch, SolverInTheLoop, WindowLoss, Windows
from warp_resphys.settings.learning import NetworkSettings, RefinementSettings
from warp_resphys.stepping.inputs import Inputs
from warp_resphys.studies.gradient_check import central_difference

MESH = box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1))
BODY = Body(MESH, fixed=select_vertices(MESH, x=0.0))
REALITY, WRONG = Corotated(264e3, 0.45), Corotated(215e3, 0.45)
CONFIG = RefinementSettings(window=3, epochs=4, batch_size=4, memory=5)
FRAMES = 11


def simulator(material=WRONG, integrator="implicit_euler"):
    solver = SolverSettings(relative_tolerance=1e-11, on_failure="count")
    return Simulator(BODY, material, integrator=integrator, solver=solver)


def motion(integrator="implicit_euler", seed=0):
    """Two releases from loads."""
    real = simulator(REALITY, integrator)
    load = torch.zeros(2, len(MESH.vertices), 3, dtype=torch.float64)
    random = torch.Generator().manual_seed(seed)
    load[:, select_vertices(MESH, x=0.06)] = 0.1 * torch.rand(2, 1, 3, generator=random, dtype=torch.float64) - 0.05
    result = real.rollout(real.static_equilibrium(Inputs(load)), FRAMES - 1)
    q, v = result.q.transpose(0, 1).contiguous(), result.v.transpose(0, 1).contiguous()
    return motion_of(q, v, q)


def motion_of(q, v, target, inputs=None, context=None):
    """Two trials at the steps of the simulator, and their targets."""
    times = real_time(target.shape[1]).expand(2, -1)
    trials = Trials(("a", "b"), times, target, target[:, 0], Inputs() if inputs is None else inputs)
    return RefinementBatch(q, v, target, trials, context)


def real_time(frames):
    return simulator().time_step * torch.arange(frames, dtype=torch.float64)


TRAIN, VALIDATION = motion(), motion(seed=1)


def windows_of(trials, frames):
    """Windows of the only motion."""
    return Windows(torch.zeros(len(trials), dtype=torch.int64), torch.tensor(trials), torch.tensor(frames))


def network(seed=0):
    torch.manual_seed(seed)
    rest = simulator().rest_positions
    force = 1e-3 * torch.randn(FRAMES * 2, *rest.shape, dtype=torch.float64)
    sizes = NetworkSettings(kind="nodal", blocks=2, layers=1, width=8, activation="normalised_elu")
    return build_model(sizes, rest, TRAIN.q.flatten(0, 1), TRAIN.v.flatten(0, 1), force)


class Formula:
    """A model whose force is a function of positions and velocities."""

    def __init__(self, force):
        self.rest, self.force = simulator().rest_positions, force

    def encode(self, q, v, context):
        return q, v

    def decode(self, state, hidden=None):
        return [self.force(*state)], hidden


def window_loss(model, window=3, batch_size=4, integrator="implicit_euler"):
    return WindowLoss(model, lambda: simulator(integrator=integrator), window, batch_size)


def trainer(model=None, error=None, **changes):
    model = network() if model is None else model
    config = CONFIG.changed(**changes)
    loss = window_loss(model, config.window, config.batch_size)

    def drift(model):
        return loss.measure(loss.consecutive([VALIDATION]), [VALIDATION])[0] ** 0.5

    return SolverInTheLoop(model, loss, [TRAIN], [VALIDATION], error or drift, config)


def finish(trainer):
    while not trainer.finished:
        trainer.run_epoch()
    return trainer


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


class TestLoss:
    def test_its_gradient_agrees_with_central_differences(self):
        model = network().double()
        loss = window_loss(model, window=4)
        windows = windows_of([0, 1, 1], [0, 2, 5])
        loss.backward(windows, [TRAIN], 1e-3)
        random = torch.Generator().manual_seed(3)
        for weight in model.network.parameters():
            direction = 1e-3 * torch.randn(weight.shape, generator=random, dtype=torch.float64)
            start = weight.detach().clone()

            def along(k, weight=weight, start=start, direction=direction):
                weight.copy_(start + k * direction)
                return loss.measure(windows, [TRAIN])[0] / 1e-3

            with torch.no_grad():
                expected, _ = central_difference(along)
                weight.copy_(start)
            assert abs(expected) > 1e-6
            assert float((weight.grad * direction).sum()) == pytest.approx(expected, rel=1e-6)

    @pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2", "midpoint"])
    def test_the_exact_force_has_no_loss(self, integrator):
        no_force = Formula(lambda q, v: torch.zeros_like(q))
        loss = WindowLoss(no_force, lambda: simulator(REALITY, integrator), 4, 3)
        target = motion(integrator)
        windows = loss.consecutive([target])
        assert windows.frame.tolist() == 2 * ([1, 5] if integrator == "bdf2" else [0, 4])
        assert loss.measure(windows, [target])[0] < 1e-12  # mm^2
        assert window_loss(no_force, 4, integrator=integrator).measure(windows, [target])[0] > 1e-3

    @pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
    def test_windows_of_a_viscoelastic_material_begin_with_its_internal_variables(self, integrator):
        no_force, creeping = Formula(lambda q, v: torch.zeros_like(q)), replace(REALITY, prony=[(0.5, 0.05)])
        sim = simulator(creeping, integrator)
        load = Inputs(torch.full((2, len(MESH.vertices), 3), -1e-3, dtype=torch.float64))
        result = sim.rollout(sim.static_equilibrium(load), FRAMES - 1)
        q, v = result.q.transpose(0, 1).contiguous(), result.v.transpose(0, 1).contiguous()
        loss = WindowLoss(no_force, lambda: simulator(creeping, integrator), 4, 3)
        target = motion_of(q, v, q)
        assert loss.measure(loss.consecutive([target]), [target])[0] < 1e-12  # mm^2
        q[0, :2] = torch.nan  # It is first known in frame 2, and counts as relaxed there.
        late = motion_of(q, v, q)
        value = loss.measure(loss.consecutive([late]), [late])[0]
        assert 0.0 < value < 1e-1

    def test_it_is_the_mean_squared_distance_of_separate_roll_outs(self):
        model, sim = network(), simulator()
        windows = windows_of([1, 0, 1], [0, 3, 6])
        squares = []
        for run, frame in zip(windows.trial, windows.frame, strict=True):
            state = replace(sim.rest_state(1), q=TRAIN.q[run, frame][None], v=TRAIN.v[run, frame][None])
            for step in (1, 2, 3):
                with torch.no_grad():
                    state, _ = sim.step(state, Inputs(model(state.q, state.v)))
                squares.append(1e6 * (state.q[0] - TRAIN.q[run, frame + step]).square().sum(-1).mean())
        loss = window_loss(model, batch_size=2)
        expected = float(torch.stack(squares).mean())
        assert loss.measure(windows, [TRAIN])[0] == pytest.approx(expected, rel=1e-6)
        assert loss.backward(windows, [TRAIN], 2.0) == pytest.approx(expected / 2.0, rel=1e-6)

    @pytest.mark.parametrize("value", [math.nan, 1e6])
    def test_a_failed_window_does_not_affect_others(self, value):
        """The force is no good in windows of the second trajectory after its frame 4."""
        model = network()

        def failing(q, v):
            bad = (q - TRAIN.q[1, 4]).abs().flatten(1).amax(1) < 1e-9
            return torch.where(bad[:, None, None], value, model(q, v))

        windows = windows_of([0, 1, 1, 0], [0, 4, 1, 5])
        others = windows.pick(torch.tensor([0, 2, 3]))
        whole, broken = window_loss(model, batch_size=4), window_loss(Formula(failing), batch_size=4)
        measured, lost = broken.measure(windows, [TRAIN])
        assert lost.tolist() == [False, True, False, False]
        expected = whole.measure(others, [TRAIN])[0]
        assert measured == pytest.approx(expected, rel=1e-6)
        whole.backward(others, [TRAIN], 1.0)
        gradients = [w.grad.clone() for w in model.parameters()]
        model.zero_grad()
        loss = broken.backward(windows, [TRAIN], 1.0)
        assert loss == pytest.approx(0.75 * expected + 0.25 * (1e3 * 10.0 * 0.06) ** 2)
        for weight, gradient in zip(model.parameters(), gradients, strict=True):
            torch.testing.assert_close(weight.grad, 0.75 * gradient, rtol=1e-4, atol=1e-9)

    def test_the_loss_uses_seen_points_and_the_inputs_of_every_window(self):
        """Weights that grow in time: with them, the simulator that made the trials is off nowhere; without, it is."""
        sim, frames = simulator(), 7
        force = torch.zeros(frames - 1, 2, *sim.rest_positions.shape, dtype=torch.float64)
        force[:, :, -1, 2] = -0.01 * torch.arange(frames - 1, dtype=torch.float64)[:, None]
        result = sim.rollout(sim.rest_state(2), frames - 1, Inputs(force))
        q, v = (x.transpose(0, 1).contiguous() for x in (result.q, result.v))
        target = q[:, :, -2:].clone()  # two markers
        target[0, 2:4, 0] = torch.nan
        target[1, 1:4] = torch.nan
        no_force = Formula(lambda q, v: torch.zeros_like(q))
        loss = WindowLoss(no_force, simulator, 3, 3, observe=lambda q: q[:, -2:])
        acting = motion_of(q, v, target, Inputs(force))
        windows = loss.consecutive([motion_of(q, v, target), acting])
        assert windows.motion.tolist() == [0, 0, 0, 1, 1, 1]  # In the first three steps of the second nothing was seen.
        assert list(zip(windows.trial.tolist(), windows.frame.tolist(), strict=True)) == 2 * [(0, 0), (0, 3), (1, 3)]
        with_force, without = windows.pick(torch.tensor([3, 4, 5])), windows.pick(torch.tensor([0, 1, 2]))
        motions = [motion_of(q, v, target), acting]
        assert loss.measure(with_force, motions)[0] < 1e-12
        assert loss.measure(without, motions)[0] > 1e-6
        torch.testing.assert_close(
            loss.measure(windows, motions)[0], 0.5 * loss.measure(without, motions)[0], rtol=1e-6, atol=0.0
        )


class TestTraining:
    def test_it_lowers_the_loss_and_the_roll_out_error(self):
        run = finish(trainer(epochs=8))
        history = run.state.history
        assert [r["epoch"] for r in history] == list(range(9))
        losses = [r["train_loss"] for r in history]
        assert losses == sorted(losses, reverse=True)
        assert losses[-1] < 0.1 * losses[0]
        assert (
            history[run.state.best_epoch]["rollout_error_mm"] == run.best_error < 0.5 * history[0]["rollout_error_mm"]
        )

    def test_the_initial_weights_are_kept_unless_others_are_better(self):
        before = {k: t.clone() for k, t in network().state_dict().items()}
        errors = iter([1.0, 2.0, 1.0, math.inf, 3.0])
        run = finish(trainer(error=lambda model: next(errors)))
        assert not same(dict(run.model.state_dict()), before)
        assert (run.state.best_epoch, run.best_error) == (0, 1.0)
        assert same(dict(run.use_best().state_dict()), before)

    @pytest.mark.parametrize("after", [1, 3])
    def test_a_snapshot_goes_on_exactly(self, after, tmp_path):
        whole = finish(trainer())
        first = trainer()
        for _ in range(after):
            first.run_epoch()
        path = tmp_path / "training.safetensors"
        write_checkpoint(path, "training", *first.snapshot())
        second = trainer(network(seed=7))
        second.resume(*read_checkpoint(path, "training"))
        finish(second)
        assert second.state.history == whole.state.history
        assert same(second.model.state_dict(), whole.model.state_dict())
        assert same(second.use_best().state_dict(), whole.use_best().state_dict())

    def test_windows_that_fail_at_the_start_are_left_out_for_good(self, tmp_path):
        model = network()

        def failing(q, v):
            bad = (q - TRAIN.q[1, 3]).abs().flatten(1).amax(1) < 1e-9
            return torch.where(bad[:, None, None], math.nan, model(q, v))

        def make():
            return SolverInTheLoop(
                model, window_loss(Formula(failing)), [TRAIN], [VALIDATION], lambda model: 1.0, CONFIG
            )

        run = make()
        run.run_epoch()
        assert run.state.history[0]["left_out"] == 1
        assert all(math.isfinite(r["train_loss"]) for r in run.state.history)
        assert run.state.history[1]["train_loss"] < run.state.history[0]["train_loss"]
        write_checkpoint(tmp_path / "a.safetensors", "training", *run.snapshot())
        again = make()
        again.resume(*read_checkpoint(tmp_path / "a.safetensors", "training"))
        assert again.run_epoch()["train_loss"] < run.state.history[1]["train_loss"]

    def test_a_simulator_that_always_fails_is_refused(self):
        loss = window_loss(Formula(lambda q, v: torch.full_like(q, math.nan)))
        run = SolverInTheLoop(network(), loss, [TRAIN], [VALIDATION], lambda model: 1.0, CONFIG)
        with pytest.raises(InputError, match="the simulator fails in every window of the training split"):
            run.run_epoch()


@pytest.mark.parametrize("experiment", ["beam_oscillation", "sopra"])
def test_a_window_is_shorter_than_the_trials(experiment):
    shorter = ["data.horizons=[]"] if experiment == "sopra" else []
    refined = (f"experiment={experiment}", "refinement=solver_in_the_loop", "data.steps=50", *shorter)
    settings(*refined, "refinement.window=49")
    with pytest.raises(InputError, match=r"refinement\.window is 50"):
        settings(*refined, "refinement.window=50")
