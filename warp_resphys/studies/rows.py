"""Settings of the command `reproduce`, conf/reproduce.yaml, and the runs of its rows: published beams and robots."""

from pathlib import Path
from typing import Literal

from pydantic import ConfigDict

from ..data.recordings.segment import convert_segment
from ..io.atomic import digest
from ..io.errors import InputError
from ..io.labels import run_label
from ..io.settings import Many, Positive, Settings, Some, Word, setting
from .runs import Run

BEAMS, ROBOTS = "beams", "robots"  # words for all rows of a kind


class Minutes(Settings):
    """Expected time of a run on two cores, for the estimate of what remains."""

    full: Positive = setting(unit="min")
    quick: Positive = setting(unit="min")


class Variant(Settings):
    """A column of the tables of published beams."""

    label: Word
    overrides: Many[Word]
    minutes: Minutes


class Beam(Settings):
    """A published experiment."""

    title: Word
    variants: Some[Word] = setting(description="columns, the first one first")
    drawn: dict[str, str] = setting(description="variant of the models, and of the published network, in figures")
    overrides: Many[Word]
    deviations: Many[Word] = setting(description="why results differ from what was published")


class RecordedRobot(Settings):
    """A robot with a fixed split of its trials, recorded by others or played by a simulation."""

    title: Word
    actuation: Word
    experiment: Word
    overrides: Many[Word]
    recordings: Word | None = setting(description="folder in `data`; null: a finer simulation plays the robot")
    segment: Word | None = setting(None, "file with all trials of the published segment, converted into recordings")
    source: Word
    files: dict[str, str] = setting({}, "SHA-256 by file")
    published: Many[Word]
    minutes: Minutes


class Timing(Settings):
    """The published time benchmark: the experiment and the variants that are compared with it."""

    experiment: Word
    variants: Some[Word]
    deviations: Many[Word]


class Reproduction(Settings):
    """The configuration ``reproduce``; keys of runs, which ``budget=quick`` adds to it, are ignored."""

    model_config = ConfigDict(extra="ignore")

    budget: Literal["full", "quick"]
    data: Word | None = setting(description="folder with the folders of recordings")
    only: Some[Word] | None = setting(description="names of rows or runs, or the words beams and robots; null: beams")
    overrides: Many[Word] = setting(description="of every run")
    runs: Word = setting(description="folder of the runs")
    results: Word | None = setting(description="folder for pages as Markdown, with their figures")
    variants: dict[str, Variant]
    experiments: dict[str, Beam]
    timing: Timing
    robots: dict[str, RecordedRobot]

    @property
    def beyond(self) -> tuple[str, ...]:
        """Overrides of all runs, beside those of their rows."""
        return (*self.overrides, *([] if self.budget == "full" else [f"budget={self.budget}"]))

    def beams(self) -> list[Run]:
        """The selected runs of published beams, in order.

        Raises:
            InputError: an unknown name.
        """
        pairs = [(name, variant) for name, beam in self.experiments.items() for variant in beam.variants]
        for name, variant in pairs:
            if variant not in self.variants:
                raise InputError(
                    f"experiments.{name}.variants names {variant!r}: there are {', '.join(self.variants)}."
                )
        names = [BEAMS, ROBOTS, *self.experiments, *self.robots, *("/".join(pair) for pair in pairs)]
        wanted = self.only or (BEAMS,)
        if unknown := [name for name in wanted if name not in names]:
            raise InputError(f"only names {unknown[0]!r}: there are {', '.join(names)}.")
        return [self._beam(*pair) for pair in pairs if {BEAMS, pair[0], "/".join(pair)} & {*wanted}]

    def _beam(self, name: str, variant: str) -> Run:
        chosen = self.variants[variant]
        overrides = [*chosen.overrides, *self.experiments[name].overrides, *self.beyond]
        folder = Path(self.runs) / name / run_label(overrides, ("experiment", "device"))
        arguments = (f"experiment={name}", *overrides)
        return Run(name, variant, arguments, folder, getattr(chosen.minutes, self.budget))

    def wanted_robots(self) -> tuple[list[str], list[str]]:
        """Names of the selected robots: those that can be run, and those whose recordings are missing.

        Raises:
            InputError: none of them can be run.
        """
        wanted = set(self.only or ())
        chosen = [name for name in self.robots if {ROBOTS, name} & wanted]
        recorded = [name for name in chosen if self.robots[name].recordings is not None]
        absent = [name for name in recorded if self.data is None or not self._place(name).is_dir()]
        if chosen and len(absent) == len(chosen):
            where = ", ".join(str(self.robots[name].recordings) for name in absent)
            raise InputError(f"data is {self.data}, where there is none of {where}: give the folder with recordings.")
        return [name for name in chosen if name not in absent], absent

    def _place(self, name: str) -> Path:
        return Path(str(self.data)).expanduser() / str(self.robots[name].recordings)

    def robot(self, name: str, folder: Path) -> Run:
        """The run of a robot.

        Args:
            name: of the robot.
            folder: for converted recordings.

        Raises:
            InputError: its recordings are not those of the row.
        """
        robot = self.robots[name]
        overrides = [*robot.overrides, *self.beyond]
        run_folder = Path(self.runs) / robot.experiment / run_label(overrides, ("experiment", "device"))
        if robot.recordings is not None:
            place = self._place(name)
            _check_files(name, place, robot.files)
            if robot.segment is not None:
                convert_segment(place / robot.segment, folder / "recordings" / name)
                place = folder / "recordings" / name
            quoted = str(place.resolve()).replace("\\", r"\\").replace("'", r"\'")
            overrides.append(f"data.folder='{quoted}'")
        arguments = (f"experiment={robot.experiment}", *overrides)
        return Run(name, "", arguments, run_folder, getattr(robot.minutes, self.budget))


def _check_files(name: str, place: Path, files: dict[str, str]) -> None:
    """Refuses recordings whose SHA-256 differs from that of the row."""
    for file, expected in files.items():
        path = place / file
        if not path.is_file():
            raise InputError(f"{path} is missing: fetch it again, or leave {name} out of `only`.")
        if (actual := digest(path)) != expected:
            raise InputError(
                f"{path} differs from the file that {name} was measured with (SHA-256 {actual[:12]}…, not "
                f"{expected[:12]}…): fetch it again, or run `experiment={name}` by itself."
            )
