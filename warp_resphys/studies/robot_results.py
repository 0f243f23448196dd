"""Results of the runs of robots, how they are kept, and the parts of the page on them."""

import shlex
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..io.errors import InputError
from ..io.files import read_json
from ..io.settings import Many, Natural, NotNegative, Settings, Some, Word, parse, setting
from ..learning.metrics import paired_gain
from ..report.conclusions import held_out
from ..report.page import (
    MINUS,
    NONE,
    Block,
    Cell,
    Drawn,
    Items,
    PageTable,
    Part,
    Row,
    Text,
    drawn_file,
    duration_text,
    error_parts,
    number_text,
)
from ..report.verdict import learned_in_part
from .rows import RecordedRobot
from .runs import Run

_MODELS = ("simulation", "sysid", "simfree", "resphys")
_GAINS = {"sysid": "simulation", "resphys": "sysid"}  # over what
_MACHINE = {"processor": "Processor", "cores used": "Cores used", "GPU": "GPU", "commit": "Commit"}
_PACKAGES = ("python", "warp-lang", "torch")


class Share(Settings):
    """By which share a model takes away of another one's error on held-out trials; see `metrics.Gain`."""

    share: float
    lower: float
    upper: float
    trials: Natural


class Measured(Settings):
    """Results of the run of a robot."""

    day: Word = setting(description="on which its errors were measured (UTC)")
    machine: dict[str, str] = setting(description="on which, with the commit and the packages")
    arguments: Many[Word] = setting(description="of the command, without folders of that machine")
    beyond: Many[Word] = setting(description="those that are not the robot's own, such as budget=quick")
    tested: Some[Word] = setting(description="trials")
    how: Word = setting(description="the trials were kept from the training")
    errors_mm: dict[str, dict[str, Any]] = setting(description="by model, as metrics.json has them")
    gains: dict[str, Share | None] = setting(description="by model over the one that it corrects; null: it diverged")
    intervals: dict[str, Any] | None = setting(description="of ResPhys, with coverage and half_width_mm")
    seconds: NotNegative = setting(description="of all stages", unit="s")
    moved_mm: float | None = setting(description="markers of the identified simulator on a finer mesh", unit="mm")

    @classmethod
    def of_run(cls, run: Run, beyond: Sequence[str]) -> "Measured":
        """Reads the folder of a run that has succeeded."""
        metrics, made = run.metrics, run.evaluation
        tested = list(metrics.get("folds", {})) or [row["name"] for row in metrics["per_trajectory"]]
        how = "each of them kept back once" if "folds" in metrics and len(tested) > 1 else "kept back"
        how = "in the part that was not learned from" if learned_in_part(run.settings, tested) else how
        return cls(
            day=str(made["finished"]).partition("T")[0],
            machine={**made.get("machine", {}), **made["versions"]},
            arguments=tuple("data.folder=FOLDER" if x.startswith("data.folder=") else x for x in run.arguments),
            beyond=tuple(beyond),
            tested=tuple(tested),
            how=how,
            errors_mm={model: metrics["errors_mm"][model] for model in _MODELS if model in metrics["errors_mm"]},
            gains={model: _gain(metrics, model, other) for model, other in _GAINS.items()},
            intervals=metrics.get("intervals", {}).get("models", {}).get("resphys"),
            seconds=_seconds(metrics),
            moved_mm=metrics.get("mesh_check", {}).get("moved_mm"),
        )

    @property
    def is_helped(self) -> bool:
        """Whether the learned force is better than identification in nine of ten draws of several trials."""
        gain = self.gains["resphys"]
        return gain is not None and gain.trials > 1 and gain.lower > 0.0


def read_kept(path: Path | None) -> dict[str, Measured]:
    """Results of earlier runs, by robot; nothing where there is no file.

    Raises:
        InputError: the file is not one of this version.
        DataFileError: it is damaged.
    """
    if path is None or not path.is_file():
        return {}
    try:
        return {name: parse(Measured, each, name) for name, each in read_json(path).items()}
    except (InputError, AttributeError) as error:
        raise InputError(
            f"{path} is not what this version keeps of earlier runs ({error}): move it away, and run all robots again."
        ) from error


def check_kept(path: Path | None, names: Sequence[str], beyond: Sequence[str]) -> None:
    """Refuses to put rows in place of those that were measured with other settings.

    Raises:
        InputError: there is such a row; see also `read_kept`.
    """
    known = read_kept(path)
    for name in names:
        if name in known and known[name].beyond != tuple(beyond):
            said = [" ".join(each) or "no more than its own settings" for each in (known[name].beyond, beyond)]
            raise InputError(
                f"{path} has {name} with {said[0]}, and this would replace it by one with {said[1]}: give another "
                "folder as results."
            )


