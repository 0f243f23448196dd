"""The console command `warp-resphys`."""

from __future__ import annotations

import sys

from . import __version__
from .commands import COMMANDS, USER_ERROR, help_text, parse
from .io.errors import InputError
from .io.pipes import ends_where_nobody_reads


def main() -> None:
    """Does what the command line asks for.

    The process ends with exit code 2 and one sentence on stderr where the user can mend what is wrong, with
    130 after Ctrl-C, with 141 when whoever reads its output has left, as `head` does, and with 1 and a traceback for
    everything else. With HYDRA_FULL_ERROR=1 in the environment, every error keeps its traceback.
    """
    with ends_where_nobody_reads():
        if "--version" in sys.argv[1:]:  # Hydra's own would name Hydra's.
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
        from .launch import launch

        launch(command, COMMANDS[command].function, arguments)


if __name__ == "__main__":
    main()
