"""Force sensors: readings in their axes, errors without zero and drift,
and parameters that they identify.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.clamped import clamped
from support.refusals import refuses
from warp_resphys import (
    Body,
    Contact,
    Corotated,
    ForceSensor,
    HalfSpace,
    Inputs,
    Simulator,
    State,
    SymmetryPlane,
    bind_markers,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.stepping.state import Reaction
from warp_resphys.data.markers import MarkerMap
from warp_resphys.io.errors import InputError
from warp_resphys.learning import (
    ObservedMotions,
    evaluate,
    fit_force,
    identify,
    identify_law,
    reconstruct,
)
from warp_resphys.learning.residuals.in_the_loop import MotionLoss, TrialGroup
from warp_resphys.learning.residuals.reconstruction_problems import (
    MarkerForceProblem,
    MarkerPositionProblem,
)
from warp_resphys.learning.sensing import loads_at_steps, readings
from warp_resphys.settings.learning import ReconstructionSettings, ReleaseSettings

BAR = box_hexahedra(size=(0.02, 0.02, 0.06), divisions=(2, 2, 4))
TRUE = {"youngs_modulus": 80e3}
RANGES = {"youngs_modulus": (30e3, 300e3)}


def double(values):
    return torch.tensor(values, dtype=torch.float64)


def test_a_reading_is_in_the_axes_of_the_sensor_about_its_origin():
    reaction = Reaction(
        torch.tensor([4, 7]),
        double([[[0.0, 0.0, 3.0], [0.0, 0.0, 1.0]]]),
        double([[[0.1, 0, 0], [0.2, 0, 0]]]),
    )
    turned = ForceSensor(
        moment_noise=1e-3, origin=(0.1, 0.0, 0.0), rotation=(math.pi / 2, 0.0, 0.0)
    )
    # Its y axis is the body's z axis; the moment of 1 N at 0.1 m about the origin is -0.1 N m about
    # y, its -z axis.
    torch.testing.assert_close(
        turned(reaction), double([[0.0, -4.0, 0.0, 0.0, 0.0, -0.1]]), rtol=0, atol=1e-14
    )
    torch.testing.assert_close(replace(turned, on_body=True)(reaction), -turned(reaction))


def test_a_sensor_moves_with_the_vertices_that_it_holds():
    rest = double(np.random.default_rng(0).normal(size=(5, 3)))
    angle = 0.7
    turn = double(
        [
            [math.cos(angle), -math.sin(angle), 0.0],
            [math.sin(angle), math.cos(angle), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    forces = double(np.random.default_rng(1).normal(size=(1, 5, 3)))
    shift = double([0.3, -0.2, 0.1])
    sensor = ForceSensor(moment_noise=1e-3, origin=(0.2, 0.1, 0.0), rotation=(0.1, 0.4, -0.2))
    still = sensor(Reaction(torch.arange(5), forces, rest[None]), rest)
    moved = sensor(Reaction(torch.arange(5), forces @ turn.T, (rest @ turn.T + shift)[None]), rest)
    torch.testing.assert_close(moved, still, rtol=1e-12, atol=1e-12)


def test_errors_have_the_inverse_covariance_of_noise_zero_and_drift():
    sensor = ForceSensor(axes=("fz",), noise=0.02, zero=30.0, drift=5.0)
    times = double([[0.0, 0.1, 0.2, 0.5, 0.9]])
    random = np.random.default_rng(2)
    predicted, measured = (double(random.normal(size=shape)) for shape in ((2, 1, 5, 6), (1, 5, 6)))
    measured[0, 2, 2] = math.nan
    errors = sensor.errors(predicted, measured, times)
    assert (
        float(errors[..., [0, 1, 3, 4, 5]].abs().max()) == float(errors[:, :, 2].abs().max()) == 0.0
    )
    seen = [0, 1, 3, 4]
    t, e = times[0, seen].numpy(), (predicted[0, 0, seen, 2] - measured[0, seen, 2]).numpy()
    covariance = 0.02**2 * (np.eye(4) + 30.0**2 * np.ones((4, 4)) + 5.0**2 * np.outer(t, t))
    assert float(errors[0, 0].square().sum()) == pytest.approx(
        e @ np.linalg.solve(covariance, e), rel=1e-9
    )
    plain = replace(sensor, zero=0.0, drift=0.0).errors(predicted, measured, times)
    np.testing.assert_allclose(plain[0, 0, seen, 2], e / 0.02, rtol=1e-12)


def stretched(modulus=TRUE["youngs_modulus"], **options):
    """A bar in a testing machine, and the motion of its upper grip by 6 mm and back."""
    ends = np.concatenate([select_vertices(BAR, z=0.0), select_vertices(BAR, z=0.06)])
    simulator = Simulator(
        Body(BAR, np.sort(ends)),
        Corotated(modulus, 0.45),
        time_step=0.05,
        gravity=(0, 0, 0),
        **options,
    )
    way = 6e-3 * torch.sin(torch.linspace(0.0, math.pi, 13).double())[1:]
    held = simulator.rest_positions[simulator.fixed].expand(12, 1, -1, -1).clone()
    held[..., 2] += way[:, None, None] * (held[..., 2] > 0.03)
    return simulator, Inputs(fixed_positions=held)


def measured(simulator, inputs, noise=0.0, zero=0.0, seed=0):
    """Readings (T, 6) of the pull at the upper grip, with an own zero."""
    start = simulator.static_equilibrium()
    motion = simulator.rollout(start, 12, inputs)
    upper = select_vertices(BAR, z=0.06)
    pull = [
        simulator.reaction(start, upper).force[0, 2],
        *simulator.reaction(motion, upper).force[:, 0, 2],
    ]
    readings = np.full((13, 6), np.nan)
    readings[:, 2] = (
        [float(force) for force in pull]
        + noise * np.random.default_rng(seed).normal(size=13)
        + zero
    )
    return readings


def test_stiffness_is_identified_from_force_and_way_alone():
    simulator, inputs = stretched(relative_tolerance=1e-10)
    sensor = ForceSensor(
        at=tuple(select_vertices(BAR, z=0.06)), axes=("fz",), noise=0.01, on_body=True
    )
    readings = measured(simulator, inputs, noise=0.01)
    largest = np.nanmax(readings)
    guess, _ = stretched(150e3)
    motions = ObservedMotions.of(
        guess, None, inputs=inputs, sensors={"load": sensor}, loads={"load": readings}
    )
    found = identify(guess, motions, RANGES)
    assert (
        abs(found.parameters["youngs_modulus"] / TRUE["youngs_modulus"] - 1.0) < 3 * 0.01 / largest
    )
    shifted = replace(motions.trials, loads={"load": readings[None] + 0.3})
    zeroed = {"load": replace(sensor, zero=1e3)}
    again = identify(guess, replace(motions, trials=shifted, sensors=zeroed), RANGES)
    assert (
        abs(again.parameters["youngs_modulus"] / TRUE["youngs_modulus"] - 1.0) < 6 * 0.01 / largest
    )


def pressing(integrator):
    """A beam that falls on a plate at its tip, sensed at its clamp and by the plate."""
    mesh = box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(6, 2, 2))
    contact = Contact(
        {"plate": HalfSpace(position=(0.0, 0.0, -0.004))}, stiffness=2e3, friction=0.3
    )
    simulator = Simulator(
        clamped(mesh, energies=[contact]),
        Corotated(80e3, 0.45),
        time_step=0.01,
        integrator=integrator,
        relative_tolerance=1e-12,
    )
    sensors = {
        "base": ForceSensor(moment_noise=1e-3, origin=(0.0, 0.01, 0.01)),
        "load": ForceSensor("plate", ("fx", "fz")),
    }
    return simulator, sensors


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_readings_of_nearby_parameters_are_right_to_first_order(integrator):
    simulator, sensors = pressing(integrator)
    loads = {name: np.zeros((26, 6)) for name in sensors}
    motions = ObservedMotions.of(
        simulator, None, simulator.rest_state(), sensors=sensors, loads=loads
    )
    ((replay, start),) = motions.replays(simulator)
    size, whole = 1e-6, {"youngs_modulus": double([80e3, 80e3 * (1 + 1e-6)])}
    near, exact = replay.varied(start, whole)[1], replay.sensed(start, whole)[1]
    assert bool(near[:, :, 0].isnan().all())  # no step led to the initial state
    near, exact = near[:, 0, 1:], exact[:, 0, 1:]
    torch.testing.assert_close(near[0], exact[0], rtol=1e-9, atol=1e-12)
    slopes = [(x[1] - x[0]) / size for x in (near, exact)]
    assert float(exact[0, :, 1, 2].min()) < -0.05  # the plate is pressed down
    torch.testing.assert_close(*slopes, rtol=1e-3, atol=1e-3 * float(slopes[1].abs().max()))


@pytest.fixture(scope="module")
def pushed():
    """A beam that a force on its middle bends, which its simulator lacks.

    One marker, and a sensor at its clamp.
    """
    mesh = box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(5, 1, 1))
    simulator = Simulator(
        clamped(mesh), Corotated(150e3, 0.45, stiffness_damping=0.01), time_step=0.01
    )
    start, force = simulator.static_equilibrium(), torch.zeros(8, 1, len(mesh.vertices), 3).double()
    force[:, :, select_vertices(mesh, x=0.04), 1] = (
        0.05 * torch.linspace(0.2, 1.0, 8).double()[:, None, None]
    )
    motion = simulator.rollout(start, 8, Inputs(external_force=force))
    clamp = ForceSensor(axes=("fx", "fy", "fz"), noise=1e-3)
    read = [clamp(simulator.reaction(start)), *(clamp(one) for one in reactions(motion))]
    marker = bind_markers(mesh, [[0.1, 0.01, 0.02]], ["tip"])
    seen = torch.stack([marker(q) for q in motion.q])
    return simulator, start, force, marker, seen, clamp, torch.stack(read)


def reactions(motion):
    held = motion.reaction
    return [Reaction(held.vertices, f, p) for f, p in zip(held.forces, held.places, strict=True)]


@pytest.mark.parametrize("method", ["gauss_newton", "levenberg_marquardt", "lbfgsb"])
def test_reconstructed_forces_agree_with_the_sensor_at_the_clamp(pushed, method):
    simulator, start, force, marker, seen, clamp, read = pushed
    settings = ReconstructionSettings(
        method=method, regularisation=1e-8, max_iterations=200, tolerance=1e-9
    )
    given = {
        "start": State(start.q, start.v),
        "observation": marker,
        "release": ReleaseSettings(noise=1e-4),
    }
    blind = ObservedMotions.of(simulator, seen, **given)
    sensing = ObservedMotions.of(
        simulator, seen, **given, sensors={"clamp": clamp}, loads={"clamp": read}
    )
    errors, wanted = [], force.sum(2)[:, 0]
    for motions in (blind, sensing):
        (forces,) = reconstruct(simulator, motions, settings=settings, acts="external").of(
            ["motion 0"], "force"
        )
        errors.append(
            float((torch.from_numpy(forces[0, 1:]).double().sum(1) - wanted).norm() / wanted.norm())
        )
    assert errors[1] < 0.03 < 0.3 < errors[0]


def test_errors_of_readings_are_those_of_the_force(pushed):
    simulator, start, force, marker, seen, clamp, read = pushed
    given = {"start": State(start.q, start.v), "observation": marker, "sensors": {"clamp": clamp}}
    shifted = read + torch.tensor([0.0, 0.0, 0.03, 0.0, 0.0, 0.0])
    motions = ObservedMotions.of(simulator, seen, **given, loads={"clamp": shifted})
    away = evaluate(simulator, motions, lambda state, k: force[k], sensor="clamp")
    assert math.isnan(away[0, 0])  # no step led to the given state
    np.testing.assert_allclose(away[1:, 0], 0.03, rtol=1e-6)
    zeroed = replace(motions, sensors={"clamp": replace(clamp, zero=1e4)})
    assert np.nanmax(evaluate(simulator, zeroed, lambda state, k: force[k], sensor="clamp")) < 1e-4
    assert evaluate(simulator, motions, lambda state, k: force[k])[1:].max() < 1e-9
    refuses(InputError, "no force sensor 'lid'", evaluate, simulator, motions, sensor="lid")


def test_the_loss_of_training_through_the_simulator_has_readings(pushed):
    simulator, start, _, marker, seen, clamp, read = pushed
    given = {
        "start": State(start.q, start.v),
        "observation": marker,
        "release": ReleaseSettings(noise=1e-4),
    }
    losses = []
    for more in ({}, {"sensors": {"clamp": clamp}, "loads": {"clamp": read}}):
        motions = ObservedMotions.of(simulator, seen, **given, **more)
        ((replay, begin),) = motions.replays(simulator)
        losses.append(float(MotionLoss([TrialGroup(replay, begin)], {})(None)))
    points, loads = replay.sensed(begin)
    squares = (
        replay.errors(points).square().sum()
        + (1e-4 * (loads[0, 0, 1:, 0] - read[1:, 0])[:, :3] / 1e-3).square().sum()
    )
    moved = (seen[:, :, 0] - seen[:1, :, 0]).square().sum()
    pushed_by = moved + (1e-4 * read[:, 0, :3] / 1e-3).square().sum()
    assert losses[1] == pytest.approx(float(squares / pushed_by), rel=1e-9)
    assert losses[0] == pytest.approx(float(replay.errors(points).square().sum() / moved), rel=1e-9)


@pytest.mark.parametrize("method", ["gauss_newton", "levenberg_marquardt"])
def test_internal_forces_leave_the_sensor_its_true_loads(pushed, method):
    """Forces that are found as internal ones explain marker and readings when they act so.

    External ones do not.
    """
    simulator, start, force, marker, *_, clamp, _ = pushed
    motion = simulator.rollout(start, 8, Inputs(internal_force=force))
    read = torch.stack(
        [clamp(simulator.reaction(start)), *(clamp(one) for one in reactions(motion))]
    )
    seen = torch.stack([marker(q) for q in motion.q])
    settings = ReconstructionSettings(
        method=method, regularisation=1e-8, max_iterations=200, tolerance=1e-9
    )
    given = {"observation": marker, "release": ReleaseSettings(noise=1e-4)}
    motions = ObservedMotions.of(
        simulator, seen, **given, sensors={"clamp": clamp}, loads={"clamp": read}
    )
    errors = []
    for acts in ("internal", "external"):
        (forces,) = reconstruct(simulator, motions, settings=settings, acts=acts).of(
            ["motion 0"], "force"
        )
        again = simulator.rollout(
            start, 8, Inputs(internal_force=torch.from_numpy(forces[0, 1:, None]).double())
        )
        assert float((marker(again.q[-1]) - seen[-1]).norm()) < 1e-6
        felt = torch.stack([clamp(one) for one in reactions(again)])
        errors.append(float((felt - read[1:])[..., :3].norm()))
    assert errors[0] < 1e-5 < 1e-2 < errors[1]


@pytest.mark.parametrize(
    ("integrator", "problem", "acts"),
    [
        ("implicit_euler", MarkerPositionProblem, "internal"),
        ("implicit_euler", MarkerForceProblem, "external"),
        ("bdf2", MarkerPositionProblem, "external"),
        ("bdf2", MarkerForceProblem, "internal"),
    ],
)
def test_derivatives_of_readings_in_a_step(integrator, problem, acts):
    """By positions of the stage, times the fraction of the step where it stands.

    With friction on a plate.
    """
    simulator, sensors = pressing(integrator)
    before = after = simulator.rest_state()
    for _ in range(18):
        before, after = after, simulator.step(after)
    reader, constants = replace(simulator), simulator.prepare()

    def read(state):
        return readings(
            reader, tuple(sensors.values()), state, before, Inputs(), constants
        ).flatten(1)

    corner = MarkerMap.at_vertices(torch.tensor([[3]]))
    made = problem(
        simulator, constants, before, Inputs(), before.q[:, [3]], 1e-6, corner, read=read, acts=acts
    )
    step, x = made.without_force(), simulator.method.solution_for(before, after.q)
    jacobian = made.transposed_jacobian(step, x)[0].T / step.stage.end
    way = torch.from_numpy(np.random.default_rng(3).normal(size=x.shape)) * 1e-9
    way[:, simulator.fixed] = 0.0
    ends = [read(made.without_force().reached(x + sign * way, acts)) for sign in (1.0, -1.0)]
    expected, found = (ends[0] - ends[1])[0] / 2.0, (jacobian @ way.flatten())[3:]
    assert float(expected[8].abs()) > 0.0  # the plate feels it
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))


def test_a_zero_is_that_of_the_first_reading_or_refused_in_a_reconstruction(pushed):
    simulator, start, force, marker, seen, clamp, read = pushed
    settings = ReconstructionSettings(method="gauss_newton", regularisation=1e-8)
    given = {
        "observation": marker,
        "release": ReleaseSettings(noise=1e-4),
        "loads": {"clamp": read + 0.05},
    }
    given["sensors"] = {"clamp": replace(clamp, zero=50.0)}
    motions = ObservedMotions.of(simulator, seen, **given)
    found = reconstruct(simulator, motions, settings=settings, acts="external")
    (forces,), wanted = found.of(["motion 0"], "force"), force.sum(2)[:, 0]
    away = torch.from_numpy(forces[0, 1:]).double().sum(1) - wanted
    assert float(away.norm() / wanted.norm()) < 0.03
    begun = ObservedMotions.of(simulator, seen, State(start.q, start.v), **given)
    said = "subtract it from the readings, and set zero to 0"
    refuses(InputError, said, reconstruct, simulator, begun, settings=settings)


def test_readings_at_steps_have_the_gaps_of_the_recording():
    simulator, inputs = stretched()
    sensor = ForceSensor(at=tuple(select_vertices(BAR, z=0.06)), axes=("fz",), on_body=True)
    loads = np.full((13, 6), np.nan)
    loads[[0, 1, 2, 8, 12], 2] = [0.0, 1.0, 2.0, 8.0, 12.0]
    motions = ObservedMotions.of(
        simulator, None, inputs=inputs, sensors={"load": sensor}, loads={"load": loads}
    )
    ((replay, _),) = motions.replays(simulator)
    read = loads_at_steps(replay.trials, 0.025, double([0.01]), 26)[0, :, 0, 2].numpy()
    at = 0.025 * np.arange(26) + 0.01  # of the recording [s]
    near = np.abs(at[:, None] - 0.05 * np.array([0, 1, 2, 8, 12])).min(1) <= 0.075
    inside = near & (at <= 0.6)
    np.testing.assert_allclose(read[inside], at[inside] / 0.05)
    assert np.isnan(read[~inside]).all()


def test_forces_alone_identify_and_reconstruct_and_what_needs_points_says_so():
    simulator, inputs = stretched(relative_tolerance=1e-10)
    sensor = ForceSensor(
        at=tuple(select_vertices(BAR, z=0.06)), axes=("fz",), noise=0.01, on_body=True
    )
    given = {
        "inputs": inputs,
        "sensors": {"load": sensor},
        "loads": {"load": measured(simulator, inputs)},
    }
    motions = ObservedMotions.of(simulator, None, **given)
    settings = ReconstructionSettings(method="gauss_newton", regularisation=1e-6)
    found = reconstruct(simulator, motions, settings=settings)
    # The simulator has the force.
    assert float(np.abs(found.of(["motion 0"], "force")[0]).max()) < 1e-6
    refuses(InputError, "a force is tested on points", fit_force, simulator, motions, found)
    refuses(InputError, "a law is tested on points", identify_law, simulator, motions)
    refuses(
        InputError,
        "forces alone are observed: name one of the sensors",
        evaluate,
        simulator,
        motions,
    )
    whole = ObservedMotions.of(
        simulator, simulator.rollout(simulator.static_equilibrium(), 12, inputs).q, **given
    )
    refuses(
        InputError, "positions of all vertices determine the forces", reconstruct, simulator, whole
    )


def test_a_density_is_identified_from_its_weight_in_single_precision():
    ends, mass = select_vertices(BAR, z=0.06), torch.zeros(2, len(BAR.vertices))
    mass[1, select_vertices(BAR, z=0.0)] = 0.001
    simulator = Simulator(Body(BAR, ends), Corotated(density=1070.0), dtype=torch.float32)
    hung = Inputs(attached_mass=mass)
    clamp = ForceSensor(axes=("fz",), noise=1e-3)
    read = clamp(simulator.reaction(simulator.static_equilibrium(hung)))[None].repeat(2, 1, 1)
    given = {"inputs": hung, "resting": hung, "sensors": {"clamp": clamp}, "loads": {"clamp": read}}
    guess = replace(simulator, material=Corotated(density=1500.0))
    found = identify(
        guess, ObservedMotions.of(simulator, None, **given), {"density": (800.0, 2000.0)}
    )
    assert found.parameters["density"] == pytest.approx(1070.0, rel=1e-3)


def test_what_has_diverged_is_infinite_and_what_is_not_known_is_missing():
    sensor, times = ForceSensor(axes=("fz",)), double([[0.0, 0.1, 0.2]])
    read, predicted = torch.ones(1, 3, 6).double(), torch.ones(1, 3, 6).double()
    predicted[0, 0], predicted[0, 2] = math.nan, math.inf
    away = sensor.distances(predicted, read, times)[0]
    assert away[0].isnan()
    assert away[1:].tolist() == [0.0, math.inf]


def test_a_sensor_at_an_edge_moves_without_a_turn_and_planes_are_refused():
    line = double([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.2, 0.0]])
    reaction = Reaction(torch.arange(3), double([[[0.0, 0.0, 1.0]] * 3]), line[None] + 0.5)
    read = ForceSensor(moment_noise=1.0)(reaction, line)
    torch.testing.assert_close(read, double([[0.0, 0.0, -3.0, -0.3, 0.0, 0.0]]), rtol=0, atol=1e-12)
    half = Body(BAR, select_vertices(BAR, z=0.0), symmetry=[SymmetryPlane((1.0, 0.0, 0.0))])
    simulator = Simulator(half, Corotated())
    given = {"sensors": {"load": ForceSensor(axes=("fz",))}, "loads": {"load": np.ones((3, 6))}}
    refuses(
        InputError,
        "symmetry planes cut it",
        identify,
        simulator,
        ObservedMotions.of(simulator, None, **given),
        RANGES,
    )


def test_bad_sensors_and_readings_are_refused():
    simulator, _ = pressing("bdf2")
    given = {"start": simulator.rest_state(), "sensors": {"load": ForceSensor("lid", ("fz",))}}
    motions = ObservedMotions.of(simulator, None, loads={"load": np.ones((3, 6))}, **given)
    refuses(InputError, "no region 'lid'", identify, simulator, motions, RANGES)
    refuses(
        InputError,
        "force sensors are .load.",
        replace,
        motions,
        trials=replace(motions.trials, loads={}),
    )
    few = {"load": np.zeros((3, 2))}
    refuses(
        InputError, "'load' have shape", ObservedMotions.of, simulator, None, loads=few, **given
    )
    refuses(InputError, "moment_noise", ForceSensor, axes=("tx",))
    refuses(InputError, "axis 'fw'", ForceSensor, axes=("fw",))
    refuses(InputError, "no axes", ForceSensor, axes=())
    refuses(InputError, "noise of a force sensor is 0.0", ForceSensor, axes=("fx",), noise=0.0)
    refuses(
        InputError,
        "zero of a force sensor is -1.0: it must be zero or more",
        ForceSensor,
        axes=("fx",),
        zero=-1.0,
    )
    refuses(InputError, "axes of a force sensor is 'fz': give a tuple", ForceSensor, axes="fz")
    free = {"start": simulator.rest_state(), "loads": {"load": np.ones((3, 6))}}
    tip = ObservedMotions.of(simulator, None, sensors={"load": ForceSensor((62,), ("fz",))}, **free)
    said = "a force sensor: there is no reaction at some of these vertices"
    refuses(InputError, said, identify, simulator, tip, RANGES)
