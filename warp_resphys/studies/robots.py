"""Robots, each through the ordinary command from a split that does not change, and one page with a row for each."""

import shlex
import shutil
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from ..io.errors import InputError
from ..io.files import digest
from ..io.labels import run_label
from ..io.stages import run_lock
from ..learning.metrics import Gain, paired_gain
from ..report.page import (
    MINUS,
    NONE,
    Block,
    Cell,
    Drawn,
    Items,
    Part,
    Row,
    Table,
    Text,
    drawn_file,
    duration_text,
    error_parts,
    figures_beside,
    number_text,
)
from ..report.verdict import held_out, learned_in_part
from .preparation import CONVERTERS
from .runs import Results, Run, asked_for, fail_for, made, run_all

PAGE = "robots.html"
_MODELS = ("simulation", "sysid", "simfree", "resphys")
_GAINS = (("sysid", "simulation"), ("resphys", "sysid"))  # of the first over the second
_PICTURES = ("figures/body.png", "fold_*/figures/body.png", "figures/registration.png")


def robots(config: Mapping[str, Any], folder: Path) -> None:
    """Runs the robots whose recordings are there; writes the page and logs into the run folder.

    Raises:
        InputError: a value that cannot be used, or recordings that are not those of the page.
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
    with run_lock(folder):
        runs = [_run(config, name, folder) for name in chosen if name not in absent]
        results = run_all(runs, folder / "logs")
        page = folder / PAGE
        with figures_beside(page) as pictures:
            parts = [_summary(config, results)]
            parts += [_robot(config["robots"][run.experiment], run, pictures) for run in results]
        if absent:
            parts.append(_not_run(config, absent))
        page_of = Results(
            "Robots",
            f"{datetime.now():%Y-%m-%d}",
            _verdict(config, results),
            [*parts, made("robots", hidden=("data",))],
        )
        page_of.write(page, config["results"], "robots")
    fail_for(results)


def _absent(config: Mapping[str, Any], name: str) -> bool:
    """Whether the recordings of a robot are not there."""
    recordings = config["robots"][name]["recordings"]
    return recordings is not None and (config["data"] is None or not _place(config, name).is_dir())


def _place(config: Mapping[str, Any], name: str) -> Path:
    return Path(config["data"]).expanduser() / str(config["robots"][name]["recordings"])


def _run(config: Mapping[str, Any], name: str, folder: Path) -> Run:
    """The run of a robot, whose recordings have been checked and, where they have to be, converted."""
    robot = config["robots"][name]
    overrides = [*robot["overrides"], *config["overrides"]]
    if config["budget"] != "full":
        overrides.append(f"budget={config['budget']}")
    run_folder = Path(config["runs"]) / robot["experiment"] / run_label(overrides, ("experiment", "device"))
    if robot["recordings"] is not None:
        place = _place(config, name)
        _check_files(name, place, robot["files"])
        if "convert" in robot:
            source, place = place / robot["convert"]["source"], folder / "recordings" / name
            CONVERTERS[robot["convert"]["layout"]](source, place)
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


def _summary(config: Mapping[str, Any], results: Sequence[Run]) -> Part:
    """A row for each robot."""
    rows = []
    for run in results:
        robot = config["robots"][run.experiment]
        if run.failure is not None:
            rows.append(Row(robot["title"], [Cell(NONE)] * (len(_MODELS) + len(_GAINS) + 1) + [Cell("failed")]))
            continue
        metrics = run.metrics
        errors = metrics["errors_mm"]
        cells = [Cell(*error_parts(errors[model])) if model in errors else Cell(NONE) for model in _MODELS]
        cells += [Cell(_gain(metrics, after, before)) for after, before in _GAINS]
        cells.append(Cell(_coverage(metrics)))
        rows.append(Row(robot["title"], [*cells, Cell(duration_text(_seconds(metrics)))], small=robot["actuation"]))
    note = (
        "Mean distance of the markers in what no training and no identification saw [mm], ± the standard "
        "deviation over trials. Less error: the share that SysID takes away of the uncorrected error, and ResPhys of "
        "SysID's, with the interval that holds it in nine of ten draws of the trials (paired bootstrap). Coverage: of "
        "the measured coordinates, those within the 90 % prediction intervals of ResPhys, and how wide these are on "
        "average. Time: all stages, beside whatever else the machine did."
    )
    columns = [
        "Uncorrected",
        "SysID",
        "SimFree",
        "ResPhys",
        "Less error by SysID",
        "Less error by ResPhys",
        "Coverage",
        "Time",
    ]
    return Part("All robots", [Table("Robot", columns, rows, note)])


def _gain(metrics: Mapping[str, Any], after: str, before: str) -> str:
    """By how much a model is better than another on held-out trials, with its interval."""
    found = _paired(metrics, after, before)
    if found is None:
        return NONE
    share, *ends = (f"{100.0 * each:.0f}".replace("-", MINUS) for each in (found.share, found.lower, found.upper))
    return f"{share} %" if found.trials == 1 else f"{share} % ({' to '.join(ends)})"


def _coverage(metrics: Mapping[str, Any]) -> str:
    """How often the prediction intervals of the learned force hold, and their mean half-width."""
    found = metrics.get("intervals", {}).get("models", {}).get("resphys")
    return NONE if found is None else f"{100.0 * found['coverage']:.0f} % (± {found['half_width_mm']:.2g} mm)"


def _paired(metrics: Mapping[str, Any], after: str, before: str) -> Gain | None:
    """The gain of one model over another; None where a roll-out diverged."""
    pairs = [(row.get(before), row.get(after)) for row in held_out(metrics)]
    known = [(b, a) for b, a in pairs if a is not None and b]
    if not known or len(known) < len(pairs):
        return None
    return paired_gain([b for b, _ in known], [a for _, a in known])


def _seconds(metrics: Mapping[str, Any]) -> float:
    """Of all stages, those of the folds included."""
    every = [metrics, *metrics.get("folds", {}).values()]
    return float(sum(sum(each["seconds"].values()) for each in every))


def _robot(robot: Mapping[str, Any], run: Run, pictures: Path) -> Part:
    """A robot: its picture, where its recordings come from, what was tested, and what was published."""
    source: list[Block] = [Text(f"{robot['actuation'][:1].upper()}{robot['actuation'][1:]}. {robot['source']}")]
    shown = ["data.folder=FOLDER" if each.startswith("data.folder=") else each for each in run.arguments]
    command = Items([shlex.join(["warp-resphys", *shown])], code=True)
    if run.failure is not None:
        return Part(robot["title"], [*source, Text(f"It failed: {run.failure}"), command])
    metrics = run.metrics
    names = list(metrics.get("folds", {})) or [row["name"] for row in metrics["per_trajectory"]]
    how = "each of them kept back once" if "folds" in metrics and len(names) > 1 else "kept back"
    how = "in the part that was not learned from" if learned_in_part(run.settings, names) else how
    said = [f"Tested on {len(names)} trial{'s' if len(names) > 1 else ''}, {how}: {', '.join(names)}."]
    if "mesh_check" in metrics and "moved_mm" in metrics["mesh_check"]:
        moved = number_text(metrics["mesh_check"]["moved_mm"])
        said.append(f"On a finer mesh the markers of the identified simulator are {moved} mm elsewhere.")
    blocks = [*_picture(robot, run, pictures), *source, Text(" ".join(said))]
    if robot["published"]:
        blocks += [Text("Published", heading=True), Items(robot["published"])]
    return Part(robot["title"], [*blocks, command])


def _picture(robot: Mapping[str, Any], run: Run, pictures: Path) -> list[Drawn]:
    """The body as the report of the run has it; none where that lacks it."""
    found = next((path for pattern in _PICTURES for path in sorted(run.folder.glob(pattern))), None)
    if found is None:
        return []
    path = Path(shutil.copy(found, pictures / f"{run.experiment}.png"))
    return [drawn_file(path, f"The body of {robot['title']} and its markers.", "The body as it is simulated.")]


def _not_run(config: Mapping[str, Any], absent: Sequence[str]) -> Part:
    items = [
        f"{known['title']}: no folder {known['recordings']} in `data`. {known['source']}"
        for known in (config["robots"][name] for name in absent)
    ]
    return Part("Not run", [Items(items)])


def _verdict(config: Mapping[str, Any], results: Sequence[Run]) -> str:
    """The robots on which each step helps, in a sentence."""
    done = [run for run in results if run.failure is None]
    helped = [config["robots"][run.experiment]["title"] for run in done if _helps(run.metrics)]
    if not done:
        return "No run has succeeded."
    which = f"{len(helped)} of {len(done)} robots" + (f" ({', '.join(helped)})" if helped else "")
    return f"The learned force takes away error that identification leaves, and other trials would show it, on {which}."


def _helps(metrics: Mapping[str, Any]) -> bool:
    """Whether the learned force is better than identification in nine of ten draws of the trials."""
    found = _paired(metrics, "resphys", "sysid")
    return found is not None and found.trials > 1 and found.lower > 0.0
