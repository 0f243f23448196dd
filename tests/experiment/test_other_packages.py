"""The package of docs/examples in an experiment from YAML:
all its classes act, and its parameters are identified.
"""

import importlib.util
import re
import shutil
import sys
import tomllib
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from torch import nn

import warp_resphys
from support.configured import check, composed, settings
from support.main_job import run_without_report
from warp_resphys.core.dynamics.gradient_check import check_gradients
from warp_resphys.energies import Energy, make_material
from warp_resphys.experiment.build import build_body, build_simulator
from warp_resphys.io.classes import ClassSettings, check_packages
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.io.resuming import Stage, fingerprint
from warp_resphys.io.safe_files import read_checkpoint, read_json
from warp_resphys.io.settings import parse
from warp_resphys.learning.residuals.networks import OwnNetwork
from warp_resphys.robot.description import describe
from warp_resphys.settings.run import RunSettings

TEMPLATE = Path(__file__).parents[2] / "docs" / "examples" / "my_robot_physics"
OPTIONS = [
    "experiment=magnetic_beam",
    "budget=quick",
    f"hydra.searchpath=[{(TEMPLATE / 'configs').as_uri()}]",
    *("mesh.divisions=[6,1,1]", "laboratory.mesh.divisions=[6,1,1]", "parallel.processes=1"),
    *("simfree.trainer.epochs=6", "simfree.trainer.rollout_every=6", "trainer.gate=false"),
]


def install(site, version=None):
    """Installs the package in a folder as installers do, without network."""
    project = tomllib.loads((TEMPLATE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = version or project["version"]
    site.mkdir(exist_ok=True)
    shutil.copytree(TEMPLATE / "my_robot_physics", site / "my_robot_physics")
    about = site / f"my_robot_physics-{version}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {version}\n"
    )
    (about / "top_level.txt").write_text("my_robot_physics\n")
    return site


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return install(tmp_path_factory.mktemp("site"))


@pytest.fixture
def installed(site, monkeypatch):
    monkeypatch.syspath_prepend(str(site))
    return site


@pytest.fixture(scope="module")
def folder(site, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        return run_without_report(tmp_path_factory.mktemp("magnetic"), *OPTIONS)


@pytest.mark.slow
def test_its_parameters_are_identified_and_its_network_trained(folder, installed):
    """Weight and magnet bend the beam of the laboratory,
    of 50 kPa and 24 kA/m, from 40 kPa and 30 kA/m.
    """
    found = read_json(folder / "identification.json")["sysid"]["parameters"]
    assert found["magnetisation"] / found["shear_modulus"] == pytest.approx(24.0 / 50.0, rel=0.05)
    assert found["shear_modulus"] == pytest.approx(50e3, rel=0.2)
    errors = read_json(folder / "metrics.json")["errors_mm"]
    assert errors["sysid"]["mean"] < 0.1 * errors["simulation"]["mean"]
    network = describe(folder, "resphys").learned.network
    assert isinstance(network.network, OwnNetwork)
    assert network.architecture["core"] == {"_target_": "my_robot_physics.sines.Sines", "width": 8}
    assert float(network.network.gain.detach().abs().max()) > 0.0
    records = {path.stem: read_json(path) for path in (folder / "stages").glob("*.json")}
    assert {
        name for name, own in records.items() if own["packages"] != {"my-robot-physics": "0.1.0"}
    } == set()


@pytest.mark.slow
def test_a_run_or_a_robot_without_the_package_says_so(folder, installed, tmp_path, monkeypatch):
    robot = warp_resphys.load(folder)
    file = tmp_path / "robot.safetensors"
    robot.save(file)
    assert read_checkpoint(file, "robot")[1]["packages"] == {"my-robot-physics": "0.1.0"}
    moved = [warp_resphys.load(place).settle(magnetic_field=[0.04]).q for place in (folder, file)]
    torch.testing.assert_close(*moved)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place != str(installed)])
    for place in (folder, file):
        with pytest.raises(
            DataFileError,
            match=r"was made with my-robot-physics 0\.1\.0, a package that is not inst",
        ):
            warp_resphys.load(place)


