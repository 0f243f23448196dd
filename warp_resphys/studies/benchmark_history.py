"""Records of the benchmark, one JSON file per machine and date, and the page of their history.

A record has the median times of every case and the yardstick of the same run; their quotients can be compared between
dates.

    python -m warp_resphys.studies.benchmark_history docs/results/benchmarks docs/benchmark_history.md
"""

import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any, Final

from matplotlib.figure import Figure

from ..io.errors import DataFileError, InputError
from ..io.files import read_json, write_json, write_text
from ..io.machine import commit
from ..report.figures import in_style, save_png

_CASE: Final = ("solver", "model", "poissons_ratio", "refinement", "unknowns", "batch", "contact")
_TIMES: Final = ("plain_ms", "forward_ms", "backward_ms")  # of a step of the whole batch
_KEYS: Final = {
    "date",
    "commit",
    "device",
    "dtype",
    "machine",
    "hardware",
    "versions",
    "command",
    "yardstick_ms",
    "cases",
}
_HEAD: Final = """# History of the benchmark

Times of a step with gradients, forward and backward, in yardsticks: a product and a Cholesky factor of 480 x 480
matrices in NumPy on one thread, timed in the same run, so that the pace of a machine matters less. Compare dates of one
machine alone. These commands add a record to `docs/results/benchmarks` and draw this page:

```bash
warp-resphys benchmark benchmark.record=docs/results/benchmarks
python -m warp_resphys.studies.benchmark_history docs/results/benchmarks docs/benchmark_history.md
```
"""


def record(result: Mapping[str, Any], machine: str, overrides: Sequence[str]) -> dict[str, Any]:
    """The part of a result of `studies.benchmark.run_benchmark` that is kept.

    Args:
        result: the content of benchmark.json.
        machine: the name of the GPU or processor that was measured.
        overrides: settings of the command line.
    """
    return {
        "date": result["date"],
        "commit": commit() or "not known",
        "device": result["settings"]["device"],
        "dtype": result["settings"]["dtype"],
        "machine": machine,
        "hardware": result["hardware"],
        "versions": result["versions"],
        "command": shlex.join(["warp-resphys", "benchmark", *overrides]),
        "yardstick_ms": result["yardstick_ms"],
        "cases": [{key: row[key] for key in (*_CASE, "repeats", *_TIMES)} for row in result["steps"]],
    }


def write_record(folder: Path, kept: Mapping[str, Any]) -> Path:
    """Writes a `record` into a folder as DATE-MACHINE.json; a second one of a day replaces the first."""
    machine = re.sub(r"[^a-z0-9]+", "-", kept["machine"].lower()).strip("-")
    path = folder / f"{kept['date'][:10]}-{machine}.json"
    write_json(path, kept)
    return path


def read_records(folder: Path) -> list[dict[str, Any]]:
    """Returns the records of a folder, oldest first.

    Raises:
        InputError: there are none.
        DataFileError: a file is no record.
    """
    records = []
    for path in sorted(folder.glob("*.json")):
        content = read_json(path)
        if not isinstance(content, dict) or not content.keys() >= _KEYS:
            raise DataFileError(f"{path} is no record of the benchmark: write it with benchmark.record={folder}.")
        records.append(content)
    if not records:
        raise InputError(f"{folder} has no records: write one with `warp-resphys benchmark benchmark.record={folder}`.")
    return sorted(records, key=lambda entry: str(entry["date"]))


def histories(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Quotients of forward and backward time to the yardstick, by machine, case and date."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for entry in records:
        machine = result.setdefault(f"{entry['machine']}, {entry['dtype']}", {})
        for case in entry["cases"]:
            quotient = (case["forward_ms"] + case["backward_ms"]) / entry["yardstick_ms"]
            machine.setdefault(_name(case), {})[entry["date"][:10]] = quotient
    return result


def history_page(records: Sequence[Mapping[str, Any]], picture: str) -> str:
    """The page of the history in Markdown: a picture, and for every machine a table of cases by date."""
    parts = [_HEAD, f"![Forward and backward time in yardsticks, by date]({picture})\n"]
    for machine, cases in histories(records).items():
        dates = sorted({day for values in cases.values() for day in values})
        own = [entry for entry in records if f"{entry['machine']}, {entry['dtype']}" == machine]
        parts.append(f"## {machine}\n\n| case | {' | '.join(dates)} |\n|---|{'---|' * len(dates)}")
        for name, values in cases.items():
            cells = (f"{values[day]:.2f}" if day in values else "" for day in dates)
            parts.append(f"| {name} | {' | '.join(cells)} |")
        latest = {entry["date"][:10]: entry for entry in own}
        yardsticks = (f"{latest[day]['yardstick_ms']:.2f}" for day in dates)
        parts.append(f"| yardstick [ms] | {' | '.join(yardsticks)} |")
        parts.append(f"| commit | {' | '.join(latest[day]['commit'] for day in dates)} |\n")
        parts += [f"{day}: `{latest[day]['command']}`\n" for day in dates]
    return "\n".join(parts)


def history_figure(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Quotients over dates, a panel per machine and a line per case."""
    shown = histories(records)
    with in_style():
        figure = Figure(figsize=(7.0, 3.2 * len(shown)), layout="constrained")
        for axes, (machine, cases) in zip(figure.subplots(len(shown), squeeze=False)[:, 0], shown.items(), strict=True):
            for number, (name, values) in enumerate(cases.items()):
                days = [date.fromisoformat(day) for day in values]
                axes.plot(days, list(values.values()), marker="osD^v"[number // 10 % 5], label=name)
            days = sorted({date.fromisoformat(day) for values in cases.values() for day in values})
            axes.set_xticks(days, [f"{day}" for day in days])
            axes.set(yscale="log", title=machine, ylabel="time / yardstick")
            axes.legend(fontsize="xx-small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _name(case: Mapping[str, Any]) -> str:
    material = case["model"] if case["poissons_ratio"] is None else f"nu {case['poissons_ratio']:g}"
    touches = ", on a floor" if case["contact"] else ""
    return f"{case['solver']}, {material}, {case['unknowns']} unknowns, batch {case['batch']}{touches}"


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:])
    records = read_records(source)
    write_text(target, history_page(records, target.with_suffix(".png").name))
    save_png(history_figure(records), target.with_suffix(".png"))
