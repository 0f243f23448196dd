"""The console command `warp-resphys`: its commands, each configured by Hydra, and errors in one sentence."""

from __future__ import annotations

import logging
import os
import re
import select
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module, resources
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, TextIO

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import (
    HydraException,
    InstantiationException,
    MissingConfigException,
    OverrideParseException,
)
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException
from yaml import MarkedYAMLError

from . import __version__
from .io.errors import InputError, ResphysError, did_you_mean
from .io.files import OWN_OPTIONS, is_disk_full
from .io.labels import run_label
from .io.team import is_first, place

CONFIG_PACKAGE = "pkg://warp_resphys.conf"
USER_ERROR = 2
INTERRUPTED = 130
NOBODY_READS = 141  # 128 + SIGPIPE


# Each command: its function below this package, which takes the configuration of the same name as plain data and the
# run folder, and its purpose.
COMMANDS: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {
        "run": ("pipeline:run_experiment", "run an experiment; the word run may be left out"),
        "tune": ("studies.tuning.tune:run_tuning", "search for better settings of the network and its training"),
        "reproduce": ("studies.reproduction:reproduce", "run the simulated beams, and compare with what was published"),
        "robots": ("studies.robots:robots", "run the robots that others recorded, with one page on all of them"),
        "film": ("studies.film:film", "make a film of a trial of a run, with any of its models"),
        "view": ("studies.view:view", "show a run's robot in a browser, to be driven and pulled"),
        "train-policy": (
            "studies.policy:train_policy",
            "learn a policy on a run's robot, and try it on its laboratory",
        ),
        "inspect": ("studies.preparation:inspect", "say what is in a mesh, or how good a recording is"),
        "make-arm": ("studies.preparation:make_arm", "make the mesh of a pneumatic arm"),
        "convert": ("studies.preparation:convert", "bring the published recordings into a format that is safe to open"),
        "compare": ("studies.recording_comparison:compare", "set a beam that is let go beside its simulation"),
        "verify": ("studies.verification:verify", "simulate reference trajectories, and compare every vertex"),
        "gradcheck": ("studies.gradient_check:gradcheck", "compare adjoint gradients with central differences"),
        "check": (
            "studies.device_check:check_device",
            "check a device against the CPU, and time it: for a page of results",
        ),
        "benchmark": ("studies.benchmark:benchmark", "time steps, forward and backward, and what they consist of"),
        "element-study": ("studies.elements:element_study", "static sag of a beam, by element and refinement"),
        "size-study": ("studies.sizes:size_study", "time and memory of a step, by linear solver and size of the body"),
        "peer-study": ("studies.peers:peer_study", "time of a step beside another simulator's, at equal error"),
        "locking-study": ("studies.locking:locking_study", "deflection of an arm, by element and refinement"),
    }
)
_CONFIGURATIONS: Final = {"run": "config"}  # where it is not called as the command is
_WORDS: Final = {"verify": "files"}  # the key that takes the words after the command, as a list

# What keys were called before, and what has taken their place.
RENAMED: Final[Mapping[str, str]] = MappingProxyType(
    {
        "task": "warp-resphys tune",
        "pressure_coupling": "coupling",
        "simulation.fibre_stiffness": "fibres.stiffness",
        "synthetic.material.fibre_stiffness": "laboratory.fibres.stiffness",
        "reality": "target",
        "synthetic": "laboratory",
        "laboratory.misplaced": "laboratory.placement_noise",
        "trajectory_source": "trial_source",
        "markers.followed": "markers.tracked",
        "markers.others": "markers.reference",
        "markers.counts": "ablation.counts",
        "markers.draws": "ablation.draws",
        "markers.modes": "ablation.modes",
        "markers.processes": "ablation.processes",
        "data.hung_on": "data.payload_at",
        "data.factors": "data.input_scales",
        "data.pressure_scales": "data.input_scales",
        "data.pressure_limit": "data.input_limit",
        "data.chambers": "data.parts",
        "data.windows": "data.horizons",
        "actuation.memory": "actuation.filter_time_constants",
        "in_the_loop.sees_loads": "actuation.sees_payload",
    }
)

# Hydra's options whose next word is their value.
_VALUED: Final = (
    *("--cfg", "-c", "--package", "-p", "--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd"),
    *("--info", "-i", "--experimental-rerun"),
)
_PLAIN: Final = re.compile(r"[\w./~=+%@:,-]+")  # A value that means nothing but itself.
# Of a process that helps another one with a run.
_SILENT: Final = ("hydra.output_subdir=null", "hydra/job_logging=disabled")