def test_another_version_is_told_and_runs_stages_again(installed, tmp_path, monkeypatch):
    def stage():
        return fingerprint(Stage("evaluate", print, (), settings(*OPTIONS)), {})

    before, packages = stage(), settings(*OPTIONS).packages()
    assert packages == {"my-robot-physics": "0.1.0"}
    check_packages(packages, "run")
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place != str(installed)])
    with pytest.raises(
        DataFileError,
        match=r"run was made with my-robot-physics 0\.1\.0, a package that is not inst",
    ):
        check_packages(packages, "run")
    monkeypatch.syspath_prepend(str(install(tmp_path / "site", version="0.2.0")))
    with pytest.raises(
        DataFileError, match=r"made with my-robot-physics 0\.1\.0, and this is .* 0\.2\.0"
    ):
        check_packages(packages, "run")
    assert settings(*OPTIONS).packages() == {"my-robot-physics": "0.2.0"}
    assert stage() != before


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("simulation.model=arruda", r"model and _target_ are both given"),
        (
            "simulation._target_=arruda",
            r"material model is 'arruda': choose one of corotated, .* class as _target_",
        ),
        (
            "simulation._target_=os.system",
            r"simulation: os\.system cannot be imported .*module of Python itself",
        ),
        (
            "simulation._target_=my_robot_physics.sines.Sines",
            r"Sines is no subclass of .*materials\.Material",
        ),
        ("simulation.locking=3", r"simulation: arruda_boyce has no parameter 'locking'"),
        (
            "energies.magnet._target_=my_robot.Magnet",
            r"energies\.magnet: .* cannot be imported .*No module named",
        ),
        (
            "energies.magnet._target_=my_robot_physics.magnet.Coil",
            r"magnet\.Coil cannot be imported .*no attribute",
        ),
        (
            "energies.magnet._target_=torch.nn.Linear",
            r"Linear is no subclass of warp_resphys\.core\.energies\.base\.Energy",
        ),
        (
            "energies.magnet.magnetisatoin=3",
            r"unknown key 'energies\.magnet\.magnetisatoin', did you mean 'magnetisat",
        ),
        (
            "energies.magnet.magnetisation=null",
            r"energies\.magnet\.magnetisation is missing: it must be a positive",
        ),
        ("markers.bind=frame", r"markers\.observation takes the place of bind and bind_to"),
        (
            "energies.magnet=null",
            r"simulator takes no input: give both the same inputs, by .* or energies",
        ),
        (
            "muscles={commanded: stress, stiffness: 0, bundles: {a: {direction: [1, 0, 0]}}}",
            r"muscles and energies\.magnet are two inputs of the body",
        ),
    ],
)
def test_wrong_settings_are_refused_in_one_sentence(installed, option, message):
    with pytest.raises(InputError, match=message) as told:
        check(composed(*OPTIONS, option))
    assert "\n" not in str(told.value)


def test_an_actuator_drives_the_body_as_its_energy_says(installed):
    """The tip rises with the field, and its derivative
    by the magnetisation equals float64 differences.
    """
    run = settings(*OPTIONS)
    energy = build_body(run).energies[0]
    assert [quantity.name for quantity in energy.inputs] == ["magnetic_field"]
    twice = settings(*OPTIONS, "energies.magnet.magnetisation=60.0e3")
    assert build_body(twice).energies[0].magnetisation == 2.0 * energy.magnetisation
    rubber = make_material("my_robot_physics.material.ArrudaBoyce", shear_modulus=50e3)
    simulator = warp_resphys.Simulator(build_body(run), rubber, gravity=(0.0, 0.0, 0.0))
    tip = simulator.body.mesh.vertices[:, 0] > 0.059

    def height(magnetisation, field):
        inputs = warp_resphys.Inputs(magnetic_field=torch.tensor([[field]], dtype=torch.float64))
        return (
            simulator.static_equilibrium(inputs, {"magnetisation": magnetisation})
            .q[0, tip, 2]
            .mean()
        )

    value = torch.tensor(30e3, dtype=torch.float64, requires_grad=True)
    end = height(value, 0.01)
    (slope,) = torch.autograd.grad(end, value)
    with torch.no_grad():
        across = (height(value + 10.0, 0.01) - height(value - 10.0, 0.01)) / 20.0
        assert float(slope) == pytest.approx(float(across), rel=1e-5)
        assert float(end) > float(height(value, -0.01)) + 1e-3


