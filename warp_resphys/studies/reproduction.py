"""Every experiment in turn, and one page that sets published results beside ours."""

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from ..io.errors import InputError
from ..io.labels import run_label
from ..io.stages import run_lock
from ..report.page import Canvas, figures_beside
from .comparison import compare
from .runs import Results, Run, asked_for, fail_for, made, run_all

PAGE = "reproduction.html"


def reproduce(config: Mapping[str, Any], folder: Path) -> None:
    """Runs what is configured; writes the page and logs into the run folder, and where asked a dated page of results.

    Raises:
        InputError: a value that cannot be used.
        ResphysError: a run failed; the others were run, and the page is written.
        RunsInterrupted: Ctrl-C.
    """
    runs = plan(config)
    with run_lock(folder):
        results = run_all(runs, folder / "logs")
        page = folder / PAGE
        with figures_beside(page) as pictures:
            said, parts = compare(config, results, Canvas(pictures))
        date = f"{datetime.now():%Y-%m-%d}"
        dated = Results("Reproduction", date, said, [*parts, made("reproduce")])
        dated.write(page, config["results"], f"{date}-reproduction")
    fail_for(results)


def plan(config: Mapping[str, Any]) -> list[Run]:
    """The runs that are asked for, in order.

    Raises:
        InputError: a value of the wrong kind, or a name that does not exist.
    """
    groups = config["experiments"]
    pairs = [(experiment, variant) for experiment, group in groups.items() for variant in group["variants"]]
    known = sorted({*groups, *("/".join(pair) for pair in pairs)})
    wanted = asked_for(config, known, "experiment or run")
    return [_run(config, *pair) for pair in pairs if {pair[0], "/".join(pair)} & wanted]


def _run(config: Mapping[str, Any], experiment: str, name: str) -> Run:
    if name not in config["variants"]:
        raise InputError(
            f"experiments.{experiment}.variants names {name!r}: there are {', '.join(config['variants'])}."
        )
    variant = config["variants"][name]
    overrides = [*variant["overrides"], *config["experiments"][experiment]["overrides"], *config["overrides"]]
    if config["budget"] != "full":
        overrides.append(f"budget={config['budget']}")
    folder = Path(config["runs"]) / experiment / run_label(overrides, ("experiment", "device"))
    return Run(experiment, name, (f"experiment={experiment}", *overrides), folder, variant["minutes"][config["budget"]])
