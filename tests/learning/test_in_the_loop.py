"""Learning from markers: observations at the steps, errors of roll-outs,
and training through the simulator.
"""

import numpy as np
import pytest
import torch

from support.swinging_beam import double, simulated
from warp_resphys import (
    Body,
    ConvergenceError,
    Inputs,
    Simulator,
    State,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.dynamics.gradient_check import central_difference
from warp_resphys.data.markers import bind_markers
from warp_resphys.io.safe_files import read_checkpoint, write_checkpoint
from warp_resphys.learning.replay import Replay
from warp_resphys.learning.residuals.in_the_loop import (
    InTheLoop,
    MotionLoss,
    TrialGroup,
    cross_validated_epochs,
)
from warp_resphys.learning.residuals.networks import ResidualForce, build_model
from warp_resphys.learning.sensing import at_steps
from warp_resphys.learning.start import Start
from warp_resphys.learning.trial_batch import TrialBatch
from warp_resphys.settings.learning import InTheLoopSettings, NetworkSettings

MESH = box_hexahedra(divisions=(2, 1, 1))
TIP = select_vertices(MESH, x=0.1)
POINTS = np.array([[0.1, 0.015, 0.036], [0.1, -0.006, 0.024]])
MARKERS = bind_markers(MESH, POINTS, ["a", "b"], kind="rigid", vertices=TIP)
STEP = 0.01
LOADS = torch.tensor([[0.0], [0.05]], dtype=torch.float64)
MODES = {"position_modes": 2, "velocity_modes": 2, "force_modes": 2}
NETWORK = NetworkSettings(**MODES, layers=0, width=8)
CONFIG = InTheLoopSettings(epochs=4, penalty=1e-3, memory=5)


def simulator():
    body = Body(MESH, select_vertices(MESH, x=0.0))
    return Simulator(body, time_step=STEP, relative_tolerance=1e-12)


def motions_of(times, markers, held=None):
    count = len(times)
    held = torch.as_tensor(POINTS).expand(count, -1, -1) if held is None else held
    names = tuple(f"m{i}" for i in range(count))
    attached = torch.zeros(count, len(MESH.vertices), dtype=torch.float64)
    attached[:, TIP] = LOADS[:count] / len(TIP)
    return TrialBatch(names, times, markers, held, Inputs(attached_mass=attached))


class TestAtSteps:
    TIMES = 0.003 + STEP * torch.arange(20, dtype=torch.float64)

    @staticmethod
    def path(times):
        """(..., 2, 3) [m] a cubic, which a spline follows exactly."""
        t = torch.as_tensor(times, dtype=torch.float64)[..., None, None]
        return (
            torch.as_tensor(POINTS)
            + t**2 * torch.tensor([0.3, -0.1, 1.0])
            + t**3 * torch.tensor([1.0, 2.0, -3.0])
        )

    def seen(self, *hidden):
        markers = self.path(self.TIMES)[None].clone()
        for marker, frames in hidden:
            markers[0, frames, marker] = torch.nan
        return motions_of(self.TIMES[None], markers)

    def test_it_lasts_from_where_the_markers_were_held_to_the_last_frame_and_bridges_short_gaps(
        self,
    ):
        result = at_steps(self.seen(), STEP)
        assert result.shape == (1, 20, 2, 3)  # 0 to 0.19 s, the last frame at 0.193 s
        np.testing.assert_allclose(result[0], self.path(STEP * np.arange(20)), rtol=0, atol=1e-12)
        finer = at_steps(self.seen(), 0.5 * STEP)[0]
        np.testing.assert_allclose(finer, self.path(0.5 * STEP * np.arange(39)), rtol=0, atol=1e-12)
        result = at_steps(
            self.seen((0, slice(5, 6)), (0, slice(10, 15)), (1, slice(2, None))), STEP
        )[0]
        # Frames 9 and 15, at 0.093 and 0.153 s, are the last and first sight; 0.015 s around them
        # count.
        lost = np.isnan(result[:, 0]).all(1)
        np.testing.assert_array_equal(np.flatnonzero(lost), [11, 12, 13])
        np.testing.assert_allclose(
            result[~lost, 0], self.path(STEP * np.flatnonzero(~lost))[:, 0], rtol=0, atol=1e-12
        )
        # Three sights with that at the release: too few for a cubic.
        assert np.isnan(result[:, 1]).all()
        result = at_steps(self.seen(), STEP, delay=double([0.002]))[0]
        np.testing.assert_allclose(
            result[2:], self.path(0.002 + STEP * np.arange(2, 20)), rtol=0, atol=1e-6
        )


def observed_motions(frames=6):
    """Two motions of the beam, bare and with a weight, that another stiffness made.

    And how they begin.
    """
    sim = simulator()
    times = (STEP * torch.arange(1, frames + 1, dtype=torch.float64)).repeat(2, 1)
    blank = motions_of(times, torch.as_tensor(POINTS).repeat(2, frames, 1, 1))
    rest = sim.rest_state(2)
    release = Start(State(rest.q, rest.v), torch.zeros(2, dtype=torch.float64))
    return simulated(
        Replay(sim, MARKERS, blank), release, {"youngs_modulus": 180e3}
    ).trials, release


@pytest.fixture(scope="module")
def loss():
    motions, release = observed_motions()
    return MotionLoss([TrialGroup(Replay(simulator(), MARKERS, motions), release, LOADS)], {})


def network(seed=0, **changes):
    torch.manual_seed(seed)
    rest = simulator().rest_positions
    q, v, force = (1e-2 * torch.randn(12, *rest.shape, dtype=torch.float64) for _ in range(3))
    return build_model(
        ResidualForce,
        NETWORK.changed(**changes),
        rest,
        rest + q,
        v,
        force + 1e-2,
        LOADS.repeat(6, 1),
    ).double()


def finish(trainer):
    while not trainer.finished:
        trainer.run_epoch()
    return trainer


class TestInTheLoop:
    @pytest.mark.parametrize("changes", [{}, {"kind": "nodal", "layers": 1}])
    def test_training_starts_at_zero_force(self, loss, changes):
        model = network(**changes)
        assert float(loss(model).detach()) != pytest.approx(float(loss(None)), rel=1e-6)
        trainer = InTheLoop(model, loss, loss, CONFIG.changed(epochs=1))
        rest = simulator().rest_state(2)
        assert not model(rest.q, rest.v + 1.0, LOADS).any()
        trainer.run_epoch()
        first, second = trainer.history
        assert first["rollout_error_mm"] == pytest.approx(loss.error_mm(None), rel=1e-9)
        if not changes:
            assert first["train_loss"] == pytest.approx(float(loss(None)), rel=1e-9)
        assert second["train_loss"] < first["train_loss"]

    def test_the_gradient_agrees_with_central_differences(self, loss):
        model = network(layers=1)
        loss(model).backward()
        random = torch.Generator().manual_seed(3)
        checked = 0
        for weight in model.network.parameters():
            direction = 0.1 * torch.randn(weight.shape, generator=random, dtype=torch.float64)
            start = weight.detach().clone()

            def along(k, weight=weight, start=start, direction=direction):
                weight.copy_(start + k * direction)
                return float(loss(model))

            with torch.no_grad():
                expected, _ = central_difference(along)
                weight.copy_(start)
            assert float((weight.grad * direction).sum()) == pytest.approx(expected, rel=1e-6)
            checked += abs(expected) > 1e-6
        assert checked >= 4

    def test_it_descends_and_keeps_the_best_weights(self, loss):
        trainer = finish(InTheLoop(network(), loss, loss, CONFIG.changed(epochs=12)))
        losses = [record["train_loss"] for record in trainer.history]
        assert losses == sorted(losses, reverse=True)
        # The way there hangs on rounding, from four epochs (0.53) to eight (0.42).
        assert losses[-1] < 0.5 * losses[0]
        errors = [record["rollout_error_mm"] for record in trainer.history]
        assert loss.error_mm(trainer.use_best()) == pytest.approx(min(errors), rel=1e-9)

    def test_it_goes_on_bit_for_bit(self, loss, tmp_path):
        whole = finish(InTheLoop(network(), loss, loss, CONFIG))
        part = InTheLoop(network(), loss, loss, CONFIG)
        for _ in range(2):
            part.run_epoch()
        write_checkpoint(tmp_path / "part.safetensors", "training", *part.snapshot())
        again = InTheLoop(network(seed=1), loss, loss, CONFIG)
        again.resume(*read_checkpoint(tmp_path / "part.safetensors", "training"))
        finish(again)
        assert again.history == whole.history
        one, other = (trainer.use_best().state_dict() for trainer in (whole, again))
        assert all(torch.equal(one[key], other[key]) for key in one)

    def test_a_failed_validation_has_an_infinite_loss(self, loss, monkeypatch):
        def failing(*_, **__):
            raise ConvergenceError("no", torch.zeros(1), None)

        monkeypatch.setattr(Replay, "sensed", failing)
        assert loss.error_mm(None) == float("inf")

    def test_cross_validation_selects_the_number_of_epochs(self, loss):
        """Here the held-out motions are those of training,
        there such as the simulator makes without a force.
        """
        motions, release = observed_motions()
        exact = simulated(Replay(simulator(), MARKERS, motions), release)
        other = MotionLoss([TrialGroup(exact, release, LOADS)], {})
        config, seen = CONFIG.changed(epochs=3), []
        trainer = InTheLoop(network(), loss, loss, config)
        epochs, (before, after) = cross_validated_epochs([trainer], lambda: seen.append(1))
        assert epochs == 3
        assert len(before) == len(after) == len(motions.names)
        assert np.mean([row.mean() for row in before]) == pytest.approx(
            loss.error_mm(None), rel=1e-9
        )
        assert np.mean([row.mean() for row in after]) < np.mean([row.mean() for row in before])
        assert len(seen) == 3
        for patience, spent in ((2, 2), (9, 3)):
            seen.clear()
            patient = config.changed(patience=patience)
            trainer = InTheLoop(network(), loss, other, patient)
            chosen, _ = cross_validated_epochs([trainer], lambda: seen.append(1))
            assert (chosen, len(seen)) == (0, spent)
        histories = []
        for held_out in (loss, other):
            alone = finish(InTheLoop(network(), loss, held_out, config))
            histories.append([record["rollout_error_mm"] for record in alone.history])
        parts = [InTheLoop(network(), loss, held_out, config) for held_out in (loss, loss, other)]
        mean = np.average(histories, axis=0, weights=[2, 1])
        # The mean decides.
        assert 0 < np.argmin(mean) == cross_validated_epochs(parts, lambda: None)[0]
        trainer = InTheLoop(network(), loss, loss, config, epochs=0)
        trainer.begin()
        assert trainer.finished
        assert loss.error_mm(trainer.use_best()) == pytest.approx(loss.error_mm(None), rel=1e-9)