def main(command: str | None = None) -> None:
    """Does what the command line asks for.

    The process ends with exit code 2 and one sentence on stderr where the user can mend what is wrong, with
    130 after Ctrl-C, with 141 when whoever reads its output has left, as `head` does, and with 1 and a traceback for
    everything else. With HYDRA_FULL_ERROR=1 in the environment, every error keeps its traceback.

    Args:
        command: one of COMMANDS; where left out, the first bare word of the command line, and without one, run.
    """
    with _ends_where_nobody_reads():
        if "--version" in sys.argv[1:]:  # Hydra's own would name Hydra's.
            print(f"warp-resphys {__version__}")
        else:
            _run(command)


@contextmanager
def _ends_where_nobody_reads() -> Iterator[None]:
    """Ends the process without a word when its output breaks for want of a reader."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        unread = [stream.fileno() for stream in (sys.stdout, sys.stderr) if _is_unread(stream)]
        if not unread:
            raise
        for descriptor in unread:
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)  # Python flushes once more at its end.
        raise SystemExit(NOBODY_READS) from None


def _is_unread(stream: TextIO) -> bool:
    """Whether the stream is a pipe that nobody has open to read any more."""
    poll = select.poll()
    poll.register(stream, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def _run(command: str | None) -> None:
    reported: list[BaseException] = []
    started = False

    def job(config: DictConfig) -> Any:
        nonlocal started
        started = True
        try:
            if old := next((key for key in RENAMED if OmegaConf.select(config, key) is not None), None):
                raise InputError(_successor(old))
            module, _, function = COMMANDS[chosen][0].partition(":")
            settings = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
            folder = Path(HydraConfig.get().runtime.output_dir)
            with _ends_where_nobody_reads():
                return getattr(import_module(f"{__package__}.{module}"), function)(settings, folder)
        except Exception as error:
            sentence = _explain(error, started)
            if sentence is None or full_error:
                raise
            if is_first():
                print(f"error: {sentence}", file=sys.stderr, flush=True)
            reported.append(error)
            if HydraConfig.get().mode == RunMode.RUN:
                raise SystemExit(USER_ERROR) from error
            raise

    full_error = os.environ.get("HYDRA_FULL_ERROR") == "1"
    arguments = sys.argv
    raise_exceptions = logging.raiseExceptions
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra hands errors on instead of printing them and leaving
    logging.raiseExceptions = False  # a log file on a full disk must not fill the screen with tracebacks
    OmegaConf.register_new_resolver("run_label", run_label, replace=True)
    OmegaConf.register_new_resolver("purpose", _purpose, replace=True)
    try:
        if any(argument.startswith("--experimental-rerun") for argument in sys.argv[1:]):
            raise HydraException("--experimental-rerun reads a pickle, which can run code: use overrides")
        chosen, rest = _read(arguments[1:], command)
        sys.argv = [arguments[0], *_own_options(), *map(_quoted, rest), *([] if is_first() else _SILENT)]
        if place()[1] > 1 and chosen != "run":
            raise InputError(f"torchrun is for runs: start warp-resphys {chosen} without it.")
        configuration = _CONFIGURATIONS.get(chosen, chosen.replace("-", "_"))
        hydra.main(version_base="1.3", config_path=CONFIG_PACKAGE, config_name=configuration)(job)()
    except KeyboardInterrupt as error:
        print(f"\n{error}" if str(error) else "\ninterrupted", file=sys.stderr, flush=True)
        raise SystemExit(INTERRUPTED) from None
    except Exception as error:
        sentence = _explain(error, started)
        if sentence is None or full_error:
            raise
        if is_first() and not any(error is known for known in reported):
            print(f"error: {sentence}", file=sys.stderr, flush=True)
        raise SystemExit(USER_ERROR) from None
    finally:
        sys.argv = arguments
        logging.raiseExceptions = raise_exceptions
        if not full_error:
            del os.environ["HYDRA_FULL_ERROR"]


def _read(arguments: Sequence[str], command: str | None) -> tuple[str, list[str]]:
    """The command that is asked for, and what Hydra is to read.

    Raises:
        InputError: there is no such command.
    """
    rest = list(arguments)
    words = [
        at
        for at, argument in enumerate(rest)
        if "=" not in argument and argument[:1] not in ("-", "+", "~") and (at == 0 or rest[at - 1] not in _VALUED)
    ]
    if command is None:
        command = rest.pop(words[0]) if words else "run"
        words = [at - 1 for at in words[1:]]
    if command not in COMMANDS:
        raise InputError(f"unknown command '{command}'{did_you_mean(command, list(COMMANDS))} (--help lists all)")
    if command in _WORDS and words:
        quoted = ["'{}'".format(rest[at].replace("'", r"\'")) for at in words]
        rest[words[0]] = f"{_WORDS[command]}=[{','.join(quoted)}]"
        rest = [argument for at, argument in enumerate(rest) if at not in words[1:]]
    return command, rest


def _purpose(command: str = "") -> str:
    """For the help: what a command is for, or all of them; an OmegaConf resolver."""
    if command in COMMANDS:
        return f"warp-resphys {command}: {COMMANDS[command][1]}"
    return "\n".join(f"warp-resphys {name:14} {purpose}" for name, (_, purpose) in COMMANDS.items())


def _own_options() -> list[str]:
    """The arguments that add the user's own options, if there are any; they give way to a --config-dir that follows."""
    folder = Path.cwd() / OWN_OPTIONS
    if not folder.is_dir():
        return []
    packaged = resources.files(CONFIG_PACKAGE.removeprefix("pkg://"))
    for path in sorted(folder.glob("*/*.yaml")):
        if packaged.joinpath(path.parent.name, path.name).is_file():
            name = path.relative_to(Path.cwd())
            print(f"warning: {name} is not used: the package has an option of that name", file=sys.stderr)
    return ["--config-dir", str(folder)]


