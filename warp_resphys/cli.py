"""The console command `warp-resphys`."""

from __future__ import annotations

import os
import sys

from . import __version__
from .commands import COMMANDS, USER_ERROR, ends_where_nobody_reads, help_text, parse
from .io.errors import InputError
from .io.process import collector_paused


def main() -> None:
    """Runs the command of the command line.

    The exit code is 2, with one sentence on stderr, for an error that the user can fix; 130 after
    Ctrl-C or SIGTERM; 141 when the reader of its output has closed the pipe, as `head` does; and 1,
    with a traceback, for any other error. With HYDRA_FULL_ERROR=1 in the environment, every error
    has its traceback.
    """
    with ends_where_nobody_reads():
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
        # Read when NumPy is imported. Its threads cost more than they save where others use the
        # cores as well.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        with collector_paused():
            from .launch import launch

        launch(command, COMMANDS[command].function, arguments)


if __name__ == "__main__":
    main()
