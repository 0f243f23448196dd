"""Runs a command with a configuration composed by Hydra, and reports errors in one sentence."""

from __future__ import annotations

import argparse
import gc
import logging
import os
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, Final, get_type_hints

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
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from yaml import MarkedYAMLError

from .applications import function_at
from .commands import (
    CONFIG_PACKAGE,
    OPTIONS_WITH_VALUE,
    OWN_OPTIONS,
    USER_ERROR,
    configuration,
    ends_where_nobody_reads,
    quote,
    run_label,
)
from .io.atomic import is_disk_full
from .io.errors import ResphysError, ResphysWarning, did_you_mean
from .io.process import collector_paused, ends_as_after_ctrl_c
from .io.settings import Settings, parse
from .option_files import own_options, run_schema, search_path_read_here
from .overrides import LateOverride, adjust, readable
from .settings.run import RunSettings

INTERRUPTED: Final = 130
# Commands that have the keys of `settings.run.RunSettings`, perhaps beside others.
TYPED: Final = ("run", "tune")
# Overrides of Hydra for a job that only prints.
_SILENT: Final = ("hydra.run.dir=.", "hydra.output_subdir=null", "hydra/job_logging=disabled")
_NUMBER: Final = re.compile(r"(?<![\w'.])[\d.,]*\d(?![\w'])")  # on its own, not in a name


def launch(command: str, function: str, arguments: Sequence[str]) -> None:
    """Runs a command, with the exit codes of `cli.main`.

    Args:
        command: name of the command.
        function: its module below this package and its function, such as "studies.film:film". The
            configuration is parsed into the class that annotates its first parameter.
        arguments: for Hydra.
    """
    job = _Job(function, os.environ.get("HYDRA_FULL_ERROR") == "1")
    with _one_sentence_each():
        try:
            job.run(command, arguments)
        except KeyboardInterrupt as error:
            print(f"\n{error}" if str(error) else "\ninterrupted", file=sys.stderr, flush=True)
            raise SystemExit(INTERRUPTED) from None
        except Exception as error:
            job.report(error)
            raise SystemExit(USER_ERROR) from None


class _Job:
    """A command that Hydra runs, once or for every job of a sweep.

    It reports errors in one sentence.

    Args:
        function: see `launch`.
        full_error: whether errors have their traceback instead.
    """

    def __init__(self, function: str, full_error: bool) -> None:
        self.function, self.full_error = function, full_error
        self.late: list[LateOverride] = []
        self.shown: str | None = None  # key of the settings that are printed instead of running
        self.started = False
        self._reported: list[BaseException] = []

    def run(self, command: str, arguments: Sequence[str]) -> None:
        """Composes the configuration and runs the command with it."""
        options, flags = _options(arguments)
        if options.pop("experimental_rerun", None) is not None:
            raise HydraException(
                "--experimental-rerun reads a pickle, which can run code: use overrides instead"
            )
        if command in TYPED and options.get("cfg") == "job":
            del options["cfg"]
            self.shown = options.pop("package", "")
        folder = options.pop("config_dir", _user_folder())
        overrides = options.pop("overrides")
        if overrides:
            schema = (
                run_schema()
                if command in TYPED
                else _function(self.function)[1].model_json_schema()
            )
            words, self.late = readable(overrides, schema, folder, "--multirun" in flags)
            overrides = [search_path_read_here(word) for word in words]
        overrides += _SILENT if self.shown is not None else ()
        flags += [f"--{name.replace('_', '-')}={value}" for name, value in options.items()]
        OmegaConf.register_new_resolver("run_label", self._label, replace=True)
        job = hydra.main(
            version_base="1.3",
            config_path=f"pkg://{CONFIG_PACKAGE}",
            config_name=configuration(command),
        )(self._call)
        typed, sys.argv = sys.argv, [*sys.argv[:1], *flags, *overrides]
        try:
            with ends_as_after_ctrl_c(), own_options(folder):
                job()
        finally:
            sys.argv = typed

    def _label(self, overrides: Sequence[str], excluded: Sequence[str] = ()) -> str:
        return run_label([*overrides, *(override.argument for override in self.late)], excluded)

    def _call(self, config: DictConfig) -> Any:
        """Runs the command, or shows its settings."""
        self.started = True
        try:
            adjust(config, HydraConfig.get().runtime.choices, self.late)
            if self.shown is not None:
                with ends_where_nobody_reads():
                    return _show(config, self.shown)
            values = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
            folder = Path(HydraConfig.get().runtime.output_dir)
            gc.collect()  # What an earlier job of a sweep has left would be kept for good.
            run, settings = _function(self.function)
            with ends_where_nobody_reads():
                return run(parse(settings, values), folder)
        except Exception as error:
            self.report(error)
            if HydraConfig.get().mode == RunMode.RUN:
                raise SystemExit(USER_ERROR) from error
            raise

    def report(self, error: Exception) -> None:
        """Prints the message of an error once; raises the error if it is a fault of the program."""
        message = _explain(error, self.started)
        if message is None or self.full_error:
            raise error
        if not any(error is earlier for earlier in self._reported):
            print(f"error: {message}", file=sys.stderr, flush=True)
            self._reported.append(error)


