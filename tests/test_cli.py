import errno
import functools
import logging
import os
import re
import shlex
import signal
import subprocess
import sys
import textwrap
import types
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from pydantic import ConfigDict

from support.command_line import ended, outcome
from warp_resphys import InputError, __version__, cli, commands
from warp_resphys.commands import NOBODY_READS, run_label
from warp_resphys.io.errors import ResphysWarning
from warp_resphys.io.resuming import StageInterrupted
from warp_resphys.io.setting_errors import keys
from warp_resphys.io.settings import Settings
from warp_resphys.launch import _one_sentence_each
from warp_resphys.overrides import readable
from warp_resphys.settings.run import RunSettings

REPOSITORY = Path(__file__).parents[1]
EXPERIMENT = "warp_resphys.pipeline"
CONFIG = {
    "config.yaml": """
        defaults:
          - _self_
          - material: soft
          - experiment: beam
          - override hydra/job_logging: none
          - override hydra/hydra_logging: none
        name: none
        seed: 0
        solver: {tolerances: {relative: 1e-8, absolute: 0.0}}
        hydra:
          run: {dir: "runs/${name}/${run_label:${hydra:overrides.task},[experiment]}"}
          sweep: {dir: "runs/${name}", subdir: "${run_label:${hydra:overrides.task},[experiment]}"}
        """,
    "material/soft.yaml": "{density: 1070.0, model: {youngs_modulus: 264e3}}",
    "material/stiff.yaml": "{density: 2000.0}",
    "experiment/beam.yaml": "# @package _global_\nname: beam",
    "experiment/beam_twist.yaml": "# @package _global_\nname: beam_twist",
}


@pytest.fixture
def config_dir(tmp_path: Path) -> Path:
    for name, text in CONFIG.items():
        path = tmp_path / "conf" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
    return tmp_path / "conf"


class AnyKeys(Settings):
    """A configuration with any keys."""

    model_config = ConfigDict(extra="allow")


class Command:
    """Runs `warp-resphys` in this process, with a job of the test's choice."""

    def __init__(
        self, config_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        self.job: Callable[[dict[str, Any]], object] = lambda config: None
        self.outputs: list[str] = []
        self.arguments = ["warp-resphys", "--config-path", str(config_dir)]
        self.monkeypatch, self.capsys = monkeypatch, capsys
        experiment = types.ModuleType(EXPERIMENT)
        experiment.run_experiment = self.run  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, EXPERIMENT, experiment)
        monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)

    def run(self, config: AnyKeys, folder: Path) -> object:
        self.outputs.append(os.path.relpath(folder))
        return self.job(config.plain())

    def __call__(self, *arguments: str) -> tuple[int, str]:
        self.outputs.clear()
        return ended(cli.main, *self.arguments, *arguments)[::2]


@pytest.fixture
def command(config_dir, tmp_path, monkeypatch, capsys) -> Command:
    monkeypatch.chdir(tmp_path)
    return Command(config_dir, monkeypatch, capsys)


class TestRunFolder:
    def test_it_is_the_same_for_the_same_overrides_alone_and_in_a_sweep(self, command):
        assert command() == (0, "")
        assert command.outputs == ["runs/beam/default"]
        command("seed=3", "material.density=900", "experiment=beam_twist")
        assert command.outputs == ["runs/beam_twist/material.density=900,seed=3"]
        assert (
            command("--multirun", "experiment=beam,beam_twist", "material.density=900", "seed=3")[0]
            == 0
        )
        assert command.outputs == [
            f"runs/{name}/material.density=900,seed=3" for name in ("beam", "beam_twist")
        ]

    def test_a_sweep_over_names(self, command, tmp_path):
        (tmp_path / "a,b").mkdir()
        assert command(
            "name=20261128,1e5,'c, d',Ü (1)", "--multirun", "hydra.sweep.dir=Ü/${name}", "seed=1"
        ) == (0, "")
        assert [folder.rpartition("/")[0] for folder in command.outputs] == [
            f"Ü/{name}" for name in ("20261128", "1e5", "c, d", "Ü (1)")
        ]
        assert command("name=a,b", "--multirun") == (0, "")
        assert command.outputs == ["runs/a,b/name=a,b"]

    def test_the_working_folder_stays(self, command, tmp_path):
        folders = []
        command.job = lambda config: folders.append(Path.cwd())
        command()
        assert folders == [tmp_path]

    def test_labels(self):
        assert run_label([]) == "default"
        assert (
            run_label(["device=cuda", "+extra.device=cpu"], ["device", "extra.device"]) == "default"
        )
        assert run_label(["b=2", "a.c=1e-3", "~d"]) == "a.c=1e-3,b=2,~d"
        assert run_label(["a=2", "a=1"]) == "a=1"
        tuning = ["tune.trials=3", "~tune.space.trainer.gamma", "seed=1"]
        assert run_label(tuning, ["tune"]) == "seed=1"
        awkward = [run_label([f"a={value}"]) for value in ("x/y", "x y", "x" * 300, "x" * 301)]
        assert len(set(awkward)) == 4
        assert all(
            set(label) <= set("axy=-0123456789abcdef") and len(label) < 120 for label in awkward
        )


