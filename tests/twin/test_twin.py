"""A twin follows a robot by its markers, however they come, and says what was wrong with them."""

import json
import socket
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.refusals import refuses
from warp_resphys import InputError, Twin, load
from warp_resphys.control.controllers import conditioned
from warp_resphys.twin.estimator import adapted, distances
from warp_resphys.twin.stream import Listener, recorded_packets
from warp_resphys.twin.tangent import StepTangent, shifted

NOISE = 1e-4


@pytest.fixture(scope="module")
def robot(finished):
    return load(finished[0], "simulation").integrated_by("bdf2")


@pytest.fixture(scope="module")
def swing(robot):
    """Markers (T, N, 3) of a body that is let go from a bent shape,
    with noise, and its true states.
    """
    start = robot.begin(external_force=pull(robot, 0.5))
    motion = robot.rollout(start, 60)
    noise = NOISE * np.random.default_rng(0).standard_normal(tuple(motion.q[:, 0].shape))
    return motion.q[:, 0].numpy() + noise, motion.q[:, 0].numpy(), motion


def pull(robot, newtons):
    """A force on the tip, upwards and sideways (N, 3)."""
    rest = robot.simulator.rest_positions
    force = torch.zeros_like(rest)
    tip = rest[:, 0] > rest[:, 0].max() - 1e-9
    force[tip] = torch.tensor([0.0, 0.6, 0.8], dtype=rest.dtype) * newtons / tip.sum()
    return force


def followed(robot, frames, order=None, commands=None, **settings):
    """A twin that took frames in an order, some with commands, by their numbers."""
    twin = Twin(robot, noise=NOISE, **settings)
    for number in order or range(len(frames)):
        twin.take(number * robot.time_step, frames[number], **(commands or {}).get(number, {}))
    return twin


