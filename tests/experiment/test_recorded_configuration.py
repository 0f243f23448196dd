"""Configurations of experiments on recordings: what is refused,
what a budget changes, and which choice wins.
"""

import re
from pathlib import Path

import pytest
import yaml

from support.command_line import outcome
from support.configured import check, composed, settings
from support.refusals import refuses
from warp_resphys.experiment.checks import check_run
from warp_resphys.experiment.splits import folds_of, split_of, trials_of
from warp_resphys.io.errors import InputError, ResphysError
from warp_resphys.io.settings import parse
from warp_resphys.settings.performed import Split
from warp_resphys.settings.run import RunSettings

REAL = ("experiment=beam_real", "data.folder=recordings")


def changed(config, key, value):
    """A configuration with another value of a key, written with slashes,
    as markers' names have dots.
    """
    *path, last = key.split("/")
    group = config
    for name in path:
        group = group[name]
    group[last] = value
    return config


TRIALS = {"a": {"file": "a.c3d", "payload": 0.0}, "b": {"file": "b.c3d", "payload": 0.1}}
WHOLE = {"lower": 0.0, "upper": 1.0}
RECORDED = [
    ("data/up", [0.0, 0.0, 0.0], "data.up is"),
    (
        "data/base_motion",
        {"about": [0.0, 0.0, 0.0]},
        "data.base_motion.file and swings: give one of them",
    ),
    ("data/base_motion", {"swings": {}}, "data.base_motion.swings is empty"),
    ("data/payload_at", {"x": 0.07003}, "no vertex lies within"),
    ("data/payload_at", {"x": 0.0}, "data.payload_at selects fixed vertices only"),
    ("data/payload_at", None, "a trial has a payload, but data.payload_at is not set"),
    ("data/trials", {}, "recordings is not a folder: set data.folder"),
    ("data/trials", {"a/b": TRIALS["a"]}, "data.trials.*a/b cannot name a trial"),
    ("data/trials", {"a": {"payload": 0.0}}, "data.trials.a.file is missing"),
    (
        "data/trials",
        {"a": TRIALS["a"], "b": TRIALS["a"]},
        "the trials 'a' and 'b' have the same file, a.c3d",
    ),
    (
        "data/trials",
        {"a": TRIALS["a"]},
        "data.folds is leave_one_out, which needs at least two trials",
    ),
    ("data/rest", "file", "release.sideways is 0.002 m, but data.rest is file"),
    ("data/seconds", None, "data.seconds is not set"),
    ("markers/bind_to", None, "markers.bind is rigid: set markers.bind_to"),
    (
        "markers/reference/Tip - 1",
        [0.1, 0.0, 0.0],
        "markers.tracked and markers.reference both have 'Tip - 1'",
    ),
    ("markers", None, "markers is null, but data.kind is recorded"),
    (
        "published/simulation/colour",
        1.0,
        "published.simulation: corotated has no parameter 'colour'",
    ),
    ("gravity", [0.0, 0.0, 0.0], "release.sideways is across gravity, but gravity is zero"),
    (
        "identify/parameters/colour",
        WHOLE,
        "identify.parameters: there is no parameter 'colour' to identify",
    ),
    (
        "identify/elastic/density",
        WHOLE,
        "identify.elastic: there is no parameter 'density' to identify",
    ),
    (
        "identify/parameters/density",
        {"lower": 2.0, "upper": 1.0},
        "identify.parameters.density.lower is 2",
    ),
    (
        "identify/first_guess/mass_damping",
        50.0,
        "identify.first_guess.mass_damping is 50: .* from 0 to 10",
    ),
    (
        "identify/first_guess/colour",
        1.0,
        "identify.first_guess: there is no parameter 'colour' to identify",
    ),
]
PLAYED = [
    ("laboratory", None, "data.folder is not set: give the folder of the recordings"),
    ("laboratory/seconds", 1.0, "laboratory.seconds is 1.0, less than data.seconds"),
    ("laboratory/material/stiffness_damping", -1.0, "laboratory.material: stiffness_damping is -1"),
    ("laboratory/test", [], "laboratory.test is empty: add at least one of laboratory.trials"),
    ("laboratory/test", ["m10", "m99"], "laboratory.test names the trial 'm99'"),
    (
        "laboratory/test",
        ["m10", "m20"],
        "the trial 'm20' is in laboratory.train and laboratory.test",
    ),
    ("laboratory/test", ["m10", "m10"], "the trial 'm10' is twice in laboratory.test"),
]


