"""Configurations of experiments on recordings: what is refused, what a budget changes, and which choice wins."""

from pathlib import Path

import numpy as np
import pytest
from measured_run import configuration

from warp_resphys.experiment.checks import check_configuration, training_settings
from warp_resphys.experiment.schema import dotted
from warp_resphys.experiment.simulate import vertical
from warp_resphys.experiment.trials import Split, folds_of, split_of, trials_of
from warp_resphys.io.errors import InputError, ResphysError

ROOT = Path(__file__).parents[2]


def changed(config, key, value):
    *path, last = key.split("/")
    group = config
    for name in path:
        group = group[name]
    group[last] = value
    return config


TRIALS = {"a": {"file": "a.c3d", "payload": 0.0}, "b": {"file": "b.c3d", "payload": 0.1}}


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("data/seconds", 0.0, "data.seconds is 0.0: it must be a positive number"),
        ("data/seconds", "long", "data.seconds is 'long': it must be a positive number"),
        ("data/longest_gap", 2.5, "data.longest_gap is 2.5: it must be a whole number"),
        ("data/units", "inch", "data.units is 'inch': it must be one of m, cm, mm"),
        ("data/units", ["m"], r"data.units is \['m'\]: it must be one of m, cm, mm"),
        ("data/folds", "five", "data.folds is 'five': it must be one of leave_one_out"),
        ("data/up", "up", "data.up is 'up': give x, -x"),
        ("data/up", [0.0, 0.0, 0.0], "data.up is .*: give x, -x"),
        ("data/up", [0.0, 1.0], "data.up is .*: it must be x, -x"),
        ("data/begins", "later", "data.begins is 'later': it must be one of held, released"),
        ("data/base_motion", "video", "data.base_motion is 'video': it must be recorded or reference, a group"),
        ("data/base_motion", 3, "data.base_motion is 3: it must be a group of settings"),
        ("data/base_motion", {"about": [0.0, 0.0, 0.0]}, "data.base_motion needs either file, .* or swings"),
        ("data/base_motion", {"swings": {}}, "data.base_motion.swings is empty: give it at least one"),
        (
            "data/base_motion",
            {"swings": {"a": {"translation": [0, 0, 1]}}},
            "data.base_motion.swings.a.frequency is mis",
        ),
        ("data/base_motion", {"swings": {"a": {"frequency": -1.0}}}, "frequency is -1.0: it must be a positive number"),
        ("data/base_motion", {"file": "a.csv", "swings": {"a": {"frequency": 1.0}}}, "data.base_motion needs either"),
        ("data/payload", {"x": 0.1}, "unknown key 'data.payload': data has folder, units"),
        ("data/payload_at", {"x": 0.07003}, "no vertex lies within"),
        ("data/payload_at", {"x": 0.0}, "data.payload_at names fixed vertices alone"),
        ("data/payload_at", {"w": 0.0}, "unknown key 'data.payload_at.w'"),
        ("data/payload_at", {"x": "tip"}, "data.payload_at.x is 'tip': it must be a finite number"),
        ("data/payload_at", None, "a trial has a payload, but data.payload_at is not set"),
        ("data/trials", {}, "recordings is no folder: set data.folder to that of the recordings"),
        ("data/trials", {"a/b": TRIALS["a"]}, "data.trials.a/b: files are named after trials"),
        ("data/trials", {7: TRIALS["a"]}, "data.trials.7: files are named after trials"),
        (
            "data/trials",
            {"a": {"payload": 0.0}},
            "data.trials.a.file is missing: give the name of a file in data.folder",
        ),
        ("data/trials", {"a": 3}, "data.trials.a is 3: it must be a group of settings"),
        (
            "data/trials",
            {"a": TRIALS["a"] | {"colour": 1}},
            "unknown key 'data.trials.a.colour': data.trials.a has file",
        ),
        (
            "data/trials",
            {"a": TRIALS["a"] | {"begins": "now"}},
            "data.trials.a.begins is 'now': it must be one of held",
        ),
        ("data/trials", {"a": {"file": 3, "payload": 0.0}}, "data.trials.a.file is 3: it must be the name of a file"),
        ("data/trials", {"a": {"file": "a.c3d", "payload": -0.1}}, "data.trials.a.payload is -0.1: it must be a mass"),
        ("data/trials", {"a": TRIALS["a"], "b": TRIALS["a"]}, "the trials 'a' and 'b' have the same file, a.c3d"),
        ("data/trials", {"a": TRIALS["a"]}, "data.folds is leave_one_out, which needs two trials"),
        ("markers/bind", "glue", "markers.bind is 'glue': it must be one of normal, frame, rigid"),
        ("markers/bind_to", None, "markers.bind is rigid: set markers.bind_to"),
        ("markers/bind_to", {"x": 0.07003}, "no vertex lies within"),
        ("markers/tracked", {}, "markers.tracked is empty"),
        ("markers/tracked/Tip - 1", [0.1, 0.0], r"markers.tracked.Tip - 1 is \[0.1, 0.0\]: it must be three numbers"),
        (
            "markers/reference/Tip - 1",
            [0.1, 0.0, 0.0],
            "the marker 'Tip - 1' is in markers.tracked and markers.reference",
        ),
        ("markers/reference", {"Base - 1": [0, 0, 0], "Base - 2": "x"}, "markers.reference.Base - 2 is 'x'"),
        ("markers/largest_residual", -1.0, "markers.largest_residual is -1.0: it must be a positive number"),
        ("published/simulation/colour", 1.0, "published.simulation: corotated has no constant 'colour': it has"),
        ("published/simulation/density", [1e3], r"published.simulation.density is \[1000.0\]: it must be a number"),
        ("published/simulation/model", ["red"], r"published.simulation.model is \['red'\]: it must be a word"),
        ("published/simulation/poissons_ratio", 0.6, "published.simulation: poissons_ratio is 0.6"),
        ("published/physics/mass", "heavy", "published.physics.mass is 'heavy': it must be one of row_sum"),
        ("published/physics", {"mass": "row_sum"}, "published.physics.volume_integration is missing"),
        ("release", None, "release is None: it must be a group of settings"),
        ("release/window", "x", "release.window is 'x': it must be a positive number"),
        ("data/rest", "file", "release.sideways is 0.002 m, but data.rest is file"),
        ("gravity", [0.0, 0.0, 0.0], "release.sideways is across gravity, but gravity is zero"),
        ("data/limit", {"train": 2}, "data.limit.validation is missing"),
        (
            "data/limit",
            {"train": 0, "validation": 1, "test": 1},
            "data.limit.train is 0: it must be a whole number, one",
        ),
        ("data/limit", 2, "data.limit is 2: it must be a group of settings"),
        ("release/sideways", -1.0, "release.sideways is -1.0: it must be a number, zero or more"),
        ("identify/substeps", 0, "identify.substeps is 0: it must be a whole number, one or more"),
        ("release/colour", 1, "unknown key 'release.colour': release has hold_modes"),
        ("in_the_loop/epochs", 0, "in_the_loop.epochs is 0: it must be a whole number, one or more"),
        ("identify/starts", "two", "identify.starts is 'two': it must be a whole number"),
        ("identify/parameters", {}, "identify.parameters is empty"),
        ("identify/parameters/colour", {"lower": 0.0, "upper": 1.0}, "identify.parameters names 'colour'"),
        (
            "identify/elastic/density",
            {"lower": 0.0, "upper": 1.0},
            "identify.elastic names .density.: choose from youngs",
        ),
        ("identify/parameters/density", {"lower": 0.0}, "identify.parameters.density.upper is missing"),
        (
            "identify/parameters/density",
            {"lower": 2.0, "upper": 1.0},
            "identify.parameters.density: the bounds 2 and 1",
        ),
        ("identify/grid/youngs_modulus/points", 0, "identify.grid.youngs_modulus.points is 0"),
        ("identify/grid/youngs_modulus/lower", 1e9, "identify.grid.youngs_modulus: the bounds"),
        ("identify/first_guess/mass_damping", 50.0, "identify.first_guess.mass_damping is 50.0: .* from 0 to 10"),
        ("identify/first_guess/colour", 1.0, "identify.first_guess names 'colour'"),
        ("published/integrator", "euler", "published.integrator is 'euler': it must be one of"),
    ],
)
def test_configuration_of_recordings_is_checked(key, value, message):
    config = changed(configuration("data.folder=recordings"), key, value)
    with pytest.raises(ResphysError, match=message):
        check_configuration(config)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("laboratory", None, "data.folder is not set: give the folder of the recordings"),
        ("data/rest", "file", "data.rest is file, but simulated bodies are held undeformed: set it to held"),
        ("laboratory/tilt", 45.0, "laboratory.tilt is 45.0: it must be an angle from 0 to 20 degrees"),
        ("laboratory/seconds", 1.0, "laboratory.seconds is 1.0, less than data.seconds"),
        (
            "laboratory/material/youngs_modulus",
            "soft",
            "laboratory.material.youngs_modulus is 'soft': it must be a number",
        ),
        ("laboratory/material/stiffness_damping", -1.0, "laboratory.material: stiffness_damping is -1"),
        ("laboratory/integrator", "rk4", "laboratory.integrator is 'rk4'"),
        ("laboratory/trials/m0", {"payload": -0.01}, "laboratory.trials.m0.payload is -0.01"),
        ("laboratory/test", [], "laboratory.test is empty: name one of laboratory.trials"),
        ("laboratory/test", ["m10", "m99"], "laboratory.test names the trial 'm99', which is not in laboratory.trials"),
        ("laboratory/test", ["m10", "m20"], "the trial 'm20' is in laboratory.train and laboratory.test"),
        ("laboratory/test", ["m10", "m10"], "the trial 'm10' is twice in laboratory.test"),
        ("laboratory/mesh/kind", "sphere", "mesh.kind is 'sphere'"),
    ],
)
def test_configuration_of_a_simulated_laboratory_is_checked(key, value, message):
    with pytest.raises(ResphysError, match=message):
        check_configuration(changed(configuration(), key, value))


