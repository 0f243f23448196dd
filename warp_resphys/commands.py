"""The commands of `warp-resphys`: parsing of command lines, and help.

A command is one word or two: ``view``, ``view film``. This module imports only what is fast to
import.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Final

from .io.errors import InputError, did_you_mean

CONFIG_PACKAGE: Final = "warp_resphys.conf"
OWN_OPTIONS: Final = (
    "configs"  # in the working directory: groups of the configuration and their options
)
USER_ERROR: Final = 2  # exit code of an error that the user can fix
NOBODY_READS: Final = (
    141  # exit code where the reader of the output has closed the pipe: 128 + SIGPIPE
)


@contextmanager
def ends_where_nobody_reads() -> Iterator[None]:
    """Ends the process silently when the reader of its output has closed the pipe, as `head`
    does.
    """
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        try:
            print(flush=True)  # Another pipe may have broken.
        except BrokenPipeError:
            # Python flushes again at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise SystemExit(NOBODY_READS) from None
        raise


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        purpose: one line for the help.
        function: such as ``studies.film:film``, below this package. Its arguments are the settings,
            an object of the class that annotates this parameter, and the run folder.
        word: the configuration key that is set by one word after the command.
        words: the configuration key that is set by all words after the command, as a list.
    """

    purpose: str
    function: str
    word: str | None = None
    words: str | None = None


COMMANDS: Final[Mapping[str, Command]] = MappingProxyType(
    {
        "run": Command(
            "run an experiment; the word run may be left out", "pipeline:run_experiment"
        ),
        "tune": Command(
            "search for better settings of the network and its training", "studies.tuning:tune"
        ),
        "inspect": Command(
            "what is in a mesh, or how good a recording is",
            "studies.inspection:inspect",
            words="files",
        ),
        "convert": Command(
            "recordings, such as bags, MCAP files and exported tables, to HDF5",
            "studies.recording_quality:convert",
            words="files",
        ),
        "view": Command(
            "a run's robot in the browser, to be driven and pulled", "studies.view:view", word="run"
        ),
        "view film": Command(
            "a film of a trial of a run, with any of its models", "studies.film:film", word="run"
        ),
        "check": Command(
            "compare a device with the CPU, and time both, in two minutes",
            "studies.check:check",
            word="device",
        ),
        "train-policy": Command(
            "learn a policy on a run's robot, and try it on its laboratory",
            "studies.policy:train_policy",
            word="run",
        ),
    }
)

# Names of Hydra's options whose next word is their value.
OPTIONS_WITH_VALUE: Final = (
    ("--cfg", "-c"),
    ("--package", "-p"),
    ("--config-path", "-cp"),
    ("--config-name", "-cn"),
    ("--config-dir", "-cd"),
    ("--info", "-i"),
    ("--experimental-rerun",),
)
_VALUED: Final = frozenset(chain.from_iterable(OPTIONS_WITH_VALUE))
_LABEL_LENGTH: Final = 100
_OPTIONS: Final = """\
--cfg job         show all keys and their values, for these settings
--multirun, -m    run a sweep
--version         show the version of warp-resphys
--hydra-help      show the other flags"""


def configuration(command: str) -> str:
    """Returns the name of a command's YAML file in conf/."""
    return "config" if command == "run" else re.sub("[ -]", "_", command)


def parse(arguments: Sequence[str]) -> tuple[str, list[str]]:
    """Splits a command line into the name of its command and the arguments for Hydra.

    Raises:
        InputError: there is no such command.
    """
    rest = list(arguments)
    words = [
        at for at, argument in enumerate(rest) if _is_word(argument, rest[at - 1] if at else "")
    ]
    name = rest[words[0]] if words else "run"
    if name not in COMMANDS:
        firsts = [command for command in COMMANDS if " " not in command]
        raise InputError(f"unknown command '{name}'{did_you_mean(name, firsts)} (--help lists all)")
    parts = [command.partition(" ")[2] for command in COMMANDS if command.startswith(f"{name} ")]
    named = words[:1]
    if len(words) > 1 and rest[words[1]] in parts:
        name, named = f"{name} {rest[words[1]]}", words[:2]
    command = COMMANDS[name]
    if command.word or command.words:
        # Names of files may be like options or overrides: m=50g.csv, -1.csv, ~a.csv.
        files = [
            at
            for at in range(named[-1] + 1, len(rest))
            if os.path.exists(rest[at]) or _is_path(rest[at])
        ]
        words = sorted({*words, *(at for at in files if rest[at - 1] not in _VALUED)})
    after = [at for at in words if at not in named]
    dropped, quoted = set(named), [quote_name(rest[at]) for at in after]
    if command.word and after:
        rest[after[0]] = f"{command.word}={quoted[0]}"
    elif command.words and after:
        rest[after[0]] = f"{command.words}=[{','.join(quoted)}]"
        dropped |= set(after[1:])
    return name, [argument for at, argument in enumerate(rest) if at not in dropped]


