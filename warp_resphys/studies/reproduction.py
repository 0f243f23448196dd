"""The command `reproduce`: runs published beams and recorded robots, and writes a page on each of the two."""

import shutil
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from ..io.files import write_json
from ..io.stages import run_lock
from ..report.page import Canvas, Items, Part, figures_beside
from . import robot_results
from .comparison import compare
from .robot_results import Measured
from .rows import BEAMS, ROBOTS, Reproduction
from .runs import Results, Run, command_part, fail_for, made, run_all

_PICTURES = ("figures/body.png", "fold_*/figures/body.png", "figures/registration.png")
_HIDDEN = ("data", "runs", "results")  # keys whose values are folders of this machine


def reproduce(settings: Reproduction, folder: Path) -> None:
    """Runs the selected rows; writes logs, and a page on beams and one on robots, into the run folder.

    With ``results``, the page on beams is also written there, under its date, and that on robots as robots.md.
    robots.json keeps the results of each robot, so that the page includes robots of earlier runs, with day and machine.

    Raises:
        InputError: recordings that are not those of a row, or a robots.json that cannot be continued.
        ResphysError: a run failed; the others were run, and the pages are written.
        RunsInterrupted: Ctrl-C.
    """
    beams = settings.beams()
    present, absent = settings.wanted_robots()
    with run_lock(folder):
        kept = None if settings.results is None else Path(settings.results) / f"{ROBOTS}.json"
        robot_results.check_kept(kept, present, settings.beyond)
        robots = [settings.robot(name, folder) for name in present]
        results = run_all([*beams, *robots], folder / "logs")
        if beams:
            _write_beams(settings, results[: len(beams)], folder / BEAMS / "reproduction.html")
        if robots:
            _write_robots(settings, results[len(beams) :], absent, kept, folder / ROBOTS / f"{ROBOTS}.html")
    fail_for(results)


def _write_beams(settings: Reproduction, results: Sequence[Run], page: Path) -> None:
    """Writes the page that compares published results with ours."""
    with figures_beside(page) as pictures:
        verdict, parts = compare(settings, results, Canvas(pictures))
    date = f"{datetime.now():%Y-%m-%d}"
    parts.append(made("reproduce", _HIDDEN))
    Results("Reproduction", date, verdict, parts).write(page, settings.results, f"{date}-reproduction")


def _write_robots(
    settings: Reproduction, results: Sequence[Run], absent: Sequence[str], kept: Path | None, page: Path
) -> None:
    """Writes the page with a row for each robot, from this run or an earlier one."""
    new = {run.experiment: Measured.of_run(run, settings.beyond) for run in results if run.failure is None}
    earlier = robot_results.read_kept(kept)  # again, as another process may have finished in the meantime
    measured = {name: row for name in settings.robots if (row := new.get(name, earlier.get(name))) is not None}
    failed = {run.experiment: str(run.failure) for run in results if run.failure is not None}
    with figures_beside(page) as pictures:
        for run in results:
            body = next((path for pattern in _PICTURES for path in sorted(run.folder.glob(pattern))), None)
            if body is not None and run.failure is None:
                shutil.copy(body, pictures / f"{run.experiment}.png")
        for name in measured.keys() - new.keys():
            with suppress(FileNotFoundError):
                shutil.copy(Path(str(settings.results)) / ROBOTS / f"{name}.png", pictures)
        parts = [robot_results.summary(settings.robots, measured, failed)]
        parts += [robot_results.details(name, settings.robots[name], row, pictures) for name, row in measured.items()]
    items = [f"{settings.robots[name].title} failed: {failure}" for name, failure in failed.items()]
    for robot in (settings.robots[name] for name in absent if name not in measured):
        items.append(f"{robot.title}: no folder {robot.recordings} in `data`. {robot.source}")
    parts += [Part("Not run", [Items(items)])] if items else []
    parts += [robot_results.machines(settings.robots, measured), command_part("reproduce", _HIDDEN)]
    verdict, date = robot_results.verdict(settings.robots, measured), f"{datetime.now():%Y-%m-%d}"
    Results("Robots", date, verdict, [part for part in parts if part.blocks]).write(page, settings.results, ROBOTS)
    if kept is not None:
        write_json(kept, {name: row.plain() for name, row in {**measured, **earlier, **new}.items()})
