"""Runs the published beams and the recorded robots with the ordinary command,
and writes the page of each.

python scripts/reproduce.py
    the beams, beside what was published
python scripts/reproduce.py robots --data FOLDER --results docs
    robots with recordings in FOLDER: docs/robots.md
python scripts/reproduce.py tentacle --data FOLDER --overrides budget=quick
    one; or beam_twist, beam_twist/default

Runs follow each other. One that fails does not stop the others, and one that is up to date is not
run again. The pages are reproduction.md and robots.md, with their figures beside them, in
--results. robots.json keeps the result of every robot, so that robots.md also has those of earlier
runs, each with its day and machine. reproduce.yaml has the rows.
"""

import argparse
import hashlib
import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from robots_page import ROWS, beside, gain_of, items, robots_page, table

from warp_resphys.commands import run_label
from warp_resphys.data.recordings.segment import convert_segment
from warp_resphys.io.errors import ResphysError
from warp_resphys.io.machine import commit, hardware
from warp_resphys.io.resuming import package_versions
from warp_resphys.io.safe_files import read_json, write_text
from warp_resphys.learning.baselines import BASELINES
from warp_resphys.learning.metrics import PUBLISHED_MM
from warp_resphys.report.data import Metrics, trial_errors
from warp_resphys.report.wording import (
    MODELS,
    NONE,
    duration_text,
    error_parts,
    number_text,
    published_parts,
)

RUNS: Final = Path("runs")
INTERRUPTED, USER_ERROR = 130, 2

COMPARED: Final = (*BASELINES, "simulation", "sysid", "simfree", "resphys")
FIGURES: Final = ("error_over_time", "paths_worst")
BODY_PICTURES: Final = ("figures/body.png", "fold_*/figures/body.png", "figures/registration.png")


@dataclass
class Run:
    """A run of the ordinary command.

    Attributes:
        name: of a robot, or of a beam and a column, as in beam_twist/default.
        arguments: of the command.
        folder: of its files.
        failure: error message of a failed run.
    """

    name: str
    arguments: list[str]
    folder: Path
    failure: str = ""

    def execute(self) -> None:
        """Runs the command, unless its files are up to date.

        Ctrl-C interrupts it, and it saves its state.
        """
        command = [
            sys.executable,
            "-m",
            "warp_resphys",
            *self.arguments,
            f"hydra.run.dir={self.folder}",
        ]
        with subprocess.Popen(
            command, stderr=subprocess.PIPE, text=True, start_new_session=True
        ) as child:
            assert child.stderr is not None
            sentence = ""
            try:
                for line in child.stderr:
                    sys.stderr.write(line)
                    sentence = (
                        line.removeprefix("error: ").strip()
                        if line.startswith("error: ")
                        else sentence
                    )
            except KeyboardInterrupt:
                child.terminate()
                sys.stderr.write(child.stderr.read())
                raise
        self.failure = (sentence or f"exit code {child.returncode}") if child.returncode else ""

    @cached_property
    def metrics(self) -> Metrics:
        """Content of metrics.json."""
        metrics: Metrics = read_json(self.folder / "metrics.json")
        return metrics

    @cached_property
    def data(self) -> dict[str, Any]:
        """The group `data` of the configuration of the run, from the record of its report."""
        return dict(read_json(self.folder / "stages" / "report.json")["settings"]["data"])