class Wide(nn.Linear):
    def __init__(self, inputs, outputs):
        super().__init__(inputs, 7)


MODULE = """
import numpy as np
from torch import nn
from warp_resphys.energies import Energy
class Unfinished(Energy):
    pass
class Arrays(nn.Module):
    def __init__(self, x: np.ndarray): pass
"""


def test_classes_that_do_not_fit_are_refused_and_no_other_is_imported_or_called(
    tmp_path, monkeypatch
):
    """A robot's file may name anything; nothing of Python itself is imported."""
    (tmp_path / "bad_physics.py").write_text(MODULE)
    (tmp_path / "worse_physics.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(str(tmp_path))
    for target, base, message in (
        (
            "bad_physics.Unfinished",
            Energy,
            r"here: bad_physics\.Unfinished has no method points and no term: add it",
        ),
        (
            "bad_physics.Arrays",
            nn.Module,
            r"arguments of Arrays cannot be given in a configuration .*ndarray",
        ),
        (
            "worse_physics.Any",
            nn.Module,
            r"worse_physics\.Any cannot be imported \(ZeroDivisionError: division by",
        ),
    ):
        with pytest.raises(InputError, match=message):
            ClassSettings(target=target).factory(base, "here")
    for target in ("subprocess.Popen", "pathlib.Path", "numpy.memmap"):
        with pytest.raises(InputError, match=target):
            ClassSettings(
                target=target, filename=str(tmp_path / "file"), mode="w+", shape=3
            ).factory(nn.Module, "here")
    assert not (tmp_path / "file").exists()
    with pytest.raises(
        InputError,
        match=r"network\.core: \S*Wide maps \(2, 3\) to \(2, 7\): it must map to \(2, 2\)",
    ):
        OwnNetwork(ClassSettings(target=f"{__name__}.Wide"), 3, 2)


def test_the_example_of_the_page_acts(tmp_path, monkeypatch):
    page = (TEMPLATE.parents[1] / "extending.md").read_text(encoding="utf-8")
    python, yaml = (
        re.findall(rf"```{kind}\n(.*?)```", page, re.DOTALL)[0] for kind in ("python", "yaml")
    )
    (tmp_path / "my_physics.py").write_text(python)
    monkeypatch.syspath_prepend(str(tmp_path))
    own = OmegaConf.to_container(OmegaConf.create(yaml))
    own["identify"]["parameters"] |= {"poissons_ratio": None, "youngs_modulus": None}
    config = composed("experiment=beam_real", "mesh.divisions=[4,1,1]")
    config |= {key: own[key] for key in ("simulation", "energies")}
    config["identify"] |= {
        "parameters": own["identify"]["parameters"],
        "elastic": None,
        "first_guess": {},
    }
    check(config)
    run = parse(RunSettings, config)
    simulator = build_simulator(run, run.simulation)
    state = simulator.static_equilibrium()
    assert float((state.q - simulator.rest_positions).abs().max()) > 1e-3
    rows = {
        row.parameter: row.relative_error for row in check_gradients(simulator, "bent", steps=2)
    }
    named = {name.partition(",")[0] for name in rows}
    assert {
        "shear_modulus",
        "stiffening",
        "lame_lambda",
        "spring_stiffness",
        "spring_anchor",
    } <= named
    ours = {name: error for name, error in rows.items() if "damping" not in name}  # These are zero.
    assert max(ours.values()) < 1e-5


@pytest.mark.parametrize(
    "path", sorted((TEMPLATE / "tests").glob("test_*.py")), ids=lambda path: path.stem
)
def test_the_tests_of_the_package_pass(installed, path):
    spec = importlib.util.spec_from_file_location(f"template_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    tests = [own for name, own in vars(module).items() if name.startswith("test_")]
    assert tests
    for own in tests:
        (values,) = [mark.args[1] for mark in getattr(own, "pytestmark", [])] or [[]]
        for arguments in [(value,) for value in values] or [()]:
            own(*arguments)
