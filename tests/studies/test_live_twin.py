"""The viewer's twin: it follows a trial, a file or packets over UDP, and its page shows where the robot will be."""

import json
import socket
import time

import numpy as np
import pytest

from warp_resphys import InputError, load, recorded_trial
from warp_resphys.studies.live_twin import LiveTwin, TwinSettings, planned_packets
from warp_resphys.studies.view import Page
from warp_resphys.twin.stream import Packet

SETTINGS = TwinSettings(horizon=0.02, patience=0.3, align=False, refine={}, noise=1e-4, planned=False, engine="full")


@pytest.fixture
def robot(finished):
    return load(finished[0])


def played(live):
    while live.step():
        pass
    return live


def test_it_follows_a_trial_as_time_goes_on(robot):
    live = LiveTwin(robot, "150 g", SETTINGS)
    trial = recorded_trial(robot, "150 g")
    assert live.words == ["Waiting for packets."]
    assert live.step()
    assert live.time == pytest.approx(robot.time_step, abs=robot.time_step)
    played(live)
    assert live.time == pytest.approx(trial.times[-1])
    assert len(live.seconds) >= len(trial.times) - 1
    off = np.linalg.norm(live.positions - trial.markers[-1], axis=1).mean()
    assert off < 2e-4
    assert any("0.02 s ahead" in line for line in live.words)
    assert not live.failure
    live.reset()
    assert live.time == 0.0


def test_it_follows_a_file(robot, folder):
    trial = recorded_trial(robot, "150 g")
    trial.play(robot).write_csv("swing.csv")
    live = played(LiveTwin(robot, "swing.csv", SETTINGS))
    assert live.time == pytest.approx(trial.times[-1])
    assert np.linalg.norm(live.positions - trial.play(robot).q[-1, 0].numpy(), axis=1).mean() < 2e-4
    with pytest.raises(InputError, match="source is 'nothing': give udp://HOST:PORT, a trial of the run"):
        LiveTwin(robot, "nothing", SETTINGS)


def test_the_commands_of_a_recording_are_its_plan():
    packets = [Packet(0.0, {}, {"pressure": [1.0]}), Packet(0.1, {}, {}), Packet(0.2, {}, {"pressure": [2.0]})]
    first, *others = planned_packets(packets)
    assert first.plan == [(0.0, {"pressure": [1.0]}), (0.2, {"pressure": [2.0]})]
    assert others == packets[1:]
    assert list(planned_packets([])) == []


def test_it_takes_packets_over_udp_and_goes_on_after_wrong_ones(robot):
    live = LiveTwin(robot, "udp://127.0.0.1:0", SETTINGS)
    host, port = live.address.removeprefix("udp://").split(":")
    rest = robot.begin().q[0].numpy()
    markers = {f"vertex_{number}": place.tolist() for number, place in enumerate(rest[:40])}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for text in ({"time": 1.0, "markers": markers}, {"time": 1.01, "inputs": {"wind": 1}}, {"time": 1.02}):
            sender.sendto(json.dumps(text).encode(), (host, int(port)))
    until_time = time.monotonic() + 20.0
    while live.time < 1.0 and time.monotonic() < until_time:
        live.step()
    for _ in range(5):
        live.step()
    assert live.time == pytest.approx(1.02)
    assert not live.failure
    assert any("there is no input 'wind'" in line for line in live.words)
    live.close()


def test_its_page_shows_the_estimate_and_what_comes(robot):
    viser = pytest.importorskip("viser")
    live = LiveTwin(robot, "150 g", SETTINGS)
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        page = Page(server, live)
        until_time = time.monotonic() + 60.0
        while "ahead" not in page._status.content and time.monotonic() < until_time:
            assert page.run(0.4) > 0.0
        assert page._scene.handles["measured body"].visible
        assert "ahead" in page._status.content
        assert len(live.seconds) > 0
    finally:
        server.stop()
