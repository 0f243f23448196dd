"""Misplaced markers, rotated recordings, and priors of parameters."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from support.refusals import refuses
from support.regions import beam
from support.slopes import differences
from support.swinging_beam import double, simulated
from warp_resphys import (
    Body,
    Corotated,
    InputError,
    Inputs,
    Rigid,
    Simulator,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.stepping.rotations import twisted
from warp_resphys.data.markers import KINDS, MarkerMap, bind_markers, follow_vertices
from warp_resphys.data.rigid_bodies import angles, arms
from warp_resphys.learning import Bounds, Prior, search_parameters
from warp_resphys.learning.identification.misfit import Misfit
from warp_resphys.learning.identification.nuisances import NuisanceFit
from warp_resphys.learning.placement import Accuracy, DisplacedMarkers, PlacedMarkers, Placement
from warp_resphys.learning.replay import Replay
from warp_resphys.learning.start import Start
from warp_resphys.learning.trial_batch import TrialBatch

MESH = box_hexahedra((0.1, 0.03, 0.03), (5, 2, 2))
REST = torch.as_tensor(MESH.vertices)
TIP = select_vertices(MESH, x=0.1)
PLACES = np.array(
    [[0.1, 0.015, 0.036], [0.1, -0.006, 0.024], [0.07, 0.0277, 0.011], [0.05, 0.015, 0.034]]
)
LABELS = ("a", "b", "c", "d")
MOVED = torch.tensor(
    [[2e-3, -1e-3, 5e-4], [0.0, 2e-3, 1e-3], [-1e-3, 0.0, 0.0], [1e-3, 1e-3, 1e-3]]
).double()
CENTRE = torch.tensor([0.01, 0.0, 0.02]).double()
ASKEW = Placement(
    MOVED,
    torch.tensor([1e-3, -2e-3, 5e-4]).double(),
    torch.tensor([0.02, -0.01, 0.03]).double(),
    CENTRE,
)
MIXED = ["patch", "rigid", "frame", "patch"]


def bind(kind="patch", places=PLACES):
    return bind_markers(MESH, places, LABELS, kind=kind, vertices=TIP, patch=0.025)


def poses():
    """(3, N, 3) at rest, twisted and turned, and stretched."""
    turn = torch.as_tensor(Rotation.from_rotvec([0.4, -1.0, 0.6]).as_matrix())
    return torch.stack([REST, twisted(REST, REST.new_tensor([1.5]))[0] @ turn.T, 1.1 * REST])


@pytest.mark.parametrize("kind", [*KINDS, MIXED], ids=[*KINDS, "mixed"])
def test_moved_markers_are_at_their_offsets_and_rotate_with_their_stems(kind):
    markers = bind(kind)
    np.testing.assert_allclose(
        markers.moved(MOVED)(REST[None])[0], torch.as_tensor(PLACES) + MOVED, atol=1e-12
    )
    q = poses()
    turns = torch.stack(
        [markers.moved(axis.expand(4, 3))(q) - markers(q) for axis in torch.eye(3).double()], -1
    )
    np.testing.assert_allclose(
        turns.mT @ turns, torch.eye(3).double().expand(3, 4, 3, 3), atol=1e-9
    )
    at, result = DisplacedMarkers.split(DisplacedMarkers(markers, 4)(q))
    np.testing.assert_allclose(result, turns, atol=1e-12)
    moved = at + (result @ MOVED[..., None])[..., 0]
    np.testing.assert_allclose(markers.moved(MOVED)(q), moved, atol=1e-12)


def test_a_placement_rotates_about_its_centre_and_placed_markers_have_derivatives():
    points = torch.as_tensor(PLACES)
    turn = torch.as_tensor(Rotation.from_rotvec(ASKEW.turn.numpy()).as_matrix())
    np.testing.assert_allclose(
        ASKEW.apply(points), (points - CENTRE) @ turn.T + CENTRE + ASKEW.shift, atol=1e-15
    )
    still = replace(ASKEW, turn=torch.zeros(3).double())
    np.testing.assert_allclose(still.apply(points), points + ASKEW.shift, atol=1e-15)
    again = Placement.from_plain(ASKEW.plain(LABELS), LABELS)
    torch.testing.assert_close(again.apply(points), ASKEW.apply(points))
    markers, q, step = PlacedMarkers.of(bind(MIXED), ASKEW), poses(), 1e-6
    direction = torch.randn(q.shape, generator=torch.Generator().manual_seed(0), dtype=q.dtype)
    expected = (markers(q + step * direction) - markers(q - step * direction)) / (2.0 * step)
    result = (markers.transposed_jacobian(q).mT @ direction.flatten(1)[:, :, None]).view_as(
        expected
    )
    np.testing.assert_allclose(result, expected, atol=2e-6)
    single = markers.to(torch.zeros(1))(q.float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single, markers(q), atol=1e-6)


def test_the_placement_minimises_its_sum_of_squares():
    """With nonlinear rotations by degrees; quantities that are known exactly stay."""
    draw = torch.Generator().manual_seed(1)
    errors = [1e-2 * torch.randn(2, 3, 4, 3, generator=draw, dtype=torch.float64)]
    at, turns = (
        x[None].expand(2, -1, *[-1] * (x.ndim - 1))
        for x in DisplacedMarkers.split(DisplacedMarkers(bind(), 4)(poses()))
    )
    seen = [torch.rand(2, 3, 4, generator=draw) > 0.3]
    errors[0] = torch.where(seen[0][..., None], errors[0], 0.0)
    weights = [torch.tensor([3.0, 5.0]).double()]
    accuracy = Accuracy(1e-3, 2e-3, 0.1, centre=CENTRE)

    def loss(b):
        moved = at + (turns @ b[:12].view(4, 3)[..., None])[..., 0]
        shown = Placement(b[:12].view(4, 3), b[12:15], b[15:], CENTRE).apply(moved)
        left = torch.where(seen[0][..., None], errors[0] + shown - at, 0.0)
        scaled = torch.cat([b[:12] / 1e-3, b[12:15] / 2e-3, b[15:] / 0.1])
        return (left.square().sum((1, 2, 3)) * weights[0]).sum() + 1e-5 * scaled.square().sum()

    held, names = torch.as_tensor(PLACES).expand(2, -1, -1), ("first", "second")
    observed = torch.where(seen[0][..., None], at - errors[0], torch.nan)
    trials = TrialBatch(names, torch.arange(3).double().expand(2, -1), observed, held)
    group = (
        Replay(SIM, DisplacedMarkers(bind(), 4), trials),
        Start.resting(REST.expand(2, -1, -1)),
    )
    series = [
        (torch.cat([at, *(at + turn for turn in turns.unbind(-1))], 2)[None], trials.loads[None])
    ]
    placed = NuisanceFit([group], weights, accuracy, 0.0)(series, 1e-5)[1]
    result, inside = placed.common, placed.rows / math.sqrt(1e-5)
    assert float(result.turn.norm()) > 0.02
    gradients = []
    for b in (
        torch.zeros(18).double(),
        torch.cat([result.offsets.flatten(), result.shift, result.turn]),
    ):
        b.requires_grad_()
        gradients.append(torch.autograd.grad(loss(b), b)[0])
    assert float(gradients[1].norm()) < 1e-4 * float(gradients[0].norm())
    np.testing.assert_allclose(inside[12:15], result.shift / 2e-3, rtol=1e-9)
    held = NuisanceFit([group], weights, Accuracy(shift=2e-3), 0.0)(series, 1e-5)[1].common
    assert (
        float(held.offsets.abs().max())
        == float(held.turn.abs().max())
        == 0.0
        < float(held.shift.abs().max())
    )


# Poses of a beam under weights on two edges of its tip, so that it bends and twists.
SIM = Simulator(Body(MESH, select_vertices(MESH, x=0.0)), time_step=0.01)
EDGES = select_vertices(MESH, x=0.1, y=0.0), select_vertices(MESH, x=0.1, y=0.03)
WEIGHTS = ((0.0, 0.0), (0.05, 0.0), (0.0, 0.06), (0.05, 0.05), (0.1, 0.02))
TRUTH = {"youngs_modulus": 215e3}
RANGES = {"youngs_modulus": Bounds(lower=1e5, upper=1e6, logarithmic=True)}


def posed(observe, noise=0.0, truth=TRUTH):
    """A replay of poses with nominal markers, of measurements by other markers."""
    attached = torch.zeros(len(WEIGHTS), len(REST), dtype=torch.float64)
    for row, weights in enumerate(WEIGHTS):
        for edge, mass in zip(EDGES, weights, strict=True):
            attached[row, edge] += mass / len(edge)
    count = len(WEIGHTS)
    held = torch.as_tensor(PLACES).expand(count, -1, -1)
    names, inputs = tuple(f"w{i}" for i in range(count)), Inputs(attached_mass=attached)
    blank = TrialBatch(names, torch.zeros(count, 1).double(), held[:, None], held, inputs)
    start = Start.resting(REST.expand(count, -1, -1))
    return simulated(Replay(SIM, bind(), blank), start, truth, observe, noise), start


ACCURACY = Accuracy(2e-3, 2e-3, 0.03, centre=CENTRE.tolist())


def test_the_modulus_is_recovered_from_misplaced_markers():
    pair = posed(PlacedMarkers.of(bind(), ASKEW), noise=1e-5)
    naive = search_parameters(Misfit([pair], RANGES), [{"youngs_modulus": 4e5}], 30)
    misfit = Misfit([pair], RANGES, accuracy=ACCURACY)
    result = search_parameters(misfit, [{"youngs_modulus": 4e5}], 30, labels=LABELS)
    assert result.parameters["youngs_modulus"] == pytest.approx(215e3, rel=0.01)
    assert abs(naive.parameters["youngs_modulus"] - 215e3) > 3.0 * abs(
        result.parameters["youngs_modulus"] - 215e3
    )
    assert result.placement["offsets"].keys() == set(LABELS)
    placed = PlacedMarkers.of(bind(), Placement.from_plain(result.placement, LABELS))
    q = SIM.static_equilibrium(
        pair[0].trials.inputs, {name: double([x]) for name, x in TRUTH.items()}
    ).q
    off = (placed(q) - PlacedMarkers.of(bind(), ASKEW)(q)).norm(dim=-1)
    # Where the recording shows them, though frame and offsets are not distinguishable.
    assert float(off.max()) < 2e-4
    deviation = result.uncertainty.deviation["youngs_modulus"]
    assert 0.2 * abs(result.parameters["youngs_modulus"] - 215e3) < deviation < 0.1 * 215e3


def test_a_prior_determines_what_poses_do_not():
    """Weight against stiffness: poses under no other load
    than the body's own tell their ratio alone.
    """
    ranges = {
        **RANGES,
        "density": Bounds(lower=800.0, upper=1600.0, prior=Prior(mean=1200.0, deviation=40.0)),
    }
    still, start = posed(bind(), noise=1e-5, truth={"youngs_modulus": 215e3, "density": 1070.0})
    own = still.trials.select([0])
    pair = Replay(SIM, bind(), own), start.select([0])
    result, apart = (
        search_parameters(Misfit([seen], ranges), [{"youngs_modulus": 3e5, "density": 1000.0}], 30)
        for seen in (pair, (still, start))
    )
    assert result.parameters["density"] == pytest.approx(1200.0, abs=4.0)
    assert result.parameters["youngs_modulus"] / 215e3 == pytest.approx(1200.0 / 1070.0, rel=0.01)
    assert result.uncertainty.deviation["density"] == pytest.approx(40.0, rel=0.1)
    assert apart.parameters["density"] == pytest.approx(1070.0, rel=0.02)  # the weights tell
    assert apart.uncertainty.deviation["density"] < 20.0


@pytest.mark.slow
def test_modulus_and_mounting_are_recovered_from_poses_of_a_rigid_part():
    """A rigid body is mounted 3 mm and 2 degrees from
    where it is believed to be, and seen with noise.
    """
    mesh = beam((5, 2, 2))
    simulator = Simulator(
        Body(mesh, select_vertices(mesh, x=0.0), rigid={"cap": Rigid(density=1240.0)}),
        {"beam": Corotated(215e3, 0.45)},
        time_step=0.01,
    )
    cap = np.unique(mesh.cells[mesh.region("cap")])
    nominal = (
        np.array([0.09, 0.02, 0.03])
        + arms(0.06) @ Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix()
    )
    turn = Rotation.from_rotvec([0.02, -0.02, 0.02])
    shift = np.array([2e-3, -2e-3, 1e-3])
    middle = nominal.mean(axis=0)
    true = middle + shift + turn.apply(nominal - middle)
    names, count = ("free", "light", "heavy"), 3
    attached = torch.zeros(count, len(mesh.vertices), dtype=torch.float64)
    attached[1:, np.intersect1d(cap, select_vertices(mesh, x=0.1, y=0.03))] = torch.tensor(
        [[0.01], [0.02]]
    ).double()
    held = torch.as_tensor(nominal).expand(count, -1, -1)
    blank = TrialBatch(
        names, torch.zeros(count, 1).double(), held[:, None], held, Inputs(attached_mass=attached)
    )
    start = Start.resting(torch.as_tensor(mesh.vertices).expand(count, -1, -1))
    with torch.no_grad():
        seen = Replay(simulator, follow_vertices(mesh, cap, true), blank)(start)[0].numpy()
    draw, places = np.random.default_rng(0), seen.mean(axis=2, keepdims=True)
    shaken = Rotation.from_rotvec(2e-3 * draw.normal(size=(count, 3))).as_matrix()[:, None]
    noisy = places + 1e-4 * draw.normal(size=places.shape) + (seen - places) @ shaken
    seen = replace(blank, observed=torch.as_tensor(noisy))
    pair = Replay(simulator, follow_vertices(mesh, cap, nominal), seen), start
    ranges = {"beam_youngs_modulus": Bounds(lower=1e5, upper=1e6, logarithmic=True)}
    guess = [{"beam_youngs_modulus": 4e5}]
    bodies = ((0, nominal - middle),)
    accuracy = Accuracy(markers=2e-3, mounting=0.03, rigid_bodies=bodies, centre=CENTRE.tolist())
    result = search_parameters(Misfit([pair], ranges, accuracy=accuracy), guess, 30, labels=LABELS)
    naive = search_parameters(Misfit([pair], ranges), guess, 30)
    off, plain = (abs(x.parameters["beam_youngs_modulus"] / 215e3 - 1.0) for x in (result, naive))
    assert off < 0.03
    assert plain > 3.0 * off
    # Six of twelve coordinates are independent.
    halved = search_parameters(Misfit([pair], ranges, shares=[0.5] * 4), guess, 30)
    wider, narrow = (x.uncertainty.deviation["beam_youngs_modulus"] for x in (halved, naive))
    assert wider / narrow == pytest.approx(
        math.sqrt(2.0 * (1.0 - 1.0 / 36.0) / (1.0 - 1.0 / 18.0)), rel=1e-3
    )
    places = nominal + Placement.from_plain(result.placement, LABELS).offsets.numpy()
    assert np.linalg.norm(places.mean(axis=0) - true.mean(axis=0)) < 3e-4
    assert np.degrees(angles(true, places)) < 0.3


def test_misplaced_vertices_are_refused():
    replay, start = posed(bind())
    with pytest.raises(InputError, match=r"leave identify\.placement out"):
        Misfit([(Replay(SIM, lambda q: q[:, :4], replay.trials), start)], RANGES, accuracy=ACCURACY)
    refuses(
        InputError,
        "can be placed elsewhere",
        MarkerMap.at_vertices(torch.tensor([[0, 1]])).moved,
        MOVED[:2],
    )


OWN = {
    **RANGES,
    **{
        f"attached_mass_factor@w{i}": Bounds(
            lower=0.7, upper=1.3, prior=Prior(mean=1.0, deviation=0.05)
        )
        for i in (1, 2, 3, 4)
    },
}
# Of the weights that hung on the body, over those that were logged.
GAINS = (1.0, 0.93, 1.05, 1.0, 0.97)


def gained():
    """A replay of poses whose weights were off by `GAINS`."""
    replay, start = posed(PlacedMarkers.of(bind(), ASKEW), noise=1e-5)
    gains = torch.tensor(GAINS).double()[:, None]
    logged = Inputs(attached_mass=replay.trials.inputs.attached_mass / gains)
    return Replay(SIM, replay.observe, replace(replay.trials, inputs=logged)), start


@pytest.mark.parametrize("sessions", [1, 2])
def test_derivatives_by_the_values_of_trials_are_those_of_the_loss(sessions):
    replay, start = gained()
    parts = [(replay, start)]
    if sessions > 1:
        rows = [[0, 2, 3], [1, 4]]
        trials = [replace(replay.trials.select(own), session=str(own)) for own in rows]
        parts = [
            (Replay(SIM, bind(), t), start.select(own)) for t, own in zip(trials, rows, strict=True)
        ]
    misfit = Misfit(parts, OWN, accuracy=ACCURACY)
    unit = np.array([0.45, 0.4, 0.6, 0.55, 0.3])
    misfit.update_prior_weight(unit)
    misfit.update_prior_weight(unit)
    slopes = differences(lambda x: misfit.linearise(x, derivatives=False).loss, unit, 1e-4)
    assert misfit.linearise(unit).gradient == pytest.approx(np.array(slopes), rel=2e-4)


def test_a_value_of_a_trial_needs_a_common_one():
    replay, _ = posed(bind())
    with pytest.raises(InputError, match="give attached_mass_factor, that of the others, too"):
        replay.prepare({"attached_mass_factor@w1": double([1.1])})
    refuses(
        InputError,
        "no parameter 'nothing' to identify",
        replay.prepare,
        {"nothing@w1": double([1.1])},
    )
    both = {
        "attached_mass_factor": 1.0,
        "attached_mass_factor@w1": 1.5,
        "attached_mass_factor@x": 9.0,
    }
    _, inputs, _ = replay.prepare({name: double([value]) for name, value in both.items()})
    expected = replay.trials.inputs.attached_mass.clone()
    expected[1] *= 1.5
    torch.testing.assert_close(inputs.attached_mass, expected)


def test_a_trial_is_left_out_as_if_the_others_were_identified():
    """The others are identified with the same priors,
    whose weights a search would compute again.
    """
    replay, start = posed(bind(), noise=2e-4)
    count = len(replay.trials.names)

    def best(rows, weight):
        pair = Replay(SIM, bind(), replay.trials.select(rows)), start.select(rows)
        misfit = Misfit([pair], RANGES, accuracy=ACCURACY)
        misfit.prior_weight, unit = weight, misfit.to_unit(TRUTH)
        for _ in range(5):
            linear = misfit.linearise(unit)
            unit = unit - np.linalg.solve(linear.gauss_newton, linear.gradient)
        placed = misfit.nuisances(unit).common
        return misfit, unit, np.concatenate([placed.offsets.ravel(), placed.shift, placed.turn])

    whole, unit, placement = best([*range(count)], 1e-5)
    left_out = whole.uncertainty(unit).left_out
    assert [*left_out] == [*replay.trials.names]
    changes, expected, moved, moves = [], [], [], []
    # Every trial has its share of the loss, so that fewer weigh more.
    for row, name in enumerate(left_out):
        misfit, other, places = best(
            [k for k in range(count) if k != row], 1e-5 * count / (count - 1)
        )
        changes.append(left_out[name].change["youngs_modulus"])
        expected.append(
            misfit.from_unit(other)["youngs_modulus"] - whole.from_unit(unit)["youngs_modulus"]
        )
        moved.append(left_out[name].placement)
        moves.append(places - placement)
        # The others fit better without the one that is left out.
        deviation = misfit.uncertainty(other).deviation["youngs_modulus"]
        assert left_out[name].deviation["youngs_modulus"] == pytest.approx(deviation, rel=0.3)
    assert np.linalg.norm(np.subtract(changes, expected)) < 0.05 * np.linalg.norm(expected)
    assert np.linalg.norm(np.subtract(moved, moves)) < 0.05 * np.linalg.norm(moves)
