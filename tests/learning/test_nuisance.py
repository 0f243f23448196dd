"""Delays of motions and marker places follow the physical parameters: both come back, with exact derivatives."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from warp_resphys import Body, Simulator
from warp_resphys.data.markers import bind_markers
from warp_resphys.data.trials import Trials
from warp_resphys.learning.identification import ParameterSearch
from warp_resphys.learning.misfit import Misfit
from warp_resphys.learning.parameters import Bounds
from warp_resphys.learning.placement import Accuracy, PlacedMarkers, Placement
from warp_resphys.learning.replay import Replay, Start
from warp_resphys.mesh.mesh import box_hexahedra, select_vertices
from warp_resphys.stepping.inputs import Inputs

MESH = box_hexahedra(divisions=(4, 1, 1))
TIP = select_vertices(MESH, x=0.1)
POINTS = np.array([[0.1, 0.015, 0.036], [0.1, -0.006, 0.024], [0.1, 0.036, 0.006]])
LABELS = ["a", "b", "c"]
SIM = Simulator(Body(MESH, select_vertices(MESH, x=0.0)), time_step=0.01, integrator="bdf2")
DELAYS, FRAMES, BEGIN = (0.013, -0.021, 0.004), 40, 6
TRUTH = {"youngs_modulus": 215e3, "stiffness_damping": 0.004}
RANGES = {"youngs_modulus": Bounds(1e5, 1e6, logarithmic=True), "stiffness_damping": Bounds(0.0, 0.02)}
ACCURACY = Accuracy(markers=0.003, shift=0.002)


def double(values):
    return torch.as_tensor(values, dtype=torch.float64)


def motions(markers, noise=1e-5):
    """Bodies at rest that a force at the tip moves, a little later than the inputs say."""
    count = len(DELAYS)
    force = torch.zeros(FRAMES, count, len(MESH.vertices), 3, dtype=torch.float64)
    force[BEGIN:, :, TIP, 1] = 0.02  # N
    times = (0.01 * torch.arange(FRAMES, dtype=torch.float64)).expand(count, -1)
    held = double(POINTS).expand(count, -1, -1)
    blank = Trials(("m1", "m2", "m3"), times, held[:, None].repeat(1, FRAMES, 1, 1), held, Inputs(force))
    start = Start.resting(SIM.rest_state(count).q)
    with torch.no_grad():
        seen = Replay(SIM, markers, blank)(
            replace(start, delay=double(DELAYS)), {k: double([v]) for k, v in TRUTH.items()}
        )
    random = torch.Generator().manual_seed(1)
    seen = seen[0] + noise * torch.randn(seen[0].shape, generator=random, dtype=torch.float64)
    seen[1, 20:25, 0] = torch.nan
    return replace(blank, observed=seen), start


def bound():
    return bind_markers(MESH, POINTS, LABELS, kind="rigid", vertices=TIP)


def askew():
    offsets = 2e-3 * double([[1.0, -0.5, 0.3], [-0.4, 0.6, 1.0], [0.2, 0.8, -1.0]])
    return Placement(offsets, double([1e-3, 0.0, -1e-3]), double([0.0, 0.0, 0.0]), double([0.0, 0.0, 0.0]))


@pytest.mark.parametrize("placed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_parameters_are_recovered_from_motions_whose_inputs_were_late(placed):
    trials, start = motions(PlacedMarkers.of(bound(), askew()) if placed else bound())
    more = {"accuracy": ACCURACY, "labels": LABELS} if placed else {}
    pair = (Replay(SIM, bound(), trials), start)
    first = {"youngs_modulus": 300e3, "stiffness_damping": 0.002}
    result = ParameterSearch(Misfit([pair], RANGES, delay=0.02, **more)).run([first], 40)
    assert result.parameters["youngs_modulus"] == pytest.approx(
        215e3, rel=1e-2 if placed else 1e-3
    )  # Places are held by a prior.
    assert result.parameters["stiffness_damping"] == pytest.approx(0.004, rel=0.05)
    on_time = ParameterSearch(Misfit([pair], RANGES, **more)).run([first], 40)
    assert result.loss < (0.2 if placed else 0.02) * on_time.loss


@pytest.mark.parametrize("accuracy", [None, ACCURACY])
def test_derivatives_are_those_of_the_loss_with_the_best_delays(accuracy):
    trials, start = motions(bound(), noise=1e-4)
    start = replace(start, delay=double([0.002, 0.0, 0.0]))
    misfit = Misfit([(Replay(SIM, bound(), trials), start)], RANGES, accuracy=accuracy, delay=0.02)
    unit = np.array([0.4, 0.25])
    for _ in range(2):
        misfit.update_prior_weight(unit)
    linear = misfit.linearise(unit)
    for column in range(len(unit)):
        step = 1e-4 * np.eye(len(unit))[column]
        ends = [misfit.linearise(unit + sign * step, derivatives=False).loss for sign in (1.0, -1.0)]
        assert linear.gradient[column] == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-3), column
    assert misfit.losses_or_infinite(unit[None])[0] == pytest.approx(linear.loss, rel=1e-9)
