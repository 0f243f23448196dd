"""The page of robots, docs/robots.md, from the results
that `reproduce.py` keeps of every robot's run.
"""

import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import yaml

from warp_resphys.learning.baselines import BASELINES
from warp_resphys.report.data import Errors
from warp_resphys.report.ranking import (
    LEAST_EVIDENCE,
    LEAST_TRIALS,
    best_pair,
    compared,
    known_errors,
)
from warp_resphys.report.verdict import less_error
from warp_resphys.report.wording import (
    MINUS,
    MODELS,
    NONE,
    duration_text,
    error_parts,
    in_a_row,
    model_words,
    number_text,
)

ROWS: Final[Mapping[str, Any]] = yaml.safe_load(
    Path(__file__).with_name("reproduce.yaml").read_text(encoding="utf-8")
)
CORRECTED: Final = ("sysid", "resphys")
MACHINE: Final = {
    "processor": "Processor",
    "cores used": "Cores used",
    "GPU": "GPU",
    "commit": "Commit",
}
PACKAGES: Final = ("python", "warp-lang", "torch")


def beside(errors: Errors) -> dict[str, Any] | None:
    """The corrected model of least mean error beside the best of all others.

    None where one of them is missing.
    """
    corrected, other = best_pair(known_errors(errors))
    gain = gain_of(errors, other, corrected)
    return gain and {"corrected": corrected, "other": other, "gain": gain}


def gain_of(errors: Errors, before: str, after: str) -> dict[str, Any] | None:
    """Share of the error of one model that another removes.

    None where one is missing or has diverged.
    """
    known = known_errors(errors)
    return (
        dict(compared(known[before], known[after])._asdict())
        if {before, after} <= known.keys()
        else None
    )


def robots_page(
    results: Mapping[str, Mapping[str, Any]], failed: Mapping[str, str], pictures: Path
) -> str:
    """Returns the page of robots: a table with a row for each, and a section for each.

    Args:
        results: by robot, from `measure`.
        failed: error messages of runs that failed now, by robot; such a robot keeps its last
            results.
        pictures: folder with pictures of their bodies.
    """
    results = {name: results[name] for name in ROWS["robots"] if name in results}
    titles = {name: str(robot["title"]) for name, robot in ROWS["robots"].items()}
    lines = [
        f"# Robots of {max((row['day'] for row in results.values()), default=NONE)}",
        _robots_verdict(results),
    ]
    lines += ["## All robots", *_robots_table(results, failed)] if results else []
    for name, row in results.items():
        lines += [f"## {titles[name]}", *_robot_section(name, row, pictures)]
    failures = [f"{titles[name]} failed: {failure}" for name, failure in failed.items()]
    lines += ["## Not run", items(failures)] if failures else []
    cells = [
        [
            titles[name],
            row["day"],
            *(row["machine"].get(key, NONE) for key in (*MACHINE, *PACKAGES)),
        ]
        for name, row in results.items()
    ]
    lines += [
        "## Machines and versions",
        table(["Robot", "Measured", *MACHINE.values(), *PACKAGES], cells),
    ]
    return "\n\n".join(
        [
            *lines,
            "## Command",
            "- `python scripts/reproduce.py robots --data FOLDER --results docs`",
        ]
    )


def _robots_table(results: Mapping[str, Mapping[str, Any]], failed: Mapping[str, str]) -> list[str]:
    models = ("simulation", "sysid", "simfree", "resphys")
    rows = []
    for name, row in results.items():
        errors, title = row["errors_mm"], _title(name)
        small = [*row["beyond"], *([f"failed since {row['day']}"] if name in failed else [])]
        means = {
            m: errors[m]["mean"] for m in BASELINES if m in errors and errors[m]["mean"] is not None
        }
        best = min(means, key=means.__getitem__, default="")
        interval = row["intervals"]
        rows.append(
            [
                f"{title} ({', '.join(small)})" if small else title,
                f"{number_text(means[best])} {MODELS[best].name.lower()}" if best else NONE,
                *(
                    " ".join(error_parts(errors[model])).strip() if model in errors else NONE
                    for model in models
                ),
                *(_gain_text(row["gains"].get(model)) for model in CORRECTED),
                f"{100.0 * interval['coverage']:.0f} % (± {interval['half_width_mm']:.2g} mm)"
                if interval
                else NONE,
                duration_text(row["seconds"]),
            ]
        )
    note = (
        "Mean distance of the markers on data that neither training nor identification used "
        "[mm], ± the standard deviation over trials. Without physics: the best of a body at "
        "rest, interpolation and regression between the training trials, and a linear model. "
        "Less error: the share of the uncorrected error that SysID removes, and of SysID's "
        "error that ResPhys removes, which is the simulator with all that is learned and used, "
        "its actuators or a force, with its 90 % interval over the trials (paired bootstrap) if "
        f"there are {LEAST_TRIALS} or more. Coverage: the share of the measured coordinates "
        "within the 90 % prediction intervals of ResPhys, and their mean half-width. Time: the "
        "sum over all stages and folds, including those that ran in parallel, "
        "on a machine with other load."
    )
    heads = ["Robot", "Without physics [mm]", *(f"{MODELS[model].name} [mm]" for model in models)]
    heads += [*(f"Less error by {MODELS[model].name}" for model in CORRECTED), "Coverage", "Time"]
    return [table(heads, rows), note]


