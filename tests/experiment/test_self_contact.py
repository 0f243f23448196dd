"""Contact of a body with itself and of its parts with one another, as configured."""

import pytest
import torch

from support.configured import check, composed, settings
from warp_resphys.energies.surfaces import FrictionPair, SurfaceContact
from warp_resphys.experiment.build import build_body, build_simulator
from warp_resphys.io.errors import InputError
from warp_resphys.learning.parameters import constants_of, identifiable_parameters
from warp_resphys.mesh.mesh import box_hexahedra
from warp_resphys.report.identification_section import parameter_wording
from warp_resphys.robot.description import Description
from warp_resphys.robot.robot import Robot
from warp_resphys.robot.twin.full import FullEstimator
from warp_resphys.settings.body import SimulatorSettings

BEAM = "mesh.divisions=[4,1,1]"
LOWER = "{mesh: {kind: box_hexahedra, size: [0.1, 0.03, 0.06], divisions: [4, 1, 1]}, shift: [0.0, 0.0, -0.062]}"
ABOVE = (BEAM, f"parts={{lower: {LOWER}}}", "self_contact={friction: 0.3, distance: 5e-4, stiffness: 2e4}")


def test_it_is_an_energy_of_the_body():
    assert build_body(settings(*ABOVE)).energies == (SurfaceContact(2e4, 0.3, 5e-4, 1e-3),)
    assert build_body(settings(BEAM)).energies == ()


def test_its_parameters_can_be_identified_and_have_words():
    run = settings(*ABOVE)
    simulator = build_simulator(run, run.simulation)
    assert {"surface_friction", "surface_stiffness"} <= {*identifiable_parameters(simulator)}
    given = {"surface_friction": torch.tensor([0.1, 0.7], dtype=torch.float64)}
    assert constants_of(simulator, given)["surface_friction"].tolist() == [[0.1], [0.7]]
    assert parameter_wording("surface_friction")[:2] == ("Friction between surfaces", "")


def test_friction_of_pairs_of_regions_is_configured_and_identified():
    pairs = "self_contact.pairs={pad: {first: lower, second: body, friction: 0.8}}"
    run = settings(*ABOVE, pairs)
    (contact,) = build_body(run).energies
    assert contact.pairs == {"pad": FrictionPair("lower", "body", 0.8)}
    simulator = build_simulator(run, run.simulation)
    given = {"surface_friction_pad": torch.tensor([0.5, 0.6], dtype=torch.float64)}
    assert given.keys() <= {*identifiable_parameters(simulator)}
    assert constants_of(simulator, given)["surface_friction"].tolist() == [[0.3, 0.5], [0.3, 0.6]]
    assert parameter_wording("surface_friction_pad")[0] == "Friction between surfaces, 'pad'"
    run = settings(*ABOVE, pairs.replace("body", "shell"))
    with pytest.raises(InputError, match=r"the pair 'pad' of a contact between surfaces: .*shell"):
        build_body(run)


def test_a_beam_lies_on_another_one():
    """The upper beam bends more than the thicker one below: in equilibrium its end lies on it."""
    upper = torch.arange(20 + 20) < 20
    gaps = []
    for given in (ABOVE, ABOVE[:2]):
        run = settings(*given, "integrator=bdf2")
        simulator = build_simulator(run, run.simulation)
        q, end = simulator.static_equilibrium().q[0], simulator.rest_positions[:, 0] > 0.09
        gaps.append(float(q[upper & end, 2].min() - q[~upper & end, 2].max()))
    touching, free = gaps
    assert free < -1e-3
    assert 0.0 < touching < 1e-3


def test_what_knows_nothing_of_it_refuses():
    with pytest.raises(InputError, match="reduced model, which has no contact"):
        check(composed("experiment=tendon_rod_control", "self_contact={distance: 1e-4}"))
    given = ("experiment=beam_obstacle", "~obstacles", "~laboratory.obstacles", "~contact", "~laboratory.contact")
    with pytest.raises(InputError, match=r"identify\.integrator is midpoint"):
        check(composed(*given, "identify.integrator=midpoint", "+self_contact={friction: 0.3}"))
    run = settings(BEAM, "self_contact={friction: 0.3}", "integrator=bdf2")
    mesh = box_hexahedra((0.1, 0.03, 0.03), (4, 1, 1))
    robot = Robot(Description("beam", "sysid", SimulatorSettings.of(run), run.simulation, mesh, {}))
    with pytest.raises(InputError, match="contact between surfaces"):
        FullEstimator(robot, {})