@pytest.mark.parametrize(
    ("base", "key", "value", "said"),
    [(REAL, *case) for case in RECORDED] + [(REAL[:1], *case) for case in PLAYED],
)
def test_a_configuration_is_checked(base, key, value, said):
    refuses(ResphysError, said, check, changed(composed(*base), key, value))


@pytest.mark.parametrize(
    "fits",
    [
        ("data.rest=file", "data.begins=static", "data.axes=[x,y,z]"),  # nothing is released
        ("gravity=[0,0,0]", "data.begins=static", "data.axes=[x,y,z]"),
        ("+data.steps=10", "data.horizons=[0.3]"),  # steps are those of driven trials
    ],
)
def test_settings_of_releases_and_of_driven_trials_are_for_those_alone(fits):
    check(composed(*REAL, *fits))


def test_bodies_of_the_laboratory_are_held_undeformed_or_pulled():
    pulled = composed("experiment=beam_real", "release.sideways=0")
    pulled["laboratory"]["trials"]["m10"]["pull"] = [0.0, 0.1, 0.0]
    with pytest.raises(
        InputError,
        match=r"laboratory\.trials\.m10\.pull deforms the body .*: set data\.rest to file",
    ):
        check(pulled)
    trials = pulled["laboratory"]["trials"]
    for pull in ([0.0, 0.1, 0.0], None):
        trials["m10"]["pull"] = pull
        with pytest.raises(
            InputError, match=r"data\.rest is file, but the simulated bodies are held undeformed"
        ):
            check(changed(pulled, "data/rest", "file"))
    for trial in trials.values():
        trial["pull"] = [0.0, 0.1, 0.0]
    check(changed(pulled, "data/rest", "file"))


def test_a_folder_without_a_list_gives_all_its_recordings(tmp_path):
    for name in ("b.c3d", "a.h5", "c.txt"):
        (tmp_path / name).touch()
    run = parse(
        RunSettings,
        changed(composed("experiment=beam_real", f"data.folder={tmp_path}"), "data/trials", {}),
    )
    check_run(run)
    results = [(trial.name, trial.file) for trial in trials_of(run)]
    assert results == [("a", str(tmp_path / "a.h5")), ("b", str(tmp_path / "b.c3d"))]


def test_folds_and_splits(tmp_path):
    config = composed("experiment=beam_real", f"data.folder={tmp_path}")
    folds = folds_of(parse(RunSettings, config))
    names = ("bare", "load52", "load101")
    assert {name: fold.test for name, fold in folds.items()} == {name: (name,) for name in names}
    assert folds["load52"].train == ("bare", "load101")
    config["data"] |= {"folds": None, "train": ["load101", "bare"], "test": ["load52"]}
    run = parse(RunSettings, config)
    check_run(run)
    assert folds_of(run) is None
    assert (
        [trial.name for trial in trials_of(run)]
        == ["load101", "bare", "load52"]
        == list(split_of(run).names)
    )
    assert trials_of(run)[1].file == str(tmp_path / "beam_gravity_V2_a.c3d")
    config["data"]["test"] = "others"
    assert split_of(parse(RunSettings, config)) == Split(
        train=["load101", "bare"], validation=[], test=["load52"]
    )
    config["data"] |= {"train": "others", "test": ["bare"]}
    assert split_of(parse(RunSettings, config)) == Split(
        train=["load52", "load101"], validation=[], test=["bare"]
    )
    config["data"]["validation"] = "others"
    refuses(InputError, r"data\.train is others, .* give these as lists", check, config)
    config["data"] |= {"train": [], "validation": []}
    refuses(
        InputError, r"data\.train is empty: .* or set data\.folds to leave_one_out", check, config
    )
    named = {"train": ["bare", "load52"], "validation": [], "test": ["load101"]}
    config["data"] |= {"splits": {"heavier": named}, "split": "heavier"}  # in place of the lists
    assert split_of(parse(RunSettings, config)) == Split(**named)
    config["data"]["folds"] = "leave_one_out"
    refuses(InputError, "split and folds exclude each other", check, config)
    config["data"]["folds"] = None
    named["test"] = ["load102"]
    refuses(
        InputError,
        r"data\.splits\.heavier\.test names .*'load102', .* not in data\.trials",
        check,
        config,
    )
    config["data"]["split"] = "lighter"
    refuses(ResphysError, r"data\.split is 'lighter': choose from heavier", check, config)