@contextmanager
def _one_sentence_each() -> Iterator[None]:
    """Lets errors and warnings have one sentence each, without lines of code.

    Restores the process at the end.

    Of warnings that differ in numbers alone, as of one body in several stages, the first is shown.
    """
    shown = set[str]()
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # It tells of its list of fonts.
    before = warnings.formatwarning, logging.raiseExceptions, os.environ.get("HYDRA_FULL_ERROR")
    warnings.formatwarning = partial(_sentence_of_warning, shown)
    logging.raiseExceptions = False  # no traceback for each log line if the disk is full
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them and exiting
    try:
        yield
    finally:
        warnings.formatwarning, logging.raiseExceptions, full_error = before
        os.environ.pop("HYDRA_FULL_ERROR") if full_error is None else os.environ.update(
            HYDRA_FULL_ERROR=full_error
        )


def _function(name: str) -> tuple[Callable[..., Any], type[Settings]]:
    """The function of a command, and the class of its settings."""
    with collector_paused():
        run = function_at(name)
    settings, *_ = get_type_hints(run).values()
    return run, settings


def _sentence_of_warning(
    shown: set[str],
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """A warning as `warnings.formatwarning` returns it.

    Those of this package without a line of code, each once.
    """
    if issubclass(category, ResphysWarning):
        before = len(shown)
        shown.add(_NUMBER.sub("", str(message)))
        return f"warning: {message}\n" if len(shown) > before else ""
    return f"{filename}:{lineno}: {category.__name__}: {message}\n"


def _options(arguments: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Options of Hydra that have a value, with ``overrides``, and the flags that have none."""
    parser = argparse.ArgumentParser(add_help=False, argument_default=argparse.SUPPRESS)
    for name, *short in OPTIONS_WITH_VALUE:
        optional: dict[str, Any] = {"nargs": "?", "const": "all"} if name == "--info" else {}
        parser.add_argument(name, *short, **optional)
    parser.add_argument("--multirun", "-m", action="store_true")
    parser.add_argument("overrides", nargs="*", default=[])
    known, flags = parser.parse_known_intermixed_args(arguments)
    options = vars(known)
    return options, [*flags, *["--multirun"][: options.pop("multirun", False)]]


def _user_folder() -> str | None:
    """The folder of the user's own options in the working directory, if it exists."""
    folder = Path.cwd() / OWN_OPTIONS
    if not folder.is_dir():
        return None
    packaged = resources.files(CONFIG_PACKAGE)
    for path in sorted(folder.glob("*/*.yaml")):
        name = path.relative_to(Path.cwd())
        if packaged.joinpath(path.parent.name, path.name).is_file():
            print(
                f"warning: {name} is ignored: the package has an option of that name",
                file=sys.stderr,
            )
    return str(folder)


def _show(config: DictConfig, key: str) -> None:
    """Prints the settings of a run, with the defaults of all keys that are not in a YAML file."""
    values: Any = OmegaConf.to_container(config, resolve=True)
    run = {name: value for name, value in values.items() if name != "tune"}
    whole = OmegaConf.create({**values, **parse(RunSettings, run).plain()})
    chosen = OmegaConf.select(whole, key) if key else whole
    print(OmegaConf.to_yaml(chosen).rstrip() if OmegaConf.is_config(chosen) else chosen)


def _explain(error: BaseException, started: bool) -> str | None:
    """Message for an error that the user can fix; None for a fault of the program.

    Before the job has started, errors are those of the command line.
    """
    cause = error.__cause__
    if isinstance(error, ResphysError):
        return str(error)
    if isinstance(error, BrokenPipeError):
        return None
    if isinstance(error, InstantiationException) and cause is not None:
        return _explain(cause, started)
    if (
        isinstance(error, MissingConfigException)
        and error.missing_cfg_file is not None
        and error.options
    ):
        group, _, option = error.missing_cfg_file.rpartition("/")
        return (
            f"unknown {group} '{option}'{did_you_mean(option, error.options)}; known are "
            f"{', '.join(error.options)}"
        )
    if isinstance(error, OverrideParseException):
        override = error.override.removeprefix("++")
        key, equals, value = override.partition("=")
        text = quote(value) if '"' in value else f'"{value}"'
        hint = (
            f", and a text with special characters in quotes, {shlex.quote(f'{key}={text}')}"
            if equals
            else ""
        )
        return f"cannot read the override {override!r} ({_sentence(error)}): write key=value{hint}"
    if isinstance(error, MissingMandatoryValue):
        return (
            f"{error.full_key} has no value: add {error.full_key}=VALUE (--help explains the keys)"
        )
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
        return (
            f"{place} cannot be read as YAML ({error.problem}): "
            "correct this line or the lines before"
        )
    if isinstance(error, OSError):
        return f"cannot write {error.filename} ({error.strerror}): choose another run folder"
    return _sentence(error) if isinstance(error, ValueError) else None


def _sentence(error: BaseException) -> str:
    """Message of a library error in one line, without lists of search paths and types."""
    text = re.split(
        r"\n\s*(?:Config search|Search path|full_key|object_type|reference_type|See )", str(error)
    )[0]
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if (
        isinstance(error, OmegaConfBaseException)
        and error.full_key
        and error.full_key not in lines[0]
    ):
        lines.append(f"(at {error.full_key})")
    if isinstance(error.__cause__, (OmegaConfBaseException, ResphysError)):
        lines.append(f"({_sentence(error.__cause__)})")
    return " ".join(lines)