def main() -> None:
    """Runs the selected rows, and writes their pages.

    The exit code is 2 where a run failed, 130 after Ctrl-C.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "only", nargs="*", default=["beams"], help="beams, robots, or names of them (beams)"
    )
    parser.add_argument(
        "--data", type=Path, default=Path("recordings"), help="folder with one for each robot"
    )
    parser.add_argument(
        "--results", type=Path, default=Path("outputs/reproduce"), help="folder of the pages"
    )
    parser.add_argument(
        "--overrides", nargs="*", default=[], help="of every run, such as budget=quick"
    )
    options = parser.parse_args()
    beyond = options.overrides
    try:
        beams, robots = selected(options.only)
        runs = []
        for name, variant in beams:
            of_beam = ROWS["beams"][name].get("overrides", ())
            overrides = [*of_beam, *ROWS["variants"][variant]["overrides"], *beyond]
            runs.append(run_of(f"{name}/{variant}", name, overrides))
        # None where a simulation plays.
        folders = {name: ROWS["robots"][name].get("recordings") for name in robots}
        places = {name: folder and options.data / folder for name, folder in folders.items()}
        present = {name: place for name, place in places.items() if place is None or place.is_dir()}
        if absent := sorted(places.keys() - present.keys()):
            print(f"--data has no recordings of {', '.join(absent)}", file=sys.stderr)
            if not (present or beams):
                sys.exit(USER_ERROR)
        kept = kept_results(options.results / "robots.json", present, beyond)
        robot_runs = [robot_run(name, place, beyond) for name, place in present.items()]
        for run in (*runs, *robot_runs):
            print(f"run {run.name}", file=sys.stderr, flush=True)
            run.execute()
        if beams:
            _write(
                options.results / "reproduction.md",
                beams_page(runs, options.results / "reproduction"),
            )
        if robots:
            pictures = options.results / "robots"
            for run in robot_runs:
                if not run.failure:
                    kept[run.name] = measure(run, beyond)
                    copy_picture(run.folder, BODY_PICTURES, pictures / f"{run.name}.png")
            failed = {run.name: run.failure for run in robot_runs if run.failure}
            _write(options.results / "robots.json", json.dumps(kept, indent=2))
            _write(options.results / "robots.md", robots_page(kept, failed, pictures))
    except KeyboardInterrupt:
        print(
            "interrupted; finished work is kept, and the same command continues from there",
            file=sys.stderr,
        )
        sys.exit(INTERRUPTED)
    except (ResphysError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(USER_ERROR)
    if failures := [run.name for run in (*runs, *robot_runs) if run.failure]:
        print(
            f"error: failed: {', '.join(failures)}; correct it and run the same command again",
            file=sys.stderr,
        )
        sys.exit(USER_ERROR)


def selected(only: Iterable[str]) -> tuple[list[tuple[str, str]], list[str]]:
    """Returns beams, as pairs of a row and a variant, and names of robots.

    Raises:
        ResphysError: an unknown name.
    """
    pairs = [
        (name, variant) for name, beam in ROWS["beams"].items() for variant in beam["variants"]
    ]
    names = [
        "beams",
        "robots",
        *ROWS["beams"],
        *ROWS["robots"],
        *("/".join(pair) for pair in pairs),
    ]
    wanted = {*only}
    if unknown := wanted - {*names}:
        raise ResphysError(f"there is no {min(unknown)}: choose from {', '.join(names)}.")
    beams = [pair for pair in pairs if {"beams", pair[0], "/".join(pair)} & wanted]
    return beams, [name for name in ROWS["robots"] if {"robots", name} & wanted]


def run_of(name: str, experiment: str, overrides: Sequence[str]) -> Run:
    """Returns a run, in the folder that the command itself would choose."""
    folder = RUNS / experiment / run_label(overrides, ("experiment", "device"))
    return Run(name, [f"experiment={experiment}", *overrides], folder)


def robot_run(name: str, place: Path | None, beyond: Sequence[str]) -> Run:
    """Returns the run of a robot, whose recordings are in a folder.

    Without one, a simulation plays the robot.

    Raises:
        ResphysError: the recordings are not those of the row.
    """
    robot = ROWS["robots"][name]
    run = run_of(name, robot["experiment"], [*robot.get("overrides", ()), *beyond])
    if place is not None:
        files = sorted(place.glob(robot["files"]))
        if (
            hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
            != robot["sha256"]
        ):
            raise ResphysError(
                f"the files {place / robot['files']} are not those of the page: fetch them again."
            )
        if "converted" in robot:
            place = RUNS / "recordings" / name
            convert_segment(files[0], place)
        run.arguments.append(f"data.folder={place.resolve()}")
    return run


def kept_results(
    path: Path, names: Iterable[str], beyond: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Returns results of earlier runs, by robot.

    Raises:
        ResphysError: a robot of this run was measured with other overrides.
    """
    kept: dict[str, dict[str, Any]] = read_json(path) if path.is_file() else {}
    for name in names:
        if name in kept and kept[name]["beyond"] != list(beyond):
            old, new = (
                " ".join(words) or "its own settings" for words in (kept[name]["beyond"], beyond)
            )
            raise ResphysError(
                f"{path} has {name} with {old}, not with {new}: name another folder by --results."
            )
    return kept