def test_the_frozen_splits_of_the_real_arm_share_no_trial_and_test_other_motions_or_another_day():
    days = {}
    for name in ("within", "to_long", "to_large"):
        run = settings("experiment=sopra_real", "data.folder=recordings", f"data.split={name}")
        check_run(run)
        days[name] = [
            {run.data.trials[trial].session for trial in part}
            for part in dict(split_of(run)).values()
        ]
    assert days["within"] == days["to_long"] == [{"day_21"}] * 3
    assert days["to_large"] == [{"day_21"}, {"day_21"}, {"day_20"}]


def test_the_rest_of_a_trial_that_is_learned_from_in_part_may_be_the_test():
    run = settings("experiment=fish_tail", "data.folder=recordings")
    assert split_of(run) == Split(train=["step"], validation=[], test=["step"])
    assert [trial.name for trial in trials_of(run)] == ["step"]
    with pytest.raises(InputError, match=r"data\.train"):
        split_of(
            settings("experiment=fish_tail", "data.folder=recordings", "data.train_fraction=1")
        )


def test_the_quick_budget_takes_fewer_folds_and_wins_but_over_the_command_line():
    folds = folds_of(settings(*REAL, "budget=quick"))
    assert {name: fold.train for name, fold in folds.items()} == {"bare": ("load52", "load101")}
    folds = folds_of(settings(*REAL, "budget=quick", "data.limit.test=2", "data.limit.train=1"))
    assert {name: fold.train for name, fold in folds.items()} == {
        "bare": ("load52",),
        "load101": ("bare",),
    }
    repeated = ("experiment=beam_real_repeated", "data.folder=recordings")
    run = settings(*repeated, "budget=quick")
    check_run(run)
    assert run.identify.starts * run.identify.max_evaluations <= 8
    assert (run.in_the_loop.epochs, run.in_the_loop.penalty) == (2, 1e-3)
    assert run.data.seconds == 0.7
    given = settings(*repeated, "budget=quick", "in_the_loop.epochs=7", "data.seconds=1")
    assert (given.in_the_loop.epochs, given.data.seconds) == (7, 1)
    full = settings(*repeated, "budget=full")
    assert (full.in_the_loop.epochs, full.data.seconds) == (10, 1.4)


def own_settings(name, text, *overrides):
    """Settings of an experiment in the working directory, as `--cfg job` prints them."""
    path = Path("configs", "experiment", f"{name}.yaml")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"# @package _global_\nname: {name}\n{text}", encoding="utf-8")
    ended = outcome("--cfg", "job", f"experiment={name}", *overrides)
    assert ended.err == ""
    return yaml.safe_load(ended.out)


def test_a_group_that_an_experiment_sets_to_null_stays_null_with_the_quick_budget(folder):
    beam = "defaults: [beam_real, _self_]\nidentify: null\nin_the_loop: null\n"
    run = own_settings("beam", beam, "budget=quick")
    assert (run["identify"], run["in_the_loop"], run["data"]["seconds"]) == (None, None, 0.7)
    run = own_settings("beam", beam, "budget=quick", "in_the_loop.epochs=7")
    assert (run["identify"], run["in_the_loop"]["epochs"]) == (None, 7)
    again = (
        "defaults: [beam, _self_]\n"
        "identify: {parameters: {youngs_modulus: {lower: 1.0e5, upper: 1.0e6}}}\n"
    )
    run = own_settings("again", again, "budget=quick")
    assert [*run["identify"]["parameters"]] == ["youngs_modulus"]
    assert run["in_the_loop"] is None


def test_whole_recordings_of_a_driven_robot_determine_its_stiffness_and_no_poissons_ratio(folder):
    page = (Path(__file__).parents[2] / "docs" / "actuators.md").read_text(encoding="utf-8")
    _, mine = re.search(
        r"```yaml\n# @package _global_\n(defaults:.*?name: my_arm\n)(.*?)```", page, re.DOTALL
    ).groups()
    identify = own_settings(
        "my_arm", f"defaults: [/recordings: pressure, override /mesh: file, _self_]\n{mine}"
    )["identify"]
    assert [*identify["parameters"]] == ["youngs_modulus"]
    assert identify["seconds"] is None


