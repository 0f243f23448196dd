"""A robot that is stepped as time goes on, its twin, by a trial,
a file or over UDP, and their page in a browser.
"""

import json
import re
import socket
import sys
import threading
import time
from contextlib import ExitStack
from urllib.request import urlopen

import numpy as np
import pytest

from support.browser import opened, until
from support.command_line import outcome, refusal, sentence
from warp_resphys import InputError, recorded_trial
from warp_resphys.robot.loading import held_out_names, load
from warp_resphys.studies.live import LiveRobot, range_of
from warp_resphys.studies.live_twin import LiveTwin, TwinSettings, planned_packets
from warp_resphys.studies.view import Page
from warp_resphys.twin.stream import Packet


@pytest.fixture
def live(finished):
    return LiveRobot(load(finished[0]))


def tip_of(live):
    mesh = live.robot.simulator.body.mesh
    return np.flatnonzero(mesh.vertices[:, 0] > mesh.vertices[:, 0].max() - 1e-9)


def test_a_trial_is_as_the_robot_plays_it(live):
    live.play_trial("150 g")
    known = live.trial.play(live.robot)
    for number in range(12):
        np.testing.assert_allclose(live.measured, live.trial.markers[number])
        assert live.step()
        np.testing.assert_allclose(live.positions, known.q[number + 1, 0], rtol=0.0, atol=1e-9)
    assert not live.step()
    assert live.time == pytest.approx(0.12)
    live.play_trial(None)
    assert live.measured is None
    assert live.time == 0.0
    with pytest.raises(InputError, match="the trial is 'none'"):
        live.play_trial("none")


def test_a_hand_pulls_the_body_to_where_it_is(live):
    tip = tip_of(live)
    start = live.positions[tip].mean(axis=0)
    target = start + [0.0, 0.02, 0.0]
    live.grab(start)
    live.drag(target)
    distances = []
    for _ in range(60):
        assert live.step()
        distances.append(np.linalg.norm(live.positions[tip].mean(axis=0) - target))
    assert distances[-1] < 0.75 * 0.02
    still = LiveRobot(live.robot)
    for _ in range(60):
        still.step()
    pulled = live.positions[tip].mean(axis=0) - still.positions[tip].mean(axis=0)
    assert pulled[1] > 0.005
    assert np.abs(pulled[[0, 2]]).max() < pulled[1]
    live.let_go()
    for _ in range(120):
        live.step()
    assert np.abs(live.positions[tip].mean(axis=0)[1] - start[1]) < 0.25 * pulled[1]


def test_a_softer_body_hangs_lower_and_comes_back(live):
    tip = tip_of(live)
    live.reset()
    stiff = live.positions[tip, 2].mean()
    quantity, value = live.parameters["youngs_modulus"]
    low, high = range_of(quantity, value)
    assert low == pytest.approx(value / np.exp(1.4))
    assert high == pytest.approx(value * np.exp(1.4))
    live.set_parameter("youngs_modulus", low)
    live.reset()
    assert live.positions[tip, 2].mean() < stiff - 1e-3
    live.restore()
    live.reset()
    np.testing.assert_allclose(live.positions[tip, 2].mean(), stiff, atol=1e-7)
    ratio = live.parameters["poissons_ratio"]
    assert ratio[0].lower < range_of(*ratio)[0] < ratio[1] < range_of(*ratio)[1] < ratio[0].upper


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (["port=70000"], "port 70000 of 127.0.0.1 cannot be used (bind(): port must be 0-65535"),
        (["trial=80 g"], "the trial is '80 g': "),
        (["model=teapot"], "teapot"),
        (["seconds=0"], "seconds is 0: "),
    ],
)
def test_what_cannot_be_viewed_is_said(finished, folder, change, said):
    assert said in sentence("view", f"run={finished[0]}", "port=0", *change)