def _is_word(argument: str, before: str) -> bool:
    """Whether an argument is a word: no option, no value of one, and no override."""
    return "=" not in argument and argument[:1] not in ("-", "+", "~") and before not in _VALUED


def _is_path(argument: str) -> bool:
    """Whether an argument has a folder before its first ``=``,
    as in monday/m=50g.csv, which no key has.
    """
    return argument[:1] not in ("-", "+", "~") and "/" in argument.partition("=")[0].removeprefix(
        "hydra/"
    )


def quote(text: str) -> str:
    """Returns a text in quotes, as Hydra reads it unchanged."""
    return (
        "'"
        + re.sub(r"(\\*)('|\Z)", lambda found: found[1] * 2 + (r"\'" if found[2] else ""), text)
        + "'"
    )


def quote_name(name: str) -> str:
    """Returns the name of a file or folder in quotes.

    In one that exists, ``${`` and a first ``~`` are letters.
    """
    if os.path.exists(name):
        name = (os.path.abspath(name) if name[:1] == "~" else name).replace("${", r"\${")
    return quote(name)


def help_text(command: str) -> str:
    """Returns the help of a command: purpose, examples and keys.

    For a run, all commands, groups and options.
    """
    import yaml

    text = (
        resources.files(CONFIG_PACKAGE)
        .joinpath(f"{configuration(command)}.yaml")
        .read_text(encoding="utf-8")
    )
    content = yaml.safe_load(text)
    examples = content["hydra"]["help"]["header"]
    if command == "run":
        return "\n".join(
            [
                *_lines(COMMANDS),
                "",
                examples,
                "Groups and their options:",
                "",
                *_groups(),
                "",
                _OPTIONS,
            ]
        )
    parts = {name: part for name, part in COMMANDS.items() if name.startswith(f"{command} ")}
    head = [
        f"warp-resphys {command}: {COMMANDS[command].purpose}",
        "",
        *_lines(parts),
        *[""][: len(parts)],
        examples,
    ]
    groups = [
        f"{group}={option}"
        for entry in content["defaults"]
        if isinstance(entry, dict)
        for group, option in entry.items()
    ]
    if "config" in content["defaults"]:
        groups.append("all groups and keys of a run, as warp-resphys --help lists them")
    keys = re.sub(
        r"^(?:defaults|hydra):\n(?:(?: .*)?(?:\n|\Z))*", "", text, flags=re.MULTILINE
    ).rstrip()
    return "\n".join(
        [
            *head,
            "Keys and their values:",
            "",
            keys,
            *[f"# also: {', '.join(groups)}"][: len(groups)],
            "",
            _OPTIONS,
        ]
    )


def _lines(commands: Mapping[str, Command]) -> list[str]:
    """Help lines of commands, and a line on the help of a single command."""
    lines = [f"warp-resphys {name:18}  {command.purpose}" for name, command in commands.items()]
    return [*lines, f"warp-resphys {'COMMAND --help':18}  help of a command"] if lines else []


def _groups() -> list[str]:
    """Help lines of the configuration groups: their options, including the user's own ones."""
    places = [Path(str(resources.files(CONFIG_PACKAGE))), Path.cwd() / OWN_OPTIONS]
    options: dict[str, set[str]] = {}
    for place in places:
        for path in place.glob("*/*.yaml"):
            options.setdefault(path.parent.name, set()).add(path.stem)
    return [f"{group}: {', '.join(sorted(names))}" for group, names in sorted(options.items())]


def run_label(overrides: Sequence[str], excluded: Sequence[str] = ()) -> str:
    """Names a run folder after its overrides; an OmegaConf resolver.

    The order of the overrides does not matter, so that a repeated command finds its own files.

    Args:
        overrides: Hydra's task overrides, such as "material.density=900".
        excluded: Keys that do not change the results, or that are part of the path already, with
            all keys below them.

    Returns:
        "key=value,key=value" sorted by key, or "default" without overrides. Long names, and names
        with unsuitable characters, are shortened or replaced and end in a hash of the whole.
    """
    settings = {}
    for override in overrides:
        key, _, value = override.removeprefix("++").partition("=")
        value = re.sub(r"\A'([A-Za-z0-9._=,+~-]*)'\Z", r"\1", value)
        bare = key.lstrip("+~")
        if not any(bare == name or bare.startswith(f"{name}.") for name in excluded):
            settings[key] = f"{key}={value}" if value else key
    whole = ",".join(settings[key] for key in sorted(settings))
    if not whole:
        return "default"
    label = re.sub(r"[^A-Za-z0-9._=,+~-]", "-", whole)
    if label == whole and len(label) <= _LABEL_LENGTH:
        return label
    return f"{label[:_LABEL_LENGTH]}-{hashlib.sha256(whole.encode()).hexdigest()[:8]}"