def _gain(metrics: Mapping[str, Any], after: str, before: str) -> Share | None:
    """By how much a model is better than another on held-out trials; None where a roll-out diverged."""
    pairs = [(row.get(before), row.get(after)) for row in held_out(metrics)]
    known = [(b, a) for b, a in pairs if a is not None and b]
    if not known or len(known) < len(pairs):
        return None
    return Share(**paired_gain([b for b, _ in known], [a for _, a in known])._asdict())


def _seconds(metrics: Mapping[str, Any]) -> float:
    """Of all stages, those of the folds included."""
    every = [metrics, *metrics.get("folds", {}).values()]
    return float(sum(sum(each["seconds"].values()) for each in every))


def summary(robots: Mapping[str, RecordedRobot], found: Mapping[str, Measured], failed: Container[str]) -> Part:
    """One row per robot. A robot whose run failed keeps its last known result."""
    rows = []
    for name, each in found.items():
        errors = each.errors_mm
        cells = [Cell(*error_parts(errors[model])) if model in errors else Cell(NONE) for model in _MODELS]
        cells += [Cell(_gain_text(gain)) for gain in each.gains.values()]
        cells += [Cell(_coverage(each.intervals)), Cell(duration_text(each.seconds))]
        small = [robots[name].actuation, *each.beyond, *([f"failed since {each.day}"] if name in failed else [])]
        rows.append(Row(robots[name].title, cells, small="; ".join(small)))
    note = (
        "Mean distance of the markers in what no training and no identification saw [mm], ± the standard "
        "deviation over trials. Less error: the share that SysID takes away of the uncorrected error, and ResPhys of "
        "SysID's, with the interval that holds it in nine of ten draws of the trials (paired bootstrap). Coverage: of "
        "the measured coordinates, those within the 90 % prediction intervals of ResPhys, and how wide these are on "
        "average. Time: all stages, also of folds that ran at once, beside whatever else the machine did."
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
    return Part("All robots", [PageTable("Robot", columns, rows, note)] if rows else [])


def _gain_text(gain: Share | None) -> str:
    if gain is None:
        return NONE
    share, *ends = (f"{100.0 * each:.0f}".replace("-", MINUS) for each in (gain.share, gain.lower, gain.upper))
    return f"{share} %" if gain.trials == 1 else f"{share} % ({' to '.join(ends)})"


def _coverage(intervals: Mapping[str, Any] | None) -> str:
    """How often the prediction intervals of the learned force hold, and their mean half-width."""
    if intervals is None:
        return NONE
    return f"{100.0 * intervals['coverage']:.0f} % (± {intervals['half_width_mm']:.2g} mm)"


def details(name: str, robot: RecordedRobot, found: Measured, pictures: Path) -> Part:
    """A robot: its picture, where its recordings come from, what was tested, and what was published."""
    source = Text(f"{robot.actuation[:1].upper()}{robot.actuation[1:]}. {robot.source}")
    count = len(found.tested)
    said = [f"Tested on {count} trial{'s' if count > 1 else ''}, {found.how}: {', '.join(found.tested)}."]
    if found.moved_mm is not None:
        moved = number_text(found.moved_mm)
        said.append(f"On a finer mesh the markers of the identified simulator are {moved} mm elsewhere.")
    blocks: list[Block] = [*_drawn(name, robot, pictures), source, Text(" ".join(said))]
    if robot.published:
        blocks += [Text("Published", heading=True), Items(robot.published)]
    return Part(robot.title, [*blocks, Items([shlex.join(["warp-resphys", *found.arguments])], code=True)])


def _drawn(name: str, robot: RecordedRobot, pictures: Path) -> list[Drawn]:
    """The body; none where no picture was drawn."""
    path = pictures / f"{name}.png"
    if not path.is_file():
        return []
    return [drawn_file(path, f"The body of {robot.title} and its markers.", "The body as it is simulated.")]


def machines(robots: Mapping[str, RecordedRobot], found: Mapping[str, Measured]) -> Part:
    """When each robot was measured, on which machine and with which versions."""
    columns = ["Measured", *_MACHINE.values(), *_PACKAGES]
    rows = [
        Row(
            robots[name].title,
            [Cell(each.day), *(Cell(each.machine.get(key, NONE)) for key in (*_MACHINE, *_PACKAGES))],
        )
        for name, each in found.items()
    ]
    return Part("Machines and versions", [PageTable("Robot", columns, rows)] if rows else [])


def verdict(robots: Mapping[str, RecordedRobot], found: Mapping[str, Measured]) -> str:
    """The robots on which the learned force helps, in a sentence."""
    if not found:
        return "No run has succeeded."
    helped: Sequence[str] = [robots[name].title for name, each in found.items() if each.is_helped]
    which = f"{len(helped)} of {len(found)} robots" + (f" ({', '.join(helped)})" if helped else "")
    return f"The learned force takes away error that identification leaves, and other trials would show it, on {which}."
