"""The hand of the live view: a sphere that pushes a robot, and the messages of a page that move it."""

import asyncio
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from support.configured import settings
from warp_resphys.energies.contact import Contact
from warp_resphys.io.errors import InputError
from warp_resphys.mesh.mesh import box_hexahedra
from warp_resphys.robot.description import Description
from warp_resphys.robot.loading import load
from warp_resphys.robot.robot import Robot
from warp_resphys.settings.body import SimulatorSettings
from warp_resphys.studies.hand import HAND, RADIUS, with_hand
from warp_resphys.studies.live import LiveRobot
from warp_resphys.studies.view import Page

FLOOR = "obstacles={floor: {shape: half_space, position: [0, 0, -0.03], moves: true}}"


def robot(*given, **more):
    """A beam along x that is fixed at x = 0."""
    run = settings("mesh.divisions=[10,3,3]", "integrator=bdf2", *given)
    body, mesh = SimulatorSettings.of(run), box_hexahedra((0.1, 0.03, 0.03), (10, 3, 3))
    return Robot(Description("beam", "sysid", body, run.simulation, mesh, **more))


class Browser:
    """The page of a robot, with the messages that a browser would send."""

    def __init__(self, live):
        self.server, self.meshes = MagicMock(), {}
        self.server.scene.add_mesh_simple.side_effect = self._add
        self.page = Page(self.server, live)
        sphere = self.server.scene.add_icosphere
        self.sphere = sphere.return_value
        assert sphere.call_args.args == ("/hand", RADIUS)
        ((self._drag,), _) = self.sphere.on_drag.call_args
        self.checkbox = self.server.gui.add_checkbox.return_value
        self.live, self.point = live, None

    def _add(self, name, points, *_, **__):
        return self.meshes.setdefault(name, MagicMock(vertices=points))

    def tick(self, shown):
        self.page._show_hand(shown)

    def drag(self, phase, target):
        """A message of the page: the mouse is at a point, in metres of the body."""
        end = tuple(self.page._shown(np.asarray(target)).tolist())
        start = tuple(self.page._shown(self.live.hand).tolist())
        asyncio.run(self._drag(SimpleNamespace(phase=phase, start_position=start, end_position=end)))
        self.page._handle_requests()


def gap_of(live):
    """Least distance of the vertices from the sphere [m]."""
    return float(np.linalg.norm(live.positions - live.hand, axis=1).min()) - RADIUS * live.size


def test_a_message_of_the_page_moves_the_sphere_and_the_body_yields_without_penetration():
    """The hand is asked to jump down through the tip; it goes as fast as contact allows, and the beam yields."""
    live = LiveRobot(robot())
    browser = Browser(live)
    for _ in range(20):
        live.step()
    tip = np.flatnonzero(live.robot.simulator.body.mesh.vertices[:, 0] > 0.1 - 1e-9)
    before = live.positions[tip].mean(axis=0)
    browser.tick(True)
    start, least = live.hand, gap_of(live)
    assert least > 0.1 * RADIUS * live.size
    browser.drag("start", start)
    browser.drag("update", start - [0.0, 0.0, 0.03])
    for _ in range(60):
        place = live.hand
        assert live.step(), live.failure
        assert np.linalg.norm(live.hand - place) <= 1.5e-3 + 1e-12  # contact.distance: 5 % of 30 mm
        least = min(least, gap_of(live))
    assert least > 0.0
    np.testing.assert_allclose(live.hand, start - [0.0, 0.0, 0.03], atol=1e-7)
    pushed = live.positions[tip].mean(axis=0) - before
    assert pushed[2] < -0.01
    assert abs(pushed[1]) < 1e-6
    assert gap_of(live) < 1.5e-3  # It lies at the hand.
    browser.page._show()
    np.testing.assert_allclose(browser.sphere.position, browser.page._shown(live.hand))
    browser.tick(False)
    assert live.hand is None
    heights = list[float]()
    for _ in range(60):
        assert live.step()
        heights.append(float(live.positions[tip, 2].mean()))
    assert max(heights) > before[2]  # It swings back.


def test_the_sphere_touches_as_contact_says():
    """After a push, the force of the barrier points away from the sphere, and its gap is that of the vertices."""
    live = LiveRobot(robot("gravity=[0,0,0]"))
    live.show_hand()
    live.move_hand(live.hand - [0.0, 0.0, 0.02])
    for _ in range(150):
        assert live.step()
    before = live.state
    assert live.step()
    placed = live._obstacles({}, live.hand)
    acting = live.robot._commands.act(before, live.robot._read(placed, 1)).inputs
    forces = live.robot.simulator.contacts(before.body, live.state.body, acting, live.robot.constants)[""]
    total = forces.normal.sum((1, 2))[0].numpy()
    assert total[2] < -0.05
    assert abs(total[1]) < 1e-6
    assert float(forces.gap.min()) == pytest.approx(gap_of(live), abs=1e-9)


def test_a_body_with_obstacles_keeps_them_and_its_friction():
    own = robot(FLOOR, "contact={friction: {floor: 0.7}, distance: 2e-3}", parameters={"obstacle_z": 1e-3})
    touched = with_hand(own)
    (contact,) = (energy for energy in touched.simulator.body.energies if isinstance(energy, Contact))
    assert [*contact.obstacles] == ["floor", HAND]
    assert contact.constants["contact_friction"] == [0.7, 0.7]
    assert contact.distance == 2e-3
    live = LiveRobot(own)
    browser = Browser(live)
    corners = browser.meshes["/obstacles"].vertices.copy()
    live.set_input("obstacle_move_z", 0, -0.01)
    browser.tick(True)
    start = live.hand
    assert live.step()
    browser.page._show()
    np.testing.assert_allclose(live.hand, start, atol=1e-12)
    moved = browser.meshes["/obstacles"].vertices - corners  # Without the hand, as far as contact allows in a step.
    np.testing.assert_allclose(moved, np.tile([0.0, 0.0, -2e-3 / live.size], (8, 1)), atol=1e-6)
    live.reset()
    assert live.hand is None
    assert live.robot.simulator is own.simulator


def test_what_knows_no_hand_says_so_and_goes_on(finished):
    live = LiveRobot(load(finished[0], "simfree"))
    browser = Browser(live)
    browser.tick(True)
    assert live.hand is None
    assert browser.checkbox.value is False
    assert browser.page._refused.startswith("a network in the simulator's place feels no hand")
    assert live.step()
    constant = robot("solver.name=projective_dynamics")
    with pytest.raises(InputError, match="solver is projective_dynamics, whose constant matrix knows no contact"):
        with_hand(constant)