def test_conditioning_is_that_of_normal_variables():
    random = np.random.default_rng(1)
    root = random.normal(size=(5, 5))
    slopes = random.normal(size=(7, 5))
    residual = random.normal(size=7)
    covariance = root @ root.T
    covariance[2] = covariance[:, 2] = 0.0  # a quantity that is known
    change, after = conditioned(covariance, slopes, residual, 0.3)
    spread = slopes @ covariance @ slopes.T + 0.09 * np.eye(7)
    gain = covariance @ slopes.T @ np.linalg.inv(spread)
    np.testing.assert_allclose(change, gain @ residual, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(after, covariance - gain @ slopes @ covariance, rtol=1e-6, atol=1e-9)
    away = distances(covariance, slopes[:6].reshape(2, 3, 5), residual[:6].reshape(2, 3), 0.3)
    whole = np.sqrt(residual[:3] @ np.linalg.solve(spread[:3, :3], residual[:3]))
    assert away[0] == pytest.approx(whole)


def test_what_is_not_seen_is_forgotten(robot):
    """The force fades in a second, and parameters drift in ten,
    but never by more than was known before.
    """
    stiff = float(robot.simulator.defaults["youngs_modulus"])
    estimator = Twin(robot, refine={"youngs_modulus": 0.1 * stiff}).estimator
    belief, count, h = estimator.begin({}), len(estimator.tangent.frequencies), robot.time_step
    belief = replace(belief, bias=np.ones(count), covariance=0.0 * belief.covariance)
    transition, variances = np.eye(2 * count, 3 * count), []
    for _ in range(round(10.0 / h)):
        belief = estimator._propagated(belief, transition)
        variances.append(belief.covariance[3 * count, 3 * count] / (0.1 * stiff) ** 2)
        if len(variances) == round(1.0 / h):
            np.testing.assert_allclose(belief.bias, np.exp(-1.0))
    assert variances[round(1.0 / h) - 1] == pytest.approx(0.1)
    assert 0.6 < variances[-1] <= 1.0


def test_the_variance_of_steps_adapts_to_the_distances_of_frames():
    usual = np.sqrt(2.366)  # the median, of three coordinates
    assert adapted(3.0, np.array([np.nan, usual, 1.1 * usual, 0.9 * usual])) == pytest.approx(
        3.0, rel=1e-3
    )
    assert adapted(3.0, np.full(4, np.nan)) == 3.0
    far, near = 1.0, 1.0
    for _ in range(5):  # frames after which the factor follows the squared distances
        far, near = adapted(far, np.full(4, 10.0 * usual)), adapted(near, np.full(4, 0.1 * usual))
    assert far == pytest.approx(100.0, rel=1e-3)
    assert near == 0.03


def test_a_step_is_linear_in_its_vibrations(robot):
    robot = robot.integrated_by("implicit_euler")
    start = robot.begin()
    tangent = StepTangent.of(robot, start, {}, 4)
    count = len(tangent.frequencies)
    still = robot.step(robot.step(start))
    errors = np.zeros((2, count))
    errors[:, 0] = 2e-4 / tangent.size * np.array([1.0, tangent.frequencies[0]])
    fields = [
        torch.einsum("r,rni->ni", torch.as_tensor(row).to(still.q), tangent.shapes)[None]
        for row in errors
    ]
    moved, linear = shifted(robot, still, *fields), errors.ravel()
    for _ in range(10):
        moved, still = robot.step(moved), robot.step(still)
        linear = tangent.transition[:, : 2 * count] @ linear
    seen = torch.einsum("r,rni->ni", torch.as_tensor(linear[:count]).to(still.q), tangent.shapes)
    true = moved.q[0] - still.q[0]
    assert float(true.norm(dim=1).max()) > 3e-5
    assert float((seen - true).norm(dim=1).max()) < 0.05 * float(true.norm(dim=1).max())


def test_a_force_shifts_the_equilibrium_by_what_it_is_named(robot):
    tangent = StepTangent.of(robot, robot.begin(), {}, 4)
    one = 1e-3 / tangent.size
    shifted_by = robot.begin(external_force=one * tangent.pull[0]).q[0] - robot.begin().q[0]
    expected = one * tangent.shapes[0]
    assert float((shifted_by - expected).norm(dim=1).max()) < 0.05 * float(
        expected.norm(dim=1).max()
    )


def test_it_finds_a_state_that_it_was_not_given(robot, swing):
    frames, true, _ = swing
    twin = followed(robot, frames)
    now = twin.now
    off = np.linalg.norm(now.markers - true[-1], axis=1).mean()
    free = np.linalg.norm(robot.begin().q[0].numpy() - true[-1], axis=1).mean()
    assert off < 0.1 * free
    assert off < 2.0 * NOISE
    assert now.time == pytest.approx(60 * robot.time_step)
    inside = np.abs(now.markers - true[-1]) < 1.645 * now.deviations + 1e-9
    assert inside[true[0] != true[-1]].mean() > 0.8
    assert twin.counts == {}


def test_its_predictions_are_better_than_the_last_markers(robot, swing):
    frames, _, _ = swing
    twin = Twin(robot, noise=NOISE, horizon=0.1)
    assert twin.disagreement is None
    for number, frame in enumerate(frames):
        twin.take(number * robot.time_step, frame)
        if number > 15:
            ahead = twin.ahead()
            np.testing.assert_allclose(ahead.times[-1] - ahead.times[0], 0.1)
    off = twin.disagreement
    assert off.predictions == 60 - 15 - 10
    assert off.twin < 0.3 * off.held
    assert off.twin < 0.5 * off.simulator
    assert off.covered > 0.8


def test_packets_that_come_late_change_nothing(robot, swing):
    """Neither their markers nor their commands."""
    frames, _, _ = swing
    order, commands = list(range(40)), {6: {"base": [0.0, 0.0, 1e-3, 0.0, 0.0, 0.0]}}
    for number in range(1, 36, 5):
        order[number], order[number + 3] = order[number + 3], order[number]
    late, due = (followed(robot, frames, own, commands) for own in (order, range(40)))
    for number in range(3):  # Estimates on the way must not matter either.
        late.take((39 - number) * robot.time_step, np.full_like(frames[0], np.nan))
        _ = late.now
    assert torch.equal(late.now.state.q, due.now.state.q)
    np.testing.assert_array_equal(late.now.markers, due.now.markers)
    fixed = robot.simulator.body.fixed_vertices
    lifted = late.now.state.q[0, fixed] - robot.simulator.rest_positions[fixed]
    assert float(lifted[:, 2].min()) == pytest.approx(1e-3)
    assert late.counts["packets out of order"] >= 7
    assert not late.take(0.0, frames[0])
    assert late.counts["packets too late"] == 1


def test_markers_that_vanish_or_jump_are_left_out_and_named(robot, swing):
    frames, true, _ = swing
    broken = frames.copy()
    tip = int(true[0, :, 0].argmax())
    broken[20:26, tip] += [0.0, 0.03, 0.0]
    broken[30:40] = np.nan
    twin = followed(robot, broken)
    assert twin.counts == {"a vertex jumps": 6}
    assert np.linalg.norm(twin.now.markers - true[-1], axis=1).mean() < 2.0 * NOISE


def test_a_body_that_is_put_elsewhere_is_found_again(robot, swing):
    frames, true, _ = swing
    moved = np.concatenate([frames[40:60], frames[:60]])
    at_tip = true[0, :, 0] > true[0, :, 0].max() - 0.01
    moved = np.where(at_tip[:, None], moved, np.nan)
    twin = followed(robot, moved)
    assert twin.counts["jumps of the whole body"] == 1
    assert np.linalg.norm(twin.now.markers - true[59], axis=1).mean() < 3.0 * NOISE


def test_a_marker_that_slips_is_followed_to_its_new_place(robot, swing):
    true = swing[1]
    along = np.argsort(true[0, :, 0])
    chosen = [int(along[len(along) * share // 8]) for share in (3, 5, 6, 7)]
    marked = robot.with_parameters()
    marked.labels = ("root", "middle", "far", "tip")
    marked._observe = lambda q: q[:, chosen]
    frames = true[:, chosen] + NOISE * np.random.default_rng(3).standard_normal((61, 4, 3))
    frames[25:, 1] += [0.0, 0.02, 0.0]
    twin = Twin(marked, noise=NOISE)
    for number, frame in enumerate(frames):
        twin.take(number * robot.time_step, dict(zip(marked.labels, frame, strict=True)))
    assert twin.counts["middle has moved on the body"] == 1
    assert twin.counts["middle jumps"] >= 2
    now = twin.now
    np.testing.assert_allclose(now.markers[1] - true[-1, chosen[1]], [0.0, 0.02, 0.0], atol=1e-3)
    others = [0, 2, 3]
    assert np.linalg.norm(now.markers - true[-1, chosen], axis=1)[others].max() < 5e-4
    body = np.linalg.norm(now.state.q[0].numpy() - true[-1], axis=1)
    assert body.mean() < 1e-3


def test_it_refines_a_parameter_as_it_runs(robot):
    stiff = float(robot.simulator.defaults["youngs_modulus"])
    other = robot.with_parameters(youngs_modulus=1.2 * stiff)
    motion = other.rollout(other.begin(external_force=pull(robot, 0.5)), 80)
    frames = motion.q[:, 0].numpy()
    frames = frames + NOISE * np.random.default_rng(2).standard_normal(frames.shape)
    twin = followed(robot, frames, refine={"youngs_modulus": 0.3 * stiff})
    value, deviation = twin.now.parameters["youngs_modulus"]
    assert value == pytest.approx(1.2 * stiff, rel=0.05)
    assert deviation < 0.1 * stiff
    assert abs(value - 1.2 * stiff) < 3.0 * deviation
    refuses(InputError, "there is no parameter 'wobble'", Twin, robot, refine={"wobble": 1.0})
    refuses(
        InputError, r"refine\.youngs_modulus is -1", Twin, robot, refine={"youngs_modulus": -1.0}
    )


def test_a_clock_that_is_set_back_and_a_gap_start_it_again(robot, swing):
    frames, _, _ = swing
    twin = followed(robot, frames[:20])
    for number in range(12):
        twin.take(number * robot.time_step - 5.0, frames[number])
    assert twin.counts["starts with an earlier clock"] == 1
    assert twin.counts["packets too late"] == 9
    assert -5.0 < twin.now.time < 0.0
    twin.take(100.0, frames[0])
    assert twin.counts["starts after a gap"] == 1
    assert twin.now.time == 100.0


@pytest.mark.parametrize(
    ("packet", "message"),
    [
        ((np.nan, None, {}), "has the time nan"),
        ((0.05, np.zeros((2, 3)), {}), r"markers of shape \(2, 3\)"),
        ((0.05, {"vertex_0": [1.0]}, {}), r"as the position of 'vertex_0': give x, y and z in m"),
        ((0.05, None, {"wind": 1.0}), "there is no input 'wind'"),
        ((0.05, None, {"base": [10**400] * 6}), "base is .*: give numbers"),
    ],
)
def test_a_wrong_packet_is_one_sentence_and_is_left_out(robot, swing, packet, message):
    twin = followed(robot, swing[0][:5])
    before = twin.now
    refuses(InputError, message, twin.take, packet[0], packet[1], **packet[2])
    assert torch.equal(before.state.q, twin.now.state.q)


def test_millimetres_are_refused_and_unknown_markers_counted(robot, swing):
    twin = Twin(robot)
    with pytest.raises(InputError, match="no packet"):
        _ = twin.now
    refuses(InputError, "give positions in metres", twin.take, 0.0, 1e3 * swing[0][0])
    twin.take(0.0, {"vertex_3": swing[0][0][3], "nose": [0, 0, 0], "vertex_4": [None, None, None]})
    assert twin.counts == {"unknown marker 'nose'": 1}
    assert np.isfinite(twin.now.markers).all()


def test_packets_over_udp_and_from_a_file(robot, folder):
    listener = Listener("udp://127.0.0.1:0")
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sent = {"time": 1.5, "markers": {"vertex_0": [0.0, 0.1, None]}, "inputs": {"payload": 0.1}}
    sent["plan"] = [{"time": 2.0, "inputs": {"payload": 0.2}}]
    wrong = [
        b"{",
        b'{"markers": {}}',
        b'{"time": 1, "x": 2}',
        b'{"time": 1, "inputs": 2}',
        b"[" * 50_000,
    ]
    wrong += [b'{"time": 1, "plan": {"payload": 1}}']
    wrong += [b'{"time": 1, "markers": {"vertex_0": [1]}}']
    for text in (json.dumps(sent).encode(), *wrong):
        sender.sendto(text, listener.address)
    packets, until = [], time.monotonic() + 10.0
    while (
        sum(listener.refused.values()) + len(packets) < 1 + len(wrong) and time.monotonic() < until
    ):
        packets += listener.packets()
    (packet,) = packets
    assert (packet.time, packet.inputs, packet.plan) == (
        1.5,
        {"payload": 0.1},
        [(2.0, {"payload": 0.2})],
    )
    np.testing.assert_array_equal(packet.markers["vertex_0"], [np.nan] * 3)
    assert sum(listener.refused.values()) == len(wrong)
    for words in (
        "as the position of 'vertex_0'",
        "has no time",
        "has the field 'x'",
        "no object",
        "plan of a packet is no list",
    ):
        assert sum(words in message for message in listener.refused) == 1
    assert sum("is no JSON" in message for message in listener.refused) == 2
    refuses(InputError, "cannot be listened at", Listener, f"udp://127.0.0.1:{listener.address[1]}")
    sender.close()
    listener.close()
    for wrong in ("tcp://127.0.0.1:1", "udp://127.0.0.1", "udp://x:y"):
        refuses(InputError, "give udp://HOST:PORT", Listener, wrong)
    motion = robot.rollout(robot.begin(), 4)
    motion.write_csv("swing.csv")
    read = list(recorded_packets(robot, "swing.csv"))
    assert [packet.time for packet in read] == pytest.approx([0.0, 0.01, 0.02, 0.03, 0.04])
    np.testing.assert_allclose(read[2].markers["vertex_7"], motion.q[2, 0, 7].numpy(), atol=1e-9)


def test_a_command_that_cannot_be_done_is_left_out(robot, swing):
    frames = swing[0]
    twin = followed(robot, frames, range(10), {5: {"base": [0.0, 0.0, 0.03, 0.0, 0.0, 0.0]}})
    assert twin.now.time == pytest.approx(9 * robot.time_step)
    (fault,) = twin.counts
    assert fault.startswith("a command was left out: base moves by 30 mm in a step")
    same = followed(robot, frames, range(10))
    assert torch.equal(twin.now.state.q, same.now.state.q)


def test_the_clamp_holds_the_estimated_body(robot, swing):
    """As in the swing that is seen, of which the twin knows nothing but the markers."""
    frames, _, motion = swing
    rest = Twin(robot)
    rest.take(0.0)
    weight = robot.simulator.prepare().load_mass.sum() * torch.tensor(
        robot.simulator.gravity, dtype=torch.float64
    )
    torch.testing.assert_close(rest.now.state.reaction.force[0], -weight, rtol=1e-5, atol=1e-7)
    twin, true, seen = Twin(robot, noise=NOISE), motion.reaction.force[:, 0], []
    for number, frame in enumerate(frames):
        twin.take(number * robot.time_step, frame)
        seen.append(robot.simulator.reaction(twin.now.state).force[0])
    off = (torch.stack(seen)[31:] - true[30:]).norm(dim=1).mean()
    assert float(off) < 0.1 * float((true[30:] - true.mean(0)).norm(dim=1).mean())
    ahead = twin.ahead(3 * robot.time_step)
    following = robot.rollout(motion.final, 3).reaction.force[-1, 0]
    assert float((ahead.state.reaction.force[0] - following).norm()) < 0.1 * float(following.norm())


def test_predictions_follow_a_plan_of_commands(robot):
    h, lifted = robot.time_step, [0.0, 0.0, 2e-3, 0.0, 0.0, 0.0]
    fixed, rest = robot.simulator.body.fixed_vertices, robot.simulator.rest_positions
    twin = Twin(robot, horizon=4 * h)
    twin.plan([(9 * h, {"base": [0.0] * 6}), (3 * h, {"base": lifted})])
    twin.take(0.0)
    ahead = twin.ahead().markers
    height = ahead[:, fixed, 2] - rest[fixed, 2].numpy()
    np.testing.assert_allclose(height.mean(axis=1), [0.0, 0.0, 0.0, 0.0, 2e-3], atol=1e-6)
    twin.take(5 * h)
    # a plan is no command
    assert float((twin.now.state.q[0, fixed] - rest[fixed]).abs().max()) == 0.0
    twin.plan([(5.6 * h, {"base": lifted})])
    twin.take(5.5 * h)  # its step ends at 6 h, and what is planned before that acts from then on
    height = twin.ahead().markers[:, fixed, 2] - rest[fixed, 2].numpy()
    np.testing.assert_allclose(height.mean(axis=1), [0.0, 2e-3, 2e-3, 2e-3, 2e-3], atol=1e-6)
    twin.plan([])
    refuses(InputError, "there is no input 'wind'", twin.plan, [(0.1, {"wind": 1.0})])
    assert twin.ahead(7 * h).markers[1, fixed[0], 2] - rest[fixed[0], 2] == pytest.approx(
        0.0, abs=1e-6
    )


def test_its_transition_follows_the_body(robot):
    """In a bent body a step has other derivatives than at rest.

    After a turn of renewals the twin has them.
    """
    robot = robot.integrated_by("implicit_euler")
    force, estimator = pull(robot, 8.0), Twin(robot).estimator
    belief = estimator.begin({})
    count = len(belief.bias)
    for _ in range(2 * 8 * 3 * count):  # two turns, at the longest pauses
        belief = estimator.advance(belief, {"external_force": force})
    moved, faster, pulled = estimator.tangent.changes(range(3 * count))
    after = robot.step(
        shifted(robot, belief.state.select([0] * 6 * count), moved, faster),
        external_force=force + pulled,
    )
    expected = estimator.tangent.slopes(after, range(3 * count))
    off, first = (
        np.abs(x - expected)[:count, :count].max()
        for x in (belief.transition, estimator.tangent.transition)
    )
    assert first > 0.03
    assert off < 0.1 * first
    assert belief.pause == 8
