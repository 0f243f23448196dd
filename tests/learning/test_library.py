"""Identification, reconstruction, training and evaluation as functions, on beams."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import warp_resphys as wr
from support.refusals import refuses
from warp_resphys import ObservedMotions, evaluate, identify, identify_law, reconstruct
from warp_resphys.data.markers import WHOLE_STATE
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.io.fan_out import Workers
from warp_resphys.io.parts import Parts
from warp_resphys.learning import comparison
from warp_resphys.learning.comparison import Comparison, Model
from warp_resphys.learning.evaluation import rollout_parts
from warp_resphys.learning.identification.misfit import Misfit
from warp_resphys.learning.identification.search import Identification
from warp_resphys.learning.observed_motions import Identified
from warp_resphys.learning.placement import Accuracy
from warp_resphys.learning.residuals.fitting import Fitting, fit_force
from warp_resphys.learning.without_physics import without_physics
from warp_resphys.settings.learning import (
    Bounds,
    InTheLoopSettings,
    LawSettings,
    NetworkSettings,
    Prior,
    TrainerSettings,
)

MESH = wr.box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(5, 1, 1))
BODY = wr.Body(MESH, fixed=wr.select_vertices(MESH, x=0.0))
TIP = wr.select_vertices(MESH, x=0.1)
MARKERS = wr.bind_markers(
    MESH, np.array([[0.1, 0.01, 0.022], [0.06, 0.01, 0.022], [0.1, 0.022, 0.01]]), ["a", "b", "c"]
)
STEPS = 15
STIFF = {"youngs_modulus": (1e5, 1e6)}


def beam(youngs_modulus, time_step=0.01):
    material = wr.Corotated(youngs_modulus, 0.45, density=1070.0, stiffness_damping=3e-3)
    return wr.Simulator(BODY, material, time_step=time_step)


def pulled(*newtons):
    force = torch.zeros(len(newtons), len(MESH.vertices), 3, dtype=torch.float64)
    force[:, TIP, 2] = -torch.tensor(newtons, dtype=torch.float64)[:, None] / len(TIP)
    return wr.Inputs(external_force=force)


def let_go(robot, *newtons, markers=WHOLE_STATE, known_start=False):
    """Motions of a robot that is pulled at its tip and let go."""
    resting = pulled(*newtons)
    start = robot.static_equilibrium(resting)
    q = robot.rollout(start, STEPS).q
    seen = torch.stack([markers(positions) for positions in q])
    begins = {"start": start} if known_start else {"resting": resting}
    return ObservedMotions.of(robot, seen, observation=markers, **begins)


@pytest.fixture(scope="module")
def robot():
    return beam(264e3)


def test_youngs_modulus_is_recovered(robot):
    motion = let_go(robot, 0.05, 0.1, markers=MARKERS)
    result = identify(beam(180e3), motion, {"youngs_modulus": (1e5, 1e6)})
    assert result.parameters["youngs_modulus"] == pytest.approx(264e3, rel=1e-4)
    assert not result.at_bounds
    assert float(evaluate(beam(180e3), motion, parameters=result.parameters).max()) < 1e-6
    assert float(evaluate(beam(180e3), motion).mean()) > 1e-4


def test_motions_that_inputs_begin_are_identified_together(robot):
    inputs = pulled(0.05, 0.1)
    q = robot.rollout(robot.static_equilibrium(batch=2), STEPS, inputs).q
    motions = ObservedMotions.of(robot, q, inputs=inputs)
    assert identify(beam(180e3), motions, STIFF).parameters["youngs_modulus"] == pytest.approx(
        264e3, rel=1e-4
    )


def test_a_law_begins_with_the_material_of_the_simulator_where_nothing_was_identified(robot):
    stiff = Bounds(lower=1e5, upper=1e6, prior=Prior(mean=264e3, deviation=50e3))
    motion = let_go(robot, 0.05, known_start=True)
    law = identify_law(
        beam(200e3),
        motion,
        {"youngs_modulus": stiff},
        settings=LawSettings(terms=(), branches=0, families=0),
    )
    assert 2.0 * law.parameters["c10"] == pytest.approx(264e3 / 2.9, rel=0.02)


def test_trials_have_their_values_sessions_their_places_and_finished_searches_are_kept(
    tmp_path, monkeypatch, capsys
):
    """Tensions that differ from their logs, and a marker
    that sits 1 mm elsewhere in one of two sessions.
    """
    cable = wr.Tendons([[[0.0, 0.01, 0.0], [0.05, 0.01, 0.0], [0.1, 0.01, 0.0]]])
    body = wr.Body(MESH, fixed=BODY.fixed_vertices, energies=[cable])
    true, wrong = (
        wr.Simulator(body, wr.Corotated(e, 0.45, stiffness_damping=3e-3)) for e in (264e3, 200e3)
    )
    factors = {"motion 0": 1.1, "motion 1": 0.92, "motion 2": 1.06}
    logged = torch.sin(0.6 * torch.arange(20).double()).square()[:, None, None].expand(20, 3, 1)
    pulled = logged * torch.tensor([*factors.values()]).double()[:, None]
    q = true.rollout(true.static_equilibrium(batch=3), 20, wr.Inputs(tendon_tension=pulled)).q
    seen = torch.stack([MARKERS(positions) for positions in q])
    seen[:, 1, 0] += torch.tensor([0.0, 1e-3, 0.0])
    motions = ObservedMotions.of(
        wrong, seen, inputs=wr.Inputs(tendon_tension=logged), observation=MARKERS
    )
    motions = replace(
        motions, trials=replace(motions.trials, sessions=("monday", "friday", "monday"))
    )
    ranges = {
        "youngs_modulus": Bounds(lower=1e5, upper=1e6),
        "tendon_tension_factor": Bounds(
            lower=0.5,
            upper=2.0,
            logarithmic=False,
            prior=Prior(mean=1.0, deviation=0.3),
            per="trial",
        ),
    }

    def identified(**more):
        options = {
            "names": ["motion 0", "motion 1"],
            "held_out": ["motion 2"],
            "accuracy": Accuracy(markers=1e-3),
        }
        return identify(
            replace(wrong), motions, ranges, kept=tmp_path / "searches", **options, **more
        )

    found = identified()
    assert found.parameters["tendon_tension_factor"] == 1.0
    assert found.of_trials_deviation.keys() == found.of_trials.keys()
    ratios = [
        found.of_trials[f"tendon_tension_factor@{name}"] / factor
        for name, factor in factors.items()
    ]
    scale = found.parameters["youngs_modulus"] / 264e3  # of all forces, which places hide
    assert scale == pytest.approx(1.0, rel=0.1)
    assert ratios == pytest.approx([scale] * 3, rel=0.02)
    places = {
        session: placed["offsets"]["a"] for session, placed in found.placement["sessions"].items()
    }
    assert np.subtract(places["friday"], places["monday"]) == pytest.approx(
        [0.0, 1e-3, 0.0], abs=2e-4
    )
    assert np.shape(found.placement["new_session"]) == (15, 15)
    # No search is needed again, but that of the first frames.
    monkeypatch.setattr(Misfit, "linearise", None)
    with pytest.raises(TypeError):
        identified()
    monkeypatch.undo()
    capsys.readouterr()
    assert identified().of_trials == found.of_trials
    # Those of the file.
    assert f"evaluation {sum(map(len, found.history))} (limit 30)" in capsys.readouterr().err
    monkeypatch.setattr(Misfit, "linearise", None)
    with pytest.raises(TypeError):  # Searches of other arguments are not used.
        identified(tolerance=1e-3)


def test_each_tendon_may_have_a_factor_of_its_own():
    routes = {
        side: [[x, y, 0.02] for x in (0.0, 0.05, 0.1)]
        for side, y in (("left", 0.0), ("right", 0.02))
    }
    body = wr.Body(MESH, fixed=BODY.fixed_vertices, energies=[wr.Tendons(routes)])
    simulator = wr.Simulator(
        body, wr.Corotated(264e3, 0.45, density=1070.0, stiffness_damping=3e-3)
    )
    ramp = torch.linspace(0.0, 1.0, 15, dtype=torch.float64)[:, None, None]
    tension = ramp * torch.tensor([[0.3, 0.0], [0.1, 0.3]], dtype=torch.float64)
    start, factors = simulator.rest_state(batch=2), torch.tensor([1.4, 0.8], dtype=torch.float64)
    q = simulator.rollout(start, 15, wr.Inputs(tendon_tension=factors * tension)).q
    motions = ObservedMotions.of(simulator, q, start, wr.Inputs(tendon_tension=tension))
    ranges = {"tendon_tension_factor": Bounds(lower=0.5, upper=2.0, per="part")}
    found = identify(simulator, motions, ranges, {"tendon_tension_factor": 1.1})
    assert found.first_guess == {
        "tendon_tension_factor_left": 1.1,
        "tendon_tension_factor_right": 1.1,
    }
    assert found.parameters == pytest.approx(
        {"tendon_tension_factor_left": 1.4, "tendon_tension_factor_right": 0.8}, rel=1e-3
    )
    assert evaluate(simulator, motions, parameters=found.parameters).max() < 1e-6
    alone = {"tendon_tension_factor_left": Bounds(lower=0.5, upper=2.0)}
    assert identify(simulator, motions, alone).parameters["tendon_tension_factor_left"] > 1.2
    beside = {"tendon_tension_factor_left": (0.9, 1.1), **ranges}
    with pytest.raises(
        InputError, match=r"per names part, but parameters has tendon_tension_factor_left as well"
    ):
        identify(simulator, motions, beside)
    with pytest.raises(
        InputError, match=r"youngs_modulus.per names part, but the body has no parts with a young"
    ):
        identify(simulator, motions, {"youngs_modulus": Bounds(lower=1e5, upper=1e6, per="part")})
    with pytest.raises(
        InputError, match=r"no parameter 'slack'.*or those of a part, such as tendon_"
    ):
        identify(simulator, motions, {"slack": (0.1, 1.0)})


def test_a_learned_force_beats_the_simulator_on_a_motion_it_has_not_seen(robot):
    wrong = beam(200e3)
    seen = let_go(robot, 0.04, 0.07, 0.1, 0.13, known_start=True)
    found = reconstruct(wrong, seen)
    q, forces = (torch.from_numpy(array) for array in found.of(found.names, "q", "force"))
    assert q.shape == forces.shape == (4, STEPS + 1, len(MESH.vertices), 3)
    # With its own forces, the simulator goes where the robot went.
    assert evaluate(wrong, seen, lambda state, step: forces[:, step + 1]).max() < 1e-6

    network = NetworkSettings(position_modes=3, velocity_modes=3, force_modes=4, layers=1, width=16)
    chosen = {"trainer": TrainerSettings(epochs=60, rollout_every=20), "validation": ["motion 3"]}
    judged = fit_force(wrong, seen, found, network=network, **chosen)
    unseen = let_go(robot, 0.09, known_start=True)
    corrected, uncorrected = evaluate(wrong, unseen, judged), evaluate(wrong, unseen)
    at_rest = (
        (torch.from_numpy(unseen.trials.observed[0]) - wrong.rest_positions).norm(dim=-1).mean(-1)
    )
    assert corrected.shape == (STEPS + 1, 1)
    assert corrected[0, 0] == 0.0
    assert float(corrected.mean()) < 0.2 * float(uncorrected.mean())
    assert float(corrected.mean()) < 0.2 * float(at_rest.mean())
    # The same seed gives the same network, whatever torch drew before; held-out motions choose the
    # weights.
    short = TrainerSettings(epochs=2, gate=False)
    first, again = (
        fit_force(wrong, seen, found, network=network, trainer=short).network for _ in range(2)
    )
    assert torch.equal(first(q[:, 3], 0.0 * q[:, 3]), again(q[:, 3], 0.0 * q[:, 3]))
    held_out = 1e3 * evaluate(wrong, seen, judged, names=["motion 3"])[1:].mean()
    assert judged.training["kept"]["validation_rollout_error_mm"] == pytest.approx(
        held_out, rel=1e-6
    )
    without = 1e3 * evaluate(wrong, seen, names=["motion 3"])[1:].mean()
    assert (judged.test["used"], judged.test["split"], judged.test["trials"]) == (
        True,
        "validation",
        ["motion 3"],
    )
    assert (judged.test["error_mm"], judged.test["below_mm"]) == pytest.approx(
        (held_out, without), rel=1e-6
    )


def test_a_force_that_is_no_gain_on_left_out_motions_is_not_used(robot, caplog):
    """The motions are those of the simulator, with noise of the points
    that a network can learn by heart alone.
    """
    seen = let_go(robot, 0.04, 0.07, 0.1, known_start=True)
    noise = 2e-4 * np.random.default_rng(0).standard_normal(seen.trials.observed[:, 1:].shape)
    noisy = np.concatenate([seen.trials.observed[:, :1], seen.trials.observed[:, 1:] + noise], 1)
    seen = replace(seen, trials=replace(seen.trials, observed=noisy))
    network = NetworkSettings(position_modes=3, velocity_modes=3, force_modes=4, layers=1, width=16)
    trainer = TrainerSettings(epochs=10, rollout_every=5)
    test = fit_force(robot, seen, reconstruct(robot, seen), network=network, trainer=trainer).test
    assert test["trials"] == [*seen.trials.names]
    assert test["split"] == "left-out training"
    assert test["error_mm"] > test["below_mm"] > 0.1
    assert not test["used"]
    assert "fit_force: the network is not used: on the left-out training trials" in caplog.text


def test_the_network_has_the_actuation_as_input():
    """Tendons of two tensions; the force that is missing is that of a third of the tension."""
    cable = wr.Tendons([[[0.0, 0.01, 0.0], [0.05, 0.01, 0.0], [0.1, 0.01, 0.0]]])
    body = wr.Body(MESH, fixed=BODY.fixed_vertices, energies=[cable])
    simulator = wr.Simulator(
        body, wr.Corotated(264e3, 0.45, density=1070.0, stiffness_damping=3e-3)
    )
    start = simulator.rest_state(batch=3)
    ramp = torch.linspace(0.0, 1.0, 15, dtype=torch.float64)[:, None, None]
    tension = ramp * torch.tensor([[0.2], [0.35], [0.5]], dtype=torch.float64)
    q = simulator.rollout(start, 15, wr.Inputs(tendon_tension=1.5 * tension)).q

    def motion(*rows):
        some = wr.Inputs(tendon_tension=tension[:, rows])
        return ObservedMotions.of(simulator, q[:, rows], start.map(lambda t: t[list(rows)]), some)

    found, learned = reconstruct(simulator, motion(0, 2)), motion(0, 2)
    samples = Fitting(simulator, learned, found, found.names).samples(found.names)
    assert torch.equal(samples.actuation[:, 0], torch.cat([tension[:, 0, 0], tension[:, 2, 0]]))
    network = NetworkSettings(position_modes=2, velocity_modes=2, force_modes=3, layers=1, width=16)
    force = fit_force(
        simulator, learned, found, network=network, trainer=TrainerSettings(epochs=60, gate=False)
    )
    uncorrected = evaluate(simulator, motion(1))
    assert float(evaluate(simulator, motion(1), force).mean()) < 0.2 * float(uncorrected.mean())
    factor = identify(simulator, motion(0, 1, 2), {"tendon_tension_factor": (0.5, 3.0)})
    assert factor.parameters["tendon_tension_factor"] == pytest.approx(1.5, rel=1e-3)


@pytest.mark.slow
def test_workers_and_training_through_the_simulator_are_for_functions_too(robot):
    wrong, seen = beam(200e3), let_go(robot, 0.04, 0.07, 0.1, 0.13, known_start=True)
    found = reconstruct(wrong, seen, parts=Parts("reconstruct", Workers(2), batch=1))
    np.testing.assert_array_equal(found.read("force"), reconstruct(wrong, seen).read("force"))
    modes = {"position_modes": 3, "velocity_modes": 3, "force_modes": 4, "layers": 1, "width": 16}
    one = {"validation": ["motion 3"], "network": NetworkSettings(**modes)}
    looped = fit_force(wrong, seen, found, **one, in_the_loop=InTheLoopSettings(epochs=3))
    uncorrected, error = (
        evaluate(wrong, seen, force, names=["motion 3"]).mean() for force in (None, looped)
    )
    assert error < 0.4 * uncorrected


def test_models_of_one_simulator_have_the_derivatives_of_their_parameters(robot):
    motions = let_go(robot, 0.05, 0.1, markers=MARKERS)
    found, simulator = identify(beam(180e3), motions, {"youngs_modulus": (1e5, 1e6)}), beam(180e3)
    models = {
        "close": Model(simulator, found),
        "soft": Model(simulator, replace(found, parameters={"youngs_modulus": 1e5})),
    }
    names = motions.trials.names
    spreads = [
        Comparison(some, motions, names, {"1": names}).spreads
        for some in (models, {"soft": models["soft"]})
    ]
    np.testing.assert_allclose(spreads[0]["soft"], spreads[1]["soft"], rtol=1e-6)
    assert np.nanmax(spreads[0]["soft"]) > 2.0 * np.nanmax(spreads[0]["close"])
    calibrated = Comparison(models, motions, names[:1], {"1": names[1:]}, names[:1])
    assert [*calibrated.errors()["per_marker"]["close"]] == ["a", "b", "c"]
    assert calibrated.errors()["intervals"]["models"].keys() == {"rest", *models}


def test_a_model_of_which_nothing_learned_is_used_has_the_motions_of_the_one_below(
    robot, monkeypatch
):
    simulator, motions = beam(180e3), let_go(robot, 0.04, 0.12, markers=MARKERS)
    names, found = motions.trials.names, {"sysid": 190e3, "soft": 120e3, "resphys": 190e3}
    models = {
        name: Model(simulator, Identification({"youngs_modulus": value}))
        for name, value in found.items()
    }
    rolled = list[str]()
    monkeypatch.setattr(
        comparison, "rollout_parts", lambda *a: rolled.append(a[-1]) or rollout_parts(*a)
    )
    errors = Comparison(models, motions, names[:1], {"1": names[1:]}, names[:1]).errors()[
        "errors_mm"
    ]
    assert rolled == ["sysid", "soft", "calibration_sysid", "calibration_soft"]
    assert errors["resphys"] == errors["sysid"] != errors["soft"]
    seen_first = {
        "a": models["soft"],
        "b": Model(simulator, replace(models["soft"].identified, of_trials={"x@a": 1.0})),
    }
    assert not Comparison(seen_first, motions, names, {"1": names})._same_motions("a", "b")
    acting = replace(found := models["sysid"].identified, actuator={"tendon_tension": object()})
    compared = Comparison(
        {"a": Model(simulator, found), "b": Model(simulator, acting)}, motions, names, {"1": names}
    )
    assert not compared._same_motions("a", "b")


def test_intervals_grow_for_simulators_identified_without_the_largest_trial(robot, monkeypatch):
    """And for networks on them; only with what the training used."""
    motions = replace(
        let_go(robot, 0.04, 0.12, 0.07, 0.1, 0.09, markers=MARKERS), train_fraction=0.4
    )
    motions.trials.observed[0, 9:] += 1.0  # not trained on
    motions.trials.observed[2, 3, 0] += (
        0.05  # a large displacement for a moment: the size of a trial is its largest
    )
    names, simulator = motions.trials.names, beam(180e3)
    train, test, validation = names[:3], names[3:4], names[4:]
    found = identify(simulator, motions, {"youngs_modulus": (1e5, 1e6)}, names=train)
    models = {
        "force": Model(simulator, found, SimpleNamespace(replaces_simulator=False)),
        "sysid": Model(simulator, found),
        "simfree": Model(simulator, found, SimpleNamespace(replaces_simulator=True)),
        "actuator": Model(simulator, replace(found, actuator={"tendon_tension": object()})),
        "guess": Model(simulator, replace(found, uncertainty=None)),
        "other": Model(beam(170e3), replace(found, uncertainty=None)),
    }
    made = Comparison(models, motions, train, {"1": test}, validation)
    below = {
        "force": "sysid",
        "sysid": "sysid",
        "simfree": None,
        "actuator": "sysid",
        "guess": None,
        "other": None,
    }
    assert {model: made._below(model) for model in [*models, "rest"]} == {**below, "rest": None}
    assert {model: made._calibrating(model) for model in models} == {
        model: [*validation, names[2]] if model == "sysid" else [*validation] for model in models
    }
    moved = motions.trials.observed - motions.trials.bound
    moved[0, 7:] = moved[1, 7:] = moved[2, 7:] = np.nan
    reach = np.nanmax(np.linalg.norm(moved[[0, 1, 2, 4]], axis=-1))
    simple, asked = {model: models[model] for model in ("other", "sysid")}, []
    monkeypatch.setattr(
        comparison,
        "without_physics",
        lambda *a, **b: asked.append(a[1]) or without_physics(*a, **b),
    )
    errors = Comparison(simple, motions, train, {"1": test}, validation).errors()["intervals"][
        "models"
    ]
    assert (
        errors["sysid"]["reach"]
        == errors["sysid"]["without_spread"]["reach"]
        == pytest.approx(reach)
    )
    assert {errors[model]["reach"] for model in errors if model != "sysid"} == {0.0}
    without = Comparison(simple, motions, train, {"1": test}, train).errors()["intervals"]
    assert without["calibrated_on"] == "left_out"
    assert without["models"]["sysid"]["reach"] == pytest.approx(
        np.nanmax(np.linalg.norm(moved[:3], axis=-1))
    )
    # Models without physics may need all training trials.
    assert {*map(tuple, asked)} == {test, validation, train}


def test_forces_from_markers_bring_the_markers_there(robot):
    wrong = beam(200e3)
    seen = let_go(robot, 0.1, markers=MARKERS)
    seen.trials.observed[0, 5, 1] = np.nan
    found = reconstruct(wrong, seen)
    (forces,) = (torch.from_numpy(array).double() for array in found.of(found.names, "force"))
    replayed = evaluate(wrong, seen, lambda state, step: forces[:, step + 1])
    assert float(replayed[1:].max()) < 0.02 * float(evaluate(wrong, seen).mean())


def test_representations_have_shapes_in_place_of_arrays(robot):
    motion = let_go(robot, 0.1, markers=MARKERS)
    assert repr(motion).startswith(
        "ObservedMotions(trials=Trials(names=('motion 0',), labels=('a', 'b', 'c'), "
        "begins=('driven',), times=array (1, 16), "
        "observed=array (1, 16, 3, 3), held=array (1, 3, 3), "
    )
    assert (
        "observe=SurfaceMarkers(vertices=array (3, 3), labels=('a', 'b', 'c'), weights=array"
        in repr(motion)
    )
    stiffness = {"youngs_modulus": np.float64(264123.4), "density": torch.tensor(1070.0)}
    assert (
        repr(Identified(stiffness))
        == "Identified(parameters={'density': 1070, 'youngs_modulus': 264123})"
    )
    found = reconstruct(robot, motion)
    assert repr(found) == "ReconstructedTrials(names=('motion 0',), read=partial)"
    network = NetworkSettings(position_modes=1, velocity_modes=0, force_modes=1, width=2)
    force = fit_force(robot, motion, found, network=network, trainer=TrainerSettings(epochs=1))
    assert repr(force).startswith(
        "Learned(network=ResidualForce, force_frame='world', training={'epochs': [{'epoch': 1"
    )


def test_invalid_motions_are_refused(robot):
    start = robot.rest_state()
    refuses(wr.InputError, "observed has shape", ObservedMotions.of, robot, torch.zeros(3), start)
    with pytest.raises(wr.InputError, match="5 points were observed, but there are 24 vertices"):
        evaluate(robot, ObservedMotions.of(robot, torch.zeros(3, 5, 3), start))
    q = robot.rollout(start, 3).q
    with pytest.raises(
        wr.InputError, match="5 points were observed, but there are 3 points of the obs"
    ):
        ObservedMotions.of(robot, q[:, :, :5], start, observation=MARKERS)
    with pytest.raises(wr.InputError, match="start has 1 states, but 2 motions were observed"):
        ObservedMotions.of(robot, q.expand(-1, 2, -1, -1), start)
    refuses(
        wr.InputError,
        "Unknown input pressure",
        ObservedMotions.of,
        robot,
        q,
        start,
        wr.Inputs(pressure=1.0),
    )
    with pytest.raises(wr.InputError, match="external_force has 2 time steps, but 3 are"):
        ObservedMotions.of(
            robot, q, start, wr.Inputs(external_force=torch.zeros(2, *q.shape[1:]).to(q))
        )
    motion = ObservedMotions.of(robot, q.numpy(), start)
    with pytest.raises(wr.InputError, match="reconstruct them first"):
        Fitting(robot, motion, None, motion.trials.names).samples(motion.trials.names)
    refuses(
        wr.InputError, "there is no parameter 'mass'", identify, robot, motion, {"mass": (1.0, 2.0)}
    )
    with pytest.raises(
        wr.InputError, match=r"a range is 200000\.0: give the smallest and the largest value"
    ):
        identify(robot, motion, {"youngs_modulus": 2e5})
    with pytest.raises(wr.InputError, match="there is no trial 'motion 1': there are motion 0"):
        evaluate(robot, motion, names=["motion 1"])
    with pytest.raises(
        wr.InputError, match="observed every 10 ms, but the step of the simulator is 4 ms"
    ):
        reconstruct(beam(2e5, time_step=0.004), motion)
    found = reconstruct(robot, motion)
    with pytest.raises(wr.InputError, match="the trial 'motion 0' was not reconstructed"):
        fit_force(robot, motion, replace(found, names=("other",)))


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (
            lambda r, m, f: fit_force(r, m, f.read("force")),
            "reconstructed is an array of shape .*ReconstructedTrials",
        ),
        (
            lambda r, m, f: fit_force(r, m, f, network={"width": 3}),
            "network is of type dict: .*NetworkSettings",
        ),
        (
            lambda r, m, f: evaluate(r, m, f.read("force")),
            "force is an array of shape .*Learned or a function or None",
        ),
        (
            lambda r, m, f: evaluate(r, m.trials),
            "motions is of type Trials: it must be .*ObservedMotions",
        ),
        (
            lambda r, m, f: identify(BODY, m, {}),
            "simulator is of type Body: it must be .*Simulator",
        ),
        (
            lambda r, m, f: identify_law(r, m, ["density"]),
            "is of type list: it must be a mapping or None",
        ),
        (
            lambda r, m, f: identify_law(r, m, known="law.json"),
            "known is of type str: it must be a mapping or None",
        ),
        (
            lambda r, m, f: identify(r, m, {}, starts=None),
            "starts is of type NoneType: it must be int",
        ),
        (
            lambda r, m, f: reconstruct(r, m, "motion 0"),
            "names is of type str: it must be a list or None",
        ),
        (
            lambda r, m, f: reconstruct(r, m, parameters={"density": None}),
            "the parameter density is of type NoneType",
        ),
        (
            lambda r, m, f: evaluate(r, m, parameters={"density": np.ones(3)}),
            r"density is an array of shape \(3,\)",
        ),
        (
            lambda r, m, f: evaluate(r, m, lambda state, step: 0.0),
            "the force of step 0 is of type float: it must be a",
        ),
        (
            lambda r, m, f: evaluate(r, m, lambda state, step: state.q[0, 0]),
            r"the force of step 0 is an array of sha",
        ),
        (lambda r, m, f: evaluate(r, m, names=[]), "no trials are named: name some of motion 0"),
        (lambda r, m, f: identify(r, m, {}, held_out=["x"]), "there is no trial 'x'"),
        (lambda r, m, f: fit_force(r, m, f, validation=["motion 0"]), "no trials are named"),
        (
            lambda r, m, f: fit_force(*longer(r), f),
            "forces on 24 vertices were reconstructed, but the body has 28",
        ),
        (
            lambda r, m, f: fit_force(r, dropped(r, 2), f),
            "of 3 steps were reconstructed, but motion 0 has 2 of 10 ms",
        ),
        (
            lambda r, m, f: fit_force(r, dropped(r, 4), f),
            "of 3 steps were reconstructed, but motion 0 has 4 of 10 ms",
        ),
        (
            lambda r, m, f: fit_force(beam(2e5, 0.03), m, f),
            "of 3 steps .*, but motion 0 has 1 of 30 ms",
        ),
        (
            lambda r, m, f: fit_force(r, m, f, force_frame="own"),
            "force_frame is 'own': choose world or corotated",
        ),
        (
            lambda r, m, f: identify(r, m, STIFF, {"colour": 1.0}),
            "first_guess: there is no parameter 'colour'",
        ),
        (
            lambda r, m, f: identify(r, m, STIFF, {"density": "x"}),
            r"identify\.first_guess\.density is 'x'",
        ),
        (
            lambda r, m, f: identify(r, m, STIFF, starts=0),
            "starts is 0: it must be a whole number, one or more",
        ),
        (
            lambda r, m, f: identify(r, m, STIFF, max_evaluations=0),
            "max_evaluations is 0: it must be a whole number",
        ),
        (
            lambda r, m, f: identify(r, m, {"density": ("a", 1.0)}),
            r"parameters\.density: Bounds\.lower is 'a'",
        ),
        (
            lambda r, m, f: identify_law(r, m, known={"model": "law", "constants": {}}),
            "known has model, constants: a law",
        ),
        (
            lambda r, m, f: identify_law(r, m, {"colour": (1.0, 2.0)}),
            "parameters: there is no parameter 'colour'",
        ),
    ],
)
def test_arguments_of_wrong_types_and_shapes_are_refused(robot, call, sentence):
    motion = dropped(robot, 3)
    with pytest.raises(wr.InputError, match=sentence):
        call(robot, motion, reconstruct(robot, motion))


def test_searches_are_kept_in_a_file_if_they_depend_on_what_modules_have(robot, tmp_path):
    with pytest.raises(DataFileError, match="is a folder: give the path of a file"):
        identify(robot, dropped(robot, 3), STIFF, kept=tmp_path)

    class Local(wr.Corotated):
        pass

    with pytest.raises(
        wr.InputError, match=r"no part of a module .*Local.*: define it at the top of a file"
    ):
        identify(
            replace(robot, material=Local(2e5)),
            dropped(robot, 3),
            STIFF,
            kept=tmp_path / "kept.safetensors",
        )


def dropped(robot, steps):
    """A motion that begins undeformed, without velocity."""
    return ObservedMotions.of(robot, robot.rollout(robot.rest_state(), steps).q, robot.rest_state())


def longer(robot):
    """The robot with a cell more, and a motion of it."""
    other = replace(
        robot, body=wr.Body(wr.box_hexahedra(size=(0.12, 0.02, 0.02), divisions=(6, 1, 1)))
    )
    return other, ObservedMotions.of(
        other, other.rest_positions.expand(4, 1, -1, -1), other.rest_state()
    )


def test_a_force_of_another_body_is_refused(robot):
    motion = dropped(robot, 3)
    network = NetworkSettings(position_modes=1, velocity_modes=0, force_modes=1, width=2)
    force = fit_force(
        robot,
        motion,
        reconstruct(robot, motion),
        network=network,
        trainer=TrainerSettings(epochs=1),
    )
    with pytest.raises(
        wr.InputError, match="a force on 24 vertices was learned, but the body has 28"
    ):
        evaluate(*longer(robot), force)
