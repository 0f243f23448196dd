"""Results of the runs of robots: how they are stored, and their sections on the page of robots."""

import shlex
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..io.errors import InputError
from ..io.files import read_json
from ..io.settings import Many, Natural, NotNegative, Settings, Some, Word, parse, setting
from ..learning.baselines import BASELINES
from ..learning.metrics import paired_gain
from ..report.conclusions import epochs_kept, trial_errors, untrained
from ..report.data import MODELS, models_in_figures
from ..report.notes import in_a_row
from ..report.page import (
    MINUS,
    NONE,
    Block,
    Cell,
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
from ..report.recommendation import LEAST_TRIALS, best_pair, model_name
from ..report.verdict import learned_in_part
from .rows import RecordedRobot
from .runs import Run

_MODELS = ("simulation", "sysid", "law", "simfree", "resphys")
_COLUMNS = {"simulation": "Uncorrected", "sysid": "SysID", "law": "Law", "simfree": "SimFree", "resphys": "ResPhys"}
_MACHINE = {"processor": "Processor", "cores used": "Cores used", "GPU": "GPU", "commit": "Commit"}
_PACKAGES = ("python", "warp-lang", "torch")


class Share(Settings):
    """Share of another model's error on held-out trials that a model removes, as `metrics.Gain`."""

    share: float
    lower: float
    upper: float
    trials: Natural


class Beside(Settings):
    """The best corrected model and the best of all other models, including predictions without physics."""

    corrected: Word
    other: Word
    gain: Share


class Measured(Settings):
    """Results of the run of a robot."""

    day: Word = setting(description="of the measurement (UTC)")
    machine: dict[str, str] = setting(description="hardware, commit and versions of packages")
    arguments: Many[Word] = setting(description="of the command, without folders of that machine")
    beyond: Many[Word] = setting(description="arguments beside those of the robot's row, such as budget=quick")
    tested: Some[Word] = setting(description="test trials")
    how: Word = setting(description="how the test trials were kept from the training")
    errors_mm: dict[str, dict[str, Any]] = setting(description="by model, as metrics.json has them")
    beside: Beside | None = setting(None, "the best corrected model beside the best of all others")
    gains: dict[str, Share | None] = setting(description="by model over the one that it corrects; null: it diverged")
    intervals: dict[str, Any] | None = setting(description="of ResPhys, with coverage and half_width_mm")
    seconds: NotNegative = setting(description="of all stages", unit="s")
    moved_mm: float | None = setting(description="markers of the identified simulator on a finer mesh", unit="mm")

    @classmethod
    def of_run(cls, run: Run, beyond: Sequence[str]) -> "Measured":
        """Reads the results from the folder of a successful run."""
        metrics, made = run.metrics, run.evaluation
        tested = list(metrics.get("folds", {})) or [row["name"] for row in metrics["per_trajectory"]]
        how = "each held out once" if "folds" in metrics and len(tested) > 1 else "held out"
        how = "in the part that was not used for training" if learned_in_part(run.settings, tested) else how
        return cls(
            day=str(made["finished"]).partition("T")[0],
            machine={**made.get("machine", {}), **made["versions"]},
            arguments=tuple("data.folder=FOLDER" if x.startswith("data.folder=") else x for x in run.arguments),
            beyond=tuple(beyond),
            tested=tuple(tested),
            how=how,
            errors_mm={
                model: metrics["errors_mm"][model] for model in (*BASELINES, *_MODELS) if model in metrics["errors_mm"]
            },
            beside=_beside(metrics),
            gains={model: _gain(metrics, model, other) for model, other in _corrected(metrics["errors_mm"]).items()},
            intervals=metrics.get("intervals", {}).get("models", {}).get("resphys"),
            seconds=sum(sum(part["seconds"].values()) for part in (metrics, *metrics.get("folds", {}).values())),
            moved_mm=metrics.get("mesh_check", {}).get("moved_mm"),
        )

    @property
    def is_helped(self) -> bool:
        """Whether the learned force reduces the error of identification, by the 90 % interval over the trials."""
        return _is_clear(self.gains["resphys"])

    @property
    def is_needed(self) -> bool:
        """Whether a corrected model is better than all others, by the 90 % interval over the trials."""
        return self.beside is not None and _is_clear(self.beside.gain)


def _is_clear(gain: Share | None) -> bool:
    return gain is not None and gain.trials >= LEAST_TRIALS and gain.lower > 0.0


def _beside(metrics: Mapping[str, Any]) -> Beside | None:
    errors = {model: own for model, own in trial_errors(metrics).items() if model in (*BASELINES, *_MODELS)}
    corrected, other = best_pair(errors, untrained(epochs_kept(metrics)))
    gain = _gain(metrics, corrected, other)
    return None if gain is None else Beside(corrected=corrected, other=other, gain=gain)


def read_kept(path: Path | None) -> dict[str, Measured]:
    """Results of earlier runs, by robot; empty without a file.

    Raises:
        InputError: the file was written by another version.
        DataFileError: the file is damaged.
    """
    if path is None or not path.is_file():
        return {}
    try:
        return {name: parse(Measured, row, name) for name, row in read_json(path).items()}
    except (InputError, AttributeError) as error:
        raise InputError(
            f"{path} was not written by this version ({error}): move it away, and run all robots again."
        ) from error


def check_kept(path: Path | None, names: Sequence[str], beyond: Sequence[str]) -> None:
    """Refuses to replace rows that were measured with other settings.

    Raises:
        InputError: a robot has such a row; see also `read_kept`.
    """
    kept = read_kept(path)
    for name in names:
        if name in kept and kept[name].beyond != tuple(beyond):
            old, new = (" ".join(arguments) or "its own settings alone" for arguments in (kept[name].beyond, beyond))
            raise InputError(
                f"{path} has {name} with {old}, and this run would replace it by one with {new}: give another folder "
                "as results."
            )


def _corrected(errors: Mapping[str, Any]) -> dict[str, str]:
    """By model, the one that it corrects."""
    if "law" in errors:
        return {"sysid": "simulation", "law": "sysid" if "sysid" in errors else "simulation", "resphys": "law"}
    return {"sysid": "simulation", "resphys": "sysid"}


def _gain(metrics: Mapping[str, Any], after: str, before: str) -> Share | None:
    """Gain of a model over another on held-out trials; None where a roll-out diverged."""
    errors = trial_errors(metrics)
    pairs = [*zip(errors.get(before, ()), errors.get(after, ()), strict=True)]
    finite = [(b, a) for b, a in pairs if a is not None and b]
    if not finite or len(finite) < len(pairs):
        return None
    return Share(**paired_gain([b for b, _ in finite], [a for _, a in finite])._asdict())


def summary(robots: Mapping[str, RecordedRobot], measured: Mapping[str, Measured], failed: Container[str]) -> Part:
    """One row per robot. A robot whose run failed keeps its last known result."""
    rows = []
    with_law = any("law" in result.errors_mm for result in measured.values())
    models = [model for model in _MODELS if model != "law" or with_law]
    gained = [model for model in ("sysid", "law", "resphys") if model in models]
    for name, result in measured.items():
        errors = result.errors_mm
        plain = next((model for model in models_in_figures(errors) if model in BASELINES), None)
        cells = [Cell(NONE) if plain is None else Cell(number_text(errors[plain]["mean"]), MODELS[plain][0].lower())]
        cells += [Cell(*error_parts(errors[model])) if model in errors else Cell(NONE) for model in models]
        cells += [Cell(_gain_text(result.gains.get(model))) for model in gained]
        held = result.intervals
        coverage = f"{100.0 * held['coverage']:.0f} % (± {held['half_width_mm']:.2g} mm)" if held is not None else NONE
        cells += [Cell(coverage), Cell(duration_text(result.seconds))]
        small = [robots[name].actuation, *result.beyond, *([f"failed since {result.day}"] if name in failed else [])]
        rows.append(Row(robots[name].title, cells, small="; ".join(small)))
    note = (
        "Mean distance of the markers on data that neither training nor identification used [mm], ± the standard "
        "deviation over trials. Without physics: the best of a body at rest, interpolation and kernel regression "
        "between the training trials, and a linear model. Less error: the share of the uncorrected error that SysID "
        "removes, and of SysID's error that ResPhys removes, with its 90 % interval over the trials (paired bootstrap) "
        f"if there are {LEAST_TRIALS} or more. Coverage: the share of the "
        "measured coordinates within the 90 % prediction intervals of ResPhys, and their mean half-width. Time: the "
        "sum over all stages and folds, including those that ran in parallel, on a machine with other load."
    )
    if with_law:
        note += " With a law of the material, the law is compared with SysID, and ResPhys with the law."
    columns = [f"{words} [mm]" for words in ("Without physics", *(_COLUMNS[model] for model in models))]
    columns += [*(f"Less error by {_COLUMNS[model]}" for model in gained), "Coverage", "Time"]
    return Part("All robots", [PageTable("Robot", columns, rows, note)] if rows else [])


def _gain_text(gain: Share | None) -> str:
    if gain is None:
        return NONE
    share, *ends = (f"{100.0 * value:.0f}".replace("-", MINUS) for value in (gain.share, gain.lower, gain.upper))
    return f"{share} %" if gain.trials < LEAST_TRIALS else f"{share} % ({' to '.join(ends)})"


def details(name: str, robot: RecordedRobot, result: Measured, pictures: Path) -> Part:
    """A section on a robot: its picture, the source of its recordings, its test trials, and published results."""
    count, path = len(result.tested), pictures / f"{name}.png"
    alt = f"The body of {robot.title} and its markers."
    text = [f"Tested on {count} trial{'s' if count > 1 else ''}, {result.how}: {', '.join(result.tested)}."]
    if result.beside is not None:
        own, other = (result.errors_mm[model] for model in (result.beside.corrected, result.beside.other))
        text.append(
            f"The best corrected model, {model_name(result.beside.corrected)}, has an error of "
            f"{number_text(own['mean'])} mm; "
            f"the best of all others, {model_name(result.beside.other)}, {number_text(other['mean'])} mm."
        )
    if result.moved_mm is not None:
        moved = number_text(result.moved_mm)
        text.append(f"A finer mesh moves the markers of the identified simulator by {moved} mm.")
    blocks: list[Block] = [
        *([drawn_file(path, alt, "The simulated body.")] if path.is_file() else []),
        Text(f"{robot.actuation[:1].upper()}{robot.actuation[1:]}. {robot.source}"),
        Text(" ".join(text)),
    ]
    if robot.published:
        blocks += [Text("Published", heading=True), Items(robot.published)]
    return Part(robot.title, [*blocks, Items([shlex.join(["warp-resphys", *result.arguments])], code=True)])


def machines(robots: Mapping[str, RecordedRobot], measured: Mapping[str, Measured]) -> Part:
    """Day, machine and versions of packages of each robot's run."""
    columns = ["Measured", *_MACHINE.values(), *_PACKAGES]
    rows = [
        Row(
            robots[name].title,
            [Cell(result.day), *(Cell(result.machine.get(key, NONE)) for key in (*_MACHINE, *_PACKAGES))],
        )
        for name, result in measured.items()
    ]
    return Part("Machines and versions", [PageTable("Robot", columns, rows)] if rows else [])


def verdict(robots: Mapping[str, RecordedRobot], measured: Mapping[str, Measured]) -> str:
    """Sentences on the robots that need a corrected simulator, and on those for which the learned force helps."""
    if not measured:
        return "No run has succeeded."
    needed, helped = (
        [robots[name].title for name, result in measured.items() if getattr(result, kind)]
        for kind in ("is_needed", "is_helped")
    )
    compared = [result for result in measured.values() if result.beside is not None]
    which = [
        f"{len(own)} of {len(of)} robots{f' ({in_a_row(own)})' if own else ''}"
        for own, of in ((needed, compared), (helped, measured))
    ]
    few = [robots[name].title for name, result in measured.items() if len(result.tested) < LEAST_TRIALS]
    text = (
        "By its 90 % interval over the held-out trials, a corrected simulator has less error than all other models "
        f"(uncorrected, a network alone, without physics) on {which[0]} for which all of these were measured, and the "
        f"learned force reduces the error of identification on {which[1]}."
    )
    return text + (f" {in_a_row(few)}: fewer than {LEAST_TRIALS} trials, so no interval." if few else "")