def measure(run: Run, beyond: Sequence[str]) -> dict[str, Any]:
    """Returns the results of a robot's run, as robots.json keeps them."""
    metrics = run.metrics
    folds = metrics.get("folds", {})
    tested = list(folds) or [row["name"] for row in metrics["per_trajectory"]]
    records = [
        read_json(path)
        for fold in (".", "fold_*")
        for path in run.folder.glob(f"{fold}/stages/evaluate.json")
    ]
    made = max(records, key=lambda record: str(record["finished"]))
    how = "each held out once" if len(folds) > 1 else "held out"
    if run.data.get("train_fraction", 1.0) < 1.0 and {*tested} <= {*run.data["train"]}:
        how = "in the part that was not used for training"
    errors = {model: error for model, error in trial_errors(metrics).items() if model in COMPARED}
    intervals = metrics["intervals"]["models"].get("resphys") if "intervals" in metrics else None
    return {
        "day": str(made["finished"]).partition("T")[0],
        "machine": {**made.get("machine", {}), **made["versions"]},
        "arguments": [
            "data.folder=FOLDER" if x.startswith("data.folder=") else x for x in run.arguments
        ],
        "beyond": list(beyond),
        "tested": tested,
        "how": how,
        "errors_mm": {
            model: metrics["errors_mm"][model]
            for model in COMPARED
            if model in metrics["errors_mm"]
        },
        "beside": beside(errors),
        "gains": {
            "sysid": gain_of(errors, "simulation", "sysid"),
            "resphys": gain_of(errors, "sysid", "resphys"),
        },
        "intervals": intervals
        and {"coverage": intervals["coverage"], "half_width_mm": intervals["half_width_mm"]},
        "seconds": sum(sum(part["seconds"].values()) for part in (metrics, *folds.values())),
        "moved_mm": metrics.get("mesh_check", {}).get("moved_mm"),
    }


def beams_page(runs: Sequence[Run], figures: Path) -> str:
    """Returns the page that compares published results with those of the runs,
    whose figures are copied.
    """
    done: dict[str, dict[str, Run]] = {}
    for run in runs:
        name, _, variant = run.name.partition("/")
        if not run.failure:
            done.setdefault(name, {})[variant] = run
    sections = []
    for name, columns in done.items():
        first = next(iter(columns.values()))
        kinds = FIGURES if name in PUBLISHED_MM else ("marker_ablation",)
        for kind in kinds:
            copy_picture(first.folder, [f"figures/{kind}.png"], figures / f"{name}_{kind}.png")
        labels = ["Published", *(str(ROWS["variants"][variant]["label"]) for variant in columns)]
        sections += [f"## {ROWS['beams'][name]['title']}"]
        sections += (
            _errors_table(name, labels, columns)
            if name in PUBLISHED_MM
            else _markers_table(name, first)
        )
        sections += [
            f"![{kind.replace('_', ' ')}]({figures.name}/{name}_{kind}.png)" for kind in kinds
        ]
        sections += ["Reasons for deviations:", items(ROWS["beams"][name]["deviations"])]
        if name == "beam_oscillation":
            sections += ["## Time benchmark", *_time_table(labels, columns)]
    lines = []
    for run in runs:
        command = shlex.join(["warp-resphys", *run.arguments])
        lines.append(
            f"`{command}`: {run.failure or duration_text(sum(run.metrics['seconds'].values()))}"
        )
    sections += ["## Runs", items(lines)]
    made = {**hardware(), "commit": commit() or "not known", **package_versions()}
    sections += ["## Machine and versions", items(f"{key}: {value}" for key, value in made.items())]
    return "\n\n".join(["# Reproduction of the published beams", *sections])