def test_a_port_in_use_and_a_missing_package_are_said(finished, folder, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = refusal("view", f"run={finished[0]}", f"port={port}")
    assert said.startswith(
        f"error: port {port} of 127.0.0.1 cannot be used (Address already in use): choose another"
    )
    monkeypatch.setitem(sys.modules, "viser", None)
    said = refusal("view", f"run={finished[0]}", "port=0").splitlines()[-1]
    assert (
        said == "error: the viewer needs a package that is not installed: pip install "
        "'warp-resphys[view]'."
    )


def test_a_command_serves_it(finished, folder, monkeypatch):
    pytest.importorskip("viser")
    pages = []

    def show(said):
        if address := re.search(r"http://\S+", said):
            pages.append(urlopen(address[0], timeout=30).read())

    monkeypatch.setattr("warp_resphys.studies.view.show", show)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    done = outcome("view", f"run={finished[0]}", "port=0", "seconds=1", "trial=150 g")
    assert done.code == 0, done.err
    assert len(pages) == 1
    assert b"<html" in pages[0].lower()


def test_the_first_view_is_a_trial_that_nothing_was_learned_from(finished, folder, monkeypatch):
    pytest.importorskip("viser")
    played = []
    monkeypatch.setattr(LiveRobot, "play_trial", lambda self, name: played.append(name))
    for trial in ([], ["trial=hand"]):
        done = outcome("view", f"run={finished[0]}", "port=0", "seconds=0.1", *trial)
        assert done.code == 0, done.err
    assert played == [held_out_names(load(finished[0]), moving=True)[0], None]


PATIENCE = 120.0  # s, of the browser on a busy machine


@pytest.mark.slow
def test_a_browser_drives_and_pulls_it(finished):
    viser = pytest.importorskip("viser")
    webdriver = pytest.importorskip("selenium.webdriver")
    from selenium.webdriver.common.by import By

    live = LiveRobot(load(finished[0]))
    with opened() as browser, ExitStack() as stack:
        server = viser.ViserServer("127.0.0.1", 0, verbose=False)
        stack.callback(server.stop)
        page = Page(server, live)

        def look() -> None:
            try:
                browser.set_window_size(1100, 800)
                browser.get(f"http://127.0.0.1:{server.get_port()}")
                until(lambda: "pictures a second" in browser.page_source, PATIENCE)
                canvas = browser.find_element(By.CSS_SELECTOR, "canvas")
                hand = webdriver.ActionChains(browser)
                hand.move_to_element_with_offset(canvas, 0, 0).click_and_hold().move_by_offset(
                    0, -40
                )
                hand.move_by_offset(0, -60).perform()
                until(lambda: live.held is not None, PATIENCE)
                observed["pulled"] = True
                webdriver.ActionChains(browser).release().perform()
                until(lambda: live.held is None, PATIENCE)
                severe = [
                    entry["message"]
                    for entry in browser.get_log("browser")
                    if entry["level"] == "SEVERE"
                ]
                # Viser's own.
                observed["severe"] = [
                    entry for entry in severe if "passive event listener" not in entry
                ]
                browser.find_element(By.XPATH, "//button[.='Pause']").click()
                until(lambda: browser.find_elements(By.XPATH, "//button[.='Go on']"), PATIENCE)
                before, drawn = live.time, page.pictures
                until(lambda: page.pictures > drawn + 5, PATIENCE)
                observed["paused"] = live.time == before
                browser.find_element(By.XPATH, "//button[.='Reset']").click()
                until(lambda: live.time == 0.0, PATIENCE)
                observed["reset"] = True
            finally:
                page.stop()

        observed = {}
        thread = threading.Thread(target=look)
        thread.start()
        # In this thread, as from the command line, until the other one has seen everything.
        page.run(None)
        thread.join()
    assert observed == {"pulled": True, "severe": [], "paused": True, "reset": True}


SETTINGS = TwinSettings(
    horizon=0.02, patience=0.3, align=False, refine={}, noise=1e-4, planned=False, engine="full"
)


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
    with pytest.raises(
        InputError, match="source is 'nothing': give udp://HOST:PORT, a trial of the run"
    ):
        LiveTwin(robot, "nothing", SETTINGS)


def test_the_commands_of_a_recording_are_its_plan():
    packets = [
        Packet(0.0, {}, {"pressure": [1.0]}),
        Packet(0.1, {}, {}),
        Packet(0.2, {}, {"pressure": [2.0]}),
    ]
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
        for text in (
            {"time": 1.0, "markers": markers},
            {"time": 1.01, "inputs": {"wind": 1}},
            {"time": 1.02},
        ):
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