def _quoted(argument: str) -> str:
    """The same argument; a value with an equals sign, as run folders are called, in the quotes that Hydra wants."""
    key, _, value = argument.partition("=")
    plain = _PLAIN.fullmatch(value) is not None and "=" in value
    return f'{key}="{value}"' if plain and not key.startswith("-") else argument


def _explain(error: BaseException, started: bool) -> str | None:
    """The sentence to print for an error that the user can mend; None for a fault of the program.

    Before the job has started, it is the command line that is wrong.
    """
    cause = error.__cause__
    if isinstance(error, ResphysError):
        return str(error)
    if isinstance(error, BrokenPipeError):
        return None
    if isinstance(error, InstantiationException) and cause is not None:
        return _explain(cause, started)
    if isinstance(error, MissingConfigException) and error.missing_cfg_file is not None and error.options:
        group, _, option = error.missing_cfg_file.rpartition("/")
        known = ", ".join(error.options)
        return f"unknown {group} '{option}'{did_you_mean(option, error.options)}; known are {known}"
    if isinstance(error, HydraException) and isinstance(cause, (ConfigAttributeError, ConfigKeyError)):
        return _explain_key(error, cause)
    if isinstance(error, OverrideParseException):
        return f"cannot read the override {error.override!r} ({_sentence(error)}): write key=value"
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        return _sentence(error)
    if is_disk_full(error):
        name = getattr(error, "filename", None)
        place = f" while writing {name}" if name else ""
        return f"disk is full{place}: free some space and run the same command again"
    if started:
        return None
    if isinstance(error, MarkedYAMLError):
        mark = error.problem_mark
        place = "a configuration" if mark is None else f"{mark.name}, line {mark.line + 1}"
        return f"{place} cannot be read as YAML ({error.problem}): mend it there or in the lines before"
    if isinstance(error, OSError):
        return f"cannot write {error.filename} ({error.strerror}): choose another run folder"
    return _sentence(error) if isinstance(error, ValueError) else None


def _explain_key(error: HydraException, cause: OmegaConfBaseException) -> str:
    """Names the closest keys where one was set that does not exist."""
    named = re.search(r"'([^']+)'", str(error))
    wanted = named.group(1) if named else str(cause.full_key)
    root = {} if cause.parent_node is None else OmegaConf.to_container(cause.parent_node._get_root())
    known = [key for key in _keys(root) if key.partition(".")[0] != "hydra"]
    parts = wanted.split(".")
    for length in range(len(parts), 0, -1):
        if (name := ".".join(parts[:length])) in RENAMED:
            return _successor(name)
    if wanted in known:  # The value has a key of its own that does not exist.
        wanted = str(cause.full_key)
    same_name = [key for key in known if key.rpartition(".")[2] == wanted.rpartition(".")[2]]
    hint = did_you_mean(wanted, known, preferred=same_name)
    return f"unknown key '{wanted}'{hint} (--cfg job lists all keys, +{wanted}=... adds a new one)"


def _successor(key: str) -> str:
    return f"unknown key '{key}': it is now '{RENAMED[key]}'"


def _keys(config: Any, prefix: str = "") -> Iterator[str]:
    """The dotted names of all entries of a configuration."""
    if isinstance(config, dict):
        for key, value in config.items():
            yield f"{prefix}{key}"
            yield from _keys(value, f"{prefix}{key}.")


def _sentence(error: BaseException) -> str:
    """The message of a library in one line, without the parts that do not help."""
    text = re.split(r"\n\s*(?:Config search|Search path|full_key|object_type|reference_type|See )", str(error))[0]
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if isinstance(error, OmegaConfBaseException) and error.full_key and error.full_key not in lines[0]:
        lines.append(f"(at {error.full_key})")
    if isinstance(error.__cause__, (OmegaConfBaseException, ResphysError)):
        lines.append(f"({_sentence(error.__cause__)})")
    return " ".join(lines)


if __name__ == "__main__":
    main()