GROUPS = ("physics", "solver", "reconstruction", "network", "trainer", "budget")
OPTIONS = [(group, path.stem) for group in GROUPS for path in sorted((ROOT / "conf" / group).glob("*.yaml"))]


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_goes_with_recordings(group, option):
    check_configuration(configuration(f"{group}={option}", *(["trainer=sequences"] if option == "recurrent" else [])))


@pytest.mark.parametrize("experiment", ["beam_real", "beam_synthetic", "beam_real_repeated"])
def test_refinement_goes_with_recordings(experiment):
    check_configuration(configuration("refinement=solver_in_the_loop", "data.folder=recordings", experiment=experiment))


def test_a_trial_without_a_payload_carries_none(tmp_path):
    trials = {"a": {"file": "a.c3d"}, "b": {"file": "b.c3d", "payload": 0.1, "begins": "released"}}
    config = changed(
        configuration(f"data.folder={tmp_path}", "data.rest=file", "release.sideways=0"), "data/trials", trials
    )
    check_configuration(config)
    assert [(trial.payload, trial.begins) for trial in trials_of(config)] == [(0.0, "held"), (0.1, "released")]


def test_a_folder_without_a_list_gives_all_its_recordings(tmp_path):
    for name in ("b.c3d", "a.h5", "c.txt"):
        (tmp_path / name).touch()
    config = changed(configuration(f"data.folder={tmp_path}"), "data/trials", {})
    check_configuration(config)
    assert [(trial.name, trial.file) for trial in trials_of(config)] == [
        ("a", tmp_path / "a.h5"),
        ("b", tmp_path / "b.c3d"),
    ]


