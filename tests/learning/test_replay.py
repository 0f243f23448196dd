"""Replays of observed motions: gradients, other weights and gravities,
begins, and predictions from nearby motions.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.refusals import refuses
from support.swinging_beam import MARKERS, MESH, TIP, blank, double, simulated
from warp_resphys import (
    Contact,
    Corotated,
    HalfSpace,
    Inputs,
    Simulator,
    SolverSettings,
    State,
    Tendons,
    box_hexahedra,
)
from warp_resphys.core.dynamics.modes import vibration_modes
from warp_resphys.core.fem.bodies import Body, PointMass
from warp_resphys.core.mesh.selection import select_vertices
from warp_resphys.core.stepping.rollout import sample
from warp_resphys.data.markers import WHOLE_STATE
from warp_resphys.io.errors import ConvergenceError, InputError
from warp_resphys.io.settings import parse
from warp_resphys.learning.identification.misfit import Misfit
from warp_resphys.learning.parameters import tilted_gravity
from warp_resphys.learning.release import (
    ReleaseSettings,
    begin_inputs,
    estimate_release,
    hold,
    sideways_shapes,
)
from warp_resphys.learning.replay import Replay
from warp_resphys.learning.start import Start
from warp_resphys.learning.trial_batch import TrialBatch
from warp_resphys.settings.learning import Bounds


def simulator(masses=(), kind=Simulator, **options):
    options = {"integrator": "bdf2", "material": Corotated(215e3, 0.45)} | options
    body = Body(
        MESH, select_vertices(MESH, x=0.0), point_masses=[PointMass(m, TIP) for m in masses]
    )
    return kind(body, time_step=0.01, **options)


def at_rest(sim, count, delay=0.0):
    return Start(sim.rest_state(count), torch.full((count,), delay, dtype=torch.float64))


def test_sampling_is_exact_on_parabolas_of_third_order_and_differentiable():
    h, t = 0.1, 0.1 * torch.arange(6, dtype=torch.float64)
    parabola = torch.stack([1.0 + 2.0 * t - 3.0 * t**2, t**2])[..., None]
    times = double([[0.0, 0.013, 0.25, 0.4999, 0.5], [0.5, 0.31, 0.07, 0.0, 0.2]])
    values = sample(parabola, times, h)[..., 0]
    torch.testing.assert_close(
        values[0], 1.0 + 2.0 * times[0] - 3.0 * times[0] ** 2, rtol=0.0, atol=1e-14
    )
    torch.testing.assert_close(values[1], times[1] ** 2, rtol=0.0, atol=1e-14)
    torch.testing.assert_close(sample(t[None] ** 3, t[None], h), t[None] ** 3, rtol=0.0, atol=1e-15)
    assert float(sample(parabola, double([[9.0], [9.0]]), h)[1, 0, 0]) == float(parabola[1, -1, 0])

    def error(h):
        series = torch.sin(h * torch.arange(int(1.0 / h) + 2, dtype=torch.float64))[None]
        times = torch.linspace(0.1, 0.9, 77, dtype=torch.float64)[None]
        return float((sample(series, times, h) - torch.sin(times)).abs().max())

    assert error(0.025) < error(0.05) / 7.0
    generator = torch.Generator().manual_seed(0)
    series = torch.rand(2, 6, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    times = double([[0.013, 0.25], [0.31, 0.487]]).requires_grad_()
    assert torch.autograd.gradcheck(lambda s, t: sample(s, t, 0.1), (series, times))


def test_gravity_turns_by_its_components_and_keeps_its_strength():
    sim = simulator(gravity=(0.0, -9.8, 0.0))
    turned = tilted_gravity(sim, double([0.0, 0.1, 0.0]), double([0.0, 0.0, -0.2]))
    expected = 9.8 * np.array(
        [[0, -1, 0], [0.1, -1, 0] / np.sqrt(1.01), [0, -1, -0.2] / np.sqrt(1.04)]
    )
    np.testing.assert_allclose(turned.numpy(), expected, atol=1e-12)
    oblique = tilted_gravity(simulator(gravity=(3.0, -2.0, 9.0)), double([0.3]), None)
    assert float(oblique.norm()) == pytest.approx(np.sqrt(94.0))
    assert tilted_gravity(sim, None, None).tolist() == [[0.0, -9.8, 0.0]]
    refuses(
        InputError,
        "without gravity",
        tilted_gravity,
        simulator(gravity=(0.0, 0.0, 0.0)),
        double([0.1]),
        None,
    )


def test_sets_of_parameters_at_once_are_those_one_by_one():
    sim = simulator()
    replay, release = Replay(sim, MARKERS, blank()), at_rest(sim, 2)
    values = {
        "youngs_modulus": double([2e5, 4e5]),
        "density": double([1000.0, 1200.0]),
        "mass_damping": double([0, 3.0]),
    }
    together = replay(release, values)
    for e in range(2):
        alone = replay(release, {name: value[e : e + 1] for name, value in values.items()})
        torch.testing.assert_close(together[e], alone[0], rtol=0.0, atol=1e-8)
    defaults = {
        "youngs_modulus": double([215e3]),
        "attached_mass_factor": double([1.0]),
        "gravity_tilt_2": double([0.0]),
    }
    torch.testing.assert_close(replay(release), replay(release, defaults), rtol=0.0, atol=1e-9)
    refuses(InputError, "no parameter 'stiffness'", replay, release, {"stiffness": double([1.0])})


def test_parts_have_their_own_parameters():
    """The parameter of one part leaves the other parts at their own or their common value."""
    routes = {
        name: [[0.0, 0.01, z], [0.1, 0.01, z]] for name, z in (("low", 0.005), ("high", 0.015))
    }
    tendons = Tendons(routes, stiffness=[300.0, 400.0])
    sim = Simulator(Body(MESH, select_vertices(MESH, x=0.0), energies=(tendons,)))
    replay = Replay(sim, lambda q: q, blank(masses=(0.0, 0.0)))
    assert {"tendon_stiffness", "tendon_stiffness_low", "tendon_stiffness_high"} <= {
        *replay.parameter_names
    }
    value = double([1.0, 2.0])
    for given, wanted in (
        ({"tendon_stiffness_high": value}, [[300.0, 1.0], [300.0, 2.0]]),
        (
            {"tendon_stiffness_low": value, "tendon_stiffness_high": 3.0 * value},
            [[1.0, 3.0], [2.0, 6.0]],
        ),
        (
            {"tendon_stiffness": 5.0 * value, "tendon_stiffness_low": value},
            [[1.0, 5.0], [2.0, 10.0]],
        ),
    ):
        constants, _, _ = replay.prepare(given)
        result = constants.values[1]["tendon_stiffness"]  # two trials for each set of parameters
        torch.testing.assert_close(result, double(wanted).repeat_interleave(2, 0))


@pytest.mark.parametrize(
    ("integrator", "nu"), [("implicit_euler", 0.45), ("bdf2", 0.499), ("midpoint", 0.499)]
)
def test_gradients_of_every_parameter_agree_with_central_differences(integrator, nu):
    sim = simulator(integrator=integrator, relative_tolerance=1e-11)
    motions = blank(frames=8)
    motions.observed[0, 3, 1] = torch.nan
    motions.observed[1, 6:] = torch.nan
    release = at_rest(sim, 2, delay=0.004)
    replay = Replay(sim, MARKERS, motions)
    at = double([215e3, nu, 1070.0, 0.8, 0.002, 1.1, 0.05, -0.03])
    scale = double([1e5, 1e-3, 1000.0, 1.0, 0.01, 1.0, 1.0, 1.0])

    def losses(values):
        errors = replay.errors(
            replay(release, dict(zip(replay.parameter_names, values.mT, strict=True)))
        )
        return errors.square().sum((1, 2, 3, 4))

    x = at[None].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(losses(x).sum(), x)
    steps = torch.diag(1e-4 * scale)
    with torch.no_grad():
        ahead, behind = losses(torch.cat([at + steps, at - steps])).view(2, -1)
    differences = (ahead - behind) / 2e-4
    assert float(differences.abs().min()) > 0.0
    torch.testing.assert_close(
        gradient[0] * scale, differences, rtol=1e-4, atol=1e-5 * float(differences.abs().max())
    )
    points = torch.cat([at[None], at + 0.1 * steps])
    varied, _ = replay.varied(release, dict(zip(replay.parameter_names, points.mT, strict=True)))
    along = replay.errors(varied).square().sum((1, 2, 3, 4))
    torch.testing.assert_close(
        (along[1:] - along[0]) / 1e-5,
        differences,
        rtol=1e-3,
        atol=1e-4 * float(differences.abs().max()),
    )


def test_states_within_an_obstacle_are_no_derivatives():
    """The second floor is where the first body, whose floor lies far below, falls through it."""
    floor = Contact({"floor": HalfSpace(position=(0.0, 0.0, -0.002))})
    sim = Simulator(
        Body(MESH, select_vertices(MESH, x=0.0), energies=[floor]),
        Corotated(5e4, 0.45),
        time_step=0.01,
    )
    replay = Replay(sim, MARKERS, blank(20, masses=(0.0,)))
    with pytest.raises(ConvergenceError, match="no derivatives from step 2 on"):
        replay.varied(at_rest(sim, 1), {"obstacle_z": double([-0.05, 0.0])})


def test_a_motion_whose_markers_were_never_seen_is_refused():
    motions = blank()
    with pytest.raises(InputError, match="'m1' was seen"):
        replace(
            motions,
            observed=torch.where(double([[[[0.0]]], [[[1.0]]]]) > 0, torch.nan, motions.observed),
        )


def test_a_held_body_has_its_markers_where_they_were_and_is_at_rest():
    sim = simulator()
    replay = Replay(sim, MARKERS, blank())
    straight = hold(replay, 6)
    assert float((MARKERS(straight) - replay.trials.held).abs().max()) < 5e-5
    turned = replay.trials.held + double([0.0, 0.004, 0.008])
    turned[1, 2] = torch.nan
    bent = hold(Replay(sim, MARKERS, replace(replay.trials, held=turned)), 6)
    distance = (MARKERS(bent) - turned).norm(dim=-1)
    assert float(distance.nanmean()) < 4e-4
    assert bool(bent.isfinite().all())


def test_releases_within_twice_what_is_expected_are_recovered_in_any_basis(monkeypatch):
    """Delays between any two frames: each frame that sees the body
    at rest or moving is a minimum of its own.

    The beam is square: any rotation of its first two vibrations is as good a basis.
    """
    angle, count = 0.6, 8

    def rotated(sim, count):
        basis = vibration_modes(sim, count)
        turn = double([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return torch.cat([basis[:, :2] @ turn, basis[:, 2:]], 1)

    monkeypatch.setattr("warp_resphys.learning.release.vibration_modes", rotated)
    sim, motions = simulator(), blank(frames=12, masses=(0.0, 0.05) * (count // 2))
    replay = Replay(sim, MARKERS, motions)
    values = (
        4.0 * torch.rand(count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        - 2.0
    )
    q = hold(replay, 6)
    release = Start(State(q, torch.zeros_like(q)), 0.01 * values)
    seen = replay(release)[0]
    settings = ReleaseSettings(hold_modes=6, delay=0.01, window=0.1, noise=1e-5)
    result = estimate_release(Replay(sim, MARKERS, replace(motions, observed=seen)), settings)
    torch.testing.assert_close(result.delay, release.delay, rtol=0.0, atol=5e-4)
    torch.testing.assert_close(result.state.q, q)
    assert float((replay(result)[0] - seen).norm(dim=-1).mean()) < 2e-5
    assert result.shift is None
    kept = estimate_release(replay, ReleaseSettings(delay=0.0))
    assert float(kept.delay.abs().max() + kept.state.v.abs().max()) == 0.0


def test_the_delay_of_inputs_of_a_body_at_rest_is_recovered():
    sim, count = simulator(), 4
    force = torch.zeros(40, count, len(MESH.vertices), 3, dtype=torch.float64)
    force[6:, :, TIP, 1] = 0.02  # N
    motions = replace(blank(frames=41, masses=(0.0,) * count), inputs=Inputs(force))
    start, delay = Start.resting(sim.rest_state(count).q), double([0.0, 0.0137, -0.0261, 0.004])
    seen = Replay(sim, MARKERS, motions)(replace(start, delay=delay))[0]
    seen[3, 10:20] = torch.nan
    replay = Replay(sim, MARKERS, replace(motions, observed=seen))
    result = begin_inputs(replay, start, ReleaseSettings(delay=0.01, window=0.3, noise=1e-5))
    torch.testing.assert_close(result.delay, delay, rtol=0.0, atol=3e-4)
    assert float((replay(result)[0] - seen).nan_to_num().abs().max()) < 5e-5
    near = begin_inputs(replay, start, ReleaseSettings(delay=0.01, window=0.3, noise=1.0))
    assert float(near.delay.abs().max()) < 1e-3  # Markers as inaccurate as this say nothing.
    assert begin_inputs(replay, start, ReleaseSettings(delay=0.0)) is start


def test_a_sideways_held_body_is_identified_from_its_initial_motion():
    sim, motions = simulator(), blank(frames=16)
    replay, shapes = Replay(sim, MARKERS, motions), sideways_shapes(sim)
    q = hold(replay, 6)
    bends = double([[0.002], [-0.003]])
    bent = q + torch.einsum("bk,knc->bnc", bends, shapes)
    truth = Start(
        State(bent, torch.zeros_like(q)), torch.zeros(2).double(), MARKERS(q) - MARKERS(bent)
    )
    seen = replay(truth)[0]
    torch.testing.assert_close(seen[:, 0], MARKERS(q), rtol=0.0, atol=1e-12)
    settings = ReleaseSettings(delay=0.0, sideways=0.002, window=0.1, noise=1e-5)
    result = estimate_release(Replay(sim, MARKERS, replace(motions, observed=seen)), settings)
    torch.testing.assert_close(result.state.q, bent, rtol=0.0, atol=2e-5)
    torch.testing.assert_close(replay(result)[0], seen, rtol=0.0, atol=1e-5)
    torch.testing.assert_close(result.select([1]).shift, result.shift[1:])
    torch.testing.assert_close(result.bound(result.shifted(seen)), seen)
    bowed = Replay(sim, MARKERS, replace(motions, observed=seen))
    straight = estimate_release(bowed, settings.changed(sideways=0.0))
    assert straight.shift is None
    assert float((replay(straight)[0] - seen).norm(dim=-1).mean()) > 1e-3


@pytest.mark.parametrize(
    "wrong",
    [{"window": 0.0}, {"noise": -1.0}, {"delay": -0.1}, {"velocity_modes": -1}, {"sideways": -1.0}],
)
def test_settings_out_of_range_are_refused(wrong):
    refuses(InputError, f"release.{next(iter(wrong))}", parse, ReleaseSettings, wrong, "release")


BAR = box_hexahedra(divisions=(4, 1, 1))
CLAMP = select_vertices(BAR, x=0.0)
SOFT = Corotated(8e4, 0.49)
RANGES = {
    "youngs_modulus": Bounds(lower=5e4, upper=5e5, logarithmic=True),
    "poissons_ratio": Bounds(lower=0.4, upper=0.499),
}
VALUES = {"youngs_modulus": 2e5, "poissons_ratio": 0.47}


class Watched(Simulator):
    """A simulator that counts its steps and their iterations."""

    steps, iterations = 0, 0

    def step(self, *arguments):
        new = super().step(*arguments)
        Watched.steps, Watched.iterations = (
            Watched.steps + 1,
            Watched.iterations + int(new.report.iterations.sum()),
        )
        return new


def counted(function, *arguments):
    """The result of a function, and the numbers of steps and of iterations."""
    Watched.steps = Watched.iterations = 0
    return function(*arguments), Watched.steps, Watched.iterations


def replayed(frames, kind=Simulator, energies=(), static=False, **options):
    """Two trials from rest under different forces at the tip, observed at all vertices."""
    sim = kind(
        Body(BAR, CLAMP, energies=energies), SOFT, time_step=0.01, integrator="bdf2", **options
    )
    times = (
        torch.zeros(2, 1).double() if static else 0.01 * torch.arange(frames).double().expand(2, -1)
    )
    held = sim.rest_positions.expand(2, -1, -1)
    force = torch.zeros(2, *held.shape[1:]).double()
    force[:, select_vertices(BAR, x=0.1), 1] = torch.tensor([[0.002], [-0.004]]).double()
    at = Inputs(external_force=force)
    blank = TrialBatch(
        ("a", "b"),
        times,
        held[:, None].repeat(1, frames, 1, 1),
        held,
        at,
        at if static else Inputs(),
    )
    replay = Replay(sim, WHOLE_STATE, blank)
    start = Start.resting(held.clone())
    return simulated(replay, start, VALUES, noise=1e-4), start


@pytest.mark.parametrize(
    ("static", "energies"),
    [(True, ()), (False, (Tendons([[[0.0, 0.015, 0.02], [0.1, 0.015, 0.02]]], friction=0.2),))],
)
def test_varied_trials_differ_from_the_first_as_trials_simulated_one_by_one(static, energies):
    replay, start = replayed(
        1 if static else 8, energies=energies, static=static, relative_tolerance=1e-12
    )
    step = 1e-4
    sets = {
        "youngs_modulus": torch.tensor([2e5, 2e5 * (1.0 + step), 2e5]).double(),
        "poissons_ratio": torch.tensor([0.47, 0.47, 0.47 + step]).double(),
    }
    with torch.no_grad():
        alone = replay(start, sets)
    varied, _ = replay.varied(start, sets)
    wanted = alone[1:] - alone[0]
    torch.testing.assert_close(varied[0], alone[0], rtol=0.0, atol=1e-10)
    torch.testing.assert_close(
        varied[1:] - varied[0], wanted, rtol=0.0, atol=1e-2 * float(wanted.abs().max())
    )


def test_predicted_motions_take_fewer_iterations_and_have_the_same_derivatives():
    replay, start = replayed(20, Watched)
    misfit, unit = Misfit([(replay, start)], RANGES), np.array([0.5, 0.5])
    _, steps, cold = counted(misfit.linearise, unit)
    assert steps == 19
    near, _, warm = counted(misfit.linearise, unit + 0.002)
    misfit.forget()
    again, _, without = counted(misfit.linearise, unit + 0.002)
    assert warm < 0.6 * min(cold, without)
    np.testing.assert_allclose(
        near.gradient, again.gradient, rtol=1e-5, atol=1e-5 * np.abs(again.gradient).max()
    )
    np.testing.assert_allclose(near.gauss_newton, again.gauss_newton, rtol=1e-5)


def test_a_step_that_fails_from_its_prediction_is_solved_without():
    replay, start = replayed(6)
    values = {name: torch.tensor([value]).double() for name, value in VALUES.items()}
    wanted = replay.states(start, values)
    # Inside out, from where the solver does not come back in few iterations.
    turned = wanted[0].q.flip(1)
    replay = Replay(
        replace(replay.simulator, solver=SolverSettings(max_iterations=20)),
        WHOLE_STATE,
        replay.trials,
    )
    with pytest.raises(ConvergenceError):
        replay.simulator.step(
            wanted[0], replay.trials.inputs.at(0), replay.prepare(values)[0], near=turned
        )
    again = replay.states(start, values, lambda number: turned if number == 1 else None)
    torch.testing.assert_close(again[-1].q, wanted[-1].q, rtol=0.0, atol=1e-6)