def _gain_text(gain: Mapping[str, Any] | None) -> str:
    if gain is None:
        return NONE
    share, *ends = (
        f"{100.0 * gain[key]:.0f}".replace("-", MINUS) for key in ("share", "lower", "upper")
    )
    return f"{share} %" if gain["trials"] < LEAST_TRIALS else f"{share} % ({' to '.join(ends)})"


def _robot_section(name: str, row: Mapping[str, Any], pictures: Path) -> list[str]:
    """Picture, source of the recordings, test trials and published results of a robot."""
    robot, count = ROWS["robots"][name], len(row["tested"])
    text = (
        f"Tested on {count} trial{'s' if count > 1 else ''}, {row['how']}: "
        f"{', '.join(row['tested'])}."
    )
    pair = row["beside"]
    if pair:
        means = {
            model: row["errors_mm"][model]["mean"] for model in (pair["corrected"], pair["other"])
        }
        best, second = sorted(means, key=lambda model: means[model])
        said = less_error(best, second, 1.0 - means[best] / means[second])
        if count < LEAST_EVIDENCE:
            said = f"no evidence either way for {model_words(best)} or {model_words(second)}"
        text += (
            f" {said[0].upper()}{said[1:]} ({number_text(means[best])} and "
            f"{number_text(means[second])} mm)."
        )
    if row["moved_mm"] is not None:
        text += (
            " A finer mesh moves the markers of the identified simulator by "
            f"{number_text(row['moved_mm'])} mm."
        )
    blocks = []
    if (pictures / f"{name}.png").is_file():
        alt = f"The body of {robot['title']} and its markers."
        blocks += [f"![{alt}]({pictures.name}/{name}.png)", "The simulated body."]
    actuation = robot["actuation"]
    blocks += [f"{actuation[:1].upper()}{actuation[1:]}. {robot['source']}", text]
    if published := robot.get("published"):
        blocks += ["Published:", items(published)]
    return [*blocks, f"- `{shlex.join(['warp-resphys', *row['arguments']])}`"]


def _robots_verdict(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Sentences on the robots that need a corrected simulator,
    and on those for which learning helps.
    """
    if not results:
        return "No run has succeeded."
    gains = {
        name: (row["beside"] and row["beside"]["gain"], row["gains"]["resphys"])
        for name, row in results.items()
    }
    words = []
    for which, of in ((0, [n for n, row in results.items() if row["beside"]]), (1, [*results])):
        clear = [
            n
            for n in of
            if (g := gains[n][which]) and g["trials"] >= LEAST_TRIALS and g["lower"] > 0.0
        ]
        words.append(
            f"{len(clear)} of {len(of)} robots"
            + (f" ({in_a_row([*map(_title, clear)])})" if clear else "")
        )
    few = [name for name, row in results.items() if len(row["tested"]) < LEAST_TRIALS]
    return (
        "By its 90 % interval over the held-out trials, a corrected simulator has less error "
        "than all other models (uncorrected, without physics and, where it was trained, a "
        f"network alone) on {words[0]}, and what is learned on top reduces the error of "
        f"identification on {words[1]}."
    ) + (
        f" {in_a_row([*map(_title, few)])}: fewer than {LEAST_TRIALS} trials, so no interval."
        if few
        else ""
    )


def _title(name: str) -> str:
    return str(ROWS["robots"][name]["title"])


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a table of Markdown."""
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, *rows)]
    return "\n".join([lines[0], f"|{'---|' * len(heads)}", *lines[1:]])


def items(texts: Iterable[str]) -> str:
    """Returns a list of Markdown."""
    return "\n".join(f"- {text}" for text in texts)