def test_bodies_of_the_laboratory_are_held_undeformed_or_pulled():
    config = configuration("data.rest=file", "release.sideways=0")
    with pytest.raises(InputError, match=r"data\.rest is file, but simulated bodies are held undeformed: set it to"):
        check_configuration(config)
    pulled = configuration("release.sideways=0")
    pulled["laboratory"]["trials"]["m10"]["pull"] = [0.0, 0.1, 0.0]
    with pytest.raises(InputError, match=r"laboratory\.trials\.m10\.pull deforms the body .*: set data\.rest to file"):
        check_configuration(pulled)
    for trial in config["laboratory"]["trials"].values():
        trial["pull"] = [0.0, 0.1, 0.0]
    check_configuration(config)


def test_folds_and_splits(tmp_path):
    config = configuration(f"data.folder={tmp_path}")
    folds = folds_of(config)
    assert {name: fold.test for name, fold in folds.items()} == {
        name: (name,) for name in ("bare", "load52", "load101")
    }
    assert folds["load52"].train == ("bare", "load101")
    config["data"] |= {"folds": None, "train": ["load101", "bare"], "test": ["load52"]}
    check_configuration(config)
    assert folds_of(config) is None
    assert [trial.name for trial in trials_of(config)] == ["load101", "bare", "load52"] == list(split_of(config).names)
    assert trials_of(config)[1].file == tmp_path / "beam_gravity_V2_a.c3d"
    config["data"]["train"] = []
    with pytest.raises(InputError, match=r"data\.train is empty: .* or set data\.folds to leave_one_out"):
        check_configuration(config)


