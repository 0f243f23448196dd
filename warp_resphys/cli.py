"""The console command `warp-resphys`."""

from __future__ import annotations

import os
import sys

from . import __version__
from .commands import COMMANDS, USER_ERROR, help_text, parse
from .io.errors import InputError
from .io.imports import uncollected

NOBODY_READS = 141  # exit code: 128 + SIGPIPE


def main() -> None:
    """Runs the command of the command line.

    The exit code is 2, with one sentence on stderr, for an error that the user can fix; 130 after Ctrl-C or SIGTERM;
    141 when the reader of its output has closed the pipe, as `head` does; and 1, with a traceback, for any other error.
    With HYDRA_FULL_ERROR=1 in the environment, every error has its traceback.
    """
    try:
        _run()
        sys.stdout.flush()
    except BrokenPipeError:
        if not _is_unread():
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes again at exit.
        raise SystemExit(NOBODY_READS) from None


def _run() -> None:
    if "--version" in sys.argv[1:]:  # Hydra would print its own version.
        print(f"warp-resphys {__version__}")
        return
    try:
        command, arguments = parse(sys.argv[1:])
        if {"--help", "-h"} & set(arguments):
            print(help_text(command))
            return
    except InputError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        raise SystemExit(USER_ERROR) from None
    # Read when NumPy is imported. Its threads cost more than they save where others use the cores as well.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with uncollected():
        from .launch import launch

    launch(command, COMMANDS[command].function, arguments)


def _is_unread() -> bool:
    """Whether the reader of the output has closed the pipe."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        return True
    return False


if __name__ == "__main__":
    main()