class TestOwnOptions:
    @pytest.fixture
    def own(self, command, tmp_path):
        for name, text in {
            "configs/experiment/my_robot.yaml": "# @package _global_\nname: my_robot",
            "elsewhere/experiment/other_robot.yaml": "# @package _global_\nname: other_robot",
        }.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True)
            path.write_text(text)
        return tmp_path / "configs"

    def test_they_lie_in_the_working_directory_or_another_folder_and_help_names_them(
        self, command, own
    ):
        assert command("experiment=my_robot", "seed=1") == (0, "")
        assert command.outputs == ["runs/my_robot/seed=1"]
        code, errors = command("experiment=my_robt")
        assert (code, errors.partition(";")[0]) == (
            2,
            "error: unknown experiment 'my_robt', did you mean 'my_robot'?",
        )
        assert command("experiment=zzz")[1].endswith("known are beam, beam_twist, my_robot\n")
        _, out, err = outcome("--help")
        assert re.search(
            "^experiment: beam_.*, my_robot, .*, tentacle_wrap$", out, flags=re.MULTILINE
        )
        assert err == ""
        assert command("--config-dir", "elsewhere", "experiment=other_robot") == (0, "")
        assert command("--config-dir", "elsewhere", "experiment=my_robot")[0] == 2

    def test_names_are_texts_in_the_folder_of_another_main_configuration(self, command, config_dir):
        (config_dir / "experiment/octal.yaml").write_text("# @package _global_\nname: 010")
        assert command("experiment=octal") == (0, "")
        assert command.outputs == ["runs/010/default"]

    def test_the_package_wins_and_says_so(self, command, own):
        (own / "config.yaml").write_text("name: of something else")
        (own / "trainer").mkdir()
        (own / "trainer" / "default.yaml").write_text("epochs: 1")
        warning = (
            "warning: configs/trainer/default.yaml is ignored: the package has an option of that "
            "name\n"
        )
        assert command("experiment=my_robot") == (0, warning)
        assert command.outputs == ["runs/my_robot/default"]

    @pytest.mark.parametrize("encoding", ["cp1252", "utf-8-sig", "utf-16"])
    def test_another_encoding_is_read(self, command, own, encoding, recwarn):
        (own / "experiment" / "my_robot.yaml").write_text(
            "# @package _global_\nname: Träger\n", encoding=encoding
        )
        assert (command("experiment=my_robot"), command.outputs) == (
            (0, ""),
            ["runs/Träger/default"],
        )
        assert any("Windows-1252" in str(warning.message) for warning in recwarn) == (
            encoding == "cp1252"
        )

    @pytest.mark.parametrize(
        ("text", "problem"),
        [
            ("name: a\nname: b\n", "found duplicate key name"),
            ("name: [a\nseed: 1\n", "expected ',' or ']'"),
        ],
    )
    def test_invalid_yaml_is_named_with_its_line(self, command, own, text, problem):
        (path := own / "experiment" / "my_robot.yaml").write_text("# @package _global_\n" + text)
        code, errors = command("experiment=my_robot")
        assert code == 2
        assert errors.startswith(f"error: {path}, line 3 cannot be read as YAML ({problem}")
        assert errors.count("\n") == 1


