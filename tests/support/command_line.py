"""The command line in this process."""

import contextlib
import io
import logging
import sys
from collections.abc import Callable
from typing import NamedTuple
from unittest import mock

from warp_resphys import cli
from warp_resphys.io.settings import S, parse
from warp_resphys.overrides import composed


class Outcome(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


def enable_loggers() -> None:
    """Undoes the silence after a run whose logging Hydra has disabled,
    which lasts in this process.
    """
    logging.root.setLevel(logging.WARNING)
    for name in logging.root.manager.loggerDict:
        logging.getLogger(name).disabled = False


def ended(program: Callable[[], object], *arguments: object) -> Outcome:
    """Runs a program in this process, with its name as the first argument."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.object(sys, "argv", list(map(str, arguments))),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            program()
        except SystemExit as end:
            code = end.code
        finally:
            enable_loggers()
    return Outcome(code, out.getvalue(), err.getvalue())


def outcome(*arguments: object) -> Outcome:
    """Runs `warp-resphys` with these arguments in the working directory."""
    return ended(cli.main, "warp-resphys", *arguments)


def refusal(*arguments: object) -> str:
    """The sentence with which a command refuses its arguments."""
    refused = outcome(*arguments)
    assert refused.code == 2, refused.out
    return refused.err


def sentence(*arguments: object) -> str:
    """The refusal, of a single line."""
    refused = refusal(*arguments)
    assert refused.startswith("error: ")
    assert refused.count("\n") == 1
    return refused


def settings_of(settings: type[S], name: str, *overrides: str) -> S:
    """A configuration of the package, parsed into its class."""
    return parse(settings, composed(name, overrides))
