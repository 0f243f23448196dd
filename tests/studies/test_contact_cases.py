"""Cases of contact that must not cross: they touch and pass with contact, and cross without; a house of cards."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from warp_resphys.energies.launcher import Launcher
from warp_resphys.energies.pairs import PairList, Surface
from warp_resphys.mesh.mesh import check_mesh
from warp_resphys.mesh.quality import cell_volumes
from warp_resphys.studies import contact_cases
from warp_resphys.studies.contact_cases import CardHouse, card_drop, cases, check_case, run_case

CPU = torch.device("cpu")
CASES = cases()


@pytest.mark.parametrize("name", [name for name in CASES if name not in ("mat", "rollers", "tentacle")])
def test_surfaces_cross_without_contact_alone(name):
    """A case passes; without contact its surfaces cross."""
    case = replace(CASES[name], steps=min(CASES[name].steps, 40))
    check = check_case(name, case, CPU)
    assert check.passed, check
    assert "touches" in check.expected
    free = run_case(replace(case, contact=None), CPU)
    assert free.crossings > 0 == free.failed


def test_rollers_draw_by_friction_alone():
    """The block passes where friction exceeds the slope at which its edges meet the rollers, and not with less.

    The middles of the rollers are 21 mm from that of the block, which is 16 mm high, and their radius is 15 mm.
    """
    case, slope = CASES["rollers"], math.tan(math.acos((21.0 - 8.0) / 15.0))
    for friction, draws in ((1.15 * slope, True), (0.85 * slope, False)):
        check = check_case("rollers", replace(case, contact=replace(case.contact, friction=friction)), CPU)
        assert "0 crossings" in check.result
        assert "0 failed" in check.result
        assert check.passed == draws, check


def test_a_mat_is_turned_until_it_touches_itself():
    case = CASES["mat"]
    end = case.inputs(case.simulator(CPU)).fixed_positions[-1, 0].numpy()
    far = end[:, 0] > 0.05
    assert np.ptp(end[far], 0)[0] == np.ptp(end[~far], 0)[0] == 0.0  # Both ends stay plane.
    assert end[far, 0].min() - end[~far, 0].max() == pytest.approx(0.07)
    short = replace(case, steps=24, time_step=0.1)
    assert check_case("mat", short, CPU).passed
    assert not check_case("free", replace(short, contact=None), CPU).passed


def test_a_tentacle_curls_around_its_post_and_onto_itself():
    """Its axis makes a whole turn around the post, and parts that are far from one another at rest are within reach."""
    case = CASES["tentacle"]
    body = case.bodies["tentacle"]
    post, rest = body.energies[1].obstacles["post"], body.mesh.vertices
    out = run_case(case, CPU)
    assert (out.crossings, out.failed) == (0, 0)
    levels = rest[:, 2].round(6)
    axis = np.stack([out.end[levels == z].mean(0) for z in np.unique(levels)])[:, [0, 2]] - [0.04, -0.09]
    assert np.linalg.norm(axis, axis=1).min() > post.radius
    assert np.ptp(np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]))) > 2.0 * math.pi
    pairs, end = PairList(Launcher(1, CPU), Surface.of(body.mesh), case.distance), torch.from_numpy(out.end)[None]
    pairs.find(end, torch.zeros_like(end))
    first, second = rest[pairs.nodes[:, 0], 2], rest[pairs.nodes[:, 3], 2]
    assert pairs.distances(end).numpy()[np.abs(first - second) > 0.1].min() < case.distance
    assert run_case(replace(case, contact=None), CPU).crossings > 0


def test_an_error_is_a_failed_check():
    lower = CASES["spikes"].bodies["lower"]
    check = check_case("twice", replace(CASES["spikes"], bodies={"lower": lower, "upper": lower}), CPU)
    assert not check.passed
    assert "at rest" in check.result


def test_both_programs_find_the_same_crossings(monkeypatch):
    """Two spikes pushed through one another step by step, by ipctk and by the project's own search."""
    pytest.importorskip("ipctk", reason="compares with ipctk: pip install 'warp-resphys[test]'")
    case = replace(CASES["spikes"], contact=None)
    s = case.simulator(CPU)
    surface = Surface.of(s.body.mesh)
    positions = s.rest_positions.expand(20, -1, -1).clone()
    upper = s.body.vertex_slice("upper")
    positions[:, upper, :2] += torch.tensor([0.003, 0.001], dtype=torch.float64)
    positions[:, upper, 2] -= torch.linspace(0.0, 0.1, 20, dtype=torch.float64)[:, None]
    pairs = PairList(Launcher(1, CPU), surface, 1e-4)
    theirs = contact_cases.crossing_steps(surface, positions, pairs)
    monkeypatch.setattr(contact_cases, "find_spec", lambda _: None)
    ours = contact_cases.crossing_steps(surface, positions, pairs)
    assert theirs[1] == "ipctk" != ours[1]
    assert 0 < theirs[0] == ours[0] < 20


def test_meshes_are_whole():
    """Cells are upright, and those that are cut from a box or a prism have the volume that is left."""
    for case in CASES.values():
        for body in case.bodies.values():
            check_mesh(body.mesh)
    volume = {n: float(cell_volumes(CASES[n].bodies["lower"].mesh).sum()) for n in ("spike in hole", "wedge in crack")}
    assert volume["spike in hole"] == pytest.approx(0.2 * 0.2 * 0.1 - 0.2 * 0.2 * 0.06 / 3.0)
    assert volume["wedge in crack"] == pytest.approx(0.2 * 0.2 * 0.1 - 0.2 * 0.12 * 0.06 / 2.0)


@pytest.mark.parametrize("degrees", [15.0, 35.0])
def test_the_friction_of_cards_balances_moments(degrees):
    """About the edge on which a card stands, with its weight in its middle and the other card's force at its top."""
    house = CardHouse(math.radians(degrees), 1)
    scene = house.scene(0.3)
    x = scene.vertices[scene.vertex_slice("card0")]
    foot, top, middle = x[x[:, 2].argmin()], x[x[:, 0].argmax()], x.mean(0)
    assert top[0] < 0.0  # The other card begins at the plane x = 0.
    need = (middle[0] - foot[0]) / (top[2] - foot[2])
    assert house.least_friction == pytest.approx(need, rel=1e-6)
    stands, falls = (card_drop(house.scene(share * need), CPU) for share in (1.05, 0.95))
    assert stands < 1e-3 < 1e-2 < falls


def test_a_second_storey_needs_more_friction():
    """A house of two storeys stands with 5 % more friction than statics asks, and falls with 5 % less."""
    one, two = (CardHouse(math.radians(25.0), storeys) for storeys in (1, 2))
    assert len(two.cards) == 7
    need = two.least_friction
    assert need > 1.2 * one.least_friction
    stands, falls = (card_drop(two.scene(share * need), CPU) for share in (1.05, 0.95))
    assert stands < 1e-3 < 1e-2 < falls