class TestUserErrors:
    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            ("experiment=beam_twst", "unknown experiment 'beam_twst', did you mean 'beam_twist'"),
            ("seed=[1", "cannot read the override 'seed=[1'"),
            ("seed", "unknown command 'seed' (--help lists all)"),
            ("seed=1 inspct", "unknown command 'inspct', did you mean 'inspect'?"),
            ("seed=${nothing}", "Interpolation key 'nothing' not found"),
            ("material.density=???", "material.density has no value: add material.density=VALUE"),
            ("+seed=1", "Could not append to config. An item is already at 'seed'."),
            ("hydra.run.dir=conf/config.yaml", "cannot write conf/config.yaml (File exists)"),
            ("--config-name other", "Cannot find primary config 'other'."),
            ("--config-dir nowhere", "Additional config directory"),
            ("--experimental-rerun config.pickle", "--experimental-rerun reads a pickle"),
        ],
    )
    def test_command_line(self, command, arguments, sentence):
        code, errors = command(*arguments.split(" "))
        assert code == 2
        assert errors.startswith(f"error: {sentence}")
        assert errors.count("\n") == 1
        assert command.outputs == []

    def test_of_the_job(self, command):
        for job, sentence in (
            (lambda config: refuse(), "no such body"),
            (
                lambda config: hydra.utils.instantiate({"_target_": f"{__name__}.refuse"}),
                "no such body",
            ),
            (lambda config: disk_is_full(), "disk is full while writing picture.png"),
        ):
            command.job = job
            code, errors = command()
            assert code == 2
            assert errors.startswith(f"error: {sentence}")
            assert errors.count("\n") == 1

    def test_in_a_sweep_the_other_jobs_run_and_each_error_is_printed_once(self, command):
        def fail(config: dict[str, Any]) -> None:
            if config["seed"] != 2:
                raise InputError(f"seed {config['seed']} is bad")

        command.job = fail
        code, errors = command("--multirun", "seed=1,2,3")
        assert code == 2
        assert len(command.outputs) == 3
        assert [line for line in errors.splitlines() if line.startswith("error: ")] == [
            "error: seed 1 is bad",
            "error: seed 3 is bad",
        ]
        assert "Traceback" not in errors


def refuse() -> None:
    raise InputError("no such body")


def disk_is_full() -> None:
    raise OSError(errno.ENOSPC, "No space left on device", "picture.png")


class TestOtherEnds:
    def test_faults_of_the_program_keep_their_traceback_and_nothing_global_is_left_changed(
        self, command, monkeypatch
    ):
        command("seed=[1")
        assert "HYDRA_FULL_ERROR" not in os.environ
        assert logging.raiseExceptions is True
        command.job = lambda config: 1 / 0
        with pytest.raises(ZeroDivisionError):
            command()
        command.job = lambda config: Path("missing").read_text()
        with pytest.raises(FileNotFoundError):
            command()
        command.job = lambda config: refuse()
        monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
        with pytest.raises(InputError):
            command()
        assert os.environ["HYDRA_FULL_ERROR"] == "1"

    @pytest.mark.parametrize("mode", ["--run", "--multirun"])
    def test_interruption(self, command, mode):
        def interrupt(config: dict[str, Any]) -> None:
            raise StageInterrupted("interrupted in stage 'train'")

        command.job = interrupt
        seeds = "seed=1,2" if mode == "--multirun" else "seed=1"
        assert command(mode, seeds) == (130, "\ninterrupted in stage 'train'\n")
        assert len(command.outputs) == 1


