"""The wheel, installed outside of the repository; dependencies come from the tests' environment."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
import yaml

from support.main_job import IN_RUN, TINY

REPOSITORY = Path(__file__).parents[1]


VERSION = "9.8.7"  # of the wheel, which is built from a copy without git


def can_build():
    """Whether what builds the wheel is installed: setuptools-scm,
    and a setuptools that is new enough.
    """
    try:
        return int(version("setuptools").partition(".")[0]) >= 77 and bool(
            version("setuptools-scm")
        )
    except PackageNotFoundError:
        return False


pytestmark = pytest.mark.skipif(
    not can_build(),
    reason="building the wheel takes setuptools 77 and setuptools-scm: pip install -U setuptools "
    "setuptools-scm",
)


def call(*command, folder, **environment):
    """Runs a command without the repository on its path, and returns its output."""
    inherited = {
        k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    }
    result = subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        env={**inherited, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of what the package is built from, so that no build folder is left in the
    repository.
    """
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, source)
    for name in ("warp_resphys", "kernels", "conf"):
        shutil.copytree(
            REPOSITORY / name, source / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    return source


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory):
    """The wheel."""
    target = tmp_path_factory.mktemp("wheel")
    offline = (
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
        "--quiet",
        "--disable-pip-version-check",
    )
    build = (sys.executable, "-m", "pip", "wheel", *offline, "--wheel-dir", target, source)
    call(*build, folder=target, SETUPTOOLS_SCM_PRETEND_VERSION_FOR_WARP_RESPHYS=VERSION)
    (built,) = target.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Folder of the commands of a fresh virtual environment with the wheel in it."""
    root = tmp_path_factory.mktemp("environment")
    call(sys.executable, "-m", "venv", "--without-pip", root, folder=root)
    commands = root / ("Scripts" if os.name == "nt" else "bin")
    offline = ("--no-deps", "--no-index", "--quiet", "--disable-pip-version-check")
    pip = (sys.executable, "-m", "pip", "--python", commands / "python")
    call(*pip, "install", *offline, wheel, folder=root)
    site = call(
        commands / "python",
        "-c",
        "import sysconfig; print(sysconfig.get_path('purelib'))",
        folder=root,
    )
    # A plain path: the .pth files behind it, such as those of an editable install, are not read.
    Path(site.strip(), "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return commands


def test_the_wheel_holds_every_module_and_configuration(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    for folder, package in (("warp_resphys", ""), ("kernels", "kernels/"), ("conf", "conf/")):
        for suffix in (".py", ".yaml", ".html", ".js", ".md", ".msh", ".xml", "py.typed"):
            for path in (REPOSITORY / folder).rglob(f"*{suffix}"):
                assert (
                    f"warp_resphys/{package}{path.relative_to(REPOSITORY / folder).as_posix()}"
                    in names
                )
    metadata = {name for name in names if ".dist-info/" in name}
    assert {name.partition("/")[0] for name in names - metadata} == {"warp_resphys"}
    assert any(name.endswith("LICENSE") for name in metadata)


def test_the_source_archive_holds_kernels_and_configurations_and_a_fallback_version(
    source, tmp_path
):
    build = "import sys; from setuptools.build_meta import build_sdist; build_sdist(sys.argv[1])"
    call(sys.executable, "-c", build, tmp_path, folder=source)
    with open(REPOSITORY / "pyproject.toml", "rb") as settings:
        expected = tomllib.load(settings)["tool"]["setuptools_scm"]["fallback_version"]
    with tarfile.open(tmp_path / f"warp_resphys-{expected}.tar.gz") as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for folder, suffix in (("warp_resphys", "py"), ("kernels", "py"), ("conf", "yaml")):
        assert {
            path.relative_to(REPOSITORY).as_posix()
            for path in (REPOSITORY / folder).rglob(f"*.{suffix}")
        } <= names


@pytest.mark.slow
def test_the_main_job_runs_from_an_empty_folder(installed, tmp_path):
    where = call(
        installed / "python",
        "-c",
        "import warp_resphys; print(warp_resphys.__file__)",
        folder=tmp_path,
    )
    assert Path(where.strip()).is_relative_to(installed.parent)
    out = call(installed / "warp-resphys", *TINY, IN_RUN, folder=tmp_path)
    assert "Report: " in out
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (
        metrics["errors_mm"]["resphys"]["mean"] < 0.1 * metrics["errors_mm"]["simulation"]["mean"]
    )
    assert metrics["versions"]["warp-resphys"] == VERSION
    assert (tmp_path / "run" / "report.html").stat().st_size > 100_000


def test_every_command_says_what_it_does_and_what_it_takes(installed, tmp_path):
    program = """
import contextlib, io, json, sys
heavy = "torch warp scipy matplotlib pyvista vtk meshio trimesh ezc3d"
for name in heavy.split():
    sys.modules[name] = None  # importing it fails
from warp_resphys import cli, commands
helps = {}
for command, entry in commands.COMMANDS.items():
    helps[command] = [entry.purpose]
    for option in ("--help", "--cfg=job"):
        sys.argv = ["warp-resphys", *command.split(), option]
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
            cli.main()
        helps[command].append(out.getvalue())
print(json.dumps(helps))
"""
    helps = json.loads(call(installed / "python", "-c", program, folder=tmp_path))
    keys = {
        "run": "seed",
        "tune": "tune",
        "inspect": "recording",
        "check": "device",
        "view film": "run",
    }
    assert keys.keys() < helps.keys()
    for command, (purpose, text, config) in helps.items():
        assert f"warp-resphys {command}: {purpose}\n" in text or command == "run"
        assert re.search(
            f"^warp-resphys {command} +{purpose}$", helps["run"][1], flags=re.MULTILINE
        )
        assert re.search(f"^warp-resphys {command}( |$)", text, flags=re.MULTILINE)
        assert yaml.safe_load(config).keys() >= {keys.get(command)} - {None}
    assert "budget=quick" in helps["run"][1]
    assert not list(tmp_path.iterdir())


def test_a_copy_of_the_repository_hides_no_part_of_an_installation(installed):
    """Python, started in the repository, imports the copy, with its kernels."""
    program = (
        "import warp_resphys.conf, warp_resphys.kernels as k; print(k.__file__); "
        "warp_resphys.Simulator"
    )
    where = call(installed / "python", "-c", program, folder=REPOSITORY)
    assert Path(where.strip()).parent == REPOSITORY / "kernels"