def test_the_rest_of_a_trial_that_is_learned_from_in_part_may_be_the_test():
    config = configuration("experiment=fish_tail", "data.folder=recordings")
    assert split_of(config) == Split(("step",), (), ("step",))
    assert [trial.name for trial in trials_of(config)] == ["step"]
    config["data"]["train_fraction"] = 1.0
    with pytest.raises(InputError, match=r"the trial 'step' is in data\.train and data\.test: every trial is in one"):
        split_of(config)


def test_a_budget_takes_fewer_simulated_trials():
    split = split_of(configuration("budget=quick"))
    assert [len(part) for part in (split.train, split.validation, split.test)] == [3, 1, 1]


def test_a_budget_takes_fewer_folds():
    settings = ["data.folder=recordings", "budget=quick"]
    assert {name: fold.train for name, fold in folds_of(configuration(*settings)).items()} == {
        "bare": ("load52", "load101")
    }
    folds = folds_of(configuration(*settings, "data.limit.test=2", "data.limit.train=1"))
    assert {name: fold.train for name, fold in folds.items()} == {"bare": ("load52",), "load101": ("bare",)}


def test_the_quick_budget_wins_over_the_experiment_and_the_command_line_over_both():
    config = configuration("budget=quick", "data.folder=recordings", experiment="beam_real_repeated")
    check_configuration(config)
    identify = config["identify"]
    assert identify["starts"] * identify["max_evaluations"] <= 8
    assert np.prod([axis["points"] for axis in identify["grid"].values()]) <= 21
    assert (config["in_the_loop"]["epochs"], config["in_the_loop"]["penalty"]) == (2, 1e-3)
    assert config["data"]["seconds"] == 0.7
    given = configuration("budget=quick", "in_the_loop.epochs=7", "data.seconds=1", experiment="beam_real_repeated")
    assert (given["in_the_loop"]["epochs"], given["data"]["seconds"]) == (7, 1)
    full = configuration("budget=full", experiment="beam_real_repeated")
    assert (full["in_the_loop"]["epochs"], full["data"]["seconds"]) == (10, 1.4)


@pytest.mark.parametrize("experiment", ["beam_oscillation", "beam_twist", "marker_ablation"])
def test_the_quick_budget_of_recordings_is_not_that_of_simulations(experiment):
    full, quick = (dict(dotted(configuration(f"budget={name}", experiment=experiment))) for name in ("full", "quick"))
    limit = {"data.limit.train": 5, "data.limit.validation": 1, "data.limit.test": 2}
    rest = {"budget": "quick", "data.steps": 60, "trainer.epochs": 200, "trainer.rollout_every": 50}
    assert {key: value for key, value in quick.items() if full.get(key) != value} == limit | rest
    assert full.keys() - quick.keys() == {"data.limit"}