class TestCommands:
    """The function that a command line calls, and its arguments."""

    @pytest.fixture
    def calls(self, command, config_dir, monkeypatch):
        called = []

        def recorder(name: str) -> Callable[[AnyKeys, Path], None]:
            def record(config: AnyKeys, folder: Path) -> None:
                called.append((name, config.plain()))

            return record

        for name, entry in commands.COMMANDS.items():
            module, function = f"warp_resphys.{entry.function}".split(":")
            monkeypatch.setitem(
                sys.modules, module, sys.modules.get(module, types.ModuleType(module))
            )
            monkeypatch.setattr(sys.modules[module], function, recorder(name), raising=False)
        for name in ("check", "inspect", "view_film"):
            (config_dir / f"{name}.yaml").write_text(
                "defaults: [config, _self_]\nfiles: []\nrun: null"
            )
        return called

    @pytest.mark.parametrize(
        ("arguments", "name", "seed"),
        [
            ("", "run", 0),
            ("run", "run", 0),
            ("seed=1", "run", 1),
            ("view film seed=2", "view film", 2),
            ("seed=3 view film", "view film", 3),
            ("--run view +extra=1 ~material film", "view film", 0),
            ("--config-dir . check", "check", 0),
        ],
    )
    def test_the_first_words_are_the_command(self, command, calls, arguments, name, seed):
        assert command(*arguments.split()) == (0, "")
        assert [(called, config["seed"]) for called, config in calls] == [(name, seed)]

    def test_words_after_it_are_values_of_the_key_that_takes_them(self, command, calls, tmp_path):
        (tmp_path / "runs" / "beam" / "seed=1").mkdir(parents=True)
        assert command("inspect", "seed=1", "a.npz", "b c's [1],.npz", "--run") == (0, "")
        assert calls[0][1]["files"] == ["a.npz", "b c's [1],.npz"]
        assert command("view", "film", "runs/beam/seed=1") == (0, "")
        assert calls[1][1]["run"] == "runs/beam/seed=1"
        assert command("view", "film", "a", "b")[1].startswith(
            "error: cannot read the override 'b'"
        )
        assert len(calls) == 2

    def test_options_with_a_value_are_those_of_hydra(self, command):
        code, usage = command("--unknown")
        valued = re.findall(r"\[(--[a-z-]+) [A-Z{[]", usage)
        assert (code, {*valued}) == (2, {names[0] for names in commands.OPTIONS_WITH_VALUE})
        explained = outcome("--hydra-help").out
        for names in commands.OPTIONS_WITH_VALUE:
            assert f"\n{','.join(names)} : " in explained

    def test_options_and_overrides_come_in_any_order(self, command):
        seeds = []
        command.job = lambda config: seeds.append(config["seed"])
        assert command("-m", "seed=1,2", "--config-name=config", "name=a", "--run")[0] == 2
        assert command("seed=1,2", "-m", "name=a", "--config-name=config") == (0, "")
        assert seeds == [1, 2]
        assert "Config search path" in outcome("seed=1", "--info", "searchpath").out
        assert "Defaults List" in outcome("--info", "--config-name=check").out


_OWN = {"my_robot", "my_arm", "ecoflex", "--cfg"}  # experiments that the reader writes


def documented():
    """Every command line with arguments in the documentation and in the help, without comments."""
    commands_found = set()
    patterns = (
        "*.md",
        "docs/*.md",
        "docs/bring_your_robot/*.md",
        "docs/tutorials/*.md",
        "conf/**/*.yaml",
    )
    for path in [path for pattern in patterns for path in REPOSITORY.glob(pattern)]:
        text = re.sub(r"\\\n *", "", path.read_text(encoding="utf-8"))
        lines = re.findall(
            r"^[# ]*warp-resphys (.*)$|`warp-resphys ([^`]*)`", text, flags=re.MULTILINE
        )
        commands_found |= {re.split(r"  +[\w(]|#", a or b)[0].strip() for a, b in lines}
    return sorted(
        line for line in commands_found if "=" in line and not _OWN & {*re.split(r"[ =]", line)}
    )


@pytest.mark.slow
def test_every_documented_line_has_keys_that_exist():
    with initialize_config_module("warp_resphys.conf", version_base="1.3"):
        for line in documented():
            command, arguments = commands.parse(
                [word for word in shlex.split(line) if word != "--multirun"]
            )
            elsewhere = ("hydra/launcher=",)  # packages that are not installed
            known = [
                re.sub(r"^seed=0,.*", "seed=0", word)
                for word in arguments
                if not word.startswith(elsewhere)
            ]
            compose(commands.configuration(command), readable(known)[0])
            if command in ("run", "tune"):
                names = [word.partition("=")[0].lstrip("+~") for word in known]
                assert all("." not in name or _is_key(name) for name in names), line


@functools.cache
def _patterns():
    """Regular expressions of the dotted names of all keys of a run."""
    return [
        key.replace(".", r"\.").replace("NAME", "[^.]+")
        for key in keys(RunSettings.model_json_schema())
    ]