def _errors_table(name: str, labels: Sequence[str], columns: Mapping[str, Run]) -> list[str]:
    published, measured = PUBLISHED_MM[name], [run.metrics["errors_mm"] for run in columns.values()]
    rows = [
        [
            f"**{MODELS[model].name}**" if model == "resphys" else MODELS[model].name,
            " ".join(published_parts(published[model])) if model in published else NONE,
            *(
                " ".join(error_parts(errors[model])).strip() if model in errors else NONE
                for errors in measured
            ),
        ]
        for model in ("simulation", "reconstruction", "simfree", "resphys")
    ]
    note = (
        "Mean distance of the vertices over all test trajectories and steps, ± its standard "
        "deviation. There is no mean if a roll-out diverged. Reconstruction: the simulator with "
        "forces fitted to the test trajectory itself."
    )
    return [table(["Roll-out error [mm]", *labels], rows), note]


def _time_table(labels: Sequence[str], columns: Mapping[str, Run]) -> list[str]:
    timing = ROWS["timing"]
    steps = [run.data["steps"] for run in columns.values()]
    seconds = [run.metrics["seconds_per_test_trajectory"] for run in columns.values()]

    def text(mean: float, std: float, count: int) -> str:
        return f"{mean:.3f} ± {std:.3f} {1e3 * mean / count:.2g} ms a step"

    rows = []
    for key, (label, mean, std) in timing["published"].items():
        ours = [
            text(second[key]["mean"], second[key]["std"], n)
            for second, n in zip(seconds, steps, strict=True)
        ]
        rows.append([label, text(mean, std, timing["steps"]), *ours])
    note = (
        f"Published: trajectories of {timing['steps']} steps; here: of "
        f"{' and '.join(sorted({*map(str, steps)}))}."
    )
    return [
        table(["Time per trajectory [s]", *labels], rows),
        note,
        "Reasons for deviations:",
        items(timing["deviations"]),
    ]


def _markers_table(name: str, run: Run) -> list[str]:
    published, metrics = ROWS["beams"][name]["published"], read_json(run.folder / "metrics.json")
    rows = []
    for row in metrics["by_markers"]:
        count = row["markers"]
        median = (
            f"below {published['median_mm']:g}" if count >= published["markers"] else "not given"
        )
        spread = "small" if count >= published["markers_of_small_spread"] else "high"
        ours = (
            number_text(row[key]) for key in ("median_mm", "interquartile_range_mm", "largest_mm")
        )
        rows.append([str(count), median, spread, *ours])
    uncorrected = number_text(metrics["uncorrected_mm"])
    note = (
        "Error over all vertices [mm] of random sets of markers on the surface. Uncorrected: "
        f"{uncorrected} mm."
    )
    heads = [
        "Published median",
        "Published spread",
        "Median here",
        "Interquartile range here",
        "Largest here",
    ]
    return [table(["Markers", *heads], rows), note]


def copy_picture(folder: Path, patterns: Iterable[str], to: Path) -> None:
    """Copies the first file of a run folder that has one of several patterns.

    None where there is no such file.
    """
    files = [path for pattern in patterns for path in sorted(folder.glob(pattern))]
    if files:
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(files[0], to)


def _write(path: Path, text: str) -> None:
    """Writes a file, and prints its name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, f"{text}\n")
    print(path)


if __name__ == "__main__":
    main()
