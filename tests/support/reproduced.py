"""Runs of a reproduction in the process of the test, which saves the imports of other processes."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.singleton import Singleton

from support.main_job import end_of
from warp_resphys import cli
from warp_resphys.studies import runs

_SILENT = ("hydra/job_logging=none", "hydra/hydra_logging=none")


def _execute(run: runs.Run, log_file: Path, follow: Callable[[str], None]) -> str | None:
    """Does what `runs.execute` does, in this process; Hydra's state is that of the reproduction again afterwards."""
    state = Singleton.get_state()
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("HYDRA_FULL_ERROR")
        GlobalHydra.instance().clear()
        try:
            code, err = end_of(cli.main, "warp-resphys", *run.arguments, f"hydra.run.dir='{run.folder}'", *_SILENT)
        finally:
            Singleton.set_state(state)
    log_file.write_text(err, encoding="utf-8")
    return err.splitlines()[-1].removeprefix("error: ") if code else None


@contextlib.contextmanager
def runs_in_this_process() -> Iterator[None]:
    """Replaces `runs.execute`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "execute", _execute)
        yield
