"""Motions predicted from those with similar parameters, and what a search simulates of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.swinging_beam import simulated
from warp_resphys import Body, Corotated, Inputs, Simulator, SolverSettings, Tendons, box_hexahedra, select_vertices
from warp_resphys.data.markers import WHOLE_STATE
from warp_resphys.io.errors import ConvergenceError
from warp_resphys.learning.identification.misfit import Misfit
from warp_resphys.learning.replay import Replay, Start
from warp_resphys.learning.trial_batch import TrialBatch
from warp_resphys.settings.learning import Bounds

MESH = box_hexahedra(divisions=(4, 1, 1))
CLAMP = select_vertices(MESH, x=0.0)
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
        Watched.steps, Watched.iterations = Watched.steps + 1, Watched.iterations + int(new.report.iterations.sum())
        return new


def counted(function, *arguments):
    """The result of a function, and the numbers of steps and of iterations."""
    Watched.steps = Watched.iterations = 0
    return function(*arguments), Watched.steps, Watched.iterations


def replayed(frames, kind=Simulator, energies=(), static=False, **options):
    """Two trials from rest under different forces at the tip, observed at all vertices."""
    sim = kind(Body(MESH, CLAMP, energies=energies), SOFT, time_step=0.01, integrator="bdf2", **options)
    times = torch.zeros(2, 1).double() if static else 0.01 * torch.arange(frames).double().expand(2, -1)
    held = sim.rest_positions.expand(2, -1, -1)
    force = torch.zeros(2, *held.shape[1:]).double()
    force[:, select_vertices(MESH, x=0.1), 1] = torch.tensor([[0.002], [-0.004]]).double()
    at = Inputs(external_force=force)
    blank = TrialBatch(("a", "b"), times, held[:, None].repeat(1, frames, 1, 1), held, at, at if static else Inputs())
    replay = Replay(sim, WHOLE_STATE, blank)
    start = Start.resting(held.clone())
    return simulated(replay, start, VALUES, noise=1e-4), start


@pytest.mark.parametrize(
    ("static", "energies"), [(True, ()), (False, (Tendons([[[0.0, 0.015, 0.02], [0.1, 0.015, 0.02]]], friction=0.2),))]
)
def test_varied_trials_differ_from_the_first_as_trials_simulated_one_by_one(static, energies):
    replay, start = replayed(1 if static else 8, energies=energies, static=static, relative_tolerance=1e-12)
    step = 1e-4
    sets = {
        "youngs_modulus": torch.tensor([2e5, 2e5 * (1.0 + step), 2e5]).double(),
        "poissons_ratio": torch.tensor([0.47, 0.47, 0.47 + step]).double(),
    }
    with torch.no_grad():
        alone = replay(start, sets)
    varied = replay.varied(start, sets)
    wanted = alone[1:] - alone[0]
    torch.testing.assert_close(varied[0], alone[0], rtol=0.0, atol=1e-10)
    torch.testing.assert_close(varied[1:] - varied[0], wanted, rtol=0.0, atol=1e-2 * float(wanted.abs().max()))


def test_predicted_motions_take_fewer_iterations_and_have_the_same_derivatives():
    replay, start = replayed(20, Watched)
    misfit, unit = Misfit([(replay, start)], RANGES), np.array([0.5, 0.5])
    _, steps, cold = counted(misfit.linearise, unit)
    assert steps == 19
    near, _, warm = counted(misfit.linearise, unit + 0.002)
    misfit.forget()
    again, _, without = counted(misfit.linearise, unit + 0.002)
    assert warm < 0.6 * min(cold, without)
    np.testing.assert_allclose(near.gradient, again.gradient, rtol=1e-5, atol=1e-5 * np.abs(again.gradient).max())
    np.testing.assert_allclose(near.gauss_newton, again.gauss_newton, rtol=1e-5)


def test_a_step_that_fails_from_its_prediction_is_solved_without():
    replay, start = replayed(6)
    values = {name: torch.tensor([value]).double() for name, value in VALUES.items()}
    wanted = replay.states(start, values)
    turned = wanted[0].q.flip(1)  # inside out, from where the solver does not come back in few iterations
    replay = Replay(replace(replay.simulator, solver=SolverSettings(max_iterations=20)), WHOLE_STATE, replay.trials)
    with pytest.raises(ConvergenceError):
        replay.simulator.step(wanted[0], replay.trials.inputs.at(0), replay.prepare(values)[0], near=turned)
    again = replay.states(start, values, lambda number: turned if number == 1 else None)
    torch.testing.assert_close(again[-1].q, wanted[-1].q, rtol=0.0, atol=1e-6)