def _is_key(name):
    """Whether a run has a key of a dotted name."""
    # Not in the schema.
    free = ("hydra.", "tune.", "simulation.", "target.", "laboratory.material.")
    return name.startswith(free) or any(re.fullmatch(pattern, name) for pattern in _patterns())


def test_all_keys_are_shown_with_their_defaults_and_nothing_is_written(folder):
    shown = OmegaConf.create(outcome("--cfg", "job", "seed=3", "mesh=rod").out)
    assert (shown.seed, shown.mesh.kind, shown.mesh.grading, shown.parallel.processes) == (
        3,
        "rod",
        0.0,
        1,
    )
    assert list(folder.iterdir()) == []


class TestProcess:
    def start(self, config_dir: Path, before: str, *arguments: str) -> subprocess.Popen:
        program = f"{textwrap.dedent(before)}\nfrom warp_resphys.cli import main\nmain()"
        command = [sys.executable, "-c", program, "--config-path", str(config_dir), *arguments]
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, env=environment, cwd=config_dir.parent, text=True, **pipes)

    def job(self, *lines: str) -> str:
        """A program's beginning, by which the command runs these lines."""
        return "\n".join(
            [
                "import signal, sys, time, types",
                f"experiment = sys.modules[{EXPERIMENT!r}] = types.ModuleType('experiment')",
                "from warp_resphys.io.settings import Settings",
                "def run(config: type('AnyKeys', (Settings,), {'model_config': {'extra': "
                "'ignore'}}), folder):",
                *(f"    {line}" for line in lines),
                "experiment.run_experiment = run",
            ]
        )

    def test_the_version_is_that_of_the_package(self, config_dir):
        assert (
            self.start(config_dir, "", "--version").communicate(timeout=60)[0]
            == f"warp-resphys {__version__}\n"
        )

    def test_help_imports_nothing_heavy(self, config_dir):
        heavy = """
            import atexit, sys
            for name in ("torch", "warp", "numpy", "h5py", "hydra"):
                sys.modules[name] = None  # importing it fails
            def show():
                ours = [name for name in sys.modules if name.startswith("warp_resphys")]
                print("imported:", *sorted(ours))
            atexit.register(show)
        """
        out, err = self.start(config_dir, heavy, "--help").communicate(timeout=60)
        assert "\nexperiment: beam_" in out
        names = out.splitlines()[-1].removeprefix("imported: ").split()
        ours = ("", ".cli", ".commands", ".conf", ".io", ".io.errors", ".io.process", ".moved")
        assert set(names) == {f"warp_resphys{name}" for name in ours}
        assert err == ""

    def test_ctrl_c(self, config_dir):
        handler = "signal.signal(signal.SIGINT, signal.default_int_handler)"
        sleeping = self.job(handler, "print('running', flush=True)", "time.sleep(60)")
        child = self.start(config_dir, sleeping)
        assert child.stdout.readline() == "running\n"
        child.send_signal(signal.SIGINT)
        assert child.wait(timeout=20) == 130
        assert child.stderr.read() == "\ninterrupted\n"

    @pytest.mark.parametrize(
        ("arguments", "code", "lines"),
        [("--help", NOBODY_READS, 0), ("--multirun seed=1,2", NOBODY_READS, 0), ("seed=[1", 2, 1)],
    )
    def test_a_closed_pipe_ends_it_silently(self, config_dir, arguments, code, lines):
        child = self.start(config_dir, self.job('print("x" * 100_000)'), *arguments.split())
        child.stdout.close()
        assert child.wait(timeout=20) == code
        assert child.stderr.read().count("\n") == lines

    def test_another_pipe_that_breaks_is_a_fault_of_the_program(self, config_dir):
        _, err = self.start(
            config_dir, self.job('raise BrokenPipeError(32, "Broken pipe")')
        ).communicate(timeout=60)
        assert err.endswith("BrokenPipeError: [Errno 32] Broken pipe\n")


def test_warnings_that_differ_in_numbers_alone_are_shown_once():
    messages = ("24 % more of 'pull_1'", "25.5 % more of 'pull_1'", "25.5 % more of 'pull_2'")
    with _one_sentence_each():
        shown = [warnings.formatwarning(text, ResphysWarning, "", 0) for text in messages]
    assert shown == ["warning: 24 % more of 'pull_1'\n", "", "warning: 25.5 % more of 'pull_2'\n"]