@pytest.mark.parametrize(("group", "option"), [("network", "published"), ("trainer", "published")])
def test_a_network_or_trainer_on_the_command_line_is_taken_whole(group, option):
    wanted = getattr(settings(f"{group}={option}"), group)
    run = settings("experiment=beam_synthetic", f"{group}={option}")
    assert getattr(run, group) == getattr(run.simfree, group) == wanted
    other = "network" if group == "trainer" else "trainer"
    assert getattr(run, other) == getattr(settings("experiment=beam_synthetic"), other)


@pytest.mark.parametrize("experiment", ["beam_oscillation", "tendon_rod", "finger", "sopra"])
def test_an_experiment_with_its_own_reconstruction_may_do_without(experiment):
    assert settings(f"experiment={experiment}").reconstruction is not None
    run = settings(f"experiment={experiment}", "reconstruction=none")
    assert run.reconstruction is None
    assert {"simfree", "resphys_uncorrected"}.isdisjoint(run.models)


def test_a_material_may_leave_out_its_model_and_its_parameters_and_is_believed_or_not():
    config = composed()
    for material in (
        {},
        {"youngs_modulus": 2e5},
        {"model": "stable_neo_hookean", "density": 1000.0},
    ):
        check(composed("experiment=sopra") | {"simulation": material})
        check(config | {"simulation": material})
    check(config | {"simulation": {"model": "mooney_rivlin"}})
    for soft, said in (
        (
            {"youngs_modulus": 264.0},
            "its own weight would strain it by .* or that of youngs_modulus not Pa",
        ),
        (
            {"model": "mooney_rivlin", "c10": 36.0, "c01": 8.0},
            "with E = 0.264 kPa its own weight .* of c10 not Pa",
        ),
    ):
        refuses(InputError, said, check, config | {"simulation": soft})


def test_an_experiment_may_choose_its_network(tmp_path):
    place = tmp_path / "experiment" / "own.yaml"
    place.parent.mkdir()
    place.write_text(
        "# @package _global_\ndefaults: [beam_real, override /network: reduced, "
        "_self_]\nnetwork: {force_modes: 4}\n"
    )
    own = (f"hydra.searchpath=[file://{tmp_path}]", "experiment=own")
    assert settings(*own).network == settings("network=reduced").network.changed(force_modes=4)
    assert settings(*own, "network=published").network.kind == "nodal"


CONF = Path(__file__).parents[2] / "conf"


def keys_of(file):
    """Dotted names of the keys that a file of conf/ sets, and the names of those it extends."""
    content = yaml.safe_load((CONF / file).read_text(encoding="utf-8"))
    extended = [
        entry
        for entry in content.pop("defaults", [])
        if isinstance(entry, str) and entry != "_self_"
    ]
    return [*_dotted(content)], extended


def _dotted(group):
    for name, value in group.items():
        parts = _dotted(value) if isinstance(value, dict) and value else [""]
        yield from (f"{name}.{part}".rstrip(".") for part in parts)


def no_key_twice(files):
    keys = [key for file in files for key in keys_of(file)[0]]
    assert len(keys) == len({*keys})
    return keys


@pytest.mark.parametrize("kind", ["released", "pressure", "poses", "record"])
def test_a_kind_of_trials_and_the_files_that_it_extends_set_no_key_twice(kind):
    files = [f"recordings/{kind}.yaml"]
    for file in files:
        files += [f"recordings/{name}.yaml" for name in keys_of(file)[1]]
    assert files[-1] == "recordings/common.yaml"
    assert "data.kind" in no_key_twice(files)


@pytest.mark.parametrize("origin", sorted(path.stem for path in (CONF / "trial_source").iterdir()))
def test_a_budget_changes_a_key_in_one_file(origin):
    changes = (f"budget_on/{origin}_quick.yaml", "control_on/figures_quick.yaml")
    assert {"budget", "trainer.epochs"} < {*no_key_twice(("budget/quick.yaml", *changes))}
