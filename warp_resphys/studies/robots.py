"""Robots, each through the ordinary command from a split that does not change, and one page with a row for each."""

import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from ..data.recordings.segment import convert_segment
from ..io.atomic import digest
from ..io.errors import InputError
from ..io.files import read_json, write_json
from ..io.labels import run_label
from ..io.stages import run_lock
from ..report.page import Items, Part, figures_beside
from .robot_results import Measured, details, machines, summary, verdict
from .runs import Results, Run, asked_for, command_part, fail_for, run_all

NAME = "robots"  # of the page and of what it was made of
_PICTURES = ("figures/body.png", "fold_*/figures/body.png", "figures/registration.png")


def robots(config: Mapping[str, Any], folder: Path) -> None:
    """Runs the robots whose recordings are there; writes the page and logs into the run folder.

    With ``results``, what each run has shown is kept there in robots.json, and the page has the robots of earlier runs
    too, each with the day and the machine that measured it.

    Raises:
        InputError: a value that cannot be used, recordings that are not those of the page, or a robots.json of
            another version.
        ResphysError: a run failed; the others were run, and the page is written.
        RunsInterrupted: Ctrl-C.
    """
    wanted = asked_for(config, list(config["robots"]), "robot")
    chosen = [name for name in config["robots"] if name in wanted]
    absent = [name for name in chosen if _absent(config, name)]
    if len(absent) == len(chosen):
        where = ", ".join(str(config["robots"][name]["recordings"]) for name in absent)
        raise InputError(
            f"data is {config['data']}, where there is none of {where}: give the folder with the recordings."
        )
    kept = None if config["results"] is None else Path(config["results"]) / f"{NAME}.json"
    beyond = _beyond(config)
    with run_lock(folder):
        _check_kept(kept, [name for name in chosen if name not in absent], beyond)
        runs = [_run(config, name, folder) for name in chosen if name not in absent]
        results = run_all(runs, folder / "logs")
        new = {run.experiment: Measured.of(run, beyond) for run in results if run.failure is None}
        known = _kept(kept)  # once more: another process may have finished in the meantime
        found = {name: each for name in config["robots"] if (each := new.get(name, known.get(name))) is not None}
        page = folder / f"{NAME}.html"
        with figures_beside(page) as pictures:
            for run in results:
                _picture(run, pictures)
            if kept is not None:
                for name in found.keys() - new.keys():
                    with suppress(FileNotFoundError):
                        shutil.copy(kept.parent / NAME / f"{name}.png", pictures)
            failed = {run.experiment for run in results if run.failure is not None}
            parts = [summary(config["robots"], found, failed)]
            parts += [details(name, config["robots"][name], each, pictures) for name, each in found.items()]
        parts += [_not_run(config, results, [name for name in absent if name not in found])]
        parts += [
            machines(config["robots"], found),
            command_part("reproduce robots", hidden=("data", "runs", "results")),
        ]
        page_of = Results(
            "Robots",
            f"{datetime.now():%Y-%m-%d}",
            verdict(config["robots"], found),
            [part for part in parts if part.blocks],
        )
        page_of.write(page, config["results"], NAME)
        if kept is not None:
            write_json(kept, {name: each.plain() for name, each in {**found, **known, **new}.items()})
    fail_for(results)


def _beyond(config: Mapping[str, Any]) -> tuple[str, ...]:
    """What all robots are run with that is not their own."""
    return (*config["overrides"], *([] if config["budget"] == "full" else [f"budget={config['budget']}"]))


def _check_kept(path: Path | None, names: Sequence[str], beyond: Sequence[str]) -> None:
    """Refuses to put rows in place of those that were measured with other settings.

    Raises:
        InputError: see there, and `_kept`.
    """
    known = _kept(path)
    for name in names:
        if name in known and known[name].beyond != tuple(beyond):
            said = [" ".join(each) or "no more than its own settings" for each in (known[name].beyond, beyond)]
            raise InputError(
                f"{path} has {name} with {said[0]}, and this would replace it by one with {said[1]}: give another "
                "folder as results."
            )


def _kept(path: Path | None) -> dict[str, Measured]:
    """What earlier runs have shown, by robot; nothing where nothing is kept.

    Raises:
        InputError: the file is not one of this version.
        DataFileError: it is damaged.
    """
    if path is None or not path.is_file():
        return {}
    try:
        return {name: Measured.from_plain(each) for name, each in read_json(path).items()}
    except (InputError, AttributeError, TypeError) as error:
        raise InputError(
            f"{path} is not what this version keeps of earlier runs: move it away, and run all robots again."
        ) from error


def _absent(config: Mapping[str, Any], name: str) -> bool:
    """Whether the recordings of a robot are not there."""
    recordings = config["robots"][name]["recordings"]
    return recordings is not None and (config["data"] is None or not _place(config, name).is_dir())


def _place(config: Mapping[str, Any], name: str) -> Path:
    return Path(config["data"]).expanduser() / str(config["robots"][name]["recordings"])


def _run(config: Mapping[str, Any], name: str, folder: Path) -> Run:
    """The run of a robot, whose recordings have been checked and, where they have to be, converted."""
    robot = config["robots"][name]
    overrides = [*robot["overrides"], *_beyond(config)]
    run_folder = Path(config["runs"]) / robot["experiment"] / run_label(overrides, ("experiment", "device"))
    if robot["recordings"] is not None:
        place = _place(config, name)
        _check_files(name, place, robot["files"])
        if "segment" in robot:
            source, place = place / robot["segment"], folder / "recordings" / name
            convert_segment(source, place)
        quoted = str(place.resolve()).replace("\\", r"\\").replace("'", r"\'")
        overrides.append(f"data.folder='{quoted}'")
    arguments = (f"experiment={robot['experiment']}", *overrides)
    return Run(name, "", arguments, run_folder, robot["minutes"][config["budget"]])


def _check_files(name: str, place: Path, files: Mapping[str, str]) -> None:
    """Refuses recordings that are not those that the page is about.

    Raises:
        InputError: a file is missing, or is another one.
    """
    for file, expected in files.items():
        path = place / file
        if not path.is_file():
            raise InputError(f"{path} is missing: fetch it again, or leave {name} out of `only`.")
        if (found := digest(path)) != expected:
            raise InputError(
                f"{path} is another file than the one that {name} was measured with (SHA-256 {found[:12]}…, not "
                f"{expected[:12]}…): fetch it again, or run `experiment={name}` by itself."
            )


def _picture(run: Run, pictures: Path) -> None:
    """Copies the body as the report of the run has it, if it has."""
    found = next((path for pattern in _PICTURES for path in sorted(run.folder.glob(pattern))), None)
    if found is not None and run.failure is None:
        shutil.copy(found, pictures / f"{run.experiment}.png")


def _not_run(config: Mapping[str, Any], results: Sequence[Run], absent: Sequence[str]) -> Part:
    """What failed, and whose recordings are not there."""
    titles = {name: each["title"] for name, each in config["robots"].items()}
    items = [f"{titles[run.experiment]} failed: {run.failure}" for run in results if run.failure is not None]
    items += [
        f"{titles[name]}: no folder {known['recordings']} in `data`. {known['source']}"
        for name, known in ((name, config["robots"][name]) for name in absent)
    ]
    return Part("Not run", [Items(items)] if items else [])