@pytest.mark.parametrize("experiment", ["beam_real", "beam_real_repeated", "beam_synthetic"])
@pytest.mark.parametrize(
    ("group", "option"), [("network", "published"), ("network", "reduced"), ("trainer", "published")]
)
def test_a_network_or_trainer_on_the_command_line_is_taken_whole(experiment, group, option):
    wanted = configuration(f"{group}={option}", experiment="beam_oscillation")[group]
    config = configuration(f"{group}={option}", experiment=experiment)
    assert config[group] == wanted
    assert training_settings(config, "simfree")[group] == wanted
    other = "network" if group == "trainer" else "trainer"
    assert config[other] == configuration(experiment=experiment)[other]


@pytest.mark.parametrize(
    ("experiment", "modes", "layers"),
    [("beam_real", [2, 2, 2], 0), ("beam_real_repeated", [3, 3, 6], 0), ("beam_synthetic", [3, 3, 4], 2)],
)
def test_without_a_choice_few_recordings_train_a_small_network(experiment, modes, layers):
    config = configuration(experiment=experiment)
    check_configuration(config | {"data": config["data"] | ({} if layers else {"folder": "recordings"})})
    names = ("position_modes", "velocity_modes", "force_modes")
    small = {"kind": "reduced", "blocks": 1, "layers": layers, "width": 16}
    small |= {"activation": "normalised_elu", "force_basis": "force"}
    assert config["network"] == small | dict(zip(names, modes, strict=True))
    simfree = training_settings(config, "simfree")
    own = {"position_modes": 6, "velocity_modes": 6, "layers": 3, "width": 128}
    assert simfree["network"] == config["network"] | own
    default = configuration(experiment="beam_oscillation")["trainer"]
    assert simfree["trainer"] == default | {"epochs": 200, "rollout_every": 20}
    assert config["trainer"] == default


def test_the_identification_of_e_and_nu_alone_can_be_left_out():
    config = configuration("identify.elastic=null", "~identify.parameters.mass_damping", "data.folder=recordings")
    check_configuration(config)
    assert config["identify"]["elastic"] is None
    assert list(config["identify"]["parameters"]) == ["youngs_modulus", "stiffness_damping"]


@pytest.mark.parametrize("experiment", ["beam_oscillation", "beam_real", "sopra"])
def test_a_material_may_leave_out_its_model_and_its_constants(experiment):
    config = configuration(experiment=experiment)
    for material in ({}, {"youngs_modulus": 2e5}, {"model": "stable_neo_hookean", "density": 1000.0}):
        check_configuration(config | {"simulation": material})
    with pytest.raises(InputError, match=r"its own weight would strain it by .* or that of youngs_modulus not Pa"):
        check_configuration(config | {"simulation": {"youngs_modulus": 264.0}})


def test_a_material_without_youngs_modulus_is_believed_or_not():
    config = configuration(experiment="beam_oscillation")
    check_configuration(config | {"simulation": {"model": "mooney_rivlin"}})
    with pytest.raises(InputError, match=r"with E = 0.264 kPa its own weight would strain it by .* that of c10 not Pa"):
        check_configuration(config | {"simulation": {"model": "mooney_rivlin", "c10": 36.0, "c01": 8.0}})


def test_an_experiment_may_choose_its_network(tmp_path):
    place = tmp_path / "experiment" / "own.yaml"
    place.parent.mkdir()
    place.write_text(
        "# @package _global_\ndefaults: [beam_real, override /network: reduced, _self_]\nnetwork: {force_modes: 4}\n"
    )
    at = f"hydra.searchpath=[file://{tmp_path}]"
    reduced = configuration("network=reduced", experiment="beam_oscillation")["network"]
    assert configuration(at, experiment="own")["network"] == reduced | {"force_modes": 4}
    assert configuration(at, "network=published", experiment="own")["network"]["kind"] == "nodal"


def test_vertical():
    np.testing.assert_array_equal(vertical("-y"), [0.0, -1.0, 0.0])
    np.testing.assert_array_equal(vertical([0.0, 0.0, 2.0]), vertical("z"))
