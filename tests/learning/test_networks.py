"""Networks, and a force that fades out beyond its training."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import nn

from warp_resphys import (
    Body,
    Corotated,
    InputError,
    Simulator,
    State,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.dynamics import modes
from warp_resphys.core.dynamics.modes import RestStiffness, vibration_modes
from warp_resphys.io.safe_files import read_checkpoint, write_checkpoint
from warp_resphys.learning.residuals.coders import (
    actuation_coder,
    displacement_coder,
    nodal_coder,
    pod_coder,
)
from warp_resphys.learning.residuals.correction import Learned, LearnedPredictor, Range
from warp_resphys.learning.residuals.networks import (
    NextState,
    ResidualForce,
    SkipMLP,
    build_model,
    restore,
)
from warp_resphys.settings.learning import NetworkSettings

REDUCED = {"kind": "reduced", "position_modes": 3, "velocity_modes": 4, "force_modes": 5}
ARCHITECTURE = {"blocks": 2, "layers": 1, "width": 16, "activation": "normalised_elu"}
KINDS = {
    "reduced": NetworkSettings(**REDUCED, **ARCHITECTURE),
    "nodal": NetworkSettings(kind="nodal", **ARCHITECTURE),
}


def field(samples, vertices=6, rank=None, seed=0):
    """(S, N, 3) of falling singular values."""
    random = np.random.default_rng(seed)
    columns = 3 * vertices
    rank = rank or min(samples, columns)
    left = np.linalg.qr(random.normal(size=(samples, rank)))[0]
    right = np.linalg.qr(random.normal(size=(columns, rank)))[0]
    values = 3.0 * 0.5 ** np.arange(rank)
    return torch.tensor((left * values) @ right.T).view(samples, vertices, 3)


def built(kind):
    torch.manual_seed(0)
    rest, q, v, force = field(1, seed=5)[0], field(40, seed=1), field(40, seed=2), field(40, seed=3)
    return build_model(ResidualForce, KINDS[kind], rest, rest + q, v, force), rest + q, v, force


def test_blocks_of_a_skip_mlp_after_the_first_add_to_their_input():
    torch.manual_seed(0)
    network = SkipMLP(4, 3, blocks=3, layers=1, width=8, activation="normalised_elu")
    x = torch.randn(5, 4)
    first = network.blocks[0](x)
    second = first + network.blocks[1](first)
    assert torch.equal(network(x), second + network.blocks[2](second))
    for block in list(network.blocks)[1:]:
        nn.init.zeros_(block[-1].weight)
        nn.init.zeros_(block[-1].bias)
    assert torch.equal(network(x), first)


class TestPOD:
    def test_basis_is_orthonormal_and_the_best_of_its_size(self):
        samples = field(40)
        coder = pod_coder(samples, 4)
        basis = coder.basis
        np.testing.assert_allclose(basis.mT @ basis, np.eye(4), atol=1e-14)
        x = samples.flatten(1)
        missed = (samples - coder.decode(coder.encode(samples))).flatten(1)
        smallest = torch.linalg.svdvals(x)[4:].square().sum()  # Eckart and Young
        np.testing.assert_allclose(missed.square().sum(), smallest, rtol=1e-10)

    @pytest.mark.parametrize(("samples", "modes"), [(40, 19), (40, 0)])
    def test_modes_that_the_samples_do_not_have(self, samples, modes):
        with pytest.raises(
            InputError, match=f"{modes} modes were asked for, but {samples} samples give 1 to"
        ):
            pod_coder(field(samples), modes)


def test_round_trip_and_standardisation_of_the_nodal_coder():
    samples = 2.0 + field(40)
    coder = nodal_coder(samples)
    coordinates = coder.encode(samples)
    np.testing.assert_allclose(coordinates.mean(0), 0.0, atol=1e-12)
    np.testing.assert_allclose(coordinates.std(0), 1.0, rtol=1e-12)
    np.testing.assert_allclose(coder.decode(coordinates), samples, atol=1e-14)
    assert coder.size == 18


class TestResidualForce:
    def test_linear_part_is_ridge_regression(self):
        model, *_ = built("reduced")
        random = np.random.default_rng(0)
        x = random.normal(size=(30, 7)).astype(np.float32)
        y = random.normal(size=(30, 5)).astype(np.float32)
        noise = 0.3
        model.fit_linear(torch.tensor(x), torch.tensor(y), noise)
        # Least squares with rows that say: noise sqrt(S) times each weight is zero.
        rows = np.vstack([x, np.sqrt(30) * noise * np.eye(7)]).astype(np.float64)
        expected = np.linalg.lstsq(rows, np.vstack([y, np.zeros((7, 5))]), rcond=None)[0]
        np.testing.assert_allclose(model.linear, expected, rtol=1e-5, atol=1e-7)
        left = y - x @ expected
        np.testing.assert_allclose(model.remainder, np.sqrt((left**2).mean()), rtol=1e-6)
        inputs = torch.tensor(x)
        together = model.standardised(inputs)
        np.testing.assert_allclose(
            together.detach(),
            inputs @ model.linear + model.remainder * model.network(inputs).detach(),
            rtol=1e-6,
        )

    @pytest.mark.parametrize("kind", KINDS)
    def test_force_from_state(self, kind):
        model, q, v, force = built(kind)
        inputs = model.encode(q, v)
        sizes = {"reduced": (7, 5), "nodal": (36, 18)}[kind]
        assert (inputs.shape[1], model.coders[0].size) == sizes
        assert inputs.dtype == torch.float32
        np.testing.assert_allclose(inputs[:, : sizes[0] // 2].std(0), 1.0, rtol=0.05)
        # With a linear part that is exact, the force comes back.
        with torch.no_grad():
            model.linear.copy_(torch.linalg.lstsq(inputs, model.encode_outputs(force)).solution)
            model.remainder.zero_()
            result = model(q, v)
        wanted = model.coders[0].decode((inputs @ model.linear).double())
        assert result.dtype == torch.float64
        np.testing.assert_allclose(result, wanted, rtol=0, atol=1e-12)


class TestActuation:
    LOADS = torch.tensor([[0.0, 0.0], [0.05, 0.0], [0.1, 0.0]], dtype=torch.float64).repeat(14, 1)
    LOADS = LOADS[:40]

    def built(self, kind=ResidualForce, coded="reduced"):
        torch.manual_seed(0)
        rest, q, v = field(1, seed=5)[0], field(40, seed=1), field(40, seed=2)
        force = field(40, seed=3) if kind is ResidualForce else None
        model = build_model(kind, KINDS[coded], rest, rest + q, v, force, self.LOADS)
        return model, rest + q, v

    def test_it_is_in_units_of_its_size_and_none_stays_zero(self):
        coded = actuation_coder(self.LOADS).encode(self.LOADS)
        assert float(coded[:, 0].square().mean()) == pytest.approx(1.0)
        assert not coded[0].any()
        assert not coded[:, 1].any()

    @pytest.mark.parametrize("coded", KINDS)
    @pytest.mark.parametrize("kind", [ResidualForce, NextState])
    @pytest.mark.parametrize("double", [False, True])
    def test_saved_and_restored_it_predicts_the_same(self, tmp_path, kind, coded, double):
        model, q, v = self.built(kind, coded)
        model = (model.double() if double else model).eval()
        write_checkpoint(
            tmp_path / "model.safetensors", "test", model.state_dict(), model.description()
        )
        again = restore(kind, *read_checkpoint(tmp_path / "model.safetensors", "test"))
        assert again.state_dict().keys() == model.state_dict().keys()
        assert not again.training
        with torch.no_grad():
            for one, other in zip(
                model.predict(q, v, self.LOADS), again.predict(q, v, self.LOADS), strict=True
            ):
                assert torch.equal(one, other)
            assert not torch.equal(
                model.predict(q, v, self.LOADS)[0], model.predict(q, v, 2.0 * self.LOADS)[0]
            )

    @pytest.mark.parametrize("kind", [ResidualForce, NextState])
    def test_inputs_outside_the_training_range_are_clamped(self, kind):
        model, q, v = self.built(kind)
        model = model.double().eval()
        with torch.no_grad():
            held = Range.of(model.encode(q, v, self.LOADS))
        # During each of four steps.
        context = torch.stack([self.LOADS[i : i + 5] for i in (0, 5, 0, 0)])
        watched = LearnedPredictor(model, context, held)

        def predicted(q, v, step):
            given = watched(State(q, v), step)
            return (given.q, given.v) if isinstance(given, State) else (given,)

        with torch.no_grad():
            for step in (0, 1):
                expected = model.predict(q[:5], v[:5], context[step])
                for one, other in zip(predicted(q[:5], v[:5], step), expected, strict=True):
                    torch.testing.assert_close(one, other)
            assert watched.left_at.tolist() == [-1] * 5
            away = q[:5] - model.rest
            far = [
                predicted(model.rest + size * away, size * v[:5], step)
                for step, size in ((2, 1e6), (3, 1e9))
            ]
        for one, other in zip(*far, strict=True):
            torch.testing.assert_close(one, other)
        assert watched.left_at.tolist() == [2] * 5


def clamped_beam():
    mesh = box_hexahedra((0.1, 0.02, 0.02), (5, 1, 1))
    return Simulator(
        Body(mesh, fixed=select_vertices(mesh, x=0.0)), Corotated(2e5, 0.3), gravity=(0.0, 0.0, 0.0)
    )


def test_displacement_modes_keep_a_weak_bending_force_and_drop_a_strong_one_without_effect():
    simulator = clamped_beam()
    stiffness, n = RestStiffness(simulator), simulator.body.n_vertices
    random = torch.Generator().manual_seed(0)
    bend, squeeze = (torch.zeros(n, 3, dtype=torch.float64) for _ in range(2))
    tip = np.flatnonzero(simulator.body.mesh.vertices[:, 0] > 0.099)
    bend[tip, 2] = 1e-3
    squeeze[tip, 1] = 1e-2 * torch.tensor([1.0, 1.0, -1.0, -1.0], dtype=torch.float64)  # cancels
    amounts = torch.randn(50, 2, generator=random, dtype=torch.float64)
    forces = amounts[:, :1, None] * bend + amounts[:, 1:, None] * squeeze
    coder = displacement_coder(forces, stiffness, 1)
    kept = coder.decode(coder.encode(forces))
    moved = stiffness.displacements((kept - forces).flatten(1).T.numpy())
    assert (
        np.abs(moved).max()
        < 0.05 * np.abs(stiffness.displacements(forces.flatten(1).T.numpy())).max()
    )
    assert float((kept - forces).norm()) > 0.9 * float((amounts[:, 1:, None] * squeeze).norm())
    plain = pod_coder(forces, 1)
    assert float((plain.decode(plain.encode(forces)) - forces).norm()) < 0.2 * float(forces.norm())
    both = displacement_coder(forces, stiffness, 2)
    torch.testing.assert_close(both.decode(both.encode(forces)), forces, rtol=0.0, atol=1e-12)


def test_a_network_without_velocity_inputs_is_restored_with_its_dual_modes():
    simulator = clamped_beam()
    rest, n = simulator.rest_positions, simulator.body.n_vertices
    random = torch.Generator().manual_seed(0)
    q, v, force = (
        1e-3 * torch.randn(20, n, 3, generator=random, dtype=torch.float64) for _ in range(3)
    )
    sizes = {"position_modes": 3, "velocity_modes": 0, "force_modes": 2}
    config = NetworkSettings(**sizes, blocks=1, layers=1, width=8, activation="silu")
    model = (
        build_model(
            ResidualForce, config, rest, rest + q, v, force, stiffness=RestStiffness(simulator)
        )
        .double()
        .eval()
    )
    torch.testing.assert_close(model(rest + q, v), model(rest + q, 10.0 * v))
    assert not torch.equal(model(rest + 2.0 * q, v), model(rest + q, v))
    again = restore(ResidualForce, model.state_dict(), model.description())
    torch.testing.assert_close(again(rest + q, v), model(rest + q, v))


def test_modes_of_large_bodies_are_those_of_small_ones(monkeypatch):
    """Lanczos and the dense solver span the same forces, also of a body that nothing holds."""
    mesh = box_hexahedra((0.1, 0.02, 0.03), (5, 1, 1))
    simulator = Simulator(Body(mesh), Corotated(2e5, 0.3, stiffness_damping=1e-3))
    dense = vibration_modes(simulator, 8).numpy()
    monkeypatch.setattr(modes, "_DENSE", 0)
    cosines = np.linalg.svd(dense.T @ vibration_modes(simulator, 8).numpy())[1]
    np.testing.assert_allclose(cosines, 1.0, atol=1e-7)


def test_rest_stiffness_knows_no_viscosity_and_wants_a_body_that_is_held():
    plain, damped = (
        RestStiffness(
            dataclasses.replace(
                clamped_beam(), material=Corotated(2e5, 0.3, stiffness_damping=beta)
            )
        )
        for beta in (0.0, 0.01)
    )
    force = np.random.default_rng(0).standard_normal((3 * 24, 2))
    np.testing.assert_allclose(damped.displacements(force), plain.displacements(force), rtol=1e-9)
    with pytest.raises(InputError, match="fix some vertices"):
        RestStiffness(Simulator(Body(box_hexahedra())))


SAMPLES, VERTICES = 30, 8
SMALL = NetworkSettings(position_modes=3, velocity_modes=2, force_modes=4, layers=1, width=16)
BOX = Range(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0]), torch.tensor([2e-3, 0.1]))


def motion(modes, seed):
    """(S, N, 3) samples in a space of few modes, and the (M, 3 N) orthonormal modes."""
    random = torch.Generator().manual_seed(seed)
    basis = torch.linalg.qr(
        torch.randn(3 * VERTICES, modes, generator=random, dtype=torch.float64)
    )[0].T
    return (torch.randn(SAMPLES, modes, generator=random, dtype=torch.float64) @ basis).view(
        SAMPLES, -1, 3
    ), basis


@pytest.fixture
def trained():
    """A model of float64, states of its training, and modes of displacements and velocities."""
    torch.manual_seed(0)
    (u, by_u), (v, by_v), (force, _) = motion(3, 1), motion(2, 2), motion(4, 3)
    rest = torch.rand(VERTICES, 3, dtype=torch.float64)
    model = build_model(ResidualForce, SMALL, rest, rest + u, v, force).double().eval()
    return model, rest + u, v, by_u, by_v


def across(basis, size):
    """A field (N, 3) without any part along modes, whose root mean square distance is `size`."""
    field = torch.randn(
        3 * VERTICES, dtype=torch.float64, generator=torch.Generator().manual_seed(9)
    )
    field = field - basis.T @ (basis @ field)
    return (size * math.sqrt(VERTICES) * field / field.norm()).view(VERTICES, 3)


def test_the_distance_from_the_modes_is_that_of_what_they_cannot_represent(trained):
    model, q, v, by_u, by_v = trained
    torch.testing.assert_close(
        model.missed(q, v), torch.zeros(SAMPLES, 2, dtype=q.dtype), rtol=0.0, atol=1e-12
    )
    away = model.missed(q + across(by_u, 3e-3), v - across(by_v, 0.2))
    torch.testing.assert_close(away, q.new_tensor([[3e-3, 0.2]]).expand(SAMPLES, 2))


@pytest.mark.parametrize(
    ("inputs", "missed", "weight"),
    [
        ([0.0, 2.0], [0.0, 0.0], 1.0),
        ([1.4, 4.9], [2.4e-3, 0.12], 1.0),  # within the widened box, and 1.25 times the distances
        ([1.75, 2.0], [0.0, 0.0], 0.5),  # half a margin beyond it
        ([0.0, -1.5], [0.0, 0.0], 0.5),
        ([0.0, 6.1], [0.0, 0.0], 0.0),
        ([0.0, 2.0], [3.75e-3, 0.0], 0.5),  # 1.875 times
        ([1.75, 2.0], [0.0, 0.26], 0.0),
    ],
)
def test_the_weight_falls_from_one_within_to_zero_beyond(inputs, missed, weight):
    assert BOX.weight(torch.tensor([inputs]), torch.tensor([missed])).tolist() == pytest.approx(
        [weight], abs=1e-5
    )


def test_a_predictor_scales_its_force_and_moves_to_a_device_with_its_range(trained):
    model, q, v, by_u, _ = trained
    # As if motions had been this far from the modes.
    missed = model.missed(q + across(by_u, 1e-3), v)
    with torch.no_grad():
        guarded = Range.of(model.encode(q, v), missed)
        fading = LearnedPredictor(model, range_=guarded)
        constant = LearnedPredictor(model, range_=Range(guarded.low, guarded.high))
        for size, weight in ((0.0, 1.0), (1.2e-3, 1.0), (1.875e-3, 0.5), (2.6e-3, 0.0)):
            state = State(q[:5] + across(by_u, size), v[:5])
            torch.testing.assert_close(
                fading(state, 0), weight * constant(state, 0), atol=1e-9, rtol=1e-6
            )
        assert constant(state, 0).abs().max() > 1e-3
    assert fading.left_at.tolist() == [-1] * 5
    learned = Learned(torch.nn.Linear(2, 1), BOX).to(torch.device("meta"))
    assert {
        x.device.type
        for x in (*learned.range_.edges, learned.range_.missed, *learned.network.parameters())
    } == {"meta"}
