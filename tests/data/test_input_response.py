"""Lag of valves, delay of commands, and exponential means of inputs."""

import numpy as np
import pytest
import torch

from warp_resphys.core.stepping.quantity import Quantity
from warp_resphys.data.input_response import InputResponse, response_of, with_means

STEP = 0.01


def test_a_lag_follows_a_step_exponentially_and_a_delay_shifts_commands():
    command = torch.full((50, 1, 1), 2e4, dtype=torch.float64)
    rise = torch.tensor([0.07], dtype=torch.float64, requires_grad=True)
    result, _ = InputResponse(STEP, rise=rise).from_rest(command)
    times = STEP * torch.arange(1, 51, dtype=torch.float64)
    torch.testing.assert_close(result[:, 0, 0], 2e4 * (1 - torch.exp(-times / rise)))
    result.sum().backward()
    expected = -(2e4 * torch.exp(-times / 0.07) * times / 0.07**2).sum()
    torch.testing.assert_close(rise.grad[0], expected)
    command = torch.arange(1.0, 6.0, dtype=torch.float64)[:, None, None].expand(-1, 3, 2)
    late = torch.tensor([0.0, 2.0, 1.25], dtype=torch.float64) * STEP
    result = InputResponse(STEP, delay=late).from_rest(command)[0][..., 0]
    assert result[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert result[:, 1].tolist() == [0.0, 0.0, 1.0, 2.0, 3.0]
    torch.testing.assert_close(
        result[:, 2], torch.tensor([0.0, 0.75, 1.75, 2.75, 3.75], dtype=torch.float64)
    )


def test_means_are_exponential_averages_of_the_pressure():
    pressure = torch.zeros(100, 1, 2, dtype=torch.float64)
    pressure[20:, :, 0] = 1e4
    context = with_means(*InputResponse(STEP, filters=[0.1, 1.0]).from_rest(pressure))
    assert context.shape == (100, 1, 6)
    torch.testing.assert_close(context[..., :2], pressure)
    assert not context[:20].any()
    fast, slow = context[-1, 0, 2], context[-1, 0, 4]
    assert float(fast) == pytest.approx(1e4, rel=1e-3)
    assert float(slow) == pytest.approx(1e4 * (1 - np.exp(-0.8)), rel=1e-9)
    torch.testing.assert_close(with_means(*InputResponse(STEP).from_rest(pressure)), pressure)


@pytest.mark.parametrize(("delay", "rise"), [(0.0, 0.001), (0.025, 0.04)])
def test_steps_are_the_series_for_arrays_and_for_tensors_with_parameters_of_their_own(delay, rise):
    commands = np.random.default_rng(1).random((20, 3, 2))
    response = InputResponse(STEP, 0.8, delay, rise, filters=[0.1, 0.5])
    acting, means = response.from_rest(commands)
    memory = response.steady(np.zeros((3, 2)))
    for number, now in enumerate(commands):
        one, mean, memory = response(memory, now[None])
        np.testing.assert_allclose(one[0], acting[number], atol=1e-12)
        np.testing.assert_allclose(mean[:, 0], means[:, number], atol=1e-12)
    of_each = [
        torch.tensor([1.0, value, 0.5 * value], dtype=torch.float64) for value in (0.8, delay, rise)
    ]
    result, context = InputResponse(STEP, *of_each, filters=[0.1, 0.5]).from_rest(
        torch.as_tensor(commands)
    )
    np.testing.assert_allclose(result[:, 1], acting[:, 1], atol=1e-12)
    np.testing.assert_allclose(context[:, :, 1], means[:, :, 1], atol=1e-12)
    assert float((result[:, 0] - torch.as_tensor(acting[:, 0])).abs().max()) > 1e-3


def test_the_slew_rate_limits_the_change_in_a_step():
    commands = np.concatenate([np.zeros((2, 1)), np.full((10, 1), 5.0), np.full((10, 1), 4.5)])
    rate = 3.0 / STEP  # of the input a second: three in a step
    limited, _ = InputResponse(STEP, slew=1.0 / rate).from_rest(commands)
    np.testing.assert_allclose(limited[:6, 0], [0.0, 0.0, 3.0, 5.0, 5.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(limited[12:, 0], 4.5, atol=1e-12)
    plain, _ = InputResponse(STEP, rise=2.0 * STEP).from_rest(commands)
    lagged, _ = InputResponse(STEP, rise=2.0 * STEP, slew=0.0).from_rest(commands)
    np.testing.assert_allclose(lagged, plain, atol=1e-12)
    slewing, _ = InputResponse(STEP, rise=2.0 * STEP, slew=1.0 / (0.2 * rate)).from_rest(commands)
    assert np.abs(np.diff(slewing[:, 0])).max() <= 0.6 + 1e-12
    assert float(slewing[11, 0]) == pytest.approx(plain[11, 0], abs=0.3)
    slews = torch.tensor([0.0, 1.0 / rate], dtype=torch.float64)
    both, _ = InputResponse(STEP, slew=slews).from_rest(
        torch.as_tensor(np.stack([commands, commands], 1))
    )
    np.testing.assert_allclose(both[:, 1], limited, atol=1e-12)
    np.testing.assert_allclose(both[:, 0], commands, atol=1e-12)


CURVE = {"slope_2": 0.5, "slope_3": 2.0, "slope_5": 0.0}


def test_a_characteristic_curve_has_its_slope_in_each_octave_of_the_typical_command():
    response = InputResponse(STEP, typical=100.0, **CURVE)
    ends = np.array([0.0, 25.0, 50.0, 100.0, 200.0, 400.0, 800.0])
    inner = (0.6 * ends[1:-1] + 0.4 * ends[2:])[:, None]
    slopes = (response.still(inner + 1e-4) - response.still(inner - 1e-4))[:, 0] / 2e-4
    np.testing.assert_allclose(slopes, [0.5, 2.0, 1.0, 0.0, 1.0], atol=0.1)
    expected = np.cumsum(np.diff(ends) * [1.0, 0.5, 2.0, 1.0, 0.0, 1.0])  # with sharp corners
    np.testing.assert_allclose(response.still(ends[1:, None])[:, 0], expected, rtol=0.15)
    np.testing.assert_array_equal(response.still(-ends), -response.still(ends))
    assert response.still(np.zeros(1)) == 0.0


def test_what_acts_counts_from_the_zero_beyond_the_dead_band_and_not_below_the_least_input():
    commands = np.array([-3.0, -1.0, 0.0, 0.5, 1.0, 1.5, 4.0])[:, None, None]
    acting, _ = InputResponse(STEP, 2.0, dead_band=1.0).from_rest(commands)
    np.testing.assert_allclose(
        acting[:, 0, 0], 2.0 * np.array([-2.0, 0.0, 0.0, 0.0, 0.0, 0.5, 3.0])
    )
    np.testing.assert_array_equal(
        InputResponse(STEP, dead_band=0.0).from_rest(commands)[0], commands
    )
    bands = torch.tensor([0.0, 1.0, 5.0], dtype=torch.float64, requires_grad=True)
    of_each = torch.as_tensor(commands).expand(-1, 3, 1)
    result = InputResponse(STEP, dead_band=bands).from_rest(of_each)[0]
    np.testing.assert_allclose(result[-1, :, 0].detach(), [4.0, 3.0, 0.0])
    (slope,) = torch.autograd.grad(result[-1].sum(), bands)
    np.testing.assert_allclose(slope, [-1.0, -1.0, 0.0])
    commands = np.array([0.0, 0.5, 1.0, 3.0])[:, None]
    acting = InputResponse(STEP, 2.0, zero=0.5, lower=0.0).still(commands)
    np.testing.assert_array_equal(acting[:, 0], [0.0, 0.0, 1.0, 5.0])
    signed = InputResponse(
        STEP, 2.0, dead_band=0.25, zero=torch.tensor([0.5, -1.0], dtype=torch.float64)
    )
    of_each = signed.still(torch.as_tensor(commands)[:, None].repeat(1, 2, 1))
    np.testing.assert_array_equal(of_each[:, 0, 0], [-0.5, 0.0, 0.5, 4.5])
    np.testing.assert_array_equal(of_each[:, 1, 0], [1.5, 2.5, 3.5, 7.5])


def test_gears_turn_back_after_their_backlash():
    """In one call and step by step; commands at rest have risen to their values."""
    commands = np.array([1.0, 3.0, 2.5, 2.0, 1.0, 1.5, 1.9, 3.0, 0.0])[:, None, None]
    expected = 2.0 * np.array([1.0, 3.0, 3.0, 2.75, 1.75, 1.75, 1.9, 3.0, 0.75])
    response = InputResponse(STEP, 2.0, backlash=0.75)
    np.testing.assert_allclose(
        response(response.steady(commands[0]), commands)[0][:, 0, 0], expected
    )
    memory, steps = response.steady(commands[0]), []
    for command in commands:
        acting, _, memory = response(memory, command[None])
        steps.append(acting[0, 0, 0])
    np.testing.assert_allclose(steps, expected)
    widths = torch.tensor([0.0, 0.75], dtype=torch.float64, requires_grad=True)
    of_each = torch.as_tensor(commands).expand(-1, 2, 1)
    response = InputResponse(STEP, 2.0, backlash=widths)
    result = response(response.steady(of_each[0]), of_each)[0][..., 0]
    np.testing.assert_allclose(result.detach(), np.stack([2.0 * commands[:, 0, 0], expected], 1))
    (slope,) = torch.autograd.grad(result.sum(), widths)
    # In as many steps the gears have turned back.
    np.testing.assert_allclose(slope, [2.0 * 4, 2.0 * 4])


@pytest.mark.parametrize(
    "word", ["factor", "delay", "rise", "slew", "dead_band", "zero", "backlash", "slope_2"]
)
def test_a_part_with_a_value_of_its_own_responds_as_if_all_had_it(word):
    commands = np.random.default_rng(2).random((20, 3, 2)) * 2.0
    common = {
        "factor": 0.8,
        "delay": 0.013,
        "rise": 0.03,
        "slew": 0.1,
        "dead_band": 0.05,
        "zero": 0.1,
    }
    common |= {"backlash": 0.1, "slope_2": 1.2}
    value = {"delay": 0.035}.get(word, 1.5 * common[word])
    pressure = Quantity("pressure", "Pa", per="chamber")
    known = {f"pressure_{name}": x for name, x in common.items()} | {f"pressure_{word}_2": value}
    arguments = response_of(pressure, known, ("1", "2"))
    np.testing.assert_array_equal(arguments[word], [common[word], value])
    alone = [
        InputResponse(STEP, **{**common, word: x}).from_rest(commands)[0]
        for x in (common[word], value)
    ]
    expected = np.stack([of_all[..., part] for part, of_all in enumerate(alone)], -1)
    np.testing.assert_allclose(
        InputResponse(STEP, **arguments).from_rest(commands)[0], expected, atol=1e-12
    )
    tensors = {name: torch.full((3,), x, dtype=torch.float64) for name, x in known.items()}
    result, _ = InputResponse(STEP, **response_of(pressure, tensors, ("1", "2"))).from_rest(
        torch.as_tensor(commands)
    )
    np.testing.assert_allclose(result, expected, atol=1e-12)


def test_other_parts_have_the_value_without_an_effect():
    known = {"tension_factor_left": 2.0, "tension_delay_right": 0.1}
    arguments = response_of(Quantity("tension", "N"), known, ("left", "right"))
    np.testing.assert_array_equal(arguments["factor"], [2.0, 1.0])
    np.testing.assert_array_equal(arguments["delay"], [0.0, 0.1])
